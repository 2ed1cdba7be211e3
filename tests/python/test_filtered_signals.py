"""A sensor filter belongs to signals: filtered or not, input or output, against a state-space model by SciPy."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lsim

import friction
import ftlm
from ftlm.cli.options import StructureOptions
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Iterate, Objective
from ftlm.estimation.output_error import fit_output_error
from ftlm.simulation.discretization import recording
from ftlm.utils.validation import Floats
from ftlm.validation.comparison import compare_means
from slow_cases import slow_after

pytestmark = pytest.mark.usefixtures("no_extension_tests")

STEP, COUNT, FINE = 1e-3, 6001, 4
OMEGA, ZETA = 2 * np.pi * 1.0, 0.9
TRUTH = {"a": -9.0, "d": -1.5, "b": 4.0, "p": 2.5}
#: One equation: an output, what drives it unfiltered, and a signal that may have passed the filter.
WORDS = "D^2 y = a y + d D y + b u + p v"
#: Two that follow together; each sees the other.
TOGETHER = "D^2 y = a y + d D y + b u + p z; D^2 z = e z + f D z + g v + h y"
SECOND = {"e": -16.0, "f": -2.0, "g": 7.0, "h": 3.0}
SUBSETS = [c for n in range(3) for c in itertools.combinations(("y", "v"), n)]

TOGETHER_SLOWLY = [*(c for c in SUBSETS if c != ("v",)), ("z",), ("y", "z"), ("z", "v"), ("y", "z", "v")]


def drive(phase: float) -> Floats:
    """A smooth signal that starts from rest with three derivatives."""
    t = np.arange((COUNT - 1) * FINE + 1) * STEP / FINE
    waves = sum(np.sin(w * t + phase * w) / w for w in (0.7, 1.9, 3.1))
    return np.asarray(waves * (1.0 - np.exp(-((t / 0.7) ** 4))))


def measured(filtered: tuple[str, ...], *, together: bool = False, inertial: bool = False) -> dict[str, Floats]:
    """All signals as they are measured: dense states, exact for inputs that are linear on a grid four times finer."""
    u, v = drive(0.3), drive(1.7)
    t = np.arange(u.size) * STEP / FINE
    c = TRUTH | SECOND
    if together:
        a = [[0, 1, 0, 0], [c["a"], c["d"], c["p"], 0], [0, 0, 0, 1], [c["h"], 0, c["e"], c["f"]]]
        b = [[0, 0], [c["b"], 0], [0, 0], [0, c["g"]]]
    elif inertial:
        # y = x + p v leaves x'' = a x + d x' + b u + a p v + d p v', of which v' is integrated by parts.
        a, through = [[0, 1], [c["a"], c["d"]]], c["d"] * c["p"]
        b = [[0, through], [c["b"], c["a"] * c["p"] + c["d"] * through]]
    else:
        a, b = [[0, 1], [c["a"], c["d"]]], [[0, 0], [c["b"], c["p"]]]
    states = lsim((a, b, np.eye(len(a)), np.zeros((len(a), 2))), np.stack([u, v], 1), t, interp=True)[1]
    signals = {"u": u, "v": v, "y": states[:, 0] + (c["p"] * v if inertial else 0.0)} | (
        {"z": states[:, 2]} if together else {}
    )
    low = ([OMEGA**2], [1.0, 2 * ZETA * OMEGA, OMEGA**2])
    for name in filtered:
        signals[name] = lsim(low, signals[name], t)[1]
    return {n: x[::FINE] for n, x in signals.items()}


def run_of(signals: dict[str, Floats], inputs: tuple[str, ...] = ("u", "v"), *, step: float = STEP) -> ftlm.Run:
    return ftlm.Run.from_arrays(
        step=step,
        inputs={n: signals[n] for n in inputs},
        outputs={n: x for n, x in signals.items() if n not in inputs},
        intersample=dict.fromkeys(inputs, "foh"),
    )


def sensor(filtered: tuple[str, ...]) -> ftlm.SensorFilter | None:
    return ftlm.SensorFilter.low_pass(filtered, frequency=1.0) if filtered else None


@slow_after(1, "filtered", SUBSETS[:0:-1], ids="+".join)
@pytest.mark.parametrize(
    ("method", "m"),
    [(ftlm.OutputError(intervals="quadratic"), None), ("least-squares", COUNT - 1)],
    ids=["output-error", "least-squares"],
)
def test_one_equation_with_a_filtered_input_or_output(filtered, method, m):
    run = run_of(measured(filtered))
    words = ftlm.equation(WORDS, sensor_filter=sensor(filtered), initial="rest")
    found = ftlm.identify(run, words, method=method, m=m)
    for name, value in TRUTH.items():
        assert found.coefficients[name] == pytest.approx(value, rel=1e-6), name
    assert found.model.compare(run).fit["y"] > 99.9999
    if m is not None:
        wrong = ftlm.identify(run, ftlm.equation(WORDS, initial="rest"), method="least-squares")
        assert max(abs(wrong.coefficients[n] / v - 1) for n, v in TRUTH.items()) > 0.05


@pytest.mark.parametrize(
    "filtered",
    [("v",), *(pytest.param(c, marks=pytest.mark.slow) for c in TOGETHER_SLOWLY)],
    ids="+".join,
)
def test_equations_that_follow_together_behind_filters(filtered):
    run = run_of(measured(filtered, together=True))
    structure = ftlm.equation(TOGETHER, sensor_filter=sensor(filtered), initial="rest")
    structure = replace(structure, coupling="simulated")
    found = ftlm.identify(run, structure, method=ftlm.OutputError(intervals="quadratic"))
    for name, value in (TRUTH | SECOND).items():
        assert found.coefficients[name] == pytest.approx(value, rel=1e-6), name
    assert min(found.model.compare(run).fit.values()) > 99.9999
    simulated, truth = found.model.simulate(run, tolerance=1e-5), measured(filtered, together=True)
    # What a filtered signal drives comes filtered; the machine's own motion comes as it is measured.
    known = measured(("y", "z", "v"), together=True) if "v" in filtered else truth
    for name in ("y", "z"):
        np.testing.assert_allclose(simulated[name], known[name], atol=2e-6 * np.abs(known[name]).max())


@pytest.mark.parametrize("filtered", [("y",), pytest.param(("v",), marks=pytest.mark.slow)], ids="+".join)
def test_a_run_in_motion_starts_with_a_filter_in_motion(filtered):
    # What the filter holds of the time before the run is two free motions of it: an acceleration lets them through.
    run = run_of(measured(filtered, inertial=True)).window(1.7, None)
    words = ftlm.equation(WORDS.replace("p v", "p D^2 v"), sensor_filter=sensor(filtered))
    found = ftlm.identify(run, words, method=ftlm.OutputError(intervals="quadratic"))
    for name, value in TRUTH.items():
        assert found.coefficients[name] == pytest.approx(value, rel=1e-4), name
    compared = found.model.compare(run)
    assert compared.fit["y"] > 99.999
    started = compared.initial[0]["y"]
    assert sorted(started) == [-2.0, -1.0, 0.0, 1.0]
    again = found.model.simulate(run, initial=compared.initial[0], tolerance=1e-4)
    np.testing.assert_allclose(again["y"], compared.simulated["y"][0], atol=2e-4 * np.abs(again["y"]).max())
    assert "filter's state 1" in found.details()
    # Exponents that are given are all there is.
    given = ftlm.Model(replace(found.model.structure, initial=(0.0, 1.0))).compare(run).fit["y"]
    assert given < 99.0


#: A fractional equation whose input is differentiated more often than its output.
ABOVE = "D^1.5 y = a y + d D y + b u + p D^2 v"
ABOVE_TRUTH = {"a": -9.0, "d": -1.5, "b": 4.0, "p": 0.5}


def above_run(filtered: tuple[str, ...], begin: float, every: int) -> ftlm.Run:
    """Signals of a stable plant by Fourier's integral, from rest to rest, cut in the middle of the motion."""
    count = 1 << 18
    t = np.arange(count) * STEP

    def smooth(seed):
        rng = np.random.default_rng(seed)
        waves = sum(np.sin(w * t + rng.uniform(0.0, 6.3)) for w in np.geomspace(0.6, 14.0, 14))
        return waves * (1.0 - np.exp(-((t / 0.7) ** 4))) * np.exp(-((np.maximum(t - 8.0, 0.0) / 0.7) ** 4))

    s = 2j * np.pi * np.fft.rfftfreq(count, STEP)
    u, v = (np.fft.rfft(smooth(seed)) for seed in (3, 17))
    c = ABOVE_TRUTH
    y = (c["b"] * u + c["p"] * s**2 * v) / (s**1.5 - c["d"] * s - c["a"])
    low = OMEGA**2 / (s**2 + 2 * ZETA * OMEGA * s + OMEGA**2)
    first, last = round(begin / STEP), round((begin + 5.0) / STEP)
    return run_of(
        {
            n: np.fft.irfft(x * (low if n in filtered else 1.0), count)[first : last + 1 : every]
            for n, x in (("u", u), ("v", v), ("y", y))
        },
        step=STEP * every,
    )


