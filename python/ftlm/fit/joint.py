"""Joint output error: all equations, all runs, continuous orders, from an automatic start to intervals.

For white measurement noise the estimate is maximum likelihood. The core minimises from a start
(Levenberg-Marquardt with an analytic Jacobian); this file finds starts, weighs outputs by their noise, refines the grid
until it no longer matters, and turns the optimum into numbers with intervals.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.errors import ConvergenceError, DataError, FtlmError
from ftlm.base.progress import Course
from ftlm.base.statistics import NORMAL_95, noise_of
from ftlm.base.tall import length
from ftlm.data.readings import read
from ftlm.data.run import Run
from ftlm.data.settings import Loss
from ftlm.data.structures import Initial, Structure
from ftlm.fit.clock import Clock
from ftlm.fit.extrapolation import feasible
from ftlm.fit.friction import race_with_friction
from ftlm.fit.grid import FINEST, Attempt, Grid
from ftlm.fit.interval import ProfileInterval
from ftlm.fit.problem import FreeProblem
from ftlm.fit.race import SAME_COST, finalists, race
from ftlm.fit.robust import Robust, huber_shares, same_shares, scales
from ftlm.fit.steady import Growth, grows, steadied
from ftlm.fit.twins import twin_words
from ftlm.fit.uncertainty import covariance, deviation
from ftlm.solve.instants import compared_values

#: Share of a fit's course at whose end the race is, and of what is left of that what each of its sweeps takes.
RACED, SWEEP = 0.5, 0.3
#: Residual that costs 1 in a coarse fit, as a share of an output's size.
COARSE_SHARE = 0.01
#: Evaluations of each finalist on all samples, and of what is left then.
FINAL_LAP = 60
LAST_LAP = 120
#: Descents to settled weights, and to those of a robust loss, which settle by a factor of some four each.
ROUNDS = 4
ROBUST_ROUNDS = 15
#: Weights are settled when no output's residuals differ from their weight by more than this share.
SETTLED = 0.01
#: Refinement ends when halving the step moves no estimate, or none extrapolated to step 0, by this share of its
#: standard error.
REFINED = 0.1
#: Logarithm of residuals by which halving the step may raise them before other starts have their way on the finer grid.
ROSE = 5e-4


@dataclass(frozen=True)
class JointFit:
    """An optimum of the joint output error.

    Parameters
    ----------
    orders, coefficients
        Free orders and free coefficients by name; under a coefficient law the free ones of the law.
    covariance
        Of orders, coefficients, then numbers of inputs, robust to coloured residuals. Variances of what takes part in
        a direction that the runs do not see are infinite, their covariances not numbers.
    noise
        Standard deviation of the residuals by output; under a robust loss from the median of their sizes.
    cost
        Half the sum of squared weighted residuals.
    samples
        Number of residuals, of samples that were read.
    refinement
        Pulses a sample interval on the finest grid; the estimates are the limit that it and the next coarser one tell.
    settled
        Whether halving the step moved no estimate by a tenth of its standard error.
    converged
        Whether the gradient of the cost vanished, but for what pushes out of a bound. False where the evaluations ran
        out, where no step lowered the cost, and where the way down led to what the grid does not carry.
    starts
        Coarse cost (per residual) and origin of every start, best first.
    residuals
        By run and output, over the noise; NaN where nothing was read.
    products
        Coefficients that the coefficient law gives: sign and factors by name.
    inputs
        Estimated delays [s] and limits of inputs by name, such as ``delay_u`` and ``sat_u``; in covariance and errors
        they stand last.
    initial, initial_terms
        Initial terms that were fitted, and how many coefficients they have on all runs together.
    robust
        What a robust loss did; None for squares.
    shares
        With which share of its weight each sample counted under it, by run, a row an output.
    on_grid
        Parameters at the optimum of the finest grid, in the order of the covariance.
    origin
        Where the fit came from, if it had no starts of its own.
    profiles
        95 % intervals by profile likelihood, of the parameters that have one.
    growth
        Where an optimum's free run grows: whether it is this one, and what one that dies away leaves beside it.
    """

    orders: dict[str, float]
    coefficients: dict[str, float]
    covariance: Floats
    noise: dict[str, float]
    cost: float
    samples: int
    refinement: int
    settled: bool
    converged: bool
    starts: list[tuple[float, str]]
    residuals: list[dict[str, Floats]]
    products: Mapping[str, tuple[float, tuple[str, ...]]] = field(default_factory=dict)
    inputs: dict[str, float] = field(default_factory=dict)
    initial: Initial = "rest"
    initial_terms: int = 0
    robust: Robust | None = None
    shares: Sequence[Floats] | None = field(default=None, repr=False)
    on_grid: Floats = field(default_factory=lambda: np.zeros(0), repr=False)
    origin: str = "the start that was given"
    profiles: Mapping[str, ProfileInterval] = field(default_factory=dict)
    growth: Growth | None = None

    @property
    def choice(self) -> str:
        """Why this optimum, in words: which start led to it, and how far behind the next other one was."""
        if not self.starts:
            return f"from {self.origin}"
        level, origin = self.starts[0]
        same = [v for v, _ in self.starts if v <= (1.0 + SAME_COST) * level]
        words = f"{len(same)} of {len(self.starts)} starts ended in the lowest optimum, first that of: {origin}"
        rest = self.starts[len(same) :]
        return words + (f"; the next costs {rest[0][0] / level:.3g} times as much" if rest and level > 0 else "")

    @property
    def derived_errors(self) -> dict[str, float]:
        """Standard errors of the coefficients that the coefficient law gives, to first order."""
        kept = slice(len(self.orders), len(self.orders) + len(self.coefficients))
        out, spread = {}, self.covariance[kept, kept]
        for name, (sign, factors) in self.products.items():
            value = sign * math.prod(self.coefficients[f] for f in factors)
            slope = np.array([factors.count(n) * value / v if v else 0.0 for n, v in self.coefficients.items()])
            out[name] = float(deviation(slope[None], spread)[0])
        return out

    @property
    def names(self) -> list[str]:
        """Parameters in the order of the covariance."""
        return [*self.orders, *self.coefficients, *self.inputs]

    @property
    def values(self) -> Floats:
        """Parameters in the order of the covariance."""
        return np.array([*self.orders.values(), *self.coefficients.values(), *self.inputs.values()])

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard error of each parameter."""
        with np.errstate(invalid="ignore"):
            return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % interval of each parameter: by profile likelihood where there is one, else ± 1.96 standard errors."""
        errors = self.standard_errors
        pairs = zip(self.names, self.values.tolist(), strict=True)
        quadratic = {n: (v - NORMAL_95 * errors[n], v + NORMAL_95 * errors[n]) for n, v in pairs}
        return {**quadratic, **{n: (p.low, p.high) for n, p in self.profiles.items()}}

    @property
    def correlation(self) -> Floats:
        """Correlation matrix of the parameters; not a number where a variance is 0 or not finite."""
        with np.errstate(divide="ignore", invalid="ignore"):
            spread = np.sqrt(np.diag(self.covariance))
            scaled: Floats = self.covariance / np.outer(spread, spread)
        return scaled


@dataclass(frozen=True)
class Race:
    """Where starts got on thinned samples, best first: fits of the same structure to the same runs go on from there."""

    reached: Sequence[Attempt]


@dataclass(frozen=True)
class Outset:
    """What is known before a first descent: the problem on its runs, and the size of each output."""

    problem: FreeProblem
    runs: Sequence[Run]
    sizes: Sequence[float]

    @classmethod
    def of(cls, runs: Sequence[Run], structure: Structure) -> Outset:
        """Of runs that tell the free numbers of a structure; the errors are those of :func:`fit_output_error`."""
        problem, outputs = FreeProblem.of(structure), structure.outputs
        samples = sum(max(read(compared_values(run, structure, o)).size - 2, 0) for run in runs for o in outputs)
        if samples <= len(problem.names):
            raise DataError(
                f"{samples} samples between the first and the last do not tell {len(problem.names)} free numbers; use "
                "longer runs, or fix orders or coefficients"
            )
        sizes = [math.sqrt(float(np.mean([np.nanvar(run[o]) for run in runs]))) for o in outputs]
        return cls(problem, runs, sizes)

    @cached_property
    def noise(self) -> list[float]:
        """A first guess of each output's."""
        structure = self.problem.structure
        outputs = zip(structure.outputs, self.sizes, strict=True)
        return [first_noise(self.runs, structure, output, size) for output, size in outputs]

    @property
    def alike(self) -> Grid:
        """Every output weighing alike: noise decides where the optimum is, not how to get near it."""
        return Grid(self.problem, self.runs, [1.0 / (COARSE_SHARE * size) for size in self.sizes])

    @property
    def weighed(self) -> Grid:
        """Every output weighed by its noise."""
        return Grid(self.problem, self.runs, [1.0 / noise for noise in self.noise])

    def race(self, threads: int, progress: Callable[[int, int], None] | None) -> Race:
        """Where the starts of this problem get."""
        shares = [noise / (COARSE_SHARE * size) for noise, size in zip(self.noise, self.sizes, strict=True)]
        runners = race_with_friction if self.problem.structure.has_friction else race
        return Race(runners(self.alike, float(np.mean([share**2 for share in shares])), threads, progress))


