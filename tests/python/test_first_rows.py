"""The first rows of a run: at rest, at its own level, in motion; held against SciPy's recursion and least squares."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares
from scipy.signal import cont2discrete, lfilter
from scipy.stats import beta

import arm_measured
import ftlm
from ftlm.estimation import estimators
from ftlm.estimation.nuisance_parameters import refit_after_screening
from ftlm.estimation.output_error import fit_output_error
from ftlm.simulation.initial_conditions import rest_evidence
from measured import needs_data
from slow_cases import slow_after

H = 0.5


def plant(numerator, denominator, u, h=H):
    """Samples of a transfer function from rest, with a held input, by the exact recursion of SciPy."""
    b, a, _ = cont2discrete((numerator, denominator), h)
    return lfilter(np.ravel(b), a, u)


def run_of(u, y, h=H, **more):
    return ftlm.Run.from_arrays(step=h, inputs={"u": u}, outputs={"y": y}, **more)


def step_input(rows, at, low=0.0, high=5.0):
    return np.where(np.arange(rows) < at, low, high)


def oracle(u, y, before, h=H):
    """Least squares of gain, time constant and level of a lag from rest, with standard errors; SciPy alone."""

    def residuals(p):
        return p[2] + plant([p[0]], [np.exp(p[1]), 1.0], u - before, h) - y

    found = least_squares(residuals, [1.0, np.log(10.0), y[0]], x_scale="jac")
    spread = np.linalg.inv(found.jac.T @ found.jac) * 2 * found.cost / (y.size - 3)
    return found.x, np.sqrt(np.diag(spread))


def gain_of(result):
    c = result.coefficients
    return -c["b"] / c["a"]


def codes(result):
    return {f.code for f in result.findings}


WORDS = "D y = a y + b u"


@pytest.mark.parametrize(("level", "low"), [(20.0, 0.0), (-3.5, 0.0), (61.0, 2.0), (0.0, 2.0)])
def test_a_plant_that_rests_at_its_level_gives_the_oracles_numbers(level, low):
    u = step_input(240, 30, low, 5.0)
    noise = 0.05 * np.random.default_rng(11).standard_normal(240)
    y = level + plant([1.7], [12.0, 1.0], u - low) + noise
    found = ftlm.identify(run_of(u, y), ftlm.equation(WORDS))
    (gain, tau, known), errors = oracle(u, y, low)
    assert gain_of(found) == pytest.approx(gain, rel=2e-3)
    assert -1 / found.coefficients["a"] == pytest.approx(np.exp(tau), rel=4e-3)
    assert found.comparison.offsets[0]["y"]["level"] == pytest.approx(known, abs=0.3 * errors[2])
    # Of log(time constant): that of a is the same share of it.
    assert found.standard_errors["a"] / abs(found.coefficients["a"]) == pytest.approx(errors[1], rel=0.15)
    assert found.settings["initial"] == "rest"
    assert found.settings["offset"] == "level"
    assert "rests_at_level" in codes(found)
    assert "30 quiet rows" in str(found)


@pytest.mark.parametrize(("alpha", "seed"), [("alpha", 0), ("1", 1)])
def test_a_step_after_rest_is_not_swallowed(alpha, seed):
    u = step_input(400, 25)
    y = plant([2.0], [15.0 * 40.0, 55.0, 1.0], u) + 0.02 * np.random.default_rng(seed).standard_normal(400)
    found = ftlm.identify(run_of(u, y), ftlm.equation(f"D^{alpha} y = a y + b u"))
    assert gain_of(found) == pytest.approx(2.0, rel=0.25)
    assert found.settings["initial"] == "rest"
    assert "level" not in str(found.settings.get("offset"))
    # Nor by the fit that is printed.
    assert not any(found.comparison.initial[0]["y"])


@pytest.mark.parametrize("constant", ["none", "constant"])
@pytest.mark.parametrize("level", [0.0, 20.0])
def test_an_input_that_is_on_from_the_first_row_assumes_rest_and_says_so(level, constant):
    u = np.full(300, 4.0)
    y = level + plant([0.7], [40.0, 1.0], u) + 0.01 * np.random.default_rng(3).standard_normal(300)
    found = ftlm.identify(run_of(u, y), ftlm.equation(WORDS, offset=constant))
    assert gain_of(found) == pytest.approx(0.7, rel=0.05)
    said = [f for f in found.findings if f.code == "rest_assumed"]
    assert len(said) == 1
    assert "u is constant from row 0 on" in said[0].text
    assert "the estimated gain assumes that the plant rested at y = " in said[0].text


def test_a_coarse_swing_in_motion_is_not_taken_for_rest():
    rest = 0
    for seed in range(4):
        g = np.random.default_rng(50 + seed)
        u = np.repeat(g.choice([-1.0, 1.0], 120), 3)[:320]
        y = plant([90.0], [1.0, 0.5, 90.0], u, 0.07)[120:]
        y += 0.004 * y.std() * g.standard_normal(y.size)
        found = ftlm.identify(run_of(u[120:], y, 0.07), ftlm.equation("D^2 y = -p D y - q y + b u"))
        rest += found.settings["initial"] == "rest"
        assert found.coefficients["p"] == pytest.approx(0.5, abs=0.1)
    assert rest == 0


@pytest.mark.parametrize("method", ["least-squares", "instrumental-variables", "multi-innovation"])
def test_equation_error_methods_see_deviations_from_the_level(method):
    u = np.concatenate([np.zeros(20), np.repeat(np.random.default_rng(5).choice([-1.0, 1.0], 30), 10)])
    y = 35.0 + plant([3.0], [6.0, 1.0], u) + 1e-3 * np.random.default_rng(6).standard_normal(u.size)
    found = ftlm.identify(run_of(u, y), ftlm.equation(WORDS), method=method)
    assert gain_of(found) == pytest.approx(3.0, rel=0.03)
    assert found.fit["y"] > 95
    assert found.comparison.offsets[0]["y"]["level"] == pytest.approx(35.0, abs=0.05)


def test_free_orders_at_a_level():
    u = np.concatenate([np.zeros(16), np.repeat(np.random.default_rng(7).choice([0.0, 1.0], 24), 12)])
    model = ftlm.Model(ftlm.equation("D^0.7 y = -0.4 y + 0.9 u"))
    clean = model.simulate(run_of(u, np.zeros(u.size)))["y"]
    run = run_of(u, clean + 8.0 + 0.005 * np.random.default_rng(8).standard_normal(u.size))
    found = ftlm.identify(run, ftlm.equation("D^alpha y = a y + b u"))
    assert found.orders["alpha"] == pytest.approx(0.7, abs=0.03)
    assert gain_of(found) == pytest.approx(2.25, rel=0.05)
    assert found.comparison.offsets[0]["y"]["level"] == pytest.approx(8.0, abs=0.01)


def test_runs_at_different_levels_are_one_fit():
    runs = []
    for k, level in enumerate((20.0, -4.0, 0.0)):
        u = step_input(160, 20 + k, high=3.0 + k)
        y = level + plant([1.2], [9.0, 1.0], u) + 0.01 * np.random.default_rng(k).standard_normal(160)
        runs.append(run_of(u, y, name=f"r{k}"))
    found = ftlm.identify(runs, ftlm.equation(WORDS))
    assert gain_of(found) == pytest.approx(1.2, rel=0.01)
    levels = [offsets.get("y", {}).get("level", 0.0) for offsets in found.comparison.offsets]
    assert levels == pytest.approx([20.0, -4.0, 0.0], abs=0.02)


def test_a_level_is_known_to_models_comparisons_and_files(tmp_path):
    u = step_input(200, 20)
    y = 12.0 + plant([1.7], [12.0, 1.0], u) + 0.01 * np.random.default_rng(1).standard_normal(200)
    found = ftlm.identify(run_of(u, y), ftlm.equation(WORDS), offset="level")
    assert found.model.structure.offset == "level"
    found.model.save(tmp_path / "m.json")
    again = ftlm.load_model(tmp_path / "m.json")
    assert again.structure.offset == "level"
    assert again.compare(run_of(u, y)).fit == pytest.approx(found.fit)
    # The printed fit is that of the simulation and the level, sample by sample.
    level = found.comparison.offsets[0]["y"]["level"]
    c = found.coefficients
    by_hand = level + plant([-c["b"] / c["a"]], [-1 / c["a"], 1.0], u)
    assert found.comparison.simulated["y"][0] == pytest.approx(by_hand, abs=1e-6)
    # simulate() is the answer of the equations, from rest.
    assert again.simulate(run_of(u, y))["y"] == pytest.approx(by_hand - level, abs=1e-6)
    assert found.parameters["level_y"].value == level
    assert any(line.split()[:2] == ["level_y", f"{level:.6g}"] for line in str(found).splitlines())
    page = found.report(tmp_path / "page.html").read_text(encoding="utf-8")
    assert "level" in page


def test_a_model_from_zero_predicts_a_run_at_another_level_from_rest():
    u = step_input(200, 20)
    y = plant([1.7], [12.0, 1.0], u) + 0.01 * np.random.default_rng(1).standard_normal(200)
    found = ftlm.identify(run_of(u, y), ftlm.equation("D^alpha y = a y + b u"))
    other = step_input(200, 40, 1.0, -2.0)
    there = 55.0 + plant([1.7], [12.0, 1.0], other - 1.0) + 0.01 * np.random.default_rng(2).standard_normal(200)
    compared = found.model.compare(run_of(other, there))
    assert compared.fit["y"] > 99
    # One number, no history.
    assert list(compared.initial[0]["y"]) == [np.inf]


@pytest.mark.parametrize("early", [0.0, 0.6])
@slow_after(1, "seeds", [2, 6])
def test_an_output_that_moves_before_its_input_is_named_with_the_rows(early, seeds):
    said = 0
    for seed in range(seeds):
        t = np.arange(80.0)
        y = (
            7.0
            + 15 * (1 - np.exp(-np.maximum(t - 12 + early, 0) / 18))
            + 0.05 * np.random.default_rng(seed).standard_normal(80)
        )
        found = ftlm.identify(run_of(step_input(80, 12, high=3.0), y, 1.0), ftlm.equation(WORDS + " + c"))
        for item in found.findings:
            if item.code == "moves_before_input":
                said += 1
                assert item.numbers["rows"] == pytest.approx(early, abs=0.3)
                assert "y moves before its input" in item.text
    assert said == (seeds if early else 0)


def test_given_starts_overrule():
    u = step_input(200, 20)
    y = 12.0 + plant([1.7], [12.0, 1.0], u) + 0.01 * np.random.default_rng(1).standard_normal(200)
    rest = ftlm.identify(run_of(u, y), ftlm.equation(WORDS, initial="rest"))
    assert "offset" not in rest.settings
    caputo = ftlm.identify(run_of(u, y), ftlm.equation(WORDS, initial="caputo"))
    assert caputo.settings["initial"] == "caputo"
    both = ftlm.identify(run_of(u, y), ftlm.equation(WORDS, initial="caputo", offset="level"))
    assert both.settings["offset"] == "level"
    assert gain_of(both) == pytest.approx(1.7, rel=0.01)
    with pytest.raises(ftlm.ModelError, match="use 'none', 'level', 'constant', 'ramp' or 'auto'"):
        ftlm.equation(WORDS, offset="nothing")


def test_a_level_that_is_asked_for_does_not_imply_rest():
    # The input is 20 before the first row, too; nothing shows whether the plant rested then.
    u = np.full(800, 20.0)
    u[60:400], u[400:] = 45.0, 30.0
    pole = np.exp(-1 / 40)
    y = 55 + lfilter([0, 0.6 * (1 - pole)], [1, -pole], u - 20) + 0.1 * np.random.default_rng(0).standard_normal(800)
    run = ftlm.Run.from_arrays(step=1.0, inputs={"u": u}, outputs={"y": y})
    found = ftlm.identify(run, ftlm.equation("D y = a y + b u", offset="level"))
    assert found.parameters["a"].value == pytest.approx(-1 / 40, rel=0.02)
    assert found.parameters["b"].value == pytest.approx(0.6 / 40, rel=0.02)
    assert found.fit["y"] > 97
    assert found.model.compare(run).fit["y"] > 97


@pytest.mark.parametrize("seed", [0, 3])
def test_a_run_that_settles_within_a_few_rows_is_compared_as_it_was_fitted(seed):
    # The response to initial values is over after a few of 100 samples, and its residuals from rest pass for white.
    pole, records = np.exp(-0.5), []
    for k in (seed, seed + 50):
        g = np.random.default_rng(k)
        u = np.repeat(g.choice([-1.0, 1.0], 11), 10)[:100]
        y = 20 + lfilter([0, 1 - pole], [1, -pole], u) + 5 * pole ** np.arange(100) + 0.02 * g.standard_normal(100)
        records.append(run_of(u, y, 1.0, name=f"r{k}"))
    found = ftlm.identify(records[0], ftlm.equation(WORDS))
    assert found.fit["y"] == pytest.approx(100 * (1 - 0.02 / np.std(records[0]["y"])), abs=0.5)
    assert found.comparison.initial[0]["y"] == pytest.approx({0.0: 5.0, np.inf: 20.0}, abs=0.1)
    validation = found.validate(records[1])
    assert validation.fit["y"] == pytest.approx(100 * (1 - 0.02 / np.std(records[1]["y"])), abs=0.5)


@pytest.mark.parametrize("tau", [20.0, 40.0])
def test_an_output_counted_from_its_first_sample_in_motion_has_the_pole_of_the_plant(tau):
    # A chirp about 5, and colored noise. The residuals of a start from rest oscillate without a slow component.
    pole, t, g = np.exp(-1 / tau), np.arange(600), np.random.default_rng(0)
    u = np.sin(2 * np.pi * (t / 150 + t * t / 1200 * (1 / 12 - 1 / 150)))
    y = lfilter([0, 1 - pole], [1, -pole], u)[300:]
    y += 0.01 * np.std(y) * lfilter([0.19**0.5], [1, -0.9], g.standard_normal(399))[99:]
    found = ftlm.identify(run_of(5 + u[300:], y - y[0], 1.0), ftlm.equation(WORDS))
    assert found.settings["initial"] == "caputo"
    assert found.coefficients["a"] == pytest.approx(-1 / tau, rel=0.03)
    assert found.fit["y"] > 98.5


@pytest.mark.parametrize("quiet", [0, 20])
def test_the_noise_of_a_first_reading_that_was_subtracted_is_a_level(quiet):
    """The angle of a servo, an integrator with a lag, minus its first reading."""
    b, a, _ = cont2discrete(([0.05], [8, 1, 0]), 1.0)[:3]
    u = np.where(np.arange(400) < quiet, 0.0, 1.0)
    angle = lfilter(np.ravel(b), a, u)
    for seed in (101, 102, 103):
        y = angle + 0.01 * np.std(angle) * np.random.default_rng(seed).standard_normal(u.size)
        run = ftlm.Run.from_arrays(step=1.0, inputs={"u": u}, outputs={"y": y - y[0]})
        found = ftlm.identify(run, ftlm.equation("D^2 y = a1 D y + b0 u"), threads=1)
        for name, truth in (("a1", -0.125), ("b0", 0.05 / 8), ("level_y", -y[0])):
            assert abs(found.parameters[name].value - truth) < 4 * found.parameters[name].standard_error
    # A counter that begins at 0 has no such noise.
    counts = np.round(angle / 0.01) * 0.01
    counter = ftlm.Run.from_arrays(step=1.0, inputs={"u": u}, outputs={"y": counts})
    found = ftlm.identify(counter, ftlm.equation("D^2 y = a1 D y + b0 u"), threads=1)
    assert "level_y" not in found.parameters


def blank_run(u, step=0.05, kind="foh"):
    return ftlm.Run.from_arrays(step=step, inputs={"f": u}, outputs={"y": 0 * u}, intersample={"f": kind})


def test_initial_values_of_the_textbook_are_those_of_caputo():
    """Bagley and Torvik: D^2 y + D^1.5 y + y = 1 + t with y(0) = y'(0) = 1 has the solution 1 + t."""
    t = 0.05 * np.arange(201)
    run = blank_run(1 + t)
    model = ftlm.Model(ftlm.equation("D^2 y = -1 D^1.5 y - 1 y + 1 f"))
    assert model.simulate(run, initial={"y": [1.0, 1.0]})["y"] == pytest.approx(1 + t, abs=1e-5)
    with pytest.raises(
        ftlm.ModelError, match=r"powers \{0: 1, 0\.5: 1\.12838, 1: 1, 1\.5: 0\.752.*'y': \[1\.0, 1\.0\]"
    ):
        model.simulate(run, initial={"y": {0.0: 1.0, 1.0: 1.0}})
    powers = {0.0: 1.0, 0.5: 1.1283791671, 1.0: 1.0, 1.5: 0.7522527781}
    assert model.simulate(run, initial={"y": powers})["y"] == pytest.approx(1 + t, abs=1e-5)
    model.simulate(run, initial={"y": {0.0: 1.0, 1.0: 1.0, 0.5: 0.0, 1.5: 0.0}})


