"""What works on other threads ends with the one that is interrupted."""

from __future__ import annotations

import threading

import numpy as np
import pytest

import ftlm
from ftlm import _core
from ftlm.simulation.output_samples import output_simulation
from ftlm.utils.resources import interruptible_pool, stop_flag


def step_response(m: int) -> list:
    """y' = -y + u sampled, as the core compares it."""
    u = np.ones(m)
    y = 1.0 - np.exp(-0.01 * np.arange(m + 1))
    return [
        {
            "record": (0.01, np.stack([np.zeros(m), u]), None),
            "pulses_per_sample": 1,
            "samples": y[None],
            "filter": None,
            "weights": [1.0],
            "signals": [],
            "robust_weights": None,
            "sample_times": None,
        }
    ]


LAW = (0, (1.0, []), [(0, (0.0, []), (1.0, [(0, 1)])), (1, (0.0, []), (1.0, [(1, 1)]))])


def fitted(m: int, flag: _core.Stop | None, evaluations: int = 60) -> dict:
    start = [-0.3, 2.0]
    return _core.output_error(
        step_response(m), [LAW], [], ["plain"] * 2, False, (True, []), [], start, [], evaluations, 1e-12, False, flag
    )


@pytest.mark.parametrize("m", [200, 4000])
def test_a_flag_that_is_set_ends_a_fit_and_one_that_is_not_changes_nothing(m: int) -> None:
    # The longer one is computed on a thread that can be left behind.
    assert (60 * m >= 1 << 17) == (m == 4000)
    flag = _core.Stop()
    plain, watched = fitted(m, None), fitted(m, flag)
    assert plain["coefficients"] == pytest.approx([-1.0, 1.0], rel=1e-4)
    assert watched["coefficients"] == plain["coefficients"]
    flag.set()
    assert flag.is_set
    with pytest.raises(KeyboardInterrupt):
        fitted(m, flag)


def test_friction_is_ended_as_well() -> None:
    m = 200
    runs = [
        {
            "record": (0.01, np.stack([np.zeros(m), np.ones(m)]), None),
            "pulses_per_sample": 1,
            "samples": np.zeros((1, m + 1)),
            "filter": None,
            "weights": [1.0],
            "signals": [],
            "robust_weights": None,
            "sample_times": None,
        }
    ]
    law = (0, (2.0, []), [(1, (0.0, []), (1.0, [(0, 1)]))])
    strength = [(1.0, [(1, 1)]), (0.0, []), (1.0, [])]

    def fit(flag: _core.Stop | None) -> dict:
        return _core.friction_error(
            runs, [law], [(0, strength)], [], ["plain"] * 2, (True, []), [], [1.0, 0.2], [], [], 3, 1e-9, flag
        )

    assert fit(None)["evaluations"] > 1
    flag = _core.Stop()
    flag.set()
    with pytest.raises(KeyboardInterrupt):
        fit(flag)


def test_an_interrupt_reaches_what_other_threads_compute() -> None:
    """The workers end only by the flag: without it this would not come to an end."""
    seen, begun = [], threading.Barrier(3)

    def work(_: int) -> None:
        flag = stop_flag()
        assert flag is not None
        begun.wait()
        while not flag.is_set:
            fitted(200, None, 2)
        seen.append(stop_flag() is flag)

    assert stop_flag() is None
    with pytest.raises(KeyboardInterrupt), interruptible_pool(2) as workers:  # noqa: PT012
        for k in range(5):
            workers.submit(work, k)
        begun.wait()
        raise KeyboardInterrupt
    # The three that waited for a thread never began.
    assert seen == [True, True]


def test_work_inside_work_ends_with_the_outermost() -> None:
    flags = []

    def inner(_: int) -> None:
        flags.append(stop_flag())

    def outer(k: int) -> None:
        flags.append(stop_flag())
        with interruptible_pool(1) as workers:
            list(workers.map(inner, [k]))

    with interruptible_pool(2) as workers:
        list(workers.map(outer, range(2)))
    assert len(flags) == 4
    assert len({id(flag) for flag in flags}) == 1


def test_an_error_of_one_thread_stops_no_other_fit() -> None:
    flags = []

    def work(k: int) -> int:
        flags.append(stop_flag())
        if k == 0:
            raise ValueError(k)
        return k

    with pytest.raises(ValueError, match="0"), interruptible_pool(1) as workers:
        list(workers.map(work, range(3)))
    assert not flags[0].is_set


def slow_simulation() -> tuple[_core.OutputSimulation, tuple[bool, list, bool], int]:
    """A simulation that is refined for minutes, and never converges."""
    rows = 1 << 15
    run = ftlm.Run.from_arrays(step=1.0, inputs={"u": np.ones(rows)}, outputs={"y": np.zeros(rows)})
    model = ftlm.Model(ftlm.equation("D^0.7 y = -900 y + u"))
    core, terms = output_simulation(model, run, {}, None, 1)
    return core, terms, 1 << 24


def test_a_simulation_on_another_thread_is_ended_within_its_grids() -> None:
    """The flag is set by this thread while the other one computes, which does not hold the interpreter."""
    core, terms, pulses = slow_simulation()
    flag, ends = _core.Stop(), []

    def work() -> None:
        try:
            core.refine(terms, 0.0, pulses, 1 << 60, flag)
        except KeyboardInterrupt:
            ends.append("ended")

    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    flag.set()
    for thread in threads:
        thread.join()
    assert ends == ["ended"] * 2