def fit_output_error(
    runs: Sequence[Run], structure: Structure, *, threads: int = 1, start: Mapping[str, float] | None = None,
    refine: bool = True, progress: Callable[[int, int], None] | None = None, loss: Loss = "squares",
    known: Sequence[Mapping[str, float]] = (), near: JointFit | None = None, raced: Race | None = None,
) -> JointFit:  # fmt: skip
    """Fit all equations of a structure on all runs by output error, from an automatic start.

    A coefficient law that the structure states is imposed; its initial terms must be decided. A start gives values of
    everything free by name, and is the only one; known ones stand beside the automatic ones; `near` is a fit of the
    same structure to nearly the same runs, to go on from on its grid and with its weights; `raced` is the race of its
    starts where that was run already. Without `refine` the grid is not refined below the samples. Progress is told
    (starts done, starts in all). The loss decides between optima on all samples, not between starts.

    Raises
    ------
    DataError
        Fewer samples than free numbers.
    ConvergenceError
        No start has a finite free run, or one whose squares are numbers.
    """
    outset = Outset.of(runs, structure)
    problem, outputs = outset.problem, structure.outputs
    if near is not None:
        attempt = given(problem, dict(zip(near.names, near.values.tolist(), strict=True)))
        grid = Grid(problem, runs, [1.0 / max(near.noise[o], 1e-300) for o in outputs], near.refinement)
        return ended(*with_settled_weights(attempt, grid, loss), raced.reached if raced else (), loss, refine=refine)
    course = Course(progress)
    reached: Sequence[Attempt] = ()
    if start is None:
        reached = (raced or outset.race(threads, course.until(RACED, SWEEP))).reached
        contenders = finalists(reached) if reached else []
        contenders += [given(problem, values) for values in known]
    else:
        contenders = [given(problem, start)]
    if not contenders:
        why = twin_words(runs, structure) or "check the signs of the data and the bounds"
        raise ConvergenceError(f"no start of {', '.join(outputs)} has a finite free run; {why}")
    course.at(RACED)
    weighed = outset.weighed
    # Where a step passes faster than the samples see, a grid as coarse as the samples has an optimum of its own.
    while weighed.every < FINEST and weighed.matters(contenders[0]):
        weighed = weighed.finer
    best = winner(contenders, replace(outset.alike, every=weighed.every))
    if len(outputs) > 1:
        # Of one output the noise does not move the optimum.
        best = weighed.descend(best, LAST_LAP)
    course.at(0.65)
    best, weighed = with_settled_weights(best, weighed, loss)
    course.at(0.75)
    fit = ended(best, weighed, reached, loss, refine=refine)
    course.at(1.0)
    return fit


