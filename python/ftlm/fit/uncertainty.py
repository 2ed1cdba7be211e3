"""The covariance that a joint fit's residuals leave."""

from __future__ import annotations

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.colour import colour_covariances, coloured
from ftlm.base.statistics import BEND, is_white, robust_deviation
from ftlm.base.tall import singular
from ftlm.data.readings import read
from ftlm.fit.grid import Attempt, Grid

#: Lags of the residuals' autocovariance that the robust covariance takes in, as a power of the sample count.
LAG_POWER = 1.0 / 3.0
#: Least share of the noise that a fit is taken to leave in its residuals.
LEAST_LEFT = 0.2


def covariance(attempt: Attempt, grid: Grid) -> Floats:
    """Covariance of the parameters: classical where residuals are white, robust to their colour where not.

    Nothing is truncated: a parameter that takes part in a direction which the runs do not see has an infinite variance.
    Under a robust loss it is that of an M-estimator: residuals count as far as the loss lets them, over the share of
    them that moves with the parameters (Huber & Ronchetti, doi:10.1002/9780470434697, §7.6).
    """
    series = [residuals for part in grid.residuals(attempt) for residuals in part.values()]
    jacobian = np.asarray(attempt.outcome["jacobian"])
    if grid.shares is not None:
        shares = grid.every_share
        jacobian = jacobian / np.where(shares > 0, shares, 1.0)
        series = _bent(series, jacobian.shape[0])
    return covariance_of(jacobian, series, sum(float(np.nansum(e**2)) for e in series))


def _bent(series: list[Floats], parameters: int) -> list[Floats]:
    """Residuals as Huber's loss lets them count, so that squares of these have its covariance."""
    level = robust_deviation(read(np.concatenate(series))) or 1.0
    bent = [np.clip(e, -BEND * level, BEND * level) for e in series]
    known = [~np.isnan(e) for e in series]
    count = sum(int(k.sum()) for k in known)
    moving = sum(int(np.sum(np.abs(e[k]) < BEND * level)) for e, k in zip(series, known, strict=True)) / max(count, 1)
    moving = max(moving, 1.0 / max(count, 1))
    # Huber's correction for few samples.
    few = 1.0 + parameters / max(count, 1) * (1.0 - moving) / moving
    return [e * few / moving for e in bent]


def covariance_of(jacobian: Floats, series: list[Floats], squares: float) -> Floats:
    """Covariance from a Jacobian (a row a parameter), residuals by run and output, and the sum of their squares.

    Residuals are NaN where nothing was read.

    By the singular values of the Jacobian, rows scaled to one length: a product with itself would hide half of the
    digits. Singular values below rounding are zero, and the directions that belong to them unseen. Covariances with a
    parameter of infinite variance are not numbers.
    """
    parameters, count = jacobian.shape
    known = sum(read(e).size for e in series)
    spread = np.linalg.norm(jacobian, axis=1)
    scaled = jacobian / np.where(spread > 0, spread, 1.0)[:, None]
    if count < parameters:
        scaled = np.hstack([scaled, np.zeros((parameters, parameters - count))])
    left, sizes, right = singular(scaled.T)
    directions, rows = right.T, left.T
    rounding = np.finfo(np.float64).eps * np.sqrt(max(count, 1)) * float(sizes.max(initial=0.0))
    seen = sizes > rounding
    # How far rounding may turn a seen direction into an unseen one.
    turned = rounding / float(sizes[seen].min()) if seen.any() else 0.0
    unseen = np.linalg.norm(directions[:, ~seen], axis=1) > turned if not seen.all() else np.zeros(parameters, bool)
    # Least-squares answers to unit residuals: the factors of the bread, so that no product of it is ever formed.
    inverse = directions[:, seen] / sizes[seen]
    if all(map(is_white, series)):
        middle = squares / max(known - parameters, 1) * (inverse @ inverse.T)
    else:
        basis = rows[seen][:, :count]
        answers = inverse @ basis
        middle = _wider(_of_colour(answers, basis, series), long_run(answers, series))
    # Of what moves next to nothing a variance may be beyond the numbers.
    with np.errstate(over="ignore"):
        result: Floats = middle / np.outer(np.where(spread > 0, spread, 1.0), np.where(spread > 0, spread, 1.0))
    unseen |= ~np.isfinite(np.diag(result))
    result[unseen, :] = result[:, unseen] = np.nan
    result[unseen, unseen] = np.inf
    return result


def deviation(slopes: Floats, spread: Floats) -> Floats:
    """Standard errors, to first order, of numbers whose slopes are the rows, infinite where a parameter's is."""
    unseen = np.isinf(np.diag(spread))
    known = slopes[:, ~unseen]
    variance = np.einsum("ij,jk,ik->i", known, spread[np.ix_(~unseen, ~unseen)], known)
    return np.where((slopes[:, unseen] != 0).any(axis=1), np.inf, np.sqrt(np.maximum(variance, 0.0)))


def _of_colour(answers: Floats, basis: Floats, series: list[Floats]) -> Floats:
    """Covariance of least-squares answers to noise whose colour is that of an autoregression of the residuals.

    What the answers are to does not depend on the noise, so its autocovariances say all. An autoregression tells them
    from few numbers, where sums over lags lose the slow part of a colour such as 0.9 a sample. The fit has taken from
    the residuals what noise there is in the directions of its orthonormal basis: more than its share, where the colour
    is that of the regressors.
    """
    total: Floats = np.zeros((answers.shape[0], answers.shape[0]))
    at = 0
    for residuals in series:
        there = slice(at, at + residuals.size)
        at += residuals.size
        known = read(residuals).size
        if known == 0:
            continue
        through, power = coloured([residuals], int(4 * known**LAG_POWER))
        covariances = colour_covariances(through, power, residuals.size)
        if not covariances[0] > 0:
            continue
        taken = float(np.trace(_between(basis[:, there], covariances))) / float(covariances[0])
        total += _between(answers[:, there], covariances) / max(1.0 - taken / known, LEAST_LEFT)
    return total


def _between(rows: Floats, covariances: Floats) -> Floats:
    """Rows times the matrix of a series' autocovariances times rows again, on a circle that holds them."""
    count = rows.shape[1]
    size = 1 << (2 * count).bit_length()
    circle = np.concatenate([covariances, np.zeros(size - 2 * count + 1), covariances[:0:-1]])
    weighted = np.fft.irfft(np.fft.rfft(rows, size) * np.fft.rfft(circle), size)[:, :count]
    product = weighted @ rows.T
    return np.asarray(0.5 * (product + product.T))


def _wider(one: Floats, other: Floats) -> Floats:
    """A covariance, widened where another one knows a larger variance."""
    ratio = np.diag(other) / np.maximum(np.diag(one), np.finfo(np.float64).tiny)
    stretch = np.sqrt(np.maximum(ratio, 1.0))
    return np.asarray(one * np.outer(stretch, stretch))


def long_run(jacobian: Floats, series: list[Floats]) -> Floats:
    """Covariance of sums of scores with Bartlett weights: the middle of the sandwich (doi:10.2307/1913610)."""
    total: Floats = np.zeros((jacobian.shape[0], jacobian.shape[0]))
    at = 0
    for residuals in series:
        scores = jacobian[:, at : at + residuals.size] * np.nan_to_num(residuals)
        at += residuals.size
        lags = int(4 * residuals.size**LAG_POWER)
        total += scores @ scores.T
        for lag in range(1, min(lags, residuals.size - 1)):
            cross = scores[:, lag:] @ scores[:, :-lag].T
            total += (1.0 - lag / lags) * (cross + cross.T)
    return total
