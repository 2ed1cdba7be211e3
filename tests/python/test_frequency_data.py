"""Frequency responses and impedance spectra: strangers' files, truth within intervals, exact slopes, bad input."""

from __future__ import annotations

import json
import math
import re
import warnings

import numpy as np
import pytest
from scipy.optimize import curve_fit
from scipy.optimize import minimize as scipy_minimize
from typer.testing import CliRunner

import circuits
import ftlm
import ftlm.plot
from ftlm import _core
from ftlm.cli.main import app
from ftlm.estimation.frequency_domain import ResponseProblem

ARC = "D^alpha U = a U + r D^alpha I + b I"
W = np.geomspace(0.06, 6e4, 60)
#: A resistor of 10 mΩ before an arc of 50 mΩ, 10 ms, 0.8: its equation's coefficients.
TRUTH = {"alpha": 0.8, "a": -(1e-2**-0.8), "r": 0.01, "b": 0.06 * 1e-2**-0.8}


def noisy(values, share, seed):
    rng = np.random.default_rng(seed)
    return values * (1 + share * (rng.standard_normal(values.size) + 1j * rng.standard_normal(values.size)))


def arc(seed=0, share=0.01, **options):
    values = circuits.zarc(W, 0.01, 0.05, 1e-2, 0.8)
    values = noisy(values, share, seed) if share else values
    return ftlm.FrequencyData.from_arrays(W, values, unit="Ω", output="U", input="I", name="cell", **options)


def run_command(*words):
    return CliRunner().invoke(app, list(map(str, words)), env={"COLUMNS": "200", "NO_COLOR": "1"})


# ------------------------------------------------------------------------------------------------ closed forms

#: Equation, response in closed form, what its numbers are, what else is said.
CLOSED = {
    "randles": ("D U = a U + r D I + b I", circuits.randles(W, 0.01, 0.05, 2.0), {"a": -10.0, "r": 0.01, "b": 0.6}, {}),
    "arc": (ARC, circuits.zarc(W, 0.01, 0.05, 1e-2, 0.8), TRUTH, {}),
    "constant phase": ("D^alpha U = b I", circuits.cpe(W, 2.0, 0.7), {"alpha": 0.7, "b": 0.5}, {}),
    "diffusion": (
        "D^(alpha+0.5) U = a D^0.5 U + r D^(alpha+0.5) I + b D^0.5 I + c D^alpha I + d I",
        circuits.warburg(W, 0.01, 0.05, 1e-2, 0.8, 0.02),
        {**TRUTH, "c": 0.02, "d": 0.02 * 1e-2**-0.8},
        {},
    ),
    "cable": (
        "D^alpha U = a U + l D^(alpha+1) I + r D^alpha I + k D I + b I",
        1e-6 * 1j * W + circuits.zarc(W, 0.01, 0.05, 1e-2, 0.8),
        {**TRUTH, "l": 1e-6, "k": 1e-6 * 1e-2**-0.8},
        {},
    ),
    "delay": (
        "D^alpha y = a1 D^beta y + a0 y + b1 D^gamma u + b0 u",
        circuits.transfer(W[:40], [(3, 0.4), (5, 0)], [(1, 2.2), (2, 1.1), (5, 0)], 0.02),
        {"alpha": 2.2, "beta": 1.1, "gamma": 0.4, "a1": -2.0, "a0": -5.0, "b1": 3.0, "b0": 5.0, "delay_u": 0.02},
        {"delay": {"u": (0.0, 0.2)}},
    ),
}


@pytest.mark.parametrize("name", CLOSED)
def test_a_response_in_closed_form_gives_its_numbers_back(name):
    words, response, truth, options = CLOSED[name]
    data = ftlm.FrequencyData.from_arrays(W[: response.size], response)
    found = ftlm.identify_frequency(data, words, **options)
    assert found.converged
    assert set(found.values) == set(truth)
    for number, value in truth.items():
        assert found.values[number] == pytest.approx(value, rel=1e-6, abs=1e-9), number
    model = found.model.frequency_response(data.frequency)[0, 0]
    assert np.max(np.abs(model / response - 1)) < 1e-7


@pytest.mark.parametrize("name", CLOSED)
def test_slopes_are_those_of_differences(name):
    words, response, truth, options = CLOSED[name]
    data = ftlm.FrequencyData.from_arrays(W[: response.size : 7], response[::7], output="o", input="i")
    structure = ftlm.equation(re.sub(r"\bU\b|\by\b", "o", re.sub(r"\bI\b|\bu\b", "i", words)))
    structure = structure.with_delays({"i": (0.0, 0.2)} if options else {})
    problem = ResponseProblem(structure, [data], [1 / np.abs(data.response)])
    seconds = 1.1 * np.array([truth[n.replace("delay_i", "delay_u")] for n in problem.names])
    values = problem.in_problem_units(seconds)
    _, slopes = problem.residuals(values)
    own = problem.jacobian_in_seconds(values, slopes)
    np.testing.assert_allclose(problem.in_seconds(values), seconds, rtol=1e-12)
    for k, at in enumerate(seconds):
        step = 1e-6 * max(abs(at), 1e-3)
        ends = []
        for side in (step, -step):
            moved = seconds.copy()
            moved[k] += side
            ends.append(problem.residuals(problem.in_problem_units(moved), jacobian=False)[0])
        naive = (ends[0] - ends[1]) / (2 * step)
        assert np.max(np.abs(own[:, k] - naive)) < 1e-5 * np.max(np.abs(naive)), problem.names[k]


