"""Recordings of the core: runs sampled on any grid, against their sampling by definition in NumPy."""

import numpy as np
import pytest

import ftlm
import sampling_oracle as oracle
from ftlm import _core
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import sample_run
from ftlm.simulation.discretization import recording

ROWS, STEP = 81, 0.05
LOW_PASS = ftlm.SensorFilter.low_pass
TWO = "D^1.8 y = a y + b u + c D^0.5 z; D^1.2 z = d z + e y + f v"
ONE = "D^1.6 y = a y + b u + c v"


def signals(times):
    """Two outputs in motion, a held and a linear input."""
    rng = np.random.default_rng(3)
    steps = np.repeat(rng.standard_normal(times.size), 7)[: times.size]
    outputs = {"y": 0.7 + np.sin(2 * times), "z": np.cos(3 * times) - 0.2 * times}
    noise = {n: 0.01 * rng.standard_normal(times.size) for n in outputs}
    return {"u": steps, "v": np.sin(5 * times + 1)}, {n: v + noise[n] for n, v in outputs.items()}


def make_run(*, gaps=False, own=False):
    rng = np.random.default_rng(9)
    times = np.arange(ROWS) * STEP
    if own:
        times = np.append(0.0, times[1:] + 0.3 * STEP * rng.uniform(-1, 1, ROWS - 1))
    inputs, outputs = signals(times)
    if gaps:
        outputs["y"][[5, 6, 40]] = np.nan
    return ftlm.Run.from_arrays(
        inputs=inputs,
        outputs=outputs,
        intersample={"u": "zoh", "v": "foh"},
        missing="weight" if gaps else "refuse",
        **({"time": times, "resample": STEP} if own else {"step": STEP}),
    )


CASES = {
    "one equation": (ONE, {}),
    "two that drive each other": (TWO, {"coupling": "simulated"}),
    "two driven by measurements": (TWO, {"coupling": "measured"}),
    "delays": (ONE, {"delay": {"u": 0.12, "v": 0.07}}),
    "whole delays": (ONE, {"delay": {"u": 0.15, "v": 0.0}}),
    "limits": (ONE, {"saturation": {"u": 0.8}, "dead_zone": {"u": 0.1, "v": 0.3}}),
    "a filtered output": (ONE, {"sensor_filter": LOW_PASS(("y",), 3.0)}),
    "a filtered output, simulated": (TWO, {"coupling": "simulated", "sensor_filter": LOW_PASS(("y",), 3.0)}),
    "a filtered input": (ONE, {"sensor_filter": LOW_PASS(("v",), 3.0)}),
    "both": (ONE, {"sensor_filter": LOW_PASS(("y", "v"), 3.0), "saturation": {"v": 0.9}}),
    "filtered, measured coupling": (TWO, {"coupling": "measured", "sensor_filter": LOW_PASS(("z",), 3.0)}),
    "a term above the order": ("D^1.1 y = a y + b u + c D^1.5 v", {}),
}
#: What drives an equation as measured, or passes the filter before it is compared, must have been read.
REFUSING_GAPS = (
    "two driven by measurements",
    "a filtered output",
    "a filtered input",
    "both",
    "filtered, measured coupling",
)
FILTERED = [name for name, (_, more) in CASES.items() if "sensor_filter" in more]


def structure_of(name, initial="rest"):
    words, more = CASES[name]
    return ftlm.equation(words, initial=initial, **more)


def check(found, expected, exact):
    if expected is None or exact:
        np.testing.assert_array_equal(found, expected)
    else:
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * max(np.abs(expected).max(initial=0.0), 1.0))


@pytest.mark.parametrize("filtered", [True, False])
@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("initial", ["rest", "caputo"])
@pytest.mark.parametrize("name", CASES)
def test_pulse_means_are_those_of_the_definition(name, initial, own, filtered):
    """The same bits, but behind a filter that a run in motion left in some state, which is a least-squares fit."""
    run, structure = make_run(own=own), structure_of(name, initial)
    exact = name not in FILTERED or initial == "rest"
    for m in (ROWS - 1, 4 * (ROWS - 1), 31):
        step, means, series, begun = recording(run, structure).pulses(m, filtered)
        expected = oracle.pulses(run, structure, m, filtered)
        assert step == expected[0]
        check(means, expected[1], exact)
        assert (series is None) == (expected[2] is None)
        if series is not None:
            check(series, expected[2], exact=True)
        assert begun[:2] == (expected[3][0], expected[3][1])
        assert (begun[2] is None) == (expected[3][2] is None)
        if begun[2] is not None:
            check(begun[2], expected[3][2], exact=False)


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("initial", ["rest", "caputo"])
@pytest.mark.parametrize("name", CASES)
def test_a_fit_compares_the_samples_of_the_definition(name, initial, gaps, own):
    """The residuals of a point have the same bits, whoever sampled the run."""
    run, structure = make_run(gaps=gaps, own=own), structure_of(name, initial)
    if gaps and name in REFUSING_GAPS:
        with pytest.raises(ftlm.DataError, match=r"has no value|missing samples"):
            recording(run, structure)
        return
    problem = FreeProblem.of(structure)
    weights = [1.0] * len(structure.outputs)
    start = ([0.5 - 0.3 * k for k in range(len(problem.names))], [])
    for every, decimation in ((1, 1), (4, 1), (2, 3)):
        found, expected = (
            problem.core.minimize([given], start, True, [], 1, 1e-9, False)
            for given in (
                sample_run(run, problem, weights, pulses_per_sample=every, decimation=decimation),
                oracle.experiment(run, structure, every=every, decimation=decimation),
            )
        )
        check(found["residuals"], expected["residuals"], exact=name not in FILTERED or initial == "rest")


