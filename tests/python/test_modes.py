"""Modes and steady states: closed forms, python-control, the argument principle, and the delta method by hand."""

import math
from dataclasses import replace

import control
import numpy as np
import pytest

import ftlm
from ftlm.analysis import dcgain, modes, polynomial_zeros, steady_states
from ftlm.analysis.poles import _mode, characteristic, order_excesses
from ftlm.analysis.polynomial_zeros import right_zeros, zeros_of
from ftlm.analysis.time_response import response
from ftlm.estimation.model_checks import has_unstable_mode, stability_findings
from ftlm.report.html_report import behavior_tables, stability_note
from ftlm.report.text_summary import behavior_lines


def model(words, covariance=None, **options):
    made = ftlm.Model(ftlm.equation(words, **options))
    if covariance is None:
        return made
    known = ftlm.Estimate("output-error", ("run",), {}, covariance=tuple(map(tuple, covariance)))
    return replace(made, estimate=known)


# ----------------------------------------------------------------------------------------------------------------------
# Where poles are


@pytest.mark.parametrize("words", ["D^2 y = -0.6 D y - 9 y + 4 u", "D^3 y = -12 D^2 y - 30 D y - 20 y + 3 D u + 7 u"])
def test_whole_orders_are_as_python_control_has_them(words):
    fitted = model(words)
    num, den = ([7.0, 3.0][::-1], [1.0, 12.0, 30.0, 20.0]) if "D^3" in words else ([4.0], [1.0, 0.6, 9.0])
    reference = control.tf(num, den)
    natural, damping, poles = control.damp(reference, doprint=False)
    upper = poles.imag >= 0
    order = np.argsort(natural[upper])
    assert [m.frequency for m in modes(fitted)] == pytest.approx(natural[upper][order].tolist(), rel=1e-9)
    assert [m.damping for m in modes(fitted)] == pytest.approx(damping[upper][order].tolist(), abs=1e-9)
    assert fitted.dcgain()[0, 0] == pytest.approx(reference.dcgain(), rel=1e-12)


def test_one_order_alone_has_its_time_constant_in_closed_form():
    for alpha in (0.4, 0.5, 0.75, 0.9, 0.9137, 1.0):
        (only,) = modes(model(f"D^{alpha} y = -2 y + u"))
        assert not only.oscillatory
        assert only.time_constant == pytest.approx(2.0 ** (-1 / alpha), rel=1e-9)
    # Above order 1 it swings: s = a^(1/alpha) exp(j pi/alpha).
    for alpha in (1.3, 1.61803, 1.9):
        (only,) = modes(model(f"D^{alpha} y = -2 y + u"))
        assert only.oscillatory
        assert only.pole == pytest.approx(2 ** (1 / alpha) * np.exp(1j * math.pi / alpha), rel=1e-9)
        assert only.damping == pytest.approx(-math.cos(math.pi / alpha), rel=1e-9)


def test_with_a_common_base_they_are_the_poles():
    for words in ("D^1.8 y = -0.6 D^0.8 y - 9 y + 4 u", "D^2.2 y = -0.625 D^0.9 y - 1.25 y + 1.25 u"):
        found = model(words)
        upper = [s for s in found.poles() if s.imag >= 0]
        assert [m.pole for m in modes(found)] == pytest.approx(upper, rel=1e-8)


def test_no_pole_is_missed_whatever_the_orders():
    rng = np.random.default_rng(3)
    counted = 0
    for _ in range(60):
        powers = np.sort(rng.uniform(0.15, 3.2, rng.integers(1, 4)))
        polynomial = {0.0: float(rng.lognormal(0, 2))}
        for p in powers[:-1]:
            polynomial[float(p)] = float(rng.choice([-1, 1]) * rng.lognormal(0, 2))
        polynomial[float(powers[-1])] = 1.0
        angle = 0.97 * math.pi
        count, near = right_zeros(polynomial, angle)
        if near:
            continue
        inside = [w for w in zeros_of(polynomial) if w.imag < angle]
        by_hand = sum(1 if w.imag < 1e-7 else 2 for w in inside)
        assert by_hand == count, polynomial
        counted += by_hand
    assert counted > 60


def test_a_coupled_model_has_the_poles_of_all_its_equations():
    arm = ftlm.link_model(stage=1)
    upper = sorted((s for s in arm.poles() if s.imag >= -1e-9), key=abs)
    assert [m.pole.real for m in arm.modes()] == pytest.approx([s.real for s in upper], rel=1e-7)
    assert [m.oscillatory for m in arm.modes()] == [True, False]


