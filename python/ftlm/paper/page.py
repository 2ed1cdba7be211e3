"""The paper's section 5 as a page: verdicts first, then every table and figure beside what is printed."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup

from ftlm.base.output import check_free
from ftlm.data.equations import numeric
from ftlm.identification.judged import Judged
from ftlm.identification.page import estimates_table, grouped_warnings
from ftlm.model.charts import bode_charts, response_frequencies
from ftlm.model.model import Model
from ftlm.model.typesetting import equation_html
from ftlm.paint.figure import Figure
from ftlm.paint.heat import heat_map
from ftlm.paint.page import Section, write_page
from ftlm.paint.table import Table
from ftlm.paint.text import SUPERSCRIPTS, Cell, Exact, number, symbol
from ftlm.paper import figures, tables
from ftlm.paper.claims import claims, spread_in_words
from ftlm.paper.recomputed import Recomputed
from ftlm.paper.records import TRACE_EVERY, Stage
from ftlm.paper.work import BEST, COARSE
from ftlm.search.result import search_summary

PAPER = (
    "Wang, Li, Li, Liang, Gao: Establishment and Identification of Fractional-Order Model for Structurally Symmetric "
    "Flexible Two-Link Manipulator System, Symmetry 2025, 17, 1072, doi:10.3390/sym17071072"
)


def stage_section(
    heading: str, joint: Model, results: Mapping[str, Judged | None], shown: Sequence[Table],
    charts: Sequence[Figure], *notes: str,
) -> Section:  # fmt: skip
    """The joint model's equations, then tables with that of all searches, and figures."""
    searches = {f"{n}, {o}": s for n, r in results.items() if r is not None for o, s in r.searches.items()}
    words = "(14)–(15) by joint output error, order law and coefficient law imposed:"
    equations = [equation_html(e, joint.structure.delay, joint.structure.limits) for e in joint.equations]
    return Section(
        heading, [words, *equations, *notes], warnings=grouped_warnings(results),
        tables=[*shown, search_summary(searches)], figures=charts,
    )  # fmt: skip


def typeset(words: str) -> str:
    """Words with numbers as a page sets them: powers of ten, a minus, K₀."""
    powers = re.sub(r"(?<=\d)e([+-]\d+)\b", lambda e: f"·10{str(int(e[1])).translate(SUPERSCRIPTS)}", words)
    return re.sub(r"(?<![\w.])-(?=\d)", "−", powers).replace("K0", "K₀")


def _verdict_section(found: Recomputed) -> Section:
    """A line for each verdict, and the numbers behind a fold."""
    told = claims(found)
    rows: list[list[Cell]] = [
        [
            typeset(c.claim),
            Markup("<strong>{}</strong>").format(typeset(c.verdict)),
            figures.share_picture(c.ruling),
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
        warnings=[missing] * (found.sine is None), fold="The numbers behind every verdict", folded_paragraphs=behind,
        folded=[tables.panel_table(found), tables.whole_table(found)],
    )  # fmt: skip


def _ran_section(found: Recomputed) -> Section:
    words = "The paper's errors are said to be those of the models' responses."
    if found.ran:
        words += (
            " The angles that they were identified from, by RMSE / NR, move more than the printed models under the "
            f"paper's own current, by factors {spread_in_words(found)}."
        )
    return Section(
        "The printed models, run", [words], figures=figures.ran_charts(found), fold="All printed models",
        folded=[tables.ran_table(found)],
    )  # fmt: skip


def _printed_section(found: Recomputed) -> Section:
    far = ", ".join(f"{t.away:.2f} ({symbol(o)})" for o, t in found.as_printed.items())
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
    return Section("As printed (Tables 4 and 5)", words, fold="Ours beside printed", folded=shown)


def _stage_section(found: Recomputed, stage: Stage) -> Section:
    number, joint = stage.number, stage.candidates["output error"]
    title = f"Table {3 + number}. Identified models of stage {number}, square input"
    estimates = estimates_table(joint.result, found.truth.get(number, {}))
    words = "(14)–(15) by joint output error, order law and coefficient law imposed:"
    model = joint.model
    equations = [equation_html(e, model.structure.delay, model.structure.limits) for e in model.equations]
    warned = grouped_warnings({label: c.result for label, c in stage.candidates.items()})
    return Section(
        f"As it should be, stage {number} (Table {3 + number})",
        [words, *equations], figures=figures.stage_figures(stage, simulated=found.simulated),
        fold=f"Table {3 + number}, estimates with intervals, fits" + (", warnings" if warned else ""),
        folded=[
            tables.model_table(stage, title), estimates, tables.fits_table(stage),
            *([_warnings_table(number, warned)] if warned else []),
        ],
    )  # fmt: skip


def _warnings_table(stage: int, warned: Sequence[str]) -> Table:
    rows = [[Markup("{}").format(models), typeset(words)] for models, _, words in (w.partition(": ") for w in warned)]
    return Table(f"Warnings of the fits of stage {stage}", ("model", "warning"), rows, wrap=True)


def _rival_section(found: Recomputed) -> Section:
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
        heading, [words], figures=figures.rival_figures(found), fold="Tables 6 and 7, seeds, bounds", folded=folded
    )


