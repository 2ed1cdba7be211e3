"""Section 5 of the paper from end to end: its tables and figures recomputed, beside the printed ones, and judged."""

from __future__ import annotations

import json
import math
import threading
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ftlm import _core, printed
from ftlm.baselines import Genetic
from ftlm.demo import PLANTS, demo_run
from ftlm.errors import ConvergenceError, DataError, ModelError
from ftlm.flexible_link import INTEGER_ORDERS, PARAMETERS, flexible_link, link_model, order_law
from ftlm.identification import Identification, identify, multi_innovation_trace
from ftlm.models import Model, Order, write_atomically
from ftlm.order_search import Lattice, prepare
from ftlm.progress import Progress, Stoppable
from ftlm.records import default_m
from ftlm.runs import Run
from ftlm.simulation import explicit_euler
from ftlm.validation import Comparison, Metrics, compare, metrics

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from ftlm.identification import Trace
    from ftlm.models import Equation, Structure

    Floats = NDArray[np.float64]

__all__ = ["Candidate", "Claim", "Reproduction", "Rival", "Stage", "reproduce"]

#: Steps between two points of a convergence curve: what p does, it does in the first steps.
TRACE_EVERY = 4
#: A prior so weak that the data alone decide.
WEAK_PRIOR = 1e10
#: Lattice of the genetic comparison: both algorithms' printed highest orders lie in it, and all of it can be evaluated.
RIVAL_ALPHA = (1.95, 2.0)
#: Instrumental variables are searched so many steps of the lattice around the orders of least squares: every candidate
#: costs several free runs.
AROUND = 2
#: A curve has converged where it stays this close to its end.
SETTLED = 0.05
#: Runs with more rows than the first are thinned to at most the second for joint fits, whose cost and whose grid's
#: refinement grow with the rows; the arm's modes are two decades below the rate that is left.
MOST_ROWS, JOINT_ROWS = 6000, 2500
#: Seconds between two looks for Ctrl-C.
LOOK = 0.1
#: Differences of two errors below this share of them are none.
ALIKE = 0.02


@dataclass(frozen=True)
class Candidate:
    """One model of a stage on both runs.

    Parameters
    ----------
    label
        Such as "p = 7".
    model
        The model.
    estimation
        Both errors on the run that it was identified from, driven as the method drives it.
    validation
        The same on the other run; None without one.
    alone
        Output error from the currents alone, on both runs, by run and output.
    result
        The identification; None for a model that was not identified.
    """

    label: str
    model: Model
    estimation: Comparison
    validation: Comparison | None
    alone: dict[str, dict[str, Metrics]]
    result: Identification | None = None


@dataclass(frozen=True)
class Rival:
    """The genetic algorithm and multi-innovation on one equation, like for like.

    Parameters
    ----------
    candidates
        Of the lattice, and evaluations of every seed.
    genetic, lattice
        The two results.
    """

    candidates: int
    genetic: Candidate
    lattice: Candidate


@dataclass(frozen=True)
class Derived:
    """What the derivative of the current that (19) drops would change.

    Parameters
    ----------
    output
        The deflection.
    order
        The order that the current would have; 0 as published.
    time
        Middle of every pulse [s].
    published, derived
        Pulse means of the free run from the current alone, all other numbers alike.
    """

    output: str
    order: float
    time: Floats
    published: Floats
    derived: Floats


@dataclass(frozen=True)
class Stage:
    """Everything about one stage.

    Parameters
    ----------
    number
        1 or 2.
    candidates
        Models by label, in the order of the tables.
    traces, weak_traces
        Convergence by output and p: each p at its own orders and K0 = 1; with a weak prior, at the orders of p = 7.
    weak
        Coefficients by output and p with a weak prior, at the orders of p = 7.
    rivals
        By output; empty without PyGAD or where a run does not start at rest.
    near
        The model with the orders that the paper prints, least-squares coefficients on this run.
    by_equation
        The model whose orders have the smallest equation error on the lattice.
    derived
        What the dropped derivative of the current changes.
    """

    number: int
    candidates: dict[str, Candidate]
    traces: dict[str, dict[int, Trace]]
    weak_traces: dict[str, dict[int, Trace]]
    weak: dict[str, dict[int, dict[str, float]]]
    rivals: dict[str, Rival]
    near: Candidate
    by_equation: Candidate
    derived: Derived

    @property
    def outputs(self) -> tuple[str, str]:
        """Hub angle and deflection."""
        return f"theta{self.number}1", f"theta{self.number}2"

    @property
    def manual(self) -> str:
        """Label of the manual's model as the paper ran it; Euler's steps start at rest, so not on any other run."""
        return "integer, Euler" if self.traces else "integer, exact"


@dataclass(frozen=True)
class Claim:
    """One claim of the paper, or slip in it, with a verdict from computed numbers.

    Parameters
    ----------
    claim
        In words.
    holds
        Whether the numbers bear it out; None where they cannot tell.
    evidence
        The numbers, in words.
    """

    claim: str
    holds: bool | None
    evidence: str


