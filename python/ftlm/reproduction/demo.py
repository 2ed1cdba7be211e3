"""Demonstration: identification of a simulated arm from end to end, a short reproduction on a coarse order grid."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

from markupsafe import Markup

from ftlm.data.run import Run
from ftlm.estimation.linear import MultiInnovationTrace
from ftlm.estimation.result import Identification
from ftlm.estimation.verdict import Validation
from ftlm.order_search.options import OrderGrid
from ftlm.order_search.result import search_summary
from ftlm.plot.comparison_charts import compared_bars, comparison_charts
from ftlm.plot.model_charts import pole_charts
from ftlm.progress import ShareTracker
from ftlm.report.html_report import behavior_tables, estimates_table, first_findings, grouped_findings, verdict_box
from ftlm.report.text_summary import behavior_lines, equation_lines, finding_lines
from ftlm.reproduction.published_values import INNOVATION_LENGTHS
from ftlm.reproduction.report import (
    convergence_chart,
    criteria_cells,
    derivative_chart,
    fits_text,
    joint_equations,
    letters_of,
    make_table,
    number_cells,
    table_text,
)
from ftlm.reproduction.simulated_arm import STAGE_NUMBERS, demo_run, truth_of
from ftlm.reproduction.stage import GRID_ALPHA, Candidate, DroppedDerivative, Preset, StageWork
from ftlm.svg.figure import Figure
from ftlm.svg.html_page import Section, Table, write_page
from ftlm.utils.files import check_folder
from ftlm.utils.formatting import Cell, json_value, symbol, wrap_text

#: Candidates that the result of an order search keeps.
TOP_CANDIDATES = 20
#: Steps between two points of a convergence curve; 128 points are more than a page shows.
TRACE_EVERY = 16
#: Steps of a stage that are announced: an order search for each p and for least squares, and the joint fit.
PARTS_OF_A_STAGE = len(INNOVATION_LENGTHS) + 2
#: Models that are saved, by the suffix of their file name.
SAVED_MODELS = {"paper": f"p = {INNOVATION_LENGTHS[-1]}", "output-error": "output error"}
#: Models in the terminal summary, with the paper's names of the methods.
SHOWN_MODELS = ("integer order", "p = 1", "p = 7", "least squares", "output error")
#: Column widths of the tables of parameters and errors, and of estimates, in the text.
PAPER_TABLE_WIDTHS, ESTIMATES_WIDTHS = (5,) * 4 + (9,) * 4 + (8, 8, 7, 8, 8, 8), (12, 16, 12, 12, 12)
TABLE_NOTE = (
    "Equation error: measured signals on the right-hand side. Free run: output error, with the other output measured; "
    "the integer-order model has explicit Euler at 2 ms from the current alone, as published, and output error has the "
    "coupled response to the current alone. Output error has (14)–(15), whose deflection moves with the hub and has no "
    "current. Integer order, p and least squares have the paper's (22)–(25), in which a derivative of the current is "
    "missing. p weighs the data against the prior K0 = 1 with coefficients near zero; least squares has no prior."
)


def paper_table(models: Mapping[str, Candidate], *, title: str = "Identified models") -> Table:
    """Return a table in the form of the paper's Tables 4 and 5, with both errors, of models with the same outputs."""

    def cells(label: str, candidate: Candidate, output: str) -> list[Cell]:
        both = (candidate.estimation.equation_error[output], candidate.estimation.output_error[output])
        return [label, *number_cells(*letters_of(candidate.model, output)), *chain(*map(criteria_cells, both))]

    outputs = next(iter(models.values())).estimation.output_error
    rows = {o: [cells(label, c, o) for label, c in models.items()] for o in outputs}
    return make_table("both_errors", rows, title=title)


@dataclass(frozen=True)
class Demo:
    """Results of the demonstration.

    Parameters
    ----------
    square, sine
        The runs.
    models
        Models by stage and label.
    traces
        Convergence by output and p.
    derived
        Effect of the dropped derivative of the current, by stage.
    files
        Written files.
    """

    square: Run
    sine: Run
    models: dict[int, dict[str, Candidate]]
    traces: dict[str, dict[int, MultiInnovationTrace]]
    derived: dict[int, DroppedDerivative]
    files: list[Path]

    @property
    def results(self) -> dict[int, dict[str, Identification]]:
        """Identifications by stage and label."""
        return {n: {k: c.result for k, c in m.items() if c.result is not None} for n, m in self.models.items()}

    @cached_property
    def validations(self) -> dict[int, Validation]:
        """Validation of the output-error models on the sine run, by stage."""
        return {stage: results["output error"].validate(self.sine) for stage, results in self.results.items()}

    @property
    def truth(self) -> dict[int, dict[str, float]]:
        """Orders and free coefficients of the simulated arm, by stage."""
        return {stage: truth_of(stage) for stage in STAGE_NUMBERS}

    def to_dict(self) -> dict[str, Any]:
        """Return models and their errors for JSON."""
        return {
            "models": json_value(self.models),
            "correlation with the current": {d.output: json_value(d.correlations) for d in self.derived.values()},
            "files": [str(f) for f in self.files],
        }


