"""Equations in words, orders and their algebra, structures, models and their files."""

import json
import math
import os
import re
import stat
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ftlm
from ftlm.model.serialization import ModelFile
from ftlm.structure.equation import format_equation
from ftlm.structure.order import order_axis, parse_values
from ftlm.structure.sensor_filter import SensorFilter
from ftlm.structure.structure import check_initial
from ftlm.utils.files import check_target, check_writable, write_atomically

# ----------------------------------------------------------------------------------------------------------------------
# Orders


@pytest.mark.parametrize(
    ("text", "constant", "weights"),
    [
        (0.5, 0.5, {}),
        (2, 2.0, {}),
        ("0.5", 0.5, {}),
        (" 1.05 ", 1.05, {}),
        ("1e-2", 0.01, {}),
        ("-0.3", -0.3, {}),
        ("alpha", 0.0, {"alpha": 1}),
        ("-alpha", 0.0, {"alpha": -1}),
        ("+alpha", 0.0, {"alpha": 1}),
        ("α", 0.0, {"α": 1}),
        ("alpha - mu", 0.0, {"alpha": 1, "mu": -1}),
        ("alpha1 - alpha2 + 2*mu2 - gamma1", 0.0, {"alpha1": 1, "alpha2": -1, "mu2": 2, "gamma1": -1}),
        ("(alpha + 0.5)*2", 1.0, {"alpha": 2}),
        ("2*(alpha - (mu - 1))", 2.0, {"alpha": 2, "mu": -2}),
        ("alpha/2 + 3/4", 0.75, {"alpha": 0.5}),
        ("alpha - alpha + mu", 0.0, {"mu": 1}),
        ("0*alpha", 0.0, {}),
        ("1 - 0.05", 0.95, {}),
    ],
)
def test_order_is_read(text, constant, weights):
    order = ftlm.Order.parse(text)
    assert order.constant == pytest.approx(constant, abs=1e-15)
    assert dict(order.weights) == weights
    assert order.weights == tuple(sorted(order.weights))
    assert order.names == tuple(sorted(weights))


@pytest.mark.parametrize(
    "text",
    [
        "",
        " ",
        "alpha*mu",
        "alpha**2",
        "alpha^2",
        "sin(alpha)",
        "alpha/mu",
        "1/0",
        "1/0.0",
        "alpha[0]",
        "alpha.x",
        "alpha mu",
        "2alpha",
        "'alpha'",
        "True",
        "None",
        "1j",
        "lambda",
        "alpha,mu",
        "[1]",
        "alpha if 1 else 2",
        "alpha := 1",
        "9" * 400,
        "(" * 500,
        "alpha\0",
        "not alpha",
        "alpha < 1",
        "f'{alpha}'",
        "__import__('os')()",
        True,
        None,
    ],
)
def test_order_that_is_none_is_refused(text):
    with pytest.raises(ftlm.ModelError, match="neither a number nor a sum of named orders; write"):
        ftlm.Order.parse(text)


def test_order_algebra():
    order = ftlm.Order.parse("alpha1 - 2*mu + 0.1")
    assert order.at({"alpha1": 2, "mu": 0.85, "unused": 9}) == 0.4
    assert math.copysign(1, ftlm.Order.parse("alpha - 1").at({"alpha": 1.0})) == 1.0  # no negative zero
    assert ftlm.Order.parse("3*a").at({"a": 0.1}) == 0.3  # rounded to 1e-9
    with pytest.raises(ftlm.ModelError, match="order mu has no value; give it in orders="):
        order.at({"alpha1": 2})
    assert ftlm.Order.parse("a + b") == ftlm.Order.parse("b + a")
    assert ftlm.Order.parse("alpha").is_single
    assert not any(ftlm.Order.parse(t).is_single for t in ("0.5", "-alpha", "2*alpha", "alpha+1", "a+b"))


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("0.5", "0.5"),
        ("2.0", "2"),
        ("alpha", "alpha"),
        ("mu - alpha*2 + 1.5", "-2*alpha+mu+1.5"),
        ("0.123456789", "0.123456789"),
        ("alpha/3", "0.3333333333333333*alpha"),
        ("alpha - 0.05", "alpha-0.05"),
        ("alpha - alpha", "0"),
    ],
)
def test_order_is_written(text, written):
    assert str(ftlm.Order.parse(text)) == written


NAMES = st.from_regex(r"[a-zA-Zα-ωΑ-Ω_][a-zA-Z0-9_α-ω]{0,6}", fullmatch=True).filter(
    lambda name: name.isidentifier() and not __import__("keyword").iskeyword(name) and name != "D"
)
NUMBERS = st.floats(-100, 100, allow_nan=False).map(lambda x: x + 0.0)
ORDERS = st.builds(
    lambda constant, weights: ftlm.Order(constant, tuple(sorted((n, w) for n, w in weights.items() if w))),
    NUMBERS,
    st.dictionaries(NAMES, NUMBERS, max_size=4),
)


