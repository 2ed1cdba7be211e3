"""What a search is computed from, as the core takes it, here and in a worker."""

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
from ftlm.order_search.checkpoint import Checkpoint, Joined, Outcomes, Part, Rounds, Section, Span, Store, Verdicts
from ftlm.order_search.options import Settings
from ftlm.simulation.discretization import InitialTuple
from ftlm.utils.validation import Floats

#: Searches that a worker keeps ready.
READY = 2
Table = TypeVar("Table")
Piece = TypeVar("Piece")
CoreRecord = tuple[float, Floats, Floats | None]
Told = Callable[[int, int, int], None]


@dataclass(frozen=True)
class Work(ABC, Generic[Table]):
    """What every round of a search is computed from, and the table it ends in."""

    runs: tuple[CoreRecord, ...]
    inputs: list[bool]
    initial: InitialTuple
    settings: Settings

    @property
    @abstractmethod
    def asked(self) -> tuple[Any, ...]:
        """What the core takes behind the runs."""

    def core(self, *more: Any) -> tuple[Any, ...]:
        """All of it, and more, as the core takes it."""
        return list(self.runs), *self.asked, *more

    @abstractmethod
    def search(self, progress: Told | None) -> Table:
        """Search here and at once."""

    @abstractmethod
    def ready(self) -> _core.OrderSearch | _core.StageSearch:
        """Build what all pieces of the search share."""

    @property
    def key(self) -> str:
        """Digest that names the search among workers."""
        digest = hashlib.blake2b(digest_size=16)
        for step, means, sensor in self.runs:
            digest.update(msgspec.msgpack.encode((step, means.shape, sensor is None)))
            digest.update(np.ascontiguousarray(means).tobytes())
            digest.update(b"" if sensor is None else np.ascontiguousarray(sensor).tobytes())
        digest.update(msgspec.msgpack.encode(self.asked))
        return digest.hexdigest()


@dataclass(frozen=True)
class EquationWork(Work["_core._Found"]):
    """The search of one equation: output, values of its highest order, and signal, values and freedom of each term."""

    orders: tuple[int, list[float], list[tuple[int, list[float], bool]]]
    fixed: list[float | None]

    @property
    def asked(self) -> tuple[Any, ...]:
        """What the core takes behind the runs."""
        return self.orders, self.inputs, self.fixed, self.initial, self.settings.core()

    def search(self, progress: Told | None) -> _core._Found:
        """Search here and at once."""
        return _core.search(*self.core(progress))

    def ready(self) -> _core.OrderSearch:
        """Build what all rounds share."""
        return _core.OrderSearch(*self.core())

    def plan(self, algorithm: int | None = None) -> tuple[int, list[int], int]:
        """Candidates, where each wave of rounds ends by this or an earlier algorithm, and the number of this one."""
        return _core.search_plan(self.orders, self.inputs, self.initial, self.settings.core(), algorithm)

    @property
    def samples(self) -> int:
        """Pulses of all records."""
        return sum(int(means.shape[1]) for _, means, _ in self.runs)

    def join(self, parts: list[Part]) -> _core._Found:
        """Join the parts of all rounds."""
        settings = self.settings.core()
        return _core.search_join(self.orders, self.inputs, self.initial, settings, self.samples, parts)


@dataclass(frozen=True)
class StageWork(Work["_core._FoundStage"]):
    """The search of a stage: values of the free orders, its equations as sums of them, a scale for each score."""

    axes: list[list[float]]
    laws: list[tuple[int, tuple[float, list[float]], list[tuple[int, tuple[float, list[float]]]]]]
    fixed: list[list[float | None]]
    scales: list[float]

    @property
    def asked(self) -> tuple[Any, ...]:
        """What the core takes behind the runs."""
        return self.axes, self.laws, self.inputs, self.fixed, self.scales, self.initial, self.settings.core()

    def search(self, progress: Told | None) -> _core._FoundStage:
        """Search here and at once."""
        return _core.search_stage(*self.core(progress))

    def ready(self, *, keeps_course: bool = False) -> _core.StageSearch:
        """Build what all candidates share, and where the search itself is kept its course."""
        return _core.StageSearch(*self.core(keeps_course))


_ready: OrderedDict[str, _core.OrderSearch | _core.StageSearch] = OrderedDict()
_lock = threading.Lock()


def _new_lock() -> None:
    """Replace the lock, which another thread may have held when this process was forked."""
    global _lock  # noqa: PLW0603
    _lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_new_lock)


