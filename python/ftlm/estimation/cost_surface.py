"""Cost surface of a joint fit over its two most correlated orders."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ftlm import _core
from ftlm.errors import ModelError
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.output_error import fit_state
from ftlm.estimation.result import Identification
from ftlm.simulation.discretization import recording
from ftlm.svg.charts import Landscape
from ftlm.utils.arguments import check_arguments
from ftlm.utils.resources import stop_flag

#: Number of points on each axis of the cost surface, and half-width of the axes in standard errors.
POINTS_PER_AXIS, HALF_WIDTH_ERRORS = 11, 4.0
#: Maximum number of evaluations that find the optimum on the finest grid.
OPTIMUM_EVALUATIONS = 20


@check_arguments
def correlated_orders(result: Identification) -> tuple[str, str, float] | None:
    """Return the names of the two most correlated free orders of a joint fit, and their correlation coefficient.

    Parameters
    ----------
    result
        Result by output error.

    Returns
    -------
    tuple or None
        (name, name, correlation); None with fewer than two free orders, or if no correlation is finite.
    """
    if result.joint is None:
        return None
    names = list(result.joint.orders)
    magnitudes = np.abs(result.joint.correlation[: len(names), : len(names)])
    magnitudes = np.where(np.isfinite(magnitudes) & ~np.eye(len(names), dtype=bool), magnitudes, -1.0)
    if len(names) < 2 or magnitudes.max() < 0:
        return None
    i, j = sorted(int(k) for k in np.unravel_index(int(np.argmax(magnitudes)), magnitudes.shape))
    return names[i], names[j], float(result.joint.correlation[i, j])


@check_arguments
def output_error_landscape(
    result: Identification, orders: tuple[str, str] | None = None, *, refit: bool = True
) -> Landscape | None:
    """Compute the output-error cost on a grid of two orders, within four standard errors of the optimum.

    Parameters
    ----------
    result
        Result by output error.
    orders
        Names of the two orders; by default the most correlated ones.
    refit
        Whether the cost at each grid point is minimized over the other parameters, to first order. Otherwise these
        parameters keep their values at the optimum.

    Returns
    -------
    Landscape or None
        Grid of scores 1 + (S - S_min) / noise variance, with the sum of squares S. For white residuals, the score is
        below 7 in the joint 95 % confidence region of both orders. None if there are no two orders with a finite
        standard error.

    Raises
    ------
    ModelError
        If a name is not a free order.
    """
    joint, task, pair = result.joint, result.task, orders
    pair_choice = correlated_orders(result)
    if pair is None and pair_choice is not None:
        pair = pair_choice[:2]
    if joint is None or task is None or pair is None:
        return None
    first, second = pair
    names = list(joint.orders)
    if first == second or first not in names or second not in names:
        raise ModelError(f"a landscape needs two different free orders; this fit has {', '.join(names)}")
    errors = joint.standard_errors
    if not all(0 < errors[n] < math.inf for n in (first, second)):
        return None
    problem = FreeProblem.of(replace(task.structure, initial=joint.initial))
    minimum, x, y, costs = _core.cost_surface(
        problem.core,
        [recording(run, problem.structure) for run in task.runs],
        {**fit_state(joint, problem), "requires_stability": False},
        (problem.names.index(first), problem.names.index(second)),
        (HALF_WIDTH_ERRORS * errors[first], HALF_WIDTH_ERRORS * errors[second]),
        POINTS_PER_AXIS,
        refit=refit,
        evaluations=OPTIMUM_EVALUATIONS,
        stop=stop_flag(),
    )
    minimum = min(minimum, float(costs.min()))
    treatment = "refitted by one linear step" if refit else "fixed at the optimum"
    subtitle = f"All other parameters are {treatment}."
    i, j = names.index(first), names.index(second)
    return Landscape(
        (first, second),
        x,
        y,
        1.0 + costs - minimum,
        subtitle,
        "1 + increase of the weighted sum of squares",
        float(joint.correlation[i, j]),
    )
