"""Loads one measured experiment from text, MATLAB or parquet files, refusing whatever it cannot be sure of."""

from __future__ import annotations

import csv
import importlib.util
import itertools
import json
import math
import os
import re
import signal
import stat
import subprocess
import sys
import tomllib
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO, TypeAlias, TypeVar, cast

import numpy as np
import numpy.typing as npt

from ftlm.errors import DataError
from ftlm.runs import Run, bad_rows, build, is_run_name, listed, names_to_columns, nearest

__all__ = ["load"]

PathLike: TypeAlias = str | os.PathLike[str]
_Kind = TypeVar("_Kind")

_SIZE_LIMIT = 1 << 30
_BLOCK = 8 << 20
_LONGEST_HEADER = 1 << 20
_SAMPLE_LINES = 20
_READER = Path(__file__).with_name("mat_reader.py")
_PARQUET_READER = Path(__file__).with_name("parquet_reader.py")
_READER_SECONDS = 60.0
_TIME_NAMES = frozenset(("t", "time", "t_s", "time_s", "seconds", "time [s]"))
_AGREE = 1e-9
_COLUMN_KEYS = ("time", "step", "inputs", "outputs", "units", "intersample")
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?|[+-]?\d+,(?:[eE][+-]?\d+)?")
_DECIMAL_COMMAS = re.compile(r"\s*[+-]?\d+,\d+(?:[eE][+-]?\d+)?(?:\s+[+-]?\d+,\d+(?:[eE][+-]?\d+)?)+\s*")
_DECIMAL_WAY_OUT = "write decimal points, for instance by replacing every comma by a point where ';' or tabs separate"
_MATLAB_COLUMN = re.compile(r"(.+)\(:,\s*(\d+)\)")
_FTLM_MARK = "# ftlm-run "
_UTF16 = (b"\xff\xfe", b"\xfe\xff")
_BOM = b"\xef\xbb\xbf"


@dataclass(frozen=True)
class _Column:
    """One column of numbers, or the reason why it is not one."""

    variable: str
    name: str
    source: Path
    values: npt.NDArray[np.float64] | npt.NDArray[np.float32] | None
    problem: DataError | None = None
    matrix: str | None = None

    def numbers(self) -> npt.NDArray[np.float64] | npt.NDArray[np.float32]:
        if self.problem is not None or self.values is None:
            raise self.problem or DataError(f"column {self.name!r} holds no numbers; choose another column")
        return self.values


@dataclass(frozen=True)
class _Header:
    """What the first line of a file written by `Run.to_csv` says."""

    name: str
    step: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: dict[str, str]
    intersample: dict[str, str]
    warnings: tuple[str, ...]
    about: dict[str, object]


@dataclass(frozen=True)
class _Table:
    """The columns of one file."""

    path: Path
    columns: list[_Column]
    text: bool
    header: _Header | None = None
    skipped: dict[str, str] = field(default_factory=dict)


