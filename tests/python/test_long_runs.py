"""Free runs of long records: against state space, closed forms of half orders, and the run on whole grids."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter, ss2tf
from scipy.special import erfcx

import ftlm
from ftlm.simulation import step_refinement as long
from ftlm.simulation.step_refinement import simulate_refined

STEP = 0.02


def switched(rows: int, *, every: int = 5000, seed: int = 0) -> np.ndarray:
    """A command that jumps now and then, and is anything in between."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.standard_normal(rows // every + 1), every)[:rows]


def record(rows: int, *, kind: str = "zoh", u: np.ndarray | None = None) -> ftlm.Run:
    u = switched(rows) if u is None else u
    zeros = np.zeros(u.size)
    return ftlm.Run.from_arrays(step=STEP, inputs={"u": u}, outputs={"y": zeros}, intersample={"u": kind})


def state_space(last: list[float], gain: float, u: np.ndarray, kind: str) -> np.ndarray:
    """Samples of D^n y = last · (y, D y, …) + gain u, by the matrix exponential of one step."""
    n = len(last)
    a = np.vstack([np.eye(n)[1:], last])
    b, c = gain * np.eye(n)[:, -1:], np.eye(n)[:1]
    top, bottom = ss2tf(*cont2discrete((a, b, c, np.zeros((1, 1))), STEP, method=kind)[:4])
    return lfilter(top[0], bottom, u)


def error(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.max(np.abs(found - truth)) / np.max(np.abs(truth)))


@pytest.mark.parametrize(("kind", "rows"), [("zoh", 300_001), ("foh", 40_001)])
def test_long_runs_of_whole_order_follow_state_space(kind, rows):
    rng = np.random.default_rng(1)
    u = switched(rows, every=40) + 0.2 * rng.standard_normal(rows)
    if kind == "foh":
        # SciPy takes what a ramp begins with for its first sample.
        u[0] = 0.0
    y = ftlm.Model(ftlm.equation("D^2 y = -40 y - 1.5 D y + 30 u")).simulate(record(u.size, kind=kind, u=u))["y"]
    assert error(y, state_space([-40.0, -1.5], 30.0, u, kind)) < 1e-6


def half_order(u: np.ndarray, rate: float) -> np.ndarray:
    """D^(1/2) y = rate (u - y) from rest: each jump is answered by 1 - exp(rate² t) erfc(rate √t)."""
    jumps = np.flatnonzero(np.diff(u, prepend=0.0))
    y = np.zeros(u.size)
    answer = 1.0 - erfcx(rate * np.sqrt(STEP * np.arange(u.size)))
    for k in jumps:
        y[k:] += (u[k] - (u[k - 1] if k else 0.0)) * answer[: u.size - k]
    return y


def test_six_hundred_thousand_samples_of_half_order_follow_the_closed_form():
    run = record(600_001, u=switched(600_001, every=30_000))
    y = ftlm.Model(ftlm.equation("D^0.5 y = -0.7 y + 0.7 u")).simulate(run)["y"]
    assert error(y, half_order(run["u"], 0.7)) < 1e-6


#: Structures whose answers to inputs and to what they start with are of every kind that a run has, and how inputs act.
EVERY = {
    "one order": ("D^1.4 y = -4 y + 2 u", "zoh", {}),
    "linear in between": ("D^1.7 y = -9 y - 0.4 D^0.6 y + 2 u + 0.3 D^0.8 u", "foh", {}),
    "two inputs, feed-through, delay": ("D^0.8 y = -2 y + 0.5 D^0.8 v + u", "zoh", {"delay": {"u": 0.03}}),
    "coupled": ("D^1.6 y = -9 y + 2 z + u\nD^0.9 z = -3 z - y + v", "zoh", {"coupling": "simulated"}),
    "each driven by the other": ("D^1.6 y = -9 y + 2 z + u\nD^0.9 z = -3 z - y + v", "zoh", {"coupling": "measured"}),
    "through a filter": (
        "D^1.5 y = -9 y + u",
        "zoh",
        {"sensor_filter": ftlm.SensorFilter.low_pass(["y"], 3.0, 0.7), "coupling": "simulated"},
    ),
    "a limit": ("D^1.4 y = -4 y + 2 u", "zoh", {"saturation": {"u": 0.8}}),
    "an offset": ("D^1.4 y = -4 y + 2 u + c", "zoh", {}),
}

