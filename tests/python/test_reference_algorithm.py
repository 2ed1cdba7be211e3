"""The literal algorithm of `benches/literal.py` does what the naive oracles do, so a race against it is a fair one."""

import numpy as np
import pytest

import literal
import oracles

M = 64


@pytest.mark.parametrize("p", [1, 3, 7])
@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_candidate_agrees_with_the_oracles(p, scale):
    y, u, orders, duration = literal.example(M)
    y = y + 0.01 * np.random.default_rng(1).standard_normal(M)
    found = literal.evaluate_candidate(y, [None, None, u], orders, p, scale, m=M, duration=duration)

    q = oracles.regressors([y, y, u], orders[1:], orders[0], duration)
    expected = oracles.multi_innovation_recursion(q, oracles.haar_matrix(M) @ y, p, scale)[-1]
    np.testing.assert_allclose(found.coefficients, expected, rtol=1e-9)

    a, b, g = expected
    response = oracles.free_run([(a, 0.9), (b, 0.0)], [(g, 0.0, u)], orders[0], M, duration)
    np.testing.assert_allclose(found.output, response, rtol=0, atol=1e-9 * np.abs(response).max())
    assert found.error == pytest.approx(oracles.absolute_error(y, response), rel=1e-9)


def test_coupled_signal_is_an_input_of_the_free_run():
    # A measured second angle enters as exogenous, at an order above zero and with a matrix for K0.
    rng = np.random.default_rng(2)
    duration, orders = 5.0, [2.0, 0.95, 0.75, 0.0]
    angle, current = rng.standard_normal((2, M)).cumsum(axis=1) / 10
    truth = oracles.free_run([(-3.0, 0.95)], [(4.0, 0.75, angle), (2.0, 0.0, current)], 2.0, M, duration)
    prior = np.diag([1e6, 1e7, 1e8])
    found = literal.evaluate_candidate(truth, [None, angle, current], orders, 5, prior, m=M, duration=duration)
    np.testing.assert_allclose(found.coefficients, [-3.0, 4.0, 2.0], rtol=1e-3)  # the prior pulls a little
    q = oracles.regressors([truth, angle, current], orders[1:], 2.0, duration)
    closed = oracles.multi_innovation_closed_form(q, oracles.haar_matrix(M) @ truth, 5, prior)
    np.testing.assert_allclose(found.coefficients, closed, rtol=1e-8)


def test_operational_matrix_is_the_oracles():
    phi = literal.haar_matrix(M)
    np.testing.assert_array_equal(phi, oracles.haar_matrix(M))
    expected = oracles.operational_matrix(1.3, M, 7.0)
    np.testing.assert_allclose(literal.operational_matrix(1.3, phi, 7.0), expected, atol=1e-11 * np.abs(expected).max())


def test_rejects_lengths_that_have_no_haar_matrix():
    with pytest.raises(ValueError, match="power of two"):
        literal.evaluate_candidate(np.zeros(12), [None], [1.0, 0.0], 1, 1.0, m=12, duration=1.0)


def test_self_check_runs(capsys):
    literal.main()
    assert "coefficients" in capsys.readouterr().out
