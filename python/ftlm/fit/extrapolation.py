"""How far an extrapolated estimate may go: bounds, and orders that stay below the highest of their equation."""

from __future__ import annotations

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.data.orders import Order
from ftlm.fit.problem import FreeProblem
from ftlm.solve.records import affine

#: What the core keeps between the highest order of an equation and those of its own terms.
LEAST_INTEGRATION = 1e-3
#: Orders of a model are rounded to 1e-9, two of them apart; another signal's may reach the highest but not pass it.
ROUNDED = 2e-9


def feasible(problem: FreeProblem, at: Floats, towards: Floats) -> Floats:
    """The last point on the way from a feasible one to another that keeps the bounds and the constraints of orders.

    A constraint that already holds with equality is kept by going along it. Every constraint is affine, so the last
    point is exact.
    """
    normals, offsets, margins = _constraints(problem)
    room = normals @ at + offsets
    # A point that the core let pass closer than a margin keeps what it has.
    room = np.maximum(room - np.minimum(margins, room), 0.0)
    step = towards - at
    active = np.zeros(room.size, dtype=bool)
    while True:
        blocked = (room <= ROUNDED) & (normals @ step < -1e-15) & ~active
        if not blocked.any():
            break
        active |= blocked
        basis = np.linalg.svd(normals[active], full_matrices=False)
        kept = basis[2][basis[1] > 1e-9 * basis[1][0]]
        step = step - kept.T @ (kept @ step)
    change = normals @ step
    short = (change < 0) & ~active & (room + change < 0)
    share = float(np.min(room[short] / -change[short])) if short.any() else 1.0
    return np.asarray(at + share * step)


def _constraints(problem: FreeProblem) -> tuple[Floats, Floats, Floats]:
    """Rows a, b, m of all constraints a·x + b ≥ m on everything free."""
    size, rows = len(problem.names), []

    def of(order: Order) -> tuple[Floats, float]:
        constant, weights = affine(order, problem.orders)
        return np.array(list(weights) + [0.0] * (size - len(weights))), constant

    for i, (low, high) in enumerate(problem.all_bounds):
        unit = np.eye(size)[i]
        rows += [(unit, -low, 0.0)] if np.isfinite(low) else []
        rows += [(-unit, high, 0.0)] if np.isfinite(high) else []
    for item in problem.structure.equations:
        highest, top = of(item.order)
        for term in item.terms:
            weights, constant = of(term.order)
            own = term.signal == item.output
            rows.append((highest - weights, top - constant, LEAST_INTEGRATION if own else ROUNDED))
            if own:
                rows.append((weights, constant, 0.0))
    kept = [(a, b, m) for a, b, m in rows if a.any()]
    if not kept:
        return np.zeros((0, size)), np.zeros(0), np.zeros(0)
    return np.stack([a for a, _, _ in kept]), np.array([b for _, b, _ in kept]), np.array([m for _, _, m in kept])
