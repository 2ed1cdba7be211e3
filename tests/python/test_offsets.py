"""Unknown constants in equations: estimated for each run, told, written, refused where they cannot be told apart."""

from __future__ import annotations

import json
from dataclasses import replace
from math import gamma

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import cont2discrete, lfilter, lsim
from typer.testing import CliRunner

import ftlm
import loops
import oracles
from ftlm import cli
from ftlm.estimation.linear import Streaming
from ftlm.estimation.nuisance_parameters import offset_test
from ftlm.simulation.output_samples import initial_exponents
from measured import DATA, needs_data

pytestmark = pytest.mark.usefixtures("no_extension_tests")

WORDS = "D^0.8 y = -a y + b u + c"
TRUTH = {"a": 0.7, "b": 1.4}


def switched(rows: int, seed: int, *, every: int = 10) -> np.ndarray:
    """A command of random levels, each held for some rows."""
    levels = np.random.default_rng(seed).uniform(-1, 1, rows // every + 1)
    return np.repeat(levels, every)[:rows]


def fractional_run(
    seed: int, constant: float, *, noise: float = 0.01, ramp: float = 0.0, name: str = "run", rows: int = 201
) -> ftlm.Run:
    """D^0.8 y = -0.7 y + 1.4 u + c + r t from rest, by dense matrices on a grid four times as fine as the samples."""
    step, fine = 0.05, 4
    u = switched(rows, seed)
    m = (rows - 1) * fine
    driven = oracles.pulse_means(u, m, "zoh")
    clock = (np.arange(m) + 0.5) * step / fine
    y = oracles.free_run(
        [(-0.7, 0.0)], [(1.4, 0.0, driven), (1.0, 0.0, constant + ramp * clock)], 0.8, m, (rows - 1) * step
    )
    samples = np.concatenate([[0.0], 1.5 * y[fine - 1 :: fine] - 0.5 * y[fine - 2 :: fine]])
    samples += noise * np.std(samples) * np.random.default_rng(1000 + seed).standard_normal(rows)
    return ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": samples}, name=name)


def motor_run(offset: float, seed: int = 1) -> ftlm.Run:
    """A motor: 8 rad/s a volt, 0.2 s, 0.035 s late, 1 % noise; its tachometer reads so much at rest. By SciPy."""
    fine, step, rows = 10, 0.01, 1500
    u = 2.0 * switched(rows, seed, every=25)
    late = np.concatenate([np.zeros(35), np.repeat(u, fine)])[: rows * fine]
    pole = np.exp(-step / fine / 0.2)
    speed = lfilter([0.0, 8.0 * (1 - pole)], [1.0, -pole], late)[::fine]
    speed += 0.01 * np.std(speed) * np.random.default_rng(seed).standard_normal(rows)
    return ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"w": speed + offset}, name="motor")


@pytest.mark.parametrize(("offset", "exponents"), [("none", []), ("constant", [0.8]), ("ramp", [0.8, 1.8])])
def test_least_squares_is_that_of_one_more_power_of_time(offset, exponents):
    # The oracle: dense regressors I^0.8 y, I^0.8 u, and I^0.8 of a column of ones and one of t.
    run = fractional_run(3, 0.5, ramp=0.1, noise=0.0)
    m, length = run.length - 1, run.duration
    y, u = oracles.pulse_means(run["y"], m, "foh"), oracles.pulse_means(run["u"], m, "zoh")
    clock = (np.arange(m) + 0.5) * run.step
    columns = [oracles.integrate(x, 0.8, length) for x in (-y, u, np.ones(m), clock)][: 2 + len(exponents)]
    expected = np.linalg.lstsq(np.stack(columns, axis=1), y, rcond=None)[0]
    structure = ftlm.equation("D^0.8 y = -a y + b u", initial="rest", offset=offset)
    found = ftlm.identify(run, structure, method="least-squares", m=m)
    # Means of t are exact, I^0.8 of their steps is not that of a line: the second column differs a little.
    assert [found.coefficients[n] for n in "ab"] == pytest.approx(
        list(expected[:2]), rel=1e-6 if offset != "ramp" else 1e-3
    )
    assert list(found.comparison.initial[0]["y"]) == pytest.approx(exponents)
    assert found.settings.get("offset", "none") == offset


@pytest.mark.parametrize("seeds", [2, pytest.param(10, marks=pytest.mark.slow)])
@pytest.mark.parametrize("method", ["least-squares", "instrumental-variables", "output-error"])
def test_an_offset_and_coefficients_are_found(method, seeds):
    errors = []
    for seed in range(seeds):
        # Instrumental variables end on pulses as wide as the samples; with less noise their step shows.
        short = method != "instrumental-variables"
        run = fractional_run(seed, 0.5, noise=0.01 if short else 0.03, rows=201 if short else 401)
        structure = ftlm.equation(WORDS if method != "output-error" else WORDS.replace("0.8", "alpha"), initial="rest")
        found = ftlm.identify(run, structure, method=method)
        truth = TRUTH | ({"alpha": 0.8} if method == "output-error" else {})
        values = {**found.orders, **found.coefficients}
        spread = found.standard_errors or dict.fromkeys(truth, np.nan)
        errors.append([(values[n] - v) / spread[n] if spread[n] > 0 else values[n] / v - 1 for n, v in truth.items()])
        assert found.comparison.offsets[0]["y"]["constant"] == pytest.approx(0.5, rel=0.1)
    # Standard errors where the method has them; least squares on the equation error has none.
    if method == "least-squares":
        assert np.max(np.abs(errors)) < 0.05
    else:
        assert np.mean(np.abs(errors) < 3) >= 0.95
        assert np.sqrt(np.mean(np.square(errors))) < 1.7


