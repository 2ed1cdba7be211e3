"""Sampling of runs: regular time grids, data windows, intersample behavior, resampling, and missing samples."""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, cast

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from ftlm import _core
from ftlm.errors import DataError
from ftlm.utils.formatting import plural
from ftlm.utils.parameters import Placeholder, parameter
from ftlm.utils.validation import Floats, Scalar, as_array, as_mapping, bad_rows_error, join_names, nearest

Intersample: TypeAlias = Literal["zoh", "foh"]
# Every estimator squares values; larger ones overflow in double precision.
MAX_SAMPLE_VALUE = 1e150
MIN_RUN_SAMPLES = 3
_MAX_RUN_SAMPLES = 50_000_000
_MIN_STEP_S, _MAX_STEP_S = 1e-30, 1e30
_MAX_JITTER_FRACTION = 0.02
_MIN_REPORTED_JITTER_FRACTION = 1e-3
_GAP_STEP_RATIO = 1.5
# A window limit such as 1.1 s must include its sample although t - t0 has a rounding error.
_EDGE_TOLERANCE_STEPS = 1e-6
ZERO_ORDER_HOLD: Intersample = "zoh"


def uniform_times(rows: int, step: float) -> Floats:
    """Return uniform sample times [s] that start at 0, shape (rows,); `step` is in seconds."""
    return np.arange(rows, dtype=np.float64) * step


def make_read_only(values: NDArray[Scalar]) -> NDArray[Scalar]:
    """Make an array read-only, and return a read-only view of it; an array that is not contiguous is copied first."""
    owner = np.ascontiguousarray(values)
    if owner.flags.writeable:
        owner.setflags(write=False)
    # The caller cannot make a view of a read-only array writeable.
    return owner.view()


def is_constant(values: Floats) -> bool:
    """Whether all samples, except missing ones, are equal."""
    finite = values[~np.isnan(values)]
    return bool((finite == finite[:1]).all())


def check_intersample(kinds: Mapping[str, str] | None, inputs: tuple[str, ...]) -> dict[str, Intersample]:
    """Return the given intersample behaviors, by input; raise DataError for an unknown input or behavior."""
    checked: dict[str, Intersample] = {}
    for signal, kind in as_mapping("intersample", {} if kinds is None else kinds).items():
        if signal not in inputs:
            raise DataError(
                f"{parameter('intersample')}: {signal!r} is not an input{nearest(signal, inputs)}; the inputs are "
                f"{join_names(inputs)}"
            )
        if kind != "zoh" and kind != "foh":  # noqa: PLR1714 — the type checker follows this
            raise DataError(
                f"{parameter('intersample')}: {kind!r} of input {signal!r} is unknown; use 'zoh' (held) or 'foh' "
                "(linear)"
            )
        checked[signal] = kind
    return checked


def check_step(step: object, argument: str) -> float:
    """Return a sampling interval [s] as a float; raise DataError unless it is a number from 1e-30 to 1e30."""
    value = as_number(step)
    if value is None:
        raise DataError(f"{parameter(argument, step)} is not a number; give the time between rows in s")
    if not _MIN_STEP_S <= value <= _MAX_STEP_S:
        raise DataError(f"{parameter(argument, value)} is not a positive, finite time; give the time between rows in s")
    return value


