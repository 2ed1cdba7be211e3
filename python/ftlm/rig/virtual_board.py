"""Virtual board: a simulated arm behind an interface with the rules of the real board on access and watchdog."""

from __future__ import annotations

import contextlib
import os
import subprocess
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ftlm import _core
from ftlm.errors import ModelError, RigFault
from ftlm.rig import watchdog
from ftlm.rig.arm_parameters import PARAMETER_SETS, ArmParameters
from ftlm.rig.excitation import finite_number
from ftlm.rig.rig import (
    MAX_RUN_DURATION_S,
    REST_DURATION_S,
    WATCHDOG_EXPIRED_MESSAGE,
    OutputGate,
    check_rate,
    check_watchdog,
    missing_expiration_state,
)
from ftlm.utils.resources import subprocess_arguments
from ftlm.utils.validation import Floats, check_choice, check_seed, short_repr, whole_number

#: Faults that can be injected, by name, with the meaning of the number that is given with the fault; "" if it has none.
FAULT_INJECTIONS = {
    "dead encoder": "",
    "saturated gauge": "",
    "limit switch": "",
    "deflection": "more bend [rad]",
    "late": "delay of that sample [s]",
    "lost samples": "",
}
#: Number of channels on which a fault can be injected; 1 for faults that are not listed.
_FAULT_CHANNELS = {"dead encoder": 2, "saturated gauge": 2, "limit switch": 4, "deflection": 2}
#: Minimum watchdog timeout of runs that are not in real time [s]. In them no write can be late, so the watchdog acts
#: only if the program terminates or freezes.
_MIN_FAST_WATCHDOG_S = 2.0
#: Maximum time until the watchdog process has started [s].
_WATCHDOG_START_TIMEOUT_S = 10.0