def test_two_runs_have_two_offsets():
    runs = [fractional_run(1, 0.5, name="first"), fractional_run(2, -0.3, name="second")]
    for method in ("least-squares", "output-error"):
        found = ftlm.identify(runs, ftlm.equation(WORDS, initial="rest"), method=method)
        assert [o["y"]["constant"] for o in found.comparison.offsets] == pytest.approx([0.5, -0.3], abs=0.03)
        assert found.coefficients == pytest.approx(TRUTH, rel=0.05)
        assert found.to_dict()["offsets"] == list(found.comparison.offsets)
        for name in ("first", "second"):
            assert f"offset in the equation of y in {name} (estimated on that run, for it alone): " in found.details()


def test_a_ramp_is_found():
    found = ftlm.identify(
        fractional_run(4, 0.5, ramp=0.2), ftlm.equation("D^0.8 y = -a y + b u", initial="rest"), offset="ramp"
    )
    assert found.comparison.offsets[0]["y"] == pytest.approx({"constant": 0.5, "ramp": 0.2}, rel=0.1)
    assert found.coefficients == pytest.approx(TRUTH, rel=0.05)


@pytest.mark.parametrize("method", ["least-squares", "instrumental-variables", "output-error"])
def test_a_constant_added_to_the_input_changes_only_the_offset(method):
    run = fractional_run(5, 0.5)
    shifted = ftlm.Run.from_arrays(step=run.step, inputs={"u": run["u"] + 3.0}, outputs={"y": run["y"]})
    structure = ftlm.equation(WORDS, initial="rest")
    one, other = (ftlm.identify(r, structure, method=method) for r in (run, shifted))
    # Instruments are made of the input, so its shift moves them within the noise.
    close = 1e-6 if method == "least-squares" else 1e-4 if method == "output-error" else 2e-2
    assert other.coefficients == pytest.approx(one.coefficients, rel=close)
    moved = other.comparison.offsets[0]["y"]["constant"] - one.comparison.offsets[0]["y"]["constant"]
    assert moved == pytest.approx(-3.0 * one.coefficients["b"], rel=10 * close)
    assert other.fit["y"] == pytest.approx(one.fit["y"], abs=0.1)


def test_a_motor_whose_tachometer_has_a_zero_of_its_own():
    structure = ftlm.equation("D w = -a w + b u", delay={"u": (0.0, 0.1)})
    found = ftlm.identify(motor_run(5.0), structure, offset="constant")
    low, high = found.intervals["delay_u"]
    assert low <= 0.035 <= high
    assert found.delays["u"] == pytest.approx(0.035, abs=1e-3)
    a, b = found.coefficients["a"], found.coefficients["b"]
    covariance = found.joint.covariance[:2, :2]
    slope = np.array([-b / a**2, 1.0 / a])
    assert abs(b / a - 8.0) < 3 * np.sqrt(slope @ covariance @ slope)
    assert found.comparison.offsets[0]["w"]["constant"] / a == pytest.approx(5.0, rel=0.02)


def test_a_cell_with_a_constant_voltage():
    # 3.7 V, 20 mOhm and a constant-phase element of order 0.8 beside 50 mOhm, in amperes and volts.
    run = fractional_run(6, 0.0, noise=0.005)
    cell = ftlm.Run.from_arrays(step=run.step, inputs={"i": run["u"]}, outputs={"v": 3.7 + 0.05 * run["y"]})
    found = ftlm.identify(cell, ftlm.equation("D^alpha v = -a v + b i + c"))
    low, high = found.intervals["alpha"]
    assert low - 0.01 <= 0.8 <= high + 0.01
    assert found.coefficients == pytest.approx({"a": 0.7, "b": 0.07}, rel=0.1)
    assert found.comparison.offsets[0]["v"]["constant"] / found.coefficients["a"] == pytest.approx(3.7, rel=0.02)


def test_another_run_gets_its_own_offset():
    found = ftlm.identify(fractional_run(1, 0.5), ftlm.equation(WORDS, initial="rest"))
    other = fractional_run(2, -2.0, name="other")
    checked = found.validate([other])
    assert checked.offsets[0]["y"]["constant"] == pytest.approx(-2.0, rel=0.05)
    assert checked.fit["y"] > 95
    assert "offset in the equation of y in other (estimated on that run, for it alone): -" in str(checked)
    assert found.resid(other).initial_terms == 1
    # A simulation has none unless it is given.
    free = found.model.simulate(other)
    given = found.model.simulate(other, initial=checked.initial[0])
    step = float(np.std(given["y"] - other["y"]))
    assert step < 0.05 * np.std(other["y"]) < np.std(free["y"] - other["y"])
    assert checked.initial[0]["y"][0.8] * gamma(1.8) == pytest.approx(checked.offsets[0]["y"]["constant"])


