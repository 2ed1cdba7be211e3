"""Bands of a simulation, against simulations at parameters that are drawn from the covariance."""

import numpy as np
import pytest

import ftlm
from ftlm.analysis.frequency_response import parameter_vector, with_parameter_vector
from ftlm.plot.comparison_charts import confidence_bands


def run(seed, samples=300):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], samples // 20), 20)
    plant = ftlm.Model(ftlm.equation("D^1.8 y = -0.4 D^0.8 y - 4 y + 4 u"))
    clean = plant.simulate(ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": 0 * u}))
    return clean.with_outputs({"y": clean["y"] + 0.05 * rng.standard_normal(samples)})


@pytest.fixture(scope="module")
def found():
    return ftlm.identify(run(1), ftlm.equation("D^1.8 y = a1 D^0.8 y + a0 y + b0 u"))


def test_band_is_the_spread_of_drawn_models(found):
    other = run(2)
    low, high = confidence_bands(found.model, other, found.model.compare(other))["y"]
    rng = np.random.default_rng(3)
    values, covariance = parameter_vector(found.model), np.array(found.model.estimate.covariance)
    free = np.flatnonzero(np.diag(covariance))
    drawn = np.tile(values, (300, 1))
    drawn[:, free] = rng.multivariate_normal(values[free], covariance[np.ix_(free, free)], size=300)
    simulated = [with_parameter_vector(found.model, v).compare(other).simulated["y"][0] for v in drawn]
    expected = 1.96 * np.std(simulated, axis=0)
    moved = expected > 0.1 * expected.max()
    ratio = ((high - low) / 2)[moved] / expected[moved]
    assert 0.9 < np.median(ratio) < 1.1
    assert np.all((ratio > 0.8) & (ratio < 1.25))


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
