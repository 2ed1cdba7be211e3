"""The verdict: its rules on records whose fault is known, and the first screen that leads with it."""

import json
import math
import re
import string
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pytest
from typer.testing import CliRunner

import ftlm
from ftlm import cli
from ftlm.estimation import estimators as estimating
from ftlm.estimation import nuisance_parameters as history
from ftlm.estimation.model_validation import validate_model
from ftlm.estimation.output_error import ProfileInterval, fit_output_error
from ftlm.estimation.verdict import saved_verdict, verdict
from ftlm.findings import MAX_SUMMARY_FINDINGS, Finding, finding_catalogue, group_findings, make_finding
from ftlm.report.html_report import model_page
from loops import loop

SOURCE = Path(ftlm.__file__).parent
WORDS = "D^alpha y = a1 D^nu y + a0 y + b0 u"
PLANT = "D^1.8 y = -0.6 D^0.8 y - 9 y + 4 u"
T = np.arange(1501) * 0.02
SQUARE, CHIRP = np.sign(np.sin(2 * np.pi * T / 5 + 1e-9)), np.sin(0.15 * T**1.6)


def record(volts, words=PLANT, seed=1, noise=0.01, name="square"):
    empty = ftlm.Run.from_arrays(step=0.02, inputs={"u": volts}, outputs={"y": 0 * T}, name=name)
    y = ftlm.Model(ftlm.equation(words)).simulate(empty)["y"]
    y = y + noise * np.std(y) * np.random.default_rng(seed).standard_normal(T.size)
    return ftlm.Run.from_arrays(step=0.02, inputs={"u": volts}, outputs={"y": y}, units={"u": "V", "y": "m"}, name=name)


@pytest.fixture(scope="module")
def run():
    return record(SQUARE)


@pytest.fixture(scope="module")
def other():
    return record(CHIRP, seed=2, name="chirp")


@pytest.fixture(scope="module")
def found(run):
    return ftlm.identify(run, ftlm.equation(WORDS))


@pytest.fixture(scope="module")
def checked(found, other):
    return found.validate(other)


# ----------------------------------------------------------------------------------------------------------------------
# Records whose fault is known


def test_a_clean_record_that_predicts_another_one_is_trusted(found, checked):
    judged = verdict(found, checked)
    assert (judged.level, judged.reasons, judged.trusted) == ("trust", (), True)
    assert judged.reason.startswith("it predicts validation runs (y 98.99 %)")
    assert checked.verdict == judged == found.verdict(checked)
    assert found.verdict() == found.verdict
    assert str(checked).startswith("TRUST: ")


def test_a_large_run_does_not_hide_that_a_small_one_is_lost(found, other):
    small = ftlm.Run.from_arrays(
        step=0.02,
        inputs={"u": 0.02 * other["u"]},
        outputs={"y": -0.02 * other["y"]},
        units={"u": "V", "y": "m"},
        name="small",
    )
    checked = found.validate([other, small])
    assert checked.output_error["y"].fit > 95.0
    assert checked.verdict.level == "do not use"
    assert "on small" in checked.verdict.reason


def test_a_validation_that_leaves_much_more_is_with_care(found, checked):
    far = replace(checked, output_error={"y": replace(checked.output_error["y"], nr=0.15, fit=85.0)})
    judged = verdict(found, far)
    assert (judged.level, judged.reason.endswith("85 % on validation")) == ("with care", True)
    for own, left, level in ((1.0, 9.5, "with care"), (1.0, 4.9, "trust"), (3.0, 9.5, "trust"), (1.2, 5.9, "trust")):
        fitted = replace(found.comparison, output_error={"y": replace(found.output_error["y"], fit=100.0 - own)})
        less = replace(checked, output_error={"y": replace(checked.output_error["y"], nr=left / 100, fit=100.0 - left)})
        assert verdict(worse(found, comparison=fitted), less).level == level, (own, left)


@pytest.mark.parametrize(
    "doubt",
    [
        make_finding("input_parameter_not_identifiable", parameter="delay_u", words="delay of u"),
        make_finding("slow_motion_missing", output="y", ratio=2.0, speed=1.0, slow=0, total=9),
        make_finding("reference_weak", input="u", reference="r", f=2.0, needed=10.0),
    ],
)
def test_what_no_number_says_speaks_against_a_model(found, checked, doubt):
    doubted = replace(found, findings=(*found.findings, doubt))
    assert verdict(doubted, checked).level == "with care"


