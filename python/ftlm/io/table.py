"""Columns of one or several files with unique names, and detection of the time column."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ftlm.data.export import Header
from ftlm.data.units import is_time_name, split_time_header
from ftlm.errors import DataError
from ftlm.io.cell_parsing import Timestamps, is_time_unit, split_slash_unit, split_unit
from ftlm.io.dialect import Assumption, Layout
from ftlm.utils.parameters import Placeholder, choose_text, layout_parameter, parameter
from ftlm.utils.validation import bad_rows_error, join_names, nearest

_RELATIVE_TIME_TOLERANCE = 1e-9
#: Further names of time columns besides t, time and seconds, case-folded and without word separators.
_OTHER_TIME_NAMES = (
    "timestamp datetime zeit zeitstempel datumzeit datumuhrzeit uhrzeit elapsedtime elapsed timeelapsed xvalue temps "
    "tiempo tempo sec secs second sekunden"
)
_OTHER_TIMES = frozenset(_OTHER_TIME_NAMES.split())
_JOINER_REMOVAL = str.maketrans("", "", " _-/.")
_MATLAB_COLUMN = re.compile(r"(.+)\(:,\s*(\d+)\)")


@dataclass(frozen=True)
class Column:
    """Column of a file: its numbers, or the reason why it is not a column of numbers.

    Parameters
    ----------
    variable, name
        Name in the file, and unique name over all files.
    source
        Path of the file, with any HDF5 group.
    values
        Numbers, shape (N,); None if there are none.
    problem
        Error to raise if the column is used as numbers; None for a column of numbers.
    matrix
        Name of the matrix of which this is a column; None for a vector.
    blank
        Whether all invalid cells are empty, so that they are NaN in `values`.
    timestamps
        Dates or times of day of the column; None if it has none.
    file_unit
        Unit in the file; "" if there is none.
    """

    variable: str
    name: str
    source: Path
    values: npt.NDArray[np.float64] | npt.NDArray[np.float32] | None
    problem: DataError | None = None
    matrix: str | None = None
    blank: bool = False
    timestamps: Timestamps | None = None
    file_unit: str = ""

    @property
    def name_with_unit(self) -> str:
        """Name of the column, with a unit after a slash, as in ``I/A``, rewritten in brackets."""
        bare, unit = split_slash_unit(self.name)
        return f"{bare} [{unit}]" if unit and unit == self.file_unit else self.name

    def numbers(self, *, blank: bool = False) -> npt.NDArray[np.float64] | npt.NDArray[np.float32]:
        """Return the numbers of the column; raise its error if it has other cells. `blank` allows empty cells (NaN)."""
        if blank and self.blank and self.values is not None:
            return self.values
        if self.problem is not None or self.values is None:
            raise self.problem or DataError(f"column {self.name!r} has no numbers; choose another column")
        return self.values


def dates_error(label: str, description: str, rows: int) -> DataError:
    """Return the DataError for a column of dates or times of day that is used as numbers."""
    return bad_rows_error(label, description, 0, rows, f"name it with {parameter('time')}, or choose another column")


@dataclass(frozen=True)
class FileTable:
    """Columns of one file, with its format, its layout and the assumptions of the reader.

    Parameters
    ----------
    path
        Path of the file, with any HDF5 group.
    columns
        Columns in the sequence of the file.
    text
        Whether columns may be selected by position, as in a text file.
    header
        Header of a run that ftlm wrote; None for other files.
    skipped
        Reason why a part of the file was not read, by name.
    layout, assumptions
        Layout of a text or sheet, and assumptions about it.
    kind
        File format, as text.
    """

    path: Path
    columns: list[Column]
    text: bool
    header: Header | None = None
    skipped: dict[str, str] = field(default_factory=dict)
    layout: Layout = field(default_factory=Layout)
    assumptions: tuple[Assumption, ...] = ()
    kind: str = ""

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the groups of an HDF5 file that each have a time column; empty if the file contains one run."""
        name_parts = [c.variable.rpartition("/") for c in self.columns if c.matrix is None]
        groups = tuple(dict.fromkeys(group for group, _, name in name_parts if group and is_time_name(name)))
        return groups if len(groups) > 1 else ()

    def in_group(self, group: str) -> FileTable:
        """Return a table of the columns in an HDF5 group, with their names within the group.

        Raises
        ------
        DataError
            If there is no column in the group.
        """
        path, prefix = self.path / group, f"{group}/"
        columns = [
            replace(c, variable=c.variable.removeprefix(prefix), name=c.name.removeprefix(prefix), source=path)
            for c in self.columns
            if c.variable.startswith(prefix)
        ]
        if not columns:
            groups = sorted({c.variable.rpartition("/")[0] for c in self.columns} - {""})
            raise DataError(
                f"{str(self.path)!r}: the group {group!r} is not in the file{nearest(group, groups)}; its groups are "
                f"{join_names(groups) or 'none'}"
            )
        return replace(self, path=path, columns=columns)