@slow_after(1, "filtered", SUBSETS[::-1], ids="+".join)
def test_a_derivative_above_its_equations_order_takes_none_of_the_beginning(filtered):
    # Signals begin at a level, and what came through a filter with the motion of what that held: neither is a jump.
    run = above_run(filtered, 1.7, 4)
    found = ftlm.identify(
        run, ftlm.equation(ABOVE, sensor_filter=sensor(filtered)), method=ftlm.OutputError(intervals="quadratic")
    )
    for name, value in ABOVE_TRUTH.items():
        assert found.coefficients[name] == pytest.approx(value, rel=0.01), name
    compared = found.model.compare(run)
    assert compared.fit["y"] > 99.8
    if "v" not in filtered:
        # At the first samples as everywhere.
        missed = np.abs(compared.simulated["y"][0] - run["y"])
        assert missed[:5].max() < 2e-3 * np.std(run["y"])


def acting(run, words, name):
    """Samples of a signal without the transient of its filter."""
    return recording(run, words).acting_samples(words.signals.index(name))


def impulse_responses(sensor_filter, m, step):
    """Pulse means of a filter's responses to an impulse and its derivatives, in a run in motion; None without any."""
    words = ftlm.equation("D^1.5 y = a y + p D^2 v", sensor_filter=sensor_filter, initial="caputo")
    run = ftlm.Run.from_arrays(step=step, inputs={}, outputs={"v": np.ones(m + 1), "y": np.ones(m + 1)})
    return recording(run, words).pulses(m, True)[3][2]


