"""Checkpoint file of an order search: results of finished rounds, appended in frames under digests, by one writer.

The file begins with a signature. Frames follow, each of

====================  =================================================================================================
4 bytes               length of the payload, little-endian
4 bytes               CRC-32 of those 4 bytes and of the frame's offset in the file (8 bytes, little-endian)
length bytes          payload: one MessagePack map, whose key ``type`` names its kind
16 bytes              BLAKE2b of the previous digest (zeros for the first frame), the length and the payload
====================  =================================================================================================

The first payload is :class:`Requests`: all arguments and data of the searches, so that they can be resumed without the
measured files. A search of one equation then appends :class:`PartialRounds` (a block of rounds with a resumption point)
and :class:`Rounds` (a finished block); a search under an order law appends :class:`Verdicts` (a finished block of
candidates) and, at its end, :class:`CoupledTable`. Frames are only appended, and a digest covers all frames before its
own: a frame that was lost, moved or changed is detected. An incomplete frame at the end of the file is what a power
failure leaves, and is dropped. Any other incomplete frame is damage, which is reported with its offset.
"""

from __future__ import annotations

import bisect
import contextlib
import errno
import hashlib
import math
import os
import stat
import struct
import time
import weakref
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Annotated, Literal, cast

import msgspec
import numpy as np

from ftlm import _core
from ftlm._core import __version__
from ftlm.errors import DataError, ModelError
from ftlm.simulation.discretization import Record
from ftlm.structure.structure import Offset, Structure, check_initial
from ftlm.utils.files import write_atomically
from ftlm.utils.parameters import parameter

FILE_SIGNATURE = b"ftlm search store 1\n"
HEADER_FORMAT = struct.Struct("<II")
DIGEST_BYTES = 16
#: Version of the search algorithm. Rounds of different versions must not be joined.
ALGORITHM_VERSION = 6
#: Earlier versions whose partial searches can be resumed if the rounds of the search are the same in both versions.
#: Version 2 excludes boxes on grids of 2²⁵ candidates or more, with longer rounds. Version 3 has sharper boxes, also
#: for squared equation errors. Version 4 has tighter bounds of simulations from 2¹⁸ candidates on. Version 5 bounds
#: simulations by coefficients that cancel, and constructs boxes by the coefficients of all of their candidates. Version
#: 6 applies these bounds to multi-innovation.
RESUMABLE_ALGORITHMS = (1, 2, 3, 4, 5)
#: Maximum payload [bytes]; a table of 100 000 rows with many coefficients is far smaller.
MAX_PAYLOAD = 1 << 30
Natural = Annotated[int, msgspec.Meta(ge=0, le=(1 << 63) - 1)]
Row = tuple[Natural, float, tuple[float, ...], tuple[tuple[float, ...], ...]]
#: Counts: candidates, kept, beaten, bounded, stopped early, singular, diverged; of the bounded those in boxes, if any.
Counts = Annotated[tuple[Natural, ...], msgspec.Meta(min_length=7, max_length=8)]


def finished_count(counts: Counts) -> int:
    """Return the number of candidates that are kept or excluded; those excluded in boxes are among the bounded."""
    return sum(counts[1:7])


Failures = tuple[tuple[Natural, bool], ...]
#: Rows (index, raw score, coefficients, initial terms by record), counts, failures (index, whether diverged).
Part = tuple[tuple[Row, ...], Counts, Failures]
#: Round, candidates followed, end and length of the batch, its limit.
Place = tuple[Natural, Natural, Natural, Natural, float]
#: Point of resumption of a partial block with the digest of the visiting order, whether it was restarted, and its part.
Checkpoint = tuple[tuple[Natural, Natural, Natural, Natural, float, Natural], bool, Part]
#: Equation, first candidate, end (exclusive), limit.
Span = tuple[int, int, int, float]
#: Results of candidates under an order law: values and kinds (see :class:`Verdicts`).
Outcomes = tuple[bytes, bytes]


#: Maximum number of initial states of a sensor filter in a record.
MAX_FILTER_STATES = 10


class RecordFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Record on file: pulse means as little-endian doubles, row by row; an offset is written only if present."""

    signals: tuple[str, ...]
    step: float
    shape: tuple[int, int]
    means: bytes
    inputs: tuple[bool, ...]
    sensor: bytes | None
    initial: str | tuple[float, ...]
    offset: Offset = "none"
    states: int = 0

    @classmethod
    def of(cls, record: Record) -> RecordFile:
        """Serialize a record."""
        sensor = None if record.sensor is None else np.ascontiguousarray(record.sensor, "<f8").tobytes()
        rows, m = record.means.shape
        means = np.ascontiguousarray(record.means, "<f8").tobytes()
        return cls(
            record.signals,
            float(record.step),
            (rows, m),
            means,
            record.inputs,
            sensor,
            record.initial,
            record.offset,
            record.states,
        )

    def record(self) -> Record:
        """Deserialize the record; raise ModelError if its sizes are inconsistent."""
        rows, m = self.shape
        sizes = (len(self.signals), len(self.inputs), len(self.means))
        if rows < 1 or m < 1 or sizes != (rows, rows, 8 * rows * m) or len(self.sensor or b"") % 8:
            raise ModelError("the sizes of a record do not fit one another")
        if not 0 <= self.states <= (0 if self.sensor is None else MAX_FILTER_STATES):
            raise ModelError(f"a record with {self.states} states of its sensor filter")
        means = np.frombuffer(self.means, "<f8").astype(np.float64).reshape(rows, m)
        sensor = None if self.sensor is None else np.frombuffer(self.sensor, "<f8").astype(np.float64)
        return Record(
            self.signals, self.step, means, self.inputs, sensor, check_initial(self.initial), self.offset, self.states
        )


class Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Definition of one search: its data and settings, and the name of its result."""

    name: str
    structure: Structure
    values: dict[str, tuple[float, ...]]
    settings: dict[str, str | int | float | bool | None]
    records: tuple[RecordFile, ...]
    runs: tuple[str, ...]
    units: dict[str, str]

    def difference(self, other: Request) -> str | None:
        """Describe the difference to another request, or return None."""
        if [r.offset for r in self.records] != [r.offset for r in other.records]:
            return "another offset"
        if self.records != other.records:
            return "other data"
        if self.structure.equations != other.structure.equations:
            return "another equation"
        if self.values != other.values:
            return "another lattice"
        changed = [n for n in self.settings if self.settings[n] != other.settings.get(n)]
        if changed:
            return "other settings: " + ", ".join(f"{n} = {self.settings[n]}" for n in changed)
        return None


class Requests(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="requests"):
    """The first frame."""

    algorithm: int
    version: str
    requests: tuple[Request, ...]


class PartialRounds(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="progress"):
    """Partly evaluated block of rounds; rows are those found since the previous frame, failures None if unchanged.

    If the block was restarted, earlier frames are void. ``order`` is the digest of the visiting order; 0, in older
    files, means none.
    """

    search: Natural
    first: Natural
    last: Natural
    place: Place
    rows: tuple[Row, ...]
    counts: Counts
    failures: Failures | None
    order: Natural = 0
    anew: bool = False


class Rounds(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="rounds"):
    """Block of rounds, complete."""

    search: Natural
    first: Natural
    last: Natural
    part: Part


class Verdicts(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="verdicts"):
    """Block of candidates of a search under an order law, in its order, complete.

    Values are raw sums as little-endian doubles. One byte each of kinds gives their meaning: 0 the whole record, 1 a
    bound, 2 a partial sum, 3 singular, 4 diverged.
    """

    search: Natural
    first: Natural
    last: Natural
    values: bytes
    kinds: bytes


#: Index, score, free orders, and of each equation score, alpha, orders, coefficients, initial terms by record.
StagePart = tuple[float, float, tuple[float, ...], tuple[float, ...], tuple[tuple[float, ...], ...]]
StageRow = tuple[Natural, float, tuple[float, ...], tuple[StagePart, ...]]
#: Index, free orders, reason.
StageFailure = tuple[Natural, tuple[float, ...], Literal["singular", "diverged"]]


class CoupledTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="joined"):
    """Final table of a search under an order law: rows, counts by reason, first failures."""

    search: Natural
    rows: tuple[StageRow, ...]
    counts: dict[str, Natural]
    failures: tuple[StageFailure, ...]


Frame = PartialRounds | Rounds | Verdicts | CoupledTable
FRAME_DECODER = msgspec.msgpack.Decoder(Requests | Frame)
FRAME_ENCODER = msgspec.msgpack.Encoder()


def _length_checksum(length: bytes, offset: int) -> int:
    return zlib.crc32(length + struct.pack("<Q", offset))


def _digest(before: bytes, length: bytes, payload: bytes) -> bytes:
    return hashlib.blake2b(before + length + payload, digest_size=DIGEST_BYTES).digest()


def encode_frame(payload: bytes, offset: int, before: bytes) -> tuple[bytes, bytes]:
    """Return the bytes of a frame and its digest."""
    length = struct.pack("<I", len(payload))
    digest = _digest(before, length, payload)
    return length + struct.pack("<I", _length_checksum(length, offset)) + payload + digest, digest


def next_frame(data: memoryview, offset: int, before: bytes) -> tuple[bytes, bytes, int] | str:
    """Return payload, digest and end of the frame at an offset, or the error: "torn" or a message."""
    rest = len(data) - offset
    if rest < HEADER_FORMAT.size:
        return "torn"
    length, check = HEADER_FORMAT.unpack_from(data, offset)
    if check != _length_checksum(bytes(data[offset : offset + 4]), offset):
        # Blocks that were set aside and never written read as zeros.
        return "torn" if not any(data[offset:]) else f"the frame at byte {offset} has a damaged length"
    end = offset + HEADER_FORMAT.size + length + DIGEST_BYTES
    if length > MAX_PAYLOAD:
        return f"the frame at byte {offset} has a length of {length} bytes"
    if end > len(data):
        return "torn"
    payload = bytes(data[offset + HEADER_FORMAT.size : end - DIGEST_BYTES])
    digest = bytes(data[end - DIGEST_BYTES : end])
    if digest != _digest(before, bytes(data[offset : offset + 4]), payload):
        return "torn" if end == len(data) else f"the frame at byte {offset} does not match its digest"
    return payload, digest, end


#: Maximum size of a checkpoint file. The largest search under an order law needs less than a tenth.
MAX_FILE_BYTES = 4 << 30


@dataclass(frozen=True)
class FileKind:
    """Name of a kind of checkpoint file, and its file signature."""

    name: str
    magic: bytes


#: Checkpoint files of an order search and of a structure selection.
SEARCH_FILE, SELECTION_FILE = FILE_KINDS = (
    FileKind("search", FILE_SIGNATURE),
    FileKind("selection", b"ftlm selection store 1\n"),
)


def check_file(path: str | os.PathLike[str], handle: int, kind: FileKind) -> None:
    """Raise DataError for a path that is no regular file, another format, or too large, before it is read."""
    status = os.fstat(handle)
    if not stat.S_ISREG(status.st_mode):
        raise DataError(f"store {path} is no regular file; choose another file")
    begins = os.read(handle, max(len(k.magic) for k in FILE_KINDS))
    other = next((k.name for k in FILE_KINDS if k != kind and begins.startswith(k.magic)), None)
    if other is not None:
        raise DataError(
            f"{path} is the store of a {other}, not of a {kind.name}; go on with it by the call that began it"
        )
    if not kind.magic.startswith(begins[: len(kind.magic)]):
        raise DataError(f"{path} is no ftlm {kind.name} store; give a file written with {parameter('store')}")
    if status.st_size > MAX_FILE_BYTES:
        raise DataError(
            f"{path} has {status.st_size} bytes, more than the {MAX_FILE_BYTES} of the largest store; start the "
            f"{kind.name} "
            "again in another file"
        )
    os.lseek(handle, 0, os.SEEK_SET)


#: Errors of a lock that another process has: of POSIX, and of Windows.
_IN_USE_ERRORS = {errno.EWOULDBLOCK, errno.EAGAIN} | ({errno.EACCES, errno.EDEADLK} if os.name == "nt" else set())


