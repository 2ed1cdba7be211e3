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

_READER = Path(__file__).with_name("reader.py")
_READER_SECONDS = 60.0


@dataclass(frozen=True)
class Apart:
    """A kind of file that is read in a process of its own.

    Parameters
    ----------
    suffixes
        How its files end.
    package, extra
        What reads it, and the extra of ftlm that installs that.
    words, again
        What errors call it, and how it is saved again.
    """

    suffixes: tuple[str, ...]
    package: str
    extra: str
    words: str
    again: str


MATLAB = Apart((".mat",), "scipy", "mat", ".mat", "save it again with save('FILE.mat', '-v7')")
PARQUET = Apart((".parquet", ".pq"), "pyarrow", "parquet", "parquet", "save it again")


def read_apart(paths: list[Path], kind: Apart) -> list[FileTable]:
    """Read files of one kind; a crash of the reader is the fault of the first file that it did not answer for."""
    folders = []
    for package in ("numpy", kind.package):
        spec = importlib.util.find_spec(package)
        if spec is None or not spec.submodule_search_locations:
            raise DataError(
                f"{str(paths[0])!r}: reading {kind.words} files needs {package}; run: pip install 'ftlm[{kind.extra}]'"
            )
        folders.append(str(Path(next(iter(spec.submodule_search_locations))).resolve().parent))
    files = [str(path.resolve()) for path in paths]
    command = [sys.executable, "-I", str(_READER), kind.package, json.dumps(folders), *files]
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=_READER_SECONDS, check=False
        )
    except subprocess.TimeoutExpired as stopped:
        answers = _Answers(stopped.stdout or b"")
        path = paths[min(answers.complete(len(paths)), len(paths) - 1)]
        raise _damaged(path, f"did not finish in {_READER_SECONDS:g} s", kind) from None
    except OSError as error:
        raise DataError(
            f"{str(paths[0])!r}: Python could not be started to read it ({error.strerror}); check the installation"
        ) from None
    answers = _Answers(done.stdout)
    tables = []
    for path in paths:
        table = answers.table(path)
        if table is None:
            raise _damaged(path, _ending(done.returncode), kind)
        tables.append(table)
    return tables


def _ending(code: int) -> str:
    """How the reader ended."""
    if code >= 0:
        return "ended too early" if code == 0 else f"ended with code {code}"
    try:
        return f"crashed (signal {-code}, {signal.Signals(-code).name})"
    except ValueError:
        return f"crashed (signal {-code})"


def _damaged(path: Path, how: str, kind: Apart) -> DataError:
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
        answer = self._next()
        if answer is None:
            return None
        header, arrays = answer
        if "error" in header:
            raise DataError(f"{str(path)!r}: {header['error']}; {header['way_out']}")
        skipped = cast("dict[str, str]", header.get("skipped", {}))
        columns = [column for name, kind, matrix in arrays for column in _columns(path, name, kind, matrix)]
        if not columns:
            why = ", ".join(f"{name!r} ({reason})" for name, reason in list(skipped.items())[:10]) or "it is empty"
            raise DataError(f"{str(path)!r} holds no real numeric matrix: {why}; save the samples as matrices")
        told = header.get("ftlm-run")
        own = Header.read(path, "its metadata", told) if isinstance(told, str) else None
        return FileTable(path, columns, text=header.get("text") is True, header=own, skipped=skipped)


def _columns(path: Path, name: str, kind: str, matrix: npt.NDArray[np.float64]) -> list[Column]:
    """Return a vector as a column under its name, a matrix as columns under its name and their numbers."""
    # The time of a single-precision file is exact to its own digits only, which the step must know.
    with np.errstate(over="ignore"):  # what overflows is no single; it is refused as infinite
        values = matrix.astype(np.float32) if kind == "single" else matrix
    if 1 in matrix.shape:
        return [Column(name, name, path, values.ravel(order="F"))]
    rows, count = matrix.shape
    if count > rows:
        problem = DataError(
            f"{path.name}: the matrix {name!r} has {rows} rows and {count} columns; "
            f"samples belong in rows: transpose it in MATLAB ({name} = {name}.';) and save it again"
        )
        return [Column(name, f"{name}.1", path, values[:, 0], problem, name)]
    return [Column(name, f"{name}.{k + 1}", path, values[:, k], matrix=name) for k in range(count)]
