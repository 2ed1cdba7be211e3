"""Equations as people write them: forms that mean the same, transfer functions, and texts that are printed and read."""

import itertools
import unicodedata

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ftlm
from ftlm.structure.grammar import MAX_POLYNOMIAL_POWER


def same(first, second):
    """Whether two structures have the same equations, delays, limits and offsets."""
    terms = [
        sorted((t.signal, str(t.order), str(t.coefficient), t.factor) for e in s.equations for t in e.terms)
        for s in (first, second)
    ]
    rest = [
        ([(e.output, e.order, e.friction) for e in s.equations], dict(s.delay), dict(s.free_delays), s.limits, s.offset)
        for s in (first, second)
    ]
    return terms[0] == terms[1] and rest[0] == rest[1]


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("y'' + 2 y' + y = u", "D^2 y = -2 D y - 1 y + u"),
        ("ÿ + 2 ẏ + y = u", "D^2 y = -2 D y - 1 y + u"),
        ("x\u0308_1 = -2 x\u0307_1 - x_1 + u", "D^2 x_1 = -2 D x_1 - 1 x_1 + u"),
        ("D^2 y + 0.5 D^0.5 y + y = 2 u", "D^2 y = -0.5 D^0.5 y - y + 2 u"),
        ("dy/dt = -y + u", "D y = -y + u"),
        ("d^2 y/dt^2 + 3 dy/dt = u", "D^2 y = -3 D y + u"),
        ("d2y/dt2 = u - y", "D^2 y = u - y"),
        ("d/dt y = -a y + b u", "D y = -a y + b u"),
        ("D**1.5 y = −0.5 y + u", "D^1.5 y = -0.5 y + u"),
        ("2 D y + 4 y = 6 u", "D y = -2 y + 3 u"),
        ("-D y = 2 y - u", "D y = -2 y + u"),
        ("D y + a y - b u = 0", "D y = -a y + b u"),
        ("y + 2 D y = u", "D y = -0.5 y + 0.5 u"),
        ("D y = 2 (u - y)", "D y = 2 u - 2 y"),
        ("D y = -y/4 + 3/2 u", "D y = -0.25 y + 1.5 u"),
        ("D^alpha y + a D^beta y = b u", "D^alpha y = -a D^beta y + b u"),
        ("3 D y = 2 a y + 6 b u", "D y = 0.6666666666666666 a y + 2 b u"),
        ("3 D y = D y - 4 y + u", "D y = -2 y + 0.5 u"),
        ("D y(t) = a y(t) + b u(t)", "D y = a y + b u"),
        ("D^2 y + fc*sign(D y) = u", "D^2 y = u - fc*sign(D y)"),
        ("2 D^2 y = u - 0.5 sign(D y)", "D^2 y = 0.5 u - 0.25 sign(D y)"),
        ("y = b/(s^alpha + a) u", "D^alpha y = -a y + b u"),
        ("y = K/(0.5 s + 1) u", "D y = -2 y + 2 K u"),
        ("y/u = 1/(s^2 + 2 s + 1)", "D^2 y = -2 D y - y + u"),
        ("y(s) = 1/(s + 1)^2 u(s)", "D^2 y = -2 D y - y + u"),
        ("Y(s) = 2 U(s)/(s + 1)", "D Y = -Y + 2 U"),
        ("y = u(s)/(s + 1) - 3 v(s) s/(s + 2)", "D^2 y = -3 D y - 2 y + D u + 2 u - 3 D^2 v - 3 D v"),
        ("y = 1/(1 + s/4) u", "D y = -4 y + 4 u"),
        ("y = 1/(s/4 + 1)^2 u", "D^2 y = -8 D y - 16 y + 16 u"),
        ("y = 9/(s^2 + 2*0.5*3*s + 3^2) u", "D^2 y = -3 D y - 9 y + 9 u"),
        ("y''(t) + 2 y'(t) + y(t) = u(t)", "D^2 y = -2 D y - 1 y + u"),
        ("dy(t)/dt = -y(t) + u(t)", "D y = -y + u"),
        ("d^2 y(t)/dt^2 = -y(t) + u(t)", "D^2 y = -y + u"),
        ("d^0.5 y/dt^0.5 = -a y + b u", "D^0.5 y = -a y + b u"),
        ("d^alpha y(t)/dt^alpha = -a d^0.5 y/dt^0.5 + b u", "D^alpha y = -a D^0.5 y + b u"),
        ("y'' = u - fc*sign(y')", "D^2 y = u - fc*sign(D y)"),
        ("y'' = u - fc sign(dy/dt)", "D^2 y = u - fc*sign(D y)"),
        (
            "y'' = u - fc sign(y'(t)) - fs*exp(-(y'/vs)^2)*sign(y')",
            "D^2 y = u - fc*sign(D y) - fs*exp(-(D y/vs)^2)*sign(D y)",
        ),
        ("y = 1/(sqrt(s) + 2) u - 3 s/(sqrt(s) + 2) v", "D^0.5 y = -2 y + u - 3 D v"),
    ],
)
def test_forms_that_mean_the_same(text, plain):
    read, expected = ftlm.equation(text), ftlm.equation(plain)
    points = [{"a": 0.7, "b": 1.3, "K": 2.1}, {"a": -2.0, "b": 0.2, "K": 0.4}]
    for values, orders in itertools.product(points, ({"alpha": 1.7, "beta": 0.6},)):
        models = []
        for structure in (read, expected):
            known = structure.with_orders({n: orders[n] for n in structure.order_names})
            known = known.with_coefficients({n: values.get(n, 0.5) for n in known.coefficient_names})
            terms: dict[tuple[str, float], float] = {}
            for t in known.equations[0].terms:
                terms[t.signal, t.order.constant] = terms.get((t.signal, t.order.constant), 0.0) + t.fixed_value
            models.append((known.equations[0].order.constant, known.equations[0].friction, terms))
        assert models[0][0] == models[1][0]
        assert (models[0][1] and models[0][1].law) == (models[1][1] and models[1][1].law)
        assert models[0][2] == pytest.approx(models[1][2], rel=1e-15)


