"""Processor time that each step of the reproduction is expected to take, and progress of its worker threads."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

from ftlm.progress import CancellableProgress, FractionTracker

#: Steps of the reproduction: processor time on one core of the reference machine [s], number of executions for a joint
#: of the estimation run, and for a joint of another arm. Times hold for the paper's increment of the order grid, and
#: for the default increment of the optimizer comparison ("optimizers"). They are three quarters of the measured times,
#: because the machine had other load.
STEP_COSTS: Mapping[str, tuple[float, int, int]] = {
    "integer orders": (1.5, 1, 0),
    "search": (1.4, 5, 0),
    "instrumental": (2.0, 1, 0),
    "output error": (5.8, 1, 0),
    "published": (1.5, 1, 0),
    "traces": (0.8, 1, 0),
    "optimizers": (5.2, 2, 2),
    "landscape": (2.4, 1, 0),
    "printed": (0.4, 1, 0),
    "trials": (2.0, 1, 0),
    "order comparison": (4.0, 0, 1),
}
#: Number of candidates of the order grid in the optimizer comparison at its default increment.
COMPARISON_CANDIDATES = 3800
#: Default minimum increment of the order grid in the optimizer comparison. The paper's grid has 60 000 candidates per
#: angle. With as many evaluations per seed, a comparison would take minutes.
COMPARISON_INCREMENT = 0.1
#: Maximum and minimum number of seeds of an optimizer, and maximum number of evaluations on one angle over all seeds.
MAX_SEEDS, MIN_SEEDS, MAX_EVALUATIONS = 10, 3, 40_000


def seeds_for(candidates: int) -> tuple[int, ...]:
    """Return the seeds 0, 1, … of an optimizer that evaluates this number of candidates per seed.

    There are ten, or fewer if all seeds would need more than `MAX_EVALUATIONS` evaluations, but at least three.
    """
    return tuple(range(min(MAX_SEEDS, max(MIN_SEEDS, MAX_EVALUATIONS // max(candidates, 1)))))


def seconds_of(step: str, increment: float, comparison_increment: float | None = COMPARISON_INCREMENT) -> float:
    """Return the expected processor time [s] of the step with this name.

    The time of an order search is proportional to the inverse fourth power of the increment. `comparison_increment` is
    the increment of the optimizer comparison; None without one.
    """
    seconds = STEP_COSTS[step][0]
    if step == "search":
        return seconds * (0.05 / increment) ** 4
    if step != "optimizers":
        return seconds
    if comparison_increment is None:
        return 0.0
    scale = (COMPARISON_INCREMENT / max(increment, comparison_increment)) ** 4
    candidates = round(COMPARISON_CANDIDATES * scale)
    return seconds * candidates * len(seeds_for(candidates)) / (COMPARISON_CANDIDATES * MAX_SEEDS)


def seconds_of_all(
    increment: float,
    stages: int,
    arms: int = 0,
    records: int = 1,
    *,
    comparison_increment: float | None = COMPARISON_INCREMENT,
) -> float:
    """Return the expected processor time of the whole reproduction [s].

    `stages`, `arms` and `records` are the numbers of joints, of further simulated arms, and of records per arm.
    """
    counts = {step: own + arms * other for step, (_, own, other) in STEP_COSTS.items()}
    counts["trials"] += (arms + 1) * records - 1
    return stages * sum(count * seconds_of(step, increment, comparison_increment) for step, count in counts.items())


class TotalProgress:
    """Progress of all work, to which several worker threads report.

    Parameters
    ----------
    seconds
        Expected processor time of all work [s].
    listener
        Progress callback with (parts done, total parts); see :class:`ftlm.progress.FractionTracker`.
    """

    def __init__(self, seconds: float, listener: Callable[[int, int], None] | None) -> None:
        self._seconds, self._course, self._lock = max(seconds, 1e-9), FractionTracker(listener), threading.Lock()
        self._seconds_by_worker: dict[object, float] = {}

    def report(self, worker: object, seconds: float) -> None:
        """Report that a worker has done work with an expected processor time of `seconds` in total."""
        with self._lock:
            self._seconds_by_worker[worker] = seconds
            self._course.advance_to(sum(self._seconds_by_worker.values()) / self._seconds)

    def end(self) -> None:
        """Report that all work is finished, even if steps were skipped."""
        self._course.advance_to(1.0)


class WorkerProgress(CancellableProgress):
    """Progress callback of one worker thread.

    Searches and fits call it with the counts (done, total) of their own work.

    Parameters
    ----------
    whole
        Progress of the work of all threads.
    stop
        Event that cancels the work: if it is set, the next report raises KeyboardInterrupt.
    """

    def __init__(self, whole: TotalProgress, stop: threading.Event) -> None:
        super().__init__(None, stop)
        self._whole, self._before, self._step, self._within = whole, 0.0, 0.0, 0.0

    def begin(self, seconds: float) -> None:
        """Finish the previous step, and start a step with this expected processor time [s]."""
        super().__call__(0, 0)
        self._before, self._step, self._within = self._before + self._step, seconds, 0.0
        self._whole.report(self, self._before)

    def __call__(self, count: int, total: int, pruned: int | None = None) -> None:
        """Report that `count` of `total` items of the current step are done.

        A step may count from zero several times. When the count restarts, half of the remaining expected time of the
        step is regarded as done, and the new count covers the other half.
        """
        super().__call__(count, total, pruned)
        share = count / max(total, 1)
        if share < self._within:
            self._step *= 0.5
            self._before += self._step
        self._within = share
        self._whole.report(self, self._before + self._step * share)
