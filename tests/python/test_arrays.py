"""Arrays of callers: one door, where a masked sample is a missing sample, for every public function that takes one."""

import ast
import inspect
from pathlib import Path

import numpy as np
import pytest

import ftlm
import public
from ftlm import analysis, control, kernels, plot, rig
from ftlm.data.sampling import NonuniformSamples
from ftlm.sklearn import FractionalRegressor
from ftlm.svg.figure import Figure
from ftlm.utils.validation import MAX_SEQUENCE_LENGTH, as_array, as_complex, as_floats

N, STEP, FILL = 64, 0.05, 9999.0
T = np.arange(N) * STEP
U = np.sign(np.sin(3 * T)) + 0.1
W = np.geomspace(0.1, 10, N)
MODEL = ftlm.Model(ftlm.equation("D^2 y = -3 D y - 8 y + 5 u"))
HUB = ftlm.Model(ftlm.equation("D^2 theta = -63 D^0.95 theta + 140 I"))
RUN = ftlm.Run.from_arrays(step=STEP, inputs={"u": U}, outputs={"y": np.sin(T)})
OWN = ftlm.Run.from_arrays(time=T + 0.2 * STEP * np.sin(5 * T), inputs={"u": U}, outputs={"y": T}, resample=STEP)
NOISY = RUN.with_outputs({"y": MODEL.simulate(RUN)["y"] + 0.01 * np.cos(40 * T)})
FITTED = ftlm.identify(NOISY, ftlm.equation("D^2 y = a D y + b y + c u")).model
PID = control.FractionalPid(1.0, 2.0, 0.1, 0.7, 0.8)
DESIGN = control.fractional_pid(HUB, crossover=40.0)
LQG = control.lqg(
    HUB, input="I", measured=["theta"], noise={"theta": 3e-4}, max_deviation={"theta": 0.02}, max_input=1.0, rate=500.0
)
OBSERVER = LQG.controller.observer
MOVE = control.point_to_point(0.3, 0.5)
EQUATION = ftlm.equation("D^2 y = a1 D y + a0 y + b0 u")
TUPLES = kernels.Candidates(np.stack([np.sin(T), U]), [0, 1], step=STEP)
ORDER_TUPLES = np.array([[1.0, 0.0, 0.0], [1.5, 0.5, 0.0]])
DATA = ftlm.FrequencyData(W, analysis.frequency_response(MODEL, W)[0, 0])


def regressor():
    return FractionalRegressor("D^1 y = a y + b u", step=STEP, method="least-squares")


def stream(samples):
    made = rig.Streaming(ftlm.equation("D y = a y + b u"), step=STEP, inputs=["u"], max_duration=10.0)
    made.push(samples)
    return made.coefficients


def commanded(commands):
    with rig.Rig(rig.VirtualBoard(real_time=False)) as arm:
        arm.run(commands)


def run_of(values, **options):
    given = {"inputs": {"u": U}, "outputs": {"y": np.sin(T)}, "step": STEP}
    return ftlm.Run.from_arrays(**{**given, **{k: v(values) if callable(v) else v for k, v in options.items()}})


