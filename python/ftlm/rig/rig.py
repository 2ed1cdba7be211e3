"""Signals that end a program, while motors may run: they end the run, and never the way out of it."""

from __future__ import annotations

import contextlib
import math
import signal
import threading
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from types import CodeType, FrameType
from typing import Any, Literal, NoReturn, Protocol

from ftlm import _core
from ftlm.errors import FtlmError, ModelError, RigFault
from ftlm.utils.validation import Floats, real_number, words_of

#: A closed terminal ends a program too.
_ENDING = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")


class Signals:
    """Handlers of the signals that end a program, between a start and a way out.

    They are those of the main thread; elsewhere Python hands over no signal, and nothing is installed. The object
    refers to no rig, so that the table of handlers does not keep one alive.

    Parameters
    ----------
    deaf
        Code that no signal may cut short: one that comes while it is at work waits.
    """

    def __init__(self, deaf: frozenset[CodeType]) -> None:
        self._deaf = deaf
        self._before: dict[int, Any] = {}
        self._waiting: int | None = None

    def install(self) -> None:
        """Takes the place of the handlers that there are; a Ctrl-C that the program ignores stays ignored."""
        if threading.current_thread() is not threading.main_thread():
            return
        for name in _ENDING:
            number = getattr(signal, name, None)
            if number is None or (name == "SIGINT" and signal.getsignal(number) in (signal.SIG_IGN, None)):
                continue
            # Noted before it is replaced: a signal between the two finds nothing that is not put back.
            self._before[number] = signal.getsignal(number)
            signal.signal(number, self._came)

    def restore(self) -> None:
        """Puts the handlers of before back, all of them: a signal that comes meanwhile waits, where the system can."""
        if not self._before or threading.current_thread() is not threading.main_thread():
            return
        mask = getattr(signal, "pthread_sigmask", None)
        kept = None if mask is None else mask(signal.SIG_BLOCK, self._before)
        try:
            for number, handler in self._before.items():
                signal.signal(number, handler)
            self._before = {}
        finally:
            if mask is not None:
                mask(signal.SIG_SETMASK, kept)

    def deliver(self) -> None:
        """Raises what a signal that waited would have raised."""
        number, self._waiting = self._waiting, None
        if number == signal.SIGINT:
            signal.raise_signal(number)
        elif number is not None:
            _end(number)

    def _came(self, number: int, frame: FrameType | None) -> None:
        at = frame
        while at is not None:
            if at.f_code in self._deaf:
                self._waiting = number
                return
            at = at.f_back
        before = self._before.get(number)
        if number == signal.SIGINT and callable(before):
            before(number, frame)
            return
        _end(number)


def _end(number: int) -> None:
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise SystemExit(128 + number)


#: Deflection per volt of strain gauge [rad/V]; the sign is reversed.
STRAIN_SCALE = (0.013636, 0.018694)
#: Current per volt of the sense [A/V]; the sign is reversed.
SENSE_SCALE = 2.0
#: Current per volt of the command [A/V]; the sign is reversed.
COMMAND_SCALE = 0.5
#: Hub angle per count [rad]: 1024 lines read fourfold, behind gears of 100:1 and 50:1.
ENCODER_SCALE = (2.0 * math.pi / 4096.0 / 100.0, 2.0 * math.pi / 4096.0 / 50.0)
#: Largest commands that the amplifiers are set up for [A].
CURRENT_LIMIT = (0.94, 1.2)
#: Time at rest before every run over which the gauges' bias is averaged [s].
REST = 0.2
#: Longest run that may be asked for [s].
LONGEST = 600.0
#: Range of the watchdog's time [s]. 0 would switch it off; a second is already a long time for a motor.
WATCHDOG_RANGE = (0.01, 1.0)
#: Said where nothing that was tried can be known to have stopped the motors.
LIVE = (
    "the motors may still be under current: neither 0 V nor switched-off amplifiers nor the watchdog's expiry could be "
    "confirmed; cut the arm's power by hand (emergency stop). The watchdog was left running and the board open"
)
#: What a row of a run holds.
COLUMNS = ("I1", "I2", "theta11", "theta12", "theta21", "theta22", "I1_measured", "I2_measured")