@dataclass
class _Asked:
    """What the caller wants, from the arguments, the columns file and ftlm's own header."""

    time: Hashable | None
    step: float | None
    inputs: dict[str, Hashable]
    outputs: dict[str, Hashable]
    units: dict[str, str]
    intersample: dict[str, str]


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
    slice: Sequence[float | None] | None = None,
    resample: float | None = None,
    name: str | None = None,
    time_unit: str = "s",
) -> Run:
    """Load one run from a text, version-5 .mat or parquet file, or from several files that hold its columns.

    Parameters
    ----------
    path : path or sequence of paths
        ``.mat``, ``.parquet``, or text: comma, semicolon, tab or white space between numbers, decimal points, UTF-8,
        lines that begin with ``#`` skipped, an optional header of names. Without a header the columns are c1, c2, …
        The columns of a matrix V of a .mat file are V.1, V.2, … (or ``V(:,1)``), a vector keeps its name; samples are
        in rows.
        Columns of several files are pooled; a name that is in two of them is prefixed by its file, ``STEM/V.3``.
    time : str or int, optional
        Column of the time, by name or, in a single text file, by position from 0. Without `time` and `step`, a text
        file's column called t, time, t_s, time_s, seconds or time [s] (any case) is taken, a .mat file's vector of
        such a name, or else the first column of every matrix in use, which must all agree.
    inputs, outputs : mapping of str to column, or list of str, optional
        Columns by signal name; a list names columns that keep their names. Needed unless `columns` or the file's
        own ftlm header gives them; at least one output.
    units : mapping of str to str, optional
        Unit of a signal's numbers, converted to SI.
    columns : mapping or path of a TOML file, optional
        Keys ``time`` or ``step``, tables ``inputs``, ``outputs``, ``units``, ``intersample``; the arguments of the
        same name override or extend it.
    intersample : mapping of str to {"zoh", "foh"}, optional
        Behaviour of an input between rows; ``"zoh"`` where not given.
    step : float, optional
        Time between rows [s], > 0, in place of `time`.
    slice : pair of float or None, optional
        Use the rows with a ≤ t < b only, [s] since the first row.
    resample : float, optional
        Interpolate onto this step [s]; recorded in the run's warnings.
    name : str, optional
        What reports call the run; the first file's name where not given.
    time_unit : {"s", "ms", "us", "min", "h"}, default "s"
        Unit of the time column.

    Returns
    -------
    Run

    Raises
    ------
    DataError
        If a file is missing, too large (more than 1 GiB), damaged or of another kind; if a line is ragged, or a column
        in use is unknown, empty somewhere or holds text (line, row and column are named); and for everything
        `Run.from_arrays` refuses.

    Examples
    --------
    >>> run = load("arm.csv", time="t_s", inputs={"I1": "Im1_meas_A"}, outputs={"theta11": "th11_deg"},
    ...            units={"theta11": "deg"})  # doctest: +SKIP
    """
    paths = _paths(path)
    asked = _asked(
        time=time,
        step=step,
        inputs=inputs,
        outputs=outputs,
        units=units,
        intersample=intersample,
        columns=columns,
    )
    tables = _tables(paths)
    header = tables[0].header
    if header is not None and len(tables) > 1:
        raise DataError(f"{str(paths[0])!r} is a whole run of its own; load it alone")
    if header is not None:
        _take_header(asked, header)
    pool = _Pool(tables)
    if not asked.outputs:
        raise DataError(
            f"no output is named; name the signals with inputs={{name: column}} and outputs={{name: column}}, "
            f"or in a columns file (commands: -u NAME=COLUMN -y NAME=COLUMN, or --columns FILE); {pool.described()}"
        )
    labels: dict[str, str] = {}
    used: list[_Column] = []

    def gather(wanted: Mapping[str, Hashable]) -> dict[str, object]:
        picked: dict[str, object] = {}
        for signal_name, spec in wanted.items():
            column = pool.find(spec, f"signal {signal_name!r}")
            labels[signal_name] = f"{column.source.name}: column {column.name!r} (signal {signal_name!r})"
            used.append(column)
            picked[signal_name] = column.numbers()
        return picked

    given_inputs, given_outputs = gather(asked.inputs), gather(asked.outputs)
    clock = pool.time(asked.time, used) if asked.step is None else None
    stem = paths[0].stem
    if name is None:
        name = header.name if header is not None else stem if is_run_name(stem) else "run"
    return build(
        step=asked.step,
        time=None if clock is None else clock.numbers(),
        inputs=given_inputs,
        outputs=given_outputs,
        units=asked.units,
        intersample=asked.intersample,
        name=name,
        resample=resample,
        window=slice,
        time_unit=time_unit,
        labels=labels,
        time_label="time" if clock is None else f"{clock.source.name}: column {clock.name!r} (time)",
        known_step=header.step if header is not None and clock is not None and clock.name == "t_s" else None,
        facts=() if header is None else header.warnings,
        about={} if header is None else header.about,
    )


def _paths(given: PathLike | Sequence[PathLike]) -> list[Path]:
    entries = [given] if isinstance(given, (str, os.PathLike)) else given
    if not isinstance(entries, Sequence) or not all(isinstance(entry, (str, os.PathLike)) for entry in entries):
        raise DataError(f"path is a {type(given).__name__}; pass the path of a file, or a list of paths")
    if not entries:
        raise DataError("path: the list is empty; pass the path of at least one file")
    paths = [Path(entry) for entry in entries]
    total = 0
    for index, path in enumerate(paths):
        total += _size(path)
        if any(path.resolve() == other.resolve() for other in paths[:index]):
            raise DataError(f"{str(path)!r} is given twice; give every file once")
    if total > _SIZE_LIMIT:
        raise DataError(
            f"{listed(map(str, paths))}: {total} bytes, more than the limit of {_SIZE_LIMIT}; "
            "split the record or lower its rate"
        )
    return paths


