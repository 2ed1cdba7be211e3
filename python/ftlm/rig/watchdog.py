"""The virtual rig's output stage and its watchdog, which lives in a process of its own: a dead program stops the motor.

Run as a script with the path of a page, it watches the page's heartbeat. It imports nothing of ftlm and nothing that
is slow to load. The rules are the board's: on expiry the analog outputs go to their expiration states only if those are
set and the digital lines are set to tristate; otherwise they stay where they were. After an expiry the outputs stay
locked until the watchdog is cleared.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import os
import signal
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

MARK = b"FTLMPAG1"
#: Name: offset and kind of every field of the page.
FIELDS = {
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
SIZE = 4096
_WRITE = struct.Struct("<Qdd")
#: Longest that a watchdog process outlives its last heartbeat, or waits for its first, when nobody closes the page [s].
_ORPHAN = 30.0


class Page:
    """The output stage's registers, in a file that two processes map.

    Parameters
    ----------
    path
        The file; made, or mapped when it is there.
    create
        Whether to make it.
    """

    def __init__(self, path: str | os.PathLike[str], *, create: bool = False) -> None:
        self.path = Path(path)
        if create:
            self.path.write_bytes(MARK + bytes(SIZE - len(MARK)))
        descriptor = os.open(self.path, os.O_RDWR | getattr(os, "O_BINARY", 0))
        try:
            self._map = mmap.mmap(descriptor, SIZE)
        finally:
            os.close(descriptor)
        if self._map[: len(MARK)] != MARK:
            raise ValueError(f"{self.path} is no page of the virtual rig")
        if create:
            self.set("state1", math.nan)
            self.set("state2", math.nan)

    def get(self, name: str) -> float:
        """A register."""
        offset, kind = FIELDS[name]
        return float(struct.unpack_from("<" + kind, self._map, offset)[0])

    def set(self, name: str, value: float) -> None:
        """Sets a register."""
        offset, kind = FIELDS[name]
        struct.pack_into("<" + kind, self._map, offset, int(value) if kind == "Q" else float(value))

    @property
    def expired(self) -> bool:
        """Whether the watchdog has expired."""
        return self._map[FIELDS["expired"][0]] != 0

    def put(self, beat: int, volts1: float, volts2: float) -> None:
        """Heartbeat and output in one go."""
        _WRITE.pack_into(self._map, FIELDS["beat"][0], beat, volts1, volts2)

    @property
    def volts(self) -> tuple[float, float]:
        """What is put out."""
        return self.get("volts1"), self.get("volts2")

    def close(self) -> None:
        """Unmaps."""
        self._map.close()


def scratch() -> Path:
    """A new file for a page, in memory where the system has such a place."""
    folder = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    descriptor, name = tempfile.mkstemp(prefix="ftlm-rig-", suffix=".page", dir=folder)
    os.close(descriptor)
    return Path(name)


def start(page: Page, *, keep: bool, patience: float = 10.0) -> subprocess.Popen[bytes]:
    """Starts the watchdog process and waits until it watches.

    Parameters
    ----------
    page
        Registers.
    keep
        Whether the page's file outlives the process.
    patience
        [s].

    Raises
    ------
    OSError
        It could not be started.
    """
    command = [sys.executable, "-I", "-S", __file__, str(page.path), "keep" if keep else "remove"]
    # A session of its own, so that Ctrl-C reaches the program and not its watchdog.
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, start_new_session=True)
    until = time.monotonic() + patience
    while not page.get("ready"):
        if process.poll() is not None or time.monotonic() > until:
            process.kill()
            process.wait()
            raise OSError("the watchdog process of the virtual rig did not start")
        time.sleep(0.002)
    return process


def watch(path: str, *, keep: bool) -> None:
    """The watchdog: until the page is closed, or its program is gone and the outputs are safe."""
    page = Page(path)
    parent = os.getppid()
    began = time.monotonic()
    beat, last = page.get("beat"), began
    page.set("ready", 1)
    armed = False
    try:
        while not page.get("closed"):
            timeout = page.get("timeout")
            now = time.monotonic()
            seen = page.get("beat")
            if seen != beat or not armed:
                beat, last = seen, now
                page.set("last_beat", now)
            armed = timeout > 0
            if armed and now - last > timeout:
                trip(page, now)
                if os.getppid() != parent or now - last > _ORPHAN:
                    break
            elif not armed and (os.getppid() != parent or now - began > _ORPHAN):
                break
            time.sleep(min(0.005, timeout / 20.0) if armed else 0.005)
    finally:
        page.close()
        if not keep:
            with contextlib.suppress(OSError):
                os.unlink(path)


def trip(page: Page, now: float) -> None:
    """The expiry, by the board's rules; repeated, so that a write that raced with it does not last."""
    if not page.expired:
        page.set("tripped", now)
        page.set("expired", 1)
    states = page.get("state1"), page.get("state2")
    if page.get("tristate") and not any(math.isnan(s) for s in states):
        page.set("volts1", states[0])
        page.set("volts2", states[1])
        page.set("enabled", 0)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    watch(sys.argv[1], keep=sys.argv[2] == "keep")