def _weak_section(found: Recomputed) -> Section:
    words = (
        "Recursion (44) is least squares with weights: row i counts min(p, M − i + 1) times, against a prior that "
        "holds the coefficients near 0 with covariance K0. So p is a weight of the data against the prior. With a "
        "weak prior every p gives the least-squares answer, step by step."
    )
    charts = [
        figures.convergence_chart(t, f"{symbol(o)}: error (45), weak prior") for o, t in found.weak_traces.items()
    ]
    return Section(
        "What p does", [words], figures=charts, small=True, fold="Coefficient a by p",
        folded=[tables.saturation_table(found)],
    )  # fmt: skip


def _near_section(found: Recomputed) -> Section:
    words = (
        "With α − ν small, I^(α−ν) y is nearly y itself. A few such terms reproduce any smooth signal on the "
        "right-hand side, whatever the machine is; only the free run shows what the equation knows."
    )
    charts = []
    for stage in found.stages.values():
        output, drawn = stage.outputs[1], [("printed orders", stage.near.estimation)]
        of = f"the orders of Table {3 + stage.number} with the best coefficients for this run"
        charts.append(figures.fit_chart(drawn, output, f"{symbol(output)}: {of}", simulated=found.simulated))
    return Section(
        "Orders close to one another", [words], figures=charts, fold="Both errors", folded=[tables.near_table(found)]
    )


def _derivative_section(found: Recomputed) -> Section:
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


def _landscape_section(found: Recomputed) -> Section:
    present = {n: stage.landscape for n, stage in found.stages.items() if stage.landscape is not None}
    words = [
        f"Stage {n}: the two orders that this run tells apart least are {symbol(landscape.names[0])} "
        f"and {symbol(landscape.names[1])} (correlation {number(landscape.correlation, 3)})."
        for n, landscape in present.items()
    ]
    return Section("Order landscape", words, figures=[*map(heat_map, present.values())], small=True)


def _bode_section(found: Recomputed) -> Section:
    charts = []
    for stage in found.stages.values():
        model = stage.candidates["output error"].model
        charts += bode_charts(model, response_frequencies(model, found.square.step, found.square.duration))
    words = "Of the joint output-error models, with 95 % bands."
    return Section("Frequency response", [words], figures=charts, small=True)


