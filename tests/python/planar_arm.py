"""The planar arm from its kinetic energy, by naive ways: event by event where orders are whole, else step by step.

Nothing of the package is used but the numbers of :class:`ftlm.rig.ArmParameters`, read as inertias, stiffnesses and
torques with J_12, all that link 1 carries, for unit.
"""

from __future__ import annotations

import itertools

import numpy as np
from scipy.integrate import solve_ivp


class Planar:
    """Inertias, forces and friction of the four angles theta11, theta12, theta21, theta22."""

    def __init__(self, arm):
        first, second, k = arm.stage1, arm.stage2, arm.coupling
        j11, j21 = first.r - 1.0, arm.inertia_ratio
        j22 = j21 / (second.r - 1.0)
        lever = arm.link_coupling_ratio * j22
        own = 1.0 - k**2 * (arm.rotating_inertia_fraction * j21 + j22 + 2.0 * lever)
        # Rates that the energy is quadratic in, by the rates of the angles: of hub 1, of link 1, of what of hub 2 turns
        # with link 1 and of its rotor, which does not, of link 2.
        link1, hub2 = np.array([1.0, 1.0, 0.0, 0.0]), np.array([k, k, 1.0, 0.0])
        link2 = hub2 + np.array([0.0, 0.0, 0.0, 1.0])
        self.inertia = (
            j11 * np.outer([1, 0, 0, 0], [1, 0, 0, 0])
            + own * np.outer(link1, link1)
            + arm.rotating_inertia_fraction * j21 * np.outer(hub2, hub2)
            + (1.0 - arm.rotating_inertia_fraction) * j21 * np.outer([0, 0, 1, 0], [0, 0, 1, 0])
            + j22 * np.outer(link2, link2)
            + k * lever * (np.outer(link1, link2) + np.outer(link2, link1))
        )
        self.stiffness = np.array([0.0, first.a * j11, 0.0, second.a * j21])
        self.damping = np.array([-first.b * j11, first.d * j11, -second.b * j21, second.d * j21])
        self.torque = np.array([first.g * j11, second.g * j21])
        self.friction = self.torque * [first.coulomb, second.coulomb]
        self.rates = np.array([first.gamma, first.mu, second.gamma, second.mu])
        self.elastic = np.array([0.0, first.beta, 0.0, second.beta])

    # ------------------------------------------------------------------------------------------------------------------
    # Whole orders

    def forces(self, state, current):
        """All but friction."""
        out = -self.stiffness * state[:4] - self.damping * state[4:]
        out[[0, 2]] += self.torque * current
        return out

    def acceleration(self, state, current, mode):
        """Of all angles, and what holds the hubs that stick; mode 0 sticks, else the sign of the hub's velocity."""
        force = self.forces(state, current)
        locked = [2 * k for k in (0, 1) if mode[k] == 0]
        moves = [i for i in range(4) if i not in locked]
        for k in (0, 1):
            force[2 * k] -= mode[k] * self.friction[k]
        out = np.zeros(4)
        out[moves] = np.linalg.solve(self.inertia[np.ix_(moves, moves)], force[moves])
        return out, force - self.inertia @ out

    def settled(self, state, current, mode):
        """What hubs at rest do: the one choice that its own forces agree with."""
        mode = list(mode)
        rest = [k for k in (0, 1) if mode[k] == 0 or state[4 + 2 * k] == 0.0]
        for choice in itertools.product((0, 1, -1), repeat=len(rest)):
            for k, value in zip(rest, choice, strict=True):
                mode[k] = value
            out, forces = self.acceleration(state, current, mode)
            if all(
                abs(forces[2 * k]) <= self.friction[k] * (1 + 1e-12) if mode[k] == 0 else out[2 * k] * mode[k] > 0.0
                for k in rest
            ):
                return mode
        raise AssertionError("no choice agrees with its forces")

    def by_events(self, currents, step):
        """Angles at the samples of held currents, and how often each hub came to rest and left it."""
        state, mode, changes = np.zeros(8), [0, 0], [0, 0]
        rows = [state[:4].copy()]
        # Currents that stay are integrated in one go.
        edges = [0, *(np.flatnonzero(np.any(np.diff(currents, axis=0) != 0.0, axis=1)) + 1), len(currents) - 1]
        for first, last in itertools.pairwise(edges):
            if first == last:
                continue
            current, now, end = currents[first], first * step, last * step
            samples = np.arange(first + 1, last + 1) * step
            mode = self.settled(state, current, mode)
            while len(samples):
                current_mode = tuple(mode)

                def flow(_, x, mode_now=current_mode, current=current):
                    return np.concatenate([x[4:], self.acceleration(x, current, mode_now)[0]])

                def event(k, mode_now=current_mode, current=current):
                    def at(_, x):
                        if mode_now[k] == 0:
                            return self.friction[k] - abs(self.acceleration(x, current, mode_now)[1][2 * k])
                        return x[4 + 2 * k] * mode_now[k]

                    at.terminal, at.direction = True, -1.0
                    return at

                solution = solve_ivp(
                    flow, (now, end), state, events=[event(0), event(1)], rtol=1e-10, atol=1e-13, dense_output=True
                )
                inside = samples <= solution.t[-1] + 1e-12
                if inside.any():
                    rows += list(solution.sol(samples[inside]).T[:, :4])
                samples = samples[~inside]
                state, now = solution.y[:, -1].copy(), solution.t[-1]
                for k in (0, 1):
                    if len(solution.t_events[k]) and mode[k] != 0:
                        state[4 + 2 * k] = 0.0
                    if len(solution.t_events[k]):
                        changes[k] += 1
                if solution.status == 1:
                    events = [k for k in (0, 1) if len(solution.t_events[k])]
                    for k in events:
                        if current_mode[k] == 0:
                            # It leaves in the direction in which it was pushed.
                            mode[k] = int(np.sign(self.acceleration(state, current, current_mode)[1][2 * k]))
                            state[4 + 2 * k] = 1e-14 * mode[k]
                        else:
                            mode[k] = 0
                    mode = self.settled(state, current, mode)
        return np.array(rows), changes

    # ------------------------------------------------------------------------------------------------------------------
    # Any orders

    def by_steps(self, currents, step):
        """Angles by implicit sums over the whole past after Gruenwald and Letnikov, friction by trying all its ways."""
        n = len(currents)
        past = np.zeros((n, 4))
        entries = []
        for i, j in itertools.product(range(4), range(4)):
            if self.inertia[i, j] != 0.0:
                entries.append((i, j, self.inertia[i, j], 2.0 - self.rates[i] + self.rates[j]))
        for i in range(4):
            entries.append((i, i, self.damping[i], self.rates[i]))
            entries.append((i, i, self.stiffness[i], self.elastic[i]))
        weights = []
        matrix = np.zeros((4, 4))
        for i, j, c, order in entries:
            w = np.cumprod(np.concatenate([[1.0], 1.0 - (order + 1.0) / np.arange(1, n)])) * step**-order
            weights.append(w)
            matrix[i, j] += c * w[0]
        inverse = np.linalg.inv(matrix)
        for m in range(1, n):
            right = np.zeros(4)
            # Held currents: what acts up to this instant is the command of the row before.
            right[[0, 2]] += self.torque * currents[m - 1]
            for (i, j, c, _), w in zip(entries, weights, strict=True):
                right[i] -= c * (w[m:0:-1] @ past[:m, j])
            for choice in sorted(itertools.product((0, 1, -1), repeat=2), key=lambda c: np.abs(c).sum()):
                locked = [2 * k for k in (0, 1) if choice[k] == 0]
                force = right.copy()
                for k in (0, 1):
                    force[2 * k] -= choice[k] * self.friction[k]
                # Angles of held hubs stay; what holds them takes their place among the unknowns.
                system, rhs = matrix.copy(), force.copy()
                for h in locked:
                    rhs -= system[:, h] * past[m - 1, h]
                    system[:, h] = 0.0
                    system[h, h] = 1.0
                solution = np.linalg.solve(system, rhs) if locked else inverse @ force
                angles = solution.copy()
                angles[locked] = past[m - 1, locked]
                change = angles - past[m - 1]
                if all(
                    abs(solution[2 * k]) <= self.friction[k] * (1 + 1e-9)
                    if choice[k] == 0
                    else change[2 * k] * choice[k] > 0.0
                    for k in (0, 1)
                ):
                    past[m] = angles
                    break
            else:
                raise AssertionError("no choice agrees with its forces")
        return past