def _size(path: Path) -> int:
    try:
        found = path.stat()
    except FileNotFoundError:
        try:
            beside = sorted(entry.name for entry in path.parent.iterdir())
        except OSError:
            beside = []
        raise DataError(f"{str(path)!r} does not exist{nearest(path.name, beside)}; check the path") from None
    except (OSError, ValueError) as error:
        raise DataError(f"{str(path)!r} cannot be opened ({error}); check the path and its permissions") from None
    if not stat.S_ISREG(found.st_mode):
        raise DataError(f"{str(path)!r} is not a file; pass the path of a file")
    return found.st_size


def _tables(paths: list[Path]) -> list[_Table]:
    read: dict[Path, _Table] = {}
    for kind in (_MATLAB, _PARQUET):
        found = [path for path in paths if path.suffix.lower() in kind.suffixes]
        if found:
            read |= dict(zip(found, _read_apart(found, kind), strict=True))
    return [read[path] if path in read else _read_text(path) for path in paths]


def column_names(path: PathLike) -> tuple[str, ...] | None:
    """Names of the columns of one file; None for a run that ftlm wrote, which names its own signals.

    Raises
    ------
    DataError
        As :func:`load`.
    """
    (table,) = _tables(_paths(path))
    return None if table.header is not None else _Pool([table]).names


# --- what is asked for ------------------------------------------------------------------------------------------------


def _asked(
    *,
    time: Hashable | None,
    step: object,
    inputs: object,
    outputs: object,
    units: object,
    intersample: object,
    columns: object,
) -> _Asked:
    told = _columns_file(columns)
    if time is not None and step is not None:
        raise DataError("time= and step=: both are given; pass one of them")
    if time is None and step is None:
        time, step = told.get("time"), told.get("step")
        if time is not None and step is not None:
            raise DataError("columns=: both time and step are given; keep one of them")
    return _Asked(
        time=time,
        step=cast("float | None", step),
        inputs={**names_to_columns("inputs", told.get("inputs")), **names_to_columns("inputs", inputs)},
        outputs={**names_to_columns("outputs", told.get("outputs")), **names_to_columns("outputs", outputs)},
        units={**_words("units", told.get("units")), **_words("units", units)},
        intersample={**_words("intersample", told.get("intersample")), **_words("intersample", intersample)},
    )


def _words(argument: str, given: object) -> dict[str, str]:
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise DataError(f"{argument}= is a {type(given).__name__}; pass a dict of name: word")
    return dict(given)


def _columns_file(columns: object) -> Mapping[str, object]:
    if columns is None:
        return {}
    told: Mapping[str, object]
    if isinstance(columns, Mapping):
        told, source = columns, "columns="
    elif isinstance(columns, (str, os.PathLike)):
        path = Path(columns)
        source = repr(str(path))
        if _size(path) > _LONGEST_HEADER:
            raise DataError(f"{source} is too large for a columns file; pass the TOML file that names the columns")
        try:
            told = tomllib.loads(path.read_bytes().decode("utf-8-sig").replace("\r\n", "\n"))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
            raise DataError(
                f"{source} is not a TOML file ({error}); write a time key and tables [inputs], [outputs] and [units] "
                "of name = column"
            ) from None
    else:
        raise DataError(f"columns= is a {type(columns).__name__}; pass a dict or the path of a TOML file")
    unknown = [key for key in told if key not in _COLUMN_KEYS]
    if unknown:
        raise DataError(
            f"{source}: the key {unknown[0]!r} is unknown{nearest(unknown[0], _COLUMN_KEYS)}, {len(unknown)} in all; "
            f"the known keys are {listed(_COLUMN_KEYS)}"
        )
    return told


