"""Files written: whether one may be, and atomically."""

from __future__ import annotations

import contextlib
import importlib
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ftlm.base.errors import DataError, ModelError


def write_atomically(path: str | os.PathLike[str], data: bytes, *, force: bool) -> Path:
    """Write beside, flush to disk, rename: a reader sees the old file or the new one.

    Raises
    ------
    DataError
        The file exists and ``force`` is not set, or the folder cannot be written.
    """
    file = Path(path)
    if os.path.lexists(file) and not force:
        raise DataError(f"{file} exists; choose another name, or overwrite it with force=True (--force)")
    try:
        handle, beside = tempfile.mkstemp(prefix=f".{file.name}.", dir=file.parent or Path())
        try:
            with os.fdopen(handle, "wb") as out:
                out.write(data)
                out.flush()
                os.fsync(out.fileno())
            umask = os.umask(0)
            os.umask(umask)
            Path(beside).chmod(0o666 & ~umask)
            Path(beside).replace(file)
        except BaseException:
            Path(beside).unlink(missing_ok=True)
            raise
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else None
        raise DataError(f"{file} cannot be written: {why or error}; choose another folder") from error
    return file


def new_file(path: str | os.PathLike[str], *, force: bool) -> Path:
    target = Path(path)
    if target.is_dir():
        raise DataError(f"{str(target)!r} is a folder; give the name of a file in it")
    if not force and os.path.lexists(target):
        raise DataError(f"{str(target)!r} exists; choose another name, or overwrite it with force=True (--force)")
    return target


def write_bytes_atomically(target: Path, content: bytes) -> None:
    beside = target.with_name(f".{target.name}.{os.urandom(6).hex()}.tmp")
    try:
        try:
            descriptor = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(beside, target)
        except BaseException:
            with contextlib.suppress(OSError):
                beside.unlink(missing_ok=True)
            raise
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise DataError(f"{str(target)!r} cannot be written ({reason}); check the folder and the space left") from None
    # The rename itself survives a power cut only when the folder is on disk too; not every system can do that.
    with contextlib.suppress(OSError):
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def check_free(path: str | os.PathLike[str], *, force: bool) -> None:
    """Refuse before any work what could not be written after it.

    Raises
    ------
    DataError
        The file exists and ``force`` is not set, or its folder is not there or cannot be written.
    """
    file = Path(path)
    if os.path.lexists(file) and not force:
        raise DataError(f"{file} exists; choose another name, or overwrite it with force=True (--force)")
    if not file.absolute().parent.is_dir():
        raise DataError(f"{file.parent} is no folder; make it first")
    if not os.access(file.absolute().parent, os.W_OK):
        raise DataError(f"{file} cannot be written: {file.parent} is read-only; choose another folder")


def check_folder(folder: Path, names: Sequence[str], *, force: bool) -> None:
    """Make a folder and refuse before any work what could not be written after it.

    Raises
    ------
    DataError
        A file that exists, or a folder that cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder} cannot be made: {error.strerror or error}; choose another folder") from error
    there = [n for n in names if (folder / n).exists()]
    if there and not force:
        raise DataError(f"{folder / there[0]} exists ({len(there)} such files); choose another folder, or --force")


def to_frame(rows: Sequence[Mapping[str, Any]], index: Sequence[str]) -> Any:
    """Rows as a pandas frame.

    Raises
    ------
    ModelError
        pandas is not installed.
    """
    try:
        pandas = importlib.import_module("pandas")
    except ImportError:
        raise ModelError("pandas is not installed; pip install pandas") from None
    return pandas.DataFrame.from_records(list(rows)).set_index(list(index))


def check_writable(paths: list[str | None], *, force: bool) -> None:
    """Refuse before any work what could not be written after it.

    Raises
    ------
    DataError
        A file that exists, or a folder that does not.
    """
    for path in paths:
        if path is None:
            continue
        if Path(path).is_dir():
            raise DataError(f"{path} is a folder; name a file in it")
        if Path(path).exists() and not force:
            raise DataError(f"{path} exists; choose another name, or overwrite it with --force")
        if not Path(path).resolve().parent.is_dir():
            raise DataError(f"{Path(path).parent} is no folder; make it first")
