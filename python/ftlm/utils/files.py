"""Files: atomic writing, versioned JSON documents, TOML files, paths in messages, and the logger ``ftlm``."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import secrets
import stat
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar, get_args

import msgspec
import msgspec.toml

from ftlm._core import __version__
from ftlm.errors import DataError, ModelError
from ftlm.utils.parameters import parameter
from ftlm.utils.resources import optional_module
from ftlm.utils.validation import error_text, nearest, short_repr

#: Logger of the package. INFO: files read and written, start and end of fits. WARNING: findings against a result.
PACKAGE_LOGGER = logging.getLogger("ftlm")
PACKAGE_LOGGER.addHandler(logging.NullHandler())


#: Flags to create a file that must not exist, in binary mode on systems that distinguish text from bytes.
_NEW_FILE_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)


def check_target(path: str | os.PathLike[str], *, force: bool) -> Path:
    """Return the path of a file to be written; raise DataError if it must not be written.

    This is the case for a folder, a link, a device, and an existing file if `force` is False.
    """
    file = Path(path)
    if file.is_dir():
        raise DataError(f"{file} is a folder; name a file in it")
    status = _link_status(file)
    # A dangling link counts as an existing file.
    if status is not None and not force:
        raise DataError(f"{file} exists; choose another name, or overwrite it with {parameter('force', True)}")
    if status is not None and not stat.S_ISREG(status.st_mode):
        # A rename would replace a device, and would replace a link instead of its target.
        kind = "a link" if stat.S_ISLNK(status.st_mode) else "a device, pipe or socket"
        raise DataError(f"{file} is {kind}, no regular file, and is not overwritten; choose another name")
    return file


def _link_status(file: Path) -> os.stat_result | None:
    """Return the status of a path itself, not of the target of a symbolic link; None if it does not exist."""
    try:
        return file.lstat()
    except (OSError, ValueError):
        return None


def check_writable(*paths: str | os.PathLike[str] | None, force: bool) -> None:
    """Raise DataError if a file cannot be written to one of the paths; a path that is None is skipped.

    The function is called before a long computation, which would otherwise be lost.
    """
    for path in paths:
        if path is None:
            continue
        file = check_target(path, force=force)
        folder = file.absolute().parent
        if not folder.is_dir():
            raise DataError(f"{file.parent} is not a folder; create it first")
        if not os.access(folder, os.W_OK):
            raise DataError(f"{file} cannot be written: {file.parent} is read-only; choose another folder")


def check_folder(folder: Path, names: Iterable[str], *, force: bool) -> None:
    """Create a folder; raise DataError if this fails, or if a file in `names` exists in it and `force` is False."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder} cannot be created: {error.strerror or error}; choose another folder") from error
    existing = [name for name in names if os.path.lexists(folder / name)]
    if existing and not force:
        raise DataError(
            f"{folder / existing[0]} exists ({len(existing)} such files); choose another folder, or "
            f"{parameter('force', True)}"
        )


