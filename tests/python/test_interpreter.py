"""Work of the interpreter: no Python loop over samples, orders or candidates, and no callback from the core."""

from __future__ import annotations

import sys
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

import ftlm
from ftlm.estimation import objective
from slow_cases import slow_after

PACKAGE = str(Path(ftlm.__file__).parent)
#: Functions that the core reports its progress to.
DRIVERS = (
    "progress.py:FractionTracker.advance_to",
    "progress.py:FractionTracker.subtask.<locals>.report_subtask",
)
#: Calls that depend on the course of a fit and on what there is to report.
SLACK_CALLS = 60
#: Zeros in the right half plane are sought for models that have some, by halving rectangles.
OF_SOME_MODELS = ("analysis/poles.py:", "analysis/polynomial_zeros.py:")


def count_calls(work: Callable[[], object]) -> tuple[Counter[str], set[str]]:
    """Return the number of calls of each function of the package, and functions called while the core computes."""
    calls: Counter[str] = Counter()
    callbacks: set[str] = set()
    inside = threading.local()

    def note(frame, event, arg):
        if event in ("c_call", "c_return", "c_exception"):
            owner = getattr(arg, "__self__", None)
            of_core = getattr(owner, "__name__", "") == "ftlm._core" or type(owner).__module__ == "ftlm._core"
            if of_core or getattr(arg, "__module__", "") == "ftlm._core":
                inside.depth = getattr(inside, "depth", 0) + (1 if event == "c_call" else -1)
        elif event == "call" and frame.f_code.co_filename.startswith(PACKAGE):
            name = f"{frame.f_code.co_filename[len(PACKAGE) + 1 :]}:{frame.f_code.co_qualname}"
            calls[name] += 1
            if getattr(inside, "depth", 0):
                callbacks.add(name)

    before = sys.getprofile()
    threading.setprofile(note)
    sys.setprofile(note)
    try:
        work()
    finally:
        sys.setprofile(before)
        threading.setprofile(None)
    return calls, callbacks


def make_run(rows: int) -> ftlm.Run:
    rng = np.random.default_rng(4)
    u = np.repeat(rng.standard_normal(rows // 8 + 1), 8)[:rows]
    plant = ftlm.Model(ftlm.equation("D^1.4 y = -3 y - 0.8 D^0.5 y + 2 u"))
    run = ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": np.zeros(rows)}, intersample={"u": "zoh"})
    y = plant.simulate(run)["y"] + 0.01 * rng.standard_normal(rows)
    return ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": y}, intersample={"u": "zoh"})


MODEL = "D^1.4 y = -3 y - 0.8 D^0.5 y + 2 u"
FREE = "D^alpha y = a y + b u"


def simulate(rows: int, _: int) -> object:
    return ftlm.Model(ftlm.equation(MODEL)).simulate(make_run(rows))


def compare(rows: int, _: int) -> object:
    return ftlm.compare(ftlm.Model(ftlm.equation(MODEL, initial="history")), make_run(rows))


def identify(rows: int, _: int) -> object:
    return ftlm.identify(make_run(rows), ftlm.equation(FREE), method="output-error", threads=1)


def identify_friction(rows: int, _: int) -> object:
    words = "D^2 y = v D y + b u - fc*sign(D y) - fs*exp(-(D y/vs)^2)*sign(D y)"
    method = ftlm.OutputError(intervals="quadratic")
    return ftlm.identify(make_run(rows), ftlm.equation(words, initial="rest"), method=method, threads=1)


def search(rows: int, points: int) -> object:
    grid = ftlm.OrderGrid(increment=0.8 / points, alpha=(1.0, 1.8))
    return ftlm.search_orders(make_run(rows), ftlm.equation("D^alpha y = a y + c D^nu y + b u"), order_grid=grid)


def select(rows: int, _: int) -> object:
    return ftlm.select(make_run(rows), ftlm.equation(FREE), threads=1)


def test_a_fit_with_friction_is_computed_by_the_core(monkeypatch):
    """Initial guesses of friction come from the multistart of the core, not from optimizations in Python."""
    made = []
    monkeypatch.setattr(objective, "minimize_cost", lambda *_, **__: made.append(1))
    _, callbacks = count_calls(lambda: identify_friction(200, 0))
    assert [name for name in callbacks if name not in DRIVERS] == []
    assert made == []


def assert_flat(
    work: Callable[[int, int], object], small: tuple[int, int], large: tuple[int, int], ratio: float
) -> None:
    """Fail if a call of the package's functions grows by more than a ratio, or if the core calls back."""
    work(*small)
    few, callbacks = count_calls(lambda: work(*small))
    many, more = count_calls(lambda: work(*large))
    assert [name for name in callbacks | more if name not in DRIVERS] == []
    grown = {n: (few[n], c) for n, c in many.items() if c > ratio * few[n] + SLACK_CALLS}
    grown = {n: pair for n, pair in grown.items() if n not in DRIVERS and not n.startswith(OF_SOME_MODELS)}
    assert grown == {}


@slow_after(5, "work", [simulate, compare, identify, search, select, identify_friction])
def test_no_call_for_each_sample(work):
    assert_flat(work, (60, 4), (240, 4), 2.0)


def test_no_call_for_each_candidate():
    """Values of one order are listed; their combinations, 64 times as many, are not."""
    assert_flat(search, (200, 8), (200, 64), 8.0)
