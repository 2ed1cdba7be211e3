"""Cross-validation of fractional against integer orders on the links of a measured arm, with its HTML page."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

from markupsafe import Markup

from ftlm.arm.flexible_link import integer_order, link_structure
from ftlm.data.run import Run
from ftlm.errors import DataError, FtlmError, ModelError
from ftlm.estimation.identify import identify
from ftlm.estimation.model_checks import dead_channel_findings
from ftlm.estimation.result import Identification
from ftlm.estimation.verdict import MIN_FIT_GAIN, have_common_value, improves_prediction, is_degenerate
from ftlm.progress import Progress
from ftlm.report.html_report import grouped_findings
from ftlm.report.typesetting import equation_html
from ftlm.reproduction.published_values import page_text, read_texts
from ftlm.reproduction.report import fit_chart, make_section, make_table, table_text
from ftlm.reproduction.simulated_arm import StageNumber, decimate_run, letter_of, stages_with
from ftlm.reproduction.stage import JOINT_METHOD
from ftlm.structure.structure import Structure
from ftlm.svg.figure import SMALL_WIDTH_PX
from ftlm.svg.html_page import Section, Table, write_page
from ftlm.svg.line_chart import LineChart
from ftlm.utils.files import check_writable
from ftlm.utils.formatting import Cell, Exact, attributes, finite, format_bound, json_value, symbol, symbol_html
from ftlm.utils.resources import duration_bounds, estimate_duration, output_error_cost
from ftlm.utils.validation import check_threads, join_names
from ftlm.validation.comparison import Comparison

#: Free orders of each structure (beta: elasticity, mu: damping), by the structure's label ("kind"). Other orders are
#: integer.
INTEGER_KIND = "integer orders"
FREE_ORDERS_BY_KIND: dict[str, tuple[str, ...]] = {
    INTEGER_KIND: (),
    "fractional elasticity": ("beta",),
    "fractional damping": ("mu",),
    "both fractional": ("beta", "mu"),
}
#: Maximum number of samples of a run in a fit. For a run of 20 s, the modes of the arm are a decade below this rate.
MAX_SAMPLES = 1250
#: Label of structures without the term in the other deflection's rate (``Deflection.without_rate``).
WITHOUT_RATE_LABEL = "without the rate of the other deflection"


#: Structure that charts compare with integer orders: elasticity and damping are fractional, as in the paper.
CHARTED_KIND = "both fractional"
#: Structures with at least one fractional order.
FRACTIONAL_KINDS = tuple(kind for kind in FREE_ORDERS_BY_KIND if kind != INTEGER_KIND)
#: Text of a verdict (`Verdict.improves`) in a table cell.
VERDICT_CELLS = {True: "yes", False: "no", None: "inconclusive"}
#: Maximum number of points of a line in a chart.
LINE_POINTS = 700


@dataclass(frozen=True)
class RunFit:
    """Fit of one structure to one run, with simulations of the model on all runs.

    Parameters
    ----------
    result
        Identification from the estimation run.
    comparisons
        Comparison of each run with its simulation by the model, by name of the run. The estimation run is included.
    """

    result: Identification
    comparisons: dict[str, Comparison]

    def fit(self, run: str) -> float:
        """Return the fit of the simulation on the run with this name [%]; minus infinity if it overflows."""
        value = next(iter(self.comparisons[run].fit.values()))
        return value if math.isfinite(value) else -math.inf

    @property
    def estimates(self) -> dict[str, tuple[float, float, float]]:
        """(estimate, low, high) of each free parameter by name, with its 95 % interval; orders come first.

        The elasticity a D^beta y and the damping d D^mu y of the deflection y differ only in their orders, so a fit may
        exchange them. Here, a and beta always belong to the term of the lower order.
        """
        joint = self.result.joint
        values = {**self.result.orders, **({} if joint is None else joint.coefficients)}
        letters = {letter_of(n): n for n in values}
        estimates = {n: (v, *self.result.intervals[n]) for n, v in values.items()}
        if {"beta", "mu"} <= letters.keys() and values[letters["beta"]] > values[letters["mu"]]:
            for one, other in ((letters["beta"], letters["mu"]), (letters["a"], letters["d"])):
                estimates[one], estimates[other] = estimates[other], estimates[one]
        return estimates

    @property
    def parameter_count(self) -> int:
        """Number of free orders and coefficients."""
        return len(self.estimates)

    def to_dict(self) -> dict[str, Any]:
        """Return fits, estimates, intervals and warnings as a dictionary for JSON."""
        return {
            "parameter_count": self.parameter_count,
            "fit": {run: finite(self.fit(run)) for run in self.comparisons},
            "estimates": {n: float(v) for n, (v, *_) in self.estimates.items()},
            "intervals": {n: json_value(ends) for n, (_, *ends) in self.estimates.items()},
            "warnings": list(self.result.warnings),
        }


@dataclass(frozen=True)
class Verdict:
    """Verdict on whether fractional orders improve the prediction of other runs significantly.

    Parameters
    ----------
    kind
        Structure with fractional orders, a key of ``FREE_ORDERS_BY_KIND``.
    improves
        Whether fractional orders improve the prediction; None if the test is inconclusive.
    reason
        Text with the fits and intervals from which the verdict follows.
    """

    kind: str
    improves: bool | None
    reason: str


@dataclass(frozen=True)
class Deflection:
    """Cross-validation of integer and fractional orders on one deflection of the arm.

    A kind is a structure with certain free orders, a key of ``FREE_ORDERS_BY_KIND``.

    Parameters
    ----------
    output
        Name of the deflection.
    structure
        Structure with free orders of elasticity and damping.
    fits
        Fits by kind, then by name of the estimation run.
    failures
        Error message of each failed fit, by (kind, estimation run).
    without_rate
        Cross-validation of structures without the term in the other deflection's rate. None if the other joint was not
        measured.
    """

    output: str
    structure: Structure
    fits: dict[str, dict[str, RunFit]]
    failures: dict[tuple[str, str], str] = field(default_factory=dict)
    without_rate: Deflection | None = None

    def gains(self, kind: str) -> dict[tuple[str, str], float]:
        """Return the gain in fit of a kind over integer orders [percentage points].

        Keys are (estimation run, validation run). The gain is minus infinity if the fit of this kind failed.
        """
        gains = {}
        for run, whole in self.fits[INTEGER_KIND].items():
            free = self.fits[kind].get(run)
            for other in (name for name in whole.comparisons if name != run):
                before, after = whole.fit(other), -math.inf if free is None else free.fit(other)
                gains[run, other] = 0.0 if before == after else after - before
        return gains

    def worse_runs(self, kind: str) -> list[str]:
        """Return the names of estimation runs to which a kind fits worse than integer orders.

        Integer orders are a special case of every kind, so such a fit has not found the optimum.
        """
        whole = self.fits[INTEGER_KIND]
        return [r for r, free in self.fits[kind].items() if not free.fit(r) > whole[r].fit(r) - MIN_FIT_GAIN]

    def intervals(self, kind: str) -> dict[str, dict[str, tuple[float, float]]]:
        """Return the 95 % intervals (low, high) of the free orders of a kind, by order name, then by estimation run."""
        return {
            name: {run: each.estimates[name][1:] for run, each in self.fits[kind].items()}
            for name in self.structure.order_names
            if letter_of(name) in FREE_ORDERS_BY_KIND[kind]
        }

    @property
    def verdicts(self) -> list[Verdict]:
        """Verdicts on all kinds with a fractional order."""
        return [self.verdict(kind) for kind in FRACTIONAL_KINDS]

    def verdict(self, kind: str) -> Verdict:
        """Return the verdict on one kind with fractional orders, from its gains in fit and the intervals of its orders.

        It is inconclusive if a fit failed, is unusable, or is worse than integer orders on its estimation run.
        """
        intervals, gains, whole, free = self.intervals(kind), self.gains(kind), self.fits[INTEGER_KIND], self.fits[kind]
        worse, used = self.worse_runs(kind), [*free.items(), *whole.items()]
        degenerate = list(dict.fromkeys(run for run, fit in used if is_degenerate(fit.result)))
        complete = not worse and not degenerate and not any(k in (kind, INTEGER_KIND) for k, _ in self.failures)
        integer_orders = {name: integer_order(name) for name in intervals}
        improves = improves_prediction(list(gains.values()), intervals, integer_orders) if complete else None

        def fit(fits: Mapping[str, RunFit], run: str, other: str) -> str:
            return percent(fits[run].fit(other)) if run in fits else "no fit"

        pairs = "; ".join(f"{run} → {o} {fit(whole, run, o)}, then {fit(free, run, o)}" for run, o in gains)
        orders = "; ".join(
            f"{symbol(name)} " + ", ".join(f"{_range(low, high)} on {run}" for run, (low, high) in each.items())
            for name, each in intervals.items()
        )
        words = f"Fit of validation runs, percent: {pairs}. 95 % intervals: {orders}."
        if not all(have_common_value(each.values()) for each in intervals.values()):
            words += " The runs contradict each other."
        if worse:
            words += f" On {', '.join(worse)} it fits worse than the integer orders that it contains: no optimum found."
        if degenerate:
            words += f" On {', '.join(degenerate)} one of the two fits must not be used, so nothing follows from it."
        return Verdict(kind, improves, words)

    def to_dict(self) -> dict[str, Any]:
        """Return equation, verdicts, fits and failures as a dictionary for JSON."""
        without_rate = {} if self.without_rate is None else {"without_rate": self.without_rate.to_dict()}
        return {
            "equation": str(self.structure),
            "verdicts": {v.kind: {"improves": v.improves, "reason": v.reason} for v in self.verdicts},
            "fits": json_value(self.fits),
            "failures": {f"{kind}, {run}": words for (kind, run), words in self.failures.items()},
            **without_rate,
        }

    @property
    def parts(self) -> list[tuple[str, Deflection]]:
        """(heading suffix, cross-validation) with and, if available, without the other deflection's rate."""
        return [("", self)] + ([] if self.without_rate is None else [(f", {WITHOUT_RATE_LABEL}", self.without_rate)])


