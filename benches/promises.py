"""Each promise of speed and memory beside its rival, in one run; instruction budgets of the hottest kernels.

``python benches/promises.py [--write] [--quick]`` prints them; ``--write`` writes them to benches/results.json and
writes docs/performance.json, from which the pages draw cost against size; ``--only P3,growth`` runs parts. Core time is
processor time, which other work on the machine disturbs less than wall time does.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import resource
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import ftlm
from ftlm.kernels import block_pulse_kernel
from ftlm.order_search.options import MAX_IV_ITERATIONS
from ftlm.simulation.discretization import record
from ftlm.utils.validation import available_threads
from results import commit, heading, save
from search import fft_time, plant_a_run

HERE = Path(__file__).parent
M = 2048
#: What the pages draw.
GROWTH = HERE.parent / "docs" / "performance.json"
#: Instructions a unit of work; a rise of more than a tenth is printed as one.
BUDGET = HERE / "instructions.json"
lines: list[str] = []
times: dict[str, float] = {}


def say(text: str) -> None:
    """Print and keep."""
    lines.append(text)
    print(text, flush=True)


def judge(name: str, what: str, ratio: float, promise: float, rival: str) -> None:
    """One promise: reached where the ratio is at most (or, for a rate, the inverse) what is promised."""
    verdict = "reached" if ratio <= promise else "NOT REACHED"
    say(f"{name} {verdict}: {what}: {ratio:.3g} (promised {promise:.3g}); {rival}")


def clocked(work):
    """Result, wall and processor seconds of a call."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, time.perf_counter() - wall, time.process_time() - cpu


def searches(quick: bool) -> None:
    """P1 and P2."""
    threads = available_threads()
    equation = replace(ftlm.flexible_link(form="published", stage=1).equation("theta12"), initial="rest")
    lattice = ftlm.order_grid(alpha=(1.05, 2.0))
    options = {"coefficients": "least-squares", "m": M}
    clean, coarse = plant_a_run(), ftlm.order_grid(increment=0.1, alpha=(1.1, 2.0))
    brute, _, cpu = clocked(lambda: ftlm.search_orders(clean, equation, coarse, pruning=False, **options))
    brute_each = cpu / brute.candidates
    for hub, deflection in ((1e-3, 1e-4), (1e-4, 1e-4), (1e-3, 1e-3)):
        run = plant_a_run(hub, deflection)
        fft = fft_time()
        result, wall, cpu = min(
            (clocked(lambda run=run: ftlm.search_orders(run, equation, lattice, **options)) for _ in range(3)),
            key=lambda r: r[2],
        )
        each = cpu / result.candidates
        shares = ", ".join(
            f"{100 * result.exclusion_counts[k] / result.candidates:.2f} % {k}" for k in ("bound", "stopped early")
        )
        judge(
            "P1",
            f"noise {hub:g} and {deflection:g} rad, core time a candidate over one real FFT of 4096",
            each / fft,
            1 / 8,
            f"{result.candidates} in {wall:.2f} s, {each * 1e6:.3f} us each, NumPy's FFT {fft * 1e6:.1f} us; {shares}; "
            f"brute force {brute_each * 1e6:.0f} us each, {brute_each / each:.0f} times ours",
        )
    run = plant_a_run()
    step = 0.05 if quick else 0.015
    result, wall, cpu = min(
        (
            clocked(
                lambda: ftlm.search_orders(
                    run,
                    equation,
                    ftlm.order_grid(increment=step, alpha=(1.05, 2.0)),
                    criterion="equation-error",
                    norm="l2",
                    m=M,
                )
            )
            for _ in range(3)
        ),
        key=lambda r: r[2],
    )
    numpy_each = numpy_solve(run, equation)
    rate = result.candidates / cpu * threads
    for name, promise in (("P2", 60), ("P2'", 120)):
        judge(
            name,
            f"{promise} million a second over candidates a second on all cores",
            promise * 1e6 / rate,
            1,
            f"{result.candidates} candidates by processor time {rate / 1e6:.1f} million/s on {threads} cores, by wall "
            f"time {result.candidates / wall / 1e6:.1f}; NumPy's batched solve {1 / numpy_each / 1e6:.2f} million/s on "
            f"one",
        )


