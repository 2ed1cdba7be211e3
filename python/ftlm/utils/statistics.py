"""Noise, rest and whiteness of a series, and the quantiles that judge them."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import NormalDist

import numpy as np

from ftlm import _core
from ftlm.utils.validation import Floats

#: A first value beyond this many noise standard deviations is not rest.
REST_SIGMAS = 5.0
#: ... nor one beyond this share of the signal's deviation, where there is no noise.
REST_SHARE = 1e-3
#: Median absolute deviation of a normal variable in units of its standard deviation.
MAD = 0.6744897501960817
#: Residuals below this share of an output's deviation are rounding and discretisation, of which nothing follows.
ROUNDING = 3e-5
#: Residuals beyond so many deviations count by their size: 95 % of the precision of squares under normal noise.
BEND = 1.345
#: Share of true models that a test is allowed to refuse.
LEVEL = 0.01
#: Half-widths of a 95 % and of a 99 % interval in standard deviations.
NORMAL_95 = 1.959963984540054
NORMAL_99 = NormalDist().inv_cdf(1 - LEVEL / 2)


def is_rest(samples: Floats) -> bool:
    """Whether a signal starts at zero within its noise.

    Only the first sample is judged: a machine at rest may answer within a few samples.
    """
    there = samples[~np.isnan(samples)]
    noise = noise_of(samples)
    return bool(abs(there[0]) <= REST_SIGMAS * noise + REST_SHARE * float(np.std(there)))


def noise_of(samples: Floats) -> float:
    """Estimate the deviation of white noise on a smooth signal, from the median of its second differences."""
    bends = np.diff(samples, 2)
    bends = bends[~np.isnan(bends)]
    if bends.size == 0:
        # No three neighbours were read: those that were stand closest.
        bends = np.diff(samples[~np.isnan(samples)], 2)
    return robust_deviation(bends) / float(np.sqrt(6.0))


def robust_deviation(values: Floats) -> float:
    """Deviation of normal values from the median of their sizes, which a few that are far off do not move."""
    return float(np.median(np.abs(values))) / MAD if values.size else 0.0


def huber_excess(few: Floats, many: Floats) -> float:
    """By how much Huber's loss of residuals exceeds that of residuals of a larger model, in units of their noise.

    Where the smaller model is enough this is distributed as chi-squared, with as many degrees as the larger one has
    numbers more, however far a few residuals lie (doi:10.1214/aoms/1177703732).
    """
    scale = robust_deviation(many) or float(np.sqrt(np.mean(many**2)))
    if not np.all(np.isfinite(few)) or (scale == 0.0 and np.any(few)):
        return float("inf")
    one, other = (np.abs(e) / (scale or 1.0) for e in (few, many))
    losses = [np.where(r <= BEND, r**2, BEND * (2.0 * r - BEND)) for r in (one, other)]
    # Both means are those of the loss's slope and curvature; under normal noise their ratio is 0.86.
    slope, curvature = np.mean(np.minimum(other, BEND) ** 2), np.mean(other <= BEND)
    return float(np.sum(losses[0] - losses[1]) * curvature / slope) if slope > 0 else 0.0


def autocovariances(series: Sequence[Floats], most: int) -> tuple[Floats, Floats]:
    """Autocovariances of series at lags from 0, and how many pairs each is the mean of; NaN is not there.

    Each series is taken about its own mean; they are pooled.
    """
    return _core.autocovariances(series, most)


def autocorrelations(series: Sequence[Floats], most: int) -> tuple[Floats, Floats]:
    """Autocorrelations of series at lags from 0, sums over all of the power, and their pairs; NaN is not there."""
    covariances, pairs = autocovariances(series, most)
    power = covariances[0] * pairs[0]
    return covariances * pairs / (power if power > 0 else 1.0), pairs


def ljung_box(correlations: Floats, pairs: Floats) -> float:
    """Ljung and Box's sum over autocorrelations at lags from 0, which stand for so many pairs each.

    Where some values are not there, each correlation has the variance of its own pairs.
    """
    return float((pairs[0] + 2.0) * pairs[0] * np.sum(correlations[1:] ** 2 / np.maximum(pairs[1:], 1.0)))


def chi_squared(degrees: int, level: float) -> float:
    """Value that chi-squared exceeds with the probability ``level``, by Wilson and Hilferty.

    Good to 0.3 % from five degrees of freedom, to 1 % from one.
    """
    return _core.chi_squared(degrees, NormalDist().inv_cdf(1 - level))


def chi_squared_99(degrees: int) -> float:
    """99 % quantile of chi-squared; see :func:`chi_squared`."""
    return chi_squared(degrees, LEVEL)


def colour(series: Floats) -> float:
    """How much more a sum of the series scatters than one of white noise of its variance: 1 or above (Bartlett)."""
    lags = min(int(4 * series.size ** (1.0 / 3.0)), series.size - 1)
    if lags < 2:
        return 1.0
    correlations = autocorrelations([series], lags - 1)[0][1:]
    return max(1.0, 1.0 + 2.0 * float(np.sum((1.0 - np.arange(1, lags) / lags) * correlations)))


def is_white(series: Floats, lags: int = 25) -> bool:
    """Ljung-Box test at 1 %: whether autocorrelations up to ``lags`` could be those of white noise."""
    return _core.is_white(series, lags)


#: A signal whose deviation is below this share of its size is constant but for rounding.
CONSTANT = 1e-12


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
    return _core.coloured(series, most)


def colour_covariances(through: Floats, power: float, count: int) -> Floats:
    """Return autocovariances at lags 0 to ``count`` - 1 of noise that a filter makes white, of this power then."""
    return _core.colour_covariances(through, power, count)


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
