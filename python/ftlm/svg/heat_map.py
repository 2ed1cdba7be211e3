"""Heat map of scores over two axes, and correlation matrix."""

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
    NARROW_WIDTH_PX,
    SMALL_WIDTH_PX,
    TEXT_GROUP,
    Figure,
    svg,
    svg_text,
    text_width,
)
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import number, symbol, truncate_text
from ftlm.utils.validation import Floats, as_floats


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
MAX_NAME_CHARACTERS = 12


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
    labels = [truncate_text(symbol(n), MAX_NAME_CHARACTERS) for n in names]
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