def _take_header(asked: _Asked, header: _Header) -> None:
    """Fill in what was not asked for from ftlm's own header."""
    if asked.time is None and asked.step is None:
        asked.time = "t_s"
    if not asked.inputs and not asked.outputs:
        asked.inputs = {name: name for name in header.inputs}
        asked.outputs = {name: name for name in header.outputs}
    elif not asked.outputs:
        asked.outputs = {name: name for name in header.outputs if name not in asked.inputs}
    elif not asked.inputs:
        asked.inputs = {name: name for name in header.inputs if name not in asked.outputs}
    for name, column in (asked.inputs | asked.outputs).items():
        stated = header.units.get(str(column))
        told = asked.units.get(name)
        if stated and told and told != stated:
            raise DataError(
                f"units=: {told!r} is asked for signal {name!r}, and the file itself says {stated!r}; "
                "leave the unit out for a file written by ftlm"
            )
        if stated and not told:
            asked.units[name] = stated
        if name in asked.inputs and str(column) in header.intersample:
            asked.intersample.setdefault(name, header.intersample[str(column)])


# --- columns of one or several files ----------------------------------------------------------------------------------


class _Pool:
    """The columns of all files under the names a person uses."""

    def __init__(self, tables: list[_Table]) -> None:
        self._tables = tables
        owners: dict[str, set[Path]] = {}
        for table in tables:
            for column in table.columns:
                owners.setdefault(column.variable, set()).add(table.path)
        self._columns: dict[str, _Column] = {}
        for table in tables:
            for column in table.columns:
                shared = len(owners[column.variable]) > 1
                prefix = f"{table.path.stem}/" if shared else ""
                name = prefix + column.name
                if name in self._columns and name:
                    raise DataError(
                        f"column {name!r} is in {str(self._columns[name].source)!r} and {str(table.path)!r}; "
                        "rename one of the files"
                    )
                matrix = None if column.matrix is None else prefix + column.matrix
                self._columns[name] = replace(column, name=name, matrix=matrix)

    @property
    def names(self) -> tuple[str, ...]:
        """What can be asked for by name."""
        return tuple(name for name in self._columns if name)

    def described(self) -> str:
        skipped = {name: why for table in self._tables for name, why in table.skipped.items()}
        text = f"the columns are {listed(self.names)}"
        if skipped:
            text += "; not read: " + ", ".join(f"{name!r} ({why})" for name, why in list(skipped.items())[:10])
        return text

    def find(self, spec: object, thing: str) -> _Column:
        """Return the column that a person names."""
        if isinstance(spec, int) and not isinstance(spec, bool):
            return self._at(spec, thing)
        if not isinstance(spec, str):
            raise DataError(f"column {spec!r} ({thing}) is neither a name nor a position; give one of them")
        name = spec
        written = _MATLAB_COLUMN.fullmatch(spec)
        if spec not in self._columns and written:
            name = f"{written[1]}.{int(written[2])}" if len(written[2]) < 10 else spec
        column = self._columns.get(name)
        if column is None:
            raise DataError(
                f"column {spec!r} ({thing}) is not in {listed(table.path.name for table in self._tables)}"
                f"{nearest(spec, self._columns)}; {self.described()}"
            )
        return column

    def _at(self, position: int, thing: str) -> _Column:
        if len(self._tables) > 1 or not self._tables[0].text:
            raise DataError(f"column {position} ({thing}): positions are for single text files; {self.described()}")
        columns = self._tables[0].columns
        if not 0 <= position < len(columns):
            raise DataError(
                f"column {position} ({thing}) is out of range, positions go from 0 to {len(columns) - 1}; "
                f"{self.described()}"
            )
        return columns[position]

    def time(self, spec: object, used: list[_Column]) -> _Column:
        """Return the time: the column asked for, or the one that names or places itself."""
        if spec is not None:
            return self.find(spec, "time")
        found = []
        for table in self._tables:
            named = [
                column
                for column in self._columns.values()
                if column.source == table.path and column.matrix is None and column.variable.casefold() in _TIME_NAMES
            ]
            if len(named) > 1:
                raise DataError(
                    f"{table.path.name}: the columns {listed(column.name for column in named)} may all be the time; "
                    "name one with time="
                )
            found += named
        if not found:
            matrices = dict.fromkeys(column.matrix for column in used if column.matrix is not None)
            found = [self._columns[f"{matrix}.1"] for matrix in matrices]
        if not found:
            raise DataError(
                "time: no column is called t, time, t_s, time_s, seconds or time [s]; "
                f"name it with time=, or give the time between rows with step=; {self.described()}"
            )
        for other in found[1:]:
            _check_agreement(found[0], other)
        return found[0]


