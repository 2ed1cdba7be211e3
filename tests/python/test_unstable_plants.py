"""Unstable plants that a controller holds: the way to the truth is named, works, and is not refused."""

import numpy as np
import pytest
from scipy.linalg import expm

import ftlm
from slow_cases import slow_after

pytestmark = pytest.mark.usefixtures("no_extension_tests")

STEP = 0.01


def controlled_run(a, b, gain, *, seed, noise, rows=3000, every=100):
    """First-order unstable plant D y = a y + b u under proportional control with reference steps."""
    g = np.random.default_rng(seed)
    reference = np.repeat(g.uniform(-1, 1, rows // every), every)
    move = expm(np.array([[a, b], [0.0, 0.0]]) * STEP)
    state, inputs, outputs = 0.0, [], []
    for r in reference:
        y = state + noise * g.standard_normal()
        u = gain * (r - y)
        state = move[0, 0] * state + move[0, 1] * u
        inputs.append(u)
        outputs.append(y)
    return ftlm.Run.from_arrays(
        step=STEP, inputs={"u": np.array(inputs), "r": reference}, outputs={"y": np.array(outputs)}
    )


EQUATION = "D y = a y + b u"


def codes(found):
    return [f.code for f in found.findings]


@slow_after(1, "seed", [1, 2, 3])
@pytest.mark.parametrize("noise", [1e-3, 1e-2])
def test_default_splits_the_run_and_finds_the_plant(seed, noise, tmp_path):
    run = controlled_run(4.0, 2.0, 5.0, seed=seed, noise=noise)
    found = ftlm.identify(run, ftlm.equation(EQUATION))
    for name, truth in (("a", 4.0), ("b", 2.0)):
        assert abs(found.coefficients[name] - truth) < 4 * found.standard_errors[name] + 0.01 * truth
    (split,) = (f for f in found.findings if f.code == "runs_split")
    assert split.numbers["pieces"] == len(run.split(split.numbers["seconds"]))
    assert found.verdict.level == "with care"
    other = controlled_run(4.0, 2.0, 5.0, seed=seed + 10, noise=noise)
    validation = found.validate(other)
    assert validation.verdict.level in ("trust", "with care")
    assert validation.output_error["y"].nr < 0.3
    # A saved model is compared in the same pieces.
    again = ftlm.load_model(found.model.save(tmp_path / "model.json"))
    assert again.compare(other).fit == validation.fit
    # The call that does the same by hand.
    by_hand = ftlm.identify(run.split(split.numbers["seconds"]), ftlm.equation(EQUATION), initial="caputo")
    assert by_hand.coefficients == found.coefficients


def levitation_run(seed, rows=4000, step=1e-3):
    """Magnetic levitation D^2 x = 900 x - 20 i under PID control, steps of the reference, noise of 0.05 %."""
    rng, x, total, last = np.random.default_rng(seed), np.zeros(2), 0.0, 0.0
    move = expm(np.array([[0.0, 1.0, 0.0], [900.0, 0.0, -20.0], [0.0, 0.0, 0.0]]) * step)
    positions, currents = np.empty(rows), np.empty(rows)
    for k, target in enumerate(np.repeat(rng.uniform(-0.002, 0.002, rows // 200), 200)):
        positions[k] = x[0] + 1e-6 * rng.standard_normal()
        error = target - positions[k]
        slope = (error - last) / step if k else 0.0
        total, last = total + error * step, error
        currents[k] = -100.0 * error - 300.0 * total - 4.0 * slope
        x = move[:2, :2] @ x + move[:2, 2] * currents[k]
    return ftlm.Run.from_arrays(step=step, inputs={"i": currents}, outputs={"x": positions})


def test_an_unstable_plant_whose_output_a_stable_model_half_explains_is_found():
    run = levitation_run(8)
    found = ftlm.identify(run, ftlm.equation("D^2 x = a1 D x + a0 x + b i"), threads=1)
    assert found.coefficients["a0"] == pytest.approx(900.0, rel=0.01)
    assert found.coefficients["b"] == pytest.approx(-20.0, rel=0.01)
    assert "runs_split" in codes(found)


@pytest.mark.parametrize("initial", ["rest", "caputo"])
def test_a_start_that_is_given_is_kept_and_the_way_is_named(initial):
    run = controlled_run(4.0, 2.0, 5.0, seed=1, noise=1e-2)
    default = ftlm.identify(run, ftlm.equation(EQUATION), initial=initial)
    assert default.verdict.level == "do not use"
    (said,) = (f for f in default.findings if f.code == "plant_needs_pieces")
    assert default.verdict.reason == said.reason
    assert f"run.split({said.numbers['seconds']:.2g})" in said.remedy
    assert "initial='caputo'" in said.remedy
    assert "method='least-squares'" in said.remedy
    assert "output-error" not in default.verdict.remedy


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_the_structure_of_an_unstable_plant_is_found(seed):
    """Inverted pendulum D^2 y = w^2 (y + u) under proportional-derivative control, noise in the measurement."""
    g, rate, step = np.random.default_rng(seed), 0.4, 0.12
    move = expm(np.array([[0.0, 1.0, 0.0], [rate**2, 0.0, rate**2], [0.0, 0.0, 0.0]]) * step)
    state, inputs, outputs = np.zeros(2), [], []
    for r in np.repeat(g.choice([-0.2, 0.2], 80), 10):
        y = state[0] + 0.004 * g.standard_normal()
        u = -3.0 * y - 2.0 / rate * state[1] + 2.0 * r
        state = move[:2, :2] @ state + move[:2, 2] * u
        inputs.append(u)
        outputs.append(y)
    run = ftlm.Run.from_arrays(step=step, inputs={"u": np.array(inputs)}, outputs={"y": np.array(outputs)})
    found = ftlm.select(run, "auto")
    (order,) = (e.order.constant for e in found.model.structure.equations)
    assert order == 2
    assert abs(found.parameters["a0"].value / rate**2 - 1) < 0.06
    assert abs(found.parameters["b0"].value / rate**2 - 1) < 0.06
    assert "runs_split" in codes(found.best)


def test_split():
    time = np.arange(1003) * 0.1
    run = ftlm.Run.from_arrays(step=0.1, inputs={"u": np.sin(time)}, outputs={"y": np.cos(time)}, name="test")
    pieces = run.split(10.0)
    assert len(pieces) == 10
    assert np.array_equal(np.concatenate([p["y"] for p in pieces]), run["y"])
    assert min(p.length for p in pieces) == 100
    assert max(p.length for p in pieces) == 101
    assert pieces[3].start == pytest.approx(30.0)
    assert pieces[3].name == "test piece 4 of 10"
    assert run.split(60.0) == [run]
    with pytest.raises(ftlm.DataError, match="duration = 0, which must be above 0"):
        run.split(0.0)


@pytest.mark.parametrize("method", ["least-squares", "instrumental-variables"])
def test_an_equation_error_method_that_has_the_truth_is_not_refused_for_growing(method, tmp_path):
    run = controlled_run(4.0, 2.0, 5.0, seed=5, noise=1e-3)
    found = ftlm.identify(run, ftlm.equation(EQUATION), method=method)
    assert found.coefficients["a"] == pytest.approx(4.0, rel=0.05)
    assert "plant_unstable_in_pieces" in codes(found)
    assert "simulation_unbounded" not in codes(found)
    assert found.verdict.level == "with care"
    found.model.save(tmp_path / "plant.json")
    again = ftlm.load_model(tmp_path / "plant.json")
    assert "plant_unstable_in_pieces" in [f.code for f in again.estimate.findings]


@pytest.mark.parametrize("seed", range(6))
def test_a_stable_plant_whose_model_grows_is_still_refused(seed):
    """The sign of the pole is wrong: from no start does the model follow the output."""
    g = np.random.default_rng(seed)
    u = np.repeat(g.standard_normal(150), 20)
    decay = np.exp(-2.0 * STEP)
    y = np.zeros(u.size)
    for k in range(1, u.size):
        y[k] = decay * y[k - 1] + (1 - decay) * u[k - 1]
    run = ftlm.Run.from_arrays(
        step=STEP, inputs={"u": u}, outputs={"y": y + 0.02 * np.std(y) * g.standard_normal(u.size)}
    )
    grows = ftlm.equation(EQUATION).with_coefficients({"a": 2.0})
    found = ftlm.identify(run, grows, method="least-squares")
    assert "simulation_unbounded" in codes(found)
    assert found.verdict.level == "do not use"
