"""Two bodies that pull at each other, each of which may stick: against events, against one body, words, estimates."""

from __future__ import annotations

import numpy as np
import pytest

import friction
import ftlm
from ftlm import _core
from ftlm.errors import DataError, ModelError
from numbered_problem import NumberedProblem
from slow_cases import slow_after

pytestmark = pytest.mark.usefixtures("no_extension_tests")

#: D^2 x = - k (x - y) - c (Dx - Dy) + u - friction, D^2 y = r k (x - y) + r c (Dx - Dy) - p y - friction.
SPRINGS, DAMPERS = ((-40.0, 40.0), (32.0, -50.0)), np.array(((-1.5, 1.0), (0.8, -1.2)))
WORDS = "D^2 x = - a x + b y - c D x + d D y + g u - fx*sign(D x); D^2 y = e x - h y + i D x - j D y - fy*sign(D y)"
TRUTH = {"a": 40.0, "b": 40.0, "c": 1.5, "d": 1.0, "g": 1.0, "e": 32.0, "h": 50.0, "i": 0.8, "j": 1.2}
STRENGTH = {"fx": 3.0, "fy": 1.5}
#: … + carried_ij D^2 of the other: with these the force on one turns the other back.
CARRIED = np.array(((0.0, -0.5), (-0.9, 0.0)))
NONE = np.zeros((2, 2))
END = 5.0


def pulled(t):
    return 14.0 * np.sin(2.1 * t) + 8.0 * np.sin(5.3 * t + 0.4)


def both(t):
    return pulled(t), 0.0 * t


def equations(carried=NONE):
    """The core's two equations over (x, y, u)."""
    (xx, xy), (yx, yy) = SPRINGS
    (cxx, cxy), (cyx, cyy) = DAMPERS
    first = [(0, 0.0), (1, 0.0), (0, 1.0), (1, 1.0), (1, 2.0), (2, 0.0)]
    second = [(0, 0.0), (1, 0.0), (0, 1.0), (1, 1.0), (0, 2.0)]
    return [
        ((0, 2.0, first), [xx, xy, cxx, cxy, carried[0][1], 1.0]),
        ((1, 2.0, second), [yx, yy, cyx, cyy, carried[1][0]]),
    ]


def averaged(m: int) -> np.ndarray:
    fine = (np.arange(50 * m) + 0.5) * END / (50 * m)
    return pulled(fine).reshape(m, 50).mean(axis=1)


def motion(m: int, laws, start=(0.0,) * 4, carried=NONE):
    level, rate = np.array(start[::2]), np.array(start[1::2])
    # Powers of t of a start: those of Caputo, what a term sees of a level or a velocity taken out.
    levels, rates = level - carried @ level, rate - carried @ rate - DAMPERS @ level
    powers = [[(0.0, x), (1.0, v)] for x, v in zip(levels.tolist(), rates.tolist(), strict=True)]
    record = (END / m, np.stack([np.zeros(m), np.zeros(m), averaged(m)]), None)
    return _core.friction_respond(record, equations(carried), laws, powers)


def model_of(**strength) -> ftlm.Model:
    return ftlm.Model(ftlm.equation(WORDS, fixed={**TRUTH, **STRENGTH, **strength}))


def sampled(rows: int = 501) -> ftlm.Run:
    t = np.arange(rows) * END / (rows - 1)
    return ftlm.Run.from_arrays(
        step=END / (rows - 1), inputs={"u": pulled(t)}, outputs={"x": 0 * t, "y": 0 * t}, intersample={"u": "foh"}
    )


