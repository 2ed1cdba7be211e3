"""Joint output error: all equations, all runs, continuous orders, from an automatic start to intervals.

For white measurement noise the estimate is maximum likelihood. The core finds where to start from, races the starts,
minimises (Levenberg-Marquardt with an analytic Jacobian), weighs outputs by what is left of them, refines the grid
until it no longer matters, and tells the covariance; this file names what goes in and what comes out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ftlm import _core
from ftlm.base.arrays import Floats
from ftlm.base.errors import ConvergenceError, DataError
from ftlm.base.memory import memory_limit
from ftlm.base.progress import PARTS, Course
from ftlm.base.statistics import NORMAL_95, noise_of
from ftlm.base.threads import stop
from ftlm.data.readings import read
from ftlm.data.run import Run
from ftlm.data.settings import Loss
from ftlm.data.structures import Initial, Structure
from ftlm.fit.asked import Asked
from ftlm.fit.friction import race_with_friction
from ftlm.fit.grid import Attempt, Grid
from ftlm.fit.growth import Growth
from ftlm.fit.interval import ProfileInterval
from ftlm.fit.problem import FreeProblem
from ftlm.fit.robust import Robust
from ftlm.fit.twins import twin_words
from ftlm.fit.uncertainty import deviation
from ftlm.solve.instants import compared_values

#: Share of a fit's course at whose end the race is, and of what is left of that what each of its sweeps takes.
RACED, SWEEP = 0.5, 0.3
#: Residual that costs 1 in a coarse fit, as a share of an output's size.
COARSE_SHARE = 0.01
#: Two costs closer than this share are the same optimum.
SAME_COST = 1e-3


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
        return cls(problem, runs, output_sizes(runs, structure))

    @cached_property
    def noise(self) -> list[float]:
        """A first guess of each output's."""
        structure = self.problem.structure
        outputs = zip(structure.outputs, self.sizes, strict=True)
        return [first_noise(self.runs, structure, output, size) for output, size in outputs]

    def race(self, threads: int, progress: Callable[[int, int], None] | None) -> _core.JointRace:
        """Where the starts of this problem get; fits of the same structure to the same runs go on from there."""
        shares = [noise / (COARSE_SHARE * size) for noise, size in zip(self.noise, self.sizes, strict=True)]
        floor = float(np.mean([share**2 for share in shares]))
        weights = [1.0 / (COARSE_SHARE * size) for size in self.sizes]
        if self.problem.structure.has_friction:
            return race_with_friction(Grid(self.problem, self.runs, weights), floor, threads, progress)
        runs = Asked(self.problem, self.runs).core(progress)
        return _core.joint_race(self.problem.core, runs, weights, floor, (threads, memory_limit()), stop())


def output_sizes(runs: Sequence[Run], structure: Structure) -> list[float]:
    """Root of the mean variance of each output on all runs."""
    return [math.sqrt(float(np.mean([np.nanvar(run[o]) for run in runs]))) for o in structure.outputs]


def fit_output_error(
    runs: Sequence[Run], structure: Structure, *, threads: int = 1, start: Mapping[str, float] | None = None,
    refine: bool = True, progress: Callable[[int, int], None] | None = None, loss: Loss = "squares",
    known: Sequence[Mapping[str, float]] = (), near: JointFit | None = None, raced: _core.JointRace | None = None,
) -> JointFit:  # fmt: skip
    """Fit all equations of a structure on all runs by output error, from an automatic start.

    A coefficient law that the structure states is imposed; its initial terms must be decided. A start gives values of
    everything free by name, and is the only one; known ones stand beside the automatic ones; `near` is a fit of the
    same structure to nearly the same runs, to go on from on its grid and with its weights; `raced` is the race of its
    starts where that was run already. Without `refine` the grid is not refined below the samples. Progress is told
    (parts done, parts in all). The loss decides between optima on all samples, not between starts.

    Raises
    ------
    DataError
        Fewer samples than free numbers.
    ConvergenceError
        No start has a finite free run, or one whose squares are numbers.
    """
    outset = Outset.of(runs, structure)
    problem, outputs = outset.problem, structure.outputs
    course = Course(progress)
    if problem.structure.has_friction and raced is None and start is None and near is None:
        raced = outset.race(threads, course.until(RACED, SWEEP))
    given_near = None
    if near is not None:
        given_near = near.values.tolist(), [near.noise[o] for o in outputs], near.refinement
    found = _core.joint_fit(
        problem.core, Asked(problem, runs).core(lambda done, _: course.at(done / PARTS)),
        list(zip(outset.sizes, outset.noise, strict=True)), [[v[n] for n in problem.names] for v in known],
        None if start is None else [start[n] for n in problem.names], given_near, raced, loss == "huber", refine,
        (threads, memory_limit()), stop(),
    )  # fmt: skip
    if found is None:
        why = twin_words(runs, structure) or "check the signs of the data and the bounds"
        raise ConvergenceError(f"no start of {', '.join(outputs)} has a finite free run; {why}")
    orders, coefficients, inputs = problem.split(found["estimate"])
    residuals = [dict(zip(outputs, part, strict=True)) for part in found["left"]]
    return JointFit(
        orders=dict(zip(problem.orders, orders, strict=True)),
        coefficients=dict(zip(problem.coefficients, coefficients, strict=True)),
        inputs=dict(zip((item.name for item in problem.inputs), inputs, strict=True)), products=dict(problem.products),
        covariance=found["covariance"], residuals=residuals, noise=dict(zip(outputs, found["noise"], strict=True)),
        robust=None if found["robust"] is None else Robust(*found["robust"]), shares=found["shares"],
        on_grid=found["on_grid"], cost=found["cost"],
        samples=sum(read(e).size for part in residuals for e in part.values()), refinement=found["every"],
        settled=found["settled"], converged=found["status"] == "converged", starts=found["starts"],
        initial=structure.initial, initial_terms=found["initial_terms"],
        growth=None if found["growth"] is None else Growth(*found["growth"]),
    )  # fmt: skip


def given(problem: FreeProblem, values: Mapping[str, float]) -> Attempt:
    """A start by name."""
    orders, coefficients, inputs = problem.split([values[n] for n in problem.names])
    return Attempt(orders, coefficients, "given start", {}, inputs)


def first_noise(runs: Sequence[Run], structure: Structure, output: str, size: float) -> float:
    """A first guess of an output's noise, from second differences, but not below a share of its size."""
    return max(float(np.median([noise_of(compared_values(run, structure, output)) for run in runs])), 1e-3 * size)
