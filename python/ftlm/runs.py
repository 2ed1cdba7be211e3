"""Holds one measured experiment, checked once and never changed afterwards."""

from __future__ import annotations

import contextlib
import copy
import difflib
import functools
import html
import importlib
import io
import json
import math
import os
import re
from collections.abc import Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from ftlm.errors import DataError

if TYPE_CHECKING:
    from ftlm.advice import Advice
    from ftlm.models import Structure

__all__ = ["Run", "check_compatible"]

Array: TypeAlias = npt.NDArray[np.float64]
Intersample: TypeAlias = Literal["zoh", "foh"]

# Values are squared by every estimator; beyond this the square leaves double precision.
_LARGEST = 1e150
_FEWEST_ROWS = 3
_MOST_ROWS = 50_000_000
_SMALLEST_STEP, _LARGEST_STEP = 1e-30, 1e30
_JITTER = 0.02
_JITTER_WORTH_SAYING = 1e-3
_GAP = 1.5
# A limit typed by a person (1.1 s) must catch the row it names although t - t0 is off by a rounding error.
_EDGE = 1e-6
_HELD: Intersample = "zoh"
_CSV_TIME = "t_s"
_CSV_MARK = "# ftlm-run "
_CSV_VERSION = 1
_NAME_LENGTH = 200
_SIGNAL_NAME = re.compile(r"[^\W\d][\w.\[\]]*")

_UNITS: dict[str, tuple[str, float]] = {
    "": ("", 1.0),
    "1": ("1", 1.0),
    "rad": ("rad", 1.0),
    "deg": ("rad", math.pi / 180.0),
    "°": ("rad", math.pi / 180.0),
    "mrad": ("rad", 1e-3),
    "A": ("A", 1.0),
    "mA": ("A", 1e-3),
    "V": ("V", 1.0),
    "mV": ("V", 1e-3),
    "m": ("m", 1.0),
    "cm": ("m", 1e-2),
    "mm": ("m", 1e-3),
    "s": ("s", 1.0),
    "N": ("N", 1.0),
    "N·m": ("N·m", 1.0),
    "N⋅m": ("N·m", 1.0),
    "N*m": ("N·m", 1.0),
    "N.m": ("N·m", 1.0),
    "Nm": ("N·m", 1.0),
    "degC": ("degC", 1.0),
    "°C": ("degC", 1.0),
    "C": ("degC", 1.0),
    "K": ("K", 1.0),
    "rad/s": ("rad/s", 1.0),
    "deg/s": ("rad/s", math.pi / 180.0),
    "rpm": ("rad/s", 2.0 * math.pi / 60.0),
    "m/s": ("m/s", 1.0),
    "m/s^2": ("m/s^2", 1.0),
    "m/s²": ("m/s^2", 1.0),
    "g": ("m/s^2", 9.80665),
    "Pa": ("Pa", 1.0),
    "kPa": ("Pa", 1e3),
    "W": ("W", 1.0),
    "Hz": ("Hz", 1.0),
}

_TIME_UNITS: dict[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "min": 60.0, "h": 3600.0}


def listed(names: Iterable[object], most: int = 40) -> str:
    """Return names for an error message: quoted, joined, and cut off after `most` of them."""
    every = [repr(name) for name in names]
    if not every:
        return "none"
    return ", ".join(every[:most]) + (f", … and {len(every) - most} more" if len(every) > most else "")


def nearest(word: object, names: Iterable[object]) -> str:
    """Return " (did you mean …?)" for the closest of names, or an empty string."""
    options = [str(name) for name in names]
    begun = [option for option in options if len(option) > 1 and str(word).casefold().startswith(option.casefold())]
    found = [max(begun, key=len)] if begun else difflib.get_close_matches(str(word), options, n=1, cutoff=0.5)
    return f" (did you mean {found[0]!r}?)" if found else ""


def bad_rows(thing: str, what: str, first: int, count: int, way_out: str) -> DataError:
    """Return the error for bad rows: the thing, the first 0-based row, the count and the way out."""
    return DataError(f"{thing}: {what}, first at row {first}, {count} in all; {way_out}")


