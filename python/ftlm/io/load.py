"""Loading of runs from files by a selection of columns."""

from __future__ import annotations

import os
import stat
from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias, cast

import msgspec
import numpy as np

from ftlm.data.construction import RunArguments
from ftlm.data.export import Header
from ftlm.data.run import Run
from ftlm.data.sampling import MissingPolicy, check_missing_policy, check_step_agrees
from ftlm.data.units import TIME_UNITS, conversion_notes, split_time_header, time_unit_of
from ftlm.errors import DataError
from ftlm.io.cell_parsing import split_unit
from ftlm.io.column_roles import ColumnSelection, add_file_units, assume_roles, has_numbers
from ftlm.io.delimited_text import read_text
from ftlm.io.dialect import SHEET_OPTIONS, TEXT_OPTIONS, Assumption, Layout
from ftlm.io.isolated_reader import HDF5_FORMAT, binary_format_of, read_isolated
from ftlm.io.table import Column, ColumnTable, FileTable, date_order_assumption
from ftlm.utils.arguments import check_arguments
from ftlm.utils.files import PACKAGE_LOGGER, nearest_file_hint, read_toml
from ftlm.utils.parameters import NAMED_COLUMNS, Note, choose_text, parameter, type_name
from ftlm.utils.validation import CSV_TIME, as_mapping, is_run_name, join_names, names_to_columns, nearest

PathLike: TypeAlias = str | os.PathLike[str]
_MAX_FILE_BYTES = 1 << 30


class _ColumnsFile(msgspec.Struct, forbid_unknown_fields=True):
    """Content of a columns file (TOML): the keys of the argument `columns` of :func:`load`."""

    time: str | int | None = None
    step: float | None = None
    inputs: str | list[str] | dict[str, str | int] | None = None
    outputs: str | list[str] | dict[str, str | int] | None = None
    units: dict[str, str] | None = None
    intersample: dict[str, str] | None = None
    layout: dict[str, str | int] | None = None


#: Keys of a columns file.
COLUMN_KEYS = _ColumnsFile.__struct_fields__