def write_atomically(path: str | os.PathLike[str], content: bytes, *, force: bool) -> Path:
    """Write bytes to a file so that readers see either the old or the new content, and return the path.

    A temporary file in the same folder is written, flushed to disk and renamed.

    Raises
    ------
    DataError
        If the file exists and ``force`` is False, or it cannot be written.
    """
    file = check_target(path, force=force)
    try:
        # The file is in the same folder, because a rename cannot cross file systems. File names have a maximum length.
        temporary_file = file.with_name(f".{file.name}.{secrets.token_hex(4)}")
        status = _link_status(file)
        # O_EXCL does not follow a link that another program created. The permissions are the default of a new file, or
        # those of the file that is overwritten, from the first byte on.
        descriptor = os.open(
            temporary_file, _NEW_FILE_FLAGS, 0o666 if status is None else stat.S_IMODE(status.st_mode) & 0o777
        )
        try:
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(content)
                stream.flush()
                if status is not None and hasattr(os, "fchmod"):
                    os.fchmod(stream.fileno(), stat.S_IMODE(status.st_mode) & 0o777)
                os.fsync(stream.fileno())
            if force:
                os.replace(temporary_file, file)
            else:
                _move_exclusively(temporary_file, file)
        except FileExistsError:
            with contextlib.suppress(OSError):
                temporary_file.unlink()
            # Another program created the file after the check.
            check_target(file, force=False)
            raise
        except BaseException:
            with contextlib.suppress(OSError):
                temporary_file.unlink()
            raise
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else None
        raise DataError(f"{file} cannot be written: {reason or error}; choose another folder") from error
    # After a power failure, the rename is preserved only if the folder was flushed; not every system supports this.
    with contextlib.suppress(OSError):
        descriptor = os.open(file.parent, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    PACKAGE_LOGGER.info("written: %s (%d bytes)", file, len(content))
    return file


def check_ending(path: str | os.PathLike[str], ending: str) -> None:
    """Raise ModelError if the name of a file does not end in the extension `ending`, such as ``".html"``."""
    if Path(path).suffix.lower() != ending:
        raise ModelError(f"{path} does not end in {ending}; use this extension")


def _move_exclusively(temporary_file: Path, file: Path) -> None:
    """Rename the file `temporary_file` to `file`, which must not exist; raise FileExistsError if it exists."""
    try:
        os.link(temporary_file, file, follow_symlinks=False)
    except FileExistsError:
        raise
    except (OSError, NotImplementedError):
        # On file systems without hard links, an empty file reserves the name.
        os.close(os.open(file, _NEW_FILE_FLAGS, 0o666))
        try:
            os.replace(temporary_file, file)
        except BaseException:
            with contextlib.suppress(OSError):
                file.unlink()
            raise
    else:
        # The file is complete even if its temporary name cannot be deleted.
        with contextlib.suppress(OSError):
            temporary_file.unlink()


#: Maximum length of a name in a message, and maximum size of a model, controller or settings file (usually kilobytes).
MAX_NAME_CHARACTERS, MAX_SMALL_FILE_BYTES = 300, 1 << 20
_READ_FLAGS = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)


def nearest_file_hint(path: Path) -> str:
    """Return text such as " (did you mean …?)" with the most similar file name in the folder of `path`, or ""."""
    try:
        names = sorted(entry.name for entry in path.parent.iterdir())
    except (OSError, ValueError):
        return ""
    return nearest(path.name, names)