def test_searches_find_orders_beside_an_offset(tmp_path):
    run = fractional_run(7, 1.0, noise=0.001)
    structure = ftlm.equation("D^alpha y = -a y + b u + c", initial="rest", orders={"alpha": "0.5:1.1:0.1"})
    tables = [
        ftlm.search_orders(run, structure, coefficients=how, store=tmp_path / how)
        for how in ("least-squares", "multi-innovation", "instrumental-variables")
    ]
    assert [t.orders["alpha"] for t in tables] == [pytest.approx(0.8)] * 3
    again = ftlm.resume_search(tmp_path / "least-squares")
    assert next(iter(again.values())).table == tables[0].table
    with pytest.raises(ftlm.DataError, match="another offset"):
        ftlm.search_orders(
            run, replace(structure, offset="none"), coefficients="least-squares", store=tmp_path / "least-squares"
        )


def test_two_mass_system_with_a_load_and_no_term_of_order_zero():
    # D^2 y = -d D y + b u + c from SciPy: a load that nobody measured, and no term of order 0.
    step, rows = 0.02, 1001
    u = switched(rows, 8, every=20)
    clock = np.arange(rows) * step
    fine = np.arange((rows - 1) * 10 + 1) * step / 10
    driven = np.repeat(u, 10)[: fine.size]
    _, y, _ = lsim(([2.0], [1.0, 0.5, 0.0]), driven - 0.2, fine, interp=False)
    run = ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": y[::10][: clock.size]})
    found = ftlm.identify(run, ftlm.equation("D^2 y = -d D y + b u + c", initial="rest"))
    assert found.coefficients == pytest.approx({"d": 0.5, "b": 2.0}, rel=1e-2)
    assert found.comparison.offsets[0]["y"]["constant"] == pytest.approx(-0.4, rel=2e-2)


def test_words_say_an_offset_and_are_printed_back():
    structure = ftlm.equation("D^1.5 y = -a y + b u + c")
    assert structure.offset == "constant"
    assert str(structure) == "D^1.5 y = -a y + b u + c"
    assert ftlm.equation(str(structure)) == structure
    assert str(ftlm.equation("D y = -c y + b u", offset="constant")) == "D^1 y = -c y + b u + c1"
    assert ftlm.equation("D y = -c y + b u + c0").offset == "constant"
    # As ever: another name alone is a signal, and so is c with a number.
    assert ftlm.equation("D y = -a y + u").signals == ("y", "u")
    assert ftlm.equation("D y = -a y + 1 c").signals == ("y", "c")
    assert ftlm.flexible_link(form="published", stage=1, offset="constant").offset == "constant"
    assert ftlm.equation("D x = a x + b u + c; D y = d y + e u + c", offset="ramp").offset == "ramp"


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ftlm.equation("D y = -a y + 3.7"), "an offset is unknown: write '\\+ c'"),
        (lambda: ftlm.equation("D y = -a y + 3.7 + b u"), "3.7 at character 14 is a constant without a signal"),
        (lambda: ftlm.equation("D y = -a y - c"), "has a sign, but the estimate of the constant includes the sign"),
        (lambda: ftlm.equation("D y = -a y + c + c0"), "occurs twice"),
        (lambda: ftlm.equation("D x = a x + c; D y = b y"), "the equation of x has an offset, that of y has none"),
        (lambda: ftlm.equation("D y = -a y + c", offset="none"), "has an offset, but offset='none'"),
        (lambda: ftlm.equation("D y = -a y", offset="some"), "use 'none', 'level', 'constant', 'ramp' or 'auto'"),
        (lambda: ftlm.equation("D^0.8 y = -a y + c", initial=(0.0, 0.8)), "leave 0.8 out of initial"),
        (lambda: ftlm.equation("D^0.8 y = -a y", initial=(1.8,), offset="ramp"), "leave 1.8 out of initial"),
    ],
)
def test_what_is_no_offset_is_refused_in_words(make, words):
    with pytest.raises(ftlm.ModelError, match=words):
        make()


def test_an_offset_that_is_the_input_or_that_a_method_lacks_is_refused():
    structure = ftlm.equation(WORDS, initial="rest")
    step = ftlm.Run.from_arrays(step=0.1, inputs={"u": np.ones(200)}, outputs={"y": 1 - np.exp(-0.1 * np.arange(200))})
    for method in ("least-squares", "output-error"):
        with pytest.raises(ftlm.DataError, match=r"u is constant on every run, so b u and the offset .* of y"):
            ftlm.identify(step, replace(structure, initial="caputo"), method=method)
        # From rest it is a level, which is told from what u does.
        c = ftlm.identify(
            step, replace(structure, equations=ftlm.equation("D y = -a y + b u").equations), method=method
        )
        assert c.coefficients["b"] / c.coefficients["a"] == pytest.approx(1.0, rel=0.02)
    with pytest.raises(ftlm.ModelError, match="the genetic baseline does not estimate an offset"):
        ftlm.identify(fractional_run(1, 0.5), structure, method=ftlm.GeneticAlgorithm(seeds=(1,)))
    with pytest.raises(ftlm.ModelError, match="not supported in a stream"):
        Streaming(structure, step=0.1, max_duration=10.0, inputs=("u",))


