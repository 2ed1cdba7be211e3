"""Noise, rest and whiteness of a series, and the quantiles that judge them."""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np

from ftlm.base.arrays import Floats

#: A first value beyond this many noise standard deviations is not rest.
REST_SIGMAS = 5.0
#: ... nor one beyond this share of the signal's deviation, where there is no noise.
REST_SHARE = 1e-3
#: Median absolute deviation of a normal variable in units of its standard deviation.
MAD = 0.6744897501960817
#: Share of true models that a test is allowed to refuse.
LEVEL = 0.01
#: Half-widths of a 95 % and of a 99 % interval in standard deviations.
NORMAL_95 = 1.959963984540054
NORMAL_99 = NormalDist().inv_cdf(1 - LEVEL / 2)


def is_rest(samples: Floats) -> bool:
    """Whether a signal starts at zero within its noise.

    Only the first sample is judged: a machine at rest may answer within a few samples.
    """
    noise = noise_of(samples)
    return bool(abs(samples[0]) <= REST_SIGMAS * noise + REST_SHARE * float(np.std(samples)))


def noise_of(samples: Floats) -> float:
    """Estimate the deviation of white noise on a smooth signal, from the median of its second differences."""
    return float(np.median(np.abs(np.diff(samples, 2)))) / MAD / float(np.sqrt(6.0)) if samples.size > 2 else 0.0


def ljung_box(correlations: Floats, count: int) -> float:
    """Ljung and Box's sum over autocorrelations at lags from 1 of a series of ``count`` samples."""
    return count * (count + 2) * float(np.sum(correlations**2 / (count - np.arange(1, correlations.size + 1))))


def chi_squared(degrees: int, level: float) -> float:
    """Value that chi-squared exceeds with the probability ``level``, by Wilson and Hilferty.

    Good to 0.3 % from five degrees of freedom, to 1 % from one.
    """
    z = NormalDist().inv_cdf(1 - level)
    return degrees * (1 - 2 / (9 * degrees) + z * math.sqrt(2 / (9 * degrees))) ** 3


def chi_squared_99(degrees: int) -> float:
    """99 % quantile of chi-squared; see :func:`chi_squared`."""
    return chi_squared(degrees, LEVEL)


def colour(series: Floats) -> float:
    """How much more a sum of the series scatters than one of white noise of its variance: 1 or above (Bartlett)."""
    e = series - np.mean(series)
    power = float(e @ e)
    lags = min(int(4 * e.size ** (1.0 / 3.0)), e.size - 1)
    if power == 0.0 or lags < 2:
        return 1.0
    return max(1.0, 1.0 + 2.0 * sum((1.0 - k / lags) * float(e[k:] @ e[:-k]) / power for k in range(1, lags)))


def is_white(series: Floats, lags: int = 25) -> bool:
    """Ljung-Box test at 1 %: whether autocorrelations up to ``lags`` could be those of white noise."""
    e = series - np.mean(series)
    power = float(e @ e)
    if power == 0.0 or e.size <= lags + 1:
        return True
    correlations = np.array([float(e[k:] @ e[:-k]) / power for k in range(1, lags + 1)])
    return ljung_box(correlations, e.size) <= chi_squared_99(lags)