def ended(best: Attempt, grid: Grid, reached: Sequence[Attempt], loss: Loss, *, refine: bool) -> JointFit:
    """What a fit comes to whose weights have settled: one that dies away where it may, on grids fine enough."""
    best, grid, growth = steadied(best, grid, reached)
    if growth is not None and not growth.kept:
        best, grid = with_settled_weights(best, grid, loss)
    others = finalists(reached) if reached else ()
    optimum = refined(best, grid, loss, others) if refine else Optimum(best, grid, best.values, settled=True)
    starts = [(a.level, origin) for a in reached for origin in (a.origin, *a.alike)]
    return replace(joint_fit(optimum, starts), growth=growth)


def given(problem: FreeProblem, values: Mapping[str, float]) -> Attempt:
    """A start by name."""
    orders, coefficients, inputs = problem.split([values[n] for n in problem.names])
    return Attempt(orders, coefficients, "given start", {}, inputs)


def first_noise(runs: Sequence[Run], structure: Structure, output: str, size: float) -> float:
    """A first guess of an output's noise, from second differences, but not below a share of its size."""
    return max(float(np.median([noise_of(compared_values(run, structure, output)) for run in runs])), 1e-3 * size)


def winner(contenders: Sequence[Attempt], near: Grid) -> Attempt:
    """The best of the contenders on all samples, every output still weighing alike."""
    ends = []
    for attempt in contenders:
        try:
            ends.append(near.descend(attempt, FINAL_LAP))
        except FtlmError:
            # No finite free run on this grid; the others have one.
            if attempt is contenders[-1] and not ends:
                raise
    best = near.finer.ranked(ends)[0] if len(ends) > 1 else ends[0]
    # In logarithms it had its lap.
    return near.lowest(best, FINAL_LAP, ended=True)


