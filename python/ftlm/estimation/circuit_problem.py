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
        safe = np.where(values > 0, values, np.nan)
        return np.where(self.is_log, np.log(np.where(self.is_log, safe, 1.0)), values)

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
        rows, limits, words = [], [], []
        for k, name in enumerate(self.names):
            low, high = admissible_range(name, self.bounds)
            for sign, end in ((1.0, high), (-1.0, low)):
                rows.append(sign * (np.arange(len(self.names)) == k))
                limits.append(sign * (math.log(end) if self.is_log[k] else end))
                words.append(ConstraintText(f"{name} is at {'most' if sign > 0 else 'least'} {end:g}", name))
        return np.reshape(np.array(rows), (-1, len(self.names))), np.array(limits), words

    def capacitor_of(self, name: str) -> str:
        """Return an unused name for a capacitor that replaces the constant-phase element whose exponent is `name`."""
        taken = {parameter.partition("_")[0] for parameter in (*self.names, *self.circuit.values)}
        number = name.removeprefix("CPE").removesuffix("_alpha")
        return next(c for c in (f"C{number}", *(f"C{k}" for k in range(1, len(taken) + 2))) if c not in taken)

    def on_user_bound(self, active_constraints: Sequence[int]) -> list[str]:
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
        kind, rest = self.circuit.tree
        if kind != "series" or self.circuit.values or self.bounds:
            return values
        out = values.copy()
        by_parameter = dict(zip(self.names, self.in_seconds(values).tolist(), strict=True))
        every = np.concatenate([r.frequency for r in self.records])
        w = np.geomspace(every.min() / 1e3, every.max() * 1e3, 2000)
        alike: dict[str, list[tuple[float, list[int]]]] = {}
        for part in (p for p in rest if p[0] == "parallel"):
            z, derivatives = impedance_and_derivatives(self.circuit, w, by_parameter, part)
            places = [self.names.index(n) for n in derivatives]
            shape = re.sub(r"_?\d+'", "'", repr(part))
            alike.setdefault(shape, []).append((-float(w[np.argmin(z.imag)]), places))
        for group in alike.values():
            for (_, source), (_, target) in zip(sorted(group), group, strict=True):
                out[target] = values[source]
        return out

    def initial_guesses(self) -> list[Floats]:
        """Return feasible initial guesses, most promising first.

        Time constants and exponents come from a Halton sequence over the measured band. Nonnegative least squares then
        give the impedance scale of each part in series.
        """
        every = np.concatenate([r.frequency for r in self.records])
        slow, fast = -math.log10(float(every.min())), -math.log10(float(every.max()))
        kind, rest = self.circuit.tree
        parts = rest if kind == "series" else [self.circuit.tree]
        weight = np.concatenate([r.weight for r in self.records])
        goal = np.concatenate([r.response for r in self.records]) * weight
        _, limits, _ = self.constraints()
        guesses = []
        for point in halton(START_POINTS, 2 * len(self.circuit.elements)):
            unit: dict[str, float] = {}
            for k, (letters, name) in enumerate(self.circuit.elements):
                tau = 10.0 ** (fast + (slow - fast) * point[2 * k])
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
            for part in parts:
                z, derivatives = impedance_and_derivatives(self.circuit, every, unit, part)
                shapes.append((z + np.zeros(every.size), list(derivatives)))
            table = np.stack([z * weight for z, _ in shapes], axis=1)
            sizes = _positive_least_squares(
                np.concatenate([table.real, table.imag]), np.concatenate([goal.real, goal.imag])
            )
            for (_, names), scale in zip(shapes, sizes, strict=True):
                for n in names:
                    # An impedance is proportional to 1/Q and 1/C. Exponents and time constants do not scale it.
                    unit[n] *= 1.0 if n.endswith(("_alpha", "_tau")) else 1.0 / scale if n[0] == "C" else scale
            values = self.in_problem_units(np.array([unit[n] for n in self.names]))
            # The constraints of each parameter are its upper bound, then its lower bound.
            inside = np.clip(values, -limits[1::2], limits[0::2])
            residuals, _ = self.residuals(inside, jacobian=False)
            cost = float(residuals @ residuals)
            if math.isfinite(cost):
                guesses.append((cost, inside))
        guesses.sort(key=lambda pair: pair[0])
        return [values for _, values in guesses[:MAX_STARTS]]


def admissible_range(name: str, bounds: Mapping[str, tuple[float, float]]) -> tuple[float, float]:
    """Return (lowest, highest) value of a circuit parameter within its bounds and the limits of its element."""
    least, most = (MIN_EXPONENT, MAX_EXPONENT) if name.endswith("_alpha") else PARAMETER_RANGE
    low, high = bounds.get(name, (least, most))
    return max(low, least), min(high, most)


