"""The covariance that a joint fit's residuals leave."""

from __future__ import annotations

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.statistics import is_white
from ftlm.fit.grid import Attempt, Grid

#: Lags of the residuals' autocovariance that the robust covariance takes in, as a power of the sample count.
LAG_POWER = 1.0 / 3.0


def covariance(attempt: Attempt, grid: Grid) -> Floats:
    """Covariance of the parameters: classical where residuals are white, robust to their colour where not.

    Nothing is truncated: a parameter that takes part in a direction which the runs do not see has an infinite variance.
    """
    series = [residuals for part in grid.residuals(attempt) for residuals in part.values()]
    return covariance_of(np.asarray(attempt.outcome["jacobian"]), series, 2.0 * float(attempt.outcome["cost"]))


def covariance_of(jacobian: Floats, series: list[Floats], squares: float) -> Floats:
    """Covariance from a Jacobian (a row a parameter), residuals by run and output, and the sum of their squares.

    By the singular values of the Jacobian, rows scaled to one length: a product with itself would hide half of the
    digits. Singular values below rounding are zero, and the directions that belong to them unseen. Covariances with a
    parameter of infinite variance are not numbers.
    """
    parameters, count = jacobian.shape
    spread = np.linalg.norm(jacobian, axis=1)
    scaled = jacobian / np.where(spread > 0, spread, 1.0)[:, None]
    if count < parameters:
        scaled = np.hstack([scaled, np.zeros((parameters, parameters - count))])
    directions, sizes, rows = np.linalg.svd(scaled, full_matrices=False)
    rounding = np.finfo(np.float64).eps * np.sqrt(max(count, 1)) * float(sizes.max(initial=0.0))
    seen = sizes > rounding
    # How far rounding may turn a seen direction into an unseen one.
    turned = rounding / float(sizes[seen].min()) if seen.any() else 0.0
    unseen = np.linalg.norm(directions[:, ~seen], axis=1) > turned if not seen.all() else np.zeros(parameters, bool)
    # Least-squares answers to unit residuals: the factors of the bread, so that no product of it is ever formed.
    inverse = directions[:, seen] / sizes[seen]
    if all(map(is_white, series)):
        middle = squares / max(count - parameters, 1) * (inverse @ inverse.T)
    else:
        middle = long_run((inverse @ rows[seen])[:, :count], series)
    result: Floats = middle / np.outer(np.where(spread > 0, spread, 1.0), np.where(spread > 0, spread, 1.0))
    result[unseen, :] = result[:, unseen] = np.nan
    result[unseen, unseen] = np.inf
    return result


def deviation(slopes: Floats, spread: Floats) -> Floats:
    """Standard errors, to first order, of numbers whose slopes are the rows, infinite where a parameter's is."""
    unseen = np.isinf(np.diag(spread))
    known = slopes[:, ~unseen]
    variance = np.einsum("ij,jk,ik->i", known, spread[np.ix_(~unseen, ~unseen)], known)
    return np.where((slopes[:, unseen] != 0).any(axis=1), np.inf, np.sqrt(np.maximum(variance, 0.0)))


def long_run(jacobian: Floats, series: list[Floats]) -> Floats:
    """Covariance of sums of scores with Bartlett weights: the middle of the sandwich (doi:10.2307/1913610)."""
    total: Floats = np.zeros((jacobian.shape[0], jacobian.shape[0]))
    at = 0
    for residuals in series:
        scores = jacobian[:, at : at + residuals.size] * residuals
        at += residuals.size
        lags = int(4 * residuals.size**LAG_POWER)
        total += scores @ scores.T
        for lag in range(1, min(lags, residuals.size - 1)):
            cross = scores[:, lag:] @ scores[:, :-lag].T
            total += (1.0 - lag / lags) * (cross + cross.T)
    return total
