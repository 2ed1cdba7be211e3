"""Demonstration: identification of a simulated arm from end to end, a short reproduction on a coarse order grid."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ftlm.data.run import Run
from ftlm.estimation.linear import MultiInnovationTrace
from ftlm.estimation.result import Identification
from ftlm.estimation.verdict import Validation
from ftlm.progress import ShareTracker
from ftlm.reproduction.published_values import ANGLE_NAMES, INNOVATION_LENGTHS
from ftlm.reproduction.simulated_arm import STAGE_NUMBERS, demo_run, truth_of
from ftlm.reproduction.stage_models import Preset, StageWork
from ftlm.reproduction.stage_result import Candidate, DroppedDerivative
from ftlm.reproduction.tables import letters_of
from ftlm.structure.order_grid import OrderGrid
from ftlm.utils.files import check_folder
from ftlm.validation.comparison import Metrics, finite

#: Candidates that the result of an order search keeps.
TOP_CANDIDATES = 20
#: Steps between two points of a convergence curve; 128 points are more than a page shows.
TRACE_EVERY = 16
#: Steps of a stage that are announced: an order search for each p and for least squares, and the joint fit.
PARTS_OF_A_STAGE = len(INNOVATION_LENGTHS) + 2
#: Models that are saved, by the suffix of their file name.
SAVED_MODELS = {"paper": f"p = {INNOVATION_LENGTHS[-1]}", "output-error": "output error"}


@dataclass(frozen=True)
class DemoStage:
    """Row of the demonstration's tables, in the form of the paper's Tables 4 and 5, for one output.

    Parameters
    ----------
    label
        Name of the model.
    output
        Output of the equation.
    orders, coefficients
        Values by name; an integer-order model lacks those of absent terms.
    equation_error, output_error
        Errors on the estimation run.
    validation
        Output error on the other run.
    """

    label: str
    output: str
    orders: Mapping[str, float]
    coefficients: Mapping[str, float]
    equation_error: Metrics
    output_error: Metrics
    validation: Metrics


@dataclass(frozen=True)
class Demo:
    """Results of the demonstration.

    Parameters
    ----------
    square, sine
        The runs.
    rows
        Table rows by stage.
    results
        Identifications by stage and label.
    traces
        Convergence by output and p.
    derived
        Effect of the dropped derivative of the current, by stage.
    files
        Written files.
    """

    square: Run
    sine: Run
    rows: dict[int, list[DemoStage]]
    results: dict[int, dict[str, Identification]]
    traces: dict[str, dict[int, MultiInnovationTrace]]
    derived: dict[int, DroppedDerivative]
    files: list[Path]

    @cached_property
    def validations(self) -> dict[int, Validation]:
        """Validation of the output-error models on the sine run, by stage."""
        return {stage: results["output error"].validate(self.sine) for stage, results in self.results.items()}

    @property
    def truth(self) -> dict[int, dict[str, float]]:
        """Orders and free coefficients of the simulated arm, by stage."""
        return {stage: truth_of(stage) for stage in STAGE_NUMBERS}

    def to_dict(self) -> dict[str, Any]:
        """Return rows and estimates for JSON."""
        return {
            "rows": {
                str(stage): [
                    {
                        "model": r.label,
                        "output": r.output,
                        "orders": dict(r.orders),
                        "coefficients": dict(r.coefficients),
                        "equation_error": r.equation_error.to_dict(),
                        "output_error": r.output_error.to_dict(),
                        "validation": r.validation.to_dict(),
                    }
                    for r in rows
                ]
                for stage, rows in self.rows.items()
            },
            "warnings": {
                f"stage {stage}, {label}": list(result.warnings)
                for stage, results in self.results.items()
                for label, result in results.items()
            },
            "correlation with the current": {
                d.output: {words: finite(v) for words, v in d.correlations.items()} for d in self.derived.values()
            },
            "files": [str(f) for f in self.files],
        }


def rows_of(candidate: Candidate) -> list[DemoStage]:
    """Return a table row for every equation of a model that was compared with both runs."""
    own, other = candidate.estimation, candidate.validation
    rows: list[DemoStage] = []
    if other is None:
        return rows
    for item in candidate.model.equations:
        output, index = item.output, 1 + ANGLE_NAMES.index(item.output)
        orders, coefficients = ({f"{n}{index}": v for n, v in part.items()} for part in letters_of(item))
        errors = own.equation_error[output], own.output_error[output], other.output_error[output]
        rows.append(DemoStage(candidate.label, output, orders, coefficients, *errors))
    return rows


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
    demo = Demo(square, sine, {}, {}, {}, {}, [])
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

    preset = Preset(OrderGrid(increment=increment), TOP_CANDIDATES, TRACE_EVERY, common_pulses=False)
    for stage in STAGE_NUMBERS:
        work = StageWork(stage, square, sine, preset, threads, begin_part, None)
        models = {
            "integer order": work.euler_candidate("integer order", work.manual("integer order")),
            **work.searches(),
        }
        words = "all orders and coefficients together by output error, from the current alone"
        models["output error"] = work.joint("output error", work.coupled, words)
        demo.rows[stage] = [row for candidate in models.values() for row in rows_of(candidate)]
        demo.results[stage] = {label: c.result for label, c in models.items() if c.result is not None}
        demo.traces.update(work.traces(models))
        demo.derived[stage] = work.dropped_derivative(models["output error"].model)
        for stem, label in SAVED_MODELS.items():
            demo.files.append(folder / f"stage{stage}-{stem}.json")
            models[label].model.save(demo.files[-1], force=force)
    return demo
