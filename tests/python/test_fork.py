"""Children forked while other threads compute: locks that those held are held for good, and nothing waits for them."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")

#: Forks some times from beside `work` in two threads; a child that has not done its own after some seconds is ended by
#: its alarm.
FORKS = """
import os, signal, sys, threading, time, warnings
import numpy as np
import ftlm
from ftlm import _core

def answers():
    return str(FOUND()), str(FIT())

# Of short runs, so that a child does in time even on a busy machine what waiting for a lock never does.
t = np.arange(120) * 0.1
u = np.sign(np.sin(1.3 * t))
y = ftlm.fractional_integral(u, 1.4, step=0.1)
run = ftlm.Run.from_arrays(inputs={{"u": u}}, outputs={{"y": y}}, step=0.1)
FOUND = lambda: ftlm.search_orders(
    run, ftlm.equation("D^alpha y = a D^beta y + b u", initial="rest"), ftlm.order_grid(increment=0.1), m=64, threads=2)
FIT = lambda: ftlm.identify(run, ftlm.equation("D^1.4 y = a y + b u", initial="rest"), threads=2)
right = answers()

{work}

going = threading.Event()
threads = [threading.Thread(target=work, args=(i,), daemon=True) for i in range(2)]
for thread in threads:
    thread.start()
warnings.simplefilter("ignore")  # Python says that it is unwise to fork beside threads, which is the point.
ended = []
for k in range({count}):
    going.set()
    time.sleep(0.02 + 0.013 * k)
    child = os.fork()
    if child == 0:
        signal.alarm(60)
        os._exit(0 if answers() == right else 7)
    going.clear()
    ended.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    if ended[-1]:
        break
print(ended, flush=True)
os._exit(0)
"""
#: More long transforms than are kept, so that a plan is being made much of the time; ever longer tables of divisors.
WORK = """
def work(i):
    if i:
        for power in range(10, 24):
            going.wait()
            _core.block_pulse_kernels(np.array([0.5]), 1 << power, 0.1)
    x = np.zeros(1 << 17)
    while True:
        for length in range(1 << 16, 1 << 17, 1 << 10):
            going.wait()
            _core.series_multiply(x[:length], x[:length], length)
"""


def test_a_child_forked_beside_busy_threads_fits_and_searches(tmp_path):
    count = 5
    done = subprocess.run(
        [sys.executable, "-c", FORKS.format(work=WORK, count=count)],
        check=False,
        timeout=280,
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )
    assert done.stdout.strip() == str([0] * count), done.stderr
