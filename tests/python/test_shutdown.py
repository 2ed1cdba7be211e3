"""Shutdown of a rig with failing calls and signals: the motors end without current, or a message says otherwise."""

import itertools
import signal
import sys
from contextlib import suppress

import numpy as np
import pytest

import ftlm
from ftlm import rig
from ftlm.rig import rig as rig_module
from ftlm.rig import watchdog
from ftlm.rig.quanser import QuanserBoard
from quanser_stand_in import Board

CALLS = (
    "task_read",
    "watchdog_reload",
    "write_analog",
    "write_digital",
    "task_stop",
    "task_delete",
    "watchdog_stop",
    "watchdog_clear",
    "close",
)
STEPS = ("write", "enable", "stop", "let_expire", "stop_watchdog", "close")
PAIRS = list(itertools.combinations(CALLS, 2))
TRIPLES = list(itertools.combinations(CALLS, 3))
#: What decides whether a motor is live; the rest of the table is marked slow.
SHORT = [
    ("write_analog", "write_digital"),
    ("write_analog", "watchdog_clear"),
    ("task_read", "write_digital"),
    ("write_analog", "write_digital", "watchdog_reload"),
    ("write_analog", "write_digital", "watchdog_stop"),
]
SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class EndError(Exception):
    """What ends a block other than its end."""


def stand_in(monkeypatch):
    hardware = Board("linear")
    hardware.install(monkeypatch)
    return hardware, QuanserBoard(clock=lambda: hardware.time, sleep=hardware.sleep)


def ended(link, raises, act):
    """Drives ten samples, acts, and leaves the block; what came out of it."""
    try:
        with link:
            link.run(np.full((10, 2), 0.3))
            act()
            if raises:
                raise EndError
    except BaseException as error:
        return error
    return None


def off(hardware):
    """Whether the motors are without current, a second after the program has let go."""
    hardware.time += 1.0
    if hardware.timeout and not hardware.expired and hardware.time - hardware.last_reload > hardware.timeout:
        return len(hardware.tristate) == 8 and set(hardware.analog_state.values()) == {0.0}
    return hardware.volts == (0.0, 0.0) or not hardware.enabled


def check_failing(monkeypatch, failing, raises):
    hardware, board = stand_in(monkeypatch)
    link = rig.Rig(board)

    def act():
        assert hardware.volts != (0.0, 0.0)
        hardware.refuse |= dict.fromkeys(failing, -1160)

    found = ended(link, raises, act)
    assert isinstance(found, EndError) if raises else found is None
    assert off(hardware)
    assert hardware.violations == []
    if hardware.in_use and "close" not in failing:
        # Nothing could be confirmed: said, and everything that may still stop the motors is left as it is.
        assert {"write_analog", "write_digital", "watchdog_reload"} <= set(failing)
        assert link.shutdown_errors[-1] == rig_module.MOTORS_LIVE_MESSAGE
        assert hardware.timeout
    else:
        assert rig_module.MOTORS_LIVE_MESSAGE not in link.shutdown_errors
    hardware.refuse = {}
    assert not any("-599" in trouble for trouble in link.shutdown_errors)


@pytest.mark.parametrize("raises", [False, True])
@pytest.mark.parametrize("failing", SHORT, ids=" ".join)
def test_calls_that_fail_on_the_way_out_leave_no_motor_live(monkeypatch, failing, raises):
    check_failing(monkeypatch, failing, raises)


@pytest.mark.slow
@pytest.mark.parametrize("raises", [False, True])
@pytest.mark.parametrize("failing", PAIRS + TRIPLES, ids=" ".join)
def test_no_pair_or_triple_of_failing_calls_leaves_a_motor_live(monkeypatch, failing, raises):
    check_failing(monkeypatch, failing, raises)


def virtual(tmp_path, monkeypatch, failing):
    """What a virtual board's outputs are after a way out with failing steps, and what was said."""
    page = tmp_path / "page"
    board = rig.VirtualBoard(parameters=rig.ArmParameters.load("linear"), register_file=page)
    link = rig.Rig(board)

    def act():
        for name in failing:

            def fails(*arguments, name=name):
                raise OSError(f"{name} has no answer")

            monkeypatch.setattr(board, name, fails)

    ended(link, False, act)
    monkeypatch.undo()
    found = watchdog.RegisterPage(page)
    state = found.volts, bool(found.get("enabled")), found.get("timeout") > 0
    found.close()
    with suppress(OSError):
        rig_module.shut_down(board)
    return state, link.shutdown_errors


