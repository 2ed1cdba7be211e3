"""What a run cannot know is said, or refused with a typed error; for every method that estimates through noise."""

from __future__ import annotations

import re

import numpy as np
import pytest

import ftlm
from ftlm.estimation.methods import method_with_options
from ftlm.estimation.model_checks import MAX_PARAMETER_CORRELATION, MAX_RELATIVE_STANDARD_ERROR
from ftlm.structure_selection.cross_validation import fit
from slow_cases import slow_after

WORDS = "D^alpha y = a1 D^nu y + a0 y + b0 u"
TRUTH = {"alpha": 1.8, "nu": 0.8, "a1": -2.0, "a0": -25.0, "b0": 25.0}
STEP, ROWS = 0.01, 1500
METHODS = ("output-error", "instrumental-variables")


def run(u, *, noise=0.01, name="run", units=None, output="y"):
    """The plant, of period 1.1 s, under an input."""
    u = np.asarray(u, dtype=float)
    blank = ftlm.Run.from_arrays(step=STEP, inputs={"u": u}, outputs={"y": 0 * u})
    y = ftlm.Model(ftlm.equation("D^1.8 y = -2 D^0.8 y - 25 y + 25 u")).simulate(blank, tolerance=1e-6)["y"]
    y = y + noise * max(np.std(y), 1e-3) * np.random.default_rng(0).standard_normal(u.size)
    return ftlm.Run.from_arrays(step=STEP, inputs={"u": u}, outputs={output: y}, name=name, units=units or {})