def some_rounds(
    key: str, work: EquationWork | None, first: int, last: int, seed: list[tuple[int, float]], start: Any, threads: int
) -> tuple[float, Part] | None:
    """Do some rounds in a worker: seconds and part, or None where the search is not known and not given."""
    return _timed(key, work, lambda search: cast("Part", search.rounds(first, last, seed, start, threads, None, None)))


def some_candidates(key: str, work: StageWork | None, spans: list[Span], threads: int) -> tuple[float, Outcomes] | None:
    """Follow some candidates in a worker: seconds and verdicts, or None where the search is not known and not given."""
    return _timed(key, work, lambda search: cast("Outcomes", search.follow(spans, threads, None)))


def _timed(key: str, work: Work[Any] | None, do: Callable[[Any], Piece]) -> tuple[float, Piece] | None:
    with _lock:
        search = _ready.get(key) or (None if work is None else work.ready())
        if search is None:
            return None
        _ready[key] = search
        _ready.move_to_end(key)
        while len(_ready) > READY:
            _ready.popitem(last=False)
    began = time.monotonic()
    piece = do(search)
    return time.monotonic() - began, piece


#: Time [s] that a task should take: long beside sending it, short beside losing it.
TASK = 2.0
#: Tasks under way for each worker, so that none waits for the next.
AHEAD = 2
#: Attempts at one task before its search is given up.
ATTEMPTS = 3
#: How often [s] signals and the store are looked after while tasks are under way.
LOOK = 0.05


@dataclass
class Stretch:
    """Rounds to be done, from a checkpoint or from their start."""

    first: int
    last: int
    start: Checkpoint | None = None
    sent: bool = False
    attempts: int = 0


def workers(executor: Executor) -> int:
    """How many tasks an executor works on at a time, as far as it tells."""
    count = getattr(executor, "_max_workers", None)
    client = getattr(executor, "_client", None)
    if count is None and client is not None:
        with contextlib.suppress(Exception):
            count = sum(client.nthreads().values())
    return count if isinstance(count, int) and count > 0 else os.cpu_count() or 1


@dataclass
class Pace:
    """Seconds that a round or a candidate takes, once known; the fewest that are sent together."""

    each: float = 0.0
    fewest: int = 1

    def size(self, seconds: float) -> int:
        """How many take about so long."""
        return self.fewest if self.each == 0 else max(self.fewest, int(seconds / self.each))

    def took(self, seconds: float, count: int) -> None:
        """Learn from some."""
        each = max(seconds, 1e-9) / count
        self.each = each if self.each == 0 else 0.7 * self.each + 0.3 * each