def test_a_virtual_board_that_can_neither_write_nor_disable_is_stopped_by_its_watchdog(tmp_path, monkeypatch):
    state, troubles = virtual(tmp_path, monkeypatch, ("write", "enable"))
    assert state[:2] == ((0.0, 0.0), False)
    assert [t.split(" failed")[0] for t in troubles[:2]] == ["writing 0 V", "disabling the amplifiers"]
    assert troubles[2] == "the watchdog was allowed to expire instead, which sets 0 V"


@pytest.mark.slow
@pytest.mark.parametrize("failing", list(itertools.combinations(STEPS, 2)) + list(itertools.combinations(STEPS, 3)))
def test_no_failing_steps_leave_the_virtual_motors_live(tmp_path, monkeypatch, failing):
    (volts, enabled, watched), troubles = virtual(tmp_path, monkeypatch, failing)
    if {"write", "enable", "let_expire"} <= set(failing):
        assert watched
        assert troubles[-1] == rig_module.MOTORS_LIVE_MESSAGE
    else:
        assert volts == (0.0, 0.0) or not enabled


def interrupted(monkeypatch, number, raises, line):
    """A way out in which a signal comes at its `line`-th line; how many lines it had, and what came out of it."""
    hardware, board = stand_in(monkeypatch)
    link = rig.Rig(board)
    before = [signal.getsignal(n) for n in SIGNALS]
    lines = 0

    def local(frame, event, argument):
        nonlocal lines
        if event == "line":
            lines += 1
            if lines == line:
                signal.raise_signal(number)
        return local

    def tracer(frame, event, argument):
        return local if "ftlm" in frame.f_code.co_filename and "test" not in frame.f_code.co_filename else None

    kept = sys.gettrace()
    try:
        found = ended(link, raises, lambda: sys.settrace(tracer))
    finally:
        sys.settrace(kept)
    assert hardware.volts == (0.0, 0.0)
    assert not hardware.enabled
    assert not hardware.in_use
    assert hardware.timeout is None
    assert [what for what, _, _ in hardware.log[-2:]] == ["watchdog_stop", "close"]
    assert hardware.violations == []
    assert link.shutdown_errors == []
    assert [signal.getsignal(n) for n in SIGNALS] == before
    return lines, found


def check_lines(monkeypatch, number, raises, every):
    def stopped(number, frame):
        raise SystemExit(128 + number)

    # What a signal does once the motors are off is the program's affair: here it raises, so that it can be counted.
    kept = [signal.signal(n, signal.default_int_handler if n == signal.SIGINT else stopped) for n in SIGNALS]
    try:
        count, found = interrupted(monkeypatch, number, raises, 0)
        assert isinstance(found, EndError) if raises else found is None
        assert count > 50
        for line in range(1, count + 1, every):
            _, found = interrupted(monkeypatch, number, raises, line)
            # Who asked to stop gets it, once the motors are off; an error that is on its way says more.
            ending = KeyboardInterrupt if number == signal.SIGINT else SystemExit
            assert isinstance(found, (EndError, ending) if raises else ending), line
    finally:
        for n, handler in zip(SIGNALS, kept, strict=True):
            signal.signal(n, handler)
    return len(range(1, count + 1, every))


@pytest.mark.parametrize("raises", [False, True])
def test_a_signal_in_the_way_out_does_not_cut_it_short(monkeypatch, raises):
    check_lines(monkeypatch, signal.SIGINT, raises, 9)


@pytest.mark.slow
@pytest.mark.parametrize("raises", [False, True])
@pytest.mark.parametrize("number", SIGNALS)
def test_no_line_of_the_way_out_is_cut_short_by_a_signal(monkeypatch, number, raises):
    check_lines(monkeypatch, number, raises, 1)


def test_a_failed_write_keeps_its_cause(monkeypatch, tmp_path):
    hardware, board = stand_in(monkeypatch)

    def gone(board):
        if board.sample == 200:
            board.refuse |= {"write_analog": -1160, "write_digital": -1160}

    hardware.hooks["task_read"] = gone
    with pytest.raises(ftlm.RigFault, match="was disconnected") as fault:
        rig.record(board, arm=True, duration=1.0, out=tmp_path / "run.csv")
    assert "-599" not in str(fault.value)
    assert "the watchdog was allowed to expire" in str(fault.value)
    assert "expired" in [what for what, _, _ in hardware.log]
    assert hardware.volts == (0.0, 0.0)
    assert not hardware.enabled
    assert ftlm.load(tmp_path / "run.csv").length == fault.value.run.length


