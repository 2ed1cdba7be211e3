"""The published identification algorithm as its equations stand, in dense NumPy: the rival of the fast program.

One candidate of the order search costs two dense M x M products per distinct order (37), a recursion over all M rows
that inverts a k x k matrix at every step (44), and one dense M x M solve for the free run. Nothing is shared between
candidates and nothing is simplified, the kernel of (32) with its cancellation included.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import gamma
from typing import NamedTuple

import numpy as np


class Candidate(NamedTuple):
    """What the evaluation of one vector of orders yields."""

    coefficients: np.ndarray
    output: np.ndarray  # free-run response, as pulse means
    error: float  # (45)


def haar_matrix(m: int) -> np.ndarray:
    """Phi of (29)."""
    phi = np.zeros((m, m))
    t = (2 * np.arange(1, m + 1) - 1) / (2 * m)
    phi[0] = 1 / np.sqrt(m)
    for sigma in range(1, m):
        delta = int(np.log2(sigma))
        shift = sigma - 2**delta
        rises = (shift / 2**delta <= t) & (t < (shift + 0.5) / 2**delta)
        falls = ((shift + 0.5) / 2**delta <= t) & (t < (shift + 1) / 2**delta)
        phi[sigma] = 2 ** (delta / 2) / np.sqrt(m) * (rises.astype(float) - falls)
    return phi


def block_pulse_matrix(eta: float, m: int, duration: float) -> np.ndarray:
    """F^eta of (32), its kernel computed as printed."""
    v = np.ones(m)
    n = np.arange(2, m + 1, dtype=float)
    v[1:] = n ** (eta + 1) - 2 * (n - 1) ** (eta + 1) + (n - 2) ** (eta + 1)
    distance = np.arange(m)[None, :] - np.arange(m)[:, None]
    return (duration / m) ** eta / gamma(eta + 2) * np.where(distance >= 0, v[np.abs(distance)], 0.0)


def operational_matrix(eta: float, phi: np.ndarray, duration: float) -> np.ndarray:
    """P^eta of (37): two dense products, the inverse of the orthogonal Phi being its transpose."""
    return phi @ block_pulse_matrix(eta, len(phi), duration) @ phi.T


def multi_innovation(q: np.ndarray, outputs: np.ndarray, p: int, prior_covariance: np.ndarray) -> np.ndarray:
    """Run (44) from X = 0 over the rows of `q`, with the (up to) `p` newest rows at each step."""
    x = np.zeros(q.shape[1])
    inverse = np.linalg.inv(prior_covariance)
    for i in range(1, len(q) + 1):
        newest = slice(max(i - p, 0), i)
        stacked = q[newest][::-1].T
        innovation = outputs[newest][::-1] - stacked.T @ x
        inverse = inverse + stacked @ stacked.T
        x = x + np.linalg.inv(inverse) @ (stacked @ innovation)
    return x


def evaluate_candidate(
    y: np.ndarray,
    regressor_signals: Sequence[np.ndarray | None],
    orders: Sequence[float],
    p: int,
    K0: np.ndarray | float,
    *,
    m: int,
    duration: float,
) -> Candidate:
    """Identify and simulate one candidate: coefficients (42)-(44), free run, error (45).

    Parameters
    ----------
    y
        Measured output, as `m` pulse means; `m` is a power of two.
    regressor_signals
        The signal of each term on the right-hand side, as `m` pulse means; None stands for the output itself.
    orders
        The highest order, then the order of each term.
    p, K0
        Innovation length, and initial covariance (a number stands for that multiple of the identity).
    m, duration
        Number of pulses and record length in seconds.
    """
    if len(y) != m or m & (m - 1):
        raise ValueError(f"{len(y)} values given for {m} pulses, which must be a power of two")
    alpha, *term_orders = orders
    phi = haar_matrix(m)
    Y = phi @ y
    steps = [alpha - order for order in term_orders]
    P = {eta: operational_matrix(eta, phi, duration) for eta in dict.fromkeys(steps)}

    # (42): each row of Q is the row vector of a signal's Haar coefficients times P, hence P.T on a column.
    columns = [
        P[eta].T @ (Y if signal is None else phi @ signal) for signal, eta in zip(regressor_signals, steps, strict=True)
    ]
    Q = np.stack(columns, axis=1)
    prior = np.asarray(K0, float)
    coefficients = multi_innovation(Q, Y, p, prior if prior.ndim else prior * np.eye(Q.shape[1]))

    lhs, right = np.eye(m), np.zeros(m)
    for c, signal, eta, column in zip(coefficients, regressor_signals, steps, columns, strict=True):
        if signal is None:
            lhs -= c * P[eta].T
        else:
            right += c * column
    output = phi.T @ np.linalg.solve(lhs, right)
    return Candidate(coefficients, output, float(np.abs(y - output).sum()))


def example(m: int) -> tuple[np.ndarray, np.ndarray, list[float], float]:
    """Return a workload with known answer: output, input, orders and duration of 0.8 D^2.2 y + 0.5 D^0.9 y + y = u.

    The output is simulated on the same `m` pulses, so the coefficients are -0.625, -1.25 and 1.25.
    """
    duration = 20.0
    u = np.sign(np.sin(2 * np.pi * (np.arange(m) + 0.5) / m * duration / 5))
    slow, fast = (block_pulse_matrix(eta, m, duration).T for eta in (1.3, 2.2))
    y = np.linalg.solve(np.eye(m) + 0.625 * slow + 1.25 * fast, 1.25 * (fast @ u))
    return y, u, [2.2, 0.9, 0.0, 0.0], duration


def main() -> None:
    """Identify the example at M = 64, where the answer is known, and print what came out."""
    m = 64
    y, u, orders, duration = example(m)
    result = evaluate_candidate(y, [None, None, u], orders, 7, 1e9, m=m, duration=duration)
    print("coefficients", result.coefficients, "error", result.error)
    if not np.allclose(result.coefficients, [-0.625, -1.25, 1.25], atol=1e-4):
        raise SystemExit("the coefficients should be -0.625, -1.25 and 1.25")


if __name__ == "__main__":
    main()
