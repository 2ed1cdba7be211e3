"""Progress bars for long computations on standard error, and cancellation of such computations."""

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

#: Time after which a progress bar appears; shorter work shows no bar.
BAR_DELAY_S = 1.0
#: Minimum estimated duration of work that is announced before its start.
ANNOUNCEMENT_THRESHOLD_S = 2.0
#: Minimum width of a bar, minimum width of its label, and minimum width of a terminal that shows the total count
#: [columns].
MIN_BAR_COLUMNS, MIN_LABEL_COLUMNS, WIDE_TERMINAL_COLUMNS = 10, 12, 100


class PercentTotal(int):
    """Total number of parts for which a progress bar shows only a percentage, without counts."""


#: Total number of parts of work that has no natural units to count.
TOTAL_PARTS = PercentTotal(1000)


def format_time_left(seconds: float) -> str:
    """Return text on a remaining time [s], such as "about 3 min left", with one significant digit."""
    if seconds < 90:
        return f"about {round_coarsely(seconds):g} s left"
    if seconds < 5400:
        return f"about {round_coarsely(seconds / 60):g} min left"
    return f"about {round_coarsely(seconds / 3600):g} h left"


def format_duration_estimate(shortest: float, longest: float) -> str:
    """Return text on a duration estimated between `shortest` and `longest` [s]: a value, a range or an upper bound."""
    low, high = format_time_left(shortest).split(" ")[1:3], format_time_left(longest).split(" ")[1:3]
    if low == high:
        return f"about {' '.join(high)}"
    if shortest < 1.0:
        return f"up to {' '.join(high)}"
    return f"{low[0]} to {' '.join(high)}" if low[1] == high[1] else f"{' '.join(low)} to {' '.join(high)}"


def round_coarsely(value: float) -> float:
    """Return a value rounded to 1, 2, 3, 5 or 7 times a power of ten, at least 1."""
    power = 10.0 ** max(math.floor(math.log10(max(value, 1.0))), 0)
    return power * min((1, 2, 3, 5, 7, 10), key=lambda digit: abs(digit * power - value))


class FractionTracker:
    """Tracker of the completed fraction of work that consists of several parts. The fraction never decreases.

    Parameters
    ----------
    listener
        Callback that is called with (completed parts, ``TOTAL_PARTS``); None for no reports.
    """

    def __init__(self, listener: Callable[[int, int], None] | None) -> None:
        self._listener = listener
        self.fraction = 0.0
        self._reported_parts = -1

    def advance_to(self, fraction: float) -> None:
        """Report that the fraction `fraction` of the whole work is completed; a decrease is ignored."""
        self.fraction = max(self.fraction, min(fraction, 1.0))
        parts = round(TOTAL_PARTS * self.fraction)
        if self._listener is not None and parts > self._reported_parts:
            self._reported_parts = parts
            self._listener(parts, TOTAL_PARTS)

    def subtask(self, end_fraction: float, pass_fraction: float = 0.5) -> Callable[[int, int], None]:
        """Return a callback (done, total) for a part of the work that ends at the fraction `end_fraction` of the whole.

        The part may count from 0 to its total several times. Each such pass then covers the fraction `pass_fraction` of
        the remaining work of the part.
        """
        first, last = self.fraction, 0.0

        def report_subtask(count: int, total: int) -> None:
            nonlocal first, last
            fraction = count / max(total, 1)
            if fraction < last:
                first = self.fraction
            last = fraction
            self.advance_to(first + pass_fraction * (end_fraction - first) * fraction)

        return report_subtask


def _start_bar() -> RichProgress:
    """Start a progress bar on standard error without label and numbers, and return it."""
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
        # The bar replaced the standard streams. The new ones must escape control characters as well.
        escape_standard_streams()
    return bar


