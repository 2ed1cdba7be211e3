"""Fractional integrals and derivatives against closed forms, matrices and transforms against the naive oracles."""

from math import gamma

import numpy as np
import pandas as pd
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ftlm
import oracles
from ftlm import _core

DEFINITIONS = ("grunwald-letnikov", "riemann-liouville", "caputo")
RULES = ("block-pulse", "trapezoidal", "grunwald-letnikov")


def power_means(exponent, m, step):
    """Pulse means of t^exponent."""
    edges = (np.arange(m + 1) * step) ** (exponent + 1)
    return np.diff(edges) / (exponent + 1) / step


def known_values(reference, function, order, definition, exponent=None):
    """Closed form by instant."""
    document = reference("derivatives")
    for r in document["records"]:
        if (r["function"], r["order"], r["definition"]) == (function, order, definition) and (
            exponent is None or r["exponent"] == exponent
        ):
            return dict(zip(document["t"], r["values"], strict=True))
    return None


# ----------------------------------------------------------------------------------------------------------------------
# Integrals


@pytest.mark.parametrize("order", [0.3, 0.5, 1.0, 1.7, 3.0])
def test_block_pulse_rule_is_exact_for_a_constant(order):
    m, step = 300, 0.02
    found = ftlm.fractional_integral(np.ones(m), order, step=step)
    exact = power_means(order, m, step) / gamma(order + 1)
    np.testing.assert_allclose(found, exact, atol=1e-12 * exact.max())


@pytest.mark.parametrize("order", [0.3, 0.5, 1.0, 1.7, 3.0])
def test_trapezoidal_rule_is_exact_for_a_straight_line(order):
    t = np.arange(300) * 0.02
    found = ftlm.fractional_integral(2 - 3 * t, order, step=0.02, rule="trapezoidal")
    exact = 2 * t**order / gamma(order + 1) - 3 * t ** (order + 1) / gamma(order + 2)
    np.testing.assert_allclose(found, exact, atol=1e-13 * np.abs(exact).max())


@pytest.mark.parametrize(("rule", "rate"), [("block-pulse", 2), ("trapezoidal", 2), ("grunwald-letnikov", 1)])
@pytest.mark.parametrize("order", [0.3, 0.5, 1.2])
def test_integrals_converge_at_their_order(reference, rule, rate, order):
    exact = known_values(reference, "sin(t)", order, "integral")[2.0]
    errors = []
    for n in (200, 400, 800):
        step = 2.0 / n
        if rule == "block-pulse":
            # Pulse means of sin; the mean of the pulses on either side of t = 2 stands for that instant.
            edges = np.cos(np.arange(n + 2) * step)
            means = ftlm.fractional_integral((edges[:-1] - edges[1:]) / step, order, step=step)
            value = (means[n - 1] + means[n]) / 2
        else:
            value = ftlm.fractional_integral(np.sin(np.arange(n + 1) * step), order, step=step, rule=rule)[-1]
        errors.append(abs(value - exact))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(rate, abs=0.2)
    assert np.log2(errors[1] / errors[2]) == pytest.approx(rate, abs=0.1)


@pytest.mark.parametrize("rule", RULES)
def test_whole_orders_are_the_ordinary_integral(rule):
    x = np.random.default_rng(2).standard_normal(50)
    once = ftlm.fractional_integral(x, 1, step=0.1, rule=rule)
    expected = {
        "block-pulse": 0.1 * (np.cumsum(x) - x / 2),
        "trapezoidal": 0.1 * np.concatenate([[0], np.cumsum((x[1:] + x[:-1]) / 2)]),
        "grunwald-letnikov": 0.1 * np.cumsum(x),
    }[rule]
    np.testing.assert_allclose(once, expected, atol=1e-14)
    np.testing.assert_array_equal(ftlm.fractional_integral(x, 0, step=0.1, rule=rule), x)


