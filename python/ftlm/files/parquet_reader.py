"""Reads the numeric columns of a parquet file in a process of its own, because a damaged file can crash its library.

Run by path, never imported by the parent, as ``mat_reader.py`` is and with the same answer, whose header also says
``"text": true`` (columns, not matrices) and, for a run that ftlm wrote, ``"ftlm-run"``: its own header.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from pathlib import Path
from typing import Any

SIZE_LIMIT = 1 << 30
MOST_COLUMNS = 10_000
DAMAGED = "the file is damaged; get an intact copy or save it again"


def read(path: str) -> tuple[dict[str, Any], list[Any]]:
    """Return the header of one file and its columns."""
    numpy: Any = importlib.import_module("numpy")
    parquet: Any = importlib.import_module("pyarrow.parquet")
    types: Any = importlib.import_module("pyarrow.types")
    compute: Any = importlib.import_module("pyarrow.compute")
    file = parquet.ParquetFile(path, page_checksum_verification=True)
    rows, columns = file.metadata.num_rows, file.metadata.num_columns
    if columns > MOST_COLUMNS or 8 * rows * columns > SIZE_LIMIT:
        why = f"it declares {rows} rows of {columns} columns, more than {SIZE_LIMIT} bytes or {MOST_COLUMNS} columns"
        return {"error": why, "way_out": "save a part of it"}, []
    table = file.read(use_threads=False)
    header: dict[str, Any] = {"arrays": [], "skipped": {}, "text": True}
    told = (table.schema.metadata or {}).get(b"ftlm-run")
    if told is not None:
        header["ftlm-run"] = told.decode("utf-8", errors="replace")
    arrays = []
    for name, column in zip(table.column_names, table.columns, strict=True):
        kind = column.type
        if not (types.is_floating(kind) or types.is_integer(kind) or types.is_boolean(kind)):
            header["skipped"][name] = str(kind)
            continue
        values = compute.cast(column, "float64").combine_chunks().to_numpy(zero_copy_only=False)
        values = numpy.asarray(values, dtype=numpy.float64)
        single = "single" if types.is_float32(kind) else "double"
        header["arrays"].append({"name": name, "rows": len(values), "columns": 1, "type": single})
        arrays.append(values)
    return header, arrays


def main(arguments: list[str]) -> None:
    """Answer for every file in turn."""
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    # The pools that reserve memory in advance would count against the limit.
    os.environ["ARROW_DEFAULT_MEMORY_POOL"] = "system"
    sys.path.append(str(Path(__file__).resolve().parent))
    importlib.import_module("mat_reader").limit_resources()
    sys.path.extend(folder for folder in json.loads(arguments[0]) if folder not in sys.path)
    for path in arguments[1:]:
        try:
            header, arrays = read(path)
        except MemoryError:
            header, arrays = {"error": "reading it takes too much memory", "way_out": DAMAGED}, []
        except Exception as error:
            # The library raises errors of any kind on a damaged file.
            header, arrays = {"error": f"{type(error).__name__}: {error}"[:300], "way_out": DAMAGED}, []
        sys.stdout.buffer.write(json.dumps(header).encode() + b"\n")
        for values in arrays:
            sys.stdout.buffer.write(values.astype("<f8", copy=False).tobytes())
        sys.stdout.buffer.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
