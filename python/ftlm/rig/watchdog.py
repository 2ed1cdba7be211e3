"""Output registers and watchdog process of the virtual rig. The process stops the motors if the program ends.

If the module is run as a script with the path of a register file, it monitors the heartbeat of the program. It imports
nothing from ftlm and no slow module. Its rules are those of the real board. On expiry, the analog outputs take their
expiration states only if these are set and the digital lines are set to tristate. Otherwise they keep their values.
After an expiry, the outputs remain locked until the watchdog is cleared.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import os
import signal
import struct
import sys
import tempfile
import time
from pathlib import Path

PAGE_SIGNATURE = b"FTLMPAG1"
#: Offset [bytes] in the file and format (of the module `struct`) of every register, by name.
PAGE_FIELDS = {
    "beat": (8, "Q"),
    "volts1": (16, "d"),
    "volts2": (24, "d"),
    "state1": (32, "d"),
    "state2": (40, "d"),
    "tristate": (48, "Q"),
    "timeout": (56, "d"),
    "expired": (64, "Q"),
    "enabled": (72, "Q"),
    "closed": (80, "Q"),
    "ready": (88, "Q"),
    "last_beat": (96, "d"),
    "tripped": (104, "d"),
}
PAGE_SIZE_BYTES = 4096
_HEARTBEAT_FORMAT = struct.Struct("<Qdd")
#: Time after the last heartbeat, or after the start without a heartbeat, at which the watchdog process ends [s].
_ORPHAN_TIMEOUT_S = 30.0


class RegisterPage:
    """Registers of the analog and digital outputs, in a file that the program and the watchdog map into memory.

    Parameters
    ----------
    path
        Path of the file.
    create
        Whether to create the file instead of mapping an existing one.

    Raises
    ------
    ValueError
        If an existing file is not a register file.
    """

    def __init__(self, path: str | os.PathLike[str], *, create: bool = False) -> None:
        self.path = Path(path)
        if create:
            self.path.write_bytes(PAGE_SIGNATURE + bytes(PAGE_SIZE_BYTES - len(PAGE_SIGNATURE)))
        descriptor = os.open(self.path, os.O_RDWR | getattr(os, "O_BINARY", 0))
        try:
            self._map = mmap.mmap(descriptor, PAGE_SIZE_BYTES)
        finally:
            os.close(descriptor)
        if self._map[: len(PAGE_SIGNATURE)] != PAGE_SIGNATURE:
            raise ValueError(f"{self.path} is not a register file of the virtual rig")
        if create:
            self.set("state1", math.nan)
            self.set("state2", math.nan)

    def get(self, name: str) -> float:
        """Return the value of the register with this name."""
        offset, kind = PAGE_FIELDS[name]
        return float(struct.unpack_from("<" + kind, self._map, offset)[0])

    def set(self, name: str, value: float) -> None:
        """Set the value of the register with this name."""
        offset, kind = PAGE_FIELDS[name]
        struct.pack_into("<" + kind, self._map, offset, int(value) if kind == "Q" else float(value))

    @property
    def has_expired(self) -> bool:
        """Whether the watchdog has expired."""
        return self._map[PAGE_FIELDS["expired"][0]] != 0

    def write_heartbeat(self, beat: int, volts1: float, volts2: float) -> None:
        """Write the heartbeat counter and the output voltages of motors 1 and 2 [V] together."""
        _HEARTBEAT_FORMAT.pack_into(self._map, PAGE_FIELDS["beat"][0], beat, volts1, volts2)

    @property
    def volts(self) -> tuple[float, float]:
        """Output voltages of motors 1 and 2 [V]."""
        return self.get("volts1"), self.get("volts2")

    def close(self) -> None:
        """Unmap the file from memory."""
        self._map.close()


def create_page_file() -> Path:
    """Create a new, empty file for registers, in shared memory if the system provides it, and return its path."""
    folder = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    descriptor, name = tempfile.mkstemp(prefix="ftlm-rig-", suffix=".page", dir=folder)
    os.close(descriptor)
    return Path(name)


def watch(path: str, *, keep: bool) -> None:
    """Monitor the heartbeat in a register file; apply the expiration states if it stops for longer than the timeout.

    The function returns when the program sets the register "closed". If the program has ended without doing so, the
    function returns after the watchdog has expired, or immediately if the watchdog was not started. On return, the file
    is removed unless `keep` is True.
    """
    page = RegisterPage(path)
    parent = os.getppid()
    start_time = time.monotonic()
    beat, last_beat = page.get("beat"), start_time
    page.set("ready", 1)
    armed = False
    try:
        while not page.get("closed"):
            timeout = page.get("timeout")
            current_time = time.monotonic()
            beat_now = page.get("beat")
            if beat_now != beat or not armed:
                beat, last_beat = beat_now, current_time
                page.set("last_beat", current_time)
            armed = timeout > 0
            if armed and current_time - last_beat > timeout:
                trip(page, current_time)
                if os.getppid() != parent or current_time - last_beat > _ORPHAN_TIMEOUT_S:
                    break
            elif not armed and (os.getppid() != parent or current_time - start_time > _ORPHAN_TIMEOUT_S):
                break
            time.sleep(min(0.005, timeout / 20.0) if armed else 0.005)
    finally:
        page.close()
        if not keep:
            with contextlib.suppress(OSError):
                os.unlink(path)


def trip(page: RegisterPage, current_time: float) -> None:
    """Mark the watchdog as expired, and apply the expiration states to the outputs by the rules of the real board.

    `current_time` is the time [s] that the first call records as the time of expiry. Repeated calls apply the states
    again, and thus override outputs that the program has written in the meantime.
    """
    if not page.has_expired:
        page.set("tripped", current_time)
        page.set("expired", 1)
    states = page.get("state1"), page.get("state2")
    if page.get("tristate") and not any(math.isnan(s) for s in states):
        page.set("volts1", states[0])
        page.set("volts2", states[1])
        page.set("enabled", 0)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    watch(sys.argv[1], keep=sys.argv[2] == "keep")