def test_a_model_keeps_its_offset_and_one_without_is_as_it_was(tmp_path):
    run = fractional_run(1, 0.5)
    for offset in ("none", "constant"):
        model = ftlm.identify(run, ftlm.equation("D^0.8 y = -a y + b u", offset=offset)).model
        file = model.save(tmp_path / f"{offset}.json")
        content = json.loads(file.read_text())
        assert content["offset"] == offset
        again = ftlm.load_model(file)
        assert again.structure.offset == offset
        assert ftlm.compare(again, run).output_error == ftlm.compare(model, run).output_error
        assert str(again).endswith(" + c") == (offset == "constant")


def test_the_command_line_and_the_report_tell_the_offset(tmp_path):
    run = fractional_run(1, 0.5)
    run.to_csv(tmp_path / "run.csv")
    words = ["identify", str(tmp_path / "run.csv"), "--structure", "D^0.8 y = -a y + b u", "--initial", "rest"]
    for more in (["--offset", "constant"], []):
        said = CliRunner().invoke(cli.app, [*words, *more, "--json", "--report", str(tmp_path / "r.html"), "--force"])
        assert said.exit_code == 0, said.output
        page = (tmp_path / "r.html").read_text()
        output = json.loads(said.stdout)
        assert ("offsets" in output) == ("offset: constant" in page) == bool(more)
        if more:
            assert output["offsets"][0]["y"]["constant"] == pytest.approx(0.5, rel=0.05)
            assert output["equations"]["y"].endswith(" + c")
    wrong = CliRunner().invoke(cli.app, [*words, "--offset", "sometimes"])
    assert wrong.exit_code == 2


@pytest.mark.parametrize("kind", ["constant", "linear"])
def test_detrending_is_that_of_numpy_and_said(kind, tmp_path):
    run = fractional_run(1, 0.5)
    clock = np.arange(run.length) * run.step
    degree = 0 if kind == "constant" else 1
    flat = run.detrend(kind)
    for name in ("u", "y"):
        expected = run[name] - np.polyval(np.polyfit(clock, run[name], degree), clock)
        np.testing.assert_allclose(flat[name], expected, atol=1e-12)
    assert len(flat.warnings) == 2
    assert "subtracted from y" in flat.warnings[1]
    only = run.detrend(kind, signals=["y"])
    assert np.array_equal(only["u"], run["u"])
    assert np.array_equal(only["y"], flat["y"])
    run.to_csv(tmp_path / "run.csv")
    words = ["identify", str(tmp_path / "run.csv"), "--structure", "D^0.8 y = -a y + b u", "--detrend", kind]
    said = CliRunner().invoke(cli.app, [*words, "--method", "least-squares"])
    assert said.exit_code == 0
    assert flat.warnings[1] in said.output.replace("\n", " ")


def test_detrending_refuses_in_words():
    run = fractional_run(1, 0.5)
    with pytest.raises(ftlm.DataError, match="use 'constant' or 'linear'"):
        run.detrend("quadratic")
    with pytest.raises(ftlm.DataError, match="'z'"):
        run.detrend(signals=["z"])


@needs_data
def test_the_hub_of_the_arm_runs_free_with_an_offset_of_the_current():
    run = ftlm.load(
        DATA / "two_link_lqr" / "lqr.csv",
        time="t_s",
        inputs={"I1": "Im1_cmd_A"},
        outputs={"theta11": "th11_deg", "theta12": "th12_deg"},
        units={"theta11": "deg", "theta12": "deg"},
    )
    structure = ftlm.equation("D^2 theta11 = -d D theta11 + b I1 + k theta12")
    without, found = (ftlm.identify(run, structure, offset=offset) for offset in ("none", "constant"))
    assert without.fit["theta11"] < 70
    assert found.fit["theta11"] > 85
    assert found.information.bic < without.information.bic - 1000
    default = ftlm.identify(run, structure)
    assert default.fit["theta11"] == pytest.approx(found.fit["theta11"], abs=0.01)
    assert "constant_estimated" in {f.code for f in default.findings}


# ------------------------------------------------------------------------------------------------ found by its test


