"""Demonstration: simulation and identification of a flexible arm, as a short reproduction on a coarse order grid."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

from markupsafe import Markup

from ftlm.data.run import Run
from ftlm.estimation.result import Identification
from ftlm.estimation.verdict import Validation
from ftlm.order_search.options import OrderGrid
from ftlm.order_search.result import search_summary
from ftlm.plot.comparison_charts import compared_bars, comparison_charts
from ftlm.plot.model_charts import pole_charts
from ftlm.report.html_report import behavior_tables, estimates_table, first_findings, grouped_findings, verdict_box
from ftlm.report.text_summary import behavior_lines, equation_lines, finding_lines
from ftlm.reproduction import report
from ftlm.reproduction.published_values import INNOVATION_LENGTHS, LAST_P, page_text
from ftlm.reproduction.report import convergence_chart, derivative_chart, table_text
from ftlm.reproduction.simulated_arm import STAGE_NUMBERS, demo_run, truth_of
from ftlm.reproduction.stage import GRID_ALPHA, Candidate, Preset, Stage, StageWork
from ftlm.reproduction.workload import TotalProgress, WorkerProgress, seconds_of
from ftlm.svg.figure import SMALL_WIDTH_PX, Figure
from ftlm.svg.html_page import Section, Table, write_page
from ftlm.utils.files import check_folder
from ftlm.utils.formatting import Cell, json_value, symbol, wrap_text

#: Number of candidates in the result table of an order search.
TOP_CANDIDATES = 20
#: Number of recursion steps between two points of a convergence curve, which then has 128 points.
TRACE_EVERY = 16
#: Labels of the models that are saved, by the suffix of their file name.
SAVED_MODELS = {"paper": f"p = {LAST_P}", "output-error": "output error"}
#: Title of the bar charts; their fits refer to pulse means, those of verdicts and other charts to all samples.
PULSE_FIT_TITLE = "Fit to pulse means"
#: Labels of the models in the terminal summary. "p = 7" is multi-innovation with innovation length 7.
SHOWN_MODELS = ("integer order", "p = 1", "p = 7", "least squares", "output error")
#: Widths [characters] of the columns after the first one, in text tables of models and of estimates.
PAPER_TABLE_WIDTHS, ESTIMATES_WIDTHS = (5,) * 4 + (9,) * 4 + (8, 8, 7, 8, 8, 8), (12, 16, 12, 12, 12)


def paper_table(models: Mapping[str, Candidate], *, title: str = "Identified models") -> Table:
    """Return a table in the form of the paper's Tables 4 and 5, for models (by label) with the same outputs.

    Each row has the orders, coefficients, equation errors and output errors of one angle by one model.
    """

    def cells(label: str, candidate: Candidate, output: str) -> list[Cell]:
        numbers = report.number_cells(*report.letters_of(candidate.model, output))
        errors = candidate.estimation.equation_error[output], candidate.estimation.output_error[output]
        return [label, *numbers, *chain(*map(report.criteria_cells, errors))]

    outputs = next(iter(models.values())).estimation.output_error
    rows = {o: [cells(label, c, o) for label, c in models.items()] for o in outputs}
    return report.make_table("both_errors", rows, title=title)


@dataclass(frozen=True)
class Demo:
    """Results of the demonstration.

    Parameters
    ----------
    square, sine
        Estimation run and validation run of the simulated arm.
    stages
        Results by joint number (stage). The demonstration omits the comparison of optimizers and the fits with a weak
        prior.
    files
        Paths of the written files.
    """

    square: Run
    sine: Run
    stages: dict[int, Stage]
    files: list[Path]

    @property
    def results(self) -> dict[int, dict[str, Identification]]:
        """Identifications by joint number and label; models that were not identified are omitted."""
        return {
            n: {label: c.result for label, c in stage.candidates.items() if c.result is not None}
            for n, stage in self.stages.items()
        }

    @cached_property
    def validations(self) -> dict[int, Validation]:
        """Validation on the sine run of the model that was fitted by output error, by joint number."""
        return {stage: results["output error"].validate(self.sine) for stage, results in self.results.items()}

    @property
    def truth(self) -> dict[int, dict[str, float]]:
        """True free orders and coefficients of the simulated arm, by joint number and name."""
        return {stage: truth_of(stage) for stage in STAGE_NUMBERS}

    def to_dict(self) -> dict[str, Any]:
        """Return models, their errors and the paths of the files as a dictionary for JSON."""
        return {"stages": json_value(self.stages), "files": [str(f) for f in self.files]}


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
    """Simulate two runs of an arm, identify its models by several methods, and write runs and models to files.

    The methods are multi-innovation with innovation lengths 1, 3, 5 and 7, least squares, and output error. Output
    error uses the equations of the simulated arm, eqs. (14)-(15) of the paper. The other methods use its eqs.
    (22)-(25), whose deflections have the wrong sign.

    Parameters
    ----------
    folder
        Folder of runs and models; created if absent.
    increment
        Increment of the order grid. With the paper's 0.05 the demonstration takes minutes.
    noise, seed
        Standard deviation [rad] and seed of the noise on the angles; see :func:`demo_run`.
    threads, progress
        Number of threads and progress callback; see :func:`ftlm.search_orders`.
    force
        Whether to overwrite existing files.
    log
        Callback with a line of text at the start of each step.

    Returns
    -------
    Demo
        Runs, results of both joints, and paths of the files.

    Raises
    ------
    DataError
        If a file exists and `force` is False, or the folder cannot be written.
    """
    names = [f"stage{n}-{stem}.json" for n in STAGE_NUMBERS for stem in SAVED_MODELS]
    check_folder(folder, ["square.csv", "sine.csv", *names, "demo.html"], force=force)
    log("recording both stages on the virtual rig, under a square and a sine current")
    square, sine = (demo_run(shape, noise=noise, seed=seed) for shape in ("square", "sine"))
    demo = Demo(square, sine, {}, [])
    for run in (square, sine):
        demo.files.append(folder / f"{run.name}.csv")
        run.to_csv(demo.files[-1], force=force)
    grid = OrderGrid(increment=increment, alpha=GRID_ALPHA)
    preset = Preset(grid, TOP_CANDIDATES, TRACE_EVERY, comparison_increment=None, threads=threads)
    seconds = (len(INNOVATION_LENGTHS) + 1) * seconds_of("search", increment) + seconds_of("output error", increment)
    whole = TotalProgress(len(STAGE_NUMBERS) * seconds, progress)
    steps = WorkerProgress(whole, threading.Event())
    for stage in STAGE_NUMBERS:
        work = StageWork(stage, square, sine, preset, log, steps)
        models = {"integer order": work.euler_candidate(work.manual())}
        models |= work.searches()
        work.begin("all orders and coefficients together by output error, from the current alone", "output error")
        models["output error"] = work.identify_candidate(work.estimation_run, work.coupled)
        traces = work.traces({p: models[f"p = {p}"].model for p in INNOVATION_LENGTHS})
        derived = work.dropped_derivative(models["output error"].model)
        demo.stages[stage] = Stage(stage, models, traces, {}, {}, work.printed_orders(), derived, None)
        for stem, label in SAVED_MODELS.items():
            demo.files.append(folder / f"stage{stage}-{stem}.json")
            models[label].model.save(demo.files[-1], force=force)
    whole.end()
    return demo


def demo_text(demo: Demo) -> str:
    """Return a summary for a terminal: verdicts and equations of output-error models, fits on both runs, findings."""
    lines = [f"A simulated flexible arm: {demo.square.length} rows of a square current, checked on a sine.", ""]
    for stage, results in demo.results.items():
        best = results["output error"]
        estimates = [best.parameters[n] for n in best.names]
        near = sum(abs(p.value - demo.truth[stage][p.name]) <= 2 * p.standard_error for p in estimates)
        lines += wrap_text(f"Stage {stage}, output error: {demo.validations[stage].verdict}")
        lines += [f"  {line}" for line in equation_lines(best.model)]
        lines += [line for line in behavior_lines(best.model) if "mode" in line or "integrates" in line][:3]
        lines += [f"  {near} of {len(estimates)} numbers within two standard errors of the arm's own", ""]
    outputs = [output for stage in demo.stages.values() for output in stage.outputs]
    lines.append(f"{'pulse means, %':<16}" + "".join(f"{o:>16}" for o in outputs))
    lines.append(f"{'':<16}" + f"{'square':>10}{'sine':>6}" * len(outputs))
    for label in SHOWN_MODELS:
        fits = [fit for stage in demo.stages.values() for fit in stage.candidates[label].fits]
        texts = [f"{round(fit, 1) + 0.0:.1f}" if math.isfinite(fit) else "–" for fit in fits]
        lines.append(f"{label:<16}" + "".join(f"{v:>{(10, 6)[k % 2]}}" for k, v in enumerate(texts)))
    lines += [
        "",
        "The table shows fits to pulse means, as in the paper; verdicts state fits to all samples.",
    ]
    joint = [results["output error"] for results in demo.results.values()]
    lines += finding_lines([w for r in joint for w in r.findings], hint="-v")
    others = sum(len(r.warnings) for results in demo.results.values() for r in results.values() if r not in joint)
    return "\n".join([*lines, f"{others} warnings about the other models: ftlm demo -v, or the page"])


def demo_details(demo: Demo) -> str:
    """Return all tables as text for a terminal of 120 columns, followed by all warnings."""
    lines = []
    for number, stage in demo.stages.items():
        lines += [f"Stage {number}, square current (the shape of the paper's Table {3 + number})"]
        lines += [*table_text(paper_table(stage.candidates), 16, PAPER_TABLE_WIDTHS), ""]
        lines += ["Fit to pulse means in percent: on the square run, and on the sine run that no model has seen"]
        lines += [
            *report.fits_text(stage.candidates),
            "",
            derivative_chart(stage.dropped_derivative_effect).caption,
            "",
            "Output error",
        ]
        estimates = estimates_table(stage.candidates["output error"].result, demo.truth[number])
        lines += [*table_text(estimates, 8, ESTIMATES_WIDTHS), ""]
    lines += [page_text("demo_tables"), ""]
    for number, results in demo.results.items():
        for label, result in results.items():
            lines += [f"warning (stage {number}, {label}): {w}" for w in result.warnings]
    return "\n".join(lines)


def demo_page(demo: Demo, path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write the demonstration as one HTML page, and return its path.

    The page has charts of the validation run, verdicts, fits, and a section with the tables of each joint. Raise
    DataError if the file exists and `force` is False, or it cannot be written.
    """
    boxes, runs = Markup(""), {"square, fitted to": "estimation", "sine, not seen": "validation"}
    bars: list[Figure] = []
    simulations: list[Figure] = []
    for number, stage in demo.stages.items():
        checked, units = demo.validations[number], demo.results[number]["output error"].model.units
        if checked.verdict is not None:
            boxes += verdict_box(checked.verdict, f"Stage {number}, output error: ")
        fits = [(label, [(r, getattr(c, part)) for r, part in runs.items()]) for label, c in stage.candidates.items()]
        bars += [replace(bar, width=SMALL_WIDTH_PX, caption="") for bar in compared_bars(fits, title=PULSE_FIT_TITLE)]
        # Four charts fit a laptop screen without their sliders, which the sections of the stages have.
        charts = comparison_charts(checked, units=units)
        simulations += [replace(chart, width=SMALL_WIDTH_PX, height=200, slider=False) for chart in charts]
    sections = [
        Section("Measured and simulated: the sine run", figures=simulations, small=True),
        Section("Verdicts", verdict=boxes),
        Section("Fit of every model", page_text("demo_models"), figures=bars, small=True),
        *(_stage_section(demo, stage) for stage in demo.results),
        Section("Fits in numbers", collapsed=True, tables=[report.fits_table(stage) for stage in demo.stages.values()]),
    ]
    title = "A flexible arm, identified from one run"
    return write_page(path, title=title, sections=sections, lead=page_text("demo_lead"), force=force)