def test_known_coefficients_follow_free_orders_in_seconds():
    words = "D^alpha y = -5 y + 3 D^beta u + 2 u"
    response = circuits.transfer(W[:30], [(3, 0.4), (2, 0)], [(1, 1.2), (5, 0)])
    found = ftlm.identify_frequency(ftlm.FrequencyData.from_arrays(W[:30], response), words)
    assert found.values == pytest.approx({"alpha": 1.2, "beta": 0.4}, abs=1e-8)


def test_two_outputs_that_hang_together_are_one_fit():
    """x is driven by u and by y, y by x: each response is that of the pair."""
    words = "D^alpha x = -2 x + k y + b u; D^beta y = c x - 3 y"
    truth = {"alpha": 0.9, "beta": 1.3, "k": 0.7, "b": 4.0, "c": 1.5}
    w = np.geomspace(0.05, 50, 40)
    s = 1j * w
    below = (s**0.9 + 2) * (s**1.3 + 3) - 0.7 * 1.5
    responses = {"x": 4.0 * (s**1.3 + 3) / below, "y": 1.5 * 4.0 / below}
    data = [
        ftlm.FrequencyData.from_arrays(w, noisy(h, 0.005, k), output=o, input="u", name=o)
        for k, (o, h) in enumerate(responses.items())
    ]
    found = ftlm.identify_frequency(data, words)
    for name, value in truth.items():
        low, high = found.intervals[name]
        assert low - (high - low) / 2 < value < high + (high - low) / 2, name
        assert found.standard_errors[name] < 0.05
    assert [e.rms < 1.5 for e in found.errors] == [True, True]
    with pytest.raises(ftlm.DataError, match=r"no record has the output y of an equation"):
        ftlm.identify_frequency(data[:1], words)


# ------------------------------------------------------------------------------------------------ what intervals say


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say():
    """Of 200 seeds a 95 % interval holds it 181 to 198 times with a probability above 99.9 %."""
    structure = ftlm.equation(ARC, orders={"alpha": [0.7, 0.8, 0.9]})
    inside = dict.fromkeys(TRUTH, 0)
    stated = dict.fromkeys(TRUTH, 0)
    for seed in range(200):
        data = arc(seed)
        relative = ftlm.identify_frequency(data, structure)
        known = ftlm.identify_frequency(data, structure, weights=0.01 * np.abs(circuits_of_arc()))
        for name, value in TRUTH.items():
            for counts, found in ((inside, relative), (stated, known)):
                low, high = found.intervals[name]
                counts[name] += low < value < high
    for counts in (inside, stated):
        assert all(181 <= n <= 198 for n in counts.values()), counts


def circuits_of_arc(kept={}):  # noqa: B006 — kept, for it is the same every time
    if not kept:
        kept["arc"] = circuits.zarc(W, 0.01, 0.05, 1e-2, 0.8)
    return kept["arc"]


def test_deviations_that_are_too_small_are_found_out_and_intervals_widened():
    exact = circuits_of_arc()
    honest = ftlm.identify_frequency(arc(1, deviation=0.01 * np.abs(exact)), ARC)
    assert honest.weights == "deviation"
    assert 0.7 < honest.chi_squared < 1.3
    assert honest.warnings == ()
    boast = ftlm.identify_frequency(arc(1, deviation=0.002 * np.abs(exact)), ARC)
    assert boast.chi_squared == pytest.approx(25 * honest.chi_squared)
    assert "times the stated standard deviations" in boast.warnings[0]
    for name in TRUTH:
        assert boast.standard_errors[name] > 0.7 * honest.standard_errors[name]


def test_a_model_that_leaves_something_out_says_so():
    data = ftlm.FrequencyData.from_arrays(W, noisy(circuits.warburg(W, 0.01, 0.05, 1e-2, 0.8, 0.02), 0.002, 1))
    found = ftlm.identify_frequency(data, ARC)
    assert not found.white
    assert "response_not_white" in [f.code for f in found.findings]
    assert found.verdict.level == "with care"
    straight = ftlm.FrequencyData.from_arrays(W, noisy(np.ones(W.size), 0.001, 2))
    assert ftlm.identify_frequency(straight, "D y = b u").verdict.level == "do not use"


def test_numbers_that_move_together_are_named():
    words = "D^alpha y = a0 y + b0 u + b1 D^0 u"
    found = ftlm.identify_frequency(ftlm.FrequencyData.from_arrays(W, circuits.cpe(W, 2.0, 0.7)), words)
    assert not math.isfinite(found.standard_errors["b0"])
    assert any(w.startswith("not separately identifiable from the data: b0, b1") for w in found.warnings)
    assert found.verdict.level == "do not use"
    assert json.dumps(found.to_dict(), allow_nan=False)
    assert found.model.estimate.covariance is None


