"""Residuals of a joint fit and the covariance that they leave."""

from __future__ import annotations

from typing import Any

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.statistics import is_white
from ftlm.data.structures import Structure
from ftlm.fit.problem import Attempt

#: Lags of the residuals' autocovariance that the robust covariance takes in, as a power of the sample count.
LAG_POWER = 1.0 / 3.0


def split_residuals(attempt: Attempt, experiments: list[Any], structure: Structure) -> list[dict[str, Floats]]:
    """Weighted residuals by run and output."""
    flat = np.asarray(attempt.found["residuals"])
    out, at = [], 0
    for _, _, samples, _, _ in experiments:
        compared = samples.shape[1] - 2
        part = {}
        for output in structure.outputs:
            part[output] = flat[at : at + compared]
            at += compared
        out.append(part)
    return out


def residual_levels(attempt: Attempt, experiments: list[Any], structure: Structure) -> dict[str, float]:
    """Root mean square of the weighted residuals by output, over all runs."""
    parts = split_residuals(attempt, experiments, structure)
    return {o: float(np.sqrt(np.mean(np.concatenate([p[o] for p in parts]) ** 2))) for o in structure.outputs}


def covariance(attempt: Attempt, experiments: list[Any], structure: Structure) -> Floats:
    """Covariance of the parameters: classical where residuals are white, robust to their colour where not.

    The robust form is the sandwich with Bartlett weights (doi:10.2307/1913610).
    """
    jacobian = np.asarray(attempt.found["jacobian"])
    parts = split_residuals(attempt, experiments, structure)
    spread = np.linalg.norm(jacobian, axis=1)
    spread = np.where(spread > 0, spread, 1.0)
    scaled = jacobian / spread[:, None]
    bread = np.linalg.pinv(scaled @ scaled.T, rcond=1e-14, hermitian=True)
    count = jacobian.shape[1]
    variance = 2.0 * float(attempt.found["cost"]) / max(count - jacobian.shape[0], 1)
    if all(is_white(series) for part in parts for series in part.values()):
        middle = variance * bread
    else:
        meat = np.zeros_like(bread)
        at = 0
        for part in parts:
            for series in part.values():
                scores = scaled[:, at : at + series.size] * series
                at += series.size
                lags = int(4 * series.size**LAG_POWER)
                meat += scores @ scores.T
                for lag in range(1, min(lags, series.size - 1)):
                    cross = scores[:, lag:] @ scores[:, :-lag].T
                    meat += (1.0 - lag / lags) * (cross + cross.T)
        middle = bread @ meat @ bread
    result: Floats = middle / np.outer(spread, spread)
    return result