class ColumnTable:
    """Columns of all files with unique names: a name that several files have gets the file name as a prefix."""

    def __init__(self, tables: list[FileTable]) -> None:
        self._tables = tables
        files = Counter(variable for variable, _ in {(c.variable, t.path) for t in tables for c in t.columns})
        self._columns: dict[str, Column] = {}
        for table in tables:
            for column in table.columns:
                prefix = f"{table.path.stem}/" if files[column.variable] > 1 else ""
                name = prefix + column.name
                if name in self._columns and name:
                    raise DataError(
                        f"column {name!r} is in {str(self._columns[name].source)!r} and {str(table.path)!r}; "
                        "rename one of the files"
                    )
                if prefix:
                    matrix = None if column.matrix is None else prefix + column.matrix
                    self._columns[name] = replace(column, name=name, matrix=matrix)
                else:
                    self._columns[name] = column

    @property
    def columns(self) -> list[Column]:
        """All columns, in the sequence of the files."""
        return list(self._columns.values())

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns that have one."""
        return tuple(name for name in self._columns if name)

    def describe(self) -> str:
        """Return text on the available columns and on skipped parts of the files, for error messages."""
        skipped = {name: reason for table in self._tables for name, reason in table.skipped.items()}
        text = f"the columns are {join_names(self.names)}"
        if skipped:
            text += "; not read: " + ", ".join(f"{name!r} ({reason})" for name, reason in list(skipped.items())[:10])
        return text

    def find(self, spec: object, use: str) -> Column:
        """Return the column with the name or position `spec`; raise DataError if there is none.

        `use` states in messages what the column is used for. A name may omit its unit, and ``V(:,1)`` means ``V.1``.
        """
        if isinstance(spec, int) and not isinstance(spec, bool):
            return self._at(spec, use)
        if not isinstance(spec, str):
            raise DataError(f"column {spec!r} ({use}) is neither a name nor a position; give one of them")
        name = spec
        match = _MATLAB_COLUMN.fullmatch(spec)
        if spec not in self._columns and match:
            name = f"{match[1]}.{int(match[2])}" if len(match[2]) < 10 else spec
        column = self._columns.get(name)
        if column is None:
            # Accept a name without its unit in brackets, if it is unique.
            bare = [
                c for c in self._columns.values() if split_unit(c.name_with_unit) == (spec, c.file_unit) and c.file_unit
            ]
            column = bare[0] if len(bare) == 1 else None
        if column is None:
            raise DataError(
                f"column {spec!r} ({use}) is not in {join_names(table.path.name for table in self._tables)}"
                f"{nearest(spec, self._columns)}; {self.describe()}"
            )
        return column

    def _at(self, position: int, use: str) -> Column:
        if len(self._tables) > 1 or not self._tables[0].text:
            raise DataError(f"column {position} ({use}): positions are for single text files; {self.describe()}")
        columns = self._tables[0].columns
        if not 0 <= position < len(columns):
            raise DataError(
                f"column {position} ({use}) is out of range, positions go from 0 to {len(columns) - 1}; "
                f"{self.describe()}"
            )
        return columns[position]

    def time(self, spec: object, matrices: Iterable[str], signals: Collection[str]) -> tuple[Column, Assumption | None]:
        """Return the time column, and the assumption about it if it was detected and may be wrong.

        Parameters
        ----------
        spec
            Name or position of the column; None to detect it.
        matrices
            Names of the matrices whose first columns are the time if no other column is.
        signals
            Names of the columns that are used as signals. They are the time only if `spec` is one of them.

        Raises
        ------
        DataError
            If there is no time column or several candidates, or times of different files differ.
        """
        if spec is not None:
            return self.find(spec, "time"), None
        time_columns, assumed = [], None
        for table in self._tables:
            columns, problem = self._time_candidates(table, signals)
            if len(columns) > 1 and table.runs:
                raise DataError(
                    f"{table.path.name} contains {len(table.runs)} runs, each in a group with its own time; give the "
                    f"path of one, as in {str(table.path / table.runs[0])!r}; the groups are {join_names(table.runs)}"
                )
            if len(columns) > 1:
                raise DataError(
                    f"{table.path.name}: the columns {join_names(column.name for column in columns)} may all be the "
                    f"time; name one with {parameter('time')}"
                )
            if columns and problem:
                assumed = Assumption("time", columns[0].name, problem, parameter("time", Placeholder("COLUMN")))
            time_columns += columns
        if not time_columns:
            first_columns = [self._columns[f"{matrix}.1"] for matrix in dict.fromkeys(matrices)]
            time_columns = [column for column in first_columns if column.name not in signals]
        if not time_columns:
            raise DataError(
                "time: no column is called t, time or seconds, alone or with a unit as in time [ms], time_ms or t (s); "
                f"name it with {parameter('time')}, or give the time between rows with {parameter('step')}; "
                f"{choose_text('identify_frequency', 'ftlm identify-frequency')} takes spectra; {self.describe()}"
            )
        for other_time_column in time_columns[1:]:
            _check_agreement(time_columns[0], other_time_column)
        return time_columns[0], assumed

    def _time_candidates(self, table: FileTable, signals: Collection[str]) -> tuple[list[Column], str]:
        """Return candidates for the time column of a file, and the reason for the choice if it is an assumption.

        The first criterion with a candidate is used: t, time or seconds; another name of a time; dates; first column
        with a unit of time.
        """
        candidates = [c for c in self._columns.values() if c.source == table.path and c.name not in signals]
        vectors = [c for c in candidates if c.matrix is None]
        groups = {name.rpartition("/")[0] for name in signals}
        # Each group of an HDF5 file is a separate run.
        if groups != {""}:
            vectors = [c for c in vectors if {c.name.rpartition("/")[0]} == groups] or vectors
        time_columns = [c for c in vectors if is_time_name(c.variable) or is_time_name(c.variable.rpartition("/")[2])]
        if time_columns:
            return time_columns, ""
        columns = [c for c in vectors if split_time_header(c.variable)[0].translate(_JOINER_REMOVAL) in _OTHER_TIMES]
        if columns:
            return columns, f"the time is column {columns[0].name!r}, by its name"
        dated = [c for c in vectors if c.timestamps is not None]
        if dated:
            return dated, f"the time is column {dated[0].name!r}, which contains dates or times of day"
        if vectors and vectors[0].file_unit and is_time_unit(vectors[0].file_unit):
            return vectors[:1], f"the time is the first column, {vectors[0].name!r}, by its unit {vectors[0].file_unit}"
        return [], ""


def date_order_assumption(time_column: Column, dates: str | None) -> Assumption | None:
    """Return the assumption on the sequence of day and month in a time column; None if none was assumed."""
    order = "" if time_column.timestamps is None else time_column.timestamps.inferred_date_order(dates)
    if time_column.timestamps is None or not order:
        return None
    first_part = "day" if order == "dmy" else "month"
    text = f"dates begin with the {first_part}, as in {time_column.timestamps.first!r}"
    return Assumption("dates", order, text, layout_parameter(dates=Placeholder("ORDER")))


def _check_agreement(reference: Column, compared: Column) -> None:
    names = (
        f"time: the columns {reference.name!r} of {reference.source.name} and {compared.name!r} of "
        f"{compared.source.name}"
    )
    if reference.timestamps is not None and compared.timestamps is not None:
        reference_parts, compared_parts = (
            np.column_stack([c.parts, c.clock]) for c in (reference.timestamps, compared.timestamps)
        )
        if reference.timestamps.separator != compared.timestamps.separator or not np.array_equal(
            reference_parts, compared_parts
        ):
            raise DataError(
                f"{names} differ; give files of one record, or name the time to use with {parameter('time')}"
            )
        return
    a, b = reference.numbers(), compared.numbers()
    if a.size != b.size:
        raise DataError(
            f"{names} have {a.size} and {b.size} rows; give files of one record, or name the time with "
            f"{parameter('time')}"
        )
    with np.errstate(invalid="ignore", over="ignore"):
        is_same = np.abs(np.subtract(a, b, dtype=np.float64)) <= _RELATIVE_TIME_TOLERANCE * max(
            1.0, float(np.abs(a[[0, -1]]).max())
        )
    rows = np.flatnonzero(~is_same & ~(np.isnan(a) & np.isnan(b)))
    if rows.size:
        difference_text = f"differ, {float(a[rows[0]])!r} and {float(b[rows[0]])!r}"
        remedy = f"give files of one record, or name the time to use with {parameter('time')}"
        raise bad_rows_error(names, difference_text, int(rows[0]), rows.size, remedy)
