"""Tables of a report: plain data first, and the HTML or terminal text that is made of them."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from numbers import Integral
from typing import TYPE_CHECKING

from markupsafe import Markup, escape

from ftlm.errors import ModelError
from ftlm.models import delay_name
from ftlm.output_error import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from ftlm.identification import Identification
    from ftlm.models import Equation, Model, Order
    from ftlm.order_search import SearchResult
    from ftlm.output_error import JointFit
    from ftlm.residuals import InformationCriteria, Residuals
    from ftlm.validation import Comparison, Metrics

__all__ = [
    "Cell",
    "Exact",
    "PaperRow",
    "Table",
    "equation_html",
    "errors_table",
    "estimates_table",
    "grouped_warnings",
    "information_table",
    "initial_terms_table",
    "number",
    "paper_row",
    "paper_table",
    "paper_table_text",
    "parameter_table",
    "residual_table",
    "search_summary",
    "search_top",
    "settings_table",
    "starts_table",
    "symbol",
    "symbol_html",
]

#: Significant digits of every estimated number: more than any estimate here deserves, enough to compare with the paper.
DIGITS = 5
#: Columns from which a table is set smaller, so that the paper's fifteen fit a laptop's screen.
DENSE = 12
DIVERGED = "diverged"
#: Decimals of an order in an equation; the model's file has them all.
ORDER_DECIMALS = 4
THIN = Markup('<mspace width="0.17em"></mspace>')  # our constant
NOT_IN_MODEL = "–"

_GREEK = {
    "alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ", "theta": "θ", "mu": "μ", "tau": "τ", "phi": "φ",
    "omega": "ω",
}  # fmt: skip
_SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_PLAIN_DIGITS = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
_SYMBOL = re.compile(rf"({'|'.join(_GREEK)}|[A-Za-z])_?(\d*)", re.ASCII)


# ------------------------------------------------------------------------------------------------ names and numbers


def symbol(name: str) -> str:
    """Return a signal's or parameter's name as it is written by hand: ``theta12`` becomes θ₁₂; any other name stays."""
    found = _SYMBOL.fullmatch(name)
    if not found:
        return name
    return _GREEK.get(found[1], found[1]) + found[2].translate(_SUBSCRIPTS)


def symbol_html(name: str) -> Markup:
    """Return the same as `symbol` with a real subscript, escaped."""
    found = _SYMBOL.fullmatch(name)
    if not found:
        return Markup("<i>{}</i>").format(name)
    stem = Markup("<i>{}</i>").format(_GREEK.get(found[1], found[1]))
    return stem + Markup("<sub>{}</sub>").format(found[2]) if found[2] else stem


class Exact(float):
    """A number that was chosen, not estimated, such as an order on a lattice: printed as it is."""


Cell = str | float | None


def number(value: float, digits: int = DIGITS) -> str:
    """Return a number with this many significant digits; infinity is ∞ with the word "diverged"."""
    if isinstance(value, Integral):
        return f"{value:,}".replace(",", "\u202f")
    if math.isnan(value):
        return "undefined"
    if math.isinf(value):
        return f"{'−' if value < 0 else ''}∞ {DIVERGED}"
    if value == 0:
        return "0"
    text = f"{value:.10g}" if isinstance(value, Exact) else f"{value:#.{digits}g}"
    mantissa, _, exponent = text.partition("e")
    mantissa = mantissa.removesuffix(".").replace("-", "−")
    return f"{mantissa}×10{str(int(exponent)).translate(_SUPERSCRIPTS)}" if exponent else mantissa


def _cell_html(value: Cell) -> Markup:
    """Return a cell's content; a number carries its full precision for whoever reads the page by program."""
    if value is None:
        return Markup(NOT_IN_MODEL)
    if isinstance(value, str):
        return escape(value)
    return Markup('<data value="{}">{}</data>').format(repr(float(value)), number(value))


# ------------------------------------------------------------------------------------------------ the table itself


