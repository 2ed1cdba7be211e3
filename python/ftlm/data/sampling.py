"""Samples checked once: numbers, lengths, a regular time, a window, another step."""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, cast

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from ftlm.errors import DataError
from ftlm.utils.validation import Floats, as_mapping, bad_rows, listed, nearest

Intersample: TypeAlias = Literal["zoh", "foh"]
# Values are squared by every estimator; beyond this the square leaves double precision.
LARGEST = 1e150
FEWEST_ROWS = 3
_MOST_ROWS = 50_000_000
_SMALLEST_STEP, _LARGEST_STEP = 1e-30, 1e30
_JITTER = 0.02
_JITTER_WORTH_SAYING = 1e-3
_GAP = 1.5
# A limit typed by a person (1.1 s) must catch the row it names although t - t0 is off by a rounding error.
_EDGE = 1e-6
HELD: Intersample = "zoh"


def grid_of(rows: int, step: float) -> Floats:
    """Regular times from 0 [s]."""
    return np.arange(rows, dtype=np.float64) * step


def locked(values: Floats) -> Floats:
    """Return numbers that nobody can change any more, without a copy."""
    owner = np.ascontiguousarray(values)
    if owner.flags.writeable:
        owner.setflags(write=False)
    # A view of a locked array cannot be unlocked by the one who holds it.
    return owner.view()


def is_constant(values: Floats) -> bool:
    """Whether all samples that are there are equal."""
    there = values[~np.isnan(values)]
    return bool((there == there[:1]).all())


def checked_intersample(given: Mapping[str, str] | None, inputs: tuple[str, ...]) -> dict[str, Intersample]:
    """Return what was said of inputs between rows, and refuse words that say nothing."""
    checked: dict[str, Intersample] = {}
    for signal, kind in as_mapping("intersample", {} if given is None else given).items():
        if signal not in inputs:
            raise DataError(
                f"intersample=: {signal!r} is not an input{nearest(signal, inputs)}; the inputs are {listed(inputs)}"
            )
        if kind != "zoh" and kind != "foh":  # noqa: PLR1714 — the type checker follows this
            raise DataError(
                f"intersample=: {kind!r} of input {signal!r} is unknown; use 'zoh' (held) or 'foh' (linear)"
            )
        checked[signal] = kind
    return checked


def checked_step(step: object, argument: str) -> float:
    """Return a time between rows [s]."""
    value = as_number(step)
    if value is None:
        raise DataError(f"{argument}={step!r} is not a number; give the time between rows in s")
    if not _SMALLEST_STEP <= value <= _LARGEST_STEP:
        raise DataError(f"{argument}={value!r} is not a positive, finite time; give the time between rows in s")
    return value


def as_number(given: object) -> float | None:
    """Return a real number as a float, infinity for one beyond its range, None for anything else."""
    if isinstance(given, bool) or not isinstance(given, (int, float, np.integer, np.floating)):
        return None
    try:
        return float(given)
    except OverflowError:
        return math.inf


def as_vector(given: object, thing: str, *, gaps: bool = False) -> tuple[Floats, np.dtype[Any]]:
    """Return a private float64 copy and the type the numbers came in; with gaps, what is masked or None is NaN."""
    if gaps and isinstance(given, (list, tuple)):
        given = [np.nan if value is None else value for value in given]
    if gaps and np.ma.isMaskedArray(given) and np.asarray(given).dtype.kind in "biuf":
        given = np.ma.filled(np.ma.asarray(given, dtype=np.float64), np.nan)
    if np.ma.isMaskedArray(given):
        mask = np.ma.getmaskarray(cast("Any", given))
        if mask.any():
            rows = np.flatnonzero(mask)
            fill = "remove or fill these rows yourself"
            raise bad_rows(thing, "masked (missing) value", int(rows[0]), rows.size, fill)
    try:
        array = np.asarray(given)
        # pandas columns that allow missing values come as objects although they hold numbers.
        if array.dtype.kind == "O" and getattr(getattr(given, "dtype", None), "kind", "O") in "biuf":
            array = cast("Any", given).to_numpy(dtype=np.float64, na_value=np.nan)
    except (ValueError, TypeError, OverflowError) as error:
        raise DataError(f"{thing}: not an array of numbers ({error}); pass one number per row") from None
    if array.dtype.kind in "USTO" or (array.ndim == 1 and array.dtype.kind in "MmV"):
        raise _not_numbers(given, array, thing)
    if array.ndim != 1:
        raise DataError(
            f"{thing}: shape {array.shape}, not one-dimensional; pass one column at a time, such as x[:, 0]"
        )
    if array.size == 0:
        raise DataError(f"{thing}: empty, 0 rows; {FEWEST_ROWS} are needed")
    if array.dtype.kind == "c":
        rows = np.flatnonzero(np.imag(array) != 0)
        first, count = (int(rows[0]), rows.size) if rows.size else (0, array.size)
        raise bad_rows(thing, f"complex number {array[first]}", first, count, "pass a real array, such as x.real")
    if array.dtype.kind not in "biuf":
        raise _not_numbers(given, array, thing)
    with np.errstate(over="ignore"):
        return np.array(array, dtype=np.float64, order="C"), array.dtype