def test_auto_estimates_an_offset_where_the_runs_ask_for_one_and_says_so(tmp_path):
    for kind, constant in (("motor", 5.0), ("battery", 3.7)):
        run, structure, truth = loops.offset_run(kind, constant, 1)
        found = ftlm.identify(run, structure, offset="auto")
        assert found.model.structure.offset == "constant"
        assert found.settings["offset_test"].startswith("constant, because the test is significant (chi-squared")
        for name, value in truth.items():
            low, high = found.intervals[name]
            # Three standard errors: 95 % would fail one number in twenty.
            assert abs(found.parameters[name].value - value) < 3 * (high - low) / 3.92
        assert "offset found by test: constant, because the test is significant" in found.details()
        # Estimated anew on the run that the model is judged on, and said.
        other, _, _ = loops.offset_run(kind, -2.0, 2)
        checked = found.validate(other)
        zero = checked.offsets[0][run.outputs[0]]["constant"] / found.coefficients["a"]
        assert zero == pytest.approx(-2.0, rel=0.1)
        assert checked.fit[run.outputs[0]] > 95
        assert "estimated on that run, for it alone" in str(checked)
    run.to_csv(tmp_path / "cell.csv")
    words = ["identify", str(tmp_path / "cell.csv"), "--structure", "D^alpha v = -a v + b i", "--offset", "auto"]
    said = CliRunner().invoke(cli.app, [*words, "--json", "--report", str(tmp_path / "r.html")])
    assert said.exit_code == 0, said.output
    output = json.loads(said.stdout)
    assert output["settings"]["offset"] == "constant"
    assert output["settings"]["offset_test"].startswith("constant")
    assert "because the test is significant" in (tmp_path / "r.html").read_text()


def test_auto_leaves_a_record_without_an_offset_as_it_was():
    run, structure, _ = loops.offset_run("motor", 0.0, 3)
    plain, found = ftlm.identify(run, structure), ftlm.identify(run, structure, offset="auto")
    assert found.settings["offset_test"].startswith("none, because the test is not significant (chi-squared")
    assert found.comparison.offsets == ()
    assert found.parameters == plain.parameters
    assert found.standard_errors == plain.standard_errors


@pytest.mark.parametrize("kind", ["motor", pytest.param("coloured", marks=pytest.mark.slow)])
def test_the_test_for_an_offset_keeps_its_level(kind):
    # At the true numbers, 60 seeds: 1 % is 0.6; at most 4 with a probability of 99.9 %. Chi-squared of one degree has
    # the mean 1 and the deviation 1.4.
    found = []
    for seed in range(60):
        run, structure, truth = loops.offset_run(kind, 0.0, seed)
        found.append(offset_test([run], replace(structure, initial="rest"), truth, pulses_per_sample=2))
    assert sum(t.exceeds() for t in found) <= 4
    assert {t.degrees for t in found} == {1}
    assert np.mean([t.statistic for t in found]) == pytest.approx(1.0, abs=0.55)


def test_the_test_for_an_offset_is_that_of_dense_regression():
    # The oracle: sensitivities of the free run by differences, noise of known white colour.
    run, truth = fractional_run(2, 0.005, noise=0.05), {"a": 0.7, "b": 1.4}
    structure = ftlm.equation("D^0.8 y = -a y + b u", initial="rest")
    found = offset_test([run], structure, truth, pulses_per_sample=4)
    steps = 4 * (run.length - 1)
    duration = run.duration

    def free(a: float, b: float, c: float) -> np.ndarray:
        driven = oracles.pulse_means(run["u"], steps, "zoh")
        y = oracles.free_run([(-a, 0.0)], [(b, 0.0, driven), (1.0, 0.0, np.full(steps, c))], 0.8, steps, duration)
        return (1.5 * y[3::4] - 0.5 * y[2::4])[:-1]

    at, small = free(0.7, 1.4, 0.0), 1e-5
    others = np.stack([free(0.7 + small, 1.4, 0.0) - at, free(0.7, 1.4 + small, 0.0) - at], axis=1)
    column, missed = free(0.7, 1.4, 1.0) - at, run["y"][1:-1] - at
    column = column - others @ np.linalg.lstsq(others, column, rcond=None)[0]
    every = np.column_stack([others, column])
    rest = missed - every @ np.linalg.lstsq(every, missed, rcond=None)[0]
    expected = rest.size * np.log1p((column @ missed) ** 2 / (column @ column) / (rest @ rest))
    assert found.statistic == pytest.approx(expected, rel=0.05)


def test_an_offset_that_nobody_asked_for_is_spoken_of():
    run, structure, _ = loops.offset_run("battery", 3.7, 0)
    # A history of the run, which the default finds, would take the offset in.
    (said,) = [w for w in ftlm.identify(run, replace(structure, initial="rest")).warnings if "unknown constant" in w]
    assert ftlm.identify(run, structure).orders["alpha"] == pytest.approx(0.8, abs=0.005)
    assert "in the equation of v explains" in said
    assert "use offset='constant' or offset='auto'" in said
    bare, structure, _ = loops.offset_run("battery", 0.0, 0)
    assert not [w for w in ftlm.identify(bare, structure).warnings if "unknown constant" in w]
    for method in ("least-squares", "instrumental-variables"):
        known = replace(structure.with_orders({"alpha": 0.8}), initial="caputo")
        found = ftlm.identify(run, known, method=method, offset="auto")
        assert found.coefficients["a"] == pytest.approx(0.2, rel=0.15)
        assert found.settings["offset"] == "constant"


