"""Checkpoint file of an order search: its records, their validation, reading and writing.

The first record is :class:`Requests`: all arguments and data of the searches, so that they can be resumed without the
measured files. A search of one equation then appends :class:`PartialRounds` (a block of rounds with a resumption point)
and :class:`Rounds` (a finished block). A search under an order law appends :class:`Verdicts` (a finished block of
candidates) and, at its end, :class:`CoupledTable`.
"""

from __future__ import annotations

import bisect
import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, cast

import msgspec

from ftlm import _core
from ftlm._core import __version__
from ftlm.errors import DataError, ModelError
from ftlm.simulation.discretization import Record
from ftlm.structure.structure import Structure, check_initial
from ftlm.utils.checkpoint_file import RECORD_ENCODER, CheckpointFile, decode_array
from ftlm.utils.parameters import parameter

#: Version of the search algorithm. Rounds of two versions cannot be joined, so files of other versions are refused.
ALGORITHM_VERSION = 1
Natural = Annotated[int, msgspec.Meta(ge=0, le=(1 << 63) - 1)]
Row = tuple[Natural, float, tuple[float, ...], tuple[tuple[float, ...], ...]]
#: Counts: candidates, kept, beaten, bounded, stopped early, singular, diverged; of the bounded those in boxes, if any.
Counts = Annotated[tuple[Natural, ...], msgspec.Meta(min_length=7, max_length=8)]


def finished_count(counts: Counts) -> int:
    """Return the number of candidates that are in the table or excluded.

    Candidates excluded in boxes are already counted as excluded by a bound.
    """
    return sum(counts[1:7])


Failures = tuple[tuple[Natural, bool], ...]
#: Rows (index, raw score, coefficients, initial terms by record), counts, failures (index, whether diverged).
Part = tuple[tuple[Row, ...], Counts, Failures]
#: Round, number of evaluated candidates, then end, length and limit of the current chunk of candidates.
Place = tuple[Natural, Natural, Natural, Natural, float]
#: Position of a partial block with the digest of the evaluation order, whether it was restarted, and its part.
Checkpoint = tuple[tuple[Natural, Natural, Natural, Natural, float, Natural], bool, Part]
#: Equation, first candidate, end (exclusive), limit.
Span = tuple[int, int, int, float]
#: Results of candidates under an order law: values and kinds (see :class:`Verdicts`).
Outcomes = tuple[bytes, bytes]


#: Maximum number of initial states of a sensor filter in a record.
MAX_FILTER_STATES = 10


def check_record(record: Record) -> None:
    """Raise ModelError if the arrays of a record have inconsistent sizes."""
    sizes, sensor = (len(record.signals), len(record.inputs)), record.sensor
    shaped = record.means.ndim == 2 and (sensor is None or sensor.ndim == 1)
    if not shaped or sizes != record.means.shape[:1] * 2 or not record.means.size:
        raise ModelError("the sizes of a record are inconsistent")
    if not 0 <= record.states <= (0 if sensor is None else MAX_FILTER_STATES):
        raise ModelError(f"a record with {record.states} states of its sensor filter")
    check_initial(record.initial)


class Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Definition of one search: its data, its settings, and the name of its result."""

    name: str
    structure: Structure
    values: dict[str, tuple[float, ...]]
    settings: dict[str, str | int | float | bool | None]
    records: tuple[Record, ...]
    runs: tuple[str, ...]
    units: dict[str, str]

    def difference(self, other: Request) -> str | None:
        """Return text on the first difference from another request; None if both are equal."""
        if [r.offset for r in self.records] != [r.offset for r in other.records]:
            return "another offset"
        if RECORD_ENCODER.encode(self.records) != RECORD_ENCODER.encode(other.records):
            return "other data"
        if self.structure.equations != other.structure.equations:
            return "another equation"
        if self.values != other.values:
            return "another order grid"
        changed = [n for n in self.settings if self.settings[n] != other.settings.get(n)]
        if changed:
            return "other settings: " + ", ".join(f"{n} = {self.settings[n]}" for n in changed)
        return None


class Requests(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="requests"):
    """First record of the file, with the definitions of all searches."""

    algorithm: int
    version: str
    requests: tuple[Request, ...]


class PartialRounds(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="progress"):
    """Record of a partly evaluated block of rounds, with the rows found since the block's previous record.

    ``failures`` is None if unchanged.

    If the block was restarted, its earlier records are invalid. ``order`` is the digest of the sequence in which
    candidates are evaluated; 0 before the first one.
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
    """Record of a completely evaluated block of rounds."""

    search: Natural
    first: Natural
    last: Natural
    part: Part


