"""Plants of known structure for the automatic selection, simulated without ftlm.

Integer orders are discretized by SciPy on a twentieth of the sampling interval, which resolves the delays exactly.
Fractional orders come from an inverse z-transform (`oracles.held_response`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import cont2discrete, lfilter

import ftlm
from oracles import held_response

#: Substeps of a sampling interval, and aliases of the inverse z-transform.
SUBSTEPS, ALIASES = 20, 600
#: Noise standard deviation by seed, relative to that of the output.
NOISE_RATIOS = (0.01, 0.02, 0.03)

Response = Callable[[np.ndarray, float], np.ndarray]


@dataclass(frozen=True)
class Plant:
    """A plant: step [s], samples, longest hold of the input in samples, response, and names of its structure.

    The names are those of selected structures without the bounds of a delay.
    """

    step: float
    samples: int
    hold: int
    response: Response
    structures: tuple[str, ...]

    def run(self, seed: int, *, noise: float, name: str) -> ftlm.Run:
        """Return a run from rest with white noise relative to the output."""
        g = np.random.default_rng(seed)
        u = held_input(g, self.samples, self.hold)
        y = self.response(u, self.step)
        noisy = y + noise * np.std(y) * g.standard_normal(y.size)
        return ftlm.Run.from_arrays(step=self.step, inputs={"u": u}, outputs={"y": noisy}, name=name)

    def is_structure(self, name: str) -> bool:
        """Whether the name of a selected structure is that of the plant."""
        start, delayed, rest = name.partition("(t - ")
        return (start + "(t - T)" + rest.partition(")")[2] if delayed else name) in self.structures


def held_input(g: np.random.Generator, samples: int, hold: int) -> np.ndarray:
    """Return uniform levels that are held for an eighth of `hold` to `hold` samples."""
    lengths = g.integers(max(1, hold // 8), hold + 1, samples)
    return np.repeat(g.uniform(-1, 1, samples), lengths)[:samples]


def integer_response(numerator: list[float], denominator: list[float], delay: float = 0.0) -> Response:
    """Return the response of a transfer function to a held input, after a delay [s]."""

    def respond(u: np.ndarray, step: float) -> np.ndarray:
        late = round(delay * SUBSTEPS / step)
        b, a, _ = cont2discrete((numerator, denominator), step / SUBSTEPS)[:3]
        fine = np.concatenate([np.zeros(late), np.repeat(u, SUBSTEPS)])
        return lfilter(np.ravel(b), a, fine)[: u.size * SUBSTEPS : SUBSTEPS]

    return respond


def fractional_response(transfer: Callable[[np.ndarray], np.ndarray], direct: float = 0.0) -> Response:
    """Return the response of a transfer function of s, and of a direct gain, to a held input."""
    return lambda u, step: direct * u + held_response(transfer, u, step, ALIASES)


_FLEXIBLE = np.polymul([1.0, 0.6, 36.0], [1.0, 0.9, 400.0]).tolist()

#: The twelve plants of the rules.
PLANTS = {
    "motor with dead time": Plant(
        0.005, 1200, 40, integer_response([120.0], [1.0, 8.0], 0.02), ("D^1 y = a0 y + b0 u(t - T)",)
    ),
    "motor angle": Plant(0.01, 1000, 30, integer_response([60.0], [1.0, 6.0, 0.0]), ("D^2 y = a1 D^1 y + b0 u",)),
    "two lags": Plant(0.05, 800, 30, integer_response([2.0], [1.0, 4.0, 3.0]), ("D^2 y = a1 D^1 y + a0 y + b0 u",)),
    "resonance with a zero": Plant(
        0.01,
        1500,
        40,
        integer_response([8.0, 144.0], [1.0, 1.2, 144.0]),
        ("D^2 y = a1 D^1 y + a0 y + b1 D^1 u + b0 u",),
    ),
    "zero in the right half plane": Plant(
        0.05,
        1000,
        30,
        integer_response([-2.0, 2.0], [1.0, 3.0, 2.0]),
        ("D^2 y = a1 D^1 y + a0 y + b1 D^1 u + b0 u",),
    ),
    "flexible arm": Plant(
        0.01,
        2000,
        60,
        integer_response([20.0, 20.0, 20.0 * 81.25], _FLEXIBLE),
        ("D^4 y = a3 D^3 y + a2 D^2 y + a1 D^1 y + a0 y + b2 D^2 u + b1 D^1 u + b0 u",),
    ),
    "heater of order one half": Plant(
        1.0, 1200, 80, fractional_response(lambda s: 1 / (1 + 6 * s**0.5)), ("D^alpha y = a0 y + b0 u",)
    ),
    "link with a spring-pot": Plant(
        0.01,
        1200,
        50,
        fractional_response(lambda s: 100 / (s**1.7 + 6 * s**0.1 + 100)),
        # Over this band the damper of order 0.1 is a spring.
        ("D^alpha y = a1 D^mu y + a0 y + b0 u", "D^alpha y = a0 y + b0 u"),
    ),
    "two RC stages, one sample late": Plant(
        0.001,
        1200,
        20,
        integer_response([5.4e5], [1.0, 3180.0, 5.4e5], 0.001),
        # The second pole is three times as fast as the sampling.
        ("D^2 y = a1 D^1 y + a0 y + b0 u(t - T)", "D^1 y = a0 y + b0 u(t - T)"),
    ),
    "supercapacitor": Plant(
        1.0, 1000, 60, fractional_response(lambda s: 1 / (20 * s**0.94), 0.05), ("D^alpha y = b1 D^alpha u + b0 u",)
    ),
    "tank": Plant(2.0, 600, 40, integer_response([0.1], [1.0, 0.02]), ("D^1 y = a0 y + b0 u",)),
    "third order with dead time": Plant(
        0.05,
        1500,
        40,
        integer_response([6.0], [1.0, 6.0, 11.0, 6.0], 0.33),
        ("D^3 y = a2 D^2 y + a1 D^1 y + a0 y + b0 u(t - T)",),
    ),
}


def drawn_plants(count: int, seed: int) -> dict[str, Plant]:
    """Return random plants: two of three of integer orders 1 to 4, half of these with a dead time, one fractional."""
    g = np.random.default_rng(seed)
    plants = {}
    for number in range(count):
        step, samples = 0.02, int(g.integers(600, 2000))
        if number % 3 == 2:
            order, damped, stiff = g.uniform(0.4, 1.9), g.uniform(0.1, 0.35), 10 ** g.uniform(0.3, 1.5)
            loss = g.uniform(0.1, 0.6) * stiff ** (1 - damped)
            response = fractional_response(_two_terms(order, damped * order, loss, stiff))
            words = f"order {order:.2f}"
        else:
            order = int(g.integers(1, 5))
            pairs = [(10 ** g.uniform(0, 1.2), 10 ** g.uniform(-1.5, -0.2)) for _ in range(order // 2)]
            denominator = np.ones(1)
            for w, damping in pairs:
                denominator = np.polymul(denominator, [1.0, 2 * damping * w, w * w])
            if order % 2:
                denominator = np.polymul(denominator, [1.0, 10 ** g.uniform(0, 1)])
            zeros = -(10 ** g.uniform(0, 1, int(g.integers(0, order)))) * g.choice([1, 1, -1])
            numerator = np.poly(zeros) * denominator[-1] / abs(np.prod(zeros))
            delay = step * g.uniform(0.5, 20) if g.uniform() < 0.5 else 0.0
            response = integer_response(np.atleast_1d(numerator).tolist(), denominator.tolist(), delay)
            words = f"order {order}, {zeros.size} zeros" + (f", {delay:.2f} s late" if delay else "")
        plants[f"{number + 1}: {words}"] = Plant(step, samples, int(g.integers(20, 60)), response, ())
    return plants


def _two_terms(order: float, damped: float, loss: float, stiff: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda s: stiff / (s**order + loss * s**damped + stiff)
