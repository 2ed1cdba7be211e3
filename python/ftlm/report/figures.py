"""Line charts as inline SVG that need no script: for screens wide and narrow, light and dark, for print and by ear."""

from __future__ import annotations

import math
import unicodedata
from dataclasses import dataclass, field
from decimal import Decimal
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup

from ftlm.errors import DataError
from ftlm.frequency import frequency_response, response_deviation, response_inputs, transfer_functions
from ftlm.output_error import NORMAL_95
from ftlm.records import COULOMB
from ftlm.report.tables import number, symbol

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

    from ftlm.identification import Trace
    from ftlm.models import Model
    from ftlm.report.landscape import Landscape
    from ftlm.residuals import Residuals
    from ftlm.validation import Comparison

    Floats = NDArray[np.float64]

__all__ = [
    "BodeCurve",
    "Figure",
    "Ticks",
    "bode_charts",
    "bode_curves",
    "chart_css",
    "comparison_charts",
    "decimate",
    "error_chart",
    "heat_map",
    "line_chart",
    "pulse_times",
    "residual_charts",
    "response_frequencies",
    "ticks",
    "trace_chart",
]

#: Points of one line in the wide chart: two for every pixel column of its plot, so no peak is lost on any screen.
POINTS = 1500
#: Width of the drawing for telephones; its text stays as large as the wide one's.
NARROW = 360
#: Values beyond this are drawn as gaps: differences of two of them leave the range of double precision.
HUGE = 1e300
#: Differences below this are none: denormal numbers have too few digits for an axis.
TINY = 1e-290
#: The axis follows the measured line, and not one that strays from it by more than this many times its height.
STRAY = 3.0
#: Coordinates inside the plot are whole tenths of a pixel.
SUB = 10
#: Width of charts that stand side by side.
SMALL = 520
#: Text at 12 px: width of a letter, height of a line.
LETTER, LINE = 6.7, 15
#: Letters of a label beside its line; the legend above the narrow chart has room for more.
MOST_LETTERS = 22

#: A natural logarithm of a gain in decibels.
DECIBEL = 20.0 / math.log(10.0)

#: (light, dark, dashes). Vermilion, blue, green, purple after Okabe and Ito, darkened to a contrast of 3:1 on white and
#: lightened for the dark; dashes tell lines apart without any colour. The first is the neutral line.
LINES = (
    ("#3d4650", "#7f8b97", ""),
    ("#d1480a", "#ff8f45", ""),
    ("#0a6cb0", "#5ab8f5", "8 3"),
    ("#00855f", "#3fcfa3", "3 3"),
    ("#9b3f83", "#e99ac8", "9 3 2 3"),
    ("#7a6300", "#e6cb4f", "14 4"),
)
NEUTRAL = "measured"
#: From best to worst, after viridis reversed in lightness: dark is good on white, and every step differs in lightness.
HEAT = ("#440154", "#472c7a", "#3b518b", "#2c718e", "#21908d", "#27ad81", "#5cc863", "#aadc32", "#fde725")
NO_SCORE = "#9aa3ad"


@dataclass(frozen=True)
class Figure:
    """A chart of a report; `line_chart` makes them.

    Parameters
    ----------
    title
        What is shown.
    svg
        The drawing, trusted markup.
    narrow
        The same for narrow screens, or empty.
    caption
        What the eye cannot see in the drawing, such as values that are not finite.
    """

    title: str
    svg: Markup
    narrow: Markup = field(default_factory=Markup)
    caption: str = ""

    def _repr_html_(self) -> str:
        return str(
            Markup("<figure>{}<figcaption>{}. {}</figcaption></figure>").format(self.svg, self.title, self.caption)
        )


# ------------------------------------------------------------------------------------------------ ticks and points


@dataclass(frozen=True)
class Ticks:
    """Round numbers on an axis: values, labels, and the power of ten that all labels leave out, as ×10⁻³ and as -3."""

    values: list[float]
    labels: list[str]
    factor: str = ""
    power: int = 0


_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def ticks(low: float, high: float, most: int = 6) -> Ticks:
    """Return multiples of 1, 2 or 5 times a power of ten within an interval.

    Parameters
    ----------
    low, high
        Ends, low < high.
    most
        About as many ticks; at least two come.
    """
    raw = (high - low) / max(most, 1)
    exponent = math.floor(math.log10(raw))
    size = next((s for s in (1, 2, 5) if s * 10.0**exponent >= raw * (1 - 1e-9)), 10)
    if size == 10:
        size, exponent = 1, exponent + 1
    step = size * 10.0**exponent
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    if last - first < 1 and most < 20:
        return ticks(low, high, most + 1)
    # Whole multiples of a power of ten, so that 0.3 is not 0.30000000000000004.
    multiples = [k * size for k in range(first, last + 1)]
    values = [float(m * 10**exponent) if exponent >= 0 else m / 10**-exponent for m in multiples]
    largest = max(abs(v) for v in values)
    shift = 0 if 1e-3 <= largest < 1e5 else 3 * math.floor(math.log10(largest) / 3)
    decimals = max(0, shift - exponent)
    labels = [f"{Decimal(m).scaleb(exponent - shift):.{decimals}f}".replace("-", "−") for m in multiples]
    return Ticks(values, labels, f"×10{str(shift).translate(_SUPERSCRIPTS)}" if shift else "", shift)


