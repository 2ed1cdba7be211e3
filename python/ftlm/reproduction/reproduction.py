"""Reproduction of the paper's section 5: computed and printed tables and figures, and verdicts on its claims."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from ftlm.data.run import Run
from ftlm.errors import DataError, ModelError
from ftlm.estimation.genetic import GeneticAlgorithm, load_differential_evolution, load_pygad
from ftlm.model.model import Model
from ftlm.order_search.options import OrderGrid
from ftlm.progress import format_time_left
from ftlm.reproduction import stage as computation
from ftlm.reproduction.checks import Check, checks
from ftlm.reproduction.published_values import AsPrinted, PrintedModelRun, as_printed, page_text, run_printed_models
from ftlm.reproduction.report import reproduction_page
from ftlm.reproduction.simulated_arm import ARM_VARIANTS, MAIN_ARM, STAGE_NUMBERS, StageNumber, demo_run, truth_of
from ftlm.reproduction.stage import Cases, OptimizerComparison, Preset, Stage, StageWork
from ftlm.reproduction.workload import COMPARISON_INCREMENT, TotalProgress, WorkerProgress, seconds_of_all
from ftlm.utils.files import check_folder, write_atomically
from ftlm.utils.formatting import attributes, json_value
from ftlm.utils.parameters import Placeholder, parameter, setting
from ftlm.utils.resources import estimate_duration
from ftlm.utils.validation import check_integer, check_threads, join_names, nearest, real_number

#: Label in verdicts for the arm of measured runs.
MEASURED_LABEL = "as measured"
#: Names of the files of runs and tables, which are written besides the model files.
ALWAYS_SAVED = ("square.csv", "sine.csv", "tables.json")
#: Duration of each wait for the workers, after which Ctrl-C can take effect [s].
INTERRUPT_POLL_S = 0.1
#: Maximum number of simulated records of one arm.
MAX_RECORDS = 1000


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
    others, grid = _other_arms(arms, records), OrderGrid(increment=increment, alpha=computation.GRID_ALPHA)
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
    whole = StageOutcome(notes=tuple(omitted))
    for outcome in run_jobs(jobs, 1 if threads == 1 else len(STAGE_NUMBERS), seconds, progress):
        whole += outcome
    notes = tuple(dict.fromkeys(whole.notes))
    return Reproduction(
        square, sine, simulated, whole.stages, grid, notes, whole.cases, whole.printed_model_runs, whole.as_printed
    )


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
        stages, tables = {**self.stages, **other.stages}, {**self.as_printed, **other.as_printed}
        return StageOutcome(
            self.cases + other.cases,
            stages,
            self.printed_model_runs + other.printed_model_runs,
            tables,
            self.notes + other.notes,
        )


#: Job of a worker thread, a function of the progress to which it reports.
Job = Callable[[WorkerProgress], StageOutcome]


def _other_arms(arms: Sequence[str] | None, records: int) -> list[str]:
    """Return the names of the simulated arms other than the main one, by default all.

    Raise ModelError if a name is unknown or `records` is out of range.
    """
    if isinstance(arms, str):
        raise ModelError(f"{setting('arms')} {arms!r} is a text; give a list of names, such as [{arms!r}]")
    for name in arms or ():
        if name not in ARM_VARIANTS:
            raise ModelError(f"arm {name!r} is not known{nearest(name, ARM_VARIANTS)}; use {join_names(ARM_VARIANTS)}")
    check_integer("records", records, 1, MAX_RECORDS)
    return [name for name in (ARM_VARIANTS if arms is None else dict.fromkeys(arms)) if name != MAIN_ARM]


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

    if workers == 1:
        ended = [done_by(job) for job in jobs]
    else:
        with ThreadPoolExecutor(workers, thread_name_prefix="ftlm-stage") as pool:
            under_way = [pool.submit(done_by, job) for job in jobs]
            try:
                finished: set[Future[StageOutcome]] = set()
                # On some systems Ctrl-C does not interrupt a wait without a timeout.
                while len(finished) < len(jobs) and not any(f.exception() for f in finished):
                    finished, _ = wait(under_way, timeout=INTERRUPT_POLL_S, return_when=FIRST_EXCEPTION)
            finally:
                stop.set()
                for future in under_way:
                    future.cancel()
            # After a failure the other jobs raise KeyboardInterrupt, so only finished jobs are read.
            ended = [f.result() for f in under_way if f in finished]
    whole.end()
    return ended


def stages_of(square: Run, sine: Run | None) -> list[StageNumber]:
    """Return the numbers of the joints (stages) for which the square run contains all signals.

    Raises
    ------
    DataError
        If there is no such joint, or the sine run lacks a signal of one.
    """
    signals_by_stage = {n: (f"I{n}", f"theta{n}1", f"theta{n}2") for n in STAGE_NUMBERS}
    stages = [n for n, names in signals_by_stage.items() if all(s in square.signals for s in names)]
    if not stages:
        listed = ", ".join(square.signals)
        raise DataError(
            f"run {square.name!r} has signals {listed}; a stage of the arm needs I1, theta11 and theta12, or I2, "
            f"theta21 and theta22: name its columns with {parameter('columns')}, or "
            f"{parameter('inputs', {'I1': Placeholder('COLUMN')})} "
            f"{parameter('outputs', {'theta11': Placeholder('COLUMN')})}"
        )
    if sine is not None:
        lacking = [s for n in stages for s in signals_by_stage[n] if s not in sine.signals]
        if lacking:
            raise DataError(
                f"the sine run, {sine.name!r}, lacks {', '.join(lacking)}, which the square run, {square.name!r}, has; "
                "both runs need the same names"
            )
    return stages
