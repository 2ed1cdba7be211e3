"""Bar charts, charts of the complex plane, heat maps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike, NDArray

from ftlm.errors import DataError
from ftlm.svg.figure import (
    LETTER_WIDTH_PX,
    MIN_DIFFERENCE,
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
from ftlm.utils.formatting import number, symbol, truncate_text
from ftlm.utils.validation import Complex, Floats, as_complex, as_floats

#: Most bars of a histogram, and its height [px].
MAX_BARS = 41
HISTOGRAM_HEIGHT_PX = 190.0
#: Height of one bar of a grouped bar chart [px].
BAR_HEIGHT_PX = 16.0
#: Longest label beside a bar [characters].
MAX_BAR_NAME_CHARACTERS = 26


@check_arguments
def histogram(values: ArrayLike, *, title: str, x_label: str, caption: str = "") -> Figure:
    """Return a histogram with the normal density of the same mean and standard deviation.

    Parameters
    ----------
    values
        Shape (N,); non-finite values are left out and counted in the caption.
    title, x_label
        Text, with units.
    caption
        Sentence below.

    Raises
    ------
    DataError
        Fewer than two finite values.
    """
    every = as_floats("values", values, gaps=True).ravel()
    there = every[np.isfinite(every)]
    if there.size < 2:
        raise DataError(f"a histogram needs two finite values at least, not {there.size}; give a longer run")
    # As many bars as Sturges and the spread of outliers ask for, symmetric about the mean.
    mean, deviation = float(np.mean(there)), float(np.std(there))
    reach = float(np.max(np.abs(there - mean)))
    if reach <= max(1e-12 * abs(mean), MIN_DIFFERENCE):
        reach = 0.1 * abs(mean) if abs(mean) > MIN_DIFFERENCE else 1.0
    bars = min(MAX_BARS, 2 * math.ceil(math.log2(there.size)) + 1)
    edges = mean + np.linspace(-reach, reach, bars + 1)
    counts, _ = np.histogram(there, edges)
    width = edges[1] - edges[0]
    at = np.linspace(edges[0], edges[-1], 121)
    curve = there.size * width * _normal(at, mean, deviation) if deviation > 0 else np.zeros(at.size)
    lost = every.size - there.size
    said = f"{caption} {lost} values are not finite and left out.".strip() if lost else caption
    described = (
        f"Histogram of {there.size} values: mean {number(mean, 3)}, standard deviation {number(deviation, 3)}, from "
        f"{number(float(there.min()), 3)} to {number(float(there.max()), 3)}."
    )
    wide, small = (
        _histogram(edges, counts, at, curve, (title, described, x_label), narrow=narrow) for narrow in (False, True)
    )
    return Figure(title, wide, small, said)


def _normal(x: Floats, mean: float, deviation: float) -> Floats:
    return np.exp(-0.5 * ((x - mean) / deviation) ** 2) / (deviation * math.sqrt(2 * math.pi))


def _histogram(
    edges: Floats, counts: Floats, at: Floats, curve: Floats, words: tuple[str, str, str], *, narrow: bool
) -> Markup:
    title, described, x_label = words
    width = NARROW_WIDTH_PX if narrow else SMALL_WIDTH_PX
    highest = 1.05 * max(float(counts.max()), float(curve.max()))
    upward, across = ticks(0.0, highest, 4), ticks(float(edges[0]), float(edges[-1]), 4 if narrow else 6)
    left = max(30.0, 10 + max(map(text_width, upward.labels)))
    frame = float(edges[0]), float(edges[-1]), 0.0, highest
    plot = PlotArea(left, 26.0, width - left - 14.0, HISTOGRAM_HEIGHT_PX - 66, frame)
    out = plot.grid(across, upward)
    bar = Markup(
        '<rect class="shade2" x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{:.1f}" fill="{}" fill-opacity=".55"/>'
    )
    places, tops = plot.x_pixels(edges).tolist(), plot.y_pixels(counts).tolist()
    for x, right, y in zip(places[:-1], places[1:], tops, strict=True):
        out.append(bar.format(x, y, max(right - x - 0.8, 0.4), plot.top + plot.height - y, LINE_STYLES[2][0]))
    out += [stroke_path(1, zip(plot.x_pixels(at), plot.y_pixels(curve), strict=True)), TEXT_GROUP]
    out += [*plot.labels((across, upward), (x_label, "samples"), width), Markup("</g>")]
    return svg(width, round(HISTOGRAM_HEIGHT_PX), title, described, out, narrow=narrow)


@check_arguments
def bar_chart(
    names: Sequence[str],
    groups: Sequence[tuple[str, ArrayLike]],
    *,
    title: str,
    x_label: str,
    low: float = 0.0,
    high: float | None = None,
    caption: str = "",
    width: int = 720,
) -> Figure:
    """Return a chart of horizontal bars, grouped by name.

    Parameters
    ----------
    names
        Group names, from top to bottom.
    groups
        (series name, one value per group name), at most five.
    title, x_label
        Text, with units.
    low, high
        Axis limits, by default from 0 to the largest value. A bar beyond them is truncated and labeled with its value.
    caption
        Sentence below.
    width
        Width of the wide drawing [px]; it scales.

    Raises
    ------
    DataError
        Nothing to draw, more than five series, or a series without one value per name.
    """
    tables = [(name, as_floats(name, values, gaps=True)) for name, values in groups]
    if not names or not 0 < len(tables) < len(LINE_STYLES):
        raise DataError(
            f"{len(names)} names and {len(tables)} groups of bars; give names, and 1 to {len(LINE_STYLES) - 1} groups"
        )
    for name, values in tables:
        if values.shape != (len(names),):
            raise DataError(
                f"bars of {name!r} have shape {values.shape}, there are {len(names)} names; give one a name"
            )
    finite = np.concatenate([v[np.isfinite(v)] for _, v in tables])
    end = high if high is not None else float(np.max(finite, initial=low))
    end = end if end > low else low + 1.0
    described = f"Bars, {x_label}. " + " ".join(
        f"{thing}: " + ", ".join(f"{group} {number(float(v[k]), 3)}" for group, v in tables) + "."
        for k, thing in enumerate(names)
    )
    words = (title, described, x_label)
    wide, small = (
        _bars(names, tables, (low, end), words, NARROW_WIDTH_PX if n else width, narrow=n) for n in (False, True)
    )
    return Figure(title, wide, small, caption)


def _bars(
    names: Sequence[str],
    tables: Sequence[tuple[str, Floats]],
    ends: tuple[float, float],
    words: tuple[str, str, str],
    width: int,
    *,
    narrow: bool,
) -> Markup:
    title, described, x_label = words
    shown = [truncate_text(n, 16 if narrow else MAX_BAR_NAME_CHARACTERS) for n in names]
    left, value = 10 + max(map(text_width, shown)), 52.0
    top = 8.0 + 18.0 * (len(tables) > 1)
    w, step = width - left - value, BAR_HEIGHT_PX * len(tables) + 8
    low, high = ends
    out = []
    across = ticks(low, high, 4 if narrow else 8)
    h = step * len(names)
    out.append(Markup('<g class="grid" fill="none" stroke="currentColor" stroke-opacity="0.14">'))
    out += [
        Markup('<path d="M{:.1f} {:.1f}v{:.1f}"/>').format(left + w * (v - low) / (high - low), top, h)
        for v in across.values
    ]
    out.append(Markup("</g>"))
    bar = Markup(
        '<rect class="shade{}" x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{:.1f}" fill="{}" fill-opacity="{}"/>'
    )
    texts = []
    for i, name in enumerate(shown):
        texts.append(svg_text(left - 6, top + step * i + BAR_HEIGHT_PX * len(tables) / 2 + 6, name, "end"))
        for k, (_, values) in enumerate(tables):
            v, y = float(values[i]), top + step * i + BAR_HEIGHT_PX * k + 2
            inside = min(max(v, low), high) if math.isfinite(v) else low
            length = w * (inside - low) / (high - low)
            out.append(bar.format(k + 1, left, y, max(length, 0.0), BAR_HEIGHT_PX - 3, LINE_STYLES[k + 1][0], "0.85"))
            text = number(v, 4) if math.isfinite(v) else "–"
            texts.append(svg_text(left + length + 5, y + BAR_HEIGHT_PX - 5, text, "start"))
    axis = Markup('<path fill="none" stroke="currentColor" stroke-opacity="0.55" d="M{:.1f} {:.1f}v{:.1f}"/>')
    out += [axis.format(left, top, h), TEXT_GROUP, *texts]
    place = left
    for k, (name, _) in enumerate(tables if len(tables) > 1 else ()):
        out.append(
            Markup('<rect class="shade{}" x="{:.1f}" y="3" width="14" height="10" fill="{}"/>').format(
                k + 1, place, LINE_STYLES[k + 1][0]
            )
        )
        out.append(svg_text(place + 19, 12, name, "start"))
        place += 19 + text_width(name) + 16
    out += [
        svg_text(left + w * (v - low) / (high - low), top + h + 15, t, "middle")
        for v, t in zip(across.values, across.labels, strict=True)
    ]
    out += [svg_text(left + w, top + h + 32, x_label, "end"), Markup("</g>")]
    return svg(width, round(top + h + 40), title, described, out, narrow=narrow)


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


@dataclass(frozen=True)
class Landscape:
    """Scores over two orders, the other orders fixed at the best model.

    Parameters
    ----------
    names
        The two orders, horizontal and vertical.
    x, y
        Their values, ascending.
    scores
        Shape (y, x); infinite for pairs that are not candidates or whose simulation diverges.
    other_orders_note
        Treatment of the other parameters, as text.
    score
        Name of the score.
    correlation
        Correlation of the two orders in a joint fit, otherwise NaN.
    """

    names: tuple[str, str]
    x: Floats
    y: Floats
    scores: Floats
    other_orders_note: str = "Other orders as in the best model."
    score: str = "score"
    correlation: float = math.nan


#: From best to worst, reversed viridis: dark is good on white, and lightness is monotone.
HEAT_COLORS = ("#440154", "#472c7a", "#3b518b", "#2c718e", "#21908d", "#27ad81", "#5cc863", "#aadc32", "#fde725")
NO_SCORE = "#9aa3ad"


@check_arguments
def heat_map(landscape: Landscape, *, title: str = "") -> Figure:
    """Return a heat map of scores over two orders; the best scores are dark.

    Parameters
    ----------
    landscape
        Scores, such as ``landscape`` returns.
    title
        Title; the default names both orders.
    """
    across, upward = landscape.names
    heading = title or f"Score over {symbol(across)} and {symbol(upward)}"
    finite = np.isfinite(landscape.scores)
    good = landscape.scores[finite & (landscape.scores > 0)]
    if good.size == 0:
        raise DataError("no candidate of this order grid has a finite score; widen it")
    low, high = float(good.min()), float(good.max())
    row, column = divmod(int(np.argmin(np.where(finite, landscape.scores, np.inf))), landscape.scores.shape[1])
    at = f"{symbol(across)} = {landscape.x[column]:g}, {symbol(upward)} = {landscape.y[row]:g}"
    described = f"Heat map of {landscape.score}. Best {number(low)} at {at}; worst {number(high)}."
    left_out = int(np.sum(~finite))
    caption = f"Best: {at} (ring). Dark is good; colours are steps of the logarithm. {landscape.other_orders_note}"
    if landscape.score != "score":
        caption += f" Score: {landscape.score}."
    if left_out:
        caption += f" Grey: {left_out} pairs that are not candidates or whose simulation diverges."
    wide, small = (
        _heat_drawing(landscape, (low, high), (row, column), heading, described, narrow=n) for n in (False, True)
    )
    return Figure(heading, wide, small, caption)


def _classes(scores: Floats, low: float, high: float) -> NDArray[np.intp]:
    """Color class of each score on a logarithmic scale; -1 without a score."""
    first, span = math.log(low), math.log(high) - math.log(low)
    with np.errstate(divide="ignore", invalid="ignore"):
        place = (np.log(scores) - first) / (span if span > 0 else 1.0)
    steps = np.clip(np.nan_to_num(place * len(HEAT_COLORS)), 0, len(HEAT_COLORS) - 1)
    return np.where(np.isfinite(place), steps, -1).astype(np.intp)


def _rectangle(x: float, y: float, width: float, height: str, colour: str) -> Markup:
    """Return a cell, slightly enlarged to hide seams."""
    return Markup('<rect x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{}" fill="{}"/>').format(
        x, y, width + 0.3, height, colour
    )


def _label_indices(count: int, most: int) -> list[int]:
    """Indices of the cells that get a label, first and last included."""
    return sorted({round(k) for k in np.linspace(0, count - 1, most).tolist()})


def _heat_drawing(
    landscape: Landscape, ends: tuple[float, float], best: tuple[int, int], title: str, described: str, *, narrow: bool
) -> Markup:
    width = NARROW_WIDTH_PX if narrow else SMALL_WIDTH_PX
    rows, columns = landscape.scores.shape
    x_marks, y_marks = ([f"{v:g}" for v in axis] for axis in (landscape.x, landscape.y))
    longest = max(map(len, x_marks))
    left, top, below = max(46.0, LETTER_WIDTH_PX * max(map(len, y_marks)) + 12), 26.0, 84.0
    w, h = width - left - max(14.0, LETTER_WIDTH_PX * longest / 2), min(max(rows * 6.0, 140.0), 300.0)
    cell_w, cell_h, bottom = w / columns, h / rows, top + h
    out = []
    for i, row in enumerate(_classes(landscape.scores, *ends).tolist()):
        j = 0
        # Cells alike in a row are one rectangle.
        for step, alike in groupby(row):
            count, colour = len(list(alike)), HEAT_COLORS[step] if step >= 0 else NO_SCORE
            place = left + j * cell_w, bottom - (i + 1) * cell_h
            out.append(_rectangle(*place, count * cell_w, f"{cell_h + 0.3:.1f}", colour))
            j += count
    centre = left + (best[1] + 0.5) * cell_w, bottom - (best[0] + 0.5) * cell_h
    ring = Markup('<circle cx="{:.1f}" cy="{:.1f}" r="7" fill="none" stroke="{}" stroke-width="{}"/>')
    out += [ring.format(*centre, colour, thickness) for colour, thickness in (("#fff", 4), ("#d1480a", 2))]
    out.append(TEXT_GROUP)
    fit = max(2, min(columns, 5 if narrow else 9, int(w / (LETTER_WIDTH_PX * longest + 14))))
    out += [
        svg_text(left + (k + 0.5) * cell_w, bottom + 16, x_marks[k], "middle") for k in _label_indices(columns, fit)
    ]
    for k in _label_indices(rows, min(rows, 7)):
        out.append(svg_text(left - 6, bottom - (k + 0.5) * cell_h + 4, y_marks[k], "end"))
    across, upward = landscape.names
    out.append(svg_text(4, top - 12, f"order {symbol(upward)}", "start"))
    out.append(svg_text(left + w, bottom + 34, f"order {symbol(across)}", "end"))
    size = 20.0 if narrow else 26.0
    out.append(svg_text(left, bottom + 76, f"score {number(ends[0], 3)}", "start"))
    out.append(svg_text(left + size * len(HEAT_COLORS), bottom + 76, number(ends[1], 3), "end"))
    out.append(Markup("</g>"))
    out += [_rectangle(left + k * size, bottom + 48, size, "12", colour) for k, colour in enumerate(HEAT_COLORS)]
    return svg(width, round(bottom + below), title, described, out, narrow=narrow)


#: From -1 to 1, blue over light gray to vermilion; black text is readable in the middle.
CORRELATION_COLORS = ("#1f4e8c", "#4b80bd", "#8fb3d9", "#c8d9ea", "#eceff1", "#f4d5c4", "#e9a27f", "#cf6535", "#9c3009")
#: Indices of colors that need white text.
DARK_COLOR_INDICES = {0, 1, 7, 8}
NO_VALUE = "#9aa3ad"
#: Largest cell, and smallest cell with a number [px].
MAX_CELL_PX, MIN_LABELED_CELL_PX = 46.0, 30.0
MAX_COLUMN_NAME_CHARACTERS = 12


@check_arguments
def correlation_map(names: Sequence[str], values: ArrayLike, *, title: str, caption: str = "") -> Figure:
    """Return a correlation matrix as colored cells.

    Parameters
    ----------
    names
        Names of the rows and columns.
    values
        Shape (N, N), from -1 to 1; NaN has a gray cell.
    title
        Title.
    caption
        Sentence below.

    Raises
    ------
    DataError
        A matrix that is not square or does not fit the names, or values beyond 1.
    """
    matrix = as_floats("values", values, gaps=True)
    if matrix.shape != (len(names), len(names)) or not len(names):
        raise DataError(f"a matrix of shape {matrix.shape} for {len(names)} names; give one row and column a name")
    beyond = np.abs(matrix) > 1 + 1e-6
    if np.any(beyond):
        row, column = divmod(int(np.argmax(beyond)), len(names))
        raise DataError(f"the correlation of {names[row]} and {names[column]} is {matrix[row, column]}, beyond 1")
    off = np.where(np.eye(len(names), dtype=bool) | ~np.isfinite(matrix), 0.0, matrix)
    at = np.unravel_index(int(np.argmax(np.abs(off))), off.shape)
    farthest = f"{names[int(at[0])]} and {names[int(at[1])]} {number(float(off[at]), 3)}"
    described = f"Correlations of {', '.join(names)}. The largest: {farthest}."
    wide, small = (_draw_matrix(names, matrix, title, described, narrow=narrow) for narrow in (False, True))
    return Figure(title, wide, small, caption)


def _draw_matrix(names: Sequence[str], matrix: Floats, title: str, described: str, *, narrow: bool) -> Markup:
    width, count = (NARROW_WIDTH_PX if narrow else SMALL_WIDTH_PX), len(names)
    labels = [truncate_text(symbol(n), MAX_COLUMN_NAME_CHARACTERS) for n in names]
    left = 10 + max(map(text_width, labels))
    cell = min((width - left - 8) / count, MAX_CELL_PX)
    # Names above the columns stand upright where they have no room.
    turned = max(map(text_width, labels)) > cell - 4
    top = 8 + (max(map(text_width, labels)) if turned else 16)
    out, texts = [], []
    box = Markup('<rect x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{:.1f}" fill="{}"/>')
    for i in range(count):
        for j in range(count):
            value = float(matrix[i, j])
            known = np.isfinite(value)
            step = (
                int(np.clip(round((value + 1) / 2 * (len(CORRELATION_COLORS) - 1)), 0, len(CORRELATION_COLORS) - 1))
                if known
                else -1
            )
            x, y = left + j * cell, top + i * cell
            out.append(box.format(x, y, cell - 1, cell - 1, CORRELATION_COLORS[step] if known else NO_VALUE))
            if cell >= MIN_LABELED_CELL_PX and i != j:
                ink = "#fff" if step in DARK_COLOR_INDICES or not known else "#15181c"
                text = f"{value:.2f}".replace("0.", ".").replace("-", "−") if known else "–"
                texts.append(
                    Markup(
                        '<text x="{:.1f}" y="{:.1f}" text-anchor="middle" fill="{}" font-size="11">{}</text>'
                    ).format(x + cell / 2 - 0.5, y + cell / 2 + 4, ink, text)
                )
    out.append(TEXT_GROUP)
    for k, label in enumerate(labels):
        out.append(svg_text(left - 6, top + (k + 0.5) * cell + 4, label, "end"))
        x = left + (k + 0.5) * cell
        if turned:
            out.append(
                Markup('<text x="0" y="0" transform="translate({:.1f} {:.1f}) rotate(-90)">{}</text>').format(
                    x + 4, top - 6, label
                )
            )
        else:
            out.append(svg_text(x, top - 6, label, "middle"))
    foot = top + count * cell + 12
    size = 18.0 if narrow else 22.0
    out += [box.format(left + k * size, foot, size, 10, colour) for k, colour in enumerate(CORRELATION_COLORS)]
    out.append(svg_text(left, foot + 24, "−1", "start"))
    out.append(svg_text(left + size * len(CORRELATION_COLORS) / 2, foot + 24, "0", "middle"))
    out.append(svg_text(left + size * len(CORRELATION_COLORS), foot + 24, "1", "end"))
    return svg(width, round(foot + 32), title, described, [*out, *texts, Markup("</g>")], narrow=narrow)
