"""The automatic structure finds delays and zeros, and predicts another record as the truth does."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter
from typer.testing import CliRunner

import friction
import ftlm
from ftlm.cli.main import app
from ftlm.structure_selection import stepwise
from ftlm.utils.formatting import typeset
from slow_cases import slow_after


def record(
    numerator: list[float], denominator: list[float], *, seed: int, hold: int, step: float = 0.02, late: int = 0
) -> tuple[ftlm.Run, float]:
    """Return a noisy record and the fit of the truth."""
    g = np.random.default_rng(seed)
    u = np.repeat(g.uniform(-3, 3, 400 // hold + 1), hold)[:400]
    b, a, _ = cont2discrete((numerator, denominator), step)[:3]
    y = lfilter(np.ravel(b), a, np.r_[np.zeros(late), u][:400])
    noisy = y + 0.02 * y.std() * g.standard_normal(400)
    run = ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": noisy})
    return run, 100 * (1 - float(np.linalg.norm(noisy - y) / np.linalg.norm(noisy - noisy.mean())))


@pytest.mark.parametrize(
    ("numerator", "denominator", "late", "words"),
    [
        ([7.0], [1.0, 4.0], 6, "u(t - 0:0.667 s)"),
        ([12.0, 40.0], [1.0, 3.0, 40.0], 0, "D^1 u"),
        # That of the next test by default.
        pytest.param([60.0], [1.0, 6.0, 0.0], 0, "D^2 y = a1 D^1 y + b0 u", marks=pytest.mark.slow),
        ([1.0, 0.4, 30.0], [1.0, 0.5, 25.0], 0, "D^2 y = a1 D^1 y + a0 y + b2 D^2 u + b1 D^1 u + b0 u"),
    ],
)
def test_auto_finds_a_delay_zeros_feedthrough_and_an_integrator(
    numerator: list[float], denominator: list[float], late: int, words: str
) -> None:
    run, _ = record(numerator, denominator, seed=1, hold=20, late=late)
    other, truth = record(numerator, denominator, seed=2, hold=7, late=late)
    found = ftlm.select(run, "auto", threads=1)
    assert words in found.winner.name
    assert found.best.model.compare(other).fit["y"] > truth - 0.5


@slow_after(
    2,
    "numerator, denominator, words, bias",
    [
        ([5.0], [1.0, 0.0], "D^1 y = b0 u", 0.5),
        ([60.0], [1.0, 6.0, 0.0], "D^2 y = a1 D^1 y + b0 u", 0.0),
        ([5.0], [1.0, 0.0], "D^1 y = b0 u", 0.0),
        ([60.0], [1.0, 6.0, 0.0], "D^2 y = a1 D^1 y + b0 u", 0.5),
    ],
)
def test_auto_finds_an_integrator_despite_an_offset_of_its_input_sensor(numerator, denominator, words, bias):
    run, _ = record(numerator, denominator, seed=3, hold=20)
    biased = ftlm.Run.from_arrays(step=run.step, inputs={"u": run["u"] + bias}, outputs={"y": run["y"]})
    best = ftlm.select(biased, "auto").best
    assert str(best.task.structure) == words + (" + c" if bias else "")
    assert best.coefficients["b0"] == pytest.approx(numerator[0], rel=0.03)


def test_auto_finds_the_level_of_an_output_rather_than_a_pole_and_a_zero_at_zero() -> None:
    # An oven that is kept at 55 degrees by 20 %, and is then heated twice.
    u = np.full(800, 20.0)
    u[60:400], u[400:] = 45.0, 30.0
    pole = np.exp(-1 / 40)
    y = 55 + lfilter([0, 0.6 * (1 - pole)], [1, -pole], np.r_[np.zeros(12), u - 20][:800])
    noisy = y + 0.1 * np.random.default_rng(0).standard_normal(800)
    run = ftlm.Run.from_arrays(step=1.0, inputs={"u": u}, outputs={"y": noisy})
    found = ftlm.select(run, "auto", threads=1)
    assert found.winner.name == "D^1 y = a0 y + b0 u(t - 0:60 s), with an output level"
    values = found.best.parameters
    assert values["a0"].value == pytest.approx(-1 / 40, rel=0.02)
    assert values["b0"].value == pytest.approx(0.6 / 40, rel=0.02)
    assert values["delay_u"].value == pytest.approx(12, abs=0.3)


def test_noise_with_a_color_does_not_raise_the_order(monkeypatch: pytest.MonkeyPatch) -> None:
    with_friction: list[str] = []
    whole = stepwise.fit

    def record_friction(runs, structure, starts, **options):  # type: ignore[no-untyped-def]
        with_friction.extend(structure.coefficient_names if structure.has_friction else ())
        return whole(runs, structure, starts, **options)

    monkeypatch.setattr(stepwise, "fit", record_friction)
    g = np.random.default_rng(1)
    u = np.repeat(g.choice([-1.0, 1.0], 100), 15)
    b, a, _ = cont2discrete(([4.0], [1.0, 0.8, 4.0]), 0.05)[:3]
    y = lfilter(np.ravel(b), a, u) + lfilter([0.05], [1, -0.95], g.standard_normal(1500))
    run = ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": y})
    found = ftlm.select(run, "auto", threads=1)
    assert found.winner.name == "D^2 y = a1 D^1 y + a0 y + b0 u"
    lower, upper = found.best.intervals["a1"]
    assert lower < -0.8 < upper
    # A friction force along the motion of the linear fit explains nothing of this noise.
    assert with_friction == []


def test_colored_noise_at_nonuniform_sample_times_does_not_end_auto() -> None:
    g = np.random.default_rng(5)
    t = np.cumsum(0.1 + 0.02 * g.uniform(-1.0, 1.0, 300))
    u = np.repeat(g.choice([-1.0, 1.0], 30), 10)
    y = np.zeros(300)
    for k, step in enumerate(np.diff(t)):
        y[k + 1] = 2.0 * u[k] + (y[k] - 2.0 * u[k]) * np.exp(-step)
    y += lfilter([0.02], [1.0, -0.9], g.standard_normal(300))
    run = ftlm.Run.from_arrays(inputs={"u": u}, outputs={"y": y}, time=t - t[0], resample=0.1)
    found = ftlm.select(run, "auto", threads=1)
    assert "fc" not in found.winner.name
    assert found.best.model.dcgain() == pytest.approx(2.0, rel=0.15)


def test_a_candidate_that_fails_is_a_row_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = stepwise.fit

    def refuse(runs, structure, starts, **options):  # type: ignore[no-untyped-def]
        if structure.order_names:
            raise ftlm.ConvergenceError("no finite simulation")
        return whole(runs, structure, starts, **options)

    monkeypatch.setattr(stepwise, "fit", refuse)
    run, _ = record([7.0], [1.0, 4.0], seed=1, hold=20)
    found = ftlm.select(run, "auto", threads=1)
    failed = [t for t in found.trials if t.failure is not None]
    assert failed
    assert all(t.failure == "no finite simulation" for t in failed)
    assert found.winner.failure is None


def test_a_given_delay_narrows_auto() -> None:
    run, _ = record([7.0], [1.0, 4.0], seed=1, hold=20, late=6)
    found = ftlm.select(run, "auto", delay={"u": 0.12}, threads=1)
    assert all("u(t - 0.12 s)" in trial.name for trial in found.trials)
    assert found.best.model.coefficients["a0"] == pytest.approx(-4.0, rel=0.05)
    within = ftlm.select(run, "auto", delay={"u": (0.1, 0.16)}, threads=1)
    assert all("u(t - 0.1:0.16 s)" in trial.name for trial in within.trials)
    with pytest.raises(ftlm.ModelError, match="'v'"):
        ftlm.select(run, "auto", delay={"v": 0.1})
    with pytest.raises(ftlm.ModelError, match="delay= is used with 'auto'; give the delays"):
        ftlm.select(run, ftlm.equation("D y = a y + b u"), delay={"u": 0.1})


def two_outputs(late: int) -> ftlm.Run:
    """A resonance beside a lag that may come late, of one input."""
    (swing, _), (lag, _) = (
        record([40.0], [1.0, 3.0, 40.0], seed=1, hold=20),
        record([7.0], [1.0, 4.0], seed=1, hold=20, late=late),
    )
    return ftlm.Run.from_arrays(step=0.02, inputs={"u": lag["u"]}, outputs={"y": swing["y"], "z": lag["y"]})


def test_each_output_has_its_own_structure() -> None:
    found = ftlm.select(two_outputs(0), "auto", threads=1)
    first, second = found.winner.structure.equations
    assert str(first) == "D^2 y = a1_y D^1 y + a0_y y + b0_y u"
    assert str(second) == "D^1 z = a0_z z + b0_z u"
    assert found.best.model.coefficients["a0_y"] == pytest.approx(-40, rel=0.02)
    assert found.best.model.coefficients["a0_z"] == pytest.approx(-4, rel=0.02)
    assert set(found.fit) == {"y", "z"}
    assert {o for t in found.trials for o in t.structure.outputs} == {"y", "z"}
    assert "Schwarz" in str(found)


def test_outputs_with_different_delays_have_no_free_delay_in_one_structure() -> None:
    found = ftlm.select(two_outputs(6), "auto", threads=1)
    assert not found.winner.structure.free_input_parameters
    assert "The outputs do not have the same delay" in found.reason
    # A higher order takes the place of the delay.
    assert found.fit["z"] > 95


def test_identify_and_select_find_the_same_model_by_auto(tmp_path: Path) -> None:
    run, _ = record([7.0], [1.0, 4.0], seed=1, hold=20, late=6)
    run.to_csv(tmp_path / "motor.csv")
    auto = ["-u", "u", "--structure", "auto", "--delay", "u=0.12", "--threads", "1", "-y", "y"]
    words = [str(tmp_path / "motor.csv"), *auto]
    chosen, fitted, instrumental = (
        CliRunner().invoke(app, [name, *words, *more, "-o", str(tmp_path / f"{number}.json")])
        for number, (name, *more) in enumerate(
            [("select",), ("identify",), ("identify", "--method", "instrumental-variables")]
        )
    )
    assert [chosen.exit_code, fitted.exit_code, instrumental.exit_code] == [0, 0, 0], fitted.output
    assert "Chosen: D^1 y = a0 y + b0 u" in fitted.output
    first, second, third = (ftlm.load_model(tmp_path / f"{k}.json") for k in range(3))
    assert first.coefficients == second.coefficients
    assert third.coefficients["a0"] == pytest.approx(first.coefficients["a0"], rel=0.02)
    run.with_outputs({"z": 2 * run["y"]}).to_csv(tmp_path / "two.csv")
    two = [str(tmp_path / "two.csv"), *auto, "-y", "z"]
    both = CliRunner().invoke(app, ["identify", *two])
    assert both.exit_code == 0, both.output
    assert "Chosen: D^1 y = a0_y y + b0_y u" in both.output
    one = CliRunner().invoke(app, ["identify", *two, "--only", "y"])
    assert one.exit_code == 0, one.output
    assert one.output.splitlines()[0] == fitted.output.splitlines()[0]
    wrong = CliRunner().invoke(app, ["identify", *words, "--orders", "alpha=1"])
    assert wrong.exit_code == 2
    assert "--orders: options of a given structure, not used with --structure auto" in wrong.output


def test_the_command_line_says_which_signals_drive_an_output(tmp_path: Path) -> None:
    """Of two lags in series, the second one is driven by the first."""
    chain = ftlm.equation("D y = -3 y + 3 u; D z = -1 z + 2 y")
    g, rows = np.random.default_rng(4), 300
    u = np.repeat(g.choice([-1.0, 1.0], size=rows // 20), 20)
    drive = ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": np.zeros(rows), "z": np.zeros(rows)})
    run = ftlm.Model(replace(chain, coupling="simulated")).simulate(drive)
    run = run.with_outputs({n: run[n] + 0.01 * np.std(run[n]) * g.normal(size=rows) for n in ("y", "z")})
    run.to_csv(tmp_path / "chain.csv")
    words = [str(tmp_path / "chain.csv"), "-u", "u", "-y", "y", "-y", "z", "--delay", "u=0", "--threads", "1"]
    for command in ("identify", "select"):
        found = CliRunner().invoke(app, [command, *words, "--structure", "auto", "--driven-by", "z=y"])
        assert found.exit_code == 0, found.output
        assert "D^1 z = a0_z z + b0_z y" in found.output, found.output
        wrong = CliRunner().invoke(app, [command, *words, "--structure", "auto", "--driven-by", "z=v,u"])
        assert wrong.exit_code == 2
        assert "--driven-by: 'v' cannot be an input of z" in wrong.output
        idle = CliRunner().invoke(app, [command, *words, "--structure", "D y = a y + b u", "--driven-by", "z=y"])
        assert idle.exit_code == 2
        assert "--driven-by is used with" in idle.output


def controlled_record(seed: int, rows: int, time_constant: float, gain: float) -> ftlm.Run:
    """Return a lag under a PI controller that reads its noisy output in the same row, with steps of the setpoint."""
    g = np.random.default_rng(seed)
    step, pole = time_constant / 20, np.exp(-1 / 20)
    setpoint = 5 + np.repeat(g.uniform(-1, 1, rows), 100)[:rows]
    x, integral, inputs, outputs = 0.0, 0.0, [], []
    for r in setpoint:
        outputs.append(x + 0.01 * g.standard_normal())
        integral += (r - outputs[-1]) * step
        inputs.append((r - outputs[-1] + integral / time_constant) / gain)
        x = pole * x + gain * (1 - pole) * inputs[-1]
    return ftlm.Run.from_arrays(step=step, inputs={"u": inputs}, outputs={"y": outputs})


@slow_after(1, "seed", range(4))
def test_the_answer_of_a_controller_within_a_row_is_not_taken_for_feedthrough(seed: int) -> None:
    found = ftlm.select(controlled_record(seed, 600, 2.0, 3.0), "auto", threads=1)
    assert found.winner.name == "D^1 y = a0 y + b0 u"
    values = found.best.parameters
    for name, true in (("a0", -0.5), ("b0", 1.5)):
        assert abs(values[name].value - true) < 3 * values[name].standard_error


@slow_after(1, "seed", range(2))
def test_feedthrough_is_found_where_the_input_is_as_rough_as_that_of_a_controller(seed: int) -> None:
    # A battery under a rough current: its resistance answers within the row.
    g = np.random.default_rng(seed)
    current = lfilter([1.0], [1.0, -0.5], g.standard_normal(800))
    pole = np.exp(-0.05)
    voltage = 0.5 * current + lfilter([0, 2 * (1 - pole)], [1, -pole], current)
    noisy = voltage + 0.02 * voltage.std() * g.standard_normal(800)
    run = ftlm.Run.from_arrays(step=0.1, inputs={"current": current}, outputs={"voltage": noisy})
    found = ftlm.select(run, "auto", threads=1)
    assert found.winner.name == "D^1 voltage = a0 voltage + b1 D^1 current + b0 current"
    assert found.best.parameters["b1"].value == pytest.approx(0.5, rel=0.02)


@slow_after(1, "seed", range(3))
def test_a_sensor_that_drifts_changes_neither_order_nor_gain(seed: int) -> None:
    g = np.random.default_rng(seed)
    u = np.repeat(g.uniform(-1, 1, 20), 30)
    pole = np.exp(-0.05)
    y = lfilter([0, 3 * (1 - pole)], [1, -pole], u)
    noisy = y + 0.3 * y.std() * np.linspace(0, 1, 600) + 0.02 * y.std() * g.standard_normal(600)
    found = ftlm.select(ftlm.Run.from_arrays(step=0.1, inputs={"u": u}, outputs={"y": noisy}), "auto", threads=1)
    assert (found.winner.structure.offset, [*found.best.parameters]) == (
        "ramp",
        ["a0", "b0", "constant_y", "ramp_y"],
    )
    for name, true in (("a0", -0.5), ("b0", 1.5)):
        assert abs(found.best.parameters[name].value - true) < 3 * found.best.parameters[name].standard_error


@slow_after(1, "seed", range(4))
def test_free_decay_without_an_input(seed):
    g = np.random.default_rng(seed)
    rate, damping = g.uniform(0.5, 3.0), g.uniform(0.02, 0.1)
    time = np.arange(400) * 0.1 / rate
    decay = np.exp(-damping * rate * time) * np.cos(rate * math.sqrt(1 - damping**2) * time + 0.4)
    run = ftlm.Run.from_arrays(step=time[1], inputs={}, outputs={"y": decay + 0.01 * g.standard_normal(400)})
    found = ftlm.select(run, "auto")
    (equation,) = found.model.structure.equations
    assert equation.order.constant == 2
    (mode,) = found.model.modes()
    assert abs(mode.frequency / rate - 1) < 0.003
    assert abs(mode.damping / damping - 1) < 0.1
    assert "excitation_short" not in {f.code for f in found.best.findings}


def rubbing_mass(
    seed: int, spring: float, friction: float, *, late: int = 0, speed: bool = False, rows: int = 250, steps: int = 20
) -> ftlm.Run:
    """Position or speed of a mass with drag and Coulomb friction that sticks, by Euler steps; noise of 2 %."""
    g = np.random.default_rng(seed)
    u = np.repeat(g.uniform(-1, 1, rows), g.integers(4, 60, rows))[:rows]
    step, v, x, y = 0.1, 0.0, 0.0, np.zeros(rows)
    h = step / steps
    for k in range(rows - 1):
        for _ in range(steps):
            force = (u[k - late] if k >= late else 0.0) - 0.8 * v - spring * x
            moving = v != 0.0
            rub = friction * np.sign(v) if moving else np.clip(force, -friction, friction)
            later = v + h * (force - rub)
            v = 0.0 if moving and later * v < 0.0 else later
            x += h * v
        y[k + 1] = v if speed else x
    return ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": y + 0.02 * y.std() * g.standard_normal(rows)})


@pytest.mark.parametrize(
    ("spring", "own"),
    [
        pytest.param(1.0, {"a0": -1.0, "a1": -0.8}, marks=pytest.mark.slow),
        (0.0, {"a1": -0.8}),
    ],
)
def test_auto_finds_dry_friction_rather_than_higher_orders(spring: float, own: dict[str, float]) -> None:
    run = rubbing_mass(1, spring, 0.25)
    found = ftlm.select(run, "auto", threads=1).best
    (item,) = found.model.structure.equations
    assert item.friction.name == "fc"
    assert item.order.constant == 2.0
    assert found.coefficients["fc"] == pytest.approx(0.25, rel=0.1)
    values = {n: v for n, v in found.coefficients.items() if n.startswith("a")}
    assert values == pytest.approx(own, rel=0.1)


def test_auto_finds_dry_friction_behind_a_dead_time() -> None:
    run = rubbing_mass(2, 0.0, 0.25, late=6, speed=True)
    found = ftlm.select(run, "auto", threads=1).best
    values = {n: found.parameters[n].value for n in ("a0", "b0", "fc", "delay_u")}
    assert values == pytest.approx({"a0": -0.8, "b0": 1.0, "fc": 0.25, "delay_u": 0.6}, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("rows", [1200, 3000])
def test_friction_is_found_beside_a_delay_that_further_poles_replace(rows):
    # Without friction, four poles and three zeros fit better than a delay of 7.4 samples. The encoder is coarse.
    t = np.arange(rows) * 0.005
    tones = zip((0.23, 0.61, 1.3, 2.7), (0.1, 2.0, 4.0, 1.0), strict=True)
    u = 2.0 * sum(np.sin(2 * np.pi * f * t + phase) for f, phase in tones) + 4.0 * np.sign(np.sin(2 * np.pi * t / 3.1))
    u[t < 0.5] = 0.0
    _, speed = friction.delayed_motor(u, 0.005, 0.037, 25 / 3, 9.5 * 25 / 3, 50.0)
    speed = np.round((speed + 0.1 * np.random.default_rng(1).standard_normal(t.size)) / 0.25) * 0.25
    run = ftlm.Run.from_arrays(step=0.005, inputs={"u": u}, outputs={"w": speed})
    best = ftlm.select(run, "auto", threads=1).best
    (item,) = best.model.structure.equations
    assert item.order.constant == 1.0
    assert any("tanh" in str(term) for term in item.terms)
    assert best.delays["u"] == pytest.approx(0.037, abs=5e-4)


@slow_after(1, "seed", range(3))
def test_blocks_in_which_the_output_rests_are_fitted_too(seed):
    """Most blocks of a single step hold noise alone, of which no model explains a part."""
    g = np.random.default_rng(seed)
    u = np.where(np.arange(300) < 30, 0.0, 1.0)
    y = lfilter([0.0, 0.04], [1.0, -0.98], u)
    e = lfilter([1.0], [1.0, -0.8], g.standard_normal(300))
    run = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": y + 0.03 * y.std() / e.std() * e})
    found = ftlm.select(run, "auto")
    assert {"no_candidate_fits", "worse_than_mean"}.isdisjoint(f.code for f in found.findings)
    assert found.winner.validation_fit > 80


@pytest.mark.parametrize("seed", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_the_fit_of_a_candidate_is_that_of_its_optimum(seed):
    """An integrator with a lag that rests at a level in colored noise: offsets of comparisons are those of the fits."""
    g = np.random.default_rng(seed)
    u = np.where(np.arange(300) < 20, 0.0, 1.0)
    b, a, _ = cont2discrete(([2.0], [0.3, 1.0, 0.0]), 0.02)[:3]
    y = lfilter(b.ravel(), a, u)
    e = lfilter([1.0], [1.0, -0.8], g.standard_normal(300))
    run = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": y - 0.2 + 0.03 * y.std() / e.std() * e})
    found = ftlm.select(run, "auto")
    at_rest = [t for t in found.trials if t.joint and t.joint.initial == "rest"]
    fits = [(t.estimation["y"], 100.0 * (1.0 - t.joint.noise["y"] / run["y"].std())) for t in at_rest]
    assert len(fits) >= 3
    for estimation, expected in fits:
        assert estimation == pytest.approx(expected, abs=0.2)


def test_the_report_of_an_automatic_structure_has_the_choice(tmp_path):
    for seed, name in ((1, "one"), (2, "two")):
        run, _ = record([12.0, 40.0], [1.0, 3.0, 40.0], seed=seed, hold=20)
        table = np.column_stack([run.time, run["u"], run["y"]])
        np.savetxt(tmp_path / f"{name}.csv", table, delimiter=",", header="t,u,y", comments="")
    words = ["identify", str(tmp_path / "one.csv"), "-u", "u", "-y", "y", "--structure", "auto"]
    page_file = str(tmp_path / "page.html")
    done = CliRunner().invoke(app, [*words, "--validation", str(tmp_path / "two.csv"), "--report", page_file, "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)["selection"]
    page = (tmp_path / "page.html").read_text("utf-8")
    heads = ["Equations</h2>", "Warnings</h2>", "The choice</h2>", "Residuals</h2>"]
    places = [page.index(head) for head in heads]
    assert places == sorted(places)
    part = page[places[2] : places[3]]
    assert typeset(found["reason"]) in part
    assert f"{found['fitted_count']} candidates fitted." in part
    assert f"chosen: {typeset(found['chosen'])}</th>" in part
    for candidate in found["candidates"]:
        row = part[part.index(f"{typeset(candidate['structure'])}") :]
        assert candidate["failure"] or f'<data value="{candidate["parameter_count"]}.0">' in row
    assert "Fit by number of parameters" in part
    assert all(typeset(text) in page for text in found["warnings"])


def test_an_integrator_that_is_set_to_zero_in_motion_is_found() -> None:
    g, step, rows = np.random.default_rng(1), 0.008, 700
    b, a, _ = cont2discrete(([3.0], [6.0, 1.0, 0.0]), 1.0)[:3]
    u = np.repeat(g.uniform(-6.0, 6.0, 70), 12)[: rows + 100]
    y = lfilter(np.ravel(b), a, u)[100:]
    y += 0.01 * np.std(y) * g.standard_normal(rows)
    run = ftlm.Run.from_arrays(step=step, inputs={"u": u[100:]}, outputs={"y": y - y[0]})
    found = ftlm.select(run, "auto", threads=1)
    assert "a0" not in found.best.parameters
    assert found.best.parameters["b0"].value == pytest.approx(0.5 / step**2, rel=0.02)
    assert found.best.parameters["a1"].value == pytest.approx(-1 / (6 * step), rel=0.02)
