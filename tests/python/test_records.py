"""From a run to the record that the core computes on: means, delays, sensor filter, rest, initial terms."""

import pickle
import weakref
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ftlm
import oracles
from ftlm import _core, kernels
from ftlm.data.runs import MAX_CACHED_RESULTS, as_runs
from ftlm.simulation.discretization import (
    default_m,
    equation_tuple,
    initial_tuple,
    prepare,
    record,
    records,
    structure_tuple,
)
from ftlm.simulation.initial_conditions import history
from ftlm.structure.structure import History

pytestmark = pytest.mark.usefixtures("no_extension_tests")


def make_run(outputs=None, inputs=None, step=0.1, **options):
    n = len(next(iter((outputs or inputs).values())))
    return ftlm.Run.from_arrays(
        step=step, inputs=inputs or {"u": np.zeros(n)}, outputs=outputs or {"y": np.zeros(n)}, **options
    )


# ----------------------------------------------------------------------------------------------------------------------
# Pulse means


@settings(max_examples=60, deadline=None)
@given(
    samples=st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=12),
    m=st.integers(1, 40),
    how=st.sampled_from(["zoh", "foh"]),
)
def test_pulse_means_are_the_oracles(samples, m, how):
    found = kernels.pulse_means(samples, m, hold=how == "zoh")
    np.testing.assert_allclose(found, oracles.pulse_means(samples, m, how), rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("m", [1, 5, 6, 7, 8, 14, 21])
def test_a_record_integrates_what_the_signals_do_between_rows(m):
    rng = np.random.default_rng(1)
    y, u, v = rng.standard_normal((3, 8))
    run = make_run({"y": y}, {"u": u, "v": v}, intersample={"v": "foh"})
    structure = ftlm.equation("D y = a y + b u + c v", initial="rest")
    found = record(run, structure, m)
    assert found.signals == ("y", "u", "v")
    assert found.inputs == (False, True, True)
    assert found.m == m
    assert found.step == pytest.approx(0.7 / m)
    for name, samples, how in (("y", y, "foh"), ("u", u, "zoh"), ("v", v, "foh")):
        np.testing.assert_allclose(found.of(name), oracles.pulse_means(samples, m, how), atol=1e-13)


def test_on_its_own_grid_an_output_is_the_mean_of_neighbours_and_a_command_is_itself():
    rng = np.random.default_rng(2)
    y, u = rng.standard_normal((2, 50))
    found = record(make_run({"y": y}, {"u": u}), ftlm.equation("D y = a y + b u", initial="rest"), 49)
    np.testing.assert_allclose(found.of("y"), (y[:-1] + y[1:]) / 2, atol=1e-15)
    np.testing.assert_array_equal(found.of("u"), u[:-1])


def test_refinement_keeps_a_held_command_exact():
    u = np.random.default_rng(3).standard_normal(20)
    found = record(make_run(inputs={"u": u}), ftlm.equation("D y = a y + b u"), 19 * 8)
    np.testing.assert_allclose(found.of("u"), np.repeat(u[:-1], 8), rtol=1e-14)


def test_default_m_is_the_papers_or_what_the_shortest_run_carries():
    long, middle, short = (make_run({"y": np.arange(n, dtype=float)}) for n in (3000, 2048, 100))
    assert default_m([long], power_of_two=True) == 2048
    assert default_m([long, middle], power_of_two=False) == 2047
    assert default_m([long, middle], power_of_two=True) == 1024
    assert default_m([long, short], power_of_two=False) == 99
    assert default_m([short], power_of_two=True) == 64


# ----------------------------------------------------------------------------------------------------------------------
# Delay


@pytest.mark.parametrize(
    ("delay", "shift", "share"), [(0.0, 0, 0.0), (0.3, 3, 0.0), (0.25, 2, 0.5), (0.07, 0, 0.7), (9.0, 50, 0.0)]
)
def test_delay_shifts_the_mean_of_a_held_input(delay, shift, share):
    u = np.random.default_rng(4).standard_normal(51)
    structure = ftlm.equation("D y = a y + b u", delay={"u": delay}, initial="rest")
    found = record(make_run(inputs={"u": u}), structure, 50).of("u")
    before = np.concatenate([np.zeros(51), u])
    at = 51 + np.arange(50)
    expected = (1 - share) * before[at - shift] + share * before[at - shift - 1]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_before_a_record_that_does_not_start_at_rest_an_input_was_what_it_is_first():
    u = np.linspace(2, 3, 51)
    run = make_run({"y": 1 + np.arange(51.0)}, {"u": u})
    structure = ftlm.equation("D y = a y + b u", delay={"u": 0.5})
    assert record(run, structure, 50).initial == "caputo"
    np.testing.assert_allclose(
        record(run, structure, 50).of("u"), np.concatenate([np.full(5, 2.0), u[:45]]), atol=1e-12
    )


@pytest.mark.parametrize("delay", [0.05, 0.01, 0.047, 0.3])
def test_a_delayed_command_switches_within_an_interval_of_a_finer_grid(delay):
    u = np.random.default_rng(5).standard_normal(13)
    structure = ftlm.equation("D y = a y + b u", delay={"u": delay}, initial="rest")
    m, step = 12 * 20, 0.1
    found = record(make_run(inputs={"u": u}, step=step), structure, m).of("u")
    # Exact means of the delayed, held command from its integral, a broken line.
    knots, integral = np.arange(14) * step, np.concatenate([[0.0], np.cumsum(u) * step])
    edges = np.interp(np.arange(m + 1) * step * 12 / m - delay, knots, integral)
    np.testing.assert_allclose(found, np.diff(edges) / (step * 12 / m), atol=1e-11)


@pytest.mark.parametrize("order", [0.5, 1.6])
def test_a_simulated_delay_does_not_depend_on_how_the_command_is_sampled(order):
    # 2.5 samples of one run are 5 of another that holds the same command in half the step.
    u = np.where(np.arange(201) % 100 < 50, 1.0, -0.6)
    late = ftlm.Model(ftlm.equation(f"D^{order} y = -3 y + 5 u", delay={"u": 0.05}))
    coarse = late.simulate(make_run(inputs={"u": u}, step=0.02), tolerance=1e-6)["y"]
    fine = late.simulate(make_run(inputs={"u": np.repeat(u, 2)[:401]}, step=0.01), tolerance=1e-6)["y"]
    np.testing.assert_allclose(coarse, fine[::2], atol=5e-6 * np.abs(fine).max())


def test_delay_is_identified_with_the_model(small_model):
    # An input delayed by 2.5 samples: with the delay in the structure the coefficients are right, without it wrong.
    n = 400
    u = np.where(np.arange(n) % 100 < 50, 1.0, -0.6)
    delayed = ftlm.Model(ftlm.equation("D^1.6 y = -3 D^0.6 y - 8 y + 5 u", delay={"u": 0.05}), units={"y": "rad"})
    run = delayed.simulate(make_run(inputs={"u": u}, step=0.02), tolerance=1e-5)
    for delay, error in ((0.05, 2e-3), (0.0, None)):
        structure = ftlm.equation("D^1.6 y = a D^0.6 y + b y + c u", delay={"u": delay})
        found = ftlm.identify(run, structure, method="least-squares").coefficients
        if error:
            assert found == {
                "a": pytest.approx(-3, rel=error),
                "b": pytest.approx(-8, rel=error),
                "c": pytest.approx(5, rel=error),
            }
        else:
            assert abs(found["a"] + 3) > 0.1


def test_delay_of_a_signal_that_a_run_has_as_an_output_is_refused():
    run = make_run({"y": np.arange(10.0), "u": np.arange(10.0)}, {"w": np.zeros(10)})
    structure = ftlm.equation("D y = a y + b u", delay={"u": 0.1})
    with pytest.raises(ftlm.ModelError, match=r"delay of u = 0.1 s, but run 'run' has it as an output; delay inputs"):
        record(run, structure, 9)


def test_a_signal_that_a_run_lacks_is_named():
    with pytest.raises(ftlm.DataError, match=r"run 'run' has no signal 'v', which the model needs; it has u, y: name"):
        record(make_run(inputs={"u": np.zeros(9)}), ftlm.equation("D y = a y + b v"), 8)


# ----------------------------------------------------------------------------------------------------------------------
# Coulomb friction


def test_coulomb_term_is_the_sign_of_the_rate():
    y = np.array([0.0, 1.0, 3.0, 3.0, 2.0, 1.5, 1.5])
    run = make_run({"theta11": y})
    structure = ftlm.equation("D^2 theta11 = a theta11 + c coulomb_theta11", initial="rest")
    found = record(run, structure, 6)
    np.testing.assert_array_equal(found.of("coulomb_theta11"), [1, 1, 0, -1, -1, 0])
    np.testing.assert_array_equal(record(run, structure, 12).of("coulomb_theta11"), np.repeat([1, 1, 0, -1, -1, 0], 2))


def test_friction_is_estimated():
    # A mass with Coulomb friction stepped finely, so that the sign of its measured rate is right.
    n, fine = 2001, 50
    step = 0.005
    force = 2.0 * np.sin(np.arange(n) * step * 3)
    y, v, samples = 0.0, 0.0, []
    for k in range(n):
        samples.append(y)
        for _ in range(fine):
            v += step / fine * (-4.0 * y - 0.5 * np.sign(v) + force[k])
            y += step / fine * v
    run = make_run({"y": np.array(samples)}, {"u": force}, step=step)
    structure = ftlm.equation("D^2 y = a y + c coulomb_y + g u")
    found = ftlm.identify(run, structure, method="least-squares", m=2000).coefficients
    assert found == {
        "a": pytest.approx(-4, rel=0.02),
        "c": pytest.approx(-0.5, rel=0.05),
        "g": pytest.approx(1, rel=0.02),
    }


# ----------------------------------------------------------------------------------------------------------------------
# Sensor filter

COUPLED = "D^1.8 y = -30 y - 2 D^0.8 y + 20 z + 10 u; D^1.2 z = -5 z + 3 D^0.4 y + u"


def coupled_model(sensor=None, coupling="simulated"):
    return ftlm.Model(replace(ftlm.equation(COUPLED, sensor_filter=sensor), coupling=coupling))


def test_filtering_every_signal_that_was_not_measured_through_it_keeps_the_equation_exact():
    sensor = ftlm.SensorFilter.low_pass(["z"], frequency=1.5)
    n = 1201
    u = np.where(np.arange(n) % 300 < 150, 1.0, -0.7)
    empty = make_run({"y": np.zeros(n), "z": np.zeros(n)}, {"u": u}, step=0.01)
    run = coupled_model(sensor).simulate(empty, tolerance=1e-8)
    bare = coupled_model().simulate(empty, tolerance=1e-8)
    assert np.max(np.abs(run["z"] - bare["z"])) > 0.1 * np.max(np.abs(bare["z"]))  # the filter matters
    np.testing.assert_array_equal(run["y"], bare["y"])
    structure = ftlm.equation(
        "D^1.8 y = a y + b D^0.8 y + c z + d u; D^1.2 z = e z + f D^0.4 y + g u", sensor_filter=sensor
    )
    truth = dict(zip("abcdefg", (-30, -2, 20, 10, -5, 3, 1), strict=True))
    found = ftlm.identify(run, structure, method="least-squares", m=1200)
    for name, value in truth.items():
        assert found.coefficients[name] == pytest.approx(value, rel=2e-3), name
    assert all(f.nr < 1e-3 for f in found.equation_error.values())
    assert all(f.nr < 1e-3 for f in found.output_error.values())
    # Without the filter in the structure the coefficients are wrong.
    wrong = ftlm.identify(run, replace(structure, sensor_filter=None), method="least-squares", m=1200).coefficients
    assert abs(wrong["f"] - 3) > 0.3


@pytest.mark.parametrize("filtered", [True, False])
def test_which_signals_of_a_record_pass_the_filter(filtered):
    sensor = ftlm.SensorFilter.low_pass(["z"], frequency=1.5)
    rng = np.random.default_rng(5)
    y, z, u = rng.standard_normal((3, 65))
    run = make_run({"y": y, "z": z}, {"u": u}, step=0.05)
    structure = replace(coupled_model(sensor).structure, initial="rest")
    found = record(run, structure, 64, filtered=filtered)
    plain = record(run, replace(structure, sensor_filter=None), 64)
    np.testing.assert_array_equal(found.of("z"), plain.of("z"))
    series = _core.filter_series(list(sensor.numerator), list(sensor.denominator), 64, 0.05)
    for name in ("y", "u"):
        expected = np.convolve(series, plain.of(name))[:64] if filtered else plain.of(name)
        np.testing.assert_allclose(found.of(name), expected, atol=1e-12)
    assert (found.sensor is None) is not filtered


def test_filter_series_is_the_filter():
    # omega^2/(s^2 + 2 zeta omega s + omega^2) on a unit step, against its closed form.
    sensor = ftlm.SensorFilter.low_pass(["y"])
    m, step = 2000, 0.001
    series = _core.filter_series(list(sensor.numerator), list(sensor.denominator), m, step)
    response = np.cumsum(series)
    zeta, omega = 0.9, 4 * np.pi
    t = np.arange(1, m) * step
    damped = omega * np.sqrt(1 - zeta**2)
    exact = 1 - np.exp(-zeta * omega * t) * (np.cos(damped * t) + zeta * omega / damped * np.sin(damped * t))
    np.testing.assert_allclose((response[1:] + response[:-1]) / 2, exact, atol=4e-5)


def test_filter_of_a_lead_is_a_filter_too():
    # A proper filter with a numerator of the denominator's order passes a step at once.
    series = _core.filter_series([(2.0, 1.0), (1.0, 0.0)], [(1.0, 1.0), (1.0, 0.0)], 500, 0.01)
    t = np.arange(1, 500) * 0.01
    response = np.cumsum(series)
    np.testing.assert_allclose((response[1:] + response[:-1]) / 2, 1 + np.exp(-t), atol=1e-4)


# ----------------------------------------------------------------------------------------------------------------------
# Rest and initial terms


@pytest.mark.parametrize(
    ("y", "initial"),
    [
        (np.arange(100.0) ** 2, "rest"),
        (np.sqrt(np.arange(100.0)), "rest"),
        (1 + np.arange(100.0) ** 2, "rest"),  # 1 of 2 920 (deviation): below a thousandth
        (10 + np.arange(100.0) ** 2, "history"),
        (np.cos(np.arange(100) / 10), "history"),
    ],
)
def test_rest_is_judged_by_the_first_sample(y, initial):
    run = make_run({"y": y})
    found = record(run, ftlm.equation("D^1.5 y = a y + b u"), 99).initial
    assert (found == "rest") == (initial == "rest")
    # Whole orders need no more than whole powers, whatever was before.
    whole = record(run, ftlm.equation("D^2 y = a y + b u"), 99).initial
    assert whole == ("rest" if initial == "rest" else "caputo")
    if initial == "history":
        assert found == history(run, ftlm.equation("D^1.5 y = a y + b u"))


def test_rest_is_judged_within_noise():
    rng = np.random.default_rng(6)
    structure = ftlm.equation("D^1.5 y = a y + b u")
    y = np.sin(np.arange(400) / 30) + 0.05 * rng.standard_normal(400)
    y[0] = 0.15
    assert record(make_run({"y": y}), structure, 99).initial == "rest"
    y[0] = 0.5
    assert isinstance(record(make_run({"y": y}), structure, 99).initial, History)


def test_plant_a_is_driven_from_its_first_sample_and_at_rest(clean_a):
    assert record(clean_a, ftlm.flexible_link(form="published"), 256).initial == "rest"


@pytest.mark.parametrize(
    ("initial", "decided"), [("rest", (False, [])), ("caputo", (True, [])), ((0.0, 0.9), (False, [0.0, 0.9]))]
)
def test_stated_initial_terms_are_kept(initial, decided):
    run = make_run({"y": 1 + np.arange(50.0)})
    found = record(run, ftlm.equation("D^1.5 y = a y + b u", initial=initial), 49)
    assert found.initial == initial
    assert initial_tuple(found.initial) == decided


def test_one_run_that_moves_gives_all_runs_initial_terms():
    still, moving = make_run({"y": np.arange(50.0) ** 2}), make_run({"y": 5000 - np.arange(50.0) ** 2})
    structure = ftlm.equation("D^1.5 y = a y")
    assert [r.initial for r in prepare([still, still], structure, 49, power_of_two=False)] == ["rest", "rest"]
    powers = history(moving, structure)
    assert [r.initial for r in prepare([still, moving], structure, 49, power_of_two=False)] == [powers, powers]
    whole = ftlm.equation("D^2 y = a y")
    assert [r.initial for r in prepare([still, moving], whole, 49, power_of_two=False)] == ["caputo", "caputo"]


def test_caputo_initial_terms_make_the_equation_error_vanish():
    # D^1.8 y = -2 D^0.9 y - y from y(0) = 1, and a run that begins in the middle of nothing known: t^0, t^0.9, t.
    n, step = 801, 0.01
    m = n - 1
    zero = (step, np.zeros((1, m)), None)
    model = ((0, 1.8, [(0, 0.9), (0, 0.0)]), [-2.0, -1.0])
    terms = [(0.0, 1.0), (0.9, 0.3), (1.0, -0.7)]
    y = _core.respond(zero, [model], [False], [terms])
    structure = ftlm.equation("D^1.8 y = a D^0.9 y + b y", initial="caputo")
    item = structure.equations[0]
    coefficients, (initial,), exponents, dropped = _core.least_squares(
        [(step, y, None)], structure_tuple(item.with_orders({}), ("y",)), [False], [None, None], (True, [])
    )
    assert exponents == [0.0, 0.9, 1.0]
    assert dropped == []
    np.testing.assert_allclose(coefficients, [-2, -1], rtol=1e-7)
    np.testing.assert_allclose(initial, [1.0, 0.3, -0.7], rtol=1e-6)


# ----------------------------------------------------------------------------------------------------------------------
# As the core takes it


def test_tuples_number_the_signals_by_row():
    item = ftlm.equation("D^1.5 y = -2 D^0.5 z + 3 y + u").equations[0]
    signals = ("y", "z", "u")
    assert structure_tuple(item, signals) == (0, 1.5, [(1, 0.5), (0, 0.0), (2, 0.0)])
    assert equation_tuple(item, signals) == ((0, 1.5, [(1, 0.5), (0, 0.0), (2, 0.0)]), [-2.0, 3.0, 1.0])


def test_records_refuse_what_the_core_cannot_trust():
    equation = (0, 1.5, [(0, 0.0)])
    for means, error in (
        (np.array([[0.0, np.nan, 1.0, np.inf]]), ftlm.DataError),
        (np.zeros((1, 0)), ftlm.DataError),
        (np.zeros((0, 4)), ftlm.DataError),
    ):
        with pytest.raises(error) as refused:
            _core.least_squares([(0.1, means, None)], equation, [False], [None], (False, []))
        assert "signal 0" in str(refused.value)
    with pytest.raises(ftlm.DataError, match="signal 0 is not finite at index 1 \\(2 such values in all\\)"):
        _core.least_squares(
            [(0.1, np.array([[0.0, np.nan, 1.0, np.inf]]), None)], equation, [False], [None], (False, [])
        )
    with pytest.raises(ftlm.ModelError, match=r"step = -0\.1 is outside"):
        _core.least_squares([(-0.1, np.ones((1, 4)), None)], equation, [False], [None], (False, []))


def test_checked_runs_pass_untouched_and_keep_their_records():
    runs = as_runs([make_run({"y": np.ones(50)}), make_run({"y": np.arange(50.0)})])
    assert as_runs(runs) is runs
    structure = ftlm.equation("D^1.5 y = a y + b u", initial="rest")
    first, second = records(runs, structure, 32)
    again = records(runs, structure.with_coefficients({"a": -1.0}), 32, filtered=False)
    assert again[0] is first
    assert again[1] is second
    assert records(runs, replace(structure, delay={"u": 0.1}), 32)[0] is not first
    assert records(runs, structure, 98)[0] is not records(runs, structure, 98)[0]
    with pytest.raises(ValueError, match="read-only"):
        first.means[0, 0] = 1.0
    assert pickle.loads(pickle.dumps(runs))._cache == {}


def test_what_is_kept_with_runs_goes_with_them():
    run = make_run({"y": np.ones(50)})
    runs = as_runs(run)
    for m in range(1, 20):
        records(runs, ftlm.equation("D^1.5 y = a y + b u", initial="rest"), m)
    assert len(runs._cache) == MAX_CACHED_RESULTS
    kept = weakref.ref(next(iter(runs._cache.values()))[0])
    assert kept() is not None
    del runs
    assert kept() is None