def test_initial_values_of_whole_orders_are_those_of_a_differential_equation():
    t = 0.01 * np.arange(401)
    run = blank_run(0 * t, 0.01)
    swing = ftlm.Model(ftlm.equation("D^2 y = -1 D y - 9 y + 1 f"))
    free = solve_ivp(lambda _, x: [x[1], -x[1] - 9 * x[0]], (0, 4), [1, 0.5], t_eval=t, rtol=1e-10, atol=1e-12).y[0]
    assert swing.simulate(run, initial={"y": [1.0, 0.5]})["y"] == pytest.approx(free, abs=1e-6)
    # The coefficients of 1 and t: the term D y adds its own.
    assert swing.simulate(run, initial={"y": {0.0: 1.0, 1.0: 1.5}})["y"] == pytest.approx(free, abs=1e-6)
    for powers in ({0.0: 1.0}, {0.0: 1.0, 1.0: 0.0}):
        with pytest.raises(
            ftlm.ModelError, match=r"imply the powers \{0: 1, 1: 1\}; give initial=\{'y': \[1\.0"
        ) as raised:
            swing.simulate(run, initial={"y": powers})
        assert "[1.0, -1.0] for the given powers alone" in str(raised.value)
    alone = swing.simulate(run, initial={"y": [1.0, -1.0]})["y"]
    np.testing.assert_allclose(alone, swing.simulate(run, initial={"y": {0.0: 1.0, 1.0: 1e-12}})["y"], atol=1e-9)
    with pytest.raises(ftlm.ModelError, match="3 initial values of y, but its equation of order 2 has 2"):
        swing.simulate(run, initial={"y": [1.0, 0.0, 0.0]})
    curved = ftlm.Model(ftlm.equation("D^2 y = -1 D y - 9 y + 1 D (y^3) + 1 f"))
    with pytest.raises(ftlm.ModelError, match="initial values of y beside the derivative of y"):
        curved.simulate(run, initial={"y": [1.0]})
    circle = ftlm.Model(ftlm.equation("D^2 y = 1 D y - 1 y^2*D y - 1 y + 1 f"))
    limit = solve_ivp(
        lambda _, x: [x[1], (1 - x[0] ** 2) * x[1] - x[0]], (0, 4), [2, 0], t_eval=t, rtol=1e-10, atol=1e-12
    ).y[0]
    assert circle.simulate(run, initial={"y": [2.0]})["y"] == pytest.approx(limit, abs=1e-4)


