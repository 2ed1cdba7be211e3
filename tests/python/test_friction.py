"""A body that sticks: free runs against closed forms, events and slow stepping; words; estimates with intervals."""

from __future__ import annotations

from itertools import pairwise
from math import gamma

import numpy as np
import pytest

import friction
import ftlm
from ftlm import _core
from ftlm.errors import DataError, ModelError
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.linear import Streaming
from ftlm.estimation.output_error import fit_output_error
from ftlm.simulation.output_samples import simulate_samples
from numbered_problem import NumberedProblem
from slow_cases import slow_after

pytestmark = pytest.mark.usefixtures("no_extension_tests")

BLOCK = "D^2 y = u - fc*sign(D y)"
CART = "D^2 y = - v D y + g u - fc*sign(D y)"


def run_of(force: np.ndarray, step: float, y: np.ndarray | None = None, *, hold: bool = True, name: str = "run"):
    return ftlm.Run.from_arrays(
        step=step,
        inputs={"u": force},
        outputs={"y": np.zeros(force.size) if y is None else y},
        intersample={"u": "zoh" if hold else "foh"},
        name=name,
    )


def model_of(words: str, **values: float) -> ftlm.Model:
    orders = {n: v for n, v in values.items() if f"^{n}" in words}
    structure = ftlm.equation(words, orders=orders, fixed={n: v for n, v in values.items() if n not in orders})
    return ftlm.Model(structure)


def motion(means: np.ndarray, step: float, alpha: float, own, strength, powers=()):
    """The core's march: own are (coefficient, order), the strength fc or (fc, fs, vs)."""
    law = strength if isinstance(strength, tuple) else (strength, 0.0, 1.0)
    terms = [(0, order) for _, order in own] + [(1, 0.0)]
    record = (step, np.stack([np.zeros_like(means), means]), None)
    equation = ((0, alpha, terms), [*(c for c, _ in own), 1.0])
    found = _core.friction_respond(record, [equation], [(0, law)], [list(powers)])
    return {"output": found["outputs"][0], **{name: rows[0] for name, rows in found.items() if name != "outputs"}}


def level_and_rate(alpha: float, own, level: float, rate: float) -> list[tuple[float, float]]:
    """Initial terms of Caputo's derivatives: own terms see neither a level nor, above order 1, a velocity."""
    powers = {0.0: level, 1.0: rate}
    for c, nu in own:
        eta = alpha - nu
        if nu > 0:
            powers[eta] = powers.get(eta, 0.0) - c * level / gamma(eta + 1)
        if nu > 1:
            powers[eta + 1] = powers.get(eta + 1, 0.0) - c * rate / gamma(eta + 2)
    return list(powers.items())


# ------------------------------------------------------------------------------------------------------------ free runs


@pytest.mark.parametrize("fc", [0.37, 2.0])
def test_a_sliding_block_stops_at_its_instant_and_stays(fc: float) -> None:
    found = motion(np.zeros(400), 0.01, 2.0, [], fc, [(0.0, 0.5), (1.0, 1.0)])
    times = np.arange(401) * 0.01
    np.testing.assert_allclose(found["velocity"], np.maximum(1.0 - fc * times, 0.0), atol=1e-12)
    rest = times >= 1.0 / fc
    assert np.all(found["velocity"][rest] == 0.0)
    assert np.ptp(found["output"][rest[:-1]][1:]) < 1e-12
    assert found["output"][-1] == pytest.approx(0.5 + 0.5 / fc, abs=1e-4)


def test_a_body_at_rest_moves_only_where_the_force_exceeds_its_friction() -> None:
    times = np.arange(2001) * 0.005
    force = np.sin(times)
    held = motion(force[:-1], 0.005, 2.0, [(-1.0, 1.0)], 1.0)
    assert not held["velocity"].any()
    assert np.max(np.abs(held["output"])) < 1e-12
    freed = motion(force[:-1], 0.005, 2.0, [(-1.0, 1.0)], 0.6)
    first = int(np.flatnonzero(freed["velocity"])[0])
    assert times[first] == pytest.approx(np.arcsin(0.6), abs=0.011)
    assert np.all(np.abs(freed["force"]) <= 0.6 * (1.0 + 1e-9))


