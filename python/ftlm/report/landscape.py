"""How an error changes around the best orders: every candidate of a lattice in two of them, or a joint fit's cost."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ftlm.errors import FtlmError, ModelError
from ftlm.models import Structure
from ftlm.order_search import Lattice, SearchResult, prepare, search_orders
from ftlm.output_error import Attempt, FreeProblem, descend, experiment

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from ftlm.identification import Identification
    from ftlm.runs import Run

    Floats = NDArray[np.float64]

__all__ = ["Landscape", "correlated_orders", "landscape", "output_error_landscape"]

#: Points a side of a joint fit's landscape, and its half-width in standard errors.
SIDE, HALF_WIDTH = 11, 4.0
#: Evaluations that find the optimum of the fit's last grid.
REFITS = 20


@dataclass(frozen=True)
class Landscape:
    """Scores of a lattice over two orders, the others as in the best model.

    Parameters
    ----------
    names
        The two orders, across and upward.
    x, y
        Their values, ascending.
    scores
        Shape (y, x); infinite where a pair is no candidate or its free run diverges.
    others
        What the other numbers do, in words.
    score
        What the score is, in words.
    correlation
        Of the two orders in a joint fit; not a number otherwise.
    """

    names: tuple[str, str]
    x: Floats
    y: Floats
    scores: Floats
    others: str = "Other orders as in the best model."
    score: str = "score"
    correlation: float = math.nan


def landscape(
    runs: Run | Sequence[Run],
    structure: Structure,
    search: SearchResult,
    lattice: Lattice | None = None,
    *,
    orders: tuple[str, str] | None = None,
    threads: int | None = None,
) -> Landscape:
    """Score every pair of values of two orders by the search's own criterion.

    Parameters
    ----------
    runs, structure, lattice
        What was searched: an equation, or a stage under its order law.
    search
        What was found.
    orders
        Names of the two; by default the first two free orders that the lattice gives several values.
    threads
        See :func:`ftlm.search_orders`.

    Returns
    -------
    Landscape

    Raises
    ------
    ModelError
        Fewer than two orders with several values, or a name that is none of them.
    """
    axes = {n: v for n, v in (lattice or Lattice()).values(structure).items() if len(v) > 1}
    best = search.orders
    names = orders or tuple(list(axes)[:2])
    if len(names) != 2 or names[0] == names[1] or any(n not in axes for n in names):
        free = ", ".join(axes) or "none"
        raise ModelError(f"a landscape needs two different orders with several values each; this lattice has {free}")
    x, y = (np.array(axes[n]) for n in names)
    fixed = structure.with_orders({n: v for n, v in best.items() if n not in names})
    settings: dict[str, Any] = {
        n: search.settings[n]
        for n in ("criterion", "norm", "coefficients", "innovation_length", "prior_covariance", "rows")
        if n in search.settings
    }
    found = search_orders(
        runs, fixed, Lattice(orders={names[0]: x.tolist(), names[1]: y.tolist()}), m=search.m, keep=x.size * y.size,
        threads=threads, **settings,
    )  # fmt: skip
    scores = np.full((y.size, x.size), np.inf)
    columns = np.array([r.orders[names[0]] for r in found.table])
    rows = np.array([r.orders[names[1]] for r in found.table])
    values = np.array([r.score for r in found.table])
    scores[np.abs(y[:, None] - rows).argmin(axis=0), np.abs(x[:, None] - columns).argmin(axis=0)] = values
    return Landscape((names[0], names[1]), x, y, scores)


def correlated_orders(result: Identification) -> tuple[str, str, float] | None:
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
    result: Identification, orders: tuple[str, str] | None = None, *, refit: bool = True
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
