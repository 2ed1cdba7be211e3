"""What a search loses to kill -9: a search with a store is killed at random moments and resumed until it ends.

python benches/store.py [kills] [stage] prints the time lost to each kill (the age, when the kill came, of the oldest
finished work that is not in the store; of a stage the time since the last write) and whether the resumed tables are
those of the uninterrupted search, byte by byte; of one equation, or of a stage under its order law.

python benches/store.py [count] control-c prints how long a terminal waits for ftlm search after Ctrl-C.
"""

import contextlib
import json
import math
import os
import pty
import random
import select
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import ftlm
from ftlm.order_search.checkpoint import read_store
from ftlm.reproduction.simulated_arm import demo_plant

EQUATION = "D^alpha y = a D^beta y + c D^mu y + b D^nu u"

CHILD = """
import sys, time
sys.path.insert(0, {folder!r})
import store
def told(done, total):
    print(time.time(), done, flush=True)
store.{search}(sys.argv[1], told)
"""

#: Makes its terminal the one whose Ctrl-C it gets, and becomes what it is told.
AT_A_TERMINAL = """
import fcntl, os, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.execv(sys.argv[1], sys.argv[1:])
"""


def run(samples=2049):
    """A noisy second-order machine under a square input."""
    u = np.where(np.arange(samples) % 400 < 230, 1.0, -0.6)
    model = ftlm.Model(ftlm.equation("D^1.6 y = -3 D^0.6 y - 8 y + 5 u"))
    empty = ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": np.zeros(samples)}, name="machine")
    clean = model.simulate(empty, tolerance=1e-6)
    noise = 1e-3 * np.random.default_rng(1).standard_normal(samples)
    return ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": clean["y"] + noise}, name="machine")


def search(path, progress=None):
    """Brute force: long enough to be killed several times."""
    return ftlm.search_orders(
        run(),
        ftlm.equation(EQUATION, initial="rest"),
        ftlm.order_grid(increment=0.1, alpha=(1.05, 2.0)),
        pruning=False,
        m=2048,
        coefficients="least-squares",
        store=path,
        progress=progress,
    )


def stage(path, progress=None):
    """The same for both equations of a stage under their order law."""
    rows = 1025
    current = np.where(np.arange(rows) % 400 < 230, 0.3, -0.3)
    outputs = {"theta11": np.zeros(rows), "theta12": np.zeros(rows)}
    empty = ftlm.Run.from_arrays(step=0.004, inputs={"I1": current}, outputs=outputs, name="stage")
    clean = demo_plant(1, form="published").simulate(empty, tolerance=1e-6)
    noise = np.random.default_rng(1)
    noisy = {n: clean[n] + 1e-4 * noise.standard_normal(rows) for n in outputs}
    run = ftlm.Run.from_arrays(step=0.004, inputs={"I1": current}, outputs=noisy, name="stage")
    lattice = ftlm.order_grid(increment=0.025, alpha=(1.8, 2.0), gamma1=(0.8, 1.1), beta2=(0.0, 0.5), mu2=(0.7, 1.0))
    return ftlm.search_orders(
        run,
        ftlm.flexible_link(form="published"),
        lattice,
        pruning=False,
        m=1024,
        coefficients="least-squares",
        store=path,
        progress=progress,
    )


def table_bytes(result):
    """The table and counts as text; a resumed search has no verdict."""
    return json.dumps(replace(result, verdict=None, model_findings=()).to_dict())


