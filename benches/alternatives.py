"""Estimates with free orders by ftlm, by SciPy's least_squares with a Grünwald-Letnikov simulator, and by FOMCON's fid.

``python benches/alternatives.py [SEEDS]``: a motor's speed, a heated rod and a flexible tip, 400 samples with
noise of 2 % of the standard deviation, validated on another input without noise. The records are Grünwald-Letnikov
simulations at a fortieth of the sampling interval, so that no program fits its own discretization. SciPy and FOMCON
start at coefficients of one with the right signs and at integer orders; SciPy also at five more points, of which the
best fit counts. The intervals of SciPy follow from its Jacobian; FOMCON has none. It needs Octave with its packages
optim and control; the environment variable FOMCON names the folder of its sources
(github.com/AlekseiTepljakov/fomcon-matlab). Without it, FOMCON has no row.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

import ftlm
from results import heading, save

#: Samples of a record, finer steps of the truth, and the noise as a share of the deviation.
SAMPLES, FINER, NOISE = 400, 40, 0.02


@dataclass(frozen=True)
class Plant:
    """A machine: D^alpha y = a1 D^mu y + a0 y + b0 u, without the term of mu where that is None."""

    name: str
    step: float
    alpha: float
    mu: float | None
    a1: float
    a0: float
    b0: float

    @property
    def words(self) -> str:
        """The structure that all programs fit."""
        return f"D^alpha y = {'' if self.mu is None else 'a1 D^mu y + '}a0 y + b0 u"

    @property
    def truth(self) -> dict[str, float]:
        """Its numbers, by name."""
        own = {"alpha": self.alpha, "a0": self.a0, "b0": self.b0}
        return own if self.mu is None else {**own, "mu": self.mu, "a1": self.a1}

    @property
    def first(self) -> dict[str, float]:
        """Initial guess of someone who knows the signs and the nearest positive integer orders."""
        whole = {"alpha": max(1.0, float(round(self.alpha))), "a0": -1.0, "b0": 1.0}
        return whole if self.mu is None else {**whole, "mu": 1.0, "a1": -1.0}


PLANTS = (
    Plant("motor, speed", 0.01, 1.0, None, 0.0, -4.0, 60.0),
    Plant("heated rod", 0.5, 0.5, None, 0.0, -0.2, 1.5),
    Plant("flexible tip", 0.02, 1.8, 0.8, -0.6, -9.0, 4.0),
)


def weights(order: float, n: int) -> np.ndarray:
    """Binomial weights of Grünwald and Letnikov."""
    k = np.arange(1, n)
    return np.concatenate([[1.0], np.cumprod((k - 1 - order) / k)])


def simulated(values: dict[str, float], u: np.ndarray, step: float) -> np.ndarray:
    """The free run of Grünwald and Letnikov, from rest: what each step of a held input has come to at its end."""
    n = u.size
    lhs = step ** -values["alpha"] * weights(values["alpha"], n)
    if "mu" in values:
        lhs = lhs - values["a1"] * step ** -values["mu"] * weights(values["mu"], n)
    lhs[0] -= values["a0"]
    return np.asarray(lfilter([values["b0"]], lhs, u))


def sampled(values: dict[str, float], u: np.ndarray, step: float, finer: int = 1) -> np.ndarray:
    """Readings under a held input, each step cut into finer ones."""
    fine = simulated(values, np.repeat(u, finer), step / finer)
    return np.concatenate([[0.0], fine[finer - 1 : -1 : finer]])


def fit(output: np.ndarray, run: np.ndarray) -> float:
    """In percent, as MATLAB defines it."""
    return 100 * (1 - float(np.linalg.norm(output - run) / np.linalg.norm(output - output.mean())))


def by_scipy(plant: Plant, u: np.ndarray, y: np.ndarray, starts: Sequence[dict[str, float]]) -> tuple[dict, dict]:
    """Numbers and standard errors of the best of some starts."""
    names = list(plant.truth)

    def residual(v: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            e = sampled(dict(zip(names, v, strict=True)), u, plant.step) - y
        return np.nan_to_num(np.clip(e, -1e6, 1e6), nan=1e6)

    best = min((least_squares(residual, [s[n] for n in names]) for s in starts), key=lambda result: result.cost)
    spread = 2 * best.cost / (y.size - len(names))
    covariance = spread * np.linalg.pinv(best.jac.T @ best.jac)
    return dict(zip(names, best.x, strict=True)), dict(zip(names, np.sqrt(np.diag(covariance)), strict=True))


def by_fomcon(
    sources: str, plant: Plant, inputs: tuple[np.ndarray, np.ndarray], outputs: Sequence[np.ndarray]
) -> list[tuple[float, float, np.ndarray]]:
    """Return processor time [s], alpha and response to the second input, for a fit by fid to each output.

    The inputs are delayed by one sample, because an input acts at its own instant in FOMCON's implicit scheme.
    """
    t = np.arange(SAMPLES) * plant.step
    delayed_inputs = [np.concatenate([[0.0], u[:-1]]) for u in inputs]
    first = plant.first
    start = [first["b0"] / -first["a0"], 1 / -first["a0"], first["alpha"]]
    start += [] if plant.mu is None else [first["a1"] / first["a0"], first["mu"]]
    with tempfile.TemporaryDirectory() as folder:
        tables = {
            "train": np.stack([t, delayed_inputs[0], *outputs], axis=1),
            "test": np.stack([t, delayed_inputs[1]], axis=1),
        }
        for name, table in {**tables, "start": np.array([start])}.items():
            np.savetxt(Path(folder, f"{name}.csv"), table, delimiter=",", fmt="%.17g")
        script = Path(__file__).with_name("fomcon_fid.m")
        command = ["octave-cli", str(script), sources, folder]
        lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    rows = [np.array(line.split(), dtype=float) for line in lines]
    return [(row[0], row[1], row[2:]) for row in rows]


def processor_time(work: Callable[[], object]) -> tuple[float, object]:
    """Processor time of all threads, and what came of it."""
    start_time = time.process_time()
    result = work()
    return time.process_time() - start_time, result


def measure(plant: Plant, seeds: int, fomcon: str | None) -> list[str]:
    """A row for each way."""
    t = np.arange(SAMPLES) * plant.step
    square = np.where((t / (SAMPLES * plant.step / 6)).astype(int) % 2 == 0, 1.0, -1.0)
    chirp = np.sin(2 * np.pi * 8 * (t / t[-1]) ** 1.6)
    clean, other = (sampled(plant.truth, u, plant.step, FINER) for u in (square, chirp))
    ways: dict[str, list[tuple[float, float, int, float]]] = {}
    outputs = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        y = clean + NOISE * np.std(clean) * rng.standard_normal(SAMPLES)
        outputs.append(y)
        run = ftlm.Run.from_arrays(step=plant.step, inputs={"u": square}, outputs={"y": y})
        unseen = ftlm.Run.from_arrays(step=plant.step, inputs={"u": chirp}, outputs={"y": other})
        seconds, result = processor_time(lambda run=run, plant=plant: ftlm.identify(run, ftlm.equation(plant.words)))
        assert isinstance(result, ftlm.Identification)
        hits = sum(low <= plant.truth[n] <= high for n, (low, high) in result.intervals.items() if n in plant.truth)
        off = abs({**result.orders, **result.coefficients}["alpha"] - plant.alpha)
        ways.setdefault("ftlm, no start", []).append(
            (seconds, result.model.compare(unseen).output_error["y"].fit, hits, off)
        )
        spread = [
            {
                n: v * float(np.exp(rng.normal(0, 1.0 if n in ("a0", "a1", "b0") else 0.2)))
                for n, v in plant.first.items()
            }
            for _ in range(5)
        ]
        for name, starts in (("SciPy, one start", [plant.first]), ("SciPy, best of six", [plant.first, *spread])):
            seconds, (values, errors) = processor_time(lambda s=starts, y=y, p=plant: by_scipy(p, square, y, s))
            hits = sum(abs(values[n] - plant.truth[n]) <= 1.96 * errors[n] for n in plant.truth)
            model = fit(other, sampled(values, chirp, plant.step))
            ways.setdefault(name, []).append((seconds, model, hits, abs(values["alpha"] - plant.alpha)))
    if fomcon is not None:
        ways["FOMCON, one start"] = [
            (seconds, fit(other, response), 0, abs(alpha - plant.alpha))
            for seconds, alpha, response in by_fomcon(fomcon, plant, (square, chirp), outputs)
        ]
    count = len(plant.truth)
    rows = []
    for name, each in ways.items():
        seconds, fits, hits, off = (np.array(v) for v in zip(*each, strict=True))
        ratio = float(np.median(seconds) / np.median([s for s, *_ in ways["ftlm, no start"]]))
        coverage = "–" if name.startswith("FOMCON") else f"{100 * np.sum(hits) / (count * seeds):.0f}"
        rows.append(
            f"| {plant.name} | {name} | {np.median(fits):.1f} | {np.min(fits):.1f} | {np.median(off):.3f} | "
            f"{coverage} | {ratio:.2g} |"
        )
    return rows


def figure(rows: Sequence[str]) -> str:
    """Return the rows of a machine as one list item for the page of results: the worst fit and the time of each way."""
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    texts = [
        f"{way.split(',')[0]} {least}, {time}" for _, way, _, least, *_, time in cells if way != "SciPy, one start"
    ]
    return f"- {cells[0][0]}, worst unseen fit [%] and time: {'; '.join(texts)}"


def main() -> None:
    """Measure, print and keep."""
    seeds = next((int(word) for word in sys.argv[1:] if word.isdigit()), 5)
    fomcon = os.environ.get("FOMCON")
    lines = [
        f"{SAMPLES} samples, noise {NOISE:.0%}, seeds 0 to {seeds - 1}.",
        "",
        "| machine | way | fit on unseen data, median [%] | least | error of alpha, median | intervals that hold the "
        "truth [%] | processor time over ftlm's |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    print("\n".join(lines))
    figures = []
    for plant in PLANTS:
        rows = measure(plant, seeds, fomcon)
        figures.append(figure(rows))
        print("\n".join(rows), flush=True)
    if "--write" in sys.argv:
        save([f"{heading()}: {lines[0]}", *figures])


if __name__ == "__main__":
    main()