def _check_agreement(one: _Column, other: _Column) -> None:
    a, b = one.numbers(), other.numbers()
    names = f"time: the columns {one.name!r} of {one.source.name} and {other.name!r} of {other.source.name}"
    if a.size != b.size:
        raise DataError(
            f"{names} have {a.size} and {b.size} rows; give files of one record, or name the time with time="
        )
    with np.errstate(invalid="ignore", over="ignore"):
        same = np.abs(np.subtract(a, b, dtype=np.float64)) <= _AGREE * max(1.0, float(np.abs(a[[0, -1]]).max()))
    rows = np.flatnonzero(~same & ~(np.isnan(a) & np.isnan(b)))
    if rows.size:
        raise bad_rows(
            names,
            f"differ, {float(a[rows[0]])!r} and {float(b[rows[0]])!r}",
            int(rows[0]),
            rows.size,
            "give files of one record, or name the time to use with time=",
        )


# --- text -------------------------------------------------------------------------------------------------------------


@dataclass
class _Trouble:
    """Cells of one column that are not numbers."""

    line: int
    row: int
    cell: str
    count: int

    def error(self, column: str, source: Path) -> DataError:
        thing = f"{source.name}: column {column!r}, line {self.line}"
        text = self.cell.strip()
        shown = repr(text if len(text) <= 40 else text[:40] + "…")
        if not text:
            what, way_out = "empty cell", "fill or remove these rows yourself"
        elif _DECIMAL_COMMA.fullmatch(text):
            what, way_out = f"{shown} has a decimal comma", _DECIMAL_WAY_OUT
        else:
            what, way_out = f"{shown} is not a number", "correct or remove these rows"
        return bad_rows(thing, what, self.row, self.count, way_out)


def _read_text(path: Path) -> _Table:
    try:
        with open(path, "rb") as stream:
            return _parse_text(path, stream)
    except OSError as error:
        raise DataError(f"{str(path)!r} cannot be read ({error.strerror}); check its permissions") from None


def _parse_text(path: Path, stream: BinaryIO) -> _Table:
    first = stream.readline(_LONGEST_HEADER)
    stream.seek(0)
    header = _ftlm_header(path, first)
    names: list[str] | None = None
    separator: str | None = None
    width = rows = ragged = 0
    ragged_line, ragged_width = 0, 0
    blocks: list[npt.NDArray[np.float64]] = []
    troubles: dict[int, _Trouble] = {}
    for number, lines in _line_blocks(path, stream):
        kept = [(index, line) for index, line in enumerate(lines, number) if line.strip() and line.lstrip()[0] != "#"]
        if not kept:
            continue
        started = width > 0
        if not started:
            separator = _separator([line for _, line in kept[:_SAMPLE_LINES]], path, kept[0][0])
        cells = _split([line for _, line in kept], separator, path, kept[0][0])
        if not started:
            width = len(cells[0])
            names = _names(cells[0], path, kept[0][0])
            if names is not None:
                kept, cells = kept[1:], cells[1:]
        wrong = [index for index, row in enumerate(cells) if len(row) != width]
        if wrong:
            if not ragged:
                ragged_line, ragged_width = kept[wrong[0]][0], len(cells[wrong[0]])
            ragged += len(wrong)
        if not ragged and cells:
            blocks.append(_numbers(cells, [index for index, _ in kept], rows, troubles))
        rows += len(cells)
    if width == 0:
        raise DataError(f"{path.name}: the file is empty, 0 rows; choose a file that holds a record")
    if ragged:
        raise DataError(
            f"{path.name}: line {ragged_line} has {ragged_width} cells where the first line has {width}, {ragged} "
            f"lines in all; give every line the same number of cells (separator: {_SEPARATOR_WORDS[separator]})"
        )
    if rows == 0:
        raise DataError(f"{path.name}: a header and no rows; choose a file that holds a record")
    values = np.concatenate(blocks).T.copy() if len(blocks) > 1 else blocks[0].T.copy()
    found = names if names is not None else [f"c{index + 1}" for index in range(width)]
    columns = [
        _Column(
            variable=name,
            name=name,
            source=path,
            values=values[index],
            problem=troubles[index].error(name, path) if index in troubles else None,
        )
        for index, name in enumerate(found)
    ]
    return _Table(path=path, columns=columns, text=True, header=header)


