"""Order searches by multi-innovation (p = 7) beside least squares, on the order grids of promise P14.

``python benches/multi_innovation.py [--write] [--quick]`` prints processor times of one thread; ``--write`` writes them
to benches/results.json, ``--quick`` searches the coarsest grid alone.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import ftlm
from results import heading, save
from search import plant_a_run

M = 2048
#: Increments of the order grids; the finest has some 10^8 candidates.
INCREMENTS = (0.05, 0.02, 0.01)


def main() -> None:
    """Time, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="write benches/results.json")
    parser.add_argument("--quick", action="store_true", help="search the coarsest grid alone")
    arguments = parser.parse_args()
    run = plant_a_run()
    equation = replace(ftlm.flexible_link(form="published", stage=1).equation("theta12"), initial="rest")
    lines: list[str] = []

    def say(text: str) -> None:
        lines.append(text)
        print(text, flush=True)

    def searched(increment: float, coefficients: str, **options: float) -> tuple[int, float]:
        grid = ftlm.order_grid(increment=increment, alpha=(1.05, 2.0))
        start = time.process_time()
        result = ftlm.search_orders(run, equation, grid, coefficients=coefficients, m=M, threads=1, **options)
        return result.candidates, time.process_time() - start

    say(f"- {heading()}, processor time")
    for increment in INCREMENTS[: 1 if arguments.quick else None]:
        count, squares = searched(increment, "least-squares")
        _, weak = searched(increment, "multi-innovation", innovation_length=7)
        say(
            f"- P14, increment {increment:g}, {count} candidates: least squares {squares:.2f} s, multi-innovation "
            f"{weak:.2f} (ratio {weak / squares:.2f}, promised 3)"
        )
    # The paper's prior leaves most candidates open, so that finer grids take hours.
    _, paper = searched(INCREMENTS[0], "multi-innovation", innovation_length=7, prior_covariance=1.0)
    say(f"- P14, increment {INCREMENTS[0]:g}, K0 = 1: {paper:.2f} s (promised 6)")
    if arguments.write:
        save(lines)


if __name__ == "__main__":
    main()
