"""Frequency responses of equations with free orders, coefficients and delays, with exact derivatives."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Literal

import numpy as np
from msgspec import UNSET
from numpy.typing import ArrayLike, NDArray

from ftlm import _core
from ftlm.data.frequency_data import FrequencyData, as_frequency_data
from ftlm.errors import ConvergenceError, DataError, ModelError
from ftlm.estimation.coefficient_bounds import Bounds, check_bounds, fit_within_bounds
from ftlm.estimation.frequency_result import FrequencyIdentification
from ftlm.estimation.model_checks import (
    SAME_MODEL_POWER,
    SECOND_OPTIMUM_LOG_LIKELIHOOD,
    second_optimum_findings,
)
from ftlm.estimation.objective import covariance_of
from ftlm.findings import Finding, make_finding
from ftlm.model.model import Estimate, Model
from ftlm.progress import Progress, ShareTracker
from ftlm.simulation.discretization import check_linear
from ftlm.structure.equation import Equation, Term
from ftlm.structure.order import MAX_DEFAULT_SEARCH_ORDER, MAX_IMPROPER_ORDER, MAX_ORDER, MIN_INPUT_ORDER, Order, Values
from ftlm.structure.parser import equation
from ftlm.structure.structure import Structure
from ftlm.utils.arguments import check_arguments
from ftlm.utils.files import PACKAGE_LOGGER
from ftlm.utils.parameters import parameter
from ftlm.utils.resources import duration_bounds, estimate_duration
from ftlm.utils.statistics import NEGLIGIBLE_RESIDUAL_SHARE, chi_squared_99, is_white
from ftlm.utils.validation import Complex, Floats, as_floats, check_known

#: Smallest highest order of an equation, and smallest gap between it and the order of an own term.
MIN_HIGHEST_ORDER, MIN_ORDER_GAP = 0.01, 0.005


#: Circuit in the notation of impedance tools, such as ``R0-p(R1,CPE1)``.
_CIRCUIT_PATTERN = re.compile(r"\s*(?:R|C|L|CPE|W|Wo|Ws|G|Q|p\s*\()[0-9_]*\s*(?:-|\(|[RCLWQ]|$)")
#: Largest exponent of a constant-phase element: that of a capacitor.
MAX_EXPONENT = 1.0


def exponent_bound(name: str) -> str:
    """Description of the upper bound of an exponent in an impedance."""
    return f"exponent {name} is at most {MAX_EXPONENT:g}, unless {parameter('orders')} gives more"


def _is_impedance(records: Sequence[FrequencyData]) -> bool:
    return all(record.unit.endswith("Ω") for record in records)


@dataclass(frozen=True)
class ResponseRecord:
    """One measured frequency response in scaled time, with its weights."""

    output: int
    input: str
    frequency: Floats
    response: Complex
    weight: Floats


class ResponseProblem:
    """Structure and measured responses in scaled time, so that the parameters are near 1.

    Time is counted in 1/`unit` of a second. Parameters have the order of `names`: free orders, free coefficients, free
    delays.
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
        self.delays = tuple(item.signal for item in structure.free_inputs)
        self.names = (*self.orders, *self.coefficients, *(item.name for item in structure.free_inputs))
        #: Free orders of an impedance that the user gives no values. As exponents of constant-phase elements they are
        #: at most 1; an order such as alpha + 0.5 may exceed it.
        self.exponents = tuple(
            n for n in self.orders if bound_exponents and n not in structure.order_values and _is_impedance(records)
        )
        every = np.concatenate([r.frequency for r in records])
        self.unit = float(np.exp(np.mean(np.log(every))))
        self.records = [
            ResponseRecord(structure.outputs.index(r.output), r.input, r.frequency / self.unit, r.response, w)
            for r, w in zip(records, weights, strict=True)
        ]
        self.known_delays = {name: value * self.unit for name, value in structure.delay.items()}
        self._place = {name: k for k, name in enumerate(self.orders)}
        at = len(self.orders)
        self._coefficient = {name: at + k for k, name in enumerate(self.coefficients)}
        self._delay = {name: at + len(self.coefficients) + k for k, name in enumerate(self.delays)}
        #: Of each free coefficient, its term with its equation.
        self.term_of = {t.coefficient: (e, t) for e in structure.equations for t in e.terms}

    def order_at(self, order: Order, values: Floats) -> float:
        """Return the value of an order."""
        return order.constant + math.fsum(w * float(values[self._place[n]]) for n, w in order.weights)

    def in_problem_units(self, values: Floats) -> Floats:
        """Convert parameters from seconds to the time unit of this problem."""
        return self._convert_time_unit(values, -1.0)

    def in_seconds(self, values: Floats) -> Floats:
        """Convert parameters from the time unit of this problem to seconds."""
        return self._convert_time_unit(values, 1.0)

    def _convert_time_unit(self, values: Floats, way: float) -> Floats:
        out = values.astype(np.float64).copy()
        for name, at in self._coefficient.items():
            item, term = self.term_of[name]
            power = self.order_at(item.order, values) - self.order_at(term.order, values)
            out[at] *= self.unit ** (way * power)
        for at in self._delay.values():
            out[at] *= self.unit**-way
        return out

    def slopes_in_seconds(self, values: Floats, slopes: Floats) -> Floats:
        """Convert a Jacobian by scaled parameters to one by parameters in seconds."""
        out = slopes.copy()
        log = np.log(self.unit)
        for name, at in self._coefficient.items():
            item, term = self.term_of[name]
            power = self.order_at(item.order, values) - self.order_at(term.order, values)
            # c' = c unit^-(alpha - order): by c itself, and by each order at a fixed c.
            for order, sign in ((item.order, -1.0), (term.order, 1.0)):
                for n, w in order.weights:
                    out[:, self._place[n]] += sign * w * log * float(values[at]) * slopes[:, at]
            out[:, at] *= self.unit**-power
        for at in self._delay.values():
            out[:, at] *= self.unit
        return out

    def coefficient(self, term: Term, item: Equation, values: Floats) -> float:
        """Return the coefficient of a term in scaled time."""
        if isinstance(term.coefficient, str):
            return term.factor * float(values[self._coefficient[term.coefficient]])
        power = self.order_at(item.order, values) - self.order_at(term.order, values)
        return float(term.fixed or 0.0) * math.pow(self.unit, -power)

    def shift(self, signal: str, values: Floats) -> float:
        """Return the delay of an input in scaled time."""
        at = self._delay.get(signal)
        return self.known_delays.get(signal, 0.0) if at is None else float(values[at])

    def responses(self, values: Floats, *, slopes: bool = True) -> list[tuple[Complex, Complex | None]]:
        """Return the model response at every record, and its derivatives by all parameters (one column each)."""
        return [self._response(record, values, slopes) for record in self.records]

    def _response(self, record: ResponseRecord, values: Floats, slopes: bool) -> tuple[Complex, Complex | None]:
        s = 1j * record.frequency
        log = np.log(s)
        items, names = self.structure.equations, self.structure.outputs
        matrix = np.zeros((s.size, len(items), len(items)), dtype=np.complex128)
        right = np.zeros((s.size, len(items)), dtype=np.complex128)
        powers: dict[tuple[int, int], Complex] = {}
        for i, item in enumerate(items):
            powers[i, -1] = np.exp(self.order_at(item.order, values) * log)
            matrix[:, i, i] += powers[i, -1]
            for k, term in enumerate(item.terms):
                if term.signal not in names and term.signal != record.input:
                    continue
                powers[i, k] = np.exp(self.order_at(term.order, values) * log)
                part = self.coefficient(term, item, values) * powers[i, k]
                if term.signal in names:
                    matrix[:, i, names.index(term.signal)] -= part
                else:
                    right[:, i] += part
        late = np.exp(-s * self.shift(record.input, values))
        try:
            whole = np.linalg.solve(matrix, (right * late[:, None])[..., None])[..., 0]
            unit = np.zeros((s.size, len(items), 1), dtype=np.complex128)
            unit[:, record.output] = 1.0
            ahead = np.linalg.solve(matrix.transpose(0, 2, 1), unit)[..., 0] if slopes else None
        except np.linalg.LinAlgError:
            nothing = np.full(s.size, np.nan, dtype=np.complex128)
            return nothing, np.full((s.size, len(self.names)), np.nan, dtype=np.complex128) if slopes else None
        response = np.asarray(whole[:, record.output], dtype=np.complex128)
        if ahead is None:
            return response, None
        out = np.zeros((s.size, len(self.names)), dtype=np.complex128)
        for i, item in enumerate(items):
            for n, w in item.order.weights:
                out[:, self._place[n]] -= w * log * ahead[:, i] * powers[i, -1] * whole[:, i]
            for k, term in enumerate(item.terms):
                if (i, k) not in powers:
                    continue
                signal = whole[:, names.index(term.signal)] if term.signal in names else late
                size = self.coefficient(term, item, values)
                moved = ahead[:, i] * powers[i, k] * signal
                for n, w in term.order.weights:
                    out[:, self._place[n]] += w * size * log * moved
                if not isinstance(term.coefficient, str):
                    # A known coefficient is one in seconds: in this unit it follows the orders.
                    for its, sign in ((item.order, -1.0), (term.order, 1.0)):
                        for n, w in its.weights:
                            out[:, self._place[n]] += sign * w * np.log(self.unit) * size * moved
                else:
                    out[:, self._coefficient[term.coefficient]] += term.factor * moved
        if record.input in self._delay:
            out[:, self._delay[record.input]] = -s * response
        return response, out

    def residuals(self, values: Floats, *, slopes: bool = True) -> tuple[Floats, Floats]:
        """Return the residuals times weights, real parts before imaginary parts, and their Jacobian."""
        left, steep = [], []
        with np.errstate(all="ignore"):
            for record, (response, moved) in zip(self.records, self.responses(values, slopes=slopes), strict=True):
                left.append((response - record.response) * record.weight)
                if moved is not None:
                    steep.append(moved * record.weight[:, None])
        flat = np.concatenate(left)
        jacobian = np.concatenate(steep) if steep else np.zeros((flat.size, 0), dtype=np.complex128)
        return np.concatenate([flat.real, flat.imag]), np.concatenate([jacobian.real, jacobian.imag])

    def constraints(self) -> tuple[Floats, Floats, list[str]]:
        """Return the constraints ``rows @ values <= limits`` of orders and delays, with descriptions."""
        rows: list[Floats] = []
        limits: list[float] = []
        words: list[str] = []

        def keep(order: Order, most: float, text: str, sign: float = 1.0) -> None:
            row = np.zeros(len(self.names))
            for n, w in order.weights:
                row[self._place[n]] += sign * w
            if np.any(row):
                rows.append(row)
                limits.append(most - sign * order.constant)
                words.append(text)

        for item in self.structure.equations:
            keep(item.order, MAX_ORDER, f"the highest order of {item.output} is at most 10")
            keep(item.order, -MIN_HIGHEST_ORDER, f"the highest order of {item.output} is above 0", -1.0)
            for term in item.terms:
                own = term.signal == item.output
                name = str(term.order)
                low, above = (0.0, -MIN_ORDER_GAP) if own else (MIN_INPUT_ORDER, MAX_IMPROPER_ORDER - MIN_ORDER_GAP)
                keep(term.order, -low, f"order {name} is from {low:g} on", -1.0)
                both = dict(term.order.weights)
                for n, w in item.order.weights:
                    both[n] = both.get(n, 0.0) - w
                over = tuple(sorted((n, w) for n, w in both.items() if w))
                gap = Order(term.order.constant - item.order.constant, over)
                keep(gap, above, f"order {name} stays below {item.order} of {item.output}{'' if own else ' + 1'}")
        for name, values in self.structure.order_values.items():
            if name in self._place:
                keep(Order(0.0, ((name, 1.0),)), values[-1], f"{name} is at most {values[-1]:g}")
                keep(Order(0.0, ((name, 1.0),)), -values[0], f"{name} is from {values[0]:g} on", -1.0)
        for name in self.exponents:
            keep(Order(0.0, ((name, 1.0),)), MAX_EXPONENT, exponent_bound(name))
        for free in self.structure.free_inputs:
            for sign, end in ((1.0, free.bounds[1]), (-1.0, free.bounds[0])):
                row = np.zeros(len(self.names))
                row[self._delay[free.signal]] = sign
                rows.append(row)
                limits.append(sign * end * self.unit)
                words.append(f"{free.words} is {'at most' if sign > 0 else 'at least'} {end:g} s")
        table = np.array(rows) if rows else np.zeros((0, len(self.names)))
        return table, np.array(limits), words

    def search_ranges(self) -> dict[str, tuple[float, ...] | tuple[float, float]]:
        """Return the grid values of each free order, or the interval of its default search."""
        out: dict[str, tuple[float, ...] | tuple[float, float]] = {}
        for name in self.orders:
            if name in self.structure.order_values:
                out[name] = tuple(self.structure.order_values[name])
                continue
            own = [e.order for e in self.structure.equations if name in e.order.names]
            highest = MAX_EXPONENT if name in self.exponents else self._highest()
            out[name] = (0.1, highest) if own else (0.0, highest)
        return out

    def _highest(self) -> float:
        """Return the highest order of the default search."""
        orders = [o for e in self.structure.equations for o in (e.order, *(t.order for t in e.terms))]
        return max([MAX_DEFAULT_SEARCH_ORDER, *(o.constant for o in orders if not o.names)])


