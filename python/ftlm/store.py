"""The store of a search: what its rounds came to, appended as they end, under digests, one writer at a time.

A store is one file. It opens with :data:`MAGIC`; frames follow, each of

====================  =================================================================================================
4 bytes               length of the payload, little-endian
4 bytes               CRC-32 of those 4 bytes and of the frame's offset in the file (8 bytes, little-endian)
length bytes          payload: one MessagePack map whose key ``type`` says what it is
16 bytes              BLAKE2b of the digest before (zeros for the first frame), the length and the payload
====================  =================================================================================================

The first payload holds the requests (:class:`Requests`): everything a search is computed from, so that it can be
resumed without the files it came from. Then come, for a search of one equation, :class:`Progress` (a stretch of rounds,
half done) and :class:`Rounds` (a stretch, done); for one under an order law :class:`Verdicts` (a stretch of candidates,
done) and at its end :class:`Joined` (its table). Frames are only appended; a digest covers all frames before its own,
so that none can be lost, moved or changed unseen. A frame that reaches to or past the end of the file and is not whole
is what a power cut leaves: it is dropped. Any other frame that is not whole is damage, reported with its offset.
"""

from __future__ import annotations

import bisect
import contextlib
import hashlib
import math
import os
import struct
import time
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import numpy as np

from ftlm.errors import DataError, ModelError
from ftlm.models import Structure

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import TracebackType

    from ftlm import _core
    from ftlm.records import Record

__all__ = [
    "MAGIC",
    "Contents",
    "Joined",
    "Progress",
    "Request",
    "Requests",
    "Rounds",
    "Store",
    "Verdicts",
    "read_store",
]

MAGIC = b"ftlm search store 1\n"
HEAD = struct.Struct("<II")
DIGEST = 16
#: Number of the algorithm that rounds follow; rounds of different ones must not be joined.
ALGORITHM = 1
#: Longest time [s] between two writes, each flushed to disk: with the time between checkpoints, under a second is lost.
INTERVAL = 0.3
#: Largest payload: a table of 100 000 rows of many coefficients is far below.
MAX_PAYLOAD = 1 << 30

Natural = Annotated[int, msgspec.Meta(ge=0, le=(1 << 63) - 1)]
Row = tuple[Natural, float, tuple[float, ...], tuple[tuple[float, ...], ...]]
Counts = tuple[Natural, Natural, Natural, Natural, Natural, Natural, Natural]
Failures = tuple[tuple[Natural, bool], ...]
#: Rows (index, raw score, coefficients, initial terms by record), counts, failures (index, whether diverged).
Part = tuple[tuple[Row, ...], Counts, Failures]
#: Round, candidates followed, end and length of the batch, its limit.
Place = tuple[Natural, Natural, Natural, Natural, float]


class RecordFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A record: pulse means as little-endian doubles, row by row."""

    signals: tuple[str, ...]
    step: float
    shape: tuple[int, int]
    means: bytes
    inputs: tuple[bool, ...]
    sensor: bytes | None
    initial: str | tuple[float, ...]

    @classmethod
    def of(cls, record: Record) -> RecordFile:
        """Write a record."""
        sensor = None if record.sensor is None else np.ascontiguousarray(record.sensor, "<f8").tobytes()
        rows, m = record.means.shape
        means = np.ascontiguousarray(record.means, "<f8").tobytes()
        return cls(record.signals, float(record.step), (rows, m), means, record.inputs, sensor, record.initial)

    def record(self) -> Record:
        """Give the record back.

        Raises
        ------
        ModelError
            Sizes that do not fit one another.
        """
        from ftlm.models import check_initial  # noqa: PLC0415 — with records, after the store
        from ftlm.records import Record  # noqa: PLC0415

        rows, m = self.shape
        sizes = (len(self.signals), len(self.inputs), len(self.means))
        if rows < 1 or m < 1 or sizes != (rows, rows, 8 * rows * m) or len(self.sensor or b"") % 8:
            raise ModelError("the sizes of a record do not fit one another")
        means = np.frombuffer(self.means, "<f8").astype(np.float64).reshape(rows, m)
        sensor = None if self.sensor is None else np.frombuffer(self.sensor, "<f8").astype(np.float64)
        return Record(self.signals, self.step, means, self.inputs, sensor, check_initial(self.initial))


class Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One search: what it is computed from, and what its result is called."""

    name: str
    structure: Structure
    values: dict[str, tuple[float, ...]]
    settings: dict[str, str | int | float | bool]
    records: tuple[RecordFile, ...]
    runs: tuple[str, ...]
    units: dict[str, str]

    def difference(self, other: Request) -> str | None:
        """Say what sets another request apart, or None."""
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


