"""Cost surface of a joint fit over its two most correlated orders."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ftlm.errors import FtlmError, ModelError
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Iterate, Objective
from ftlm.estimation.output_error import JointFit
from ftlm.estimation.result import Identification, Task
from ftlm.svg.heat_map import Landscape
from ftlm.utils.arguments import check_arguments
from ftlm.utils.linalg import dot, projections, thin_svd
from ftlm.utils.validation import Floats

#: Points on each axis of the cost surface, and its half-width in standard errors.
POINTS_PER_AXIS, HALF_WIDTH_ERRORS = 11, 4.0
#: Maximum number of evaluations that find the optimum on the finest grid.
OPTIMUM_EVALUATIONS = 20


@check_arguments
def correlated_orders(result: Identification) -> tuple[str, str, float] | None:
    """Return the two most correlated orders of a joint fit, and their correlation.

    Parameters
    ----------
    result
        Result by output error.

    Returns
    -------
    tuple or None
        None with fewer than two free orders, or without a known correlation.
    """
    if result.fit is None:
        return None
    names = list(result.fit.orders)
    sizes = np.abs(result.fit.correlation[: len(names), : len(names)])
    sizes = np.where(np.isfinite(sizes) & ~np.eye(len(names), dtype=bool), sizes, -1.0)
    if len(names) < 2 or sizes.max() < 0:
        return None
    i, j = sorted(int(k) for k in np.unravel_index(int(np.argmax(sizes)), sizes.shape))
    return names[i], names[j], float(result.fit.correlation[i, j])


@check_arguments
def output_error_landscape(
    result: Identification, orders: tuple[str, str] | None = None, *, refit: bool = True
) -> Landscape | None:
    """Compute the cost of an output-error fit over two orders, four standard errors around the optimum.

    Parameters
    ----------
    result
        Result by output error.
    orders
        Names of the two orders; by default the most correlated ones.
    refit
        Whether all other parameters follow by one linear step from the optimum; otherwise they stay fixed.

    Returns
    -------
    Landscape or None
        Scores are 1 plus the increase of the sum of squares, weighted by the noise. For white residuals the 95 % region
        of both orders ends at 7. None if two orders have no finite standard error.

    Raises
    ------
    ModelError
        A name that is no free order.
    """
    joint, task, pair = result.fit, result.task, orders
    chosen = correlated_orders(result)
    if pair is None and chosen is not None:
        pair = chosen[:2]
    if joint is None or task is None or pair is None:
        return None
    first, second = pair
    names = list(joint.orders)
    if first == second or first not in names or second not in names:
        raise ModelError(f"a landscape needs two different free orders; this fit has {', '.join(names)}")
    errors = joint.standard_errors
    if not all(0 < errors[n] < math.inf for n in (first, second)):
        return None
    around = CostSurface.of(joint, task, (first, second), refit=refit)
    bounds = dict(zip(around.grid.problem.orders, around.grid.problem.bounds, strict=True))
    axes = []
    for name, k in zip((first, second), around.at, strict=True):
        low, high = (
            around.center[k] - HALF_WIDTH_ERRORS * errors[name],
            around.center[k] + HALF_WIDTH_ERRORS * errors[name],
        )
        axes.append(np.linspace(max(low, bounds[name][0]), min(high, bounds[name][1]), POINTS_PER_AXIS))
    scores = np.array([[around.cost(x, y) for x in axes[0]] for y in axes[1]])
    least = min(around.residual_sum_of_squares(around.best), float(scores.min()))
    kept = "All other numbers refitted, by one linear step." if refit else "All other numbers held at the optimum."
    i, j = names.index(first), names.index(second)
    return Landscape(
        (first, second),
        axes[0],
        axes[1],
        1.0 + scores - least,
        kept,
        "1 + increase of the weighted sum of squares",
        float(joint.correlation[i, j]),
    )


@dataclass(frozen=True)
class CostSurface:
    """Cost surface around the optimum of a joint fit."""

    grid: Objective
    best: Iterate
    at: list[int]
    basis: Floats | None

    @classmethod
    def of(cls, joint: JointFit, task: Task, names: tuple[str, str], *, refit: bool) -> CostSurface:
        """Return the surface around the optimum of the finest grid, close to the estimate."""
        problem = FreeProblem.of(replace(task.structure, initial=joint.initial))
        weights = [1.0 / joint.noise[o] for o in problem.structure.outputs]
        grid = Objective(problem, task.runs, weights, joint.refinement, robust_weights=joint.robust_weights)
        best = _minimize_from(grid, joint.values, OPTIMUM_EVALUATIONS)
        at = [problem.names.index(n) for n in names]
        others = np.delete(np.asarray(best.outcome["jacobian"]), at, axis=0)
        size = np.linalg.norm(others, axis=1, keepdims=True)
        spanned = refit and bool(others.size)
        scaled = others / np.where(size > 0, size, 1.0)
        return cls(grid, best, at, thin_svd(scaled.T)[0].T if spanned else None)

    @property
    def center(self) -> Floats:
        """Parameters at the optimum."""
        return self.best.values

    def residual_sum_of_squares(self, attempt: Iterate) -> float:
        """Return the residual sum of squares after one linear step of all other parameters."""
        residuals = np.asarray(attempt.outcome["residuals"])
        if self.basis is not None:
            residuals = residuals - self.basis.T @ projections(self.basis.T, residuals)
        return dot(residuals, residuals)

    def cost(self, x: float, y: float) -> float:
        """Return the sum of squares at two parameter values; infinite if the simulation is not finite."""
        values = self.center.copy()
        values[self.at] = x, y
        try:
            return self.residual_sum_of_squares(_minimize_from(self.grid, values, 1))
        except FtlmError:
            return math.inf


def _minimize_from(grid: Objective, values: Floats, evaluations: int) -> Iterate:
    """Minimize the cost from given parameters."""
    orders, coefficients, inputs = grid.problem.split(values.tolist())
    return grid.minimize(Iterate(orders, coefficients, "landscape", {}, inputs), evaluations, plain=True)