@pytest.mark.parametrize(
    ("text", "delay", "free"),
    [
        ("D y = a y + b u(t - 0.06)", {"u": 0.06}, {}),
        ("D y = a y + b u(t - 0.06 s)", {"u": 0.06}, {}),
        ("D y = a y + b u(t + 0.06 s)", {"u": -0.06}, {}),
        ("D y = a y + b u(t - 0:0.5)", {}, {"u": (0.0, 0.5)}),
        ("D y = a y + b u(t - -0.02:0.5 s)", {}, {"u": (-0.02, 0.5)}),
        ("D y = a y + b D^0.5 u(t - 0.1) + k u(t - 0.1)", {"u": 0.1}, {}),
        ("D y = a y + b sat(u(t - 0.035 s), 0.94)", {"u": 0.035}, {}),
        ("y'(t) = a y(t) + b u'(t - 0.1)", {"u": 0.1}, {}),
        ("y = 2 u(s)/(s + 1) e^(-0.1 s)", {"u": 0.1}, {}),
        ("y = 1/(s + 1) e^(-0.1 s) u + exp(-0.2*s)/(s + 2) v", {"u": 0.1, "v": 0.2}, {}),
    ],
)
def test_delays_are_read(text, delay, free):
    read = ftlm.equation(text)
    assert (dict(read.delay), dict(read.free_delays)) == (delay, free)
    # As it is printed, a lead included.
    assert ftlm.equation(str(read)) == read


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("y' = -a y(t - 0.1) + u", "the output y is delayed, but only inputs have delays"),
        ("dy/dt = -a y(t - 0.1) + u", "the output y is delayed, but only inputs have delays"),
        ("y' + a y(t - 0.1) = u(t - 0.2)", "the output y is delayed, but only inputs have delays"),
        ("y' = -a y + u + b u(t - 0.1)", "u has two delays; give the input with the longer delay its own name"),
        ("y' = -2 zeta wn y + u", "one name for a product of coefficients, as in 'a1 y'"),
        ("y' = -wn^2 y + u", "write one name for it, as in 'a1 y'"),
        ("y'' = u - fc*sign(y'')", r"friction depends on the first derivative; write sign\(D y\)"),
        ("D y' = -y + u", "y has both D and primes"),
        ("y' = -y + sat(u', 2)", r"limits a signal, not its derivative; write sat\(u, …\)"),
        ("y = 1/(1 + s/T) u", "'T' at character 14 divides, but a divisor must be a number"),
        ("y = u/(s + 1)", r"write '1/\(s \+ 1\) u' if u is the input"),
        ("y = 2*u/(s + 1) + v", r"write '2/\(s \+ 1\) u' if u is the input"),
        ("y = K u/(s + 1) e^(-0.1 s)", r"write 'K/\(s \+ 1\) e\^\(-0.1 s\) u' if u is the input"),
    ],
)
def test_a_form_that_is_not_computed_is_refused_with_the_form_that_is(text, words):
    with pytest.raises(ftlm.ModelError, match=words):
        ftlm.equation(text)


