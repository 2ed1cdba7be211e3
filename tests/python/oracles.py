"""Slow, plainly correct NumPy versions of what the program computes fast: matrices written out, sums written as loops.

Nothing here imports the package, so that agreement with it means something. Conventions: a signal is the vector of its
means over `m` equal pulses of a record of length `duration`; `block_pulse_matrix` is upper triangular, as in the
literature, so a signal is integrated by its TRANSPOSE (`integrate`); an equation reads
D^alpha y = sum of c D^nu s, and a term enters divided by D^alpha, as c I^(alpha - nu) s.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from math import gamma

import numpy as np
from scipy.linalg import solve_triangular

# ----------------------------------------------------------------------------------------------------------------------
# Matrices


def block_pulse_kernel(eta: float, m: int) -> np.ndarray:
    """First row v_1 … v_m of (32), without the factor h^eta / Gamma(eta + 2).

    With j = n - 1 the second difference is j^(eta+1) [((1+1/j)^(eta+1) - 1) + ((1-1/j)^(eta+1) - 1)]. Each bracket is
    an expm1 of a log1p, so only their sum cancels, by a factor j instead of the j^2 of the printed form, and
    `np.longdouble` absorbs that: with the 64-bit mantissa it has on x86 the relative error is about 1e-19 m / eta, a
    few units in the last place of a double up to m = 10^4 unless eta is tiny. Where longdouble is a plain double,
    expect 1e-16 m / eta instead.
    """
    v = np.ones(m, dtype=np.longdouble)
    if m > 1:
        e = np.longdouble(eta) + 1
        v[1] = 2 * np.expm1(np.longdouble(eta) * np.log(np.longdouble(2)))
        j = np.arange(2, m, dtype=np.longdouble)
        v[2:] = j**e * (np.expm1(e * np.log1p(1 / j)) + np.expm1(e * np.log1p(-1 / j)))
    return v.astype(float)


def block_pulse_kernel_as_printed(eta: float, m: int) -> np.ndarray:
    """First row of (32) by the formula as it stands in the paper, in doubles: the example of what to avoid."""
    n = np.arange(2, m + 1, dtype=float)
    return np.concatenate([[1.0], n ** (eta + 1) - 2 * (n - 1) ** (eta + 1) + (n - 2) ** (eta + 1)])


def block_pulse_matrix(eta: float, m: int, duration: float) -> np.ndarray:
    """F^eta of (32): upper triangular, constant along its diagonals; eta = 0 gives the identity."""
    if eta == 0:
        return np.eye(m)
    row = (duration / m) ** eta / gamma(eta + 2) * block_pulse_kernel(eta, m)
    matrix = np.zeros((m, m))
    for i in range(m):
        matrix[i, i:] = row[: m - i]
    return matrix


def haar_matrix(m: int) -> np.ndarray:
    """Phi of (29): Haar functions (27) by row, at the pulse midpoints by column; row 0 is the constant 1/sqrt(m)."""
    matrix = np.zeros((m, m))
    matrix[0] = 1 / np.sqrt(m)
    t = (2 * np.arange(1, m + 1) - 1) / (2 * m)
    for sigma in range(1, m):
        delta = sigma.bit_length() - 1
        shift = sigma - 2**delta
        height = 2 ** (delta / 2) / np.sqrt(m)
        start, middle, end = shift / 2**delta, (shift + 0.5) / 2**delta, (shift + 1) / 2**delta
        matrix[sigma, (start <= t) & (t < middle)] = height
        matrix[sigma, (middle <= t) & (t < end)] = -height
    return matrix


def operational_matrix(eta: float, m: int, duration: float) -> np.ndarray:
    """P^eta = Phi F^eta Phi^T of (37)."""
    phi = haar_matrix(m)
    return phi @ block_pulse_matrix(eta, m, duration) @ phi.T


def integrate(signal: np.ndarray, eta: float, duration: float) -> np.ndarray:
    """Pulse means of I^eta of a signal given by its pulse means."""
    return block_pulse_matrix(eta, len(signal), duration).T @ np.asarray(signal, float)


# ----------------------------------------------------------------------------------------------------------------------
# Samples to means


def pulse_means(samples: Sequence[float], m: int, how: str) -> np.ndarray:
    """Means over `m` equal pulses of the record [0, (N-1)h] of what N samples at t = 0, h, … (N-1)h stand for.

    `how="zoh"` holds sample j over [jh, (j+1)h); `how="foh"` joins the samples by straight lines. Time is counted in
    sample steps and the ends of the pulses are rational numbers, so no pulse gains or loses a sliver to rounding.
    """
    if how not in ("zoh", "foh"):
        raise ValueError(f"no inter-sample behaviour is called {how!r}")
    last = len(samples) - 1
    means = np.zeros(m)
    for k in range(m):
        start, right = Fraction(last * k, m), Fraction(last * (k + 1), m)
        area = 0.0
        for j in range(int(start), last):
            a, b = max(start, Fraction(j)), min(right, Fraction(j + 1))
            if b <= a:
                break
            if how == "zoh":
                height = float(samples[j])
            else:
                middle = float((a + b) / 2 - j)
                height = (1 - middle) * float(samples[j]) + middle * float(samples[j + 1])
            area += float(b - a) * height
        means[k] = area / float(right - start)
    return means


# ----------------------------------------------------------------------------------------------------------------------
# Free runs


def free_run(
    own: Sequence[tuple[float, float]],
    exogenous: Sequence[tuple[float, float, np.ndarray]],
    alpha: float,
    m: int,
    duration: float,
    *,
    initial: np.ndarray | None = None,
) -> np.ndarray:
    """Response y of one equation to given signals, by one dense triangular solve.

    `own` holds (coefficient, order) and `exogenous` (coefficient, order, signal) of the right-hand side; `initial` is
    a ready contribution of the initial terms, added as it is.
    """
    lhs = np.eye(m)
    right = np.zeros(m) if initial is None else np.array(initial, float)
    for coefficient, order in own:
        lhs -= coefficient * block_pulse_matrix(alpha - order, m, duration).T
    for coefficient, order, signal in exogenous:
        right += coefficient * integrate(signal, alpha - order, duration)
    return solve_triangular(lhs, right, lower=True)


def coupled_free_run(
    equations: Sequence[Mapping], inputs: Mapping[str, np.ndarray], m: int, duration: float
) -> dict[str, np.ndarray]:
    """Responses of several equations that feed each other, by one dense solve over all outputs at once.

    An equation is {"output", "alpha", "terms": [{"signal", "coefficient", "order"}, …]}; a signal that is the output
    of some equation is solved for, any other is looked up in `inputs`.
    """
    place = {equation["output"]: slice(i * m, (i + 1) * m) for i, equation in enumerate(equations)}
    lhs = np.eye(m * len(equations))
    right = np.zeros(m * len(equations))
    for equation in equations:
        row = place[equation["output"]]
        for term in equation["terms"]:
            operator = block_pulse_matrix(equation["alpha"] - term["order"], m, duration).T
            if term["signal"] in place:
                lhs[row, place[term["signal"]]] -= term["coefficient"] * operator
            else:
                right[row] += term["coefficient"] * (operator @ inputs[term["signal"]])
    solution = np.linalg.solve(lhs, right)
    return {name: solution[where] for name, where in place.items()}


# ----------------------------------------------------------------------------------------------------------------------
# Estimates


def regressors(
    signals: Sequence[np.ndarray], orders: Sequence[float], alpha: float, duration: float, haar: bool = True
) -> np.ndarray:
    """Matrix whose columns are I^(alpha - order) of each signal, in Haar coordinates unless told otherwise."""
    columns = [integrate(s, alpha - order, duration) for s, order in zip(signals, orders, strict=True)]
    matrix = np.stack(columns, axis=1)
    return haar_matrix(len(matrix)) @ matrix if haar else matrix


def least_squares(q: np.ndarray, outputs: np.ndarray) -> np.ndarray:
    """Coefficients X that minimise |outputs - Q X|; one row of `q` per equation."""
    return np.linalg.lstsq(q, outputs, rcond=None)[0]


def multi_innovation_recursion(
    q: np.ndarray, outputs: np.ndarray, p: int, prior_covariance: np.ndarray | float, start: np.ndarray | None = None
) -> np.ndarray:
    """Estimates X after every step of (44), one to a row, each step using the min(i, p) newest of the rows of `q`.

    A scalar prior covariance stands for that multiple of the identity. The inverse of K is updated and inverted at
    every step, as (44) says.
    """
    size = q.shape[1]
    covariance = np.asarray(prior_covariance, float)
    if covariance.ndim == 0:
        covariance = covariance * np.eye(size)
    precision = np.linalg.inv(covariance)
    x = np.zeros(size) if start is None else np.array(start, float)
    path = []
    for i in range(1, len(q) + 1):
        newest = [row for row in range(i - 1, i - 1 - p, -1) if row >= 0]
        stacked = q[newest].T  # Q(p, i): one column per row used
        innovation = outputs[newest] - stacked.T @ x
        precision = precision + stacked @ stacked.T
        x = x + np.linalg.inv(precision) @ stacked @ innovation
        path.append(x)
    return np.array(path)


def multi_innovation_closed_form(
    q: np.ndarray, outputs: np.ndarray, p: int, prior_covariance: np.ndarray | float, start: np.ndarray | None = None
) -> np.ndarray:
    """Last estimate of (44) at once: row i counts min(p, M - i + 1) times, against the prior (start, covariance)."""
    rows, size = q.shape
    covariance = np.asarray(prior_covariance, float)
    if covariance.ndim == 0:
        covariance = covariance * np.eye(size)
    precision = np.linalg.inv(covariance)
    x = np.zeros(size) if start is None else np.array(start, float)
    weights = np.array([min(p, rows - i + 1) for i in range(1, rows + 1)], float)
    normal = q.T @ (weights[:, None] * q) + precision
    return np.linalg.solve(normal, q.T @ (weights * outputs) + precision @ x)


# ----------------------------------------------------------------------------------------------------------------------
# Criteria


def absolute_error(measured: np.ndarray, model: np.ndarray) -> float:
    """Sum of absolute differences, (45)."""
    return float(sum(abs(a - b) for a, b in zip(measured, model, strict=True)))


def root_mean_square(measured: np.ndarray, model: np.ndarray) -> float:
    """RMSE, (46) with the sum it lacks in print."""
    return float((sum((a - b) ** 2 for a, b in zip(measured, model, strict=True)) / len(measured)) ** 0.5)


def normalised_residual(measured: np.ndarray, model: np.ndarray) -> float:
    """RMSE over the population standard deviation of the measured signal, (47)."""
    return root_mean_square(measured, model) / float(np.std(measured, ddof=0))


def fit(measured: np.ndarray, model: np.ndarray) -> float:
    """Fit in per cent: 100 for a perfect model, 0 for one no better than the mean."""
    measured, model = np.asarray(measured, float), np.asarray(model, float)
    return float(100 * (1 - np.linalg.norm(measured - model) / np.linalg.norm(measured - measured.mean())))


def held_response(
    transfer: Callable[[np.ndarray], np.ndarray], u: np.ndarray, step: float, aliases: int = 30
) -> np.ndarray:
    """Samples of the response to an input that is held from each sample to the next, by the inverse z-transform.

    The z-transform of a sampled response is the sum of the Laplace transform's aliases (Poisson); it is inverted by a
    discrete Fourier transform along a circle so far out that what wraps around is gone. `transfer` takes points in the
    complex plane, and may give a row an output.
    """
    rows = len(u)
    count = 2 * rows
    damp = 23.0 / (count * step)
    s = damp + 2j * np.pi * np.arange(count // 2 + 1) / (count * step)
    places = [s + 2j * np.pi * m / step for m in range(-aliases, aliases + 1)]
    pulse = sum(transfer(at) / at for at in places) * (1 - np.exp(-s * step)) / step
    decay = np.exp(-damp * step * np.arange(count))
    spectrum = np.fft.rfft(np.pad(u, (0, rows)) * decay)
    return (np.fft.irfft(pulse * spectrum, count) / decay)[..., :rows]
