"""A body on dry friction, computed slowly: sums over the whole past written out, one implicit step an instant.

Nothing here imports the package. D^alpha y = sum of c D^nu y + F(t) - (f + fs exp(-(Dy/vs)^2)) sgn(Dy), 1 < alpha <= 2,
Caputo's derivatives, sgn set-valued at rest. In the velocity v = Dy the derivatives are those of Grünwald and Letnikov,
of first order in the step, and every step solves its own scalar inclusion: what is left of all other forces beyond f
moves the body.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise, product

import numpy as np
from scipy.integrate import solve_ivp


def weights(order: float, count: int) -> np.ndarray:
    """(-1)^j C(order, j): a derivative for a positive order, an integral for a negative one."""
    out = np.ones(count)
    for j in range(1, count):
        out[j] = out[j - 1] * (1.0 - (order + 1.0) / j)
    return out


def naive_run(
    force: np.ndarray,
    step: float,
    alpha: float,
    own: Sequence[tuple[float, float]],
    friction: float,
    level: float = 0.0,
    rate: float = 0.0,
    more: float = 0.0,
    speed: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity at the instants of `force`; `own` are (coefficient, order) with orders in [0, alpha).

    What friction has `more` near rest is that of the velocity an instant ago.
    """
    count = force.size
    v, y = np.zeros(count), np.full(count, level)
    v[0] = rate
    inertia = weights(alpha - 1.0, count) * step ** (1.0 - alpha)
    damping = [(c, nu, weights(nu - 1.0, count) * step ** (1.0 - nu)) for c, nu in own]
    for k in range(1, count):
        # Everything but this instant's velocity and friction; Caputo's derivative of the velocity does not see `rate`.
        momentum = force[k] - inertia[1 : k + 1] @ (v[k - 1 :: -1][:k] - rate) + inertia[0] * rate
        gain = inertia[0]
        for c, nu, w in damping:
            if nu == 0:
                momentum += c * y[k - 1]
                gain -= c * step
            elif nu < 1:
                momentum += c * (w[1:k] @ v[k - 1 : 0 : -1])
                gain -= c * w[0]
            else:
                shift = rate if nu > 1 else 0.0
                momentum += c * (w[1 : k + 1] @ (v[k - 1 :: -1][:k] - shift) - w[0] * shift)
                gain -= c * w[0]
        holds = friction + more * np.exp(-((v[k - 1] / speed) ** 2))
        v[k] = np.sign(momentum) * max(abs(momentum) - holds, 0.0) / gain
        y[k] = y[k - 1] + step * v[k]
    return y, v


