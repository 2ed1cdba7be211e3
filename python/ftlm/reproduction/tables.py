"""Tables in the form of the paper's, computed values beside the printed ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from ftlm.arm.flexible_link import PARAMETER_SETS
from ftlm.errors import ModelError
from ftlm.model.model import Model
from ftlm.reproduction import published_values as printed
from ftlm.reproduction.checks import table_3_coefficients
from ftlm.reproduction.published_values import COEFFICIENT_LETTERS, ORDER_LETTERS, parameter_name
from ftlm.reproduction.simulated_arm import letter_of
from ftlm.reproduction.stage_result import (
    MULTI_INNOVATION_LABELS,
    PRIOR_COVARIANCES,
    RIVAL_ALPHA,
    WEAK_PRIOR,
    Candidate,
    Stage,
    prior_text,
)
from ftlm.svg.html_page import NOT_IN_MODEL, Table
from ftlm.utils.formatting import (
    DIVERGED_TEXT,
    SIGNIFICANT_DIGITS,
    Cell,
    Exact,
    number,
    symbol,
    symbol_html,
    truncate_text,
)
from ftlm.validation.comparison import Comparison, Metrics

if TYPE_CHECKING:
    from ftlm.reproduction.reproduction import Reproduction

#: Heads of the columns of parameters and criteria, and groups of the parameter columns.
NUMBER_HEADS = tuple(map(symbol_html, (*ORDER_LETTERS, *COEFFICIENT_LETTERS)))
CRITERION_HEADS = ("error (45)", "RMSE", "NR")
COLUMN_GROUPS = (("", 1), ("orders", 4), ("coefficients", 4))
PRIOR_HEADS = tuple(Markup("<i>K</i><sub>0</sub> = {}").format(prior_text(k)) for k in PRIOR_COVARIANCES)
OPTIMIZER_LABELS = {"genetic": "genetic algorithm", "differential evolution": "differential evolution"}
PRINTED_NOTE = "Rows in which “printed” stands are the paper's numbers, from the authors' arm; all others are computed."


@dataclass(frozen=True)
class PaperRow:
    """Row of a table in the form of the paper's Tables 4 and 5.

    Parameters
    ----------
    label
        Label, such as "integer order" or "p = 7".
    output
        Output of the equation.
    orders
        ``alpha``, ``beta``, ``gamma``, ``mu``; orders of absent terms are missing.
    coefficients
        ``a``, ``b``, ``d``, ``g``, likewise.
    equation_error, output_error, validation
        Errors on the estimation run, and output error on another run; None if they were not computed.
    """

    label: str
    output: str
    orders: Mapping[str, float]
    coefficients: Mapping[str, float]
    equation_error: Metrics | None
    output_error: Metrics | None
    validation: Metrics | None = None


def letters_of(model: Model, output: str) -> tuple[dict[str, float], dict[str, float]]:
    """Orders and coefficients of the equation of one angle by letter.

    Raises
    ------
    ModelError
        No such output.
    """
    item = next((e for e in model.equations if e.output == output), None)
    if item is None:
        raise ModelError(f"the model has no output {output!r}; it has {', '.join(model.outputs)}")
    orders, coefficients = {"alpha": item.order.constant}, {}
    for term in item.terms:
        letter = letter_of(term.name or "")
        if letter in COEFFICIENT_LETTERS:
            coefficients[letter] = float(term.coefficient) + 0.0
        if letter in printed.ORDER_OF:
            orders[printed.ORDER_OF[letter]] = term.order.constant
    return orders, coefficients


def number_cells(orders: Mapping[str, float], coefficients: Mapping[str, float]) -> list[Cell]:
    """Cells under `NUMBER_HEADS`: orders to the four decimals of the paper's Table 6, coefficients as estimates."""
    cells = [Exact(round(orders[n], 4) + 0.0) if n in orders else None for n in ORDER_LETTERS]
    return [*cells, *map(coefficients.get, COEFFICIENT_LETTERS)]


def criteria_cells(figures: Metrics | None) -> list[Cell]:
    """Cells under `CRITERION_HEADS`."""
    return [None] * 3 if figures is None else [figures.error, figures.rmse, figures.nr]


def paper_row(
    label: str, model: Model, comparison: Comparison, output: str, validation: Comparison | None = None
) -> PaperRow:
    """Return the row of one equation of an arm's model with coefficients a, b, d, g and an index.

    Raises
    ------
    ModelError
        No such output.
    """
    errors = comparison.equation_error.get(output), comparison.output_error.get(output)
    prediction = None if validation is None else validation.output_error[output]
    return PaperRow(label, output, *letters_of(model, output), *errors, prediction)


