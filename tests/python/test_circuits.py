"""Circuits of impedances beside impedance.py's formulas, written anew from its documentation, and SciPy's fits."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from typer.testing import CliRunner

import ftlm
from ftlm.cli.main import app
from ftlm.structure.circuit import impedance_and_derivatives
from slow_cases import slow_after

F = np.geomspace(1e5, 5e-3, 70)
W = 2 * np.pi * F


def parallel(*parts):
    return 1 / sum(1 / z for z in parts)


def r(value):
    return np.full(F.size, complex(value))


def c(value):
    return 1 / (value * 1j * W)


def cpe(q, alpha):
    return 1 / (q * (1j * W) ** alpha)


def warburg(sigma):
    return sigma * (1 - 1j) / np.sqrt(W)


def blocked(size, tau):
    x = np.sqrt(1j * W * tau)
    return size / (x * np.tanh(x))


def opened(size, tau):
    x = np.sqrt(1j * W * tau)
    return size * np.tanh(x) / x


def gerischer(size, tau):
    return size / np.sqrt(1 + 1j * W * tau)


#: Circuit, its impedance by parameters in the order of their names, and their true values.
CASES = {
    "R0-p(R1,C1)": (lambda a, b, d: r(a) + parallel(r(b), c(d)), (0.01, 0.05, 2.0)),
    "R0 - p(R1, CPE1) - W1": (
        lambda a, b, q, e, g: r(a) + parallel(r(b), cpe(q, e)) + warburg(g),
        (0.01, 0.02, 0.8, 0.85, 0.003),
    ),
    "R0-p(CPE1,R1-W1)": (
        lambda a, q, e, b, g: r(a) + parallel(cpe(q, e), r(b) + warburg(g)),
        (0.012, 0.8, 0.82, 0.03, 0.004),
    ),
    "L0-R0-p(R1,CPE1)": (
        lambda n, a, b, q, e: 1j * W * n + r(a) + parallel(r(b), cpe(q, e)),
        (2e-7, 0.01, 0.02, 0.1, 0.85),
    ),
    "R0-p(C1,R1-Wo1)": (
        lambda a, d, b, g, t: r(a) + parallel(c(d), r(b) + blocked(g, t)),
        (10.0, 2e-5, 50.0, 100.0, 3.0),
    ),
    "R0-p(C1,R1-Ws1)": (
        lambda a, d, b, g, t: r(a) + parallel(c(d), r(b) + opened(g, t)),
        (10.0, 2e-5, 50.0, 100.0, 3.0),
    ),
    "R0-p(R1,C1)-G1": (
        lambda a, b, d, g, t: r(a) + parallel(r(b), c(d)) + gerischer(g, t),
        (1.0, 2.0, 1e-3, 5.0, 2.0),
    ),
    "p(R_1,C0,p(R2,CPE3-R3))": (
        lambda a, d, b, q, e, g: parallel(r(a), c(d), r(b), cpe(q, e) + r(g)),
        (3.0, 1e-4, 4.0, 1e-2, 0.7, 0.5),
    ),
}


def spectrum(z, noise=0.003, seed=3):
    g = np.random.default_rng(seed)
    z = z * (1 + noise * (g.standard_normal(z.size) + 1j * g.standard_normal(z.size)))
    return ftlm.FrequencyData.from_arrays(F, z, frequency_unit="Hz", unit="Ω", name="cell")


@pytest.mark.parametrize("text", CASES)
def test_impedance_and_its_slopes_are_those_of_the_formulas(text):
    formula, true = CASES[text]
    circuit = ftlm.Circuit(text)
    known = circuit.with_values(dict(zip(circuit.names, true, strict=True)))
    assert known.impedance(W) == pytest.approx(formula(*true), rel=1e-12)
    _, slopes = impedance_and_derivatives(known, W, {})
    for k, name in enumerate(circuit.names):
        ends = []
        for step in (1e-6, -1e-6):
            values = list(true)
            values[k] += step * (1 if name.endswith("_alpha") else true[k])
            ends.append(formula(*values))
        assert slopes[name] + 0 * W == pytest.approx(
            (ends[0] - ends[1]) / 2e-6, rel=1e-6, abs=1e-9 * abs(ends[0]).max()
        )


@pytest.mark.parametrize("text", [t for t in CASES if not t.startswith("p(")])
def test_a_fit_without_a_guess_is_scipys_from_the_truth(text):
    formula, true = CASES[text]
    record = spectrum(formula(*true))
    found = ftlm.identify_frequency(record, text)

    def left(p):
        e = formula(*(np.array(true) * p)) / record.response - 1
        return np.r_[e.real, e.imag]

    oracle = least_squares(left, np.ones(len(true)), xtol=1e-15, ftol=1e-15)
    # Its weights are those of the measured response, too.
    errors = np.sqrt(np.diag(np.linalg.inv(oracle.jac.T @ oracle.jac)) * 2 * oracle.cost / (2 * F.size - len(true)))
    names = ftlm.Circuit(text).names
    assert [found.values[n] for n in names] == pytest.approx(oracle.x * true, rel=1e-5)
    assert [found.standard_errors[n] for n in names] == pytest.approx(errors * true, rel=1e-3)
    assert all(abs(found.values[n] - t) < 4 * found.standard_errors[n] for n, t in zip(names, true, strict=True))
    assert all(p.unit or n.endswith("_alpha") for n, p in found.parameters.items())


@pytest.mark.parametrize("text", [t for t in CASES if not set(t) & set("oGs")])
def test_a_circuit_of_powers_of_s_is_exactly_its_equation(text):
    formula, true = CASES[text]
    found = ftlm.identify_frequency(spectrum(formula(*true)), text, fixed={ftlm.Circuit(text).names[0]: true[0]})
    response = found.model.frequency_response(W)[0, 0]
    assert response == pytest.approx(found.circuit.impedance(W), rel=1e-6)
    assert found.parameters[ftlm.Circuit(text).names[0]].fixed


def test_summary_report_validation_and_json(tmp_path):
    formula, true = CASES["R0 - p(R1, CPE1) - W1"]
    found = ftlm.identify_frequency(spectrum(formula(*true)), "R0 - p(R1, CPE1) - W1")
    check = found.validate(spectrum(formula(*true), seed=4))
    assert check.verdict.trusted
    text = found.summary(check)
    assert "R0-p(R1,CPE1)-W1" in text
    assert "Ω s^-0.5" in text
    assert "S s^0.8" in text
    page = found.report(tmp_path / "cell.html", validation=check).read_text()
    assert "Nyquist" in page
    assert "W1_sigma" in page
    assert found.to_dict()["circuit"] == "R0-p(R1,CPE1)-W1"
    assert list(found.to_frame().index) == list(found.values)
    assert found._repr_html_()
    size, phase = ftlm.plot.response(found).axes
    assert (size.get_ylabel(), size.get_yscale(), phase.get_xlabel()) == ("|Z| [Ω]", "log", "frequency [Hz]")
    (axes,) = ftlm.plot.nyquist(found).axes
    measured = next(line for line in axes.lines if len(line.get_xdata()) == F.size)
    np.testing.assert_allclose(measured.get_ydata(), -spectrum(formula(*true)).response.imag)


def test_equal_groups_are_numbered_from_the_fastest_on():
    fast, slow = parallel(r(0.02), cpe(0.1, 0.85)), parallel(r(0.03), cpe(30.0, 0.9))
    for seed in range(2):
        found = ftlm.identify_frequency(spectrum(r(0.01) + slow + fast, seed=seed), "R0-p(R1,CPE1)-p(R2,CPE2)")
        assert [found.values[n] for n in ("R1", "R2")] == pytest.approx([0.02, 0.03], rel=0.05)
        assert [found.values[n] for n in ("CPE1_alpha", "CPE2_alpha")] == pytest.approx([0.85, 0.9], abs=0.02)
    kept = ftlm.identify_frequency(spectrum(r(0.01) + slow + fast), "R0-p(R1,CPE1)-p(R2,CPE2)", fixed={"CPE1_Q": 30.0})
    assert kept.values["R1"] == pytest.approx(0.03, rel=0.05)


@slow_after(1, "seeds", [3, 6])
def test_the_capacitor_that_replaces_a_cpe_of_exponent_1_is_named(seeds):
    z = CASES["R0-p(R1,C1)"][0](0.01, 0.05, 2.0)
    fits = [ftlm.identify_frequency(spectrum(z, seed=seed), "R0 − p(R1, CPE1)") for seed in range(seeds)]
    named = [fit for fit in fits if fit.values["CPE1_alpha"] == 1.0]
    assert named
    for fit in named:
        (finding,) = (f for f in fit.findings if f.code == "cpe_is_capacitor")
        assert finding.remedy == "write C1 instead of CPE1"
        assert not any(f.code == "response_on_bound" for f in fit.findings)
    taken = ftlm.identify_frequency(spectrum(z, seed=0), "R0-p(R1,CPE1)-p(R2,C1)", fixed={"R2": 1e-6, "C1": 1.0})
    assert all(f.code != "cpe_is_capacitor" or "write C2 " in f.remedy for f in taken.findings)


def test_an_exponent_ends_at_1_and_bounds_are_kept():
    z = CASES["R0-p(R1,C1)"][0](0.01, 0.05, 2.0)
    found = ftlm.identify_frequency(
        spectrum(z, seed=1), "R0-p(R1,CPE1)", bounds={"R0": (0.0101, 1)}, start={"R1": 0.04}
    )
    assert found.values["CPE1_alpha"] <= 1
    assert found.values["R0"] == pytest.approx(0.0101)
    assert "a parameter is on its bound: R0 is at least 0.0101" in found.warnings
    on_bound = found.parameters["R0"]
    assert on_bound.fixed
    assert np.isnan([on_bound.standard_error, *on_bound.interval]).all()
    assert len(found.names) == len(found.covariance) == 3
    # The errors of the others are those with the parameter fixed at its bound.
    known = ftlm.identify_frequency(spectrum(z, seed=1), "R0-p(R1,CPE1)", fixed={"R0": 0.0101})
    assert found.standard_errors == pytest.approx(known.standard_errors, rel=1e-4)
    alone = ftlm.identify_frequency(spectrum(r(0.01)), "R0", bounds={"R0": (0.02, 1)})
    assert (alone.values, alone.standard_errors) == ({"R0": pytest.approx(0.02)}, {})


@pytest.mark.parametrize("resistance", [0.0, *(pytest.param(r, marks=pytest.mark.slow) for r in (1e-6, 3e-6, 6e-6))])
@slow_after(1, "seeds", [2, 20])
def test_a_small_resistance_has_an_interval_on_the_scale_of_the_data(resistance, seeds):
    frequency = np.geomspace(0.01, 1e4, 60)
    s = 2j * np.pi * frequency
    z = resistance + 1 / (1 / 0.05 + 0.3 * s**0.9)
    covered, absent = 0, 0
    for seed in range(seeds):
        g = np.random.default_rng(seed)
        noisy = z * (1 + 0.01 * (g.standard_normal(60) + 1j * g.standard_normal(60)))
        found = ftlm.identify_frequency(ftlm.FrequencyData.from_arrays(2 * np.pi * frequency, noisy), "R0-p(R1,CPE1)")
        low, high = found.intervals["R0"]
        assert 0 <= low < high < 2e-5
        covered += low <= resistance <= high
        absent += [f.code for f in found.findings if f.parameter == "R0"] == ["parameter_at_limit"]
    assert covered > 0.9 * seeds - 1
    if resistance == 0:
        assert absent == seeds
    else:
        assert 20 * absent >= 15 * seeds if resistance == 1e-6 else 20 * absent < 12 * seeds


def test_a_parallel_resistor_that_is_absent_has_no_upper_bound():
    z = r(0.01) + c(2.0)
    found = ftlm.identify_frequency(spectrum(z), "R0-p(R1,C1)")
    low, high = found.intervals["R1"]
    assert 10 < low < high == np.inf
    assert "R1 is not distinguishable from infinity (99 %): its 95 % interval is" in str(found.warnings)
    twice = ftlm.identify_frequency(spectrum(z), "R0-R1-C1")
    assert any(f.code == "response_not_separately_identifiable" for f in twice.findings)


def test_a_profile_interval_ends_at_a_user_bound():
    z = 1 / (1 / 0.05 + 0.3 * (1j * W) ** 0.9)
    found = ftlm.identify_frequency(spectrum(z), "R0-p(R1,CPE1)", bounds={"R0": (0, 1e-3)})
    assert found.intervals["R0"][0] == 0
    assert 0 < found.intervals["R0"][1] < 1e-4


@pytest.mark.parametrize(
    ("circuit", "options", "words"),
    [
        ("R0-p(R1,X1)", {}, r"'X1' is not an element; known: R \(resistor\), C \(capacitor\), L \(inductor\), CPE"),
        ("R0-p(R1,C1", {}, "a parenthesis is not closed"),
        ("R0-R0", {}, "two elements are R0; number them"),
        ("R0-p(R1)", {}, r"joins two or more elements in parallel, and one has a single branch; write p\(R1,C1\)"),
        ("R0-p(R1-C1)", {}, "joins two or more elements in parallel"),
        ("R0-p(R1,C1))", {}, r"'\)' is out of place"),
        ("R0-", {}, "ends where an element is expected"),
        ("R0+C1+C2", {}, r"contains invalid characters \(2, first '\+'\); write it as in"),
        ("R0-P(R1,C1)", {}, r"write p\( before elements in parallel"),
        ("R0-(R1,C1)", {}, r"write p\( before elements in parallel"),
        ("Rs-p(R1,C1)", {}, "'Rs' is not an element; a name is a kind and a number, such as R1"),
        ("R0-p(R1,CPEdl)", {}, "'CPEdl' is not an element; a name is a kind and a number, such as CPE1"),
        ("R0-C1", {"fixed": {"R1": 1.0}}, "fixed parameter 'R1' does not occur"),
        ("R0-C1", {"fixed": {"R0": 1.0, "C1": 1.0}}, "no parameter of R0-C1 is free"),
        ("R0-C1", {"bounds": {"R0": (2, 1)}}, "are not an interval"),
        ("R0-C1", {"bounds": {"R0": (-1, -0.5)}}, "bounds of R0, -1 to -0.5, leave no range: R0 lies between 1e-18"),
        ("R0-C1", {"bounds": {"R0": (-1, 0)}}, r"leave no range.* or fix the value with fixed="),
        ("R0-C1", {"bounds": {"R0": (1e19, np.inf)}}, "leave no range"),
        ("R0-C1", {"bounds": {"R0": (np.nan, 1)}}, "are not an interval"),
        ("R0-C1", {"bounds": {"R0": (np.inf, np.inf)}}, "are not an interval"),
        ("R0-C1", {"bounds": {"R0": (1, 1)}}, "are not an interval"),
        ("R0-CPE1", {"bounds": {"CPE1_alpha": (1, 2)}}, "leave no range: CPE1_alpha lies between 0.05 and 1"),
        ("R0-CPE1", {"bounds": {"CPE1_alpha": (-1, 0)}}, "leave no range"),
        ("R0-CPE1", {"bounds": {"CPE1_alpha": (0.5, 1.2)}}, "exceed its largest value 1; use 1"),
        ("R0-CPE1", {"fixed": {"CPE1_alpha": 2.0}}, "is not admissible: CPE1_alpha lies between 0.05 and 1"),
        ("R0-C1", {"fixed": {"R0": -1.0}}, "is not admissible"),
        ("R0-C1", {"fixed": {"R0": np.nan}}, "is not admissible"),
        ("R0-C1", {"start": {"R0": -1.0}}, "start= is out of the bounds"),
        ("R0-CPE1", {"orders": {"CPE1_alpha": 0.5}}, "orders= and delay= apply to equations"),
    ],
)
def test_bad_circuits_are_refused_in_words(circuit, options, words):
    with pytest.raises(ftlm.ModelError, match=words):
        ftlm.identify_frequency(spectrum(r(1.0)), circuit, **options)


def test_a_finite_diffusion_has_no_equation_and_says_so():
    formula, true = CASES["R0-p(C1,R1-Wo1)"]
    found = ftlm.identify_frequency(spectrum(formula(*true)), "R0-p(C1,R1-Wo1)")
    with pytest.raises(ftlm.ModelError, match=r"Wo1 .* has no equation with powers of s; use .circuit.impedance"):
        _ = found.model


def test_a_circuit_on_the_command_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record = spectrum(CASES["R0 - p(R1, CPE1) - W1"][0](0.01, 0.02, 0.8, 0.85, 0.003))
    table = np.c_[F, record.response.real, record.response.imag]
    np.savetxt(
        "cell.csv", table, delimiter=",", header="freq [Hz],Zreal [Ohm],Zimag [Ohm]", comments="", encoding="utf-8"
    )
    words = [
        "identify-frequency",
        "cell.csv",
        "--circuit",
        "R0-p(R1,CPE1)-W1",
        "--bounds",
        "R1=0:1",
        "--report",
        "a.html",
    ]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0
    assert "W1_sigma" in result.output
    assert (tmp_path / "a.html").exists()


def test_intervals_of_positive_parameters_are_positive():
    # A finite diffusion whose end the spectrum does not reach: only its short-time slope is known.
    g = np.random.default_rng(3)
    f = np.geomspace(0.01, 1e4, 50)
    s = 2j * np.pi * f
    z = 0.02 + 0.1 / np.tanh(np.sqrt(400 * s)) / np.sqrt(400 * s)
    noisy = z * (1 + 0.003 * (g.standard_normal(50) + 1j * g.standard_normal(50)))
    found = ftlm.identify_frequency(ftlm.FrequencyData.from_arrays(2 * np.pi * f, noisy), "R0-Wo1")
    for name, (low, high) in found.intervals.items():
        value = found.values[name]
        assert 0 < low < value < high
        if found.standard_errors[name] < 0.2 * value:
            assert low * high == pytest.approx(value**2, rel=1e-9)
    # The end of the diffusion is at least as far as the spectrum shows, or nowhere.
    assert found.intervals["Wo1_tau"][0] < 400
    assert found.intervals["Wo1_tau"][1] == np.inf
    assert "Wo1_tau is not distinguishable from infinity (99 %)" in str(found.warnings)
