"""Equations of a problem as the core's own estimators take them, written out from the structure."""

from __future__ import annotations

from typing import Any

from ftlm.estimation.free_parameters import FreeProblem
from ftlm.simulation.discretization import affine


def laws(problem: FreeProblem) -> list[Any]:
    """Output, affine order, and (signal, affine order, (factor, powers of free coefficients)) of each term."""
    names, signals = list(problem.coefficients), problem.structure.signals

    def monomial(coefficient: str | float, factor: float) -> tuple[float, list[tuple[int, int]]]:
        if not isinstance(coefficient, str):
            return factor * coefficient, []
        sign, factors = problem.products.get(coefficient, (1.0, (coefficient,)))
        return factor * sign, [(names.index(f), factors.count(f)) for f in dict.fromkeys(factors)]

    return [
        (
            signals.index(e.output),
            affine(e.order, problem.orders),
            [
                (signals.index(t.signal), affine(t.order, problem.orders), monomial(t.coefficient, t.factor))
                for t in e.terms
            ],
        )
        for e in problem.structure.equations
    ]
