"""An optimum whose free run grows, beside one whose free run dies away."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from msgspec import UnsetType

from ftlm import _core
from ftlm.data.run import Run
from ftlm.data.sampling import read
from ftlm.errors import ConvergenceError, DataError, ModelError
from ftlm.estimation.free_parameters import FreeProblem, twin_words
from ftlm.estimation.friction import race_with_friction
from ftlm.estimation.objective import Asked, Attempt, Grid, deviation
from ftlm.model.model import Freedom, Solved
from ftlm.order_search.options import Loss
from ftlm.progress import PARTS, Course
from ftlm.simulation.discretization import compared_values
from ftlm.structure.input_nonlinearity import input_name
from ftlm.structure.order import Order
from ftlm.structure.structure import Initial, Structure
from ftlm.utils.formatting import unbounded
from ftlm.utils.resources import memory_limit, stop
from ftlm.utils.statistics import NORMAL_95, noise_of
from ftlm.utils.validation import Floats


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


@dataclass(frozen=True)
class ProfileInterval:
    """The values of a number at which the cost, all others fitted anew, rises by no more than noise explains.

    Parameters
    ----------
    low, high
        Its ends, in the unit of the number; infinite where the cost does not rise to the threshold within the bounds,
        as far as there is a finite free run.
    level
        Probability with which intervals of repeated runs hold the truth.
    points
        (value, rise) of every refit: the rise of the weighted sum of squares in units of the noise's variance, so that
        its root counts standard deviations; widened for coloured residuals as the standard errors are.
    evaluations
        Free runs that it took.
    """

    low: float
    high: float
    level: float
    points: tuple[tuple[float, float], ...] = field(default=(), repr=False)
    evaluations: int = field(default=0, repr=False)

    @property
    def is_open(self) -> bool:
        """Whether an end is infinite."""
        return not (math.isfinite(self.low) and math.isfinite(self.high))

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high

    def __str__(self) -> str:
        return f"{unbounded(self.low, '.6g')} to {unbounded(self.high, '.6g')}"


#: Residuals beyond so many deviations are outliers: of normal noise one in two millions is.
FAR = 5.0


@dataclass(frozen=True)
class Robust:
    """What a robust loss did.

    Parameters
    ----------
    lowered
        Residuals beyond 1.345 deviations, which count less; of normal noise 18 % are.
    outliers
        Those beyond five.
    samples
        Residuals in all.
    """

    lowered: int
    outliers: int
    samples: int


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
    runs: Sequence[Run],
    structure: Structure,
    *,
    threads: int = 1,
    start: Mapping[str, float] | None = None,
    refine: bool = True,
    progress: Callable[[int, int], None] | None = None,
    loss: Loss = "squares",
    known: Sequence[Mapping[str, float]] = (),
    near: JointFit | None = None,
    raced: _core.JointRace | None = None,
) -> JointFit:
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
        problem.core,
        Asked(problem, runs).core(lambda done, _: course.at(done / PARTS)),
        list(zip(outset.sizes, outset.noise, strict=True)),
        [[v[n] for n in problem.names] for v in known],
        None if start is None else [start[n] for n in problem.names],
        given_near,
        raced,
        loss == "huber",
        refine,
        (threads, memory_limit()),
        stop(),
    )
    if found is None:
        why = twin_words(runs, structure) or "check the signs of the data and the bounds"
        raise ConvergenceError(f"no start of {', '.join(outputs)} has a finite free run; {why}")
    orders, coefficients, inputs = problem.split(found["estimate"])
    residuals = [dict(zip(outputs, part, strict=True)) for part in found["left"]]
    return JointFit(
        orders=dict(zip(problem.orders, orders, strict=True)),
        coefficients=dict(zip(problem.coefficients, coefficients, strict=True)),
        inputs=dict(zip((item.name for item in problem.inputs), inputs, strict=True)),
        products=dict(problem.products),
        covariance=found["covariance"],
        residuals=residuals,
        noise=dict(zip(outputs, found["noise"], strict=True)),
        robust=None if found["robust"] is None else Robust(*found["robust"]),
        shares=found["shares"],
        on_grid=found["on_grid"],
        cost=found["cost"],
        samples=sum(read(e).size for part in residuals for e in part.values()),
        refinement=found["every"],
        settled=found["settled"],
        converged=found["status"] == "converged",
        starts=found["starts"],
        initial=structure.initial,
        initial_terms=found["initial_terms"],
        growth=None if found["growth"] is None else Growth(*found["growth"]),
    )


def given(problem: FreeProblem, values: Mapping[str, float]) -> Attempt:
    """A start by name."""
    orders, coefficients, inputs = problem.split([values[n] for n in problem.names])
    return Attempt(orders, coefficients, "given start", {}, inputs)


def first_noise(runs: Sequence[Run], structure: Structure, output: str, size: float) -> float:
    """A first guess of an output's noise, from second differences, but not below a share of its size."""
    return max(float(np.median([noise_of(compared_values(run, structure, output)) for run in runs])), 1e-3 * size)