@pytest.mark.parametrize("fc", [0.8, 1.5])
def test_stops_turns_and_break_aways_are_those_between_events(fc: float) -> None:
    def force(t):
        return 2.0 * np.sin(3.0 * t) + 0.3

    times = np.linspace(0.0, 4.0, 2001)
    _, v = friction.between_events(force, times, 1.0, fc, 1.0)
    assert np.mean(v == 0.0) > 0.2 or fc < 1.0
    errors = []
    for m in (250, 500, 1000):
        fine = (np.arange(50 * m) + 0.5) * 4.0 / (50 * m)
        found = motion(force(fine).reshape(m, 50).mean(axis=1), 4.0 / m, 2.0, [(-1.0, 1.0)], fc, [(1.0, 1.0)])
        assert np.array_equal(found["velocity"][1:][found["stuck"]], np.zeros(found["stuck"].sum()))
        edges = np.arange(m + 1) * 4.0 / m
        errors.append(float(np.max(np.abs(found["velocity"] - np.interp(edges, times, v)))))
    assert errors[0] < 1e-4
    # The second order: a quarter for half the step, events and all, up to where in its pulse each one lies.
    assert errors[2] < errors[0] / 7.0


@pytest.mark.parametrize(
    ("alpha", "own"),
    [(2.0, [(-1.0, 1.0)]), (1.8, [(-1.0, 0.9)]), (1.7, [(-2.0, 0.0), (-0.5, 1.2)]), (1.4, [(-0.3, 0.5)])],
)
def test_fractional_bodies_are_those_of_slow_stepping(alpha: float, own) -> None:
    errors = []
    for count in (250, 500, 1000):
        step = 4.0 / count
        force = 2.0 * np.sin(3.0 * np.arange(count + 1) * step) + 0.3
        y, v = friction.naive_run(force, step, alpha, own, 0.8, 0.2, 1.0)
        found = motion(0.5 * (force[1:] + force[:-1]), step, alpha, own, 0.8, level_and_rate(alpha, own, 0.2, 1.0))
        errors.append(float(np.max(np.abs(found["output"] - 0.5 * (y[1:] + y[:-1])))))
        # After the first turn, so that both have slid and turned.
        assert np.ptp(np.sign(v)) == 2.0
    # The slow one is of first order.
    assert errors[2] < 0.005
    assert errors[2] < 0.3 * errors[0]


def test_a_steep_tanh_tends_to_it() -> None:
    def force(t):
        return 2.0 * np.sin(3.0 * t) + 0.3

    m = 4000
    step = 4.0 / m
    times = (np.arange(m) + 0.5) * step
    exact = motion(force(times), step, 2.0, [(-1.0, 1.0)], 1.5, [(1.0, 1.0)])["output"]
    at = np.concatenate([[0.0], times[::40]])
    away = [
        float(np.max(np.abs(friction.regularised(force, at, 1.0, 1.5, width, 1.0)[1:] - exact[::40])))
        for width in (1e-1, 1e-2, 1e-3)
    ]
    assert away[2] < 2e-3
    assert away[1] < 0.2 * away[0]
    assert away[2] < 0.2 * away[1]


@pytest.mark.parametrize(
    ("alpha", "own"), [(2.0, [(-3.0, 1.0)]), (1.8, [(-3.0, 0.9), (-2.0, 0.0)]), (1.3, [(-0.5, 1.1)])]
)
def test_without_friction_it_is_the_linear_free_run(alpha: float, own) -> None:
    means = np.sign(np.sin(np.arange(1000) * 0.03))
    powers = [(0.0, 0.3), (1.0, -0.2)]
    record = (0.01, np.stack([np.zeros(1000), means]), None)
    equation = ((0, alpha, [(0, nu) for _, nu in own] + [(1, 0.0)]), [*(c for c, _ in own), 1.0])
    linear = _core.respond(record, [equation], [False, True], [powers])[0]
    found = motion(means, 0.01, alpha, own, 0.0, powers)
    np.testing.assert_allclose(found["output"], linear, atol=1e-9 * np.max(np.abs(linear)))


