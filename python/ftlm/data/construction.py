"""Construction of runs: validation of arguments, data window, resampling, missing samples and units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ftlm.data.sampling import (
    MIN_RUN_SAMPLES,
    ZERO_ORDER_HOLD,
    Intersample,
    MissingPolicy,
    NonuniformSamples,
    as_seconds,
    as_vector,
    check_increasing,
    check_intersample,
    check_lengths,
    check_missing_policy,
    check_step,
    check_values,
    describe_missing,
    describe_resampled_signals,
    fill_input_gaps,
    grid_positions,
    interpolate_gaps,
    masked_rows_error,
    missing_mask,
    regular_step,
    resample_uniform,
    rows_coincide,
    uniform_times,
    window_rows,
)
from ftlm.data.units import TIME_UNITS, check_units
from ftlm.errors import DataError
from ftlm.utils.formatting import plural
from ftlm.utils.parameters import parameter
from ftlm.utils.validation import Floats, bad_rows_error, check_run_name, check_signal_name, join_names


@dataclass(frozen=True)
class RunArguments:
    """Arguments from which a run is built, before validation; see :meth:`ftlm.Run.from_arrays`.

    Parameters
    ----------
    inputs, outputs, step, time, units, intersample, name, resample, time_unit, missing
        As in :meth:`ftlm.Run.from_arrays`.
    window
        Data window: the argument ``window`` of :meth:`ftlm.Run.from_arrays`.
    labels, time_label
        Names of signals and time in error messages.
    known_step
        Step in the header of the file [s]; None if the file states none.
    notes, metadata
        Notes on earlier processing, and metadata about the origin of the data.
    """

    inputs: Mapping[str, object]
    outputs: Mapping[str, object]
    step: float | None = None
    time: object = None
    units: Mapping[str, str] | None = None
    intersample: Mapping[str, str] | None = None
    name: str = "run"
    resample: float | None = None
    window: Sequence[float | None] | None = None
    time_unit: str = "s"
    labels: Mapping[str, str] = field(default_factory=dict)
    time_label: str = "time"
    known_step: float | None = None
    notes: tuple[str, ...] = ()
    metadata: Mapping[str, Any] = field(default_factory=dict)
    missing: str = "refuse"

    def label_of(self, signal: str) -> str:
        """Return the name that error messages use for a signal."""
        return self.labels.get(signal, f"signal {signal!r}")

    def checked_fields(self) -> dict[str, Any]:
        """Validate names, numbers, time, window and values, and return the fields of the run.

        Raises
        ------
        DataError
            If an argument or a sample is invalid.
        """
        self._check_names()
        units = check_units(self.units, (*self.inputs, *self.outputs))
        intersample: dict[str, Intersample] = {
            **dict.fromkeys(self.inputs, ZERO_ORDER_HOLD),
            **check_intersample(self.intersample, tuple(self.inputs)),
        }
        new_step = None if self.resample is None else check_step(self.resample, "resample")
        missing = check_missing_policy(self.missing)
        vectors = {
            s: as_vector(v, self.label_of(s), gaps=missing != "refuse" and (missing == "hold" or s in self.outputs))[0]
            for s, v in {**self.inputs, **self.outputs}.items()
        }
        time_axis = self._time_axis(vectors)
        first, last = self._rows(time_axis.times)
        if last - first < time_axis.times.size:
            # A view would keep the other rows in memory, and would be writable through its base array.
            vectors = {s: vector[first:last].copy() for s, vector in vectors.items()}
        data = self._values(vectors, units, first, missing)
        times, all_notes = time_axis.times[first:last], self.notes + time_axis.notes
        if time_axis.step is not None:
            step, start = time_axis.step, float(f"{first * time_axis.step:.12g}")
        else:
            check_values(times, self.time_label, first)
            check_increasing(times, self.time_label, first)
            start = float(times[0])
            if new_step is None:
                if missing != "refuse":
                    times, data = self._insert_missing_samples(times, data, missing, first)
                step, jitter = regular_step(times, self.time_label, first, time_axis.resolution, self.known_step)
                all_notes += jitter
        data, notes = self._fill_input_gaps(data, intersample)
        all_notes += notes
        nonuniform_samples = None
        if new_step is not None:
            step, times = new_step, times - times[0]
            is_complete = not any(np.isnan(data[s]).any() for s in self.outputs)
            if not (is_complete and rows_coincide(times, new_step)):
                nonuniform_samples = NonuniformSamples(times, data)
            data = resample_uniform(times, data, intersample, new_step)
            method = describe_resampled_signals(intersample, keep_times=nonuniform_samples is not None)
            all_notes += (describe_resampling(times, new_step, first, method),)
        return dict(
            name=self.name,
            step=step,
            start=start,
            inputs=tuple(self.inputs),
            outputs=tuple(self.outputs),
            _data=data,
            _units={s: unit for s, (unit, _) in units.items()},
            _intersample=intersample,
            notes=tuple(dict.fromkeys(all_notes)),
            _metadata=dict(self.metadata),
            nonuniform_samples=nonuniform_samples,
        )

    def _insert_missing_samples(
        self, times: Floats, data: dict[str, Floats], missing: MissingPolicy, first: int
    ) -> tuple[Floats, dict[str, Floats]]:
        """Return times [s] and data with rows of NaN inserted in the gaps of a regular time grid.

        Times and data are returned unchanged if the rows do not lie on a regular grid. Raise DataError if inputs are
        unknown in a gap and `missing` is not "hold". Rows in messages are counted from `first`.
        """
        grid = grid_positions(times)
        if grid is None or grid[0].size == grid[0][-1] + 1:
            return times, data
        indices, step = grid
        count = int(indices[-1]) + 1 - indices.size
        if self.inputs and missing != "hold":
            row = first + int(np.flatnonzero(np.diff(indices) > 1)[0]) + 1
            raise DataError(
                f"{self.time_label}: {plural(count, 'row', 'are')} missing in a regular grid of {step:.6g} s, the "
                f"first before row "
                f"{row}, and the inputs are not known there; give these rows with NaN for the outputs alone, or, "
                f"only if no input changed there, hold the inputs over them with {parameter('missing', 'hold')}"
            )
        grid_times = times[0] + uniform_times(int(indices[-1]) + 1, step)
        grid_times[indices] = times
        out = {}
        for name, values in data.items():
            out[name] = np.full(grid_times.size, np.nan)
            out[name][indices] = values
        return grid_times, out

    def _fill_input_gaps(
        self, data: dict[str, Floats], intersample: Mapping[str, Intersample]
    ) -> tuple[dict[str, Floats], tuple[str, ...]]:
        """Return data with missing input samples filled, and notes on the missing samples of all signals.

        Raise DataError if an output has fewer than three samples, or the first sample of an input is missing.
        """
        notes, out = [], dict(data)
        for name, values in data.items():
            is_missing = missing_mask(values)
            if not is_missing.any():
                continue
            if name in self.outputs:
                count = int((~is_missing).sum())
                if count < MIN_RUN_SAMPLES:
                    problem = f"{count} values, but {MIN_RUN_SAMPLES} are needed"
                    raise bad_rows_error(self.label_of(name), problem, 0, int(is_missing.sum()), "use a longer record")
                notes.append(
                    describe_missing(
                        f"output {name}", is_missing, "they have no weight in output-error fits and figures"
                    )
                )
                continue
            if is_missing[0]:
                problem, remedy = (
                    "no value, and there is no earlier value to hold",
                    "begin where the input is known, with ",
                )
                raise masked_rows_error(self.label_of(name), problem, is_missing, remedy + parameter("window"))
            out[name] = fill_input_gaps(values, intersample[name])
            text = "its last value was held" if intersample[name] == ZERO_ORDER_HOLD else "a straight line was drawn"
            notes.append(describe_missing(f"input {name}", is_missing, f"{text}, which is a guess"))
        return out, tuple(notes)

    def _check_names(self) -> None:
        check_run_name(self.name)
        for signal in (*self.inputs, *self.outputs):
            check_signal_name(signal)
        common = [signal for signal in self.inputs if signal in self.outputs]
        if common:
            raise DataError(
                f"signal {common[0]!r} is both an input and an output ({len(common)} in all); use different names"
            )
        if not self.outputs:
            raise DataError(f"{parameter('outputs')}: no output is given; name at least one output")
        if (self.step is None) == (self.time is None):
            reason = "neither is given" if self.step is None else "both are given"
            raise DataError(f"{parameter('step')} and {parameter('time')}: {reason}; pass exactly one of them")

    def _time_axis(self, vectors: Mapping[str, Floats]) -> _TimeAxis:
        """Return the time axis; raise DataError if step, time or time unit is invalid, or lengths differ."""
        lengths = {self.label_of(s): vector.size for s, vector in vectors.items()}
        if self.time is None:
            if self.time_unit != "s":
                raise DataError(
                    f"{parameter('time_unit', self.time_unit)} is the unit of {parameter('time')}, which is not "
                    f"given; leave it out, because {parameter('step')} is in s"
                )
            step = check_step(self.step, "step")
            time_axis = _TimeAxis(uniform_times(min(lengths.values()), step), step, 0.0)
        else:
            if not isinstance(self.time_unit, str) or self.time_unit not in TIME_UNITS:
                raise DataError(
                    f"{parameter('time_unit', self.time_unit)} is unknown; the known ones are {join_names(TIME_UNITS)}"
                )
            dates = as_seconds(self.time, self.time_label)
            if dates is not None and self.time_unit != "s":
                raise DataError(
                    f"{parameter('time_unit', self.time_unit)} is the unit of numbers, but {self.time_label} has "
                    f"dates; omit {parameter('time_unit')}"
                )
            gaps = check_missing_policy(self.missing) != "refuse"
            times, dtype = as_vector(self.time if dates is None else dates[0], self.time_label, gaps=gaps)
            lengths = {self.time_label: times.size, **lengths}
            times = times * TIME_UNITS[self.time_unit]
            is_single = dtype.kind == "f" and dtype.itemsize < 8
            precision = float(np.finfo(dtype if is_single else np.float64).eps)
            notes: tuple[str, ...] = (dates[1],) if dates is not None and dates[1] else ()
            if gaps and (is_missing := missing_mask(times)).any() and not (is_missing[0] or is_missing[-1]):
                times = interpolate_gaps(times)
                notes += (describe_missing(self.time_label, is_missing, "they were interpolated"),)
            time_axis = _TimeAxis(times, None, precision * float(np.abs(times).max()), notes)
        check_lengths(lengths)
        return time_axis

    def _rows(self, times: Floats) -> tuple[int, int]:
        """Return the index of the first row inside the data window, and the index after its last row.

        Raise DataError if the window is invalid or contains fewer than three rows.
        """
        first, last = 0, times.size
        if self.window is not None:
            first, last = window_rows(times, self.window, self.time_label)
        if last - first < MIN_RUN_SAMPLES:
            label = self.label_of((*self.inputs, *self.outputs)[0]) if self.time is None else self.time_label
            raise DataError(
                f"{label}: {plural(last - first, 'row')}{' in the window' if self.window is not None else ''}, "
                f"{MIN_RUN_SAMPLES} are needed; use a longer record"
            )
        return first, last

    def _values(
        self, vectors: Mapping[str, Floats], units: Mapping[str, tuple[str, float]], first: int, missing: MissingPolicy
    ) -> dict[str, Floats]:
        """Return the signals converted to SI units by (SI unit, factor) pairs, with NaN at missing samples.

        Raise DataError for missing samples that `missing` does not allow, and for infinite or too large values. Rows in
        messages are counted from `first`.
        """
        data: dict[str, Floats] = {}
        for signal, vector in vectors.items():
            unit, scale = units[signal]
            gaps = missing == "hold" or (missing == "weight" and signal in self.outputs)
            remedy = f"give them no weight with {parameter('missing', 'weight')}"
            if signal in self.inputs:
                remedy = f"hold the last value before them with {parameter('missing', 'hold')}"
            remedy += f", or avoid them with {parameter('window')}"
            check_values(vector, self.label_of(signal), first, gaps=gaps, remedy=remedy)
            data[signal] = vector
            if scale != 1.0:
                with np.errstate(over="ignore"):
                    data[signal] = vector * scale
                check_values(data[signal], f"{self.label_of(signal)} in {unit}", first, gaps=gaps)
        return data


@dataclass(frozen=True)
class _TimeAxis:
    """Time axis: sample times [s], the step [s] if the user gave it, the rounding error of the times [s], and notes."""

    times: Floats
    step: float | None
    resolution: float
    notes: tuple[str, ...] = ()


def describe_resampling(times: Floats, step: float, first: int, method: str) -> str:
    """Return a sentence on a resampling to `step` [s]: range of the original intervals, widest interval and method.

    `times` are the original sample times [s]. Rows are counted from `first`, and `method` describes the method.
    """
    intervals = np.diff(times)
    return (
        f"resampled to {step:.12g} s from intervals of {intervals.min():.6g} to {intervals.max():.6g} s, the widest "
        f"after row {first + int(intervals.argmax())} ({method})"
    )
