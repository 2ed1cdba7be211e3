"""Order search of one equation or of coupled equations: preparation, run, resumption, and score surfaces."""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from typing import Any, cast

import numpy as np
from msgspec import UNSET

from ftlm import _core
from ftlm.data.run import Run
from ftlm.data.runs import as_runs
from ftlm.errors import DataError, FtlmError, ModelError
from ftlm.model.model import Model
from ftlm.order_search.batches import (
    CoreRecord,
    CoupledProblem,
    EquationProblem,
    Execution,
    ProgressCallback,
    coupled_state,
    equation_state,
    search_coupled,
    search_equation,
)
from ftlm.order_search.checkpoint import Request, Store, check_record, read_store
from ftlm.order_search.options import Norm, OrderGrid, SearchSettings, check_order_grid
from ftlm.order_search.result import SearchResult, SearchRow, StoreStatus
from ftlm.progress import Progress
from ftlm.simulation.discretization import (
    InitialTuple,
    Record,
    affine,
    check_derivative_orders,
    check_frictionless,
    check_linear,
    error_with_signal_names,
    named_coefficients,
    order_grid_tuple,
    prepare,
)
from ftlm.simulation.nonlinear_columns import record_signals
from ftlm.simulation.output_samples import simulate_samples
from ftlm.structure.parser import as_structure
from ftlm.structure.structure import Structure
from ftlm.svg.charts import Landscape
from ftlm.svg.figure import SMALL_WIDTH_PX
from ftlm.svg.line_chart import LineChart
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import symbol
from ftlm.utils.validation import Floats, check_threads

#: Minimum number of best candidates by equation error that are simulated if the equations have nonlinear terms.
FREE_RUN_CANDIDATES = 300


def record_run(rec: Record, structure: Structure) -> Run:
    """Return a run made from a block-pulse record, with one sample at each boundary between pulses.

    Inputs have a zero-order hold and the pulse means of the record. An output sample is the mean of the two neighboring
    pulse means. The first and the last output sample are extrapolated linearly.
    """
    rows = {name: rec.of(name) for name in structure.signals}
    inputs = {
        name: np.append(row, row[-1])
        for (name, row), is_input in zip(rows.items(), rec.inputs, strict=False)
        if is_input
    }
    outputs = {
        name: np.concatenate([[1.5 * row[0] - 0.5 * row[1]], (row[:-1] + row[1:]) / 2, [1.5 * row[-1] - 0.5 * row[-2]]])
        for name, row in rows.items()
        if name not in inputs
    }
    return Run.from_arrays(step=rec.step, inputs=inputs, outputs=outputs, intersample=dict.fromkeys(inputs, "zoh"))


def record_structure(rec: Record, structure: Structure) -> Structure:
    """Return a structure for runs made from a block-pulse record.

    The structure has no delays or input nonlinearities, because the signals of the record already include their
    effects. Initial conditions and offset are those of the record.
    """
    return replace(
        structure, delay={}, free_delays={}, input_nonlinearities=UNSET, initial=rec.initial, offset=rec.offset
    )


def free_run_errors(model: Model, rec: Record, run: Run) -> dict[str, Floats]:
    """Return measured minus simulated block-pulse means, one array (pulses,) per output name.

    Values are not finite if the simulation diverges.
    """
    simulated, _ = simulate_samples(replace(model, structure=record_structure(rec, model.structure)), run, 1, None)
    with np.errstate(over="ignore", invalid="ignore"):
        return {
            name: rec.of(name) - (row[:-1] + row[1:]) / 2 for name, row in zip(model.outputs, simulated, strict=True)
        }


def free_run_score(
    model: Model, records: Sequence[Record], runs: Sequence[Run], norm: Norm, scales: Sequence[float]
) -> float:
    """Return the score of a model's simulations over all records, summed over outputs.

    For the norm ``"l1"``, the score of an output is the sum of absolute errors, eq. (45) of the paper, and for ``"l2"``
    the RMSE. Each is divided by the entry of `scales` for this output. The score is infinite if a simulation fails or
    diverges.
    """
    try:
        errors = [free_run_errors(model, rec, run) for rec, run in zip(records, runs, strict=True)]
    except FtlmError:
        return math.inf
    score = 0.0
    for name, scale in zip(model.outputs, scales, strict=True):
        residuals = np.concatenate([e[name] for e in errors])
        with np.errstate(over="ignore", invalid="ignore"):
            error_measure = float(np.abs(residuals).sum()) if norm == "l1" else math.sqrt(float(np.mean(residuals**2)))
        score += error_measure / scale
    return score if math.isfinite(score) else math.inf


