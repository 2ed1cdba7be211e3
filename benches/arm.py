"""The Euler-Lagrange form of the arm, measured: recovery from the automatic start, and real runs that it never saw.

``python benches/arm.py recovery [--seeds 20] [--first 0] [--levels 20,40,60,80]`` fits stage 1 and stage 2 under
square, sine and multisine currents with both angles following from the current, and says how far the truth lies from
each estimate. ``python benches/arm.py measured`` fits the deflections of the real arm on the run of one laboratory and
judges them on that of the other. Each row is printed as soon as it is known.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "python"))

import ftlm
from lagrange import INPUTS, clean_run, structure, truth
from plants import with_noise

NORMAL_95 = 1.959963984540054
FOLDER = Path(os.environ.get("FTLM_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
ANGLES = {"theta11": "th11_deg", "theta12": "th12_deg", "theta21": "th21_deg", "theta22": "th22_deg"}


def recovery(seeds: range, levels: list[float]) -> None:
    """z-scores of all nine numbers, seed by seed, then their table."""
    found: dict[tuple[int, str, float], list[np.ndarray]] = {}
    lost: dict[tuple[int, str, float], int] = {}
    for seed in seeds:
        for stage in (1, 2):
            for shape in INPUTS:
                for level in levels:
                    key = (stage, shape, level)
                    run = with_noise(clean_run(stage, shape), level, [seed, round(level), stage])
                    start = time.process_time()
                    try:
                        fit = ftlm.identify(run, structure(stage), method="output-error", threads=1).joint
                    except ftlm.FtlmError as error:
                        lost[key] = lost.get(key, 0) + 1
                        print(*key, seed, error, flush=True)
                        continue
                    values = dict(zip(fit.names, fit.values.tolist(), strict=True))
                    z = np.array([(values[n] - v) / fit.standard_errors[n] for n, v in truth(stage).items()])
                    found.setdefault(key, []).append(z)
                    print(
                        *key,
                        seed,
                        f"largest |z| {np.abs(z).max():.2f}",
                        f"{time.process_time() - start:.1f} s",
                        flush=True,
                    )
    for key, scores in found.items():
        z = np.abs(np.stack(scores))
        near = int(np.sum(z.max(axis=1) < 5.0))
        print(
            f"| {key[0]} | {key[1]} | {key[2]:g} | {near} of {len(z) + lost.get(key, 0)} | "
            f"{100.0 * np.mean(z < NORMAL_95):.1f} | {z.max():.1f} |", flush=True,
        )  # fmt: skip


def arm_run(name: str, thin: int = 4) -> ftlm.Run:
    """One of the two laboratories' runs, thinned to 8 ms, in rad."""
    run = ftlm.load(
        FOLDER / f"two_link_{name}" / f"{name}.csv", time="t_s", inputs={"I1": "Im1_meas_A", "I2": "Im2_meas_A"},
        outputs=ANGLES, units=dict.fromkeys(ANGLES, "deg"), intersample={"I1": "foh", "I2": "foh"},
    )  # fmt: skip
    if name == "psf":
        run = run.slice(1.1, 19.5)
    signals = {n: run[n][::thin] for n in (*run.inputs, *run.outputs)}
    return ftlm.Run.from_arrays(
        step=thin * run.step, inputs={n: signals[n] for n in run.inputs}, outputs={n: signals[n] for n in run.outputs},
        units=run.units, intersample=run.intersample, name=name,
    )  # fmt: skip


#: The link's equation (15) and what arm.md's table adds, term by term.
WORDS = {
    "(15), whole orders": "D^2 theta12 = a theta12 + d D theta12 + b D^2 theta11",
    "+ stage 2 pushes back": "D^2 theta12 = a theta12 + d D theta12 + b D^2 theta11 + p D^2 theta21 + q theta22",
    "+ hub angles in the gauge": "D^2 theta12 = a theta12 + d D theta12 + b D^2 theta11 + p D^2 theta21 + q theta22"
    " + s theta21 + r theta11",
    "+ a spring-pot": "D^2 theta12 = a D^beta theta12 + d D theta12 + b D^2 theta11 + p D^2 theta21 + q theta22"
    " + s theta21 + r theta11",
    "the same, b = -1": "D^2 theta12 = a theta12 + d D theta12 - D^2 theta11 + p D^2 theta21 + q theta22"
    " + s theta21 + r theta11",
    "the same, b = -1, a spring-pot": "D^2 theta12 = a D^beta theta12 + d D theta12 - D^2 theta11 + p D^2 theta21"
    " + q theta22 + s theta21 + r theta11",
    "inertial, b = -1": "D^2 theta12 = a theta12 + d D theta12 - D^2 theta11 + p D^2 theta21 + q D^2 theta22",
    "theta22, whole orders": "D^2 theta22 = a theta22 + d D theta22 + b D^2 theta21 + p D^2 theta11 + q D^2 theta12",
    "theta22, b = -1": "D^2 theta22 = a theta22 + d D theta22 - D^2 theta21 + p D^2 theta11 + q D^2 theta12",
    "theta22, hub angles": "D^2 theta22 = a theta22 + d D theta22 + b D^2 theta21 + p D^2 theta11 + q D^2 theta12"
    " + e theta21 + f theta11",
}


def measured() -> None:
    """Fitted on each run and on both; judged on each by the free run with the other angles as measured."""
    runs = {n: arm_run(n) for n in ("psf", "lqr")}
    structures = {}
    for name, text in WORDS.items():
        seen = [s for s in ("theta12", "theta22") if s in text]
        structures[name] = ftlm.equation(text, sensor_filter=ftlm.SensorFilter.low_pass(seen))
    link = ftlm.flexible_link(stage=1, sensor_filter="stock").equation("theta12")
    whole = {"beta2": 0.0, "gamma2": 2.0, "mu2": 1.0}
    free_b = ftlm.flexible_link(stage=1, sensor_filter="stock", laws=()).equation("theta12")
    structures["flexible_link, whole, b = -1"] = link.with_orders(whole)
    structures["flexible_link, whole, b free"] = free_b.with_orders(whole)
    structures["flexible_link, orders free, b = -1"] = link
    structures["flexible_link, orders free, b free"] = free_b
    pushed = ftlm.flexible_link(stage=2, cross_stage="inertial", sensor_filter="stock").equation("theta22")
    structures["flexible_link, inertial, theta22"] = pushed.with_orders({"beta4": 0.0, "gamma4": 2.0, "mu4": 1.0})
    for name, words in structures.items():
        output = words.outputs[0]
        for used in (("psf",), ("lqr",), ("psf", "lqr")):
            start = time.process_time()
            try:
                found = ftlm.identify([runs[u] for u in used], words, method="output-error", threads=1)
                fits = {n: found.model.compare(r).fit_percent[output] for n, r in runs.items()}
                values = ", ".join(
                    f"{n} {v:.4g} ± {found.joint.standard_errors[n]:.2g}"
                    for n, v in zip(found.joint.names, found.joint.values.tolist(), strict=True)
                )
                judged = ", ".join(f"{n} {v:.1f}" for n, v in fits.items())
            except ftlm.FtlmError as error:
                judged, values = str(error), ""
            print(
                f"| {name} | {'+'.join(used)} | {judged} | {values} | {time.process_time() - start:.0f} s", flush=True
            )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("recovery", "measured"))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--levels", default="20,40,60,80")
    given = parser.parse_args()
    if given.what == "measured":
        measured()
    else:
        recovery(range(given.first, given.first + given.seeds), [float(v) for v in given.levels.split(",")])


if __name__ == "__main__":
    main()