@settings(max_examples=200, deadline=None)
@given(order=ORDERS)
def test_order_survives_being_written_and_read(order):
    assert ftlm.Order.parse(str(order)) == order


# ----------------------------------------------------------------------------------------------------------------------
# Equations in words


def terms_of(text):
    (item,) = ftlm.equation(text).equations
    terms = [(t.factor, t.coefficient, str(t.order), t.signal) for t in item.terms]
    return item.output, str(item.order), terms


@pytest.mark.parametrize(
    ("text", "output", "order", "terms"),
    [
        ("D^2.2 y = a1 D^0.9 y + a0 y", "y", "2.2", [(1, "a1", "0.9", "y"), (1, "a0", "0", "y")]),
        ("D y = a y", "y", "1", [(1, "a", "0", "y")]),
        ("D^2 y = D y", "y", "2", [(1, 1.0, "1", "y")]),
        ("D^1.5 y = -a y - b u", "y", "1.5", [(-1, "a", "0", "y"), (-1, "b", "0", "u")]),
        ("D^1.5 y = - - a y + - b u", "y", "1.5", [(1, "a", "0", "y"), (-1, "b", "0", "u")]),
        ("D^1.5 y = 2 a y + 0.5*b*u", "y", "1.5", [(2, "a", "0", "y"), (0.5, "b", "0", "u")]),
        ("D^1.5 y = -3 y + 4 u", "y", "1.5", [(1, -3, "0", "y"), (1, 4, "0", "u")]),
        ("D^1.5 y = -3 D^0.5 y + u", "y", "1.5", [(1, -3, "0.5", "y"), (1, 1, "0", "u")]),
        ("D^alpha y = a D^(alpha-mu) y + b u", "y", "alpha", [(1, "a", "alpha-mu", "y"), (1, "b", "0", "u")]),
        ("D^{alpha} y = a D^{2*(alpha - mu)} y", "y", "alpha", [(1, "a", "2*alpha-2*mu", "y")]),
        ("D^1.5 y = b D^-0.5 u + c D^-mu v", "y", "1.5", [(1, "b", "-0.5", "u"), (1, "c", "-mu", "v")]),
        ("D^1.5y=a y+b u", "y", "1.5", [(1, "a", "0", "y"), (1, "b", "0", "u")]),
        ("  D ^ 1.5   y\t=  a   y ", "y", "1.5", [(1, "a", "0", "y")]),
        ("D^1.5 y = 1e-3 a y + .5 u + 2. v", "y", "1.5", [(1e-3, "a", "0", "y"), (1, 0.5, "0", "u"), (1, 2, "0", "v")]),
        ("D^α θ11 = K_s θ12 + β₂ I1".replace("β₂", "β2"), "θ11", "α", [(1, "K_s", "0", "θ12"), (1, "β2", "0", "I1")]),
        ("D^2 Dy = D1 Dy", "Dy", "2", [(1, "D1", "0", "Dy")]),
        ("D^1.5 e5 = 2 e5", "e5", "1.5", [(1, 2, "0", "e5")]),
    ],
)
def test_equation_is_read(text, output, order, terms):
    assert terms_of(text) == (output, order, terms)


@pytest.mark.parametrize(
    ("text", "place", "message"),
    [
        ("D^1.5 y", 8, "expected '=' at character 8, found the end"),
        ("D^1.5 y a u", 9, "expected '=' at character 9, found 'a'"),
        ("D^1.5 = a y", 7, "expected the name of a signal at character 7, found '='"),
        # An order called y, and no signal after it.
        ("D^ y = a y", 6, "expected the name of a signal at character 6, found '='"),
        ("D^1.5 y = ", 11, "expected the name of a signal at character 11, found the end"),
        ("D^1.5 y = a y +", 16, "expected the name of a signal at character 16, found the end"),
        ("D^1.5 y = a y b u", 15, "expected '+', '-' or the end at character 15, found 'b'"),
        ("D^1.5 y = a y = b u", 15, "expected '+', '-' or the end at character 15, found '='"),
        ("D^1.5 y = 3", 11, "3 at character 11 is a constant without a signal"),
        ("D^1.5 y = a D^ + u", 16, "expected an order: a number, a name or (…) at character 16, found '+'"),
        # An order -u, and no signal after it.
        ("D^1.5 y = a D^- u + 1 y", 19, "expected the name of a signal at character 19, found '+'"),
        ("D^1.5 y = a D^(0.5 y", 21, "expected ')' at character 21, found the end"),
        ("D^1.5 y = a D^{0.5 y", 21, "expected '}' at character 21, found the end"),
        ("D^1.5 y = a D^(b*c) y", 16, "at character 16: order 'b*c' is neither a number nor a sum"),
        ("D^1.5 y = a D^() y", 16, "at character 16: order '' is neither"),
        ("D^1.5 y = a D^(1/0) y", 16, "at character 16: order '1/0' is neither"),
        ("D^1.5 y = a D^lambda y", 15, "at character 15: order 'lambda' is neither"),
        ("D^1.5 y = a y & b u", 15, "unexpected '&' at character 15; remove it"),
        ("D^1.5 y = a y, b u", 14, "unexpected ',' at character 14; remove it"),
        ("D y = a y + b u, D z = c z", 16, "unexpected ',' at character 16; separate equations by ';'"),
        ("D^1.5 y = a y[0]", 14, "unexpected '[' at character 14; remove it"),
        ("D^1.5 y = a y + § u", 17, "unexpected '§' at character 17; remove it"),
        ("D^1.5 y = a * * y", 15, "expected the name of a signal at character 15, found '*'"),
        ("D^1.5 y = a D D y", 15, "expected the name of a signal at character 15, found 'D'"),
        # A column called D.
        (
            "D D = a D + b u",
            3,
            "at character 3, found 'D'; D is the derivative in an equation: rename a signal called D",
        ),
        ("D y = a y + b D", 16, "at character 16, found the end; D is the derivative in an equation"),
        ("D^1.5 y = / u", 11, "expected the name of a signal at character 11, found '/'"),
        ("= a y", 1, "expected the name of a signal at character 1, found '='"),
        ("3 y = a u", 0, "its left-hand side has no derivative; write it as in 'D^1.5 y = …'"),
        ("y = a u", 0, "its left-hand side has no derivative; write it as in 'D^1.5 y = …'"),
    ],
)
def test_text_that_is_no_equation_is_refused_at_its_place(text, place, message):
    with pytest.raises(ftlm.ModelError) as refused:
        ftlm.equation(text)
    assert f"equation {text!r}: " in str(refused.value)
    assert message in str(refused.value)
    assert not place or f"at character {place}" in message