@dataclass
class VirtualBoard:
    """Interface board of the simulated arm, with the same rules on access and watchdog as the real board.

    Parameters
    ----------
    parameters
        Parameters of the arm.
    seed
        Seed of the measurement noise.
    real_time
        Whether to run in real time instead of as fast as possible.
    horizon
        Maximum duration of a run [s], which determines how much memory the simulation allocates.
    register_file
        File of the output registers, which the watchdog process shares; by default a temporary file.
    inject
        Faults to inject for tests, each as (name in FAULT_INJECTIONS, channel from 0, time [s], number). The number has
        the meaning given in FAULT_INJECTIONS.

    Raises
    ------
    ModelError
        If a fault or its channel is unknown, or its time or number is out of range.
    """

    parameters: ArmParameters = field(default_factory=lambda: PARAMETER_SETS["effective"])
    seed: int = 0
    real_time: bool = False
    horizon: float = 30.0
    register_file: str | os.PathLike[str] | None = None
    inject: tuple[tuple[str, int, float, float], ...] = ()
    name: str = "virtual rig"
    hardware: bool = False

    def __post_init__(self) -> None:
        self.gate = OutputGate()
        self._page: watchdog.RegisterPage | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._arm: _core.VirtualArm | None = None
        self._seconds = 0.0
        self._beat = 0
        self._started = False
        self.seed = check_seed(self.seed)
        self._random = np.random.default_rng(self.seed)
        self._rate = 0.0
        if not isinstance(self.inject, (tuple, list)):
            raise ModelError(
                f"inject = {short_repr(self.inject)} is not a sequence of faults; give one (name, channel, time [s], "
                "value) for each fault"
            )
        for fault in self.inject:
            _checked_injection(fault)

    def open(self) -> None:
        """Open the board by creating the file of the output registers; raise RigFault if it is already open."""
        if self._page is not None:
            raise RigFault("virtual rig: the board is open already; close it first")
        self._page = watchdog.RegisterPage(self.register_file or watchdog.create_page_file(), create=True)

    def configure(self, rate: float) -> None:
        """Create the simulated arm with a sampling rate [Hz], and set the outputs to 0 V."""
        self._access()
        check_rate(rate)
        self._rate = rate
        self._arm = self.parameters.arm(1.0 / rate, self.horizon + 2.0)
        for kind, channel, seconds, number in map(_checked_injection, self.inject):
            self._arm.inject(kind, channel, round((seconds + REST_DURATION_S) * rate), number)
        self.write((0.0, 0.0))

    def set_expiration(self) -> None:
        """Set the outputs that the watchdog applies when it expires: 0 V, and tristate digital lines."""
        page = self._access()
        page.set("state1", 0.0)
        page.set("state2", 0.0)
        page.set("tristate", 1)

    def watchdog_problem(self) -> str | None:
        """Return an error message if an output has no safe state for a watchdog expiration; None if all have one."""
        page = self._access()
        zero = all(page.get(f"state{k}") == 0.0 for k in (1, 2))
        return missing_expiration_state(analog=zero, digital=bool(page.get("tristate")))

    def start_watchdog(self, seconds: float) -> None:
        """Start the watchdog process with a timeout of `seconds`; raise RigFault if it does not start."""
        page = self._access()
        if self.real_time:
            check_watchdog(self._rate, seconds)
        try:
            # The process is stored before it is ready, so that it can be ended after an interruption.
            self._process = spawn_watchdog(page, keep=self.register_file is not None)
            wait_for_watchdog(self._process, page)
        except OSError as error:
            raise RigFault(f"virtual rig: {error}; check the Python installation") from None
        self._seconds = seconds
        page.set("timeout", seconds if self.real_time else max(seconds, _MIN_FAST_WATCHDOG_S))

    def start(self, rate: float) -> None:
        """Start sampling at the rate that was given to :meth:`configure`."""
        self._require_arm().start(self.real_time)
        self._started = True

    def enable(self, on: bool) -> None:
        """Enable (`on`) or disable the simulated amplifiers."""
        with self.gate.lock:
            if on:
                page = self._access()
                self.gate.check()
                page.set("enabled", 1)
            elif self._page is not None:
                # Disabling is always possible, because the real watchdog releases the lines as well.
                self._page.set("enabled", 0)

    def write(self, volts: tuple[float, float]) -> None:
        """Write the command voltages of both motors [V]; 0 V can always be written, also after a fault."""
        with self.gate.lock:
            page, closed = self._page, self.gate.reason is not None
            if volts == (0.0, 0.0) and page is not None and (closed or page.has_expired or self._has_lost_watchdog()):
                page.write_heartbeat(self._beat, 0.0, 0.0)
            else:
                self._output_volts(*volts)

    def read_rest(self, guard: _core.Guard, samples: int) -> None:
        """Simulate a number of samples with outputs at 0 V, over which `guard` averages the bias of the gauges."""
        self._require_arm().rest(guard, self._random.standard_normal((samples, 4)), self._output_volts)

    def run(self, guard: _core.Guard, commands: Floats) -> None:
        """Apply commands of the motor currents [A], shape (n, 2), to the simulated arm; record one sample for each."""
        if not self._started:
            raise RigFault("virtual rig: the task is not started; call start() first")
        self._require_arm().run(guard, commands, self._random.standard_normal((len(commands), 4)), self._output_volts)

    def take(self) -> Floats:
        """Return the samples since the last call, shape (n, 9): RIG_COLUMNS, then the delay of the sample [s]."""
        return np.empty((0, 9)) if self._arm is None else self._arm.take()

    def stop(self) -> None:
        """Stop sampling."""
        self._started = False

    def let_expire(self) -> bool:
        """Wait for the watchdog to expire, and return whether it has expired and the outputs are at 0 V."""
        page, process = self._page, self._process
        if page is None:
            return True
        if process is None:
            return False
        page.set("timeout", self._seconds)
        until = time.monotonic() + self._seconds + 5.0
        while not page.has_expired or page.volts != (0.0, 0.0):
            if process.poll() is not None or time.monotonic() > until:
                return False
            time.sleep(0.001)
        return True

    def stop_watchdog(self) -> None:
        """Stop the watchdog process."""
        if self._page is not None:
            self._page.set("timeout", 0.0)
            self._page.set("closed", 1)
        if self._process is not None:
            # The process reads the request to end in the registers, which a closed board no longer has.
            try:
                self._process.wait(timeout=0.0 if self._page is None else 5.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None

    def close(self) -> None:
        """Close the board, and remove its temporary file of output registers."""
        with self.gate.lock:
            page, self._page = self._page, None
        if page is not None:
            page.close()
            if self.register_file is None:
                with contextlib.suppress(OSError):
                    page.path.unlink()

    def _access(self) -> watchdog.RegisterPage:
        if self._page is None:
            raise RigFault("virtual rig: the board is not open; call open() first")
        if self._page.has_expired:
            raise RigFault(WATCHDOG_EXPIRED_MESSAGE)
        return self._page

    def _has_lost_watchdog(self) -> bool:
        """Whether the watchdog process was started and has terminated unexpectedly."""
        return self._process is not None and self._process.poll() is not None

    def _require_arm(self) -> _core.VirtualArm:
        if self._arm is None:
            raise RigFault("virtual rig: the board is not configured; call configure() first")
        return self._arm

    def _output_volts(self, volts1: float, volts2: float) -> tuple[tuple[float, float], bool]:
        """Write the command voltages of both motors [V] with a heartbeat for the watchdog.

        Return (applied voltages, whether the amplifiers are enabled). Raise RigFault if the output gate is closed, the
        board is not open, or the watchdog has expired or terminated.
        """
        with self.gate.lock:
            page = self._access()
            self.gate.check()
            if self._has_lost_watchdog():
                raise RigFault(
                    "virtual rig: the watchdog's process has died, so the motors would not be stopped if the program "
                    "also crashed; find the cause, and start again"
                )
            self._beat += 1
            page.write_heartbeat(self._beat, volts1, volts2)
            return (volts1, volts2), bool(page.get("enabled"))


def spawn_watchdog(page: watchdog.RegisterPage, *, keep: bool) -> subprocess.Popen[bytes]:
    """Start the watchdog process, and return it without waiting until it is ready.

    Parameters
    ----------
    page
        Output registers, which the process shares through their file.
    keep
        Whether the process keeps this file when it ends, instead of removing it.

    Raises
    ------
    OSError
        If the process cannot be started.
    """
    # A separate session, and on Windows a console, so that Ctrl-C and Ctrl-Break do not reach the watchdog.
    return subprocess.Popen(
        **subprocess_arguments(
            Path(watchdog.__file__), str(page.path.resolve()), "keep" if keep else "remove", site=False
        ),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
    )


def wait_for_watchdog(process: subprocess.Popen[bytes], page: watchdog.RegisterPage) -> None:
    """Wait until the watchdog process is ready; end the process if it does not become ready.

    Parameters
    ----------
    process
        Process from `spawn_watchdog`.
    page
        Output registers that the process shares.

    Raises
    ------
    OSError
        If the process ended, or was not ready within 10 s.
    """
    until = time.monotonic() + _WATCHDOG_START_TIMEOUT_S
    try:
        while not page.get("ready"):
            if process.poll() is not None:
                raise OSError(f"the watchdog process ended at its start (exit code {process.returncode})")
            if time.monotonic() > until:
                raise OSError(f"the watchdog process did not start within {_WATCHDOG_START_TIMEOUT_S:g} s")
            time.sleep(0.002)
    except BaseException:
        process.kill()
        process.wait()
        raise


def _checked_injection(fault: object) -> tuple[str, int, float, float]:
    """Return an injected fault as (name, channel, time [s], number); raise ModelError if it is invalid."""
    if not isinstance(fault, (tuple, list)) or len(fault) != 4:
        raise ModelError(f"inject has {short_repr(fault)}; give (name, channel, time [s], value)")
    name, channel, time_s, number = fault
    check_choice("the injected fault", name, FAULT_INJECTIONS)
    count, meaning = _FAULT_CHANNELS.get(name, 1), FAULT_INJECTIONS[name]
    channel_index, time, value = whole_number(channel), finite_number(time_s), finite_number(number)
    if channel_index is None or not 0 <= channel_index < count:
        channels_text = "has the channel 0 only" if count == 1 else f"has the channels 0 to {count - 1}"
        raise ModelError(f"inject has {name!r} on channel {short_repr(channel)}; the fault {channels_text}")
    if time is None or not 0 <= time <= MAX_RUN_DURATION_S:
        raise ModelError(
            f"inject has {name!r} at {short_repr(time_s)} s; give a time of the run, from 0 to {MAX_RUN_DURATION_S:g} s"
        )
    if value is None or (name == "late" and value < 0):
        raise ModelError(f"inject has {name!r} with the number {short_repr(number)}; give {meaning or '0'}")
    return name, channel_index, time, value
