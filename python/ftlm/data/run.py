"""One measured experiment, checked once and never changed afterwards."""

from __future__ import annotations

import html
import importlib
import io
import os
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from typing import Any, NoReturn, cast

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.checks import as_mapping, bad_rows, listed, names_to_columns, nearest
from ftlm.base.errors import DataError
from ftlm.base.output import new_file, write_bytes_atomically
from ftlm.data.advice import Advice, advise
from ftlm.data.header import CSV_MARK, header_text, written_time
from ftlm.data.measured import Measured
from ftlm.data.names import CSV_TIME, check_run_name, check_signal_name
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
    is_constant,
    regular_step,
    window_rows,
)
from ftlm.data.structures import Structure
from ftlm.data.units import TIME_UNITS, checked_units


class Run(Measured):
    """One measured experiment: regular samples of named inputs and outputs in SI units.

    A run never changes. It is made by `Run.from_arrays`, `Run.from_frame` or `ftlm.load`, which check the data once:
    whatever cannot be used as given is refused with a `DataError` that names the signal, the first bad row (counted
    from 0), the number of bad rows and what to do. Nothing is repaired, resampled or clipped unless asked for, and
    what was asked for is stated in `warnings`.

    Row j holds the outputs read at t = j·step and the inputs of that moment; between rows an input behaves as
    `intersample` says: ``"zoh"`` (a command, held until the next row) or ``"foh"`` (a measured signal, linear).
    """

    def __init__(self) -> None:
        raise TypeError("a Run is made by Run.from_arrays, Run.from_frame or ftlm.load")

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise AttributeError(f"a Run never changes; {name!r} cannot be set")

    def __delattr__(self, name: str) -> NoReturn:
        raise AttributeError(f"a Run never changes; {name!r} cannot be deleted")

    def __reduce__(self) -> tuple[object, ...]:
        return partial(_of, **self._known()), ()

    @classmethod
    def from_arrays(
        cls,
        *,
        step: float | None = None,
        time: object = None,
        inputs: Mapping[str, object] | None,
        outputs: Mapping[str, object],
        units: Mapping[str, str] | None = None,
        intersample: Mapping[str, str] | None = None,
        name: str = "run",
        resample: float | None = None,
        slice: Sequence[float | None] | None = None,
        time_unit: str = "s",
    ) -> Run:
        """Make a run from one-dimensional arrays.

        Parameters
        ----------
        step : float, optional
            Time between rows [s], > 0. Exactly one of `step` and `time` is given.
        time : array_like, shape (N,), optional
            Time of every row in `time_unit`, increasing. It is regular when every row lies within 2 % of a step of its
            place on a regular grid; a mean step that differs from a short decimal number by rounding alone is taken
            as that number.
        inputs, outputs : mapping of str to array_like, shape (N,), N ≥ 3
            Signals by name: lists, NumPy arrays, pandas or polars series of real numbers up to 1e150 in size. `inputs`
            may be empty; at least one output is needed. A name begins with a letter or an underscore and holds
            letters, digits, ``_ . [ ]``.
        units : mapping of str to str, optional
            Unit of a signal's numbers, converted to SI here. A signal without a unit is taken as it is.
        intersample : mapping of str to {"zoh", "foh"}, optional
            Behaviour of an input between rows; ``"zoh"`` where not given.
        name : str, default "run"
            What reports call this run.
        resample : float, optional
            Interpolate onto this step [s]: held inputs by hold, everything else linearly. Recorded in `warnings`.
        slice : pair of float or None, optional
            Use the rows with a ≤ t < b only, [s] since the first row; applied before any other check of the rows.
        time_unit : {"s", "ms", "us", "min", "h"}, default "s"
            Unit of `time`.

        Returns
        -------
        Run

        Raises
        ------
        DataError
            If a signal is not one-dimensional, not real numbers, empty, shorter than three rows, not finite or too
            large; if lengths differ; if a name, unit or behaviour is unknown or used twice; if time is not finite,
            repeated, decreasing, jittered or has a gap; if `step` is not positive.
        """
        given_inputs = as_mapping("inputs", {} if inputs is None else inputs)
        given_outputs = as_mapping("outputs", outputs)
        return build(
            step=step,
            time=time,
            inputs=given_inputs,
            outputs=given_outputs,
            units=units,
            intersample=intersample,
            name=name,
            resample=resample,
            window=slice,
            time_unit=time_unit,
        )

    @classmethod
    def from_frame(
        cls,
        frame: object,
        *,
        time: Hashable | None = None,
        step: float | None = None,
        inputs: Mapping[str, Hashable] | Sequence[str] | str | None,
        outputs: Mapping[str, Hashable] | Sequence[str] | str,
        units: Mapping[str, str] | None = None,
        intersample: Mapping[str, str] | None = None,
        name: str = "run",
        resample: float | None = None,
        slice: Sequence[float | None] | None = None,
        time_unit: str = "s",
    ) -> Run:
        """Make a run from a pandas or polars frame, a dict of arrays or a structured NumPy array.

        Parameters
        ----------
        frame : frame
            Columns are taken as ``frame[column]``.
        time : hashable, optional
            Column that holds the time. Exactly one of `time` and `step` is given.
        step : float, optional
            Time between rows [s], > 0.
        inputs, outputs : mapping of str to column, or list of str
            Columns by signal name; a list names columns that keep their names.
        units, intersample, name, resample, slice, time_unit
            As in `Run.from_arrays`.

        Returns
        -------
        Run

        Raises
        ------
        DataError
            If a column is unknown or there more than once, and for everything `Run.from_arrays` refuses.
        """
        columns = _frame_columns(frame)
        labels: dict[str, str] = {}

        def pick(column: Hashable, thing: str) -> object:
            found = columns.count(column)
            if found == 0:
                raise DataError(
                    f"column {column!r} ({thing}) is not in the frame{nearest(column, columns)}; "
                    f"the columns are {listed(columns)}; for the index of a pandas frame use frame.reset_index()"
                )
            if found > 1:
                raise DataError(f"column {column!r} ({thing}) is there {found} times; rename all but one")
            return cast("Mapping[Any, object]", frame)[column]

        def gather(argument: str, given: object) -> dict[str, object]:
            picked: dict[str, object] = {}
            for signal, column in names_to_columns(argument, given).items():
                labels[signal] = _label(signal, column)
                picked[signal] = pick(column, f"signal {signal!r}")
            return picked

        return build(
            step=step,
            time=None if time is None else pick(time, "time"),
            inputs=gather("inputs", inputs),
            outputs=gather("outputs", outputs),
            units=units,
            intersample=intersample,
            name=name,
            resample=resample,
            window=slice,
            time_unit=time_unit,
            labels=labels,
            time_label="time" if time is None else f"time (column {time!r})",
        )

    def __repr__(self) -> str:
        lines = [self._headline()]
        if self.inputs:
            lines.append("  inputs:  " + ", ".join(self._described(name) for name in self.inputs))
        lines.append("  outputs: " + ", ".join(self._described(name) for name in self.outputs))
        lines.extend(f"  warning: {text}" for text in self.warnings)
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td>{html.escape(name)}</td><td>{role}</td><td>{html.escape(self._units[name])}</td>"
            f"<td>{low:.6g}</td><td>{high:.6g}</td></tr>"
            for name, role, low, high in (
                (
                    name,
                    f"input ({self._intersample[name]})" if name in self._intersample else "output",
                    float(self._data[name].min()),
                    float(self._data[name].max()),
                )
                for name in self.signals
            )
        )
        warnings = "".join(f"<li>{html.escape(text)}</li>" for text in self.warnings)
        return (
            f"<p>{html.escape(self._headline())}</p>"
            "<table><thead><tr><th>signal</th><th>role</th><th>unit</th><th>min</th><th>max</th></tr></thead>"
            f"<tbody>{rows}</tbody></table>" + (f"<ul>{warnings}</ul>" if warnings else "")
        )

    def slice(self, start: float | None, stop: float | None) -> Run:
        """Return the rows with start ≤ t < stop.

        Parameters
        ----------
        start, stop : float or None
            [s] since this run's first row, 0 ≤ start < stop ≤ N·step; None for the first row or past the last one.
            The row at `stop` is left out, so ``run.slice(0, b)`` and ``run.slice(b, None)`` share no row.

        Returns
        -------
        Run
            Its `start` is the source time of its first row.

        Raises
        ------
        DataError
            If a limit lies outside the run, the limits do not increase, or fewer than three rows remain.
        """
        first, last = window_rows(grid_of(self.length, self.step), (start, stop), "slice")
        if last - first < FEWEST_ROWS:
            raise DataError(f"slice: {last - first} rows remain, {FEWEST_ROWS} are needed; widen the limits")
        data = {name: values[first:last] for name, values in self._data.items()}
        # The digits beyond the twelfth come from the sum and not from the source.
        begin = self.start if first == 0 else float(f"{self.start + first * self.step:.12g}")
        return self._with(_data=data, start=begin)

    def resample(self, step: float) -> Run:
        """Return this run interpolated onto another step.

        Held inputs ("zoh") keep the value of the last row at or before each new row; inputs that are "foh" and all
        outputs are interpolated linearly. There is no anti-alias filter. The result says so in `warnings`.

        Parameters
        ----------
        step : float
            New time between rows [s], > 0.

        Returns
        -------
        Run

        Raises
        ------
        DataError
            If `step` is not positive, or leaves fewer than three rows or more than 50 million.
        """
        new_step = checked_step(step, "resample")
        data = interpolated(grid_of(self.length, self.step), self._data, self._intersample, new_step)
        fact = f"resampled from {self.step:.12g} s to {new_step:.12g} s ({how_interpolated(self._intersample)})"
        return self._with(_data=data, step=new_step, facts=(*self.facts, fact))

    def rename(self, mapping: Mapping[str, str]) -> Run:
        """Return this run with other signal names.

        Parameters
        ----------
        mapping : mapping of str to str
            New name by old name; two names may be exchanged.

        Returns
        -------
        Run

        Raises
        ------
        DataError
            If an old name is unknown, a new name is not a name, or two signals would share one.
        """
        for old, new in mapping.items():
            if old not in self:
                raise self._unknown(old)
            check_signal_name(new)
        new_names = [mapping.get(name, name) for name in self.signals]
        for index, name in enumerate(new_names):
            if name in new_names[:index]:
                raise DataError(f"rename: two signals would be called {name!r}; give every signal its own name")
        return self._with(
            _data={mapping.get(name, name): values for name, values in self._data.items()},
            inputs=tuple(mapping.get(name, name) for name in self.inputs),
            outputs=tuple(mapping.get(name, name) for name in self.outputs),
            _units={mapping.get(name, name): unit for name, unit in self._units.items()},
            _intersample={mapping.get(name, name): kind for name, kind in self._intersample.items()},
        )

    def with_intersample(self, mapping: Mapping[str, str]) -> Run:
        """Return this run with another behaviour of some inputs between rows.

        Parameters
        ----------
        mapping : mapping of str to {"zoh", "foh"}
            Behaviour by input; other inputs keep theirs.

        Returns
        -------
        Run

        Raises
        ------
        DataError
            If a name is not an input or a behaviour is neither "zoh" nor "foh".
        """
        return self._with(_intersample={**self._intersample, **checked_intersample(mapping, self.inputs)})

    def select(self, names: Iterable[str]) -> Run:
        """Return this run with some of its signals only.

        Parameters
        ----------
        names : iterable of str
            Signals to keep, in this order within inputs and outputs; at least one output.

        Returns
        -------
        Run

        Raises
        ------
        DataError
            If a name is unknown or given twice, or no output is left.
        """
        kept = list(names_to_columns("names", names))
        for name in kept:
            if name not in self:
                raise self._unknown(name)
        outputs = tuple(name for name in kept if name in self.outputs)
        if not outputs:
            raise DataError(f"select: no output is left; keep at least one of {listed(self.outputs)}")
        inputs = tuple(name for name in kept if name in self.inputs)
        return self._with(
            _data={name: self._data[name] for name in inputs + outputs},
            inputs=inputs,
            outputs=outputs,
            _units={name: self._units[name] for name in inputs + outputs},
            _intersample={name: self._intersample[name] for name in inputs},
        )

    def require_outputs(self, names: Iterable[str]) -> None:
        """Raise unless every name is an output of this run that an equation can be estimated from.

        Parameters
        ----------
        names : iterable of str
            Outputs that are needed.

        Raises
        ------
        DataError
            If a name is not an output of this run, or all its samples are equal.
        """
        for name in names_to_columns("names", names):
            if name not in self.outputs:
                raise DataError(
                    f"output {name!r} is not in run {self.name!r}{nearest(name, self.outputs)}; "
                    f"its outputs are {listed(self.outputs)}"
                )
            values = self._data[name]
            if is_constant(values):
                raise bad_rows(
                    f"output {name!r} of run {self.name!r}",
                    f"constant, every row is {float(values[0])!r}",
                    0,
                    values.size,
                    "check the sensor and the column, or load a part of the record in which it moves with slice=",
                )

    def advice(self, structure: Structure | None = None) -> Advice:
        """What to know about this run before a model is identified from it, in sentences with numbers.

        Looks for dead, constant and zeroed channels, saturation, spikes, encoders that wrap, outputs that do not start
        at rest, drift that no input explains, feedback from outputs to inputs, runs that are too short, and inputs that
        excite too little. Nothing is repaired.

        Parameters
        ----------
        structure : Structure, optional
            What is to be identified: its free numbers are counted against the inputs' spectral lines.

        Returns
        -------
        Advice
            Prints as sentences; empty where nothing stands out.
        """
        return advise(self, structure)

    def to_csv(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write this run to a csv file that `ftlm.load` reads back bit for bit, without being told the columns.

        The first line is a comment, ``# ftlm-run 1`` and a JSON object that holds name, step, start, inputs, outputs,
        units, intersample and warnings, and `about` where a rig made the run; then come a header ``t_s,…`` and the
        rows. The file is written beside its place and renamed, so a reader never sees half of it.

        Parameters
        ----------
        path : path
            File to write.
        force : bool, default False
            Overwrite a file that exists.

        Raises
        ------
        DataError
            If the file exists and `force` is not set, or it cannot be written.
        """
        target = new_file(path, force=force)
        columns = [written_time(self), *(self._data[name] for name in self.signals)]
        lines = [
            f"{CSV_MARK}{header_text(self)}",
            ",".join([CSV_TIME, *self.signals]),
            *map(",".join, zip(*(map(repr, column.tolist()) for column in columns), strict=True)),
            "",
        ]
        write_bytes_atomically(target, "\n".join(lines).encode())

    def to_parquet(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write this run to a parquet file that `ftlm.load` reads back bit for bit; needs pyarrow.

        A column ``t_s`` and one a signal, float64; the header of `to_csv` is the metadata ``ftlm-run``.

        Parameters
        ----------
        path : path
            File to write.
        force : bool, default False
            Overwrite a file that exists.

        Raises
        ------
        DataError
            If pyarrow is not installed, the file exists and `force` is not set, or it cannot be written.
        """
        target = new_file(path, force=force)
        try:
            pyarrow = importlib.import_module("pyarrow")
            parquet = importlib.import_module("pyarrow.parquet")
        except ImportError:
            raise DataError(f"{str(target)!r}: parquet needs pyarrow; run: pip install 'ftlm[parquet]'") from None
        columns = {CSV_TIME: written_time(self)} | {name: self._data[name] for name in self.signals}
        table = pyarrow.table(columns).replace_schema_metadata({"ftlm-run": header_text(self)})
        content = io.BytesIO()
        # Checksums, so that a flipped byte is no other answer.
        parquet.write_table(table, content, write_page_checksum=True)
        write_bytes_atomically(target, content.getvalue())

    def _known(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(Measured)}

    def _with(self, **changes: Any) -> Run:
        return _of(**{**self._known(), **changes})

    def _headline(self) -> str:
        return (
            f"Run {self.name!r}: {self.length} rows, step {self.step:.12g} s, duration {self.duration:.12g} s, "
            f"source time {self.start:.12g} s"
        )

    def _described(self, name: str) -> str:
        unit = f" [{self._units[name]}]" if self._units[name] else ""
        return name + unit + (f" {self._intersample[name]}" if name in self._intersample else "")


def build(
    *,
    step: float | None,
    time: object,
    inputs: Mapping[str, object],
    outputs: Mapping[str, object],
    units: Mapping[str, str] | None,
    intersample: Mapping[str, str] | None,
    name: str,
    resample: float | None,
    window: Sequence[float | None] | None,
    time_unit: str = "s",
    labels: Mapping[str, str] | None = None,
    time_label: str = "time",
    known_step: float | None = None,
    facts: tuple[str, ...] = (),
    about: Mapping[str, Any] | None = None,
) -> Run:
    """Check everything and make the run; `labels` says what errors call a signal, `known_step` what the file stated."""
    check_run_name(name)
    for signal in (*inputs, *outputs):
        check_signal_name(signal)
    both = [signal for signal in inputs if signal in outputs]
    if both:
        raise DataError(f"signal {both[0]!r} is both an input and an output, {len(both)} in all; give it two names")
    if not outputs:
        raise DataError("outputs=: there is none; name at least one output")
    if (step is None) == (time is None):
        given = "neither is given" if step is None else "both are given"
        raise DataError(f"step= and time=: {given}; pass exactly one of them")
    order = (*inputs, *outputs)
    scales = checked_units(units, order)
    behaviour: dict[str, Intersample] = {
        **dict.fromkeys(inputs, HELD),
        **checked_intersample(intersample, tuple(inputs)),
    }
    new_step = None if resample is None else checked_step(resample, "resample")

    things = {signal: (labels or {}).get(signal, f"signal {signal!r}") for signal in order}
    vectors = {signal: as_vector({**inputs, **outputs}[signal], things[signal])[0] for signal in order}
    lengths = {things[signal]: vector.size for signal, vector in vectors.items()}
    if time is None:
        if time_unit != "s":
            raise DataError(f"time_unit={time_unit!r} is the unit of time=, which is not given; step= is in s")
        fixed = checked_step(step, "step")
        rows = min(lengths.values())
        clock, resolution = grid_of(rows, fixed), 0.0
    else:
        fixed = None
        if not isinstance(time_unit, str) or time_unit not in TIME_UNITS:
            raise DataError(f"time_unit={time_unit!r} is unknown; the known ones are {listed(TIME_UNITS)}")
        clock, dtype = as_vector(time, time_label)
        lengths = {time_label: clock.size, **lengths}
        clock = clock * TIME_UNITS[time_unit]
        precision = np.finfo(dtype).eps if dtype.kind == "f" and dtype.itemsize < 8 else np.finfo(np.float64).eps
        resolution = float(precision) * float(np.abs(clock).max())
    check_lengths(lengths)

    first = 0
    if window is not None:
        first, last = window_rows(clock, window, "slice", time_label)
        clock = clock[first:last]
        vectors = {signal: vector[first:last] for signal, vector in vectors.items()}
    if clock.size < FEWEST_ROWS:
        raise DataError(
            f"{next(iter(lengths))}: {clock.size} rows{' in the slice' if window is not None else ''}, "
            f"{FEWEST_ROWS} are needed; use a longer record"
        )

    data: dict[str, Floats] = {}
    for signal, vector in vectors.items():
        check_values(vector, things[signal], first)
        with np.errstate(over="ignore"):
            data[signal] = vector * scales[signal][1] if scales[signal][1] != 1.0 else vector
        check_values(data[signal], f"{things[signal]} in {scales[signal][0]}", first)

    if fixed is not None:
        spacing = fixed
        begin = float(f"{first * fixed:.12g}")
    else:
        check_values(clock, time_label, first)
        check_increasing(clock, time_label, first)
        begin = float(clock[0])
        if new_step is None:
            spacing, fact = regular_step(clock, time_label, first, resolution, known_step)
            facts += fact
        else:
            spacing = new_step
    if new_step is not None:
        since = clock - clock[0]
        data = interpolated(since, data, behaviour, new_step)
        widest = int(np.diff(since).argmax())
        facts += (
            f"resampled to {new_step:.12g} s from intervals of {np.diff(since).min():.6g} to {np.diff(since).max():.6g}"
            f" s, the widest after row {first + widest} ({how_interpolated(behaviour)})",
        )
        spacing = new_step
    return _of(
        name=name, step=spacing, start=begin, inputs=tuple(inputs), outputs=tuple(outputs), _data=data,
        _units={s: scales[s][0] for s in order}, _intersample=behaviour, facts=tuple(dict.fromkeys(facts)),
        _about=dict(about or {}),
    )  # fmt: skip


def _of(**known: Any) -> Run:
    """A run of checked samples."""
    run = object.__new__(Run)
    Measured.__init__(run, **known)
    return run


def _label(signal: str, column: object) -> str:
    return f"signal {signal!r} (column {column!r})"


def _frame_columns(frame: object) -> list[Hashable]:
    if isinstance(frame, Mapping):
        return list(frame)
    # A lazy polars frame is told by its collect(); asking it for its columns would already start work.
    columns = None if hasattr(frame, "collect") else getattr(frame, "columns", None)
    if columns is None:
        columns = getattr(getattr(frame, "dtype", None), "names", None)
    if columns is None or not hasattr(frame, "__getitem__"):
        raise DataError(
            f"frame is a {type(frame).__name__}; pass a pandas or polars DataFrame (collect() a lazy one first), "
            "a dict of arrays or a structured array"
        )
    return list(columns)
