"""Order search on Plant A's deflection: ours, brute force, and the paper's algorithm written literally, in one run.

``python benches/search.py [--write]`` prints ratios; ``--write`` writes them to benches/results.json.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

import ftlm
import literal
from ftlm.reproduction.simulated_arm import demo_plant
from ftlm.simulation.discretization import record
from ftlm.utils.validation import available_threads
from results import heading, save

#: Candidates that the literal algorithm is timed on; each takes seconds.
LITERAL = 20
#: Candidates evaluated without early stopping: enough for a mean to 1 %.
BRUTE_STEP = 0.2
M = 2048


def plant_a_run(hub: float = 1e-3, deflection: float = 1e-4) -> ftlm.Run:
    """Point samples of Plant A under the square current, 10 s at 2 ms, with noise of these deviations in rad."""
    rows = 5001
    t = np.arange(rows) * 0.002
    current = np.where((t + 0.001) % 2 < 1, 0.3, -0.3)
    blank = ftlm.Run.from_arrays(
        step=0.002, inputs={"I1": current}, outputs={n: np.zeros(rows) for n in ("theta11", "theta12")}, name="plant A"
    )
    truth = ftlm.simulate(demo_plant(1, form="published"), blank, tolerance=1e-8)
    rng = np.random.default_rng(7)
    noisy = {"theta11": hub, "theta12": deflection}
    return ftlm.Run.from_arrays(
        step=0.002,
        inputs={"I1": current},
        outputs={n: truth[n] + s * rng.standard_normal(rows) for n, s in noisy.items()},
        name="plant A",
    )


def fft_time() -> float:
    """Seconds of one forward real FFT of length 4096, NumPy."""
    x = np.random.default_rng(1).standard_normal(4096)
    best = np.inf
    for _ in range(20):
        start = time.perf_counter()
        for _ in range(100):
            np.fft.rfft(x)
        best = min(best, (time.perf_counter() - start) / 100)
    return best


def main() -> None:
    """Time, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="write benches/results.json")
    write = parser.parse_args().write
    threads = available_threads()
    run = plant_a_run()
    equation = replace(ftlm.flexible_link(form="published", stage=1).equation("theta12"), initial="rest")
    lines: list[str] = []

    def say(text: str) -> None:
        lines.append(text)
        print(text, flush=True)

    say(f"{heading()}, {threads} threads")
    fft = fft_time()
    say(f"one forward real FFT of 4096 (NumPy): {fft * 1e6:.1f} us")

    per_candidate: dict[str, float] = {}
    for coefficients in ("least-squares", "multi-innovation"):
        start = time.perf_counter()
        scan = ftlm.search_orders(run, equation, ftlm.order_grid(alpha=(1.05, 2.0)), coefficients=coefficients, m=M)
        wall = time.perf_counter() - start
        cost = per_candidate[coefficients] = wall * threads / scan.candidates
        bounded, stopped = (scan.exclusion_counts[k] / scan.candidates for k in ("bound", "stopped early"))
        say(
            f"lattice, {coefficients}: {scan.candidates} candidates in {wall:.2f} s, {cost * 1e6:.2f} us of core time "
            f"each ({cost / fft:.3f} FFTs), {100 * bounded:.2f} % excluded by their bound, "
            f"{100 * stopped:.2f} % stopped early"
        )
    start = time.perf_counter()
    brute = ftlm.search_orders(
        run,
        equation,
        ftlm.order_grid(increment=BRUTE_STEP, alpha=(1.2, 2.0)),
        coefficients="least-squares",
        m=M,
        pruning=False,
    )
    cost = (time.perf_counter() - start) * threads / brute.candidates
    ours = per_candidate["least-squares"]
    say(f"brute force: {brute.candidates} candidates, {cost * 1e6:.1f} us each: {cost / ours:.1f} times ours")

    # The same candidates, evenly spread over the coarse lattice's ranked table.
    table = ftlm.search_orders(
        run,
        equation,
        ftlm.order_grid(increment=BRUTE_STEP, alpha=(1.2, 2.0)),
        innovation_length=7,
        top=100_000,
        m=M,
        pruning=False,
    ).table
    rec = record(run, equation, M)
    y, hub, current = (rec.of(n) for n in ("theta12", "theta11", "I1"))
    worst = total = 0.0
    picked = [table[i] for i in np.linspace(0, len(table) // 4, LITERAL).astype(int)]
    for row in picked:
        orders = (row.orders["alpha2"], row.orders["beta2"], row.orders["gamma2"], row.orders["mu2"], 0.0)
        start = time.perf_counter()
        theirs = literal.evaluate_candidate(y, [None, hub, None, current], orders, 7, 1.0, m=M, duration=rec.step * M)
        total += time.perf_counter() - start
        worst = max(worst, abs(theirs.error - row.score) / row.score)
        expected = np.array([row.coefficients[n] for n in ("a2", "b2", "d2", "g2")])
        worst = max(worst, float(np.max(np.abs(theirs.coefficients - expected) / np.max(np.abs(expected)))))
    cost = total / LITERAL
    ours = per_candidate["multi-innovation"]
    say(
        f"the paper's algorithm in NumPy: {cost:.2f} s a candidate ({LITERAL} of them): {cost / ours:.3g} times ours; "
        f"largest relative difference of error and coefficients {worst:.1e}"
    )
    if worst > 1e-6:
        raise SystemExit("the literal algorithm and ours disagree")
    if write:
        save([f"- {line}" for line in lines])


if __name__ == "__main__":
    main()
