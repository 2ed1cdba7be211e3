"""HTML page and terminal summary of the reproduction: sections, and tables of computed and printed values.

Printed values are those in the paper. Texts, headings and columns are in page.toml. In this module, p is the innovation
length and K0 the prior covariance of multi-innovation. Equation and table numbers are those of the paper.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from ftlm.arm.flexible_link import ORDER_OF, PARAMETER_SETS
from ftlm.estimation.linear import MultiInnovationTrace, trace_chart
from ftlm.model.model import Model
from ftlm.plot.comparison_charts import error_chart, pulse_times
from ftlm.plot.model_charts import bode_charts, response_frequencies
from ftlm.report.html_report import estimates_table, grouped_findings
from ftlm.report.typesetting import equations_html
from ftlm.reproduction import published_values as printed
from ftlm.reproduction import stage as stage_module
from ftlm.reproduction.checks import ClaimVerdict, deviation_text, table_3_coefficients
from ftlm.reproduction.published_values import COEFFICIENT_LETTERS, ORDER_LETTERS, page_text, parameter_name, prior_text
from ftlm.reproduction.simulated_arm import ANGLE_NAMES, letter_of
from ftlm.reproduction.stage import MULTI_INNOVATION_LABELS, Candidate, DroppedDerivative, Stage
from ftlm.structure.equation import format_equation
from ftlm.svg.figure import Figure, StaticFigure
from ftlm.svg.html_page import NOT_IN_MODEL, Section, Table, read_resource, write_page
from ftlm.svg.line_chart import LineChart
from ftlm.utils.files import check_writable
from ftlm.utils.formatting import (
    DIVERGED_TEXT,
    SIGNIFICANT_DIGITS,
    SUPERSCRIPT_DIGITS,
    Cell,
    Exact,
    format_bound,
    number,
    symbol,
    symbol_html,
    truncate_text,
)
from ftlm.utils.validation import Floats, check_known
from ftlm.validation.comparison import Comparison, Metrics, metrics

if TYPE_CHECKING:
    from ftlm.reproduction.reproduction import Reproduction

OPTIMIZER_LABELS = {"genetic": "genetic algorithm", "differential evolution": "differential evolution"}
_STRONG_PRIOR, _WEAK_PRIOR = (
    Markup("<i>K</i><sub>0</sub> = {}").format(prior_text(k)) for k in printed.PRIOR_COVARIANCES
)
#: Column headings that replace the names beginning with @ in page.toml.
COLUMN_HEADS: Mapping[str, Sequence[str]] = {
    "@numbers": tuple(map(symbol_html, (*ORDER_LETTERS, *COEFFICIENT_LETTERS))),
    "@coefficients": tuple(map(symbol_html, COEFFICIENT_LETTERS)),
    "@criteria": ("error (45)", "RMSE", "NR"),
    "@strong_prior": (_STRONG_PRIOR,),
    "@weak_prior": (_WEAK_PRIOR,),
    "@curve": (Markup("<i>x p</i> / (<i>p</i> + <i>c</i>)"),),
}
#: Maximum number of points per line of a chart, with which a page of some fifty charts stays below 2 MB.
LINE_POINTS = 500
#: Limits of drawn values, because diverging lines would hide all others: excursion relative to that of the reference
#: line, and error of the recursion relative to the largest final error.
MAX_EXCURSION_RATIO, MAX_ERROR_RATIO = 4.0, 1000.0


def angle_chart(
    time: Floats, lines: Sequence[tuple[str, Floats]], output: str, title: str, caption: str, **options: Any
) -> LineChart:
    """Return a chart of lines (label, values) of one angle [rad] over time [s]; `options` are those of LineChart."""
    options = {"points": LINE_POINTS, "caption": caption.replace(" -", " −"), **options}
    return LineChart(time, lines, title=title, x_label="time [s]", y_label=f"{symbol(output)} [rad]", **options)


def fit_chart(
    models: Sequence[tuple[str, Comparison]],
    output: str,
    title: str,
    caption: str = "",
    reference_label: str = "measured",
    **options: Any,
) -> LineChart:
    """Return a chart of a measured (or reference) angle and its simulations by the models (label, comparison).

    Simulated values far outside the range of this angle are omitted, and the caption reports this. `reference_label` is
    the label of its line, and `options` are those of LineChart.
    """
    first = models[0][1]
    measured, time = first.measured[output][0], pulse_times(first)
    middle = float(np.mean(measured))
    limit = MAX_EXCURSION_RATIO * float(np.max(np.abs(measured - middle)))
    lines, remarks = [(reference_label, measured)], []
    for label, comparison in models:
        response = comparison.simulated[output][0]
        with np.errstate(invalid="ignore"):
            response = np.where(np.abs(response - middle) <= limit, response, np.nan)
        out_of_range = np.flatnonzero(np.isnan(response))
        if out_of_range.size:
            remarks.append(f"{label} leaves the drawing after {time[out_of_range[0]]:.2g} s")
        if out_of_range.size < response.size:
            lines.append((label, response))
    words = " ".join(part for part in (caption, "; ".join(remarks) + "." if remarks else "") if part)
    return angle_chart(time, lines, output, title, words, **options)


def printed_model_charts(reproduction: Reproduction) -> list[Figure]:
    """Return one chart per hub angle: simulations of the models printed in the paper, under the paper's current.

    Each chart also has the angle of the simulated arm, scaled to the standard deviation that the paper implies.
    """
    charts: list[Figure] = []
    for output, rows in reproduction.printed_runs_by_output.items():
        if not output.endswith("1"):
            continue
        last = rows[-1]
        caption = page_text("printed_model_caption", table=3 + int(output[-2]), run=last)
        lines = [("simulated arm", last.arm), *((f"printed, p = {r.p}", r.response) for r in rows)]
        title = f"{symbol(output)}: the printed models under the paper's current"
        charts.append(angle_chart(last.time, lines, output, title, caption))
    return charts


def share_picture(ruling: ClaimVerdict) -> Markup:
    """Return a bar chart as SVG: fraction of cases in which a claim holds, per level of the first factor."""
    levels = ruling.levels or (("", ruling.cases, ruling.holding_cases),)
    words = "; ".join(f"{level + ': ' if level else ''}{holding} of {count}" for level, count, holding in levels)
    bar = Markup(
        '<rect class="held" x="0" y="{}" width="{:.1f}" height="8"/><rect x=".5" y="{}" width="87" height="7"/>'
    )
    bars = (bar.format(10 * k, 88 * h / max(count, 1), 10 * k + 0.5) for k, (_, count, h) in enumerate(levels))
    picture = Markup('<svg class="share" viewBox="0 0 88 {}" role="img" aria-label="holds in {}">{}</svg>')
    return picture.format(10 * len(levels) - 2, words, Markup("").join(bars))


def convergence_chart(traces: Mapping[int, MultiInnovationTrace], title: str, *, log_x: bool = True) -> LineChart:
    """Return a chart of the error, eq. (45) of the paper, over the recursion step, one line per innovation length p."""
    end = max(float(t.error[-1]) for t in traces.values())
    labeled_traces, gaps = [], False
    for p, trace in traces.items():
        with np.errstate(invalid="ignore"):
            near = np.where(trace.error <= MAX_ERROR_RATIO * end, trace.error, np.nan)
        near = near if np.isfinite(near).any() else trace.error
        gaps = gaps or bool(np.isnan(near).any())
        labeled_traces.append((f"p = {p}", replace(trace, error=near)))
    figure = trace_chart(labeled_traces, title=title, log_x=log_x)
    words = f"Errors above {MAX_ERROR_RATIO:g} times the last ones are not drawn."
    return replace(figure, caption=f"{figure.caption} {words}".strip()) if gaps else figure


def derivative_chart(derived: DroppedDerivative, reference: str = "simulated arm") -> LineChart:
    """Return a chart of the deflection: reference, simulated by eqs. (14)-(15) of the paper, and by eqs. (22)-(25)."""
    lines = [(reference, derived.measured), ("(14)–(15)", derived.derived), ("(22)–(25)", derived.published)]
    nr = metrics(derived.derived, derived.published).nr
    caption = page_text("derivative_caption", order=derived.order, nr=nr, own=reference, **derived.correlations)
    title = f"{symbol(derived.output)}: which way the link bends"
    return angle_chart(derived.time, lines, derived.output, title, caption)


def _fits_chart(
    models: Mapping[str, Candidate], output: str, place: str, reference: str, *, on_validation_run: bool
) -> Figure:
    """Return a chart of an angle simulated by several models on one run.

    The run is the validation run (`on_validation_run`) or the estimation run. `place` is the number of the paper's
    figure.
    """
    parts = {label: c.validation if on_validation_run else c.estimation for label, c in models.items()}
    compared = [(label, part) for label, part in parts.items() if part is not None]
    fits = ", ".join(f"{label} {format_bound(c.output_error[output].fit, '.4g')} %" for label, c in compared)
    caption = f"Fit: {fits}."
    if output.endswith("2") and any(label.startswith("p = ") for label in models):
        caption += f" {page_text('filtered_rows')}"
    title = f"Figure {place}. {symbol(output)}, {'sine' if on_validation_run else 'square'} input"
    return fit_chart(compared, output, title, caption, reference)


def _comparison_models(stage: Stage) -> dict[str, Candidate]:
    """Return the models in the paper's Figures 6, 9 and 10, by label.

    They are the integer-order model of the manufacturer's manual, multi-innovation with innovation length 7, and output
    error. The first is simulated by Euler's method if the run starts at rest, and exactly otherwise.
    """
    manual = stage.candidates["integer, Euler" if stage.traces else "integer, exact"]
    return {"integer, manual": manual} | {n: stage.candidates[n] for n in (f"p = {printed.LAST_P}", "output error")}


def stage_figures(stage: Stage, reference: str) -> list[Figure]:
    """Return the charts of a joint that correspond to Figures 4 to 6 (joint 1) or 7 to 9 (joint 2) of the paper."""
    first = 4 if stage.number == 1 else 7
    errors = [(f"p = {p}", stage.candidates[f"p = {p}"].estimation) for p in printed.INNOVATION_LENGTHS]
    figures: list[Figure] = []
    for place, output in enumerate(stage.outputs, first):
        title = f"Figure {place}(a). {symbol(output)}: absolute error of the free run"
        figures.append(error_chart(errors, output, title=title, units={output: "rad"}, points=LINE_POINTS))
        if output in stage.traces:
            title = f"Figure {place}(b). {symbol(output)}: error (45) after each step"
            figures.append(convergence_chart(stage.traces[output], title))
    for letter, output in zip("ab", stage.outputs, strict=True):
        number = f"{first + 2}({letter})"
        figures.append(_fits_chart(_comparison_models(stage), output, number, reference, on_validation_run=False))
    return figures


def _place(figure: int, output: str) -> str:
    return f"{figure}({'abcd'[ANGLE_NAMES.index(output)]})"


def sine_figures(reproduction: Reproduction) -> list[Figure]:
    """Return the charts that correspond to Figure 10 of the paper: simulations of every angle on the sine run."""
    reference = reproduction.reference_label
    return [
        _fits_chart(_comparison_models(stage), output, _place(10, output), reference, on_validation_run=True)
        for stage, output in reproduction.angles
    ]


def optimizer_comparison_figures(reproduction: Reproduction) -> list[Figure]:
    """Return the charts that correspond to Figure 11 of the paper: multi-innovation and the genetic algorithm.

    They show the validation run if there is one, otherwise the estimation run.
    """
    names = dict(zip(MULTI_INNOVATION_LABELS, ("p = 7, K₀ = 1", "p = 7, weak prior"), strict=True))
    reference, validated = reproduction.reference_label, reproduction.sine is not None
    figures = []
    for output, comparison in reproduction.optimizer_comparisons.items():
        models = {names.get(n, n): c for n, c in comparison.models.items() if n != "differential evolution"}
        figures.append(_fits_chart(models, output, _place(11, output), reference, on_validation_run=validated))
    return figures


def flow_chart() -> Figure:
    """Return the flow chart of the method (Figure 2 of the paper), with drawings for wide and for narrow screens."""
    wide, narrow = (read_resource(f"flow_chart_{screen}.svg", "ftlm.reproduction") for screen in ("wide", "narrow"))
    return StaticFigure("Figure 2. From the physics to the identified model", Markup(wide), Markup(narrow))  # safe


def make_table(
    key: str,
    rows: Iterable[Sequence[Any]] | Mapping[str, Iterable[Sequence[Any]]],
    heads: Mapping[str, Sequence[str]] | None = None,
    **values: Any,
) -> Table:
    """Return a table with title, note and columns from page.toml, and with the given rows.

    Parameters
    ----------
    key
        Key of the table in page.toml.
    rows
        Rows, or groups of rows by heading. A heading that is the name of an angle is shown as its symbol.
    heads
        Column headings by name, in addition to `COLUMN_HEADS`.
    **values
        Values of the placeholders in title and note.
    """
    texts = printed.read_texts("page")["tables"][key]
    heads = {**COLUMN_HEADS, **(heads or {})}
    columns = [head for name in texts["columns"] for head in heads.get(name, (name,))]
    values["printed_note"] = page_text("printed_note")
    title, note = (texts.get(name, "").format(**values) for name in ("title", "note"))
    options = {name: texts[name] for name in ("groups", "wrap", "stacked") if name in texts}
    if isinstance(rows, Mapping):
        groups = {symbol_html(n) if n in ANGLE_NAMES else n: list(each) for n, each in rows.items()}
        return Table.from_groups(title, columns, groups, note=note, **options)
    return Table(title, columns, list(rows), note=note, **options)


def make_section(key: str, *paragraphs: str, values: Mapping[str, Any] | None = None, **content: Any) -> Section:
    """Return a section of the page with heading and paragraphs from page.toml.

    `values` replace the placeholders in these texts. `paragraphs` are appended, and `content` are other fields of
    :class:`Section`, such as figures and tables.
    """
    texts = printed.read_texts("page")["sections"][key]
    templates = (texts["heading"], texts.get("fold", Section.fold), *texts.get("paragraphs", ()))
    heading, fold, *own = (template.format(**values or {}) for template in templates)
    return Section(heading, [*own, *paragraphs], fold=fold, **content)


def letters_of(model: Model, output: str) -> tuple[dict[str, float], dict[str, float]]:
    """Return (orders, coefficients) of the equation of one angle, by names without index, such as alpha or a.

    Raises
    ------
    ModelError
        If the model has no such output.
    """
    check_known("output", [output], model.outputs)
    item = next(e for e in model.equations if e.output == output)
    terms = {letter_of(term.name or ""): term for term in item.terms}
    orders = {ORDER_OF[letter]: term.order.constant for letter, term in terms.items() if letter in ORDER_OF}
    coefficients = {n: float(term.coefficient) + 0.0 for n, term in terms.items() if n in COEFFICIENT_LETTERS}
    return {"alpha": item.order.constant, **orders}, coefficients


def number_cells(orders: Mapping[str, float], coefficients: Mapping[str, float]) -> list[Cell]:
    """Return eight table cells: the four orders, rounded to four decimals as in Table 6 of the paper, and a, b, d, g.

    Cells of absent orders and coefficients are None.
    """
    cells = [Exact(round(orders[n], 4) + 0.0) if n in orders else None for n in ORDER_LETTERS]
    return [*cells, *map(coefficients.get, COEFFICIENT_LETTERS)]


def criteria_cells(figures: Metrics | None) -> list[Cell]:
    """Return three table cells: error (45), RMSE (46) and NR (47) of the paper; None in each without metrics."""
    return [None] * 3 if figures is None else [figures.error, figures.rmse, figures.nr]


def printed_head(words: str) -> Markup:
    """Return the first cell of a row with values printed in the paper, with the label `words`."""
    return Markup("<em>printed: {}</em>").format(words)


def printed_cells(words: str, row: printed.PublishedRow, *, criteria: bool = True) -> list[Cell]:
    """Return the cells of a table row with values printed in the paper: label, orders, coefficients and criteria."""
    cells = [printed_head(words), *number_cells(row.orders, row.coefficients)]
    return [*cells, *row.criteria] if criteria else cells


def computed_cells(candidate: Candidate, output: str) -> list[Cell]:
    """Return table cells with the orders and coefficients of the equation of one output of a model.

    A coefficient is omitted (None) if its magnitude is below its standard error.
    """
    orders, coefficients = letters_of(candidate.model, output)
    errors = {} if candidate.result is None else candidate.result.standard_errors
    identifiable = {n: v for n, v in coefficients.items() if not errors.get(parameter_name(n, output), 0.0) > abs(v)}
    return number_cells(orders, identifiable)


def model_table(stage: Stage) -> Table:
    """Return the table of a joint that corresponds to Table 4 (joint 1) or 5 (joint 2) of the paper.

    It has a computed row per model, each followed by the printed row if the paper has one.
    """

    def rows(output: str) -> Iterator[list[Cell]]:
        beside = {"integer, Euler": printed.INTEGER_ROWS[output]}
        beside |= {f"p = {p}": row for p, row in printed.FRACTIONAL_ROWS[output].items()}
        for label, c in stage.candidates.items():
            yield [label, *computed_cells(c, output), *criteria_cells(c.estimation.output_error.get(output))]
            if label in beside:
                yield printed_cells(label.partition(",")[0], beside[label])

    return make_table("models", {o: rows(o) for o in stage.outputs}, table=3 + stage.number, stage=stage.number)


def fits_table(stage: Stage) -> Table:
    """Return a table with one row per angle and model of a joint.

    Columns are normalized residuals (NR) of equation error and output error, and fits [%] on both runs.
    """

    def rows(output: str) -> Iterator[list[Cell]]:
        for label, c in stage.candidates.items():
            errors = c.estimation.equation_error[output].nr, c.estimation.output_error[output].nr
            driven = [None if part is None else part.output_error[output].fit for part in (c.estimation, c.validation)]
            alone = [figures[output].fit for figures in c.input_driven.values()]
            yield [label, *errors, *driven, *alone, *[None] * (2 - len(alone))]

    return make_table("fits", {o: rows(o) for o in stage.outputs}, stage=stage.number)


def description_tables() -> list[Table]:
    """Return the tables of the paper's symbols (its Table 1), and of the steps of its method with their functions."""
    symbols = [list(each.values()) for each in printed.read_paper_table("paper_symbols.csv")]
    steps: list[list[Cell]] = []
    for k, each in enumerate(printed.read_paper_table("paper_procedure.csv"), 1):
        functions = (Markup("<code>{}</code>").format(f) for f in each["functions"].split(", "))
        steps.append([f"{k}. {each['step']}", Markup(", ").join(functions), each["how"]])
    return [make_table("symbols", symbols), make_table("steps", steps)]


