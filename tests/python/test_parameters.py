"""Parameters of results: the same names for time, frequency, search and selection results."""

from functools import cache

import numpy as np
import pytest

import ftlm

PLANT = "D y = -2 y + 3 u"
STRUCTURE = "D y = a y + b u"
DELAY = 0.06


@cache
def run(seed=1, samples=500):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], samples // 10), 10)
    plant = ftlm.Model(ftlm.equation(PLANT, delay={"u": DELAY}))
    empty = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": 0 * u}, units={"u": "V", "y": "rad"})
    clean = plant.simulate(empty)
    return clean.with_outputs({"y": clean["y"] + 0.01 * rng.standard_normal(samples)})


@cache
def identified():
    return ftlm.identify(run(), ftlm.equation(STRUCTURE, delay={"u": (0.0, 0.2)}))


def test_parameters_have_values_errors_intervals_and_units():
    found = identified().parameters
    assert list(found) == ["a", "b", "delay_u"]
    for name, truth in {"a": -2.0, "b": 3.0, "delay_u": DELAY}.items():
        parameter = found[name]
        assert parameter.name == name
        assert not parameter.fixed
        assert abs(parameter.value - truth) < 4 * parameter.standard_error
        low, high = parameter.interval
        assert low < parameter.value < high
    assert {n: p.unit for n, p in found.items()} == {"a": "s^-1", "b": "s^-1 rad/V", "delay_u": "s"}
    assert str(found["b"]).startswith(f"b = {found['b'].value:.6g} s^-1 rad/V (standard error ")


def test_covariance_agrees_with_standard_errors():
    found = identified()
    deviations = np.sqrt(np.diag(found.covariance))
    assert deviations == pytest.approx([found.parameters[n].standard_error for n in found.names])


def test_given_delay_is_fixed():
    found = ftlm.identify(run(), ftlm.equation(STRUCTURE, delay={"u": DELAY}))
    delay = found.parameters["delay_u"]
    assert (delay.value, delay.fixed, delay.unit) == (DELAY, True, "s")
    assert np.isnan(delay.standard_error)
    assert str(delay) == "delay_u = 0.06 s (fixed)"
    assert [n for n, p in found.parameters.items() if not p.fixed] == ["a", "b"]
    assert "fixed" in str(found)


def test_method_without_errors_has_free_parameters_without_errors():
    found = ftlm.identify(run(), ftlm.equation(STRUCTURE, delay={"u": DELAY}), method="least-squares")
    assert found.names == ("a", "b")
    assert found.covariance.shape == (2, 2)
    assert np.isnan(found.covariance).all()
    assert not found.parameters["a"].fixed
    assert str(found.parameters["a"]) == f"a = {found.coefficients['a']:.6g} s^-1"


def test_frame_has_a_row_for_each_parameter():
    frame = identified().to_frame()
    assert list(frame.index) == list(identified().parameters)
    assert frame.loc["b", "unit"] == "s^-1 rad/V"
    assert frame.loc["a", "low"] == identified().parameters["a"].interval[0]


def test_frequency_result_has_the_same_names():
    omega = np.geomspace(0.1, 100, 40)
    rng = np.random.default_rng(4)
    exact = 3 / (1j * omega + 2)
    noise = 0.002 * (rng.standard_normal(40) + 1j * rng.standard_normal(40))
    data = ftlm.FrequencyData(omega, exact * (1 + noise), output="y", input="u")
    found = ftlm.identify_frequency(data, ftlm.equation(STRUCTURE))
    assert found.parameters["a"].value == pytest.approx(-2.0, rel=0.01)
    assert found.parameters["a"].interval == found.intervals["a"]
    assert found.verdict.level == "with care"
    assert found.validate(data).verdict.level == "with care"
    residual = (found.model.frequency_response(omega)[0, 0] - data.response) / np.abs(data.response)
    expected = 100 - 100 * np.sqrt(np.mean(np.abs(residual) ** 2))
    assert found.fit == {"y": pytest.approx(expected)}
    assert list(found.to_frame().index) == ["a", "b"]


