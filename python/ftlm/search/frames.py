"""Frames of a search store: what each holds, and the bytes around it."""

from __future__ import annotations

import bisect
import hashlib
import math
import struct
import zlib
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from ftlm.base.errors import ModelError
from ftlm.data.structures import Structure, check_initial
from ftlm.solve.records import Record

MAGIC = b"ftlm search store 1\n"
HEAD = struct.Struct("<II")
DIGEST = 16
#: Number of the algorithm that rounds follow; rounds of different ones must not be joined.
ALGORITHM = 1
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


#: Where to go on with a stretch that is half done.
Checkpoint = tuple[Place, Part]
#: Equation, first candidate, the one behind the last, limit.
Span = tuple[int, int, int, float]
#: What candidates came to: values and kinds (see :class:`Verdicts`).
Found = tuple[bytes, bytes]


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
DECODER = msgspec.msgpack.Decoder(Requests | Frame)
ENCODER = msgspec.msgpack.Encoder()


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


def framed(payload: bytes, offset: int, before: bytes) -> tuple[bytes, bytes]:
    """Bytes of a frame and its digest."""
    length = struct.pack("<I", len(payload))
    digest = _digest(before, length, payload)
    return length + struct.pack("<I", _check(length, offset)) + payload + digest, digest


def next_frame(data: memoryview, offset: int, before: bytes) -> tuple[bytes, bytes, int] | str:
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
