"""Residuals of measured frequency responses with exact derivatives, and initial guesses."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ftlm.data.frequency_data import FrequencyData
from ftlm.structure.equation import Equation, Term
from ftlm.structure.order import MAX_DEFAULT_SEARCH_ORDER, MAX_IMPROPER_ORDER, MAX_ORDER, MIN_INPUT_ORDER, Order
from ftlm.structure.structure import Structure
from ftlm.utils.parameters import parameter
from ftlm.utils.validation import Complex, Floats

#: Lower limit of the order of an equation, and minimum difference between it and the orders of other output terms.
MIN_HIGHEST_ORDER, MIN_ORDER_GAP = 0.01, 0.005


#: Maximum exponent of a constant-phase element: that of a capacitor.
MAX_EXPONENT = 1.0


class ConstraintText(NamedTuple):
    """Description of a linear constraint for messages, and the parameter that it bounds (None if it bounds several)."""

    text: str
    parameter: str | None = None


def is_impedance(record: FrequencyData) -> bool:
    """Whether the unit of a record ends in Ω, so that the record is an impedance."""
    return record.unit.endswith("Ω")


@dataclass(frozen=True)
class ResponseRecord:
    """One measured frequency response in scaled time, with its weights.

    ``output`` is the index of an equation, ``input`` the name of a signal, and ``frequency`` is divided by the unit of
    the problem. Residuals are multiplied by ``weight``.
    """

    output: int
    input: str
    frequency: Floats
    response: Complex
    weight: Floats


class ResponseProblem:
    """Estimation problem of a structure from measured frequency responses, in scaled time.

    The time unit is 1/`unit` seconds, where `unit` is the geometric mean of the measured frequencies. Parameters are
    then near 1. Parameter vectors are in the sequence of `names`: free orders, free coefficients, free delays.
    """

    def __init__(
        self,
        structure: Structure,
        records: Sequence[FrequencyData],
        weights: Sequence[Floats],
        *,
        bound_exponents: bool = True,
    ) -> None:
        self.structure = structure
        self.orders = structure.order_names
        self.coefficients = tuple(dict.fromkeys(structure.coefficient_names))
        self.delays = tuple(item.signal for item in structure.free_input_parameters)
        self.names = (*self.orders, *self.coefficients, *(item.name for item in structure.free_input_parameters))
        #: Free orders of an impedance for which the user gives no values. They are exponents of constant-phase elements
        #: and at most 1. A sum such as alpha + 0.5 may exceed 1.
        self.exponents = tuple(
            n
            for n in self.orders
            if bound_exponents and n not in structure.order_values and all(map(is_impedance, records))
        )
        frequencies = np.concatenate([r.frequency for r in records])
        self.unit = float(np.exp(np.mean(np.log(frequencies))))
        self.records = [
            ResponseRecord(structure.outputs.index(r.output), r.input, r.frequency / self.unit, r.response, w)
            for r, w in zip(records, weights, strict=True)
        ]
        self.known_delays = {name: value * self.unit for name, value in structure.delay.items()}
        self._order_index = {name: k for k, name in enumerate(self.orders)}
        at = len(self.orders)
        self._coefficient = {name: at + k for k, name in enumerate(self.coefficients)}
        self._delay = {name: at + len(self.coefficients) + k for k, name in enumerate(self.delays)}
        #: (equation, term) of each free coefficient, by name.
        self.term_of = {t.coefficient: (e, t) for e in structure.equations for t in e.terms}

    def with_records(self, records: Sequence[FrequencyData], weights: Sequence[Floats]) -> ResponseProblem:
        """Return the same problem for other measured responses and weights."""
        return ResponseProblem(self.structure, records, weights)

    def names_on_user_bound(self, active_constraints: Sequence[int]) -> list[str]:
        """Return an empty list: bounds of coefficients are imposed by :func:`fit_within_bounds`."""
        return []

    def default_start(self) -> dict[str, float]:
        """Return default values of orders and coefficients by name, which complete a user's initial guess."""
        values = dict.fromkeys(self.coefficients, 1.0)
        for name in self.orders:
            grid = self.structure.order_values.get(name, (1.0,))
            values[name] = min(max(1.0, grid[0]), grid[-1])
        return values

    def sort_groups(self, values: Floats) -> Floats:
        """Return the parameters unchanged: equations, unlike circuits, have no exchangeable groups to sort."""
        return values

    def initial_guesses(self) -> list[Floats]:
        """Return feasible initial guesses, most promising first."""
        return initial_guesses(self)

    def order_at(self, order: Order, values: Floats) -> float:
        """Return the value of an order of the equations at given parameters."""
        return order.constant + math.fsum(w * float(values[self._order_index[n]]) for n, w in order.weights)

    def in_problem_units(self, values: Floats) -> Floats:
        """Convert parameters from seconds to the time unit of this problem."""
        return self._convert_time_unit(values, -1.0)

    def in_seconds(self, values: Floats) -> Floats:
        """Convert parameters from the time unit of this problem to seconds."""
        return self._convert_time_unit(values, 1.0)

    def intervals(self, values: Floats, widths: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        """Return (low, high) by name from half-widths by name; parameters are in SI units (seconds)."""
        return {n: (v - widths[n], v + widths[n]) for n, v in zip(self.names, values.tolist(), strict=True)}

    def _convert_time_unit(self, values: Floats, power_sign: float) -> Floats:
        out = values.astype(np.float64).copy()
        for name, at in self._coefficient.items():
            equation, term = self.term_of[name]
            power = self.order_at(equation.order, values) - self.order_at(term.order, values)
            out[at] *= self.unit ** (power_sign * power)
        for at in self._delay.values():
            out[at] *= self.unit**-power_sign
        return out

    def jacobian_in_seconds(self, values: Floats, jacobian: Floats) -> Floats:
        """Convert a Jacobian with respect to scaled parameters to one with respect to parameters in seconds."""
        out = jacobian.copy()
        log = np.log(self.unit)
        for name, at in self._coefficient.items():
            equation, term = self.term_of[name]
            power = self.order_at(equation.order, values) - self.order_at(term.order, values)
            # The scaled coefficient c unit^-(alpha - order) depends on the coefficient c and on the orders.
            for order, sign in ((equation.order, -1.0), (term.order, 1.0)):
                for n, w in order.weights:
                    out[:, self._order_index[n]] += sign * w * log * float(values[at]) * jacobian[:, at]
            out[:, at] *= self.unit**-power
        for at in self._delay.values():
            out[:, at] *= self.unit
        return out

    def coefficient(self, term: Term, equation: Equation, values: Floats) -> float:
        """Return the coefficient of an equation's term, in the time unit of this problem."""
        if isinstance(term.coefficient, str):
            return term.factor * float(values[self._coefficient[term.coefficient]])
        power = self.order_at(equation.order, values) - self.order_at(term.order, values)
        return float(term.fixed_value or 0.0) * math.pow(self.unit, -power)

    def shift(self, signal: str, values: Floats) -> float:
        """Return the delay of an input, in the time unit of this problem."""
        at = self._delay.get(signal)
        return self.known_delays.get(signal, 0.0) if at is None else float(values[at])

    def responses(self, values: Floats, *, jacobian: bool = True) -> list[tuple[Complex, Complex | None]]:
        """Return, for each record, the complex model response and its Jacobian of shape (frequencies, parameters).

        The Jacobian is None without `jacobian`.
        """
        return [self._response(record, values, jacobian) for record in self.records]

    def _response(self, record: ResponseRecord, values: Floats, jacobian: bool) -> tuple[Complex, Complex | None]:
        s = 1j * record.frequency
        log = np.log(s)
        items, names = self.structure.equations, self.structure.outputs
        matrix = np.zeros((s.size, len(items), len(items)), dtype=np.complex128)
        inputs_matrix = np.zeros((s.size, len(items)), dtype=np.complex128)
        powers: dict[tuple[int, int], Complex] = {}
        for i, equation in enumerate(items):
            powers[i, -1] = np.exp(self.order_at(equation.order, values) * log)
            matrix[:, i, i] += powers[i, -1]
            for k, term in enumerate(equation.terms):
                if term.signal not in names and term.signal != record.input:
                    continue
                powers[i, k] = np.exp(self.order_at(term.order, values) * log)
                part = self.coefficient(term, equation, values) * powers[i, k]
                if term.signal in names:
                    matrix[:, i, names.index(term.signal)] -= part
                else:
                    inputs_matrix[:, i] += part
        delay_factor = np.exp(-s * self.shift(record.input, values))
        try:
            outputs_matrix = np.linalg.solve(matrix, (inputs_matrix * delay_factor[:, None])[..., None])[..., 0]
            unit = np.zeros((s.size, len(items), 1), dtype=np.complex128)
            unit[:, record.output] = 1.0
            solutions = np.linalg.solve(matrix.transpose(0, 2, 1), unit)[..., 0] if jacobian else None
        except np.linalg.LinAlgError:
            undefined = np.full(s.size, np.nan, dtype=np.complex128)
            return undefined, np.full((s.size, len(self.names)), np.nan, dtype=np.complex128) if jacobian else None
        response = np.asarray(outputs_matrix[:, record.output], dtype=np.complex128)
        if solutions is None:
            return response, None
        out = np.zeros((s.size, len(self.names)), dtype=np.complex128)
        for i, equation in enumerate(items):
            for n, w in equation.order.weights:
                out[:, self._order_index[n]] -= w * log * solutions[:, i] * powers[i, -1] * outputs_matrix[:, i]
            for k, term in enumerate(equation.terms):
                if (i, k) not in powers:
                    continue
                signal = outputs_matrix[:, names.index(term.signal)] if term.signal in names else delay_factor
                coefficient = self.coefficient(term, equation, values)
                derivative = solutions[:, i] * powers[i, k] * signal
                for n, w in term.order.weights:
                    out[:, self._order_index[n]] += w * coefficient * log * derivative
                if not isinstance(term.coefficient, str):
                    # A fixed coefficient is given in seconds. Its value in scaled time depends on the orders.
                    for order, sign in ((equation.order, -1.0), (term.order, 1.0)):
                        for n, w in order.weights:
                            out[:, self._order_index[n]] += sign * w * np.log(self.unit) * coefficient * derivative
                else:
                    out[:, self._coefficient[term.coefficient]] += term.factor * derivative
        if record.input in self._delay:
            out[:, self._delay[record.input]] = -s * response
        return response, out

    def residuals(self, values: Floats, *, jacobian: bool = True) -> tuple[Floats, Floats]:
        """Return the weighted residuals (model minus measurement) and their Jacobian.

        All real parts precede all imaginary parts. Without `jacobian`, the Jacobian has no columns.
        """
        residual_parts, rows = [], []
        with np.errstate(all="ignore"):
            for record, (response, derivatives) in zip(
                self.records, self.responses(values, jacobian=jacobian), strict=True
            ):
                residual_parts.append((response - record.response) * record.weight)
                if derivatives is not None:
                    rows.append(derivatives * record.weight[:, None])
        flat = np.concatenate(residual_parts)
        matrix = np.concatenate(rows) if rows else np.zeros((flat.size, 0), dtype=np.complex128)
        return np.concatenate([flat.real, flat.imag]), np.concatenate([matrix.real, matrix.imag])

    def constraints(self) -> tuple[Floats, Floats, list[ConstraintText]]:
        """Return (rows, limits, descriptions) of the constraints ``rows @ values <= limits`` on orders and delays."""
        rows: list[Floats] = []
        limits: list[float] = []
        descriptions: list[ConstraintText] = []

        def add(order: Order, maximum: float, text: str, sign: float = 1.0, *, name: str | None = None) -> None:
            row = np.zeros(len(self.names))
            for n, w in order.weights:
                row[self._order_index[n]] += sign * w
            if np.any(row):
                rows.append(row)
                limits.append(maximum - sign * order.constant)
                descriptions.append(ConstraintText(text, name))

        for equation in self.structure.equations:
            add(equation.order, MAX_ORDER, f"the highest order of {equation.output} is at most 10")
            add(equation.order, -MIN_HIGHEST_ORDER, f"the highest order of {equation.output} is above 0", -1.0)
            for term in equation.terms:
                is_output_term = term.signal == equation.output
                name = str(term.order)
                low, upper = (
                    (0.0, -MIN_ORDER_GAP) if is_output_term else (MIN_INPUT_ORDER, MAX_IMPROPER_ORDER - MIN_ORDER_GAP)
                )
                add(term.order, -low, f"order {name} is from {low:g} on", -1.0)
                both = dict(term.order.weights)
                for n, w in equation.order.weights:
                    both[n] = both.get(n, 0.0) - w
                variables = tuple(sorted((n, w) for n, w in both.items() if w))
                gap = Order(term.order.constant - equation.order.constant, variables)
                add(
                    gap,
                    upper,
                    f"order {name} stays below {equation.order} of {equation.output}{'' if is_output_term else ' + 1'}",
                )
        for name, values in self.structure.order_values.items():
            if name in self._order_index:
                add(Order(0.0, ((name, 1.0),)), values[-1], f"{name} is at most {values[-1]:g}")
                add(Order(0.0, ((name, 1.0),)), -values[0], f"{name} is from {values[0]:g} on", -1.0)
        for name in self.exponents:
            text = f"exponent {name} is at most {MAX_EXPONENT:g}, unless {parameter('orders')} gives more"
            add(Order(0.0, ((name, 1.0),)), MAX_EXPONENT, text, name=name)
        for free in self.structure.free_input_parameters:
            for sign, end in ((1.0, free.bounds[1]), (-1.0, free.bounds[0])):
                row = np.zeros(len(self.names))
                row[self._delay[free.signal]] = sign
                rows.append(row)
                limits.append(sign * end * self.unit)
                descriptions.append(
                    ConstraintText(f"{free.description} is {'at most' if sign > 0 else 'at least'} {end:g} s")
                )
        table = np.array(rows) if rows else np.zeros((0, len(self.names)))
        return table, np.array(limits), descriptions

    def search_ranges(self) -> dict[str, tuple[float, ...] | tuple[float, float]]:
        """Return for each free order its grid values if it has any, else the interval (low, high) to search."""
        out: dict[str, tuple[float, ...] | tuple[float, float]] = {}
        for name in self.orders:
            if name in self.structure.order_values:
                out[name] = tuple(self.structure.order_values[name])
                continue
            output_orders = [e.order for e in self.structure.equations if name in e.order.names]
            highest = MAX_EXPONENT if name in self.exponents else self._highest()
            out[name] = (0.1, highest) if output_orders else (0.0, highest)
        return out

    def _highest(self) -> float:
        """Return the upper limit of orders without grid values, in the search for initial guesses."""
        orders = [o for e in self.structure.equations for o in (e.order, *(t.order for t in e.terms))]
        return max([MAX_DEFAULT_SEARCH_ORDER, *(o.constant for o in orders if not o.names)])


#: Maximum numbers of grid points, of frequencies, of reweighting iterations, and of returned initial guesses.
MAX_GRID_POINTS, MAX_START_FREQUENCIES, REWEIGHTING_ITERATIONS, MAX_STARTS = 3000, 160, 4, 8
#: Maximum number of grid points whose exact cost is computed, number of corner frequencies for one grid point, and
#: maximum number of grid points with corner frequencies.
MAX_EVALUATED_POINTS, CORNERS_PER_POINT, MAX_CORNER_POINTS = 60, 14, 120


def initial_guesses(problem: ResponseProblem) -> list[Floats]:
    """Return feasible initial guesses, most promising first."""
    points = _order_delay_grid(problem)
    guesses = _linear_coefficients(problem, points) if problem.coefficients else list(points)
    candidates = []
    for values in guesses:
        residuals, _ = problem.residuals(values, jacobian=False)
        cost = float(residuals @ residuals)
        if np.isfinite(cost):
            candidates.append((cost, values))
    candidates.sort(key=lambda pair: pair[0])
    distinct_guesses: list[Floats] = []
    first, last = len(problem.orders), len(problem.orders) + len(problem.coefficients)
    free = [k for k in range(len(problem.names)) if not first <= k < last]
    for _, values in candidates:
        if (
            all(np.max(np.abs(values[free] - other[free]), initial=0.0) > 0.1 for other in distinct_guesses)
            or not distinct_guesses
        ):
            distinct_guesses.append(values)
        if len(distinct_guesses) == MAX_STARTS:
            break
    return distinct_guesses


def _order_delay_grid(problem: ResponseProblem) -> Floats:
    """Return feasible grid points of orders and delays, of shape (points, parameters); coefficients are 0."""
    axes = list(problem.search_ranges().values())
    has_values = [n in problem.structure.order_values for n in problem.orders]
    delays = [
        (item.bounds[0] * problem.unit, item.bounds[1] * problem.unit)
        for item in problem.structure.free_input_parameters
    ]
    # The fit still converges from a delay error of a third of a period at the highest frequency.
    fastest = max(float(r.frequency.max()) for r in problem.records)
    delay_counts = [int(np.clip(np.ceil((high - low) * fastest / 2.0) + 1, 2, 60)) for low, high in delays]
    point_budget = max(MAX_GRID_POINTS // int(np.prod(delay_counts, initial=1)), 60)
    count = len(axes)
    grid_size = int(np.prod([len(a) if g else 1 for a, g in zip(axes, has_values, strict=True)], initial=1))
    free = count - sum(has_values)
    values_per_order = (
        int(np.floor((point_budget / max(grid_size, 1)) ** (1.0 / free))) if free and grid_size <= point_budget else 0
    )
    if (free and values_per_order < 4) or (not free and grid_size > point_budget):
        # For too many axes, a deterministic low-discrepancy sequence replaces the grid.
        halton_points = halton(point_budget, count)
        columns = [
            np.asarray(a)[(halton_points[:, k] * len(a)).astype(int)]
            if g
            else a[0] + halton_points[:, k] * (a[1] - a[0])
            for k, (a, g) in enumerate(zip(axes, has_values, strict=True))
        ]
        orders = np.stack(columns, axis=1)
    else:
        axis_values = [
            a if g else np.linspace(a[0], a[1], min(values_per_order, 31))
            for a, g in zip(axes, has_values, strict=True)
        ]
        orders = _cartesian_product(axis_values)
    delay_values = _cartesian_product([np.linspace(a, b, n) for (a, b), n in zip(delays, delay_counts, strict=True)])
    table = np.zeros((len(orders) * len(delay_values), len(problem.names)))
    table[:, :count] = np.repeat(orders, len(delay_values), axis=0)
    table[:, len(problem.names) - len(delays) :] = np.tile(delay_values, (len(orders), 1))
    rows, limits, _ = problem.constraints()
    is_feasible = np.all(table @ rows.T <= limits + 1e-12, axis=1)
    points: Floats = table[is_feasible]
    return points


def _cartesian_product(axis_values: Sequence[Sequence[float] | Floats]) -> Floats:
    """Return the Cartesian product of grid axes, of shape (points, axes)."""
    rows = list(itertools.product(*axis_values))
    return np.array(rows, dtype=np.float64).reshape(len(rows), len(axis_values))


def halton(count: int, dimension: int) -> Floats:
    """Return the first `count` points of the Halton sequence in the unit cube of `dimension` dimensions."""
    primes = [p for p in range(2, 300) if all(p % q for q in range(2, int(p**0.5) + 1))][:dimension]
    out = np.zeros((count, dimension))
    for k, base in enumerate(primes):
        index, fraction = np.arange(1, count + 1), 1.0
        while np.any(index):
            fraction /= base
            out[:, k] += fraction * (index % base)
            index = index // base
    return out


def _linear_coefficients(problem: ResponseProblem, points: Floats) -> list[Floats]:
    """Return the best initial guesses: grid points with coefficients by linear least squares.

    The coefficients of each equation are computed separately. Points are sorted by the total cost of all equations.
    """
    repeated_points = points[
        np.unique(np.linspace(0, len(points) - 1, min(MAX_CORNER_POINTS, len(points))).astype(int))
    ]
    points, corners = (
        np.concatenate([points, np.repeat(repeated_points, CORNERS_PER_POINT, axis=0)]),
        _corner_frequencies(problem, len(points), repeated_points),
    )
    table = points.copy()
    costs = np.zeros(len(points))
    for i, equation in enumerate(problem.structure.equations):
        names = [n for n in equation.coefficient_names if n in problem.coefficients]
        records = [r for r in problem.records if r.output == i]
        if not records:
            continue
        coefficients, cost = _equation_coefficients(
            problem, i, names, [_subsample_record(r) for r in records], points, corners
        )
        for k, name in enumerate(names):
            table[:, problem.names.index(name)] = coefficients[:, k]
        costs += np.where(np.isfinite(cost), cost, np.inf)
    best = np.argsort(costs, kind="stable")[:MAX_EVALUATED_POINTS]
    return [table[k] for k in best if np.isfinite(costs[k])]


def _corner_frequencies(problem: ResponseProblem, estimated_count: int, repeated_points: Floats) -> Floats:
    """Return, for each grid point, the corner frequency that fixes the coefficient of the slowest output term.

    The slowest output term is the one that dominates at low frequencies. The corner frequency is NaN for the first
    points (`estimated_count` is their number), where this coefficient is estimated. The other points are repetitions of
    the points in `repeated_points`, each with corner frequencies distributed over the measured band.

    If noise hides a small arc of an impedance, iteratively reweighted least squares are biased. The coefficients of
    output terms are then far too small or too large. If the slowest output term is fixed, the remaining bias is small.
    """
    measured = np.concatenate([r.frequency for r in problem.records])
    frequencies = np.geomspace(measured.min(), measured.max(), CORNERS_PER_POINT)
    return np.concatenate([np.full(estimated_count, np.nan), np.tile(frequencies, len(repeated_points))])


def _subsample_record(record: ResponseRecord) -> ResponseRecord:
    """Return a record at the limited number of frequencies that an initial guess needs."""
    order = np.argsort(record.frequency, kind="stable")
    if order.size > MAX_START_FREQUENCIES:
        order = order[np.linspace(0, order.size - 1, MAX_START_FREQUENCIES).astype(int)]
    return ResponseRecord(
        record.output, record.input, record.frequency[order], record.response[order], record.weight[order]
    )


def _equation_coefficients(
    problem: ResponseProblem,
    output_index: int,
    names: Sequence[str],
    records: Sequence[ResponseRecord],
    points: Floats,
    corners: Floats,
) -> tuple[Floats, Floats]:
    """Return the coefficients of one equation at every grid point by reweighted least squares, and their cost.

    The coefficients have shape (points, names), and the cost has shape (points,). `output_index` is the index of the
    equation, and `corners` are the corner frequencies from :func:`_corner_frequencies`.
    """
    equation = problem.structure.equations[output_index]
    alpha = _orders(problem, equation.order.constant, equation.order.weights, points)
    columns: dict[str, list[Complex]] = {n: [] for n in names}
    output_columns: dict[str, list[Complex]] = {}
    targets, powers_by_record = [], []
    for record in records:
        log = np.log(1j * record.frequency)
        delay_factor = np.exp(-1j * record.frequency * _shifts(problem, record.input, points)[:, None])
        powers = np.exp(alpha[:, None] * log)
        powers_by_record.append(powers)
        target = powers * record.response
        for term in equation.terms:
            signal = _signal(problem, record, term.signal, delay_factor)
            power = np.exp(_orders(problem, term.order.constant, term.order.weights, points)[:, None] * log)
            if isinstance(term.coefficient, str):
                columns[term.coefficient].append(term.factor * power * signal)
                if term.signal == equation.output:
                    output_columns.setdefault(term.coefficient, []).append(term.factor * power)
            else:
                gap = alpha - _orders(problem, term.order.constant, term.order.weights, points)
                fixed_coefficient = float(term.fixed_value or 0.0) * problem.unit ** -gap[:, None]
                target = target - fixed_coefficient * power * signal
                if term.signal == equation.output:
                    powers_by_record[-1] = powers_by_record[-1] - fixed_coefficient * power
        targets.append(target)
    weight = np.concatenate([r.weight for r in records])
    target, powers = np.concatenate(targets, axis=1), np.concatenate(powers_by_record, axis=1)
    matrix = np.stack([np.concatenate(columns[n], axis=1) for n in names], axis=2) if names else None
    denominator_parts = {n: np.concatenate(parts, axis=1) for n, parts in output_columns.items()}
    slowest = _slowest_output_term(problem, equation, points)
    denominator = 1.0 + np.abs(powers) + 0j
    coefficients = np.zeros((len(points), len(names)))
    cost = np.full(len(points), np.inf)
    with np.errstate(all="ignore"):
        for _ in range(REWEIGHTING_ITERATIONS):
            scaled = weight / np.abs(denominator)
            if matrix is not None:
                coefficients = _least_squares(matrix * scaled[..., None], target * scaled)
                if slowest is not None:
                    k, power = names.index(slowest[0]), slowest[1]
                    is_finite = np.isfinite(corners)
                    fixed_values = -(corners[is_finite] ** power[is_finite])
                    remainder = target[is_finite] - matrix[is_finite][:, :, k] * fixed_values[:, None]
                    other_columns = np.delete(matrix[is_finite], k, axis=2)
                    other_coefficients = _least_squares(
                        other_columns * scaled[is_finite][..., None], remainder * scaled[is_finite]
                    )
                    coefficients[is_finite] = np.insert(other_coefficients, k, fixed_values, axis=1)
            denominator = powers - sum(
                (coefficients[:, [names.index(n)]] * part for n, part in denominator_parts.items()), 0.0 * powers
            )
            misfit = target if matrix is None else target - np.einsum("bnp,bp->bn", matrix, coefficients)
            cost = np.sum(np.abs(misfit / denominator * weight) ** 2, axis=1)
    return coefficients, cost


def _slowest_output_term(problem: ResponseProblem, equation: Equation, points: Floats) -> tuple[str, Floats] | None:
    """Return the coefficient of the output term that dominates at low frequencies, and its order difference.

    The difference is alpha minus the order of the term at each point. Only terms with a free coefficient are
    considered; None if there are none.
    """
    output_terms = [
        t for t in equation.terms if t.signal == equation.output and isinstance(t.coefficient, str) and t.factor == 1
    ]
    if not output_terms:
        return None
    alpha = _orders(problem, equation.order.constant, equation.order.weights, points)
    gaps = [alpha - _orders(problem, t.order.constant, t.order.weights, points) for t in output_terms]
    at = int(np.argmax([float(np.mean(g)) for g in gaps]))
    return str(output_terms[at].coefficient), gaps[at]


def _least_squares(matrix: Complex, target: Complex) -> Floats:
    """Return the real minimum-norm least-squares solution of each complex linear system of a batch."""
    lengths = np.sqrt(np.sum(np.abs(matrix) ** 2, axis=1))
    unit = np.where((lengths > 0) & np.isfinite(lengths), lengths, 1.0)
    scaled = np.nan_to_num(matrix / unit[:, None, :])
    normal = np.einsum("bnp,bnq->bpq", scaled.conj(), scaled).real
    right_side = np.einsum("bnp,bn->bp", scaled.conj(), np.nan_to_num(target)).real
    inverse = np.linalg.pinv(normal, rcond=1e-13, hermitian=True)
    solution: Floats = np.einsum("bpq,bq->bp", inverse, right_side) / unit
    return solution


def _orders(problem: ResponseProblem, constant: float, weights: Sequence[tuple[str, float]], points: Floats) -> Floats:
    order_sum = np.full(len(points), constant)
    for name, weight in weights:
        order_sum = order_sum + weight * points[:, problem.orders.index(name)]
    return order_sum


def _shifts(problem: ResponseProblem, signal: str, points: Floats) -> Floats:
    if signal in problem.delays:
        return np.asarray(points[:, len(problem.orders) + len(problem.coefficients) + problem.delays.index(signal)])
    return np.full(len(points), problem.known_delays.get(signal, 0.0))


def _signal(problem: ResponseProblem, record: ResponseRecord, name: str, delay_factor: Complex) -> Complex | float:
    """Return the frequency response from the input of a record to a signal.

    For an output it is the measured response to the same input, interpolated from another record if necessary. For the
    input itself it is `delay_factor`, and for other signals 0.
    """
    outputs = problem.structure.outputs
    if name not in outputs:
        return delay_factor if name == record.input else 0.0
    if outputs.index(name) == record.output:
        return record.response
    input_record = next(
        (r for r in problem.records if r.output == outputs.index(name) and r.input == record.input), None
    )
    if input_record is None:
        return 0.0
    # Linear interpolation between the frequencies of the other record suffices for an initial guess.
    order = np.argsort(input_record.frequency, kind="stable")
    at, x = np.log(record.frequency), np.log(input_record.frequency[order])
    values = input_record.response[order]
    return np.interp(at, x, values.real) + 1j * np.interp(at, x, values.imag)