def test_a_delay_is_given_once():
    with pytest.raises(ftlm.ModelError, match=r"the delay of u is in the equation and in delay="):
        ftlm.equation("D y = a y + b u(t - 0.1)", delay={"u": 0.2})


def random_polynomial(rng, top):
    """A random sum of powers of s as text and as function, of this highest order."""
    orders = np.unique(np.r_[top, rng.uniform(0, top, int(rng.integers(0, 3))).round(2), 0.0])[::-1]
    values = rng.uniform(0.2, 3, orders.size).round(3)
    text = " + ".join(f"{c} s^{o}" if o else f"{c}" for c, o in zip(values.tolist(), orders.tolist(), strict=True))
    return f"({text})", lambda s: sum(c * s**o for c, o in zip(values, orders, strict=True))


def test_transfer_functions_have_the_response_of_their_formula():
    rng = np.random.default_rng(3)
    w = np.geomspace(0.01, 100, 9)
    for _ in range(40):
        (n1, f1), (n2, f2) = (random_polynomial(rng, round(rng.uniform(0.1, 0.9), 2)) for _ in range(2))
        (d1, g1), (d2, g2) = (random_polynomial(rng, round(rng.uniform(1, 2), 2)) for _ in range(2))
        power, delay = int(rng.integers(1, 3)), round(rng.uniform(0, 0.3), 3)
        model = ftlm.Model(ftlm.equation(f"y = 2 {n1}/({d1}^{power}) e^(-{delay} s) u - {n2} {n1} / {d2} v"))
        s = 1j * w
        expected = np.stack([2 * f1(s) / g1(s) ** power * np.exp(-delay * s), -f2(s) * f1(s) / g2(s)], axis=1)
        np.testing.assert_allclose(model.frequency_response(w)[0].T, expected, rtol=1e-9)


NAMES = ("y", "u", "v")
NUMBERS = st.floats(0.01, 50).map(lambda x: float(f"{x:.4g}"))
INTERVALS = st.tuples(NUMBERS, NUMBERS).filter(lambda ends: ends[0] < ends[1])


@st.composite
def structures(draw):
    """Structures with two inputs, delays, limits, friction and offsets, free or known."""
    highest = draw(st.sampled_from(["2", "1.5", "alpha"]))
    terms = []
    for k, signal in enumerate(("y", "u", "v")):
        orders = st.sampled_from(["0", "0.5", "beta", "(alpha-beta)"])
        for n, order in enumerate(draw(st.lists(orders, min_size=1, max_size=2, unique=True))):
            coefficient = draw(st.one_of(st.just(f"k{k}{n}"), NUMBERS.map(repr)))
            sign = draw(st.sampled_from("+-"))
            terms.append(f"{sign} {coefficient} {'' if order == '0' else f'D^{order} '}{signal}")
    friction = draw(st.sampled_from(["", " - fc*sign(D y)", " - 0.5 sign(D y) - fs*exp(-(D y/vs)^2)*sign(D y)"]))
    limits = {}
    delay = draw(st.dictionaries(st.just("v"), st.one_of(NUMBERS, INTERVALS)))
    for kind, signal in (("saturation", "u"), ("dead_zone", "v")):
        if draw(st.booleans()) and signal not in delay:
            limits[kind] = {signal: draw(NUMBERS)}
    offset = draw(st.sampled_from(["none", "constant", "ramp", "auto"]))
    text = f"D^{highest} y = {' '.join(terms).removeprefix('+ ')}{friction}"
    return ftlm.equation(text, delay=delay, offset=offset, **limits)


