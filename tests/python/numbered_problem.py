"""Estimation problems of the core whose orders and coefficients have numbers instead of names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ftlm import _core

#: (constant, weights of the free orders), and (factor, (coefficient, power) pairs).
Order = tuple[float, Sequence[float]]
Monomial = tuple[float, Sequence[tuple[int, int]]]
HINTS: dict[str, Any] = {"highest": None, "natural": [], "exceeds": [], "positive": [], "known": []}


class NumberedProblem:
    """Coupled bodies with friction: laws (output, order, terms), and friction (equation, [fc, fs, vs])."""

    def __init__(
        self,
        laws: Sequence[tuple[int, Order, Sequence[tuple[int, Order, Monomial]]]],
        frictions: Sequence[tuple[int, Sequence[Monomial]]],
        bounds: Sequence[tuple[float, float]],
        initial: tuple[Any, ...],
    ) -> None:
        products: dict[str, tuple[str, float, list[str]]] = {}

        def coefficient(monomial: Monomial) -> tuple[float, str | float]:
            factor, powers = monomial
            if not powers:
                return 1.0, factor
            factors = [f"c{i}" for i, power in powers for _ in range(power)]
            if len(factors) == 1:
                return factor, factors[0]
            name = "*".join(factors)
            products[name] = (name, 1.0, factors)
            return factor, name

        def order(order_values: Order) -> tuple[float, list[tuple[str, float]]]:
            return order_values[0], [(f"o{k}", weight) for k, weight in enumerate(order_values[1]) if weight]

        friction = dict(frictions)
        equations = []
        for place, (output, alpha, terms) in enumerate(laws):
            own = [(signal, order(nu), *coefficient(value)[::-1]) for signal, nu, value in terms]
            rubs = [coefficient(value) for value in friction[place]] if place in friction else None
            equations.append((output, order(alpha), own, rubs))
        signals = 1 + max(max(output, *(term[0] for term in terms)) for output, _, terms, _ in equations)
        self.core = _core.JointProblem(
            {
                "signals": [f"s{k}" for k in range(signals)],
                "derived": [],
                "equations": equations,
                "bounds": [(f"o{k}", ends) for k, ends in enumerate(bounds)],
                "priors": [],
                "coupled": True,
                "delayed": False,
                "initial": initial,
                "history": False,
                "inputs": [],
                "laws": list(products.values()),
                "hints": HINTS,
            }
        )
        orders, coefficients = (
            [int(name[1:]) for name in names] for names in (self.core.orders, self.core.coefficients)
        )
        self.places = np.array([*orders, *(len(orders) + i for i in coefficients)])

    def evaluate(
        self,
        runs: Sequence[Any],
        values: np.ndarray,
        states: Sequence[Sequence[float]],
        evaluations: int = 1,
        stop: _core.Stop | None = None,
    ) -> dict[str, Any]:
        """Return the fit of so many evaluations, with the derivatives in the order of the numbers."""
        start = [float(v) for v in np.asarray(values)[self.places]], [list(map(float, s)) for s in states]
        result = dict(self.core.minimize(runs, start, True, [], evaluations, 1e-9, False, stop))
        result["jacobian"] = np.asarray(result["jacobian"])[np.argsort(self.places)]
        return result
