"""Processor time and memory of a default `identify`, which decides how a run started, beside `initial="rest"`.

``python benches/first_rows.py [CASE …] [--repeats 3] [--write]`` prints a row a case: 2 300 samples of the deflection
of the arm's second link (five coefficients, the same with three free orders) on each laboratory's run, and simulated
records of a free order and of two poles from rest, at a level and in motion. Each fit has a process of its own; times
are the least, memories the largest of the repeats, ratios those of the default.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "python"))

import ftlm
from arm_measured import arm_run
from results import heading, save

ROWS, BEFORE, STEP = 2300, 3000, 0.02
ARM = {
    "five": "D^2 theta22 = a theta22 + d D theta22 + b D^2 theta21 + p D^2 theta11 + q D^2 theta12",
    "three": "D^alpha theta22 = a theta22 + d D^mu theta22 + b D^gamma theta21 + p D^2 theta11 + q D^2 theta12",
}
SIMULATED = {"order": "D^alpha y = -q y + b u", "poles": "D^2 y = -p D y - q y + b u"}
STARTS = ("rest", "level", "motion")
CASES = [f"{run} {words}" for run in ("psf", "lqr") for words in ARM]
CASES += [f"{start} {words}" for start in STARTS for words in SIMULATED]


def simulated(start: str, words: str) -> ftlm.Run:
    """A record of 2 300 samples with 1 % noise, by recursions of NumPy and SciPy alone."""
    g = np.random.default_rng(7)
    before = BEFORE if start == "motion" else 0
    u = np.repeat(g.choice([-1.0, 1.0], ROWS), 20)[: before + ROWS]
    u[: 0 if before else 40] = 0.0
    if words == "poles":
        pole = np.exp(STEP * np.roots([1.0, 3.0, 25.0]))
        y = lfilter([0.0, 1.0], np.real(np.poly(pole)), u) * np.real(np.prod(1.0 - pole))
    else:
        # Gruenwald and Letnikov's sum of D^0.7 y = -2 y + 4 u, four steps a sample.
        fine, h = np.repeat(u, 4), STEP / 4
        weights = np.concatenate([[1.0], np.cumprod(1.0 - 1.7 / np.arange(1, fine.size))])
        weights[0] += 2.0 * h**0.7
        y = np.concatenate([[0.0], lfilter([4.0 * h**0.7], weights, fine)[3::4]])[: u.size]
    y = y[before:] + (20.0 if start == "level" else 0.0)
    y = y + 0.01 * np.std(y) * g.standard_normal(ROWS)
    return ftlm.Run.from_arrays(step=STEP, inputs={"u": u[before:]}, outputs={"y": y})


def measure(case: str, initial: str) -> dict[str, object]:
    """Processor time [s], peak and earlier memory [MB], and what was taken."""
    source, words = case.split()
    if words in ARM:
        run, sensor = arm_run(source), ftlm.SensorFilter.low_pass(("theta12", "theta22"))
        structure = ftlm.equation(ARM[words], sensor_filter=sensor, initial=initial)
    else:
        run, structure = simulated(source, words), ftlm.equation(SIMULATED[words], initial=initial)
    identify, before = ftlm.identify, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    start_time = time.process_time()
    result = identify(run, structure, threads=1)
    seconds = time.process_time() - start_time
    initial_text = str(result.settings["initial"]).partition(",")[0] + (
        " at a level" if result.settings.get("offset") == "level" else ""
    )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"seconds": seconds, "peak": peak, "before": before, "taken": initial_text, "fit": min(result.fit.values())}


def apart(case: str, initial: str, repeats: int) -> dict[str, object]:
    """The least time and the largest memory of several processes."""
    command = [sys.executable, __file__, case, "--initial", initial]
    runs = [
        json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[-1])
        for _ in range(repeats)
    ]
    return {**runs[0], "seconds": min(r["seconds"] for r in runs), "peak": max(r["peak"] for r in runs)}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=CASES)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--initial", help=argparse.SUPPRESS)
    parser.add_argument("--write", action="store_true", help="write benches/results.json")
    arguments = parser.parse_args()
    if arguments.initial:
        print(json.dumps(measure(arguments.cases[0], arguments.initial)))
        return
    lines = [heading(), ""]
    lines += ["| run | from rest: s, MB | default: s, MB | times as long | as much memory | start taken | fit |"]
    lines += ["| --- | --- | --- | --- | --- | --- | --- |"]
    for line in lines:
        print(line)
    for case in arguments.cases:
        rest, auto = (apart(case, initial, arguments.repeats) for initial in ("rest", "auto"))
        lines.append(
            f"| {case} | {rest['seconds']:.2f}, {rest['peak']:.0f} | {auto['seconds']:.2f}, {auto['peak']:.0f} | "
            f"{auto['seconds'] / rest['seconds']:.1f} | {auto['peak'] / rest['peak']:.2f} | {auto['taken']} | "
            f"{rest['fit']:.2f}, {auto['fit']:.2f} |"
        )
        print(lines[-1], flush=True)
    if arguments.write:
        save(lines)


if __name__ == "__main__":
    main()