def between_events(
    force: Callable[[float], float],
    times: np.ndarray,
    viscous: float,
    friction: float,
    rate: float = 0.0,
    more: float = 0.0,
    speed: float = 1.0,
    spring: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Mass of 1 with viscous, Coulomb and Stribeck friction, integrated between its events: stops, turns, breaks away.

    A spring of this stiffness holds it at 0.
    """
    most = friction + more
    state, now, end = np.array([0.0, rate]), 0.0, float(times[-1])
    y, v = np.zeros(times.size), np.zeros(times.size)
    v[0] = rate
    side = np.sign(rate)
    while now < end:
        if side == 0:
            fine = np.linspace(now, end, 20001)
            away = np.flatnonzero(np.abs([force(t) - spring * state[0] for t in fine]) > most)
            until = end if away.size == 0 else float(fine[away[0]])
            if away.size and away[0] > 0:
                low, high = float(fine[away[0] - 1]), until
                for _ in range(60):
                    middle = 0.5 * (low + high)
                    low, high = (low, middle) if abs(force(middle) - spring * state[0]) > most else (middle, high)
                until = high
            is_inside = (times >= now) & (times <= until)
            y[is_inside], v[is_inside] = state[0], 0.0
            now, side = until, np.sign(force(until) - spring * state[0]) if until < end else 0.0
            if until >= end:
                break
        s = side

        def motion(t: float, x: np.ndarray, s: float = s) -> list[float]:
            return [
                x[1],
                force(t) - spring * x[0] - viscous * x[1] - s * (friction + more * np.exp(-((x[1] / speed) ** 2))),
            ]

        def rest(t: float, x: np.ndarray, s: float = s, start_time: float = now) -> float:
            return x[1] if t > start_time + 1e-9 else s

        rest.terminal, rest.direction = True, -s
        inside = times[(times > now) & (times <= end)]
        solution = solve_ivp(
            motion, (now, end), state, events=rest, rtol=1e-10, atol=1e-12, dense_output=True, max_step=(end / 500)
        )
        reached = inside[inside <= solution.t[-1]]
        if reached.size:
            at = [np.searchsorted(times, t) for t in reached]
            y[at], v[at] = solution.sol(reached)
        now, state = float(solution.t[-1]), solution.y[:, -1].copy()
        if solution.status == 1:
            state[1] = 0.0
            pull = force(now) - spring * state[0]
            side = 0.0 if abs(pull) <= most else float(np.sign(pull))
    return y, v


def regularised(
    force: Callable[[float], float], times: np.ndarray, viscous: float, friction: float, width: float, rate: float = 0.0
) -> np.ndarray:
    """Position of the same mass where sgn is tanh(v / width)."""
    solution = solve_ivp(
        lambda t, x: [x[1], force(t) - viscous * x[1] - friction * np.tanh(x[1] / width)],
        (0.0, float(times[-1])),
        [0.0, rate],
        method="LSODA",
        t_eval=times,
        rtol=1e-9,
        atol=1e-11,
        max_step=float(times[-1]) / 2000,
    )
    return np.asarray(solution.y[0])


def exact_cart(
    force: np.ndarray, step: float, viscous: float, friction: float, level: float = 0.0, rate: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity of a mass of 1 at the instants of a force that holds in between, to rounding.

    Between its events the velocity is an exponential, so the instants of stops and turns are logarithms.
    """
    y, v = np.zeros(force.size), np.zeros(force.size)
    y[0], v[0] = level, rate
    x, w = level, rate
    for k in range(force.size - 1):
        remaining = step
        while remaining > 0:
            side = np.sign(w)
            if side == 0:
                if abs(force[k]) <= friction:
                    break
                side = np.sign(force[k])
            final = (force[k] - side * friction) / viscous
            duration = remaining
            if w != 0 and final * side < 0:
                duration = min(remaining, np.log((w - final) / -final) / viscous)
            decay = np.exp(-viscous * duration)
            x += final * duration + (w - final) * (1.0 - decay) / viscous
            w = 0.0 if duration < remaining else final + (w - final) * decay
            remaining -= duration
        y[k + 1], v[k + 1] = x, w
    return y, v


def hub_and_link(
    force: Callable[[float], float],
    times: np.ndarray,
    hub: tuple[float, float, float],
    link: tuple[float, float],
    friction: float,
    more: float = 0.0,
    speed: float = 1.0,
    start: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
    low_pass: tuple[float, float] | None = None,
    filter_state: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
) -> tuple[np.ndarray, np.ndarray]:
    """A hub on dry friction that carries an elastic link, between its events: angles, and the hub's velocity.

    With a low pass of second order (corner [rad/s], damping ratio) two more rows are both angles behind it, each with
    two states of its own that start at `filter_state`.

    D^2 x = a q + d Dq + b Dx + F - (f + fs exp(-(Dx/vs)^2)) sgn(Dx), D^2 q = - D^2 x - k q - c Dq, with (a, d, b) of
    the hub and (k, c) of the link; the start is (x, Dx, q, Dq). Angles have shape (2, times). While the hub rests
    the link rings by itself.
    """
    (a, d, b), (k, c) = hub, link
    most, now, end = friction + more, 0.0, float(times[-1])
    state = np.array([*start, *filter_state] if low_pass else start, dtype=float)
    columns = [0, 2, 4, 6] if low_pass else [0, 2]
    angles, rate = np.zeros((len(columns), times.size)), np.zeros(times.size)
    angles[:, 0], rate[0] = state[columns], state[1]

    def behind(x: np.ndarray) -> list[float]:
        if low_pass is None:
            return []
        corner, damping = low_pass
        pairs = ((x[0], x[4], x[5]), (x[2], x[6], x[7]))
        return [v for y, s, ds in pairs for v in (ds, corner**2 * (y - s) - 2.0 * damping * corner * ds)]

    def pull(t: float, x: np.ndarray) -> float:
        return a * x[2] + d * x[3] + force(t)

    def side_at_rest(t: float, x: np.ndarray) -> float:
        return float(np.sign(pull(t, x))) if abs(pull(t, x)) > most else 0.0

    side = float(np.sign(state[1])) or side_at_rest(0.0, state)
    while now < end:

        def motion(t: float, x: np.ndarray, s: float = side) -> list[float]:
            away = 0.0
            if s:
                away = pull(t, x) + b * x[1] - s * (friction + more * np.exp(-((x[1] / speed) ** 2)))
            return [x[1] if s else 0.0, away, x[3], -away - k * x[2] - c * x[3], *behind(x)]

        def event(t: float, x: np.ndarray, s: float = side, start_time: float = now) -> float:
            if s:
                return s * x[1] if t > start_time + 1e-9 else 1.0
            return abs(pull(t, x)) - most if t > start_time + 1e-9 else -1.0

        event.terminal, event.direction = True, -1.0 if side else 1.0
        solution = solve_ivp(
            motion,
            (now, end),
            state,
            events=event,
            rtol=1e-11,
            atol=1e-13,
            method="DOP853",
            dense_output=True,
            max_step=end / 1000,
        )
        inside = np.flatnonzero((times > now) & (times <= solution.t[-1]))
        if inside.size:
            there = solution.sol(times[inside])
            angles[:, inside], rate[inside] = there[columns], there[1] if side else 0.0
        now, state = float(solution.t[-1]), solution.y[:, -1].copy()
        if solution.status == 1:
            if side:
                state[1] = 0.0
                side = side_at_rest(now, state)
            else:
                side = float(np.sign(pull(now, state)))
    return angles, rate


def bodies(
    force: Callable[[float], Sequence[float]],
    times: np.ndarray,
    springs: Sequence[Sequence[float]],
    dampers: Sequence[Sequence[float]],
    friction: Sequence[tuple[float, float, float] | None],
    start: Sequence[float] | None = None,
    width: float | None = None,
    carried: Sequence[Sequence[float]] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Bodies that pull at each other, some on dry friction, between their events: positions, velocities, (n, times).

    D^2 y_i = sum_j (springs_ij y_j + dampers_ij Dy_j + carried_ij D^2 y_j) + F_i - (f_i + fs_i exp(-(Dy_i/vs_i)^2))
    sgn(Dy_i), no friction where it is None; the start is (y_1, Dy_1, y_2, …). Each way to slide to a side or rest is an
    equation of its own; of those that bodies at rest may go on in, the one is taken whose accelerations and forces
    agree with it. With a width the sign is tanh(Dy / width), and no body ever rests.
    """
    k, d, end, n = np.asarray(springs), np.asarray(dampers), float(times[-1]), len(friction)
    mass = np.eye(n) - (np.zeros((n, n)) if carried is None else np.asarray(carried))
    rough = [i for i in range(n) if friction[i] is not None]
    state, now = np.zeros(2 * n) if start is None else np.array(start, dtype=float), 0.0
    places, rates = np.zeros((n, times.size)), np.zeros((n, times.size))
    places[:, 0], rates[:, 0] = state[::2], state[1::2]

    def pull(t: float, x: np.ndarray) -> np.ndarray:
        return k @ x[::2] + d @ x[1::2] + np.asarray(force(t))

    def rubs(i: int, v: float) -> float:
        f, more, speed = friction[i]
        return f + more * float(np.exp(-((v / speed) ** 2)))

    def most(i: int) -> float:
        return friction[i][0] + friction[i][1]

    def moving(t: float, x: np.ndarray, sides: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """Accelerations, and the forces that hold what rests."""
        pulled = pull(t, x)
        for i in rough:
            pulled[i] -= sides[i] * rubs(i, x[2 * i + 1])
        free = [i for i in range(n) if i not in rough or sides[i]]
        a = np.zeros(n)
        a[free] = np.linalg.solve(mass[np.ix_(free, free)], pulled[free])
        return a, pulled - mass @ a

    if width is not None:

        def smooth(t: float, x: np.ndarray) -> np.ndarray:
            pulled = pull(t, x)
            for i in rough:
                pulled[i] -= rubs(i, x[2 * i + 1]) * np.tanh(x[2 * i + 1] / width)
            return np.stack([x[1::2], np.linalg.solve(mass, pulled)]).T.ravel()

        solution = solve_ivp(
            smooth, (0.0, end), state, method="LSODA", t_eval=times, rtol=1e-9, atol=1e-11, max_step=end / 2000
        )
        return solution.y[::2], solution.y[1::2]

    def on_from(t: float, x: np.ndarray, sides_known: dict[int, float]) -> list[float]:
        """The one way to go on: what moves goes on to its side, what rests stays or starts as forces say."""
        sides_known = {
            i: float(np.sign(x[2 * i + 1])) for i in range(n) if i not in rough or x[2 * i + 1]
        } | sides_known
        undecided = [i for i in range(n) if i not in sides_known]
        agree = []
        for ways in product((-1.0, 0.0, 1.0), repeat=len(undecided)):
            sides = sides_known | dict(zip(undecided, ways, strict=True))
            a, forces = moving(t, x, [sides[i] for i in range(n)])
            if all(a[i] * sides[i] > 0.0 if sides[i] else abs(forces[i]) <= most(i) for i in undecided):
                agree.append([sides[i] for i in range(n)])
        assert len(agree) == 1, agree
        return agree[0]

    sides = on_from(0.0, state, {})
    while now < end:

        def rested(x: np.ndarray, sides: Sequence[float] = tuple(sides)) -> np.ndarray:
            still = x.copy()
            still[[2 * i + 1 for i in rough if not sides[i]]] = 0.0
            return still

        def motion(t: float, x: np.ndarray, sides: Sequence[float] = tuple(sides)) -> np.ndarray:
            still = rested(x)
            return np.stack([still[1::2], moving(t, still, sides)[0]]).T.ravel()

        def event_of(i: int, start_time: float = now, sides: Sequence[float] = tuple(sides)):
            def event(t: float, x: np.ndarray) -> float:
                if sides[i]:
                    return sides[i] * x[2 * i + 1] if t > start_time + 1e-9 else 1.0
                return abs(float(moving(t, rested(x), sides)[1][i])) - most(i) if t > start_time + 1e-9 else -1.0

            event.terminal, event.direction = True, -1.0 if sides[i] else 1.0
            return event

        solution = solve_ivp(
            motion,
            (now, end),
            state,
            events=[event_of(i) for i in rough],
            rtol=1e-11,
            atol=1e-13,
            method="DOP853",
            dense_output=True,
            max_step=end / 500,
        )
        inside = np.flatnonzero((times > now) & (times <= solution.t[-1]))
        if inside.size:
            there = np.array([rested(column) for column in solution.sol(times[inside]).T]).T
            places[:, inside], rates[:, inside] = there[::2], there[1::2]
        now, state = float(solution.t[-1]), rested(solution.y[:, -1])
        if solution.status == 1:
            contacts = [i for i, when in zip(rough, solution.t_events, strict=True) if when.size]
            forces = moving(now, state, sides)[1]
            state[[2 * i + 1 for i in contacts if sides[i]]] = 0.0
            # At its limit a body lets go to the side to which it is pushed.
            sides = on_from(now, state, {i: float(np.sign(forces[i])) for i in contacts if not sides[i]})
    return places, rates


def two_records() -> tuple[list[tuple], tuple]:
    """Two driven records of noise, on grids of their own, and the law of a body, as the core takes them."""
    rng = np.random.default_rng(1)

    def experiment(m: int, every: int) -> dict:
        u = 2 * np.sin(0.012 * np.arange(m)) + 0.3 * rng.normal(size=m) + 0.2
        samples = rng.normal(size=(1, m // every + 1))
        return {
            "record": (0.004, np.stack([0 * u, u]), None),
            "pulses_per_sample": every,
            "samples": samples,
            "filter": None,
            "weights": [1.3],
            "signals": [(None, False)] * 2,
            "robust_weights": None,
            "sample_times": None,
        }

    law = (0, (0.0, [1.0, 0.0]), [(0, (0.0, [0.0, 1.0]), (-1.0, [(0, 1)])), (1, (0.0, [0.0, 0.0]), (1.0, [(1, 1)]))])
    return [experiment(400, 1), experiment(600, 2)], law


def slope_errors(at: Callable[[np.ndarray], dict], point: np.ndarray, numbers: int) -> list[float]:
    """How far the derivatives of `at` are from central differences, each as a share of the difference's norm.

    Behind the numbers, `point` holds initial terms, along which nothing is compared: the fit projects them out.
    """
    result = np.asarray(at(point)["jacobian"])
    columns = []
    for i in range(point.size):
        step = np.zeros(point.size)
        step[i] = 1e-6
        up, down = (np.asarray(at(point + s)["residuals"]) for s in (step, -step))
        columns.append((up - down) / 2e-6)
    states = np.linalg.qr(np.array(columns[numbers:]).T)[0]
    errors = []
    for k in range(numbers):
        expected = columns[k] - states @ (states.T @ columns[k])
        assert np.linalg.norm(expected) > 1e-6 * np.linalg.norm(columns[k]) > 0
        errors.append(float(np.linalg.norm(result[k] - expected) / np.linalg.norm(columns[k])))
    return errors


def delayed_motor(
    u: np.ndarray, step: float, delay: float, viscous: float, gain: float, friction: float
) -> tuple[np.ndarray, np.ndarray]:
    """Angle and speed of a motor from rest, D^2 y = -viscous D y + gain u(t - delay) - friction sgn(D y).

    u is held, and both are those at its samples. Between jumps, samples and stops the speed is an exponential, which
    is written out.
    """
    rows = u.size
    samples = np.arange(rows) * step
    edges = np.unique(np.round(np.concatenate([samples, samples + delay]), 12))
    edges = edges[edges <= samples[-1] + 1e-12]
    y, v = np.zeros(rows), np.zeros(rows)
    angle = speed = 0.0
    for begin, end in pairwise(edges):
        row = int(np.floor((begin - delay) / step + 1e-6))
        force, left = (gain * u[row] if row >= 0 else 0.0), end - begin
        while left > 1e-15 and (speed != 0.0 or abs(force) > friction):
            side = np.sign(speed if speed != 0.0 else force)
            limit, used = (force - side * friction) / viscous, left
            if speed * limit < 0.0:
                used = min(left, np.log(1.0 - speed / limit) / viscous)
            faded = np.exp(-viscous * used)
            angle += limit * used + (speed - limit) * (1.0 - faded) / viscous
            speed = 0.0 if used < left else limit + (speed - limit) * faded
            left -= used
        near = round(end / step)
        if abs(near * step - end) < 1e-9:
            y[near], v[near] = angle, speed
    return y, v
