"""Reads arrays and sheets from binary files in a process of its own: a damaged file can crash the libraries.

Run by path, never imported by the parent: ``python -I reader.py KIND OPTIONS FILE…`` with KIND mat, hdf5, parquet,
feather, numpy or sheet, and OPTIONS a JSON object: the folders that hold the packages, the sheet that is asked for. For
every file it writes to standard output one line of JSON and then the numbers:

``{"arrays": [{"name": …, "rows": …, "columns": …, "type": …}], "skipped": {name: why}}`` followed by the arrays, each
little-endian float64, column after column; or ``{"error": why, "way_out": what to do}`` and the end. An array may
state its ``"unit"``; one of moments says ``"since"``, whole nanoseconds since 1970 from which its own nanoseconds
count. Of columns, not matrices, it says ``"text": true``, and for a run that ftlm wrote ``"ftlm-run"``: its own header.
Of a sheet it says ``"sheet"``, its name, ``"others"``, which are empty, and ``"bytes"``: so many of UTF-8 text follow,
a line a row, cells between tabs.
"""

from __future__ import annotations

import csv
import datetime
import hashlib
import importlib
import io
import json
import math
import os
import sys
import warnings
import zipfile
from typing import Any, BinaryIO

MEMORY_LIMIT = 4 << 30
SECONDS_LIMIT = 60
SIZE_LIMIT = 1 << 30
MOST_ARRAYS = 10_000
MOST_DEPTH = 8
WHICH = "say which with layout=dict(sheet=NAME)"
SAVE_AGAIN = "save it again with save('FILE.mat', '-v7')"
NUMERIC = frozenset(
    ("double", "single", "logical", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64")
)


class UnreadableError(Exception):
    """A file that is refused: why, and what to do about it; nothing where it is damaged."""

    def __init__(self, why: str, way_out: str = "") -> None:
        super().__init__(why)
        self.way_out = way_out


def limit_resources() -> None:
    """Bound this process's memory and time where the system can."""
    try:
        resource: Any = importlib.import_module("resource")
    except ImportError:
        return
    for kind, most in (
        (resource.RLIMIT_AS, MEMORY_LIMIT),
        (resource.RLIMIT_CPU, SECONDS_LIMIT),
        (resource.RLIMIT_CORE, 0),
    ):
        _, hard = resource.getrlimit(kind)
        allowed = most if hard == resource.RLIM_INFINITY else min(most, hard)
        try:
            resource.setrlimit(kind, (allowed, hard))
        except (OSError, ValueError):
            continue


def check_version(path: str) -> None:
    """Raise unless the first bytes are those of a file of version 4 or 5."""
    with open(path, "rb") as stream:
        head = stream.read(520)
    # Version 4 begins with the type of its first matrix, a number below 5000: zeros among four bytes, as in no text.
    if len(head) >= 20 and 0 in head[:4] and (head[:2] == b"\0\0" or head[2:4] == b"\0\0"):
        return
    if len(head) < 128 or head[126:128] not in (b"IM", b"MI"):
        raise UnreadableError("it is not a .mat file of version 4, 5 or 7.3", SAVE_AGAIN)
    major = head[125] if head[126:128] == b"IM" else head[124]
    if major != 1:
        raise UnreadableError(f"it is not a .mat file of version 4, 5 or 7.3 (its version code is {major})", SAVE_AGAIN)


def read_matlab(path: str, budget: int) -> tuple[dict[str, Any], list[Any]]:
    """Return the header of a .mat file and its matrices, of at most `budget` bytes as float64."""
    numpy: Any = importlib.import_module("numpy")
    matlab: Any = importlib.import_module("scipy.io")
    # SciPy says with warnings that it left something out; nothing may be left out in silence.
    warnings.simplefilter("ignore")
    warnings.simplefilter("error", UserWarning)
    warnings.simplefilter("error", RuntimeWarning)
    check_version(path)
    skipped: dict[str, str] = {}
    wanted: dict[str, str] = {}
    size = 0
    seen: set[str] = set()
    for name, shape, kind in matlab.whosmat(path):
        if name in seen:
            raise UnreadableError(f"the variable {name!r} is in it twice")
        seen.add(name)
        count = math.prod(map(int, shape))
        if kind not in NUMERIC:
            skipped[name] = str(kind)
        elif len(shape) != 2:
            skipped[name] = f"{len(shape)} dimensions"
        elif count <= 0:
            skipped[name] = "empty"
        else:
            wanted[name] = kind
            size += 8 * count
    if size > budget:
        raise UnreadableError(
            f"with it the arrays take more than {SIZE_LIMIT} bytes (it declares {size})", "save a part of it"
        )
    if len(seen) > MOST_ARRAYS:
        raise UnreadableError(f"it holds {len(seen)} variables, more than {MOST_ARRAYS}", "save a part of it")
    # With mat_dtype=True SciPy drops imaginary parts; the stored type loses nothing.
    loaded = matlab.loadmat(path, mat_dtype=False, variable_names=list(wanted)) if wanted else {}
    header: dict[str, Any] = {"arrays": [], "skipped": skipped}
    arrays = []
    for name, kind in wanted.items():
        values = loaded.get(name)
        if not isinstance(values, numpy.ndarray) or values.ndim != 2 or values.dtype.kind not in "biufc":
            raise UnreadableError(f"the variable {name!r} is not what the file's own list says")
        if values.dtype.kind == "c":
            skipped[name] = "complex"
            continue
        header["arrays"].append({"name": name, "rows": values.shape[0], "columns": values.shape[1], "type": kind})
        arrays.append(values)
    return header, arrays


def check_size(rows: int, columns: int) -> None:
    """Refuse a table that declares too much."""
    if columns > MOST_ARRAYS or 8 * rows * columns > SIZE_LIMIT:
        raise UnreadableError(
            f"it declares {rows} rows of {columns} columns, more than {SIZE_LIMIT} bytes or {MOST_ARRAYS} columns",
            "save a part of it",
        )


def moments_of(nanoseconds: Any, gone: Any) -> tuple[dict[str, Any], Any]:
    """What is said of a column of moments, and nanoseconds since the first of them that is there."""
    numpy: Any = importlib.import_module("numpy")
    there = numpy.flatnonzero(~gone)
    since = int(nanoseconds[there[0]]) if there.size else 0
    values = (nanoseconds - since).astype(numpy.float64)
    values[gone] = numpy.nan
    return {"type": "moments", "since": str(since)}, values


def read_feather(path: str, budget: int) -> tuple[dict[str, Any], list[Any]]:
    """Return the header of a feather file (version 2, Arrow's own format) and its columns."""
    arrow: Any = importlib.import_module("pyarrow")
    ipc: Any = importlib.import_module("pyarrow.ipc")
    with open(path, "rb") as stream:
        if stream.read(4) == b"FEA1":
            raise UnreadableError("it is a feather file of version 1", "save it again in version 2")
    file = ipc.open_file(arrow.OSFile(path))
    batches, rows, columns = [], 0, len(file.schema.names)
    check_size(0, columns)
    for index in range(file.num_record_batches):
        batches.append(file.get_batch(index))
        rows += batches[-1].num_rows
        if 8 * rows * columns > budget:
            check_size(rows, columns)
    return arrow_columns(arrow.Table.from_batches(batches, file.schema))


def read_parquet(path: str, budget: int) -> tuple[dict[str, Any], list[Any]]:
    """Return the header of a parquet file and its columns."""
    parquet: Any = importlib.import_module("pyarrow.parquet")
    file = parquet.ParquetFile(path, page_checksum_verification=True)
    check_size(file.metadata.num_rows, file.metadata.num_columns)
    return arrow_columns(file.read(use_threads=False))


def arrow_columns(table: Any) -> tuple[dict[str, Any], list[Any]]:
    """Return the header and the columns of a table of Arrow's."""
    numpy: Any = importlib.import_module("numpy")
    types: Any = importlib.import_module("pyarrow.types")
    compute: Any = importlib.import_module("pyarrow.compute")
    header: dict[str, Any] = {"arrays": [], "skipped": {}, "text": True}
    told = (table.schema.metadata or {}).get(b"ftlm-run")
    if told is not None:
        header["ftlm-run"] = told.decode("utf-8", errors="replace")
    arrays = []
    made = hashlib.sha256(told or b"")
    for name, column in zip(table.column_names, table.columns, strict=True):
        kind = column.type
        if types.is_timestamp(kind) or types.is_date(kind):
            whole = compute.cast(compute.cast(column, "timestamp[ns]"), "int64").combine_chunks()
            gone = numpy.asarray(whole.is_null())
            said, values = moments_of(whole.fill_null(0).to_numpy(zero_copy_only=False), gone)
            header["arrays"].append({"name": name, "rows": len(values), "columns": 1, **said})
            arrays.append(values)
            continue
        if not (types.is_floating(kind) or types.is_integer(kind) or types.is_boolean(kind)):
            header["skipped"][name] = str(kind)
            continue
        values = compute.cast(column, "float64").combine_chunks().to_numpy(zero_copy_only=False)
        single = "single" if types.is_float32(kind) else "double"
        header["arrays"].append({"name": name, "rows": len(values), "columns": 1, "type": single})
        arrays.append(numpy.asarray(values, dtype=numpy.float64))
        made.update(f"\0{name}\0{len(values)}\0".encode())
        made.update(numpy.ascontiguousarray(arrays[-1], dtype="<f8").tobytes())
    # Runs of ftlm say how many rows they have, and what all of them come to.
    check = (table.schema.metadata or {}).get(b"ftlm-check")
    if check is not None and check != f"{table.num_rows} {made.hexdigest()}".encode():
        said = check.split(b" ")[0].decode("utf-8", errors="replace")[:20]
        raise UnreadableError(
            f"the file is damaged: {table.num_rows} rows were read where it says {said}, or their checksum is another"
        )
    return header, arrays


class Arrays:
    """Arrays as they are gathered, within the bytes that are left."""

    def __init__(self, budget: int) -> None:
        self.header: dict[str, Any] = {"arrays": [], "skipped": {}}
        self.values: list[Any] = []
        self.left = budget

    def fits(self, name: str, shape: tuple[int, ...], kind: Any) -> bool:
        """Whether an array of that shape and type is to be read; what is not a table of numbers is skipped."""
        why = None
        if kind.hasobject:
            why = "pickled objects, which are not read"
        elif kind.names is None and kind.kind not in "biufM":
            why = "complex" if kind.kind == "c" else "no numbers"
        elif not 1 <= len(shape) <= 2:
            why = "a single value" if not shape else f"{len(shape)} dimensions"
        elif 0 in shape:
            why = "empty"
        if why is not None:
            self.header["skipped"][name] = why
            return False
        size = 8 * math.prod(shape) * len(kind.names or " ")
        if size > self.left:
            raise UnreadableError(f"with {name!r} the arrays take more than {SIZE_LIMIT} bytes", "save a part of it")
        if len(self.values) + len(kind.names or " ") > MOST_ARRAYS:
            raise UnreadableError(f"it holds more than {MOST_ARRAYS} arrays", "save a part of it")
        self.left -= size
        return True

    def add(self, name: str, values: Any, unit: str = "") -> None:
        """Take an array; the fields of a structured one are columns of their own."""
        numpy: Any = importlib.import_module("numpy")
        if values.dtype.names:
            for field in values.dtype.names:
                column = values[field]
                whole = f"{name}.{field}" if name else field
                if column.ndim == 1 and column.dtype.kind in "biufM":
                    self.add(whole, column)
                else:
                    self.header["skipped"][whole] = "no column of numbers"
            return
        matrix = values.reshape(-1, 1) if values.ndim == 1 else values
        said: dict[str, Any] = {"type": "single" if values.dtype == numpy.float32 else "double"}
        if values.dtype.kind == "M":
            if matrix.shape[1] > 1:
                self.header["skipped"][name] = "a matrix of dates"
                return
            flat = values.ravel().astype("datetime64[ns]")
            said, matrix = moments_of(flat.astype(numpy.int64), numpy.isnat(flat))
            matrix = matrix.reshape(-1, 1)
        if unit:
            said["unit"] = unit[:40]
        self.header["arrays"].append({"name": name, "rows": matrix.shape[0], "columns": matrix.shape[1], **said})
        self.values.append(matrix)


def read_numpy(path: str, budget: int) -> tuple[dict[str, Any], list[Any]]:
    """Return the arrays of a file that NumPy wrote; nothing in it is unpickled."""
    found = Arrays(budget)
    if path.lower().endswith(".npy"):
        with open(path, "rb") as stream:
            values = numpy_array(stream, "the array", found)
        if values is None:
            return found.header, []
        found.header["text"] = True
        if values.dtype.names is not None or values.ndim == 1:
            found.add("" if values.dtype.names else "c1", values)
        else:
            check_size(0, values.shape[1])
            for k in range(values.shape[1]):
                found.add(f"c{k + 1}", values[:, k])
        return found.header, found.values
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            name = entry.filename.removesuffix(".npy")
            with archive.open(entry) as stream:
                values = numpy_array(stream, name, found)
            if values is not None:
                found.add(name, values)
    return found.header, found.values


def numpy_array(stream: Any, name: str, found: Arrays) -> Any:
    """One array, or None where it is none to be read; its size is known before its numbers are."""
    form: Any = importlib.import_module("numpy.lib.format")
    version = form.read_magic(stream)
    read_header = {(1, 0): form.read_array_header_1_0, (2, 0): form.read_array_header_2_0}.get(version)
    if read_header is None:
        raise UnreadableError(f"{name!r} is of a format of NumPy's that is not known here ({version})", "save it again")
    shape, order, kind = read_header(stream)
    if not found.fits(name, shape, kind):
        return None
    numpy: Any = importlib.import_module("numpy")
    size = math.prod(shape) * kind.itemsize
    content = stream.read(size)
    if len(content) != size:
        raise UnreadableError(f"{name!r} ends after {len(content)} of {size} bytes")
    return numpy.frombuffer(content, kind).reshape(shape, order="F" if order else "C")


def read_hdf5(path: str, budget: int) -> tuple[dict[str, Any], list[Any]]:
    """Return the matrices of an HDF5 file, of MATLAB or others; nothing outside of it is followed."""
    hdf5: Any = importlib.import_module("h5py")
    found = Arrays(budget)
    with hdf5.File(path, "r") as file:
        _gather(hdf5, file, "", found, 0)
    return found.header, found.values


def _gather(hdf5: Any, group: Any, prefix: str, found: Arrays, depth: int) -> None:
    """Take what a group holds."""
    for key in group:
        name, link = f"{prefix}{key}", group.get(key, getlink=True)
        if not isinstance(link, hdf5.HardLink):
            found.header["skipped"][name] = "a link"
            continue
        item = group[key]
        matlab = item.attrs.get("MATLAB_class")
        kind = matlab.decode(errors="replace") if isinstance(matlab, bytes) else "" if matlab is None else str(matlab)
        if len(found.header["skipped"]) > MOST_ARRAYS:
            raise UnreadableError(f"it holds more than {MOST_ARRAYS} things that are no arrays", "save a part of it")
        if isinstance(item, hdf5.Group):
            if kind or key.startswith("#") or depth >= MOST_DEPTH:
                found.header["skipped"][name] = kind or "of MATLAB's own"
            else:
                _gather(hdf5, item, f"{name}/", found, depth + 1)
        elif not isinstance(item, hdf5.Dataset) or (kind and kind not in NUMERIC):
            found.header["skipped"][name] = kind or "no array"
        elif not has_numbers(item):
            found.header["skipped"][name] = "no numbers"
        elif item.is_virtual or item.external:
            found.header["skipped"][name] = "its numbers lie in other files"
        elif "MATLAB_empty" in item.attrs:
            found.header["skipped"][name] = "empty"
        elif found.fits(name, item.shape or (), item.dtype):
            values = item[()]
            unit = item.attrs.get("units", item.attrs.get("unit", ""))
            unit = unit.decode(errors="replace") if isinstance(unit, bytes) else unit if isinstance(unit, str) else ""
            # MATLAB counts along columns, so that what it writes is turned.
            found.add(name, values.T if kind and values.ndim == 2 else values, unit)


def has_numbers(item: Any) -> bool:
    """Whether NumPy knows the type of an array of HDF5, and it is none of objects."""
    try:
        return not item.dtype.hasobject
    except (TypeError, ValueError):
        return False


def read_sheet(path: str, sheet: str | None) -> tuple[dict[str, Any], bytes]:
    """Return the header of a workbook's sheet and its cells as text."""
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > SIZE_LIMIT:
            raise UnreadableError(f"unpacked, it has {size} bytes, more than {SIZE_LIMIT}", "save a part of it")
        # What reads the sheet does not come to the checksum of each part, which stands behind it.
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
        if damaged is not None:
            raise UnreadableError(f"the checksum of {damaged!r} in it is another")
    calamine: Any = importlib.import_module("python_calamine")
    book = calamine.CalamineWorkbook.from_path(path)
    names = list(book.sheet_names)
    if sheet is not None and sheet not in names:
        raise UnreadableError(f"it has no sheet {sheet!r}; its sheets are {', '.join(map(repr, names[:20]))}", WHICH)
    filled = {}
    for name in names if sheet is None else [sheet]:
        try:
            found = book.get_sheet_by_name(name)
        except calamine.WorksheetNotFound:
            continue
        if found.end is not None:
            check_size(found.end[0] + 1, found.end[1] + 1)
            filled[name] = found
    if not filled:
        raise UnreadableError(
            f"{'its sheets are' if len(names) > 1 else 'its sheet is'} empty", "choose a file that holds a record"
        )
    if len(filled) > 1:
        raise UnreadableError(
            f"it has {len(filled)} sheets that are not empty: {', '.join(map(repr, list(filled)[:20]))}", WHICH
        )
    ((name, found),) = filled.items()
    out = io.StringIO(newline="")
    writer = csv.writer(out, delimiter="\t", lineterminator="\n")
    table = found.to_python(skip_empty_area=False)
    while table and not any(map(cell_text, table[-1])):
        table.pop()
    for row in table:
        writer.writerow([cell_text(cell) for cell in row])
    content = out.getvalue().encode("utf-8", errors="replace")
    return {"sheet": name, "others": [n for n in names if n != name], "bytes": len(content)}, content


def cell_text(cell: Any) -> str:
    """What a cell of a sheet holds, as text: numbers to their last digit."""
    if isinstance(cell, bool):
        return str(cell)
    if isinstance(cell, int | float):
        return repr(cell)
    if isinstance(cell, datetime.timedelta):
        # A time that passed has its unit in itself, which a number would take from the header.
        seconds, rest = divmod(abs(cell) // datetime.timedelta(microseconds=1), 1_000_000)
        return f"{'-' if cell < datetime.timedelta() else ''}PT{seconds}.{rest:06}S"
    if isinstance(cell, datetime.datetime):
        return cell.isoformat(sep=" ")
    if isinstance(cell, datetime.date | datetime.time):
        return cell.isoformat()
    return " ".join(str(cell).replace("\0", " ").split())


READERS = {"mat": read_matlab, "hdf5": read_hdf5, "parquet": read_parquet, "feather": read_feather, "numpy": read_numpy}


def answer(kind: str, path: str, out: BinaryIO, budget: int, sheet: str | None) -> int:
    """Write what one file holds, or why it cannot be read; return the number of bytes of its arrays."""
    matlab = path.lower().endswith(".mat")
    damaged = f"the file is damaged; get an intact copy or {SAVE_AGAIN if matlab else 'save it again'}"
    cells, payload = b"", []
    try:
        if kind == "sheet":
            header, cells = read_sheet(path, sheet)
        else:
            header, arrays = READERS[kind](path, budget)
            payload = [values.astype("<f8", copy=False).ravel(order="F") for values in arrays]
    except UnreadableError as error:
        header, payload = {"error": str(error), "way_out": error.way_out or damaged}, []
    except MemoryError:
        header, payload = {"error": "reading it takes too much memory", "way_out": damaged}, []
    except Exception as error:
        # The libraries raise errors of any kind on a damaged file.
        header, payload = {"error": f"{type(error).__name__}: {error}"[:300], "way_out": damaged}, []
    out.write(json.dumps(header).encode() + b"\n")
    for values in payload:
        out.write(values.data)
    out.write(cells)
    out.flush()
    return int(sum(values.nbytes for values in payload)) + len(cells)


def main(arguments: list[str]) -> None:
    """Answer for every file in turn."""
    # One thread: every further one would reserve memory that counts against the limit, as pools of memory do.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    os.environ["ARROW_DEFAULT_MEMORY_POOL"] = "system"
    limit_resources()
    kind, told, *paths = arguments
    options = json.loads(told)
    sys.path.extend(folder for folder in options["folders"] if folder not in sys.path)
    budget = SIZE_LIMIT
    for path in paths:
        budget -= answer(kind, path, sys.stdout.buffer, budget, options["sheet"])


if __name__ == "__main__":
    main(sys.argv[1:])
