"""Instrumental variables start from state-variable filters, which drift does not outweigh."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

import ftlm


@pytest.mark.parametrize("seed", range(3))
def test_instruments_find_a_resonance_in_noise(seed: int) -> None:
    g = np.random.default_rng(100 + seed)
    u = np.repeat(g.choice([-1.0, 1.0], 301), 10)[:3000]
    b, a, _ = cont2discrete(([100.0], [1.0, 0.4, 100.0]), 0.02)[:3]
    y = lfilter(np.ravel(b), a, u)
    y = y + np.std(y) * 10**-0.5 * g.standard_normal(3000)
    run = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": y})
    equation = ftlm.equation("D^2 y = -a1 D y - a0 y + b0 u", initial="rest")
    found = ftlm.identify(run, equation, method=ftlm.InstrumentalVariables()).coefficients
    assert found["a0"] == pytest.approx(100.0, rel=0.05)
    assert found["b0"] == pytest.approx(100.0, rel=0.05)
    assert found["a1"] == pytest.approx(0.4, rel=0.25)