@settings(max_examples=25, deadline=None)
@given(a=st.floats(0.0, 1.5), b=st.floats(0.0, 1.5), seed=st.integers(0, 99))
def test_grunwald_letnikov_orders_add_up(a, b, seed):
    x = np.random.default_rng(seed).standard_normal(40)
    options = {"step": 0.1, "rule": "grunwald-letnikov"}
    twice = ftlm.fractional_integral(ftlm.fractional_integral(x, a, **options), b, **options)
    np.testing.assert_allclose(twice, ftlm.fractional_integral(x, a + b, **options), atol=1e-10)
    back = ftlm.fractional_derivative(ftlm.fractional_integral(x, a, **options), a, step=0.1)
    np.testing.assert_allclose(back, x, atol=1e-9)


@pytest.mark.parametrize("order", [0.15, 1.0, 2.95])
def test_block_pulse_rule_is_the_oracles_matrix(order):
    x = np.random.default_rng(3).standard_normal(333)
    np.testing.assert_allclose(
        ftlm.fractional_integral(x, order, step=0.03), oracles.integrate(x, order, 333 * 0.03), rtol=1e-10, atol=1e-11
    )


# ----------------------------------------------------------------------------------------------------------------------
# Derivatives


def test_absurd_numbers_of_points_are_refused():
    with pytest.raises(ftlm.ModelError, match=r"m = 1e\+?15|m = 10{15} is outside \[0, 134217728\]; use a number"):
        _core.block_pulse_kernels(np.array([0.5]), 10**15, 0.1)


def test_figures_of_nothing_are_refused():
    with pytest.raises(ftlm.DataError, match="measured has length 0, but 1 is needed"):
        _core.metrics(np.zeros(0), np.zeros(0))


@pytest.mark.parametrize("order", [0.3, 0.5, 1.2, 1.8, 2.4])
@pytest.mark.parametrize("definition", DEFINITIONS[1:])
@pytest.mark.parametrize("function", ["exp(-t)", "sin(t)"])
def test_derivatives_against_closed_forms(reference, function, definition, order):
    known = known_values(reference, function, order, definition)
    step = 1e-3
    t = np.arange(10_001) * step
    x = np.exp(-t) if function == "exp(-t)" else np.sin(t)
    initial = [1.0, -1.0, 1.0] if function == "exp(-t)" else [0.0, 1.0, 0.0]
    found = ftlm.fractional_derivative(x, order, step=step, definition=definition, initial=initial)
    # L1 on the highest whole derivative: order 2 - frac, so the worst is frac = 0.8 at 1e-3^1.2.
    for instant in (1.0, 2.0, 5.0):
        assert found[round(instant / step)] == pytest.approx(known[instant], abs=3e-4)


@pytest.mark.parametrize(("order", "rate"), [(0.3, 1.7), (0.5, 1.5), (1.2, 1.8), (1.8, 1.2)])
def test_caputo_converges_at_its_order(reference, order, rate):
    exact = known_values(reference, "sin(t)", order, "caputo")[2.0]
    errors = []
    for n in (400, 800, 1600):
        x = np.sin(np.arange(n + 1) * 2.0 / n)
        found = ftlm.fractional_derivative(x, order, step=2.0 / n, definition="caputo", initial=[0.0, 1.0])
        errors.append(abs(found[-1] - exact))
    assert np.log2(errors[0] / errors[2]) / 2 == pytest.approx(rate, abs=0.2)


@pytest.mark.parametrize("order", [0.5, 1.2])
def test_grunwald_letnikov_is_first_order_for_signals_that_start_at_zero(reference, order):
    exponent = 2.0
    exact = gamma(exponent + 1) / gamma(exponent + 1 - order) * 2.0 ** (exponent - order)
    errors = []
    for n in (200, 400, 800):
        x = (np.arange(n + 1) * 2.0 / n) ** exponent
        errors.append(abs(ftlm.fractional_derivative(x, order, step=2.0 / n)[-1] - exact))
    assert np.log2(errors[0] / errors[2]) / 2 == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("definition", DEFINITIONS)
def test_definitions_agree_from_rest_and_with_the_closed_form(reference, definition):
    step = 5e-4
    t = np.arange(4001) * step
    found = ftlm.fractional_derivative(t**2, 0.5, step=step, definition=definition)
    np.testing.assert_allclose(found[400:], gamma(3) / gamma(2.5) * t[400:] ** 1.5, rtol=2e-3)


