"""Rig sessions: board interface, safety limits, start-up, shutdown, fault messages and signal handlers."""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import math
import os
import select
import signal
import threading
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from types import CodeType, FrameType
from typing import Any, Literal, NoReturn, Protocol

from ftlm import _core
from ftlm.errors import DataError, FtlmError, ModelError, RigFault
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import setting
from ftlm.utils.validation import Floats, as_floats, error_text, real_number

#: Termination signals, including those of a closed terminal.
_TERMINATION_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
#: Interval at which the thread looks for new signal handlers of the program [ms].
_HANDLER_CHECK_INTERVAL_MS = 20.0


class OutputGate:
    """Lock for writes to a board. After the gate is closed, no thread can write anything but 0 V.

    :class:`Rig` assigns a gate to its board for each session. A user-defined board must acquire `lock` for every write.
    Before it writes a voltage other than 0 V or enables the amplifiers, it must call :meth:`check`.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        #: Reason why the gate was closed; None while it is open.
        self.reason: str | None = None
        #: Whether a thread is executing :meth:`Board.run`.
        self.running = False

    def close(self, reason: str) -> None:
        """Close the gate permanently for a reason; further calls do not change the reason."""
        with self.lock:
            self.reason = self.reason or reason

    def check(self) -> None:
        """Raise RigFault with the reason if the gate is closed, so that the caller sends no command to the motors."""
        if self.reason is not None:
            raise RigFault(self.reason)


class InterruptWatch:
    """Thread that stops the motors on a termination signal if the rig runs in a thread other than the main one.

    Python calls signal handlers only in the main thread, which may be waiting for the run. The C-level handler of
    :mod:`faulthandler` writes to a pipe immediately, and then passes the signal to Python. The thread reads the pipe.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._boards: list[Board] = []
        #: Read end and write end of the pipe of each signal, and address of the installed handler of faulthandler.
        self._pipes: dict[int, tuple[int, int]] = {}
        self._handlers: dict[int, bytes] = {}

    @property
    def available(self) -> bool:
        """Whether this platform can report signals to the thread; false on Windows."""
        return hasattr(faulthandler, "register")

    def add(self, board: Board) -> None:
        """Register a board, so that the next termination signal with a Python handler stops its motors.

        A termination signal without a Python handler ends the program.
        """
        with self._lock:
            self._boards.append(board)
            if self._pipes or not self.available:
                return
            for name in _TERMINATION_SIGNALS:
                if hasattr(signal, name):
                    pipe_ends = os.pipe()
                    os.set_blocking(pipe_ends[1], False)
                    self._pipes[getattr(signal, name)] = pipe_ends
            self._register()
            threading.Thread(target=self._watch, name="ftlm signals", daemon=True).start()

    def remove(self, board: Board) -> None:
        """Unregister a board, whose motors a signal then no longer stops."""
        with self._lock, contextlib.suppress(ValueError):
            self._boards.remove(board)

    def reset(self) -> None:
        """Unregister all boards and handlers in a forked child process, which does not have the thread."""
        self._lock = threading.Lock()
        self._boards = []
        self._stop()

    def _stop(self) -> None:
        for number, pipe_ends in self._pipes.items():
            # If the current handler is not a Python function, the handler of faulthandler is already replaced.
            if number in self._handlers and callable(signal.getsignal(number)):
                faulthandler.unregister(number)
            for descriptor in pipe_ends:
                os.close(descriptor)
        self._handlers, self._pipes = {}, {}

    def _register(self) -> None:
        """Register faulthandler again for each signal whose handler the program has set since the last call.

        Setting a Python handler replaces the handler of faulthandler.
        """
        for number, (_, write_end) in self._pipes.items():
            if callable(signal.getsignal(number)) and _system_handler(number) != self._handlers.get(number):
                faulthandler.unregister(number)
                faulthandler.register(number, write_end, all_threads=False, chain=True)
                self._handlers[number] = _system_handler(number)

    def _watch(self) -> None:
        signal_numbers = {pipe_ends[0]: number for number, pipe_ends in self._pipes.items()}
        poll = select.poll()
        for descriptor in signal_numbers:
            poll.register(descriptor, select.POLLIN)
        while True:
            ready_descriptors = poll.poll(_HANDLER_CHECK_INTERVAL_MS)
            with self._lock:
                self._register()
                boards = list(self._boards)
                if not boards:
                    self._stop()
                    return
            for descriptor, _ in ready_descriptors:
                os.read(descriptor, 1 << 16)
                for board in boards:
                    _stop_motors(board, describe_signal(signal_numbers[descriptor]))


