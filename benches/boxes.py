"""Growth of an exact order search with its lattice: Plant A's deflection, steps 0.05 to 0.005, and the real arm's.

``python benches/boxes.py [--steps 0.05 0.02 0.01] [--write]`` prints candidates, seconds of processors and of clock,
what became of the candidates, and the growth from each step to the next: the exponent of the candidates that the
processor time follows. ``--psf`` adds the real arm's first link, taken to be at rest; ``--squares`` ranks by squared
equation errors; ``--alpha 1.05 1.3`` takes a part of the lattice; ``--against-brute-force`` runs every candidate to
its end too and fails unless that keeps the same rows to the last bit (step 0.02: a quarter of an hour of one processor,
half the step sixteen times that); ``--write`` writes benches/results.json and docs/boxes.json, from which
the pages draw the growth.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from dataclasses import replace
from pathlib import Path

import ftlm
from arm_measured import arm_run
from results import commit, heading, machine, save
from search import M, plant_a_run

STEPS = (0.05, 0.02, 0.01, 0.005)
#: From this the pages draw the growth.
GROWTH = Path(__file__).resolve().parent.parent / "docs" / "boxes.json"


def main() -> None:
    """Search, time, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=float, nargs="+", default=STEPS)
    parser.add_argument("--noise", type=float, nargs="*", default=(1e-4, 1e-3), help="deviation on both angles [rad]")
    parser.add_argument("--psf", action="store_true", help="the measured run psf as well (FTLM_DATA)")
    parser.add_argument("--squares", action="store_true", help="rank by the equation error in squares")
    parser.add_argument("--alpha", type=float, nargs=2, default=(1.05, 2.0), help="its interval")
    parser.add_argument("--threads", type=int, help="all cores unless given")
    parser.add_argument("--against-brute-force", action="store_true", help="run every candidate to its end as well")
    parser.add_argument("--write", action="store_true", help="write benches/results.json")
    arguments = parser.parse_args()
    ranked: dict[str, str] = {"criterion": "equation-error", "norm": "l2"} if arguments.squares else {}
    options = {"coefficients": "least-squares", "m": M, "threads": arguments.threads, **ranked}
    by = ", squared equation error" if arguments.squares else ""
    equation = replace(ftlm.flexible_link(form="published", stage=1).equation("theta12"), initial="rest")
    runs = {f"Plant A, {noise:g} rad{by}": plant_a_run(noise, noise) for noise in arguments.noise}
    if arguments.psf:
        runs[f"psf{by}"] = arm_run("psf")
    lines = [heading()]
    print(lines[0], flush=True)
    searches: list[dict[str, str | float]] = []
    for name, run in runs.items():
        before: tuple[int, float] | None = None
        for step in arguments.steps:
            lattice = ftlm.order_grid(increment=step, alpha=tuple(arguments.alpha))
            wall, cpu = time.perf_counter(), time.process_time()
            result = ftlm.search_orders(run, equation, lattice, **options)
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            growth = ""
            if before is not None:
                exponent = math.log(cpu / before[1]) / math.log(result.candidates / before[0])
                growth = f", growth as candidates^{exponent:.2f}"
            before = result.candidates, cpu
            searches.append({"run": name, "step": step, "candidates": result.candidates, "processor": round(cpu, 2)})
            best = ", ".join(f"{n} {v:g}" for n, v in result.table[0].orders.items())
            lines.append(
                f"{name}, step {step:g}: {result.candidates} candidates, {cpu:.1f} s of processors, {wall:.1f} s, "
                f"{cpu / result.candidates * 1e9:.1f} ns each{growth}; bound {result.exclusion_counts['bound']} "
                f"({result.excluded_by_box} in boxes), stopped early "
                f"{result.exclusion_counts['stopped early']}, beaten {result.exclusion_counts['beaten']}; best "
                f"{result.table[0].score:.6g} "
                f"({best}), last kept {result.table[-1].score:.6g}"
            )
            print(lines[-1], flush=True)
            if arguments.against_brute_force:
                cpu = time.process_time()
                brute = ftlm.search_orders(run, equation, lattice, pruning=False, **options)
                cpu = time.process_time() - cpu
                # Every candidate was run: what is not kept was beaten, or has no score.
                followed = len(brute.table) + sum(brute.exclusion_counts[k] for k in ("beaten", "singular", "diverged"))
                same = result.table == brute.table and followed == brute.candidates == result.candidates
                lines.append(
                    f"{name}, step {step:g}: all {followed} candidates run to their end in {cpu:.0f} s of processors, "
                    f"{cpu / followed * 1e6:.1f} us each; the {len(brute.table)} kept rows (index, score, orders, "
                    f"coefficients) are {'the same to the last bit' if same else 'NOT THE SAME'}"
                )
                print(lines[-1], flush=True)
                if not same:
                    raise SystemExit("the search and brute force disagree")
    if arguments.write:
        save([f"- {line}" for line in lines])
        content = {"commit": commit(), "machine": machine(), "load": os.getloadavg()[0], "searches": searches}
        GROWTH.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