#: Largest number of grid points, of frequencies, of reweighting iterations, and of initial guesses returned.
MAX_GRID_POINTS, MAX_START_FREQUENCIES, REWEIGHTING_ITERATIONS, MAX_STARTS = 3000, 160, 4, 8
#: Points whose exact cost is computed, corner frequencies tried for one own term, and points at which they are tried.
MAX_EVALUATED_POINTS, CORNERS_PER_POINT, MAX_CORNER_POINTS = 60, 14, 120


def initial_guesses(problem: ResponseProblem) -> list[Floats]:
    """Return feasible initial guesses, most promising first."""
    points = _points(problem)
    found = _linear_coefficients(problem, points) if problem.coefficients else list(points)
    judged = []
    for values in found:
        left, _ = problem.residuals(values, slopes=False)
        cost = float(left @ left)
        if np.isfinite(cost):
            judged.append((cost, values))
    judged.sort(key=lambda pair: pair[0])
    kept: list[Floats] = []
    first, last = len(problem.orders), len(problem.orders) + len(problem.coefficients)
    free = [k for k in range(len(problem.names)) if not first <= k < last]
    for _, values in judged:
        if all(np.max(np.abs(values[free] - other[free]), initial=0.0) > 0.1 for other in kept) or not kept:
            kept.append(values)
        if len(kept) == MAX_STARTS:
            break
    return kept