def rank_by_simulation(
    table: Sequence[SearchRow], structure: Structure, records: Sequence[Record], norm: Norm, scales: Sequence[float]
) -> list[SearchRow]:
    """Return the rows of a search table whose simulations are finite, ranked by the score of the simulation.

    Score and rank of each returned row are replaced. Equal scores are ranked by the index of the candidate.

    Raises
    ------
    ModelError
        If no row has a finite simulation.
    """
    runs = [record_run(rec, structure) for rec in records]
    scored = []
    for row in table:
        model = Model(structure.with_orders(row.orders).with_coefficients(row.coefficients))
        score = free_run_score(model, records, runs, norm, scales)
        if math.isfinite(score):
            scored.append(replace(row, score=score))
    if not scored:
        raise ModelError(
            f"the simulations of the best {len(table)} candidates by equation error all diverge; check the signs of "
            "the non-linear terms, or search by equation error"
        )
    scored.sort(key=lambda row: (row.score, row.index))
    return [replace(row, rank=rank) for rank, row in enumerate(scored, 1)]


Failures = list[tuple[dict[str, float], str]]


@dataclass(frozen=True)
class Job:
    """Order search with validated arguments, and with the block-pulse records of its runs."""

    runs: tuple[str, ...]
    units: Mapping[str, str]
    structure: Structure
    values: Mapping[str, tuple[float, ...]]
    records: list[Record]
    settings: SearchSettings
    threads: int
    progress: ProgressCallback | None

    @property
    def name(self) -> str:
        """Name of the output, or ``"stage"`` if an order law relates the orders of coupled equations."""
        return "stage" if self.structure.has_order_law else self.structure.outputs[0]

    def request(self, name: str) -> Request:
        """Return the definition of this search for a checkpoint file, which stores it under `name`."""
        # Hints are initial guesses of a fit and do not change a search.
        structure = replace(self.structure, hints=UNSET)
        # The records store the kind of offset, so the stored structure omits it.
        object.__setattr__(structure, "offset", UNSET)
        return Request(
            name, structure, dict(self.values), asdict(self.settings), tuple(self.records), self.runs, dict(self.units)
        )

    @classmethod
    def of(cls, request: Request, threads: int, progress: ProgressCallback | None) -> Job:
        """Return the order search that a request of a checkpoint file defines; raise ModelError if it is invalid."""
        try:
            settings: dict[str, Any] = {f.name: request.settings[f.name] for f in fields(SearchSettings)}
        except KeyError as error:
            raise ModelError(f"setting {error} is missing") from None
        records = list(request.records)
        for record in records:
            check_record(record)
        structure = replace(request.structure, offset=records[0].offset if records else "none")
        signals = record_signals(structure)
        if not records or (len(structure.equations) != 1 and not structure.has_order_law):
            raise ModelError("the search has no block-pulse records, or several equations without an order law")
        if any(r.signals != signals or r.inputs != records[0].inputs for r in records):
            raise ModelError("the records of the search lack a signal of its equation")
        if any(n not in request.values for n in structure.order_names):
            raise ModelError("an order has no values")
        return cls(
            request.runs,
            request.units,
            structure,
            request.values,
            records,
            SearchSettings(**settings),
            threads,
            progress,
        )

    def _common_arguments(self) -> tuple[tuple[CoreRecord, ...], list[bool], InitialTuple, SearchSettings, int]:
        record = self.records[0]
        runs = tuple(r.core() for r in self.records)
        return runs, list(record.inputs), record.start, self.settings, self.threads

    def equation_problem(self) -> EquationProblem:
        """Return the search problem of the single equation, in the form that the Rust core takes."""
        equation = self.structure.equations[0]
        orders = order_grid_tuple(equation, self.records[0].signals, self.values)
        return EquationProblem(*self._common_arguments(), orders=orders, fixed=[t.fixed_value for t in equation.terms])

    def coupled_problem(self) -> CoupledProblem:
        """Return the search problem of the coupled equations, in the form that the Rust core takes.

        Raise ModelError if the standard deviation of an output is 0 or not finite.
        """
        structure, signals = self.structure, self.records[0].signals
        names = structure.order_names
        law = partial(affine, names=names)
        laws = [
            (signals.index(e.output), law(e.order), [(signals.index(t.column), law(t.order)) for t in e.terms])
            for e in structure.equations
        ]
        return CoupledProblem(
            *self._common_arguments(),
            axes=[list(self.values[n]) for n in names],
            laws=laws,
            fixed=[[t.fixed_value for t in e.terms] for e in structure.equations],
            scales=self.scales(),
        )

    def scales(self) -> list[float]:
        """Return the number by which the score of each equation is divided.

        Without an order law it is 1. Otherwise it is the standard deviation of the output, which for the norm ``"l1"``
        is multiplied by the number of block pulses of all records.
        """
        if not self.structure.has_order_law:
            return [1.0] * len(self.structure.equations)
        points = sum(r.m for r in self.records)
        return [s * points if self.settings.norm == "l1" else s for s in self.standard_deviations()]

    def standard_deviations(self) -> list[float]:
        """Return the standard deviation of each output, in the sequence of the outputs.

        Deviations are taken from the mean of each record. Raise ModelError if a standard deviation is 0 or not finite.
        """
        points, deviations = sum(r.m for r in self.records), []
        for output in self.structure.outputs:
            with np.errstate(over="ignore", invalid="ignore"):
                squares = sum(float(((r.of(output) - r.of(output).mean()) ** 2).sum()) for r in self.records)
            deviation = math.sqrt(squares / points)
            if not 0 < deviation < math.inf:
                raise ModelError(
                    f"the deviation of {output} is {deviation:g}; scale the signal so that its squares neither "
                    "overflow "
                    "nor underflow"
                )
            deviations.append(deviation)
        return deviations


