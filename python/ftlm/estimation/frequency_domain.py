"""Fit of equations and circuits to measured frequency responses and impedances."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftlm import _core
from ftlm.data.frequency_data import FrequencyData, as_frequency_data
from ftlm.errors import ConvergenceError, DataError, ModelError
from ftlm.estimation.circuit_problem import CircuitProblem, check_admissible, profile_intervals
from ftlm.estimation.frequency_result import FrequencyIdentification
from ftlm.estimation.model_checks import (
    SAME_MODEL_POWER,
    SECOND_OPTIMUM_LOG_LIKELIHOOD,
    second_optimum_findings,
)
from ftlm.estimation.objective import covariance_of, propagated_covariance
from ftlm.estimation.prior_knowledge import Bounds, check_bounds, check_intervals, fit_within_bounds
from ftlm.estimation.response_problem import MAX_EXPONENT, ConstraintText, ResponseProblem
from ftlm.findings import Finding, make_finding
from ftlm.model.model import Estimate, Model
from ftlm.progress import FractionTracker, Progress
from ftlm.simulation.discretization import check_linear
from ftlm.structure.circuit import Circuit
from ftlm.structure.order import Values
from ftlm.structure.parser import equation
from ftlm.structure.structure import Structure
from ftlm.utils.arguments import check_arguments
from ftlm.utils.files import PACKAGE_LOGGER
from ftlm.utils.formatting import format_bound
from ftlm.utils.parameters import parameter
from ftlm.utils.resources import duration_bounds, estimate_duration
from ftlm.utils.statistics import ROUNDING_RESIDUAL_RATIO, chi_squared_99, is_white
from ftlm.utils.validation import Floats, as_floats, check_known, real_number
from ftlm.validation.information_criteria import InformationCriteria, criteria_of_likelihood

Weights = Literal["auto", "relative", "uniform", "deviation"]
#: Relative difference of two sums of squares below which both fits have ended at the same optimum.
SAME_OPTIMUM_TOLERANCE = 1e-6
#: RMS residual relative to the RMS response below which residuals are rounding errors.
RESIDUAL_FLOOR_RATIO = 1e-13
#: Maximum number of frequencies of a record that the multistart uses.
MAX_MULTISTART_FREQUENCIES = 800
#: Fractions of the progress at which the initial guesses are found, and at which the multistart ends.
STARTS_END_FRACTION, MULTISTART_END_FRACTION = 0.25, 0.85
#: Lowest and highest measured duration of a fit, relative to the time estimate.
DURATION_FACTOR_RANGE = (0.4, 4.0)
#: Maximum lag of the whiteness test over frequency; neighboring frequencies are one lag apart.
WHITENESS_LAGS = 8


@check_arguments
def identify_frequency(
    data: FrequencyData | Sequence[FrequencyData],
    structure: Structure | Circuit | str,
    *,
    weights: Weights | ArrayLike = "auto",
    orders: Mapping[str, Values] | None = None,
    fixed: Mapping[str, float] | None = None,
    delay: Mapping[str, float | tuple[float, float]] | None = None,
    start: Mapping[str, float] | None = None,
    bounds: Bounds | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> FrequencyIdentification:
    """Identify orders, coefficients and delays from a measured frequency response or impedance.

    The equations are written as for runs over time: ``"D^alpha y = a0 y + b0 u"`` has the response b0 / ((jω)^α - a0),
    and ``"D^alpha U = a U + r D^alpha I + b I"`` is the equation of a resistor in series with a depressed arc. Linear
    least squares on a grid of orders gives the initial guesses. Levenberg-Marquardt with exact derivatives then fits
    all parameters to the complex response.

    Parameters
    ----------
    data
        One measured response, or several of different signals or frequency bands.
    structure
        Structure to identify; see :func:`ftlm.equation`. Several outputs are simulated together from the inputs. For
        an impedance, it may also be a circuit such as ``"R0-p(R1,CPE1)-W1"``; see :class:`ftlm.Circuit`.
    weights
        Scale by which residuals are divided. ``"deviation"``: the standard deviations of the records. ``"relative"``:
        the magnitude of the response at each frequency, for noise proportional to it. ``"uniform"``: 1. ``"auto"``
        (default): ``"deviation"`` if all records state one, otherwise ``"relative"``. For one record, an array gives
        the standard deviation of the real and of the imaginary part at each frequency.
    orders, fixed, delay
        See :func:`ftlm.equation`. A grid of orders also gives their bounds, and a delay (low, high) in seconds is
        estimated. A circuit takes only `fixed`.
    start
        Additional initial guess by name. Missing orders and coefficients start at 1 (orders within their bounds),
        missing delays at 0, and missing values of a circuit at automatic guesses.
    bounds
        (lower, upper) of coefficients and orders by name; infinite without a bound on that side. A coefficient that
        ends on a bound is fixed at the bound, has no confidence interval, and is named by a finding.
    progress
        Callback with (work done, total work).

    Returns
    -------
    FrequencyIdentification
        Printable result. Its ``.model`` can be simulated over time, plotted and saved.

    Raises
    ------
    DataError
        If the data are invalid, a signal is not one of the equations, there are too few frequencies for the free
        parameters, or a response is 0 with relative weights.
    ModelError
        If nothing is free, the structure has a friction term, saturation, dead zone, offset, sensor filter or
        coefficient law, or a name or weight is unknown.
    ConvergenceError
        If no initial guess has a finite response.
    """
    if isinstance(structure, str) and "=" not in structure:
        structure = Circuit(structure)
    if isinstance(structure, Circuit):
        return _identify_circuit(
            as_frequency_data(data), structure, weights, fixed, bounds, start, progress, orders, delay
        )
    full_structure, limits = check_bounds(_structure(structure, orders, fixed, delay), bounds, start)
    records = _match_records(as_frequency_data(data), full_structure)
    kind, weight = _weights(records, weights)
    _user_start(ResponseProblem(full_structure, records, weight), start)

    def fit(
        variant: Structure, single_guess: Mapping[str, float] | None
    ) -> tuple[FrequencyIdentification, Mapping[str, float]]:
        problem = ResponseProblem(variant, records, weight)
        guess_source = start if single_guess is None else single_guess
        guess = (
            {n: v for n, v in guess_source.items() if n in problem.names}
            if isinstance(guess_source, Mapping)
            else guess_source
        )
        result = _fit_response(problem, records, weight, kind, guess, progress, single_start=single_guess is not None)
        return result, result.values

    result, bound_findings = fit_within_bounds(full_structure, limits, fit)
    result = replace(result, findings=(*result.findings, *bound_findings))
    return _log_result(result)


def _log_result(result: FrequencyIdentification) -> FrequencyIdentification:
    """Write the verdict and the findings of a result to the log, and return the result."""
    PACKAGE_LOGGER.info("identified: %s", result.verdict)
    for finding in result.findings:
        PACKAGE_LOGGER.warning("%s", finding)
    return result


def _identify_circuit(
    records: Sequence[FrequencyData],
    circuit: Circuit,
    weights: object,
    fixed: Mapping[str, float] | None,
    bounds: Bounds | None,
    start: Mapping[str, float] | None,
    progress: Callable[[int, int], None] | None,
    *inapplicable: object,
) -> FrequencyIdentification:
    """Identify the parameters of a circuit from measured impedances.

    Raise ModelError if a name is unknown, a bound is invalid, no parameter is free, or one of `inapplicable` is given:
    the options `orders` and `delay`, which apply to equations.
    """
    if any(inapplicable):
        raise ModelError(
            f"{parameter('orders')} and {parameter('delay')} apply to equations; give exponents of a circuit with "
            f"{parameter('fixed')} or {parameter('bounds')}"
        )
    check_known("fixed parameter", fixed or {}, circuit.names)
    circuit = circuit.with_values({n: real_number(n, v) for n, v in (fixed or {}).items()})
    check_intervals(bounds or {})
    check_known("bound of", bounds or {}, circuit.free_names)
    check_admissible(circuit.values, bounds or {})
    if not circuit.free_names:
        raise ModelError(f"no parameter of {circuit} is free; leave {parameter('fixed')} out")
    labeled = [replace(r, output=r.output or "U", input=r.input or "I", unit=r.unit or "Ω") for r in records]
    kind, weight = _weights(labeled, weights)
    problem = CircuitProblem(circuit, labeled, weight, bounds or {})
    return _log_result(_fit_response(problem, labeled, weight, kind, start, progress, single_start=False))


def _fit_response(
    problem: ResponseProblem,
    records: list[FrequencyData],
    weight: list[Floats],
    kind: str,
    start: Mapping[str, float] | None,
    progress: Callable[[int, int], None] | None,
    *,
    single_start: bool,
) -> FrequencyIdentification:
    """Fit a response problem from automatic guesses and from `start`; with `single_start`, from `start` alone.

    Raise DataError if there are no more measured values than parameters. Raise ConvergenceError if no initial guess has
    a finite response.
    """
    count, parameter_count = 2 * sum(r.frequency.size for r in records), len(problem.names)
    if count <= parameter_count:
        raise DataError(
            f"{count // 2} frequencies give {count} values, and {parameter_count} parameters are free "
            f"({', '.join(problem.names)}); measure more frequencies, or fix parameters"
        )
    if isinstance(progress, Progress):
        progress.announce(
            "the fit",
            *duration_bounds(
                estimate_duration(0.007 * parameter_count**2 + 2e-6 * parameter_count * count, 1), DURATION_FACTOR_RANGE
            ),
        )
    tracker = FractionTracker(progress)
    descriptions = problem.constraints()[2]
    PACKAGE_LOGGER.info("identifying %s from %s", ", ".join(problem.names), ", ".join(r.name for r in records))
    total = sum(float(np.sum(np.abs(r.response * w) ** 2)) for r, w in zip(records, weight, strict=True))
    # The multistart uses a subset of the frequencies. Only its best candidate is fitted to all of them.
    subsampled_records, subsampled_weights = zip(
        *(_subsample_data(r, w) for r, w in zip(records, weight, strict=True)), strict=True
    )
    multistart_problem = (
        problem
        if count <= 2 * MAX_MULTISTART_FREQUENCIES
        else problem.with_records(subsampled_records, subsampled_weights)
    )
    guesses = _user_start(multistart_problem, start)
    guesses += [] if single_start else multistart_problem.initial_guesses()
    tracker.advance_to(STARTS_END_FRACTION)
    fits = []
    for values in guesses:
        fits.append(_fit(multistart_problem, values))
        tracker.advance_to(
            STARTS_END_FRACTION + (MULTISTART_END_FRACTION - STARTS_END_FRACTION) * len(fits) / len(guesses)
        )
    fits = [f for f in fits if math.isfinite(f.cost)]
    if not fits:
        raise ConvergenceError(
            "no initial guess has a finite response: the order grid is empty or singular; widen "
            f"{parameter('orders')} or {parameter('bounds')} above 0, or give {parameter('start')}"
        )
    lowest = min(fits, key=lambda f: f.cost)
    reached_count = sum(
        f.cost <= lowest.cost * (1 + SAME_OPTIMUM_TOLERANCE) + 1e4 * RESIDUAL_FLOOR_RATIO**2 * total for f in fits
    )
    # Another fit from the best optimum continues steps that a bound has shortened.
    best = _fit_again(problem, multistart_problem, lowest)
    if multistart_problem is problem and lowest.cost < best.cost:
        best = lowest
    if start is None and np.any((sorted_values := problem.sort_groups(best.values)) != best.values):
        best = _fit(problem, sorted_values)
    tracker.advance_to(1.0)
    active_bounds = [descriptions[k] for k in best.active_constraints]
    at_limit = [bound for bound in active_bounds if bound.parameter in problem.exponents]
    if at_limit and not _is_bound_significant(problem, records, best, kind):
        active_bounds = [bound for bound in active_bounds if bound not in at_limit]
    near_optima = [
        f if multistart_problem is problem else _fit_again(problem, multistart_problem, f)
        for f in _near_optima(fits, multistart_problem, kind)
    ]
    return _result(
        problem,
        records,
        best,
        kind,
        (reached_count, len(fits)),
        active_bounds,
        exact=best.cost <= ROUNDING_RESIDUAL_RATIO**2 * total,
        near_optima=near_optima,
    )


def _structure(
    structure: Structure | str,
    orders: Mapping[str, Values] | None,
    fixed: Mapping[str, float] | None,
    delay: Mapping[str, float | tuple[float, float]] | None,
) -> Structure:
    """Return the structure to identify, parsed if it is text.

    Raises
    ------
    ModelError
        If it has non-linear terms, an offset, a sensor filter or a coefficient law.
    """
    target = equation(structure) if isinstance(structure, str) else structure
    if not isinstance(target, Structure):
        raise ModelError(f"structure is {type(structure).__name__}; give an equation: 'D^alpha y = a0 y + b0 u'")
    if fixed:
        check_known("fixed coefficient", fixed, target.coefficient_names)
    target = target.with_delays(delay or {}).with_orders(orders or {}).with_coefficients(fixed or {})
    reason = "which a fit of a frequency response does not support"
    if target.has_friction:
        raise ModelError(f"the equations have friction, {reason}; identify runs over time, or leave it out")
    check_linear(target.equations, "a frequency response")
    if target.limits:
        raise ModelError(f"{target.limits[0].signal} saturates or has a dead zone, {reason}; identify runs over time")
    if target.offset != "none":
        raise ModelError(f"the equations have an offset, {reason}; leave '+ c' out, or {parameter('offset')}")
    if target.sensor_filter is not None:
        raise ModelError("the structure has a sensor filter; divide the data by its response, and leave the filter out")
    if target.coefficient_law:
        raise ModelError(
            f"the structure has a coefficient law, which this fit does not impose; leave {parameter('laws')} out"
        )
    if not (target.order_names or target.coefficient_names or target.free_input_parameters):
        raise ModelError(
            "no parameter is free: every order, coefficient and delay is a number; give the unknown ones names"
        )
    return replace(target, coupling="simulated", initial="auto")


def _match_records(records: Sequence[FrequencyData], structure: Structure) -> list[FrequencyData]:
    """Return the records with missing signal names filled in from the structure.

    Raises
    ------
    DataError
        If a record has a signal that the equations lack, its signal is ambiguous, or an equation or input has no
        record.
    ModelError
        If the equations have no input.
    """
    outputs = structure.outputs
    inputs = tuple(s for s in structure.signals if s not in outputs)
    if not inputs:
        raise ModelError(f"the equations of {', '.join(outputs)} have no input; add an input term, as in '+ b0 u'")
    matches = []
    for record in records:
        signals = {"output": record.output, "input": record.input}
        for side, names in (("output", outputs), ("input", inputs)):
            if not signals[side]:
                if len(names) > 1:
                    raise DataError(
                        f"{record.name} does not name its {side}, and the equations have {', '.join(names)}; give "
                        f"{parameter(side)} when loading it"
                    )
                signals[side] = names[0]
            elif signals[side] not in names:
                raise DataError(
                    f"{record.name} has the {side} {signals[side]!r}, which is not an {side} of the equations; "
                    "these have "
                    f"{', '.join(names)}: write the equation in the names of the data, or give {parameter(side)} when "
                    "loading"
                )
        matches.append(replace(record, output=signals["output"], input=signals["input"]))
    for output in outputs:
        if not any(r.output == output for r in matches):
            raise DataError(
                f"no record has the output {output} of an equation; give such a record, or leave the equation out"
            )
    for name in inputs:
        if not any(r.input == name for r in matches):
            raise DataError(
                f"no record has the input {name} of the equations; give such a record, or leave the input out"
            )
    return matches


def _weights(records: Sequence[FrequencyData], weights: object) -> tuple[str, list[Floats]]:
    """Return the name of the weighting, and for each record an array of factors by which its residuals are multiplied.

    Raise ModelError if the weighting is unknown, or an array is given for several records. Raise DataError if a record
    states no standard deviation or, for relative weights, has a response of 0.
    """
    if not isinstance(weights, str):
        if len(records) > 1:
            raise ModelError(
                f"{parameter('weights')} as an array apply to one record; give each record its deviation instead"
            )
        (record,) = records
        return "deviation", [1.0 / _given_deviations(record, weights)]
    if weights not in ("auto", "relative", "uniform", "deviation"):
        raise ModelError(
            f"{parameter('weights', weights)} is not known; use 'auto', 'relative', 'uniform', 'deviation' or "
            "standard deviations"
        )
    deviations = [r.deviation for r in records]
    if weights == "deviation" or (weights == "auto" and all(d is not None for d in deviations)):
        unweighted = [r.name for r, d in zip(records, deviations, strict=True) if d is None]
        if unweighted:
            raise DataError(
                f"{unweighted[0]} states no standard deviation; use {parameter('weights', 'relative')} or give "
                f"{parameter('deviation')}"
            )
        return "deviation", [1.0 / d for d in deviations if d is not None]
    if weights == "uniform":
        return "uniform", [np.ones(r.frequency.size) for r in records]
    for record in records:
        magnitude = np.abs(record.response)
        if not np.all(magnitude > 0):
            at = int(np.argmin(magnitude))
            raise DataError(
                f"{record.name}: the response is 0 at row {at}, {int(np.sum(magnitude == 0))} in all, and has no "
                "relative "
                f"weight; leave such rows out, or use {parameter('weights', 'uniform')}"
            )
    return "relative", [1.0 / np.abs(r.response) for r in records]


def _given_deviations(record: FrequencyData, weights: object) -> Floats:
    """Return the user's standard deviations as an array with one value per frequency; raise DataError if invalid."""
    deviations = as_floats("weights", weights)
    if deviations.shape != record.frequency.shape:
        raise DataError(
            f"weights has shape {deviations.shape}, the data {record.frequency.shape}; give one standard deviation "
            "per frequency"
        )
    return np.asarray(replace(record, deviation=deviations).deviation)


