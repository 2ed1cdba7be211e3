"""Transfer functions as models and their connections, against frequency responses computed from the lists."""

import numpy as np
import pytest

import ftlm

S = 1j * np.geomspace(1e-2, 1e2, 60)


def value(pairs):
    return sum(c * S**p for c, p in pairs)


def response(model):
    return model.frequency_response(np.abs(S))[0, 0]


def close(model, expected):
    assert np.max(np.abs(response(model) - expected) / np.abs(expected)) < 1e-12


def drawn(seed, *, delay=True):
    """Random fractional transfer function as lists, and its model."""
    rng = np.random.default_rng(seed)
    powers = np.sort(rng.choice(np.arange(0.1, 2.0, 0.1), rng.integers(1, 4), replace=False))
    den = [(float(c), round(float(p), 1)) for c, p in zip(rng.uniform(0.2, 3, powers.size), powers, strict=True)]
    den.append((float(rng.uniform(0.2, 3)), 0.0))
    num = [(float(rng.uniform(-3, 3)), round(float(p), 1)) for p in powers[: rng.integers(0, powers.size)] / 2]
    num.append((float(rng.uniform(0.5, 3)), 0.0))
    late = float(rng.uniform(0, 0.5)) if delay and seed % 2 else 0.0
    return num, den, late, ftlm.transfer_function(num, den, late)


def exact(num, den, late):
    return value(num) / value(den) * np.exp(-S * late)


@pytest.mark.parametrize("seed", range(60))
def test_models_and_their_connections_have_the_responses_of_the_lists(seed):
    num, den, late, model = drawn(seed)
    own = exact(num, den, late)
    close(model, own)
    other_lists = drawn(seed + 1000)
    other = exact(*other_lists[:3])
    close(model.series(other_lists[3]), own * other)
    one, two = drawn(seed, delay=False), drawn(seed + 1000, delay=False)
    g, h = exact(*one[:3]), exact(*two[:3])
    sum_ = g + h
    assert np.max(np.abs(response(one[3].parallel(two[3])) - sum_) / (np.abs(g) + np.abs(h))) < 1e-12
    loop = response(one[3].feedback(two[3]))
    assert np.max(np.abs(loop * (1 + g * h) - g) / ((1 + np.abs(g * h)) * np.abs(g))) < 1e-11


def test_whole_orders_agree_with_python_control():
    control = pytest.importorskip("control")
    model = ftlm.transfer_function([2, 1], [1, 0.4, 4])
    system = control.tf([2, 1], [1, 0.4, 4])
    close(model, np.asarray(system(S)))
    close(model.feedback(3.0), np.asarray(control.feedback(system, 3)(S)))
    close(model.feedback(sign=1), np.asarray(control.feedback(system, 1, 1)(S)))


def test_lists_of_fomcon_give_its_transfer_function():
    a, na, b, nb = [1, 0.5, 2], [1.8, 0.9, 0], [4], [0]
    model = ftlm.transfer_function(list(zip(b, nb, strict=True)), list(zip(a, na, strict=True)), delay=0.1)
    assert str(model.equations[0]) == "D^1.8 y = -0.5 D^0.9 y - 2.0 y + 4.0 u"
    assert model.structure.delay == {"u": 0.1}
    assert ftlm.transfer_function((b, nb), (a, na), delay=0.1) == model
    assert ftlm.transfer_function((np.array(b), np.array(nb)), (a, na), delay=0.1) == model


@pytest.mark.parametrize("seed", range(20))
def test_operators_have_the_meaning_of_python_control(seed):
    num, den, late, model = drawn(seed)
    other_lists = drawn(seed + 1000, delay=False)
    other = other_lists[3]
    g, h = exact(num, den, late), exact(*other_lists[:3])
    close(model * other, g * h)
    close(2 * model, 2 * g)
    close(-model * 0.5, -0.5 * g)
    close(model / 4, g / 4)
    close(model * other / other, g)
    one = drawn(seed, delay=False)
    g = exact(*one[:3])
    for found, expected in ((one[3] + other, g + h), (one[3] - other, g - h), (3 - one[3], 3 - g), (one[3] + 1, g + 1)):
        scale = np.abs(g) + np.abs(h) + 3
        assert np.max(np.abs(response(found) - expected) / scale) < 1e-12


