"""Functions of ftlm.kernels and operational matrices beside NumPy and SciPy.

``python benches/public_kernels.py [--write]`` prints processor times of one thread; ``--write`` writes them to
benches/results.json.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import fftconvolve

import ftlm
from ftlm import _core, kernels
from results import heading, save
from search import plant_a_run

M, STEP, ORDER, SIGNALS = 2048, 10.0 / 2048, 0.85, 256
#: Candidates that are scored without a limit, and the increment of their orders.
SCORED, INCREMENT = 512, 0.05
#: Samples of a recursion with four terms and p = 7.
SAMPLES = 20_000
#: Signals of the batch whose memory is measured, in a process of its own.
BATCH = 10_000


def shortest(work: Callable[[], object], seconds: float = 0.5) -> float:
    """Shortest processor time of a call [s], after a first one that is not counted."""
    work()
    best, total = np.inf, 0.0
    while total < seconds:
        start = time.process_time()
        work()
        each = time.process_time() - start
        best, total = min(best, each), total + each
    return best


def batch_memory() -> None:
    """Print the peak memory before and after the integrals of a batch [MB]."""
    x = np.ones((BATCH, M))

    def peak() -> float:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    before = peak()
    kernels.integrate(x, ORDER, step=STEP)
    print(before, peak())


def main() -> None:
    """Time, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="write benches/results.json")
    arguments = parser.parse_args()
    lines: list[str] = []

    def say(text: str) -> None:
        lines.append(text)
        print(text, flush=True)

    say(f"{heading()}, processor time")
    random = np.random.default_rng(1)
    x = random.standard_normal((SIGNALS, M))
    kernel = kernels.block_pulse_kernel(ORDER, M, step=STEP)
    spectrum = np.fft.rfft(kernel, 2 * M)

    def prepared() -> np.ndarray:
        return np.fft.irfft(np.fft.rfft(x, 2 * M, axis=-1) * spectrum, 2 * M, axis=-1)[:, :M]

    assert np.allclose(kernels.integrate(x, ORDER, step=STEP), prepared(), atol=1e-10)
    ours, numpy_time = shortest(lambda: kernels.integrate(x, ORDER, step=STEP)), shortest(prepared)
    scipy_time = shortest(lambda: fftconvolve(x, kernel[None], axes=-1)[:, :M])
    say(
        f"P19, integrate, {SIGNALS} signals of {M}: {ours / SIGNALS * 1e6:.1f} us each; NumPy, spectrum prepared, "
        f"{numpy_time / SIGNALS * 1e6:.1f} (ratio {ours / numpy_time:.2f}, promised 1); fftconvolve "
        f"{scipy_time / SIGNALS * 1e6:.1f}"
    )
    command = [sys.executable, "-c", "import public_kernels; public_kernels.batch_memory()"]
    answer = subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parent).stdout
    before, after = (float(value) for value in answer.split())
    result = BATCH * M * 8 / 2**20
    say(
        f"P19, integrate, {BATCH} signals of {M}: peak memory {after - before:.0f} MB above that of the argument; "
        f"the result has {result:.0f}"
    )
    first, row = np.concatenate([[1.0], random.standard_normal(M - 1) / M]), np.zeros(M)
    row[0] = first[0]
    assert np.allclose(kernels.toeplitz_solve(first, x[0]), solve_toeplitz((first, row), x[0]))
    ours = shortest(lambda: kernels.toeplitz_solve(first, x[0]))
    scipy_time = shortest(lambda: solve_toeplitz((first, row), x[0]))
    say(
        f"P19, toeplitz_solve, {M}: {ours * 1e6:.0f} us; SciPy {scipy_time * 1e6:.0f}, {scipy_time / ours:.0f} times "
        "ours (promised 50)"
    )
    ours, dense = (shortest(lambda of=of: _core.operational_matrix(ORDER, M, STEP, dense=of)) for of in (False, True))
    phi, square = ftlm.haar_matrix(M), ftlm.block_pulse_matrix(ORDER, M, step=STEP)
    numpy_time = shortest(lambda: phi @ square @ phi.T)
    say(
        f"Haar operational matrix of {M} by Toeplitz structure: {ours * 1e3:.0f} ms; dense by faer {dense * 1e3:.0f}, "
        f"by NumPy {numpy_time * 1e3:.0f}"
    )
    ours, dense = shortest(lambda: kernels.integrate(x, ORDER, step=STEP)), shortest(lambda: x @ square)
    assert np.allclose(kernels.integrate(x, ORDER, step=STEP), x @ square, atol=1e-10)
    say(
        f"block-pulse matrix of {M} times {SIGNALS} signals by Toeplitz products: {ours * 1e3:.1f} ms; dense by NumPy "
        f"{dense * 1e3:.1f}"
    )
    run = plant_a_run()
    means = np.stack([kernels.pulse_means(run[name], M, hold=name == "I1") for name in ("theta12", "theta11", "I1")])
    plan = kernels.Candidates(means, [0, 1, 0, 2], output=0, step=STEP)
    # Tuples of an order grid, whose integrals are shared, as in a search.
    alpha = random.integers(21, 41, SCORED)
    own = np.sort(random.integers(0, alpha[:, None], (SCORED, 2)))
    orders = np.column_stack([alpha, own[:, 1], random.integers(0, alpha), own[:, 0], 0 * alpha]) * INCREMENT
    plan.score(orders)
    ours = shortest(lambda: plan.score(orders))
    say(f"P19, Candidates.score without a limit, four terms: {ours / SCORED * 1e6:.1f} us a candidate (promised 40)")
    rows = np.cumsum(random.standard_normal((SAMPLES, 3)), axis=0) / 100

    def recursion() -> None:
        orders, hold = [1.9, 0.8, 0.5, 0.3, 0.0], [False, False, True]
        kernels.Recursion(orders, [0, 1, 0, 2], step=STEP, hold=hold, longest=SAMPLES).push(rows)

    say(f"Recursion, four terms, p = 7: {shortest(recursion) / SAMPLES * 1e6:.2f} us a sample (promised 1)")
    if arguments.write:
        save([f"- {line}" for line in lines])


if __name__ == "__main__":
    main()