_SEPARATOR_WORDS: dict[str | None, str] = {";": "semicolon", "\t": "tab", ",": "comma", None: "white space"}


def _line_blocks(path: Path, stream: BinaryIO) -> Iterator[tuple[int, list[str]]]:
    """Yield the number of a first line and the lines from there, a few megabytes at a time."""
    carry, number, newline = b"", 1, b""
    while True:
        block = stream.read(_BLOCK)
        if not newline:
            if block.startswith(_UTF16):
                raise DataError(f"{path.name}: the text is UTF-16; save it as UTF-8")
            block = block.removeprefix(_BOM)
            newline = b"\r" if b"\r" in block and b"\n" not in block else b"\n"
        zero = block.find(b"\0")
        if zero >= 0:
            raise DataError(
                f"{path.name}: a zero byte near line {number + (carry + block[:zero]).count(newline)}, so it is not a "
                "text file or is damaged; pass a csv, text or .mat file"
            )
        data = carry + block
        cut = data.rfind(newline) + 1 if block else len(data)
        if cut == 0 and len(data) > _BLOCK:
            raise DataError(f"{path.name}: line {number} is longer than {_BLOCK} bytes; pass a csv or text file")
        if cut:
            try:
                text = data[:cut].decode("utf-8")
            except UnicodeDecodeError as error:
                raise DataError(
                    f"{path.name}: line {number + data[: error.start].count(newline)} is not UTF-8 text (byte "
                    f"{data[error.start]:#04x}); save it as UTF-8"
                ) from None
            lines = text.split(newline.decode())
            yield number, lines
            number += len(lines) - 1
        carry = data[cut:]
        if not block:
            return


def _separator(sample: list[str], path: Path, number: int) -> str | None:
    """Return what at least half of the first lines have: a semicolon, else a tab, else a comma, else None."""
    if 2 * sum(_DECIMAL_COMMAS.fullmatch(line) is not None for line in sample) >= len(sample):
        raise DataError(f"{path.name}: line {number} and others have decimal commas; {_DECIMAL_WAY_OUT}")
    for candidate in (";", "\t", ","):
        if 2 * sum(candidate in line.strip() for line in sample) >= len(sample):
            return candidate
    return None


def _split(lines: list[str], separator: str | None, path: Path, number: int) -> list[list[str]]:
    if separator is None:
        return [line.split() for line in lines]
    if not any('"' in line for line in lines):
        return [line.split(separator) for line in lines]
    try:
        rows = list(csv.reader(lines, delimiter=separator, strict=True))
    except csv.Error as error:
        raise DataError(f"{path.name}: quotes after line {number} cannot be read ({error}); correct them") from None
    if len(rows) != len(lines):
        raise DataError(f"{path.name}: a quoted cell after line {number} spans lines; correct the quotes")
    return rows