def test_what_a_filter_held_is_told_from_what_came_in():
    sensor_filter = ftlm.SensorFilter.low_pass(("v",), frequency=1.0)
    words = ftlm.equation("D^1.5 y = a y + p D^2 v", sensor_filter=sensor_filter, initial="caputo")
    t = np.arange(400) * 0.004
    system = ([[0.0, 1.0], [-(OMEGA**2), -2 * ZETA * OMEGA]], [[0.0], [OMEGA**2]], [[1.0, 0.0]], [[0.0]])
    came, moved = 0.3 - 0.8 * t, lsim(system, np.zeros(t.size), t, X0=[0.4, -1.7])[1]
    answer = lsim(system, came, t)[1]
    run = ftlm.Run.from_arrays(step=0.004, inputs={}, outputs={"v": answer + moved, "y": np.cos(t)})
    np.testing.assert_allclose(acting(run, words, "v"), answer, atol=1e-9)
    np.testing.assert_array_equal(acting(run, words, "y"), run["y"])
    # From rest it held nothing.
    rest = replace(words, initial="rest")
    np.testing.assert_array_equal(acting(run, rest, "v"), run["v"])
    # Noise leaves the first sample where it is, and little of the rest.
    noise = 1e-3 * np.random.default_rng(5).normal(size=t.size)
    noisy = ftlm.Run.from_arrays(step=0.004, inputs={}, outputs={"v": answer + moved + noise, "y": np.cos(t)})
    left = acting(noisy, words, "v")
    assert left[0] == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(left - answer - noise, 0.0, atol=5e-3)


