"""Files written: whether one may be, and atomically."""

from __future__ import annotations

import contextlib
import os
import secrets
import stat
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from ftlm.base.errors import DataError
from ftlm.base.log import LOG

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
    there = _status(file)
    # A dangling link is a file that someone meant to be there.
    if there is not None and not force:
        raise DataError(f"{words.shown(file)} exists; choose another name, or overwrite it with {words.overwrite}")
    if there is not None and not stat.S_ISREG(there.st_mode) and not stat.S_ISDIR(there.st_mode):
        # A device of the system would be gone, and what stands behind a link is not what was asked for.
        kind = "a link" if stat.S_ISLNK(there.st_mode) else "a device, pipe or socket"
        raise DataError(f"{words.shown(file)} is {kind}, no regular file, and is not overwritten; choose another name")
    return file


def _status(file: Path) -> os.stat_result | None:
    """What has that name, itself and not what it leads to; None where nothing has."""
    try:
        return file.lstat()
    except (OSError, ValueError):
        return None


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
        there = _status(file)
        # Never through a link that another program left. The permissions are those that a new file has here, or those
        # of the file that is overwritten, from the first byte on.
        descriptor = os.open(beside, _NEW, 0o666 if there is None else stat.S_IMODE(there.st_mode) & 0o777)
        try:
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(content)
                stream.flush()
                if there is not None and hasattr(os, "fchmod"):
                    os.fchmod(stream.fileno(), stat.S_IMODE(there.st_mode) & 0o777)
                os.fsync(stream.fileno())
            if force or not _named(beside, file):
                os.replace(beside, file)
        except FileExistsError:
            with contextlib.suppress(OSError):
                beside.unlink()
            # Somebody made it between the check and now.
            check_new(file, force=False, words=words)
            raise
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
    LOG.info("written: %s (%d bytes)", file, len(content))
    return file


def _named(beside: Path, file: Path) -> bool:
    """Give a file a second name that nobody has, and take the first away; refuse one that was taken meanwhile.

    Where the file system has no links it is false, and an empty file of that name waits for the file's renaming.
    """
    try:
        os.link(beside, file, follow_symlinks=False)
    except FileExistsError:
        raise
    except (OSError, NotImplementedError):
        os.close(os.open(file, _NEW, 0o666))
        return False
    beside.unlink()
    return True
