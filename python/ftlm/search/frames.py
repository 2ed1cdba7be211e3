"""Frames of a search store: what each holds, and the bytes around it."""

from __future__ import annotations

import hashlib
import struct
import zlib
from typing import Annotated, Literal

import msgspec
import numpy as np

from ftlm.base.errors import ModelError
from ftlm.data.structures import Offset, Structure, check_initial
from ftlm.solve.records import Record

MAGIC = b"ftlm search store 1\n"
HEAD = struct.Struct("<II")
DIGEST = 16
#: Number of the algorithm that rounds follow; rounds of different ones must not be joined.
ALGORITHM = 5
#: Earlier ones whose half-finished stores go on where the rounds of a search have not changed since: 2 screens lattices
#: of 2²⁵ candidates and more in boxes and in longer rounds, 3 in sharper boxes and by squared equation errors too, 4
#: proves free runs of 2¹⁸ candidates and more closely, 5 bounds free runs by coefficients that cancel and lays boxes by
#: the coefficients of all of their candidates; all leave the others as they were.
CONTINUED = (1, 2, 3, 4)
#: Largest payload: a table of 100 000 rows of many coefficients is far below.
MAX_PAYLOAD = 1 << 30
Natural = Annotated[int, msgspec.Meta(ge=0, le=(1 << 63) - 1)]
Row = tuple[Natural, float, tuple[float, ...], tuple[tuple[float, ...], ...]]
#: Candidates, kept, beaten, bounded, stopped early, singular, diverged; of the bounded those in boxes, if any.
Counts = Annotated[tuple[Natural, ...], msgspec.Meta(min_length=7, max_length=8)]
Failures = tuple[tuple[Natural, bool], ...]
#: Rows (index, raw score, coefficients, initial terms by record), counts, failures (index, whether diverged).
Part = tuple[tuple[Row, ...], Counts, Failures]
#: Round, candidates followed, end and length of the batch, its limit.
Place = tuple[Natural, Natural, Natural, Natural, float]
#: Where to go on with a stretch half done, with the digest of the visiting order, and whether it was begun anew.
Checkpoint = tuple[tuple[Natural, Natural, Natural, Natural, float, Natural], bool, Part]
#: Equation, first candidate, the one behind the last, limit.
Span = tuple[int, int, int, float]
#: What candidates under an order law came to: values and kinds (see :class:`Verdicts`).
Outcomes = tuple[bytes, bytes]


#: Most free motions of a sensor filter that a record may hold.
MAX_STATES = 10


class RecordFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A record: pulse means as little-endian doubles, row by row; an offset is written where there is one."""

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
        """Write a record."""
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
        """Give the record back, or refuse sizes that do not fit one another."""
        rows, m = self.shape
        sizes = (len(self.signals), len(self.inputs), len(self.means))
        if rows < 1 or m < 1 or sizes != (rows, rows, 8 * rows * m) or len(self.sensor or b"") % 8:
            raise ModelError("the sizes of a record do not fit one another")
        if not 0 <= self.states <= (0 if self.sensor is None else MAX_STATES):
            raise ModelError(f"a record with {self.states} states of its sensor filter")
        means = np.frombuffer(self.means, "<f8").astype(np.float64).reshape(rows, m)
        sensor = None if self.sensor is None else np.frombuffer(self.sensor, "<f8").astype(np.float64)
        return Record(
            self.signals, self.step, means, self.inputs, sensor, check_initial(self.initial), self.offset, self.states
        )


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


class Begun(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="progress"):
    """A stretch of rounds, half done; rows are those found since the frame before, failures None where unchanged.

    Where the stretch was begun anew, frames before do not count. Order is the digest of the order in which the round is
    visited; 0, which older stores mean, is that of none.
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


Frame = Begun | Rounds | Verdicts | Joined
DECODER = msgspec.msgpack.Decoder(Requests | Frame)
ENCODER = msgspec.msgpack.Encoder()


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