def _subsample_data(record: FrequencyData, weight: Floats) -> tuple[FrequencyData, Floats]:
    """Return a record and its weights at a limited number of frequencies, spread evenly over the sorted ones."""
    if record.frequency.size <= MAX_MULTISTART_FREQUENCIES:
        return record, weight
    order = np.argsort(record.frequency, kind="stable")
    rows = order[np.linspace(0, order.size - 1, MAX_MULTISTART_FREQUENCIES).astype(int)]
    return replace(record, frequency=record.frequency[rows], response=record.response[rows], deviation=None), weight[
        rows
    ]


def _user_start(problem: ResponseProblem, start: Mapping[str, float] | None) -> list[Floats]:
    """Return a list with the user's initial guess in the variables of the optimizer; [] if there is none.

    Default values complete the guess.

    Raises
    ------
    ModelError
        If a name is unknown, or a value is not finite or out of its bounds.
    """
    if start is None:
        return []
    if not isinstance(start, Mapping):
        raise ModelError(f"start is {type(start).__name__}; give values by name, such as {{'alpha': 0.8}}")
    check_known("start", start, problem.names)
    defaults = problem.default_start()
    values = np.array([float(start.get(n, defaults.get(n, 0.0))) for n in problem.names])
    point, (rows, limits, _) = problem.in_problem_units(values), problem.constraints()
    if not (np.all(np.isfinite(values)) and np.all(rows @ point <= limits + 1e-9)):
        raise ModelError(
            f"{parameter('start')} is out of the bounds of orders or delays, or not finite; choose values within them"
        )
    return [point]