def test_without_a_validation_nothing_is_trusted(found, run):
    assert found.verdict.level == "with care"
    assert found.verdict.reasons == ("the model was not validated on another run",)
    # Its own run validates nothing.
    assert found.validate(run).verdict.reason == "the model was not validated on another run"


def test_a_missing_mode_is_with_care(other):
    words = "D^3 y = -6 D^2 y - 14 D y - 36 y + 24 u"
    poor = ftlm.identify(record(SQUARE, words), ftlm.equation("D^2 y = a1 D y + a0 y + b0 u"))
    judged = poor.validate(record(CHIRP, words, seed=3)).verdict
    assert judged.level == "with care"
    assert judged.reason == "y responds to u with more phase lag than its equation describes"
    assert judged.remedy.startswith("raise the order of the equation by 1")


def test_a_model_that_explains_nothing_is_not_to_be_used():
    poor = ftlm.identify(record(SQUARE, "D^2 y = -0.2 D y - 900 y + u", noise=1.5), ftlm.equation("D y = b u"))
    assert poor.verdict.level == "do not use"
    assert "explains little of y (fit" in poor.verdict.reason


def test_a_failed_validation_never_advises_the_method_of_the_fit(found):
    other_plant = record(CHIRP, words="D^1.8 y = -0.6 D^0.8 y - 90 y + 4 u", seed=2, name="chirp")
    lost = found.validate(other_plant).verdict
    assert lost.level == "do not use"
    assert "output-error" not in lost.sentence
    assert "output-error" not in saved_verdict(found.model, [found.model.compare(other_plant)]).sentence


def test_a_closed_loop_is_named():
    poor = ftlm.identify(loop("closed, coloured, biased", 0), ftlm.equation("D^alpha y = a y + b u"))
    judged = poor.verdict
    assert judged.level == "with care"
    assert judged.reason == "u depends on past values of y: a closed loop, which biases the estimates"
    assert "reference=" in judged.remedy


def test_a_free_run_that_grows_is_not_to_be_used():
    time = np.arange(400) * 0.02
    volts = np.sign(np.sin(2 * time))
    empty = ftlm.Run.from_arrays(step=0.02, inputs={"u": volts}, outputs={"y": 0 * time})
    y = ftlm.Model(ftlm.equation("D y = 0.3 y + u")).simulate(empty)["y"]
    y = y + 0.01 * np.random.default_rng(1).standard_normal(y.size)
    grown = ftlm.Run.from_arrays(step=0.02, inputs={"u": volts}, outputs={"y": y})
    judged = ftlm.identify(grown, ftlm.equation("D y = a y + b u")).verdict
    assert judged.level == "do not use"
    assert judged.reason == "the simulation grows without bound (1 pole with a positive real part)"


def test_numbers_that_no_run_tells_apart_are_not_to_be_used(run, monkeypatch):
    # From a given start: an automatic one finds nothing to invert.
    start = {"a1": -0.6, "a0": -9.0, "b0": 2.0, "b1": 2.0}
    monkeypatch.setattr(history, "fit_output_error", partial(fit_output_error, start=start))
    twice = ftlm.Run.from_arrays(step=0.02, inputs={"u": run["u"], "v": run["u"]}, outputs={"y": run["y"]})
    judged = ftlm.identify(twice, ftlm.equation("D^1.8 y = a1 D^0.8 y + a0 y + b0 u + b1 v")).verdict
    assert judged.level == "do not use"
    assert judged.reason == "not separately identifiable from the runs: b0 and b1"
    assert "richer input" in judged.remedy


def test_a_method_without_errors_says_nothing_of_its_numbers(run, other):
    plain = ftlm.identify(run, ftlm.equation("D^1.8 y = a1 D^0.8 y + a0 y + b0 u"), method="multi-innovation")
    assert not plain.standard_errors
    reasons = plain.validate(other).verdict.reasons
    assert "multi-innovation gives no standard errors, so the uncertainty of the parameters is unknown" in reasons


# ----------------------------------------------------------------------------------------------------------------------
# Each rule by itself: one diagnostic of the clean result is made worse


def worse(found, **parts):
    return replace(found, **parts)


