"""Frequency response, poles, stability and steps against closed forms, whole-order algebra and free runs."""

import math
from dataclasses import replace

import numpy as np
import pytest

import ftlm
from ftlm import analysis
from ftlm.analysis.frequency_response import parameter_vector
from ftlm.analysis.polynomial_zeros import right_zeros, roots_in_base
from ftlm.reproduction.simulated_arm import demo_plant

TWO = "D^1.7 y = -20 y - 2 D^0.7 y + 15 z + 10 u; D^1.2 z = -5 z + 3 D^0.4 y + 2 D^0.3 u + v"


def model(text, **options):
    return ftlm.Model(ftlm.equation(text, **options))


# ------------------------------------------------------------------------------------------------ response


def test_one_equation_is_its_quotient():
    w = np.geomspace(1e-3, 1e4, 60)
    s = 1j * w
    found = model("D^1.6 y = -3 D^0.6 y - 8 y + 5 D^0.2 u + 2 v", delay={"v": 0.3}).frequency_response(w)
    below = s**1.6 + 3 * s**0.6 + 8
    assert found.shape == (1, 2, 60)
    np.testing.assert_allclose(found[0, 0], 5 * s**0.2 / below, rtol=1e-13)
    np.testing.assert_allclose(found[0, 1], 2 * np.exp(-0.3 * s) / below, rtol=1e-13)


def test_coupled_equations_together_and_alone():
    w = np.geomspace(0.01, 100, 40)
    s = 1j * w
    together = model(TWO).frequency_response(w)
    alone = model(TWO).frequency_response(w, coupling="measured")
    assert together.shape == (2, 2, 40)  # y, z from u, v
    assert alone.shape == (2, 4, 40)  # y, z from y, z, u, v
    a = s**1.7 + 20 + 2 * s**0.7
    b = s**1.2 + 5
    determinant = a * b - 15 * 3 * s**0.4
    np.testing.assert_allclose(together[0, 0], (10 * b + 15 * 2 * s**0.3) / determinant, rtol=1e-12)
    np.testing.assert_allclose(together[1, 1], a / determinant, rtol=1e-12)
    np.testing.assert_allclose(alone[0, 1], 15 / a, rtol=1e-12)
    assert np.all(alone[0, 0] == 0)
    quotients = analysis.transfer_functions(model(TWO))
    for i, output in enumerate(quotients.outputs):
        for j, signal in enumerate(quotients.inputs):
            top, bottom = (
                sum(c * s**p for c, p in pairs)
                for pairs in (quotients.numerators[output, signal], quotients.denominator[output])
            )
            np.testing.assert_allclose(together[i, j], top / bottom, rtol=1e-10)


@pytest.mark.parametrize("stage", [1, 2])
def test_the_response_is_that_of_the_free_run(stage):
    # A sine long enough: what is left of the transient dies as a power of time.
    plant, omega, step = demo_plant(stage, form="published"), 3.0, 0.01
    t = np.arange(6001) * step
    # The hub drifts: compare the deflection, which does not.
    empty = ftlm.Run.from_arrays(
        step=step, inputs={f"I{stage}": np.sin(omega * t)}, outputs={o: 0 * t for o in plant.outputs}
    ).with_intersample({f"I{stage}": "foh"})
    y = plant.simulate(empty, tolerance=1e-5)[plant.outputs[1]]
    late = t > 40
    basis = np.stack([np.cos(omega * t[late]), np.sin(omega * t[late]), np.ones(late.sum())])
    c, d, _ = np.linalg.lstsq(basis.T, y[late], rcond=None)[0]
    found = plant.frequency_response([omega])[1, 0, 0]
    assert abs(found - (d + 1j * c)) < 0.01 * abs(found)


def test_the_sensor_filter_is_in_the_response_unless_asked_otherwise():
    sensor = ftlm.SensorFilter.low_pass(["y"], frequency=2.0)
    w = np.array([0.0, 1.0, 4 * math.pi])
    filtered = model("D y = -2 y + 4 u", sensor_filter=sensor)
    plain = filtered.frequency_response(w, sensor=False)
    gain = filtered.frequency_response(w)[0, 0] / plain[0, 0]
    assert abs(gain[0]) == pytest.approx(1)
    assert abs(gain[2]) == pytest.approx(1 / 1.8)
    np.testing.assert_allclose(plain[0, 0], 4 / (1j * w + 2))


