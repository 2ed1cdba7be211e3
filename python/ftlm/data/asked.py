"""What a person asks a run to be, and the checks that make it one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.checks import listed
from ftlm.base.errors import DataError
from ftlm.data.measured import Measured
from ftlm.data.names import check_run_name, check_signal_name
from ftlm.data.samples import (
    FEWEST_ROWS,
    HELD,
    Intersample,
    as_vector,
    check_increasing,
    check_lengths,
    check_values,
    checked_intersample,
    checked_step,
    grid_of,
    how_interpolated,
    interpolated,
    regular_step,
    window_rows,
)
from ftlm.data.units import TIME_UNITS, checked_units


@dataclass(frozen=True)
class Asked:
    """Everything that a run is made of, as a person or a file gave it; see :meth:`ftlm.Run.from_arrays`.

    Parameters
    ----------
    inputs, outputs, step, time, units, intersample, name, resample, time_unit
        As there.
    window
        Its ``slice``.
    labels, time_label
        What errors call each signal and the time.
    known_step
        The step that the file states.
    facts, about
        What was done to the data before, and how they were made.
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
    facts: tuple[str, ...] = ()
    about: Mapping[str, Any] = field(default_factory=dict)

    def thing(self, signal: str) -> str:
        """Return what errors call a signal."""
        return self.labels.get(signal, f"signal {signal!r}")

    def measured(self) -> Measured:
        """Check everything once, in the order in which the data come: names, numbers, clock, window, values, spacing.

        Raises
        ------
        DataError
            Whatever cannot be used as it is.
        """
        self._check_names()
        units = checked_units(self.units, (*self.inputs, *self.outputs))
        behaviour: dict[str, Intersample] = {
            **dict.fromkeys(self.inputs, HELD),
            **checked_intersample(self.intersample, tuple(self.inputs)),
        }
        new_step = None if self.resample is None else checked_step(self.resample, "resample")
        vectors = {s: as_vector(v, self.thing(s))[0] for s, v in {**self.inputs, **self.outputs}.items()}
        clock = self._clock(vectors)
        first, last = self._rows(clock.times)
        if last - first < clock.times.size:
            # Copies: a view would keep the rest in memory, and could be written to.
            vectors = {s: vector[first:last].copy() for s, vector in vectors.items()}
        data = self._values(vectors, units, first)
        times, facts = clock.times[first:last], self.facts
        if clock.step is not None:
            step, start = clock.step, float(f"{first * clock.step:.12g}")
        else:
            check_values(times, self.time_label, first)
            check_increasing(times, self.time_label, first)
            start = float(times[0])
            if new_step is None:
                step, jitter = regular_step(times, self.time_label, first, clock.resolution, self.known_step)
                facts += jitter
        if new_step is not None:
            step, since = new_step, times - times[0]
            data = interpolated(since, data, behaviour, new_step)
            facts += (_resampled(since, new_step, first, behaviour),)
        return Measured(
            name=self.name, step=step, start=start, inputs=tuple(self.inputs), outputs=tuple(self.outputs), _data=data,
            _units={s: unit for s, (unit, _) in units.items()}, _intersample=behaviour,
            facts=tuple(dict.fromkeys(facts)), _about=dict(self.about),
        )  # fmt: skip

    def _check_names(self) -> None:
        check_run_name(self.name)
        for signal in (*self.inputs, *self.outputs):
            check_signal_name(signal)
        both = [signal for signal in self.inputs if signal in self.outputs]
        if both:
            raise DataError(f"signal {both[0]!r} is both an input and an output, {len(both)} in all; give it two names")
        if not self.outputs:
            raise DataError("outputs=: there is none; name at least one output")
        if (self.step is None) == (self.time is None):
            given = "neither is given" if self.step is None else "both are given"
            raise DataError(f"step= and time=: {given}; pass exactly one of them")

    def _clock(self, vectors: Mapping[str, Floats]) -> _Clock:
        """Return the time of every row, which all signals must have."""
        lengths = {self.thing(s): vector.size for s, vector in vectors.items()}
        if self.time is None:
            if self.time_unit != "s":
                raise DataError(f"time_unit={self.time_unit!r} is the unit of time=, which is not given; step= is in s")
            step = checked_step(self.step, "step")
            clock = _Clock(grid_of(min(lengths.values()), step), step, 0.0)
        else:
            if not isinstance(self.time_unit, str) or self.time_unit not in TIME_UNITS:
                raise DataError(f"time_unit={self.time_unit!r} is unknown; the known ones are {listed(TIME_UNITS)}")
            times, dtype = as_vector(self.time, self.time_label)
            lengths = {self.time_label: times.size, **lengths}
            times = times * TIME_UNITS[self.time_unit]
            single = dtype.kind == "f" and dtype.itemsize < 8
            precision = float(np.finfo(dtype if single else np.float64).eps)
            clock = _Clock(times, None, precision * float(np.abs(times).max()))
        check_lengths(lengths)
        return clock

    def _rows(self, times: Floats) -> tuple[int, int]:
        """Return the first row asked for and the one after the last."""
        first, last = 0, times.size
        if self.window is not None:
            first, last = window_rows(times, self.window, "slice", self.time_label)
        if last - first < FEWEST_ROWS:
            thing = self.thing((*self.inputs, *self.outputs)[0]) if self.time is None else self.time_label
            raise DataError(
                f"{thing}: {last - first} rows{' in the slice' if self.window is not None else ''}, "
                f"{FEWEST_ROWS} are needed; use a longer record"
            )
        return first, last

    def _values(
        self, vectors: Mapping[str, Floats], units: Mapping[str, tuple[str, float]], first: int
    ) -> dict[str, Floats]:
        """Return finite numbers in SI units."""
        data: dict[str, Floats] = {}
        for signal, vector in vectors.items():
            unit, scale = units[signal]
            check_values(vector, self.thing(signal), first)
            with np.errstate(over="ignore"):
                data[signal] = vector * scale if scale != 1.0 else vector
            check_values(data[signal], f"{self.thing(signal)} in {unit}", first)
        return data


@dataclass(frozen=True)
class _Clock:
    """Times of the rows [s], their step where it was given, and what their numbers resolve."""

    times: Floats
    step: float | None
    resolution: float


def _resampled(since: Floats, step: float, first: int, behaviour: Mapping[str, Intersample]) -> str:
    intervals = np.diff(since)
    return (
        f"resampled to {step:.12g} s from intervals of {intervals.min():.6g} to {intervals.max():.6g} s, the widest "
        f"after row {first + int(intervals.argmax())} ({how_interpolated(behaviour)})"
    )