def refined(quick: bool) -> None:
    """P3: coefficients by instrumental variables."""
    threads = available_threads()
    equation = replace(ftlm.flexible_link(form="published", stage=1).equation("theta12"), initial="rest")
    step = 0.1 if quick else 0.05
    for hub, deflection in ((1e-3, 1e-4), (1e-3, 1e-3)):
        run = plant_a_run(hub, deflection)
        result, wall, cpu = clocked(
            lambda run=run: ftlm.search_orders(
                run,
                equation,
                ftlm.order_grid(increment=step, alpha=(1.05, 2.0)),
                coefficients="instrumental-variables",
                m=M,
            )
        )
        each, rival = cpu / result.candidates, numpy_refinement(run, equation)
        shares = ", ".join(
            f"{100 * result.exclusion_counts[k] / result.candidates:.1f} % {k}" for k in ("bound", "stopped early")
        )
        judge(
            "P3",
            f"instrumental variables, noise {hub:g} and {deflection:g} rad, seconds by processor time on "
            f"{threads} cores over 30{', an eighth of the lattice' if quick else ''}",
            cpu / threads / 30,
            1,
            f"{result.candidates} candidates, exact top 20, in {wall:.1f} s of wall time, {each * 1e6:.0f} us each, up "
            f"to {MAX_IV_ITERATIONS} steps for all but what a bound over all coefficients excludes; {shares}; in NumPy "
            f"{rival * 1e3:.1f} ms each, {rival / each:.0f} times ours",
        )


def numpy_refinement(run: ftlm.Run, equation: ftlm.Structure) -> float:
    """Seconds a candidate of the same refinement in NumPy: filter 1/D, simulated instruments, as many steps."""
    from scipy.signal import lfilter  # noqa: PLC0415

    rec = record(run, equation, M)
    y, hub, current = (rec.of(n) for n in ("theta12", "theta11", "I1"))
    signals = (y, y, hub, current)

    def times(a, b):
        return np.fft.irfft(np.fft.rfft(a, 2 * M) * np.fft.rfft(b, 2 * M))[:M]

    start = time.process_time()
    kernels = [block_pulse_kernel(eta, M, step=rec.step) for eta in (1.9, 1.15, 0.95, 2.0)]
    columns = [times(k, s) for k, s in zip(kernels, signals, strict=True)]
    c = np.linalg.lstsq(np.stack(columns, axis=1), y, rcond=None)[0]
    unit = np.eye(1, M)[0]
    for _ in range(MAX_IV_ITERATIONS):
        divisor = unit - c[0] * kernels[0] - c[1] * kernels[1]
        inverse = lfilter([1.0], divisor, unit)
        response = times(inverse, c[2] * columns[2] + c[3] * columns[3])
        phi = np.stack([times(inverse, x) for x in columns])
        own = times(inverse, response)
        psi = np.stack([times(kernels[0], own), times(kernels[1], own), phi[2], phi[3]])
        c = np.linalg.solve(psi @ phi.T, psi @ times(inverse, y))
    np.abs(y - lfilter(c[2] * columns[2] + c[3] * columns[3], divisor, unit)).sum()
    return time.process_time() - start


def stage(quick: bool) -> None:
    """Five free orders under the order law, two equations: the joined tables beside evaluating every tuple."""
    run = plant_a_run()
    structure = replace(ftlm.flexible_link(form="published", stage=1), initial="rest")
    options = {"coefficients": "least-squares", "m": M}
    # Both equations of a tuple, each fitted and run to its end.
    one = replace(structure.equation("theta12"), initial="rest")
    brute, _, cpu = clocked(
        lambda: ftlm.search_orders(run, one, ftlm.order_grid(increment=0.2, alpha=(1.2, 2.0)), pruning=False, **options)
    )
    each = 2 * cpu / brute.candidates
    step = 0.1 if quick else 0.05
    low = {"alpha1": (1.5, 2.0, step), "alpha2": (1.5, 2.0, step)}
    scan, wall, cpu = clocked(
        lambda: ftlm.search_orders(run, structure, ftlm.order_grid(increment=step, **low), **options)
    )
    judge(
        "stage",
        "joined tables over evaluating every tuple, processor time",
        cpu / (each * scan.candidates),
        1,
        f"{scan.candidates} tuples of five orders in {wall:.1f} s, {cpu / scan.candidates * 1e9:.0f} ns each; every "
        f"tuple evaluated {each * 1e6:.0f} us each (from {brute.candidates} runs), "
        f"{each * scan.candidates / cpu:.3g} times ours",
    )


