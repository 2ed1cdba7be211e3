"""A joint fit's cost around its optimum, over the two orders that its runs tell apart least."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ftlm.base.errors import FtlmError, ModelError
from ftlm.fit.problem import Attempt, FreeProblem, descend, experiment
from ftlm.identification.judged import Judged
from ftlm.paint.heat import Landscape
from ftlm.solve.records import prepare

#: Points a side of a joint fit's landscape, and its half-width in standard errors.
SIDE, HALF_WIDTH = 11, 4.0
#: Evaluations that find the optimum of the fit's last grid.
REFITS = 20


def correlated_orders(result: Judged) -> tuple[str, str, float] | None:
    """The two orders of a joint fit that its runs tell apart least, and their correlation.

    Parameters
    ----------
    result
        By output error.

    Returns
    -------
    tuple or None
        None with fewer than two free orders, or where no correlation is known.
    """
    if result.joint is None:
        return None
    names = list(result.joint.orders)
    found = np.abs(result.joint.correlation[: len(names), : len(names)])
    found = np.where(np.isfinite(found) & ~np.eye(len(names), dtype=bool), found, -1.0)
    if len(names) < 2 or found.max() < 0:
        return None
    i, j = sorted(int(k) for k in np.unravel_index(int(np.argmax(found)), found.shape))
    return names[i], names[j], float(result.joint.correlation[i, j])


def output_error_landscape(
    result: Judged, orders: tuple[str, str] | None = None, *, refit: bool = True
) -> Landscape | None:
    """Cost of a joint output-error fit over two of its orders, four standard errors around the optimum.

    Parameters
    ----------
    result
        By output error.
    orders
        Names of the two; by default those that the runs tell apart least.
    refit
        Whether all other orders, coefficients and delays follow by one linear step from the optimum; otherwise they
        are held.

    Returns
    -------
    Landscape or None
        Scores are 1 plus what the sum of squares, weighted by the noise, exceeds its smallest value by; for white
        residuals the 95 % region of both orders ends at 7. None where two orders have no finite standard error.

    Raises
    ------
    ModelError
        A name that is no free order.
    """
    joint, task, pair = result.joint, result.task, orders
    chosen = correlated_orders(result)
    if joint is None or task is None or (pair is None and chosen is None):
        return None
    first, second = pair or chosen[:2]  # type: ignore[index]
    names = list(joint.orders)
    if first == second or first not in names or second not in names:
        raise ModelError(f"a landscape needs two different free orders; this fit has {', '.join(names)}")
    errors = joint.standard_errors
    if not all(0 < errors[n] < math.inf for n in (first, second)):
        return None
    decided = prepare(task.runs, replace(task.structure, free_delays={}), None, power_of_two=False)[0].initial
    structure = replace(task.structure, initial=decided)
    problem = FreeProblem.of(structure)
    weights = [1.0 / joint.noise[o] for o in structure.outputs]
    experiments = [experiment(run, problem, structure.initial, weights, every=joint.refinement) for run in task.runs]

    def attempt(values: Sequence[float], evaluations: int) -> Attempt:
        held, coefficients, delays = problem.split(list(values))
        start = Attempt(held, coefficients, "landscape", {}, delays)
        return descend(
            problem, experiments, structure.signals, structure.initial, start, evaluations=evaluations, plain=True
        )

    # The estimate is extrapolated to step 0; the grid has an optimum of its own close by.
    best = attempt(joint.values.tolist(), REFITS)
    centre = best.values
    at = [problem.names.index(n) for n in (first, second)]
    residuals, jacobian = np.asarray(best.found["residuals"]), np.asarray(best.found["jacobian"])
    rest = np.delete(jacobian, at, axis=0)
    size = np.linalg.norm(rest, axis=1, keepdims=True)
    basis = np.linalg.svd(rest / np.where(size > 0, size, 1.0), full_matrices=False)[2] if refit and rest.size else None
    bounds = dict(zip(problem.orders, problem.bounds, strict=True))
    axes = []
    for name, k in zip((first, second), at, strict=True):
        low, high = centre[k] - HALF_WIDTH * errors[name], centre[k] + HALF_WIDTH * errors[name]
        axes.append(np.linspace(max(low, bounds[name][0]), min(high, bounds[name][1]), SIDE))

    def cost(x: float, y: float) -> float:
        moved = centre.copy()
        moved[at] = x, y
        try:
            found = np.asarray(attempt(moved.tolist(), 1).found["residuals"])
        except FtlmError:
            return math.inf
        if basis is not None:
            found = found - basis.T @ (basis @ found)
        return float(found @ found)

    scores = np.array([[cost(x, y) for x in axes[0]] for y in axes[1]])
    whole = residuals if basis is None else residuals - basis.T @ (basis @ residuals)
    least = min(float(whole @ whole), float(scores.min()))
    kept = "All other numbers refitted, by one linear step." if refit else "All other numbers held at the optimum."
    i, j = names.index(first), names.index(second)
    return Landscape(
        (first, second), axes[0], axes[1], 1.0 + scores - least, kept,
        "1 + increase of the weighted sum of squares", float(joint.correlation[i, j]),
    )  # fmt: skip