def _system_handler(number: int) -> bytes:
    """Return the bytes of the address of the C function that handles a signal: the first member of struct sigaction."""
    action = ctypes.create_string_buffer(1024)
    ctypes.CDLL(None).sigaction(number, None, action)
    return action.raw[: ctypes.sizeof(ctypes.c_void_p)]


INTERRUPT_WATCH = InterruptWatch()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=INTERRUPT_WATCH.reset)


def check_thread(board: Board) -> None:
    """Raise ModelError if a hardware board would run in a thread in which Ctrl-C cannot stop its motors."""
    in_main_thread = threading.current_thread() is threading.main_thread()
    if board.hardware and not in_main_thread and not INTERRUPT_WATCH.available:
        raise ModelError(
            f"the {board.name} would run in the thread {threading.current_thread().name!r}, where Ctrl-C cannot stop "
            "its motors on this system; run it in the main thread"
        )


def describe_signal(number: int) -> str:
    """Return the text "stopped by …" with the name of a signal; an unknown number means an exit of the program."""
    if number == signal.SIGINT:
        return "stopped by Ctrl-C"
    names = {int(s): s.name for s in signal.Signals}
    return f"stopped by {names.get(number, 'an exit of the program')}"


def _stop_motors(board: Board, reason: str) -> None:
    """Close the output gate of a board for a reason, write 0 V and disable the amplifiers; errors are ignored."""
    board.gate.close(reason)
    with contextlib.suppress(Exception):
        board.write((0.0, 0.0))
    with contextlib.suppress(Exception):
        board.enable(False)


class SignalHandlers:
    """Handlers of termination signals that are active from start-up to shutdown of a rig.

    If the rig runs in the main thread, a signal closes the output gate of the board and raises an exception. Nothing
    but 0 V can then be written. If the rig runs in another thread, `INTERRUPT_WATCH` stops the motors. The object has
    no reference to the rig, because installed handlers would otherwise prevent its garbage collection.

    Parameters
    ----------
    uninterruptible
        Code objects of functions that no signal may interrupt. A signal during such a function is deferred.
    board
        Board whose motors a signal stops, or None.
    """

    def __init__(self, uninterruptible: frozenset[CodeType] = frozenset(), board: Board | None = None) -> None:
        self.uninterruptible = uninterruptible
        self._board = board
        self._previous_handlers: dict[int, Any] = {}
        self._pending_signal: int | None = None
        self._watched = self._is_persistent = self._deferring = False

    def install(self) -> None:
        """Replace the current signal handlers; if the program ignores Ctrl-C (SIGINT), it remains ignored."""
        if self._previous_handlers or self._watched:
            return
        if threading.current_thread() is not threading.main_thread():
            if self._board is not None:
                self._watched = True
                INTERRUPT_WATCH.add(self._board)
            return
        for name in _TERMINATION_SIGNALS:
            number = getattr(signal, name, None)
            if number is None or (name == "SIGINT" and signal.getsignal(number) in (signal.SIG_IGN, None)):
                continue
            # Store the old handler first, so that a signal between the two statements can be handled.
            self._previous_handlers[number] = signal.getsignal(number)
            signal.signal(number, self._handle)

    def keep(self) -> None:
        """Install the handlers until :meth:`release` is called.

        Signals that arrive after the first one, or after shutdown of the rig, are deferred.
        """
        self._is_persistent = True
        self.install()

    def restore(self) -> None:
        """Restore all previous handlers.

        After :meth:`keep`, leave the handlers installed instead, and defer signals until :meth:`release`.
        """
        if self._is_persistent:
            self._deferring = True
        else:
            self._restore()

    def release(self) -> None:
        """Restore all previous handlers; :meth:`deliver` can then raise the exception of a deferred signal."""
        self._is_persistent, self._deferring = False, True
        self._restore()
        self._deferring = False

    def ignore(self) -> None:
        """Ignore further termination signals, because the process is about to exit."""
        for number in self._previous_handlers:
            signal.signal(number, signal.SIG_IGN)
        self._previous_handlers = {}

    def deliver(self) -> None:
        """Raise the exception of a deferred signal, if any; do nothing while signals are being deferred."""
        if self._deferring:
            return
        number, self._pending_signal = self._pending_signal, None
        if number is not None and (number == signal.SIGINT or self._previous_handlers):
            signal.raise_signal(number)
        elif number is not None:
            _end(number)

    def _restore(self) -> None:
        """Restore all previous handlers, while the signals are blocked if the system supports blocking."""
        if self._board is not None and self._watched:
            self._watched = False
            INTERRUPT_WATCH.remove(self._board)
        if not self._previous_handlers or threading.current_thread() is not threading.main_thread():
            return
        mask = getattr(signal, "pthread_sigmask", None)
        mask_before = None if mask is None else mask(signal.SIG_BLOCK, self._previous_handlers)
        try:
            for number, handler in self._previous_handlers.items():
                signal.signal(number, handler)
            self._previous_handlers = {}
        finally:
            if mask is not None:
                mask(signal.SIG_SETMASK, mask_before)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        at = frame
        while at is not None and at.f_code not in self.uninterruptible:
            at = at.f_back
        if self._deferring or at is not None:
            self._pending_signal = number
            return
        handler = self._previous_handlers.get(number)
        try:
            if number == signal.SIGINT and callable(handler):
                handler(number, frame)
            else:
                _end(number)
        except BaseException:
            self._deferring = self._is_persistent
            if self._board is not None:
                self._board.gate.close(describe_signal(number))
            raise