def test_initial_values_of_coupled_equations_act_on_each_other():
    t = 0.01 * np.arange(301)
    run = ftlm.Run.from_arrays(step=0.01, inputs={"f": 0 * t}, outputs={"y": 0 * t, "z": 0 * t})
    text = "D^2 y = -1 D y - 5 y + 2 D z + 1 f; D z = -1 z + 1 y"
    model = ftlm.Model(replace(ftlm.equation(text), coupling="simulated"))

    def slope(_, x):
        rate = -x[2] + x[0]
        return [x[1], -x[1] - 5 * x[0] + 2 * rate, rate]

    exact = solve_ivp(slope, (0, 3), [1, -0.5, 2], t_eval=t, rtol=1e-10, atol=1e-12).y
    with pytest.raises(ftlm.ModelError, match="initial values of y and powers of t of z in coupled equations"):
        model.simulate(run, initial={"y": [1.0, -0.5], "z": {0.0: 2.0}})
    found = model.simulate(run, initial={"y": [1.0, -0.5], "z": [2.0]})
    assert found["y"] == pytest.approx(exact[0], abs=1e-6)
    assert found["z"] == pytest.approx(exact[2], abs=1e-6)


def test_initial_terms_of_a_comparison_simulate_its_run():
    u = step_input(200, 20, 2.0, 5.0)
    y = 12.0 + plant([1.7], [12.0, 1.0], u - 2.0) + 0.01 * np.random.default_rng(1).standard_normal(200)
    found = ftlm.identify(run_of(u, y), ftlm.equation(WORDS))
    again = found.model.simulate(run_of(u, y), initial=found.comparison.initial[0])
    assert again["y"] == pytest.approx(found.comparison.simulated["y"][0], abs=1e-9)