def test_a_blocked_sum_is_the_plain_sum() -> None:
    # 5 000 pulses need blocks of 64 to 2 048; the plain march sums over the whole past.
    rng = np.random.default_rng(5)
    m, step, alpha, strength = 5000, 0.01, 1.6, 0.7
    means = np.repeat(rng.normal(size=m // 20), 20)
    response = step ** (alpha - 1) / gamma(alpha) * np.diff(np.arange(m + 1) ** (alpha - 1.0))
    linear = np.convolve(response, means)[:m]
    sign, v, brake = np.zeros(m), 0.0, strength * response[0]
    edges = [0.0]
    for k in range(m):
        p = linear[k] - strength * (response[1 : k + 1][::-1] @ sign[:k])
        side = np.sign(v) if v else np.sign(p)
        end = p - brake * side
        if end * side >= 0 and (v or abs(p) > brake):
            sign[k] = side
        elif abs(p - v) <= brake:
            sign[k], end = p / brake, 0.0
        else:
            sign[k] = side * (2.0 * v / (v - end) - 1.0)
            end = p - brake * sign[k]
        v = end
        edges.append(v)
    found = motion(means, step, alpha, [], strength)
    np.testing.assert_allclose(found["velocity"], edges, atol=1e-10)
    assert 0.05 < np.mean(found["stuck"]) < 0.95


def test_simulate_stops_where_the_block_does() -> None:
    force = np.concatenate([np.full(100, 1.0), np.zeros(300)])
    free = model_of(BLOCK, fc=0.25).simulate(run_of(force, 0.01))
    times = free.time
    # 0.75 for one second, then 0.25 against it for three.
    expected = np.where(times < 1.0, 0.375 * times**2, 0.375 + 0.75 * (times - 1) - 0.125 * (times - 1) ** 2)
    np.testing.assert_allclose(free["y"], expected, atol=1e-6)
    later = model_of(BLOCK, fc=1.0).simulate(run_of(force, 0.01))
    assert not later["y"].any()


def test_initial_terms_are_level_and_velocity() -> None:
    free = model_of(BLOCK, fc=0.5).simulate(run_of(np.zeros(301), 0.01), initial={"y": {0.0: 2.0, 1.0: 1.0}})
    stop = free.time >= 2.0
    np.testing.assert_allclose(free["y"][stop], 3.0, atol=1e-6)
    assert free["y"][0] == 2.0


# ------------------------------------------------------------------------------------------------------- sensitivities


@pytest.mark.parametrize("orders", [(1.9, 0.9), (1.8, 0.4), (1.95, 1.2)])
def test_derivatives_are_those_of_finite_differences(orders) -> None:
    runs, law = friction.two_records()

    friction_law = [(1.0, [(2, 1)]), (0.0, []), (1.0, [])]
    problem = NumberedProblem([law], [(0, friction_law)], [(1.05, 2.0), (0.0, 1.5)], (True, [], 1))

    def at(point):
        return problem.evaluate(runs, point[:5], [point[5:8], point[8:]])

    point = np.array([*orders, 0.7, 1.1, 0.9, 0.1, 0.2, 0.05, -0.2, 0.4, -0.1])
    assert max(friction.slope_errors(at, point, 5)) < 1e-6


# --------------------------------------------------------------------------------------------------------------- words


def test_words_are_read_and_written() -> None:
    structure = ftlm.equation("D^2 y = - v D y + g u - fc*sign(D y) + c")
    assert str(structure) == "D^2 y = -v D^1 y + g u - fc sign(D y) + c"
    assert structure.coefficient_names == ("v", "g", "fc")
    assert str(ftlm.equation("D^2 y = u - 2 fc sign(D y)")) == "D^2 y = 1.0 u - 2.0 fc sign(D y)"
    known = ftlm.equation("D^2 y = u - 0.5*sign(D y)")
    assert known.coefficient_names == ()
    assert known.equations[0].friction.strength == 0.5
    again = ftlm.equation(str(structure))
    assert again == structure
    assert str(model_of(CART, v=2.0, g=1.5, fc=0.3)) == "D^2 y = -2 D^1 y + 1.5 u - 0.3 sign(D y)"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("D^2 y = u + fc*sign(D y)", "it is subtracted"),
        ("D^2 y = u - fc*sign(D u)", "velocity of the output of the equation"),
        ("D^2 y = u - fc*sign(y)", "of a measured speed .*fc.tanh"),
        ("D^2 y = u - fc*sign(D y) - fs*sign(D y)", "twice"),
        ("D^0.8 y = u - fc*sign(D y)", r"requires an order alpha in \(1, 2\]"),
        ("D^2.2 y = u - fc*sign(D y)", r"requires an order alpha in \(1, 2\]"),
        ("D^2 y = D^2 u - fc*sign(D y)", "not below alpha"),
    ],
)
def test_words_that_mean_nothing_are_refused(words: str, said: str) -> None:
    with pytest.raises(ModelError, match=said):
        ftlm.equation(words)


