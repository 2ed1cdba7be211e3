"""A hub that sticks with a link that hangs on it: both from the current alone, against events; words; estimates."""

from __future__ import annotations

from math import gamma

import numpy as np
import pytest

import friction
import ftlm
from ftlm import _core
from ftlm.errors import DataError, ModelError
from numbered_problem import NumberedProblem

pytestmark = pytest.mark.usefixtures("no_extension_tests")

#: Hub (a, d, b) and link (k, c): D^2 x = a q + d Dq + b Dx + u - friction, D^2 q = - D^2 x - k q - c Dq.
HUB, LINK = (30.0, 0.4, -1.5), (90.0, 1.2)
WORDS = "D^2 x = a q + d D q - b D x + g u - fc*sign(D x); D^2 q = - 1 D^2 x - k q - e D q"
TRUTH = {"a": 30.0, "d": 0.4, "b": 1.5, "g": 1.0, "k": 90.0, "e": 1.2}
END = 4.0


def force(t):
    return 6.0 * np.sin(2.1 * t) + 3.0 * np.sin(5.3 * t + 0.4)


def equations(hub=HUB, link=LINK):
    """The core's two equations over (x, q, u)."""
    (a, d, b), (k, c) = hub, link
    return [
        ((0, 2.0, [(1, 0.0), (1, 1.0), (0, 1.0), (2, 0.0)]), [a, d, b, 1.0]),
        ((1, 2.0, [(0, 2.0), (1, 0.0), (1, 1.0)]), [-1.0, -k, -c]),
    ]


def motion(means, step, strength, powers=((), ()), model=None, sticks=0):
    law = strength if isinstance(strength, tuple) else (strength, 0.0, 1.0)
    record = (step, np.stack([np.zeros_like(means), np.zeros_like(means), means]), None)
    found = _core.friction_respond(record, model or equations(), [(sticks, law)], [list(p) for p in powers])
    return {name: rows if name == "outputs" else rows[0] for name, rows in found.items()}


def averaged(m: int) -> np.ndarray:
    """Pulse means of the force."""
    fine = (np.arange(50 * m) + 0.5) * END / (50 * m)
    return force(fine).reshape(m, 50).mean(axis=1)


def started(x: float, dx: float, q: float, dq: float) -> list[list[tuple[float, float]]]:
    """Powers of t of a start: those of Caputo, what a term sees of a level or a velocity taken out."""
    (_, d, b), (_, c) = HUB, LINK
    hub = {0.0: x, 1.0: dx - d * q - b * x}
    link = {0.0: q + x, 1.0: dq + dx + c * q}
    return [list(p.items()) for p in (hub, link)]


def run_of(u, x, q, step, name="run", *, is_constant=False):
    return ftlm.Run.from_arrays(
        step=step,
        inputs={"u": u},
        outputs={"x": x, "q": q},
        intersample={"u": "zoh" if is_constant else "foh"},
        name=name,
    )


def model_of(fc: float, words: str = WORDS, **more: float) -> ftlm.Model:
    return ftlm.Model(ftlm.equation(words, fixed={**TRUTH, "fc": fc, **more}))


# ------------------------------------------------------------------------------------------------------------ free runs