@check_arguments
def load(
    path: PathLike | Sequence[PathLike],
    *,
    time: str | int | None = None,
    inputs: Mapping[str, str | int] | Sequence[str] | str | None = None,
    outputs: Mapping[str, str | int] | Sequence[str] | str | None = None,
    units: Mapping[str, str] | None = None,
    columns: Mapping[str, object] | PathLike | None = None,
    intersample: Mapping[str, str] | None = None,
    step: float | None = None,
    window: Sequence[float | None] | None = None,
    resample: float | None = None,
    name: str | None = None,
    time_unit: str | None = None,
    missing: str | None = None,
    layout: Layout | Mapping[str, object] | None = None,
) -> Run:
    """Load one run from a text, spreadsheet or array file, or from several files that each have some of its columns.

    Parameters
    ----------
    path : path or sequence of paths
        Text, optionally compressed by gzip; ``.xlsx``, ``.xls``, ``.ods``; ``.mat``, ``.h5``, ``.npz``, ``.npy``;
        ``.parquet``, ``.feather``. A group of an HDF5 file is named in the path, ``runs.h5/run1``. The layout of text
        and sheets is given by `layout` or detected: comma, semicolon, tab or white space between cells, decimal points
        or commas, a line of names, a line of units, dates. Ambiguous files raise an error. Assumptions that affect
        values are listed in the `warnings` of the run, with the option that overrides them. Lines that begin with ``#``
        are skipped. Without a header the columns are named c1, c2, … The columns of a matrix V are named V.1, V.2, …
        (or ``V(:,1)``), and a vector keeps its name; samples are in rows. If two files have the same column name, the
        file name is put in front of it, as in ``STEM/V.3``.
    time : str or int, optional
        Time column, by name or, in a single text file, by position from 0. Without `time` and `step`, the column called
        t, time or seconds is used (any case, alone or with a unit as in ``time [ms]`` or ``t_ms``). Otherwise, the time
        is, with a warning, a column with a name such as Timestamp or Zeit, the only column of dates, or a first column
        with a unit of time. Otherwise it is the first column of each selected matrix; these columns must be equal.
        Dates and times of day are converted to seconds since the first row.
    inputs, outputs : mapping of str to column, or list of str, optional
        Column by signal name, or a list of columns that keep their names; at least one output. The unit in a name such
        as ``I (A)`` may be omitted. If neither is given here, by `columns` or by an ftlm header, both are guessed from
        words in the column names as by :func:`ftlm.open_file`; the guess is listed in the `warnings` of the run, and
        ambiguous names raise an error.
    units : mapping of str to str, optional
        Units of signals, from which values are converted to SI. They replace units in the file, which are in names such
        as ``y [deg]``, in a line of units or in attributes. With "" or without a unit, values are not converted.
    columns : mapping or path of a TOML file, optional
        Arguments in a mapping or file: keys ``time`` or ``step``, and tables ``inputs``, ``outputs``, ``units``,
        ``intersample`` and ``layout``. Arguments of the same name override or extend them.
    intersample : mapping of str to {"zoh", "foh"}, optional
        Intersample behavior of an input; default ``"zoh"``.
    step : float, optional
        Time between rows [s], > 0, of files without a time column. A time column whose step differs raises an error.
    window : pair of float or None, optional
        Times (a, b) [s] since the first row: only rows with a ≤ t < b are used.
    resample : float, optional
        New step [s], to which the run is resampled; see `Run.from_arrays`. Nonuniform outputs keep their own times for
        the output error. The warnings list the resampling.
    name : str, optional
        Name of the run in reports; default the name of the first file.
    time_unit : {"s", "ms", "us", "min", "h"}, optional
        Unit of the time column; default the unit in its header (with a warning), else s. A contradicting header
        raises an error. The unit is never guessed from the spacing of the samples.
    missing : {"refuse", "weight", "hold"}, optional
        Treatment of NaN, empty cells and missing rows; see `Run.from_arrays`. The default is ``"refuse"``, or
        ``"weight"`` for a file that ftlm wrote with missing outputs.
    layout : Layout or dict, optional
        Layout of text or sheets, as far as it cannot be detected; see :class:`ftlm.Layout`.

    Returns
    -------
    Run

    Raises
    ------
    DataError
        If a file is missing, larger than 1 GiB, damaged or of an unknown format; if a line has too few or too many
        cells; if a selected column is unknown, has empty cells or contains text (the message names line, row and
        column); and in the cases of `Run.from_arrays`.

    Examples
    --------
    >>> run = load("arm.csv", time="t_s", inputs={"I1": "Im1_meas_A"}, outputs={"theta11": "th11_deg"},
    ...            units={"theta11": "deg"})  # doctest: +SKIP
    """
    selection = select_columns(columns, time, step, inputs, outputs, units, intersample, layout)
    return load_selection(path, selection, LoadOptions(window, resample, name, time_unit, missing))


def load_selection(
    path: PathLike | Sequence[PathLike],
    selection: ColumnSelection,
    options: LoadOptions,
    signals: Signals | None = None,
) -> Run:
    """Load a run with a selection of columns; errors are those of :func:`load`.

    `signals` are the inputs and outputs of an equation. They are used if the selection has no inputs and outputs.
    """
    run = run_from_tables(read_tables(path, selection.layout), selection, options, signals)
    PACKAGE_LOGGER.info("read: %s: %d rows, %s", run.name, run.length, ", ".join(run.signals))
    return run


@dataclass(frozen=True)
class LoadOptions:
    """Arguments of :func:`load` that do not select columns; raise DataError for an unknown value of `missing`."""

    window: Sequence[float | None] | None = None
    resample: float | None = None
    name: str | None = None
    time_unit: str | None = None
    missing: str | None = None

    def __post_init__(self) -> None:
        check_missing_policy(self.missing or "refuse")

    def missing_policy(self, header: Header | None) -> MissingPolicy:
        """Return the treatment of missing samples: `missing` if given, otherwise the default for the ftlm header."""
        if self.missing is None and header is not None and header.missing:
            return "weight"
        return check_missing_policy(self.missing or "refuse")


