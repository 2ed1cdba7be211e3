"""What a motor may be trusted to: every way out, the watchdog and the limits, on both rigs."""

import contextlib
import gc
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import ftlm
from ftlm import rig
from ftlm.rig import quanser, watchdog
from ftlm.rig.quanser import QuanserBoard
from ftlm.rig.rig import shut_down
from rig_bench import Bench, drive, recorded
from slow_cases import slow_after

HERE = Path(__file__).parent
LOOSE = rig.ArmParameters(**{**rig.ArmParameters.load("effective").__dict__, "travel": (1e6, 1e6)})


@pytest.fixture(params=["virtual", "q8"])
def bench(request, tmp_path, monkeypatch):
    return Bench(request.param, tmp_path, monkeypatch)


# ----------------------------------------------------------------------------------------------------------------------
# Ways out


def test_return_leaves_the_motors_off(bench):
    with bench.rig() as link:
        link.run(drive())
        assert bench.enabled
        assert len(link.take()) == 400
    assert link.shutdown_errors == []
    bench.assert_safe(within=502)


@pytest.mark.parametrize("error", [ValueError("x"), KeyboardInterrupt(), SystemExit(3), MemoryError()])
def test_an_exception_in_the_loop_leaves_the_motors_off(bench, error):
    def act():
        raise error

    bench.at(50, act)
    with pytest.raises(type(error)), bench.rig() as link:
        link.run(drive())
    assert len(link.take()) >= 49
    bench.assert_safe(within=152)


def test_an_exception_outside_the_loop_leaves_the_motors_off(bench):
    def fails():
        with bench.rig() as link:
            link.run(drive(50))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fails()
    bench.assert_safe(within=152)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_leave_the_motors_off(bench, number, request):
    if number == signal.SIGINT:
        # A shell that starts the tests in the background has them ignore Ctrl-C; here it must mean what it says.
        kept = signal.signal(number, signal.default_int_handler)
        request.addfinalizer(lambda: signal.signal(number, kept))
    before = signal.getsignal(number)
    bench.at(50, lambda: os.kill(os.getpid(), number))
    with pytest.raises(KeyboardInterrupt if number == signal.SIGINT else SystemExit), bench.rig() as link:
        link.run(drive())
    bench.assert_safe(within=153)
    assert signal.getsignal(number) is before


def test_garbage_collection_leaves_the_motors_off(bench):
    link = bench.rig()
    link.__enter__()
    link.run(drive(50))
    assert bench.enabled
    del link
    gc.collect()
    bench.assert_safe(within=152)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


@pytest.mark.parametrize("failing", ["write", "enable", "stop", "stop_watchdog", "close"])
def test_every_step_of_the_way_out_is_tried(bench, failing, monkeypatch):
    done = []
    with bench.rig() as link:
        link.run(drive(50))
        for name in ("write", "enable", "stop", "stop_watchdog", "close"):
            real = getattr(bench.board, name)

            def step(*arguments, name=name, real=real):
                done.append(name)
                if name == failing:
                    raise OSError("no answer")
                real(*arguments)

            monkeypatch.setattr(bench.board, name, step)
    assert done == ["write", "enable", "stop", "stop_watchdog", "close"]
    assert "no answer" in link.shutdown_errors[0]
    assert link.shutdown_errors[1:] == (
        ["the watchdog was allowed to expire instead, which sets 0 V"] if failing in ("write", "enable") else []
    )
    monkeypatch.undo()
    started = time.monotonic()
    shut_down(bench.board)
    # A watchdog that was not told to stop while its board was open is not waited for.
    assert time.monotonic() - started < 4.0


def test_a_second_ctrl_c_does_not_cut_the_way_out_short(bench, monkeypatch):
    with bench.rig() as link:
        link.run(drive(50))
        real, count = bench.board.enable, []

        def enable(on):
            count.append(on)
            if len(count) == 1:
                raise KeyboardInterrupt
            real(on)

        monkeypatch.setattr(bench.board, "enable", enable)
    assert count == [False, False]
    bench.assert_safe()


