"""Exact simulation of integer orders: against SciPy's discretization, closed forms, and the refined pulse grids."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import cont2discrete, dlsim, lfilter

import ftlm
from ftlm.simulation import step_refinement
from ftlm.simulation.output_samples import output_simulation
from ftlm.simulation.step_refinement import simulate_refined
from slow_cases import slow_after

STEP = 0.05


def moves(rows: int, seed: int, *, every: int = 3) -> np.ndarray:
    """Steps of random height."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.standard_normal(rows // every + 1), every)[:rows]


def record(rows: int = 400, *, kind: str = "zoh", outputs: Any = ("y",), step: float = STEP, **more: Any) -> ftlm.Run:
    inputs = {"u": moves(rows, 1), "v": moves(rows, 2, every=7)} | more
    return ftlm.Run.from_arrays(
        step=step,
        inputs=inputs,
        outputs={name: np.zeros(rows) for name in outputs},
        intersample=dict.fromkeys(inputs, kind),
    )


def on_grids(model: ftlm.Model, run: ftlm.Run, monkeypatch: pytest.MonkeyPatch, **more: Any) -> Any:
    """Simulation of the same run on refined pulse grids."""
    with monkeypatch.context() as changed:
        changed.setattr(step_refinement, "exact_samples", lambda *_: None)
        return simulate_refined(model, run, **{"initial": {}, "tolerance": 1e-8, "max_m": 1 << 18, **more})


def exact(model: ftlm.Model, run: ftlm.Run, initial: dict) -> Any:
    """Exact samples with these initial terms, or None."""
    core, terms = output_simulation(model, run, initial, None, 1)
    return core.exact_samples(terms)


def apart(found: np.ndarray, truth: np.ndarray) -> float:
    """Largest difference relative to the largest value of the truth."""
    return float(np.max(np.abs(found - truth)) / np.max(np.abs(truth)))


def random_poles(rng: np.random.Generator, order: int, fastest: float) -> np.ndarray:
    """Coefficients of a polynomial with real and complex roots; the slowest may grow a little over the record."""
    roots: list[complex] = []
    while len(roots) < order:
        size = fastest ** rng.uniform(-0.3, 1.0)
        if order - len(roots) > 1 and rng.random() < 0.6:
            damping = rng.uniform(-0.005, 0.9)
            pair = size * complex(-damping, math.sqrt(1.0 - damping**2))
            roots += [pair, pair.conjugate()]
        else:
            roots.append(complex(-size, 0.0))
    return np.real(np.poly(roots))


def words(last: np.ndarray, top: list[float], name: str = "u") -> str:
    """D^n y = ... with these coefficients, highest derivative first."""
    n = len(last) - 1
    own = [f"{-c!r} D^{n - k} y" for k, c in enumerate(last.tolist()) if k]
    driven = [f"{c!r} D^{len(top) - 1 - k} {name}" for k, c in enumerate(top)]
    return f"D^{n} y = " + " + ".join([*own, *driven]).replace("+ -", "- ")


@pytest.mark.parametrize("order", range(1, 7))
@slow_after(1, "seeds", [1, 12])
def test_random_systems_with_zeros_and_feedthrough_follow_scipy(order, seeds):
    for seed in range(seeds):
        rng = np.random.default_rng([order, seed])
        last = random_poles(rng, order, fastest=30.0)
        top = rng.standard_normal(rng.integers(1, order + 2)).tolist()
        run = record(2000)
        y = ftlm.Model(ftlm.equation(words(last, top))).simulate(run)["y"]
        a, b, c, d = state_matrices(last, top)
        discrete = cont2discrete((a, b, c, d), STEP, method="zoh")
        truth = dlsim((*discrete[:4], STEP), run["u"][:, None])[1][:, 0]
        assert apart(y, truth) < 1e-9, (order, seed)


