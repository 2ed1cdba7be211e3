"""Base classes of charts, and elements of SVG drawings: text, axes and ticks."""

from __future__ import annotations

import math
import unicodedata
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Decimal
from functools import cached_property

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike, NDArray

from ftlm.utils.formatting import SUPERSCRIPT_DIGITS, split_exponents, truncate_text, typeset
from ftlm.utils.validation import Floats, as_floats

#: Width of the drawing for narrow screens, in which text has the same size as in the wide drawing.
NARROW_WIDTH_PX = 360
#: Width of charts that are placed side by side.
SMALL_WIDTH_PX = 520
#: Approximate width of a character and height of a line of text with a font size of 12 px [px].
LETTER_WIDTH_PX, LINE_HEIGHT_PX = 6.7, 15


class Figure(ABC):
    """Base class of charts that can be drawn as SVG; :mod:`ftlm.plot` draws most of them with matplotlib.

    Attributes
    ----------
    title, caption
        Title of the chart, and text shown below it.
    """

    title: str
    caption: str

    @abstractmethod
    def draw(self, *, narrow: bool) -> Markup:
        """Return the chart as SVG markup, for a wide or a narrow screen."""

    @cached_property
    def svg(self) -> Markup:
        """SVG markup for wide screens."""
        return self.draw(narrow=False)

    @cached_property
    def narrow(self) -> Markup:
        """SVG markup for narrow screens; empty if the drawing for wide screens is sufficient."""
        return self.draw(narrow=True)

    @property
    def note(self) -> str:
        """Caption, followed by notes on values that the chart cannot show, such as nonfinite ones."""
        return self.caption

    def _repr_html_(self) -> str:
        texts = typeset(self.title), typeset(self.note)
        return str(Markup("<figure>{}<figcaption>{}. {}</figcaption></figure>").format(self.svg, *texts))


@dataclass(frozen=True)
class StaticFigure(Figure):
    """Chart with given SVG drawings: `wide` for wide screens and `small` for narrow screens."""

    title: str
    wide: Markup
    small: Markup
    caption: str = ""

    def draw(self, *, narrow: bool) -> Markup:
        """Return the SVG markup for a wide or a narrow screen."""
        return self.small if narrow else self.wide


class Figures(tuple[Figure, ...]):
    """Tuple of charts. Notebooks display the drawings; :func:`print` displays the titles."""

    __slots__ = ()

    def __str__(self) -> str:
        return "\n".join(figure.title for figure in self)

    def _repr_html_(self) -> str:
        return "".join(figure._repr_html_() for figure in self)


def element(name: str, parts: Iterable[str] | None = None, /, **attributes: str | float) -> Markup:
    """Return an SVG element with the content `parts`; without parts it is an empty element.

    Underscores in attribute names become hyphens, and a trailing underscore is removed. Floats [px] are written with
    one decimal.
    """
    opening = Markup("<{}").format(name)
    for attribute, value in attributes.items():
        text = f"{value:.1f}" if isinstance(value, float) else value
        opening += Markup(' {}="{}"').format(attribute.rstrip("_").replace("_", "-"), text)
    return opening + (Markup("/>") if parts is None else Markup(">{}</{}>").format(Markup("").join(parts), name))


def svg(
    width: int, height: int, title: str, description: str, parts: Iterable[Markup], *, narrow: bool, **attributes: str
) -> Markup:
    """Return an SVG drawing of the given size [px] and parts; `description` is the description for screen readers."""
    all_parts = [element("title", [title]), element("desc", [description]), *parts]
    options: dict[str, str] = {"class_": f"chart {'narrow' if narrow else 'wide'}", "role": "img"}
    view = f"0 0 {width} {height}"
    return element("svg", all_parts, **options, viewBox=view, width=width, height=height, **attributes)


def svg_text(x: float, y: float, text: str, anchor: str, **attributes: str) -> Markup:
    """Return text as SVG markup; `anchor` is the part of the text ("start", "middle", "end") at the point (x, y).

    Exponents such as that of ``s^-0.9`` are superscripts.
    """
    parts: list[str] = []
    for k, part in enumerate(split_exponents(text)):
        # The attribute baseline-shift is not known to all browsers; the text after a superscript moves down again.
        shifts = {"dy": "-5", "font_size": "9"} if k % 2 else {"dy": "5"} if k else None
        parts += [part if shifts is None else element("tspan", [part], **shifts)] if part else []
    return element("text", parts, x=float(x), y=float(y), text_anchor=anchor, **attributes)


def text_group(texts: Iterable[Markup]) -> Markup:
    """Return an SVG group of text elements with the font size and color of charts."""
    return element("g", texts, font_size="12", fill="currentColor")


def faint_path(data: str) -> Markup:
    """Return the SVG path with the path data `data`, in a faint text color, for an axis."""
    return element("path", fill="none", stroke="currentColor", stroke_opacity="0.55", d=data)


def text_width(text: str) -> float:
    """Return the approximate width of a text [px]."""
    return LETTER_WIDTH_PX * sum(2 if unicodedata.east_asian_width(c) in "WF" else 1 for c in text)


