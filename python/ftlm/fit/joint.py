"""Joint output error: all equations, all runs, continuous orders, from an automatic start to intervals.

For white measurement noise the estimate is maximum likelihood. The core minimises from a start
(Levenberg-Marquardt with an analytic Jacobian), weighs outputs by what is left of them, refines the grid until it no
longer matters, and tells the covariance; this file finds where to start from, and names what comes out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.errors import ConvergenceError, DataError, FtlmError
from ftlm.base.progress import Course
from ftlm.base.statistics import NORMAL_95, noise_of
from ftlm.base.threads import stop
from ftlm.data.readings import read
from ftlm.data.run import Run
from ftlm.data.settings import Loss
from ftlm.data.structures import Initial, Structure
from ftlm.fit.clock import spans
from ftlm.fit.friction import race_with_friction
from ftlm.fit.grid import FINEST, Attempt, Grid
from ftlm.fit.interval import ProfileInterval
from ftlm.fit.problem import FreeProblem
from ftlm.fit.race import SAME_COST, finalists, race
from ftlm.fit.robust import Robust
from ftlm.fit.steady import Growth, steadied
from ftlm.fit.twins import twin_words
from ftlm.fit.uncertainty import deviation
from ftlm.solve.instants import compared_values

#: Share of a fit's course at whose end the race is, and of what is left of that what each of its sweeps takes.
RACED, SWEEP = 0.5, 0.3
#: Residual that costs 1 in a coarse fit, as a share of an output's size.
COARSE_SHARE = 0.01
#: Evaluations of each finalist on all samples, and of what is left then.
FINAL_LAP = 60
LAST_LAP = 120


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
    others = finalists(reached) if reached and refine else ()
    starts = [(a.level, origin) for a in reached for origin in (a.origin, *a.alike)]
    return replace(finished(best, grid, others, loss, refine=refine), starts=starts, growth=growth)


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
    outcome, weights, shares = grid.problem.core.settled(
        grid.sampled, spans(grid.runs), grid.core, _place(attempt), loss == "huber", stop()
    )
    numbers = [list(outcome[n]) for n in ("orders", "coefficients", "inputs")]
    there = replace(attempt, orders=numbers[0], coefficients=numbers[1], inputs=numbers[2], outcome=outcome)
    return there, replace(grid, weights=weights, shares=shares)


def _place(attempt: Attempt) -> tuple[list[float], list[list[float]]]:
    """Numbers of an attempt, and states of its runs where they are known."""
    known = attempt.outcome.get("states", []) if isinstance(attempt.outcome, dict) else []
    return attempt.values.tolist(), known


def finished(best: Attempt, grid: Grid, others: Sequence[Attempt], loss: Loss, *, refine: bool) -> JointFit:
    """An optimum, its step halved until that moves it by little of its standard error, in words and names.

    A coarse grid may lead along a flat valley to where equations end, and there a finer one leads nowhere: then others
    have their way on it as well.
    """
    problem, outputs = grid.problem, grid.problem.structure.outputs
    end = problem.core.finished(
        grid.sampled, spans(grid.runs), grid.core, best.outcome, [_place(a) for a in others], loss == "huber", refine,
        stop(),
    )  # fmt: skip
    there = end["attempt"]
    orders, coefficients, inputs = problem.split(end["estimate"])
    residuals = [dict(zip(outputs, part, strict=True)) for part in end["left"]]
    return JointFit(
        orders=dict(zip(problem.orders, orders, strict=True)),
        coefficients=dict(zip(problem.coefficients, coefficients, strict=True)),
        inputs=dict(zip((item.name for item in problem.inputs), inputs, strict=True)), products=dict(problem.products),
        covariance=end["covariance"], residuals=residuals, noise=dict(zip(outputs, end["noise"], strict=True)),
        robust=None if end["robust"] is None else Robust(*end["robust"]), shares=end["shares"],
        on_grid=np.array([*there["orders"], *there["coefficients"], *there["inputs"]]), cost=there["cost"],
        samples=sum(read(e).size for part in residuals for e in part.values()), refinement=end["every"],
        settled=end["settled"], converged=there["status"] == "converged", starts=[],
        initial=problem.structure.initial, initial_terms=sum(len(x) for run in there["initial"] for x in run),
    )  # fmt: skip