def _end(number: int) -> None:
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise SystemExit(128 + number)


#: Deflection per volt of strain-gauge voltage above its bias [rad/V], for links 1 and 2; the sign is reversed.
STRAIN_SCALE = (0.013636, 0.018694)
#: Motor current per volt at the current-sense input [A/V]; the sign is reversed.
SENSE_SCALE = 2.0
#: Motor current per volt at the command output [A/V]; the sign is reversed.
COMMAND_SCALE = 0.5
#: Hub angle per encoder count [rad], for joints 1 and 2: 1024 lines with fourfold evaluation, gears of 100:1 and 50:1.
ENCODER_SCALE = (2.0 * math.pi / 4096.0 / 100.0, 2.0 * math.pi / 4096.0 / 50.0)
#: Maximum motor currents for which the amplifiers are configured [A], for joints 1 and 2.
CURRENT_LIMIT = (0.94, 1.2)
#: Time at 0 V before every run, over which the bias of the strain gauges is averaged [s].
REST_DURATION_S = 0.2
#: Maximum permitted duration of a run [s].
MAX_RUN_DURATION_S = 600.0
#: Range of permitted watchdog timeouts [s]. 0 would disable the watchdog, and with a longer one a motor would run too
#: long after a failure.
WATCHDOG_RANGE_S = (0.01, 1.0)
#: Error message if no step of the shutdown has confirmed that the motors are stopped.
MOTORS_LIVE_MESSAGE = (
    "the motors may still be under current: neither 0 V nor switched-off amplifiers nor the watchdog's expiry could be "
    "confirmed; cut the arm's power by hand (emergency stop). The watchdog was left running and the board open"
)
#: Columns of a recorded row: commanded currents [A], angles [rad], measured currents [A].
RIG_COLUMNS = ("I1", "I2", "theta11", "theta12", "theta21", "theta22", "I1_measured", "I2_measured")


@check_arguments
@dataclass(frozen=True)
class Limits:
    """Safety limits for every command and sample of a rig; pairs are for joints 1 and 2.

    Parameters
    ----------
    current
        Maximum magnitude of a motor current command [A].
    slew
        Maximum rate of change of a command [A/s]. With the default, a full reversal takes two samples of 2 ms.
    continuous
        Maximum RMS current of a motor, averaged over `thermal_time` [A].
    thermal_time
        Thermal time constant of the motors [s].
    deflection
        Maximum magnitude of a link deflection [rad].
    saturation
        Magnitude of a strain-gauge voltage [V] at and above which the gauge counts as saturated.
    moving_current
        Current above which a hub must move [A]. At a smaller current it may stick.
    standstill
        Maximum duration [s] for which a hub may stand still while its current exceeds `moving_current`. The same limit
        applies to a strain gauge whose voltage does not change after the current has changed by `moving_current`.
    fastest
        Maximum plausible hub speed [rad/s]. A faster change of the encoder count is an encoder fault.
    max_write_delay
        Maximum permitted delay of a command after its deadline [s].
    max_missed_deadlines
        Maximum permitted number of consecutive missed deadlines.
    """

    current: tuple[float, float] = CURRENT_LIMIT
    slew: tuple[float, float] = (500.0, 500.0)
    continuous: tuple[float, float] = (0.7 * CURRENT_LIMIT[0], 0.7 * CURRENT_LIMIT[1])
    thermal_time: float = 10.0
    deflection: tuple[float, float] = (math.radians(5.0), math.radians(7.5))
    saturation: float = 9.99
    moving_current: float = 0.25
    standstill: float = 0.5
    fastest: float = 20.0
    max_write_delay: float = 0.05
    max_missed_deadlines: int = 20

    def guard(self, step: float, sensor_filter: tuple[float, float] | None = None) -> _core.Guard:
        """Return the core object that enforces the limits at a sampling interval `step` [s].

        `sensor_filter` is (natural frequency [rad/s], damping ratio) of a low-pass on both deflections, or None.
        """
        return _core.Guard(
            {
                **vars(self),
                "step": step,
                "strain_scale": STRAIN_SCALE,
                "sense_scale": SENSE_SCALE,
                "command_scale": COMMAND_SCALE,
                "encoder_scale": ENCODER_SCALE,
                "current_limit": self.current,
                "deflection_limit": self.deflection,
                "late_limit": self.max_write_delay,
                "missed_limit": self.max_missed_deadlines,
                "filter": sensor_filter,
            }
        )