def as_seconds(given: object, thing: str) -> tuple[Floats, str] | None:
    """Return dates as seconds since the first and its words, lapses of time as seconds; None for anything else."""
    try:
        array = np.asarray(given)
        first = array.flat[0] if array.dtype.kind == "O" and array.size else None
        if isinstance(first, datetime.date):
            # Dates with a time zone are in universal time then, as pandas knows and NumPy does not.
            plain = getattr(given, "dtype", None) is not None and array.dtype != getattr(given, "dtype", None)
            array = np.asarray(given if plain else [_universal(moment) for moment in array.tolist()], "datetime64[ns]")
    except (ValueError, TypeError, OverflowError) as error:
        raise DataError(f"{thing}: not one date per row ({error}); pass datetime64, or seconds") from None
    if array.dtype.kind not in "mM" or array.ndim != 1 or array.size == 0:
        return None
    gone = np.flatnonzero(np.isnat(array))
    if gone.size:
        raise bad_rows(thing, "no date", int(gone[0]), gone.size, "remove or fill these rows yourself")
    lapses = array - array[0] if array.dtype.kind == "M" else array
    nanoseconds = lapses.astype("timedelta64[ns]")
    if (nanoseconds.astype(lapses.dtype) != lapses).any():
        raise DataError(f"{thing}: from {array.min()} to {array.max()} there are more nanoseconds than can be counted")
    words = f"time counted from {array[0]} on" if array.dtype.kind == "M" else ""
    return nanoseconds.astype(np.int64) / 1e9, words


def _universal(moment: Any) -> Any:
    """A date in universal time, where it has a zone."""
    zone = getattr(moment, "tzinfo", None)
    return moment if zone is None else moment.astimezone(datetime.UTC).replace(tzinfo=None)


def _not_numbers(given: object, array: npt.NDArray[Any], thing: str) -> DataError:
    if array.dtype.kind in "Mm":
        return bad_rows(thing, f"dates, not numbers ({array.dtype})", 0, array.size, "convert them to seconds first")
    if array.ndim == 0:
        return DataError(f"{thing}: {_short(array.item())} is not an array; pass one number per row")
    # A list of numbers and words has become an array of words; the list still tells them apart.
    flat = list(given) if isinstance(given, (list, tuple)) and array.ndim == 1 else array.ravel().tolist()
    bad = [index for index, value in enumerate(flat) if not isinstance(value, (int, float, np.number, np.bool_))]
    if not bad:
        what = f"objects, not numbers (dtype {array.dtype})"
        return bad_rows(thing, what, 0, len(flat), "use np.asarray(x, dtype=float)")
    what = "missing value None" if flat[bad[0]] is None else f"{_short(flat[bad[0]])} is not a number"
    return bad_rows(thing, what, bad[0], len(bad), "convert it to numbers first")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "…" + text[-1]


def check_lengths(lengths: Mapping[str, int]) -> None:
    """Refuse columns of different lengths; what most of them have is taken as right."""
    counts = list(lengths.values())
    expected = max(set(counts), key=lambda count: (counts.count(count), count))
    wrong = [(thing, count) for thing, count in lengths.items() if count != expected]
    if wrong:
        thing, count = wrong[0]
        raise DataError(
            f"{thing}: {count} rows where {expected} are expected, {len(wrong)} of {len(lengths)} columns differ; "
            "give every column one number per row of the same record"
        )


def trend_of(values: Floats, step: float, *, linear: bool) -> tuple[Callable[[Floats], Floats], str]:
    """The mean of samples or their line of least squares as a function of time, and in words."""
    there = ~np.isnan(values)
    mean = float(np.mean(values[there]))
    if not linear:
        return (lambda t: np.full(t.size, mean)), f"{mean:.6g}"
    clock = np.arange(values.size) * step
    middle = float(np.mean(clock[there]))
    late = clock[there] - middle
    slope = float(late @ (values[there] - mean)) / float(late @ late)
    sign = "-" if slope < 0 else "+"
    return (lambda t: mean + slope * (t - middle)), f"{mean - slope * middle:.6g} {sign} {abs(slope):.6g} t"


