"""Checkpoint file of an order search: its records, their validation, reading and writing.

The first record is :class:`Requests`: all arguments and data of the searches, so that they can be resumed without the
measured files. A search of one equation is evaluated in rounds, fixed groups of candidates. It appends
:class:`PartialRounds` (a partly evaluated block of rounds, with a resumption point) and :class:`Rounds` (a finished
block). A search under an order law appends :class:`Verdicts` (a finished block of candidates) and, at its end,
:class:`CoupledTable`.
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

#: Version of the search algorithm. Results of two versions cannot be combined, so files of other versions are rejected.
ALGORITHM_VERSION = 1
Natural = Annotated[int, msgspec.Meta(ge=0, le=(1 << 63) - 1)]
Row = tuple[Natural, float, tuple[float, ...], tuple[tuple[float, ...], ...]]
#: Numbers of candidates: all, in the table, worse than the table, excluded by a bound, stopped early, singular, and
#: diverged. An eighth number, if any, counts those that a bound excluded in whole boxes.
Counts = Annotated[tuple[Natural, ...], msgspec.Meta(min_length=7, max_length=8)]


def finished_count(counts: Counts) -> int:
    """Return the number of processed candidates: those in the table and those excluded for any reason.

    The optional eighth count (excluded in boxes) is not added, because it is part of those excluded by a bound.
    """
    return sum(counts[1:7])


Failures = tuple[tuple[Natural, bool], ...]
#: Partial result: rows (candidate index, unscaled score, coefficients, initial terms by record), counts of candidates,
#: and failures (candidate index, True if diverged or False if singular).
Part = tuple[tuple[Row, ...], Counts, Failures]
#: Position in a block: number of the round (group of candidates), number of its evaluated candidates, then end, length
#: and score limit of the current chunk of candidates.
Place = tuple[Natural, Natural, Natural, Natural, float]
#: Checkpoint of a block: position with the digest of the evaluation order, whether the block was restarted, and its
#: partial result.
Checkpoint = tuple[tuple[Natural, Natural, Natural, Natural, float, Natural], bool, Part]
#: Range of candidates of one equation: index of the equation, first candidate, exclusive end, limit of the score.
Span = tuple[int, int, int, float]
#: Results of candidates of a coupled search: values and kinds, as in :class:`Verdicts`.
Outcomes = tuple[bytes, bytes]


#: Maximum number of initial states of a sensor filter in a record.
MAX_FILTER_STATES = 10


def check_record(record: Record) -> None:
    """Raise ModelError if sizes, number of filter states or initial conditions of a block-pulse record are invalid."""
    sizes, sensor = (len(record.signals), len(record.inputs)), record.sensor
    shaped = record.means.ndim == 2 and (sensor is None or sensor.ndim == 1)
    if not shaped or sizes != record.means.shape[:1] * 2 or not record.means.size:
        raise ModelError("the sizes of a record are inconsistent")
    if not 0 <= record.states <= (0 if sensor is None else MAX_FILTER_STATES):
        raise ModelError(f"a block-pulse record has {record.states} states of its sensor filter")
    check_initial(record.initial)


class Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Definition of one order search: data, structure, order grid (`values`), settings, and name of the result."""

    name: str
    structure: Structure
    values: dict[str, tuple[float, ...]]
    settings: dict[str, str | int | float | bool | None]
    records: tuple[Record, ...]
    runs: tuple[str, ...]
    units: dict[str, str]

    def difference(self, other: Request) -> str | None:
        """Return a text that describes the first difference from another request; None if both are equal."""
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
    """First record of a checkpoint file: definitions of all searches, and versions of algorithm and ftlm."""

    algorithm: int
    version: str
    requests: tuple[Request, ...]


class PartialRounds(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="progress"):
    """Checkpoint record of a partly evaluated block of rounds (groups of candidates of one equation).

    ``rows`` are the table rows found since the previous record of the block. ``failures`` is None if they did not
    change since then. With ``restarted``, the block was restarted and its earlier records are invalid. ``order`` is the
    digest of the sequence in which candidates are evaluated, 0 before the first candidate.
    """

    search: Natural
    first: Natural
    last: Natural
    place: Place
    rows: tuple[Row, ...]
    counts: Counts
    failures: Failures | None
    order: Natural = 0
    restarted: bool = msgspec.field(default=False, name="anew")


class Rounds(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="rounds"):
    """Checkpoint record of a completely evaluated block of rounds (groups of candidates) and their partial result."""

    search: Natural
    first: Natural
    last: Natural
    part: Part


class Verdicts(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="verdicts"):
    """Checkpoint record of a completely evaluated block of candidates, in a search of coupled equations.

    ``values`` are unscaled scores as little-endian doubles. ``kinds`` has one byte per value: 0 for a complete score, 1
    for a lower bound, 2 for a partial sum, 3 for a singular candidate, 4 for a diverged one.
    """

    search: Natural
    first: Natural
    last: Natural
    values: bytes
    kinds: bytes


