"""What a default `identify` costs in processor time, in real FFTs of 4096 points of the same machine, beside SciPy.

``python benches/identify.py [five] [three] [long] [longest]``: theta22 of both laboratories' runs at 8 ms, five
coefficients (promise P9), the same with three free orders, and one run of 50 000 samples, then of 500 000, with a free
order (P10). Each in a process of its own, modules imported before (P8); the rival of the first is SciPy's least_squares
on the two numbers of the link, all that is linear projected out by run (less than the five numbers that both runs
share), from twenty starts. ``psf`` and ``lqr`` fit the five on one run and judge them on the other one, in bold.
``jax --jax PYTHON`` sets jax-sysid's linear model of order 4 beside, from one start, fitted on both runs and on each:
with the signals as they were measured (its states may be the link's and the filter's), then with the hubs' angles
through the deflections' filter, so that all signals passed it. The times after the slash are of two more starts in the
same process, less what a fit takes with a single step of each optimiser: setting up and compiling.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "python"))

import ftlm
from arm_measured import arm_run
from lsim_link import STOCK, projected, response
from results import heading, save

FILTERED = ("theta12", "theta22")
TERMS = [("theta21", 2), ("theta11", 2), ("theta12", 2)]
#: The three linear terms are those of TERMS.
WORDS = {
    "five": "D^2 theta22 = a theta22 + d D theta22 + b D^2 theta21 + p D^2 theta11 + q D^2 theta12",
    "three": "D^alpha theta22 = a theta22 + d D^mu theta22 + b D^gamma theta21 + p D^2 theta11 + q D^2 theta12",
}
#: Samples of the longest run.
LONGEST = 500_000
STARTS = [(-(w**2), -2 * z * w) for w in (3.0, 8.0, 15.0, 25.0, 40.0) for z in (0.01, 0.05, 0.2, 0.5)]


def processor_time(work: Callable[[], object]) -> float:
    """Processor time of this process."""
    start_time = time.process_time()
    work()
    return time.process_time() - start_time


def transform() -> float:
    """Processor time of one real FFT of 4096 points by NumPy, the least of five hundred times five."""
    x = np.random.default_rng(0).normal(size=4096)
    return min(processor_time(lambda: [np.fft.rfft(x) for _ in range(500)]) / 500 for _ in range(5))


def peak() -> float:
    """Most memory that this process held [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def print_row(name: str, seconds: float, before: float, fit: str) -> None:
    """One row."""
    row(name, [seconds], (peak(), before), fit)


def row(name: str, seconds: Sequence[float], memory: tuple[float, float], fit: str) -> None:
    """One row; processor times with and without what is left out of the second."""
    seconds_text, ffts = (
        " / ".join(f"{s:.2f}" for s in seconds),
        " / ".join(f"{s / transform() / 1000:.0f}" for s in seconds),
    )
    print(f"| {name} | {seconds_text} | {ffts} | {memory[0]:.0f} | {memory[1]:.0f} | {fit} |")


def percents(fits: dict[str, float], names: Sequence[str]) -> str:
    """Fits by run, in bold where the run was not fitted to."""
    return ", ".join(f"{n} {v:.1f} %" if n in names else f"{n} **{v:.1f} %**" for n, v in fits.items())


def arm(name: str, names: Sequence[str] = ("psf", "lqr")) -> None:
    """Fitted on both runs of the arm, or on one of them, and judged on each."""
    runs = {n: arm_run(n) for n in ("psf", "lqr")}
    structure = ftlm.equation(WORDS[name], sensor_filter=ftlm.SensorFilter.low_pass(FILTERED))
    identify, before, results = ftlm.identify, peak(), []
    seconds = processor_time(lambda: results.append(identify([runs[n] for n in names], structure, threads=1)))
    numbers = ", ".join(f"{p.name} {p.value:.4g}" for p in results[0].parameters.values())
    fits = {n: results[0].model.compare(run).fit["theta22"] for n, run in runs.items()}
    case = name if len(names) > 1 else f"{name} on {names[0]}"
    print_row(case, seconds, before, f"{results[0].fit['theta22']:.2f} %: {percents(fits, names)}; {numbers}")


def state_space(python: str) -> None:
    """The linear model of jax-sysid on the same runs, inputs and judged runs, by an interpreter that has it."""
    script = Path(__file__).with_name("state_space.py")
    runs = {n: arm_run(n) for n in ("psf", "lqr")}
    for way in ("as measured", "hub angles filtered"):
        arrays = {}
        for name, run in runs.items():
            signals = [np.asarray(run[n]) for n, _ in TERMS]
            if way != "as measured":
                signals = [
                    s if n in FILTERED else s[0] + response(STOCK[-1:], STOCK, s - s[0], run.step)
                    for s, (n, _) in zip(signals, TERMS, strict=True)
                ]
            arrays |= {f"{name}.y": run["theta22"][:, None], f"{name}.u": np.stack(signals, axis=1)}
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "runs.npz"
            np.savez(file, **arrays)
            for names in ("psf+lqr", "psf", "lqr"):
                command = [python, str(script), str(file), names]
                output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
                answer = json.loads(output.splitlines()[-1])
                if "absent" in answer:
                    print(f"| jax-sysid | | | | | {answer['absent']} |")
                    return
                first, setting_up = answer["seconds"][0], answer["setting_up"]
                fits = percents(answer["fits"]["one"], names.split("+"))
                best = percents(answer["fits"]["best"], names.split("+"))
                words = f"{fits}; best of {len(answer['seconds'])} starts {best}; {answer['numbers']} numbers"
                case = f"jax-sysid, order 4, {way}, on {names}"
                again = float(np.mean(answer["seconds"][1:]))
                row(case, [first, again - setting_up], (answer["peak"], answer["before"]), words)


def rival() -> None:
    """SciPy on the problem of five numbers, from the best of its own starts: both runs, filter, initial motions."""
    runs = [arm_run("psf"), arm_run("lqr")]
    signals = [{n: np.asarray(r[n]) for n in r.outputs} for r in runs]
    before, ends = peak(), []

    def residuals(point: np.ndarray) -> np.ndarray:
        pairs = zip(signals, runs, strict=True)
        parts = [projected(s, r.step, "theta22", point, TERMS, filtered=FILTERED)[1] for s, r in pairs]
        return np.concatenate(parts)

    def scaled(x: np.ndarray, scale: np.ndarray) -> np.ndarray:
        return residuals(x * scale)

    def all_starts() -> None:
        for start in STARTS:
            scale = np.abs(start)
            end = least_squares(scaled, np.sign(start), method="lm", max_nfev=60, args=(scale,))
            ends.append((float(end.cost), end.x * scale))

    seconds = processor_time(all_starts)
    cost, point = min(ends, key=lambda e: e[0])
    print_row("five, SciPy (terms by run)", seconds, before, f"a {point[0]:.4g}, d {point[1]:.4g}, cost {cost:.4g}")


def long(samples: int) -> None:
    """One long run, three numbers, one of them an order."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], size=samples // 50 + 1), 50)[:samples]
    machine = ftlm.Model(ftlm.equation("D^1.4 y = -4 y + 2 u"))
    drive = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": np.zeros(samples)})
    y = machine.simulate(drive, tolerance=1e-4)["y"]
    y = y + 0.01 * np.std(y) * rng.normal(size=samples)
    run = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": y})
    identify, before, results = ftlm.identify, peak(), []
    seconds = processor_time(lambda: results.append(identify(run, ftlm.equation("D^alpha y = a y + b u"), threads=1)))
    numbers = ", ".join(f"{p.name} {p.value:.6g}" for p in results[0].parameters.values())
    print_row(f"{samples} samples", seconds, before, f"{results[0].fit['y']:.2f} %: {numbers}")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=["five", "rival", "jax", "psf", "lqr", "three", "long", "longest"])
    parser.add_argument("--samples", type=int, default=50_000, help="of the long run, up to 1 048 576")
    parser.add_argument("--jax", default=sys.executable, help="interpreter of an environment with jax-sysid")
    parser.add_argument("--alone", action="store_true", help="measure in this process")
    parser.add_argument("--write", action="store_true", help="write benches/results.json")
    arguments = parser.parse_args()
    if arguments.alone:
        for case in arguments.cases:
            cases = {
                "long": lambda: long(arguments.samples),
                "longest": lambda: long(LONGEST),
                "rival": rival,
                "jax": lambda: state_space(arguments.jax),
                "psf": lambda: arm("five", ["psf"]),
                "lqr": lambda: arm("five", ["lqr"]),
            }
            cases.get(case, lambda case=case: arm(case))()
        return
    lines = [heading(), "", "| case | processor s | thousand FFTs | peak MB | before | found |", "| --- " * 6 + "|"]
    print("\n".join(lines), flush=True)
    alone = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    for case in arguments.cases:
        command = [
            sys.executable,
            __file__,
            case,
            "--samples",
            str(arguments.samples),
            "--jax",
            arguments.jax,
            "--alone",
        ]
        output = subprocess.run(command, capture_output=True, text=True, check=True, env=alone).stdout.strip()
        print(output, flush=True)
        lines.append(output)
    if arguments.write:
        save(lines)


if __name__ == "__main__":
    main()