def test_auto_says_where_an_offset_cannot_be_told():
    # An input that never changes does what an offset does, and so does a given initial term of its power.
    t = 0.1 * np.arange(200)
    y = -np.expm1(-t) + 0.01 * np.random.default_rng(0).standard_normal(200)
    still = ftlm.Run.from_arrays(step=0.1, inputs={"u": np.ones(200)}, outputs={"y": y})
    found = ftlm.identify(still, ftlm.equation("D y = -a y + b u", initial="rest"), offset="auto")
    assert found.settings["offset_test"].startswith("none: u is constant on every run")
    ramp = ftlm.Run.from_arrays(step=0.1, inputs={"u": np.sin(t)}, outputs={"y": 1.0 - np.cos(t) + 0.3 * t + 0.5})
    found = ftlm.identify(ramp, ftlm.equation("D y = b u", initial=(0.0, 1.0)), offset="auto")
    assert "not separately identifiable" in found.settings["offset_test"]
    assert found.coefficients["b"] == pytest.approx(1.0, rel=1e-2)
    with pytest.raises(ftlm.ModelError, match=r"offset='auto' lets ftlm\.identify decide"):
        ftlm.search_orders(still, ftlm.equation("D^alpha y = -a y + b u", offset="auto"))
    with pytest.raises(ftlm.ModelError, match=r"offset='auto' lets ftlm\.identify decide"):
        ftlm.Model(ftlm.equation("D y = -2 y + 3 u", offset="auto"))
    with pytest.raises(ftlm.ModelError, match="a store keeps only one"):
        ftlm.identify(
            still, ftlm.equation("D^alpha y = -a y + b u"), method=ftlm.LeastSquares(store="never"), offset="auto"
        )


# ------------------------------------------------------------------------------------------------ the hub of the arm


@needs_data
@pytest.mark.parametrize(("name", "within"), [("psf", (1.1, 19.5)), ("lqr", None)])
def test_the_offset_of_the_hub_ends_in_the_global_optimum(name, within):
    # The oracle: with d given, the state-space free run is linear in everything else, so a scan of d alone finds it.
    run = ftlm.load(
        DATA / f"two_link_{name}" / f"{name}.csv",
        time="t_s",
        inputs={"I1": "Im1_meas_A"},
        outputs={"theta11": "th11_deg", "theta12": "th12_deg"},
        units={"theta11": "deg", "theta12": "deg"},
    )
    run = run if within is None else run.window(*within)
    step = 4 * run.step
    thin = ftlm.Run.from_arrays(
        step=step, inputs={"I1": run["I1"][::4]}, outputs={n: run[n][::4] for n in ("theta11", "theta12")}
    )
    y, drives = thin["theta11"], [thin["I1"], thin["theta12"], np.ones(thin.length)]
    clock = np.arange(thin.length) * step
    best = np.inf
    for d in np.geomspace(0.05, 3000.0, 80):
        decay = np.exp(-d * step)
        columns = [np.ones(thin.length), np.exp(-d * clock)]
        for drive in drives:
            # Held over each step: exact for D^2 x = -d D x + drive.
            gain = (1 - decay) / d
            rate = lfilter([0.0, gain], [1.0, -decay], drive)
            moved = gain * rate + (step - gain) / d * drive
            columns.append(np.cumsum(np.concatenate([[0.0], moved[:-1]])))
        basis = np.stack(columns, axis=1)
        basis /= np.linalg.norm(basis, axis=0)
        best = min(best, np.linalg.norm(y - basis @ np.linalg.lstsq(basis, y, rcond=1e-12)[0]))
    reached = 100 * (1 - best / np.linalg.norm(y - y.mean()))
    structure = ftlm.equation("D^2 theta11 = -d D theta11 + b I1 + k theta12 + c")
    found = ftlm.identify(thin, structure)
    assert found.fit["theta11"] == pytest.approx(reached, abs=0.3)
    assert reached == pytest.approx({"psf": 76.4, "lqr": 87.9}[name], abs=0.3)


def raised_motor(seed):
    """A motor of first order whose speed is read 5 rad/s too high, and so at its start."""
    rng = np.random.default_rng([14, seed])
    t, u = np.arange(800) * 0.01, np.repeat(rng.choice([-1.0, 1.0], 40), 20)
    _, y, _ = lsim(([8.0], [0.15, 1.0]), u, t, interp=False)
    return ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": y + 5.0 + 0.02 * rng.standard_normal(800)})


FIRST_ORDER = "D^alpha y = a y + b u"


@pytest.mark.parametrize("seed", [0, 1])
def test_an_offset_is_found_whichever_side_of_one_the_order_ends(seed):
    # Just above one Caputo's terms hold t^1, which does what the offset does; just below one they do not.
    found = ftlm.identify(raised_motor(seed), ftlm.equation(FIRST_ORDER, offset="auto"))
    assert found.settings["offset_test"].startswith("constant")
    assert found.settings["initial"] == "caputo"
    assert found.comparison.offsets[0]["y"]["constant"] == pytest.approx(5 / 0.15, rel=0.01)
    assert sorted(found.comparison.initial[0]["y"]) == pytest.approx([0.0, found.orders["alpha"]])
    for name, true in {"alpha": 1.0, "a": -1 / 0.15, "b": 8 / 0.15}.items():
        value = {**found.orders, **found.coefficients}[name]
        assert abs(value - true) < 3.5 * found.standard_errors[name]