def check_executor(executor: object) -> None:
    """Raise ModelError unless `executor` is None or an executor of `concurrent.futures`."""
    if executor is not None and not isinstance(executor, Executor):
        raise ModelError(
            f"executor = {executor!r} is not an executor of concurrent.futures; pass ProcessPoolExecutor(…) or "
            "Client(…).get_executor()"
        )


def threads_per_task(threads: int | None, executor: Executor | None) -> int:
    """Return the number of threads of one task.

    If `threads` is None, the number is 1 with an executor. Without an executor it is ``FTLM_THREADS`` if set, otherwise
    the number of cores. Raise ModelError if the number is out of range.
    """
    return check_threads(1 if threads is None and executor is not None else threads)


def run_job(job: Job, *, store: Store | None = None, number: int = 0, executor: Executor | None = None) -> SearchResult:
    """Run an order search and return its result; raise ModelError if no candidate has a finite score.

    `number` is the index of the search in the checkpoint file `store`. If the equations have nonlinear terms and the
    criterion is the output error, all candidates are ranked by equation error. Only the best of them are simulated and
    ranked by output error.
    """
    settings = job.settings
    if job.structure.has_nonlinear_terms and settings.criterion == "output-error":
        count = max(settings.top, FREE_RUN_CANDIDATES)
        preliminary_job = replace(job, settings=replace(settings, criterion="equation-error", top=count))
        ranked = run_job(preliminary_job, store=store, number=number, executor=executor)
        table = rank_by_simulation(ranked.table, job.structure, job.records, settings.norm, job.scales())
        counts = {"candidates": ranked.candidates, "kept": min(settings.top, len(table)), **ranked.exclusion_counts}
        counts["diverged"] += len(ranked.table) - len(table)
        counts["beaten"] += len(table) - counts["kept"]
        totals = cast("_core._Counts", counts)
        result = _result(job, table[: settings.top], ranked.failures, totals, ranked.excluded_by_box)
        return replace(result, simulated_candidates=len(ranked.table))
    execution = Execution(store, number, executor, job.progress)
    if job.structure.has_order_law:
        found_stage = search_coupled(job.coupled_problem(), execution)
        return _result(job, *_stage_rows(job.structure, found_stage), found_stage["counts"], 0)
    try:
        found = search_equation(job.equation_problem(), execution)
    except ModelError as error:
        raise error_with_signal_names(error, job.records[0].signals) from None
    return _result(job, *_equation_rows(job.structure, found), found["counts"], found["boxed"])


