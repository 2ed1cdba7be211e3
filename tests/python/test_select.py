"""Structures chosen by what they predict: the true one among those inside a richer one, and words where none can be."""

import json
import math
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal
from typer.testing import CliRunner

import friction
import ftlm
import loops
from ftlm.cli.main import app
from ftlm.structure_selection.automatic import IntegerOrderForm
from ftlm.structure_selection.candidates import Change, NestedStructures, Variant, name_candidates
from ftlm.structure_selection.cross_validation import (
    Folds,
    Trial,
    fit,
    mask_outputs,
    validate_fit,
    validation_score_bound,
)
from ftlm.structure_selection.result import format_fit
from ftlm.structure_selection.select import _predicts_equally, _rank_trials, _reason, automatic_problems
from ftlm.structure_selection.stepwise import (
    CandidateEvaluator,
    FittedVariant,
    StepwiseSelection,
    evaluate_list,
    format_duration,
    prescreen,
)
from ftlm.utils.formatting import Exact, number, typeset
from ftlm.utils.resources import stop_flag

RICH = "D^2 y = d D^mu y + a y + b0 u + b1 D^gamma u"


def motor(seed, rows=400, late=0, snr=40.0, name="motor"):
    """A second-order motor by SciPy, its command late by some samples, in white noise."""
    rng = np.random.default_rng([7, seed])
    step = 0.02
    u = np.repeat(rng.choice([-1.0, 1.0], rows // 15 + 1), 15)[:rows]
    acts = np.concatenate([np.zeros(late), u[: rows - late]])
    system = signal.cont2discrete(signal.tf2ss([40.0], [1.0, 5.0, 40.0]), step, "zoh")
    y = signal.dlsim(system, acts)[1][:, 0]
    y = y + 10 ** (-snr / 20) * np.std(y) * rng.standard_normal(rows)
    return ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": y}, name=f"{name} {seed}")


def rich(**more):
    return ftlm.equation(RICH, orders={"mu": (0.1, 1.9, 0.1), "gamma": (0.5, 1.5, 0.1)}, **more)


@pytest.fixture(scope="module")
def runs():
    return [motor(0), motor(1)]


@pytest.fixture(scope="module")
def chosen(runs):
    return ftlm.select(runs, rich(offset="auto"), threads=2)


def test_the_true_structure_is_chosen_from_a_richer_one(chosen):
    assert chosen.winner.name == "D^2 y = d D^1 y + a y + b0 u"
    assert chosen.winner.parameter_count == 3
    truth = {"d": -5.0, "a": -40.0, "b0": 40.0}
    for name, value in truth.items():
        low, high = chosen.best.intervals[name]
        assert low <= value <= high
    assert "each of 2 runs by the others" in str(chosen)
    assert chosen.reason.startswith("Chosen: D^2 y = d D^1 y + a y + b0 u (3 parameters, ")


def test_what_is_judged_was_not_fitted(runs, chosen):
    """The figure of the left-out run is that of an identification of the other run alone."""
    for left, seen in ((runs[0], runs[1]), (runs[1], runs[0])):
        alone = ftlm.identify(seen, chosen.winner.structure, threads=1, method=ftlm.OutputError(intervals="quadratic"))
        own = chosen.winner.validation[left.name]["y"]
        assert own == pytest.approx(alone.model.compare(left).fit["y"], abs=2e-3)


def test_any_number_of_threads_gives_the_same_bits(runs, chosen):
    again = ftlm.select(runs, rich(offset="auto"), threads=1)
    assert [(t.name, t.scores, t.values) for t in again.trials] == [(t.name, t.scores, t.values) for t in chosen.trials]
    assert again.chosen_index == chosen.chosen_index
    assert again.fitted_count == chosen.fitted_count


def test_a_dead_time_is_found_where_there_is_one():
    late = [motor(0, rows=200, late=4), motor(1, rows=200, late=4)]
    structure = ftlm.equation("D^2 y = d D y + a y + b u", delay={"u": (0.0, 0.3)})
    with_delay = ftlm.select(late, structure, threads=2)
    assert with_delay.winner.structure.free_delays == {"u": (0.0, 0.3)}
    assert with_delay.best.delays["u"] == pytest.approx(0.08, abs=2e-3)
    assert "u(t - 0:" in with_delay.winner.name
    without = ftlm.select([motor(0, rows=200), motor(1, rows=200)], structure, threads=2)
    assert without.winner.structure.free_delays == {}


def cart(seed, strength, rows=200, step=0.02):
    """A spring-mounted body on dry friction by slow stepping, in noise of half a percent."""
    rng = np.random.default_rng([17, seed])
    u = np.repeat(rng.uniform(-1.0, 1.0, rows // 10 + 1), 10)[:rows]
    position, _ = friction.naive_run(np.repeat(3.0 * u, 10), step / 10, 2.0, [(-1.0, 1.0), (-4.0, 0.0)], strength)
    # What the oracle has at an instant the force before it did.
    y = np.append(0.0, position)[::10][:rows]
    y = y + 0.005 * np.std(y) * rng.standard_normal(rows)
    return ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": y}, name=f"cart {seed}")


@pytest.mark.parametrize("strength", [0.6, 0.0])
def test_friction_is_chosen_where_there_is_some(strength):
    asked = ftlm.equation("D^2 y = -d D y - k y + g u - fc*sign(D y)")
    found = ftlm.select([cart(seed, strength) for seed in (0, 1)], asked, threads=1)
    words = "D^2 y = -d D^1 y - k y + g u"
    assert found.winner.name == words + (" - fc sign(D y)" if strength else "")
    assert {words, f"{words} - fc sign(D y)"} <= {t.name for t in found.trials}
    low, high = found.best.intervals["k"]
    assert low - 0.05 < 4.0 < high + 0.05
    if strength:
        assert found.best.coefficients["fc"] == pytest.approx(strength, rel=0.02)


def test_frictions_that_may_be_left_out():
    inside = NestedStructures(ftlm.equation("D^2 y = g u - fc*sign(D y) - fs*exp(-(D y/vs)^2)*sign(D y)"))
    assert inside.frictions == {"friction of y": None, "friction of y near rest": "friction of y"}
    assert str(inside.without_optional_friction) == "D^2 y = g u"
    (first,) = [c.variant for c in inside.simplest()]
    coulomb = next(c for c in inside.larger(first))
    assert [c.words for c in inside.larger(first)] == ["friction of y"]
    assert str(inside.build(coulomb.variant)) == "D^2 y = g u - fc sign(D y)"
    (whole,) = list(inside.larger(coulomb.variant))
    assert inside.build(whole.variant) == inside.structure
    # Without the one it stands on, what falls with speed goes, too.
    fewer = {c.words: str(inside.build(c.variant)) for c in inside.smaller(whole.variant)}
    assert fewer["without friction of y"] == "D^2 y = g u"
    assert fewer["without friction of y near rest"] == "D^2 y = g u - fc sign(D y)"
    # Of a size that is known it is no choice.
    known = NestedStructures(ftlm.equation("D^2 y = g u - 0.5*sign(D y)"))
    assert known.frictions == {}
    assert known.without_optional_friction == known.structure


def test_a_list_is_ranked_by_prediction_and_failures_have_a_reason(runs):
    found = ftlm.select(
        runs,
        {
            "first order": ftlm.equation("D y = a y + b u"),
            "second order": ftlm.equation("D^2 y = d D y + a y + b u"),
            "without a spring": ftlm.equation("D^2 y = d D y + b u"),
        },
        threads=2,
    )
    assert found.trials[0].name == found.winner.name == "second order"
    assert found.fitted_count == 3
    assert [t.score for t in found.trials] == sorted(t.score for t in found.trials)
    assert found.trials[0].validation_fit > 98.5
    assert found.trials[1].validation_fit < 90


def test_blocks_of_one_run_are_judged_by_a_fit_that_has_not_read_them():
    run = motor(2)
    folds = Folds.of(run, "blocks")
    assert [f.rows for f in folds.parts] == [(0, 100), (100, 200), (200, 300), (300, 400)]
    unread = folds.parts[1].estimation_runs(["y"])[0]
    assert np.isnan(unread["y"][100:200]).all()
    assert not np.isnan(np.delete(unread["y"], slice(100, 200))).any()
    assert not np.isnan(run["y"]).any()
    found = ftlm.select(run, [ftlm.equation("D^2 y = d D y + a y + b u"), ftlm.equation("D y = a y + b u")], threads=2)
    assert len(found.winner.validation) == 4
    # 40 dB of noise leave 1 % over, of whatever block.
    assert all(97.5 < part["y"] < 99.5 for part in found.winner.validation.values())


@pytest.mark.parametrize("text", ["D^2 y = d D y + a y + b u", "D y = a y + b u"])
@pytest.mark.parametrize("validation", ["runs", "blocks"])
def test_no_fold_is_left_less_than_where_all_is_fitted(runs, text, validation):
    structure, folds = ftlm.equation(text), Folds.of(runs, validation)
    joint = fit(folds.runs, structure, [], refine=False)
    least, found = validation_score_bound(joint, folds), validate_fit("it", structure, folds, joint)
    # Free runs that judge are of finer grids and of two samples a run more.
    assert found.score > least - 0.01
    assert found.score < least + 0.2
    own = Folds.of(runs[0], runs[1])
    assert validation_score_bound(joint, own) == -np.inf
    assert validation_score_bound(replace(joint, converged=False), folds) == -np.inf


def test_what_cannot_matter_is_not_judged(runs):
    """Of two whose fits are known, the far worse one waits for the better, and is judged where that fails."""
    inside = NestedStructures(ftlm.equation("D^alpha y = a y + b0 u + b1 D^gamma u", orders={"gamma": (0.5, 1.5, 0.1)}))
    variants = [Variant(frozenset({"a", "b0"}), (("alpha", top),), offset=False) for top in (2.0, 1.0)]
    folds = Folds.of(runs, "runs")
    ahead = [FittedVariant(Change("", v), fit(folds.runs, inside.build(v), [], refine=False), 0.0) for v in variants]
    scores = [validate_fit("", inside.build(v), folds, f.joint).score for v, f in zip(variants, ahead, strict=True)]
    order = sorted(range(2), key=lambda k: scores[k])
    better, worse = (ahead[k] for k in order)

    def names(pair, **more):
        return [t.name for t in StepwiseSelection(inside, CandidateEvaluator(folds, 1)).validate_variants(pair, **more)]

    both = names([better, worse])
    assert len(both) == 2
    assert names([better, worse], limit=min(scores) + 0.01) == both[:1]
    assert names([better, worse], limit=-np.inf, margin=10.0) == both
    assert names([worse, better], limit=min(scores) + 0.01) == both[::-1]


def test_long_records_are_fitted_by_those_alone_that_may_lead():
    runs = [motor(seed, rows=3001) for seed in (0, 1)]
    at = {"d": -5.0, "a": -40.0, "b": 40.0}
    true, free, first = map(
        ftlm.equation, ("D^2 y = d D y + a y + b u", "D^2 y = d D^mu y + a y + b u", "D y = a y + b u")
    )
    starts = [(first, [at]), (true, [at]), (first, [{"a": -1.0, "b": 0.1}]), (free, [{**at, "mu": 1.2}])]
    work = CandidateEvaluator(Folds.of(runs, "runs"), 1)
    assert prescreen(runs, starts, 2, work) == [1, 3]
    assert prescreen(runs, starts, 3, work) == [0, 1, 3]
    assert prescreen(runs, starts, 4, work) == [0, 1, 2, 3]
    # Short ones are not thinned, and what sticks is not told from what slides by a few evaluations.
    assert prescreen([motor(0)], starts, 2, work) == [0, 1, 2, 3]
    rubbing = ftlm.equation("D^2 y = d D y + a y + b u - fc*sign(D y)")
    assert prescreen(runs, [*starts, (rubbing, [{**at, "fc": 0.1}])], 2, work) == [0, 1, 2, 3, 4]
    assert work.done_count == work.announced_count == 0


def test_a_run_of_its_own_judges(runs):
    found = ftlm.select(runs[0], [ftlm.equation("D^2 y = d D y + a y + b u")], validation=runs[1], threads=1)
    assert list(found.winner.validation) == [runs[1].name]
    assert found.validation == f"{runs[1].name}, not fitted to"


def test_what_was_chosen_from_rest_is_judged_on_a_run_in_motion(runs):
    whole = motor(3, rows=800)
    found = ftlm.select(whole.window(0, 8.0), [ftlm.equation("D^2 y = d D y + a y + b u")], threads=1)
    late = whole.window(8.0, 16.0)
    selected_fit = found.best.validate(late).fit["y"]
    single_fit = ftlm.identify(whole.window(0, 8.0), found.winner.structure).validate(late).fit["y"]
    assert selected_fit > 95.0
    assert abs(selected_fit - single_fit) < 0.1


def relaxing(alpha, noise, seed, rows=400):
    """D^alpha y = -0.8 y + 1.6 u with white noise."""
    rng = np.random.default_rng([seed, 3])
    u = np.repeat(rng.choice([-1.0, 1.0], rows // 15 + 1), 15)[:rows]
    y = loops.convolved(np.diff(u, prepend=0.0), 2 * (1 - loops.relaxation(0.1 * np.arange(rows), alpha, 0.8)))
    y += noise * np.std(y) * rng.standard_normal(rows)
    return ftlm.Run.from_arrays(step=0.1, inputs={"u": u}, outputs={"y": y}, name=f"run {seed}")


@pytest.mark.parametrize(
    ("alpha", "noise", "rival", "code"),
    [
        (0.7, 0.01, True, "fractional_orders_gain"),
        (0.98, 0.05, True, "fractional_orders_gain_nothing"),
        (0.7, 0.01, False, "fractional_orders_inconclusive"),
    ],
)
def test_fractional_orders_are_judged_on_what_was_not_fitted(alpha, noise, rival, code):
    candidates = {"free": ftlm.equation("D^alpha y = a y + b u")}
    if rival:
        candidates["lag"] = ftlm.equation("D y = a y + b u")
    found = ftlm.select([relaxing(alpha, noise, 0), relaxing(alpha, noise, 1)], candidates)
    assert found.winner.name == "free"
    (said,) = [f for f in found.findings if f.code.startswith("fractional_orders")]
    assert said.code == code
    assert f"alpha = {found.best.orders['alpha']:.3g}" in said.text
    if rival:
        free, lag = (next(t for t in found.trials if t.name == name) for name in ("free", "lag"))
        gains = [free.fits_by_part[p] - lag.fits_by_part[p] for p in lag.fits_by_part]
        assert said.numbers["gain"] == pytest.approx(np.median(gains))


def test_auto_is_of_outputs_that_something_drives(runs):
    (problem,) = automatic_problems(runs)
    made = IntegerOrderForm(2, 1, delayed=True, integrator=True).structure(problem)
    assert str(made.without_free_input_parameters()) == "D^2 y = a1 D^1 y + b1 D^1 u + b0 u"
    assert list(made.free_delays) == ["u"]
    pair = [ftlm.Run.from_arrays(step=1, inputs={"u": [0, 1, 2]}, outputs={"y": [0, 1, 2], "z": [0, 1, 2]})]
    first, second = automatic_problems(pair, driven_by={"z": ["y"]})
    assert (first.drivers, second.drivers) == (("u",), ("y",))
    # An output is measured when it acts.
    assert str(IntegerOrderForm(1, 0, delayed=True).structure(second)) == "D^1 z = a0_z z + b0_z y"
    for asked, words in (
        ({"x": ["u"]}, "'x' is not an output"),
        ({"z": ["z"]}, "'z' cannot be an input of z"),
    ):
        with pytest.raises(ftlm.ModelError, match=words):
            automatic_problems(pair, driven_by=asked)
    (free,) = automatic_problems([ftlm.Run.from_arrays(step=1, inputs={}, outputs={"y": [0, 1, 2]})])
    assert str(IntegerOrderForm(2, 0).structure(free)) == "D^2 y = a1 D^1 y + a0 y"
    with pytest.raises(ftlm.ModelError, match="driven_by= is used with 'auto'"):
        ftlm.select(runs, ftlm.equation("D y = a y + b u"), driven_by={"y": ["u"]})


@pytest.mark.slow
def test_auto_finds_order_and_terms(runs):
    found = ftlm.select(runs, "auto", threads=2)
    assert found.winner.parameter_count == 3
    item = found.winner.structure.equations[0]
    assert item.order.constant == 2.0
    assert sorted((t.signal, t.order.constant) for t in item.terms) == [("u", 0.0), ("y", 0.0), ("y", 1.0)]


def test_everything_inside_a_structure_is_one():
    inside = NestedStructures(rich(offset="auto"))
    first = next(iter(inside.simplest())).variant
    assert str(inside.build(first)) == "D^2 y = d D^1 y + a y + b0 u"
    grown = {c.words for c in inside.larger(first)}
    assert grown == {"+ b1 D^1 u", "mu free", "an offset of each run"}
    for change in inside.larger(first):
        back = {str(inside.build(c.variant)) for c in inside.smaller(change.variant)}
        assert str(inside.build(first)) in back
    # A second own term at order 0 would be the same as the first.
    assert not inside.is_valid(Variant(frozenset({"d", "a", "b0"}), (("mu", 2.0),), offset=False))


def test_what_only_drives_has_a_skeleton(runs):
    inside = NestedStructures(ftlm.equation("D^2 y = b0 u + b1 D u"))
    assert [str(inside.build(c.variant)) for c in inside.simplest()] == ["D^2 y = b0 u", "D^2 y = b1 D^1 u"]
    found = ftlm.select(runs, ftlm.equation("D^2 y = b u"), threads=1)
    assert found.winner.name == "D^2 y = b u"


def test_masked_runs_keep_what_was_read(runs):
    unread = mask_outputs(runs[0], ["y"], (10, 20))
    assert unread.unmasked_run is runs[0]
    assert unread.select(["u", "y"]).unmasked_run is None
    assert unread.step == runs[0].step
    assert unread.name == runs[0].name
    np.testing.assert_array_equal(unread["u"], runs[0]["u"])
    np.testing.assert_array_equal(unread["y"][:10], runs[0]["y"][:10])


def test_words_where_nothing_can_be_chosen(runs):
    second = ftlm.equation("D^2 y = d D y + a y + b u")
    with pytest.raises(ftlm.ModelError, match="there is only one; give several runs"):
        ftlm.select(runs[0], second, validation="runs")
    with pytest.raises(ftlm.ModelError, match="'halves' is not known; use 'runs', 'blocks', or a run"):
        ftlm.select(runs, second, validation="halves")
    with pytest.raises(ftlm.ModelError, match="there are no candidates"):
        ftlm.select(runs, [])
    with pytest.raises(ftlm.ModelError, match="candidate 1 of 2 is int"):
        ftlm.select(runs, [second, 3])
    with pytest.raises(ftlm.ModelError, match="are the same structure; leave one out"):
        name_candidates({"one": second, "two": ftlm.equation("D^2 y = d D y + a y + b u")})
    renamed = ftlm.equation("D^2 y = k y + c D y + g u")
    with pytest.raises(ftlm.ModelError, match="the same structure except for parameter names; leave one out"):
        ftlm.select(runs, {"one": second, "two": renamed})
    with pytest.raises(ftlm.ModelError, match="candidates 'any, offset' and 'constant' are the same structure; leave"):
        ftlm.select(runs, {"any": replace(second, offset="auto"), "constant": replace(second, offset="constant")})
    with pytest.raises(ftlm.ModelError, match=r"validation = \[\] has no run; give a run that is not"):
        ftlm.select(runs, second, validation=[])
    with pytest.raises(ftlm.ModelError, match="candidates = 'linear'; use 'auto'"):
        ftlm.select(runs, "linear")
    with pytest.raises(ftlm.ModelError, match="has no free parameter"):
        ftlm.select(runs, "D y = u")
    with pytest.raises(ftlm.ModelError, match="10001 candidates are more than 10000"):
        ftlm.select(runs, [second] * 10_001)
    with pytest.raises(ftlm.DataError, match="has 40 rows, too few to be cut into 4 blocks"):
        ftlm.select(runs[0].window(0, 0.8), second)
    with pytest.raises(ftlm.ModelError, match="motor 1 is also an estimation run, so it does not validate the model"):
        ftlm.select(runs, second, validation=runs[1])
    idle = ftlm.Run.from_arrays(step=0.1, inputs={"u": np.zeros(300)}, outputs={"y": 1e-3 * np.sin(np.arange(300.0))})
    with pytest.raises(ftlm.DataError, match="u is 0 in all rows"):
        ftlm.select(idle, replace(second, initial="rest"))
    still = ftlm.Run.from_arrays(step=0.1, inputs={"u": np.zeros(300)}, outputs={"y": np.zeros(300)})
    for candidates in ("auto", second, [second]):
        with pytest.raises(ftlm.DataError, match="'y' of run 'run': constant, every row is 0"):
            ftlm.select(still, candidates)
    with pytest.raises(ftlm.DataError, match="signal"):
        ftlm.select(runs, ftlm.equation("D^2 z = a z + b u"))
    for nothing in (None, 3, second.equations[0]):
        with pytest.raises(ftlm.ModelError, match=f"candidates is {type(nothing).__name__}; use ftlm.equation"):
            ftlm.select(runs, nothing)
    known = ftlm.equation("D y = -3 y + 3 u")
    for candidates in (known, [second, known]):
        with pytest.raises(ftlm.ModelError, match=r"-3\.0 y \+ 3\.0 u has no free parameter; name a coefficient"):
            ftlm.select(runs, candidates)


def test_what_only_one_block_excites_is_said_of_the_others(runs):
    begins = np.arange(400) >= 310
    late = ftlm.Run.from_arrays(
        step=0.02, inputs={"u": runs[0]["u"] * begins}, outputs={"y": runs[0]["y"] * begins}, name="late"
    )
    words = r"without late 6-8 s: output 'y' of run 'late': constant"
    with pytest.raises(ftlm.ConvergenceError, match=words):
        ftlm.select(late, [ftlm.equation("D^2 y = d D y + a y + b u")])


def test_who_stops_it_ends_what_threads_compute(runs):
    """By the order of events: the second item computes until it is told to end, and nothing new begins after that."""
    entered, begun, ended = threading.Event(), [], []

    def item(number):
        begun.append(number)
        if number == 0:
            assert entered.wait(60)
            return number
        entered.set()
        # The core asks the same flag at every evaluation.
        assert wait_for(stop_flag())
        ended.append(number)
        raise KeyboardInterrupt

    def wait_for(flag):
        return any(flag.is_set or time.sleep(0.001) for _ in range(60_000))

    def interrupt(done, known):
        raise KeyboardInterrupt

    work = CandidateEvaluator(Folds.of(runs, "runs"), 2, interrupt)
    with pytest.raises(KeyboardInterrupt):
        work.map_candidates(item, list(range(20)))
    # The thread of the first item may have taken up a third before.
    assert set(begun) <= {0, 1, 2}
    assert sorted(ended) == sorted(begun)[1:]


def test_fits_on_threads_end_with_the_flag(runs):
    work = CandidateEvaluator(Folds.of(runs, "runs"), 1)
    structure = ftlm.equation("D^2 y = d D y + a y + b u")
    start = {"d": -5.0, "a": -40.0, "b": 40.0}

    def stopped(call):
        def item(_):
            stop_flag().set()
            return call()

        with pytest.raises(KeyboardInterrupt):
            work.map_items(item, [0])

    joint = work.fit_candidate(structure, [start])
    stopped(lambda: work.fit_candidate(structure, []))
    stopped(lambda: work.fit_candidate(structure, [start]))
    stopped(lambda: work.validate("second order", structure, joint))


def test_many_candidates_are_told_how_long_they_take(runs):
    ticks = iter([0.0, 3.0])

    def judge(name, structure, joint, *, is_final):
        return Trial(name, structure, 1, failure="not asked")

    work = CandidateEvaluator(Folds.of(runs, "runs"), 2, clock=lambda: next(ticks))
    work.fit_candidate = lambda structure, starts: None
    work.validate = judge
    candidates = {str(k): ftlm.equation(f"D^{1 + k * 1e-4:.6f} y = a y + b u") for k in range(202)}
    with pytest.warns(
        UserWarning, match="202 candidates: the first 2 took 3 s, so the other 200 take about 5 min on 2"
    ):
        assert len(evaluate_list(candidates, work)) == 202
    assert [format_duration(s) for s in (0.123, 119.0, 121.0, 7300.0)] == ["0.12 s", "1.2e+02 s", "2 min", "2 h"]


def test_predictions_are_alike_where_folds_do_not_tell_them_apart():
    """Scores of one seed of a plant whose true structure a single standard error refused for one with three more."""

    def trial(*scores, bic=0.0):
        return Trial("", ftlm.equation("D y = a y + b u"), 1, scores=scores, effective_bic=bic)

    best = trial(-3.7766, -4.4820, -4.7931, -4.8312)
    assert _predicts_equally(trial(-3.7169, -4.4811, -4.7930, -4.8305), best)
    # However much the folds scatter, beyond 5 % nothing is alike; nor what is a little worse in each of them.
    assert not _predicts_equally(trial(-3.5, -4.4811, -4.7930, -4.8305), best)
    assert not _predicts_equally(trial(-3.76, -4.467, -4.777, -4.815), best)
    # Another seed: the truth without the one block that tells it is far off there, but very likely on all samples.
    best = trial(-3.7591, -4.5182, -4.7539, -4.8769, bic=-14235.6)
    assert _predicts_equally(trial(-3.2813, -4.5247, -4.7543, -4.8814, bic=-14254.4), best)
    assert not _predicts_equally(trial(-3.2813, -4.5247, -4.7543, -4.8814, bic=-14240.0), best)
    assert not _predicts_equally(trial(-3.2813, -4.1247, -4.3543, -4.4814, bic=-14254.4), best)
    # Two folds tell no scatter: 1 %.
    assert _predicts_equally(trial(-3.76, -4.48), trial(-3.7766, -4.4820))
    assert not _predicts_equally(trial(-3.75, -4.48), trial(-3.7766, -4.4820))
    # Of a motor's two runs: the luckiest had five numbers more, and on all samples a criterion of 21 more.
    best = trial(-4.6434, -4.5739, bic=-6645.1)
    assert _predicts_equally(trial(-4.6380, -4.5558, bic=-6666.5), best)
    assert not _predicts_equally(trial(-4.6380, -4.5558, bic=-6654.0), best)
    assert not _predicts_equally(trial(-4.5380, -4.5058, bic=-6666.5), best)


def stretches(name, fits, numbers=3):
    """A candidate with these fits in percent on stretches of a run."""
    return Trial(
        name,
        ftlm.equation("D y = a y + b u"),
        numbers,
        effective_bic=0.0,
        validation={f"run {k}": {"y": fit} for k, fit in enumerate(fits)},
        scores=tuple(math.log(1 - max(fit, -100.0) / 100) for fit in fits),
    )


def test_none_wins_that_fails_where_another_does_not():
    """Three stretches in four do not make good what is lost on the fourth, and the reason says so."""
    failing, steady = stretches("failing", (92, 92, 92, -3e7), 6), stretches("steady", (80, 80, 80, 60), 5)
    assert failing.score < steady.score
    assert _rank_trials([failing, steady]) == [steady, failing]
    assert failing.worst_fold == -3e7
    said = _reason(steady, steady, [steady, failing])
    assert "steady (5 parameters, validation fit 75.00 %). It predicts best." in said
    assert said.endswith(
        "failing has 25 % smaller residuals on average and is not chosen: it fails on y of run 3, with a fit of < "
        "-1000 % where the chosen one has 60.00 %."
    )
    # It is none of the best with more numbers either.
    assert "more (6)" not in said
    # Where each fails somewhere the mean decides, and the reason tells where.
    other = stretches("other", (-50, 80, 80, 60))
    assert _rank_trials([other, failing]) == [failing, other]
    assert "It fails on y of run 3, with a fit of < -1000 %; other has 60.00 % there, but fails elsewhere." in _reason(
        failing, failing, [failing, other]
    )
    # One that grows without bound fails nobody, nor do stretches that nobody predicts, of noise alone.
    grown = replace(stretches("grown", (80, 80, 80, 60)), unstable=True)
    assert _rank_trials([grown, failing]) == [failing, grown]
    quiet = [stretches("one", (90, 90, 90, -1)), stretches("two", (89, 89, 89, 3))]
    assert _rank_trials(quiet) == quiet
    # Candidates of other outputs have other parts.
    apart = replace(steady, validation={"run 0": {"z": 80.0}}, scores=(math.log(0.2),))
    assert _rank_trials([apart, failing]) == [failing, apart]


def test_the_first_rows_of_a_run_in_motion_are_judged_with_its_own_initial_terms():
    """Motion from before the start dies away within the block that is left out: its later rows tell nothing of it."""
    rng, step, rows = np.random.default_rng(5), 0.02, 400
    u = np.repeat(rng.choice([-1.0, 1.0], rows // 20), 20)
    keep = math.exp(-4.0 * step)
    y = signal.lfilter([0.0, 1.0 - keep], [1.0, -keep], u) + 2.0 * keep ** np.arange(rows)
    run = ftlm.Run.from_arrays(
        step=step, inputs={"u": u}, outputs={"y": y + 0.01 * rng.standard_normal(rows)}, name="lag"
    )
    structure, folds = ftlm.equation("D y = a y + b u"), Folds.of(run, "blocks")
    joint = fit(folds.runs, structure, [])
    assert joint.initial == "caputo"
    found = validate_fit("lag", structure, folds, joint)
    # What it leaves over is the noise, on the first block as on the others.
    assert found.worst_fold > 97.0
    assert validation_score_bound(joint, folds) == -np.inf
    # A whole run always is, and what is known of it at least stays known.
    whole = Folds.of([run, run.window(0, 4)], "runs")
    assert validation_score_bound(fit(whole.runs, structure, []), whole) > -np.inf


def test_the_page_and_the_figures(chosen, tmp_path):
    page = chosen.report(tmp_path / "choice.html").read_text("utf-8")
    assert "Fit by number of parameters" in page
    assert "insignificant" in page
    # What is chosen is a dot on the line, not a line of one point that nobody sees.
    assert "are not finite" not in page
    # The model has the sections of its own report.
    for head in ("Measured and simulated</h2>", "Equations</h2>", "The choice</h2>", "Residuals</h2>"):
        assert head in page
    assert page.index("Equations</h2>") < page.index("The choice</h2>") < page.index("Residuals</h2>")
    for name, parameter in chosen.parameters.items():
        if not parameter.fixed:
            assert number(parameter.standard_error) in page, name
    part = page[page.index("The choice</h2>") : page.index("Residuals</h2>")]
    # The report has the findings of the terminal and of Python.
    found = ftlm.Finding("worse_than_mean", numbers={"parts": "run 0 (-3 %)"})
    doubted = replace(chosen, findings=(found,))
    warned = doubted.report(tmp_path / "warned.html").read_text("utf-8")
    warnings = warned[warned.index("Warnings</h2>") : warned.index("The choice</h2>")]
    assert typeset(found.text) in warnings
    assert found.text in str(doubted)
    assert "No check raised a warning" not in warned
    # One model has one criterion: that of the residuals.
    assert chosen.winner.bic == pytest.approx(chosen.best.information.bic, rel=1e-9)
    bic = number(Exact(round(chosen.best.information.bic, 1)))
    assert bic in part
    assert bic in page[page.index("Residuals</h2>") :]
    # Exponents are raised, and the first derivative has none.
    assert "D<sup>2</sup> y = d D y + a y + b0 u" in part
    assert "^" not in part
    with pytest.raises(ftlm.DataError, match="exists"):
        chosen.report(tmp_path / "choice.html")
    data = json.loads(json.dumps(chosen.to_dict()))
    assert data["chosen"] == chosen.winner.name
    assert len(data["candidates"]) == len(chosen.trials)
    frame = chosen.to_frame()
    assert list(frame["chosen"]).count(True) == 1
    assert frame["worst_fold"].iloc[chosen.chosen_index] == min(f["y"] for f in chosen.winner.validation.values())


def test_the_command(tmp_path):
    for seed in (0, 1):
        run = motor(seed)
        table = np.column_stack([np.arange(run.length) * run.step, run["u"], run["y"]])
        np.savetxt(tmp_path / f"{seed}.csv", table, delimiter=",", header="t,u,y", comments="")
    files = [str(tmp_path / "0.csv"), str(tmp_path / "1.csv")]
    columns = ["--time", "t", "-u", "u=u", "-y", "y=y"]
    model = tmp_path / "best.json"
    done = CliRunner().invoke(
        app, ["select", *files, *columns, "--structure", "D^2 y = d D y + a y + b u", "-o", str(model), "--json"]
    )
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["chosen"] == "D^2 y = d D^1 y + a y + b u"
    assert ftlm.load_model(model).coefficients["a"] == pytest.approx(-40, rel=0.02)
    first = ["--structure", "D y = a y + b u"]
    asked = CliRunner().invoke(app, ["select", files[0], *columns, *first, "--validation", "runs"])
    assert asked.exit_code == 2
    assert "--validation runs leaves one run out at a time, but there is only one" in asked.output
    assert "or use --validation blocks" in asked.output
    by_file = CliRunner().invoke(app, ["select", files[0], *columns, *first, "--validation", files[1]])
    assert by_file.exit_code == 0, by_file.output
    assert "1, not fitted to" in by_file.output
    wrong = CliRunner().invoke(app, ["select", *files, *columns, "--structure", "auto", "--orders", "alpha=1"])
    assert wrong.exit_code == 2
    assert "--orders: options of a given structure, not used with --structure auto" in wrong.output


def test_a_fit_below_all_measure_keeps_its_column():
    assert [format_fit(v) for v in (99.123, -12.3, -1e15, -math.inf, math.nan)] == [
        "99.12",
        "-12.30",
        "< -1000",
        "< -1000",
        "nan",
    ]


def heated_plate(seed: int) -> ftlm.Run:
    """A plate at 21.4 °C that is heated from row 24 on; it is warm after half of the run."""
    t = np.arange(480) * 5.0
    truth = ftlm.Model(ftlm.equation("D y = -0.004 y + 0.0024 u"))
    power = np.where(t >= 120.0, 50.0, 0.0)
    still = ftlm.Run.from_arrays(step=5.0, inputs={"u": power}, outputs={"y": 0 * t})
    y = 21.4 + truth.simulate(still)["y"] + 0.05 * np.random.default_rng(seed).standard_normal(t.size)
    return still.with_outputs({"y": y})


def test_blocks_that_tell_nothing_are_no_folds():
    # The first quarter has the only step, and nothing moves in the last.
    folds = Folds.of(heated_plate(1), "blocks")
    assert [f.rows for f in folds.parts] == [(120, 240), (240, 360)]
    # Every quarter of a plant that is excited throughout is a fold.
    assert len(Folds.of(motor(2), "blocks").parts) == 4


def test_one_step_from_a_level_selects_the_plant():
    found = ftlm.select(heated_plate(2), "auto", threads=2)
    assert not {"no_candidate_fits", "worse_than_mean"} & {f.code for f in found.findings}
    assert found.best.model.dcgain() == pytest.approx(0.6, rel=0.01)


def test_a_masked_beginning_leaves_the_level_of_a_run_at_rest():
    # In motion about (40, 3.2) with time constant 45 rows: the first block is predicted from the other three.
    rng = np.random.default_rng(3)
    u = 40.0 + np.repeat(rng.choice([-10.0, 0.0, 10.0, 20.0], 20), 40)
    u[:40] = 40.0
    truth = ftlm.Model(ftlm.equation("D y = -0.5 y + 0.04 u"))
    run = ftlm.Run.from_arrays(step=0.05, inputs={"u": u - 40.0}, outputs={"y": 0 * u})
    y = 3.2 + truth.simulate(run)["y"] + 0.005 * rng.standard_normal(u.size)
    run = ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": y})
    structure = ftlm.equation("D y = a y + b u", offset="level")
    fold = Folds.of(run, "blocks").parts[0]
    masked = fold.estimation_runs(["y"])[0]
    assert fold.rows == (0, 200)
    assert np.isnan(masked["y"][:200]).all()
    found = ftlm.identify(masked, structure)
    assert found.coefficients == pytest.approx({"a": -0.5, "b": 0.04}, rel=0.02)
    assert fold.fit(found.model)["y"] > 97.0