def parameter_tables() -> list[Table]:
    """Return a table of the paper's Table 3 and the manufacturer's effective parameters, and one of the coefficients.

    The second table has the coefficients that follow from both parameter sets, and the printed ones.
    """
    rows: list[list[Cell]] = []
    for name, (value, unit, stage, field) in printed.TABLE_3.items():
        effective = Exact(getattr(PARAMETER_SETS["effective"][stage], field)) if field else None
        name_html = Markup("<i>{}</i><sub>{}</sub>").format(name[0], name.partition("_")[2])
        rows.append([name_html, Exact(value), unit, effective, value / effective if effective else None])
    coefficients = table_3_coefficients().items()
    ratios = ([symbol_html(n), t + 0.0, e + 0.0, p, t / p, e / p] for n, (t, e, p) in coefficients)
    return [make_table("parameters", rows), make_table("coefficients", ratios)]


def saturation_table(reproduction: Reproduction) -> Table:
    """Return a table of coefficient a by angle and innovation length p, for the paper's prior and for a weak prior.

    It also has the printed value and the saturation curve that was fitted to the printed values.
    """

    def rows(stage: Stage, output: str) -> Iterator[list[Cell]]:
        name = parameter_name("a", output)
        of_p = {p: stage.candidates[f"p = {p}"].model for p in printed.INNOVATION_LENGTHS}
        last = letters_of(of_p[printed.LAST_P], output)[0]
        x, c, _ = printed.printed_saturation(output)
        for p, model in of_p.items():
            alike = "yes" if letters_of(model, output)[0] == last else "no"
            weak = stage.weak_prior_coefficients[output][p][name] if stage.weak_prior_coefficients else None
            printed_value = printed.FRACTIONAL_ROWS[output][p].a
            yield [f"p = {p}", model.coefficients[name], alike, weak, printed_value, x * p / (p + c)]

    return make_table("saturation", {output: rows(stage, output) for stage, output in reproduction.angles})