@pytest.mark.parametrize("frequency", [1e-9, 1e-3, 1e2, 1e4, 1e8, 1e40, 1e120])
def test_filters_of_any_speed_leave_numbers(frequency):
    t = np.arange(300) * 0.01
    low_pass = ftlm.SensorFilter.low_pass(("v",), frequency=frequency)
    words = ftlm.equation("D^1.5 y = a y + p D^2 v", sensor_filter=low_pass, initial="caputo")
    run = ftlm.Run.from_arrays(step=0.01, inputs={}, outputs={"v": np.cos(t) + 2.0, "y": np.sin(t)})
    left, found = acting(run, words, "v"), impulse_responses(low_pass, 100, 0.01)
    assert np.abs(left).max() < 3.1
    if frequency > 1e5:
        # What it held is gone before the second sample.
        np.testing.assert_array_equal(left, run["v"])
        assert found is None
    else:
        # All of an impulse comes out in the end, and no more.
        assert found is not None
        assert np.sum(found[0]) * 0.01 <= 1.2
        assert np.abs(found[0]).max() <= 101.0


def test_a_filters_answers_to_impulses_are_those_of_its_states():
    sensor_filter = ftlm.SensorFilter(("v",), ((6.0, 0.0),), ((2.0, 3.0), (5.0, 2.0), (7.0, 1.0), (3.0, 0.0)))
    m, step, fine = 40, 0.05, 20
    found = impulse_responses(sensor_filter, m, step)
    system = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1.5, -3.5, -2.5]]
    t = (np.arange(m * fine) + 0.5) * step / fine
    begun = np.array([0.0, 0.0, 3.0])
    for row in found:
        there = np.array([(expm(np.array(system) * x) @ begun)[0] for x in t]).reshape(m, fine)
        np.testing.assert_allclose(row, there.mean(axis=1), atol=1e-4)
        begun = np.array(system) @ begun
    zero = ftlm.SensorFilter(("v",), ((1.0, 1.0), (6.0, 0.0)), ((1.0, 2.0), (5.0, 1.0), (7.0, 0.0)))
    assert impulse_responses(zero, m, step) is None


#: A hub and the elastic link on it; each drives the other, the current both.
HUB, LINK = (30.0, 0.4, -1.5), (90.0, 1.2)
CARRIED = "D^2 x = a q + d D q - b D x + g u; D^2 q = - D^2 x - k q - e D q"
CARRIED_TRUTH = {"a": 30.0, "d": 0.4, "b": 1.5, "g": 1.0, "k": 90.0, "e": 1.2}
#: Where they are when the run begins, how fast, and what each one's filter holds then.
MOVING, FILTER_STATE = (0.3, 1.0, 0.05, -0.4), (0.25, 0.8, 0.07, 0.2)


def carried_run(names: str, *, own_times: bool = False) -> ftlm.Run:
    """Hub and link by an integrator, cut in the middle of a motion, the angles that are named behind their filters."""

    def pulled(t):
        return 6.0 * np.sin(2.1 * t) + 3.0 * np.sin(5.3 * t + 0.4)

    t = np.arange(401) * 0.01
    if own_times:
        t[1:-1] += np.random.default_rng(0).uniform(-0.003, 0.003, t.size - 2)
    angles, _ = friction.hub_and_link(
        pulled, t, HUB, LINK, 0.0, start=MOVING, low_pass=(OMEGA, ZETA), filter_state=FILTER_STATE
    )
    outputs = {name: angles[k + 2 * (name in names)] for k, name in enumerate("xq")}
    times = {"time": t, "resample": 0.01} if own_times else {"step": 0.01}
    return ftlm.Run.from_arrays(inputs={"u": pulled(t)}, outputs=outputs, intersample={"u": "foh"}, **times)


def carried(names: str, **options) -> ftlm.Structure:
    return replace(ftlm.equation(CARRIED, sensor_filter=sensor(tuple(names)), **options), coupling="simulated")


@pytest.mark.parametrize("own_times", [False, True], ids=["grid", "own times"])
@slow_after(1, "names", ["xq", "q"])
def test_equations_that_follow_together_start_with_their_filters_in_motion(names, own_times):
    run = carried_run(names, own_times=own_times)
    model = ftlm.Model(carried(names, fixed=CARRIED_TRUTH))
    compared = model.compare(run)
    # All that is left is the force between its samples.
    assert min(compared.fit.values()) > 99.98
    start = compared.initial[0]
    assert {n for n in "xq" if {-1.0, -2.0} <= set(start[n])} == set(names)
    for name in names:
        level, rate = FILTER_STATE["xq".index(name) * 2 :][:2]
        # A free motion of the filter is its answer to these; of an impulse's derivative it makes a jump.
        assert OMEGA**2 * start[name][-2.0] == pytest.approx(level, abs=3e-4)
        slope = OMEGA**2 * (start[name][-1.0] - 2 * ZETA * OMEGA * start[name][-2.0])
        assert slope == pytest.approx(rate, abs=3e-3)
    if own_times:
        return
    again = model.simulate(run, initial=start)
    for name in "xq":
        np.testing.assert_allclose(again[name], compared.simulated[name][0], atol=1e-6 * np.ptp(run[name]))
    means = compare_means(model, run).simulated
    for name in "xq":
        # Impulses lie within the first pulses, and are read from the others.
        middles = 0.5 * (run[name][1:] + run[name][:-1])
        np.testing.assert_allclose(means[name][0][8:], middles[8:], atol=0.02 * np.ptp(run[name]))


