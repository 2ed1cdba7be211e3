"""A body that may stick, its angle or that of what hangs on it read through a sensor filter."""

import numpy as np
import pytest
from scipy import signal

import friction
import ftlm
from ftlm.errors import ModelError
from slow_cases import slow_after

pytestmark = pytest.mark.usefixtures("no_extension_tests")

CORNER, DAMPING = 2.0 * np.pi * 2.0, 0.9
HUB, LINK = (30.0, 0.4, -1.5), (90.0, 1.2)
WORDS = "D^2 x = a q + d D q - b D x + g u - fc*sign(D x); D^2 q = - D^2 x - k q - e D q"
TRUTH = {"a": 30.0, "d": 0.4, "b": 1.5, "g": 1.0, "fc": 4.0, "k": 90.0, "e": 1.2}
CART = "D^2 y = - v D y + g u - fc*sign(D y)"
STEP, ROWS = 0.0125, 601


def behind(*signals: str) -> ftlm.SensorFilter:
    return ftlm.SensorFilter.low_pass(list(signals), frequency=2.0, damping=0.9)


def force(t, first: float = 0.0, second: float = 0.4):
    return 6.0 * np.sin(2.1 * t + first) + 3.0 * np.sin(5.3 * t + second)


def hub_run(names: str, *, start=(0.0,) * 4, filter_state=(0.0,) * 4, seed: int | None = None) -> ftlm.Run:
    """The hub and its link between events, the angles that are named behind the filter."""
    t = np.arange(ROWS) * 0.01
    angles, v = friction.hub_and_link(
        force, t, HUB, LINK, TRUTH["fc"], start=start, low_pass=(CORNER, DAMPING), filter_state=filter_state
    )
    assert 0.1 < np.mean(v == 0.0) < 0.9
    x, q = (angles[k + 2 * (name in names)] for k, name in enumerate("xq"))
    if seed is not None:
        rng = np.random.default_rng(seed)
        x, q = (row + 0.003 * np.std(row) * rng.standard_normal(ROWS) for row in (x, q))
    return ftlm.Run.from_arrays(
        step=0.01, inputs={"u": force(t)}, outputs={"x": x, "q": q}, intersample={"u": "foh"}, name="hub"
    )


def cart_run(level: float, rate: float, filter_state: tuple[float, float], seed: int) -> ftlm.Run:
    """A cart with v = 1, g = 1, fc = 0.8 under held values in closed form, its position behind the filter, with noise.

    The filter is driven by straight lines between hundredths of a sample interval.
    """
    rng, parts = np.random.default_rng(seed), 100
    first, second = rng.uniform(0.0, 2.0 * np.pi, 2)
    t = np.arange(ROWS) * STEP
    push = 1.6 * np.sin(2.2 * t + first) + 0.8 * np.sin(5.1 * t + second)
    fine, _ = friction.exact_cart(np.repeat(push, parts), STEP / parts, 1.0, 0.8, level, rate)
    _, read, _ = signal.lsim(
        ([[0.0, 1.0], [-(CORNER**2), -2.0 * DAMPING * CORNER]], [[0.0], [CORNER**2]], [[1.0, 0.0]], [[0.0]]),
        fine[: (ROWS - 1) * parts + 1],
        np.arange((ROWS - 1) * parts + 1) * STEP / parts,
        X0=filter_state,
    )
    read = read[::parts]
    read += 0.005 * np.std(read) * rng.standard_normal(ROWS)
    return ftlm.Run.from_arrays(step=STEP, inputs={"u": push}, outputs={"y": read}, intersample={"u": "zoh"})


def solved(words: str, truth: dict[str, float], sensor: ftlm.SensorFilter | None, **options) -> ftlm.Model:
    return ftlm.Model(ftlm.equation(words, fixed=truth, sensor_filter=sensor, **options))


@pytest.mark.parametrize("names", ["q", "xq"])
def test_the_free_run_is_that_between_events_with_the_filter_s_states(names: str) -> None:
    run = hub_run(names)
    found = solved(WORDS, TRUTH, behind(*names)).simulate(run)
    for name in "xq":
        assert np.max(np.abs(found[name] - run[name])) < 1e-3 * np.max(np.abs(run[name])), name
    # It sticks before the filter: read through it, a hub at rest still moves.
    plain = solved(WORDS, TRUTH, None).simulate(run)
    assert np.max(np.abs(plain["q"] - run["q"])) > 0.1 * np.max(np.abs(run["q"]))