def state_matrices(last: np.ndarray, top: list[float]) -> tuple[np.ndarray, ...]:
    """Controllable form of top(s) / last(s), in a unit of time that keeps its entries near 1."""
    n = len(last) - 1
    unit = abs(last[-1]) ** (1.0 / n)
    below = (last * unit ** np.arange(0.0, -n - 1.0, -1.0))[::-1]
    above = np.concatenate([top[::-1], np.zeros(n + 1 - len(top))]) * unit ** np.arange(-n, 1.0)
    a = unit * np.vstack([np.eye(n)[1:], -below[:n]])
    return a, unit * np.eye(n)[:, -1:], (above - above[n] * below)[None, :n], above[None, n:]


@pytest.mark.parametrize("seed", range(12))
def test_random_coupled_systems_follow_scipy(seed):
    rng = np.random.default_rng([3, seed])
    c, damping = rng.standard_normal(7).tolist(), rng.uniform(0.5, 3.0, 2).tolist()
    text = (
        f"D^2 y = -20 y - {damping[0]!r} D y + {c[0]!r} z + {c[1]!r} D z + {c[2]!r} u\n"
        f"D z = -{damping[1]!r} z + {c[3]!r} y + {c[4]!r} D y + {c[5]!r} v + {c[6]!r} D v"
    ).replace("+ -", "- ")
    slope = np.array([c[3], c[4], -damping[1]])
    a = np.array([[0.0, 1.0, 0.0], [-20.0, -damping[0], c[0]] + c[1] * slope, slope])
    # The states are continuous: y, and D y and z without their jumps with v.
    jump = np.array([[0.0, 0.0], [0.0, c[1] * c[6]], [0.0, c[6]]])
    b = np.array([[0.0, 0.0], [c[2], c[1] * c[5]], [0.0, c[5]]]) + a @ jump
    read, direct = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([[0.0, 0.0], [0.0, c[6]]])
    run = record(1000, outputs=("y", "z"))
    found = ftlm.Model(ftlm.equation(text, coupling="simulated")).simulate(run)
    discrete = cont2discrete((a, b, read, direct), STEP, method="zoh")
    truth = dlsim((*discrete[:4], STEP), np.stack([run["u"], run["v"]], axis=1))[1].T
    for name, exact in zip(("y", "z"), truth, strict=True):
        assert apart(found[name], exact) < 1e-9


@pytest.mark.parametrize("kind", ["zoh", "foh"])
@pytest.mark.parametrize("seed", range(6))
def test_the_same_as_on_refined_grids(kind, seed, monkeypatch):
    rng = np.random.default_rng([7, seed])
    last = random_poles(rng, int(rng.integers(1, 5)), fastest=6.0)
    top = rng.standard_normal(rng.integers(1, len(last) + 1)).tolist()
    model, run = ftlm.Model(ftlm.equation(words(last, top))), record(kind=kind)
    terms = {"y": {0.0: 0.7, 1.0: -0.4, 3.0: 0.01}}
    exact, grids = simulate_refined(model, run, terms, tolerance=1e-6), on_grids(model, run, monkeypatch, initial=terms)
    assert exact.refinement == 1
    assert not exact.change.any()
    assert exact.initial == terms
    assert apart(exact.outputs, grids.outputs) < 1e-6


#: Structures of integer orders of every kind that runs have.
STRUCTURES = {
    "coupled": ("D^2 y = -9 y - D y + 2 z + u\nD z = -3 z - y + v", {"coupling": "simulated"}),
    "coupled at the highest order": (
        "D^2 y = -9 y - D y + 0.5 D^2 z + u\nD^2 z = -4 z - D z + 0.6 D^2 y + D v",
        {"coupling": "simulated"},
    ),
    "coupled through feedthrough": ("D y = -2 y + 0.5 D z\nD z = -z + D u + 0.3 D y + v", {"coupling": "simulated"}),
    "measured": ("D^2 y = -9 y - D y + 2 z + u\nD z = -3 z - y + v", {"coupling": "measured"}),
    "an integral of an input": ("D y = -2 y + u + 0.3 D^-1 v", {}),
    "a double integrator": ("D^2 y = u - v", {}),
    "a whole delay": ("D^2 y = -9 y - D y + u + 0.4 v", {"delay": {"u": 3 * STEP}}),
    "a fractional delay": ("D^2 y = -9 y - D y + u + 0.4 v", {"delay": {"u": 2.35 * STEP, "v": 0.2 * STEP}}),
    "a delayed feedthrough": ("D y = -2 y + D u + 0.4 v", {"delay": {"u": 1.5 * STEP}}),
    "a saturation": ("D^2 y = -9 y - D y + u", {"saturation": {"u": 0.8}}),
}


