"""Figures of an error: (45), RMSE, NR, fit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ftlm import _core
from ftlm.base.arrays import Floats, as_floats
from ftlm.base.errors import DataError


def finite(value: float) -> float | None:
    """For JSON, which has no infinity: None stands for a figure that is not finite."""
    return float(value) if math.isfinite(value) else None


@dataclass(frozen=True)
class Metrics:
    """The four figures of one output.

    Parameters
    ----------
    error
        Sum of absolute errors over the block pulses (paper (45)), in the unit of the output.
    rmse
        Root mean square error (paper (46)).
    nr
        Normalised residual RMSE / sigma(y) (paper (47)).
    fit
        100 (1 - ‖y - ŷ‖ / ‖y - mean‖) in percent.
    """

    error: float
    rmse: float
    nr: float
    fit: float

    def to_dict(self) -> dict[str, float | None]:
        """For JSON."""
        return {name: finite(getattr(self, name)) for name in ("error", "rmse", "nr", "fit")}


#: Figures that nothing is known of.
UNKNOWN = Metrics(math.nan, math.nan, math.nan, math.nan)


def metrics(measured: ArrayLike, predicted: ArrayLike) -> Metrics:
    """Error (45), RMSE (46), NR (47) and fit of a prediction.

    Parameters
    ----------
    measured, predicted
        Arrays of shape (M,) in the same unit.

    Returns
    -------
    Metrics
        Not finite where the prediction is not; NR and fit of a constant measurement mean nothing.

    Raises
    ------
    DataError
        Not one-dimensional, empty or of different lengths; measured values that are not finite real numbers.
    """
    y, prediction = as_floats("measured", measured), as_floats("predicted", predicted)
    if y.ndim != 1 or y.size == 0 or prediction.shape != y.shape:
        raise DataError(
            f"measured has shape {y.shape}, predicted {prediction.shape}; give two vectors of one length, at least 1"
        )
    return Metrics(*_core.metrics(y, y - prediction))


def pooled(measured: list[Floats], residuals: list[Floats]) -> Metrics:
    """Figures over several runs, of what was read; each run's mean is its own."""
    known = [~np.isnan(y) for y in measured]
    if not all(k.all() for k in known):
        measured = [y[k] for y, k in zip(measured, known, strict=True)]
        residuals = [e[k] for e, k in zip(residuals, known, strict=True)]
    if len(measured) == 1:
        return Metrics(*_core.metrics(measured[0], residuals[0]))
    return Metrics(*_core.metrics(np.concatenate([y - np.mean(y) for y in measured]), np.concatenate(residuals)))