def read_small_file(path: str | os.PathLike[str], label: str, source: str) -> bytes:
    """Return the bytes of a regular file of at most 1 MiB.

    Parameters
    ----------
    path
        File to read.
    label, source
        Name of the content, and kind of file that the user should pass, for error messages.

    Raises
    ------
    DataError
        If the file cannot be read, is not a regular file (such as a pipe or device), or is too large.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise DataError(f"path = {short_repr(path)} is not the path of a file; give {source}")
    file = Path(path)
    try:
        descriptor = os.open(file, _READ_FLAGS)
        status = os.fstat(descriptor)
        if stat.S_ISREG(status.st_mode) and status.st_size <= MAX_SMALL_FILE_BYTES:
            with os.fdopen(descriptor, "rb") as stream:
                return stream.read(MAX_SMALL_FILE_BYTES)
        os.close(descriptor)
    except (OSError, ValueError) as error:
        # The path may be too long or unprintable for a message.
        name = str(file)
        path_text = (
            name if name.isprintable() and len(name) <= MAX_NAME_CHARACTERS else short_repr(name, MAX_NAME_CHARACTERS)
        )
        reason = (error.strerror if isinstance(error, OSError) else None) or error
        hint = nearest_file_hint(file) if isinstance(error, FileNotFoundError) else ""
        raise DataError(f"{label} {path_text} cannot be read: {reason}{hint}; check the path") from error
    if not stat.S_ISREG(status.st_mode):
        raise DataError(f"{file} is not a regular file; give {source}")
    raise DataError(
        f"{file} has {status.st_size} bytes, no {label} is larger than {MAX_SMALL_FILE_BYTES}; give {source}"
    )


F = TypeVar("F", bound=msgspec.Struct)


def read_toml(path: str | os.PathLike[str], label: str, source: str, kind: type[F]) -> F:
    """Return the content of a TOML file.

    Parameters
    ----------
    path
        File to read.
    label, source
        Name of the content, and kind of file that the user should pass, for error messages.
    kind
        Type of the content, a msgspec structure, which is returned.

    Raises
    ------
    DataError
        If the file cannot be read, is too large, is not TOML, or has unknown keys or values of a wrong type.
    """
    content = read_small_file(path, label, source)
    try:
        # Some editors write a byte-order mark at the start.
        return msgspec.toml.decode(content.removeprefix(b"\xef\xbb\xbf"), type=kind)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        unknown = re.search("unknown field `(.*)`", str(error))
        reason = error_text(error, MAX_NAME_CHARACTERS) + (nearest(unknown[1], _field_names(kind)) if unknown else "")
        raise DataError(f"{os.fspath(path)!r} is not a TOML file of {label}: {reason}; give {source}") from error


def _field_names(kind: type[msgspec.Struct]) -> list[str]:
    """Return the keys of a msgspec structure and of the structures nested in it."""
    names = []
    for field in msgspec.structs.fields(kind):
        tables = [
            t for t in (field.type, *get_args(field.type)) if isinstance(t, type) and issubclass(t, msgspec.Struct)
        ]
        names += [field.encode_name, *(name for table in tables for name in _field_names(table))]
    return names


class FileHeader(msgspec.Struct):
    """Common fields of all JSON documents of ftlm, which can be read from files with any schema version."""

    format: str
    schema: int
    written_by: str = ""


@dataclass(frozen=True)
class JsonFormat(Generic[F]):
    """Format of a versioned JSON document.

    Parameters
    ----------
    name
        Name of the content.
    source
        Kind of file that the user should pass, for error messages.
    kind
        Type of the content, a msgspec structure.
    schema
        Schema version that this version of ftlm reads and writes.
    """

    name: str
    source: str
    kind: type[F]
    schema: int

    def read(self, path: str | os.PathLike[str]) -> F:
        """Return the content of a file.

        Raises
        ------
        DataError
            If the file cannot be read, is too large, or has another format or schema version.
        """
        content = read_small_file(path, self.name, self.source)
        file = Path(path)
        self._check_schema(file, content)
        try:
            return msgspec.json.decode(content, type=self.kind)
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            raise DataError(
                f"{file} is not an ftlm {self.name}: {error_text(error, MAX_NAME_CHARACTERS)}; give {self.source}"
            ) from error

    def _check_schema(self, file: Path, content: bytes) -> None:
        """Raise DataError if a file has this format but another schema version."""
        try:
            head = msgspec.json.decode(content, type=FileHeader)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            return
        if head.format == f"ftlm-{self.name}" and head.schema != self.schema:
            version = f" (written by {short_repr(head.written_by, MAX_NAME_CHARACTERS)})" if head.written_by else ""
            raise DataError(
                f"{file} is a {self.name} file of schema {short_repr(head.schema)}{version}, and ftlm {__version__} "
                f"reads schema {self.schema}; read it with the version that wrote it, or compute the {self.name} again"
            )


def to_frame(rows: Sequence[Mapping[str, Any]], index: Sequence[str]) -> Any:
    """Return rows, each a mapping of values by column, as a pandas DataFrame with the columns `index` as its index.

    Raises
    ------
    ModelError
        If pandas is not installed.
    """
    pandas = optional_module("pandas", "pandas", "pandas")
    return pandas.DataFrame.from_records(list(rows)).set_index(list(index))
