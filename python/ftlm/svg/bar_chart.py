"""Bar charts: histograms and grouped bars."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike

from ftlm.errors import DataError
from ftlm.svg.figure import (
    MIN_DIFFERENCE,
    NARROW_WIDTH_PX,
    SMALL_WIDTH_PX,
    TEXT_GROUP,
    Figure,
    PlotArea,
    svg,
    svg_text,
    text_width,
    ticks,
)
from ftlm.svg.line_chart import LINE_STYLES, stroke_path
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import number, truncate_text
from ftlm.utils.validation import Floats, as_floats

#: Most bars of a histogram, and its height [px].
MAX_BARS = 41
HISTOGRAM_HEIGHT_PX = 190.0
#: Height of one bar of a grouped bar chart [px].
BAR_HEIGHT_PX = 16.0
#: Longest label beside a bar [characters].
MAX_NAME_CHARACTERS = 26


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
    shown = [truncate_text(n, 16 if narrow else MAX_NAME_CHARACTERS) for n in names]
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