def test_each_rule_finds_its_own_fault(found, checked):
    def fit(comparison, percent):
        bad = replace(comparison.output_error["y"], fit=percent, nr=1 - percent / 100)
        return replace(comparison, output_error={"y": bad})

    lost = verdict(found, fit(checked, 70.0))
    assert lost.reason == f"the fit of y drops from {found.fit['y']:.3g} % to 70 % on validation"
    assert lost.level == "with care"
    gone = verdict(found, fit(checked, 40.0))
    assert (gone.level, gone.reason) == (
        "do not use",
        "the simulation explains little of the validation run of y (fit 40 %)",
    )
    far = replace(found.comparison, output_error={"y": replace(found.output_error["y"], nr=math.inf)})
    never = verdict(worse(found, comparison=far), checked)
    assert (never.level, never.reason) == ("do not use", "the simulation overflows")
    stuck = verdict(worse(found, joint=replace(found.joint, converged=False)), checked)
    assert (stuck.level, stuck.reason) == ("with care", "the fit has not converged")
    short = verdict(worse(found, residuals=None), checked)
    assert short.reason == "the runs are too short for residual tests"


def test_a_number_is_vague_by_its_own_size(found, checked):
    names, spread = found.joint.names, found.joint.covariance.copy()
    a1, alpha = names.index("a1"), names.index("alpha")
    # Half of a1 is the limit: 0.3 of 0.6.
    for share, vague in ((0.4, False), (0.6, True)):
        spread[a1, a1] = (share * found.coefficients["a1"]) ** 2
        judged = verdict(worse(found, joint=replace(found.joint, covariance=spread, profiles={})), checked)
        assert judged.trusted != vague
        assert not vague or judged.reason.startswith("poorly identifiable from the runs: a1 = -0.6")
    spread[a1, a1], spread[alpha, alpha] = 0.0, 0.3**2
    judged = verdict(worse(found, joint=replace(found.joint, covariance=spread, profiles={})), checked)
    assert judged.reason == f"poorly identifiable from the runs: alpha = {found.orders['alpha']:.3g} ± 0.3"


def test_an_interval_without_end_speaks_against_a_delay_and_an_order(found, checked):
    late = replace(found.model, structure=found.model.structure.with_delays({"u": 0.1}))
    for name, low, high, reason in (
        ("delay_u", -math.inf, 0.3, ""),  # it may well be 0
        ("delay_u", 0.05, math.inf, "unbounded intervals: delay_u"),
        ("alpha", 1.5, math.inf, f"poorly identifiable from the runs: alpha = {found.orders['alpha']:.3g} ± "),
    ):
        open_ended = replace(found.joint, profiles={name: ProfileInterval(low, high, 0.95)})
        judged = verdict(worse(found, joint=open_ended, model=late), checked)
        assert judged.reason.startswith(reason)
        assert judged.level == ("with care" if reason else "trust")


def test_rough_intervals_are_a_fact(found, checked):
    doubted = worse(found, findings=(ROUGH,))
    assert verdict(doubted, checked).trusted
    assert doubted.warnings == (
        "the cost is not quadratic along a0, and profile-likelihood intervals would take too long: these intervals are "
        "approximate; use intervals='profile', which computes accurate intervals",
    )


#: Findings as fits give them: facts, one of weight.
ROUGH = make_finding("intervals_rough", parameter="a0")
TIED = make_finding("parameters_correlated", parameter="a0 and b0", why="correlation 0.9960")
BOUND = make_finding("on_bound", parameter="alpha", what="order alpha", value="2")


@pytest.mark.parametrize("words", ["D y = 2 u", "D^2 y = 2 u", "D^2 y = -0.3 D y + u", "D^1.5 y = -D^0.5 y + u"])
def test_an_integrator_is_no_fault(words):
    assert saved_verdict(ftlm.Model(ftlm.equation(words)), []).reasons == (
        "the model file does not state how the model was identified",
    )


def test_a_swing_that_nothing_damps_is_with_care(found, checked):
    for words in ("D^2 y = -4 y + u", "D^2.5 y = -4 D^0.5 y + u"):
        judged = saved_verdict(ftlm.Model(ftlm.equation(words)), [])
        assert judged.level == "with care"
        assert judged.reason == "an oscillation at 2 rad/s may not decay (damping 0)"
    # The damping of the clean result is 0.27; it is not told apart from 0 where its own error is half of it.
    order = found.joint.names.index("alpha")
    for spread, told in ((1e-3, True), (0.3, False)):
        covariance = np.array(found.model.estimate.covariance)
        covariance[:] = 0.0
        covariance[order, order] = spread**2
        known = replace_estimate(found.model, covariance=tuple(map(tuple, covariance.tolist())))
        judged = verdict(worse(found, model=known), checked)
        assert judged.trusted == told
        assert told or "may not decay (damping 0.27 ± " in judged.reason


