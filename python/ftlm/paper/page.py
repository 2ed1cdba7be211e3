"""The paper's section 5 as a page: verdicts first, then every table and figure beside what is printed."""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from markupsafe import Markup

from ftlm.base.output import check_free
from ftlm.data.equations import numeric
from ftlm.fit.recursion import trace_chart
from ftlm.identification.landscape import output_error_landscape
from ftlm.identification.page import estimates_table, grouped_warnings
from ftlm.judge.metrics import metrics
from ftlm.model.charts import bode_charts, response_frequencies
from ftlm.model.typesetting import equation_html
from ftlm.paint.heat import heat_map
from ftlm.paint.lines import line_chart
from ftlm.paint.page import Section, write_page
from ftlm.paint.table import Table
from ftlm.paint.text import Cell, Exact, number, symbol, symbol_html
from ftlm.paper.claims import claims
from ftlm.paper.figures import (
    LINE_POINTS,
    fit_chart,
    flow_chart,
    rival_figures,
    sine_figures,
    stage_figures,
    unit_label,
)
from ftlm.paper.stages import TRACE_EVERY, Recomputed, Stage
from ftlm.paper.tables import (
    LETTERS,
    bounds_table,
    fits_table,
    genetic_table,
    integer_table,
    model_table,
    numbers_of,
    parameters_table,
    rivals_table,
    saturation_table,
    seeds_table,
    steps_table,
    symbols_table,
)
from ftlm.search.result import search_summary

PAPER = (
    "Wang, Li, Li, Liang, Gao: Establishment and Identification of Fractional-Order Model for Structurally Symmetric "
    "Flexible Two-Link Manipulator System, Symmetry 2025, 17, 1072, doi:10.3390/sym17071072"
)


def verdicts(found: Recomputed) -> list[str]:
    """What holds and what does not, a paragraph each."""
    words = {True: "Holds.", False: "Does not hold.", None: "Cannot be told."}
    return [
        Markup('<span class="verdict"><strong>{} {}</strong><span class="note">{}</span></span>').format(
            words[c.holds], c.claim, c.evidence[0].upper() + c.evidence[1:]
        )
        for c in claims(found)
    ]


def _stage_section(found: Recomputed, stage: Stage) -> Section:
    number = stage.number
    table = 4 if number == 1 else 5
    joint = stage.candidates["output error"]
    searches = {
        f"{label}, {o}": s
        for label, c in stage.candidates.items()
        if c.result is not None
        for o, s in c.result.searches.items()
    }
    return Section(
        f"Stage {number} (Table {table}, Figures {3 * number + 1}–{3 * number + 3})",
        paragraphs=[
            "Joint output error, order law and coefficient law imposed:",
            *(equation_html(e) for e in joint.model.equations),
        ],
        warnings=grouped_warnings({label: c.result for label, c in stage.candidates.items()}),
        tables=[
            model_table(stage, f"Table {table}. Identified models of stage {number}, square input"),
            estimates_table(joint.result, found.truth.get(stage.number, {})),
            fits_table(stage),
            search_summary(searches),
        ],
        figures=stage_figures(stage),
    )


def _weak_section(found: Recomputed) -> Section:
    figures = []
    for stage in found.stages.values():
        for output, traces in stage.weak_traces.items():
            named = [(f"p = {p}", trace) for p, trace in traces.items()]
            figures.append(trace_chart(named, title=f"{symbol(output)}: error (45), weak prior", log_x=True))
    return Section(
        "What p does",
        paragraphs=[
            "Recursion (44) is least squares with weights: row i counts min(p, M − i + 1) times, against a prior that "
            "holds the coefficients near 0 with covariance K0. So p is a weight of the data against the prior. With a "
            "weak prior every p gives the least-squares answer, step by step.",
        ],
        tables=[saturation_table(found)],
        figures=figures,
        small=True,
    )


