"""The covariance that a joint fit's residuals leave."""

from __future__ import annotations

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.statistics import is_white
from ftlm.fit.grid import Attempt, Grid

#: Lags of the residuals' autocovariance that the robust covariance takes in, as a power of the sample count.
LAG_POWER = 1.0 / 3.0


def covariance(attempt: Attempt, grid: Grid) -> Floats:
    """Covariance of the parameters: classical where residuals are white, robust to their colour where not."""
    jacobian = np.asarray(attempt.outcome["jacobian"])
    series = [residuals for part in grid.residuals(attempt) for residuals in part.values()]
    spread = np.linalg.norm(jacobian, axis=1)
    spread = np.where(spread > 0, spread, 1.0)
    scaled = jacobian / spread[:, None]
    bread = np.linalg.pinv(scaled @ scaled.T, rcond=1e-14, hermitian=True)
    count = jacobian.shape[1]
    variance = 2.0 * float(attempt.outcome["cost"]) / max(count - jacobian.shape[0], 1)
    middle = variance * bread if all(map(is_white, series)) else bread @ _long_run(scaled, series) @ bread
    result: Floats = middle / np.outer(spread, spread)
    return result


def _long_run(jacobian: Floats, series: list[Floats]) -> Floats:
    """Covariance of the scores with Bartlett weights: the middle of the sandwich (doi:10.2307/1913610)."""
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
