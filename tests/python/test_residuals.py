"""Residual tests refuse one true model in a hundred and find what a model lacks; information criteria count orders."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

import ftlm
from ftlm import _core
from ftlm.plot.comparison_charts import residual_charts
from ftlm.utils.statistics import autoregression, chi_squared_99, is_white, whiten_series
from ftlm.validation import residual_tests
from ftlm.validation.residual_tests import NoiseModel, residual_findings
from slow_cases import slow_after

WORDS = "D^1.6 y = a D^0.6 y + c y + b u"


@pytest.fixture(scope="module")
def noisy(small_run, with_noise):
    return with_noise(small_run, 0.02, 1)


@pytest.fixture(scope="module")
def long_run(small_model):
    """A minute and a half under a random two-level input: many independent stretches."""
    rng = np.random.default_rng(12)
    u = np.repeat(rng.choice([-1.0, 1.0], 180), 25)
    clean = small_model.simulate(blank(u), tolerance=1e-5)
    y = clean["y"] + 0.02 * rng.standard_normal(u.size)
    return ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": y}, name="long")


# ------------------------------------------------------------------------------------------------ the mathematics


@pytest.mark.parametrize("lags", [1, 5, 25, 100])
def test_the_quantile_is_that_of_chi_squared(lags):
    scipy = pytest.importorskip("scipy.stats")
    assert chi_squared_99(lags) == pytest.approx(scipy.chi2.ppf(0.99, lags), rel=0.03 if lags < 5 else 0.003)


def test_correlations_are_numpys():
    rng = np.random.default_rng(1)
    e, u = rng.standard_normal((2, 400))
    values, variance, _ = _core.correlation([e], [u], 25)
    a, b = e - e.mean(), u - u.mean()
    full = np.correlate(a, b, "full")[400 - 1 - 25 : 400 + 25] / (np.linalg.norm(a) * np.linalg.norm(b))
    np.testing.assert_allclose(values, full, atol=1e-14)
    assert variance == pytest.approx(1 / 400, rel=0.3)


def blank(u, step=0.02):
    return ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": 0 * u}, name="blank")


@pytest.mark.parametrize(("seeds", "most"), [(60, 4), pytest.param(300, 9, marks=pytest.mark.slow)])
def test_one_true_model_in_a_hundred_is_refused(small_model, small_run, with_noise, seeds, most):
    verdicts = [small_model.resid(with_noise(small_run, 0.05, seed)) for seed in range(seeds)]
    whiteness = sum(not v.white["y"] for v in verdicts)
    independence = sum(not v.independent["y"] for v in verdicts)
    # One in a hundred each: 3 of 300, at most 9 with a probability of 99.9 %, and at most 4 of 60; the second is
    # conservative for an input whose lags are alike.
    assert whiteness <= most
    assert independence <= most
    values = np.concatenate([v.outputs["y"].whiteness.values[1:] for v in verdicts])
    outside = np.mean(np.abs(values) > verdicts[0].outputs["y"].whiteness.band)
    assert 0.005 < outside < 0.02


def test_coloured_noise_fails_whiteness_and_not_independence(small_model, small_run):
    refused = 0
    for seed in range(20):
        rng = np.random.default_rng([9, seed])
        white = rng.standard_normal(small_run.length + 50)
        coloured = np.convolve(white, 0.8 ** np.arange(50), "valid")[: small_run.length]
        run = ftlm.Run.from_arrays(
            step=small_run.step, inputs={"u": small_run["u"]}, outputs={"y": small_run["y"] + 0.02 * coloured}
        )
        found = small_model.resid(run)
        assert not found.white["y"]
        refused += not found.independent["y"]
    # With the band of white residuals it would be a third of them.
    assert refused <= 2


def test_a_lacking_term_is_found(long_run):
    lacking = ftlm.Model(ftlm.equation("D^1.6 y = -2 D^0.6 y - 8 y + 5 u"))
    found = lacking.resid(long_run)
    assert not found.passed
    assert not found.independent["y"]
    text = str(found)
    assert "FAILED" in text
    assert "residuals are correlated with u" in text
    assert "residuals are not white" in text


def test_feedback_is_told_from_a_lacking_term(small_model):
    # The input answers the noise three samples later; the model is the true one.
    rng = np.random.default_rng(3)
    n = 2000
    noise = 0.1 * rng.standard_normal(n)
    u = np.repeat(rng.choice([-1.0, 1.0], n // 40), 40) - 2 * np.concatenate([np.zeros(3), noise[:-3]])
    clean = small_model.simulate(blank(u), tolerance=1e-5)
    run = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": clean["y"] + noise})
    found = small_model.resid(run)
    assert found.independent["y"]
    assert found.outputs["y"].feedback == ("u",)
    lag = int(found.outputs["y"].inputs["u"].lags[np.argmax(np.abs(found.outputs["y"].inputs["u"].values))])
    assert lag == -3
    assert "closed loop" in str(found)
    assert [f.code for f in residual_findings(found)] == ["loop_harmless"]


# ------------------------------------------------------------------------------------------------ what is tested


def test_residuals_are_samples_less_the_free_run(small_model, small_run, noisy):
    found = small_model.resid(noisy)
    exact = (noisy["y"] - small_run["y"])[1:-1]
    assert found.refinement >= 2
    assert np.max(np.abs(found.outputs["y"].residuals[0] - exact)) < 0.05 * np.std(exact)
    assert found.outputs["y"].rms == pytest.approx(0.02, rel=0.1)
    assert found.passed
    assert found.initial_terms == 0


def test_initial_terms_are_fitted_to_each_run(small_model, noisy):
    structure = replace(small_model.structure, initial="caputo")
    late = noisy.window(1.5, None)
    found = ftlm.Model(structure).resid([noisy, late])
    assert found.initial_terms > 0
    assert len(found.outputs["y"].residuals) == 2
    assert found.runs == (noisy.name, late.name)


def test_inputs_that_the_model_does_not_read_are_tested_too(small_model, noisy):
    other = np.random.default_rng(8).standard_normal(noisy.length)
    y = noisy["y"] + 0.02 * np.concatenate([[0.0], other[:-1]])
    run = ftlm.Run.from_arrays(step=noisy.step, inputs={"u": noisy["u"], "v": other}, outputs={"y": y})
    found = small_model.resid(run)
    assert set(found.outputs["y"].inputs) == {"u", "v"}
    assert not found.outputs["y"].inputs["v"].passed
    assert found.outputs["y"].inputs["v"].largest_correlation[0] == 1
    assert found.outputs["y"].inputs["u"].passed


@pytest.mark.parametrize("coupling", ["simulated", "measured"])
@pytest.mark.parametrize("sensor", [None, "z"])
def test_the_true_coupled_model_passes(coupling, sensor):
    text = "D^1.7 y = -20 y - 2 D^0.7 y + 15 z + 10 u; D^1.2 z = -5 z + 3 D^0.4 y + u"
    sensor_filter = ftlm.SensorFilter.low_pass([sensor], frequency=1.0) if sensor else None
    structure = ftlm.equation(text, sensor_filter=sensor_filter)
    n = 1201
    u = np.where(np.arange(n) % 200 < 120, 1.0, -0.5)
    empty = ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": np.zeros(n), "z": np.zeros(n)})
    clean = ftlm.Model(replace(structure, coupling="simulated")).simulate(empty, tolerance=1e-7)
    rng = np.random.default_rng(2)
    # With measured coupling, noise on one output is the other's input: only what is compared gets any.
    noise = {"y": 0.02, "z": 0.02 if coupling == "simulated" else 0.0}
    outputs = {o: clean[o] + noise[o] * rng.standard_normal(n) for o in ("y", "z")}
    found = ftlm.Model(replace(structure, coupling=coupling)).resid(
        ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs=outputs)
    )
    filtered = coupling == "measured" and sensor == "z"
    # A measured output that passes the filter before it is compared brings coloured noise with it.
    assert found.white["y"] is not filtered
    assert found.independent["y"]


def test_an_unstable_model_fails_in_words(small_run):
    found = ftlm.Model(ftlm.equation("D^1 y = 400 y + u")).resid(small_run)
    assert not found.passed
    assert "overflows" in str(found)
    json.dumps(found.to_dict(), allow_nan=False)
    assert "overflows" in residual_findings(found)[0].text


def test_residuals_print_and_are_json(small_model, noisy):
    found = small_model.resid(noisy, lags=10)
    assert str(found).startswith("residual tests at 99 % on small, simulated, noise 0.02, seed 1: passed")
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert document["passed"] is True
    assert document["outputs"]["y"]["inputs"]["u"]["lags"] == list(range(-10, 11))
    assert found.outputs["y"].whiteness.lags.tolist() == list(range(11))
    assert "whiteness" in found._repr_html_()
    assert "passed" in found._repr_html_()


def test_refusals_name_the_thing_and_the_way_out(small_model, small_run):
    with pytest.raises(ftlm.DataError, match="has 40 rows, correlations up to 25 lags need 53; give a longer run"):
        small_model.resid(small_run.window(0, 0.8))
    for lags in (0, -1, 1.5, "x", None):
        with pytest.raises(ftlm.ModelError, match="is not a whole number of at least 1"):
            small_model.resid(small_run, lags=lags)
    other = ftlm.Run.from_arrays(step=0.02, inputs={"w": small_run["u"]}, outputs={"y": small_run["y"]})
    with pytest.raises(ftlm.DataError, match="has no signal 'u', which the model needs"):
        small_model.resid(other)
    with pytest.raises(ftlm.ModelError, match="not a Model"):
        ftlm.resid("model.json", small_run)


# ------------------------------------------------------------------------------------------------ after identification


def test_identify_reports_both_tests_and_the_criteria(noisy):
    found = ftlm.identify(noisy, ftlm.equation(WORDS), method="least-squares", m=512)
    assert found.residuals is not None
    assert found.information.parameter_count == 4  # a, c, b and the noise level
    assert found.information.sample_count == noisy.length - 2
    assert "AIC " in found.details()
    assert "residuals white" in str(found)
    assert json.loads(json.dumps(found.to_dict(), default=list, allow_nan=False))["information"]["parameter_count"] == 4
    assert found.resid(noisy).outputs["y"].rms == found.residuals.outputs["y"].rms


def test_a_model_that_leaves_something_out_says_so(long_run):
    poor = ftlm.equation("D^1 y = c y + b u")
    for method in ("least-squares", "output-error"):
        found = ftlm.identify(long_run, poor, method=method)
        assert any("not white" in w or "one more pole and zero" in w for w in found.warnings), found.warnings
        assert any("residuals are correlated with u" in w for w in found.warnings), found.warnings


def test_information_criteria_by_hand(small_model, noisy):
    tests = small_model.resid(noisy)
    found = ftlm.information_criteria(tests, 3)
    n, k, rms = noisy.length - 2, 4, tests.outputs["y"].rms
    likelihood = -0.5 * n * (math.log(2 * math.pi * rms**2) + 1)
    assert found.log_likelihood == pytest.approx(likelihood, rel=1e-12)
    assert found.aic == pytest.approx(2 * k - 2 * likelihood, rel=1e-12)
    assert found.aicc == pytest.approx(found.aic + 2 * k * (k + 1) / (n - k - 1), rel=1e-12)
    assert found.bic == pytest.approx(k * math.log(n) - 2 * likelihood, rel=1e-12)
    with pytest.raises(ftlm.ModelError, match="not a whole number of at least 0"):
        ftlm.information_criteria(tests, -1)


def test_criteria_prefer_the_true_structure(noisy):
    true = ftlm.equation(WORDS)
    poor = ftlm.equation("D^2 y = a D y + c y + b u")
    rich = ftlm.equation("D^1.6 y = a D^0.6 y + c y + b u + d D^0.3 y + e D^0.8 u")
    bic = [ftlm.identify(noisy, s, method="output-error").information.bic for s in (true, poor, rich)]
    assert bic[0] < bic[1]
    assert bic[0] < bic[2]


# ------------------------------------------------------------------------------------------------ validation


def test_validation_far_below_estimation_is_said(noisy, small_model):
    found = ftlm.identify(noisy, ftlm.equation(WORDS), method="least-squares", m=512)
    other = ftlm.Run.from_arrays(step=noisy.step, inputs={"u": noisy["u"]}, outputs={"y": -noisy["y"]}, name="mirrored")
    lost = found.validate(other)
    assert any(w.startswith("mirrored: the fit of y drops from") for w in lost.warnings)
    again = found.validate(noisy)
    assert any("does not validate the model" in w for w in again.warnings)
    fresh = small_model.simulate(blank(np.sin(0.02 * np.arange(800) ** 1.1)), tolerance=1e-5)
    assert found.validate(fresh).warnings == ()
    assert found.validate(fresh).fit == found.model.compare(fresh).fit


# ------------------------------------------------------------------------------------------------ tests that can fail


def motor_record(seed, *, coloured=False):
    """SciPy's record of a motor of gain 8 and time constant 0.12 s behind a dead time of 35 ms, 5 % noise."""
    signal = pytest.importorskip("scipy.signal")
    rng, step, fine, n = np.random.default_rng([35, seed]), 0.005, 5, 1600
    u = np.where(np.arange(n) % 400 < 200, 1.0, -1.0)
    late = np.concatenate([np.zeros(35), np.repeat(u, fine)])[: n * fine]
    motor = tuple(np.array(part) for part in ([[-1 / 0.12]], [[8 / 0.12]], [[1.0]], [[0.0]]))
    a, b, c, d, _ = scipy.signal.cont2discrete(motor, step / fine, "zoh")
    y = signal.dlsim((a, b, c, d, step / fine), late)[1][::fine, 0]
    noise = rng.standard_normal(n + 60)
    noise = np.convolve(noise, 0.9 ** np.arange(61), "valid")[:n] if coloured else noise[:n]
    return ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": y + 0.4 * noise}, name=f"motor {seed}")


