"""Statistics of residuals and signals: noise level, rest, whiteness, quantiles and prewhitening."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist

import numpy as np

from ftlm import _core
from ftlm.utils.validation import Floats

#: Number of noise standard deviations within which the first value of a signal at rest must lie.
REST_SIGMAS = 5.0
#: Additional tolerance of the first value, as a fraction of the standard deviation of the signal, for signals without
#: noise.
REST_FRACTION = 1e-3
#: Median absolute deviation of a normal variable in standard deviations.
MAD_OVER_SIGMA = 0.6744897501960817
#: Residuals below this fraction of the standard deviation of an output are rounding and discretization errors.
ROUNDING_RESIDUAL_RATIO = 3e-5
#: Huber threshold in standard deviations: 95 % efficiency under normal noise.
HUBER_THRESHOLD = 1.345
#: Significance level of tests.
SIGNIFICANCE_LEVEL = 0.01
#: Half-widths of 95 % and 99 % intervals in standard deviations.
NORMAL_95 = 1.959963984540054
NORMAL_99 = NormalDist().inv_cdf(1 - SIGNIFICANCE_LEVEL / 2)


def is_rest(samples: Floats) -> bool:
    """Whether the first sample of a signal is zero within the noise.

    Later samples are not tested, because a machine that starts at rest may respond within a few samples.
    """
    finite = samples[~np.isnan(samples)]
    noise = white_noise(samples)
    return bool(abs(finite[0]) <= REST_SIGMAS * noise + REST_FRACTION * float(np.std(finite)))


def estimate_noise(samples: Floats) -> float:
    """Return the standard deviation of white noise on a smooth signal, from the median of second differences."""
    differences = np.diff(samples, 2)
    differences = differences[~np.isnan(differences)]
    if differences.size == 0:
        # No three adjacent samples are present, so missing samples are dropped.
        differences = np.diff(samples[~np.isnan(samples)], 2)
    return robust_deviation(differences) / float(np.sqrt(6.0))


#: Machine precisions at which samples may have been rounded: single precision, tested first because its own grid is not
#: a quantization, and double precision.
SAMPLE_PRECISIONS = (float(np.finfo(np.float32).eps), float(np.finfo(np.float64).eps))
#: Maximum number of quantization steps in the range of a signal: that of a converter of 24 bits.
MAX_QUANTIZATION_STEPS = 2**24
#: Rounding error of a sample in units of the precision of the largest one, and minimum quantization step in units of
#: that error. Below this step, any samples are multiples of it within rounding.
ROUNDING_UNITS, MIN_QUANTUM_ERRORS = 4.0, 50.0


def quantization_step(samples: Floats) -> float:
    """Return the largest step of which all differences between finite samples are multiples; 0 if there is none.

    The step is the greatest common divisor of the differences, by Euclid's algorithm with a tolerance for rounding. A
    step near the rounding error, or far below the range, is no quantization.
    """
    values = np.unique(samples)
    for precision in SAMPLE_PRECISIONS:
        error = ROUNDING_UNITS * precision * float(np.abs(values).max(initial=0.0))
        differences = np.diff(values)
        levels = values[np.concatenate([[True], differences > error])]
        if levels.size < 2:
            continue
        differences = np.unique(np.diff(levels))
        step = float(differences[0])
        min_step = max(MIN_QUANTUM_ERRORS * error, float(levels[-1] - levels[0]) / MAX_QUANTIZATION_STEPS)
        while step > min_step:
            counts = np.rint(differences / step)
            remainders = np.abs(differences - counts * step)
            remainders = remainders[remainders > error * (2.0 + counts)]
            if not remainders.size:
                indices = np.rint((levels - levels[0]) / step)
                step = float(indices @ (levels - levels[0])) / float(indices @ indices)
                deviation = np.abs(levels - levels[0] - indices * step)
                if deviation.max() <= 2.0 * error:
                    return step
                break
            step = float(remainders.min())
    return 0.0


#: Orders of the differences from which the noise is estimated, and minimum number of differences of an order.
DIFFERENCE_ORDERS, MIN_DIFFERENCES = range(2, 9), 8
#: Maximum number of first samples from which the noise is estimated; more samples would only increase the time.
NOISE_SAMPLES = 4096


def white_noise(samples: Floats) -> float:
    """Return the standard deviation of white noise on a signal that may oscillate.

    The result is the smallest of the estimates from differences of several orders. White noise contributes to the
    differences of every order. An oscillation with few samples per period also contributes to second differences, but
    less to differences of higher orders (Hall, Kay, Titterington 1990, doi:10.1093/biomet/77.3.521).
    """
    segment = samples[:NOISE_SAMPLES]
    noise = estimate_noise(segment)
    for order in DIFFERENCE_ORDERS:
        differences = np.diff(segment, order)
        differences = differences[~np.isnan(differences)]
        if differences.size < MIN_DIFFERENCES:
            break
        noise = min(noise, robust_deviation(differences) / math.sqrt(math.comb(2 * order, order)))
    return noise


def robust_deviation(values: Floats) -> float:
    """Return a robust estimate of the standard deviation of zero-mean normal values, from their median magnitude."""
    return float(np.median(np.abs(values))) / MAD_OVER_SIGMA if values.size else 0.0


def huber_excess(nested: Floats, full: Floats) -> float:
    """Return the Huber loss of a smaller model minus that of a larger model, in units of the noise variance.

    `nested` and `full` are the residuals of the two models. If the smaller model is sufficient, the difference is
    chi-squared distributed, even with outliers. The number of degrees of freedom is the number of additional parameters
    of the larger model (doi:10.1214/aoms/1177703732). The result is infinite if `nested` has values that are not
    finite.
    """
    scale = robust_deviation(full) or float(np.sqrt(np.mean(full**2)))
    if not np.all(np.isfinite(nested)) or (scale == 0.0 and np.any(nested)):
        return float("inf")
    nested, full = (np.abs(e) / (scale or 1.0) for e in (nested, full))
    losses = [
        np.where(r <= HUBER_THRESHOLD, r**2, HUBER_THRESHOLD * (2.0 * r - HUBER_THRESHOLD)) for r in (nested, full)
    ]
    # Mean squared slope and mean curvature of the loss of the larger model; their ratio is 0.86 for normal noise.
    slope, curvature = np.mean(np.minimum(full, HUBER_THRESHOLD) ** 2), np.mean(full <= HUBER_THRESHOLD)
    return float(np.sum(losses[0] - losses[1]) * curvature / slope) if slope > 0 else 0.0


def autocovariances(series: Sequence[Floats], max_lag: int) -> tuple[Floats, Floats]:
    """Return autocovariances at lags 0 to `max_lag`, pooled over series, and the number of sample pairs at each lag.

    The mean of each series is subtracted. NaN marks missing samples.
    """
    return _core.autocovariances(series, max_lag)


def autocorrelations(series: Sequence[Floats], max_lag: int) -> tuple[Floats, Floats]:
    """Return autocorrelations at lags 0 to `max_lag`, pooled over series, and the number of sample pairs at each lag.

    NaN marks missing samples.
    """
    covariances, pairs = autocovariances(series, max_lag)
    power = covariances[0] * pairs[0]
    return covariances * pairs / (power if power > 0 else 1.0), pairs


def portmanteau(series: Sequence[Floats], max_lag: int) -> float:
    """Return a whiteness statistic over lags 1 to `max_lag`, pooled over series.

    For white noise, the statistic is chi-squared distributed with `max_lag` degrees of freedom. The squared
    autocovariance at each lag is divided by the variance of the products at this lag, so the variance of the noise may
    change within a series (Lobato, Nankervis and Savin, doi:10.1111/1468-2354.00106). The Box-Pierce statistic would be
    too large for a machine that is at rest during a part of the run.
    """
    return _core.portmanteau(series, max_lag)


def chi_squared(degrees: int, level: float) -> float:
    """Return the value that a chi-squared variable exceeds with probability ``level`` (Wilson-Hilferty approximation).

    The relative error is 0.3 % for at least five degrees of freedom, and 1 % for fewer.
    """
    return _core.chi_squared(degrees, NormalDist().inv_cdf(1 - level))


def chi_squared_99(degrees: int) -> float:
    """Return the 99 % quantile of the chi-squared distribution; see :func:`chi_squared`."""
    return chi_squared(degrees, SIGNIFICANCE_LEVEL)


def variance_inflation(series: Floats) -> float:
    """Return the ratio of the variance of a sum of samples to that for white noise, at least 1 (Bartlett).

    The white noise has the same variance per sample.
    """
    return _core.variance_inflation(series)


def is_white(series: Floats, lags: int = 25) -> bool:
    """Whether the :func:`portmanteau` test over `lags` lags does not reject white noise at the 1 % level."""
    return _core.is_white(series, lags)


#: Range of a signal, relative to its largest magnitude, up to which it counts as constant.
CONSTANT_TOLERANCE = 1e-12


def autoregression(series: Sequence[Floats], max_order: int) -> Floats:
    """Return the coefficients 1, a₁, …, aₙ of a whitening filter that is common to several series.

    The Levinson-Durbin recursion solves the Yule-Walker equations (doi:10.1093/biomet/47.3-4.233) with autocovariances
    that are pooled over the series, whose means are subtracted. The order minimizes the Bayesian information criterion.

    Parameters
    ----------
    series
        One array per run; NaN marks a missing sample.
    max_order
        Maximum order.
    """
    return _core.whitening_filter(series, max_order)[0]


def whiten_series(series: Sequence[Floats], coefficients: Floats) -> list[Floats]:
    """Return the series minus their means, filtered by the whitening filter with the coefficients `coefficients`.

    The initial transient of the filter is omitted. Filtered samples that depend on a missing sample (NaN) are zero.
    """
    out = []
    for x in series:
        mean = np.mean(x[~np.isnan(x)])
        out.append(np.ascontiguousarray(np.nan_to_num(np.convolve(x - mean, coefficients, "valid"))))
    return out


def is_constant(series: Sequence[Floats]) -> bool:
    """Whether every series is constant up to rounding errors."""
    return all(float(np.ptp(x)) <= CONSTANT_TOLERANCE * float(np.max(np.abs(x))) for x in series)