def _near_section(found: Recomputed) -> Section:
    rows: list[list[Cell]] = []
    figures = []
    for stage in found.stages.values():
        for label, candidate in (("printed", stage.near), ("smallest equation error", stage.by_equation)):
            for output in stage.outputs:
                orders, _ = numbers_of(candidate, output)
                rows.append(
                    [Markup("{}, {}").format(symbol_html(output), label), *(Exact(orders[n]) for n in LETTERS[0]),
                     candidate.estimation.equation_error[output].nr, candidate.estimation.output_error[output].nr]
                )  # fmt: skip
        output = stage.outputs[1]
        figures.append(
            fit_chart(
                stage.near.estimation, [("printed orders", stage.near.estimation)], output,
                f"{symbol(output)}: the orders of Table {3 + stage.number} with the best coefficients for this run",
            )
        )  # fmt: skip
    table = Table(
        "Orders close to α: equation error and free run",
        ("angle, orders", *(symbol_html(n) for n in LETTERS[0]), "NR of the equation error", "NR of the free run"),
        rows,
        note="Coefficients by least squares. “Smallest equation error”: the orders that the lattice gives when the "
        "equation error (RMSE) ranks its candidates.",
    )
    words = (
        "With α − ν small, I^(α−ν) y is nearly y itself. A few such terms reproduce any smooth signal on the "
        "right-hand side, whatever the machine is; only the free run shows what the equation knows."
    )
    return Section("Orders close to one another", [words], tables=[table], figures=figures)


def _derivative_section(found: Recomputed) -> Section:
    figures = []
    for stage in found.stages.values():
        part = stage.derived
        nr = metrics(part.published, part.derived).nr
        figures.append(
            line_chart(
                part.time, [("as published", part.published), ("as derived", part.derived)],
                title=f"{symbol(part.output)} from the current alone, order of the current 0 and {part.order:.3g}",
                x_label="time [s]", y_label=unit_label(part.output), points=LINE_POINTS,
                caption=f"All other numbers alike. NR between the two: {nr:.3g}.",
            )
        )  # fmt: skip
    words = (
        "Eliminating the hub angle's highest derivative from (15) by (17) differentiates the current as well, by the "
        "order α₂ − μ₂ + γ₁ − α₁, which (19) and (21) leave out. It vanishes for whole orders. "
        "flexible_link(input_order='derived') keeps it; a symbolic test derives both."
    )
    return Section("The dropped derivative", [words], figures=figures)


def _landscape_section(found: Recomputed) -> Section:
    figures, words = [], []
    fits = [(stage, stage.candidates["output error"].result) for stage in found.stages.values()]
    joint = [(stage, result) for stage, result in fits if result is not None and result.joint is not None]
    with ThreadPoolExecutor(max(1, len(joint))) as pool:
        landscapes = list(pool.map(output_error_landscape, [result for _, result in joint]))
    for (stage, _), drawn in zip(joint, landscapes, strict=True):
        if drawn is not None:
            figures.append(heat_map(drawn))
            words.append(
                f"Stage {stage.number}: the two orders that this run tells apart least are {symbol(drawn.names[0])} "
                f"and {symbol(drawn.names[1])} (correlation {number(drawn.correlation, 3)})."
            )
    return Section("Order landscape", words, figures=figures, small=True)


def _bode_section(found: Recomputed) -> Section:
    figures = []
    for stage in found.stages.values():
        model = stage.candidates["output error"].model
        omega = response_frequencies(model, found.square.step, found.square.duration)
        figures += bode_charts(model, omega)
    return Section(
        "Frequency response", ["Of the joint output-error models, with 95 % bands."], figures=figures, small=True
    )


