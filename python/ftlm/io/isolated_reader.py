"""Reading of binary files in a separate process: the code of the parent process.

See :mod:`ftlm.io.binary_reader` for the code of the child process.
"""

from __future__ import annotations

import importlib.util
import io
import json
import signal
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from ftlm.data.export import Header
from ftlm.data.sampling import masked_rows_error
from ftlm.errors import DataError
from ftlm.io.cell_parsing import Timestamps
from ftlm.io.delimited_text import parse_text
from ftlm.io.dialect import Assumption, Layout
from ftlm.io.table import Column, FileTable, dates_error
from ftlm.utils.formatting import plural
from ftlm.utils.parameters import Placeholder, layout_parameter
from ftlm.utils.resources import subprocess_arguments
from ftlm.utils.validation import Floats

_READER_PATH = Path(__file__).with_name("binary_reader.py")
_READER_TIMEOUT_S = 60.0
#: Remedy in an answer of the reader, to which the option that selects a sheet is added here.
_SHEET_CHOICE_HINT = "name the sheet"


@dataclass(frozen=True)
class BinaryFormat:
    """Binary file format that is read in a separate process.

    Parameters
    ----------
    kind
        Name of the format in :mod:`ftlm.io.binary_reader`.
    suffixes
        File name extensions.
    package, extra
        Python package that reads the format, and the extra of ftlm that installs it; "" if NumPy is sufficient.
    label, repair_hint
        Name of the format, and text on how to save such a file again, for error messages.
    has_sheets
        Whether the file consists of sheets. Their cells are parsed like delimited text.
    """

    kind: str
    suffixes: tuple[str, ...]
    package: str
    extra: str
    label: str
    repair_hint: str = "save it again"
    has_sheets: bool = False


_MATLAB_REPAIR_HINT = "save it again with save('FILE.mat', '-v7')"
MATLAB_FORMAT = BinaryFormat("mat", (".mat",), "scipy", "mat", ".mat", _MATLAB_REPAIR_HINT)
MATLAB_73_FORMAT = BinaryFormat("hdf5", (), "h5py", "hdf5", ".mat (version 7.3)", _MATLAB_REPAIR_HINT)
HDF5_FORMAT = BinaryFormat("hdf5", (".h5", ".hdf5", ".hdf", ".he5"), "h5py", "hdf5", "HDF5")
PARQUET_FORMAT = BinaryFormat("parquet", (".parquet", ".pq"), "pyarrow", "parquet", "parquet")
FEATHER_FORMAT = BinaryFormat("feather", (".feather", ".arrow"), "pyarrow", "parquet", "feather")
NUMPY_FORMAT = BinaryFormat("numpy", (".npz", ".npy"), "numpy", "", "NumPy")
_SPREADSHEET_SUFFIXES = (".xlsx", ".xlsm", ".xlsb", ".xls", ".ods")
SPREADSHEET_FORMAT = BinaryFormat("sheet", _SPREADSHEET_SUFFIXES, "python_calamine", "excel", "sheet", has_sheets=True)
BINARY_FORMATS = (MATLAB_FORMAT, HDF5_FORMAT, PARQUET_FORMAT, FEATHER_FORMAT, NUMPY_FORMAT, SPREADSHEET_FORMAT)
_HDF5_MARK = b"\x89HDF\r\n\x1a\n"


def binary_format_of(path: Path) -> BinaryFormat | None:
    """Return the binary format of a path by its extension, None for text; raise DataError for a gzipped binary file."""
    suffixes = [suffix.lower() for suffix in path.suffixes[-2:]]
    if suffixes and suffixes[-1] == ".gz":
        inner_format = next((kind for kind in BINARY_FORMATS if suffixes[0] in kind.suffixes), None)
        if inner_format is not None:
            raise DataError(
                f"{str(path)!r}: {inner_format.label} files cannot be read compressed; unpack it with gunzip"
            )
        return None
    match = next((kind for kind in BINARY_FORMATS if suffixes and suffixes[-1] in kind.suffixes), None)
    return MATLAB_73_FORMAT if match is MATLAB_FORMAT and _is_hdf5(path) else match