def test_an_integrator_is_infinite_at_rest_and_nowhere_else():
    found = model("D^2 y = -2 D y + u").frequency_response([0.0, 1.0])
    assert np.isinf(found[0, 0, 0])
    assert found[0, 0, 1] == pytest.approx(1 / (-1 + 2j))


@pytest.mark.parametrize("w", [[-1.0], [np.nan], [np.inf], [], 1.0, [[1.0]]])
def test_frequencies_that_are_none_are_refused(w):
    with pytest.raises(ftlm.DataError, match="w "):
        model("D y = -y + u").frequency_response(w)


def test_other_couplings_are_refused():
    for call in (lambda m: m.frequency_response([1.0], coupling="x"), lambda m: m.poles(coupling="x")):
        with pytest.raises(ftlm.ModelError, match="coupling = 'x' is not known"):
            call(model("D y = -y + u"))


# ------------------------------------------------------------------------------------------------ stability and poles


def test_whole_orders_have_the_poles_of_their_polynomial():
    found = model("D^3 y = -6 D^2 y - 11 D y - 6 y + u").poles()
    np.testing.assert_allclose(found, [-1, -2, -3], atol=1e-9)
    swinging = model("D^2 y = -0.4 D y - 9 y + u")
    np.testing.assert_allclose(sorted(swinging.poles().imag), [-math.sqrt(8.96), math.sqrt(8.96)], rtol=1e-12)
    assert swinging.is_stable()
    coupled = model("D y = -y + 2 z + u; D z = -3 z - 4 y")
    np.testing.assert_allclose(
        np.sort_complex(coupled.poles()), np.sort_complex(np.linalg.eigvals([[-1, 2], [-4, -3]])), rtol=1e-10
    )


def test_poles_are_zeros_of_the_characteristic_function():
    for plant in (demo_plant(1, form="published"), model("D^1.5 y = -2 D^0.5 y - 4 y + u"), model(TWO)):
        found = plant.poles()
        assert found.size
        quotients = analysis.transfer_functions(plant)
        pairs = quotients.denominator[plant.outputs[0]]
        for s in found:
            terms = [c * s**p for c, p in pairs]
            assert abs(sum(terms)) < 1e-8 * sum(map(abs, terms))


@pytest.mark.parametrize(
    ("text", "stable", "unstable"),
    [
        ("D^0.5 y = -y + u", True, 0),
        ("D^0.5 y = y + u", False, 1),
        ("D^1.5 y = -y + u", True, 0),  # its roots s = exp(±jπ/1.5) lie on the left
        ("D^2.5 y = -y + u", False, 2),
        ("D^2 y = -y + u", False, 0),  # undamped
        ("D^2 y = 0.1 D y - y + u", False, 2),
        ("D^2 y = -0.1 D^1.5 y - y + u", True, 0),
        ("D y = u", False, 0),
        ("D^1.3 y = -2 D^0.4 y + u", False, 0),  # integrates
        ("D^2 y = -3 D y + D u", True, 0),  # its zero at the origin cancels the integrator
        ("D^1.31 y = -2 D^0.4301 y - y + u", True, 0),  # no common base
        ("D^2.31 y = -2 D^0.4301 y - 9 y + u", False, 2),
    ],
)
def test_stability_of_known_cases(text, stable, unstable):
    found = model(text).stability()
    assert (found.stable, found.unstable_poles) == (stable, unstable), str(found)
    assert bool(found) is stable
    assert model(text).is_stable() is stable
    assert str(found).startswith("stable" if stable else "not stable: ")


def test_matignon_and_the_argument_principle_agree():
    rng = np.random.default_rng(4)
    counts = []
    for _ in range(200):
        terms = int(rng.integers(2, 5))
        powers = np.sort(rng.choice(np.arange(1, 31), terms, replace=False)) / 10
        values = rng.choice([-1, 1], terms + 1, p=[0.25, 0.75]) * 10 ** rng.uniform(-2, 2, terms + 1)
        polynomial = {0.0: float(values[0])} | dict(zip(powers.tolist(), values[1:].tolist(), strict=True))
        base, roots = roots_in_base(polynomial)
        by_roots = int(np.sum(np.abs(np.angle(roots)) < base * math.pi / 2))
        count, on_axis = right_zeros(polynomial)
        assert not on_axis
        assert count == by_roots, polynomial
        counts.append(by_roots)
    assert len(set(counts)) >= 3  # stable and unstable ones are among them


