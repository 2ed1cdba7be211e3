"""HTML page and terminal summary of the reproduction, both made from its checks and tables."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup

from ftlm.model.model import Model
from ftlm.plot.model_charts import bode_charts, response_frequencies
from ftlm.report.html_report import estimates_table, grouped_findings
from ftlm.report.typesetting import equation_html
from ftlm.reproduction import figures, tables
from ftlm.reproduction.checks import deviation_text
from ftlm.reproduction.stage_models import COARSE_INCREMENT, REFINED_CANDIDATES
from ftlm.reproduction.stage_result import TRACE_EVERY, Candidate, Stage
from ftlm.structure.equation import format_equation
from ftlm.svg.heat_map import heat_map
from ftlm.svg.html_page import Section, Table, write_page
from ftlm.utils.files import check_free
from ftlm.utils.formatting import SUPERSCRIPT_DIGITS, Cell, Exact, number, symbol

if TYPE_CHECKING:
    from ftlm.reproduction.reproduction import Reproduction

PAPER_REFERENCE = (
    "Wang, Li, Li, Liang, Gao: Establishment and Identification of Fractional-Order Model for Structurally Symmetric "
    "Flexible Two-Link Manipulator System, Symmetry 2025, 17, 1072, doi:10.3390/sym17071072"
)


def typeset(words: str) -> str:
    """Typeset numbers in a text: powers of ten, minus signs, K₀."""
    powers = re.sub(r"(?<=\d)e([+-]\d+)\b", lambda e: f"·10{str(int(e[1])).translate(SUPERSCRIPT_DIGITS)}", words)
    return re.sub(r"(?<![\w.])-(?=\d)", "−", powers).replace("K0", "K₀")


def joint_equations(model: Model) -> list[str]:
    """Return the equations of a joint model as paragraphs."""
    words = "(14)–(15) by joint output error, order law and coefficient law imposed:"
    return [words, *(equation_html(e, model.structure.delay, model.structure.limits) for e in model.equations)]


def _verdict_section(found: Reproduction) -> Section:
    """Section with one line per check, and the cases in a collapsed part."""
    rows: list[list[Cell]] = [
        [
            typeset(c.claim),
            Markup("<strong>{}</strong>").format(typeset(c.verdict)),
            figures.share_picture(c.ruling),
            typeset(c.brief),
        ]
        for c in found.checks
    ]
    numbers = [[typeset(text) for text in (c.claim, c.computed, c.printed, c.rule)] for c in found.checks]
    behind = Table("Numbers", ("the paper's claim", "computed", "printed", "rule of a case"), numbers, wrap=True)
    heads = "the paper's claim", "verdict", "cases", "computed"
    note = (
        "A verdict is computed from all its cases: arms, records, angles, both ends of K₀. A claim holds, or does not, "
        "if all cases agree, and turns with each factor whose change alone changes the outcome. Bars show the share of "
        "cases in which a claim holds, one bar for each level of the deciding factor."
    )
    missing = "No second run was given: nothing is validated, Figure 10 is left out."
    return Section(
        "What holds and what does not",
        tables=[Table("Verdicts", heads, rows, note=note, wrap=True, stacked=True)],
        warnings=[missing] * (found.sine is None),
        fold="All numbers, rules and cases",
        folded_tables=[behind, *tables.case_tables(found)],
    )


def _stage_section(found: Reproduction, stage: Stage) -> Section:
    number, joint = stage.number, stage.candidates["output error"]
    shown = [
        tables.model_table(stage, f"Table {3 + number}. Identified models of stage {number}, square input"),
        estimates_table(joint.result, found.truth.get(number, {})),
        tables.fits_table(stage),
    ]
    warned = [w.partition(": ") for w in grouped_findings({label: c.result for label, c in stage.candidates.items()})]
    if warned:
        rows = [[Markup("{}").format(models), typeset(words)] for models, _, words in warned]
        shown.append(Table(f"Warnings of the fits of stage {number}", ("model", "warning"), rows, wrap=True))
    return Section(
        f"As it should be, stage {number} (Table {3 + number})",
        joint_equations(joint.model),
        figures=figures.stage_figures(stage, simulated=found.simulated),
        fold=f"Table {3 + number}, estimates with intervals, fits" + (", warnings" if warned else ""),
        folded_tables=shown,
    )


def _sections(found: Reproduction) -> list[Section]:
    """All sections in their order; those without content are left out."""
    simulated, stages = found.simulated, list(found.stages.values())
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
    bode = [c for m in joint for c in bode_charts(m, response_frequencies(m, found.square.step, found.square.duration))]
    ran = (
        [f"Standard deviations implied by RMSE / NR over those of the models: {deviation_text(found)}."]
        if found.ran
        else []
    )
    every = [
        _verdict_section(found),
        Section(
            "The printed models, run",
            ["The paper describes its errors as those of the models' responses.", *ran],
            figures=figures.printed_model_charts(found),
            fold="All printed models",
            folded_tables=[tables.printed_runs_table(found)],
        ),
        Section(
            "As printed (Tables 4 and 5)",
            [
                "Tables 4 and 5 are approached with the printed orders, multi-innovation and the error of the equation "
                "in place of the free run. Four choices are not in the paper: K₀ for each angle, own terms on the "
                "left-hand side, the stock filter on the deflections, and which of (22)–(25) and (26) is meant."
            ],
            fold="Ours beside printed",
            folded_tables=[tables.printed_reading_table(found, stage) for stage in stages],
        ),
        *(_stage_section(found, stage) for stage in stages),
    ]
    if found.sine is not None:
        every.append(Section("The other input (Figure 10)", figures=figures.sine_figures(found)))
    if found.rivals:
        every.append(
            Section(
                "The genetic algorithm (Tables 6 and 7, Figure 11)",
                [
                    "All optimizers search the same record by criterion (45) of the free run. Each evaluates as many "
                    "candidates as the order grid has. The rivals vary orders and coefficients. Multi-innovation takes "
                    "the coefficients of the equation error, with a prior near 0 if K₀ is small."
                ],
                figures=figures.rival_figures(found),
                fold="Tables 6 and 7, seeds",
                folded_tables=tables.optimizer_tables(found),
            )
        )
    return [
        *every,
        Section(
            "What p does",
            [
                "Recursion (44) is weighted least squares: row i has the weight min(p, M − i + 1), against a prior "
                "with covariance K0 around 0. So p weighs the data against the prior. With a weak prior every p gives "
                "the least-squares estimate at every step."
            ],
            figures=weak,
            small=True,
            fold="Coefficient a by p",
            folded_tables=[tables.saturation_table(found)],
        ),
        Section(
            "Orders close to one another",
            [
                "If α − ν is small, I^(α−ν) y is nearly y itself. A few such terms on the right-hand side reproduce "
                "any smooth signal. Only the free run shows whether the equation describes the machine."
            ],
            figures=near,
        ),
        Section(
            "The dropped derivative",
            [
                "Eliminating the hub angle's highest derivative from (15) by (17) differentiates the current by the "
                "order α₂ − μ₂ + γ₁ − α₁, which (19) and (21) leave out. It vanishes for integer orders. Without it a "
                "fractional link bends with the current, whereas a real one bends against it: Figures 6(b), 9(b), "
                "10(b) and 10(d). Rows of p, least squares, instrumental variables and the rivals have (22)–(25), as "
                "in the paper. Output error and integer orders identified have (14)–(15)."
            ],
            figures=[figures.derivative_chart(s.derived, simulated=simulated) for s in stages],
        ),
        Section("Order landscape", correlated, figures=[*map(heat_map, landscapes.values())], small=True),
        Section("Frequency response", ["Of the joint output-error models, with 95 % bands."], figures=bode, small=True),
        Section("Parameters (Table 3)", fold="Table 3 and its coefficients", folded_tables=tables.parameter_tables()),
        Section(
            "Symbols and steps",
            ["Figures 1 and 3 are pictures of the authors' arm and are not shown."],
            figures=[figures.flow_chart()],
            fold="Tables 1 and 2",
            folded_tables=tables.description_tables(),
        ),
        _runs_section(found),
    ]


def _runs_section(found: Reproduction) -> Section:
    rows: list[list[Cell]] = []
    for run in found.runs:
        currents = (f"{symbol(n)} ±{np.max(np.abs(run[n])):.3g} {run.units[n]}" for n in run.inputs)
        rows.append([run.name, run.length, Exact(run.step), run.duration, ", ".join(currents)])
    grid, m = found.order_grid, next(iter(found.stages.values())).candidates["p = 7"].estimation.m
    notes = [
        f"M = {m} block pulses, increment of the order grid {grid.increment:g}, α from {grid.alpha[0]:g} to "
        f"{grid.alpha[1]:g}, K₀ = 1, rows in Haar coordinates from coarse to fine. Convergence is computed at every "
        f"{TRACE_EVERY}nd step. Instrumental variables are searched two increments around the orders of least squares. "
        "With K₀ = 1 deflections hardly move, and no bound excludes a candidate: grids finer than "
        f"{COARSE_INCREMENT:g} are searched in increments of that, then around the {REFINED_CANDIDATES} best. "
        "Equations (22)–(25) are fitted by output error from the parameters of (14)–(15).",
        "Explicit Euler steps at the step of the run, 0.002 s on the virtual rig, as in the paper.",
        *found.notes,
    ]
    runs = Table("Runs", ("run", "rows", "step [s]", "length [s]", "currents"), rows)
    return Section("Runs and settings", notes, tables=[runs])


def reproduction_page(found: Reproduction, path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write the reproduction as one HTML page; see :meth:`ftlm.Reproduction.page`."""
    check_free(path, force=force)
    names = " and ".join(f"“{run.name}”" for run in found.runs)
    origin = (
        "a simulated arm whose links move with their hubs, truth known," if found.simulated else f"the runs {names},"
    )
    strongest = f"The printed models, run under the paper's current: {found.checks[0].brief}. " if found.ran else ""
    lead = (
        f"Section 5 of the paper, recomputed on {origin} beside what the paper prints. {typeset(strongest)}Numbers in "
        f"rows marked “printed” are the paper's; every other number, figure and verdict on this page is computed. "
        f"{PAPER_REFERENCE}."
    )
    return write_page(path, title="The paper reproduced", sections=_sections(found), lead=lead, force=force)


def fits_text(models: Mapping[str, Candidate], label: int, widths: Sequence[int]) -> list[str]:
    """Fits of the free runs in percent as text, one line per model, in columns of these widths."""
    lines = []
    for name, candidate in models.items():
        shown = ("–" if math.isnan(fit) else f"{fit:.2f}" for fit in candidate.fits)
        lines.append(name.ljust(label) + "".join(text.rjust(w) for text, w in zip(shown, widths, strict=True)))
    return lines


def reproduction_text(found: Reproduction) -> str:
    """Summary for a terminal: checks, and fits."""
    lines = []
    for check in found.checks:
        lines += [f"{check.verdict.upper()}: {check.claim}", f"    {check.brief}"]
    for stage in found.stages.values():
        lines += ["", f"Stage {stage.number}: fit of the free run in percent, driven as identified"]
        lines.append(" " * 26 + "".join(f"{o + run:>16}" for o in stage.outputs for run in (" square", " sine")))
        lines += fits_text(stage.candidates, 26, [16] * 4)
        best = stage.candidates["output error"].model
        lines += [f"  {format_equation(e, best.structure.describe_inputs('.6g'))}" for e in best.equations]
    return "\n".join([*lines, *(f"note: {n}" for n in found.notes)])
