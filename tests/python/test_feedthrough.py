"""Direct feed-through: y[k] belongs to t_k after u[k] acts, as SciPy samples C x[k] + D u[k]."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import mpmath
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.signal import dlsim, lsim, lti
from scipy.special import gamma

import ftlm
import loops
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Iterate, Objective
from ftlm.estimation.output_error import JointFit, fit_output_error
from ftlm.simulation.output_samples import simulate_samples as one_grid
from slow_cases import slow_after

STEP = 0.1
#: (0.5 s + 1)/(s + 1): y' = 0.5 u' + u - y.
LEAD = replace(ftlm.equation("D y = d D u + a y + b u"), initial="rest")
LEAD_TRUTH = {"d": 0.5, "a": -1.0, "b": 1.0}
LEAD_SYSTEM = ([0.5, 1.0], [1.0, 1.0])
#: Torque to acceleration: (0.8 s^2 + 2)/(s^2 + 0.6 s + 4).
SECOND = replace(ftlm.equation("D^2 y = c D^2 u + d D y + a y + b u"), initial="rest")
SECOND_TRUTH = {"c": 0.8, "d": -0.6, "a": -4.0, "b": 2.0}
SECOND_SYSTEM = ([0.8, 0.0, 2.0], [1.0, 0.6, 4.0])


def sampled(system: tuple, rows: int, seed: int, intersample: str, noise: float) -> ftlm.Run:
    """A run as SciPy samples it: a random command held, or random samples joined by lines, and white noise."""
    rng = np.random.default_rng(seed)
    t = STEP * np.arange(rows)
    u = rng.standard_normal(rows)
    u[0] = 0.0
    if intersample == "zoh":
        y = dlsim(lti(*system).to_discrete(STEP), u)[1][:, 0]
    else:
        y = lsim(lti(*system), u, t, interp=True)[1]
    y = y + noise * np.std(y) * rng.standard_normal(rows)
    return ftlm.Run.from_arrays(step=STEP, outputs={"y": y}, inputs={"u": u}, intersample={"u": intersample})


def scores(found: JointFit, truth: dict[str, float]) -> np.ndarray:
    return np.array([(found.coefficients[n] - v) / found.standard_errors[n] for n, v in truth.items()])


@pytest.mark.parametrize("intersample", ["zoh", "foh"])
@pytest.mark.parametrize(
    ("words", "system", "truth"), [(LEAD, LEAD_SYSTEM, LEAD_TRUTH), (SECOND, SECOND_SYSTEM, SECOND_TRUTH)]
)
def test_without_noise_the_coefficients_are_those_of_the_system(words, system, truth, intersample: str) -> None:
    found = fit_output_error([sampled(system, 60, 1, intersample, 0.0)], words)
    for name, value in truth.items():
        assert found.coefficients[name] == pytest.approx(value, abs=1e-3), name


@pytest.mark.parametrize("intersample", ["zoh", "foh"])
@pytest.mark.parametrize(
    ("words", "system", "truth"), [(LEAD, LEAD_SYSTEM, LEAD_TRUTH), (SECOND, SECOND_SYSTEM, SECOND_TRUTH)]
)
@slow_after(1, "seeds", [6, 10])
def test_the_truth_lies_within_three_standard_errors(words, system, truth, intersample: str, seeds: int) -> None:
    z = np.array(
        [
            scores(fit_output_error([sampled(system, 600, seed, intersample, 0.01)], words), truth)
            for seed in range(seeds)
        ]
    )
    assert np.max(np.abs(z)) < 3.0
    # A bias of half an error, or errors of half the size, would show.
    assert 0.4 < np.sqrt(np.mean(z**2)) < 1.6


@pytest.mark.parametrize("hold", ["zoh", "foh"])
@slow_after(1, "seeds", [2, 4])
def test_a_cell_with_a_constant_phase_element_feeds_through(hold: str, seeds: int) -> None:
    # 5 Ohm at once, a diffusive rest of order 0.78; the truth follows from its spectrum of relaxations.
    scored = []
    for seed in range(seeds):
        found = ftlm.identify(loops.cell_run(800, 0.02, hold, seed, noise=0.01), loops.CELL_STRUCTURE)
        scored.append([(found.parameters[n].value - v) / found.standard_errors[n] for n, v in loops.CELL.items()])
        assert found.standard_errors["d"] < 0.02
    assert np.max(np.abs(scored)) < 3.5
    assert np.mean(np.abs(scored) < 1.96) >= 0.8


@slow_after(1, "hold", ["zoh", "foh"])
def test_a_cell_without_noise_is_itself(hold: str) -> None:
    found = ftlm.identify(loops.cell_run(400, 0.05, hold, 1, noise=0.0), loops.CELL_STRUCTURE)
    for name, value in loops.CELL.items():
        assert found.parameters[name].value == pytest.approx(value, rel=2e-4)


def test_the_relaxation_of_the_cell_is_the_series_of_mittag_leffler() -> None:
    t = np.array([0.01, 0.4, 3.0, 9.0])
    with mpmath.workdps(40):
        for alpha, rate in ((0.78, 1 / 3), (1.7, 4.0)):
            for integral, second in ((False, 1), (True, 2)):
                exact = [
                    float(
                        x ** (second - 1)
                        * mpmath.nsum(
                            lambda k, x=x, alpha=alpha, rate=rate, second=second: (
                                (-rate * mpmath.mpf(x) ** alpha) ** k / mpmath.gamma(alpha * k + second)
                            ),
                            [0, mpmath.inf],
                        )
                    )
                    for x in map(float, t[:3])
                ]
                np.testing.assert_allclose(
                    loops.relaxation(t[:3], alpha, rate, integral=integral), exact, rtol=1e-9, atol=1e-12
                )


@slow_after(3, "excess", [0.3, 0.6, 0.9, 0.99])
def test_a_ramp_that_starts_with_a_jump_is_differentiated_more_often_than_the_output(excess: float) -> None:
    """y' = -2 y + D^(1 + e) u answers with D^e u and its convolution with an exponential, by their closed forms."""
    jump, slope, rows = 0.17, 0.5, 401
    t = 0.01 * np.arange(rows)
    still = ftlm.Run.from_arrays(
        step=0.01, inputs={"u": jump + slope * t}, outputs={"y": 0.0 * t}, intersample={"u": "foh"}
    )
    made = ftlm.equation("D y = -2 y + b D^g u", fixed={"b": 1.0}).with_orders({"g": 1.0 + excess})
    samples = ftlm.Model(replace(made, initial="rest")).simulate(still)["y"]
    jumps, ramps = jump / gamma(1.0 - excess), slope / gamma(2.0 - excess)
    for k in (1, 2, 5, 20, 100, 399, 400):
        end = t[k]
        now = jumps * end**-excess + ramps * end ** (1.0 - excess)
        kink = quad(lambda s, e=end: np.exp(-2.0 * (e - s)), 0.0, end, weight="alg", wvar=(-excess, 0.0))[0]
        rest = quad(lambda s, e=end: np.exp(-2.0 * (e - s)) * s ** (1.0 - excess), 0.0, end)[0]
        exact = now - 2.0 * (jumps * kink + ramps * rest)
        assert samples[k] == pytest.approx(exact, abs=2e-6), k


