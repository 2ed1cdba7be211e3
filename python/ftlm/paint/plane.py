"""Points of the complex plane, such as poles, with the sector in which they may not lie."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from ftlm.base.arrays import Complex
from ftlm.base.errors import DataError
from ftlm.paint.axes import ticks
from ftlm.paint.figure import LETTER, NARROW, SMALL, Figure, svg, svg_text, text_width
from ftlm.paint.lines import LINES
from ftlm.paint.text import number

#: Height of the plot, and half the size of a cross [px].
HEIGHT, CROSS = 260.0, 5.0
#: Share of the plot that is left free around the farthest point.
MARGIN = 1.18


def plane_chart(
    points: Sequence[complex], *, title: str, x_label: str, y_label: str, sector: float = math.pi / 2,
    caption: str = "",
) -> Figure:  # fmt: skip
    """Crosses in the complex plane, with the same unit in both directions.

    Parameters
    ----------
    points
        Where they are, finite; conjugate ones are both given.
    title, x_label, y_label
        Text, with units.
    sector
        Half-angle [rad] around the positive axis that is shaded: what is in it is not stable.
    caption
        Sentence below.

    Raises
    ------
    DataError
        A point that is not finite, or a sector that is no angle between 0 and pi.
    """
    values = np.asarray(list(points), dtype=np.complex128)
    bad = ~np.isfinite(values)
    if np.any(bad):
        raise DataError(f"point {int(np.argmax(bad))} of {values.size} is not finite; leave it out")
    if not 0 < sector < math.pi:
        raise DataError(f"sector = {sector!r} is no angle between 0 and pi")
    inside = int(np.sum(np.abs(np.angle(values)) < sector))
    far = float(np.max(np.abs(values), initial=0.0)) or 1.0
    listed = ", ".join(f"{number(v.real, 3)} {'−' if v.imag < 0 else '+'} {number(abs(v.imag), 3)}j" for v in values)
    described = f"{values.size} points in the plane: {listed or 'none'}. {inside} in the shaded sector."
    wide, small = (
        _drawing(values, far, sector, (title, described, x_label, y_label), narrow=narrow) for narrow in (False, True)
    )
    return Figure(title, wide, small, caption)


def _drawing(
    values: Complex, far: float, sector: float, words: tuple[str, str, str, str], *, narrow: bool
) -> Markup:  # fmt: skip
    title, described, x_label, y_label = words
    width = NARROW if narrow else SMALL
    upward = ticks(-far * MARGIN, far * MARGIN, 5)
    left, top = max(30.0, 10 + max(map(text_width, upward.labels))), 26.0
    w, h = width - left - 14.0, HEIGHT
    # As many pixels a unit in both directions: far fits in the shorter one.
    scale = min(w, h) / (2 * far * MARGIN)
    x0, y0 = left + w / 2, top + h / 2
    across = ticks(-w / 2 / scale, w / 2 / scale, 4 if narrow else 8)
    out = [Markup('<g class="grid" fill="none" stroke="currentColor" stroke-opacity="0.14">')]
    out += [Markup('<path d="M{:.1f} {:.1f}v{:.1f}"/>').format(x0 + v * scale, top, h) for v in across.values]
    out += [Markup('<path d="M{:.1f} {:.1f}h{:.1f}"/>').format(left, y0 - v * scale, w) for v in upward.values]
    out.append(Markup("</g>"))
    inner = Markup('<svg x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{:.1f}" viewBox="{:.1f} {:.1f} {:.1f} {:.1f}">')
    out.append(inner.format(left, top, w, h, -w / 2, -h / 2, w, h))
    reach = 2 * (w + h)
    x, y = reach * math.cos(sector), reach * math.sin(sector)
    # Beyond a right angle the sector also covers what lies above and below its arms' ends.
    arms = [(x, -y), (reach, -reach), (reach, reach), (x, y)]
    path = "M0 0" + "".join(f"L{a:.1f} {b:.1f}" for a, b in arms) + "Z"
    out.append(Markup('<path class="shade1" fill="{}" fill-opacity="0.16" d="{}"/>').format(LINES[1][0], path))
    edge = Markup('<path class="line1" fill="none" stroke="{}" stroke-width="1.2" stroke-dasharray="5 3" d="{}"/>')
    out.append(edge.format(LINES[1][0], f"M{x:.1f} {-y:.1f}L0 0L{x:.1f} {y:.1f}"))
    axes = Markup(
        '<path fill="none" stroke="currentColor" stroke-opacity="0.55" d="M{:.1f} 0h{:.1f}M0 {:.1f}v{:.1f}"/>'
    )
    out.append(axes.format(-w / 2, w, -h / 2, h))
    for value in values.tolist():
        a, b = value.real * scale, -value.imag * scale
        cross = f"M{a - CROSS:.1f} {b - CROSS:.1f}l{2 * CROSS} {2 * CROSS}m0 {-2 * CROSS}l{-2 * CROSS} {2 * CROSS}"
        out.append(
            Markup('<path class="line2" fill="none" stroke="{}" stroke-width="2.2" d="{}"/>').format(LINES[2][0], cross)
        )
    out.append(Markup('</svg><g font-size="12" fill="currentColor">'))
    for v, label in zip(upward.values, upward.labels, strict=True):
        out.append(svg_text(left - 6, y0 - v * scale + 4, label, "end"))
    for v, label in zip(across.values, across.labels, strict=True):
        # A label at the edge would be cut off.
        place = min(max(x0 + v * scale, left + LETTER * len(label) / 2), width - LETTER * len(label) / 2 - 2)
        out.append(svg_text(place, top + h + 16, label, "middle"))
    factor = f" ({upward.factor})" if upward.factor else ""
    out += [svg_text(4, top - 12, y_label + factor, "start"), svg_text(left + w, top + h + 34, x_label + factor, "end")]
    out.append(Markup("</g>"))
    return svg(width, round(top + h + 44), title, described, out, narrow=narrow)
