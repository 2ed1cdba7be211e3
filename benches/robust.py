"""What real records have, measured: coverage of 95 % intervals, or the warning that names the cause.

``python benches/robust.py [CASE …] [--seeds 30] [--plants whole,fractional] [--write]`` prints a table; ``--write``
writes it to benches/results.json. Two plants, all orders free: a resonance of integer orders by SciPy's `lsim`, and
D^0.8 y = -1.5 y + 1.5 u by Grünwald and Letnikov's sum on a grid 64 times finer than the samples, extrapolated.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import lfilter, lsim

import ftlm
from results import heading, save

Floats = np.ndarray[Any, np.dtype[np.float64]]

#: Rows of a run, ticks of the fine grid an interval.
ROWS, FINE = 1000, 64


@dataclass(frozen=True)
class Plant:
    """A plant, its sampling, its structure with free orders, and the truth."""

    step: float
    words: str
    truth: dict[str, float]
    answer: Callable[[Floats, float], Floats]
    switching: float


def resonance(u: Floats, tick: float) -> Floats:
    """D^2 y = -0.8 D y - 4 y + 4 u under a held input, exactly."""
    system = ([[0.0, 1.0], [-4.0, -0.8]], [[0.0], [4.0]], [[1.0, 0.0]], [[0.0]])
    return np.asarray(lsim(system, u, np.arange(u.size) * tick, interp=False)[1])


def relaxation(u: Floats, tick: float) -> Floats:
    """D^0.8 y = -1.5 y + 1.5 u, by sums of Grünwald and Letnikov on this grid and on one of half the ticks."""
    fine = grunwald(np.repeat(u, 2), 0.5 * tick)[::2]
    return np.asarray(2.0 * fine - grunwald(u, tick))


def grunwald(u: Floats, tick: float) -> Floats:
    """The implicit sum, y[k] after u[k-1] was held; its answer to one tick by transforms on a circle below 1."""
    count = u.size
    size = 1 << (4 * count - 1).bit_length()
    radius = 1e-10 ** (1.0 / size)
    z = radius * np.exp(-2j * np.pi * np.fft.rfftfreq(size))
    answer = np.fft.irfft(1.5 * z / (((1.0 - z) / tick) ** 0.8 + 1.5), size)[:count] / radius ** np.arange(count)
    half = 1 << (2 * count - 1).bit_length()
    return np.fft.irfft(np.fft.rfft(answer, half) * np.fft.rfft(u, half), half)[:count]


PLANTS = {
    "whole": Plant(
        0.1,
        "D^alpha y = c D^nu y + a y + b u",
        {"alpha": 2.0, "nu": 1.0, "c": -0.8, "a": -4.0, "b": 4.0},
        resonance,
        0.06,
    ),
    "fractional": Plant(
        0.05,
        "D^alpha y = a y + b u",
        {"alpha": 0.8, "a": -1.5, "b": 1.5},
        relaxation,
        0.06,
    ),
}


@dataclass(frozen=True)
class Recorded:
    """Noise-free samples with what they came from."""

    plant: Plant
    command: Floats
    ticks: np.ndarray[Any, np.dtype[np.int64]]
    y: Floats
    size: float


def recorded(plant: Plant, rng: np.random.Generator, *, jitter: float = 0.0, disturbance: float = 0.0) -> Recorded:
    """A random switching command, held from row to row, and the plant's answer at the rows."""
    ticks = np.arange(ROWS) * FINE + np.round(rng.uniform(-jitter, jitter, ROWS) * FINE).astype(np.int64)
    ticks[0] = 0
    command = np.where(np.cumsum(rng.random(ROWS) < plant.switching) % 2, -1.0, 1.0)
    input_values = command[np.searchsorted(ticks, np.arange(ticks[-1] + 1), side="right") - 1]
    if disturbance:
        # A slow load at the input that nobody measures.
        load = lfilter([np.sqrt(1 - 0.95**2)], [1.0, -0.95], rng.standard_normal(ROWS + 1))
        input_values = input_values + disturbance * np.repeat(load, FINE)[: input_values.size]
    y = plant.answer(input_values, plant.step / FINE)[ticks]
    return Recorded(plant, command, ticks, y, float(np.std(y)))


def white(record: Recorded, rng: np.random.Generator, share: float = 0.01) -> Floats:
    """The output with white noise."""
    return np.asarray(record.y + share * record.size * rng.standard_normal(ROWS))


def run_of(record: Recorded, y: Floats, **options: Any) -> ftlm.Run:
    """A regular run."""
    return ftlm.Run.from_arrays(inputs={"u": record.command}, outputs={"y": y}, step=record.plant.step, **options)


def nothing(plant: Plant, rng: np.random.Generator) -> ftlm.Run:
    """1 % white noise."""
    record = recorded(plant, rng)
    return run_of(record, white(record, rng))


def coloured(plant: Plant, rng: np.random.Generator) -> ftlm.Run:
    """10 % noise, each sample 0.9 of the one before it and something new."""
    record = recorded(plant, rng)
    noise = lfilter([np.sqrt(1 - 0.9**2)], [1.0, -0.9], rng.standard_normal(ROWS + 200))[200:]
    return run_of(record, record.y + 0.1 * record.size * noise)


def disturbed(plant: Plant, rng: np.random.Generator) -> ftlm.Run:
    """A load of 10 % at the input with 1 % white noise at the output."""
    record = recorded(plant, rng, disturbance=0.1)
    return run_of(record, white(record, rng))


