"""Candidates of one step looked at on thinned samples, so that long records are fitted by those alone that may lead."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, TypeVar

from ftlm.base.errors import FtlmError
from ftlm.data.run import Run
from ftlm.data.structures import Structure
from ftlm.fit.grid import Grid
from ftlm.fit.joint import COARSE_SHARE, given, output_sizes
from ftlm.fit.problem import FreeProblem
from ftlm.selection.trial import decided

#: Samples of the thinned records, and evaluations of a descent on them: those of a race of starts whose best go on; by
#: how much more than the best one leaves others are out of it.
COARSE_SAMPLES, SECOND_LAP, CONTENDER = 1200, 60, 3.0

Item = TypeVar("Item")
Made = TypeVar("Made")
#: A structure and where it starts.
Start = tuple[Structure, Sequence[Mapping[str, float]]]


class Pool(Protocol):
    """What does work for items in their order."""

    def quietly(self, work: Callable[[Item], Made], items: Sequence[Item]) -> list[Made]:
        """Work done for each item."""


def contenders(runs: Sequence[Run], starts: Sequence[Start], least: int, pool: Pool) -> list[int]:
    """Places of the structures that are fitted on all samples, in their order.

    Left out are those whose descents on thinned samples, as many evaluations as those ahead in a race of starts have,
    leave more than the best by the factor that ends such a race; never so many that fewer than `least` are left. Of
    records that are not thinned, and of bodies that may stick, none is.
    """
    every = list(range(len(starts)))
    decimation = max(1, round(min(run.length - 1 for run in runs) / COARSE_SAMPLES))
    if decimation == 1 or len(starts) <= least or any(s.has_friction for s, _ in starts):
        return every

    def level(start: Start) -> float:
        structure, points = start
        try:
            return _level(runs, decided(structure, runs), points, decimation)
        except FtlmError:
            # The fit on all samples says why.
            return math.inf

    levels = pool.quietly(level, starts)
    limit = CONTENDER * min(levels)
    ahead = sorted(every, key=lambda k: (levels[k], k))[:least]
    return [k for k in every if levels[k] <= limit or k in ahead]


def _level(runs: Sequence[Run], structure: Structure, points: Sequence[Mapping[str, float]], decimation: int) -> float:
    """The least that descents from some points leave on thinned samples, every output weighing alike."""
    problem = FreeProblem.of(structure)
    grid = Grid(
        problem, runs, [1.0 / (COARSE_SHARE * size) for size in output_sizes(runs, structure)], decimation=decimation
    )
    found = math.inf
    for point in points:
        try:
            found = min(found, grid.descend(given(problem, point), SECOND_LAP).level)
        except FtlmError:
            # A start whose free run is not finite is no start.
            continue
    return found