@dataclass(frozen=True)
class Reproduction:
    """Section 5 of the paper, recomputed.

    Parameters
    ----------
    square, sine
        The run that everything is identified from, and the other one (None where it is not given).
    simulated
        Whether they come from the virtual rig, whose truth is known.
    stages
        By number.
    lattice
        Of the order searches.
    notes
        What was left out and why.
    """

    square: Run
    sine: Run | None
    simulated: bool
    stages: dict[int, Stage]
    lattice: Lattice
    notes: tuple[str, ...] = field(default=())

    @property
    def truth(self) -> dict[int, dict[str, float]]:
        """Orders and coefficients of the simulated arm by stage; empty for measured runs."""
        if not self.simulated:
            return {}
        found = {}
        for n in self.stages:
            orders, free = PLANTS[n]
            found[n] = {**orders, **{(f"r{n}" if name == "r" else name): v for name, v in free.items()}}
        return found

    @property
    def claims(self) -> list[Claim]:
        """What holds and what does not."""
        return claims(self)

    def page(self, path: str | os.PathLike[str], *, force: bool = False) -> Path:
        """Write everything as one HTML file that opens offline.

        Raises
        ------
        DataError
            The file exists and ``force`` is not set, or cannot be written.
        """
        from ftlm.report.reproduction import reproduction_page  # noqa: PLC0415 — pages read results

        return reproduction_page(self, path, force=force)

    def save(self, folder: str | os.PathLike[str], *, force: bool = False) -> list[Path]:
        """Write runs, models and all tables' numbers, from which each table can be computed again.

        Parameters
        ----------
        folder
            Made if it is not there: ``square.csv``, ``sine.csv``, a model file for every row, ``tables.json``.
        force
            Overwrite.

        Returns
        -------
        list of pathlib.Path
            The files.

        Raises
        ------
        DataError
            A file is there already, or the folder cannot be written.
        """
        where = Path(folder)
        names = check_folder(where, self._models(), force=force)
        written = []
        for run, name in ((self.square, "square.csv"), (self.sine, "sine.csv")):
            if run is not None:
                run.to_csv(where / name, force=force)
                written.append(where / name)
        for name, model in names.items():
            model.save(where / name, force=force)
            written.append(where / name)
        text = json.dumps(self.to_dict(), indent=1, ensure_ascii=False, allow_nan=False)
        write_atomically(where / "tables.json", text.encode(), force=force)
        return [*written, where / "tables.json"]

    def _models(self) -> dict[str, Model]:
        found = {}
        for number, stage in self.stages.items():
            for label, candidate in stage.candidates.items():
                found[f"stage{number}-{slug(label)}.json"] = candidate.model
            for output, rival in stage.rivals.items():
                found[f"{output}-genetic.json"] = rival.genetic.model
                found[f"{output}-rival.json"] = rival.lattice.model
        return found

    def to_dict(self) -> dict[str, Any]:
        """For JSON: every number of every table, and the verdicts."""
        return {
            "runs": [r.name for r in (self.square, self.sine) if r is not None],
            "simulated": self.simulated,
            "lattice": {"step": self.lattice.step, "alpha": list(self.lattice.alpha)},
            "claims": [{"claim": c.claim, "holds": c.holds, "evidence": c.evidence} for c in self.claims],
            "stages": {str(n): _stage_dict(s) for n, s in self.stages.items()},
            "notes": list(self.notes),
        }


def slug(label: str) -> str:
    """A label as part of a file's name."""
    return "-".join("".join(c if c.isalnum() else " " for c in label).split())


