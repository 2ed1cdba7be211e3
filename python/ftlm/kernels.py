"""Array functions of the Rust core: block-pulse means, fractional integrals, Toeplitz systems and estimators.

:class:`Candidates` scores tuples of orders of one equation. :class:`Recursion` estimates the coefficients of one
equation sample by sample.

Time is the last axis, and leading axes broadcast as in NumPy's universal functions. Arguments are arrays of real
numbers with any type and strides, and are not changed. Results are new float64 arrays. The functions release the global
interpreter lock. Equation numbers are those of the paper.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftlm import _core
from ftlm.errors import DataError, ModelError
from ftlm.fractional_calculus import haar_inverse
from ftlm.fractional_calculus import haar_transform as haar
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import parameter, setting
from ftlm.utils.validation import (
    as_floats,
    check_choice,
    check_integer,
    check_pulses,
    check_threads,
    finite_floats,
    real_number,
    short_repr,
    whole_number,
)

__all__ = [
    "Candidates",
    "Recursion",
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
    """Return the means of sampled signals over m block pulses of equal width, equation (39) of the paper.

    Parameters
    ----------
    samples
        Uniform samples of shape (..., n); the block pulses together cover their n - 1 sampling intervals.
    m
        Number of pulses; by default n - 1.
    hold
        Whether signals are constant between samples (zero-order hold), as commands are. Otherwise they are
        interpolated linearly between samples.

    Returns
    -------
    numpy.ndarray
        Shape (..., m).

    Raises
    ------
    DataError
        Fewer than two samples, or values that are not finite real numbers (with the first index and the count).
    ModelError
        An m that is not a positive whole number.

    Notes
    -----
    The cost is O(n + m) per signal.
    """
    rows, lead = _rows("samples", samples)
    pulses = rows.shape[1] - 1 if m is None else check_pulses(m)
    return _core.pulse_mean_rows(rows, pulses, hold).reshape(*lead, pulses)


@check_arguments
def block_pulse_kernel(order: ArrayLike, m: int, *, step: float, derivative: bool = False) -> NDArray[np.float64]:
    """Return the first row of the fractional integration matrix of block pulses, equations (31)-(32) of the paper.

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
        Shape (..., m), in which the leading axes are those of ``order``.

    Raises
    ------
    ModelError
        An order outside [0, 10], a step that is not positive, or an m that is not a positive whole number.

    Notes
    -----
    The cost is O(m) per order.
    """
    orders, pulses = finite_floats("order", order), check_pulses(m)
    kernels = _core.block_pulse_kernels(orders.ravel(), pulses, real_number("step", step), derivative=derivative)
    return kernels.reshape(*orders.shape, pulses)


@check_arguments
def integrate(x: ArrayLike, order: ArrayLike, *, step: float) -> NDArray[np.float64]:
    """Return block-pulse means of fractional integrals of signals by equation (32) of the paper.

    Parameters
    ----------
    x
        Block-pulse means of the signals, shape (..., m).
    order
        Orders of integration in [0, 10]. Their shape broadcasts with the leading axes of ``x``:
        ``integrate(x[:, None], orders, step=h)`` returns one integral for every pair of signal and order.
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
    The cost is O(m log m) per integral. Integrals of equal order share one kernel and its spectrum. In addition to the
    result, about one byte per value is required. If ``x`` is broadcast, the memory of the result is required twice.
    """
    values, orders = finite_floats("x", x), finite_floats("order", order)
    m = _length("x", values)
    lead = _broadcast({"x": values.shape[:-1], "order": orders.shape})
    unique_orders, groups = np.unique(np.broadcast_to(orders, lead), return_inverse=True)
    kernels = _core.block_pulse_kernels(unique_orders, m, real_number("step", step))
    rows = np.broadcast_to(values, (*lead, m)).reshape(-1, m)
    return _core.toeplitz_apply(kernels, rows, groups.ravel().tolist()).reshape(*lead, m)


@check_arguments
def toeplitz_apply(kernel: ArrayLike, x: ArrayLike) -> NDArray[np.float64]:
    """Return the products of lower triangular Toeplitz matrices with vectors: causal convolutions of m values.

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
    The cost is O(m log m) per vector, as for ``scipy.linalg.matmul_toeplitz``. Vectors that are multiplied by the same
    kernel share its spectrum.
    """
    return _with_kernels(_core.toeplitz_apply, kernel, "x", x)


@check_arguments
def toeplitz_solve(kernel: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    """Return the solutions x of lower triangular Toeplitz systems: the inverse of :func:`toeplitz_apply`.

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
        If the first value of a kernel is zero, so that its matrix is singular.

    Notes
    -----
    The cost is O(m log^2 m) per system; that of ``scipy.linalg.solve_toeplitz`` is O(m^2).
    """
    return _with_kernels(_solve_rows, kernel, "b", b)


@check_arguments
def multi_innovation(
    Q: ArrayLike, m: ArrayLike, p: int = 7, *, prior_covariance: ArrayLike, trace: bool = False
) -> NDArray[np.float64]:
    """Return the multi-innovation estimate of X in m = Q X by equations (42)-(44) of the paper, starting from X = 0.

    Parameters
    ----------
    Q
        Regressors, shape (..., M, k), with rows in the sequence of the recursion.
    m
        Outputs, shape (..., M).
    p
        Innovation length: number of most recent rows that each step of the recursion uses.
    prior_covariance
        Initial variance of the coefficients, one number or shape (k,), in the squared units of the coefficients.
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
    Without ``trace`` the estimate is computed in closed form by a QR factorization of cost O(M k^2), in which row i of
    M has the weight min(p, M - i + 1).
    """
    regressors, outputs = finite_floats("Q", Q), finite_floats("m", m)
    if regressors.ndim < 2 or outputs.ndim < 1 or regressors.shape[-2] != outputs.shape[-1] or not outputs.shape[-1]:
        raise DataError(
            f"Q has shape {regressors.shape}, m has shape {outputs.shape}; give shapes (..., M, k) and "
            "(..., M) with M of at least 1"
        )
    length = check_integer("p", p, 1)
    count, width = regressors.shape[-2:]
    prior = as_floats("prior_covariance", prior_covariance)
    if prior.ndim > 1 or (prior.ndim and prior.size != width):
        raise DataError(
            f"prior_covariance has shape {prior.shape}; give one number, or one for each of {width} columns of Q"
        )
    lead = _broadcast({"Q": regressors.shape[:-2], "m": outputs.shape[:-1]})
    rows = _core.multi_innovation_rows(
        np.broadcast_to(regressors, (*lead, count, width)).reshape(-1, width),
        np.broadcast_to(outputs, (*lead, count)).ravel(),
        count,
        min(length, count),
        np.broadcast_to(prior, width).tolist(),
        trace,
    )
    return rows.reshape(*lead, count, width) if trace else rows.reshape(*lead, width)


@check_arguments
def errors(measured: ArrayLike, predicted: ArrayLike) -> NDArray[np.float64]:
    """Return the sum of absolute errors, RMSE, NR and fit of predictions; see :func:`ftlm.metrics`.

    The first three are equations (45)-(47) of the paper.

    Parameters
    ----------
    measured, predicted
        Shapes (..., M) in the same unit.

    Returns
    -------
    numpy.ndarray
        Shape (..., 4): sum of absolute errors, root mean square error, NR (the RMSE divided by the standard deviation
        of the measurement), and fit 100 (1 - NR) percent.

    Raises
    ------
    DataError
        Measured values that are not finite real numbers, or shapes that do not broadcast.
    """
    y, prediction = finite_floats("measured", measured), as_floats("predicted", predicted, gaps=True)
    m = _length("measured", y)
    if _length("predicted", prediction) != m:
        raise DataError(
            f"measured has shape {y.shape}, predicted {prediction.shape}; give arrays whose last axes have equal length"
        )
    lead = _broadcast({"measured": y.shape[:-1], "predicted": prediction.shape[:-1]})
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        residuals = np.abs(np.broadcast_to(y - prediction, (*lead, m)))
        rmse = np.sqrt(np.mean(residuals**2, axis=-1))
        ratio = rmse / np.std(y, axis=-1)
        return np.stack([np.sum(residuals, axis=-1), rmse, ratio, 100.0 * (1.0 - ratio)], axis=-1)


#: Minimum eigenvalue of the correlation matrix of a candidate's regressors. Below it, the regressors are treated as
#: linearly dependent within rounding, and the candidate has no coefficients.
MIN_CORRELATION_EIGENVALUE = 1e-12


class Candidates:
    """Evaluator of the equation D^alpha y = sum_j c_j D^order_j x_j for many tuples of orders.

    Initial conditions are zero. The method follows equations (22)-(45) of the paper. Fractional integrals and their
    inner products are cached between calls, so that the tuples of an order grid share them.

    Parameters
    ----------
    signals
        Block-pulse means of s signals, shape (s, M).
    terms
        Row index in `signals` of the signal x_j, for each of k terms.
    output
        Row index in `signals` of the output y.
    step
        Pulse width [s].

    Raises
    ------
    DataError
        Values that are not finite real numbers (with the first index and the count), or signals that are not a
        two-dimensional array.
    ModelError
        If a row index is out of range, there is no term, or the step is not positive.

    Examples
    --------
    >>> import numpy as np
    >>> from ftlm import kernels
    >>> u = np.repeat([1.0, -1.0, 1.0, -1.0], 16)
    >>> y = 2.0 * kernels.integrate(u, 0.8, step=0.1)
    >>> model = kernels.Candidates([y, u], [1], step=0.1)
    >>> scores, coefficients = model.score([[0.7, 0.0], [0.8, 0.0]])
    >>> int(scores.argmin()), coefficients[1].round(9).tolist()
    (1, [2.0])
    """

    @check_arguments
    def __init__(self, signals: ArrayLike, terms: Sequence[int], *, output: int = 0, step: float) -> None:
        table = finite_floats("signals", signals)
        if table.ndim != 2 or not table.size:
            raise DataError(f"signals has shape {table.shape}; give pulse means of shape (signals, M)")
        self._signals, self._terms = table, np.array(_signal_rows(terms, output, len(table)))
        self._output = int(output)
        self._step = real_number("step", step)
        self._columns = dict[tuple[int, float], int]()
        self._cache: dict[str, NDArray[np.float64]] = {}

    @check_arguments
    def coefficients(
        self,
        orders: ArrayLike,
        *,
        p: int = 0,
        prior_covariance: ArrayLike = math.inf,
        rows: Literal["haar", "time"] = "haar",
    ) -> NDArray[np.float64]:
        """Estimate the coefficients for each tuple of orders, by least squares or multi-innovation.

        Parameters
        ----------
        orders
            Shape (N, 1 + k): alpha, then the order of each term.
        p
            Innovation length; 0 for least squares.
        prior_covariance
            Initial covariance of the coefficients, a number or shape (k,); infinite for no prior.
        rows
            Basis of the rows in equation (42) of the paper: ``"haar"``, which requires an M that is a power of two, or
            ``"time"``.

        Returns
        -------
        numpy.ndarray
            Shape (N, k); NaN where columns are linearly dependent within rounding.

        Raises
        ------
        DataError
            Orders that are not finite, or of another shape; an M that is not a power of two, for Haar rows.
        ModelError
            If an order of a term is above alpha or below 0, or alpha is above 10. Also if p or the prior covariance is
            out of range.

        Notes
        -----
        The normal equations are solved with columns scaled to unit norm. The cost is O(K M log M + K^2 M + N k^3),
        where K is the number of distinct fractional integrals.
        """
        table = self._orders(orders)
        length = check_integer("p", p, 0)
        check_choice("rows", rows, ("haar", "time"))
        prior = as_floats("prior_covariance", prior_covariance)
        if prior.ndim > 1 or (prior.ndim and prior.size != len(self._terms)) or not np.all(prior > 0):
            raise ModelError(
                f"prior_covariance is not positive, or has a wrong shape; give one positive number, or "
                f"{len(self._terms)}, one per term"
            )
        columns = self._integral_rows(table)
        gram = self._gram(length, rows)
        normal = gram[columns[:, :, None], columns[:, None, :]]
        normal[:, range(len(self._terms)), range(len(self._terms))] += 1.0 / np.broadcast_to(prior, len(self._terms))
        norms = np.sqrt(np.einsum("nii->ni", normal))
        with np.errstate(divide="ignore", invalid="ignore"):
            correlation = normal / (norms[:, :, None] * norms[:, None, :])
            target = gram[columns, 0] / norms
        coefficients = np.full(columns.shape, np.nan)
        usable = np.flatnonzero(np.all(norms > 0, axis=1))
        usable = usable[np.linalg.eigvalsh(correlation[usable])[:, 0] > MIN_CORRELATION_EIGENVALUE]
        coefficients[usable] = np.linalg.solve(correlation[usable], target[usable, :, None])[..., 0] / norms[usable]
        return coefficients

    @check_arguments
    def score(
        self,
        orders: ArrayLike,
        coefficients: ArrayLike | None = None,
        *,
        p: int = 0,
        prior_covariance: ArrayLike = math.inf,
        rows: Literal["haar", "time"] = "haar",
        norm: Literal["l1", "l2"] = "l1",
        limit: float = math.inf,
        threads: int = 1,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the output error of the simulation with zero initial conditions, and the coefficients, for each tuple.

        Parameters
        ----------
        orders
            Shape (N, 1 + k): alpha, then the order of each term.
        coefficients
            Shape (N, k); by default they are estimated by :meth:`coefficients` with p, prior covariance and rows.
        p, prior_covariance, rows
            See :meth:`coefficients`.
        norm
            ``"l1"``: sum of absolute errors. ``"l2"``: root mean square error.
        limit
            Error above which a simulation is stopped early and its error is set to infinity.
        threads
            Number of threads; results do not depend on it.

        Returns
        -------
        tuple of numpy.ndarray
            Errors, shape (N,), and coefficients, shape (N, k). An error is infinite if it exceeds the limit or a
            coefficient is not finite.

        Raises
        ------
        DataError
            Orders that are not finite, or orders or coefficients of another shape.
        ModelError
            If an order, p, the prior covariance or the limit is out of range; see :meth:`coefficients`.

        Notes
        -----
        In addition to the coefficients, the cost is O(k M + M log^2 M) per tuple. Tuples whose error exceeds the limit
        take a fraction of this cost.
        """
        table = self._orders(orders)
        check_choice("norm", norm, ("l1", "l2"))
        max_error = real_number("limit", limit)
        if math.isnan(max_error):
            raise ModelError(f"{parameter('limit', limit)} is not a number; give a maximum error, or inf for no limit")
        if coefficients is None:
            coefficients_table = self.coefficients(table, p=p, prior_covariance=prior_covariance, rows=rows)
        else:
            coefficients_table = self._check_shape(as_floats("coefficients", coefficients, gaps=True), len(table))
        scores = np.full(len(table), np.inf)
        is_finite = np.all(np.isfinite(coefficients_table), axis=1)
        scores[is_finite] = self._points[norm].scores(
            np.hstack([table, coefficients_table])[is_finite], max_error, check_threads(threads)
        )
        return scores, coefficients_table

    @check_arguments
    def free_run(self, orders: ArrayLike, coefficients: ArrayLike) -> NDArray[np.float64]:
        """Simulate the output with zero initial conditions for each tuple of orders and coefficients.

        Parameters
        ----------
        orders, coefficients
            Shapes (N, 1 + k) and (N, k); see :meth:`coefficients`.

        Returns
        -------
        numpy.ndarray
            Block-pulse means of the simulated output, shape (N, M).

        Raises
        ------
        DataError
            Orders or coefficients that are not finite, or of another shape.
        ModelError
            If an order of a term is above alpha or below 0, or alpha is above 10.

        Notes
        -----
        The cost per tuple is O(k M log M). Terms of the output (autoregressive terms) add O(M log^2 M).
        """
        table = self._orders(orders)
        coefficients_table = self._check_shape(finite_floats("coefficients", coefficients), len(table))
        m, output_terms = self._signals.shape[1], self._terms == self._output
        divisor = np.zeros((len(table), m))
        divisor[:, 0] = 1.0
        forced = np.zeros((len(table), m))
        order_differences = table[:, :1] - table[:, 1:]
        for k, is_output in enumerate(output_terms):
            if is_output:
                divisor -= coefficients_table[:, [k]] * block_pulse_kernel(order_differences[:, k], m, step=self._step)
            else:
                forced += coefficients_table[:, [k]] * integrate(
                    self._signals[self._terms[k]], order_differences[:, k], step=self._step
                )
        return toeplitz_solve(divisor, forced) if output_terms.any() else forced

    @cached_property
    def _points(self) -> dict[str, _core.Points]:
        """Evaluators of the Rust core by norm, ``"l1"`` and ``"l2"``."""
        inputs = [row != self._output for row in range(len(self._signals))]
        record = (self._step, self._signals, None)
        return {
            norm: _core.Points([record], self._output, self._terms.tolist(), inputs, norm == "l2")
            for norm in ("l1", "l2")
        }

    def _check_shape(self, coefficients: NDArray[np.float64], count: int) -> NDArray[np.float64]:
        """Return the coefficients unchanged; raise DataError unless their shape is (count, number of terms)."""
        if coefficients.shape != (count, len(self._terms)):
            raise DataError(
                f"coefficients has shape {coefficients.shape}; give ({count}, {len(self._terms)}), one row per tuple"
            )
        return coefficients

    def _orders(self, orders: ArrayLike) -> NDArray[np.float64]:
        """Return orders as an array of shape (N, 1 + k).

        Raise DataError for another shape. Raise ModelError for an alpha above 10, or another order outside [0, alpha].
        """
        table = finite_floats("orders", orders)
        width = 1 + len(self._terms)
        if table.ndim != 2 or table.shape[1] != width:
            raise DataError(f"orders has shape {table.shape}; give (N, {width}): alpha, then the order of each term")
        bad = np.flatnonzero(np.any((table[:, 1:] < 0) | (table[:, 1:] > table[:, :1]), axis=1) | (table[:, 0] > 10))
        if bad.size:
            raise ModelError(
                f"orders {bad[0]} of {len(table)} are {table[bad[0]].tolist()} ({bad.size} such tuples in all); give "
                "alpha of at most 10, and orders of the terms from 0 to alpha"
            )
        return table

    def _integral_rows(self, orders: NDArray[np.float64]) -> NDArray[np.intp]:
        """Return the row of each term's fractional integral in the cache ``_cache["time"]``, shape (N, k).

        Missing integrals are computed and appended to the cache. Row 0 is the output.
        """
        order_differences = np.round(orders[:, :1] - orders[:, 1:], 9)
        # A pair (signal, order) is encoded as a complex number: NumPy sorts these faster than rows of an array.
        unique_keys, inverse = np.unique((self._terms + 1j * order_differences).ravel(), return_inverse=True)
        keys = [(int(pair.real), float(pair.imag)) for pair in unique_keys]
        new_keys = [key for key in keys if key not in self._columns]
        if new_keys or not self._cache:
            rows, etas = [row for row, _ in new_keys], [eta for _, eta in new_keys]
            integrals = self._cache.get("time", self._signals[[self._output]])
            all_integrals = (
                np.vstack([integrals, integrate(self._signals[rows], etas, step=self._step)]) if new_keys else integrals
            )
            self._columns |= {key: len(integrals) + k for k, key in enumerate(new_keys)}
            self._cache = {"time": all_integrals}
        rows_of_keys = np.array([self._columns[key] for key in keys], dtype=np.intp)
        return rows_of_keys[inverse.ravel()].reshape(order_differences.shape)

    def _gram(self, p: int, rows: str) -> NDArray[np.float64]:
        """Return the matrix of inner products of the output and all cached integrals.

        Pulse i of M has the weight min(p, M - i + 1); for p = 0 all weights are 1.
        """
        key = f"{rows} {p}" if p else "least squares"
        if key not in self._cache:
            integrals = self._cache["time"]
            if p:
                weights = np.minimum(p, np.arange(integrals.shape[1], 0, -1.0))
                integrals = np.sqrt(weights) * (haar(integrals) if rows == "haar" else integrals)
            self._cache[key] = integrals @ integrals.T
        return self._cache[key]