class FrameFile:
    """Checkpoint file, locked until closed; without `create` it must exist.

    New frames are appended at `end` and chained to the `digest` of the previous frame. The reader of the file sets both
    to the end of the last intact frame.
    """

    def __init__(self, path: str | os.PathLike[str], kind: FileKind, *, create: bool) -> None:
        self.path, self.kind = Path(path), kind
        self.end, self.digest = 0, bytes(DIGEST_BYTES)
        # A pipe that nobody reads would keep the open waiting.
        flags = os.O_RDWR | getattr(os, "O_NONBLOCK", 0) | (os.O_CREAT if create else 0) | getattr(os, "O_BINARY", 0)
        try:
            self.handle = os.open(self.path, flags | getattr(os, "O_CLOEXEC", 0), 0o666)
            _OPEN_FILES.add(self)
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) else None
            raise DataError(f"store {self.path} cannot be opened: {why or error}; choose another file") from error
        try:
            check_file(self.path, self.handle, kind)
            self._lock()
        except BaseException:
            self.close()
            raise

    def _lock(self) -> None:
        """Lock the file against other writers."""
        try:
            if os.name == "nt":
                import msvcrt  # noqa: PLC0415

                os.lseek(self.handle, 1 << 40, os.SEEK_SET)
                msvcrt.locking(self.handle, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]
            else:
                import fcntl  # noqa: PLC0415

                fcntl.flock(self.handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in _IN_USE_ERRORS:
                name = errno.errorcode.get(error.errno or 0, "unknown error")
                raise DataError(
                    f"store {self.path} cannot be locked ({name}: {error.strerror}); choose a file on another file "
                    "system, such as a local disk"
                ) from error
            raise DataError(
                f"store {self.path} is in use by another {self.kind.name}; wait for it, stop it, or choose another file"
            ) from error

    def read(self) -> bytes:
        """Return all bytes of the file."""
        os.lseek(self.handle, 0, os.SEEK_SET)
        return b"".join(iter(lambda: os.read(self.handle, 1 << 20), b""))

    def has_no_frame(self, data: bytes) -> bool:
        """Whether a file is empty, or has an incomplete first frame only."""
        magic = self.kind.magic
        if not data.startswith(magic):
            return magic.startswith(data)
        return next_frame(memoryview(data), len(magic), bytes(DIGEST_BYTES)) == "torn"

    def begin(self, payload: bytes) -> bytes:
        """Write the first frame and return the bytes of the file."""
        frame, digest = encode_frame(payload, len(self.kind.magic), bytes(DIGEST_BYTES))
        self.end = 0
        self._write(self.kind.magic + frame)
        self.digest = digest
        self._sync_folder()
        return self.kind.magic + frame

    def append(self, payloads: Sequence[bytes]) -> None:
        """Append frames and flush them to disk."""
        data, digest, offset = [], self.digest, self.end
        for payload in payloads:
            piece, digest = encode_frame(payload, offset, digest)
            data.append(piece)
            offset += len(piece)
        self._write(b"".join(data))
        self.digest = digest

    def truncate(self) -> None:
        """Truncate the file at the end of the last intact frame."""
        with self._rollback_on_error():
            os.ftruncate(self.handle, self.end)
            os.fsync(self.handle)

    @contextlib.contextmanager
    def _rollback_on_error(self) -> Iterator[None]:
        """Truncate the file to its previous end if writing fails, and raise DataError."""
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
        with self._rollback_on_error():
            os.lseek(self.handle, self.end, os.SEEK_SET)
            left = memoryview(data)
            while left:
                left = left[os.write(self.handle, left) :]
            os.fsync(self.handle)
        self.end += len(data)

    def close(self) -> None:
        """Close the file and release the lock."""
        _OPEN_FILES.discard(self)
        if self.handle >= 0:
            os.close(self.handle)
            self.handle = -1


_OPEN_FILES: weakref.WeakSet[FrameFile] = weakref.WeakSet()


def _close_in_child() -> None:
    """Close the files of the parent, whose locks a forked child would hold beyond the parent's end."""
    for file in list(_OPEN_FILES):
        file.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_close_in_child)