class Progress(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="progress"):
    """A stretch of rounds, half done; rows are those found since the frame before, failures None where unchanged."""

    search: Natural
    first: Natural
    last: Natural
    place: Place
    rows: tuple[Row, ...]
    counts: Counts
    failures: Failures | None


class Rounds(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="rounds"):
    """A stretch of rounds, done."""

    search: Natural
    first: Natural
    last: Natural
    part: Part


class Verdicts(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="verdicts"):
    """A stretch of the candidates that a search under an order law follows, in its order, done.

    Values are raw sums as little-endian doubles; a byte each of kinds tells of what: 0 the whole record, 1 a bound, 2 a
    partial sum, 3 singular, 4 diverged.
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


class Joined(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="joined"):
    """What a search under an order law came to: table, counts by reason, first failures."""

    search: Natural
    rows: tuple[StageRow, ...]
    counts: dict[str, Natural]
    failures: tuple[StageFailure, ...]


Frame = Progress | Rounds | Verdicts | Joined

_decoder = msgspec.msgpack.Decoder(Requests | Frame)
_encoder = msgspec.msgpack.Encoder()


@dataclass
class Half:
    """A stretch of rounds, half done, with all rows found since its start."""

    last: int
    place: Place
    rows: list[Row]
    counts: Counts
    failures: Failures

    @property
    def checkpoint(self) -> tuple[Place, Part]:
        """Where to go on, as the core takes it."""
        return self.place, (tuple(self.rows), self.counts, self.failures)


@dataclass
class Section:
    """What is known of one search: stretches done by their first round, and those half done.

    Under an order law: stretches of candidates followed, by the first.
    """

    law: bool = False
    done: dict[int, tuple[int, Part]] = field(default_factory=dict)
    open: dict[int, Half] = field(default_factory=dict)
    followed: dict[int, tuple[int, bytes, bytes]] = field(default_factory=dict)
    joined: Joined | None = None
    _firsts: list[int] = field(default_factory=list)

    def take(self, frame: Frame) -> None:
        """Take a frame in.

        Raises
        ------
        ModelError
            Rounds that are there already, a stretch that is none, or one of another kind of search.
        """
        if self.joined is not None or (isinstance(frame, Joined) and not self.law):
            raise ModelError("a table stands where none belongs")
        if isinstance(frame, Joined):
            self.joined = frame
            return
        stretches: dict[int, Any] = self.followed if self.law else self.done
        if frame.first >= frame.last or isinstance(frame, Verdicts) != self.law:
            raise ModelError(f"rounds {frame.first} to {frame.last} are no stretch")
        place = bisect.bisect_left(self._firsts, frame.last)
        if place and stretches[self._firsts[place - 1]][0] > frame.first:
            raise ModelError(f"rounds {frame.first} to {frame.last} are there twice")
        if isinstance(frame, Verdicts):
            count = frame.last - frame.first
            if (len(frame.values), len(frame.kinds)) != (8 * count, count):
                raise ModelError(f"candidates {frame.first} to {frame.last} have other verdicts")
            self.followed[frame.first] = (frame.last, frame.values, frame.kinds)
            self._firsts.insert(place, frame.first)
            return
        half = self.open.get(frame.first)
        if isinstance(frame, Rounds):
            self.open.pop(frame.first, None)
            self.done[frame.first] = (frame.last, frame.part)
            self._firsts.insert(place, frame.first)
            return
        if not frame.first <= frame.place[0] < frame.last or (half is not None and half.last != frame.last):
            raise ModelError(f"rounds {frame.first} to {frame.last} are continued as something else")
        _, followed, end, size, limit = frame.place
        if not (followed <= end and size >= (end > 0) and not math.isnan(limit)):
            raise ModelError(f"rounds {frame.first} to {frame.last} stand nowhere")
        if half is None:
            half = self.open[frame.first] = Half(frame.last, frame.place, [], frame.counts, ())
        half.place, half.counts = frame.place, frame.counts
        half.rows.extend(frame.rows)
        half.failures = half.failures if frame.failures is None else frame.failures

    @property
    def dealt(self) -> int:
        """Candidates dealt with."""
        if self.law:
            return sum(len(kinds) for _, _, kinds in self.followed.values())
        counted = [part[1] for _, part in self.done.values()] + [half.counts for half in self.open.values()]
        return sum(sum(counts[1:]) for counts in counted)

    @property
    def best(self) -> float | None:
        """Smallest raw score so far."""
        rows = [row for _, part in self.done.values() for row in part[0]]
        return min((row[1] for row in (*rows, *(r for half in self.open.values() for r in half.rows))), default=None)


@dataclass
class Contents:
    """What a store holds.

    Parameters
    ----------
    requests
        The searches.
    sections
        What is known of each.
    version
        Version of ftlm that made it.
    algorithm
        Number of the algorithm that its rounds follow.
    end
        Offset behind the last whole frame.
    digest
        Digest of that frame.
    torn
        Bytes behind it that a power cut or a kill left, or that are being written.
    damage
        What is damaged, with its offset, where frames or bytes follow that cannot be read; None for a whole store.
    """

    requests: tuple[Request, ...]
    sections: list[Section]
    version: str
    algorithm: int
    end: int
    digest: bytes
    torn: int = 0
    damage: str | None = None


def _check(length: bytes, offset: int) -> int:
    return zlib.crc32(length + struct.pack("<Q", offset))


def _digest(before: bytes, length: bytes, payload: bytes) -> bytes:
    return hashlib.blake2b(before + length + payload, digest_size=DIGEST).digest()


def _frame(payload: bytes, offset: int, before: bytes) -> tuple[bytes, bytes]:
    """Bytes of a frame and its digest."""
    length = struct.pack("<I", len(payload))
    digest = _digest(before, length, payload)
    return length + struct.pack("<I", _check(length, offset)) + payload + digest, digest


def _next(data: memoryview, offset: int, before: bytes) -> tuple[bytes, bytes, int] | str:
    """Payload, digest and end of the frame at an offset, or what is wrong: "torn" or words."""
    rest = len(data) - offset
    if rest < HEAD.size:
        return "torn"
    length, check = HEAD.unpack_from(data, offset)
    if check != _check(bytes(data[offset : offset + 4]), offset):
        # Blocks that were set aside and never written read as zeros.
        return "torn" if not any(data[offset:]) else f"the frame at byte {offset} has a damaged length"
    end = offset + HEAD.size + length + DIGEST
    if length > MAX_PAYLOAD:
        return f"the frame at byte {offset} has a length of {length} bytes"
    if end > len(data):
        return "torn"
    payload = bytes(data[offset + HEAD.size : end - DIGEST])
    digest = bytes(data[end - DIGEST : end])
    if digest != _digest(before, bytes(data[offset : offset + 4]), payload):
        return "torn" if end == len(data) else f"the frame at byte {offset} does not match its digest"
    return payload, digest, end


def read_store(path: str | os.PathLike[str]) -> Contents:
    """Read a store as far as it is whole; it may be in use.

    Raises
    ------
    DataError
        No such file, no store, one without its first frame, one of a later version.
    """
    try:
        data = Path(path).read_bytes()
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else None
        raise DataError(f"store {path} cannot be read: {why or error}; check the path") from error
    return _parse(path, memoryview(data))


def _parse(path: str | os.PathLike[str], data: memoryview) -> Contents:
    start = bytes(data[: len(MAGIC)])
    if start != MAGIC:
        if MAGIC.startswith(start):
            raise DataError(f"{path} ends before its first frame: its search had not begun; start it again with store=")
        raise DataError(f"{path} is no ftlm search store; give a file written with store= (--store)")
    found: Contents | None = None
    offset, digest = len(MAGIC), bytes(DIGEST)
    while offset < len(data):
        got = _next(data, offset, digest)
        if isinstance(got, str):
            if found is None:
                if got == "torn":
                    got = "it ends before its first frame does"
                raise DataError(f"{path} cannot be used: {got}; start the search again in another file")
            found.torn = len(data) - offset if got == "torn" else 0
            found.damage = None if got == "torn" else got
            break
        payload, digest, end = got
        try:
            frame = _decoder.decode(payload)
            if found is None:
                found = _opened(frame, end, digest)
            elif isinstance(frame, Requests):
                raise ModelError("requests stand twice")
            else:
                if frame.search >= len(found.sections):
                    raise ModelError(f"there is no search {frame.search}")
                found.sections[frame.search].take(frame)
        except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError) as error:
            raise DataError(
                f"{path} holds something else at byte {offset}: {error}; start the search again in another file"
            ) from error
        offset = end
        found.end, found.digest = end, digest
    if found is None:
        raise DataError(f"{path} ends before its first frame: its search had not begun; start it again with store=")
    return found


def _opened(frame: Requests | Frame, end: int, digest: bytes) -> Contents:
    if not isinstance(frame, Requests) or not frame.requests:
        raise ModelError("the first frame holds no request")
    sections = [Section(law=r.structure.has_order_law) for r in frame.requests]
    return Contents(frame.requests, sections, frame.version, frame.algorithm, end, digest)


class Store:
    """A store opened for writing: locked until it is closed; what is appended is on disk within :data:`INTERVAL`.

    Parameters
    ----------
    path
        The file.
    requests
        Searches of a new store, or what an existing one must hold; None takes what it holds.
    salvage
        Whether to go on with the whole frames of a damaged store; the damaged file is kept beside it.

    Raises
    ------
    DataError
        Another writer, another search, damage (with its offset), a file that cannot be written.
    """

    def __init__(
        self, path: str | os.PathLike[str], requests: Sequence[Request] | None = None, *, salvage: bool = False
    ) -> None:
        self.path = Path(path)
        #: What was mended, in words.
        self.notes: list[str] = []
        self._last = time.monotonic()
        self._waiting: dict[tuple[int, int], Progress] = {}
        self._failures: dict[tuple[int, int], Any] = {}
        flags = os.O_RDWR | (os.O_CREAT if requests is not None else 0) | getattr(os, "O_BINARY", 0)
        try:
            self._handle = os.open(self.path, flags | getattr(os, "O_CLOEXEC", 0), 0o666)
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) else None
            raise DataError(f"store {self.path} cannot be opened: {why or error}; choose another file") from error
        try:
            self._lock()
            self._begin(requests, salvage=salvage)
        except BaseException:
            os.close(self._handle)
            raise

    def _lock(self) -> None:
        try:
            if os.name == "nt":
                import msvcrt  # noqa: PLC0415

                os.lseek(self._handle, 1 << 40, os.SEEK_SET)
                msvcrt.locking(self._handle, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]
            else:
                import fcntl  # noqa: PLC0415

                fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise DataError(
                f"store {self.path} is in use by another search; wait for it, stop it, or choose another file"
            ) from error

    def _begin(self, requests: Sequence[Request] | None, *, salvage: bool) -> None:
        os.lseek(self._handle, 0, os.SEEK_SET)
        data = b"".join(iter(lambda: os.read(self._handle, 1 << 20), b""))
        fresh = requests is not None and _unbegun(data)
        if fresh:
            from ftlm._core import __version__  # noqa: PLC0415 — of the package that writes

            assert requests is not None
            payload = _encoder.encode(Requests(ALGORITHM, __version__, tuple(requests)))
            # A payload read back must be the one asked for: what would not survive is found before any work.
            frame, digest = _frame(payload, len(MAGIC), bytes(DIGEST))
            self._end = 0
            self._write(MAGIC + frame)
            self._digest = digest
            self._sync_folder()
            data = MAGIC + frame
        self.contents = _parse(self.path, memoryview(data))
        found = self.contents
        if requests is not None:
            if [r.name for r in requests] != [r.name for r in found.requests]:
                held = ", ".join(r.name for r in found.requests)
                raise DataError(f"store {self.path} holds searches of {held}; choose another file")
            for asked, held_request in zip(requests, found.requests, strict=True):
                difference = asked.difference(held_request)
                if difference is not None:
                    raise DataError(
                        f"store {self.path} holds another search of {asked.name} (asked is {difference}); "
                        "choose another file"
                    )
        self._end, self._digest = found.end, found.digest
        if found.damage is not None:
            self._salvage(data, salvage=salvage)
        elif found.torn:
            self.notes.append(f"{found.torn} bytes of an unfinished write at byte {found.end} were dropped")
        if found.end < len(data):
            self._truncate()

    def _salvage(self, data: bytes, *, salvage: bool) -> None:
        lost = len(data) - self.contents.end
        if not salvage:
            raise DataError(
                f"store {self.path} is damaged: {self.contents.damage}; {lost} bytes from there on cannot be trusted: "
                "resume with salvage=True (--salvage) to keep what stands before and compute the rest again"
            )
        from ftlm.models import write_atomically  # noqa: PLC0415

        copy = self.path.with_name(self.path.name + ".damaged")
        write_atomically(copy, data, force=False)
        self.notes.append(f"{lost} damaged bytes from byte {self.contents.end} on were dropped; {copy} keeps them")
        self.contents.damage = None

    def _truncate(self) -> None:
        try:
            os.ftruncate(self._handle, self._end)
            os.fsync(self._handle)
        except OSError as error:
            raise self._failed(error) from error

    def _failed(self, error: OSError) -> DataError:
        return DataError(
            f"store {self.path} cannot be written: {error.strerror or error}; what it holds is whole: make room, or "
            "move it to another folder, and resume it"
        )

    def _sync_folder(self) -> None:
        if os.name == "nt":
            return
        try:
            folder = os.open(self.path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
        except OSError:  # some file systems do not sync folders
            return

    def _write(self, data: bytes) -> None:
        """Append and flush to disk; a write that fails leaves the store as it was.

        Raises
        ------
        DataError
            A full disk, and whatever else the system says.
        """
        try:
            os.lseek(self._handle, self._end, os.SEEK_SET)
            left = memoryview(data)
            while left:
                left = left[os.write(self._handle, left) :]
            os.fsync(self._handle)
        except OSError as error:
            # Where even that fails the next reader drops the torn frame.
            with contextlib.suppress(OSError):
                os.ftruncate(self._handle, self._end)
            raise self._failed(error) from error
        self._end += len(data)
        self._last = time.monotonic()

    def _append(self, frames: Sequence[Frame]) -> None:
        found = self.contents
        if found.algorithm != ALGORITHM:
            # A finished search is only read, whatever made it.
            raise DataError(
                f"store {self.path} is of ftlm {found.version}, whose rounds follow algorithm {found.algorithm}; this "
                f"version's is {ALGORITHM}: finish the search with that version, or start it again in another file"
            )
        data, digest, offset = [], self._digest, self._end
        for frame in frames:
            payload = _encoder.encode(frame)
            piece, digest = _frame(payload, offset, digest)
            data.append(piece)
            offset += len(piece)
        self._write(b"".join(data))
        self._digest = digest
        for frame in frames:
            self.contents.sections[frame.search].take(frame)

    def save(self, search: int, first: int, last: int, checkpoint: tuple[Place, Part] | None) -> None:
        """Note how far a stretch of rounds is; it is written with others, or when it is time.

        Raises
        ------
        DataError
            As writing.
        """
        if checkpoint is not None:
            place, (rows, counts, failures) = checkpoint
            before = self._waiting.get((search, first))
            rows = (*(before.rows if before else ()), *rows)
            self._waiting[search, first] = Progress(search, first, last, place, rows, counts, failures)
        if time.monotonic() - self._last >= INTERVAL:
            self.flush()

    def flush(self) -> None:
        """Write what waits.

        Raises
        ------
        DataError
            As writing.
        """
        frames = []
        for key, frame in self._waiting.items():
            same = self._failures.get(key) == frame.failures
            frames.append(msgspec.structs.replace(frame, failures=None) if same else frame)
            self._failures[key] = frame.failures
        self._waiting.clear()
        if frames:
            self._append(frames)

    def done(self, search: int, first: int, last: int, part: Part) -> None:
        """Append a stretch of rounds that is done.

        Raises
        ------
        DataError
            As writing.
        """
        self._waiting.pop((search, first), None)
        self._failures.pop((search, first), None)
        self._append([Rounds(search, first, last, part)])

    def followed(self, search: int, first: int, last: int, values: bytes, kinds: bytes) -> None:
        """Append a stretch of candidates of a search under an order law.

        Raises
        ------
        DataError
            As writing.
        """
        self._append([Verdicts(search, first, last, values, kinds)])

    def joined(self, search: int, found: _core._FoundStage) -> None:
        """Append the table of a search under an order law.

        Raises
        ------
        DataError
            As writing.
        """
        frame = {"type": "joined", "search": search, **{k: found[k] for k in ("rows", "counts", "failures")}}
        self._append([msgspec.convert(frame, Joined)])

    def close(self) -> None:
        """Write what waits and give the lock back."""
        try:
            self.flush()
        finally:
            os.close(self._handle)

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None and issubclass(kind, DataError):
            # Writing failed: what waits would fail too, and hide why.
            self._waiting.clear()
        self.close()


def _unbegun(data: bytes) -> bool:
    """Whether a file is empty or what is left of a store whose first frame was never finished."""
    if len(data) < len(MAGIC):
        return MAGIC.startswith(data)
    return data.startswith(MAGIC) and _next(memoryview(data), len(MAGIC), bytes(DIGEST)) == "torn"
