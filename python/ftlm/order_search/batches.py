"""Batches of an order search: evaluation in this process or on an executor, and checkpoints.

A batch consists of candidates in a search of coupled equations, and of rounds in a search of one equation. A round is a
fixed group of candidates that the core evaluates together.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import threading
import time
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Generic, TypeVar, cast

import msgspec
import numpy as np

from ftlm import _core
from ftlm.errors import ConvergenceError, FtlmError, ModelError
from ftlm.order_search.checkpoint import (
    Checkpoint,
    CoupledTable,
    Outcomes,
    Part,
    Rounds,
    Section,
    Span,
    Store,
    Verdicts,
    finished_count,
)
from ftlm.order_search.options import SearchSettings
from ftlm.simulation.discretization import InitialTuple
from ftlm.utils.parameters import parameter
from ftlm.utils.resources import run_in_worker
from ftlm.utils.validation import Floats

#: Maximum number of search evaluators that a worker caches.
MAX_CACHED_SEARCHES = 2
Table = TypeVar("Table")
Piece = TypeVar("Piece")
CoreRecord = tuple[float, Floats, Floats | None]
ProgressCallback = Callable[[int, int, int], None]


@dataclass(frozen=True)
class SearchProblem(ABC):
    """Data shared by all batches of an order search, and the functions of the Rust core that evaluate candidates.

    `runs` are the block-pulse records as (pulse width [s], means, series of the sensor filter or None). `inputs` states
    for each signal whether it is an input.
    """

    runs: tuple[CoreRecord, ...]
    inputs: list[bool]
    initial: InitialTuple
    settings: SearchSettings
    threads: int

    @property
    @abstractmethod
    def core_arguments(self) -> tuple[Any, ...]:
        """Arguments of the search functions of the Rust core that follow the block-pulse records."""

    def core(self, *extra: Any) -> tuple[Any, ...]:
        """Return the arguments of a search function of the Rust core: records, `core_arguments`, and then `extra`."""
        return list(self.runs), *self.core_arguments, *extra

    @abstractmethod
    def build_evaluator(self) -> _core.OrderSearch | _core.StageSearch:
        """Return an object of the Rust core that evaluates blocks of candidates; one serves all blocks of a search."""

    @cached_property
    def key(self) -> str:
        """Hexadecimal digest of records and arguments, which identifies the search in the cache of a worker process."""
        digest = hashlib.blake2b(digest_size=16)
        for step, means, sensor in self.runs:
            digest.update(msgspec.msgpack.encode((step, means.shape, sensor is None)))
            digest.update(np.ascontiguousarray(means).tobytes())
            digest.update(b"" if sensor is None else np.ascontiguousarray(sensor).tobytes())
        digest.update(msgspec.msgpack.encode(self.core_arguments))
        return digest.hexdigest()


@dataclass(frozen=True)
class EquationProblem(SearchProblem):
    """Order search of one equation, in the form that the Rust core takes.

    `orders` is (output index, grid values of alpha, terms). A term is (signal index, grid values of its order, whether
    coefficient and order are free). `fixed` is the fixed coefficient of each term, or None if it is estimated.
    """

    orders: tuple[int, list[float], list[tuple[int, list[float], bool]]]
    fixed: list[float | None]

    @property
    def core_arguments(self) -> tuple[Any, ...]:
        """Arguments of the search functions of the Rust core that follow the block-pulse records."""
        return self.orders, self.inputs, self.fixed, self.initial, self.settings.core_arguments(self.threads)

    def search(self, progress: ProgressCallback | None) -> _core._Found:
        """Run the whole search in this process, and return its result table."""
        return _core.search(*self.core(progress))

    def build_evaluator(self) -> _core.OrderSearch:
        """Return an object of the Rust core that evaluates candidates of one equation; one serves the whole search."""
        return _core.OrderSearch(*self.core())

    def plan(self) -> tuple[int, list[int]]:
        """Return the number of candidates, and the exclusive end of each batch, counted in rounds.

        A round is a fixed group of candidates that are evaluated together.
        """
        return _core.search_plan(self.orders, self.inputs, self.initial, self.settings.core_arguments(self.threads))

    @property
    def samples(self) -> int:
        """Total number of block pulses of all records."""
        return sum(int(means.shape[1]) for _, means, _ in self.runs)

    def join(self, parts: list[Part]) -> _core._Found:
        """Return the result table of the search, joined from the partial results of all its blocks."""
        settings = self.settings.core_arguments(self.threads)
        return _core.search_join(self.orders, self.inputs, self.initial, settings, self.samples, parts)


@dataclass(frozen=True)
class CoupledProblem(SearchProblem):
    """Order search of coupled equations under an order law, in the form that the Rust core takes.

    `axes` are the grid values of each free order. `laws` and `fixed` have one entry per equation. An entry of `laws` is
    (output index, law of alpha, terms), and a term is (signal index, law of its order). A law is (constant, weight of
    each free order). An entry of `fixed` is a list with the given coefficient of each term, None for an estimated one.
    `scales` are the numbers by which the scores of the equations are divided.
    """

    axes: list[list[float]]
    laws: list[tuple[int, tuple[float, list[float]], list[tuple[int, tuple[float, list[float]]]]]]
    fixed: list[list[float | None]]
    scales: list[float]

    @property
    def core_arguments(self) -> tuple[Any, ...]:
        """Arguments of the search functions of the Rust core that follow the block-pulse records."""
        return (
            self.axes,
            self.laws,
            self.inputs,
            self.fixed,
            self.scales,
            self.initial,
            self.settings.core_arguments(self.threads),
        )

    def search(self, progress: ProgressCallback | None) -> _core._FoundStage:
        """Run the whole search in this process, and return its result table."""
        return _core.search_stage(*self.core(progress))

    def build_evaluator(self, *, keeps_state: bool = False) -> _core.StageSearch:
        """Return an object of the Rust core that evaluates candidates.

        With `keeps_state` it also stores the search state and collects the results.
        """
        return _core.StageSearch(*self.core(keeps_state))


_cached_searches: OrderedDict[str, _core.OrderSearch | _core.StageSearch] = OrderedDict()
_lock = threading.Lock()


def _new_lock() -> None:
    """Replace the lock after a fork, because another thread may have held it in the parent process."""
    global _lock  # noqa: PLW0603
    _lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_new_lock)


def evaluate_rounds(
    key: str,
    work: EquationProblem | None,
    first: int,
    last: int,
    seed: list[tuple[int, float]],
    start: Any,
    threads: int,
) -> tuple[float, Part] | None:
    """Evaluate rounds (groups of candidates) `first` to `last` - 1 of one equation in a worker process.

    `work` is the search problem, or None if the worker should have cached it under `key`. `seed` is (index, score) of
    each row found in earlier batches, and `start` is a checkpoint to resume from, or None. Return (computing time [s],
    partial result), or None if neither `work` nor the cache gives the problem.
    """
    return _run_cached(
        key, work, lambda search: cast("Part", search.evaluate_batches(first, last, seed, start, threads, None, None))
    )


def evaluate_candidates(
    key: str, work: CoupledProblem | None, spans: list[Span], threads: int
) -> tuple[float, Outcomes] | None:
    """Evaluate candidates of a coupled search in a worker process.

    `work` is the search problem, or None if the worker should have cached it under `key`. `spans` are blocks of
    candidates: (equation, first, exclusive end, limit of the score). Return (computing time [s], outcomes), or None if
    neither `work` nor the cache gives the problem.
    """
    return _run_cached(key, work, lambda search: cast("Outcomes", search.evaluate_spans(spans, threads, None)))


def _run_cached(key: str, work: SearchProblem | None, do: Callable[[Any], Piece]) -> tuple[float, Piece] | None:
    with _lock:
        search = _cached_searches.get(key) or (None if work is None else work.build_evaluator())
        if search is None:
            return None
        _cached_searches[key] = search
        _cached_searches.move_to_end(key)
        while len(_cached_searches) > MAX_CACHED_SEARCHES:
            _cached_searches.popitem(last=False)
    start_time = time.monotonic()
    result = do(search)
    return time.monotonic() - start_time, result


#: Target duration of a task: long compared with its transfer, and short enough that a lost task costs little.
TASK_DURATION_S = 2.0
#: Number of tasks submitted per worker; more than one, so that no worker waits for work.
TASKS_PER_WORKER = 2
#: Number of failed attempts at one task after which the search fails.
MAX_ATTEMPTS = 3
#: Maximum duration of one wait for running tasks; Ctrl-C takes effect between two waits.
POLL_INTERVAL_S = 0.05


@dataclass
class CandidateBlock:
    """Contiguous block of work: rounds (groups of candidates) of one equation, or candidates of a coupled search.

    Parameters
    ----------
    first, last
        First index and exclusive end.
    start
        Checkpoint within the block from which the evaluation is resumed; None to begin at the start.
    with_problem
        Whether the search problem is sent with the task, because a worker has not cached it.
    attempts
        Number of failed attempts.
    """

    first: int
    last: int
    start: Checkpoint | None = None
    with_problem: bool = False
    attempts: int = 0


def worker_count(executor: Executor) -> int:
    """Return the number of tasks that an executor runs concurrently; the number of CPUs if it cannot be determined."""
    count = getattr(executor, "_max_workers", None)
    client = getattr(executor, "_client", None)
    if count is None and client is not None:
        with contextlib.suppress(Exception):
            count = sum(client.nthreads().values())
    return count if isinstance(count, int) and count > 0 else os.cpu_count() or 1


@dataclass
class Throughput:
    """Evaluation time per item as measured, which determines the number of items in a task.

    An item is a candidate of a coupled search, or a round (group of candidates) of one equation. The time is smoothed
    exponentially, and is 0 before the first measurement. A task has at least `min_count` items.
    """

    seconds_each: float = 0.0
    min_count: int = 1

    def count_for(self, seconds: float) -> int:
        """Return the number of items that take about `seconds`; `min_count` before the first measurement."""
        return self.min_count if self.seconds_each == 0 else max(self.min_count, int(seconds / self.seconds_each))

    def update(self, seconds: float, count: int) -> None:
        """Update the smoothed time per item from the time [s] that `count` items took."""
        seconds_each = max(seconds, 1e-9) / count
        self.seconds_each = seconds_each if self.seconds_each == 0 else 0.7 * self.seconds_each + 0.3 * seconds_each


def run_on_executor(
    send: Callable[[CandidateBlock], tuple[Any, ...]],
    blocks: list[CandidateBlock],
    executor: Executor,
    throughput: Throughput,
) -> Iterator[tuple[CandidateBlock, Any]]:
    """Evaluate blocks in tasks of about :data:`TASK_DURATION_S` seconds, and yield (block, result) pairs.

    `send` returns the function that evaluates a block, followed by its arguments. Raise ConvergenceError if the
    executor is broken, or if a task fails :data:`MAX_ATTEMPTS` times.
    """
    count = worker_count(executor)
    queue_size = TASKS_PER_WORKER * count + 2
    # A small batch is divided evenly among the workers.
    task_size = max(throughput.min_count, -(-sum(s.last - s.first for s in blocks) // count))
    pending: dict[Future[Any], CandidateBlock] = {}
    queue = blocks[::-1]
    try:
        while queue or pending:
            while queue and len(pending) < queue_size:
                block = queue.pop()
                task_count = min(throughput.count_for(TASK_DURATION_S), task_size)
                if block.start is None and block.attempts == 0 and block.last - block.first > task_count:
                    queue.append(CandidateBlock(block.first + task_count, block.last))
                    block = CandidateBlock(block.first, block.first + task_count)
                try:
                    pending[executor.submit(run_in_worker, *send(block))] = block
                except (BrokenExecutor, RuntimeError) as error:
                    raise _executor_error(error) from error
            finished, _ = wait(pending, timeout=POLL_INTERVAL_S, return_when=FIRST_COMPLETED)
            for future in finished:
                block = pending.pop(future)
                timed = _result(future, block)
                if timed is None:
                    queue.append(block)
                    continue
                seconds, result = timed
                throughput.update(seconds, block.last - block.first)
                yield block, result
    finally:
        for future in pending:
            future.cancel()


def _result(future: Future[Any], block: CandidateBlock) -> tuple[float, Any] | None:
    """Return (computing time [s], result) of a finished task, or None if the task must be submitted again.

    It must be submitted again after a failure, or if the worker had not cached the search problem. Raise
    ConvergenceError after :data:`MAX_ATTEMPTS` failures, or if the executor is broken.
    """
    try:
        timed = cast("tuple[float, Any] | None", future.result())
    except FtlmError:
        raise
    except BrokenExecutor as error:
        raise _executor_error(error) from error
    except (Exception, CancelledError) as error:
        block.attempts += 1
        if block.attempts >= MAX_ATTEMPTS:
            raise _executor_error(error) from error
        return None
    if timed is None and not block.with_problem:
        # The worker has not cached the search problem, so the next attempt sends it with the task.
        block.with_problem = True
        return None
    if not isinstance(timed, tuple) or len(timed) != 2:
        raise _executor_error(TypeError(f"a task returned {type(timed).__name__}"))
    return timed


def _executor_error(error: BaseException) -> ConvergenceError:
    return ConvergenceError(
        f"the executor lost its work ({type(error).__name__}: {error}); start a new one and search again: "
        f"with {parameter('store')} completed work is kept"
    )


#: Time of local evaluation between two checkpoint records of a coupled search. A crash loses about this much work.
CHECKPOINT_INTERVAL_S = 0.25
#: Minimum number of candidates in one task of a coupled search, and their number before the first time measurement.
MIN_BLOCK_CANDIDATES = 256
Frame = TypeVar("Frame", Rounds, Verdicts)
#: Callback (first, last, checkpoint) that stores the checkpoint of a block of rounds (groups of candidates).
Save = Callable[[int, int, Checkpoint | None], None]


class SearchState(ABC, Generic[Frame, Table]):
    """Order search in progress: current batch, and numbers of processed (`done`) and known (`total`) candidates.

    A batch is evaluated in blocks, in any sequence. Later batches use the results of earlier ones. `total` may increase
    from batch to batch.
    """

    #: Whether the core itself calls the progress callback during evaluation in this process.
    core_reports_progress = False

    def __init__(self, work: SearchProblem, throughput: Throughput) -> None:
        self.work, self.throughput = work, throughput
        self.threads = work.threads
        self.done = self.total = 0

    def payload(self, block: CandidateBlock) -> SearchProblem | None:
        """Return the search problem if it is sent with the task of a block; None if workers have it cached."""
        return self.work if block.with_problem else None

    @abstractmethod
    def batches(self) -> Iterator[tuple[int, int]]:
        """Yield (first index, exclusive end) of each batch, after the results of the previous batch are added."""

    @abstractmethod
    def evaluate_locally(
        self, blocks: list[CandidateBlock], progress: ProgressCallback | None, save: Save | None
    ) -> Iterator[tuple[CandidateBlock, Any]]:
        """Evaluate blocks in this process, and yield (block, result) pairs."""

    @abstractmethod
    def task(self, block: CandidateBlock) -> tuple[Any, ...]:
        """Return the function that evaluates a block in a worker process, followed by its arguments."""

    @abstractmethod
    def frame(self, number: int, block: CandidateBlock, piece: Any) -> Frame:
        """Return the checkpoint record with the result of a block; `number` is the index of the search in the file."""

    @abstractmethod
    def add_block(self, frame: Frame) -> int:
        """Add the result of a block to the current batch.

        Return the number of candidates whose evaluation was stopped before the complete score.
        """

    @abstractmethod
    def table(self) -> Table:
        """Return the result table of the search, after all batches are complete."""


class EquationSearchState(SearchState[Rounds, "_core._Found"]):
    """Order search of one equation in progress.

    Candidates are excluded if their scores exceed those of the best rows of earlier batches.
    """

    core_reports_progress = True
    work: EquationProblem

    def __init__(self, work: EquationProblem) -> None:
        super().__init__(work, Throughput())
        self.total, self._ends = work.plan()
        self._parts: list[Part] = []
        self._seed: list[tuple[int, float]] = []

    @cached_property
    def _search(self) -> _core.OrderSearch:
        return self.work.build_evaluator()

    def batches(self) -> Iterator[tuple[int, int]]:
        """Yield (first, exclusive end) of each batch, counted in rounds (groups of candidates).

        All rounds of a batch start from the same best rows. Later batches exclude more candidates, so the evaluation
        time per round is measured separately for each batch.
        """
        first, table_size = 0, self.work.settings.top
        for end in self._ends:
            ranked = sorted({(row[1], row[0]) for part in self._parts for row in part[0]})[:table_size]
            if len(ranked) == table_size:
                self._parts = [_drop_beaten_rows(ranked[-1], part) for part in self._parts]
            self._seed = [(index, score) for score, index in ranked]
            self.throughput = Throughput()
            yield first, end
            first = end

    def evaluate_locally(
        self, blocks: list[CandidateBlock], progress: ProgressCallback | None, save: Save | None
    ) -> Iterator[tuple[CandidateBlock, Part]]:
        """Evaluate each block in one call of the core, resumed from its checkpoint if any; yield (block, result)."""
        for block in blocks:
            first, last = block.first, block.last
            listener = None if progress is None else partial(self._report_progress, progress, self.done)
            saved = None if save is None else partial(save, first, last)
            part = self._search.evaluate_batches(first, last, self._seed, block.start, self.threads, listener, saved)
            yield block, cast("Part", part)

    def _report_progress(
        self, progress: ProgressCallback, count_before: int, count: int, _all: int, pruned: int
    ) -> None:
        progress(min(count_before + count, self.total), self.total, pruned)

    def task(self, block: CandidateBlock) -> tuple[Any, ...]:
        """Return the function that evaluates a block of this search in a worker process, followed by its arguments."""
        arguments = block.first, block.last, self._seed, block.start, self.threads
        return evaluate_rounds, self.work.key, self.payload(block), *arguments

    def frame(self, number: int, block: CandidateBlock, piece: Part) -> Rounds:
        """Return the checkpoint record with the partial result of a block of rounds (groups of candidates)."""
        return Rounds(number, block.first, block.last, piece)

    def add_block(self, frame: Rounds) -> int:
        """Add the result of a block to the current batch; return 0, because every candidate is completely evaluated."""
        self._parts.append(frame.part)
        self.done += finished_count(frame.part[1])
        return 0

    def table(self) -> _core._Found:
        """Return the result table of the search, joined from the partial results of all blocks."""
        return self.work.join(self._parts)


def _drop_beaten_rows(worst: tuple[float, int], part: Part) -> Part:
    """Return a partial result without rows that rank below `worst`, (score, index) of the last row of the table."""
    rows, counts, failures = part
    return tuple(row for row in rows if (row[1], row[0]) <= worst), counts, failures


class CoupledSearchState(SearchState[Verdicts, "_core._FoundStage"]):
    """Order search of coupled equations in progress; candidates of a batch depend on results of earlier batches."""

    work: CoupledProblem

    def __init__(self, work: CoupledProblem) -> None:
        super().__init__(work, Throughput(min_count=MIN_BLOCK_CANDIDATES))
        self.search = work.build_evaluator(keeps_state=True)
        self._first = 0
        self._spans: list[Span] = []
        self._batch_results: list[Verdicts] = []

    def batches(self) -> Iterator[tuple[int, int]]:
        """Yield (first, exclusive end) of each batch of candidates, numbered consecutively through all batches."""
        while spans := self.search.pending_spans():
            end = self._first + sum(last - first for _, first, last, _ in spans)
            self._spans, self._batch_results = spans, []
            self.total, _ = self.search.state()
            yield self._first, end
            self.search.record_outcomes(*_join_verdicts(self._batch_results, self._first, end), self.threads)
            self._first = end
        self.total = self._first

    def evaluate_locally(
        self, blocks: list[CandidateBlock], progress: ProgressCallback | None, save: Save | None
    ) -> Iterator[tuple[CandidateBlock, Outcomes]]:
        """Evaluate blocks in parts of about :data:`CHECKPOINT_INTERVAL_S` seconds; yield (part, result) pairs."""
        for block in blocks:
            at = block.first
            while at < block.last:
                sub_block = CandidateBlock(at, min(block.last, at + self.throughput.count_for(CHECKPOINT_INTERVAL_S)))
                start_time = time.monotonic()
                outcomes = self.search.evaluate_spans(self._candidate_spans(sub_block), self.threads, None)
                self.throughput.update(time.monotonic() - start_time, sub_block.last - sub_block.first)
                yield sub_block, outcomes
                at = sub_block.last

    def task(self, block: CandidateBlock) -> tuple[Any, ...]:
        """Return the function that evaluates a block of candidates in a worker process, followed by its arguments."""
        return evaluate_candidates, self.work.key, self.payload(block), self._candidate_spans(block), self.threads

    def _candidate_spans(self, block: CandidateBlock) -> list[Span]:
        """Return the candidates of a block as spans (equation, first index, exclusive end, limit of the score).

        Indices in a span count the candidates of its equation. Indices of a block count the candidates of all spans of
        all batches consecutively.
        """
        spans, at = [], self._first
        for equation, start, end, limit in self._spans:
            low, high = max(block.first - at, 0), min(block.last - at, end - start)
            if low < high:
                spans.append((equation, start + low, start + high, limit))
            at += end - start
        return spans

    def frame(self, number: int, block: CandidateBlock, piece: Outcomes) -> Verdicts:
        """Return the checkpoint record with the outcomes of a block of candidates."""
        return Verdicts(number, block.first, block.last, *piece)

    def add_block(self, frame: Verdicts) -> int:
        """Add the result of a block to the current batch.

        Return the number of candidates with only a lower bound or a partial sum of the score.
        """
        self._batch_results.append(frame)
        self.done += len(frame.kinds)
        return frame.kinds.count(1) + frame.kinds.count(2)

    def table(self) -> _core._FoundStage:
        """Return the result table of the search, whose rows combine all equations under the order law."""
        return self.search.outcome()


def _join_verdicts(batch: list[Verdicts], first: int, end: int) -> Outcomes:
    """Return (values, kinds) of all candidates of a batch in sequence.

    Raise ModelError if the blocks do not cover candidates `first` to `end` - 1.
    """
    at, values, kinds = first, [], []
    for verdicts in sorted(batch, key=lambda v: v.first):
        if verdicts.first != at:
            break
        at = verdicts.last
        values.append(verdicts.values)
        kinds.append(verdicts.kinds)
    if at != end:
        raise ModelError(f"candidates {first} to {end} are divided into other blocks")
    return b"".join(values), b"".join(kinds)


@dataclass(frozen=True)
class Execution:
    """Execution options of a search: checkpoint file, index of the search in the file, executor, progress callback.

    Without file and executor, a search is one call of the core. Otherwise it is evaluated in batches.
    """

    store: Store | None
    number: int
    executor: Executor | None
    progress: ProgressCallback | None

    @property
    def section(self) -> Section | None:
        """Content of the checkpoint file that belongs to this search; None without a file."""
        return None if self.store is None else self.store.contents.sections[self.number]


def search_equation(work: EquationProblem, execution: Execution) -> _core._Found:
    """Run the order search of one equation, and return its result table."""
    if execution.store is None and execution.executor is None:
        return work.search(execution.progress)
    return _run_batches(EquationSearchState(work), execution)


def search_coupled(work: CoupledProblem, execution: Execution) -> _core._FoundStage:
    """Run the order search of coupled equations, and return its result table.

    The table of a finished search is read from the checkpoint file.
    """
    store, section = execution.store, execution.section
    if store is None and execution.executor is None:
        return work.search(execution.progress)
    if section is not None and section.table is not None:
        return _table(work, section.table)
    table = _run_batches(CoupledSearchState(work), execution)
    if store is not None:
        store.append_table(execution.number, table)
    return table


def _run_batches(state: SearchState[Frame, Table], execution: Execution) -> Table:
    """Evaluate all blocks that the checkpoint file does not contain, batch by batch, and return the result table.

    Raise ModelError if the file contains candidates of another search.
    """
    store, search_index, section = execution.store, execution.number, execution.section
    executor, progress = execution.executor, execution.progress
    save = None if store is None else partial(store.save, search_index)
    pruned = 0
    for first, end in state.batches():
        for stored_frame in _stored_frames(section, first, end):
            state.add_block(stored_frame)
        blocks = list(_pending_blocks(section, first, end))
        if executor is None:
            results = state.evaluate_locally(blocks, progress, save)
        else:
            results = run_on_executor(state.task, blocks, executor, state.throughput)
        for block, result in results:
            frame = state.frame(search_index, block, result)
            if store is not None:
                store.append_block(frame)
            pruned += state.add_block(frame)
            if progress is not None and not (state.core_reports_progress and executor is None):
                progress(state.done, state.total, pruned)
    if section is not None and section.law and section.processed_count != state.total:
        raise ModelError(f"the search has {section.processed_count} of {state.total} candidates")
    if progress is not None:
        progress(state.total, state.total, 0)
    return state.table()


def equation_state(work: EquationProblem, section: Section) -> tuple[int, float | None]:
    """Return (number of candidates, best score in the checkpoint file) of the search of one equation.

    The score is None if the file contains none.
    """
    best_score = section.best
    if best_score is not None and work.settings.norm == "l2":
        best_score = math.sqrt(max(best_score, 0.0) / work.samples)
    return work.plan()[0], best_score


def coupled_state(work: CoupledProblem, section: Section) -> tuple[int, float | None]:
    """Return (number of candidates, best score) of a coupled search, as far as the checkpoint file determines them.

    The score is None before the first one.
    """
    if section.table is not None:
        return section.processed_count, _table(work, section.table)["rows"][0][1]
    state = CoupledSearchState(work)
    for first, end in state.batches():
        for frame in _stored_frames(section, first, end):
            state.add_block(frame)
        if any(_pending_blocks(section, first, end)):
            break
    return state.search.state()


def _table(work: CoupledProblem, joined: CoupledTable) -> _core._FoundStage:
    """Return the table of a finished search from its checkpoint record, in the form that the Rust core returns.

    Raise ModelError if sizes or counts of the table do not match the search.
    """
    coefficient_counts = [len(terms) for _, _, terms in work.laws]
    accounted = sum(v for k, v in joined.counts.items() if k != "candidates")
    is_valid = (
        set(joined.counts) == {"candidates", "kept", "beaten", "bound", "stopped early", "singular", "diverged"}
        and accounted == joined.counts["candidates"]
        and 0 < len(joined.rows) == joined.counts["kept"] <= work.settings.top
        and all(len(free) == len(work.axes) for _, free, _ in joined.failures)
        and all(len(free) == len(work.axes) for _, _, free, _ in joined.rows)
        and all([len(p[3]) for p in parts] == coefficient_counts for _, _, _, parts in joined.rows)
    )
    if not is_valid:
        raise ModelError("the stored table belongs to another search")
    table = msgspec.to_builtins({"rows": joined.rows, "counts": joined.counts, "failures": joined.failures})
    return cast("_core._FoundStage", {**table, "distinct": []})


def _stored_frames(section: Section | None, first: int, end: int) -> list[Any]:
    """Return the checkpoint records of complete blocks that start in the batch from `first` to `end` - 1."""
    return [] if section is None else [frame for at, frame in section.frames.items() if first <= at < end]


def _pending_blocks(section: Section | None, first: int, end: int) -> Iterator[CandidateBlock]:
    """Yield the blocks of a batch from `first` to `end` - 1 that remain to be evaluated.

    They are the partly evaluated blocks, which are resumed from checkpoints, and the gaps between stored blocks.
    """
    blocks: list[CandidateBlock] = []
    if section is not None:
        blocks = [CandidateBlock(at, frame.last) for at, frame in section.frames.items()]
        blocks += [CandidateBlock(at, half.last, half.checkpoint) for at, half in section.open.items()]
    at = first
    for block in sorted(blocks, key=lambda s: s.first):
        if not first <= block.first < end:
            continue
        if at < block.first:
            yield CandidateBlock(at, block.first)
        if block.start is not None:
            yield block
        at = block.last
    if at < end:
        yield CandidateBlock(at, end)
