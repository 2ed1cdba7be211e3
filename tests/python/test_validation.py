"""Both errors of a model on measured runs, the four figures, and warnings in words."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

import ftlm
import oracles
from ftlm import _core
from ftlm.simulation import output_samples as past
from ftlm.simulation.output_samples import simulate_samples
from ftlm.validation.comparison import common_rows, compare_means, near_identity_findings

# ----------------------------------------------------------------------------------------------------------------------
# The four figures


@pytest.mark.parametrize("seed", range(4))
def test_figures_are_the_oracles(seed):
    rng = np.random.default_rng(seed)
    y, prediction = rng.standard_normal((2, 300)) * 10.0 ** rng.integers(-8, 8)
    found = ftlm.metrics(y, prediction)
    assert found.error == pytest.approx(oracles.absolute_error(y, prediction), rel=1e-13)
    assert found.rmse == pytest.approx(oracles.root_mean_square(y, prediction), rel=1e-13)
    assert found.nr == pytest.approx(oracles.normalised_residual(y, prediction), rel=1e-12)
    assert found.fit == pytest.approx(oracles.fit(y, prediction), rel=1e-11)
    assert found.fit == pytest.approx(100 * (1 - found.nr), rel=1e-12)


def test_figures_of_a_perfect_and_of_a_diverged_prediction():
    y = np.array([0.0, 1.0, 2.0])
    assert ftlm.metrics(y, y) == ftlm.Metrics(0.0, 0.0, 0.0, 100.0)
    for bad in (np.inf, np.nan, 1e300):
        found = ftlm.metrics(y, np.array([0.0, bad, 2.0]))
        assert found.rmse == np.inf
        assert found.fit == -np.inf
        assert found.to_dict()["rmse"] is None
        assert json.dumps(found.to_dict(), allow_nan=False)
    assert ftlm.metrics(y, np.zeros(3)).to_dict() == pytest.approx(
        {"error": 3.0, "rmse": (5 / 3) ** 0.5, "nr": 2.5**0.5, "fit": 100 * (1 - 2.5**0.5)}
    )


@pytest.mark.parametrize(
    ("measured", "predicted", "message"),
    [
        ([1.0, 2.0], [1.0], "measured has shape (2,), predicted (1,)"),
        ([], [], "measured has shape (0,), predicted (0,)"),
        (np.ones((2, 2)), np.ones((2, 2)), "measured has shape (2, 2)"),
        (1.0, 1.0, "measured has shape ()"),
        ([1.0, np.nan, 2.0, np.inf], np.ones(4), "measured is not finite at index 1 (2 such values in all)"),
        (["a"], ["b"], "measured has <U1 values; give real numbers"),
        ([1.0], [1j], "predicted has complex128 values"),
    ],
)
def test_figures_of_what_cannot_be_compared_are_refused(measured, predicted, message):
    with pytest.raises(ftlm.DataError) as refused:
        ftlm.metrics(measured, predicted)
    assert message in str(refused.value)


# ----------------------------------------------------------------------------------------------------------------------
# Comparison


def test_the_true_model_fits_its_own_run(small_model, small_run):
    found = small_model.compare(small_run)
    assert found.m == 256  # that of the identification
    # What is left is discretization: 40 ms pulses, and 20 ms ones.
    assert found.fit["y"] > 99.8
    assert found.equation_error["y"].fit > 99.7
    assert found.warnings == ()
    assert ftlm.compare(small_model, small_run, m=512).fit["y"] > 99.9


def test_free_run_and_equation_error_are_the_oracles(small_model, small_run, with_noise):
    run = with_noise(small_run, 0.02, 1)
    m, duration = 128, run.duration
    found = compare_means(small_model, run, m=m)
    y, u = (oracles.pulse_means(run[n], m, how) for n, how in (("y", "foh"), ("u", "zoh")))
    free = oracles.free_run([(-3, 0.6), (-8, 0.0)], [(5, 0.0, u)], 1.6, m, duration)
    q = oracles.regressors([y, y, u], [0.6, 0.0, 0.0], 1.6, duration, haar=False)
    for figures, prediction in ((found.output_error["y"], free), (found.equation_error["y"], q @ [-3, -8, 5])):
        assert figures.error == pytest.approx(oracles.absolute_error(y, prediction), rel=1e-9)
        assert figures.rmse == pytest.approx(oracles.root_mean_square(y, prediction), rel=1e-9)
        assert figures.nr == pytest.approx(oracles.normalised_residual(y, prediction), rel=1e-9)
        assert figures.fit == pytest.approx(oracles.fit(y, prediction), rel=1e-9)
    np.testing.assert_allclose(found.simulated["y"][0], free, atol=1e-11)
    np.testing.assert_allclose(found.measured["y"][0], y, atol=1e-14)
    assert found.step == [pytest.approx(duration / m)]


@pytest.mark.parametrize("coupling", ["simulated", "measured"])
@pytest.mark.parametrize("sensor", [None, "z"])
def test_the_true_coupled_model_fits_its_run(coupling, sensor):
    text = "D^1.7 y = -20 y - 2 D^0.7 y + 15 z + 10 u; D^1.2 z = -5 z + 3 D^0.4 y + u"
    sensor_filter = ftlm.SensorFilter.low_pass([sensor], frequency=1.0) if sensor else None
    structure = ftlm.equation(text, sensor_filter=sensor_filter)
    n = 801
    u = np.where(np.arange(n) % 200 < 120, 1.0, -0.5)
    empty = ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": np.zeros(n), "z": np.zeros(n)})
    run = ftlm.Model(replace(structure, coupling="simulated")).simulate(empty, tolerance=1e-7)
    found = ftlm.Model(replace(structure, coupling=coupling)).compare(run, m=800)
    assert all(fit > 99.9 for fit in found.fit.values())
    assert all(figures.fit > 99.9 for figures in found.equation_error.values())
    assert found.warnings == ()


@pytest.mark.parametrize("coupling", ["simulated", "measured"])
def test_the_true_plant_fits_its_run(plant, clean_a, coupling):
    found = plant("A", coupling=coupling).compare(clean_a, m=4999)
    assert all(fit > 99.8 for fit in found.fit.values()), found.fit


def test_initial_terms_are_fitted_anew_for_every_run(small_model):
    # Two pieces of one free oscillation: the model is the same, what it starts from is not.
    structure = replace(ftlm.equation("D^2 y = -9 y - 0.4 D y"), initial="caputo")
    swinging = ftlm.Model(structure)
    t = np.arange(1001) * 0.01
    omega = np.sqrt(9 - 0.04)
    y = np.exp(-0.2 * t) * np.cos(omega * t)
    run = ftlm.Run.from_arrays(step=0.01, inputs={"u": np.zeros(1001)}, outputs={"y": y}, name="whole")
    found = swinging.compare([run.window(0, 5), run.window(5, None)], m=499)
    assert found.fit["y"] > 99.98
    # Terms of t^0 and t^1, where D y = -0.4 leaves 0.4 y(0) beside y'(0).
    for terms, start in zip(found.initial, (0, 500), strict=True):
        slope = np.exp(-0.2 * t[start]) * (-0.2 * np.cos(omega * t[start]) - omega * np.sin(omega * t[start]))
        assert terms["y"][0.0] == pytest.approx(y[start], abs=2e-3)
        assert terms["y"][1.0] == pytest.approx(slope + 0.4 * y[start], abs=2e-3)
    resting = ftlm.Model(replace(structure, initial="rest")).compare(run, m=500)
    assert resting.initial == [{"y": {}}]
    assert resting.fit["y"] < 1


def test_several_runs_are_pooled_about_their_own_means(small_model, small_run, with_noise):
    first, second = with_noise(small_run, 0.01, 1), with_noise(small_run.window(0, 6), 0.05, 2)
    together = compare_means(small_model, [first, second], m=256)
    alone = [compare_means(small_model, run, m=256) for run in (first, second)]
    for kind in ("output_error", "equation_error"):
        pooled, parts = getattr(together, kind)["y"], [getattr(c, kind)["y"] for c in alone]
        assert pooled.error == pytest.approx(sum(p.error for p in parts), rel=1e-12)
        squares = sum(256 * p.rmse**2 for p in parts)
        assert pooled.rmse == pytest.approx(np.sqrt(squares / 512), rel=1e-12)
        deviation = sum(256 * (p.rmse / p.nr) ** 2 for p in parts)
        assert pooled.nr == pytest.approx(np.sqrt(squares / deviation), rel=1e-12)
    assert [name for name, _, _ in together.per_run] == [first.name, second.name]
    for (_, equation, output), c in zip(together.per_run, alone, strict=True):
        assert equation == c.equation_error
        assert output == c.output_error
    assert len(together.step) == 2
    assert together.step[0] != together.step[1]


def test_a_model_that_knows_no_m_takes_what_the_run_carries(small_model, small_run):
    unknown = replace(small_model, m=None)
    assert unknown.compare(small_run).m == 512
    assert small_model.compare(small_run.window(0, 4)).m == 199
    with pytest.raises(ftlm.ModelError, match=r"m = 513 is more than run 'small, simulated' allows: 513 rows give 512"):
        small_model.compare(small_run, m=513)


def test_comparison_prints_and_is_json(small_model, small_run, with_noise):
    other = with_noise(small_run, 0.01, 1)
    found = small_model.compare([small_run, other], m=64)
    lines = str(found).splitlines()
    assert lines[0].split() == ["output", "error", "RMSE", "NR", "fit", "%"]
    assert [line.split()[:3] for line in lines[1:3]] == [["y", "equation", "error"], ["y", "output", "error"]]
    assert lines[3] == "output error over 1026 samples, equation error over 64 block pulses per run"
    means = str(compare_means(small_model, small_run, m=64)).splitlines()
    assert means[3] == "over 64 block pulses per run"
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert document["m"] == 64
    assert document["output_error"]["y"]["fit"] == found.fit["y"]
    assert [r["run"] for r in document["runs"]] == ["small, simulated", other.name]


# ----------------------------------------------------------------------------------------------------------------------
# Refusals


def test_runs_that_cannot_be_compared_are_refused(small_model, small_run):
    u = small_run["u"]
    others = {
        "no run is given": [],
        "runs is int; give a Run": 3,
        r"runs\[1\] is str, not a Run": [small_run, "run"],
        "has no signal 'u', which the model needs": ftlm.Run.from_arrays(step=1, inputs={}, outputs={"y": u}),
        "has no signal 'y', which the model needs": ftlm.Run.from_arrays(step=1, inputs={"u": u}, outputs={"w": u}),
        "output 'y' of run 'run': constant, every row is 1.0, first at row 0, 513 in all": ftlm.Run.from_arrays(
            step=1, inputs={"u": u}, outputs={"y": np.ones(513)}
        ),
        "output 'y' is not in run 'run'": ftlm.Run.from_arrays(step=1, inputs={"y": u, "u": u}, outputs={"w": u}),
        "have different outputs": [
            small_run,
            ftlm.Run.from_arrays(step=1, inputs={"u": u}, outputs={"y": u, "w": u}),
        ],
        "have different inputs": [small_run, ftlm.Run.from_arrays(step=1, inputs={"v": u}, outputs={"y": u})],
        "have different units: signal 'y' is in 'V' and 'rad'": [
            small_run,
            ftlm.Run.from_arrays(step=1, inputs={"u": u}, outputs={"y": u}, units={"y": "V", "u": "A"}),
        ],
    }
    for message, runs in others.items():
        with pytest.raises(ftlm.DataError, match=message):
            small_model.compare(runs)
    with pytest.raises(ftlm.ModelError, match="model is str, not a Model"):
        ftlm.compare("model.json", small_run)


@pytest.mark.parametrize("m", [0, -1, 1.5, "x", None, float("nan"), 1e30, True])
def test_numbers_of_pulses_that_are_none_are_refused(small_model, small_run, m):
    if m is None:
        assert small_model.compare(small_run, m=None).m == 256
        return
    with pytest.raises(ftlm.ModelError, match=r"^m = "):
        small_model.compare(small_run, m=m)


# ----------------------------------------------------------------------------------------------------------------------
# Warnings in words


def figures(nr):
    return {"y": ftlm.Metrics(1.0, 1.0, nr, 100 * (1 - nr))}


@pytest.mark.parametrize(
    ("own", "equation", "output", "words"),
    [
        ((1.3, 0.5), 0.01, 0.01, None),
        ((1.4,), 0.01, 0.04, None),
        ((1.4,), 0.01, 0.06, "order 1.4 is close to alpha = 1.5, so the equation nearly says that y equals itself"),
        ((1.4, 1.3), 0.001, np.inf, "orders 1.4, 1.3 are close to alpha = 1.5"),
        (
            (1.4, 1.3),
            0.001,
            np.nan,
            "the normalized residual (NR) of its simulation is nan, that of the equation error 0.001",
        ),
        ((1.0,), 0.01, 0.4, None),
        ((1.0,), 0.01, 0.6, "the simulation (normalized residual 0.6) is far worse than the equation error (0.01)"),
        ((1.0,), 0.4, 0.6, "the simulation explains little of the output (normalized residual 0.6)"),
        ((1.0,), np.nan, np.nan, "is far worse than the equation error"),
    ],
)
def test_free_runs_far_worse_than_their_equation_error_are_named(own, equation, output, words):
    text = "D^1.5 y = " + " ".join(f"+ 1 D^{order} y" for order in own) + " + u"
    found = near_identity_findings(ftlm.equation(text), figures(equation), figures(output))
    if words is None:
        assert found == []
    else:
        (warning,) = found
        assert warning.output == "y"
        assert words in warning.text


def test_an_unstable_model_is_compared_and_said_to_be_useless():
    n = 400
    u = np.where(np.arange(n) % 80 < 40, 1.0, -1.0)
    y = np.cumsum(u)
    run = ftlm.Run.from_arrays(step=0.1, inputs={"u": u}, outputs={"y": y})
    growing = ftlm.Model(ftlm.equation("D^1 y = 15 y + u"))
    found = growing.compare(run, m=399)
    assert found.output_error["y"].nr == np.inf
    document = found.to_dict()["output_error"]["y"]
    assert (document["rmse"], document["nr"], document["fit"]) == (None, None, None)
    assert found.output_error["y"].error > 1e250  # e^(15 · 40), as the equation has it
    assert any("far worse than the equation error" in w or "explains little" in w for w in found.warnings)


def test_metrics_of_the_core_are_the_public_ones():
    y, prediction = np.random.default_rng(3).standard_normal((2, 50))
    found = ftlm.metrics(y, prediction)
    assert _core.metrics(y, y - prediction) == (found.error, found.rmse, found.nr, found.fit)


def test_a_run_in_motion_that_starts_at_zero_is_said_to_be_no_run_from_rest(monkeypatch):
    rng = np.random.default_rng(3)
    u = np.repeat(rng.choice([-1.0, 1.0], size=60), 40)
    truth = ftlm.Model(ftlm.equation("D^1.4 y = -4 y + 2 u", initial="rest"))
    y = truth.simulate(ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": 0.0 * u}))["y"]
    y = y + 0.002 * np.std(y) * rng.normal(size=u.size)
    # Cut where it crosses zero, with speed.
    start = next(k for k in range(800, 1600) if y[k] * y[k - 1] < 0)
    moving = np.where(np.arange(u.size) == start, 0.0, y)
    from_rest = ftlm.Run.from_arrays(step=0.05, inputs={"u": u[:800]}, outputs={"y": y[:800]}, name="from rest")
    cut = ftlm.Run.from_arrays(step=0.05, inputs={"u": u[start:]}, outputs={"y": moving[start:]}, name="cut")
    model = ftlm.Model(ftlm.equation("D^1.4 y = -4 y + 2 u"))
    assert ftlm.compare(model, from_rest).warnings == ()
    words = ftlm.compare(model, [from_rest, cut]).warnings
    assert len(words) == 1
    assert words[0].startswith("cut starts at zero and is simulated from rest")
    assert "initial='history'" in words[0]
    # Two free runs tell it of each, from rest and with a history, and both questions are asked of these.
    simulated = []

    def counted(model, run, *more):
        simulated.append(run.name)
        return simulate_samples(model, run, *more)

    with monkeypatch.context() as patch:
        patch.setattr(past, "simulate_samples", counted)
        assert past.runs_in_motion(model, [from_rest, cut]) == ["cut"]
    assert simulated == ["from rest", "from rest", "cut", "cut"]
    with monkeypatch.context() as patch:
        # The first part of a long run is enough.
        patch.setattr(past, "MAX_START_SAMPLES", 200)
        assert past.runs_in_motion(model, [from_rest, cut]) == ["cut"]
    asked = ftlm.Model(replace(model.structure, initial="history"))
    assert ftlm.compare(asked, cut).fit["y"] > ftlm.compare(model, cut).fit["y"] + 1.0


def test_rows_that_two_parts_of_a_recording_share():
    y = np.random.default_rng(5).standard_normal((1, 200)).cumsum(axis=1)
    y[:, :20] = 0.0
    assert common_rows(y, y) == 200
    assert common_rows(y[:, :100], y) == common_rows(y, y[:, :100]) == 100
    assert common_rows(y[:, :100], y[:, 60:]) == common_rows(y[:, 60:], y[:, :100]) == 40
    # Rows one after the other, another recording, and rests of different recordings share nothing.
    assert common_rows(y[:, :100], y[:, 100:]) == 0
    assert common_rows(y, y + 0.1) == 0
    assert common_rows(np.zeros((1, 100)), y) == 0


def test_a_validation_on_fitted_rows_is_with_care():
    rng = np.random.default_rng(6)
    u = np.repeat(rng.choice([-1.0, 1.0], 40), 25)
    plant = ftlm.Model(ftlm.equation("D y = -2 y + 2 u"))
    run = plant.simulate(ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": 0 * u}))
    run = run.with_outputs({"y": run["y"] + 0.01 * rng.standard_normal(u.size)})
    found = ftlm.identify(run.window(0, 10), ftlm.equation("D y = a y + b u"))
    clean, partly = found.validate(run.window(10, 20)), found.validate(run.window(5, 15))
    assert clean.verdict.trusted
    assert not partly.verdict.trusted
    (shared,) = (f for f in partly.findings if f.code == "estimation_rows_repeated")
    assert (shared.numbers["count"], shared.numbers["rows"]) == (250, 500)
    # The state at the start of a run in motion is estimated on it, and the summary says so.
    terms = sum(map(len, clean.initial[0].values()))
    assert terms
    said = " ".join(found.summary(clean).split())
    assert f"estimated on them (their number): {clean.per_run[0][0]} ({terms})" in said
    assert "initial terms estimated on each run (their number)" in str(found.model.compare(run.window(10, 20)))


def two_lags(u, noise, seed, name):
    """Samples of 2 / ((0.8 s + 1) (0.48 s + 1)) u at 50 Hz with white noise, by SciPy's exact discretization."""
    b, a, _ = signal.cont2discrete(([2.0], np.polymul([0.8, 1.0], [0.48, 1.0])), 0.02)
    y = signal.lfilter(b.ravel(), a, u)
    y = y + noise * y.std() * np.random.default_rng(seed).standard_normal(u.size)
    return ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": y}, name=name)


@pytest.mark.parametrize("seed", range(4))
def test_a_validation_run_shows_dynamics_that_a_step_hides(seed):
    step = np.where(np.arange(600) < 60, 0.0, 1.0)
    binary = np.repeat(np.random.default_rng(seed).choice([-1.0, 1.0], 50), 12)
    estimation, validation = two_lags(step, 0.1, seed, "step"), two_lags(binary, 0.1, 100 + seed, "binary")
    # In 10 % noise, a lag and a delay describe the step response, but not the response to the binary signal.
    poor = ftlm.identify(estimation, ftlm.equation("D y = -a y + b u(t - 0:1)")).validate(validation)
    assert "validation_follows_input" in {f.code for f in poor.findings}
    assert poor.verdict.level == "with care"
    # With uncertain parameters, the residuals of the right structure depend on the input as well.
    right = ftlm.identify(estimation, ftlm.equation("D^2 y = -a1 D y - a y + b u")).validate(validation)
    assert "validation_follows_input" not in {f.code for f in right.findings}
