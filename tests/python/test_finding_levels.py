"""Findings that weigh as much as they show: noise that buries, a coupling that is left out, a design in doubt."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lsim, lti

import ftlm
from ftlm.estimation.identify import arm_findings
from ftlm.findings import LEVEL_DO_NOT_USE, LEVEL_WITH_CARE, group_findings, make_finding
from slow_cases import slow_after

STEP = 0.05


def steps(g, rows, hold=10):
    return np.repeat(g.choice([-1.0, 1.0], rows // hold), hold)


def lag(u, gain=1.5, pole=2.0):
    return lsim(lti([gain * pole], [1.0, pole]), u, STEP * np.arange(u.size), interp=False)[1]


def codes(found):
    return [f.code for f in found.findings]


@pytest.mark.parametrize("seed", range(20, 28))
def test_a_right_model_under_large_noise_is_buried_and_not_useless(seed):
    g = np.random.default_rng(seed)
    u = steps(g, 3000)
    y = lag(u)
    run = ftlm.Run.from_arrays(step=STEP, inputs={"u": u}, outputs={"y": y + 2 * np.std(y) * g.standard_normal(u.size)})
    found = ftlm.identify(run, ftlm.equation("D y = a y + b u", initial="rest"))
    assert "explains_little" not in codes(found)
    assert "buried_in_noise" in codes(found)
    assert found.verdict.level == LEVEL_WITH_CARE
    assert "output-error" not in found.verdict.sentence


def test_a_model_that_explains_nothing_stays_useless():
    g = np.random.default_rng(3)
    run = ftlm.Run.from_arrays(step=STEP, inputs={"u": steps(g, 3000)}, outputs={"y": g.standard_normal(3000)})
    found = ftlm.identify(run, ftlm.equation("D y = a y + b u", initial="rest"))
    assert "buried_in_noise" not in codes(found)
    assert found.verdict.level == LEVEL_DO_NOT_USE


@slow_after(1, "seed", range(30, 34))
def test_an_input_that_no_equation_reads_is_named_with_the_option(seed):
    g = np.random.default_rng(seed)
    u, other = steps(g, 1500), steps(g, 1500, 15)
    y = lag(u) + 0.3 * lag(other, pole=4.0)
    run = ftlm.Run.from_arrays(
        step=STEP, inputs={"u": u, "v": other}, outputs={"y": y + 0.02 * np.std(y) * g.standard_normal(u.size)}
    )
    found = ftlm.identify(run, ftlm.equation("D y = a y + b u", initial="rest"))
    said = next(f for f in found.findings if f.code == "coupling_missing")
    assert (said.output, said.input) == ("y", "v")
    assert "cross_stage='torques'" in said.remedy
    whole = ftlm.identify(run, ftlm.equation("D^2 y = a D y + c y + b u + d D u + e v + f D v", initial="rest"))
    assert "coupling_missing" not in codes(whole)
    # A prediction from the model that lacks it says so.
    design = ftlm.design_input(found, duration=20.0)
    assert [f.code for f in design.findings] == ["prediction_in_doubt"]
    assert "correlated with v" in design.findings[0].text


def weighed(found):
    """Levels, codes and levels of verdict, which no name or unit may change."""
    return found.verdict.level, sorted((f.level, f.code) for f in found.findings)


@slow_after(2, "fault", ["none", "order", "noise", "outliers"])
def test_verdicts_do_not_depend_on_names_scales_or_the_order_of_runs(fault):
    def runs_of(inside="u", outside="y", names=("first", "second"), scale=(1.0, 1.0)):
        runs = []
        for k, name in enumerate(names):
            g = np.random.default_rng([k, 9])
            u = np.concatenate([np.zeros(10), steps(g, 600)])
            y = (
                lag(u)
                if fault != "order"
                else lsim(lti([9.0], [1.0, 1.0, 9.0]), u, STEP * np.arange(u.size), interp=False)[1]
            )
            y = y + (2.0 if fault == "noise" else 0.02) * np.std(y) * g.standard_normal(u.size)
            if fault == "outliers":
                y[g.choice(np.arange(20, 600), 6)] += 5 * np.std(y)
            columns = {"inputs": {inside: scale[0] * u}, "outputs": {outside: scale[1] * y}}
            runs.append(ftlm.Run.from_arrays(step=STEP, name=name, **columns))
        return runs

    usual = weighed(ftlm.identify(runs_of(), ftlm.equation("D y = a y + b u")))
    # Names that messages contain.
    named = runs_of("not_white", "residuals", ("outliers", "a closed loop"))
    assert weighed(ftlm.identify(named, ftlm.equation("D residuals = a residuals + b not_white"))) == usual
    scaled = runs_of(scale=(2.0**-10, 2.0**12))
    assert weighed(ftlm.identify(scaled, ftlm.equation("D y = a y + b u"))) == usual
    assert weighed(ftlm.identify(runs_of()[::-1], ftlm.equation("D y = a y + b u"))) == usual


@pytest.mark.parametrize("row", [0, -1])
def test_an_outlier_at_an_end_of_the_run_is_named_and_not_taken_for_a_poor_model(row):
    g = np.random.default_rng(4)
    u = np.concatenate([np.zeros(20), steps(g, 400)])
    y = lag(u) + 0.01 * g.standard_normal(u.size)
    y[row] = 30.0
    found = ftlm.identify(
        ftlm.Run.from_arrays(step=STEP, inputs={"u": u}, outputs={"y": y}), ftlm.equation("D y = a y + b u")
    )
    assert found.coefficients["a"] == pytest.approx(-2.0, rel=0.02)
    assert "end_row_far_off" in codes(found)
    assert not {"explains_little", "buried_in_noise"} & set(codes(found))
    assert found.verdict.level == LEVEL_WITH_CARE
    assert found.verdict.reason.startswith("the first or the last row of y is an outlier")


def test_a_flexible_link_names_what_it_leaves_out_of_an_arm():
    left = [make_finding("residuals_not_white", output="theta11")]
    friction, link = arm_findings(ftlm.flexible_link(stage=1), left)
    assert "dry friction of the hubs" in friction.text
    assert "friction=" in friction.remedy
    assert "cross_stage" not in friction.remedy
    assert "the other link" in link.text
    assert "cross_stage='inertial'" in link.remedy
    # It leads what shares its topic.
    assert group_findings([*left, friction])[0].first_finding is friction
    both = ftlm.flexible_link(stage="both", coupling="simulated", friction=True, cross_stage="inertial")
    assert arm_findings(both, left) == []
    assert arm_findings(ftlm.flexible_link(stage=1), []) == []
    # A deflection that follows measured hubs of both stages omits neither.
    inertial = ftlm.flexible_link(stage=1, cross_stage="inertial", coupling="measured")
    deflection = replace(inertial, equations=inertial.equations[1:])
    assert arm_findings(deflection, [make_finding("residuals_not_white", output="theta12")]) == []
    assert arm_findings(ftlm.equation("D y = a y + b u"), left) == []
