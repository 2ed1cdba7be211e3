"""Reproduction of the paper's section 5: computed and printed tables and figures, and verdicts on its claims."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, wait
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from ftlm.data.run import Run
from ftlm.errors import ModelError
from ftlm.estimation.genetic import GeneticAlgorithm, load_differential_evolution, load_pygad
from ftlm.model.model import Model
from ftlm.order_search.options import OrderGrid
from ftlm.progress import format_time_left
from ftlm.reproduction import stage as computation
from ftlm.reproduction.checks import Check, checks
from ftlm.reproduction.published_values import AsPrinted, PrintedModelRun, as_printed, page_text, run_printed_models
from ftlm.reproduction.report import reproduction_page
from ftlm.reproduction.simulated_arm import (
    MAIN_ARM,
    STAGE_NUMBERS,
    StageNumber,
    demo_run,
    other_arms,
    stages_of,
    truth_of,
)
from ftlm.reproduction.stage import Cases, OptimizerComparison, Preset, Stage, StageWork
from ftlm.reproduction.workload import COMPARISON_INCREMENT, TotalProgress, WorkerProgress, seconds_of_all
from ftlm.utils.files import check_folder, write_atomically
from ftlm.utils.formatting import attributes, json_value
from ftlm.utils.resources import estimate_duration, interruptible_pool
from ftlm.utils.validation import check_threads, real_number

#: Label in verdicts for the arm of measured runs.
MEASURED_LABEL = "as measured"
#: Names of the files of runs and tables, which are written besides the model files.
ALWAYS_SAVED = ("square.csv", "sine.csv", "tables.json")
#: Duration of each wait for the workers, after which Ctrl-C can take effect [s].
INTERRUPT_POLL_S = 0.1


@dataclass(frozen=True)
class Reproduction:
    """Result of :func:`ftlm.reproduce`: reproduction of section 5 of the paper.

    Parameters
    ----------
    square, sine
        Estimation run (square current) and validation run (sine current); the latter is None if there is none.
    simulated
        Whether the runs come from the virtual rig, whose parameters are known.
    stages
        Results of each joint (stage) by its number.
    order_grid
        Order grid of the searches.
    notes
        Texts on omitted or modified results, with reasons.
    cases
        Cases on which verdicts are based, for all arms and records and both prior covariances.
    printed_model_runs
        Simulations of the models printed in the paper, under the paper's current.
    as_printed
        Tables 4 and 5 of the paper, recomputed by its method, by angle.
    """

    square: Run
    sine: Run | None
    simulated: bool
    stages: dict[int, Stage]
    order_grid: OrderGrid
    notes: tuple[str, ...] = ()
    cases: Cases = field(default_factory=Cases)
    printed_model_runs: tuple[PrintedModelRun, ...] = ()
    as_printed: dict[str, AsPrinted] = field(default_factory=dict)

    @property
    def checks(self) -> list[Check]:
        """Claims of the paper, each with computed and printed numbers and a verdict."""
        return checks(self)

    @property
    def truth(self) -> dict[int, dict[str, float]]:
        """True orders and coefficients of the simulated arm, by joint number and name; empty for measured runs."""
        return {n: truth_of(n) for n in self.stages} if self.simulated else {}

    @property
    def reference_label(self) -> str:
        """Label of the lines of the runs in charts: "simulated arm" or "measured"."""
        return "simulated arm" if self.simulated else "measured"

    @property
    def runs(self) -> list[Run]:
        """Estimation run (square current), and validation run (sine current) if there is one."""
        return [self.square] if self.sine is None else [self.square, self.sine]

    @property
    def angles(self) -> list[tuple[Stage, str]]:
        """Pairs (results of a joint, name of one of its angles) for all angles."""
        return [(stage, output) for stage in self.stages.values() for output in stage.outputs]

    @property
    def printed_runs_by_output(self) -> dict[str, list[PrintedModelRun]]:
        """Simulations of the models printed in the paper, by angle."""
        return {o: [run for run in self.printed_model_runs if run.output == o] for _, o in self.angles}

    @property
    def optimizer_comparisons(self) -> dict[str, OptimizerComparison]:
        """Optimizer comparisons of all joints, by output."""
        return {o: each for stage in self.stages.values() for o, each in stage.optimizer_comparisons.items()}

    def page(self, path: str | os.PathLike[str], *, force: bool = False) -> Path:
        """Write the reproduction as one HTML file, and return its path.

        Parameters
        ----------
        path
            File to write.
        force
            Whether to overwrite an existing file.

        Raises
        ------
        DataError
            If the file exists and `force` is False, or it cannot be written.
        """
        return reproduction_page(self, path, force=force)

    def save(self, folder: str | os.PathLike[str], *, force: bool = False) -> list[Path]:
        """Write runs, models and the numbers of all tables to a folder.

        Each table can be recomputed from these files: ``square.csv``, ``sine.csv``, one model file per table row, and
        ``tables.json``.

        Parameters
        ----------
        folder
            Folder of the files; created if absent.
        force
            Whether to overwrite existing files.

        Returns
        -------
        list of pathlib.Path
            Paths of the files.

        Raises
        ------
        DataError
            If a file exists and `force` is False, or the folder cannot be written.
        """
        where, models = Path(folder), dict[str, Model]()
        for number, stage in self.stages.items():
            models |= {f"stage{number}-{slug(label)}.json": c.model for label, c in stage.candidates.items()}
        for output, comparison in self.optimizer_comparisons.items():
            models |= {f"{output}-{slug(label)}.json": c.model for label, c in comparison.models.items()}
        check_folder(where, [*ALWAYS_SAVED, *models], force=force)
        runs = dict(zip(ALWAYS_SAVED, self.runs, strict=False))
        for name, run in runs.items():
            run.to_csv(where / name, force=force)
        for name, model in models.items():
            model.save(where / name, force=force)
        text = json.dumps(self.to_dict(), indent=1, ensure_ascii=False, allow_nan=False)
        write_atomically(where / ALWAYS_SAVED[-1], text.encode(), force=force)
        return [where / name for name in (*runs, *models, ALWAYS_SAVED[-1])]

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers of all tables, and the verdicts, as a dictionary for JSON."""
        return {
            "runs": [run.name for run in self.runs],
            "simulated": self.simulated,
            "order_grid": attributes(self.order_grid, ("increment", "alpha")),
            "as it should be": json_value(self.stages),
            **attributes(self, ("checks", "as_printed")),
            "printed_model_runs": json_value(self.printed_model_runs),
            "cases": json_value(self.cases),
            "notes": json_value(self.notes),
        }