def _names(cells: list[str], path: Path, number: int) -> list[str] | None:
    """Return the names when this is a header, None when it is a row."""
    stripped = [cell.strip() for cell in cells]
    words = [cell for cell in stripped if cell and not _is_number(cell)]
    if not words:
        return None
    commas = [cell for cell in words if _DECIMAL_COMMA.fullmatch(cell)]
    if commas:
        raise DataError(f"{path.name}: line {number}: {commas[0]!r} has a decimal comma; {_DECIMAL_WAY_OUT}")
    if any(_is_number(cell) for cell in stripped):
        raise DataError(
            f"{path.name}: line {number} mixes words and numbers ({words[0][:40]!r} is not a number, {len(words)} in "
            "all), so it is neither a header nor a row; correct that cell, or give the columns names"
        )
    for index, name in enumerate(stripped):
        if name and name in stripped[:index]:
            raise DataError(
                f"{path.name}: line {number}: the column name {name!r} is there {stripped.count(name)} times; "
                "rename all but one"
            )
    return stripped


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _numbers(
    cells: list[list[str]], lines: list[int], rows_before: int, troubles: dict[int, _Trouble]
) -> npt.NDArray[np.float64]:
    width = len(cells[0])
    try:
        flat = np.fromiter(map(float, itertools.chain.from_iterable(cells)), dtype=np.float64, count=len(cells) * width)
    except ValueError:
        pass
    else:
        return flat.reshape(len(cells), width)
    values = np.zeros((len(cells), width))
    for index in range(width):
        column = [row[index] for row in cells]
        try:
            values[:, index] = list(map(float, column))
        except ValueError:
            bad = [row for row, cell in enumerate(column) if not _is_number(cell)]
            known = troubles.get(index)
            if known is None:
                troubles[index] = _Trouble(lines[bad[0]], rows_before + bad[0], column[bad[0]], len(bad))
            else:
                known.count += len(bad)
    return values


def _ftlm_header(path: Path, line: bytes) -> _Header | None:
    text = line.removeprefix(_BOM).decode("utf-8", errors="replace")
    if not text.startswith(_FTLM_MARK):
        return None
    return _header_of(path, "line 1", text.removeprefix(_FTLM_MARK))


def _header_of(path: Path, where: str, text: str) -> _Header:
    """Return what ``VERSION JSON`` says."""
    version, _, body = text.partition(" ")
    if version.strip() != "1":
        raise DataError(
            f"{path.name}: {where}: the format ftlm-run {version.strip()[:20]!r} is not known here; use a newer ftlm, "
            "or remove the line and name the columns"
        )
    try:
        told = json.loads(body)
        header = _Header(
            name=_field(told, "name", str),
            step=_field(told, "step", float),
            inputs=tuple(_field(told, "inputs", list)),
            outputs=tuple(_field(told, "outputs", list)),
            units=_field(told, "units", dict),
            intersample=_field(told, "intersample", dict),
            warnings=tuple(_field(told, "warnings", list)),
            about=_field({"about": {}} | told, "about", dict),
        )
        words = (
            header.inputs,
            header.outputs,
            header.warnings,
            header.units.values(),
            header.intersample.values(),
        )
        if not is_run_name(header.name) or not math.isfinite(header.step):
            raise ValueError("its name or step cannot be used")
        if not all(isinstance(word, str) for word in itertools.chain.from_iterable(words)):
            raise ValueError("a name, unit or warning is not text")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise DataError(
            f"{path.name}: {where} is a damaged ftlm header ({str(error)[:100]}); restore it, or remove the line and "
            "name the columns"
        ) from None
    return header


def _field(told: Mapping[str, object], key: str, kind: type[_Kind]) -> _Kind:
    value = told[key]
    if not isinstance(value, kind):
        raise ValueError(f"{key!r} is {str(value)[:40]!r}")
    return value


# --- MATLAB -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Apart:
    """A kind of file that is read in a process of its own."""

    suffixes: tuple[str, ...]
    package: str
    extra: str
    words: str
    again: str


_MATLAB = _Apart((".mat",), "scipy", "mat", ".mat", "save it again with save('FILE.mat', '-v7')")
_PARQUET = _Apart((".parquet", ".pq"), "pyarrow", "parquet", "parquet", "save it again")


def _read_apart(paths: list[Path], kind: _Apart) -> list[_Table]:
    folders = []
    for package in ("numpy", kind.package):
        found = importlib.util.find_spec(package)
        if found is None or not found.submodule_search_locations:
            raise DataError(
                f"{str(paths[0])!r}: reading {kind.words} files needs {package}; run: pip install 'ftlm[{kind.extra}]'"
            )
        folders.append(str(Path(next(iter(found.submodule_search_locations))).resolve().parent))
    reader = _READER if kind is _MATLAB else _PARQUET_READER
    command = [sys.executable, "-I", str(reader), json.dumps(folders), *(str(path.resolve()) for path in paths)]
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_READER_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired as stopped:
        answers = _Answers(stopped.stdout or b"")
        path = paths[min(answers.complete(len(paths)), len(paths) - 1)]
        raise DataError(
            f"{str(path)!r}: damaged file: the reader did not finish in {_READER_SECONDS:g} s; "
            f"get an intact copy or {kind.again}"
        ) from None
    except OSError as error:
        raise DataError(
            f"{str(paths[0])!r}: Python could not be started to read it ({error.strerror}); check the installation"
        ) from None
    answers = _Answers(done.stdout)
    tables = []
    for path in paths:
        table = answers.table(path)
        if table is None:
            raise _crash(path, done.returncode, kind)
        tables.append(table)
    return tables


