"""Tables in the shape of the paper's Tables 4 and 5."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ftlm.base.errors import ModelError
from ftlm.judge.comparison import _FIGURES, Comparison
from ftlm.judge.metrics import Metrics
from ftlm.model.model import Model
from ftlm.paint.table import NOT_IN_MODEL, Table
from ftlm.paint.text import DIGITS, DIVERGED, Cell, Exact, symbol, symbol_html


@dataclass(frozen=True)
class PaperRow:
    """One row of a table in the shape of the paper's Tables 4 and 5.

    Parameters
    ----------
    label
        Such as "integer order" or "p = 7".
    output
        Name of the output whose equation this is.
    orders
        ``alpha``, ``beta``, ``gamma``, ``mu``; what is missing is not in the model.
    coefficients
        ``a``, ``b``, ``d``, ``g``, likewise.
    equation_error, output_error
        Figures; None where they were not computed.
    """

    label: str
    output: str
    orders: Mapping[str, float]
    coefficients: Mapping[str, float]
    equation_error: Metrics | None
    output_error: Metrics | None


#: The order that each coefficient's term has in the paper's equations (22)-(25).
_ORDER_OF = {"a": "beta", "b": "gamma", "d": "mu"}
_ORDERS = ("gamma", "alpha", "beta", "mu")
_COEFFICIENTS = ("a", "b", "d", "g")


def paper_row(label: str, model: Model, comparison: Comparison, output: str) -> PaperRow:
    """Return the row of one equation of an arm's model, whose coefficients are called a, b, d, g with an index.

    Raises
    ------
    ModelError
        No such output.
    """
    item = next((e for e in model.equations if e.output == output), None)
    if item is None:
        raise ModelError(f"the model has no output {output!r}; it has {', '.join(model.outputs)}")
    orders: dict[str, float] = {"alpha": item.order.constant}
    coefficients: dict[str, float] = {}
    for term in item.terms:
        letter = (term.name or "").rstrip("0123456789")
        if letter in _COEFFICIENTS:
            coefficients[letter] = float(term.coefficient) + 0.0
        if letter in _ORDER_OF:
            orders[_ORDER_OF[letter]] = term.order.constant
    return PaperRow(
        label, output, orders, coefficients, comparison.equation_error.get(output), comparison.output_error.get(output)
    )


def _halves(rows: Sequence[PaperRow]) -> dict[int, str]:
    """Return the output that begins at each row index."""
    return {i: r.output for i, r in enumerate(rows) if i == 0 or rows[i - 1].output != r.output}


def paper_table(rows: Sequence[PaperRow], *, title: str = "Identified models") -> Table:
    """Return a table in the shape of the paper's Tables 4 and 5, with both errors.

    Parameters
    ----------
    rows
        For each output the integer-order model, then one row for each p; rows of one output stand together.
    title
        Caption.
    """
    cells: list[list[Cell]] = []
    for row in rows:
        orders = [Exact(row.orders[n]) if n in row.orders else None for n in _ORDERS]
        coefficients = [row.coefficients.get(n) for n in _COEFFICIENTS]
        cells.append([row.label, *orders, *coefficients, *three(row.equation_error), *three(row.output_error)])
    return Table(
        title,
        ("model", *(symbol_html(n) for n in (*_ORDERS, *_COEFFICIENTS)), *_FIGURES[:3], *_FIGURES[:3]),
        cells,
        groups=(("", 1), ("orders", 4), ("coefficients", 4), ("equation error", 3), ("output error (free run)", 3)),
        headings={i: symbol_html(output) for i, output in _halves(rows).items()},
    )


def three(figures: Metrics | None) -> list[Cell]:
    return [None] * 3 if figures is None else [figures.error, figures.rmse, figures.nr]


#: Widths of the columns in text: label, four orders, four coefficients, twice error, RMSE, NR. Together 119 of 120.
_LABEL, _TEXT_WIDTHS = 17, (5,) * 4 + (9,) * 4 + (8, 8, 7) * 2


def paper_table_text(rows: Sequence[PaperRow]) -> str:
    """Return the same table for a terminal of 120 columns; a number loses digits where its column is too narrow."""
    table = paper_table(rows)
    heads = [symbol(n) for n in (*_ORDERS, *_COEFFICIENTS)] + ["error", "RMSE", "NR"] * 2
    left, right = sum(_TEXT_WIDTHS[:8]) + _LABEL, sum(_TEXT_WIDTHS[8:11])
    lines = [
        " " * left
        + " equation error ".center(right - 1, "-").rjust(right)
        + " free run ".center(right - 1, "-").rjust(right),
        "model".ljust(_LABEL) + "".join(h.rjust(w) for h, w in zip(heads, _TEXT_WIDTHS, strict=True)),
    ]
    starts, infinite = _halves(rows), False
    for i, cells in enumerate(table.rows):
        if i in starts:
            lines.append(symbol(starts[i]))
        label = rows[i].label
        line = f"  {label if len(label) <= _LABEL - 3 else label[: _LABEL - 4] + '…'}".ljust(_LABEL)
        for value, width in zip(cells[1:], _TEXT_WIDTHS, strict=True):
            infinite = infinite or (isinstance(value, float) and not math.isfinite(value))
            line += _fitted(value, width - 1).rjust(width)
        lines.append(line)
    if infinite:
        lines.append(f"∞: {DIVERGED}, the response leaves the range of numbers")
    return "\n".join(lines)


def _fitted(value: Cell, width: int) -> str:
    """Return a number with as many of its five digits as fit."""
    if value is None or isinstance(value, str):
        return NOT_IN_MODEL
    if not math.isfinite(value):
        return "?" if math.isnan(value) else "∞"
    texts = [f"{value:.{digits}g}".replace("e-0", "e-").replace("e+0", "e") for digits in range(DIGITS, 0, -1)]
    return next((t for t in texts if len(t) <= width), texts[-1])