def slug(label: str) -> str:
    """Return a label as part of a file name: letters and digits, with hyphens in place of other characters."""
    return "-".join("".join(c if c.isalnum() else " " for c in label).split())


def reproduce(
    square: Run | None = None,
    sine: Run | None = None,
    *,
    increment: float = 0.05,
    noise: float = 1e-4,
    seed: int = 1,
    genetic: GeneticAlgorithm | None = None,
    comparison_increment: float = COMPARISON_INCREMENT,
    arms: Sequence[str] | None = None,
    records: int = 3,
    threads: int | None = None,
    log: Callable[[str], None] = lambda _: None,
    progress: Callable[[int, int], None] | None = None,
) -> Reproduction:
    """Reproduce section 5 of the paper, on the virtual rig or on measured runs.

    Parameters
    ----------
    square
        Estimation run with I1 [A], theta11, theta12 [rad] and (or) I2, theta21, theta22. By default a run of both
        joints of the virtual rig under a square current of 0.3 A with a period of 2 s, for 10 s.
    sine
        Validation run with the same signals. By default a run of the virtual rig under a sine current of 0.6 A at
        6.3 rad/s if `square` is not given, otherwise none.
    increment
        Increment of the order grid; the paper's is 0.05.
    noise, seed
        Standard deviation [rad] and seed of the noise on the angles of the virtual rig; see
        :func:`ftlm.reproduction.demo_run`.
    genetic
        Settings of the genetic algorithm, whose seeds and evaluations also apply to differential evolution. By default
        each seed has as many evaluations as the compared order grid has candidates, and there are ten seeds, or fewer
        on a fine grid. `order_grid` and `norm` must not be set, because the comparison determines them.
    comparison_increment
        Minimum increment of the order grid on which multi-innovation, the genetic algorithm and differential
        evolution are compared. The paper's 0.05 takes sixteen times as long as the default.
    arms
        Simulated arms on which claims are tested in addition to the main one: keys of `ARM_VARIANTS`, by default all.
        Not used with measured runs.
    records
        Number of records per simulated arm, which differ in their noise.
    threads
        Number of threads per joint. Two joints or arms are computed in parallel unless this is 1.
    log
        Callback with a line of text at the start of each step, called from the thread of a joint.
    progress
        Callback with (parts done, total parts) of all work, called from the thread of a joint. Parts have equal
        expected duration.

    Returns
    -------
    Reproduction
        Results, with the methods ``page`` and ``save``. Equal arguments give equal results.

    Raises
    ------
    DataError
        If the runs do not have all signals of a joint, or the sine run lacks a signal of the square run.
    ModelError
        If a sine run is given without a square run, an arm is unknown, or an increment or `records` is out of range.
        Also if `genetic` has an order grid or another norm.
    """
    if genetic is not None and (genetic.order_grid is not None or genetic.norm != "l1"):
        raise ModelError(
            "genetic: the order grid and the norm are those of the comparison; leave order_grid and norm out"
        )
    simulated = square is None
    others, grid = other_arms(arms, records), OrderGrid(increment=increment, alpha=computation.GRID_ALPHA)
    for each in (increment, real_number("comparison_increment", comparison_increment)):
        replace(grid, increment=each).values(computation.published_structure(1))
    if square is None and sine is not None:
        raise ModelError("a sine run is given without a square run; give both, or neither")
    omitted = []
    try:
        load_pygad()
        load_differential_evolution()
    except ModelError as error:
        omitted.append(page_text("comparison_omitted", reason=error))
        log(omitted[0])
    compared_increment = None if omitted else comparison_increment
    preset = Preset(grid, comparison_increment=compared_increment, genetic=genetic, threads=threads)
    if square is None:
        log("recording both stages on the virtual rig, under a square and a sine current")
        square, sine = (demo_run(shape, noise=noise, seed=seed) for shape in ("square", "sine"))
    numbers = stages_of(square, sine)
    more = (len(others), records) if simulated else ()
    seconds = seconds_of_all(increment, len(numbers), *more, comparison_increment=compared_increment)
    expected = estimate_duration(seconds, min(check_threads(threads), len(STAGE_NUMBERS)))
    log(f"this takes {format_time_left(expected).removesuffix(' left')}")
    seeds, runs = [seed + k for k in range(records)], (square, sine)

    def compute_stage(number: StageNumber, steps: WorkerProgress) -> StageOutcome:
        work = StageWork(number, *runs, preset, log, steps, simulated)
        stage = work.compute_stage()
        work.begin("the paper's printed models under its own current", "printed")
        rows = run_printed_models(number, threads)
        work.begin("verdicts, both ends of K0", "trials")
        arm = MAIN_ARM if simulated else MEASURED_LABEL
        cases = computation.cases_of(stage, runs[0], arm, seed, threads)
        return StageOutcome(cases, {number: stage}, tuple(rows), as_printed(stage.outputs), tuple(work.notes))

    def compute_cases(arm: str, number: StageNumber, steps: WorkerProgress) -> StageOutcome:
        log(f"verdicts: the arm “{arm}”, stage {number}")
        own = seeds[1:] if arm == MAIN_ARM else seeds
        return StageOutcome(computation.simulated_cases(number, arm, own, noise, preset, steps))

    jobs: list[Job] = [partial(compute_stage, n) for n in numbers]
    jobs += [partial(compute_cases, a, n) for a in ([MAIN_ARM, *others] if simulated else []) for n in numbers]
    outcomes = run_jobs(jobs, 1 if threads == 1 else len(STAGE_NUMBERS), seconds, progress)
    whole = sum(outcomes, StageOutcome(notes=tuple(omitted)))
    results = {**vars(whole), "notes": tuple(dict.fromkeys(whole.notes))}
    return Reproduction(square, sine, simulated, order_grid=grid, **results)


