"""HTML page and terminal summary of the reproduction: tables with computed values beside the printed ones, sections.

Their texts are in page.toml.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from ftlm.arm.flexible_link import PARAMETER_SETS
from ftlm.errors import ModelError
from ftlm.model.model import Model
from ftlm.plot.model_charts import bode_charts, response_frequencies
from ftlm.report.html_report import estimates_table, grouped_findings
from ftlm.report.typesetting import equation_html
from ftlm.reproduction import figures
from ftlm.reproduction import published_values as printed
from ftlm.reproduction.checks import deviation_text, table_3_coefficients
from ftlm.reproduction.published_values import (
    ANGLE_NAMES,
    COEFFICIENT_LETTERS,
    ORDER_LETTERS,
    PRIOR_COVARIANCES,
    WEAK_PRIOR,
    parameter_name,
    prior_text,
    read_texts,
)
from ftlm.reproduction.simulated_arm import letter_of
from ftlm.reproduction.stage import (
    COARSE_INCREMENT,
    MULTI_INNOVATION_LABELS,
    REFINED_CANDIDATES,
    RIVAL_ALPHA,
    TRACE_EVERY,
    Candidate,
    Stage,
)
from ftlm.structure.equation import format_equation
from ftlm.svg.html_page import Section, Table, write_page
from ftlm.utils.files import check_free
from ftlm.utils.formatting import SUPERSCRIPT_DIGITS, Cell, Exact, number, symbol, symbol_html
from ftlm.validation.comparison import Metrics

if TYPE_CHECKING:
    from ftlm.reproduction.reproduction import Reproduction

PAPER_REFERENCE = (
    "Wang, Li, Li, Liang, Gao: Establishment and Identification of Fractional-Order Model for Structurally Symmetric "
    "Flexible Two-Link Manipulator System, Symmetry 2025, 17, 1072, doi:10.3390/sym17071072"
)
PRINTED_NOTE = "Rows in which “printed” stands are the paper's numbers, from the authors' arm; all others are computed."
OPTIMIZER_LABELS = {"genetic": "genetic algorithm", "differential evolution": "differential evolution"}
_STRONG_PRIOR, _WEAK_PRIOR = (Markup("<i>K</i><sub>0</sub> = {}").format(prior_text(k)) for k in PRIOR_COVARIANCES)
#: Heads of columns that page.toml names by @.
COLUMN_HEADS: Mapping[str, Sequence[str]] = {
    "@numbers": tuple(map(symbol_html, (*ORDER_LETTERS, *COEFFICIENT_LETTERS))),
    "@coefficients": tuple(map(symbol_html, COEFFICIENT_LETTERS)),
    "@criteria": ("error (45)", "RMSE", "NR"),
    "@strong_prior": (_STRONG_PRIOR,),
    "@weak_prior": (_WEAK_PRIOR,),
    "@curve": (Markup("<i>x p</i> / (<i>p</i> + <i>c</i>)"),),
}


def make_table(
    key: str,
    rows: Iterable[Sequence[Any]] | Mapping[str, Iterable[Sequence[Any]]],
    heads: Mapping[str, Sequence[str]] | None = None,
    **fields: Any,
) -> Table:
    """Return a table of page.toml.

    Parameters
    ----------
    key
        Key of the table in page.toml.
    rows
        Rows, or the rows of every angle by name, or those of other groups by heading.
    heads
        Heads of columns besides `COLUMN_HEADS`.
    **fields
        Values of the placeholders in its title and note.
    """
    texts = read_texts("page")["tables"][key]
    heads_by_name = {**COLUMN_HEADS, **(heads or {})}
    columns = [head for name in texts["columns"] for head in heads_by_name.get(name, (name,))]
    title, note = (texts.get(name, "").format(printed_note=PRINTED_NOTE, **fields) for name in ("title", "note"))
    options = {name: texts[name] for name in ("groups", "wrap", "stacked") if name in texts}
    if isinstance(rows, Mapping):
        groups: dict[str, list[Any]] = {
            symbol_html(name) if name in ANGLE_NAMES else name: list(each) for name, each in rows.items()
        }
        return Table.from_groups(title, columns, groups, note=note, **options)
    return Table(title, columns, list(rows), note=note, **options)


def make_section(key: str, *paragraphs: str, fields: Mapping[str, Any] | None = None, **content: Any) -> Section:
    """Return a section of page.toml with these fields; further paragraphs follow its own, `content` is a section's."""
    texts = read_texts("page")["sections"][key]
    if fields is not None:
        texts = {
            n: v.format(**fields) if isinstance(v, str) else [p.format(**fields) for p in v] for n, v in texts.items()
        }
    options = {"fold": texts["fold"]} if "fold" in texts else {}
    return Section(texts["heading"], [*texts.get("paragraphs", ()), *paragraphs], **options, **content)


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


