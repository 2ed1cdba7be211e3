"""Bands of a simulated output that the uncertainty of the model's orders and coefficients gives it."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from ftlm.analysis.frequency_response import parameter_vector, with_parameter_vector
from ftlm.data.run import Run
from ftlm.errors import FtlmError
from ftlm.model.model import Model
from ftlm.utils.statistics import NORMAL_95
from ftlm.utils.validation import Floats
from ftlm.validation.comparison import Comparison, compare

Band: TypeAlias = tuple[Floats, Floats]
#: Step of the numerical derivatives in standard errors: small beside the curvature, large beside the tolerance of runs.
DERIVATIVE_STEP_IN_ERRORS = 0.1


def prediction_bands(model: Model, run: Run, comparison: Comparison) -> dict[str, Band]:
    """Return the ends of the 95 % band of each simulated output on one run, by output.

    The band holds what the covariance of orders and coefficients makes of the simulation, to first order; delays,
    limits and noise of the measurement are not in it. It takes one simulation per parameter.

    Parameters
    ----------
    model
        Identified model.
    run
        Run that the model is compared with.
    comparison
        Comparison with this run alone.

    Returns
    -------
    dict
        Empty for a model without covariance, with friction, or whose simulation fails beside the estimate.
    """
    covariance = None if model.estimate is None else model.estimate.covariance
    if covariance is None or model.structure.has_friction:
        return {}
    spread = np.asarray(covariance, dtype=np.float64)
    errors, values = np.sqrt(np.diag(spread)), parameter_vector(model)
    if not np.all(np.isfinite(spread)):
        return {}
    used = np.flatnonzero(errors)
    derivatives: dict[str, list[Floats]] = {name: [] for name in comparison.simulated}
    for k in used:
        step = DERIVATIVE_STEP_IN_ERRORS * errors[k]
        moved = values.copy()
        moved[k] += step
        try:
            beside = compare(with_parameter_vector(model, moved), run)
        except FtlmError:
            return {}
        for name, centre in comparison.simulated.items():
            derivatives[name].append((beside.simulated[name][0] - centre[0]) / step)
    bands = {}
    for name, columns in derivatives.items():
        matrix, middle = np.array(columns), comparison.simulated[name][0]
        variance = np.einsum("kt,kl,lt->t", matrix, spread[np.ix_(used, used)], matrix)
        half = NORMAL_95 * np.sqrt(np.maximum(variance, 0.0))
        if np.all(np.isfinite(half)):
            bands[name] = (middle - half, middle + half)
    return bands