def names_to_columns(argument: str, given: object) -> dict[str, Hashable]:
    """Return {signal: column} for what a person gave: nothing, one name, a list of names or a mapping."""
    if given is None:
        return {}
    if isinstance(given, str):
        return {given: given}
    if isinstance(given, Mapping):
        return dict(given)
    if not isinstance(given, Iterable):
        raise DataError(f"{argument}= is a {type(given).__name__}; pass a dict of name: column, or a list of names")
    names = list(given)
    for index, name in enumerate(names):
        if not isinstance(name, str):
            raise DataError(f"{argument}=: entry {index} is {name!r}, not a name; pass a dict of name: column")
        if name in names[:index]:
            raise DataError(f"{argument}=: the name {name!r} is given twice; give every name once")
    return {name: name for name in names}


class Run:
    """One measured experiment: regular samples of named inputs and outputs in SI units.

    A run never changes. It is made by `Run.from_arrays`, `Run.from_frame` or `ftlm.load`, which check the data once:
    whatever cannot be used as given is refused with a `DataError` that names the signal, the first bad row (counted
    from 0), the number of bad rows and what to do. Nothing is repaired, resampled or clipped unless asked for, and
    what was asked for is stated in `warnings`.

    Row j holds the outputs read at t = j·step and the inputs of that moment; between rows an input behaves as
    `intersample` says: ``"zoh"`` (a command, held until the next row) or ``"foh"`` (a measured signal, linear).
    """

    __slots__ = (
        "_about",
        "_data",
        "_facts",
        "_inputs",
        "_intersample",
        "_name",
        "_outputs",
        "_start",
        "_step",
        "_units",
    )

    _name: str
    _step: float
    _start: float
    _inputs: tuple[str, ...]
    _outputs: tuple[str, ...]
    _units: dict[str, str]
    _intersample: dict[str, Intersample]
    _facts: tuple[str, ...]
    _data: dict[str, Array]
    _about: dict[str, Any]

    def __init__(self) -> None:
        raise TypeError("a Run is made by Run.from_arrays, Run.from_frame or ftlm.load")

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise AttributeError(f"a Run never changes; {name!r} cannot be set")

    def __delattr__(self, name: str) -> NoReturn:
        raise AttributeError(f"a Run never changes; {name!r} cannot be deleted")

    def __reduce__(self) -> tuple[object, ...]:
        return functools.partial(
            _restore,
            name=self._name,
            step=self._step,
            start=self._start,
            data=self._data,
            inputs=self._inputs,
            outputs=self._outputs,
            units=self._units,
            intersample=self._intersample,
            facts=self._facts,
            about=self._about,
        ), ()

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
        given_inputs = _mapping("inputs", {} if inputs is None else inputs)
        given_outputs = _mapping("outputs", outputs)
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

    @property
    def name(self) -> str:
        """What reports call this run."""
        return self._name

    @property
    def step(self) -> float:
        """Time between rows [s]."""
        return self._step

    @property
    def start(self) -> float:
        """Source time of the first row [s]."""
        return self._start

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return self._inputs

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self._outputs

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the inputs, then of the outputs."""
        return self._inputs + self._outputs

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
        return int(self._data[self._outputs[0]].size)

    @property
    def duration(self) -> float:
        """Time from the first row to the last, (N − 1)·step [s]."""
        return (self.length - 1) * self._step

    @property
    def time(self) -> Array:
        """Time of every row [s], from 0, shape (N,), read-only."""
        return _locked(_grid(self.length, self._step))

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was done to the data and what is odd about them, in words."""
        constant = tuple(
            f"output {name!r} is constant ({float(self._data[name][0])!r} in all {self.length} rows): nothing can be "
            "identified from it"
            for name in self._outputs
            if _is_constant(self._data[name])
        )
        return self._facts + constant

    @property
    def about(self) -> dict[str, Any]:
        """How the run was made, for JSON: a rig says its name, seed, input, parameters and faults. A copy."""
        return copy.deepcopy(self._about)

    def __getitem__(self, name: str) -> Array:
        """Return a signal in SI units, shape (N,), read-only; `DataError` for an unknown name."""
        try:
            return self._data[name]
        except (KeyError, TypeError):
            raise self._unknown(name) from None

    def __contains__(self, name: object) -> bool:
        return name in self.signals

    def __repr__(self) -> str:
        lines = [self._headline()]
        if self._inputs:
            lines.append("  inputs:  " + ", ".join(self._described(name) for name in self._inputs))
        lines.append("  outputs: " + ", ".join(self._described(name) for name in self._outputs))
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
        first, last = _window_rows(_grid(self.length, self._step), (start, stop), "slice")
        if last - first < _FEWEST_ROWS:
            raise DataError(f"slice: {last - first} rows remain, {_FEWEST_ROWS} are needed; widen the limits")
        data = {name: values[first:last] for name, values in self._data.items()}
        # The digits beyond the twelfth come from the sum and not from the source.
        begin = self._start if first == 0 else float(f"{self._start + first * self._step:.12g}")
        return self._with(data=data, start=begin)

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
        new_step = _checked_step(step, "resample")
        data = _interpolated(_grid(self.length, self._step), self._data, self._intersample, new_step)
        fact = f"resampled from {self._step:.12g} s to {new_step:.12g} s ({self._how_interpolated()})"
        return self._with(data=data, step=new_step, facts=(*self._facts, fact))

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
            _check_signal_name(new)
        new_names = [mapping.get(name, name) for name in self.signals]
        for index, name in enumerate(new_names):
            if name in new_names[:index]:
                raise DataError(f"rename: two signals would be called {name!r}; give every signal its own name")
        return self._with(
            data={mapping.get(name, name): values for name, values in self._data.items()},
            inputs=tuple(mapping.get(name, name) for name in self._inputs),
            outputs=tuple(mapping.get(name, name) for name in self._outputs),
            units={mapping.get(name, name): unit for name, unit in self._units.items()},
            intersample={mapping.get(name, name): kind for name, kind in self._intersample.items()},
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
        return self._with(intersample={**self._intersample, **_checked_intersample(mapping, self._inputs)})

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
        outputs = tuple(name for name in kept if name in self._outputs)
        if not outputs:
            raise DataError(f"select: no output is left; keep at least one of {listed(self._outputs)}")
        inputs = tuple(name for name in kept if name in self._inputs)
        return self._with(
            data={name: self._data[name] for name in inputs + outputs},
            inputs=inputs,
            outputs=outputs,
            units={name: self._units[name] for name in inputs + outputs},
            intersample={name: self._intersample[name] for name in inputs},
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
            if name not in self._outputs:
                raise DataError(
                    f"output {name!r} is not in run {self._name!r}{nearest(name, self._outputs)}; "
                    f"its outputs are {listed(self._outputs)}"
                )
            values = self._data[name]
            if _is_constant(values):
                raise bad_rows(
                    f"output {name!r} of run {self._name!r}",
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
        from ftlm.advice import advise  # noqa: PLC0415 — advice reads runs

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
        target = _new_file(path, force=force)
        columns = [self._written_time(), *(self._data[name] for name in self.signals)]
        lines = [
            f"{_CSV_MARK}{self._header()}",
            ",".join([_CSV_TIME, *self.signals]),
            *map(",".join, zip(*(map(repr, column.tolist()) for column in columns), strict=True)),
            "",
        ]
        _write_atomically(target, "\n".join(lines).encode())

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
        target = _new_file(path, force=force)
        try:
            pyarrow = importlib.import_module("pyarrow")
            parquet = importlib.import_module("pyarrow.parquet")
        except ImportError:
            raise DataError(f"{str(target)!r}: parquet needs pyarrow; run: pip install 'ftlm[parquet]'") from None
        columns = {_CSV_TIME: self._written_time()} | {name: self._data[name] for name in self.signals}
        table = pyarrow.table(columns).replace_schema_metadata({"ftlm-run": self._header()})
        content = io.BytesIO()
        # Checksums, so that a flipped byte is no other answer.
        parquet.write_table(table, content, write_page_checksum=True)
        _write_atomically(target, content.getvalue())

    def _header(self) -> str:
        header = {
            "name": self._name,
            "step": self._step,
            "start": self._start,
            "inputs": list(self._inputs),
            "outputs": list(self._outputs),
            "units": self._units,
            "intersample": self._intersample,
            "warnings": list(self._facts),
        } | ({"about": self._about} if self._about else {})
        return f"{_CSV_VERSION} {json.dumps(header, ensure_ascii=False, allow_nan=False)}"

    def _written_time(self) -> Array:
        exact = self._start + _grid(self.length, self._step)
        # Nine digits below the step read well, and the exact step stands in the header.
        digits = 9 - math.floor(math.log10(self._step))
        if not 0 <= digits <= 15 or np.abs(exact).max() * 10.0**digits >= 2.0**53:
            return exact
        rounded = np.round(exact, digits)
        rounded[0] = self._start
        return rounded

    def _with(
        self,
        *,
        data: dict[str, Array] | None = None,
        step: float | None = None,
        start: float | None = None,
        inputs: tuple[str, ...] | None = None,
        outputs: tuple[str, ...] | None = None,
        units: dict[str, str] | None = None,
        intersample: dict[str, Intersample] | None = None,
        facts: tuple[str, ...] | None = None,
    ) -> Run:
        return _restore(
            name=self._name,
            step=self._step if step is None else step,
            start=self._start if start is None else start,
            data=self._data if data is None else data,
            inputs=self._inputs if inputs is None else inputs,
            outputs=self._outputs if outputs is None else outputs,
            units=self._units if units is None else units,
            intersample=self._intersample if intersample is None else intersample,
            facts=self._facts if facts is None else facts,
            about=self._about,
        )

    def _unknown(self, name: object) -> DataError:
        return DataError(
            f"signal {name!r} is not in run {self._name!r}{nearest(name, self.signals)}; "
            f"its signals are {listed(self.signals)}"
        )

    def _headline(self) -> str:
        return (
            f"Run {self._name!r}: {self.length} rows, step {self._step:.12g} s, duration {self.duration:.12g} s, "
            f"source time {self._start:.12g} s"
        )

    def _described(self, name: str) -> str:
        unit = f" [{self._units[name]}]" if self._units[name] else ""
        return name + unit + (f" {self._intersample[name]}" if name in self._intersample else "")

    def _how_interpolated(self) -> str:
        return _how_interpolated(self._intersample)


def check_compatible(runs: Iterable[Run]) -> None:
    """Raise unless all runs have the same inputs, outputs and units.

    Steps, lengths, intersample behaviour and the order of the signals may differ.

    Parameters
    ----------
    runs : iterable of Run
        At least one.

    Raises
    ------
    DataError
        If there is no run, or names or units differ; the run and the signal are named.
    """
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
    _check_run_name(name)
    for signal in (*inputs, *outputs):
        _check_signal_name(signal)
    both = [signal for signal in inputs if signal in outputs]
    if both:
        raise DataError(f"signal {both[0]!r} is both an input and an output, {len(both)} in all; give it two names")
    if not outputs:
        raise DataError("outputs=: there is none; name at least one output")
    if (step is None) == (time is None):
        given = "neither is given" if step is None else "both are given"
        raise DataError(f"step= and time=: {given}; pass exactly one of them")
    order = (*inputs, *outputs)
    scales = _checked_units(units, order)
    behaviour: dict[str, Intersample] = {
        **dict.fromkeys(inputs, _HELD),
        **_checked_intersample(intersample, tuple(inputs)),
    }
    new_step = None if resample is None else _checked_step(resample, "resample")

    things = {signal: (labels or {}).get(signal, f"signal {signal!r}") for signal in order}
    vectors = {signal: _vector({**inputs, **outputs}[signal], things[signal])[0] for signal in order}
    lengths = {things[signal]: vector.size for signal, vector in vectors.items()}
    if time is None:
        if time_unit != "s":
            raise DataError(f"time_unit={time_unit!r} is the unit of time=, which is not given; step= is in s")
        fixed = _checked_step(step, "step")
        rows = min(lengths.values())
        clock, resolution = _grid(rows, fixed), 0.0
    else:
        fixed = None
        if not isinstance(time_unit, str) or time_unit not in _TIME_UNITS:
            raise DataError(f"time_unit={time_unit!r} is unknown; the known ones are {listed(_TIME_UNITS)}")
        clock, dtype = _vector(time, time_label)
        lengths = {time_label: clock.size, **lengths}
        clock = clock * _TIME_UNITS[time_unit]
        precision = np.finfo(dtype).eps if dtype.kind == "f" and dtype.itemsize < 8 else np.finfo(np.float64).eps
        resolution = float(precision) * float(np.abs(clock).max())
    _check_lengths(lengths)

    first = 0
    if window is not None:
        first, last = _window_rows(clock, window, "slice", time_label)
        clock = clock[first:last]
        vectors = {signal: vector[first:last] for signal, vector in vectors.items()}
    if clock.size < _FEWEST_ROWS:
        raise DataError(
            f"{next(iter(lengths))}: {clock.size} rows{' in the slice' if window is not None else ''}, "
            f"{_FEWEST_ROWS} are needed; use a longer record"
        )

    data: dict[str, Array] = {}
    for signal, vector in vectors.items():
        _check_values(vector, things[signal], first)
        with np.errstate(over="ignore"):
            data[signal] = vector * scales[signal][1] if scales[signal][1] != 1.0 else vector
        _check_values(data[signal], f"{things[signal]} in {scales[signal][0]}", first)

    if fixed is not None:
        spacing = fixed
        begin = float(f"{first * fixed:.12g}")
    else:
        _check_values(clock, time_label, first)
        _check_increasing(clock, time_label, first)
        begin = float(clock[0])
        if new_step is None:
            spacing, fact = _regular_step(clock, time_label, first, resolution, known_step)
            facts += fact
        else:
            spacing = new_step
    if new_step is not None:
        since = clock - clock[0]
        data = _interpolated(since, data, behaviour, new_step)
        widest = int(np.diff(since).argmax())
        facts += (
            f"resampled to {new_step:.12g} s from intervals of {np.diff(since).min():.6g} to {np.diff(since).max():.6g}"
            f" s, the widest after row {first + widest} ({_how_interpolated(behaviour)})",
        )
        spacing = new_step
    return _restore(
        name=name,
        step=spacing,
        start=begin,
        data=data,
        inputs=tuple(inputs),
        outputs=tuple(outputs),
        units={signal: scales[signal][0] for signal in order},
        intersample=behaviour,
        facts=tuple(dict.fromkeys(facts)),
        about=about,
    )


def _restore(
    *,
    name: str,
    step: float,
    start: float,
    data: Mapping[str, Array],
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    units: Mapping[str, str],
    intersample: Mapping[str, Intersample],
    facts: tuple[str, ...],
    about: Mapping[str, Any] | None = None,
) -> Run:
    run = object.__new__(Run)
    for field, value in (
        ("_name", name),
        ("_step", step),
        ("_start", start),
        ("_data", {signal: _locked(data[signal]) for signal in inputs + outputs}),
        ("_inputs", inputs),
        ("_outputs", outputs),
        ("_units", {signal: units[signal] for signal in inputs + outputs}),
        ("_intersample", {signal: intersample[signal] for signal in inputs}),
        ("_facts", facts),
        ("_about", copy.deepcopy(dict(about or {}))),
    ):
        object.__setattr__(run, field, value)
    return run


def _grid(rows: int, step: float) -> Array:
    return np.arange(rows, dtype=np.float64) * step


def _locked(values: Array) -> Array:
    owner = np.ascontiguousarray(values)
    if owner.flags.writeable:
        owner.setflags(write=False)
    # A view of a locked array cannot be unlocked by the one who holds it.
    return owner.view()


def _mapping(argument: str, given: object) -> Mapping[str, object]:
    if not isinstance(given, Mapping):
        raise DataError(f"{argument}= is a {type(given).__name__}; pass a dict of name: array")
    return given


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


def _is_constant(values: Array) -> bool:
    return bool((values == values[0]).all())


def _check_run_name(name: object) -> None:
    if not is_run_name(name):
        raise DataError(
            f"name={name!r} cannot name a run; use 1 to {_NAME_LENGTH} printable characters, not beginning with = + - @"
        )


def is_run_name(name: object) -> bool:
    """Return whether a run may be called this."""
    return isinstance(name, str) and 0 < len(name) <= _NAME_LENGTH and name.isprintable() and name[0] not in "=+-@"


def _check_signal_name(name: object) -> None:
    if not isinstance(name, str) or len(name) > _NAME_LENGTH or not _SIGNAL_NAME.fullmatch(name):
        raise DataError(
            f"{name!r} cannot name a signal; begin with a letter or _ and use letters, digits, _ . [ ] "
            f"(at most {_NAME_LENGTH})"
        )
    if name == _CSV_TIME:
        raise DataError(f"{name!r} is the name of the time in csv files; give the signal another name")


def _checked_units(units: Mapping[str, str] | None, signals: tuple[str, ...]) -> dict[str, tuple[str, float]]:
    given = _mapping("units", {} if units is None else units)
    for signal, unit in given.items():
        if signal not in signals:
            raise DataError(
                f"units=: {signal!r} is not a signal{nearest(signal, signals)}; the signals are {listed(signals)}"
            )
        if not isinstance(unit, str) or unit not in _UNITS:
            raise DataError(
                f"unit {unit!r} of signal {signal!r} is unknown{nearest(unit, _UNITS)}; "
                f"the known units are {listed(_UNITS)}; convert other data before loading"
            )
    return {signal: _UNITS[str(given.get(signal, ""))] for signal in signals}


def _checked_intersample(given: Mapping[str, str] | None, inputs: tuple[str, ...]) -> dict[str, Intersample]:
    checked: dict[str, Intersample] = {}
    for signal, kind in _mapping("intersample", {} if given is None else given).items():
        if signal not in inputs:
            raise DataError(
                f"intersample=: {signal!r} is not an input{nearest(signal, inputs)}; the inputs are {listed(inputs)}"
            )
        if kind not in ("zoh", "foh"):
            raise DataError(
                f"intersample=: {kind!r} of input {signal!r} is unknown; use 'zoh' (held) or 'foh' (linear)"
            )
        checked[signal] = "zoh" if kind == "zoh" else "foh"
    return checked


def _checked_step(step: object, argument: str) -> float:
    value = _number(step)
    if value is None:
        raise DataError(f"{argument}={step!r} is not a number; give the time between rows in s")
    if not _SMALLEST_STEP <= value <= _LARGEST_STEP:
        raise DataError(f"{argument}={value!r} is not a positive, finite time; give the time between rows in s")
    return value


def _number(given: object) -> float | None:
    if isinstance(given, bool) or not isinstance(given, (int, float, np.integer, np.floating)):
        return None
    try:
        return float(given)
    except OverflowError:
        return math.inf


def _vector(given: object, thing: str) -> tuple[Array, np.dtype[Any]]:
    """Return a private float64 copy and the type the numbers came in."""
    if np.ma.isMaskedArray(given):
        mask = np.ma.getmaskarray(cast("Any", given))
        if mask.any():
            rows = np.flatnonzero(mask)
            raise bad_rows(
                thing, "masked (missing) value", int(rows[0]), rows.size, "remove or fill these rows yourself"
            )
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
        raise DataError(f"{thing}: empty, 0 rows; {_FEWEST_ROWS} are needed")
    if array.dtype.kind == "c":
        rows = np.flatnonzero(np.imag(array) != 0)
        first, count = (int(rows[0]), rows.size) if rows.size else (0, array.size)
        raise bad_rows(thing, f"complex number {array[first]}", first, count, "pass a real array, such as x.real")
    if array.dtype.kind not in "biuf":
        raise _not_numbers(given, array, thing)
    with np.errstate(over="ignore"):
        return np.array(array, dtype=np.float64, order="C"), array.dtype


def _not_numbers(given: object, array: npt.NDArray[Any], thing: str) -> DataError:
    way_out = "convert it to numbers first"
    if array.dtype.kind in "Mm":
        return bad_rows(thing, f"dates, not numbers ({array.dtype})", 0, array.size, "convert them to seconds first")
    if array.ndim == 0:
        return DataError(f"{thing}: {_short(array.item())} is not an array; pass one number per row")
    # A list of numbers and words has become an array of words; the list still tells them apart.
    flat = list(given) if isinstance(given, (list, tuple)) and array.ndim == 1 else array.ravel().tolist()
    bad = [index for index, value in enumerate(flat) if not isinstance(value, (int, float, np.number, np.bool_))]
    if not bad:
        return bad_rows(
            thing, f"objects, not numbers (dtype {array.dtype})", 0, len(flat), "use np.asarray(x, dtype=float)"
        )
    what = "missing value None" if flat[bad[0]] is None else f"{_short(flat[bad[0]])} is not a number"
    return bad_rows(thing, what, bad[0], len(bad), way_out)


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "…" + text[-1]


def _check_lengths(lengths: Mapping[str, int]) -> None:
    counts = list(lengths.values())
    expected = max(set(counts), key=lambda count: (counts.count(count), count))
    wrong = [(thing, count) for thing, count in lengths.items() if count != expected]
    if wrong:
        thing, count = wrong[0]
        raise DataError(
            f"{thing}: {count} rows where {expected} are expected, {len(wrong)} of {len(lengths)} columns differ; "
            "give every column one number per row of the same record"
        )


def _check_values(values: Array, thing: str, offset: int) -> None:
    with np.errstate(invalid="ignore"):
        good = np.abs(values) <= _LARGEST
    if good.all():
        return
    rows = np.flatnonzero(~good)
    value = float(values[rows[0]])
    first, count = offset + int(rows[0]), rows.size
    if math.isnan(value):
        raise bad_rows(thing, "NaN", first, count, "remove or fill these rows yourself, or avoid them with slice=")
    if math.isinf(value):
        raise bad_rows(thing, f"infinity ({value})", first, count, "correct these rows, or avoid them with slice=")
    raise bad_rows(
        thing,
        f"{value!r} is larger than {_LARGEST:g} and its square overflows",
        first,
        count,
        "correct these rows, scale the signal, or avoid them with slice=",
    )


def _check_increasing(clock: Array, thing: str, offset: int) -> None:
    steps = np.diff(clock)
    if (steps > 0).all():
        return
    first = int(np.flatnonzero(~(steps > 0))[0])
    if steps[first] == 0:
        raise bad_rows(
            thing,
            f"repeated time {float(clock[first + 1])!r} s",
            offset + first + 1,
            int((steps == 0).sum()),
            "remove the repeated rows, or write the time with more digits",
        )
    raise bad_rows(
        thing,
        f"decreasing time, {float(clock[first + 1])!r} s after {float(clock[first])!r} s",
        offset + first + 1,
        int((steps < 0).sum()),
        "sort the rows, or split the file where the clock starts again",
    )


def _regular_step(
    clock: Array, thing: str, offset: int, resolution: float, known: float | None
) -> tuple[float, tuple[str, ...]]:
    count = clock.size - 1
    since = clock - clock[0]
    mean = float(since[-1]) / count
    if not _SMALLEST_STEP <= mean <= _LARGEST_STEP:
        raise DataError(f"{thing}: the mean step {mean!r} s cannot be used; check the unit of the time")
    deviation = np.abs(since - _grid(clock.size, mean))
    worst = float(deviation.max())
    if worst > _JITTER * mean:
        steps = np.diff(clock)
        usual = float(np.median(steps))
        gaps = np.flatnonzero(steps > _GAP * usual)
        if gaps.size:
            first = int(gaps[0])
            raise bad_rows(
                thing,
                f"gap of {steps[first]:.6g} s where {usual:.6g} s is usual",
                offset + first + 1,
                gaps.size,
                "load the part before or after it with slice=, or interpolate over it with resample=STEP",
            )
        rows = np.flatnonzero(deviation > _JITTER * mean)
        raise bad_rows(
            thing,
            f"jitter of up to {100.0 * worst / mean:.3g} % of the mean step {mean:.6g} s ({100 * _JITTER:g} % allowed)",
            offset + int(rows[0]),
            rows.size,
            "interpolate onto a regular grid with resample=STEP",
        )
    fact = (
        (
            f"time jitters by up to {100.0 * worst / mean:.2g} % of a step, the most at row "
            f"{offset + int(deviation.argmax())}; it was taken as regular",
        )
        if worst > _JITTER_WORTH_SAYING * mean
        else ()
    )
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


def _window_rows(clock: Array, window: object, argument: str, thing: str = "time") -> tuple[int, int]:
    """Return the first row and the row after the last one of start ≤ t < stop."""
    if not isinstance(window, Sequence) or isinstance(window, str) or len(window) != 2:
        raise DataError(f"{argument}={window!r} is not a pair (start, stop) of seconds; use None for an open end")
    limits: list[float | None] = []
    for limit in window:
        value = _number(limit)
        if value is None and limit is not None:
            raise DataError(f"{argument}: limit {limit!r} is not a number of seconds")
        if value is not None and not math.isfinite(value):
            raise DataError(f"{argument}: limit {value!r} is not finite; use None for an open end")
        limits.append(value)
    start, stop = limits
    ends = clock[[0, -1]]
    if not np.isfinite(ends).all():
        raise bad_rows(
            thing,
            "the first or last time is not finite",
            0 if not np.isfinite(ends[0]) else clock.size - 1,
            int((~np.isfinite(clock)).sum()),
            "remove these rows; slice= counts from the first time",
        )
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


def _interpolated(
    since: Array, data: Mapping[str, Array], behaviour: Mapping[str, Intersample], step: float
) -> dict[str, Array]:
    spans = float(since[-1]) / step
    if spans + 1 > _MOST_ROWS:
        raise DataError(f"resample={step!r} gives more than {_MOST_ROWS} rows; use a larger step")
    rows = math.floor(spans + _EDGE) + 1
    if rows < _FEWEST_ROWS:
        raise DataError(f"resample={step!r} leaves {rows} rows, {_FEWEST_ROWS} are needed; use a smaller step")
    grid = _grid(rows, step)
    held = np.searchsorted(since, grid + _EDGE * step, side="right") - 1
    return {
        signal: values[held] if behaviour.get(signal) == "zoh" else np.interp(grid, since, values)
        for signal, values in data.items()
    }


def _how_interpolated(behaviour: Mapping[str, Intersample]) -> str:
    held = [signal for signal, kind in behaviour.items() if kind == "zoh"]
    return f"{'held: ' + ', '.join(held) + '; ' if held else ''}others linear; no anti-alias filter"


def _new_file(path: str | os.PathLike[str], *, force: bool) -> Path:
    target = Path(path)
    if target.is_dir():
        raise DataError(f"{str(target)!r} is a folder; give the name of a file in it")
    if not force and os.path.lexists(target):
        raise DataError(f"{str(target)!r} exists; choose another name, or overwrite it with force=True (--force)")
    return target


def _write_atomically(target: Path, content: bytes) -> None:
    beside = target.with_name(f".{target.name}.{os.urandom(6).hex()}.tmp")
    try:
        try:
            descriptor = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(beside, target)
        except BaseException:
            with contextlib.suppress(OSError):
                beside.unlink(missing_ok=True)
            raise
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise DataError(f"{str(target)!r} cannot be written ({reason}); check the folder and the space left") from None
    # The rename itself survives a power cut only when the folder is on disk too; not every system can do that.
    with contextlib.suppress(OSError):
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
