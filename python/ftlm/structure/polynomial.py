"""Polynomials in s with real powers, as dictionaries of coefficients by power."""

from __future__ import annotations

import itertools
from typing import TypeAlias

#: Polynomial in s with real powers, as a dictionary of coefficients by power.
Polynomial: TypeAlias = dict[float, float]
#: Difference below which two powers of s count as equal.
POWER_TOLERANCE = 1e-9


def add_polynomial(target: Polynomial, summand: Polynomial, factor: float = 1.0) -> None:
    """Add `factor` times the polynomial `summand` to the polynomial `target` in place; nearly equal powers merge."""
    for power, value in summand.items():
        key = next((p for p in target if abs(p - power) < POWER_TOLERANCE), power)
        target[key] = target.get(key, 0.0) + factor * value


def multiply_polynomials(a: Polynomial, b: Polynomial) -> Polynomial:
    """Return the product of two polynomials with real powers."""
    out: Polynomial = {}
    for (p, x), (q, y) in itertools.product(a.items(), b.items()):
        add_polynomial(out, {round(p + q, 9): x * y})
    return out