#: By function: what takes an array, and a sound one.
CALLS = {
    "ftlm.FrequencyData.from_arrays": [
        (lambda x: ftlm.FrequencyData.from_arrays(x, DATA.response), W),
        (lambda x: ftlm.FrequencyData.from_arrays(W, x), DATA.response),
        (lambda x: ftlm.FrequencyData.from_arrays(W, DATA.response, deviation=x), W),
    ],
    "ftlm.FrequencyData.__init__": [
        (lambda x: ftlm.FrequencyData(x, DATA.response), W),
        (lambda x: ftlm.FrequencyData(W, x), DATA.response),
        (lambda x: ftlm.FrequencyData(W, DATA.response, x), W),
    ],
    "ftlm.Circuit.impedance": [(ftlm.Circuit("R0-C1", {"R0": 1.0, "C1": 0.1}).impedance, W)],
    "ftlm.Model.frequency_response": [(MODEL.frequency_response, W)],
    "ftlm.Model.step_response": [(MODEL.step_response, T)],
    "ftlm.Model.step": [(MODEL.step, T)],
    "ftlm.Model.impulse": [(MODEL.impulse, T)],
    "ftlm.Model.bode": [(MODEL.bode, W)],
    "ftlm.Run.from_arrays": [
        (lambda x: run_of(x, inputs=lambda v: {"u": v}), U),
        (lambda x: run_of(x, outputs=lambda v: {"y": v}), U),
        (lambda x: run_of(x, outputs=lambda v: {"y": v}, missing="weight"), U),
        (lambda x: run_of(x, inputs=lambda v: {"u": v}, missing="hold"), U),
        (lambda x: run_of(x, time=lambda v: v, step=None), T),
        (lambda x: run_of(x, time=lambda v: v, step=None), np.datetime64("2024-01-01") + np.arange(N)),
    ],
    "ftlm.Run.from_frame": [
        (lambda x: ftlm.Run.from_frame({"u": U, "y": x}, step=STEP, inputs="u", outputs="y", missing="weight"), U),
    ],
    "ftlm.Run.with_samples": [
        (lambda x: RUN.with_samples({"u": x}), U),
        (lambda x: RUN.with_samples({"y": x}), U),
        (lambda x: OWN.with_samples({}, {"u": x}), U),
    ],
    "ftlm.Run.with_outputs": [(lambda x: RUN.with_outputs({"y": x}), U)],
    "ftlm.fractional_derivative": [
        (lambda x: ftlm.fractional_derivative(x, 0.5, step=STEP), U),
        (lambda x: ftlm.fractional_derivative(U, 1.5, step=STEP, definition="caputo", initial=x), np.zeros(2)),
    ],
    "ftlm.fractional_integral": [(lambda x: ftlm.fractional_integral(x, 0.5, step=STEP), U)],
    "ftlm.haar_inverse": [(ftlm.haar_inverse, U)],
    "ftlm.haar_transform": [(ftlm.haar_transform, U)],
    "ftlm.identify_frequency": [(lambda x: ftlm.identify_frequency(DATA, EQUATION, weights=x), W)],
    "ftlm.metrics": [(lambda x: ftlm.metrics(x, U), T), (lambda x: ftlm.metrics(T, x), U)],
    "analysis.Approximation.frequency_response": [(analysis.approximate(HUB, band=(1.0, 100.0)).frequency_response, W)],
    "analysis.frequency_response": [(lambda x: analysis.frequency_response(MODEL, x), W)],
    "analysis.response_deviation": [(lambda x: analysis.response_deviation(FITTED, x), W)],
    "analysis.step_response": [(lambda x: analysis.step_response(MODEL, x), T)],
    "control.DiscretePid.response": [(control.DiscretePid(PID, 500.0).response, W)],
    "control.FractionalPid.response": [(PID.response, W)],
    "control.JointControllers.__call__": [
        (lambda x: control.JointControllers(control.DiscretePid(PID, 500.0), None)(0.0, x, np.zeros(2)), np.ones(4)),
        (lambda x: control.JointControllers(control.DiscretePid(PID, 500.0), None)(0.0, np.zeros(4), x), np.ones(2)),
    ],
    "control.Lqg.__init__": [(lambda x: control.Lqg(OBSERVER, x, "theta").feedback, LQG.controller.feedback)],
    "control.Lqg.__call__": [(lambda x: LQG.controller(x, 0.1), np.ones(1))],
    "control.Lqg.response": [(LQG.controller.response, W)],
    "control.LqgDesign.controller_response": [(LQG.controller_response, W)],
    "control.Observer.equilibrium_state": [(OBSERVER.equilibrium_state, np.ones(1))],
    "control.PidDesign.controller_response": [(DESIGN.controller_response, W)],
    "control.Realization.response": [(OBSERVER.realization.response, W)],
    "control.Shaper.residual_vibration": [
        (lambda x: control.input_shaper(-2 + 17j).residual_vibration(x, 0.1), W),
        (lambda x: control.input_shaper(-2 + 17j).residual_vibration(17.0, x), W / 20),
    ],
    "control.Shaper.filter": [(lambda x: control.input_shaper(-2 + 17j).filter(x, 500.0), U)],
    "control.inverse_dynamics": [(lambda x: control.inverse_dynamics(DESIGN, x), MOVE)],
    "kernels.pulse_means": [(kernels.pulse_means, U)],
    "kernels.block_pulse_kernel": [(lambda x: kernels.block_pulse_kernel(x, 5, step=STEP), W / 10)],
    "kernels.integrate": [
        (lambda x: kernels.integrate(x, 0.5, step=STEP), U),
        (lambda x: kernels.integrate(U, x, step=STEP), W / 10),
    ],
    "kernels.toeplitz_apply": [
        (lambda x: kernels.toeplitz_apply(x, U), T + 1),
        (lambda x: kernels.toeplitz_apply(U, x), T),
    ],
    "kernels.toeplitz_solve": [
        (lambda x: kernels.toeplitz_solve(x, U), T + 1),
        (lambda x: kernels.toeplitz_solve(U, x), T),
    ],
    "kernels.multi_innovation": [
        (lambda x: kernels.multi_innovation(x, T, prior_covariance=1e6), np.stack([U, T], axis=1)),
        (lambda x: kernels.multi_innovation(np.stack([U, T], axis=1), x, prior_covariance=1e6), T),
        (lambda x: kernels.multi_innovation(np.stack([U, T], axis=1), T, prior_covariance=x), np.array([1.0, 2.0])),
    ],
    "kernels.Recursion.push": [
        (
            lambda x: kernels.Recursion([1.0, 0.0, 0.0], [0, 1], step=STEP, hold=[False, True]).push(x),
            np.stack([U, T], axis=1),
        )
    ],
    "kernels.Candidates.coefficients": [
        (TUPLES.coefficients, ORDER_TUPLES),
        (
            lambda x: TUPLES.coefficients(ORDER_TUPLES, p=3, prior_covariance=x, rows="time"),
            np.array([1.0, 2.0]),
        ),
    ],
    "kernels.Candidates.score": [
        (TUPLES.score, ORDER_TUPLES),
        (lambda x: TUPLES.score(ORDER_TUPLES, x), np.array([[-1.0, 2.0], [-2.0, 1.0]])),
    ],
    "kernels.Candidates.free_run": [
        (lambda x: TUPLES.free_run(x, np.array([[-1.0, 2.0], [-2.0, 1.0]])), ORDER_TUPLES),
        (lambda x: TUPLES.free_run(ORDER_TUPLES, x), np.array([[-1.0, 2.0], [-2.0, 1.0]])),
    ],
    "kernels.errors": [(lambda x: kernels.errors(x, U), T), (lambda x: kernels.errors(T, x), U)],
    "plot.bode": [(lambda x: plot.bode(MODEL, x), W)],
    "plot.impulse": [(lambda x: plot.impulse(MODEL, x), T)],
    "plot.step": [(lambda x: plot.step(MODEL, x), T)],
    "plot.BarChart.__init__": [
        (lambda x: plot.BarChart([str(k) for k in range(N)], [("a", x)], title="", x_label="y"), T)
    ],
    "plot.svg_bode_charts": [(lambda x: plot.svg_bode_charts(MODEL, x), W)],
    "plot.CorrelationMap.__init__": [(lambda x: plot.CorrelationMap(["a", "b"], x, title=""), np.eye(2))],
    "plot.svg_histogram": [(lambda x: plot.svg_histogram(x, title="", x_label="x"), U)],
    "plot.LineChart.__init__": [
        (lambda x: plot.LineChart(x, [("y", U)], title="", x_label="x", y_label="y"), T),
        (lambda x: plot.LineChart(T, [("y", x)], title="", x_label="x", y_label="y"), U),
        (lambda x: plot.LineChart(T, [("y", U)], title="", x_label="x", y_label="y", bands=[(x, U)]), U),
    ],
    "plot.PlaneChart.__init__": [(lambda x: plot.PlaneChart(x, title="", x_label="x", y_label="y"), -1 + 1j * W)],
    "rig.Rig.run": [(commanded, np.zeros((5, 2)))],
    "rig.Streaming.push": [(stream, np.stack([U, T], axis=1))],
    "rig.control": [(lambda x: rig.control(lambda *_: (0.1, 0.0), x), np.zeros((50, 2)))],
    "sklearn.FractionalRegressor.fit": [
        (lambda x: regressor().fit(x, np.sin(T)).model_.coefficients, U[:, None]),
        (lambda x: regressor().fit(U[:, None], x).model_.coefficients, np.sin(T)),
    ],
    "sklearn.FractionalRegressor.predict": [(regressor().fit(U[:, None], np.sin(T)).predict, U[:, None])],
}
#: Functions with an array that no caller makes, and why.
EXEMPT = {
    "rig.Board.run": "an interface, which Rig.run calls",
    "rig.VirtualBoard.run": "called by Rig.run, which checks the commands",
}
SIDES = [(name, k) for name, calls in CALLS.items() for k in range(len(calls))]