@pytest.mark.parametrize("text", ["", "  ", ";;", "\n ; \n"])
def test_empty_text_is_refused(text):
    with pytest.raises(ftlm.ModelError, match="the equation is empty; write it as in"):
        ftlm.equation(text)


@pytest.mark.parametrize("text", [None, 3, ["D y = a y"], b"D y = a y"])
def test_what_is_no_text_is_refused(text):
    with pytest.raises(ftlm.ModelError, match="not text"):
        ftlm.equation(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("D^10.5 y = a y", "order alpha = 10.5 of y is outside (0, 10]"),
        ("D^0 y = a u", "its left-hand side has no derivative"),
        ("D^-1 y = a u", "order alpha = -1 of y is outside (0, 10]"),
        ("D^1e400 y = a u", "order alpha = inf of y is outside (0, 10]"),
        ("D^1.5 y = a D^1.5 y", "order 1.5 of a term of the output y is outside [0, 1.5)"),
        ("D^1.5 y = a D^1.6 y", "order 1.6 of a term of the output y is outside [0, 1.5)"),
        ("D^1.5 y = a D^-0.1 y", "order -0.1 of a term of the output y is outside [0, 1.5)"),
        ("D^1.5 y = a D^10.5 u", "order 10.5 of u is above 10"),
        ("D^1.5 y = a D^-3.5 u", "order -3.5 of u is below -3"),
        ("D^1.5 y = a y + a u", "coefficient a occurs twice in the equation of y"),
        ("D y = a y; D z = a z", "coefficient a occurs in two equations"),
        ("D y = a u; D^2 y = b u", "two equations have the output y"),
        ("D^a y = a u", "a names an order and a coefficient"),
        ("D y = 0 a u", "factor 0 of a u in the equation of y is 0 or not finite"),
        ("D y = 1e400 a u", "factor inf of a u in the equation of y is 0 or not finite"),
        ("D y = 1e400 u", "coefficient of u in the equation of y is inf, which is not finite"),
    ],
)
def test_equation_that_means_nothing_is_refused(text, message):
    with pytest.raises(ftlm.ModelError) as refused:
        ftlm.equation(text)
    assert message in str(refused.value)


def test_message_for_an_order_far_below_says_so():
    with pytest.raises(ftlm.ModelError, match=r"order -3.5 of u"):
        ftlm.equation("D y = a D^(-3.5) u")


def test_several_equations_by_line_or_semicolon():
    for text in ("D^2 y = a z\nD z = b u", "D^2 y = a z; D z = b u;", "\n\nD^2 y = a z\n;\nD z = b u\n"):
        structure = ftlm.equation(text)
        assert structure.outputs == ("y", "z")
        assert structure.signals == ("y", "z", "u")
        assert structure.coefficient_names == ("a", "b")


COEFFICIENTS = st.one_of(NAMES, st.floats(-1e6, 1e6, allow_nan=False).filter(bool))