@slow_after(1, "names", ["xq", "q"])
def test_numbers_of_equations_that_follow_together_behind_filters_in_motion(names):
    run = carried_run(names)
    start = {n: 1.3 * v for n, v in CARRIED_TRUTH.items()}
    joint = fit_output_error([run], carried(names, initial="caputo"), start=start)
    assert joint.initial_terms == 4 + 2 * len(names)
    for name, value in CARRIED_TRUTH.items():
        assert joint.coefficients[name] == pytest.approx(value, rel=2e-3), name


@pytest.mark.slow
@pytest.mark.parametrize("filtered", [("y",), ("y", "z")], ids="+".join)
def test_coupled_runs_in_motion_are_identified_from_their_own_start(filtered):
    run = run_of(measured(filtered, together=True)).window(1.7, None)
    structure = replace(ftlm.equation(TOGETHER, sensor_filter=sensor(filtered)), coupling="simulated")
    found = ftlm.identify(run, structure, method="output-error")
    for name, value in (TRUTH | SECOND).items():
        assert found.coefficients[name] == pytest.approx(value, rel=1e-5), name
    assert min(found.model.compare(run).fit.values()) > 99.999
    assert "filter's state 1" in found.details()


def test_slopes_beside_a_filter_in_motion_are_those_of_finite_differences():
    structure = ftlm.flexible_link(coupling="simulated", sensor_filter="stock")
    structure = replace(structure, initial="caputo")
    problem = FreeProblem.of(structure)
    orders = {"alpha1": 1.93, "gamma1": 0.9, "beta2": 0.23, "mu2": 0.7}
    numbers = {"a1": 500.0, "b1": -50.0, "d1": 8.0, "g1": 120.0, "j1": 0.5}
    t, rng = np.arange(241) * 0.004, np.random.default_rng(1)
    outputs = {n: np.sin(9.0 * t + k) + rng.normal(size=t.size) for k, n in enumerate(("theta11", "theta12"))}
    run = ftlm.Run.from_arrays(step=0.004, inputs={"I1": np.sign(np.sin(7.0 * t))}, outputs=outputs)
    grid = Objective(problem, [run], [1.0, 3.0], pulses_per_sample=2)
    names = [*problem.orders, *problem.coefficients]
    point, count = np.array([(orders | numbers)[n] for n in names]), len(orders)

    def at(values):
        attempt = Iterate(list(values[:count]), list(values[count:]), "here", {})
        return grid.minimize(attempt, 1, linear_scale=True).outcome

    base = at(point)
    # The hub's filter holds nothing, for it has none.
    bare = replace(grid, problem=FreeProblem.of(replace(structure, sensor_filter=None)))
    without = bare.minimize(Iterate(list(point[:count]), list(point[count:]), "here", {}), 1, linear_scale=True).outcome
    held = [len(begun) for begun in base["initial"][0]], [len(begun) for begun in without["initial"][0]]
    assert [a - b for a, b in zip(*held, strict=True)] == [0, 2]
    weights = np.linalg.norm(base["jacobian"], axis=1)
    for i, name in enumerate(names):
        shift = 1e-6 * max(abs(point[i]), 1.0) * np.eye(point.size)[i]
        slope = (np.asarray(at(point + shift)["residuals"]) - at(point - shift)["residuals"]) / (2 * shift[i])
        # Kaufman's projection: that of the cost is exact.
        found, expected = (float(np.dot(row, base["residuals"])) for row in (base["jacobian"][i], slope))
        assert found == pytest.approx(expected, rel=2e-3, abs=1e-4 * weights[i]), name


