"""Equations as frequency responses of free orders, coefficients and delays, with exact derivatives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ftlm.base.arrays import Complex, Floats
from ftlm.data.equations import Equation, Term
from ftlm.data.orders import MAX_EXCESS, MAX_ORDER, MIN_INPUT_ORDER, SEARCHED_ORDER, Order
from ftlm.data.response import FrequencyData
from ftlm.data.structures import Structure

#: Least of a highest order, and what an own order stays below it: closer, a term says what the left side says.
LEAST_ORDER, GAP = 0.01, 0.005


@dataclass(frozen=True)
class Measured:
    """One record in a unit of time of its own, its weights beside it."""

    output: int
    input: str
    frequency: Floats
    response: Complex
    weight: Floats


class ResponseProblem:
    """A structure and records, in numbers that are near 1: time is counted in 1/`unit` of a second.

    Numbers stand in the order of `names`: free orders, free coefficients, free delays.
    """

    def __init__(self, structure: Structure, records: Sequence[FrequencyData], weights: Sequence[Floats]) -> None:
        self.structure = structure
        self.orders = structure.order_names
        self.coefficients = tuple(dict.fromkeys(structure.coefficient_names))
        self.delays = tuple(item.signal for item in structure.free_inputs)
        self.names = (*self.orders, *self.coefficients, *(item.name for item in structure.free_inputs))
        every = np.concatenate([r.frequency for r in records])
        self.unit = float(np.exp(np.mean(np.log(every))))
        self.records = [
            Measured(structure.outputs.index(r.output), r.input, r.frequency / self.unit, r.response, w)
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
        """Value of an order."""
        return order.constant + math.fsum(w * float(values[self._place[n]]) for n, w in order.weights)

    def scaled(self, values: Floats) -> Floats:
        """Numbers in seconds as numbers of this problem's unit of time."""
        return self._turned(values, -1.0)

    def in_seconds(self, values: Floats) -> Floats:
        """Numbers of this problem as numbers in seconds."""
        return self._turned(values, 1.0)

    def _turned(self, values: Floats, way: float) -> Floats:
        out = values.astype(np.float64).copy()
        for name, at in self._coefficient.items():
            item, term = self.term_of[name]
            power = self.order_at(item.order, values) - self.order_at(term.order, values)
            out[at] *= self.unit ** (way * power)
        for at in self._delay.values():
            out[at] *= self.unit**-way
        return out

    def slopes_in_seconds(self, values: Floats, slopes: Floats) -> Floats:
        """Columns of slopes by this problem's numbers as slopes by numbers in seconds."""
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
        """Value of a term's coefficient in this unit of time."""
        if isinstance(term.coefficient, str):
            return term.factor * float(values[self._coefficient[term.coefficient]])
        power = self.order_at(item.order, values) - self.order_at(term.order, values)
        return float(term.fixed or 0.0) * math.pow(self.unit, -power)

    def shift(self, signal: str, values: Floats) -> float:
        """Delay of an input in this unit of time."""
        at = self._delay.get(signal)
        return self.known_delays.get(signal, 0.0) if at is None else float(values[at])

    def responses(self, values: Floats, *, slopes: bool = True) -> list[tuple[Complex, Complex | None]]:
        """Response of the model at every record, and its slopes by all numbers (a column each)."""
        return [self._response(record, values, slopes) for record in self.records]

    def _response(self, record: Measured, values: Floats, slopes: bool) -> tuple[Complex, Complex | None]:
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
        """Weighted residuals, real parts of all records and then imaginary parts, and their slopes."""
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
        """Rows and limits of what orders and delays keep to, rows @ values <= limits, and what each says."""
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
            keep(item.order, -LEAST_ORDER, f"the highest order of {item.output} is above 0", -1.0)
            for term in item.terms:
                own = term.signal == item.output
                name = str(term.order)
                low, above = (0.0, -GAP) if own else (MIN_INPUT_ORDER, MAX_EXCESS - GAP)
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
        for free in self.structure.free_inputs:
            for sign, end in ((1.0, free.bounds[1]), (-1.0, free.bounds[0])):
                row = np.zeros(len(self.names))
                row[self._delay[free.signal]] = sign
                rows.append(row)
                limits.append(sign * end * self.unit)
                words.append(f"{free.words} is {'at most' if sign > 0 else 'at least'} {end:g} s")
        table = np.array(rows) if rows else np.zeros((0, len(self.names)))
        return table, np.array(limits), words

    def searched(self) -> dict[str, tuple[float, ...] | tuple[float, float]]:
        """Values of each free order on its lattice, or the interval in which a search looks of itself."""
        out: dict[str, tuple[float, ...] | tuple[float, float]] = {}
        for name in self.orders:
            if name in self.structure.order_values:
                out[name] = tuple(self.structure.order_values[name])
                continue
            own = [e.order for e in self.structure.equations if name in e.order.names]
            out[name] = (0.1, self._highest()) if own else (0.0, self._highest())
        return out

    def _highest(self) -> float:
        """Highest order that a search tries of itself."""
        orders = [o for e in self.structure.equations for o in (e.order, *(t.order for t in e.terms))]
        return max([SEARCHED_ORDER, *(o.constant for o in orders if not o.names)])