def printed_head(words: str) -> Markup:
    """Return the head of a row of printed values."""
    return Markup("<em>printed: {}</em>").format(words)


def printed_cells(words: str, row: printed.PublishedRow, *, criteria: bool = True) -> list[Cell]:
    """Cells of a row of the paper."""
    cells = [printed_head(words), *number_cells(row.orders, row.coefficients)]
    return [*cells, *row.criteria] if criteria else cells


def computed_cells(candidate: Candidate, output: str) -> list[Cell]:
    """Orders, and coefficients at least as large as their standard errors, of one equation."""
    orders, coefficients = letters_of(candidate.model, output)
    errors = {} if candidate.result is None else candidate.result.standard_errors
    identifiable = {n: v for n, v in coefficients.items() if not errors.get(parameter_name(n, output), 0.0) > abs(v)}
    return number_cells(orders, identifiable)


def model_table(stage: Stage) -> Table:
    """Table 4 or 5, with computed and printed rows."""

    def rows(output: str) -> Iterator[list[Cell]]:
        beside = {"integer, Euler": printed.INTEGER_ROWS[output]}
        beside |= {f"p = {p}": row for p, row in printed.FRACTIONAL_ROWS[output].items()}
        for label, c in stage.candidates.items():
            yield [label, *computed_cells(c, output), *criteria_cells(c.estimation.output_error.get(output))]
            if label in beside:
                yield printed_cells(label.partition(",")[0], beside[label])

    return make_table("models", {o: rows(o) for o in stage.outputs}, table=3 + stage.number, stage=stage.number)


def fits_table(stage: Stage) -> Table:
    """Table of both errors of every model, and its fits on both runs by the method's inputs and by the current."""

    def rows(output: str) -> Iterator[list[Cell]]:
        for label, c in stage.candidates.items():
            errors = c.estimation.equation_error[output].nr, c.estimation.output_error[output].nr
            driven = [None if part is None else part.output_error[output].fit for part in (c.estimation, c.validation)]
            alone = [figures[output].fit for figures in c.input_driven.values()]
            yield [label, *errors, *driven, *alone, *[None] * (2 - len(alone))]

    return make_table("fits", {o: rows(o) for o in stage.outputs}, stage=stage.number)


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
    return [make_table("symbols", symbols), make_table("steps", steps)]


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
        if (fields_by_stem := fields.get(stem.rstrip("_"))) is not None:
            effective = Exact(getattr(PARAMETER_SETS["effective"][stage], fields_by_stem[place[0] - 1 if place else 0]))
        name_html = Markup("<i>{}</i><sub>{}</sub>").format(name[0], name.partition("_")[2])
        rows.append([name_html, Exact(value), unit, effective, value / effective if effective else None])
    coefficients = table_3_coefficients().items()
    ratios = ([symbol_html(n), t + 0.0, e + 0.0, p, t / p, e / p] for n, (t, e, p) in coefficients)
    return [make_table("parameters", rows), make_table("coefficients", ratios)]