def optimizer_tables(reproduction: Reproduction) -> list[Table]:
    """Return three tables of the optimizer comparison, in which all optimizers have equal numbers of evaluations.

    They correspond to Tables 6 and 7 of the paper. The third has the error, eq. (45), for each optimizer and seed.
    """
    comparisons = reproduction.optimizer_comparisons
    seeds = list(dict.fromkeys(seed for c in comparisons.values() for seed in c.optimizers["genetic"].errors))
    best: list[list[Cell]] = []
    for output, comparison in comparisons.items():
        head = Markup("{}, best of {} seeds").format(symbol_html(output), len(comparison.optimizers["genetic"].errors))
        best.append([head, *computed_cells(comparison.models["genetic"], output)])
        best.append(printed_cells(symbol_html(output), printed.GENETIC_ROWS[output], criteria=False))
    priors = zip(MULTI_INNOVATION_LABELS, printed.PRIOR_COVARIANCES, strict=True)
    labels = OPTIMIZER_LABELS | {n: f"p = {printed.LAST_P}, K₀ = {prior_text(k)}" for n, k in priors}

    def errors(output: str) -> Iterator[list[Cell]]:
        for label, candidate in comparisons[output].models.items():
            own, other = candidate.estimation, candidate.validation
            prediction = criteria_cells(None if other is None else other.output_error[output])
            spread = float(np.std(own.measured[output][0]))
            yield [labels.get(label, label), *criteria_cells(own.output_error[output]), *prediction, spread]
        for k, label in enumerate(("genetic algorithm", "multi-innovation")):
            criteria, implied = map(Exact, printed.TABLE_7_CRITERIA[output][k]), printed.implied_spreads()[output][k]
            yield [printed_head(label), *criteria, None, None, None, implied]

    def errors_by_seed(output: str) -> Iterator[list[Cell]]:
        for name, run in comparisons[output].optimizers.items():
            each = max(run.evaluations.values())
            yield [OPTIMIZER_LABELS[name], comparisons[output].candidates, each, *map(run.errors.get, seeds)]

    return [
        make_table("genetic", best),
        make_table("optimizers", {o: errors(o) for o in comparisons}, alpha=stage_module.COMPARISON_ALPHA),
        make_table("seeds", {o: errors_by_seed(o) for o in comparisons}, {"@seeds": [f"seed {s}" for s in seeds]}),
    ]