@pytest.mark.parametrize(
    ("law", "start"),
    [
        ((4.0, 0.0, 1.0), (0.0, 0.0, 0.0, 0.0)),
        ((6.0, 0.0, 1.0), (0.3, 1.0, 0.05, -0.4)),
        ((3.0, 3.0, 0.2), (0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_the_free_run_converges_to_that_between_events(law, start) -> None:
    times = np.linspace(0.0, END, 8001)
    angles, v = friction.hub_and_link(force, times, HUB, LINK, *law, start=start)
    assert 0.1 < np.mean(v == 0.0) < 0.9
    assert np.ptp(np.sign(v)) == 2.0
    size = np.max(np.abs(angles), axis=1)
    errors, slips = [], []
    for m in (500, 1000, 2000):
        found = motion(averaged(m), END / m, law, started(*start))
        middles, edges = (np.arange(m) + 0.5) * END / m, np.arange(m + 1) * END / m
        exact = np.stack([np.interp(middles, times, row) for row in angles])
        errors.append(np.max(np.abs(found["outputs"] - exact), axis=1) / size)
        slips.append(np.max(np.abs(found["velocity"] - np.interp(edges, times, v))))
    assert np.all(errors[2] < 1e-4)
    # The second order in the step, events and all: a sixteenth for a quarter, up to where in its pulse each one lies.
    assert np.all(errors[2] < errors[0] / 8.0)
    assert slips[2] < slips[0] / 10.0


def test_what_sticks_stands_while_its_link_rings() -> None:
    m, step = 2000, 0.002
    found = motion(np.concatenate([np.full(200, 8.0), np.zeros(m - 200)]), step, 3.0)
    stuck = found["stuck"]
    last = int(np.flatnonzero(~stuck)[-1])
    assert last < m // 2
    assert not found["velocity"][last + 2 :].any()
    x, q = found["outputs"]
    assert np.ptp(x[last + 3 :]) < 1e-15 * np.max(np.abs(x)) * m
    # Clamped, the link is the oscillator D^2 q = - k q - c Dq.
    k, c = LINK
    rings = q[last + 3 :]
    crossings = np.flatnonzero(np.diff(np.sign(rings)) != 0)
    assert len(crossings) > 5
    period = 2 * step * np.mean(np.diff(crossings))
    assert period == pytest.approx(2 * np.pi / np.sqrt(k - c * c / 4), rel=0.01)


def arm(nu: float):
    """Orders of the arm: the link carries the hub above its own order, below it, or at it."""
    return [
        ((0, 1.9, [(1, 0.3), (1, 1.0), (0, 0.95), (2, 0.0)]), [30.0, 0.4, -1.5, 1.0]),
        ((1, 2.0, [(0, nu), (1, 0.2), (1, 0.8)]), [-1.0, -90.0, -2.0]),
    ]


#: Two bodies, either of which may stick.
CHAIN = [
    ((0, 2.0, [(1, 0.0), (0, 1.0), (0, 0.0)]), [20.0, -1.0, -20.0]),
    ((1, 1.8, [(0, 0.0), (1, 0.9), (2, 0.0)]), [5.0, -2.0, 3.0]),
]


@pytest.mark.parametrize(
    ("model", "sticks", "level"),
    [
        (equations(), 0, 0.3),
        (arm(2.15), 0, 0.0),
        (arm(1.9), 0, 0.3),
        (arm(2.0), 0, 0.3),
        (CHAIN, 0, 0.3),
        (CHAIN, 1, 0.3),
    ],
)
def test_without_friction_it_is_the_linear_free_run(model, sticks: int, level: float) -> None:
    means = averaged(1000)
    record = (END / 1000, np.stack([0 * means, 0 * means, means]), None)
    powers = [[(0.0, level), (1.0, -0.2)], [(0.0, 0.1), (1.0, 0.3), (2.0, 0.2)]]
    linear = _core.respond(record, model, [False, False, True], powers)
    found = motion(means, END / 1000, 0.0, powers, model, sticks)["outputs"]
    np.testing.assert_allclose(found, linear, atol=1e-9 * np.max(np.abs(linear)))


@pytest.mark.parametrize("nu", [2.15, 1.9, 2.0])
def test_where_a_hub_starts_moves_nothing(nu: float) -> None:
    # No term sees the level itself, and every one that differentiates it has its power of t.
    means, eta = averaged(1000), 2.0 - nu
    base = motion(means, END / 1000, 3.0, model=arm(nu))
    level = 5.0
    own = {0.0: level, 1.9 - 0.95: 1.5 * level / gamma(1.95)}
    powers = [list(own.items()), [(eta, level / gamma(eta + 1.0))]]
    moved = motion(means, END / 1000, 3.0, powers, arm(nu))
    np.testing.assert_allclose(moved["velocity"], base["velocity"], atol=1e-10)
    np.testing.assert_allclose(moved["outputs"][0] - level, base["outputs"][0], atol=1e-9)
    np.testing.assert_allclose(moved["outputs"][1], base["outputs"][1], atol=1e-9)


# ------------------------------------------------------------------------------------------------------- sensitivities


@pytest.mark.parametrize(
    ("orders", "passes"),
    [
        ((1.9, 0.95, 2.1), None),
        pytest.param((1.8, 0.9, 1.95), None, marks=pytest.mark.slow),
        pytest.param((1.95, 1.1, 2.0), None, marks=pytest.mark.slow),
        ((1.9, 0.95, 2.1), [False, True]),
        pytest.param((1.95, 1.1, 2.0), [True, True], marks=pytest.mark.slow),
    ],
)
def test_derivatives_are_those_of_finite_differences(orders, passes) -> None:
    rng = np.random.default_rng(1)

    def experiment(m: int, every: int):
        u = 8 * np.sin(0.012 * np.arange(m)) + 1.3 * rng.normal(size=m) + 0.2
        samples = rng.normal(size=(2, m // every + 1))
        record = (0.004, np.stack([0 * u, 0 * u, u]), None)
        low_pass = None
        if passes is not None:
            low_pass = (_core.filter_series([(150.0, 0.0)], [(1.0, 2.0), (22.0, 1.0), (150.0, 0.0)], m, 0.004), passes)
        return {
            "record": record,
            "pulses_per_sample": every,
            "samples": samples,
            "filter": low_pass,
            "weights": [1.3, 5.0],
            "signals": [(None, False)] * 3,
            "robust_weights": None,
            "sample_times": None,
        }

    runs = [experiment(400, 1), experiment(600, 2)]

    def order(constant: float, free: int | None = None):
        return constant, [1.0 if k == free else 0.0 for k in range(3)]

    # Free orders are alpha and gamma of the hub and that of the hub in the link; the link's stiffness is a product.
    laws = [
        (
            0,
            order(0.0, 0),
            [(1, order(0.2), (1.0, [(0, 1)])), (0, order(0.0, 1), (-1.0, [(1, 1)])), (2, order(0.0), (1.0, [(2, 1)]))],
        ),
        (
            1,
            order(2.0),
            [
                (0, order(0.0, 2), (-1.0, [])),
                (1, order(0.2), (-1.0, [(0, 1), (3, 1)])),
                (1, order(0.8), (-1.0, [(4, 1)])),
            ],
        ),
    ]
    # What a filter of the second order holds are two states more of each output that passes it.
    each = 6 if passes is None else 6 + 2 * sum(passes)
    count, states = 9, 2 * each
    begun = (True, [], 1) if passes is None else (True, [], 1, 2)
    law = [(1.0, [(5, 1)]), (0.4, [(5, 1)]), (0.2, [])]

    problem = NumberedProblem(laws, [(0, law)], [(1.05, 2.0), (0.0, 1.5), (0.0, 2.5)], begun)

    def at(point):
        return problem.evaluate(runs, point[:count], [point[count : count + each], point[count + each :]])

    plain = [0.02, -0.3, 0.01, 0.2, 0.4, 0.1, -0.05, 0.1, 0.02, -0.3, 0.3, -0.1]
    starts = [v for run in (plain[:6], plain[6:]) for v in (*run, *rng.normal(scale=0.01, size=each - 6))]
    point = np.array([*orders, 30.0, 1.5, 1.2, 3.0, 2.0, 3.0, *starts])
    assert point.size == count + states
    assert max(friction.slope_errors(at, point, count)) < 2e-6


# --------------------------------------------------------------------------------------------------------------- words


def test_several_equations_with_friction_follow_each_other() -> None:
    structure = ftlm.equation(WORDS)
    assert structure.coupling == "simulated"
    assert ftlm.equation(WORDS.replace(" - fc*sign(D x)", "")).coupling == "measured"
    assert structure.friction_equations == (0,)
    turned = ftlm.equation("; ".join(reversed(WORDS.split("; "))))
    assert turned.friction_equations == (1,)
    t = np.arange(401) * 0.01
    run = run_of(force(t), 0 * t, 0 * t, 0.01)
    first = ftlm.Model(ftlm.equation(WORDS, fixed={**TRUTH, "fc": 4.0})).simulate(run)
    second = ftlm.Model(ftlm.equation("; ".join(reversed(WORDS.split("; "))), fixed={**TRUTH, "fc": 4.0})).simulate(run)
    for name in ("x", "q"):
        np.testing.assert_allclose(first[name], second[name], atol=1e-10)
    # Against events, by the natural call.
    angles, _ = friction.hub_and_link(force, t, HUB, LINK, 4.0)
    for name, exact in zip(("x", "q"), angles, strict=True):
        assert np.max(np.abs(first[name] - exact)) < 1e-3 * np.max(np.abs(exact))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: ftlm.equation(WORDS, coupling="measured"), "coupling='simulated'"),
        (lambda: ftlm.equation(WORDS.replace("g u", "g D^2 u")), "order 2 of u is not below alpha"),
        (lambda: ftlm.flexible_link(form="published", coupling="simulated", friction=True), "form='lagrange'"),
    ],
)
def test_what_is_not_followed_is_refused(make, said: str) -> None:
    with pytest.raises(ModelError, match=said):
        make()


@pytest.mark.parametrize("cross", [False, "torques", "inertial"])
def test_hubs_keep_their_friction_beside_the_other_stage(cross) -> None:
    structure = ftlm.flexible_link(stage="both", coupling="simulated", friction=True, cross_stage=cross)
    assert structure.friction_equations == (0, 2)


def test_friction_is_named() -> None:
    named = ftlm.flexible_link(stage="both", coupling="simulated", friction="coulomb")
    assert str(named) == str(ftlm.flexible_link(stage="both", coupling="simulated", friction=True))
    near = ftlm.flexible_link(stage="both", coupling="simulated", friction="stribeck")
    assert [f.names for e in near.equations if (f := e.friction) is not None] == [
        ("fc1", "fs1", "vs1"),
        ("fc2", "fs2", "vs2"),
    ]
    # The hub holds at rest what it takes at speed and more, until 0.5 A push it away.
    values = {"a1": 628.0, "b1": -62.0, "d1": 2.0, "g1": 140.0, "a2": -235.5, "d2": -0.75}
    t = np.arange(201) * 0.005
    run = ftlm.Run.from_arrays(
        step=0.005, inputs={"I1": 0.5 * t}, outputs={"theta11": 0 * t, "theta12": 0 * t}, intersample={"I1": "foh"}
    )
    moved = []
    for rubs in ({"fc1": 20.0}, {"fc1": 20.0, "fs1": 15.0, "vs1": 0.05}):
        structure = ftlm.flexible_link(coupling="simulated", friction="coulomb" if len(rubs) == 1 else "stribeck")
        orders = dict.fromkeys(structure.order_names, 1.0) | {"alpha1": 2.0, "beta2": 0.0}
        model = ftlm.Model(structure.with_orders(orders).with_coefficients({**values, **rubs}), orders=orders)
        moved.append(t[np.argmax(np.abs(model.simulate(run)["theta11"]) > 1e-6)])
    assert moved == pytest.approx([20 / 140 / 0.5, 35 / 140 / 0.5], abs=0.02)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"friction": "colomb"}, "friction = 'colomb' is not known; use False, 'coulomb' or 'stribeck'"),
        ({"friction": 2}, "friction = 2 is not known"),
        ({"friction": "stribeck"}, "requires the simulated velocity; use coupling='simulated'"),
        ({"hub": "no"}, "hub = 'no' is neither True nor False"),
        ({"cross_damping": 1}, "cross_damping = 1 is neither True nor False"),
        ({"cross_sensitivity": "inertial"}, "cross_sensitivity = 'inertial' is neither True nor False"),
    ],
)
def test_words_that_mean_nothing_are_refused_by_the_link(options, said: str) -> None:
    with pytest.raises(ModelError, match=said):
        ftlm.flexible_link(**options)