@pytest.mark.parametrize("names", ["q", "xq"])
def test_a_filter_in_motion_is_found_with_the_start(names: str) -> None:
    run = hub_run(names, start=(0.3, 1.0, 0.05, -0.4), filter_state=(0.25, 0.8, 0.07, 0.2))
    model = solved(WORDS, TRUTH, behind(*names), initial="caputo")
    found = model.compare(run)
    assert min(found.fit.values()) > 99.7
    start = found.initial[0]
    assert {n for n in "xq" if {-1.0, -2.0} <= set(start[n])} == set(names)
    for name in names:
        # Of an impulse's derivative the filter makes a jump: where its reading stands at the start.
        assert CORNER**2 * start[name][-2.0] == pytest.approx(run[name][0], abs=0.01 * np.ptp(run[name]))
        assert found.simulated[name][0][0] == pytest.approx(CORNER**2 * start[name][-2.0], rel=1e-9)
    again = model.simulate(run, initial=start)
    for name in "xq":
        np.testing.assert_allclose(again[name], found.simulated[name][0], atol=1e-5 * np.ptp(run[name]))


@slow_after(1, "level, rate, filter_state", [(0.0, 0.0, (0.0, 0.0)), (0.3, 0.8, (0.25, 0.5))], ids=["rest", "motion"])
def test_a_cart_is_recovered_behind_its_filter(level: float, rate: float, filter_state: tuple[float, float]) -> None:
    run = cart_run(level, rate, filter_state, 3)
    initial = "rest" if rate == 0 else "caputo"
    found = ftlm.identify(run, ftlm.equation(CART, sensor_filter=behind("y"), initial=initial), threads=1)
    for name, value in {"v": 1.0, "g": 1.0, "fc": 0.8}.items():
        assert abs(found.coefficients[name] - value) < 4.0 * found.standard_errors[name], name
        low, high = found.intervals[name]
        assert high - low < 0.02
    assert found.fit["y"] > 99.4
    assert found.warnings == ()
    if rate:
        return
    # Taken for the position itself, what was read gives other numbers.
    blind = ftlm.identify(run, ftlm.equation(CART, initial=initial), threads=1)
    assert blind.fit["y"] < 99.0
    assert abs(blind.coefficients["fc"] - 0.8) > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("names", ["q", "xq"])
def test_both_bodies_are_recovered(names: str) -> None:
    found = ftlm.identify(
        hub_run(names, seed=4), ftlm.equation(WORDS, sensor_filter=behind(*names), initial="rest"), threads=1
    )
    for name, value in TRUTH.items():
        assert abs(found.coefficients[name] - value) < 4.0 * found.standard_errors[name], name
    assert min(found.fit.values()) > 99.5


def test_the_arm_s_hub_and_its_filtered_link(tmp_path) -> None:
    structure = ftlm.flexible_link(coupling="simulated", friction=True, sensor_filter="stock")
    assert structure.sensor_filter.signals == ("theta12",)
    assert not structure.all_filtered
    orders = {"alpha1": 1.95, "gamma1": 0.97, "beta2": 0.05, "mu2": 0.9}
    values = {"a1": 628.0, "b1": -62.0, "d1": 2.0, "g1": 140.0, "fc1": 12.0, "a2": -235.5, "d2": -0.75}
    model = ftlm.Model(structure.with_orders(orders).with_coefficients(values), orders=orders)
    t = np.arange(301) * 0.008
    run = ftlm.Run.from_arrays(
        step=0.008, inputs={"I1": 0.5 * np.sign(np.sin(3.0 * t))}, outputs={"theta11": 0 * t, "theta12": 0 * t}
    )
    there = model.simulate(run)
    back = ftlm.load_model(model.save(tmp_path / "arm.json")).simulate(run)
    for name in ("theta11", "theta12"):
        assert np.array_equal(there[name], back[name])
    assert model.compare(there).fit["theta12"] > 99.99


def test_what_was_filtered_and_drives_a_body_that_sticks_is_refused() -> None:
    words = "D^2 x = a q - b D x + g u - fc*sign(D x)"
    with pytest.raises(ModelError, match=r"q, an input of it, passed the sensor filter.*coupling='simulated'"):
        ftlm.equation(words, sensor_filter=behind("q"))
    ftlm.equation(words, sensor_filter=behind("x"))


def test_given_starts_of_a_filter_that_is_not_there_are_refused() -> None:
    run = hub_run("q")
    with pytest.raises(ModelError, match="exponent"):
        solved(WORDS, TRUTH, behind("q")).simulate(run, initial={"x": {-1.0: 1.0}})
