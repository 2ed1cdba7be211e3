"""Step and impulse responses of a model, with their standard deviation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from ftlm.analysis.frequency_response import (
    covariance_of,
    parameter_vector,
    response_inputs,
    step_response,
    with_parameter_vector,
)
from ftlm.analysis.poles import settling_time, stability, steady_states
from ftlm.errors import FtlmError, ModelError
from ftlm.model.model import Model, check_model
from ftlm.utils.parameters import setting
from ftlm.utils.validation import Floats, as_floats

#: Number of time points if the user gives none.
DEFAULT_TIME_POINTS = 401
#: Step of the difference quotient along each eigenvector of the covariance, in standard deviations. The change of the
#: response is then far above the tolerance of the simulation (1e-6), and significant parameters keep their signs.
DEVIATION_STEP_RATIO = 0.1
#: Variance along an eigenvector of the correlation matrix, relative to the largest, below which it is neglected.
MIN_VARIANCE_RATIO = 1e-12


@dataclass(frozen=True)
class Response:
    """Responses of all outputs to a unit step, or a unit impulse, of each input.

    Parameters
    ----------
    kind
        ``"step"`` or ``"impulse"``.
    outputs, inputs
        Signal names.
    time
        Time points [s], shape (N,). For an impulse they are centers of sampling intervals, and the values are means
        over the intervals. The means are finite even if orders below 1 make the response infinite at 0.
    values
        Responses, shape (outputs, inputs, N), in SI units of output over input.
    deviation
        Standard deviation of the values from the covariance of the model, to first order; None if it is not available.
    final_values
        Limit of each step response for infinite time, by (output, input): value and standard error, None without a
        covariance. Empty for an impulse, and for a model that is not stable or has no transfer function.
    """

    kind: str
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    time: Floats
    values: Floats
    deviation: Floats | None
    final_values: Mapping[tuple[str, str], tuple[float, float | None]] = field(default_factory=dict)


def response(model: Model, time: ArrayLike | None = None, *, kind: str = "step") -> Response:
    """Return the response of a model to unit steps or impulses, from rest, with coupled equations.

    Parameters
    ----------
    model
        The model.
    time
        Uniform time points from 0 [s], at least 3; by default about six time constants of the slowest mode, or 10 s
        for a nonlinear model.
    kind
        ``"step"`` or ``"impulse"``.

    Returns
    -------
    Response
        Response with its standard deviation.

    Raises
    ------
    DataError
        If the time points are not uniform from 0.
    ModelError
        If an input has a saturation or dead zone, or `kind` is unknown.
    ConvergenceError
        If the response of an unstable model overflows.
    """
    check_model(model)
    if kind not in ("step", "impulse"):
        raise ModelError(f"{setting('kind')} {kind!r} is not known; use 'step' or 'impulse'")
    if time is None:
        # A non-linear model has no poles from which a settling time follows.
        duration = settling_time(model) if model.structure.is_linear else 10.0
        time = np.linspace(0.0, duration, DEFAULT_TIME_POINTS)
    times = as_floats("time", time)
    nominal = step_response(model, times)
    deviation = _deviation(model, times, impulse=kind == "impulse")
    if kind == "impulse":
        nominal = np.diff(nominal) / (times[1] - times[0])
        times = (times[1:] + times[:-1]) / 2
    final_values = _final_values(model) if kind == "step" else {}
    return Response(kind, model.outputs, response_inputs(model, coupled=True), times, nominal, deviation, final_values)


def _final_values(model: Model) -> dict[tuple[str, str], tuple[float, float | None]]:
    """Return the limits of the step responses of a stable linear model; empty for other models."""
    if not model.structure.is_linear or model.structure.has_friction or not stability(model).stable:
        return {}
    # A response that decays as a power of time has the limit 0.
    return {(s.output, s.input): (s.gain, s.error if s.gain else 0.0) for s in steady_states(model)}


def _deviation(model: Model, time: Floats, *, impulse: bool) -> Floats | None:
    """Return the standard deviation of a response to first order, shape (outputs, inputs, N).

    The response is simulated for small parameter changes along each eigenvector of the covariance. The result is None
    without a finite covariance, with friction, or if a changed model is not valid.
    """
    matrix, parameters = covariance_of(model), parameter_vector(model)
    if matrix is None or model.structure.has_friction:
        return None
    if matrix.shape != (parameters.size, parameters.size) or not np.all(np.isfinite(matrix)):
        return None
    deviations = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    rows = np.flatnonzero(deviations > 0)
    if not rows.size:
        return None
    scaled = matrix[np.ix_(rows, rows)] / np.outer(deviations[rows], deviations[rows])
    weights, directions = np.linalg.eigh(scaled)
    variance: Floats = np.zeros(1)
    # A model without an estimate is simulated without an uncertainty band.
    plain_model = replace(model, estimate=None)
    for weight, direction in zip(weights.tolist(), directions.T, strict=True):
        if weight <= MIN_VARIANCE_RATIO * float(weights[-1]):
            continue
        shift = np.zeros(parameters.size)
        shift[rows] = DEVIATION_STEP_RATIO * np.sqrt(weight) * direction * deviations[rows]
        try:
            upper, lower = (
                step_response(with_parameter_vector(plain_model, parameters + increment), time)
                for increment in (shift, -shift)
            )
        except FtlmError:
            # The model with parameters changed by a tenth of a standard deviation is not valid.
            return None
        change = (upper - lower) / (2 * DEVIATION_STEP_RATIO)
        variance = variance + (np.diff(change) / (time[1] - time[0]) if impulse else change) ** 2
    return np.sqrt(variance)
