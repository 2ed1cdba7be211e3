"""Unstable plants that a controller holds: the way to the truth is named, works, and is not refused."""

import numpy as np
import pytest
from scipy.linalg import expm

import ftlm

STEP = 0.01


def held(a, b, gain, *, seed, noise, rows=3000, every=100):
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


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("noise", [1e-3, 1e-2])
def test_the_way_that_is_named_leads_to_the_truth(seed, noise):
    run = held(4.0, 2.0, 5.0, seed=seed, noise=noise)
    default = ftlm.identify(run, ftlm.equation(EQUATION))
    assert default.verdict.level == "do not use"
    (said,) = (f for f in default.findings if f.code == "plant_needs_pieces")
    assert default.verdict.reason == said.reason
    assert "initial='caputo'" in said.remedy
    assert "method='least-squares'" in said.remedy
    assert "output-error" not in default.verdict.remedy
    # The call that the remedy names.
    seconds = round(said.numbers["seconds"], 2)
    pieces = [run.window(k * seconds, (k + 1) * seconds) for k in range(int(run.length * STEP / seconds))]
    found = ftlm.identify(pieces, ftlm.equation(EQUATION, initial="caputo"))
    for name, truth in (("a", 4.0), ("b", 2.0)):
        assert abs(found.coefficients[name] - truth) < 4 * found.standard_errors[name] + 0.01 * truth
    assert "plant_unstable" in codes(found)
    assert found.verdict.level == "with care"
    assert found.validate(pieces[:3]).verdict.level == "with care"
    # What the file keeps is judged alike.
    assert ftlm.compare(found.model, pieces).output_error["y"].nr < 0.5


@pytest.mark.parametrize("method", ["least-squares", "instrumental-variables"])
def test_an_equation_error_method_that_has_the_truth_is_not_refused_for_growing(method, tmp_path):
    run = held(4.0, 2.0, 5.0, seed=5, noise=1e-3)
    found = ftlm.identify(run, ftlm.equation(EQUATION), method=method)
    assert found.coefficients["a"] == pytest.approx(4.0, rel=0.05)
    assert "plant_unstable_in_pieces" in codes(found)
    assert "free_run_grows" not in codes(found)
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
    assert "free_run_grows" in codes(found)
    assert found.verdict.level == "do not use"