def saturation_table(reproduction: Reproduction) -> Table:
    """Coefficient a by innovation length p, with the paper's prior and with a weak one."""

    def rows(stage: Stage, output: str) -> Iterator[list[Cell]]:
        name = parameter_name("a", output)
        of_p = {p: stage.candidates[f"p = {p}"].model for p in printed.INNOVATION_LENGTHS}
        last = letters_of(of_p[printed.INNOVATION_LENGTHS[-1]], output)[0]
        x, c, _ = printed.printed_saturation(output)
        for p, model in of_p.items():
            alike = "yes" if letters_of(model, output)[0] == last else "no"
            weak = stage.weak[output][p][name] if stage.weak else None
            printed_value = printed.FRACTIONAL_ROWS[output][p].coefficients["a"]
            yield [f"p = {p}", model.coefficients[name], alike, weak, printed_value, x * p / (p + c)]

    return make_table("saturation", {output: rows(stage, output) for stage, output in reproduction.angles})


def optimizer_tables(reproduction: Reproduction) -> list[Table]:
    """Tables 6 and 7 at equal budgets, and the error (45) of each optimizer and seed."""
    rivals = reproduction.rivals
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

    return [
        make_table("genetic", best),
        make_table("optimizers", {o: errors(o) for o in rivals}, alpha=RIVAL_ALPHA),
        make_table("seeds", {o: errors_by_seed(o) for o in rivals}, {"@seeds": [f"seed {s}" for s in seeds]}),
    ]


def printed_reading_table(reproduction: Reproduction, stage: Stage) -> Table:
    """Table 4 or 5 as the paper computed it: recomputed, printed, and their ratio."""

    def rows(output: str) -> Iterator[list[Cell]]:
        for p, row in reproduction.as_printed[output].rows.items():
            printed_row = printed.FRACTIONAL_ROWS[output][p]
            ours = [*map(row.coefficients.get, COEFFICIENT_LETTERS), *criteria_cells(row.equation)]
            theirs = [*map(printed_row.coefficients.get, COEFFICIENT_LETTERS), *printed_row.criteria]
            pairs = zip(ours, theirs, strict=True)
            ratios = [number(float(a) / b, 3) if a is not None and b else None for a, b in pairs]
            yield [f"p = {p}", *ours]
            yield [printed_head(f"p = {p}"), *theirs]
            yield ["ours / printed", *ratios]

    tables = {symbol(o): reproduction.as_printed[o] for o in stage.outputs}
    return make_table(
        "as_printed",
        {o: rows(o) for o in stage.outputs},
        table=3 + stage.number,
        settings="; ".join(
            f"{o}: {t.reading} ({printed.TERM_INTERPRETATIONS[t.reading.terms]})" for o, t in tables.items()
        ),
        scales=", ".join(f"{o} by {t.scale:.3g}" for o, t in tables.items()),
    )


def printed_runs_table(reproduction: Reproduction) -> Table:
    """Table of the printed models under the paper's own current."""

    def rows(output: str) -> Iterator[list[Cell]]:
        for r in reproduction.ran:
            if r.output == output:
                back = [r.returned_coefficients.get(k, {}).get(parameter_name("a", output)) for k in PRIOR_COVARIANCES]
                deviations = r.angle_deviation, r.single_equation_deviation, r.implied_deviation, r.deviation_ratio
                printed_value = printed.FRACTIONAL_ROWS[output][r.p].coefficients["a"]
                yield [f"p = {r.p}", Exact(r.stability.unstable_poles), *deviations, printed_value, *back]

    return make_table("printed_models", {o: rows(o) for o in dict.fromkeys(r.output for r in reproduction.ran)})


def case_tables(reproduction: Reproduction) -> list[Table]:
    """Tables of error and steps by p, arm, K0 and angle, first record of each arm, and of integer and free orders."""
    rows: dict[tuple[str, str, float], list[Cell]] = {}
    for t in reproduction.panel.trials:
        steps = [None if math.isinf(v) else Exact(v) for v in t.convergence_steps.values()]
        head = f"{t.arm}, {symbol(t.output)}, K₀ = {prior_text(t.prior)}"
        rows.setdefault((t.arm, t.output, t.prior), [head, *t.errors.values(), *steps, t.nr, t.manual])
    orders = (
        [f"{f.arm}, {symbol(o)}", f.integer_nr[o], f.free_nr[o], f.fractional_text]
        for f in reproduction.panel.order_comparisons
        for o in f.free_nr
    )
    return [make_table("trials", rows.values(), weak_prior=WEAK_PRIOR), make_table("order_comparisons", orders)]