def table_by_angle(
    title: str,
    columns: Sequence[str],
    outputs: Iterable[str],
    rows: Callable[[str], Iterable[Sequence[Cell]]],
    **options: Any,
) -> Table:
    """Return a table with the rows of every angle under its symbol."""
    return Table.from_groups(title, columns, {symbol_html(o): list(rows(o)) for o in dict.fromkeys(outputs)}, **options)


def paper_table(rows: Sequence[PaperRow], *, title: str = "Identified models") -> Table:
    """Return a table in the form of the paper's Tables 4 and 5, with both errors.

    Parameters
    ----------
    rows
        For each output the integer-order model, then one row for each p; rows of one output are adjacent.
    title
        Caption.
    """

    def cells(output: str) -> Iterator[list[Cell]]:
        for row in rows:
            if row.output == output:
                errors = [*criteria_cells(row.equation_error), *criteria_cells(row.output_error)]
                yield [row.label, *number_cells(row.orders, row.coefficients), *errors]

    return table_by_angle(
        title,
        ("model", *NUMBER_HEADS, *CRITERION_HEADS, *CRITERION_HEADS),
        [row.output for row in rows],
        cells,
        groups=(*COLUMN_GROUPS, ("equation error", 3), ("output error (free run)", 3)),
    )


#: Column widths of the text: label, four orders, four coefficients, twice error, RMSE, NR. Together 119 of 120.
_LABEL_WIDTH, _TEXT_WIDTHS = 17, (5,) * 4 + (9,) * 4 + (8, 8, 7) * 2


def paper_table_text(rows: Sequence[PaperRow]) -> str:
    """Return the same table as text of 120 columns; numbers lose digits in narrow columns."""
    heads = [*map(symbol, (*ORDER_LETTERS, *COEFFICIENT_LETTERS)), *("error", "RMSE", "NR") * 2]
    left, right = sum(_TEXT_WIDTHS[:8]) + _LABEL_WIDTH, sum(_TEXT_WIDTHS[8:11])
    groups = (f" {words} ".center(right - 1, "-").rjust(right) for words in ("equation error", "free run"))
    lines = [
        " " * left + "".join(groups),
        "model".ljust(_LABEL_WIDTH) + "".join(h.rjust(w) for h, w in zip(heads, _TEXT_WIDTHS, strict=True)),
    ]
    table, infinite = paper_table(rows), False
    for i, (label, *cells) in enumerate(table.rows):
        if i in table.headings:
            lines.append(symbol(rows[i].output))
        numbers = "".join(
            _fit_to_width(v, width - 1).rjust(width) for v, width in zip(cells, _TEXT_WIDTHS, strict=True)
        )
        lines.append(f"  {truncate_text(str(label), _LABEL_WIDTH - 3)}".ljust(_LABEL_WIDTH) + numbers)
        infinite = infinite or any(isinstance(v, float) and not math.isfinite(v) for v in cells)
    if infinite:
        lines.append(f"∞: {DIVERGED_TEXT}, the response leaves the range of numbers")
    return "\n".join(lines)


def _fit_to_width(value: Cell, width: int) -> str:
    """Format a number with as many of its five digits as fit."""
    if value is None or isinstance(value, str):
        return NOT_IN_MODEL
    if not math.isfinite(value):
        return "?" if math.isnan(value) else "∞"
    texts = [f"{value:.{n}g}".replace("e-0", "e-").replace("e+0", "e") for n in range(SIGNIFICANT_DIGITS, 0, -1)]
    return next((t for t in texts if len(t) <= width), texts[-1])


def printed_head(words: str) -> Markup:
    """Return the head of a row of printed values."""
    return Markup("<em>printed: {}</em>").format(words)


def printed_cells(words: str, row: printed.PublishedRow, *, criteria: bool = True) -> list[Cell]:
    """Cells of a printed row."""
    cells = [printed_head(words), *number_cells(row.orders, row.coefficients)]
    return [*cells, *row.criteria] if criteria else cells


def computed_cells(candidate: Candidate, output: str) -> list[Cell]:
    """Orders, and coefficients at least as large as their standard errors, of one equation."""
    orders, coefficients = letters_of(candidate.model, output)
    errors = {} if candidate.result is None else candidate.result.standard_errors
    known = {n: v for n, v in coefficients.items() if not errors.get(parameter_name(n, output), 0.0) > abs(v)}
    return number_cells(orders, known)