@pytest.mark.parametrize(
    ("laws", "start", "carried"),
    [
        pytest.param(((3.0, 0.0, 1.0), (1.5, 0.0, 1.0)), (0.0,) * 4, NONE, marks=pytest.mark.slow),
        (((3.0, 0.0, 1.0), (1.5, 0.0, 1.0)), (0.2, 0.8, -0.1, -0.6), NONE),
        (((2.0, 2.0, 0.2), (1.0, 1.0, 0.1)), (0.0,) * 4, NONE),
        (((3.0, 0.0, 1.0), (1.5, 0.0, 1.0)), (0.2, 0.8, -0.1, -0.6), CARRIED),
    ],
)
def test_the_free_run_converges_to_that_between_events(laws, start, carried) -> None:
    times = np.linspace(0.0, END, 8001)
    places, rates = friction.bodies(both, times, SPRINGS, DAMPERS, laws, start, carried=carried)
    rest = rates == 0.0
    # All four: both slide, either rests, both do.
    assert {(bool(a), bool(b)) for a, b in rest.T} == {(False, False), (True, False), (False, True), (True, True)}
    size = np.max(np.abs(places), axis=1)
    errors, slips = [], []
    for m in (500, 1000, 2000):
        found = motion(m, list(enumerate(laws)), start, carried)
        middles, edges = (np.arange(m) + 0.5) * END / m, np.arange(m + 1) * END / m
        exact = np.stack([np.interp(middles, times, row) for row in places])
        errors.append(np.max(np.abs(found["outputs"] - exact), axis=1) / size)
        exact_rates = np.stack([np.interp(edges, times, row) for row in rates])
        slips.append(np.max(np.abs(found["velocity"] - exact_rates)))
        for row, stuck in zip(found["velocity"], found["stuck"], strict=True):
            assert np.array_equal(row[1:] == 0.0, stuck)
    assert np.all(errors[2] < 2e-4)
    # A body that comes to rest within a pulse jolts what it carries, which shows from the next pulse on.
    order = 4.0 if carried.any() else 8.0
    assert np.all(errors[2] < errors[0] / order)
    assert slips[2] < slips[0] / 8.0


def test_where_one_has_no_friction_it_is_the_other_s_run() -> None:
    start = (0.2, 0.8, -0.1, -0.6)
    law = (3.0, 0.0, 1.0)
    for place in (0, 1):
        alone = motion(800, [(place, law)], start)
        none = motion(800, sorted([(place, law), (1 - place, (0.0, 0.0, 1.0))]), start)
        size = np.max(np.abs(alone["outputs"]))
        np.testing.assert_allclose(none["outputs"], alone["outputs"], atol=1e-11 * size)
        assert np.array_equal(none["stuck"][place], alone["stuck"][0])
        np.testing.assert_allclose(none["force"][place], alone["force"][0], atol=1e-9)


def test_regularised_friction_tends_to_it() -> None:
    times = np.linspace(0.0, END, 1001)
    laws = ((3.0, 0.0, 1.0), (1.5, 0.0, 1.0))
    found = model_of().simulate(sampled(1001))
    errors = []
    for width in (0.03, 0.01, 0.003):
        places, _ = friction.bodies(both, times, SPRINGS, DAMPERS, laws, width=width)
        errors.append(
            max(float(np.max(np.abs(found[n] - row)) / np.ptp(row)) for n, row in zip("xy", places, strict=True))
        )
    # Of the first order in the width, for what is at rest creeps by it.
    assert errors[0] > 2.0 * errors[1] > 4.0 * errors[2]
    assert errors[2] < 3e-3


def test_words_in_any_order() -> None:
    structure = ftlm.equation(WORDS)
    assert (structure.coupling, structure.friction_equations) == ("simulated", (0, 1))
    turned = ftlm.equation("; ".join(reversed(WORDS.split("; "))), fixed={**TRUTH, **STRENGTH})
    first, second = model_of().simulate(sampled()), ftlm.Model(turned).simulate(sampled())
    exact, rates = friction.bodies(
        both, np.linspace(0.0, END, 501), SPRINGS, DAMPERS, [(f, 0.0, 1.0) for f in STRENGTH.values()]
    )
    assert all(0.02 < np.mean(row == 0.0) < 0.98 for row in rates)
    for name, row in zip("xy", exact, strict=True):
        np.testing.assert_allclose(first[name], second[name], atol=1e-10)
        # The force is linear between its samples.
        assert np.max(np.abs(first[name] - row)) < 2e-3 * np.ptp(row)


