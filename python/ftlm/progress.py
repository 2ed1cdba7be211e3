"""Progress of long work on standard error: a bar with rate and time left, shown only where a person can see it."""

from __future__ import annotations

import math
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
#: Who waits longer than this [s] wants to know beforehand how long.
WONDER = 2.0
#: Columns that a bar and its label keep, and from which on a terminal has room for the count of all candidates.
LEAST_BAR, LEAST_LABEL, ROOMY = 10, 12, 100


class Parts(int):
    """A total that stands for a whole, of which a person wants to know the share, not the count."""


#: Work without a count of its own is told in so many parts.
PARTS = Parts(1000)


def left_in_words(seconds: float) -> str:
    """Time left as a person says it: what is behind tells it to a digit, not to a second."""
    if seconds < 90:
        return f"about {rounded(seconds):g} s left"
    if seconds < 5400:
        return f"about {rounded(seconds / 60):g} min left"
    return f"about {rounded(seconds / 3600):g} h left"


def expected_in_words(least: float, most: float) -> str:
    """How long work takes [s] as far as is known beforehand: about so long, between two times, or up to one."""
    low, high = left_in_words(least).split(" ")[1:3], left_in_words(most).split(" ")[1:3]
    if low == high:
        return f"about {' '.join(high)}"
    if least < 1.0:
        return f"up to {' '.join(high)}"
    return f"{low[0]} to {' '.join(high)}" if low[1] == high[1] else f"{' '.join(low)} to {' '.join(high)}"


def rounded(value: float) -> float:
    """Return one of 1, 2, 3, 5, 7 times a power of ten, at least 1."""
    power = 10.0 ** max(math.floor(math.log10(max(value, 1.0))), 0)
    return power * min((1, 2, 3, 5, 7, 10), key=lambda digit: abs(digit * power - value))


class Course:
    """The share of a whole that is done, of work whose parts do not know each other; it never goes back.

    Parameters
    ----------
    told
        Called with (parts done, ``PARTS``); None for nobody.
    """

    def __init__(self, told: Callable[[int, int], None] | None) -> None:
        self._told = told
        self.reached = 0.0
        self._said = -1

    def at(self, share: float) -> None:
        """So much of the whole is done."""
        self.reached = max(self.reached, min(share, 1.0))
        parts = round(PARTS * self.reached)
        if self._told is not None and parts > self._said:
            self._said = parts
            self._told(parts, PARTS)

    def until(self, share: float, sweep: float = 0.5) -> Callable[[int, int], None]:
        """What a part that ends at this share of the whole is to call with (done, total).

        Where it begins to count anew, each sweep takes the same share of what is left.
        """
        begun, last = self.reached, 0.0

        def told(done: int, total: int) -> None:
            nonlocal begun, last
            fraction = done / max(total, 1)
            if fraction < last:
                begun = self.reached
            last = fraction
            self.at(begun + sweep * (share - begun) * fraction)

        return told


class _Bars:
    """The bars of one job: rich draws one display at a time, and several threads may report to it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._shown: RichProgress | None = None

    def start(self, total: int | None) -> TaskID:
        """Add a bar, whose label comes with its first figures."""
        from rich.console import Console  # noqa: PLC0415 — only a terminal needs it
        from rich.progress import BarColumn, Progress, TextColumn  # noqa: PLC0415

        with self._lock:
            if self._shown is None:
                self._shown = Progress(
                    TextColumn("{task.description}"),
                    BarColumn(),
                    TextColumn("{task.fields[counted]}"),
                    TextColumn("{task.fields[pruned]}"),
                    TextColumn("{task.fields[left]}"),
                    console=Console(stderr=True),
                    transient=True,
                )
                self._shown.start()
            return self._shown.add_task("", total=total, counted="", pruned="", left="")

    def update(self, task: TaskID, **state: Any) -> None:
        """Move a bar; its label is cut where bar and figures need the line."""
        with self._lock:
            if self._shown is not None:
                figures = (str(state.get(name, "")) for name in ("counted", "pruned", "left"))
                room = max(self._shown.console.width - sum(len(f) + 1 for f in figures) - LEAST_BAR, LEAST_LABEL)
                label = str(state["description"])
                label = label if len(label) <= room else f"{label[: room - 1].rstrip(' ,')}…"
                self._shown.update(task, **state | {"description": label})

    @property
    def width(self) -> int:
        """Columns of the terminal."""
        with self._lock:
            return 0 if self._shown is None else self._shown.console.width

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
            self._task = self._bars.start(total)
        passed = max(time.monotonic() - self._start, 1e-9)
        counted = f"{100 * done // total:.0f} %"
        # Of work without a count of its own a person wants to know the share alone.
        if not isinstance(total, Parts):
            counted += f" of {total:,.0f}" if self._bars.width >= ROOMY else ""
            counted += f" {done / passed:,.0f}/s"
        share = "" if pruned is None else f"{100 * pruned / max(done, 1):.1f} % pruned"
        left = left_in_words(passed * (total - done) / done) if 0 < done < total else ""
        state = {"description": self._label, "counted": counted, "pruned": share, "left": left}
        self._bars.update(self._task, completed=done, total=total, **state)
        if done >= total:
            # The next search of the same job starts a bar of its own.
            self._stop()

    def beside(self) -> Progress:
        """Another bar on the same display, for work that another thread does at the same time."""
        other = Progress(self._label, quiet=self._quiet)
        other._bars = self._bars
        return other

    def so_far(self, done: int, known: int) -> None:
        """Show how much is done of work that grows as it is done: nobody knows its end, so none is shown."""
        passed = time.monotonic() - self._start
        if self._quiet or passed < PATIENCE:
            return
        if self._task is None:
            self._task = self._bars.start(None)
        state = {"description": self._label, "counted": f"{done} of {known} so far", "left": f"after {passed:.0f} s"}
        self._bars.update(self._task, **state)

    @property
    def quiet(self) -> bool:
        """Whether nobody sees it."""
        return self._quiet

    def expect(self, what: str, least: float, most: float | None = None) -> None:
        """Say beforehand about how long it takes, or between which times [s], where that is long enough to wonder."""
        most = least if most is None else most
        if not self._quiet and most >= WONDER:
            print(f"{what} takes {expected_in_words(least, most)}; Ctrl-C ends it", file=sys.stderr)

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