def kills(count, seed=0, of=search):
    """Kill and resume until so many kills have been done: (seconds lost to each, searches ended, all identical)."""
    choose = random.Random(seed)
    expected = table_bytes(of(None))
    name = "y" if of is search else "stage"
    script = CHILD.replace("{folder!r}", repr(str(Path(__file__).resolve().parent))).replace("{search}", of.__name__)
    losses, ended, same = [], 0, True
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "search.ftlm"
        while len(losses) < count:
            moment = choose.uniform(0.0, 1.5)
            with subprocess.Popen(
                [sys.executable, "-c", script, str(path)], stdout=subprocess.PIPE, text=True
            ) as child:
                first = child.stdout.readline()
                time.sleep(moment)
                killed = time.time()
                finished = child.poll() is not None
                if not finished:
                    os.kill(child.pid, signal.SIGKILL)
                lines = [first, *child.stdout]
            lines_of_progress = [line.split() for line in lines if line.endswith("\n") and line.strip()]
            if not finished:
                stored_count = ftlm.search_status(path)[name].done_count
                # A stage tells what is in the store only: all since then is lost.
                ages = [
                    killed - float(when)
                    for when, count_text in (lines_of_progress if of is search else lines_of_progress[-1:])
                    if of is stage or int(count_text) > stored_count
                ]
                losses.append(max([0.0, *ages]))
                continue
            ended += 1
            same &= table_bytes(of(path)) == expected
            path.unlink()
        same &= table_bytes(ftlm.resume_search(path)[name]) == expected if path.exists() else True
    return losses, ended, same


def control_c(arguments, path, frames):
    """Type Ctrl-C at ftlm once its store holds so many frames: exit code, seconds until it ended, what it said."""
    terminal, other = pty.openpty()
    child = subprocess.Popen(
        [sys.executable, "-c", AT_A_TERMINAL, sys.executable, "-m", "ftlm", *arguments],
        stdin=other,
        stdout=other,
        stderr=other,
        start_new_session=True,
    )
    os.close(other)
    output, typed = b"", None
    while True:
        ready, _, _ = select.select([terminal], [], [], 0.02)
        if ready:
            try:
                data = os.read(terminal, 4096)
            except OSError:  # how Linux says that the other end is closed
                break
            if not data:
                break
            output += data
        if typed is None:
            with contextlib.suppress(ftlm.DataError):
                if path.exists() and rounds_in(path) >= frames:
                    os.write(terminal, b"\x03")
                    typed = time.monotonic()
    code = child.wait()
    waited = math.nan if typed is None else time.monotonic() - typed
    os.close(terminal)
    return code, waited, output.decode()


def rounds_in(path):
    """Stretches of rounds in a store, done or begun, of its first search."""
    section = read_store(path).sections[0]
    return len(section.frames) + len(section.open)


def interruptions(count):
    """Seconds from Ctrl-C to the end of a search, whose store must then be whole."""
    waits = []
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "run.csv"
        run().to_csv(data)
        for number in range(count):
            path = Path(folder) / f"{number}.ftlm"
            call = [
                "search",
                str(data),
                "--structure",
                EQUATION,
                "--increment",
                "0.02",
                "--m",
                "2048",
                "--initial",
                "rest",
            ]
            call += ["--coefficients", "instrumental-variables", "--store", str(path)]
            code, waited, output = control_c(call, path, 1 + number % 3)
            status = ftlm.search_status(path)["y"]
            if code != 130 or status.corruption:
                sys.exit(f"exit code {code}, {status}\n{output}")
            waits.append(waited)
    return waits


if __name__ == "__main__":
    if "control-c" in sys.argv:
        waits = interruptions(int(sys.argv[1]) if sys.argv[1].isdigit() else 20)
        print(f"{len(waits)} times Ctrl-C: median {sorted(waits)[len(waits) // 2]:.3f} s, worst {max(waits):.3f} s")
        sys.exit()
    numbers = [int(a) for a in sys.argv[1:] if a.isdigit()]
    losses, ended, same = kills(*(numbers or [50]), of=stage if "stage" in sys.argv else search)
    print(f"{len(losses)} kills, {ended} searches ended between them; tables identical: {same}")
    print(f"lost to a kill: median {sorted(losses)[len(losses) // 2]:.3f} s, worst {max(losses):.3f} s")
