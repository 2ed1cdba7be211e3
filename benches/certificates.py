"""Certificates over all orders: Plant A's deflection at several noises, and the real arm's first link.

``python benches/certificates.py [--within 0.2 0.05] [--noise 1e-4] [--psf] [--write]`` prints what is proved of all
orders between those of a lattice of step 0.05, in how many boxes, and in what time; ``--write`` writes it to
benches/results.json.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import ftlm
from arm_measured import arm_run
from results import heading, save
from search import M, plant_a_run


def main() -> None:
    """Prove, time, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--within", type=float, nargs="+", default=(0.2, 0.05))
    parser.add_argument("--noise", type=float, nargs="*", default=(1e-4, 1e-3), help="deviation on both angles [rad]")
    parser.add_argument("--psf", action="store_true", help="the measured run psf as well (FTLM_DATA)")
    parser.add_argument("--alpha", type=float, nargs=2, default=(1.05, 2.0), help="its interval")
    parser.add_argument("--apart", type=float, default=0.05, help="how far orders are kept apart")
    parser.add_argument("--write", action="store_true", help="write benches/results.json")
    arguments = parser.parse_args()
    equation = replace(ftlm.flexible_link(form="published", stage=1).equation("theta12"), initial="rest")
    runs = {f"Plant A, {noise:g} rad": plant_a_run(noise, noise) for noise in arguments.noise}
    if arguments.psf:
        runs["psf"] = arm_run("psf")
    lines = [heading()]
    print(lines[0], flush=True)
    for name, run in runs.items():
        for within in arguments.within:
            wall, cpu = time.perf_counter(), time.process_time()
            proved = ftlm.certify_orders(
                run,
                equation,
                ftlm.order_grid(alpha=tuple(arguments.alpha)),
                tolerance=within,
                min_separation=arguments.apart,
                m=M,
            )
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            best = ", ".join(f"{n} {v:.5g}" for n, v in proved.orders.items())
            lines.append(
                f"{name}, alpha {arguments.alpha[0]:g} to {arguments.alpha[1]:g}, orders {arguments.apart:g} apart, "
                f"{within:g} asked: proved {proved.proved_tolerance:.4g} (at least {proved.lower_bound:.5g}, best "
                f"{proved.best:.5g} "
                f"at {best}), {proved.cells} boxes, {proved.open_cells} left, {cpu:.1f} s of processors, {wall:.1f} s"
            )
            print(lines[-1], flush=True)
    if arguments.write:
        save([f"- {line}" for line in lines])


if __name__ == "__main__":
    main()