@dataclass(frozen=True)
class Table:
    """A table of a report.

    Parameters
    ----------
    title
        Caption.
    columns
        Column heads. The first column names the row.
    rows
        Cells: text (escaped, unless it is ``Markup``), numbers (shown with five significant digits, kept in full), or
        None for what a model does not have.
    groups
        Heads above the heads, as (text, number of columns) from left to right; an empty text heads nothing.
    headings
        Lines across the table, by the index of the row that they stand above.
    note
        Sentence below the table.
    wrap
        Whether text in cells breaks into lines; otherwise every row is one line.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    groups: Sequence[tuple[str, int]] = ()
    headings: Mapping[int, str] = field(default_factory=dict)
    note: str = ""
    wrap: bool = False

    @property
    def is_numeric(self) -> list[bool]:
        """Which columns hold numbers, and are set flush right."""
        columns = [[row[k] for row in self.rows] for k in range(len(self.columns))]
        return [
            bool(cells)
            and all(c is None or not isinstance(c, str) for c in cells)
            and any(c is not None for c in cells)
            for cells in columns
        ]

    @property
    def starts_group(self) -> list[bool]:
        """Which columns begin a group, and are set apart."""
        starts, at = [False] * len(self.columns), 0
        for text, width in self.groups:
            if text and at < len(starts):
                starts[at] = True
            at += width
        return starts

    def _classes(self) -> list[str]:
        pairs = zip(self.is_numeric, self.starts_group, strict=True)
        return [" ".join(w for w, on in (("n", numeric), ("g", group)) if on) for numeric, group in pairs]

    def to_html(self) -> Markup:
        """Return the table in a container that scrolls by itself on a narrow screen."""
        classes = [Markup(' class="{}"').format(c) if c else Markup("") for c in self._classes()]
        # The title stands outside of what scrolls, so that it wraps; the label tells it to those who listen.
        dense = " dense" if len(self.columns) >= DENSE else " wrap" if self.wrap else ""
        out = [Markup('<div class="table{}"><p class="title">{}</p>').format(dense, self.title)]
        out.append(Markup('<div class="scroll" role="group" tabindex="0" aria-label="{}">').format(self.title))
        out.append(Markup('<table aria-label="{}"><thead>').format(self.title))
        if self.groups:
            heads = Markup("").join(
                Markup('<th scope="colgroup" colspan="{}" class="g">{}</th>').format(width, text)
                if text
                else Markup('<td colspan="{}"></td>').format(width)
                for text, width in self.groups
            )
            out.append(Markup("<tr>{}</tr>").format(heads))
        heads = Markup("").join(
            Markup('<th scope="col"{}>{}</th>').format(c, head) for c, head in zip(classes, self.columns, strict=True)
        )
        out.append(Markup("<tr>{}</tr></thead><tbody>").format(heads))
        for i, row in enumerate(self.rows):
            if i in self.headings:
                out.append(
                    Markup('<tr class="heading"><th scope="rowgroup" colspan="{}"><span>{}</span></th></tr>').format(
                        len(self.columns), self.headings[i]
                    )
                )
            cells = [Markup('<th scope="row"{}>{}</th>').format(classes[0], _cell_html(row[0]))]
            cells += [
                Markup("<td{}>{}</td>").format(c, _cell_html(v)) for c, v in zip(classes[1:], row[1:], strict=True)
            ]
            out.append(Markup("<tr>{}</tr>").format(Markup("").join(cells)))
        out.append(Markup("</tbody></table></div>"))
        if self.note:
            out.append(Markup('<p class="note">{}</p>').format(self.note))
        out.append(Markup("</div>"))
        return Markup("\n").join(out)


# ------------------------------------------------------------------------------------------------ equations


def equation_html(item: Equation) -> Markup:
    """Return an identified equation typeset as MathML, a piece for each term so that it breaks between terms."""
    parts = [_math(_derivative_math(item.order, item.output) + Markup("<mo>=</mo>"))]
    for k, term in enumerate(item.terms):
        value = term.fixed or 0.0
        sign = "−" if value < 0 else "" if k == 0 else "+"
        # The first sign belongs to its number; the others stand between two terms.
        lead = Markup('<mo form="{}">{}</mo>').format("infix" if k else "prefix", sign) if sign else Markup("")
        parts.append(_math(lead + _number_math(abs(value)) + THIN +
                           _derivative_math(term.order, term.signal), "term"))  # fmt: skip
    return Markup('<span class="equation">{}</span>').format(Markup(" ").join(parts))


def _math(content: Markup, name: str = "") -> Markup:
    kind = Markup(' class="{}"').format(name) if name else Markup("")
    return Markup("<math{}><mrow>{}</mrow></math>").format(kind, content)


def _number_math(value: float) -> Markup:
    mantissa, times, power = number(value).partition("×10")
    base = Markup("<mn>{}</mn>").format(mantissa)
    if not times:
        return base
    exponent = power.translate(_PLAIN_DIGITS)
    sign = Markup("<mo>−</mo>") if exponent.startswith("-") else Markup("")
    raised = Markup("<mrow>{}<mn>{}</mn></mrow>").format(sign, exponent.lstrip("-"))
    return Markup("{}<mo>×</mo><msup><mn>10</mn>{}</msup>").format(base, raised)


def _symbol_math(name: str) -> Markup:
    found = _SYMBOL.fullmatch(name)
    if not found:
        return Markup("<mi>{}</mi>").format(name)
    stem = Markup("<mi>{}</mi>").format(_GREEK.get(found[1], found[1]))
    return Markup("<msub>{}<mn>{}</mn></msub>").format(stem, found[2]) if found[2] else stem


def _derivative_math(order: Order, signal: str) -> Markup:
    if not order.names and round(order.constant, ORDER_DECIMALS) == 0:
        return _symbol_math(signal)
    value = Markup("<mi>{}</mi>").format(str(order)) if order.names else _signed(order.constant)
    return Markup("<msup><mi>D</mi>{}</msup>{}{}").format(value, THIN, _symbol_math(signal))


def _signed(value: float) -> Markup:
    value = round(value, ORDER_DECIMALS) + 0.0
    text = number(Exact(abs(value)))
    return Markup("<mrow><mo>−</mo><mn>{}</mn></mrow>" if value < 0 else "<mn>{}</mn>").format(text)


def _derivative_html(order: Order, signal: str) -> Markup:
    if not order.names and round(order.constant, ORDER_DECIMALS) == 0:
        return symbol_html(signal)
    text = str(order) if order.names else number(Exact(round(order.constant, ORDER_DECIMALS) + 0.0))
    return Markup("D<sup>{}</sup> {}").format(text, symbol_html(signal))


# ------------------------------------------------------------------------------------------------ one model


def parameter_table(model: Model, joint: JointFit | None = None, *, title: str = "Orders and coefficients") -> Table:
    """Return orders and coefficients with the place of each, beside standard errors and the values the maker states.

    Parameters
    ----------
    model
        The model. What its ``estimate`` knows is used where there is no fit.
    joint
        The fit that it came from, where there is one: it knows the standard errors.
    title
        Caption.
    """
    reference = model.structure.reference
    errors: Mapping[str, float | None] = {}
    extra: Mapping[str, float] = {}
    if joint is not None:
        errors, extra = joint.standard_errors, joint.coefficients
    elif model.estimate is not None:
        errors, extra = model.estimate.standard_errors, model.estimate.values
    known = any(e is not None for e in errors.values())

    def row(name: str, value: float, stated: float | None, place: str) -> list[Cell]:
        error = errors.get(name)
        half = None if error is None else NORMAL_95 * error
        ends: list[Cell] = [None, None] if half is None else [value - half, value + half]
        return [symbol_html(name), value, error, *ends, stated, place]

    rows = [row(n, v if known else Exact(v), None, "free order") for n, v in model.orders.items()]
    shown = set(model.orders)
    for item in model.equations:
        for term in item.terms:
            if term.name is None:
                continue
            place = Markup("of {} in the equation of {}").format(
                _derivative_html(term.order, term.signal), symbol_html(item.output)
            )
            stated = reference.get(term.name)
            shown.add(term.name)
            # + 0.0 makes the negative zero of a product of signs a plain zero.
            rows.append(row(term.name, float(term.coefficient), None if stated is None else stated + 0.0, place))
    delays = {delay_name(n): (n, v) for n, v in model.structure.delay.items() if delay_name(n) in errors}
    rows += [
        row(n, v, None, "free in the coefficient law") for n, v in extra.items() if n not in shown and n not in delays
    ]
    rows += [row(n, v, None, f"delay of {symbol(signal)} in s") for n, (signal, v) in delays.items()]
    columns = ["parameter", "value", "standard error", "from", "to", "stated", "what it is"]
    if known:
        note = "A coefficient without an interval follows from the law. Intervals hold as far as the model does."
    else:
        note = "No standard errors are given here: this table does not say how many of the digits mean something."
    left_out = ([] if known else [2, 3, 4]) + ([] if reference else [5])
    if reference:
        note += " Stated values belong to the integer orders of the maker's model."
    kept = [i for i in range(len(columns)) if i not in left_out]
    groups = (("", 3), ("95 % interval", 2), ("", len(kept) - 5)) if known else ()
    return Table(
        title, tuple(columns[i] for i in kept), [[row[i] for i in kept] for row in rows], groups=groups, note=note
    )


def estimates_table(result: Identification | None, truth: Mapping[str, float] | None = None) -> Table:
    """Orders and coefficients of a joint fit with intervals, beside their true values where those are known."""
    rows: list[list[Cell]] = []
    if result is not None and result.joint is not None:
        for name, value in {**result.orders, **result.joint.coefficients}.items():
            low, high = result.intervals[name]
            known = [truth.get(name)] if truth else []
            rows.append([symbol_html(name), value, result.standard_errors[name], low, high, *known])
    columns, groups = ["parameter", "value", "standard error", "from", "to"], [("", 3), ("95 % interval", 2)]
    if truth:
        columns, groups = [*columns, "true value"], [*groups, ("", 1)]
    return Table("Output error: orders and coefficients, with intervals", columns, rows, groups=groups)


def grouped_warnings(results: Mapping[str, Identification | None]) -> list[str]:
    """Warnings of several results by label, those that differ in numbers alone together."""
    groups: dict[str, tuple[str, list[str]]] = {}
    for label, result in results.items():
        for warning in () if result is None else result.warnings:
            # Digits of names stay: theta11 is not theta12.
            key = re.sub(r"(?<![A-Za-z\d.])[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", warning)
            groups.setdefault(key, (warning, []))[1].append(label)
    found = []
    for warning, labels in groups.values():
        alike = "" if len(labels) == 1 else " (numbers of the first)"
        found.append(f"{', '.join(dict.fromkeys(labels))}: {warning}{alike}")
    return found


def starts_table(joint: JointFit, *, rows: int = 10, title: str = "Automatic starts") -> Table:
    """Return where the first fits began and how far each came on thinned samples, best first."""
    kept = joint.starts[:rows]
    cells: list[list[Cell]] = [[k + 1, origin, level] for k, (level, origin) in enumerate(kept)]
    note = f"{joint.choice}. The best ones went on on all samples." if joint.starts else ""
    return Table(title, ("rank", "start from", "cost per residual"), cells, note=note)


def residual_table(tests: Residuals, *, title: str = "Residual tests") -> Table:
    """Return every residual test with its statistic and limit."""
    rows: list[list[Cell]] = []
    for output, found in tests.outputs.items():
        white = found.whiteness
        rows.append([symbol_html(output), "whiteness", white.statistic, white.limit, _verdict(white.passed)])
        rows += [
            [symbol_html(output), Markup("independence of {}").format(symbol_html(n)), t.statistic, t.limit,
             _verdict(t.passed)]
            for n, t in found.inputs.items()
        ]  # fmt: skip
    return Table(
        title,
        ("output", "test", "statistic", "limit (99 %)", "verdict"),
        rows,
        note="Whiteness: Ljung-Box sum over 25 lags. Independence: largest correlation at lags from 0 on. One true "
        "model in a hundred fails each.",
    )


def _verdict(passed: bool) -> str:
    return "passed" if passed else "failed"


def information_table(information: InformationCriteria, *, title: str = "Information criteria") -> Table:
    """Return AIC, AICc and BIC with what they count."""
    criteria = (("AIC", information.aic), ("AICc", information.aicc), ("BIC", information.bic))
    # Differences count, not sizes: all digits before the point.
    rows: list[list[Cell]] = [[name, Exact(round(value, 1))] for name, value in criteria]
    rows += [["numbers estimated", information.parameters], ["samples", information.samples]]
    note = (
        "Lower is better, among models of the same outputs on the same runs. Orders, coefficients, initial terms and "
        "one noise level an output count as numbers."
    )
    return Table(title, ("criterion", "value"), rows, note=note)


def settings_table(result: Identification, *, title: str = "What the result depends on") -> Table:
    """Return what the result depends on besides the data: estimator, criterion, M, p, K₀, initial terms, runs."""
    used, structure = result.settings, result.model.structure
    coordinates = {"haar": "Haar coordinates", "time": "order of time"}
    initial = {"rest": "none, the records start at rest", "caputo": "Caputo's, estimated for each run"}
    rows: list[list[Cell]] = [
        ["structure", structure.name],
        ["coupling in free runs", structure.coupling],
        ["estimator", result.method],
        ["block pulses a run, M", int(used["m"])],
    ]
    if "innovation_length" in used:
        rows += [
            ["innovation length, p", int(used["innovation_length"])],
            [Markup("prior covariance, K<sub>0</sub>"), Exact(used["prior_covariance"])],
            ["rows of the recursion", coordinates.get(used["rows"], used["rows"])],
        ]  # fmt: skip
    if "refinement" in used:
        rows += [
            ["pulses a sample interval", int(used["refinement"])],
            ["automatic starts", int(used["starts"])],
        ]
        for name, level in used["noise"].items():
            rows.append([f"noise found on {symbol(name)}", float(level)])
    rows.append(["initial terms", initial.get(str(used["initial"]), str(used["initial"]))])
    if result.searches:
        norm = {"l1": "sum of absolute errors (45)", "l2": "RMSE (46)"}.get(used["norm"], used["norm"])
        rows.append(["orders ranked by", f"{used['criterion']}, {norm}"])
    rows += [[f"delay of {symbol(name)}", f"{delay:g} s"] for name, delay in structure.delay.items()]
    if structure.sensor_filter is not None:
        filtered = ", ".join(symbol(o) for o in structure.sensor_filter.outputs)
        rows.append(["known sensor filter on", filtered])
    found = result.comparison
    rows += [
        [Markup("run <q>{}</q>").format(name), f"{number(step * found.m)} s, pulses of {number(step * 1e3)} ms"]
        for (name, _, _), step in zip(found.per_run, found.step, strict=True)
    ]
    return Table(title, ("setting", "used"), rows)


def initial_terms_table(comparison: Comparison, *, title: str = "Initial terms of the free runs") -> Table | None:
    """Return initial terms by run and output, or None where every run starts at rest."""
    rows: list[list[Cell]] = [
        [name, symbol_html(output), Exact(exponent), value]
        for (name, _, _), initial in zip(comparison.per_run, comparison.initial, strict=True)
        for output, terms in initial.items()
        for exponent, value in terms.items()
    ]
    if not rows:
        return None
    note = "They describe how that record starts and are never carried to another."
    return Table(title, ("run", "output", "exponent of t", "coefficient"), rows, note=note)


# ------------------------------------------------------------------------------------------------ errors

_FIGURES = ("error (45)", "RMSE", "NR", "fit %")


def errors_table(
    compared: Iterable[tuple[str, Comparison]], *, units: Mapping[str, str] | None = None, title: str = "Both errors"
) -> Table:
    """Return equation error and output error side by side, a row for each output of each comparison.

    Parameters
    ----------
    compared
        (what the data were to the model, comparison), such as ``("estimation", result.comparison)``. Where a comparison
        holds several runs, each follows with its own rows.
    units
        Units of the outputs.
    title
        Caption.
    """
    rows: list[list[Cell]] = []
    headings: dict[int, str] = {}

    def add(heading: str, equation: Mapping[str, Metrics], output: Mapping[str, Metrics]) -> None:
        headings[len(rows)] = heading
        for name in output:
            unit = (units or {}).get(name, "")
            label = symbol_html(name) + (Markup(" [{}]").format(unit) if unit else Markup(""))
            rows.append([label, *_four(equation[name]), *_four(output[name])])

    for label, found in compared:
        names = [name for name, _, _ in found.per_run]
        if len(names) == 1:
            add(f"{label}: {names[0]}", found.equation_error, found.output_error)
            continue
        add(f"{label}: {len(names)} runs together", found.equation_error, found.output_error)
        for name, equation, output in found.per_run:
            add(f"{label}: {name}", equation, output)
    return Table(
        title,
        ("output", *_FIGURES, *_FIGURES),
        rows,
        groups=(("", 1), ("equation error", 4), ("output error (free run)", 4)),
        headings=headings,
        note="The equation error uses the measured output on the right-hand side and flatters a model whose orders are "
        "close to one another; only the free run shows what the model knows.",
    )


def _four(figures: Metrics) -> list[Cell]:
    return [figures.error, figures.rmse, figures.nr, figures.fit]


# ------------------------------------------------------------------------------------------------ the paper's tables


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
        cells.append([row.label, *orders, *coefficients, *_three(row.equation_error), *_three(row.output_error)])
    return Table(
        title,
        ("model", *(symbol_html(n) for n in (*_ORDERS, *_COEFFICIENTS)), *_FIGURES[:3], *_FIGURES[:3]),
        cells,
        groups=(("", 1), ("orders", 4), ("coefficients", 4), ("equation error", 3), ("output error (free run)", 3)),
        headings={i: symbol_html(output) for i, output in _halves(rows).items()},
    )


def _three(figures: Metrics | None) -> list[Cell]:
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


# ------------------------------------------------------------------------------------------------ order searches


def search_summary(searches: Mapping[str, SearchResult], *, title: str = "What became of the candidates") -> Table:
    """Return what became of every candidate: kept, or left out for a reason; kept and left out are all candidates."""
    reasons = list(dict.fromkeys(reason for s in searches.values() for reason in s.pruned))
    rows: list[list[Cell]] = [
        [
            _search_name(name), s.settings["criterion"], s.candidates, len(s.table),
            *(s.pruned.get(reason, 0) for reason in reasons),
        ]
        for name, s in searches.items()
    ]  # fmt: skip
    return Table(
        title,
        ("search", "ranked by", "candidates", "kept", *reasons),
        rows,
        groups=(("", 4), ("left out", len(reasons))) if reasons else (),
        note="Every candidate of the lattice is kept or counted under a reason. “beaten” and “stopped early” were "
        "worse than the last row kept.",
    )


def search_top(name: str, search: SearchResult, *, rows: int = 10, title: str = "") -> Table:
    """Return the first rows of an order search.

    Parameters
    ----------
    name
        Output searched, or ``"stage"``.
    search
        The search.
    rows
        Most rows.
    title
        Caption; by default it names the search.
    """
    law = len(search.model.equations) > 1
    score = {"l1": "error (45)", "l2": "RMSE"}.get(search.settings["norm"], "score")
    orders, coefficients = list(search.orders), list(search.coefficients)
    kept = search.table[:rows]
    return Table(
        title or f"Best {len(kept)} of {number(search.candidates)} candidates: {_search_name(name)}",
        ("rank", "score" if law else score, *map(symbol_html, orders), *map(symbol_html, coefficients)),
        [
            [r.rank, r.score, *(Exact(r.orders[n]) for n in orders), *(r.coefficients[n] for n in coefficients)]
            for r in kept
        ],
        groups=(("", 2), ("orders", len(orders)), ("coefficients", len(coefficients))),
        note=f"The score is the sum over the equations of each one's {score}, divided by the spread of its output."
        if law
        else "",
    )


def _search_name(name: str) -> str:
    return "whole stage, under its order law" if name == "stage" else symbol(name)