def check_folder(folder: Path, names: Mapping[str, Any], *, force: bool) -> dict[str, Any]:
    """Make a folder and refuse before any work what could not be written after it.

    Raises
    ------
    DataError
        A file that exists, or a folder that cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder} cannot be made: {error.strerror or error}; choose another folder") from error
    there = [n for n in ("square.csv", "sine.csv", "tables.json", *names) if (folder / n).exists()]
    if there and not force:
        raise DataError(f"{folder / there[0]} exists ({len(there)} such files); choose another folder, or --force")
    return dict(names)


def _candidate_dict(candidate: Candidate) -> dict[str, Any]:
    return {
        "orders": {n: float(v) for n, v in candidate.model.orders.items()},
        "coefficients": {n: float(v) for n, v in candidate.model.coefficients.items()},
        "intervals": {} if candidate.result is None else {n: list(i) for n, i in candidate.result.intervals.items()},
        "estimation": candidate.estimation.to_dict(),
        "validation": None if candidate.validation is None else candidate.validation.to_dict(),
        "alone": {run: {o: f.to_dict() for o, f in found.items()} for run, found in candidate.alone.items()},
        "settings": {} if candidate.result is None else candidate.result.settings,
        "warnings": [] if candidate.result is None else list(candidate.result.warnings),
    }


def _stage_dict(stage: Stage) -> dict[str, Any]:
    return {
        "models": {label: _candidate_dict(c) for label, c in stage.candidates.items()},
        "printed orders": _candidate_dict(stage.near),
        "weak prior": {o: {str(p): c for p, c in found.items()} for o, found in stage.weak.items()},
        "genetic": {
            o: {
                "candidates": r.candidates,
                "genetic": _candidate_dict(r.genetic),
                "multi-innovation": _candidate_dict(r.lattice),
            }
            for o, r in stage.rivals.items()
        },
        "smallest equation error": _candidate_dict(stage.by_equation),
        "derived input order": {"output": stage.derived.output, "order": stage.derived.order},
    }


# ------------------------------------------------------------------------------------------------ computing


def reproduce(
    square: Run | None = None,
    sine: Run | None = None,
    *,
    step: float = 0.05,
    noise: float = 1e-4,
    seed: int = 1,
    genetic: Genetic | None = None,
    threads: int | None = None,
    say: Callable[[str], None] = lambda _: None,
    progress: Callable[[int, int], None] | None = None,
) -> Reproduction:
    """Recompute section 5 of the paper, on the virtual rig or on runs of one's own.

    Parameters
    ----------
    square
        Run that everything is identified from: I1, theta11, theta12 and (or) I2, theta21, theta22, in A and rad. By
        default both stages of the virtual rig under a square current of 0.3 A, period 2 s, for 10 s.
    sine
        Run that nothing is identified from. By default, with the default ``square`` only, 0.6 A at 6.3 rad/s.
    step
        Step of the order lattice; the paper's is 0.05.
    noise, seed
        Of the virtual rig's angles, see :func:`ftlm.demo.demo_run`.
    genetic
        Settings of the genetic algorithm; by default seeds 0, 1, 2, each with as many evaluations as the lattice that
        it is compared with has candidates.
    threads
        Threads of each stage; both stages are computed at the same time unless this is 1.
    say
        Called with a line about what happens next, from the thread of a stage.
    progress
        See :func:`ftlm.search_orders`; called from the thread of a stage.

    Returns
    -------
    Reproduction
        With ``page`` and ``save``. Equal arguments give equal results.

    Raises
    ------
    DataError
        Runs without the signals of any stage, or a sine run that lacks some.
    """
    simulated = square is None
    if square is None:
        if sine is not None:
            raise ModelError("a sine run is given without a square run; give both, or neither")
        say("recording both stages on the virtual rig, under a square and a sine current")
        square, sine = (demo_run(shape, noise=noise, seed=seed) for shape in ("square", "sine"))
    numbers = stages_of(square, sine)
    lattice = Lattice(step=step)
    works = {n: _Work(n, square, sine, lattice, genetic, threads, say, progress, []) for n in numbers}
    stages = {n: work.stage() for n, work in works.items()} if len(works) == 1 or threads == 1 else side_by_side(works)
    notes = [note for work in works.values() for note in work.notes]
    return Reproduction(square, sine, simulated, stages, lattice, tuple(dict.fromkeys(notes)))


def side_by_side(works: Mapping[int, _Work]) -> dict[int, Stage]:
    """All stages at once: while one fits on one core, another uses the rest."""
    stop = threading.Event()
    with ExitStack() as stack:
        for work in works.values():
            told = work.progress
            if isinstance(told, Progress):
                told = stack.enter_context(told.beside())
                work.say = _both(work.say, told.name)
            work.progress = Stoppable(told, stop)
        pool = stack.enter_context(ThreadPoolExecutor(len(works), thread_name_prefix="ftlm-stage"))
        under_way = {n: pool.submit(work.stage) for n, work in works.items()}
        try:
            # A wait without an end would not be interrupted by Ctrl-C everywhere.
            while wait(under_way.values(), timeout=LOOK, return_when=FIRST_EXCEPTION).not_done:
                if any(f.done() and f.exception() is not None for f in under_way.values()):
                    break
        except BaseException:
            stop.set()
            raise
        stop.set()
        failed = [f.exception() for f in under_way.values() if f.done() and f.exception() is not None]
        if failed and failed[0] is not None:
            raise failed[0]
        return {n: f.result() for n, f in under_way.items()}


def thinned(run: Run, every: int) -> Run:
    """Every so manieth row of a run, held inputs by their means until the next one, which act alike."""
    rows = run.length // every
    data = {}
    for name in run.signals:
        samples = run[name][: rows * every].reshape(rows, every)
        held = name in run.inputs and run.intersample[name] == "zoh"
        data[name] = samples.mean(axis=1) if held else samples[:, 0]
    return Run.from_arrays(
        step=run.step * every, inputs={n: data[n] for n in run.inputs}, outputs={n: data[n] for n in run.outputs},
        units=dict(run.units), intersample=dict(run.intersample), name=run.name,
    )  # fmt: skip


def _both(first: Callable[[str], None], second: Callable[[str], None]) -> Callable[[str], None]:
    def told(line: str) -> None:
        first(line)
        second(line)

    return told


def stages_of(square: Run, sine: Run | None) -> list[int]:
    """Stages whose signals a run has.

    Raises
    ------
    DataError
        No stage is whole, or the sine run lacks a signal of one.
    """
    wanted = {n: (f"I{n}", f"theta{n}1", f"theta{n}2") for n in (1, 2)}
    found = [n for n, names in wanted.items() if all(s in square.signals for s in names)]
    if not found:
        listed = ", ".join(square.signals)
        raise DataError(
            f"run {square.name!r} has signals {listed}; a stage of the arm needs I1, theta11 and theta12, or I2, "
            "theta21 and theta22: name its columns with --columns, or -u I1=COLUMN -y theta11=COLUMN"
        )
    if sine is not None:
        lacking = [s for n in found for s in wanted[n] if s not in sine.signals]
        if lacking:
            raise DataError(
                f"the sine run, {sine.name!r}, lacks {', '.join(lacking)}, which the square run, {square.name!r}, has; "
                "both runs need the same names"
            )
    return found


@dataclass
class _Work:
    """One stage under way."""

    number: int
    square: Run
    sine: Run | None
    lattice: Lattice
    genetic: Genetic | None
    threads: int | None
    say: Callable[[str], None]
    progress: Callable[[int, int], None] | None
    notes: list[str]

    def __post_init__(self) -> None:
        which: Any = self.number
        self.measured = flexible_link(stage=which, coupling="measured", laws=())
        self.coupled = flexible_link(stage=which)
        own = list(self.measured.signals)
        self.on = self.square.select(own)
        self.off = None if self.sine is None else self.sine.select(own)

    def thinned(self) -> Run:
        """The run for joint fits: as it is, or every so many rows of it."""
        run = self.on
        if run.length <= MOST_ROWS:
            return run
        every = -(-run.length // JOINT_ROWS)
        self.notes.append(
            f"run {run.name} has {run.length} rows: joint fits by output error take one of {every} rows, "
            f"{every * run.step:.6g} s apart, with the means of held currents in between; all models are compared on "
            "the same block pulses of the whole run"
        )
        return thinned(run, every)

    @property
    def runs(self) -> list[Run]:
        return [self.on] if self.off is None else [self.on, self.off]

    def stage(self) -> Stage:
        candidates = {c.label: c for c in self.integer()}
        for p in printed.INNOVATION_LENGTHS:
            candidates[f"p = {p}"] = self.searched(f"p = {p}", "multi-innovation", innovation_length=p)
        candidates["least squares"] = self.searched("least squares", "least-squares")
        candidates["instrumental variables"] = self.instrumental(candidates["least squares"])
        candidates["output error"] = self.best()
        last = candidates[f"p = {printed.INNOVATION_LENGTHS[-1]}"]
        traces: dict[str, dict[int, Trace]] = {}
        weak_traces: dict[str, dict[int, Trace]] = {}
        weak: dict[str, dict[int, dict[str, float]]] = {}
        if prepare([self.on], self.measured, None, power_of_two=True)[0].initial == "rest":
            for output in self.measured.outputs:
                each = {p: candidates[f"p = {p}"].model for p in printed.INNOVATION_LENGTHS}
                traces[output] = {p: self.trace(self.ordered(output, m.orders), p, 1.0) for p, m in each.items()}
                single = self.ordered(output, last.model.orders)
                weak_traces[output] = {p: self.trace(single, p, WEAK_PRIOR) for p in each}
                weak[output] = {
                    p: {n: float(c[-1]) for n, c in t.coefficients.items()} for p, t in weak_traces[output].items()
                }
        else:
            self.notes.append(
                f"run {self.on.name} does not start at rest: every model is fitted and compared with initial terms; "
                "explicit Euler, which steps from rest as in the paper, is not, and its errors hold that; convergence "
                "of the recursion, and with it Figures 4(b) to 8(b), and the weak prior are left out"
            )
        return Stage(
            self.number, candidates, traces, weak_traces, weak, self.rivals(), self.near(),
            self.by_equation(),
            self.derived(candidates["output error"].model),
        )  # fmt: skip

    def candidate(self, label: str, model: Model, result: Identification | None = None) -> Candidate:
        """Both errors of a model on both runs, and its free run from the currents alone.

        Whatever a method worked on, all are judged on the paper's pulses: a sum over other pulses is another number.
        """
        m = default_m([self.on], power_of_two=True)
        own = [] if result is None or result.task is None else result.task.runs
        known = result.comparison if result is not None and any(run is self.on for run in own) else None
        model = model if model.m == m else replace(model, m=m)
        estimation = known if known is not None and known.m == m else compare(model, self.on)
        alone_model = replace(model, structure=replace(model.structure, coupling="simulated"))
        whole = len(model.equations) > 1
        alone = {r.name: compare(alone_model, r).output_error for r in self.runs} if whole else {}
        validation = None if self.off is None else compare(model, self.off)
        return Candidate(label, model, estimation, validation, alone, result)

    def integer(self) -> list[Candidate]:
        """The manual's model by explicit Euler and exactly, and whole orders identified from the run."""
        which: Any = self.number
        model = link_model(stage=which)
        exact = self.candidate("integer, exact", model)
        euler = [
            self._euler(model, r, c) for r, c in zip(self.runs, (exact.estimation, exact.validation), strict=False)
        ]
        stepped = replace(
            exact, label="integer, Euler", estimation=euler[0], validation=euler[1] if self.off else None,
            alone={r.name: e.output_error for r, e in zip(self.runs, euler, strict=True)},
        )  # fmt: skip
        whole = {n: INTEGER_ORDERS.get(n.rstrip("0123456789"), 2.0) for n in self.measured.order_names}
        words = "whole orders, each equation driven by the measured other angle"
        return [stepped, exact, self.joint("integer, identified", self.measured.with_orders(whole), words)]

    def _euler(self, model: Model, run: Run, exact: Comparison | None) -> Comparison:
        """The comparison with Euler's response in place of the exact one."""
        if exact is None:
            raise ModelError(f"run {run.name!r} was not compared; please report it")
        stepped = explicit_euler(model, run)
        simulated = {}
        for name, samples in stepped.items():
            with np.errstate(over="ignore", invalid="ignore"):
                finite = bool(np.all(np.isfinite(samples)))
            simulated[name] = _core.pulse_means(samples, exact.m, False) if finite else np.full(exact.m, np.inf)
        errors = {n: metrics(exact.measured[n][0], s) for n, s in simulated.items()}
        return replace(
            exact, simulated={n: [s] for n, s in simulated.items()}, output_error=errors,
            per_run=[(run.name, exact.equation_error, errors)], warnings=(),
        )  # fmt: skip

    def searched(self, label: str, method: Any, **options: Any) -> Candidate:
        self.say(f"stage {self.number}: searching the orders of both equations, {label}")
        result = identify(
            self.on, self.measured, method=method, lattice=self.lattice, keep=1, threads=self.threads,
            progress=self.progress, **options,
        )  # fmt: skip
        return self.candidate(label, result.model, result)

    def instrumental(self, start: Candidate) -> Candidate:
        """Orders on the part of the lattice around those of least squares."""
        self.say(f"stage {self.number}: searching the orders by instrumental variables")
        step, axes = self.lattice.step, {}
        for name, value in start.model.orders.items():
            steps = range(-1, 2) if name.startswith("alpha") else range(-AROUND, AROUND + 1)
            near = [round(value + k * step, 9) for k in steps]
            top = self.lattice.alpha[1]
            axes[name] = [v for v in near if 0 <= v <= top]
        result = identify(
            self.on, self.measured, method="instrumental-variables", lattice=Lattice(step=step, orders=axes), keep=1,
            threads=self.threads, progress=self.progress,
        )  # fmt: skip
        return self.candidate("instrumental variables", result.model, result)

    def joint(self, label: str, structure: Structure, words: str) -> Candidate:
        self.say(f"stage {self.number}: {words}, by output error")
        result = identify(self.thinned(), structure, threads=self.threads, progress=self.progress)
        return self.candidate(label, result.model, result)

    def best(self) -> Candidate:
        """Joint output error from the current alone, or driven by the measured other angle where that has no start."""
        try:
            return self.joint(
                "output error", self.coupled, "all orders and coefficients together, from the current alone"
            )
        except ConvergenceError as error:
            self.notes.append(
                f"stage {self.number}: from the current alone, {error}; the row of output error is driven by the "
                "measured other angle instead"
            )
        return self.joint(
            "output error", replace(self.coupled, coupling="measured"), "all orders and coefficients together"
        )

    def ordered(self, output: str, orders: Mapping[str, float]) -> Structure:
        single = self.measured.equation(output)
        return single.with_orders({n: orders[n] for n in single.order_names})

    def trace(self, single: Structure, p: int, prior: float) -> Trace:
        return multi_innovation_trace(self.on, single, innovation_length=p, prior_covariance=prior, every=TRACE_EVERY)

    def rivals(self) -> dict[str, Rival]:
        """Genetic algorithm and lattice on one equation each: same record, same number of candidates."""
        lattice = Lattice(step=self.lattice.step, alpha=RIVAL_ALPHA)
        found = {}
        for output in self.measured.outputs:
            single = self.measured.equation(output)
            self.say(f"{output}: a genetic algorithm with as many evaluations as the lattice has candidates")
            paper = identify(
                self.on, single, method="multi-innovation", lattice=lattice, keep=1, threads=self.threads,
                progress=self.progress,
            )  # fmt: skip
            count = paper.searches[output].candidates
            settings = self.genetic or Genetic()
            settings = (
                settings if settings.evaluations else replace(settings, evaluations=max(count, 2 * settings.population))
            )
            try:
                result = identify(
                    self.on, single, method="genetic", lattice=lattice, genetic=settings, threads=self.threads,
                    progress=self.progress,
                )  # fmt: skip
            except ModelError as error:
                self.notes.append(f"Tables 6 and 7 and Figure 11 are left out: {error}")
                return {}
            found[output] = Rival(
                count, self.candidate("genetic", result.model, result), self.candidate("p = 7", paper.model, paper)
            )
        return found

    def near(self) -> Candidate:
        """The orders that the paper prints, with the best coefficients that this run gives them."""
        orders: dict[str, float] = {}
        for item in self.measured.equations:
            row = printed.FRACTIONAL[item.output][printed.INNOVATION_LENGTHS[-1]]
            index = next(n for n in self.measured.equation(item.output).order_names if n.startswith("alpha"))[5:]
            orders |= {f"{n}{index}": v for n, v in row.orders.items()}
        result = identify(self.on, self.measured.with_orders(orders), method="least-squares")
        return self.candidate("printed orders", result.model, result)

    def by_equation(self) -> Candidate:
        """Least squares at the orders whose equation error is smallest."""
        self.say(f"stage {self.number}: searching the orders with the smallest equation error")
        result = identify(
            self.on, self.measured, method="least-squares", criterion="equation-error", norm="l2",
            lattice=self.lattice, threads=self.threads, progress=self.progress,
        )  # fmt: skip
        return self.candidate("smallest equation error", result.model, result)

    def derived(self, model: Model) -> Derived:
        """The deflection with the current's order as published and as derived, all other numbers alike."""
        output = self.measured.outputs[1]
        order = order_law(self.number, "derived")["input"].at(model.orders)

        def moved(item: Equation) -> Equation:
            if item.output != output:
                return item
            return replace(
                item,
                terms=tuple(replace(t, order=Order(order)) if t.signal in self.on.inputs else t for t in item.terms),
            )

        other = replace(model, structure=replace(model.structure, equations=tuple(map(moved, model.equations))))
        found = [compare(m, self.on) for m in (model, other)]
        time = np.asarray((np.arange(found[0].m) + 0.5) * found[0].step[0], dtype=np.float64)
        return Derived(output, order, time, found[0].simulated[output][0], found[1].simulated[output][0])