def test_words_that_lean_on_accelerations() -> None:
    first, second = WORDS.split("; ")
    words = f"{first} - k D^2 y; {second} - l D^2 x"
    model = ftlm.Model(ftlm.equation(words, fixed={**TRUTH, **STRENGTH, "k": 0.5, "l": 0.9}))
    found, laws = model.simulate(sampled()), [(f, 0.0, 1.0) for f in STRENGTH.values()]
    exact, _ = friction.bodies(both, np.linspace(0.0, END, 501), SPRINGS, DAMPERS, laws, carried=CARRIED)
    for name, row in zip("xy", exact, strict=True):
        assert np.max(np.abs(found[name] - row)) < 3e-3 * np.ptp(row)
    # Both carry each other by more than they weigh: a force on one would turn it against the force.
    heavy = ftlm.Model(ftlm.equation(words, fixed={**TRUTH, **STRENGTH, "k": 1.5, "l": 0.9}))
    with pytest.raises(ModelError, match="a force on one moves it against the force"):
        heavy.simulate(sampled())


def test_stages_that_do_not_meet_are_two_machines(tmp_path) -> None:
    t = np.arange(301) * 0.008
    drive = {"I1": 0.5 * np.sign(np.sin(3.0 * t)), "I2": 0.4 * np.sin(4.0 * t)}
    outputs = {f"theta{j}{k}": 0 * t for j in (1, 2) for k in (1, 2)}
    run = ftlm.Run.from_arrays(step=0.008, inputs=drive, outputs=outputs)
    orders = {"alpha1": 1.95, "gamma1": 0.97, "beta2": 0.05, "mu2": 0.9}
    orders |= {"alpha3": 1.9, "gamma3": 0.95, "beta4": 0.1, "mu4": 0.8}
    values = {"a1": 628.0, "b1": -62.0, "d1": 2.0, "g1": 140.0, "fc1": 12.0, "a2": -235.5, "d2": -0.75}
    values |= {"a3": 500.0, "b3": -50.0, "d3": 1.0, "g3": 300.0, "fc3": 20.0, "a4": -300.0, "d4": -1.5, "fc2": 20.0}

    def made(stage) -> ftlm.Model:
        structure = ftlm.flexible_link(stage=stage, coupling="simulated", friction=True)
        named = {n: v for n, v in orders.items() if n in structure.order_names}
        structure = structure.with_orders(named)
        return ftlm.Model(structure.with_coefficients({n: values[n] for n in structure.coefficient_names}))

    together = made("both")
    assert together.structure.friction_equations == (0, 2)
    found = ftlm.load_model(together.save(tmp_path / "arm.json")).simulate(run)
    for stage in (1, 2):
        alone = made(stage).simulate(run)
        for name in (f"theta{stage}1", f"theta{stage}2"):
            # Each is refined by itself until it stands still to a millionth.
            np.testing.assert_allclose(found[name], alone[name], atol=1e-5 * np.ptp(alone[name]))
            assert np.ptp(alone[name]) > 1e-3