def quantised(plant: Plant, rng: np.random.Generator) -> ftlm.Run:
    """0.1 % noise, then steps of 0.15 deviations of the output."""
    record = recorded(plant, rng)
    step = 0.15 * record.size
    return run_of(record, step * np.round(white(record, rng, 0.001) / step))


def with_outliers(plant: Plant, rng: np.random.Generator) -> ftlm.Run:
    """1 % noise; one sample in a hundred off by up to two deviations of the output."""
    record = recorded(plant, rng)
    struck = rng.random(ROWS) < 0.01
    return run_of(record, white(record, rng) + struck * record.size * rng.uniform(-2.0, 2.0, ROWS))


def unread(plant: Plant, rng: np.random.Generator) -> ftlm.Run:
    """1 % noise; 15 % of the outputs were not read, one gap of 40 rows among them."""
    record = recorded(plant, rng)
    y = white(record, rng)
    y[rng.random(ROWS) < 0.11] = np.nan
    y[300:340] = np.nan
    return run_of(record, y, missing="weight")


def with_lost_rows(plant: Plant, rng: np.random.Generator) -> ftlm.Run:
    """1 % noise; 15 % of the rows were lost, the command there with them."""
    record = recorded(plant, rng)
    is_present = rng.random(ROWS) >= 0.15
    is_present[[0, -1]] = True
    return ftlm.Run.from_arrays(
        inputs={"u": record.command[is_present]},
        outputs={"y": white(record, rng)[is_present]},
        time=np.arange(ROWS)[is_present] * plant.step,
        missing="hold",
    )


def jittered(plant: Plant, rng: np.random.Generator) -> ftlm.Run:
    """1 % noise; times off by up to 30 % of a step, those of the command as well."""
    record = recorded(plant, rng, jitter=0.3)
    return ftlm.Run.from_arrays(
        inputs={"u": record.command},
        outputs={"y": white(record, rng)},
        time=record.ticks * plant.step / FINE,
        resample=plant.step,
    )


@dataclass(frozen=True)
class Case:
    """What befalls a record, how it is identified, and the codes of findings that name the cause."""

    make: Callable[[Plant, np.random.Generator], ftlm.Run]
    codes: tuple[str, ...] = ()
    method: str | ftlm.OutputError = "output-error"


CASES = {
    "white": Case(nothing),
    "white, huber": Case(nothing, method=ftlm.OutputError(loss="huber")),
    "coloured": Case(coloured, ("noise_coloured", "residuals_not_white")),
    "disturbed": Case(disturbed, ("noise_coloured", "residuals_not_white")),
    "quantised": Case(quantised, ("quantised",)),
    "outliers": Case(with_outliers, ("outliers", "outliers_dominate")),
    "outliers, huber": Case(with_outliers, method=ftlm.OutputError(loss="huber")),
    "unread": Case(unread),
    "lost": Case(with_lost_rows, ("data_note",)),
    "jitter": Case(jittered),
}


def fit(task: tuple[str, str, int]) -> tuple[list[float], list[float], bool, float]:
    """Errors in standard errors, errors over true values, whether the cause was named, seconds."""
    name, plant_name, seed = task
    case, plant = CASES[name], PLANTS[plant_name]
    run = case.make(plant, np.random.default_rng([seed, 13]))
    start = time.process_time()
    result = ftlm.identify(run, ftlm.equation(plant.words), method=case.method, threads=1)
    seconds = time.process_time() - start
    values, errors = result.orders | result.coefficients, result.standard_errors
    z = [(values[n] - true) / errors[n] for n, true in plant.truth.items()]
    off = [values[n] - true for n, true in plant.truth.items()]
    is_reported = any(finding.code in case.codes for finding in result.findings)
    return z, off, is_reported, seconds


def main() -> None:
    """Measure and print; write them with ``--write``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=list(CASES))
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--plants", default=",".join(PLANTS))
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--write", action="store_true", help="write benches/results.json")
    arguments = parser.parse_args()
    lines = [
        f"{heading()}: {ROWS} rows, {arguments.seeds} seeds, all orders free",
        "",
        "| record | plant | covered by 95 % intervals, each number | largest mean z | error / that of white noise "
        "| cause named | s |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    print("\n".join(lines))
    with ProcessPoolExecutor(arguments.workers) as pool:
        for plant_name in arguments.plants.split(","):
            plant, base = PLANTS[plant_name], None
            for name in arguments.cases:
                ended = list(pool.map(fit, [(name, plant_name, s) for s in range(arguments.seeds)]))
                z = np.array([e[0] for e in ended])
                spread = np.sqrt(np.mean(np.array([e[1] for e in ended]) ** 2, axis=0))
                base = spread if base is None else base
                covered = ", ".join(
                    f"{n} {int(c)}" for n, c in zip(plant.truth, np.sum(np.abs(z) < 1.96, axis=0), strict=True)
                )
                reports = sum(e[2] for e in ended) if CASES[name].codes else "-"
                lines.append(
                    f"| {name} | {plant_name} | {covered} of {len(z)} | {np.abs(z.mean(axis=0)).max():.2f} "
                    f"| {np.median(spread / base):.2f} | {reports} | {np.mean([e[3] for e in ended]):.1f} |"
                )
                print(lines[-1], flush=True)
    if arguments.write:
        save(lines)


if __name__ == "__main__":
    main()
