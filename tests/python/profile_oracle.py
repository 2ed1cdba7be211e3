"""The program's former profile likelihood in NumPy: the oracle of the core's.

At each value of one parameter all others are refitted. The interval holds the values at which the cost rises by no more
than the noise explains (Venzon & Moolgavkar, doi:10.2307/2347496; Raue et al., doi:10.1093/bioinformatics/btp358).
"""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np

from ftlm.data.run import Run
from ftlm.errors import FtlmError, ModelError
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Iterate, Objective, covariance, covariance_of
from ftlm.estimation.output_error import JointFit, ProfileInterval
from ftlm.estimation.result import Identification
from ftlm.utils.linalg import dot, projections, thin_svd
from ftlm.utils.parameters import parameter
from ftlm.utils.resources import interruptible_pool
from ftlm.utils.validation import Floats

#: Largest relative error of a bound of the Wald interval, from one linear step of all other parameters. Above it the
#: parameter is profiled.
MAX_QUADRATIC_ERROR = 0.1
#: A bound is found if the root of the rise is within RISE_TOLERANCE of its threshold and Newton's next step is shorter
#: than BOUND_TOLERANCE times the distance from the optimum.
RISE_TOLERANCE = 0.1
BOUND_TOLERANCE = 0.02
#: Half the refinement is enough if it moves the optimum by less than this many standard errors, or less than this
#: fraction of each parameter.
MAX_OPTIMUM_SHIFT_ERRORS, MAX_OPTIMUM_SHIFT_RATIO = 2.0, 1e-3
#: Maximum number of evaluations of one refit, and of refits for one bound.
MAX_REFIT_EVALUATIONS = 120
MAX_REFITS_PER_BOUND = 40
#: Smallest budget of simulations with which the search for a bound continues.
MIN_BUDGET_PER_BOUND = 10
#: Largest distance of a bound, in half-widths of the Wald interval. Beyond it the interval is unbounded.
MAX_BOUND_DISTANCE = 1e3
#: The first step is the Wald half-width or the value itself, but at least MIN_FIRST_STEP_RATIO times the former. A
#: bracket is narrow if its width is BOUND_TOLERANCE of the value inside it, or of BRACKET_SCALE_RATIO times the
#: distance.
MIN_FIRST_STEP_RATIO = 0.01
BRACKET_SCALE_RATIO = 0.1
#: Smallest and largest factor by which the distance from the optimum grows in one step.
MIN_STEP_FACTOR, MAX_STEP_FACTOR = 1.1, 4.0
#: Tolerance of a refit as a fraction of the threshold, and the cost decrease that indicates another optimum.
REFIT_TOLERANCE = 1e-4
LOWER_OPTIMUM_MARGIN = 0.02
#: If a step moves another parameter by more than this fraction, power laws are tried as well, with exponents up to
#: this.
POWER_LAW_MOVE_RATIO, MAX_POWER_LAW_EXPONENT = 0.3, 4.0
#: The cost levels off if its root rises by at most this fraction of the last rise and stays this far below the
#: threshold.
LEVELING_RATIO, LEVELING_MARGIN = 0.5, 0.05
#: A lower optimum is reported if the sum of squares falls by more than this fraction of one standard error's rise.
MIN_COST_REDUCTION = 0.1
#: Largest number of lower optima from which the search continues.
MAX_LOWER_OPTIMA = 5
#: Relative singular value below which a direction of the other parameters has no effect.
SINGULAR_VALUE_TOLERANCE = 1e-12


class _LowerOptimumError(Exception):
    """Refit with a cost below that of the optimum."""

    def __init__(self, attempt: Iterate) -> None:
        super().__init__()
        self.attempt = attempt
        self.evaluations = int(attempt.outcome["evaluations"])


