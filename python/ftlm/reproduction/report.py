"""HTML pages of the reproduction, of the cross-validation and of the demonstration."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from markupsafe import Markup

from ftlm.estimation.result import Identification
from ftlm.estimation.verdict import MIN_FIT_GAIN
from ftlm.model.model import Model
from ftlm.order_search.result import search_summary
from ftlm.plot.comparison_charts import comparison_charts, pulse_times
from ftlm.plot.model_charts import bode_charts, pole_charts, response_frequencies
from ftlm.report.html_report import behavior_tables, estimates_table, first_findings, grouped_findings, verdict_box
from ftlm.report.text_summary import behavior_lines, equation_lines, finding_lines
from ftlm.report.typesetting import equation_html
from ftlm.reproduction import figures, tables
from ftlm.reproduction.claims import ReproductionData, claims, deviation_in_words
from ftlm.reproduction.cross_validation import (
    FREE_ORDERS_BY_KIND,
    INTEGER_KIND,
    WITHOUT_RATE_LABEL,
    Deflection,
    UnseenOrders,
    Verdict,
    percent,
)
from ftlm.reproduction.demo import Demo
from ftlm.reproduction.figures import convergence_chart, derivative_chart
from ftlm.reproduction.stage_models import COARSE_INCREMENT, REFINED_CANDIDATES
from ftlm.reproduction.stage_result import TRACE_EVERY, Stage
from ftlm.reproduction.tables import PaperRow, four_digits, letter_of, paper_table, paper_table_text
from ftlm.structure.equation import format_equation
from ftlm.svg.bar_chart import bar_chart
from ftlm.svg.figure import SMALL_WIDTH_PX, Figure
from ftlm.svg.heat_map import heat_map
from ftlm.svg.html_page import Section, Table, write_page
from ftlm.svg.line_chart import line_chart
from ftlm.utils.files import check_free
from ftlm.utils.formatting import SUPERSCRIPT_DIGITS, Cell, Exact, format_bound, number, symbol, symbol_html, wrap_text

PAPER_REFERENCE = (
    "Wang, Li, Li, Liang, Gao: Establishment and Identification of Fractional-Order Model for Structurally Symmetric "
    "Flexible Two-Link Manipulator System, Symmetry 2025, 17, 1072, doi:10.3390/sym17071072"
)


def stage_section(
    heading: str,
    joint: Model,
    results: Mapping[str, Identification | None],
    shown: Sequence[Table],
    charts: Sequence[Figure],
    *notes: str,
) -> Section:
    """Section with the joint model's equations, tables including all searches, and figures."""
    searches = {f"{n}, {o}": s for n, r in results.items() if r is not None for o, s in r.searches.items()}
    words = "(14)–(15) by joint output error, order law and coefficient law imposed:"
    equations = [equation_html(e, joint.structure.delay, joint.structure.limits) for e in joint.equations]
    return Section(
        heading,
        [words, *equations, *notes],
        warnings=grouped_findings(results),
        tables=[*shown, search_summary(searches)],
        figures=charts,
    )


def typeset(words: str) -> str:
    """Typeset numbers in a text: powers of ten, minus signs, K₀."""
    powers = re.sub(r"(?<=\d)e([+-]\d+)\b", lambda e: f"·10{str(int(e[1])).translate(SUPERSCRIPT_DIGITS)}", words)
    return re.sub(r"(?<![\w.])-(?=\d)", "−", powers).replace("K0", "K₀")


def _verdict_section(found: ReproductionData) -> Section:
    """Section with one line per verdict, and the evidence in a collapsed part."""
    told = claims(found)
    rows: list[list[Cell]] = [
        [
            typeset(c.claim),
            Markup("<strong>{}</strong>").format(typeset(c.verdict)),
            figures.share_picture(c.claim_verdict),
            typeset(c.brief),
        ]
        for c in told
    ]
    verdict = Markup('<span class="verdict"><strong>{}</strong><span class="note">{}: {}</span></span>')
    behind = [
        verdict.format(typeset(c.claim), *(typeset(t[0].upper() + t[1:]) for t in (c.verdict, c.evidence)))
        for c in told
    ]
    heads = "the paper's claim", "verdict", "cases", "shown by"
    missing = "No second run was given: nothing is validated, Figure 10 is left out."
    note = (
        "A verdict is computed from all its cases: arms, records, angles, both ends of K₀, whatever it depends on. It "
        "holds, or does not, where all cases agree, and turns with what changes the outcome while all else stays. Bars "
        "are filled as far as a claim holds, one bar for each level of what decides."
    )
    return Section(
        "What holds and what does not",
        tables=[Table("Verdicts", heads, rows, note=note, wrap=True, stacked=True)],
        warnings=[missing] * (found.sine is None),
        fold="The numbers behind every verdict",
        folded_paragraphs=behind,
        folded_tables=[tables.panel_table(found), tables.order_comparison_table(found)],
    )