@pytest.mark.parametrize("kind", ["zoh", "foh"])
@pytest.mark.parametrize("case", STRUCTURES)
def test_structures_respond_as_on_refined_grids(case, kind, monkeypatch):
    text, more = STRUCTURES[case]
    model = ftlm.Model(ftlm.equation(text, **more))
    run = record(kind=kind, outputs=("y", "z"))
    if case == "measured":
        t = STEP * np.arange(run.length)
        run = run.with_outputs({"y": np.sin(2 * t), "z": np.cos(1.3 * t) - 1.0})
    exact, grids = simulate_refined(model, run, {}, tolerance=1e-6), on_grids(model, run, monkeypatch)
    assert exact.refinement == 1
    for found, truth in zip(exact.outputs, grids.outputs, strict=True):
        # A delay of a part of an interval converges with the first power of the step on the grids.
        assert apart(found, truth) < (1e-6 + 5 * float(np.max(grids.change)))


@pytest.mark.parametrize("delay", [0.0, 1.0, 0.3, 2.0, 4.75, 1e6])
def test_delays_of_a_held_input_follow_the_matrix_exponential(delay):
    a, run = np.array([[0.0, 1.0], [-9.0, -0.8]]), record(300)
    y = ftlm.Model(ftlm.equation("D^2 y = -9 y - 0.8 D y + 9 u", delay={"u": delay * STEP})).simulate(run)["y"]
    late = math.floor(delay)
    rest = 1.0 - (delay - late)
    whole = np.zeros((3, 3))
    whole[:2, :2], whole[1, 2] = a, 9.0

    def propagate(share: float, value: float, state: np.ndarray) -> np.ndarray:
        return (expm(share * STEP * whole) @ [*state, value])[:2]

    state, truth = np.zeros(2), []
    for k in range(300):
        truth.append(state[0])
        earlier, later = (run["u"][j] if j >= 0 else 0.0 for j in (k - late - 1, k - late))
        state = propagate(rest, later, propagate(1.0 - rest, earlier, state))
    assert np.max(np.abs(y - truth)) < 1e-11


def test_an_input_before_a_run_in_motion_has_its_first_value(monkeypatch):
    t = STEP * np.arange(400)
    run = record().with_outputs({"y": 1.0 + np.sin(t)})
    model = ftlm.Model(ftlm.equation("D^2 y = -9 y - D y + u", delay={"u": 2.5 * STEP}))
    exact, grids = simulate_refined(model, run, {}, tolerance=1e-6), on_grids(model, run, monkeypatch)
    assert apart(exact.outputs, grids.outputs) < 1e-6