@dataclass(frozen=True)
class Limits:
    """What the innermost write and the checks of every sample hold a run to; pairs are stage 1 and stage 2.

    Parameters
    ----------
    current
        Largest command [A].
    slew
        Largest change of a command [A/s]. A reversal from end to end takes two samples of 2 ms.
    continuous
        Current that a motor bears for ever [A]: the mean square over `thermal_time` stays below its square.
    thermal_time
        [s].
    deflection
        Trip of the links [rad].
    saturation
        Gauge volts that count as saturated.
    moving_current
        Current under which a hub must move [A]; below it friction may hold it.
    standstill
        Time that it may stand still under it [s].
    fastest
        Fastest hub [rad/s]; a faster count is a fault of the encoder.
    late
        Longest delay of a write [s].
    missed
        Missed deadlines in a row that are borne.
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
    late: float = 0.05
    missed: int = 20

    def guard(self, step: float, sensor_filter: tuple[float, float] | None = None) -> _core.Guard:
        """The guard that enforces them at a sampling step [s]."""
        return _core.Guard(
            {
                "step": step,
                "strain_scale": STRAIN_SCALE,
                "sense_scale": SENSE_SCALE,
                "command_scale": COMMAND_SCALE,
                "encoder_scale": ENCODER_SCALE,
                "current_limit": self.current,
                "slew": self.slew,
                "continuous": self.continuous,
                "thermal_time": self.thermal_time,
                "deflection_limit": self.deflection,
                "saturation": self.saturation,
                "moving_current": self.moving_current,
                "standstill": self.standstill,
                "fastest": self.fastest,
                "late_limit": self.late,
                "missed_limit": self.missed,
                "filter": sensor_filter,
            }
        )


class Board(Protocol):
    """What a rig must be able to do; the order is :class:`Rig`'s."""

    name: str
    hardware: bool

    def open(self) -> None:
        """Takes possession of the board."""

    def configure(self, rate: float) -> None:
        """Sets ranges, directions and encoders, zeroes outputs, makes the one task that reads all channels."""

    def set_expiration(self) -> None:
        """Tells the watchdog to put 0 V out, and the digital lines in their safe state."""

    def unsafe(self) -> str | None:
        """What is missing for the watchdog to stop the motors, in words; None when nothing is."""

    def start_watchdog(self, seconds: float) -> None:
        """Starts the watchdog."""

    def start(self, rate: float) -> None:
        """Starts sampling."""

    def enable(self, on: bool) -> None:
        """Switches the amplifiers."""

    def write(self, volts: tuple[float, float]) -> None:
        """Puts volts out."""

    def rest(self, guard: _core.Guard, samples: int) -> None:
        """Samples with 0 V out."""

    def run(self, guard: _core.Guard, commands: Floats) -> None:
        """Samples under commands, shape (n, 2) [A], until they end or a fault latches."""

    def take(self) -> Floats:
        """Rows since the last call: COLUMNS and the delay [s]."""

    def stop(self) -> None:
        """Stops the task."""

    def let_expire(self) -> bool:
        """Waits without a heartbeat until the watchdog has put 0 V out; whether it is known to have."""

    def stop_watchdog(self) -> None:
        """Stops the watchdog."""

    def close(self) -> None:
        """Lets go of the board."""


def shut_down(board: Board) -> list[str]:
    """Every step of the way out, each tried whatever became of the one before; what went wrong, in words.

    A step that is interrupted (a second Ctrl-C) is done again. Where 0 V could not be written or the amplifiers could
    not be disabled, the watchdog is let expire, which does both. Where none of the three is certain, the watchdog is
    left running and the board open: stopping the one or closing the other could leave the motors under current.
    """
    troubles: list[str] = []
    zero = _tried("writing 0 V", lambda: board.write((0.0, 0.0)), troubles)
    off = _tried("disabling the amplifiers", lambda: board.enable(False), troubles)
    _tried("stopping the task", board.stop, troubles)
    # A board of one's own may have no watchdog that can be waited for.
    let_expire = getattr(board, "let_expire", None)
    expired = False
    if not (zero and off) and let_expire is not None:
        seen: list[bool] = []
        _tried("waiting for the watchdog", lambda: seen.append(let_expire()), troubles)
        expired = any(seen)
        if expired:
            troubles.append("the watchdog was let expire instead, which puts 0 V out")
    if not (zero or off or expired):
        troubles.append(LIVE)
        return troubles
    _tried("stopping the watchdog", board.stop_watchdog, troubles)
    _tried("closing the board", board.close, troubles)
    return troubles


def _tried(name: str, step: Callable[[], None], troubles: list[str]) -> bool:
    """Whether a step was done; one that is interrupted is done again, and what fails is told."""
    for _ in (1, 2):
        try:
            step()
        except (KeyboardInterrupt, SystemExit) as error:
            why: BaseException | str = str(error) or "interrupted twice"
        except BaseException as error:
            why = error
            break
        else:
            return True
    troubles.append(f"{name} failed: {why}")
    return False


def _way_out(board: Board, signals: Signals) -> list[str]:
    """The way out, and then the handlers of before; nothing that it refers to keeps the rig alive."""
    try:
        return shut_down(board)
    finally:
        signals.restore()


