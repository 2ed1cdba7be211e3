"""Exhaustive order searches over one equation, or over a stage under its order law."""

from __future__ import annotations

import math
import os
from dataclasses import asdict, dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from ftlm import _core
from ftlm.checks import real_number, whole_number
from ftlm.errors import DataError, ModelError
from ftlm.models import MAX_ORDER, Equation, Model, Order, Structure, Values, grid, parse_values
from ftlm.progress import Progress
from ftlm.records import check_m, default_m, initial_tuple, named_signals, record
from ftlm.rounds import StageWork, Work, do_rounds, do_stage, stage_state
from ftlm.store import RecordFile, Request, Store, read_store
from ftlm.validation import as_runs

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from concurrent.futures import Executor

    from ftlm.records import Record
    from ftlm.runs import Run

__all__ = [
    "Lattice",
    "SearchResult",
    "SearchRow",
    "StoreStatus",
    "lattice",
    "resume_search",
    "search_orders",
    "search_status",
]

Criterion = Literal["output-error", "equation-error"]
Coefficients = Literal["multi-innovation", "least-squares", "instrumental-variables"]

#: The paper's step.
STEP = 0.05
#: The interval of alpha: a flexible link is second order or a little less.
ALPHA = (1.05, 2.0)


#: Steps of refined instrumental variables a candidate; most stand still before.
REFINEMENTS = 5


@dataclass(frozen=True)
class Lattice:
    """Intervals and step of an order search.

    Parameters
    ----------
    step
        Step of every order that has no step of its own.
    alpha
        (low, high) of every highest order.
    orders
        Other orders by name: a number, a tuple (low, high) or (low, high, step), ``"low:high:step"`` or a list of
        values; ``alpha`` stands for every highest order and takes the place of the interval above.
    """

    step: float = STEP
    alpha: tuple[float, float] = ALPHA
    orders: Mapping[str, Values] = field(default_factory=dict)

    def values(self, structure: Structure) -> dict[str, tuple[float, ...]]:
        """Values of each free order of a structure.

        What the structure or this lattice does not name runs over all multiples of the step from 0 to the largest
        alpha; the search itself keeps an own-output order below alpha and any other at most alpha.

        Raises
        ------
        ModelError
            A name that is no free order, an interval out of range.
        """
        free = structure.order_names
        for name in self.orders:
            if name not in free and name != "alpha":
                raise ModelError(f"lattice order {name!r} is no free order; free are {', '.join(free) or 'none'}")
        highest = [n for e in structure.equations for n in e.order.names if e.order.is_single]
        values: dict[str, tuple[float, ...]] = {}
        for name in free:
            if name in self.orders:
                values[name] = self._axis(name, self.orders[name])
            elif name in structure.order_values:
                values[name] = structure.order_values[name]
            elif name in highest:
                values[name] = self._axis(name, self.orders.get("alpha", self.alpha))
        fixed = [e.order.constant for e in structure.equations if not e.order.names]
        top = max([max(values[n]) for n in highest if n in values] + fixed, default=2.0)
        for name in free:
            if name not in values:
                values[name] = grid(name, 0.0, min(top, MAX_ORDER), self.step)
        return {name: values[name] for name in free}

    def _axis(self, name: str, spec: Values) -> tuple[float, ...]:
        if isinstance(spec, tuple) and len(spec) == 2:
            spec = (*spec, self.step)
        values = parse_values(name, spec)
        return (values,) if isinstance(values, float) else values