class Progress:
    """Progress bar: a context manager and a callback with (done, total) or (done, total, pruned).

    Parameters
    ----------
    label
        Description of the work.
    quiet
        Whether to show no progress bar. Without a terminal, no bar is shown in any case.
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
        """Show that ``count`` of ``total`` candidates are completed, of which ``pruned`` were excluded early."""
        if self._quiet or time.monotonic() - self._start < BAR_DELAY_S or total == 0:
            return
        elapsed = max(time.monotonic() - self._start, 1e-9)
        text = f"{100 * count // total:.0f} %"
        # For work without natural units, only the percentage is shown.
        if not isinstance(total, PercentTotal):
            text += f" of {total:,.0f}" if self._current_bar().console.width >= WIDE_TERMINAL_COLUMNS else ""
            text += f" {count / elapsed:,.0f}/s"
        pruned_text = "" if pruned is None else f"{100 * pruned / max(count, 1):.1f} % pruned"
        time_left = format_time_left(elapsed * (total - count) / count) if 0 < count < total else ""
        self._show(text, pruned_text, time_left, completed=count, total=total)
        if count >= total:
            # The next search of the same job starts a new bar.
            self._stop()

    def show_count(self, count: int, total: int) -> None:
        """Show that ``count`` of ``total`` parts are completed, for work whose total may still increase."""
        elapsed = time.monotonic() - self._start
        if self._quiet or elapsed < BAR_DELAY_S:
            return
        self._show(f"{count} of {total} so far", time_left=f"after {elapsed:.0f} s")

    @property
    def quiet(self) -> bool:
        """Whether the progress bar is hidden."""
        return self._quiet

    def announce(self, label: str, shortest: float, longest: float | None = None) -> None:
        """Print the estimated duration of the work `label`, from `shortest` to `longest` [s], if it is long."""
        longest = shortest if longest is None else longest
        if not self._quiet and longest >= ANNOUNCEMENT_THRESHOLD_S:
            print(f"{label} takes {format_duration_estimate(shortest, longest)}; Ctrl-C ends it", file=sys.stderr)

    def set_label(self, label: str) -> None:
        """Set the label of the bar."""
        self._label = label

    def print_label(self, label: str) -> None:
        """Set the label of the bar and print it."""
        self.set_label(label)
        if not self._quiet:
            print(label, file=sys.stderr)

    def _current_bar(self) -> RichProgress:
        """Return the progress bar, which is created at the first call."""
        with self._lock:
            self._bar = self._bar or _start_bar()
            return self._bar

    def _show(self, text: str, pruned: str = "", time_left: str = "", **state: Any) -> None:
        """Update the texts of the bar; the label is truncated to the width of the terminal."""
        bar, columns = self._current_bar(), len(text) + len(pruned) + len(time_left) + 3
        width = max(bar.console.width - columns - MIN_BAR_COLUMNS, MIN_LABEL_COLUMNS)
        label = escape_controls(self._label)
        label = label if len(label) <= width else f"{label[: width - 1].rstrip(' ,')}…"
        bar.update(bar.task_ids[0], description=label, counted=text, pruned=pruned, left=time_left, **state)

    def _stop(self) -> None:
        with self._lock:
            if self._bar is not None:
                self._bar.stop()
            self._bar = None
        self._start = time.monotonic()

    def __exit__(self, *_: object) -> None:
        self._stop()


class CancellableProgress(Progress):
    """Progress callback for work in another thread, which can also cancel this work.

    Parameters
    ----------
    listener
        Callback that receives the reports; None for no reports.
    stop
        Event that cancels the work: its next report raises KeyboardInterrupt. An event is required because signals
        reach only the main thread.
    """

    def __init__(self, listener: Callable[[int, int], None] | None, stop: threading.Event) -> None:
        super().__init__("", quiet=True)
        self._listener = listener
        self._stop_event = stop

    def __call__(self, count: int, total: int, pruned: int | None = None) -> None:
        """Forward a report to the listener; raise KeyboardInterrupt if the stop event is set."""
        if self._stop_event.is_set():
            raise KeyboardInterrupt
        if isinstance(self._listener, Progress):
            self._listener(count, total, pruned)
        elif self._listener is not None:
            self._listener(count, total)