@pytest.mark.parametrize("late", [0, 1])
def test_runs_that_differ_by_a_row_of_delay_are_named(late):
    runs = []
    for k, shift in enumerate((late, 0)):
        g = np.random.default_rng(30 + k)
        u = np.repeat(g.uniform(-1, 1, 90), 9 + 5 * k)[:700]
        y = plant([1.0], [4.0, 4.2, 1.0], np.r_[np.zeros(shift), u][:700]) + 0.003 * g.standard_normal(700)
        runs.append(run_of(u, y, name=f"r{k}"))
    found = ftlm.consistency(runs, ftlm.equation("D^2 y = p D y + q y + b u"))
    assert found.consistent is (not late)
    said = [f.text for f in found.findings if f.code == "segments_differ_by_delay"]
    assert len(said) == late
    if late:
        assert "r0 differs by a delay: if its inputs are" in said[0]


@pytest.mark.parametrize("row", [0, 7])
def test_an_outlier_in_quiet_rows_is_left_out(row):
    u = step_input(200, 20)
    y = 12.0 + plant([1.7], [12.0, 1.0], u) + 0.01 * np.random.default_rng(1).standard_normal(200)
    y[row] = 9.0
    found = ftlm.identify(run_of(u, y), ftlm.equation(WORDS))
    assert (found.settings["initial"], found.settings["offset"]) == ("rest", "level")
    assert gain_of(found) == pytest.approx(1.7, rel=0.05)


def test_runs_that_never_move_are_refused_or_dead():
    still = run_of(np.zeros(100), np.full(100, 20.0))
    with pytest.raises(ftlm.FtlmError):
        ftlm.identify(still, ftlm.equation(WORDS))
    # A free decay without an input is motion, not rest at a level.
    decay = run_of(np.zeros(100), 5.0 * np.exp(-0.05 * np.arange(100)))
    found = ftlm.identify(decay, ftlm.equation("D y = a y"))
    assert found.settings["initial"] == "caputo"
    assert found.coefficients["a"] == pytest.approx(-0.1, rel=1e-3)


ROWS, BEFORE, FINE = 300, 400, 4
TWO_POLES, FRACTIONAL = "D^2 y = -p D y - q y + b u", "D^alpha y = -q y + b u"
#: Plants of gain 2, the structure of each, and whether it is right or lacks a lag.
PANEL = (
    ("two lags", TWO_POLES, True),
    ("swing", TWO_POLES, True),
    ("fractional", FRACTIONAL, True),
    ("two lags", FRACTIONAL, False),
    ("swing", FRACTIONAL, False),
    ("fractional and a lag", FRACTIONAL, False),
)
#: Numbers of the whole-order plants.
TRUTHS = {
    "two lags": {"p": 46 / 240, "q": 1 / 240, "b": 2 / 240},
    "swing": {"p": 4 / 30, "q": 1 / 30, "b": 2 / 30},
    "fractional": {"alpha": 0.7, "q": 0.12, "b": 0.24},
}
INPUTS = ("step", "pulse", "prbs", "steps", "multisine")
STARTS = ("rest", "level", "motion")


def panel_input(kind, g):
    """The input of a record of the panel from its first row on."""
    t = np.arange(ROWS)
    if kind == "step":
        return np.where(t < 15, 0.0, 1.0)
    if kind == "pulse":
        return np.where((t >= 15) & (t < 120), 1.0, 0.0)
    if kind == "prbs":
        return np.repeat(g.choice([-1.0, 1.0], ROWS), 4)[:ROWS]
    if kind == "steps":
        return np.repeat(g.uniform(-1, 1, ROWS), 30)[:ROWS]
    return np.sum([np.sin(w * t + g.uniform(0, 6)) for w in (0.03, 0.11, 0.37)], axis=0)