#: Inputs and outputs of an equation or a model.
Signals = tuple[Sequence[str], Sequence[str]]


def run_from_tables(
    tables: list[FileTable], selection: ColumnSelection, options: LoadOptions, signals: Signals | None = None
) -> Run:
    """Return a run with the selected columns of file tables; errors are those of :func:`load`.

    If the selection lacks a time, inputs or outputs, they are chosen as in :func:`load`, and `selection` is changed.
    """
    header = tables[0].header
    policy = options.missing_policy(header)
    if header is not None and len(tables) > 1:
        raise DataError(f"{str(tables[0].path)!r} is a complete run; load it alone")
    if header is not None:
        _apply_header(selection, header)
    pool = ColumnTable(tables)
    roles = _assume_roles(selection, pool, signals) if header is None else ()
    _check_disjoint_roles(selection, pool)
    if not selection.outputs:
        # A column that contains text does not become a signal by its name.
        problem_text = next((f"; {c.problem}" for c in pool.columns if c.problem is not None and not c.blank), "")
        in_a_file = f", or in a file for {parameter('columns')}"
        in_a_file = choose_text(in_a_file, in_a_file, "")
        raise DataError(
            "no output is named, and the roles of the columns are not clear from their names; name the signals with "
            f"{parameter('inputs', NAMED_COLUMNS)} and {parameter('outputs', NAMED_COLUMNS)}{in_a_file}; "
            f"{pool.describe()}{problem_text}"
        )
    if header is None:
        add_file_units(selection, pool)
    labels: dict[str, str] = {}
    used_columns: list[Column] = []

    def gather(columns: Mapping[str, Hashable], *, blank: bool) -> dict[str, object]:
        picked: dict[str, object] = {}
        for signal, spec in columns.items():
            column = pool.find(spec, f"signal {signal!r}")
            labels[signal] = f"{column.source.name}: column {column.name!r} (signal {signal!r})"
            used_columns.append(column)
            picked[signal] = column.numbers(blank=blank)
        return picked

    given_inputs = gather(selection.inputs, blank=policy == "hold")
    given_outputs = gather(selection.outputs, blank=policy != "refuse")
    time_column = _time_column(selection, pool, used_columns, options, policy)
    name = options.name
    if name is None:
        stem = base_name(tables[0].path)
        name = header.name if header is not None else stem if is_run_name(stem) else "run"
    is_batch = len(tables) > 1
    facts: tuple[str, ...] = tuple(
        Note(f"{table.path.name}: {a.evidence}", a.override) if is_batch else a.note
        for table in tables
        for a in table.assumptions
        if a.affects_run
    )
    facts += (*(a.note for a in roles), *time_column.notes, *conversion_notes(selection.units))
    arguments = RunArguments(
        given_inputs,
        given_outputs,
        step=selection.step,
        time=time_column.times,
        units=selection.units,
        intersample=selection.intersample,
        name=name,
        resample=options.resample,
        window=options.window,
        time_unit=time_column.unit,
        labels=labels,
        notes=facts,
        time_label=time_column.label,
        missing=policy,
    )
    if header is not None:
        known_step = header.step if time_column.name == CSV_TIME else None
        arguments = replace(arguments, known_step=known_step, notes=(*header.warnings, *facts), metadata=header.about)
    return Run._from_checked(**arguments.checked_fields())


@dataclass(frozen=True)
class _TimeColumn:
    """Time column: values (None if the step is given), unit, label in error messages, column name, and notes."""

    times: object = None
    unit: str = "s"
    label: str = "time"
    name: str | None = None
    notes: tuple[str, ...] = ()