def made_by_callers(name, function):
    """Whether an annotation of a function says that it takes an array; objects that ftlm returns are made by it."""
    parameters = inspect.signature(function).parameters.values()
    annotations = " ".join(str(p.annotation) for p in parameters if p.name != "ax")
    constructs = name.endswith("__init__") and name not in CALLS
    return not constructs and any(word in annotations for word in ("ArrayLike", "Floats", "Complex"))


def test_the_table_has_every_public_function_that_takes_an_array():
    known = public.functions()
    taking = {name for name, function in known.items() if made_by_callers(name, function)}
    assert taking - set(EXEMPT) <= set(CALLS)
    assert set(CALLS) | set(EXEMPT) <= set(known)


def answer(call, values):
    """What a call returns, as numbers or text, or the type of its error."""
    try:
        found = call(values)
    except ValueError as error:
        return type(error).__name__
    if isinstance(found, Figure):
        return [found.svg, found.narrow, found.note]
    if isinstance(found, ftlm.Run):
        readings = found.nonuniform_samples.data if isinstance(found.nonuniform_samples, NonuniformSamples) else {}
        return [[found[n] for n in found.signals], [readings[n] for n in readings]]
    return found


def equal(one, other):
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(equal, one, other))
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other, equal_nan=one.dtype.kind in "fc")
    return type(one) is type(other) and str(one) == str(other)