def test_a_negative_coefficient_is_refused() -> None:
    with pytest.raises(ModelError, match="at least 0"):
        model_of(BLOCK, fc=-0.1)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"initial": "history"}, "initial='caputo'"),
        ({"sensor_filter": ftlm.SensorFilter.low_pass(["u"])}, "u, an input of it, passed the sensor filter"),
    ],
)
def test_what_a_march_does_not_know_is_refused(options, said: str) -> None:
    with pytest.raises(ModelError, match=said):
        ftlm.equation(BLOCK, **options)


def test_an_unstable_body_is_recovered() -> None:
    words, truth = "D^2 y = k y + b u - fc*sign(D y)", {"k": 1.0, "b": 1.0, "fc": 0.3}
    times, rng = np.arange(401) * 0.01, np.random.default_rng(0)
    force = 1.5 * np.sin(2.2 * times) + 0.8 * np.sin(5.1 * times + 1.0)
    y = ftlm.Model(ftlm.equation(words, fixed=truth)).simulate(run_of(force, 0.01))["y"]
    y = y + 0.005 * np.std(y) * rng.standard_normal(y.size)
    found = ftlm.identify(run_of(force, 0.01, y), ftlm.equation(words, initial="rest"), threads=1)
    for name, value in truth.items():
        assert abs(found.coefficients[name] - value) < 4.0 * found.standard_errors[name] < 0.02, name