@dataclass(frozen=True)
class StageOutcome:
    """Result of one job on one arm and joint, or the sum of several: cases for verdicts, and further results.

    Only jobs on the main arm or on measured runs have further results: all results of the joint, simulations of the
    printed models, recomputed tables by angle, and notes.
    """

    cases: Cases = field(default_factory=Cases)
    stages: dict[int, Stage] = field(default_factory=dict)
    printed_model_runs: tuple[PrintedModelRun, ...] = ()
    as_printed: dict[str, AsPrinted] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __add__(self, other: StageOutcome) -> StageOutcome:
        pairs = ((getattr(self, each.name), getattr(other, each.name)) for each in fields(self))
        sums: list[Any] = [{**a, **b} if isinstance(a, dict) else a + b for a, b in pairs]
        return StageOutcome(*sums)


#: Job of a worker thread, a function of the progress to which it reports.
Job = Callable[[WorkerProgress], StageOutcome]


def run_jobs(
    jobs: Sequence[Job], workers: int, seconds: float, progress: Callable[[int, int], None] | None
) -> list[StageOutcome]:
    """Run all jobs on a number of worker threads, and return their results in the sequence of the jobs.

    `seconds` is the expected processor time of all jobs. If a job fails, the others are stopped, and its exception is
    raised.
    """
    stop, whole = threading.Event(), TotalProgress(seconds, progress)

    def done_by(job: Job) -> StageOutcome:
        steps = WorkerProgress(whole, stop)
        result = job(steps)
        steps.begin(0.0)
        return result

    finished: set[Future[StageOutcome]] = set()
    with interruptible_pool(workers) as pool:
        under_way = [pool.submit(done_by, job) for job in jobs]
        try:
            # On some systems Ctrl-C does not interrupt a wait without a timeout.
            while len(finished) < len(jobs):
                finished, _ = wait(under_way, timeout=INTERRUPT_POLL_S, return_when=FIRST_EXCEPTION)
                # After a failure the other jobs raise KeyboardInterrupt, so only finished jobs are read.
                ended = [future.result() for future in under_way if future in finished]
        finally:
            stop.set()
    whole.end()
    return ended