def test_operands_keep_the_names_of_their_signals():
    first = ftlm.transfer_function([1], [1, 2], output="torque", input="volts")
    second = ftlm.transfer_function([3], [1, 1], output="angle", input="torque")
    both = second * first
    assert (both.outputs, both.structure.signals) == (("angle",), ("angle", "volts"))
    close(both, 3 / ((S + 1) * (S + 2)))
    for call in (lambda: first * "x", lambda: "x" + first, lambda: first / None):
        with pytest.raises(TypeError):
            call()
    with pytest.raises(ftlm.ModelError, match=r"the delays are 0\.1 s and 0 s"):
        one_lag(0.1) + one_lag()
    with pytest.raises(ftlm.ModelError, match=r"the divisor has a delay of 0\.1 s"):
        one_lag() / one_lag(0.1)


def test_an_inverse_undoes_its_model():
    model = ftlm.transfer_function([(2, 1.5), (1, 0)], [(1, 1.5), (3, 0.5), (1, 0)], output="angle", input="volts")
    back = model.inverse()
    assert back.outputs == ("volts",)
    close(back, 1 / response(model))


def test_an_integral_of_a_signal_is_written_without_powers_below_zero():
    model = ftlm.Model(ftlm.equation("D y = -2 y + 3 D^-0.5 u"))
    close(model.series(ftlm.transfer_function([1], [1, 1])), response(model) / (S + 1))


def one_lag(delay=0.0):
    return ftlm.transfer_function([1], [1, 1], delay)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: ftlm.transfer_function([1, 0, 0], [1, 1]), "numerator is of order 2 and the denominator of order 1"),
        (lambda: ftlm.transfer_function([1], [2]), "the denominator is of order 0"),
        (lambda: ftlm.transfer_function([1], [1, 1], -0.1), "the delay of -0.1 s is below 0"),
        (lambda: ftlm.transfer_function([1], [1] + [0] * 11), "the denominator is of order 11"),
        (lambda: ftlm.transfer_function([], [1, 1]), "num has no coefficient"),
        (lambda: ftlm.transfer_function([1], [0, 0]), "den has no coefficient"),
        (lambda: ftlm.transfer_function([1], [1, float("nan")]), r"den\[1\] is nan"),
        (lambda: ftlm.transfer_function(([1], [0]), ([1, 2], [1])), "den has 2 coefficients and 1 power;"),
        (lambda: ftlm.transfer_function(zip([1], [0]), [1, 1]), "num is a zip, which omits entries"),  # noqa: B905
        (lambda: ftlm.transfer_function([1], [1, 1], input="y"), "'y' is the name of the output and of the input"),
        (lambda: ftlm.transfer_function([(1, 2, 3)], [1, 1]), r"num\[0\] is \(1, 2, 3\)"),
        (lambda: one_lag(0.1).inverse(), "0.1 s in advance"),
        (lambda: one_lag().inverse(), "numerator is of order 1"),
        (lambda: one_lag(0.1).feedback(), "delay of 0.1 s"),
        (lambda: one_lag().feedback(sign=2), "sign"),
        (lambda: one_lag(0.1).parallel(one_lag()), "the delays are 0.1 s and 0 s"),
        (
            lambda: one_lag().series(ftlm.Model(ftlm.equation("D y = -1 y + 1 u + 1 v"))),
            "one output and one input; this model has y from u, v",
        ),
    ],
)
def test_what_is_no_model_is_refused(call, words):
    with pytest.raises(ftlm.ModelError, match=words):
        call()
