"""What is free in a joint fit, as the core takes it, and one descent."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ftlm import _core
from ftlm.base.arrays import Floats
from ftlm.data.orders import MAX_ORDER, Order
from ftlm.data.run import Run
from ftlm.data.structures import Structure, delay_name
from ftlm.solve.records import initial_tuple, record, sensor_series

#: Own bounds of orders where the structure gives none.
ALPHA_BOUNDS = (0.05, MAX_ORDER)


@dataclass(frozen=True)
class FreeProblem:
    """A structure as the core takes it: orders affine in free ones, coefficients products of free ones."""

    structure: Structure
    orders: tuple[str, ...]
    coefficients: tuple[str, ...]
    bounds: tuple[tuple[float, float], ...]
    products: Mapping[str, tuple[float, tuple[str, ...]]]
    delays: tuple[str, ...] = ()

    @property
    def names(self) -> list[str]:
        """Everything that is free: orders, coefficients, then delays."""
        return [*self.orders, *self.coefficients, *map(delay_name, self.delays)]

    @property
    def all_bounds(self) -> list[tuple[float, float]]:
        """Bounds of everything that is free; those of coefficients are infinite."""
        ends = [self.structure.free_delays[n] for n in self.delays]
        return [*self.bounds, *[(-math.inf, math.inf)] * len(self.coefficients), *ends]

    def split(self, values: Sequence[float]) -> tuple[list[float], list[float], list[float]]:
        """Values of orders, coefficients and delays."""
        flat = list(map(float, values))
        first, second = len(self.orders), len(self.orders) + len(self.coefficients)
        return flat[:first], flat[first:second], flat[second:]

    @classmethod
    def of(cls, structure: Structure) -> FreeProblem:
        """Free orders, free coefficients and their bounds."""
        law = {name: (sign, factors) for name, sign, factors in structure.coefficient_law}
        named = structure.coefficient_names
        products = {n: law[n] for n in named if n in law}
        free = [n for n in named if n not in products]
        free += [f for _, factors in products.values() for f in factors if f not in named]
        highest = {n for e in structure.equations if e.order.is_single for n in e.order.names}
        bounds = []
        for name in structure.order_names:
            if name in structure.order_values:
                values = structure.order_values[name]
                bounds.append((values[0], values[-1]))
            else:
                bounds.append(ALPHA_BOUNDS if name in highest else (0.0, MAX_ORDER))
        coefficients = tuple(dict.fromkeys(free))
        return cls(
            structure, structure.order_names, coefficients, tuple(bounds), products, tuple(structure.free_delays)
        )

    def coordinates(self, start: Sequence[float], *, plain: bool) -> list[str]:
        """Logarithms where the start allows them."""
        ratios = {
            f for _, factors in self.products.values() for f in factors if f not in self.structure.coefficient_names
        }
        out = []
        for name, value in zip(self.coefficients, start, strict=True):
            if plain or value == 0:
                out.append("plain")
            else:
                out.append("excess" if name in ratios and value > 1 else "logarithm")
        return out

    def laws(self, signals: Sequence[str]) -> list[Any]:
        """Equations with affine orders and monomial coefficients."""
        index = {n: i for i, n in enumerate(self.coefficients)}

        def affine(order: Order) -> tuple[float, list[float]]:
            weights = dict(order.weights)
            return order.constant, [weights.get(n, 0.0) for n in self.orders]

        def monomial(coefficient: str | float, factor: float) -> tuple[float, list[tuple[int, int]]]:
            if not isinstance(coefficient, str):
                return factor * coefficient, []
            sign, factors = self.products.get(coefficient, (1.0, (coefficient,)))
            return factor * sign, [(index[f], 1) for f in factors]

        return [
            (
                signals.index(e.output),
                affine(e.order),
                [(signals.index(t.signal), affine(t.order), monomial(t.coefficient, t.factor)) for t in e.terms],
            )
            for e in self.structure.equations
        ]

    def named(self, values: Sequence[float]) -> dict[str, float]:
        """Every coefficient of the structure by name from the free ones."""
        free = dict(zip(self.coefficients, map(float, values), strict=True))
        out: dict[str, float] = {}
        for name in self.structure.coefficient_names:
            sign, factors = self.products.get(name, (1.0, (name,)))
            out[name] = sign * float(np.prod([free[f] for f in factors]))
        return out

    def number_jacobian(self, orders: Sequence[float], coefficients: Sequence[float]) -> Floats:
        """Derivatives of a model's numbers (rows) with respect to everything that is free (columns).

        Rows are, equation by equation, alpha, then order and coefficient of each term; delays are none of them.
        """
        free = dict(zip(self.coefficients, coefficients, strict=True))
        count, idle = len(self.orders), len(self.delays)
        rows = []

        def of_order(order: Order) -> Floats:
            weights = dict(order.weights)
            return np.array([weights.get(n, 0.0) for n in self.orders] + [0.0] * (len(free) + idle))

        for item in self.structure.equations:
            rows.append(of_order(item.order))
            for term in item.terms:
                row = np.zeros(count + len(free) + idle)
                if isinstance(term.coefficient, str):
                    sign, factors = self.products.get(term.coefficient, (1.0, (term.coefficient,)))
                    for k, name in enumerate(factors):
                        others = [free[f] for j, f in enumerate(factors) if j != k]
                        row[count + list(free).index(name)] += term.factor * sign * math.prod(others)
                rows += [of_order(term.order), row]
        found: Floats = np.stack(rows)
        return found

    def free_from(self, estimated: Mapping[str, float]) -> list[float]:
        """Free coefficients from freely estimated ones; ratios as the median of what the equations say, above 1."""
        out = []
        for name in self.coefficients:
            if name in estimated:
                out.append(estimated[name])
                continue
            said = []
            for dependent, (sign, factors) in self.products.items():
                others = [estimated[f] for f in factors if f != name and f in estimated]
                product = float(np.prod(others))
                if name in factors and product:
                    said.append(sign * estimated[dependent] / product)
            usable = [s for s in said if math.isfinite(s) and 1.05 < s < 20]
            out.append(float(np.median(usable)) if usable else 1.5)
        return out


def experiment(
    run: Run, problem: FreeProblem, initial: Any, weights: Sequence[float], *, every: int = 1, decimation: int = 1
) -> tuple[Any, ...]:
    """A run as the core compares with it: ``every`` pulses a sample interval, each ``decimation``-th sample."""
    # Free delays are the core's to apply, to inputs as they were given.
    structure = replace(problem.structure, initial=initial, free_delays={})
    rows = (run.length - 1) // decimation * decimation + 1
    if rows != run.length:
        run = run.slice(None, rows * run.step - run.step / 2)
    intervals = (rows - 1) // decimation
    coupled = structure.coupling == "simulated"
    rec = record(run, structure, intervals * every, filtered=not coupled)
    samples = []
    for output in structure.outputs:
        measured_through = structure.sensor_filter is not None and output in structure.sensor_filter.outputs
        if rec.sensor is None or measured_through:
            samples.append(run[output][::decimation])
        else:
            # The equation is compared in filtered signals, so this output passes the filter too.
            samples.append(_core.point_samples(rec.of(output))[::every])
    filtered = None
    if coupled and structure.sensor_filter is not None:
        applies = [o in structure.sensor_filter.outputs for o in structure.outputs]
        filtered = (sensor_series(structure, rec.m, rec.step), applies)
    return rec.core(), every, np.ascontiguousarray(np.stack(samples)), filtered, list(weights)


@dataclass
class Attempt:
    """A point in the space of parameters, and what the core said about it."""

    orders: list[float]
    coefficients: list[float]
    origin: str
    found: Any
    delays: list[float] = field(default_factory=list)

    @property
    def values(self) -> Floats:
        """Orders, coefficients, delays."""
        return np.array(self.orders + self.coefficients + self.delays)

    @property
    def level(self) -> float:
        """Cost per residual: 1 at the noise floor if the weights are right."""
        return 2.0 * float(self.found["cost"]) / len(self.found["residuals"])


def descend(
    problem: FreeProblem,
    experiments: list[Any],
    signals: Sequence[str],
    initial: Any,
    attempt: Attempt,
    *,
    evaluations: int,
    tolerance: float = 1e-9,
    plain: bool = False,
) -> Attempt:
    """Levenberg-Marquardt from an attempt."""
    found = _core.output_error(
        experiments,
        problem.laws(signals),
        list(problem.bounds),
        problem.coordinates(attempt.coefficients, plain=plain),
        problem.structure.coupling == "simulated",
        initial_tuple(initial),
        attempt.orders,
        attempt.coefficients,
        [
            (signals.index(n), problem.structure.free_delays[n], delay)
            for n, delay in zip(problem.delays, attempt.delays, strict=True)
        ],
        evaluations,
        tolerance,
    )
    return Attempt(list(found["orders"]), list(found["coefficients"]), attempt.origin, found, list(found["delays"]))


def lowest(problem: FreeProblem, *arguments: Any, evaluations: int) -> Attempt:
    """Descend in logarithmic coordinates, then in plain ones, which may cross zero."""
    experiments, signals, initial, attempt = arguments
    first = descend(problem, experiments, signals, initial, attempt, evaluations=evaluations)
    second = descend(problem, experiments, signals, initial, first, evaluations=evaluations, plain=True)
    return second if second.found["cost"] <= first.found["cost"] else first