@st.composite
def equations(draw):
    """Equations as the parser makes them: a factor beside a name, a number alone."""
    output, other = "out", draw(st.sampled_from(["u", "v_1", "θ2"]))
    alpha = draw(
        st.one_of(st.just(ftlm.Order(2.0)), st.builds(lambda n: ftlm.Order(0.0, ((f"order_{n}", 1.0),)), NAMES))
    )
    terms = []
    for k in range(draw(st.integers(1, 4))):
        signal = draw(st.sampled_from([output, other]))
        order = draw(
            st.one_of(
                st.floats(0, 1.9).map(lambda x: ftlm.Order(round(x, 9) + 0.0)),
                st.builds(lambda c, n: ftlm.Order(round(c, 9) + 0.0, ((f"order_{n}", 2.0),)), NUMBERS, NAMES),
            )
        )
        coefficient = draw(COEFFICIENTS)
        if isinstance(coefficient, str):
            factor = draw(st.one_of(st.sampled_from([1.0, -1.0]), st.floats(-1e9, 1e9).filter(bool)))
            terms.append(ftlm.Term(signal, order, f"c{k}{coefficient}", factor))
        else:
            terms.append(ftlm.Term(signal, order, coefficient))
    return ftlm.Equation(output, alpha, tuple(terms))


@settings(max_examples=200, deadline=None)
@given(item=equations())
def test_equation_survives_being_written_and_read(item):
    assert ftlm.equation(str(item)).equations == (item,)


# ----------------------------------------------------------------------------------------------------------------------
# Values of orders


@pytest.mark.parametrize(
    ("spec", "values"),
    [
        (1.5, 1.5),
        (2, 2.0),
        ("1.5", 1.5),
        ("1:2:0.5", (1.0, 1.5, 2.0)),
        ((1, 2, 0.5), (1.0, 1.5, 2.0)),
        ([1, 2, 0.5], (0.5, 1.0, 2.0)),
        ([2, 1], (1.0, 2.0)),
        (np.array([0.3, 0.1, 0.3]), (0.1, 0.3)),
        ((0.1, 0.2, 0.3, 0.4), (0.1, 0.2, 0.3, 0.4)),
        ("1.05:1.2:0.05", (1.05, 1.1, 1.15, 1.2)),
        ("0:0:1", (0.0,)),
        ("-0.1:0.1:0.1", (-0.1, 0.0, 0.1)),
        ("1:1.000000002:1e-9", (1.0, 1.000000001, 1.000000002)),
        ("0:1:0.3", (0.0, 0.3, 0.6, 0.9)),
    ],
)
def test_values_of_an_order(spec, values):
    assert parse_values("alpha", spec) == values


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("1:2", "'1:2' has 2 parts; write LOW:HIGH:STEP"),
        ("a", "'a' is not an interval; write LOW:HIGH:STEP"),
        ("1:2:b", "'1:2:b' is not an interval"),
        ("", "'' is not an interval"),
        ("1:2:0", "increment 0 is not positive"),
        ("1:2:-0.1", "increment -0.1 is not positive"),
        ("1:2:nan", "increment nan is not positive"),
        ("2:1:0.1", "interval 2:1 is empty"),
        ("1:11:0.1", "= 11 is outside [-3, 10]"),
        ("0:3:1e-7", "has 3e+07 values, more than 1000000"),
        ("1:1.000000002:5e-10", "increment 5e-10 is below 1e-09, the resolution of orders; raise the increment"),
        ("0:3:1e-300", "increment 1e-300 is below 1e-09, the resolution of orders; raise the increment"),
        (
            [0.5, 0.7, 0.7000000001],
            "values 0.7 and 0.7000000001 are equal, because orders have a resolution of 1e-09; leave one out",
        ),
        (11.0, "= 11 is outside [-3, 10]"),
        (math.nan, "= nan is outside [-3, 10]"),
        (math.inf, "= inf is outside [-3, 10]"),
        ([], "has no value; give at least one"),
        ([1, "x"], "= 'x' is not a number"),
        ([1, math.nan], "= nan is outside [-3, 10]"),
        (None, "None is not a list of numbers"),
        ((1.0, 2.0), "(1.0, 2.0) has no step; write (low, high, step)"),
        (True, "= True is not a number"),
    ],
)
def test_values_that_are_none_are_refused(spec, message):
    with pytest.raises(ftlm.ModelError) as refused:
        parse_values("alpha", spec)
    assert "order alpha" in str(refused.value)
    assert message in str(refused.value)


def test_grid_has_no_rounding_errors():
    values = order_axis("alpha", 0.0, 2.0, 0.05)
    assert len(values) == 41
    assert values == tuple(float(f"{0.05 * i:.2f}") for i in range(41))


# ----------------------------------------------------------------------------------------------------------------------
# Structures


def test_orders_are_fixed_or_get_a_lattice():
    structure = ftlm.equation(
        "D^alpha y = a D^beta y + b D^gamma u", orders={"alpha": 1.8, "beta": "0:1:0.5", "gamma": (0, 0.2, 0.1)}
    )
    assert structure.order_names == ("beta", "gamma")
    assert structure.order_values == {"beta": (0.0, 0.5, 1.0), "gamma": (0.0, 0.1, 0.2)}
    fixed = structure.with_orders({"beta": 0.5})
    assert fixed.order_values == {"gamma": (0.0, 0.1, 0.2)}
    assert str(fixed) == "D^1.8 y = a D^0.5 y + b D^gamma u"
    assert structure.order_names == ("beta", "gamma")  # a structure never changes