class Verdicts(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="verdicts"):
    """Checkpoint record of a coupled search for one block of candidates that is completely evaluated.

    ``values`` are unscaled scores as little-endian doubles. ``kinds`` has one byte per value: 0 for a complete score, 1
    for a lower bound, 2 for a partial sum, 3 for a singular candidate, 4 for a diverged one.
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
    """Record of the final table of a coupled search: rows, counts by reason, and first failures."""

    search: Natural
    rows: tuple[StageRow, ...]
    counts: dict[str, Natural]
    failures: tuple[StageFailure, ...]


Frame = PartialRounds | Rounds | Verdicts | CoupledTable
FRAME_DECODER = msgspec.msgpack.Decoder(Requests | Frame, dec_hook=decode_array)


@dataclass
class PartialBlock:
    """Partly evaluated block of rounds, with all rows that were found in it so far."""

    last: int
    place: Place
    order: int
    rows: list[Row]
    counts: Counts
    failures: Failures

    @property
    def checkpoint(self) -> Checkpoint:
        """Return the state from which the core resumes the block."""
        return (*self.place, self.order), False, (tuple(self.rows), self.counts, self.failures)


@dataclass
class Section:
    """Progress of one search in a checkpoint file: complete blocks of rounds and partly evaluated blocks.

    A round is a fixed range of candidates. The key of a block is the number of its first round. In a coupled search it
    is the number of the first candidate.
    """

    law: bool = False
    frames: dict[int, Rounds | Verdicts] = field(default_factory=dict)
    open: dict[int, PartialBlock] = field(default_factory=dict)
    table: CoupledTable | None = None
    _firsts: list[int] = field(default_factory=list)

    def add_frame(self, frame: Frame) -> None:
        """Add a record; raise ModelError if it is a duplicate, has an empty block, or is of another kind of search."""
        if self.table is not None or (isinstance(frame, CoupledTable) and not self.law):
            raise ModelError("it has an unexpected final table")
        if isinstance(frame, CoupledTable):
            self.table = frame
            return
        if frame.first >= frame.last or isinstance(frame, Verdicts) != self.law:
            raise ModelError(f"rounds {frame.first} to {frame.last} are not a valid range")
        place = bisect.bisect_left(self._firsts, frame.last)
        if place and self.frames[self._firsts[place - 1]].last > frame.first:
            raise ModelError(f"rounds {frame.first} to {frame.last} are stored twice")
        if isinstance(frame, PartialRounds):
            self._add_partial_rounds(frame)
            return
        count = frame.last - frame.first
        if isinstance(frame, Verdicts) and (len(frame.values), len(frame.kinds)) != (8 * count, count):
            raise ModelError(f"candidates {frame.first} to {frame.last} have a wrong number of verdicts")
        self.open.pop(frame.first, None)
        self.frames[frame.first] = frame
        self._firsts.insert(place, frame.first)

    def _add_partial_rounds(self, frame: PartialRounds) -> None:
        half = self.open.get(frame.first)
        if not frame.first <= frame.place[0] < frame.last or (half is not None and half.last != frame.last):
            raise ModelError(f"rounds {frame.first} to {frame.last} do not continue their block")
        _, followed, end, size, limit = frame.place
        if not (followed <= end and size >= (end > 0) and not math.isnan(limit)):
            raise ModelError(f"rounds {frame.first} to {frame.last} have an invalid position")
        if half is None or frame.anew:
            half = self.open[frame.first] = PartialBlock(frame.last, frame.place, frame.order, [], frame.counts, ())
        half.place, half.order, half.counts = frame.place, frame.order, frame.counts
        half.rows.extend(frame.rows)
        half.failures = half.failures if frame.failures is None else frame.failures

    @property
    def processed_count(self) -> int:
        """Number of candidates evaluated or excluded."""
        counts = (len(f.kinds) if isinstance(f, Verdicts) else finished_count(f.part[1]) for f in self.frames.values())
        return sum(counts) + sum(finished_count(half.counts) for half in self.open.values())

    @property
    def best(self) -> float | None:
        """Lowest unscaled score found so far in the search of one equation; None for a coupled search."""
        rows = [row for frame in self.frames.values() if isinstance(frame, Rounds) for row in frame.part[0]]
        return min((row[1] for row in (*rows, *(r for half in self.open.values() for r in half.rows))), default=None)


@dataclass
class Contents:
    """Contents of a checkpoint file: definitions and progress of its searches."""

    requests: tuple[Request, ...]
    sections: list[Section]
    version: str
    #: Description of corrupt data with the number of its record; None for an intact file.
    corruption: str | None


def read_store(path: str | os.PathLike[str]) -> Contents:
    """Return the contents of the intact part of a checkpoint file, which may be in use."""
    with CheckpointFile(path, "search") as file:
        return contents_of(path, *file.read())


def contents_of(path: str | os.PathLike[str], payloads: Sequence[bytes], corruption: str | None) -> Contents:
    """Return the contents that records of a checkpoint file encode; raise DataError if they are no order search."""
    if not payloads:
        why = (
            f"cannot be used: {corruption}" if corruption else "ends before its first record: its search had not begun"
        )
        raise DataError(f"{path} {why}; start the search again in another file")
    contents: Contents | None = None
    for number, payload in enumerate(payloads, 1):
        try:
            frame = FRAME_DECODER.decode(payload)
            if contents is None:
                contents = _contents_of_requests(frame, corruption)
            elif isinstance(frame, Requests):
                raise ModelError("the requests are stored twice")
            else:
                if frame.search >= len(contents.sections):
                    raise ModelError(f"there is no search {frame.search}")
                contents.sections[frame.search].add_frame(frame)
        except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError) as error:
            raise DataError(
                f"{path} has an unexpected entry in record {number}: {error}; start the search again in another file"
            ) from error
    return cast("Contents", contents)


def _contents_of_requests(frame: Requests | Frame, corruption: str | None) -> Contents:
    if not isinstance(frame, Requests) or not frame.requests:
        raise ModelError("the first record holds no request")
    if frame.algorithm != ALGORITHM_VERSION:
        writer = f"ftlm {frame.version} with algorithm {frame.algorithm}"
        raise ModelError(f"it was written by {writer}, and this version has algorithm {ALGORITHM_VERSION}")
    sections = [Section(law=r.structure.has_order_law) for r in frame.requests]
    return Contents(frame.requests, sections, frame.version, corruption)


#: Maximum time between two writes, each flushed to disk. Less than a second of work is lost on a crash.
FLUSH_INTERVAL_S = 0.3


class Store:
    """Checkpoint file that is open for writing, and locked until it is closed.

    Results are on disk within :data:`FLUSH_INTERVAL_S`.

    `requests` define the searches of a new file. An existing file must contain the same searches; with None, any
    searches are accepted. With `recover` the intact records of a corrupt file are kept, and a copy of the corrupt file
    is saved.
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
        self._file = CheckpointFile(path, "search", "resume" if requests is None else "create")
        try:
            self._begin(requests, recover=recover)
        except BaseException:
            self._file.close()
            raise

    def _begin(self, requests: Sequence[Request] | None, *, recover: bool) -> None:
        payloads, corruption = self._file.read()
        if requests is not None and not payloads and corruption is None:
            # The stored request is compared with the given one, so that encoding errors appear before the search.
            payloads = [RECORD_ENCODER.encode(Requests(ALGORITHM_VERSION, __version__, tuple(requests)))]
            self._file.append(payloads)
        self.contents = contents = contents_of(self.path, payloads, corruption)
        if requests is not None:
            self._check_same(requests, contents.requests)
        if corruption is None:
            return
        if not recover:
            raise DataError(
                f"store {self.path} is damaged: {corruption}; later records are unreliable; resume with "
                f"{parameter('recover', True)} to keep the records before the damage and compute the rest again"
            )
        copy = self._file.recover(payloads)
        self._file = CheckpointFile(self.path, "search", "resume")
        self.notes.append(
            f"the {len(payloads)} records before the damage ({corruption}) were kept; {copy} has the rest"
        )
        contents.corruption = None

    def _check_same(self, requests: Sequence[Request], stored: Sequence[Request]) -> None:
        if [r.name for r in requests] != [r.name for r in stored]:
            names = ", ".join(r.name for r in stored)
            raise DataError(f"store {self.path} holds searches of {names}; choose another file")
        for one, other in zip(requests, stored, strict=True):
            difference = one.difference(other)
            if difference is not None:
                raise DataError(
                    f"store {self.path} holds another search of {one.name} (this one has {difference}); choose "
                    "another file"
                )

    def _append(self, added: Sequence[Frame]) -> None:
        self._file.append([RECORD_ENCODER.encode(frame) for frame in added])
        self._last = time.monotonic()
        for frame in added:
            self.contents.sections[frame.search].add_frame(frame)

    def save(self, search: int, first: int, last: int, checkpoint: Checkpoint | None) -> None:
        """Queue the progress of a block of rounds for writing; write the queue if the flush interval has elapsed."""
        if checkpoint is not None:
            (*place, order), anew, (rows, counts, failures) = checkpoint
            rounds_before = self._waiting.get((search, first))
            rows = (*(rounds_before.rows if rounds_before else ()), *rows)
            anew = anew or (rounds_before is not None and rounds_before.anew)
            checkpoint_place = cast("Place", tuple(place))
            self._waiting[search, first] = PartialRounds(
                search, first, last, checkpoint_place, rows, counts, failures, order, anew
            )
        if time.monotonic() - self._last >= FLUSH_INTERVAL_S:
            self.flush()

    def flush(self) -> None:
        """Write all queued records."""
        due = []
        for key, frame in self._waiting.items():
            same = not frame.anew and self._failures.get(key) == frame.failures
            due.append(msgspec.structs.replace(frame, failures=None) if same else frame)
            self._failures[key] = frame.failures
        self._waiting.clear()
        if due:
            self._append(due)

    def append_block(self, frame: Rounds | Verdicts) -> None:
        """Write a complete block."""
        self._waiting.pop((frame.search, frame.first), None)
        self._failures.pop((frame.search, frame.first), None)
        self._append([frame])

    def append_table(self, search: int, table: _core._FoundStage) -> None:
        """Write the final table of a coupled search."""
        frame = {"type": "joined", "search": search, **{k: table[k] for k in ("rows", "counts", "failures")}}
        self._append([msgspec.convert(frame, CoupledTable)])

    def close(self) -> None:
        """Write queued records, close the file and release the lock."""
        try:
            self.flush()
        finally:
            self._file.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and issubclass(kind, DataError):
            # After a failed write, pending writes would fail too and hide the cause.
            self._waiting.clear()
        self.close()
