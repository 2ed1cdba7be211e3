"""Faults of the rig, of its board and of a recording: 0 V, the cause in words, and what was recorded is kept."""

import contextlib
import os
import resource
import signal
import subprocess
import sys

import numpy as np
import pytest

import ftlm
from ftlm import rig
from ftlm.cli.main import app
from ftlm.rig import quanser, recording, virtual_board, watchdog
from ftlm.rig.quanser import QuanserBoard
from quanser_stand_in import Board
from rig_bench import Bench, drive, recorded


@pytest.fixture(params=["virtual", "q8"])
def bench(request, tmp_path, monkeypatch):
    return Bench(request.param, tmp_path, monkeypatch)


# ----------------------------------------------------------------------------------------------------------------------
# Faults, latched, with the cause in words, and what was recorded kept


@pytest.mark.parametrize(
    ("what", "channel", "number", "words", "rows"),
    [
        ("dead encoder", 0, 0.0, "encoder 1 has not changed for 0.50 s under 0.25 A or more", 551),
        ("dead encoder", 1, 0.0, "encoder 2 has not changed", 551),
        ("saturated gauge", 0, 0.0, "strain gauge 1 is saturated at 10.00 V", 301),
        ("saturated gauge", 1, 0.0, "strain gauge 2 is saturated", 301),
        ("limit switch", 2, 0.0, "limit switch 2 is tripped", 301),
        ("deflection", 0, 0.1, "more than the limit of 5.00", 301),
        ("deflection", 1, 0.15, "more than the limit of 7.50", 301),
        ("late", 0, 0.06, "a command was 60.0 ms late, more than the limit of 50 ms", 301),
        ("lost samples", 0, 0.0, "samples were lost", 300),
    ],
)
def test_faults_stop_the_motors_and_keep_the_record(bench, tmp_path, what, channel, number, words, rows):
    bench.inject(what, 300, channel, number)
    said, run = recorded(bench, tmp_path)
    assert words in said
    assert abs(run.length - rows) <= 3
    assert words in run.metadata["faults"][0]
    driven = [at for at, volts in bench.writes if volts != (0.0, 0.0)]
    assert driven[-1] - 100 <= run.length


def test_missed_deadlines_in_a_row_are_a_fault(tmp_path, monkeypatch):
    bench = Bench("q8", tmp_path, monkeypatch)

    def slow(board, *_):
        if board.sample > 200:
            board.time = board.sample / board.rate + 0.003
        return 1

    bench.hardware.hooks["reading"] = slow
    words, run = recorded(bench, tmp_path)
    assert "21 deadlines in a row were missed" in words
    assert run.metadata["missed_deadlines"] == 21


def test_missed_deadlines_in_a_row_are_a_fault_on_the_virtual_rig(tmp_path, monkeypatch):
    bench = Bench("virtual", tmp_path, monkeypatch)
    for sample in range(300, 330):
        bench.inject("late", sample, number=0.003)
    words, run = recorded(bench, tmp_path)
    assert "21 deadlines in a row were missed" in words
    assert run.metadata["missed_deadlines"] == 21


def test_single_missed_deadlines_are_counted_and_borne(bench, tmp_path):
    bench.inject("late", 100, number=0.003)
    run = rig.record(bench.board, arm=True, duration=1.0, out=tmp_path / "run.csv")
    assert run.metadata["missed_deadlines"] >= 1
    assert run.metadata["faults"] == []
    bench.assert_safe()


def test_a_counter_that_wraps_is_a_fault(tmp_path, monkeypatch):
    bench = Bench("q8", tmp_path, monkeypatch)

    def wrapped(board, analog, counts, digital):
        if board.sample > 300:
            counts[0] -= 1 << 24
        return 1

    bench.hardware.hooks["reading"] = wrapped
    words, _ = recorded(bench, tmp_path)
    assert "encoder 1 jumped by -1677" in words


def test_a_switch_that_is_tripped_already_stops_the_start(bench, tmp_path):
    bench.trip_at_rest(3)
    with pytest.raises(ftlm.RigFault, match="limit switch 3 is tripped") as fault:
        rig.record(bench.board, arm=True, duration=1.0, out=tmp_path / "run.csv")
    assert "nothing was recorded" in str(fault.value)
    assert fault.value.run is None
    assert all(volts == (0.0, 0.0) for _, volts in bench.writes)
    assert not (tmp_path / "run.csv").exists()
    bench.assert_safe()


