"""Runs of a rig outside the main thread: whoever shuts it down, nothing but 0 V is written afterwards."""

import asyncio
import concurrent.futures
import hashlib
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import ftlm
from ftlm import rig
from ftlm.rig import recording, watchdog
from ftlm.rig import rig as rig_module
from ftlm.rig.quanser import QuanserBoard
from quanser_stand_in import Board

HERE = Path(__file__).parent

#: Timeout of the watchdog [s] of runs in real time, which a busy machine may stop for seconds.
WATCHDOG_S = 60.0


def stand_in(monkeypatch):
    hardware = Board("linear")
    hardware.install(monkeypatch)
    return hardware, QuanserBoard(clock=lambda: hardware.time, sleep=hardware.sleep)


def patient(monkeypatch):
    """A busy machine may be late in real time; that is not what is tested here."""
    monkeypatch.setattr(recording, "Limits", lambda: rig.Limits(max_write_delay=60.0, max_missed_deadlines=10**9))
    monkeypatch.setattr(rig_module, "WATCHDOG_RANGE_S", (0.01, WATCHDOG_S))


@pytest.fixture
def default_interrupt():
    """Ctrl-C as a program from a terminal has it."""
    kept = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, kept)


def in_thread(work):
    """Starts a thread, and returns the event of its end with a list that gets what it raised."""
    done, raised = threading.Event(), []

    def run():
        try:
            work()
        except BaseException as error:
            raised.append(error)
        finally:
            done.set()

    threading.Thread(target=run, daemon=True).start()
    return done, raised


# ----------------------------------------------------------------------------------------------------------------------
# The gate of the outputs


@pytest.mark.parametrize("call", ["watchdog_reload", "write_analog"])
def test_a_thread_that_is_about_to_write_volts_writes_none_after_the_shutdown(monkeypatch, call):
    hardware, board = stand_in(monkeypatch)
    link = rig.Rig(board)
    about, zero = threading.Event(), threading.Event()

    def wait(hardware):
        if threading.current_thread() is not threading.main_thread() and hardware.sample == 150:
            about.set()
            zero.wait(0.5)

    def switched(hardware):
        # The first step after 0 V: now the other thread may write what it was about to.
        if threading.current_thread() is threading.main_thread():
            zero.set()
            time.sleep(0.2)

    link.__enter__()
    hardware.hooks |= {call: wait, "write_digital": switched}
    done, raised = in_thread(lambda: link.run(np.full((2000, 2), 0.3)))
    assert about.wait(120)
    link.__exit__(None, None, None)
    assert done.wait(120)
    volts = [values for _, values in hardware.writes]
    assert max(k for k, one in enumerate(volts) if one != (0.0, 0.0)) < volts.index((0.0, 0.0), 150)
    assert volts[-1] == hardware.volts == (0.0, 0.0)
    assert not hardware.enabled
    assert isinstance(raised[0], ftlm.RigFault)
    assert hardware.violations == []


def check_shutdowns(monkeypatch, count):
    """A run in a thread and a shutdown in the main one, at any moment."""
    random = np.random.default_rng(5)
    for _ in range(count):
        hardware, board = stand_in(monkeypatch)
        link = rig.Rig(board, limit=600.0)
        link.__enter__()
        done, raised = in_thread(lambda link=link: link.run(np.full((200_000, 2), 0.3)))
        # On a busy machine the arm may reach a limit switch before this thread sees a volt, and its run is over.
        while hardware.volts == (0.0, 0.0) and not done.is_set():
            time.sleep(0)
        time.sleep(0.02 * random.random())
        link.__exit__(None, None, None)
        done.wait(120)
        assert hardware.volts == (0.0, 0.0)
        assert not hardware.enabled
        assert isinstance(raised[0], ftlm.RigFault)
        with pytest.raises(ftlm.RigFault):
            link.run(np.full((10, 2), 0.3))
        assert hardware.volts == (0.0, 0.0)


def test_shutdowns_during_a_run_of_another_thread_leave_0_v(monkeypatch):
    check_shutdowns(monkeypatch, 10)


@pytest.mark.slow
def test_two_hundred_shutdowns_during_a_run_of_another_thread_leave_0_v(monkeypatch):
    check_shutdowns(monkeypatch, 200)


DAEMON = """
import sys, threading, time
sys.path.insert(0, {here!r})
from ftlm import rig
from ftlm.rig import recording, rig as rig_module
from ftlm.rig.quanser import QuanserBoard
from quanser_stand_in import Board
rig_module.WATCHDOG_RANGE_S = 0.01, {watchdog!r}
hardware = Board("linear", page={page!r})
sys.modules |= hardware.modules()
recording.Limits = lambda: rig.Limits(max_write_delay=60.0, max_missed_deadlines=10**9)
run = dict(arm=True, input="sine", amplitude=0.3, duration=25.0, watchdog={watchdog!r})
threading.Thread(target=rig.record, args=(QuanserBoard(),), kwargs=run, daemon=True).start()
while hardware.page.volts == (0.0, 0.0):
    time.sleep(0.001)
time.sleep({delay!r})
"""


