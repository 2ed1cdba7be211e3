"""The next experiment on Plant A: intervals after the designed run beside those after the paper's square.

``python benches/next_experiment.py [--seeds 20] [--criterion D] [--write]``: of each seed the paper's square of ten
seconds is identified from an automatic start, the next input is designed on that model with its noise, within the
square's peak and the largest angles that it moved, Plant A answers with noise of the same deviations, and that run is
identified alone from an automatic start. Finished seeds are kept in ``--kept`` and not done again. ``--write`` writes
benches/results.json and docs/next_experiment.json, from which the page draws its table and its picture.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "python"))

import numpy as np

import ftlm
import plants
from ftlm.reproduction.simulated_arm import demo_plant
from results import commit, heading, machine, save

LEVEL = 40.0
ORDERS = ("alpha1", "alpha2", "gamma1", "beta2", "mu2")
DOCS_FILE = Path(__file__).resolve().parent.parent / "docs" / "next_experiment.json"


def one(seed: int, criterion: str) -> dict[str, Any]:
    """One seed: predicted and found."""
    structure, clean = plants.structure("A"), plants.clean_run("A")
    square = plants.noisy_run("A", LEVEL, seed)
    first = ftlm.identify(square, structure, threads=1)
    start_time = time.process_time()
    designed = ftlm.design_input(first, criterion=criterion, seed=seed)
    seconds = time.process_time() - start_time
    truth = demo_plant(1, form="published").simulate(designed.run, tolerance=1e-8)
    rng = np.random.default_rng([2026, seed])
    # The gauge and the encoder are as noisy as in the square.
    noisy = {
        o: truth[o] + np.std(clean[o]) * 10 ** (-LEVEL / 20) * rng.standard_normal(truth.length) for o in truth.outputs
    }
    run = ftlm.Run.from_arrays(step=truth.step, inputs={"I1": truth["I1"]}, outputs=noisy, name=f"designed {seed}")
    second = ftlm.identify(run, structure, threads=1)
    return {
        "seed": seed,
        "criterion": criterion,
        "seconds": seconds,
        "gain": designed.gain,
        "shape": designed.shape,
        "efficiency": designed.efficiency,
        "binding": list(designed.active_constraints),
        "predicted": {k: dict(designed.standard_errors[k]) for k in ("now", "square", "designed", "both")},
        "found": {n: v for n, v in second.standard_errors.items() if n in designed.values},
        "estimates": {n: p.value for n, p in second.parameters.items()},
        "correlated": np.asarray(second.joint.covariance).tolist() if second.joint is not None else [],
        "names": second.joint.names if second.joint is not None else [],
        "largest": {o: float(np.max(np.abs(truth[o]))) for o in truth.outputs},
        "allowed": {r.name: r.limit for r in designed.predicted_extremes},
        **({"input": [float(v) for v in designed.run["I1"]]} if seed == 0 else {}),
        **({"angles": {o: [round(float(v), 6) for v in truth[o][::10]] for o in truth.outputs}} if seed == 0 else {}),
    }


def lines_of(rows: list[dict[str, Any]]) -> list[str]:
    """What came of it, in words."""
    truth = plants.truth("A")
    product = [np.prod([r["predicted"]["now"][n] / r["found"][n] for n in ORDERS]) for r in rows]
    gains = [np.prod([r["predicted"]["now"][n] / r["predicted"]["designed"][n] for n in ORDERS]) for r in rows]
    each = np.array([[r["found"][n] / r["predicted"]["designed"][n] for n in truth] for r in rows])
    off = np.array([[r["estimates"][n] - truth[n] for n in truth] for r in rows])
    foretold = np.array([[r["predicted"]["designed"][n] for n in truth] for r in rows])
    z, own = off / foretold, [list(truth).index(n) for n in ORDERS]
    coverage = np.mean(np.abs(off) <= 1.96 * np.array([[r["found"][n] for n in truth] for r in rows]))
    ratios = [max(r["largest"][o] / r["allowed"][o] for o in r["largest"]) for r in rows]
    return [
        f"{len(rows)} seeds, {rows[0]['criterion']}: product of the orders' intervals smaller than after the square by "
        f"{np.median(product):.1f} times (median; {min(product):.1f} to {max(product):.1f}), predicted "
        f"{np.median(gains):.1f} ({min(gains):.1f} to {max(gains):.1f})",
        f"standard errors found over predicted, all ten numbers of all seeds: {np.min(each):.3f} to {np.max(each):.3f}",
        f"spread of the estimates around the truth over predicted: root mean square {np.sqrt(np.mean(z**2)):.3f} "
        f"over all numbers and seeds, {np.sqrt(np.mean(z[:, own] ** 2)):.3f} over orders "
        f"({len(rows)} seeds know one number's to ± {100 / np.sqrt(2 * len(rows)):.0f} %); 95 % intervals hold the "
        f"truth in {100 * coverage:.1f} %",
        f"largest angle of the plant over its limit: {max(ratios):.3f}; efficiency "
        f"{np.median([r['efficiency'] for r in rows]):.2f} (median); a design takes "
        f"{np.median([r['seconds'] for r in rows]):.0f} s of processor time",
    ]


def main() -> None:
    """Measure, print, keep."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--criterion", choices=("D", "E"), default="D")
    parser.add_argument("--kept", type=Path, default=Path("next_experiment.jsonl"))
    parser.add_argument("--write", action="store_true", help="write benches/results.json and what the page shows")
    arguments = parser.parse_args()
    rows: dict[int, dict[str, Any]] = {}
    if arguments.kept.exists():
        read = [json.loads(line) for line in arguments.kept.read_text(encoding="utf-8").splitlines()]
        rows = {r["seed"]: r for r in read if r["criterion"] == arguments.criterion}
    for seed in range(arguments.seeds):
        if seed not in rows:
            rows[seed] = one(seed, arguments.criterion)
            with arguments.kept.open("a", encoding="utf-8") as file:
                file.write(json.dumps(rows[seed]) + "\n")
        print(seed, rows[seed]["gain"], rows[seed]["shape"], flush=True)
    every = [rows[k] for k in range(arguments.seeds)]
    lines = [f"{heading()}:", "", *(f"- {line}" for line in lines_of(every))]
    print("\n".join(lines))
    if arguments.write:
        save(lines)
        every = [{k: v for k, v in r.items() if k not in ("correlated", "names")} for r in every]
        content = {"commit": commit(), "machine": machine(), "cores": os.cpu_count(), "seeds": every}
        DOCS_FILE.write_text(json.dumps(content) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