MOTOR = "D y = a y + b u"


@slow_after(1, "seeds", [2, 10])
def test_a_missing_dead_time_is_found(seeds):
    found = [ftlm.identify(motor_record(seed), ftlm.equation(MOTOR)).residuals for seed in range(seeds)]
    assert 10 * sum(t.outputs["y"].inputs["u"].failed for t in found) >= 9 * seeds
    assert 10 * sum(not t.white["y"] for t in found) >= 9 * seeds


@pytest.mark.slow
@pytest.mark.parametrize("coloured", [False, True])
def test_the_true_dead_time_raises_no_alarm(coloured):
    true = ftlm.Model(ftlm.equation("D y = -8.333333333333334 y + 66.66666666666667 u").with_delays({"u": 0.035}))
    alarms = sum(
        true.resid(motor_record(seed, coloured=coloured)).outputs["y"].inputs["u"].failed for seed in range(100)
    )
    assert alarms <= 3


def levinson_oracle(x, order):
    """Yule-Walker's equations solved as they stand."""
    c = [float(np.mean((x - x.mean())[k:] @ (x - x.mean())[: x.size - k])) for k in range(order + 1)]
    matrix = np.array([[c[abs(i - j)] for j in range(order)] for i in range(order)])
    return np.concatenate([[1.0], -np.linalg.solve(matrix, c[1:])])