@pytest.mark.parametrize(("name", "side"), SIDES)
def test_a_masked_sample_is_a_missing_one(name, side):
    call, sound = CALLS[name][side]
    answer(call, sound)
    assert not isinstance(answer(call, np.ma.masked_array(sound)), str), "an array without masked samples"
    mask = np.zeros(sound.shape, dtype=bool)
    mask.flat[sound.size // 2] = True
    dates = sound.dtype.kind == "M"
    missing = np.where(mask, np.datetime64("NaT") if dates else np.nan, sound)
    masked = np.ma.masked_array(np.where(mask, sound[0] if dates else FILL, sound), mask=mask)
    for values in (masked, list(masked)) if sound.ndim == 1 and not dates else (masked,):
        got = answer(call, values)
        # What computes on with NaN may refuse a masked sample.
        assert got == "DataError" if isinstance(got, str) else equal(got, answer(call, missing))


def test_arrays_are_read_as_they_are():
    x = np.arange(6.0).reshape(2, 3)
    assert as_floats("x", x) is x
    assert as_floats("x", np.ma.masked_array(x, mask=x == 2), gaps=True)[0, 1:].tolist()[0] == 1.0
    assert np.isnan(as_floats("x", [np.ma.masked, 1.0], gaps=True)).tolist() == [True, False]
    assert as_complex("x", [1, 2j]).tolist() == [1, 2j]
    with pytest.raises(ftlm.DataError, match=r"x: masked \(missing\) value, first at row 1, 2 in all; remove or fill"):
        as_array("x", [np.ma.masked_array([1, 2]), np.ma.masked_array([1, 2], mask=True)])


def test_sequences_that_cannot_be_read_are_refused():
    deep, double = [], []
    deep.append(deep)
    double += [double, double]
    for values, words in (
        (range(MAX_SEQUENCE_LENGTH + 1), f"more than {MAX_SEQUENCE_LENGTH} values"),
        (range(10**30), "values"),
        (deep, "more than 16 dimensions"),
        (double, "more than 16 dimensions"),
        ([[1.0, 2.0], [3.0]], "give rows of equal length"),
        (np.broadcast_to(1.0, 1 << 50), "does not fit into memory"),
    ):
        with pytest.raises(ftlm.DataError, match=f"x .*{words}"):
            as_array("x", values)


def test_arrays_of_callers_pass_one_door():
    """No function makes an array of an argument that may be anything, as `ArrayLike` or `object` says."""
    package, found = Path(ftlm.__file__).parent, []
    for path in sorted(package.rglob("*.py")):
        if path.name == "validation.py" and path.parent.name == "utils":
            continue
        for function in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(function, ast.FunctionDef):
                continue
            arguments = [*function.args.args, *function.args.kwonlyargs]
            loose = {a.arg for a in arguments if a.annotation and "ArrayLike" in ast.unparse(a.annotation)}
            found += [
                f"{path.relative_to(package)}:{call.lineno}"
                for call in ast.walk(function)
                if isinstance(call, ast.Call)
                and ast.unparse(call.func) in {"np.asarray", "np.array", "np.ascontiguousarray", "np.atleast_1d"}
                and any(isinstance(a, ast.Name) and a.id in loose for a in call.args[:1])
            ]
    assert found == []