def _runs_section(found: Recomputed) -> Section:
    rows: list[list[Cell]] = []
    for run in (found.square, found.sine):
        if run is not None:
            rows.append(
                [run.name, run.length, Exact(run.step), run.duration,
                 ", ".join(f"{symbol(n)} ±{np.max(np.abs(run[n])):.3g} {run.units[n]}" for n in run.inputs)]
            )  # fmt: skip
    first = next(iter(found.stages.values()))
    m = first.candidates["p = 7"].estimation.m
    notes = [
        f"M = {m} block pulses, order lattice in steps of {found.lattice.step:g}, α from {found.lattice.alpha[0]:g} to "
        f"{found.lattice.alpha[1]:g}, K0 = 1, rows in Haar coordinates from coarse to fine. Convergence is drawn at "
        f"every {TRACE_EVERY}th step. Instrumental variables are searched two steps around the "
        "orders of least squares.",
        "Explicit Euler steps at the step of the run, 0.002 s on the virtual rig, as in the paper.",
        *found.notes,
    ]
    return Section(
        "Runs and settings", notes, tables=[Table("Runs", ("run", "rows", "step [s]", "length [s]", "currents"), rows)]
    )


def reproduction_page(found: Recomputed, path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write the reproduction as one page.

    Parameters
    ----------
    found
        From :func:`ftlm.reproduce`.
    path
        File to write.
    force
        Whether to overwrite.

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
    missing = (
        [] if found.sine is not None else ["No second run was given: nothing is validated, Figure 10 is left out."]
    )
    sections = [
        Section("What holds and what does not", verdicts(found), warnings=[*missing, *found.notes]),
        Section(
            "Symbols and steps",
            ["Figures 1 and 3 are pictures of the authors' arm and are not shown."],
            tables=[symbols_table(), steps_table()],
            figures=[flow_chart()],
        ),
        Section("Parameters (Table 3)", tables=[parameters_table(), integer_table()]),
        *(_stage_section(found, s) for s in found.stages.values()),
    ]
    if found.sine is not None:
        sections.append(Section("The other input (Figure 10)", figures=sine_figures(found)))
    if any(s.rivals for s in found.stages.values()):
        words = (
            "Both search the same record; the genetic algorithm may evaluate as many candidates as the lattice has. It "
            "varies orders and coefficients and is judged by (45) itself."
        )
        sections.append(
            Section(
                "The genetic algorithm (Tables 6 and 7, Figure 11)", [words],
                tables=[genetic_table(found), rivals_table(found), seeds_table(found), bounds_table(found)],
                figures=rival_figures(found),
            )
        )  # fmt: skip
    sections += [
        _weak_section(found), _near_section(found), _derivative_section(found), _landscape_section(found),
        _bode_section(found), _runs_section(found),
    ]  # fmt: skip
    origin = "a simulated arm whose truth is known" if found.simulated else f"the runs {_names(found)}"
    lead = (
        f"Section 5 of the paper, recomputed on {origin}, beside what the paper prints. {PAPER}. Numbers in rows "
        "marked “printed” are the paper's; every other number, figure and verdict on this page is computed."
    )
    return write_page(path, title="The paper reproduced", sections=sections, lead=lead, force=force)


def _names(found: Recomputed) -> str:
    return " and ".join(f"“{r.name}”" for r in (found.square, found.sine) if r is not None)


def reproduction_text(found: Recomputed) -> str:
    """Verdicts and fits for a terminal."""
    words = {True: "holds", False: "does not hold", None: "cannot be told"}
    lines = []
    for claim in claims(found):
        lines += [f"{words[claim.holds].upper()}: {claim.claim}", f"    {claim.evidence}"]
    for stage in found.stages.values():
        lines += ["", f"Stage {stage.number}: fit of the free run in percent, driven as identified"]
        heads = [f"{o} {run}" for o in stage.outputs for run in ("square", "sine")]
        lines.append(" " * 26 + "".join(f"{h:>16}" for h in heads))
        for label, candidate in stage.candidates.items():
            cells = ""
            for o in stage.outputs:
                other = candidate.validation
                fits = (
                    candidate.estimation.output_error[o].fit,
                    math.nan if other is None else other.output_error[o].fit,
                )
                cells += "".join(f"{'–' if math.isnan(f) else f'{f:.2f}':>16}" for f in fits)
            lines.append(f"{label:<26}{cells}")
        lines += [f"  {numeric(e)}" for e in stage.candidates["output error"].model.equations]
    lines += [f"note: {n}" for n in found.notes]
    return "\n".join(lines)
