"""`ftlm.kernels` against dense matrices, SciPy and the recursion as published; broadcasting, and arguments refused."""

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

import ftlm
from ftlm import _core, kernels
from thread_pair import overlap

STEP = 0.1
PAIR = kernels.Candidates(np.ones((2, 4)), [1], step=STEP)
SHORT = kernels.Candidates(np.ones((2, 6)), [1], step=STEP)
ORDERS = np.array([0.0, 0.5, 1.3, 2.0])


def noise(*shape, seed=0):
    return np.random.default_rng(seed).standard_normal(shape)


def dense(kernel):
    return scipy.linalg.toeplitz(kernel, np.r_[kernel[0], np.zeros(len(kernel) - 1)])


@pytest.mark.parametrize("m", [1, 7, 64, 65, 300])
def test_integrals_are_products_with_dense_matrices(m):
    x = noise(3, m)
    found = kernels.integrate(x[:, None], ORDERS, step=STEP)
    assert found.shape == (3, 4, m)
    for order, integrals in zip(ORDERS, found.swapaxes(0, 1), strict=True):
        expected = x @ ftlm.block_pulse_matrix(order, m, step=STEP)
        np.testing.assert_allclose(integrals, expected, rtol=1e-10, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("rule", ["block-pulse", "trapezoidal", "grunwald-letnikov"])
@pytest.mark.parametrize("m", [5, 200])
def test_a_batch_has_the_integrals_of_its_signals(m, rule):
    x = noise(5, m)
    batch = ftlm.fractional_integral(x, 0.7, step=STEP, rule=rule)
    alone = [ftlm.fractional_integral(row, 0.7, step=STEP, rule=rule) for row in x]
    np.testing.assert_array_equal(batch, alone)


def test_orders_of_integrals_add():
    x = noise(2, 500)
    twice = kernels.integrate(kernels.integrate(x, 0.4, step=STEP), 0.6, step=STEP)
    once = kernels.integrate(x, 1.0, step=STEP)
    # Block pulses are second order in the step: the matrices of two orders commute, their product is near the sum's.
    assert np.abs(twice - once).max() < 0.02 * np.abs(once).max()


def test_the_derivative_of_a_kernel_is_that_of_differences():
    low, high = kernels.block_pulse_kernel([0.8 - 1e-6, 0.8 + 1e-6], 50, step=STEP)
    slope = kernels.block_pulse_kernel(0.8, 50, step=STEP, derivative=True)
    np.testing.assert_allclose(slope, (high - low) / 2e-6, rtol=1e-5, atol=1e-9)


@given(
    lead=st.sampled_from([((), ()), ((3,), ()), ((), (3,)), ((2, 1), (3,)), ((0,), (1,))]),
    m=st.integers(1, 150),
)
def test_toeplitz_systems_broadcast_and_are_solved(lead, m):
    kernel, x = 0.3 * noise(*lead[0], m) / np.arange(1, m + 1), noise(*lead[1], m, seed=1)
    kernel[..., 0] = 1.0
    product = kernels.toeplitz_apply(kernel, x)
    shape = np.broadcast_shapes(*lead)
    assert product.shape == (*shape, m)
    every, vectors = np.broadcast_to(kernel, (*shape, m)), np.broadcast_to(x, (*shape, m))
    for index in np.ndindex(shape):
        np.testing.assert_allclose(product[index], dense(every[index]) @ vectors[index], rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(kernels.toeplitz_solve(kernel, product), vectors, rtol=1e-8, atol=1e-8)


def published_recursion(q, m, p, prior):
    """(44) step by step, with the covariance as the paper writes it."""
    x, covariance, path = np.zeros(q.shape[1]), np.diag(prior), []
    for i in range(len(m)):
        rows = q[max(0, i - p + 1) : i + 1]
        inverse = np.linalg.inv(np.eye(len(rows)) + rows @ covariance @ rows.T)
        covariance = covariance - covariance @ rows.T @ inverse @ rows @ covariance
        x = x + covariance @ rows.T @ (m[max(0, i - p + 1) : i + 1] - rows @ x)
        path.append(x)
    return np.array(path)


@pytest.mark.parametrize("p", [1, 3, 7, 500])
@pytest.mark.parametrize("prior", [2.0, [0.1, 10.0, 1e3]])
def test_multi_innovation_is_the_published_recursion(p, prior):
    q, m = noise(2, 40, 3), noise(2, 40, seed=1)
    path = kernels.multi_innovation(q, m, p, prior_covariance=prior, trace=True)
    last = kernels.multi_innovation(q, m, p, prior_covariance=prior)
    assert path.shape == (2, 40, 3)
    for k in range(2):
        expected = published_recursion(q[k], m[k], p, np.broadcast_to(prior, 3))
        np.testing.assert_allclose(path[k], expected, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(last[k], expected[-1], rtol=1e-7, atol=1e-9)


def test_means_haar_and_errors_are_those_of_one_signal():
    samples = noise(2, 3, 65)
    means = kernels.pulse_means(samples, 32, hold=True)
    np.testing.assert_allclose(means[1, 2], samples[1, 2, :-1].reshape(32, 2).mean(axis=1), rtol=1e-13)
    np.testing.assert_allclose(kernels.pulse_means(samples)[0, 0], (samples[0, 0, 1:] + samples[0, 0, :-1]) / 2)
    np.testing.assert_allclose(kernels.haar(means), means @ ftlm.haar_matrix(32).T, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(kernels.haar_inverse(kernels.haar(means)), means, rtol=1e-12, atol=1e-12)
    found = kernels.errors(means, means[0] + 0.1)
    one = ftlm.metrics(means[1, 2], means[0, 2] + 0.1)
    np.testing.assert_allclose(found[1, 2], [one.error, one.rmse, one.nr, one.fit], rtol=1e-12)


def test_arguments_of_any_strides_stay_as_they_are():
    x = noise(300, 4).T
    x.flags.writeable = False
    whole = np.asarray(x, dtype=np.float32)
    kept = whole.copy()
    np.testing.assert_allclose(
        kernels.integrate(whole, 0.5, step=STEP), kernels.integrate(kept.astype(float), 0.5, step=STEP)
    )
    np.testing.assert_array_equal(whole, kept)
    kernels.integrate(x, 0.5, step=STEP)
    assert kernels.integrate(np.zeros((0, 3, 8)), ORDERS[:3], step=STEP).shape == (0, 3, 8)
    assert kernels.haar(np.zeros((0, 8))).shape == (0, 8)
    assert kernels.multi_innovation(np.zeros((0, 5, 2)), np.zeros((0, 5)), prior_covariance=1.0).shape == (0, 2)


@pytest.mark.parametrize(
    ("name", "work"),
    [
        ("toeplitz_apply", lambda x: kernels.integrate(x, 0.3, step=STEP)),
        ("toeplitz_solve", lambda x: kernels.toeplitz_solve(np.r_[2.0, x[0, 1:]], x[:16])),
        ("pulse_mean_rows", lambda x: kernels.pulse_means(x, 30_000)),
        ("multi_innovation_rows", lambda x: kernels.multi_innovation(x[:8].T, x[8], 7, prior_covariance=1.0)),
    ],
)
def test_two_threads_compute_at_once_what_one_does(monkeypatch, name, work):
    """No thread is made to give up the interpreter, so that the second call begins only if the first one lets go."""
    x, found = 0.01 * noise(64, 16384), {}
    alone = work(x)
    assert overlap(lambda key: found.__setitem__(key, work(x)), monkeypatch, _core, name)
    for one in found.values():
        np.testing.assert_array_equal(one, alone)


def candidates(m=64, seed=4):
    """An equation with an own term and two inputs, and order tuples around the one that made the output."""
    rng = np.random.default_rng(seed)
    u, v = np.repeat(rng.standard_normal((2, m // 8)), 8, axis=1)
    forced = 2.0 * kernels.integrate(u, 1.6, step=STEP) + 0.5 * kernels.integrate(v, 1.2, step=STEP)
    divisor = 0.8 * kernels.block_pulse_kernel(0.7, m, step=STEP)
    divisor[0] += 1.0
    y = kernels.toeplitz_solve(divisor, forced) + 0.01 * rng.standard_normal(m)
    tuples = np.array([[1.6, 0.9, 0.0, 0.4], [1.5, 0.9, 0.0, 0.4], [1.6, 0.5, 0.1, 0.1], [0.9, 0.2, 0.0, 0.3]])
    return kernels.Candidates([u, y, v], [1, 0, 2], output=1, step=STEP), np.stack([u, y, v]), tuples


@pytest.mark.parametrize("rows", ["haar", "time"])
@pytest.mark.parametrize(("p", "prior"), [(0, np.inf), (1, 1e6), (7, 1e6), (7, 1.0), (7, [1e-3, 1.0, 1e9])])
def test_coefficients_of_candidates_are_those_of_dense_columns(p, prior, rows):
    model, signals, tuples = candidates()
    turn = kernels.haar if rows == "haar" else np.asarray
    found = model.coefficients(tuples, p=p, prior_covariance=prior, rows=rows)
    for order, own in zip(tuples, found, strict=True):
        columns = [
            kernels.integrate(signals[row], order[0] - order[1 + j], step=STEP) for j, row in enumerate([1, 0, 2])
        ]
        columns, output = turn(np.stack(columns)).T, turn(signals[1])
        if p:
            expected = kernels.multi_innovation(columns, output, p, prior_covariance=prior)
        else:
            expected = np.linalg.lstsq(columns, output, rcond=None)[0]
        np.testing.assert_allclose(own, expected, rtol=1e-9)
    # What is kept between calls changes nothing.
    again = model.coefficients(tuples[::-1], p=p, prior_covariance=prior, rows=rows)
    np.testing.assert_allclose(again[::-1], found, rtol=1e-12)
    fresh = candidates()[0].coefficients(tuples[2:], p=p, prior_covariance=prior, rows=rows)
    np.testing.assert_allclose(fresh, found[2:], rtol=1e-9)


@pytest.mark.parametrize("norm", ["l1", "l2"])
def test_scores_of_candidates_are_errors_of_their_simulations(norm):
    model, signals, tuples = candidates()
    scores, numbers = model.score(tuples, norm=norm)
    simulated = model.free_run(tuples, numbers)
    for order, own, outputs in zip(tuples, numbers, simulated, strict=True):
        gaps = order[0] - order[1:]
        divisor = np.eye(64) - own[0] * dense(kernels.block_pulse_kernel(gaps[0], 64, step=STEP))
        forced = own[1] * kernels.integrate(signals[0], gaps[1], step=STEP)
        forced = forced + own[2] * kernels.integrate(signals[2], gaps[2], step=STEP)
        np.testing.assert_allclose(outputs, np.linalg.solve(divisor, forced), rtol=1e-9, atol=1e-12)
    each = kernels.errors(signals[1], simulated)[:, 0 if norm == "l1" else 1]
    np.testing.assert_allclose(scores, each, rtol=1e-9)
    assert scores.argmin() == 0
    limited, same = model.score(tuples, numbers, norm=norm, limit=float(scores.min() * 1.01), threads=2)
    np.testing.assert_array_equal(np.isfinite(limited), scores <= scores.min() * 1.01)
    assert same is numbers or np.array_equal(same, numbers)


@pytest.mark.parametrize("p", [1, 3, 5, 7])
@pytest.mark.parametrize("prior", [1.0, 1e6])
def test_candidates_agree_with_identify(small_run, p, prior):
    structure = ftlm.equation("D^alpha y = a1 D^beta y + a0 y + b u", initial="rest")
    structure = structure.with_orders({"alpha": [1.7, 1.8], "beta": [0.5, 0.6]})
    method = ftlm.MultiInnovation(innovation_length=p, prior_covariance=prior)
    found = ftlm.identify(small_run, structure, method=method, m=256)
    y, u = (kernels.pulse_means(small_run[n], 256, hold=n == "u") for n in "yu")
    model = kernels.Candidates([y, u], [0, 0, 1], step=small_run.duration / 256)
    orders = [[alpha, beta, 0.0, 0.0] for alpha in (1.7, 1.8) for beta in (0.5, 0.6)]
    scores, coefficients = model.score(orders, p=p, prior_covariance=prior)
    best = int(scores.argmin())
    assert orders[best][:2] == pytest.approx([found.orders["alpha"], found.orders["beta"]])
    np.testing.assert_allclose(coefficients[best], [found.coefficients[n] for n in ("a1", "a0", "b")], rtol=1e-9)


def test_candidates_without_an_estimate_are_marked():
    model = kernels.Candidates([np.ones(8), np.ones(8)], [1, 1], step=STEP)
    scores, numbers = model.score([[0.5, 0.1, 0.1], [0.5, 0.1, 0.2]])
    assert np.isnan(numbers[0]).all()
    assert np.isinf(scores[0])
    assert np.isfinite(numbers[1]).all()
    none = model.score(np.zeros((0, 3)))
    assert none[0].shape == (0,)
    assert none[1].shape == (0, 2)
    assert model.free_run(np.zeros((0, 3)), np.zeros((0, 2))).shape == (0, 8)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: kernels.integrate([[1.0, np.nan]], 0.5, step=STEP), r"x is not finite at index \[0, 1\] \(1 such"),
        (lambda: kernels.integrate(np.ma.masked_array([1.0, 2.0], [0, 1]), 0.5, step=STEP), "masked"),
        (lambda: kernels.integrate([1j, 2.0], 0.5, step=STEP), "complex"),
        (lambda: kernels.integrate([1.0, 2.0], 11.0, step=STEP), "order"),
        (lambda: kernels.integrate([1.0, 2.0], 0.5, step=0.0), "step"),
        (lambda: kernels.integrate(np.ones((2, 4)), np.ones(3), step=STEP), r"x \(2,\) and order \(3,\) do not"),
        (lambda: kernels.integrate(1.0, 0.5, step=STEP), "no time axis"),
        (lambda: kernels.toeplitz_apply(np.ones(3), np.ones(4)), "3 values and x has 4"),
        (lambda: kernels.toeplitz_solve([0.0, 1.0], [1.0, 1.0]), "kernel 0 of 1 begins with 0"),
        (lambda: kernels.block_pulse_kernel([0.5, -0.1], 4, step=STEP), r"order = -0.1"),
        (lambda: kernels.block_pulse_kernel([0.5, np.inf], 4, step=STEP), r"order is not finite at index 1"),
        (lambda: kernels.toeplitz_apply([1.0, np.inf], np.ones(2)), r"kernel is not finite at index 1 \(1 such"),
        (lambda: kernels.toeplitz_solve(np.ones(2), [np.nan] * 2), r"b is not finite at index 0 \(2 such"),
        (lambda: kernels.toeplitz_apply(np.ones((2, 3)), np.ones((4, 3))), r"kernel \(2,\) and x \(4,\) do not"),
        (lambda: kernels.pulse_means(np.ma.masked_array([1.0, 2.0], [0, 1])), "masked"),
        (lambda: kernels.multi_innovation(np.ones((4, 2)) * 1j, np.ones(4), prior_covariance=1.0), "complex"),
        (lambda: kernels.errors([1.0, np.nan], np.ones(2)), r"measured is not finite at index 1"),
        (lambda: kernels.haar(np.ones(6)), "power of two"),
        (lambda: kernels.haar([[1.0, 2.0], [3.0, np.nan]]), r"x is not finite at index \[1, 1\] \(1 such"),
        (lambda: kernels.integrate([1.0, 2.0], np.nan, step=STEP), "order = nan is not finite"),
        (lambda: PAIR.score([[0.5, 0.1]], limit=np.nan), "limit=nan is not a number"),
        (lambda: kernels.pulse_means([1.0]), "samples|pulse"),
        (
            lambda: kernels.multi_innovation(np.ones((4, 2)), np.ones(5), prior_covariance=1.0),
            r"\(4, 2\), m has shape \(5,\)",
        ),
        (lambda: kernels.multi_innovation(np.ones((4, 2)), np.ones(4), 0, prior_covariance=1.0), "p = 0"),
        (lambda: kernels.multi_innovation(np.ones((4, 2)), np.ones(4), prior_covariance=-1.0), "prior"),
        (lambda: kernels.multi_innovation(np.ones((4, 2)), np.ones(4), prior_covariance=[1.0] * 3), "prior_covariance"),
        (lambda: kernels.errors(np.ones(3), np.ones(4)), r"\(3,\), predicted \(4,\)"),
        (lambda: kernels.block_pulse_kernel(0.5, 0, step=STEP), "m"),
        (lambda: kernels.Candidates(np.ones(4), [0], step=STEP), r"signals has shape \(4,\)"),
        (
            lambda: kernels.Candidates(np.ones((2, 4)), [2], step=STEP),
            "terms = 2 is not the row index of one of 2 signals",
        ),
        (lambda: kernels.Candidates(np.ones((2, 4)), [], step=STEP), "terms is empty|terms. is empty"),
        (lambda: PAIR.coefficients([0.5, 0.1]), r"orders has shape \(2,\); give \(N, 2\)"),
        (lambda: PAIR.coefficients([[0.5, 0.1], [0.5, 0.6]]), r"orders 1 of 2 are \[0.5, 0.6\] \(1 such"),
        (lambda: PAIR.coefficients([[0.5, 0.1]], p=-1), "p = -1 is not a whole number of at least 0"),
        (lambda: PAIR.coefficients([[0.5, 0.1]], prior_covariance=0.0), "prior_covariance is not positive"),
        (lambda: PAIR.coefficients([[0.5, 0.1]], rows="fourier"), "rows = 'fourier' is not known"),
        (lambda: SHORT.coefficients([[0.5, 0.1]], p=7), "power of two"),
        (lambda: PAIR.score([[0.5, 0.1]], [[1.0, 2.0]]), r"coefficients has shape \(1, 2\); give \(1, 1\)"),
        (lambda: PAIR.free_run([[0.5, 0.1]], [[1.0, 2.0]]), r"coefficients has shape \(1, 2\)"),
    ],
)
def test_wrong_arguments_are_refused_in_words(call, words):
    with pytest.raises(ftlm.FtlmError, match=words):
        call()


def test_a_recursion_ends_at_the_rows_so_far():
    y, u = np.cumsum(noise(2, 60), axis=1)
    stream = kernels.Recursion([1.3, 0.4, 0.0], [0, 1], step=STEP, hold=[False, True], p=3, prior_covariance=1e4)
    path = stream.push(np.stack([y, u], axis=1)[:50])
    assert path.shape == (50, 2)
    np.testing.assert_array_equal(path[-1], stream.coefficients)
    means = np.stack([kernels.pulse_means(y, hold=False), kernels.pulse_means(u, hold=True)])
    q = kernels.integrate(means, [0.9, 1.3], step=STEP).T
    for rows in (5, 49):
        expected = kernels.multi_innovation(q[:rows], means[0, :rows], 3, prior_covariance=1e4)
        np.testing.assert_allclose(path[rows], expected, rtol=1e-8)
    more = stream.push(np.stack([y, u], axis=1)[50:])
    expected = kernels.multi_innovation(q, means[0], 3, prior_covariance=1e4)
    np.testing.assert_allclose(more[-1], expected, rtol=1e-8)
    assert stream.pulses == 59


def test_a_recursion_forgets_by_powers_of_its_factor():
    y, u = np.cumsum(noise(2, 80), axis=1)
    stream = kernels.Recursion([1.0, 0.0], [1], step=STEP, hold=[False, True], p=1, forgetting=0.9)
    (found,) = stream.push(np.stack([y, u], axis=1))[-1]
    target, means = kernels.pulse_means(y), kernels.pulse_means(u, hold=True)
    q = kernels.integrate(means, 1.0, step=STEP)
    weights = 0.9 ** np.arange(78, -1, -1)
    assert found == pytest.approx((weights * q) @ target / ((1 + 1e-10) * (weights * q) @ q), rel=1e-9)


def test_a_start_in_motion_is_a_term_of_a_recursion():
    u = np.repeat([1.0, -1.0, 0.5, 2.0], 25)
    t = np.arange(100) * STEP
    y = 3.0 + 0.7 * t  # its input has the coefficient 0
    for initial in ([0.0, 1.0], "caputo"):
        stream = kernels.Recursion([2.0, 0.0], [1], step=STEP, hold=[False, True], initial=initial)
        stream.push(np.stack([y, u], axis=1))
        np.testing.assert_allclose(stream.coefficients, [0.0, 3.0, 0.7], atol=1e-6)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (
            lambda: kernels.Recursion([1.0, 0.0], [2], step=STEP, hold=[False, True]),
            "terms = 2 is not the row index of one of 2 signals",
        ),
        (lambda: kernels.Recursion([1.0], [1], step=STEP, hold=[False, True]), r"orders has shape \(1,\); give \(2,\)"),
        (lambda: kernels.Recursion([2.5, 0.0], [1], step=STEP, hold=[False, True]), r"outside \[0, 2\]"),
        (
            lambda: kernels.Recursion([1, 0], [1], step=STEP, hold=[False, True], forgetting=0.0),
            "forgetting factor = 0",
        ),
        (lambda: kernels.Recursion([1, 0], [1], step=STEP, hold=[False, True], initial=[-1.0]), r"exponent"),
        (lambda: kernels.Recursion([1, 0], [1], step=STEP, hold=[False, True], initial="rest"), "initial = 'rest'"),
        (
            lambda: kernels.Recursion([1, 0], [1], step=STEP, hold=[False, True], p=0),
            "p = 0 is not a whole number from 1",
        ),
        (lambda: STREAM.push(np.ones(3)), r"samples has shape \(3,\); give \(n, 2\)"),
        (lambda: STREAM.push([[0.0, np.nan]]), r"samples is not finite at index \[0, 1\]"),
    ],
)
def test_what_a_recursion_cannot_do_is_refused(call, words):
    with pytest.raises(ftlm.FtlmError, match=words):
        call()


STREAM = kernels.Recursion([1.0, 0.0], [1], step=STEP, hold=[False, True])