def test_what_grows_says_so():
    (swing,) = modes(model("D^2 y = 0.6 D y - 9 y + u"))
    assert swing.unstable
    assert "grows" in str(swing)
    (away,) = modes(model("D y = 2 y + u"))
    assert (away.unstable, away.oscillatory, away.time_constant) == (True, False, 0.5)
    (still,) = modes(model("D^2 y = -9 y + u"))
    assert (still.damping, still.unstable, still.time_constant) == (0.0, False, math.inf)


# ----------------------------------------------------------------------------------------------------------------------
# Where it ends


def test_steady_states_are_the_limits_of_the_step():
    (state,) = steady_states(model("D^1.8 y = -0.6 D^0.8 y - 9 y + 4 u"))
    assert state.gain == pytest.approx(4 / 9)
    (runs_on,) = steady_states(model("D^2 y = -3 D y + 6 u"))
    assert (runs_on.gain, runs_on.order, runs_on.rate) == (math.inf, 1.0, 2.0)
    (back,) = steady_states(model("D^2 y = -3 D y - 4 y + 8 D u"))
    assert (back.gain, back.order) == (0.0, -1.0)
    two = model("D y = -2 y + 3 u - 4 v")
    assert np.array_equal(two.dcgain(), [[1.5, -2.0]])
    low = np.abs(two.frequency_response([1e-9]))[:, :, 0]
    assert np.abs(dcgain(two)) == pytest.approx(low)


def test_a_sensor_that_halves_what_it_sees_halves_the_gain():
    halves = ftlm.SensorFilter(("y",), ((1.0, 0.0),), ((0.1, 1.0), (2.0, 0.0)))
    plain = ftlm.equation("D y = -2 y + 3 u")
    seen = ftlm.Model(replace(plain, sensor_filter=halves))
    assert seen.dcgain()[0, 0] == pytest.approx(0.75)
    assert seen.dcgain()[0, 0] == pytest.approx(seen.frequency_response([1e-9])[0, 0, 0].real)


# ----------------------------------------------------------------------------------------------------------------------
# How sure


def test_standard_errors_are_those_of_the_closed_form():
    # Numbers: alpha, (order, coefficient) of each term.
    spread = np.zeros((7, 7))
    spread[2, 2], spread[4, 4], spread[6, 6] = 0.03**2, 0.2**2, 0.1**2
    spread[2, 4] = spread[4, 2] = 0.5 * 0.03 * 0.2
    found = model("D^2 y = -0.6 D y - 9 y + 4 u", spread)
    (swing,) = found.modes()
    assert swing.frequency_error == pytest.approx(0.2 / 6, rel=1e-3)
    # zeta = d/(2 w), w^2 = a: d zeta = dd/(2 w) - d/(4 w^3) da, and the numbers are -d and -a.
    slope = np.array([1 / 6, -0.6 / 108])
    part = spread[np.ix_([2, 4], [2, 4])]
    assert swing.damping_error == pytest.approx(math.sqrt(slope @ part @ slope), rel=1e-3)
    # T = 2/d
    assert swing.time_constant_error == pytest.approx(2 / 0.36 * 0.03, rel=1e-3)
    (state,) = steady_states(found)
    assert state.error == pytest.approx(math.hypot(0.1 / 9, 4 / 81 * 0.2), rel=1e-3)


def test_errors_of_orders_count():
    spread = np.zeros((5, 5))
    spread[0, 0], spread[2, 2] = 0.01**2, 0.05**2
    (only,) = model("D^0.8 y = -2 y + u", spread).modes()
    # ln T = -ln(2)/alpha
    share = math.hypot(math.log(2) / 0.64 * 0.01, 1 / (0.8 * 2) * 0.05)
    assert only.time_constant_error == pytest.approx(only.time_constant * share, rel=1e-3)