#: What is made of a corner t at 0: b t^(1 - excess) E(a t^alpha), term by term.
CORNERS = [(1.4, 2.0, -3.0), (1.4, 1.6, -3.0), (1.9, 2.0, -40.0), (1.4, 1.0, -3.0), (0.9, 0.9, -2.0)]


def answer_to_corners(alpha: float, order: float, a: float, corners: np.ndarray, step: float) -> np.ndarray:
    """D^alpha y = a y + D^order u for u with these changes of its slope at the samples, by Mittag-Leffler's series."""
    t = step * np.arange(corners.size)
    with np.errstate(divide="ignore"):
        powers = [alpha * (k + 1) - order + 1.0 for k in range(90)]
        terms = [a**k * np.where(t > 0, t, 0.0) ** p / gamma(p + 1.0) for k, p in enumerate(powers)]
    return np.asarray(np.convolve(corners, np.sum(terms, axis=0))[: corners.size])


@pytest.mark.parametrize(("alpha", "order", "a"), CORNERS)
def test_samples_at_corners_are_read_to_second_order(alpha: float, order: float, a: float) -> None:
    # Half of what a pulse answers to the corner in it would leave h^(1 + alpha - order): at 0.6 above alpha h^0.4.
    rng = np.random.default_rng(4)
    step, rows = 0.05, 41
    u = np.concatenate([[0.0], np.cumsum(rng.standard_normal(rows - 1))]) * step
    corners = np.diff(np.diff(u) / step, prepend=0.0)
    truth = answer_to_corners(alpha, order, a, np.append(corners, 0.0), step)
    run = ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": truth}, intersample={"u": "foh"})
    structure = replace(ftlm.equation(f"D^{alpha} y = a y + b D^{order} u"), initial="rest")
    problem = FreeProblem.of(structure)
    scale = float(np.max(np.abs(truth)))
    fitted, free = [], []
    model = ftlm.Model(replace(ftlm.equation(f"D^{alpha} y = {a:g} y + 1 D^{order} u"), initial="rest"))
    for every in (8, 16, 32):
        grid = Objective(problem, [run], [1.0 / scale], every)
        values = {"a": a, "b": 1.0}
        start = Iterate([], [values[n] for n in problem.coefficients], "truth", {})
        fitted.append(float(np.max(np.abs(grid.evaluate(start).outcome["residuals"]))))
        free.append(float(np.max(np.abs(one_grid(model, run, every, None)[0][0] - truth)[1:-1])) / scale)
    for errors in (fitted, free):
        assert errors[-1] < 1e-3
        assert all(fine < coarse / 3.0 for coarse, fine in pairwise(errors)), errors


