"""Progress of long work on standard error: a bar with rate and time left, shown only where a person can see it."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

from rich.progress import Progress as RichProgress
from rich.progress import TaskID

#: Work that ends sooner needs no bar.
PATIENCE = 1.0


class _Bars:
    """The bars of one job: rich draws one display at a time, and several threads may report to it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._shown: RichProgress | None = None

    def start(self, label: str, total: int) -> TaskID:
        """Add a bar."""
        from rich.console import Console  # noqa: PLC0415 — only a terminal needs it
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn  # noqa: PLC0415

        with self._lock:
            if self._shown is None:
                self._shown = Progress(
                    TextColumn("{task.description}"),
                    BarColumn(),
                    TextColumn("{task.completed:,.0f}/{task.total:,.0f}"),
                    TextColumn("{task.fields[rate]:,.0f}/s"),
                    TextColumn("{task.fields[pruned]}"),
                    TimeRemainingColumn(),
                    console=Console(stderr=True),
                    transient=True,
                )
                self._shown.start()
            return self._shown.add_task(label, total=total, rate=0.0, pruned="")

    def update(self, task: TaskID, **state: Any) -> None:
        """Move a bar."""
        with self._lock:
            if self._shown is not None:
                self._shown.update(task, **state)

    def drop(self, task: TaskID) -> None:
        """Remove a bar, and with the last one the display."""
        with self._lock:
            if self._shown is None:
                return
            if len(self._shown.tasks) > 1:
                self._shown.remove_task(task)
            else:
                # Stopping paints the last state once more, which a bar that ended between two paintings needs.
                self._shown.stop()
                self._shown = None


class Progress:
    """Context manager whose instances are called with (done, total), or (done, total, pruned).

    Parameters
    ----------
    label
        What is going on.
    quiet
        Whether to show nothing.
    """

    def __init__(self, label: str, *, quiet: bool = False) -> None:
        self._label = label
        self._quiet = quiet or not sys.stderr.isatty()
        self._start = time.monotonic()
        self._bars = _Bars()
        self._task: TaskID | None = None

    def __enter__(self) -> Progress:
        return self

    def __call__(self, done: int, total: int, pruned: int | None = None) -> None:
        """Show that ``done`` of ``total`` candidates are dealt with, ``pruned`` of them before their end."""
        if self._quiet or time.monotonic() - self._start < PATIENCE or total == 0:
            return
        if self._task is None:
            self._task = self._bars.start(self._label, total)
        rate = done / max(time.monotonic() - self._start, 1e-9)
        share = "" if pruned is None else f"{100 * pruned / max(done, 1):.1f} % pruned"
        self._bars.update(self._task, completed=done, total=total, rate=rate, pruned=share)
        if done >= total:
            # The next search of the same job starts a bar of its own.
            self._stop()

    def beside(self) -> Progress:
        """Another bar on the same display, for work that another thread does at the same time."""
        other = Progress(self._label, quiet=self._quiet)
        other._bars = self._bars
        return other

    def name(self, label: str) -> None:
        """Name what comes next on the bar alone."""
        self._label = label

    def say(self, label: str) -> None:
        """Name what comes next."""
        self.name(label)
        if not self._quiet:
            print(label, file=sys.stderr)

    def _stop(self) -> None:
        if self._task is not None:
            self._bars.drop(self._task)
        self._task = None
        self._start = time.monotonic()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()


class Stoppable(Progress):
    """Passes on what another thread reports, and ends that thread's work once it shall stop.

    Parameters
    ----------
    told
        Who is told.
    stop
        Set to end the work with KeyboardInterrupt at its next report: signals reach the main thread alone.
    """

    def __init__(self, told: Callable[[int, int], None] | None, stop: threading.Event) -> None:
        super().__init__("", quiet=True)
        self._told = told
        self._ended = stop

    def __call__(self, done: int, total: int, pruned: int | None = None) -> None:
        """Report, or end."""
        if self._ended.is_set():
            raise KeyboardInterrupt
        if isinstance(self._told, Progress):
            self._told(done, total, pruned)
        elif self._told is not None:
            self._told(done, total)