def run_demo(
    folder: Path,
    *,
    increment: float = 0.1,
    noise: float = 1e-4,
    seed: int = 1,
    threads: int | None = None,
    force: bool = False,
    log: Callable[[str], None] = lambda _: None,
    progress: Callable[[int, int], None] | None = None,
) -> Demo:
    """Simulate two runs, and identify every equation by p = 1, 3, 5, 7, least squares and output error.

    Output error uses the equations of the simulated arm, (14)-(15). The other methods use the paper's (22)-(25), whose
    deflections have the wrong sign.

    Parameters
    ----------
    folder
        Folder of runs and models; created if absent.
    increment
        Increment of the order grid; the paper's is 0.05, which takes minutes.
    noise, seed
        See :func:`demo_run`.
    threads, progress
        See :func:`ftlm.search_orders`.
    force
        Whether to overwrite.
    log
        Called with a line about the next step.

    Returns
    -------
    Demo
        Tables and files.

    Raises
    ------
    DataError
        A file exists and ``force`` is not set, or the folder cannot be written.
    """
    names = [f"stage{n}-{stem}.json" for n in STAGE_NUMBERS for stem in SAVED_MODELS]
    check_folder(folder, ["square.csv", "sine.csv", *names, "demo.html"], force=force)
    log("recording both stages on the virtual rig, under a square and a sine current")
    square, sine = (demo_run(shape, noise=noise, seed=seed) for shape in ("square", "sine"))
    demo = Demo(square, sine, {}, {}, {}, [])
    for run in (square, sine):
        demo.files.append(folder / f"{run.name}.csv")
        run.to_csv(demo.files[-1], force=force)
    course = ShareTracker(progress)
    parts = len(STAGE_NUMBERS) * PARTS_OF_A_STAGE
    at = 0

    def begin_part(label: str) -> None:
        nonlocal at
        course.advance_to(at / parts)
        at += 1
        work.progress = course.subtask(at / parts)
        log(label)

    grid = OrderGrid(increment=increment, alpha=GRID_ALPHA)
    preset = Preset(grid, TOP_CANDIDATES, TRACE_EVERY)
    for stage in STAGE_NUMBERS:
        work = StageWork(stage, square, sine, preset, threads, begin_part, None)
        models = {"integer order": work.euler_candidate("integer order", work.manual("integer order"))}
        models |= work.searches()
        words = "all orders and coefficients together by output error, from the current alone"
        models["output error"] = work.joint("output error", work.coupled, words)
        demo.models[stage] = models
        demo.traces.update(work.traces({p: models[f"p = {p}"].model for p in INNOVATION_LENGTHS}))
        demo.derived[stage] = work.dropped_derivative(models["output error"].model)
        for stem, label in SAVED_MODELS.items():
            demo.files.append(folder / f"stage{stage}-{stem}.json")
            models[label].model.save(demo.files[-1], force=force)
    return demo


def demo_text(demo: Demo) -> str:
    """Summary for a terminal: verdicts, models, fits on the validation run, three warnings."""
    lines = [f"A simulated flexible arm: {demo.square.length} rows of a square current, checked on a sine.", ""]
    for stage, results in demo.results.items():
        best = results["output error"]
        estimates = [best.parameters[n] for n in best.names]
        near = sum(abs(p.value - demo.truth[stage][p.name]) <= 2 * p.standard_error for p in estimates)
        lines += wrap_text(f"Stage {stage}, output error: {demo.validations[stage].verdict}")
        lines += [f"  {line}" for line in equation_lines(best.model)]
        lines += [line for line in behavior_lines(best.model) if "mode" in line or "integrates" in line][:3]
        lines += [f"  {near} of {len(estimates)} numbers within two standard errors of the arm's own", ""]
    outputs = list(demo.traces)
    lines.append(f"{'free run, fit %':<16}" + "".join(f"{o:>16}" for o in outputs))
    lines.append(f"{'':<16}" + f"{'square':>10}{'sine':>6}" * len(outputs))
    for label in SHOWN_MODELS:
        fits = [fit for models in demo.models.values() for fit in models[label].fits]
        texts = [f"{round(fit, 1) + 0.0:.1f}" if math.isfinite(fit) else "–" for fit in fits]
        lines.append(f"{label:<16}" + "".join(f"{v:>{(10, 6)[k % 2]}}" for k, v in enumerate(texts)))
    lines += ["", "Fits of pulse means, as in the paper, whose p weighs a prior near zero as well."]
    joint = [results["output error"] for results in demo.results.values()]
    lines += finding_lines([w for r in joint for w in r.findings], how="-v")
    others = sum(len(r.warnings) for results in demo.results.values() for r in results.values() if r not in joint)
    return "\n".join([*lines, f"{others} warnings about the other models: ftlm demo -v, or the page"])


