"""Bands of a simulation, against simulations at parameters that are drawn from the covariance."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

import ftlm
from ftlm.analysis.frequency_response import linear_part, parameter_vector, response_deviation, with_parameter_vector
from ftlm.estimation.model_validation import validate_model
from ftlm.plot.comparison_charts import confidence_bands
from ftlm.report.html_report import model_page
from slow_cases import slow_after


def run(seed, samples=300):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], samples // 20), 20)
    plant = ftlm.Model(ftlm.equation("D^1.8 y = -0.4 D^0.8 y - 4 y + 4 u"))
    clean = plant.simulate(ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": 0 * u}))
    return clean.with_outputs({"y": clean["y"] + 0.05 * rng.standard_normal(samples)})


@pytest.fixture(scope="module")
def found():
    return ftlm.identify(run(1), ftlm.equation("D^1.8 y = a1 D^0.8 y + a0 y + b0 u"))


@slow_after(1, "draws", [80, 300])
def test_band_is_the_spread_of_drawn_models(found, draws):
    other = run(2)
    low, high = confidence_bands(found.model, other, found.model.compare(other))["y"]
    rng = np.random.default_rng(3)
    values, covariance = parameter_vector(found.model), np.array(found.model.estimate.covariance)
    free = np.flatnonzero(np.diag(covariance))
    drawn = np.tile(values, (draws, 1))
    drawn[:, free] = rng.multivariate_normal(values[free], covariance[np.ix_(free, free)], size=draws)
    simulated = [with_parameter_vector(found.model, v).compare(other).simulated["y"][0] for v in drawn]
    expected = 1.96 * np.std(simulated, axis=0)
    moved = expected > 0.1 * expected.max()
    ratio = ((high - low) / 2)[moved] / expected[moved]
    assert 0.9 < np.median(ratio) < 1.1
    assert np.all((ratio > 0.8) & (ratio < 1.25))


def test_a_negative_variance_by_rounding_is_none(found):
    matrix = np.array(found.model.estimate.covariance)
    # The order of the equation is fixed, so its variance is 0.
    assert matrix[0, 0] == 0.0
    matrix[0, 0] = -1e-22
    rounded = replace(found.model, estimate=msgspec.structs.replace(found.model.estimate, covariance=matrix.tolist()))
    other = run(2)
    with np.errstate(invalid="raise"):
        bands = [confidence_bands(m, other, m.compare(other))["y"] for m in (rounded, found.model)]
        assert validate_model(rounded, other).findings == validate_model(found.model, other).findings
    np.testing.assert_array_equal(*bands)


def delayed_lag(u, step, a, b, delay):
    """Samples of D y = -a y + b u(t - delay) from rest, exact for a held input."""
    whole, part = divmod(delay, step)
    late = np.r_[np.zeros(int(whole) + 1), u]
    y = np.zeros(u.size)
    for k in range(u.size - 1):
        # The older value of the input acts for `part`, the newer one for the rest of the interval.
        older, newer = late[k], late[k + 1]
        after = np.exp(-a * part) * y[k] + b / a * (1.0 - np.exp(-a * part)) * older
        y[k + 1] = np.exp(-a * (step - part)) * after + b / a * (1.0 - np.exp(-a * (step - part))) * newer
    return y


@pytest.fixture(scope="module")
def delayed():
    rng = np.random.default_rng(5)
    u = np.repeat(rng.choice([-1.0, 1.0], 20), 25)
    y = delayed_lag(u, 0.1, 1.5, 3.0, 0.234) + 0.2 * rng.standard_normal(u.size)
    run = ftlm.Run.from_arrays(step=0.1, inputs={"u": u}, outputs={"y": y})
    return run, ftlm.identify(run, ftlm.equation("D y = -a y + b u(t - 0:1)", initial="rest"))


def test_band_of_a_delayed_model_is_the_spread_of_drawn_delays_too(delayed):
    run, found = delayed
    assert found.names == ("a", "b", "delay_u")
    low, high = confidence_bands(found.model, run, found.model.compare(run))["y"]
    drawn = np.random.default_rng(3).multivariate_normal(found.joint.values, found.covariance, size=400)
    expected = 1.96 * np.std([delayed_lag(run["u"], 0.1, *v) for v in drawn], axis=0)
    moved = expected > 0.05 * expected.max()
    ratio = ((high - low) / 2)[moved] / expected[moved]
    assert 0.9 < np.median(ratio) < 1.1
    assert np.all((ratio > 0.7) & (ratio < 1.35)), (ratio.min(), ratio.max())


def test_deviation_of_step_and_frequency_response_includes_the_delay(delayed):
    found = delayed[1]
    a, b, delay = found.joint.values
    w = np.array([0.5, 3.0, 20.0])
    # d arg H = -w d(delay) + atan's derivative by a.
    gradient = np.array([w / (a * a + w * w), 0 * w, -w])
    expected = np.sqrt(np.einsum("iw,ij,jw->w", gradient, found.covariance, gradient))
    assert response_deviation(found.model, w)[1][0, 0] == pytest.approx(expected, rel=1e-5)
    response = found.model.step(np.linspace(0.0, 4.0, 401))
    t = response.time - delay
    slopes = np.array(
        [b * (t * a * np.exp(-a * t) - 1 + np.exp(-a * t)) / a**2, (1 - np.exp(-a * t)) / a, -b * np.exp(-a * t)]
    )
    after = t > 0.1
    expected = np.sqrt(np.einsum("it,ij,jt->t", slopes, found.covariance, slopes))
    assert response.deviation[0, 0][after] == pytest.approx(expected[after], rel=0.01)


def test_a_saved_model_keeps_the_covariance_of_its_delay(delayed, tmp_path):
    found = delayed[1]
    found.model.save(tmp_path / "m.json")
    again = ftlm.load_model(tmp_path / "m.json")
    assert np.sqrt(again.estimate.covariance[-1][-1]) == pytest.approx(found.standard_errors["delay_u"])


def test_a_model_without_covariance_has_no_band(found):
    other = run(2)
    plain = ftlm.identify(run(1), found.task.structure, method="least-squares").model
    assert confidence_bands(plain, other, plain.compare(other)) == {}


def test_the_page_shows_unseen_runs_with_their_band_first(found, tmp_path):
    text = found.report(tmp_path / "r.html", validation=run(2)).read_text(encoding="utf-8")
    heads = [
        "Validation: measured and simulated</h2>",
        "Equations</h2>",
        "Warnings</h2>",
        "Residuals</h2>",
        "Settings</h2>",
    ]
    places = [text.index(head) for head in heads]
    assert places == sorted(places)
    assert text.count("95 % confidence band of the simulation") == 1
    assert text.index('<details class="part">') > places[2]
    alone = found.report(tmp_path / "alone.html").read_text(encoding="utf-8")
    assert "Validation: measured and simulated" not in alone
    assert "95 % confidence band of the simulation" not in alone


def rubbing_run(seed, words="D^2 y = -1.5 D y + 4 u - 1.2*sign(D y)"):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-2.0, 2.0, 25), 20)
    clean = ftlm.Model(ftlm.equation(words)).simulate(
        ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": 0 * u})
    )
    return clean.with_outputs({"y": clean["y"] + 0.01 * rng.standard_normal(u.size)})


@pytest.fixture(scope="module")
def rubbing():
    return ftlm.identify(rubbing_run(1), ftlm.equation("D^2 y = -b D y + k u - fc*sign(D y)"))


@slow_after(1, "draws", [60, 200])
def test_band_of_a_model_with_friction_is_the_spread_of_drawn_models(rubbing, draws):
    other, rng = rubbing_run(2), np.random.default_rng(3)
    low, high = confidence_bands(rubbing.model, other, rubbing.model.compare(other))["y"]
    names = [n for n in rubbing.joint.names if n in ("b", "k", "fc")]
    assert names == rubbing.joint.names
    drawn = rng.multivariate_normal(rubbing.joint.values, rubbing.covariance, size=draws)
    structure = rubbing.task.structure
    simulated = [
        ftlm.Model(structure.with_coefficients(dict(zip(names, v, strict=True)))).compare(other).simulated["y"][0]
        for v in drawn.tolist()
    ]
    expected = 1.96 * np.std(simulated, axis=0)
    moved = expected > 0.1 * expected.max()
    ratio = ((high - low) / 2)[moved] / expected[moved]
    assert 0.85 < np.median(ratio) < 1.15


def test_the_page_of_a_model_with_friction_has_a_band_and_the_response_of_its_linear_part(rubbing, tmp_path):
    text = rubbing.report(tmp_path / "r.html", validation=rubbing_run(2)).read_text(encoding="utf-8")
    assert text.count("95 % confidence band of the simulation") == 1
    part = text[text.index("Frequency response</h2>") :]
    assert "without friction" in part
    assert "<svg" in part[: part.index("Settings</h2>")]
    # The linear part responds like an equation without friction, with the same covariance of its parameters.
    b, k = (rubbing.coefficients[n] for n in ("b", "k"))
    omega = np.array([0.5, 5.0])
    part_model = linear_part(rubbing.model)
    assert np.allclose(part_model.frequency_response(omega)[0, 0], k / ((1j * omega) ** 2 + b * 1j * omega))
    gain, _ = response_deviation(part_model, omega)
    rows = [rubbing.joint.names.index(n) for n in ("b", "k")]
    slopes = np.stack([-b / (omega**2 + b**2), np.full(2, 1 / k)])
    variance = np.einsum("iw,ij,jw->w", slopes, rubbing.covariance[np.ix_(rows, rows)], slopes)
    assert gain[0, 0] == pytest.approx(np.sqrt(variance), rel=1e-3)


def test_the_page_of_a_nonlinear_model_has_no_empty_section(tmp_path):
    model = ftlm.Model(ftlm.equation("D y = -2 y^3 + 3 u"))
    text = model_page(model, tmp_path / "r.html").read_text(encoding="utf-8")
    assert "Frequency response</h2>" not in text
