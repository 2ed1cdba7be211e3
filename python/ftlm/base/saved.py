"""JSON files that ftlm wrote, read back: of which size, of which kind, of which schema."""

from __future__ import annotations

import os
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Protocol, TypeVar

import msgspec

from ftlm.base.checks import shown, words_of
from ftlm.base.errors import DataError

#: Longest name of a file in a message.
LONGEST = 300


class Versioned(Protocol):
    """What stands in such a file."""

    schema: int


T = TypeVar("T", bound=Versioned)


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
    most
        Largest size that is read [bytes].
    """

    what: str
    source: str
    kind: type[T]
    most: int = 1 << 20

    def read(self, path: str | os.PathLike[str]) -> T:
        """The record of a file.

        Raises
        ------
        DataError
            A file that cannot be read, is too large, or is none of this kind.
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

    @staticmethod
    def check_schema(path: str | os.PathLike[str], read: Versioned, latest: int) -> None:
        """Refuse what a later version wrote.

        Raises
        ------
        DataError
            A schema beyond the latest that this version reads.
        """
        if not 1 <= read.schema <= latest:
            raise DataError(f"{path} has schema {read.schema}, this version reads up to {latest}; upgrade ftlm")