# ------------------------------------------------------------------------------------------------ judging


def claims(found: Reproduction) -> list[Claim]:
    """Hold the paper's claims, and its slips, against computed numbers.

    Parameters
    ----------
    found
        The reproduction.

    Returns
    -------
    list of Claim
        Every verdict follows from numbers by a rule; none is written down.
    """
    return [
        *_claims_of_p(found), *_claims_of_orders(found), _claim_of_table_3(), *_claims_of_rivals(found),
        _claim_of_the_derivative(found), _claim_of_the_impossible_row(),
    ]  # fmt: skip


def angle(name: str) -> str:
    """An angle as the paper writes it, in plain text."""
    return "θ" + name.removeprefix("theta").translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉"))


def listed(values: Sequence[float], digits: int = 4) -> str:
    """Numbers in a row."""
    return ", ".join("∞" if math.isinf(v) else f"{v:.{digits}g}" for v in values)


def settled_at(trace: Trace) -> int:
    """First step from which a curve stays within a share of its end."""
    end = trace.error[-1]
    with np.errstate(invalid="ignore"):
        away = np.flatnonzero(~(np.abs(trace.error - end) <= SETTLED * end))
    return int(trace.step[min(int(away[-1]) + 1, trace.step.size - 1)]) if away.size else int(trace.step[0])