def as_number(value: object) -> float | None:
    """Return a real number as a float, infinity on overflow; None if the value is a bool or not a number."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        return None
    try:
        return float(value)
    except OverflowError:
        return math.inf


def as_vector(values: object, label: str, *, gaps: bool = False) -> tuple[Floats, np.dtype[Any]]:
    """Return a float64 copy of a vector and its original dtype; raise DataError if it is not a vector of numbers.

    With `gaps`, masked values and None become NaN. `label` names the vector in error messages.
    """
    if gaps and isinstance(values, (list, tuple)):
        values = [np.nan if value is None else value for value in values]
    array = as_array(label, values, gaps=gaps)
    # pandas columns that allow missing values come as objects although they hold numbers.
    if array.dtype.kind == "O" and getattr(getattr(values, "dtype", None), "kind", "O") in "biuf":
        array = cast("Any", values).to_numpy(dtype=np.float64, na_value=np.nan)
    if array.dtype.kind in "USTO" or (array.ndim == 1 and array.dtype.kind in "MmV"):
        raise _not_numbers_error(values, array, label)
    if array.ndim != 1:
        raise DataError(
            f"{label}: shape {array.shape}, not one-dimensional; pass one column at a time, such as x[:, 0]"
        )
    if array.size == 0:
        raise DataError(f"{label}: empty, 0 rows; {MIN_RUN_SAMPLES} are needed")
    if array.dtype.kind == "c":
        rows = np.flatnonzero(np.imag(array) != 0)
        first, count = (int(rows[0]), rows.size) if rows.size else (0, array.size)
        raise bad_rows_error(label, f"complex number {array[first]}", first, count, "pass a real array, such as x.real")
    if array.dtype.kind not in "biuf":
        raise _not_numbers_error(values, array, label)
    with np.errstate(over="ignore"):
        return np.array(array, dtype=np.float64, order="C"), array.dtype


def as_seconds(values: object, label: str) -> tuple[Floats, str] | None:
    """Return dates or time differences as seconds, and a note on the subtracted date; None for other types.

    The first date is subtracted from all dates; time differences are only converted, with an empty note. Missing dates
    and spans above 292 years raise DataError. `label` names the time in error messages.
    """
    try:
        array = as_array(label, values)
        first = array.flat[0] if array.dtype.kind == "O" and array.size else None
        if isinstance(first, datetime.date):
            # Dates with a time zone become UTC: a pandas series converts itself, other objects are converted here.
            is_series = getattr(values, "dtype", None) is not None and array.dtype != getattr(values, "dtype", None)
            array = np.asarray(
                values if is_series else [_to_universal_time(date) for date in array.tolist()], "datetime64[ns]"
            )
    except (ValueError, TypeError, OverflowError) as error:
        raise DataError(f"{label}: not one date per row ({error}); pass datetime64, or seconds") from None
    if array.dtype.kind not in "mM" or array.ndim != 1 or array.size == 0:
        return None
    if np.isnat(array).any():
        raise masked_rows_error(label, "no date", np.isnat(array), "remove or fill these rows yourself")
    differences = array - array[0] if array.dtype.kind == "M" else array
    nanoseconds = differences.astype("timedelta64[ns]")
    if (nanoseconds.astype(differences.dtype) != differences).any():
        raise DataError(f"{label}: from {array.min()} to {array.max()} is more than 292 years; split the record")
    note = f"time counted from {array[0]} on" if array.dtype.kind == "M" else ""
    return nanoseconds.astype(np.int64) / 1e9, note


def _to_universal_time(date: Any) -> Any:
    """Return a date with a time zone as UTC without a time zone; return other values unchanged."""
    zone = getattr(date, "tzinfo", None)
    return date if zone is None else date.astimezone(datetime.UTC).replace(tzinfo=None)


def _not_numbers_error(values: object, array: npt.NDArray[Any], label: str) -> DataError:
    if array.dtype.kind in "Mm":
        return bad_rows_error(
            label, f"dates, not numbers ({array.dtype})", 0, array.size, "convert them to seconds first"
        )
    if array.ndim == 0:
        return DataError(f"{label}: {_abbreviate(array.item())} is not an array; pass one number per row")
    # NumPy turns a list of numbers and text into an array of text; the list still distinguishes them.
    flat = list(values) if isinstance(values, (list, tuple)) and array.ndim == 1 else array.ravel().tolist()
    bad = [index for index, value in enumerate(flat) if not isinstance(value, (int, float, np.number, np.bool_))]
    if not bad:
        problem = f"objects, not numbers (dtype {array.dtype})"
        return bad_rows_error(label, problem, 0, len(flat), "use np.asarray(x, dtype=float)")
    problem = "missing value None" if flat[bad[0]] is None else f"{_abbreviate(flat[bad[0]])} is not a number"
    return bad_rows_error(label, problem, bad[0], len(bad), "convert it to numbers first")


def _abbreviate(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "…" + text[-1]


def check_lengths(lengths: Mapping[str, int]) -> None:
    """Raise DataError if lengths differ; the message names the first column without the most frequent length."""
    counts = list(lengths.values())
    expected = max(set(counts), key=lambda count: (counts.count(count), count))
    mismatches = [(label, count) for label, count in lengths.items() if count != expected]
    if mismatches:
        label, count = mismatches[0]
        raise DataError(
            f"{label}: {plural(count, 'row')} where {expected} are expected, {len(mismatches)} of {len(lengths)} "
            "columns differ; give every column one number per row of the same record"
        )


def fit_trend(values: Floats, step: float, *, linear: bool) -> tuple[Callable[[Floats], Floats], str]:
    """Return the mean or, with `linear`, the least-squares line of a signal, as a function of time [s] and as text.

    Time begins at the first sample, and `step` is the sampling interval [s]. Missing samples (NaN) are ignored.
    """
    is_present = ~np.isnan(values)
    mean = float(np.mean(values[is_present]))
    if not linear:
        return (lambda t: np.full(t.size, mean)), f"{mean:.6g}"
    times = np.arange(values.size) * step
    mean_time = float(np.mean(times[is_present]))
    centered_times = times[is_present] - mean_time
    slope = float(centered_times @ (values[is_present] - mean)) / float(centered_times @ centered_times)
    sign = "-" if slope < 0 else "+"
    return (lambda t: mean + slope * (t - mean_time)), f"{mean - slope * mean_time:.6g} {sign} {abs(slope):.6g} t"


def check_values(values: Floats, label: str, offset: int, *, gaps: bool = False, remedy: str | None = None) -> None:
    """Raise DataError if values are not finite, or above 1e150 in magnitude, where squares overflow.

    In the message, `label` names the signal, rows are counted from `offset`, and `remedy` is a remedy for NaN. With
    `gaps`, NaN is accepted.
    """
    with np.errstate(invalid="ignore"):
        if values.size == 0 or (values.min() >= -MAX_SAMPLE_VALUE and values.max() <= MAX_SAMPLE_VALUE):
            return
        is_valid = np.abs(values) <= MAX_SAMPLE_VALUE
    if gaps:
        is_valid |= np.isnan(values)
    if is_valid.all():
        return
    rows = np.flatnonzero(~is_valid)
    value = float(values[rows[0]])
    first, count = offset + int(rows[0]), rows.size
    advice = f"avoid them with {parameter('window')}"
    if math.isnan(value):
        raise bad_rows_error(label, "NaN", first, count, f"remove or fill these rows yourself, or {remedy or advice}")
    if math.isinf(value):
        raise bad_rows_error(
            label, f"infinity ({value})", first, count, f"correct these rows, or avoid them with {parameter('window')}"
        )
    problem = f"{value!r} is larger than {MAX_SAMPLE_VALUE:g} and its square overflows"
    raise bad_rows_error(
        label, problem, first, count, f"correct these rows, scale the signal, or avoid them with {parameter('window')}"
    )


def masked_rows_error(label: str, problem: str, is_bad: NDArray[np.bool_], remedy: str, offset: int = 0) -> DataError:
    """Return a DataError that names the first row where `is_bad` is True; rows are counted from `offset`."""
    rows = np.flatnonzero(is_bad)
    return bad_rows_error(label, problem, offset + int(rows[0]), rows.size, remedy)


def check_increasing(times: Floats, label: str, offset: int) -> None:
    """Raise DataError if sample times are not strictly increasing; rows are counted from `offset`."""
    steps = np.diff(times)
    if (steps > 0).all():
        return
    row_before = int(np.flatnonzero(~(steps > 0))[0])
    row, (earlier, later) = offset + row_before + 1, times[row_before : row_before + 2].tolist()
    if steps[row_before] == 0:
        remedy = "remove the repeated rows, or write the time with more digits"
        raise bad_rows_error(label, f"repeated time {later!r} s", row, int((steps == 0).sum()), remedy)
    remedy = "sort the rows, or split the file where the clock starts again"
    raise bad_rows_error(
        label, f"decreasing time, {later!r} s after {earlier!r} s", row, int((steps < 0).sum()), remedy
    )


def regular_step(
    times: Floats, label: str, offset: int, resolution: float, stated_step: float | None
) -> tuple[float, tuple[str, ...]]:
    """Return the step [s] of regular sample times, rounded to a short decimal, and notes on their jitter.

    Parameters
    ----------
    times
        Sample times [s], strictly increasing.
    label, offset
        Name of the time in messages, and number of the first row.
    resolution
        Rounding error of the times [s].
    stated_step
        Step stated in the header of the file [s], which is returned unchanged; None if the header states none.

    Raises
    ------
    DataError
        If there is a gap, the jitter exceeds 2 % of a step, or the mean step contradicts the stated step.
    """
    count = times.size - 1
    elapsed = times - times[0]
    mean = float(elapsed[-1]) / count
    if not _MIN_STEP_S <= mean <= _MAX_STEP_S:
        raise DataError(f"{label}: the mean step {mean!r} s cannot be used; check the unit of the time")
    deviation = np.abs(elapsed - uniform_times(times.size, mean))
    max_deviation = float(deviation.max())
    if max_deviation > _MAX_JITTER_FRACTION * mean:
        steps = np.diff(times)
        median_step = float(np.median(steps))
        gaps = np.flatnonzero(steps > _GAP_STEP_RATIO * median_step)
        if gaps.size:
            problem = f"gap of {steps[gaps[0]]:.6g} s where {median_step:.6g} s is usual"
            remedy = (
                f"load the part before or after it with {parameter('window')}; or add its rows, with the inputs and "
                f"empty outputs, and use {parameter('missing', 'weight')}; or, only if no input changed there, "
                f"{parameter('missing', 'hold')} or {parameter('resample', Placeholder('STEP'))}"
            )
            raise bad_rows_error(label, problem, offset + int(gaps[0]) + 1, gaps.size, remedy)
        problem = f"jitter of up to {100.0 * max_deviation / mean:.3g} % of the mean step {mean:.6g} s"
        problem += f" ({100 * _MAX_JITTER_FRACTION:g} % allowed)"
        remedy = (
            f"put the inputs on a regular grid with {parameter('resample', Placeholder('STEP'))}; outputs are "
            "then compared at their original times"
        )
        is_late = deviation > _MAX_JITTER_FRACTION * mean
        raise masked_rows_error(label, problem, is_late, remedy, offset)
    notes: tuple[str, ...] = ()
    if max_deviation > _MIN_REPORTED_JITTER_FRACTION * mean:
        row = offset + int(deviation.argmax())
        jitter = f"{100.0 * max_deviation / mean:.2g} % of a step, the most at row {row}"
        notes = (f"time jitters by up to {jitter}; the sampling was assumed uniform",)
    if stated_step is not None:
        if not abs(stated_step - mean) * count <= max(4.0 * resolution, 2.0 * max_deviation, 1e-8 * mean):
            raise DataError(
                f"{label}: the mean step is {mean!r} s where the file's header says {stated_step!r} s; "
                "correct the header, or remove its first line and name the columns"
            )
        return stated_step, notes
    return _short_decimal(mean, count, 4.0 * resolution, 2.0 * max_deviation), notes


def check_step_agrees(step: object, times: Floats, label: str) -> None:
    """Raise DataError if a given step [s] contradicts the sample times [s] of the same rows.

    The step agrees if it differs by at most 2 % from the mean or the median interval. Times that do not increase are no
    time axis and are not compared.
    """
    seconds, steps = check_step(step, "step"), np.diff(times[np.isfinite(times)])
    if not steps.size or not np.all(steps > 0):
        return
    intervals = float(np.mean(steps)), float(np.median(steps))
    if min(abs(interval / seconds - 1.0) for interval in intervals) > _MAX_JITTER_FRACTION:
        raise DataError(
            f"{parameter('step', step)}, but {label} has a step of {intervals[1]:.6g} s; omit {parameter('step')}, "
            f"with {parameter('time_unit')} if the times have another unit, or rename the column if it is not the time"
        )


def _short_decimal(mean: float, count: int, rounding: float, jitter: float) -> float:
    """Return the decimal with the fewest digits that agrees with the mean step, or the mean step if there is none.

    A decimal agrees if `count` such steps and `count` mean steps differ by at most `rounding` [s]. A decimal within a
    relative difference of 1e-9 of the mean step also agrees if they differ by at most `jitter` [s].
    """
    for digits in range(12):
        decimal = float(f"{mean:.{digits}e}")
        error = abs(decimal - mean) * count
        if error <= rounding or (error <= jitter and abs(decimal - mean) <= 1e-9 * mean):
            return decimal
    return mean


def window_rows(times: Floats, window: object, label: str = "time") -> tuple[int, int]:
    """Return the index of the first row inside a data window, and the index after its last row.

    `window` is a pair of times [s] since the first row; a time of None marks an open end. Raise DataError if the window
    is invalid or contains no row.
    """
    if not isinstance(window, Sequence) or isinstance(window, str) or len(window) != 2:
        raise DataError(
            f"{parameter('window', window)} is not a pair (start, stop) of seconds; use None for an open end"
        )
    limits: list[float | None] = []
    for limit in window:
        value = as_number(limit)
        if value is None and limit is not None:
            raise DataError(
                f"{parameter('window')}: limit {limit!r} is not a number; give seconds, or None for an open end"
            )
        if value is not None and not math.isfinite(value):
            raise DataError(f"{parameter('window')}: limit {value!r} is not finite; use None for an open end")
        limits.append(value)
    start, stop = limits
    end_times = times[[0, -1]]
    if not np.isfinite(end_times).all():
        row, count = 0 if not np.isfinite(end_times[0]) else times.size - 1, int((~np.isfinite(times)).sum())
        remedy = f"remove these rows; {parameter('window')} counts from the first time"
        raise bad_rows_error(label, "the first or last time is not finite", row, count, remedy)
    with np.errstate(over="ignore", invalid="ignore"):
        elapsed = times - times[0]
        steps = np.diff(elapsed)
        # The median interval is robust against gaps and repeated or missing times.
        steps = steps[np.isfinite(steps) & (steps > 0)]
        step = float(np.median(steps)) if steps.size else 0.0
        duration = float(elapsed[-1]) + step
    remedy = f"{label} has times from 0 to {duration:.12g} s since its first row"
    for limit in (start, stop):
        if limit is not None and not -_EDGE_TOLERANCE_STEPS * step <= limit <= duration + _EDGE_TOLERANCE_STEPS * step:
            raise DataError(f"{parameter('window')}: limit {limit!r} s is out of range; {remedy}")
    low = 0.0 if start is None else start
    high = math.inf if stop is None else stop
    if low >= high:
        raise DataError(f"{parameter('window')}: the limits {start!r} and {stop!r} s do not increase; {remedy}")
    with np.errstate(invalid="ignore"):
        rows = np.flatnonzero(
            (elapsed >= low - _EDGE_TOLERANCE_STEPS * step) & (elapsed < high - _EDGE_TOLERANCE_STEPS * step)
        )
    if rows.size == 0:
        raise DataError(f"window: no row lies between {start!r} and {stop!r} s; {remedy}")
    return int(rows[0]), int(rows[-1]) + 1


def rows_coincide(times: Floats, step: float) -> bool:
    """Whether the sample times `times` [s] are regular and every row at the new step [s] is an original sample."""
    mean_step = float(times[-1]) / (times.size - 1)
    is_regular = np.abs(times - uniform_times(times.size, mean_step)).max() <= _MAX_JITTER_FRACTION * mean_step
    ratio = step / mean_step
    return (
        bool(is_regular) and abs(ratio - round(ratio)) * times.size <= _MAX_JITTER_FRACTION and step > 0.5 * mean_step
    )


def resample_uniform(
    times: Floats, data: Mapping[str, Floats], intersample: Mapping[str, Intersample], step: float
) -> dict[str, Floats]:
    """Return signals with sample times `times` [s], resampled to a uniform step [s].

    Zero-order-hold inputs take interval means, and other signals are interpolated linearly. `intersample` has the
    intersample behavior by input. Raise DataError if there would be fewer than three samples, or more than 50 million.
    """
    intervals = float(times[-1]) / step
    if intervals + 1 > _MAX_RUN_SAMPLES:
        raise DataError(f"{parameter('resample', step)} gives more than {_MAX_RUN_SAMPLES} rows; use a larger step")
    rows = math.floor(intervals + _EDGE_TOLERANCE_STEPS) + 1
    if rows < MIN_RUN_SAMPLES:
        raise DataError(
            f"{parameter('resample', step)} leaves {plural(rows, 'row')}, {MIN_RUN_SAMPLES} are needed; use a "
            f"smaller step"
        )
    return NonuniformSamples(times, dict(data)).resample(intersample, step)


def describe_resampled_signals(intersample: Mapping[str, Intersample], *, keep_times: bool) -> str:
    """Return text on how each signal is resampled.

    `keep_times` states whether output-error fits use the original output samples at their original times.
    """
    signals = [signal for signal, kind in intersample.items() if kind == ZERO_ORDER_HOLD]
    means = f"means over the new intervals for {', '.join(signals)}; " if signals else ""
    if keep_times:
        return f"{means}outputs at their original times in output-error fits and figures, otherwise interpolated"
    return f"{means}linear interpolation of the others, without an anti-alias filter"


#: Treatment of missing samples: raise an error, give missing outputs no weight, or also fill missing inputs.
MissingPolicy = Literal["refuse", "weight", "hold"]
MISSING_POLICIES: tuple[MissingPolicy, ...] = ("refuse", "weight", "hold")
#: Maximum distance of a sample from its grid point, in steps, for a regular grid with gaps.
GRID_TOLERANCE_STEPS = 0.02
#: Tolerance of comparisons of times, relative to the duration.
_RELATIVE_TIME_TOLERANCE = 1e-12


def check_missing_policy(policy: object) -> MissingPolicy:
    """Return `policy` if it is a known treatment of missing samples; raise DataError otherwise."""
    for choice in MISSING_POLICIES:
        if policy == choice:
            return choice
    raise DataError(
        f"{parameter('missing', policy)} is unknown; use 'refuse', 'weight' (missing outputs get no weight) "
        "or 'hold' (as 'weight', and missing inputs keep their last value)"
    )


def missing_mask(values: Floats) -> NDArray[np.bool_]:
    """Return a boolean mask of missing samples (NaN)."""
    return np.asarray(np.isnan(values))


def drop_missing(values: Floats) -> Floats:
    """Return the values without missing samples (NaN)."""
    return values[~np.isnan(values)]


def interpolate_gaps(values: Floats) -> Floats:
    """Return values with NaN replaced by linear interpolation, or by the nearest value at the ends."""
    is_missing = np.isnan(values)
    if not is_missing.any() or is_missing.all():
        return values
    rows = np.arange(values.size)
    return np.asarray(np.where(is_missing, np.interp(rows, rows[~is_missing], values[~is_missing]), values))


def fill_input_gaps(values: Floats, kind: Intersample) -> Floats:
    """Return an input with NaN replaced by the last value for "zoh", by linear interpolation for "foh"."""
    if kind != ZERO_ORDER_HOLD:
        return interpolate_gaps(values)
    is_missing = np.isnan(values)
    last = np.maximum.accumulate(np.where(is_missing, 0, np.arange(values.size)))
    return np.asarray(values[last])


def grid_positions(times: Floats) -> tuple[NDArray[np.intp], float] | None:
    """Return the grid index of each sample and the step [s] of a regular grid with gaps; None without such a grid."""
    elapsed = times - times[0]
    median_step = float(np.median(np.diff(elapsed)))
    step = median_step
    # The median interval is affected by rounding; each pass refines the step by least squares.
    for _ in range(4):
        indices = np.rint(elapsed / step).astype(np.intp)
        if indices[-1] <= 0:
            return None
        step = float(elapsed @ indices) / float(indices @ indices)
    deviation = np.abs(elapsed - indices * step)
    if deviation.max() > GRID_TOLERANCE_STEPS * step or (np.diff(indices) <= 0).any():
        return None
    return indices, step


@dataclass(frozen=True, eq=False)
class NonuniformSamples:
    """Samples of inputs and outputs at the nonuniform times at which they were recorded.

    Parameters
    ----------
    times
        Sample times [s since the first sample of the run's grid], ascending from 0.
    data
        Values by signal; missing output samples are NaN.
    """

    times: Floats
    data: dict[str, Floats]

    def indices_within(self, duration: float) -> NDArray[np.intp]:
        """Return the indices of the samples with times of at most `duration` [s], up to rounding."""
        return np.flatnonzero(self.times <= duration * (1.0 + _RELATIVE_TIME_TOLERANCE))

    def resample(self, intersample: Mapping[str, Intersample], step: float) -> dict[str, Floats]:
        """Return the signals resampled to a regular grid with the given step [s].

        Zero-order-hold inputs take interval means, and other signals are interpolated linearly. `intersample` has the
        intersample behavior by input.
        """
        rows = int(np.floor(float(self.times[-1]) / step + 1e-6)) + 1
        grid = uniform_times(rows, step)
        return {
            name: _core.nonuniform_means(self.times, values, rows, step, True)
            if intersample.get(name) == ZERO_ORDER_HOLD
            else np.interp(grid, self.times[~np.isnan(values)], drop_missing(values))
            for name, values in self.data.items()
        }

    def cut_window(
        self, intersample: Mapping[str, Intersample], start: float, stop: float, step: float
    ) -> NonuniformSamples:
        """Return the samples with times from `start` to `stop` + `step` [s]; the new times are counted from `start`.

        If there is no sample at `start`, a sample is added there, with NaN for the outputs, and with values for the
        inputs by their intersample behavior `intersample`.
        """
        tolerance = 1e-9 * step
        rows = np.flatnonzero((self.times >= start - tolerance) & (self.times <= stop + step))
        times, data = np.maximum(self.times[rows] - start, 0.0), {n: v[rows] for n, v in self.data.items()}
        if rows.size == 0 or times[0] > tolerance:
            times = np.append(0.0, times)
            # Times that differ from a switching instant only by rounding count as equal.
            limit_time = start + _RELATIVE_TIME_TOLERANCE * float(self.times[-1])
            row = max(int(np.searchsorted(self.times, limit_time, side="right")) - 1, 0)
            for name, values in self.data.items():
                kind = intersample.get(name)
                is_constant = kind == ZERO_ORDER_HOLD
                first = np.nan if kind is None else values[row] if is_constant else np.interp(start, self.times, values)
                data[name] = np.append(first, data[name])
        return NonuniformSamples(times, data)

    def replace_signals(self, **changes: Any) -> NonuniformSamples:
        """Return a copy with new samples of some signals, given as keyword arguments by signal name."""
        return NonuniformSamples(self.times, {**self.data, **changes})


def describe_missing(label: str, is_missing: NDArray[np.bool_], treatment: str) -> str:
    """Return a sentence on the number of missing samples of the signal `label`, with their treatment `treatment`."""
    first, count = int(np.flatnonzero(is_missing)[0]), int(is_missing.sum())
    verb = "has" if count == 1 else "have"
    return f"{label}: {count} of {is_missing.size} rows {verb} no value, the first is row {first}; {treatment}"


#: Maximum delay of a default search: in samples, and as a fraction of the length of the run.
MAX_DELAY_SAMPLES, MAX_DELAY_FRACTION = 60, 1.0 / 12.0


def longest_delay(length: int, step: float) -> float:
    """Return the default upper limit of a delay search [s]: 60 samples, or a twelfth of the run if that is less.

    `length` is the number of samples, and `step` the sampling interval [s].
    """
    # Three digits, because the limit is printed in the name of a structure.
    return float(f"{min(MAX_DELAY_SAMPLES, length * MAX_DELAY_FRACTION) * step:.3g}")
