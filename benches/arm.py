"""The Euler-Lagrange form of the arm, measured: recovery from the automatic start, and real runs that it never saw.

``python benches/arm.py recovery [--seeds 20] [--first 0] [--levels 20,40,60,80]`` fits stage 1 and stage 2 under
square, sine and multisine currents with both angles following from the current, and says how far the truth lies from
each estimate. ``measured``, ``orders``, ``gains``, ``hubs``, ``steps``, ``left-out`` and ``rival`` are the real runs,
see ``arm_measured.py``. Each row is printed as soon as it is known.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "python"))

import ftlm
from arm_measured import gains, hubs, left_out, measurements, orders, rival, steps
from lagrange import INPUTS, clean_run, structure, truth
from plants import with_noise
from results import heading, save

NORMAL_95 = 1.959963984540054


def recovery(seeds: range, levels: list[float]) -> None:
    """Every fit as it is known, and after every seed what is known of each input and level."""
    scores_by_case: dict[tuple[int, str, float], list[np.ndarray]] = {}
    hits: dict[tuple[int, str, float], list[list[bool]]] = {}
    failures: dict[tuple[int, str, float], int] = {}
    for seed in seeds:
        for key in ((stage, shape, level) for stage in (1, 2) for shape in INPUTS for level in levels):
            stage, shape, level = key
            run = with_noise(clean_run(stage, shape), level, [seed, round(level), stage])
            start = time.process_time()
            try:
                fit = ftlm.identify(run, structure(stage), method="output-error", threads=1).joint
            except ftlm.FtlmError as error:
                failures[key] = failures.get(key, 0) + 1
                print(*key, seed, error, flush=True)
                continue
            true_values = truth(stage)
            values = dict(zip(fit.names, fit.values.tolist(), strict=True))
            z = np.array([(values[n] - v) / fit.standard_errors[n] for n, v in true_values.items()])
            inside = [fit.intervals[n][0] <= v <= fit.intervals[n][1] for n, v in true_values.items()]
            scores_by_case.setdefault(key, []).append(z)
            hits.setdefault(key, []).append(inside)
            outside = ", ".join(
                f"{n} {values[n]:.5g} for {v:.5g}"
                for (n, v), i in zip(true_values.items(), inside, strict=True)
                if not i
            )
            print(
                *key,
                seed,
                f"largest |z| {np.abs(z).max():.2f}",
                f"{time.process_time() - start:.1f} s",
                f"outside: {outside or 'none'}",
                flush=True,
            )
        print("| stage | input | dB | largest |z| < 5 | in 95 % intervals | within 1.96 errors | largest |z| |")
        print("| --- | --- | --- | --- | --- | --- | --- |")
        for key, scores in scores_by_case.items():
            z = np.abs(np.stack(scores))
            near = int(np.sum(z.max(axis=1) < 5.0))
            print(
                f"| {key[0]} | {key[1]} | {key[2]:g} | {near} of {len(z) + failures.get(key, 0)} | "
                f"{100.0 * np.mean(hits[key]):.1f} | {100.0 * np.mean(z < NORMAL_95):.1f} | {z.max():.1f} |",
                flush=True,
            )


SECTIONS: dict[str, Callable[[], Iterator[str]]] = {
    "measured": measurements,
    "orders": orders,
    "gains": gains,
    "hubs": hubs,
    "steps": steps,
    "left-out": left_out,
    "rival": rival,
}


def main() -> None:
    """Measure and print; real runs are written with ``--write``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("recovery", *SECTIONS))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--levels", default="20,40,60,80")
    parser.add_argument("--write", action="store_true", help="write benches/results.json")
    arguments = parser.parse_args()
    if arguments.what == "recovery":
        recovery(
            range(arguments.first, arguments.first + arguments.seeds), [float(v) for v in arguments.levels.split(",")]
        )
        return
    lines = [f"{heading()}:", ""]
    print(lines[0])
    for line in SECTIONS[arguments.what]():
        lines.append(line)
        print(line, flush=True)
    if arguments.write:
        save(lines)


if __name__ == "__main__":
    main()