def test_the_whitening_filter_is_that_of_yule_and_walker():
    rng = np.random.default_rng(4)
    white = rng.standard_normal(4000)
    x = np.zeros(4000)
    for k in range(2, 4000):
        x[k] = 1.4 * x[k - 1] - 0.7 * x[k - 2] + white[k]
    found = autoregression([x], 25)
    assert 3 <= found.size <= 5
    np.testing.assert_allclose(found, levinson_oracle(x, found.size - 1), rtol=1e-9)
    np.testing.assert_allclose(found[:3], [1.0, -1.4, 0.7], atol=0.05)
    assert is_white(whiten_series([x], found)[0])
    assert not is_white(x)
    assert autoregression([white], 25).size == 1
    assert autoregression([np.zeros(100)], 25).tolist() == [1.0]


def test_a_limit_that_cannot_be_exceeded_decides_nothing(small_model, monkeypatch):
    # A slow sine of a few samples: were its correlations judged as they are, the limit would be above 1.
    monkeypatch.setattr(
        NoiseModel, "fit", lambda series, signal, lags: NoiseModel(np.ones(1), 0, [e - e.mean() for e in series], 1.0)
    )
    n = 60
    t = np.arange(n)
    u = np.sin(2 * np.pi * t / 120)
    clean = small_model.simulate(blank(u), tolerance=1e-5)
    run = ftlm.Run.from_arrays(
        step=0.02, inputs={"u": u}, outputs={"y": clean["y"] + 0.1 * np.cos(2 * np.pi * t / 120)}
    )
    found = small_model.resid(run)
    test = found.outputs["y"].inputs["u"]
    assert test.limit > 1
    assert (test.conclusive, test.passed, test.failed, test.verdict) == (False, False, False, "undecided")
    assert found.to_dict()["outputs"]["y"]["inputs"]["u"]["conclusive"] is False
    assert "undecided" in str(found)
    assert "residual_test_inconclusive" in [f.code for f in residual_findings(found)]
    assert "undecided" in found._repr_html_()
    assert "undecided: its limit is" in residual_charts(found)[1].caption