def _ran_section(found: ReproductionData) -> Section:
    words = "The paper's errors are said to be those of the models' responses."
    if found.ran:
        words += (
            " The angles that they were identified from, by RMSE / NR, move more than the printed models under the "
            f"paper's own current, by factors {deviation_in_words(found)}."
        )
    return Section(
        "The printed models, run",
        [words],
        figures=figures.printed_model_charts(found),
        fold="All printed models",
        folded_tables=[tables.printed_runs_table(found)],
    )


def _printed_section(found: ReproductionData) -> Section:
    far = ", ".join(f"{t.ratio:.2f} ({symbol(o)})" for o, t in found.as_printed.items())
    others = "; ".join(
        f"{number(t.ratios['b'][-1], 3)}, {number(t.ratios['d'][-1], 3)}, {number(t.ratios['g'][-1], 3)} ({symbol(o)})"
        for o, t in found.as_printed.items()
    )
    ranks = ", ".join(f"{t.rank} of {t.among} ({symbol(o)})" for o, t in found.as_printed.items())
    words = [
        f"How near Tables 4 and 5 can be brought: a and NR, by which K₀ is chosen, within a factor of {far}, in the "
        f"mean; b, d and g over the printed ones with p = 7 are {others}. It takes the printed "
        "orders, multi-innovation, the error of the equation in place of the free run, and choices that the paper does "
        "not name: K₀ for each angle, own terms on the left-hand side, the stock filter on the deflections, which of "
        "(22)–(25) and (26) is meant.",
        f"Among neighbouring orders the printed ones have the places {ranks}.",
    ]
    shown = [tables.printed_reading_table(found, stage) for stage in found.stages.values()]
    return Section("As printed (Tables 4 and 5)", words, fold="Ours beside printed", folded_tables=shown)


def _stage_section(found: ReproductionData, stage: Stage) -> Section:
    number, joint = stage.number, stage.candidates["output error"]
    title = f"Table {3 + number}. Identified models of stage {number}, square input"
    estimates = estimates_table(joint.result, found.truth.get(number, {}))
    words = "(14)–(15) by joint output error, order law and coefficient law imposed:"
    model = joint.model
    equations = [equation_html(e, model.structure.delay, model.structure.limits) for e in model.equations]
    warned = grouped_findings({label: c.result for label, c in stage.candidates.items()})
    return Section(
        f"As it should be, stage {number} (Table {3 + number})",
        [words, *equations],
        figures=figures.stage_figures(stage, simulated=found.simulated),
        fold=f"Table {3 + number}, estimates with intervals, fits" + (", warnings" if warned else ""),
        folded_tables=[
            tables.model_table(stage, title),
            estimates,
            tables.fits_table(stage),
            *([_warnings_table(number, warned)] if warned else []),
        ],
    )


def _warnings_table(stage: int, warned: Sequence[str]) -> Table:
    rows = [[Markup("{}").format(models), typeset(words)] for models, _, words in (w.partition(": ") for w in warned)]
    return Table(f"Warnings of the fits of stage {stage}", ("model", "warning"), rows, wrap=True)


def _rival_section(found: ReproductionData) -> Section:
    words = (
        "All search the same record by the same criterion, (45) of the free run; either rival may evaluate as many "
        "candidates as the lattice has. They vary orders and coefficients; multi-innovation takes the coefficients of "
        "the equation error, pulled towards 0 by a small K₀."
    )
    folded = [
        tables.genetic_table(found),
        tables.rivals_table(found),
        tables.seeds_table(found),
        tables.bounds_table(found),
    ]
    heading = "The genetic algorithm (Tables 6 and 7, Figure 11)"
    return Section(
        heading,
        [words],
        figures=figures.rival_figures(found),
        fold="Tables 6 and 7, seeds, bounds",
        folded_tables=folded,
    )


def _weak_section(found: ReproductionData) -> Section:
    words = (
        "Recursion (44) is least squares with weights: row i counts min(p, M − i + 1) times, against a prior that "
        "holds the coefficients near 0 with covariance K0. So p is a weight of the data against the prior. With a "
        "weak prior every p gives the least-squares answer, step by step."
    )
    charts = [
        figures.convergence_chart(t, f"{symbol(o)}: error (45), weak prior") for o, t in found.weak_traces.items()
    ]
    return Section(
        "What p does",
        [words],
        figures=charts,
        small=True,
        fold="Coefficient a by p",
        folded_tables=[tables.saturation_table(found)],
    )