#: Orders keep this distance from bounds of their own: derivatives are taken at them, and nothing is fitted.
ROOM = 0.5


def freedom(joint: JointFit, structure: Structure) -> Freedom:
    """What a joint fit of a structure found together."""
    orders = [order for e in structure.equations for order in (e.order, *(t.order for t in e.terms))]
    spread = joint.covariance
    return Freedom(
        names=tuple(joint.names),
        orders=tuple(map(str, orders)),
        noise={o: float(v) for o, v in joint.noise.items()},
        products={n: (float(sign), tuple(factors)) for n, (sign, factors) in joint.products.items()},
        covariance=tuple(tuple(row) for row in spread.tolist()) if np.all(np.isfinite(spread)) else None,
        refinement=joint.refinement,
    )


def freedom_of(model: Solved) -> Freedom:
    """What was free in the fit that a model is of.

    Raises
    ------
    ModelError
        A model of another method, one that was written down, or one of a file that does not say so.
    """
    known = None if model.estimate is None else model.estimate.free
    if known is None or isinstance(known, UnsetType):
        how = "was not identified" if model.estimate is None else f"is of method {model.estimate.method!r}"
        raise ModelError(
            f"this model {how}, or of a file that does not say what was free in its fit: without intervals and noise "
            "no experiment can be laid out; identify it with method='output-error'"
        )
    return known


def problem_of(model: Solved) -> tuple[FreeProblem, list[float]]:
    """The problem of a model's fit for a run that begins at rest, and the values of its free numbers.

    Raises
    ------
    ModelError
        A model that does not say what was free; orders that are none, or others than its equations have.
    """
    known, estimate = freedom_of(model), model.estimate
    values = {} if estimate is None else estimate.values
    lacking = [n for n in known.names if n not in values]
    count = sum(1 + len(e.terms) for e in model.equations)
    if lacking or len(known.orders) != count:
        what = (
            f"no value of {lacking[0]}" if lacking else f"{len(known.orders)} orders where its equations have {count}"
        )
        raise ModelError(f"what the model says of its fit has {what}; identify it again")
    laws = iter(known.orders)
    equations = []
    for item in model.equations:
        order = Order.parse(next(laws))
        terms = []
        for term in item.terms:
            free = term.name in known.names or term.name in known.products
            coefficient = str(term.name) if free else term.coefficient
            terms.append(replace(term, order=Order.parse(next(laws)), coefficient=coefficient, name=None))
        equations.append(replace(item, order=order, terms=tuple(terms)))
    names = {n for e in equations for n in e.order_names}
    late = {s: input_name("delay", s) for s in model.structure.signals if s not in model.outputs}
    delays = {s: values[n] for s, n in late.items() if n in known.names}
    structure = replace(
        model.structure,
        equations=tuple(equations),
        order_values={n: (values[n] - ROOM, values[n] + ROOM) for n in names},
        coefficient_law=tuple((n, sign, factors) for n, (sign, factors) in known.products.items()),
        delay={s: d for s, d in model.structure.delay.items() if s not in delays},
        free_delays={s: (0.0, 2.0 * d + 1.0) for s, d in delays.items()},
        initial="rest",
    )
    problem = FreeProblem.of(structure)
    if set(problem.names) != set(known.names):
        odd = sorted(set(problem.names) ^ set(known.names))
        raise ModelError(f"what the model says of its fit does not fit its equations: {odd[0]}; identify it again")
    return problem, [values[n] for n in problem.names]