class Recursion:
    """Recursive multi-innovation estimator of the coefficients of D^alpha y = sum_j c_j D^order_j x_j.

    It processes one sample at a time by equation (44) of the paper.

    Parameters
    ----------
    orders
        Shape (1 + k,): alpha, then the order of each of k terms. Alpha exceeds each of these orders by at most 2.
    terms
        Column index, in the samples given to :meth:`push`, of the signal x_j of each term.
    output
        Column index of the output y.
    step
        Sampling interval [s].
    hold
        For each of s signals, whether it is constant between samples (zero-order hold), as commands are. Otherwise it
        is interpolated linearly.
    p
        Innovation length: number of most recent regression equations in each update.
    prior_covariance
        Initial variance of every coefficient. By default it is 1e10 divided by the sum of squares of the coefficient's
        regressor.
    forgetting
        Forgetting factor in (0, 1]: weight of each regression equation relative to the next one; 1 for no forgetting.
    initial
        Exponents, above -1, of powers of time that are added as terms for nonzero initial conditions. ``"caputo"``
        selects the exponents of Caputo's initial values. By default initial conditions are zero.
    longest
        Maximum number of samples, minus one.
    fixed
        Fixed value of each term's coefficient, or None for a free coefficient; by default all are free.

    Raises
    ------
    DataError
        Orders that are not finite, or of another shape.
    ModelError
        A column index out of range, no term, or an option out of range.

    Notes
    -----
    A sample takes about 1 us, independent of the number of earlier samples. The history of each signal is represented
    by a sum of some hundred decaying exponentials, exactly up to rounding. After every sample the coefficients equal
    those of :func:`multi_innovation` for all samples up to then.

    Examples
    --------
    >>> import numpy as np
    >>> from ftlm import kernels
    >>> u = np.repeat([1.0, -1.0, 1.0, -1.0], 16)
    >>> y = np.append(0.0, np.cumsum(2.0 * 0.1 * u[:-1]))
    >>> stream = kernels.Recursion([1.0, 0.0], [1], step=0.1, hold=[False, True])
    >>> path = stream.push(np.column_stack([y, u]))
    >>> path.shape, stream.coefficients.round(6).tolist()
    ((64, 1), [2.0])
    """

    @check_arguments
    def __init__(
        self,
        orders: ArrayLike,
        terms: Sequence[int],
        *,
        output: int = 0,
        step: float,
        hold: Sequence[bool],
        p: int = 7,
        prior_covariance: float | None = None,
        forgetting: float = 1.0,
        initial: Sequence[float] | Literal["caputo"] = (),
        longest: int = 1_000_000,
        fixed: Sequence[float | None] | None = None,
    ) -> None:
        rows = _signal_rows(terms, output, len(hold))
        numbers = finite_floats("orders", orders)
        if numbers.shape != (1 + len(rows),):
            raise DataError(
                f"orders has shape {numbers.shape}; give ({1 + len(rows)},): alpha, then one order per term"
            )
        length = check_integer("p", p, 1, (1 << 31) - 1)
        if isinstance(initial, str):
            check_choice("initial", initial, ("caputo",))
        exponents = [] if isinstance(initial, str) else [real_number("initial", e) for e in initial]
        equation = (int(output), float(numbers[0]), list(zip(rows, numbers[1:].tolist(), strict=True)))
        self._count = len(hold)
        self._core = _core.Streaming(
            real_number("step", step),
            max(2, check_pulses(longest)),
            [bool(h) for h in hold],
            [(equation, [None] * len(rows) if fixed is None else list(fixed))],
            length,
            None if prior_covariance is None else real_number("prior_covariance", prior_covariance),
            real_number("forgetting", forgetting),
            (isinstance(initial, str), exponents),
        )

    @check_arguments
    def push(self, samples: ArrayLike) -> NDArray[np.float64]:
        """Update the estimate with samples of all signals, and return the coefficients after each sample.

        Parameters
        ----------
        samples
            Samples of the s signals, shape (n, s).

        Returns
        -------
        numpy.ndarray
            Shape (n, k + number of initial terms): the coefficients of the terms, then those of the initial terms.

        Raises
        ------
        DataError
            Values that are not finite (with the first index and the count), or another number of signals.
        ModelError
            If there are more samples than ``longest`` allows.
        ConvergenceError
            If rounding makes the covariance lose its positive definiteness.
        """
        table = finite_floats("samples", samples)
        if table.ndim != 2 or table.shape[1] != self._count:
            raise DataError(f"samples has shape {table.shape}; give (n, {self._count}), one column per signal")
        return self._core.push(table)

    @property
    def coefficients(self) -> NDArray[np.float64]:
        """Coefficients after the newest sample, of the terms first, then of the initial terms."""
        return np.array(self._core.coefficients[0])

    @property
    def pulses(self) -> int:
        """Number of regression equations processed, by equation (44) of the paper: the number of samples minus one."""
        return self._core.pulses