#: Maximum number of points of a line in a wide chart: two per pixel column, so that every extreme value is drawn.
MAX_LINE_POINTS = 1500
#: Minimum difference between axis limits. Below it, denormal numbers have too few digits for ticks.
MIN_DIFFERENCE = 1e-290
#: Maximum extension of the vertical axis beyond the measured lines, in multiples of their range. Other lines that
#: exceed it are cut off.
MAX_STRAY_HEIGHTS = 3.0


@dataclass(frozen=True)
class Ticks:
    """Ticks of an axis: values, labels, and the common factor 10**power of the labels, as text and as exponent."""

    values: list[float]
    labels: list[str]
    factor: str = ""
    power: int = 0


#: Resolution of the coordinates of curves, which are integers in tenths of a pixel.
TENTHS_PER_PIXEL = 10


@dataclass(frozen=True)
class PlotArea:
    """Plot area of a drawing [px]; `frame` has the axis limits (left, right, bottom, top)."""

    left: float
    top: float
    width: float
    height: float
    frame: tuple[float, float, float, float]

    def x_pixels(self, x: Floats | float) -> Floats:
        """Return the horizontal pixel coordinates of values on the horizontal axis."""
        low, high, _, _ = self.frame
        return np.asarray(self.left + self.width * (np.asarray(x) - low) / (high - low))

    def y_pixels(self, y: Floats | float) -> Floats:
        """Return the vertical pixel coordinates, counted downward, of values on the vertical axis."""
        _, _, low, high = self.frame
        return np.asarray(self.top + self.height * (high - np.asarray(y)) / (high - low))

    def tenths(self, x: Floats, y: Floats) -> tuple[list[int], list[int]]:
        """Return coordinates of points relative to the upper left corner of the plot, in integer tenths of a pixel.

        Vertical coordinates are limited to one plot height above and below the plot.
        """
        down = np.clip(self.y_pixels(y) - self.top, -self.height, 2 * self.height)
        xs, ys = (
            np.rint(coordinates * TENTHS_PER_PIXEL).astype(np.int64).tolist()
            for coordinates in (self.x_pixels(x) - self.left, down)
        )
        return xs, ys

    def grid(self, x_ticks: Ticks, y_ticks: Ticks | None) -> list[Markup]:
        """Return grid lines and the left and lower axis as SVG markup.

        Without ticks of the vertical axis (`y_ticks`), only vertical grid lines and the left axis are drawn.
        """
        levels = () if y_ticks is None else y_ticks.values
        lines = [f"M{self.left:.1f} {float(self.y_pixels(v)):.1f}h{self.width:.1f}" for v in levels]
        lines += [f"M{float(self.x_pixels(v)):.1f} {self.top:.1f}v{self.height:.1f}" for v in x_ticks.values]
        paths = [element("path", d=line) for line in lines]
        lower = "" if y_ticks is None else f"h{self.width:.1f}"
        return [
            element("g", paths, class_="grid", fill="none", stroke="currentColor", stroke_opacity="0.14"),
            faint_path(f"M{self.left:.1f} {self.top:.1f}v{self.height:.1f}{lower}"),
        ]

    def labels(self, axes: tuple[Ticks, Ticks], names: tuple[str, str], width: int) -> list[Markup]:
        """Return tick labels and axis labels `names` as SVG markup; `width` is the width of the whole drawing [px]."""
        x_ticks, y_ticks = axes
        bottom = self.top + self.height
        pairs = zip(y_ticks.values, y_ticks.labels, strict=True)
        tick_labels = [svg_text(self.left - 6, float(self.y_pixels(v)) + 4, label, "end") for v, label in pairs]
        pairs = zip(x_ticks.values, x_ticks.labels, strict=True)
        for v, label in pairs:
            x = float(self.x_pixels(v))
            # A centered label at the right end would exceed the drawing, so it is right-aligned there.
            fits = x + text_width(label) / 2 <= width - 4
            tick_labels.append(svg_text(x if fits else width, bottom + 16, label, "middle" if fits else "end"))
        x_text, y_text = (
            truncate_text(f"{label} ({axis.factor})" if axis.factor else label, int((width - 8) / LETTER_WIDTH_PX))
            for label, axis in zip(names, axes, strict=True)
        )
        return [
            element("g", tick_labels, class_="ticks"),
            svg_text(4, self.top - 12, y_text, "start"),
            svg_text(self.left + self.width, bottom + 34, x_text, "end"),
        ]