def model_table(stage: Stage, title: str) -> Table:
    """Table 4 or 5, with computed and printed rows."""

    def rows(output: str) -> Iterator[list[Cell]]:
        beside = {"integer, Euler": printed.INTEGER_ROWS[output]}
        beside |= {f"p = {p}": row for p, row in printed.FRACTIONAL_ROWS[output].items()}
        for label, c in stage.candidates.items():
            yield [label, *computed_cells(c, output), *criteria_cells(c.estimation.output_error.get(output))]
            if label in beside:
                yield printed_cells(label.partition(",")[0], beside[label])

    return table_by_angle(
        title,
        ("model", *NUMBER_HEADS, *CRITERION_HEADS),
        stage.outputs,
        rows,
        groups=(*COLUMN_GROUPS, ("output error (free run)", 3)),
        note="Inputs of the free runs: the current and the measured other angle for rows of p, least squares and "
        "instrumental variables; the current alone for the manual's integer model (by explicit Euler at the run's "
        "step, and exactly), integer orders identified and output error. The last two have (14)–(15), whose deflection "
        "moves with the hub and has no current; all other rows have the paper's (22)–(25). Errors in rad. –: not in "
        "the model, or a coefficient that its own standard error exceeds. " + PRINTED_NOTE,
    )


def fits_table(stage: Stage) -> Table:
    """Table of both errors of every model, and its fits on both runs by the method's inputs and by the current."""

    def rows(output: str) -> Iterator[list[Cell]]:
        for label, c in stage.candidates.items():
            errors = c.estimation.equation_error[output].nr, c.estimation.output_error[output].nr
            driven = [None if part is None else part.output_error[output].fit for part in (c.estimation, c.validation)]
            alone = [figures[output].fit for figures in c.input_driven.values()]
            yield [label, *errors, *driven, *alone, *[None] * (2 - len(alone))]

    return table_by_angle(
        f"Stage {stage.number}: both errors, and the fit of the free run on both inputs",
        ("model", "equation error", "free run", "square", "sine", "square", "sine"),
        stage.outputs,
        rows,
        groups=(("", 1), ("NR on the square", 2), ("fit %, driven as identified", 2), ("fit %, current alone", 2)),
        note="Everything was identified from the square run. 100 is perfect, 0 is as good as the mean.",
    )


def description_tables() -> list[Table]:
    """Tables 1 and 2: symbols, and every step with its function."""
    steps = [
        [
            f"{k}. {each['step']}",
            Markup(", ").join(Markup("<code>{}</code>").format(f) for f in each["functions"].split(", ")),
            each["how"],
        ]
        for k, each in enumerate(printed.read_paper_table("paper_procedure.csv"), 1)
    ]
    symbols = [list(each.values()) for each in printed.read_paper_table("paper_symbols.csv")]
    return [
        Table("Table 1. Symbols", ("symbol", "what it is", "name here"), symbols, wrap=True),
        Table("Table 2. The seven steps, with the functions of ftlm", ("step", "function", "how"), steps, wrap=True),
    ]


def parameter_tables() -> list[Table]:
    """Table 3 beside the manufacturer's effective parameters, and the coefficients that follow from both."""
    fields = {
        "J": ("hub_inertia", "link_inertia"),
        "B": ("hub_friction", "link_friction"),
        "K_s": ("stiffness",),
        "K_τ": ("torque_constant",),
    }
    rows: list[list[Cell]] = []
    for name, (value, unit) in printed.TABLE_3.items():
        stem = letter_of(name)
        stage, *place = map(int, name[len(stem) :])
        effective = None
        if (known := fields.get(stem.rstrip("_"))) is not None:
            effective = Exact(getattr(PARAMETER_SETS["effective"][stage], known[place[0] - 1 if place else 0]))
        shown = Markup("<i>{}</i><sub>{}</sub>").format(name[0], name.partition("_")[2])
        rows.append([shown, Exact(value), unit, effective, value / effective if effective else None])
    return [
        Table(
            "Table 3. Parameters: printed, and the manufacturer's effective ones",
            ("parameter", "printed", "printed unit", "effective, SI", "printed / effective"),
            rows,
            note="Effective torque constants include gear ratio and efficiency. Lengths enter no equation.",
        ),
        Table(
            "Coefficients of the integer-order models",
            (
                "coefficient",
                "from Table 3",
                "effective set",
                "in Tables 4, 5",
                "Table 3 / printed",
                "effective / printed",
            ),
            [[symbol_html(n), t + 0.0, e + 0.0, p, t / p, e / p] for n, (t, e, p) in table_3_coefficients().items()],
        ),
    ]