@dataclass(frozen=True)
class ProfileLikelihood:
    """Cost of a joint fit around its optimum, on its finest grid.

    Parameters
    ----------
    grid, best
        Objective with weights from the residuals, and its optimum.
    shift
        Difference between the estimate, extrapolated to step 0, and this optimum.
    bread
        Inverse of the Hessian of the cost.
    errors, units
        Standard errors, and the rise of the sum of squares at one standard error: the noise variance, widened for
        colored residuals, so that a parabola gives the Wald interval.
    """

    grid: Objective
    best: Iterate
    shift: Floats
    bread: Floats
    errors: Floats
    units: Floats

    @classmethod
    def of(cls, joint: JointFit, problem: FreeProblem, runs: Sequence[Run]) -> ProfileLikelihood:
        """Return the profile likelihood around the optimum of a fit."""
        weights = [1.0 / max(joint.noise[o], 1e-300) for o in problem.structure.outputs]
        # Where a growing optimum was left, its valley is not this one.
        steady = joint.unstable_optimum is not None and not joint.unstable_optimum.is_accepted
        grid = Objective(
            problem, runs, weights, joint.refinement, robust_weights=joint.robust_weights, prefer_stable=steady
        )
        if joint.step_converged and joint.refinement > 1:
            # Half as fine a grid moved the optimum by less than its errors, and how steep it is by less still.
            with contextlib.suppress(FtlmError):
                coarse = replace(grid, pulses_per_sample=joint.refinement // 2)
                likelihood = cls.at(coarse, joint.finest_grid_values, np.zeros(len(problem.names)))
                near = np.maximum(
                    MAX_OPTIMUM_SHIFT_ERRORS * likelihood.errors,
                    MAX_OPTIMUM_SHIFT_RATIO * np.abs(joint.finest_grid_values),
                )
                if likelihood.best.has_converged and np.all(
                    np.abs(likelihood.best.values - joint.finest_grid_values) <= near
                ):
                    return replace(likelihood, shift=joint.values - likelihood.best.values)
        return cls.at(grid, joint.finest_grid_values, joint.values - joint.finest_grid_values)

    @classmethod
    def at(cls, grid: Objective, values: Floats, shift: Floats) -> ProfileLikelihood:
        """Return the profile likelihood around the optimum reached from a point."""
        best = grid.minimize(_attempt(grid, values), MAX_REFIT_EVALUATIONS, linear_scale=True)
        bread = covariance_of(np.asarray(best.outcome["jacobian"]), [], 1.0)
        spread = np.diag(covariance(best, grid))
        with np.errstate(invalid="ignore", divide="ignore"):
            return cls(grid, best, shift, bread, np.sqrt(spread), spread / np.diag(bread))

    @property
    def names(self) -> list[str]:
        """Names of all free parameters."""
        return self.grid.problem.names

    def is_identifiable(self, i: int) -> bool:
        """Whether the data determine a parameter at all."""
        return bool(0 < self.errors[i] < math.inf and 0 < self.units[i] < math.inf)

    def rise(self, i: int, squares: float) -> float:
        """Return the rise of a sum of squares above the optimum, in standard deviations."""
        return math.sqrt(max(squares - 2.0 * float(self.best.outcome["cost"]), 0.0) / float(self.units[i]))

    def nonlinearity(self, i: int, width: float) -> float:
        """Return the relative error of the Wald interval of a parameter, from one evaluation at each bound.

        Each bound is moved along the conditional optimum, and all other parameters follow by one linear step. Infinite
        if a bound violates a constraint or its simulation is not finite.
        """
        if not self.is_identifiable(i):
            return 0.0
        worst = 0.0
        for side in (-1.0, 1.0):
            ends = self.best.values
            ends[i] += side * width * self.errors[i]
            low, high = self.grid.problem.all_bounds[i]
            if not low <= ends[i] <= high:
                return math.inf
            try:
                there = self._evaluate(i, self._point_along(i, self.best.values, self.bread[:, i], float(ends[i])))
            except FtlmError:
                return math.inf
            residuals = _projected_residuals(there, i)
            with np.errstate(over="ignore"):
                worst = max(worst, abs(self.rise(i, dot(residuals, residuals)) / width - 1.0))
        return worst

    def search_bound(self, i: int, side: float, width: float, stop: threading.Event | None = None) -> BoundSearch:
        """Search one bound of the interval of a parameter by a bracketed Newton method.

        A generator: it receives the total budget of simulations, yields the number used whenever the budget is
        exhausted, and returns the bound. At a refit the slope of the cost along the parameter is the slope of the
        profile. The root of its rise is linear if the cost is a parabola, so one refit then suffices.
        """
        start, sigma = float(self.best.values[i]), float(self.errors[i])
        limit = self.grid.problem.all_bounds[i][0 if side < 0 else 1]
        # In a valley without end standard errors are no measure of it.
        first = min(sigma * width, max(abs(start), MIN_FIRST_STEP_RATIO * sigma * width))
        farthest = min(MAX_BOUND_DISTANCE * first, abs(limit - start))
        within, inside, outside = self.best, 0.0, math.inf
        way, points, evaluations = min(first, farthest), [], 0
        reached, gained = 0.0, math.inf
        allowed = yield 0
        for _ in range(MAX_REFITS_PER_BOUND):
            if not way > inside:
                break
            if stop is not None and stop.is_set():
                raise KeyboardInterrupt
            origin = within
            while True:
                lap = max(min(MAX_REFIT_EVALUATIONS, allowed - evaluations), 0)
                try:
                    there, following = self.refit(i, start + side * way, origin, lap) if lap > 0 else None, math.inf
                except _LowerOptimumError as lower:
                    lower.evaluations += evaluations
                    raise
                took = lap if there is None else int(there.outcome["evaluations"])
                evaluations += took
                if lap == MAX_REFIT_EVALUATIONS or took < lap:
                    break
                # Cut short, a refit tells nothing, and goes on from where it was.
                origin = there or origin
                allowed = yield evaluations
            rise, near = math.inf, False
            if there is not None:
                rise = self.rise(i, 2.0 * float(there.outcome["cost"]))
                points.append((start + side * way + float(self.shift[i]), rise**2))
                slope = side * _slope(there, i) / (float(self.units[i]) * rise) if rise > 0 else 0.0
                following = way + (width - rise) / slope if slope > 0 else math.inf
                near = abs(rise / width - 1.0) <= RISE_TOLERANCE
                if near and abs(following - way) <= BOUND_TOLERANCE * way and inside < following <= farthest:
                    return IntervalBound(start + side * following, points, evaluations)
            if there is None or rise > width:
                if way >= outside:
                    # Followed closely, it is out as well: the profile jumps here, or the free run ends.
                    break
                outside = way
            else:
                inside, within = way, there
                if way >= outside:
                    # What stood for the outside was a refit that had lost its way.
                    outside = math.inf
                if way >= farthest:
                    break
            closed = math.isfinite(outside)
            size = max(min(outside, abs(start + side * inside)), BRACKET_SCALE_RATIO * outside) if closed else 0.0
            narrow = closed and outside - inside <= BOUND_TOLERANCE * size
            if near and not narrow and inside < following < min(outside, farthest):
                # Newton's next step is worth more there than one of a size given beforehand.
                way = following
            elif not closed:
                gain, reached = rise - reached, rise
                if (
                    gain <= LEVELING_RATIO * gained
                    and rise + gain < (1.0 - LEVELING_MARGIN) * width
                    and way > MAX_STEP_FACTOR * first
                ):
                    break
                gained = gain
                way = min(max(following, MIN_STEP_FACTOR * way), MAX_STEP_FACTOR * way, farthest)
            elif narrow:
                way = outside
            else:
                margin = 0.05 * (outside - inside)
                following = (
                    following if inside < following < outside else _bracket_midpoint(start, side, inside, outside)
                )
                way = min(max(following, inside + margin), outside - margin)
        # An end between two points of which the outer one has a cost; else the cost never rose that far.
        is_bounded = math.isfinite(outside) and any(r >= width**2 for _, r in points)
        return IntervalBound(start + side * outside if is_bounded else side * math.inf, points, evaluations)

    def refit(self, i: int, value: float, near: Iterate, lap: int = MAX_REFIT_EVALUATIONS) -> Iterate | None:
        """Refit all other parameters at a value of one, from a nearby point; None if none is feasible.

        Raises
        ------
        _LowerOptimumError
            The cost is below that of the optimum.
        """
        rise = float(self.units[i])
        least = 2.0 * float(self.best.outcome["cost"])
        for point in self._refit_starts(i, value, near):
            try:
                there = self._minimize(i, point, lap, REFIT_TOLERANCE * rise / max(least, rise))
            except FtlmError:
                continue
            if 2.0 * float(there.outcome["cost"]) < least - LOWER_OPTIMUM_MARGIN * rise:
                raise _LowerOptimumError(there)
            return there
        return None

    def _refit_starts(self, i: int, value: float, near: Iterate) -> list[Floats]:
        """Return initial guesses of the other parameters at a value of one, most promising first.

        Along the tangent; if that moves them far, also along power laws, for all parameters or for the orders only.
        Unbounded valleys often have the form d mu = const, d + a = const.
        """
        values, tangent = near.values, _tangent(near, i)
        orders = len(self.grid.problem.orders)
        still = self._point_along(i, values, np.zeros_like(tangent), value)
        points = [self._point_along(i, values, tangent, value), still]
        # Of numbers that nothing tells a tangent has no end; a point there is none, and has no cost.
        with np.errstate(over="ignore", invalid="ignore"):
            moves = np.abs(tangent * (value - values[i])) > POWER_LAW_MOVE_RATIO * np.abs(values)
            if value * values[i] > 0 and moves.any():
                powers = tangent * values[i] / np.where(values, values, 1.0)
                power = values * (value / values[i]) ** np.clip(powers, -MAX_POWER_LAW_EXPONENT, MAX_POWER_LAW_EXPONENT)
                mixed = np.where(np.arange(values.size) < orders, power, values + tangent * (value - values[i]))
                for towards in (power, mixed):
                    towards[i] = value
                    points.append(self._point_along(i, values, towards - values, value))
        return sorted(points, key=lambda p: self._cost(i, p)) if len(points) > 2 else points

    def _cost(self, i: int, values: Floats) -> float:
        """Return the cost at a point; infinite if the simulation is not finite."""
        try:
            return float(self._minimize(i, values, 0, REFIT_TOLERANCE).outcome["cost"])
        except FtlmError:
            return math.inf

    def _point_along(self, i: int, values: Floats, direction: Floats, value: float) -> Floats:
        """Return a point with a given value of one parameter, the others moved as far as feasible."""
        at = values.copy()
        at[i] = value
        if not direction[i]:
            return at
        with np.errstate(over="ignore", invalid="ignore"):
            towards = values + direction / direction[i] * (value - values[i])
        towards[i] = value
        point = self.grid.problem.feasible_point(at, towards)
        point[i] = value
        return point

    def _evaluate(self, i: int, values: Floats) -> Iterate:
        return self._minimize(i, values, 1, REFIT_TOLERANCE)

    def _minimize(self, i: int, values: Floats, evaluations: int, tolerance: float) -> Iterate:
        return self.grid.minimize(
            _attempt(self.grid, values), evaluations, linear_scale=True, fixed=i, tolerance=tolerance
        )


#: A search for an end: it yields the free runs it took, is sent how many it may have taken, and returns the end.
BoundSearch = Generator[int, int, "IntervalBound"]


@dataclass(frozen=True)
class IntervalBound:
    """Bound of an interval: value on the grid, evaluated points and number of simulations."""

    value: float
    points: list[tuple[float, float]]
    evaluations: int


@dataclass(frozen=True)
class ProfileResult:
    """Profile-likelihood intervals, and any lower optimum found on the way.

    Parameters
    ----------
    intervals
        Intervals by name.
    lower_optimum
        Parameters of an optimum with a lower cost than the fit; None if there is no significantly lower one.
    incomplete_names
        Parameters whose profile needed more simulations than allowed.
    evaluations
        Total number of simulations.
    """

    intervals: dict[str, ProfileInterval]
    lower_optimum: Floats | None = None
    incomplete_names: tuple[str, ...] = ()
    evaluations: int = 0


def profile_intervals(
    valley: ProfileLikelihood,
    names: Sequence[str],
    level: float,
    *,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
    most: int | None = None,
) -> ProfileResult:
    """Compute profile-likelihood intervals of some parameters of a fit.

    Each bound is searched from the optimum independently, so results do not depend on the number of threads. A
    parameter that the data do not determine has the whole line as its interval.

    Parameters
    ----------
    valley
        Profile likelihood around the optimum.
    names
        Parameter names.
    level
        Probability between 0 and 1.
    threads, progress
        Number of threads, and a callback with (bounds found, total bounds).
    most
        Budget of simulations for all bounds, including those of lower optima; None for no limit. It is distributed
        evenly, and the unused part goes to the bounds that are not found yet.

    Raises
    ------
    KeyboardInterrupt
        Ctrl-C, within one refit.
    """
    start, evaluations = valley, 0
    for _ in range(MAX_LOWER_OPTIMA):
        ends, took = _search_bounds(
            valley, names, level, threads, progress, None if most is None else most - evaluations
        )
        evaluations += took
        below = [e.attempt for e in ends.values() if isinstance(e, _LowerOptimumError)]
        if not below:
            break
        # What was the limit for step 0 of another optimum is none of this one.
        valley = ProfileLikelihood.at(valley.grid, below[0].values, np.zeros_like(valley.shift))
    fall = 2.0 * (float(start.best.outcome["cost"]) - float(valley.best.outcome["cost"]))
    finite = valley.units[np.isfinite(valley.units)]
    lower = valley.best.values if finite.size and fall > MIN_COST_REDUCTION * float(np.median(finite)) else None
    intervals: dict[str, ProfileInterval] = {}
    remaining = tuple(n for n in names if any(ends.get((n, side), 0) is None for side in (-1.0, 1.0)))
    for name in (n for n in names if n not in remaining):
        both = [e for e in (ends.get((name, side)) for side in (-1.0, 1.0)) if isinstance(e, IntervalBound)]
        if len(both) < 2:
            intervals[name] = ProfileInterval(-math.inf, math.inf, level)
            continue
        i = valley.names.index(name)
        first, last = valley.grid.problem.all_bounds[i]
        low, high = (e.value + float(valley.shift[i]) for e in both)
        low, high = (min(max(v, first), last) if math.isfinite(v) else v for v in (low, high))
        points = tuple(sorted([*both[0].points, *both[1].points]))
        intervals[name] = ProfileInterval(low, high, level, points, sum(e.evaluations for e in both))
    return ProfileResult(intervals, lower, remaining, evaluations)


def _search_bounds(
    valley: ProfileLikelihood,
    names: Sequence[str],
    level: float,
    threads: int,
    progress: Callable[[int, int], None] | None,
    most: int | None,
) -> tuple[dict[tuple[str, float], IntervalBound | _LowerOptimumError | None], int]:
    """Search both bounds of every identifiable parameter; return them and the number of simulations.

    The search stops at the first lower optimum, because the other bounds would belong to the wrong optimum.
    """
    width, stop = half_width(level), threading.Event()
    tasks = [(n, side) for n in names if valley.is_identifiable(valley.names.index(n)) for side in (-1.0, 1.0)]
    searches = {one: valley.search_bound(valley.names.index(one[0]), one[1], width, stop) for one in tasks}
    for search in searches.values():
        next(search)

    def continue_search(one: tuple[str, float], allowed: int) -> int | IntervalBound | _LowerOptimumError:
        try:
            return searches[one].send(allowed)
        except StopIteration as found:
            end: IntervalBound = found.value
            return end
        except _LowerOptimumError as lower:
            return lower

    out: dict[tuple[str, float], IntervalBound | _LowerOptimumError | None] = dict.fromkeys(tasks)
    took = dict.fromkeys(tasks, 0)
    remaining = tasks
    with interruptible_pool(max(threads, 1)) as workers:
        try:
            while remaining:
                share = (
                    MAX_REFIT_EVALUATIONS * MAX_REFITS_PER_BOUND * 2
                    if most is None
                    else (most - sum(took.values())) // len(remaining)
                )
                if share < MIN_BUDGET_PER_BOUND:
                    break
                # In whole rounds, so that what an end may take does not depend on the number of threads.
                allowed = [took[o] + share for o in remaining]
                asked_now = [
                    workers.submit(continue_search, one, most_now)
                    for one, most_now in zip(remaining, allowed, strict=True)
                ]
                for one, future in zip(remaining, asked_now, strict=True):
                    result = future.result()
                    if isinstance(result, int):
                        took[one] = result
                        continue
                    out[one], took[one] = result, result.evaluations
                    if isinstance(result, _LowerOptimumError):
                        stop.set()
                        workers.shutdown(cancel_futures=True)
                        return out, sum(took.values())
                    if progress is not None:
                        progress(sum(e is not None for e in out.values()), len(tasks))
                remaining = [o for o in remaining if out[o] is None]
        except BaseException:
            stop.set()
            raise
    return out, sum(took.values())


def nonlinear_parameters(valley: ProfileLikelihood, level: float) -> list[str]:
    """Return the parameters whose Wald interval is inaccurate, from two evaluations each."""
    width = half_width(level)
    return [n for i, n in enumerate(valley.names) if valley.nonlinearity(i, width) > MAX_QUADRATIC_ERROR]


def half_width(level: float) -> float:
    """Return the half-width of an interval of this probability, in standard deviations."""
    return NormalDist().inv_cdf(0.5 + 0.5 * level)


def _attempt(grid: Objective, values: Floats) -> Iterate:
    orders, coefficients, inputs = grid.problem.split(values.tolist())
    return Iterate(orders, coefficients, "profile", {}, inputs)


def _bracket_midpoint(start: float, side: float, inside: float, outside: float) -> float:
    """Return the midpoint of a bracket; geometric if both values have the same sign."""
    near, far = start + side * inside, start + side * outside
    if near * far > 0:
        return side * (math.copysign(math.sqrt(near * far), near) - start)
    return 0.5 * (inside + outside)


def _slope(attempt: Iterate, i: int) -> float:
    """Return half the derivative of the sum of squares by one parameter; 0 on overflow."""
    # Near where a free run has no value its derivatives overflow: they tell no step.
    with np.errstate(over="ignore", invalid="ignore"):
        slope = dot(np.asarray(attempt.outcome["jacobian"])[i], np.asarray(attempt.outcome["residuals"]))
    return slope if math.isfinite(slope) else 0.0


def _other_sensitivities(attempt: Iterate, i: int) -> tuple[Any, Floats]:
    """Return the SVD of the other parameters' sensitivities (unit rows), and the row norms."""
    others = np.delete(np.asarray(attempt.outcome["jacobian"]), i, axis=0)
    # Far out, sensitivities may be so large that their squares are not numbers.
    length = np.abs(others).max(axis=1, initial=0.0)
    length = np.where(length > 0, length, 1.0)
    length = length * np.maximum(np.linalg.norm(others / length[:, None], axis=1), 1.0)
    tall, sizes, square = thin_svd((others / length[:, None]).T)
    is_significant = sizes > SINGULAR_VALUE_TOLERANCE * sizes.max(initial=0.0)
    return (square.T[:, is_significant], sizes[is_significant], tall.T[is_significant]), length


def _projected_residuals(attempt: Iterate, i: int) -> Floats:
    """Return the residuals after one linear step of all other parameters."""
    residuals = np.asarray(attempt.outcome["residuals"])
    (_, _, right), _ = _other_sensitivities(attempt, i)
    return np.asarray(residuals - right.T @ projections(right.T, residuals))


def _tangent(attempt: Iterate, i: int) -> Floats:
    """Return the direction of all parameters along the profile when one moves by 1."""
    (u, sizes, right), length = _other_sensitivities(attempt, i)
    along = np.asarray(attempt.outcome["jacobian"])[i]
    with np.errstate(over="ignore"):
        others = -(u @ (projections(right.T, along) / sizes)) / length
    return np.insert(others, i, 1.0)


def likelihood_of(result: Identification) -> ProfileLikelihood:
    """Return the profile likelihood around the optimum of an output-error result."""
    if result.joint is None or result.task is None:
        raise ModelError(
            f"method {result.method!r} has no likelihood to profile; identify by {parameter('method', 'output-error')}"
        )
    problem = FreeProblem.of(replace(result.task.structure, initial=result.joint.initial))
    return ProfileLikelihood.of(result.joint, problem, result.task.runs)
