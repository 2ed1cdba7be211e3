"""JSON files that ftlm wrote, read back: of which size, of which kind, of which schema."""

from __future__ import annotations

import os
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Protocol, TypeVar

import msgspec

from ftlm._core import __version__
from ftlm.base.checks import shown, words_of
from ftlm.base.errors import DataError

#: Longest name of a file in a message.
LONGEST = 300


class Versioned(Protocol):
    """What stands in such a file."""

    schema: int


T = TypeVar("T", bound=Versioned)


class Head(msgspec.Struct):
    """What every such file says of itself, whatever else a later version put into it."""

    format: str
    schema: int
    written_by: str = ""


@dataclass(frozen=True)
class Saved(Generic[T]):
    """A kind of file.

    Parameters
    ----------
    what
        Name of what is in it.
    source
        What to give instead of another file.
    kind
        Its record.
    latest
        The last schema that this version reads.
    most
        Largest size that is read [bytes].
    """

    what: str
    source: str
    kind: type[T]
    latest: int
    most: int = 1 << 20

    def read(self, path: str | os.PathLike[str]) -> T:
        """The record of a file.

        Raises
        ------
        DataError
            A file that cannot be read, is too large, is none of this kind, or is of a later version.
        """
        if not isinstance(path, (str, os.PathLike)):
            raise DataError(f"path = {shown(path)} is no path of a file; give {self.source}")
        file = Path(path)
        try:
            content = self._content(file)
        except DataError:
            raise
        except (OSError, ValueError) as error:
            # What no file system takes is not put into words as it is.
            name = str(file) if str(file).isprintable() and len(str(file)) <= LONGEST else shown(str(file), LONGEST)
            why = (error.strerror if isinstance(error, OSError) else None) or error
            raise DataError(f"{self.what} {name} cannot be read: {why}; check the path") from error
        try:
            return msgspec.json.decode(content, type=self.kind)
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            self._check_later(file, content)
            raise DataError(f"{file} is no ftlm {self.what}: {words_of(error, LONGEST)}; give {self.source}") from error

    def _content(self, file: Path) -> bytes:
        """All of a file that may be one of this kind."""
        state = file.stat()
        if not stat.S_ISREG(state.st_mode):
            raise DataError(f"{file} is no regular file; give {self.source}")
        if state.st_size > self.most:
            raise DataError(
                f"{file} has {state.st_size} bytes, no {self.what} is larger than {self.most}; give {self.source}"
            )
        return file.read_bytes()

    def _check_later(self, file: Path, content: bytes) -> None:
        """Say of a file that cannot be read whether a later version can."""
        try:
            head = msgspec.json.decode(content, type=Head)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            return
        if head.format == f"ftlm-{self.what}" and head.schema > self.latest:
            raise self._later(file, head.schema, head.written_by)

    def _later(self, path: str | os.PathLike[str], schema: int, writer: str = "") -> DataError:
        by = f", {shown(writer, LONGEST)}" if writer else ""
        return DataError(
            f"{path} is a {self.what} of a later version of ftlm{by}: it has schema {shown(schema)}, and this version, "
            f"{__version__}, reads up to {self.latest}; upgrade ftlm"
        )

    def check_schema(self, path: str | os.PathLike[str], read: Versioned, of: int) -> None:
        """Refuse what a later version wrote, and what says so and has nothing of it.

        Raises
        ------
        DataError
            A schema beyond the latest that this version reads, or beyond that of what is in the file.
        """
        if read.schema > self.latest:
            raise self._later(path, read.schema, getattr(read, "written_by", ""))
        if not 1 <= read.schema <= of:
            raise DataError(
                f"{path} says that it has schema {read.schema}, and what it holds has schema {of}; give {self.source}"
            )