def lattice(step: float = STEP, alpha: tuple[float, float] = ALPHA, **orders: Values) -> Lattice:
    """Intervals and step of an order search.

    Every own-output order takes all values 0 <= nu < alpha on the step (distinct, unordered within a signal), every
    other signal's 0 <= nu <= alpha, unless named here.

    Parameters
    ----------
    step
        Step, positive; the paper's is 0.05.
    alpha
        (low, high) of the highest order, in (0, 3].
    **orders
        Other orders by name, see :class:`Lattice`.

    Returns
    -------
    Lattice
        Its values follow once it meets a structure.

    Raises
    ------
    ModelError
        A step that is not positive, an interval that is empty or out of range.
    """
    if not (isinstance(alpha, (tuple, list)) and len(alpha) == 2):
        raise ModelError(f"alpha = {alpha!r} is no interval; write (low, high), such as {ALPHA}")
    low, high = (real_number("alpha", a) for a in alpha)
    if not 0 < low <= MAX_ORDER:
        raise ModelError(f"alpha interval {low:g}:{high:g} starts outside (0, 3]; choose a positive order")
    grid("alpha", low, high, step)
    return Lattice(step, (float(low), float(high)), dict(orders))


@dataclass(frozen=True)
class SearchRow:
    """One kept candidate.

    Parameters
    ----------
    rank
        From 1.
    index
        Index of the candidate in the lattice, by which ties are broken.
    score
        Its score: error (45) for norm l1, RMSE for l2; for a stage the sum of the equations' scores, each divided by
        its scale.
    orders
        Free orders by name.
    coefficients
        Coefficients by name.
    """

    rank: int
    index: int
    score: float
    orders: dict[str, float]
    coefficients: dict[str, float]


@dataclass(frozen=True)
class SearchResult:
    """A ranked table, the best model and what became of every candidate.

    Parameters
    ----------
    table
        Kept rows, best first.
    model
        Model of the first row.
    candidates
        Number of candidates.
    pruned
        Candidates not in the table, by reason: "beaten" (run to the end), "bound" (excluded by a lower bound of their
        score), "stopped early" (left at a partial sum), "singular", "diverged". Kept rows and these are all candidates.
        One that was excluded or left early might have diverged had it been run.
    failures
        The first candidates without a score: (orders by name, reason).
    m
        Block pulses a run.
    settings
        Criterion, norm, coefficients, innovation length, prior covariance, rows, initial terms.
    edges
        Orders of the first row that stand on the edge of their interval, by name with the edge.
    """

    table: list[SearchRow]
    model: Model
    candidates: int
    pruned: dict[str, int]
    failures: list[tuple[dict[str, float], str]]
    m: int
    settings: dict[str, Any]
    edges: dict[str, float]

    @property
    def orders(self) -> dict[str, float]:
        """Free orders of the best model."""
        return self.table[0].orders

    @property
    def coefficients(self) -> dict[str, float]:
        """Coefficients of the best model."""
        return self.table[0].coefficients

    @property
    def score(self) -> float:
        """Score of the best model."""
        return self.table[0].score

    def _repr_html_(self) -> str:
        from ftlm.report.notebook import search_html  # noqa: PLC0415 — only notebooks need it

        return search_html(self)

    def to_frame(self) -> Any:
        """The ranked table as a pandas frame, by rank."""
        from ftlm.exports import to_frame  # noqa: PLC0415 — pandas is not always there

        rows = [{"rank": r.rank, "score": r.score, **r.orders, **r.coefficients} for r in self.table]
        return to_frame(rows, ["rank"])

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "candidates": self.candidates,
            "pruned": self.pruned,
            "m": self.m,
            "settings": self.settings,
            "table": [
                {
                    "rank": r.rank,
                    "index": r.index,
                    "score": r.score,
                    "orders": r.orders,
                    "coefficients": r.coefficients,
                }
                for r in self.table
            ],
            "failures": [{"orders": o, "reason": reason} for o, reason in self.failures],
            "edges": self.edges,
        }

    def __str__(self) -> str:
        names, coefficients = list(self.orders), list(self.coefficients)
        what = "error" if self.settings["norm"] == "l1" else "RMSE"
        head = f"{'rank':>4}{what:>12}" + "".join(f"{n:>9}" for n in names) + "".join(f"{n:>12}" for n in coefficients)
        lines = [head]
        for row in self.table:
            orders = "".join(f"{row.orders[n]:>9.5g}" for n in names)
            values = "".join(f"{row.coefficients[n]:>12.5g}" for n in coefficients)
            lines.append(f"{row.rank:>4}{row.score:>12.5g}{orders}{values}")
        pruned = ", ".join(f"{count} {reason}" for reason, count in self.pruned.items() if count)
        lines.append(f"{self.candidates} candidates: {len(self.table)} kept" + (f", {pruned}" if pruned else ""))
        lines += [f"warning: order {n} = {v:g} is on the edge of its interval; widen it" for n, v in self.edges.items()]
        return "\n".join(lines)


