"""Exhaustive order searches over one equation, or over a stage under its order law."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from ftlm.base.checks import check_threads
from ftlm.base.errors import DataError, ModelError
from ftlm.base.progress import Progress
from ftlm.data.lattice import Lattice, check_lattice
from ftlm.data.run import Run
from ftlm.data.settings import Coefficients, Criterion, Settings, check_used
from ftlm.data.several import as_runs
from ftlm.data.structures import Structure
from ftlm.paint.heat import Landscape
from ftlm.search.contents import read_store
from ftlm.search.frames import Request
from ftlm.search.job import Job, run_job
from ftlm.search.result import SearchResult, StoreStatus
from ftlm.search.rounds import equation_state, stage_state
from ftlm.search.store import Store
from ftlm.search.work import Told
from ftlm.solve.records import check_held, check_linear, prepare


def search_orders(
    runs: Run | Sequence[Run],
    equation: Structure,
    lattice: Lattice | None = None,
    *,
    criterion: Criterion = "output-error",
    coefficients: Coefficients = "multi-innovation",
    norm: Literal["l1", "l2"] = "l1",
    innovation_length: int | None = None,
    prior_covariance: float | None = None,
    rows: Literal["haar", "time"] | None = None,
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
    candidate to the end, the same bits for any number of threads on one kind of processor (paper Table 2, steps 5-7).

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
        p and K0 of paper (43)-(44), and whether rows come in Haar coordinates (``"haar"``) or in the order of time
        (``"time"``); by default 7, 1 and ``"haar"``. Of ``"multi-innovation"`` alone; with other coefficients they are
        refused.
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
        Nothing to search, a lattice without or with too many candidates, settings out of range, an option that these
        coefficients do not use; what needs more memory than the machine has left, or than ``FTLM_MEMORY`` allows.
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
    checked = as_runs(runs)
    weighted = {"innovation_length": innovation_length, "prior_covariance": prior_covariance, "rows": rows}
    words: dict[str, Any] = {n: value for n, value in weighted.items() if value is not None}
    settings = Settings.check(
        criterion, norm, coefficients, keep=keep, threads=threads, early_stopping=early_stopping, **words
    )
    check_used(coefficients, words, argument="coefficients")
    job = make_job(checked, equation, lattice, settings, m=m, progress=progress)
    if store is None:
        return run_job(job, executor=executor)
    with Store(store, [job.request(job.name)]) as kept:
        return run_job(job, store=kept, executor=executor)


def make_job(
    runs: Run | Sequence[Run],
    equation: Structure,
    lattice: Lattice | None = None,
    settings: Settings | None = None,
    *,
    m: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    **words: Any,
) -> Job:
    """Check what :func:`search_orders` is given, and make it what a search works on.

    Settings come checked, or in the words of :meth:`.Settings.check`.
    """
    checked = as_runs(runs)
    settings = settings or Settings.check(**words)
    if not isinstance(equation, Structure):
        raise ModelError(f"equation is {type(equation).__name__}, not a structure; use ftlm.equation or flexible_link")
    if not equation.order_names:
        raise ModelError("every order is a number, so there is nothing to search; name one, as in D^alpha y")
    check_linear(equation.equations, "an order search")
    if len(equation.equations) > 1 and not equation.has_order_law:
        raise ModelError(
            "the equations share no order law, so they are searched one by one: "
            f"pass .equation({equation.outputs[0]!r}) or use identify"
        )
    check_lattice(lattice)
    values = (lattice or Lattice()).values(equation)
    known = {n: v[0] for n, v in values.items() if len(v) == 1}
    for run in checked:
        check_held(run, equation, known)
    records = prepare(checked, equation, m, power_of_two=settings.needs_haar)
    units = {n: u for n, u in checked[0].units.items() if n in equation.signals}
    return Job(tuple(r.name for r in checked), units, equation, values, records, settings, _told(progress))


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
    """Go on with one search of a store."""
    threads = 1 if executor is not None and threads is None else threads
    job = replace(job_of(store, number, threads), progress=_told(progress))
    with _usable(store.path, store.contents.requests[number]):
        return run_job(job, store=store, number=number, executor=executor)


def job_of(store: Store, number: int, threads: int | None) -> Job:
    """One search of a store as what it works on."""
    request = store.contents.requests[number]
    with _usable(store.path, request):
        return Job.of(request, check_threads(threads), None)


@contextlib.contextmanager
def _usable(path: str | os.PathLike[str], request: Request) -> Iterator[None]:
    """Say of a search that makes no sense which one it is, and in which store."""
    try:
        yield
    except ModelError as error:
        raise DataError(
            f"{path} holds no usable search of {request.name}: {error}; start it again in another file"
        ) from error


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
    states = {}
    for request, section in zip(contents.requests, contents.sections, strict=True):
        with _usable(path, request):
            job = Job.of(request, 1, None)
            if section.law:
                candidates, best = stage_state(job.stage_work(), section)
            else:
                candidates, best = equation_state(job.equation_work(), section)
        states[request.name] = StoreStatus(
            request.name, candidates, section.dealt, best, job.settings.to_dict(), request.runs, contents.version,
            contents.torn, contents.damage,
        )  # fmt: skip
    return states


def _told(progress: Callable[[int, int], None] | None) -> Told | None:
    """What the core calls: the bar shows the share pruned too, others are told what is done."""
    if progress is None or isinstance(progress, Progress):
        return progress
    return lambda done, total, _pruned: progress(done, total)


def landscape(
    runs: Run | Sequence[Run],
    structure: Structure,
    search: SearchResult,
    lattice: Lattice | None = None,
    *,
    orders: tuple[str, str] | None = None,
    threads: int | None = None,
) -> Landscape:
    """Score every pair of values of two orders by the search's own criterion.

    Parameters
    ----------
    runs, structure, lattice
        What was searched: an equation, or a stage under its order law.
    search
        What was found.
    orders
        Names of the two; by default the first two free orders that the lattice gives several values.
    threads
        See :func:`ftlm.search_orders`.

    Returns
    -------
    Landscape

    Raises
    ------
    ModelError
        Fewer than two orders with several values, or a name that is none of them.
    """
    axes = {n: v for n, v in (lattice or Lattice()).values(structure).items() if len(v) > 1}
    best = search.orders
    names = orders or tuple(list(axes)[:2])
    if len(names) != 2 or names[0] == names[1] or any(n not in axes for n in names):
        free = ", ".join(axes) or "none"
        raise ModelError(f"a landscape needs two different orders with several values each; this lattice has {free}")
    x, y = (np.array(axes[n]) for n in names)
    fixed = structure.with_orders({n: v for n, v in best.items() if n not in names})
    table = search_orders(
        runs, fixed, Lattice(orders={names[0]: x.tolist(), names[1]: y.tolist()}), m=search.m, keep=x.size * y.size,
        threads=threads, **search.settings,
    ).table  # fmt: skip
    scores = np.full((y.size, x.size), np.inf)
    columns = np.array([r.orders[names[0]] for r in table])
    rows = np.array([r.orders[names[1]] for r in table])
    values = np.array([r.score for r in table])
    scores[np.abs(y[:, None] - rows).argmin(axis=0), np.abs(x[:, None] - columns).argmin(axis=0)] = values
    return Landscape((names[0], names[1]), x, y, scores)