def _range(low: float, high: float) -> str:
    """Return an interval as text, such as "0.10 to 0.25"; infinite limits are omitted ("from 0.10 up")."""
    ends = [f"{v:.2f}".replace("-", "−") if math.isfinite(v) else "" for v in (low, high)]
    if all(ends):
        return " to ".join(ends)
    return f"up to {ends[1]}" if ends[1] else f"from {ends[0]} up" if ends[0] else "anything"


def percent(value: float) -> str:
    """Return a fit [%] as text with one decimal and a typographic minus sign; "−∞" if it is not finite."""
    return f"{value:.1f}".replace("-", "−") if math.isfinite(value) else "−∞"


@dataclass(frozen=True)
class OrderCrossValidation:
    """Cross-validation of integer against fractional orders over several runs.

    Parameters
    ----------
    runs
        Runs as used for estimation and validation, decimated if they are long.
    deflections
        Cross-validation of each deflection by its name.
    filtered
        Whether the measured deflections passed the 2 Hz low-pass filter of the arm's stock real-time model.
    notes
        Texts on decimation, and on angles that are constant in a part of a run.
    """

    runs: tuple[Run, ...]
    deflections: dict[str, Deflection]
    filtered: bool
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return runs, fits and verdicts as a dictionary for JSON."""
        return {
            "runs": [run.name for run in self.runs],
            "filtered": self.filtered,
            "margin": MIN_FIT_GAIN,
            **attributes(self, ("deflections", "notes")),
        }


def dead_channel_notes(runs: Sequence[Run], stages: Sequence[StageNumber]) -> list[str]:
    """Return texts on angles that are constant in a part of a run, as of a dead sensor; fits use them unchanged."""
    structures = [link_structure(stage, both=len(stages) == 2, filtered=False) for stage in stages]
    found = [(run, dead) for item in structures for run in runs for dead in dead_channel_findings([run], item)]
    return list(dict.fromkeys(f"run {run.name}: {dead.sentence}" for run, dead in found))


def cross_validate_orders(
    runs: Sequence[Run],
    *,
    filtered: bool = True,
    threads: int | None = None,
    log: Callable[[str], None] = lambda _: None,
    progress: Callable[[int, int], None] | None = None,
) -> OrderCrossValidation:
    """Fit models of each deflection to each run with integer and fractional orders, and validate them on other runs.

    A link obeys eq. (15) of the paper with the terms that a real arm requires. They are the measured motion of its hub,
    the influence of hub angles on the strain gauge, and an offset of the gauge per run. If both joints were measured,
    there are also the accelerations of the other joint and the rate of its deflection. All structures have the same
    terms. They differ in the orders of the link's elasticity (integer 0) and damping (integer 1).

    If both joints were measured, all fits are repeated without the rate of the other deflection
    (``Deflection.without_rate``). A fractional order that improves the prediction only without this term compensates
    for it.

    Parameters
    ----------
    runs
        Two or more runs with theta11 and theta12 and (or) theta21 and theta22 [rad]. Runs with more than 1250 samples
        are decimated. Initial terms, initial filter state and gauge offset are estimated for each run.
    filtered
        Whether the measured deflections passed the 2 Hz low-pass filter of the arm's stock real-time model.
    threads, progress
        Number of threads and progress callback; see :func:`ftlm.search_orders`.
    log
        Callback with a line of text at the start of each fit.

    Returns
    -------
    OrderCrossValidation
        Fits, intervals and verdicts for each deflection.

    Raises
    ------
    DataError
        If there are fewer than two runs, two runs have the same name, or no joint has both angles in all runs.
    ModelError
        If a fit with integer orders fails.
    """
    if len(runs) < 2:
        raise DataError(f"cross-validation needs at least two runs, and there is {len(runs)}; give two or more")
    if len({run.name for run in runs}) < len(runs):
        raise DataError(f"runs {join_names(r.name for r in runs)} do not have distinct names; rename a file")
    stages = stages_with(runs, current=False)
    both = len(stages) == 2
    structures = [link_structure(stage, both=both, filtered=filtered) for stage in stages]
    notes: list[str] = []
    used = []
    for run in runs:
        every = -(-run.length // MAX_SAMPLES)
        if every > 1:
            notes.append(f"of run {run.name} one of {every} rows is used, {every * run.step:.4g} s apart")
        used.append(decimate_run(run, every) if every > 1 else run)
    notes += dead_channel_notes(runs, stages)
    if isinstance(progress, Progress):
        numbers = [len(s.order_names) + len(s.coefficient_names) for s in structures]
        each = sum(output_error_cost(run.length, count) for count in numbers for run in used)
        fits = len(FREE_ORDERS_BY_KIND) * (2 if both else 1) * each
        progress.announce("the cross-validation", *duration_bounds(estimate_duration(fits, check_threads(threads))))

    def cross_validate(structure: Structure, suffix: str = "") -> Deflection:
        """Fit a structure with each set of free orders to every run; return the cross-validation of its output."""
        output, own = structure.outputs[0], [run.select(list(structure.signals)) for run in used]
        fits: dict[str, dict[str, RunFit]] = {kind: {} for kind in FREE_ORDERS_BY_KIND}
        failed = {}
        for (kind, free), run in product(FREE_ORDERS_BY_KIND.items(), own):
            log(f"{output}{suffix}: {kind}, fitted to {run.name}")
            fixed = {n: integer_order(n) for n in structure.order_names if letter_of(n) not in free}
            try:
                restricted = structure.with_orders(fixed)
                result = identify(run, restricted, method=JOINT_METHOD, threads=threads, progress=progress)
                fits[kind][run.name] = RunFit(result, {other.name: result.model.compare(other) for other in own})
            except FtlmError as error:
                if kind == INTEGER_KIND:
                    raise ModelError(f"{output}, integer orders, fitted to {run.name}: {error}") from error
                failed[kind, run.name] = str(error)
        return Deflection(output, structure, fits, failed)

    deflections = {}
    for stage, structure in zip(stages, structures, strict=True):
        deflection = cross_validate(structure)
        if both:
            less = link_structure(stage, both=True, filtered=filtered, rate=False)
            deflection = replace(deflection, without_rate=cross_validate(less, f", {WITHOUT_RATE_LABEL}"))
        deflections[deflection.output] = deflection
    return OrderCrossValidation(tuple(used), deflections, filtered, tuple(notes))


def verdict_sentence(output: str, verdict: Verdict) -> str:
    """Return a verdict on a deflection as a sentence that begins with the symbol of the deflection."""
    sentence: str = read_texts("page")["order_verdicts"][verdict.kind][VERDICT_CELLS[verdict.improves]]
    return f"{symbol(output)}: {sentence}"


def _verdict(output: str, verdict: Verdict) -> Markup:
    template = Markup('<span class="verdict"><strong>{}</strong><span class="note">{}</span></span>')
    return template.format(verdict_sentence(output, verdict), verdict.reason)


def validation_charts(result: OrderCrossValidation, deflection: Deflection) -> list[LineChart]:
    """Return one chart per estimation run: the measured deflection and its simulations on the next run in the list.

    The simulations are by the structures with integer orders and with both orders fractional.
    """
    charts, output = [], deflection.output
    names = [run.name for run in result.runs]
    for run, other in zip(names, names[1:] + names[:1], strict=True):
        fits = {kind: deflection.fits[kind].get(run) for kind in (INTEGER_KIND, CHARTED_KIND)}
        models = [(kind, fit.comparisons[other]) for kind, fit in fits.items() if fit is not None]
        words = [
            f"{kind} {percent(fit.fit(other))} % with {fit.parameter_count} parameters" if fit else f"{kind}: no fit"
            for kind, fit in fits.items()
        ]
        title = f"{symbol(output)} on {other}, fitted to {run}"
        caption = "; ".join(words)
        caption = f"{caption[0].upper()}{caption[1:]}."
        charts.append(fit_chart(models, output, title, caption, points=LINE_POINTS, width=SMALL_WIDTH_PX))
    return charts


def rate_effect_table(result: OrderCrossValidation) -> Table | None:
    """Return a table of the verdicts without and with the term in the other deflection's rate.

    Return None if only one joint was measured.
    """
    rows = {
        symbol(output): [
            [kind, *(VERDICT_CELLS[d.verdict(kind).improves] for d in (full.without_rate, full))]
            for kind in FRACTIONAL_KINDS
        ]
        for output, full in result.deflections.items()
        if full.without_rate is not None
    }
    return make_table("rate_effect", rows) if rows else None


def fits_table(result: OrderCrossValidation) -> Table:
    """Return a table of fits [%] with one row per structure and one column per (estimation run, validation run)."""
    pairs = list(product((run.name for run in result.runs), repeat=2))
    rows: dict[str, list[list[Cell]]] = {}
    for output, full in result.deflections.items():
        for suffix, deflection in full.parts:
            cells = rows[f"{symbol(output)}{suffix}"] = []
            for kind, fits in deflection.fits.items():
                count = next((Exact(f.parameter_count) for f in fits.values()), None)
                cells.append([kind, count, *(_fit_cell(fits.get(run), run, other) for run, other in pairs)])
    heads = [f"{run}, fitted" if run == other else f"{run} → {other}" for run, other in pairs]
    return make_table("cross_fits", rows, {"@runs": heads})


def _fit_cell(fit: RunFit | None, run: str, other: str) -> Cell:
    """Return the fit [%] on run `other` of a model fitted to `run` as a table cell, bold if the runs differ."""
    if fit is None:
        return None
    return percent(fit.fit(other)) if run == other else Markup("<strong>{}</strong>").format(percent(fit.fit(other)))


def estimates_table(deflection: Deflection, suffix: str = "") -> Table:
    """Return a table of the estimates and 95 % intervals of every fit to a deflection, one row per parameter."""
    rows: dict[str, list[list[Cell]]] = {}
    for kind, fits in deflection.fits.items():
        for run, fit in fits.items():
            rows[f"{kind}, fitted to {run}"] = [
                [symbol_html(name), value, *(v if math.isfinite(v) else format_bound(v) for v in ends)]
                for name, (value, *ends) in fit.estimates.items()
            ]
    return make_table("cross_estimates", rows, output=f"{symbol(deflection.output)}{suffix}")


def _deflection_section(full: Deflection) -> Section:
    results: dict[str, Identification | None] = {}
    failed: list[str] = []
    for suffix, d in full.parts:
        results |= {f"{kind}, {run}{suffix}": f.result for kind, fits in d.fits.items() for run, f in fits.items()}
        failed += [f"{kind}, {run}{suffix}: {words}" for (kind, run), words in d.failures.items()]
    whole, free = full.fits[INTEGER_KIND], full.fits[CHARTED_KIND]
    run, fit = next(iter({**whole, **free}.items()))
    equations = [*next(iter(whole.values())).result.model.equations, *fit.result.model.equations]
    introduction = f"With integer orders and with both free, fitted to {run}:"
    return Section(
        symbol(full.output),
        [introduction, *map(equation_html, dict.fromkeys(equations))],
        warnings=[*failed, *(f"{models}: {sentence}" for models, sentence in grouped_findings(results))],
        tables=[estimates_table(d, suffix) for suffix, d in full.parts],
    )


def _method_section(result: OrderCrossValidation) -> Section:
    rows = ([r.name, r.length, Exact(round(r.step, 9)), r.duration] for r in result.runs)
    filtered = " Both deflections passed the 2 Hz low-pass of the arm's stock model." if result.filtered else ""
    values = {"filtered": filtered, "min_gain": MIN_FIT_GAIN}
    return make_section("cross_validation", *result.notes, values=values, tables=[make_table("cross_runs", rows)])


def cross_validation_page(result: OrderCrossValidation, path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write charts, verdicts and numbers of a cross-validation as one HTML page, and return its path.

    Parameters
    ----------
    result
        Result of :func:`cross_validate_orders`.
    path
        File to write.
    force
        Whether to overwrite an existing file.

    Raises
    ------
    DataError
        If the file exists and `force` is False, or it cannot be written.
    """
    check_writable(path, force=force)
    both: list[Markup] = []
    alone: list[Markup] = []
    charts: list[LineChart] = []
    for output, deflection in result.deflections.items():
        for verdict in deflection.verdicts:
            (both if verdict.kind == CHARTED_KIND else alone).append(_verdict(output, verdict))
        charts += validation_charts(result, deflection)
    tables = [table for table in (rate_effect_table(result), fits_table(result)) if table is not None]
    sections = [
        Section("On runs that were not fitted to", both, figures=charts, small=True),
        Section("One order at a time", alone, tables=tables),
        *(_deflection_section(d) for d in result.deflections.values()),
        _method_section(result),
    ]
    names = ", ".join(run.name for run in result.runs)
    lead = page_text("cross_validation_lead", names=names)
    return write_page(path, title="Integer against fractional orders", sections=sections, lead=lead, force=force)


def cross_validation_text(result: OrderCrossValidation) -> str:
    """Return a summary for a terminal: verdicts, verdicts without the other deflection's rate, fits, and notes."""
    lines: list[str] = []
    for output, full in result.deflections.items():
        for verdict in full.verdicts:
            lines += [verdict_sentence(output, verdict), f"    {verdict.reason}"]
    for output, full in result.deflections.items():
        if full.without_rate is not None:
            lines += ["", f"{symbol(output)}, {WITHOUT_RATE_LABEL}:"]
            lines += [f"    {verdict_sentence(output, verdict)}" for verdict in full.without_rate.verdicts]
    table = fits_table(result)
    widths = (13, *[max(18, len(head) + 2) for head in table.columns[2:]])
    lines += ["", table.title, *table_text(table, 26, widths)]
    return "\n".join([*lines, *(f"note: {n}" for n in result.notes)])
