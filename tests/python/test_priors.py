"""Normal priors of parameters, compared with the posterior mode that SciPy finds from the exact response."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import least_squares
from typer.testing import CliRunner

import ftlm
from ftlm.cli.main import app
from test_bounds import INPUT, STEP, oscillator

pytestmark = pytest.mark.usefixtures("no_extension_tests")

COUNT = INPUT.size
OSCILLATOR = "D^2 y = a1 D y + a0 y + b u"
TRUTH = {"a1": -0.05, "a0": -4.0, "b": 3.0}


def noisy(seed: int, deviation: float, count: int = COUNT) -> ftlm.Run:
    y = oscillator(**TRUTH) + deviation * np.random.default_rng(seed).standard_normal(COUNT)
    return ftlm.Run.from_arrays(outputs={"y": y[:count]}, inputs={"u": INPUT[:count]}, step=STEP)


def values(found: ftlm.Identification, names: tuple[str, ...] = tuple(TRUTH)) -> list[float]:
    return [found.parameters[n].value for n in names]


def errors(found: ftlm.Identification, names: tuple[str, ...] = tuple(TRUTH)) -> list[float]:
    return [found.parameters[n].standard_error for n in names]


def assert_same_as_fixed(narrow: ftlm.Identification, fixed: ftlm.Identification) -> None:
    """Check that a narrow prior gives the estimates and the standard errors of a fit with a fixed value."""
    names = tuple(fixed.parameters)
    assert np.abs(np.subtract(values(narrow, names), values(fixed, names)) / errors(fixed, names)).max() < 0.05
    assert errors(narrow, names) == pytest.approx(errors(fixed, names), rel=0.02)


@pytest.mark.parametrize(
    "priors",
    [
        {"b": (3.2, 0.05)},
        {"a1": (-0.08, 0.01), "b": (2.9, 0.03)},
        {"a1": (-0.05, 1e-4), "a0": (-4.0, 1e-4), "b": (3.0, 1e-4)},
    ],
)
def test_the_estimate_is_the_maximum_of_the_posterior_and_its_errors_are_the_inverse_information(priors):
    run = noisy(0, 0.5)
    found = ftlm.identify(run, OSCILLATOR, priors=priors)
    noise = found.settings["noise"]["y"]

    def residuals(p: np.ndarray) -> np.ndarray:
        deviations = [(p[k] - priors[n][0]) / priors[n][1] for k, n in enumerate(TRUTH) if n in priors]
        # The first sample of a run at rest is an initial value, which has no residual.
        return np.r_[(oscillator(*p) - run["y"])[1:] / noise, deviations]

    oracle = least_squares(residuals, [*TRUTH.values()], x_scale=[0.01, 0.1, 0.1], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    posterior = np.sqrt(np.diag(np.linalg.inv(oracle.jac.T @ oracle.jac)))
    # The noise level, and so the weight of the priors, is iterated to one per cent.
    assert np.abs((values(found) - oracle.x) / posterior).max() < 0.05
    assert errors(found) == pytest.approx(posterior, rel=0.01)


def test_standardized_errors_of_drawn_parameters_have_unit_mean_square():
    """If true parameters are drawn from the prior, errors over posterior deviations have unit variance."""
    squares = []
    random = np.random.default_rng(5)
    prior = {"a1": (-0.05, 0.02), "b": (3.0, 0.05)}
    for _ in range(24):
        truth = {**TRUTH, **{n: mean + s * random.standard_normal() for n, (mean, s) in prior.items()}}
        y = oscillator(**truth) + 0.5 * random.standard_normal(COUNT)
        run = ftlm.Run.from_arrays(outputs={"y": y}, inputs={"u": INPUT}, step=STEP)
        method = ftlm.OutputError(priors=prior, start=TRUTH, intervals="quadratic")
        found = ftlm.identify(run, OSCILLATOR, initial="rest", offset="none", method=method)
        squares.append(np.square((np.array(values(found)) - [*truth.values()]) / errors(found)))
    # Mean of 72 squared standard normal variables; those of a0 and b are correlated.
    assert 0.6 < np.mean(squares) < 1.45


@pytest.mark.parametrize(
    ("structure", "options"),
    [
        ("D^alpha y = a y + b u", {}),
        ("D^alpha y = a y + b u", {"method": ftlm.OutputError(loss="huber")}),
        ("D^alpha y = a y + b u", {"method": ftlm.OutputError(noise="ar")}),
        ("D^alpha y = a y + c y^3 + b u", {}),
        ("D^alpha y = a y + b u(t - 0:0.2)", {}),
    ],
    ids=["linear", "huber", "autoregression", "cube", "delay"],
)
def test_a_narrow_prior_is_a_fixed_value_and_a_wide_one_changes_nothing(structure, options):
    rng = np.random.default_rng(2)
    delay = {"u": 0.06} if "0:0.2" in structure else {}
    model = ftlm.Model(ftlm.equation("D^0.8 y = -1.5 y + 2 u", delay=delay))
    u = np.repeat(rng.choice([-1.0, 1.0], 20), 15)
    y = model.simulate(ftlm.Run.from_arrays(inputs={"u": u}, outputs={"y": 0 * u}, step=0.04))["y"]
    y = y + 0.01 * rng.standard_normal(u.size)
    run = ftlm.Run.from_arrays(inputs={"u": u}, outputs={"y": y}, step=0.04)
    narrow = ftlm.identify(run, structure, priors={"alpha": (0.75, 1e-7)}, **options)
    fixed = ftlm.identify(run, structure.replace("alpha", "0.75"), **options)
    assert narrow.parameters["alpha"].value == pytest.approx(0.75, abs=1e-5)
    assert_same_as_fixed(narrow, fixed)
    free = ftlm.identify(run, structure, **options)
    wide = ftlm.identify(run, structure, priors={n: (p.value, 1e4) for n, p in free.parameters.items()}, **options)
    names = tuple(free.parameters)
    assert np.abs(np.subtract(values(wide, names), values(free, names)) / errors(free, names)).max() < 0.02
    assert errors(wide, names) == pytest.approx(errors(free, names), rel=0.02)


def test_a_narrow_prior_of_friction_is_a_fixed_friction():
    rng, step, position, speed, rows = np.random.default_rng(0), 0.01, 0.0, 0.0, []
    force = np.repeat(rng.choice([-3.0, 0.0, 3.0], 30), 20)
    for applied in force:
        rows.append(position)
        for _ in range(20):
            drive = applied - 0.5 * speed
            friction = 0.8 * np.sign(speed) if speed else np.clip(drive, -0.8, 0.8)
            next_speed = speed + step / 20 * (drive - friction)
            speed = 0.0 if speed * next_speed < 0 else next_speed
            position += step / 20 * speed
    y = np.array(rows) + 1e-3 * rng.standard_normal(force.size)
    run = ftlm.Run.from_arrays(inputs={"u": force}, outputs={"y": y}, step=step)
    narrow = ftlm.identify(run, "D^2 y = -a D y + b u - fc*sign(D y)", priors={"fc": (0.7, 1e-6)})
    assert_same_as_fixed(narrow, ftlm.identify(run, "D^2 y = -a D y + b u - 0.7*sign(D y)"))


@pytest.mark.parametrize("coupling", ["simulated", "measured"])
def test_a_prior_holds_in_coupled_equations(coupling):
    rng, step, state, rows = np.random.default_rng(0), 0.02, np.zeros(5), []
    system = np.zeros((5, 5))
    system[:4, :4] = [[0, 1, 0, 0], [-9, -0.3, 2, 0], [0, 0, 0, 1], [1, 0, -4, -0.2]]
    system[1, 4] = 3.0
    transition, u = expm(step * system), np.repeat(rng.choice([-1.0, 1.0], 40), 15)
    for input_value in u:
        rows.append(state[[0, 2]])
        state = transition @ [*state[:4], input_value]
    y, z = np.transpose(rows) + [[0.01], [0.002]] * rng.standard_normal((2, u.size))
    run = ftlm.Run.from_arrays(inputs={"u": u}, outputs={"y": y, "z": z}, step=step)
    second = ftlm.equation("D^2 z = d D z + e z + g y").equations[0]

    def structure(k: str) -> ftlm.Structure:
        first = ftlm.equation(f"D^2 y = a D y + c y + {k} z + b u")
        return replace(first, equations=(first.equations[0], second), coupling=coupling)

    narrow = ftlm.identify(run, structure("k"), offset="none", priors={"k": (1.8, 1e-7)})
    assert_same_as_fixed(narrow, ftlm.identify(run, structure("1.8"), offset="none"))


def test_a_prior_contributes_what_a_short_run_lacks():
    """In 40 rows the damping is poorly identifiable; a prior in addition determines it."""
    run = noisy(1, 0.02, 40)
    alone = ftlm.identify(run, OSCILLATOR, initial="rest", offset="none")
    found = ftlm.identify(run, OSCILLATOR, initial="rest", offset="none", priors={"a1": (-0.05, 0.005)})
    assert alone.parameters["a1"].standard_error > 0.05
    assert found.parameters["a1"].standard_error == pytest.approx(0.005, rel=0.05)
    assert found.parameters["a0"].standard_error < alone.parameters["a0"].standard_error
    assert [f.parameter for f in found.findings if f.code == "prior_determines_parameter"] == ["a1"]
    assert "priors: a1 = -0.05 ± 0.005" in found.details()


def test_profile_intervals_include_the_prior():
    run = noisy(1, 0.02, 40)
    method = ftlm.OutputError(intervals="profile", priors={"a1": (-0.05, 0.005)})
    found = ftlm.identify(run, OSCILLATOR, initial="rest", offset="none", method=method)
    low, high = found.parameters["a1"].interval
    assert (high - low) / 2 == pytest.approx(1.96 * 0.005, rel=0.05)


@pytest.mark.parametrize(("mean", "contradicts"), [(3.0, False), (3.1, False), (3.6, True), (2.4, True)])
def test_a_prior_that_the_runs_contradict_is_named(mean, contradicts):
    found = ftlm.identify(noisy(0, 0.5), OSCILLATOR, priors={"b": (mean, 0.05)})
    assert any(f.code == "prior_contradicts_runs" for f in found.findings) == contradicts
    if contradicts:
        assert any("the runs contradict the prior of b" in reason for reason in found.verdict.reasons)


def test_a_correct_prior_rarely_contradicts_the_runs():
    """Prior means are drawn around the true value; a finding is then a false alarm."""
    random, exceeded = np.random.default_rng(8), []
    for seed in range(30):
        run, mean = noisy(seed, 0.5), 3.0 + 0.05 * random.standard_normal()
        method = ftlm.OutputError(priors={"b": (mean, 0.05)}, start=TRUTH, intervals="quadratic")
        found = ftlm.identify(run, OSCILLATOR, initial="rest", offset="none", method=method)
        exceeded += [f.code for f in found.findings if f.code == "prior_contradicts_runs"]
    assert len(exceeded) <= 1


def test_the_command_line_has_priors(tmp_path):
    run = noisy(0, 0.5)
    run.to_csv(tmp_path / "run.csv")
    arguments = ["identify", str(tmp_path / "run.csv"), "--structure", OSCILLATOR, "--priors", "b=3.2:0.05"]
    outcome = CliRunner().invoke(app, [*arguments, "-u", "u", "-y", "y"])
    assert outcome.exit_code == 0, outcome.output
    expected = ftlm.identify(run, OSCILLATOR, priors={"b": (3.2, 0.05)}).parameters["b"].value
    assert f"b = {expected:.3f}: its prior 3.2 ± 0.05 contributes" in outcome.output
    outcome = CliRunner().invoke(app, [*arguments[:-1], "b=3.2", "-u", "u", "-y", "y"])
    assert outcome.exit_code != 0
    assert "'3.2' is not MEAN:DEVIATION; write it as in 2:0.1" in outcome.output.replace("\n", " ")


@pytest.mark.parametrize(
    ("priors", "options", "words"),
    [
        ({"B": (0, 1)}, {}, "prior of 'B' does not occur in the equation; known: a1, a0, b"),
        ({"b": (2, 0)}, {}, r"prior of b = \(2, 0\) is not a finite mean and a positive standard deviation"),
        ({"b": (math.nan, 1)}, {}, "is not a finite mean and a positive standard deviation; write priors="),
        ({"b": 3}, {}, "prior of b = 3 is not a finite mean"),
        ({"b": (0, math.inf)}, {}, "is not a finite mean"),
        ([("b", 1)], {}, "priors = .* is not a mapping; write"),
        ({"b": (0, 1)}, {"method": "least-squares"}, "priors= is not used by method='least-squares'"),
        ({"b": (0, 1)}, {"method": ftlm.OutputError(reference="r")}, "priors= cannot be used with reference="),
    ],
)
def test_invalid_priors_are_refused(priors, options, words):
    with pytest.raises(ftlm.ModelError, match=words):
        ftlm.identify(noisy(0, 0.5), OSCILLATOR, priors=priors, **options)


def test_a_coefficient_that_follows_from_a_law_has_no_prior_of_its_own():
    structure = ftlm.flexible_link()
    name = structure.coefficient_law[0][0] if structure.coefficient_law else None
    assert name is not None
    run = noisy(0, 0.5)
    with pytest.raises(ftlm.ModelError, match=f"priors= has {name}, which follows from the coefficient law"):
        ftlm.identify(run.rename({"y": structure.outputs[0]}), structure, priors={name: (0.0, 1.0)})
