"""The demonstration as a page and as text: the paper's tables, the fits, the convergence."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

from markupsafe import Markup

from ftlm.identification.first import behaviour_tables, first_warnings, verdict_box
from ftlm.identification.page import estimates_table, grouped_warnings
from ftlm.identification.summary import behaviour_in_words, concerns_in_words, equations_in_words
from ftlm.judge.charts import comparison_charts
from ftlm.model.charts import pole_charts
from ftlm.paint.bars import bar_chart
from ftlm.paint.figure import SMALL
from ftlm.paint.page import Section, write_page
from ftlm.paint.table import Table
from ftlm.paint.text import Cell, symbol, wrapped
from ftlm.paper.demo import Demo
from ftlm.paper.figures import convergence_chart, derivative_chart
from ftlm.paper.page import fits_text, stage_section
from ftlm.paper.rows import PaperRow, four_digits, letter_of, paper_table, paper_table_text

NOTE = (
    "Equation error: measured signals on the right-hand side. Free run: output error, the other output measured; for "
    "the integer-order model explicit Euler at 2 ms from the current alone, as published, and for output error the "
    "coupled response to the current alone. Output error has the arm as it is, (14)–(15): its deflection hangs on the "
    "hub's motion, without a current. Integer order, p and least squares have the paper's (22)–(25), in which a "
    "derivative of the current is missing. p weighs the data against the prior K0 = 1 and coefficients near zero; "
    "least squares has no prior."
)


def paper_rows(demo: Demo, stage: int) -> list[PaperRow]:
    """Rows of a stage, those of one output together."""
    rows = []
    for r in sorted(demo.rows[stage], key=lambda r: r.output):
        orders, coefficients = ({letter_of(n): v for n, v in part.items()} for part in (r.orders, r.coefficients))
        rows.append(PaperRow(r.label, r.output, four_digits(orders), coefficients, r.equation_error, r.output_error))
    return rows


def validation_table(demo: Demo) -> Table:
    """Fit of every model on the square run, from which it was identified, and on the sine run."""
    rows: list[list[Cell]] = [
        [r.output, r.label, r.output_error.fit, r.validation.fit, r.validation.error, r.validation.nr]
        for stage in demo.rows
        for r in sorted(demo.rows[stage], key=lambda r: r.output)
    ]
    columns = (
        "output", "model", "fit % on the square", "fit % on the sine", "error (45) on the sine", "NR on the sine",
    )  # fmt: skip
    return Table("Validation on the other input", columns, rows, note="Free runs; error in rad.")


#: Models whose fits the first screen shows, and what the paper calls the method.
SHOWN_MODELS = ("integer order", "p = 1", "p = 7", "least squares", "output error")


def demo_text(demo: Demo) -> str:
    """What came out on one screen: both verdicts, both models, who predicts the run that nobody saw, three warnings."""
    square = demo.square
    lines = [
        f"A simulated flexible arm: {square.length} rows of a square current, checked on a sine.", "",
    ]  # fmt: skip
    for stage, results in demo.results.items():
        best = results["output error"]
        checked = demo.checked[stage]
        estimates = {**best.orders, **best.joint_values}
        near = sum(abs(v - demo.truth[stage][n]) <= 2 * best.standard_errors[n] for n, v in estimates.items())
        lines += wrapped(f"Stage {stage}, output error: {checked.verdict}")
        lines += [f"  {line}" for line in equations_in_words(best.model)]
        lines += [line for line in behaviour_in_words(best.model) if "mode" in line or "integrates" in line][:3]
        lines += [f"  {near} of {len(estimates)} numbers within two standard errors of the arm's own", ""]
    outputs = [r.output for stage in demo.rows for r in demo.rows[stage] if r.label == SHOWN_MODELS[0]]
    lines.append(f"{'free run, fit %':<16}" + "".join(f"{o:>16}" for o in outputs))
    lines.append(f"{'':<16}" + f"{'square':>10}{'sine':>6}" * len(outputs))
    for label in SHOWN_MODELS:
        fits = [
            fit for stage in demo.rows for r in demo.rows[stage] if r.label == label
            for fit in (r.output_error.fit, r.validation.fit)
        ]  # fmt: skip
        shown = [f"{round(fit, 1) + 0.0:.1f}" if math.isfinite(fit) else "–" for fit in fits]
        lines.append(f"{label:<16}" + "".join(f"{v:>{(10, 6)[k % 2]}}" for k, v in enumerate(shown)))
    lines += [
        "",
        "Fits of pulse means, as in the paper, whose p weighs a prior near zero as well.",
    ]
    said = [w for results in demo.results.values() for w in results["output error"].warnings]
    lines += concerns_in_words(said, how="-v")
    others = sum(
        len(r.warnings) for results in demo.results.values() for n, r in results.items() if n != "output error"
    )
    lines.append(f"{others} warnings about the other models: ftlm demo -v, or the page")
    return "\n".join(lines)


def demo_details(demo: Demo) -> str:
    """All tables for a terminal of 120 columns, warnings last."""
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
    lines += ["", NOTE, "", "Which way a link bends: correlation of the deflection with its current"]
    lines.append(" " * 24 + "".join(f"{words:>26}" for words in ("simulated arm", "(14)–(15) identified",
                                                                 "the same in (22)–(25)")))  # fmt: skip
    for d in demo.derived.values():
        lines.append(d.output.ljust(24) + "".join(f"{v:>26.2f}" for v in d.correlations.values()))
    lines.append("")
    for stage, results in demo.results.items():
        best = results["output error"]
        estimates = {**best.orders, **(best.joint.coefficients if best.joint is not None else {})}
        lines.append(f"Stage {stage}, output error: estimate ± standard error (truth of the simulated arm)")
        for n, v in estimates.items():
            lines.append(f"  {n:<8}{v:>12.6g} ± {best.standard_errors[n]:<9.2g} ({demo.truth[stage][n]:.6g})")
    lines.append("")
    for stage, results in demo.results.items():
        for label, result in results.items():
            lines += [f"warning (stage {stage}, {label}): {w}" for w in result.warnings]
    return "\n".join(lines)


def demo_page(demo: Demo, path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write everything on one page: both verdicts, who predicts the other run, then each stage with its tables.

    Raises
    ------
    DataError
        The file exists and ``force`` is not set, or cannot be written.
    """
    boxes = Markup("").join(
        verdict_box(checked.verdict, f"Stage {stage}, output error: ")
        for stage, checked in demo.checked.items() if checked.verdict is not None
    )  # fmt: skip
    sections = [_first_section(demo)]
    for stage, results in demo.results.items():
        best, paper = results["output error"], results["p = 7"]
        compared = {
            "output error, square run": best.comparison, "output error, sine run": demo.checked[stage],
            "multi-innovation, p = 7, square run": paper.comparison,
        }  # fmt: skip
        units = best.model.units
        figures = [f for label, c in compared.items() for f in comparison_charts(c, units=units, label=label)]
        figures += [*pole_charts(best.model), *best.model.step().figures()]
        for output in best.model.outputs:
            title = f"Error (45) of {symbol(output)} after each step of the recursion"
            figures.append(convergence_chart(demo.traces[output], title, log_x=False))
        figures.append(derivative_chart(demo.derived[stage]))
        table = paper_table(paper_rows(demo, stage), title=f"Stage {stage}, square current")
        tables = [*behaviour_tables(best.model), estimates_table(best, demo.truth[stage]), table]
        whole = stage_section(f"Stage {stage}", best.model, results, tables, figures, NOTE)
        # What is said of the model that is meant to be used comes first; the paper's methods have the rest.
        shown, left = first_warnings(best.warnings)
        others = grouped_warnings({n: r for n, r in results.items() if n != "output error"})
        sections.append(replace(whole, warnings=shown, more=[*left, *others]))
    sections.append(Section("Validation", tables=[validation_table(demo)]))
    lead = (
        "Both stages of a simulated flexible two-link arm with fractional damping, identified from a noisy square run, "
        "as they are by output error and in the paper's equations with every order on a lattice, and checked on a sine "
        "run."
    )
    return write_page(path, title="ftlm demo", sections=sections, lead=lead, force=force, verdict=boxes)


def _first_section(demo: Demo) -> Section:
    """Which model predicts the run that none has seen, as bars, an output each."""
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
                    [r.label for r in rows], groups, title=f"Fit of the free run of {symbol(output)}",
                    x_label="fit [%]", high=100.0, width=SMALL,
                )
            )  # fmt: skip
    return Section("Which model predicts", figures=figures, small=True)
