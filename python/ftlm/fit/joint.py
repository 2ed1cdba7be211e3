"""Joint output error: all equations, all runs, continuous orders, from an automatic start to intervals.

For white measurement noise the estimate is maximum likelihood. The core minimises from a start
(Levenberg-Marquardt with an analytic Jacobian); this file finds starts, weighs outputs by their noise, refines the grid
until it no longer matters, and turns the optimum into numbers with intervals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.errors import ConvergenceError, DataError, FtlmError
from ftlm.base.statistics import NORMAL_95, noise_of
from ftlm.data.run import Run
from ftlm.data.structures import Structure, delay_name
from ftlm.fit.problem import Attempt, FreeProblem, descend, experiment, lowest
from ftlm.fit.simpler import LowerOrder, Simpler, lower_orders, simpler
from ftlm.fit.starts import delayed_attempts
from ftlm.fit.uncertainty import covariance, residual_levels, split_residuals

#: Samples a run of the coarse fits that compare starts; the best ones continue on all samples.
COARSE_SAMPLES = 1200
#: Residual that costs 1 in a coarse fit, as a share of an output's size.
COARSE_SHARE = 0.01
#: Evaluations of every coarse fit, then of those that are ahead: one in RUNNERS, but not fewer than FEWEST.
FIRST_LAP = 15
SECOND_LAP = 60
RUNNERS = 3
FEWEST = 8
#: All get as many as those ahead where the best is above the noise by this factor.
ABOVE_FLOOR = 2.0
#: Coarse fits that continue on all samples.
FINALISTS = 3
#: ... unless their coarse cost exceeds the best one's by this factor.
CONTENDER = 3.0
#: Two costs closer than this share are the same optimum.
SAME_COST = 1e-3
#: Weights are settled when no output's residuals differ from their weight by more than this share.
SETTLED = 0.01
#: Refinement ends when halving the step moves no estimate, extrapolated to step 0, by this share of its standard error.
REFINED = 0.1
#: Discretisation that the first fit on all samples may leave, in standard deviations of the noise.
NOTICED = 0.3
#: Finest grid: pulses a sample interval.
FINEST = 16


@dataclass(frozen=True)
class JointFit:
    """An optimum of the joint output error.

    Parameters
    ----------
    orders, coefficients
        Free orders and free coefficients by name; under a coefficient law the free ones of the law.
    covariance
        Of orders, coefficients, then delays, robust to coloured residuals.
    noise
        Standard deviation of the residuals by output.
    cost
        Half the sum of squared weighted residuals.
    samples
        Number of residuals.
    refinement
        Pulses a sample interval on the finest grid; the estimates are the limit that it and the next coarser one tell.
    settled
        Whether halving the step moved no estimate by a tenth of its standard error.
    converged
        Whether neither cost nor parameters moved any more.
    starts
        Coarse cost (per residual) and origin of every start, best first.
    residuals
        By run and output.
    products
        Coefficients that the coefficient law gives: sign and factors by name.
    delays
        Estimated delays [s] by input; in covariance and errors they stand last, as ``delay_`` and the input's name.
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
    delays: dict[str, float] = field(default_factory=dict)

    @property
    def choice(self) -> str:
        """Why this optimum, in words: which start led to it, and how far behind the next other one was."""
        if not self.starts:
            return "from the start that was given"
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
            out[name] = float(np.sqrt(slope @ spread @ slope))
        return out

    @property
    def names(self) -> list[str]:
        """Parameters in the order of the covariance."""
        return [*self.orders, *self.coefficients, *map(delay_name, self.delays)]

    @property
    def values(self) -> Floats:
        """Parameters in the order of the covariance."""
        return np.array([*self.orders.values(), *self.coefficients.values(), *self.delays.values()])

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard error of each parameter."""
        with np.errstate(invalid="ignore"):
            return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % interval of each parameter."""
        errors = self.standard_errors
        pairs = zip(self.names, self.values.tolist(), strict=True)
        return {n: (v - NORMAL_95 * errors[n], v + NORMAL_95 * errors[n]) for n, v in pairs}

    @property
    def correlation(self) -> Floats:
        """Correlation matrix of the parameters; not a number where a variance is 0 or not finite."""
        with np.errstate(divide="ignore", invalid="ignore"):
            spread = np.sqrt(np.diag(self.covariance))
            scaled: Floats = self.covariance / np.outer(spread, spread)
        return scaled