def test_a_model_of_an_inductance_has_no_time_response_and_says_so(tmp_path):
    words, response, _, _ = CLOSED["cable"]
    found = ftlm.identify_frequency(ftlm.FrequencyData.from_arrays(W, response), words)
    found.report(tmp_path / "cable.html")
    for call in (
        lambda: found.model.step_response(np.arange(0, 1, 0.01)),
        lambda: found.model.to_control(band=(0.1, 100)),
    ):
        with pytest.raises(ftlm.ModelError, match=r"order 1\.8 of I is (1 )?above alpha = 0\.8"):
            call()


def test_a_number_that_another_hides_is_said_and_their_ratio_holds():
    words = CLOSED["diffusion"][0]
    w = 2 * math.pi * np.geomspace(0.01, 1e4, 60)
    exact = circuits.warburg(w, 0.01, 0.02, 0.005, 0.8, 0.0005)
    found = ftlm.identify_frequency(ftlm.FrequencyData.from_arrays(w, noisy(exact, 0.005, 0)), words)
    vague = {f.parameter for f in found.findings if f.code == "response_parameter_imprecise"}
    assert "c" in vague
    assert not vague & {"alpha", "a", "r", "b"}
    assert found.values["d"] / -found.values["a"] == pytest.approx(0.0005, rel=0.15)


def test_a_second_record_decides_the_verdict():
    found = ftlm.identify_frequency(arc(1), ARC)
    assert "was not validated" in found.verdict.reason
    assert found.validate(arc(2)).verdict.level == "trust"
    assert found.validate(arc(1)).verdict.level == "with care"
    other = ftlm.FrequencyData.from_arrays(W, 1.2 * circuits_of_arc(), name="older")
    assert "of the estimation data, but 16.7 % of older" in found.validate(other).verdict.reason


def test_weights_are_what_they_are_called():
    exact = circuits_of_arc()
    rng = np.random.default_rng(4)
    even = 2e-4 * (rng.standard_normal(W.size) + 1j * rng.standard_normal(W.size))
    data = ftlm.FrequencyData.from_arrays(W, exact + even)
    found = {w: ftlm.identify_frequency(data, ARC, weights=w) for w in ("uniform", "relative")}
    by_hand = ftlm.identify_frequency(data, ARC, weights=np.full(W.size, 7.0))
    assert by_hand.values == pytest.approx(found["uniform"].values, rel=1e-6)
    # Under noise of one size the others count too much where the response is small.
    assert found["uniform"].standard_errors["a"] < found["relative"].standard_errors["a"]


def test_an_order_ends_on_the_bound_of_its_lattice_and_says_so():
    found = ftlm.identify_frequency(arc(1), ARC, orders={"alpha": "0.3:0.7:0.1"})
    assert found.orders["alpha"] == pytest.approx(0.7, abs=1e-9)
    assert any(w == "a parameter is on its bound: alpha is at most 0.7" for w in found.warnings)


# ------------------------------------------------------------------------------------------------ the fit itself


def test_damped_least_squares_keeps_to_its_inequalities():
    """Minimum of (x - 3)^2 + (y - 1)^2 with x + y <= 2 and x <= 1.2, by hand: at (1.2, 0.8)."""

    rows, limits = np.array([[1.0, 1.0], [1.0, 0.0]]), np.array([2.0, 1.2])
    values, cost, status, _, active = _core.minimize(
        lambda v: v - [3.0, 1.0], lambda v: np.eye(2), np.zeros(2), rows, limits
    )
    np.testing.assert_allclose(values, [1.2, 0.8], atol=1e-9)
    assert cost == pytest.approx(1.8**2 + 0.2**2)
    assert (status, active) == ("converged", [0, 1])


def test_a_wall_that_is_met_on_the_way_is_let_go():
    """From (0, -1) the way to (2, 2) along a bent valley meets x <= 1 + y first; the end lies within."""

    values, _, _, _, active = _core.minimize(
        lambda v: np.array([v[0] - 2.0, 3.0 * (v[1] - v[0] ** 2 / 2)]),
        lambda v: np.array([[1.0, 0.0], [-3.0 * v[0], 3.0]]),
        np.array([0.0, -1.0]),
        np.array([[1.0, -1.0]]),
        np.array([1.0]),
    )
    np.testing.assert_allclose(values, [2.0, 2.0], atol=1e-7)
    assert active == []


def test_constrained_optima_are_those_of_scipy():
    """Random Rosenbrock-like problems under random constraints, beside SciPy's SLSQP."""
    rng = np.random.default_rng(3)
    bounded = 0
    for _ in range(40):
        matrix, target = rng.standard_normal((6, 3)), rng.standard_normal(6)
        rows, limits = rng.standard_normal((5, 3)), rng.uniform(0.0, 0.5, 5)

        def residuals(v, matrix=matrix, target=target):
            return matrix @ (v + 0.3 * v**2) - target

        def jacobian(v, matrix=matrix):
            return matrix * (1.0 + 0.6 * v)

        values, cost, status, _, active = _core.minimize(residuals, jacobian, np.zeros(3), rows, limits)
        assert status == "converged"
        assert np.all(rows @ values <= limits + 1e-9)
        within = {"type": "ineq", "fun": lambda v, rows=rows, limits=limits: limits - rows @ v}
        other = scipy_minimize(
            lambda v, residuals=residuals: np.sum(residuals(v) ** 2),
            values,
            method="SLSQP",
            constraints=within,
            options={"ftol": 1e-13},
        )
        assert cost <= other.fun * (1.0 + 1e-7)
        np.testing.assert_allclose((limits - rows @ values)[active], 0.0, atol=1e-8)
        bounded += bool(active)
    assert bounded > 10