def saturation_table(found: Reproduction) -> Table:
    """Coefficient a by innovation length p, with the paper's prior and with a weak one."""

    def rows(output: str) -> Iterator[list[Cell]]:
        stage, name = found.stages[printed.stage_of(output)], parameter_name("a", output)
        of_p = {p: stage.candidates[f"p = {p}"].model for p in printed.INNOVATION_LENGTHS}
        last = letters_of(of_p[printed.INNOVATION_LENGTHS[-1]], output)[0]
        x, c, _ = printed.printed_saturation(output)
        for p, model in of_p.items():
            alike = "yes" if letters_of(model, output)[0] == last else "no"
            weak = stage.weak[output][p][name] if stage.weak else None
            stated = printed.FRACTIONAL_ROWS[output][p].coefficients["a"]
            yield [f"p = {p}", model.coefficients[name], alike, weak, stated, x * p / (p + c)]

    curve = Markup("<i>x p</i> / (<i>p</i> + <i>c</i>)")
    return table_by_angle(
        "Coefficient a by innovation length",
        ("innovation length", PRIOR_HEADS[0], "orders of p = 7", PRIOR_HEADS[1], "printed", curve),
        [output for _, output in found.angles],
        rows,
        note="The last column is the curve of a prior through the printed values of p = 1 and p = 7. With the weak "
        "prior all p have the orders of p = 7.",
    )


def optimizer_tables(found: Reproduction) -> list[Table]:
    """Tables 6 and 7 at equal budgets, and the error (45) of each optimizer and seed."""
    rivals = found.rivals
    seeds = list(dict.fromkeys(seed for rival in rivals.values() for seed in rival.optimizers["genetic"].errors))
    best: list[list[Cell]] = []
    for output, rival in rivals.items():
        head = Markup("{}, best of {} seeds").format(symbol_html(output), len(rival.optimizers["genetic"].errors))
        best.append([head, *computed_cells(rival.models["genetic"], output)])
        best.append(printed_cells(symbol_html(output), printed.GENETIC_ROWS[output], criteria=False))
    labels = OPTIMIZER_LABELS | {
        n: f"p = 7, K₀ = {prior_text(k)}" for n, k in zip(MULTI_INNOVATION_LABELS, PRIOR_COVARIANCES, strict=True)
    }

    def errors(output: str) -> Iterator[list[Cell]]:
        for label, candidate in rivals[output].models.items():
            own, other = candidate.estimation, candidate.validation
            prediction = criteria_cells(None if other is None else other.output_error[output])
            spread = float(np.std(own.measured[output][0]))
            yield [labels.get(label, label), *criteria_cells(own.output_error[output]), *prediction, spread]
        for k, label in enumerate(("genetic algorithm", "multi-innovation")):
            criteria, implied = map(Exact, printed.TABLE_7_CRITERIA[output][k]), printed.implied_spreads()[output][k]
            yield [printed_head(label), *criteria, None, None, None, implied]

    def errors_by_seed(output: str) -> Iterator[list[Cell]]:
        for name, run in rivals[output].optimizers.items():
            each = max(run.evaluations.values())
            yield [OPTIMIZER_LABELS[name], rivals[output].candidates, each, *map(run.errors.get, seeds)]

    title = "Table 6. Orders and coefficients by the genetic algorithm"
    return [
        Table(title, ("angle", *NUMBER_HEADS), best, groups=COLUMN_GROUPS, note=PRINTED_NOTE),
        table_by_angle(
            "Table 7. Multi-innovation and its rivals: the same record, the same number of candidates",
            ("algorithm", *CRITERION_HEADS, *CRITERION_HEADS, "σ of the angle"),
            rivals,
            errors,
            groups=(("", 1), ("square, identified from", 3), ("sine, never seen", 3), ("", 1)),
            note="Free runs, driven by the current and the measured other angle. All have α from "
            f"{RIVAL_ALPHA[0]:g} to {RIVAL_ALPHA[1]:g}; p = 7 on the whole grid stands in Tables 4 and 5. "
            "Printed σ is RMSE / NR. " + PRINTED_NOTE,
        ),
        table_by_angle(
            "Error (45) by seed",
            ("algorithm", "candidates", "evaluations a seed", *(f"seed {s}" for s in seeds)),
            rivals,
            errors_by_seed,
        ),
    ]


