"""Equations of order above three: kernels against 60 digits, free runs and estimates against SciPy's state space."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from scipy.signal import lsim

import ftlm
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.kernels import block_pulse_kernel
from ftlm.simulation import step_refinement
from ftlm.structure.structure import Structure

#: Natural frequency [rad/s] and damping of each mode, and the length of the run [s].
MODES = {
    4: ([(3, 0.02), (7, 0.03)], 30.0),
    6: ([(2, 0.05), (3, 0.05), (5, 0.05)], 20.0),
    8: ([(1, 0.05), (2, 0.05), (3, 0.05), (4, 0.05)], 20.0),
}
STEP = 0.01
LENGTHS = (1, 2, 3, 4, 8, 9, 10, 64, 65, 66, 256, 257, 1025, 1026, 5000, 32769, 32770, 65537, 100003, 1 << 17)


def characteristic(modes: list[tuple[float, float]]) -> list[float]:
    """Coefficients of the product of s^2 + 2 zeta omega s + omega^2, highest first."""
    whole = np.array([1.0])
    for omega, damping in modes:
        whole = np.polymul(whole, [1.0, 2 * damping * omega, omega**2])
    return [float(c) for c in whole]


def written(modes: list[tuple[float, float]], *, free: bool = False) -> Structure:
    """All modes in one equation with static gain 1, its coefficients as numbers or as names c0, c1, …, b."""
    parts = characteristic(modes)
    n = len(parts) - 1
    if free:
        return ftlm.equation(f"D^{n} y = " + " + ".join(f"c{k} D^{k} y" for k in range(n)[::-1]) + " + b u")
    terms = " ".join(f"- {c!r} D^{n - i} y" for i, c in enumerate(parts) if i)
    return ftlm.equation(f"D^{n} y = {terms} + {parts[-1]!r} u")


def exact(modes: list[tuple[float, float]], u: np.ndarray, step: float, *, linear: bool) -> np.ndarray:
    """The same by SciPy's matrix exponential of the companion form."""
    parts = characteristic(modes)
    n = len(parts) - 1
    a, b, c = np.diag(np.ones(n - 1), 1), np.zeros((n, 1)), np.zeros((1, n))
    a[-1], b[-1], c[0, 0] = -np.array(parts[:0:-1]), parts[-1], 1.0
    return np.asarray(lsim((a, b, c, 0.0), u, np.arange(u.size) * step, interp=linear)[1])


@pytest.mark.parametrize("eta", [3.5, 5.0, 7.3, 10.0])
def test_kernels_are_exact(eta: float) -> None:
    kernel = block_pulse_kernel(eta, 1 << 17, step=1.0)
    slope = block_pulse_kernel(eta, 1 << 17, step=1.0, derivative=True)
    with mpmath.workdps(60):
        for n in LENGTHS:

            def printed(x: mpmath.mpf, n: int = n) -> mpmath.mpf:
                if n == 1:
                    return 1 / mpmath.gamma(x + 2)
                return (mpmath.mpf(n) ** (x + 1) - 2 * mpmath.mpf(n - 1) ** (x + 1) + mpmath.mpf(n - 2) ** (x + 1)) / (
                    mpmath.gamma(x + 2)
                )

            true, rise = printed(mpmath.mpf(eta)), mpmath.diff(printed, mpmath.mpf(eta))
            assert abs(kernel[n - 1] / true - 1) < 2e-14, n
            # The two parts of the derivative have opposite signs and may cancel.
            assert abs(slope[n - 1] - rise) < 2e-14 * max(abs(rise), abs(true)), n


@pytest.mark.parametrize("kind", ["zoh", "foh"])
@pytest.mark.parametrize("order", sorted(MODES))
def test_all_modes_in_one_equation_run_as_their_state_space(order: int, kind: str) -> None:
    modes, duration = MODES[order]
    rows, rng = round(duration / STEP), np.random.default_rng(order)
    steps = np.repeat(rng.standard_normal(rows // 50), 50)
    u = steps if kind == "zoh" else 0.1 * np.cumsum(rng.standard_normal(rows))
    run = ftlm.Run.from_arrays(inputs={"u": u}, outputs={"y": 0 * u}, step=STEP, intersample={"u": kind})
    found = ftlm.Model(written(modes)).simulate(run)["y"]
    y = exact(modes, u, STEP, linear=kind == "foh")
    assert np.max(np.abs(found - y)) < 1e-6 * np.max(np.abs(y))


def test_a_run_that_rounding_swamps_is_refused(monkeypatch) -> None:
    # Eight integrations of 20 s at 2 to 7 rad/s add up terms 10^10 times the response; a recursion does not.
    modes = [(2, 0.05), (3, 0.05), (5, 0.05), (7, 0.05)]
    u = np.repeat(np.random.default_rng(1).standard_normal(40), 50)
    run = ftlm.Run.from_arrays(inputs={"u": u}, outputs={"y": 0 * u}, step=STEP)
    found = ftlm.Model(written(modes)).simulate(run)["y"]
    expected = exact(modes, u, STEP, linear=False)
    assert np.max(np.abs(found - expected)) < 1e-6 * np.ptp(expected)
    monkeypatch.setattr(step_refinement, "exact_samples", lambda *_: None)
    with pytest.raises(ftlm.ConvergenceError, match="still changes by more than"):
        ftlm.Model(written(modes)).simulate(run, max_m=1 << 18)


def two_modes(seed: int) -> ftlm.Run:
    """A plant of two modes under a random square command at 40 dB."""
    modes, rng = MODES[4][0], np.random.default_rng(seed)
    u = np.repeat(np.where(rng.random(60) < 0.5, -1.0, 1.0), 25)
    y = exact(modes, u, 0.02, linear=False)
    return ftlm.Run.from_arrays(
        inputs={"u": u}, outputs={"y": y + 0.01 * np.std(y) * rng.standard_normal(y.size)}, step=0.02
    )


def test_two_modes_are_identified_from_an_automatic_start() -> None:
    modes = MODES[4][0]
    true = {f"c{k}": -c for k, c in enumerate(characteristic(modes)[:0:-1])} | {"b": characteristic(modes)[-1]}
    for seed in range(10):
        found = ftlm.identify(two_modes(seed), written(modes, free=True))
        for name, value in true.items():
            assert abs(found.coefficients[name] - value) < 3 * found.standard_errors[name], (seed, name)


def test_free_orders_are_sought_past_three_where_the_structure_says_so() -> None:
    def sought(words: str) -> dict[str, tuple[float, float]]:
        problem = FreeProblem.of(ftlm.equation(words))
        return dict(zip(problem.orders, problem.bounds, strict=True))

    assert sought("D^alpha y = a D^mu y + b u") == {"alpha": (0.05, 3.0), "mu": (0.0, 3.0)}
    assert sought("D^alpha y = a D^3 y + c y + b u") == {"alpha": (0.05, 4.0)}
    assert sought("D^4 y = a D^mu y + b u") == {"mu": (0.0, 4.0)}