def _signal_rows(terms: Sequence[int], output: int, count: int) -> list[int]:
    """Return the index of each term's signal; raise ModelError without terms, or for an index that is out of range."""
    if not len(terms):
        raise ModelError(f"{parameter('terms')} is empty; give the row of the signal of each term")
    for name, row in [("output", output), *(("terms", term) for term in terms)]:
        index = whole_number(row)
        if index is None or not 0 <= index < count:
            raise ModelError(
                f"{setting(name)} {short_repr(row)} is not the row index of one of {count} signals; count from 0"
            )
    return [int(term) for term in terms]


def _rows(name: str, values: ArrayLike) -> tuple[NDArray[np.float64], tuple[int, ...]]:
    """Return `values` as rows of a two-dimensional array, and the shape of the axes before the last one."""
    array = finite_floats(name, values)
    return array.reshape(-1, _length(name, array)), array.shape[:-1]


def _length(name: str, array: NDArray[np.float64]) -> int:
    """Return the length of the last axis, which is time; raise DataError if it is missing or empty."""
    if array.ndim == 0 or array.shape[-1] == 0:
        raise DataError(f"{name} has shape {array.shape} and no time axis; give an array of shape (..., m)")
    return int(array.shape[-1])


def _broadcast(shapes: dict[str, tuple[int, ...]]) -> tuple[int, ...]:
    """Return the shape to which the given shapes, by argument name, broadcast; raise DataError if they do not."""
    try:
        return np.broadcast_shapes(*shapes.values())
    except ValueError:
        text = " and ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise DataError(f"leading axes of {text} do not broadcast; give axes of equal length, or of length 1") from None