def test_a_stable_model_settles_and_an_unstable_one_grows():
    rng = np.random.default_rng(6)
    agreed = 0
    for _ in range(12):
        alpha, nu = rng.uniform(1.2, 2.4), rng.uniform(0.2, 0.9)
        plant = model(f"D^{alpha:.3f} y = -{rng.uniform(0.3, 3):.3f} D^{nu:.3f} y - {rng.uniform(1, 4):.3f} y + u")
        growing = not plant.is_stable()
        y = plant.step_response(np.arange(0, 60, 0.02), tolerance=1e-3)[0, 0]
        gain = abs(plant.frequency_response([0.0])[0, 0, 0])
        late = np.max(np.abs(y[-500:] - gain)) / gain
        early = np.max(np.abs(y[500:1000] - gain)) / gain
        assert (late > early) == growing
        agreed += growing
    assert 0 < agreed < 12


def zeros_inside(polynomial: dict[float, float], radius: float) -> int:
    """Zeros of a sum of c s^p within a circle cut along the negative axis, by the turn of its value on its edge."""
    angle = math.pi - 1e-9
    along = np.geomspace(1e-8, radius, 200_001)
    round_ = np.exp(1j * np.linspace(-angle, angle, 200_001))
    path = np.concatenate(
        [along * np.exp(-1j * angle), radius * round_, along[::-1] * np.exp(1j * angle), 1e-8 * round_[::-1]]
    )
    values = sum(c * path**p for p, c in polynomial.items())
    turns = np.angle(values[1:] / values[:-1])
    assert np.max(np.abs(turns)) < 1.5
    return round(float(np.sum(turns)) / (2 * math.pi))


def test_poles_of_any_orders_are_all_zeros_on_the_principal_sheet():
    rng = np.random.default_rng(5)
    counts = []
    for _ in range(6):
        powers = np.sort(rng.uniform(0.05, 5, int(rng.integers(1, 5)))).round(4)
        values = rng.choice([-1, 1], powers.size + 1, p=[0.2, 0.8]) * 10 ** rng.uniform(-1, 1, powers.size + 1)
        polynomial = {0.0: float(values[0])} | dict(zip(powers.tolist(), values[1:].tolist(), strict=True))
        highest = powers[-1]
        own = " ".join(f"{-c / values[-1]:+.17g} D^{p} y" for p, c in polynomial.items() if p != highest)
        found = model(f"D^{highest} y = {own.replace('D^0.0 y', 'y')} + u").poles()
        for s in found:
            terms = [c * s**p for p, c in polynomial.items()]
            assert abs(sum(terms)) < 1e-8 * sum(map(abs, terms))
        reach = 10 * float(np.max(np.abs(found), initial=1.0))
        assert found.size == zeros_inside(polynomial, reach), polynomial
        counts.append(found.size)
    assert len(set(counts)) >= 3


def test_zeros_are_those_of_the_numerator():
    np.testing.assert_allclose(model("D^3 y = -y + D^2 u + 3 D u + 2 u").zeros(), [-1, -2], rtol=1e-12)
    assert not model("D^1.5 y = -y + D^0.5 u + 2 u").zeros().size  # s^0.5 = -2 is on another sheet
    fractional = model("D^2 y = -y + D^1.37 u - D^0.4 u + 2 u").zeros()
    assert fractional.size == zeros_inside({1.37: 1.0, 0.4: -1.0, 0.0: 2.0}, 100.0)
    for s in fractional:
        assert abs(s**1.37 - s**0.4 + 2) < 1e-9
    coupled = model("D y = -y + 2 z + u; D z = -3 z - 4 y + D v")
    np.testing.assert_allclose(coupled.zeros("y", "u"), [-3], rtol=1e-12)
    for bad, words in (
        ((), "the model has the outputs y, z; name one with output="),
        (("w", "u"), "output 'w' is not"),
    ):
        with pytest.raises(ftlm.ModelError, match=words):
            coupled.zeros(*bad)


def test_stability_without_a_common_base_is_that_of_the_argument_principle():
    assert model("D^1.31 y = -2 D^0.4301 y - y + u").stability().method == "argument principle"
    assert model("D^1.3 y = -2 D^0.4 y - y + u").stability().commensurate_order == pytest.approx(0.1)
    # Two equations without coupling, with bases 0.5 and 0.3.
    for text in ("D^1.5 y = -y + u; D^0.6 z = -2 D^0.3 z - z + u", "D^0.6 z = -2 D^0.3 z - z + u; D^1.5 y = -y + u"):
        assert model(text).stability().commensurate_order == pytest.approx(0.3)