def _runs_section(found: Recomputed) -> Section:
    rows: list[list[Cell]] = []
    for run in found.runs:
        currents = (f"{symbol(n)} ±{np.max(np.abs(run[n])):.3g} {run.units[n]}" for n in run.inputs)
        rows.append([run.name, run.length, Exact(run.step), run.duration, ", ".join(currents)])
    first = next(iter(found.stages.values()))
    notes = [
        f"M = {first.candidates['p = 7'].estimation.m} block pulses, order lattice in steps of {found.lattice.step:g}, "
        f"α from {found.lattice.alpha[0]:g} to {found.lattice.alpha[1]:g}, K₀ = 1, rows in Haar coordinates from "
        f"coarse to fine. Convergence is computed at every {TRACE_EVERY}nd step. Instrumental variables are searched "
        "two steps around the orders of least squares. With K₀ = 1 deflections hardly move, and no bound excludes a "
        f"candidate: lattices finer than {COARSE:g} are searched in steps of that for them, then around the {BEST} "
        "best. Equations (22)–(25) are fitted by output error from the numbers of (14)–(15); automatic starts end in "
        "optima that rounding chooses between.",
        "Explicit Euler steps at the step of the run, 0.002 s on the virtual rig, as in the paper.",
        *found.notes,
    ]
    runs = Table("Runs", ("run", "rows", "step [s]", "length [s]", "currents"), rows)
    return Section("Runs and settings", notes, tables=[runs])


def reproduction_page(found: Recomputed, path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write the reproduction as one page; see :meth:`ftlm.Reproduction.page`."""
    check_free(path, force=force)
    sections = [
        _verdict_section(found), _ran_section(found), _printed_section(found),
        *(_stage_section(found, stage) for stage in found.stages.values()),
    ]  # fmt: skip
    if found.sine is not None:
        sections.append(Section("The other input (Figure 10)", figures=figures.sine_figures(found)))
    if found.rivals:
        sections.append(_rival_section(found))
    last = _weak_section, _near_section, _derivative_section, _landscape_section, _bode_section
    sections += [section(found) for section in last]
    sections += [
        Section(
            "Parameters (Table 3)", fold="Table 3 and what follows from it",
            folded=[tables.parameters_table(), tables.integer_table()],
        ),
        Section(
            "Symbols and steps", ["Figures 1 and 3 are pictures of the authors' arm and are not shown."],
            figures=[figures.flow_chart()], fold="Tables 1 and 2",
            folded=[tables.symbols_table(), tables.steps_table()],
        ),
        _runs_section(found),
    ]  # fmt: skip
    names = " and ".join(f"“{run.name}”" for run in found.runs)
    origin = "a simulated arm whose links hang on their hubs, truth known," if found.simulated else f"the runs {names},"
    strongest = next((c for c in claims(found) if c.claim.startswith("The printed models, under")), None)
    shown = (
        "" if strongest is None else f"The printed models, run under the paper's current: {typeset(strongest.brief)}. "
    )
    lead = (
        f"Section 5 of the paper, recomputed on {origin} beside what the paper prints. {shown}Numbers in rows marked "
        f"“printed” are the paper's; every other number, figure and verdict on this page is computed. {PAPER}."
    )
    return write_page(path, title="The paper reproduced", sections=sections, lead=lead, force=force)


def fits_text(fits: Mapping[str, Sequence[float]], label: int, widths: Sequence[int]) -> list[str]:
    """Fits in percent, a line for each model, in columns of these widths."""
    lines = []
    for name, values in fits.items():
        shown = ("–" if math.isnan(fit) else f"{fit:.2f}" for fit in values)
        lines.append(name.ljust(label) + "".join(text.rjust(w) for text, w in zip(shown, widths, strict=True)))
    return lines


def reproduction_text(found: Recomputed) -> str:
    """Verdicts, each with its shortest reason, and fits for a terminal; the page has the numbers."""
    lines = []
    for claim in claims(found):
        lines += [f"{claim.verdict.upper()}: {claim.claim}", f"    {claim.brief}"]
    for stage in found.stages.values():
        lines += ["", f"Stage {stage.number}: fit of the free run in percent, driven as identified"]
        lines.append(" " * 26 + "".join(f"{o + run:>16}" for o in stage.outputs for run in (" square", " sine")))
        fits = {
            label: [
                math.nan if part is None else part.output_error[o].fit
                for o in stage.outputs for part in (c.estimation, c.validation)
            ]
            for label, c in stage.candidates.items()
        }  # fmt: skip
        lines += fits_text(fits, 26, [16] * 4)
        best = stage.candidates["output error"].model
        lines += [f"  {numeric(e, best.structure.acting('.6g'))}" for e in best.equations]
    lines += [f"note: {n}" for n in found.notes]
    return "\n".join(lines)
