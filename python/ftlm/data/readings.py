"""What was read and what was not: samples that are missing, and rows at times of their own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ftlm.base.arrays import Floats
from ftlm.base.errors import DataError
from ftlm.data.samples import FEWEST_ROWS, HELD, Intersample, Pieces, grid_of

#: What becomes of rows and cells that are not there.
Missing = Literal["refuse", "weight", "hold"]
MISSING: tuple[Missing, ...] = ("refuse", "weight", "hold")
#: Rows lie on a grid with holes where each is within this share of a step of a place on it.
ON_GRID = 0.02
#: A row within this share of the duration of a grid's end is there.
_THERE = 1e-12


def checked_missing(given: object) -> Missing:
    """Return what to do about what is missing, and refuse words that say nothing."""
    for known in MISSING:
        if given == known:
            return known
    raise DataError(
        f"missing={given!r} is unknown; use 'refuse', 'weight' (outputs that were not read weigh nothing) or 'hold' "
        "(inputs hold their last value besides)"
    )


def unread(values: Floats) -> NDArray[np.bool_]:
    """Rows that hold no value."""
    return np.asarray(np.isnan(values))


def read(values: Floats) -> Floats:
    """The values that are there."""
    return values[~np.isnan(values)]


def bridged(values: Floats) -> Floats:
    """Samples with straight lines over what is missing, the nearest value at the ends; what is whole stays as it is."""
    gone = np.isnan(values)
    if not gone.any() or gone.all():
        return values
    rows = np.arange(values.size)
    return np.asarray(np.where(gone, np.interp(rows, rows[~gone], values[~gone]), values))


def held(values: Floats, kind: Intersample) -> Floats:
    """An input that goes on where it is not known: with its last value, or in a straight line where it is linear."""
    if kind != HELD:
        return bridged(values)
    gone = np.isnan(values)
    last = np.maximum.accumulate(np.where(gone, 0, np.arange(values.size)))
    return np.asarray(values[last])


def places_on_grid(times: Floats) -> tuple[NDArray[np.intp], float] | None:
    """Place of each row on a regular grid with holes, and its step; None where rows do not lie on one."""
    since = times - times[0]
    usual = float(np.median(np.diff(since)))
    step = usual
    # The first step is off by rounding; the whole record tells it better each time.
    for _ in range(4):
        places = np.rint(since / step).astype(np.intp)
        if places[-1] <= 0:
            return None
        step = float(since @ places) / float(places @ places)
    off = np.abs(since - places * step)
    if off.max() > ON_GRID * step or (np.diff(places) <= 0).any():
        return None
    return places, step


@dataclass(frozen=True, eq=False)
class Readings:
    """Rows at times of their own: commands and outputs as they were recorded, not as a grid has them.

    Parameters
    ----------
    times
        When each row was recorded [s since the first row of the run's grid], ascending from 0.
    data
        Values by signal; outputs are NaN where they were not read.
    """

    times: Floats
    data: dict[str, Floats]

    def means(self, name: str, kind: Intersample, m: int, duration: float, delay: float, before: float) -> Floats:
        """Exact means of an input over m equal pulses of the duration, after a delay [s]."""
        times, values = self._late(name, delay, before)
        step = duration / m
        if kind == HELD:
            return Pieces.of(times, m, step).means(values)
        edges = grid_of(m + 1, step)
        area = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(times))])
        row = np.clip(np.searchsorted(times, edges, side="right") - 1, 0, times.size - 1)
        there = np.interp(edges, times, values)
        return np.asarray(np.diff(area[row] + 0.5 * (values[row] + there) * (edges - times[row])) / step)

    def jumps(self, name: str, delay: float, before: float) -> tuple[Floats, Floats]:
        """Times [s] and sizes of the jumps of a held input, the one from nothing at the start included."""
        times, values = self._late(name, delay, before)
        return times, np.diff(values, prepend=0.0)

    def at(self, name: str, kind: Intersample, times: Floats, delay: float, before: float) -> Floats:
        """Values of an input at some times, after it has changed there."""
        own, values = self._late(name, delay, before)
        if kind != HELD:
            return np.asarray(np.interp(times, own, values))
        # A time and a switch that are one but for rounding are one.
        slack = _THERE * max(float(own[-1]), 1e-300)
        return np.asarray(values[np.maximum(np.searchsorted(own, times + slack, side="right") - 1, 0)])

    def _late(self, name: str, delay: float, before: float) -> tuple[Floats, Floats]:
        if not delay:
            return self.times, self.data[name]
        return np.append(0.0, self.times + delay), np.append(before, self.data[name])

    def compared(self, duration: float) -> NDArray[np.intp]:
        """Rows within a grid of this duration."""
        return np.flatnonzero(self.times <= duration * (1.0 + _THERE))

    def on(self, behaviour: Mapping[str, Intersample], step: float) -> dict[str, Floats]:
        """All signals on a regular grid: held inputs by their means over each interval, all else in straight lines."""
        rows = int(np.floor(float(self.times[-1]) / step + 1e-6)) + 1
        grid, pieces = grid_of(rows, step), Pieces.of(self.times, rows, step)
        return {
            name: pieces.means(values)
            if behaviour.get(name) == HELD
            else np.interp(grid, self.times[~np.isnan(values)], read(values))
            for name, values in self.data.items()
        }

    def part(self, behaviour: Mapping[str, Intersample], start: float, stop: float, step: float) -> Readings:
        """Rows from one time to another [s], and what the inputs were when they began."""
        tiny = 1e-9 * step
        kept = np.flatnonzero((self.times >= start - tiny) & (self.times <= stop + step))
        times, data = np.maximum(self.times[kept] - start, 0.0), {n: v[kept] for n, v in self.data.items()}
        if kept.size == 0 or times[0] > tiny:
            times = np.append(0.0, times)
            begin = np.array([start])
            for name in self.data:
                kind = behaviour.get(name)
                first = np.array([np.nan]) if kind is None else self.at(name, kind, begin, 0.0, 0.0)
                data[name] = np.append(first, data[name])
        return Readings(times, data)

    def changed(self, **changes: Any) -> Readings:
        """The same rows with other signals."""
        return Readings(self.times, {**self.data, **changes})


def few_read(values: Floats) -> bool:
    """Whether too few values are there for anything."""
    return int(np.sum(~np.isnan(values))) < FEWEST_ROWS


def said_missing(thing: str, gone: NDArray[np.bool_], what: str) -> str:
    """What is missing of a signal, and what becomes of it, in a sentence."""
    first, count = int(np.flatnonzero(gone)[0]), int(gone.sum())
    rows = "row holds" if count == 1 else "rows hold"
    return f"{thing}: {count} of {gone.size} {rows} no value, the first is row {first}; {what}"