def test_an_input_that_does_not_move_decides_nothing(small_model, noisy):
    run = ftlm.Run.from_arrays(
        step=noisy.step, inputs={"u": noisy["u"], "v": np.full(noisy.length, 0.1)}, outputs={"y": noisy["y"]}
    )
    found = small_model.resid(run)
    assert found.outputs["y"].inputs["v"].verdict == "undecided"
    assert found.outputs["y"].inputs["u"].verdict == "passed"
    # The input that moves decides; the other one can do nothing, and is shown as what it is.
    assert (found.passed, found.conclusive, found.verdict) == (True, True, "passed")
    assert re.search(r"^y and v .* undecided$", str(found), re.MULTILINE)
    json.dumps(found.to_dict(), allow_nan=False)
    still = ftlm.Run.from_arrays(step=0.02, inputs={"u": np.full(noisy.length, 0.1)}, outputs={"y": noisy["y"]})
    found = small_model.resid(still)
    assert found.outputs["y"].inputs["u"].verdict == "undecided"
    assert found.independence == {"y": "undecided"}
    assert not found.passed
    assert "correlation between residuals and u cannot be tested, because u is constant" in str(found)


def test_the_caption_of_a_chart_says_what_its_bars_do(long_run, small_model):
    for model in (small_model, ftlm.Model(ftlm.equation("D^1.6 y = -2 D^0.6 y - 8 y + 5 u"))):
        tests = model.resid(long_run)
        for chart, (_, signal, test) in zip(residual_charts(tests), tests.tests, strict=True):
            bars = test.values[test.lags != 0] if not signal else test.values
            outside = int(np.sum(np.abs(bars) > test.band))
            assert f"; {outside} of {bars.size} bars leave" in chart.caption
            assert ("could be" in chart.caption) is test.passed
            assert ("is not" in chart.caption) is not test.passed