def _is_hdf5(path: Path) -> bool:
    """Whether a file begins as a MATLAB file of version 7.3, or as an HDF5 file."""
    try:
        with open(path, "rb") as stream:
            head = stream.read(520)
    except OSError:
        return False
    return head.startswith(b"MATLAB 7.3 MAT-file") or _HDF5_MARK in (head[:8], head[512:520])


def read_isolated(paths: list[Path], kind: BinaryFormat, layout: Layout) -> list[FileTable]:
    """Read files of one format in a separate process, and return their tables.

    Raise DataError if the package for the format is missing, a file cannot be read, or the process crashes or does not
    finish in 60 s. In the last two cases the error names the first file without a complete answer.
    """
    if importlib.util.find_spec(kind.package) is None:
        raise DataError(
            f"{str(paths[0])!r}: reading {kind.label} files needs {kind.package.replace('_', '-')}; run: pip install "
            f"'ftlm[{kind.extra}]'"
        )
    files = [str(path.resolve()) for path in paths]
    request = json.dumps({"sheet": layout.sheet})
    try:
        process = subprocess.run(
            **subprocess_arguments(_READER_PATH, kind.kind, request, *files),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_READER_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired as stopped:
        output = _ReaderOutput(stopped.stdout or b"")
        path = paths[min(output.count_complete(len(paths)), len(paths) - 1)]
        raise _damaged_file_error(path, f"did not finish in {_READER_TIMEOUT_S:g} s", kind) from None
    except OSError as error:
        raise DataError(
            f"{str(paths[0])!r}: Python could not be started to read it ({error.strerror}); check the installation"
        ) from None
    output = _ReaderOutput(process.stdout)
    tables = []
    for path in paths:
        table = output.table(path, layout)
        if table is None:
            raise _damaged_file_error(path, _describe_exit(process.returncode), kind)
        tables.append(table if table.kind else replace(table, kind=kind.label))
    return tables


def describe_crash(code: int) -> str:
    """Return text on the signal that ended a process; `code` is the negative number of the signal."""
    try:
        return f"signal {-code}, {signal.Signals(-code).name}"
    except ValueError:
        return f"signal {-code}"


def _describe_exit(code: int) -> str:
    """Return text on how the reader process ended; `code` is its return code."""
    if code >= 0:
        return "ended too early" if code == 0 else f"ended with code {code}"
    return f"crashed ({describe_crash(code)})"


def _damaged_file_error(path: Path, reason: str, kind: BinaryFormat) -> DataError:
    return DataError(f"{str(path)!r}: damaged file: the reader {reason}; get an intact copy or {kind.repair_hint}")


Size = Annotated[int, msgspec.Meta(ge=0)]


class _Array(msgspec.Struct):
    """Description of an array in the reader's output.

    `since` is the reference time of timestamps [ns since 1970]; None for numbers.
    """

    name: str
    rows: Size
    columns: Size
    type: str
    unit: str = ""
    since: int | None = None


class _ResultHeader(msgspec.Struct):
    """Header of the reader's answer for one file, before its numbers or cells; see :mod:`ftlm.io.binary_reader`."""

    arrays: list[_Array] = []
    skipped: dict[str, str] = {}
    text: bool = False
    run_header: str | None = msgspec.field(default=None, name="ftlm-run")
    sheet: str | None = None
    others: list[str] = []
    bytes: Size = 0
    error: str | None = None
    way_out: str = ""


HEADER_DECODER = msgspec.json.Decoder(_ResultHeader)


class _ReaderOutput:
    """Parser of the reader's output, which may be truncated at any byte."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0

    def count_complete(self, maximum: int) -> int:
        """Return the number of further files with a complete answer, at most `maximum`."""
        count = 0
        while count < maximum and self._next() is not None:
            count += 1
        return count

    def _next(self) -> tuple[_ResultHeader, list[Floats], bytes] | None:
        stop = self._content.find(b"\n", self._at)
        matrices = []
        try:
            header = HEADER_DECODER.decode(self._content[self._at : max(stop, self._at)])
            at = stop + 1
            for array in header.arrays:
                count = array.rows * array.columns
                flat = np.frombuffer(self._content, dtype="<f8", count=count, offset=at)
                matrices.append(flat.reshape((array.rows, array.columns), order="F").astype(np.float64, copy=False))
                at += 8 * count
        except (msgspec.MsgspecError, ValueError, OverflowError, RecursionError):
            return None
        self._at = at + header.bytes
        return (header, matrices, self._content[at : self._at]) if self._at <= len(self._content) else None

    def table(self, path: Path, layout: Layout) -> FileTable | None:
        """Return the table of the next file; None if its answer is missing or incomplete.

        Raise DataError if the answer is an error, or the file has no column of numbers.
        """
        result = self._next()
        if result is None:
            return None
        header, matrices, cells = result
        if header.error is not None:
            remedy = header.way_out
            if remedy == _SHEET_CHOICE_HINT:
                remedy += f" with {layout_parameter(sheet=Placeholder('NAME'))}"
            raise DataError(f"{str(path)!r}: {header.error}; {remedy}")
        if header.sheet is not None:
            return _sheet(path, header.sheet, header.others, cells, layout)
        arrays = zip(header.arrays, matrices, strict=True)
        columns = [column for array, matrix in arrays for column in _columns(path, array, matrix)]
        if not columns:
            skipped = list(header.skipped.items())[:10]
            skipped_text = ", ".join(f"{name!r} ({reason})" for name, reason in skipped) or "it is empty"
            raise DataError(
                f"{str(path)!r} contains no real numeric matrix: {skipped_text}; save the samples as matrices"
            )
        run_header = None if header.run_header is None else Header.read(path, "its metadata", header.run_header)
        return FileTable(path, columns, text=header.text, header=run_header, skipped=header.skipped)


def _sheet(path: Path, sheet: str, other_sheets: list[str], cells: bytes, layout: Layout) -> FileTable:
    """Return the table in the cells of a sheet, which the reader sends as tab-separated text.

    An assumption names the sheet if the user did not, and the workbook has other sheets, all of them empty.
    """
    table = parse_text(path, io.BytesIO(cells), layout, sheet)
    if layout.sheet is None and other_sheets:
        text = f"sheet {sheet!r}, the only one that is not empty"
        assumed = Assumption("sheet", sheet, text, layout_parameter(sheet=Placeholder("NAME")))
        table = replace(table, assumptions=(assumed, *table.assumptions))
    return table


def _columns(path: Path, array: _Array, matrix: Floats) -> list[Column]:
    """Return the columns of an array: a vector keeps its name, and column k of a matrix V is named V.k."""
    name = array.name
    # Single precision is kept, because the step detection needs the actual resolution of the times.
    with np.errstate(over="ignore"):  # overflow gives infinity, which raises an error later
        values = matrix.astype(np.float32) if array.type == "single" else matrix
    if array.since is not None:
        return [_timestamp_column(path, array.name, array.since, matrix)]
    if 1 in matrix.shape:
        return [Column(name, name, path, values.ravel(order="F"), file_unit=array.unit)]
    rows, count = matrix.shape
    if count > rows:
        problem = DataError(
            f"{path.name}: the matrix {name!r} has {plural(rows, 'row')} and {plural(count, 'column')}; "
            f"samples belong in rows: transpose it in MATLAB ({name} = {name}.';) and save it again"
        )
        return [Column(name, f"{name}.1", path, values[:, 0], problem, name)]
    return [Column(name, f"{name}.{k + 1}", path, values[:, k], matrix=name) for k in range(count)]


def _timestamp_column(path: Path, name: str, since: int, matrix: Floats) -> Column:
    """Return the column of an array of timestamps [ns], counted from the time `since` [ns since 1970]."""
    values = matrix.ravel(order="F")
    label, is_missing = f"{path.name}: column {name!r}", np.isnan(values)
    if is_missing.any():
        problem = masked_rows_error(label, "no date", is_missing, "remove or fill these rows yourself")
        return Column(name, name, path, None, problem)
    first_text = str(np.datetime64(since, "ns")) if abs(since) < 1 << 63 else "a date"
    timestamps = Timestamps(
        np.zeros((values.size, 3), np.int64), "", np.clip(values, -9e18, 9e18).astype(np.int64), first_text
    )
    problem = dates_error(label, f"dates, not numbers ({first_text})", values.size)
    return Column(name, name, path, values, problem, timestamps=timestamps)
