"""How long every long call goes on after Ctrl-C, at moments all over it (promise R10: half a second).

``python benches/stops.py [--samples N] [--moments K] [--longest SECONDS] [JOB ...]``: each job is begun K times, in a
process of its own each, and told to stop after 1/K, 2/K ... of the time that it takes, or of SECONDS if it takes
longer; the time is that from the signal to ``KeyboardInterrupt``. Jobs are written out by ``--help``.
"""

from __future__ import annotations

import argparse
import math
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import ftlm
from results import heading

LINK = "D^alpha y = a D^beta y + c D^mu y + b D^nu u"
FIT = "D^alpha y = a y + b u"
SOLVED = ftlm.equation("D^1.6 y = -3 D^0.6 y - 8 y + 5 u")
FIXED_EQUATION = ftlm.equation("D^1.6 y = c D^0.6 y + a y + b u")
#: Seconds within which a job is to end; one that takes longer is marked.
PROMISED = 0.5


def machine(samples: int) -> ftlm.Run:
    """A noisy second-order machine under steps of random length."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.choice([-1.0, 0.3, 1.0], samples // 300 + 1), 300)[:samples]
    empty = ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": np.zeros(samples)}, name="machine")
    y = ftlm.Model(SOLVED).simulate(empty)["y"] + 1e-3 * rng.standard_normal(samples)
    return ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": y}, name="machine")


def searched(run: ftlm.Run, **options: object) -> Callable[[], object]:
    """A search on the largest power of two of pulses that a run holds."""
    m = 1 << int(math.log2(run["y"].size - 1))
    lattice = ftlm.order_grid(increment=0.2, alpha=(1.05, 2.0))
    return lambda: ftlm.search_orders(run, ftlm.equation(LINK), lattice, m=m, **options)


def reported(run: ftlm.Run) -> Callable[[], object]:
    """The report on a fit."""
    result = ftlm.identify(run, ftlm.equation(FIT.replace("alpha", "1.6")))
    return lambda: result.report(Path(tempfile.mkdtemp()) / "report.html", validation=run)


JOBS: dict[str, Callable[[ftlm.Run], Callable[[], object]]] = {
    "search": searched,
    "equation-error": lambda run: searched(run, criterion="equation-error"),
    "squares": lambda run: searched(run, norm="l2", coefficients="least-squares"),
    "instruments": lambda run: searched(run, coefficients="instrumental-variables"),
    "certificate": lambda run: lambda: ftlm.certify_orders(run, ftlm.equation(FIT), m=run["y"].size - 1),
    "recursion": lambda run: (
        lambda: ftlm.multi_innovation_trace(run, FIXED_EQUATION, m=1 << int(math.log2(run["y"].size - 1)))
    ),
    "fit": lambda run: lambda: ftlm.identify(run, ftlm.equation(FIT)),
    "refined": lambda run: lambda: ftlm.identify(run, FIXED_EQUATION, method="instrumental-variables"),
    "innovations": lambda run: lambda: ftlm.identify(run, FIXED_EQUATION, method="multi-innovation"),
    "select": lambda run: lambda: ftlm.select(run, [ftlm.equation(FIT), FIXED_EQUATION], validation="blocks"),
    "simulate": lambda run: lambda: ftlm.Model(SOLVED).simulate(run, tolerance=1e-9),
    "integral": lambda run: lambda: [ftlm.fractional_integral(run["y"], 0.01 * n, step=0.01) for n in range(1, 200)],
    "report": reported,
}


def child(job: str, samples: int, after: float) -> None:
    """Do a job, told to stop after so many seconds: its own time, or that from the signal to its end."""
    call = JOBS[job](machine(samples))
    stop_time = [math.inf]

    def send() -> None:
        stop_time[0] = time.perf_counter()
        os.kill(os.getpid(), signal.SIGINT)

    signal.signal(signal.SIGINT, signal.default_int_handler)
    timer = threading.Timer(after, send)
    timer.daemon = True
    start_time = time.perf_counter()
    timer.start()
    try:
        call()
        took = time.perf_counter() - start_time
        timer.cancel()
        print("done", took)
    except KeyboardInterrupt:
        print("stopped", time.perf_counter() - stop_time[0])


def stop_result(job: str, samples: int, after: float) -> tuple[str, float]:
    """What a child said."""
    call = [sys.executable, __file__, "--samples", str(samples), "--child", str(after), job]
    out = subprocess.run(call, stdout=subprocess.PIPE, text=True, check=True).stdout
    word, seconds = out.splitlines()[-1].split()
    return word, float(seconds)


def main() -> None:
    """Every job asked for, at all moments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("jobs", nargs="*", metavar="JOB", help=", ".join(JOBS))
    parser.add_argument("--samples", type=int, default=(1 << 20) + 1)
    parser.add_argument("--moments", type=int, default=12)
    parser.add_argument("--longest", type=float, default=40.0, help="seconds of a job within which it is told to stop")
    parser.add_argument("--child", type=float, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if unknown := [job for job in arguments.jobs if job not in JOBS]:
        parser.error(f"no job {unknown[0]!r}; jobs are {', '.join(JOBS)}")
    if arguments.child is not None:
        child(arguments.jobs[0], arguments.samples, arguments.child)
        return
    print(f"{heading()}, {arguments.samples} samples, load {os.getloadavg()[0]:.1f} at the start")
    for job in arguments.jobs or JOBS:
        word, seconds = stop_result(job, arguments.samples, arguments.longest)
        late = word == "stopped"
        length = arguments.longest if late else seconds
        waits = [(arguments.longest, seconds)] if late else []
        for k in range(1, arguments.moments):
            after = k * length / arguments.moments
            word, seconds = stop_result(job, arguments.samples, after)
            waits += [(after, seconds)] if word == "stopped" else []
        if not waits:
            print(f"{job}: takes {length:.2f} s and was never caught", flush=True)
            continue
        after, worst = max(waits, key=lambda wait: wait[1])
        median = sorted(seconds for _, seconds in waits)[len(waits) // 2]
        print(
            f"{job}: {'more than ' if late else ''}{length:.1f} s, told to stop {len(waits)} times: "
            f"median {median:.2f} s, at most {worst:.2f} s after {after:.1f} s"
            f"{'' if worst <= PROMISED else ' NOT KEPT'}",
            flush=True,
        )


if __name__ == "__main__":
    main()
