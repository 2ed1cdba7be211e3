"""Share of the wall time of `identify` that is spent outside the core, on the runs of both laboratories (FTLM_DATA).

``python benches/core_share.py [--write]`` fits the five and the three terms of ``benches/identify.py`` with all cores.
Time is inside while any thread is in a call of the core. The profiler slows the interpreter, so the share outside is an
upper bound.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time

import ftlm
from arm_measured import arm_run
from identify import FILTERED, WORDS
from results import heading, save


class CoreClock:
    """Wall time during which at least one thread computes in the core."""

    def __init__(self) -> None:
        self.inside, self._depth, self._start_time, self._lock = 0.0, 0, 0.0, threading.Lock()

    def note(self, _frame: object, event: str, function: object) -> None:
        """Count calls of the core: a profile function."""
        if event not in ("c_call", "c_return", "c_exception"):
            return
        owner = getattr(function, "__self__", None)
        names = getattr(owner, "__name__", ""), type(owner).__module__, getattr(function, "__module__", "")
        if "ftlm._core" not in names:
            return
        with self._lock:
            now = time.perf_counter()
            if event == "c_call":
                self._start_time = now if self._depth == 0 else self._start_time
                self._depth += 1
            else:
                self._depth -= 1
                self.inside += now - self._start_time if self._depth == 0 else 0.0


def main() -> None:
    """Measure and print; write them with ``--write``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="write benches/results.json")
    arguments = parser.parse_args()
    runs = [arm_run("psf"), arm_run("lqr")]
    rows = ["| equation | wall [s] | outside the core [s] | share |", "| --- | --- | --- | --- |"]
    for name, words in WORDS.items():
        structure = ftlm.equation(words, sensor_filter=ftlm.SensorFilter.low_pass(FILTERED))
        clock, start_time = CoreClock(), time.perf_counter()
        threading.setprofile(clock.note)
        sys.setprofile(clock.note)
        ftlm.identify(runs, structure)
        sys.setprofile(None)
        threading.setprofile(None)
        wall = time.perf_counter() - start_time
        outside = wall - clock.inside
        rows.append(f"| {name} | {wall:.2f} | {outside:.2f} | {100 * outside / wall:.1f} % |")
    print("\n".join(rows))
    if arguments.write:
        save([heading(), "", *rows])


if __name__ == "__main__":
    main()