def test_an_exception_of_the_residuals_is_passed_on():
    def broken(_):
        raise ZeroDivisionError("on purpose")

    arguments = (np.zeros(1), np.zeros((0, 1)), np.zeros(0))
    with pytest.raises(ZeroDivisionError, match="on purpose"):
        _core.minimize(broken, broken, *arguments)
    with pytest.raises(ftlm.DataError, match="a row of the Jacobian has length 2, but 1 is needed"):
        _core.minimize(lambda v: v, lambda v: np.eye(2)[:1], *arguments)


def scipys(response):
    """What curve_fit finds of an arc from its own start, all numbers 1; NaN where it gives up."""
    size = np.abs(response)

    def flat(w, alpha, a, r, b):
        with np.errstate(all="ignore"):
            s = (1j * w) ** alpha
            value = (r * s + b) / (s - a) / size
        return np.nan_to_num(np.concatenate([value.real, value.imag]), posinf=1e6, neginf=-1e6)

    goal = response / size
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return curve_fit(flat, W, np.concatenate([goal.real, goal.imag]))[0]
        except RuntimeError:
            return np.full(4, np.nan)


def test_the_automatic_start_finds_what_curve_fit_misses_from_its_own():
    rng = np.random.default_rng(0)
    identified_count = scipy_count = 0
    for _ in range(8):
        r0, r1, time = 10 ** rng.uniform([-2, -2, -4], [1, 1, 1])
        alpha = rng.uniform(0.5, 0.95)
        response = circuits.zarc(W, r0, r1, time, alpha)
        truth = np.array([alpha, -(time**-alpha), r0, (r0 + r1) * time**-alpha])
        found = ftlm.identify_frequency(ftlm.FrequencyData.from_arrays(W, response), ARC)
        identified_count += np.allclose([found.values[n] for n in ("alpha", "a", "r", "b")], truth, rtol=1e-5)
        scipy_count += np.allclose(scipys(response), truth, rtol=1e-5)
    assert identified_count == 8
    assert scipy_count <= 4, scipy_count


def test_a_lattice_of_any_length_and_many_orders_is_searched():
    words = "D^alpha y = a1 D^beta y + a0 y + b2 D^gamma u + b1 D^delta u + b0 u"
    w = np.geomspace(0.02, 200, 90)
    response = circuits.transfer(w, [(2, 1.1), (1, 0.5), (3, 0)], [(1, 2.1), (0.8, 0.9), (3, 0)])
    found = ftlm.identify_frequency(ftlm.FrequencyData.from_arrays(w, response), words)
    assert found.errors[0].rms < 1e-5
    by_lattice = ftlm.identify_frequency(arc(share=0), ARC, orders={"alpha": "0.5:1:0.0001"})
    assert by_lattice.values == pytest.approx(TRUTH, rel=1e-6)


def test_a_long_record_is_raced_on_part_of_it_and_fitted_to_all():
    w = np.geomspace(0.06, 6e4, 3000)
    exact = 0.01 + 0.05 / (1 + (1j * w * 1e-2) ** 0.8)
    long = ftlm.identify_frequency(ftlm.FrequencyData.from_arrays(w, noisy(exact, 0.01, 1)), ARC)
    short = ftlm.identify_frequency(arc(1), ARC)
    for name, value in TRUTH.items():
        assert abs(long.values[name] - value) < 4 * long.standard_errors[name]
        # Fifty times the frequencies are a seventh of the error.
        assert long.standard_errors[name] == pytest.approx(short.standard_errors[name] / math.sqrt(50), rel=0.35)


def test_the_order_of_rows_does_not_matter():
    data = arc(3)
    turned = np.random.default_rng(0).permutation(W.size)
    shuffled = ftlm.FrequencyData.from_arrays(W[turned], data.response[turned])
    one, other = (ftlm.identify_frequency(d, ARC) for d in (data, shuffled))
    assert other.values == pytest.approx(one.values, rel=1e-9)
    assert other.standard_errors == pytest.approx(one.standard_errors, rel=1e-6)
    assert one.white == other.white


# ------------------------------------------------------------------------------------------------ what comes of it


def test_the_model_runs_over_time_as_the_circuit_does(tmp_path):
    found = ftlm.identify_frequency(arc(share=0), ARC)
    found.model.save(tmp_path / "cell.json")
    model = ftlm.load_model(tmp_path / "cell.json")
    time = np.arange(2001) * 1e-4
    run = ftlm.Run.from_arrays(step=1e-4, inputs={"I": np.ones(time.size)}, outputs={"U": 0 * time})
    voltage = model.simulate(run)["U"]
    # A step of current meets the resistor first, and at the end of 20 time constants nearly all of the arc.
    assert voltage[1] == pytest.approx(0.0114, abs=2e-4)
    assert voltage[-1] == pytest.approx(0.0587, abs=2e-4)
    assert model.dcgain()[0, 0] == pytest.approx(0.06, rel=1e-6)
    assert model.is_stable()


