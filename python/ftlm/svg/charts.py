"""Charts as SVG: histogram, bar chart, complex plane, and heat maps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
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
    Figure,
    PlotArea,
    element,
    faint_path,
    svg,
    svg_text,
    text_group,
    text_width,
    ticks,
)
from ftlm.svg.line_chart import LINE_STYLES, LineChart, path_data, stroke_path
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import number, symbol, truncate_text
from ftlm.utils.validation import Complex, Floats, as_complex, as_floats

#: Maximum number of bars of a histogram, and height of its chart [px].
MAX_BARS = 41
HISTOGRAM_HEIGHT_PX = 190
#: Height of one bar of a grouped bar chart [px].
BAR_HEIGHT_PX = 16.0
#: Maximum length of the name beside a bar [characters]; longer names are truncated.
MAX_BAR_NAME_CHARACTERS = 26


@check_arguments
def histogram(values: ArrayLike, *, title: str, x_label: str, caption: str = "") -> LineChart:
    """Return a histogram chart of values, with the normal density of equal mean and standard deviation as a line.

    Parameters
    ----------
    values
        Values of shape (N,). Nonfinite values are omitted, and the caption states their number.
    title, x_label
        Title, and label of the horizontal axis with its unit.
    caption
        Text shown below the chart.

    Raises
    ------
    DataError
        If there are fewer than two finite values.
    """
    finite_values = as_floats("values", values, gaps=True).ravel()
    finite = finite_values[np.isfinite(finite_values)]
    if finite.size < 2:
        raise DataError(f"a histogram needs two finite values at least, not {finite.size}; give a longer run")
    # Twice the number of bars of Sturges' rule. The range is symmetric about the mean and includes all outliers.
    mean, deviation = float(np.mean(finite)), float(np.std(finite))
    half_range = float(np.max(np.abs(finite - mean)))
    if half_range <= max(1e-12 * abs(mean), MIN_DIFFERENCE):
        half_range = 0.1 * abs(mean) if abs(mean) > MIN_DIFFERENCE else 1.0
    bars = min(MAX_BARS, 2 * math.ceil(math.log2(finite.size)) + 1)
    edges = mean + np.linspace(-half_range, half_range, bars + 1)
    counts, _ = np.histogram(finite, edges)
    width = edges[1] - edges[0]
    x = np.linspace(edges[0], edges[-1], 121)
    curve = finite.size * width * _normal(x, mean, deviation) if deviation > 0 else np.zeros(x.size)
    nonfinite_count = finite_values.size - finite.size
    text = f"{caption} {nonfinite_count} values are not finite and left out.".strip() if nonfinite_count else caption
    description = (
        f"Histogram of {finite.size} values: mean {number(mean, 3)}, standard deviation {number(deviation, 3)}, from "
        f"{number(float(finite.min()), 3)} to {number(float(finite.max()), 3)}."
    )
    return LineChart(
        x,
        [("", curve)],
        title=title,
        x_label=x_label,
        y_label="samples",
        caption=text,
        bars=(edges, counts.astype(np.float64)),
        width=SMALL_WIDTH_PX,
        height=HISTOGRAM_HEIGHT_PX,
        description=description,
    )


def _normal(x: Floats, mean: float, deviation: float) -> Floats:
    return np.exp(-0.5 * ((x - mean) / deviation) ** 2) / (deviation * math.sqrt(2 * math.pi))


@check_arguments
@dataclass(frozen=True, eq=False)
class BarChart(Figure):
    """Chart of horizontal bars: one group of bars for each name, one bar of the group for each series.

    Parameters
    ----------
    names
        Names of the groups, from top to bottom.
    groups
        (name, values) of each series, at most five; ``values`` has one value for each of `names`.
    title, x_label
        Title, and label of the value axis with its unit.
    low, high
        Limits of the value axis, by default 0 and the largest value. Bars are truncated at the limits, and every bar is
        labeled with its value.
    caption
        Text shown below the chart.
    width
        Width [px] of the drawing for wide screens. The page scales the drawing to the available width.

    Raises
    ------
    DataError
        If there is nothing to draw, there are more than five series, or a series does not have one value per name.
    """

    names: Sequence[str]
    groups: Sequence[tuple[str, ArrayLike]]
    _: KW_ONLY
    title: str
    x_label: str
    low: float = 0.0
    high: float | None = None
    caption: str = ""
    width: int = 720

    def __post_init__(self) -> None:
        count = len(self.names)
        if not self.names or not 0 < len(self.groups) < len(LINE_STYLES):
            raise DataError(
                f"{count} names and {len(self.groups)} groups of bars; give names, and 1 to {len(LINE_STYLES) - 1} "
                "groups"
            )
        for name, values in self.tables:
            if values.shape != (count,):
                raise DataError(
                    f"bars of {name!r} have shape {values.shape}, expected {(count,)}; give one value for each name"
                )

    @cached_property
    def tables(self) -> list[tuple[str, Floats]]:
        """(name, array of values) of each series."""
        return [(name, as_floats(name, values, gaps=True)) for name, values in self.groups]

    @property
    def axis_limits(self) -> tuple[float, float]:
        """Lower and upper limit of the value axis."""
        finite = np.concatenate([v[np.isfinite(v)] for _, v in self.tables])
        upper = self.high if self.high is not None else float(np.max(finite, initial=self.low))
        return self.low, upper if upper > self.low else self.low + 1.0

    def draw(self, *, narrow: bool) -> Markup:
        """Return the chart as SVG markup, for a wide or a narrow screen."""
        tables, names, width = self.tables, self.names, NARROW_WIDTH_PX if narrow else self.width
        description = f"Bars, {self.x_label}. " + " ".join(
            f"{name}: " + ", ".join(f"{group} {number(float(v[k]), 3)}" for group, v in tables) + "."
            for k, name in enumerate(names)
        )
        shortened_names = [truncate_text(n, 16 if narrow else MAX_BAR_NAME_CHARACTERS) for n in names]
        left, value = 10 + max(map(text_width, shortened_names)), 52.0
        top = 8.0 + 18.0 * (len(tables) > 1)
        w, step = width - left - value, BAR_HEIGHT_PX * len(tables) + 8
        low, high = self.axis_limits
        x_ticks = ticks(low, high, 4 if narrow else 8)
        plot = PlotArea(left, top, w, step * len(names), (low, high, 0.0, 1.0))
        grid, axis = plot.grid(x_ticks, None)
        bars, texts = [], []
        for i, name in enumerate(shortened_names):
            texts.append(svg_text(left - 6, top + step * i + BAR_HEIGHT_PX * len(tables) / 2 + 6, name, "end"))
            for k, (_, values) in enumerate(tables):
                v, y = float(values[i]), top + step * i + BAR_HEIGHT_PX * k + 2
                clipped = min(max(v, low), high) if math.isfinite(v) else low
                length = w * (clipped - low) / (high - low)
                bars.append(_shade(k + 1, left, y, max(length, 0.0), BAR_HEIGHT_PX - 3, fill_opacity="0.85"))
                text = number(v, 4) if math.isfinite(v) else "–"
                texts.append(svg_text(left + length + 5, y + BAR_HEIGHT_PX - 5, text, "start"))
        x_value = left
        for k, (name, _) in enumerate(tables if len(tables) > 1 else ()):
            texts += [_shade(k + 1, x_value, 3, 14, 10), svg_text(x_value + 19, 12, name, "start")]
            x_value += 19 + text_width(name) + 16
        bottom = top + plot.height
        pairs = zip(x_ticks.values, x_ticks.labels, strict=True)
        texts += [svg_text(float(plot.x_pixels(v)), bottom + 15, label, "middle") for v, label in pairs]
        texts.append(svg_text(left + w, bottom + 32, self.x_label, "end"))
        parts = [grid, *bars, axis, text_group(texts)]
        return svg(width, round(bottom + 40), self.title, description, parts, narrow=narrow)


def _shade(style: int, x: float, y: float, width: float, height: float, **attributes: str) -> Markup:
    """Return a filled rectangle with upper left corner (x, y) [px] as SVG markup, in the color of a line style."""
    geometry = {"x": x, "y": y, "width": width, "height": height}
    return element("rect", class_=f"shade{style}", **geometry, fill=LINE_STYLES[style][0], **attributes)


#: Maximum height of the complex plane, half the width of a cross, and radius of a dot [px].
PLANE_HEIGHT_PX, CROSS_HALF_SIZE_PX, DOT_RADIUS_PX = 260.0, 5.0, 2.6
#: Axis limit of a pole map divided by the largest magnitude of a pole. Margin around the dots of a locus, as a fraction
#: of their range.
PLANE_MARGIN_FACTOR, LOCUS_MARGIN_FRACTION = 1.18, 0.06


@check_arguments
@dataclass(frozen=True, eq=False)
class PlaneChart(Figure):
    """Chart of the complex plane with equal axis scales: a pole map, or a measured locus with the curve of a model.

    Parameters
    ----------
    points
        Finite complex values. Poles include both members of each conjugate pair and are drawn as crosses.
    title, x_label, y_label
        Title, and axis labels with their units.
    sector
        Half-angle [rad] of the shaded unstable sector around the positive real axis.
    curve
        Complex values of a model's curve. If it is given, the points are measured values and are drawn as dots. The
        dots determine the axis limits, and no sector is drawn.
    caption
        Text shown below the chart.

    Raises
    ------
    DataError
        If a point is not finite, the sector is outside (0, pi), or there is a curve without points.
    """

    points: Sequence[complex] | Complex
    _: KW_ONLY
    title: str
    x_label: str
    y_label: str
    sector: float = math.pi / 2
    curve: ArrayLike | None = None
    caption: str = ""

    def __post_init__(self) -> None:
        is_invalid = ~np.isfinite(self.values)
        if np.any(is_invalid):
            raise DataError(f"point {int(np.argmax(is_invalid))} of {is_invalid.size} is not finite; leave it out")
        if not 0 < self.sector < math.pi:
            raise DataError(f"sector = {self.sector!r} is not an angle; give one between 0 and pi")
        if self.curve is not None and not is_invalid.size:
            raise DataError("there is no measured value to draw; give at least one")

    @cached_property
    def values(self) -> Complex:
        """Points as a complex array."""
        return as_complex("points", self.points)

    @cached_property
    def line(self) -> Complex | None:
        """Finite values of the curve; None without a curve."""
        line = None if self.curve is None else as_complex("curve", self.curve)
        return None if line is None else line[np.isfinite(line)]

    @property
    def plot_corners(self) -> tuple[complex, complex]:
        """Lower left and upper right corner of the plotted region, which may cut off parts of the curve."""
        if self.line is None:
            largest = float(np.max(np.abs(self.values), initial=0.0)) or 1.0
            return complex(-largest, -largest) * PLANE_MARGIN_FACTOR, complex(largest, largest) * PLANE_MARGIN_FACTOR
        real, imag = self.values.real, self.values.imag
        low, high = complex(real.min(), imag.min()), complex(real.max(), imag.max())
        pad = LOCUS_MARGIN_FRACTION * (max(high.real - low.real, high.imag - low.imag) or abs(high) or 1.0)
        return low - complex(pad, pad), high + complex(pad, pad)

    def sector_outline(self, half_range: float) -> list[complex]:
        """Return the corners of the shaded sector, which extends beyond the square of half-width `half_range`."""
        edge = 8 * half_range
        arm = edge * complex(math.cos(self.sector), math.sin(self.sector))
        # The two corners on the right keep the outline outside the visible square for every half-angle.
        return [0, arm.conjugate(), edge * (1 - 1j), edge * (1 + 1j), arm]

    def draw(self, *, narrow: bool) -> Markup:
        """Return the chart as SVG markup: grid, axes through zero, points and clipped curves."""
        width = NARROW_WIDTH_PX if narrow else SMALL_WIDTH_PX
        low, high = self.plot_corners
        y_ticks = ticks(low.imag, high.imag, 5)
        left, top = max(30.0, 10 + max(map(text_width, y_ticks.labels))), 26.0 if self.line is None else 48.0
        w, extent = width - left - 14.0, high - low
        # Equal scale [px per unit] on both axes.
        scale = min(w / extent.real, PLANE_HEIGHT_PX / extent.imag)
        h = max(scale * extent.imag, 90.0)
        corner = (low + high) / 2 - complex(w, h) / scale / 2
        frame = corner.real, corner.real + w / scale, corner.imag, corner.imag + h / scale
        x_ticks, y_ticks = ticks(*frame[:2], 4 if narrow else 8), ticks(*frame[2:], max(2, round(h / 48)))
        plot = PlotArea(left, top, w, h, frame)
        box = {"x": plot.left, "y": plot.top, "width": plot.width, "height": plot.height}
        view = " ".join(f"{v:.1f}" for v in box.values())
        x, y = _pixel_coordinates(plot, [0])[0]
        zero_axes = faint_path(f"M{plot.left:.1f} {y:.1f}h{plot.width:.1f}M{x:.1f} {plot.top:.1f}v{plot.height:.1f}")
        curves = self._crosses(plot) if self.line is None else self._locus(plot, self.line)
        texts = plot.labels((x_ticks, y_ticks), (self.x_label, self.y_label), width)
        if self.line is not None:
            texts += [stroke_path(1, [(left, 12.0), (left + 20, 12.0)]), svg_text(left + 26, 16, "model", "start")]
            texts += [_dot(left + 90, 12.0), svg_text(left + 100, 16, "measured", "start")]
        clipped_group = element("svg", [zero_axes, *curves], **box, viewBox=view)
        parts = [*plot.grid(x_ticks, y_ticks), clipped_group, text_group(texts)]
        return svg(width, round(top + h + 44), self.title, self._describe(), parts, narrow=narrow)

    def _describe(self) -> str:
        values = self.values
        if self.line is not None:
            range_text = f"from {_complex_text(values[0])} to {_complex_text(values[-1])}"
            return f"Locus in the complex plane. {values.size} measured points {range_text}, and the model's curve."
        unstable_count = int(np.sum(np.abs(np.angle(values)) < self.sector))
        poles_text = ", ".join(map(_complex_text, values.tolist()))
        return f"{values.size} points in the plane: {poles_text or 'none'}. {unstable_count} in the shaded sector."

    def _crosses(self, plot: PlotArea) -> list[Markup]:
        outline = self.sector_outline((plot.frame[1] + plot.frame[3]) / 2)
        sector = path_data(_pixel_coordinates(plot, outline)) + "Z"
        curves = [element("path", class_="shade1", fill=LINE_STYLES[1][0], fill_opacity="0.16", d=sector)]
        curves.append(stroke_path(1, _pixel_coordinates(plot, [outline[1], 0, outline[-1]]), 1.2, dashes="5 3"))
        c = CROSS_HALF_SIZE_PX
        strokes = f"l{2 * c} {2 * c}m0 {-2 * c}l{-2 * c} {2 * c}"
        crosses = (f"M{x - c:.1f} {y - c:.1f}{strokes}" for x, y in _pixel_coordinates(plot, self.values))
        stroke = {"class_": "line2", "fill": "none", "stroke": LINE_STYLES[2][0], "stroke_width": "2.2"}
        return curves + [element("path", **stroke, d=data) for data in crosses]

    def _locus(self, plot: PlotArea, line: Complex) -> list[Markup]:
        curves = [stroke_path(1, _pixel_coordinates(plot, line))] if line.size else []
        return curves + [_dot(x, y) for x, y in _pixel_coordinates(plot, self.values)]


def _dot(x: float, y: float) -> Markup:
    """Return the dot of a measured point at pixel coordinates (x, y) as SVG markup."""
    stroke = {"class_": "line0", "fill": "none", "stroke": LINE_STYLES[0][0], "stroke_width": "1.6"}
    return element("circle", **stroke, cx=x, cy=y, r=DOT_RADIUS_PX)


def _pixel_coordinates(plot: PlotArea, values: Sequence[complex] | Complex) -> list[tuple[float, float]]:
    """Return the (x, y) pixel coordinates of complex values, limited to [-10000, 10000]."""
    points = np.asarray(values, dtype=np.complex128)
    xs, ys = (np.clip(v, -1e4, 1e4).tolist() for v in (plot.x_pixels(points.real), plot.y_pixels(points.imag)))
    return list(zip(xs, ys, strict=True))


def _complex_text(value: complex) -> str:
    return f"{number(value.real, 3)} {'−' if value.imag < 0 else '+'} {number(abs(value.imag), 3)}j"


#: Colors from the best (lowest) score to the worst, from the color map viridis. The best scores are dark, which is well
#: visible on white, and lightness is monotone.
HEAT_COLORS = ("#440154", "#472c7a", "#3b518b", "#2c718e", "#21908d", "#27ad81", "#5cc863", "#aadc32", "#fde725")
#: Color of a cell without a value.
NO_VALUE = "#9aa3ad"


@dataclass(frozen=True, eq=False)
class Landscape(Figure):
    """Heat map of scores over two orders, in which the best scores are dark.

    The other orders are fixed at their values in the best model.

    Parameters
    ----------
    names
        Names of the orders on the horizontal and the vertical axis.
    x, y
        Ascending values of these orders.
    scores
        Scores of shape (len(y), len(x)). A score is infinite if the pair is not a candidate or its simulation diverges.
    other_orders_note
        Text that states the values of the orders that are not on the axes.
    score
        Name of the score for captions.
    correlation
        Correlation of the estimates of the two orders in a joint fit; NaN without one.
    """

    names: tuple[str, str]
    x: Floats
    y: Floats
    scores: Floats
    other_orders_note: str = "Other orders as in the best model."
    score: str = "score"
    correlation: float = math.nan

    @property
    def title(self) -> str:  # type: ignore[override]
        """Title of the chart, with the names of both orders."""
        x_name, y_name = map(symbol, self.names)
        return f"Score over {x_name} and {y_name}"

    @cached_property
    def valid_scores(self) -> Floats:
        """Scores, with NaN for pairs without a positive finite score; raise DataError if no pair has one."""
        scores = np.where(np.isfinite(self.scores) & (self.scores > 0), self.scores, np.nan)
        if np.all(np.isnan(scores)):
            raise DataError("no candidate of this order grid has a finite score; widen the order grid")
        return scores

    @property
    def best(self) -> tuple[int, int]:
        """Row index and column index of the best (lowest) score."""
        row, column = divmod(int(np.nanargmin(self.valid_scores)), self.scores.shape[1])
        return row, column

    def _best_orders(self) -> str:
        row, column = self.best
        x_name, y_name = map(symbol, self.names)
        return f"{x_name} = {self.x[column]:g}, {y_name} = {self.y[row]:g}"

    @property
    def caption(self) -> str:  # type: ignore[override]
        """Sentences on the orders of the best score and on the meaning of the colors."""
        parts = [
            f"Best: {self._best_orders()} (ring). Dark is good; colors are steps of the logarithm.",
            self.other_orders_note,
        ]
        if self.score != "score":
            parts.append(f"Score: {self.score}.")
        if omitted_count := int(np.sum(~np.isfinite(self.scores))):
            parts.append(f"Grey: {omitted_count} pairs that are not candidates or whose simulation diverges.")
        return " ".join(parts)

    def draw(self, *, narrow: bool) -> Markup:
        """Return the chart as SVG markup, for a wide or a narrow screen."""
        score_range = float(np.nanmin(self.valid_scores)), float(np.nanmax(self.valid_scores))
        best_score, worst_score = map(number, score_range)
        description = f"Heat map of {self.score}. Best {best_score} at {self._best_orders()}; worst {worst_score}."
        best_indices = self.best
        width = NARROW_WIDTH_PX if narrow else SMALL_WIDTH_PX
        rows, columns = self.scores.shape
        x_labels, y_labels = ([f"{v:g}" for v in axis] for axis in (self.x, self.y))
        longest = max(map(len, x_labels))
        left, top, bottom_margin = max(46.0, LETTER_WIDTH_PX * max(map(len, y_labels)) + 12), 26.0, 84.0
        w, h = width - left - max(14.0, LETTER_WIDTH_PX * longest / 2), min(max(rows * 6.0, 140.0), 300.0)
        cell_w, cell_h, bottom = w / columns, h / rows, top + h
        out = []
        for i, row in enumerate(_color_indices(self.scores, *score_range).tolist()):
            j = 0
            # Adjacent cells of a row with equal color are drawn as one rectangle.
            for step, equal_cells in groupby(row):
                count, color = len(list(equal_cells)), HEAT_COLORS[step] if step >= 0 else NO_VALUE
                corner = left + j * cell_w, bottom - (i + 1) * cell_h
                out.append(_rectangle(*corner, count * cell_w, f"{cell_h + 0.3:.1f}", color))
                j += count
        marker_center = left + (best_indices[1] + 0.5) * cell_w, bottom - (best_indices[0] + 0.5) * cell_h
        for color, thickness in (("#fff", 4), ("#d1480a", 2)):
            x, y = marker_center
            out.append(element("circle", cx=x, cy=y, r=7, fill="none", stroke=color, stroke_width=thickness))
        fit = max(2, min(columns, 5 if narrow else 9, int(w / (LETTER_WIDTH_PX * longest + 14))))
        x_name, y_name = self.names
        size = 20.0 if narrow else 26.0
        column_labels, row_labels = _label_indices(columns, fit), _label_indices(rows, min(rows, 7))
        texts = [
            *(svg_text(left + (k + 0.5) * cell_w, bottom + 16, x_labels[k], "middle") for k in column_labels),
            *(svg_text(left - 6, bottom - (k + 0.5) * cell_h + 4, y_labels[k], "end") for k in row_labels),
            svg_text(4, top - 12, f"order {symbol(y_name)}", "start"),
            svg_text(left + w, bottom + 34, f"order {symbol(x_name)}", "end"),
            svg_text(left, bottom + 76, f"score {number(score_range[0], 3)}", "start"),
            svg_text(left + size * len(HEAT_COLORS), bottom + 76, number(score_range[1], 3), "end"),
        ]
        out.append(text_group(texts))
        out += [_rectangle(left + k * size, bottom + 48, size, "12", color) for k, color in enumerate(HEAT_COLORS)]
        return svg(width, round(bottom + bottom_margin), self.title, description, out, narrow=narrow)


def _color_indices(scores: Floats, low: float, high: float) -> NDArray[np.intp]:
    """Return the index into HEAT_COLORS of each score, on a logarithmic scale; -1 for pairs without a score."""
    log_low, span = math.log(low), math.log(high) - math.log(low)
    with np.errstate(divide="ignore", invalid="ignore"):
        position = (np.log(scores) - log_low) / (span if span > 0 else 1.0)
    indices = np.clip(np.nan_to_num(position * len(HEAT_COLORS)), 0, len(HEAT_COLORS) - 1)
    return np.where(np.isfinite(position), indices, -1).astype(np.intp)


def _rectangle(x: float, y: float, width: float, height: str, color: str) -> Markup:
    """Return a heat-map cell as SVG markup, slightly enlarged to hide gaps."""
    return element("rect", x=x, y=y, width=width + 0.3, height=height, fill=color)


def _label_indices(count: int, max_count: int) -> list[int]:
    """Return at most `max_count` equally spaced indices from 0 to count - 1. Cells with these indices get a label."""
    return list(range(0, count, max(1, math.ceil((count - 1) / max(max_count - 1, 1)))))


#: Colors from correlation -1 to 1: blue, light gray, vermilion. Black text is readable on the colors in the middle.
CORRELATION_COLORS = ("#1f4e8c", "#4b80bd", "#8fb3d9", "#c8d9ea", "#eceff1", "#f4d5c4", "#e9a27f", "#cf6535", "#9c3009")
#: Indices of the colors on which text is white.
DARK_COLOR_INDICES = {0, 1, 7, 8}
#: Maximum width of a cell, and minimum width of a cell that shows its correlation as a number [px].
MAX_CELL_PX, MIN_LABELED_CELL_PX = 46.0, 30.0
MAX_COLUMN_NAME_CHARACTERS = 12


@check_arguments
@dataclass(frozen=True, eq=False)
class CorrelationMap(Figure):
    """Chart of a correlation matrix with colored cells.

    Parameters
    ----------
    names
        Names of the N parameters, for rows and columns.
    values
        Correlations of shape (N, N), from -1 to 1. NaN gives a gray cell.
    title
        Title of the chart.
    caption
        Text shown below the chart.

    Raises
    ------
    DataError
        If the matrix is not square or does not match the names, or a magnitude exceeds 1.
    """

    names: Sequence[str]
    values: ArrayLike
    _: KW_ONLY
    title: str
    caption: str = ""

    def __post_init__(self) -> None:
        matrix, names = self.matrix, self.names
        if matrix.shape != (len(names), len(names)) or not len(names):
            raise DataError(
                f"values has shape {matrix.shape}, but there are {len(names)} names; give one row and one "
                "column per name"
            )
        is_outside = np.abs(matrix) > 1 + 1e-6
        if np.any(is_outside):
            row, column = divmod(int(np.argmax(is_outside)), len(names))
            raise DataError(
                f"the correlation of {names[row]} and {names[column]} is {matrix[row, column]}, outside [-1, 1]; "
                "give a correlation matrix, not a covariance"
            )

    @cached_property
    def matrix(self) -> Floats:
        """Correlation matrix as an array."""
        return as_floats("values", self.values, gaps=True)

    def _describe(self) -> str:
        names, matrix = self.names, self.matrix
        off_diagonal = np.where(np.eye(len(names), dtype=bool) | ~np.isfinite(matrix), 0.0, matrix)
        index = np.unravel_index(int(np.argmax(np.abs(off_diagonal))), off_diagonal.shape)
        largest = f"{names[int(index[0])]} and {names[int(index[1])]} {number(float(off_diagonal[index]), 3)}"
        return f"Correlations of {', '.join(names)}. The largest: {largest}."

    def draw(self, *, narrow: bool) -> Markup:
        """Return the chart as SVG markup, for a wide or a narrow screen."""
        names, matrix = self.names, self.matrix
        width, count = (NARROW_WIDTH_PX if narrow else SMALL_WIDTH_PX), len(names)
        labels = [truncate_text(symbol(n), MAX_COLUMN_NAME_CHARACTERS) for n in names]
        left = 10 + max(map(text_width, labels))
        cell = min((width - left - 8) / count, MAX_CELL_PX)
        # Column names that are wider than a cell are rotated by 90 degrees.
        rotated = max(map(text_width, labels)) > cell - 4
        top = 8 + (max(map(text_width, labels)) if rotated else 16)
        out, texts = [], []
        for i in range(count):
            for j in range(count):
                value = float(matrix[i, j])
                is_known = np.isfinite(value)
                step = (
                    int(np.clip(round((value + 1) / 2 * (len(CORRELATION_COLORS) - 1)), 0, len(CORRELATION_COLORS) - 1))
                    if is_known
                    else -1
                )
                x, y = left + j * cell, top + i * cell
                color = CORRELATION_COLORS[step] if is_known else NO_VALUE
                out.append(element("rect", x=x, y=y, width=cell - 1, height=cell - 1, fill=color))
                if cell >= MIN_LABELED_CELL_PX and i != j:
                    text_color = "#fff" if step in DARK_COLOR_INDICES or not is_known else "#15181c"
                    text = f"{value:.2f}".replace("0.", ".").replace("-", "−") if is_known else "–"
                    center = x + cell / 2 - 0.5, y + cell / 2 + 4
                    texts.append(svg_text(*center, text, "middle", fill=text_color, font_size="11"))
        markup = []
        for k, label in enumerate(labels):
            markup.append(svg_text(left - 6, top + (k + 0.5) * cell + 4, label, "end"))
            x = left + (k + 0.5) * cell
            rotation = f"translate({x + 4:.1f} {top - 6:.1f}) rotate(-90)"
            label_text = element("text", [label], x=0, y=0, transform=rotation)
            markup.append(label_text if rotated else svg_text(x, top - 6, label, "middle"))
        legend_top = top + count * cell + 12
        size = 18.0 if narrow else 22.0
        for k, color in enumerate(CORRELATION_COLORS):
            markup.append(element("rect", x=left + k * size, y=legend_top, width=size, height=10.0, fill=color))
        for fraction, text, anchor in ((0.0, "−1", "start"), (0.5, "0", "middle"), (1.0, "1", "end")):
            markup.append(svg_text(left + fraction * size * len(CORRELATION_COLORS), legend_top + 24, text, anchor))
        parts = [*out, text_group([*markup, *texts])]
        return svg(width, round(legend_top + 32), self.title, self._describe(), parts, narrow=narrow)