@pytest.mark.parametrize(
    ("name", "message"),
    [("bet", "order 'bet' does not occur in the equation; did you mean beta?"), ("x", "known: alpha, beta")],
)
def test_unknown_orders_are_refused(name, message):
    with pytest.raises(ftlm.ModelError) as refused:
        ftlm.equation("D^alpha y = a D^beta y", orders={name: 1.0})
    assert message in str(refused.value)


def test_order_laws():
    structure = ftlm.equation("D^alpha y = a D^(alpha-mu) y + b D^mu u")
    assert structure.has_order_law
    assert structure.order_names == ("alpha", "mu")
    at = structure.with_orders({"alpha": 1.9, "mu": 0.3})
    assert [t.order.constant for t in at.equations[0].terms] == [1.6, 0.3]
    partly = structure.with_orders({"alpha": 1.9})
    assert str(partly) == "D^1.9 y = a D^(-mu+1.9) y + b D^mu u"
    assert not ftlm.equation("D^alpha y = a D^beta y + b u").has_order_law
    assert ftlm.equation("D^alpha y = a D^mu y + b D^mu u").has_order_law  # one order in two places
    with pytest.raises(ftlm.ModelError, match=r"order 2.2 of a term of the output y is outside \[0, 1.9\)"):
        structure.with_orders({"alpha": 1.9, "mu": -0.3})


def test_one_equation_of_a_law_names_its_orders():
    structure = ftlm.equation("D^alpha y = k D^(alpha-mu) y + 3 D^(alpha-nu) z + b D^(mu) u; D^2 z = c y")
    single = structure.equation("y")
    assert single.order_names == ("alpha", "nu_y_1", "nu_y_2", "mu")
    assert single.outputs == ("y",)
    assert single.coupling == "measured"
    assert not single.has_order_law
    with pytest.raises(ftlm.ModelError, match="output 'w' does not occur"):
        structure.equation("w")


def test_fixed_coefficients():
    structure = ftlm.equation("D^1.5 y = -2 a y + b u", fixed={"a": 3})
    assert structure.coefficient_names == ("b",)
    (own, _) = structure.equations[0].terms
    assert (own.fixed_value, own.coefficient, own.factor, own.name) == (-6.0, 3.0, -2.0, "a")
    assert str(structure) == "D^1.5 y = -6.0 y + b u"
    model = ftlm.Model(structure.with_coefficients({"b": 4.0}))
    assert model.coefficients == {"a": 3.0, "b": 4.0}
    for bad, message in (
        ({"c": 1.0}, "fixed coefficient 'c' does not occur in the equation; known: a, b"),
        ({"a": math.nan}, "fixed coefficient a = nan is not finite"),
        ({"a": "1"}, "fixed coefficient a = '1' is not a number"),
    ):
        with pytest.raises(ftlm.ModelError) as refused:
            ftlm.equation("D^1.5 y = a y + b u", fixed=bad)
        assert message in str(refused.value)


@pytest.mark.parametrize(
    ("delay", "message"),
    [
        ({"u": math.inf}, "delay of u = inf s is not a finite number"),
        ({"u": math.nan}, "delay of u = nan s is not a finite number"),
        ({"u": "1"}, "delay of u = '1' is not a number"),
        ({"y": 1.0}, "delayed input 'y' does not occur in the equation; known: u"),
        ({"w": 1.0}, "delayed input 'w' does not occur"),
    ],
)
def test_delays_that_are_none_are_refused(delay, message):
    with pytest.raises(ftlm.ModelError) as refused:
        ftlm.equation("D y = a y + b u", delay=delay)
    assert message in str(refused.value)


@pytest.mark.parametrize("initial", ["auto", "rest", "caputo", "history", (0.0, 1.0), (-0.5,), ()])
def test_initial_terms(initial):
    assert ftlm.equation("D y = a y", initial=initial).initial == initial
    assert check_initial(np.array([0, 1])) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("initial", "message"),
    [
        ("start", "initial = 'start' is not known"),
        (3, "initial = 3 is not known"),
        ((-1.0,), "exponent -1 of an initial term is outside (-1, 10]"),
        ((math.nan,), "exponent nan of an initial term is outside (-1, 10]"),
        ((11,), "exponent 11 of an initial term"),
        (("a",), "exponent of an initial term = 'a' is not a number"),
    ],
)
def test_initial_terms_that_are_none_are_refused(initial, message):
    with pytest.raises(ftlm.ModelError) as refused:
        ftlm.equation("D y = a y", initial=initial)
    assert message in str(refused.value)