def test_a_full_disk_stops_the_motors_and_keeps_what_was_written(bench, tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, hard))
    try:
        with pytest.raises(ftlm.RigFault, match="cannot be written") as fault:
            rig.record(bench.board, arm=True, duration=4.0, out=tmp_path / "run.csv")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)
    bench.assert_safe()
    assert fault.value.run.length >= 300
    assert "run.csv.partial" in str(fault.value)
    assert not (tmp_path / "run.csv").exists()
    if bench.kind == "q8":
        kept = ftlm.load(tmp_path / "run.csv.partial")
        assert 3 <= kept.length <= fault.value.run.length
        assert np.array_equal(kept["theta11"], fault.value.run["theta11"][: kept.length])


# ----------------------------------------------------------------------------------------------------------------------
# The board


@pytest.fixture
def hardware(monkeypatch):
    board = Board("linear")
    board.install(monkeypatch)
    return board


def test_real_hardware_needs_to_be_armed(hardware):
    with pytest.raises(ftlm.ModelError, match="arm=True"):
        rig.record("q8", duration=1.0)
    assert hardware.log == []


def test_a_run_on_the_board_is_that_of_the_simulated_arm(hardware, tmp_path):
    board = QuanserBoard(clock=lambda: hardware.time)
    run = rig.record(board, arm=True, duration=2.0, out=tmp_path / "run.csv")
    same = rig.record("virtual", parameters="linear", duration=2.0)
    assert hardware.violations == []
    assert run.metadata["rig"] == "Q8-USB"
    assert np.array_equal(run["I1"], same["I1"])
    for name in ("theta11", "theta21"):
        assert np.abs(run[name] - same[name]).max() <= 1e-4
    for name in ("theta12", "theta22"):
        assert np.abs(run[name] - same[name]).max() <= 1e-9


@pytest.mark.parametrize(
    ("call", "code", "words"),
    [
        ("open", -108, "no Q8-USB board was found"),
        ("open", -109, "in use by another program"),
        ("open", -179, "does not know the Q8-USB"),
        ("open", -986, "driver was not found"),
        ("open", -1073, "open already"),
        ("task_read", -1160, "was disconnected"),
        ("task_read", -111, "the buffer overflowed"),
        ("task_read", -1270, "samples were lost"),
        ("task_start", -9999, "error -9999"),
    ],
)
def test_every_error_of_the_board_has_its_words(hardware, call, code, words, capsys, tmp_path):
    hardware.refuse[call] = code
    command = ["record", "--rig", "q8", "--arm", "--duration", "1", "-o", str(tmp_path / "never.csv")]
    with pytest.raises(SystemExit) as ended:
        app(command, standalone_mode=True)
    assert ended.value.code == 5
    assert words in capsys.readouterr().err
    assert hardware.violations == []
    assert list(tmp_path.iterdir()) == []
    assert all(volts == (0.0, 0.0) for _, volts in hardware.writes)


def test_a_board_that_goes_away_in_a_run_is_a_fault(tmp_path, monkeypatch):
    bench = Bench("q8", tmp_path, monkeypatch)

    def gone(board):
        if board.sample == 300:
            board.refuse["task_read"] = -1160

    bench.hardware.hooks["task_read"] = gone
    with pytest.raises(ftlm.RigFault, match="was disconnected") as fault:
        rig.record(bench.board, arm=True, duration=2.0, out=tmp_path / "run.csv")
    assert ftlm.load(tmp_path / "run.csv").length == fault.value.run.length == 200
    bench.assert_safe()


@pytest.mark.parametrize("code", [-111, -1270])
def test_an_error_in_a_run_writes_zero_at_once(tmp_path, monkeypatch, code):
    bench = Bench("q8", tmp_path, monkeypatch)

    def lost(board):
        if board.sample == 300:
            board.refuse["task_read"] = code

    bench.hardware.hooks["task_read"] = lost
    with bench.rig() as link:
        with pytest.raises(ftlm.RigFault, match="samples were lost"):
            link.run(drive())
        # Still inside the with statement, and already safe.
        assert bench.writes[-1] == (300, (0.0, 0.0))
        assert bench.writes[-2][1] != (0.0, 0.0)
    bench.assert_safe()