def set_up(quick: bool) -> None:
    """P12: set-up of a search over a long record, on one thread and on two, one after the other."""
    binary, m = bench_binary(), 1 << (15 if quick else 20)
    least: dict[int, tuple[float, ...]] = {}
    for threads in (1, 2) * (1 if quick else 2):
        out = subprocess.run(
            [binary, "setup", str(m), "0.2", str(threads)], capture_output=True, text=True, check=True
        ).stdout
        times_of_run = tuple(float(x) for x in out.split())
        least[threads] = min(times_of_run, least.get(threads, times_of_run), key=lambda times: times[2])
    (one_wall, one, _, _), (two_wall, two, busiest, peak) = least[1], least[2]
    judge(
        "P12",
        f"set-up of a search at {m} pulses on two threads over one, processor time of the busier thread",
        busiest / one,
        0.55,
        f"{busiest:.1f} of {one:.1f} s ({two:.1f} s by both threads); wall time {two_wall:.1f} of {one_wall:.1f} s, "
        f"load {os.getloadavg()[0]:.1f}; at most {peak / 1e6:.0f} MB",
    )


def growth(quick: bool, write: bool) -> None:
    """Cost of a search against pulses, candidates and threads; cost of the operators against pulses."""
    binary = bench_binary()
    searches = []
    steps = {round(0.05 * (313_845 / n) ** 0.25, 4) for n in (1e3, 1e4, 1e5) + (() if quick else (1e6, 1e7, 1e8))}
    plan = [(M, step) for step in sorted(steps, reverse=True)]
    plan += [(1 << log, 0.2) for log in range(9, 15 if quick else 21) if 1 << log != M]
    for m, step in plan:
        for threads in (1, 2):
            out = subprocess.run(
                [binary, "search", str(m), str(step), str(threads)], capture_output=True, text=True, check=True
            ).stdout
            candidates, wall, cpu = (float(x) for x in out.split())
            searches.append({"m": m, "candidates": int(candidates), "threads": threads, "wall": wall, "processor": cpu})
            say(
                f"growth: {m} pulses, {candidates:.3g} candidates, {threads} threads: {wall:.3g} s, {cpu:.3g} s of "
                f"processors, {cpu / candidates * 1e6:.3g} us a candidate"
            )
    if write:
        where = {"commit": commit(), "machine": platform.machine(), "cores": os.cpu_count(), "load": os.getloadavg()[0]}
        table = {"measured": where, "searches": searches, "operators": operator_times()}
        GROWTH.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")


def operator_times() -> dict[str, float]:
    """Seconds of every operator by name and length, once a process."""
    if not times:
        out = subprocess.run([bench_binary()], capture_output=True, text=True, check=True).stdout
        times.update((name, float(value)) for name, value in (line.rsplit(" ", 1) for line in out.splitlines()))
    return times


def numpy_solve(run: ftlm.Run, equation: ftlm.Structure, count: int = 200_000) -> float:
    """Seconds a candidate of NumPy's batched solve and quadratic form on gathered Gram matrices."""
    rec = record(run, equation, M)
    y, hub, current = (rec.of(n) for n in ("theta12", "theta11", "I1"))
    etas = np.arange(1, 41) * 0.05
    kernels = [block_pulse_kernel(float(e), M, step=rec.step) for e in etas]
    spectrum = [np.fft.rfft(k, 2 * M) for k in kernels]
    columns = [np.fft.irfft(s * np.fft.rfft(x, 2 * M))[:M] for x in (y, hub, current) for s in spectrum]
    x = np.stack([*columns, y], axis=1)
    x /= np.linalg.norm(x, axis=0)
    gram = x.T @ x
    rng = np.random.default_rng(0)
    own = np.sort(rng.permuted(np.tile(np.arange(40), (count, 1)), axis=1)[:, :2], axis=1)
    picks = np.column_stack([own, 40 + rng.integers(0, 40, count), 80 + rng.integers(0, 40, count)])
    start = time.process_time()
    a = gram[picks[:, :, None], picks[:, None, :]] + 1e-9 * np.eye(4)
    b = gram[picks, -1]
    c = np.linalg.solve(a, b[:, :, None])[:, :, 0]
    np.argsort(1 - 2 * np.sum(b * c, axis=1) + np.einsum("ni,nij,nj->n", c, a, c))
    return (time.process_time() - start) / count


