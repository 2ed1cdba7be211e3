"""Export and import of runs: pandas and polars frames, xarray datasets, csv and parquet files."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import io
import json
import math
import os
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np

from ftlm.data.construction import RunArguments
from ftlm.data.run import Run
from ftlm.data.sampling import as_seconds, as_vector, check_step_agrees, missing_mask, uniform_times
from ftlm.data.units import TIME_UNITS, is_time_name, parse_unit, split_time_header, time_unit_of
from ftlm.errors import DataError
from ftlm.utils.files import check_target, write_atomically
from ftlm.utils.parameters import type_name
from ftlm.utils.resources import optional_module
from ftlm.utils.validation import CSV_TIME, Floats, is_run_name, join_names, names_to_columns, nearest


def arguments_from_frame(
    frame: object,
    time: Hashable | None,
    step: float | None,
    inputs: object,
    outputs: object,
    units: Mapping[str, str] | None,
    time_unit: str | None,
    **options: Any,
) -> RunArguments:
    """Return the arguments of a run from the columns of a frame; see :meth:`ftlm.Run.from_frame`."""
    columns, index = _columns_of(frame), _index_of(frame)

    def pick(column: Hashable, role: str) -> object:
        count = columns.count(column)
        if count == 0 and index is not None and column == index[0]:
            return index[1]
        if count == 0:
            raise DataError(
                f"column {column!r} ({role}) is not in the frame{nearest(column, columns)}; "
                f"the columns are {join_names(columns)}; for the index of a pandas frame use frame.reset_index()"
            )
        if count > 1:
            raise DataError(f"column {column!r} ({role}) occurs {count} times; rename all but one")
        return cast("Mapping[Any, object]", frame)[column]

    label, times = "time" if time is None else f"time (column {time!r})", None
    if time is not None:
        times = pick(time, "time")
    elif index is not None and _is_time_index(*index):
        name = "time (the index)" if index[0] is None else f"time (the index {index[0]!r})"
        if step is None:
            label, (time, times) = name, index
        else:
            _check_index_step(step, name, index)
    columns_by_role = [
        names_to_columns(argument, names) for argument, names in (("inputs", inputs), ("outputs", outputs))
    ]
    units = _stated_units(frame, columns_by_role[0] | columns_by_role[1]) | dict(units or {})
    labels = {s: f"signal {s!r} (column {column!r})" for part in columns_by_role for s, column in part.items()}
    input_values, output_values = ({s: pick(c, f"signal {s!r}") for s, c in part.items()} for part in columns_by_role)
    if isinstance(time, str):
        unit, notes = time_unit_of(time, label, time_unit)
    else:
        unit, notes = time_unit or "s", ()
    return RunArguments(
        input_values,
        output_values,
        step=step,
        time=times,
        units=units,
        time_unit=unit,
        labels=labels,
        notes=notes,
        time_label=label,
        **options,
    )


def _check_index_step(step: float, label: str, index: tuple[Hashable, object]) -> None:
    """Raise DataError if a given step [s] contradicts the time index of a frame."""
    dated, unit = as_seconds(index[1], label), split_time_header(str(index[0]))[1] or "s"
    if dated is not None:
        check_step_agrees(step, dated[0], label)
    elif unit in TIME_UNITS:
        check_step_agrees(step, as_vector(index[1], label, gaps=True)[0] * TIME_UNITS[unit], label)


def _stated_units(frame: object, columns: Mapping[str, Hashable]) -> dict[str, str]:
    """Return the units in the attributes of a frame or of its columns, by signal; unknown units are omitted."""
    frame_units = getattr(frame, "attrs", {}).get("units")
    units_by_column = dict(frame_units) if isinstance(frame_units, Mapping) else {}
    for column in set(columns.values()).intersection(_columns_of(frame)):
        with contextlib.suppress(KeyError, TypeError, ValueError, IndexError):
            column_attributes = getattr(cast("Mapping[Any, object]", frame)[column], "attrs", {})
            stated_unit = column_attributes.get("units", column_attributes.get("unit"))
            # A column of a pandas frame has the attributes of the frame.
            units_by_column[column] = stated_unit if isinstance(stated_unit, str) else units_by_column.get(column)
    units = {name: parse_unit(str(units_by_column.get(column) or "")) for name, column in columns.items()}
    return {name: unit for name, unit in units.items() if unit}


def _columns_of(frame: object) -> list[Hashable]:
    if isinstance(frame, Mapping):
        # An xarray dataset is a mapping, too; its coordinates count as columns.
        return list(getattr(frame, "variables", frame))
    # A lazy polars frame has collect(); reading its columns would already start the computation.
    columns = None if hasattr(frame, "collect") else getattr(frame, "columns", None)
    if columns is None:
        columns = getattr(getattr(frame, "dtype", None), "names", None)
    if columns is None or not hasattr(frame, "__getitem__"):
        raise DataError(
            f"frame is {type_name(frame)}; pass a pandas or polars DataFrame (collect() a lazy one first), "
            "a dict of arrays or a structured array"
        )
    return list(columns)


def _index_of(frame: object) -> tuple[Hashable, object] | None:
    """Return name and values of the row index of a frame, or of the only dimension of an xarray dataset; else None."""
    sizes = getattr(frame, "sizes", None)
    if isinstance(frame, Mapping) and isinstance(sizes, Mapping):
        axis = next(iter(sizes), None)
        return (axis, cast("Any", frame)[axis]) if len(sizes) == 1 and axis in getattr(frame, "coords", ()) else None
    index = getattr(frame, "index", None)
    if index is None or callable(index) or getattr(index, "nlevels", 1) != 1:
        return None
    return getattr(index, "name", None), index


def _is_time_index(name: Hashable, values: object) -> bool:
    """Whether an index is a time axis: its name is t, time or seconds, or it contains dates or time differences."""
    return (isinstance(name, str) and is_time_name(name)) or as_seconds(values, "time (the index)") is not None


def frame_of(run: Run) -> Any:
    """Return a run as a pandas DataFrame indexed by time [s]; raise ModelError if pandas is not installed."""
    pandas = optional_module("pandas", "pandas", "pandas")
    index = pandas.Index(run.start + run.time, name=CSV_TIME)
    frame = pandas.DataFrame({name: run[name].copy() for name in run.signals}, index=index)
    frame.attrs = {**_frame_attributes(run), "units": run.units, "intersample": dict(run.intersample)}
    return frame


def dataset_of(run: Run) -> Any:
    """Return a run as an xarray dataset indexed by time [s]; raise ModelError if xarray is not installed."""
    xarray = optional_module("xarray", "xarray", "xarray")
    signals = {}
    for name in run.signals:
        role = {"role": "input", "intersample": run.intersample[name]} if name in run.inputs else {"role": "output"}
        signals[name] = (CSV_TIME, run[name].copy(), {"units": run.units[name], **role})
    time = (CSV_TIME, run.start + run.time, {"units": "s"})
    return xarray.Dataset(signals, coords={CSV_TIME: time}, attrs=_frame_attributes(run))


def _frame_attributes(run: Run) -> dict[str, Any]:
    attributes = {"name": run.name, "inputs": list(run.inputs), "outputs": list(run.outputs), "step": run.step}
    return {**attributes, "warnings": list(run.warnings)}


CSV_MARK = "# ftlm-run "
CSV_VERSION = 1
UTF8_BOM = b"\xef\xbb\xbf"
#: Maximum length of the first line; without it, a file without line breaks would be read into memory as a whole.
MAX_HEADER_BYTES = 1 << 20
#: Note in files of runs with nonuniform samples: the files contain only the samples on the uniform grid.
OMITTED_TIMES_NOTE = "written on the uniform grid, without the original sample times of the outputs"


class Header(msgspec.Struct, frozen=True, omit_defaults=True):
    """Header of a run file written by ftlm, stored as the text ``VERSION JSON`` with its fields as a JSON object.

    It is the first line of a csv file, or metadata of a parquet file. Fields are those of :class:`ftlm.Run`, except
    that `about` is the metadata of the run, and `missing` contains the names of outputs with missing samples.
    """

    name: str
    step: float
    start: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: dict[str, str]
    intersample: dict[str, str]
    warnings: tuple[str, ...]
    about: dict[str, Any] = {}
    missing: tuple[str, ...] = ()

    @classmethod
    def of(cls, run: Run) -> Header:
        """Return the header that describes a run."""
        return cls(
            run.name,
            run.step,
            run.start,
            run.inputs,
            run.outputs,
            run.units,
            dict(run.intersample),
            run.notes if run.nonuniform_samples is None else (*run.notes, OMITTED_TIMES_NOTE),
            run.metadata,
            tuple(n for n in run.outputs if missing_mask(run[n]).any()),
        )

    def text(self) -> str:
        """Return the header as text, ``VERSION JSON``."""
        fields = json.dumps(msgspec.to_builtins(self), ensure_ascii=False, allow_nan=False)
        # A lone surrogate cannot be encoded in UTF-8 and is written as a JSON escape.
        return f"{CSV_VERSION} {fields.encode('utf-8', 'backslashreplace').decode()}"

    def line(self) -> str:
        """Return the header as the first line of a text file; raise DataError if it is too long."""
        line = f"{CSV_MARK}{self.text()}\n"
        size = len(line.encode())
        if size > MAX_HEADER_BYTES:
            raise DataError(
                f"run {self.name!r}: signal names, notes and metadata take {size} bytes, more than the "
                f"{MAX_HEADER_BYTES} bytes that the first line of a csv file may have; write the run as .parquet"
            )
        return line

    @classmethod
    def read(cls, path: Path, location: str, text: str) -> Header:
        """Return the header from its text; raise DataError if it is corrupt or has another version.

        `location` is the position of the header in the file, for messages. The start time is set to 0, because it
        follows from the samples.
        """
        version, _, body = text.partition(" ")
        if version.strip() != str(CSV_VERSION):
            raise DataError(
                f"{path.name}: {location}: the format ftlm-run {version.strip()[:20]!r} is not known here; use a newer "
                "ftlm, or remove the line and name the columns"
            )
        try:
            # The start time follows from the samples.
            header = msgspec.convert({**json.loads(body), "start": 0.0}, cls)
            if not is_run_name(header.name) or not math.isfinite(header.step):
                raise ValueError("its name or step cannot be used")
            return header
        except (ValueError, TypeError, RecursionError) as error:
            raise DataError(
                f"{path.name}: {location} is a damaged ftlm header ({str(error)[:100]}); restore it, or remove the "
                "line and name the columns"
            ) from None


def header_of_line(path: Path, line: bytes) -> Header | None:
    """Return the header in the first line of a text file; None if the line is not a header of ftlm."""
    text = line.removeprefix(UTF8_BOM).decode("utf-8", errors="replace")
    return (
        Header.read(path, "line 1", text.removeprefix(CSV_MARK)) if f"{text.rstrip()} ".startswith(CSV_MARK) else None
    )


def write_csv(run: Run, path: str | os.PathLike[str], *, force: bool) -> None:
    """Write a run to a csv file; see :meth:`ftlm.Run.to_csv`."""
    check_target(path, force=force)
    columns = _columns(run)
    rows = map(",".join, zip(*(map(repr, column.tolist()) for column in columns.values()), strict=True))
    text = Header.of(run).line() + "\n".join([",".join(columns), *rows, ""])
    write_atomically(path, text.encode(), force=force)


def write_parquet(run: Run, path: str | os.PathLike[str], *, force: bool) -> None:
    """Write a run to a parquet file; see :meth:`ftlm.Run.to_parquet`."""
    target = check_target(path, force=force)
    try:
        pyarrow = importlib.import_module("pyarrow")
        parquet = importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise DataError(f"{str(target)!r}: parquet needs pyarrow; run: pip install 'ftlm[parquet]'") from None
    columns, header = _columns(run), Header.of(run).text()
    check = f"{run.length} {digest(columns, header)}"
    table = pyarrow.table(columns).replace_schema_metadata({"ftlm-run": header, "ftlm-check": check})
    content = io.BytesIO()
    # Page checksums do not cover the footer with the row count; a digest of all rows does.
    parquet.write_table(table, content, write_page_checksum=True)
    write_atomically(target, content.getvalue(), force=force)


def digest(columns: Mapping[str, Floats], header: str) -> str:
    """Return the SHA-256 digest of header and columns of a run, which the reader of parquet files verifies."""
    digest = hashlib.sha256(header.encode())
    for name, values in columns.items():
        digest.update(f"\0{name}\0{len(values)}\0".encode())
        digest.update(np.ascontiguousarray(values, dtype="<f8").tobytes())
    return digest.hexdigest()


def _columns(run: Run) -> dict[str, Floats]:
    return {CSV_TIME: _source_time(run)} | {name: run[name] for name in run.signals}


def _source_time(run: Run) -> Floats:
    """Return the time of every sample on the time axis of the measured file [s].

    Times are rounded to 1e-9 of the sampling interval or finer, unless a float cannot represent so many digits.
    """
    exact = run.start + uniform_times(run.length, run.step)
    # A resolution of 1e-9 of the step suffices, because the header contains the exact step.
    digits = 9 - math.floor(math.log10(run.step))
    if not 0 <= digits <= 15 or np.abs(exact).max() * 10.0**digits >= 2.0**53:
        return exact
    rounded = np.round(exact, digits)
    rounded[0] = run.start
    return rounded
