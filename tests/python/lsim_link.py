"""A link's equation with integer orders by SciPy alone: free runs of its filtered deflection, linear numbers projected.

D^2 y = a y + d D y + sum of c_k D^m_k s_k, compared behind the filter that y passed. Shares no code with ftlm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import cont2discrete, lfilter

Signals = Mapping[str, np.ndarray]
Term = tuple[str, int]
#: Denominator of the stock filter, whose numerator is its last coefficient.
STOCK = (1.0, 22.6195, 157.9137)


def response(numerator: Sequence[float], denominator: Sequence[float], u: np.ndarray, step: float) -> np.ndarray:
    """From rest, the input linear between its samples."""
    b, a, _ = cont2discrete((numerator, denominator), step, method="foh")
    return np.asarray(lfilter(b[0], a, u))


def columns(
    signals: Signals, step: float, a: float, d: float, terms: Sequence[Term], filtered: Sequence[str], offset: bool
) -> np.ndarray:
    """Responses to each term, then free motions of the link and of the filter, and the response to a constant."""
    link = np.array([1.0, -d, -a])
    out = []
    for name, order in terms:
        u = signals[name] - (signals[name][0] if order else 0.0)
        power = np.array([1.0] + [0.0] * order)
        if name in filtered:
            out.append(response(power, link, u, step))
        else:
            out.append(response(STOCK[-1] * power, np.polymul(link, STOCK), u, step))
    impulse = np.zeros(len(u))
    impulse[0] = 1.0
    for denominator in (link, STOCK):
        poles = np.roots(denominator)
        free = lfilter([1.0], np.real(np.poly(np.exp(poles * step))), impulse)
        out += [free, np.r_[0.0, free[:-1]]]
    if offset:
        out.append(response([1.0], link, np.ones(len(u)), step))
    return np.array(out).T


def projected(
    signals: Signals,
    step: float,
    output: str,
    point: Sequence[float],
    terms: Sequence[Term],
    *,
    filtered: Sequence[str],
    offset: bool = False,
    fixed: np.ndarray | None = None,
    first: float | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of the terms, unless known (all, or the first), and what is left over."""
    table = columns(signals, step, *point, terms, filtered, offset)
    y, count = signals[output], len(terms)
    if fixed is not None:
        y = y - table[:, :count] @ fixed
        table = table[:, count:]
    elif first is not None:
        y = y - first * table[:, 0]
        table = table[:, 1:]
    scale = np.linalg.norm(table, axis=0)
    solution = np.linalg.lstsq(table / scale, y, rcond=1e-12)[0] / scale
    residual = y - table @ solution
    if fixed is not None:
        return fixed, residual
    return (solution[:count] if first is None else np.r_[first, solution[: count - 1]]), residual


def fit(y: np.ndarray, residual: np.ndarray) -> float:
    """Fit of a free run that leaves this."""
    return 100.0 * (1.0 - float(np.linalg.norm(residual) / np.linalg.norm(y - y.mean())))


def fitted(
    signals: Signals,
    step: float,
    output: str,
    terms: Sequence[Term],
    starts: Sequence[tuple[float, float]],
    *,
    filtered: Sequence[str],
    offset: bool = False,
    first: float | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness and damping of the best of several descents, and the coefficients of the terms there."""
    best, size = None, np.linalg.norm(signals[output])
    options: dict[str, Any] = {"filtered": filtered, "offset": offset, "first": first}
    for start in starts:
        scale = np.abs(np.array(start))

        def missed(z: np.ndarray, scale: np.ndarray = scale) -> np.ndarray:
            return projected(signals, step, output, z * scale, terms, **options)[1] / size

        end = least_squares(missed, np.sign(start))
        if best is None or end.cost < best[0]:
            best = (end.cost, end.x * scale)
    assert best is not None
    coefficients, _ = projected(signals, step, output, best[1], terms, **options)
    return best[1], coefficients
