"""Answers of a model to a unit step and to a unit impulse, with what its covariance says of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ftlm.analysis.frequency_response import model_numbers, response_inputs, step_response, with_numbers
from ftlm.analysis.poles import settling_time
from ftlm.errors import FtlmError
from ftlm.model.model import Solved, check_solved
from ftlm.utils.validation import Floats

#: Instants of a picture.
INSTANTS = 401
#: The difference quotient steps this share of a standard deviation along each direction of the covariance: far above
#: what refinement leaves (1e-6), and so short that a number keeps its sign where it is known at all.
SHARE = 0.1
#: Directions whose variance is below this share of the largest, in units of each number's own, add nothing.
LEAST = 1e-12


@dataclass(frozen=True)
class Response:
    """What every output does after a unit step, or a unit impulse, of every input.

    Parameters
    ----------
    kind
        ``"step"`` or ``"impulse"``.
    outputs, inputs
        Names.
    time
        Instants [s], shape (N,). An impulse has the middle of each interval of the step: there the mean of its answer
        over the interval stands, which is finite where orders below 1 make the answer itself infinite at 0.
    values
        Shape (outputs, inputs, N).
    deviation
        Standard deviation of the values from the covariance of the model, to first order; None where there is none.
    """

    kind: str
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    time: Floats
    values: Floats
    deviation: Floats | None


def response(model: Solved, time: ArrayLike | None = None, *, kind: str = "step") -> Response:
    """Answer of a model to unit steps or impulses, from rest, its equations together.

    Parameters
    ----------
    model
        The model.
    time
        Regular instants from 0 [s], at least 3; by default until it has settled.
    kind
        ``"step"`` or ``"impulse"``.

    Raises
    ------
    DataError
        Instants that are not regular from 0.
    ModelError
        An input that saturates or has a dead zone.
    ConvergenceError
        A model so unstable that the response leaves the range of numbers.
    """
    check_solved(model)
    if time is None:
        # Friction has no poles, and no time of its own that a program could tell.
        span = 10.0 if model.structure.has_friction else settling_time(model)
        time = np.linspace(0.0, span, INSTANTS)
    instants = np.asarray(time, dtype=np.float64)
    centre = step_response(model, instants)
    deviation = _deviation(model, instants, impulse=kind == "impulse")
    if kind == "impulse":
        centre = np.diff(centre) / (instants[1] - instants[0])
        instants = (instants[1:] + instants[:-1]) / 2
    return Response(kind, model.outputs, response_inputs(model, coupled=True), instants, centre, deviation)


def _deviation(model: Solved, time: Floats, *, impulse: bool) -> Floats | None:
    """Root of the summed squares of what one standard deviation along each direction of the covariance changes."""
    covariance = None if model.estimate is None else model.estimate.covariance
    if covariance is None or model.structure.has_friction:
        return None
    matrix, numbers = np.asarray(covariance, dtype=np.float64), model_numbers(model)
    if matrix.shape != (numbers.size, numbers.size) or not np.all(np.isfinite(matrix)):
        return None
    size = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    used = np.flatnonzero(size > 0)
    if not used.size:
        return None
    scaled = matrix[np.ix_(used, used)] / np.outer(size[used], size[used])
    weights, directions = np.linalg.eigh(scaled)
    total: Floats = np.zeros(1)
    # Of the model alone, lest every step is refined with the covariance of another one.
    bare = replace(model, estimate=None)
    for weight, direction in zip(weights.tolist(), directions.T, strict=True):
        if weight <= LEAST * float(weights[-1]):
            continue
        shift = np.zeros(numbers.size)
        shift[used] = SHARE * np.sqrt(weight) * direction * size[used]
        try:
            above, below = (step_response(with_numbers(bare, numbers + side), time) for side in (shift, -shift))
        except FtlmError:
            # So vague that a tenth of a standard deviation is no model any more: there is no band to be drawn.
            return None
        change = (above - below) / (2 * SHARE)
        total = total + (np.diff(change) / (time[1] - time[0]) if impulse else change) ** 2
    return np.sqrt(total)