@pytest.mark.parametrize(
    ("numerator", "denominator", "message"),
    [
        (((1.0, 3.0),), ((1.0, 2.0), (1.0, 0.0)), "order 3 of its numerator is above 2"),
        (((1.0, 0.0),), (), "its denominator has no term"),
        (((1.0, 0.0),), ((0.0, 1.0),), "its denominator has no term"),
        (((math.nan, 0.0),), ((1.0, 1.0),), "nan D^0 in its numerator is not a term"),
        (((1.0, 0.0),), ((1.0, 11.0),), "1 D^11 in its denominator is not a term"),
        (((1.0, 0.0),), ((1.0, -1.0),), "1 D^-1 in its denominator is not a term"),
    ],
)
def test_filters_that_are_none_are_refused(numerator, denominator, message):
    with pytest.raises(ftlm.ModelError) as refused:
        SensorFilter(("y",), numerator, denominator)
    assert "sensor filter" in str(refused.value)
    assert message in str(refused.value)


def test_filtered_outputs_must_occur():
    with pytest.raises(ftlm.ModelError, match="filtered signal 'z' does not occur in the equation; known: y, u"):
        ftlm.equation("D y = a y + b u", sensor_filter=SensorFilter.low_pass(["z"]))


def test_other_structures_that_are_none_are_refused():
    (item,) = ftlm.equation("D y = a y").equations
    with pytest.raises(ftlm.ModelError, match="the structure has no equation; give at least one"):
        ftlm.Structure(())
    with pytest.raises(ftlm.ModelError, match="coupling = 'loose' is not known; use 'measured' or 'simulated'"):
        ftlm.Structure((item,), coupling="loose")
    with pytest.raises(ftlm.ModelError, match="the equation of y has no term"):
        ftlm.Equation("y", ftlm.Order(1.0), ())


def test_structures_and_models_print_well():
    structure = ftlm.equation("D^alpha y = -2 a D^0.5 y + b u")
    assert str(structure) == "D^alpha y = -2.0 a D^0.5 y + b u"
    assert structure._repr_html_() == "<pre>D^alpha y = -2.0 a D^0.5 y + b u</pre>"
    model = ftlm.Model(ftlm.equation("D^1.5 y = -2.123456789 D^0.5 y + 1e-7 u - 3e8 v"))
    assert str(model) == "D^1.5 y = -2.12346 D^0.5 y + 1e-07 u - 3e+08 v"
    assert format_equation(model.equations[0]) == str(model)


# ----------------------------------------------------------------------------------------------------------------------
# Models and their files


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("D^alpha y = 2 y", "the equation of y still has free alpha; identify it first"),
        ("D y = a y + b u", "the equation of y still has free a, b; identify it first"),
    ],
)
def test_a_model_has_nothing_free(text, message):
    with pytest.raises(ftlm.ModelError) as refused:
        ftlm.Model(ftlm.equation(text))
    assert message in str(refused.value)


def test_a_model_has_finite_coefficients():
    with pytest.raises(ftlm.ModelError, match="coefficient of y in the equation of y is nan"):
        ftlm.Model(ftlm.equation("D y = a y").with_coefficients({"a": math.nan}))


def full_model():
    """A model with one of everything that a file holds."""
    structure = ftlm.equation(
        "D^alpha y = -2 a D^beta y + b z + 3 u; D^1.9 z = -c z + d D^-0.25 u",
        delay={"u": 0.0123456789012345},
        initial=(0.0, 0.9),
        sensor_filter=SensorFilter.low_pass(["y"], 1 / 3, 0.7),
    )
    rng = np.random.default_rng(1)
    values = dict(zip("abcd", rng.standard_normal(4) * 10.0 ** rng.integers(-200, 200, 4), strict=True))
    orders = {"alpha": 1.0 + 1 / 3, "beta": 0.1 + 0.2}
    return ftlm.Model(
        structure.with_orders(orders).with_coefficients({n: float(v) for n, v in values.items()}),
        orders=orders,
        units={"y": "rad", "u": "A"},
        m=2048,
        about={"method": "multi-innovation", "p": 7, "k0": 1e-300, "haar": True, "note": "<b>ü</b>", "none": None},
    )


def same_bits(a, b):
    return struct.pack("<d", a) == struct.pack("<d", b)


