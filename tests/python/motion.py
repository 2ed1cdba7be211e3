"""Runs cut out of a longer motion, exact and by a way of their own: residues and the integral along the branch cut.

Nothing here imports the package's mathematics. A held input is a sum of steps, and the response to a step is

    S(t) = G(0) + Σ Res e^{pt} − (1/π) ∫₀^∞ Im F(r e^{iπ}) e^{−rt} dr,  F(s) = G(s)/s, G = Σ b s^ν / (s^α − Σ c s^ν),

the inverse Laplace transform deformed around the cut of s^α: no step, no recursion, no truncated memory. Before the
longer motion the plant is at rest; what is cut off is the history that the rest of the run carries.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import ftlm


@dataclass(frozen=True)
class Plant:
    """D^alpha y = sum of c D^nu y + sum of b D^nu u, stable, with the words and the truth of what is identified."""

    words: str
    truth: dict[str, float]
    alpha: float
    own: Sequence[tuple[float, float]]
    inputs: Sequence[tuple[float, float]]

    def divisor(self, s: np.ndarray) -> np.ndarray:
        """s^alpha − Σ c s^ν on the principal branch."""
        return s**self.alpha - sum(c * s**nu for c, nu in self.own)

    def step_transform(self, s: np.ndarray) -> np.ndarray:
        """Laplace transform of the response to a step."""
        return sum(b * s**nu for b, nu in self.inputs) / (s * self.divisor(s))

    def poles(self) -> list[complex]:
        """Zeros of the divisor in the upper half of the principal sheet, by Newton's method from a net of starts."""
        poles_so_far: list[complex] = []
        for radius in np.geomspace(0.05, 50.0, 25):
            for angle in np.linspace(0.05, np.pi - 0.05, 25):
                s = radius * np.exp(1j * angle)
                for _ in range(60):
                    slope = self.alpha * s ** (self.alpha - 1) - sum(c * nu * s ** (nu - 1) for c, nu in self.own if nu)
                    s = s - self.divisor(s) / slope
                    if not np.isfinite(s) or abs(s) < 1e-9:
                        break
                inside = np.isfinite(s) and s.imag > 1e-9 and abs(self.divisor(s)) < 1e-9 * (1 + abs(s) ** self.alpha)
                if inside and all(abs(s - p) > 1e-6 * abs(p) for p in poles_so_far):
                    poles_so_far.append(complex(s))
        return poles_so_far

    def step_response(self, t: np.ndarray) -> np.ndarray:
        """Response to a unit step at these times; exact to about 1e-10."""
        (gain,) = (b for b, nu in self.inputs if nu == 0)
        (own,) = (c for c, nu in self.own if nu == 0)
        log_r = np.linspace(np.log(1e-32), np.log(1e10), 2000)
        r = np.exp(log_r)
        density = -np.imag(self.step_transform(r * np.exp(1j * np.pi))) / np.pi * r * (log_r[1] - log_r[0])
        out = -gain / own + np.exp(-np.outer(t, r)) @ density
        for pole in self.poles():
            width = 1e-6 * abs(pole)
            slope = (self.divisor(pole + width) - self.divisor(pole - width)) / (2 * width)
            residue = sum(b * pole**nu for b, nu in self.inputs) / (pole * slope)
            out += 2 * np.real(residue * np.exp(pole * t))
        out[t == 0] = 0.0
        return out


def one_term(alpha: float) -> Plant:
    """D^alpha y = -0.5 y + u for alpha < 1; above it lightly damped by itself, at 2 rad/s^alpha."""
    a, b = (0.5, 1.0) if alpha < 1 else (2.0, 2.0)
    return Plant("D^alpha y = -a y + b u", {"alpha": alpha, "a": a, "b": b}, alpha, [(-a, 0.0)], [(b, 0.0)])


def two_terms(alpha: float, nu: float) -> Plant:
    """D^alpha y = -0.5 D^nu y - 4 y + 4 u."""
    truth = {"alpha": alpha, "nu": nu, "d": 0.5, "a": 4.0, "b": 4.0}
    words = "D^alpha y = -d D^nu y - a y + b u"
    return Plant(words, truth, alpha, [(-0.5, nu), (-4.0, 0.0)], [(4.0, 0.0)])


#: The plants of the Monte-Carlo, alpha from 0.4 to 1.9.
PLANTS = {
    **{f"{alpha:g}": one_term(alpha) for alpha in (0.4, 0.55, 0.7, 0.85, 0.95, 1.1, 1.3, 1.5)},
    "1.7, 0.6": two_terms(1.7, 0.6),
    "1.9, 0.5": two_terms(1.9, 0.5),
}


def held_command(rows: int, seed: int, every: int) -> np.ndarray:
    """Random levels, each held for some rows."""
    levels = np.random.default_rng([seed, 1]).uniform(-1, 1, rows // every + 1)
    return np.repeat(levels, every)[:rows]


def response(plant: Plant, u: np.ndarray, step: float) -> np.ndarray:
    """Clean output of a held command from rest."""
    jumps = np.diff(u, prepend=0.0)
    answer = plant.step_response(np.arange(u.size) * step)
    # Each row's jump has moved nothing yet at its own instant: the step response starts with 0.
    size = 2 * u.size
    return np.fft.irfft(np.fft.rfft(jumps, size) * np.fft.rfft(answer, size), size)[: u.size]


def pieces(
    plant: Plant, seed: int, *, rows: int = 500, step: float = 0.05, noise: float = 0.01, every: int = 20
) -> tuple[ftlm.Run, ftlm.Run]:
    """First half of a motion, from rest, and its second half, in motion, with white noise on both."""
    u = held_command(2 * rows, seed, every)
    y = response(plant, u, step)
    y = y + noise * np.std(y) * np.random.default_rng([seed, 2]).standard_normal(2 * rows)
    halves = (slice(0, rows), slice(rows, 2 * rows))
    first, second = (
        ftlm.Run.from_arrays(step=step, inputs={"u": u[part]}, outputs={"y": y[part]}, name=name)
        for part, name in zip(halves, ("first half", "second half"), strict=True)
    )
    return first, second


def scores(result: ftlm.Identification, plant: Plant) -> dict[str, float]:
    """How many standard errors each number is from the truth."""
    values = {**result.orders, **result.coefficients}
    return {n: (values[n] - truth) / result.standard_errors[n] for n, truth in plant.truth.items()}