def test_without_package_or_library_the_words_say_which(monkeypatch, capsys):
    for name in ("quanser", "quanser.hardware"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ftlm.RigFault, match=r"package .* is not installed"):
        rig.record("q8", arm=True)
    assert "not on PyPI" in quanser.driver_state()

    def broken(name):
        raise OSError("libhil.so: cannot open shared object file")

    monkeypatch.setattr(quanser, "import_module", broken)
    with pytest.raises(ftlm.RigFault, match=r"library \(hil\) cannot be loaded"):
        rig.record("q8", arm=True)
    assert "library (hil)" in quanser.driver_state()


@pytest.mark.parametrize("form", [2022, 2025])
def test_doctor_says_what_is_there(monkeypatch, form):
    board = Board("linear", form=form)
    board.install(monkeypatch)
    assert quanser.driver_state() == "driver found, board found" + (" (Q8-USB)" if form == 2025 else "")
    board.in_use = True
    assert "in use by another program" in quanser.driver_state()
    board.in_use = False
    board.refuse["open"] = -108
    assert "no Q8-USB board was found" in quanser.driver_state()
    assert board.violations == []


def test_the_stand_in_sees_lists_wrong_types_and_unknown_calls(hardware):
    hil = hardware.modules()["quanser.hardware"].HIL("q8_usb", "0")
    hil.write_analog([0, 1], 2, np.zeros(2))
    hil.write_analog(np.arange(2, dtype=np.int64), 2, np.zeros(2))
    hil.write_analog(np.arange(2, dtype=np.uint32), 3, np.zeros(2, dtype=np.float32))
    assert len(hardware.violations) >= 4
    with pytest.raises(AttributeError):
        hil.read_analog(np.arange(2, dtype=np.uint32), 2, np.zeros(2))


# ----------------------------------------------------------------------------------------------------------------------
# Starts and ends of a recording


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (("dead encoder", 9, 1.0, 0.0), "'dead encoder' on channel 9; the fault has the channels 0 to 1"),
        (("saturated gauge", 2, 1.0, 0.0), "on channel 2; the fault has the channels 0 to 1"),
        (("limit switch", 4, 1.0, 0.0), "on channel 4; the fault has the channels 0 to 3"),
        (("lost samples", 1, 1.0, 0.0), "on channel 1; the fault has the channel 0 only"),
        (("dead encoder", -1, 1.0, 0.0), "on channel -1"),
        (("dead encoder", 0.5, 1.0, 0.0), "on channel 0.5"),
        (("dead encoder", 0, float("nan"), 0.0), "at nan s; give a time of the run"),
        (("dead encoder", 0, -1.0, 0.0), "at -1.0 s; give a time of the run"),
        (("dead encoder", 0, float("inf"), 0.0), "at inf s"),
        (("deflection", 0, 1.0, float("nan")), r"with the number nan; give more bend \[rad\]"),
        (("late", 0, 1.0, -1.0), "with the number -1.0; give delay"),
        (("dead encodr", 0, 1.0, 0.0), "'dead encodr' is not known; use 'dead encoder' or"),
        (("dead encoder", 0), "; give .name, channel, time"),
        (3, "; give .name, channel, time"),
    ],
)
def test_a_fault_that_could_not_be_the_one_that_was_named_is_refused(fault, words):
    with pytest.raises(ftlm.ModelError, match=words):
        rig.VirtualBoard(inject=(fault,))
    board = rig.VirtualBoard(register_file=None)
    board.inject = (fault,)
    with pytest.raises(ftlm.ModelError, match=words):
        rig.record(board, duration=0.1)


def test_a_first_write_that_fails_leaves_nothing_in_the_way(bench, tmp_path, monkeypatch):
    def full(descriptor, content):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(recording.os, "write", full)
        with pytest.raises(ftlm.DataError, match="No space left"):
            rig.record(bench.board, arm=True, duration=0.1, out=tmp_path / "run.csv")
    assert [p.name for p in tmp_path.iterdir() if p.name != "page"] == []
    assert rig.record(bench.board, arm=True, duration=0.1, out=tmp_path / "run.csv").length == 51


