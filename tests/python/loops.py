"""Closed loops, records with offsets and cells for tests and benches, from seeds; no simulation of the package."""

from __future__ import annotations

import functools
import math

import numpy as np

import ftlm

STEP, ROWS = 0.02, 1500
TRUTH = {"alpha": 1.7, "a": 4.0, "b": 4.0}
#: Colour and deviation of the output's noise, gain and integral action of the controller, rows its reference holds.
KINDS = {
    "open, white": (0.0, 0.1, 0.0, 0.0, 25),
    "open, coloured": (0.9, 0.1, 0.0, 0.0, 25),
    "closed, white": (0.0, 0.1, 1.0, 0.0, 25),
    "closed, coloured": (0.9, 0.1, 1.0, 0.0, 25),
    "closed, coloured, biased": (0.9, 0.5, 3.0, 2.0, 40),
    "closed, coloured, strong": (0.9, 0.5, 3.0, 0.0, 200),
    "closed, coloured, integral": (0.9, 1.0, 2.0, 1.0, 150),
}
CELL = {"alpha": 0.78, "a": 1 / 3, "d": 5.0, "b": 13 / 3}
CELL_STRUCTURE = ftlm.equation("D^alpha v = -a v + d D^alpha i + b i", initial="rest")
#: Records of `offset_run` and the constants on their outputs.
OFFSETS = {"motor": (0.0, 5.0), "battery": (0.0, 3.7), "coloured": (0.0,)}


def relaxation(t: np.ndarray, alpha: float, rate: float, *, integral: bool = False) -> np.ndarray:
    """E_alpha(-rate t^alpha), or its integral from 0, by its spectrum of relaxations and, above 1, its oscillation.

    Gorenflo and Mainardi (Fractional calculus, CISM 378, 1997, section 3): exact, no step, no series.
    """
    logarithms = np.linspace(-60.0, 60.0, 6001)
    r, h = np.exp(logarithms), logarithms[1] - logarithms[0]
    # Of the scaled time rate^(1/alpha) t.
    scaled = rate ** (1.0 / alpha) * t
    below = r ** (2 * alpha) + 2 * r**alpha * math.cos(alpha * math.pi) + 1.0
    weight = h * r**alpha * math.sin(alpha * math.pi) / (math.pi * below)
    out = np.empty(t.size)
    for i in range(0, t.size, 512):
        decay = np.outer(scaled[i : i + 512], r)
        out[i : i + 512] = (-np.expm1(-decay) / r) @ weight if integral else np.exp(-decay) @ weight
    if alpha > 1.0:
        pole = complex(math.cos(math.pi / alpha), math.sin(math.pi / alpha))
        exponential = np.exp(pole * scaled)
        out += 2.0 / alpha * np.real((exponential - 1.0) / pole if integral else exponential)
    return out / rate ** (1.0 / alpha) if integral else out


