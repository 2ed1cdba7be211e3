"""Preview of an unknown file: columns, units, roles, assumptions and a command for the next step."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ftlm.data.run import Run
from ftlm.data.units import split_time_header
from ftlm.errors import DataError
from ftlm.io.column_roles import ColumnSelection, add_file_units, assume_roles, has_numbers
from ftlm.io.dialect import Assumption, Layout
from ftlm.io.load import (
    COLUMN_KEYS,
    LoadOptions,
    PathLike,
    load,
    read_tables,
    run_from_tables,
    select_columns,
    time_header,
    unused_time,
)
from ftlm.io.load_frequency import is_response
from ftlm.io.table import Column, ColumnTable, FileTable, date_order_assumption
from ftlm.utils.arguments import check_arguments
from ftlm.utils.files import write_atomically
from ftlm.utils.parameters import NAMED_COLUMNS, Placeholder, choose_text, flag_of, parameter, type_name
from ftlm.utils.validation import CSV_TIME, join_names

_MAX_LISTED_COLUMNS = 40
#: Circuit of a resistor in series with a resistor parallel to a constant-phase element.
_ARC_CIRCUIT = "R0-p(R1,CPE1)"
#: Names of time columns that imply seconds.
_SECONDS_COLUMN_NAMES = frozenset(("seconds", "second", "sec", "secs", "sekunden"))
#: Part of the error message of a column that describes its first bad cell.
_IN_LINE = re.compile(r"line \d+: .*?(?=, first at)")


@dataclass(frozen=True)
class FileColumn:
    """Summary of one column of a file.

    Parameters
    ----------
    name : str
        Name in the file.
    role : str
        ``"time"``, ``"input"``, ``"output"``, or "" for an unused column.
    signal : str
        Signal name of an input or output; otherwise "".
    unit : str
        Unit in the file; "" if there is none.
    first, low, high : float or None
        First, lowest and highest value; None if the column has no numbers.
    description : str
        Description of the content if the column has no numbers; otherwise "".
    """

    name: str
    role: str
    signal: str
    unit: str
    first: float | None
    low: float | None
    high: float | None
    description: str = ""


@dataclass(frozen=True)
class OpenedFile:
    """Result of :func:`ftlm.open_file`: columns of a file, their roles, layout and assumptions.

    Parameters
    ----------
    path : str
        Path of the file.
    kind : str
        File format, as text.
    rows : int
        Number of rows of the table.
    columns : tuple of FileColumn
        Summaries of the columns.
    layout : Layout
        Layout of the file, with given and detected options.
    assumptions : tuple of Assumption
        Assumptions about layout, time and roles, each with the argument that replaces it.
    options : dict
        Arguments with which :func:`ftlm.load` returns the previewed run without assumptions.
    step : float or None
        Sampling interval [s]; None if `problem` is set.
    problem : str
        Reason why the file cannot be loaded as a run without further arguments, with a remedy; "" if it can.
    warnings : tuple of str
        Warnings of the run.
    """

    path: str
    kind: str
    rows: int
    columns: tuple[FileColumn, ...]
    layout: Layout
    assumptions: tuple[Assumption, ...]
    options: dict[str, Any]
    step: float | None
    problem: str
    warnings: tuple[str, ...] = ()

    def load(self) -> Run:
        """Load the file with `options` as arguments, and return the run; raise DataError as :func:`ftlm.load` does."""
        return load(self.path, **self.options)

    def command(self, verb: str = "identify") -> str:
        """Return a shell command for the next step; "" if inputs or outputs are unknown.

        Parameters
        ----------
        verb
            Command of `ftlm`: ``identify``, ``inspect`` or ``select``. For ``identify`` and ``select`` the structure is
            chosen automatically, for the first output if there are several.
        """
        if self.problem:
            return ""
        words = ["ftlm", verb, self.path if not self.path.startswith("-") else f"./{self.path}", *self._flags()]
        outputs = [c.signal for c in self.columns if c.role == "output"]
        if verb in ("identify", "select"):
            words += ["--structure", "auto"]
            words += ["--only", outputs[0]] if len(outputs) > 1 else []
        return " ".join(map(shlex.quote, words))

    def write_columns(self, path: PathLike, *, force: bool = False) -> Path:
        """Write time, columns, units and layout as a TOML file for ``columns=`` and ``--columns``.

        Parameters
        ----------
        path
            File to write.
        force
            Overwrite an existing file.

        Raises
        ------
        DataError
            If inputs or outputs are unknown, the file exists and ``force`` is False, or it cannot be written.
        """
        if self.problem:
            raise DataError(f"{self.path} has no columns to write: {self.problem}")
        options = {k: v.to_dict() if isinstance(v, Layout) else v for k, v in self.options.items() if k in COLUMN_KEYS}
        lines = ["# Left of = is the signal name; change it to the name in your equation or structure."]
        lines += [f"{key} = {_toml(value)}" for key, value in options.items() if not isinstance(value, dict)]
        for table, values in ((k, v) for k, v in options.items() if isinstance(v, dict)):
            lines += ["", f"[{table}]", *(f"{_toml(str(k))} = {_toml(v)}" for k, v in values.items())]
        return write_atomically(path, ("\n".join(lines) + "\n").encode(), force=force)

    def to_dict(self) -> dict[str, Any]:
        """Return the preview as a JSON-compatible dictionary."""
        fields = {**asdict(self), "layout": self.layout.to_dict(), "commands": self._commands()}
        return {**fields, "options": {k: v.to_dict() if isinstance(v, Layout) else v for k, v in self.options.items()}}

    def __str__(self) -> str:
        headings = ("column", "role", "unit", "first", "low", "high")
        columns = self.columns[:_MAX_LISTED_COLUMNS]
        cells: list[tuple[str, ...]] = [headings]
        for c in columns:
            texts = _truncate_text(c.name), f"{c.role} {c.signal}".rstrip(), _truncate_text(c.unit)
            cells.append((*texts, *_figures(c)))
        widths = [max(len(row[k]) for row in cells) for k in range(6)]
        counts = f"{self.rows} row{'s' * (self.rows != 1)}, {len(self.columns)} column{'s' * (len(self.columns) != 1)}"
        lines = [f"{_truncate_text(self.path)}: {self.kind}; {counts}"]
        lines += ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in cells]
        if len(self.columns) > _MAX_LISTED_COLUMNS:
            lines.append(f"… and {len(self.columns) - _MAX_LISTED_COLUMNS} more")
        if self.step is not None:
            lines.append(f"step {self.step:.6g} s, {self.step * (self.rows - 1):.6g} s in all")
        lines += [f"assumed: {assumption}" for assumption in self.assumptions]
        lines += [f"note: {note}" for note in self.warnings]
        if self.problem:
            lines.append(f"to do: {self.problem}")
        # A command with unprintable characters could not be copied from a terminal.
        lines += [f"next: {line}" for line in self._commands() if line.isprintable()]
        return "\n".join(map(_escape_nonprintable, lines))

    def _commands(self) -> list[str]:
        return [] if self.problem else [self.command("inspect"), self.command("identify")]

    def _flags(self) -> list[str]:
        """Return the command-line arguments that correspond to `options`, without those that equal a default."""
        options = self.options
        # Options that are detected reliably or equal the default are omitted.
        stated_options = {a.option for a in self.assumptions if not a.affects_run and a.option != "time"}
        arguments = []
        for key in ("time", "step", "time_unit", "resample", "missing"):
            if key in options and key not in stated_options:
                arguments += [flag_of(key), str(options[key])]
        if "window" in options:
            arguments += [
                flag_of("window"),
                ":".join("" if bound is None else repr(bound) for bound in options["window"]),
            ]
        for key in ("inputs", "outputs", "units", "intersample"):
            bare = key in ("inputs", "outputs")
            pairs = (
                name if bare and name == value else f"{name}={value}" for name, value in options.get(key, {}).items()
            )
            arguments += [w for pair in pairs for w in (flag_of(key), pair)]
        given_layout: Layout = options.get("layout", Layout())
        arguments += [
            w for k, v in given_layout.to_dict().items() if k not in stated_options for w in (flag_of(k), str(v))
        ]
        return arguments


@check_arguments
def open_file(
    path: PathLike,
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
    time_unit: str | None = None,
    missing: str | None = None,
    layout: Layout | Mapping[str, object] | None = None,
) -> OpenedFile:
    """Return a preview of a file: columns, units, roles, assumptions and a command for the next step.

    Unless given, time column and roles are inferred from column names, and units from names or a line of units. The
    result lists these inferences with the corresponding arguments of :func:`ftlm.load`. Nothing is inferred from the
    values.

    Parameters
    ----------
    path : path
        File of any format that :func:`ftlm.load` reads.
    time, inputs, outputs, units, columns, intersample, step, window, resample, time_unit, missing, layout
        As in :func:`ftlm.load`.

    Returns
    -------
    OpenedFile
        Preview that prints as a table; ``.load()`` returns the run.

    Raises
    ------
    DataError
        If the file is missing, damaged or has an ambiguous layout. If the file cannot be loaded for another reason,
        `problem` of the result states the reason.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise DataError(f"path is {type_name(path)}; pass the path of one file")
    selection = select_columns(columns, time, step, inputs, outputs, units, intersample, layout)
    return preview_selection(path, selection, LoadOptions(window, resample, None, time_unit, missing))