class Rig:
    """A rig between its start and its way out; use it in a ``with`` statement.

    However the block is left (its end, an exception, Ctrl-C, SIGTERM, SIGHUP, garbage collection), 0 V is written, the
    amplifiers are disabled, task and watchdog stopped and the board closed, each step tried even if one before it
    fails. If the program dies or freezes, the watchdog puts 0 V out.

    Parameters
    ----------
    board
        The virtual board or the Q8-USB.
    rate
        Samples per second.
    watchdog
        Time after which the watchdog puts 0 V out [s], 0.01 to 1.
    limit
        Longest run [s]; no command is written after it.
    limits
        What every write is held to.
    sensor_filter
        Natural frequency [rad/s] and damping of a low-pass on both recorded deflections.
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
        low, high = WATCHDOG_RANGE
        watchdog = real_number("watchdog", watchdog)
        if not low <= watchdog <= high:
            raise ModelError(
                f"watchdog = {watchdog!r} s is outside [{low:g}, {high:g}] s; 0 would leave the motors running when "
                "the program dies"
            )
        if not 0 < limit <= LONGEST:
            raise ModelError(f"limit = {limit!r} s is outside (0, {LONGEST:g}] s; give the longest time of a run")
        self.board = board
        self.rate = rate
        self.watchdog = watchdog
        self.limit = limit
        self.limits = limits or Limits()
        self.guard = self.limits.guard(1.0 / rate, sensor_filter)
        self.troubles: list[str] = []
        self._samples = 0
        self._signals = Signals(WAY_OUT)
        self._finalizer: weakref.finalize[Any, Any] | None = None

    def __enter__(self) -> Rig:
        board = self.board
        try:
            self._finalizer = weakref.finalize(self, _way_out, board, self._signals)
            self._signals.install()
            board.open()
            board.configure(self.rate)
            board.set_expiration()
            missing = board.unsafe()
            if missing is not None:
                raise RigFault(
                    f"{board.name}: {missing}; the motors are not started without a watchdog that stops them"
                )
            board.start_watchdog(self.watchdog)
            board.start(self.rate)
            board.rest(self.guard, max(2, round(REST * self.rate)))
            self._check()
            board.enable(True)
            return self
        except BaseException:
            self._leave()
            raise

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> Literal[False]:
        self._leave()
        if kind is None:
            # Who asked to stop while the motors were being stopped gets what they asked for.
            self._signals.deliver()
        return False

    def _leave(self) -> None:
        if self._finalizer is not None:
            self.troubles += self._finalizer() or []

    def _check(self) -> None:
        fault = self.guard.fault
        if fault is not None:
            raise RigFault(fault if fault.startswith(self.board.name) else f"{self.board.name}: {fault}")

    def run(self, commands: Floats) -> None:
        """Runs commands, shape (n, 2) [A]; rows wait in :meth:`take`.

        Raises
        ------
        RigFault
            A fault latched: the motors are at 0 V and stay there.
        """
        self._check()
        if self._samples + len(commands) > self.limit * self.rate + 1.5:
            self.fail(f"the time limit of {self.limit:g} s is over; ask for a longer one")
        self._samples += len(commands)
        try:
            self.board.run(self.guard, commands)
        except BaseException as error:
            # At once, and not only on the way out: the caller may stay in the with statement.
            with contextlib.suppress(Exception):
                self.board.write((0.0, 0.0))
            if not isinstance(error, FtlmError):
                raise
            self.guard.fail(words_of(error))
        self._check()

    def fail(self, why: str, cause: BaseException | None = None) -> NoReturn:
        """Latch a fault of the program: 0 V at once.

        Raises
        ------
        RigFault
            The first fault of the run, from what caused it.
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
        """Rows since the last call, shape (n, 9): COLUMNS and how late each was [s]."""
        return self.board.take()


#: Nothing cuts these short: a signal that comes while one of them is at work waits for its end.
WAY_OUT = frozenset(f.__code__ for f in (Rig.__exit__, Rig._leave, _way_out, shut_down))


#: The board's clock [Hz]: lowest, and highest in fast update.
RATES = (1.0, 8000.0)
EXPIRED = "the watchdog expired: the program did not answer in time, and the board put 0 V out"


def check_rate(rate: float) -> None:
    """Refuse samples a second that the board's clock cannot do."""
    low, high = RATES
    if not low <= rate <= high:
        raise ModelError(f"rate = {rate!r} Hz cannot be done by this board; use {low:g} to {high:g} Hz")


def check_watchdog(rate: float, seconds: float) -> None:
    """Refuse a watchdog that would expire between one sample and the next, each of which reloads it."""
    if seconds * rate < 2.0:
        raise ModelError(
            f"watchdog = {seconds:g} s is shorter than two samples at {rate:g} Hz and would expire between them; use "
            f"at least {2.0 / rate:g} s, or a higher rate"
        )


def unset(*, analog: bool, digital: bool) -> str | None:
    """What keeps the watchdog from stopping the motors, given which of its expiration states are set."""
    if not analog:
        return "the watchdog's expiration state of the analog outputs is not 0 V"
    if not digital:
        return "the watchdog's expiration state of the digital lines is not tristate, so analog outputs would stay"
    return None