class Board(Protocol):
    """Protocol of the interface board of a rig.

    :class:`Rig` calls the methods in the sequence in which they are defined.
    """

    name: str
    hardware: bool
    #: Gate of the session, assigned by :class:`Rig`.
    gate: OutputGate

    def open(self) -> None:
        """Open the connection to the board."""

    def configure(self, rate: float) -> None:
        """Configure channel ranges, directions and encoders, set outputs to zero, and create the sampling task.

        `rate` is the sampling rate [Hz].
        """

    def set_expiration(self) -> None:
        """Set the outputs that the board applies when its watchdog expires: 0 V, and disabled amplifiers."""

    def watchdog_problem(self) -> str | None:
        """Return an error message if an expired watchdog would not stop the motors; None if it would."""

    def start_watchdog(self, seconds: float) -> None:
        """Start the watchdog with a timeout of `seconds`."""

    def start(self, rate: float) -> None:
        """Start sampling at a rate [Hz]."""

    def enable(self, on: bool) -> None:
        """Enable (`on`) or disable the amplifiers of both motors."""

    def write(self, volts: tuple[float, float]) -> None:
        """Write the command voltages of both motors [V]."""

    def read_rest(self, guard: _core.Guard, samples: int) -> None:
        """Read a number of samples with outputs at 0 V, over which `guard` averages the bias of the strain gauges."""

    def run(self, guard: _core.Guard, commands: Floats) -> None:
        """Apply commands of the motor currents [A], shape (n, 2), and record one sample per command.

        The method returns early if `guard`, which enforces the safety limits, latches a fault.
        """

    def take(self) -> Floats:
        """Return the samples since the last call, shape (n, 9): RIG_COLUMNS, then the delay of the sample [s]."""

    def stop(self) -> None:
        """Stop sampling."""

    def let_expire(self) -> bool:
        """Wait until the watchdog expires and its outputs of 0 V are set; return whether this is confirmed."""

    def stop_watchdog(self) -> None:
        """Stop the watchdog."""

    def close(self) -> None:
        """Close the connection to the board."""


def shut_down(board: Board) -> list[str]:
    """Run the shutdown sequence of a board, and return the error messages of its steps.

    The output gate is closed first, after which no thread can write anything but 0 V. Each step is tried even if an
    earlier one failed, and is repeated once if it is interrupted, as by a second Ctrl-C. If 0 V cannot be written or
    the amplifiers cannot be disabled, the function waits until the watchdog expires, which does both.

    If none of the three (0 V, disabled amplifiers, expiry) is confirmed, the motors may still carry current. The
    watchdog is then not stopped and the board not closed, so that the watchdog can still act.
    """
    errors: list[str] = []
    _try_step("closing the output gate", lambda: board.gate.close("the rig was shut down"), errors)
    zero = _try_step("writing 0 V", lambda: board.write((0.0, 0.0)), errors)
    off = _try_step("disabling the amplifiers", lambda: board.enable(False), errors)
    _try_step("stopping the task", board.stop, errors)
    # A user-defined board may lack let_expire().
    let_expire = getattr(board, "let_expire", None)
    expired = False
    if not (zero and off) and let_expire is not None:
        results: list[bool] = []
        _try_step("waiting for the watchdog", lambda: results.append(let_expire()), errors)
        expired = any(results)
        if expired:
            errors.append("the watchdog was allowed to expire instead, which sets 0 V")
    if not (zero or off or expired):
        errors.append(MOTORS_LIVE_MESSAGE)
        return errors
    _try_step("stopping the watchdog", board.stop_watchdog, errors)
    _try_step("closing the board", board.close, errors)
    return errors


