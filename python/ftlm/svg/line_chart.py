"""Line charts as SVG, with the data of a slider that shows the values of all lines at one position."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from itertools import cycle
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike

from ftlm.errors import DataError
from ftlm.svg.figure import (
    LINE_HEIGHT_PX,
    MAX_LINE_POINTS,
    MAX_STRAY_HEIGHTS,
    NARROW_WIDTH_PX,
    SMALL_WIDTH_PX,
    TENTHS_PER_PIXEL,
    Figure,
    PlotArea,
    Ticks,
    decimate,
    element,
    faint_path,
    limits,
    log_ticks,
    snap_limits,
    svg,
    svg_text,
    text_group,
    text_width,
    ticks,
)
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import number, truncate_text
from ftlm.utils.validation import Floats, as_floats

#: Approximate maximum number of slider positions; the track of the slider has fewer pixels.
SLIDER_POSITIONS = 750
#: Number of quantization levels over the range of a line, which gives values of five digits.
READOUT_LEVELS = 1e5


def slider_readout(
    x: Floats,
    lines: Sequence[tuple[str, int, Floats]],
    x_label: str,
    y_label: str,
    position_count: int = SLIDER_POSITIONS,
) -> str:
    """Return the values of all lines at the slider positions of a chart, as JSON text for the page script.

    Parameters
    ----------
    x
        Ascending values of the horizontal axis, shape (N,).
    lines
        (name, index in LINE_STYLES, values of shape (N,)) of each line; NaN marks a missing value.
    x_label, y_label
        Axis labels; each may end with a unit in brackets.
    position_count
        Approximate maximum number of positions.

    Returns
    -------
    str
        JSON object with integer values; empty without finite `x` or without lines. Every position is a sample. The
        slider starts at the largest difference between the first two lines.
    """
    finite_rows = np.flatnonzero(np.isfinite(x))
    if not finite_rows.size or not lines:
        return ""
    rows = finite_rows[:: max(1, math.ceil(finite_rows.size / min(position_count, SLIDER_POSITIONS)))]
    start = None
    if len(lines) > 1:
        differences = np.abs(lines[0][2][finite_rows] - lines[1][2][finite_rows])
        if np.isfinite(differences).any():
            start = finite_rows[int(np.nanargmax(differences))]
    rows = np.unique(np.append(rows, [finite_rows[-1], *([] if start is None else [start])]))
    name, unit = _split_unit(x_label)
    data = {
        "name": name,
        "unit": unit,
        "y": _split_unit(y_label)[1],
        "at": _scaled_integers(x[rows]),
        "begin": 0 if start is None else int(np.searchsorted(rows, start)),
        "apart": start is not None,
        "lines": [{"name": n, "style": s, "at": _scaled_integers(y[rows])} for n, s, y in lines],
    }
    return json.dumps(data, separators=(",", ":"), allow_nan=False)


def _split_unit(label: str) -> tuple[str, str]:
    """Split an axis label such as "time [s]" into name and unit; the unit is empty without brackets."""
    name, bracket, unit = label.rpartition(" [")
    return (name, unit[:-1]) if bracket and unit.endswith("]") else (label, "")


def _scaled_integers(values: Floats) -> list[object]:
    """Return [exponent, integers], where values = integers * 10**exponent; an integer is None for a missing value."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return [0, [None] * values.size]
    low, high = float(finite.min()), float(finite.max())
    largest = max(abs(low), abs(high))
    # The integers have at most about twelve digits, which a browser represents exactly.
    resolution = max((high / READOUT_LEVELS - low / READOUT_LEVELS), largest * 1e-12, 1e-290)
    power = math.floor(math.log10(resolution))
    scaled = values / 10.0**power
    return [power, [None if math.isnan(v) else round(v) for v in scaled.tolist()]]