def test_what_is_carried_does_not_turn_friction_round() -> None:
    words = "D^2 x = c D^2 y + u - fx*sign(D x); D^2 y = D^2 x - 9 y - 1 D y"
    t = np.arange(101) * 0.02
    run = ftlm.Run.from_arrays(step=0.02, inputs={"u": force(t)}, outputs={"x": 0 * t, "y": 0 * t})
    brakes = ftlm.Model(ftlm.equation(words, fixed={"c": -0.5, "fx": 1.0})).simulate(run)
    slides = ftlm.Model(ftlm.equation(words, fixed={"c": -0.5, "fx": 1e-4})).simulate(run)
    assert np.ptp(brakes["x"]) < np.ptp(slides["x"])
    # 1 / (1 - 2) of a force on the body is what moves it.
    with pytest.raises(ModelError, match="a force on one moves it against the force"):
        ftlm.Model(ftlm.equation(words, fixed={"c": 2.0, "fx": 1.0})).simulate(run)


def test_highest_orders_that_cancel_are_refused() -> None:
    three = "D^2 x = q + u - 1*sign(D x); D^2 q = D^2 p - q; D^2 p = D^2 q - 2 p + x"
    t = np.arange(101) * 0.01
    run = ftlm.Run.from_arrays(step=0.01, inputs={"u": force(t)}, outputs={"x": 0 * t, "q": 0 * t, "p": 0 * t})
    with pytest.raises(ModelError, match="leading matrix of the equations is singular"):
        ftlm.Model(ftlm.equation(three)).simulate(run)