def typeset(words: str) -> str:
    """Typeset numbers in a text: powers of ten, minus signs, K₀."""
    powers = re.sub(r"(?<=\d)e([+-]\d+)\b", lambda e: f"·10{str(int(e[1])).translate(SUPERSCRIPT_DIGITS)}", words)
    return re.sub(r"(?<![\w.])-(?=\d)", "−", powers).replace("K0", "K₀")


def joint_equations(model: Model) -> list[str]:
    """Return the equations of a joint model as paragraphs."""
    words = "(14)–(15) by joint output error, order law and coefficient law imposed:"
    return [words, *(equation_html(e, model.structure.delay, model.structure.limits) for e in model.equations)]


def _verdict_section(reproduction: Reproduction) -> Section:
    """Section with one line per check, and the cases in a collapsed part."""
    rows: list[list[Cell]] = [
        [
            typeset(c.claim),
            Markup("<strong>{}</strong>").format(typeset(c.verdict)),
            figures.share_picture(c.ruling),
            typeset(c.brief),
        ]
        for c in reproduction.checks
    ]
    numbers = ([typeset(text) for text in (c.claim, c.computed, c.printed, c.rule)] for c in reproduction.checks)
    missing = "No second run was given: nothing is validated, Figure 10 is left out."
    return make_section(
        "verdicts",
        tables=[make_table("verdicts", rows)],
        warnings=[missing] * (reproduction.sine is None),
        folded_tables=[make_table("claims", numbers), *case_tables(reproduction)],
    )


def _stage_section(reproduction: Reproduction, stage: Stage) -> Section:
    number, joint = stage.number, stage.candidates["output error"]
    tables = [model_table(stage), estimates_table(joint.result, reproduction.truth.get(number, {})), fits_table(stage)]
    warned = [w.partition(": ") for w in grouped_findings({label: c.result for label, c in stage.candidates.items()})]
    if warned:
        rows = ([Markup("{}").format(models), typeset(words)] for models, _, words in warned)
        tables.append(make_table("warnings", rows, stage=number))
    return make_section(
        "stage",
        *joint_equations(joint.model),
        fields={"stage": number, "table": 3 + number, "warnings": ", warnings" if warned else ""},
        figures=figures.stage_figures(stage, simulated=reproduction.simulated),
        folded_tables=tables,
    )


def _sections(reproduction: Reproduction) -> list[Section]:
    """All sections in their order; those without content are left out."""
    simulated, stages = reproduction.simulated, list(reproduction.stages.values())
    near = [
        figures.fit_chart(
            [("printed orders", s.printed_orders.estimation)],
            s.outputs[1],
            f"{symbol(s.outputs[1])}: the orders of Table {3 + s.number} with the best coefficients for this run",
            simulated=simulated,
        )
        for s in stages
    ]
    weak = [
        figures.convergence_chart(t, f"{symbol(o)}: error (45), weak prior")
        for s in stages
        for o, t in s.weak_traces.items()
    ]
    landscapes = {s.number: s.landscape for s in stages if s.landscape is not None}
    correlated = [
        f"Stage {n}: the two orders that this run distinguishes least are {symbol(each.names[0])} and "
        f"{symbol(each.names[1])} (correlation {number(each.correlation, 3)})."
        for n, each in landscapes.items()
    ]
    joint = [s.candidates["output error"].model for s in stages]
    bode = [
        c
        for m in joint
        for c in bode_charts(m, response_frequencies(m, reproduction.square.step, reproduction.square.duration))
    ]
    sentences = [f"Standard deviations implied by RMSE / NR over those of the models: {deviation_text(reproduction)}."]
    every = [
        _verdict_section(reproduction),
        make_section(
            "printed_models",
            *(sentences if reproduction.ran else ()),
            figures=figures.printed_model_charts(reproduction),
            folded_tables=[printed_runs_table(reproduction)],
        ),
        make_section("as_printed", folded_tables=[printed_reading_table(reproduction, stage) for stage in stages]),
        *(_stage_section(reproduction, stage) for stage in stages),
    ]
    if reproduction.sine is not None:
        every.append(make_section("sine", figures=figures.sine_figures(reproduction)))
    if reproduction.rivals:
        charts = figures.rival_figures(reproduction)
        every.append(make_section("optimizers", figures=charts, folded_tables=optimizer_tables(reproduction)))
    derived = [figures.derivative_chart(s.derived, simulated=simulated) for s in stages]
    return [
        *every,
        make_section("innovation_length", figures=weak, small=True, folded_tables=[saturation_table(reproduction)]),
        make_section("close_orders", figures=near),
        make_section("dropped_derivative", figures=derived),
        make_section("landscape", *correlated, figures=[*landscapes.values()], small=True),
        make_section("frequency_response", figures=bode, small=True),
        make_section("parameters", folded_tables=parameter_tables()),
        make_section("description", figures=[figures.flow_chart()], folded_tables=description_tables()),
        _runs_section(reproduction),
    ]


