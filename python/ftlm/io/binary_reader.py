"""Reader of binary data files that runs in a separate process, because a damaged file can crash the libraries.

The file is run by its path with the arguments KIND OPTIONS FILE…, by `ftlm.utils.resources.subprocess_arguments`; the
parent process never imports it. KIND is mat, hdf5, parquet, feather, numpy or sheet, and OPTIONS is a JSON object with
the requested sheet. For every file the reader writes an answer to standard output: one line of JSON, the header, then
the numbers.

The header is ``{"arrays": [{"name": …, "rows": …, "columns": …, "type": …}], "skipped": {name: why}}``, and the arrays
follow as little-endian float64, column after column. For an unreadable file, the answer is only ``{"error": reason,
"way_out": remedy}``. An array may have a ``"unit"``. An array of timestamps has values in nanoseconds after a reference
time. This time is stored under ``"since"`` in integer nanoseconds since 1970. A file with columns instead of matrices
has ``"text": true``. The run header that ftlm wrote to a file is under ``"ftlm-run"``. A sheet has its name under
``"sheet"`` and the names of all other sheets under ``"others"``. Its ``"bytes"`` is the number of bytes of UTF-8 text
that follow: one line per row, tabs between cells.
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
MAX_ARRAYS = 10_000
MAX_GROUP_DEPTH = 8
#: Remedy to which the parent process adds the option that selects a sheet.
SHEET_CHOICE_HINT = "name the sheet"
SAVE_AGAIN = "save it again with save('FILE.mat', '-v7')"
NUMERIC_MATLAB_CLASSES = frozenset(
    ("double", "single", "logical", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64")
)


class UnreadableError(Exception):
    """Error for a file that cannot be read, with the reason as message and a remedy `way_out`, "" if there is none."""

    def __init__(self, reason: str, way_out: str = "") -> None:
        super().__init__(reason)
        self.way_out = way_out


def limit_resources(memory: int, seconds: int | None = None) -> None:
    """Limit memory [bytes] and CPU time [s] of this process, and disable core files, if the system supports it."""
    try:
        resource: Any = importlib.import_module("resource")
    except ImportError:
        return
    limits = {resource.RLIMIT_AS: memory, resource.RLIMIT_CORE: 0}
    if seconds is not None:
        limits[resource.RLIMIT_CPU] = seconds
    for kind, maximum in limits.items():
        _, hard_limit = resource.getrlimit(kind)
        limit = maximum if hard_limit == resource.RLIM_INFINITY else min(maximum, hard_limit)
        try:
            resource.setrlimit(kind, (limit, hard_limit))
        except (OSError, ValueError):
            continue


def check_version(path: str) -> None:
    """Raise UnreadableError unless the first bytes identify a MATLAB file of version 4 or 5."""
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
    """Return the header of a .mat file and its numeric matrices.

    Raise UnreadableError if the matrices take more than `budget` bytes as float64.
    """
    numpy: Any = importlib.import_module("numpy")
    matlab: Any = importlib.import_module("scipy.io")
    # SciPy only warns when it skips data; turn such warnings into errors.
    warnings.simplefilter("ignore")
    warnings.simplefilter("error", UserWarning)
    warnings.simplefilter("error", RuntimeWarning)
    check_version(path)
    skipped: dict[str, str] = {}
    kinds: dict[str, str] = {}
    size = 0
    names: set[str] = set()
    structs: list[str] = []
    for name, shape, kind in list_variables(matlab, path):
        if name in names:
            raise UnreadableError(f"the variable {name!r} occurs twice")
        names.add(name)
        count = math.prod(map(int, shape))
        if kind == "struct" and count == 1:
            structs.append(name)
        elif kind not in NUMERIC_MATLAB_CLASSES:
            skipped[name] = str(kind)
        elif len(shape) != 2:
            skipped[name] = f"{len(shape)} dimensions"
        elif count <= 0:
            skipped[name] = "empty"
        else:
            kinds[name] = kind
            size += 8 * count
    if size > budget:
        raise UnreadableError(
            f"with it the arrays take more than {SIZE_LIMIT} bytes (it declares {size})", "save a part of it"
        )
    if len(names) > MAX_ARRAYS:
        raise UnreadableError(f"it contains {len(names)} variables, more than {MAX_ARRAYS}", "save a part of it")
    # With mat_dtype=True, SciPy drops imaginary parts; the stored types keep them.
    names_to_read = [*kinds, *structs]
    loaded = matlab.loadmat(path, mat_dtype=False, variable_names=names_to_read) if names_to_read else {}
    for name in structs:
        for field, values in struct_fields(loaded.pop(name)):
            # Fields of the only struct keep their own names, as `t` of `data.t`.
            full_name = field if len(structs) == 1 and field not in names else f"{name}.{field}"
            is_table = isinstance(values, numpy.ndarray) and values.ndim == 2 and values.dtype.kind in "biuf"
            if not is_table or values.size == 0 or full_name in loaded:
                skipped[full_name] = "no column of numbers"
                continue
            size += 8 * values.size
            kinds[full_name] = "single" if values.dtype == numpy.float32 else "double"
            loaded[full_name] = values
    if size > budget or len(kinds) > MAX_ARRAYS:
        raise UnreadableError(
            f"with its structs the arrays take more than {SIZE_LIMIT} bytes or {MAX_ARRAYS} columns",
            "save a part of it",
        )
    header: dict[str, Any] = {"arrays": [], "skipped": skipped}
    arrays = []
    for name, kind in kinds.items():
        values = loaded.get(name)
        if not isinstance(values, numpy.ndarray) or values.ndim != 2 or values.dtype.kind not in "biufc":
            raise UnreadableError(f"the variable {name!r} differs from the list of variables in the file")
        if values.dtype.kind == "c":
            skipped[name] = "complex"
            continue
        header["arrays"].append({"name": name, "rows": values.shape[0], "columns": values.shape[1], "type": kind})
        arrays.append(values)
    return header, arrays


def struct_fields(struct: Any) -> list[tuple[str, Any]]:
    """Return (name, array) of every field of a struct; [] if the value is not a single struct."""
    if getattr(struct, "size", 0) != 1 or struct.dtype.names is None:
        return []
    return [(field, struct[field].ravel()[0]) for field in struct.dtype.names]


def list_variables(matlab: Any, path: str) -> list[tuple[str, tuple[int, ...], str]]:
    """Return (name, shape, class) of every variable of a .mat file.

    SciPy cannot list a file that contains an object, such as a datetime or a table, but it can load the file. The file
    is then loaded under the memory limit of this process, and the object is listed as "object".
    """
    try:
        return list(matlab.whosmat(path))
    except TypeError:
        loaded = matlab.loadmat(path, mat_dtype=False)
        kinds = {"float64": "double", "float32": "single"}
        return [
            (
                name,
                value.shape,
                kinds.get(value.dtype.name, value.dtype.name) if value.dtype.names is None else "object",
            )
            for name, value in loaded.items()
            if not name.startswith("__")
        ]


def check_size(rows: int, columns: int) -> None:
    """Raise UnreadableError if a table declares more than `MAX_ARRAYS` columns, or `SIZE_LIMIT` bytes of float64."""
    if columns > MAX_ARRAYS or 8 * rows * columns > SIZE_LIMIT:
        raise UnreadableError(
            f"it declares {rows} rows of {columns} columns, more than {SIZE_LIMIT} bytes or {MAX_ARRAYS} columns",
            "save a part of it",
        )


def read_feather(path: str, budget: int) -> tuple[dict[str, Any], list[Any]]:
    """Return the header of a feather file (version 2, Arrow's IPC format) and its columns.

    Raise UnreadableError for version 1 and for columns above the size limit.
    """
    arrow: Any = importlib.import_module("pyarrow")
    ipc: Any = importlib.import_module("pyarrow.ipc")
    with open(path, "rb") as stream:
        if stream.read(4) == b"FEA1":
            raise UnreadableError("it is a feather file of version 1", "save it again as feather version 2 (Arrow IPC)")
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
    """Return the header of a parquet file and its columns; raise UnreadableError if they exceed the size limit."""
    parquet: Any = importlib.import_module("pyarrow.parquet")
    file = parquet.ParquetFile(path, page_checksum_verification=True)
    check_size(file.metadata.num_rows, file.metadata.num_columns)
    return arrow_columns(file.read(use_threads=False))


def arrow_columns(table: Any) -> tuple[dict[str, Any], list[Any]]:
    """Return the header and the numeric and date columns of an Arrow table; other columns are listed as skipped.

    Raise UnreadableError if row count or digest of a run written by ftlm is wrong.
    """
    numpy: Any = importlib.import_module("numpy")
    types: Any = importlib.import_module("pyarrow.types")
    compute: Any = importlib.import_module("pyarrow.compute")
    arrays = Arrays()
    arrays.header["text"] = True
    metadata = (table.schema.metadata or {}).get(b"ftlm-run")
    if metadata is not None:
        arrays.header["ftlm-run"] = metadata.decode("utf-8", errors="replace")
    units = _arrow_units(table.schema)
    digest = hashlib.sha256(metadata or b"")
    for name, column in zip(table.column_names, table.columns, strict=True):
        kind = column.type
        if types.is_timestamp(kind) or types.is_date(kind):
            arrays.add(name, compute.cast(column, "timestamp[ns]").to_numpy())
        elif types.is_floating(kind) or types.is_integer(kind) or types.is_boolean(kind):
            float_type = "float32" if types.is_float32(kind) else "float64"
            values = compute.cast(column, float_type).combine_chunks().to_numpy(zero_copy_only=False)
            arrays.add(name, values, units.get(name, ""))
            digest.update(f"\0{name}\0{len(values)}\0".encode())
            digest.update(numpy.ascontiguousarray(values, dtype="<f8").tobytes())
        else:
            arrays.header["skipped"][name] = str(kind)
    # Files of runs written by ftlm contain their row count and a digest.
    check = (table.schema.metadata or {}).get(b"ftlm-check")
    if check is not None and check != f"{table.num_rows} {digest.hexdigest()}".encode():
        entry = check.split(b" ")[0].decode("utf-8", errors="replace")[:20]
        raise UnreadableError(
            f"the file is damaged: {table.num_rows} rows were read instead of {entry}, or the checksum differs"
        )
    return arrays.header, arrays.values


def _arrow_units(schema: Any) -> dict[str, str]:
    """Return the units by column from the metadata of Arrow fields, or from the attributes of a pandas frame."""
    try:
        all_units = json.loads((schema.metadata or {}).get(b"PANDAS_ATTRS", b"{}")).get("units", {})
        units = {str(name): str(unit) for name, unit in all_units.items()}
    except (ValueError, AttributeError, RecursionError):
        units = {}
    for item in schema:
        field_metadata = item.metadata or {}
        unit = field_metadata.get(b"units", field_metadata.get(b"unit"))
        if unit is not None:
            units[item.name] = unit.decode("utf-8", errors="replace")
    return units


class Arrays:
    """Arrays of one file with their header; `budget` limits their total size as float64 [bytes]."""

    def __init__(self, budget: int = SIZE_LIMIT) -> None:
        self.header: dict[str, Any] = {"arrays": [], "skipped": {}}
        self.values: list[Any] = []
        self.remaining_budget = budget

    def fits(self, name: str, shape: tuple[int, ...], kind: Any) -> bool:
        """Return whether an array of this shape and dtype is supported; if not, record the reason in the header.

        Raise UnreadableError if the array would exceed the size limit or the maximum number of arrays.
        """
        reason = None
        if kind.hasobject:
            reason = "pickled objects, which are not read"
        elif kind.names is None and kind.kind not in "biufM":
            reason = "complex" if kind.kind == "c" else "no numbers"
        elif not 1 <= len(shape) <= 2:
            reason = "a single value" if not shape else f"{len(shape)} dimensions"
        elif 0 in shape:
            reason = "empty"
        if reason is not None:
            self.header["skipped"][name] = reason
            return False
        size = 8 * math.prod(shape) * len(kind.names or " ")
        if size > self.remaining_budget:
            raise UnreadableError(f"with {name!r} the arrays take more than {SIZE_LIMIT} bytes", "save a part of it")
        if len(self.values) + len(kind.names or " ") > MAX_ARRAYS:
            raise UnreadableError(f"it contains more than {MAX_ARRAYS} arrays", "save a part of it")
        self.remaining_budget -= size
        return True

    def add(self, name: str, values: Any, unit: str = "") -> None:
        """Append an array with its header entry; each field of a structured array becomes a column."""
        numpy: Any = importlib.import_module("numpy")
        if values.dtype.names:
            for field in values.dtype.names:
                column = values[field]
                full_name = f"{name}.{field}" if name else field
                if column.ndim == 1 and column.dtype.kind in "biufM":
                    self.add(full_name, column)
                else:
                    self.header["skipped"][full_name] = "no column of numbers"
            return
        matrix = values.reshape(-1, 1) if values.ndim == 1 else values
        fields: dict[str, Any] = {"type": "single" if values.dtype == numpy.float32 else "double"}
        if values.dtype.kind == "M":
            if matrix.shape[1] > 1:
                self.header["skipped"][name] = "a matrix of dates"
                return
            flat = values.ravel().astype("datetime64[ns]")
            nanoseconds, is_missing = flat.astype(numpy.int64), numpy.isnat(flat)
            valid = numpy.flatnonzero(~is_missing)
            since = int(nanoseconds[valid[0]]) if valid.size else 0
            matrix = (nanoseconds - since).astype(numpy.float64)[:, None]
            matrix[is_missing] = numpy.nan
            fields = {"type": "moments", "since": since}
        if unit:
            fields["unit"] = unit[:40]
        self.header["arrays"].append({"name": name, "rows": matrix.shape[0], "columns": matrix.shape[1], **fields})
        self.values.append(matrix)


def read_numpy(path: str, budget: int) -> tuple[dict[str, Any], list[Any]]:
    """Return the header of a NumPy file (.npy or .npz) and its arrays; pickled objects are never loaded."""
    arrays = Arrays(budget)
    if path.lower().endswith(".npy"):
        with open(path, "rb") as stream:
            values = numpy_array(stream, "the array", arrays)
        if values is None:
            return arrays.header, []
        arrays.header["text"] = True
        if values.dtype.names is not None or values.ndim == 1:
            arrays.add("" if values.dtype.names else "c1", values)
        else:
            check_size(0, values.shape[1])
            for k in range(values.shape[1]):
                arrays.add(f"c{k + 1}", values[:, k])
        return arrays.header, arrays.values
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            name = entry.filename.removesuffix(".npy")
            with archive.open(entry) as stream:
                values = numpy_array(stream, name, arrays)
            if values is not None:
                arrays.add(name, values)
    return arrays.header, arrays.values


def numpy_array(stream: Any, name: str, arrays: Arrays) -> Any:
    """Return the NumPy array in a binary stream, or None if its shape or dtype is not supported.

    `name` is the name of the array. Raise UnreadableError if its size is wrong, or exceeds the limit of `arrays`.
    """
    npy_format: Any = importlib.import_module("numpy.lib.format")
    version = npy_format.read_magic(stream)
    read_header = {(1, 0): npy_format.read_array_header_1_0, (2, 0): npy_format.read_array_header_2_0}.get(version)
    if read_header is None:
        raise UnreadableError(f"{name!r} has an unknown NumPy format ({version})", "save it again")
    shape, order, kind = read_header(stream)
    if not arrays.fits(name, shape, kind):
        return None
    numpy: Any = importlib.import_module("numpy")
    size = math.prod(shape) * kind.itemsize
    content = stream.read(size)
    if len(content) != size:
        raise UnreadableError(f"{name!r} ends after {len(content)} of {size} bytes")
    if stream.read(1):
        # The header may be damaged, and the numbers would then be shifted.
        raise UnreadableError(f"{name!r} has more than the {size} bytes that its header declares")
    return numpy.frombuffer(content, kind).reshape(shape, order="F" if order else "C")


def read_hdf5(path: str, budget: int) -> tuple[dict[str, Any], list[Any]]:
    """Return the header of an HDF5 file (including MATLAB 7.3) and its arrays; external links are not followed."""
    hdf5: Any = importlib.import_module("h5py")
    arrays = Arrays(budget)
    with hdf5.File(path, "r") as file:
        _gather(hdf5, file, "", arrays, 0)
    return arrays.header, arrays.values


def _gather(hdf5: Any, group: Any, prefix: str, arrays: Arrays, depth: int) -> None:
    """Append the arrays of an HDF5 group and its subgroups to `arrays`, with names that begin with `prefix`."""
    for key in group:
        name, link = f"{prefix}{key}", group.get(key, getlink=True)
        if not isinstance(link, hdf5.HardLink):
            arrays.header["skipped"][name] = "a link"
            continue
        item = group[key]
        matlab = item.attrs.get("MATLAB_class")
        kind = matlab.decode(errors="replace") if isinstance(matlab, bytes) else "" if matlab is None else str(matlab)
        if len(arrays.header["skipped"]) > MAX_ARRAYS:
            raise UnreadableError(f"it has more than {MAX_ARRAYS} items that are not arrays", "save a part of it")
        if isinstance(item, hdf5.Group):
            if kind or key.startswith("#") or depth >= MAX_GROUP_DEPTH:
                arrays.header["skipped"][name] = kind or "of MATLAB's own"
            else:
                _gather(hdf5, item, f"{name}/", arrays, depth + 1)
        elif not isinstance(item, hdf5.Dataset) or (kind and kind not in NUMERIC_MATLAB_CLASSES):
            arrays.header["skipped"][name] = kind or "no array"
        elif not has_numbers(item):
            arrays.header["skipped"][name] = "no numbers"
        elif item.is_virtual or item.external:
            arrays.header["skipped"][name] = "its numbers lie in other files"
        elif "MATLAB_empty" in item.attrs:
            arrays.header["skipped"][name] = "empty"
        elif arrays.fits(name, item.shape or (), item.dtype):
            values = item[()]
            unit = item.attrs.get("units", item.attrs.get("unit", ""))
            unit = unit.decode(errors="replace") if isinstance(unit, bytes) else unit if isinstance(unit, str) else ""
            # MATLAB stores arrays in column-major order, so HDF5 shows them transposed.
            arrays.add(name, values.T if kind and values.ndim == 2 else values, unit)


def has_numbers(item: Any) -> bool:
    """Whether an HDF5 dataset has a NumPy dtype that contains no Python objects."""
    try:
        return not item.dtype.hasobject
    except (TypeError, ValueError):
        return False


def read_sheet(path: str, sheet: str | None) -> tuple[dict[str, Any], bytes]:
    """Return the header of a sheet in a workbook, and its cells as tab-separated UTF-8 text.

    `sheet` is the name of the sheet; None selects the only sheet that is not empty. Raise UnreadableError if there is
    no such sheet.
    """
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > SIZE_LIMIT:
            raise UnreadableError(f"unpacked, it has {size} bytes, more than {SIZE_LIMIT}", "save a part of it")
        # The spreadsheet library does not verify the checksum of the archive members.
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
        if damaged is not None:
            raise UnreadableError(f"the checksum of {damaged!r} in the file is wrong")
    calamine: Any = importlib.import_module("python_calamine")
    book = calamine.CalamineWorkbook.from_path(path)
    names = list(book.sheet_names)
    if sheet is not None and sheet not in names:
        raise UnreadableError(
            f"it has no sheet {sheet!r}; its sheets are {', '.join(map(repr, names[:20]))}", SHEET_CHOICE_HINT
        )
    filled = {}
    for name in names if sheet is None else [sheet]:
        try:
            sheet_object = book.get_sheet_by_name(name)
        except calamine.WorksheetNotFound:
            continue
        if sheet_object.end is not None:
            check_size(sheet_object.end[0] + 1, sheet_object.end[1] + 1)
            filled[name] = sheet_object
    if not filled:
        raise UnreadableError(
            f"{'its sheets are' if len(names) > 1 else 'its sheet is'} empty", "choose a file with data"
        )
    if len(filled) > 1:
        raise UnreadableError(
            f"it has {len(filled)} sheets that are not empty: {', '.join(map(repr, list(filled)[:20]))}",
            SHEET_CHOICE_HINT,
        )
    ((name, sheet_object),) = filled.items()
    out = io.StringIO(newline="")
    writer = csv.writer(out, delimiter="\t", lineterminator="\n")
    table = sheet_object.to_python(skip_empty_area=False)
    while table and not any(map(cell_text, table[-1])):
        table.pop()
    for row in table:
        writer.writerow([cell_text(cell) for cell in row])
    content = out.getvalue().encode("utf-8", errors="replace")
    return {"sheet": name, "others": [n for n in names if n != name], "bytes": len(content)}, content


def cell_text(cell: Any) -> str:
    """Return the text of a spreadsheet cell; numbers keep all digits."""
    if isinstance(cell, bool):
        return str(cell)
    if isinstance(cell, int | float):
        return repr(cell)
    if isinstance(cell, datetime.timedelta):
        # A duration is written with its unit; a plain number would get the unit in the header of its column.
        seconds, microseconds = divmod(abs(cell) // datetime.timedelta(microseconds=1), 1_000_000)
        return f"{'-' if cell < datetime.timedelta() else ''}PT{seconds}.{microseconds:06}S"
    if isinstance(cell, datetime.datetime):
        return cell.isoformat(sep=" ")
    if isinstance(cell, datetime.date | datetime.time):
        return cell.isoformat()
    return " ".join(str(cell).replace("\0", " ").split())


READERS_BY_FORMAT = {
    "mat": read_matlab,
    "hdf5": read_hdf5,
    "parquet": read_parquet,
    "feather": read_feather,
    "numpy": read_numpy,
}


def write_result(kind: str, path: str, out: BinaryIO, budget: int, sheet: str | None) -> int:
    """Write the answer for one file to `out`: header with arrays or cells, or an error.

    Return the number of bytes of arrays and cells. `budget` limits the size of the arrays as float64 [bytes].
    """
    matlab = path.lower().endswith(".mat")
    damaged = f"the file is damaged; get an intact copy or {SAVE_AGAIN if matlab else 'save it again'}"
    cells, payload = b"", []
    try:
        if kind == "sheet":
            header, cells = read_sheet(path, sheet)
        else:
            header, arrays = READERS_BY_FORMAT[kind](path, budget)
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
    """Read the files of the command line KIND OPTIONS FILE…, and write one answer per file to standard output."""
    # More threads and a memory pool would reserve memory that counts against the limit.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    os.environ["ARROW_DEFAULT_MEMORY_POOL"] = "system"
    limit_resources(MEMORY_LIMIT, SECONDS_LIMIT)
    kind, text, *paths = arguments
    options = json.loads(text)
    budget = SIZE_LIMIT
    for path in paths:
        budget -= write_result(kind, path, sys.stdout.buffer, budget, options["sheet"])


if __name__ == "__main__":
    main(sys.argv[1:])