def test_a_filter_that_holds_more_than_answers_to_impulses_is_refused_in_motion():
    for numerator, denominator in [
        (((1.0, 1.0), (9.0, 0.0)), ((1.0, 2.0), (3.0, 1.0), (9.0, 0.0))),
        (((9.0, 0.0),), ((1.0, 1.5), (9.0, 0.0))),
    ]:
        odd = ftlm.SensorFilter(("q",), numerator, denominator)
        run = carried_run("q")
        structure = replace(ftlm.equation(CARRIED, sensor_filter=odd, fixed=CARRIED_TRUTH), coupling="simulated")
        with pytest.raises(ftlm.ModelError, match="q passed a sensor filter with a fractional order or a zero"):
            ftlm.Model(structure).compare(run)
        ftlm.Model(replace(structure, initial="rest")).compare(run)


@pytest.mark.parametrize("method", ["least-squares", "instrumental-variables"])
def test_equation_errors_know_the_filters_state(method):
    run = run_of(measured(("y",), inertial=True)).window(1.7, None)
    words = ftlm.equation(WORDS.replace("p v", "p D^2 v"), sensor_filter=sensor(("y",)))
    found = ftlm.identify(run, words, method=method, m=4096)
    for name, value in TRUTH.items():
        assert found.coefficients[name] == pytest.approx(value, rel=2e-3), name


def test_an_input_that_passed_the_filter_is_not_filtered_again():
    # A model as it is, on signals that a state-space model made: today's answer for a deflection among the inputs.
    run = run_of(measured(("y", "v")))
    model = ftlm.Model(ftlm.equation(WORDS, sensor_filter=sensor(("y", "v")), initial="rest", fixed=TRUTH))
    assert model.compare(run).fit["y"] > 99.9999
    twice = ftlm.Model(ftlm.equation(WORDS, sensor_filter=sensor(("y",)), initial="rest", fixed=TRUTH))
    assert twice.compare(run).fit["y"] < 95.0


def test_responses_are_those_of_the_measured_signals():
    w = np.geomspace(0.1, 20.0, 15)
    s = 1j * w
    gain = OMEGA**2 / (s**2 + 2 * ZETA * OMEGA * s + OMEGA**2)
    plain = ftlm.Model(ftlm.equation(WORDS, fixed=TRUTH)).frequency_response(w)
    for filtered in SUBSETS:
        found = ftlm.Model(ftlm.equation(WORDS, sensor_filter=sensor(filtered), fixed=TRUTH)).frequency_response(w)
        own = gain if "y" in filtered else 1.0
        expected = plain * np.array([own * np.ones(w.size), own / (gain if "v" in filtered else 1.0) * np.ones(w.size)])
        np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_a_filter_names_signals_that_are_there():
    low_pass = ftlm.SensorFilter.low_pass
    for wrong, words in [
        (lambda: low_pass([]), "sensor filter: it names no signal"),
        (lambda: low_pass(["y", "y"]), "sensor filter: it names y twice"),
        (lambda: low_pass("theta12"), r"signals = 'theta12' is one text; give a list of names, \['theta12'\]"),
        (lambda: low_pass(["y"], frequency=0.0), "frequency of the sensor filter = 0.0 is not positive"),
        (lambda: low_pass(["y"], damping=float("nan")), "damping of the sensor filter = nan is not positive"),
        (lambda: ftlm.equation(WORDS, sensor_filter=low_pass(["w"])), "filtered signal 'w' does not occur"),
    ]:
        with pytest.raises(ftlm.ModelError, match=words):
            wrong()


def test_files_keep_the_meaning_of_their_filter(tmp_path):
    for filtered in (("y",), ("v",), ("y", "v")):
        model = ftlm.Model(ftlm.equation(WORDS, sensor_filter=sensor(filtered), fixed=TRUTH))
        path = model.save(tmp_path / f"{'-'.join(filtered)}.json")
        assert json.loads(path.read_bytes())["sensor_filter"]["signals"] == list(filtered)
        assert ftlm.load_model(path).structure == model.structure


