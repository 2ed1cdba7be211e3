"""Levenberg-Marquardt least squares under linear inequality constraints, for few parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ftlm.utils.validation import Floats

#: Largest cosine between the residuals and any feasible direction of their Jacobian at an optimum.
COSINE_TOLERANCE = 1e-10
#: Initial, smallest and largest damping factor.
INITIAL_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-2, 1e-12, 1e12


@dataclass(frozen=True)
class LeastSquaresResult:
    """Result of a constrained fit: parameters, cost, convergence, evaluations, active constraints."""

    values: Floats
    cost: float
    converged: bool
    evaluations: int
    active_constraints: tuple[int, ...]


def constrained_least_squares(
    residuals: Callable[[Floats], tuple[Floats, Floats]],
    cost_of: Callable[[Floats], float],
    start: Floats,
    rows: Floats,
    limits: Floats,
    *,
    floor: float = 0.0,
    most: int = 120,
) -> LeastSquaresResult:
    """Minimize a sum of squares under the constraints ``rows @ values <= limits``.

    Parameters
    ----------
    residuals
        Function that returns the residuals and their Jacobian (one column a parameter).
    cost_of
        Function that returns the sum of squares alone; not finite where it is undefined.
    start
        Feasible initial guess.
    rows, limits
        Linear inequality constraints.
    floor
        Sum of squares at rounding level, below which the fit has converged.
    most
        Maximum number of evaluations.
    """
    values, held = start.copy(), list[int]()
    left, slopes = residuals(values)
    cost, damping, spent = float(left @ left), INITIAL_DAMPING, 1
    scale = np.zeros(values.size)
    while spent < most:
        if cost <= floor:
            return LeastSquaresResult(values, cost, True, spent, tuple(held))
        sizes = np.linalg.norm(slopes, axis=0)
        # The largest slopes so far, as in MINPACK: a number that stops acting must not run away.
        scale = np.maximum(scale, sizes)
        unit = np.where(scale > 0, scale, 1.0)
        before = set(held)
        held, free = _release_constraints(left, slopes, unit, rows, held)
        if _is_flat(left, slopes, sizes, free, unit):
            return LeastSquaresResult(values, cost, True, spent, tuple(held))
        step = _step(left, slopes, unit, free, damping)
        reach, wall = _feasible_fraction(values, step, rows, limits, held)
        if reach <= 1e-12 and wall is not None:
            # The gradient leaves a wall that was let go, and a damped step follows it only where it is short.
            spent += 1
            if wall in before:
                damping = min(damping * 4.0, MAX_DAMPING)
            else:
                held.append(wall)
            continue
        tried = values + reach * step
        new = cost_of(tried)
        spent += 1
        if np.isfinite(new) and new < cost:
            gained, moved = cost - new, float(np.linalg.norm(reach * step * unit))
            values, damping = tried, max(damping / 5.0, MIN_DAMPING)
            if wall is not None and reach < 1.0:
                held.append(wall)
            left, slopes = residuals(values)
            cost = new
            if gained <= 1e-13 * cost and moved <= 1e-7 * (np.sqrt(cost) + 1e-300):
                return LeastSquaresResult(values, cost, True, spent, tuple(held))
        elif damping >= MAX_DAMPING or cost == 0.0:
            return LeastSquaresResult(values, cost, cost == 0.0, spent, tuple(held))
        else:
            # A wall is no reason to give up a direction: a shorter step may not reach it.
            damping = min(damping * 4.0, MAX_DAMPING)
            if damping > 1e6 and _is_flat(left, slopes, sizes, free, unit, 1e-6):
                return LeastSquaresResult(values, cost, True, spent, tuple(held))
    return LeastSquaresResult(values, cost, False, spent, tuple(held))


def _basis(rows: Floats, held: list[int], unit: Floats) -> Floats:
    """Return orthonormal directions, in scaled parameters, that keep the active constraints active."""
    if not held:
        return np.eye(unit.size)
    normals = rows[held] / unit
    _, sizes, directions = np.linalg.svd(normals)
    rank = int(np.sum(sizes > 1e-12 * sizes[0])) if sizes.size else 0
    return np.asarray(directions[rank:].T)


def _release_constraints(
    left: Floats, slopes: Floats, unit: Floats, rows: Floats, held: list[int]
) -> tuple[list[int], Floats]:
    """Return the active constraints with a nonnegative multiplier, and a basis of the free directions."""
    while held:
        normals = (rows[held] / unit).T
        push = np.linalg.lstsq(normals, -(slopes / unit).T @ left, rcond=None)[0]
        worst = int(np.argmin(push))
        if push[worst] >= 0:
            break
        held = held[:worst] + held[worst + 1 :]
    return held, _basis(rows, held, unit)


def _is_flat(
    left: Floats, slopes: Floats, sizes: Floats, free: Floats, unit: Floats, least: float = COSINE_TOLERANCE
) -> bool:
    size = float(np.linalg.norm(left))
    if size == 0.0 or free.shape[1] == 0:
        return True
    along = (slopes / unit) @ free
    lengths = np.linalg.norm(along, axis=0)
    cosines = np.abs(along.T @ left) / np.where(lengths > 0, lengths * size, 1.0)
    return bool(np.max(cosines, initial=0.0) <= least)


def _step(left: Floats, slopes: Floats, unit: Floats, free: Floats, damping: float) -> Floats:
    along = (slopes / unit) @ free
    stacked = np.vstack([along, np.sqrt(damping) * np.eye(free.shape[1])])
    wanted = np.concatenate([-left, np.zeros(free.shape[1])])
    step: Floats = (free @ np.linalg.lstsq(stacked, wanted, rcond=None)[0]) / unit
    return step


def _feasible_fraction(
    values: Floats, step: Floats, rows: Floats, limits: Floats, held: list[int]
) -> tuple[float, int | None]:
    """Return the largest feasible fraction of a step, and the constraint that limits it."""
    towards, room = rows @ step, limits - rows @ values
    towards[held] = 0.0
    # What cannot move but for rounding ends nothing.
    ends = np.flatnonzero(towards > 1e-14)
    if not ends.size:
        return 1.0, None
    shares = np.maximum(room[ends], 0.0) / towards[ends]
    first = int(np.argmin(shares))
    return (1.0, None) if shares[first] >= 1.0 else (float(shares[first]), int(ends[first]))
