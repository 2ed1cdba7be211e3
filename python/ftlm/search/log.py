"""A file of frames under digests, appended to by one writer at a time: stores of searches and of selections."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ftlm.base.errors import DataError
from ftlm.search import frames

#: Most bytes of a store: a layout of the largest search under a law takes under a tenth.
LARGEST = 4 << 30


@dataclass(frozen=True)
class Kind:
    """What a store is called, and the bytes that it opens with."""

    name: str
    magic: bytes


#: The stores of an order search and of a selection.
SEARCH, SELECTION = KINDS = (Kind("search", frames.MAGIC), Kind("selection", b"ftlm selection store 1\n"))


def check(path: str | os.PathLike[str], handle: int, kind: Kind) -> None:
    """Refuse what is no file, or none of ours, or too large to be one, before its gigabytes are read."""
    status = os.fstat(handle)
    if not stat.S_ISREG(status.st_mode):
        raise DataError(f"store {path} is no regular file; choose another file")
    begins = os.read(handle, max(len(k.magic) for k in KINDS))
    other = next((k.name for k in KINDS if k != kind and begins.startswith(k.magic)), None)
    if other is not None:
        raise DataError(
            f"{path} is the store of a {other}, not of a {kind.name}; go on with it by the call that began it"
        )
    if not kind.magic.startswith(begins[: len(kind.magic)]):
        raise DataError(f"{path} is no ftlm {kind.name} store; give a file written with store= (--store)")
    if status.st_size > LARGEST:
        raise DataError(
            f"{path} has {status.st_size} bytes, more than the {LARGEST} of the largest store; start the {kind.name} "
            "again in another file"
        )
    os.lseek(handle, 0, os.SEEK_SET)


class Log:
    """A store's file, locked until it is closed; without `create` it must be there.

    What is appended stands behind `end`, chained to the `digest` of the frame before it; whoever reads the file says
    where its last whole frame ends.
    """

    def __init__(self, path: str | os.PathLike[str], kind: Kind, *, create: bool) -> None:
        self.path, self.kind = Path(path), kind
        self.end, self.digest = 0, bytes(frames.DIGEST)
        # A pipe that nobody reads would keep the open waiting.
        flags = os.O_RDWR | getattr(os, "O_NONBLOCK", 0) | (os.O_CREAT if create else 0) | getattr(os, "O_BINARY", 0)
        try:
            self.handle = os.open(self.path, flags | getattr(os, "O_CLOEXEC", 0), 0o666)
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) else None
            raise DataError(f"store {self.path} cannot be opened: {why or error}; choose another file") from error
        try:
            check(self.path, self.handle, kind)
            self._lock()
        except BaseException:
            self.close()
            raise

    def _lock(self) -> None:
        """Keep other writers out."""
        try:
            if os.name == "nt":
                import msvcrt  # noqa: PLC0415

                os.lseek(self.handle, 1 << 40, os.SEEK_SET)
                msvcrt.locking(self.handle, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]
            else:
                import fcntl  # noqa: PLC0415

                fcntl.flock(self.handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise DataError(
                f"store {self.path} is in use by another {self.kind.name}; wait for it, stop it, or choose another file"
            ) from error

    def read(self) -> bytes:
        """All bytes of the file."""
        os.lseek(self.handle, 0, os.SEEK_SET)
        return b"".join(iter(lambda: os.read(self.handle, 1 << 20), b""))

    def unbegun(self, data: bytes) -> bool:
        """Whether a file is empty or what is left of a store whose first frame was never finished."""
        magic = self.kind.magic
        if not data.startswith(magic):
            return magic.startswith(data)
        return frames.next_frame(memoryview(data), len(magic), bytes(frames.DIGEST)) == "torn"

    def begin(self, payload: bytes) -> bytes:
        """Write the first frame; the bytes of the file."""
        frame, digest = frames.framed(payload, len(self.kind.magic), bytes(frames.DIGEST))
        self.end = 0
        self._write(self.kind.magic + frame)
        self.digest = digest
        self._sync_folder()
        return self.kind.magic + frame

    def append(self, payloads: Sequence[bytes]) -> None:
        """Write frames behind the last one, and flush to disk."""
        data, digest, offset = [], self.digest, self.end
        for payload in payloads:
            piece, digest = frames.framed(payload, offset, digest)
            data.append(piece)
            offset += len(piece)
        self._write(b"".join(data))
        self.digest = digest

    def cut(self) -> None:
        """Drop what stands behind the end."""
        with self._writing():
            os.ftruncate(self.handle, self.end)
            os.fsync(self.handle)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Leave the store as it was where writing fails, and say so."""
        try:
            yield
        except OSError as error:
            # Where even that fails the next reader drops the torn frame.
            with contextlib.suppress(OSError):
                os.ftruncate(self.handle, self.end)
            raise DataError(
                f"store {self.path} cannot be written: {error.strerror or error}; what it holds is whole: make room, "
                "or move it to another folder, and resume it"
            ) from error

    def _sync_folder(self) -> None:
        with contextlib.suppress(OSError):  # some file systems do not sync folders, and Windows opens none
            folder = os.open(self.path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)

    def _write(self, data: bytes) -> None:
        with self._writing():
            os.lseek(self.handle, self.end, os.SEEK_SET)
            left = memoryview(data)
            while left:
                left = left[os.write(self.handle, left) :]
            os.fsync(self.handle)
        self.end += len(data)

    def close(self) -> None:
        """Give the lock back."""
        os.close(self.handle)