def check_values(
    values: Floats, thing: str, offset: int, *, gaps: bool = False, instead: str = "avoid them with slice="
) -> None:
    """Refuse what is not finite, and numbers whose squares overflow; ``offset`` is the number of the first row.

    With gaps, NaN is let pass; ``instead`` is the other way out for what is NaN.
    """
    with np.errstate(invalid="ignore"):
        good = np.abs(values) <= LARGEST
    if gaps:
        good |= np.isnan(values)
    if good.all():
        return
    rows = np.flatnonzero(~good)
    value = float(values[rows[0]])
    first, count = offset + int(rows[0]), rows.size
    if math.isnan(value):
        raise bad_rows(thing, "NaN", first, count, f"remove or fill these rows yourself, or {instead}")
    if math.isinf(value):
        raise bad_rows(thing, f"infinity ({value})", first, count, "correct these rows, or avoid them with slice=")
    what = f"{value!r} is larger than {LARGEST:g} and its square overflows"
    raise bad_rows(thing, what, first, count, "correct these rows, scale the signal, or avoid them with slice=")


def check_increasing(clock: Floats, thing: str, offset: int) -> None:
    """Refuse a time that stands still or goes back."""
    steps = np.diff(clock)
    if (steps > 0).all():
        return
    before = int(np.flatnonzero(~(steps > 0))[0])
    row, (earlier, later) = offset + before + 1, clock[before : before + 2].tolist()
    if steps[before] == 0:
        way_out = "remove the repeated rows, or write the time with more digits"
        raise bad_rows(thing, f"repeated time {later!r} s", row, int((steps == 0).sum()), way_out)
    way_out = "sort the rows, or split the file where the clock starts again"
    raise bad_rows(thing, f"decreasing time, {later!r} s after {earlier!r} s", row, int((steps < 0).sum()), way_out)


def regular_step(
    clock: Floats, thing: str, offset: int, resolution: float, known: float | None
) -> tuple[float, tuple[str, ...]]:
    """Return the step of a regular time, in digits that read well, and what there is to say of its jitter."""
    count = clock.size - 1
    since = clock - clock[0]
    mean = float(since[-1]) / count
    if not _SMALLEST_STEP <= mean <= _LARGEST_STEP:
        raise DataError(f"{thing}: the mean step {mean!r} s cannot be used; check the unit of the time")
    deviation = np.abs(since - grid_of(clock.size, mean))
    worst = float(deviation.max())
    if worst > _JITTER * mean:
        steps = np.diff(clock)
        usual = float(np.median(steps))
        gaps = np.flatnonzero(steps > _GAP * usual)
        if gaps.size:
            what = f"gap of {steps[gaps[0]]:.6g} s where {usual:.6g} s is usual"
            way_out = (
                "load the part before or after it with slice=, let the rows be missing with missing='hold', or put "
                "the inputs on a regular grid with resample=STEP"
            )
            raise bad_rows(thing, what, offset + int(gaps[0]) + 1, gaps.size, way_out)
        rows = np.flatnonzero(deviation > _JITTER * mean)
        share = f"{100.0 * worst / mean:.3g} % of the mean step {mean:.6g} s ({100 * _JITTER:g} % allowed)"
        way_out = "put the inputs on a regular grid with resample=STEP; outputs are compared when they were read"
        raise bad_rows(thing, f"jitter of up to {share}", offset + int(rows[0]), rows.size, way_out)
    fact: tuple[str, ...] = ()
    if worst > _JITTER_WORTH_SAYING * mean:
        row = offset + int(deviation.argmax())
        share = f"{100.0 * worst / mean:.2g} % of a step, the most at row {row}"
        fact = (f"time jitters by up to {share}; it was taken as regular",)
    if known is not None:
        if not abs(known - mean) * count <= max(4.0 * resolution, 2.0 * worst, 1e-8 * mean):
            raise DataError(
                f"{thing}: the mean step is {mean!r} s where the file's header says {known!r} s; "
                "correct the header, or remove its first line and name the columns"
            )
        return known, fact
    return _short_decimal(mean, count, 4.0 * resolution, 2.0 * worst), fact


def _short_decimal(mean: float, count: int, rounding: float, observed: float) -> float:
    """Return the shortest decimal number that explains the times as well as their mean step does, or the mean step."""
    for digits in range(12):
        short = float(f"{mean:.{digits}e}")
        drift = abs(short - mean) * count
        if drift <= rounding or (drift <= observed and abs(short - mean) <= 1e-9 * mean):
            return short
    return mean