def test_it_prints_draws_and_reports(tmp_path):
    found = ftlm.identify_frequency(arc(1), ARC)
    text = str(found)
    assert text.splitlines()[0].startswith("WITH CARE: the model was not validated on another response")
    assert "V/A" in text
    assert "alpha" in text
    assert len(text.splitlines()) < 30
    page = found.report(tmp_path / "cell.html", validation=found.validate(arc(2))).read_text(encoding="utf-8")
    assert page.count("<figure") >= 8
    assert "Nyquist" in page
    assert "−Im Z" in page
    assert "not finite" not in page
    assert "<svg" in found._repr_html_()
    for figure, axes in ((ftlm.plot.response(found), 2), (ftlm.plot.nyquist(found.model, arc(2)), 1)):
        assert len(figure.axes) == axes
        points, curve, *_ = figure.axes[0].lines
        assert points.get_xdata().size == W.size
        assert curve.get_xdata().size > 2 * W.size
    with pytest.raises(ftlm.ModelError, match="a model alone has no measured points; give data"):
        ftlm.plot.nyquist(found.model)
    with pytest.raises(ftlm.ModelError, match="result is str; give what identify_frequency returns"):
        ftlm.plot.response("cell")


# ------------------------------------------------------------------------------------------------ strangers' files


def rows_of(share=0.0):
    exact = circuits_of_arc()
    return W / (2 * np.pi), noisy(exact, share, 1) if share else exact


def written(path, heads, rows, *, comma=False, separator=",", encoding="utf-8", above=""):
    lines = [separator.join(f"{v:.9g}" for v in row) for row in rows]
    text = above + separator.join(heads) + "\n" + "\n".join(line.replace(".", ",") if comma else line for line in lines)
    path.write_bytes((text + "\n").encode(encoding))
    return path


F, Z = rows_of()
DEGREES = np.degrees(np.angle(Z))
DECIBELS = 20 * np.log10(np.abs(Z))
#: Header, columns, how it is written, what must be said; all hold the same spectrum.
STRANGERS = {
    "Zreal Zimag": (("Freq", "Zreal", "Zimag"), (F, Z.real, Z.imag), {}, "'Freq' are assumed to be in Hz"),
    "Zreal Zimg": (("Freq/Hz", "Zreal/Ohm", "Zimg/Ohm"), (F, Z.real, Z.imag), {}, None),
    "potentiostat": (
        ("freq/Hz", "Re(Z)/Ohm", "-Im(Z)/Ohm", "|Z|/Ohm", "Phase(Z)/deg"),
        (F, Z.real, -Z.imag, np.abs(Z), DEGREES),
        {"separator": "\t"},
        "negative imaginary part",
    ),
    "primes": (
        ("Index", "Frequency (Hz)", "Z' (mΩ)", "-Z'' (mΩ)", "Z (Ω)", "-Phase (°)"),
        (np.arange(60), F, 1e3 * Z.real, -1e3 * Z.imag, np.abs(Z), -DEGREES),
        {},
        "negative imaginary part",
    ),
    "units below": (
        ("Freq", "Zreal", "Zimag"),
        (F, Z.real, Z.imag),
        {"separator": "\t", "units": ("Hz", "ohm", "ohm")},
        None,
    ),
    "bode": (("Hz", "dB", "deg"), (F, DECIBELS, DEGREES), {}, None),
    "angular": (("omega_rad_s", "gain_abs", "phase_rad"), (W, np.abs(Z), np.angle(Z)), {}, None),
    "German": (
        ("Frequenz [Hz]", "Betrag [dB]", "Phase [°]"),
        (F, DECIBELS, DEGREES),
        {"separator": ";", "comma": True, "encoding": "cp1252", "above": "Messung 12\nPrüfling A\n"},
        "decimal commas",
    ),
    "kilohertz": (("f [kHz]", "Re", "Im"), (F / 1e3, Z.real, Z.imag), {}, None),
    "scatter": (("w", "real", "imag", "sigma"), (W, Z.real, Z.imag, 1e-3 * np.abs(Z)), {}, "assumed to be in rad/s"),
}


@pytest.mark.parametrize("name", STRANGERS)
def test_a_strangers_file_is_one_command_from_its_model(name, tmp_path):
    heads, columns, how, said = STRANGERS[name]
    how = dict(how)
    units = how.pop("units", None)
    if units:
        heads = (*heads[:-1], heads[-1] + "\n" + how["separator"].join(units))
    path = written(tmp_path / "spectrum.csv", heads, np.stack(columns, axis=1), **how)
    data = ftlm.load_frequency(path)
    np.testing.assert_allclose(data.frequency, W, rtol=1e-7)
    np.testing.assert_allclose(data.response, Z, rtol=2e-7)
    assert (data.deviation is not None) == (name == "scatter")
    assert said is None or said in " ".join(data.warnings)
    done = run_command("identify-frequency", path, "--structure", ARC, "-o", tmp_path / "cell.json", "--json")
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    for number, value in TRUTH.items():
        assert found["values"][number] == pytest.approx(value, rel=1e-5), number
    assert ftlm.load_model(tmp_path / "cell.json").outputs == ("U",)