def test_the_error_of_an_order_says_whether_a_steady_state_is_a_gain():
    # Numbers: alpha, order and coefficient of D^nu y, of u. The output runs on as t^nu.
    spread = np.zeros((5, 5))
    spread[1, 1], spread[4, 4] = 0.02**2, 0.1**2
    (near,) = steady_states(model("D^1.5 y = -2 D^0.03 y + 4 u", spread))
    assert (near.order, near.rate) == (pytest.approx(0.03), pytest.approx(2.0))
    assert near.order_error == pytest.approx(0.02, rel=1e-3)
    assert near.error == pytest.approx(0.05, rel=1e-3)
    words = behavior_lines(model("D^1.5 y = -2 D^0.03 y + 4 u", spread))
    assert words[0].endswith("t^0.03/Γ(1.03); order 0.030 ± 0.020, which may be 0: a gain")
    (table, _) = behavior_tables(model("D^1.5 y = -2 D^0.03 y + 4 u", spread))
    assert "which may be 0: a gain" in str(table.to_html())
    spread[1, 1] = 0.01**2
    assert behavior_lines(model("D^1.5 y = -2 D^0.03 y + 4 u", spread))[0].endswith("; order 0.0300 ± 0.0100")
    assert (
        "0.97 ± 0.10, which may be 1: an integrator"
        in behavior_lines(model("D^1.5 y = -2 D^0.97 y + 4 u", 100 * spread))[0]
    )
    # Orders that were given have no error, and alpha does not move what is left in the end.
    spread[1, 1], spread[0, 0] = 0.0, 0.1**2
    (given,) = steady_states(model("D^1.5 y = -2 y + 4 u", spread))
    assert given.order_error == 0.0
    assert behavior_lines(model("D^1.5 y = -2 y + 4 u", spread))[0].endswith("2.000 ± 0.050")


# ----------------------------------------------------------------------------------------------------------------------
# Steps and impulses


def test_a_step_is_the_closed_form_and_so_is_its_band():
    # y' = -2 y + 3 u, the pole known to 0.1: y = 3/p (1 - e^(-p t)).
    spread = np.zeros((5, 5))
    spread[2, 2] = 0.1**2
    found = model("D y = -2 y + 3 u", spread).step(np.linspace(0, 3, 301))
    t = found.time
    assert found.values[0, 0] == pytest.approx(1.5 * (1 - np.exp(-2 * t)), abs=2e-5)
    slope = -3 / 4 * (1 - np.exp(-2 * t)) + 1.5 * t * np.exp(-2 * t)
    assert found.deviation[0, 0] == pytest.approx(0.1 * np.abs(slope), abs=2e-5)
    reference = control.step_response(control.tf([3.0], [1.0, 2.0]), t).outputs
    assert found.values[0, 0] == pytest.approx(reference, abs=2e-5)
    assert "final value 1.5 ± 0.075" in str(found)
    assert "<svg" in found._repr_html_()
    assert "95 % band" in found._repr_html_()


def test_the_final_value_of_a_step_is_the_gain_of_a_stable_model():
    slow = ftlm.Model(ftlm.equation("D^0.5 T = -0.02 T + 0.05 P"))
    assert "T from P: final value 2.5, peak 1.96" in str(slow.step())
    assert slow.step().final_values == {("T", "P"): (pytest.approx(2.5), None)}
    washed_out = ftlm.Model(ftlm.equation("D y = -2 y + 3 D u"))
    assert "final value 0, peak" in str(washed_out.step())
    for text, time in {"D y = 2 u": (0, 3), "D y = 0.1 y + u": (0, 3), "D^2 y = -4 y + u": (0, 3)}.items():
        found = ftlm.Model(ftlm.equation(text)).step(np.linspace(*time, 31))
        assert "y from u: value at 3 s" in str(found)
        assert found.final_values == {}
    assert "value at" in str(slow.impulse())
    with pytest.raises(ftlm.ModelError, match="'ramp' is not known; use 'step' or 'impulse'"):
        response(slow, kind="ramp")


def test_an_impulse_is_the_mean_of_the_closed_form_over_each_interval():
    found = model("D y = -2 y + 3 u").impulse(np.linspace(0, 3, 31))
    edges = np.linspace(0, 3, 31)
    means = -np.diff(1.5 * np.exp(-2 * edges)) / 0.1
    assert found.values[0, 0] == pytest.approx(means, abs=2e-4)
    assert found.deviation is None
    assert "No covariance" in found._repr_html_()
    # Half an order: infinite at 0, and still drawn.
    half = model("D^0.5 y = -2 y + u").impulse()
    assert np.all(np.isfinite(half.values))


def test_by_default_a_step_is_seen_to_its_end():
    for words in ("D y = -2 y + 3 u", "D^2 y = -0.6 D y - 9 y + 4 u", "D^1.8 y = -0.6 D^0.8 y - 9 y + 4 u"):
        found = model(words)
        assert found.step().values[0, 0, -1] == pytest.approx(found.dcgain()[0, 0], rel=0.06)


