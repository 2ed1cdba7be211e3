"""Heat maps: scores over two axes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from ftlm.base.arrays import Floats
from ftlm.base.errors import DataError
from ftlm.paint.lines import LETTER, NARROW, SMALL, Figure, svg_text
from ftlm.paint.text import number, symbol


@dataclass(frozen=True)
class Landscape:
    """Scores of a lattice over two orders, the others as in the best model.

    Parameters
    ----------
    names
        The two orders, across and upward.
    x, y
        Their values, ascending.
    scores
        Shape (y, x); infinite where a pair is no candidate or its free run diverges.
    others
        What the other numbers do, in words.
    score
        What the score is, in words.
    correlation
        Of the two orders in a joint fit; not a number otherwise.
    """

    names: tuple[str, str]
    x: Floats
    y: Floats
    scores: Floats
    others: str = "Other orders as in the best model."
    score: str = "score"
    correlation: float = math.nan


#: From best to worst, after viridis reversed in lightness: dark is good on white, and every step differs in lightness.
HEAT = ("#440154", "#472c7a", "#3b518b", "#2c718e", "#21908d", "#27ad81", "#5cc863", "#aadc32", "#fde725")
NO_SCORE = "#9aa3ad"


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
        out.append(svg_text(left + (k + 0.5) * cell_w, top + h + 16, marks[0][k], "middle"))
    for k in np.unique(np.linspace(0, rows - 1, min(rows, 7)).round().astype(int)).tolist():
        out.append(svg_text(left - 6, top + h - (k + 0.5) * cell_h + 4, marks[1][k], "end"))
    out.append(svg_text(4, top - 12, f"order {symbol(upward)}", "start"))
    out.append(svg_text(left + w, top + h + 34, f"order {symbol(across)}", "end"))
    size = 20.0 if narrow else 26.0
    out.append(svg_text(left, top + h + 76, f"score {number(ends[0], 3)}", "start"))
    out.append(svg_text(left + size * len(HEAT), top + h + 76, f"{number(ends[1], 3)}", "end"))
    out.append(Markup("</g>"))
    for k, colour in enumerate(HEAT):
        out.append(
            Markup('<rect x="{:.1f}" y="{:.1f}" width="{:.1f}" height="12" fill="{}"/>').format(
                left + k * size, top + h + 48, size + 0.3, colour
            )
        )
    out.append(Markup("</svg>"))
    return Markup("").join(out)
