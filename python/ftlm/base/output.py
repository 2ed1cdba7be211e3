"""Files written: whether one may be, and atomically."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from ftlm.base.errors import DataError

#: Systems that tell text from bytes are to write bytes.
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)


@dataclass(frozen=True)
class Words:
    """How errors speak of a file that cannot be written, which depends on who asked for it.

    Parameters
    ----------
    quoted
        Whether its name stands in quotes.
    folder
        What to do where a folder has that name; nothing where that counts as a file that exists.
    overwrite
        How to overwrite a file that exists.
    failed
        What is said of a failure, with its reason.
    """

    quoted: bool = False
    folder: str = ""
    overwrite: str = "force=True (--force)"
    failed: str = "cannot be written: {}; choose another folder"

    def shown(self, path: Path) -> str:
        """Write a path."""
        return repr(str(path)) if self.quoted else str(path)


#: Models, pages and tables; runs; what a command was told to write.
PLAIN = Words()
RUN = Words(
    quoted=True,
    folder="give the name of a file in it",
    failed="cannot be written ({}); check the folder and the space left",
)
COMMAND = Words(folder="name a file in it", overwrite="--force")


def check_new(path: str | os.PathLike[str], *, force: bool, words: Words = PLAIN) -> Path:
    """Refuse the name of a folder, and that of a file that must not be overwritten."""
    file = Path(path)
    if words.folder and file.is_dir():
        raise DataError(f"{words.shown(file)} is a folder; {words.folder}")
    # A dangling link is a file that someone meant to be there.
    if not force and os.path.lexists(file):
        raise DataError(f"{words.shown(file)} exists; choose another name, or overwrite it with {words.overwrite}")
    return file


def check_free(*paths: str | os.PathLike[str] | None, force: bool, words: Words = PLAIN) -> None:
    """Refuse before any work what could not be written after it; no path is no file to write."""
    for path in paths:
        if path is None:
            continue
        file = check_new(path, force=force, words=words)
        folder = file.absolute().parent
        if not folder.is_dir():
            raise DataError(f"{words.shown(file.parent)} is no folder; make it first")
        if not os.access(folder, os.W_OK):
            raise DataError(
                f"{words.shown(file)} cannot be written: {words.shown(file.parent)} is read-only; choose another folder"
            )


def check_folder(folder: Path, names: Iterable[str], *, force: bool) -> None:
    """Make a folder and refuse before any work those of its files that could not be written after it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder} cannot be made: {error.strerror or error}; choose another folder") from error
    there = [name for name in names if os.path.lexists(folder / name)]
    if there and not force:
        raise DataError(f"{folder / there[0]} exists ({len(there)} such files); choose another folder, or --force")


def write_atomically(path: str | os.PathLike[str], content: bytes, *, force: bool, words: Words = PLAIN) -> Path:
    """Write beside, flush to disk, rename: a reader sees the old file or the new one, whole.

    Raises
    ------
    DataError
        The file exists and ``force`` is not set, or it cannot be written.
    """
    file = check_new(path, force=force, words=words)
    try:
        # In its folder, since no rename crosses disks; short, so that long names have room.
        beside = file.with_name(f".{file.name}.{secrets.token_hex(4)}")
        # Never through a link that another program left, and with the permissions that a new file has here.
        descriptor = os.open(beside, _NEW, 0o666)
        try:
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(beside, file)
        except BaseException:
            with contextlib.suppress(OSError):
                beside.unlink()
            raise
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else None
        raise DataError(f"{words.shown(file)} {words.failed.format(why or error)}") from error
    # The rename itself survives a power cut only when the folder is on disk too; not every system can do that.
    with contextlib.suppress(OSError):
        descriptor = os.open(file.parent, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    return file
