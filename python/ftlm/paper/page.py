"""The paper's section 5 as a page: verdicts first, then every table and figure beside what is printed."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from markupsafe import Markup

from ftlm.base.output import check_free
from ftlm.data.equations import numeric
from ftlm.identification.judged import Judged
from ftlm.identification.landscape import output_error_landscape
from ftlm.identification.page import estimates_table, grouped_warnings
from ftlm.model.charts import bode_charts, response_frequencies
from ftlm.model.model import Model
from ftlm.model.typesetting import equation_html
from ftlm.paint.figure import Figure
from ftlm.paint.heat import heat_map
from ftlm.paint.page import Section, write_page
from ftlm.paint.table import Table
from ftlm.paint.text import Cell, Exact, number, symbol
from ftlm.paper import figures, tables
from ftlm.paper.claims import claims
from ftlm.paper.records import TRACE_EVERY, Recomputed, Stage
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


def _verdict_section(found: Recomputed) -> Section:
    """What holds and what does not, a paragraph each."""
    words = {True: "Holds.", False: "Does not hold.", None: "Cannot be told."}
    verdict = Markup('<span class="verdict"><strong>{} {}</strong><span class="note">{}</span></span>')
    verdicts = [verdict.format(words[c.holds], c.claim, c.evidence[0].upper() + c.evidence[1:]) for c in claims(found)]
    missing = "No second run was given: nothing is validated, Figure 10 is left out."
    warnings = [missing] * (found.sine is None) + list(found.notes)
    return Section("What holds and what does not", verdicts, warnings=warnings)


def _stage_section(found: Recomputed, stage: Stage) -> Section:
    number, joint = stage.number, stage.candidates["output error"]
    title = f"Table {3 + number}. Identified models of stage {number}, square input"
    estimates = estimates_table(joint.result, found.truth.get(number, {}))
    return stage_section(
        f"Stage {number} (Table {3 + number}, Figures {3 * number + 1}–{3 * number + 3})", joint.model,
        {label: c.result for label, c in stage.candidates.items()},
        [tables.model_table(stage, title), estimates, tables.fits_table(stage)], figures.stage_figures(stage),
    )  # fmt: skip


def _rival_section(found: Recomputed) -> Section:
    words = (
        "Both search the same record; the genetic algorithm may evaluate as many candidates as the lattice has. It "
        "varies orders and coefficients and is judged by (45) itself."
    )
    both = [tables.genetic_table(found), tables.rivals_table(found)]
    how = [tables.seeds_table(found), tables.bounds_table(found)]
    heading = "The genetic algorithm (Tables 6 and 7, Figure 11)"
    return Section(heading, [words], tables=[*both, *how], figures=figures.rival_figures(found))


def _weak_section(found: Recomputed) -> Section:
    words = (
        "Recursion (44) is least squares with weights: row i counts min(p, M − i + 1) times, against a prior that "
        "holds the coefficients near 0 with covariance K0. So p is a weight of the data against the prior. With a "
        "weak prior every p gives the least-squares answer, step by step."
    )
    charts = [
        figures.convergence_chart(t, f"{symbol(o)}: error (45), weak prior") for o, t in found.weak_traces.items()
    ]
    return Section("What p does", [words], tables=[tables.saturation_table(found)], figures=charts, small=True)


def _near_section(found: Recomputed) -> Section:
    words = (
        "With α − ν small, I^(α−ν) y is nearly y itself. A few such terms reproduce any smooth signal on the "
        "right-hand side, whatever the machine is; only the free run shows what the equation knows."
    )
    charts = []
    for stage in found.stages.values():
        output, drawn = stage.outputs[1], [("printed orders", stage.near.estimation)]
        of = f"the orders of Table {3 + stage.number} with the best coefficients for this run"
        charts.append(figures.fit_chart(drawn, output, f"{symbol(output)}: {of}"))
    return Section("Orders close to one another", [words], tables=[tables.near_table(found)], figures=charts)


def _derivative_section(found: Recomputed) -> Section:
    words = (
        "Eliminating the hub angle's highest derivative from (15) by (17) differentiates the current as well, by the "
        "order α₂ − μ₂ + γ₁ − α₁, which (19) and (21) leave out. It vanishes for whole orders. Without it a fractional "
        "link bends with the current, where a real one bends against it. A symbolic test derives both. Rows of p, "
        "least squares, instrumental variables and the genetic algorithm are the paper's (22)–(25) all the same, as "
        "its tables are; with orders free they make up for it by orders that are not the arm's. Output error, and "
        "whole orders identified, have (14)–(15) as they stand, which flexible_link() is."
    )
    charts = [figures.derivative_chart(stage.derived) for stage in found.stages.values()]
    return Section("The dropped derivative", [words], figures=charts)


def _landscape_section(found: Recomputed) -> Section:
    fits = {n: stage.candidates["output error"].result for n, stage in found.stages.items()}
    joint = {n: result for n, result in fits.items() if result is not None and result.joint is not None}
    with ThreadPoolExecutor(max(1, len(joint))) as pool:
        drawn = dict(zip(joint, pool.map(output_error_landscape, joint.values()), strict=True))
    present = {n: landscape for n, landscape in drawn.items() if landscape is not None}
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
        f"α from {found.lattice.alpha[0]:g} to {found.lattice.alpha[1]:g}, K0 = 1, rows in Haar coordinates from "
        f"coarse to fine. Convergence is drawn at every {TRACE_EVERY}th step. Instrumental variables are searched two "
        "steps around the orders of least squares.",
        "Explicit Euler steps at the step of the run, 0.002 s on the virtual rig, as in the paper.",
        *found.notes,
    ]
    runs = Table("Runs", ("run", "rows", "step [s]", "length [s]", "currents"), rows)
    return Section("Runs and settings", notes, tables=[runs])


def reproduction_page(found: Recomputed, path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write the reproduction as one page; see :meth:`ftlm.Reproduction.page`."""
    check_free(path, force=force)
    sections = [
        _verdict_section(found),
        Section(
            "Symbols and steps", ["Figures 1 and 3 are pictures of the authors' arm and are not shown."],
            tables=[tables.symbols_table(), tables.steps_table()], figures=[figures.flow_chart()],
        ),
        Section("Parameters (Table 3)", tables=[tables.parameters_table(), tables.integer_table()]),
        *(_stage_section(found, stage) for stage in found.stages.values()),
    ]  # fmt: skip
    if found.sine is not None:
        sections.append(Section("The other input (Figure 10)", figures=figures.sine_figures(found)))
    if found.rivals:
        sections.append(_rival_section(found))
    last = _weak_section, _near_section, _derivative_section, _landscape_section, _bode_section, _runs_section
    sections += [section(found) for section in last]
    names = " and ".join(f"“{run.name}”" for run in found.runs)
    origin = "a simulated arm whose links hang on their hubs, truth known," if found.simulated else f"the runs {names},"
    lead = (
        f"Section 5 of the paper, recomputed on {origin} beside what the paper prints. {PAPER}. Numbers in rows "
        "marked “printed” are the paper's; every other number, figure and verdict on this page is computed."
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
    """Verdicts and fits for a terminal."""
    words = {True: "HOLDS", False: "DOES NOT HOLD", None: "CANNOT BE TOLD"}
    lines = []
    for claim in claims(found):
        lines += [f"{words[claim.holds]}: {claim.claim}", f"    {claim.evidence}"]
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