def printed_reading_table(found: Reproduction, stage: Stage) -> Table:
    """Table 4 or 5 as the paper computed it: recomputed, printed, and their ratio."""

    def rows(output: str) -> Iterator[list[Cell]]:
        for p, row in found.as_printed[output].rows.items():
            stated = printed.FRACTIONAL_ROWS[output][p]
            ours = [*map(row.coefficients.get, COEFFICIENT_LETTERS), *criteria_cells(row.equation)]
            theirs = [*map(stated.coefficients.get, COEFFICIENT_LETTERS), *stated.criteria]
            pairs = zip(ours, theirs, strict=True)
            ratios = [number(float(a) / b, 3) if a is not None and b else None for a, b in pairs]
            yield [f"p = {p}", *ours]
            yield [printed_head(f"p = {p}"), *theirs]
            yield ["ours / printed", *ratios]

    made = {symbol(o): found.as_printed[o] for o in stage.outputs}
    settings = "; ".join(f"{o}: {t.reading} ({printed.TERM_INTERPRETATIONS[t.reading.terms]})" for o, t in made.items())
    scales = ", ".join(f"{o} by {t.scale:.3g}" for o, t in made.items())
    return table_by_angle(
        f"Table {3 + stage.number} as printed: multi-innovation at the printed orders, equation errors",
        ("row", *map(symbol_html, COEFFICIENT_LETTERS), *CRITERION_HEADS),
        stage.outputs,
        rows,
        note=f"Closest settings: {settings}. The simulated arm has integer orders and Coulomb friction; its angles are "
        f"scaled to the deviations that the printed RMSE / NR imply ({scales}). " + PRINTED_NOTE,
    )


def printed_runs_table(found: Reproduction) -> Table:
    """Table of the printed models under the paper's own current."""

    def rows(output: str) -> Iterator[list[Cell]]:
        for r in found.ran:
            if r.output == output:
                back = [r.returned_coefficients.get(k, {}).get(parameter_name("a", output)) for k in PRIOR_COVARIANCES]
                deviations = r.angle_deviation, r.single_equation_deviation, r.implied_deviation, r.deviation_ratio
                stated = printed.FRACTIONAL_ROWS[output][r.p].coefficients["a"]
                yield [f"p = {r.p}", Exact(r.stability.unstable_poles), *deviations, stated, *back]

    heads = ("σ, both equations [rad]", "σ, (26) alone [rad]", "σ of the paper's angle [rad]", "times too small")
    return table_by_angle(
        "The printed models of Tables 4 and 5 under the paper's current",
        ("model", "unstable poles", *heads, "a printed", *PRIOR_HEADS),
        [r.output for r in found.ran],
        rows,
        groups=(("", 7), ("a, identified from its own response", 2)),
        note="Square current of 0.3 A, 10 s, from rest. σ of the paper's angle is RMSE / NR of Table 7. Poles are "
        "those of both equations of a stage together. The response is identified without noise, at the printed orders.",
    )


def case_tables(found: Reproduction) -> list[Table]:
    """Tables of error and steps by p, arm, K0 and angle, first record of each arm, and of integer and free orders."""
    rows: dict[tuple[str, str, float], list[Cell]] = {}
    for t in found.panel.trials:
        steps = [None if math.isinf(v) else Exact(v) for v in t.convergence_steps.values()]
        head = f"{t.arm}, {symbol(t.output)}, K₀ = {prior_text(t.prior)}"
        rows.setdefault((t.arm, t.output, t.prior), [head, *t.errors.values(), *steps, t.nr, t.manual])
    orders: list[list[Cell]] = []
    for f in found.panel.order_comparisons:
        for output in f.free_nr:
            head = f"{f.arm}, {symbol(output)}"
            orders.append([head, f.integer_nr[output], f.free_nr[output], f.fractional_text])
    p = [f"p = {p}" for p in printed.INNOVATION_LENGTHS]
    return [
        Table(
            "Multi-innovation on several arms and with both ends of K₀",
            ("arm, angle, K₀", *p, *p, "p = 7", "manual"),
            list(rows.values()),
            groups=(("", 1), ("error (45), free run", 4), ("steps to 2 % of the end of p = 1", 4), ("NR", 2)),
            note="First record of each arm; verdicts are computed from all records. –: never. Weak prior: "
            f"{WEAK_PRIOR:g}.",
        ),
        Table(
            "Integer and free orders of (14)–(15), from the current alone",
            ("arm, angle", "NR, integer orders", "NR, free orders", "orders whose interval excludes the integer one"),
            orders,
            note="Joint output error on one of four rows.",
        ),
    ]