def printed_saturation(output: str) -> tuple[float, float, float]:
    """Return x and c of x·p / (p + c) through the printed a of p = 1 and 7, and how far p = 3 and 5 are from it."""
    rows = printed.FRACTIONAL[output]
    first, last = printed.INNOVATION_LENGTHS[0], printed.INNOVATION_LENGTHS[-1]
    # 1/a = 1/x + (c/x)/p is a line in 1/p.
    slope = (1 / rows[first].coefficients["a"] - 1 / rows[last].coefficients["a"]) / (1 / first - 1 / last)
    x = 1 / (1 / rows[first].coefficients["a"] - slope / first)
    c = slope * x
    between = [(p, rows[p].coefficients["a"]) for p in printed.INNOVATION_LENGTHS[1:-1]]
    return x, c, max(abs(x * p / (p + c) / a - 1) for p, a in between)


def weak_spread(stage: Stage, output: str) -> float:
    """Largest relative difference of a coefficient between p = 1 and any other p, with a weak prior."""
    each = stage.weak[output]
    first = each[printed.INNOVATION_LENGTHS[0]]
    return max(abs(c[n] / first[n] - 1) for c in each.values() for n in first if first[n])


def _claims_of_p(found: Reproduction) -> list[Claim]:
    lengths = printed.INNOVATION_LENGTHS
    errors = {
        o: [s.candidates[f"p = {p}"].estimation.output_error[o].error for p in lengths]
        for s in found.stages.values() for o in s.outputs
    }  # fmt: skip
    falls = {o: all(b <= a for a, b in pairwise(e)) for o, e in errors.items()}
    away = {o: printed_saturation(o)[2] for o in printed.OUTPUTS}
    curve = "the printed a lie on x·p / (p + c), the curve of a prior, within " + ", ".join(
        f"{100 * v:.2g} % ({angle(o)})" for o, v in away.items()
    )
    words = "; ".join(f"{angle(o)} {listed(e)}" for o, e in errors.items())
    out = [
        Claim(
            "A larger innovation length p gives a smaller error (45): Tables 4 and 5.",
            all(falls.values()),
            f"error of the free run for p = 1, 3, 5, 7 at K0 = 1: {words}.",
        )
    ]
    spread = {o: weak_spread(s, o) for s in found.stages.values() for o in s.weak}
    out.append(
        Claim(
            "p itself improves the estimate.",
            not all(v < ALIKE for v in spread.values()) if spread else None,
            (
                f"with a weak prior (K0 = {WEAK_PRIOR:.0e}) the coefficients of p = 1, 3, 5, 7 at the same orders "
                f"differ by at most {100 * max(spread.values()):.2g} %: p is a weight of the data against the prior, "
                "which pulls to 0; "
                if spread
                else ""
            )
            + curve
            + ".",
        )
    )
    steps = {o: [settled_at(t[p]) for p in lengths] for s in found.stages.values() for o, t in s.traces.items()}
    weak = {o: [settled_at(t[p]) for p in lengths] for s in found.stages.values() for o, t in s.weak_traces.items()}
    if steps:
        out.append(
            Claim(
                "A larger p converges faster: Figures 4(b), 5(b), 7(b), 8(b).",
                all(b <= a for each in steps.values() for a, b in pairwise(each)),
                "steps until the error stays within 5 % of its end, for p = 1, 3, 5, 7: at K0 = 1 "
                + "; ".join(f"{angle(o)} {listed(s)}" for o, s in steps.items())
                + f"; with the weak prior {'; '.join(f'{angle(o)} {listed(s)}' for o, s in weak.items())}.",
            )
        )
    return out