def test_a_file_keeps_it(tmp_path) -> None:
    structure = ftlm.flexible_link(coupling="simulated", friction=True)
    orders = {"alpha1": 1.95, "gamma1": 0.97, "beta2": 0.05, "mu2": 0.9}
    values = {"a1": 628.0, "b1": -62.0, "d1": 2.0, "g1": 140.0, "fc1": 12.0, "a2": -235.5, "d2": -0.75}
    model = ftlm.Model(structure.with_orders(orders).with_coefficients(values), orders=orders)
    again = ftlm.load_model(model.save(tmp_path / "arm.json"))
    t = np.arange(301) * 0.008
    run = ftlm.Run.from_arrays(
        step=0.008, inputs={"I1": 0.5 * np.sign(np.sin(3.0 * t))}, outputs={"theta11": 0 * t, "theta12": 0 * t}
    )
    there, back = model.simulate(run), again.simulate(run)
    assert np.ptp(there["theta11"]) > 0.05
    for name in ("theta11", "theta12"):
        assert np.array_equal(there[name], back[name])
    assert again.compare(there).fit["theta12"] > 99.99


# ----------------------------------------------------------------------------------------------------------- estimates


def sampled_arm(seed: int, *, offset: float = 0.0, start=(0.0, 0.0, 0.0, 0.0)) -> ftlm.Run:
    """The hub and its link under two sinusoids, between events, with 0.3 % of white noise."""
    rng = np.random.default_rng(seed)
    times, phases = np.arange(601) * 0.01, rng.uniform(0.0, 2.0 * np.pi, 2)

    def pulled(t):
        return 6.0 * np.sin(2.1 * t + phases[0]) + 3.0 * np.sin(5.3 * t + phases[1])

    angles, _ = friction.hub_and_link(lambda t: pulled(t) + offset, times, HUB, LINK, 4.0, start=start)
    angles += 0.003 * np.std(angles, axis=1)[:, None] * rng.standard_normal(angles.shape)
    return run_of(pulled(times), *angles, 0.01, f"arm {seed}")