def hold_response(numerator, denominator, u, step):
    """Response of a transfer function to an input that is constant between samples, by SciPy."""
    b, a, _ = scipy.signal.cont2discrete((numerator, denominator), step)
    return scipy.signal.lfilter(np.ravel(b), a, u)


SLOW_INPUTS = {
    "step": lambda t: (t > 9.0).astype(float),
    "chirp": lambda t: np.sin((0.2 + 0.05 * t) * t),
    "two sines": lambda t: np.sin(1.3 * t) + 0.7 * np.sin(3.1 * t + 1.0),
    "square": lambda t: np.sign(np.sin(0.9 * t)),
}


@pytest.mark.parametrize("kind", SLOW_INPUTS)
@slow_after(1, "seeds", [1, 3])
def test_a_missing_lag_is_found_under_slow_inputs(kind, seeds):
    """What the model lacks has the colour of such an input, which a spectrum of the residuals takes for noise."""
    step, tau = 0.05, 0.9
    t = step * np.arange(900)
    u = SLOW_INPUTS[kind](t)
    for seed in range(seeds):
        y = hold_response([1.0], np.polymul([tau, 1.0], [0.2 * tau, 1.0]), u, step)
        y += np.random.default_rng(seed).normal(0.0, 0.02 * np.std(y), t.size)
        run = ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": y})
        lacking = ftlm.identify(run, ftlm.equation("D y = a y + b u"))
        assert "residuals_follow_input" in {f.code for f in lacking.findings}
        whole = ftlm.identify(run, ftlm.equation("D^2 y = a1 D y + a0 y + b u"))
        assert "residuals_follow_input" not in {f.code for f in whole.findings}


