"""Colour taken out of residuals before they are compared with anything else."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ftlm.base.arrays import Floats

#: An autoregression has at most one coefficient for so many samples of the shortest run.
SAMPLES_A_COEFFICIENT = 10
#: A signal whose deviation is below this share of its size is constant but for rounding.
CONSTANT = 1e-12


def autoregression(series: Sequence[Floats], most: int) -> Floats:
    """Return the whitening filter 1, a₁, …, aₙ of series that share one colour.

    Yule-Walker's equations by Levinson and Durbin (doi:10.1093/biomet/47.3-4.233), covariances pooled over the runs and
    each about its own mean; the order is that of the least Bayesian information criterion.

    Parameters
    ----------
    series
        One array a run.
    most
        Largest order.
    """
    centred = [x - np.mean(x) for x in series]
    count = sum(x.size for x in series)
    most = min(most, min(x.size for x in series) // SAMPLES_A_COEFFICIENT)
    covariance = np.array([sum(float(x[k:] @ x[: x.size - k]) for x in centred) for k in range(most + 1)]) / count
    best = current = np.ones(1)
    power = covariance[0]
    if not power > 0:
        return best
    least = count * math.log(power)
    for order in range(1, most + 1):
        reflection = -float(current @ covariance[order:0:-1]) / power
        longer = np.append(current, 0.0)
        current = longer + reflection * longer[::-1]
        power *= 1.0 - reflection**2
        if not power > 0:
            break
        criterion = count * math.log(power) + order * math.log(count)
        if criterion < least:
            least, best = criterion, current
    return np.asarray(best, dtype=np.float64)


def whitened(series: Sequence[Floats], through: Floats) -> list[Floats]:
    """Return series about their means through a whitening filter, without the samples in which it fills."""
    return [np.ascontiguousarray(np.convolve(x - np.mean(x), through, "valid")) for x in series]


def is_constant(series: Sequence[Floats]) -> bool:
    """Whether no run of a signal moves by more than rounding."""
    return all(float(np.ptp(x)) <= CONSTANT * float(np.max(np.abs(x))) for x in series)