def test_a_workbook_is_read_too(tmp_path):
    import openpyxl

    book = openpyxl.Workbook()
    book.active.append(["Frequency (Hz)", "Z' (Ω)", "-Z'' (Ω)"])
    for row in zip(F, Z.real, -Z.imag, strict=True):
        book.active.append(list(row))
    book.save(tmp_path / "eis.xlsx")
    np.testing.assert_allclose(ftlm.load_frequency(tmp_path / "eis.xlsx").response, Z, rtol=1e-12)


def test_the_command_says_what_python_says(tmp_path):
    path = written(tmp_path / "cell.csv", ("Hz", "dB", "deg"), np.stack([F, DECIBELS, DEGREES], axis=1))
    done = run_command(
        "identify-frequency", path, "--structure", ARC, "--report", tmp_path / "cell.html", "--validation", path
    )
    assert done.exit_code == 0, done.output
    assert "D^0.8 U = -39.8107 U" in done.stdout
    assert (tmp_path / "cell.html").stat().st_size > 20_000
    assert "validation" in done.stdout
    for words, code, text in (
        (["--structure", ARC, "--weights", "deviation"], 3, "states no standard deviation; use --weights relative"),
        (["--structure", "arm:1"], 2, "a frequency response needs an equation"),
        (["--structure", ARC, "--columns", "amplitude=dB"], 3, "'amplitude' is not part"),
        (["--structure", ARC, "--frequency-unit", "kHz"], 3, "states Hz, and --frequency-unit kHz is given"),
        (["--structure", ARC, "--start", "alfa=1"], 2, "did you mean alpha?"),
        (["--equation", ARC], 2, "--structure takes equations as text"),
    ):
        refused = run_command("identify-frequency", path, *words)
        assert refused.exit_code == code, refused.output
        assert text in " ".join(refused.stderr.split()), refused.stderr


# ------------------------------------------------------------------------------------------------ bad input


def test_what_cannot_be_a_response_is_refused_in_words():
    make = ftlm.FrequencyData.from_arrays
    for what, words in (
        (lambda: make([1.0, 0.0, -2.0], [1, 1, 1]), r"frequency is not above 0: 0.0 at row 1, 2 in all; leave such"),
        (lambda: make([1.0, math.nan], [1, 1]), r"frequency is not finite: nan at row 1, 1 in all"),
        (lambda: make([1.0, 2.0], [1, math.inf]), r"response is not finite: .* at row 1, 1 in all"),
        (lambda: make([1.0, 2.0], [1, 2, 3]), r"response has shape \(3,\), frequency \(2,\)"),
        (lambda: make([], []), r"there is no frequency, 0 rows"),
        (lambda: make([[1.0]], [[1.0]]), r"frequency has shape \(1, 1\); give a vector"),
        (lambda: make(["a"], [1.0]), r"frequency has <U1 values; give real numbers"),
        (lambda: make([1.0], ["a"]), r"response has <U1 values; give numbers"),
        (
            lambda: make([1.0], [1.0], frequency_unit="hz"),
            r"frequency_unit='hz' is unknown; the known ones are rad/s, Hz",
        ),
        (lambda: make([1.0, 2.0], [1, 1], deviation=[1.0]), r"deviation has 1 value, frequency 2"),
        (lambda: make([1.0, 2.0], [1, 1], deviation=[1.0, 0.0]), r"deviation is not above 0: 0.0 at row 1, 1 in all"),
        (lambda: arc().slice(1e6), r"there are no data from 1e\+06 to inf rad/s; the data cover"),
    ):
        with pytest.raises(ftlm.DataError, match=words):
            what()


def test_data_are_never_changed():
    frequency, response = W.copy(), circuits_of_arc().copy()
    data = ftlm.FrequencyData.from_arrays(frequency, response)
    ftlm.identify_frequency(data, ARC)
    np.testing.assert_array_equal(frequency, W)
    with pytest.raises(ValueError, match="read-only"):
        data.response[0] = 0
    frequency[0] = 5.0
    assert data.frequency[0] == W[0]


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"structure": 3}, ftlm.ModelError, r"structure is int; give an equation"),
        ({"structure": "R0 - X1"}, ftlm.ModelError, r"'X1' is not an element; known: R \(resistor\), C"),
        ({"structure": "D^0.5 U = 2 I"}, ftlm.ModelError, r"no parameter is free"),
        ({"structure": "D^2 U = a U - fc*sign(D U) + b I"}, ftlm.ModelError, r"have friction, which a fit of"),
        ({"structure": "D U = a U + b sat(I, 3)"}, ftlm.ModelError, r"I saturates or has a dead zone, which a fit"),
        (
            {"structure": "D U = a U + b I + c"},
            ftlm.ModelError,
            r"have an offset, which a fit of a frequency response does not",
        ),
        ({"structure": "D U = a U"}, ftlm.ModelError, r"the equations of U have no input"),
        (
            {"structure": "D y = a y + b I"},
            ftlm.DataError,
            r"cell has the output 'U', which is not an output of the equa",
        ),
        ({"structure": "D U = a U + b I + d J"}, ftlm.DataError, r"no record has the input J of the equations"),
        ({"orders": {"alpa": 1.0}}, ftlm.ModelError, r"alpa"),
        ({"fixed": {"q": 1.0}}, ftlm.ModelError, r"fixed coefficient 'q' does not occur"),
        ({"delay": {"u": 0.1}}, ftlm.ModelError, r"u"),
        ({"weights": "realtive"}, ftlm.ModelError, r"weights='realtive' is not known; use 'auto', 'relative'"),
        ({"weights": "deviation"}, ftlm.DataError, r"cell states no standard deviation; use weights='relative'"),
        ({"weights": [1.0, 2.0]}, ftlm.DataError, r"weights has shape \(2,\), the data \(60,\)"),
        ({"weights": np.zeros(60)}, ftlm.DataError, r"deviation is not above 0: 0.0 at row 0, 60 in all"),
        ({"start": {"alfa": 1.0}}, ftlm.ModelError, r"start 'alfa' does not occur in the equation; did you mean alpha"),
        ({"start": {"alpha": -1.0}}, ftlm.ModelError, r"start= is out of the bounds"),
        ({"start": 3}, ftlm.ModelError, r"start is int; give values by name"),
        ({"data": "cell.csv"}, ftlm.DataError, r"data is str; give frequency data"),
        ({"data": []}, ftlm.DataError, r"data is empty; give at least one"),
        ({"data": [1]}, ftlm.DataError, r"data\[0\] is int; give frequency data"),
    ],
)
def test_bad_arguments_are_refused_in_words(options, error, words):
    given = {"data": arc(), "structure": ARC, **options}
    with pytest.raises(error, match=words):
        ftlm.identify_frequency(given.pop("data"), given.pop("structure"), **given)


