"""The covariance that a joint fit's residuals leave."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ftlm import _core
from ftlm.base.arrays import Floats
from ftlm.fit.grid import Attempt, Grid


def covariance(attempt: Attempt, grid: Grid) -> Floats:
    """Covariance of the parameters: classical where residuals are white, robust to their colour where not.

    Nothing is truncated: a parameter that takes part in a direction which the runs do not see has an infinite variance.
    Under a robust loss it is that of an M-estimator.
    """
    series = [residuals for part in grid.residuals(attempt) for residuals in part.values()]
    shares = None if grid.shares is None else grid.every_share
    return _core.fit_covariance(np.asarray(attempt.outcome["jacobian"]), series, shares)


def covariance_of(jacobian: Floats, series: Sequence[Floats], squares: float) -> Floats:
    """Covariance from a Jacobian (a row a parameter), residuals by run and output, and the sum of their squares.

    Residuals are NaN where nothing was read. Covariances with a parameter of infinite variance are not numbers.
    """
    return _core.covariance_of(jacobian, series, squares)


def long_run(jacobian: Floats, series: Sequence[Floats]) -> Floats:
    """Covariance of sums of scores with Bartlett weights: the middle of the sandwich (doi:10.2307/1913610)."""
    return _core.long_run(jacobian, series)


def deviation(slopes: Floats, spread: Floats) -> Floats:
    """Standard errors, to first order, of numbers whose slopes are the rows, infinite where a parameter's is."""
    unseen = np.isinf(np.diag(spread))
    known = slopes[:, ~unseen]
    variance = np.einsum("ij,jk,ik->i", known, spread[np.ix_(~unseen, ~unseen)], known)
    return np.where((slopes[:, unseen] != 0).any(axis=1), np.inf, np.sqrt(np.maximum(variance, 0.0)))
