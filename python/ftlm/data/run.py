"""The record of one measured experiment: what verbs read of a run."""

from __future__ import annotations

import copy
import html
import os
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from ftlm.data.construction import Asked, how_read
from ftlm.data.sampling import (
    FEWEST_ROWS,
    Intersample,
    Readings,
    as_vector,
    bridged,
    check_lengths,
    check_rows,
    check_values,
    checked_intersample,
    checked_step,
    grid_of,
    how_interpolated,
    interpolated,
    is_constant,
    locked,
    read,
    trend_of,
    unread,
    window_rows,
)
from ftlm.errors import DataError
from ftlm.structure.input_nonlinearity import Limit
from ftlm.structure.structure import Structure
from ftlm.svg.figure import Figures
from ftlm.utils.validation import Floats, as_mapping, bad_rows, check_signal_name, listed, names_to_columns, nearest

if TYPE_CHECKING:
    from ftlm.validation.data_advice import Advice


@dataclass(frozen=True, eq=False, repr=False)
class Measured:
    """Regular samples of named inputs and outputs in SI units; :class:`ftlm.Run` is what people hold.

    Parameters
    ----------
    name
        What reports call it.
    step, start
        Time between rows, and source time of the first row [s].
    inputs, outputs
        Names.
    facts
        What was done to the data, and what a rig said of them, in words.
    readings
        Rows at times of their own, where these are not those of the grid; on the grid stand means of the hold and
        straight lines.
    """

    name: str
    step: float
    start: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    _data: dict[str, Floats]
    _units: dict[str, str]
    _intersample: dict[str, Intersample]
    facts: tuple[str, ...] = ()
    _about: dict[str, Any] = field(default_factory=dict)
    readings: Readings | None = None

    def __post_init__(self) -> None:
        for name, value in (
            ("_data", {s: locked(self._data[s]) for s in self.signals}),
            ("_units", {s: self._units[s] for s in self.signals}),
            ("_intersample", {s: self._intersample[s] for s in self.inputs}),
            ("_about", copy.deepcopy(self._about)),
        ):
            object.__setattr__(self, name, value)
        if self.readings is not None:
            own = Readings(locked(self.readings.times), {s: locked(self.readings.data[s]) for s in self.signals})
            object.__setattr__(self, "readings", own)

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the inputs, then of the outputs."""
        return self.inputs + self.outputs

    @property
    def units(self) -> dict[str, str]:
        """SI unit of every signal; "" where none was given. A copy."""
        return dict(self._units)

    @property
    def intersample(self) -> dict[str, Intersample]:
        """Behaviour of every input between rows, "zoh" or "foh". A copy."""
        return dict(self._intersample)

    @property
    def length(self) -> int:
        """Number of rows N."""
        return int(self._data[self.outputs[0]].size)

    @property
    def duration(self) -> float:
        """Time from the first row to the last, (N − 1)·step [s]."""
        return (self.length - 1) * self.step

    @property
    def time(self) -> Floats:
        """Time of every row [s], from 0, shape (N,), read-only."""
        return locked(grid_of(self.length, self.step))

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was done to the data and what is odd about them, in words."""
        there = {name: read(self._data[name]) for name in self.outputs}
        constant = tuple(
            f"output {name!r} is constant ({float(values[0])!r} in all {values.size} rows): nothing can be identified "
            "from it"
            for name, values in there.items()
            if values.size and is_constant(values)
        )
        return self.facts + constant

    @property
    def missing(self) -> dict[str, NDArray[np.bool_]]:
        """Outputs that were not read throughout, with the rows of the run (or of its `readings`) that hold no value."""
        data = self._data if self.readings is None else self.readings.data
        gone = {name: unread(data[name]) for name in self.outputs}
        return {name: rows for name, rows in gone.items() if rows.any()}

    def bridged(self) -> Measured:
        """The same with straight lines over what was not read, for a first look; nothing is fitted to these."""
        if not any(unread(self._data[name]).any() for name in self.outputs):
            return self
        told = {f.name: getattr(self, f.name) for f in fields(Measured)}
        return Measured(**{**told, "_data": {name: bridged(values) for name, values in self._data.items()}})

    @property
    def about(self) -> dict[str, Any]:
        """How the run was made, for JSON: a rig says its name, seed, input, parameters and faults. A copy."""
        return copy.deepcopy(self._about)

    def __getitem__(self, name: str) -> Floats:
        """Return a signal in SI units, shape (N,), read-only; `DataError` for an unknown name."""
        try:
            return self._data[name]
        except (KeyError, TypeError):
            raise self._unknown(name) from None

    def __contains__(self, name: object) -> bool:
        return name in self.signals

    def _unknown(self, name: object) -> DataError:
        return DataError(
            f"signal {name!r} is not in run {self.name!r}{nearest(name, self.signals)}; "
            f"its signals are {listed(self.signals)}"
        )


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
        return run_of, (Measured(**self._fields()),)

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
        missing: str = "refuse",
    ) -> Run:
        """Make a run from one-dimensional arrays.

        Parameters
        ----------
        step : float, optional
            Time between rows [s], > 0. Exactly one of `step` and `time` is given.
        time : array_like, shape (N,), optional
            Time of every row in `time_unit`, or dates (datetime64, datetime), which count from the first row on;
            increasing. It is regular when every row lies within 2 % of a step of its
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
            Put the run on this step [s]: held inputs by the mean of the hold over each new interval, everything
            else linearly. Recorded in `warnings`. Where the rows were not regular, or outputs were not read
            throughout, they stay in `readings`: output error simulates under the inputs as they were, and compares
            with each output when it was read. Methods of the equation error see the straight lines.
        slice : pair of float or None, optional
            Use the rows with a ≤ t < b only, [s] since the first row; applied before any other check of the rows.
        time_unit : {"s", "ms", "us", "min", "h"}, default "s"
            Unit of `time`.
        missing : {"refuse", "weight", "hold"}, default "refuse"
            What to do about values that are not there: NaN, None in a list, masked values, rows that a regular `time`
            lacks. ``"weight"``: of outputs; they stay NaN and weigh nothing wherever output error is fitted or judged,
            every other method refuses the run. ``"hold"``: of inputs as well, which hold their last value (a straight
            line where they are ``"foh"``). What was missing is said in `warnings`.

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
        asked = Asked(
            as_mapping("inputs", {} if inputs is None else inputs),
            as_mapping("outputs", outputs),
            step=step,
            time=time,
            units=units,
            intersample=intersample,
            name=name,
            resample=resample,
            window=slice,
            time_unit=time_unit,
            missing=missing,
        )
        return built(asked)

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
        time_unit: str | None = None,
        missing: str = "refuse",
    ) -> Run:
        """Make a run from a pandas or polars frame, an xarray dataset, a dict of arrays or a structured array.

        Parameters
        ----------
        frame : frame
            Columns are taken as ``frame[column]``.
        time : hashable, optional
            Column that holds the time, or the name of the frame's index. Without `time` and `step` that index is the
            time where it holds dates or is called t, time or seconds; of a dataset its only dimension.
        step : float, optional
            Time between rows [s], > 0.
        inputs, outputs : mapping of str to column, or list of str
            Columns by signal name; a list names columns that keep their names.
        units, intersample, name, resample, slice, missing
            As in `Run.from_arrays`.
        time_unit : {"s", "ms", "us", "min", "h"}, optional
            Unit of the time column; where not given, the one that its name states, as in ``time [ms]`` (said in the
            run's `warnings`), or else s. A name that states another one is refused.

        Returns
        -------
        Run

        Raises
        ------
        DataError
            If a column is unknown or there more than once, and for everything `Run.from_arrays` refuses.
        """
        from ftlm.data.export import asked_of_frame

        asked = asked_of_frame(
            frame,
            time=time,
            step=step,
            inputs=inputs,
            outputs=outputs,
            units=units,
            intersample=intersample,
            name=name,
            resample=resample,
            window=slice,
            time_unit=time_unit,
            missing=missing,
        )
        return built(asked)

    def __repr__(self) -> str:
        lines = [self._headline()]
        if self.inputs:
            lines.append("  inputs:  " + ", ".join(self._described(name) for name in self.inputs))
        lines.append("  outputs: " + ", ".join(self._described(name) for name in self.outputs))
        lines.extend(f"  warning: {text}" for text in self.warnings)
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td>{html.escape(name)}</td>"
            f"<td>{f'input ({self._intersample[name]})' if name in self._intersample else 'output'}</td>"
            f"<td>{html.escape(self._units[name])}</td>"
            f"<td>{np.nanmin(self._data[name]):.6g}</td><td>{np.nanmax(self._data[name]):.6g}</td></tr>"
            for name in self.signals
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
        readings = self.readings
        if readings is not None:
            readings = readings.part(self._intersample, first * self.step, (last - 1) * self.step, self.step)
        return self._with(_data=data, start=begin, readings=readings)

    def resample(self, step: float) -> Run:
        """Return this run interpolated onto another step.

        Held inputs ("zoh") take their mean over each new interval, the exact integral of the hold; inputs that are
        "foh" and all outputs are interpolated linearly. There is no anti-alias filter. The result says so in
        `warnings`.

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
        since, readings, how = grid_of(self.length, self.step), self.readings, how_interpolated(self._intersample)
        if readings is None and self.missing:
            readings = Readings(since, self._data)
        if readings is None:
            data = interpolated(since, self._data, self._intersample, new_step)
        else:
            check_rows(readings.times, new_step)
            data, how = readings.on(self._intersample, new_step), how_read(self._intersample)
        fact = f"resampled from {self.step:.12g} s to {new_step:.12g} s ({how})"
        return self._with(_data=data, step=new_step, facts=(*self.facts, fact), readings=readings)

    def detrend(self, kind: str = "constant", signals: Iterable[str] | None = None) -> Run:
        """Return this run less the mean, or the straight line of least squares, of some signals.

        A mean belongs to the record, not to the system: the mean of a record that does not end where it began holds
        part of the response. An offset in the structure (``+ c``) estimates it instead. The result says in `warnings`
        what was subtracted.

        Parameters
        ----------
        kind : {"constant", "linear"}, default "constant"
            What is subtracted.
        signals : iterable of str, optional
            Which signals; default all inputs and outputs.

        Returns
        -------
        Run

        Raises
        ------
        DataError
            If the kind is neither, or a name is unknown or given twice.
        """
        if kind not in ("constant", "linear"):
            raise DataError(f"detrend: kind = {kind!r} is not known; use 'constant' or 'linear'")
        wanted = self.signals if signals is None else tuple(names_to_columns("signals", signals))
        unknown = next((name for name in wanted if name not in self), None)
        if unknown is not None:
            raise self._unknown(unknown)
        data, facts, readings = dict(self._data), list(self.facts), self.readings
        for name in wanted:
            trend, words = trend_of(self._data[name], self.step, linear=kind == "linear")
            data[name] = self._data[name] - trend(self.time)
            if readings is not None:
                readings = readings.changed(**{name: readings.data[name] - trend(readings.times)})
            facts.append(f"detrended: {words} subtracted from {name}")
        return self._with(_data=data, facts=tuple(facts), readings=readings)

    def bent(self, limits: Sequence[Limit]) -> Run:
        """Return this run with inputs as known saturations and dead zones let them act, sample by sample."""
        data, readings = dict(self._data), self.readings
        for limit in limits:
            data[limit.signal] = limit.of(data[limit.signal])
            if readings is not None:
                readings = readings.changed(**{limit.signal: limit.of(readings.data[limit.signal])})
        return self._with(_data=data, readings=readings)

    def with_samples(self, samples: Mapping[str, Floats], read: Mapping[str, Floats] | None = None) -> Run:
        """Return this run with other samples of some of its signals.

        Parameters
        ----------
        samples : mapping of str to array
            New samples by name, shape (N,).
        read : mapping of str to array, optional
            The same at the rows' own times, if it has some.
        """
        readings = self.readings and self.readings.changed(**(read or {}))
        return self._with(_data={**self._data, **samples}, readings=readings)

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
        renamed = {name: mapping.get(name, name) for name in self.signals}
        names = list(renamed.values())
        for index, name in enumerate(names):
            if name in names[:index]:
                raise DataError(f"rename: two signals would be called {name!r}; give every signal its own name")
        return self._with(
            inputs=tuple(renamed[name] for name in self.inputs),
            outputs=tuple(renamed[name] for name in self.outputs),
            _data={renamed[name]: values for name, values in self._data.items()},
            _units={renamed[name]: unit for name, unit in self._units.items()},
            _intersample={renamed[name]: kind for name, kind in self._intersample.items()},
            readings=None
            if self.readings is None
            else Readings(self.readings.times, {renamed[name]: v for name, v in self.readings.data.items()}),
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
        behaviour = {**self._intersample, **checked_intersample(mapping, self.inputs)}
        data = self._data if self.readings is None else self.readings.on(behaviour, self.step)
        return self._with(_intersample=behaviour, _data={n: v[: self.length] for n, v in data.items()})

    def with_outputs(self, values: Mapping[str, Floats]) -> Run:
        """Return this run with further outputs, or other values of its own; on its grid, known throughout.

        Parameters
        ----------
        values : mapping of str to array, shape (N,)
            Numbers by name, finite, in SI units.

        Returns
        -------
        Run

        Raises
        ------
        DataError
            If a name is an input of this run, is no name, or its values are not N finite numbers.
        """
        given = {n: as_vector(v, f"output {n!r}")[0] for n, v in as_mapping("values", values).items()}
        for name, numbers in given.items():
            check_signal_name(name)
            if name in self.inputs:
                raise DataError(f"with_outputs: {name!r} is an input of run {self.name!r}; give it another name")
            check_lengths({f"run {self.name!r}": self.length, f"output {name!r}": numbers.size})
            check_values(numbers, f"output {name!r}", 0)
        readings = self.readings
        if readings is not None:
            readings = readings.changed(**{n: np.interp(readings.times, self.time, v) for n, v in given.items()})
        return self._with(
            outputs=tuple(dict.fromkeys([*self.outputs, *given])),
            _data={**self._data, **given},
            _units={**dict.fromkeys(given, ""), **self._units},
            readings=readings,
        )

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
        # The record keeps what is told of its own signals alone.
        return self._with(inputs=inputs, outputs=outputs)

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
            there = read(values)
            if there.size == 0:
                raise DataError(
                    f"output {name!r} of run {self.name!r}: none of its {values.size} rows holds a value; use a part "
                    "of the record in which it was read"
                )
            if is_constant(values):
                thing, what = f"output {name!r} of run {self.name!r}", f"constant, every row is {float(there[0])!r}"
                way_out = "check the sensor and the column, or load a part of the record in which it moves with slice="
                raise bad_rows(thing, what, 0, values.size, way_out)

    def plot(self, *signals: str) -> Figures:
        """Charts of signals over time, outputs first: a notebook shows them; for matplotlib see ``ftlm.plot.run``.

        Raises
        ------
        DataError
            A name that is no signal of the run.
        """
        from ftlm.plot.comparison_charts import picture

        return picture(self, *signals)

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
        from ftlm.validation.data_advice import advise

        return advise(self, structure)

    def to_csv(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write this run to a csv file that `ftlm.load` reads back bit for bit, without being told the columns.

        The first line is a comment, ``# ftlm-run 1`` and a JSON object that holds name, step, start, inputs, outputs,
        units, intersample and warnings, and `about` where a rig made the run; then come a header ``t_s,…`` and the
        rows, ``nan`` where an output was not read. `readings` stay behind: what is written is the grid. The file is
        written beside its place and renamed, so a reader never sees half of it.

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
        from ftlm.data.export import write_csv

        write_csv(self, path, force=force)

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
        from ftlm.data.export import write_parquet

        write_parquet(self, path, force=force)

    def to_frame(self) -> Any:
        """Return the run as a pandas frame: a column a signal in SI units, the source time ``t_s`` [s] as its index.

        `Run.from_frame` takes it back. What is told of the signals stands in its ``attrs``: units, inputs, outputs,
        intersample, name.

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        ModelError
            If pandas is not installed.
        """
        from ftlm.data.export import frame_of

        return frame_of(self)

    def to_xarray(self) -> Any:
        """Return the run as an xarray dataset over ``t_s`` [s], attributes as of `to_frame`.

        Returns
        -------
        xarray.Dataset

        Raises
        ------
        ModelError
            If xarray is not installed.
        """
        from ftlm.data.export import dataset_of

        return dataset_of(self)

    def _fields(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(Measured)}

    def _with(self, **changes: Any) -> Run:
        return run_of(Measured(**{**self._fields(), **changes}))

    def _headline(self) -> str:
        return (
            f"Run {self.name!r}: {self.length} rows, step {self.step:.12g} s, duration {self.duration:.12g} s, "
            f"source time {self.start:.12g} s"
        )

    def _described(self, name: str) -> str:
        unit = f" [{self._units[name]}]" if self._units[name] else ""
        return name + unit + (f" {self._intersample[name]}" if name in self._intersample else "")


def built(asked: Asked) -> Run:
    """Check all that is asked of a run, and make it."""
    return run_of(asked.measured())


def run_of(record: Measured) -> Run:
    """Return a record of checked samples as what people hold."""
    run = object.__new__(Run)
    Measured.__init__(run, **{f.name: getattr(record, f.name) for f in fields(Measured)})
    return run


#: Results that are kept with runs: those of the equations one by one and of the whole.
MOST_KEPT = 8


def check_compatible(runs: Iterable[Run]) -> None:
    """Refuse runs whose inputs, outputs or units differ; steps, lengths, holds and the order of signals may."""
    every = list(runs)
    if not every:
        raise DataError("runs: there is none; pass at least one run")
    first = every[0]
    for index, run in enumerate(every[1:], start=1):
        who = f"run {index} ({run.name!r}) and run 0 ({first.name!r})"
        for role, mine, other in (("inputs", first.inputs, run.inputs), ("outputs", first.outputs, run.outputs)):
            if set(mine) != set(other):
                raise DataError(
                    f"{who} have different {role}: {listed(other)} and {listed(mine)}; "
                    "use rename() and select() so that the names agree"
                )
        units, first_units = run.units, first.units
        differing = [name for name in first.signals if units[name] != first_units[name]]
        if differing:
            name = differing[0]
            raise DataError(
                f"{who} have different units: signal {name!r} is in {units[name]!r} and {first_units[name]!r}, "
                f"{len(differing)} in all; give the same units= when loading"
            )


class Runs(tuple[Run, ...]):
    """Runs that fit together, checked once; see :func:`as_runs`.

    What is computed from them time and again stays with them, read-only, and goes when they go.
    """

    _kept: dict[str, tuple[Any, ...]]

    def __new__(cls, runs: Run | Iterable[Run]) -> Runs:
        """Check them."""
        try:
            every = [runs] if isinstance(runs, Run) else list(runs)
        except TypeError:
            raise DataError(f"runs is {type(runs).__name__}; give a Run or a list of them") from None
        if not every:
            raise DataError("no run is given; give at least one")
        for i, run in enumerate(every):
            if not isinstance(run, Run):
                raise DataError(f"runs[{i}] is {type(run).__name__}, not a Run; use ftlm.load or Run.from_arrays")
        check_compatible(every)
        checked = super().__new__(cls, every)
        checked._kept = {}
        return checked

    def __reduce__(self) -> tuple[object, ...]:
        return Runs, (tuple(self),)

    def keep(self, key: str, make: Callable[[], Iterable[Any]]) -> tuple[Any, ...]:
        """Return what was made under this key, or make it; the oldest goes where there are too many."""
        made = self._kept.get(key)
        if made is None:
            made = self._kept[key] = tuple(make())
            for old in list(self._kept)[:-MOST_KEPT]:
                self._kept.pop(old, None)
        return made


def as_runs(runs: Run | Iterable[Run]) -> Runs:
    """One run or several that fit together; what is checked passes untouched.

    Raises
    ------
    DataError
        No run, something that is no run, or runs whose names or units differ.
    """
    return runs if isinstance(runs, Runs) else Runs(runs)
