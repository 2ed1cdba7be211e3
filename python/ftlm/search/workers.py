"""Pieces of a search sent to an executor, and what they came to."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from dataclasses import dataclass
from typing import Any, cast

from ftlm.base.errors import ConvergenceError, FtlmError
from ftlm.search.frames import Checkpoint

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
