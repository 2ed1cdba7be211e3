"""What a motor may be trusted to: every way out, the watchdog, the limits and every fault, on both rigs."""

import contextlib
import gc
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import ftlm
from ftlm import rig
from ftlm.cli.main import app
from ftlm.rig import quanser, recording, virtual_board, watchdog
from ftlm.rig.quanser import QuanserBoard
from ftlm.rig.rig import shut_down
from quanser_stand_in import Board

HERE = Path(__file__).parent
WILD = rig.Limits(deflection=(9.0, 9.0), fastest=1e6, max_missed_deadlines=10**6)
LOOSE = rig.ArmParameters(**{**rig.ArmParameters.of("effective").__dict__, "travel": (1e6, 1e6)})


class Watched(rig.VirtualBoard):
    """A virtual board that logs its writes and can do something at one of them."""

    def __init__(self, **options):
        super().__init__(**options)
        self.log, self.hook = [], None

    def _output_volts(self, volts1, volts2):
        # The first write sets up; from then on there is one a sample.
        at = len(self.log) - 1
        if self.hook is not None:
            self.hook(self, at)
        found = super()._output_volts(volts1, volts2)
        self.log.append((at, (volts1, volts2)))
        return found

    def write(self, volts):
        if volts == (0.0, 0.0) and self._page is not None and (self._page.has_expired or self.gate.reason):
            self.log.append((len(self.log) - 1, volts))
        super().write(volts)


class Bench:
    """One rig under test: its board, and what it did."""

    def __init__(self, kind, tmp_path, monkeypatch, parameters="linear", rate=500.0):
        self.kind, self.rate, self.acted = kind, rate, False
        self.parameters = rig.ArmParameters.of(parameters)
        if kind == "virtual":
            self.page = tmp_path / "page"
            self.board = Watched(parameters=self.parameters, page=self.page)
        else:
            self.hardware = Board(self.parameters)
            self.hardware.install(monkeypatch)
            self.board = QuanserBoard(clock=lambda: self.hardware.time, sleep=self.hardware.sleep)

    def rig(self, **options):
        return rig.Rig(self.board, rate=self.rate, **options)

    def at(self, sample, act):
        """Does something at a sample, counted from the end of the rest."""
        sample += 100 if self.kind == "virtual" else 101

        def hook(board, at=None):
            if (board.sample if at is None else at) == sample and not self.acted:
                self.acted = True
                act()

        if self.kind == "virtual":
            self.board.hook = hook
        else:
            self.hardware.hooks["watchdog_reload"] = hook

    def inject(self, what, sample, channel=0, number=0.0):
        seconds = sample / self.rate
        if self.kind == "virtual":
            self.board.inject = (*self.board.inject, (what, channel, seconds, number))
            return
        first = sample + 100

        def reading(board, analog, counts, digital):
            if board.sample <= first:
                self.frozen = counts[channel % 2].copy()
                return 1
            if what == "dead encoder":
                counts[channel] = self.frozen
            elif what == "saturated gauge":
                analog[channel] = 10.0 - 20.0 / 2**16
            elif what == "limit switch":
                digital[channel] = 0
            elif what == "deflection":
                analog[channel] -= number / (0.013636, 0.018694)[channel]
            elif what == "late" and board.sample == first + 1:
                board.time += number
            elif what == "lost samples":
                return 0
            return 1

        self.hardware.hooks["reading"] = reading

    def trip_at_rest(self, line):
        """Trips a limit switch before a run begins."""
        if self.kind == "q8":
            self.inject("limit switch", -100, line)
            return
        start = self.board.start

        def started(rate):
            start(rate)
            self.board._arm.inject("limit switch", line, 0, 0.0)

        self.board.start = started

    @property
    def writes(self):
        return self.board.log if self.kind == "virtual" else self.hardware.writes

    @property
    def samples(self):
        return self.board._arm.sample if self.kind == "virtual" else self.hardware.sample

    @property
    def enabled(self):
        if self.kind == "virtual":
            page = watchdog.RegisterPage(self.page)
            found = bool(page.get("enabled"))
            page.close()
            return found
        return self.hardware.enabled

    def assert_safe(self, within=None):
        """0 V was written last, the amplifiers are off, task, watchdog and board are let go."""
        at, volts = self.writes[-1] if self.kind == "virtual" else (self.hardware.sample, self.hardware.volts)
        assert volts == (0.0, 0.0)
        assert not self.enabled
        if within is not None:
            driven = [at for at, volts in self.writes if volts != (0.0, 0.0)]
            assert at - driven[-1] <= 2
            assert self.samples <= within
        if self.kind == "virtual":
            assert self.board._process is None
            assert self.board._page is None
            assert not self.board._started
        else:
            assert self.hardware.violations == []
            assert not self.hardware.in_use
            ends = [what for what, _, _ in self.hardware.log[-6:]]
            if "expired" in ends:
                # What the watchdog has put out stays: clearing it would bring back what was there before.
                assert ends[-4:] == ["expired", "task_stop", "task_delete", "close"]
            else:
                assert ends == ["write_analog", "write_digital", "task_stop", "task_delete", "watchdog_stop", "close"]


@pytest.fixture(params=["virtual", "q8"])
def bench(request, tmp_path, monkeypatch):
    return Bench(request.param, tmp_path, monkeypatch)


def drive(samples=400, current=0.3):
    return np.full((samples, 2), current)


def recorded(bench, tmp_path, **options):
    """A record on the bench's board that is expected to fail, and what was kept of it."""
    path = tmp_path / "run.csv"
    with pytest.raises(ftlm.RigFault) as fault:
        rig.record(bench.board, arm=True, rate=bench.rate, out=path, **{"duration": 2.0, **options})
    loaded = ftlm.load(path)
    assert np.array_equal(loaded["theta11"], fault.value.run["theta11"])
    assert loaded.metadata["faults"]
    assert any("the rig stopped the run" in w for w in loaded.notes)
    assert str(path) in str(fault.value)
    assert sorted(p.name for p in tmp_path.iterdir() if p.name != "page") == ["run.csv"]
    bench.assert_safe()
    return str(fault.value), loaded


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
    shut_down(bench.board)


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


@pytest.mark.parametrize("stop", ["open", "configure", "set_expiration", "start_watchdog", "start", "rest", "enable"])
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
    board = rig.VirtualBoard(page={page!r}, real_time=True)
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


@pytest.mark.parametrize("kind", ["virtual", "q8"])
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


@pytest.mark.parametrize("kind", ["virtual", "q8"])
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


@pytest.mark.parametrize(("kind", "count"), [("virtual", 100_000), ("q8", 20_000)])
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
    board = rig.VirtualBoard(page=None)
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
    monkeypatch.setattr(virtual_board.wait_for_watchdog, "__kwdefaults__", {"patience": 0.5})
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