def near(found, truth) -> None:
    for name, value in truth.items():
        assert abs(found.coefficients[name] - value) < 4.0 * found.standard_errors[name], name


@pytest.mark.parametrize("seed", [4, pytest.param(6, marks=pytest.mark.slow)])
def test_both_bodies_are_recovered(seed: int) -> None:
    found = ftlm.identify(sampled_arm(seed), ftlm.equation(WORDS, initial="rest"), threads=1)
    near(found, {**TRUTH, "fc": 4.0})
    assert found.intervals["fc"][1] - found.intervals["fc"][0] < 0.02
    assert min(found.fit.values()) > 99.5
    assert found.warnings == ()


@pytest.mark.slow
def test_several_runs_in_motion_with_offsets() -> None:
    runs = [
        sampled_arm(0, offset=0.5, start=(0.2, 0.8, 0.02, -0.1)),
        sampled_arm(1, offset=-0.3, start=(0.0, 0.0, 0.03, 0.0)),
    ]
    found = ftlm.identify(runs, ftlm.equation(WORDS, initial="caputo", offset="constant"), threads=1)
    near(found, {**TRUTH, "fc": 4.0})
    np.testing.assert_allclose([o["x"]["constant"] for o in found.comparison.offsets], [0.5, -0.3], atol=0.02)