def _log_ticks(low: float, high: float, most: int) -> Ticks:
    """Ticks between 10**low and 10**high: powers of ten, or 1-2-5 between them where the powers are few."""
    every = max(1, math.ceil((high - low) / most))
    first, last = math.ceil(low / every - 1e-9), math.floor(high / every + 1e-9)
    powers = [k * every for k in range(first, last + 1)]
    if len(powers) >= 3:
        labels = [f"{10.0**p:g}" if -3 <= p <= 4 else f"10{str(p).translate(_SUPERSCRIPTS)}" for p in powers]
        return Ticks([float(p) for p in powers], labels)
    fine = [(s, p) for p in range(math.floor(low), math.ceil(high) + 1) for s in (1, 2, 5)]
    inside = [(s, p) for s, p in fine if low <= math.log10(s) + p <= high]
    if len(inside) >= 2:
        labels = [f"{s * 10.0**p:g}".replace("-", "−") for s, p in inside]
        return Ticks([math.log10(s) + p for s, p in inside], labels)
    found = ticks(10.0**low, 10.0**high, most)
    kept = [(math.log10(v), label) for v, label in zip(found.values, found.labels, strict=True) if v > 0]
    return Ticks([v for v, _ in kept], [label for _, label in kept], found.factor)


def decimate(y: ArrayLike, most: int = POINTS) -> NDArray[np.intp]:
    """Return indices of the points that draw a line: first, last, and smallest and largest of every stretch.

    Parameters
    ----------
    y
        Values; those that are not finite are left out.
    most
        Most indices, at least 4.

    Returns
    -------
    ndarray of int
        Ascending. All finite values where they are no more than ``most``.
    """
    values = np.asarray(y, dtype=np.float64)
    finite = np.flatnonzero(np.isfinite(values))
    if finite.size <= most:
        return finite
    edges = np.linspace(0, finite.size, max(1, (most - 2) // 2) + 1).astype(np.intp)
    # One pass each for all stretches: sort by (stretch, value), then take the ends of every stretch.
    stretch = np.repeat(np.arange(edges.size - 1), np.diff(edges))
    order = np.lexsort((values[finite], stretch))
    picked = np.concatenate([order[edges[:-1]], order[edges[1:] - 1], [0, finite.size - 1]])
    kept: NDArray[np.intp] = finite[np.unique(picked)]
    return kept


# ------------------------------------------------------------------------------------------------ one chart


@dataclass(frozen=True)
class _Plot:
    """Place of the plot in the drawing [px], and the data at its edges."""

    left: float
    top: float
    width: float
    height: float
    frame: tuple[float, float, float, float]

    def across(self, x: Floats | float) -> Floats:
        low, high, _, _ = self.frame
        return np.asarray(self.left + self.width * (np.asarray(x) - low) / (high - low))

    def down(self, y: Floats | float) -> Floats:
        _, _, low, high = self.frame
        return np.asarray(self.top + self.height * (high - np.asarray(y)) / (high - low))


@dataclass(frozen=True)
class _Words:
    title: str
    described: str
    x_label: str
    y_label: str


@dataclass(frozen=True)
class _Line:
    name: str
    style: int
    x: Floats
    y: Floats  # logarithms on a logarithmic axis; not a number where nothing can be drawn


@dataclass(frozen=True)
class _Shade:
    style: int
    x: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True)
class _How:
    log_x: bool
    log_y: bool
    stems: bool
    shades: tuple[_Shade, ...]


def line_chart(
    x: ArrayLike,
    lines: Sequence[tuple[str, ArrayLike]],
    *,
    title: str,
    x_label: str,
    y_label: str,
    width: int = 720,
    height: int = 260,
    log_x: bool = False,
    log_y: bool = False,
    caption: str = "",
    points: int = POINTS,
    bands: Sequence[tuple[ArrayLike, ArrayLike]] = (),
    stems: bool = False,
) -> Figure:
    """Chart of one or several lines over a common axis.

    Parameters
    ----------
    x
        Shape (N,).
    lines
        (name, values of shape (N,)); a lone line may do without a name. A line whose name begins with "measured" is
        neutral and lies beneath; the others are coloured and dashed in the order given.
    title, x_label, y_label
        Text, with units.
    width, height
        Of the wide drawing, in pixels; it scales.
    log_x, log_y
        Logarithmic axes.
    caption
        Sentence below; what could not be drawn is added to it.
    points
        Most points of a line.
    bands
        (low, high) of a shade behind the first lines, in their order; each of shape (N,).
    stems
        Draw every value as a stem from 0 instead of a line.

    Returns
    -------
    Figure
        With a second drawing for narrow screens.

    Raises
    ------
    DataError
        No line, or a line whose length is not that of x.
    """
    drawn, notes = _checked(x, lines, x_label, log_x, log_y)
    x_low, x_high = _limits([drawn[0].x[np.isfinite(drawn[0].x)]], 0.02 if stems else 0.0)
    if not (log_x or stems):
        x_low, x_high = _snapped(x_low, x_high)
    shades = [_shade(drawn[k], low, high, log_y) for k, (low, high) in enumerate(bands[: len(drawn)])]
    around = [_Line("", 0, b.x, edge) for b in shades for edge in (b.low, b.high)]
    y_low, y_high, strays = _y_limits(drawn if stems or not around else [*drawn, *_unnamed(around)])
    if stems:
        around_zero = [0.0, *(float(np.nanmax(b.high)) for b in shades), *(float(np.nanmin(b.low)) for b in shades)]
        y_low, y_high = min(y_low, *(1.1 * v for v in around_zero)), max(y_high, *(1.1 * v for v in around_zero))
    notes += [f"{name} leaves the axis ({place})." for name, place in _in_words(strays, log_y)]
    about = f"{y_label} against {x_label}" + ("; logarithmic vertical axis" if log_y else "")
    about += "; logarithmic horizontal axis" if log_x else ""
    described = f"Line chart. {about}. " + " ".join(_described(line, log_y) for line in drawn)
    frame = (x_low, x_high, y_low, y_high)
    words = _Words(title, described, x_label, y_label)
    how = _How(log_x, log_y, stems, tuple(shades))
    wide = _drawing(drawn, frame, words, how, size=(width, height), points=points, narrow=False)
    half = max(4, points // 2)
    narrow = _drawing(drawn, frame, words, how, size=(NARROW, 240), points=half, narrow=True)
    return Figure(title, wide, narrow, " ".join(([caption] if caption else []) + notes))


def _shade(line: _Line, low: ArrayLike, high: ArrayLike, log_y: bool) -> _Shade:
    """Edges of a band behind a line; where an edge is not finite there is none."""
    edges = []
    for edge in (low, high):
        values = np.array(edge, dtype=np.float64)
        if values.shape != line.x.shape:
            raise DataError(f"a band of {line.name!r} has shape {values.shape}, x {line.x.shape}; give one length")
        if log_y:
            with np.errstate(divide="ignore", invalid="ignore"):
                values = np.log10(values)
        values[~(np.isfinite(values) & (np.abs(values) < HUGE))] = np.nan
        edges.append(values)
    return _Shade(line.style, line.x, *edges)


def _unnamed(lines: list[_Line]) -> list[_Line]:
    """Lines that widen an axis and are never told to have left it."""
    return [_Line(line.name, 1, line.x, line.y) for line in lines if np.isfinite(line.y).any()]


def _checked(
    x: ArrayLike, lines: Sequence[tuple[str, ArrayLike]], x_label: str, log_x: bool, log_y: bool
) -> tuple[list[_Line], list[str]]:
    """Lines ready to draw, and in words what of them cannot be drawn."""
    if not lines:
        raise DataError("a chart needs at least one line; give (name, values) pairs")
    across = np.array(x, dtype=np.float64)
    if log_x:
        with np.errstate(divide="ignore", invalid="ignore"):
            across = np.where(across > 0, np.log10(np.where(across > 0, across, 1.0)), np.nan)
    drawn, notes, coloured = [], [], 0
    for name, values in lines:
        y = np.array(values, dtype=np.float64)
        if y.ndim != 1 or y.shape != across.shape:
            raise DataError(f"line {name!r} has shape {y.shape}, x {across.shape}; give arrays of one length")
        bad = ~(np.isfinite(y) & np.isfinite(across)) | (np.abs(y) > HUGE)
        if np.any(bad):
            first = across[int(np.argmax(bad))]
            where = f" (first at {x_label} = {first:.4g})" if np.isfinite(first) else ""
            notes.append(f"{name}: {np.sum(bad)} of {y.size} values are not finite{where} and leave a gap.")
        y[bad] = np.nan
        if log_y:
            below = ~bad & (y <= 0)
            if np.any(below):
                notes.append(f"{name}: {np.sum(below)} values of 0 or less have no place on a logarithmic axis.")
            with np.errstate(divide="ignore", invalid="ignore"):
                y = np.where(below, np.nan, np.log10(np.where(below, np.nan, y)))
        neutral = name.startswith(NEUTRAL)
        style = 0 if neutral else 1 + coloured % (len(LINES) - 1)
        coloured += not neutral
        drawn.append(_Line(name, style, across, y))
    return drawn, notes


def _limits(values: list[Floats], margin: float) -> tuple[float, float]:
    """Return ends of an axis that holds these values with a margin, never equal."""
    finite = np.concatenate(values) if values else np.empty(0)
    if finite.size == 0:
        return 0.0, 1.0
    low, high = float(np.min(finite)), float(np.max(finite))
    if high - low <= max(1e-12 * max(abs(low), abs(high)), TINY):
        spread = 0.1 * abs(low) if abs(low) > TINY else 1.0
        return low - spread, high + spread
    return low - margin * (high - low), high + margin * (high - low)


def _snapped(low: float, high: float) -> tuple[float, float]:
    """Move ends to a round number that is near: pulses begin half a step after 0 and end half a step before 10."""
    values = ticks(low - 0.01 * (high - low), high + 0.01 * (high - low), 9).values
    return min(low, values[0]), max(high, values[-1])


def _y_limits(lines: list[_Line]) -> tuple[float, float, list[tuple[str, float]]]:
    """Return ends of the vertical axis, and lines that leave it with their farthest values."""
    every = [line.y[np.isfinite(line.y)] for line in lines]
    low, high = _limits(every, 0.05)
    neutral = [y for y, line in zip(every, lines, strict=True) if line.style == 0 and y.size]
    if not neutral:
        return low, high, []
    # A free run that runs away would flatten what it is to be compared with.
    bottom, top = _limits(neutral, 0.0)
    reach = STRAY * (top - bottom)
    floor, ceiling = bottom - reach, top + reach
    strays = []
    for y, line in zip(every, lines, strict=True):
        if y.size and (np.min(y) < floor or np.max(y) > ceiling):
            middle = (bottom + top) / 2
            strays.append((line.name, float(y[np.argmax(np.abs(y - middle))])))
    return max(low, floor), min(high, ceiling), strays


def _in_words(strays: list[tuple[str, float]], log_y: bool) -> list[tuple[str, str]]:
    return [(name, f"to {number(10.0**far if log_y else far, 3)}") for name, far in strays]


def _described(line: _Line, log_y: bool) -> str:
    finite = line.y[np.isfinite(line.y)]
    if finite.size == 0:
        return f"{line.name}: no value that can be drawn."
    ends = [float(np.min(finite)), float(np.max(finite)), float(finite[-1])]
    low, high, last = (number(10.0**v if log_y else v, 4) for v in ends)
    return f"{line.name or 'Values'}: from {low} to {high}, at the end {last}."


def _text_width(text: str) -> float:
    return LETTER * sum(2 if unicodedata.east_asian_width(c) in "WF" else 1 for c in text)


def _short(name: str, most: int) -> str:
    return name if len(name) <= most else name[: most - 1] + "…"


def _drawing(
    lines: list[_Line],
    frame: tuple[float, float, float, float],
    words: _Words,
    how: _How,
    *,
    size: tuple[int, int],
    points: int,
    narrow: bool,
) -> Markup:
    width, height = size
    x_low, x_high, y_low, y_high = frame
    across = _log_ticks(x_low, x_high, 4 if narrow else 9) if how.log_x else ticks(x_low, x_high, 4 if narrow else 9)
    upward = _log_ticks(y_low, y_high, 6) if how.log_y else ticks(y_low, y_high, 5)
    legend = _legend([line for line in lines if line.name], width) if narrow else []
    left = max(30.0, 10 + max(_text_width(t) for t in upward.labels))
    named = [line for line in lines if line.name]
    side = max((_text_width(_short(line.name, MOST_LETTERS)) for line in named), default=0.0)
    # Beside the lines: a gap, a swatch, the label.
    right = 14.0 if narrow or not named else 34 + side
    top = 26.0 + (LINE * (legend[-1][2] + 1) + 5 if legend else 0)
    bottom = 40.0
    if narrow:
        height += int(top - 26)
    w, h = width - left - right, height - top - bottom
    plot = _Plot(left, top, w, h, frame)

    out = [
        Markup('<svg class="chart {}" role="img" viewBox="0 0 {} {}" width="{}" height="{}"{}>').format(
            "narrow" if narrow else "wide", width, height, width, height, _zoomable(plot, how, across, upward)
        ),
        Markup("<title>{}</title><desc>{}</desc>").format(words.title, words.described),
        Markup('<g class="grid" fill="none" stroke="currentColor" stroke-opacity="0.14">'),
    ]
    out += [Markup('<path d="M{:.1f} {:.1f}h{:.1f}"/>').format(left, float(plot.down(v)), w) for v in upward.values]
    out += [Markup('<path d="M{:.1f} {:.1f}v{:.1f}"/>').format(float(plot.across(v)), top, h) for v in across.values]
    out.append(Markup("</g>"))
    axes = Markup('<path fill="none" stroke="currentColor" stroke-opacity="0.55" d="M{:.1f} {:.1f}v{:.1f}h{:.1f}"/>')
    out.append(axes.format(left, top, h, w))
    # The inner drawing cuts off what leaves the axes and has whole numbers for coordinates.
    out.append(
        Markup(
            '<svg class="plot" preserveAspectRatio="none" x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{:.1f}" '
            'viewBox="0 0 {:.0f} {:.0f}">'
        ).format(left, top, w, h, w * SUB, h * SUB)
    )
    for shade in how.shades:
        d = _outline(shade, plot, points)
        if d:
            out.append(
                Markup('<path class="shade{}" fill="{}" fill-opacity="0.2" d="{}"/>').format(
                    shade.style, LINES[shade.style][0], d
                )
            )
    if how.stems:
        zero = float(plot.down(0.0) - plot.top) * SUB
        out.append(
            Markup('<path fill="none" stroke="currentColor" stroke-opacity="0.55" d="M0 {:.0f}h{:.0f}"/>').format(
                zero, w * SUB
            )
        )
    for line in sorted(lines, key=lambda item: item.style != 0):
        d = _stem_path(line, plot) if how.stems else _path(line, plot, points)
        if d:
            out.append(Markup('<path vector-effect="non-scaling-stroke" {} d="{}"/>').format(_stroke(line.style), d))
    out.append(Markup("</svg>"))

    out.append(Markup('<g font-size="12" fill="currentColor"><g class="ticks">'))
    for v, label in zip(upward.values, upward.labels, strict=True):
        out.append(_text(left - 6, float(plot.down(v)) + 4, label, "end"))
    for v, label in zip(across.values, across.labels, strict=True):
        out.append(_text(float(plot.across(v)), top + h + 16, label, "middle"))
    out.append(Markup("</g>"))
    room = int((width - 8) / LETTER)
    y_text = f"{words.y_label} ({upward.factor})" if upward.factor else words.y_label
    x_text = f"{words.x_label} ({across.factor})" if across.factor else words.x_label
    out.append(_text(4, top - 12, _short(y_text, room), "start"))
    out.append(_text(left + w, top + h + 34, _short(x_text, room), "end"))
    if not any(np.isfinite(line.y).any() for line in lines):
        out.append(_text(left + w / 2, top + h / 2, "no finite value to draw", "middle"))
    if named:
        out += _legend_marks(legend, named) if narrow else _end_labels(named, plot)
    out.append(Markup("</g></svg>"))
    return Markup("").join(out)


def _zoomable(plot: _Plot, how: _How, across: Ticks, upward: Ticks) -> Markup:
    """What the page's script needs to zoom: data at the edges, place of the plot, powers of ten left out of labels."""
    if how.log_x or how.log_y or how.stems:
        return Markup("")
    frame = " ".join(repr(float(v)) for v in plot.frame)
    place = f"{plot.left:.1f} {plot.top:.1f} {plot.width:.1f} {plot.height:.1f}"
    return Markup(' data-frame="{}" data-plot="{}" data-powers="{} {}"').format(
        frame, place, across.power, upward.power
    )


def _outline(shade: _Shade, plot: _Plot, points: int) -> str:
    """Closed path around a band where both its edges are finite."""
    good = np.flatnonzero(np.isfinite(shade.low) & np.isfinite(shade.high) & np.isfinite(shade.x))
    if good.size < 2:
        return ""
    good = good[:: max(1, good.size // points)]
    xs = np.rint((plot.across(shade.x[good]) - plot.left) * SUB).astype(np.int64)
    edges = [np.clip(plot.down(e[good]) - plot.top, -plot.height, 2 * plot.height) for e in (shade.high, shade.low)]
    top, bottom = (np.rint(e * SUB).astype(np.int64) for e in edges)
    there = [f"{x} {y}" for x, y in zip(xs.tolist(), top.tolist(), strict=True)]
    back = [f"{x} {y}" for x, y in zip(xs[::-1].tolist(), bottom[::-1].tolist(), strict=True)]
    return "M" + "L".join([*there, *back]) + "Z"


def _stem_path(line: _Line, plot: _Plot) -> str:
    kept = np.flatnonzero(np.isfinite(line.y) & np.isfinite(line.x))
    xs = np.rint((plot.across(line.x[kept]) - plot.left) * SUB).astype(np.int64)
    ys = np.rint((plot.down(line.y[kept]) - plot.top) * SUB).astype(np.int64)
    zero = round(float(plot.down(0.0) - plot.top) * SUB)
    return "".join(f"M{x} {zero}V{y}" for x, y in zip(xs.tolist(), ys.tolist(), strict=True))


def _stroke(style: int) -> Markup:
    light, _, dashes = LINES[style]
    # The measured line is wide enough to show on both sides of one that follows it exactly.
    thickness = 3.4 if style == 0 else 1.5
    dashed = dashes
    dash = Markup(' stroke-dasharray="{}"').format(dashed) if dashed else Markup("")
    # The page's style sheet replaces the colour in the dark; the attribute serves wherever there is no page.
    return Markup(
        'class="line{}" fill="none" stroke="{}" stroke-width="{:g}" stroke-linejoin="round" stroke-linecap="{}"{}'
    ).format(style, light, thickness, "butt" if dashed else "round", dash)


def _text(x: float, y: float, text: str, anchor: str) -> Markup:
    return Markup('<text x="{:.1f}" y="{:.1f}" text-anchor="{}">{}</text>').format(x, y, anchor, text)


def _path(line: _Line, plot: _Plot, points: int) -> str:
    """Path data in whole tenths of a pixel, each point relative to the one before, a new start after every gap."""
    kept = decimate(line.y, points)
    if kept.size == 0:
        return ""
    # Far outside, a point's place no longer matters; the bound keeps the numbers short.
    y = np.clip(plot.down(line.y[kept]) - plot.top, -plot.height, 2 * plot.height)
    xs = np.rint((plot.across(line.x[kept]) - plot.left) * SUB).astype(np.int64)
    ys = np.rint(y * SUB).astype(np.int64)
    missing = np.cumsum(~np.isfinite(line.y))[kept]
    parts: list[str] = []
    for i in range(kept.size):
        if i == 0 or missing[i] != missing[i - 1]:
            # A line of no length: a lone point between gaps still shows, as a dot.
            parts.append(f"M{xs[i]} {ys[i]}h0")
        else:
            parts.append(f"l{xs[i] - xs[i - 1]} {ys[i] - ys[i - 1]}")
    return "".join(parts).replace(" -", "-")


def _end_labels(lines: list[_Line], plot: _Plot) -> list[Markup]:
    """Swatch and name beside the end of every line, moved apart where lines end together."""
    x, top, bottom = plot.left + plot.width, plot.top, plot.top + plot.height
    ends = []
    for line in lines:
        finite = line.y[np.isfinite(line.y)]
        ends.append(float(np.clip(plot.down(finite[-1]), top, bottom)) if finite.size else (top + bottom) / 2)
    # Lines that end together keep the order in which they were given.
    order = sorted(range(len(lines)), key=lambda i: (round(ends[i] / LINE), i))
    places = [ends[i] for i in order]
    for k in range(1, len(places)):
        places[k] = max(places[k], places[k - 1] + LINE)
    if places[-1] > bottom:
        places[-1] = bottom
        for k in range(len(places) - 2, -1, -1):
            places[k] = min(places[k], places[k + 1] - LINE)
    out = []
    for i, y in zip(order, places, strict=True):
        out.append(Markup('<path {} d="M{:.1f} {:.1f}h16"/>').format(_stroke(lines[i].style), x + 8, y))
        out.append(_text(x + 28, y + 4, _short(lines[i].name, MOST_LETTERS), "start"))
    return out


def _legend(lines: list[_Line], width: int) -> list[tuple[int, float, int]]:
    """Place of every entry above a narrow chart: (line, x, row)."""
    entries, x, row = [], 4.0, 0
    for i, line in enumerate(lines):
        needed = 26 + _text_width(_short(line.name, 2 * MOST_LETTERS)) + 14
        if x > 4 and x + needed > width:
            x, row = 4.0, row + 1
        entries.append((i, x, row))
        x += needed
    return entries


def _legend_marks(entries: list[tuple[int, float, int]], lines: list[_Line]) -> list[Markup]:
    out = []
    for i, x, row in entries:
        y = 8.0 + LINE * row
        out.append(Markup('<path {} d="M{:.1f} {:.1f}h20"/>').format(_stroke(lines[i].style), x, y))
        out.append(_text(x + 26, y + 4, _short(lines[i].name, 2 * MOST_LETTERS), "start"))
    return out


def chart_css() -> Markup:
    """Return the rules that give the lines their colours by the page's variables, light and dark."""
    light = "".join(f"--line{i}:{c};" for i, (c, _, _) in enumerate(LINES))
    dark = "".join(f"--line{i}:{c};" for i, (_, c, _) in enumerate(LINES))
    rules = "".join(f".line{i}{{stroke:var(--line{i})}}.shade{i}{{fill:var(--line{i})}}" for i in range(len(LINES)))
    return Markup(
        f":root{{{light}}}@media screen and (prefers-color-scheme:dark){{:root{{{dark}}}}}{rules}"  # our constants
    )


# ------------------------------------------------------------------------------------------------ results as charts


def pulse_times(comparison: Comparison, run: int = 0) -> Floats:
    """Return the middle of every block pulse of a run of a comparison [s], at which its means are drawn."""
    return np.asarray((np.arange(comparison.m) + 0.5) * comparison.step[run], dtype=np.float64)


def comparison_charts(
    comparison: Comparison, *, units: Mapping[str, str] | None = None, label: str = "", points: int = POINTS
) -> list[Figure]:
    """Measured and simulated output, a chart for every output of every run.

    Parameters
    ----------
    comparison
        From :func:`ftlm.compare` or an identification.
    units
        Units of the outputs.
    label
        What the data were to the model, such as "estimation".
    points
        Most points of a line.
    """
    figures = []
    for k, (run, _, output_error) in enumerate(comparison.per_run):
        for name, figures_of in output_error.items():
            figures.append(
                line_chart(
                    pulse_times(comparison, k),
                    [("measured", comparison.measured[name][k]), ("simulated", comparison.simulated[name][k])],
                    title=f"{symbol(name)}, {f'{label}: ' if label else ''}{run}",
                    x_label="time [s]",
                    y_label=_with_unit(symbol(name), units, name),
                    caption=f"Free run: fit {number(figures_of.fit)}\u00a0%, NR {number(figures_of.nr)}.",
                    points=points,
                )
            )
    return figures


def error_chart(
    compared: Sequence[tuple[str, Comparison]],
    output: str,
    *,
    run: int = 0,
    title: str = "",
    units: Mapping[str, str] | None = None,
    points: int = POINTS,
) -> Figure:
    """Absolute error of the free runs of several models on one run, as in the paper's Figure 4(a).

    Parameters
    ----------
    compared
        (name of the model, its comparison); all on the same run with the same m.
    output
        Whose error.
    run
        Index of the run in the comparisons.
    title
        Default: says what is shown.
    units
        Units of the outputs.
    points
        Most points of a line.
    """
    if not compared:
        raise DataError("an error chart needs at least one comparison; give (name, comparison) pairs")
    errors = [(name, np.abs(c.measured[output][run] - c.simulated[output][run])) for name, c in compared]
    return line_chart(
        pulse_times(compared[0][1], run),
        errors,
        title=title or f"{symbol(output)}: absolute error of the free run",
        x_label="time [s]",
        y_label=_with_unit("|error|", units, output),
        points=points,
    )


def trace_chart(traces: Sequence[tuple[str, Trace]], *, title: str, log_x: bool = False) -> Figure:
    """Error (45) of the free run after every step of the recursion (44), as in the paper's Figure 4(b).

    Parameters
    ----------
    traces
        (name, trace), such as ("p = 7", …), of one equation and with the same steps.
    title
        What is shown.
    log_x
        Whether the axis of steps is logarithmic, which widens the first ones.

    Raises
    ------
    DataError
        No trace, or traces whose steps differ.
    """
    if not traces:
        raise DataError("a convergence chart needs at least one trace; give (name, trace) pairs")
    steps = traces[0][1].step
    for name, trace in traces:
        if not np.array_equal(trace.step, steps):
            raise DataError(f"trace {name!r} is given at other steps than {traces[0][0]!r}; use the same every=")
    return line_chart(
        steps, [(name, trace.error) for name, trace in traces], title=title, x_label="step of the recursion",
        y_label="error (45) of the free run", log_x=log_x, log_y=True,
    )  # fmt: skip


def _with_unit(text: str, units: Mapping[str, str] | None, name: str) -> str:
    unit = (units or {}).get(name, "")
    return f"{text} [{unit}]" if unit else text


# ------------------------------------------------------------------------------------------------ residuals, frequency


def residual_charts(tests: Residuals, *, label: str = "") -> list[Figure]:
    """Autocorrelation and cross-correlations of the residuals of every output, with their 99 % bands.

    Parameters
    ----------
    tests
        From :func:`ftlm.resid`.
    label
        What the data were to the model, such as "validation".
    """
    figures = []
    suffix = f", {label}" if label else ""
    for output, found in tests.outputs.items():
        drawn = [("itself", found.whiteness), *found.inputs.items()]
        for name, test in drawn:
            own = name == "itself"
            # Lag 0 of an autocorrelation is 1 and says nothing.
            keep = test.lags != 0 if own else np.ones(test.lags.size, dtype=bool)
            lags, values = test.lags[keep].astype(np.float64), test.values[keep]
            band = np.full(lags.size, test.band)
            words = "could be white noise" if own else f"could be independent of earlier {symbol(name)}"
            words = words if test.passed else words.replace("could", "cannot")
            other = "itself" if own else symbol(name)
            figures.append(
                line_chart(
                    lags, [("", values)], stems=True, width=SMALL, height=190, bands=[(-band, band)],
                    title=f"Residual of {symbol(output)} with {other}{suffix}",
                    x_label="lag [samples]", y_label="correlation",
                    caption=f"Shade: 99 % band. The residual {words} (99 %).",
                )
            )  # fmt: skip
    return figures


def response_frequencies(model: Model, step: float | None = None, duration: float | None = None) -> Floats:
    """Frequencies at which a model is worth looking at: from one period in a record to half the sampling rate."""
    if step is not None and duration is not None:
        return np.geomspace(2 * math.pi / duration, math.pi / step, 240)
    corner = []
    for pairs in transfer_functions(model).denominator.values():
        (top, high), (bottom, low) = pairs[0], pairs[-1]
        corner.append(abs(bottom / top) ** (1 / (high - low)) if high > low else 1.0)
    middle = float(np.exp(np.mean(np.log(corner))))
    return np.geomspace(middle / 100, middle * 100, 240)


def bode_charts(model: Model, w: ArrayLike | None = None) -> list[Figure]:
    """Gain and phase of every output from every input that is not modelled, with 95 % bands where they are known.

    Parameters
    ----------
    model
        The model.
    w
        Frequencies [rad/s]; by default around the model's own.
    """
    omega = response_frequencies(model) if w is None else np.asarray(w, dtype=np.float64)
    curves = bode_curves(model, omega)
    figures = []
    for curve in curves:
        title = f"{symbol(curve.output)} from {symbol(curve.input)}"
        shade = "Shade: 95 % band, from the covariance of the fit." if curve.gain_spread is not None else ""
        for kind, values, spread, label in (
            ("gain", curve.gain, curve.gain_spread, "gain [dB]"),
            ("phase", curve.phase, curve.phase_spread, "phase [degrees]"),
        ):
            bands = [] if spread is None else [(values - spread, values + spread)]
            figures.append(
                line_chart(
                    omega, [("", values)], log_x=True, bands=bands, title=f"{title}: {kind}", width=SMALL, height=220,
                    x_label="frequency [rad/s]", y_label=label, caption=shade,
                )
            )  # fmt: skip
    return figures


@dataclass(frozen=True)
class BodeCurve:
    """Gain [dB] and phase [degrees] of one output from one input, and half-widths of their 95 % bands or None."""

    output: str
    input: str
    gain: Floats
    phase: Floats
    gain_spread: Floats | None
    phase_spread: Floats | None


def bode_curves(model: Model, omega: Floats) -> list[BodeCurve]:
    """Curves of all pairs in which the input reaches the output; Coulomb terms are not linear and have none."""
    response = frequency_response(model, omega)
    spread = None
    if model.estimate is not None and model.estimate.covariance is not None:
        spread = response_deviation(model, omega)
    inputs = response_inputs(model, coupled=True)
    found = []
    for i, output in enumerate(model.outputs):
        for j, name in enumerate(inputs):
            h = response[i, j]
            if not np.any(h) or name.startswith(COULOMB):
                continue
            with np.errstate(divide="ignore", invalid="ignore"):
                gain = 20 * np.log10(np.abs(h))
            phase = np.degrees(np.unwrap(np.angle(np.where(np.isfinite(h), h, 1.0))))
            widths: tuple[Floats | None, Floats | None] = (None, None)
            if spread is not None:
                widths = (DECIBEL * NORMAL_95 * spread[0][i, j], np.degrees(NORMAL_95 * spread[1][i, j]))
            found.append(BodeCurve(output, name, gain, phase, *widths))
    return found


# ------------------------------------------------------------------------------------------------ order landscape


def heat_map(landscape: Landscape, *, title: str = "") -> Figure:
    """Scores of an order lattice over two of its orders, best dark.

    Parameters
    ----------
    landscape
        From :func:`ftlm.report.landscape`.
    title
        Default: says what is shown.
    """
    across, upward = landscape.names
    heading = title or f"Score over {symbol(across)} and {symbol(upward)}"
    good = landscape.scores[np.isfinite(landscape.scores) & (landscape.scores > 0)]
    if good.size == 0:
        raise DataError("no candidate of this lattice has a finite score; widen it")
    low, high = float(good.min()), float(good.max())
    best = np.unravel_index(int(np.argmin(np.where(np.isfinite(landscape.scores), landscape.scores, np.inf))),
                            landscape.scores.shape)  # fmt: skip
    at = f"{symbol(across)} = {landscape.x[best[1]]:g}, {symbol(upward)} = {landscape.y[best[0]]:g}"
    described = f"Heat map of {landscape.score}. Best {number(low)} at {at}; worst {number(high)}."
    left_out = int(np.sum(~np.isfinite(landscape.scores)))
    caption = f"Best: {at} (ring). Dark is good; colours are steps of the logarithm. {landscape.others}"
    if landscape.score != "score":
        caption += f" Score: {landscape.score}."
    if left_out:
        caption += f" Grey: {left_out} pairs that are no candidate or whose free run diverges."
    drawings = [
        _heat_drawing(landscape, (low, high), (int(best[0]), int(best[1])), heading, described, narrow=n)
        for n in (False, True)
    ]
    return Figure(heading, drawings[0], drawings[1], caption)


def _heat_drawing(
    landscape: Landscape, ends: tuple[float, float], best: tuple[int, int], title: str, described: str, *, narrow: bool
) -> Markup:
    width = NARROW if narrow else SMALL
    rows, columns = landscape.scores.shape
    marks = [[f"{v:g}" for v in axis] for axis in (landscape.x, landscape.y)]
    longest = [max(map(len, each)) for each in marks]
    left, top, bottom = max(46.0, LETTER * longest[1] + 12), 26.0, 84.0
    w = width - left - max(14.0, LETTER * longest[0] / 2)
    cell_w = w / columns
    h = min(max(rows * 6.0, 140.0), 300.0)
    cell_h = h / rows
    height = top + h + bottom
    low, high = (math.log(v) for v in ends)
    with np.errstate(divide="ignore", invalid="ignore"):
        place = (np.log(landscape.scores) - low) / (high - low if high > low else 1.0)
    classes = np.where(np.isfinite(place), np.clip(np.nan_to_num(place * len(HEAT)), 0, len(HEAT) - 1), -1).astype(int)
    out = [
        Markup('<svg class="chart {}" role="img" viewBox="0 0 {} {:.0f}" width="{}" height="{:.0f}">').format(
            "narrow" if narrow else "wide", width, height, width, height
        ),
        Markup("<title>{}</title><desc>{}</desc>").format(title, described),
    ]
    for i in range(rows):
        y = top + h - (i + 1) * cell_h
        j = 0
        while j < columns:
            # Cells alike in a row are one rectangle.
            end = j + 1
            while end < columns and classes[i, end] == classes[i, j]:
                end += 1
            colour = HEAT[classes[i, j]] if classes[i, j] >= 0 else NO_SCORE
            out.append(
                Markup('<rect x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{:.1f}" fill="{}"/>').format(
                    left + j * cell_w, y, (end - j) * cell_w + 0.3, cell_h + 0.3, colour
                )
            )
            j = end
    centre = (left + (best[1] + 0.5) * cell_w, top + h - (best[0] + 0.5) * cell_h)
    for radius, colour, thickness in ((7, "#fff", 4), (7, "#d1480a", 2)):
        out.append(
            Markup('<circle cx="{:.1f}" cy="{:.1f}" r="{}" fill="none" stroke="{}" stroke-width="{}"/>').format(
                *centre, radius, colour, thickness
            )
        )
    out.append(Markup('<g font-size="12" fill="currentColor">'))
    across, upward = landscape.names
    fit = max(2, min(columns, 5 if narrow else 9, int(w / (LETTER * longest[0] + 14))))
    for k in np.unique(np.linspace(0, columns - 1, fit).round().astype(int)).tolist():
        out.append(_text(left + (k + 0.5) * cell_w, top + h + 16, marks[0][k], "middle"))
    for k in np.unique(np.linspace(0, rows - 1, min(rows, 7)).round().astype(int)).tolist():
        out.append(_text(left - 6, top + h - (k + 0.5) * cell_h + 4, marks[1][k], "end"))
    out.append(_text(4, top - 12, f"order {symbol(upward)}", "start"))
    out.append(_text(left + w, top + h + 34, f"order {symbol(across)}", "end"))
    size = 20.0 if narrow else 26.0
    out.append(_text(left, top + h + 76, f"score {number(ends[0], 3)}", "start"))
    out.append(_text(left + size * len(HEAT), top + h + 76, f"{number(ends[1], 3)}", "end"))
    out.append(Markup("</g>"))
    for k, colour in enumerate(HEAT):
        out.append(
            Markup('<rect x="{:.1f}" y="{:.1f}" width="{:.1f}" height="12" fill="{}"/>').format(
                left + k * size, top + h + 48, size + 0.3, colour
            )
        )
    out.append(Markup("</svg>"))
    return Markup("").join(out)
