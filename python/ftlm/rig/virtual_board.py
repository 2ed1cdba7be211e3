"""The virtual rig: the simulated arm behind a board that keeps the real one's rules of access and of its watchdog."""

from __future__ import annotations

import contextlib
import os
import subprocess
import time
from dataclasses import dataclass, field

import numpy as np

from ftlm import _core
from ftlm.errors import RigFault
from ftlm.rig import watchdog
from ftlm.rig.arm_parameters import SETS, ArmParameters
from ftlm.rig.rig import EXPIRED, check_rate, check_watchdog, unset
from ftlm.utils.validation import Floats, check_seed

#: What can be made to go wrong: name, and what its number means.
INJECTIONS = {
    "dead encoder": "",
    "saturated gauge": "",
    "limit switch": "",
    "deflection": "more bend [rad]",
    "late": "delay of that sample [s]",
    "lost samples": "",
}
#: A run that is not in real time cannot be late; its watchdog only has to see that the program lives [s].
_FAST_WATCHDOG = 2.0


@dataclass
class VirtualBoard:
    """The simulated arm as a board: opened, configured, watched, read, written and closed like the real one.

    Parameters
    ----------
    parameters
        Of the arm.
    seed
        Of the noise.
    paced
        Real time, or as fast as possible.
    horizon
        Longest run [s]; sets the size of the arm's memory.
    page
        File for the output stage's registers; kept when it is given.
    inject
        What goes wrong: (name in INJECTIONS, channel from 0, time [s], number).
    """

    parameters: ArmParameters = field(default_factory=lambda: SETS["effective"])
    seed: int = 0
    paced: bool = False
    horizon: float = 30.0
    page: str | os.PathLike[str] | None = None
    inject: tuple[tuple[str, int, float, float], ...] = ()
    name: str = "virtual rig"
    hardware: bool = False

    def __post_init__(self) -> None:
        self._page: watchdog.Page | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._arm: _core.VirtualArm | None = None
        self._seconds = 0.0
        self._beat = 0
        self._started = False
        self.seed = check_seed(self.seed)
        self._random = np.random.default_rng(self.seed)
        self._rate = 0.0

    def open(self) -> None:
        """Makes the output stage."""
        if self._page is not None:
            raise RigFault("virtual rig: the board is open already")
        self._page = watchdog.Page(self.page or watchdog.scratch(), create=True)

    def configure(self, rate: float) -> None:
        """Makes the arm; its converters and encoders need no setting."""
        self._access()
        check_rate(rate)
        self._rate = rate
        self._arm = self.parameters.arm(1.0 / rate, self.horizon + 2.0)
        for what, channel, seconds, number in self.inject:
            sample = round((seconds + 0.2) * rate)
            self._arm.inject(what, channel, sample, number)
        self.write((0.0, 0.0))

    def set_expiration(self) -> None:
        """0 V and tristate on expiry."""
        page = self._access()
        page.set("state1", 0.0)
        page.set("state2", 0.0)
        page.set("tristate", 1)

    def unsafe(self) -> str | None:
        """What the registers lack."""
        page = self._access()
        zero = all(page.get(f"state{k}") == 0.0 for k in (1, 2))
        return unset(analog=zero, digital=bool(page.get("tristate")))

    def start_watchdog(self, seconds: float) -> None:
        """Starts the process that watches."""
        page = self._access()
        if self.paced:
            check_watchdog(self._rate, seconds)
        try:
            self._process = watchdog.start(page, keep=self.page is not None)
        except OSError as error:
            raise RigFault(f"virtual rig: {error}; check the Python installation") from None
        self._seconds = seconds
        page.set("timeout", seconds if self.paced else max(seconds, _FAST_WATCHDOG))

    def start(self, rate: float) -> None:
        """Starts the clock."""
        self._stepped().start(self.paced)
        self._started = True

    def enable(self, on: bool) -> None:
        """Switches the amplifiers."""
        if not on:
            # Off is always possible: the real lines are released by the watchdog too.
            if self._page is not None:
                self._page.set("enabled", 0)
            return
        self._access().set("enabled", 1)

    def write(self, volts: tuple[float, float]) -> None:
        """Puts volts out; 0 V always, whatever became of the watchdog."""
        if volts == (0.0, 0.0) and self._page is not None and (self._page.expired or self._unwatched()):
            self._page.put(self._beat, 0.0, 0.0)
            return
        self._put(*volts)

    def rest(self, guard: _core.Guard, samples: int) -> None:
        """Samples at rest."""
        self._stepped().rest(guard, self._random.standard_normal((samples, 4)), self._put)

    def run(self, guard: _core.Guard, commands: Floats) -> None:
        """Samples under commands."""
        if not self._started:
            raise RigFault("virtual rig: the task is not started")
        self._stepped().run(guard, commands, self._random.standard_normal((len(commands), 4)), self._put)

    def take(self) -> Floats:
        """Rows since the last call."""
        return np.empty((0, 9)) if self._arm is None else self._arm.take()

    def stop(self) -> None:
        """Stops sampling."""
        self._started = False

    def let_expire(self) -> bool:
        """Waits for the watchdog, which has the time that was asked for, also where the run is as fast as possible."""
        page, process = self._page, self._process
        if page is None:
            return True
        if process is None:
            return False
        page.set("timeout", self._seconds)
        until = time.monotonic() + self._seconds + 5.0
        while not page.expired or page.volts != (0.0, 0.0):
            if process.poll() is not None or time.monotonic() > until:
                return False
            time.sleep(0.001)
        return True

    def stop_watchdog(self) -> None:
        """Stops the process that watches."""
        if self._page is not None:
            self._page.set("timeout", 0.0)
            self._page.set("closed", 1)
        if self._process is not None:
            try:
                self._process.wait(timeout=5.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None

    def close(self) -> None:
        """Removes the output stage."""
        if self._page is not None:
            page, self._page = self._page, None
            page.close()
            if self.page is None:
                with contextlib.suppress(OSError):
                    page.path.unlink()

    def _access(self) -> watchdog.Page:
        if self._page is None:
            raise RigFault("virtual rig: the board is not open")
        if self._page.expired:
            raise RigFault(EXPIRED)
        return self._page

    def _unwatched(self) -> bool:
        """Whether the watchdog's process was started and is gone."""
        return self._process is not None and self._process.poll() is not None

    def _stepped(self) -> _core.VirtualArm:
        if self._arm is None:
            raise RigFault("virtual rig: the board is not configured")
        return self._arm

    def _put(self, volts1: float, volts2: float) -> tuple[tuple[float, float], bool]:
        """Writes, and says what reaches the motors."""
        page = self._access()
        if self._unwatched():
            raise RigFault(
                "virtual rig: the watchdog's process has died, and nothing would stop the motors should the program "
                "die too; see what ended it, and start again"
            )
        self._beat += 1
        page.put(self._beat, volts1, volts2)
        return (volts1, volts2), bool(page.get("enabled"))