def kernels() -> None:
    """P4, P5 and P6: times of operators of the core, relative to their transforms and to other Python packages."""
    from scipy.linalg import solve_triangular, toeplitz  # noqa: PLC0415
    from scipy.signal import fftconvolve  # noqa: PLC0415

    times = operator_times()
    start = time.perf_counter()
    phi = ftlm.haar_matrix(M)
    dense = phi @ ftlm.block_pulse_matrix(0.85, M, step=10.0 / M) @ phi.T
    numpy_time = time.perf_counter() - start
    assert np.allclose(dense, ftlm.operational_matrix(0.85, M, step=10.0 / M), atol=1e-12)
    ours, write = times["operational matrix 2048"], times["write 2048"]
    judge(
        "P4",
        "dense P of 2048 over writing such a matrix once",
        ours / write,
        3,
        f"{ours * 1e3:.1f} ms, writing {write * 1e3:.1f} ms; F alone {times['block pulse matrix 2048'] * 1e3:.1f} ms, "
        f"by faer {times['operational matrix by faer 2048'] * 1e3:.0f} ms, by NumPy {numpy_time * 1e3:.0f} ms",
    )
    lengths = [2**k for k in range(11, 21)]
    pairs = {m: times[f"rfft {m}"] + times[f"irfft {m}"] for m in lengths}
    worst = max(lengths, key=lambda m: times[f"apply {m}"] / pairs[m])
    signal, kernel = np.random.default_rng(0).standard_normal((2, M))
    rival = best(lambda: fftconvolve(kernel, signal)[:M])
    judge(
        "P5",
        f"I^eta applied over a forward and an inverse FFT, worst of 2^11 to 2^20 (2^{worst.bit_length() - 1})",
        times[f"apply {worst}"] / pairs[worst],
        1.3,
        "by length "
        + ", ".join(f"{times[f'apply {m}'] / pairs[m]:.2f}" for m in lengths)
        + f"; at 2048 {times['apply 2048'] * 1e6:.1f} us, SciPy's fftconvolve {rival * 1e6:.1f} us",
    )
    ratios = {m: times[f"simulate {m}"] / times[f"rfft {m}"] for m in lengths}
    worst = max(lengths, key=lambda m: ratios[m])
    kernel = np.abs(kernel) + np.eye(1, M)[0] * M
    matrix = toeplitz(kernel, np.zeros(M))
    rival = best(lambda: solve_triangular(matrix, signal, lower=True))
    judge(
        "P6",
        "median free run of the lattice over one FFT of twice its length, worst of 2^11 to 2^20 "
        f"(2^{worst.bit_length() - 1})",
        ratios[worst],
        15,
        "exact division throughout, so no residual to check; by length "
        + ", ".join(f"{ratios[m]:.1f}" for m in lengths)
        + f"; at 2048 {times['simulate 2048'] * 1e6:.0f} us, SciPy's triangular solve {rival * 1e6:.0f} us",
    )


def best(work) -> float:
    """Shortest of some runs, in seconds."""
    times = []
    for _ in range(10):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def bench_binary() -> str:
    """Path of the Rust side, built if need be."""
    out = subprocess.run(
        ["cargo", "bench", "--bench", "promises", "--no-run", "--message-format", "json"],
        capture_output=True,
        text=True,
        check=True,
        cwd=HERE.parent,
    ).stdout
    built = [json.loads(line) for line in out.splitlines() if line.startswith("{")]
    return next(b["executable"] for b in built if b.get("executable") and b["target"]["name"] == "promises")


def instructions(write: bool) -> None:
    """Instructions of the hottest kernels against their budget."""
    if shutil.which("valgrind") is None:
        say("instruction budget skipped: valgrind is not installed")
        return
    budget = json.loads(BUDGET.read_text(encoding="utf-8")) if BUDGET.exists() else {}
    binary = bench_binary()

    def count(kernel: str) -> tuple[int, int]:
        process = subprocess.run(
            ["valgrind", "--tool=callgrind", "--callgrind-out-file=/dev/null", binary, kernel],
            capture_output=True,
            text=True,
            check=True,
        )
        units = re.search(r"units (\d+)", process.stdout)
        collected = re.search(r"Collected : (\d+)", process.stderr)
        if units is None or collected is None:
            raise SystemExit(f"callgrind did not count {kernel}: {process.stderr[-300:]}")
        return int(collected[1]), int(units[1])

    nothing, _ = count("nothing")
    for kernel in ("screen", "rank", "boxes", "certify", "fit", "divide", "apply"):
        total, units = count(kernel)
        each = round((total - (nothing if kernel == "screen" else 0)) / units)
        allowed = budget.get(kernel)
        if allowed is None:
            budget[kernel] = each
            say(f"instructions of {kernel}: {each} a unit, taken as its budget")
        else:
            verdict = "within" if each <= 1.1 * allowed else "BEYOND"
            say(f"instructions of {kernel}: {each} a unit, {verdict} the budget of {allowed}")
    if write:
        BUDGET.write_text(json.dumps(budget, indent=2) + "\n", encoding="utf-8")