def shipped(
    send: Callable[[Stretch], tuple[Any, ...]], left: list[Stretch], executor: Executor, pace: Pace
) -> Iterator[tuple[Stretch, Any]]:
    """Send stretches in pieces of about :data:`TASK` seconds each; give back what they came to."""
    count = workers(executor)
    ahead = AHEAD * count + 2
    # Of a short wave every worker gets its share.
    share = max(pace.fewest, -(-sum(s.last - s.first for s in left) // count))
    pending: dict[Future[Any], Stretch] = {}
    waiting = left[::-1]
    try:
        while waiting or pending:
            while waiting and len(pending) < ahead:
                stretch = waiting.pop()
                size = min(pace.size(TASK), share)
                if stretch.start is None and stretch.attempts == 0 and stretch.last - stretch.first > size:
                    waiting.append(Stretch(stretch.first + size, stretch.last))
                    stretch = Stretch(stretch.first, stretch.first + size)
                try:
                    pending[executor.submit(*send(stretch))] = stretch
                except (BrokenExecutor, RuntimeError) as error:
                    raise _lost(error) from error
            done, _ = wait(pending, timeout=LOOK, return_when=FIRST_COMPLETED)
            for future in done:
                stretch = pending.pop(future)
                timed = _result(future, stretch)
                if timed is None:
                    waiting.append(stretch)
                    continue
                seconds, piece = timed
                pace.took(seconds, stretch.last - stretch.first)
                yield stretch, piece
    finally:
        for future in pending:
            future.cancel()


def _result(future: Future[Any], stretch: Stretch) -> tuple[float, Any] | None:
    """Seconds and what a task came to; None where it must be sent (again)."""
    try:
        timed = cast("tuple[float, Any] | None", future.result())
    except FtlmError:
        raise
    except BrokenExecutor as error:
        raise _lost(error) from error
    except (Exception, CancelledError) as error:
        stretch.attempts += 1
        if stretch.attempts >= ATTEMPTS:
            raise _lost(error) from error
        return None
    if timed is None and not stretch.sent:
        # The worker has not got what the search is computed from: it goes along the next time.
        stretch.sent = True
        return None
    if not isinstance(timed, tuple) or len(timed) != 2:
        raise _lost(TypeError(f"a task came back with {type(timed).__name__}"))
    return timed


def _lost(error: BaseException) -> ConvergenceError:
    return ConvergenceError(
        f"the executor lost its work ({type(error).__name__}: {error}); start a new one and search again: "
        "with store= nothing that was finished is lost"
    )


#: Time [s] between two writes of what candidates under an order law came to: what is lost is not much more.
PIECE = 0.25
#: Fewest candidates under an order law that are followed or sent together: the first wave, so that the first worker to
#: be asked gets the record before the others are.
FEWEST = 256
Done = TypeVar("Done", Rounds, Verdicts)
#: Notes a checkpoint of the rounds from the first to the last.
Save = Callable[[int, int, Checkpoint | None], None]


class Course(ABC, Generic[Done, Table]):
    """A search on its way: candidates done and in all, and the wave that is being done."""

    #: Whether what an earlier version began may be gone on with.
    goes_on = True
    #: Whether the core itself tells of progress in what is done here.
    core_tells = False

    def __init__(self, work: Work[Table], pace: Pace) -> None:
        self.work, self.pace = work, pace
        self.threads = work.settings.threads
        self.done = self.total = 0

    @cached_property
    def key(self) -> str:
        """Name of the search among workers."""
        return self.work.key

    def payload(self, stretch: Stretch) -> Work[Table] | None:
        """What goes along with a stretch: nothing, unless a worker said that it does not know the search."""
        return self.work if stretch.sent else None

    @abstractmethod
    def waves(self) -> Iterator[tuple[int, int]]:
        """First piece of each wave and the one behind its last; the next is laid out once that one is whole."""

    @abstractmethod
    def here(self, left: list[Stretch], progress: Told | None, save: Save | None) -> Iterator[tuple[Stretch, Any]]:
        """Do stretches here."""

    @abstractmethod
    def task(self, stretch: Stretch) -> tuple[Any, ...]:
        """Name a function and its arguments that do a stretch elsewhere."""

    @abstractmethod
    def frame(self, number: int, stretch: Stretch, piece: Any) -> Done:
        """Make what a stretch came to a frame of a store, as of its search of that number."""

    @abstractmethod
    def take(self, done: Done) -> int:
        """Take in a stretch of the wave; tell how many of its candidates were left early, where that is known."""

    @abstractmethod
    def table(self) -> Table:
        """Join all waves."""


class EquationCourse(Course[Rounds, "_core._Found"]):
    """The rounds of one equation; those of a wave know the best rows of the waves before."""

    core_tells = True
    work: EquationWork

    def __init__(self, work: EquationWork, algorithm: int | None = None) -> None:
        super().__init__(work, Pace())
        self.total, self._ends, present = work.plan(algorithm)
        self.goes_on = algorithm is None or algorithm >= present
        self._parts: list[Part] = []
        self._seed: list[tuple[int, float]] = []

    @cached_property
    def _search(self) -> _core.OrderSearch:
        return self.work.ready()

    def waves(self) -> Iterator[tuple[int, int]]:
        """Rounds that know the same rows, each wave at a pace of its own: later ones exclude more."""
        first, keep = 0, self.work.settings.keep
        for end in self._ends:
            ranked = sorted({(row[1], row[0]) for part in self._parts for row in part[0]})[:keep]
            if len(ranked) == keep:
                self._parts = [_up_to(ranked[-1], part) for part in self._parts]
            self._seed = [(index, score) for score, index in ranked]
            self.pace = Pace()
            yield first, end
            first = end

    def here(self, left: list[Stretch], progress: Told | None, save: Save | None) -> Iterator[tuple[Stretch, Part]]:
        """Do each stretch in one call, from where it stands."""
        for stretch in left:
            first, last = stretch.first, stretch.last
            told = None if progress is None else partial(self._tell, progress, self.done)
            saved = None if save is None else partial(save, first, last)
            part = self._search.rounds(first, last, self._seed, stretch.start, self.threads, told, saved)
            yield stretch, cast("Part", part)

    def _tell(self, progress: Told, before: int, done: int, _all: int, pruned: int) -> None:
        progress(min(before + done, self.total), self.total, pruned)

    def task(self, stretch: Stretch) -> tuple[Any, ...]:
        """Some rounds."""
        ranged = stretch.first, stretch.last, self._seed, stretch.start, self.threads
        return some_rounds, self.key, self.payload(stretch), *ranged

    def frame(self, number: int, stretch: Stretch, piece: Part) -> Rounds:
        """Some rounds, done."""
        return Rounds(number, stretch.first, stretch.last, piece)

    def take(self, done: Rounds) -> int:
        """Take in some rounds."""
        self._parts.append(done.part)
        self.done += sum(done.part[1][1:])
        return 0

    def table(self) -> _core._Found:
        """Join the parts of all rounds."""
        return self.work.join(self._parts)


def _up_to(worst: tuple[float, int], part: Part) -> Part:
    """A part without the rows that better ones have pushed out."""
    rows, counts, failures = part
    return tuple(row for row in rows if (row[1], row[0]) <= worst), counts, failures


class StageCourse(Course[Verdicts, "_core._FoundStage"]):
    """The candidates that a stage wants followed; what those of a wave are depends on the waves before."""

    work: StageWork

    def __init__(self, work: StageWork) -> None:
        super().__init__(work, Pace(fewest=FEWEST))
        self.search = work.ready(keeps_course=True)
        self._first = 0
        self._spans: list[Span] = []
        self._wave: list[Verdicts] = []

    def waves(self) -> Iterator[tuple[int, int]]:
        """Candidates that are wanted next, by a number that goes on through all waves."""
        while spans := self.search.wanted():
            end = self._first + sum(last - first for _, first, last, _ in spans)
            self._spans, self._wave = spans, []
            self.total, _ = self.search.state()
            yield self._first, end
            self.search.take(*_whole(self._wave, self._first, end), self.threads)
            self._first = end
        self.total = self._first

    def here(self, left: list[Stretch], progress: Told | None, save: Save | None) -> Iterator[tuple[Stretch, Outcomes]]:
        """Follow candidates in pieces of about :data:`PIECE` seconds."""
        for stretch in left:
            at = stretch.first
            while at < stretch.last:
                piece = Stretch(at, min(stretch.last, at + self.pace.size(PIECE)))
                began = time.monotonic()
                outcomes = self.search.follow(self._cut(piece), self.threads, None)
                self.pace.took(time.monotonic() - began, piece.last - piece.first)
                yield piece, outcomes
                at = piece.last

    def task(self, stretch: Stretch) -> tuple[Any, ...]:
        """Some candidates."""
        return some_candidates, self.key, self.payload(stretch), self._cut(stretch), self.threads

    def _cut(self, stretch: Stretch) -> list[Span]:
        """The candidates of a stretch, counted through all spans of the wave."""
        cut, at = [], self._first
        for equation, start, end, limit in self._spans:
            low, high = max(stretch.first - at, 0), min(stretch.last - at, end - start)
            if low < high:
                cut.append((equation, start + low, start + high, limit))
            at += end - start
        return cut

    def frame(self, number: int, stretch: Stretch, piece: Outcomes) -> Verdicts:
        """Some candidates, done."""
        return Verdicts(number, stretch.first, stretch.last, *piece)

    def take(self, done: Verdicts) -> int:
        """Take in some verdicts."""
        self._wave.append(done)
        self.done += len(done.kinds)
        return done.kinds.count(1) + done.kinds.count(2)

    def table(self) -> _core._FoundStage:
        """Join the equations under their law."""
        return self.search.outcome()


def _whole(wave: list[Verdicts], first: int, end: int) -> Outcomes:
    """Verdicts of a wave in their order; refuse stretches that do not make it up."""
    at, values, kinds = first, [], []
    for verdicts in sorted(wave, key=lambda v: v.first):
        if verdicts.first != at:
            break
        at = verdicts.last
        values.append(verdicts.values)
        kinds.append(verdicts.kinds)
    if at != end:
        raise ModelError(f"candidates {first} to {end} are cut up otherwise")
    return b"".join(values), b"".join(kinds)


def search_equation(
    work: EquationWork, *, store: Store | None, number: int, executor: Executor | None, progress: Told | None
) -> _core._Found:
    """Search the orders of one equation: at once here, or in rounds with a store (its search `number`) or executor."""
    if store is None and executor is None:
        return work.search(progress)
    algorithm = None if store is None else store.contents.algorithm
    return _do(EquationCourse(work, algorithm), store, number, executor, progress)


def search_stage(
    work: StageWork, *, store: Store | None, number: int, executor: Executor | None, progress: Told | None
) -> _core._FoundStage:
    """Search a stage under its order law, as :func:`search_equation`; a finished search is only read."""
    if store is None and executor is None:
        return work.search(progress)
    joined = None if store is None else store.contents.sections[number].joined
    if joined is not None:
        return _table(work, joined)
    table = _do(StageCourse(work), store, number, executor, progress)
    if store is not None:
        store.joined(number, table)
    return table


def _do(
    course: Course[Done, Table], store: Store | None, number: int, executor: Executor | None, progress: Told | None
) -> Table:
    """Do all that a store does not hold yet, wave by wave, and join."""
    section = None if store is None else store.contents.sections[number]
    save = None if store is None else partial(store.save, number)
    pruned = 0
    for first, end in course.waves():
        for held in _held(section, first, end):
            course.take(held)
        left = list(_left(section, first, end))
        if left and store is not None and not course.goes_on:
            raise store.outdated()
        if executor is None:
            pieces = course.here(left, progress, save)
        else:
            pieces = shipped(course.task, left, executor, course.pace)
        for stretch, piece in pieces:
            frame = course.frame(number, stretch, piece)
            if store is not None:
                store.done(frame)
            pruned += course.take(frame)
            if progress is not None and not (course.core_tells and executor is None):
                progress(course.done, course.total, pruned)
    if section is not None and section.law and section.dealt != course.total:
        raise ModelError(f"it holds {section.dealt} candidates of {course.total}")
    if progress is not None:
        progress(course.total, course.total, 0)
    return course.table()


def equation_state(work: EquationWork, section: Section) -> tuple[int, float | None]:
    """Candidates of one equation, and the best score so far."""
    best = section.best
    if best is not None and work.settings.norm == "l2":
        best = math.sqrt(max(best, 0.0) / work.samples)
    return work.plan()[0], best


def stage_state(work: StageWork, section: Section) -> tuple[int, float | None]:
    """Candidates that the search of a stage follows, as far as a store tells, and the best score so far."""
    if section.joined is not None:
        return section.dealt, _table(work, section.joined)["rows"][0][1]
    course = StageCourse(work)
    for first, end in course.waves():
        for held in _held(section, first, end):
            course.take(held)
        if any(_left(section, first, end)):
            break
    return course.search.state()


def _table(work: StageWork, joined: Joined) -> _core._FoundStage:
    """The table of a finished search as the core gives it; refuse one of another search."""
    widths = [len(terms) for _, _, terms in work.laws]
    dealt = sum(v for k, v in joined.counts.items() if k != "candidates")
    sound = (
        set(joined.counts) == {"candidates", "kept", "beaten", "bound", "stopped early", "singular", "diverged"}
        and dealt == joined.counts["candidates"]
        and 0 < len(joined.rows) == joined.counts["kept"] <= work.settings.keep
        and all(len(free) == len(work.axes) for _, free, _ in joined.failures)
        and all(len(free) == len(work.axes) for _, _, free, _ in joined.rows)
        and all([len(p[3]) for p in parts] == widths for _, _, _, parts in joined.rows)
    )
    if not sound:
        raise ModelError("its table is of another search")
    table = msgspec.to_builtins({"rows": joined.rows, "counts": joined.counts, "failures": joined.failures})
    return cast("_core._FoundStage", {**table, "distinct": []})


def _held(section: Section | None, first: int, end: int) -> list[Any]:
    """What a store holds of a wave."""
    return [] if section is None else [frame for at, frame in section.done.items() if first <= at < end]


def _left(section: Section | None, first: int, end: int) -> Iterator[Stretch]:
    """Stretches of a wave that are not done: half done ones as they stand, and the gaps between."""
    known: list[Stretch] = []
    if section is not None:
        known = [Stretch(at, frame.last) for at, frame in section.done.items()]
        known += [Stretch(at, half.last, half.checkpoint) for at, half in section.open.items()]
    at = first
    for stretch in sorted(known, key=lambda s: s.first):
        if not first <= stretch.first < end:
            continue
        if at < stretch.first:
            yield Stretch(at, stretch.first)
        if stretch.start is not None:
            yield stretch
        at = stretch.last
    if at < end:
        yield Stretch(at, end)
