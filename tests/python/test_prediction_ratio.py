"""Likelihood ratio of regressions under autoregressive noise, against one regression at a time by NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

from ftlm import _core
from slow_cases import slow_after

MOST = 8


def autoregressions(series, most):
    """Criterion and filter of every order, of the series and of their increments; rows from number ``most`` on."""
    rows = sum(len(x) - most for x in series)
    for difference in ([1.0], [1.0, -1.0]):
        passed = [np.convolve(x, difference)[: len(x)] for x in series]
        for order in range(most + 2 - len(difference)):
            lags = np.concatenate([[x[t - 1 - np.arange(order)] for t in range(most, len(x))] for x in passed]).reshape(
                rows, order
            )
            now = np.concatenate([x[most:] for x in passed])
            factors = np.linalg.lstsq(lags, now, rcond=None)[0]
            power = np.mean((now - lags @ factors) ** 2)
            penalty = 2 * order + (np.log(rows) if len(difference) == 1 else 0)
            yield rows * np.log(power) + penalty, np.convolve(np.append(1.0, -factors), difference), power


def criterion(columns, residuals, outputs, limits):
    """Least criterion over alternations of noise and amounts, and the orders of the noise."""
    amounts, best, orders = columns.T @ residuals, np.inf, limits
    for _ in range(4):
        noise = residuals - columns @ amounts
        fits = [
            min(autoregressions([noise[a:b] for a, b in places], most), key=lambda fit: fit[0])
            for places, most in zip(outputs, limits, strict=True)
        ]
        if not sum(f[0] for f in fits) < best:
            break
        best, orders = sum(f[0] for f in fits), [len(f[1]) - 1 for f in fits]
        both = np.column_stack([columns, residuals])
        white = np.concatenate(
            [
                lfilter(f[1], [1.0], both[a:b], axis=0)[most:] / np.sqrt(f[2])
                for f, places, most in zip(fits, outputs, limits, strict=True)
                for a, b in places
            ]
        )
        amounts = np.linalg.lstsq(white[:, :-1], white[:, -1], rcond=1e-10)[0]
    return best, orders


def ratio(few, many, residuals, outputs):
    limits = [min(MOST, min(b - a for a, b in places) // 10) for places in outputs]
    orders = [criterion(columns, residuals, outputs, limits)[1] for columns in (few, many)]
    common = [max(pair) for pair in zip(*orders, strict=True)]
    one, other = (criterion(columns, residuals, outputs, common)[0] for columns in (few, many))
    return max(one - other, 0.0)


NOISES = {"white": [1.0], "of a lag": [1.0, -0.9], "of motion": [1.0, -1.6, 0.8], "walking": [1.0, -1.0]}


@pytest.mark.parametrize("kind", NOISES)
@slow_after(1, "seed", range(3))
def test_the_ratio_is_that_of_regressions_one_by_one(kind, seed):
    g = np.random.default_rng([seed, 3])
    outputs = [[(0, 150), (150, 240)], [(240, 300)]]
    noise = np.concatenate([lfilter([1.0], NOISES[kind], g.standard_normal(b - a)) for p in outputs for a, b in p])
    raw = np.column_stack([g.standard_normal((300, 2)), np.ones(300)])
    many = np.linalg.qr(raw)[0]
    few, residuals = many[:, :2], noise - many[:, :2] @ (many[:, :2].T @ noise) + 0.3 * seed
    got = _core.prediction_ratio(np.ascontiguousarray(few.T), np.ascontiguousarray(many.T), residuals, outputs, MOST)
    assert got == pytest.approx(ratio(few, many, residuals, outputs), rel=1e-7, abs=1e-7)


@pytest.mark.parametrize("kind", NOISES)
def test_a_mean_that_is_not_there_is_seldom_significant(kind):
    one = np.full((1, 400), 400**-0.5)
    alarms = 0
    for seed in range(100):
        noise = lfilter([1.0], NOISES[kind], np.random.default_rng([seed, 4]).standard_normal(400))
        alarms += _core.prediction_ratio(np.zeros((0, 400)), one, noise, [[(0, 400)]], MOST) > chi2.ppf(0.99, 1)
    assert alarms <= 5