def test_ctrl_c_at_any_line_of_the_start_leaves_nothing_behind(tmp_path, request):
    """Whenever it comes: one KeyboardInterrupt, handlers as before, no file, no process."""
    kept = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, kept))
    before = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
    lines, stop = 0, 0

    def local(frame, event, argument):
        nonlocal lines
        lines += event == "line"
        if event == "line" and lines == stop:
            signal.raise_signal(signal.SIGINT)
        return local

    def tracer(frame, event, argument):
        return local if f"ftlm{os.sep}rig" in frame.f_code.co_filename else None

    def record():
        nonlocal lines
        lines, traced = 0, sys.gettrace()
        sys.settrace(tracer)
        try:
            rig.record(duration=0.004, parameters="linear", out=tmp_path / "run.csv", force=True)
        finally:
            sys.settrace(traced)

    record()
    count = lines
    assert count > 300
    for stop in range(1, count, count // 25):
        (tmp_path / "run.csv").unlink(missing_ok=True)
        with contextlib.suppress(KeyboardInterrupt):
            record()
            assert ftlm.load(tmp_path / "run.csv").length == 3
        assert not (tmp_path / "run.csv.partial").exists(), stop
        assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)] == before, stop


@pytest.mark.parametrize("script", ["import time; time.sleep(60)", "raise ValueError('no clock')"])
def test_a_watchdog_that_does_not_start_is_said_in_words(script, tmp_path, monkeypatch, capfd):
    fake = tmp_path / "watchdog.py"
    fake.write_text(script, encoding="utf-8")
    monkeypatch.setattr(watchdog, "__file__", str(fake))
    monkeypatch.setattr(virtual_board, "_WATCHDOG_START_TIMEOUT_S", 0.5)
    with pytest.raises(SystemExit) as ended:
        app(["record", "--duration", "1", "-o", str(tmp_path / "run.csv")], standalone_mode=True)
    assert ended.value.code == 5
    said = capfd.readouterr().err
    assert "the watchdog process" in said
    assert "check the Python installation" in said
    assert "Traceback" not in said
    assert [p.name for p in tmp_path.iterdir()] == ["watchdog.py"]


SIGNALLED = """
import os, sys
from ftlm import cli, rig
from ftlm.data.run import Run
from ftlm.rig import recording

first, second = {first}, {second}
flush, to_csv, describe = recording._Recorder.flush, Run.to_csv, recording.describe_interruption


def flushed(self):
    if self.row_count >= 32:
        os.kill(os.getpid(), first)
    flush(self)


def written(self, *given, **named):
    os.kill(os.getpid(), second)
    to_csv(self, *given, **named)
    os.kill(os.getpid(), second)


def described(ended):
    os.kill(os.getpid(), second)
    return describe(ended)


recording._Recorder.flush, Run.to_csv, recording.describe_interruption = flushed, written, described
recording.Limits = lambda: rig.Limits(max_write_delay=60.0, max_missed_deadlines=10**9)
rig.rig.WATCHDOG_RANGE_S = 0.01, 60.0
sys.argv = ["ftlm", "record", "--real-time", "--duration", "25", "--watchdog", "60", "-o", {out!r}]
cli.main()
"""


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (signal.SIGTERM, signal.SIGTERM),
        (signal.SIGHUP, signal.SIGHUP),
        (signal.SIGTERM, signal.SIGINT),
        (signal.SIGINT, signal.SIGTERM),
    ],
)
def test_further_signals_while_a_run_is_saved_do_not_lose_it(first, second, tmp_path):
    out = tmp_path / "run.csv"
    script = SIGNALLED.format(first=int(first), second=int(second), out=str(out))
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 128 + first, done.stderr
    assert "Traceback" not in done.stderr
    assert "rows were recorded until then and are in" in done.stderr
    run = ftlm.load(out)
    assert run.length >= 32
    assert [p.name for p in tmp_path.iterdir()] == ["run.csv"]


def test_a_signal_while_a_finished_run_is_saved_comes_after_it(tmp_path, monkeypatch):
    real = recording.save_run

    def save(*given, **named):
        os.kill(os.getpid(), signal.SIGTERM)
        return real(*given, **named)

    monkeypatch.setattr(recording, "save_run", save)
    with pytest.raises(SystemExit) as ended:
        rig.record(duration=0.1, out=tmp_path / "run.csv")
    assert ended.value.code == 128 + signal.SIGTERM
    loaded = ftlm.load(tmp_path / "run.csv")
    assert loaded.length == 51
    assert loaded.metadata["faults"] == []