@dataclass
class PartialBlock:
    """Partly evaluated block of rounds, with all rows found since its start."""

    last: int
    place: Place
    order: int
    rows: list[Row]
    counts: Counts
    failures: Failures

    @property
    def checkpoint(self) -> Checkpoint:
        """Point of resumption, as an argument of the core."""
        return (*self.place, self.order), False, (tuple(self.rows), self.counts, self.failures)


@dataclass
class Section:
    """Progress of one search: blocks (of rounds, or of candidates under an order law), complete or partial.

    Both are indexed by their first round or candidate.
    """

    law: bool = False
    frames: dict[int, Rounds | Verdicts] = field(default_factory=dict)
    open: dict[int, PartialBlock] = field(default_factory=dict)
    table: CoupledTable | None = None
    _firsts: list[int] = field(default_factory=list)

    def add_frame(self, frame: Frame) -> None:
        """Add a frame; raise ModelError for a duplicate, an empty block, or another kind of search."""
        if self.table is not None or (isinstance(frame, CoupledTable) and not self.law):
            raise ModelError("a table stands where none belongs")
        if isinstance(frame, CoupledTable):
            self.table = frame
            return
        if frame.first >= frame.last or isinstance(frame, Verdicts) != self.law:
            raise ModelError(f"rounds {frame.first} to {frame.last} are no stretch")
        place = bisect.bisect_left(self._firsts, frame.last)
        if place and self.frames[self._firsts[place - 1]].last > frame.first:
            raise ModelError(f"rounds {frame.first} to {frame.last} are there twice")
        if isinstance(frame, PartialRounds):
            self._add_partial_rounds(frame)
            return
        count = frame.last - frame.first
        if isinstance(frame, Verdicts) and (len(frame.values), len(frame.kinds)) != (8 * count, count):
            raise ModelError(f"candidates {frame.first} to {frame.last} have other verdicts")
        self.open.pop(frame.first, None)
        self.frames[frame.first] = frame
        self._firsts.insert(place, frame.first)

    def _add_partial_rounds(self, frame: PartialRounds) -> None:
        half = self.open.get(frame.first)
        if not frame.first <= frame.place[0] < frame.last or (half is not None and half.last != frame.last):
            raise ModelError(f"rounds {frame.first} to {frame.last} are continued as something else")
        _, followed, end, size, limit = frame.place
        if not (followed <= end and size >= (end > 0) and not math.isnan(limit)):
            raise ModelError(f"rounds {frame.first} to {frame.last} stand nowhere")
        if half is None or frame.anew:
            half = self.open[frame.first] = PartialBlock(frame.last, frame.place, frame.order, [], frame.counts, ())
        half.place, half.order, half.counts = frame.place, frame.order, frame.counts
        half.rows.extend(frame.rows)
        half.failures = half.failures if frame.failures is None else frame.failures

    @property
    def processed_count(self) -> int:
        """Number of candidates evaluated or excluded."""
        done = (len(f.kinds) if isinstance(f, Verdicts) else finished_count(f.part[1]) for f in self.frames.values())
        return sum(done) + sum(finished_count(half.counts) for half in self.open.values())

    @property
    def best(self) -> float | None:
        """Smallest raw score so far, for the search of one equation."""
        rows = [row for frame in self.frames.values() if isinstance(frame, Rounds) for row in frame.part[0]]
        return min((row[1] for row in (*rows, *(r for half in self.open.values() for r in half.rows))), default=None)


@dataclass
class Contents:
    """Contents of a checkpoint file."""

    requests: tuple[Request, ...]
    sections: list[Section]
    version: str
    algorithm: int
    #: Offset after the last intact frame, and that frame's digest.
    end: int
    digest: bytes
    #: Number of bytes after it, left by a power cut or a kill, or being written.
    truncated_bytes: int = 0
    #: Description of corrupt data with its offset; None for an intact file.
    corruption: str | None = None