#: Maximum magnitude of a drawn value. Larger values are drawn as gaps, because their differences overflow.
MAX_DRAWN_VALUE = 1e300
#: Minimum space on the left of a plot [px]: that of tick labels of six characters.
MIN_LEFT_MARGIN_PX = 52.0
#: Diameter of a dot [px].
DOT_DIAMETER_PX = 4.6
#: Maximum length of a label beside a line [characters]; the legend of a narrow chart allows twice this length.
MAX_LABEL_CHARACTERS = 22
#: Line styles: (color in light mode, color in dark mode, SVG dash pattern). The colors are those of Okabe and Ito,
#: darkened to a contrast of 3:1 on white and lightened for dark mode. The dash patterns distinguish lines without
#: color. The first style is neutral, for measured values.
LINE_STYLES = (
    ("#3d4650", "#7f8b97", ""),
    ("#d1480a", "#ff8f45", ""),
    ("#0a6cb0", "#5ab8f5", "8 3"),
    ("#00855f", "#3fcfa3", "3 3"),
    ("#9b3f83", "#e99ac8", "9 3 2 3"),
    ("#7a6300", "#e6cb4f", "14 4"),
)
#: Prefixes of the names of lines that are drawn in the neutral style.
NEUTRAL_PREFIXES = ("measured", "simulated arm", "designed")


@dataclass(frozen=True)
class _Line:
    name: str
    style: int
    x: Floats
    y: Floats  # values, or their decimal logarithms on a logarithmic axis; NaN where nothing can be drawn
    dots: bool = False
    band: tuple[Floats, Floats] | None = None