def _near_section(found: ReproductionData) -> Section:
    words = (
        "With α − ν small, I^(α−ν) y is nearly y itself. A few such terms reproduce any smooth signal on the "
        "right-hand side, whatever the machine is; only the free run shows what the equation knows."
    )
    charts = []
    for stage in found.stages.values():
        output, drawn = stage.outputs[1], [("printed orders", stage.printed_orders.estimation)]
        of = f"the orders of Table {3 + stage.number} with the best coefficients for this run"
        charts.append(figures.fit_chart(drawn, output, f"{symbol(output)}: {of}", simulated=found.simulated))
    return Section(
        "Orders close to one another",
        [words],
        figures=charts,
        fold="Both errors",
        folded_tables=[tables.near_table(found)],
    )


def _derivative_section(found: ReproductionData) -> Section:
    words = (
        "Eliminating the hub angle's highest derivative from (15) by (17) differentiates the current as well, by the "
        "order α₂ − μ₂ + γ₁ − α₁, which (19) and (21) leave out. It vanishes for whole orders. Without it a fractional "
        "link bends with the current, where a real one bends against it: Figures 6(b), 9(b) and 10(b), (d) show it. A "
        "symbolic test derives both. Rows of p, least squares, instrumental variables and the rivals are the paper's "
        "(22)–(25) all the same, as its tables are; with orders free they make up for it by orders that are not the "
        "arm's. Output error, and whole orders identified, have (14)–(15) as they stand, which flexible_link() is."
    )
    charts = [figures.derivative_chart(stage.derived, simulated=found.simulated) for stage in found.stages.values()]
    return Section("The dropped derivative", [words], figures=charts)


def _landscape_section(found: ReproductionData) -> Section:
    present = {n: stage.landscape for n, stage in found.stages.items() if stage.landscape is not None}
    words = [
        f"Stage {n}: the two orders that this run tells apart least are {symbol(landscape.names[0])} "
        f"and {symbol(landscape.names[1])} (correlation {number(landscape.correlation, 3)})."
        for n, landscape in present.items()
    ]
    return Section("Order landscape", words, figures=[*map(heat_map, present.values())], small=True)


def _bode_section(found: ReproductionData) -> Section:
    charts = []
    for stage in found.stages.values():
        model = stage.candidates["output error"].model
        charts += bode_charts(model, response_frequencies(model, found.square.step, found.square.duration))
    words = "Of the joint output-error models, with 95 % bands."
    return Section("Frequency response", [words], figures=charts, small=True)


def _runs_section(found: ReproductionData) -> Section:
    rows: list[list[Cell]] = []
    for run in found.runs:
        currents = (f"{symbol(n)} ±{np.max(np.abs(run[n])):.3g} {run.units[n]}" for n in run.inputs)
        rows.append([run.name, run.length, Exact(run.step), run.duration, ", ".join(currents)])
    first = next(iter(found.stages.values()))
    notes = [
        f"M = {first.candidates['p = 7'].estimation.m} block pulses, order lattice in steps of "
        f"{found.order_grid.increment:g}, "
        f"α from {found.order_grid.alpha[0]:g} to {found.order_grid.alpha[1]:g}, K₀ = 1, rows in Haar coordinates from "
        f"coarse to fine. Convergence is computed at every {TRACE_EVERY}nd step. Instrumental variables are searched "
        "two steps around the orders of least squares. With K₀ = 1 deflections hardly move, and no bound excludes a "
        f"candidate: lattices finer than {COARSE_INCREMENT:g} are searched in steps of that for them, then around "
        f"the {REFINED_CANDIDATES} "
        "best. Equations (22)–(25) are fitted by output error from the numbers of (14)–(15); automatic starts end in "
        "optima that rounding chooses between.",
        "Explicit Euler steps at the step of the run, 0.002 s on the virtual rig, as in the paper.",
        *found.notes,
    ]
    runs = Table("Runs", ("run", "rows", "step [s]", "length [s]", "currents"), rows)
    return Section("Runs and settings", notes, tables=[runs])