def test_bode_is_the_frequency_response():
    found = model("D^1.8 y = -0.6 D^0.8 y - 9 y + 4 u")
    drawn = found.bode([0.1, 1.0, 10.0])
    h = found.frequency_response([0.1, 1.0, 10.0])[0, 0]
    (curve,) = drawn.curves
    assert curve.gain == pytest.approx(20 * np.log10(np.abs(h)))
    assert "y from u" in str(drawn)
    assert drawn._repr_html_().count("<figure>") == 2


# ----------------------------------------------------------------------------------------------------------------------
# What is refused


def test_bad_input_is_refused_in_words():
    with pytest.raises(ftlm.errors.ModelError, match="coupling = 'both' is not known"):
        modes(model("D y = -y + u"), coupling="both")
    rubs = ftlm.Model(ftlm.equation("D^2 y = -3 D y + 6 u - 0.5*sign(D y)"))
    for ask in (rubs.modes, rubs.dcgain):
        with pytest.raises(ftlm.errors.ModelError, match="friction"):
            ask()
    limited = ftlm.Model(ftlm.equation("D y = -2 y + 3 u").with_limits(saturation={"u": 1.0}))
    with pytest.raises(ftlm.errors.ModelError, match="saturation"):
        limited.dcgain()
    with pytest.raises(ftlm.errors.ModelError, match="saturation"):
        limited.step()
    for bad in ([0.0, 1.0], [1.0, 2.0, 3.0], [[0, 1, 2]], [0.0, 1.0, 3.0], [0.0, math.nan, 1.0]):
        with pytest.raises(ftlm.errors.DataError, match="time"):
            model("D y = -y + u").step(bad)
    for bad in ([], [-1.0], [math.inf], [[1.0]]):
        with pytest.raises(ftlm.errors.DataError, match="w "):
            model("D y = -y + u").bode(bad)
    for bad in (None, 3, "model"):
        with pytest.raises(ftlm.errors.ModelError, match="not a Model"):
            modes(bad)
    assert characteristic(limited, coupled=True)


def test_what_hardly_anything_tells_is_no_certain_decay():
    # Right of the axis, and its angle unknown: it is not turned onto the negative axis.
    growing = _mode(complex(np.log(3.0), 1.2), (0.1, 5.0, 2.0))
    assert growing.pole.real > 0
    assert growing.oscillatory
    # A little off the axis, within what its own uncertainty says: a relaxation.
    assert not _mode(complex(np.log(3.0), np.pi - 0.03), (0.1, 0.1, 0.1)).oscillatory


def test_a_dead_time_is_waited_for_and_an_order_of_nearly_0_is_0():
    late = ftlm.Model(ftlm.equation("D y = -2 y + 3 u", delay={"u": 20.0}))
    assert late.step().time[-1] > 22.0
    assert abs(late.step().values[0, 0, -1] - 1.5) < 5e-3
    nearly = ftlm.Model(ftlm.equation("D^1.8 y = -0.6 D^0.8 y - 9 D^0.00001 y + 4 u"))
    assert abs(nearly.dcgain()[0, 0] - 4 / 9) < 1e-3


#: Two equations whose highest order, 2 + 0.1, is that of their coupling, with the opposite sign: they have a growing
#: pole near 4^10 rad/s. Positions in the parameter vector: alpha 0 and 7, orders of the coupling 1 and 8.
EXCESS = "D x = 0.5 D^1.1 y - 2 x + u; D y = 0.5 D x - 3 y"


def excess_covariance(scale):
    """A covariance of the orders with correlations, of which the excess has the standard error ``scale``."""
    root = np.zeros((12, 3))
    root[[0, 1, 7, 8]] = [[1.0, 0.5, 0.0], [0.3, 2.0, 0.1], [0.0, 0.4, 1.5], [0.7, -0.2, 0.9]]
    excess = root[1] + root[8] - root[0] - root[7]
    root *= scale / np.linalg.norm(excess)
    return root @ root.T