def printed_reading_table(reproduction: Reproduction, stage: Stage) -> Table:
    """Return Table 4 or 5 of the paper for a joint, recomputed by the paper's method.

    Each innovation length has a row of recomputed values, one of printed values, and one of their ratios.
    """

    def rows(output: str) -> Iterator[list[Cell]]:
        for p, row in reproduction.as_printed[output].rows.items():
            printed_row = printed.FRACTIONAL_ROWS[output][p]
            computed = [*map(row.coefficients.get, COEFFICIENT_LETTERS), *criteria_cells(row.equation)]
            printed_values = [*map(printed_row.coefficients.get, COEFFICIENT_LETTERS), *printed_row.criteria]
            pairs = zip(computed, printed_values, strict=True)
            ratios = [number(float(a) / b, 3) if a is not None and b else None for a, b in pairs]
            yield [f"p = {p}", *computed]
            yield [printed_head(f"p = {p}"), *printed_values]
            yield ["ours / printed", *ratios]

    tables = {symbol(o): reproduction.as_printed[o] for o in stage.outputs}
    meanings = {o: printed.TERM_INTERPRETATIONS[t.interpretation.terms]["meaning"] for o, t in tables.items()}
    settings = "; ".join(f"{o}: {t.interpretation} ({meanings[o]})" for o, t in tables.items())
    scales = ", ".join(f"{o} by {t.scale:.3g}" for o, t in tables.items())
    groups = {o: rows(o) for o in stage.outputs}
    return make_table("as_printed", groups, table=3 + stage.number, settings=settings, scales=scales)