def panel_response(name, u):
    """Samples of a plant for a held input, from rest, by recursions of NumPy and SciPy alone."""
    fine = np.repeat(u, FINE)
    if name.startswith("fractional"):
        # Gruenwald and Letnikov's sum of D^0.7 y = -0.12 y + 0.24 u.
        h, count = 1.0 / FINE, np.arange(1, fine.size)
        weights = np.concatenate([[1.0], np.cumprod(1.0 - 1.7 / count)])
        weights[0] += 0.12 * h**0.7
        y = lfilter([0.24 * h**0.7], weights, fine)
        if name.endswith("lag"):
            pole = np.exp(-h / 6.0)
            y = lfilter([1 - pole], [1.0, -pole], y)
        # A sample is read before the command of its row acts.
        return np.concatenate([[0.0], y[FINE - 1 :: FINE]])[: u.size]
    den = [40.0 * 6.0, 46.0, 1.0] if name == "two lags" else [30.0, 4.0, 1.0]
    num, den, _ = cont2discrete(([2.0], den), 1.0)[:3]
    return lfilter(np.ravel(num), den, u)


def panel_record(name, kind, start, seed):
    """A record of the panel with 1 % noise."""
    g = np.random.default_rng([seed, *(ord(c) for c in name + kind + start)])
    past = np.repeat(g.choice([-1.0, 1.0], BEFORE), 7)[:BEFORE] if start == "motion" else np.zeros(0)
    u = np.concatenate([past, panel_input(kind, g)])
    y = panel_response(name, u)[past.size :] + (23.0 if start == "level" else 0.0)
    return run_of(u[past.size :], y + 0.01 * np.std(y) * g.standard_normal(ROWS), 1.0)


def panel_gain(result):
    c = result.coefficients
    return c["b"] / c["q"]


#: Findings that say that a gain assumes a start, or that the structure lacks dynamics.
GAIN_CODES = {"rest_assumed", "gain_depends_on_initial_conditions", "lag_fits", "dynamics_missing"}


def panel_table(seeds):
    """Gains off by over 20 %, by structure, plant and start; how many without a finding; whether intervals hold."""
    wrong, silent, covered = {}, 0, []
    for name, words, right in PANEL:
        for start, kind, seed in itertools.product(STARTS, INPUTS, seeds):
            found = ftlm.identify(panel_record(name, kind, start, seed), ftlm.equation(words))
            is_off = abs(panel_gain(found) / 2.0 - 1.0) > 0.2
            silent += is_off and not GAIN_CODES & set(codes(found))
            off = is_off and not {"rest_assumed", "gain_depends_on_initial_conditions"} & set(codes(found))
            wrong.setdefault(("right" if right else "one lag too few", name, start), []).append(off)
            if right and name != "fractional":
                covered += [found.intervals[n][0] <= v <= found.intervals[n][1] for n, v in TRUTHS[name].items()]
    return wrong, silent, covered


@pytest.mark.parametrize("cut", [0, 150, 151, 152])
def test_an_output_that_hardly_moves_at_first_was_at_rest(cut):
    # The input acts from row 0 on, as a rig's command does; a structure without the fast lag must not ask for a past.
    u = np.repeat(np.random.default_rng(2).choice([-1.0, 1.0], 40), 20)
    y = plant([3.0], [1.0, 4.0, 6.0, 0.0], u, 0.02)
    first = int(np.argmin(np.abs(y[cut : cut + 100]))) + cut if cut else 0
    y = y[first:] - (y[first] if cut else 0.0) + 1e-6 * np.random.default_rng(3).standard_normal(y.size - first)
    run = run_of(u[first:], y, 0.02)
    structure = ftlm.equation("D^alpha y = a D y + b u")
    evidence = rest_evidence(run, structure)
    assert (evidence is not None) == (cut == 0)
    if cut == 0:
        assert ftlm.identify(run, structure).settings["initial"] == "rest"


def test_quiet_rows_of_a_slow_motion_are_refuted():
    record = panel_record("two lags", "pulse", "motion", 412)
    structure = ftlm.equation(TWO_POLES)
    assert rest_evidence(record, structure).rows == 15
    found = ftlm.identify(record, structure)
    assert panel_gain(found) == pytest.approx(2.0, rel=0.01)
    assert "rest_rejected" in codes(found)
    assert "rests_at_level" not in codes(found)
    # The model says so to comparisons.
    assert found.model.structure.initial == "caputo"
    assert found.model.compare(record).fit == pytest.approx(found.fit)
    # A lag that the structure lacks refutes no rest.
    wrong = ftlm.identify(panel_record("two lags", "pulse", "level", 411), ftlm.equation(FRACTIONAL))
    assert "rest_rejected" not in codes(wrong)
    assert "rests_at_level" in codes(wrong)


@pytest.mark.parametrize(("share", "color"), [(0.05, 0.0), (0.1, 0.0), (0.05, 0.6)])
@slow_after(1, "seeds", [1, 2])
def test_a_staircase_with_an_offset_of_its_input_sensor(share, color, seeds):
    """The plant rests until row 100, but its recorded input is 0.7 there: from rest, no model explains the record."""
    u = np.repeat(np.arange(6.0), 100)
    y = plant([2.0], [0.192, 1.04, 1.0], u, 0.02)
    for seed in range(seeds):
        g = np.random.default_rng(seed)
        noise = lfilter([np.sqrt(1 - color**2)], [1, -color], g.standard_normal(800))[200:]
        run = run_of(u + 0.7, y + share * np.std(y) * noise, 0.02)
        found = ftlm.identify(run, ftlm.equation("D^2 y = -p D y - q y + b u"))
        assert found.settings["offset"] == "level"
        for name, truth in {"p": 1.04 / 0.192, "q": 1 / 0.192, "b": 2 / 0.192}.items():
            low, high = found.parameters[name].interval
            assert low <= truth <= high
            assert found.parameters[name].value == pytest.approx(truth, rel=0.4)
        assert found.comparison.offsets[0]["y"]["level"] == pytest.approx(-1.4, abs=0.2)
        assert "level_estimated" in codes(found)


def test_a_mode_with_few_samples_a_period_is_named():
    g = np.random.default_rng(1)
    u = np.repeat(g.choice([-1.0, 1.0], 200), 3)
    for step, named in ((0.25, True), (0.1, False)):
        y = plant([16.0], [1.0, 0.8, 16.0], u, step) + 0.01 * g.standard_normal(u.size)
        found = ftlm.identify(run_of(u, y, step), ftlm.equation("D^2 y = -p D y - q y + b u"))
        said = [f for f in found.findings if f.code == "mode_sampled_coarsely"]
        assert len(said) == named
        if named:
            assert said[0].numbers["samples"] == pytest.approx(2 * np.pi / (4 * step), rel=0.02)
            # A hold is half a sample late and sinc(1/n) small.
            assert said[0].numbers["phase"] == pytest.approx(180 / said[0].numbers["samples"])