def read_store(path: str | os.PathLike[str]) -> Contents:
    """Read the intact part of a checkpoint file, which may be in use."""
    try:
        # A pipe that nobody writes to would keep the open waiting.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        with os.fdopen(handle, "rb") as stream:
            check_file(path, handle, SEARCH_FILE)
            data = stream.read()
    except DataError:
        raise
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else None
        raise DataError(f"store {path} cannot be read: {why or error}; check the path") from error
    return contents_of(path, memoryview(data))


def contents_of(path: str | os.PathLike[str], data: memoryview) -> Contents:
    """Parse the bytes of a checkpoint file; raise DataError for another file, no first frame, or a later version."""
    start = bytes(data[: len(FILE_SIGNATURE)])
    if not FILE_SIGNATURE.startswith(start):
        raise DataError(f"{path} is no ftlm search store; give a file written with {parameter('store')}")
    contents: Contents | None = None
    offset, digest = len(FILE_SIGNATURE), bytes(DIGEST_BYTES)
    while offset < len(data):
        got = next_frame(data, offset, digest)
        if isinstance(got, str):
            if contents is None:
                why = "it ends before its first frame does" if got == "torn" else got
                raise DataError(f"{path} cannot be used: {why}; start the search again in another file")
            contents.truncated_bytes = len(data) - offset if got == "torn" else 0
            contents.corruption = None if got == "torn" else got
            break
        payload, digest, end = got
        try:
            frame = FRAME_DECODER.decode(payload)
            if contents is None:
                contents = _contents_of_requests(frame, end, digest)
            elif isinstance(frame, Requests):
                raise ModelError("requests stand twice")
            else:
                if frame.search >= len(contents.sections):
                    raise ModelError(f"there is no search {frame.search}")
                contents.sections[frame.search].add_frame(frame)
        except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError) as error:
            raise DataError(
                f"{path} holds something else at byte {offset}: {error}; start the search again in another file"
            ) from error
        offset = end
        contents.end, contents.digest = end, digest
    if contents is None:
        raise DataError(
            f"{path} ends before its first frame: its search had not begun; start it again with {parameter('store')}"
        )
    return contents


def _contents_of_requests(frame: Requests | Frame, end: int, digest: bytes) -> Contents:
    if not isinstance(frame, Requests) or not frame.requests:
        raise ModelError("the first frame holds no request")
    sections = [Section(law=r.structure.has_order_law) for r in frame.requests]
    return Contents(frame.requests, sections, frame.version, frame.algorithm, end, digest)


#: Maximum time between two writes, each flushed to disk. Less than a second of work is lost on a crash.
FLUSH_INTERVAL_S = 0.3