# ------------------------------------------------------------------------------------------------ steps


def test_steps_are_those_of_the_closed_form():
    t = np.arange(0, 4.001, 0.01)
    found = model("D y = -2 y + 6 u", delay={"u": 0.5}).step_response(t)[0, 0]
    np.testing.assert_allclose(found, 3 * (1 - np.exp(-2 * np.maximum(t - 0.5, 0))), atol=1e-5)
    mittag_leffler = model("D^2.2 y = -0.625 D^0.9 y - 1.25 y + 1.25 u").step_response(np.arange(0, 10.001, 0.05))[0, 0]
    assert mittag_leffler[20] == pytest.approx(0.423976252450147, abs=2e-5)
    assert mittag_leffler[200] == pytest.approx(0.820332518587934, abs=2e-5)


def test_steps_of_several_inputs_stand_side_by_side():
    t = np.arange(0, 30, 0.02)
    coupled = model("D^2 y = -2 y - 3 D y + z + u; D z = -3 z - y + v + 2 u")
    found = coupled.step_response(t)
    assert found.shape == (2, 2, t.size)
    gains = coupled.frequency_response([0.0])[:, :, 0].real
    np.testing.assert_allclose(found[:, :, -1], gains, atol=1e-6)
    together = replace(coupled, structure=replace(coupled.structure, coupling="simulated"))
    both = together.simulate(
        ftlm.Run.from_arrays(step=0.02, inputs={"u": 0 * t + 1, "v": 0 * t + 1}, outputs={"y": 0 * t, "z": 0 * t})
    )
    np.testing.assert_allclose(found.sum(axis=1), np.stack([both["y"], both["z"]]), atol=1e-5)


@pytest.mark.parametrize("time", [[0, 1], [1, 2, 3], [0, 1, 3], [0, np.nan, 1], [0, 0, 0], [[0, 1, 2]]])
def test_times_that_are_none_are_refused(time):
    with pytest.raises(ftlm.DataError, match="time "):
        model("D y = -y + u").step_response(time)


# ------------------------------------------------------------------------------------------------ uncertainty


@pytest.fixture(scope="module")
def fits(small_model, small_run, with_noise):
    words = "D^alpha y = a D^0.6 y + c y + b u"
    return [ftlm.identify(with_noise(small_run, 0.02, seed), ftlm.equation(words)) for seed in range(12)]


def test_the_uncertainty_is_the_scatter_of_repeated_fits(fits, small_model):
    w = np.geomspace(0.3, 20, 12)
    truth = small_model.frequency_response(w)
    z = []
    for fit in fits:
        gain, phase = analysis.response_deviation(fit.model, w)
        ratio = fit.model.frequency_response(w) / truth
        z += [np.log(np.abs(ratio)) / gain, np.angle(ratio) / phase]
    spread = float(np.sqrt(np.mean(np.square(z))))
    assert 0.6 < spread < 1.5


def test_laws_carry_their_uncertainty_to_every_number(fits):
    fit = fits[0]
    covariance = np.array(fit.model.estimate.covariance)
    # alpha; order and coefficient of three terms, of which only alpha and the coefficients are free.
    deviations = np.sqrt(np.diag(covariance))
    expected = [fit.standard_errors[n] for n in ("alpha", "a", "c", "b")]
    np.testing.assert_allclose(deviations[[0, 2, 4, 6]], expected, rtol=1e-9)
    assert np.all(deviations[[1, 3, 5]] == 0)


def test_the_covariance_of_a_tied_coefficient_is_that_of_its_product(plant, plants, drive, with_noise):
    clean = plant("A").simulate(drive("A", 600), tolerance=1e-5)
    structure = ftlm.flexible_link(form="published", stage=1).with_orders(plants["A"]["free_orders"])
    fit = ftlm.identify(with_noise(clean, 1e-4, 1), structure)
    numbers = parameter_vector(fit.model)
    deviation = np.sqrt(np.diag(np.array(fit.model.estimate.covariance)))
    errors, values = fit.standard_errors, fit.joint.coefficients
    at = {t.name: 9 * i + 2 * k + 2 for i, e in enumerate(fit.model.equations) for k, t in enumerate(e.terms)}
    for name in ("a1", "b1"):
        assert numbers[at[name]] == pytest.approx(values[name])
        assert deviation[at[name]] == pytest.approx(errors[name], rel=1e-9)
    joint, names = fit.joint, fit.joint.names
    a, r = names.index("a1"), names.index("r1")
    product = np.zeros(len(names))
    product[a], product[r] = -values["r1"], -values["a1"]
    assert deviation[at["a2"]] == pytest.approx(math.sqrt(product @ joint.covariance @ product), rel=1e-9)