def test_a_pole_from_an_excess_of_orders_is_one_if_the_excess_is_significant() -> None:
    for coupling in ("simulated", "measured"):
        certain, doubtful = (
            model(EXCESS, excess_covariance(scale), coupling=coupling) for scale in (0.1 / 2.5, 0.1 / 2.2)
        )
        (pole,) = (s for s in doubtful.poles() if s.real > 0)
        assert (pole + 2) * (pole + 3) == pytest.approx(0.25 * pole**2.1, rel=1e-9)
        assert [m.frequency for m in certain.modes() if m.unstable] == pytest.approx([pole.real])
        assert not any(m.unstable for m in doubtful.modes())
        assert len(certain.modes()) == len(doubtful.modes()) + 1
        (excess,) = order_excesses(doubtful, coupling="simulated")
        assert (excess.excess, excess.order_sum) == pytest.approx((0.1, 2.0))
        assert excess.error == pytest.approx(0.1 / 2.2)
        assert has_unstable_mode(certain, "simulated")
        assert not has_unstable_mode(doubtful, "simulated")
        assert [(f.code, f.level) for f in stability_findings(certain)] == [("order_excess", "with care")]
        (fact,) = stability_findings(doubtful)
        assert (fact.code, fact.level) == ("order_excess_not_significant", "fact")
        assert fact.numbers["frequency"] == pytest.approx(pole.real)
        assert stability_note(doubtful).endswith(", but not significantly.")
        assert "significantly" not in stability_note(certain)
        assert not any("grows" in line for line in behavior_lines(doubtful))
        # Without a covariance nothing is doubtful.
        assert [f.code for f in stability_findings(model(EXCESS, coupling=coupling))] == ["order_excess"]


def test_an_excess_of_orders_in_a_ring_of_equations() -> None:
    ring = "D x = 0.5 D^1.1 y - 2 x + u; D y = 0.5 D^0.9 z - 3 y; D z = 0.5 D^1.25 x - z"
    (excess,) = order_excesses(model(ring), coupling="simulated")
    assert excess.excess == pytest.approx(0.25)
    (pole,) = (s for s in model(ring).poles() if s.real > 0)
    assert [math.exp(w.real) for w in excess.poles] == pytest.approx([pole.real])
    assert order_excesses(model(ring), coupling="measured") == []
    # A coupling of the other sign has a higher order too, but no growing pole.
    assert order_excesses(model(ring.replace("0.5 D^0.9", "-0.5 D^0.9")), coupling="simulated") == []


def test_a_pole_that_remains_without_the_excess_of_orders_is_not_due_to_it() -> None:
    # The coupling exceeds the equations' own highest terms already at equal orders.
    strong = EXCESS.replace("0.5 D^1.1 y", "8 D^1.1 y")
    assert order_excesses(model(strong), coupling="simulated") == []
    assert [f.code for f in stability_findings(model(strong, coupling="simulated"))] == ["simulation_unbounded"]
    assert [f.code for f in stability_findings(model(strong, coupling="measured"))] == ["coupled_model_unstable"]


def test_zeros_of_one_polynomial_are_sought_once(monkeypatch: pytest.MonkeyPatch) -> None:
    sought = []
    for name in ("_newton_zeros", "_two_term_zeros"):
        plain = getattr(polynomial_zeros, name)
        monkeypatch.setattr(polynomial_zeros, name, lambda *a, plain=plain: (sought.append(1), plain(*a))[1])
    words = "D^1.7312 y = -0.61237 D^0.8123 y - 9.0451 y + u"
    first = modes(model(words))
    count = len(sought)
    assert count == 2
    assert modes(model(words)) == first
    assert len(stability_findings(model(words))) + len(sought) == count
    # A caller may change the returned list.
    polynomial = characteristic(model(words), coupled=True)[0]
    zeros_of(polynomial).clear()
    assert len(zeros_of(polynomial)) == len(first)
    modes(model(words.replace("9.0451", "9.0452")))
    assert len(sought) == 2 * count


def test_equations_without_a_common_solution_have_no_poles() -> None:
    dependent = model("D x = D y + u; D y = D x + u")
    with pytest.raises(ftlm.errors.ModelError, match="linearly dependent"):
        dependent.modes()
    assert behavior_lines(dependent) == []
    assert "linearly dependent" in stability_note(dependent)
    assert stability_findings(dependent) == []


def test_a_pole_beyond_the_range_of_numbers_is_none() -> None:
    # D^0.01 y = -1e-6 y has its zero at (1e-6)^(100) rad/s.
    model = ftlm.Model(ftlm.equation("D^1.01 y = -1 D y - 1e-6 D^0.99 y + u"))
    assert all(math.isfinite(m.time_constant) and m.frequency > 0 for m in modes(model))
