"""What is free in a joint fit, as the core takes it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ftlm import _core
from ftlm.base.arrays import Floats
from ftlm.data.equations import Friction, Stribeck
from ftlm.data.limits import FreeInput
from ftlm.data.orders import Order
from ftlm.data.structures import Hints, History, Offset, Structure
from ftlm.solve.records import affine, initial_tuple


@dataclass(frozen=True)
class FreeProblem:
    """A structure, its initial terms decided, as the core takes it.

    Orders are affine in free ones, coefficients products of free ones.
    """

    structure: Structure

    @cached_property
    def core(self) -> _core.JointProblem:
        """What the core makes of the structure."""
        return _core.JointProblem(told(self.structure))

    @cached_property
    def orders(self) -> tuple[str, ...]:
        """Free orders."""
        return tuple(self.core.orders)

    @cached_property
    def coefficients(self) -> tuple[str, ...]:
        """Free coefficients, those of a law among them."""
        return tuple(self.core.coefficients)

    @cached_property
    def products(self) -> Mapping[str, tuple[float, tuple[str, ...]]]:
        """Coefficients that a law gives: sign and factors by name."""
        return {name: (sign, tuple(factors)) for name, sign, factors in self.core.products}

    @cached_property
    def bounds(self) -> tuple[tuple[float, float], ...]:
        """Bounds of the free orders."""
        return tuple(self.core.bounds[: len(self.orders)])

    @property
    def inputs(self) -> tuple[FreeInput, ...]:
        """Free numbers of inputs."""
        return self.structure.free_inputs

    @property
    def names(self) -> list[str]:
        """Everything that is free: orders, coefficients, then numbers of inputs."""
        return [*self.orders, *self.coefficients, *(item.name for item in self.inputs)]

    def split(self, values: Sequence[float]) -> tuple[list[float], list[float], list[float]]:
        """Values of orders, coefficients and numbers of inputs."""
        flat = list(map(float, values))
        first, second = len(self.orders), len(self.orders) + len(self.coefficients)
        return flat[:first], flat[first:second], flat[second:]

    @classmethod
    def of(cls, structure: Structure) -> FreeProblem:
        """The same, refused at once where the core cannot take it."""
        problem = cls(structure)
        _ = problem.core
        return problem

    @property
    def all_bounds(self) -> list[tuple[float, float]]:
        """Bounds of everything that is free; those of coefficients are infinite, but friction takes energy."""
        return self.core.bounds

    def feasible(self, at: Floats, towards: Floats) -> Floats:
        """The last point on the way from a feasible one to another that keeps bounds and constraints of orders."""
        return self.core.feasible(at, towards)

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

        Rows are, equation by equation, alpha, then order and coefficient of each term, then the coefficient of friction
        where there is some (of Stribeck's term after it fs and vs); numbers of inputs are none of them.
        """
        free = dict(zip(self.coefficients, coefficients, strict=True))
        count, idle = len(self.orders), len(self.inputs)
        rows = []

        def of_order(order: Order) -> Floats:
            return np.array(affine(order, self.orders)[1] + [0.0] * (len(free) + idle))

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
            rubs, more = item.friction, None if item.friction is None else item.friction.stribeck
            numbers = [] if rubs is None else [rubs.coefficient]
            for number in numbers + ([] if more is None else [more.coefficient, more.speed]):
                row = np.zeros(count + len(free) + idle)
                if isinstance(number, str):
                    row[count + list(free).index(number)] = 1.0
                rows.append(row)
        return np.stack(rows)

    def free_from(self, estimated: Mapping[str, float]) -> list[float]:
        """Free coefficients from freely estimated ones; ratios as the median of what the equations can say."""
        return self.core.free_from(dict(estimated))


def told(structure: Structure) -> Any:
    """A structure, its initial terms decided, as the core takes it."""
    signals, hints = structure.signals, structure.hints or Hints()
    states = structure.filter_states(structure.initial)
    # What is free does not hang on an offset that is still to be decided.
    offset: Offset = "none" if structure.offset == "auto" else structure.offset

    def order(of: Order) -> tuple[float, list[tuple[str, float]]]:
        return of.constant, list(of.weights)

    def friction(rubs: Friction | None) -> list[tuple[float, str | float]] | None:
        if rubs is None:
            return None
        more = rubs.stribeck or Stribeck(0.0, 1.0)
        return [(-rubs.factor, rubs.coefficient), (-more.factor, more.coefficient), (1.0, more.speed)]

    equations = [
        (
            signals.index(e.output), order(e.order),
            [(signals.index(t.signal), order(t.order), t.coefficient, t.factor) for t in e.terms], friction(e.friction),
        )
        for e in structure.equations
    ]  # fmt: skip
    return {
        "signals": list(signals),
        "equations": equations,
        "bounds": [(name, (values[0], values[-1])) for name, values in structure.order_values.items()],
        "coupled": structure.coupling == "simulated",
        "delayed": bool(structure.delay),
        "initial": initial_tuple(structure.initial, offset, states),
        "history": isinstance(structure.initial, History),
        "inputs": [(i.name, signals.index(i.signal), i.law, i.bounds) for i in structure.free_inputs],
        "laws": list(structure.coefficient_law),
        "hints": {
            "highest": hints.highest,
            "natural": [(name, list(values)) for name, values in hints.natural.items()],
            "exceeds": list(hints.exceeds.items()),
            "positive": list(hints.positive),
            "known": list(hints.known.items()),
        },
    }