#: Faults by name: words of the plant, of the structure, what else identify is given, what it finds.
FAULTS = {
    "none": ("D y = -2 y + 3 u", "D y = a0 y + b0 u", {}, []),
    "not very vague": ("D y = -2 y + 3 u", "D y = a0 y + b0 u", {}, [TIED]),
    "rough": ("D y = -2 y + 3 u", "D y = a0 y + b0 u", {}, [ROUGH]),
    "on a bound": ("D y = -2 y + 3 u", "D y = a0 y + b0 u", {}, [BOUND]),
    "a missing mode": ("D^3 y = -6 D^2 y - 14 D y - 36 y + 24 u", "D^2 y = a1 D y + a0 y + b0 u", {}, []),
    "no errors": ("D y = -2 y + 3 u", "D y = a0 y + b0 u", {"method": "multi-innovation"}, []),
    "errors of instruments": (
        "D y = -2 y + 3 u",
        "D y = a0 y + b0 u",
        {"method": "instrumental-variables"},
        [],
    ),
    "explains nothing": ("D^2 y = -0.2 D y - 900 y + u", "D y = b u", {}, []),
    "undamped": ("D^2 y = -4 y + u", "D^2 y = a0 y + b0 u", {}, []),
    "integrates": ("D y = 3 u", "D y = b0 u", {}, []),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_saved_model_is_judged_as_its_result_was(fault, tmp_path, monkeypatch):
    plant, words, given, doubts = FAULTS[fault]
    real = estimating.identifiability_findings
    monkeypatch.setattr(estimating, "identifiability_findings", lambda *args: [*real(*args), *doubts])
    found = ftlm.identify(record(SQUARE, plant), ftlm.equation(words), **given)
    other = record(CHIRP, plant, seed=2, name="chirp")
    saved = ftlm.load_model(found.model.save(tmp_path / "m.json"))
    for runs in ([], [other]):
        live = verdict(found, found.validate(runs) if runs else None)
        judged = saved_verdict(saved, [validate_model(saved, run) for run in runs])
        assert (judged.level, judged.reasons) == (live.level, live.reasons)
        assert live.trusted == (bool(runs) and fault in TRUSTED)


TRUSTED = ("none", "not very vague", "rough", "errors of instruments", "integrates")


def test_a_saved_model_keeps_the_records(found, tmp_path):
    path = tmp_path / "m.json"
    document = json.loads(found.model.save(path).read_text("utf-8"))
    assert document["estimate"]["verdict_findings"] == []
    for bad in ([{"level": "trust", "reason": "x"}], [{"values": {}}], ["x"], {}, [{"code": 3}], [{"code": "later"}]):
        document["estimate"]["verdict_findings"] = bad
        path.write_text(json.dumps(document), encoding="utf-8")
        with pytest.raises(ftlm.DataError, match="is not an ftlm model"):
            ftlm.load_model(path)
    # A finding that lacks its numbers is shown by its code.
    document["estimate"]["verdict_findings"] = [{"code": "poor_fit"}]
    path.write_text(json.dumps(document), encoding="utf-8")
    judged = saved_verdict(ftlm.load_model(path), [])
    assert (judged.level, judged.reason) == ("do not use", "poor_fit")


def test_findings_survive_a_file(found, tmp_path):
    infinite = make_finding("explains_little", output="y", nr=math.inf)
    kept = replace_estimate(found.model, findings=(infinite.to_file(), BOUND.to_file()))
    read = ftlm.load_model(kept.save(tmp_path / "m.json")).estimate.findings
    assert [f.text for f in read] == [infinite.text, BOUND.text]
    assert read[0].text == "y: the simulation explains little of the output (normalized residual inf)"
    assert read[0].to_dict()["level"] == "do not use"


def test_residuals_below_a_thousandth_of_the_output_decide_nothing(found, checked):
    tests = found.residuals.outputs["y"]
    follows = {"u": replace(tests.inputs["u"], passed=False)}
    red = replace(tests, whiteness=replace(tests.whiteness, passed=False), inputs=follows)
    for nr, trusted in ((0.01, False), (0.0009, True)):
        part = replace(found.residuals, outputs={"y": replace(red, nr=nr)})
        assert verdict(worse(found, residuals=part), checked).trusted == trusted
    # Colored noise that follows no input is a fact.
    part = replace(found.residuals, outputs={"y": replace(red, inputs=tests.inputs)})
    assert verdict(worse(found, residuals=part), checked).trusted
    part = replace(found.residuals, outputs={"y": replace(tests, inputs=follows)})
    assert verdict(worse(found, residuals=part), checked).reason == (
        "residuals are correlated with inputs (y with u): the model is incomplete"
    )


def test_a_hidden_offset_is_named(found, checked):
    past = [{"y": {0.5: 1.0}}]
    hidden = worse(found, comparison=replace(found.comparison, offsets=({"y": {}},), initial=past))
    judged = verdict(hidden, checked)
    assert judged.level == "with care"
    assert judged.reason == "the offset of y is not separately identifiable from the initial conditions"
    assert "offset in the equation of y in square: not separately identifiable" in str(hidden)


def test_a_run_in_motion_says_so(found):
    moving = worse(found, comparison=replace(found.comparison, initial=[{"y": {0.0: 1.0, 1.0: 2.0}}]))
    assert "nonzero initial conditions, initial terms estimated (their number): square (2)" in str(moving)
    assert "in motion" not in str(found)


def test_what_may_not_be_used_comes_before_what_needs_care(found):
    poor = worse(
        found,
        joint=replace(found.joint, converged=False),
        comparison=replace(found.comparison, output_error={"y": replace(found.output_error["y"], nr=0.8, fit=20.0)}),
    )
    judged = poor.verdict
    assert judged.level == "do not use"
    assert len(judged.reasons) == 3
    assert judged.reasons[0] == judged.reason
    assert "not validated" in judged.reasons[-1]


@pytest.mark.parametrize("bad", [3, "chirp", [], {}])
def test_what_is_no_validation_is_refused(found, bad):
    for ask in (found.verdict, found.summary):
        with pytest.raises(ftlm.errors.ModelError, match=r"give what validate\(run\) returns"):
            ask(bad)


# ----------------------------------------------------------------------------------------------------------------------
# Warnings in groups


def test_nothing_reads_a_sentence():
    """Severity is in codes: no module searches the words of findings, warnings, reasons or remedies."""
    words = r"(?:warning|finding|concern|reason|remedy|sentence|\.text)s?(?:\[\d+\])?"
    methods = "startswith|endswith|removeprefix|partition|split|find"
    searches = re.compile(
        rf"""["'] (?:not )?in (?:\w+\.)?{words}\b|\b{words}\.(?:{methods})\("""
        rf"""|re\.\w+\([^)]*\b{words}\)|\bin w\b.* for w in .*warnings"""
    )
    found = [
        (path.relative_to(SOURCE).as_posix(), line.strip())
        for path in sorted(SOURCE.rglob("*.py"))
        for line in path.read_text(encoding="utf-8").splitlines()
        if searches.search(line)
    ]
    assert found == []
    assert searches.search('own = [w for w in fit.warnings if "are not white" in w or "x" in warnings]')
    assert searches.search("name = warning.partition(';')")


def test_an_edited_sentence_changes_no_verdict(found, checked, monkeypatch, tmp_path):
    poor = replace(found, findings=(BOUND, TIED, make_finding("offset_missing", output="y", share=30.0, test="x")))
    model = replace_estimate(found.model, findings=(BOUND.to_file(),), verdict_findings=(BOUND.to_file(),))
    before = verdict(poor, checked), saved_verdict(model, [])
    for code, kind in finding_catalogue().kinds.items():
        reason = f"{code} a closed loop" if kind.reason else ""
        monkeypatch.setitem(
            finding_catalogue().kinds, code, replace(kind, template="grows without bound| is quantized", reason=reason)
        )
    after = verdict(poor, checked), saved_verdict(model, [])
    assert [v.level for v in after] == [v.level for v in before]
    assert [len(v.reasons) for v in after] == [len(v.reasons) for v in before]
    assert poor.warnings == ("grows without bound is quantized",) * 3
    again = replace(found.model, estimate=model.estimate).save(tmp_path / "m.json")
    assert saved_verdict(ftlm.load_model(again), []).level == before[1].level


@pytest.mark.parametrize(
    "name", ["before the rig stopped", "psf, a channel that was off; a closed loop", "{code} | %s"]
)
def test_the_name_of_a_run_is_no_reason(found, checked, name):
    noted = make_finding("data_note", run=name, text=f"resampled as {name}")
    judged = verdict(replace(found, findings=(noted,)), checked)
    assert judged.trusted
    assert noted.text == f"run {name}: resampled as {name}"
    fallen = make_finding("fit_falls", run=name, output=name, before=99.0, after=50.0, where="")
    assert fallen.text.startswith(f"{name}: the fit of {name} drops from 99 % on")


def test_every_entry_of_the_catalogue_renders():
    fields = {"run": "r", "output": "y", "input": "u", "parameter": "a", "method": "least-squares"}
    for code, kind in finding_catalogue().kinds.items():
        assert kind.topic in finding_catalogue().topics
        topic = finding_catalogue().topics[kind.topic]
        templates = "".join((kind.template, kind.reason, kind.remedy, kind.prefix, topic.remedy, topic.alternative))
        names = {n.partition("[")[0] for _, n, _, _ in string.Formatter().parse(templates) if n}
        numbers = dict.fromkeys(names - {*fields, "ask", "choose", "remedy", "signal"}, 1)
        item = Finding(code, **fields, numbers=numbers)
        for said in (item.text, item.reason, item.remedy):
            assert said != code
            assert not set("{}|") & set(said), (code, said)
        assert item.text


def test_remedies_know_the_method():
    for method, remedy in (
        ("least-squares", "add a missing input, a delay or a term; or use identify with method='output-error'"),
        ("output-error", "add a missing input, a delay or a term"),
    ):
        assert Finding("explains_little", method=method).remedy == remedy


def test_findings_are_grouped_the_most_serious_first():
    said = [
        make_finding("output_not_white", output="theta11", statistic=3.0, lags=25, limit=2.0),
        make_finding("order_on_edge", parameter="alpha", value=1.6),
        make_finding("residuals_follow_input", output="theta11", input="I1", value=0.3, lag=1, limit=0.1),
        make_finding("simulation_unbounded", stability="not stable: 1 pole", poles="1 pole"),
        make_finding("data_note", run="r", text="time read in ms, as the header 'time [ms]' says"),
    ]
    found = group_findings([*said, said[0]])
    assert [g.first_finding.kind.topic for g in found] == ["unstable", "residuals", "bound", "other"]
    assert found[1].findings == (said[0], said[2])
    assert found[1].count == " (and 1 more alike)"
    assert sum(len(g.findings) for g in found) == len(said)
    assert group_findings([]) == ()
    # What is of no topic stands alone.
    notes = [make_finding("data_note", text=text) for text in ("this", "that")]
    assert [g.findings for g in group_findings(notes)] == [(notes[0],), (notes[1],)]


def test_the_first_screen_has_three_groups_and_says_where_the_rest_is(found):
    many = (
        *(make_finding("prior_shifts_estimate", output="y", prior=k, share=3.0, length=7) for k in range(3)),
        BOUND,
        make_finding("coefficient_law_broken", parameter="a", value=1.0, wanted=2.0),
        make_finding("quantised", run="r", output="y", step=1.0, noise=0.1),
        make_finding("loop_found", output="y", input="u", ratio=9.0, effect=""),
    )
    poor = worse(found, findings=many)
    text = str(poor)
    assert sum(line.startswith("! ") for line in text.splitlines()) == MAX_SUMMARY_FINDINGS == 3
    assert "! y: u depends on past values of y" in text
    assert "(4 more warnings: print(result.details()))" in text
    assert all(f"warning: {w}" in poor.details() for w in poor.warnings)
    assert poor.findings == many


# ----------------------------------------------------------------------------------------------------------------------
# The first screen


def test_the_first_screen_has_verdict_model_behaviour_and_both_fits(found, checked, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    text = found.summary(checked)
    lines = text.splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 120
    assert lines[0].startswith("TRUST: ")
    assert lines[2].startswith(f"D^{found.orders['alpha']:.4f} y = ")
    for word in (
        "gain   y from u: 0.44",
        "m/V",
        "mode ",
        "damping 0.26",
        "pole -0.9",
        "estimation",
        "validation",
        f"s^{-round(found.orders['alpha'], 4):g} m/V",
    ):
        assert word in text, word
    assert "not tried" in str(found)
    assert str(found) == found.summary()


def test_delay_offset_and_friction_stand_in_the_equation():
    time = np.arange(1201) * 0.01
    volts = np.sign(np.sin(2 * time))
    late = np.sign(np.sin(2 * np.maximum(time - 0.1, 0)))
    empty = ftlm.Run.from_arrays(step=0.01, inputs={"u": late}, outputs={"y": 0 * time})
    y = ftlm.Model(ftlm.equation("D y = -2 y + 3 u")).simulate(empty)["y"]
    y = y + 0.2 + 0.01 * np.random.default_rng(1).standard_normal(y.size)
    run = ftlm.Run.from_arrays(step=0.01, inputs={"u": volts}, outputs={"y": y}, units={"u": "V", "y": "rad"})
    structure = ftlm.equation("D y = a y + b u + c").with_delays({"u": (0.0, 0.3)})
    found = ftlm.identify(run, structure)
    (equation,) = [line for line in str(found).splitlines() if line.startswith("D^1 y = ")]
    assert "u(t - 0.0" in equation or "u(t - 0.1" in equation
    # The offset of this run, as a number: 0.2 rad times 2 a second.
    assert float(equation.rpartition("+ ")[2]) == pytest.approx(0.4, abs=0.05)
    assert "delay_u" in str(found)
    rubs = ftlm.Model(ftlm.equation("D^2 y = -3 D y + 6 u - 0.5*sign(D y)"))
    assert "- 0.5 sign(D y)" in str(rubs)


def test_json_and_page_say_the_same(found, checked, other, tmp_path):
    document = json.loads(json.dumps(verdict(found, checked).to_dict()))
    assert document["level"] == "trust"
    html = found._repr_html_()
    assert "<strong>With care</strong>: the model was not validated on another run" in html
    assert html.index("With care") < html.index("<math>")
    assert "<strong>Trust</strong>" in checked._repr_html_()
    page = found.report(tmp_path / "r.html", validation=other).read_text("utf-8")
    assert page.index("Trust") < page.index("<math>") < page.index("Residuals</h2>")


def test_a_saved_model_is_judged_by_what_its_file_knows(found, other, run, tmp_path):
    saved = ftlm.load_model(found.model.save(tmp_path / "m.json"))
    assert saved_verdict(saved, [saved.compare(other)]).level == "trust"
    for seen in ([], [saved.compare(run)]):
        assert saved_verdict(saved, seen).reason == "the model was not validated on another run"
    page = model_page(saved, tmp_path / "m.html", validation=other).read_text("utf-8")
    assert page.index("Trust") < page.index("<math>")
    bare = replace(saved, estimate=None)
    assert saved_verdict(bare, []).reason == "the model file does not state how the model was identified"
    estimate = replace_estimate(saved, standard_errors={**saved.estimate.standard_errors, "b0": None})
    judged = saved_verdict(estimate, [])
    assert (judged.level, judged.reason) == ("do not use", "not separately identifiable from the runs: b0")
    warned = replace_estimate(saved, verdict_findings=(BOUND,))
    assert saved_verdict(warned, [saved.compare(other)]).reason == (
        "an order or another parameter is on its bound: order alpha = 2 is on its bound"
    )
    better = replace_estimate(saved, fit={"y": 130.0})
    assert "drops from 130 % to" in saved_verdict(better, [saved.compare(other)]).reason
    grown = ftlm.Model(ftlm.equation("D y = 0.3 y + u"))
    assert saved_verdict(grown, []).level == "do not use"


def replace_estimate(model, **changes):
    return replace(model, estimate=msgspec.structs.replace(model.estimate, **changes))


def test_the_command_line_has_verdict_validation_and_more(run, other, tmp_path):
    run.to_csv(tmp_path / "run.csv")
    other.to_csv(tmp_path / "other.csv")
    words = ["identify", str(tmp_path / "run.csv"), "--structure", "D^1.8 y = a1 D^0.8 y + a0 y + b0 u"]
    alone = CliRunner().invoke(cli.app, words)
    assert alone.exit_code == 0, alone.output
    assert alone.output.startswith("WITH CARE: the model was not validated on another run")
    assert len(alone.output.splitlines()) < 24
    both = CliRunner().invoke(cli.app, [*words, "--validation", str(tmp_path / "other.csv"), "-v"])
    assert both.output.startswith("TRUST: it predicts validation runs (y ")
    assert "equation error" in both.output
    assert "validation on chirp" in both.output
    document = json.loads(CliRunner().invoke(cli.app, [*words, "--json"]).output)
    assert document["verdict"]["level"] == "with care"


# ----------------------------------------------------------------------------------------------------------------------
# Levels: records whose fault is known to be none


def integrator_record(seed, pole=0.0, noise=0.05):
    """The level of a tank under steps that were drawn beforehand, or one that grows."""
    rng = np.random.default_rng([seed, 41])
    u = np.repeat(rng.integers(-3, 4, 24), 25).astype(float)
    gain = math.expm1(0.02 * pole) / pole if pole else 0.02
    level = np.zeros(u.size)
    for k in range(1, u.size):
        level[k] = math.exp(0.02 * pole) * level[k - 1] + gain * u[k - 1]
    return ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": level + noise * rng.standard_normal(u.size)})


def test_an_integrator_is_no_growth_by_chance():
    positive = 0
    for seed in range(8):
        found = ftlm.identify(integrator_record(seed), ftlm.equation("D y = a0 y + b u"))
        positive += found.coefficients["a0"] > 0
        codes = [f.code for f in found.findings]
        assert ("instability_not_significant" in codes) == (found.coefficients["a0"] > 0)
        assert found.verdict.level == "with care"
        assert saved_verdict(found.model, []).level == "with care"
    assert positive >= 2


def double_integrator_record(seed, stiffness=0.0):
    """The position of a mass under a force that was drawn beforehand, on a spring that may push instead of pull."""
    rng = np.random.default_rng([seed, 43])
    force = np.cumsum(rng.standard_normal(400)) * 0.2
    blank = ftlm.Run.from_arrays(step=0.02, inputs={"u": force}, outputs={"y": 0 * force})
    position = ftlm.Model(ftlm.equation(f"D^2 y = {-stiffness:g} y + 2 u")).simulate(blank)["y"]
    noise = 0.01 * position.std() * rng.standard_normal(400)
    return ftlm.Run.from_arrays(step=0.02, inputs={"u": force}, outputs={"y": position + noise})


def test_a_double_integrator_is_no_growth_by_chance():
    # Its poles meet at 0, where their errors of first order are far too small.
    unstable = 0
    for seed in range(8):
        found = ftlm.identify(double_integrator_record(seed), ftlm.equation("D^2 y = a1 D y + a0 y + b u"))
        unstable += found.model.stability().unstable_poles > 0
        assert found.verdict.level == "with care", found.verdict
    assert unstable >= 4


def test_a_spring_that_pushes_grows():
    for seed in range(4):
        found = ftlm.identify(double_integrator_record(seed, -0.25), ftlm.equation("D^2 y = a1 D y + a0 y + b u"))
        assert found.verdict.level == "do not use"
        assert "simulation_unbounded" in [f.code for f in found.findings]


def test_a_pole_that_grows_is_still_found():
    found = ftlm.identify(integrator_record(1, pole=0.15), ftlm.equation("D y = a0 y + b u"))
    assert found.verdict.level == "do not use"
    assert "simulation_unbounded" in [f.code for f in found.findings]
    assert saved_verdict(found.model, []).level == "do not use"


def test_a_noise_with_a_color_is_a_fact(other):
    rng = np.random.default_rng(3)
    run = record(SQUARE, noise=0.0)
    noise = np.zeros(T.size)
    for k, w in enumerate(rng.standard_normal(T.size)):
        noise[k] = 0.9 * noise[k - 1] + 0.005 * w
    red = ftlm.Run.from_arrays(step=0.02, inputs={"u": run["u"]}, outputs={"y": run["y"] + noise}, units=run.units)
    found = ftlm.identify(red, ftlm.equation("D^1.8 y = a1 D^0.8 y + a0 y + b0 u"))
    assert [f.level for f in found.findings if f.code == "noise_coloured"] == ["fact"]
    assert "residuals_not_white" not in [f.code for f in found.findings]
    assert found.validate(other).verdict.trusted


def test_a_machine_that_stands_still_has_no_outliers_and_no_dead_channel():
    # A motor with a tachometer whose dead band makes its rest exact, for a third of the run.
    rng = np.random.default_rng(9)
    u = np.repeat([*rng.uniform(-2, 2, 10), *[0.0] * 10, *rng.uniform(-2, 2, 10)], 40)
    speed = np.zeros(u.size)
    for k in range(1, u.size):
        speed[k] = 0.9 * speed[k - 1] + 0.1 * u[k - 1]
    read = speed + 0.01 * rng.standard_normal(u.size)
    read[np.abs(speed) < 0.02] = 0.0
    run = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"w": read})
    found = ftlm.identify(run, ftlm.equation("D w = a w + b u"))
    assert not {"outliers", "outliers_dominate", "channel_off"} & {f.code for f in found.findings}
    # A channel that is off while the motor moves is one.
    off = speed + 0.01 * rng.standard_normal(u.size)
    off[900:1000] = 0.0
    dead = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"w": off})
    assert "channel_off" in dead.advice().codes


@pytest.mark.parametrize(("level", "input_level"), [(0.0, 0.0), (21.3, 0.0), (0.0, 2.0)])
def test_a_rest_before_the_input_moves_is_a_rest_at_any_level(level, input_level):
    u = np.repeat([0.0, 1.0, -1.0], [150, 200, 250])
    y = np.zeros(u.size)
    for k in range(1, u.size):
        y[k] = 0.97 * y[k - 1] + 0.03 * u[k - 1]
    run = ftlm.Run.from_arrays(step=0.01, inputs={"u": u + input_level}, outputs={"y": y + level})
    assert "channel_off" not in run.advice().codes