#: One equation in a table row: score, alpha, orders and coefficients of the terms, initial terms by record.
StagePart = tuple[float, float, tuple[float, ...], tuple[float, ...], tuple[tuple[float, ...], ...]]
#: Row of the table: candidate index, score, free orders, equations.
StageRow = tuple[Natural, float, tuple[float, ...], tuple[StagePart, ...]]
#: Candidate without a score: candidate index, free orders, reason.
StageFailure = tuple[Natural, tuple[float, ...], Literal["singular", "diverged"]]


class CoupledTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="joined"):
    """Checkpoint record of the final table in a search of coupled equations: rows, numbers of candidates, failures."""

    search: Natural
    rows: tuple[StageRow, ...]
    counts: dict[str, Natural]
    failures: tuple[StageFailure, ...]


Frame = PartialRounds | Rounds | Verdicts | CoupledTable
FRAME_DECODER = msgspec.msgpack.Decoder(Requests | Frame, dec_hook=decode_array)


@dataclass
class PartialBlock:
    """Partly evaluated block of rounds (groups of candidates), with all table rows found in the block up to now."""

    last: int
    place: Place
    order: int
    rows: list[Row]
    counts: Counts
    failures: Failures

    @property
    def checkpoint(self) -> Checkpoint:
        """Checkpoint from which the evaluation of the block is resumed."""
        return (*self.place, self.order), False, (tuple(self.rows), self.counts, self.failures)


@dataclass
class Section:
    """Progress of one search in a checkpoint file: complete blocks, partly evaluated blocks, and the final table.

    A search of one equation has blocks of rounds (fixed ranges of candidates), which are stored by the number of the
    first round. A coupled search (``law``) has blocks of candidates, stored by the number of the first candidate.
    """

    law: bool = False
    frames: dict[int, Rounds | Verdicts] = field(default_factory=dict)
    open: dict[int, PartialBlock] = field(default_factory=dict)
    table: CoupledTable | None = None
    _firsts: list[int] = field(default_factory=list)

    def add_frame(self, frame: Frame) -> None:
        """Add a checkpoint record of this search.

        Raise ModelError if its block is empty or overlaps a stored block, if it contradicts an earlier record, or if it
        belongs to another kind of search.
        """
        if self.table is not None or (isinstance(frame, CoupledTable) and not self.law):
            raise ModelError("the search has an unexpected final table")
        if isinstance(frame, CoupledTable):
            self.table = frame
            return
        if frame.first >= frame.last or isinstance(frame, Verdicts) != self.law:
            raise ModelError(f"block {frame.first} to {frame.last} is not a valid range")
        index = bisect.bisect_left(self._firsts, frame.last)
        if index and self.frames[self._firsts[index - 1]].last > frame.first:
            raise ModelError(f"block {frame.first} to {frame.last} overlaps a stored block")
        if isinstance(frame, PartialRounds):
            self._add_partial_rounds(frame)
            return
        count = frame.last - frame.first
        if isinstance(frame, Verdicts) and (len(frame.values), len(frame.kinds)) != (8 * count, count):
            raise ModelError(f"candidates {frame.first} to {frame.last} have a wrong number of verdicts")
        self.open.pop(frame.first, None)
        self.frames[frame.first] = frame
        self._firsts.insert(index, frame.first)

    def _add_partial_rounds(self, frame: PartialRounds) -> None:
        half = self.open.get(frame.first)
        if not frame.first <= frame.place[0] < frame.last or (half is not None and half.last != frame.last):
            raise ModelError(f"block {frame.first} to {frame.last} contradicts its earlier record")
        _, simulated, end, block_size, limit = frame.place
        if not (simulated <= end and block_size >= (end > 0) and not math.isnan(limit)):
            raise ModelError(f"block {frame.first} to {frame.last} has an invalid resumption point")
        if half is None or frame.restarted:
            half = self.open[frame.first] = PartialBlock(frame.last, frame.place, frame.order, [], frame.counts, ())
        half.place, half.order, half.counts = frame.place, frame.order, frame.counts
        half.rows.extend(frame.rows)
        half.failures = half.failures if frame.failures is None else frame.failures

    @property
    def processed_count(self) -> int:
        """Number of candidates that were evaluated or excluded up to now."""
        counts = (len(f.kinds) if isinstance(f, Verdicts) else finished_count(f.part[1]) for f in self.frames.values())
        return sum(counts) + sum(finished_count(half.counts) for half in self.open.values())

    @property
    def best(self) -> float | None:
        """Lowest unscaled score up to now in the search of one equation; None without a row or for a coupled search."""
        rows = [row for frame in self.frames.values() if isinstance(frame, Rounds) for row in frame.part[0]]
        return min((row[1] for row in (*rows, *(r for half in self.open.values() for r in half.rows))), default=None)


@dataclass
class Contents:
    """Contents of a checkpoint file: definition and progress of each search, and the ftlm version that created it."""

    requests: tuple[Request, ...]
    sections: list[Section]
    version: str
    #: Description of corrupt data with the number of its record; None for an intact file.
    corruption: str | None