@pytest.mark.parametrize("delay", [0.053, 0.06])
def test_a_free_delay_is_estimated_beside_friction(delay: float) -> None:
    """A delay within a row and one of whole rows, from bounds far from both."""
    g, rows = np.random.default_rng(3), 1500
    u = np.repeat(g.uniform(-3.0, 3.0, rows // 40 + 1), 40)[:rows]
    quiet = ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": np.zeros(rows)})
    truth = ftlm.equation("D^2 y = - 2 D y + 10 u - 6*sign(D y)", delay={"u": delay})
    y = ftlm.Model(truth).simulate(quiet)["y"]
    run = quiet.with_outputs({"y": y + 0.01 * np.std(y) * g.standard_normal(rows)})
    found = ftlm.identify(run, ftlm.equation("D^2 y = - a D y + b u(t - 0:0.2) - fc*sign(D y)"))
    assert found.fit["y"] > 98.5
    for name, value in {"a": 2.0, "b": 10.0, "fc": 6.0, "delay_u": delay}.items():
        one = found.parameters[name]
        assert abs(one.value - value) < 4.0 * one.standard_error < 0.05 * value


def motor_levels(seed: int, rows: int) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).uniform(-6.0, 6.0, rows // 60 + 1), 60)[:rows]


@pytest.mark.parametrize("delay", [0.02, 0.023, 0.0013, 0.0249])
def test_a_delayed_motor_converges_with_the_square_of_the_step(delay: float) -> None:
    """A body at rest slides from the jump of its force on, wherever in a pulse the delay puts it."""
    u = motor_levels(0, 400)
    y, _ = friction.delayed_motor(u, 0.005, delay, 8.0, 120.0, 90.0)
    run = ftlm.Run.from_arrays(step=0.005, inputs={"u": u}, outputs={"y": y})
    model = ftlm.Model(ftlm.equation("D^2 y = - 8 D y + 120 u - 90*sign(D y)", delay={"u": delay}))
    errors = []
    for pulses in (1, 4, 16):
        simulated = simulate_samples(model, run, pulses, {"y": {}})[0][0]
        errors.append(float(np.sqrt(np.mean((simulated - y) ** 2))))
    assert errors[0] < 3e-4 * np.std(y)
    assert all(fine < coarse / 10.0 for coarse, fine in pairwise(errors)), errors


@slow_after(1, "seeds", [1, 3])
def test_intervals_of_a_delayed_motor_hold(seeds: int) -> None:
    """At a delay of 4.6 rows and little noise, where an error of the scheme would show in every interval."""
    truth = {"b": 8.0, "k": 120.0, "fc": 90.0, "delay_u": 0.023}
    inside = []
    for seed in range(seeds):
        u = motor_levels(seed, 1500)
        y, _ = friction.delayed_motor(u, 0.005, truth["delay_u"], truth["b"], truth["k"], truth["fc"])
        noise = 0.01 * np.random.default_rng(1000 + seed).standard_normal(y.size)
        run = ftlm.Run.from_arrays(step=0.005, inputs={"u": u}, outputs={"y": y + noise})
        found = ftlm.identify(run, ftlm.equation("D^2 y = -b D y + k u(t - 0:0.1) - fc*sign(D y)"))
        for name, value in truth.items():
            one = found.parameters[name]
            assert abs(one.value - value) < 1e-2 * value, name
            inside.append(one.interval[0] <= value <= one.interval[1])
    assert 12 * sum(inside) >= 10 * len(inside), inside


def test_a_file_keeps_it(tmp_path) -> None:
    model = model_of(CART, v=2.0, g=1.5, fc=0.3)
    path = model.save(tmp_path / "cart.json")
    again = ftlm.load_model(path)
    assert again.structure.equations == model.structure.equations
    assert again.coefficients == {"v": 2.0, "g": 1.5, "fc": 0.3}


@pytest.mark.parametrize("method", ["instrumental-variables", "multi-innovation", "least-squares", "genetic"])
def test_other_methods_refuse_it(method: str) -> None:
    with pytest.raises(ModelError, match="has friction"):
        ftlm.identify(cart_run(0)[0], ftlm.equation(CART), method=method)


def test_what_is_linear_refuses_it() -> None:
    model = model_of(CART, v=2.0, g=1.5, fc=0.3)
    for linear in (model.stability, model.poles, lambda: model.frequency_response([1.0])):
        with pytest.raises(ModelError, match="has friction"):
            linear()
    for export in (lambda: model.to_control(band=(0.1, 10.0)), lambda: ftlm.analysis.transfer_functions(model)):
        with pytest.raises(ModelError, match="has friction"):
            export()
    free = ftlm.equation("D^alpha y = - v D y + g u - fc*sign(D y)")
    with pytest.raises(ModelError, match="has friction"):
        ftlm.search_orders(cart_run(0)[0], free)
    with pytest.raises(ModelError, match="has friction"):
        Streaming(ftlm.equation(CART), step=0.01, max_duration=1.0, inputs=["u"])
    with pytest.raises(ModelError, match="has friction"):
        ftlm.identify(cart_run(0)[0], ftlm.equation(CART), offset="auto")


# ----------------------------------------------------------------------------------------------------------- estimates


def cart_run(seed: int, *, noise: float = 0.005, offset: float = 0.0, rate: float = 0.0, rows: int = 801):
    """A cart with v = 1, g = 1, fc = 0.8 under two sinusoids of held values, in closed form, with white noise."""
    step = 0.0125
    times = np.arange(rows) * step
    rng = np.random.default_rng(seed)
    first, second = rng.uniform(0.0, 2.0 * np.pi, 2)
    force = 1.6 * np.sin(2.2 * times + first) + 0.8 * np.sin(5.1 * times + second)
    clean, v = friction.exact_cart(force + offset, step, 1.0, 0.8, 0.3, rate)
    samples = clean + noise * np.std(clean) * rng.standard_normal(rows)
    return run_of(force, step, samples, name=f"cart {seed}"), v


def test_friction_is_recovered_with_offsets_a_run(tmp_path) -> None:
    runs = [cart_run(1, offset=0.15, rows=501)[0], cart_run(2, offset=-0.1, rows=501)[0]]
    found = ftlm.identify(runs, ftlm.equation(CART + " + c", initial="caputo"))
    for name, truth in {"v": 1.0, "g": 1.0, "fc": 0.8}.items():
        error = found.standard_errors[name]
        assert error < 0.03
        assert abs(found.coefficients[name] - truth) < 4.0 * error + 0.004
    constants = [o["y"]["constant"] for o in found.comparison.offsets]
    np.testing.assert_allclose(constants, [0.15, -0.1], atol=0.02)
    for run, truth in zip(runs, (0.15, -0.1), strict=True):
        own = found.parameters[f"constant_y[{run.name}]"]
        assert 0.0 < own.standard_error < 0.02
        assert abs(own.value - truth) < 4.0 * own.standard_error
    assert found.fit["y"] > 98.5
    assert np.isnan(found.equation_error["y"].fit)
    page = found.report(tmp_path / "cart.html").read_text()
    assert "sgn" in page
    assert "Coulomb friction" in page
    # What is not known is not a row of four times "undefined": the reason stands there.
    reason = "y has no equation error: friction acts on it, and the sign of a measured velocity is that of its noise"
    assert reason in page
    assert '<data value="nan">' not in page
    assert "equation error</th>" not in page
    again = found.model.compare(runs)
    assert str(again).count("equation error") == 1
    assert reason in str(again)
    assert "nan" not in str(again)
    assert again.fit["y"] == pytest.approx(found.fit["y"], abs=1e-9)


def test_a_velocity_of_one_sign_does_not_tell_friction_from_an_offset() -> None:
    times = np.arange(401) * 0.01
    force = 3.0 + np.sin(4.0 * times)
    y, v = friction.exact_cart(force, 0.01, 1.0, 0.5)
    assert np.all(v >= 0.0)
    run = run_of(force, 0.01, y + 1e-3 * np.random.default_rng(0).standard_normal(401))
    found = ftlm.identify(run, ftlm.equation(CART + " + c", initial="caputo"))
    assert any(f.code == "friction_unsigned" for f in found.findings)


def test_a_run_that_never_moves_is_refused() -> None:
    rng = np.random.default_rng(0)
    run = run_of(np.sin(np.arange(400) * 0.02), 0.01, 1e-3 * rng.standard_normal(400))
    with pytest.raises(DataError, match="never moves"):
        ftlm.identify(run, ftlm.equation(CART, initial="caputo"))


def test_a_free_order_has_bounds_within_which_a_body_has_a_velocity() -> None:
    for words, bounds in ((CART, []), (CART.replace("D^2", "D^alpha"), [(1.001, 2.0)])):
        assert list(FreeProblem.of(ftlm.equation(words)).bounds) == bounds


@pytest.mark.slow
def test_a_free_order_stays_where_friction_has_a_velocity() -> None:
    run = cart_run(3)[0]
    found = ftlm.identify(run, ftlm.equation(CART.replace("D^2", "D^alpha"), initial="caputo"))
    assert 1.0 < found.orders["alpha"] <= 2.0
    assert found.orders["alpha"] == pytest.approx(2.0, abs=0.05)
    assert found.coefficients["fc"] == pytest.approx(0.8, abs=0.08)
    assert found.model.structure.equations[0].friction.strength == found.coefficients["fc"]


def test_the_initial_values_of_a_long_ring_down_are_found() -> None:
    # Far from its rest the squared error over the whole run has a second minimum, another half swing before it sticks.
    truth = ftlm.Model(ftlm.equation("D^2 x = -0.1 D x - 100 x - 0.5*sign(D x)"))
    rest = ftlm.Run.from_arrays(step=0.01, inputs={}, outputs={"x": np.zeros(1000)})
    x = truth.simulate(rest, initial={"x": [0.1]})["x"] + 2e-5 * np.random.default_rng(1).standard_normal(1000)
    found = truth.compare(rest.with_outputs({"x": x}))
    assert found.initial[0]["x"][0.0] == pytest.approx(0.1, rel=1e-3)
    assert found.output_error["x"].rmse == pytest.approx(2e-5, rel=0.1)


def hub(seed: int, load: float, disturbance: float) -> ftlm.Run:
    """A hub with friction, a constant load and an unmeasured disturbance, in a loop; explicit Euler steps of 2 ms."""
    g, step, substeps = np.random.default_rng(seed), 0.02, 10
    reference = np.repeat(g.choice([-25, 25, 0, 10], 10), 100)
    push = disturbance * np.repeat(g.standard_normal(40), 25)
    currents, angles, angle, speed = [], [], 0.0, 0.0
    for target, force in zip(reference, push, strict=True):
        current = np.clip(0.03 * (target - angle) - 0.004 * speed, -0.7, 0.7)
        currents.append(current)
        angles.append(angle)
        for _ in range(substeps):
            torque = 1500.0 * current - 5.0 * speed + load + force
            if speed == 0.0 and abs(torque) < 200.0:
                continue
            direction = np.sign(speed) if speed else np.sign(torque)
            later = speed + step / substeps * (torque - 200.0 * direction)
            speed = 0.0 if later * speed < 0.0 else later
            angle += step / substeps * speed
    return run_of(np.array(currents), step, np.array(angles) + 0.02 * g.standard_normal(reference.size))


@slow_after(1, "seed, load, disturbance", [(21, 0.0, 50.0), (2, 60.0, 150.0), (24, 60.0, 50.0)])
def test_friction_never_fits_worse_than_the_equation_without_it(seed, load, disturbance):
    run, linear = hub(seed, load, disturbance), "D^2 y = a1 D y + b u"
    frictionless, dry = (
        fit_output_error([run], ftlm.equation(words, initial="rest")) for words in (linear, f"{linear} - fc*sign(D y)")
    )
    assert dry.noise["y"] < 1.001 * frictionless.noise["y"]


SPRING_CART = "D^2 y = - v D y - k y + g u - fc*sign(D y)"


def noisy_spring_cart(force: np.ndarray, step: float, fc: float, seed: int, level: float = 0.0) -> ftlm.Run:
    run = run_of(force, step)
    y = model_of(SPRING_CART, v=1.0, k=6.0, g=4.0, fc=fc).simulate(run)["y"]
    return run.with_outputs({"y": level + y + 0.002 * np.random.default_rng(seed).standard_normal(force.size)})


def assert_spring_cart_is_found(found, fc: float) -> None:
    for name, truth in {"v": 1.0, "k": 6.0, "g": 4.0, "fc": fc}.items():
        assert abs(found.parameters[name].value - truth) < 4 * found.parameters[name].standard_error < 0.5, name


@slow_after(1, "level", [3.0, -2.0])
def test_a_step_in_the_first_row_of_a_cart_at_a_level(level):
    # With initial values instead of a level, a gain of 22 or -8 explains the run as well.
    found = ftlm.identify(noisy_spring_cart(np.ones(200), 0.04, 0.3, 1, level), ftlm.equation(SPRING_CART), threads=1)
    assert_spring_cart_is_found(found, 0.3)
    assert found.offsets["level_y"].value == pytest.approx(level, abs=0.01)
    assert found.verdict.level == "with care"
    assert "rest_assumed" in {finding.code for finding in found.findings}


@slow_after(0, "seed", [1, 0])
def test_an_offset_that_friction_compensates_is_not_estimated(seed):
    """A long stick after a step: the guesses without offset miss the optimum that a fit with offset comes near."""
    force = np.where(np.arange(400) < 20, 0.0, 1.0)
    found = ftlm.identify(noisy_spring_cart(force, 0.05, 0.8, seed), ftlm.equation(SPRING_CART), threads=1)
    assert_spring_cart_is_found(found, 0.8)
    assert not found.offsets
    assert not {"constant_estimated", "level_estimated"} & {finding.code for finding in found.findings}
