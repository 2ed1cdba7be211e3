"""HTML report of an identification or a saved model: its sections, tables and charts."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from markupsafe import Markup

from ftlm.analysis.frequency_response import linear_part
from ftlm.analysis.poles import modes, steady_states
from ftlm.data.run import Run
from ftlm.data.runs import as_runs
from ftlm.errors import FtlmError
from ftlm.estimation.cost_surface import output_error_landscape
from ftlm.estimation.linear import multi_innovation_trace, trace_chart
from ftlm.estimation.model_checks import has_unstable_mode
from ftlm.estimation.model_validation import validate, validate_model
from ftlm.estimation.output_error import JointFit
from ftlm.estimation.result import Identification, Task
from ftlm.estimation.verdict import Verdict, saved_verdict, verdict, verdict_html
from ftlm.findings import (
    LEVEL_NOTE,
    MAX_SUMMARY_FINDINGS,
    Finding,
    group_findings,
    make_finding,
    mark_validation,
    texts,
    unique_findings,
)
from ftlm.model.model import Model
from ftlm.model.parameter_estimates import Parameter
from ftlm.order_search.options import COMPARED_INNOVATION_LENGTHS
from ftlm.order_search.result import SearchResult, search_summary, search_top
from ftlm.order_search.search import landscape, score_profiles
from ftlm.plot.comparison_charts import (
    Band,
    comparison_charts,
    confidence_bands,
    input_charts,
    residual_charts,
    residual_series,
)
from ftlm.plot.model_charts import bode_charts, pole_charts, response_frequencies
from ftlm.report.text_summary import describe_order, settings_rows
from ftlm.report.typesetting import equations_html, parameter_table
from ftlm.structure.input_nonlinearity import INPUT_EFFECT_LABELS
from ftlm.svg.charts import CorrelationMap
from ftlm.svg.figure import MAX_LINE_POINTS, Figure
from ftlm.svg.html_page import Page, Section, Table
from ftlm.svg.line_chart import LineChart
from ftlm.utils.files import check_writable
from ftlm.utils.formatting import Cell, format_bound, number, symbol, symbol_html, typeset
from ftlm.utils.parameters import use_interface
from ftlm.validation.comparison import (
    Comparison,
    errors_table,
    initial_terms_table,
    validation_fit_findings,
    warnings_html,
)
from ftlm.validation.data_advice import data_notes
from ftlm.validation.information_criteria import InformationCriteria, information_table
from ftlm.validation.residual_tests import DEFAULT_LAGS, Residuals, resid, residual_table

#: Maximum number of pole maps and step responses together on a page.
MAX_RESPONSE_FIGURES = 9
_LEVEL_CSS_CLASSES = {"trust": "trust", "with care": "care", "do not use": "not"}


def verdict_box(verdict: Verdict, subject: str = "") -> Markup:
    """Return a verdict as an HTML box for the top of a page; the prefix `subject` names one of several models."""
    remedy = Markup(' <span class="todo">→ {}</span>').format(typeset(verdict.remedy)) if verdict.remedy else ""
    return Markup('<div class="first {}" role="note"><strong>{}</strong>{}{}</div>').format(
        _LEVEL_CSS_CLASSES[verdict.level],
        f"{subject}{verdict.level}" if subject else verdict.level.capitalize(),
        typeset(verdict.reason),
        remedy,
    )


def first_findings(findings: Iterable[Finding]) -> tuple[list[str], list[str]]:
    """Return two lists of sentences: the most serious findings, and all other findings.

    The first list has one sentence with its remedy for each of the `MAX_SUMMARY_FINDINGS` most serious groups.
    """
    main: list[str] = []
    further: list[str] = []
    for k, group in enumerate(group_findings(findings)):
        if k >= MAX_SUMMARY_FINDINGS:
            further += texts(group.findings)
            continue
        remedy = Markup(' <span class="todo">→ {}</span>').format(typeset(group.remedy)) if group.remedy else Markup("")
        main.append(Markup("{}{}{}").format(typeset(group.first_finding.text), group.count, remedy))
        further += texts(group.findings[1:])
    return main, further


def model_title(model: Model) -> str:
    """Return the page title for a model: the name of its structure, or its outputs and inputs."""
    structure = model.structure
    if structure.name != "equation":
        return structure.name
    inputs = [s for s in structure.signals if s not in structure.outputs]
    inputs_text = f" from {', '.join(map(symbol, inputs))}" if inputs else ""
    return f"Model of {', '.join(map(symbol, structure.outputs))}{inputs_text}"


def behavior_tables(model: Model) -> list[Table]:
    """Return tables of steady-state gains and of modes with standard errors.

    A table is omitted if it would be empty. The list is empty for a model that is not linear.
    """
    if not model.structure.is_linear:
        return []
    tables = []
    try:
        model_modes = modes(model)
        unstable = any(mode.unstable for mode in model_modes)
        states = () if unstable or model.structure.limits else steady_states(model)
    except FtlmError:
        # Equations that cannot be solved for all outputs together have neither gains nor modes.
        return []
    if states:
        rows: list[list[Cell]] = []
        for state in states:
            output_unit, input_unit = (model.units.get(n, "") for n in (state.output, state.input))
            pair = Markup("{} from {}").format(symbol_html(state.output), symbol_html(state.input))
            unit = f"{output_unit}/{input_unit}" if output_unit and input_unit else ""
            uncertainty = describe_order(state)
            if state.order > 0:
                runs = f" t^{state.order:.4g}/Γ({state.order + 1:.4g})" if state.order != 1 else " per second"
                rows.append(
                    [pair, state.rate, state.error, unit, f"none: the output does not settle; rate{runs}{uncertainty}"]
                )
            else:
                decays = state.order < 0
                text = "0: the response decays to zero" if decays else "gain"
                rows.append([pair, state.gain, None if decays else state.error, unit, f"{text}{uncertainty}"])
        tables.append(
            Table("Steady state under a unit step", ("output", "value", "standard error", "unit", "what it is"), rows)
        )
    if model_modes:
        rows = [
            [
                f"{k + 1}",
                f"{number(m.pole.real, 4)} ± {number(abs(m.pole.imag), 4)}j"
                if m.oscillatory
                else number(m.pole.real, 4),
                m.frequency,
                m.frequency_error,
                m.damping,
                m.damping_error,
                m.time_constant if math.isfinite(m.time_constant) else "∞",
                m.time_constant_error,
            ]
            for k, m in enumerate(model_modes)
        ]
        note = (
            "The time constant is 1/|Re s| of an oscillation and 1/|s| of a relaxation; standard errors are to first "
            "order from the covariance of the fit."
        )
        columns = ("mode", "pole s [rad/s]", "frequency [rad/s]", "±", "damping", "±", "time constant [s]", "±")
        tables.append(Table("Modes", columns, rows, note=note))
    return tables


def behavior_figures(model: Model) -> list[Figure]:
    """Return the pole map and step responses, at most `MAX_RESPONSE_FIGURES` charts.

    The list is empty for a model that is not linear, or has a saturation or dead zone. Charts that cannot be computed
    are omitted.
    """
    figures: list[Figure] = []
    if not model.structure.is_linear or model.structure.limits:
        return figures
    with contextlib.suppress(FtlmError):
        figures += pole_charts(model)
        figures += model.step().figures()
    return figures[:MAX_RESPONSE_FIGURES]


#: Maximum number of charts of measured and simulated outputs on a page, and of points in all their lines. A point takes
#: at most 10 bytes, so that the page stays below 2 MB.
PAGE_CHARTS = 60
PAGE_POINTS = 90_000
#: Maximum number of residual charts, and of frequency-response charts, on a page.
SMALL_CHARTS = 24
#: Maximum number of points of a line in a notebook, whose file stores every displayed chart.
NOTEBOOK_POINTS = 600
#: Maximum number of points of a residual line in a small chart.
SERIES_POINTS = 600
#: Approximate number of points of a convergence curve of the recursion.
TRACE_POINTS = 64
#: Texts for models that are not linear, in place of a statement on their stability.
FRICTION_STABILITY_NOTE = "A model with friction is not linear, so it has no poles."
NONLINEAR_STABILITY_NOTE = "The model is not linear: only its linear model about a point has poles."


def stability_note(model: Model) -> str:
    """Return a sentence on the stability of a model, or on the reason why it has no poles."""
    if model.structure.has_nonlinear_terms:
        return NONLINEAR_STABILITY_NOTE
    if model.structure.has_friction:
        return FRICTION_STABILITY_NOTE
    try:
        stable = model.stability()
    except FtlmError as error:
        return f"As a whole, the model has no poles: {error}."
    is_doubtful = stable.unstable_poles > 0 and not has_unstable_mode(model, "simulated")
    return f"As a whole, the model is {stable}{', but not significantly' if is_doubtful else ''}."


def identification_page(
    result: Identification,
    path: str | os.PathLike[str],
    *,
    validation: Run | Sequence[Run] | None = None,
    force: bool = False,
    sections: Sequence[Section] = (),
    choice_findings: Sequence[Finding] = (),
    validated: Comparison | None = None,
) -> Path:
    """Write the HTML report of one identification.

    Parameters
    ----------
    result
        Result of :func:`ftlm.identify`.
    path, validation, force
        See :meth:`ftlm.Identification.report`.
    sections
        Sections on the structure selection, which follow the warnings.
    choice_findings
        Findings on the structure selection, which precede those of the result.
    validated
        Comparison with validation runs, used if `validation` is None because the runs are not available.

    Returns
    -------
    Path
        The file that was written.
    """
    check_writable(path, force=force)
    validation_runs = [] if validation is None else as_runs(validation)
    comparisons = [validate(result, run) for run in validation_runs] or ([] if validated is None else [validated])
    pooled = validate(result, validation_runs) if len(validation_runs) > 1 else comparisons[0] if comparisons else None
    # Findings name options in the words of a page. Errors, above and in writing, are for the caller.
    with use_interface("report"):
        page = _identification_content(result, validation_runs, comparisons, pooled, sections, choice_findings)
    return page.write(path, force=force)


def _identification_content(
    result: Identification,
    validation_runs: Sequence[Run],
    comparisons: Sequence[Comparison],
    pooled: Comparison | None,
    sections: Sequence[Section],
    choice_findings: Sequence[Finding],
) -> Page:
    """Return the page of an identification with `comparisons` on validation runs, and with one on all of them."""
    model = result.model
    findings = [*choice_findings, *result.findings]
    undefined = [n for n, e in result.standard_errors.items() if math.isnan(e)]
    if undefined:
        findings.append(make_finding("errors_undefined", parameter=", ".join(undefined)))
    for run, comparison in zip(validation_runs, comparisons, strict=False):
        findings += mark_validation([*comparison.findings, *data_notes(run)], run.name)
    compared = [("estimation", result.comparison), *(("validation", c) for c in comparisons)]
    tests = [] if result.residuals is None else [("estimation", result.residuals)]
    tests += validation_tests(model, validation_runs)
    overall_verdict = verdict(result, pooled)
    task = result.task
    runs = [*(() if task is None else task.runs), *validation_runs]
    bands = [confidence_bands(model, run, c) for run, c in zip(validation_runs, comparisons, strict=False)]
    main_parts = main_sections(model, findings, compared, bool(comparisons), result.joint, runs, bands, result.offsets)
    collapsed = [section for section in main_parts if section.collapsed]
    main_parts = [
        *main_parts[: len(main_parts) - len(collapsed)],
        *sections,
        *_order_search_sections(result),
        *collapsed,
    ]
    details = [residual_section(tests, result.information, compared, model.units)]
    details += correlation_sections(result.joint)
    sampling = [(r.step, r.duration) for r in ((() if task is None else task.runs) or validation_runs)]
    details += frequency_sections(model, sampling)
    details += _search_sections(result)
    titles = ((f"Initial terms of the simulations, {label}", c) for label, c in compared)
    initial = [t for title, c in titles if (t := initial_terms_table(c, title=title)) is not None]
    starts = [starts_table(result.joint)] if result.joint is not None and result.joint.starts else []
    details.append(Section("Settings", tables=[settings_table(result), *starts, *initial]))
    return _content(model, overall_verdict, compared, main_parts, details)


def _content(
    model: Model,
    overall_verdict: Verdict,
    compared: Sequence[tuple[str, Comparison]],
    sections: Sequence[Section],
    details: Sequence[Section],
) -> Page:
    """Return a page with a verdict, `sections` and collapsed `details`.

    `compared` has (role of the data, comparison) pairs, whose fits are summarized below the title.
    """
    all_sections = [*sections, *(replace(section, collapsed=True) for section in details)]
    return Page(model_title(model), all_sections, fit_sentences(compared), verdict_box(overall_verdict))


def main_sections(
    model: Model,
    findings: Iterable[Finding],
    compared: Sequence[tuple[str, Comparison]],
    validated: bool,
    joint: JointFit | None,
    runs: Sequence[Run] = (),
    bands: Sequence[Mapping[str, Band]] = (),
    offsets: Mapping[str, Parameter] | None = None,
) -> list[Section]:
    """Return the first sections of a page: measured and simulated outputs, equations, warnings, and collapsed details.

    The outputs are those of the validation runs, or of the estimation runs without validation.

    Parameters
    ----------
    findings
        Findings of the page; alerts are shown as warnings, notes as plain text.
    compared
        (role, comparison) pairs; the role is "estimation" or "validation".
    validated
        Whether a validation run was given.
    joint
        Output-error fit of the model; None for other methods.
    runs
        Runs of all comparisons in the same sequence, for charts of the inputs.
    bands
        For each validation comparison, confidence bands of the simulated outputs by output.
    offsets
        Offsets of the estimation runs by name.
    """
    units = model.units
    verdict_texts = [
        "No check raised a warning. Checked: simulation against equation error, orders close to one another or on the "
        "edge of their interval, influence of the prior, coefficient law, residuals, stability of the scheme, the data."
    ]
    if not validated:
        verdict_texts.append("No validation run was given, so the prediction of other data is unknown.")
    distinct_findings = unique_findings(findings)
    alerts, notes = ([f for f in distinct_findings if (f.level == LEVEL_NOTE) == is_note] for is_note in (False, True))
    main_findings, further_findings = first_findings(alerts)
    verdict_texts += [f"{note}." for note in texts(notes)]
    charts = sum(len(c.per_run) for _, c in compared) * len(model.outputs)
    # A chart has two lines, each drawn once for wide screens and once with half the points for narrow screens.
    points = min(MAX_LINE_POINTS, PAGE_POINTS // (3 * max(min(charts, PAGE_CHARTS), 1)))
    estimation_comparison = compared[0][1] if compared and compared[0][0] == "estimation" else None
    equations = [
        *equations_html(model, None if estimation_comparison is None else estimation_comparison.offsets),
        stability_note(model),
    ]
    validated_on = [(label, c) for label, c in compared if label == "validation"]
    fits = [(label, c) for label, c in compared if label != "validation"]
    remaining_runs = list(runs)
    figures_with_inputs = _with_inputs(model, fits, remaining_runs, points)
    validation_figures = _with_inputs(model, validated_on, remaining_runs, points, bands)
    main_figures = validation_figures or figures_with_inputs
    sections = []
    if main_figures:
        omission_text = f"{charts - PAGE_CHARTS} further charts are left out; the table of errors has every run."
        heading = "Validation: measured and simulated" if validation_figures else "Measured and simulated"
        sections.append(
            Section(heading, omission_text if charts > PAGE_CHARTS else (), figures=main_figures[:PAGE_CHARTS])
        )
    sections += [
        Section("Equations", equations, tables=[parameter_table(model, joint, offsets)]),
        Section("Warnings", verdict_texts[bool(alerts) :], main_findings, more=further_findings),
    ]
    if figures := behavior_figures(model):
        tables = behavior_tables(model)
        sections.append(Section("Gain, modes and steps", tables=tables, figures=figures, small=True, collapsed=True))
    if compared:
        sections.append(Section("Errors", tables=[errors_table(compared, units=units)], collapsed=True))
    if validation_figures and figures_with_inputs:
        figures = figures_with_inputs[: max(PAGE_CHARTS - len(validation_figures), 0)]
        sections.append(Section("Estimation: measured and simulated", figures=figures, collapsed=True))
    return sections


def _with_inputs(
    model: Model,
    compared: Sequence[tuple[str, Comparison]],
    runs: list[Run],
    points: int,
    bands: Sequence[Mapping[str, Band]] = (),
) -> list[Figure]:
    """Return charts of the measured and simulated outputs of each compared run, followed by its inputs.

    `runs` has the compared runs in the same sequence. Each run whose inputs are drawn is removed from this list. Inputs
    of a compared run that the list lacks are omitted. `points` is the maximum number of points of a line.
    """
    inputs = [s for s in model.structure.signals if s not in model.outputs]
    charts: list[Figure] = []
    for index, (label, comparison) in enumerate(compared):
        band = bands[index] if index < len(bands) else {}
        figures = comparison_charts(comparison, units=model.units, label=label, points=points, bands=band)
        for k, (name, _, _) in enumerate(comparison.per_run):
            output_count = len(comparison.output_error)
            charts += figures[k * output_count : (k + 1) * output_count]
            if runs and runs[0].name == name:
                charts += input_charts([runs.pop(0)], inputs, points=max(points // 2, 4))
    return charts


def validation_tests(model: Model, runs: Sequence[Run]) -> list[tuple[str, Residuals]]:
    """Return a ("validation", residual tests) pair for each run with at least ``2 * DEFAULT_LAGS + 3`` samples."""
    return [("validation", resid(model, run)) for run in runs if run.length >= 2 * DEFAULT_LAGS + 3]


def correlation_sections(joint: JointFit | None) -> list[Section]:
    """Return a section with the correlation matrix of the estimates; [] without a joint fit or for one parameter."""
    if joint is None or len(joint.names) < 2:
        return []
    texts = (
        "Two parameters whose correlation is near 1 or −1 can change together with little effect on the fit. Their "
        "combination is then better determined than each of them."
    )
    values = np.clip(joint.correlation, -1.0, 1.0)
    figure = CorrelationMap(joint.names, values, title="Correlations of the estimates")
    return [Section("Correlations of the estimates", texts, figures=[figure], small=True)]


def residual_section(
    tests: Sequence[tuple[str, Residuals]],
    information: InformationCriteria | None,
    compared: Sequence[tuple[str, Comparison]] = (),
    units: Mapping[str, str] | None = None,
) -> Section:
    """Return a section with residual tests, information criteria, residual series, histograms and correlations.

    `tests` and `compared` have (role, result) pairs; a role is "estimation" or "validation".
    """
    tables = [residual_table(t, title=f"{label}: {', '.join(t.runs)}") for label, t in tests]
    if information is not None:
        tables.append(information_table(information))
    figures = [f for label, c in compared for f in residual_series(c, units=units, label=label, points=SERIES_POINTS)]
    figures = figures[: SMALL_CHARTS // 2]
    figures += [f for label, t in tests for f in residual_charts(t, label=label)]
    text = () if tests else "The runs are too short for residual tests."
    return Section("Residuals", text, tables=tables, figures=figures[:SMALL_CHARTS], small=True)


def frequency_sections(model: Model, steps: Sequence[tuple[float, float]]) -> list[Section]:
    """Return a section with Bode charts of a model; [] for a model with nonlinear terms.

    `steps` are (sampling interval, duration) pairs of the runs [s], which determine the frequency range. Without runs
    it follows from the model.
    """
    structure = model.structure
    if structure.has_nonlinear_terms:
        return []
    orders = [order.constant for e in model.equations for order in e.orders]
    fractional = ", without an approximation of fractional orders" if any(order % 1.0 for order in orders) else ""
    text = f"Exact response of all equations together{fractional}."
    effects = ["friction"] if structure.has_friction else []
    effects += list(dict.fromkeys(INPUT_EFFECT_LABELS[limit.kind] for limit in structure.limits))
    if effects:
        model = linear_part(model)
        conditions = ["every output keeps its direction of motion"] if structure.has_friction else []
        if any(e.friction is not None and e.friction.stribeck is not None for e in structure.equations):
            conditions.append("moves faster than Stribeck's speed")
        conditions += ["the inputs stay between dead zone and saturation"] if structure.limits else []
        text = (
            f"Exact response of the linear part of the model, without {' and '.join(effects)}. Small deviations "
            f"respond in this way while {' and '.join(conditions)}."
        )
    omega = response_frequencies(model, *min(steps)) if steps else response_frequencies(model)
    if model.estimate is None or model.estimate.covariance is None:
        has_errors = model.estimate is None or None not in model.estimate.standard_errors.values()
        reason = "This estimator gives no covariance" if has_errors else "The runs do not identify all parameters"
        text += f" {reason}, so there are no bands."
    return [Section("Frequency response", text, figures=bode_charts(model, omega)[:SMALL_CHARTS], small=True)]


def _search_sections(result: Identification) -> list[Section]:
    """Return sections with the convergence of the multi-innovation recursion and with the cost over two orders.

    A section that does not apply to the method of the result is omitted.
    """
    sections = []
    traces = _recursion_error_charts(result)
    if traces:
        text = (
            "Error (45) of the simulation after every step of the recursion, at the identified orders. p is the weight "
            "of the data relative to the prior. All lines end at the error of the closed form."
        )
        sections.append(Section("Convergence of the recursion", text, figures=traces))
    cost_landscape = output_error_landscape(result)
    if cost_landscape is not None:
        first, second = map(symbol, cost_landscape.names)
        text = (
            f"The two orders with the most correlated estimates are {first} and {second}: their correlation is "
            f"{number(cost_landscape.correlation, 3)}. For white residuals, their joint 95 % region is bounded by a "
            "score of 7."
        )
        sections.append(Section("Order landscape", text, figures=[cost_landscape], small=True))
    return sections


def _order_search_sections(result: Identification) -> list[Section]:
    """Return a section with the best candidates of order searches, score profiles and maps; [] without a search."""
    if not result.searches:
        return []
    tables = [search_top(name, search) for name, search in result.searches.items()]
    charts = [] if result.task is None else _score_charts(result.task, result.searches)
    return [Section("Order search", tables=[*tables, search_summary(result.searches)], figures=charts, small=True)]


def _score_charts(task: Task, searches: Mapping[str, SearchResult]) -> list[Figure]:
    """Return charts of the score over each order, and over two orders for searches that vary two or more."""
    charts: list[Figure] = []
    for name, search in searches.items():
        group = task.structure if name == "stage" else task.structure.equation(name)
        group_grid = task.part_order_grid(group)
        charts += score_profiles(task.runs, group, search, group_grid)
        if sum(len(v) > 1 for v in group_grid.values(group).values()) >= 2:
            charts.append(landscape(task.runs, group, search, group_grid))
    return charts


def _recursion_error_charts(result: Identification) -> list[LineChart]:
    """Return charts of the error of the multi-innovation recursion at the identified orders, one per equation.

    The lines are for the innovation lengths p of the paper and of the result. The list is empty for other methods,
    nonzero initial conditions, or an estimated offset.
    """
    if result.task is None or result.method != "multi-innovation" or result.settings["initial"] != "rest":
        return []
    if "offset" in result.settings:
        return []
    run, settings = result.task.runs[0], result.settings
    stride = max(1, int(settings["m"]) // TRACE_POINTS)
    options = {n: settings[n] for n in ("prior_covariance", "row_basis", "m")}
    figures = []
    for identified in result.model.equations:
        single_equation = result.task.structure.equation(identified.output)
        order_pairs = zip(single_equation.equations[0].orders, identified.orders, strict=True)
        orders = {o.names[0]: n.constant for o, n in order_pairs if o.names}
        structure = single_equation.with_orders(orders)
        if not structure.coefficient_names:
            continue
        traces = [
            (f"p = {p}", multi_innovation_trace(run, structure, innovation_length=p, every=stride, **options))
            for p in sorted({*COMPARED_INNOVATION_LENGTHS, int(settings["innovation_length"])})
        ]
        figures.append(trace_chart(traces, title=f"Error (45) of {symbol(identified.output)}, run {run.name}"))
    return figures


def fit_sentences(compared: Sequence[tuple[str, Comparison]]) -> str:
    """Return text on the simulation fit of every output [%], one sentence for each (role of the data, comparison)."""
    sentences = []
    for label, comparison in compared:
        fits = ", ".join(f"{symbol(name)} {number(fit, 4)}\u00a0%" for name, fit in comparison.fit.items())
        runs = ", ".join(name for name, _, _ in comparison.per_run)
        sentences.append(f"Fit on {label} data ({runs}): {fits}.")
    return " ".join(sentences)


def estimates_table(result: Identification | None, true_values: Mapping[str, float] | None = None) -> Table:
    """Return a table of orders and coefficients of a joint fit with 95 % intervals, and true values by name if given.

    The table has no rows without a joint fit.
    """
    rows: list[list[Cell]] = []
    if result is not None and result.joint is not None:
        for name, value in {**result.orders, **result.joint.coefficients}.items():
            low, high = result.intervals[name]
            true_cells = [true_values.get(name)] if true_values else []
            error_and_interval = [
                v if math.isfinite(v) else format_bound(v) for v in (result.standard_errors[name], low, high)
            ]
            rows.append([symbol_html(name), value, *error_and_interval, *true_cells])
    columns, groups = ["parameter", "value", "standard error", "from", "to"], [("", 3), ("95 % interval", 2)]
    if true_values:
        columns, groups = [*columns, "true value"], [*groups, ("", 1)]
    return Table("Output error: orders and coefficients, with intervals", columns, rows, groups=groups)


def grouped_findings(results: Mapping[str, Identification | None]) -> list[tuple[str, str]]:
    """Return the findings of several results, as pairs of the labels of the results that have it and its sentence.

    Findings that differ only in numbers are merged; the sentence then has the numbers of the first one.
    """
    groups: dict[tuple[str, ...], tuple[Finding, list[str]]] = {}
    for label, result in results.items():
        for finding in () if result is None else result.findings:
            note = finding.text if finding.level == LEVEL_NOTE else ""
            key = (finding.code, finding.run, finding.output, finding.input, finding.parameter, note)
            groups.setdefault(key, (finding, []))[1].append(label)
    return [
        (", ".join(dict.fromkeys(labels)), f"{finding}{'' if len(labels) == 1 else ' (numbers of the first)'}")
        for finding, labels in groups.values()
    ]


#: Maximum number of initial guesses in the table of a report.
MAX_STARTS_SHOWN = 10


def starts_table(joint: JointFit) -> Table:
    """Return a table of the best automatic initial guesses of a fit, with their costs on subsampled records."""
    best_starts = joint.starts[:MAX_STARTS_SHOWN]
    cells: list[list[Cell]] = [[rank, origin, level] for rank, (level, origin) in enumerate(best_starts, 1)]
    note = f"{joint.origin_text}. The best ones were then optimized on all samples." if joint.starts else ""
    return Table("Automatic initial guesses", ("rank", "start from", "cost per residual"), cells, note=note)


def settings_table(result: Identification) -> Table:
    """Return a table of the settings of an identification: structure, estimator and its options, delays, runs."""
    structure, comparison = result.model.structure, result.comparison
    rows: list[list[Cell]] = [
        ["structure", structure.name],
        ["coupling in simulations", structure.coupling],
        ["estimator", result.method],
        *settings_rows(result.settings, searched=bool(result.searches)),
    ]
    rows += [[f"delay of {symbol(name)}", f"{delay:g} s"] for name, delay in structure.delay.items()]
    rows += [
        [f"{INPUT_EFFECT_LABELS[limit.kind]} of {symbol(limit.signal)}", f"{limit.value:g}"]
        for limit in structure.limits
    ]
    if structure.sensor_filter is not None:
        filtered = ", ".join(symbol(o) for o in structure.sensor_filter.signals)
        rows.append(["known sensor filter on", filtered])
    rows += [
        [Markup("run <q>{}</q>").format(name), f"{number(step * comparison.m)} s, pulses of {number(step * 1e3)} ms"]
        for (name, _, _), step in zip(comparison.per_run, comparison.step, strict=True)
    ]
    return Table("Settings of the identification", ("setting", "value"), rows)


#: Phrase for each result of the test of independence between residuals and inputs.
_INDEPENDENCE_PHRASES = {"yes": "independent of", "no": "not independent of", "undecided": "perhaps independent of"}


def identification_html(result: Identification) -> str:
    """Return an identification as HTML for notebooks: verdict, equations, parameters, fit, residual tests, warnings."""
    model = result.model
    contents = [verdict_html(verdict(result))]
    contents += [Markup("<p>{}</p>").format(e) for e in equations_html(model, result.comparison.offsets)]
    contents += [table.to_html() for table in behavior_tables(model)]
    contents.append(parameter_table(model, result.joint, result.offsets).to_html())
    # A notebook shows the first run only; a report shows all runs.
    figures = comparison_charts(result.comparison, units=model.units, points=NOTEBOOK_POINTS)
    contents += [Markup(f._repr_html_()) for f in figures[: len(result.output_error)]]  # safe: all parts are escaped
    contents.append(errors_table([("estimation", result.comparison)], units=model.units).to_html())
    if result.residuals is not None:
        verdicts = [
            Markup("{}: residuals {}, {} the inputs").format(
                symbol_html(o),
                "white" if is_white else "not white",
                _INDEPENDENCE_PHRASES[result.residuals.independence[o]],
            )
            for o, is_white in result.residuals.white.items()
        ]
        contents.append(Markup("<p>{} (99 %).</p>").format(Markup("; ").join(verdicts)))
    main, further = first_findings(result.findings)
    contents.append(warnings_html(main))
    if further:
        folded = Markup("<details><summary>{} more warning{}</summary>{}</details>")
        contents.append(folded.format(len(further), "" if len(further) == 1 else "s", warnings_html(further)))
    return str(Markup("").join(contents))


def model_page(
    model: Model, path: str | os.PathLike[str], *, validation: Run | Sequence[Run] | None = None, force: bool = False
) -> Path:
    """Write the HTML report of a saved model, with its stored identification results and with validation runs.

    Parameters
    ----------
    model
        Model, as :func:`ftlm.load_model` returns it.
    path, validation, force
        See :meth:`ftlm.Identification.report`.

    Returns
    -------
    Path
        The file that was written.
    """
    check_writable(path, force=force)
    validation_runs = [] if validation is None else as_runs(validation)
    validated = [validate_model(model, run) for run in validation_runs]
    with use_interface("report"):
        page = _model_content(model, validation_runs, validated)
    return page.write(path, force=force)


def _model_content(model: Model, validation_runs: Sequence[Run], validated: Sequence[Comparison]) -> Page:
    """Return the page of a saved model and of its comparisons (`validated`) with `validation_runs`."""
    estimate = model.estimate
    findings = [] if estimate is None else list(estimate.findings)
    for run, comparison in zip(validation_runs, validated, strict=True):
        run_findings = [*comparison.findings, *data_notes(run)]
        if estimate is not None:
            run_findings += validation_fit_findings(
                {n: f for n, f in estimate.fit.items() if f is not None}, comparison
            )
            run_findings += [make_finding("estimation_run_name_repeated", run=run.name)] * (run.name in estimate.runs)
        findings += mark_validation(run_findings, run.name)
    compared = [("validation", comparison) for comparison in validated]
    bands = [confidence_bands(model, run, c) for run, c in zip(validation_runs, validated, strict=True)]
    sections = main_sections(model, findings, compared, bool(validation_runs), None, validation_runs, bands)
    details = []
    if tests := validation_tests(model, validation_runs):
        details.append(residual_section(tests, None, compared, model.units))
    details += frequency_sections(model, [(r.step, r.duration) for r in validation_runs])
    model_rows: list[list[Cell]] = [
        ["structure", model.structure.name],
        ["coupling in simulations", model.structure.coupling],
    ]
    if estimate is not None:
        model_rows += [["estimator", estimate.method], ["identified from", ", ".join(estimate.runs)]]
        model_rows += [[Markup("fit of {} there, %").format(symbol_html(n)), f] for n, f in estimate.fit.items()]
        model_rows += [[n.upper().replace("AICC", "AICc"), v] for n, v in estimate.information.items()]
    initial = [t for _, c in compared if (t := initial_terms_table(c)) is not None]
    details.append(
        Section("Settings", tables=[Table("Content of the model file", ("setting", "value"), model_rows), *initial])
    )
    overall_verdict = saved_verdict(model, validated)
    return _content(model, overall_verdict, compared, sections, details)
