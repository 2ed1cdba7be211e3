"""Tables in the shape of the paper's Tables 4 and 5."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ftlm.base.errors import ModelError
from ftlm.data.equations import Equation
from ftlm.judge.comparison import Comparison
from ftlm.judge.metrics import Metrics
from ftlm.model.model import Model
from ftlm.paint.table import NOT_IN_MODEL, Table
from ftlm.paint.text import DIGITS, DIVERGED, Cell, Exact, shortened, symbol, symbol_html
from ftlm.paper.printed import COEFFICIENTS, ORDERS

#: The order that each coefficient's term has in the paper's equations (22)-(25).
ORDER_OF = {"a": "beta", "b": "gamma", "d": "mu"}
#: Heads of the columns of an equation's numbers and of its criteria, and the groups that the former stand in.
ORDER_HEADS = tuple(map(symbol_html, ORDERS))
HEADS = (*ORDER_HEADS, *map(symbol_html, COEFFICIENTS))
CRITERIA = ("error (45)", "RMSE", "NR")
GROUPS = (("", 1), ("orders", 4), ("coefficients", 4))


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


def letter_of(name: str) -> str:
    """A name of the paper without its index: alpha1 is alpha."""
    return name.rstrip("0123456789")


def letters_of(item: Equation) -> tuple[dict[str, float], dict[str, float]]:
    """Orders and coefficients of an equation of the arm by letter."""
    orders, coefficients = {"alpha": item.order.constant}, {}
    for term in item.terms:
        letter = letter_of(term.name or "")
        if letter in COEFFICIENTS:
            coefficients[letter] = float(term.coefficient) + 0.0
        if letter in ORDER_OF:
            orders[ORDER_OF[letter]] = term.order.constant
    return orders, coefficients


def four_digits(orders: Mapping[str, float]) -> dict[str, float]:
    """Orders with the digits of the paper's Table 6."""
    return {name: round(order, 4) + 0.0 for name, order in orders.items()}


def number_cells(orders: Mapping[str, float], coefficients: Mapping[str, float]) -> list[Cell]:
    """The cells under `HEADS`: orders as they are, coefficients as estimates."""
    return [*(Exact(orders[n]) if n in orders else None for n in ORDERS), *map(coefficients.get, COEFFICIENTS)]


def criteria_cells(figures: Metrics | None) -> list[Cell]:
    """The cells under `CRITERIA`."""
    return [None] * 3 if figures is None else [figures.error, figures.rmse, figures.nr]


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
    errors = comparison.equation_error.get(output), comparison.output_error.get(output)
    return PaperRow(label, output, *letters_of(item), *errors)


def _beginnings(rows: Sequence[PaperRow]) -> dict[int, str]:
    """The output that begins at each row index."""
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
    cells = [
        [row.label, *number_cells(row.orders, row.coefficients), *criteria_cells(row.equation_error),
         *criteria_cells(row.output_error)]
        for row in rows
    ]  # fmt: skip
    return Table(
        title, ("model", *HEADS, *CRITERIA, *CRITERIA), cells,
        groups=(*GROUPS, ("equation error", 3), ("output error (free run)", 3)),
        headings={i: symbol_html(output) for i, output in _beginnings(rows).items()},
    )  # fmt: skip


#: Widths of the columns in text: label, four orders, four coefficients, twice error, RMSE, NR. Together 119 of 120.
_LABEL, _TEXT_WIDTHS = 17, (5,) * 4 + (9,) * 4 + (8, 8, 7) * 2


def paper_table_text(rows: Sequence[PaperRow]) -> str:
    """Return the same table for a terminal of 120 columns; a number loses digits where its column is too narrow."""
    heads = [*map(symbol, (*ORDERS, *COEFFICIENTS)), *("error", "RMSE", "NR") * 2]
    left, right = sum(_TEXT_WIDTHS[:8]) + _LABEL, sum(_TEXT_WIDTHS[8:11])
    groups = (f" {words} ".center(right - 1, "-").rjust(right) for words in ("equation error", "free run"))
    lines = [
        " " * left + "".join(groups),
        "model".ljust(_LABEL) + "".join(h.rjust(w) for h, w in zip(heads, _TEXT_WIDTHS, strict=True)),
    ]
    starts, infinite = _beginnings(rows), False
    for i, (label, *cells) in enumerate(paper_table(rows).rows):
        if i in starts:
            lines.append(symbol(starts[i]))
        numbers = "".join(_fitted(v, width - 1).rjust(width) for v, width in zip(cells, _TEXT_WIDTHS, strict=True))
        lines.append(f"  {shortened(str(label), _LABEL - 3)}".ljust(_LABEL) + numbers)
        infinite = infinite or any(isinstance(v, float) and not math.isfinite(v) for v in cells)
    if infinite:
        lines.append(f"∞: {DIVERGED}, the response leaves the range of numbers")
    return "\n".join(lines)


def _fitted(value: Cell, width: int) -> str:
    """A number with as many of its five digits as fit."""
    if value is None or isinstance(value, str):
        return NOT_IN_MODEL
    if not math.isfinite(value):
        return "?" if math.isnan(value) else "∞"
    texts = [f"{value:.{digits}g}".replace("e-0", "e-").replace("e+0", "e") for digits in range(DIGITS, 0, -1)]
    return next((t for t in texts if len(t) <= width), texts[-1])