def printed_runs_table(reproduction: Reproduction) -> Table:
    """Return a table on simulations of the models printed in the paper: unstable poles, standard deviations, refits."""

    def cells(r: printed.PrintedModelRun) -> list[Cell]:
        deviations = r.angle_deviation, r.single_equation_deviation, r.implied_deviation, r.deviation_ratio
        refits = map(r.returned_a.get, printed.PRIOR_COVARIANCES)
        return [f"p = {r.p}", Exact(r.stability.unstable_poles), *deviations, r.row.a, *refits]

    return make_table("printed_models", {o: map(cells, r) for o, r in reproduction.printed_runs_by_output.items()})


def case_tables(reproduction: Reproduction) -> list[Table]:
    """Return two tables of the cases on which verdicts are based.

    The first has errors and convergence steps of multi-innovation by arm, angle, prior covariance and innovation
    length. The second compares integer and free orders.
    """
    rows: dict[tuple[str, str, float], list[Cell]] = {}
    for t in reproduction.cases.trials:
        steps = [None if math.isinf(v) else Exact(v) for v in t.convergence_steps.values()]
        head = f"{t.arm}, {symbol(t.output)}, K₀ = {prior_text(t.prior)}"
        rows.setdefault((t.arm, t.output, t.prior), [head, *t.errors.values(), *steps, t.nr, t.manual])
    orders = (
        [f"{f.arm}, {symbol(o)}", f.integer_nr[o], f.free_nr[o], f.fractional_text]
        for f in reproduction.cases.order_comparisons
        for o in f.free_nr
    )
    return [make_table("trials", rows.values(), weak_prior=printed.WEAK_PRIOR), make_table("order_comparisons", orders)]


