"""Nonzero initial conditions: the past is estimated if the runs require it, and intervals cover as from rest.

Truth is exact and shares no code with the estimator: residues and the integral along the branch cut (motion.py).
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter
from typer.testing import CliRunner

import ftlm
import motion
import oracles
from ftlm import cli
from ftlm.simulation.discretization import prepare, record
from ftlm.simulation.initial_conditions import (
    history,
    huber_loss_excess,
    loss_excess_of_fits,
    resolve_initial_conditions,
)
from ftlm.simulation.output_samples import with_initial_conditions
from ftlm.structure.structure import History
from slow_cases import slow_after

pytestmark = pytest.mark.usefixtures("no_extension_tests")

WORDS = motion.PLANTS["0.7"].words


@pytest.fixture(scope="module")
def halves():
    """Both halves of one motion of D^0.7 y = -0.5 y + u, and what is identified from them."""
    runs = motion.pieces(motion.PLANTS["0.7"], 0)
    return runs, [ftlm.identify(run, ftlm.equation(WORDS), threads=1) for run in runs]


# ----------------------------------------------------------------------------------------------------------------------
# The oracle


@pytest.mark.parametrize(("name", "poles"), [("0.4", 0), ("0.7", 0), ("1.3", 1), ("1.7, 0.6", 1)])
def test_the_exact_motion_is_that_of_dense_matrices(name, poles):
    plant = motion.PLANTS[name]
    assert len(plant.poles()) == poles
    rows, fine, step = 121, 16, 0.05
    u = motion.held_command(rows, 5, 20)
    exact = motion.response(plant, u, step)
    m = (rows - 1) * fine
    driven = oracles.pulse_means(u, m, "zoh")
    y = oracles.free_run(
        list(plant.own), [(b, nu, driven) for b, nu in plant.inputs], plant.alpha, m, (rows - 1) * step
    )
    samples = np.concatenate([[0.0], 1.5 * y[fine - 1 :: fine] - 0.5 * y[fine - 2 :: fine]])
    # Just after a jump the scheme is off by its step to the power of alpha; elsewhere by its square.
    quiet = np.arange(rows) % 20 > 5
    assert np.max(np.abs(exact - samples)[quiet]) < 2e-4 * np.std(exact)


# ----------------------------------------------------------------------------------------------------------------------
# Intervals


@pytest.mark.parametrize(("name", "seeds"), [("0.7", 1), ("1.3", 1), ("1.7, 0.6", 1)])
def test_intervals_of_a_run_cut_out_of_a_motion_hold_the_truth(name, seeds):
    # With Caputo's terms alone these are dozens of standard errors away.
    plant = motion.PLANTS[name]
    for seed in range(seeds):
        _, run = motion.pieces(plant, seed)
        found = ftlm.identify(run, ftlm.equation(plant.words), threads=1)
        assert found.settings["initial"] == "history, 8 powers of t up to 2"
        assert max(map(abs, motion.scores(found, plant).values())) < 3.5
        assert found.residuals.passed


def test_halves_of_a_motion_agree(halves):
    _, (first, second) = halves
    for name in ("alpha", "a", "b"):
        first_value, second_value = ({**f.orders, **f.coefficients}[name] for f in (first, second))
        assert abs(first_value - second_value) < 3.5 * np.hypot(
            first.standard_errors[name], second.standard_errors[name]
        )


@pytest.mark.slow
def test_intervals_cover_in_motion_as_from_rest():
    held, agree = [], []
    for name in ("0.4", "0.7", "1.3", "1.7, 0.6", "1.9, 0.5"):
        plant = motion.PLANTS[name]
        for seed in range(20):
            both = [ftlm.identify(run, ftlm.equation(plant.words)) for run in motion.pieces(plant, seed)]
            held.append([abs(z) < 1.96 for z in motion.scores(both[1], plant).values()])
            for n in plant.truth:
                first_value, second_value = ({**f.orders, **f.coefficients}[n] for f in both)
                agree.append(abs(first_value - second_value) < 1.96 * np.hypot(*(f.standard_errors[n] for f in both)))
    covered = np.concatenate(held)
    assert 0.90 <= np.mean(covered) <= 0.99
    assert np.mean(agree) >= 0.90


# ----------------------------------------------------------------------------------------------------------------------
# What is estimated of the past, and when


def test_from_rest_nothing_is_estimated_of_the_past(halves):
    (run, _), (found, _) = halves
    assert found.settings["initial"] == "rest"
    assert found.comparison.initial == [{"y": {}}]
    stated = ftlm.identify(run, ftlm.equation(WORDS, initial="rest"), threads=1)
    assert found.standard_errors == stated.standard_errors
    # What asking for it would cost.
    asked = ftlm.identify(run, ftlm.equation(WORDS, initial="history"), threads=1)
    assert all(asked.standard_errors[n] > 1.2 * e for n, e in found.standard_errors.items())


def test_what_rounding_leaves_asks_for_no_history():
    # Residuals without noise are the step's: of any shape, and slow terms follow them.
    plant = motion.PLANTS["0.7"]
    u = motion.held_command(300, 6, 20)
    y = motion.response(plant, u, 0.05)
    for level, initial in ((0.0, "rest"), (0.6, "caputo")):
        run = ftlm.Run.from_arrays(step=0.05, inputs={"u": u + 0.5 * level}, outputs={"y": y + level})
        found = ftlm.identify(run, ftlm.equation(plant.words), threads=1)
        assert found.settings["initial"] == initial
        assert found.orders["alpha"] == pytest.approx(0.7, abs=1e-4)
        # Standard errors are as small as the residuals: a change by a tenth of them is none.
        assert "step_moves_estimate" not in {f.code for f in found.findings}


def test_the_command_line_asks_for_a_history(halves, tmp_path):
    (_, run), (_, found) = halves
    table = tmp_path / "run.csv"
    rows = zip(run.time, run["u"], run["y"], strict=True)
    table.write_text("t,u,y\n" + "".join(f"{t!r},{u!r},{y!r}\n" for t, u, y in np.array(list(rows)).tolist()))
    words = ["identify", str(table), "--structure", WORDS, "--time", "t", "-u", "u", "-y", "y", "--json"]
    result = CliRunner().invoke(cli.app, [*words, "--initial", "history"])
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert document["settings"]["initial"] == found.settings["initial"]
    refused = CliRunner().invoke(cli.app, [*words, "--initial", "tails"])
    assert refused.exit_code == 2
    assert "is not known; give auto, rest, caputo, history or exponents" in " ".join(refused.output.split())


@pytest.mark.parametrize("offset", ["none", "constant"])
def test_a_level_held_since_long_asks_for_no_history(offset):
    # At rest at another level: nothing has moved, so Caputo's terms are exact.
    plant = motion.PLANTS["0.7"]
    u = motion.held_command(400, 2, 20)
    y = motion.response(plant, u, 0.05)
    y = y + (1.3 if offset == "constant" else 0.6) + 0.01 * np.std(y) * np.random.default_rng(4).standard_normal(400)
    moved = u if offset == "constant" else u + 0.3
    run = ftlm.Run.from_arrays(step=0.05, inputs={"u": moved}, outputs={"y": y})
    found = ftlm.identify(run, ftlm.equation(WORDS, offset=offset), threads=1)
    assert found.settings["initial"] == "caputo"
    assert found.standard_errors["alpha"] < 0.004
    assert abs(found.orders["alpha"] - 0.7) < 3.5 * found.standard_errors["alpha"]
    if offset == "constant":
        assert found.comparison.offsets[0]["y"]["constant"] == pytest.approx(0.5 * 1.3, rel=0.05)


def test_an_offset_beside_a_history_is_not_told_apart(halves):
    (_, run), _ = halves
    found = ftlm.identify(run, ftlm.equation(WORDS, offset="constant"), threads=1)
    assert found.settings["initial"].startswith("history")
    assert abs(found.orders["alpha"] - 0.7) < 3.5 * found.standard_errors["alpha"]
    assert found.comparison.offsets == ({"y": {}},)
    assert (
        "offset in the equation of y in second half: not separately identifiable from the initial conditions"
        in found.details()
    )


def test_an_offset_and_a_power_of_the_history_may_be_one_term():
    _, run = motion.pieces(motion.one_term(0.7), 1, rows=250)
    # The order is that of another plant, and what it leaves does not ask for a history by itself.
    structure = ftlm.equation("D^0.75 y = -a y + b u", offset="constant", initial="history")
    for method in ("output-error", "least-squares"):
        found = ftlm.identify(run, structure, method=method)
        assert 0.75 in found.comparison.initial[0]["y"]
        assert list(found.comparison.initial[0]["y"]) == [0, 0.25, 0.5, 0.75, 1, 1.25, 1.5, 2]


def test_a_run_in_motion_that_passes_zero_as_it_starts_is_found_out():
    plant = motion.PLANTS["0.7"]
    u = motion.held_command(1000, 3, 20)
    y = motion.response(plant, u, 0.05)
    start = 300 + int(np.argmin(np.abs(y[300:600])))
    noise = 0.01 * np.std(y) * np.random.default_rng(8).standard_normal(400)
    part = slice(start, start + 400)
    run = ftlm.Run.from_arrays(step=0.05, inputs={"u": u[part]}, outputs={"y": y[part] + noise}, name="cut")
    structure = ftlm.equation(plant.words)
    assert record(run, structure, 399).initial == "rest"
    found = ftlm.identify(run, structure, threads=1)
    assert found.settings["initial"].startswith("history")
    assert any("cut: the first values look like rest, but the residuals" in w for w in found.warnings)
    assert max(map(abs, motion.scores(found, plant).values())) < 3.5
    # Whoever judges the model on this run sees it as the fit did.
    assert found.model.structure.initial == "history"
    assert ftlm.compare(found.model, run).fit == pytest.approx(found.fit, rel=1e-12)


@pytest.mark.parametrize("seed", [3, 6])
def test_a_swing_that_passes_zero_at_the_first_row_is_not_at_rest(seed):
    # Eight samples a period: the residuals from rest swing, so that they do not inflate the variance of a sum.
    step, size, before = 2 * np.pi / 300 / 8, 400, 300
    rng, t = np.random.default_rng(seed), np.arange(size + before)
    u = sum(np.sin(6 * np.pi * k * t / t.size + rng.uniform(0, 6)) for k in (1, 3, 7, 13, 20))
    numerator, denominator, _ = cont2discrete(([1.8e5], [1, 6, 9e4]), step)[:3]
    y = lfilter(np.ravel(numerator), denominator, u)[before:]
    noise = 0.05 * y.std() * np.random.default_rng(seed).standard_normal(size)
    run = ftlm.Run.from_arrays(step=step, inputs={"u": u[before:]}, outputs={"y": y + noise}, name="cut")
    structure = ftlm.equation("D^2 y = a1 D y + a0 y + b u")
    assert resolve_initial_conditions(run, structure) == "rest"
    found = ftlm.identify(run, structure)
    assert found.settings["initial"] == "caputo"
    assert "rest_rejected" in [f.code for f in found.findings]
    for name, truth in (("a1", -6.0), ("a0", -9e4), ("b", 1.8e5)):
        assert abs(found.coefficients[name] - truth) < 3.5 * found.standard_errors[name]


def test_whole_orders_need_whole_powers_alone():
    # (1 - 0.9) / (z - 0.9) by SciPy, cut out of a longer motion.
    rng = np.random.default_rng(5)
    u = np.repeat(rng.uniform(-1, 1, 40), 20)
    y = lfilter([0.0, 0.1], [1.0, -0.9], u)[400:] + 0.003 * rng.standard_normal(400)
    run = ftlm.Run.from_arrays(step=0.1, inputs={"u": u[400:]}, outputs={"y": y})
    found = ftlm.identify(run, ftlm.equation("D y = -a y + b u"), threads=1)
    assert found.settings["initial"] == "caputo"
    assert found.comparison.initial[0]["y"].keys() == {0.0}
    for name in "ab":
        assert found.coefficients[name] == pytest.approx(-10 * np.log(0.9), abs=3.5 * found.standard_errors[name])


# ----------------------------------------------------------------------------------------------------------------------
# One decision and one free run for all who judge


def test_a_comparison_has_the_history_of_the_fit(halves, tmp_path):
    (_, run), (_, found) = halves
    saved = ftlm.load_model(found.model.save(tmp_path / "model.json"))
    for model in (found.model, saved):
        again = model.compare(run)
        assert again.fit == pytest.approx(found.fit, rel=1e-12)
        assert again.initial == found.comparison.initial
    terms = found.comparison.initial[0]
    assert list(terms["y"]) == [0, 0.25, 0.5, 0.75, 1, 1.25, 1.5, 2]
    simulated = found.model.simulate(run, initial=terms)["y"]
    np.testing.assert_allclose(simulated, found.comparison.simulated["y"][0], atol=1e-4 * np.std(simulated))
    assert found.residuals.initial_terms == 8
    assert "initial terms of y in second half (of that run alone): " in found.details()


def test_a_run_in_motion_is_judged_with_its_own_history(halves):
    (first, second), (found, _) = halves
    judged = found.validate(second)
    clean = 100 * (1 - 0.01)
    assert judged.fit["y"] == pytest.approx(clean, abs=0.3)
    assert len(judged.initial[0]["y"]) == 8
    assert found.validate(first).initial == [{"y": {}}]


@pytest.mark.parametrize(("name", "seed"), [("0.4", 1), ("0.7", 1), ("1.3", 1), ("1.7, 0.6", 1)])
@slow_after(1, "coupling", ["measured", "simulated"])
def test_a_history_explains_no_more_of_a_run_than_a_past_input_could(name, seed, coupling):
    # Free powers of t alone explain 73, 77, 65 and 57 % of these runs, whose input changes four times.
    plant = motion.PLANTS[name]
    _, run = motion.pieces(plant, seed, every=120)
    orders = {n: v for n, v in plant.truth.items() if n in ("alpha", "nu")}
    structure = ftlm.equation(plant.words, initial="history", coupling=coupling).with_orders(orders)
    coefficients = {n: plant.truth[n] for n in structure.coefficient_names}
    true, wrong = (
        ftlm.Model(structure.with_coefficients({**coefficients, "b": share * coefficients["b"]})) for share in (1, 0.02)
    )
    assert ftlm.compare(true, run).fit["y"] > 99.1
    judged = ftlm.compare(wrong, run)
    assert judged.fit["y"] < 15
    # What is printed is still what the initial terms simulate.
    answer = wrong.simulate(run, initial=judged.initial[0])["y"]
    np.testing.assert_allclose(answer, judged.simulated["y"][0], atol=1e-6 * np.std(run["y"]))


def test_a_run_that_no_input_moves_is_explained_by_its_past():
    t = 0.05 * np.arange(300)
    u = np.where(t < 4.0, 1.0, 0.0)
    plant = motion.PLANTS["0.7"]
    y = motion.response(plant, u, 0.05)[100:] + 1e-4 * np.random.default_rng(1).standard_normal(200)
    run = ftlm.Run.from_arrays(step=0.05, inputs={"u": u[100:]}, outputs={"y": y})
    structure = ftlm.equation(plant.words, initial="history").with_orders({"alpha": 0.7})
    model = ftlm.Model(structure.with_coefficients({"a": 0.5, "b": 1.0}))
    assert ftlm.compare(model, run).fit["y"] > 99


def test_the_length_follows_the_noise_never_the_fit(halves):
    (_, run), (_, found) = halves
    structure = ftlm.equation(WORDS)
    rng = np.random.default_rng(2)

    def length(share: float) -> int:
        y = run["y"] + share * np.std(run["y"]) * rng.standard_normal(run.length)
        return len(history(ftlm.Run.from_arrays(step=run.step, inputs={"u": run["u"]}, outputs={"y": y}), structure))

    lengths = [length(share) for share in (0.0, 0.03, 0.1, 0.3)]
    assert lengths == sorted(lengths, reverse=True)
    assert lengths[0] == 8
    assert lengths[-1] < lengths[0]
    # A model that fits worse asks for no other powers.
    worse = replace(found.model.structure, equations=structure.with_orders({"alpha": 0.6}).equations)
    assert (
        resolve_initial_conditions(run, worse) == resolve_initial_conditions(run, structure) == history(run, structure)
    )
    assert history(run, ftlm.equation("D^4.2 y = a y + b u"))[-3:] == (2.0, 3.0, 4.0)
    short = run.window(None, 3.0)
    assert history(short, structure) == (0.0, 0.25, 0.5, 0.75, 1.0, 2.0)


def test_runs_of_one_fit_have_one_rule(halves):
    (first, second), _ = halves
    prepared = prepare([first, second], ftlm.equation(WORDS), 499, power_of_two=False)
    assert {r.initial for r in prepared} == {history(second, ftlm.equation(WORDS))}
    both = ftlm.identify([first, second], ftlm.equation(WORDS), threads=1)
    assert max(map(abs, motion.scores(both, motion.PLANTS["0.7"]).values())) < 3.5


def test_started_leaves_stated_terms_alone(halves):
    (_, run), (_, found) = halves
    assert isinstance(with_initial_conditions(found.model, run).structure.initial, History)
    for stated in ("rest", "caputo", (0.0, 0.5)):
        model = replace(found.model, structure=replace(found.model.structure, initial=stated))
        assert with_initial_conditions(model, run).structure.initial == stated


@pytest.mark.parametrize("method", ["least-squares", "instrumental-variables", "multi-innovation"])
def test_equation_error_methods_carry_the_history_too(halves, method):
    (_, run), _ = halves
    structure = ftlm.equation("D^0.7 y = -a y + b u")
    chosen = ftlm.MultiInnovation(prior_covariance=1e6) if method == "multi-innovation" else method
    found = ftlm.identify(run, structure, method=chosen)
    assert found.settings["initial"] == "history, 8 powers of t up to 2"
    assert found.coefficients == pytest.approx({"a": 0.5, "b": 1.0}, rel=0.1)


def test_squares_have_a_say_in_what_a_history_is_worth():
    rng = np.random.default_rng(0)
    many = rng.normal(size=2000)
    # What lies far out hardly counts by Huber's measure, and in squares as much as it lies.
    few = many.copy()
    few[::200] += 40.0
    by_huber, together = huber_loss_excess([few], [many], [100.0]), loss_excess_of_fits([few], [many], [100.0])
    squares = np.sum(few**2 - many**2) / np.mean(many**2)
    assert by_huber < 0.25 * squares
    assert together == pytest.approx(0.25 * squares)
    assert loss_excess_of_fits([many], [many], [100.0]) == 0.0
    assert loss_excess_of_fits([1e-16 * few], [0.0 * many], [100.0]) == 0.0
    assert loss_excess_of_fits([few], [0.0 * many], [100.0]) == np.inf