def test_riemann_liouville_is_infinite_where_a_signal_does_not_start_at_zero():
    found = ftlm.fractional_derivative(np.ones(20), 0.5, step=0.1, definition="riemann-liouville")
    assert np.isinf(found[0])
    t = np.arange(1, 20) * 0.1
    np.testing.assert_allclose(found[1:], t**-0.5 / gamma(0.5), rtol=1e-12)
    caputo = ftlm.fractional_derivative(np.ones(20), 0.5, step=0.1, definition="caputo")
    np.testing.assert_allclose(caputo, 0, atol=1e-14)


@pytest.mark.parametrize("definition", DEFINITIONS)
def test_whole_derivatives_are_the_ordinary_ones(definition):
    step = 0.01
    t = np.arange(200) * step
    inner = slice(3, -3)
    once = ftlm.fractional_derivative(t**3, 1, step=step, definition=definition)
    twice = ftlm.fractional_derivative(t**3, 2, step=step, definition=definition)
    tolerance = 0.07 if definition == "grunwald-letnikov" else 2e-3
    np.testing.assert_allclose(once[inner], 3 * t[inner] ** 2, atol=tolerance)
    np.testing.assert_allclose(twice[inner], 6 * t[inner], atol=2 * tolerance)
    np.testing.assert_array_equal(ftlm.fractional_derivative(t, 0, step=step, definition=definition), t)


def test_known_initial_values_are_used_and_missing_ones_are_differences():
    step = 0.01
    t = np.arange(400) * step
    x = 1 + 2 * t
    options = {"step": step, "definition": "riemann-liouville"}
    guessed = ftlm.fractional_derivative(x, 1.5, **options)
    given_all = ftlm.fractional_derivative(x, 1.5, initial=[1.0, 2.0], **options)
    given_one = ftlm.fractional_derivative(x, 1.5, initial=1.0, **options)
    np.testing.assert_allclose(guessed[1:], given_all[1:], atol=1e-9)
    np.testing.assert_allclose(given_one[1:], given_all[1:], atol=1e-9)
    wrong = ftlm.fractional_derivative(x, 1.5, initial=[1.0, 3.0], **options)
    assert np.max(np.abs(wrong - given_all)[1:]) > 0.1


def test_initial_values_of_several_signals():
    step, t = 0.01, np.arange(100) * 0.01
    x = np.stack([1 + t, 2 - t])
    options = {"step": step, "definition": "caputo"}
    each = ftlm.fractional_derivative(x, 1.5, initial=[[1.0, 1.0], [2.0, -1.0]], **options)
    for row, start in zip(range(2), ([1.0, 1.0], [2.0, -1.0]), strict=True):
        np.testing.assert_array_equal(each[row], ftlm.fractional_derivative(x[row], 1.5, initial=start, **options))


# ----------------------------------------------------------------------------------------------------------------------
# Arrays in, arrays out


@pytest.mark.parametrize("axis", [0, 1, 2, -1, -3])
def test_axes(axis):
    x = np.random.default_rng(4).standard_normal((4, 8, 2)) if axis != 1 else np.random.default_rng(4).random((3, 8, 5))
    calls = {
        "integral": lambda v, a: ftlm.fractional_integral(v, 0.7, step=0.1, axis=a),
        "derivative": lambda v, a: ftlm.fractional_derivative(v, 0.7, step=0.1, axis=a),
        "transform": lambda v, a: ftlm.haar_transform(v, axis=a),
        "inverse": lambda v, a: ftlm.haar_inverse(v, axis=a),
    }
    for name, call in calls.items():
        found = call(x, axis)
        assert found.shape == x.shape, name
        np.testing.assert_array_equal(found, np.apply_along_axis(lambda v, call=call: call(v, -1), axis, x))


def test_arrays_are_never_changed_and_may_be_read_only_or_strided():
    x = np.random.default_rng(5).standard_normal(64)
    kept = x.copy()
    x.flags.writeable = False
    strided = np.repeat(x, 3)[::3]
    for call in (
        lambda v: ftlm.fractional_integral(v, 0.5, step=0.1),
        lambda v: ftlm.fractional_derivative(v, 0.5, step=0.1, definition="caputo"),
        ftlm.haar_transform,
        ftlm.haar_inverse,
    ):
        found = call(x)
        np.testing.assert_array_equal(call(strided), found)
        np.testing.assert_array_equal(call(x[::-1][::-1]), found)
        assert not np.shares_memory(found, x)
    np.testing.assert_array_equal(x, kept)


