"""Residuals and initial guesses for a fit of a circuit to measured impedances.

Resistances and other positive parameters are replaced by their logarithms; exponents are used as they are.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ftlm.data.frequency_data import FrequencyData
from ftlm.errors import ModelError
from ftlm.estimation.response_problem import (
    MAX_EXPONENT,
    MAX_STARTS,
    ConstraintText,
    ResponseProblem,
    ResponseRecord,
    halton,
)
from ftlm.structure.circuit import Circuit, impedance_and_derivatives
from ftlm.utils.parameters import parameter
from ftlm.utils.statistics import chi_squared_99
from ftlm.utils.validation import Complex, Floats

#: Number of points (time constants and impedance ratios) at which initial guesses are tried, and range of the impedance
#: ratios within a parallel group [decades].
START_POINTS, RATIO_DECADES = 400, 2.0
#: Minimum exponent, which distinguishes an element from a resistor, and range of the exponents of initial guesses.
MIN_EXPONENT, START_EXPONENTS = 0.05, (0.6, 1.0)
#: Minimum and maximum parameter in SI units.
PARAMETER_RANGE = (1e-18, 1e18)
#: Relative standard error of a positive parameter above which its interval is a profile-likelihood interval, because
#: a normal distribution of the logarithm is then inaccurate.
MAX_WALD_RELATIVE_ERROR = 0.2
#: Number of fits that bracket one bound of a profile-likelihood interval and that bisect the bracket, tolerance of the
#: bound relative to its distance from the estimate, and ratio of the ends above which a bracket is wide.
MAX_PROFILE_FITS, PROFILE_TOLERANCE, WIDE_RATIO = 40, 0.01, 10.0

#: Function that returns the optimum of a problem from an initial guess as (variables of the optimizer, cost).
Optimizer = Callable[["CircuitProblem", Floats], tuple[Floats, float]]


class CircuitProblem(ResponseProblem):
    """Estimation problem of a circuit: its free parameters and the measured impedances.

    The optimizer varies the logarithm of each positive parameter (resistance, capacitance, time constant), so that the
    parameter cannot become negative. Exponents are varied directly.
    """

    def __init__(
        self,
        circuit: Circuit,
        records: Sequence[FrequencyData],
        weights: Sequence[Floats],
        bounds: Mapping[str, tuple[float, float]],
    ) -> None:
        self.circuit, self.bounds, self.names = circuit, bounds, circuit.free_names
        self.exponents = ()
        self.orders = tuple(n for n in self.names if n.endswith("_alpha"))
        self.is_log = np.array([n not in self.orders for n in self.names], dtype=bool)
        self.records = [
            ResponseRecord(0, r.input, r.frequency, r.response, w) for r, w in zip(records, weights, strict=True)
        ]

    def with_records(self, records: Sequence[FrequencyData], weights: Sequence[Floats]) -> CircuitProblem:
        """Return the same problem for other measured impedances and weights."""
        return CircuitProblem(self.circuit, records, weights, self.bounds)

    def in_seconds(self, values: Floats) -> Floats:
        """Return the parameters in SI units from the variables of the optimizer."""
        return np.where(self.is_log, np.exp(np.where(self.is_log, values, 0.0)), values)

    def in_problem_units(self, values: Floats) -> Floats:
        """Return the variables of the optimizer: logarithms of positive parameters, exponents unchanged.

        A parameter that must be positive but is not gives NaN.
        """
        positive_values = np.where(values > 0, values, np.nan)
        return np.where(self.is_log, np.log(np.where(self.is_log, positive_values, 1.0)), values)

    def intervals(self, values: Floats, widths: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        """Return (low, high) of each parameter by name, in SI units, from half-widths by name.

        The bounds of a positive parameter are symmetric in its logarithm. An exponent is at most 1.
        """
        intervals = super().intervals(values, widths)
        for name, value, is_log in zip(self.names, values.tolist(), self.is_log.tolist(), strict=True):
            if is_log:
                with np.errstate(over="ignore"):
                    ratio = float(np.exp(widths[name] / value))
                intervals[name] = (value / ratio, value * ratio)
            else:
                intervals[name] = (intervals[name][0], min(intervals[name][1], MAX_EXPONENT))
        return intervals

    def jacobian_in_seconds(self, values: Floats, jacobian: Floats) -> Floats:
        """Convert a Jacobian with respect to logarithms to one with respect to the parameters."""
        return jacobian / np.where(self.is_log, self.in_seconds(values), 1.0)

    def responses(self, values: Floats, *, jacobian: bool = True) -> list[tuple[Complex, Complex | None]]:
        """Return, for each record, the impedance and its Jacobian of shape (frequencies, parameters).

        Derivatives are taken with respect to the variables of the optimizer. Without `jacobian` they are None.
        """
        by_parameter = dict(zip(self.names, self.in_seconds(values).tolist(), strict=True))
        out: list[tuple[Complex, Complex | None]] = []
        for record in self.records:
            z, by_name = impedance_and_derivatives(self.circuit, record.frequency, by_parameter)
            z = z + np.zeros(record.frequency.size)
            columns = [by_name[n] + np.zeros_like(z) for n in self.names] if jacobian else None
            out.append((z, None if columns is None else np.stack(columns, axis=1)))
        return out

    def constraints(self) -> tuple[Floats, Floats, list[ConstraintText]]:
        """Return (rows, limits, descriptions) of the linear constraints ``rows @ values <= limits``.

        They keep every parameter within its bounds, and exponents between 0.05 and 1. `values` are the variables of the
        optimizer.
        """
        rows, limits, descriptions = [], [], []
        for k, name in enumerate(self.names):
            low, high = admissible_range(name, self.bounds)
            for sign, end in ((1.0, high), (-1.0, low)):
                rows.append(sign * (np.arange(len(self.names)) == k))
                limits.append(sign * (math.log(end) if self.is_log[k] else end))
                descriptions.append(ConstraintText(f"{name} is at {'most' if sign > 0 else 'least'} {end:g}", name))
        return np.reshape(np.array(rows), (-1, len(self.names))), np.array(limits), descriptions

    def capacitor_of(self, name: str) -> str:
        """Return an unused name for a capacitor that replaces the constant-phase element whose exponent is `name`."""
        used_names = {parameter.partition("_")[0] for parameter in (*self.names, *self.circuit.values)}
        number = name.removeprefix("CPE").removesuffix("_alpha")
        return next(c for c in (f"C{number}", *(f"C{k}" for k in range(1, len(used_names) + 2))) if c not in used_names)

    def names_on_user_bound(self, active_constraints: Sequence[int]) -> list[str]:
        """Return the names of the parameters on a bound of the user, as opposed to a limit of the element."""
        names = []
        for k in active_constraints:
            name, side = self.names[k // 2], 1 - k % 2
            if admissible_range(name, self.bounds)[side] != admissible_range(name, {})[side]:
                names.append(name)
        return names

    def default_start(self) -> dict[str, float]:
        """Return the best automatic initial guess by name, in SI units."""
        return dict(zip(self.names, self.in_seconds(self.initial_guesses()[0]).tolist(), strict=True))

    def sort_groups(self, values: Floats) -> Floats:
        """Return the parameters with identical parallel groups in series sorted from the fastest to the slowest.

        An exchange of two such groups does not change the impedance. The frequency of the peak of -Im Z determines
        which group is faster.
        """
        kind, elements = self.circuit.tree
        if kind != "series" or self.circuit.values or self.bounds:
            return values
        out = values.copy()
        by_parameter = dict(zip(self.names, self.in_seconds(values).tolist(), strict=True))
        frequencies = np.concatenate([r.frequency for r in self.records])
        w = np.geomspace(frequencies.min() / 1e3, frequencies.max() * 1e3, 2000)
        groups_by_shape: dict[str, list[tuple[float, list[int]]]] = {}
        for element in (p for p in elements if p[0] == "parallel"):
            z, derivatives = impedance_and_derivatives(self.circuit, w, by_parameter, element)
            indices = [self.names.index(n) for n in derivatives]
            shape = re.sub(r"_?\d+'", "'", repr(element))
            groups_by_shape.setdefault(shape, []).append((-float(w[np.argmin(z.imag)]), indices))
        for group in groups_by_shape.values():
            for (_, source), (_, target) in zip(sorted(group), group, strict=True):
                out[target] = values[source]
        return out

    def initial_guesses(self) -> list[Floats]:
        """Return feasible initial guesses, most promising first.

        Time constants and exponents come from a Halton sequence over the measured band. Nonnegative least squares then
        give the impedance scale of each part in series.
        """
        frequencies = np.concatenate([r.frequency for r in self.records])
        slowest, fastest = -math.log10(float(frequencies.min())), -math.log10(float(frequencies.max()))
        kind, elements = self.circuit.tree
        series_elements = elements if kind == "series" else [self.circuit.tree]
        weight = np.concatenate([r.weight for r in self.records])
        target = np.concatenate([r.response for r in self.records]) * weight
        _, limits, _ = self.constraints()
        guesses = []
        for point in halton(START_POINTS, 2 * len(self.circuit.elements)):
            unit: dict[str, float] = {}
            for k, (letters, name) in enumerate(self.circuit.elements):
                tau = 10.0 ** (fastest + (slowest - fastest) * point[2 * k])
                size, alpha = (
                    10.0 ** (RATIO_DECADES * (point[2 * k + 1] - 0.5)),
                    float(np.interp(point[2 * k + 1], (0, 1), START_EXPONENTS)),
                )
                unit |= {
                    "R": {name: size},
                    "C": {name: tau},
                    "L": {name: tau},
                    "CPE": {f"{name}_Q": tau**alpha, f"{name}_alpha": alpha},
                    "W": {f"{name}_sigma": (2.0 * tau) ** -0.5},
                }.get(letters, {f"{name}_R": size, f"{name}_tau": tau})
            shapes = []
            for element in series_elements:
                z, derivatives = impedance_and_derivatives(self.circuit, frequencies, unit, element)
                shapes.append((z + np.zeros(frequencies.size), list(derivatives)))
            table = np.stack([z * weight for z, _ in shapes], axis=1)
            scales = _positive_least_squares(
                np.concatenate([table.real, table.imag]), np.concatenate([target.real, target.imag])
            )
            for (_, names), scale in zip(shapes, scales, strict=True):
                for n in names:
                    # An impedance is proportional to 1/Q and 1/C. Exponents and time constants do not scale it.
                    unit[n] *= 1.0 if n.endswith(("_alpha", "_tau")) else 1.0 / scale if n[0] == "C" else scale
            values = self.in_problem_units(np.array([unit[n] for n in self.names]))
            # The constraints of each parameter are its upper bound, then its lower bound.
            feasible = np.clip(values, -limits[1::2], limits[0::2])
            residuals, _ = self.residuals(feasible, jacobian=False)
            cost = float(residuals @ residuals)
            if math.isfinite(cost):
                guesses.append((cost, feasible))
        guesses.sort(key=lambda pair: pair[0])
        return [values for _, values in guesses[:MAX_STARTS]]


def admissible_range(name: str, bounds: Mapping[str, tuple[float, float]]) -> tuple[float, float]:
    """Return (lowest, highest) value of a circuit parameter within its bounds and the limits of its element."""
    minimum, maximum = (MIN_EXPONENT, MAX_EXPONENT) if name.endswith("_alpha") else PARAMETER_RANGE
    low, high = bounds.get(name, (minimum, maximum))
    return max(low, minimum), min(high, maximum)


def check_admissible(values: Mapping[str, float], bounds: Mapping[str, tuple[float, float]]) -> None:
    """Raise ModelError if a fixed value is not admissible, or if bounds leave at most one admissible value."""
    for name, value in values.items():
        minimum, maximum = admissible_range(name, {})
        # An element of the value 0 is absent.
        if not (minimum <= value <= maximum or (value == 0 and not name.endswith("_alpha"))):
            raise ModelError(
                f"{parameter('fixed', {name: value})} is not admissible: {name} lies between {minimum:g} and "
                f"{maximum:g}; "
                "fix it within this range, or leave it free"
            )
    for name, (low, high) in bounds.items():
        minimum, maximum = admissible_range(name, {})
        low_inside, high_inside = admissible_range(name, bounds)
        if not low_inside < high_inside:
            raise ModelError(
                f"bounds of {name}, {low:g} to {high:g}, leave no range: {name} lies between {minimum:g} and "
                f"{maximum:g}; "
                f"give bounds that overlap this range, or fix the value with {parameter('fixed')}"
            )
        if name.endswith("_alpha") and high > maximum:
            raise ModelError(
                f"bounds of {name}, {low:g} to {high:g}, exceed its largest value {maximum:g}; use {maximum:g}"
            )


def profile_intervals(
    problem: CircuitProblem,
    records: Sequence[FrequencyData],
    optimum: tuple[Floats, float],
    standard_errors: Mapping[str, float],
    noise: float,
    factor: float,
    optimize: Optimizer,
) -> tuple[dict[str, tuple[float, float]], list[tuple[str, str]]]:
    """Return profile-likelihood intervals of imprecise parameters, and the parameters that may be 0 or infinite.

    A positive parameter is imprecise if its relative standard error exceeds `MAX_WALD_RELATIVE_ERROR`. A bound of its
    interval is 0 or infinite if the data are compatible with that value.

    Parameters
    ----------
    problem, records
        Estimation problem and its measured impedances.
    optimum
        Optimum: variables of the optimizer and cost.
    standard_errors
        Standard errors by name, in SI units.
    noise
        Variance of a residual.
    factor
        Half-width of a 95 % interval divided by the standard error.
    optimize
        Function of a problem and an initial point that returns the optimum and its cost.

    Returns
    -------
    dict, list
        (low, high) by name in SI units, and (name, limit) of each parameter whose limit, "0" or "infinity", is not
        rejected at 99 %.
    """
    values, least_cost = optimum
    weights = [r.weight for r in problem.records]
    intervals, compatible_limits = {}, []
    estimates = dict(zip(problem.names, problem.in_seconds(values).tolist(), strict=True))
    for k, name in enumerate(problem.names):
        estimate, error = estimates[name], standard_errors.get(name, math.nan)
        if not problem.is_log[k] or not error > MAX_WALD_RELATIVE_ERROR * estimate:
            continue
        initial = np.delete(values, k)

        def likelihood_ratio(value: float, name: str = name, initial: Floats = initial) -> float:
            """Return twice the decrease of the log likelihood if the parameter has this value."""
            circuit = problem.circuit.with_values({name: value})
            _, cost = optimize(CircuitProblem(circuit, records, weights, problem.bounds), initial)
            return max(cost - least_cost, 0.0) / max(noise, 1e-300)

        interval_bounds = []
        for side, (limiting_value, text) in enumerate(((0.0, "0"), (math.inf, "infinity"))):
            limit, end = PARAMETER_RANGE[side], admissible_range(name, problem.bounds)[side]
            at_end = likelihood_ratio(end)
            if end == limit and math.isfinite(error) and at_end <= chi_squared_99(1):
                compatible_limits.append((name, text))
            is_open = at_end <= factor**2
            reached_bound = limiting_value if end == limit else end
            distance = error * factor
            interval_bounds.append(
                reached_bound if is_open else _bound_crossing(likelihood_ratio, estimate, end, factor**2, distance)
            )
        intervals[name] = (interval_bounds[0], interval_bounds[1])
    return intervals, compatible_limits


def _bound_crossing(
    function: Callable[[float], float], inner: float, outer: float, level: float, distance: float
) -> float:
    """Return the value between `inner` and `outer` at which `function` reaches `level`, by bracketing and bisection.

    `distance` is the expected distance from `inner`. A wide bracket is bisected geometrically.
    """
    sign = math.copysign(1.0, outer - inner)
    estimate = inner
    if min(distance, inner) <= 0 or not math.isfinite(distance):
        distance = inner
    for _ in range(MAX_PROFILE_FITS):
        trial = inner + sign * distance
        if not min(estimate, outer) < trial < max(estimate, outer):
            break
        if function(trial) > level:
            outer = trial
            break
        inner, distance = trial, 2.0 * distance
    for _ in range(MAX_PROFILE_FITS):
        is_wide = max(inner, outer) > WIDE_RATIO * min(inner, outer)
        distance = min(max(abs(inner - estimate), 1e-2 * outer), max(inner, outer))
        if not is_wide and abs(outer - inner) <= PROFILE_TOLERANCE * distance:
            break
        trial = math.sqrt(inner * outer) if is_wide else 0.5 * (inner + outer)
        if function(trial) > level:
            outer = trial
        else:
            inner = trial
    return outer


def _positive_least_squares(table: Floats, target: Floats) -> Floats:
    """Return a positive least-squares solution x of ``table @ x = target``.

    Components that are not positive are replaced by 0.001 of the largest component, for columns of unit norm.
    """
    norms = np.linalg.norm(table, axis=0)
    scaled = table / norms
    is_active = np.ones(norms.size, dtype=bool)
    solution = np.zeros(norms.size)
    while np.any(is_active):
        solution[:] = 0.0
        solution[is_active] = np.linalg.lstsq(scaled[:, is_active], target, rcond=None)[0]
        if np.all(solution[is_active] > 0):
            break
        is_active &= solution > 0
    minimum = 1e-3 * max(float(np.max(solution)), 1e-30)
    return np.asarray(np.maximum(solution, minimum) / norms)