def preview_selection(path: PathLike, selection: ColumnSelection, options: LoadOptions) -> OpenedFile:
    """Return a preview of a file with a selection of its columns; see :func:`open_file`."""
    (table,) = read_tables(path, selection.layout)
    return _FilePreview(table, ColumnTable([table]), selection, options).result(os.fspath(path))


@dataclass
class _FilePreview:
    """Builder of the preview of a file; :meth:`result` returns it."""

    table: FileTable
    pool: ColumnTable
    selection: ColumnSelection
    options: LoadOptions

    def result(self, path: str) -> OpenedFile:
        table, selection = self.table, self.selection
        all_columns = self.pool.columns
        time_column, assumed, problem = self._time(all_columns)
        time_assumptions = (
            () if time_column is None or selection.step is not None else self._time_assumptions(time_column)
        )
        roles, role_assumptions, open_roles = self._roles(all_columns, time_column)
        assumed = (*table.assumptions, *assumed, *time_assumptions, *role_assumptions)
        step, notes = None, tuple[str, ...]()
        if not problem:
            problem = open_roles
        options = self._options(time_column, time_assumptions)
        if not problem:
            try:
                run = run_from_tables([table], selection, self.options)
                step, notes = run.step, tuple(n for n in run.warnings if n not in {str(a) for a in assumed})
            except DataError as error:
                problem = str(error)
        columns = tuple(_summarize_column(column, roles) for column in all_columns)
        rows = max((0 if c.values is None else c.values.size for c in all_columns), default=0)
        return OpenedFile(path, table.kind, rows, columns, table.layout, assumed, options, step, problem, notes)

    def _named_signals(self) -> set[str]:
        """Return the names of the columns that the user selects as inputs or outputs, if they exist."""
        names = set[str]()
        for spec in (*self.selection.inputs.values(), *self.selection.outputs.values()):
            with contextlib.suppress(DataError):
                names.add(self.pool.find(spec, "signal").name)
        return names

    def _time(self, all_columns: list[Column]) -> tuple[Column | None, tuple[Assumption, ...], str]:
        """Return the time column, assumptions about it, and "" or a text on why there is no time column."""
        selection, header = self.selection, self.table.header
        if header is not None and selection.time is None and selection.step is None:
            selection.time = CSV_TIME
        signals = self._named_signals()
        if selection.step is not None:
            return unused_time(selection, self.pool, signals), (), ""
        if header is None and selection.time is None and not signals and is_response(self.pool):
            path = shlex.quote(os.fspath(self.table.path))
            command = f"ftlm identify-frequency {path} {parameter('circuit', _ARC_CIRCUIT)}"
            hint = choose_text(f"ftlm.identify_frequency(ftlm.load_frequency(path), {_ARC_CIRCUIT!r})", command)
            reason = "the columns are those of a frequency response or an impedance spectrum"
            fits = "fits a first model, for an impedance a resistor in series with a depressed semicircle"
            return None, (), f"{reason}; {hint} {fits}"
        matrices = list(dict.fromkeys(c.matrix for c in all_columns if c.matrix is not None))
        try:
            time_column, assumed = self.pool.time(selection.time, matrices if len(matrices) == 1 else [], signals)
        except DataError as error:
            return None, (), str(error)
        if assumed is not None:
            return time_column, (assumed,), ""
        if selection.time is None and time_column.matrix is not None:
            reason = f"the time is the first column of the matrix, {time_column.name!r}"
            return (
                time_column,
                (Assumption("time", time_column.name, reason, f"{parameter('time', Placeholder('COLUMN'))}", False),),
                "",
            )
        return time_column, (), ""

    def _roles(
        self, all_columns: list[Column], time_column: Column | None
    ) -> tuple[dict[str, tuple[str, str]], tuple[Assumption, ...], str]:
        """Return (role, signal) by column, assumptions, and "" or a text on why the roles are unknown."""
        selection, header = self.selection, self.table.header
        assumptions = tuple[Assumption, ...]()
        if header is not None and not selection.inputs and not selection.outputs:
            selection.inputs, selection.outputs = {n: n for n in header.inputs}, {n: n for n in header.outputs}
        else:
            assumptions = assume_roles(selection, [c for c in all_columns if c is not time_column])
        roles: dict[str, tuple[str, str]] = {} if time_column is None else {time_column.name: ("time", "")}
        for role, specs in (("input", selection.inputs), ("output", selection.outputs)):
            for name, spec in specs.items():
                roles[self.pool.find(spec, f"signal {name!r}").name] = (role, name)
        if header is None:
            add_file_units(selection, self.pool)
        open_roles = ""
        if not selection.outputs:
            choice = join_names((c.name for c in all_columns if c is not time_column and has_numbers(c)), 20)
            open_roles = (
                "the column names do not say which are inputs and which are outputs; name them with "
                f"{parameter('inputs', NAMED_COLUMNS)} and {parameter('outputs', NAMED_COLUMNS)}; there are "
                f"{choice or 'none'}"
            )
            text_columns = (
                c for c in all_columns if c is not time_column and not has_numbers(c) and c.timestamps is None
            )
            texts = [f"{c.name!r} ({_first_bad_cell(c)})" for c in text_columns]
            if texts:
                further_text = f" and {len(texts) - _MAX_LISTED_COLUMNS} more" * (len(texts) > _MAX_LISTED_COLUMNS)
                open_roles += f"; no column of numbers is {', '.join(texts[:_MAX_LISTED_COLUMNS])}{further_text}"
        return roles, assumptions, open_roles

    def _time_assumptions(self, time_column: Column) -> tuple[Assumption, ...]:
        """Return the assumptions on the time column: its unit, or the sequence of day and month in its dates."""
        if self.table.header is not None:
            return ()
        if time_column.timestamps is not None:
            order = date_order_assumption(time_column, self.selection.layout.dates)
            return () if order is None else (order,)
        name = time_header(time_column)
        is_certain = split_time_header(name)[1] is not None or name.casefold() in _SECONDS_COLUMN_NAMES
        if self.options.time_unit is not None or is_certain or time_column.problem is not None:
            return ()
        text = f"the numbers of {time_column.name!r} are seconds, as no unit is stated"
        return (Assumption("time_unit", "s", text, f"{parameter('time_unit', Placeholder('UNIT'))}", False),)

    def _options(self, time_column: Column | None, time_assumptions: tuple[Assumption, ...]) -> dict[str, Any]:
        """Return the arguments with which :func:`ftlm.load` returns the previewed run without assumptions."""
        selection = self.selection
        options: dict[str, Any] = {"step": selection.step} if selection.step is not None else {}
        if time_column is not None and selection.step is None and self.table.header is None:
            options["time"] = time_column.name
        further_options = {key: getattr(self.options, key) for key in ("window", "resample", "time_unit", "missing")}
        options |= {key: value for key, value in further_options.items() if value is not None}
        for key in ("inputs", "outputs", "units", "intersample"):
            if getattr(selection, key) and (self.table.header is None or key in ("inputs", "outputs")):
                options[key] = dict(getattr(selection, key))
        keys = {*selection.layout.to_dict(), *(a.option for a in self.table.assumptions)}
        layout = Layout.from_argument({key: value for key, value in self.table.layout.to_dict().items() if key in keys})
        for assumption in time_assumptions:
            if assumption.option == "dates":
                layout = layout.merge(Layout(dates=str(assumption.value)))
            else:
                options[assumption.option] = assumption.value
        return options | ({"layout": layout} if layout != Layout() else {})


