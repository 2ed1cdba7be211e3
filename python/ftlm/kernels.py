"""Operators of the core on arrays: pulse means, fractional integrals, Toeplitz systems, Haar transform, estimator (44).

Time is the last axis, and leading axes broadcast as in NumPy's universal functions. Arrays are real numbers of any type
and strides. They are never changed, and results are new float64 arrays. Other threads run meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftlm import _core
from ftlm.errors import DataError, ModelError
from ftlm.fractional_calculus import haar_inverse
from ftlm.fractional_calculus import haar_transform as haar
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import setting
from ftlm.utils.validation import as_floats, check_pulses, real_number, short_repr, whole_number

__all__ = [
    "block_pulse_kernel",
    "errors",
    "haar",
    "haar_inverse",
    "integrate",
    "multi_innovation",
    "pulse_means",
    "toeplitz_apply",
    "toeplitz_solve",
]


@check_arguments
def pulse_means(samples: ArrayLike, m: int | None = None, *, hold: bool = False) -> NDArray[np.float64]:
    """Return the means of sampled signals over m equal pulses (paper (39)).

    Parameters
    ----------
    samples
        Shape (..., n), n samples at the ends of n - 1 sampling intervals.
    m
        Number of pulses; by default n - 1.
    hold
        Whether a signal holds each sample until the next one, as commands do. Otherwise it is linear in between.

    Returns
    -------
    numpy.ndarray
        Shape (..., m).

    Raises
    ------
    DataError
        Fewer than two samples, or values that are not finite real numbers (with the first index and the count).
    ModelError
        An m that is no positive whole number.

    Notes
    -----
    O(n + m) a signal.
    """
    rows, lead = _rows("samples", samples)
    pulses = rows.shape[1] - 1 if m is None else check_pulses(m)
    return _core.pulse_mean_rows(rows, pulses, hold).reshape(*lead, pulses)


@check_arguments
def block_pulse_kernel(order: ArrayLike, m: int, *, step: float, derivative: bool = False) -> NDArray[np.float64]:
    """Return the first row of the fractional integration matrix of block pulses (paper (31), (32)).

    Parameters
    ----------
    order
        Orders in [0, 10], of any shape.
    m
        Number of pulses.
    step
        Pulse width [s].
    derivative
        Whether to return the derivative of the row with respect to the order.

    Returns
    -------
    numpy.ndarray
        Shape of ``order`` and (m,).

    Raises
    ------
    ModelError
        An order outside [0, 10], a step that is not positive, or an m that is no positive whole number.

    Notes
    -----
    O(m) an order.
    """
    orders, pulses = _finite("order", order), check_pulses(m)
    kernels = _core.block_pulse_kernels(orders.ravel(), pulses, real_number("step", step), derivative=derivative)
    return kernels.reshape(*orders.shape, pulses)


@check_arguments
def integrate(x: ArrayLike, order: ArrayLike, *, step: float) -> NDArray[np.float64]:
    """Return the means of the fractional integrals of signals from their means over pulses (paper (32)).

    Parameters
    ----------
    x
        Pulse means, shape (..., m).
    order
        Orders in [0, 10]; their shape broadcasts with the leading axes of ``x``. ``integrate(x[:, None], orders,
        step=h)`` has every integral of every signal.
    step
        Pulse width [s].

    Returns
    -------
    numpy.ndarray
        Shape of the broadcast leading axes and (m,).

    Raises
    ------
    DataError
        Values that are not finite real numbers (with the first index and the count), or shapes that do not broadcast.
    ModelError
        An order outside [0, 10], or a step that is not positive.

    Notes
    -----
    O(m log m) an integral. Signals of one order share their kernel and its spectrum.
    """
    values, orders = _finite("x", x), _finite("order", order)
    m = _length("x", values)
    lead = _broadcast({"x": values.shape[:-1], "order": orders.shape})
    distinct, groups = np.unique(np.broadcast_to(orders, lead), return_inverse=True)
    kernels = _core.block_pulse_kernels(distinct, m, real_number("step", step))
    rows = np.broadcast_to(values, (*lead, m)).reshape(-1, m)
    return _core.toeplitz_apply(kernels, rows, groups.ravel().tolist()).reshape(*lead, m)


@check_arguments
def toeplitz_apply(kernel: ArrayLike, x: ArrayLike) -> NDArray[np.float64]:
    """Return the products of lower triangular Toeplitz matrices with vectors: causal convolutions of equal length.

    Parameters
    ----------
    kernel
        First columns of the matrices, shape (..., m).
    x
        Vectors, shape (..., m).

    Returns
    -------
    numpy.ndarray
        Shape of the broadcast leading axes and (m,).

    Raises
    ------
    DataError
        Values that are not finite real numbers (with the first index and the count), or shapes that do not broadcast.

    Notes
    -----
    O(m log m) a vector, as ``scipy.linalg.matmul_toeplitz``. Vectors of one kernel share its spectrum.
    """
    return _with_kernels(_core.toeplitz_apply, kernel, "x", x)


@check_arguments
def toeplitz_solve(kernel: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    """Return the solutions of lower triangular Toeplitz systems: the inverse of :func:`toeplitz_apply`.

    Parameters
    ----------
    kernel
        First columns of the matrices, shape (..., m).
    b
        Right-hand sides, shape (..., m).

    Returns
    -------
    numpy.ndarray
        Shape of the broadcast leading axes and (m,).

    Raises
    ------
    DataError
        Values that are not finite real numbers (with the first index and the count), or shapes that do not broadcast.
    ModelError
        A kernel that begins with zero, whose matrix is singular.

    Notes
    -----
    O(m log^2 m) a system; ``scipy.linalg.solve_toeplitz`` takes O(m^2).
    """
    columns, _ = _rows("kernel", kernel)
    zero = np.flatnonzero(columns[:, 0] == 0.0)
    if zero.size:
        raise ModelError(
            f"kernel {zero[0]} of {len(columns)} begins with 0 ({len(zero)} such kernels in all), so its matrix is "
            "singular; leave it out"
        )
    return _with_kernels(_core.toeplitz_solve, kernel, "b", b)


@check_arguments
def multi_innovation(
    Q: ArrayLike,
    m: ArrayLike,
    p: int = 7,
    *,
    prior_covariance: ArrayLike,
    trace: bool = False,
) -> NDArray[np.float64]:
    """Return the multi-innovation least-squares estimate of X in m = Q X (paper (42)-(44)), from X = 0.

    Parameters
    ----------
    Q
        Regressors, shape (..., M, k), rows in the sequence of the recursion.
    m
        Outputs, shape (..., M).
    p
        Innovation length: number of rows of a step.
    prior_covariance
        Initial covariance of the coefficients, a number or shape (k,), in units of their squares.
    trace
        Whether to return the coefficients after every row.

    Returns
    -------
    numpy.ndarray
        Shape (..., k), or (..., M, k) with ``trace``.

    Raises
    ------
    DataError
        Values that are not finite real numbers (with the first index and the count), or shapes that do not match.
    ModelError
        An innovation length below 1, or a prior covariance that is not positive.
    ConvergenceError
        Columns that are linearly dependent within rounding.

    Notes
    -----
    Without ``trace`` the estimate is computed in closed form by QR, O(M k^2): row i of M has the weight
    min(p, M - i + 1).
    """
    regressors, outputs = _finite("Q", Q), _finite("m", m)
    if regressors.ndim < 2 or outputs.ndim < 1 or regressors.shape[-2] != outputs.shape[-1] or not outputs.shape[-1]:
        raise DataError(
            f"Q has shape {regressors.shape}, m {outputs.shape}; give (..., M, k) and (..., M) with M of at least 1"
        )
    length = whole_number(p)
    if length is None or length < 1:
        raise ModelError(f"{setting('p')} {short_repr(p)} is no whole number from 1")
    count, width = regressors.shape[-2:]
    prior = as_floats("prior_covariance", prior_covariance)
    if prior.ndim > 1 or (prior.ndim and prior.size != width):
        raise DataError(f"prior_covariance has shape {prior.shape}; give a number, or one for each of {width} columns")
    lead = _broadcast({"Q": regressors.shape[:-2], "m": outputs.shape[:-1]})
    found = _core.multi_innovation_estimate(
        np.broadcast_to(regressors, (*lead, count, width)).reshape(-1, width),
        np.broadcast_to(outputs, (*lead, count)).ravel(),
        count,
        min(length, count),
        np.broadcast_to(prior, width).tolist(),
        trace,
    )
    return found.reshape(*lead, count, width) if trace else found.reshape(*lead, width)


@check_arguments
def errors(measured: ArrayLike, predicted: ArrayLike) -> NDArray[np.float64]:
    """Return the error (45), RMSE (46), NR (47) and fit of predictions, as :func:`ftlm.metrics` does of one.

    Parameters
    ----------
    measured, predicted
        Shapes (..., M) in the same unit.

    Returns
    -------
    numpy.ndarray
        Shape (..., 4): sum of absolute errors, root mean square error, that divided by the standard deviation of the
        measurement, and 100 (1 - NR) percent.

    Raises
    ------
    DataError
        Measured values that are not finite real numbers, or shapes that do not broadcast.
    """
    y, prediction = _finite("measured", measured), as_floats("predicted", predicted, gaps=True)
    m = _length("measured", y)
    if _length("predicted", prediction) != m:
        raise DataError(f"measured has shape {y.shape}, predicted {prediction.shape}; give arrays of one length")
    lead = _broadcast({"measured": y.shape[:-1], "predicted": prediction.shape[:-1]})
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        left = np.abs(np.broadcast_to(y - prediction, (*lead, m)))
        rmse = np.sqrt(np.mean(left**2, axis=-1))
        ratio = rmse / np.std(y, axis=-1)
        return np.stack([np.sum(left, axis=-1), rmse, ratio, 100.0 * (1.0 - ratio)], axis=-1)


def _finite(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """Return an array of finite real numbers."""
    array = as_floats(name, values)
    if not np.all(np.isfinite(array)):
        bad = np.argwhere(~np.isfinite(array))
        raise DataError(
            f"{name} is not finite at index {bad[0].tolist()} ({len(bad)} such values in all); remove or replace them"
        )
    return array


def _rows(name: str, values: ArrayLike) -> tuple[NDArray[np.float64], tuple[int, ...]]:
    """Return signals as rows of a table, and the shape of their leading axes."""
    array = _finite(name, values)
    return array.reshape(-1, _length(name, array)), array.shape[:-1]


def _length(name: str, array: NDArray[np.float64]) -> int:
    """Return the length of the axis of time."""
    if array.ndim == 0 or array.shape[-1] == 0:
        raise DataError(f"{name} has shape {array.shape} and no axis of time; give an array of shape (..., m)")
    return int(array.shape[-1])


def _broadcast(shapes: dict[str, tuple[int, ...]]) -> tuple[int, ...]:
    """Return the common shape of leading axes."""
    try:
        return np.broadcast_shapes(*shapes.values())
    except ValueError:
        words = " and ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise DataError(f"leading axes of {words} do not broadcast; give equal ones, or 1") from None


def _with_kernels(
    work: Callable[[NDArray[np.float64], NDArray[np.float64], list[int]], NDArray[np.float64]],
    kernel: ArrayLike,
    name: str,
    vectors: ArrayLike,
) -> NDArray[np.float64]:
    """Apply ``work(kernels, rows, number of the kernel of each row)`` to broadcast kernels and vectors."""
    columns, of = _rows("kernel", kernel)
    values = _finite(name, vectors)
    m = _length(name, values)
    if columns.shape[1] != m:
        raise DataError(f"kernel has {columns.shape[1]} terms and {name} {m}; give kernels of the vectors' length")
    lead = _broadcast({"kernel": of, name: values.shape[:-1]})
    groups = np.broadcast_to(np.arange(columns.shape[0]).reshape(of), lead).ravel().tolist()
    return work(columns, np.broadcast_to(values, (*lead, m)).reshape(-1, m), groups).reshape(*lead, m)
