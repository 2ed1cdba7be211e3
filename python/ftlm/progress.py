"""Progress of long computations on standard error, as bars on terminals, and cancellation."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ftlm.utils.formatting import EscapedStream, escape_controls, escape_standard_streams

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress

#: Work that ends sooner shows no bar.
BAR_DELAY_S = 1.0
#: Work that takes longer [s] is announced with its estimated duration.
ANNOUNCEMENT_THRESHOLD_S = 2.0
#: Minimum width of a bar and of its label, and terminal width from which the count of candidates is shown [columns].
MIN_BAR_COLUMNS, MIN_LABEL_COLUMNS, WIDE_TERMINAL_COLUMNS = 10, 12, 100


class ShareTotal(int):
    """Total for which the bar shows a percentage instead of a count."""


#: Total of work without a natural count.
TOTAL_PARTS = ShareTotal(1000)


def format_time_left(seconds: float) -> str:
    """Return a remaining time [s] as text with one digit."""
    if seconds < 90:
        return f"about {round_coarsely(seconds):g} s left"
    if seconds < 5400:
        return f"about {round_coarsely(seconds / 60):g} min left"
    return f"about {round_coarsely(seconds / 3600):g} h left"


def format_duration_estimate(least: float, most: float) -> str:
    """Return an estimated duration [s] as text: about one value, a range, or an upper bound."""
    low, high = format_time_left(least).split(" ")[1:3], format_time_left(most).split(" ")[1:3]
    if low == high:
        return f"about {' '.join(high)}"
    if least < 1.0:
        return f"up to {' '.join(high)}"
    return f"{low[0]} to {' '.join(high)}" if low[1] == high[1] else f"{' '.join(low)} to {' '.join(high)}"


def round_coarsely(value: float) -> float:
    """Return a value rounded to 1, 2, 3, 5 or 7 times a power of ten, at least 1."""
    power = 10.0 ** max(math.floor(math.log10(max(value, 1.0))), 0)
    return power * min((1, 2, 3, 5, 7, 10), key=lambda digit: abs(digit * power - value))


class ShareTracker:
    """Fraction of completed work with independent parts, which never decreases.

    Parameters
    ----------
    listener
        Callback with (parts done, ``TOTAL_PARTS``); None for no reports.
    """

    def __init__(self, listener: Callable[[int, int], None] | None) -> None:
        self._listener = listener
        self.reached = 0.0
        self._reported_parts = -1

    def advance_to(self, share: float) -> None:
        """Report that a fraction of the whole work is done."""
        self.reached = max(self.reached, min(share, 1.0))
        parts = round(TOTAL_PARTS * self.reached)
        if self._listener is not None and parts > self._reported_parts:
            self._reported_parts = parts
            self._listener(parts, TOTAL_PARTS)

    def subtask(self, share: float, sweep: float = 0.5) -> Callable[[int, int], None]:
        """Return a callback (done, total) for a part of the work; the part ends at a fraction `share` of the whole.

        If the part restarts its count, each pass takes the fraction `sweep` of the remainder.
        """
        first, last = self.reached, 0.0

        def report_subtask(count: int, total: int) -> None:
            nonlocal first, last
            fraction = count / max(total, 1)
            if fraction < last:
                first = self.reached
            last = fraction
            self.advance_to(first + sweep * (share - first) * fraction)

        return report_subtask


def _start_bar() -> RichProgress:
    """Return a progress bar on the terminal, without label, total and figures."""
    from rich.console import Console  # noqa: PLC0415 — only a terminal needs it
    from rich.progress import BarColumn, Progress, TextColumn  # noqa: PLC0415

    stream: Any = sys.stderr
    escaped = isinstance(stream, EscapedStream)
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[counted]}"),
        TextColumn("{task.fields[pruned]}"),
        TextColumn("{task.fields[left]}"),
        console=Console(file=stream.stream) if escaped else Console(stderr=True),
        transient=True,
    )
    bar.add_task("", total=None, counted="", pruned="", left="")
    bar.start()
    if escaped:
        # The display has put streams of its own in place, which print above the bar.
        escape_standard_streams()
    return bar


class Progress:
    """Progress bar: a context manager that is called with (done, total) or (done, total, pruned).

    Parameters
    ----------
    label
        Description of the work.
    quiet
        Whether to show nothing.
    """

    def __init__(self, label: str, *, quiet: bool = False) -> None:
        self._label = label
        self._quiet = quiet or not sys.stderr.isatty()
        self._start = time.monotonic()
        self._bar: RichProgress | None = None
        self._lock = threading.Lock()

    def __enter__(self) -> Progress:
        return self

    def __call__(self, count: int, total: int, pruned: int | None = None) -> None:
        """Show ``count`` of ``total`` candidates, ``pruned`` of them excluded early."""
        if self._quiet or time.monotonic() - self._start < BAR_DELAY_S or total == 0:
            return
        passed = max(time.monotonic() - self._start, 1e-9)
        text = f"{100 * count // total:.0f} %"
        # For work without countable units only the fraction is shown.
        if not isinstance(total, ShareTotal):
            text += f" of {total:,.0f}" if self._current_bar().console.width >= WIDE_TERMINAL_COLUMNS else ""
            text += f" {count / passed:,.0f}/s"
        share = "" if pruned is None else f"{100 * pruned / max(count, 1):.1f} % pruned"
        time_left = format_time_left(passed * (total - count) / count) if 0 < count < total else ""
        self._show(text, share, time_left, completed=count, total=total)
        if count >= total:
            # The next search of the same job starts a bar of its own.
            self._stop()

    def so_far(self, count: int, total: int) -> None:
        """Show the progress of work whose total number may still increase."""
        passed = time.monotonic() - self._start
        if self._quiet or passed < BAR_DELAY_S:
            return
        self._show(f"{count} of {total} so far", time_left=f"after {passed:.0f} s")

    @property
    def quiet(self) -> bool:
        """Whether nothing is shown."""
        return self._quiet

    def expect(self, what: str, least: float, most: float | None = None) -> None:
        """Show the estimated duration [s], or its range, of long work."""
        most = least if most is None else most
        if not self._quiet and most >= ANNOUNCEMENT_THRESHOLD_S:
            print(f"{what} takes {format_duration_estimate(least, most)}; Ctrl-C ends it", file=sys.stderr)

    def name(self, label: str) -> None:
        """Set the label of the bar."""
        self._label = label

    def say(self, label: str) -> None:
        """Set the label of the bar and print it."""
        self.name(label)
        if not self._quiet:
            print(label, file=sys.stderr)

    def _current_bar(self) -> RichProgress:
        """Return the bar, which is created when the first figures are shown."""
        with self._lock:
            self._bar = self._bar or _start_bar()
            return self._bar

    def _show(self, text: str, pruned: str = "", time_left: str = "", **state: Any) -> None:
        """Show figures; the label is truncated to the width of the line."""
        bar, columns = self._current_bar(), len(text) + len(pruned) + len(time_left) + 3
        room = max(bar.console.width - columns - MIN_BAR_COLUMNS, MIN_LABEL_COLUMNS)
        label = escape_controls(self._label)
        label = label if len(label) <= room else f"{label[: room - 1].rstrip(' ,')}…"
        bar.update(bar.task_ids[0], description=label, counted=text, pruned=pruned, left=time_left, **state)

    def _stop(self) -> None:
        with self._lock:
            if self._bar is not None:
                self._bar.stop()
            self._bar = None
        self._start = time.monotonic()

    def __exit__(self, *_: object) -> None:
        self._stop()


class Stoppable(Progress):
    """Progress callback that another thread calls, and that can cancel the work of that thread.

    Parameters
    ----------
    listener
        Receiver of the reports.
    stop
        Event that ends the work with KeyboardInterrupt at its next report. Signals reach only the main thread.
    """

    def __init__(self, listener: Callable[[int, int], None] | None, stop: threading.Event) -> None:
        super().__init__("", quiet=True)
        self._listener = listener
        self._ended = stop

    def __call__(self, count: int, total: int, pruned: int | None = None) -> None:
        """Forward a report to the listener, or raise KeyboardInterrupt if the work is cancelled."""
        if self._ended.is_set():
            raise KeyboardInterrupt
        if isinstance(self._listener, Progress):
            self._listener(count, total, pruned)
        elif self._listener is not None:
            self._listener(count, total)