def _fits(found: Reproduction, label: str) -> dict[str, float]:
    """Fit of the free run, driven as the model was identified, by angle and run."""
    fits: dict[str, float] = {}
    for s in found.stages.values():
        candidate = s.candidates[label]
        for name, comparison in (("square", candidate.estimation), ("sine", candidate.validation)):
            if comparison is not None:
                fits |= {f"{angle(o)} on the {name}": comparison.output_error[o].fit for o in s.outputs}
    return fits


def _claims_of_orders(found: Reproduction) -> list[Claim]:
    last = f"p = {printed.INNOVATION_LENGTHS[-1]}"
    labels = ", ".join(sorted({s.manual for s in found.stages.values()}))
    manual = {
        o: (s.candidates[s.manual].estimation.output_error[o].nr,
            s.candidates[last].estimation.output_error[o].nr)
        for s in found.stages.values() for o in s.outputs
    }  # fmt: skip
    whole, fractional = _fits(found, "integer, identified"), _fits(found, "output error")
    better = [fractional[k] > whole[k] for k in whole]
    near = {
        o: (s.near.estimation.equation_error[o].nr, s.near.estimation.output_error[o].nr)
        for s in found.stages.values() for o in s.outputs
    }  # fmt: skip
    return [
        Claim(
            "The fractional model (p = 7) is closer to the run than the manual's integer-order model: Figures 6 and 9.",
            all(f < i for i, f in manual.values()),
            f"NR of the manual's model ({labels}) and of p = 7: "
            + "; ".join(f"{angle(o)} {listed(pair, 3)}" for o, pair in manual.items()) + ".",
        ),
        Claim(
            "Fractional orders describe the arm better than whole ones.",
            all(better),
            "both identified by output error from the same run; fit in percent of whole orders, even driven by the "
            "measured other angle, and of fractional ones from the current alone: "
            + "; ".join(f"{k} {listed([whole[k], fractional[k]])}" for k in whole)
            + ". The manual's model is no measure of whole orders: its parameters were not identified from this run.",
        ),
        Claim(
            "The orders of Tables 4 and 5 (2; 1.95 to 1.8) describe the arm.",
            all(output < FLATTERY * equation and output < EXPLAINS for equation, output in near.values()),
            "with these orders and the best coefficients for them, NR of the equation error and of the free run: "
            + "; ".join(f"{angle(o)} {listed(pair, 3)}" for o, pair in near.items())
            + ". So close to α, I^(α−ν) y is nearly y, and the equation says that a signal equals itself.",
        ),
    ]  # fmt: skip