@settings(max_examples=150, deadline=None)
@given(structure=structures())
def test_what_is_printed_is_read(structure):
    assert same(ftlm.equation(str(structure)), structure)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("D y = a y^2.5 + u", "at character 9: the power 2.5 of y is not a whole number; write abs(y)^2.5"),
        ("D y = a y^-1 + u", "at character 9: the power -1 of y is not in [1, 100]; give a quotient of signals as a"),
        ("D y = a y/u", "'u' at character 11 divides"),
        ("D y = a sin(y/u)", "'u' at character 15 divides inside a non-linear term"),
        ("D y = a D y^2", "a power of D y at character 12 has two meanings; write (D y)^…"),
        ("D y = sin(w y) + u", "'y' at character 13 follows another name inside a non-linear term"),
        ("D y = tan(y) + u", r"tan(…) at character 7: of the functions of signals only"),
        (
            "D y = tahn(y) + u",
            "'tahn' at character 7 is no known function (did you mean 'tanh'?); if it is a coefficient",
        ),
        ("D y = log10(y) + u", "'log10' at character 7 is no known function; if it is a coefficient, write 'log10*('"),
        ("D y = y*tahn(y) + u", "'tahn' is no known function (did you mean 'tanh'?); of the functions of signals only"),
        ("D y = a y*sign(y) + u", "sign(…) at character 11: of the functions of signals only"),
        ("D y = abs(D^nu y) + u", "the order nu at character 11 is free inside a non-linear term"),
        ("D y = k D^0.5 (y^2)*u", "'*' at character 20 follows the derivative of an expression"),
        ("D y = a y + (3^2)", "the term at character 13 is a constant without a signal"),
        ("D y = " + 40 * "sin(" + "y" + 40 * ")", "parentheses are nested more than 30 times"),
        ("D y = k " + "*".join(600 * ["y"]), "the non-linear term at character 9 has too many operations"),
        ("D^1.5 y = k D^0.7 (abs(D y)^2) + u", "has the derivative of order 1 of y, above 0.8"),
        ("D y = k D^1.2 (u^2) + u", "order 1.2 of the non-linear term k D^1.2 (u^2) in the equation of y is outside"),
        ("m D^2 y + k y = u", "m multiplies the highest derivative; write 'D^2 y = a0 y + b0 u'"),
        ("D y = -y/tau + u", "'tau' at character 10 divides"),
        ("D y = u/0", "'0' at character 9 divides"),
        ("D y = k (u - y)", "k at character 7 multiplies a sum"),
        ("y = 1/(T s + 1) u", "T multiplies the highest derivative"),
        ("D y = a y + b u(t - Td)", "the delay Td of u is free"),
        ("D y = a y + b u(t + Td)", "a lead is estimated as a negative delay between bounds"),
        (
            "y = e^(-L s)/(s + 1) u",
            "an exponential at character 5 is a delay; write a number, as in e^(-0.1 s), or bounds",
        ),
        ("D y = a y + u + 0.5 u(t - 0.1)", "u has two delays"),
        ("y = 1/(s + 1) u + 2/(s + 1) u", "u occurs twice"),
        ("y = (a s + b)/((s + 1) (c s + 2)) u", "c multiplies the highest derivative; write"),
        ("y = 1/(s + a) u + 1/(s + b) v", "a*b is a product of coefficients"),
        ("y = (s + 1) (a s + 1)/(s + 2) u", "a occurs in several terms after multiplication"),
        (f"y = 1/(s + 1)^{MAX_POLYNOMIAL_POWER + 1} u", "not a whole number from 1 to 10"),
        ("y = 1/(s + 1", "expected ')' at character 13"),
        ("G(s) = 2/(s + 3)", "the transfer function has no input at its end; write both signals"),
        ("D^u y = a y + b u", "u names an order and a signal"),
        ("D^y y = a y + b u", "y names an order and a signal"),
        ("D y - D y = u", "D^1 y cancels out"),
        ("u = D y", "its left-hand side has no derivative"),
        ("y' + c = u", "the offset 'c' at character 6 is on the left-hand side"),
        ("D y = a*3 y", "3 at character 9 follows the coefficient a"),
    ],
)
def test_what_is_not_computed_is_refused_with_its_place(text, message):
    with pytest.raises(ftlm.ModelError) as refused:
        ftlm.equation(text)
    assert message in str(refused.value)


