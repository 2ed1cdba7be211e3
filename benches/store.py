"""What a search loses to kill -9: a search with a store is killed at random moments and resumed until it ends.

python benches/store.py [kills] prints the time lost to each kill (the age, when the kill came, of the oldest finished
work that is not in the store) and whether the resumed tables are those of the uninterrupted search, byte by byte.
"""

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import ftlm

EQUATION = "D^alpha y = a D^beta y + c D^mu y + b D^nu u"

CHILD = """
import sys, time
sys.path.insert(0, {folder!r})
import store
def told(done, total):
    print(time.time(), done, flush=True)
store.search(sys.argv[1], told)
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
        run(), ftlm.equation(EQUATION, initial="rest"), ftlm.lattice(step=0.1), early_stopping=False, m=2048,
        coefficients="least-squares", store=path, progress=progress,
    )  # fmt: skip


def kills(count, seed=0):
    """Kill and resume until so many kills have been done: (seconds lost to each, searches ended, all identical)."""
    choose = random.Random(seed)
    expected = json.dumps(search(None).to_dict())
    script = CHILD.replace("{folder!r}", repr(str(Path(__file__).resolve().parent)))
    lost, ended, same = [], 0, True
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "search.ftlm"
        while len(lost) < count:
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
            told = [line.split() for line in lines if line.endswith("\n") and line.strip()]
            if not finished:
                held = ftlm.search_status(path)["y"].done
                ages = [killed - float(when) for when, done in told if int(done) > held]
                lost.append(max([0.0, *ages]))
                continue
            ended += 1
            same &= json.dumps(search(path).to_dict()) == expected
            path.unlink()
        same &= json.dumps(ftlm.resume_search(path)["y"].to_dict()) == expected if path.exists() else True
    return lost, ended, same


if __name__ == "__main__":
    lost, ended, same = kills(int(sys.argv[1]) if len(sys.argv) > 1 else 50)
    print(f"{len(lost)} kills, {ended} searches ended between them; tables identical: {same}")
    print(f"lost to a kill: median {sorted(lost)[len(lost) // 2]:.3f} s, worst {max(lost):.3f} s")