def test_the_command_line_names_filtered_signals():
    built = StructureOptions(filtered_signals=["y", "v"], sensor_filter="1:0.9").structure(WORDS)
    assert built == ftlm.equation(WORDS, sensor_filter=sensor(("y", "v")))
    assert StructureOptions(filtered_signals=["v"]).structure(WORDS).sensor_filter == ftlm.SensorFilter.low_pass(["v"])
    for options, text, words in [
        ({"sensor_filter": "2"}, WORDS, "--sensor-filter applies to the signals of --filtered-signals"),
        (
            {"filtered_signals": ["y"], "sensor_filter": "slow"},
            WORDS,
            "--sensor-filter 'slow' is not a filter; give stock, HZ or HZ:DAMPING",
        ),
        ({"filtered_signals": ["w"]}, WORDS, "filtered signal 'w' does not occur"),
        (
            {"filtered_signals": ["theta12"]},
            "flexible-link:1",
            "apply to equations as text; the flexible link has --sensor-filter stock",
        ),
        (
            {"filtered_signals": ["theta12"]},
            "arm",
            "--filtered-signals: not used with --structure arm, which fixes these options; leave it out",
        ),
        ({"sensor_filter": "2"}, "flexible-link:1", "the flexible link has --sensor-filter stock"),
        (
            {"sensor_filter": "stock"},
            "arm",
            "--sensor-filter: not used with --structure arm, which fixes these options; leave it out",
        ),
        ({}, "arm:3", "--structure 'arm:3' is not known; use arm:1, :2 or :both"),
    ]:
        with pytest.raises(ftlm.ModelError, match=words):
            StructureOptions(**options).structure(text)


def test_the_arm_of_real_files_is_its_deflections():
    arm = StructureOptions().structure("arm")
    assert str(arm).splitlines() == [
        "D^2 theta12 = a2 D^beta2 theta12 - 1.0 D^2 theta11 + d2 D^1 theta12 + p2 D^2 theta21 + q2 D^2 theta22"
        " + w2 D^1 theta22 + e2 theta11 + f2 theta21 + c",
        "D^2 theta22 = a4 D^beta4 theta22 - 1.0 D^2 theta21 + d4 D^1 theta22 + p4 D^2 theta11 + q4 D^2 theta12"
        " + w4 D^1 theta12 + e4 theta21 + f4 theta11 + c",
    ]
    assert (arm.coupling, arm.coefficient_law) == ("measured", ())
    assert arm.sensor_filter == ftlm.SensorFilter.low_pass(["theta12", "theta22"])
    assert StructureOptions().structure("arm:2").outputs == ("theta22",)
    with pytest.raises(ftlm.ModelError, match="cross_damping=True needs the measured other deflection"):
        ftlm.flexible_link(cross_damping=True)
    with pytest.raises(ftlm.ModelError, match="hub=False makes the measured hub angle an input of the deflection"):
        ftlm.flexible_link(hub=False, form="published")


def single(count: int, names: tuple[str, ...]) -> ftlm.Run:
    rng = np.random.default_rng(count)
    return ftlm.Run.from_arrays(step=0.01, inputs={}, outputs={n: rng.standard_normal(50) for n in names})


def test_a_link_whose_other_stage_was_not_measured_is_alone(capsys):
    both, alone = single(1, ("theta11", "theta12", "theta21", "theta22")), single(2, ("theta11", "theta12"))
    options = StructureOptions()
    assert options.structure_for_runs("arm:1", [both]) == options.structure("arm:1")
    assert options.structure_for_runs("arm", [alone]) == options.structure("arm")
    # One run with stage 2 is enough: the other lacks signals, and is refused for that.
    assert options.structure_for_runs("arm:1", [alone, both]) == options.structure("arm:1")
    assert capsys.readouterr().err == ""
    made = options.structure_for_runs("arm:1", [alone, alone])
    assert "no run has theta21 or theta22: arm:1 is a link alone" in capsys.readouterr().err
    assert str(made) == "D^2 theta12 = a2 theta12 - 1.0 D^2 theta11 + d2 D^mu2 theta12 + e2 theta11 + c"
    assert made.sensor_filter == ftlm.SensorFilter.low_pass(["theta12"])
    assert options.structure_for_runs("arm:2", [alone]) == options.structure("arm:2")


def test_what_is_free_behind_a_filter_is_known_before_its_offset_is_decided():
    structure = replace(ftlm.equation(WORDS, sensor_filter=sensor(("y",))), offset="auto")
    assert FreeProblem.of(structure).names == FreeProblem.of(replace(structure, offset="none")).names
