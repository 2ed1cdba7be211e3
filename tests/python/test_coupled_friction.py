"""A hub that sticks with a link that hangs on it: both from the current alone, against events; words; estimates."""

from __future__ import annotations

from math import gamma

import numpy as np
import pytest

import friction
import ftlm
from ftlm import _core
from ftlm.errors import DataError, ModelError

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
    return _core.friction_respond(record, model or equations(), sticks, law, [list(p) for p in powers])


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


def run_of(u, x, q, step, name="run", *, held=False):
    return ftlm.Run.from_arrays(
        step=step, inputs={"u": u}, outputs={"x": x, "q": q}, intersample={"u": "zoh" if held else "foh"}, name=name
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
    # The second order in the step, events and all: a sixteenth for a quarter of it, up to where in a pulse each one lies.
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
    [(equations(), 0, 0.3), (arm(2.15), 0, 0.0), (arm(1.9), 0, 0.3), (arm(2.0), 0, 0.3), (CHAIN, 0, 0.3), (CHAIN, 1, 0.3)],
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


@pytest.mark.parametrize("orders", [(1.9, 0.95, 2.1), (1.8, 0.9, 1.95), (1.95, 1.1, 2.0)])
def test_derivatives_are_those_of_finite_differences(orders) -> None:
    rng = np.random.default_rng(1)

    def experiment(m: int, every: int):
        u = 8 * np.sin(0.012 * np.arange(m)) + 1.3 * rng.normal(size=m) + 0.2
        samples = rng.normal(size=(2, m // every + 1))
        record = (0.004, np.stack([0 * u, 0 * u, u]), None)
        return (record, every, samples, None, [1.3, 5.0], [(None, False)] * 3, None, None)

    runs = [experiment(400, 1), experiment(600, 2)]

    def order(constant: float, free: int | None = None):
        return constant, [1.0 if k == free else 0.0 for k in range(3)]

    # Free orders are alpha and gamma of the hub and that of the hub in the link; the link's stiffness is a product.
    laws = [
        (0, order(0.0, 0), [(1, order(0.2), (1.0, [(0, 1)])), (0, order(0.0, 1), (-1.0, [(1, 1)])),
                            (2, order(0.0), (1.0, [(2, 1)]))]),
        (1, order(2.0), [(0, order(0.0, 2), (-1.0, [])), (1, order(0.2), (-1.0, [(0, 1), (3, 1)])),
                         (1, order(0.8), (-1.0, [(4, 1)]))]),
    ]  # fmt: skip
    count, states = 9, 2 * 6
    law = [(1.0, [(5, 1)]), (0.4, [(5, 1)]), (0.2, [])]

    def at(point):
        return _core.friction_error(
            runs, laws, 0, law, [(1.05, 2.0), (0.0, 1.5), (0.0, 2.5)], ["plain"] * 6, (True, [], 1), list(point[:3]),
            list(point[3:count]), [], [list(point[count : count + 6]), list(point[count + 6 :])], 1, 1e-9,
        )  # fmt: skip

    starts = [0.02, -0.3, 0.01, 0.2, 0.4, 0.1, -0.05, 0.1, 0.02, -0.3, 0.3, -0.1]
    point = np.array([*orders, 30.0, 1.5, 1.2, 3.0, 2.0, 3.0, *starts])
    assert point.size == count + states
    found = np.asarray(at(point)["jacobian"])
    columns = []
    for i in range(point.size):
        step = np.zeros(point.size)
        step[i] = 1e-6
        up, down = (np.asarray(at(point + s)["residuals"]) for s in (step, -step))
        columns.append((up - down) / 2e-6)
    basis = np.linalg.qr(np.array(columns[count:]).T)[0]
    for k in range(count):
        expected = columns[k] - basis @ (basis.T @ columns[k])
        assert np.linalg.norm(found[k] - expected) < 2e-6 * np.linalg.norm(columns[k]), k