def window_rows(clock: Floats, window: object, argument: str, thing: str = "time") -> tuple[int, int]:
    """Return the first row and the row after the last one of start ≤ t < stop."""
    if not isinstance(window, Sequence) or isinstance(window, str) or len(window) != 2:
        raise DataError(f"{argument}={window!r} is not a pair (start, stop) of seconds; use None for an open end")
    limits: list[float | None] = []
    for limit in window:
        value = as_number(limit)
        if value is None and limit is not None:
            raise DataError(f"{argument}: limit {limit!r} is not a number of seconds")
        if value is not None and not math.isfinite(value):
            raise DataError(f"{argument}: limit {value!r} is not finite; use None for an open end")
        limits.append(value)
    start, stop = limits
    ends = clock[[0, -1]]
    if not np.isfinite(ends).all():
        row, count = 0 if not np.isfinite(ends[0]) else clock.size - 1, int((~np.isfinite(clock)).sum())
        way_out = "remove these rows; slice= counts from the first time"
        raise bad_rows(thing, "the first or last time is not finite", row, count, way_out)
    with np.errstate(over="ignore", invalid="ignore"):
        since = clock - clock[0]
        steps = np.diff(since)
        # The median is the step although there may be a gap, a repeated or a missing time.
        steps = steps[np.isfinite(steps) & (steps > 0)]
        step = float(np.median(steps)) if steps.size else 0.0
        whole = float(since[-1]) + step
    way_out = f"the record has times from 0 to {whole:.12g} s since its first row"
    for limit in (start, stop):
        if limit is not None and not -_EDGE * step <= limit <= whole + _EDGE * step:
            raise DataError(f"{argument}: limit {limit!r} s is out of range; {way_out}")
    low = 0.0 if start is None else start
    high = math.inf if stop is None else stop
    if low >= high:
        raise DataError(f"{argument}: the limits {start!r} and {stop!r} s do not increase; {way_out}")
    with np.errstate(invalid="ignore"):
        rows = np.flatnonzero((since >= low - _EDGE * step) & (since < high - _EDGE * step))
    if rows.size == 0:
        raise DataError(f"{argument}: no row lies between {start!r} and {stop!r} s; {way_out}")
    return int(rows[0]), int(rows[-1]) + 1


def check_rows(since: Floats, step: float) -> int:
    """Return how many rows of this step a record has, and refuse too many or too few."""
    spans = float(since[-1]) / step
    if spans + 1 > _MOST_ROWS:
        raise DataError(f"resample={step!r} gives more than {_MOST_ROWS} rows; use a larger step")
    rows = math.floor(spans + _EDGE) + 1
    if rows < FEWEST_ROWS:
        raise DataError(f"resample={step!r} leaves {rows} rows, {FEWEST_ROWS} are needed; use a smaller step")
    return rows


def is_regular(since: Floats) -> bool:
    """Whether rows keep to a regular step."""
    step = float(since[-1]) / (since.size - 1)
    return bool(np.abs(since - grid_of(since.size, step)).max() <= _JITTER * step)


def interpolated(
    since: Floats, data: Mapping[str, Floats], behaviour: Mapping[str, Intersample], step: float
) -> dict[str, Floats]:
    """Return signals on another step: of held inputs the mean of the hold over each new interval, all else linearly."""
    rows = check_rows(since, step)
    grid = grid_of(rows, step)
    pieces = Pieces.of(since, rows, step)
    return {
        signal: pieces.means(values) if behaviour.get(signal) == "zoh" else np.interp(grid, since, values)
        for signal, values in data.items()
    }


@dataclass(frozen=True)
class Pieces:
    """New intervals cut at the old rows: the row each piece holds, its share of a step, where each interval begins."""

    row: npt.NDArray[np.intp]
    share: Floats
    first: npt.NDArray[np.intp]

    @classmethod
    def of(cls, since: Floats, rows: int, step: float) -> Pieces:
        """Cut; an old row within rounding of a new one counts as there. The last row holds on."""
        edges = grid_of(rows + 1, step)
        place = np.searchsorted(edges, since, side="left")
        near = np.minimum(place, rows)
        near = np.where((near > 0) & (np.abs(edges[near - 1] - since) <= _EDGE * step), near - 1, near)
        snapped = np.where(np.abs(edges[near] - since) <= _EDGE * step, edges[near], since)
        cuts = np.unique(np.concatenate([edges, snapped[snapped < edges[-1]]]))
        row = np.searchsorted(snapped, cuts[:-1], side="right") - 1
        return cls(row, np.diff(cuts) / step, np.searchsorted(cuts, edges[:-1]))

    def means(self, values: Floats) -> Floats:
        """Exact means of a hold; what does not change within an interval keeps its bits."""
        begin = values[self.row[self.first]]
        counts = np.diff(np.append(self.first, self.row.size))
        risen = (values[self.row] - np.repeat(begin, counts)) * self.share
        return np.asarray(begin + np.add.reduceat(risen, self.first))


def how_interpolated(behaviour: Mapping[str, Intersample]) -> str:
    """Say what :func:`interpolated` does to each signal."""
    held = [signal for signal, kind in behaviour.items() if kind == "zoh"]
    means = f"held: {', '.join(held)}, by means over the new intervals; " if held else ""
    return f"{means}others linear; no anti-alias filter"


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
