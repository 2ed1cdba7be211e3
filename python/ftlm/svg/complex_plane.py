"""Complex plane: pole map and Nyquist locus."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike

from ftlm.errors import DataError
from ftlm.svg.figure import (
    NARROW_WIDTH_PX,
    SMALL_WIDTH_PX,
    TEXT_GROUP,
    Figure,
    PlotArea,
    Ticks,
    svg,
    svg_text,
    text_width,
    ticks,
)
from ftlm.svg.line_chart import LINE_STYLES, path_data, stroke_path
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
        raise DataError(f"sector = {sector!r} is not an angle between 0 and pi")
    inside = int(np.sum(np.abs(np.angle(values)) < sector))
    far = float(np.max(np.abs(values), initial=0.0)) or 1.0
    listed = ", ".join(map(_complex_text, values.tolist()))
    described = f"{values.size} points in the plane: {listed or 'none'}. {inside} in the shaded sector."
    wide, small = (
        _draw_plane(values, far, sector, (title, described, x_label, y_label), narrow=narrow)
        for narrow in (False, True)
    )
    return Figure(title, wide, small, caption)


def _draw_plane(
    values: Complex, far: float, sector: float, words: tuple[str, str, str, str], *, narrow: bool
) -> Markup:
    width, reach = NARROW_WIDTH_PX if narrow else SMALL_WIDTH_PX, far * PLANE_MARGIN_FACTOR
    upward = ticks(-reach, reach, 5)
    left = max(30.0, 10 + max(map(text_width, upward.labels)))
    w, h = width - left - 14.0, PLANE_HEIGHT_PX
    # As many pixels a unit in both directions: far fits in the shorter one.
    half_x, half_y = reach * max(w / h, 1.0), reach * max(h / w, 1.0)
    plot = PlotArea(left, 26.0, w, h, (-half_x, half_x, -half_y, half_y))
    # Beyond a right angle the sector also covers what lies above and below its arms' ends.
    edge = 4 * (half_x + half_y)
    arm = edge * complex(math.cos(sector), math.sin(sector))
    outline = [0, arm.conjugate(), edge * (1 - 1j), edge * (1 + 1j), arm]
    shade = Markup('<path class="shade1" fill="{}" fill-opacity="0.16" d="{}"/>')
    curves = [shade.format(LINE_STYLES[1][0], path_data(_places(plot, outline)) + "Z")]
    curves.append(stroke_path(1, _places(plot, [arm.conjugate(), 0, arm]), 1.2, dashes="5 3"))
    c = CROSS_HALF_SIZE_PX
    cross = Markup('<path class="line2" fill="none" stroke="{}" stroke-width="2.2" d="M{:.1f} {:.1f}{}"/>')
    strokes = f"l{2 * c} {2 * c}m0 {-2 * c}l{-2 * c} {2 * c}"
    curves += [cross.format(LINE_STYLES[2][0], x - c, y - c, strokes) for x, y in _places(plot, values)]
    return _draw_axes(plot, (ticks(-half_x, half_x, 4 if narrow else 8), upward), words, width, curves, narrow=narrow)


def _places(plot: PlotArea, values: Sequence[complex] | Complex) -> list[tuple[float, float]]:
    """Points of complex values [px]; far outside of the plot it no longer matters where."""
    found = np.asarray(values, dtype=np.complex128)
    xs, ys = (np.clip(v, -1e4, 1e4).tolist() for v in (plot.x_pixels(found.real), plot.y_pixels(found.imag)))
    return list(zip(xs, ys, strict=True))


def _draw_axes(
    plot: PlotArea,
    axes: tuple[Ticks, Ticks],
    words: tuple[str, str, str, str],
    width: int,
    curves: list[Markup],
    legend: Sequence[Markup] = (),
    *,
    narrow: bool,
) -> Markup:
    """Drawing of a complex plane: grid, the axes through zero, and clipped curves."""
    title, described, x_label, y_label = words
    inner = Markup('<svg x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{:.1f}" viewBox="{:.1f} {:.1f} {:.1f} {:.1f}">')
    box = plot.left, plot.top, plot.width, plot.height
    x, y = _places(plot, [0])[0]
    zero = Markup('<path fill="none" stroke="currentColor" stroke-opacity="0.55" d="{}"/>')
    through = zero.format(f"M{plot.left:.1f} {y:.1f}h{plot.width:.1f}M{x:.1f} {plot.top:.1f}v{plot.height:.1f}")
    out = [*plot.grid(*axes), inner.format(*box, *box), through, *curves, Markup("</svg>"), TEXT_GROUP]
    out += [*plot.labels(axes, (x_label, y_label), width), *legend, Markup("</g>")]
    return svg(width, round(plot.top + plot.height + 44), title, described, out, narrow=narrow)


#: Height of the plot and radius of a dot [px].
LOCUS_HEIGHT_PX, DOT_RADIUS_PX = 240.0, 2.6
#: Margin around the data as a share of their range.
LOCUS_MARGIN_SHARE = 0.06


def locus_chart(curve: ArrayLike, points: ArrayLike, *, title: str, x_label: str, y_label: str) -> Figure:
    """Return a chart of a curve and points in the complex plane.

    Parameters
    ----------
    curve
        Model values, complex, in order of frequency; non-finite values are left out.
    points
        Measured values, complex, finite.
    title, x_label, y_label
        Text, with units.

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
    return Figure(title, wide, small)


def _complex_text(value: complex) -> str:
    return f"{number(value.real, 3)} {'−' if value.imag < 0 else '+'} {number(abs(value.imag), 3)}j"


def _draw_locus(line: Complex, dots: Complex, words: tuple[str, str, str, str], *, narrow: bool) -> Markup:
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

    plot = PlotArea(left, top, w, h, (x0, x0 + w / scale, y0, y0 + h / scale))
    curves = [stroke_path(1, _places(plot, line))] if line.size else []
    dot = Markup('<circle class="line0" fill="none" stroke="{}" stroke-width="1.6" cx="{:.1f}" cy="{:.1f}" r="{}"/>')
    curves += [dot.format(LINE_STYLES[0][0], x, y, DOT_RADIUS_PX) for x, y in _places(plot, dots)]
    legend = [
        stroke_path(1, [(left, 12.0), (left + 20, 12.0)]),
        svg_text(left + 26, 16, "model", "start"),
        dot.format(LINE_STYLES[0][0], left + 90, 12, DOT_RADIUS_PX),
        svg_text(left + 100, 16, "measured", "start"),
    ]
    return _draw_axes(plot, (across, upward), words, width, curves, legend, narrow=narrow)