def test_too_few_frequencies_and_responses_of_size_0_are_refused():
    with pytest.raises(ftlm.DataError, match="2 frequencies give 4 values, and 4 parameters are free"):
        ftlm.identify_frequency(arc().slice(0.06, 0.08), ARC)
    dead = ftlm.FrequencyData.from_arrays(W, np.where(W > 1e3, 0, 1.0))
    with pytest.raises(ftlm.DataError, match=r"the response is 0 at row \d+, \d+ in all, and has no relative weight"):
        ftlm.identify_frequency(dead, "D y = a y + b u")


@pytest.mark.parametrize(
    ("heads", "words"),
    [
        (("a", "b", "c"), r"the frequency cannot be recognized .*recognized: none.*the columns are 'a', 'b', 'c'"),
        (("Hz", "b", "c"), r"real and imaginary part, or magnitude and phase cannot be recognized .*frequency 'Hz'"),
        (("Hz", "dB", "c"), r"recognized: frequency 'Hz', magnitude 'dB'"),
        (
            ("f", "Hz", "dB"),
            r"the columns 'f' and 'Hz' may both be the frequency; name one with columns=\{part",
        ),
        (("freq [parsec]", "re", "im"), r"states the unit 'parsec', which is not a unit of frequency"),
        (("Hz", "Re (Ohm)", "Im (mOhm)"), r"have the units 'Ohm' and 'mOhm'; give both in one unit"),
    ],
)
def test_columns_that_cannot_be_told_are_refused(heads, words, tmp_path):
    path = written(tmp_path / "x.csv", heads, [(1, 2, 3), (2, 3, 4), (3, 4, 5)])
    with pytest.raises(ftlm.DataError, match=words):
        ftlm.load_frequency(path)


def test_what_is_said_of_a_file_is_checked(tmp_path):
    path = written(tmp_path / "x.csv", ("f", "gain", "phase"), [(1, -2, 3), (2, 3, 4), (3, 4, 5)])
    for options, words in (
        ({}, r"column 'gain': a magnitude is negative, first at row 0, 1 in all; give magnitude_unit='dB'"),
        ({"magnitude_unit": "db"}, r"magnitude_unit='db' is unknown \(did you mean 'dB'\?\)"),
        ({"magnitude_unit": "dB", "phase_unit": "turns"}, r"phase_unit='turns' is unknown"),
        (
            {"columns": {"frequncy": "f"}},
            r"'frequncy' is not part of a frequency response \(did you mean 'freq",
        ),
        ({"columns": {"frequency": "g"}}, r"column 'g' \(frequency\) is not in 'x.csv'"),
        ({"columns": 3}, r"columns is an int; pass a dict of part: column"),
        ({"magnitude_unit": "dB", "negated": 1}, r"negated=1 is neither True nor False"),
    ):
        with pytest.raises(ftlm.DataError, match=words):
            ftlm.load_frequency(path, **options)
    data = ftlm.load_frequency(path, magnitude_unit="dB", negated=True)
    np.testing.assert_allclose(data.response[0], 10 ** (-0.1) * np.exp(-1j * np.radians(3)))
    assert any("the phase 'phase' is assumed to be in degrees; otherwise phase_unit='rad'" in w for w in data.warnings)
    ftlm.Run.from_arrays(step=1.0, inputs={"u": [0.0, 1, 2]}, outputs={"y": [0.0, 1, 2]}).to_csv(tmp_path / "run.csv")
    with pytest.raises(ftlm.DataError, match=r"run.csv is a run over time that ftlm wrote; load it with ftlm.load"):
        ftlm.load_frequency(tmp_path / "run.csv")