def fit_output_error(
    runs: Sequence[Run],
    structure: Structure,
    *,
    threads: int = 1,
    start: Mapping[str, float] | None = None,
    refine: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> JointFit:
    """Fit all equations of a structure on all runs by output error, from an automatic start.

    Parameters
    ----------
    runs
        Runs with the same names and units.
    structure
        Free orders and coefficients; a stated coefficient law is imposed. Its initial terms must be decided.
    threads
        Threads of the start's lattice.
    start
        Values of all free orders, coefficients and delays by name, instead of the automatic start.
    refine
        Whether to refine the grid below the samples until it does not matter.
    progress
        Called with (starts done, starts in all).

    Returns
    -------
    JointFit
        The best optimum found.

    Raises
    ------
    DataError
        Fewer samples than free numbers.
    ConvergenceError
        No start has a finite free run.
    """
    problem = FreeProblem.of(structure)
    initial = structure.initial
    signals = structure.signals
    samples = sum(run.length - 2 for run in runs) * len(structure.outputs)
    if samples <= len(problem.names):
        raise DataError(
            f"{samples} samples between the first and the last do not tell {len(problem.names)} free numbers; use "
            "longer runs, or fix orders or coefficients"
        )
    noise = first_noise(runs, structure)
    decimation = max(1, min(run.length - 1 for run in runs) // COARSE_SAMPLES)

    def experiments(weights: Sequence[float], every: int = 1, thinned: int = 1) -> list[Any]:
        return [experiment(r, problem, initial, weights, every=every, decimation=thinned) for r in runs]

    weights = [1.0 / noise[o] for o in structure.outputs]
    # Starts are compared with every output weighing alike: noise decides where the optimum is, not how to get near it.
    sizes = [math.sqrt(float(np.mean([np.var(run[o]) for run in runs]))) for o in structure.outputs]
    alike = [1.0 / (COARSE_SHARE * size) for size in sizes]
    starts: list[tuple[float, str]] = []
    if start is None:
        coarse: list[Any] = []
        attempts = delayed_attempts(runs, problem, initial, threads)

        def tried(attempt: Attempt, evaluations: int, of: FreeProblem, begin: Any) -> Attempt | None:
            try:
                return descend(of, coarse, signals, begin, attempt, evaluations=evaluations)
            except FtlmError:
                # A start whose free run is not finite is no start; if none is left, that is said below.
                return None

        def race(
            runners: list[Attempt], evaluations: int, of: FreeProblem = problem, begin: Any = initial
        ) -> list[Attempt]:
            ended, count = [], len(runners)
            with ThreadPoolExecutor(threads) as pool:
                try:
                    for done, attempt in enumerate(
                        pool.map(tried, runners, *([v] * count for v in (evaluations, of, begin)))
                    ):
                        if attempt is not None:
                            ended.append(attempt)
                        if progress is not None:
                            progress(min(done, len(attempts) - 1), len(attempts))
                except BaseException:
                    pool.shutdown(cancel_futures=True)
                    raise
            return sorted(ended, key=lambda a: a.level)

        def thinned(weights: Sequence[float], every: int) -> list[Any]:
            return experiments(weights, every, decimation)

        level = 1
        while True:
            coarse = thinned(alike, level)
            reached = race(attempts, FIRST_LAP)
            # A stiff equation may have no stable scheme, and so no start, on a coarse grid.
            settled = bool(reached) and not grid_matters(problem, thinned, alike, initial, reached[0], level)
            if settled or level >= FINEST:
                break
            # The coarse grid has optima of its own: once more from the same starts, on half the step.
            level *= 2
        # Whatever a simpler equation reaches, this one reaches too: it starts there with the term's coefficient at 0,
        # or with a pole too fast to see.
        others: list[Simpler | LowerOrder] = [*simpler(problem, initial), *lower_orders(problem, runs, initial)]
        for less in others if reached else []:
            laps = race(
                delayed_attempts(runs, less.problem, less.initial, threads), FIRST_LAP, less.problem, less.initial
            )
            laps = race(laps[:FINALISTS], SECOND_LAP, less.problem, less.initial)
            reached = sorted(reached + [less.embedded(a, problem) for a in laps[:1]], key=lambda a: a.level)
        ahead = max(FEWEST, len(reached) // RUNNERS)
        rest = reached[ahead:]
        reached = race(reached[:ahead], SECOND_LAP)
        floor = float(
            np.mean([(noise[o] / (COARSE_SHARE * size)) ** 2 for o, size in zip(structure.outputs, sizes, strict=True)])
        )
        if reached and reached[0].level > ABOVE_FLOOR * floor:
            # Noise alone would leave less: those behind may yet be on the way to where it does.
            rest = race(rest, SECOND_LAP)
        reached = by_both_grids(problem, thinned(alike, 2 * level), initial, reached + rest)
        starts = [(a.level, a.origin) for a in reached]
        kept = distinct(reached)[:FINALISTS]
        finalists = [a for a in kept if a.level <= CONTENDER * kept[0].level]
        if progress is not None:
            progress(len(attempts), len(attempts))
    else:
        orders, coefficients, delays = problem.split([start[n] for n in problem.names])
        finalists = [Attempt(orders, coefficients, "given start", {}, delays)]
    if not finalists:
        raise ConvergenceError(
            f"no start of {', '.join(structure.outputs)} has a finite free run; "
            "check the signs of the data and the bounds"
        )
    # Where a step passes faster than the samples see, a grid as coarse as the samples has an optimum of its own.
    every = 1
    while every < FINEST and grid_matters(problem, experiments, weights, initial, finalists[0], every):
        every *= 2
    near = experiments(alike, every)
    ends = []
    for attempt in finalists:
        try:
            ends.append(descend(problem, near, signals, initial, attempt, evaluations=60))
        except FtlmError:
            # No finite free run on this grid; the others have one.
            if attempt is finalists[-1] and not ends:
                raise
    best = by_both_grids(problem, experiments(alike, 2 * every), initial, ends)[0]
    best = lowest(problem, near, signals, initial, best, evaluations=120)
    best = descend(problem, experiments(weights, every), signals, initial, best, evaluations=120)

    def weighed(attempt: Attempt, weights: list[float], every: int) -> tuple[Attempt, list[float]]:
        """Descend on a grid until the weights are those of the residuals, pooled over runs."""
        for _ in range(4):
            full = experiments(weights, every)
            attempt = descend(problem, full, signals, initial, attempt, evaluations=120, plain=True)
            levels = residual_levels(attempt, full, structure)
            if all(abs(v - 1.0) < SETTLED for v in levels.values()):
                break
            weights = [w / max(levels[o], 1e-300) for w, o in zip(weights, structure.outputs, strict=True)]
        return attempt, weights

    best, weights = weighed(best, weights, every)
    estimate, settled = best.values, not refine
    while not settled and every < FINEST:
        # On a finer grid residuals may shrink to their noise, so weights follow anew.
        finer, weights = weighed(best, weights, 2 * every)
        errors = np.sqrt(np.diag(covariance(finer, experiments(weights, 2 * every), structure)))
        # The scheme is of second order, so two grids tell the limit (Richardson); a third tells whether that is so.
        # Of a flat valley in which neither stood still they tell nothing.
        still = finer.found["status"] == "converged" and best.found["status"] == "converged"
        limit = finer.values + (finer.values - best.values) / 3.0 if still else finer.values
        settled = bool(np.all(np.abs(limit - estimate) <= REFINED * errors))
        best, every, estimate = finer, 2 * every, limit
    low, high = np.array(problem.all_bounds).T
    orders, coefficients, delays = problem.split(np.clip(estimate, low, high).tolist())
    full = experiments(weights, every)
    levels = residual_levels(best, full, structure)
    residuals = split_residuals(best, full, structure)
    return JointFit(
        orders=dict(zip(problem.orders, orders, strict=True)),
        coefficients=dict(zip(problem.coefficients, coefficients, strict=True)),
        covariance=covariance(best, full, structure),
        noise={o: levels[o] / w for (o, w) in zip(structure.outputs, weights, strict=True)},
        cost=float(best.found["cost"]),
        samples=len(best.found["residuals"]),
        refinement=every,
        settled=settled,
        converged=best.found["status"] == "converged",
        starts=starts,
        residuals=residuals,
        products=dict(problem.products),
        delays=dict(zip(problem.delays, delays, strict=True)),
    )


def by_both_grids(problem: FreeProblem, finer: list[Any], initial: Any, reached: Sequence[Attempt]) -> list[Attempt]:
    """Attempts by their cost on their own grid or on the finer one, whichever is the larger; the least first.

    The pulse scheme of a stiff equation has a mode that alternates from pulse to pulse. A fit may use it to follow
    noise, at the cost of a free run that no other grid has.
    """

    def worse(attempt: Attempt) -> float:
        try:
            there = descend(problem, finer, problem.structure.signals, initial, attempt, evaluations=1)
        except FtlmError:
            return math.inf
        return max(attempt.level, there.level)

    costs = [worse(a) for a in reached]
    if not any(map(math.isfinite, costs)):
        return sorted(reached, key=lambda a: a.level)
    return [reached[i] for i in sorted(range(len(reached)), key=lambda i: (costs[i], reached[i].level))]


def grid_matters(
    problem: FreeProblem,
    experiments: Callable[[Sequence[float], int], list[Any]],
    weights: Sequence[float],
    initial: Any,
    attempt: Attempt,
    every: int,
) -> bool:
    """Whether halving the step moves the simulated samples by a share of their noise that the fit would notice."""
    signals = problem.structure.signals
    try:
        ends = [
            descend(problem, experiments(weights, e), signals, initial, attempt, evaluations=1).found["residuals"]
            for e in (every, 2 * every)
        ]
    except FtlmError:
        # Finite on one grid and not on the other: it matters.
        return True
    moved: Floats = np.asarray(ends[1]) - np.asarray(ends[0])
    return bool(np.mean(moved**2) > NOTICED**2)


def first_noise(runs: Sequence[Run], structure: Structure) -> dict[str, float]:
    """A first guess of the noise of each output, from second differences, but not below a share of its size."""
    out = {}
    for name in structure.outputs:
        size = float(np.sqrt(np.mean([np.var(run[name]) for run in runs])))
        out[name] = max(float(np.median([noise_of(run[name]) for run in runs])), 1e-3 * size)
    return out


def distinct(reached: Sequence[Attempt]) -> list[Attempt]:
    """Attempts, best first, without those that ended in the optimum of an earlier one."""
    kept: list[Attempt] = []
    for attempt in reached:
        values = np.array(attempt.orders)
        same = any(
            abs(k.level - attempt.level) <= SAME_COST * k.level and np.allclose(values, k.orders, atol=0.02)
            for k in kept
        )
        if not same:
            kept.append(attempt)
    return kept