def test_a_level_that_drifts_is_named_with_its_remedy():
    u = np.repeat(np.random.default_rng(4).choice([-1.0, 1.0], 60), 10)
    y = plant([1.0], [3.0, 1.0], u) + np.linspace(0.0, 8.0, 600) + 0.01 * np.random.default_rng(5).standard_normal(600)
    said = [f for f in run_of(u, y).advice() if f.code == "drift"]
    assert len(said) == 1
    assert "offset='ramp'" in said[0].text
    assert said[0].remedy.startswith("use offset='ramp'")
    found = ftlm.identify(run_of(u, y), ftlm.equation(WORDS, offset="ramp"))
    assert gain_of(found) == pytest.approx(1.0, rel=0.02)
    # Without the line it is named with what it changes.
    plain = ftlm.identify(run_of(u, y), ftlm.equation(WORDS))
    (drift,) = [f for f in plain.findings if f.code == "drift_fits"]
    assert drift.numbers["ratio"] < 0.01
    assert drift.numbers["other_value"] == pytest.approx(found.parameters[drift.parameter].value, rel=1e-3)
    assert "offset_missing" not in codes(plain)
    assert any("the level of y drifts" in reason for reason in plain.verdict.reasons)


def test_colored_noise_is_no_drift():
    u = np.repeat(np.random.default_rng(4).choice([-1.0, 1.0], 60), 10)
    for seed in range(5):
        noise = lfilter([1.0], [1.0, -0.98], np.random.default_rng(seed).standard_normal(600))
        y = plant([1.0], [3.0, 1.0], u) + 0.1 * noise / np.std(noise)
        found = ftlm.identify(run_of(u, y), ftlm.equation(WORDS))
        assert "noise_coloured" in codes(found)
        assert "drift_fits" not in codes(found)


@slow_after(1, "name, start", [("fractional and a lag", "rest"), ("fractional", "rest")])
def test_a_start_that_cannot_be_told_gives_both_gains(name, start):
    # A lag that the structure lacks makes a past of what a run did from rest.
    record = panel_record(name, "prbs", start, 311)
    found = ftlm.identify(record, ftlm.equation(FRACTIONAL))
    said = [f for f in found.findings if f.code == "gain_depends_on_initial_conditions"]
    if name == "fractional":
        assert not said
        return
    numbers = said[0].numbers
    assert numbers["gain"] == pytest.approx(panel_gain(found), rel=1e-9)
    given = ftlm.identify(record, ftlm.equation(FRACTIONAL, initial="caputo", offset="level"))
    assert numbers["other_gain"] == pytest.approx(panel_gain(given), rel=5e-3)
    apart = abs(numbers["gain"] - numbers["other_gain"])
    assert apart > 3 * np.hypot(numbers["error"], numbers["other_error"])
    assert "1.694 ± 0.067" in said[0].text
    assert "1.374 ± 0.049" in said[0].text
    # A start that is given is no question.
    assert "gain_depends_on_initial_conditions" not in codes(given)


def test_a_fit_under_other_initial_conditions_is_not_repeated(monkeypatch):
    requests = []

    def refit(joint, runs, structure, *others, **options):
        requests.append((structure.initial, structure.offset))
        return refit_after_screening(joint, runs, structure, *others, **options)

    monkeypatch.setattr("ftlm.estimation.extensions.refit_after_screening", refit)
    # The run in motion was fitted with Caputo's terms before a level was tried.
    found = ftlm.identify(panel_record("two lags", "prbs", "level", 311), ftlm.equation("D y = -q y + b u"))
    assert found.settings["offset"] == "level"
    assert requests
    assert ("caputo", "none") not in requests


@slow_after(1, "name", ["two lags", "fractional and a lag"])
@pytest.mark.parametrize("seed", [311, pytest.param(312, marks=pytest.mark.slow)])
def test_a_history_that_no_past_input_explains_is_rejected(name, seed):
    # With one lag too few, nine free powers of t fitted the response to the step: gains were 7e8, 6e8, 0.59 and 0.47.
    found = ftlm.identify(panel_record(name, "step", "motion", seed), ftlm.equation(FRACTIONAL))
    assert found.settings["initial"].startswith("caputo")
    assert panel_gain(found) == pytest.approx(2.0, rel=0.2 if name == "fractional and a lag" else 0.5)
    assert "lag_fits" in codes(found)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_gains_of_a_panel_of_first_rows():
    # Seeds that no threshold was chosen on.
    wrong, silent, covered = panel_table((211, 212))
    for (which, name, start), off in wrong.items():
        print(f"{which:<16} {name:<21} {start:<7} {sum(off):>2} of {len(off)} gains off by over 20 %")
    share = {w: np.mean([v for key, off in wrong.items() if key[0] == w for v in off]) for w, _, _ in wrong}
    print(share, f"{100 * np.mean(covered):.0f} % of {len(covered)} intervals hold the truth")
    assert share["right"] <= 0.02
    # Of 180, where a gain is off the findings name the assumption or the missing dynamics.
    assert silent <= 2
    # 23 of 90: a quarter within chance.
    off = [v for key, off in wrong.items() if key[0] == "one lag too few" for v in off]
    assert beta.ppf(0.025, sum(off), len(off) - sum(off) + 1) <= 0.25
    assert 0.9 <= np.mean(covered) <= 0.99


def test_an_integrator_with_an_offset_of_its_input_sensor_agrees_with_linear_regression():
    # D y = b (u - 0.3) from rest is y = b ∫u - 0.3 b t, linear in both coefficients.
    g = np.random.default_rng(11)
    u, h = np.repeat(g.choice([-1.0, 0.6], 48), 25), 0.01
    time, area = h * np.arange(u.size), h * np.concatenate([[0.0], np.cumsum(u + 0.3)[:-1]])
    y = 2.0 * (area - 0.3 * time) + 0.01 * g.standard_normal(u.size)
    (slope, drift), *_ = np.linalg.lstsq(np.stack([area, time], axis=1), y, rcond=None)
    result = ftlm.identify(run_of(u + 0.3, y, h), ftlm.equation("D y = b u"))
    assert "constant_estimated" in codes(result)
    assert result.coefficients["b"] == pytest.approx(slope, rel=1e-5)
    assert result.comparison.offsets[0]["y"]["constant"] == pytest.approx(drift, rel=1e-4)


