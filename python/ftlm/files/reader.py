"""Reads numbers from version-5 .mat and parquet files in a process of its own: a damaged file can crash the libraries.

Run by path, never imported by the parent: ``python -I reader.py PACKAGE FOLDERS FILE…`` with PACKAGE scipy or pyarrow
and FOLDERS a JSON list of the folders that hold it and NumPy. For every file it writes to standard output one line of
JSON and then the numbers:

``{"arrays": [{"name": …, "rows": …, "columns": …, "type": …}], "skipped": {name: why}}`` followed by the arrays, each
little-endian float64, column after column; or ``{"error": why, "way_out": what to do}`` and the end. Of a parquet file
it also says ``"text": true`` (columns, not matrices) and, for a run that ftlm wrote, ``"ftlm-run"``: its own header.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import math
import os
import sys
import warnings
from typing import Any, BinaryIO

MEMORY_LIMIT = 4 << 30
SECONDS_LIMIT = 60
SIZE_LIMIT = 1 << 30
MOST_ARRAYS = 10_000
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
    """Raise unless the first bytes are those of a version-5 file."""
    with open(path, "rb") as stream:
        head = stream.read(520)
    if head[:19] == b"MATLAB 7.3 MAT-file" or b"\x89HDF\r\n\x1a\n" in (head[:8], head[512:520]):
        raise UnreadableError("it is a version 7.3 (HDF5) file, which this version does not read", SAVE_AGAIN)
    if len(head) < 128 or head[126:128] not in (b"IM", b"MI"):
        raise UnreadableError("it is not a version-5 .mat file", SAVE_AGAIN)
    major = head[125] if head[126:128] == b"IM" else head[124]
    if major != 1:
        raise UnreadableError(f"it is not a version-5 .mat file (its version code is {major})", SAVE_AGAIN)


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


def read_parquet(path: str) -> tuple[dict[str, Any], list[Any]]:
    """Return the header of a parquet file and its columns."""
    numpy: Any = importlib.import_module("numpy")
    parquet: Any = importlib.import_module("pyarrow.parquet")
    types: Any = importlib.import_module("pyarrow.types")
    compute: Any = importlib.import_module("pyarrow.compute")
    file = parquet.ParquetFile(path, page_checksum_verification=True)
    rows, columns = file.metadata.num_rows, file.metadata.num_columns
    if columns > MOST_ARRAYS or 8 * rows * columns > SIZE_LIMIT:
        raise UnreadableError(
            f"it declares {rows} rows of {columns} columns, more than {SIZE_LIMIT} bytes or {MOST_ARRAYS} columns",
            "save a part of it",
        )
    table = file.read(use_threads=False)
    header: dict[str, Any] = {"arrays": [], "skipped": {}, "text": True}
    told = (table.schema.metadata or {}).get(b"ftlm-run")
    if told is not None:
        header["ftlm-run"] = told.decode("utf-8", errors="replace")
    arrays = []
    made = hashlib.sha256(told or b"")
    for name, column in zip(table.column_names, table.columns, strict=True):
        kind = column.type
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


def answer(package: str, path: str, out: BinaryIO, budget: int) -> int:
    """Write what one file holds, or why it cannot be read; return the number of bytes of its arrays."""
    matlab = package == "scipy"
    damaged = f"the file is damaged; get an intact copy or {SAVE_AGAIN if matlab else 'save it again'}"
    try:
        header, arrays = read_matlab(path, budget) if matlab else read_parquet(path)
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
    out.flush()
    return sum(values.nbytes for values in payload)


def main(arguments: list[str]) -> None:
    """Answer for every file in turn."""
    # One thread: every further one would reserve memory that counts against the limit, as pools of memory do.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    os.environ["ARROW_DEFAULT_MEMORY_POOL"] = "system"
    limit_resources()
    package, folders, *paths = arguments
    sys.path.extend(folder for folder in json.loads(folders) if folder not in sys.path)
    budget = SIZE_LIMIT
    for path in paths:
        budget -= answer(package, path, sys.stdout.buffer, budget)


if __name__ == "__main__":
    main(sys.argv[1:])
