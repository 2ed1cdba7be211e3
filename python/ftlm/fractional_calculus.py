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
    """Riemann-Liouville fractional integral of uniformly sampled signals, lower limit at the first sample.

    Parameters
    ----------
    x
        Signals along ``axis``: means over pulses for ``"block-pulse"``, point samples otherwise.
    order
        Order of the integral, in [0, 10].
    step
        Sampling step or pulse width [s], positive.
    rule
        ``"block-pulse"``: means in, means out, paper (31)-(32), second order in the step. ``"trapezoidal"``: point
        samples, exact for the linear interpolant (doi:10.1023/A:1016592219341), second order.
        ``"grunwald-letnikov"``: point samples, paper (2) with a negative order, first order.
    axis
        Axis of time.

    Returns
    -------
    numpy.ndarray
        Array of the shape of ``x``.

    Raises
    ------
    DataError
        Values that are not finite real numbers (with the first index and the count).
    ModelError
        An order outside [0, 10], a step that is not positive, a rule that is not known.

    Notes
    -----
    O(n log n) for n samples.
    """
    eta, width = real_number("order", order), real_number("step", step)
    return apply_along_axis("x", x, axis, lambda rows: _core.fractional_integral(rows, eta, width, rule))


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
    """Fractional derivative of uniformly sampled signals, lower limit at the first sample.

    Parameters
    ----------
    x
        Point samples along ``axis``.
    order
        Order of the derivative, in [0, 3].
    step
        Sampling step [s], positive.
    definition
        ``"grunwald-letnikov"``: paper (2), first order in the step for signals that start at zero.
        ``"caputo"``: paper (5) with m = ceil(order), L1 formula on the highest whole derivative (second-order
        differences), order min(2, 2 - frac). ``"riemann-liouville"``: paper (3), Caputo's plus the power functions
        of the initial values; infinite at the first sample where an initial value is not zero.
    initial
        x(0), x'(0), ... where known, along the last axis (other axes as ``x`` without its time axis, or one set for
        all signals). What is not given is taken from one-sided differences.
    axis
        Axis of time.

    Returns
    -------
    numpy.ndarray
        Array of the shape of ``x``.

    Raises
    ------
    DataError
        Values that are not finite real numbers, or fewer than ceil(order) + 2 samples.
    ModelError
        An order outside [0, 3], a step that is not positive, a definition that is not known.

    Notes
    -----
    O(n log n) for n samples.
    """
    values = as_floats("initial", [] if initial is None else initial)
    alpha, width = real_number("order", order), real_number("step", step)

    def work(rows: NDArray[np.float64]) -> NDArray[np.float64]:
        if values.ndim <= 1:
            starts = np.broadcast_to(values.reshape(1, -1), (rows.shape[0], values.size))
        else:
            starts = values.reshape(-1, values.shape[-1])
        starts = np.ascontiguousarray(starts)
        return _core.fractional_derivative(rows, alpha, width, definition, starts)

    return apply_along_axis("x", x, axis, work)


@check_arguments
def haar_transform(x: ArrayLike, *, axis: int = -1) -> NDArray[np.float64]:
    """Haar coefficients, coarse to fine, of pulse means: the orthogonal matrix of paper (29) applied in O(m).

    Parameters
    ----------
    x
        Pulse means along ``axis``, a power of two of them.
    axis
        Axis of time.

    Returns
    -------
    numpy.ndarray
        Array of the shape of ``x``.

    Raises
    ------
    ModelError
        A length that is not a power of two.
    """
    return apply_along_axis("x", x, axis, _core.haar_transform)


@check_arguments
def haar_inverse(x: ArrayLike, *, axis: int = -1) -> NDArray[np.float64]:
    """Pulse means from Haar coefficients: the transpose of :func:`haar_transform`.

    Parameters
    ----------
    x
        Haar coefficients along ``axis``, a power of two of them.
    axis
        Axis of the coefficients, coarse to fine.

    Returns
    -------
    numpy.ndarray
        Array of the shape of ``x``.

    Raises
    ------
    ModelError
        A length that is not a power of two.
    """
    return apply_along_axis("x", x, axis, _core.haar_inverse)


@check_arguments
def haar_matrix(m: int) -> NDArray[np.float64]:
    """Orthogonal Haar matrix (paper (27), (29)).

    Parameters
    ----------
    m
        Number of wavelets, a power of two, at most 16 384.

    Returns
    -------
    numpy.ndarray
        Matrix of shape (m, m), coarse to fine by row.

    Raises
    ------
    ModelError
        Another m.
    """
    return _core.haar_matrix(check_pulses(m))


@check_arguments
def block_pulse_matrix(order: float, m: int, *, step: float) -> NDArray[np.float64]:
    """Fractional integration matrix of block pulses (paper (32)), upper triangular.

    A row vector of pulse means times this matrix is the row vector of the means of its integral.

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
        An order, m or step out of range.
    """
    m = check_pulses(m)
    return _core.block_pulse_matrix(real_number("order", order), m, real_number("step", step))


@check_arguments
def operational_matrix(order: float, m: int, *, step: float) -> NDArray[np.float64]:
    """Fractional integration matrix of Haar wavelets (paper (37)), by the two-sided fast Haar transform, O(m^2).

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
        An order, m or step out of range.
    """
    m = check_pulses(m)
    return _core.operational_matrix(real_number("order", order), m, real_number("step", step))