def read_store(path: str | os.PathLike[str]) -> Contents:
    """Return the contents of the intact part of a checkpoint file, which another process may be writing.

    Raise DataError if the file cannot be read or is not the file of an order search.
    """
    with CheckpointFile(path, "search") as file:
        return contents_of(path, *file.read())


def contents_of(path: str | os.PathLike[str], payloads: Sequence[bytes], corruption: str | None) -> Contents:
    """Return the contents of a checkpoint file from its encoded records; raise DataError if one is invalid.

    `corruption` describes damage to later records, or is None.
    """
    if not payloads:
        reason = (
            f"cannot be used: {corruption}" if corruption else "ends before its first record: its search had not begun"
        )
        raise DataError(f"{path} {reason}; start the search again in another file")
    contents: Contents | None = None
    for number, payload in enumerate(payloads, 1):
        try:
            frame = FRAME_DECODER.decode(payload)
            if contents is None:
                contents = _contents_of_requests(frame, corruption)
            elif isinstance(frame, Requests):
                raise ModelError("the definitions of the searches are stored twice")
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
        raise ModelError("the first record contains no request")
    if frame.algorithm != ALGORITHM_VERSION:
        writer = f"ftlm {frame.version} with algorithm {frame.algorithm}"
        raise ModelError(f"the file was written by {writer}, and this version has algorithm {ALGORITHM_VERSION}")
    sections = [Section(law=r.structure.has_order_law) for r in frame.requests]
    return Contents(frame.requests, sections, frame.version, corruption)


#: Minimum time between two writes of partial results, each flushed to disk. A crash loses less than a second of work.
FLUSH_INTERVAL_S = 0.3


class Store:
    """Checkpoint file of order searches that is open for writing, and locked until it is closed.

    Partial results are written about every :data:`FLUSH_INTERVAL_S` seconds, complete blocks immediately.

    Parameters
    ----------
    path
        Path of the file.
    requests
        Definitions of the searches, with which a new file is created. An existing file must contain the same searches.
        With None, an existing file is opened, whatever searches it contains.
    recover
        Whether to keep the intact records of a damaged file, and to save a copy of the damaged file.

    Raises
    ------
    DataError
        If the file cannot be opened, contains other searches, or is damaged and `recover` is False.
    """

    def __init__(
        self, path: str | os.PathLike[str], requests: Sequence[Request] | None = None, *, recover: bool = False
    ) -> None:
        self.path = Path(path)
        #: Texts on repairs of a damaged file.
        self.notes: list[str] = []
        self._last = time.monotonic()
        #: Records that are not written yet, and the failures written last, by (search, first round of the block).
        self._queued_checkpoints: dict[tuple[int, int], PartialRounds] = {}
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
            # The encoded request is decoded and compared below, so that encoding errors appear before the search.
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
            raise DataError(f"store {self.path} contains searches of {names}; choose another file")
        for request, stored_request in zip(requests, stored, strict=True):
            difference = request.difference(stored_request)
            if difference is not None:
                raise DataError(
                    f"store {self.path} contains another search of {request.name} (this one has {difference}); choose "
                    "another file"
                )

    def _append(self, frames: Sequence[Frame]) -> None:
        self._file.append([RECORD_ENCODER.encode(frame) for frame in frames])
        self._last = time.monotonic()
        for frame in frames:
            self.contents.sections[frame.search].add_frame(frame)

    def save(self, search: int, first: int, last: int, checkpoint: Checkpoint | None) -> None:
        """Queue a checkpoint of a partly evaluated block; write the queue at most every `FLUSH_INTERVAL_S` seconds.

        `search` is the index of the search in the file, and `first` and `last` (exclusive) are the limits of the block.
        With None as checkpoint, nothing is queued.
        """
        if checkpoint is not None:
            (*place, order), restarted, (rows, counts, failures) = checkpoint
            rounds_before = self._queued_checkpoints.get((search, first))
            rows = (*(rounds_before.rows if rounds_before else ()), *rows)
            restarted = restarted or (rounds_before is not None and rounds_before.restarted)
            checkpoint_place = cast("Place", tuple(place))
            self._queued_checkpoints[search, first] = PartialRounds(
                search, first, last, checkpoint_place, rows, counts, failures, order, restarted
            )
        if time.monotonic() - self._last >= FLUSH_INTERVAL_S:
            self.flush()

    def flush(self) -> None:
        """Write all queued records to the file."""
        frames = []
        for key, frame in self._queued_checkpoints.items():
            is_unchanged = not frame.restarted and self._failures.get(key) == frame.failures
            frames.append(msgspec.structs.replace(frame, failures=None) if is_unchanged else frame)
            self._failures[key] = frame.failures
        self._queued_checkpoints.clear()
        if frames:
            self._append(frames)

    def append_block(self, frame: Rounds | Verdicts) -> None:
        """Write the record of a complete block to the file, and remove its queued partial results."""
        self._queued_checkpoints.pop((frame.search, frame.first), None)
        self._failures.pop((frame.search, frame.first), None)
        self._append([frame])

    def append_table(self, search: int, table: _core._FoundStage) -> None:
        """Write the final table of the coupled search with index `search` to the file."""
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
            self._queued_checkpoints.clear()
        self.close()
