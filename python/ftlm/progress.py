"""Progress of long work on standard error: a bar with rate and time left, shown only where a person can see it."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import TracebackType

    from rich.progress import Progress as RichProgress
    from rich.progress import TaskID

__all__ = ["Progress"]

#: Work that ends sooner needs no bar.
PATIENCE = 1.0


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
        self._bar: RichProgress | None = None
        self._task: TaskID | None = None

    def __enter__(self) -> Progress:
        return self

    def __call__(self, done: int, total: int, pruned: int | None = None) -> None:
        """Show that ``done`` of ``total`` candidates are dealt with, ``pruned`` of them before their end."""
        if self._quiet or time.monotonic() - self._start < PATIENCE or total == 0:
            return
        if self._bar is None:
            from rich.console import Console  # noqa: PLC0415 — only a terminal needs it
            from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn  # noqa: PLC0415

            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.completed:,.0f}/{task.total:,.0f}"),
                TextColumn("{task.fields[rate]:,.0f}/s"),
                TextColumn("{task.fields[pruned]}"),
                TimeRemainingColumn(),
                console=Console(stderr=True),
                transient=True,
            )
            self._bar.start()
            self._task = self._bar.add_task(self._label, total=total, rate=0.0, pruned="")
        if self._task is not None:
            rate = done / max(time.monotonic() - self._start, 1e-9)
            share = "" if pruned is None else f"{100 * pruned / max(done, 1):.1f} % pruned"
            self._bar.update(self._task, completed=done, total=total, rate=rate, pruned=share)
        if done >= total:
            # The next search of the same job starts a bar of its own.
            self._stop()

    def say(self, label: str) -> None:
        """Name what comes next."""
        self._label = label
        if not self._quiet:
            print(label, file=sys.stderr)

    def _stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()
        self._bar = self._task = None
        self._start = time.monotonic()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()
