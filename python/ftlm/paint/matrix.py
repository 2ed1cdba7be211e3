"""A matrix of correlations: colours from -1 over 0 to 1, and the number in every cell that has room."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike

from ftlm.base.arrays import Floats
from ftlm.base.errors import DataError
from ftlm.paint.figure import NARROW, SMALL, Figure, svg, svg_text, text_width
from ftlm.paint.text import number, shortened, symbol

#: From -1 to 1, blue over a light grey to vermilion: both ends dark, and the middle reads black.
SCALE = ("#1f4e8c", "#4b80bd", "#8fb3d9", "#c8d9ea", "#eceff1", "#f4d5c4", "#e9a27f", "#cf6535", "#9c3009")
#: Cells with these colours carry white numbers.
DARK = {0, 1, 7, 8}
NO_VALUE = "#9aa3ad"
#: Largest cell, and the smallest one that has room for its number [px].
LARGEST_CELL, ROOM = 46.0, 30.0
MOST_LETTERS = 12


def correlation_map(names: Sequence[str], values: ArrayLike, *, title: str, caption: str = "") -> Figure:
    """A correlation matrix as coloured cells.

    Parameters
    ----------
    names
        Of the rows and columns.
    values
        Shape (N, N), from -1 to 1; what is not a number has a grey cell.
    title
        What is shown.
    caption
        Sentence below.

    Raises
    ------
    DataError
        A matrix that is not square or not of these names, or numbers beyond 1.
    """
    matrix = np.asarray(values, dtype=np.float64)
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
    wide, small = (_drawing(names, matrix, title, described, narrow=narrow) for narrow in (False, True))
    return Figure(title, wide, small, caption)


def _drawing(names: Sequence[str], matrix: Floats, title: str, described: str, *, narrow: bool) -> Markup:
    width, count = (NARROW if narrow else SMALL), len(names)
    labels = [shortened(symbol(n), MOST_LETTERS) for n in names]
    left = 10 + max(map(text_width, labels))
    cell = min((width - left - 8) / count, LARGEST_CELL)
    # Names above the columns stand upright where they have no room.
    turned = max(map(text_width, labels)) > cell - 4
    top = 8 + (max(map(text_width, labels)) if turned else 16)
    out, texts = [], []
    box = Markup('<rect x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{:.1f}" fill="{}"/>')
    for i in range(count):
        for j in range(count):
            value = float(matrix[i, j])
            known = np.isfinite(value)
            step = int(np.clip(round((value + 1) / 2 * (len(SCALE) - 1)), 0, len(SCALE) - 1)) if known else -1
            x, y = left + j * cell, top + i * cell
            out.append(box.format(x, y, cell - 1, cell - 1, SCALE[step] if known else NO_VALUE))
            if cell >= ROOM and i != j:
                ink = "#fff" if step in DARK or not known else "#15181c"
                text = f"{value:.2f}".replace("0.", ".").replace("-", "−") if known else "–"
                texts.append(
                    Markup(
                        '<text x="{:.1f}" y="{:.1f}" text-anchor="middle" fill="{}" font-size="11">{}</text>'
                    ).format(x + cell / 2 - 0.5, y + cell / 2 + 4, ink, text)
                )
    out.append(Markup('<g font-size="12" fill="currentColor">'))
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
    out += [box.format(left + k * size, foot, size, 10, colour) for k, colour in enumerate(SCALE)]
    out.append(svg_text(left, foot + 24, "−1", "start"))
    out.append(svg_text(left + size * len(SCALE) / 2, foot + 24, "0", "middle"))
    out.append(svg_text(left + size * len(SCALE), foot + 24, "1", "end"))
    return svg(width, round(foot + 32), title, described, [*out, *texts, Markup("</g>")], narrow=narrow)
