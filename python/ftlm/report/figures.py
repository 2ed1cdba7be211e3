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
from ftlm.report.tables import number, symbol

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

    from ftlm.identification import Trace
    from ftlm.validation import Comparison

    Floats = NDArray[np.float64]

__all__ = [
    "Figure",
    "Ticks",
    "chart_css",
    "comparison_charts",
    "decimate",
    "error_chart",
    "line_chart",
    "pulse_times",
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
#: Text at 12 px: width of a letter, height of a line.
LETTER, LINE = 6.7, 15
#: Letters of a label beside its line; the legend above the narrow chart has room for more.
MOST_LETTERS = 22

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
    """Round numbers on an axis: their values, their labels, and the factor that all labels leave out, such as ×10⁻³."""

    values: list[float]
    labels: list[str]
    factor: str = ""


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
    return Ticks(values, labels, f"×10{str(shift).translate(_SUPERSCRIPTS)}" if shift else "")


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


def line_chart(
    x: ArrayLike,
    lines: Sequence[tuple[str, ArrayLike]],
    *,
    title: str,
    x_label: str,
    y_label: str,
    width: int = 720,
    height: int = 260,
    log_y: bool = False,
    caption: str = "",
    points: int = POINTS,
) -> Figure:
    """Chart of one or several lines over a common axis.

    Parameters
    ----------
    x
        Shape (N,).
    lines
        (name, values of shape (N,)). A line whose name begins with "measured" is neutral and lies beneath; the others
        are coloured and dashed in the order given.
    title, x_label, y_label
        Text, with units.
    width, height
        Of the wide drawing, in pixels; it scales.
    log_y
        Logarithmic vertical axis.
    caption
        Sentence below; what could not be drawn is added to it.
    points
        Most points of a line.

    Returns
    -------
    Figure
        With a second drawing for narrow screens.

    Raises
    ------
    DataError
        No line, or a line whose length is not that of x.
    """
    drawn, notes = _checked(x, lines, x_label, log_y)
    x_low, x_high = _snapped(*_limits([drawn[0].x[np.isfinite(drawn[0].x)]], 0.0))
    y_low, y_high, strays = _y_limits(drawn)
    notes += [f"{name} leaves the axis ({place})." for name, place in _in_words(strays, log_y)]
    about = f"{y_label} against {x_label}" + ("; logarithmic vertical axis" if log_y else "")
    described = f"Line chart. {about}. " + " ".join(_described(line, log_y) for line in drawn)
    frame = (x_low, x_high, y_low, y_high)
    words = _Words(title, described, x_label, y_label)
    wide = _drawing(drawn, frame, words, size=(width, height), log_y=log_y, points=points, narrow=False)
    half = max(4, points // 2)
    narrow = _drawing(drawn, frame, words, size=(NARROW, 240), log_y=log_y, points=half, narrow=True)
    return Figure(title, wide, narrow, " ".join(([caption] if caption else []) + notes))


def _checked(
    x: ArrayLike, lines: Sequence[tuple[str, ArrayLike]], x_label: str, log_y: bool
) -> tuple[list[_Line], list[str]]:
    """Lines ready to draw, and in words what of them cannot be drawn."""
    if not lines:
        raise DataError("a chart needs at least one line; give (name, values) pairs")
    across = np.asarray(x, dtype=np.float64)
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
    return f"{line.name}: from {low} to {high}, at the end {last}."


def _text_width(text: str) -> float:
    return LETTER * sum(2 if unicodedata.east_asian_width(c) in "WF" else 1 for c in text)


def _short(name: str, most: int) -> str:
    return name if len(name) <= most else name[: most - 1] + "…"


def _drawing(
    lines: list[_Line],
    frame: tuple[float, float, float, float],
    words: _Words,
    *,
    size: tuple[int, int],
    log_y: bool,
    points: int,
    narrow: bool,
) -> Markup:
    width, height = size
    x_low, x_high, y_low, y_high = frame
    across = ticks(x_low, x_high, 4 if narrow else 9)
    upward = _log_ticks(y_low, y_high, 6) if log_y else ticks(y_low, y_high, 5)
    legend = _legend(lines, width) if narrow else []
    left = max(30.0, 10 + max(_text_width(t) for t in upward.labels))
    side = max(_text_width(_short(line.name, MOST_LETTERS)) for line in lines)
    # Beside the lines: a gap, a swatch, the label.
    right = 14.0 if narrow else 34 + side
    top = 26.0 + (LINE * (legend[-1][2] + 1) + 5 if legend else 0)
    bottom = 40.0
    if narrow:
        height += int(top - 26)
    w, h = width - left - right, height - top - bottom
    plot = _Plot(left, top, w, h, frame)

    out = [
        Markup('<svg class="chart {}" role="img" viewBox="0 0 {} {}" width="{}" height="{}">').format(
            "narrow" if narrow else "wide", width, height, width, height
        ),
        Markup("<title>{}</title><desc>{}</desc>").format(words.title, words.described),
        Markup('<g fill="none" stroke="currentColor" stroke-opacity="0.14">'),
    ]
    out += [Markup('<path d="M{:.1f} {:.1f}h{:.1f}"/>').format(left, float(plot.down(v)), w) for v in upward.values]
    out += [Markup('<path d="M{:.1f} {:.1f}v{:.1f}"/>').format(float(plot.across(v)), top, h) for v in across.values]
    out.append(Markup("</g>"))
    axes = Markup('<path fill="none" stroke="currentColor" stroke-opacity="0.55" d="M{:.1f} {:.1f}v{:.1f}h{:.1f}"/>')
    out.append(axes.format(left, top, h, w))
    # The inner drawing cuts off what leaves the axes and has whole numbers for coordinates.
    out.append(
        Markup('<svg x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{:.1f}" viewBox="0 0 {:.0f} {:.0f}">').format(
            left, top, w, h, w * SUB, h * SUB
        )
    )
    for line in sorted(lines, key=lambda item: item.style != 0):
        d = _path(line, plot, points)
        if d:
            out.append(Markup('<path {} d="{}"/>').format(_stroke(line.style, SUB), d))
    out.append(Markup("</svg>"))

    out.append(Markup('<g font-size="12" fill="currentColor">'))
    for v, label in zip(upward.values, upward.labels, strict=True):
        out.append(_text(left - 6, float(plot.down(v)) + 4, label, "end"))
    for v, label in zip(across.values, across.labels, strict=True):
        out.append(_text(float(plot.across(v)), top + h + 16, label, "middle"))
    room = int((width - 8) / LETTER)
    y_text = f"{words.y_label} ({upward.factor})" if upward.factor else words.y_label
    x_text = f"{words.x_label} ({across.factor})" if across.factor else words.x_label
    out.append(_text(4, top - 12, _short(y_text, room), "start"))
    out.append(_text(left + w, top + h + 34, _short(x_text, room), "end"))
    if not any(np.isfinite(line.y).any() for line in lines):
        out.append(_text(left + w / 2, top + h / 2, "no finite value to draw", "middle"))
    out += _legend_marks(legend, lines) if narrow else _end_labels(lines, plot)
    out.append(Markup("</g></svg>"))
    return Markup("").join(out)


def _stroke(style: int, scale: int = 1) -> Markup:
    light, _, dashes = LINES[style]
    # The measured line is wide enough to show on both sides of one that follows it exactly.
    thickness = (3.4 if style == 0 else 1.5) * scale
    dashed = " ".join(f"{float(d) * scale:g}" for d in dashes.split())
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
    rules = "".join(f".line{i}{{stroke:var(--line{i})}}" for i in range(len(LINES)))
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
    )


def trace_chart(traces: Sequence[tuple[str, Trace]], *, title: str) -> Figure:
    """Error (45) of the free run after every step of the recursion (44), as in the paper's Figure 4(b).

    Parameters
    ----------
    traces
        (name, trace), such as ("p = 7", …), of one equation and with the same steps.
    title
        What is shown.

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
        y_label="error (45) of the free run", log_y=True,
    )  # fmt: skip


def _with_unit(text: str, units: Mapping[str, str] | None, name: str) -> str:
    unit = (units or {}).get(name, "")
    return f"{text} [{unit}]" if unit else text