def _time_column(
    selection: ColumnSelection, pool: ColumnTable, columns: list[Column], options: LoadOptions, policy: MissingPolicy
) -> _TimeColumn:
    unit_option = options.time_unit
    if selection.step is not None:
        if unit_option is not None:
            raise DataError(
                f"{parameter('time_unit', unit_option)} is the unit of {parameter('time')}, which is not used; "
                f"{parameter('step')} is in s"
            )
        unused = unused_time(selection, pool, {column.name for column in columns})
        if unused is not None:
            label = f"{unused.source.name}: column {unused.name!r} (time)"
            unit = split_time_header(time_header(unused))[1] or "s"
            if unused.timestamps is not None:
                check_step_agrees(selection.step, unused.timestamps.seconds(label, selection.layout.dates), label)
            elif unit in TIME_UNITS:
                times = unused.numbers(blank=True).astype(np.float64) * TIME_UNITS[unit]
                check_step_agrees(selection.step, times, label)
        return _TimeColumn()
    matrices = [column.matrix for column in columns if column.matrix is not None]
    column, assumed = pool.time(selection.time, matrices, {column.name for column in columns})
    label = f"{column.source.name}: column {column.name!r} (time)"
    facts: tuple[str, ...] = () if assumed is None else (str(assumed),)
    if column.timestamps is None:
        unit, notes = time_unit_of(time_header(column), label, unit_option)
        return _TimeColumn(column.numbers(blank=policy != "refuse"), unit, label, column.name, facts + notes)
    if unit_option is not None:
        raise DataError(
            f"{parameter('time_unit', unit_option)} is the unit of numbers, but {label} has dates or times of day; "
            f"omit {parameter('time_unit')}"
        )
    seconds = column.timestamps.seconds(label, selection.layout.dates)
    order = date_order_assumption(column, selection.layout.dates)
    facts += () if order is None else (str(order),)
    facts += (f"time counted from {column.timestamps.first!r} on",)
    return _TimeColumn(seconds, "s", label, column.name, facts)


def _assume_roles(selection: ColumnSelection, pool: ColumnTable, signals: Signals | None) -> tuple[Assumption, ...]:
    """Set inputs and outputs of a selection by column names if it has none, and return the assumptions."""
    if selection.inputs or selection.outputs:
        return ()
    matrices = list(dict.fromkeys(c.matrix for c in pool.columns if c.matrix is not None))
    time_column = unused_time(selection, pool, set())
    if selection.step is None:
        time_column, _ = pool.time(selection.time, matrices if len(matrices) == 1 else [], set())
    return assume_roles(selection, [c for c in pool.columns if c is not time_column], signals)


def unused_time(selection: ColumnSelection, pool: ColumnTable, signals: Collection[str]) -> Column | None:
    """Return the time column that is not used because the step is given; None without a step or such a column.

    `signals` are the names of the columns that are used as signals.
    """
    if selection.step is None:
        return None
    try:
        column, _ = pool.time(selection.time, (), signals)
    except DataError:
        if selection.time is not None:
            raise
        return None
    return column if has_numbers(column) or column.timestamps is not None else None


def base_name(path: Path) -> str:
    """Return a file name without its extensions, including ``.gz``."""
    return Path(path.stem).stem if path.suffix.lower() == ".gz" else path.stem


def _check_disjoint_roles(selection: ColumnSelection, pool: ColumnTable) -> None:
    """Raise DataError if a column is an input and an output, because the model of this output would be trivial."""
    inputs_by_id = {id(pool.find(spec, f"signal {name!r}")): (name, spec) for name, spec in selection.inputs.items()}
    twice = [
        (inputs_by_id[id(column)], name)
        for name, spec in selection.outputs.items()
        if id(column := pool.find(spec, f"signal {name!r}")) in inputs_by_id
    ]
    if twice and twice[0][0][0] != twice[0][1]:
        (name, spec), other_name = twice[0]
        raise DataError(
            f"column {spec!r} is the input {name!r} and the output {other_name!r} ({len(twice)} such columns in "
            "all); name "
            "another column for one of them"
        )


