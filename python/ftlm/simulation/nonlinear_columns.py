"""Rows of non-linear terms in a block-pulse record: expressions of measured signals and their derivatives."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ftlm.data.run import Run
from ftlm.errors import DataError, ModelError
from ftlm.kernels import toeplitz_apply
from ftlm.structure.expression import Channel, Expression
from ftlm.structure.structure import Structure
from ftlm.utils.parameters import parameter
from ftlm.utils.validation import Floats

#: Number of points and degree of the local polynomials that smooth a measured signal before it is differentiated. At a
#: signal-to-noise ratio of 40 dB, velocities from differences of raw samples give poor initial guesses of an
#: output-error fit (measured on a body with drag).
SMOOTHING_POINTS, SMOOTHING_DEGREE = 31, 3


def nonlinear_columns(structure: Structure) -> dict[str, Expression]:
    """Return the expressions of the non-linear terms by the names of their rows in a record.

    They have the sequence of the terms.
    """
    return {t.column: t.nonlinear for e in structure.equations for t in e.terms if t.nonlinear is not None}


def record_signals(structure: Structure) -> tuple[str, ...]:
    """Return the names of the rows of a record: the signals of a structure, then its non-linear terms."""
    return (*structure.signals, *nonlinear_columns(structure))


def has_derivative_channels(structure: Structure) -> bool:
    """Whether a non-linear term contains the derivative of a signal, which is not measured."""
    return any(order > 0 for item in nonlinear_columns(structure).values() for _, order in item.channels)


def append_columns(run: Run, structure: Structure, means: Floats, step: float, *, local_smoothing: bool) -> Floats:
    """Return block-pulse means of shape (signals, pulses) with a further row for each non-linear term.

    An expression is evaluated at the means of its signals, which is accurate to second order in the `step` [s]. Means
    are smoothed before differentiation if `local_smoothing` is True. A row is NaN where its expression is not finite.
    The whole row is NaN with a sensor filter, or if its expression contains the derivative of a zero-order-hold input;
    see :func:`check_columns`.
    """
    columns = nonlinear_columns(structure)
    if not columns:
        return means
    rows = dict(zip(structure.signals, means, strict=True))
    undefined = np.full(means.shape[1], np.nan)
    values: dict[Channel, Floats] = {}
    for signal, order in dict.fromkeys(c for item in columns.values() for c in item.channels):
        if structure.sensor_filter is not None or _lacks_derivative(run, signal, order):
            values[signal, order] = undefined
        else:
            values[signal, order] = (
                differentiate(rows[signal], order, step, local_smoothing=local_smoothing) if order else rows[signal]
            )
    row_values = [np.asarray(item.evaluate(values), dtype=np.float64) for item in columns.values()]
    return np.vstack([means, *(np.where(np.isfinite(row), row, np.nan) for row in row_values)])


def _lacks_derivative(run: Run, signal: str, order: float) -> bool:
    """Whether a derivative of a signal does not exist: a positive order of a zero-order-hold input, which has jumps."""
    return order > 0 and run.intersample.get(signal) == "zoh"


def check_columns(run: Run, structure: Structure, rows: Mapping[str, Floats], step: float) -> None:
    """Raise an error if the row of a non-linear term contains NaN, for estimators that need all values.

    Raises
    ------
    DataError
        If an expression is not finite; the message has the time and the values of its signals.
    ModelError
        If a term contains the derivative of a zero-order-hold input, or the structure has a sensor filter.
    """
    for name, item in nonlinear_columns(structure).items():
        undefined_indices = np.flatnonzero(np.isnan(rows[name]))
        if not undefined_indices.size:
            continue
        if structure.sensor_filter is not None:
            raise ModelError(
                f"{name} does not apply to filtered signals; use {parameter('method', 'output-error')}, "
                "or leave the filter out"
            )
        pair = next(((signal, order) for signal, order in item.channels if _lacks_derivative(run, signal, order)), None)
        if pair is not None:
            raise ModelError(
                f"{name} has the derivative of order {pair[1]:g} of {pair[0]}, but run {run.name!r} has a zero-order "
                f"hold for {pair[0]}, whose jumps have no derivative; give {parameter('intersample', 'foh')} if it is "
                "linear between samples"
            )
        index = int(undefined_indices[0])
        values_text = ", ".join(f"{s} = {rows[s][index]:.6g}" for s in dict.fromkeys(s for s, _ in item.channels))
        raise DataError(
            f"{name} of run {run.name!r} is not finite in {undefined_indices.size} pulses, first at "
            f"{(index + 0.5) * step:.6g} s, "
            f"where {values_text}; use another term, a part of the run, or {parameter('method', 'output-error')}"
        )


def differentiate(means: Floats, order: float, step: float, *, local_smoothing: bool) -> Floats:
    """Return the fractional derivative of a signal from its m block-pulse means, to second order in the `step` [s].

    The signal is assumed to be zero before its record. With the backward shift q, the Grünwald-Letnikov weights
    (1 - q)^order are multiplied by 1 + order/2 (1 - q), which removes their delay of order/2 steps. With
    `local_smoothing`, the means are smoothed first. The cost is O(m log m).
    """
    values = smooth_locally(means) if local_smoothing else means
    m = values.size
    weights = np.cumprod(np.concatenate([[1.0], (np.arange(m - 1) - order) / np.arange(1, m)]))
    kernel = (1.0 + order / 2) * weights - order / 2 * np.concatenate([[0.0], weights[:-1]])
    return np.asarray(toeplitz_apply(kernel / step**order, values), dtype=np.float64)


def smooth_locally(values: Floats) -> Floats:
    """Return values smoothed by local polynomials (Savitzky and Golay 1964).

    An array of fewer than 31 values is returned unchanged.
    """
    points, half = SMOOTHING_POINTS, SMOOTHING_POINTS // 2
    if values.size < points:
        return values
    at = np.arange(-half, half + 1) / half
    powers = np.vander(at, SMOOTHING_DEGREE + 1, increasing=True)
    projection = powers @ np.linalg.pinv(powers)
    interior = np.convolve(values, projection[half], mode="valid")
    # The first and the last polynomial also smooth the ends.
    edges = projection[:half] @ values[:points], projection[half + 1 :] @ values[-points:]
    return np.concatenate([edges[0], interior, edges[1]])