def _solve_rows(columns: NDArray[np.float64], rows: NDArray[np.float64], groups: list[int]) -> NDArray[np.float64]:
    """Return the solutions of lower triangular Toeplitz systems, one per row of `rows`.

    `columns` are first columns of matrices, and `groups` gives the matrix index of each row. Raise ModelError for a
    singular matrix.
    """
    zero = np.flatnonzero(columns[:, 0] == 0.0)
    if zero.size:
        raise ModelError(
            f"kernel {zero[0]} of {len(columns)} begins with 0 ({len(zero)} such kernels in all), so its matrix is "
            "singular; leave it out"
        )
    return _core.toeplitz_solve(columns, rows, groups)


def _with_kernels(
    function: Callable[[NDArray[np.float64], NDArray[np.float64], list[int]], NDArray[np.float64]],
    kernel: ArrayLike,
    name: str,
    vectors: ArrayLike,
) -> NDArray[np.float64]:
    """Broadcast kernels against vectors, and return ``function(kernels, rows, kernel index of each row)`` reshaped."""
    columns, shape = _rows("kernel", kernel)
    values = finite_floats(name, vectors)
    m = _length(name, values)
    if columns.shape[1] != m:
        raise DataError(f"kernel has {columns.shape[1]} values and {name} has {m}; give both the same length")
    lead = _broadcast({"kernel": shape, name: values.shape[:-1]})
    groups = np.broadcast_to(np.arange(columns.shape[0]).reshape(shape), lead).ravel().tolist()
    return function(columns, np.broadcast_to(values, (*lead, m)).reshape(-1, m), groups).reshape(*lead, m)