def with_powers_of_ten(text: str) -> str:
    """Return a text with powers of ten and K₀ in place of e-notation and K0."""
    powers = re.sub(r"(?<=\d)e([+-]\d+)\b", lambda e: f"·10{str(int(e[1])).translate(SUPERSCRIPT_DIGITS)}", text)
    return powers.replace("K0", "K₀")


def joint_equations(model: Model) -> list[str]:
    """Return paragraphs with an introduction and with the equations of the model of a joint, as HTML."""
    return [page_text("equations"), *equations_html(model)]


def _verdict_section(reproduction: Reproduction) -> Section:
    """Return the section with one table row per checked claim, and with numbers and cases in a collapsed part."""
    found = reproduction.checks
    rows: list[list[Cell]] = []
    for check in found:
        claim, verdict, brief = map(with_powers_of_ten, (check.claim, check.verdict, check.brief))
        rows.append([claim, Markup("<strong>{}</strong>").format(verdict), share_picture(check.ruling), brief])
    numbers = [[*map(with_powers_of_ten, (c.claim, c.computed, c.printed, c.rule))] for c in found]
    return make_section(
        "verdicts",
        tables=[make_table("verdicts", rows)],
        warnings=[page_text("no_second_run")] if reproduction.sine is None else [],
        folded_tables=[make_table("claims", numbers), *case_tables(reproduction)],
    )