@pytest.mark.parametrize(
    "stop", ["open", "configure", "set_expiration", "start_watchdog", "start", "read_rest", "enable"]
)
def test_a_start_that_fails_leaves_the_motors_off(bench, stop, monkeypatch):
    real = getattr(bench.board, stop)

    def fails(*arguments):
        real(*arguments)
        if arguments != (False,):
            raise OSError("no answer")

    monkeypatch.setattr(bench.board, stop, fails)
    with pytest.raises(OSError, match="no answer"), bench.rig():
        pass
    assert all(volts == (0.0, 0.0) for _, volts in bench.writes)
    assert not bench.enabled
    if bench.kind == "q8":
        assert not bench.hardware.in_use
        assert bench.hardware.violations == []


def test_ctrl_c_in_a_record_keeps_what_was_recorded(bench, tmp_path):
    def act():
        raise KeyboardInterrupt

    bench.at(200, act)
    with pytest.raises(KeyboardInterrupt):
        rig.record(bench.board, arm=True, duration=2.0, out=tmp_path / "run.csv")
    loaded = ftlm.load(tmp_path / "run.csv")
    assert 199 <= loaded.length <= 202
    assert loaded.metadata["faults"] == ["stopped by Ctrl-C"]
    bench.assert_safe(within=303)


# ----------------------------------------------------------------------------------------------------------------------
# The watchdog

CHILD = """
import sys
sys.path.insert(0, {here!r})
from ftlm import rig
from ftlm.rig import recording, rig as rig_module
rig_module.WATCHDOG_RANGE_S = 0.01, 60.0
if {kind!r} == "virtual":
    board = rig.VirtualBoard(register_file={page!r}, real_time=True)
else:
    from quanser_stand_in import Board
    from ftlm.rig.quanser import QuanserBoard
    sys.modules |= Board("linear", page={page!r}).modules()
    board = QuanserBoard()
# A busy machine may be late before it is struck; that is not what is tested here.
rig.recording.Limits = lambda: rig.Limits(max_write_delay=60.0, max_missed_deadlines=10**9)
rig.record(board, arm=True, input="sine", amplitude=0.2, duration=25.0, watchdog=3.0, out={out!r})
"""


def child(kind, tmp_path):
    page, out = tmp_path / "page", tmp_path / "run.csv"
    script = CHILD.format(here=str(HERE), kind=kind, page=str(page), out=str(out))
    process = subprocess.Popen([sys.executable, "-c", script], stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 120
    found = None
    # A second of beats, so that some rows are on disk.
    while found is None or found.volts == (0.0, 0.0) or found.get("beat") < 500:
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < until
        time.sleep(0.02)
        if found is None and page.exists() and page.stat().st_size == watchdog.PAGE_SIZE_BYTES:
            with contextlib.suppress(ValueError):
                found = watchdog.RegisterPage(page)
    return process, found, out


def until_expired(page):
    until = time.monotonic() + 120
    while not page.has_expired or page.volts != (0.0, 0.0):
        assert time.monotonic() < until
        time.sleep(0.01)


@slow_after(1, "kind", ["q8", "virtual"])
def test_a_killed_program_leaves_the_motors_off(kind, tmp_path):
    process, page, out = child(kind, tmp_path)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=120)
    until_expired(page)
    assert page.volts == (0.0, 0.0)
    assert not page.get("enabled")
    page.close()
    kept = ftlm.load(out.with_name("run.csv.partial"))
    assert kept.length >= 3
    assert "did not end" in kept.notes[0]


@slow_after(1, "kind", ["virtual", "q8"])
def test_a_frozen_program_leaves_the_motors_off_and_wakes_to_a_fault(kind, tmp_path):
    process, page, out = child(kind, tmp_path)
    process.send_signal(signal.SIGSTOP)
    until_expired(page)
    assert page.volts == (0.0, 0.0)
    process.send_signal(signal.SIGCONT)
    _, said = process.communicate(timeout=120)
    assert process.returncode == 1
    assert "RigFault" in said
    assert "the watchdog expired" in said or "ms late" in said
    assert page.volts == (0.0, 0.0)
    page.close()
    loaded = ftlm.load(out)
    assert loaded.length > 300
    assert loaded.metadata["faults"]