@check_arguments
@dataclass(frozen=True, eq=False)
class LineChart(Figure):
    """Chart of one or more lines over a common horizontal axis.

    Parameters
    ----------
    x
        Values of the horizontal axis, shape (N,).
    lines
        (name, values of shape (N,)) of each line; a single line may have an empty name. A line whose name begins with
        "measured", "simulated arm" or "designed" has the neutral style. The other lines get colors and dashes in
        sequence.
    title, x_label, y_label
        Title, and axis labels with their units.
    caption
        Text shown below the chart. Notes on values that are not drawn are added to it.
    bands
        (lower, upper) edge of a shaded band for the first lines, in the sequence of the lines; each edge has shape
        (N,).
    log_x, log_y
        Whether the axis is logarithmic.
    stems
        Whether every value is drawn as a stem from 0 instead of a line.
    steps
        Whether every value is held until the next one (staircase).
    dots
        Names of lines that are drawn as dots.
    bars
        (edges, heights) of bars that start at 0: shapes (M + 1,) and (M,).
    width, height
        Size [px] of the drawing for wide screens. The page scales the drawing to the available width.
    points
        Maximum number of drawn points of a line.
    slider
        Whether data of a slider that shows sample values are included. It is ignored on logarithmic axes.
    description
        Sentences for screen readers; by default they state the range of every line.

    Raises
    ------
    DataError
        If there is no line, or a line or band has another length than x.
    """

    x: ArrayLike
    lines: Sequence[tuple[str, ArrayLike]]
    _: KW_ONLY
    title: str
    x_label: str
    y_label: str
    caption: str = ""
    bands: Sequence[tuple[ArrayLike, ArrayLike]] = ()
    log_x: bool = False
    log_y: bool = False
    stems: bool = False
    steps: bool = False
    dots: Collection[str] = ()
    bars: tuple[Floats, Floats] | None = None
    width: int = 720
    height: int = 260
    points: int = MAX_LINE_POINTS
    slider: bool = False
    description: str = ""

    def __post_init__(self) -> None:
        _ = self.content

    @cached_property
    def content(self) -> tuple[list[_Line], list[str]]:
        """Lines in axis coordinates, and sentences on values that cannot be drawn.

        Raise DataError without lines, or if a line or band has another length than x.
        """
        if not self.lines:
            raise DataError("a chart needs at least one line; give (name, values) pairs")
        x_values = as_floats("x", self.x, gaps=True).copy()
        lines, notes = [], []
        x = _logarithms(x_values) if self.log_x else x_values
        bands: Iterable[Any] = (*self.bands, *(None for _ in self.lines))
        for (name, values), style, band in zip(self.lines, line_styles(n for n, _ in self.lines), bands, strict=False):
            y = as_floats(f"line {name!r}", values, gaps=True).copy()
            if y.ndim != 1 or y.shape != x.shape:
                raise DataError(f"line {name!r} has shape {y.shape}, x {x.shape}; give arrays of one length")
            is_invalid = ~(np.isfinite(y) & np.isfinite(x)) | (np.abs(y) > MAX_DRAWN_VALUE)
            if np.any(is_invalid) and name not in self.dots:
                first_x = x_values[int(np.argmax(is_invalid))]
                location = f" (first at {self.x_label} = {first_x:.4g})" if np.isfinite(first_x) else ""
                notes.append(
                    f"{name}: {np.sum(is_invalid)} of {y.size} values are not finite{location} and leave a gap."
                )
            y[is_invalid] = np.nan
            if self.log_y:
                is_nonpositive = ~is_invalid & (y <= 0)
                if np.any(is_nonpositive):
                    notes.append(
                        f"{name}: {np.sum(is_nonpositive)} values of 0 or less have no place on a logarithmic axis."
                    )
                y = _logarithms(y)
            edges = None if band is None else (self._edge(name, band[0], x), self._edge(name, band[1], x))
            lines.append(_Line(name, style, *self._corners(x, y), name in self.dots, edges))
        return lines, notes

    def _corners(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return the points to connect by straight lines: those of the line, or two per value of a staircase."""
        return (x.repeat(2)[1:], y.repeat(2)[:-1]) if self.steps else (x, y)

    def _edge(self, name: str, edge: ArrayLike, x: Floats) -> Floats:
        """Return one edge of the band of line `name` in axis coordinates, with NaN at values that cannot be drawn.

        Raise DataError if the edge has another length than x.
        """
        values = as_floats("bands", edge, gaps=True).copy()
        if values.shape != x.shape:
            raise DataError(
                f"a band of {name!r} has shape {values.shape}, x has shape {x.shape}; give arrays of one length"
            )
        values = _logarithms(values) if self.log_y else values
        return self._corners(x, np.where(np.abs(values) < MAX_DRAWN_VALUE, values, np.nan))[1]

    @cached_property
    def frame(self) -> tuple[float, float, float, float]:
        """Axis limits (left, right, bottom, top); decimal logarithms of the limits on logarithmic axes."""
        lines = self.content[0]
        x_low, x_high = limits([lines[0].x[np.isfinite(lines[0].x)]], 0.02 if self.stems else 0.0)
        if self.bars is not None:
            return x_low, x_high, 0.0, 1.05 * max(float(np.max(self.bars[1])), float(np.nanmax(lines[0].y)))
        if not (self.log_x or self.stems):
            x_low, x_high = snap_limits(x_low, x_high)
        y_low, y_high, _ = self._y_limits
        if self.stems:
            edges = [1.1 * v for line in lines if line.band for v in (np.nanmin(line.band[0]), np.nanmax(line.band[1]))]
            y_low, y_high = min(y_low, 0.0, *edges), max(y_high, 0.0, *edges)
        return x_low, x_high, y_low, y_high

    @cached_property
    def _y_limits(self) -> tuple[float, float, list[tuple[str, float]]]:
        """Limits (low, high) of the vertical axis, and (name, extreme value) of each line that exceeds them."""
        lines = self.content[0]
        finite_values = [line.y[np.isfinite(line.y)] for line in lines]
        # Bands extend the axis, and are not reported if they exceed it.
        bands = [] if self.stems else [e[np.isfinite(e)] for line in lines if line.band for e in line.band]
        low, high = limits([*finite_values, *bands], 0.05)
        neutral = [y for y, line in zip(finite_values, lines, strict=True) if line.style == 0 and y.size]
        if not neutral:
            return low, high, []
        # The measured lines limit the axis: with a diverging simulation they would appear flat.
        bottom, top = limits(neutral, 0.0)
        max_distance = MAX_STRAY_HEIGHTS * (top - bottom)
        floor, ceiling = bottom - max_distance, top + max_distance
        exceeding = []
        for y, line in zip(finite_values, lines, strict=True):
            if y.size and (np.min(y) < floor or np.max(y) > ceiling):
                center = (bottom + top) / 2
                exceeding.append((line.name, float(y[np.argmax(np.abs(y - center))])))
        return max(low, floor), min(high, ceiling), exceeding

    @property
    def note(self) -> str:
        """Caption, followed by sentences on values that are not drawn and on lines that exceed the axis."""
        exceeding = [
            f"{name} leaves the axis (to {number(10.0**extreme if self.log_y else extreme, 3)})."
            for name, extreme in self._y_limits[2]
        ]
        return " ".join(part for part in (self.caption, *self.content[1], *exceeding) if part)

    def ticks(self, *, narrow: bool) -> tuple[Ticks, Ticks]:
        """Return the ticks of the horizontal axis and of the vertical axis."""
        x_low, x_high, y_low, y_high = self.frame
        x_ticks = (log_ticks if self.log_x else ticks)(x_low, x_high, 4 if narrow else 9)
        return x_ticks, log_ticks(y_low, y_high, 6) if self.log_y else ticks(y_low, y_high, 5)

    def draw(self, *, narrow: bool) -> Markup:
        """Return the chart as SVG markup, for a wide or a narrow screen."""
        lines = self.content[0]
        width, height = (NARROW_WIDTH_PX, 240) if narrow else (self.width, self.height)
        x_ticks, y_ticks = self.ticks(narrow=narrow)
        named = [line for line in lines if line.name]
        legend = _legend(named, width) if narrow else []
        left = max(MIN_LEFT_MARGIN_PX, 10 + max(map(text_width, y_ticks.labels)))
        # The space on the right of the lines contains a gap, a line sample and the label. Wide charts without labels
        # have the space, too, so that the horizontal axes of charts above one another are aligned.
        names = [truncate_text(line.name, MAX_LABEL_CHARACTERS) for line in named]
        names += ["simulated"] if self.width > SMALL_WIDTH_PX else []
        right = 14.0 if narrow or not names else 34 + max(map(text_width, names))
        top = 26.0 + (LINE_HEIGHT_PX * (legend[-1][2] + 1) + 5 if legend else 0)
        if narrow:
            height += int(top - 26)
        plot = PlotArea(left, top, width - left - right, height - top - 40.0, self.frame)
        texts = plot.labels((x_ticks, y_ticks), (self.x_label, self.y_label), width)
        if not any(np.isfinite(line.y).any() for line in lines):
            center = plot.left + plot.width / 2, plot.top + plot.height / 2
            texts.append(svg_text(*center, "no finite value to draw", "middle"))
        if named:
            texts += _legend_marks(legend) if narrow else _end_labels(named, plot)
        parts = [*plot.grid(x_ticks, y_ticks), self._curves(plot, narrow=narrow), text_group(texts)]
        data = {} if self.log_x or self.log_y or self.stems else _zoomable(plot, x_ticks, y_ticks)
        if self.slider and not (narrow or self.log_x or self.log_y):
            # The slider has fewer positions on a page with many charts, whose lines have fewer points.
            values = [(line.name, line.style, line.y) for line in lines]
            position_count = max(2, self.points // 2)
            data["data_readings"] = slider_readout(lines[0].x, values, self.x_label, self.y_label, position_count)
        description = self.description or self._describe()
        return svg(width, height, self.title, description, parts, narrow=narrow, **data)

    def _describe(self) -> str:
        """Return sentences on the axes and the range of every line, for screen readers."""
        text = f"Line chart. {self.y_label} against {self.x_label}"
        text += "; logarithmic vertical axis" if self.log_y else ""
        text += "; logarithmic horizontal axis. " if self.log_x else ". "
        return text + " ".join(_describe_line(line, self.log_y) for line in self.content[0])

    def _curves(self, plot: PlotArea, *, narrow: bool) -> Markup:
        """Return bars, bands and lines as a nested SVG element that clips them to the plot area."""
        points = max(4, self.points // 2) if narrow else self.points
        out = []
        zero = round(float(plot.y_pixels(0.0) - plot.top) * TENTHS_PER_PIXEL)
        if self.bars is not None:
            edges, heights = self.bars
            xs, ys = plot.tenths(edges, np.append(heights, 0.0))
            shade: dict[str, str] = {"fill": LINE_STYLES[2][0], "fill_opacity": ".55"}
            for x, next_x, y in zip(xs[:-1], xs[1:], ys[:-1], strict=True):
                size = {"width": max(next_x - x - 8, 4), "height": zero - y}
                out.append(element("rect", class_="shade2", x=x, y=y, **size, **shade))
        for line in self.content[0]:
            if d := _outline(line, plot, points):
                shade = {"class_": f"shade{line.style}", "fill": LINE_STYLES[line.style][0], "fill_opacity": "0.2"}
                out.append(element("path", **shade, d=d))
        if self.stems:
            out.append(faint_path(f"M0 {zero}h{plot.width * TENTHS_PER_PIXEL:.0f}"))
        # The neutral line is drawn first, below the other lines.
        for line in sorted(self.content[0], key=lambda item: item.style != 0 or item.dots):
            if d := _stem_path(line, plot) if self.stems else _path(line, plot, points):
                out.append(element("path", vector_effect="non-scaling-stroke", **_stroke(line), d=d))
        box = {"x": plot.left, "y": plot.top, "width": plot.width, "height": plot.height}
        view = f"0 0 {plot.width * TENTHS_PER_PIXEL:.0f} {plot.height * TENTHS_PER_PIXEL:.0f}"
        return element("svg", out, class_="plot", preserveAspectRatio="none", **box, viewBox=view)


def line_styles(names: Iterable[str]) -> list[int]:
    """Return the index in LINE_STYLES for each line name: 0 for a neutral prefix, otherwise 1, 2, … in sequence."""
    other_styles = cycle(range(1, len(LINE_STYLES)))
    return [0 if name.startswith(NEUTRAL_PREFIXES) else next(other_styles) for name in names]


def _logarithms(values: Floats) -> Floats:
    """Return decimal logarithms of values; NaN for values that are not positive."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log10(np.where(values > 0, values, np.nan))


def _describe_line(line: _Line, log_y: bool) -> str:
    finite = line.y[np.isfinite(line.y)]
    if finite.size == 0:
        return f"{line.name}: no value that can be drawn."
    extremes = [float(np.min(finite)), float(np.max(finite)), float(finite[-1])]
    low, high, last = (number(10.0**v if log_y else v, 4) for v in extremes)
    return f"{line.name or 'Values'}: from {low} to {high}, at the end {last}."


def _zoomable(plot: PlotArea, x_ticks: Ticks, y_ticks: Ticks) -> dict[str, str]:
    """Return SVG attributes for the zoom script: axis limits, plot area [px], and powers of ten of the tick labels."""
    frame = " ".join(repr(float(v)) for v in plot.frame)
    plot_box = f"{plot.left:.1f} {plot.top:.1f} {plot.width:.1f} {plot.height:.1f}"
    return {"data_frame": frame, "data_plot": plot_box, "data_powers": f"{x_ticks.power} {y_ticks.power}"}


def _outline(line: _Line, plot: PlotArea, points: int) -> str:
    """Return the SVG path data of a band as one polygon; points with an edge that is not finite are omitted."""
    if line.band is None:
        return ""
    low, high = line.band
    rows = np.flatnonzero(np.isfinite(low) & np.isfinite(high) & np.isfinite(line.x))
    if rows.size < 2:
        return ""
    rows = rows[:: max(1, rows.size // points)]
    xs, top = plot.tenths(line.x[rows], high[rows])
    _, bottom = plot.tenths(line.x[rows], low[rows])
    upper_points = [f"{x} {y}" for x, y in zip(xs, top, strict=True)]
    lower_points = [f"{x} {y}" for x, y in zip(xs[::-1], bottom[::-1], strict=True)]
    return "M" + "L".join([*upper_points, *lower_points]) + "Z"


def _stem_path(line: _Line, plot: PlotArea) -> str:
    rows = np.flatnonzero(np.isfinite(line.y) & np.isfinite(line.x))
    zero = round(float(plot.y_pixels(0.0) - plot.top) * TENTHS_PER_PIXEL)
    return "".join(f"M{x} {zero}V{y}" for x, y in zip(*plot.tenths(line.x[rows], line.y[rows]), strict=True))


def _stroke(line: _Line) -> dict[str, str]:
    """Return the SVG stroke attributes of a line; dots have no dash pattern."""
    light, _, dashes = LINE_STYLES[line.style]
    dashes = "" if line.dots else dashes
    # The measured line is wider, so that it stays visible behind a simulated line that coincides with it.
    thickness = DOT_DIAMETER_PX if line.dots else 3.4 if line.style == 0 else 1.5
    # The style sheet of a page replaces the color in dark mode; the attribute applies without a style sheet.
    stroke = {"class_": f"line{line.style}", "fill": "none", "stroke": light, "stroke_width": f"{thickness:g}"}
    stroke |= {"stroke_linejoin": "round", "stroke_linecap": "butt" if dashes else "round"}
    return stroke | ({"stroke_dasharray": dashes} if dashes else {})


def path_data(points: Iterable[tuple[float, float]]) -> str:
    """Return the SVG path data of the polyline through points (x, y) [px]."""
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points)


def stroke_path(style: int, points: Iterable[tuple[float, float]], width: float = 1.5, dashes: str = "") -> Markup:
    """Return the polyline through points (x, y) [px] as SVG markup, in the color of a line style."""
    stroke = {"class_": f"line{style}", "fill": "none", "stroke": LINE_STYLES[style][0], "stroke_width": f"{width}"}
    dash = {"stroke_dasharray": dashes} if dashes else {}
    return element("path", **stroke, **dash, d=path_data(points))


def _path(line: _Line, plot: PlotArea, points: int) -> str:
    """Return the SVG path data of a line with gaps, in integer tenths of a pixel.

    Each point is relative to the previous one. At most `points` points are drawn.
    """
    rows = decimate(line.y, points)
    if rows.size == 0:
        return ""
    xs, ys = plot.tenths(line.x[rows], line.y[rows])
    starts = np.diff(np.cumsum(~np.isfinite(line.y))[rows], prepend=-1) != 0
    # A line of zero length (h0) shows a single point between two gaps as a dot.
    parts = [
        f"M{x} {y}h0" if start else f"l{x - x_before} {y - y_before}"
        for x, y, x_before, y_before, start in zip(xs, ys, [0, *xs], [0, *ys], starts.tolist(), strict=False)
    ]
    return "".join(parts).replace(" -", "-")


def _line_sample(line: _Line, x: float, y: float, length: int) -> Markup:
    """Return a short sample of a line as SVG markup for its label: `length` [px] from (x, y), or a dot."""
    start, extension = (x + length / 2, 0) if line.dots else (x, length)
    return element("path", **_stroke(line), d=f"M{start:.1f} {y:.1f}h{extension}")


def _end_labels(lines: list[_Line], plot: PlotArea) -> list[Markup]:
    """Return a line sample and a name at the right end of every line as SVG markup.

    Overlapping labels are moved apart.
    """
    x, top, bottom = plot.left + plot.width, plot.top, plot.top + plot.height
    endpoints = []
    for line in lines:
        finite = line.y[np.isfinite(line.y)]
        endpoints.append(float(np.clip(plot.y_pixels(finite[-1]), top, bottom)) if finite.size else (top + bottom) / 2)
    # Lines that end at about the same height keep their sequence.
    order = sorted(range(len(lines)), key=lambda i: (round(endpoints[i] / LINE_HEIGHT_PX), i))
    sorted_endpoints = [endpoints[i] for i in order]
    for k in range(1, len(sorted_endpoints)):
        sorted_endpoints[k] = max(sorted_endpoints[k], sorted_endpoints[k - 1] + LINE_HEIGHT_PX)
    if sorted_endpoints[-1] > bottom:
        sorted_endpoints[-1] = bottom
        for k in range(len(sorted_endpoints) - 2, -1, -1):
            sorted_endpoints[k] = min(sorted_endpoints[k], sorted_endpoints[k + 1] - LINE_HEIGHT_PX)
    labels = []
    for i, y in zip(order, sorted_endpoints, strict=True):
        labels.append(_line_sample(lines[i], x + 8, y, 16))
        labels.append(svg_text(x + 28, y + 4, truncate_text(lines[i].name, MAX_LABEL_CHARACTERS), "start"))
    return labels


def _legend(lines: list[_Line], width: int) -> list[tuple[_Line, float, int]]:
    """Return (line, x position [px], row index) of every legend entry above a narrow chart."""
    entries, x, row = [], 4.0, 0
    for line in lines:
        entry_width = 26 + text_width(truncate_text(line.name, 2 * MAX_LABEL_CHARACTERS)) + 14
        if x > 4 and x + entry_width > width:
            x, row = 4.0, row + 1
        entries.append((line, x, row))
        x += entry_width
    return entries


def _legend_marks(entries: list[tuple[_Line, float, int]]) -> list[Markup]:
    out = []
    for line, x, row in entries:
        y = 8.0 + LINE_HEIGHT_PX * row
        out.append(_line_sample(line, x, y, 20))
        out.append(svg_text(x + 26, y + 4, truncate_text(line.name, 2 * MAX_LABEL_CHARACTERS), "start"))
    return out


def chart_css() -> Markup:
    """Return the CSS rules for the colors of all line styles in light and dark mode."""
    light = "".join(f"--line{i}:{c};" for i, (c, _, _) in enumerate(LINE_STYLES))
    dark = "".join(f"--line{i}:{c};" for i, (_, c, _) in enumerate(LINE_STYLES))
    rules = "".join(
        f".line{i}{{stroke:var(--line{i})}}.shade{i}{{fill:var(--line{i})}}" for i in range(len(LINE_STYLES))
    )
    return Markup(
        f":root{{{light}}}@media screen and (prefers-color-scheme:dark){{:root{{{dark}}}}}{rules}"  # safe: constants
    )
