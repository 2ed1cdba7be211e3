"""Q8-USB board, accessed through the vendor's Python package, whose blocking read determines the sampling times.

No board was available during development. The module is tested with a substitute for the vendor's package that has the
same names, types, error codes and rules. See docs/rig.md before the first run on hardware.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from importlib import import_module
from inspect import signature
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ftlm import _core
from ftlm.errors import RigFault
from ftlm.rig.rig import (
    RIG_COLUMNS,
    WATCHDOG_EXPIRED_MESSAGE,
    OutputGate,
    check_rate,
    check_watchdog,
    missing_expiration_state,
)
from ftlm.utils.validation import Floats

#: Maximum sampling rate of the board's normal update mode [Hz]; for a higher rate the fast mode is used.
MAX_NORMAL_RATE_HZ = 1000.0


def _channels(*numbers: int) -> tuple[NDArray[np.uint32], int]:
    """Return (array of channel numbers, their count), two consecutive arguments of the vendor's functions."""
    return np.array(numbers, dtype=np.uint32), len(numbers)


ANALOG_IN, ANALOG_OUT = _channels(0, 1, 2, 3), _channels(0, 1)
ENCODER_CHANNELS, SWITCH_CHANNELS = _channels(0, 1), _channels(0, 1, 2, 3)
#: Digital lines that enable the amplifiers of joints 1 and 2 (active low), and master enable line (active high).
ENABLE_CHANNELS = _channels(0, 1, 4)
ENABLE_STATES_ON, ENABLE_STATES_OFF = np.array([0, 0, 1], dtype=np.int8), np.array([1, 1, 0], dtype=np.int8)
#: All digital outputs of the board. Each of them needs an expiration state for the watchdog.
DIGITAL_OUT = _channels(*range(8))
DIGITAL_STATE_TRISTATE = 2
QUADRATURE_MODE_X4 = 4
OVERFLOW_IS_AN_ERROR = 0
UNLIMITED_SAMPLES = 0x7FFFFFFF
OPTIONS_SIZE = 256
#: Error code of the vendor's `watchdog_clear` if the watchdog has not expired.
NOTHING_TO_CLEAR = -599
#: Maximum relative drift between the clocks of board and computer. The reference time from which delays are measured is
#: adapted at this rate.
CLOCK_DRIFT_RATIO = 1e-3
ERROR_MESSAGES = {
    -108: "no Q8-USB board was found; plug it in, switch it on, and check --board",
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
        raise _no_library_error(error) from None


def _no_library_error(error: OSError) -> RigFault:
    return RigFault(
        f"the vendor's Python package is installed, but its library (hil) cannot be loaded ({error}); install the "
        "vendor's runtime"
    )


def driver_state() -> str:
    """Return a text that states whether the vendor's package, its library and a board were found.

    The board is opened and closed for this check.
    """
    try:
        _driver()
    except RigFault as fault:
        return f"not found: {fault}"
    board = QuanserBoard()
    try:
        board.open()
    except RigFault as fault:
        return f"driver found; {fault}"
    description = board.describe()
    board.close()
    return f"driver found, board found{description}"


class QuanserBoard:
    """Q8-USB board, accessed by the vendor's `HIL` class.

    Parameters
    ----------
    card
        Identifier of the board, such as ``"0"`` or ``"0@tcpip://host:port"``.
    clock
        Function that returns the time [s]. It measures the delays of samples.
    sleep
        Function that waits for a number of seconds, used to wait for the watchdog.
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
        self.gate = OutputGate()
        self.clock = clock
        self._sleep = sleep
        self._hil: Any = None
        self._error: type[Exception] = Exception
        self._module: ModuleType | None = None
        self._task: Any = None
        self._watched = False
        self._is_expired = False
        self._seconds = 0.0
        self._analog_safe = False
        self._digital_safe = False
        self._analog = np.zeros(ANALOG_IN[1], dtype=np.float64)
        self._counts = np.zeros(ENCODER_CHANNELS[1], dtype=np.int32)
        self._digital = np.zeros(SWITCH_CHANNELS[1], dtype=np.int8)
        self._volts = np.zeros(ANALOG_OUT[1], dtype=np.float64)
        self._rows: list[list[float]] = []
        self._rate = 0.0
        self._samples = 0
        self._origin = math.inf

    def open(self) -> None:
        """Open the connection to the board; raise RigFault if driver, library or board is not found or is in use."""
        module = _driver()
        self._module, self._error = module, module.HILError
        try:
            self._hil = module.HIL(card_type="q8_usb", card_identifier=self.card)
            valid = self._hil.is_valid()
        except self._error as error:
            self._hil = None
            raise self._fault("opening the board", error) from None
        except OSError as error:
            raise _no_library_error(error) from None
        if not valid:
            self._hil = None
            raise RigFault(f"Q8-USB: {ERROR_MESSAGES[-108]}")

    def configure(self, rate: float) -> None:
        """Configure channels and encoders, set outputs to zero, and create a task that samples all inputs at once.

        `rate` is the sampling rate [Hz].
        """
        check_rate(rate)
        self._rate, self._samples, self._origin, self._rows = rate, 0, math.inf, []
        speed = "normal" if rate <= MAX_NORMAL_RATE_HZ else "fast"
        low_in, low_out = np.full(ANALOG_IN[1], -10.0), np.full(ANALOG_OUT[1], -10.0)
        with self._translate_errors("configuring the board") as hil:
            try:
                hil.watchdog_clear()
            except self._error as error:
                if getattr(error, "error_code", None) != NOTHING_TO_CLEAR:
                    raise
            else:
                # Clearing an expired watchdog restores the previous outputs.
                self._write((0.0, 0.0))
                hil.write_digital(*ENABLE_CHANNELS, ENABLE_STATES_OFF)
            self._is_expired = False
            hil.set_card_specific_options(f"update_rate={speed};decimation=1", OPTIONS_SIZE)
            hil.set_analog_input_ranges(*ANALOG_IN, low_in, -low_in)
            hil.set_analog_output_ranges(*ANALOG_OUT, low_out, -low_out)
            hil.set_digital_directions(*SWITCH_CHANNELS, *ENABLE_CHANNELS)
            self._write((0.0, 0.0))
            hil.write_digital(*ENABLE_CHANNELS, ENABLE_STATES_OFF)
            modes = np.full(ENCODER_CHANNELS[1], QUADRATURE_MODE_X4, dtype=np.int32)
            hil.set_encoder_quadrature_mode(*ENCODER_CHANNELS, modes)
            hil.set_encoder_counts(*ENCODER_CHANNELS, np.zeros(ENCODER_CHANNELS[1], dtype=np.int32))
            self._task = hil.task_create_reader(
                max(2, round(rate / 10.0)), *ANALOG_IN, *ENCODER_CHANNELS, *SWITCH_CHANNELS, None, 0
            )
            hil.task_set_buffer_overflow_mode(self._task, OVERFLOW_IS_AN_ERROR)

    def set_expiration(self) -> None:
        """Set the outputs that the board applies when its watchdog expires: 0 V, and tristate digital lines.

        If the digital lines were not tristate, the board would not change its analog outputs on expiry.
        """
        with self._translate_errors("setting the watchdog's expiration states") as hil:
            hil.watchdog_set_analog_expiration_state(*ANALOG_OUT, np.zeros(ANALOG_OUT[1]))
            self._analog_safe = True
            states = np.full(DIGITAL_OUT[1], DIGITAL_STATE_TRISTATE, dtype=np.int32)
            hil.watchdog_set_digital_expiration_state(*DIGITAL_OUT, states)
            self._digital_safe = True

    def watchdog_problem(self) -> str | None:
        """Return an error message if an output has no safe state for a watchdog expiration; None if all have one."""
        return missing_expiration_state(analog=self._analog_safe, digital=self._digital_safe)

    def start_watchdog(self, seconds: float) -> None:
        """Start the watchdog of the board with a timeout of `seconds`.

        Raise RigFault if expiration states are not set, and ModelError if the timeout is shorter than two samples.
        """
        missing_state = self.watchdog_problem()
        if missing_state is not None:
            raise RigFault(f"Q8-USB: {missing_state}")
        check_watchdog(self._rate, seconds)
        with self._translate_errors("starting the watchdog") as hil:
            self._seconds = float(seconds)
            hil.watchdog_start(self._seconds)
            self._watched = True

    def start(self, rate: float) -> None:
        """Start the sampling task at a rate [Hz], which the hardware clock of the board determines."""
        with self._translate_errors("starting the task") as hil:
            clocks = getattr(self._module, "Clock", None)
            hil.task_start(self._task, getattr(clocks, "HARDWARE_CLOCK_0", 0), float(rate), UNLIMITED_SAMPLES)

    def enable(self, on: bool) -> None:
        """Enable (`on`) or disable the amplifiers; do nothing if the board is not open."""
        if self._hil is None:
            return
        with self.gate.lock, self._translate_errors("switching the amplifiers") as hil:
            if on:
                self.gate.check()
            self._run_unless_expired(
                lambda: hil.write_digital(*ENABLE_CHANNELS, ENABLE_STATES_ON if on else ENABLE_STATES_OFF),
                is_end=not on,
            )

    def write(self, volts: tuple[float, float]) -> None:
        """Write the command voltages of both motors [V]; do nothing if the board is not open.

        Writing 0 V raises no error if the expired watchdog has locked the board at 0 V.
        """
        if self._hil is None:
            return
        with self.gate.lock, self._translate_errors("writing"):
            self._run_unless_expired(lambda: self._write(volts), is_end=volts == (0.0, 0.0))

    def read_rest(self, guard: _core.Guard, samples: int) -> None:
        """Read a number of samples with outputs at 0 V, over which `guard` averages the bias of the strain gauges."""
        for _ in range(samples):
            if self._read(guard) is None:
                return
            guard.rest(self._analog.tolist(), self._counts.tolist(), self._digital.tolist())
            self._reload_and_write(guard, (0.0, 0.0))
            if guard.fault is not None:
                return

    def run(self, guard: _core.Guard, commands: Floats) -> None:
        """Apply commands of the motor currents [A], shape (n, 2), and record one sample per command.

        Each read blocks until the board has the next sample. The method returns early if `guard`, which enforces the
        safety limits, latches a fault.
        """
        for command in commands:
            delay = self._read(guard)
            if delay is None:
                return
            values = guard.read(self._analog.tolist(), self._counts.tolist(), self._digital.tolist(), delay)
            volts = guard.command(command)
            # A sample that is not finite is a fault and is not recorded.
            if all(map(math.isfinite, values)):
                self._rows.append([*guard.last_currents, *values, delay])
            self._reload_and_write(guard, (volts[0], volts[1]))
            if guard.fault is not None:
                return

    def take(self) -> Floats:
        """Return the samples since the last call, shape (n, 9): RIG_COLUMNS, then the delay of the sample [s]."""
        rows, self._rows = self._rows, []
        return np.array(rows, dtype=np.float64).reshape(-1, len(RIG_COLUMNS) + 1)

    def stop(self) -> None:
        """Stop and delete the sampling task."""
        if self._hil is not None and self._task is not None:
            task, self._task = self._task, None
            with self._translate_errors("stopping the task") as hil:
                try:
                    hil.task_stop(task)
                finally:
                    hil.task_delete(task)

    def let_expire(self) -> bool:
        """Wait for 1.5 watchdog timeouts without a heartbeat, and return whether the watchdog has expired."""
        if self._hil is None or self._is_expired:
            return True
        if not self._watched:
            return False
        self._sleep(1.5 * self._seconds + 0.05)
        return self._has_expired()

    def stop_watchdog(self) -> None:
        """Stop the watchdog. An expired watchdog is not stopped, so that its safe outputs remain."""
        if self._hil is not None and self._watched and not self._is_expired:
            self._watched = False
            with self._translate_errors("stopping the watchdog") as hil:
                hil.watchdog_stop()

    def close(self) -> None:
        """Close the connection to the board."""
        with self.gate.lock:
            hil, self._hil = self._hil, None
        if hil is not None:
            with self._translate_errors("closing the board", hil):
                hil.close()

    def describe(self) -> str:
        """Return the product name of the board in parentheses, after a space; "" if it cannot be read."""
        try:
            codes = getattr(import_module("quanser.hardware.enumerations"), "StringProperty", None)
            text = string_property(self._hil, getattr(codes, "PRODUCT_NAME", 1))
        except Exception:  # a name that cannot be read is no reason to stop
            return ""
        return f" ({text})" if text else ""

    def _read(self, guard: _core.Guard) -> float | None:
        """Read one sample into the buffers of this object, and return its delay [s].

        If the sampling task has stopped, latch a fault, write 0 V and return None.
        """
        with self._translate_errors("reading", guard=guard) as hil:
            count = hil.task_read(self._task, 1, self._analog, self._counts, self._digital, None)
            if count < 1:
                guard.fail("Q8-USB: the sampling task of the board stopped without a sample: samples were lost")
                self._write((0.0, 0.0))
                return None
        since = self.clock() - self._samples / self._rate
        self._samples += 1
        self._origin = min(self._origin + CLOCK_DRIFT_RATIO / self._rate, since)
        return since - self._origin

    def _reload_and_write(self, guard: _core.Guard, volts: tuple[float, float]) -> None:
        with self.gate.lock, self._translate_errors("writing", guard=guard) as hil:
            # After shutdown, a run that continues in another thread must not reload the watchdog either.
            self.gate.check()
            if not hil.watchdog_reload():
                self._is_expired = True
                guard.fail(WATCHDOG_EXPIRED_MESSAGE)
                return
            self._write(volts)

    def _write(self, volts: tuple[float, float]) -> None:
        with self.gate.lock:
            if volts != (0.0, 0.0):
                self.gate.check()
            if self._hil is not None:
                self._volts[:] = volts
                self._hil.write_analog(*ANALOG_OUT, self._volts)

    def _run_unless_expired(self, act: Callable[[], None], *, is_end: bool) -> None:
        """Perform an action on the board.

        `is_end` states that the action only does what an expired watchdog also does (0 V or disabled amplifiers). An
        error of such an action is ignored if the watchdog has expired. The expired watchdog is not cleared, because
        that would restore the previous outputs.
        """
        try:
            act()
        except self._error:
            if not (is_end and self._has_expired()):
                raise

    def _has_expired(self) -> bool:
        """Whether the watchdog has expired; False if the board reports an error instead."""
        if not self._watched or self._hil is None:
            return self._is_expired
        try:
            self._is_expired = self._is_expired or not self._hil.watchdog_reload()
        except self._error:
            return False
        return self._is_expired

    @contextlib.contextmanager
    def _translate_errors(self, operation: str, hil: Any = None, guard: _core.Guard | None = None) -> Iterator[Any]:
        """Convert errors of the vendor's package in a ``with`` block to RigFault, and latch them in `guard`, if given.

        `operation` is the name of the operation in the message. The block gets the vendor's board object, by default
        that of this board. Raise RigFault if the board is not open.
        """
        handle = self._hil if hil is None else hil
        if handle is None:
            raise RigFault(f"Q8-USB, {operation}: the board is not open; call open() first")
        try:
            yield handle
        except self._error as error:
            fault = self._fault(operation, error)
            if guard is not None:
                # A board that is locked by its expired watchdog rejects every call, so the expiry is the cause.
                if self._has_expired():
                    fault = RigFault(f"{WATCHDOG_EXPIRED_MESSAGE} (Q8-USB, {operation})")
                guard.fail(str(fault))
            raise fault from None

    def _fault(self, operation: str, error: Exception) -> RigFault:
        code = getattr(error, "error_code", None)
        code_message = ERROR_MESSAGES.get(code) if isinstance(code, int) else None
        if code_message is None:
            try:
                message = str(error.get_error_message())  # type: ignore[attr-defined]
            except Exception:  # the message needs the vendor's runtime
                message = str(error)
            code_message = f"{message or 'no message'} (error {code})"
        return RigFault(f"Q8-USB, {operation}: {code_message}")


#: Maximum length of a string property of the board.
MAX_PROPERTY_CHARACTERS = 64


def string_property(hil: Any, code: Any) -> str:
    """Return the string property with this code of the vendor's board object.

    Return "" with the vendor's package of 2022, whose function overflows its buffer.
    """
    if len(signature(hil.get_string_property).parameters) != 2:
        return ""
    return str(hil.get_string_property(code, MAX_PROPERTY_CHARACTERS))
