"""Fractional integrals and derivatives of arrays, and Haar and block-pulse operational matrices."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftlm import _core
from ftlm.utils.arguments import check_arguments
from ftlm.utils.validation import apply_along_axis, as_floats, check_pulses, real_number


@check_arguments
def fractional_integral(
    x: ArrayLike,
    order: float,
    *,
    step: float,
    rule: Literal["block-pulse", "trapezoidal", "grunwald-letnikov"] = "block-pulse",
    axis: int = -1,
) -> NDArray[np.float64]:
    """Return the Riemann-Liouville fractional integral of uniformly sampled signals.

    The lower limit of the integral is the time of the first sample.

    Parameters
    ----------
    x
        Signals along ``axis``: means over block pulses for ``"block-pulse"``, point samples otherwise.
    order
        Order of the integral, in [0, 10].
    step
        Sampling interval or pulse width [s], positive.
    rule
        Quadrature rule.

        - ``"block-pulse"``: block-pulse means of the integral, by equations (31)-(32) of the paper. The error is of
          second order in the step.
        - ``"trapezoidal"``: point samples of the integral of the linear interpolant (doi:10.1023/A:1016592219341). The
          error is of second order.
        - ``"grunwald-letnikov"``: point samples, by equation (2) of the paper with a negative order. The error is of
          first order.
    axis
        Time axis of ``x``.

    Returns
    -------
    numpy.ndarray
        Array of the shape of ``x``.

    Raises
    ------
    DataError
        Values that are not finite real numbers (with the first index and the count).
    ModelError
        An order outside [0, 10], a step that is not positive, or an unknown rule.

    Notes
    -----
    The cost is O(n log n) for n samples.
    """
    eta, width = real_number("order", order), real_number("step", step)
    return apply_along_axis(x, axis, lambda rows: _core.fractional_integral(rows, eta, width, rule))


@check_arguments
def fractional_derivative(
    x: ArrayLike,
    order: float,
    *,
    step: float,
    definition: Literal["grunwald-letnikov", "riemann-liouville", "caputo"] = "grunwald-letnikov",
    initial: ArrayLike | None = None,
    axis: int = -1,
) -> NDArray[np.float64]:
    """Return the fractional derivative of uniformly sampled signals.

    The lower limit of the derivative is the time of the first sample.

    Parameters
    ----------
    x
        Point samples of the signals along ``axis``.
    order
        Order of the derivative, in [0, 3].
    step
        Sampling interval [s], positive.
    definition
        Definition of the derivative.

        - ``"grunwald-letnikov"``: equation (2) of the paper. The error is of first order in the step for signals that
          start at zero.
        - ``"caputo"``: equation (5) of the paper with m = ceil(order). The L1 formula is applied to the highest integer
          derivative, from second-order differences. The error is of order min(2, 2 - frac), where frac is the
          fractional part of ``order``.
        - ``"riemann-liouville"``: equation (3) of the paper, computed as Caputo's derivative plus power functions of
          the initial values. It is infinite at the first sample if an initial value is not zero.
    initial
        Known initial values x(0), x'(0), ... along the last axis. The other axes are those of ``x`` without its time
        axis. A one-dimensional array applies to all signals. Missing values are estimated by one-sided differences.
    axis
        Time axis of ``x``.

    Returns
    -------
    numpy.ndarray
        Array of the shape of ``x``.

    Raises
    ------
    DataError
        Values that are not finite real numbers, or fewer than ceil(order) + 2 samples.
    ModelError
        An order outside [0, 3], a step that is not positive, or an unknown definition.

    Notes
    -----
    The cost is O(n log n) for n samples.
    """
    values = as_floats("initial", [] if initial is None else initial)
    alpha, width = real_number("order", order), real_number("step", step)

    def differentiate(rows: NDArray[np.float64]) -> NDArray[np.float64]:
        if values.ndim <= 1:
            initial_values = np.broadcast_to(values.reshape(1, -1), (rows.shape[0], values.size))
        else:
            initial_values = values.reshape(-1, values.shape[-1])
        initial_values = np.ascontiguousarray(initial_values)
        return _core.fractional_derivative(rows, alpha, width, definition, initial_values)

    return apply_along_axis(x, axis, differentiate)


@check_arguments
def haar_transform(x: ArrayLike, *, axis: int = -1) -> NDArray[np.float64]:
    """Return the Haar coefficients of block-pulse means, from the coarsest to the finest wavelet.

    The orthogonal matrix of equation (29) of the paper is applied in O(m) operations for m means.

    Parameters
    ----------
    x
        Block-pulse means along ``axis``, whose length is a power of two.
    axis
        Time axis of ``x``.

    Returns
    -------
    numpy.ndarray
        Array of the shape of ``x``.

    Raises
    ------
    ModelError
        A length that is not a power of two.
    """
    return apply_along_axis(x, axis, _core.haar_transform)


@check_arguments
def haar_inverse(x: ArrayLike, *, axis: int = -1) -> NDArray[np.float64]:
    """Return the block-pulse means with given Haar coefficients, the inverse of :func:`haar_transform`.

    Parameters
    ----------
    x
        Haar coefficients along ``axis``, whose length is a power of two.
    axis
        Axis of the coefficients, from the coarsest to the finest wavelet.

    Returns
    -------
    numpy.ndarray
        Array of the shape of ``x``.

    Raises
    ------
    ModelError
        A length that is not a power of two.
    """
    return apply_along_axis(x, axis, _core.haar_inverse)


@check_arguments
def haar_matrix(m: int) -> NDArray[np.float64]:
    """Return the orthogonal Haar matrix, equations (27) and (29) of the paper.

    Parameters
    ----------
    m
        Number of wavelets, a power of two, at most 16 384.

    Returns
    -------
    numpy.ndarray
        Matrix of shape (m, m), whose rows are the wavelets from coarsest to finest.

    Raises
    ------
    ModelError
        If m is not a power of two, or too large.
    """
    return _core.haar_matrix(check_pulses(m))


@check_arguments
def block_pulse_matrix(order: float, m: int, *, step: float) -> NDArray[np.float64]:
    """Return the fractional integration matrix of block pulses, equation (32) of the paper.

    The matrix is upper triangular. A row vector of block-pulse means, multiplied by this matrix, gives the means of the
    fractional integral.

    Parameters
    ----------
    order
        Order of the integral, in [0, 10].
    m
        Number of pulses, at most 16 384.
    step
        Pulse width [s].

    Returns
    -------
    numpy.ndarray
        Matrix of shape (m, m).

    Raises
    ------
    ModelError
        If the order, m or the step is out of range.
    """
    m = check_pulses(m)
    return _core.block_pulse_matrix(real_number("order", order), m, real_number("step", step))


@check_arguments
def operational_matrix(order: float, m: int, *, step: float) -> NDArray[np.float64]:
    """Return the fractional integration matrix of Haar wavelets, equation (37) of the paper that ftlm implements.

    It is computed from the matrix of block pulses by fast Haar transforms from both sides, in O(m^2) operations.

    Parameters
    ----------
    order
        Order of the integral, in [0, 10].
    m
        Number of wavelets, a power of two, at most 16 384.
    step
        Pulse width [s].

    Returns
    -------
    numpy.ndarray
        Matrix of shape (m, m).

    Raises
    ------
    ModelError
        If the order, m or the step is out of range.
    """
    m = check_pulses(m)
    return _core.operational_matrix(real_number("order", order), m, real_number("step", step))
