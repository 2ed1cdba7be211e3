"""What works on other threads ends with the one that is interrupted."""

from __future__ import annotations

import subprocess
import sys
import threading

import numpy as np
import pytest

import ftlm
from ftlm import _core
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.output_error import fit_output_error
from ftlm.simulation.discretization import recording
from ftlm.simulation.output_samples import output_simulation
from ftlm.utils.resources import interruptible_pool, stop_flag
from thread_pair import overlap


def compared(samples: np.ndarray, inputs: np.ndarray) -> list:
    """Samples and pulses of an input, as the core compares them."""
    return [
        {
            "record": (0.01, np.stack([np.zeros(inputs.size), inputs]), None),
            "pulses_per_sample": 1,
            "samples": samples[None],
            "filter": None,
            "weights": [1.0],
            "signals": [],
            "robust_weights": None,
            "sample_times": None,
        }
    ]


def fitted(m: int, flag: _core.Stop | None, evaluations: int = 60) -> dict:
    """y' = -y + u."""
    runs = compared(1.0 - np.exp(-0.01 * np.arange(m + 1)), np.ones(m))
    problem = FreeProblem.of(ftlm.equation("D y = a y + b u", initial="caputo"))
    return problem.core.minimize(runs, ([-0.3, 2.0], []), True, [], evaluations, 1e-12, False, flag)


@pytest.mark.parametrize("m", [200, 4000])
def test_a_flag_that_is_set_ends_a_fit_and_one_that_is_not_changes_nothing(m: int) -> None:
    # The longer one is computed on a thread that can be left behind.
    assert (60 * m >= 1 << 17) == (m == 4000)
    flag = _core.Stop()
    plain, watched = fitted(m, None), fitted(m, flag)
    assert plain["values"] == pytest.approx([-1.0, 1.0], rel=1e-4)
    assert watched["values"] == plain["values"]
    flag.set()
    assert flag.is_set
    with pytest.raises(KeyboardInterrupt):
        fitted(m, flag)


def test_friction_is_ended_as_well() -> None:
    runs = compared(np.zeros(201), np.ones(200))
    problem = FreeProblem.of(ftlm.equation("D^2 y = b u - fc*sign(D y)", initial="caputo"))

    def fit(flag: _core.Stop | None) -> dict:
        return problem.core.minimize(runs, ([1.0, 0.2], []), True, [], 3, 1e-9, False, flag)

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
            core.refine(terms, 0.0, pulses, 1 << 60, 1 << 40, flag)
        except KeyboardInterrupt:
            ends.append("ended")

    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    flag.set()
    for thread in threads:
        thread.join()
    assert ends == ["ended"] * 2


def test_two_fits_run_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """No thread is made to give up the interpreter, so that the second fit begins only if the first one lets go."""
    run, start = moving_run(400), {"alpha": 1.0, "a": -0.3, "b": 0.5}
    structure = ftlm.equation("D^alpha y = a y + b u", initial="rest")
    assert overlap(lambda _: fit_output_error([run], structure, start=start), monkeypatch, _core, "joint_fit")


def moving_run(rows: int, friction: float = 0.0) -> ftlm.Run:
    """A body under random steps."""
    rng = np.random.default_rng(2)
    u = np.repeat(rng.choice([-1.0, 1.0], rows // 20 + 1), 20)[:rows]
    words = f"D^2 y = -D y - 3 y + 2 u - {friction!r}*sign(D y)" if friction else "D y = -y + u"
    plant = ftlm.Model(ftlm.equation(words))
    run = ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": np.zeros(rows)})
    y = plant.simulate(run)["y"] + 1e-3 * rng.standard_normal(rows)
    return ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": y})


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_a_multistart_is_ended_from_another_thread(friction: float) -> None:
    """The first report comes from within the multistart, which the flag then ends."""
    run = moving_run(600, friction)
    words = "D^2 y = v D y + k y + b u - fc*sign(D y)" if friction else "D^alpha y = a D^nu y + c y + b u"
    problem = FreeProblem.of(ftlm.equation(words, initial="rest"))
    flag, reports = _core.Stop(), []

    def report(done: int, _: int) -> None:
        reports.append(done)
        flag.set()

    with pytest.raises(KeyboardInterrupt):
        _core.joint_multistart(problem.core, [recording(run, problem.structure)], (1, 1 << 30), report, flag)
    assert reports


def test_the_catalogue_of_findings_is_read_before_threads_can_ask_for_it():
    # Two first calls at once crashed the interpreter in one of eight selections.
    code = "from ftlm.findings import finding_catalogue as f; print(f.cache_info().currsize)"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout == "1\n"