STREAM = """
import sys, time
from dataclasses import replace
import ftlm
from search import plant_a_run
run = plant_a_run()
equation = replace(ftlm.flexible_link(form="published", stage=1).equation("theta12"), initial="rest")
step = float(sys.argv[1])
coarse = ftlm.order_grid(increment=0.5, alpha=(1.0, 2.0))
ftlm.search_orders(run, equation, coarse, coefficients="least-squares", m=2048)
with open("/proc/self/clear_refs", "w") as peak:
    peak.write("5")  # forget the peak so far
def status(name):
    with open("/proc/self/status") as lines:
        return next(int(line.split()[1]) for line in lines if line.startswith(name))
before = status("VmRSS")
grid = ftlm.order_grid(increment=step, alpha=(1.05, 2.0))
start = time.perf_counter()
found = ftlm.search_orders(run, equation, grid, coefficients="least-squares", m=2048)
wall = time.perf_counter() - start
after = status("VmHWM")
kept = len(found.table) + found.exclusion_counts["beaten"]
pruned = 1 - kept / found.candidates
print(found.candidates, wall, (after - before) / 1024, pruned)
"""


def memory(quick: bool) -> None:
    """P8: import, demo, peak memory; a search over 10^8 candidates."""

    def seconds(code: str) -> float:
        def processor_time() -> float:
            usage = resource.getrusage(resource.RUSAGE_CHILDREN)
            return usage.ru_utime + usage.ru_stime

        times = []
        for _ in range(10):
            before = processor_time()
            subprocess.run([sys.executable, "-c", code], check=True)
            times.append(processor_time() - before)
        return min(times)

    nothing = seconds("pass")
    ratio = (seconds("import ftlm") - nothing) / (seconds("import numpy") - nothing)
    everything = "import ftlm\nfor name in ftlm.__all__: getattr(ftlm, name)"
    all_names = (seconds(everything) - nothing) / (seconds("import numpy") - nothing)
    judge(
        "P8",
        "import ftlm over import numpy, interpreter apart",
        ratio,
        2,
        f"processor time; with every public name asked for {all_names:.2f}; interpreter {nothing * 1e3:.0f} ms",
    )
    for step in (0.05,) if quick else (0.05, 0.0118):
        process = subprocess.run(
            [sys.executable, "-c", STREAM, str(step)], capture_output=True, text=True, check=True, cwd=HERE
        )
        candidates, wall, peak, pruned = (float(x) for x in process.stdout.split())
        judge(
            "P8",
            f"memory of a search over {candidates:.3g} candidates beyond the record, MB",
            peak,
            200,
            f"{wall:.1f} s, {candidates / wall:.3g} candidates/s, {100 * pruned:.3f} % pruned",
        )
    if not quick:
        start = time.perf_counter()
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        before = usage.ru_utime + usage.ru_stime
        folder = HERE.parent / "target" / "bench-demo"
        subprocess.run(
            [sys.executable, "-m", "ftlm", "demo", "-o", str(folder), "--force"], check=True, capture_output=True
        )
        wall = time.perf_counter() - start
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu = usage.ru_utime + usage.ru_stime - before
        judge(
            "P8",
            "ftlm demo, seconds",
            wall,
            20,
            f"{cpu:.0f} s of processors, {cpu / available_threads():.0f} s on each core; load {os.getloadavg()[0]:.1f}",
        )


def main() -> None:
    """Measure, judge, print; say how long each part took."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="write benches/results.json and budgets and growth")
    parser.add_argument("--quick", action="store_true", help="leave out what takes more than a few seconds")
    parser.add_argument("--only", default="", help="parts by name, separated by commas")
    arguments = parser.parse_args()
    quick, write = arguments.quick, arguments.write
    parts = {
        "P1P2": lambda: searches(quick),
        "P3": lambda: refined(quick),
        "stage": lambda: stage(quick),
        "P4P5P6": kernels,
        "P8": lambda: memory(quick),
        "P12": lambda: set_up(quick),
        "growth": lambda: growth(quick, write),
        "instructions": lambda: instructions(write),
    }
    names = arguments.only.split(",") if arguments.only else list(parts)
    if unknown := [name for name in names if name not in parts]:
        parser.error(f"no part {unknown[0]!r}; parts are {', '.join(parts)}")
    say(f"{heading()}, load {os.getloadavg()[0]:.1f} at the start")
    for name in names:
        start = time.perf_counter()
        parts[name]()
        print(f"  {name} took {time.perf_counter() - start:.0f} s", flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    say(f"load {os.getloadavg()[0]:.1f} at the end; this process took at most {peak:.0f} MB")
    if write:
        save([f"- {line}" for line in lines])


if __name__ == "__main__":
    main()