def _first_bad_cell(column: Column) -> str:
    """Return text on the first cell of a column that is not a number, with its line; "" if the error has none."""
    match = _IN_LINE.search(str(column.problem))
    return "" if match is None else match[0]


def _summarize_column(column: Column, roles: Mapping[str, tuple[str, str]]) -> FileColumn:
    role, signal = roles.get(column.name, ("", ""))
    summary, values = FileColumn(column.name, role, signal, column.file_unit, None, None, None), column.values
    if column.timestamps is not None:
        return replace(summary, description=f"from {column.timestamps.first}")
    if values is None or not values.size or not has_numbers(column):
        problem = _first_bad_cell(column)
        return replace(summary, description=f"no numbers ({problem})" if problem else "no numbers")
    finite = values[~np.isnan(values)]
    if not finite.size:
        return replace(summary, description="empty")
    return replace(summary, first=float(values[0]), low=float(finite.min()), high=float(finite.max()))


def _toml(value: object) -> str:
    """Return a text or a number in TOML syntax."""
    return json.dumps(value, ensure_ascii=False)


def _figures(column: FileColumn) -> tuple[str, str, str]:
    if column.first is None or column.low is None or column.high is None:
        return _truncate_text(column.description), "", ""
    return f"{column.first:.5g}", f"{column.low:.5g}", f"{column.high:.5g}"


def _truncate_text(text: str) -> str:
    """Return at most 60 characters of a text, with an ellipsis if it is longer, and with unprintable ones escaped."""
    return _escape_nonprintable(text[:60]) + ("…" if len(text) > 60 else "")


def _escape_nonprintable(text: str) -> str:
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