def with_settled_weights(attempt: Attempt, grid: Grid, loss: Loss = "squares") -> tuple[Attempt, Grid]:
    """Descend on a grid until the weights are those of the residuals, pooled over runs, and so are robust shares."""
    last = (ROBUST_ROUNDS if loss == "huber" else ROUNDS) - 1
    for turn in range(last + 1):
        attempt = grid.descend(attempt, LAST_LAP, plain=True)
        levels = scales(grid, attempt) if loss == "huber" else grid.levels(attempt)
        beyond = [o for o, level in levels.items() if not math.isfinite(level)]
        if beyond:
            raise ConvergenceError(
                f"wherever it starts, the free run of {beyond[0]} ends beyond the range of numbers: it grows; leave "
                "out the term that pushes, or bound its coefficient"
            )
        settled = all(abs(v - 1.0) < SETTLED for v in levels.values())
        shares = huber_shares(grid, attempt, levels) if loss == "huber" else None
        if turn == last or (settled and same_shares(grid.shares, shares)):
            break
        weights = [w / max(level, 1e-300) for w, level in zip(grid.weights, levels.values(), strict=True)]
        grid = replace(grid, weights=weights, shares=shares)
    return attempt, grid


@dataclass(frozen=True)
class Optimum:
    """Where a fit ended on its finest grid, and its estimate at step 0."""

    attempt: Attempt
    grid: Grid
    estimate: Floats
    settled: bool


def refined(best: Attempt, grid: Grid, loss: Loss = "squares", others: Sequence[Attempt] = ()) -> Optimum:
    """Halve the step until that moves the estimate by little of its standard error.

    A coarse grid may lead along a flat valley to where equations end, and there a finer one leads nowhere: then others
    have their way on it as well.
    """
    estimate, settled = best.values, False
    clock = Clock.of(grid.problem, grid.runs)
    before: Attempt | None = None
    while not settled and grid.every < FINEST:
        # On a finer grid residuals may shrink to their noise, so weights follow anew.
        try:
            finer, fine_grid = with_settled_weights(expected(grid.problem, clock, best, before), grid.finer, loss)
        except FtlmError:
            # Where two grids point there may be no free run.
            finer, fine_grid = with_settled_weights(best, grid.finer, loss)
        rose = likelihood(finer, fine_grid) > likelihood(best, grid) + ROSE
        if (finer.outcome["status"] == "wall" and before is None) or (rose and others):
            other, fine_grid = freed(finer, fine_grid, others, loss)
            # They have had their way.
            others = ()
            if other is not finer:
                # Two grids have two optima, of which they tell nothing together.
                before, best, estimate, grid = None, other, other.values, fine_grid
                continue
        grid = fine_grid
        errors = clock.errors(finer.values, covariance(finer, grid))
        # The scheme is of second order, so two grids tell the limit (Richardson); a third tells whether that is so.
        # Of a flat valley in which neither stood still, or of two fits that a wall stopped, they tell nothing.
        still = finer.converged and best.converged
        limit = finer.values
        if still:
            fine, coarse = clock.told(finer.values), clock.told(best.values)
            limit = clock.untold(feasible(grid.problem, fine, fine + (fine - coarse) / 3.0))
        ways = (limit, estimate), (finer.values, best.values)
        moved = [np.abs(clock.told(one) - clock.told(other)) for one, other in ways]
        settled = any(bool(np.all(way <= REFINED * errors)) for way in moved)
        before, best, estimate = best, finer, limit
    return Optimum(best, grid, nearer(best, grid, estimate, clock, settled=settled), settled)