@pytest.mark.parametrize("coupling", ["simulated", "measured"])
@pytest.mark.parametrize("offset", ["none", "constant"])
def test_initial_terms_are_fitted_as_on_refined_grids(coupling, offset, monkeypatch):
    rng, t = np.random.default_rng(5), STEP * np.arange(400)
    run = record(outputs=("y", "z")).with_outputs(
        {"y": 1.0 + np.sin(2.0 * t) + 0.1 * rng.standard_normal(400), "z": 0.5 - np.cos(1.3 * t)}
    )
    text = "D^2 y = -9 y - D y + 2 z + u\nD z = -3 z - y + v"
    model = ftlm.Model(ftlm.equation(text, coupling=coupling, offset=offset))
    exact = simulate_refined(model, run, None, tolerance=1e-6)
    grids = on_grids(model, run, monkeypatch, initial=None)
    assert exact.refinement == 1
    for found, truth in zip(exact.outputs, grids.outputs, strict=True):
        assert apart(found, truth) < 1e-6
    for output, powers in grids.initial.items():
        assert exact.initial[output] == pytest.approx(powers, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("rows", [20_000, 300_000])
def test_three_lags_on_long_records_follow_a_filter(rows):
    b, a, _ = cont2discrete(([60.0], [1, 8, 40, 60.0]), 0.02)[:3]
    run = record(rows, step=0.02)
    y = ftlm.Model(ftlm.equation("D^3 y = -8 D^2 y - 40 D y - 60 y + 60 u")).simulate(run)["y"]
    assert apart(y, lfilter(np.ravel(b), a, run["u"])) < 1e-8


def test_poles_eight_decades_apart_keep_their_digits():
    # Partial fractions: a pole at 1e6 per second follows the slow one without delay.
    run = record(20_000)
    fast, slow = 1e6, 1e-2
    model = ftlm.equation(f"D^2 y = -{fast + slow!r} D y - {fast * slow!r} y + {fast * slow!r} u")
    y = ftlm.Model(model).simulate(run)["y"]
    truth = np.zeros(run.length)
    for pole, share in ((slow, fast / (fast - slow)), (fast, -slow / (fast - slow))):
        gain = -math.expm1(-pole * STEP)
        truth += share * lfilter([0.0, gain], [1.0, gain - 1.0], run["u"])
    assert apart(y, truth) < 1e-12


def test_fractional_orders_filters_and_friction_use_the_grid():
    run = record()
    for item in (
        ftlm.equation("D^1.5 y = -2 y + u"),
        ftlm.equation("D^2 y = -9 y + D^0.5 u"),
        ftlm.equation("D y = -y + u", sensor_filter=ftlm.SensorFilter.low_pass(["y"], 3.0, 0.7)),
    ):
        assert exact(ftlm.Model(item), run, {}) is None
    lag = ftlm.Model(ftlm.equation("D y = -y + u"))
    assert exact(lag, run, {"y": {0.5: 1.0}}) is None
    assert exact(lag, run, {"y": {0.0: 1.0}}) is not None


def test_singular_equations_are_refused():
    model = ftlm.Model(ftlm.equation("D y = D z - y + u\nD z = D y - z", coupling="simulated"))
    assert exact(model, record(outputs=("y", "z")), {}) is None
    with pytest.raises(ftlm.ModelError, match="singular"):
        model.simulate(record(outputs=("y", "z")))


def test_an_unstable_model_names_the_time_of_its_overflow():
    run = ftlm.Run.from_arrays(step=0.1, inputs={"u": np.ones(2001)}, outputs={"y": np.zeros(2001)})
    with pytest.raises(ftlm.ConvergenceError, match=r"the simulation of y overflows 14\d\.?\d* s"):
        ftlm.Model(ftlm.equation("D^1 y = 5 y + u")).simulate(run)
    with pytest.raises(ftlm.ConvergenceError, match="overflows"):
        ftlm.Model(ftlm.equation("D^2 y = 1e9 y + u")).simulate(run)


def test_terms_of_another_number_of_equations_are_refused():
    core, _ = output_simulation(ftlm.Model(ftlm.equation("D y = -y + u")), record(), {}, None, 1)
    with pytest.raises(ftlm.DataError, match="initial terms has length 2, but 1 is needed"):
        core.exact_samples((False, [[], []], False))


@pytest.mark.parametrize("exponent", [200.0, 1e300])
def test_exponents_of_more_states_than_are_simulated_are_left_to_the_series(exponent):
    assert exact(ftlm.Model(ftlm.equation("D^2 y = -y + u")), record(), {"y": {exponent: 1.0}}) is None


@pytest.mark.parametrize("order", [4e-10, 1e-9, 1.1e-9])
def test_an_order_off_an_integer_by_rounding_is_simulated(order):
    # The search for an order ends where a bound lies, off it by rounding.
    u = np.repeat(np.random.default_rng(1).choice([-1.0, 1.0], 20), 10)
    run = ftlm.Run.from_arrays(step=0.1, inputs={"u": u}, outputs={"y": np.zeros(200)})
    near, whole = (
        ftlm.Model(ftlm.equation(f"D^2 y = -1.0 D y - 2.0 D^{nu!r} y + 1.0 u")).simulate(run)["y"]
        for nu in (order, 0.0)
    )
    np.testing.assert_allclose(near, whole, atol=1e-6)
