"""The arm on a Q8-USB board, through the vendor's Python package; timed by the board's blocking read.

No board was available while this was written: it is tested against a stand-in that keeps the package's names, types,
error codes and rules. See docs/rig.md before the first run on hardware.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from importlib import import_module
from inspect import signature
from types import ModuleType
from typing import Any

import numpy as np

from ftlm import _core
from ftlm.errors import RigFault
from ftlm.rig.rig import COLUMNS, EXPIRED, check_rate, check_watchdog, unset
from ftlm.utils.validation import Floats

#: Up to here the board's normal update rate does [Hz]; above, the fast one.
RATE_NORMAL = 1000.0
ANALOG_IN = np.arange(4, dtype=np.uint32)
ANALOG_OUT = np.arange(2, dtype=np.uint32)
ENCODERS = np.arange(2, dtype=np.uint32)
SWITCHES = np.arange(4, dtype=np.uint32)
#: Amplifier enable of both stages (active low) and master enable (active high).
ENABLES = np.array([0, 1, 4], dtype=np.uint32)
ON, OFF = np.array([0, 0, 1], dtype=np.int8), np.array([1, 1, 0], dtype=np.int8)
#: Every digital output of the board: the watchdog's rule is about all of them.
DIGITAL_OUT = np.arange(8, dtype=np.uint32)
TRISTATE = 2
X4 = 4
OVERFLOW_IS_AN_ERROR = 0
ENDLESS = 0x7FFFFFFF
OPTIONS_SIZE = 256
#: `watchdog_clear` at start-up, when there is nothing to clear.
NOTHING_TO_CLEAR = -599
#: The board's clock and the computer's drift apart; delays are counted from an instant that follows by this share.
DRIFT = 1e-3
WORDS = {
    -108: "no Q8-USB board was found; plug it in, switch it on, and check --card",
    -109: "the board is in use by another program; close that program",
    -111: "the buffer overflowed and samples were lost; lower the rate or the machine's load",
    -179: "the vendor's installation does not know the Q8-USB; install the suite or SDK that lists it (Windows)",
    -986: "the board's driver was not found; install the vendor's driver for the Q8-USB",
    -1073: "the board is open already; close it first",
    -1160: "the board was disconnected; check its cable",
    -1270: "samples were lost; lower the rate or the machine's load",
}
NO_PACKAGE = (
    "the vendor's Python package (quanser.hardware) is not installed; it comes with the vendor's SDK or real-time "
    "suite and is not on PyPI"
)


def _driver() -> ModuleType:
    try:
        return import_module("quanser.hardware")
    except ImportError as error:
        if error.name is not None and error.name.split(".")[0] != "quanser":
            raise RigFault(
                f"the vendor's Python package is installed, but {error.name}, which it needs, is not; run: pip install "
                f"{error.name.split('.')[0]}"
            ) from None
        raise RigFault(NO_PACKAGE) from None
    except OSError as error:
        raise _no_library(error) from None


def _no_library(error: OSError) -> RigFault:
    return RigFault(
        f"the vendor's Python package is installed, but its library (hil) cannot be loaded ({error}); install the "
        "vendor's runtime"
    )


def driver_state(card: str = "0") -> str:
    """Whether a board could be used, in words: package, library, then the board itself, opened and closed."""
    try:
        _driver()
    except RigFault as fault:
        return f"not found: {fault}"
    board = QuanserBoard(card)
    try:
        board.open()
    except RigFault as fault:
        return f"driver found; {fault}"
    about = board.describe()
    board.close()
    return f"driver found, board found{about}"


class QuanserBoard:
    """The Q8-USB behind the vendor's `HIL`.

    Parameters
    ----------
    card
        Identifier, such as ``"0"`` or ``"0@tcpip://host:port"``.
    clock
        Seconds, to see delays with.
    sleep
        Waits seconds, for the watchdog.
    """

    name = "Q8-USB"
    hardware = True

    def __init__(
        self,
        card: str = "0",
        *,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.card = card
        self.clock = clock
        self._sleep = sleep
        self._hil: Any = None
        self._error: type[Exception] = Exception
        self._module: ModuleType | None = None
        self._task: Any = None
        self._watched = False
        self._lapsed = False
        self._seconds = 0.0
        self._analog_safe = False
        self._digital_safe = False
        self._analog = np.zeros(len(ANALOG_IN), dtype=np.float64)
        self._counts = np.zeros(len(ENCODERS), dtype=np.int32)
        self._digital = np.zeros(len(SWITCHES), dtype=np.int8)
        self._volts = np.zeros(len(ANALOG_OUT), dtype=np.float64)
        self._rows: list[list[float]] = []
        self._rate = 0.0
        self._samples = 0
        self._origin = math.inf

    def open(self) -> None:
        """Takes possession of the board."""
        module = _driver()
        self._module, self._error = module, module.HILError
        try:
            self._hil = module.HIL(card_type="q8_usb", card_identifier=self.card)
            valid = self._hil.is_valid()
        except self._error as error:
            self._hil = None
            raise self._fault("opening the board", error) from None
        except OSError as error:
            raise _no_library(error) from None
        if not valid:
            self._hil = None
            raise RigFault(f"Q8-USB: {WORDS[-108]}")

    def configure(self, rate: float) -> None:
        """Ranges, directions, encoders, outputs at zero, and one reader for all channels: one sample instant."""
        check_rate(rate)
        self._rate = rate
        speed = "normal" if rate <= RATE_NORMAL else "fast"
        low_in, low_out = np.full(len(ANALOG_IN), -10.0), np.full(len(ANALOG_OUT), -10.0)
        with self._spoken("configuring the board") as hil:
            try:
                hil.watchdog_clear()
            except self._error as error:
                if getattr(error, "error_code", None) != NOTHING_TO_CLEAR:
                    raise
            else:
                # Clearing an expiry brings back what was put out before it.
                self._write((0.0, 0.0))
                hil.write_digital(ENABLES, len(ENABLES), OFF)
            self._lapsed = False
            hil.set_card_specific_options(f"update_rate={speed};decimation=1", OPTIONS_SIZE)
            hil.set_analog_input_ranges(ANALOG_IN, len(ANALOG_IN), low_in, -low_in)
            hil.set_analog_output_ranges(ANALOG_OUT, len(ANALOG_OUT), low_out, -low_out)
            hil.set_digital_directions(SWITCHES, len(SWITCHES), ENABLES, len(ENABLES))
            self._write((0.0, 0.0))
            hil.write_digital(ENABLES, len(ENABLES), OFF)
            modes = np.full(len(ENCODERS), X4, dtype=np.int32)
            hil.set_encoder_quadrature_mode(ENCODERS, len(ENCODERS), modes)
            hil.set_encoder_counts(ENCODERS, len(ENCODERS), np.zeros(len(ENCODERS), dtype=np.int32))
            self._task = hil.task_create_reader(
                max(2, round(rate / 10.0)),
                ANALOG_IN,
                len(ANALOG_IN),
                ENCODERS,
                len(ENCODERS),
                SWITCHES,
                len(SWITCHES),
                None,
                0,
            )
            hil.task_set_buffer_overflow_mode(self._task, OVERFLOW_IS_AN_ERROR)

    def set_expiration(self) -> None:
        """0 V, and every digital line in tristate: without the second the analog outputs would stay."""
        with self._spoken("setting the watchdog's expiration states") as hil:
            hil.watchdog_set_analog_expiration_state(ANALOG_OUT, len(ANALOG_OUT), np.zeros(len(ANALOG_OUT)))
            self._analog_safe = True
            states = np.full(len(DIGITAL_OUT), TRISTATE, dtype=np.int32)
            hil.watchdog_set_digital_expiration_state(DIGITAL_OUT, len(DIGITAL_OUT), states)
            self._digital_safe = True

    def unsafe(self) -> str | None:
        """What was not set."""
        return unset(analog=self._analog_safe, digital=self._digital_safe)

    def start_watchdog(self, seconds: float) -> None:
        """Starts the board's watchdog."""
        missing = self.unsafe()
        if missing is not None:
            raise RigFault(f"Q8-USB: {missing}")
        check_watchdog(self._rate, seconds)
        with self._spoken("starting the watchdog") as hil:
            self._seconds = float(seconds)
            hil.watchdog_start(self._seconds)
            self._watched = True

    def start(self, rate: float) -> None:
        """Starts the task on the board's own clock."""
        with self._spoken("starting the task") as hil:
            clocks = getattr(self._module, "Clock", None)
            hil.task_start(self._task, getattr(clocks, "HARDWARE_CLOCK_0", 0), float(rate), ENDLESS)

    def enable(self, on: bool) -> None:
        """Switches the amplifiers."""
        if self._hil is None:
            return
        with self._spoken("switching the amplifiers") as hil:
            self._allowed(lambda: hil.write_digital(ENABLES, len(ENABLES), ON if on else OFF), done=not on)

    def write(self, volts: tuple[float, float]) -> None:
        """Puts volts out; where the watchdog has locked the board, 0 V is out already."""
        if self._hil is None:
            return
        with self._spoken("writing"):
            self._allowed(lambda: self._write(volts), done=volts == (0.0, 0.0))

    def rest(self, guard: _core.Guard, samples: int) -> None:
        """Samples with 0 V out."""
        for _ in range(samples):
            if self._read(guard) is None:
                return
            guard.rest(self._analog.tolist(), self._counts.tolist(), self._digital.tolist())
            self._put(guard, (0.0, 0.0))
            if guard.fault is not None:
                return

    def run(self, guard: _core.Guard, commands: Floats) -> None:
        """Samples under commands; each read blocks until the board has one."""
        for command in commands:
            late = self._read(guard)
            if late is None:
                return
            values = guard.read(self._analog.tolist(), self._counts.tolist(), self._digital.tolist(), late)
            volts = guard.command(command)
            # A reading that is no number is a fault, which says so, and no measurement.
            if all(map(math.isfinite, values)):
                self._rows.append([*guard.written, *values, late])
            self._put(guard, (volts[0], volts[1]))
            if guard.fault is not None:
                return

    def take(self) -> Floats:
        """Rows since the last call."""
        rows, self._rows = self._rows, []
        return np.array(rows, dtype=np.float64).reshape(-1, len(COLUMNS) + 1)

    def stop(self) -> None:
        """Stops the task and gives it back."""
        if self._hil is not None and self._task is not None:
            task, self._task = self._task, None
            with self._spoken("stopping the task") as hil:
                try:
                    hil.task_stop(task)
                finally:
                    hil.task_delete(task)

    def let_expire(self) -> bool:
        """Waits half as long again as the watchdog does, and asks the board."""
        if self._hil is None or self._lapsed:
            return True
        if not self._watched:
            return False
        self._sleep(1.5 * self._seconds + 0.05)
        return self._expired()

    def stop_watchdog(self) -> None:
        """Stops the watchdog; one that has expired is left as it is, since what it put out is to stay."""
        if self._hil is not None and self._watched and not self._lapsed:
            self._watched = False
            with self._spoken("stopping the watchdog") as hil:
                hil.watchdog_stop()

    def close(self) -> None:
        """Lets go of the board."""
        if self._hil is not None:
            hil, self._hil = self._hil, None
            with self._spoken("closing the board", hil):
                hil.close()

    def describe(self) -> str:
        """What the board says of itself; empty when it says nothing."""
        try:
            codes = getattr(import_module("quanser.hardware.enumerations"), "StringProperty", None)
            text = string_property(self._hil, getattr(codes, "PRODUCT_NAME", 1))
        except Exception:  # a name that cannot be read is no reason to stop
            return ""
        return f" ({text})" if text else ""

    def _read(self, guard: _core.Guard) -> float | None:
        """One sample into the buffers; how late it came [s], None where the board stopped sampling."""
        with self._spoken("reading", guard=guard) as hil:
            count = hil.task_read(self._task, 1, self._analog, self._counts, self._digital, None)
            if count < 1:
                guard.fail("Q8-USB: the board's task stopped and handed over no sample: samples were lost")
                self._write((0.0, 0.0))
                return None
        since = self.clock() - self._samples / self._rate
        self._samples += 1
        self._origin = min(self._origin + DRIFT / self._rate, since)
        return since - self._origin

    def _put(self, guard: _core.Guard, volts: tuple[float, float]) -> None:
        with self._spoken("writing", guard=guard) as hil:
            if not hil.watchdog_reload():
                self._lapsed = True
                guard.fail(EXPIRED)
                return
            self._write(volts)

    def _write(self, volts: tuple[float, float]) -> None:
        self._volts[:] = volts
        self._hil.write_analog(ANALOG_OUT, len(ANALOG_OUT), self._volts)

    def _allowed(self, act: Callable[[], None], *, done: bool) -> None:
        """Acts, unless the watchdog has expired and has `done` it.

        The lock stays: clearing it brings back what was put out before.
        """
        try:
            act()
        except self._error:
            if not (done and self._expired()):
                raise

    def _expired(self) -> bool:
        """Whether the watchdog has expired; False where the board does not say."""
        if not self._watched:
            return False
        try:
            self._lapsed = self._lapsed or not self._hil.watchdog_reload()
        except self._error:
            return False
        return self._lapsed

    def _spoken(self, what: str, hil: Any = None, guard: _core.Guard | None = None) -> _Spoken:
        return _Spoken(self, what, self._hil if hil is None else hil, guard)

    def _fault(self, what: str, error: Exception) -> RigFault:
        code = getattr(error, "error_code", None)
        words = WORDS.get(code) if isinstance(code, int) else None
        if words is None:
            try:
                said = str(error.get_error_message())  # type: ignore[attr-defined]
            except Exception:  # the message needs the vendor's runtime
                said = str(error)
            words = f"{said or 'no message'} (error {code})"
        return RigFault(f"Q8-USB, {what}: {words}")


class _Spoken:
    """The vendor's errors in words; latched where a run was under way.

    Parameters
    ----------
    board, what, hil
        Whose, doing what, with which handle.
    guard
        Of the run that is under way.
    """

    def __init__(self, board: QuanserBoard, what: str, hil: Any, guard: _core.Guard | None) -> None:
        self._board, self._what, self._hil, self._guard = board, what, hil, guard

    def __enter__(self) -> Any:
        if self._hil is None:
            raise RigFault(f"Q8-USB, {self._what}: the board is not open")
        return self._hil

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        board = self._board
        if error is None or not isinstance(error, board._error):
            return
        fault = board._fault(self._what, error)
        if self._guard is not None:
            # A locked board refuses whatever is called next with an error of its own; the cause is the expiry.
            if board._expired():
                fault = RigFault(f"{EXPIRED} (Q8-USB, {self._what})")
            self._guard.fail(str(fault))
        raise fault from None


def string_property(hil: Any, code: Any, size: int = 64) -> str:
    """A text that the board knows; empty with the package of 2022, whose call writes past its own buffer."""
    if len(signature(hil.get_string_property).parameters) != 2:
        return ""
    return str(hil.get_string_property(code, size))