def convolved(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """First terms of a convolution."""
    length = 1 << (2 * a.size).bit_length()
    return np.fft.irfft(np.fft.rfft(a, length) * np.fft.rfft(b, length), length)[: a.size]


@functools.cache
def step_response(rows: int = ROWS, alpha: float = 1.7) -> np.ndarray:
    """Samples of the step response of D^alpha y = -4 y + 4 u."""
    return 1.0 - relaxation(np.arange(rows) * STEP, alpha, 4.0)


def coloured(rng: np.random.Generator, rows: int, colour: float) -> np.ndarray:
    """Noise of deviation 1, each sample so much of the last one."""
    noise = rng.standard_normal(rows)
    for k in range(1, rows):
        noise[k] = colour * noise[k - 1] + math.sqrt(1.0 - colour**2) * noise[k]
    return noise


def loop(kind: str, seed: int, rows: int = ROWS) -> ftlm.Run:
    """D^1.7 y = -4 y + 4 u with noise on y, which a controller reads, or an open loop where its gain is 0."""
    colour, deviation, gain, integral, every = KINDS[kind]
    rng = np.random.default_rng([seed, 17])
    reference = np.repeat(rng.choice([-1.0, 1.0], rows // every + 1), every)[:rows]
    noise = deviation * coloured(rng, rows, colour)
    pulse = np.diff(np.concatenate([[0.0], step_response(rows)]))
    u, y, collected = np.zeros(rows), np.zeros(rows), 0.0
    for k in range(rows):
        y[k] = pulse[k:0:-1] @ u[:k]
        error = reference[k] - y[k] - noise[k]
        collected += integral * STEP * error
        u[k] = gain * error + collected if gain else reference[k]
    return ftlm.Run.from_arrays(
        step=STEP, inputs={"u": u, "r": reference}, outputs={"y": y + noise}, name=f"{kind}, seed {seed}"
    )


def open_run(seed: int, noise: float, rows: int = ROWS) -> ftlm.Run:
    """D^1.73 y = -4 y + 4 u with white noise, a share of y's deviation; 1.73 is on no lattice."""
    rng = np.random.default_rng([seed, 23])
    u = np.repeat(rng.uniform(-1.0, 1.0, rows // 25 + 1), 25)[:rows]
    y = convolved(np.diff(u, prepend=0.0), step_response(rows, 1.73))
    y += noise * np.std(y) * rng.standard_normal(rows)
    return ftlm.Run.from_arrays(step=STEP, inputs={"u": u}, outputs={"y": y}, name=f"open, seed {seed}")


def offset_run(kind: str, constant: float, seed: int) -> tuple[ftlm.Run, ftlm.Structure, dict[str, float]]:
    """A record whose output has a zero of its own, what is identified from it, and the truth."""
    rng = np.random.default_rng([seed, 29])
    if kind == "motor":
        # 8 rad/s a volt, 0.2 s, 0.035 s late.
        step, rows = 0.01, 1000
        u = 2.0 * np.repeat(rng.uniform(-1.0, 1.0, rows // 25 + 1), 25)[:rows]
        t = np.maximum(np.arange(rows) * step - 0.035, 0.0)
        y = convolved(np.diff(u, prepend=0.0), 8.0 * -np.expm1(-t / 0.2))
        y += constant + 0.01 * np.std(y) * rng.standard_normal(rows)
        words = ftlm.equation("D w = -a w + b u", delay={"u": (0.0, 0.1)})
        run = ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"w": y}, name=f"motor {seed}")
        return run, words, {"a": 5.0, "b": 40.0, "delay_u": 0.035}
    step, rows = 0.5, 1000
    i = np.repeat(rng.uniform(-2.0, 2.0, rows // 20 + 1), 20)[:rows]
    v = 0.05 * convolved(np.diff(i, prepend=0.0), 1.0 - relaxation(np.arange(rows) * step, 0.8, 0.2))
    v += constant + 0.02 * np.std(v) * coloured(rng, rows, 0.9 if kind == "coloured" else 0.0)
    run = ftlm.Run.from_arrays(step=step, inputs={"i": i}, outputs={"v": v}, name=f"{kind} {seed}")
    return run, ftlm.equation("D^alpha v = -a v + b i"), {"alpha": 0.8, "a": 0.2, "b": 0.01}


def cell_run(rows: int, step: float, hold: str, seed: int, noise: float) -> ftlm.Run:
    """A Randles cell: 5 Ohm, and 8 Ohm beside a constant-phase element of order 0.78, 3 s^0.78 together."""
    rng = np.random.default_rng([seed, 31])
    t, every = np.arange(rows) * step, max(rows // 50, 1)
    levels = rng.uniform(-1.0, 1.0, rows // every + 2)
    if hold == "zoh":
        i = np.repeat(levels, every)[:rows]
        v = 5.0 * i + 8.0 * convolved(np.diff(i, prepend=0.0), 1.0 - relaxation(t, CELL["alpha"], CELL["a"]))
    else:
        levels[0] = 0.0
        i = np.interp(np.arange(rows), np.arange(levels.size) * every, levels)
        slope = np.diff(i, append=i[-1]) / step
        ramp = t - relaxation(t, CELL["alpha"], CELL["a"], integral=True)
        v = 5.0 * i + 8.0 * convolved(np.diff(slope, prepend=0.0), ramp)
    v += noise * np.std(v) * rng.standard_normal(rows)
    return ftlm.Run.from_arrays(
        step=step, inputs={"i": i}, outputs={"v": v}, intersample={"i": hold}, name=f"cell, {hold}, seed {seed}"
    )
