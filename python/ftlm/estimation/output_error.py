"""Joint output-error fit: multistart, optimum with its statistics, and free parameters stored in model files."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from ftlm import _core
from ftlm.data.run import Run
from ftlm.data.sampling import drop_missing
from ftlm.errors import ConvergenceError, DataError, ModelError
from ftlm.estimation.free_parameters import FreeProblem, describe_collinear_inputs
from ftlm.estimation.objective import Iterate, propagated_errors
from ftlm.model.model import FitParameters, Model
from ftlm.simulation.discretization import recording, values_at_residuals
from ftlm.structure.input_nonlinearity import input_name
from ftlm.structure.order import Order
from ftlm.structure.structure import Initial, Structure
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import format_bound
from ftlm.utils.parameters import parameter
from ftlm.utils.resources import memory_limit, stop_flag
from ftlm.utils.statistics import NORMAL_95, ROUNDING_RESIDUAL_RATIO
from ftlm.utils.validation import Floats

Loss = Literal["squares", "huber"]
Noise = Literal["white", "ar"]


@dataclass(frozen=True)
class UnstableOptimum:
    """Comparison of an unstable optimum with the best stable optimum.

    Parameters
    ----------
    is_accepted
        Whether the unstable optimum was chosen, because the data require it or no stable optimum exists.
    residual_excess
        RMS residual of the stable optimum divided by the RMS residual of the unstable optimum, minus 1. Infinite if
        there is no stable optimum; negative if the unstable point is not an optimum.
    at_stability_limit
        Whether the stable point lies on the stability limit, so that it is an optimum only under this constraint.
    """

    is_accepted: bool
    residual_excess: float
    at_stability_limit: bool = False


@dataclass(frozen=True)
class ProfileInterval:
    """Profile-likelihood interval of a parameter.

    It contains the values at which the cost, minimized over all other parameters, rises by at most the threshold of the
    likelihood-ratio test.

    Parameters
    ----------
    low, high
        Ends of the interval, in the unit of the parameter. An end is infinite if the cost does not reach the threshold
        within the bounds of the parameter or within the range of finite simulations. For a parameter with a lower bound
        of 0, such as a delay, `low` is then 0.
    level
        Confidence level.
    points
        (value, rise) of every refit. The rise is the increase of the sum of squares divided by the noise variance, so
        its square root counts standard deviations. Like standard errors, it is corrected for colored residuals.
    evaluations
        Number of simulations used.
    """

    low: float
    high: float
    level: float
    points: tuple[tuple[float, float], ...] = field(default=(), repr=False)
    evaluations: int = field(default=0, repr=False)

    @property
    def is_open(self) -> bool:
        """Whether the interval is unbounded on at least one side."""
        return not (math.isfinite(self.low) and math.isfinite(self.high))

    @check_arguments
    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high

    def __str__(self) -> str:
        return f"{format_bound(self.low, '.6g')} to {format_bound(self.high, '.6g')}"


#: Outlier threshold in standard deviations: exceeded by one of two million samples of normal noise.
OUTLIER_DEVIATIONS = 5.0


@dataclass(frozen=True)
class RobustLossSummary:
    """Counts of a fit with a robust loss: residuals with reduced weight, and outliers.

    Parameters
    ----------
    downweighted_count
        Number of residuals beyond 1.345 standard deviations, which have reduced weight. Normal noise has 18 % of such
        residuals.
    outliers
        Number of residuals beyond five standard deviations.
    samples
        Total number of residuals.
    """

    downweighted_count: int
    outliers: int
    samples: int


#: Residual that counts as 1 in the cost of a coarse fit, as a fraction of the standard deviation of the output.
COARSE_FRACTION = 0.01
#: Relative difference of two costs below which both fits have ended at the same optimum.
SAME_COST = 1e-3


@dataclass(frozen=True)
class JointFit:
    """Optimum of a joint output-error fit of all equations to all runs, with its statistics.

    Parameters
    ----------
    orders, coefficients
        Estimated free orders and free coefficients by name. With a coefficient law, `coefficients` has only the
        independent factors, and `products` has the other coefficients.
    covariance
        Covariance matrix of orders, coefficients and input parameters, in this sequence, robust to colored residuals.
        Parameters that are not identifiable have infinite variances, and NaN covariances.
    noise
        Standard deviation of the residuals by output; with a robust loss, estimated from their median absolute value.
    cost
        Half the sum of squared weighted residuals.
    samples
        Number of residuals, without missing samples.
    refinement
        Number of block pulses per sampling interval on the finest time grid. The estimates are extrapolated to step 0
        from this grid and the next coarser one.
    step_converged
        Whether halving the step changed every estimate by less than a tenth of its standard error.
    converged
        Whether the gradient vanishes except along active bounds. False if the maximum number of evaluations was
        reached, no step lowered the cost, or the iterates left the range that the time grid can represent.
    starts
        (cost per residual on a coarse time grid, origin as text) of every initial guess, best first.
    survivors
        (cost per residual on a coarse time grid, parameters) of the distinct best candidates of the multistart.
    residuals
        Residuals divided by the noise standard deviation, for each run by output; NaN for missing samples.
    products
        Coefficients that follow from a coefficient law: (sign, names of the factors) by name.
    inputs
        Estimated delays [s], saturations and dead zones by name, such as ``delay_u`` and ``sat_u``.
    initial, initial_terms
        Kind of the fitted initial terms, and the number of coefficients of initial terms and offsets over all runs.
    robust
        Summary of a robust loss; None for squares.
    robust_weights
        Robust weights of the samples, an array (outputs, samples) for each run.
    finest_grid_values
        Parameters at the optimum on the finest time grid, in the sequence of the rows of `covariance`.
    origin
        Description of the initial guess if there was no multistart.
    profiles
        95 % profile-likelihood intervals of the parameters that have one.
    unstable_optimum
        Comparison of an unstable optimum with a stable one; None if the optimum is stable.
    prior_fractions
        Fraction of the information on a parameter that its prior contributes, by name: posterior variance, computed for
        white noise, divided by the prior variance.
    """

    orders: dict[str, float]
    coefficients: dict[str, float]
    covariance: Floats
    noise: dict[str, float]
    cost: float
    samples: int
    refinement: int
    step_converged: bool
    converged: bool
    starts: list[tuple[float, str]]
    residuals: list[dict[str, Floats]]
    products: Mapping[str, tuple[float, tuple[str, ...]]] = field(default_factory=dict)
    inputs: dict[str, float] = field(default_factory=dict)
    initial: Initial = "rest"
    initial_terms: int = 0
    robust: RobustLossSummary | None = None
    robust_weights: Sequence[Floats] | None = field(default=None, repr=False)
    finest_grid_values: Floats = field(default_factory=lambda: np.zeros(0), repr=False)
    origin: str = "the start that was given"
    survivors: Sequence[tuple[float, Sequence[float]]] = field(default=(), repr=False)
    profiles: Mapping[str, ProfileInterval] = field(default_factory=dict)
    unstable_optimum: UnstableOptimum | None = None
    prior_fractions: Mapping[str, float] = field(default_factory=dict)

    @property
    def values_by_name(self) -> dict[str, float]:
        """Estimates by name, in the sequence of the rows of the covariance."""
        return dict(zip(self.names, self.values.tolist(), strict=True))

    @property
    def origin_text(self) -> str:
        """Text on the initial guess that led to this optimum, and on the cost of the second-best optimum."""
        if not self.starts:
            return f"from {self.origin}"
        level, origin = self.starts[0]
        same_optimum = [v for v, _ in self.starts if v <= (1.0 + SAME_COST) * level]
        text = f"{len(same_optimum)} of {len(self.starts)} starts ended in the lowest optimum, first that of: {origin}"
        other_starts = self.starts[len(same_optimum) :]
        return text + (
            f"; the next costs {other_starts[0][0] / level:.3g} times as much" if other_starts and level > 0 else ""
        )

    @property
    def derived_errors(self) -> dict[str, float]:
        """Standard errors, to first order, of the coefficients that follow from a coefficient law, by name."""
        block = slice(len(self.orders), len(self.orders) + len(self.coefficients))
        out, covariance = {}, self.covariance[block, block]
        for name, (sign, factors) in self.products.items():
            value = sign * math.prod(self.coefficients[f] for f in factors)
            slope = np.array([factors.count(n) * value / v if v else 0.0 for n, v in self.coefficients.items()])
            out[name] = float(propagated_errors(slope[None], covariance)[0])
        return out

    def exact_outputs(self, runs: Sequence[Run]) -> set[str]:
        """Return the outputs whose residuals are no larger than rounding and discretization errors."""
        deviations = {o: math.sqrt(float(np.mean([np.nanvar(run[o]) for run in runs]))) for o in self.noise}
        return {o for o, noise in self.noise.items() if noise <= ROUNDING_RESIDUAL_RATIO * deviations[o]}

    @property
    def names(self) -> list[str]:
        """Parameter names, in the sequence of the rows of the covariance."""
        return [*self.orders, *self.coefficients, *self.inputs]

    @property
    def values(self) -> Floats:
        """Parameter values, in the sequence of the rows of the covariance."""
        return np.array([*self.orders.values(), *self.coefficients.values(), *self.inputs.values()])

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors of the parameters by name."""
        with np.errstate(invalid="ignore"):
            return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % intervals of the parameters by name: profile likelihood if available, else ± 1.96 standard errors."""
        errors = self.standard_errors
        pairs = self.values_by_name.items()
        quadratic = {n: (v - NORMAL_95 * errors[n], v + NORMAL_95 * errors[n]) for n, v in pairs}
        return {**quadratic, **{n: (p.low, p.high) for n, p in self.profiles.items()}}

    @property
    def correlation(self) -> Floats:
        """Correlation matrix of the parameters; NaN in rows of parameters whose variance is 0 or not finite."""
        with np.errstate(divide="ignore", invalid="ignore"):
            deviations = np.sqrt(np.diag(self.covariance))
            scaled: Floats = self.covariance / np.outer(deviations, deviations)
        return scaled


def run_multistart(
    runs: Sequence[Run], structure: Structure, threads: int, progress: Callable[[int, int], None] | None
) -> _core.JointMultistart:
    """Run the multistart of a structure, and return its state for later fits of the same structure and runs."""
    problem = _check_sample_count(runs, structure)
    recordings = [recording(run, structure) for run in runs]
    return _core.joint_multistart(problem.core, recordings, (threads, memory_limit()), progress, stop_flag())


def _check_sample_count(runs: Sequence[Run], structure: Structure) -> FreeProblem:
    """Return the estimation problem of a structure; raise DataError if the runs have too few samples."""
    problem = FreeProblem.of(structure)
    values = [values_at_residuals(run, structure, output) for run in runs for output in structure.outputs]
    samples = sum(drop_missing(samples_of_output).size for samples_of_output in values)
    if samples <= len(problem.names):
        raise DataError(
            f"{samples} samples that are compared with the simulation do not determine {len(problem.names)} free "
            "parameters; use longer runs, or fix orders or coefficients"
        )
    return problem


def output_deviations(runs: Sequence[Run], structure: Structure) -> list[float]:
    """Return the standard deviation of each output: the square root of its mean variance over all runs."""
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
    guesses: Sequence[Mapping[str, float]] = (),
    initial_fit: JointFit | None = None,
    multistart: _core.JointMultistart | None = None,
) -> JointFit:
    """Return the joint output-error fit of all equations of a structure to all runs.

    A coefficient law of the structure is imposed. The structure must not have ``initial="auto"``. `start` gives values
    of all free parameters by name and replaces the automatic initial guesses, whereas `guesses` adds to them.
    `initial_fit` is a fit of the same structure to nearly the same runs, whose optimum, time step and weights are
    reused. `multistart` is the result of an earlier multistart. Without `refine`, the time step is not refined below
    the sampling interval. `progress` is called with (work done, total work). Optima are compared by the loss on all
    samples, and initial guesses by the sum of squared residuals.

    Raises
    ------
    DataError
        If there are fewer samples than free parameters.
    ConvergenceError
        If no initial guess has a finite simulation or a finite sum of squares.
    """
    problem, outputs = _check_sample_count(runs, structure), structure.outputs
    initial_optimum = None
    if initial_fit is not None:
        initial_optimum = initial_fit.values.tolist(), [initial_fit.noise[o] for o in outputs], initial_fit.refinement
    automatic = start is None and initial_fit is None and not guesses
    if automatic and problem.orders and structure.is_linear:
        # The coefficients of collinear inputs are not identifiable. This check avoids a search of all orders.
        reason = describe_collinear_inputs(runs, structure)
        if reason is not None:
            raise ConvergenceError(f"no initial guess of {', '.join(outputs)} has a finite simulation; {reason}")
    result = _core.joint_fit(
        problem.core,
        [recording(run, structure) for run in runs],
        [[v[n] for n in problem.names] for v in guesses],
        None if start is None else [start[n] for n in problem.names],
        initial_optimum,
        multistart,
        loss == "huber",
        refine,
        (threads, memory_limit()),
        progress,
        stop_flag(),
    )
    if result is None:
        reason = describe_collinear_inputs(runs, structure) or "check the signs of the data and the bounds"
        raise ConvergenceError(f"no initial guess of {', '.join(outputs)} has a finite simulation; {reason}")
    orders, coefficients, inputs = problem.split(result["estimate"])
    priors = structure.priors or {}
    residuals = [dict(zip(outputs, run_residuals, strict=True)) for run_residuals in result["residuals"]]
    return JointFit(
        orders=dict(zip(problem.orders, orders, strict=True)),
        coefficients=dict(zip(problem.coefficients, coefficients, strict=True)),
        inputs=dict(zip((item.name for item in problem.inputs), inputs, strict=True)),
        products=dict(problem.products),
        covariance=result["covariance"],
        residuals=residuals,
        noise=dict(zip(outputs, result["noise"], strict=True)),
        robust=None if result["robust"] is None else RobustLossSummary(*result["robust"]),
        robust_weights=result["robust_weights"],
        finest_grid_values=result["on_grid"],
        cost=result["cost"],
        samples=sum(drop_missing(e).size for run_residuals in residuals for e in run_residuals.values()),
        refinement=result["pulses_per_sample"],
        step_converged=result["step_converged"],
        converged=result["status"] == "converged",
        starts=result["starts"],
        survivors=result["survivors"],
        initial=structure.initial,
        initial_terms=result["initial_terms"] + uncounted_level_count(runs, structure),
        unstable_optimum=None if result["unstable_optimum"] is None else UnstableOptimum(*result["unstable_optimum"]),
        prior_fractions=dict(zip((n for n in problem.names if n in priors), result["prior_fractions"], strict=True)),
    )


def uncounted_level_count(runs: Sequence[Run], structure: Structure) -> int:
    """Return the number of output levels over all runs that are not among the initial terms of the compiled fit.

    It is 0 for non-linear models, whose levels are initial states and counted as such.
    """
    return len(runs) * len(structure.outputs) if structure.offset == "level" and structure.is_linear else 0


def fit_state(joint: JointFit, problem: FreeProblem) -> dict[str, Any]:
    """Return the data of a fit by name, from which the core restores its objective and optimum."""
    # If an unstable optimum was discarded, the core must not return to it.
    prefers_stable = joint.unstable_optimum is not None and not joint.unstable_optimum.is_accepted
    return {
        "estimate": joint.values,
        "on_grid": joint.finest_grid_values,
        "weights": [1.0 / max(joint.noise[o], 1e-300) for o in problem.structure.outputs],
        "robust_weights": joint.robust_weights,
        "pulses_per_sample": joint.refinement,
        "step_converged": joint.step_converged,
        "requires_stability": prefers_stable,
    }


def start_from_values(problem: FreeProblem, values: Mapping[str, float]) -> Iterate:
    """Return an initial guess as an iterate, from parameter values by name."""
    orders, coefficients, inputs = problem.split([values[n] for n in problem.names])
    return Iterate(orders, coefficients, "given start", {}, inputs)


#: Distance between an estimated order and the bounds that :func:`problem_of` gives it, so that derivatives exist at the
#: estimate. The order is not fitted again.
ORDER_BOUND_MARGIN = 0.5


def parameter_set(joint: JointFit, structure: Structure) -> FitParameters:
    """Return the free parameters of a joint fit with their covariance and noise, as a model file stores them."""
    orders = [order for e in structure.equations for order in (e.order, *(t.order for t in e.terms))]
    covariance = joint.covariance
    return FitParameters(
        names=tuple(joint.names),
        orders=tuple(map(str, orders)),
        noise={o: float(v) for o, v in joint.noise.items()},
        products={n: (float(sign), tuple(factors)) for n, (sign, factors) in joint.products.items()},
        covariance=tuple(tuple(row) for row in covariance.tolist()) if np.all(np.isfinite(covariance)) else None,
        refinement=joint.refinement,
    )


def parameter_set_of(model: Model) -> FitParameters:
    """Return the free parameters, with covariance and noise, that a model file stores.

    Raises
    ------
    ModelError
        If the model was not estimated by output error, or its file does not list the free parameters.
    """
    free = None if model.estimate is None else model.estimate.free_parameters
    if free is None:
        reason = "was not identified" if model.estimate is None else f"is of method {model.estimate.method!r}"
        raise ModelError(
            f"this model {reason}, or its file does not list the free parameters, whose covariance an input design "
            "needs; "
            f"identify it with {parameter('method', 'output-error')}"
        )
    return free


def problem_of(model: Model) -> tuple[FreeProblem, list[float]]:
    """Return the estimation problem of a fitted model for runs that start at rest, and its parameter values.

    Raises
    ------
    ModelError
        If the model does not list its free parameters, or the list contradicts its equations.
    """
    parameter_set, estimate = parameter_set_of(model), model.estimate
    values = {} if estimate is None else estimate.values
    missing_names = [n for n in parameter_set.names if n not in values]
    count = sum(1 + len(e.terms) for e in model.equations)
    if missing_names or len(parameter_set.orders) != count:
        message = (
            f"no value of {missing_names[0]}"
            if missing_names
            else f"{len(parameter_set.orders)} orders where its equations have {count}"
        )
        raise ModelError(f"the fit results that the model stores have {message}; identify the model again")
    laws = iter(parameter_set.orders)
    equations = []
    for equation in model.equations:
        order = Order.parse(next(laws))
        terms = []
        for term in equation.terms:
            free = term.name in parameter_set.names or term.name in parameter_set.products
            coefficient = str(term.name) if free else term.coefficient
            terms.append(replace(term, order=Order.parse(next(laws)), coefficient=coefficient, name=None))
        equations.append(replace(equation, order=order, terms=tuple(terms)))
    names = {n for e in equations for n in e.order_names}
    delay_names = {s: input_name("delay", s) for s in model.structure.signals if s not in model.outputs}
    delays = {s: values[n] for s, n in delay_names.items() if n in parameter_set.names}
    structure = replace(
        model.structure,
        equations=tuple(equations),
        order_values={n: (values[n] - ORDER_BOUND_MARGIN, values[n] + ORDER_BOUND_MARGIN) for n in names},
        coefficient_law=tuple((n, sign, factors) for n, (sign, factors) in parameter_set.products.items()),
        delay={s: d for s, d in model.structure.delay.items() if s not in delays},
        free_delays={s: (min(d, 0.0), 2.0 * abs(d) + 1.0) for s, d in delays.items()},
        initial="rest",
    )
    problem = FreeProblem.of(structure)
    if set(problem.names) != set(parameter_set.names):
        different_names = sorted(set(problem.names) ^ set(parameter_set.names))
        raise ModelError(
            f"the fit results that the model stores contradict its equations: {different_names[0]}; identify the "
            "model again"
        )
    return problem, [values[n] for n in problem.names]