def _try_step(name: str, step: Callable[[], None], errors: list[str]) -> bool:
    """Run a shutdown step, once more if it is interrupted, and return whether it succeeded.

    If it failed, an error message is appended to `errors`.
    """
    for _ in (1, 2):
        try:
            step()
        except (KeyboardInterrupt, SystemExit) as error:
            reason: BaseException | str = str(error) or "interrupted twice"
        except BaseException as error:
            reason = error
            break
        else:
            return True
    errors.append(f"{name} failed: {reason}")
    return False


def _shut_down_and_restore(board: Board, signals: SignalHandlers) -> list[str]:
    """Shut down a board, restore the signal handlers, and return the error messages of the shutdown.

    The function has no reference to the rig, so that it can be called when the rig is garbage-collected.
    """
    try:
        return shut_down(board)
    finally:
        signals.restore()


class Rig:
    """Session on a rig, from start-up to shutdown; use it in a ``with`` statement.

    The shutdown writes 0 V, disables the amplifiers, stops task and watchdog, and closes the board. It is run whenever
    the ``with`` block is left (end, exception, Ctrl-C, SIGTERM, SIGHUP), and at garbage collection. Each step is tried
    even if an earlier one fails. If the program terminates or freezes, the watchdog writes 0 V.

    Parameters
    ----------
    board
        Virtual board, Q8-USB board, or user-defined board.
    rate
        Sampling rate [Hz].
    watchdog
        Watchdog timeout [s], 0.01 to 1.
    limit
        Maximum total duration of all commands of the session [s]. Longer runs raise RigFault.
    limits
        Safety limits for every command and sample.
    sensor_filter
        (natural frequency [rad/s], damping ratio) of a low-pass filter on both recorded deflections; None for none.
    """

    def __init__(
        self,
        board: Board,
        *,
        rate: float = 500.0,
        watchdog: float = 0.1,
        limit: float = 30.0,
        limits: Limits | None = None,
        sensor_filter: tuple[float, float] | None = None,
    ) -> None:
        low, high = WATCHDOG_RANGE_S
        watchdog = real_number("watchdog", watchdog)
        if not low <= watchdog <= high:
            raise ModelError(
                f"{setting('watchdog')} {watchdog!r} s is outside [{low:g}, {high:g}] s; with 0 the motors would keep "
                "running if the program crashes"
            )
        if not 0 < limit <= MAX_RUN_DURATION_S:
            raise ModelError(
                f"{setting('limit')} {limit!r} s is outside (0, {MAX_RUN_DURATION_S:g}] s; give the longest time of "
                "a run"
            )
        self.board = board
        self.rate = rate
        self.watchdog = watchdog
        self.limit = limit
        self.limits = limits or Limits()
        self.guard = self.limits.guard(1.0 / rate, sensor_filter)
        self.shutdown_errors: list[str] = []
        self._samples = 0
        self._gate = OutputGate()
        #: Handlers of termination signals during the session.
        self.signals = SignalHandlers(UNINTERRUPTIBLE_CODE, board)
        self._finalizer: weakref.finalize[Any, Any] | None = None

    def __enter__(self) -> Rig:
        board = self.board
        check_thread(board)
        previous_gate: OutputGate | None = getattr(board, "gate", None)
        if previous_gate is not None and previous_gate.running:
            raise RigFault(f"{board.name}: another thread has not returned from a run on this board; wait for it")
        board.gate = self._gate
        try:
            self._finalizer = weakref.finalize(self, _shut_down_and_restore, board, self.signals)
            self.signals.install()
            board.open()
            board.configure(self.rate)
            board.set_expiration()
            missing_state = board.watchdog_problem()
            if missing_state is not None:
                raise RigFault(
                    f"{board.name}: {missing_state}; the motors are not started without a watchdog that stops them"
                )
            board.start_watchdog(self.watchdog)
            board.start(self.rate)
            board.read_rest(self.guard, max(2, round(REST_DURATION_S * self.rate)))
            self._check()
            board.enable(True)
            return self
        except BaseException:
            self._leave()
            raise

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> Literal[False]:
        self._leave()
        if kind is None:
            # A signal that arrived during shutdown takes effect now.
            self.signals.deliver()
        return False

    def _leave(self) -> None:
        if self._finalizer is not None:
            self.shutdown_errors += self._finalizer() or []

    def _check(self) -> None:
        fault = self.guard.fault
        if fault is not None:
            raise RigFault(fault if fault.startswith(self.board.name) else f"{self.board.name}: {fault}")

    def run(self, commands: Floats) -> None:
        """Apply commands of the motor currents [A], shape (n, 2), and record one sample per command for :meth:`take`.

        Raises
        ------
        DataError
            If the commands have another shape or are not numbers.
        RigFault
            If a fault occurs or has occurred, or the time limit is exceeded. The motors remain at 0 V.
        """
        self._check()
        commands = as_floats("commands", commands)
        if commands.ndim != 2 or commands.shape[1] != 2:
            raise DataError(f"commands has shape {commands.shape}; give two currents [A] a row, shape (n, 2)")
        if self._samples + len(commands) > self.limit * self.rate + 1.5:
            self.fail(f"the time limit of {self.limit:g} s is reached; give a longer limit")
        self._samples += len(commands)
        try:
            with self._gate.lock:
                self._gate.check()
                self._gate.running = True
            self.board.run(self.guard, commands)
        except BaseException as error:
            # Write 0 V immediately, because the caller may stay in the with statement.
            with contextlib.suppress(Exception):
                self.board.write((0.0, 0.0))
            # If the board was shut down meanwhile, the shutdown caused the error of this call.
            reason = self._gate.reason if isinstance(error, Exception) else None
            if reason is None and not isinstance(error, FtlmError):
                raise
            self.guard.fail(reason or error_text(error))
        finally:
            self._gate.running = False
        self._check()

    def fail(self, why: str, cause: BaseException | None = None) -> NoReturn:
        """Latch a fault with the message `why`, write 0 V immediately, and raise RigFault.

        Raises
        ------
        RigFault
            Always, with the message of the first fault of the session and with `cause` as its cause.
        """
        self.guard.fail(why)
        with contextlib.suppress(Exception):
            self.board.write((0.0, 0.0))
        try:
            self._check()
        except RigFault as fault:
            raise fault from cause
        raise RigFault(why) from cause

    def take(self) -> Floats:
        """Return the samples since the last call, shape (n, 9): RIG_COLUMNS, then the delay of the sample [s]."""
        return self.board.take()