def check_daemons(tmp_path, count):
    """Programs whose main thread ends while a daemon thread drives the motors."""
    random = np.random.default_rng(7)
    for k in range(count):
        path = tmp_path / f"page{k}"
        script = DAEMON.format(here=str(HERE), page=str(path), delay=0.02 * random.random(), watchdog=WATCHDOG_S)
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, done.stderr
        page = watchdog.RegisterPage(path)
        assert page.volts == (0.0, 0.0)
        # The shutdown wrote it, not the watchdog.
        assert not page.has_expired
        page.close()


def test_a_program_that_ends_over_a_daemon_thread_leaves_0_v(tmp_path):
    check_daemons(tmp_path, 3)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_two_hundred_programs_that_end_over_a_daemon_thread_leave_0_v(tmp_path):
    check_daemons(tmp_path, 200)


@pytest.mark.parametrize("kind", ["virtual", "q8"])
def test_a_closed_gate_lets_nothing_but_0_v_pass(kind, monkeypatch):
    board = rig.VirtualBoard(parameters="linear") if kind == "virtual" else stand_in(monkeypatch)[1]
    with rig.Rig(rig.VirtualBoard() if kind == "virtual" else board) as link:
        board = link.board
        board.write((0.5, 0.0))
        board.gate.close("the test closed it")
        board.gate.close("a second reason")
        for act in (
            lambda: board.write((0.5, 0.0)),
            lambda: board.write((float("nan"), 0.0)),
            lambda: board.enable(True),
            lambda: link.run(np.full((10, 2), 0.3)),
        ):
            with pytest.raises(ftlm.RigFault, match="the test closed it"):
                act()
        board.write((0.0, 0.0))
        board.enable(False)
        assert len(link.take()) == 0


def test_a_board_on_which_a_thread_still_runs_is_not_started_again(monkeypatch):
    hardware, board = stand_in(monkeypatch)
    link = rig.Rig(board)
    reached, go_on = threading.Event(), threading.Event()

    def wait(hardware):
        if hardware.sample == 150 and threading.current_thread() is not threading.main_thread():
            reached.set()
            go_on.wait(120)

    link.__enter__()
    hardware.hooks["task_read"] = wait
    done, raised = in_thread(lambda: link.run(np.full((2000, 2), 0.3)))
    assert reached.wait(120)
    link.__exit__(None, None, None)
    log = len(hardware.log)
    with pytest.raises(ftlm.RigFault, match="another thread has not returned"):
        rig.record(board, arm=True, duration=0.1)
    assert len(hardware.log) == log
    go_on.set()
    done.wait(120)
    assert isinstance(raised[0], ftlm.RigFault)
    hardware.hooks.clear()
    hardware.reset()
    assert rig.record(board, arm=True, duration=0.1).length == 51


# ----------------------------------------------------------------------------------------------------------------------
# Ctrl-C while the run is in another thread


class Interrupting:
    """Drives both motors, sends a signal at a sample, and waits until the motors are stopped, if that is its effect.

    When another thread runs is the machine's, so that only what is asked after that is counted.
    """

    def __init__(self, number=signal.SIGINT, ready=None):
        self.number, self.ready, self.asked, self.begun = number, ready, 0, threading.Event()

    def __call__(self, at, angles, reference):
        self.asked += 1
        self.begun.set()
        if self.asked == 50:
            assert self.ready is None or self.ready.wait(120)
            boards, until = list(rig_module.INTERRUPT_WATCH._boards), time.monotonic() + 120
            os.kill(os.getpid(), self.number)
            while self.number != signal.SIGWINCH and any(board.gate.reason is None for board in boards):
                assert time.monotonic() < until
                time.sleep(0.001)
        return 0.2, 0.1


def drive(controller, tmp_path):
    return rig.control(
        controller,
        (0.1, 0.05),
        duration=25.0,
        parameters="linear",
        real_time=True,
        watchdog=WATCHDOG_S,
        out=tmp_path / "run.csv",
    )


def check_stopped(controller, fault, tmp_path, words="stopped by Ctrl-C"):
    """Stopped with the answer to the sample at which the gate was closed; the run is kept, with the cause."""
    assert isinstance(fault, ftlm.RigFault)
    assert words in str(fault)
    assert controller.asked == 50
    run = ftlm.load(tmp_path / "run.csv")
    assert 50 <= run.length <= 52
    assert words in run.metadata["faults"][0]


