"""Ordinary records for tests: ten kinds of input, six of noise and seven plants, by SciPy and NumPy alone."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, cont2discrete, lfilter

import ftlm
import loops

STEP, ROWS, QUIET = 0.1, 600, 10
LAG, TWO = "D y = -a y + b u", "D^2 y = -p D y - q y + b u"
#: Numerator and denominator in s, rows of dead time, and the structure of each plant; the fractional one has alpha 0.7.
PLANTS: dict[str, tuple[list[float], list[float], int, str]] = {
    "lag": ([2.0], [1.0, 1.0], 0, LAG),
    "two lags": ([1.5], [0.8, 2.4, 1.0], 0, TWO),
    "swing": ([9.0], [1.0, 0.6, 9.0], 0, TWO),
    "motor": ([1.0], [0.5, 1.0, 0.0], 0, "D^2 y = -p D y + b u"),
    "zero": ([-0.8, 2.0], [1.0, 2.5, 1.0], 0, "D^2 y = -p D y - q y + b1 D u + b u"),
    "dead time": ([2.0], [1.0, 1.0], 3, LAG),
    "fractional": ([], [], 0, "D^alpha y = -a y + b u"),
}
INPUTS = (
    *("PRBS", "telegraph", "levels", "pulses", "white", "low-pass"),
    *("multisine", "chirp", "walk", "bursts"),
)
NOISES = ("white", "strong", "coloured", "heavy", "of motion", "walking")


@dataclass(frozen=True)
class Record:
    """One ordinary record with the structure of its plant and the noise of its output."""

    plant: str
    input: str
    noise: str
    seed: int
    run: ftlm.Run
    structure: ftlm.Structure
    error: np.ndarray


def drawn_input(kind: str, rows: int, rng: np.random.Generator) -> np.ndarray:
    """An input that is drawn before anything is simulated."""
    t, white = STEP * np.arange(rows), rng.standard_normal(rows)
    match kind:
        case "PRBS":
            return np.repeat(rng.choice([-1.0, 1.0], rows // 5 + 1), 5)[:rows]
        case "telegraph":
            return np.cumprod(np.where(rng.random(rows) < 0.06, -1.0, 1.0))
        case "levels":
            return np.repeat(rng.uniform(-1, 1, rows // 20 + 1), 20)[:rows]
        case "pulses":
            # On and off, long enough for the plant to come to rest between.
            return (np.arange(rows) // 60 % 2) * np.repeat(rng.uniform(0.5, 1, rows // 120 + 1), 120)[:rows]
        case "white":
            return white
        case "low-pass":
            return lfilter(*butter(2, 0.15), white)
        case "multisine":
            return sum(np.sin(w * t + rng.uniform(0, 6)) for w in np.geomspace(0.3, 12, 10))
        case "chirp":
            return np.sin(0.2 * t + 0.06 * t**2)
        case "walk":
            return np.cumsum(white)
    return white * (np.sin(np.arange(rows) / 40 + rng.uniform(0, 6)) > 0)


def response(plant: str, u: np.ndarray) -> np.ndarray:
    """Samples of a plant for a held input, from rest."""
    num, den, late, _ = PLANTS[plant]
    if not den:
        # D^0.7 y = -0.8 y + 1.6 u.
        answer = 2.0 * (1.0 - loops.relaxation(STEP * np.arange(u.size), 0.7, 0.8))
        return loops.convolved(np.diff(u, prepend=0.0), answer)
    b, a, _ = cont2discrete((num, den), STEP)[:3]
    return lfilter(np.ravel(b), a, np.concatenate([np.zeros(late), u])[: u.size])


def drawn_noise(kind: str, clean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Noise of a sensor."""
    white, size = rng.standard_normal(clean.size), float(np.std(clean))
    match kind:
        case "white":
            return 0.02 * size * white
        case "strong":
            return 0.3 * size * white
        case "coloured":
            return 0.1 * size * lfilter([np.sqrt(1 - 0.81)], [1, -0.9], white)
        case "heavy":
            return 0.03 * size * rng.standard_t(3, clean.size)
        case "walking":
            # The zero of a sensor that wanders, by 5, 10 or 20 % of the signal over the record.
            return rng.choice([0.05, 0.1, 0.2]) * size * np.cumsum(white) / np.sqrt(clean.size)
    # A sensor that is quiet where the machine is: its noise follows the speed.
    return 0.2 * np.abs(np.gradient(clean)) * white


def record(plant: str, kind: str, noise: str, seed: int, rows: int = ROWS, quiet: int = QUIET) -> Record:
    """One record of the panel; after some quiet rows its input starts."""
    of = (list(PLANTS).index(plant), INPUTS.index(kind), NOISES.index(noise))
    rng = np.random.default_rng([seed, *of])
    u = np.concatenate([np.zeros(quiet), drawn_input(kind, rows - quiet, rng)])
    clean = response(plant, u)
    error = drawn_noise(noise, clean, rng)
    words, late = PLANTS[plant][3], PLANTS[plant][2]
    structure = ftlm.equation(words, delay={"u": (0.0, 1.0)} if late else None)
    run = ftlm.Run.from_arrays(step=STEP, inputs={"u": u}, outputs={"y": clean + error})
    return Record(plant, kind, noise, seed, run, structure, error)


def records(seeds: Iterable[int]) -> Iterator[Record]:
    """The panel: 420 records a seed."""
    for names in itertools.product(PLANTS, INPUTS, NOISES, seeds):
        yield record(*names)