#: None of an input that acted before the run began.
NONE = ("two inputs, feed-through, delay",)


def noisy(rows: int, kind: str, *, moving: bool) -> ftlm.Run:
    rng = np.random.default_rng(3)
    u, v = (np.repeat(rng.standard_normal(rows // 9 + 1), 9)[:rows] for _ in range(2))
    t = STEP * np.arange(rows)
    y, z = (0.3 * np.sin(w * t + (0.7 if moving else 0.0)) for w in (2.0, 1.3))
    inputs, outputs = {"u": u, "v": v}, {"y": y, "z": z}
    return ftlm.Run.from_arrays(step=STEP, inputs=inputs, outputs=outputs, intersample=dict.fromkeys(inputs, kind))


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("case", EVERY)
def test_the_same_run_as_on_whole_grids(case, moving, monkeypatch):
    words, kind, more = EVERY[case]
    model = ftlm.Model(ftlm.equation(words, **{"initial": "auto", **more}))
    run = noisy(1200, kind, moving=moving)
    whole = simulate_refined(model, run, None, tolerance=1e-6, max_m=1 << 16)
    monkeypatch.setattr(long, "LONG_RECORD_INTERVALS", 1000)
    pieces = simulate_refined(model, run, None, tolerance=1e-6, max_m=1 << 16)
    assert case in NONE or not np.array_equal(pieces.outputs, whole.outputs)
    assert pieces.refinement < whole.refinement or moving
    size = np.max(np.abs(whole.outputs), axis=1)
    apart = np.max(np.abs(pieces.outputs - whole.outputs), axis=1) / size
    assert np.all(apart < 1e-6 + 3.0 * (pieces.change + whole.change))
    assert {o: set(p) for o, p in pieces.initial.items()} == {o: set(p) for o, p in whole.initial.items()}


@pytest.mark.parametrize("words", ["D^2 y = -15000 y - 4 D y + u", "D^1.9 y = -9000 y + u", "D^0.3 y = -80 y + u"])
def test_what_is_left_is_told(words, monkeypatch):
    """With few pulses the change that is told is no less than a small part of the error."""
    monkeypatch.setattr(long, "exact_samples", lambda *_: None)
    monkeypatch.setattr(long, "LONG_RECORD_INTERVALS", 1000)
    model, run = ftlm.Model(ftlm.equation(words)), record(2001, u=switched(2001, every=7))
    fine = simulate_refined(model, run, None, tolerance=1e-9, max_m=1 << 18)
    for max_m in (1 << 13, 1 << 14, 1 << 15):
        found = simulate_refined(model, run, None, tolerance=1e-9, max_m=max_m)
        assert error(found.outputs, fine.outputs) <= 2.5 * (float(found.change[0]) + float(fine.change[0])) + 1e-12


def test_too_few_pulses_are_an_error_and_what_grows_is_one_too():
    model, run = ftlm.Model(ftlm.equation("D^1.4 y = -4 y + 2 u")), record(20_001)
    with pytest.raises(ftlm.errors.ConvergenceError, match="still changes by more than"):
        model.simulate(run, max_m=30_000)
    with pytest.raises(ftlm.errors.ConvergenceError, match="overflows"):
        ftlm.Model(ftlm.equation("D^1.4 y = 4 y + 2 u")).simulate(run)


@pytest.mark.parametrize("noise", [1e-4, 1e-6])
def test_half_an_order_of_a_long_record_is_that_of_its_closed_form(noise):
    """D^0.5 y = -y + u answers a step by 1 - erfcx(sqrt t), here for held steps of random size."""
    g, rows, step = np.random.default_rng(5), 5000, 0.02
    response = 1.0 - erfcx(np.sqrt(np.arange(rows) * step))
    u = np.repeat(g.uniform(-1, 1, rows // 50), 50)
    jumps = np.diff(u, prepend=0.0)
    y = sum(jumps[k] * np.r_[np.zeros(k), response[: rows - k]] for k in np.flatnonzero(jumps))
    run = ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": y + noise * g.standard_normal(rows)})
    found = ftlm.identify(run, ftlm.equation("D^alpha y = a y + b u", initial="rest"))
    for name, truth in {"alpha": 0.5, "a": -1.0, "b": 1.0}.items():
        parameter = found.parameters[name]
        assert abs(parameter.value - truth) < 4 * parameter.standard_error
        assert parameter.standard_error < noise
    # Exact samples need no finer grid.
    assert found.joint.refinement == 1