def test_ctrl_c_stops_a_run_in_a_thread_of_an_event_loop(monkeypatch, tmp_path, default_interrupt):
    patient(monkeypatch)
    controller, raised = Interrupting(), []

    def work():
        try:
            drive(controller, tmp_path)
        except ftlm.RigFault as fault:
            raised.append(fault)

    async def main():
        await asyncio.to_thread(work)

    with pytest.raises(KeyboardInterrupt):
        asyncio.run(main())
    check_stopped(controller, raised[0], tmp_path)


def test_ctrl_c_stops_a_run_of_an_executor(monkeypatch, tmp_path, default_interrupt):
    patient(monkeypatch)
    controller = Interrupting()
    with concurrent.futures.ThreadPoolExecutor() as pool:
        future = pool.submit(drive, controller, tmp_path)
        with pytest.raises(KeyboardInterrupt):
            future.result()
        check_stopped(controller, future.exception(), tmp_path)


def test_ctrl_c_stops_a_run_while_the_main_thread_is_busy_elsewhere(monkeypatch, tmp_path, default_interrupt):
    """As in the event loop of a graphical interface: no handler in Python runs until it returns."""
    patient(monkeypatch)
    controller = Interrupting()
    done, raised = in_thread(lambda: drive(controller, tmp_path))

    def compute():
        while not done.is_set():
            hashlib.pbkdf2_hmac("sha256", b"", b"", 300_000)

    with pytest.raises(KeyboardInterrupt):
        compute()
    done.wait(120)
    check_stopped(controller, raised[0], tmp_path)


def test_a_signal_that_the_program_handles_stops_a_run_in_a_thread(monkeypatch, tmp_path):
    patient(monkeypatch)
    seen = []
    kept = signal.signal(signal.SIGTERM, lambda number, frame: seen.append(number))
    try:
        controller = Interrupting(signal.SIGTERM)
        done, raised = in_thread(lambda: drive(controller, tmp_path))
        done.wait(120)
    finally:
        signal.signal(signal.SIGTERM, kept)
    check_stopped(controller, raised[0], tmp_path, "stopped by SIGTERM")
    assert seen == [signal.SIGTERM]


def test_a_handler_that_is_set_during_a_run_is_called_and_kept(monkeypatch, tmp_path, default_interrupt):
    """As by an event loop that starts later; afterwards the handlers are the program's alone."""
    patient(monkeypatch)
    seen, ready = [], threading.Event()
    controller, watch = Interrupting(ready=ready), rig_module.INTERRUPT_WATCH
    done, raised = in_thread(lambda: drive(controller, tmp_path))
    assert controller.begun.wait(120)
    signal.signal(signal.SIGINT, lambda number, frame: seen.append(number))
    while rig_module._system_handler(signal.SIGINT) != watch._handlers[signal.SIGINT]:
        time.sleep(0.001)
    ready.set()
    done.wait(120)
    check_stopped(controller, raised[0], tmp_path)
    until = time.monotonic() + 120
    while watch._pipes and time.monotonic() < until:
        time.sleep(0.01)
    os.kill(os.getpid(), signal.SIGINT)
    assert seen == [signal.SIGINT] * 2
    signal.signal(signal.SIGINT, signal.default_int_handler)


def test_two_rigs_in_two_threads_both_stop(monkeypatch, default_interrupt):
    patient(monkeypatch)
    second = Interrupting(signal.SIGWINCH)
    controllers = Interrupting(ready=second.begun), second
    threads = []
    for k, controller in enumerate(controllers):
        options = {"duration": 25.0, "parameters": "linear", "real_time": True, "watchdog": WATCHDOG_S, "seed": k}
        threads.append(in_thread(lambda c=controller, o=options: rig.control(c, (0.1, 0.05), **o)))

    def join():
        for done, _ in threads:
            done.wait(120)

    with pytest.raises(KeyboardInterrupt):
        join()
    for done, raised in threads:
        done.wait(120)
        assert "stopped by Ctrl-C" in str(raised[0])


def test_where_ctrl_c_cannot_reach_a_thread_hardware_runs_in_the_main_thread_only(monkeypatch, tmp_path):
    hardware, board = stand_in(monkeypatch)
    monkeypatch.setattr(rig_module.InterruptWatch, "available", False)
    for work in (
        lambda: rig.record(board, arm=True, duration=0.1, out=tmp_path / "run.csv"),
        lambda: rig.Rig(board).__enter__(),
    ):
        done, raised = in_thread(work)
        done.wait(120)
        assert isinstance(raised[0], ftlm.ModelError)
        assert "run it in the main thread" in str(raised[0])
    assert hardware.log == []
    assert list(tmp_path.iterdir()) == []
    done, raised = in_thread(lambda: rig.record(duration=0.1))
    done.wait(120)
    assert raised == []
    assert rig.record(board, arm=True, duration=0.1).length == 51