def _runs_section(reproduction: Reproduction) -> Section:
    rows: list[list[Cell]] = []
    for run in reproduction.runs:
        currents = (f"{symbol(n)} ±{np.max(np.abs(run[n])):.3g} {run.units[n]}" for n in run.inputs)
        rows.append([run.name, run.length, Exact(run.step), run.duration, ", ".join(currents)])
    fields = {
        "m": next(iter(reproduction.stages.values())).candidates["p = 7"].estimation.m,
        "increment": reproduction.order_grid.increment,
        "alpha": reproduction.order_grid.alpha,
        "trace_every": TRACE_EVERY,
        "coarse_increment": COARSE_INCREMENT,
        "refined_candidates": REFINED_CANDIDATES,
    }
    return make_section("runs", *reproduction.notes, fields=fields, tables=[make_table("runs", rows)])


def reproduction_page(reproduction: Reproduction, path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write the reproduction as one HTML page; see :meth:`ftlm.Reproduction.page`."""
    check_free(path, force=force)
    names = " and ".join(f"“{run.name}”" for run in reproduction.runs)
    origin = (
        "a simulated arm whose links move with their hubs, truth known,"
        if reproduction.simulated
        else f"the runs {names},"
    )
    strongest = (
        f"The printed models, run under the paper's current: {reproduction.checks[0].brief}. "
        if reproduction.ran
        else ""
    )
    lead = (
        f"Section 5 of the paper, recomputed on {origin} beside what the paper prints. {typeset(strongest)}Numbers in "
        f"rows marked “printed” are the paper's; every other number, figure and verdict on this page is computed. "
        f"{PAPER_REFERENCE}."
    )
    return write_page(path, title="The paper reproduced", sections=_sections(reproduction), lead=lead, force=force)


def fits_text(models: Mapping[str, Candidate], label: int, widths: Sequence[int]) -> list[str]:
    """Fits of the free runs in percent as text, one line per model, in columns of these widths."""
    lines = []
    for name, candidate in models.items():
        texts = ("–" if math.isnan(fit) else f"{fit:.2f}" for fit in candidate.fits)
        lines.append(name.ljust(label) + "".join(text.rjust(w) for text, w in zip(texts, widths, strict=True)))
    return lines


def reproduction_text(reproduction: Reproduction) -> str:
    """Summary for a terminal: checks, and fits."""
    lines = []
    for check in reproduction.checks:
        lines += [f"{check.verdict.upper()}: {check.claim}", f"    {check.brief}"]
    for stage in reproduction.stages.values():
        lines += ["", f"Stage {stage.number}: fit of the free run in percent, driven as identified"]
        lines.append(" " * 26 + "".join(f"{o + run:>16}" for o in stage.outputs for run in (" square", " sine")))
        lines += fits_text(stage.candidates, 26, [16] * 4)
        best = stage.candidates["output error"].model
        lines += [f"  {format_equation(e, best.structure.describe_inputs('.6g'))}" for e in best.equations]
    return "\n".join([*lines, *(f"note: {n}" for n in reproduction.notes)])