def test_a_model_file_gives_back_every_bit(tmp_path):
    model = full_model()
    path = model.save(tmp_path / "model.json")
    assert path == tmp_path / "model.json"
    loaded = ftlm.load_model(path)
    # What is only of use before identification is not stored.
    assert loaded.structure.order_values == {}
    for original, restored in zip(model.equations, loaded.equations, strict=True):
        assert original == restored
        for a, b in zip(original.terms, restored.terms, strict=True):
            assert same_bits(a.coefficient, b.coefficient)
            assert same_bits(a.fixed_value, b.fixed_value)
            assert same_bits(a.order.constant, b.order.constant)
    for name in ("orders", "units", "m", "about", "coefficients"):
        assert getattr(loaded, name) == getattr(model, name), name
    for name in ("delay", "initial", "sensor_filter", "coupling", "name"):
        assert getattr(loaded.structure, name) == getattr(model.structure, name), name
    loaded.save(tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == path.read_bytes()


def test_factor_and_sign_survive_estimation_and_file(small_run, tmp_path):
    # -2 a is the -3, 0.5 b the 5 of the small model: a = 1.5, b = 10, and the same after reading the file.
    structure = ftlm.equation("D^1.6 y = -2 a D^nu y - 8 y + 0.5 b u", orders={"nu": [0.4, 0.6]})
    found = ftlm.search_orders(small_run, structure, coefficients="least-squares", m=256)
    assert found.orders == {"nu": 0.6}
    assert found.coefficients["a"] == pytest.approx(1.5, rel=1e-3)
    assert found.coefficients["b"] == pytest.approx(10, rel=1e-3)
    identified = ftlm.identify(small_run, structure, method="least-squares", m=256)
    assert identified.coefficients == pytest.approx(found.coefficients, rel=1e-9)
    assert [t.factor for t in identified.model.equations[0].terms] == [-2.0, 1.0, 0.5]
    loaded = ftlm.load_model(identified.model.save(tmp_path / "m.json"))
    assert loaded.coefficients == identified.coefficients
    assert [t.fixed_value for t in loaded.equations[0].terms] == [
        t.fixed_value for t in identified.model.equations[0].terms
    ]
    assert loaded.simulate(small_run)["y"].tolist() == identified.model.simulate(small_run)["y"].tolist()


def test_nothing_is_overwritten_without_force(tmp_path):
    model = full_model()
    path = tmp_path / "model.json"
    path.write_text("mine")
    with pytest.raises(
        ftlm.DataError, match=r"model\.json exists; choose another name, or overwrite it with force=True"
    ):
        model.save(path)
    assert path.read_text() == "mine"
    model.save(path, force=True)
    assert ftlm.load_model(path).coefficients == model.coefficients
    # A link that leads nowhere is a name that is taken.
    link = tmp_path / "link.json"
    link.symlink_to(tmp_path / "nowhere")
    with pytest.raises(ftlm.DataError, match="exists"):
        model.save(link)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link.json", "model.json"]  # nothing left beside


def test_a_file_that_cannot_be_written_is_an_error_in_words(tmp_path):
    with pytest.raises(ftlm.DataError, match="cannot be written: No such file or directory; choose another folder"):
        full_model().save(tmp_path / "nowhere" / "model.json")
    (tmp_path / "folder").mkdir()
    with pytest.raises(ftlm.DataError, match="folder is a folder; name a file in it"):
        full_model().save(tmp_path / "folder", force=True)
    with pytest.raises(ftlm.DataError, match="cannot be written"):
        full_model().save(f"{tmp_path}/nul\0.json")
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]


def test_whether_a_file_may_be_written_is_said_before_it_is(tmp_path):
    there, new = tmp_path / "there", tmp_path / "new"
    there.touch()
    exists = f"{there} exists; choose another name, or overwrite it with force=True"
    for path, text in ((there, exists), (tmp_path, f"{tmp_path} is a folder; name a file in it")):
        for check in (check_target, check_writable):
            with pytest.raises(ftlm.DataError, match=f"^{re.escape(text)}$"):
                check(path, force=False)
    with pytest.raises(ftlm.DataError, match=f"^{re.escape(f'{new} is not a folder')}; create it first$"):
        check_writable(None, new / "file", force=False)
    check_writable(there, new, None, force=True)
    assert check_target(new / "file", force=False) == new / "file"


def test_a_written_file_has_the_usual_permissions(tmp_path):
    path = write_atomically(tmp_path / "a", b"x", force=False)
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~umask


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "model.json"
    path.write_text("mine")
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(ftlm.DataError, match="No space left on device"):
        full_model().save(path, force=True)
    assert path.read_text() == "mine"
    assert [p.name for p in tmp_path.iterdir()] == ["model.json"]


def altered(change):
    """The text of a model file after a change to its document."""
    model = full_model()
    document = json.loads(__import__("msgspec").json.encode(ModelFile.of(model)))
    change(document)
    return json.dumps(document)