#: Code objects of the shutdown functions; signals that arrive while one of them runs are deferred.
UNINTERRUPTIBLE_CODE = frozenset(f.__code__ for f in (Rig.__exit__, Rig._leave, _shut_down_and_restore, shut_down))


#: Minimum and maximum sampling rate of the Q8-USB clock [Hz]; the maximum requires the fast update mode.
SAMPLE_RATE_RANGE_HZ = (1.0, 8000.0)
WATCHDOG_EXPIRED_MESSAGE = "the watchdog expired: the program did not answer in time, and the board put 0 V out"


def check_rate(rate: float) -> None:
    """Raise ModelError if a sampling rate is outside the range of the Q8-USB board, 1 to 8000 Hz."""
    low, high = SAMPLE_RATE_RANGE_HZ
    if not low <= rate <= high:
        raise ModelError(f"{setting('rate')} {rate!r} Hz is not possible with this board; use {low:g} to {high:g} Hz")


def check_watchdog(rate: float, seconds: float) -> None:
    """Raise ModelError if a watchdog timeout (`seconds`) is shorter than two samples at a rate [Hz].

    Such a watchdog would expire between samples.
    """
    if seconds * rate < 2.0:
        raise ModelError(
            f"{setting('watchdog')} {seconds:g} s is shorter than two samples at {rate:g} Hz and would expire "
            f"between them; use at least {2.0 / rate:g} s, or a higher rate"
        )


def missing_expiration_state(*, analog: bool, digital: bool) -> str | None:
    """Return an error message if analog or digital outputs have no safe state for a watchdog expiration, else None.

    `analog` and `digital` state whether these outputs have such a state.
    """
    if not analog:
        return "the watchdog's expiration state of the analog outputs is not 0 V"
    if not digital:
        return "the watchdog's expiration state of the digital lines is not tristate, so analog outputs would stay"
    return None