@pytest.mark.parametrize("law", ["delay", "saturation", "dead_zone"])
def test_what_is_free_of_an_input_is_left_to_the_fit(law):
    run = make_run()
    structure = ftlm.equation(ONE, initial="rest", **{law: {"u": (0.05, 0.4)}})
    plain = structure.without_free_input_parameters()
    means = recording(run, structure).pulses(160, False)[1]
    np.testing.assert_array_equal(means, recording(run, plain).pulses(160, False)[1])


def test_signs_of_measured_rates_are_held():
    run = make_run()
    words = ftlm.equation("D^2 y = a D y + b coulomb_y + c u", initial="rest")
    _, means, *_ = recording(run, words).pulses(2 * (ROWS - 1), False)
    expected = oracle.pulses(run, words, 2 * (ROWS - 1), False)[1]
    np.testing.assert_array_equal(means, expected)


def test_gaps_of_a_coupled_output_do_not_stop_a_fit():
    """Where a fit starts, the gaps are interpolated; what is compared leaves them out."""
    rng, rows = np.random.default_rng(0), 400
    u = np.repeat(rng.choice([-1.0, 1.0], rows // 10), 10)
    words = ftlm.equation("D^2 x = -4 x - 0.5 D x + 2 y + u; D y = -1.5 y + x", coupling="simulated")
    still = {"x": np.zeros(rows), "y": np.zeros(rows)}
    made = ftlm.Model(words).simulate(ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs=still))
    outputs = {n: made[n] + 0.01 * rng.standard_normal(rows) for n in ("x", "y")}
    outputs["x"][50:60] = np.nan
    run = ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs=outputs, missing="weight")
    free = ftlm.equation("D^2 x = a x + d D x + e y + b u; D y = g y + h x", initial="rest", coupling="simulated")
    found = ftlm.identify(run, free)
    for name, value in {"a": -4.0, "d": -0.5, "e": 2.0, "b": 1.0, "g": -1.5, "h": 1.0}.items():
        assert abs(found.coefficients[name] - value) < 5 * found.standard_errors[name], name


@pytest.mark.parametrize("kind", ["zoh", "foh"])
def test_values_and_jumps_are_those_of_the_definition(kind):
    run = make_run(own=True).with_intersample({"u": kind})
    structure = structure_of("delays", "caputo")
    found, times = recording(run, structure), np.sort(np.random.default_rng(2).uniform(0, 4, 50))
    for k, name in enumerate(structure.signals):
        line = oracle.Line.of(run, structure, name, float(run.nonuniform_samples.data[name][0]))
        np.testing.assert_array_equal(found.values_at(k, times), line.at(times))
        jumps = found.jumps(k)
        if line.is_zero_order_hold:
            np.testing.assert_array_equal(jumps, line.jumps())
        else:
            assert jumps is None


def recording_arguments():
    """What a recording is made of."""
    channel = {"samples": np.arange(5.0), "nonuniform": None, "delay": None, "limits": [], "filtered": False}
    return {
        "name": "run",
        "step": 0.1,
        "times": None,
        "signals": [
            {**channel, "name": "y", "role": "output", "enters_others": False},
            {**channel, "name": "u", "role": "zoh", "enters_others": True},
        ],
        "outputs": [0],
        "filter": None,
        "filter_states": 0,
        "at_rest": True,
        "coupled": True,
        "friction": False,
        "free": [],
    }


def test_the_core_refuses_runs_that_are_none():
    assert _core.Recording(recording_arguments()).pulses(4, False)[1].shape == (2, 4)
    shorter, unknown, late, holes = (recording_arguments() for _ in range(4))
    shorter["signals"][1]["samples"] = np.arange(4.0)
    unknown["signals"][1]["role"] = "spline"
    late["signals"][1]["delay"] = np.inf
    holes["signals"][1]["samples"] = np.array([0.0, np.nan, 1.0, 2.0, 3.0])
    refused = [
        ({**recording_arguments(), "step": 0.0}, ftlm.ModelError, "step = 0"),
        ({**recording_arguments(), "outputs": [2]}, ftlm.ModelError, "output 2 of 2 signals"),
        ({**recording_arguments(), "times": np.arange(5.0)}, ftlm.DataError, "samples at nonuniform times"),
        ({**recording_arguments(), "signals": []}, ftlm.DataError, "length 0"),
        (shorter, ftlm.DataError, "signal u has length 4"),
        (unknown, ftlm.ModelError, "role 'spline'"),
        (late, ftlm.DataError, "delay of u is not finite"),
        (holes, ftlm.DataError, "signal u is not finite at index 1"),
    ]
    for given, kind, words in refused:
        with pytest.raises(kind, match=words):
            _core.Recording(given)
    run = _core.Recording(recording_arguments())
    for m in (0, 1 << 40):
        with pytest.raises(ftlm.ModelError, match="m = "):
            run.pulses(m, False)
    for every, decimation in ((0, 1), (1, 0), (1 << 40, 1), (1, 1 << 40)):
        with pytest.raises(ftlm.ModelError, match=r"pulses per sampling interval|decimation factor"):
            run.experiment(every, decimation, [1.0])
    with pytest.raises(ftlm.DataError, match="window: 1 rows remain"):
        run.experiment(1, 5, [1.0])
    with pytest.raises(ftlm.DataError, match="length 2"):
        run.experiment(1, 1, [1.0, 1.0])
    with pytest.raises(ftlm.ModelError, match="signal 2 of 2"):
        run.jumps(2)


def test_a_fit_refuses_runs_of_another_structure():
    problem = FreeProblem.of(structure_of("one equation"))
    with pytest.raises(ftlm.DataError, match="signals of a run has length 2, but 3"):
        _core.joint_multistart(problem.core, [_core.Recording(recording_arguments())], (1, 1 << 30))