def test_coloured_noise_under_slow_inputs_raises_no_alarm():
    """Of noise that follows no input, about one series in a hundred fails, whatever the colours of both."""
    failed, tried = 0, 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        t = 0.05 * np.arange(600)
        white = rng.normal(size=t.size)
        for noise in (
            white,
            scipy.signal.lfilter([1.0], [1.0, -0.9], white),
            scipy.signal.lfilter([1.0], [1.0, -1.8, 0.9], white),
        ):
            for shape in SLOW_INPUTS.values():
                u = shape(t)
                model = NoiseModel.fit([noise], [u], 25)
                failed += residual_tests._independence([noise], [u], model, 25, first_lag=0).failed
                tried += 1
    assert failed <= 0.03 * tried


def test_the_arx_model_is_that_of_least_squares():
    """Against NumPy on the same columns, with missing samples and two runs."""
    rng = np.random.default_rng(5)
    inputs = [rng.normal(size=400), rng.normal(size=300)]
    series = [scipy.signal.lfilter([1.0], [1.0, -0.7], rng.normal(size=u.size)) + 0.8 * np.roll(u, 1) for u in inputs]
    series[0][50] = np.nan
    through, start, innovations, parameters = _core.arx_model(series, [inputs], 4)
    lags = through.size - 1
    rows, wanted, whole = [], [], []
    for raw, given in zip(series, inputs, strict=True):
        e, u = raw - np.nanmean(raw), given - given.mean()
        for k in range(start, e.size):
            if not np.isnan(e[k]):
                own = [e[k - j] for j in range(1, 1 + lags)]
                rows.append([1.0, *(u[k - j] for j in range(1, 5)), *np.nan_to_num(own)])
                wanted.append(e[k])
                whole.append(not np.isnan(own).any())
    found = np.linalg.lstsq(np.array(rows), np.array(wanted), rcond=None)[0]
    assert parameters == 5 + lags
    assert start == 4
    np.testing.assert_allclose(-through[1:], found[5:], rtol=1e-9)
    power = sum(float(w @ w) for w in innovations)
    left = (np.array(wanted) - np.array(rows) @ found)[whole]
    np.testing.assert_allclose(power, left @ left, rtol=1e-9)