class Store:
    """Checkpoint file opened for writing, locked until closed; results are on disk within :data:`FLUSH_INTERVAL_S`.

    The requests are the searches of a new file, or those that an existing file must contain; None accepts those of the
    file. With `salvage` the intact frames of a corrupt file are used, and a copy of the corrupt file is kept beside it.
    """

    def __init__(
        self, path: str | os.PathLike[str], requests: Sequence[Request] | None = None, *, recover: bool = False
    ) -> None:
        self.path = Path(path)
        #: Descriptions of repairs.
        self.notes: list[str] = []
        self._last = time.monotonic()
        #: By search and first round: frames not written yet, and the failures written last.
        self._waiting: dict[tuple[int, int], PartialRounds] = {}
        self._failures: dict[tuple[int, int], Failures | None] = {}
        self._log = FrameFile(path, SEARCH_FILE, create=requests is not None)
        try:
            self._begin(requests, recover=recover)
        except BaseException:
            self._log.close()
            raise

    def _begin(self, requests: Sequence[Request] | None, *, recover: bool) -> None:
        data = self._log.read()
        if requests is not None and self._log.has_no_frame(data):
            # A payload read back must be the one asked for: what would not survive is found before any work.
            payload = FRAME_ENCODER.encode(Requests(ALGORITHM_VERSION, __version__, tuple(requests)))
            data = self._log.begin(payload)
        self.contents = held = contents_of(self.path, memoryview(data))
        if requests is not None:
            self._check_same(requests, held.requests)
        self._log.end, self._log.digest = held.end, held.digest
        if held.corruption is not None:
            self._recover(data, recover=recover)
        elif held.truncated_bytes:
            self.notes.append(f"{held.truncated_bytes} bytes of an unfinished write at byte {held.end} were dropped")
        if held.end < len(data):
            self._log.truncate()

    def _check_same(self, asked: Sequence[Request], held: Sequence[Request]) -> None:
        if [r.name for r in asked] != [r.name for r in held]:
            names = ", ".join(r.name for r in held)
            raise DataError(f"store {self.path} holds searches of {names}; choose another file")
        for one, other in zip(asked, held, strict=True):
            difference = one.difference(other)
            if difference is not None:
                raise DataError(
                    f"store {self.path} holds another search of {one.name} (asked is {difference}); choose another file"
                )

    def _recover(self, data: bytes, *, recover: bool) -> None:
        lost = len(data) - self.contents.end
        if not recover:
            raise DataError(
                f"store {self.path} is damaged: {self.contents.corruption}; {lost} bytes from there on cannot be "
                f"trusted: resume with {parameter('recover', True)} to keep what stands before and compute the rest "
                "again"
            )
        copy = self.path.with_name(self.path.name + ".damaged")
        write_atomically(copy, data, force=False)
        self.notes.append(f"{lost} damaged bytes from byte {self.contents.end} on were dropped; {copy} keeps them")
        self.contents.corruption = None

    def outdated_error(self) -> DataError:
        """Return the error of a search that another version began and this one cannot resume."""
        held = self.contents
        return DataError(
            f"store {self.path} is of ftlm {held.version}, whose rounds follow algorithm {held.algorithm}; this "
            f"version's is {ALGORITHM_VERSION}: finish the search with that version, or start it again in another "
            "file"
        )

    def _append(self, added: Sequence[Frame]) -> None:
        held = self.contents
        if held.algorithm not in (ALGORITHM_VERSION, *RESUMABLE_ALGORITHMS):
            # A finished search is only read, whatever made it.
            raise self.outdated_error()
        self._log.append([FRAME_ENCODER.encode(frame) for frame in added])
        self._last = time.monotonic()
        for frame in added:
            self.contents.sections[frame.search].add_frame(frame)

    def save(self, search: int, first: int, last: int, checkpoint: Checkpoint | None) -> None:
        """Note the progress of a block of rounds; it is written with others, or when the flush interval ends."""
        if checkpoint is not None:
            (*place, order), anew, (rows, counts, failures) = checkpoint
            before = self._waiting.get((search, first))
            rows = (*(before.rows if before else ()), *rows)
            anew = anew or (before is not None and before.anew)
            told = cast("Place", tuple(place))
            self._waiting[search, first] = PartialRounds(search, first, last, told, rows, counts, failures, order, anew)
        if time.monotonic() - self._last >= FLUSH_INTERVAL_S:
            self.flush()

    def flush(self) -> None:
        """Write all pending frames."""
        due = []
        for key, frame in self._waiting.items():
            same = not frame.anew and self._failures.get(key) == frame.failures
            due.append(msgspec.structs.replace(frame, failures=None) if same else frame)
            self._failures[key] = frame.failures
        self._waiting.clear()
        if due:
            self._append(due)

    def append_block(self, frame: Rounds | Verdicts) -> None:
        """Append a complete block."""
        self._waiting.pop((frame.search, frame.first), None)
        self._failures.pop((frame.search, frame.first), None)
        self._append([frame])

    def append_table(self, search: int, table: _core._FoundStage) -> None:
        """Append the final table of a search under an order law."""
        frame = {"type": "joined", "search": search, **{k: table[k] for k in ("rows", "counts", "failures")}}
        self._append([msgspec.convert(frame, CoupledTable)])

    def close(self) -> None:
        """Write pending frames and release the lock."""
        try:
            self.flush()
        finally:
            self._log.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None and issubclass(kind, DataError):
            # Writing failed: what waits would fail too, and hide why.
            self._waiting.clear()
        self.close()