def test_after_an_expiry_the_next_start_brings_nothing_back(monkeypatch):
    hardware, board = stand_in(monkeypatch)

    def act():
        hardware.refuse |= {"write_analog": -1160, "write_digital": -1160}

    ended(rig.Rig(board), False, act)
    hardware.refuse = {}
    hardware.timeout = None
    del hardware.log[:]
    with pytest.raises(EndError), rig.Rig(QuanserBoard(clock=lambda: hardware.time)):
        raise EndError
    assert [what for what, _, _ in hardware.log[:3]] == ["cleared", "write_analog", "write_digital"]


def test_a_watchdog_that_died_is_noticed_within_a_sample(tmp_path):
    board = rig.VirtualBoard(register_file=tmp_path / "page")
    link = rig.Rig(board)

    def outlived():
        with link:
            link.run(np.full((20, 2), 0.3))
            board._process.kill()
            board._process.wait()
            link.run(np.full((20, 2), 0.3))

    with pytest.raises(ftlm.RigFault, match="watchdog's process has died"):
        outlived()
    assert len(link.take()) == 21
    page = watchdog.RegisterPage(tmp_path / "page")
    assert page.volts == (0.0, 0.0)
    assert not page.get("enabled")
    page.close()


@pytest.mark.parametrize("stage", [0, 1])
def test_a_gauge_that_stands_at_zero_is_a_fault(monkeypatch, tmp_path, stage):
    hardware, board = stand_in(monkeypatch)

    def dead(board, analog, counts, digital):
        analog[stage] = 0.0
        return 1

    hardware.hooks["reading"] = dead
    with pytest.raises(ftlm.RigFault, match=f"strain gauge {stage + 1} has not changed from 0.0000 V for 0.50 s"):
        rig.record(board, arm=True, duration=2.0, out=tmp_path / "run.csv")


@pytest.mark.parametrize(
    ("channel", "words"), [(0, "strain gauge 1 is saturated at NaN"), (3, "current sense of motor 2")]
)
def test_a_reading_that_is_no_number_is_a_fault_and_the_rows_before_it_load(monkeypatch, tmp_path, channel, words):
    hardware, board = stand_in(monkeypatch)

    def nan(board, analog, counts, digital):
        if board.sample > 200:
            analog[channel] = float("nan")
        return 1

    hardware.hooks["reading"] = nan
    with pytest.raises(ftlm.RigFault, match=words):
        rig.record(board, arm=True, duration=2.0, out=tmp_path / "run.csv")
    assert ftlm.load(tmp_path / "run.csv").length == 100
    assert hardware.volts == (0.0, 0.0)


@pytest.mark.parametrize("error", [RuntimeError("x"), MemoryError(), OSError(5, "no answer"), ValueError("x")])
@pytest.mark.parametrize("where", ["progress", "task_read"])
def test_whatever_ends_a_recording_its_rows_are_kept(monkeypatch, tmp_path, error, where):
    hardware, board = stand_in(monkeypatch)

    def fails(*found):
        if where == "progress" or found[0].sample == 300:
            raise error

    if where == "task_read":
        hardware.hooks["task_read"] = fails
    with pytest.raises(type(error)):
        rig.record(
            board, arm=True, duration=1.0, out=tmp_path / "run.csv", progress=fails if where == "progress" else None
        )
    run = ftlm.load(tmp_path / "run.csv")
    assert run.length >= 32
    assert type(error).__name__ in run.metadata["faults"][0]
    assert hardware.volts == (0.0, 0.0)
    assert [path.name for path in tmp_path.iterdir()] == ["run.csv"]


def test_a_dangling_partial_link_is_not_followed(tmp_path):
    away = tmp_path / "away"
    (tmp_path / "run.csv.partial").symlink_to(away)
    with pytest.raises(ftlm.DataError, match="a program that was interrupted"):
        rig.record(duration=0.1, out=tmp_path / "run.csv")
    rig.record(duration=0.1, out=tmp_path / "run.csv", force=True)
    assert not away.exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.csv"]


def test_a_rate_that_the_watchdog_cannot_wait_for_is_refused(monkeypatch):
    hardware, board = stand_in(monkeypatch)
    with pytest.raises(ftlm.ModelError, match=r"watchdog = 0.1 s is shorter than two samples at 5 Hz"):
        rig.record(board, arm=True, duration=2.0, rate=5.0)
    assert not hardware.in_use
    assert all(volts == (0.0, 0.0) for _, volts in hardware.writes)


def test_a_package_that_lacks_what_it_needs_is_not_called_missing(monkeypatch):
    def lacks(name):
        raise ModuleNotFoundError("No module named 'cffi'", name="cffi")

    monkeypatch.setattr("ftlm.rig.quanser.import_module", lacks)
    with pytest.raises(ftlm.RigFault, match="cffi, which it needs, is not; run: pip install cffi"):
        rig.record("q8", arm=True)