def ticks(low: float, high: float, max_count: int = 6) -> Ticks:
    """Return the ticks of an axis, at multiples of 1, 2 or 5 times a power of ten within an interval.

    Parameters
    ----------
    low, high
        Ends of the interval, low < high.
    max_count
        Approximate maximum number of ticks; at least two are returned.
    """
    raw_step = (high - low) / max(max_count, 1)
    exponent = math.floor(math.log10(raw_step))
    mantissa = next((s for s in (1, 2, 5) if s * 10.0**exponent >= raw_step * (1 - 1e-9)), 10)
    if mantissa == 10:
        mantissa, exponent = 1, exponent + 1
    step = mantissa * 10.0**exponent
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    if last - first < 1 and max_count < 20:
        return ticks(low, high, max_count + 1)
    # Integer multiples of a power of ten avoid rounding, such as 0.30000000000000004 for 0.3.
    multiples = [k * mantissa for k in range(first, last + 1)]
    values = [float(m * 10**exponent) if exponent >= 0 else m / 10**-exponent for m in multiples]
    largest = max(abs(v) for v in values)
    shift = 0 if 1e-3 <= largest < 1e5 else 3 * math.floor(math.log10(largest) / 3)
    decimals = max(0, shift - exponent)
    labels = [f"{Decimal(m).scaleb(exponent - shift):.{decimals}f}".replace("-", "−") for m in multiples]
    return Ticks(values, labels, f"×10{str(shift).translate(SUPERSCRIPT_DIGITS)}" if shift else "", shift)


def log_ticks(low: float, high: float, max_count: int) -> Ticks:
    """Return the ticks of a logarithmic axis from 10**low to 10**high, with decimal logarithms as tick values.

    The ticks are powers of ten, a 1-2-5 series if there would be fewer than three powers, or linear ticks for a short
    interval. The number of powers is at most about `max_count`.
    """
    stride = max(1, math.ceil((high - low) / max_count))
    first, last = math.ceil(low / stride - 1e-9), math.floor(high / stride + 1e-9)
    powers = [k * stride for k in range(first, last + 1)]
    if len(powers) >= 3:
        labels = [f"{10.0**p:g}" if -3 <= p <= 4 else f"10{str(p).translate(SUPERSCRIPT_DIGITS)}" for p in powers]
        return Ticks([float(p) for p in powers], labels)
    all_ticks = [(s, p) for p in range(math.floor(low), math.ceil(high) + 1) for s in (1, 2, 5)]
    visible_ticks = [(s, p) for s, p in all_ticks if low <= math.log10(s) + p <= high]
    if len(visible_ticks) >= 2:
        labels = [f"{s * 10.0**p:g}".replace("-", "−") for s, p in visible_ticks]
        return Ticks([math.log10(s) + p for s, p in visible_ticks], labels)
    scale_ticks = ticks(10.0**low, 10.0**high, max_count)
    pairs = [(math.log10(v), label) for v, label in zip(scale_ticks.values, scale_ticks.labels, strict=True) if v > 0]
    return Ticks([v for v, _ in pairs], [label for _, label in pairs], scale_ticks.factor)


def decimate(y: ArrayLike, max_count: int = MAX_LINE_POINTS) -> NDArray[np.intp]:
    """Return indices of the points that are sufficient to draw a line.

    These are the ends of intervals of constant value or, if there are too many of these, the extreme values of blocks.

    Parameters
    ----------
    y
        Values of the line; nonfinite values are omitted.
    max_count
        Maximum number of indices, at least 4.

    Returns
    -------
    ndarray of int
        Ascending indices. All finite values are included if there are at most ``max_count``.
    """
    values = as_floats("y", y, gaps=True)
    finite = np.flatnonzero(np.isfinite(values))
    if finite.size <= max_count:
        return finite
    # Points inside a constant interval are on the line between its ends. Staircases keep their shape without them.
    changes = values[1:] != values[:-1]
    segment_ends = np.flatnonzero(np.isfinite(values) & (np.append(True, changes) | np.append(changes, True)))
    if segment_ends.size <= max_count:
        return segment_ends
    edges = np.linspace(0, finite.size, max(1, (max_count - 2) // 2) + 1).astype(np.intp)
    # Sorting by (block, value) places the extreme values of every block at its ends.
    blocks = np.repeat(np.arange(edges.size - 1), np.diff(edges))
    order = np.lexsort((values[finite], blocks))
    rows = np.concatenate([order[edges[:-1]], order[edges[1:] - 1], [0, finite.size - 1]])
    selection: NDArray[np.intp] = finite[np.unique(rows)]
    return selection


def limits(values: list[Floats], margin: float) -> tuple[float, float]:
    """Return axis limits (low, high), low < high, that include all finite values.

    `margin` is added on each side, as a fraction of the range. Without finite values the limits are 0 and 1.
    """
    finite = np.concatenate(values) if values else np.empty(0)
    if finite.size == 0:
        return 0.0, 1.0
    low, high = float(np.min(finite)), float(np.max(finite))
    if high - low <= max(1e-12 * max(abs(low), abs(high)), MIN_DIFFERENCE):
        half_range = 0.1 * abs(low) if abs(low) > MIN_DIFFERENCE else 1.0
        return low - half_range, high + half_range
    return low - margin * (high - low), high + margin * (high - low)


def snap_limits(low: float, high: float) -> tuple[float, float]:
    """Return axis limits extended to ticks that are at most 1 % of the range outside.

    Centers of block pulses from 0.05 to 9.95 give the limits 0 and 10, for example.
    """
    values = ticks(low - 0.01 * (high - low), high + 0.01 * (high - low), 9).values
    return min(low, values[0]), max(high, values[-1])