@dataclass(frozen=True)
class ResponseFit:
    """Optimum of a response problem.

    ``values`` are the variables of the optimizer, ``cost`` is the weighted sum of squared residuals, and
    ``active_constraints`` are the indices of the active linear constraints.
    """

    values: Floats
    cost: float
    converged: bool
    active_constraints: Sequence[int]


def _fit(problem: ResponseProblem, values: Floats) -> ResponseFit:
    rows, limits, _ = problem.constraints()
    norm = math.sqrt(sum(float(np.sum(np.abs(r.response * r.weight) ** 2)) for r in problem.records))

    def residuals(point: Floats) -> Floats:
        return problem.residuals(point, jacobian=False)[0]

    if not np.all(np.isfinite(residuals(values))):
        return ResponseFit(values, math.inf, False, ())
    optimum, cost, status, _, active = _core.minimize(
        residuals, lambda point: problem.residuals(point)[1], values, rows, limits, signal_norm=norm
    )
    return ResponseFit(optimum, cost, status == "converged", active)


def _optimum_and_cost(problem: ResponseProblem, values: Floats) -> tuple[Floats, float]:
    """Return the parameters and the cost of a fit; without free parameters, the cost alone is computed."""
    if not problem.names:
        residuals, _ = problem.residuals(values, jacobian=False)
        return values, float(residuals @ residuals)
    fit = _fit(problem, values)
    return fit.values, fit.cost


