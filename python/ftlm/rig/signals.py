"""Signals that end a program, while motors may run: they end the run, and never the way out of it."""

from __future__ import annotations

import signal
import threading
from types import CodeType, FrameType
from typing import Any

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