def reproduction_page(found: ReproductionData, path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write the reproduction as one HTML page; see :meth:`ftlm.Reproduction.page`."""
    check_free(path, force=force)
    sections = [
        _verdict_section(found),
        _ran_section(found),
        _printed_section(found),
        *(_stage_section(found, stage) for stage in found.stages.values()),
    ]
    if found.sine is not None:
        sections.append(Section("The other input (Figure 10)", figures=figures.sine_figures(found)))
    if found.rivals:
        sections.append(_rival_section(found))
    last = _weak_section, _near_section, _derivative_section, _landscape_section, _bode_section
    sections += [section(found) for section in last]
    sections += [
        Section(
            "Parameters (Table 3)",
            fold="Table 3 and what follows from it",
            folded_tables=[tables.parameters_table(), tables.integer_table()],
        ),
        Section(
            "Symbols and steps",
            ["Figures 1 and 3 are pictures of the authors' arm and are not shown."],
            figures=[figures.flow_chart()],
            fold="Tables 1 and 2",
            folded_tables=[tables.symbols_table(), tables.steps_table()],
        ),
        _runs_section(found),
    ]
    names = " and ".join(f"“{run.name}”" for run in found.runs)
    origin = "a simulated arm whose links hang on their hubs, truth known," if found.simulated else f"the runs {names},"
    strongest = next((c for c in claims(found) if c.claim.startswith("The printed models, under")), None)
    shown = (
        "" if strongest is None else f"The printed models, run under the paper's current: {typeset(strongest.brief)}. "
    )
    lead = (
        f"Section 5 of the paper, recomputed on {origin} beside what the paper prints. {shown}Numbers in rows marked "
        "“printed” are the paper's; every other number, figure and verdict on this page is computed. "
        f"{PAPER_REFERENCE}."
    )
    return write_page(path, title="The paper reproduced", sections=sections, lead=lead, force=force)


def fits_text(fits: Mapping[str, Sequence[float]], label: int, widths: Sequence[int]) -> list[str]:
    """Fits in percent as text, one line per model, in columns of these widths."""
    lines = []
    for name, values in fits.items():
        shown = ("–" if math.isnan(fit) else f"{fit:.2f}" for fit in values)
        lines.append(name.ljust(label) + "".join(text.rjust(w) for text, w in zip(shown, widths, strict=True)))
    return lines


def reproduction_text(found: ReproductionData) -> str:
    """Summary for a terminal: verdicts with their main number, and fits."""
    lines = []
    for claim in claims(found):
        lines += [f"{claim.verdict.upper()}: {claim.claim}", f"    {claim.brief}"]
    for stage in found.stages.values():
        lines += ["", f"Stage {stage.number}: fit of the free run in percent, driven as identified"]
        lines.append(" " * 26 + "".join(f"{o + run:>16}" for o in stage.outputs for run in (" square", " sine")))
        fits = {
            label: [
                math.nan if part is None else part.output_error[o].fit
                for o in stage.outputs
                for part in (c.estimation, c.validation)
            ]
            for label, c in stage.candidates.items()
        }
        lines += fits_text(fits, 26, [16] * 4)
        best = stage.candidates["output error"].model
        lines += [f"  {format_equation(e, best.structure.describe_inputs('.6g'))}" for e in best.equations]
    lines += [f"note: {n}" for n in found.notes]
    return "\n".join(lines)


#: Structure in the charts: elasticity and damping fractional, as in the paper.
CHARTED_KIND = "both fractional"
#: Subject and both endings of a verdict for each kind.
VERDICT_PHRASES = {
    "fractional elasticity": ("a fractional order of the elasticity", "earns its place", "does not earn its place"),
    "fractional damping": ("a fractional order of the damping", "earns its place", "does not earn its place"),
    CHARTED_KIND: ("fractional orders", "earn their place", "do not earn their place"),
}
#: Verdict in a table cell.
VERDICT_CELLS = {True: "yes", False: "no", None: "cannot be told"}
#: Points of a line.
LINE_POINTS = 700


def sentence(output: str, verdict: Verdict) -> str:
    """Return a verdict as a sentence."""
    what, yes, no = VERDICT_PHRASES[verdict.kind]
    if verdict.earns is None:
        return f"{symbol(output)}: whether {what} {yes} cannot be told."
    return f"{symbol(output)}: {what} {yes if verdict.earns else no}."


def _verdict(output: str, verdict: Verdict) -> Markup:
    template = Markup('<span class="verdict"><strong>{}</strong><span class="note">{}</span></span>')
    return template.format(sentence(output, verdict), verdict.words)


def unseen_charts(found: UnseenOrders, deflection: Deflection) -> list[Figure]:
    """Charts of a deflection and its simulations by both structures on the run after the estimation run."""
    charts = []
    names = [run.name or "" for run in found.runs]
    for run, judged in zip(names, names[1:] + names[:1], strict=True):
        output = deflection.output
        whole = deflection.fits[INTEGER_KIND][run]
        at = whole.comparisons[judged]
        lines = [("measured", at.measured[output][0])]
        told = []
        for kind in (INTEGER_KIND, CHARTED_KIND):
            fitted = deflection.fits[kind].get(run)
            if fitted is None:
                told.append(f"{kind}: no fit")
                continue
            lines.append((kind, fitted.comparisons[judged].simulated[output][0]))
            told.append(f"{kind} {percent(fitted.fit(judged))} % with {fitted.numbers} numbers")
        words = "; ".join(told)
        charts.append(
            line_chart(
                pulse_times(at),
                lines,
                title=f"{symbol(output)} on {judged}, fitted to {run}",
                x_label="time [s]",
                y_label=f"{symbol(output)} [rad]",
                points=LINE_POINTS,
                width=SMALL_WIDTH_PX,
                caption=f"{words[0].upper()}{words[1:]}.",
            )
        )
    return charts


def _all_deflections(found: UnseenOrders) -> list[tuple[str, Deflection]]:
    """Return every structure with its heading; those without the rate follow those with it."""
    out = []
    for output, deflection in found.deflections.items():
        out.append((symbol(output), deflection))
        if deflection.before is not None:
            out.append((f"{symbol(output)}, {WITHOUT_RATE_LABEL}", deflection.before))
    return out


def places_table(found: UnseenOrders) -> Table | None:
    """Table of the verdicts without and with the rate of the other deflection."""
    rows: list[list[Cell]] = []
    headings = {}
    for output, deflection in found.deflections.items():
        if deflection.before is not None:
            headings[len(rows)] = symbol(output)
            pair = (deflection.before, deflection)
            rows += [
                [kind, *(VERDICT_CELLS[d.verdict(kind).earns] for d in pair)]
                for kind in FREE_ORDERS_BY_KIND
                if kind != INTEGER_KIND
            ]
    if not rows:
        return None
    return Table(
        "Does the order earn its place?",
        ("order", "without rate", "with rate"),
        rows,
        headings=headings,
        note="The rate of the other deflection stands in a link's equation as the gain of an observer would. An order "
        "that earns its place only without it stood in for that gain.",
    )


def fits_table(found: UnseenOrders) -> Table:
    """Table of the fits of every structure on all runs, with its orders."""
    names = [run.name or "" for run in found.runs]
    pairs = [(run, other) for run in names for other in names]
    rows: list[list[Cell]] = []
    headings = {}
    for heading, deflection in _all_deflections(found):
        headings[len(rows)] = heading
        for kind, each in deflection.fits.items():
            numbers = next((f.numbers for f in each.values()), None)
            fits: list[Cell] = []
            for run, other in pairs:
                value = each[run].fit(other) if run in each else None
                shown = None if value is None else percent(value)
                fits.append(shown if shown is None or run == other else Markup("<strong>{}</strong>").format(shown))
            rows.append([kind, None if numbers is None else Exact(numbers), *fits])
    heads = [f"{run}, fitted" if run == other else f"{run} → {other}" for run, other in pairs]
    return Table(
        "Fit of the free run in percent",
        ("structure", "numbers free", *heads),
        rows,
        headings=headings,
        note="In bold the runs that were not fitted to. 100 is perfect, 0 is as good as the mean. Initial terms, the "
        "filter's state and the gauge's zero are each run's own; of the judged run nothing else is estimated.",
    )


def estimates_table_unseen_page(deflection: Deflection, told: str = "") -> Table:
    """Table of the estimates with 95 % intervals of every fit, one line per parameter."""
    rows: list[list[Cell]] = []
    headings = {}
    for kind, each in deflection.fits.items():
        for run, fitted in each.items():
            headings[len(rows)] = f"{kind}, fitted to {run}"
            for name, (value, low, high) in fitted.estimates.items():
                rows.append(
                    [symbol_html(name), value, *(v if math.isfinite(v) else format_bound(v) for v in (low, high))]
                )
    title = f"{symbol(deflection.output)}{told}: estimates and their 95 % intervals"
    return Table(title, ("number", "estimate", "from", "to"), rows, headings=headings)


def _unseen_section(found: UnseenOrders) -> Section:
    verdicts = [_verdict(o, d.verdict(CHARTED_KIND)) for o, d in found.deflections.items()]
    charts = [chart for d in found.deflections.values() for chart in unseen_charts(found, d)]
    return Section("On runs that were not fitted to", verdicts, figures=charts, small=True)


def _deflection_section(deflection: Deflection) -> Section:
    parts = [("", deflection)] + ([] if deflection.before is None else [(f", {WITHOUT_RATE_LABEL}", deflection.before)])
    results = {
        f"{k}, {run}{told}": f.result for told, d in parts for k, each in d.fits.items() for run, f in each.items()
    }
    failed = [f"{kind}, {run}{told}: {words}" for told, d in parts for (kind, run), words in d.failed.items()]
    last = next(iter(deflection.fits[INTEGER_KIND].values())).result.model
    first, run = next(
        (f.result.model, run) for run, f in {**deflection.fits[INTEGER_KIND], **deflection.fits[CHARTED_KIND]}.items()
    )
    equations = [equation_html(e) for e in dict.fromkeys((*last.equations, *first.equations))]
    words = f"With whole orders and with both free, fitted to {run}:"
    return Section(
        symbol(deflection.output),
        [words, *equations],
        warnings=[*failed, *grouped_findings(results)],
        tables=[estimates_table_unseen_page(d, told) for told, d in parts],
    )


def _method_section(found: UnseenOrders) -> Section:
    rows: list[list[Cell]] = [[r.name, r.length, Exact(round(r.step, 9)), r.duration] for r in found.runs]
    words = [
        "A link is the Euler–Lagrange equation (15) with what a real arm needs: it hangs on the measured motion of its "
        "hub, whose coefficient −1 is known; the other stage's accelerations push on it where both stages were "
        "measured, and the rate of the other deflection steadies it as an observer's gain would; hub angles leak into "
        "its gauge; the gauge has an unknown zero."
        + (" Both deflections passed the 2 Hz low-pass of the arm's stock model." if found.filtered else ""),
        "All structures have the same terms. Whole orders: elasticity of order 0, damping of order 1.",
        f"An order earns its place where every fitted run's 95 % interval excludes the whole one, the runs' intervals "
        f"have a value in common, no unseen run loses {MIN_FIT_GAIN:g} points of fit and the middle one gains as much. "
        "It does not where no unseen run gains that, or no interval excludes the whole order and the middle run gains "
        "less. The rest cannot be told, as where a fit is worse on its own run than the whole orders that it contains.",
        *found.notes,
    ]
    return Section("How it is judged", words, tables=[Table("Runs", ("run", "rows", "step [s]", "length [s]"), rows)])


def unseen_page(found: UnseenOrders, path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write charts, verdicts and numbers as one HTML page.

    Parameters
    ----------
    found
        From :func:`orders_on_unseen_runs`.
    path
        File to write.
    force
        Overwrite.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    DataError
        The file exists and ``force`` is not set, or cannot be written.
    """
    check_free(path, force=force)
    alone = [_verdict(o, v) for o, d in found.deflections.items() for v in d.verdicts if v.kind != CHARTED_KIND]
    places = places_table(found)
    sections = [
        _unseen_section(found),
        Section("One order at a time", alone, tables=[*([] if places is None else [places]), fits_table(found)]),
        *(_deflection_section(d) for d in found.deflections.values()),
        _method_section(found),
    ]
    names = ", ".join(run.name or "" for run in found.runs)
    lead = (
        f"Deflections of a flexible arm in runs {names}: each model is fitted to one run and runs free on another, "
        "with whole orders and with fractional ones in the same terms."
    )
    return write_page(path, title="Integer against fractional orders", sections=sections, lead=lead, force=force)


def unseen_text(found: UnseenOrders) -> str:
    """Summary of verdicts and fits for a terminal."""
    lines: list[str] = []
    for output, deflection in found.deflections.items():
        for verdict in deflection.verdicts:
            lines += [sentence(output, verdict), f"    {verdict.words}"]
    names = [run.name or "" for run in found.runs]
    for output, deflection in found.deflections.items():
        if deflection.before is not None:
            lines += ["", f"{symbol(output)}, {WITHOUT_RATE_LABEL}:"]
            lines += [f"    {sentence(output, verdict)}" for verdict in deflection.before.verdicts]
    for heading, deflection in _all_deflections(found):
        lines += ["", f"{heading}: fit of the free run in percent, fitted to the first, judged on the second"]
        lines.append(" " * 24 + "numbers".rjust(8) + "".join(f"{a} → {b}".rjust(18) for a in names for b in names))
        lines += [_line(kind, deflection, names) for kind in FREE_ORDERS_BY_KIND]
    return "\n".join([*lines, *(f"note: {n}" for n in found.notes)])


def _line(kind: str, deflection: Deflection, names: Sequence[str]) -> str:
    each = deflection.fits[kind]
    numbers = next((str(f.numbers) for f in each.values()), "–")
    shown = [percent(each[a].fit(b)) if a in each else "no fit" for a in names for b in names]
    return kind.ljust(24) + numbers.rjust(8) + "".join(text.rjust(18) for text in shown)


TABLE_NOTE = (
    "Equation error: measured signals on the right-hand side. Free run: output error, the other output measured; for "
    "the integer-order model explicit Euler at 2 ms from the current alone, as published, and for output error the "
    "coupled response to the current alone. Output error has the arm as it is, (14)–(15): its deflection hangs on the "
    "hub's motion, without a current. Integer order, p and least squares have the paper's (22)–(25), in which a "
    "derivative of the current is missing. p weighs the data against the prior K0 = 1 and coefficients near zero; "
    "least squares has no prior."
)


def paper_rows(demo: Demo, stage: int) -> list[PaperRow]:
    """Table rows of a stage, grouped by output."""
    rows = []
    for r in sorted(demo.rows[stage], key=lambda r: r.output):
        orders, coefficients = ({letter_of(n): v for n, v in part.items()} for part in (r.orders, r.coefficients))
        rows.append(PaperRow(r.label, r.output, four_digits(orders), coefficients, r.equation_error, r.output_error))
    return rows


def validation_table(demo: Demo) -> Table:
    """Table of the fits of every model on the square run (estimation) and on the sine run (validation)."""
    rows: list[list[Cell]] = [
        [r.output, r.label, r.output_error.fit, r.validation.fit, r.validation.error, r.validation.nr]
        for stage in demo.rows
        for r in sorted(demo.rows[stage], key=lambda r: r.output)
    ]
    columns = (
        "output",
        "model",
        "fit % on the square",
        "fit % on the sine",
        "error (45) on the sine",
        "NR on the sine",
    )
    return Table("Validation on the other input", columns, rows, note="Free runs; error in rad.")


#: Models in the first table, with the paper's names of the methods.
SHOWN_MODELS = ("integer order", "p = 1", "p = 7", "least squares", "output error")


def demo_text(demo: Demo) -> str:
    """Summary for a terminal: verdicts, models, fits on the validation run, three warnings."""
    square = demo.square
    lines = [
        f"A simulated flexible arm: {square.length} rows of a square current, checked on a sine.",
        "",
    ]
    for stage, results in demo.results.items():
        best = results["output error"]
        checked = demo.validations[stage]
        estimates = [p for n, p in best.parameters.items() if n in best.names]
        near = sum(abs(p.value - demo.truth[stage][p.name]) <= 2 * p.standard_error for p in estimates)
        lines += wrap_text(f"Stage {stage}, output error: {checked.verdict}")
        lines += [f"  {line}" for line in equation_lines(best.model)]
        lines += [line for line in behavior_lines(best.model) if "mode" in line or "integrates" in line][:3]
        lines += [f"  {near} of {len(estimates)} numbers within two standard errors of the arm's own", ""]
    outputs = [r.output for stage in demo.rows for r in demo.rows[stage] if r.label == SHOWN_MODELS[0]]
    lines.append(f"{'free run, fit %':<16}" + "".join(f"{o:>16}" for o in outputs))
    lines.append(f"{'':<16}" + f"{'square':>10}{'sine':>6}" * len(outputs))
    for label in SHOWN_MODELS:
        fits = [
            fit
            for stage in demo.rows
            for r in demo.rows[stage]
            if r.label == label
            for fit in (r.output_error.fit, r.validation.fit)
        ]
        shown = [f"{round(fit, 1) + 0.0:.1f}" if math.isfinite(fit) else "–" for fit in fits]
        lines.append(f"{label:<16}" + "".join(f"{v:>{(10, 6)[k % 2]}}" for k, v in enumerate(shown)))
    lines += [
        "",
        "Fits of pulse means, as in the paper, whose p weighs a prior near zero as well.",
    ]
    said = [w for results in demo.results.values() for w in results["output error"].findings]
    lines += finding_lines(said, how="-v")
    others = sum(
        len(r.warnings) for results in demo.results.values() for n, r in results.items() if n != "output error"
    )
    lines.append(f"{others} warnings about the other models: ftlm demo -v, or the page")
    return "\n".join(lines)


def demo_details(demo: Demo) -> str:
    """All tables for a terminal of 120 columns, followed by the warnings."""
    lines = []
    for stage in demo.rows:
        lines += [f"Stage {stage}, square current (the shape of the paper's Table {3 + stage})"]
        lines += [paper_table_text(paper_rows(demo, stage)), ""]
    lines += ["Fit of the free run in percent: on the square run, and on the sine run that no model has seen"]
    for rows in demo.rows.values():
        fits: dict[str, list[float]] = {}
        for r in rows:
            fits.setdefault(r.label, []).extend((r.output_error.fit, r.validation.fit))
        outputs = dict.fromkeys(r.output for r in rows)
        lines.append(" " * 24 + "".join(f"{o + ' square':>18}{o + ' sine':>16}" for o in outputs))
        lines += fits_text(fits, 24, (18, 16) * len(outputs))
    lines += ["", TABLE_NOTE, "", "Which way a link bends: correlation of the deflection with its current"]
    lines.append(
        " " * 24
        + "".join(f"{words:>26}" for words in ("simulated arm", "(14)–(15) identified", "the same in (22)–(25)"))
    )
    for d in demo.derived.values():
        lines.append(d.output.ljust(24) + "".join(f"{v:>26.2f}" for v in d.correlations.values()))
    lines.append("")
    for stage, results in demo.results.items():
        best = results["output error"]
        estimates = {**best.orders, **(best.fit.coefficients if best.fit is not None else {})}
        lines.append(f"Stage {stage}, output error: estimate ± standard error (truth of the simulated arm)")
        for n, v in estimates.items():
            lines.append(f"  {n:<8}{v:>12.6g} ± {best.standard_errors[n]:<9.2g} ({demo.truth[stage][n]:.6g})")
    lines.append("")
    for stage, results in demo.results.items():
        for label, result in results.items():
            lines += [f"warning (stage {stage}, {label}): {w}" for w in result.warnings]
    return "\n".join(lines)


def demo_page(demo: Demo, path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write the demonstration as one HTML page: verdicts, fits on the validation run, then the tables of each stage.

    Raises
    ------
    DataError
        The file exists and ``force`` is not set, or cannot be written.
    """
    boxes = Markup("").join(
        verdict_box(checked.verdict, f"Stage {stage}, output error: ")
        for stage, checked in demo.validations.items()
        if checked.verdict is not None
    )
    sections = [_demo_section(demo)]
    for stage, results in demo.results.items():
        best, paper = results["output error"], results["p = 7"]
        compared = {
            "output error, square run": best.comparison,
            "output error, sine run": demo.validations[stage],
            "multi-innovation, p = 7, square run": paper.comparison,
        }
        units = best.model.units
        figures = [f for label, c in compared.items() for f in comparison_charts(c, units=units, label=label)]
        figures += [*pole_charts(best.model), *best.model.step().figures()]
        for output in best.model.outputs:
            title = f"Error (45) of {symbol(output)} after each step of the recursion"
            figures.append(convergence_chart(demo.traces[output], title, log_x=False))
        figures.append(derivative_chart(demo.derived[stage]))
        table = paper_table(paper_rows(demo, stage), title=f"Stage {stage}, square current")
        tables = [*behavior_tables(best.model), estimates_table(best, demo.truth[stage]), table]
        whole = stage_section(f"Stage {stage}", best.model, results, tables, figures, TABLE_NOTE)
        # What is said of the model that is meant to be used comes first; the paper's methods have the rest.
        shown, left = first_findings(best.findings)
        others = grouped_findings({n: r for n, r in results.items() if n != "output error"})
        sections.append(replace(whole, warnings=shown, more=[*left, *others]))
    sections.append(Section("Validation", tables=[validation_table(demo)]))
    lead = (
        "Both stages of a simulated flexible two-link arm with fractional damping, identified from a noisy square run, "
        "as they are by output error and in the paper's equations with every order on a lattice, and checked on a sine "
        "run."
    )
    return write_page(path, title="ftlm demo", sections=sections, lead=lead, force=force, verdict=boxes)


def _demo_section(demo: Demo) -> Section:
    """Fits of all models on the validation run as bars, one chart per output."""
    figures = []
    for stage in demo.rows:
        for output in dict.fromkeys(r.output for r in demo.rows[stage]):
            rows = [r for r in demo.rows[stage] if r.output == output]
            groups = [
                ("square, fitted to", [r.output_error.fit for r in rows]),
                ("sine, not seen", [r.validation.fit for r in rows]),
            ]
            figures.append(
                bar_chart(
                    [r.label for r in rows],
                    groups,
                    title=f"Fit of the free run of {symbol(output)}",
                    x_label="fit [%]",
                    high=100.0,
                    width=SMALL_WIDTH_PX,
                )
            )
    return Section("Which model predicts", figures=figures, small=True)