def _fit_again(problem: ResponseProblem, first_problem: ResponseProblem, optimum: ResponseFit) -> ResponseFit:
    """Return the fit of `problem` from `optimum`, the optimum of `first_problem`, which has the same parameters."""
    return _fit(problem, problem.in_problem_units(first_problem.in_seconds(optimum.values)))


def _log_likelihood_difference(cost: float, lowest_cost: float, kind: str, count: int) -> float:
    """Return the log-likelihood decrease when the sum of `count` squared residuals rises from `lowest_cost` to `cost`.

    The noise level is known for weights of the `kind` ``"deviation"``, and otherwise estimated.
    """
    if kind == "deviation":
        return (cost - lowest_cost) / 2.0
    return 0.5 * count * math.log(max(cost, 1e-300) / max(lowest_cost, 1e-300))


def _near_optima(fits: Sequence[ResponseFit], problem: ResponseProblem, kind: str) -> list[ResponseFit]:
    """Return other optima of the multistart that are nearly as likely as the best one but have different responses."""
    ranked = sorted(fits, key=lambda f: f.cost)
    optima, series = [], [problem.residuals(ranked[0].values, jacobian=False)[0]]
    for fit in ranked[1:]:
        residuals = problem.residuals(fit.values, jacobian=False)[0]
        if _log_likelihood_difference(fit.cost, ranked[0].cost, kind, residuals.size) > SECOND_OPTIMUM_LOG_LIKELIHOOD:
            break
        # Exchanged circuit elements give the same residuals and the same model.
        noise = ranked[0].cost / residuals.size
        if all(float(np.sum((residuals - other) ** 2)) > SAME_MODEL_POWER * noise for other in series):
            optima.append(fit)
            series.append(residuals)
    return optima