def _equation_rows(structure: Structure, found: _core._Found) -> tuple[list[SearchRow], Failures]:
    """Return (table rows, failures) of the search of one equation from the result of the Rust core.

    Orders and coefficients have names. A failure is (orders by name, reason).
    """
    equation = structure.equations[0]

    def orders_by_name(alpha: float, orders: list[float]) -> dict[str, float]:
        return {o.names[0]: v for o, v in zip(equation.orders, (alpha, *orders), strict=True) if o.names}

    table = [
        SearchRow(
            rank,
            row["index"],
            row["score"],
            orders_by_name(row["alpha"], row["orders"]),
            named_coefficients(equation, row["coefficients"]),
        )
        for rank, row in enumerate(found["rows"], 1)
    ]
    return table, [(orders_by_name(alpha, orders), str(reason)) for _, alpha, orders, reason in found["failures"]]


def _stage_rows(structure: Structure, found: _core._FoundStage) -> tuple[list[SearchRow], Failures]:
    """Return (table rows, failures) of the search of coupled equations from the result of the Rust core.

    Free orders and coefficients have names. A failure is (free orders by name, reason).
    """
    names, table = structure.order_names, []
    for rank, (index, score, free, equation_results) in enumerate(found["rows"], 1):
        coefficients: dict[str, float] = {}
        for equation, (_, _, _, c, _) in zip(structure.equations, equation_results, strict=True):
            coefficients |= named_coefficients(equation, c)
        table.append(SearchRow(rank, index, score, dict(zip(names, free, strict=True)), coefficients))
    return table, [(dict(zip(names, free, strict=True)), str(reason)) for _, free, reason in found["failures"]]


def _result(job: Job, table: list[SearchRow], failures: Failures, counts: _core._Counts, boxed: int) -> SearchResult:
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
    # The highest order 2 is the physical one, so a limit of 2 needs no finding.
    highest = {n for e in structure.equations for n in e.order.names}
    edges = {n: v for n, v in edges.items() if not (v == 2.0 and n in highest)}
    pruned = {k: cast("int", v) for k, v in counts.items() if k not in ("candidates", "kept")}
    return SearchResult(table, model, counts["candidates"], pruned, failures, m, settings.to_dict(), edges, boxed)


def rank_orders(
    runs: Run | Sequence[Run],
    equation: Structure,
    order_grid: OrderGrid | None = None,
    *,
    m: int | None = None,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    store: str | os.PathLike[str] | None = None,
    executor: Executor | None = None,
    **settings: Any,
) -> SearchResult:
    """Run an order search and return its result without a verdict.

    Arguments are those of :func:`ftlm.search_orders`. Raise ModelError or DataError if an argument is invalid.
    """
    search_settings = SearchSettings(**settings)
    check_executor(executor)
    job = make_job(
        runs, equation, order_grid, search_settings, m=m, threads=threads_per_task(threads, executor), progress=progress
    )
    if store is None:
        return run_job(job, executor=executor)
    with Store(store, [job.request(job.name)]) as open_store:
        return run_job(job, store=open_store, executor=executor)


