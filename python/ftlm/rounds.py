"""The rounds of a search: done here or by an executor, kept in a store or not, to the same bits.

Rounds form waves (see the core's search): those of a wave depend only on the rows kept before it, so they may be done
anywhere and in any order. An executor gets index ranges. What they are computed from is sent only to a worker that says
it has not got it, once.
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
from ftlm.errors import ConvergenceError, FtlmError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from ftlm.store import Part, Place, Store

    Checkpoint = tuple[Place, Part]

__all__ = ["Work", "do_rounds"]

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
        found = hashlib.blake2b(digest_size=16)
        for step, means, sensor in self.runs:
            found.update(msgspec.msgpack.encode((step, means.shape, sensor is None)))
            found.update(np.ascontiguousarray(means).tobytes())
            found.update(b"" if sensor is None else np.ascontiguousarray(sensor).tobytes())
        found.update(msgspec.msgpack.encode((self.orders, self.inputs, self.fixed, self.initial, self.settings)))
        return found.hexdigest()

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


# ------------------------------------------------------------------------------------------------ in a worker

_ready: OrderedDict[str, _core.OrderSearch] = OrderedDict()
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
    began = time.monotonic()
    part = search.rounds(first, last, seed, start, threads, None, None)
    return time.monotonic() - began, cast("Part", part)


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
            for stretch, part in _shipped(work, left, seed, executor, threads):
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


def _left(section: Any, first: int, end: int) -> Iterator[Stretch]:
    """Stretches of a wave that are not done: half done ones as they stand, and the gaps between."""
    if section is None:
        yield Stretch(first, end)
        return
    known = [(f, last, None) for f, (last, _) in section.done.items()]
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


def _shipped(
    work: Work, left: list[Stretch], seed: list[tuple[int, float]], executor: Executor, threads: int
) -> Iterator[tuple[Stretch, Part]]:
    """Send stretches in pieces that take about :data:`TASK` seconds each; parts as they come back."""
    key = work.key
    ahead = AHEAD * workers(executor) + 2
    pending: dict[Future[Any], Stretch] = {}
    waiting = left[::-1]
    pace = 0.0
    try:
        while waiting or pending:
            while waiting and len(pending) < ahead:
                stretch = waiting.pop()
                size = 1 if pace == 0 else max(1, int(TASK / pace))
                if stretch.start is None and stretch.attempts == 0 and stretch.last - stretch.first > size:
                    waiting.append(Stretch(stretch.first + size, stretch.last))
                    stretch = Stretch(stretch.first, stretch.first + size)
                payload = work if stretch.sent else None
                task = (key, payload, stretch.first, stretch.last, seed, stretch.start, threads)
                try:
                    pending[executor.submit(some_rounds, *task)] = stretch
                except (BrokenExecutor, RuntimeError) as error:
                    raise _lost(error) from error
            done, _ = wait(pending, timeout=LOOK, return_when=FIRST_COMPLETED)
            for future in done:
                stretch = pending.pop(future)
                found = _result(future, stretch)
                if found is None:
                    waiting.append(stretch)
                    continue
                seconds, part = found
                each = seconds / (stretch.last - stretch.first)
                pace = each if pace == 0 else 0.7 * pace + 0.3 * each
                yield stretch, part
    finally:
        for future in pending:
            future.cancel()


def _result(future: Future[Any], stretch: Stretch) -> tuple[float, Part] | None:
    """What a task came to; None where it must be sent (again).

    Raises
    ------
    ConvergenceError
        Workers that are gone, or a task that failed each time.
    """
    try:
        found = cast("tuple[float, Part] | None", future.result())
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
