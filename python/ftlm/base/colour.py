"""Colour taken out of residuals before they are compared with anything else."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.statistics import autocovariances

#: An autoregression has at most one coefficient for so many samples of the shortest run.
SAMPLES_A_COEFFICIENT = 10
#: A signal whose deviation is below this share of its size is constant but for rounding.
CONSTANT = 1e-12
#: Least points of a circle of frequencies: on it a colour of 0.99 a sample has died away.
LEAST_CIRCLE = 4096


def autoregression(series: Sequence[Floats], most: int) -> Floats:
    """Return the whitening filter 1, a₁, …, aₙ of series that share one colour.

    Yule-Walker's equations by Levinson and Durbin (doi:10.1093/biomet/47.3-4.233), covariances pooled over the runs and
    each about its own mean; the order is that of the least Bayesian information criterion.

    Parameters
    ----------
    series
        One array a run; NaN is not there.
    most
        Largest order.
    """
    return coloured(series, most)[0]


def coloured(series: Sequence[Floats], most: int) -> tuple[Floats, float]:
    """Return the whitening filter of series as :func:`autoregression` does, and the power that it leaves."""
    counts = [int(np.sum(~np.isnan(x))) for x in series]
    most = min(most, min(counts) // SAMPLES_A_COEFFICIENT)
    covariance, pairs = autocovariances(series, most)
    count = sum(counts)
    # A lag whose pairs are few counts for as little: all lags together remain those of one positive spectrum.
    whole = np.array([float(sum(max(x.size - k, 0) for x in series)) for k in range(most + 1)])
    share = np.where(whole > 0, whole, 1.0) / float(sum(x.size for x in series))
    covariance = covariance * np.where(pairs > 0, share, 0.0)
    best = current = np.ones(1)
    power = left = float(covariance[0])
    if not power > 0:
        return best, 0.0
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
            least, best, left = criterion, current, power
    return np.asarray(best, dtype=np.float64), left


def colour_covariances(through: Floats, power: float, count: int) -> Floats:
    """Return autocovariances at lags 0 to ``count`` - 1 of noise that a filter makes white, of this power then."""
    # Its spectrum, on a circle so fine that what wraps round has died away.
    size = max(1 << (2 * count + 8 * through.size).bit_length(), LEAST_CIRCLE)
    spectrum = power / np.abs(np.fft.rfft(through, size)) ** 2
    return np.asarray(np.fft.irfft(spectrum, size)[:count])


def whitened(series: Sequence[Floats], through: Floats) -> list[Floats]:
    """Return series about their means through a whitening filter, without the samples in which it fills.

    What is not there is left out, and so is what the filter makes of it.
    """
    out = []
    for x in series:
        mean = np.mean(x[~np.isnan(x)])
        out.append(np.ascontiguousarray(np.nan_to_num(np.convolve(x - mean, through, "valid"))))
    return out


def is_constant(series: Sequence[Floats]) -> bool:
    """Whether no run of a signal moves by more than rounding."""
    return all(float(np.ptp(x)) <= CONSTANT * float(np.max(np.abs(x))) for x in series)
