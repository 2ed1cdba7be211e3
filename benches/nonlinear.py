"""Non-linear terms, measured: time of a free run, of a Jacobian and of a fit of 2,300 samples; intervals over seeds.

``python benches/nonlinear.py speed``, ``recovery [--seeds 20]``. Plants: tests/python/nonlinear_plants.py.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import ftlm
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Objective
from ftlm.estimation.output_error import start_from_values

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "python"))

from nonlinear_plants import NOISE, PLANTS


def processor_time(work: Callable[[], object], repeats: int) -> float:
    """Return the median processor time of some work [s]."""
    times = []
    for _ in range(repeats):
        start_time = time.process_time()
        work()
        times.append(time.process_time() - start_time)
    return statistics.median(times)


def speed() -> None:
    """Print the time of a free run, of a step with a Jacobian, and of a fit with automatic start."""
    for name, plant in PLANTS.items():
        run = plant.run(plant.clean(), 0)
        problem = FreeProblem.of(ftlm.equation(plant.text, initial="rest"))
        grid = Objective(problem, [run], [1.0])
        at = start_from_values(problem, plant.truth)
        once = processor_time(lambda grid=grid, at=at: grid.evaluate(at), 20)
        step = processor_time(lambda grid=grid, at=at: grid.minimize(at, 1), 20)
        fit = processor_time(lambda plant=plant, run=run: ftlm.identify(run, plant.structure, threads=1), 3)
        print(
            f"{name:8s} {run.length} samples, {len(problem.names)} numbers: free run {1e3 * once:.1f} ms, "
            f"free run and Jacobian {1e3 * (step - once):.1f} ms, identify {fit:.2f} s"
        )


def recovery(seeds: int) -> None:
    """Print how often the plants are found, and how many 95 % intervals hold the truth."""
    for name, plant in PLANTS.items():
        clean, hit_count, hits, count, times = plant.clean(), 0, 0, 0, []
        for seed in range(seeds):
            start_time = time.process_time()
            joint = ftlm.identify(plant.run(clean, seed), plant.structure, threads=1).joint
            times.append(time.process_time() - start_time)
            assert joint is not None
            ratio = joint.noise[plant.output] / (NOISE * float(np.std(clean)))
            hit_count += abs(ratio - 1) < 0.1
            hits += sum(low <= plant.truth[n] <= high for n, (low, high) in joint.intervals.items())
            count += len(joint.intervals)
        print(f"{name:8s} found {hit_count}/{seeds}, intervals {hits}/{count}, {statistics.median(times):.2f} s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["speed", "recovery"])
    parser.add_argument("--seeds", type=int, default=20)
    arguments = parser.parse_args()
    speed() if arguments.what == "speed" else recovery(arguments.seeds)
