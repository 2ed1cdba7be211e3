"""The rounds of a search: done here or by an executor, kept in a store or not, to the same bits.

Rounds form waves (see the core's search): those of a wave depend only on the rows kept before it, so they may be done
anywhere and in any order. Under an order law candidates of the equations take the place of rounds: what those of a wave
are, and how far each is followed, depends only on the waves before. An executor gets index ranges. What they are
computed from is sent only to a worker that says it has not got it, once.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import threading
import time
from collections import OrderedDict
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import msgspec
import numpy as np

from ftlm import _core
from ftlm.errors import ConvergenceError, FtlmError, ModelError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from ftlm.store import Joined, Part, Place, Section, Store

    Checkpoint = tuple[Place, Part]
    #: Equation, first candidate, the one behind the last, limit.
    Span = tuple[int, int, int, float]
    #: What candidates came to: values and kinds (see :class:`ftlm.store.Verdicts`).
    Found = tuple[bytes, bytes]

__all__ = ["StageWork", "Work", "do_rounds", "do_stage", "stage_state"]

#: Time [s] that a task should take: long beside sending it, short beside losing it.
TASK = 2.0
#: Tasks under way for each worker, so that none waits for the next.
AHEAD = 2
#: Attempts at one task before its search is given up.
ATTEMPTS = 3
#: Searches that a worker keeps ready.
READY = 2
#: How often [s] signals and the store are looked after while tasks are under way.
LOOK = 0.05
#: Time [s] between two writes of what candidates under an order law came to: what is lost is not much more.
PIECE = 0.25
#: Fewest candidates under an order law that are followed or sent together: the first wave, so that the first worker to
#: be asked gets the record before the others are.
FEWEST = 256


@dataclass(frozen=True)
class Work:
    """What every round of a search is computed from, as the core takes it."""

    runs: tuple[tuple[float, Any, Any], ...]
    orders: tuple[int, list[float], list[tuple[int, list[float], bool]]]
    inputs: list[bool]
    fixed: list[float | None]
    initial: tuple[bool, list[float]]
    settings: tuple[str, str, int, float, bool, int, int, bool, int]

    @property
    def samples(self) -> int:
        """Pulses of all records."""
        return sum(int(means.shape[1]) for _, means, _ in self.runs)

    @property
    def key(self) -> str:
        """Digest that names the search among workers."""
        return _key(self.runs, (self.orders, self.inputs, self.fixed, self.initial, self.settings))

    def plan(self) -> tuple[int, list[int]]:
        """Candidates, and where each wave of rounds ends."""
        return _core.search_plan(self.orders, self.inputs, self.initial, self.settings)

    def ready(self) -> _core.OrderSearch:
        """Build what the rounds share."""
        return _core.OrderSearch(list(self.runs), self.orders, self.inputs, self.fixed, self.initial, self.settings)

    def join(self, parts: Sequence[Part]) -> _core._Found:
        """Join the parts of all rounds."""
        settings = (self.orders, self.inputs, self.initial, self.settings)
        return _core.search_join(*settings, self.samples, list(parts))


@dataclass(frozen=True)
class StageWork:
    """What the search of a stage under its order law is computed from, as the core takes it."""

    runs: tuple[tuple[float, Any, Any], ...]
    axes: list[list[float]]
    laws: list[tuple[int, tuple[float, list[float]], list[tuple[int, tuple[float, list[float]]]]]]
    inputs: list[bool]
    fixed: list[list[float | None]]
    scales: list[float]
    initial: tuple[bool, list[float]]
    settings: tuple[str, str, int, float, bool, int, int, bool, int]

    @property
    def key(self) -> str:
        """Digest that names the search among workers."""
        settled = (self.axes, self.laws, self.inputs, self.fixed, self.scales, self.initial, self.settings)
        return _key(self.runs, settled)

    def ready(self, *, keeps_course: bool = False) -> _core.StageSearch:
        """Build what all candidates share, and where the search itself is kept its course."""
        return _core.StageSearch(
            list(self.runs), self.axes, self.laws, self.inputs, self.fixed, self.scales, self.initial, self.settings,
            keeps_course,
        )  # fmt: skip

    def search(self, progress: Callable[[int, int, int], None] | None) -> _core._FoundStage:
        """Search here, without a store."""
        return _core.search_stage(
            list(self.runs), self.axes, self.laws, self.inputs, self.fixed, self.scales, self.initial, self.settings,
            progress,
        )  # fmt: skip


def _key(runs: Sequence[tuple[float, Any, Any]], settled: tuple[Any, ...]) -> str:
    found = hashlib.blake2b(digest_size=16)
    for step, means, sensor in runs:
        found.update(msgspec.msgpack.encode((step, means.shape, sensor is None)))
        found.update(np.ascontiguousarray(means).tobytes())
        found.update(b"" if sensor is None else np.ascontiguousarray(sensor).tobytes())
    found.update(msgspec.msgpack.encode(settled))
    return found.hexdigest()


# ------------------------------------------------------------------------------------------------ in a worker

_ready: OrderedDict[str, _core.OrderSearch | _core.StageSearch] = OrderedDict()
_lock = threading.Lock()


def _new_lock() -> None:
    """Replace the lock, which another thread may have held when this process was forked."""
    global _lock  # noqa: PLW0603
    _lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_new_lock)


def some_rounds(
    key: str, work: Work | None, first: int, last: int, seed: list[tuple[int, float]], start: Any, threads: int
) -> tuple[float, Part] | None:
    """Do some rounds in a worker: seconds and part, or None where the search is not known and not given."""
    search = _known(key, work)
    if search is None:
        return None
    began = time.monotonic()
    part = cast("_core.OrderSearch", search).rounds(first, last, seed, start, threads, None, None)
    return time.monotonic() - began, cast("Part", part)


def some_candidates(key: str, work: StageWork | None, spans: list[Span], threads: int) -> tuple[float, Found] | None:
    """Follow some candidates in a worker: seconds and verdicts, or None where the search is not known and not given."""
    search = _known(key, work)
    if search is None:
        return None
    began = time.monotonic()
    found = cast("_core.StageSearch", search).follow(spans, threads, None)
    return time.monotonic() - began, found


def _known(key: str, work: Work | StageWork | None) -> _core.OrderSearch | _core.StageSearch | None:
    with _lock:
        search = _ready.get(key)
        if search is None:
            if work is None:
                return None
            search = work.ready()
            _ready[key] = search
            while len(_ready) > READY:
                _ready.popitem(last=False)
        _ready.move_to_end(key)
        return search


# ------------------------------------------------------------------------------------------------ at home


@dataclass
class Stretch:
    """Rounds to be done, from a checkpoint or from their start."""

    first: int
    last: int
    start: Checkpoint | None = None
    sent: bool = False
    attempts: int = 0


def do_rounds(
    work: Work,
    *,
    store: Store | None,
    number: int,
    executor: Executor | None,
    threads: int,
    progress: Callable[[int, int, int], None] | None,
) -> list[Part]:
    """Do all rounds that a store does not hold yet.

    Parameters
    ----------
    work
        The search.
    store, number
        Where parts are kept, and the number of this search in it.
    executor
        Who does them; None: this process.
    threads
        Threads of a task.
    progress
        Called with candidates done, in all, and 0.

    Returns
    -------
    list of Part
        What the rounds came to.

    Raises
    ------
    ConvergenceError
        An executor that has lost its workers.
    DataError
        A store that cannot be written.
    """
    total, ends = work.plan()
    keep = work.settings[5]
    section = None if store is None else store.contents.sections[number]
    parts: list[Part] = []
    search: _core.OrderSearch | None = None
    first = 0
    for end in ends:
        # The rows that all rounds of this wave know.
        best = sorted({(row[1], row[0]) for part in parts for row in part[0]})[:keep]
        seed = [(index, score) for score, index in best]
        held = [] if section is None else [p for f, (_, p) in section.done.items() if first <= f < end]
        left = list(_left(section, first, end))
        done = sum(sum(part[1][1:]) for part in (*parts, *held))
        if left and executor is None:
            search = search or work.ready()
            for stretch in left:
                told = None if progress is None else _from(progress, done, total)
                save = None if store is None else _saver(store, number, stretch)
                start = stretch.start
                part = cast("Part", search.rounds(stretch.first, stretch.last, seed, start, threads, told, save))
                _keep(store, number, stretch, part)
                held.append(part)
                done += sum(part[1][1:])
        elif left and executor is not None:
            key = work.key

            def send(stretch: Stretch, seed: list[tuple[int, float]] = seed, key: str = key) -> tuple[Any, ...]:
                payload = work if stretch.sent else None
                return some_rounds, key, payload, stretch.first, stretch.last, seed, stretch.start, threads

            for stretch, part in cast("Iterator[tuple[Stretch, Part]]", _shipped(send, left, executor, Pace())):
                _keep(store, number, stretch, part)
                held.append(part)
                done += sum(part[1][1:])
                if progress is not None:
                    progress(done, total, 0)
        parts = [*_trimmed(parts, keep), *held]
        first = end
    if progress is not None:
        progress(total, total, 0)
    return parts


def _trimmed(parts: list[Part], keep: int) -> list[Part]:
    """Parts without the rows that better ones have pushed out."""
    ranked = sorted({(row[1], row[0]) for part in parts for row in part[0]})
    if len(ranked) <= keep:
        return parts
    worst = ranked[keep - 1]
    return [(tuple(r for r in rows if (r[1], r[0]) <= worst), counts, failed) for rows, counts, failed in parts]


def _from(progress: Callable[[int, int, int], None], done: int, total: int) -> Callable[[int, int, int], None]:
    return lambda here, _, pruned: progress(min(done + here, total), total, pruned)


def _saver(store: Store, number: int, stretch: Stretch) -> Callable[[Any], None]:
    return lambda checkpoint: store.save(number, stretch.first, stretch.last, checkpoint)


def _keep(store: Store | None, number: int, stretch: Stretch, part: Part) -> None:
    if store is not None:
        store.done(number, stretch.first, stretch.last, part)


def do_stage(
    work: StageWork,
    *,
    store: Store | None,
    number: int,
    executor: Executor | None,
    threads: int,
    progress: Callable[[int, int, int], None] | None,
) -> _core._FoundStage:
    """Search a stage under its order law: follow all candidates that a store does not hold yet, and join.

    Parameters
    ----------
    work
        The search.
    store, number, executor, threads, progress
        As for :func:`do_rounds`; candidates are those of the equations.

    Returns
    -------
    dict
        Table, counts and failures.

    Raises
    ------
    ConvergenceError
        An executor that has lost its workers.
    DataError
        A store that cannot be written.
    ModelError
        A store that holds other candidates.
    """
    section = None if store is None else store.contents.sections[number]
    if section is not None and section.joined is not None:
        return _table(work, section.joined)
    search = work.ready(keeps_course=True)
    pace = Pace(fewest=FEWEST)
    key, first, pruned = work.key, 0, 0
    while spans := search.wanted():
        end = first + sum(last - start for _, start, last, _ in spans)
        held = {} if section is None else {f: s for f, s in section.followed.items() if first <= f < end}
        left = list(_left(section, first, end))
        done = end - sum(s.last - s.first for s in left)
        total, _ = search.state()

        def send(stretch: Stretch, spans: list[Span] = spans, first: int = first) -> tuple[Any, ...]:
            some = cut(spans, stretch.first - first, stretch.last - first)
            return some_candidates, key, work if stretch.sent else None, some, threads

        came = (
            _followed(search, spans, first, left, threads, pace)
            if executor is None
            else cast("Iterator[tuple[Stretch, Found]]", _shipped(send, left, executor, pace))
        )
        for stretch, (values, kinds) in came:
            if store is not None:
                store.followed(number, stretch.first, stretch.last, values, kinds)
            held[stretch.first] = (stretch.last, values, kinds)
            done += len(kinds)
            pruned += kinds.count(1) + kinds.count(2)
            if progress is not None:
                progress(done, total, pruned)
        search.take(*_whole(held, first, end), threads)
        first = end
    if section is not None and section.dealt != first:
        raise ModelError(f"it holds {section.dealt} candidates of {first}")
    if progress is not None:
        progress(first, first, 0)
    found = search.outcome()
    if store is not None:
        store.joined(number, found)
    return found


def stage_state(work: StageWork, section: Section, threads: int) -> tuple[int, float | None]:
    """Candidates that the search of a stage follows, as far as a store tells, and the best score so far.

    Raises
    ------
    ModelError
        A store that holds other candidates.
    """
    if section.joined is not None:
        return section.dealt, _table(work, section.joined)["rows"][0][1]
    search = work.ready(keeps_course=True)
    first = 0
    while spans := search.wanted():
        end = first + sum(last - start for _, start, last, _ in spans)
        held = {f: s for f, s in section.followed.items() if first <= f < end}
        if list(_left(section, first, end)):
            break
        search.take(*_whole(held, first, end), threads)
        first = end
    return search.state()


def _table(work: StageWork, joined: Joined) -> _core._FoundStage:
    """The table of a finished search as the core gives it.

    Raises
    ------
    ModelError
        One of another search.
    """
    widths = [len(terms) for _, _, terms in work.laws]
    dealt = sum(v for k, v in joined.counts.items() if k != "candidates")
    sound = (
        set(joined.counts) == {"candidates", "kept", "beaten", "bound", "stopped early", "singular", "diverged"}
        and dealt == joined.counts["candidates"]
        and 0 < len(joined.rows) == joined.counts["kept"] <= work.settings[5]
        and all(len(free) == len(work.axes) for _, free, _ in joined.failures)
        and all(len(free) == len(work.axes) for _, _, free, _ in joined.rows)
        and all([len(p[3]) for p in parts] == widths for _, _, _, parts in joined.rows)
    )
    if not sound:
        raise ModelError("its table is of another search")
    found = msgspec.to_builtins({"rows": joined.rows, "counts": joined.counts, "failures": joined.failures})
    return cast("_core._FoundStage", {**found, "distinct": []})


def _followed(
    search: _core.StageSearch, spans: list[Span], first: int, left: list[Stretch], threads: int, pace: Pace
) -> Iterator[tuple[Stretch, Found]]:
    """Follow the candidates of stretches here, in pieces of about :data:`PIECE` seconds."""
    for stretch in left:
        at = stretch.first
        while at < stretch.last:
            piece = Stretch(at, min(stretch.last, at + pace.size(PIECE)))
            began = time.monotonic()
            found = search.follow(cut(spans, piece.first - first, piece.last - first), threads, None)
            pace.took(time.monotonic() - began, piece.last - piece.first)
            yield piece, found
            at = piece.last


def cut(spans: list[Span], first: int, last: int) -> list[Span]:
    """The candidates ``first … last − 1`` of spans, counted through all of them."""
    found = []
    at = 0
    for equation, start, end, limit in spans:
        low, high = max(first - at, 0), min(last - at, end - start)
        if low < high:
            found.append((equation, start + low, start + high, limit))
        at += end - start
    return found


def _whole(held: dict[int, tuple[int, bytes, bytes]], first: int, end: int) -> Found:
    """Verdicts of a wave in their order.

    Raises
    ------
    ModelError
        Stretches that do not make it up.
    """
    at, values, kinds = first, [], []
    for start, (last, some, of) in sorted(held.items()):
        if start != at:
            break
        at = last
        values.append(some)
        kinds.append(of)
    if at != end:
        raise ModelError(f"candidates {first} to {end} are cut up otherwise")
    return b"".join(values), b"".join(kinds)


def _left(section: Any, first: int, end: int) -> Iterator[Stretch]:
    """Stretches of a wave that are not done: half done ones as they stand, and the gaps between."""
    if section is None:
        yield Stretch(first, end)
        return
    known = [(f, last, None) for f, (last, *_) in (*section.done.items(), *section.followed.items())]
    known += [(f, half.last, half.checkpoint) for f, half in section.open.items()]
    at = first
    for start, last, checkpoint in sorted(known, key=lambda k: k[0]):
        if not first <= start < end:
            continue
        if at < start:
            yield Stretch(at, start)
        if checkpoint is not None:
            yield Stretch(start, last, checkpoint)
        at = last
    if at < end:
        yield Stretch(at, end)


def workers(executor: Executor) -> int:
    """How many tasks an executor works on at a time, as far as it tells."""
    found = getattr(executor, "_max_workers", None)
    client = getattr(executor, "_client", None)
    if found is None and client is not None:
        with contextlib.suppress(Exception):
            found = sum(client.nthreads().values())
    return found if isinstance(found, int) and found > 0 else os.cpu_count() or 1


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


def _shipped(
    send: Callable[[Stretch], tuple[Any, ...]], left: list[Stretch], executor: Executor, pace: Pace
) -> Iterator[tuple[Stretch, Any]]:
    """Send stretches in pieces that take about :data:`TASK` seconds each; what they came to as it comes back."""
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
                found = _result(future, stretch)
                if found is None:
                    waiting.append(stretch)
                    continue
                seconds, came = found
                pace.took(seconds, stretch.last - stretch.first)
                yield stretch, came
    finally:
        for future in pending:
            future.cancel()


def _result(future: Future[Any], stretch: Stretch) -> tuple[float, Any] | None:
    """What a task came to; None where it must be sent (again).

    Raises
    ------
    ConvergenceError
        Workers that are gone, or a task that failed each time.
    """
    try:
        found = cast("tuple[float, Any] | None", future.result())
    except FtlmError:
        raise
    except BrokenExecutor as error:
        raise _lost(error) from error
    except (Exception, CancelledError) as error:
        stretch.attempts += 1
        if stretch.attempts >= ATTEMPTS:
            raise _lost(error) from error
        return None
    if found is None:
        stretch.sent = True
    return found


def _lost(error: BaseException) -> ConvergenceError:
    return ConvergenceError(
        f"the executor lost its work ({type(error).__name__}: {error}); start a new one and search again: "
        "with store= nothing that was finished is lost"
    )