COMMAND = """
import sys
from ftlm import cli, rig
rig.rig.WATCHDOG_RANGE_S = 0.01, 60.0
rig.recording.Limits = lambda: rig.Limits(max_write_delay=60.0, max_missed_deadlines=10**9)
sys.argv = ["ftlm", "record", "--real-time", "--duration", "25", "--watchdog", "60", "-o", {out!r}]
cli.main()
"""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_command_that_is_stopped_says_where_its_run_is(number, code, tmp_path):
    out = tmp_path / "run.csv"
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND.format(out=str(out))],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    partial = tmp_path / "run.csv.partial"
    until = time.monotonic() + 120
    while not partial.exists() or partial.stat().st_size < 20_000:
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < until
        time.sleep(0.02)
    process.send_signal(number)
    _, said = process.communicate(timeout=120)
    assert process.returncode == code
    assert f"the motors are at 0 V; {ftlm.load(out).length} rows were recorded until then and are in {out}" in said
    assert ftlm.load(out).metadata["faults"] == ["stopped by " + ("Ctrl-C" if code == 130 else "SIGTERM")]
    assert not partial.exists()


def test_on_a_virtual_clock_the_outputs_are_at_0_volts_one_timeout_after_the_last_reload(tmp_path, monkeypatch):
    bench = Bench("q8", tmp_path, monkeypatch)

    def freeze(board):
        if board.sample == 201:
            board.time += 0.5

    bench.hardware.hooks["watchdog_reload"] = freeze
    words, run = recorded(bench, tmp_path)
    assert "the watchdog expired" in words
    assert bench.hardware.volts == (0.0, 0.0)
    assert ("expired", 201, (0.0, 0.0)) in bench.hardware.log
    assert run.length == 101


@pytest.mark.parametrize("call", ["task_read", "watchdog_reload", "write_analog"])
def test_an_expiry_is_named_whichever_call_meets_it_first(tmp_path, monkeypatch, call):
    bench = Bench("q8", tmp_path, monkeypatch)

    def freeze(board):
        if board.sample == 201 and not board.expired:
            board.time += 0.5

    bench.hardware.hooks[call] = freeze
    words, run = recorded(bench, tmp_path)
    assert "the watchdog expired" in words
    assert "error -600" not in words
    assert bench.hardware.volts == (0.0, 0.0)
    assert not bench.hardware.enabled
    assert "the watchdog expired" in run.metadata["faults"][0]


@pytest.mark.parametrize("missing", ["both", "analog", "digital", "one line"])
def test_it_does_not_start_without_expiration_states(bench, missing, monkeypatch):
    board = bench.board
    if bench.kind == "virtual":

        def set_expiration():
            page = board._access()
            if missing in ("digital", "one line"):
                page.set("state1", 0.0)
            if missing == "digital":
                page.set("state2", 0.0)
            if missing == "analog":
                page.set("tristate", 1)

        monkeypatch.setattr(board, "set_expiration", set_expiration)
    else:

        def set_expiration():
            if missing in ("digital", "one line"):
                board._hil.watchdog_set_analog_expiration_state(*quanser.ANALOG_OUT, np.zeros(2))
                board._analog_safe = True
            if missing == "analog":
                states = np.full(8, 2, dtype=np.int32)
                board._hil.watchdog_set_digital_expiration_state(*quanser.DIGITAL_OUT, states)
                board._digital_safe = True

        monkeypatch.setattr(board, "set_expiration", set_expiration)
    with pytest.raises(ftlm.RigFault, match="not started without a watchdog"), bench.rig():
        raise AssertionError
    assert not bench.enabled
    assert all(volts == (0.0, 0.0) for _, volts in bench.writes)
    if bench.kind == "q8":
        assert bench.hardware.timeout is None
        fresh = QuanserBoard()
        fresh.open()
        with pytest.raises(ftlm.RigFault, match="expiration state"):
            fresh.start_watchdog(0.1)
        fresh.close()


