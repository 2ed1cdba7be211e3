"""Optima whose free run grows: kept where the runs force them, not where one that dies away explains them as well.

A run that starts in motion gives an equation initial terms of its own. They cost a growing mode nothing: fitted, they
take away all that it becomes until the end of the run, and what is left runs backwards in time. Such an equation
answers its inputs before they come, which no machine does, and where residuals are coloured it may well leave less.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ftlm import _core
from ftlm.base.arrays import Floats
from ftlm.base.errors import FtlmError
from ftlm.fit.clock import clock
from ftlm.fit.grid import Attempt, Grid
from ftlm.fit.problem import FreeProblem
from ftlm.fit.simpler import held as known_orders

#: Stretches of the runs whose sums of squares are compared, and the 99 % quantile of Student's t of one less.
STRETCHES, STUDENT_99 = 20, 2.54
#: Residuals larger by this factor force what no stretch may show: a run that grows is seen at its end alone.
FAR_LARGER = 2.0
#: Optima of the race that are looked at, and evaluations of each.
LOOKED_AT, EVALUATIONS = 3, 60


@dataclass(frozen=True)
class Growth:
    """An optimum whose free run grows beside the best one found whose free run does not.

    Parameters
    ----------
    kept
        Whether the growing one is the fit's, because the runs force it or there was no other.
    excess
        Share by which residuals of the other one are larger (root mean square); infinite where there was none, below 0
        where the growing one was no optimum.
    at_limit
        Whether the other one stands where free runs begin to grow, no optimum of its own.
    """

    kept: bool
    excess: float
    at_limit: bool = False


def can_grow(problem: FreeProblem) -> bool:
    """Whether own terms alone say that a free run grows, and initial terms may take away what it becomes."""
    structure = problem.structure
    alone = structure.coupling == "measured" or len(structure.equations) == 1
    return alone and not structure.has_friction and structure.initial != "rest"


def grows(problem: FreeProblem, attempt: Attempt) -> bool:
    """Whether the free run of an equation grows at a point."""
    if not can_grow(problem):
        return False
    orders, named = dict(zip(problem.orders, attempt.orders, strict=True)), problem.named(attempt.coefficients)
    for item in problem.structure.equations:
        alpha, *own = (
            order.constant + sum(w * orders[n] for n, w in order.weights)
            for order in (item.order, *(t.order for t in item.terms if t.signal == item.output))
        )
        terms = [t for t in item.terms if t.signal == item.output]
        values = [t.fixed if t.fixed is not None else t.factor * named[str(t.coefficient)] for t in terms]
        if _core.grows(alpha, list(zip(map(float, values), own, strict=True))):
            return True
    return False


def own_terms(problem: FreeProblem) -> dict[str, float]:
    """Free coefficients before own terms, with the factor that they are multiplied by."""
    return {
        t.coefficient: t.factor for e in problem.structure.equations for t in e.terms
        if t.signal == e.output and isinstance(t.coefficient, str)
    }  # fmt: skip


def dissipative(problem: FreeProblem, attempt: Attempt) -> tuple[Attempt, list[int]]:
    """The point with own terms that all pull back, whose free run dies away up to order 2, and which of them turned.

    Those are held where the rest follows first: released at once, what drives would be that of the growing optimum.
    """
    own = own_terms(problem)
    turned = [
        k for k, (n, v) in enumerate(zip(problem.coefficients, attempt.coefficients, strict=True))
        if n in own and v * own[n] > 0.0
    ]  # fmt: skip
    values = [-v if k in turned else v for k, v in enumerate(attempt.coefficients)]
    origin = f"{attempt.origin}, all own terms pulling back"
    return replace(attempt, coefficients=values, origin=origin), [len(problem.orders) + k for k in turned]


def lacking(problem: FreeProblem, attempt: Attempt) -> list[tuple[Attempt, list[int]]]:
    """The point without one own term after the other, each held at 0 where the rest follows first.

    What a term less explains without growing, the whole equation explains, too.
    """
    own = own_terms(problem)
    places = [k for k, name in enumerate(problem.coefficients) if name in own]
    out = []
    for k in places if len(places) > 1 else []:
        values = [0.0 if i == k else v for i, v in enumerate(attempt.coefficients)]
        origin = f"{attempt.origin}, from {problem.coefficients[k]} = 0"
        out.append((replace(attempt, coefficients=values, origin=origin), [len(problem.orders) + k]))
    return out


def stable_ends(held: Grid, best: Attempt, reached: Sequence[Attempt]) -> list[Attempt]:
    """Where attempts end whose free runs die away: those of a race, and what is nearest to a growing optimum."""
    problem = held.problem
    starts: list[tuple[Attempt, list[int]]] = [(a, []) for a in reached if not grows(problem, a)]
    ends = []
    for start, turned in (*starts[:LOOKED_AT], dissipative(problem, best), *lacking(problem, best)):
        if grows(problem, start):
            continue
        try:
            near = held.descend(start, EVALUATIONS, plain=True, held=turned) if turned else start
            ends.append(ended_steadily(held, near))
        except FtlmError:
            # No finite free run on this grid; the others have one.
            continue
    return ends


def ended_steadily(held: Grid, start: Attempt) -> Attempt:
    """Where a descent ends that goes to no free run that grows, along the limit of growth if it comes there."""
    end = held.descend(start, EVALUATIONS, plain=True)
    return end if end.converged else along_limit(held, end)


def steadied(best: Attempt, grid: Grid, reached: Sequence[Attempt]) -> tuple[Attempt, Grid, Growth | None]:
    """The optimum to go on from, on a grid that stays where free runs die away if it does, and what was compared."""
    problem = grid.problem
    if not grows(problem, best):
        return best, grid, None
    held = replace(grid, steady=True)
    ends = stable_ends(held, best, reached)
    unit = clock(problem, grid.runs)
    for one in known_orders(problem):
        # What the equation explains with an order known without growing, it explains with that order free.
        narrow = replace(held, problem=one.problem)
        inside = stable_ends(narrow, one.without(best, problem, unit), [one.without(a, problem, unit) for a in reached])
        if inside:
            with contextlib.suppress(FtlmError):
                there = one.embedded(nearest_stable(narrow, inside), problem.orders[one.order])
                ends.append(ended_steadily(held, there))
    if not ends:
        return best, grid, Growth(kept=True, excess=math.inf)
    other = nearest_stable(held, ends)
    excess = math.sqrt(other.level / best.level) - 1.0 if best.level > 0 else math.inf
    if forced(grid, best, other):
        return best, grid, Growth(kept=True, excess=excess)
    return other, held, Growth(kept=False, excess=excess, at_limit=not other.converged)


def along_limit(grid: Grid, end: Attempt) -> Attempt:
    """The lowest point beside one at the limit of growth: from there on with one own term held after the other.

    A descent stands where a step of all numbers would grow, though the rest may still fall along the limit.
    """
    problem = grid.problem
    own = own_terms(problem)
    best = end
    for place in (k for k, name in enumerate(problem.coefficients) if name in own):
        try:
            there = grid.descend(end, EVALUATIONS, plain=True, held=len(problem.orders) + place)
        except FtlmError:
            continue
        best = min(best, there, key=lambda a: a.level)
    # Held, it stood still in fewer numbers than the fit has.
    return replace(best, outcome={**best.outcome, "status": end.outcome["status"]}) if best is not end else end


def nearest_stable(grid: Grid, ends: Sequence[Attempt]) -> Attempt:
    """The end that a growing optimum is compared with.

    Where free runs begin to grow a descent stands at a wall, which is no optimum: one of those is taken instead, but
    for where the runs refuse all of them for the wall.
    """
    ranked = grid.finer.ranked(ends)
    settled = [a for a in ranked if a.converged and not forced(grid, ranked[0], a)]
    return (settled or ranked)[0]


def forced(grid: Grid, best: Attempt, other: Attempt) -> bool:
    """Whether the best point leaves less than another one by more than chance, neither of them inside the other.

    The means of the squares over stretches of the runs are compared (Vuong, doi:10.2307/1912557; for coloured residuals
    Rivers & Vuong, doi:10.1111/1368-423X.t01-1-00071).
    """
    if other.level > FAR_LARGER**2 * best.level:
        return True
    less: list[float] = []
    pairs = list(zip(grid.residuals(other), grid.residuals(best), strict=True))
    samples = sum(_squares(one).size for one, _ in pairs)
    for one, two in pairs:
        fall = _squares(one) - _squares(two)
        parts = np.array_split(fall, max(1, round(STRETCHES * fall.size / samples)))
        less += [float(np.mean(part)) for part in parts if part.size]
    if len(less) < 2:
        return True
    scatter = float(np.std(less, ddof=1)) / math.sqrt(len(less))
    return float(np.mean(less)) > STUDENT_99 * scatter


def _squares(residuals: dict[str, Floats]) -> Floats:
    """Squares of weighted residuals of all outputs, sample by sample; what was not read counts nothing."""
    summed: Floats = np.sum([np.nan_to_num(e) ** 2 for e in residuals.values()], axis=0)
    return summed
