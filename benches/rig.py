"""The rig: deadlines in real time, the watchdog's latency, the cost of a sample and the error of the bounded memory.

Run it on a quiet machine: ``python benches/rig.py [seconds]``. A loop that is late stops a recording; here it is only
counted.
"""

from __future__ import annotations

import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import ftlm
from ftlm import rig
from ftlm.reproduction.simulated_arm import demo_plant
from ftlm.rig import watchdog
from ftlm.rig.arm_parameters import MAX_SUBSTEP_S
from ftlm.rig.rig import Limits, Rig
from ftlm.rig.virtual_board import VirtualBoard

PATIENT = Limits(max_write_delay=60.0, max_missed_deadlines=10**9, standstill=1e9)
CHILD = """
import sys
from ftlm import rig
rig.record(rig.VirtualBoard(register_file=sys.argv[1], real_time=True), input="sine", amplitude=0.2, duration=25.0)
"""


def real_time(rate: float, seconds: float) -> None:
    excitation = rig.Excitation("multisine", 0.25, period=10.0, band=(0.1, 10.0))
    commands = excitation.commands(rate, seconds)
    structure = ftlm.flexible_link(form="published", stage=1, laws=("orders",), coupling="measured")
    arm = rig.ArmParameters.load("effective")
    stream = rig.Streaming(
        structure.with_orders(arm.stage1.orders(1)), step=1.0 / rate, max_duration=seconds + 1.0, prior_covariance=1e8
    )
    columns = [rig.rig.COLUMNS.index(name) for name in stream.signals]
    late = []
    board = VirtualBoard(arm, real_time=True, horizon=seconds + 1.0)
    with Rig(board, rate=rate, limit=seconds + 1.0, watchdog=1.0, limits=PATIENT) as link:
        for start in range(0, len(commands), 32):
            link.run(commands[start : start + 32])
            rows = link.take()
            stream.push(rows[:, columns])
            late.append(rows[:, 8])
    delays = np.concatenate(late)
    period = 1.0 / rate
    missed = int((delays > period).sum())
    print(
        f"{rate:g} Hz for {seconds:g} s in real time, recursion (44) for stage 1 alongside: {delays.size} samples, "
        f"{missed} deadlines missed ({100.0 * missed / delays.size:.3f} %)"
    )
    quantiles = [50, 99, 99.9, 100]
    words = ", ".join(
        f"{q:g} % {1e6 * v:.1f}" for q, v in zip(quantiles, np.percentile(delays, quantiles), strict=True)
    )
    print(f"  delay of a sample [us]: {words}")


def stopped(number: signal.Signals, times: int = 8) -> None:
    delays = []
    for _ in range(times):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "page"
            process = subprocess.Popen([sys.executable, "-c", CHILD, str(path)])
            page = None
            while page is None or page.volts == (0.0, 0.0) or page.get("beat") < 300:
                time.sleep(0.01)
                if page is None and path.exists() and path.stat().st_size == watchdog.PAGE_SIZE_BYTES:
                    page = watchdog.RegisterPage(path)
            struck = time.monotonic()
            os.kill(process.pid, number)
            while not page.has_expired:
                time.sleep(0.001)
            delays.append(page.get("tripped") - struck)
            if page.volts != (0.0, 0.0):
                raise SystemExit("the watchdog left volts on the motors")
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
            page.close()
    ms = 1e3 * np.array(delays)
    print(f"{number.name} to 0 V, watchdog of 100 ms, {times} times: {ms.min():.1f} to {ms.max():.1f} ms")


def cost() -> None:
    for rate in (500.0, 1000.0, 8000.0):
        arm = rig.ArmParameters.load("effective").arm(1.0 / rate, 600.0)
        n = 5000
        start = time.perf_counter()
        for _ in range(n):
            arm.advance((-0.3, 0.3), True)
        each = 1e6 * (time.perf_counter() - start) / n
        print(f"one sample of the arm at {rate:g} Hz: {each:.1f} us, {arm.memory} numbers hold the past of 600 s")
    structure = ftlm.flexible_link(form="published", stage=1, laws=("orders",), coupling="measured")
    structure = structure.with_orders(rig.ArmParameters.load("effective").stage1.orders(1))
    rng = np.random.default_rng(0)
    for n in (1_000, 10_000, 100_000):
        stream = rig.Streaming(structure, step=0.002, max_duration=600.0, prior_covariance=1e8)
        rows = np.cumsum(rng.standard_normal((n, len(stream.signals))), axis=0) * 1e-3
        start = time.perf_counter()
        stream.push(rows)
        each = 1e6 * (time.perf_counter() - start) / n
        print(f"one row of recursion (44), both equations, p = 7, run of {n}: {each:.1f} us")


def truth() -> None:
    linear = replace(rig.ArmParameters.load("linear"), form="published")
    run = rig.record(duration=10.0, parameters=linear)
    clean = {}
    for stage in (1, 2):
        names = [f"theta{stage}1", f"theta{stage}2"]
        blank = ftlm.Run.from_arrays(
            step=run.step, inputs={n: run[n] for n in run.inputs}, outputs={n: np.zeros(run.length) for n in names}
        )
        solved = demo_plant(stage, form="published").simulate(blank, tolerance=1e-7)
        clean |= {n: solved[n] for n in names}
    arm = linear.arm(run.step, 600.0)
    states = np.empty((run.length, 4))
    currents = np.column_stack([run["I1"], run["I2"]])
    for k, row in enumerate(-2.0 * currents):
        states[k] = arm.angles
        arm.advance(row, True)
    names = ("theta11", "theta12", "theta21", "theta22")
    words = ", ".join(f"{n} {np.abs(states[:, k] - clean[n]).max() / clean[n].std():.1e}" for k, n in enumerate(names))
    print(
        f"largest error of the arm against the series solution, in its own deviations, substep {MAX_SUBSTEP_S:g} s: "
        f"{words}"
    )


if __name__ == "__main__":
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    real_time(1000.0, float(sys.argv[1]) if len(sys.argv) > 1 else 60.0)
    for number in (signal.SIGKILL, signal.SIGSTOP):
        stopped(number)
    cost()
    truth()