def test_by_the_boards_rule_outputs_stay_where_they_were_without_tristate(tmp_path):
    page = watchdog.RegisterPage(tmp_path / "page", create=True)
    for tristate, left in ((0, (1.0, -1.0)), (1, (0.0, 0.0))):
        page.write_heartbeat(1, 1.0, -1.0)
        for name, value in (("state1", 0.0), ("state2", 0.0), ("tristate", tristate), ("expired", 0)):
            page.set(name, value)
        watchdog.trip(page, 1.0)
        assert page.has_expired
        assert page.volts == left
    page.close()


@pytest.mark.parametrize("seconds", [0.0, -1.0, 2.0, float("nan")])
def test_a_watchdog_that_would_not_help_is_refused(bench, seconds):
    with pytest.raises(ftlm.ModelError, match="the motors would keep running"):
        bench.rig(watchdog=seconds)


# ----------------------------------------------------------------------------------------------------------------------
# Limits in the innermost write


def checked_writes(volts, rate, limits):
    """Largest excess over the amplitude, slew and heat limits in a sequence of written volts, shape (n, 2)."""
    current = -0.5 * np.asarray(volts)
    over = np.abs(current).max(axis=0) - limits.current
    before, after = current[:-1], current[1:]
    # Towards zero the heat limit may go faster.
    relief = (before * after >= 0) & (np.abs(after) < np.abs(before))
    jump = np.where(relief, 0.0, np.abs(after - before)).max(axis=0) - np.array(limits.slew) / rate
    share = 1.0 / (rate * limits.thermal_time)
    heat = np.zeros(2)
    decay = (1.0 - share) ** np.arange(4096)
    for k in (0, 1):
        mean = share * np.convolve(current[:, k] ** 2, decay)[: len(current)]
        heat[k] = mean.max() - limits.continuous[k] ** 2
    return over.max(), jump.max(), heat.max()


@pytest.mark.parametrize(("kind", "count"), [("virtual", 20_000), ("q8", 10_000)])
def test_no_write_is_outside_the_limits(kind, count, tmp_path, monkeypatch):
    bench = Bench(kind, tmp_path, monkeypatch, parameters=LOOSE, rate=8000.0)
    rng = np.random.default_rng(11)
    commands = rng.standard_normal((count, 2)) * 10.0 ** rng.uniform(-3, 6, (count, 2))
    # Stretches of steady full current, which only the heat limit stops.
    commands[count // 2 :] = np.where(rng.random((count - count // 2, 1)) < 0.999, 1e3, -1e3)
    limits = rig.Limits(
        deflection=(1e9, 1e9), fastest=1e9, max_missed_deadlines=10**6, thermal_time=0.2, saturation=1e9, standstill=1e9
    )
    with bench.rig(limits=limits) as link:
        link.run(commands)
    volts = np.array([v for _, v in bench.writes])
    assert len(volts) > count
    over, jump, heat = checked_writes(volts, 8000.0, limits)
    assert over <= 1e-12
    assert jump <= 1e-9
    assert heat <= 1e-9
    assert np.abs(volts).max() > 1.8


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_command_that_is_no_number_writes_zero_and_latches(bench, value):
    commands = drive()
    commands[50, 1] = value
    with bench.rig() as link:
        with pytest.raises(ftlm.RigFault, match=r"command of motor 2 is .*, not a finite current"):
            link.run(commands)
        assert bench.writes[-1][1] == (0.0, 0.0)
        rows = link.take()
        assert len(rows) == 51
        assert np.isfinite(rows).all()
        # Latched: nothing runs any more.
        with pytest.raises(ftlm.RigFault):
            link.run(drive(10))
        assert bench.writes[-1][1] == (0.0, 0.0)
    bench.assert_safe(within=152)


def test_no_command_is_written_after_the_time_limit(bench):
    with bench.rig(limit=0.5) as link:
        link.run(drive(250))
        with pytest.raises(ftlm.RigFault, match=r"time limit of 0\.5 s is reached"):
            link.run(drive(250))
    assert max(at for at, volts in bench.writes if volts != (0.0, 0.0)) <= 352
    bench.assert_safe()