def _stage_section(reproduction: Reproduction, stage: Stage) -> Section:
    number, joint = stage.number, stage.candidates["output error"]
    tables = [model_table(stage), estimates_table(joint.result, reproduction.truth.get(number, {})), fits_table(stage)]
    warned = grouped_findings({label: c.result for label, c in stage.candidates.items()})
    if warned:
        rows = ([models, with_powers_of_ten(sentence)] for models, sentence in warned)
        tables.append(make_table("warnings", rows, stage=number))
    return make_section(
        "stage",
        *joint_equations(joint.model),
        values={"stage": number, "table": 3 + number, "warnings": ", warnings" if warned else ""},
        figures=stage_figures(stage, reproduction.reference_label),
        folded_tables=tables,
    )


def _sections(reproduction: Reproduction) -> list[Section]:
    """Return all sections of the page, from top to bottom.

    The sections on the sine run and on optimizers are omitted if there are no such results.
    """
    reference, stages = reproduction.reference_label, list(reproduction.stages.values())
    near, weak, derived, landscapes, correlated, bode = [], [], [], [], [], []
    for s in stages:
        title = page_text("printed_orders", angle=symbol(s.outputs[1]), table=3 + s.number)
        models = [("printed orders", s.printed_orders.estimation)]
        near.append(fit_chart(models, s.outputs[1], title, reference_label=reference))
        for output, traces in s.weak_prior_traces.items():
            weak.append(convergence_chart(traces, f"{symbol(output)}: error (45), weak prior"))
        derived.append(derivative_chart(s.dropped_derivative_effect, reference))
        if s.landscape is not None:
            landscapes.append(s.landscape)
            first, second = map(symbol, s.landscape.names)
            words = {"first": first, "second": second, "correlation": number(s.landscape.correlation, 3)}
            correlated.append(page_text("correlated_orders", stage=s.number, **words))
        joint, run = s.candidates["output error"].model, reproduction.square
        bode += bode_charts(joint, response_frequencies(joint, run.step, run.duration))
    ran = reproduction.printed_model_runs
    sentences = [page_text("implied_deviations", ratios=deviation_text(reproduction))] if ran else []
    sections = [
        _verdict_section(reproduction),
        make_section(
            "printed_models",
            *sentences,
            figures=printed_model_charts(reproduction),
            folded_tables=[printed_runs_table(reproduction)],
        ),
        make_section("as_printed", folded_tables=[printed_reading_table(reproduction, stage) for stage in stages]),
        *(_stage_section(reproduction, stage) for stage in stages),
    ]
    if reproduction.sine is not None:
        sections.append(make_section("sine", figures=sine_figures(reproduction)))
    if reproduction.optimizer_comparisons:
        tables = optimizer_tables(reproduction)
        sections.append(
            make_section("optimizers", figures=optimizer_comparison_figures(reproduction), folded_tables=tables)
        )
    return [
        *sections,
        make_section("innovation_length", figures=weak, small=True, folded_tables=[saturation_table(reproduction)]),
        make_section("close_orders", figures=near),
        make_section("dropped_derivative", figures=derived),
        make_section("landscape", *correlated, figures=landscapes, small=True),
        make_section("frequency_response", figures=bode, small=True),
        make_section("parameters", folded_tables=parameter_tables()),
        make_section("description", figures=[flow_chart()], folded_tables=description_tables()),
        _runs_section(reproduction),
    ]


