"""Initial terms that represent past inputs: the core's posterior means beside an oracle of NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import ftlm
import past_inputs_oracle
from ftlm.simulation.initial_conditions import history
from ftlm.simulation.output_samples import INITIAL_STATE_REFINEMENT, nonuniform_sample_times, output_simulation
from ftlm.simulation.step_refinement import _fit_past_inputs

ROWS, BEFORE, STEP = 500, 300, 0.05
FILTER = ftlm.SensorFilter.low_pass(["x"])
MODELS = {
    "fractional": ("D^1.6 y = -2 y - 0.5 D^0.4 y + 3 u", {}),
    "low order": ("D^0.7 y = -2 y + 3 u", {}),
    "integer orders": ("D^2 y = -4 y - 0.5 D y + 3 u", {}),
    "two outputs": ("D^1.5 y = -2 y - 0.5 D^0.5 y + 0.4 x + 3 u; D^0.8 x = -x + y", {"coupling": "simulated"}),
    "sensor filter": (
        "D^1.5 y = -2 y - 0.5 D^0.5 y + 3 u; D^0.8 x = -x + y",
        {"coupling": "simulated", "sensor_filter": FILTER},
    ),
}


def second_part(model: ftlm.Model, seed: int) -> ftlm.Run:
    """A run that starts in motion: the second part of a simulation from rest, with noise."""
    g = np.random.default_rng(seed)
    u = np.repeat(g.choice([-1.0, 1.0], (BEFORE + ROWS) // 10), 10)
    outputs = model.outputs
    whole = ftlm.Run.from_arrays(step=STEP, inputs={"u": u}, outputs={o: np.zeros(u.size) for o in outputs})
    measured = {o: ftlm.simulate(model, whole)[o] for o in outputs}
    noisy = {o: y + 0.02 * np.std(y) * g.standard_normal(y.size) for o, y in measured.items()}
    return ftlm.Run.from_arrays(step=STEP, inputs={"u": u[BEFORE:]}, outputs={o: y[BEFORE:] for o, y in noisy.items()})


def with_nonuniform_samples(run: ftlm.Run) -> ftlm.Run:
    """The run read at its own times, up to 0.2 of a sampling interval away."""
    g = np.random.default_rng(8)
    times = run.time + np.r_[0.0, g.uniform(-0.2, 0.2, run.length - 2), 0.0] * run.step
    outputs = {n: np.interp(times, run.time, run[n]) for n in run.outputs}
    return ftlm.Run.from_arrays(time=times, inputs={"u": run["u"]}, outputs=outputs, resample=STEP)


def with_missing_samples(run: ftlm.Run) -> ftlm.Run:
    """The run without 15 % of the samples of its outputs."""
    g = np.random.default_rng(9)
    outputs = {n: np.where(g.uniform(size=run.length) < 0.15, np.nan, run[n]) for n in run.outputs}
    return ftlm.Run.from_arrays(
        step=run.step, inputs={n: run[n] for n in run.inputs}, outputs=outputs, missing="weight"
    )


def simulated(core, terms) -> np.ndarray:
    """Outputs with given initial terms; the exponent ∞ is a level."""
    powers = [[(e, c) for e, c in own if np.isfinite(e)] for own in terms]
    outputs = core.refine((False, powers, False), 1e-6, 1 << 17, 1 << 14, 1 << 30)[0][0]
    return outputs + np.array([[dict(own).get(np.inf, 0.0)] for own in terms])


def check(model: ftlm.Model, run: ftlm.Run) -> None:
    """Compare outputs with the initial terms of the core and of the oracle. The powers themselves nearly coincide."""
    model = replace(model, structure=replace(model.structure, initial=history(run, model.structure)))
    times = nonuniform_sample_times(model, run)
    core, terms = output_simulation(model, run, None, times, INITIAL_STATE_REFINEMENT)
    expected = past_inputs_oracle.fit_past_inputs(core, model, run, terms, run.time if times is None else times)
    fitted = _fit_past_inputs(core, model, terms, 1 << 17)
    assert fitted is not None
    assert [[e for e, _ in own] for own in fitted[1]] == [[e for e, _ in own] for own in expected]
    fitted_response, expected_response, rest = (
        simulated(core, each) for each in (fitted[1], expected, [[] for _ in expected])
    )
    np.testing.assert_allclose(fitted_response, expected_response, atol=2e-4 * np.abs(expected_response).max())
    assert np.max(np.abs(expected_response - rest)) > 0.1 * np.std(expected_response)


@pytest.mark.parametrize("name", MODELS)
def test_posterior_means_equal_those_of_the_oracle(name):
    words, options = MODELS[name]
    model = ftlm.Model(ftlm.equation(words, **options))
    check(model, second_part(model, 3))


@pytest.mark.parametrize("change", [with_nonuniform_samples, with_missing_samples])
def test_posterior_means_need_no_regular_samples(change):
    model = ftlm.Model(ftlm.equation(MODELS["fractional"][0]))
    check(model, change(second_part(model, 4)))


def test_a_level_has_no_prior():
    model = ftlm.Model(ftlm.equation(MODELS["low order"][0], offset="level"))
    run = second_part(model, 5)
    check(model, run.with_samples({"y": run["y"] - run["y"][0]}))