@pytest.mark.parametrize("true", ["foh", "zoh"])
@slow_after(1, "seeds", [1, 3])
def test_a_wrong_behavior_between_samples_is_found(true, seeds):
    """Half a sample of delay lies between the two; the finding has the estimate of the other one."""
    step, a, b = 0.05, -1.2, 2.5
    t = step * np.arange(900)
    u = SLOW_INPUTS["two sines"](t)
    other = {"foh": "zoh", "zoh": "foh"}[true]
    for seed in range(seeds):
        y = scipy.signal.lsim(([b], [1.0, -a]), u, t)[1] if true == "foh" else hold_response([b], [1.0, -a], u, step)
        y += np.random.default_rng(seed).normal(0.0, 0.02 * np.std(y), t.size)
        run = ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": y}, intersample={"u": true})
        structure = ftlm.equation("D y = a y + b u")
        right = ftlm.identify(run, structure)
        assert "other_intersample_fits" not in {f.code for f in right.findings}
        wrong = ftlm.identify(run.with_intersample({"u": other}), structure)
        (found,) = [f for f in wrong.findings if f.code == "other_intersample_fits"]
        assert (found.input, found.parameter, found.numbers["kind"]) == ("u", "a", true)
        assert abs(wrong.parameters["a"].value - a) > 8 * wrong.parameters["a"].standard_error
        assert found.numbers["other_value"] == pytest.approx(right.parameters["a"].value, rel=1e-4)


def test_an_input_of_noise_and_a_missing_lag_keep_their_behavior_between_samples():
    """Neither coloured noise nor a lag that the structure lacks passes for another reading of the input."""
    rng = np.random.default_rng(3)
    t = 0.05 * np.arange(900)
    for u, denominator in ((rng.normal(size=t.size), [1.0, 1.2]), (SLOW_INPUTS["two sines"](t), [0.2, 1.2, 1.2])):
        noise = scipy.signal.lfilter([1.0], [1.0, -0.9], rng.normal(size=t.size))
        y = hold_response([2.0], denominator, u, 0.05)
        run = ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": y + 0.05 * np.std(y) * noise})
        found = ftlm.identify(run, ftlm.equation("D y = a y + b u"))
        assert "other_intersample_fits" not in {f.code for f in found.findings}


def rubbing_motor(seed: int, friction: float) -> ftlm.Run:
    """Return the speed of a motor under steps of voltage, by Euler's method with sticking."""
    g = np.random.default_rng(seed)
    voltage = np.repeat(g.uniform(-6, 6, 40), 40)
    speed, speeds, step = 0.0, [], 0.01
    for u in voltage:
        speeds.append(speed)
        for _ in range(20):
            force = 12 * u - 3 * speed
            stuck = speed == 0.0 and abs(force) <= friction
            rub = friction * np.sign(speed if speed != 0.0 else force)
            after = speed + step / 20 * (force - rub)
            speed = 0.0 if stuck or after * speed < 0 else after
    y = np.array(speeds) + 0.05 * g.standard_normal(voltage.size)
    return ftlm.Run.from_arrays(step=step, inputs={"u": voltage}, outputs={"w": y})


@slow_after(1, "seed", range(3))
def test_friction_that_a_linear_model_lacks_is_named_with_the_term(seed):
    run, other = rubbing_motor(seed, 9.0), rubbing_motor(seed + 50, 9.0)
    found = ftlm.identify(run, ftlm.equation("D w = a w + b u"), threads=1)
    (said,) = [f for f in found.findings if f.code == "friction_fits"]
    assert not [f for f in found.findings if f.code == "noise_coloured"]
    assert found.validate(other).verdict.level == "with care"
    term = said.numbers["term"]
    assert term.startswith("- fc*tanh(")
    whole = ftlm.identify(run, ftlm.equation(f"D w = a w + b u {term}"), threads=1)
    assert not [f for f in whole.findings if f.code == "friction_fits"]
    for name, true in (("a", -3.0), ("b", 12.0), ("fc", 9.0)):
        assert whole.parameters[name].value == pytest.approx(true, rel=0.02)


@slow_after(1, "seeds", [4, 20])
def test_a_linear_motor_has_no_friction(seeds):
    said = [
        f
        for seed in range(seeds)
        for f in ftlm.identify(rubbing_motor(seed, 0.0), ftlm.equation("D w = a w + b u"), threads=1).findings
    ]
    assert not [f for f in said if f.code == "friction_fits"]
