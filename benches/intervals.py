"""Intervals where the quadratic picture fails, measured: coverage by standard errors and by profile likelihood.

``python benches/intervals.py [CASE …] [--seeds 30] [--write]`` prints a row a number; ``--write`` writes them to
benches/results.json. The link's deflection is driven by the measured hub of the first half of ``psf`` (needs measured
data: FTLM_DATA or the shared folder), simulated by Grünwald and Letnikov's sum on a grid 64 times finer than the
samples; the other plants by SciPy's `lsim`. Quadratic intervals are value ± 1.96 standard errors.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import lfilter, lsim

import ftlm
from ftlm.estimation.confidence_intervals import likelihood_of, nonlinear_parameters
from ftlm.utils.statistics import NORMAL_95
from results import heading, save

Floats = np.ndarray[Any, np.dtype[np.float64]]
DATA = Path(os.environ.get("FTLM_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")

#: Ticks of the fine grid an interval, thinning of the measured run.
FINE, THIN = 64, 4
#: An end that differs from the quadratic one by more than this share of a half-width should have been profiled.
OFF = 0.1


@dataclass(frozen=True)
class Case:
    """A plant, its truth, the noise as a share of the output's deviation, and its colour a sample."""

    words: str
    truth: dict[str, float]
    clean: Callable[[], tuple[Floats, Floats, float, str]]
    noise: float
    colour: float = 0.0


DRIVEN = {"mu": 0.2, "d": -40.0, "a": -80.0, "b": -0.8}


@cache
def driven() -> tuple[Floats, Floats, float, str]:
    """D^2 y = d D^mu y + a y + b D^2 u from rest; u: the measured hub angle from 1.1 s to 10.3 s, linear in between."""
    run = ftlm.load(
        DATA / "two_link_psf" / "psf.csv",
        time="t_s",
        inputs={"u": "th11_deg"},
        outputs={"y": "th12_deg"},
        units={"u": "deg", "y": "deg"},
    ).window(1.1, 10.3)
    u, step = run["u"][::THIN] - run["u"][0], THIN * run.step
    places = np.arange(2 * FINE * (u.size - 1) + 1) / (2 * FINE)
    fine = np.interp(places, np.arange(u.size), u)
    y = 2.0 * grunwald(fine, step / FINE / 2)[::2] - grunwald(fine[::2], step / FINE)
    return u, y[::FINE], step, "foh"


def grunwald(u: Floats, tick: float) -> Floats:
    """The implicit sum; its answer to one tick by transforms on a circle below 1."""
    count = u.size
    size = 1 << (4 * count - 1).bit_length()
    radius = 1e-10 ** (1.0 / size)
    s = (1.0 - radius * np.exp(-2j * np.pi * np.fft.rfftfreq(size))) / tick
    transfer = DRIVEN["b"] * s**2 / (s**2 - DRIVEN["d"] * s ** DRIVEN["mu"] - DRIVEN["a"])
    answer = np.fft.irfft(transfer, size)[:count] / radius ** np.arange(count)
    half = 1 << (2 * count - 1).bit_length()
    return np.fft.irfft(np.fft.rfft(answer, half) * np.fft.rfft(u, half), half)[:count]


@cache
def fast_pole() -> tuple[Floats, Floats, float, str]:
    """Poles at -1 and -25 1/s, sampled at 50 ms: the fast one hardly shows."""
    rng = np.random.default_rng(100)
    u = np.repeat(np.where(rng.random(40) < 0.5, -1.0, 1.0), 15)
    plant = ([[0.0, 1.0], [-25.0, -26.0]], [[0.0], [25.0]], [[1.0, 0.0]], 0)
    return u, lsim(plant, u, np.arange(u.size) * 0.05, interp=False)[1], 0.05, "zoh"


@cache
def resonance() -> tuple[Floats, Floats, float, str]:
    """D^2 y = -0.8 D y - 4 y + 4 u: the quadratic picture holds, and both kinds of intervals should."""
    rng = np.random.default_rng(100)
    u = np.repeat(np.where(rng.random(40) < 0.5, -1.0, 1.0), 15)
    plant = ([[0.0, 1.0], [-4.0, -0.8]], [[0.0], [4.0]], [[1.0, 0.0]], 0)
    return u, lsim(plant, u, np.arange(u.size) * 0.1, interp=False)[1], 0.1, "zoh"