def make_job(
    runs: Run | Sequence[Run],
    equation: Structure,
    order_grid: OrderGrid | None,
    settings: SearchSettings,
    *,
    m: int | None = None,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Job:
    """Validate the arguments of an order search, and return it as a job; arguments as for :func:`ftlm.search_orders`.

    Raise ModelError or DataError if an argument is invalid.
    """
    checked, workers = as_runs(runs), check_threads(threads)
    equation = as_structure("equation", equation)
    if not equation.order_names:
        raise ModelError("every order is a number, so there is nothing to search; name one, as in D^alpha y")
    check_frictionless(equation.equations, "an order search")
    if settings.coefficients == "instrumental-variables":
        check_linear(equation.equations, "an instrument")
    if len(equation.equations) > 1 and not equation.has_order_law:
        raise ModelError(
            "the equations share no order law, so they are searched one by one: "
            f"pass .equation({equation.outputs[0]!r}) or use identify"
        )
    check_order_grid(order_grid)
    values = (order_grid or OrderGrid()).values(equation)
    order_values = {n: v[0] for n, v in values.items() if len(v) == 1}
    for run in checked:
        check_derivative_orders(run, equation, order_values)
    records = prepare(checked, equation, m, power_of_two=settings.needs_haar)
    units = {n: u for n, u in checked[0].units.items() if n in equation.signals}
    names = tuple(r.name for r in checked)
    return Job(names, units, equation, values, records, settings, workers, _core_callback(progress))


def resume_search(
    path: str | os.PathLike[str],
    *,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    executor: Executor | None = None,
    recover: bool = False,
) -> dict[str, SearchResult]:
    """Resume the order searches of a checkpoint file, which contains their data and settings.

    Parameters
    ----------
    path
        Checkpoint file that :func:`search_orders` wrote with ``store=``.
    threads, progress, executor
        As for :func:`search_orders`.
    recover
        Whether to resume from a damaged file. The records before the damage are kept, and the rest is computed again.
        The damaged file is renamed to ``….damaged``.

    Returns
    -------
    dict of SearchResult
        Results by output name, or under ``"stage"`` for a search under an order law. They equal the results of
        uninterrupted searches bit for bit. A completed search is read from the file and not repeated.

    Raises
    ------
    DataError
        If the file is not a checkpoint file, is in use or cannot be written, or is damaged and `recover` is False.
    ModelError
        If `threads` is out of range.
    ConvergenceError
        If the executor has lost its workers.
    KeyboardInterrupt
        On Ctrl-C, within half a second. The checkpoint file can be resumed.
    """
    with Store(path, recover=recover) as store:
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
    """Resume the search with index `number` in a checkpoint file, and return its result.

    Raise DataError if the stored search is invalid.
    """
    check_executor(executor)
    job = replace(job_of(store, number, threads_per_task(threads, executor)), progress=_core_callback(progress))
    with _convert_model_errors(store.path, store.contents.requests[number]):
        return run_job(job, store=store, number=number, executor=executor)


def job_of(store: Store, number: int, threads: int | None) -> Job:
    """Return the search with index `number` in a checkpoint file; raise DataError if it is invalid."""
    request = store.contents.requests[number]
    with _convert_model_errors(store.path, request):
        return Job.of(request, check_threads(threads), None)


@contextlib.contextmanager
def _convert_model_errors(path: str | os.PathLike[str], request: Request) -> Iterator[None]:
    """Convert a ModelError within a ``with`` block to a DataError that names the search and the checkpoint file."""
    try:
        yield
    except ModelError as error:
        raise DataError(
            f"{path} contains no usable search of {request.name}: {error}; start it again in another file"
        ) from error


@check_arguments
def search_status(path: str | os.PathLike[str]) -> dict[str, StoreStatus]:
    """Return the progress of every search in a checkpoint file, which another process may be writing.

    For an unfinished search under an order law, bounds are computed again, which takes seconds for a fine grid.

    Parameters
    ----------
    path
        Checkpoint file that :func:`ftlm.search_orders` wrote with ``store=``.

    Returns
    -------
    dict of StoreStatus
        Status by output name, or under ``"stage"`` for a search under an order law.

    Raises
    ------
    DataError
        If the file is not a checkpoint file, or one of its searches is invalid.
    """
    contents = read_store(path)
    states = {}
    for request, section in zip(contents.requests, contents.sections, strict=True):
        with _convert_model_errors(path, request):
            job = Job.of(request, 1, None)
            if section.law:
                candidates, best = coupled_state(job.coupled_problem(), section)
            else:
                candidates, best = equation_state(job.equation_problem(), section)
        states[request.name] = StoreStatus(
            request.name,
            candidates,
            section.processed_count,
            best,
            job.settings.to_dict(),
            request.runs,
            contents.version,
            contents.corruption,
        )
    return states


def _core_callback(progress: Callable[[int, int], None] | None) -> ProgressCallback | None:
    """Return a progress callback with the arguments that the Rust core passes: (done, total, stopped early).

    All three are numbers of candidates. A progress bar receives all of them, any other callable only (done, total).
    """
    if progress is None or isinstance(progress, Progress):
        return progress
    return lambda count, total, _pruned: progress(count, total)


@check_arguments
def landscape(
    runs: Run | Sequence[Run],
    structure: Structure,
    search: SearchResult,
    order_grid: OrderGrid | None = None,
    *,
    orders: tuple[str, str] | None = None,
    threads: int | None = None,
) -> Landscape:
    """Compute the score of an order search over two orders, with the other orders as in the best model.

    Parameters
    ----------
    runs, structure, order_grid
        Arguments of the order search.
    search
        Result of the order search.
    orders
        Names of the two orders; by default the first two free orders with several values in the order grid.
    threads
        Number of threads; see :func:`ftlm.search_orders`.

    Returns
    -------
    Landscape
        Score at each pair of grid values; infinite at pairs without a finite score.

    Raises
    ------
    ModelError
        If fewer than two orders have several grid values, or `orders` contains another name or the same name twice.
    """
    axes = {n: v for n, v in (order_grid or OrderGrid()).values(structure).items() if len(v) > 1}
    best = search.orders
    names = orders or tuple(list(axes)[:2])
    if len(names) != 2 or names[0] == names[1] or any(n not in axes for n in names):
        free = ", ".join(axes) or "none"
        raise ModelError(f"a landscape needs two different orders with several values each; this order grid has {free}")
    x, y = (np.array(axes[n]) for n in names)
    fixed = structure.with_orders({n: v for n, v in best.items() if n not in names})
    table = rank_orders(
        runs,
        fixed,
        OrderGrid(orders={names[0]: x.tolist(), names[1]: y.tolist()}),
        m=search.m,
        top=x.size * y.size,
        threads=threads,
        **search.settings,
    ).table
    scores = np.full((y.size, x.size), np.inf)
    columns = np.array([r.orders[names[0]] for r in table])
    rows = np.array([r.orders[names[1]] for r in table])
    values = np.array([r.score for r in table])
    scores[np.abs(y[:, None] - rows).argmin(axis=0), np.abs(x[:, None] - columns).argmin(axis=0)] = values
    return Landscape((names[0], names[1]), x, y, scores)


def score_profiles(
    runs: Sequence[Run], structure: Structure, search: SearchResult, order_grid: OrderGrid
) -> list[LineChart]:
    """Return a chart of the score over each order with several grid values, with the other orders as in rank 1."""
    charts = []
    best = search.orders
    score = "sum of absolute errors" if search.settings["norm"] == "l1" else "RMSE"
    for name, values in order_grid.values(structure).items():
        if len(values) < 2:
            continue
        fixed = structure.with_orders({n: v for n, v in best.items() if n != name})
        grid = OrderGrid(orders={name: list(values)})
        rows = rank_orders(runs, fixed, grid, m=search.m, top=len(values), **search.settings).table
        x, scores = np.array(values), np.full(len(values), math.nan)
        for row in rows:
            scores[np.abs(x - row.orders[name]).argmin()] = row.score
        minimum_scores = np.where(x == x[np.abs(x - best[name]).argmin()], scores, math.nan)
        charts.append(
            LineChart(
                x,
                [("score", scores), ("rank 1", minimum_scores)],
                title=f"Score over {symbol(name)}",
                x_label=f"order {symbol(name)}",
                y_label="score" if len(structure.equations) > 1 else score,
                dots=("rank 1",),
                caption="Other orders as in the best model." if len(best) > 1 else "",
                width=SMALL_WIDTH_PX,
            )
        )
    return charts


#: Subsampling factors of the order grid, coarsest first, for searches whose measured time is extrapolated.
SUBSAMPLING_FACTORS = (16, 12, 10, 8, 6, 5, 4, 3, 2)
#: Maximum fraction of all candidates in such a search, and time [s] from which its measurement is long enough.
MAX_PROBE_FRACTION, PROBE_TIME_S = 1 / 12, 0.3
#: Range of the exponent e in time ~ candidates^e. It is often below 1, because finer grids exclude more candidates.
TIME_EXPONENT_RANGE = (0.7, 1.1)
#: Range of the ratio of the actual to the extrapolated computing time.
TIME_FACTOR_RANGE = (0.6, 4.0)
#: Minimum number of candidates with which whole boxes may be excluded, and exponent of time over candidates above it.
#: Searches on coarse grids do not show this effect.
BOX_EXCLUSION_CANDIDATES, BOX_TIME_EXPONENT = 1 << 25, 0.5


def announce_time(progress: object, jobs: Sequence[Job], store: Store | None = None) -> None:
    """Show the expected time of several order searches on a progress bar; other callables show nothing.

    With a checkpoint file, the time is that of the remaining work.
    """
    if not isinstance(progress, Progress) or progress.quiet:
        return
    lower_total = upper_total = 0.0
    for number, job in enumerate(jobs):
        fraction = 1.0 if store is None else _remaining_fraction(job, store, number)
        low, high = expected_seconds(job) if fraction > 0 else (0.0, 0.0)
        lower_total, upper_total = lower_total + fraction * low, upper_total + fraction * high
    progress.announce("the search", lower_total, upper_total)


def expected_seconds(job: Job, clock: Callable[[], float] = time.perf_counter) -> tuple[float, float]:
    """Return (lower, upper) estimates of the time of a search on this machine [s]; (0, 0) for a small grid.

    The time is extrapolated from searches on finer and finer subsets of the grid, each with at most the fraction
    `MAX_PROBE_FRACTION` of all candidates. The last of these searches is the first that takes `PROBE_TIME_S` seconds.
    """
    candidate_count = _candidates(job)
    trials: list[tuple[float, float]] = []
    for factor in SUBSAMPLING_FACTORS:
        subsampled_job = replace(job, values={name: axis[::factor] for name, axis in job.values.items()}, progress=None)
        try:
            count = _candidates(subsampled_job)
            if trials and count <= trials[-1][0]:
                continue
            if count > MAX_PROBE_FRACTION * candidate_count:
                break
            start_time = clock()
            (
                subsampled_job.coupled_problem() if job.structure.has_order_law else subsampled_job.equation_problem()
            ).search(None)
        except FtlmError:
            # A grid this coarse may have no candidate, or none with a finite score.
            continue
        trials.append((count, clock() - start_time))
        if trials[-1][1] >= PROBE_TIME_S:
            break
    if not trials:
        return 0.0, 0.0
    (count, elapsed), power = trials[-1], TIME_EXPONENT_RANGE[1]
    if len(trials) > 1 and trials[-2][1] > 0:
        power = math.log(max(elapsed / trials[-2][1], 1e-9)) / math.log(count / trials[-2][0])
        power = min(max(power, TIME_EXPONENT_RANGE[0]), TIME_EXPONENT_RANGE[1])
    extrapolated = elapsed * (candidate_count / count) ** power
    boxed = (
        extrapolated
        if candidate_count < BOX_EXCLUSION_CANDIDATES
        else elapsed
        * (BOX_EXCLUSION_CANDIDATES / count) ** power
        * (candidate_count / BOX_EXCLUSION_CANDIDATES) ** BOX_TIME_EXPONENT
    )
    return TIME_FACTOR_RANGE[0] * boxed, TIME_FACTOR_RANGE[1] * extrapolated


def _candidates(job: Job) -> float:
    """Return the number of candidates of a search; under an order law, the number of points of the order grid."""
    if job.structure.has_order_law:
        return float(math.prod(len(axis) for axis in job.values.values()))
    return float(job.equation_problem().plan()[0])


def _remaining_fraction(job: Job, store: Store, number: int) -> float:
    """Return the fraction (0 to 1) of a search's candidates that a checkpoint file does not contain.

    Under an order law, the fraction is 1 until the search is complete, and 0 afterwards. `number` is the index of the
    search in the file.
    """
    section = store.contents.sections[number]
    if job.structure.has_order_law:
        return 0.0 if section.table is not None else 1.0
    return 1.0 - min(section.processed_count / _candidates(job), 1.0)
