"""Non-linear terms: language, values, records."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ftlm
from ftlm.model.parameter_estimates import parameter_units
from ftlm.report.typesetting import equations_html
from ftlm.simulation.simulate import explicit_euler
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
    assert '"expression": "abs(D^0.5 y)*D^0.5 y*u"' in path.read_text()
    assert ftlm.load_model(path) == model
    path.write_text(path.read_text().replace("(y + 300)^4", "(y + 300)^4.5"))
    with pytest.raises(ftlm.DataError, match=r"the power 4\.5 of"):
        ftlm.load_model(path)


TEXT = "D^1.8 y = -2 y - 0.5 D^0.5 y - 3 y^3 + 0.7 y*u + u - 0.2 abs(D y)*D y"


@pytest.fixture(scope="module")
def model():
    return ftlm.Model(ftlm.equation(TEXT))


@pytest.fixture(scope="module")
def run():
    u = np.repeat(np.random.default_rng(1).uniform(-1, 1, 40), 10)
    return ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": 0.2 * np.cumsum(u) / 10})


LINEAR_ONLY = {
    "frequency response": lambda m, run: m.frequency_response([1.0]),
    "bode": lambda m, run: m.bode(),
    "poles": lambda m, run: m.poles(),
    "zeros": lambda m, run: m.zeros(),
    "modes": lambda m, run: m.modes(),
    "stability": lambda m, run: m.stability(),
    "is stable": lambda m, run: m.is_stable(),
    "dcgain": lambda m, run: m.dcgain(),
    "to_tf": lambda m, run: m.to_tf(),
    "to_control": lambda m, run: m.to_control(band=(0.1, 10.0)),
    "series": lambda m, run: m.series(m),
    "parallel": lambda m, run: m.parallel(m),
    "feedback": lambda m, run: m.feedback(1.0),
    "inverse": lambda m, run: m.inverse(),
    "transfer functions": lambda m, run: ftlm.analysis.transfer_functions(m),
    "approximation": lambda m, run: ftlm.analysis.approximate(m, band=(0.1, 10.0)),
    "json": lambda m, run: ftlm.analysis.json_text(m),
    "matlab": lambda m, run: ftlm.analysis.matlab_text(m),
    "python-control": lambda m, run: ftlm.analysis.control_text(m, band=(0.1, 10.0)),
    "pid": lambda m, run: ftlm.control.fractional_pid(m, crossover=1.0, phase_margin=60.0),
    "lqg": lambda m, run: ftlm.control.lqg(m, max_deviation={"y": 1.0}, max_input=1.0),
    "shaper": lambda m, run: ftlm.control.input_shaper(m),
    "Euler": explicit_euler,
    "next experiment": lambda m, run: ftlm.design_input(m, reference_run=run, peak=1.0),
    "frequency identification": lambda m, run: ftlm.identify_frequency(
        ftlm.FrequencyData.from_arrays([1.0, 2.0], [1.0, 0.5j], input="u", output="y"), "D y = a y^2 + b u"
    ),
    "instruments": lambda m, run: ftlm.identify(
        run, ftlm.equation("D y = a y^2 + b u"), method="instrumental-variables"
    ),
    "genetic": lambda m, run: ftlm.identify(run, ftlm.equation("D^q y = a y^2 + b u"), method="genetic"),
    "reference": lambda m, run: ftlm.identify(
        run, ftlm.equation("D y = a y^2 + b u"), method=ftlm.OutputError(reference="u")
    ),
    "offset test": lambda m, run: ftlm.identify(
        run, ftlm.equation("D y = a y^2 + b u"), offset="auto", method="least-squares"
    ),
    "search by instruments": lambda m, run: ftlm.search_orders(
        run, ftlm.equation("D^q y = a y^2 + b u"), coefficients="instrumental-variables"
    ),
    "certificate": lambda m, run: ftlm.certify_orders(run, ftlm.equation("D^q y = a y^2 + b u", initial="rest")),
    "stream": lambda m, run: ftlm.estimation.linear.Streaming(
        ftlm.equation("D y = a y^2 + b u"), step=0.1, max_duration=9.0, inputs=["u"]
    ),
    "trace": lambda m, run: ftlm.estimation.linear.multi_innovation_trace(run, ftlm.equation("D y = a y^2 + b u")),
}


@pytest.mark.parametrize("kind", LINEAR_ONLY)
def test_what_is_linear_refuses_a_nonlinear_model_by_name(kind, model, run):
    with pytest.raises(ftlm.ModelError, match=r"non-linear term .* model\.linearized\(at=\{'y': 0\.3"):
        LINEAR_ONLY[kind](model, run)


def test_linear_model_about_a_point(model):
    linear = model.linearized(at={"y": 0.3, "u": 0.5})
    assert str(linear) == "D^1.8 y = -2.46 y - 0.5 D^0.5 y + 1.21 u"
    assert linear.stability().stable
    moving = model.linearized(at={"y": 0.0, "u": 0.0, "D y": -0.5})
    assert str(moving) == "D^1.8 y = -2 y - 0.5 D^0.5 y + 1 u - 0.2 D^1 y"
    assert model.linearized(at={"y": 0.3, "u": 0.5}).structure.is_linear
    feedthrough = ftlm.Model(ftlm.equation("D^1.5 y = -2 y - D^0.5 (y*D y) + u + u^2"))
    assert str(feedthrough.linearized(at={"y": 0.5, "u": 1})) == "D^1.5 y = -1.33333 y + 2 u"


def test_an_input_that_makes_the_output_jump_is_refused():
    with pytest.raises(ftlm.ModelError, match="order 2 of h is not below alpha = 2, but the non-linear term k y"):
        ftlm.equation("D^2 y = a y + k y^3 - D^2 h")
    coupled = ftlm.equation("D^2 y = a y + k y^3 - D^2 h; D^2 h = b u", coupling="simulated")
    assert coupled.has_nonlinear_terms


@pytest.mark.parametrize(
    ("text", "at", "message"),
    [
        (
            TEXT,
            {"y": 0.3},
            "the operating point of u is not given, and 0.7 (y)*u depends on it; give its value with at=",
        ),
        (TEXT, {"y": 0.3, "u": 0, "v": 1}, "operating point 'v' does not occur in the equation"),
        (TEXT, {"y": 0.3, "u": 0, "sin(y)": 1}, "the operating point 'sin(y)' is not a signal"),
        ("D y = -sqrt(y) + u", {"y": 0.0}, "sqrt(y) has no derivative at y = 0"),
        ("D^2 y = (y + 1)*D^2 y - y + u", {"y": 0.0}, "the highest derivative of y cancels"),
    ],
)
def test_points_without_a_linear_model_are_refused(text, at, message):
    with pytest.raises(ftlm.ModelError) as refused:
        ftlm.Model(ftlm.equation(text)).linearized(at=at)
    assert message in str(refused.value)


@pytest.mark.parametrize(
    ("term", "unit"),
    [
        ("k y^3", "s^-2 rad^-2"),
        ("k y*u", "s^-2 V^-1"),
        ("k u^2", "s^-2 rad/V^2"),
        ("k abs(D y)*D y", "rad^-1"),
        ("k D^0.5 (y^2*w)", "s^-1.5 rad^-1·(m/s)^-1"),
        ("k sin(y)", "s^-2 rad"),
        ("k ((y + 300)^4 - 8.1e9)", "s^-2 rad^-3"),
        ("k sqrt(u)", "s^-2 rad/V^0.5"),
        ("k y*n", "s^-2"),
        ("k y^2*v", ""),
    ],
)
def test_unit_of_the_coefficient_of_a_nonlinear_term(term, unit):
    units = {"y": "rad", "u": "V", "w": "m/s", "n": "1"}
    structure = ftlm.equation(f"D^2 y = {term}")
    model = ftlm.Model(structure.with_coefficients({"k": 1.0}), units=units)
    assert parameter_units(model).get("k", "") == unit


def test_equation_of_a_page():
    model = ftlm.Model(ftlm.equation("D^1.5 y = -2 y^3 + 0.5 D^0.25 (abs(D y)*y - sqrt(y + 1)) - 3 cos(2 y)"))
    shown = re.sub(r"<[^>]+>|\s", "", str(equations_html(model)[0]))
    assert shown == "D1.5y=−2.0000y3+0.50000D0.25(|Dy|y−y+1)−3.0000cos(2y)"