@pytest.mark.parametrize(
    ("text", "response"),
    [
        ("y = k/(tau s + 1) u", lambda s, k, tau, **_: k / (tau * s + 1)),
        ("y = k/(tau s^0.7 + 1) e^(-0.3 s) u", lambda s, k, tau, **_: k / (tau * s**0.7 + 1) * np.exp(-0.3 * s)),
        ("tau y' + y = k u", lambda s, k, tau, **_: k / (tau * s + 1)),
        ("y = k/((tau s + 1)(T s + 1)) u", lambda s, k, tau, T, **_: k / ((tau * s + 1) * (T * s + 1))),
        ("y = k w^2/(s^2 + 2 z w s + w^2) u", lambda s, k, w, z, **_: k * w**2 / (s**2 + 2 * z * w * s + w**2)),
        ("y = (k s + z)/((s + 1) (T s + 2)) u", lambda s, k, z, T, **_: (k * s + z) / ((s + 1) * (T * s + 2))),
        ("y = (s + 1) (k s + 1)/(s + 2) u", lambda s, k, **_: (s + 1) * (k * s + 1) / (s + 2)),
    ],
)
def test_a_refused_quotient_of_coefficients_is_rewritten_as_an_equivalent_equation(text, response):
    """The suggested equation has the response of the refused one for any values of its coefficients."""
    with pytest.raises(ftlm.ModelError) as refused:
        ftlm.equation(text)
    rewritten, meanings = str(refused.value).split("; write '")[1].split("', where ")
    values = {"k": 1.7, "tau": 0.6, "T": 2.3, "w": 3.1, "z": 0.4}
    fixed = {
        name: eval(value.replace("^", "**"), {}, values)
        for name, value in (item.split(" = ") for item in meanings.split(", "))
    }
    w = np.array([0.3, 1.1, 4.0])
    model = ftlm.Model(ftlm.equation(rewritten, fixed=fixed))
    assert np.allclose(model.frequency_response(w), response(1j * w, **values), rtol=1e-9)


@pytest.mark.parametrize(
    ("printed", "plain"),
    [
        ("D y = -3·y + b·u", "D y = -3*y + b*u"),
        ("D y = a × y + b u", "D y = a*y + b u"),
        ("D² y = a ⋅ y + b u³", "D^2 y = a y + b u^3"),
        ("y = 2/(s² + 3)² u", "y = 2/(s^2 + 3)^2 u"),
    ],
)
def test_multiplication_signs_and_superscripts_of_printed_texts_are_read(printed, plain):
    assert ftlm.equation(printed) == ftlm.equation(plain)


def test_a_delay_between_bounds_is_estimated_in_a_transfer_function():
    assert ftlm.equation("y = 2/(s + 3) e^(-0:0.4 s) u") == ftlm.equation("D y = -3 y + 2 u(t - 0:0.4)")


def test_a_polynomial_with_too_many_products_of_coefficients_is_refused():
    factors = " ".join(f"(p{k} s + q{k})" for k in range(20))
    with pytest.raises(ftlm.ModelError, match="more than 200 terms after multiplication"):
        ftlm.equation(f"y = 1/({factors}) u")


@pytest.mark.parametrize("name", ["größe", "ü", "ö_1", "Fläche", "fu\u0308r", "é", "żółw"])
def test_dotted_letters_of_a_language_are_no_derivatives(name):
    assert str(ftlm.equation(f"D {name} = a {name} + b u")) == str(
        ftlm.equation(f"D {unicodedata.normalize('NFC', name)} = a {unicodedata.normalize('NFC', name)} + b u")
    )
    assert unicodedata.normalize("NFC", name) in ftlm.equation(f"D {name} = a {name} + b u").outputs