def test_search_and_selection_have_the_same_names():
    free = ftlm.equation("D^alpha y = a y + b u", delay={"u": DELAY})
    search = ftlm.search_orders(run(), free, ftlm.OrderGrid(alpha=(0.5, 1.5, 0.5)))
    assert {n: p.value for n, p in search.parameters.items()} == {**search.orders, **search.coefficients}
    at_rank_1 = ftlm.identify(run(), free.with_orders(search.orders), method="multi-innovation")
    assert search.verdict == at_rank_1.verdict
    chosen = ftlm.select(run(), [ftlm.equation(STRUCTURE, delay={"u": DELAY})])
    assert chosen.parameters == chosen.best.parameters
    assert chosen.verdict == chosen.best.verdict
    assert chosen.covariance.shape == (2, 2)
    assert chosen.validate(run(seed=2)).fit["y"] > 95
    assert chosen.summary() == str(chosen)
    assert list(chosen.standard_errors) == list(chosen.intervals) == list(chosen.coefficients) == ["a", "b"]
    assert chosen.orders == {}


SHARED_NAMES = (
    *("parameters", "values", "standard_errors", "intervals", "names", "covariance", "orders", "coefficients"),
    *("model", "fit", "fit_percent", "findings", "warnings", "verdict"),
)


def shared_results(tmp_path):
    text = "D^alpha y = a y + b u"
    omega = np.geomspace(0.1, 100, 40)
    data = ftlm.FrequencyData(omega, 3 / ((1j * omega) ** 0.9 + 2), output="y", input="u")
    return {
        "identify": ftlm.identify(run(), text),
        "least squares": ftlm.identify(run(), "D y = a y + b u", method="least-squares"),
        "search": ftlm.search_orders(run(), text, ftlm.OrderGrid(alpha=(0.5, 1.5, 0.5))),
        "select": ftlm.select(run(), ["D y = a y + b u", "D^2 y = a y + b D y + c0 u"]),
        "frequency": ftlm.identify_frequency(data, text),
    }, data


def test_all_results_have_the_shared_names_and_take_equations_as_text(tmp_path):
    results, data = shared_results(tmp_path)
    for kind, found in results.items():
        for name in SHARED_NAMES:
            getattr(found, name)
        assert found.covariance.shape == (len(found.names), len(found.names)), kind
        assert set(found.names) <= set(found.values), kind
        assert found.fit["y"] == found.fit_percent["y"]
        assert len(found.warnings) == len(found.findings)
        assert str(found) in (found.summary(), str(found))
        assert found.to_frame().shape[0] > 0
        assert found.report(tmp_path / f"{kind}.html").exists()
        checked = found.validate(data if kind == "frequency" else run(seed=2))
        assert checked.verdict.level in ("trust", "with care", "do not use")
        assert set(checked.fit) == {"y"}
        assert isinstance(checked.findings, tuple)
        assert checked.to_frame().shape[0] > 0
    wrong = ftlm.FrequencyData(data.frequency, 3 * data.response, output="y", input="u")
    missed = results["frequency"].validate(wrong)
    assert missed.fit["y"] < 50
    assert [f.code for f in missed.findings] == ["response_missed", "response_lost"]
    assert len(missed.warnings) == 2


def test_a_text_without_an_equation_is_refused_by_every_estimator():
    for call in (ftlm.identify, ftlm.search_orders, ftlm.select):
        with pytest.raises(ftlm.ModelError, match=r"'y'|equation"):
            call(run(), "y")
        with pytest.raises(ftlm.ModelError, match="is int"):
            call(run(), [3] if call is ftlm.select else 3)
    assert ftlm.identify_many([run()], STRUCTURE)[0].result.coefficients.keys() == {"a", "b"}
