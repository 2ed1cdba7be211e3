"""Closed loops, offsets and cells with a constant-phase element, measured by Monte-Carlo.

``python benches/loops.py WHAT [--seeds 30] [--write]`` prints tables; ``--write`` writes them to benches/results.json.
WHAT is loops, instruments, offsets or cell. Seeds are 0 to ``--seeds`` less one.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "python"))

import ftlm
import loops
from results import heading, save

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

STRUCTURE = ftlm.equation("D^alpha y = -a y + b u", initial="rest")


def workers() -> int:
    """Cores."""
    return int(os.environ.get("FTLM_WORKERS", os.cpu_count() or 1))


def covered(result: ftlm.Identification, truth: dict[str, float]) -> list[bool]:
    """Whether the 95 % interval of each number holds the truth."""
    return [result.intervals[n][0] <= v <= result.intervals[n][1] for n, v in truth.items()]


def one_loop(task: tuple[str, int, str]) -> tuple[list[bool], bool, bool, float]:
    """Coverage, whether the result says that there is a loop, whether it warns of one or of its instrument, alpha."""
    kind, seed, how = task
    method = ftlm.OutputError(reference="r" if how == "reference" else None)
    result = ftlm.identify(loops.loop(kind, seed), STRUCTURE, method=method, threads=1)
    reports_feedback = bool(result.residuals and result.residuals.outputs["y"].feedback)
    warned = any("closed loop" in w or "weak instrument" in w for w in result.warnings)
    return covered(result, loops.TRUTH), reports_feedback, warned, result.orders["alpha"]


def closed(seeds: int) -> Iterator[str]:
    """Coverage in closed and open loops, and what is said of them, with and without the reference as instrument."""
    with ProcessPoolExecutor(workers()) as pool:
        for how in ("measured", "reference"):
            for kind in loops.KINDS:
                ended = list(pool.map(one_loop, [(kind, s, how) for s in range(seeds)]))
                share = 100 * np.mean([e[0] for e in ended], axis=0)
                alpha = np.array([e[3] for e in ended])
                words = ", ".join(f"{n} {c:.0f} %" for n, c in zip(loops.TRUTH, share, strict=True))
                yield (
                    f"{kind}, inputs as {how}, {seeds} seeds: alpha {alpha.mean():.3f} ± {alpha.std():.3f} "
                    f"(truth 1.7), intervals cover {words}; loop found in {sum(e[1] for e in ended)}, "
                    f"warned in {sum(e[2] for e in ended)}"
                )


def one_instrument(seed: int) -> tuple[list[bool], float]:
    """Coverage by instrumental variables with the order free, on a record in white noise, and alpha."""
    result = ftlm.identify(loops.open_run(seed, noise=0.05), STRUCTURE, method="instrumental-variables", threads=1)
    return covered(result, {**loops.TRUTH, "alpha": 1.73}), result.orders["alpha"]


def instruments(seeds: int) -> Iterator[str]:
    """Coverage by instrumental variables with a free order."""
    with ProcessPoolExecutor(workers()) as pool:
        ended = list(pool.map(one_instrument, range(seeds)))
    share = 100 * np.mean([e[0] for e in ended], axis=0)
    words = ", ".join(f"{n} {c:.0f} %" for n, c in zip(loops.TRUTH, share, strict=True))
    alpha = np.array([e[1] for e in ended])
    yield (
        f"instrumental variables, alpha free on its lattice, 5 % white noise, {seeds} seeds: alpha {alpha.mean():.3f} "
        f"± {alpha.std():.3f} (truth 1.73), intervals cover {words}"
    )


def one_offset(task: tuple[str, float, int, str]) -> tuple[bool, bool, list[float], float, float]:
    """Whether an offset was estimated, whether one was spoken of, errors of the numbers, their size, seconds."""
    kind, constant, seed, offset = task
    run, structure, truth = loops.offset_run(kind, constant, seed)
    start = time.process_time()
    result = ftlm.identify(run, structure, offset=offset, threads=1)
    seconds = time.process_time() - start
    values = {n: p.value for n, p in result.parameters.items()}
    errors = [values[n] - v for n, v in truth.items()]
    reports_offset = any("unknown constant" in w for w in result.warnings)
    return bool(result.comparison.offsets), reports_offset, errors, float(np.mean(covered(result, truth))), seconds


def offsets(seeds: int) -> Iterator[str]:
    """What offset="auto" and no offset do to records with and without one."""
    with ProcessPoolExecutor(workers()) as pool:
        for kind, constants in loops.OFFSETS.items():
            for constant in constants:
                base: np.ndarray | None = None
                for offset in ("none", "auto"):
                    ended = list(pool.map(one_offset, [(kind, constant, s, offset) for s in range(seeds)]))
                    spread = np.sqrt(np.mean(np.square([e[2] for e in ended]), axis=0))
                    more = "" if base is None else f", {np.max(spread / base):.3f} times those without at most"
                    base = spread if base is None else base
                    yield (
                        f"{kind} + {constant:g}, offset={offset!r}, {seeds} seeds: estimated in "
                        f"{sum(e[0] for e in ended)}, spoken of in {sum(e[1] for e in ended)}; errors "
                        f"{', '.join(f'{s:.2g}' for s in spread)}{more}; intervals cover "
                        f"{100 * np.mean([e[3] for e in ended]):.0f} %; {np.mean([e[4] for e in ended]):.2f} s a fit"
                    )


def cell(seeds: int) -> Iterator[str]:
    """A Randles cell with a constant-phase element, 50 000 rows, against the relaxation spectrum."""
    truth = loops.CELL
    for hold in ("zoh", "foh"):
        ended = []
        for seed in range(seeds):
            run = loops.cell_run(50_000, 0.01, hold, seed, noise=0.01)
            start = time.process_time()
            result = ftlm.identify(run, loops.CELL_STRUCTURE, threads=1)
            z = [(result.parameters[n].value - v) / result.standard_errors[n] for n, v in truth.items()]
            ended.append((z, time.process_time() - start, result))
        z = np.array([e[0] for e in ended])
        last = ended[-1][2]
        words = ", ".join(f"{n} {last.parameters[n].value:.5g} ± {last.standard_errors[n]:.2g}" for n in truth)
        yield (
            f"cell, {hold}, 50 000 rows, 1 % noise, {seeds} seeds: mean z "
            f"{', '.join(f'{v:.2f}' for v in z.mean(axis=0))}, covered {100 * np.mean(np.abs(z) < 1.96):.0f} %; the "
            f"last {words} (truth {', '.join(f'{v:.5g}' for v in truth.values())}); "
            f"{np.mean([e[1] for e in ended]):.1f} s a fit"
        )


def main() -> None:
    """Measure and print; write them with ``--write``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("loops", "instruments", "offsets", "cell"))
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--write", action="store_true", help="write benches/results.json")
    arguments = parser.parse_args()
    rows: Iterable[str] = {"loops": closed, "instruments": instruments, "offsets": offsets, "cell": cell}[
        arguments.what
    ](arguments.seeds)
    lines = [f"{heading()}:", ""]
    print(lines[0])
    for row in rows:
        lines.append(f"- {row}")
        print(lines[-1], flush=True)
    if arguments.write:
        save(lines)


if __name__ == "__main__":
    main()