def test_what_is_known_of_a_fit_stays_with_the_saved_model(fits, tmp_path):
    fit = fits[0]
    loaded = ftlm.load_model(fit.model.save(tmp_path / "m.json"))
    assert loaded.estimate == fit.model.estimate
    assert loaded.estimate.fit == fit.fit
    w = [1.0, 3.0]
    for one, two in zip(analysis.response_deviation(loaded, w), analysis.response_deviation(fit.model, w), strict=True):
        np.testing.assert_array_equal(one, two)
    with pytest.raises(ftlm.ModelError, match="has no covariance"):
        analysis.response_deviation(model("D y = -y + u"), w)


def test_coefficients_that_ran_away_have_a_stability_that_cannot_be_told_not_an_overflow():
    # Whole orders fitted to an arm that has none: a characteristic of 1e200 beside 1, powers 0.5 apart.
    count, on_axis = right_zeros({0.0: 1e200, 0.5: 1.0})
    assert np.isnan(count)
    assert on_axis


def test_information_criteria_of_spectra_are_those_of_normal_residuals():
    rng = np.random.default_rng(7)
    f = np.geomspace(0.1, 1e3, 40)
    s = 2j * np.pi * f
    z = 0.01 + 0.05 / (1 + (s * 0.01) ** 0.8)
    noise = 1e-4 * (rng.standard_normal(40) + 1j * rng.standard_normal(40))
    cell = ftlm.FrequencyData.from_arrays(f, z + noise, frequency_unit="Hz", unit="Ω")
    found = ftlm.identify_frequency(cell, "R0-p(R1,CPE1)", weights="uniform")
    left = cell.response - found.circuit.impedance(cell.frequency)
    parts = np.concatenate([left.real, left.imag])
    level = np.sqrt(np.mean(parts**2))
    likelihood = np.sum(-0.5 * np.log(2 * np.pi * level**2) - 0.5 * (parts / level) ** 2)
    known = found.information
    # R0, R1, Q, alpha and the level of the noise.
    assert (known.parameter_count, known.sample_count) == (5, 80)
    assert known.log_likelihood == pytest.approx(likelihood, rel=1e-9)
    assert known.aic == pytest.approx(10 - 2 * likelihood, rel=1e-9)
    assert known.bic == pytest.approx(5 * np.log(80) - 2 * likelihood, rel=1e-9)
    stated = ftlm.FrequencyData.from_arrays(f, z + noise, frequency_unit="Hz", unit="Ω", deviation=np.full(40, 1e-4))
    given = ftlm.identify_frequency(stated, "R0-p(R1,CPE1)")
    left = stated.response - given.circuit.impedance(stated.frequency)
    squares = np.sum(np.abs(left / 1e-4) ** 2)
    assert given.information.parameter_count == 4
    assert given.information.log_likelihood == pytest.approx(-40 * np.log(2 * np.pi * 1e-8) - 0.5 * squares, rel=1e-9)
    poorer = ftlm.identify_frequency(cell, "R0-p(R1,C1)", weights="uniform")
    assert poorer.information.aicc > known.aicc + 10
    assert found.to_dict()["information"]["bic"] == pytest.approx(known.bic)


def test_an_impedance_is_drawn_as_size_over_hertz():
    f = np.geomspace(0.1, 1e3, 40)
    z = 10.0 + 100.0 / (1 + 2j * np.pi * f * 0.01)
    rng = np.random.default_rng(9)
    z = z * (1 + 0.01 * (rng.standard_normal(40) + 1j * rng.standard_normal(40)))
    for unit, wanted in (("Ω", ("|Z| [Ω]", "frequency [Hz]")), ("", ("gain [dB]", "frequency [rad/s]"))):
        record = ftlm.FrequencyData.from_arrays(f, z, frequency_unit="Hz", unit=unit, output="U", input="I")
        found = ftlm.identify_frequency(record, "D U = a U + r D I + b I")
        drawn = " ".join(figure._repr_html_() for figure in found.figures())
        assert all(label in drawn for label in wanted)
        # The model has a covariance, so both kinds of chart have its band.
        assert drawn.count("95 % band, from the covariance") == 2
