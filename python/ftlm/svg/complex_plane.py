"""Complex plane: pole map and Nyquist locus."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike

from ftlm.errors import DataError
from ftlm.svg.figure import LETTER_WIDTH_PX, NARROW_WIDTH_PX, SMALL_WIDTH_PX, Figure, svg, svg_text, text_width, ticks
from ftlm.svg.line_chart import LINE_STYLES
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import number
from ftlm.utils.validation import Complex, as_complex

#: Height of the plot, and half the size of a cross [px].
PLANE_HEIGHT_PX, CROSS_HALF_SIZE_PX = 260.0, 5.0
#: Axis limits relative to the farthest point.
PLANE_MARGIN_FACTOR = 1.18


@check_arguments
def plane_chart(
    points: Sequence[complex],
    *,
    title: str,
    x_label: str,
    y_label: str,
    sector: float = math.pi / 2,
    caption: str = "",
) -> Figure:
    """Return a chart of crosses in the complex plane with equal axis units.

    Parameters
    ----------
    points
        Finite values; both members of a conjugate pair are given.
    title, x_label, y_label
        Text, with units.
    sector
        Half-angle [rad] of the shaded unstable sector around the positive axis.
    caption
        Sentence below.

    Raises
    ------
    DataError
        A point that is not finite, or a sector outside (0, pi).
    """
    values = as_complex("points", points)
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
        _draw_plane(values, far, sector, (title, described, x_label, y_label), narrow=narrow)
        for narrow in (False, True)
    )
    return Figure(title, wide, small, caption)


def _draw_plane(
    values: Complex, far: float, sector: float, words: tuple[str, str, str, str], *, narrow: bool
) -> Markup:
    title, described, x_label, y_label = words
    width = NARROW_WIDTH_PX if narrow else SMALL_WIDTH_PX
    upward = ticks(-far * PLANE_MARGIN_FACTOR, far * PLANE_MARGIN_FACTOR, 5)
    left, top = max(30.0, 10 + max(map(text_width, upward.labels))), 26.0
    w, h = width - left - 14.0, PLANE_HEIGHT_PX
    # As many pixels a unit in both directions: far fits in the shorter one.
    scale = min(w, h) / (2 * far * PLANE_MARGIN_FACTOR)
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
    out.append(Markup('<path class="shade1" fill="{}" fill-opacity="0.16" d="{}"/>').format(LINE_STYLES[1][0], path))
    edge = Markup('<path class="line1" fill="none" stroke="{}" stroke-width="1.2" stroke-dasharray="5 3" d="{}"/>')
    out.append(edge.format(LINE_STYLES[1][0], f"M{x:.1f} {-y:.1f}L0 0L{x:.1f} {y:.1f}"))
    axes = Markup(
        '<path fill="none" stroke="currentColor" stroke-opacity="0.55" d="M{:.1f} 0h{:.1f}M0 {:.1f}v{:.1f}"/>'
    )
    out.append(axes.format(-w / 2, w, -h / 2, h))
    for value in values.tolist():
        a, b = value.real * scale, -value.imag * scale
        c = CROSS_HALF_SIZE_PX
        cross = f"M{a - c:.1f} {b - c:.1f}l{2 * c} {2 * c}m0 {-2 * c}l{-2 * c} {2 * c}"
        out.append(
            Markup('<path class="line2" fill="none" stroke="{}" stroke-width="2.2" d="{}"/>').format(
                LINE_STYLES[2][0], cross
            )
        )
    out.append(Markup('</svg><g font-size="12" fill="currentColor">'))
    for v, label in zip(upward.values, upward.labels, strict=True):
        out.append(svg_text(left - 6, y0 - v * scale + 4, label, "end"))
    for v, label in zip(across.values, across.labels, strict=True):
        # A label at the edge would be cut off.
        place = min(
            max(x0 + v * scale, left + LETTER_WIDTH_PX * len(label) / 2), width - LETTER_WIDTH_PX * len(label) / 2 - 2
        )
        out.append(svg_text(place, top + h + 16, label, "middle"))
    factor = f" ({upward.factor})" if upward.factor else ""
    out += [svg_text(4, top - 12, y_label + factor, "start"), svg_text(left + w, top + h + 34, x_label + factor, "end")]
    out.append(Markup("</g>"))
    return svg(width, round(top + h + 44), title, described, out, narrow=narrow)


#: Height of the plot and radius of a dot [px].
LOCUS_HEIGHT_PX, DOT_RADIUS_PX = 240.0, 2.6
#: Margin around the data as a share of their range.
LOCUS_MARGIN_SHARE = 0.06


def locus_chart(
    curve: ArrayLike, points: ArrayLike, *, title: str, x_label: str, y_label: str, caption: str = ""
) -> Figure:
    """Return a chart of a curve and points in the complex plane.

    Parameters
    ----------
    curve
        Model values, complex, in order of frequency; non-finite values are left out.
    points
        Measured values, complex, finite.
    title, x_label, y_label
        Text, with units.
    caption
        Sentence below.

    Raises
    ------
    DataError
        A measured value that is not finite, or none.
    """
    line, dots = as_complex("curve", curve), as_complex("points", points)
    bad = ~np.isfinite(dots)
    if dots.size == 0 or np.any(bad):
        where = f"value {int(np.argmax(bad))} of {dots.size} is not finite" if dots.size else "there is no value"
        raise DataError(f"measured: {where}; leave it out")
    line = line[np.isfinite(line)]
    ends = f"from {_complex_text(dots[0])} to {_complex_text(dots[-1])}"
    described = f"Locus in the complex plane. {dots.size} measured points {ends}, and the model's curve."
    wide, small = (
        _draw_locus(line, dots, (title, described, x_label, y_label), narrow=narrow) for narrow in (False, True)
    )
    return Figure(title, wide, small, caption)


def _complex_text(value: complex) -> str:
    return f"{number(value.real, 3)} {'−' if value.imag < 0 else '+'} {number(abs(value.imag), 3)}j"


def _draw_locus(line: Complex, dots: Complex, words: tuple[str, str, str, str], *, narrow: bool) -> Markup:
    title, described, x_label, y_label = words
    width = NARROW_WIDTH_PX if narrow else SMALL_WIDTH_PX
    # Dots decide the frame; a curve that strays from them leaves it.
    low, high = complex(dots.real.min(), dots.imag.min()), complex(dots.real.max(), dots.imag.max())
    reach = max(high.real - low.real, high.imag - low.imag) or abs(high) or 1.0
    pad = LOCUS_MARGIN_SHARE * reach
    spread_x, spread_y = high.real - low.real + 2 * pad, high.imag - low.imag + 2 * pad
    guess = ticks(low.imag - pad, low.imag - pad + spread_y, 5)
    left, top = max(34.0, 10 + max(map(text_width, guess.labels))), 48.0
    w = width - left - 14.0
    scale = min(w / spread_x, LOCUS_HEIGHT_PX / spread_y)
    h = max(scale * spread_y, 90.0)
    x0, y0 = (low.real + high.real) / 2 - w / scale / 2, (low.imag + high.imag) / 2 - h / scale / 2
    upward, across = ticks(y0, y0 + h / scale, max(2, round(h / 48))), ticks(x0, x0 + w / scale, 4 if narrow else 8)

    def right(v: float) -> float:
        return left + (v - x0) * scale

    def down(v: float) -> float:
        return top + h - (v - y0) * scale

    out = [Markup('<g class="grid" fill="none" stroke="currentColor" stroke-opacity="0.14">')]
    out += [Markup('<path d="M{:.1f} {:.1f}v{:.1f}"/>').format(right(v), top, h) for v in across.values]
    out += [Markup('<path d="M{:.1f} {:.1f}h{:.1f}"/>').format(left, down(v), w) for v in upward.values]
    out.append(Markup("</g>"))
    inner = Markup('<svg x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{:.1f}" viewBox="{:.1f} {:.1f} {:.1f} {:.1f}">')
    out.append(inner.format(left, top, w, h, left, top, w, h))
    zeros = [f"M{left:.1f} {down(0):.1f}h{w:.1f}"] if y0 < 0 < y0 + h / scale else []
    zeros += [f"M{right(0):.1f} {top:.1f}v{h:.1f}"] if x0 < 0 < x0 + w / scale else []
    if zeros:
        axes = Markup('<path fill="none" stroke="currentColor" stroke-opacity="0.55" d="{}"/>')
        out.append(axes.format("".join(zeros)))
    # Far outside of the frame it no longer matters where, and the bound keeps numbers short.
    places = [(float(np.clip(right(v.real), -1e4, 1e4)), float(np.clip(down(v.imag), -1e4, 1e4))) for v in line]
    if places:
        path = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in places)
        curve = Markup('<path class="line1" fill="none" stroke="{}" stroke-width="1.5" d="{}"/>')
        out.append(curve.format(LINE_STYLES[1][0], path))
    dot = Markup('<circle class="line0" fill="none" stroke="{}" stroke-width="1.6" cx="{:.1f}" cy="{:.1f}" r="{}"/>')
    out += [dot.format(LINE_STYLES[0][0], right(v.real), down(v.imag), DOT_RADIUS_PX) for v in dots.tolist()]
    out.append(Markup('</svg><g font-size="12" fill="currentColor">'))
    for v, label in zip(upward.values, upward.labels, strict=True):
        out.append(svg_text(left - 6, down(v) + 4, label, "end"))
    for v, label in zip(across.values, across.labels, strict=True):
        place = min(
            max(right(v), left + LETTER_WIDTH_PX * len(label) / 2), width - LETTER_WIDTH_PX * len(label) / 2 - 2
        )
        out.append(svg_text(place, top + h + 16, label, "middle"))
    ratios = [f" ({axis.factor})" if axis.factor else "" for axis in (upward, across)]
    out += [
        svg_text(4, top - 10, y_label + ratios[0], "start"),
        svg_text(left + w, top + h + 34, x_label + ratios[1], "end"),
    ]
    out.append(
        Markup('<path class="line1" fill="none" stroke="{}" stroke-width="1.5" d="M{:.1f} 12h20"/>').format(
            LINE_STYLES[1][0], left
        )
    )
    out.append(svg_text(left + 26, 16, "model", "start"))
    out.append(dot.format(LINE_STYLES[0][0], left + 90, 12, DOT_RADIUS_PX))
    out.append(svg_text(left + 100, 16, "measured", "start"))
    out.append(Markup("</g>"))
    return svg(width, round(top + h + 44), title, described, out, narrow=narrow)
