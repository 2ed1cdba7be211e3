"""Delays of inputs: known, estimated with intervals, refused where they cannot be."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import ftlm
import plants
from ftlm import _core, cli
from ftlm.estimation.free_parameters import FreeProblem, core_arguments
from ftlm.estimation.objective import Iterate, minimize_cost, sample_run
from ftlm.estimation.output_error import fit_output_error
from slow_cases import slow_after

pytestmark = pytest.mark.usefixtures("no_extension_tests")

WORDS = "D^alpha y = a1 D^nu y + a0 y + b0 u"


def late_run(delay: float, snr: float, seed: int, *, is_constant: bool = True) -> ftlm.Run:
    """The three-term plant behind a delay: the truth is simulated on a grid that the delay is a multiple of."""
    clean = plants.clean_run("3T")
    fine = 8
    step, rows = clean.step / fine, (clean.length - 1) * fine + 1
    steps = round(delay / step)
    assert steps == pytest.approx(delay / step, abs=1e-9)
    if is_constant:
        given = np.repeat(clean["u"], fine)[:rows]
    else:
        # Linear between the samples, as the record says.
        coarse = np.arange(clean.length) * clean.step
        drive = np.sin(1.3 * coarse) + np.sin(2.9 * coarse + 1) - np.sin(1.0)
        given = np.interp(np.arange(rows) * step, coarse, drive)
    arrived = np.concatenate([np.zeros(steps), given])[:rows]
    truth = ftlm.Model(ftlm.equation("D^2.2 y = -0.625 D^0.9 y - 1.25 y + 1.25 u"))
    between = {"u": "zoh" if is_constant else "foh"}
    blank = ftlm.Run.from_arrays(step=step, inputs={"u": arrived}, outputs={"y": 0 * arrived}, intersample=between)
    y = truth.simulate(blank, tolerance=1e-7)["y"][::fine]
    noise = np.std(y) * 10 ** (-snr / 20) * np.random.default_rng([seed, 77]).standard_normal(y.size)
    return ftlm.Run.from_arrays(
        step=clean.step, inputs={"u": given[::fine]}, outputs={"y": y + noise}, intersample=between, name=f"late {seed}"
    )


def structure(low: float = 0.0, high: float = 0.6) -> ftlm.Structure:
    return replace(ftlm.equation(WORDS, delay={"u": (low, high)}), initial="rest")


DELAY = 30.375 * plants.clean_run("3T").step


@pytest.fixture(scope="module")
def found() -> ftlm.Identification:
    return ftlm.identify(late_run(DELAY, 40, 0), structure(), threads=1)


def test_a_delay_is_estimated_with_the_rest(found):
    truth = {**plants.THREE_TERMS, "delay_u": DELAY}
    errors = found.standard_errors
    assert set(errors) == set(truth)
    for name, value in truth.items():
        low, high = found.intervals[name]
        assert low < high
        centre = 0.5 * (low + high)
        assert abs(centre - value) < 4 * errors[name], name
    assert found.delays == {"u": pytest.approx(DELAY, abs=4 * errors["delay_u"])}
    assert errors["delay_u"] < plants.clean_run("3T").step
    assert found.model.structure.delay == found.delays
    assert found.model.structure.free_delays == {}
    assert found.joint.step_converged


@slow_after(1, "seeds", [8, 30])
def test_its_score_is_that_of_a_standard_normal_number(seeds):
    truth = [2.2, 0.9, *[plants.THREE_TERMS[n] for n in ("a1", "a0", "b0")], DELAY]
    problem = FreeProblem.of(structure())
    scores = []
    for seed in range(seeds):
        found = fit_output_error(
            [late_run(DELAY, 40, seed)], structure(), start=dict(zip(problem.names, truth, strict=True))
        )
        scores.append((found.inputs["delay_u"] - DELAY) / found.standard_errors["delay_u"])
    # Thirty standard normal numbers: the mean scatters by 0.18, the deviation by 0.13.
    assert abs(np.mean(scores)) < 0.65
    assert 0.55 < np.std(scores) < 1.45


def test_an_input_that_is_linear_in_between_is_delayed_to_second_order():
    errors = []
    for every in (1, 2, 4):
        problem = FreeProblem.of(structure())
        run = late_run(DELAY, 200, 0, is_constant=False)
        prepared = [sample_run(run, problem, [1.0], pulses_per_sample=every)]
        start = Iterate([2.2, 0.9], [plants.THREE_TERMS[n] for n in ("a1", "a0", "b0")], "truth", {}, [DELAY])
        end = minimize_cost(problem, prepared, start, evaluations=40, linear_scale=True)
        errors.append(abs(end.inputs[0] - DELAY))
    assert errors[0] < 0.02 * plants.clean_run("3T").step
    assert errors[2] < errors[0] / 6


def test_the_model_is_the_one_with_the_delay_known(found, tmp_path):
    run = late_run(DELAY, 40, 0)
    known = structure().with_delays(found.delays).with_orders(found.orders).with_coefficients(found.coefficients)
    assert np.array_equal(ftlm.Model(known).simulate(run)["y"], found.model.simulate(run)["y"])
    assert found.fit["y"] == pytest.approx(found.model.compare(run).fit["y"], abs=1e-12)
    assert found.fit["y"] > 98
    saved = found.model.save(tmp_path / "late.json")
    again = ftlm.load_model(saved)
    assert again.structure.delay == found.delays
    assert again.estimate.standard_errors["delay_u"] == found.standard_errors["delay_u"]
    again.simulate(run)


def test_it_is_said_everywhere(found, tmp_path):
    assert "delay_u" in str(found)
    assert found.to_dict()["delays"] == found.delays
    assert "delay_u" in found.to_frame().index
    page = found.report(tmp_path / "late.html").read_text(encoding="utf-8")
    assert re.search(r"<td[^>]*>s</td><td[^>]*>delay of u</td>", page)
    # Of an estimated delay the equation has no more digits than the table knows.
    (digits,) = re.findall(r"<mi>t</mi><mo>−</mo><mn>([\d.]+)</mn>", page)[:1]
    assert len(digits.replace(".", "").lstrip("0")) <= 6


def test_two_runs_share_one_delay():
    one, two = late_run(DELAY, 40, 1), late_run(DELAY, 40, 2)
    start = {**plants.THREE_TERMS, "delay_u": DELAY}
    alone = fit_output_error([one], structure(), start=start).standard_errors["delay_u"]
    both = fit_output_error([one, two], structure(), start=start).standard_errors["delay_u"]
    assert both == pytest.approx(alone / np.sqrt(2), rel=0.1)


def test_no_delay_is_found_where_there_is_none():
    found = fit_output_error([plants.noisy_run("3T", 40, 5)], structure())
    # At 0 the estimate is on its natural edge, which is no reason to widen anything.
    assert found.inputs["delay_u"] < 3 * found.standard_errors["delay_u"]
    result = ftlm.identify(plants.noisy_run("3T", 40, 5), structure(), threads=1)
    assert not [w for w in result.warnings if "on its bound" in w]


def test_a_delay_beyond_its_bound_is_named():
    found = ftlm.identify(late_run(DELAY, 40, 0), structure(0.0, 0.1), threads=1)
    assert any("the delay of u = 0.1 s is on its bound; widen the bound" in w for w in found.warnings)


@pytest.mark.parametrize("method", ["instrumental-variables", "least-squares", "multi-innovation"])
def test_other_methods_refuse_a_free_delay(method):
    fixed = structure().with_orders({"alpha": 2.2, "nu": 0.9})
    with pytest.raises(ftlm.ModelError, match=r"the delay of u is free: only method='output-error'.*give its value"):
        ftlm.identify(plants.noisy_run("3T", 40, 5), fixed, method=method)
    with pytest.raises(ftlm.ModelError, match="the delay of u is free"):
        ftlm.search_orders(plants.noisy_run("3T", 40, 5), structure(), ftlm.order_grid(increment=0.2))


@pytest.mark.parametrize(
    ("delay", "words"),
    [
        ({"u": (0.2, 0.1)}, "from 0.2 to 0.1 s is not an interval"),
        ({"u": (0.1, 0.1)}, "give the smaller time first"),
        ({"u": (0.0, np.inf)}, "is not an interval"),
        ({"u": (0.0, np.nan)}, "is not an interval"),
        ({"u": (0.0,)}, r"has 1 value; give seconds, or \(minimum"),
        ({"u": ("a", 0.1)}, "minimum delay of u"),
        ({"y": (0.0, 0.1)}, "delayed input"),
        ({"v": 0.1}, "delayed input"),
        ({"u": np.inf}, "not a finite number"),
    ],
)
def test_a_delay_that_is_none_is_refused(delay, words):
    with pytest.raises(ftlm.ModelError, match=words):
        ftlm.equation(WORDS, delay=delay)


def test_a_model_has_no_free_delay_and_no_second_name():
    free = structure().with_orders({"alpha": 2.2, "nu": 0.9}).with_coefficients({"a1": -1, "a0": -1, "b0": 1})
    with pytest.raises(ftlm.ModelError, match="the delay of u is still free"):
        ftlm.Model(free)
    with pytest.raises(ftlm.ModelError, match="delay_u is the name of the delay of u"):
        ftlm.equation("D^alpha y = a0 y + delay_u u", delay={"u": (0.0, 0.1)})


def test_the_core_refuses_delays_that_are_none():
    plain = structure()
    prepared = [sample_run(plants.noisy_run("3T", 40, 5), FreeProblem.of(plain), [1.0])]

    def core(delays):
        inputs = [("delay", s, "delay", ends) for s, ends, _ in delays]
        problem = _core.JointProblem({**core_arguments(replace(plain, free_delays={})), "inputs": inputs})
        start = [2.2, 0.9, -0.6, -1.2, 1.2, *(v for *_, v in delays)]
        return problem.minimize(prepared, (start, []), True, [], 1, 1e-9, False)

    for delays in ([(0, (0.0, 0.1), 0.0)], [(7, (0.0, 0.1), 0.0)], [(1, (0.2, 0.1), 0.1)], [(1, (0.0, 0.1), np.nan)]):
        with pytest.raises(ftlm.ModelError):
            core(delays)
    assert core([(1, (0.0, 0.1), 5.0)])["values"][-1] == pytest.approx(0.1)


def test_on_the_command_line(tmp_path):
    late_run(DELAY, 40, 0).to_csv(tmp_path / "late.csv")
    command = ["identify", str(tmp_path / "late.csv"), "--structure", WORDS, "--delay"]
    done = CliRunner().invoke(cli.app, [*command, "u=0.2:0.4", "--initial", "rest", "--json"])
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)
    assert said["delays"]["u"] == pytest.approx(DELAY, abs=4 * said["standard_errors"]["delay_u"])
    done = CliRunner().invoke(cli.app, [*command, "u=0.2..0.4"])
    assert done.exit_code != 0
    assert "is neither seconds nor LOW:HIGH; give one" in done.output


# ----------------------------------------------------------------------------------------------------------------------
# An input that is logged after it acts


FINE = 10


def early_runs(words, rows, intersample):
    """A run whose input acts 0.7 rows before it is logged, and the clean output by a grid ten times finer."""
    step = 0.2
    u = np.repeat(np.random.default_rng(9).choice([-1.0, 1.0], 60), 4)
    fine = np.repeat(u, FINE)
    acting = np.concatenate([fine[7:], np.full(7, fine[-1])])
    if intersample == "foh":
        t = np.arange(u.size * FINE) / FINE
        acting = np.interp(t + 0.7, np.arange(u.size), u)
    blank = ftlm.Run.from_arrays(
        step=step / FINE, inputs={"u": acting}, outputs={"y": 0 * acting}, intersample={"u": intersample}
    )
    y = ftlm.Model(ftlm.equation(words)).simulate(blank)["y"][::FINE]
    run = ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": y}, intersample={"u": intersample})
    return run.window(0.0, rows * step)


@pytest.mark.parametrize("words", ["D^2 y = -1.2 D y - 4.0 y + 4.0 u", "D^1.7 y = -1.2 D^0.6 y - 4.0 y + 4.0 u"])
def test_a_negative_delay_acts_before_its_row(words):
    run = early_runs(words, 200, "zoh")
    early = ftlm.Model(ftlm.equation(words.replace("+ 4.0 u", "+ 4.0 u(t + 0.14)")))
    assert early.structure.delay == {"u": pytest.approx(-0.14)}
    answer = early.simulate(run)["y"]
    np.testing.assert_allclose(answer, run["y"], atol=2e-4 * np.std(run["y"]))
    late = ftlm.Model(ftlm.equation(words)).simulate(run)["y"]
    assert np.max(np.abs(late - run["y"])) > 0.1


def test_a_whole_row_early_is_the_next_row():
    words = "D^2 y = -1.2 D y - 4.0 y + 4.0 u"
    u = np.repeat(np.random.default_rng(9).choice([-1.0, 1.0], 60), 4)
    for between in ("zoh", "foh"):
        given, shifted = (
            ftlm.Run.from_arrays(step=0.2, inputs={"u": v}, outputs={"y": 0 * u}, intersample={"u": between})
            for v in (u, np.append(u[1:], u[-1]))
        )
        early = ftlm.Model(ftlm.equation(words, delay={"u": -0.2})).simulate(given)["y"]
        np.testing.assert_allclose(early, ftlm.Model(ftlm.equation(words)).simulate(shifted)["y"], atol=1e-9)


@pytest.mark.parametrize("words", ["D^2 y = -p D y - q y + b u", "D^alpha y = -p D^0.6 y - q y + b u"])
def test_a_negative_delay_is_estimated(words):
    truth = "D^2 y = -1.2 D y - 4.0 y + 4.0 u" if "alpha" not in words else "D^1.7 y = -1.2 D^0.6 y - 4.0 y + 4.0 u"
    run = early_runs(truth, 230, "zoh")
    noise = 0.01 * np.std(run["y"]) * np.random.default_rng(3).standard_normal(run.length)
    noisy = run.with_outputs({"y": run["y"] + noise})
    found = ftlm.identify(noisy, ftlm.equation(words, delay={"u": (-0.2, 0.4)}), threads=1)
    error = found.standard_errors["delay_u"]
    assert found.delays["u"] == pytest.approx(-0.14, abs=4 * error)
    assert error < 0.02
    assert found.coefficients["b"] == pytest.approx(4.0, abs=4 * found.standard_errors["b"])
    assert found.fit["y"] > 98.5


def test_an_input_is_no_more_than_a_row_early():
    run = early_runs("D y = -1.0 y + 1.0 u", 100, "zoh")
    for delay in (-0.21, (-0.3, 0.1)):
        with pytest.raises(ftlm.ModelError, match="more than one sampling interval"):
            ftlm.identify(run, ftlm.equation("D y = a y + b u", delay={"u": delay}))
    with pytest.raises(ftlm.ModelError, match="more than one sampling interval"):
        ftlm.Model(ftlm.equation("D y = -1.0 y + 1.0 u", delay={"u": -0.21})).simulate(run)
    early = ftlm.Model(ftlm.equation("D y = -1.0 y + 1.0 u", delay={"u": -0.1}))
    with pytest.raises(ftlm.ModelError, match="no linear system responds before its input"):
        ftlm.analysis.to_control(early, band=(0.1, 10.0))
