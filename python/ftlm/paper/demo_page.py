"""The demonstration as a page and as text: the paper's tables, the fits, the convergence."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from ftlm.fit.recursion import trace_chart
from ftlm.identification.page import estimates_table, grouped_warnings
from ftlm.judge.charts import comparison_charts
from ftlm.model.typesetting import equation_html
from ftlm.paint.page import Section, write_page
from ftlm.paint.table import Table
from ftlm.paint.text import Cell, symbol
from ftlm.paper.demo import Demo
from ftlm.paper.rows import PaperRow, paper_table, paper_table_text
from ftlm.search.result import search_summary

NOTE = (
    "Equation error: measured signals on the right-hand side. Free run: output error, the other output measured; for "
    "the integer-order model explicit Euler at 2 ms from the current alone, as published, and for output error the "
    "coupled response to the current alone. p weighs the data against the prior K0 = 1 and coefficients near zero; "
    "least squares has no prior."
)


def _letters(found: Mapping[str, float]) -> dict[str, float]:
    """Names without their index: alpha1 is alpha."""
    return {name.rstrip("0123456789"): value for name, value in found.items()}


def paper_rows(found: Demo, stage: int) -> list[PaperRow]:
    """Rows of a stage, those of one output together."""
    rows = found.rows[stage]
    outputs = dict.fromkeys(r.output for r in rows)
    return [
        PaperRow(
            r.label,
            o,
            {n: round(v, 4) + 0.0 for n, v in _letters(r.orders).items()},
            _letters(r.coefficients),
            r.equation_error,
            r.output_error,
        )
        for o in outputs
        for r in rows
        if r.output == o
    ]


def validation_table(found: Demo) -> Table:
    """Fit of every model on the square run, from which it was identified, and on the sine run."""
    rows: list[list[Cell]] = [
        [r.output, r.label, r.output_error.fit, r.validation.fit, r.validation.error, r.validation.nr]
        for stage in found.rows
        for r in sorted(found.rows[stage], key=lambda r: r.output)
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


def demo_text(found: Demo) -> str:
    """Tables for a terminal of 120 columns, warnings last."""
    lines = []
    for stage in found.rows:
        number = 4 if stage == 1 else 5
        lines += [f"Stage {stage}, square current (the shape of the paper's Table {number})"]
        lines += [paper_table_text(paper_rows(found, stage)), ""]
    lines += ["Fit of the free run in percent: on the square run, and on the sine run that no model has seen"]
    for stage in found.rows:
        outputs = list(dict.fromkeys(r.output for r in found.rows[stage]))
        lines.append(" " * 24 + "".join(f"{o + ' square':>18}{o + ' sine':>16}" for o in outputs))
        for label in dict.fromkeys(r.label for r in found.rows[stage]):
            cells = ""
            for o in outputs:
                row = next(r for r in found.rows[stage] if r.label == label and r.output == o)
                cells += f"{row.output_error.fit:>18.2f}{row.validation.fit:>16.2f}"
            lines.append(f"{label:<24}{cells}")
    lines += ["", NOTE, ""]
    for stage, results in found.results.items():
        best = results["output error"]
        estimates = {**best.orders, **(best.joint.coefficients if best.joint is not None else {})}
        lines.append(f"Stage {stage}, output error: estimate ± standard error (truth of the simulated arm)")
        for n, v in estimates.items():
            lines.append(f"  {n:<8}{v:>12.6g} ± {best.standard_errors[n]:<9.2g} ({found.truth[stage][n]:.6g})")
    lines.append("")
    for stage, results in found.results.items():
        for label, result in results.items():
            lines += [f"warning (stage {stage}, {label}): {w}" for w in result.warnings]
    return "\n".join(lines)


def demo_page(found: Demo, path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write everything on one page: warnings, tables, the four fits on both runs, convergence.

    Parameters
    ----------
    found
        The demonstration.
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
    sections = []
    for stage, results in found.results.items():
        best = results["output error"]
        units = dict(best.model.units)
        figures = comparison_charts(best.comparison, units=units, label="output error, square run")
        figures += comparison_charts(best.model.compare(found.sine), units=units, label="output error, sine run")
        paper = results[max((n for n in results if n.startswith("p = ")), key=lambda n: int(n[4:]))]
        figures += comparison_charts(paper.comparison, units=units, label="multi-innovation, p = 7, square run")
        for output, traces in found.traces.items():
            if output in best.model.outputs:
                named = [(f"p = {p}", trace) for p, trace in traces.items()]
                figures.append(
                    trace_chart(named, title=f"Error (45) of {symbol(output)} after each step of the recursion")
                )
        sections.append(
            Section(
                f"Stage {stage}",
                paragraphs=[
                    "Joint output error, order law and coefficient law imposed:",
                    *(equation_html(e) for e in best.model.equations),
                    NOTE,
                ],
                warnings=grouped_warnings(results),
                tables=[
                    estimates_table(best, found.truth[stage]),
                    paper_table(paper_rows(found, stage), title=f"Stage {stage}, square current"),
                    search_summary({f"{n}, {o}": s for n, r in results.items() for o, s in r.searches.items()}),
                ],
                figures=figures,
            )
        )
    sections.append(Section("Validation", tables=[validation_table(found)]))
    lead = (
        "Both stages of a simulated flexible two-link arm with fractional damping, identified from a noisy square run "
        "with every order on a lattice, and checked on a sine run."
    )
    return write_page(path, title="ftlm demo", sections=sections, lead=lead, force=force)
