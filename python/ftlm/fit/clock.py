"""Numbers of a fit in a unit of time of the runs' own, so that nothing hangs on the unit in which time is told."""

from __future__ import annotations

from collections.abc import Sequence

from ftlm import _core
from ftlm.data.run import Run
from ftlm.fit.problem import FreeProblem


def spans(runs: Sequence[Run]) -> list[tuple[float, float]]:
    """Sample interval and duration of each run [s]."""
    return [(run.step, run.length * run.step) for run in runs]


def clock(problem: FreeProblem, runs: Sequence[Run]) -> _core.JointClock:
    """The unit of a frequency half way, in logarithms, between that of the runs and Nyquist's.

    A coefficient before D^nu y beside D^alpha y is a time to the power of -(alpha - nu), which free orders change.
    """
    return problem.core.clock(spans(runs))