def test_a_level_is_not_taken_for_a_past():
    # The speed is read 5 rad/s too high, and the motor rested: a history of powers of t would do as well.
    found = ftlm.identify(raised_motor(0), ftlm.equation(FIRST_ORDER))
    assert (found.settings["initial"], found.settings["offset"]) == ("rest", "level")
    assert found.comparison.offsets[0]["y"]["level"] == pytest.approx(5.0, abs=0.01)
    assert "level_estimated" in [finding.code for finding in found.findings]
    for name, true in {"alpha": 1.0, "a": -1 / 0.15, "b": 8 / 0.15}.items():
        value = {**found.orders, **found.coefficients}[name]
        assert abs(value - true) < 3.5 * found.standard_errors[name]


@pytest.mark.parametrize(("alpha", "left"), [(1.0003, [0.0]), (1.04, [0.0]), (1.2, [0.0, 1.0]), (1.98, [0.0, 1.0])])
def test_powers_of_time_that_an_offset_is_are_left_out(alpha, left):
    (item,) = ftlm.equation(f"D^{alpha} y = -2 y + u").equations
    assert initial_exponents(item, "caputo", "constant") == pytest.approx([*left, alpha])
    assert initial_exponents(item, "caputo", "none") == [0.0, 1.0]


def test_a_free_run_that_diverges_has_no_offset_and_says_so():
    run = ftlm.Run.from_arrays(step=0.02, inputs={"u": np.ones(900)}, outputs={"y": np.arange(900.0)}, name="ramp")
    model = ftlm.Model(ftlm.equation("D^2 y = 0.5 D y + 1e6 y + u", offset="constant"))
    comparison = ftlm.compare(model, run)
    assert not np.isfinite(comparison.output_error["y"].nr)
    assert comparison.offsets == ({"y": {}},)
    assert "offset in the equation of y in ramp: not estimated, since the simulation diverges" in str(comparison)


def recorded(u: np.ndarray, y: np.ndarray, step: float, name: str = "run", **inputs: np.ndarray) -> ftlm.Run:
    """A run of one output and any inputs."""
    units = {"y": "m", "u": "V"}
    return ftlm.Run.from_arrays(step=step, inputs={"u": u, **inputs}, outputs={"y": y}, units=units, name=name)


def check_against_input_of_ones(found: ftlm.Identification, same: ftlm.Identification, pairs: dict[str, str]) -> None:
    """A constant has the value and the standard error of the coefficient of an input of ones."""
    for name, coefficient in pairs.items():
        parameter, reference = found.parameters[name], same.parameters[coefficient]
        assert parameter.standard_error == pytest.approx(reference.standard_error, rel=0.02)
        assert abs(parameter.value - reference.value) < 0.05 * reference.standard_error
        assert parameter.interval == pytest.approx(reference.interval, abs=0.1 * reference.standard_error)


def test_a_constant_is_a_parameter_with_the_standard_error_of_linear_regression(tmp_path):
    # D y = b u + c from rest is y = b ∫u + c t, linear in both.
    g, h = np.random.default_rng(11), 0.01
    u = np.repeat(g.choice([-1.0, 0.6], 48), 25)
    time, area = h * np.arange(u.size), h * np.concatenate([[0.0], np.cumsum(u)[:-1]])
    y = 2.0 * area - 0.6 * time + 0.01 * g.standard_normal(u.size)
    regressors = np.stack([area, time], axis=1)
    _, squares, *_ = np.linalg.lstsq(regressors, y, rcond=None)
    error = np.sqrt(np.linalg.inv(regressors.T @ regressors)[1, 1] * squares[0] / (u.size - 2))
    result = ftlm.identify(recorded(u, y, h), ftlm.equation("D y = b u", offset="constant"))
    parameter = result.parameters["constant_y"]
    assert parameter.value == result.comparison.offsets[0]["y"]["constant"]
    assert parameter.standard_error == pytest.approx(error, rel=0.02)
    assert (parameter.unit, parameter.fixed) == ("s^-1 m", False)
    assert result.to_frame().loc["constant_y", "standard_error"] == parameter.standard_error
    assert [line for line in result.summary().splitlines() if line.startswith("  constant_y ")]
    page = result.report(tmp_path / "page.html").read_text()
    assert "<i>constant_y</i>" in page
    assert "constant of the equation, for this run only" in page