def available_threads() -> int:
    """Cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS or Windows
        return os.cpu_count() or 1


def check_threads(threads: int | None) -> int:
    """Threads to use: all cores by default.

    Raises
    ------
    ModelError
        Fewer than one or more than 1 024.
    """
    if threads is None:
        return available_threads()
    found = whole_number(threads)
    if found is None or not 1 <= found <= 1024:
        raise ModelError(f"threads = {threads!r} is outside [1, 1024]; leave it out to use all cores")
    return found


@dataclass(frozen=True)
class Settings:
    """Checked settings of a search."""

    criterion: str
    norm: str
    coefficients: str
    innovation_length: int
    prior_covariance: float
    rows: str
    keep: int
    threads: int
    early_stopping: bool = True

    @classmethod
    def check(
        cls,
        criterion: str,
        norm: str,
        coefficients: str,
        innovation_length: int,
        prior_covariance: float,
        rows: str,
        keep: int,
        threads: int | None,
        early_stopping: bool = True,
    ) -> Settings:
        """Refuse words and numbers that mean nothing.

        Raises
        ------
        ModelError
            Naming the argument and what it may be.
        """
        for name, value, known in (
            ("criterion", criterion, ("output-error", "equation-error")),
            ("norm", norm, ("l1", "l2")),
            ("coefficients", coefficients, ("multi-innovation", "least-squares", "instrumental-variables")),
            ("rows", rows, ("haar", "time")),
        ):
            if value not in known:
                raise ModelError(
                    f"{name} = {value!r} is not known in this version; use {' or '.join(map(repr, known))}"
                )
        rows_kept, p = whole_number(keep), whole_number(innovation_length)
        if rows_kept is None or not 1 <= rows_kept <= 100_000:
            raise ModelError(f"keep = {keep!r} is outside [1, 100000]; keep as many rows as you will read")
        if p is None or not 1 <= p < 1 << 62:
            raise ModelError(f"innovation length p = {innovation_length!r} is no whole number from 1; the paper's is 7")
        k0 = real_number("prior covariance K0", prior_covariance)
        if not 0 < k0 < math.inf:
            raise ModelError(f"prior covariance K0 = {prior_covariance!r} is not positive; a large one is a weak prior")
        return cls(criterion, norm, coefficients, p, k0, rows, rows_kept, check_threads(threads), early_stopping)

    @property
    def needs_haar(self) -> bool:
        """Whether m must be a power of two."""
        return self.coefficients == "multi-innovation" and self.rows == "haar"

    def core(self) -> tuple[str, str, int, float, bool, int, int, bool, int]:
        """As the core takes them."""
        p = self.innovation_length if self.coefficients == "multi-innovation" else 0
        steps = REFINEMENTS if self.coefficients == "instrumental-variables" else 0
        ranked = (self.criterion, self.norm, p, self.prior_covariance, self.rows == "haar")
        return *ranked, self.keep, self.threads, self.early_stopping, steps

    def to_dict(self) -> dict[str, Any]:
        """For results and reports."""
        out: dict[str, Any] = {"criterion": self.criterion, "norm": self.norm, "coefficients": self.coefficients}
        if self.coefficients == "multi-innovation":
            out |= {"innovation_length": self.innovation_length, "prior_covariance": self.prior_covariance}
            out["rows"] = self.rows
        return out


def prepare(runs: Sequence[Run], structure: Structure, m: int | None, *, power_of_two: bool) -> list[Record]:
    """Make the records of runs for an estimator on the equation error.

    Raises
    ------
    DataError
        A signal that a run lacks, a constant output, or a signal with a free coefficient that is 0 in all runs.
    ModelError
        An m that the runs do not carry.
    """
    chosen = default_m(runs, power_of_two=power_of_two) if m is None else m
    m = check_m(chosen, runs, power_of_two=power_of_two)
    for run in runs:
        run.require_outputs([o for o in structure.outputs if o in run])
    records = [record(run, structure, m) for run in runs]
    if any(r.initial == "caputo" for r in records):
        # One rule for all runs of a fit: initial terms that a run at rest does not need are estimated as zero.
        records = [record(run, replace(structure, initial="caputo"), m) for run in runs]
    for item in structure.equations:
        for term in item.terms:
            if term.fixed is None and term.signal != item.output and not any(r.of(term.signal).any() for r in records):
                raise DataError(
                    f"{term.signal} is 0 throughout, so its coefficient in the equation of {item.output} cannot be "
                    "identified; leave the term out, fix its coefficient, or add a run in which it moves"
                )
    return records


def search_orders(
    runs: Run | Sequence[Run],
    equation: Structure,
    lattice: Lattice | None = None,
    *,
    criterion: Criterion = "output-error",
    coefficients: Coefficients = "multi-innovation",
    norm: Literal["l1", "l2"] = "l1",
    innovation_length: int = 7,
    prior_covariance: float = 1.0,
    rows: Literal["haar", "time"] = "haar",
    m: int | None = None,
    keep: int = 20,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    early_stopping: bool = True,
    store: str | os.PathLike[str] | None = None,
    executor: Executor | None = None,
) -> SearchResult:
    """Exhaustive search over the orders of an equation, or of a stage under its order law.

    Each candidate gets its coefficients on the equation error, then its score; the table is that of evaluating every
    candidate to the end, the same bits for any number of threads (paper Table 2, steps 5-7).

    Parameters
    ----------
    runs
        One run or several with the same names and units; scores add up.
    equation
        Structure with free orders; see :func:`ftlm.equation` and :func:`ftlm.flexible_link`.
    lattice
        Intervals and step; see :func:`ftlm.lattice`.
    criterion
        ``"output-error"``: the free run, each equation driven by the measured other outputs. ``"equation-error"``:
        measured signals on the right-hand side; it prefers near-identities.
    coefficients
        ``"multi-innovation"`` (closed form of paper (44)), ``"least-squares"``, or ``"instrumental-variables"``:
        refined instrumental variables for every candidate, which noise on the outputs does not bias. Measured outputs
        that drive an equation are replaced by their projections on what the inputs excite, as instruments and in the
        score.
    norm
        ``"l1"`` (paper (45)) or ``"l2"`` (paper (46)).
    innovation_length, prior_covariance, rows
        p and K0 of paper (43)-(44), and whether rows come in Haar coordinates or in the order of time.
    m
        Block pulses a run; default 2 048, or what the runs carry.
    keep
        Rows of the table.
    threads
        Threads; default all cores.
    progress
        Called about twenty times a second with (candidates done, candidates in all).
    early_stopping
        Whether to leave a candidate once it cannot be kept, by a proved bound of its score or by its partial sum;
        False is brute force, with the same table.
    store
        File in which finished work is kept, on disk within a second; the same call goes on with it after a power cut,
        and so does :func:`resume_search`.
    executor
        Any :class:`concurrent.futures.Executor` to work for this search: threads, processes, or a cluster's, such as
        ``dask.distributed.Client(…).get_executor()``. The result is the same to the last bit on processors of one kind.
        `threads` are those of one task then, one by default.

    Returns
    -------
    SearchResult
        Table, best model and counts.

    Raises
    ------
    DataError
        Runs that do not fit, or a constant output; a store of another search, in use, damaged, or that cannot be
        written.
    ModelError
        Nothing to search, a lattice without or with too many candidates, settings out of range.
    ConvergenceError
        An executor that has lost its workers.
    KeyboardInterrupt
        Ctrl-C, within half a second.

    Notes
    -----
    One Gram matrix of distinct regressors serves all candidates; each costs a k x k solve and a lower bound of its
    score from a few inner products. Those that the bound does not exclude are run until their partial sum has lost,
    likely ones first. Candidates are generated by index, so memory does not grow with their number.
    """
    if executor is not None and threads is None:
        threads = 1
    job = make_job(
        runs, equation, lattice, criterion=criterion, coefficients=coefficients, norm=norm,
        innovation_length=innovation_length, prior_covariance=prior_covariance, rows=rows, m=m, keep=keep,
        threads=threads, progress=progress, early_stopping=early_stopping,
    )  # fmt: skip
    if store is None:
        return run_job(job, executor=executor)
    with Store(store, [job.request(job.name)]) as kept:
        return run_job(job, store=kept, executor=executor)


def make_job(
    runs: Run | Sequence[Run],
    equation: Structure,
    lattice: Lattice | None = None,
    *,
    criterion: str = "output-error",
    coefficients: str = "multi-innovation",
    norm: str = "l1",
    innovation_length: int = 7,
    prior_covariance: float = 1.0,
    rows: str = "haar",
    m: int | None = None,
    keep: int = 20,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    early_stopping: bool = True,
) -> Job:
    """Check what :func:`search_orders` is given, and make it what a search works on.

    Raises
    ------
    DataError, ModelError
        As :func:`search_orders`.
    """
    found = as_runs(runs)
    settings = Settings.check(
        criterion, norm, coefficients, innovation_length, prior_covariance, rows, keep, threads, early_stopping
    )
    if not isinstance(equation, Structure):
        raise ModelError(f"equation is {type(equation).__name__}, not a structure; use ftlm.equation or flexible_link")
    if not equation.order_names:
        raise ModelError("every order is a number, so there is nothing to search; name one, as in D^alpha y")
    if len(equation.equations) > 1 and not equation.has_order_law:
        raise ModelError(
            "the equations share no order law, so they are searched one by one: "
            f"pass .equation({equation.outputs[0]!r}) or use identify"
        )
    check_lattice(lattice)
    values = (lattice or Lattice()).values(equation)
    records = prepare(found, equation, m, power_of_two=settings.needs_haar)
    units = {n: u for n, u in found[0].units.items() if n in equation.signals}
    return Job(tuple(r.name for r in found), units, equation, values, records, settings, _told(progress))


def run_job(job: Job, *, store: Store | None = None, number: int = 0, executor: Executor | None = None) -> SearchResult:
    """Search; with a store, as search `number` of it.

    Raises
    ------
    DataError, ModelError, ConvergenceError, KeyboardInterrupt
        As :func:`search_orders`.
    """
    if job.structure.has_order_law:
        return _search_law(job, store, number, executor)
    return _search_one(job, store, number, executor)


def resume_search(
    path: str | os.PathLike[str],
    *,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    executor: Executor | None = None,
    salvage: bool = False,
) -> dict[str, SearchResult]:
    """Go on with the searches of a store; it holds all that they are computed from.

    Parameters
    ----------
    path
        A file written with ``store=``.
    threads, progress, executor
        As for :func:`search_orders`.
    salvage
        Whether to go on with a damaged store: what stands before the damage is kept, the rest is computed again, and
        the damaged file stays beside it as ``….damaged``.

    Returns
    -------
    dict of SearchResult
        By output, or under ``"stage"`` for a search under an order law; those of the uninterrupted searches to the last
        bit. A store that is complete is only read.

    Raises
    ------
    DataError
        No store, one in use, damaged (with its offset), or one that cannot be written.
    ModelError
        Threads out of range.
    ConvergenceError
        An executor that has lost its workers.
    KeyboardInterrupt
        Ctrl-C, within half a second; the store can be resumed.
    """
    with Store(path, salvage=salvage) as store:
        return {
            request.name: resume_job(store, number, threads=threads, progress=progress, executor=executor)
            for number, request in enumerate(store.contents.requests)
        }


def resume_job(
    store: Store,
    number: int,
    *,
    threads: int | None,
    progress: Callable[[int, int], None] | None,
    executor: Executor | None = None,
) -> SearchResult:
    """Go on with one search of a store.

    Raises
    ------
    DataError, ModelError, ConvergenceError, KeyboardInterrupt
        As :func:`resume_search`.
    """
    threads = 1 if executor is not None and threads is None else check_threads(threads)
    request = store.contents.requests[number]
    try:
        job = Job.of(request, threads, _told(progress))
        return run_job(job, store=store, number=number, executor=executor)
    except ModelError as error:
        raise DataError(
            f"{store.path} holds no usable search of {request.name}: {error}; start it again in another file"
        ) from error


@dataclass(frozen=True)
class StoreStatus:
    """How far a search in a store is.

    Parameters
    ----------
    name
        Output that was searched, or ``"stage"``.
    candidates
        Candidates in all. Under an order law those of the equations one by one, as far as is known: one that was left
        early may have to be followed further.
    done
        Candidates dealt with.
    best
        Best score so far: error (45) for norm l1, RMSE for l2; None before the first.
    settings
        Criterion, norm, coefficients.
    runs
        Names of the runs.
    version
        Version of ftlm that began the store.
    torn
        Bytes of an unfinished write at its end.
    damage
        What is damaged, with its offset, or None.
    """

    name: str
    candidates: int
    done: int
    best: float | None
    settings: dict[str, Any]
    runs: tuple[str, ...]
    version: str
    torn: int
    damage: str | None

    @property
    def complete(self) -> bool:
        """Whether nothing is left to do."""
        return self.done == self.candidates

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**asdict(self), "complete": self.complete}

    def __str__(self) -> str:
        share = 100 * self.done / self.candidates
        text = f"{self.name}: {self.done} of {self.candidates} candidates done ({share:.1f} %)"
        text += "" if self.best is None else f", best score {self.best:.6g}"
        text += f", runs {', '.join(self.runs)}"
        if self.torn:
            text += f"\n{self.torn} bytes of an unfinished write at its end: being written now, or dropped on resuming"
        if self.damage is not None:
            text += f"\ndamaged: {self.damage}; resume with --salvage to keep what stands before"
        return text


def search_status(path: str | os.PathLike[str]) -> dict[str, StoreStatus]:
    """How far the searches of a store are; it may be in use.

    Of an unfinished stage under its order law the tables are laid out again, which takes seconds for a fine lattice.

    Parameters
    ----------
    path
        A file written with ``store=``.

    Returns
    -------
    dict of StoreStatus
        By output, or under ``"stage"``.

    Raises
    ------
    DataError
        No store.
    """
    contents = read_store(path)
    found = {}
    for request, section in zip(contents.requests, contents.sections, strict=True):
        try:
            job = Job.of(request, 1, None)
            if job.structure.has_order_law:
                candidates, best = stage_state(job.stage_work()[0], section, 1)
            else:
                work, _ = job.work()
                candidates, _ = work.plan()
                best = section.best
                if best is not None and job.settings.norm == "l2":
                    best = math.sqrt(max(best, 0.0) / work.samples)
        except ModelError as error:
            raise DataError(
                f"{path} holds no usable search of {request.name}: {error}; start it again in another file"
            ) from error
        found[request.name] = StoreStatus(
            request.name, candidates, section.dealt, best, job.settings.to_dict(), request.runs, contents.version,
            contents.torn, contents.damage,
        )  # fmt: skip
    return found


def _told(progress: Callable[[int, int], None] | None) -> Callable[[int, int, int], None] | None:
    """What the core calls: the bar shows the share pruned too, others are told what is done."""
    if progress is None or isinstance(progress, Progress):
        return progress
    return lambda done, total, _pruned: progress(done, total)


def check_lattice(lattice: Lattice | None) -> None:
    """Refuse a lattice that is none.

    Raises
    ------
    ModelError
        Something else.
    """
    if not (lattice is None or isinstance(lattice, Lattice)):
        raise ModelError(f"lattice is {type(lattice).__name__}, not a Lattice; use ftlm.lattice(…)")


@dataclass(frozen=True)
class Job:
    """What a search works on."""

    runs: tuple[str, ...]
    units: Mapping[str, str]
    structure: Structure
    values: Mapping[str, tuple[float, ...]]
    records: list[Record]
    settings: Settings
    progress: Callable[[int, int, int], None] | None

    @property
    def name(self) -> str:
        """What its result is called among others."""
        return "stage" if self.structure.has_order_law else self.structure.outputs[0]

    def request(self, name: str) -> Request:
        """As a store keeps it."""
        settings = {f.name: getattr(self.settings, f.name) for f in fields(self.settings) if f.name != "threads"}
        records = tuple(RecordFile.of(r) for r in self.records)
        return Request(name, self.structure, dict(self.values), settings, records, self.runs, dict(self.units))

    @classmethod
    def of(cls, request: Request, threads: int, progress: Callable[[int, int, int], None] | None) -> Job:
        """From a store.

        Raises
        ------
        ModelError
            A request that is none.
        """
        s = request.settings
        try:
            settings = Settings.check(
                cast("str", s["criterion"]), cast("str", s["norm"]), cast("str", s["coefficients"]),
                cast("int", s["innovation_length"]), cast("float", s["prior_covariance"]), cast("str", s["rows"]),
                cast("int", s["keep"]), threads, bool(s["early_stopping"]),
            )  # fmt: skip
        except KeyError as error:
            raise ModelError(f"setting {error} is missing") from None
        records = [r.record() for r in request.records]
        structure = request.structure
        signals = structure.signals
        if not records or (len(structure.equations) != 1 and not structure.has_order_law):
            raise ModelError("it is not the search of one equation, or of some under a law, on a record")
        if any(r.signals != signals or r.inputs != records[0].inputs for r in records):
            raise ModelError("its records do not hold the signals of its equation")
        if any(n not in request.values for n in structure.order_names):
            raise ModelError("an order has no values")
        return cls(request.runs, request.units, structure, request.values, records, settings, progress)

    def work(self) -> tuple[Work, list[str]]:
        """As rounds are computed from it, and the signals by number."""
        item, first = self.structure.equations[0], self.records[0]
        signals = list(first.signals)
        axes = [
            (signals.index(t.signal), axis_of(t.order, self.values), bool(t.order.names) and t.fixed is None)
            for t in item.terms
        ]
        orders = (signals.index(item.output), axis_of(item.order, self.values), axes)
        work = Work(
            tuple(r.core() for r in self.records), orders, list(first.inputs), [t.fixed for t in item.terms],
            initial_tuple(first.initial), self.settings.core(),
        )  # fmt: skip
        return work, signals

    def stage_work(self) -> tuple[StageWork, list[str]]:
        """As the search of a stage is computed from it, and the free orders by number."""
        structure, records, settings = self.structure, self.records, self.settings
        names = list(structure.order_names)
        signals = records[0].signals

        def affine(order: Order) -> tuple[float, list[float]]:
            weights = dict(order.weights)
            return order.constant, [weights.get(n, 0.0) for n in names]

        laws = [
            (signals.index(e.output), affine(e.order), [(signals.index(t.signal), affine(t.order)) for t in e.terms])
            for e in structure.equations
        ]
        # Each output's deviation makes radians of hub and of deflection weigh alike.
        points = sum(r.m for r in records)
        with np.errstate(over="ignore", invalid="ignore"):
            spread = [
                math.sqrt(sum(float(((r.of(e.output) - r.of(e.output).mean()) ** 2).sum()) for r in records) / points)
                for e in structure.equations
            ]
        for item, size in zip(structure.equations, spread, strict=True):
            if not 0 < size < math.inf:
                raise ModelError(
                    f"the deviation of {item.output} is {size:g}; scale it so that its squares are numbers"
                )
        work = StageWork(
            tuple(r.core() for r in records), [list(self.values[n]) for n in names], laws, list(records[0].inputs),
            [[t.fixed for t in e.terms] for e in structure.equations],
            [s * points if settings.norm == "l1" else s for s in spread],
            initial_tuple(records[0].initial), settings.core(),
        )  # fmt: skip
        return work, names


def axis_of(order: Order, values: Mapping[str, tuple[float, ...]]) -> list[float]:
    """Values of an order that is a number or one free order."""
    return list(values[order.names[0]]) if order.names else [order.constant]


def _search_one(job: Job, store: Store | None, number: int, executor: Executor | None) -> SearchResult:
    item = job.structure.equations[0]
    work, signals = job.work()
    try:
        if store is None and executor is None:
            found = _core.search(
                list(work.runs), work.orders, work.inputs, work.fixed, work.initial, work.settings, job.progress
            )
        else:
            parts = do_rounds(
                work, store=store, number=number, executor=executor, threads=job.settings.threads, progress=job.progress
            )
            found = work.join(parts)
    except ModelError as error:
        raise named_signals(error, signals) from None

    def named(alpha: float, orders: list[float]) -> dict[str, float]:
        pairs = zip((item.order, *(t.order for t in item.terms)), (alpha, *orders), strict=True)
        return {o.names[0]: v for o, v in pairs if o.names}

    table = [
        SearchRow(rank, index, score, named(alpha, orders), named_coefficients(item, c))
        for rank, (index, score, alpha, orders, c, _) in enumerate(found["rows"], 1)
    ]
    failures = [(named(alpha, orders), str(reason)) for _, alpha, orders, reason in found["failures"]]
    return _result(job, table, dict(cast("Mapping[str, int]", found["counts"])), failures)


def _search_law(job: Job, store: Store | None, number: int, executor: Executor | None) -> SearchResult:
    structure = job.structure
    work, names = job.stage_work()
    if store is None and executor is None:
        found = work.search(job.progress)
    else:
        found = do_stage(
            work, store=store, number=number, executor=executor, threads=job.settings.threads, progress=job.progress
        )
    table = []
    for rank, (index, score, free, parts) in enumerate(found["rows"], 1):
        coefficients: dict[str, float] = {}
        for item, (_, _, _, c, _) in zip(structure.equations, parts, strict=True):
            coefficients |= named_coefficients(item, c)
        table.append(SearchRow(rank, index, score, dict(zip(names, free, strict=True)), coefficients))
    failures = [(dict(zip(names, free, strict=True)), str(reason)) for _, free, reason in found["failures"]]
    return _result(job, table, dict(cast("Mapping[str, int]", found["counts"])), failures)


def named_coefficients(item: Equation, raw: Sequence[float]) -> dict[str, float]:
    """Free coefficients by name from the core's products of factor and coefficient."""
    return {t.coefficient: c / t.factor for t, c in zip(item.terms, raw, strict=True) if isinstance(t.coefficient, str)}


def _result(
    job: Job, table: list[SearchRow], counts: Mapping[str, int], failures: list[tuple[dict[str, float], str]]
) -> SearchResult:
    structure, values, settings = job.structure, job.values, job.settings
    m = job.records[0].m
    if not table:
        raise ModelError(f"none of {counts['candidates']} candidates has a finite score; check the data and the orders")
    best = table[0]
    model = Model(
        structure.with_orders(best.orders).with_coefficients(best.coefficients),
        orders=best.orders,
        units=job.units,
        m=m,
        about={"runs": ", ".join(job.runs), "orders from": "order search", **settings.to_dict()},
    )
    edges = {
        n: v for n, v in best.orders.items() if len(values[n]) > 2 and v in (values[n][0], values[n][-1]) and v != 0
    }
    # alpha = 2 is where the physics puts it, not an accident of the interval.
    edges = {n: v for n, v in edges.items() if not (v == 2.0 and n in _highest(structure))}
    pruned = {k: int(v) for k, v in counts.items() if k not in ("candidates", "kept")}
    return SearchResult(table, model, int(counts["candidates"]), pruned, failures, m, settings.to_dict(), edges)


def _highest(structure: Structure) -> set[str]:
    return {n for e in structure.equations for n in e.order.names}