def demo_details(demo: Demo) -> str:
    """All tables for a terminal of 120 columns, followed by the warnings."""
    lines = []
    for stage, models in demo.models.items():
        lines += [f"Stage {stage}, square current (the shape of the paper's Table {3 + stage})"]
        lines += [*table_text(paper_table(models), 16, PAPER_TABLE_WIDTHS), ""]
    lines += ["Fit of the free run in percent: on the square run, and on the sine run that no model has seen"]
    for models in demo.models.values():
        lines += fits_text(models)
    lines += ["", TABLE_NOTE, "", "Which way a link bends: correlation of the deflection with its current"]
    heads = ("simulated arm", "(14)–(15) identified", "the same in (22)–(25)")
    lines.append(" " * 24 + "".join(f"{words:>26}" for words in heads))
    for d in demo.derived.values():
        lines.append(d.output.ljust(24) + "".join(f"{v:>26.2f}" for v in d.correlations.values()))
    lines.append("")
    for stage, results in demo.results.items():
        lines.append(f"Stage {stage}, output error")
        lines += [*table_text(estimates_table(results["output error"], demo.truth[stage]), 8, ESTIMATES_WIDTHS), ""]
    for stage, results in demo.results.items():
        for label, result in results.items():
            lines += [f"warning (stage {stage}, {label}): {w}" for w in result.warnings]
    return "\n".join(lines)


def demo_page(demo: Demo, path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write the demonstration as one HTML page: verdicts, fits on the validation run, then the tables of each stage."""
    boxes = Markup("").join(
        verdict_box(checked.verdict, f"Stage {stage}, output error: ")
        for stage, checked in demo.validations.items()
        if checked.verdict is not None
    )
    runs = {"square, fitted to": "estimation", "sine, not seen": "validation"}
    bars = [
        chart
        for models in demo.models.values()
        for chart in compared_bars(
            [(label, [(run, getattr(c, part)) for run, part in runs.items()]) for label, c in models.items()],
            title="Fit of the free run",
        )
    ]
    validated: list[list[Cell]] = [
        [o, label, c.estimation.output_error[o].fit, prediction.fit, prediction.error, prediction.nr]
        for models in demo.models.values()
        for o in models["output error"].model.outputs
        for label, c in models.items()
        if c.validation is not None and (prediction := c.validation.output_error[o])
    ]
    heads = ("output", "model", "fit % on the square", "fit % on the sine", "error (45) on the sine", "NR on the sine")
    table = Table("Validation on the other input", heads, validated, note="Free runs; error in rad.")
    sections = [
        Section("Which model predicts", figures=bars, small=True),
        *(_stage_section(demo, stage) for stage in demo.results),
        Section("Validation", tables=[table]),
    ]
    lead = (
        "Both stages of a simulated flexible two-link arm with fractional damping, identified from a noisy square run: "
        "by output error in the arm's own equations, and in the paper's equations with every order on a grid. All "
        "models are checked on a sine run."
    )
    return write_page(path, title="ftlm demo", sections=sections, lead=lead, force=force, verdict=boxes)


def _stage_section(demo: Demo, stage: int) -> Section:
    """Section of a stage; findings of the model to be used come first."""
    results = demo.results[stage]
    best = results["output error"]
    compared = {
        "output error, square run": best.comparison,
        "output error, sine run": demo.validations[stage],
        "multi-innovation, p = 7, square run": results["p = 7"].comparison,
    }
    charts: list[Figure] = [
        f for label, c in compared.items() for f in comparison_charts(c, units=best.model.units, label=label)
    ]
    charts += [*pole_charts(best.model), *best.model.step().figures()]
    for output in best.model.outputs:
        title = f"Error (45) of {symbol(output)} after each step of the recursion"
        charts.append(convergence_chart(demo.traces[output], title, log_x=False))
    first, rest = first_findings(best.findings)
    others = grouped_findings({n: r for n, r in results.items() if n != "output error"})
    searches = {f"{n}, {o}": s for n, r in results.items() for o, s in r.searches.items()}
    return Section(
        f"Stage {stage}",
        [*joint_equations(best.model), TABLE_NOTE],
        warnings=first,
        more=[*rest, *others],
        tables=[
            *behavior_tables(best.model),
            estimates_table(best, demo.truth[stage]),
            paper_table(demo.models[stage], title=f"Stage {stage}, square current"),
            search_summary(searches),
        ],
        figures=[*charts, derivative_chart(demo.derived[stage])],
    )
