"""Samples of simulations by the core: on one grid and in the limit for zero step, against NumPy by definition."""

import numpy as np
import pytest

import ftlm
import output_samples_oracle as oracle
from ftlm.simulation import step_refinement
from ftlm.simulation.output_samples import nonuniform_sample_times, simulate_samples

ROWS, STEP = 161, 0.05
LOW_PASS = ftlm.SensorFilter.low_pass
TWO = "D^1.6 y = -9 y + 2 z + u\nD^0.9 z = -3 z - y + v"
ONE = "D^1.7 y = -9 y - 0.4 D^0.6 y + 2 u + 0.3 v"
CASES = {
    "one equation": (ONE, {}),
    "a term of the equation's own order": ("D^0.8 y = -2 y + 0.5 D^0.8 v + u", {}),
    "a term above the order": ("D^1.1 y = -4 y + u + 0.2 D^1.5 v", {}),
    "coupled by own orders": (
        "D^1.2 y = -4 y + 0.3 D^1.2 z + u\nD^0.9 z = -3 z + 0.2 D^0.9 y + v",
        {"coupling": "simulated"},
    ),
    "coupled": (TWO, {"coupling": "simulated"}),
    "driven by measurements": (TWO, {"coupling": "measured"}),
    "delays": (ONE, {"delay": {"u": 0.12, "v": 0.07}}),
    "delays and a direct term": ("D^0.8 y = -2 y + 0.5 D^0.8 u + v", {"delay": {"u": 0.12}}),
    "limits": (ONE, {"saturation": {"u": 0.8}, "dead_zone": {"v": 0.3}}),
    "a filtered output": (ONE, {"sensor_filter": LOW_PASS(("y",), 3.0), "coupling": "simulated"}),
    "a filter that a jump passes": (
        "D^0.8 y = -2 y + 0.5 D^0.8 v + u",
        {"sensor_filter": ftlm.SensorFilter(("y",), ((1.0, 0.0), (0.2, 1.0)), ((1.0, 0.0), (0.3, 1.0)))},
    ),
    "a filtered input": (ONE, {"sensor_filter": LOW_PASS(("v",), 3.0)}),
    "filtered, driven by measurements": (TWO, {"coupling": "measured", "sensor_filter": LOW_PASS(("z",), 3.0)}),
    "an offset": (ONE + " + c", {"offset": "constant"}),
    "a level": (ONE, {"offset": "level"}),
}


def make_run(kind: str, *, rows: int = ROWS, moving: bool = True) -> ftlm.Run:
    rng = np.random.default_rng(9)
    times = np.arange(rows) * STEP
    if kind == "own times":
        times = np.append(0.0, times[1:] + 0.3 * STEP * rng.uniform(-1, 1, rows - 1))
    u = np.repeat(rng.standard_normal(rows // 7 + 1), 7)[:rows]
    outputs = {"y": 0.7 * moving + np.sin(2 * times), "z": np.cos(3 * times) - 1.0 + 0.4 * moving}
    outputs = {n: v + 0.01 * rng.standard_normal(rows) for n, v in outputs.items()}
    if kind == "gaps":
        outputs["y"][[5, 6, 40]] = np.nan
    return ftlm.Run.from_arrays(
        inputs={"u": u, "v": np.sin(5 * times + 1)},
        outputs=outputs,
        intersample={"u": "zoh", "v": "foh"},
        missing="weight" if kind == "gaps" else "refuse",
        **({"time": times, "resample": STEP} if kind == "own times" else {"step": STEP}),
    )


def make_model(name: str, initial: str) -> ftlm.Model:
    words, more = CASES[name]
    return ftlm.Model(ftlm.equation(words, **{"initial": initial, **more}))


def assert_same(found, expected, share: float = 1e-10) -> None:
    """Sums in another order: the largest value counts, and that of responses whose sum cancels."""
    scale = np.max(np.abs(expected), axis=1, keepdims=True)
    np.testing.assert_allclose(found / scale, expected / scale, rtol=0, atol=share)


@pytest.mark.parametrize("kind", ["uniform", "gaps", "own times"])
@pytest.mark.parametrize("initial", ["rest", "caputo", "history"])
@pytest.mark.parametrize("name", CASES)
def test_one_grid_has_the_samples_of_the_definition(name, initial, kind):
    model, run = make_model(name, initial), make_run(kind)
    times = nonuniform_sample_times(model, run)
    for every in (2, 5):
        try:
            expected, terms = oracle.simulate_samples(model, run, every, None, times)
        except ftlm.FtlmError as error:
            with pytest.raises(type(error)):
                simulate_samples(model, run, every, None, times)
            return
        found, ours = simulate_samples(model, run, every, None, times)
        assert {o: list(t) for o, t in ours.items()} == {o: list(t) for o, t in terms.items()}
        assert_same(found, expected, 1e-8 if initial == "history" else 1e-11)


@pytest.mark.parametrize("long", [False, True])
@pytest.mark.parametrize("name", [name for name in CASES if name != "a level"])
def test_the_limit_is_that_of_the_definition(name, long, monkeypatch):
    """Long records are superposed of responses to single samples where these exist, by transforms where these do."""
    model = make_model(name, "rest" if "delays" in name else "caputo")
    run = make_run("uniform", rows=1201 if long else 81)
    monkeypatch.setattr(step_refinement, "LONG_RECORD_INTERVALS", 1000)
    options = {"tolerance": 1e-5, "max_m": 1 << 14}
    expected = oracle.simulate_refined(model, run, None, **options, long_intervals=1000)
    found = step_refinement.simulate_refined(model, run, None, **options)
    if long and found.refinement == 1:
        assert_same(found.outputs, expected.outputs, 1e-5)
        return
    assert found.refinement == expected.refinement
    assert_same(found.outputs, expected.outputs)
    np.testing.assert_allclose(found.change, expected.change, rtol=1e-3, atol=1e-10)