def _points(problem: ResponseProblem) -> Floats:
    """Return the grid points of orders and delays, one row each, with coefficients 0."""
    axes = list(problem.search_ranges().values())
    given = [n in problem.structure.order_values for n in problem.orders]
    delays = [(item.bounds[0] * problem.unit, item.bounds[1] * problem.unit) for item in problem.structure.free_inputs]
    # A delay that is off by a third of a period at the highest frequency still leads downhill.
    fastest = max(float(r.frequency.max()) for r in problem.records)
    fine = [int(np.clip(np.ceil((high - low) * fastest / 2.0) + 1, 2, 60)) for low, high in delays]
    room = max(MAX_GRID_POINTS // int(np.prod(fine, initial=1)), 60)
    count = len(axes)
    lattice = int(np.prod([len(a) if g else 1 for a, g in zip(axes, given, strict=True)], initial=1))
    free = count - sum(given)
    each = int(np.floor((room / max(lattice, 1)) ** (1.0 / free))) if free and lattice <= room else 0
    if (free and each < 4) or (not free and lattice > room):
        # Too many axes for a lattice: points that fill the box evenly, the same every time.
        spread = _halton(room, count)
        columns = [
            np.asarray(a)[(spread[:, k] * len(a)).astype(int)] if g else a[0] + spread[:, k] * (a[1] - a[0])
            for k, (a, g) in enumerate(zip(axes, given, strict=True))
        ]
        orders = np.stack(columns, axis=1)
    else:
        sides = [a if g else np.linspace(a[0], a[1], min(each, 31)) for a, g in zip(axes, given, strict=True)]
        orders = _product(sides)
    late = _product([np.linspace(a, b, n) for (a, b), n in zip(delays, fine, strict=True)])
    table = np.zeros((len(orders) * len(late), len(problem.names)))
    table[:, :count] = np.repeat(orders, len(late), axis=0)
    table[:, len(problem.names) - len(delays) :] = np.tile(late, (len(orders), 1))
    rows, limits, _ = problem.constraints()
    inside = np.all(table @ rows.T <= limits + 1e-12, axis=1)
    kept: Floats = table[inside]
    return kept


def _product(sides: Sequence[Sequence[float] | Floats]) -> Floats:
    """Return every point of a grid, one row each; a grid without axes has one point."""
    rows = list(itertools.product(*sides))
    return np.array(rows, dtype=np.float64).reshape(len(rows), len(sides))


def _halton(count: int, width: int) -> Floats:
    """Return a Halton sequence in the unit box: radical inverses in the first primes."""
    primes = [p for p in range(2, 300) if all(p % q for q in range(2, int(p**0.5) + 1))][:width]
    out = np.zeros((count, width))
    for k, base in enumerate(primes):
        index, share = np.arange(1, count + 1), 1.0
        while np.any(index):
            share /= base
            out[:, k] += share * (index % base)
            index = index // base
    return out


def _linear_coefficients(problem: ResponseProblem, points: Floats) -> list[Floats]:
    """Return the coefficients at the most promising points, one equation after the other."""
    slow = points[np.unique(np.linspace(0, len(points) - 1, min(MAX_CORNER_POINTS, len(points))).astype(int))]
    points, corners = (
        np.concatenate([points, np.repeat(slow, CORNERS_PER_POINT, axis=0)]),
        _corner_frequencies(problem, len(points), slow),
    )
    table = points.copy()
    total = np.zeros(len(points))
    for i, item in enumerate(problem.structure.equations):
        names = [n for n in item.coefficient_names if n in problem.coefficients]
        records = [r for r in problem.records if r.output == i]
        if not records:
            continue
        answers, cost = _equation(problem, i, names, [_subsample_record(r) for r in records], points, corners)
        for k, name in enumerate(names):
            table[:, problem.names.index(name)] = answers[:, k]
        total += np.where(np.isfinite(cost), cost, np.inf)
    best = np.argsort(total, kind="stable")[:MAX_EVALUATED_POINTS]
    return [table[k] for k in best if np.isfinite(total[k])]


def _corner_frequencies(problem: ResponseProblem, first: int, slow: Floats) -> Floats:
    """Return corner frequencies imposed on the slowest own term, for points after the first; else NaN.

    If noise hides a small arc, reweighted least squares are biased and own terms are far too small or too large. With
    the slowest own term fixed, the remaining bias is small.
    """
    every = np.concatenate([r.frequency for r in problem.records])
    tried = np.geomspace(every.min(), every.max(), CORNERS_PER_POINT)
    return np.concatenate([np.full(first, np.nan), np.tile(tried, len(slow))])


def _subsample_record(record: ResponseRecord) -> ResponseRecord:
    """Return a record subsampled to the number of frequencies that an initial guess needs."""
    order = np.argsort(record.frequency, kind="stable")
    if order.size > MAX_START_FREQUENCIES:
        order = order[np.linspace(0, order.size - 1, MAX_START_FREQUENCIES).astype(int)]
    return ResponseRecord(
        record.output, record.input, record.frequency[order], record.response[order], record.weight[order]
    )


def _equation(
    problem: ResponseProblem,
    place: int,
    names: Sequence[str],
    records: Sequence[ResponseRecord],
    points: Floats,
    corners: Floats,
) -> tuple[Floats, Floats]:
    """Return the coefficients of one equation at every point, and their cost."""
    item = problem.structure.equations[place]
    alpha = _orders(problem, item.order.constant, item.order.weights, points)
    columns: dict[str, list[Complex]] = {n: [] for n in names}
    own: dict[str, list[Complex]] = {}
    wanted, below = [], []
    for record in records:
        log = np.log(1j * record.frequency)
        late = np.exp(-1j * record.frequency * _shifts(problem, record.input, points)[:, None])
        known = np.exp(alpha[:, None] * log)
        below.append(known)
        goal = known * record.response
        for term in item.terms:
            signal = _signal(problem, record, term.signal, late)
            power = np.exp(_orders(problem, term.order.constant, term.order.weights, points)[:, None] * log)
            if isinstance(term.coefficient, str):
                columns[term.coefficient].append(term.factor * power * signal)
                if term.signal == item.output:
                    own.setdefault(term.coefficient, []).append(term.factor * power)
            else:
                gap = alpha - _orders(problem, term.order.constant, term.order.weights, points)
                size = float(term.fixed or 0.0) * problem.unit ** -gap[:, None]
                goal = goal - size * power * signal
                if term.signal == item.output:
                    below[-1] = below[-1] - size * power
        wanted.append(goal)
    weight = np.concatenate([r.weight for r in records])
    goal, known = np.concatenate(wanted, axis=1), np.concatenate(below, axis=1)
    left = np.stack([np.concatenate(columns[n], axis=1) for n in names], axis=2) if names else None
    ours = {n: np.concatenate(parts, axis=1) for n, parts in own.items()}
    slowest = _slowest(problem, item, points)
    bottom = 1.0 + np.abs(known) + 0j
    answers = np.zeros((len(points), len(names)))
    cost = np.full(len(points), np.inf)
    with np.errstate(all="ignore"):
        for _ in range(REWEIGHTING_ITERATIONS):
            scaled = weight / np.abs(bottom)
            if left is not None:
                answers = _least_squares(left * scaled[..., None], goal * scaled)
                if slowest is not None:
                    k, power = names.index(slowest[0]), slowest[1]
                    given = np.isfinite(corners)
                    held = -(corners[given] ** power[given])
                    rest = goal[given] - left[given][:, :, k] * held[:, None]
                    others = np.delete(left[given], k, axis=2)
                    solved = _least_squares(others * scaled[given][..., None], rest * scaled[given])
                    answers[given] = np.insert(solved, k, held, axis=1)
            bottom = known - sum((answers[:, [names.index(n)]] * part for n, part in ours.items()), 0.0 * known)
            missed = goal if left is None else goal - np.einsum("bnp,bp->bn", left, answers)
            cost = np.sum(np.abs(missed / bottom * weight) ** 2, axis=1)
    return answers, cost


def _slowest(problem: ResponseProblem, item: Equation, points: Floats) -> tuple[str, Floats] | None:
    """Return the free own term that acts at the lowest frequencies, and its order gap."""
    own = [t for t in item.terms if t.signal == item.output and isinstance(t.coefficient, str) and t.factor == 1]
    if not own:
        return None
    alpha = _orders(problem, item.order.constant, item.order.weights, points)
    gaps = [alpha - _orders(problem, t.order.constant, t.order.weights, points) for t in own]
    at = int(np.argmax([float(np.mean(g)) for g in gaps]))
    return str(own[at].coefficient), gaps[at]


def _least_squares(left: Complex, right: Complex) -> Floats:
    """Return real least-squares solutions of complex equations; undetermined directions are 0."""
    lengths = np.sqrt(np.sum(np.abs(left) ** 2, axis=1))
    unit = np.where((lengths > 0) & np.isfinite(lengths), lengths, 1.0)
    scaled = np.nan_to_num(left / unit[:, None, :])
    normal = np.einsum("bnp,bnq->bpq", scaled.conj(), scaled).real
    moment = np.einsum("bnp,bn->bp", scaled.conj(), np.nan_to_num(right)).real
    inverse = np.linalg.pinv(normal, rcond=1e-13, hermitian=True)
    answers: Floats = np.einsum("bpq,bq->bp", inverse, moment) / unit
    return answers


def _orders(problem: ResponseProblem, constant: float, weights: Sequence[tuple[str, float]], points: Floats) -> Floats:
    total = np.full(len(points), constant)
    for name, weight in weights:
        total = total + weight * points[:, problem.orders.index(name)]
    return total


def _shifts(problem: ResponseProblem, signal: str, points: Floats) -> Floats:
    if signal in problem.delays:
        return np.asarray(points[:, len(problem.orders) + len(problem.coefficients) + problem.delays.index(signal)])
    return np.full(len(points), problem.known_delays.get(signal, 0.0))


def _signal(problem: ResponseProblem, record: ResponseRecord, name: str, late: Complex) -> Complex | float:
    """Return the factor of a term: a measured response, the delayed input, or 0."""
    outputs = problem.structure.outputs
    if name not in outputs:
        return late if name == record.input else 0.0
    if outputs.index(name) == record.output:
        return record.response
    other = next((r for r in problem.records if r.output == outputs.index(name) and r.input == record.input), None)
    if other is None:
        return 0.0
    # Between measured frequencies, where there are other ones; a start needs no more.
    order = np.argsort(other.frequency, kind="stable")
    at, x = np.log(record.frequency), np.log(other.frequency[order])
    values = other.response[order]
    return np.interp(at, x, values.real) + 1j * np.interp(at, x, values.imag)


Weights = Literal["auto", "relative", "uniform", "deviation"]
#: Largest relative difference of the sums of squares of one and the same optimum.
SAME_OPTIMUM_TOLERANCE = 1e-6
#: Relative size of the residuals below which they are rounding.
RESIDUAL_FLOOR_RATIO = 1e-13
#: Largest number of frequencies of a record in the multistart.
MAX_MULTISTART_FREQUENCIES = 800
#: Fractions of the progress at which the initial guesses are found, and at which the multistart ends.
STARTS_END_FRACTION, MULTISTART_END_FRACTION = 0.25, 0.85
#: Range of the measured durations, relative to the time estimate.
DURATION_FACTOR_RANGE = (0.4, 4.0)
#: Number of lags of the whiteness test, from one frequency to the next.
WHITENESS_LAGS = 8


@check_arguments
def identify_frequency(
    data: FrequencyData | Sequence[FrequencyData],
    structure: Structure | str,
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
    and ``"D^alpha U = a U + r D^alpha I + b I"`` is a resistor in series with a depressed arc. Linear least squares on
    a grid of orders gives the initial guesses. Levenberg-Marquardt with exact derivatives then fits all parameters to
    the complex response.

    Parameters
    ----------
    data
        One record or several: other outputs and inputs, or other frequency bands.
    structure
        Structure to identify; see :func:`ftlm.equation`. Several outputs are simulated together from the inputs.
    weights
        ``"deviation"``: residuals divided by the standard deviations of the records. ``"relative"``: divided by the
        magnitude of the response at each frequency, for noise proportional to it. ``"uniform"``: unweighted. ``"auto"``
        (default): deviation if all records state one, otherwise relative. An array, for one record: a standard
        deviation of real and imaginary part for each frequency.
    orders, fixed, delay
        See :func:`ftlm.equation`: grids of orders bound them, too; a delay (low, high) is estimated.
    start
        Additional initial guess by name; missing values are 1, and 0 for a delay.
    bounds
        (lower, upper) of coefficients and orders by name; infinite for an open side. A coefficient that ends on a bound
        is fixed there and has no interval, and a finding names it.
    progress
        Callback with (parts done, total parts).

    Returns
    -------
    FrequencyIdentification
        Printable result; ``.model`` simulates over time, plots and saves.

    Raises
    ------
    DataError
        Invalid data, signals that the equations do not have, too few frequencies for the free parameters, or a response
        of 0 under relative weights.
    ModelError
        Nothing is free; friction, saturation or dead zone, offset, sensor filter or coefficient law; unknown weights or
        names.
    ConvergenceError
        No initial guess has a finite response.
    """
    wanted, limits = check_bounds(_structure(structure, orders, fixed, delay), bounds, start)
    records = _match_records(as_frequency_data(data), wanted)
    kind, weight = _weights(records, weights)
    _user_start(ResponseProblem(wanted, records, weight), start)

    def fit(asked: Structure, only: Mapping[str, float] | None) -> tuple[FrequencyIdentification, Mapping[str, float]]:
        problem = ResponseProblem(asked, records, weight)
        given = start if only is None else only
        known = {n: v for n, v in given.items() if n in problem.names} if isinstance(given, Mapping) else given
        found = _fit_response(problem, records, weight, kind, known, progress, alone=only is not None)
        return found, found.values

    result, found = fit_within_bounds(wanted, limits, fit)
    result = replace(result, findings=(*result.findings, *found))
    PACKAGE_LOGGER.info("identified: %s", result.verdict)
    for item in result.findings:
        PACKAGE_LOGGER.warning("%s", item)
    return result


def _fit_response(
    problem: ResponseProblem,
    records: list[FrequencyData],
    weight: list[Floats],
    kind: str,
    start: Mapping[str, float] | None,
    progress: Callable[[int, int], None] | None,
    *,
    alone: bool,
) -> FrequencyIdentification:
    """Fit a response problem from automatic initial guesses and the given one, or from that `alone`."""
    count, numbers = 2 * sum(r.frequency.size for r in records), len(problem.names)
    if count <= numbers:
        raise DataError(
            f"{count // 2} frequencies give {count} values, and {numbers} parameters are free "
            f"({', '.join(problem.names)}); "
            "measure more frequencies, or fix numbers"
        )
    if isinstance(progress, Progress):
        progress.expect(
            "the fit",
            *duration_bounds(estimate_duration(0.007 * numbers**2 + 2e-6 * numbers * count, 1), DURATION_FACTOR_RANGE),
        )
    course = ShareTracker(progress)
    words = problem.constraints()[2]
    PACKAGE_LOGGER.info("identifying %s from %s", ", ".join(problem.names), ", ".join(r.name for r in records))
    total = sum(float(np.sum(np.abs(r.response * w) ** 2)) for r, w in zip(records, weight, strict=True))
    # Starts race on no more frequencies than tell them apart; the best goes on with all.
    few, light = zip(*(_subsample_data(r, w) for r, w in zip(records, weight, strict=True)), strict=True)
    racing = problem if count <= 2 * MAX_MULTISTART_FREQUENCIES else ResponseProblem(problem.structure, few, light)
    begun = _user_start(racing, start)
    begun += [] if alone else initial_guesses(racing)
    course.advance_to(STARTS_END_FRACTION)
    fits = []
    for values in begun:
        fits.append(_fit(racing, values))
        course.advance_to(
            STARTS_END_FRACTION + (MULTISTART_END_FRACTION - STARTS_END_FRACTION) * len(fits) / len(begun)
        )
    fits = [f for f in fits if math.isfinite(f.cost)]
    if not fits:
        raise ConvergenceError(
            "no initial guess has a finite response: the order grid is empty or singular; widen "
            f"{parameter('orders')}, or give {parameter('start')}"
        )
    first = min(fits, key=lambda f: f.cost)
    reached = sum(
        f.cost <= first.cost * (1 + SAME_OPTIMUM_TOLERANCE) + 1e4 * RESIDUAL_FLOOR_RATIO**2 * total for f in fits
    )
    # A last race from where the best ended, so that what a wall had cut goes on.
    best = _fit_again(problem, racing, first)
    if racing is problem and first.cost < best.cost:
        best = first
    course.advance_to(1.0)
    held = [words[k] for k in best.active_constraints]
    at_limit = [n for n in problem.exponents if exponent_bound(n) in held]
    if at_limit and not _is_bound_significant(problem, records, best, kind):
        held = [text for text in held if text not in map(exponent_bound, at_limit)]
    ends = [f if racing is problem else _fit_again(problem, racing, f) for f in _near_optima(fits, racing, kind)]
    return _result(
        problem,
        records,
        best,
        kind,
        (reached, len(fits)),
        held,
        exact=best.cost <= NEGLIGIBLE_RESIDUAL_SHARE**2 * total,
        ends=ends,
    )


def _structure(
    structure: Structure | str,
    orders: Mapping[str, Values] | None,
    fixed: Mapping[str, float] | None,
    delay: Mapping[str, float | tuple[float, float]] | None,
) -> Structure:
    """Return the structure to identify; raise for nonlinear terms, offsets, sensor filters and laws."""
    if isinstance(structure, str) and _CIRCUIT_PATTERN.match(structure):
        raise ModelError(
            f"structure {structure!r} is a circuit; give its equation, such as 'D^alpha U = a U + r D^alpha I + b I' "
            "for R0 - p(R1, CPE1) and 'D U = a U + r D I + b I' for R0 - p(R1, C1)"
        )
    wanted = equation(structure) if isinstance(structure, str) else structure
    if not isinstance(wanted, Structure):
        raise ModelError(f"structure is {type(structure).__name__}; give an equation: 'D^alpha y = a0 y + b0 u'")
    if fixed:
        check_known("fixed coefficient", fixed, wanted.coefficient_names)
    wanted = wanted.with_delays(delay or {}).with_orders(orders or {}).with_coefficients(fixed or {})
    lacking = "which a frequency response does not know"
    if wanted.has_friction:
        raise ModelError(f"the equations have friction, {lacking}; identify runs over time, or leave it out")
    check_linear(wanted.equations, "a frequency response")
    if wanted.limits:
        raise ModelError(f"{wanted.limits[0].signal} saturates or has a dead zone, {lacking}; identify runs over time")
    if wanted.offset != "none":
        raise ModelError(f"the equations have an offset, {lacking}; leave '+ c' out, or {parameter('offset')}")
    if wanted.sensor_filter is not None:
        raise ModelError("the structure has a sensor filter; divide the data by its response, and leave it out")
    if wanted.coefficient_law:
        raise ModelError(
            f"the structure has a law of its coefficients, which this fit does not keep; leave {parameter('laws')} out"
        )
    if not (wanted.order_names or wanted.coefficient_names or wanted.free_inputs):
        raise ModelError(
            "no parameter is free: every order, coefficient and delay is a number; give the unknown ones names"
        )
    return replace(wanted, coupling="simulated", initial="auto")


def _match_records(records: Sequence[FrequencyData], structure: Structure) -> list[FrequencyData]:
    """Return the records with their signal names; raise if signals or equations have no counterpart."""
    outputs = structure.outputs
    inputs = tuple(s for s in structure.signals if s not in outputs)
    if not inputs:
        raise ModelError(f"the equations of {', '.join(outputs)} have no input; add an input term, as in '+ b0 u'")
    found = []
    for record in records:
        own = {"output": record.output, "input": record.input}
        for side, known in (("output", outputs), ("input", inputs)):
            if not own[side]:
                if len(known) > 1:
                    raise DataError(
                        f"{record.name} does not say its {side}, and the equations have {', '.join(known)}; say "
                        f"{parameter(side)} when loading it"
                    )
                own[side] = known[0]
            elif own[side] not in known:
                raise DataError(
                    f"{record.name} has the {side} {own[side]!r}, which is no {side} of the equations; these have "
                    f"{', '.join(known)}: write the equation in the names of the data, or say {parameter(side)} when "
                    "loading"
                )
        found.append(replace(record, output=own["output"], input=own["input"]))
    for output in outputs:
        if not any(r.output == output for r in found):
            raise DataError(f"no record is of {output}, which has an equation; give one, or leave the equation out")
    for name in inputs:
        if not any(r.input == name for r in found):
            raise DataError(f"no record is from {name}, an input of the equations; give one, or leave it out")
    return found


def _weights(records: Sequence[FrequencyData], weights: object) -> tuple[str, list[Floats]]:
    """Return the kind of weights and the factor of each residual."""
    if not isinstance(weights, str):
        if len(records) > 1:
            raise ModelError(
                f"{parameter('weights')} as an array are of one record; give each record its deviation instead"
            )
        (record,) = records
        return "deviation", [1.0 / _given_deviations(record, weights)]
    if weights not in ("auto", "relative", "uniform", "deviation"):
        raise ModelError(
            f"{parameter('weights', weights)} is not known; use 'auto', 'relative', 'uniform', 'deviation' or "
            "standard deviations"
        )
    known = [r.deviation for r in records]
    if weights == "deviation" or (weights == "auto" and all(d is not None for d in known)):
        without = [r.name for r, d in zip(records, known, strict=True) if d is None]
        if without:
            raise DataError(
                f"{without[0]} states no standard deviation; use {parameter('weights', 'relative')} or give "
                f"{parameter('deviation')}"
            )
        return "deviation", [1.0 / d for d in known if d is not None]
    if weights == "uniform":
        return "uniform", [np.ones(r.frequency.size) for r in records]
    for record in records:
        size = np.abs(record.response)
        if not np.all(size > 0):
            at = int(np.argmin(size))
            raise DataError(
                f"{record.name}: the response is 0 at row {at}, {int(np.sum(size == 0))} in all, and has no relative "
                f"weight; leave such rows out, or use {parameter('weights', 'uniform')}"
            )
    return "relative", [1.0 / np.abs(r.response) for r in records]


def _given_deviations(record: FrequencyData, weights: object) -> Floats:
    """Return standard deviations given by the user in place of those of a record."""
    given = as_floats("weights", weights)
    if given.shape != record.frequency.shape:
        raise DataError(f"weights has shape {given.shape}, the data {record.frequency.shape}; give one deviation each")
    return np.asarray(replace(record, deviation=given).deviation)


def _subsample_data(record: FrequencyData, weight: Floats) -> tuple[FrequencyData, Floats]:
    """Return a record and its weights, subsampled evenly to the number of frequencies of the multistart."""
    if record.frequency.size <= MAX_MULTISTART_FREQUENCIES:
        return record, weight
    order = np.argsort(record.frequency, kind="stable")
    kept = order[np.linspace(0, order.size - 1, MAX_MULTISTART_FREQUENCIES).astype(int)]
    return replace(record, frequency=record.frequency[kept], response=record.response[kept], deviation=None), weight[
        kept
    ]


def _user_start(problem: ResponseProblem, start: Mapping[str, float] | None) -> list[Floats]:
    """Return the initial guess of the user, if any."""
    if start is None:
        return []
    if not isinstance(start, Mapping):
        raise ModelError(f"start is {type(start).__name__}; give values by name, such as {{'alpha': 0.8}}")
    check_known("start", start, problem.names)
    usual = dict.fromkeys(problem.coefficients, 1.0)
    for name in problem.orders:
        grid = problem.structure.order_values.get(name, (1.0,))
        usual[name] = min(max(1.0, grid[0]), grid[-1])
    values = np.array([float(start.get(n, usual.get(n, 0.0))) for n in problem.names])
    begun, (rows, limits, _) = problem.in_problem_units(values), problem.constraints()
    if not (np.all(np.isfinite(values)) and np.all(rows @ begun <= limits + 1e-9)):
        raise ModelError(
            f"{parameter('start')} is out of the bounds of orders or delays, or not finite; choose values within them"
        )
    return [begun]


@dataclass(frozen=True)
class ResponseFit:
    """Optimum of a response problem: parameters, sum of squares, convergence, active constraints."""

    values: Floats
    cost: float
    converged: bool
    active_constraints: Sequence[int]


def _fit(problem: ResponseProblem, values: Floats) -> ResponseFit:
    rows, limits, _ = problem.constraints()
    size = math.sqrt(sum(float(np.sum(np.abs(r.response * r.weight) ** 2)) for r in problem.records))

    def residuals(numbers: Floats) -> Floats:
        return problem.residuals(numbers, slopes=False)[0]

    if not np.all(np.isfinite(residuals(values))):
        return ResponseFit(values, math.inf, False, ())
    found, cost, status, _, active = _core.minimize(
        residuals, lambda numbers: problem.residuals(numbers)[1], values, rows, limits, signal_norm=size
    )
    return ResponseFit(found, cost, status == "converged", active)


def _fit_again(problem: ResponseProblem, other: ResponseProblem, end: ResponseFit) -> ResponseFit:
    """Fit a problem from the optimum of another problem with the same parameters."""
    return _fit(problem, problem.in_problem_units(other.in_seconds(end.values)))


def _log_likelihood_difference(cost: float, best: float, kind: str, count: int) -> float:
    """Return by how much the log likelihood falls from one sum of squares to a larger one."""
    if kind == "deviation":
        return (cost - best) / 2.0
    return 0.5 * count * math.log(max(cost, 1e-300) / max(best, 1e-300))


def _near_optima(fits: Sequence[ResponseFit], problem: ResponseProblem, kind: str) -> list[ResponseFit]:
    """Return distinct optima of the multistart that are nearly as likely as the best."""
    ranked = sorted(fits, key=lambda f: f.cost)
    kept, seen = [], [problem.residuals(ranked[0].values, slopes=False)[0]]
    for fit in ranked[1:]:
        left = problem.residuals(fit.values, slopes=False)[0]
        if _log_likelihood_difference(fit.cost, ranked[0].cost, kind, left.size) > SECOND_OPTIMUM_LOG_LIKELIHOOD:
            break
        # Elements that change places are one and the same model.
        noise = ranked[0].cost / left.size
        if all(float(np.sum((left - other) ** 2)) > SAME_MODEL_POWER * noise for other in seen):
            kept.append(fit)
            seen.append(left)
    return kept


def _is_bound_significant(
    problem: ResponseProblem, records: Sequence[FrequencyData], best: ResponseFit, kind: str
) -> bool:
    """Whether exponents above their bound explain an impedance better than chance does, at 99 %."""
    free = ResponseProblem(problem.structure, records, [r.weight for r in problem.records], bound_exponents=False)
    beyond = _fit(free, best.values)
    count = 2 * sum(r.frequency.size for r in problem.records)
    return 2.0 * _log_likelihood_difference(best.cost, beyond.cost, kind, count) > chi_squared_99(1)


def _result(
    problem: ResponseProblem,
    records: list[FrequencyData],
    best: ResponseFit,
    kind: str,
    reached: tuple[int, int],
    held: list[str],
    *,
    exact: bool,
    ends: Sequence[ResponseFit] = (),
) -> FrequencyIdentification:
    values = problem.in_seconds(best.values)
    rising = _frequency_order(records)
    left = problem.residuals(best.values)[0][rising]
    series = _series(records, left)
    free = left.size - values.size
    chi = best.cost / free
    too_large = kind == "deviation" and best.cost > chi_squared_99(free)
    findings: list[Finding] = []

    def covariance_at(end: ResponseFit) -> Floats:
        residuals, slopes = problem.residuals(end.values)
        steep = problem.slopes_in_seconds(end.values, slopes)[rising]
        if kind == "deviation" and not too_large:
            return covariance_of(steep.T, [np.zeros(e.size) for e in series], float(free))
        return covariance_of(steep.T, _series(records, residuals[rising]), end.cost)

    def errors_of(covariance: Floats) -> dict[str, float]:
        return dict(zip(problem.names, np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist(), strict=True))

    covariance = covariance_at(best)
    white = exact or all(is_white(e, min(WHITENESS_LAGS, max(e.size // 4, 1))) for e in series)
    factor = float(_student(free)) if kind != "deviation" or too_large else NormalDist().inv_cdf(0.975)
    names = problem.names
    standard = errors_of(covariance)
    if too_large:
        findings.append(make_finding("deviations_exceeded", ratio=math.sqrt(chi)))
    if not white:
        findings.append(make_finding("response_not_white"))
    if not best.converged:
        findings.append(make_finding("response_not_converged"))
    findings += [make_finding("response_on_bound", bound=bound) for bound in held]
    falls = [(end, _log_likelihood_difference(end.cost, best.cost, kind, left.size)) for end in ends]
    optima = [
        (problem.in_seconds(end.values), fall, errors_of(covariance_at(end)))
        for end, fall in falls
        if fall <= SECOND_OPTIMUM_LOG_LIKELIHOOD
    ]
    findings += second_optimum_findings(problem.names, values, standard, optima)
    findings += _identifiability_findings(problem, values, standard)
    named = dict(zip(names, values.tolist(), strict=True))
    model = _model(problem, records, named, values, covariance, standard, findings)
    intervals = {n: (named[n] - factor * e, named[n] + factor * e) for n, e in standard.items()}
    return FrequencyIdentification(
        model,
        tuple(records),
        kind,
        named,
        standard,
        intervals,
        names,
        covariance,
        chi if kind == "deviation" else None,
        best.converged,
        reached,
        white,
        tuple(findings),
    )


def _frequency_order(records: Sequence[FrequencyData]) -> NDArray[np.intp]:
    """Return indices that sort the residuals of each record by frequency."""
    places, at = [], 0
    for record in records:
        places.append(at + np.argsort(record.frequency, kind="stable"))
        at += record.frequency.size
    every = np.concatenate(places)
    return np.concatenate([every, at + every])


def _series(records: Sequence[FrequencyData], left: Floats) -> list[Floats]:
    """Return real and imaginary parts of the residuals of every record, in the order of `left`."""
    ends = np.cumsum([r.frequency.size for r in records])
    half = left.size // 2
    return [*np.split(left[:half], ends[:-1]), *np.split(left[half:], ends[:-1])]


def _identifiability_findings(problem: ResponseProblem, values: Floats, standard: Mapping[str, float]) -> list[Finding]:
    """Return findings on parameters that the data determine poorly or not at all."""
    unseen = [n for n, e in standard.items() if not math.isfinite(e)]
    out = []
    if unseen:
        out.append(make_finding("response_not_told_apart", parameter=", ".join(unseen)))
    for name, value in zip(problem.names, values.tolist(), strict=True):
        error = standard[name]
        vague = error > 0.25 if name in problem.orders else error > 0.5 * abs(value)
        if math.isfinite(error) and vague:
            out.append(make_finding("response_number_vague", parameter=name, value=value, error=error))
    return out


def _model(
    problem: ResponseProblem,
    records: Sequence[FrequencyData],
    named: Mapping[str, float],
    values: Floats,
    covariance: Floats,
    standard: Mapping[str, float],
    findings: Sequence[Finding],
) -> Model:
    """Return the model with its estimate, as stored in its file."""
    orders = {n: round(named[n], 9) for n in problem.orders}
    late = {free.signal: named[free.name] for free in problem.structure.free_inputs}
    found = problem.structure.with_delays(late).with_orders(orders)
    found = found.with_coefficients({n: named[n] for n in problem.coefficients})
    spread = None
    if np.all(np.isfinite(covariance)):
        rows = []
        for item in problem.structure.equations:
            for order, term in [(item.order, None), *((t.order, t) for t in item.terms)]:
                row = np.zeros(values.size)
                for n, w in order.weights:
                    row[problem.names.index(n)] = w
                rows.append(row)
                if term is not None:
                    row = np.zeros(values.size)
                    if isinstance(term.coefficient, str):
                        row[problem.names.index(term.coefficient)] = term.factor
                    rows.append(row)
        table = np.array(rows)
        spread = tuple(tuple(row) for row in (table @ covariance @ table.T).tolist())
    units: dict[str, str] = {}
    if all(r.unit == "Ω" for r in records):
        units = {r.output: "V" for r in records} | {r.input: "A" for r in records}
    estimate = Estimate(
        method="frequency-response",
        runs=tuple(dict.fromkeys(r.name for r in records)),
        values=dict(named),
        standard_errors={n: e if math.isfinite(e) else None for n, e in standard.items()},
        covariance=spread,
        findings=tuple(f.to_file() for f in findings) or UNSET,
    )
    return Model(found, orders, units, None, {"identified from": "frequency response"}, estimate)


def _student(degrees: int) -> float:
    """Return the 97.5 % quantile of Student's t by a series, accurate to 1 % from 4 degrees of freedom."""
    z, n = NormalDist().inv_cdf(0.975), float(degrees)
    terms = [(z**3 + z) / 4, (5 * z**5 + 16 * z**3 + 3 * z) / 96, (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384]
    return z + sum(t / n ** (k + 1) for k, t in enumerate(terms))