def test_whatever_holds_real_numbers_is_an_array():
    values = [1, 2, 4, 8]
    expected = ftlm.fractional_integral(np.array(values, float), 0.5, step=1)
    for given_values in (
        values,
        np.array(values, np.int8),
        np.array(values, np.float32),
        pd.Series(values, index=[9, 8, 7, 6]),
        pl.Series(values),
        tuple(values),
    ):
        np.testing.assert_array_equal(ftlm.fractional_integral(given_values, 0.5, step=1), expected)
    frame = pd.DataFrame({"a": values, "b": values})
    np.testing.assert_array_equal(ftlm.fractional_integral(frame, 0.5, step=1, axis=0)[:, 1], expected)


# ----------------------------------------------------------------------------------------------------------------------
# Matrices and transforms


@pytest.mark.parametrize("m", [1, 2, 8, 64])
def test_haar_matrix_is_the_oracles_and_orthogonal(m):
    phi = ftlm.haar_matrix(m)
    np.testing.assert_allclose(phi, oracles.haar_matrix(m), atol=1e-15)
    np.testing.assert_allclose(phi @ phi.T, np.eye(m), atol=1e-14)


@pytest.mark.parametrize("m", [1, 2, 8, 256])
def test_haar_transform_is_the_matrix_and_its_inverse_the_transpose(m):
    x = np.random.default_rng(6).standard_normal((3, m))
    phi = oracles.haar_matrix(m)
    np.testing.assert_allclose(ftlm.haar_transform(x), x @ phi.T, atol=1e-13)
    np.testing.assert_allclose(ftlm.haar_inverse(x), x @ phi, atol=1e-13)
    np.testing.assert_allclose(ftlm.haar_inverse(ftlm.haar_transform(x)), x, atol=1e-13)


@pytest.mark.parametrize("m", [1, 7, 64])
@pytest.mark.parametrize("order", [0.0, 0.35, 1.0, 2.2, 3.0])
def test_block_pulse_matrix_is_the_oracles(order, m):
    found = ftlm.block_pulse_matrix(order, m, step=5.0 / m)
    np.testing.assert_allclose(found, oracles.block_pulse_matrix(order, m, 5.0), rtol=1e-13)
    np.testing.assert_array_equal(found, np.triu(found))


@pytest.mark.parametrize("m", [1, 4, 64])
@pytest.mark.parametrize("order", [0.0, 0.35, 1.0, 2.2])
def test_operational_matrix_is_the_oracles(order, m):
    found = ftlm.operational_matrix(order, m, step=5.0 / m)
    expected = oracles.operational_matrix(order, m, 5.0)
    np.testing.assert_allclose(found, expected, atol=1e-13 * np.abs(expected).max())
    dense = _core.operational_matrix(order, m, 5.0 / m, dense=True)
    np.testing.assert_allclose(found, dense, atol=1e-13 * np.abs(expected).max())


def test_signals_matrices_and_haar_coordinates_say_the_same():
    m, order, duration = 128, 0.85, 4.0
    x = np.random.default_rng(7).standard_normal(m)
    integral = ftlm.fractional_integral(x, order, step=duration / m)
    np.testing.assert_allclose(x @ ftlm.block_pulse_matrix(order, m, step=duration / m), integral, atol=1e-12)
    in_haar = ftlm.haar_transform(x) @ ftlm.operational_matrix(order, m, step=duration / m)
    np.testing.assert_allclose(ftlm.haar_inverse(in_haar), integral, atol=1e-12)


def test_series_products_and_quotients_are_their_naive_selves():
    rng = np.random.default_rng(8)
    for m in (1, 63, 64, 65, 500):
        a, b = rng.standard_normal((2, m))
        np.testing.assert_allclose(_core.series_multiply(a, b, m), np.convolve(a, b)[:m], atol=1e-12 * np.sqrt(m))
        b[0] = 3.0
        decaying = b * 0.8 ** np.arange(m)
        np.testing.assert_allclose(
            _core.series_divide(a, decaying), _core.series_divide(a, decaying, naive=True), rtol=1e-9, atol=1e-9
        )