def _crash(path: Path, code: int, kind: _Apart) -> DataError:
    how = "ended too early" if code == 0 else f"ended with code {code}"
    if code < 0:
        try:
            how = f"crashed (signal {-code}, {signal.Signals(-code).name})"
        except ValueError:
            how = f"crashed (signal {-code})"
    return DataError(f"{str(path)!r}: damaged file: the reader {how}; get an intact copy or {kind.again}")


class _Answers:
    """What the reader wrote, taken apart with care: it may have died at any byte."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0

    def complete(self, most: int) -> int:
        """Return how many files were answered for."""
        count = 0
        while count < most and self._next() is not None:
            count += 1
        return count

    def _next(self) -> tuple[dict[str, object], list[tuple[str, str, npt.NDArray[np.float64]]]] | None:
        end = self._content.find(b"\n", self._at)
        if end < 0:
            return None
        try:
            header = json.loads(self._content[self._at : end])
        except (ValueError, RecursionError):
            return None
        if not isinstance(header, dict):
            return None
        at = end + 1
        arrays = []
        try:
            for entry in header.get("arrays", []):
                rows, columns = int(entry["rows"]), int(entry["columns"])
                if rows < 0 or columns < 0:
                    return None
                flat = np.frombuffer(self._content, dtype="<f8", count=rows * columns, offset=at)
                matrix = flat.reshape((rows, columns), order="F").astype(np.float64, copy=False)
                arrays.append((str(entry["name"]), str(entry["type"]), matrix))
                at += 8 * rows * columns
        except (ValueError, KeyError, TypeError, OverflowError):
            return None
        if not isinstance(header.get("skipped", {}), dict) or ("error" in header and "way_out" not in header):
            return None
        self._at = at
        return header, arrays

    def table(self, path: Path) -> _Table | None:
        """Return the next file's columns, or None when the reader did not get that far."""
        found = self._next()
        if found is None:
            return None
        header, arrays = found
        if "error" in header:
            raise DataError(f"{str(path)!r}: {header['error']}; {header['way_out']}")
        skipped = cast("dict[str, str]", header.get("skipped", {}))
        columns: list[_Column] = []
        for name, kind, matrix in arrays:
            # The time of a single-precision file is exact to its own digits only, which the step must know.
            with np.errstate(over="ignore"):  # what overflows is no single; it is refused as infinite
                values = matrix.astype(np.float32) if kind == "single" else matrix
            if 1 in matrix.shape:
                columns.append(_Column(variable=name, name=name, source=path, values=values.ravel(order="F")))
                continue
            problem = None
            if matrix.shape[1] > matrix.shape[0]:
                problem = DataError(
                    f"{path.name}: the matrix {name!r} has {matrix.shape[0]} rows and {matrix.shape[1]} columns; "
                    f"samples belong in rows: transpose it in MATLAB ({name} = {name}.';) and save it again"
                )
            columns += [
                _Column(
                    variable=name,
                    name=f"{name}.{index + 1}",
                    source=path,
                    values=values[:, index],
                    problem=problem,
                    matrix=name,
                )
                for index in range(matrix.shape[1] if problem is None else 1)
            ]
        if not columns:
            why = ", ".join(f"{name!r} ({reason})" for name, reason in list(skipped.items())[:10]) or "it is empty"
            raise DataError(f"{str(path)!r} holds no real numeric matrix: {why}; save the samples as matrices")
        told = header.get("ftlm-run")
        own = _header_of(path, "its metadata", told) if isinstance(told, str) else None
        return _Table(path=path, columns=columns, text=header.get("text") is True, header=own, skipped=skipped)