#: A free run this many times worse than the equation error, or with a larger NR than this, describes nothing.
FLATTERY, EXPLAINS = 5.0, 0.5


def table_3_coefficients() -> dict[str, tuple[float, float, float]]:
    """Coefficients of (22)-(25) from Table 3, from the effective parameters, and as printed in the integer rows."""
    found = {}
    for stage in (1, 2):
        table, effective = (PARAMETERS[n][stage].coefficients(stage) for n in ("table-3", "effective"))
        for k in (1, 2):
            row = printed.INTEGER[f"theta{stage}{k}"]
            for letter, value in row.coefficients.items():
                name = f"{letter}{2 * stage - 2 + k}"
                found[name] = (table[name], effective[name], value)
    return found


def _claim_of_table_3() -> Claim:
    rows = table_3_coefficients()
    ratios = {n: t / p for n, (t, _, p) in rows.items()}
    effective = max(abs(e / p - 1) for _, e, p in rows.values())
    off = [n for n, r in ratios.items() if abs(r - 1) > ALIKE]
    worst = max(off, key=lambda n: abs(math.log(abs(ratios[n]))), default=None)
    words = "" if worst is None else f"; {worst} is {ratios[worst]:.3g} times the printed value"
    return Claim(
        "Table 3 gives the integer-order models of Tables 4 and 5.",
        not off,
        f"{len(off)} of {len(rows)} coefficients from Table 3 are not those printed{words}. The maker's effective "
        f"parameters (torque with gear and efficiency) give every one of them to {100 * effective:.1g} %.",
    )