def time_header(time_column: Column) -> str:
    """Return the header of a time column with its unit, or ``time`` for the first column of a matrix."""
    if time_column.matrix is not None:
        return "time"
    is_unit_row = (
        time_column.file_unit
        and split_time_header(time_column.variable)[1] is None
        and not split_unit(time_column.variable)[1]
    )
    return f"{time_column.variable} [{time_column.file_unit}]" if is_unit_row else time_column.variable


def _paths(argument: PathLike | Sequence[PathLike]) -> list[tuple[Path, str]]:
    """Return (file, HDF5 group) for each path; the group is "" for the whole file.

    Raise DataError if a file is missing or given twice, or the files exceed 1 GiB in total.
    """
    entries = [argument] if isinstance(argument, (str, os.PathLike)) else argument
    if not isinstance(entries, Sequence) or not all(isinstance(entry, (str, os.PathLike)) for entry in entries):
        raise DataError(f"path is {type_name(argument)}; pass the path of a file, or a list of paths")
    if not entries:
        raise DataError("path: the list is empty; pass the path of at least one file")
    paths_and_groups = [_split_group(Path(entry)) for entry in entries]
    total_size = 0
    for index, (path, group) in enumerate(paths_and_groups):
        total_size += _size(path)
        if any(
            path.resolve() == other_path.resolve() and group == other_group
            for other_path, other_group in paths_and_groups[:index]
        ):
            raise DataError(f"{str(path / group)!r} is given twice; give every file once")
    if total_size > _MAX_FILE_BYTES:
        raise DataError(
            f"{join_names(str(path) for path, _ in paths_and_groups)}: {total_size} bytes, more than the limit of "
            f"{_MAX_FILE_BYTES}; "
            "split the record or lower its rate"
        )
    return paths_and_groups


def _split_group(path: Path) -> tuple[Path, str]:
    """Split a path such as ``runs.h5/run1`` into the HDF5 file and the group; the group is "" for other paths."""
    for parent in path.parents:
        if parent.suffix.lower() in HDF5_FORMAT.suffixes and parent.is_file():
            return parent, path.relative_to(parent).as_posix()
    return path, ""


def run_paths(path: str) -> list[str]:
    """Return the paths of the runs in a file.

    If several groups of an HDF5 file have time columns, each group is a run. Otherwise the only path is `path`.
    """
    if Path(path).suffix.lower() not in HDF5_FORMAT.suffixes or not Path(path).is_file():
        return [path]
    (table,) = read_tables(path, Layout())
    return [str(Path(path) / group) for group in table.runs] or [path]


def _size(path: Path) -> int:
    try:
        file_status = path.stat()
    except FileNotFoundError:
        raise DataError(f"{str(path)!r} does not exist{nearest_file_hint(path)}; check the path") from None
    except (OSError, ValueError) as error:
        raise DataError(f"{str(path)!r} cannot be opened ({error}); check the path and its permissions") from None
    if not stat.S_ISREG(file_status.st_mode):
        raise DataError(f"{str(path)!r} is not a file; pass the path of a file")
    return file_status.st_size


def read_tables(path: PathLike | Sequence[PathLike], layout: Layout) -> list[FileTable]:
    """Return one table per path, with all columns; raise DataError if a file cannot be read."""
    paths = _paths(path)
    tables_by_path: dict[Path, FileTable] = {}
    kinds = {file: binary_format_of(file) for file, _ in paths}
    for kind in dict.fromkeys(kinds.values()):
        if kind is not None:
            files_of_kind = [file for file in kinds if kinds[file] is kind]
            for name in files_of_kind:
                layout.check_used(repr(name.name), kind.label, SHEET_OPTIONS if kind.has_sheets else ())
            tables_by_path |= dict(zip(files_of_kind, read_isolated(files_of_kind, kind, layout), strict=True))
    for name, file_format in kinds.items():
        if file_format is None:
            layout.check_used(repr(name.name), "text", TEXT_OPTIONS)
    tables = [tables_by_path[file] if file in tables_by_path else read_text(file, layout) for file, _ in paths]
    return [table.in_group(group) if group else table for table, (_, group) in zip(tables, paths, strict=True)]