def square(rows=ROWS):
    return np.where((np.arange(rows) // 150) % 2 == 0, 1.0, -1.0)


def sine():
    return np.sin(4 * STEP * np.arange(ROWS))


def identified(runs, method, **orders):
    structure = ftlm.equation(WORDS, orders=orders)
    searched = method != "output-error" and structure.order_names
    options = {"order_grid": ftlm.order_grid(increment=0.2)} if searched else {}
    return ftlm.identify(runs, structure, method=method_with_options(method, options), threads=1)


def truth_is_inside(found, width=4.0):
    """No number is claimed more exactly than it is known."""
    values = {**found.orders, **found.coefficients}
    errors = found.standard_errors
    return all(abs(values[n] - TRUTH[n]) <= width * errors[n] for n in TRUTH)


@pytest.mark.parametrize("method", METHODS)
def test_an_input_that_is_zero_identifies_nothing(method):
    still = run(np.zeros(ROWS))
    with pytest.raises(ftlm.DataError, match=r"^u is 0 in all rows, so its coefficient in the equation of y .* remove"):
        identified(still, method)
    # Beside a run in which it moves it is a run like any other.
    assert identified([still, run(square())], method).coefficients["b0"] > 10


def test_without_the_input_a_decay_is_identified():
    t = STEP * np.arange(ROWS)
    y = np.exp(-0.4 * t) * np.cos(3 * t) + 0.002 * np.random.default_rng(0).standard_normal(ROWS)
    decay = ftlm.Run.from_arrays(step=STEP, inputs={"u": 0 * t}, outputs={"y": y})
    found = ftlm.identify(decay, ftlm.equation("D^2 y = a1 D y + a0 y"), threads=1)
    assert found.coefficients["a1"] == pytest.approx(-0.8, abs=4 * found.standard_errors["a1"])
    assert found.coefficients["a0"] == pytest.approx(-9.16, abs=4 * found.standard_errors["a0"])
    assert found.fit["y"] > 98


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("u", "fixes"), [(np.ones(ROWS), 1), (sine(), 4)])
def test_an_input_of_few_frequencies_is_counted(method, u, fixes):
    found = identified(run(u), method)
    said = f"the equation of y has 5 free parameters, but in steady state u determines only {fixes}"
    assert [w for w in found.warnings if said in w]
    if method == "output-error":
        # Correlated by more than 0.995, and yet each known to within a tenth: both can be used.
        joint = found.joint
        pair = joint.names.index("a0"), joint.names.index("b0")
        assert abs(joint.correlation[pair]) > MAX_PARAMETER_CORRELATION
        assert all(
            found.standard_errors[n] < MAX_RELATIVE_STANDARD_ERROR * abs(found.coefficients[n]) for n in ("a0", "b0")
        )
        assert not any("separately identifiable" in w for w in found.warnings)
        assert truth_is_inside(found)


@pytest.mark.parametrize("method", METHODS)
def test_a_handful_of_samples_is_refused(method):
    few = run(square()[:6])
    words = "4 samples .* do not determine 5 free parameters" if method == "output-error" else "at least 8 pulses"
    orders = {} if method == "output-error" else {"alpha": 1.8, "nu": 0.8}
    with pytest.raises(ftlm.FtlmError, match=words):
        identified(few, method, **orders)


@pytest.mark.parametrize("rows", [60, 12])
@pytest.mark.parametrize("method", METHODS)
def test_a_run_shorter_than_the_period_is_no_reason_to_believe(rows, method):
    short = run(square()[:rows])
    found = identified(short, method)
    assert any("but in steady state u determines only 1" in w for w in found.warnings)
    if method == "output-error":
        doubts = [
            w
            for w in found.warnings
            if "does not differ significantly from 0" in w
            or "identifiable" in w
            or "correlated" in w
            or "unbounded" in w
        ]
        assert len(doubts) >= 3
        assert found.profiles
        assert all(any(re.search(rf"\b{name}\b", w) for w in doubts) for name in TRUTH)
        # Where a standard error says nothing, the profile may still know a number's sign.
        assert all(low <= TRUTH[name] <= high for name, (low, high) in found.intervals.items())
        assert truth_is_inside(found)


@pytest.mark.parametrize("method", METHODS)
def test_runs_that_do_not_belong_together_are_refused(method):
    here = run(square(), units={"y": "rad"})
    with pytest.raises(ftlm.DataError, match=r"different units: signal 'y' is in 'm' and 'rad', 1 in all"):
        identified([here, run(square(), units={"y": "m"})], method)
    with pytest.raises(ftlm.DataError, match=r"different outputs: 'z' and 'y'; use rename"):
        identified([here, run(square(), output="z", units={"z": "rad"})], method)


@pytest.mark.parametrize("method", METHODS)
def test_bounds_that_hold_no_equation_are_refused_by_name(method):
    with pytest.raises(ftlm.ModelError, match=r"no orders of signal 'y' fit below alpha = 0.3; widen"):
        identified(run(square()), method, alpha="0.1:0.3:0.1", nu="2.5:2.9:0.1")


@pytest.mark.parametrize("method", METHODS)
def test_bounds_far_from_the_truth_are_said_to_be_in_the_way(method):
    found = identified(run(square()), method, alpha="0.1:0.3:0.1")
    assert any("is close to alpha = 0.3" in w for w in found.warnings)
    assert any("alpha = 0.3 is on" in w or "alpha is not identifiable" in w for w in found.warnings)
    assert any(f.code == "residuals_follow_input" for f in found.findings)


@pytest.mark.parametrize("method", METHODS)
def test_a_lattice_of_one_point_is_that_point(method):
    one = identified(run(square()), method, alpha="1.8:1.8:0.05", nu="0.8:0.8:0.05")
    known = identified(run(square()), method, alpha=1.8, nu=0.8)
    assert one.orders == {"alpha": 1.8, "nu": 0.8}
    assert one.coefficients == known.coefficients
    assert one.standard_errors == known.standard_errors
    assert set(one.standard_errors) == {"a1", "a0", "b0"}
    assert one.warnings == known.warnings
    # Instrumental variables do not refine the step, and say what it does.
    assert [w for w in one.warnings if "the discretization changes" not in w] == []


@slow_after(1, "noise, fit", [(1.0, 30), (3.2, 5)])
def test_noise_as_large_as_the_signal_widens_the_intervals(noise, fit):
    found = identified(run(square(), noise=noise), "output-error")
    assert found.fit["y"] == pytest.approx(fit, abs=2)
    assert truth_is_inside(found)
    assert any("does not differ significantly from 0" in w for w in found.warnings)
    assert any(f.code == "buried_in_noise" for f in found.findings)


def test_noise_beyond_the_instruments_is_a_typed_error_or_said():
    assert identified(run(square(), noise=1.0), "instrumental-variables").warnings
    # At 3.2 rounding decides whether a candidate converges.
    with pytest.raises(ftlm.FtlmError, match="none of 35 candidates has a finite score; check the data"):
        identified(run(square(), noise=10.0), "instrumental-variables")


def test_a_superfluous_order_does_not_run_away():
    """A fourth-order equation of a machine of order 1.2 explains at least what one of first order does."""
    t = np.arange(3000) * 0.01
    u = np.sign(np.sin(1.7 * t) + 0.4 * np.sin(5.1 * t))
    machine = ftlm.Model(ftlm.equation("D^1.2 y = -3 D^0.2 y - 2 y + 4 u"))
    y = machine.simulate(ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": 0 * t}))["y"]
    y = y + 0.02 * np.random.default_rng(2).standard_normal(t.size)
    measured = ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": y})
    lag, rich = (
        fit([measured], ftlm.equation(words), [], refine=False)
        for words in ("D y = a0 y + b u", "D^4 y = a3 D^3 y + a2 D^2 y + a1 D y + a0 y + b u")
    )
    assert rich.noise["y"] < 1.01 * lag.noise["y"]
