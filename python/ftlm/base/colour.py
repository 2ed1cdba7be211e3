"""Colour taken out of residuals before they are compared with anything else."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ftlm import _core
from ftlm.base.arrays import Floats

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
