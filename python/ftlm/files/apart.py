"""Reads .mat and parquet files in a process of its own, which they may crash."""

from __future__ import annotations

import importlib.util
import json
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt

from ftlm.base.errors import DataError
from ftlm.data.header import Header
from ftlm.files.columns import Column, FileTable

_READER = Path(__file__).with_name("mat_reader.py")
_PARQUET_READER = Path(__file__).with_name("parquet_reader.py")
_READER_SECONDS = 60.0


@dataclass(frozen=True)
class _Apart:
    """A kind of file that is read in a process of its own."""

    suffixes: tuple[str, ...]
    package: str
    extra: str
    words: str
    again: str


MATLAB = _Apart((".mat",), "scipy", "mat", ".mat", "save it again with save('FILE.mat', '-v7')")
PARQUET = _Apart((".parquet", ".pq"), "pyarrow", "parquet", "parquet", "save it again")


def read_apart(paths: list[Path], kind: _Apart) -> list[FileTable]:
    folders = []
    for package in ("numpy", kind.package):
        found = importlib.util.find_spec(package)
        if found is None or not found.submodule_search_locations:
            raise DataError(
                f"{str(paths[0])!r}: reading {kind.words} files needs {package}; run: pip install 'ftlm[{kind.extra}]'"
            )
        folders.append(str(Path(next(iter(found.submodule_search_locations))).resolve().parent))
    reader = _READER if kind is MATLAB else _PARQUET_READER
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

    def table(self, path: Path) -> FileTable | None:
        """Return the next file's columns, or None when the reader did not get that far."""
        found = self._next()
        if found is None:
            return None
        header, arrays = found
        if "error" in header:
            raise DataError(f"{str(path)!r}: {header['error']}; {header['way_out']}")
        skipped = cast("dict[str, str]", header.get("skipped", {}))
        columns: list[Column] = []
        for name, kind, matrix in arrays:
            # The time of a single-precision file is exact to its own digits only, which the step must know.
            with np.errstate(over="ignore"):  # what overflows is no single; it is refused as infinite
                values = matrix.astype(np.float32) if kind == "single" else matrix
            if 1 in matrix.shape:
                columns.append(Column(variable=name, name=name, source=path, values=values.ravel(order="F")))
                continue
            problem = None
            if matrix.shape[1] > matrix.shape[0]:
                problem = DataError(
                    f"{path.name}: the matrix {name!r} has {matrix.shape[0]} rows and {matrix.shape[1]} columns; "
                    f"samples belong in rows: transpose it in MATLAB ({name} = {name}.';) and save it again"
                )
            columns += [
                Column(
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
        own = Header.read(path, "its metadata", told) if isinstance(told, str) else None
        return FileTable(path=path, columns=columns, text=header.get("text") is True, header=own, skipped=skipped)