HOSTILE = {
    "empty": "",
    "no JSON": "not a model",
    "a number": "3",
    "a list": "[]",
    "null": "null",
    "another object": "{}",
    "two documents": "{}{}",
    "deep nesting": "[" * 100_000,
    "deep objects": '{"a":' * 50_000,
    "not UTF-8": b"\xff\xfe\x00{",
    "a NUL": b"\0" * 100,
    "unknown key": altered(lambda d: d.update(extra=1)),
    "unknown key in an equation": altered(lambda d: d["equations"][0].update(extra=1)),
    "unknown key in a term": altered(lambda d: d["equations"][0]["terms"][0].update(extra=1)),
    "missing key": altered(lambda d: d.pop("coupling")),
    "another format": altered(lambda d: d.update(format="other")),
    "text for a number": altered(lambda d: d["equations"][0].update(order="2")),
    "number beyond range": altered(lambda d: d).replace("1.9", "1e999"),
    "a covariance of another size": altered(
        lambda d: d.update(estimate={"method": "x", "runs": [], "values": {}, "covariance": [[1.0]]})
    ),
    "NaN": altered(lambda d: d["equations"][0].update(order=math.nan)),
    "another schema": altered(lambda d: d.update(schema=1)),
    "another schema with what is in it": altered(lambda d: d.update(schema=14, moons={"of": "a later version"})),
    "another schema, and who wrote it": altered(lambda d: d.update(schema=10**30, written_by="ftlm 7", equations=4)),
    "schema in text": altered(lambda d: d.update(schema="1")),
    "alpha out of range": altered(lambda d: d["equations"][0].update(order=11.0)),
    "own order above alpha": altered(lambda d: d["equations"][0]["terms"][0].update(order=2.9)),
    "no equation": altered(lambda d: d.update(equations=[])),
    "no term": altered(lambda d: d["equations"][0].update(terms=[])),
    "one output twice": altered(lambda d: d["equations"].append(d["equations"][0])),
    "factor 0": altered(lambda d: d["equations"][0]["terms"][0].update(factor=0.0)),
    "overflow of factor and coefficient": altered(
        lambda d: d["equations"][0]["terms"][0].update(factor=1e200, coefficient=1e200)
    ),
    "another coupling": altered(lambda d: d.update(coupling="loose")),
    "delay of text": altered(lambda d: d.update(delay={"u": "soon"})),
    "delay of nothing": altered(lambda d: d.update(delay={"w": 1.0})),
    "initial terms": altered(lambda d: d.update(initial="start")),
    "initial exponents": altered(lambda d: d.update(initial=[-2.0])),
    "improper filter": altered(lambda d: d["sensor_filter"].update(numerator=[[1.0, 3.0]])),
    "filter without denominator": altered(lambda d: d["sensor_filter"].update(denominator=[])),
    "filter of nothing": altered(lambda d: d["sensor_filter"].update(signals=["w"])),
    "m = 0": altered(lambda d: d.update(m=0)),
    "m < 0": altered(lambda d: d.update(m=-4)),
    "m beyond all machines": altered(lambda d: d.update(m=10**30)),
    "m = 1.5": altered(lambda d: d.update(m=1.5)),
    "orders in text": altered(lambda d: d.update(orders={"alpha": "x"})),
    "too large": " " * ((1 << 20) + 1),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_model_files_are_refused(kind, tmp_path):
    path = tmp_path / "hostile.json"
    content = HOSTILE[kind]
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ftlm.DataError) as refused:
        ftlm.load_model(path)
    message = str(refused.value)
    assert message.startswith(str(path))
    version = f", and ftlm {ftlm.__version__} reads schema 13"
    words = f"{version}; read it with the version that wrote it, or compute the model again"
    expected = {
        "too large": "1048577 bytes",
        "another schema": f"is a model file of schema 1{words}",
        "another schema with what is in it": f"is a model file of schema 14{words}",
        "another schema, and who wrote it": f"is a model file of schema {10**30} (written by 'ftlm 7'){words}",
        "unknown key": "is not an ftlm model: Object contains unknown field `extra`",
    }
    assert expected.get(kind, "") in message


@pytest.mark.parametrize("load", [ftlm.load_model, ftlm.control.load_controller])
def test_what_is_no_path_of_a_file_is_refused(load, tmp_path):
    for wrong in (5, None, b"model.json", ["model.json"], 10**5000):
        with pytest.raises(ftlm.DataError, match=r"^path = .* is not the path of a file; give a file "):
            load(wrong)
    with pytest.raises(ftlm.DataError, match="is not a regular file; give a file "):
        load(tmp_path)
    for absent in (tmp_path / "none.json", "a\0b", "\ud800.json", "x" * 5000):
        with pytest.raises(ftlm.DataError, match=r"cannot be read: .*; check the path$") as refused:
            load(absent)
        assert str(refused.value).isprintable()
        assert len(str(refused.value)) < 1000


def test_a_model_file_cut_anywhere_is_refused(tmp_path):
    path = full_model().save(tmp_path / "model.json")
    whole = path.read_bytes().rstrip()
    cut = tmp_path / "cut.json"
    for length in range(0, len(whole), 17):
        cut.write_bytes(whole[:length])
        with pytest.raises(ftlm.DataError, match=r"cut\.json"):
            ftlm.load_model(cut)


def test_a_model_file_flipped_anywhere_never_is_another_kind_of_error(tmp_path):
    whole = full_model().save(tmp_path / "model.json").read_bytes()
    flipped = tmp_path / "flipped.json"
    rng = np.random.default_rng(2)
    for _ in range(300):
        data = bytearray(whole)
        data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        flipped.write_bytes(data)
        try:
            model = ftlm.load_model(flipped)
        except ftlm.DataError:
            continue
        assert all(math.isfinite(c) for c in model.coefficients.values())


def test_paths_that_hold_no_model_are_refused(tmp_path):
    for path, message in (
        (tmp_path / "missing.json", "missing.json cannot be read: No such file or directory; check the path"),
        (tmp_path, "is not a regular file"),
        ("/dev/null", "is not a regular file"),
        (f"{tmp_path}/nul\0", "nul"),
    ):
        with pytest.raises(ftlm.DataError) as refused:
            ftlm.load_model(path)
        assert message in str(refused.value)