def test_a_constant_of_each_run_has_the_standard_error_of_an_input_of_ones():
    runs, with_ones = [], []
    for k, constant in enumerate((0.6, -0.4)):
        g = np.random.default_rng(k)
        u = np.repeat(g.choice([-1.0, 1.0], 48), 25)
        y = lfilter([0.0, 1 - np.exp(-0.005)], [1.0, -np.exp(-0.005)], 4.0 * u + 2.0 * constant)
        y = y + lfilter([0.03], [1.0, -0.9], 0.1 * g.standard_normal(u.size))
        runs.append(recorded(u, y, 0.01, f"run {k}"))
        ones = {n: np.ones(u.size) * (j == k) for j, n in enumerate(("first", "second"))}
        with_ones.append(recorded(u, y, 0.01, f"run {k}", **ones))
    found = ftlm.identify(runs, ftlm.equation("D y = a y + b u", offset="constant", initial="rest"))
    words = "D y = a y + b u + c first + d second"
    same = ftlm.identify(with_ones, ftlm.equation(words, initial="rest"), offset="none")
    check_against_input_of_ones(found, same, {"constant_y[run 0]": "c", "constant_y[run 1]": "d"})


def test_a_constant_of_a_nonlinear_equation_has_the_standard_error_of_an_input_of_ones():
    g, h, state, y = np.random.default_rng(3), 0.02, 0.0, []
    u = np.repeat(g.uniform(-2.0, 3.0, 40), 20)
    for value in u:
        y.append(state)
        for _ in range(20):
            state += 0.05 * h * (-(state**3) + value - 0.5)
    run = recorded(u, np.array(y) + 0.01 * g.standard_normal(u.size), h)
    same = recorded(u, run["y"], h, ones=np.ones(u.size))
    found = ftlm.identify(run, ftlm.equation("D y = -k y^3 + b u", offset="constant", initial="rest"))
    check_against_input_of_ones(
        found,
        ftlm.identify(same, ftlm.equation("D y = -k y^3 + b u + c ones", initial="rest"), offset="none"),
        {"constant_y": "c"},
    )


def test_a_ramp_has_the_standard_error_of_an_input_of_time():
    run = fractional_run(4, 0.3, ramp=0.2)
    time = run.step * np.arange(run.length)
    same = recorded(run["u"], run["y"], run.step, ones=np.ones(time.size), time=time)
    words = "D^0.8 y = -a y + b u"
    found = ftlm.identify(run, ftlm.equation(words, offset="ramp", initial="rest"))
    reference = ftlm.identify(same, ftlm.equation(f"{words} + c ones + r time", initial="rest"), offset="none")
    for name, coefficient in (("constant_y", "c"), ("ramp_y", "r")):
        assert found.parameters[name].standard_error == pytest.approx(
            reference.parameters[coefficient].standard_error, rel=0.02
        )


def test_a_level_is_a_parameter_with_the_standard_error_of_least_squares():
    g = np.random.default_rng(8)
    u = np.where(np.arange(240) < 30, 0.0, 5.0)

    def simulated(p):
        pole = np.exp(-0.5 / p[1])
        return p[2] + lfilter([0.0, 1 - pole], [1.0, -pole], p[0] * u)

    y = simulated([1.2, 10.0, 20.0]) + 0.05 * g.standard_normal(u.size)
    found = least_squares(lambda p: simulated(p) - y, [1.0, 9.0, 19.0])
    spread = np.linalg.inv(found.jac.T @ found.jac) * 2 * found.cost / (u.size - 3)
    result = ftlm.identify(recorded(u, y, 0.5), ftlm.equation("D y = a y + b u"))
    level = result.parameters["level_y"]
    assert level.value == pytest.approx(found.x[2], abs=0.3 * np.sqrt(spread[2, 2]))
    assert level.standard_error == pytest.approx(np.sqrt(spread[2, 2]), rel=0.03)
    assert level.unit == "m"


def test_a_constant_without_a_covariance_has_no_standard_error():
    structure = ftlm.equation("D^0.8 y = -a y + b u", offset="constant", initial="rest")
    result = ftlm.identify(fractional_run(2, 0.5), structure, method="least-squares")
    parameter = result.parameters["constant_y"]
    assert np.isfinite(parameter.value)
    assert np.isnan(parameter.standard_error)
    line = next(line for line in result.summary().splitlines() if "constant_y" in line)
    assert "±" not in line


@pytest.mark.parametrize("bias", [0.0, 0.5])
def test_a_constant_that_stands_for_motion_of_an_integrating_plant_is_left_out(bias):
    # An encoder that counts from its first sample while the motor turns: 600 / (s (s + 20)), an input sensor with bias.
    g, step = np.random.default_rng(3), 0.008
    u = np.repeat(g.uniform(-6, 6, 75), 12)
    num, den, _ = cont2discrete(([600.0], [1.0, 20.0, 0.0]), step)[:3]
    y = lfilter(np.ravel(num), den, u)[100:]
    y += 0.01 * np.std(y) * g.standard_normal(800)
    run = ftlm.Run.from_arrays(step=step, inputs={"u": u[100:] + bias}, outputs={"y": y - y[0]})
    found = ftlm.identify(run, ftlm.equation("D^2 y = a D y + b u"))
    for name, true in (("a", -20.0), ("b", 600.0)):
        assert abs(found.parameters[name].value - true) < 4 * found.parameters[name].standard_error
    said = {finding.code for finding in found.findings}
    assert "rest_rejected" in said
    assert ("constant_estimated" in said) is (bias > 0)
    if bias:
        constant = found.parameters["constant_y"]
        assert abs(constant.value + 600.0 * bias) < 4 * constant.standard_error