def freed(stuck: Attempt, grid: Grid, others: Sequence[Attempt], loss: Loss) -> tuple[Attempt, Grid]:
    """What an attempt that a wall stopped came to, or another one on its grid if that leaves less."""
    best, least = (stuck, grid), likelihood(stuck, grid)
    for other in others:
        try:
            there = with_settled_weights(other, grid, loss)
        except FtlmError:
            continue
        if likelihood(*there) < least and not (grid.steady and grows(grid.problem, there[0])):
            best, least = there, likelihood(*there)
    return best


def likelihood(attempt: Attempt, grid: Grid) -> float:
    """Minus the logarithm of the likelihood per sample, but for a constant."""
    levels = grid.levels(attempt).values()
    return math.fsum(math.log(max(level, 1e-300) / w) for level, w in zip(levels, grid.weights, strict=True))


def expected(problem: FreeProblem, clock: Clock, best: Attempt, before: Attempt | None) -> Attempt:
    """Where to begin on half the step: what moved the optimum from the last grid to this moves it a quarter as far."""
    if before is None or not (best.converged and before.converged):
        return best
    fine, coarse = clock.told(best.values), clock.told(before.values)
    return at_values(best, problem, clock.untold(feasible(problem, fine, fine + (fine - coarse) / 4.0)))


def at_values(attempt: Attempt, problem: FreeProblem, values: Floats) -> Attempt:
    """An attempt at other values."""
    orders, coefficients, inputs = problem.split(values.tolist())
    return replace(attempt, orders=orders, coefficients=coefficients, inputs=inputs)


def nearer(best: Attempt, grid: Grid, limit: Floats, clock: Clock, *, settled: bool) -> Floats:
    """What is nearer to the truth on half the step, the limit that two grids tell or the optimum of the finer one.

    Along the bottom of a flat and curved valley, where numbers cannot be told apart, a straight line leads out of it.
    Where the residuals follow it there is none, and a limit on which grids agree is nearer.
    """
    columns = np.asarray(best.outcome["jacobian"]).T
    way = clock.step(best.values, clock.told(limit) - clock.told(best.values))
    if float(np.sum((columns @ way) ** 2)) <= REFINED**2:
        # Both leave the same.
        return limit
    ahead = at_values(best, grid.problem, limit)
    if settled:
        with contextlib.suppress(FtlmError):
            told = np.asarray(best.outcome["residuals"]) + columns @ way
            bent = length(np.asarray(grid.evaluated(ahead).outcome["residuals"]) - told)
            if bent <= REFINED * length(columns @ way):
                return limit
    costs = []
    for attempt in (ahead, best):
        try:
            costs.append(float(grid.finer.evaluated(attempt).outcome["cost"]))
        except FtlmError:
            # No finite free run there.
            costs.append(math.inf)
    return limit if costs[0] <= costs[1] else best.values


def joint_fit(optimum: Optimum, starts: list[tuple[float, str]]) -> JointFit:
    """The optimum with its covariance, its noise and its residuals."""
    best, grid = optimum.attempt, optimum.grid
    problem = grid.problem
    low, high = np.array(problem.all_bounds).T
    orders, coefficients, inputs = problem.split(np.clip(optimum.estimate, low, high).tolist())
    levels = grid.levels(best) if grid.shares is None else scales(grid, best)
    residuals = grid.residuals(best)
    return JointFit(
        orders=dict(zip(problem.orders, orders, strict=True)),
        coefficients=dict(zip(problem.coefficients, coefficients, strict=True)),
        inputs=dict(zip((item.name for item in problem.inputs), inputs, strict=True)), products=dict(problem.products),
        covariance=covariance(best, grid), residuals=residuals,
        robust=None if grid.shares is None else Robust.of(grid, best), shares=grid.shares, on_grid=best.values,
        noise={o: level / w for (o, level), w in zip(levels.items(), grid.weights, strict=True)},
        cost=float(best.outcome["cost"]), samples=sum(read(e).size for part in residuals for e in part.values()),
        refinement=grid.every,
        settled=optimum.settled, converged=best.converged, starts=starts, initial=problem.structure.initial,
        initial_terms=sum(len(x) for run in best.outcome["initial"] for x in run),
    )  # fmt: skip
