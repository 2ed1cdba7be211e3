"""Non-linear terms: language, values, records."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ftlm
from ftlm.structure.expression import EXPRESSION_FUNCTIONS, add, apply, channel, constant, multiply, power
from ftlm.structure.grammar import EquationParser

CHANNELS = [("y", 0.0), ("y", 1.0), ("y", 0.5), ("u", 0.0), ("v", 0.0)]
NUMBERS = st.sampled_from([-3.0, -1.0, 0.25, 1 / 3, 2.0, 300.0, 1e-7])


def extend(inner):
    """Expressions over expressions."""
    return st.one_of(
        st.lists(inner, min_size=2, max_size=3).map(lambda a: add(*a)),
        st.lists(inner, min_size=2, max_size=3).map(lambda a: multiply(*a)),
        st.tuples(inner, st.integers(2, 4)).map(lambda a: power(*a)),
        st.tuples(inner, st.sampled_from([0.5, 1.5, 2.25])).map(lambda a: power(apply("abs", channel("y", 1)), a[1])),
        st.tuples(st.sampled_from(sorted(EXPRESSION_FUNCTIONS)), inner.filter(lambda e: e.channels)).map(
            lambda a: apply(*a)
        ),
    )


EXPRESSIONS = st.recursive(
    st.one_of(st.sampled_from(CHANNELS).map(lambda c: channel(*c)), NUMBERS.map(constant)), extend, max_leaves=8
)
NONLINEAR = (
    EXPRESSIONS.filter(lambda e: not e.is_linear).map(lambda e: e.split_factor()[1]).filter(lambda e: not e.is_linear)
)


@settings(max_examples=100, deadline=None)
@given(expression=EXPRESSIONS)
def test_an_expression_is_read_back_from_its_text(expression):
    assert EquationParser(str(expression)).parse_expression() == expression


def is_sum_without_powers(expression):
    return expression.operation == "add" and not any(word in str(expression) for word in ("^", *EXPRESSION_FUNCTIONS))


@settings(max_examples=60, deadline=None)
@given(
    expressions=st.lists(NONLINEAR.filter(lambda e: not is_sum_without_powers(e)), min_size=1, max_size=3),
    known=st.lists(st.one_of(NUMBERS, st.none()), min_size=3, max_size=3),
    orders=st.lists(st.sampled_from(["", "D^0.5 ", "D^mu "]), min_size=3, max_size=3),
    limits=st.booleans(),
)
def test_a_structure_with_nonlinear_terms_is_read_back(expressions, known, orders, limits):
    terms = []
    for k, (expression, number, order) in enumerate(zip(expressions, known, orders, strict=False)):
        coefficient = f"k{k}" if number is None else repr(number)
        terms.append(f"+ {coefficient} {order}({'' if order else '('}{expression}{'' if order else ')'})")
    try:
        structure = ftlm.equation(f"D^2.5 y = b u + a y {' '.join(terms)}", delay={"u": 0.25} if limits else None)
    except ftlm.ModelError:
        # A number times a sum is multiplied out, and its items may be constants.
        return
    assert ftlm.equation(str(structure)) == structure
    assert structure.has_nonlinear_terms


def run_program(program, values):
    """Naive stack machine."""
    stack = []
    for name, value in program:
        if name == "constant":
            stack.append(value)
        elif name == "channel":
            stack.append(values[int(value)])
        elif name in ("add", "multiply"):
            b, a = stack.pop(), stack.pop()
            stack.append(a + b if name == "add" else a * b)
        elif name == "negate":
            stack.append(-stack.pop())
        elif name == "power":
            stack.append(stack.pop() ** value)
        else:
            stack.append(EXPRESSION_FUNCTIONS[name][0](stack.pop()))
    (out,) = stack
    return out


@settings(max_examples=60, deadline=None)
@given(expression=EXPRESSIONS, seed=st.integers(0, 1000))
def test_program_values_and_gradient_agree(expression, seed):
    values = dict(zip(CHANNELS, np.random.default_rng(seed).uniform(0.2, 1.0, len(CHANNELS)), strict=True))
    expected = expression.evaluate(values)
    with np.errstate(all="ignore"):
        found = run_program(expression.program({c: i for i, c in enumerate(CHANNELS)}), list(values.values()))
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    for one, slope in expression.gradient(values).items():
        around = [expression.evaluate(values | {one: values[one] + d}) for d in (-2e-6, -1e-6, 1e-6, 2e-6)]
        near, far = (around[2] - around[1]) / 2e-6, (around[3] - around[0]) / 4e-6
        # Not where the expression is too steep, or too large, for differences.
        if (
            np.isfinite([*around, slope]).all()
            and abs(far - near) < 1e-4 * abs(near)
            and abs(expected) < 1e4 * abs(near)
        ):
            assert slope == pytest.approx(near, rel=1e-3)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("D^2 y = -k y - k3 y^3 + b u", "D^2 y = -k y - k3 y^3 + b u"),
        ("D^2 y + k3 y**3 = u", "D^2 y = -k3 y^3 + 1.0 u"),
        ("D y = -w abs(D^0.5 y)*y + u", "D^1 y = -w abs(D^0.5 y)*y + 1.0 u"),
        ("D T = e ((T + 300)^4 - 300^4) + u", "D^1 T = e ((T + 300)^4 - 8.1e+09) + 1.0 u"),
        ("D T = -4e-9 ((T + 300)^4 - 300^4) + u", "D^1 T = -4e-09 ((T + 300)^4 - 8.1e+09) + 1.0 u"),
        ("y'' = k D^mu (y^3) + b u", "D^2 y = k D^mu (y^3) + b u"),
        ("D y = e y*u - y", "D^1 y = e y*u - 1.0 y"),
        # A name that is a signal elsewhere is no coefficient.
        ("D y = y*u - y", "D^1 y = 1.0 (y)*u - 1.0 y"),
        ("D y = 3 u*v + u", "D^1 y = 3.0 (u)*v + 1.0 u"),
        ("D y = k sin(2 y)/4 + u(t - 0.1)^2", "D^1 y = 0.25 k sin(2*y) + 1.0 u(t - 0.1 s)^2"),
        ("D y = k sat(u, 2)^2 - y", "D^1 y = k sat(u, 2.0)^2 - 1.0 y"),
        ("D y = -k (2 y) + u", "D^1 y = -2.0 k y + 1.0 u"),
        ("D y = 2 (a y^2 + b u)", "D^1 y = 2.0 a y^2 + 2.0 b u"),
        ("D y = fs exp(-(y/0.5)^2) - y", "D^1 y = fs exp(-(2*y)^2) - 1.0 y"),
        ("dy/dt = y'*u^2 - y", "D^1 y = 1.0 D y*u^2 - 1.0 y"),
    ],
)
def test_texts_and_their_meaning(text, shown):
    structure = ftlm.equation(text)
    assert str(structure) == shown
    assert ftlm.equation(shown) == structure


def test_what_a_nonlinear_term_holds():
    structure = ftlm.equation("D^1.8 y = a y + w abs(D^0.5 y)*D^0.5 y*u + k D^0.3 (v^2)")
    (_, drag, square), (equation,) = structure.equations[0].terms, structure.equations
    assert drag.nonlinear.channels == (("y", 0.5), ("u", 0.0))
    assert (drag.signal, drag.signals, drag.order) == ("y", ("y", "u"), ftlm.Order(0.0))
    assert (square.signal, square.order) == ("v", ftlm.Order(0.3))
    assert equation.signals == ("y", "u", "v")
    assert equation.nonlinear_terms == (drag, square)
    assert structure.has_nonlinear_terms
    assert not ftlm.equation("D y = a y + u").has_nonlinear_terms


def test_a_saved_model_is_read_back(tmp_path):
    text = "D^1.8 y = a y + w abs(D^0.5 y)*D^0.5 y*u - 0.1 y^3 + k D^0.3 (v^2) + e ((y + 300)^4 - 300^4)"
    model = ftlm.Model(ftlm.equation(text, fixed={"a": -1 / 3, "w": -0.7, "k": 2.0, "e": 1e-9}))
    path = model.save(tmp_path / "model.json")
    assert '"schema": 11' in path.read_text()
    assert '"expression": "abs(D^0.5 y)*D^0.5 y*u"' in path.read_text()
    assert ftlm.load_model(path) == model
    path.write_text(path.read_text().replace("(y + 300)^4", "(y + 300)^4.5"))
    with pytest.raises(ftlm.DataError, match=r"the power 4\.5 of"):
        ftlm.load_model(path)
    linear = ftlm.Model(ftlm.equation("D y = -1 y + 1 u")).save(tmp_path / "linear.json")
    assert '"schema": 2' in linear.read_text()
    assert "expression" not in linear.read_text()