def _stage_section(demo: Demo, stage: int) -> Section:
    """Return the section on one joint, in which findings on the output-error model precede those on other models."""
    results = demo.results[stage]
    best = results["output error"]
    compared = {"output error": best, f"multi-innovation, p = {LAST_P}": results[f"p = {LAST_P}"]}
    charts: list[Figure] = []
    for label, result in compared.items():
        charts += comparison_charts(result.comparison, units=best.model.units, label=f"{label}, square run")
    charts += [*pole_charts(best.model), *best.model.step().figures()]
    for output in best.model.outputs:
        title = f"Error (45) of {symbol(output)} after each step of the recursion"
        charts.append(convergence_chart(demo.stages[stage].traces[output], title, log_x=False))
    first, rest = first_findings(best.findings)
    others = grouped_findings({n: r for n, r in results.items() if n != "output error"})
    searches = search_summary({f"{n}, {o}": s for n, r in results.items() for o, s in r.searches.items()})
    tables = paper_table(demo.stages[stage].candidates, title=f"Stage {stage}, square current").split(9)
    return Section(
        f"Stage {stage}",
        [*report.joint_equations(best.model), page_text("demo_tables")],
        warnings=first,
        more=[*rest, *(f"{models}: {sentence}" for models, sentence in others)],
        tables=[*behavior_tables(best.model), estimates_table(best, demo.truth[stage])],
        fold="All models",
        folded_tables=[*tables, searches],
        figures=[*charts, derivative_chart(demo.stages[stage].dropped_derivative_effect)],
    )
