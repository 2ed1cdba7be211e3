"""What a person asks a run to be, and the checks that make it one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ftlm.data.sampling import (
    FEWEST_ROWS,
    HELD,
    Intersample,
    Missing,
    Readings,
    as_seconds,
    as_vector,
    check_increasing,
    check_lengths,
    check_rows,
    check_values,
    checked_intersample,
    checked_missing,
    checked_step,
    few_read,
    grid_of,
    held,
    how_interpolated,
    interpolated,
    is_regular,
    places_on_grid,
    regular_step,
    said_missing,
    unread,
    window_rows,
)
from ftlm.data.units import TIME_UNITS, checked_units
from ftlm.errors import DataError
from ftlm.utils.validation import Floats, bad_rows, check_run_name, check_signal_name, listed

if TYPE_CHECKING:
    from ftlm.data.run import Measured


@dataclass(frozen=True)
class Asked:
    """Everything that a run is made of, as a person or a file gave it; see :meth:`ftlm.Run.from_arrays`.

    Parameters
    ----------
    inputs, outputs, step, time, units, intersample, name, resample, time_unit, missing
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
    missing: str = "refuse"

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
        from ftlm.data.run import Measured  # noqa: PLC0415 — the class that it makes

        self._check_names()
        units = checked_units(self.units, (*self.inputs, *self.outputs))
        behaviour: dict[str, Intersample] = {
            **dict.fromkeys(self.inputs, HELD),
            **checked_intersample(self.intersample, tuple(self.inputs)),
        }
        new_step = None if self.resample is None else checked_step(self.resample, "resample")
        missing = checked_missing(self.missing)
        vectors = {
            s: as_vector(v, self.thing(s), gaps=missing != "refuse" and (missing == "hold" or s in self.outputs))[0]
            for s, v in {**self.inputs, **self.outputs}.items()
        }
        clock = self._clock(vectors)
        first, last = self._rows(clock.times)
        if last - first < clock.times.size:
            # Copies: a view would keep the rest in memory, and could be written to.
            vectors = {s: vector[first:last].copy() for s, vector in vectors.items()}
        data = self._values(vectors, units, first, missing)
        times, facts = clock.times[first:last], self.facts + clock.facts
        if clock.step is not None:
            step, start = clock.step, float(f"{first * clock.step:.12g}")
        else:
            check_values(times, self.time_label, first)
            check_increasing(times, self.time_label, first)
            start = float(times[0])
            if new_step is None:
                if missing != "refuse":
                    times, data = self._with_lost_rows(times, data, missing, first)
                step, jitter = regular_step(times, self.time_label, first, clock.resolution, self.known_step)
                facts += jitter
        data, said = self._known(data, behaviour, missing)
        facts += said
        readings = None
        if new_step is not None:
            step, since = new_step, times - times[0]
            whole = not any(np.isnan(data[s]).any() for s in self.outputs)
            if whole and is_regular(since):
                data = interpolated(since, data, behaviour, new_step)
                facts += (resampled(since, new_step, first, how_interpolated(behaviour)),)
            else:
                check_rows(since, new_step)
                readings = Readings(since, data)
                data = readings.on(behaviour, new_step)
                facts += (resampled(since, new_step, first, how_read(behaviour)),)
        return Measured(
            name=self.name,
            step=step,
            start=start,
            inputs=tuple(self.inputs),
            outputs=tuple(self.outputs),
            _data=data,
            _units={s: unit for s, (unit, _) in units.items()},
            _intersample=behaviour,
            facts=tuple(dict.fromkeys(facts)),
            _about=dict(self.about),
            readings=readings,
        )

    def _with_lost_rows(
        self, times: Floats, data: dict[str, Floats], missing: Missing, first: int
    ) -> tuple[Floats, dict[str, Floats]]:
        """Rows for the places of a regular grid that have none, where the others lie on one."""
        found = places_on_grid(times)
        if found is None or found[0].size == found[0][-1] + 1:
            return times, data
        places, step = found
        lost = int(places[-1]) + 1 - places.size
        if self.inputs and missing != "hold":
            row = first + int(np.flatnonzero(np.diff(places) > 1)[0]) + 1
            raise DataError(
                f"{self.time_label}: {lost} rows are missing of a regular grid of {step:.6g} s, the first before row "
                f"{row}, and the inputs are not known there; give these rows with NaN for the outputs alone, or hold "
                "the inputs over them with missing='hold'"
            )
        whole = times[0] + grid_of(int(places[-1]) + 1, step)
        whole[places] = times
        out = {}
        for name, values in data.items():
            out[name] = np.full(whole.size, np.nan)
            out[name][places] = values
        return whole, out

    def _known(
        self, data: dict[str, Floats], behaviour: Mapping[str, Intersample], missing: Missing
    ) -> tuple[dict[str, Floats], tuple[str, ...]]:
        """Inputs that are known throughout, and what there is to say of what was not read."""
        said, out = [], dict(data)
        for name, values in data.items():
            gone = unread(values)
            if not gone.any():
                continue
            if name in self.outputs:
                if few_read(values):
                    raise bad_rows(
                        self.thing(name),
                        f"{gone.size - int(gone.sum())} values, {FEWEST_ROWS} are needed",
                        0,
                        int(gone.sum()),
                        "use a longer record",
                    )
                said.append(said_missing(f"output {name}", gone, "they weigh nothing in output-error fits and figures"))
                continue
            if gone[0]:
                raise bad_rows(
                    self.thing(name),
                    "no value before which there is none to hold",
                    0,
                    int(gone.sum()),
                    "begin where the input is known, with slice=",
                )
            out[name] = held(values, behaviour[name])
            how = "its last value was held" if behaviour[name] == HELD else "a straight line was drawn"
            said.append(said_missing(f"input {name}", gone, f"{how}, which is a guess"))
        return out, tuple(said)

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
            dated = as_seconds(self.time, self.time_label)
            if dated is not None and self.time_unit != "s":
                raise DataError(
                    f"time_unit={self.time_unit!r} is the unit of numbers, and {self.time_label} holds dates"
                )
            times, dtype = as_vector(self.time if dated is None else dated[0], self.time_label)
            lengths = {self.time_label: times.size, **lengths}
            times = times * TIME_UNITS[self.time_unit]
            single = dtype.kind == "f" and dtype.itemsize < 8
            precision = float(np.finfo(dtype if single else np.float64).eps)
            said = (dated[1],) if dated is not None and dated[1] else ()
            clock = _Clock(times, None, precision * float(np.abs(times).max()), said)
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
        self, vectors: Mapping[str, Floats], units: Mapping[str, tuple[str, float]], first: int, missing: Missing
    ) -> dict[str, Floats]:
        """Return finite numbers in SI units, NaN where they may be missing."""
        data: dict[str, Floats] = {}
        for signal, vector in vectors.items():
            unit, scale = units[signal]
            gaps = missing == "hold" or (missing == "weight" and signal in self.outputs)
            instead = "give them no weight with missing='weight'"
            if signal in self.inputs:
                instead = "hold the last value before them with missing='hold'"
            check_values(vector, self.thing(signal), first, gaps=gaps, instead=f"{instead}, or avoid them with slice=")
            with np.errstate(over="ignore"):
                data[signal] = vector * scale if scale != 1.0 else vector
            check_values(data[signal], f"{self.thing(signal)} in {unit}", first, gaps=gaps)
        return data


@dataclass(frozen=True)
class _Clock:
    """Times of the rows [s], their step where it was given, what their numbers resolve, what is to be said of them."""

    times: Floats
    step: float | None
    resolution: float
    facts: tuple[str, ...] = ()


def resampled(since: Floats, step: float, first: int, how: str) -> str:
    """Say what was put on which step, and how."""
    intervals = np.diff(since)
    return (
        f"resampled to {step:.12g} s from intervals of {intervals.min():.6g} to {intervals.max():.6g} s, the widest "
        f"after row {first + int(intervals.argmax())} ({how})"
    )


def how_read(behaviour: Mapping[str, Intersample]) -> str:
    """Say what becomes of each signal that has times of its own."""
    kept = [signal for signal, kind in behaviour.items() if kind == HELD]
    means = f"held: {', '.join(kept)}, by means over the new intervals; " if kept else ""
    return f"{means}outputs keep their own times in output-error fits and figures, elsewhere straight lines"
