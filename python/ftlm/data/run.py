"""Runs: measured experiments with named inputs and outputs in SI units, immutable after validation."""

from __future__ import annotations

import copy
import html
import itertools
import os
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from ftlm.data.construction import RunArguments
from ftlm.data.sampling import (
    MIN_RUN_SAMPLES,
    Intersample,
    NonuniformSamples,
    as_vector,
    check_intersample,
    check_lengths,
    check_step,
    check_values,
    describe_resampled_signals,
    drop_missing,
    fit_trend,
    interpolate_gaps,
    is_constant,
    make_read_only,
    missing_mask,
    resample_uniform,
    rows_coincide,
    uniform_times,
    window_rows,
)
from ftlm.errors import DataError
from ftlm.structure.input_nonlinearity import InputNonlinearity
from ftlm.structure.structure import Structure
from ftlm.svg.figure import Figures
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import plural
from ftlm.utils.parameters import parameter
from ftlm.utils.validation import (
    Floats,
    as_mapping,
    bad_rows_error,
    check_signal_name,
    join_names,
    names_to_columns,
    nearest,
)

if TYPE_CHECKING:
    from ftlm.validation.data_advice import Advice, Inspection


@check_arguments
@dataclass(eq=False, repr=False, init=False)
class Run:
    """One measured experiment: regular samples of named inputs and outputs in SI units.

    A run is immutable. `Run.from_arrays`, `Run.from_frame` and `ftlm.load` create runs and validate the data. Invalid
    data raise a `DataError` that names the signal, the first bad row (counted from 0), the number of bad rows and a
    remedy. Data are repaired, resampled or cut only on request, and `warnings` lists every such change.

    Sample j contains inputs and outputs at t = j·step, j = 0, …, N − 1. Between samples, an input is constant
    (`intersample` ``"zoh"``, a command) or linear (``"foh"``, a measured signal).

    Attributes
    ----------
    name : str
        Name of the run in reports.
    step, start : float
        Sampling interval, and time of the first sample on the time axis of the file [s].
    inputs, outputs : tuple of str
        Names of the signals.
    notes : tuple of str
        Notes on processing and, for a rig, on the recording.
    nonuniform_samples : NonuniformSamples or None
        Original samples at nonuniform times; None if all samples lie on the uniform grid. With nonuniform samples, the
        grid has interval means of zero-order-hold inputs and linear interpolations of all other signals.
    unmasked_run : Run or None
        Original run of a run with masked outputs; its first samples determine the initial state. None without a mask.
        Methods that return a changed run set it to None.
    """

    name: str
    step: float
    start: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    notes: tuple[str, ...]
    nonuniform_samples: NonuniformSamples | None
    _data: dict[str, Floats]
    _units: dict[str, str]
    _intersample: dict[str, Intersample]
    _metadata: dict[str, Any]
    unmasked_run: Run | None = None

    def __init__(self) -> None:
        raise TypeError("a Run cannot be created directly; use Run.from_arrays, Run.from_frame or ftlm.load")

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise AttributeError(f"a Run is immutable; {name!r} cannot be set")

    def __delattr__(self, name: str) -> NoReturn:
        raise AttributeError(f"a Run is immutable; {name!r} cannot be deleted")

    def __reduce__(self) -> tuple[object, ...]:
        return _restore_run, (vars(self),)

    @classmethod
    def _from_checked(cls, **values: Any) -> Run:
        """Return a run from validated fields; arrays become read-only, and only data of the named signals are kept."""
        run = object.__new__(cls)
        vars(run).update(values)
        samples = run.nonuniform_samples
        if samples is not None:
            data = {s: make_read_only(samples.data[s]) for s in run.signals}
            samples = NonuniformSamples(make_read_only(samples.times), data)
        vars(run).update(
            nonuniform_samples=samples,
            _data={s: make_read_only(run._data[s]) for s in run.signals},
            _units={s: run._units[s] for s in run.signals},
            _intersample={s: run._intersample[s] for s in run.inputs},
            _metadata=copy.deepcopy(run._metadata),
        )
        return run

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
        window: Sequence[float | None] | None = None,
        time_unit: str = "s",
        missing: str = "refuse",
    ) -> Run:
        """Return a run built from one-dimensional arrays.

        Parameters
        ----------
        step : float, optional
            Time between rows [s], > 0. Exactly one of `step` and `time` is given.
        time : array_like, shape (N,), optional
            Increasing time of every row in `time_unit`, or dates (datetime64, datetime), from which the first is
            subtracted. Every time must lie within 2 % of a step of its position on a regular grid, unless `resample`
            is given. A mean step that differs from a short decimal only by rounding is replaced by this decimal.
        inputs, outputs : mapping of str to array_like, shape (N,), N ≥ 3
            Signals by name: lists, NumPy arrays, pandas or polars series of real numbers of magnitude up to 1e150.
            `inputs` may be empty; at least one output is required. A name begins with a letter or an underscore and
            consists of letters, digits, ``_ . [ ]``.
        units : mapping of str to str, optional
            Unit of each signal; values are converted from it to SI. Signals without a unit are not converted.
        intersample : mapping of str to {"zoh", "foh"}, optional
            Intersample behavior of an input; default ``"zoh"``.
        name : str, default "run"
            Name of the run in reports.
        resample : float, optional
            New step [s], to which the run is resampled: interval means of zero-order-hold inputs, linear interpolation
            of all other signals. `warnings` lists this. Unless every new row is an original row, `nonuniform_samples`
            keeps the original samples: the output error is simulated with the original inputs and evaluated at the
            original output times. Equation-error methods use the resampled signals.
        window : pair of float or None, optional
            Times (a, b) [s] since the first row: only rows with a ≤ t < b are used. The window is applied before any
            other check of the rows.
        time_unit : {"s", "ms", "us", "min", "h"}, default "s"
            Unit of `time`.
        missing : {"refuse", "weight", "hold"}, default "refuse"
            Treatment of missing values: NaN, None in a list, masked values, gaps in a regular `time`. ``"refuse"``:
            DataError. ``"weight"``: missing outputs stay NaN and get no weight in output-error estimation and
            validation; other methods raise. ``"hold"``: in addition, missing inputs take their last value (linear
            interpolation for ``"foh"``). With ``"weight"`` and ``"hold"``, missing values of `time` are interpolated,
            except the first and the last.
            `warnings` lists the missing samples.

        Returns
        -------
        Run

        Raises
        ------
        DataError
            If a signal is not one-dimensional, not real numbers, empty, shorter than three rows, not finite or too
            large; if lengths differ; if a name is invalid or used twice; if a unit or intersample behavior is unknown;
            if time is not finite, repeated, decreasing, jittered or has a gap; if `step` is not positive.
        """
        inputs, outputs = as_mapping("inputs", {} if inputs is None else inputs), as_mapping("outputs", outputs)
        arguments = RunArguments(
            inputs, outputs, step, time, units, intersample, name, resample, window, time_unit, missing=missing
        )
        return cls._from_checked(**arguments.checked_fields())

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
        window: Sequence[float | None] | None = None,
        time_unit: str | None = None,
        missing: str = "refuse",
    ) -> Run:
        """Return a run built from a pandas or polars frame, an xarray dataset, a dict of arrays or a structured array.

        Parameters
        ----------
        frame : frame
            Table whose columns are read as ``frame[column]``.
        time : hashable, optional
            Time column, or the name of the frame's index. Default without `step`: the index (for a dataset its only
            dimension) if it contains dates or is called t, time or seconds.
        step : float, optional
            Time between rows [s], > 0. An index that is the time and has another step raises DataError.
        inputs, outputs : mapping of str to column, or list of str
            Column of each signal; a list contains the names of columns that are also the names of the signals.
        units
            As in `Run.from_arrays`. Default: the unit of the column in ``frame.attrs["units"]``, or in the ``attrs`` of
            the column itself (``units`` or ``unit``).
        intersample, name, resample, window, missing
            As in `Run.from_arrays`.
        time_unit : {"s", "ms", "us", "min", "h"}, optional
            Unit of the time column; default the unit in its name, as in ``time [ms]`` (with a warning), else s. A name
            with a different unit raises DataError.

        Returns
        -------
        Run

        Raises
        ------
        DataError
            If a column is unknown or occurs more than once, or in the cases of `Run.from_arrays`.
        """
        from ftlm.data.export import arguments_from_frame

        options = {"intersample": intersample, "name": name, "resample": resample, "window": window, "missing": missing}
        arguments = arguments_from_frame(frame, time, step, inputs, outputs, units, time_unit, **options)
        return cls._from_checked(**arguments.checked_fields())

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the inputs, then of the outputs."""
        return self.inputs + self.outputs

    @property
    def units(self) -> dict[str, str]:
        """SI unit of every signal by name; "" for unknown units. The dictionary is a copy."""
        return dict(self._units)

    @property
    def intersample(self) -> dict[str, Intersample]:
        """Intersample behavior of every input, "zoh" or "foh". The dictionary is a copy."""
        return dict(self._intersample)

    @property
    def length(self) -> int:
        """Number of samples N."""
        return int(self._data[self.outputs[0]].size)

    @property
    def duration(self) -> float:
        """Time from the first sample to the last, (N − 1)·step [s]."""
        return (self.length - 1) * self.step

    @property
    def time(self) -> Floats:
        """Sample times [s] from 0, shape (N,), read-only."""
        return make_read_only(uniform_times(self.length, self.step))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Notes on processing and warnings about the data, as sentences."""
        samples = {name: drop_missing(self._data[name]) for name in self.outputs}
        constant = tuple(
            f"output {name!r} is constant ({float(values[0])!r} in all {values.size} rows): nothing can be identified "
            "from it"
            for name, values in samples.items()
            if values.size and is_constant(values)
        )
        return self.notes + constant

    @property
    def missing_samples(self) -> dict[str, NDArray[np.bool_]]:
        """Boolean mask of missing samples, by name of every output that has missing samples.

        The samples are those of `nonuniform_samples` if it is not None, otherwise those of the uniform grid.
        """
        data = self._data if self.nonuniform_samples is None else self.nonuniform_samples.data
        masks = {name: missing_mask(data[name]) for name in self.outputs}
        return {name: rows for name, rows in masks.items() if rows.any()}

    def with_interpolated_gaps(self) -> Run:
        """Return a copy with linearly interpolated missing samples, for plots and data checks.

        Estimation does not use this copy.
        """
        if not any(missing_mask(self._data[name]).any() for name in self.outputs):
            return self
        return self._replace(_data={name: interpolate_gaps(values) for name, values in self._data.items()})

    @property
    def metadata(self) -> dict[str, Any]:
        """Metadata, such as name, seed, input, parameters and faults of the rig. The dictionary is a copy."""
        return copy.deepcopy(self._metadata)

    def __getitem__(self, name: str) -> Floats:
        """Return the samples of a signal in SI units, shape (N,), read-only; raise DataError for an unknown name."""
        try:
            return self._data[name]
        except (KeyError, TypeError):
            raise self._unknown_signal_error(name) from None

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and name in self.signals

    def __repr__(self) -> str:
        lines = [self._headline()]
        if self.inputs:
            lines.append("  inputs:  " + ", ".join(self._describe_signal(name) for name in self.inputs))
        lines.append("  outputs: " + ", ".join(self._describe_signal(name) for name in self.outputs))
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

    def window(self, start: float | None, stop: float | None) -> Run:
        """Return a run of the rows with start ≤ t < stop.

        Parameters
        ----------
        start, stop : float or None
            Times [s] since the first row, 0 ≤ start < stop ≤ N·step. None for the first row, or for the end of the run.
            The row at `stop` is excluded, so ``run.window(0, b)`` and ``run.window(b, None)`` have no common row.

        Returns
        -------
        Run
            Run whose `start` is the time of its first row on the time axis of the file.

        Raises
        ------
        DataError
            If a limit lies outside the run, the limits do not increase, or fewer than three rows remain.
        """
        first, last = window_rows(uniform_times(self.length, self.step), (start, stop))
        if last - first < MIN_RUN_SAMPLES:
            raise DataError(
                f"window: {plural(last - first, 'row', 'remain')}, {MIN_RUN_SAMPLES} are needed; widen the limits"
            )
        data = {name: values[first:last] for name, values in self._data.items()}
        # Digits beyond the twelfth are rounding errors of the sum.
        start_time = self.start if first == 0 else float(f"{self.start + first * self.step:.12g}")
        nonuniform = self.nonuniform_samples
        if nonuniform is not None:
            nonuniform = nonuniform.cut_window(self._intersample, first * self.step, (last - 1) * self.step, self.step)
        return self._replace(_data=data, start=start_time, nonuniform_samples=nonuniform)

    def split(self, duration: float) -> list[Run]:
        """Split this run into consecutive runs whose lengths differ by at most one row.

        Parameters
        ----------
        duration : float
            Minimum duration of each returned run [s], > 0. Each has at least three rows. A run shorter than twice this
            minimum is returned whole and unchanged.

        Returns
        -------
        list of Run
            Runs with ``piece k of n`` added to their names, and without the notes of this run.

        Raises
        ------
        DataError
            If the duration is not positive.
        """
        if not duration > 0.0:
            raise DataError(f"duration = {duration:g}, which must be above 0; give the length of a piece in seconds")
        count = max(1, int(self.length * self.step / max(duration, MIN_RUN_SAMPLES * self.step) + 1e-9))
        limits = np.linspace(0, self.length, count + 1).astype(int) * self.step
        if count == 1:
            return [self]
        pieces = (self.window(float(a), float(b)) for a, b in itertools.pairwise(limits))
        return [p._replace(name=f"{self.name} piece {k} of {count}", notes=()) for k, p in enumerate(pieces, 1)]

    def resample(self, step: float) -> Run:
        """Return this run resampled to another step.

        Zero-order-hold inputs ("zoh") take their mean over each new interval, which is exact. Inputs with "foh" and all
        outputs are interpolated linearly, without an anti-alias filter. `warnings` records the resampling. Unless every
        new row is an original row, output-error fits and comparisons use the original outputs at their original times,
        because interpolated values are not measurements.

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
            If `step` is not positive, or gives fewer than three rows or more than 50 million.
        """
        new_step = check_step(step, "resample")
        times, nonuniform = uniform_times(self.length, self.step), self.nonuniform_samples
        if nonuniform is None and (self.missing_samples or not rows_coincide(times, new_step)):
            nonuniform = NonuniformSamples(times, self._data)
        source = nonuniform or NonuniformSamples(times, self._data)
        data = resample_uniform(source.times, source.data, self._intersample, new_step)
        how = describe_resampled_signals(self._intersample, keep_times=nonuniform is not None)
        note = f"resampled from {self.step:.12g} s to {new_step:.12g} s ({how})"
        return self._replace(_data=data, step=new_step, notes=(*self.notes, note), nonuniform_samples=nonuniform)

    def detrend(self, kind: str = "constant", signals: Iterable[str] | None = None) -> Run:
        """Return this run with the mean or the least-squares line of signals subtracted from them.

        If an output does not return to its initial value, its mean contains part of the response. An offset in the
        structure (``+ c``) estimates a constant offset without this bias. `warnings` records the subtracted trend.

        Parameters
        ----------
        kind : {"constant", "linear"}, default "constant"
            Trend to subtract: mean or least-squares line.
        signals : iterable of str, optional
            Signals to detrend; default all inputs and outputs.

        Returns
        -------
        Run

        Raises
        ------
        DataError
            If the kind is unknown, or a name is unknown or given twice.
        """
        if kind not in ("constant", "linear"):
            raise DataError(f"detrend: kind = {kind!r} is not known; use 'constant' or 'linear'")
        names = self.signals if signals is None else tuple(names_to_columns("signals", signals))
        unknown = next((name for name in names if name not in self), None)
        if unknown is not None:
            raise self._unknown_signal_error(unknown)
        data, run_notes, nonuniform = dict(self._data), list(self.notes), self.nonuniform_samples
        for name in names:
            trend, text = fit_trend(self._data[name], self.step, linear=kind == "linear")
            data[name] = self._data[name] - trend(self.time)
            if nonuniform is not None:
                nonuniform = nonuniform.replace_signals(**{name: nonuniform.data[name] - trend(nonuniform.times)})
            run_notes.append(f"detrended: {text} subtracted from {name}")
        return self._replace(_data=data, notes=tuple(run_notes), nonuniform_samples=nonuniform)

    def with_input_nonlinearities(self, limits: Sequence[InputNonlinearity]) -> Run:
        """Return this run with the given saturations and dead zones, which must be fixed, applied to its inputs."""
        data, nonuniform = dict(self._data), self.nonuniform_samples
        for limit in limits:
            data[limit.signal] = limit.apply(data[limit.signal])
            if nonuniform is not None:
                nonuniform = nonuniform.replace_signals(**{limit.signal: limit.apply(nonuniform.data[limit.signal])})
        return self._replace(_data=data, nonuniform_samples=nonuniform)

    def with_samples(
        self, samples: Mapping[str, Floats], nonuniform_samples: Mapping[str, Floats] | None = None
    ) -> Run:
        """Return this run with some of its signals replaced by new samples.

        Parameters
        ----------
        samples : mapping of str to array
            New samples by name, shape (N,), in SI units. Only outputs may have missing (NaN or masked) samples.
        nonuniform_samples : mapping of str to array, optional
            New samples by name at the times of `nonuniform_samples` of the run; ignored if the run has none.

        Raises
        ------
        DataError
            If a name is not a signal of this run, the number of values differs, or a value of an input is not finite.
        """
        checked = self._checked_samples("samples", samples, self.length)
        nonuniform = self.nonuniform_samples
        if nonuniform is not None:
            values = {} if nonuniform_samples is None else nonuniform_samples
            nonuniform = nonuniform.replace_signals(
                **self._checked_samples("nonuniform_samples", values, nonuniform.times.size)
            )
        return self._replace(_data={**self._data, **checked}, nonuniform_samples=nonuniform)

    def with_unmasked_run(self, run: Run) -> Run:
        """Return this run with `unmasked_run` set to the original run, whose first samples give the initial state."""
        return self._replace(unmasked_run=run)

    def _checked_samples(self, argument: str, values_by_name: object, length: int) -> dict[str, Floats]:
        """Return new samples by signal as float arrays; raise DataError for a wrong name, length or value."""
        checked: dict[str, Floats] = {}
        for name, values in as_mapping(argument, values_by_name).items():
            if name not in self:
                raise self._unknown_signal_error(name)
            label, gaps = f"signal {name!r}", name in self.outputs
            checked[name] = as_vector(values, label, gaps=gaps)[0]
            check_lengths({f"run {self.name!r}": length, label: checked[name].size})
            check_values(checked[name], label, 0, gaps=gaps)
        return checked

    def rename(self, mapping: Mapping[str, str]) -> Run:
        """Return this run with other signal names.

        Parameters
        ----------
        mapping : mapping of str to str
            New name by old name. Two names may be exchanged.

        Returns
        -------
        Run

        Raises
        ------
        DataError
            If an old name is unknown, a new name is invalid, or two signals would have the same name.
        """
        for old, new in mapping.items():
            if old not in self:
                raise self._unknown_signal_error(old)
            check_signal_name(new)
        renamed = {name: mapping.get(name, name) for name in self.signals}
        names = list(renamed.values())
        for index, name in enumerate(names):
            if name in names[:index]:
                raise DataError(f"rename: two signals would have the name {name!r}; give every signal its own name")
        return self._replace(
            inputs=tuple(renamed[name] for name in self.inputs),
            outputs=tuple(renamed[name] for name in self.outputs),
            _data={renamed[name]: values for name, values in self._data.items()},
            _units={renamed[name]: unit for name, unit in self._units.items()},
            _intersample={renamed[name]: kind for name, kind in self._intersample.items()},
            nonuniform_samples=None
            if self.nonuniform_samples is None
            else NonuniformSamples(
                self.nonuniform_samples.times, {renamed[name]: v for name, v in self.nonuniform_samples.data.items()}
            ),
        )

    def with_intersample(self, mapping: Mapping[str, str]) -> Run:
        """Return this run with another intersample behavior for some inputs.

        Parameters
        ----------
        mapping : mapping of str to {"zoh", "foh"}
            Intersample behavior by input; other inputs keep theirs.

        Returns
        -------
        Run

        Raises
        ------
        DataError
            If a name is not an input or a value is neither "zoh" nor "foh".
        """
        intersample = {**self._intersample, **check_intersample(mapping, self.inputs)}
        data = (
            self._data if self.nonuniform_samples is None else self.nonuniform_samples.resample(intersample, self.step)
        )
        return self._replace(_intersample=intersample, _data={n: v[: self.length] for n, v in data.items()})

    def with_outputs(self, values: Mapping[str, Floats]) -> Run:
        """Return this run with additional or replaced outputs.

        Parameters
        ----------
        values : mapping of str to array, shape (N,)
            Samples by name, finite, in SI units, on the uniform grid of the run.

        Returns
        -------
        Run

        Raises
        ------
        DataError
            If a name is invalid or belongs to an input, or its values are not N finite numbers.
        """
        values_by_name = {n: as_vector(v, f"output {n!r}")[0] for n, v in as_mapping("values", values).items()}
        for name, numbers in values_by_name.items():
            check_signal_name(name)
            if name in self.inputs:
                raise DataError(f"with_outputs: {name!r} is an input of run {self.name!r}; give it another name")
            check_lengths({f"run {self.name!r}": self.length, f"output {name!r}": numbers.size})
            check_values(numbers, f"output {name!r}", 0)
        nonuniform = self.nonuniform_samples
        if nonuniform is not None:
            nonuniform = nonuniform.replace_signals(
                **{n: np.interp(nonuniform.times, self.time, v) for n, v in values_by_name.items()}
            )
        return self._replace(
            outputs=tuple(dict.fromkeys([*self.outputs, *values_by_name])),
            _data={**self._data, **values_by_name},
            _units={**dict.fromkeys(values_by_name, ""), **self._units},
            nonuniform_samples=nonuniform,
        )

    def select(self, names: Iterable[str]) -> Run:
        """Return this run with only the given signals.

        Parameters
        ----------
        names : iterable of str
            Signals to keep, at least one output. Inputs and outputs of the returned run have this sequence.

        Returns
        -------
        Run

        Raises
        ------
        DataError
            If a name is unknown or given twice, or no output remains.
        """
        signals = list(names_to_columns("names", names))
        for name in signals:
            if name not in self:
                raise self._unknown_signal_error(name)
        outputs = tuple(name for name in signals if name in self.outputs)
        if not outputs:
            raise DataError(f"select: no output is left; keep at least one of {join_names(self.outputs)}")
        inputs = tuple(name for name in signals if name in self.inputs)
        return self._replace(inputs=inputs, outputs=outputs)

    def require_outputs(self, names: Iterable[str]) -> None:
        """Raise DataError unless every name is an output of this run that is not constant.

        Parameters
        ----------
        names : iterable of str
            Names of the required outputs.

        Raises
        ------
        DataError
            If a name is not an output of this run, or all samples of the output are equal or missing.
        """
        for name in names_to_columns("names", names):
            if name not in self.outputs:
                raise DataError(
                    f"output {name!r} is not in run {self.name!r}{nearest(name, self.outputs)}; "
                    f"its outputs are {join_names(self.outputs)}"
                )
            values = self._data[name]
            samples = drop_missing(values)
            if samples.size == 0:
                raise DataError(
                    f"output {name!r} of run {self.name!r}: all of its {values.size} samples are missing; use a part "
                    "of the record in which it was measured"
                )
            if is_constant(values):
                label, fault = f"output {name!r} of run {self.name!r}", f"constant, every row is {float(samples[0])!r}"
                remedy = (
                    "check the sensor and the column, or load a part of the record in which it moves with "
                    f"{parameter('window')}"
                )
                raise bad_rows_error(label, fault, 0, values.size, remedy)

    def plot(self, *signals: str) -> Figures:
        """Return plots of the given signals (default all) over time, outputs first; see also ``ftlm.plot.run``.

        Raises
        ------
        DataError
            If a name is not a signal of the run.
        """
        from ftlm.plot.comparison_charts import run_charts

        return run_charts(self, *signals)

    def advice(self, structure: Structure | None = None) -> Advice:
        """Check this run for faults and poor excitation before estimation, and return the findings.

        The checks cover dead, constant and duplicate channels, saturation, spikes, encoder wraps, outputs that do not
        start at rest, unexplained drift, feedback from outputs to inputs, short runs and poor excitation. The data are
        not changed.

        Parameters
        ----------
        structure : Structure, optional
            Structure to identify. The number of its free parameters is compared with the number of spectral lines of
            the inputs.

        Returns
        -------
        Advice
            Findings, printed as sentences; empty if the checks find nothing.
        """
        from ftlm.validation.data_advice import advise

        return advise(self, structure)

    def inspect(self) -> Inspection:
        """Return statistics of every signal, such as range, noise, quantization and whether it starts at zero.

        Returns
        -------
        Inspection
            Statistics of all signals, printed as a table.
        """
        from ftlm.validation.data_advice import inspect_run

        return inspect_run(self)

    def to_csv(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write this run to a csv file, which `ftlm.load` reads back bit for bit and without further arguments.

        The first line is a comment, ``# ftlm-run 1`` and a JSON object with name, step, start, inputs, outputs, units,
        intersample and warnings. A run with metadata also has ``about``. A header ``t_s,…`` and the samples follow,
        with ``nan`` for missing outputs. Only the samples on the grid are written, not `nonuniform_samples`. The
        file is written under a temporary name and renamed, so that readers never see an incomplete file.

        Parameters
        ----------
        path : path
            File to write.
        force : bool, default False
            Overwrite a file that exists.

        Raises
        ------
        DataError
            If the file exists and `force` is False, or it cannot be written.
        """
        from ftlm.data.export import write_csv

        write_csv(self, path, force=force)

    def to_parquet(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write this run to a parquet file that `ftlm.load` reads back bit for bit; requires pyarrow.

        The table has float64 columns, ``t_s`` and one per signal. Its metadata ``ftlm-run`` is the header of `to_csv`.

        Parameters
        ----------
        path : path
            File to write.
        force : bool, default False
            Overwrite a file that exists.

        Raises
        ------
        DataError
            If pyarrow is not installed, the file exists and `force` is False, or it cannot be written.
        """
        from ftlm.data.export import write_parquet

        write_parquet(self, path, force=force)

    def to_frame(self) -> Any:
        """Return the run as a pandas DataFrame: one column per signal in SI units, indexed by ``t_s`` [s].

        `Run.from_frame` converts the frame back. Its ``attrs`` contain units, inputs, outputs, intersample and name.

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
        """Return the run as an xarray dataset over ``t_s`` [s], with the attributes of `to_frame`.

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

    def _unknown_signal_error(self, name: object) -> DataError:
        return DataError(
            f"signal {name!r} is not in run {self.name!r}{nearest(name, self.signals)}; "
            f"its signals are {join_names(self.signals)}"
        )

    def _replace(self, **changes: Any) -> Run:
        return Run._from_checked(**{**vars(self), "unmasked_run": None, **changes})

    def _headline(self) -> str:
        return (
            f"Run {self.name!r}: {self.length} rows, step {self.step:.12g} s, duration {self.duration:.12g} s, "
            f"source time {self.start:.12g} s"
        )

    def _describe_signal(self, name: str) -> str:
        unit = f" [{self._units[name]}]" if self._units[name] else ""
        return name + unit + (f" {self._intersample[name]}" if name in self._intersample else "")


def _restore_run(values: Mapping[str, Any]) -> Run:
    return Run._from_checked(**values)