def test_an_inductive_spectrum_is_said_not_guessed(tmp_path):
    path = written(tmp_path / "x.csv", ("Hz", "Z'", "Z''"), np.stack([F, Z.real, -Z.imag], axis=1))
    data = ftlm.load_frequency(path)
    assert any("if it contains -Z'', give negated=True" in w for w in data.warnings)
    np.testing.assert_allclose(ftlm.load_frequency(path, negated=True).response, Z, rtol=1e-7)


FORMS = {
    "Zimg": ("Freq/Hz\tZreal/Ohm\tZimg/Ohm\n", ""),
    "a time beside": ("Time/s,Frequency/Hz,Z'/Ohm,-Z''/Ohm\n", ""),
    "a remark under the names": ("freq,re,im\n# measured at 25 C\n", ""),
    "quoted names": ('"Frequency (Hz)","Z\' (Ohm)","Z\'\' (Ohm)"\n', ""),
    "a row at rest": ("f [Hz],Zreal,Zimag\n", "0,0.06,0\n"),
    "text below the table": ("freq,Zreal,Zimag\n", "\nFit results\nRs,0.01\nchi2,1e-4,9\n"),
    "no names": ("", ""),
    "a remark between names and rows": ("ZPLOT2 ASCII\nFreq(Hz)\tZ'(a)\tZ''(b)\nEnd Comments\n", ""),
}


@pytest.mark.parametrize("form", FORMS)
def test_impedances_are_read_as_instruments_write_them(tmp_path, form):
    head, tail = FORMS[form]
    frequency, gap = W / (2 * np.pi), "\t" if "\t" in head else ","
    z = circuits.zarc(W, 0.01, 0.05, 1e-2, 0.8)
    columns = [frequency, z.real, z.imag]
    if head.startswith("Time"):
        columns = [np.arange(W.size) * 2.0, frequency, z.real, -z.imag]
    lines = "".join(gap.join(f"{v:.10g}" for v in row) + "\n" for row in np.column_stack(columns))
    (tmp_path / "cell.csv").write_text(head + lines + tail)
    found = ftlm.load_frequency(tmp_path / "cell.csv")
    np.testing.assert_allclose(found.response, z, rtol=1e-8)
    np.testing.assert_allclose(found.frequency, W, rtol=1e-8)
    said = "lines 63 to 65 are below the table and left out" if "Fit" in tail else "1 of 61 rows are at frequency 0"
    assert any(said in w for w in found.warnings) == bool(tail)
    assert any("taken as 'frequency', 'real', 'imag'" in w for w in found.warnings) == (not head)
    if head:
        assert "impedance spectrum" in ftlm.open_file(tmp_path / "cell.csv").problem


def test_two_tables_in_a_file_are_refused_with_the_line_of_the_second(tmp_path):
    table = "freq,re,im\n" + "".join(f"{k},1,-{k}\n" for k in range(1, 9))
    (tmp_path / "two.csv").write_text(f"{table}\n{table}")
    words = (
        "a table ends above line 11, and line 12 is a row of another one; save the lines from 11 on as a second file"
    )
    with pytest.raises(ftlm.DataError, match=words):
        ftlm.load_frequency(tmp_path / "two.csv")
    (tmp_path / "two.csv").write_text(f"{table}{table}")
    with pytest.raises(
        ftlm.DataError, match="line 10 repeats the line of names; save the lines from 10 on as a second"
    ):
        ftlm.load_frequency(tmp_path / "two.csv")


def test_a_record_with_its_names_repeated_or_a_word_in_a_cell_is_refused_with_the_line(tmp_path):
    rows = [f"{k},{k % 3},{k % 5}\n" for k in range(20)]
    (tmp_path / "run.csv").write_text("t,u,y\n" + "".join(rows) + "t,u,y\n" + "".join(rows))
    with pytest.raises(ftlm.DataError, match="line 22 repeats the line of names"):
        ftlm.load(tmp_path / "run.csv")
    rows[7] = "7,ERR,2\n"
    (tmp_path / "run.csv").write_text("t,u,y\n" + "".join(rows))
    with pytest.raises(ftlm.DataError, match=r"no output is named, .* column 'u', line 9: 'ERR' is not a number"):
        ftlm.load(tmp_path / "run.csv")


@pytest.mark.parametrize("direction", [1, -1])
def test_sweeps_of_one_file_are_counted_and_compared(tmp_path, direction):
    """Two sweeps of one resistor and capacitor, the second with 10 % more; a check of one frequency is no sweep."""
    frequency = np.geomspace(0.1, 1e3, 25)[::direction]
    z = 10 + 100 / (1 + 0.2j * np.pi * frequency)
    rows = [np.column_stack([frequency, z.real, z.imag])] * 2
    rows[1] = rows[1] * [1, 1.1, 1.1]

    def notes(table):
        path = tmp_path / "z.csv"
        np.savetxt(path, table, delimiter=",", header="freq/Hz,Re(Z)/Ohm,Im(Z)/Ohm", comments="")
        return [w for w in ftlm.load_frequency(path).warnings if "sweeps" in w]

    (note,) = notes(np.vstack(rows))
    assert "2 sweeps" in note
    assert "by up to 10 %" in note
    assert notes(rows[0]) == []
    assert notes(np.vstack([rows[0], rows[0][:1]])) == []