def _runs_section(reproduction: Reproduction) -> Section:
    rows: list[list[Cell]] = []
    for run in reproduction.runs:
        currents = (f"{symbol(n)} ±{np.max(np.abs(run[n])):.3g} {run.units[n]}" for n in run.inputs)
        rows.append([run.name, run.length, Exact(run.step), run.duration, ", ".join(currents)])
    m = next(iter(reproduction.stages.values())).candidates[f"p = {printed.LAST_P}"].estimation.m
    values = {"m": m, "order_grid": reproduction.order_grid, "settings": stage_module}
    return make_section("runs", *reproduction.notes, values=values, tables=[make_table("runs", rows)])


def reproduction_page(reproduction: Reproduction, path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write the reproduction as one HTML page, and return its path.

    Raise DataError if the file exists and `force` is False, or it cannot be written.
    """
    check_writable(path, force=force)
    names = " and ".join(f"“{run.name}”" for run in reproduction.runs)
    origin = page_text("simulated_origin") if reproduction.simulated else f"the runs {names},"
    strongest = page_text("strongest", brief=reproduction.checks[0].brief) if reproduction.printed_model_runs else ""
    lead = page_text("lead", origin=origin, strongest=with_powers_of_ten(strongest))
    return write_page(path, title="The paper reproduced", sections=_sections(reproduction), lead=lead, force=force)


def table_text(table: Table, label: int, widths: Sequence[int]) -> list[str]:
    """Return a table as text lines; widths are in characters, `label` for the first column, `widths` for the others."""
    plain, all_widths, at, head = [Markup(head).striptags() for head in table.columns], (label, *widths), 0, ""
    for words, count in table.groups:
        width = sum(all_widths[at : at + count])
        head += f" {words} ".center(width - 1, "-").rjust(width) if words else " " * width
        at += count
    lines = [head.rstrip()] if head else []
    heads = (truncate_text(name, width - 1).rjust(width) for name, width in zip(plain[1:], widths, strict=True))
    lines.append(plain[0].ljust(label) + "".join(heads))
    for i, (name, *cells) in enumerate(table.rows):
        if i in table.headings:
            lines.append(Markup(table.headings[i]).striptags())
        own = f"  {Markup(name).striptags()}" if table.headings else Markup(name).striptags()
        texts = (_fit_to_width(v, width - 1).rjust(width) for v, width in zip(cells, widths, strict=True))
        lines.append(truncate_text(own, label - 1).ljust(label) + "".join(texts))
    if any(isinstance(v, float) and math.isinf(v) for row in table.rows for v in row):
        lines.append(f"∞: {DIVERGED_TEXT}, the response leaves the range of numbers")
    return lines


def _fit_to_width(value: Cell, width: int) -> str:
    """Return a cell as text; a number has as many of its five significant digits as fit into `width` characters."""
    if value is None or isinstance(value, str):
        return value or NOT_IN_MODEL
    if not math.isfinite(value):
        return "?" if math.isnan(value) else format_bound(value)
    texts = [f"{value:.{n}g}".replace("e-0", "e-").replace("e+0", "e") for n in range(SIGNIFICANT_DIGITS, 0, -1)]
    return next((t for t in texts if len(t) <= width), texts[-1])


def fits_text(models: Mapping[str, Candidate]) -> list[str]:
    """Return text lines of a table with one row per model: fits of its simulations [%] on the square and sine runs."""
    outputs = next(iter(models.values())).estimation.output_error
    heads = ["", *(f"{o} {run}" for o in outputs for run in ("square", "sine"))]
    rows = [[n, *("–" if math.isnan(v) else f"{v:.2f}" for v in c.fits)] for n, c in models.items()]
    return table_text(Table("", heads, rows), 26, [16] * 4)


def reproduction_text(reproduction: Reproduction) -> str:
    """Return a summary for a terminal: verdict on each claim, then fits and equations of each joint, then notes."""
    lines = []
    for check in reproduction.checks:
        lines += [f"{check.verdict.upper()}: {check.claim}", f"    {check.brief}"]
    for stage in reproduction.stages.values():
        lines += ["", f"Stage {stage.number}: fit of the simulation in percent, driven as identified"]
        lines += fits_text(stage.candidates)
        best = stage.candidates["output error"].model
        lines += [f"  {format_equation(e, best.structure.describe_inputs('.6g'))}" for e in best.equations]
    return "\n".join([*lines, *(f"note: {n}" for n in reproduction.notes)])