def implied_spreads() -> dict[str, tuple[float, float]]:
    """Standard deviations that Table 7 implies by RMSE / NR, of the genetic algorithm's record and of the other."""
    return {o: (g[1] / g[2], m[1] / m[2]) for o, (g, m) in printed.RIVALS.items()}


def _claims_of_rivals(found: Reproduction) -> list[Claim]:
    spreads = implied_spreads()
    mixed = {o: pair for o, pair in spreads.items() if abs(pair[0] / pair[1] - 1) > MIXED}
    out = [
        Claim(
            "Table 7 compares both algorithms on one record.",
            not mixed,
            "standard deviation of the angle that RMSE / NR implies, genetic algorithm and multi-innovation: "
            + "; ".join(f"{angle(o)} {listed(pair, 3)}" for o, pair in spreads.items())
            + " rad. One record has one standard deviation.",
        )
    ]
    rivals = {o: r for s in found.stages.values() for o, r in s.rivals.items()}
    if rivals:
        pairs = {
            o: (r.genetic.estimation.output_error[o].error, r.lattice.estimation.output_error[o].error)
            for o, r in rivals.items()
        }
        out.append(
            Claim(
                "Multi-innovation has a smaller error than the genetic algorithm.",
                all(m < g for g, m in pairs.values()),
                "the same record, "
                + ", ".join(sorted({_budget(r) for r in rivals.values()}))
                + "; error (45) of the genetic algorithm's best seed and of p = 7: "
                + "; ".join(f"{angle(o)} {listed(pair)}" for o, pair in pairs.items())
                + ". The genetic algorithm minimises (45) over the coefficients, too; multi-innovation takes those of "
                "the equation error, pulled towards 0.",
            )
        )
    return out


def _budget(rival: Rival) -> str:
    """How many evaluations a seed of the genetic algorithm had for how many candidates of the lattice."""
    settings = {} if rival.genetic.result is None else rival.genetic.result.settings
    each = sum(settings["evaluations"].values()) / len(settings["seeds"])
    return f"{each:.0f} evaluations a seed for {rival.candidates} candidates"


#: Digits of RMSE and NR in Table 7 allow this much between two standard deviations of one record.
MIXED = 0.15


def _claim_of_the_derivative(found: Reproduction) -> Claim:
    dropped = {}
    for stage in (1, 2):
        row = {n: v for k in (1, 2) for n, v in _paper_orders(stage, k).items()}
        dropped[stage] = order_law(stage, "derived")["input"].at(row)
    nr = {
        s.derived.output: metrics(s.derived.published, s.derived.derived).nr for s in found.stages.values()
    }  # fmt: skip
    orders = ", ".join(f"{s.derived.order:.3g}" for s in found.stages.values())
    return Claim(
        "Eliminating the other angle leaves the current as it is: (19), (21).",
        all(abs(v) < 1e-9 for v in dropped.values()),
        f"the elimination differentiates the current as well, by the order {listed(list(dropped.values()), 2)} at the "
        f"printed orders and {orders} at those identified here, where it changes the deflection's free run by NR "
        + ", ".join(f"{v:.3g} ({angle(o)})" for o, v in nr.items()) + ".",
    )  # fmt: skip


def _paper_orders(stage: int, k: int) -> dict[str, float]:
    index = 2 * stage - 2 + k
    row = printed.FRACTIONAL[f"theta{stage}{k}"][printed.INNOVATION_LENGTHS[-1]]
    return {f"{n}{index}": v for n, v in row.orders.items()}


def _claim_of_the_impossible_row() -> Claim:
    row = printed.INTEGER["theta22"]
    error, rmse = float(row.error or 0.0), float(row.rmse or 0.0)
    mean = error / printed.POINTS
    return Claim(
        "The integer row of θ₂₂ in Table 5 is possible.",
        mean <= rmse,
        f"its error {error:g} over {printed.POINTS} points is a mean of {mean:.4g} rad, its RMSE {rmse:g} rad; a mean "
        "absolute value never exceeds the root mean square.",
    )
