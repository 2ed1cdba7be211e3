"""How far the reproduction is: what each of its steps takes, said beforehand, and the share that is behind."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

from ftlm.base.progress import Course, Stoppable
from ftlm.paper.rivalry import CONTEST_STEP, seeds_for

#: What each step of a stage takes one core of the machine that base/pace.py knows [s]: searches at the step of the
#: paper's lattice, rivals at that of theirs, fits on the virtual rig's 5000 rows. Three quarters of what they took
#: beside other work.
STEPS: Mapping[str, float] = {
    "whole orders": 1.5, "search": 1.4, "instrumental": 2.0, "output error": 5.8, "published": 1.5, "traces": 0.8,
    "rivals": 5.2, "equation": 0.1, "landscape": 2.4, "printed": 0.4, "trials": 2.0, "freed": 4.0,
}  # fmt: skip


#: Of the rivals' lattice at its usual step.
CANDIDATES = 3800
#: What a stage of the run that is identified from takes, once each unless said, and one of another arm.
OF_STAGE = {
    "whole orders": 1, "search": 5, "instrumental": 1, "output error": 1, "published": 1, "traces": 1, "rivals": 2,
    "equation": 1, "landscape": 1, "printed": 1, "trials": 1,
}  # fmt: skip
OF_ARM = {"trials": 0, "rivals": 2, "freed": 1}


def seconds_of(step: str, lattice_step: float, rivals_step: float = CONTEST_STEP) -> float:
    """Processor time of a step [s]; what searches lattices grows with the fourth power of their fineness."""
    if step == "rivals":
        candidates = round(CANDIDATES * (CONTEST_STEP / max(lattice_step, rivals_step)) ** 4)
        evaluations = candidates * len(seeds_for(candidates))
        return STEPS[step] * evaluations / (CANDIDATES * len(seeds_for(CANDIDATES)))
    return STEPS[step] * float((0.05 / lattice_step) ** 4 if step == "search" else 1.0)


def seconds_of_all(
    lattice_step: float, stages: int, arms: int = 0, records: int = 1, *, rivals_step: float = CONTEST_STEP
) -> float:  # fmt: skip
    """Processor time of all of it [s]: stages of one run, so many arms besides, records of each and of the first."""
    counts = dict(OF_STAGE)
    for step, count in OF_ARM.items():
        counts[step] = counts.get(step, 0) + arms * count
    counts["trials"] += (arms + 1) * records - 1
    return stages * sum(count * seconds_of(step, lattice_step, rivals_step) for step, count in counts.items())


class Whole:
    """The share of all work that is done, told to one listener by workers at the same time.

    Parameters
    ----------
    seconds
        Of all work together.
    told
        See :class:`ftlm.base.progress.Course`.
    """

    def __init__(self, seconds: float, told: Callable[[int, int], None] | None) -> None:
        self._seconds, self._course, self._lock = max(seconds, 1e-9), Course(told), threading.Lock()
        self._done = 0.0
        self._under_way: dict[object, float] = {}

    def at(self, worker: object, seconds: float) -> None:
        """A worker is so far with its step."""
        with self._lock:
            self._under_way[worker] = seconds
            self._course.at((self._done + sum(self._under_way.values())) / self._seconds)

    def ended(self, worker: object, seconds: float) -> None:
        """A worker has ended a step."""
        with self._lock:
            self._under_way.pop(worker, None)
            self._done += seconds
            self._course.at((self._done + sum(self._under_way.values())) / self._seconds)

    def end(self) -> None:
        """All is done, whatever was left out on the way."""
        self._course.at(1.0)


class Steps(Stoppable):
    """One worker's steps, one after the other: what searches and fits are to call with (done, total).

    Parameters
    ----------
    whole
        All work.
    stop
        Set to end the work with KeyboardInterrupt at its next report.
    """

    def __init__(self, whole: Whole, stop: threading.Event) -> None:
        super().__init__(None, stop)
        self._whole, self._step, self._within = whole, 0.0, 0.0

    def begin(self, seconds: float) -> None:
        """The step before has ended; the next one takes so long."""
        super().__call__(0, 0)
        self._whole.ended(self, self._step)
        self._step, self._within = seconds, 0.0

    def __call__(self, done: int, total: int, pruned: int | None = None) -> None:
        """A part of the step is so far; where it counts anew, it has gone half of the way that was left."""
        super().__call__(done, total, pruned)
        share = done / max(total, 1)
        if share < self._within:
            self._step, passed = 0.5 * self._step, 0.5 * self._step
            self._whole.ended(self, passed)
        self._within = share
        self._whole.at(self, self._step * share)