@pytest.mark.parametrize("behind", [False, True])
def test_slopes_of_a_term_above_its_equation_are_those_of_differences(behind):
    """Kernels below order 0 and powers of t that are infinite at 0, behind a filter too, turned with both orders."""
    rng = np.random.default_rng(0)
    driven = np.cumsum(np.cumsum(rng.standard_normal(400))) * 1e-2
    outputs = {"y": np.sin(np.arange(400) * 0.02), "u": driven}
    run = ftlm.Run.from_arrays(step=0.02, outputs=outputs, inputs={"v": np.zeros(400)})
    sensor = ftlm.SensorFilter.low_pass(["y", "u"]) if behind else None
    problem = FreeProblem.of(
        ftlm.equation("D^alpha y = a y + b D^gamma u", initial="caputo", offset="none", sensor_filter=sensor)
    )
    grid, point = Objective(problem, [run], [1.0]), np.array([1.3, 1.8])

    def at(orders, evaluations):
        start = Iterate(list(orders), [-4.0, 2.0], "here", {})
        return grid.minimize(start, evaluations, linear_scale=True, fixed=[2, 3]).outcome

    there, shift = at(point, 1), 1e-4
    residuals = np.asarray(there["residuals"])
    for k, slope in enumerate(np.asarray(there["jacobian"])[:2]):
        up, down = (np.asarray(at(point + s * shift * np.eye(2)[k], 0)["residuals"]) for s in (1, -1))
        # Initial terms are projected out of both, so what counts is the slope of the sum of squares.
        assert slope @ residuals == pytest.approx((up - down) @ residuals / (2 * shift), rel=1e-5)


@pytest.mark.parametrize("samples", [150, 600])
def test_a_resistor_under_a_constant_current_is_no_level(samples):
    """Voltage of R + Q^-1 s^-0.5 at a constant current: R and an output level would be collinear."""
    t = 0.02 * np.arange(samples)
    clean = 2.0 + 3.0 * np.sqrt(t) / 0.886226925452758
    for seed in range(4):
        y = clean + 0.01 * clean.std() * np.random.default_rng(seed).standard_normal(samples)
        run = ftlm.Run.from_arrays(step=0.02, inputs={"u": np.ones(samples)}, outputs={"y": y})
        found = ftlm.identify(run, ftlm.equation("D^alpha y = r D^alpha u + b u"))
        assert found.joint.initial == "rest"
        assert "not_converged" not in {f.code for f in found.findings}
        for name, value in (("alpha", 0.5), ("r", 2.0), ("b", 3.0)):
            assert abs(found.parameters[name].value - value) < 4.0 * found.standard_errors[name]
            assert found.standard_errors[name] < 0.05 * value
