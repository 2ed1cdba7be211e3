"""Optimal input design: predicted standard errors against SciPy, naive loops, and fits of simulated runs."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs
from scipy.optimize import minimize
from scipy.signal import cont2discrete, dlsim
from typer.testing import CliRunner

import ftlm
import oracles
import plants
from ftlm.cli.main import app
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.output_error import fit_output_error, parameter_set, parameter_set_of
from ftlm.experiment_design.design_input import multisine, square_wave
from ftlm.experiment_design.exchange import exchange_holds, scaled_design
from ftlm.experiment_design.problem import Bounds, Criterion, ModelFit, Sensitivities
from ftlm.experiment_design.spectrum import SpectralLines, best_spectrum, spectral_lines
from ftlm.model.model import FitParameters
from ftlm.reproduction.simulated_arm import demo_plant

STEP, NOISE, ROWS = 0.05, 0.01, 201


def first_run(words: str, seed: int = 0, rows: int = ROWS, noise: float = NOISE, peak: float = 1.0) -> ftlm.Run:
    """A run of a plant in words with inputs that switch at random."""
    truth = ftlm.Model(replace(ftlm.equation(words), initial="rest"))
    rng = np.random.default_rng([7, seed])
    driving = [s for s in truth.structure.signals if s not in truth.outputs]
    inputs = {s: peak * np.repeat(rng.choice([-1.0, 1.0], rows // 8 + 1), 8)[:rows] for s in driving}
    blank = ftlm.Run.from_arrays(step=STEP, inputs=inputs, outputs={o: np.zeros(rows) for o in truth.outputs})
    clean = truth.simulate(blank)
    outputs = {o: clean[o] + noise * rng.standard_normal(rows) for o in truth.outputs}
    return ftlm.Run.from_arrays(step=STEP, inputs=inputs, outputs=outputs, name="first")


def fitted(words: str, free: str, start: dict[str, float], **options: object) -> ftlm.Model:
    """A model of that plant from a fit of its free structure in words that begins at the truth."""
    structure = replace(ftlm.equation(free), initial="rest", **options)
    joint = fit_output_error([first_run(words)], structure, start=start, refine=False)
    values = dict(zip(joint.names, joint.values.tolist(), strict=True))
    solved = (
        structure.with_orders(joint.orders).with_coefficients(joint.coefficients).with_input_parameters(joint.inputs)
    )
    estimate = ftlm.Estimate(
        "output-error",
        ("first",),
        values,
        free_parameters=structs.replace(parameter_set(joint, structure), refinement=8),
    )
    return ftlm.Model(solved, joint.orders, estimate=estimate)


PLANT, FREE = "D^1.6 y = -0.8 D^0.6 y - 4 y + 3 u", "D^alpha y = a1 D^0.6 y + a0 y + b0 u"
TRUTH = {"alpha": 1.6, "a1": -0.8, "a0": -4.0, "b0": 3.0}


@pytest.fixture(scope="module")
def found() -> ftlm.Identification:
    structure = replace(ftlm.equation(FREE), initial="rest")
    return ftlm.identify(
        first_run(PLANT), structure, threads=1, method=ftlm.OutputError(intervals="quadratic", start=TRUTH)
    )


@pytest.fixture(scope="module")
def designed(found: ftlm.Identification) -> ftlm.DesignedInput:
    return ftlm.design_input(found, duration=5.0, limits={"y": 0.9})


# ---------------------------------------------------------------------------------------------- what is predicted


def by_differences(answer, made: ftlm.DesignedInput, delta: float) -> np.ndarray:
    """Standard errors from central differences of a simulation over its noise; its ends are not compared."""
    rows = []
    for name, value in made.values.items():
        above, below = (answer({**made.values, name: value + d}, made.run["u"]) for d in (delta, -delta))
        rows.append((above - below)[1:-1] / (2 * delta) / NOISE)
    jacobian = np.array(rows)
    return np.sqrt(np.diag(np.linalg.inv(jacobian @ jacobian.T)))


def test_of_whole_orders_it_is_what_scipy_differenced_says() -> None:
    start = {"a1": -0.8, "a0": -4.0, "b0": 3.0}
    known = fitted("D^2 y = -0.8 D y - 4 y + 3 u", "D^2 y = a1 D y + a0 y + b0 u", start)
    made = ftlm.design_input(known, duration=4.0, step=STEP, peak=1.0, noise={"y": NOISE}, parameters=["a1", "a0"])

    def answer(v: dict[str, float], u: np.ndarray) -> np.ndarray:
        system = np.array([[0.0, 1.0], [v["a0"], v["a1"]]]), np.array([[0.0], [v["b0"]]])
        discrete = cont2discrete((*system, np.array([[1.0, 0.0]]), np.zeros((1, 1))), STEP, "zoh")
        return np.asarray(dlsim(discrete, u[:, None])[1][:, 0])

    errors = by_differences(answer, made, 1e-4)
    assert [made.standard_errors["designed"][n] for n in made.values] == pytest.approx(errors, rel=2e-3)


def test_of_fractional_orders_it_is_what_the_laplace_transform_differenced_says(found: ftlm.Identification) -> None:
    made = ftlm.design_input(found.model, duration=4.0, step=STEP, peak=1.0, noise={"y": NOISE}, parameters=["alpha"])

    def answer(v: dict[str, float], u: np.ndarray) -> np.ndarray:
        def transfer(s: np.ndarray) -> np.ndarray:
            return v["b0"] / (s ** v["alpha"] - v["a1"] * s**0.6 - v["a0"])

        return oracles.held_response(transfer, u, STEP, aliases=200)

    errors = by_differences(answer, made, 1e-4)
    assert [made.standard_errors["designed"][n] for n in made.values] == pytest.approx(errors, rel=5e-3)


COUPLED = (
    "D^1.6 y = -1.5 D^0.6 y - 4 y + 1 z + 3 u; D^1.2 z = -2 z + 1 y + 1 u",
    "D^alpha y = a1 D^0.6 y + a0 y + c z + b0 u; D^beta z = d z + e y + f u",
    {"alpha": 1.6, "beta": 1.2, "a1": -1.5, "a0": -4.0, "c": 1.0, "b0": 3.0, "d": -2.0, "e": 1.0, "f": 1.0},
)
STRUCTURES = {
    "one": (PLANT, FREE, TRUTH, {}),
    "offset": (PLANT, FREE, TRUTH, {"offset": "constant"}),
    "ramp": (PLANT, FREE, TRUTH, {"offset": "ramp"}),
    "late": (PLANT, FREE, TRUTH, {"delay": {"u": 0.07}}),
    "delay": (PLANT, FREE, TRUTH | {"delay_u": 0.01}, {"free_delays": {"u": (0.0, 0.3)}}),
    "inputs": (
        "D^1.6 y = -0.8 D^0.6 y - 4 y + 3 u + 2 v",
        "D^alpha y = a1 D^0.6 y + a0 y + b0 u + b1 v",
        TRUTH | {"b1": 2.0},
        {},
    ),
    "two": (*COUPLED, {"coupling": "simulated"}),
    "measured": (*COUPLED, {"coupling": "measured"}),
}


@pytest.fixture(scope="module", params=STRUCTURES)
def laid(request: pytest.FixtureRequest) -> ModelFit:
    words, free, start, options = STRUCTURES[request.param]
    model = fitted(words, free, start, **options)
    return ModelFit.of(model, parameter_set_of(model).noise)


def test_any_input_follows_from_what_one_sample_does(laid: ModelFit) -> None:
    rows, rng = 120, np.random.default_rng(3)
    for ramp in (1, 3):
        known = Sensitivities.of(laid, STEP, rows, ramp)
        commands = rng.standard_normal((len(laid.inputs), rows))
        run = laid.run(known.rig_commands(commands), STEP, "any")
        for name, row in zip(laid.outputs, known.outputs(commands), strict=True):
            assert row == pytest.approx(run[name][:-1], abs=1e-5 * np.max(np.abs(run[name])))
        expected_information = known.information(known.derivatives(commands))
        # The core compares neither the first sample nor the last, and projects offsets out by itself.
        exact = laid.jacobian(run)
        exact = exact @ exact.T
        size = np.sqrt(np.diag(exact))
        assert expected_information / np.outer(size, size) == pytest.approx(exact / np.outer(size, size), abs=2e-4)


def test_lines_are_what_a_period_says_that_was_there_long_before(laid: ModelFit) -> None:
    rows, periods = 64, 12
    bounds = Bounds(
        dict.fromkeys(laid.inputs, 0.7), dict.fromkeys(laid.inputs, math.inf), dict.fromkeys(laid.outputs, 1.0)
    )
    lines = spectral_lines(laid, bounds, STEP, rows)
    count = len(laid.inputs)
    for k in range(count):
        at = int(np.flatnonzero(lines.costs[k] > 0)[2])
        wave = np.zeros((count, rows * periods))
        t = np.arange(rows * periods) * STEP
        wave[k] = 0.7 * np.sqrt(2) * np.sin(2 * np.pi * lines.frequencies[at] * t)
        known = Sensitivities.of(laid, STEP, rows * periods, 1)
        last = known.derivatives(wave)[..., -rows:].reshape(len(laid.names), -1)
        expected_information = last @ last.T
        size = np.sqrt(np.maximum(np.diag(expected_information), 1e-12 * np.max(np.diag(expected_information))))
        close = pytest.approx(expected_information / np.outer(size, size), abs=0.03)
        assert lines.information[at] / np.outer(size, size) == close
        swings = known.outputs(wave)[:, -rows:]
        assert lines.costs[count:, at] == pytest.approx(np.mean(swings**2, axis=1), rel=0.03, abs=1e-4)


def test_the_errors_now_are_those_of_the_model_and_both_is_less_than_either(
    found: ftlm.Identification, designed: ftlm.DesignedInput
) -> None:
    for name in designed.values:
        assert designed.standard_errors["now"][name] == pytest.approx(found.standard_errors[name], rel=1e-9)
        assert designed.standard_errors["both"][name] < min(
            designed.standard_errors["now"][name], designed.standard_errors["designed"][name]
        )
    assert designed.parameters == ("alpha",)
    ratio = designed.standard_errors["square"]["alpha"] / designed.standard_errors["designed"]["alpha"]
    assert designed.gain == pytest.approx(ratio, rel=1e-9)
    assert designed.gain > 1.5
    low, high = designed.intervals["alpha"]
    assert (high - low) == pytest.approx(2 * 1.959964 * designed.standard_errors["designed"]["alpha"], rel=1e-6)


def test_fits_of_the_designed_run_scatter_as_foretold(designed: ftlm.DesignedInput) -> None:
    truth = ftlm.Model(replace(ftlm.equation(PLANT), initial="rest"))
    clean = truth.simulate(designed.run)
    structure = replace(ftlm.equation(FREE), initial="rest")
    true = {"alpha": 1.6, "a1": -0.8, "a0": -4.0, "b0": 3.0}
    off, expected_information = [], []
    for seed in range(12):
        noisy = clean["y"] + NOISE * np.random.default_rng([11, seed]).standard_normal(clean.length)
        run = ftlm.Run.from_arrays(step=STEP, inputs={"u": clean["u"]}, outputs={"y": noisy}, name="second")
        fit = fit_output_error([run], structure, start=true)
        off.append([fit.values[fit.names.index(n)] - true[n] for n in true])
        expected_information.append([fit.standard_errors[n] for n in true])
    foretold = np.array([designed.standard_errors["designed"][n] for n in true])
    # One model's noise is known to 5 % of so few samples.
    assert np.sqrt(np.mean(np.array(expected_information) ** 2, axis=0)) == pytest.approx(foretold, rel=0.2)
    assert 0.7 < float(np.sqrt(np.mean((np.array(off) / foretold) ** 2))) < 1.3


# ------------------------------------------------------------------------------------------------- the best spectrum


def regression(power: int, points: np.ndarray) -> SpectralLines:
    """A polynomial seen at points: designs of it are in every book."""
    rows = np.stack([points**k for k in range(power + 1)], axis=1)
    return SpectralLines(
        np.arange(1.0, len(points) + 1), rows[:, :, None] * rows[:, None, :], np.ones((1, len(points)))
    )


def test_a_parabola_is_seen_best_at_its_ends_and_its_middle() -> None:
    lines = regression(2, np.linspace(-1, 1, 21))
    best = best_spectrum(lines, Criterion("D", (0, 1, 2), (1.0,) * 3))
    # Points beside the middle see nearly what it sees.
    assert [best.power[0], np.sum(best.power[8:13]), best.power[20]] == pytest.approx([1 / 3] * 3, abs=2e-3)
    assert np.sum(best.power) == pytest.approx(1.0, abs=1e-9)
    assert best.gap < 2e-3


@pytest.mark.parametrize("kind", ["D", "E"])
def test_no_share_of_power_says_more_than_the_bound_and_scipy_finds_no_better(kind: str) -> None:
    rng = np.random.default_rng(5)
    rows = rng.standard_normal((9, 2, 3))
    lines = SpectralLines(
        np.arange(1.0, 10.0), np.einsum("krp,krq->kpq", rows, rows), np.abs(rng.standard_normal((3, 9))) + 0.2
    )
    goal = Criterion(kind, (0, 2), (1.0, 2.0))
    best = best_spectrum(lines, goal)
    assert np.all(lines.costs @ best.power <= 1 + 1e-9)
    for _ in range(300):
        drawn = rng.exponential(size=9) ** 3
        drawn /= np.max(lines.costs @ drawn)
        assert goal.score(np.tensordot(drawn, lines.information, 1)) <= best.bound + 1e-12
    other = minimize(
        lambda w: -goal.smooth_score(np.tensordot(np.maximum(w, 1e-12), lines.information, 1)),
        np.full(9, 0.05),
        bounds=[(0, None)] * 9,
        constraints=[{"type": "ineq", "fun": lambda w: 1 - lines.costs @ w}],
        method="SLSQP",
        options={"maxiter": 500, "ftol": 1e-12},
    )
    assert -other.fun <= best.bound + 1e-6
    # Of the widest axis the mean that has a derivative is within 2^(1/32) of it.
    assert best.score == pytest.approx(-other.fun, abs=5e-3 if kind == "D" else 0.03)


@pytest.mark.parametrize("kind", ["D", "E"])
def test_slopes_are_those_of_differences_and_one_along_the_information(kind: str) -> None:
    rng = np.random.default_rng(8)
    rows, more = rng.standard_normal((2, 30, 4))
    information, step = rows.T @ rows, more.T @ more
    goal = Criterion(kind, (1, 3), (1.0, 0.1))
    slope = goal.gradient(information)
    assert np.sum(slope * information) == pytest.approx(1.0, rel=1e-9)
    moved = (goal.smooth_score(information + 1e-6 * step) - goal.smooth_score(information - 1e-6 * step)) / 1e-6
    assert np.sum(slope * step) == pytest.approx(moved, rel=1e-5)
    naive = np.linalg.inv(information)[np.ix_([1, 3], [1, 3])] / np.outer([1, 0.1], [1, 0.1])
    score = -0.25 * np.log(np.linalg.det(naive)) if kind == "D" else -0.5 * np.log(np.linalg.eigvalsh(naive)[-1])
    assert goal.score(information) == pytest.approx(score, rel=1e-9)
    assert goal.score(np.zeros((4, 4))) == -np.inf


def test_a_sum_of_sines_keeps_its_spectrum_and_has_a_low_crest(found: ftlm.Identification) -> None:
    laid = ModelFit.of(found.model, parameter_set_of(found.model).noise)
    lines = spectral_lines(laid, Bounds({"u": 1.0}, {"u": math.inf}, {"y": math.inf}), STEP, 200)
    spectrum = replace(
        best_spectrum(lines, Criterion("D", (0,), (1.0,))), power=np.where(lines.frequencies < 3, 1.0, 0.0)
    )
    wave = multisine(spectrum, 1, 200, STEP, np.random.default_rng(0))[0]
    assert np.max(np.abs(wave)) == pytest.approx(1.0)
    sizes = np.abs(np.fft.rfft(wave))
    own = np.round(lines.frequencies[lines.frequencies < 3] * 200 * STEP).astype(int)
    assert np.ptp(sizes[own]) < 1e-9 * np.max(sizes)
    assert np.sum(sizes) == pytest.approx(np.sum(sizes[own]))
    assert 1.0 / np.sqrt(np.mean(wave**2)) < 1.75


# ----------------------------------------------------------------------------------------------------- the exchange


@pytest.mark.parametrize("name", ["one", "offset", "inputs"])
def test_no_exchange_of_one_hold_or_of_two_tells_more(name: str) -> None:
    words, free, start, options = STRUCTURES[name]
    model = fitted(words, free, start, **options)
    laid = ModelFit.of(model, parameter_set_of(model).noise)
    rows, hold = 90, 6
    known = Sensitivities.of(laid, STEP, rows, 1)
    bounds = Bounds(dict.fromkeys(laid.inputs, 0.8), dict.fromkeys(laid.inputs, math.inf), {"y": 0.5})
    goal = Criterion("D", (0, 1), (1.0, 1.0))
    begin = scaled_design("square", 0.8 * np.stack([square_wave(rows, 24)] * len(laid.inputs)), known, goal, bounds)
    best = exchange_holds(begin, hold, known, goal, bounds)
    assert best.score > begin.score

    def naive(commands: np.ndarray) -> float:
        """What commands say, written out: from the core, made small enough for the limits."""
        run = laid.run(known.rig_commands(commands), STEP, "naive")
        scale = min(1.0, 0.5 / float(np.max(np.abs(run["y"]))))
        rows_of = laid.jacobian(run)
        block = np.linalg.inv(rows_of @ rows_of.T)[:2, :2]
        return float(-0.25 * np.log(np.linalg.det(block)) + math.log(scale))

    assert best.score == pytest.approx(naive(best.commands), abs=1e-4)
    # The scale that keeps the limit is taken out: levels are those of the peak.
    level = np.round(best.commands / np.max(np.abs(best.commands)), 6)[:, ::hold]
    assert set(np.unique(level)) <= {-1.0, 0.0, 1.0}
    changes = [
        [(k, at, d)] for k in range(len(laid.inputs)) for at in range(level.shape[1]) for d in (-2, -1, 1, 2)
    ] + [
        [(k, at, d), (k, at + gap, -d)]
        for k in range(len(laid.inputs))
        for gap in (1, 4)
        for at in range(level.shape[1] - gap)
        for d in (-1, 2)
    ]
    top = naive(0.8 * np.repeat(level, hold, axis=1))
    for change in changes[:: max(1, len(changes) // 60)]:
        other = level.copy()
        for k, at, d in change:
            other[k, at] += d
        if np.max(np.abs(other)) <= 1:
            assert naive(0.8 * np.repeat(other, hold, axis=1)) <= top + 1e-4


# -------------------------------------------------------------------------------------------------------- limits


def test_peak_swing_and_slew_are_kept_and_said(found: ftlm.Identification, designed: ftlm.DesignedInput) -> None:
    assert np.max(np.abs(designed.run["u"])) <= 1.0
    assert np.max(np.abs(designed.run["y"])) <= 0.9
    assert "y" in designed.active_constraints or "u" in designed.active_constraints
    assert set(np.round(np.unique(designed.run["u"][:-1] / np.max(np.abs(designed.run["u"]))), 9)) <= {-1.0, 0.0, 1.0}
    slow = ftlm.design_input(found, duration=5.0, limits={"y": 0.9}, slew=8.0)
    change = np.abs(np.diff(slow.run["u"][:-1], prepend=0.0)) / STEP
    assert np.max(change) <= 8.0 * (1 + 1e-9)
    assert {r.name for r in slow.predicted_extremes} == {"u", "slew of u", "y"}
    assert slow.gain < designed.gain * 1.05


def test_the_widest_axis_is_shorter_by_its_own_criterion(found: ftlm.Identification) -> None:
    options = {"parameters": ["alpha", "a1"], "limits": {"y": 0.9}, "duration": 4.0}
    both = {c: ftlm.design_input(found, criterion=c, **options) for c in ("D", "E")}
    laid = ModelFit.of(found.model, parameter_set_of(found.model).noise)
    widest, all_of_it = Criterion("E", (0, 1), (1.0, abs(laid.values[1]))), Criterion("D", (0, 1), (1.0, 1.0))
    expected_information = {}
    for kind, made in both.items():
        rows = laid.jacobian(made.run)
        expected_information[kind] = rows @ rows.T
    assert widest.score(expected_information["E"]) > widest.score(expected_information["D"]) - 0.02
    assert all_of_it.score(expected_information["D"]) > all_of_it.score(expected_information["E"]) - 0.02


def test_the_same_is_designed_from_a_result_and_from_its_file(
    found: ftlm.Identification, designed: ftlm.DesignedInput, tmp_path: Path
) -> None:
    found.model.save(tmp_path / "m.json")
    read = ftlm.load_model(tmp_path / "m.json")
    # The file knows the step of the run that the model came from.
    again = ftlm.design_input(read, duration=5.0, peak=1.0, limits={"y": 0.9})
    assert again.step == STEP
    assert np.array_equal(again.run["u"], designed.run["u"])
    assert again.standard_errors == designed.standard_errors
    read.save(tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "m.json").read_bytes()


def test_laws_of_orders_and_coefficients_come_back_from_a_file(tmp_path: Path) -> None:
    structure, clean, values = plants.structure("A"), plants.clean_run("A"), plants.truth("A")
    problem, model = FreeProblem.of(structure), demo_plant(1, form="published")
    orders = [str(o) for e in structure.equations for o in (e.order, *(t.order for t in e.terms))]
    noise = {o: 0.01 * float(np.std(clean[o])) for o in clean.outputs}
    free = FitParameters(
        names=tuple(problem.names),
        orders=tuple(orders),
        noise=noise,
        products=dict(problem.products),
        covariance=tuple(map(tuple, np.eye(10).tolist())),
        refinement=2,
    )
    estimate = ftlm.Estimate("output-error", ("A",), {**values, **model.coefficients}, free_parameters=free)
    named = structure.with_orders(model.orders).with_coefficients(model.coefficients)
    ftlm.Model(replace(named, initial="rest"), model.orders, estimate=estimate).save(tmp_path / "a.json")
    laid = ModelFit.of(ftlm.load_model(tmp_path / "a.json"), noise)
    errors = dict(zip(laid.names, np.sqrt(np.diag(laid.predicted_covariance(clean))).tolist(), strict=True))
    assert errors == pytest.approx(plants.CRAMER_RAO_40_DB["A"], rel=0.15)


# -------------------------------------------------------------------------------------------------- what is refused


def hopeless(tmp_path: Path, change) -> ftlm.Model:
    """The model of a file that was altered."""
    fitted(PLANT, FREE, TRUTH).save(tmp_path / "m.json", force=True)
    document = json.loads((tmp_path / "m.json").read_text())
    change(document)
    (tmp_path / "m.json").write_text(json.dumps(document))
    return ftlm.load_model(tmp_path / "m.json")


BAD = {
    "no model": ({}, 3, "model is int"),
    "peak": ({"peak": 0}, None, "peak of u = 0 is not above 0"),
    "peak of another": ({"peak": {"w": 1}}, None, "peak names 'w'.*not one of u"),
    "infinite": ({"peak": math.inf}, None, "peak of u is infinite"),
    "text": ({"peak": "loud"}, None, "peak of u = 'loud' is not a number"),
    "slew": ({"slew": 1e-3}, None, "slew of u = 0.001 per second needs"),
    "limit of an input": ({"limits": {"u": 1}}, None, "limits names 'u'.*not one of y"),
    "limit below 0": ({"limits": {"y": -1}}, None, "limits of y = -1 is not above 0"),
    "parameters": ({"parameters": ["alhpa"]}, None, r"parameters\[0\] = 'alhpa'.*did you mean 'alpha'"),
    "no names": ({"parameters": []}, None, "parameters is empty"),
    "twice": ({"parameters": ["a0", "a0"]}, None, "'a0' twice"),
    "criterion": ({"criterion": "A"}, None, "criterion = 'A' is not known"),
    "duration": ({"duration": -1.0}, None, "duration = -1 is not a length"),
    "not a number": ({"step": math.nan}, None, "step = nan is not a step"),
    "too short": ({"duration": 0.5}, None, "11 rows; give a run of 32 to 50000"),
    "too long": ({"duration": 1e12}, None, "rows; give a run of 32 to 50000"),
    "noise": ({"noise": {"y": 0}}, None, "noise of y = 0 is not above 0"),
    "tiny limit": ({"limits": {"y": 1e-320}}, None, "limits of y = .* is not between 1e-50 and 1e.50; use other units"),
    "huge peak": ({"peak": 1e308}, None, "peak of u = 1e.308 is not between"),
    "tiny slew": ({"slew": 1e-45}, None, "slew of u = 1e-45 per second needs"),
    "tiny noise": ({"noise": 1e-320}, None, "noise of y = .* is not between"),
    "criteria": ({"criterion": np.array(["D", "E"])}, None, "criterion = array"),
    "progress": ({"progress": 5}, None, "progress is an int"),
    "no list": ({"parameters": 5}, None, "parameters is an int"),
    "no name": ({"parameters": [["alpha"]]}, None, r"parameters\[0\] = \['alpha'\] is not a free parameter"),
    "long seed": ({"seed": -(10**5000)}, None, "seed = an integer of 16610 bits"),
    "seed": ({"seed": -1}, None, "seed = -1"),
    "period": ({"period": 0.01}, None, "period = 0.01 s is out of range"),
    "reference_run": ({"reference_run": 7}, None, "reference_run is int, not a Run"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_meant_is_refused_in_words(found: ftlm.Identification, name: str) -> None:
    options, model, words = BAD[name]
    with pytest.raises(ftlm.ModelError, match=words):
        ftlm.design_input(found if model is None else model, **options)


def altered(values: dict[str, float], **more: object):
    """Other numbers of the model of one file."""

    def change(document: dict) -> None:
        terms = document["equations"][0]["terms"]
        for term in terms:
            term["coefficient"] = values.get(term["name"], term["coefficient"])
        document["estimate"]["values"].update(values)
        document["estimate"]["free_parameters"].update(more)

    return change


def test_a_model_that_runs_away_or_drifts_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ftlm.ModelError, match=r"not stable.*, and inputs are designed for stable models"):
        ftlm.design_input(hopeless(tmp_path, altered({"a0": 4.0})), duration=10, step=STEP, peak=1)
    start = {"alpha": 1.5, "a1": -2.0, "b0": 3.0}
    drifts = fitted("D^1.5 y = -2 D^0.7 y + 3 u", "D^alpha y = a1 D^0.7 y + b0 u", start)
    with pytest.raises(ftlm.ModelError, match=r"integrates its input \(order 0.7\), so that y may drift.*limits="):
        ftlm.design_input(drifts, duration=10, step=STEP, peak=1)
    kept = ftlm.design_input(drifts, duration=4, step=STEP, peak=1, limits={"y": 2.0})
    assert np.max(np.abs(kept.run["y"])) <= 2.0


def test_intervals_too_wide_to_design_on_are_refused_with_what_comes_first(tmp_path: Path) -> None:
    wide = (100.0 * np.eye(4)).tolist()
    with pytest.raises(ftlm.ModelError, match=r"too wide to design on \(order alpha = 1\.6.*First record.*--band"):
        ftlm.design_input(hopeless(tmp_path, altered({}, covariance=wide)), duration=10, step=STEP, peak=1)
    loose = np.diag([1e-4, 1e-4, 25.0, 1e-4]).tolist()
    with pytest.raises(ftlm.ModelError, match=r"its uncertainty changes the response of y by \d+ %"):
        ftlm.design_input(hopeless(tmp_path, altered({}, covariance=loose)), duration=10, step=STEP, peak=1)
    with pytest.raises(ftlm.ModelError, match="infinite intervals"):
        ftlm.design_input(hopeless(tmp_path, altered({}, covariance=None)), duration=10, step=STEP, peak=1)
    with pytest.raises(ftlm.ModelError, match=r"identify (it|the model) again"):
        ftlm.design_input(hopeless(tmp_path, altered({}, orders=["alpha"])), duration=10, step=STEP, peak=1)


def test_what_is_not_linear_or_says_nothing_is_refused(found: ftlm.Identification) -> None:
    written = ftlm.Model(ftlm.equation("D y = -2 y + 1 u"))
    with pytest.raises(ftlm.ModelError, match=r"was not identified.*identify it with method='output-error'"):
        ftlm.design_input(written, duration=10, step=STEP, peak=1)
    with pytest.raises(ftlm.ModelError, match="friction, and a design of the next experiment"):
        ftlm.design_input(ftlm.Model(ftlm.equation("D^2 y = -2 y - 0.1 D y - 0.2 sign(D y) + 1 u")))
    with pytest.raises(ftlm.ModelError, match="saturation before it acts, which a design"):
        ftlm.design_input(ftlm.Model(ftlm.equation("D y = -2 y + 1 u").with_limits(saturation={"u": 0.5})))
    with pytest.raises(ftlm.ModelError, match=r"duration is not given|step is not given"):
        ftlm.design_input(found.model, peak=1)
    other = ftlm.Run.from_arrays(step=STEP, inputs={"w": np.ones(50)}, outputs={"y": np.zeros(50)})
    with pytest.raises(ftlm.DataError, match="has no input 'u'"):
        ftlm.design_input(found, reference_run=other)


# ----------------------------------------------------------------------------------------- words, files, pictures


def test_it_prints_goes_into_a_frame_and_json_and_is_drawn(designed: ftlm.DesignedInput) -> None:
    text = str(designed)
    assert "* alpha = " in text
    assert "D-optimal for alpha" in text
    assert "% of that of the best periodic input in steady state" in text
    frame = designed.to_frame()
    assert frame.loc["a0", "designed"] == designed.standard_errors["designed"]["a0"]
    document = json.loads(json.dumps(designed.to_dict(), allow_nan=False))
    assert document["parameters"] == ["alpha"]
    assert document["predicted_extremes"]["y"]["limit"] == 0.9
    figure = ftlm.plot.design(designed)
    assert [a.get_xlabel() for a in figure.axes] == ["time [s]", "time [s]", "frequency [Hz]"]
    with pytest.raises(ftlm.ModelError, match="is an int; give DesignedInput"):
        ftlm.plot.design(3)


def test_a_rig_takes_what_is_written(tmp_path: Path) -> None:
    structure = replace(ftlm.equation("D^alpha theta11 = a D theta11 + b I1"), initial="rest")
    t = 0.02 * np.arange(301)
    truth = ftlm.Model(replace(ftlm.equation("D^1.9 theta11 = -12 D theta11 + 30 I1"), initial="rest"))
    blank = ftlm.Run.from_arrays(
        step=0.02, inputs={"I1": 0.2 * np.sign(np.sin(9 * t + 1e-6))}, outputs={"theta11": 0 * t}
    )
    clean = truth.simulate(blank)
    noise = 1e-4 * np.random.default_rng(0).standard_normal(t.size)
    run = clean.with_outputs({"theta11": clean["theta11"] + noise})
    start = {"alpha": 1.9, "a": -12.0, "b": 30.0}
    known = ftlm.identify(run, structure, threads=1, method=ftlm.OutputError(intervals="quadratic", start=start))
    made = ftlm.design_input(known, duration=3.0, limits={"theta11": 0.3})
    made.save(tmp_path / "next.csv")
    recorded = ftlm.rig.record(input="csv", file=tmp_path / "next.csv", rate=50.0, duration=made.run.duration)
    assert recorded["I1"][:-1] == pytest.approx(made.run["I1"][:-1], abs=1e-3)
    with pytest.raises(ftlm.DataError, match="exists"):
        made.save(tmp_path / "next.csv")


def test_the_command_says_writes_and_refuses(found: ftlm.Identification, tmp_path: Path) -> None:
    assert found.task is not None
    model, reference_run, out, picture = (str(tmp_path / n) for n in ("m.json", "first.csv", "next.csv", "next.svg"))
    found.model.save(model)
    found.task.runs[0].to_csv(reference_run)
    words = [
        "design-input",
        model,
        "--reference-run",
        reference_run,
        "--limits",
        "y=0.9",
        "--parameters",
        "alpha",
        "--peak",
        "u=0.8",
        "--duration",
        "4",
    ]
    done = CliRunner().invoke(app, [*words, "-o", out, "--plot", picture])
    assert done.exit_code == 0, done.output
    assert "* alpha = " in done.output
    assert np.max(np.abs(ftlm.load(out)["u"])) <= 0.8
    assert Path(picture).read_text(encoding="utf-8").count("<svg") == 1
    refused = {
        ("-o", out): "exists; choose another name, or overwrite it with --force",
        ("--plot", picture + ".gif"): "write .png, .pdf or .svg",
        ("-o", str(tmp_path / "next.mat")): "does not end in .csv",
        ("--slew", "fast"): "neither a number nor INPUT=NUMBER",
        ("--slew", "1e-3"): "raise --slew or --duration",
        ("--limits", "z=1"): "limits names 'z'",
        ("--parameters", "beta"): "is not a free parameter of the model",
    }
    for more, said in refused.items():
        failed = CliRunner().invoke(app, [*words, *more])
        assert failed.exit_code in (2, 3), failed.output
        assert said in " ".join(failed.output.split()), failed.output


@pytest.mark.slow
def test_plant_a_is_told_three_times_better_than_by_the_papers_square() -> None:
    first = ftlm.identify(
        plants.noisy_run("A", 40, 0), plants.structure("A"), method=ftlm.OutputError(intervals="quadratic")
    )
    made = ftlm.design_input(first)
    assert made.gain > 10
    square = plants.noisy_run("A", 40, 0)
    for name in square.outputs:
        # As far as the square moved it from where it began, whose noise is no limit.
        assert np.max(np.abs(made.run[name])) <= np.max(np.abs(square[name] - square[name][0])) * (1 + 1e-9)
