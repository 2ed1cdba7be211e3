"""Bad input as a table: each a typed error that names the thing, and for data the first index and the count."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ftlm
from ftlm import _core
from ftlm.utils.validation import error_text, real_number, short_repr, whole_number

N = 65
U = np.where(np.arange(N) % 20 < 10, 1.0, -1.0)
Y = np.cumsum(np.cumsum(U)) / 100


def run(y=Y, u=U, **options):
    options = {"step": 0.1, "inputs": {"u": u}, "outputs": {"y": y}} | options
    return ftlm.Run.from_arrays(**options)


def spoiled(*where, by=math.nan):
    y = Y.copy()
    y[list(where)] = by
    return y


WORDS = "D^alpha y = a D^beta y + b u"


def identify(runs=None, words="D^1.5 y = a y + b u", **options):
    return ftlm.identify(run() if runs is None else runs, ftlm.equation(words), **{"method": "least-squares"} | options)


def search(runs=None, words=WORDS, order_grid=None, **options):
    chosen = ftlm.order_grid(increment=0.5) if order_grid is None else order_grid
    return ftlm.search_orders(run() if runs is None else runs, ftlm.equation(words), chosen, **{"m": 64} | options)


def model(words="D^1.5 y = -2 y + 3 u", **options):
    return ftlm.Model(ftlm.equation(words, **options))


MODEL, DATA, CONVERGENCE = ftlm.ModelError, ftlm.DataError, ftlm.ConvergenceError

BAD = {
    # Orders
    "alpha of 0": (MODEL, "its left-hand side has no derivative", lambda: ftlm.equation("D^0 y = a u")),
    "alpha above 10": (MODEL, "order alpha = 10.01 of y", lambda: ftlm.equation("D^10.01 y = a u")),
    "alpha below 0": (MODEL, "order alpha = -1 of y", lambda: ftlm.equation("D^(-1) y = a u")),
    "alpha above 10 in a lattice": (MODEL, "order alpha = 10.5", lambda: ftlm.order_grid(alpha=(1.0, 10.5))),
    "alpha of 0 in a lattice": (MODEL, "alpha interval 0:2", lambda: ftlm.order_grid(alpha=(0.0, 2.0))),
    "alpha above 10 by name": (
        MODEL,
        "order alpha = 11",
        lambda: ftlm.equation(WORDS, orders={"alpha": 11.0}),
    ),
    "own order at alpha": (
        MODEL,
        "order 1.5 of a term of the output y is outside [0, 1.5)",
        lambda: ftlm.equation("D^1.5 y = a D^1.5 y"),
    ),
    "own order above alpha": (MODEL, "order 2 of a term of the output y", lambda: ftlm.equation("D^1.5 y = a D^2 y")),
    "own order below 0": (MODEL, "order -0.5 of a term of the output y", lambda: ftlm.equation("D^1.5 y = a D^-0.5 y")),
    "own order fixed above alpha": (
        MODEL,
        "order 1.8 of a term of the output y",
        lambda: ftlm.equation(WORDS, orders={"alpha": 1.5, "beta": 1.8}),
    ),
    "input order above alpha": (
        MODEL,
        "order 2.7 of u is above alpha = 1.5 of y",
        lambda: identify(run(), "D^1.5 y = a D^2.7 u"),
    ),
    "other output below 0": (
        MODEL,
        "order of term 1 = -0.5 is outside [0, 2.5)",
        lambda: identify(run(outputs={"y": Y, "z": Y**2}), "D^1.5 y = a y + b D^-0.5 z"),
    ),
    "order without a value": (MODEL, "order mu has no value", lambda: ftlm.Order.parse("alpha-mu").at({"alpha": 1})),
    "order of a product": (MODEL, "order 'alpha*mu'", lambda: ftlm.Order.parse("alpha*mu")),
    # Lattices
    "lattice of zero": (
        MODEL,
        "the order grid has no candidate",
        lambda: search(order_grid=ftlm.order_grid(alpha=(0.5, 0.6), beta=[1.0, 2.0])),
    ),
    "lattice of 10^9": (
        MODEL,
        "more than the limit of",
        lambda: search(
            words="D^alpha y = a D^b y + c D^e y + d D^f y + u", order_grid=ftlm.order_grid(increment=0.001)
        ),
    ),
    "lattice with a step of 0": (
        MODEL,
        "order alpha: increment 0 is not positive",
        lambda: ftlm.order_grid(increment=0),
    ),
    "lattice of an unknown order": (
        MODEL,
        "order 'betta' of order_grid= is not a free order; free are alpha, beta",
        lambda: search(order_grid=ftlm.order_grid(betta=1.0)),
    ),
    "lattice upside down": (
        MODEL,
        "order beta: interval 1:0 is empty",
        lambda: search(order_grid=ftlm.order_grid(beta=(1, 0))),
    ),
    "lattice of a million steps": (MODEL, "order alpha: 1.05:2:1e-09", lambda: ftlm.order_grid(increment=1e-9)),
    "nothing to search": (MODEL, "every order is a number", lambda: search(words="D^1.5 y = a y + b u")),
    # Pulses
    "m above what the data carry": (
        MODEL,
        "m = 65 is more than run 'run' allows: 65 rows give 64 pulses",
        lambda: search(m=65),
    ),
    "m of a short second run": (
        MODEL,
        "m = 64 is more than run 'short' allows: 33 rows give 32 pulses",
        lambda: search([run(), run(Y[:33], U[:33], name="short")]),
    ),
    "m no power of two with Haar rows": (
        MODEL,
        "m = 60 is not a power of two, which Haar rows need; take m = 32 or 64",
        lambda: search(m=60),
    ),
    "m of 0": (MODEL, "m = 0 is not a number of pulses", lambda: identify(m=0)),
    "m in words": (MODEL, "m = 'many' is not a number of pulses", lambda: identify(m="many")),
    "m not finite": (MODEL, "m = inf is not a number of pulses", lambda: model().compare(run(), m=math.inf)),
    "length no power of two": (
        MODEL,
        "need m to be a power of two, not 65; take m = 64 or 128",
        lambda: ftlm.haar_transform(Y),
    ),
    # Settings
    "threads of 0": (MODEL, "threads = 0 is outside [1, 1024]", lambda: search(threads=0)),
    "keep of 0": (MODEL, "top = 0 is outside [1, 100000]", lambda: search(top=0)),
    "p of 0": (MODEL, "innovation_length = 0", lambda: identify(method=ftlm.MultiInnovation(innovation_length=0))),
    "K0 of 0": (
        MODEL,
        "prior_covariance = 0 is not positive",
        lambda: identify(method=ftlm.MultiInnovation(prior_covariance=0)),
    ),
    "K0 below 0": (MODEL, "prior_covariance = -3 is not positive", lambda: search(prior_covariance=-3)),
    "unknown method": (MODEL, "method = 'lsq' is not known", lambda: identify(method="lsq")),
    "unknown criterion": (MODEL, "criterion = 'rmse' is not known", lambda: search(criterion="rmse")),
    "unknown norm": (MODEL, "norm = 'linf' is not known", lambda: search(norm="linf")),
    "unknown rows": (MODEL, "row_basis = 'fast' is not known", lambda: search(row_basis="fast")),
    "unknown coefficients": (MODEL, "coefficients = 'free' is not known", lambda: search(coefficients="free")),
    "unknown coupling": (
        MODEL,
        "coupling = 'none' is not known",
        lambda: ftlm.flexible_link(coupling="none"),
    ),
    "unknown rule": (
        MODEL,
        "rule 'simpson' is not known",
        lambda: ftlm.fractional_integral(Y, 0.5, step=1, rule="simpson"),
    ),
    "unknown definition": (
        MODEL,
        "definition 'weyl' is not known",
        lambda: ftlm.fractional_derivative(Y, 0.5, step=1, definition="weyl"),
    ),
    "a keyword that is none": (
        TypeError,
        "unexpected keyword argument 'thread'; did you mean threads=",
        lambda: search(thread=2),
    ),
    "a keyword of the structure": (
        TypeError,
        "argument 'delay'; it is an argument of structure=ftlm.equation(…, delay=…)",
        lambda: ftlm.identify(run(), "D y = a y + b u", delay={"u": 0.1}),
    ),
    "a keyword of two methods": (
        TypeError,
        "it is an argument of method=ftlm.MultiInnovation(…, norm=…) or ftlm.InstrumentalVariables(…, norm=…)",
        lambda: ftlm.identify(run(), "D y = a y + b u", norm="l1"),
    ),
    "a parameter of the equation as keyword": (
        TypeError,
        "alpha is in the equation: write its value there, or give it to ftlm.equation by orders= or fixed=",
        lambda: ftlm.identify(run(), ftlm.equation("D^alpha y = a y + b u"), alpha=1.5),
    ),
    "a keyword that belongs nowhere": (
        TypeError,
        "argument 'tau'; known: runs, structure, method, initial",
        lambda: ftlm.identify(run(), "D^alpha y = a y + b u", tau=1.5),
    ),
    # Runs
    "no run": (DATA, "no run is given", lambda: identify([])),
    "no run to compare": (DATA, "no run is given", lambda: model().compare([])),
    "something that is not a run": (DATA, "runs[0] is str, not a Run", lambda: identify(["psf.csv"])),
    "runs with different outputs": (
        DATA,
        "have different outputs: 'z' and 'y'",
        lambda: identify([run(), run(outputs={"z": Y})]),
    ),
    "runs with different inputs": (
        DATA,
        "have different inputs: 'v' and 'u'",
        lambda: identify([run(), run(inputs={"v": U})]),
    ),
    "runs with different units": (
        DATA,
        "have different units: signal 'y' is in 'm' and 'rad', 1 in all",
        lambda: identify([run(units={"y": "rad"}), run(units={"y": "mm"})]),
    ),
    "unknown signal": (
        DATA,
        "run 'run' has no signal 'v', which the model needs; it has u, y",
        lambda: identify(words="D y = a y + b v"),
    ),
    "unknown output": (
        DATA,
        "run 'run' has no signal 'z', which the model needs",
        lambda: identify(words="D z = a z + b u"),
    ),
    "output that is an input": (DATA, "output 'u' is not in run 'run'", lambda: identify(words="D u = a u + b y")),
    "constant output": (
        DATA,
        "output 'y' of run 'run': constant, every row is 2.0, first at row 0, 65 in all",
        lambda: identify(run(np.full(N, 2.0))),
    ),
    "NaN in a run": (DATA, "signal 'y': NaN, first at row 3, 2 in all", lambda: run(spoiled(3, 9))),
    "infinity in a run": (
        DATA,
        "signal 'y': infinity (-inf), first at row 5, 1 in all",
        lambda: run(spoiled(5, by=-math.inf)),
    ),
    "empty run": (DATA, "0 rows", lambda: run(Y[:0], U[:0])),
    # Arrays given to operators
    "NaN in an array": (
        DATA,
        "x is not finite at index 3 (2 such values in all)",
        lambda: ftlm.fractional_integral(spoiled(3, 9), 0.5, step=1),
    ),
    "NaN in a row": (
        DATA,
        "x is not finite at index [1, 4] (1 such values in all)",
        lambda: ftlm.fractional_derivative([Y, spoiled(4)], 0.5, step=1),
    ),
    "infinity before a transform": (
        DATA,
        "x is not finite at index 0 (1 such values in all)",
        lambda: ftlm.haar_transform(spoiled(0, by=math.inf)[:64]),
    ),
    "NaN in initial values": (
        DATA,
        "initial is not finite at index 1 (1 such values in all)",
        lambda: ftlm.fractional_derivative(Y, 1.5, step=1, definition="caputo", initial=[0.0, math.nan]),
    ),
    "NaN in a measurement": (
        DATA,
        "measured is not finite at index 7 (1 such values in all)",
        lambda: ftlm.metrics(spoiled(7), Y),
    ),
    "empty array": (DATA, "x has shape (0,) and no values", lambda: ftlm.fractional_integral([], 0.5, step=1)),
    "array of text": (DATA, "x has <U1 values; give real numbers", lambda: ftlm.haar_inverse(["a", "b"])),
    "array of objects": (DATA, "x has object values; give real numbers", lambda: ftlm.haar_inverse([None, 1.0])),
    "array of complex numbers": (DATA, "x has complex128 values", lambda: ftlm.haar_transform(Y[:64] * 1j)),
    "rows of different length": (DATA, "x is not an array", lambda: ftlm.haar_transform([[1.0, 2.0], [1.0]])),
    "single number": (DATA, "x has 0 dimensions and no axis -1", lambda: ftlm.haar_transform(1.0)),
    "axis that is not there": (DATA, "x has 1 dimensions and no axis 1", lambda: ftlm.haar_transform(Y, axis=1)),
    "too short to differentiate": (
        DATA,
        "x has length 3, but 4 is needed",
        lambda: ftlm.fractional_derivative([1.0, 2.0, 3.0], 1.5, step=1, definition="caputo"),
    ),
    "order of an operator above 10": (
        MODEL,
        "order = 10.5 is outside [0, 10]",
        lambda: ftlm.fractional_integral(Y, 10.5, step=1),
    ),
    "order of an operator below 0": (
        MODEL,
        "order = -0.5 is outside [0, 3]",
        lambda: ftlm.fractional_derivative(Y, -0.5, step=1),
    ),
    "order of an operator NaN": (
        MODEL,
        "order = NaN is outside [0, 10]",
        lambda: ftlm.block_pulse_matrix(math.nan, 4, step=1.0),
    ),
    "order of an operator in words": (
        MODEL,
        "order = 'half' is not a number",
        lambda: ftlm.fractional_integral(Y, "half", step=1),
    ),
    "step of 0": (MODEL, "step = 0 is outside (0, ∞)", lambda: ftlm.fractional_integral(Y, 0.5, step=0)),
    "step NaN": (MODEL, "step = NaN is outside (0, ∞)", lambda: ftlm.fractional_derivative(Y, 0.5, step=math.nan)),
    "step in words": (MODEL, "step = None is not a number", lambda: ftlm.fractional_derivative(Y, 0.5, step=None)),
    "step of a matrix": (MODEL, "step = 0 is outside", lambda: ftlm.block_pulse_matrix(0.5, 4, step=0)),
    "step infinite": (MODEL, "step = inf is outside", lambda: ftlm.operational_matrix(0.5, 4, step=math.inf)),
    "matrix of 0 pulses": (MODEL, "m = 0 is not a number of pulses", lambda: ftlm.haar_matrix(0)),
    "matrix of half a pulse": (
        MODEL,
        "m = 2.5 is not a number of pulses",
        lambda: ftlm.block_pulse_matrix(0.5, 2.5, step=1),
    ),
    "matrix beyond memory": (MODEL, "m = 32768 is outside [1, 16384]", lambda: ftlm.haar_matrix(1 << 15)),
    "matrix beyond all machines": (
        MODEL,
        "m = 1e+300 is not a number of pulses",
        lambda: ftlm.block_pulse_matrix(0.5, 1e300, step=1),
    ),
    "Haar matrix of three": (
        MODEL,
        "a power of two, not 3; take m = 2 or 4",
        lambda: ftlm.operational_matrix(0.5, 3, step=1.0),
    ),
    # Equations and models
    "infinite delay": (MODEL, "delay of u = inf s", lambda: ftlm.equation("D y = a y + b u", delay={"u": np.inf})),
    "delay of an output": (MODEL, "delayed input 'y'", lambda: ftlm.equation("D y = a y + b u", delay={"y": 0.1})),
    "delay of what a run has as an output": (
        MODEL,
        "delay of u = 0.1 s, but run 'run' has it as an output",
        lambda: model("D y = -y + u", delay={"u": 0.1}).compare(run(inputs={}, outputs={"y": Y, "u": Y**2})),
    ),
    "improper filter": (
        MODEL,
        "sensor filter: order 2 of its numerator is above 1",
        lambda: ftlm.SensorFilter(("y",), ((1.0, 2.0),), ((1.0, 1.0),)),
    ),
    "filter of nothing": (
        MODEL,
        "filtered signal 'z' does not occur",
        lambda: ftlm.equation("D y = a y", sensor_filter=ftlm.SensorFilter.low_pass(["z"])),
    ),
    "unknown initial terms": (
        MODEL,
        "initial = 'zero' is not known",
        lambda: ftlm.equation("D y = a y", initial="zero"),
    ),
    "unknown coefficient": (
        MODEL,
        "fixed coefficient 'c' does not occur in the equation",
        lambda: ftlm.equation("D y = a y", fixed={"c": 1}),
    ),
    "model with free coefficients": (MODEL, "still has free a; identify it first", lambda: model("D y = a y")),
    "model that is a structure": (
        MODEL,
        "model is Structure, not a Model",
        lambda: ftlm.simulate(ftlm.equation("D y = a y"), run()),
    ),
    "structure that is a number": (MODEL, "structure is int", lambda: ftlm.identify(run(), 3)),
    "number for a path": (DATA, "path is an int", lambda: ftlm.load(3)),
    "unknown argument": (TypeError, "known: step, time", lambda: ftlm.Run.from_arrays(following=3)),
    "tolerance of 0": (MODEL, "tolerance = 0 is not positive", lambda: model().simulate(run(), tolerance=0)),
    "unstable model": (
        CONVERGENCE,
        "the simulation of y overflows",
        lambda: model("D y = 90 y + u").simulate(run(step=1.0)),
    ),
    "dependent regressors": (
        CONVERGENCE,
        "regressor 2 of 3 is a linear combination of the others",
        lambda: ftlm.identify(
            run(), ftlm.equation("D^1.5 y = a y + b u + c D^0 u", initial="rest"), method="least-squares"
        ),
    ),
    "Euler of a fractional order": (
        MODEL,
        "equation 0 has orders that explicit Euler cannot step",
        lambda: ftlm.explicit_euler(model(), run()),
    ),
    "trace of free orders": (
        MODEL,
        "a convergence trace needs one equation whose orders are numbers",
        lambda: ftlm.multi_innovation_trace(run(), ftlm.equation(WORDS)),
    ),
    "unknown stage": (MODEL, "stage = 3 is not known", lambda: ftlm.flexible_link(form="published", stage=3)),
    "missing model file": (
        DATA,
        "model nowhere.json cannot be read: No such file or directory",
        lambda: ftlm.load_model("nowhere.json"),
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_a_typed_error_that_names_the_thing(case):
    kind, message, call = BAD[case]
    with pytest.raises(kind) as refused:
        call()
    assert message in str(refused.value)
    if kind is not TypeError:
        assert type(refused.value) is kind
        assert isinstance(refused.value, ftlm.FtlmError)
        # A person is told what is wrong and what to do, in one line, without machine talk.
        assert "\n" not in str(refused.value)
        assert "Traceback" not in str(refused.value)


def test_every_message_ends_with_a_way_out():
    # "what is wrong; what to do", or a hint in brackets, or a sentence that says both.
    without = []
    for case, (kind, _, call) in BAD.items():
        if kind is TypeError:
            continue
        with pytest.raises(kind) as refused:
            call()
        text = str(refused.value)
        if not any(mark in text for mark in ("; ", "take ", "use ", "give ")):
            without.append((case, text))
    assert without == []


def test_families():
    families = ("DataError", "ModelError", "ConvergenceError", "RigFault", "InternalError")
    for name in families:
        assert issubclass(getattr(ftlm, name), ftlm.FtlmError)
    # Where Python people expect a ValueError, it is one.
    assert issubclass(ftlm.DataError, ValueError)
    assert issubclass(ftlm.ModelError, ValueError)
    assert not issubclass(ftlm.ConvergenceError, ValueError)
    assert not issubclass(ftlm.InternalError, ValueError)


# ----------------------------------------------------------------------------------------------------------------------
# Numbers


@pytest.mark.parametrize(
    ("value", "whole"),
    [
        (3, 3),
        (0, 0),
        (-2, -2),
        (3.0, 3),
        (np.int8(5), 5),
        (np.float64(7), 7),
        (10**40, 10**40),
        (3.5, None),
        (True, None),
        ("3", None),
        (b"3", None),
        (None, None),
        (math.nan, None),
        (math.inf, None),
        ([3], None),
        (3 + 0j, None),
        (np.complex64(3), None),
        (np.bool_(True), None),
        (np.array(3), 3),
    ],
)
def test_whole_numbers(value, whole):
    assert whole_number(value) == whole
    assert type(whole_number(value)) in (int, type(None))


@pytest.mark.parametrize("value", [1, 1.5, np.float32(0.5), np.int64(3), math.inf, math.nan])
def test_real_numbers(value):
    assert real_number("x", value) == pytest.approx(float(value), nan_ok=True)
    assert type(real_number("x", value)) is float


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("1", "'1'"),
        (None, "None"),
        (True, "True"),
        (1j, "1j"),
        ([1], "[1]"),
        (10**400, "an integer of 1329 bits"),
        pytest.param(10**5000, "an integer of 16610 bits", id="beyond decimals"),
        ("x" * 200, "'" + "x" * 59 + "…"),
        (np.complex64(1), "np.complex64(1+0j)"),
        (np.array(1 + 2j), "array(1.+2.j)"),
        (np.bool_(True), "np.True_"),
    ],
)
def test_what_is_no_real_number_is_refused(value, words):
    with pytest.raises(ftlm.ModelError) as refused:
        real_number("the step", value)
    assert str(refused.value) == f"the step = {words} is not a number; give one"


def test_what_others_say_is_shown_whatever_it_is():
    class MuteError(Exception):
        def __repr__(self):
            raise ValueError

        __str__ = __repr__

    seen = [short_repr(v) for v in (1.5, -(10**5000), MuteError(), "\ud800")]
    assert seen == ["1.5", "an integer of 16610 bits", "a MuteError", r"'\ud800'"]
    assert short_repr("x" * 100, 10) == "'xxxxxxxxx…"
    said = [error_text(e, 10) for e in (ValueError("why"), MuteError(), ValueError("\ud800"), ValueError("x" * 10**6))]
    assert said == ["why", "its message cannot be read", r"\ud800", "x" * 10 + "…"]


# ----------------------------------------------------------------------------------------------------------------------
# The core, called with what no checked caller would pass


ODD = st.one_of(st.floats(allow_nan=True, allow_infinity=True), st.integers(-3, 40).map(float))


HOSTILE = {
    "order": ODD,
    "alpha": ODD,
    "step": ODD,
    "signal": st.integers(0, 4),
    "output": st.integers(0, 4),
    "values": st.lists(ODD, min_size=0, max_size=9),
    "coefficient": ODD,
    "exponents": st.lists(ODD, max_size=2),
}
CALLS = 18


def hostile_calls(order, alpha, step, signal, output, values, coefficient, exponents):
    means = np.array([values, values[::-1]], float).reshape(2, len(values))
    rec, inputs = (step, means, None), [False, True]
    structure = (output, alpha, [(signal, order), (1, 0.0)])
    calls = (
        lambda: _core.least_squares([rec], structure, inputs, [None, None], (False, exponents)),
        lambda: _core.multi_innovation([rec], structure, inputs, [None, coefficient], (True, []), 3, 1.0, True, True),
        lambda: _core.respond(rec, [(structure, [coefficient, 1.0])], inputs, [[(e, 1.0) for e in exponents]]),
        lambda: _core.respond_with_initial(rec, [(structure, [coefficient, 1.0])], inputs, (True, []), None),
        lambda: _core.equation_error(rec, (structure, [coefficient, 1.0]), inputs, (False, exponents)),
        lambda: _core.explicit_euler(means, step, [(structure, [coefficient, 1.0])], inputs),
        lambda: _core.trace_errors(rec, structure, inputs, np.array([[coefficient, 1.0]])),
        lambda: _core.search(
            [rec],
            (output, [alpha, order], [(signal, [order, alpha], True)]),
            inputs,
            [None],
            (False, exponents),
            {
                "criterion": "output-error",
                "norm": "l1",
                "innovation_length": 0,
                "prior_covariance": 1.0,
                "haar_rows": False,
                "top": 5,
                "threads": 1,
                "pruning": True,
                "iterations": 2,
                "memory": 1 << 31,
            },
            None,
        ),
        lambda: _core.OrderSearch(
            [rec],
            (output, [alpha, order], [(signal, [order, alpha], True)]),
            inputs,
            [None],
            (False, exponents),
            {
                "criterion": "equation-error",
                "norm": "l2",
                "innovation_length": 2,
                "prior_covariance": coefficient,
                "haar_rows": True,
                "top": 5,
                "threads": 1,
                "pruning": True,
                "iterations": 0,
                "memory": 1 << 31,
            },
        ).evaluate_batches(0, signal, [(output, coefficient)], None, 1, None, None),
        lambda: _core.filter_series([(coefficient, order)], [(1.0, alpha)], 8, step),
        lambda: _core.fractional_integral(means, order, step, "trapezoidal"),
        lambda: _core.fractional_derivative(means, order, step, "caputo", means),
        lambda: _core.pulse_mean_rows(means, 7, True),
        lambda: _core.delay_samples(means[0], order, coefficient),
        lambda: _core.series_divide(means[0], means[1]),
        lambda: _core.metrics(means[0], means[1]),
        lambda: _core.nyquist_margin([(coefficient, order)], step),
        lambda: _core.block_pulse_kernels(np.array([order]), 9, step, derivative=True),
    )
    for k, call in enumerate(calls):
        try:
            call()
        except ftlm.InternalError as error:
            pytest.fail(f"call {k}: {error}")
        except ftlm.FtlmError:
            pass


@settings(max_examples=150, deadline=None)
@given(**HOSTILE)
def test_the_core_answers_hostile_calls_with_typed_errors(**arguments):
    hostile_calls(**arguments)


@pytest.mark.slow
def test_a_hundred_thousand_hostile_calls():
    made = []

    @settings(max_examples=6_000, deadline=None, database=None)
    @given(**HOSTILE)
    def call(**arguments):
        hostile_calls(**arguments)
        made.append(CALLS)

    call()
    print(f"\n{sum(made)} calls")
    assert sum(made) >= 100_000


@pytest.mark.parametrize("where", ["call", "search", "worker"])
def test_a_panic_is_an_internal_error(where, capfd):
    with pytest.raises(ftlm.InternalError, match="internal fault: on purpose; please report it"):
        _core.panic_on_purpose(where)


def test_arrays_of_another_kind_are_a_type_error():
    for bad in (np.ones(4, np.float32), np.ones(4, int), [1.0, 2.0], np.ones((2, 2))):
        with pytest.raises(TypeError):
            _core.point_samples(bad)