def column_names(path: PathLike) -> tuple[str, ...] | None:
    """Return the column names of one file; None for a run written by ftlm.

    Raises
    ------
    DataError
        In the cases of :func:`load`.
    """
    (table,) = read_tables(path, Layout())
    return None if table.header is not None else ColumnTable([table]).names


def select_columns(
    columns: object,
    time: Hashable | None,
    step: object,
    inputs: object,
    outputs: object,
    units: object,
    intersample: object,
    layout: object,
) -> ColumnSelection:
    """Return the column selection from arguments and a columns file; arguments take precedence.

    Arguments are those of :func:`load`. Raise DataError for an invalid argument or file.
    """
    specification = _columns_file(columns)
    if time is not None and step is not None:
        raise DataError(f"{parameter('time')} and {parameter('step')}: both are given; pass one of them")
    if specification.get("time") is not None and specification.get("step") is not None:
        raise DataError(f"{parameter('columns')}: both time and step are given; keep one of them")
    if time is None:
        # A time column in the columns file is compared with a given step.
        time, step = specification.get("time"), specification.get("step") if step is None else step
    return ColumnSelection(
        time,
        cast("float | None", step),
        names_to_columns("inputs", specification.get("inputs")) | names_to_columns("inputs", inputs),
        names_to_columns("outputs", specification.get("outputs")) | names_to_columns("outputs", outputs),
        _words("units", specification.get("units")) | _words("units", units),
        _words("intersample", specification.get("intersample")) | _words("intersample", intersample),
        Layout.from_argument(specification.get("layout")).merge(Layout.from_argument(layout)),
    )


def _words(argument: str, value: object) -> dict[str, str]:
    return {} if value is None else dict(cast("Mapping[str, str]", as_mapping(argument, value, "word")))


def _columns_file(columns: object) -> Mapping[str, object]:
    if columns is None:
        return {}
    if isinstance(columns, (str, os.PathLike)):
        remedy = "a file with a time and tables [inputs], [outputs] and [units] of name = column"
        contents = msgspec.structs.asdict(read_toml(columns, "names of columns", remedy, _ColumnsFile))
        return {key: value for key, value in contents.items() if value is not None}
    if not isinstance(columns, Mapping):
        raise DataError(f"{parameter('columns')} is {type_name(columns)}; pass a dict or the path of a TOML file")
    keys = COLUMN_KEYS
    unknown_names = [key for key in columns if key not in keys]
    if unknown_names:
        raise DataError(
            f"{parameter('columns')}: the key {unknown_names[0]!r} is unknown{nearest(unknown_names[0], keys)}, "
            f"{len(unknown_names)} in "
            f"all; the known keys are {join_names(keys)}"
        )
    return columns


def _apply_header(selection: ColumnSelection, header: Header) -> None:
    """Complete a column selection in place by the ftlm header of a file; raise DataError if units contradict it."""
    if selection.time is None and selection.step is None:
        selection.time = CSV_TIME
    if not selection.inputs and not selection.outputs:
        selection.inputs = {name: name for name in header.inputs}
        selection.outputs = {name: name for name in header.outputs}
    elif not selection.outputs:
        selection.outputs = {name: name for name in header.outputs if name not in selection.inputs}
    elif not selection.inputs:
        selection.inputs = {name: name for name in header.inputs if name not in selection.outputs}
    for name, column in (selection.inputs | selection.outputs).items():
        file_unit = header.units.get(str(column))
        unit = selection.units.get(name)
        if file_unit and unit and unit != file_unit:
            raise DataError(
                f"{parameter('units')}: {unit!r} is given for signal {name!r}, but the file states {file_unit!r}; "
                "leave the unit out for a file written by ftlm"
            )
        if file_unit and not unit:
            selection.units[name] = file_unit
        if name in selection.inputs and str(column) in header.intersample:
            selection.intersample.setdefault(name, header.intersample[str(column)])