@slow_after(
    2,
    "leans",
    [
        (),
        # Accelerations of each other: as they are, a little below and a little above.
        ((0.0, 0), (0.0, 1)),
        pytest.param(((1.85, None), (1.7, None)), marks=pytest.mark.slow),
        pytest.param(((1.95, None), (1.9, None)), marks=pytest.mark.slow),
    ],
)
def test_derivatives_are_those_of_finite_differences(leans) -> None:
    rng = np.random.default_rng(1)

    def experiment(m: int, every: int):
        u = 30 * np.sin(0.012 * np.arange(m)) + 3.0 * rng.normal(size=m)
        samples = rng.normal(size=(2, m // every + 1))
        record = (0.004, np.stack([0 * u, 0 * u, u]), None)
        return {
            "record": record,
            "pulses_per_sample": every,
            "samples": samples,
            "filter": None,
            "weights": [1.3, 5.0],
            "signals": [(None, False)] * 3,
            "robust_weights": None,
            "sample_times": None,
        }

    runs = [experiment(250, 1), experiment(300, 2)]

    def order(constant: float, free: int | None = None):
        return constant, [1.0 if k == free else 0.0 for k in range(2)]

    # Free are both alphas, a spring that both feel, dampers, the drive, and all numbers of both frictions.
    laws = [
        (
            0,
            order(0.0, 0),
            [
                (0, order(0.0), (-1.0, [(0, 1)])),
                (1, order(0.0), (1.0, [(0, 1)])),
                (0, order(0.9), (-1.0, [(1, 1)])),
                (2, order(0.0), (1.0, [(2, 1)])),
            ],
        ),
        (
            1,
            order(0.0, 1),
            [
                (0, order(0.0), (0.8, [(0, 1)])),
                (1, order(0.0), (-1.2, [(0, 1)])),
                (0, order(0.9), (0.5, [(1, 1)])),
                (1, order(1.0), (-1.0, [])),
            ],
        ),
    ]
    for lean, (_, _, terms), other, sign in zip(leans, laws, (1, 0), (0.4, -0.4), strict=bool(leans)):
        terms.append((other, order(*lean), (sign, [(2, 1)])))
    frictions = [
        (0, [(1.0, [(3, 1)]), (0.4, [(3, 1)]), (0.2, [])]),
        (1, [(1.0, [(4, 1)]), (1.0, [(5, 1)]), (1.0, [(6, 1)])]),
    ]
    count, each = 9, 6

    problem = NumberedProblem(laws, frictions, [(1.05, 2.0)] * 2, (True, [], 1))

    def at(point):
        return problem.evaluate(runs, point[:count], [point[count : count + each], point[count + each :]])

    starts = [0.02, -0.3, 0.01, 0.2, 0.4, 0.1, -0.05, 0.1, 0.02, -0.3, 0.3, -0.1]
    point = np.array([1.9, 1.8, 40.0, 1.5, 1.2, 6.0, 3.0, 1.0, 0.2, *starts])
    assert max(friction.slope_errors(at, point, count)) < 2e-6


def noisy(seed: int, start=(0.0,) * 4) -> ftlm.Run:
    """Both bodies between events, with 0.3 % of white noise."""
    rng = np.random.default_rng(seed)
    t, phases = np.arange(501) * END / 500, rng.uniform(0.0, 2.0 * np.pi, 2)

    def force(t):
        return 14.0 * np.sin(2.1 * t + phases[0]) + 8.0 * np.sin(5.3 * t + phases[1])

    laws = [(f, 0.0, 1.0) for f in STRENGTH.values()]
    places, _ = friction.bodies(lambda t: (force(t), 0.0), t, SPRINGS, DAMPERS, laws, start)
    places += 0.003 * np.std(places, axis=1)[:, None] * rng.standard_normal(places.shape)
    return ftlm.Run.from_arrays(
        step=END / 500,
        inputs={"u": force(t)},
        outputs=dict(zip("xy", places, strict=True)),
        intersample={"u": "foh"},
        name=f"seed {seed}",
    )


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "start"), [(0, (0.0,) * 4), (1, (0.2, 0.8, -0.1, -0.6))])
def test_both_bodies_are_recovered(seed: int, start) -> None:
    initial = "caputo" if any(start) else "rest"
    found = ftlm.identify(noisy(seed, start), ftlm.equation(WORDS, initial=initial), threads=1)
    for name, value in {**TRUTH, **STRENGTH}.items():
        assert abs(found.coefficients[name] - value) < 4.0 * found.standard_errors[name], name
    assert min(found.fit.values()) > 99.5
    assert found.warnings == ()


def test_a_body_that_never_moves_is_refused() -> None:
    run = noisy(0)
    still = ftlm.Run.from_arrays(
        step=run.step,
        inputs={"u": run["u"]},
        intersample={"u": "foh"},
        outputs={"x": run["x"], "y": 1e-4 * np.random.default_rng(0).standard_normal(run.length)},
    )
    with pytest.raises(DataError, match="y never moves"):
        ftlm.identify(still, ftlm.equation(WORDS, initial="caputo"))
