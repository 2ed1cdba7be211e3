"""Processor time expected for the steps of the reproduction, and progress of its workers."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

from ftlm.progress import ShareTracker, Stoppable

#: Steps of the work: processor time on one core of the reference machine [s], executions for a stage of the estimation
#: run, and for a stage of another arm. Searches are those of the paper's increment, optimizers those of theirs. Times
#: are three quarters of the measured ones, which included other load.
STEP_COSTS: Mapping[str, tuple[float, int, int]] = {
    "whole orders": (1.5, 1, 0),
    "search": (1.4, 5, 0),
    "instrumental": (2.0, 1, 0),
    "output error": (5.8, 1, 0),
    "published": (1.5, 1, 0),
    "traces": (0.8, 1, 0),
    "rivals": (5.2, 2, 2),
    "landscape": (2.4, 1, 0),
    "printed": (0.4, 1, 0),
    "trials": (2.0, 1, 0),
    "freed": (4.0, 0, 1),
}
#: Candidates of the optimizer comparison at its default increment.
CONTEST_CANDIDATES = 3800
#: Default smallest increment of the order grid, on every arm: the paper's grid has 60 000 candidates per angle, as many
#: evaluations per seed, and takes minutes.
CONTEST_STEP = 0.1
#: Maximum and minimum number of seeds, and most evaluations of one optimizer on one angle over all seeds.
MAX_SEEDS, MIN_SEEDS, MAX_EVALUATIONS = 10, 3, 40_000


def seeds_for(candidates: int) -> tuple[int, ...]:
    """Return ten seeds, or as many as the budget of evaluations allows."""
    return tuple(range(min(MAX_SEEDS, max(MIN_SEEDS, MAX_EVALUATIONS // max(candidates, 1)))))


def seconds_of(step: str, increment: float, rivals_increment: float | None = CONTEST_STEP) -> float:
    """Processor time of a step [s]; searches grow with the inverse fourth power of the increment."""
    scale = 1.0
    if step == "search":
        scale = (0.05 / increment) ** 4
    elif step == "rivals":
        candidates = 0
        if rivals_increment is not None:
            candidates = round(CONTEST_CANDIDATES * (CONTEST_STEP / max(increment, rivals_increment)) ** 4)
        scale = candidates * len(seeds_for(candidates)) / (CONTEST_CANDIDATES * len(seeds_for(CONTEST_CANDIDATES)))
    return STEP_COSTS[step][0] * scale


def seconds_of_all(
    increment: float, stages: int, arms: int = 0, records: int = 1, *, rivals_increment: float | None = CONTEST_STEP
) -> float:
    """Processor time of the whole reproduction [s]."""
    counts = {step: own + arms * other for step, (_, own, other) in STEP_COSTS.items()}
    counts["trials"] += (arms + 1) * records - 1
    return stages * sum(count * seconds_of(step, increment, rivals_increment) for step, count in counts.items())


class TotalProgress:
    """Share of all completed work, reported by several workers to one receiver.

    Parameters
    ----------
    seconds
        Processor time of all work.
    listener
        See :class:`ftlm.progress.ShareTracker`.
    """

    def __init__(self, seconds: float, listener: Callable[[int, int], None] | None) -> None:
        self._seconds, self._course, self._lock = max(seconds, 1e-9), ShareTracker(listener), threading.Lock()
        self._seconds_by_worker: dict[object, float] = {}

    def report(self, worker: object, seconds: float) -> None:
        """Report the processor time of all work that a worker has done [s]."""
        with self._lock:
            self._seconds_by_worker[worker] = seconds
            self._course.advance_to(sum(self._seconds_by_worker.values()) / self._seconds)

    def end(self) -> None:
        """Report that all work is finished, including skipped steps."""
        self._course.advance_to(1.0)


class WorkerProgress(Stoppable):
    """Progress of one worker through its steps; searches and fits call it with (done, total).

    Parameters
    ----------
    whole
        Progress of all work.
    stop
        Event that ends the work with KeyboardInterrupt at its next report.
    """

    def __init__(self, whole: TotalProgress, stop: threading.Event) -> None:
        super().__init__(None, stop)
        self._whole, self._before, self._step, self._within = whole, 0.0, 0.0, 0.0

    def begin(self, seconds: float) -> None:
        """Finish the previous step, and start a step with the given processor time [s]."""
        super().__call__(0, 0)
        self._before, self._step, self._within = self._before + self._step, seconds, 0.0
        self._whole.report(self, self._before)

    def __call__(self, count: int, total: int, pruned: int | None = None) -> None:
        """Report progress within the step; if the count restarts, it covers half of the remainder."""
        super().__call__(count, total, pruned)
        share = count / max(total, 1)
        if share < self._within:
            self._step *= 0.5
            self._before += self._step
        self._within = share
        self._whole.report(self, self._before + self._step * share)