INTEGRATORS = [
    ("D y = b u", [2.0], [1.0, 0.0]),
    ("D^2 y = a1 D y + b u", [20.0], [1.0, 3.0, 0.0]),
    ("D^3 y = a2 D^2 y + a1 D y + b u", [300.0], [1.0, 4.0, 60.0, 0.0]),
]


@pytest.mark.parametrize("first", [0, 317])
@slow_after(1, "bias", [0.03, 0.3])
@pytest.mark.parametrize(("words", "num", "den"), INTEGRATORS)
@slow_after(1, "seeds", [1, 3])
def test_an_integrating_plant_has_its_rate_despite_an_offset_of_its_input(words, num, den, bias, first, seeds):
    for seed in range(seeds):
        g = np.random.default_rng([seed, 3])
        u = np.repeat(g.choice([-1.0, -0.5, 0.5, 1.0], 30), 40)
        y = plant(num, den, u, 0.01)
        y = y + 0.01 * np.std(y) * g.standard_normal(u.size)
        result = ftlm.identify(run_of(u[first:] + bias, y[first:], 0.01), ftlm.equation(words))
        error = abs(result.coefficients["b"] - num[0])
        assert error < 4 * result.standard_errors["b"]
        assert error < 0.05 * num[0]


def test_a_nonlinear_plant_with_an_offset_of_its_input_agrees_with_its_differential_equation():
    # y'' = -0.8 y' - 4 y^3 + u - 0.5 by an adaptive solver of ordinary differential equations.
    g, h = np.random.default_rng(0), 0.02
    u = np.repeat(g.uniform(-3.0, 3.0, 40), 25)
    state, y = np.zeros(2), []
    for value in u:
        y.append(state[0])
        motion = solve_ivp(
            lambda _, x, f=value: [x[1], -0.8 * x[1] - 4.0 * x[0] ** 3 + f], (0.0, h), state, rtol=1e-9, atol=1e-10
        )
        state = motion.y[:, -1]
    run = run_of(u + 0.5, np.array(y) + 0.005 * g.standard_normal(u.size), h)
    result = ftlm.identify(run, ftlm.equation("D^2 y = -d D y - k y^3 + b u"))
    assert "constant_estimated" in codes(result)
    for name, true in (("d", 0.8), ("k", 4.0), ("b", 1.0)):
        assert abs(result.coefficients[name] - true) < 4 * result.standard_errors[name]
    assert result.comparison.offsets[0]["y"]["constant"] == pytest.approx(-0.5, abs=0.02)


@pytest.mark.slow
def test_colored_noise_of_an_integrator_is_rarely_taken_for_an_offset():
    estimated = []
    for seed in range(20):
        g = np.random.default_rng([seed, 7])
        u = np.repeat(g.choice([-1.0, -0.5, 0.5, 1.0], 30), 40)
        noise = lfilter([1.0], [1.0, -0.9], g.standard_normal(u.size))
        y = plant([20.0], [1.0, 3.0, 0.0], u, 0.01)
        y = y + 0.05 * np.std(y) * noise / np.std(noise)
        result = ftlm.identify(run_of(u, y, 0.01), ftlm.equation("D^2 y = a1 D y + b u"))
        estimated.append("constant_estimated" in codes(result))
        assert abs(result.coefficients["b"] - 20.0) < 4 * result.standard_errors["b"]
    assert sum(estimated) <= 2


def test_a_level_is_found_on_a_record_that_is_too_long_for_the_offset_test(monkeypatch):
    monkeypatch.setattr("ftlm.estimation.initial_condition_selection.MAX_OFFSET_TEST_SAMPLES", 100)
    g = np.random.default_rng(5)
    u = np.repeat(g.choice([-1.0, 1.0], 40), 25)
    y = 30.0 + plant([1.2], [0.5, 1.0], u, 0.05) + 0.01 * g.standard_normal(u.size)
    found = ftlm.identify(run_of(u, y, 0.05), ftlm.equation(WORDS))
    assert "level_estimated" in codes(found)
    assert gain_of(found) == pytest.approx(1.2, rel=0.01)


def test_a_plant_that_rests_under_a_constant_input_is_not_said_to_have_moved():
    # The input changes often, so that 40 constant samples are not accepted as evidence of rest.
    g = np.random.default_rng(0)
    change = np.r_[np.zeros(40), np.repeat(g.uniform(-20, -10, 12), 40)][:500]
    y = 48 + plant([1.5], [20.0, 1.0], change, 1.0) + 0.1 * g.standard_normal(500)
    found = ftlm.identify(run_of(20 + change, y, 1.0), ftlm.equation(WORDS))
    assert found.settings["initial"] == "caputo"
    # The level belongs to an input of 0, far from the output at which the plant rests.
    assert found.parameters["level_y"].value == pytest.approx(48 - 1.5 * 20, abs=0.5)
    (said,) = [f for f in found.findings if f.code == "level_estimated"]
    assert "the simulation starts with estimated initial terms about this level" in said.text


def test_a_given_offset_of_none_prevents_a_level_and_a_constant():
    g = np.random.default_rng(5)
    u = np.repeat(g.choice([-1.0, 1.0], 40), 25)
    noise = 0.01 * g.standard_normal(u.size)
    at_level = run_of(u, 30.0 + plant([1.2], [0.5, 1.0], u, 0.05) + noise, 0.05)
    biased = run_of(u + 0.3, plant([2.0], [1.0, 0.0], u, 0.05) + noise, 0.05)
    for run, words, code in ((at_level, WORDS, "level_estimated"), (biased, "D y = b u", "constant_estimated")):
        assert code in codes(ftlm.identify(run, ftlm.equation(words)))
        given = ftlm.identify(run, ftlm.equation(words), offset="none")
        assert given.model.structure.offset == "none"
        assert code not in codes(given)