LINK = "D^2 y = d D^mu y + a y + b D^2 u"
CASES = {
    "driven, 10 dB": Case(LINK, DRIVEN, driven, 0.3),
    "driven, 0 dB": Case(LINK, DRIVEN, driven, 1.0),
    "driven, -4 dB": Case(LINK, DRIVEN, driven, 1.5),
    "driven, coloured": Case(LINK, DRIVEN, driven, 0.3, 0.9),
    "fast pole, 26 dB": Case("D^2 y = c D y + a y + b u", {"c": -26.0, "a": -25.0, "b": 25.0}, fast_pole, 0.05),
    "fast pole, 10 dB": Case("D^2 y = c D y + a y + b u", {"c": -26.0, "a": -25.0, "b": 25.0}, fast_pole, 0.3),
    "fast pole, 0 dB": Case("D^2 y = c D y + a y + b u", {"c": -26.0, "a": -25.0, "b": 25.0}, fast_pole, 1.0),
    "resonance, 20 dB": Case("D^2 y = c D y + a y + b u", {"c": -0.8, "a": -4.0, "b": 4.0}, resonance, 0.1),
}


def fit_of_seed(job: tuple[str, int]) -> dict[str, Any]:
    """Intervals of both kinds at one seed."""
    name, seed = job
    case = CASES[name]
    u, y, step, between = case.clean()
    rng = np.random.default_rng([seed, 7])
    white = rng.standard_normal(y.size + 200)
    e = lfilter([np.sqrt(1.0 - case.colour**2)], [1.0, -case.colour], white)[200:]
    run = ftlm.Run.from_arrays(
        inputs={"u": u}, outputs={"y": y + case.noise * np.std(y) * e}, step=step, intersample={"u": between}
    )
    begin = time.perf_counter()
    result = ftlm.identify(
        run, ftlm.equation(case.words, initial="rest"), threads=1, method=ftlm.OutputError(intervals="quadratic")
    )
    fit = time.perf_counter()
    bent = nonlinear_parameters(likelihood_of(result), 0.95)
    test = time.perf_counter()
    try:
        profiles = result.profile(threads=1)
    except ftlm.ConvergenceError:
        # What `identify` does by itself where the profile finds a lower optimum.
        result = ftlm.identify(
            run, ftlm.equation(case.words, initial="rest"), threads=1, method=ftlm.OutputError(intervals="profile")
        )
        profiles = result.profiles
    end = time.perf_counter()
    values, errors = {n: result.parameters[n].value for n in result.names}, result.standard_errors
    numbers = {}
    for n, truth in case.truth.items():
        half = NORMAL_95 * errors[n]
        own = profiles[n]
        off = max(abs(own.low - values[n] + half), abs(own.high - values[n] - half)) / half
        numbers[n] = {
            "quadratic": abs(truth - values[n]) <= half,
            "profile": truth in own,
            "open": own.is_open,
            "bent": n in bent,
            "off": off > OFF,
            "runs": own.evaluations,
        }
    correlation = np.abs(result.joint.correlation) if result.joint is not None else np.zeros((1, 1))
    np.fill_diagonal(correlation, 0.0)
    times = (fit - begin, test - fit, end - test)
    return {"numbers": numbers, "correlation": float(np.nanmax(correlation)), "times": times}


def main() -> None:
    """Measure and print; write them with ``--write``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=list(CASES))
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--write", action="store_true", help="write benches/results.json")
    arguments = parser.parse_args()
    lines = [
        f"{heading()}: {arguments.seeds} seeds, 95 % intervals",
        "",
        "| record | largest correlation | number | covered, quadratic | covered, profile | open ends | told to bend "
        "| off by a tenth | of these told | free runs | fit, test, profile of all, s |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    print("\n".join(lines))
    with ProcessPoolExecutor(arguments.workers) as pool:
        for name in arguments.cases:
            ended = list(pool.map(fit_of_seed, [(name, s) for s in range(arguments.seeds)]))
            correlation = np.median([e["correlation"] for e in ended])
            times_text = ", ".join(f"{t:.2f}" for t in np.median([e["times"] for e in ended], axis=0))
            for number in CASES[name].truth:
                own = [e["numbers"][number] for e in ended]
                count = {k: sum(bool(o[k]) for o in own) for k in ("quadratic", "profile", "open", "bent", "off")}
                both = sum(o["off"] and o["bent"] for o in own)
                lines.append(
                    f"| {name} | {correlation:.4f} | {number} | {count['quadratic']} of {len(own)} "
                    f"| {count['profile']} of {len(own)} | {count['open']} | {count['bent']} | {count['off']} | {both} "
                    f"| {np.median([o['runs'] for o in own]):.0f} | {times_text} |"
                )
                print(lines[-1], flush=True)
    if arguments.write:
        save(lines)


if __name__ == "__main__":
    main()