@pytest.mark.slow
def test_the_arm_is_identified_by_the_natural_call() -> None:
    orders = {"alpha1": 1.95, "gamma1": 0.95, "beta2": 0.08, "mu2": 0.85}
    free = {"a1": 628.0, "b1": -62.0, "d1": 2.0, "g1": 140.0, "fc1": 12.0, "j1": 0.375}
    structure = ftlm.flexible_link(coupling="simulated", friction=True)
    values = {**free, "a2": -628.0 * 0.375, "d2": -2.0 * 0.375}
    model = ftlm.Model(
        structure.with_orders(orders).with_coefficients({n: values[n] for n in structure.coefficient_names}),
        orders=orders,
    )
    t, rng = np.arange(1501) * 0.004, np.random.default_rng(0)
    current = 0.35 * np.sign(np.sin(2.1 * t)) + 0.3 * np.sin(5.3 * t + 0.4)
    zeros = {"theta11": 0 * t, "theta12": 0 * t}
    clean = model.simulate(ftlm.Run.from_arrays(step=0.004, inputs={"I1": current}, outputs=zeros))
    noisy = {n: clean[n] + 0.003 * np.std(clean[n]) * rng.standard_normal(t.size) for n in zeros}
    run = ftlm.Run.from_arrays(step=0.004, inputs={"I1": current}, outputs=noisy)
    found = ftlm.identify(run, structure, threads=1).joint
    for name, value in zip(found.names, found.values.tolist(), strict=True):
        assert abs(value - {**orders, **free}[name]) < 4.0 * found.standard_errors[name], name


def test_a_hub_that_never_moves_is_refused() -> None:
    rng, t = np.random.default_rng(0), np.arange(400) * 0.01
    run = run_of(np.sin(t), 1e-3 * rng.standard_normal(400), 0.1 * np.sin(9.0 * t), 0.01)
    with pytest.raises(DataError, match="x never moves"):
        ftlm.identify(run, ftlm.equation(WORDS, initial="caputo"))


@pytest.mark.slow
def test_a_hub_that_slides_one_way_does_not_tell_friction_from_an_offset() -> None:
    times = np.arange(301) * 0.01

    def pulled(t):
        return 9.0 + 3.0 * np.sin(4.0 * t)

    angles, v = friction.hub_and_link(pulled, times, HUB, LINK, 3.0)
    assert np.all(v >= 0.0)
    angles += 1e-3 * np.random.default_rng(0).standard_normal(angles.shape)
    words = WORDS.replace("a q + d D q - b D x", "30 q + 0.4 D q - 1.5 D x").replace("k q - e D q", "90 q - 1.2 D q")
    found = ftlm.identify(
        run_of(pulled(times), *angles, 0.01), ftlm.equation(words, initial="rest", offset="constant"), threads=1
    )
    assert any(f.code == "friction_unsigned" and f.output == "x" for f in found.findings)