def test_a_level_is_found_where_a_fit_without_it_fails():
    # Its mean is below three deviations of the output, which alone would show a level.
    g = np.random.default_rng(1)
    u = np.repeat(g.choice([-1.0, 1.0], 75), 20)
    num, den, _ = cont2discrete(([8.0, 144.0], [1.0, 1.2, 144.0]), 0.01)[:3]
    y = 9.0 + lfilter(np.ravel(num), den, u) + 0.02 * g.standard_normal(u.size)
    assert np.mean(y) < 3.0 * np.std(y)
    found = ftlm.identify(run_of(u, y, 0.01), ftlm.equation("D^2 y = a1 D y + a0 y + b1 D u + b0 u"))
    assert "level_estimated" in codes(found)
    assert found.fit["y"] > 99.0


@pytest.mark.parametrize(("num", "den", "seed"), [([1.5], [0.8, 2.4, 1.0], 13), ([9.0], [1.0, 0.6, 9.0], 2)])
def test_a_level_far_from_the_fit_without_it_has_initial_guesses_of_its_own(num, den, seed):
    # A walk of the input in motion at a level: the fit without a level leads the one with it astray.
    g = np.random.default_rng([seed, 5])
    u = np.cumsum(g.standard_normal(900))
    y = (20.0 + plant(num, den, u))[300:]
    y = y + 0.02 * np.std(y) * g.standard_normal(600)
    found = ftlm.identify(run_of(u[300:], y), ftlm.equation("D^2 y = -p D y - q y + b u"))
    assert "level_estimated" in codes(found)
    assert "lower_optimum_found" not in codes(found)
    assert found.coefficients["b"] / found.coefficients["q"] == pytest.approx(num[0] / den[-1], rel=0.01)


@pytest.mark.parametrize("seed", [96, 100])
def test_a_swinging_plant_at_a_level_is_not_sought_from_a_start_at_rest(seed):
    # From rest at a level, the best fit explains 1 % and is stationary for a start in motion, too.
    g = np.random.default_rng(seed)
    u = np.repeat(g.choice([-1.0, 1.0], 41), 20)[:800]
    y = 5 + plant([100.0], [1.0, 0.4, 100.0], u, 0.02) + 0.01 * g.standard_normal(800)
    found = ftlm.identify(run_of(u[300:], y[300:], 0.02), ftlm.equation("D^2 y = -p D y - q y + b u"))
    assert found.coefficients["p"] == pytest.approx(0.4, abs=0.01)
    assert found.coefficients["b"] == pytest.approx(100.0, rel=0.01)
    assert found.fit["y"] > 99.0


def test_residuals_of_a_warm_start_are_in_units_of_its_noise():
    g = np.random.default_rng(3)
    u = np.repeat(g.choice([-1.0, 1.0], 40), 25)
    y = plant([1.2], [0.5, 1.0], u, 0.05) + 0.01 * g.standard_normal(u.size)
    run, structure = run_of(u, y, 0.05), ftlm.equation(WORDS)
    joint = ftlm.identify(run, structure).joint
    noisy = {**joint.noise, "y": 1.009 * joint.noise["y"]}
    near = fit_output_error([run], replace(structure, initial="rest"), initial_fit=replace(joint, noise=noisy))
    assert np.sqrt(np.mean(near.residuals[0]["y"] ** 2)) == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize("mean", [0.0, 50.0])
@slow_after(1, "seeds", [2, 8])
def test_runs_in_motion_at_a_level_have_the_gain_of_the_plant(mean, seeds):
    # Sampled 3/(s + 2); without the level, the fit ends at residuals whose color hides it.
    step, rows, before, pole = 0.05, 800, 637, np.exp(-0.1)
    for seed in range(seeds):
        rng = np.random.default_rng([seed, 3])
        u = mean + np.cumsum(rng.standard_normal(before + rows))
        y = lfilter([0.0, 1.5 * (1 - pole)], [1.0, -pole], u)[before:]
        noisy = y + 20 + 0.02 * np.std(y) * rng.standard_normal(rows)
        run = ftlm.Run.from_arrays(step=step, inputs={"u": u[before:]}, outputs={"y": noisy})
        got = ftlm.identify(run, ftlm.equation("D y = a y + b u")).coefficients
        assert got["b"] / -got["a"] == pytest.approx(1.5, rel=0.05), seed


@needs_data
@pytest.mark.parametrize(
    ("name", "stage", "text"),
    [
        ("lqr", 1, "D^2 y = d D y + a y + b D^2 u"),
        pytest.param("psf", 2, "D^2 y = d D^mu y + a y + b D^gamma u", marks=pytest.mark.slow),
    ],
)
def test_a_run_that_begins_slowly_is_compared_as_it_was_fitted(name, stage, text):
    # Deviations from the first sample look like rest, which would leave -18 and 25 % of these records.
    arm = arm_measured.arm_run(name)
    record = ftlm.Run.from_arrays(
        step=arm.step,
        inputs={"u": arm[f"theta{stage}1"]},
        outputs={"y": arm[f"theta{stage}2"]},
        intersample={"u": "foh"},
    )
    result = ftlm.identify(record, ftlm.equation(text))
    fitted = 100 * (1 - result.joint.noise["y"] / np.std(record["y"]))
    assert result.joint.initial != "rest"
    assert result.fit["y"] == pytest.approx(fitted, abs=0.5)


def test_a_constant_that_does_not_help_costs_no_second_search_and_findings_are_computed_once(monkeypatch):
    offsets, findings = [], []
    fit, multistart_findings = estimators.fit_with_initial_conditions, estimators.multistart_findings

    def recorded_fit(runs, structure, *arguments, **options):
        offsets.append(structure.offset)
        return fit(runs, structure, *arguments, **options)

    def recorded_findings(*arguments):
        findings.append(multistart_findings(*arguments))
        return findings[-1]

    monkeypatch.setattr(estimators, "fit_with_initial_conditions", recorded_fit)
    monkeypatch.setattr(estimators, "multistart_findings", recorded_findings)
    random, rows = np.random.default_rng(0), 300
    u = np.repeat(random.choice([-1.0, 1.0], 25), 12)
    noise = lfilter([0.05], [1, -0.9], random.standard_normal(rows))
    y = np.concatenate([[0.0], np.cumsum(0.04 * u)[:-1]]) + noise
    found = ftlm.identify(ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": y}), "D y = b u")
    assert not found.residuals.outputs["y"].whiteness.passed
    assert found.parameters["b"].value == pytest.approx(2.0, abs=0.2)
    assert len(findings) == 1
    # A constant is refuted by a fit from the optimum without it, before any search from automatic guesses.
    assert "none" in offsets
    assert "constant" not in offsets