def _is_bound_significant(
    problem: ResponseProblem, records: Sequence[FrequencyData], best: ResponseFit, kind: str
) -> bool:
    """Whether exponents above their upper bound would fit an impedance significantly better, at 99 %."""
    free = ResponseProblem(problem.structure, records, [r.weight for r in problem.records], bound_exponents=False)
    unbounded = _fit(free, best.values)
    count = 2 * sum(r.frequency.size for r in problem.records)
    return 2.0 * _log_likelihood_difference(best.cost, unbounded.cost, kind, count) > chi_squared_99(1)


def _result(
    problem: ResponseProblem,
    records: list[FrequencyData],
    best: ResponseFit,
    kind: str,
    start_counts: tuple[int, int],
    active_bounds: list[ConstraintText],
    *,
    exact: bool,
    near_optima: Sequence[ResponseFit] = (),
) -> FrequencyIdentification:
    values = problem.in_seconds(best.values)
    rising = _frequency_order(records)
    residual_values = problem.residuals(best.values)[0][rising]
    series = _series(records, residual_values)
    names_on_bound = problem.names_on_user_bound(best.active_constraints)
    is_free = np.array([n not in names_on_bound for n in problem.names], dtype=bool)
    names = tuple(n for n in problem.names if n not in names_on_bound)
    free = residual_values.size - len(names)
    chi = best.cost / free
    is_cost_too_large = kind == "deviation" and best.cost > chi_squared_99(free)
    findings: list[Finding] = []

    def covariance_at(optimum: ResponseFit) -> Floats:
        residuals, jacobian = problem.residuals(optimum.values)
        free_jacobian = problem.jacobian_in_seconds(optimum.values, jacobian)[rising][:, is_free]
        residual_series = _series(records, residuals[rising])
        has_known_errors = kind == "deviation" and not is_cost_too_large
        squares = float(free) if has_known_errors else optimum.cost
        if has_known_errors or all(is_white(e) for e in residual_series):
            # Errors at different frequencies are independent. Only a model error correlates the residuals.
            residual_series = [np.zeros(e.size) for e in series]
        return covariance_of(free_jacobian.T, residual_series, squares)

    def errors_of(covariance: Floats) -> dict[str, float]:
        return dict(zip(names, np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist(), strict=True))

    covariance = covariance_at(best)
    is_whitened = exact or all(is_white(e, min(WHITENESS_LAGS, max(e.size // 4, 1))) for e in series)
    factor = float(_student(free)) if kind != "deviation" or is_cost_too_large else NormalDist().inv_cdf(0.975)
    standard = errors_of(covariance)
    if is_cost_too_large:
        findings.append(make_finding("deviations_exceeded", ratio=math.sqrt(chi)))
    if not is_whitened:
        findings.append(make_finding("response_not_white"))
    if not best.converged:
        findings.append(make_finding("response_not_converged"))
    likelihood_differences = [
        (end, _log_likelihood_difference(end.cost, best.cost, kind, residual_values.size)) for end in near_optima
    ]
    optima = [
        (problem.in_seconds(end.values)[is_free], difference, errors_of(covariance_at(end)))
        for end, difference in likelihood_differences
        if difference <= SECOND_OPTIMUM_LOG_LIKELIHOOD
    ]
    findings += second_optimum_findings(names, values[is_free], standard, optima)
    values_by_name = dict(zip(problem.names, values.tolist(), strict=True))
    intervals = problem.intervals(values, {n: factor * standard.get(n, math.nan) for n in problem.names})
    intervals = {n: intervals[n] for n in names}
    model: Model | Circuit
    compatible_limits: list[tuple[str, str]] = []
    if isinstance(problem, CircuitProblem):
        model = problem.circuit.with_values(values_by_name)
        noise = 1.0 if kind == "deviation" and not is_cost_too_large else chi
        profiles, compatible_limits = profile_intervals(
            problem, records, (best.values, best.cost), standard, noise, factor, _optimum_and_cost
        )
        intervals |= profiles
        for name, limit in compatible_limits:
            low, high = (format_bound(v, ".3g") for v in profiles[name])
            findings.append(make_finding("parameter_at_limit", parameter=name, limit=limit, low=low, high=high))
    else:
        model = _model(problem, records, values_by_name, values, covariance, standard, findings)
    reported_names = [name for name, _ in compatible_limits]
    for bound in active_bounds:
        limited = bound.parameter or ""
        if (
            isinstance(problem, CircuitProblem)
            and limited in problem.orders
            and values_by_name[limited] == MAX_EXPONENT
        ):
            texts = {"element": limited.removesuffix("_alpha"), "capacitor": problem.capacitor_of(limited)}
            findings.append(make_finding("cpe_is_capacitor", parameter=limited, **texts))
        elif limited not in reported_names:
            findings.append(make_finding("response_on_bound", bound=bound.text))
    findings += _identifiability_findings(
        problem, {n: values_by_name[n] for n in names if n not in reported_names}, standard
    )
    return FrequencyIdentification(
        model,
        tuple(records),
        kind,
        values_by_name,
        standard,
        intervals,
        names,
        covariance,
        chi if kind == "deviation" else None,
        best.converged,
        start_counts,
        is_whitened,
        tuple(findings),
        information=_information(problem, best.cost, kind),
    )


def _information(problem: ResponseProblem, cost: float, kind: str) -> InformationCriteria:
    """Return AIC, AICc and BIC for normal residuals.

    The noise level counts as a parameter unless standard deviations are given.
    """
    log_weights = [math.log(w) for record in problem.records for w in record.weight.tolist()]
    count = 2 * len(log_weights)
    if kind == "deviation":
        residual_scale, parameters = cost, len(problem.names)
    else:
        residual_scale, parameters = count * (math.log(max(cost, 1e-300) / count) + 1.0), len(problem.names) + 1
    likelihood = 2.0 * sum(log_weights) - 0.5 * (count * math.log(2.0 * math.pi) + residual_scale)
    return criteria_of_likelihood(likelihood, parameters, count)


def _frequency_order(records: Sequence[FrequencyData]) -> NDArray[np.intp]:
    """Return indices that sort the residual vector of a response problem by frequency within each record.

    The vector has all real parts, then all imaginary parts.
    """
    frequencies, at = [], 0
    for record in records:
        frequencies.append(at + np.argsort(record.frequency, kind="stable"))
        at += record.frequency.size
    all_frequencies = np.concatenate(frequencies)
    return np.concatenate([all_frequencies, at + all_frequencies])


def _series(records: Sequence[FrequencyData], residuals: Floats) -> list[Floats]:
    """Split a residual vector into the real part of each record, then the imaginary part of each record."""
    stops = np.cumsum([r.frequency.size for r in records])
    half = residuals.size // 2
    return [*np.split(residuals[:half], stops[:-1]), *np.split(residuals[half:], stops[:-1])]


def _identifiability_findings(
    problem: ResponseProblem, values: Mapping[str, float], standard: Mapping[str, float]
) -> list[Finding]:
    """Return findings on parameters that the data determine poorly or not at all."""
    unidentifiable = [n for n in values if not math.isfinite(standard[n])]
    out = []
    if unidentifiable:
        out.append(make_finding("response_not_separately_identifiable", parameter=", ".join(unidentifiable)))
    for name, value in values.items():
        error = standard[name]
        is_uncertain = error > 0.25 if name in problem.orders else error > 0.5 * abs(value)
        if math.isfinite(error) and is_uncertain:
            out.append(make_finding("response_parameter_imprecise", parameter=name, value=value, error=error))
    return out


def _model(
    problem: ResponseProblem,
    records: Sequence[FrequencyData],
    values_by_name: Mapping[str, float],
    values: Floats,
    covariance: Floats,
    standard: Mapping[str, float],
    findings: Sequence[Finding],
) -> Model:
    """Return the identified model with the estimate that a model file stores (covariance, errors, findings)."""
    orders = {n: round(values_by_name[n], 9) for n in problem.orders}
    delays = {free.signal: values_by_name[free.name] for free in problem.structure.free_input_parameters}
    structure = problem.structure.with_delays(delays).with_orders(orders)
    structure = structure.with_coefficients({n: values_by_name[n] for n in problem.coefficients})
    coefficient_covariance = None
    if np.all(np.isfinite(covariance)):
        rows = []
        for equation in problem.structure.equations:
            for order, term in [(equation.order, None), *((t.order, t) for t in equation.terms)]:
                row = np.zeros(values.size)
                for n, w in order.weights:
                    row[problem.names.index(n)] = w
                rows.append(row)
                if term is not None:
                    row = np.zeros(values.size)
                    if isinstance(term.coefficient, str):
                        row[problem.names.index(term.coefficient)] = term.factor
                    rows.append(row)
        rows += [np.array([float(n == name) for n in problem.names]) for name in structure.fixed_input_parameters]
        coefficient_covariance = tuple(tuple(row) for row in propagated_covariance(np.array(rows), covariance).tolist())
    units: dict[str, str] = {}
    if all(r.unit == "Ω" for r in records):
        units = {r.output: "V" for r in records} | {r.input: "A" for r in records}
    estimate = Estimate(
        method="frequency-response",
        runs=tuple(dict.fromkeys(r.name for r in records)),
        values=dict(values_by_name),
        standard_errors={n: e if math.isfinite(e) else None for n, e in standard.items()},
        covariance=coefficient_covariance,
        findings=tuple(f.to_file() for f in findings),
    )
    return Model(structure, orders, units, None, {"identified from": "frequency response"}, estimate)


def _student(degrees: int) -> float:
    """Return the 97.5 % quantile of Student's t distribution, accurate to 1 % for at least 4 degrees of freedom."""
    z, n = NormalDist().inv_cdf(0.975), float(degrees)
    terms = [(z**3 + z) / 4, (5 * z**5 + 16 * z**3 + 3 * z) / 96, (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384]
    return z + sum(t / n ** (k + 1) for k, t in enumerate(terms))