def check_admissible(values: Mapping[str, float], bounds: Mapping[str, tuple[float, float]]) -> None:
    """Raise ModelError if a fixed value is not admissible, or if bounds leave at most one admissible value."""
    for name, value in values.items():
        least, most = admissible_range(name, {})
        # An element of the value 0 is absent.
        if not (least <= value <= most or (value == 0 and not name.endswith("_alpha"))):
            raise ModelError(
                f"{parameter('fixed', {name: value})} is not admissible: {name} lies between {least:g} and {most:g}; "
                "fix it within this range, or leave it free"
            )
    for name, (low, high) in bounds.items():
        least, most = admissible_range(name, {})
        low_inside, high_inside = admissible_range(name, bounds)
        if not low_inside < high_inside:
            raise ModelError(
                f"bounds of {name}, {low:g} to {high:g}, leave no range: {name} lies between {least:g} and {most:g}; "
                f"give bounds that overlap this range, or fix the value with {parameter('fixed')}"
            )
        if name.endswith("_alpha") and high > most:
            raise ModelError(f"bounds of {name}, {low:g} to {high:g}, exceed its largest value {most:g}; use {most:g}")


def profile_intervals(
    problem: CircuitProblem,
    records: Sequence[FrequencyData],
    best: tuple[Floats, float],
    standard: Mapping[str, float],
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
    best
        Optimum: variables of the optimizer and cost.
    standard
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
    values, least_cost = best
    weights = [r.weight for r in problem.records]
    intervals, absent = {}, []
    estimates = dict(zip(problem.names, problem.in_seconds(values).tolist(), strict=True))
    for k, name in enumerate(problem.names):
        estimate, error = estimates[name], standard.get(name, math.nan)
        if not problem.is_log[k] or not error > MAX_WALD_RELATIVE_ERROR * estimate:
            continue
        warm = np.delete(values, k)

        def likelihood_ratio(value: float, name: str = name, warm: Floats = warm) -> float:
            """Return twice the decrease of the log likelihood if the parameter has this value."""
            circuit = problem.circuit.with_values({name: value})
            _, cost = optimize(CircuitProblem(circuit, records, weights, problem.bounds), warm)
            return max(cost - least_cost, 0.0) / max(noise, 1e-300)

        ends = []
        for side, (absence, words) in enumerate(((0.0, "0"), (math.inf, "infinity"))):
            limit, end = PARAMETER_RANGE[side], admissible_range(name, problem.bounds)[side]
            at_end = likelihood_ratio(end)
            if end == limit and math.isfinite(error) and at_end <= chi_squared_99(1):
                absent.append((name, words))
            is_open = at_end <= factor**2
            reached = absence if end == limit else end
            distance = error * factor
            ends.append(reached if is_open else _bound_crossing(likelihood_ratio, estimate, end, factor**2, distance))
        intervals[name] = (ends[0], ends[1])
    return intervals, absent


def _bound_crossing(
    function: Callable[[float], float], inside: float, outside: float, level: float, distance: float
) -> float:
    """Return the value between `inside` and `outside` at which `function` reaches `level`, by bracketing and bisection.

    `distance` is the expected distance from `inside`. A wide bracket is bisected geometrically.
    """
    sign = math.copysign(1.0, outside - inside)
    estimate = inside
    if min(distance, inside) <= 0 or not math.isfinite(distance):
        distance = inside
    for _ in range(MAX_PROFILE_FITS):
        trial = inside + sign * distance
        if not min(estimate, outside) < trial < max(estimate, outside):
            break
        if function(trial) > level:
            outside = trial
            break
        inside, distance = trial, 2.0 * distance
    for _ in range(MAX_PROFILE_FITS):
        is_wide = max(inside, outside) > WIDE_RATIO * min(inside, outside)
        distance = min(max(abs(inside - estimate), 1e-2 * outside), max(inside, outside))
        if not is_wide and abs(outside - inside) <= PROFILE_TOLERANCE * distance:
            break
        trial = math.sqrt(inside * outside) if is_wide else 0.5 * (inside + outside)
        if function(trial) > level:
            outside = trial
        else:
            inside = trial
    return outside


def _positive_least_squares(table: Floats, goal: Floats) -> Floats:
    """Return a positive least-squares solution x of ``table @ x = goal``.

    Components that are not positive are replaced by 0.001 of the largest component, for columns of unit norm.
    """
    lengths = np.linalg.norm(table, axis=0)
    scaled = table / lengths
    is_active = np.ones(lengths.size, dtype=bool)
    sizes = np.zeros(lengths.size)
    while np.any(is_active):
        sizes[:] = 0.0
        sizes[is_active] = np.linalg.lstsq(scaled[:, is_active], goal, rcond=None)[0]
        if np.all(sizes[is_active] > 0):
            break
        is_active &= sizes > 0
    least = 1e-3 * max(float(np.max(sizes)), 1e-30)
    return np.asarray(np.maximum(sizes, least) / lengths)
