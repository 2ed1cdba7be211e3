"""The race of starts: short fits on thinned samples, of which the best go on."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ftlm.base.errors import FtlmError, ModelError
from ftlm.base.threads import pool
from ftlm.data.run import Run
from ftlm.data.structures import History
from ftlm.fit.clock import clock
from ftlm.fit.grid import FINEST, Attempt, Grid, descend
from ftlm.fit.problem import FreeProblem
from ftlm.fit.simpler import LowerOrder, Simpler, Whole, held, lower_orders, simpler, unlike, whole
from ftlm.fit.starts import delayed_attempts, power_frequency

#: Samples of the coarse fits that compare starts, of all runs together, and of each at least; the best ones continue on
#: all samples.
COARSE_SAMPLES, LEAST_SAMPLES = 1200, 400
#: So many samples become one without asking what that shows; half a turn of what holds 90 % of the power is to be as
#: many at least; a part of a record stands for it if its outputs deviate by this share of the whole's.
THINNEST, SHOWN, AS_LIVELY = 10, 1.0, 0.7
#: Evaluations of every coarse fit, then of those that are ahead: one in RUNNERS, but not fewer than FEWEST.
FIRST_LAP = 15
SECOND_LAP = 60
RUNNERS = 3
FEWEST = 8
#: Share of its start below which a coefficient is as good as 0: a descent that keeps its sign ends at e^-20.
VANISHED = 1e-8
#: Starts that tell how fine the grid must be on which all compete, chosen by this many evaluations.
PIONEERS = 3
GLANCE = 2
#: A coarse grid tells where starts lead if a finer one moves no number of the best by more than this share.
MOVED = 0.1
#: Behind the first, a start goes on while a lap lowers its cost by this share: what has come to rest overtakes nobody.
ON_THE_WAY = 0.05
#: All get as many as those ahead where the best is above the noise by this factor; of those further behind than
#: contenders are, by no more than the second factor, who falls by a share in a few evaluations.
ABOVE_FLOOR, FAR_BEHIND = 2.0, 100.0
STIR, STIRS = 5, 0.1
#: Coarse fits that continue on all samples.
FINALISTS = 3
#: ... unless their coarse cost exceeds the best one's by this factor; on few samples nobody as far behind goes on.
CONTENDER = 3.0
#: Two costs closer than this share are the same optimum.
SAME_COST = 1e-3
#: Starts whose numbers are all as near as this share are in the same place, optima if their orders are as near as this.
SAME_PLACE = 0.02


@dataclass(frozen=True)
class Laps:
    """Who runs how many laps at a time, and who is told."""

    starts: int
    threads: int
    progress: Callable[[int, int], None] | None

    def run(
        self, grid: Grid, runners: Sequence[Attempt], evaluations: int, problem: FreeProblem | None = None
    ) -> list[Attempt]:
        """Where the runners get with so many evaluations, best first."""
        ended = self.each(grid, runners, evaluations, problem)
        return sorted((a for a in ended if a is not None), key=lambda a: a.level)

    def each(
        self, grid: Grid, runners: Sequence[Attempt], evaluations: int, problem: FreeProblem | None = None
    ) -> list[Attempt | None]:
        """Where each of the runners gets; None of those whose free run is not finite."""
        experiments = grid.experiments

        def tried(attempt: Attempt) -> Attempt | None:
            try:
                ended = descend(problem or grid.problem, experiments, attempt, evaluations=evaluations)
                return without_vanished(problem or grid.problem, attempt, ended)
            except FtlmError:
                # A start whose free run is not finite is no start; if none is left, the fit says so.
                return None

        ended = []
        with pool(self.threads) as workers:
            for done, attempt in enumerate(workers.map(tried, runners)):
                ended.append(attempt)
                if self.progress is not None:
                    self.progress(min(done, self.starts - 1), self.starts)
        return ended


def race(alike: Grid, floor: float, threads: int, progress: Callable[[int, int], None] | None) -> list[Attempt]:
    """Coarse fits from all starts, best first, every output weighing alike; noise alone leaves `floor` per residual."""
    if isinstance(alike.problem.structure.initial, History):
        return with_history(alike, floor, threads, progress)
    return without_history(alike, floor, threads, progress)[0]


def without_history(
    alike: Grid, floor: float, threads: int, progress: Callable[[int, int], None] | None
) -> tuple[list[Attempt], Grid]:
    """The race of a problem whose initial terms are few, and the grid on which it was."""
    problem, runs = alike.problem, alike.runs
    starts = delayed_attempts(runs, problem, threads)
    laps = Laps(len(starts), threads, progress)
    coarse, glanced, ran = fine_enough(thinned(alike), starts, laps)
    reached = sorted(ran + laps.run(coarse, glanced, FIRST_LAP), key=lambda a: a.level)
    while coarse.every < FINEST and (not reached or coarse.matters(reached[0])):
        coarse = coarse.finer
        reached = laps.run(coarse, starts, FIRST_LAP)
    # Whatever a simpler equation reaches, this one reaches too: it starts there with the term's coefficient at 0, or
    # with a pole too fast to see.
    others: list[Simpler | LowerOrder | Whole] = [*unlike(simpler(problem)), *lower_orders(problem, runs)]
    others += whole(problem, reached[0].orders) if reached else []
    first, wholes = reached, list[Attempt]()
    for less in others if reached else []:
        if isinstance(less, Simpler) and less.driven:
            # What drives is solved for at every point, with a term less as well: own terms alone are told apart, so
            # where the whole problem starts and ends will do, and the way goes on in the whole problem.
            runners = [less.without(a, problem) for a in (*distinct(first)[:FINALISTS], *starts)]
            runners = laps.run(coarse, runners, GLANCE, less.problem)[:FINALISTS]
            ended = laps.run(coarse, runners, FIRST_LAP, less.problem)
            reached = sorted(
                reached + laps.run(coarse, [less.embedded(a, problem) for a in ended[:1]], 1), key=lambda a: a.level
            )
            continue
        if isinstance(less, Simpler) and is_rich(problem) and len(less.problem.orders) < len(problem.orders):
            # One of several terms of free orders less is still an equation of many optima: searched like the whole.
            ended = without_history(replace(alike, problem=less.problem), floor, threads, None)[0]
            # Which of its optima is the lowest, a history may turn round.
            there = laps.run(coarse, [less.embedded(a, problem) for a in in_reach(ended)[:FEWEST]], 1)
            reached = sorted(reached + there, key=lambda a: a.level)
            continue
        try:
            runners = delayed_attempts(runs, less.problem, threads)
        except ModelError:
            # At whole orders two of its terms have become one.
            continue
        # At given orders most starts lead to one optimum.
        going = FINALISTS if isinstance(less, Whole) else FEWEST
        runners = distinct(laps.run(coarse, runners, GLANCE, less.problem), same_place)[:going]
        ended = laps.run(coarse, runners, FIRST_LAP, less.problem)
        ended = laps.run(coarse, finalists(ended), SECOND_LAP, less.problem)
        there = [less.embedded(a, problem) for a in ended[:1]]
        wholes += there if isinstance(less, Whole) else []
        reached = sorted(reached + there, key=lambda a: a.level)
    unit = clock(problem, runs)
    for one in held(problem) if reached else []:
        if len(one.problem.orders) == 1 and reached[0].level > ABOVE_FLOOR * floor:
            # A race of one free order costs little where noise alone would leave less; bounds may leave it no lattice.
            with contextlib.suppress(ModelError):
                ended = without_history(replace(alike, problem=one.problem), floor, threads, None)[0]
                there = [one.embedded(a, problem.orders[one.order]) for a in in_reach(ended)[:FINALISTS]]
                reached = sorted(reached + laps.run(coarse, there, 1), key=lambda a: a.level)
                continue
        # Nor is it to end above what it reaches with one order known: from where it is, and from whole orders.
        near = (*distinct(reached)[:FINALISTS], *distinct(first)[:FINALISTS], *wholes)
        runners = [one.without(a, problem, unit) for a in near]
        runners = distinct(laps.run(coarse, runners, GLANCE, one.problem), same_place)[:FINALISTS]
        ended = laps.run(coarse, runners, FIRST_LAP, one.problem)
        there = [one.embedded(a, problem.orders[one.order]) for a in ended[:1]]
        reached = sorted(reached + laps.run(coarse, there, 1), key=lambda a: a.level)
    if reached and problem.structure.coupling == "measured" and problem.structure.offset != "none":
        # An offset of each run hides which of the measured signals drives: also from where it ends without.
        plain = replace(alike, problem=FreeProblem.of(replace(problem.structure, offset="none")))
        reached = sorted(reached + race(plain, floor, threads, None)[:FINALISTS], key=lambda a: a.level)
    # Those that came to the same optimum go on as one, and those that are far behind not at all.
    reached = distinct(reached)
    contenders = in_reach(reached)
    ahead = contenders[: max(FEWEST, len(reached) // RUNNERS)]
    rest, lost = contenders[len(ahead) :], reached[len(contenders) :]
    reached = laps.run(coarse, ahead, SECOND_LAP)
    if reached and reached[0].level > ABOVE_FLOOR * floor:
        # Noise alone would leave less: those behind may yet be on the way to where it does.
        rest = on_the_way(coarse, rest, laps)
        stirring, lost = stirred(coarse, lost, FAR_BEHIND * contenders[0].level, laps)
        rest += on_the_way(coarse, stirring, laps)
    reached = coarse.finer.ranked(reached + rest) + lost
    if progress is not None:
        progress(len(starts), len(starts))
    return reached, coarse


def is_rich(problem: FreeProblem) -> bool:
    """Whether an equation has several own terms of free order."""
    equations = problem.structure.equations
    return any(sum(bool(t.order.names) for t in e.terms if t.signal == e.output) > 1 for e in equations)


def with_history(
    alike: Grid, floor: float, threads: int, progress: Callable[[int, int], None] | None
) -> list[Attempt]:  # fmt: skip
    """The same of runs in motion: the terms of their history, many a run, wait for those that go on.

    What a run remembers moves most optima by less than lies between two; where it does not, the order among them is
    that of a lap with it.
    """
    few = FreeProblem.of(replace(alike.problem.structure, initial="caputo"))
    reached, coarse = without_history(replace(alike, problem=few), floor, threads, progress)
    reached, coarse = distinct(reached), replace(coarse, problem=alike.problem)
    laps = Laps(len(reached), threads, None)
    levels = [math.inf if a is None else a.level for a in laps.each(coarse, reached, 0)]
    order = sorted(range(len(reached)), key=lambda i: levels[i])
    going = [i for i in order[:FEWEST] if levels[i] <= CONTENDER * levels[order[0]]]
    ahead = coarse.finer.ranked(laps.run(coarse, [reached[i] for i in going], FIRST_LAP))
    return distinct(ahead + [reached[i] for i in sorted(order[len(going) :])])


def coarse_samples(runs: Sequence[Run]) -> int:
    """Samples of each run that starts compete on: what one run does not tell of where they lead, another does."""
    return max(COARSE_SAMPLES // len(runs), LEAST_SAMPLES)


def thinned(grid: Grid) -> Grid:
    """A grid of as many samples as starts compete on.

    Thinned until they no longer show the motion, the samples of a long record tell no start from another: then its
    first part is taken, if that moves as the whole does.
    """
    each = coarse_samples(grid.runs)
    decimation = max(1, round(min(run.length - 1 for run in grid.runs) / each))
    if decimation <= THINNEST or grid.shares is not None:
        return replace(grid, decimation=decimation)
    outputs = grid.problem.structure.outputs
    fastest = max(power_frequency(run, o) * run.step for run in grid.runs for o in outputs)
    carried = max(THINNEST, int(math.pi / (SHOWN * fastest)))
    if carried >= decimation:
        return replace(grid, decimation=decimation)
    firsts = [run.slice(None, (each * carried + 0.5) * run.step) for run in grid.runs]
    pairs = [(first[o], run[o]) for first, run in zip(firsts, grid.runs, strict=True) for o in outputs]
    if any(not np.nanstd(part) >= AS_LIVELY * np.nanstd(whole) for part, whole in pairs):
        return replace(grid, decimation=decimation)
    return replace(grid, runs=firsts, decimation=carried)


def fine_enough(
    coarse: Grid, starts: Sequence[Attempt], laps: Laps
) -> tuple[Grid, list[Attempt], list[Attempt]]:  # fmt: skip
    """A grid on which starts may compete, as far as a few tell, where others are after a glance, those after a lap.

    A stiff equation may have no stable scheme, and so no start, on a coarse grid; and a coarse grid has optima of its
    own: all start anew on the grid on which those few no longer move.
    """
    first, glanced = coarse, distinct(laps.run(coarse, starts, GLANCE), same_place)
    if len(starts) <= PIONEERS:
        return coarse, glanced, []
    before, pioneers = list[tuple[Grid, Attempt]](), glanced[:PIONEERS]
    while coarse.every < FINEST:
        reached = laps.run(coarse, pioneers, FIRST_LAP)
        if reached and not coarse.matters(reached[0]):
            break
        before += [(coarse, reached[0])] if reached else []
        coarse, pioneers = coarse.finer, reached
        if not pioneers:
            # Where none has a scheme, others may on half the step.
            pioneers = distinct(laps.run(coarse, starts, GLANCE), same_place)[:PIONEERS]
    else:
        reached = pioneers
    if coarse is first:
        return (coarse, glanced, []) if reached is pioneers else (coarse, glanced[PIONEERS:], reached)
    told = before if reached else []
    near = (grid for grid, best in told if np.allclose(best.values, reached[0].values, rtol=MOVED, atol=0.0))
    if (grid := next(near, None)) is not None:
        glanced = distinct(laps.run(grid, starts, GLANCE), same_place)
        if sum(1 + len(a.alike) for a in glanced) == len(starts):
            # This coarser grid has the same optimum, a little moved: of those that come to one place there one goes on.
            starts = distinct(laps.run(grid, glanced, FIRST_LAP))
    return coarse, distinct(laps.run(coarse, starts, GLANCE), same_place), []


def on_the_way(coarse: Grid, behind: Sequence[Attempt], laps: Laps) -> list[Attempt]:
    """Where those behind end, each for as long as it is getting on, but no longer than a second lap."""
    ended: list[Attempt] = []
    going = list(behind)
    for _ in range(SECOND_LAP // FIRST_LAP):
        further: list[Attempt] = []
        for attempt, at in zip(going, laps.each(coarse, going, FIRST_LAP), strict=True):
            if at is not None:
                (further if at.level < (1.0 - ON_THE_WAY) * attempt.level else ended).append(at)
        going = further
    return ended + going


def stirred(
    coarse: Grid, lost: Sequence[Attempt], farthest: float, laps: Laps
) -> tuple[list[Attempt], list[Attempt]]:  # fmt: skip
    """Where those no further behind are after a few evaluations that lower their cost by a share; and the others."""
    near = [a for a in lost if a.level <= farthest]
    moving: list[Attempt] = []
    still = [a for a in lost if a.level > farthest]
    for attempt, at in zip(near, laps.each(coarse, near, STIR), strict=True):
        if at is not None and at.level < (1.0 - STIRS) * attempt.level:
            moving.append(at)
        else:
            still.append(attempt)
    return moving, still


def without_vanished(problem: FreeProblem, start: Attempt, ended: Attempt) -> Attempt:
    """An attempt with coefficients at 0 that fell towards it as far as a sign that is kept lets them.

    From there they may take the other sign.
    """
    if problem.products or problem.structure.has_friction:
        return ended
    pairs = zip(start.coefficients, ended.coefficients, strict=True)
    return replace(ended, coefficients=[0.0 if abs(b) < VANISHED * abs(a) else b for a, b in pairs])


def finalists(reached: Sequence[Attempt]) -> list[Attempt]:
    """Those that go on on all samples: the best of different optima, unless they are far behind."""
    return in_reach(distinct(reached)[:FINALISTS])


def in_reach(reached: Sequence[Attempt]) -> list[Attempt]:
    """Those of attempts, best first, that are not far behind the best."""
    return [a for a in reached if a.level <= CONTENDER * reached[0].level]


def same_optimum(one: Attempt, other: Attempt) -> bool:
    """Whether two that ended cost the same at orders that are as near."""
    near = abs(one.level - other.level) <= SAME_COST * one.level
    return near and np.allclose(np.array(other.orders), one.orders, atol=SAME_PLACE)


def same_place(one: Attempt, other: Attempt) -> bool:
    """Whether two are at the same numbers, each as near as a share of itself: several lattices have the same rows."""
    return np.allclose(other.values, one.values, rtol=SAME_PLACE, atol=0.0)


def distinct(
    attempts: Sequence[Attempt], same: Callable[[Attempt, Attempt], bool] = same_optimum
) -> list[Attempt]:  # fmt: skip
    """Attempts, best first; those that are the same as an earlier one are alike to it."""
    kept: list[Attempt] = []
    for attempt in attempts:
        first = next((i for i, k in enumerate(kept) if same(k, attempt)), None)
        if first is None:
            kept.append(attempt)
        else:
            alike = (*kept[first].alike, attempt.origin, *attempt.alike)
            kept[first] = replace(kept[first], alike=alike)
    return kept
