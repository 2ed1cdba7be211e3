"""A run as a csv or a parquet file."""

from __future__ import annotations

import hashlib
import importlib
import io
import math
import os
from collections.abc import Mapping

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.errors import DataError
from ftlm.base.output import RUN, check_new, write_atomically
from ftlm.data.header import Header
from ftlm.data.measured import Measured
from ftlm.data.names import CSV_TIME
from ftlm.data.samples import grid_of


def write_csv(run: Measured, path: str | os.PathLike[str], *, force: bool) -> None:
    """Write a run as text; see :meth:`ftlm.Run.to_csv`."""
    check_new(path, force=force, words=RUN)
    columns = _columns(run)
    rows = map(",".join, zip(*(map(repr, column.tolist()) for column in columns.values()), strict=True))
    text = Header.of(run).line() + "\n".join([",".join(columns), *rows, ""])
    write_atomically(path, text.encode(), force=force, words=RUN)


def write_parquet(run: Measured, path: str | os.PathLike[str], *, force: bool) -> None:
    """Write a run as a parquet file; see :meth:`ftlm.Run.to_parquet`."""
    target = check_new(path, force=force, words=RUN)
    try:
        pyarrow = importlib.import_module("pyarrow")
        parquet = importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise DataError(f"{str(target)!r}: parquet needs pyarrow; run: pip install 'ftlm[parquet]'") from None
    columns, header = _columns(run), Header.of(run).text()
    check = f"{run.length} {digest(columns, header)}"
    table = pyarrow.table(columns).replace_schema_metadata({"ftlm-run": header, "ftlm-check": check})
    content = io.BytesIO()
    # Checksums of pages, and one of all rows: the footer, which says how many there are, has none of its own.
    parquet.write_table(table, content, write_page_checksum=True)
    write_atomically(target, content.getvalue(), force=force, words=RUN)


def digest(columns: Mapping[str, Floats], header: str) -> str:
    """Checksum of a run's columns in their order and of its header; `files/reader.py` computes it as well."""
    made = hashlib.sha256(header.encode())
    for name, values in columns.items():
        made.update(f"\0{name}\0{len(values)}\0".encode())
        made.update(np.ascontiguousarray(values, dtype="<f8").tobytes())
    return made.hexdigest()


def _columns(run: Measured) -> dict[str, Floats]:
    return {CSV_TIME: _source_time(run)} | {name: run[name] for name in run.signals}


def _source_time(run: Measured) -> Floats:
    """Source time of every row, in digits that read well."""
    exact = run.start + grid_of(run.length, run.step)
    # Nine digits below the step read well, and the exact step stands in the header.
    digits = 9 - math.floor(math.log10(run.step))
    if not 0 <= digits <= 15 or np.abs(exact).max() * 10.0**digits >= 2.0**53:
        return exact
    rounded = np.round(exact, digits)
    rounded[0] = run.start
    return rounded
