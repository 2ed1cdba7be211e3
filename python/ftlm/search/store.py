"""The store of a search: what its rounds came to, appended as they end, under digests, one writer at a time.

A store is one file. It opens with :data:`MAGIC`; frames follow, each of

====================  =================================================================================================
4 bytes               length of the payload, little-endian
4 bytes               CRC-32 of those 4 bytes and of the frame's offset in the file (8 bytes, little-endian)
length bytes          payload: one MessagePack map whose key ``type`` says what it is
16 bytes              BLAKE2b of the digest before (zeros for the first frame), the length and the payload
====================  =================================================================================================

The first payload holds the requests (:class:`Requests`): everything a search is computed from, so that it can be
resumed without the files it came from. Then come, for a search of one equation, :class:`Begun` (a stretch of rounds,
half done) and :class:`Rounds` (a stretch, done); for one under an order law :class:`Verdicts` (a stretch of candidates,
done) and at its end :class:`Joined` (its table). Frames are only appended; a digest covers all frames before its own,
so that none can be lost, moved or changed unseen. A frame that reaches to or past the end of the file and is not whole
is what a power cut leaves: it is dropped. Any other frame that is not whole is damage, reported with its offset.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import cast

import msgspec

from ftlm import _core
from ftlm._core import __version__
from ftlm.base.errors import DataError
from ftlm.base.output import write_atomically
from ftlm.search import frames
from ftlm.search.contents import contents_of
from ftlm.search.log import SEARCH, Log

#: Longest time [s] between two writes, each flushed to disk: with the time between checkpoints, under a second is lost.
INTERVAL = 0.3


class Store:
    """A store opened for writing: locked until it is closed; what is appended is on disk within :data:`INTERVAL`.

    The requests are the searches of a new store, or what an existing one must hold; None takes what it holds. With
    `salvage` a damaged one goes on with its whole frames, and the damaged file is kept beside it.
    """

    def __init__(
        self, path: str | os.PathLike[str], requests: Sequence[frames.Request] | None = None, *, salvage: bool = False
    ) -> None:
        self.path = Path(path)
        #: What was mended, in words.
        self.notes: list[str] = []
        self._last = time.monotonic()
        #: By search and first round: what is not written yet, and the failures written last.
        self._waiting: dict[tuple[int, int], frames.Begun] = {}
        self._failures: dict[tuple[int, int], frames.Failures | None] = {}
        self._log = Log(path, SEARCH, create=requests is not None)
        try:
            self._begin(requests, salvage=salvage)
        except BaseException:
            self._log.close()
            raise

    def _begin(self, requests: Sequence[frames.Request] | None, *, salvage: bool) -> None:
        data = self._log.read()
        if requests is not None and self._log.unbegun(data):
            # A payload read back must be the one asked for: what would not survive is found before any work.
            payload = frames.ENCODER.encode(frames.Requests(frames.ALGORITHM, __version__, tuple(requests)))
            data = self._log.begin(payload)
        self.contents = held = contents_of(self.path, memoryview(data))
        if requests is not None:
            self._check_same(requests, held.requests)
        self._log.end, self._log.digest = held.end, held.digest
        if held.damage is not None:
            self._salvage(data, salvage=salvage)
        elif held.torn:
            self.notes.append(f"{held.torn} bytes of an unfinished write at byte {held.end} were dropped")
        if held.end < len(data):
            self._log.cut()

    def _check_same(self, asked: Sequence[frames.Request], held: Sequence[frames.Request]) -> None:
        if [r.name for r in asked] != [r.name for r in held]:
            names = ", ".join(r.name for r in held)
            raise DataError(f"store {self.path} holds searches of {names}; choose another file")
        for one, other in zip(asked, held, strict=True):
            difference = one.difference(other)
            if difference is not None:
                raise DataError(
                    f"store {self.path} holds another search of {one.name} (asked is {difference}); choose another file"
                )

    def _salvage(self, data: bytes, *, salvage: bool) -> None:
        lost = len(data) - self.contents.end
        if not salvage:
            raise DataError(
                f"store {self.path} is damaged: {self.contents.damage}; {lost} bytes from there on cannot be trusted: "
                "resume with salvage=True (--salvage) to keep what stands before and compute the rest again"
            )
        copy = self.path.with_name(self.path.name + ".damaged")
        write_atomically(copy, data, force=False)
        self.notes.append(f"{lost} damaged bytes from byte {self.contents.end} on were dropped; {copy} keeps them")
        self.contents.damage = None

    def outdated(self) -> DataError:
        """Say why a search that another version began does not go on."""
        held = self.contents
        return DataError(
            f"store {self.path} is of ftlm {held.version}, whose rounds follow algorithm {held.algorithm}; this "
            f"version's is {frames.ALGORITHM}: finish the search with that version, or start it again in another "
            "file"
        )

    def _append(self, added: Sequence[frames.Frame]) -> None:
        held = self.contents
        if held.algorithm not in (frames.ALGORITHM, *frames.CONTINUED):
            # A finished search is only read, whatever made it.
            raise self.outdated()
        self._log.append([frames.ENCODER.encode(frame) for frame in added])
        self._last = time.monotonic()
        for frame in added:
            self.contents.sections[frame.search].take(frame)

    def save(self, search: int, first: int, last: int, checkpoint: frames.Checkpoint | None) -> None:
        """Note how far a stretch of rounds is; it is written with others, or when it is time."""
        if checkpoint is not None:
            (*place, order), anew, (rows, counts, failures) = checkpoint
            before = self._waiting.get((search, first))
            rows = (*(before.rows if before else ()), *rows)
            anew = anew or (before is not None and before.anew)
            told = cast("frames.Place", tuple(place))
            self._waiting[search, first] = frames.Begun(search, first, last, told, rows, counts, failures, order, anew)
        if time.monotonic() - self._last >= INTERVAL:
            self.flush()

    def flush(self) -> None:
        """Write what waits."""
        due = []
        for key, frame in self._waiting.items():
            same = not frame.anew and self._failures.get(key) == frame.failures
            due.append(msgspec.structs.replace(frame, failures=None) if same else frame)
            self._failures[key] = frame.failures
        self._waiting.clear()
        if due:
            self._append(due)

    def done(self, frame: frames.Rounds | frames.Verdicts) -> None:
        """Append a stretch that is done."""
        self._waiting.pop((frame.search, frame.first), None)
        self._failures.pop((frame.search, frame.first), None)
        self._append([frame])

    def joined(self, search: int, table: _core._FoundStage) -> None:
        """Append the table of a search under an order law."""
        frame = {"type": "joined", "search": search, **{k: table[k] for k in ("rows", "counts", "failures")}}
        self._append([msgspec.convert(frame, frames.Joined)])

    def close(self) -> None:
        """Write what waits and give the lock back."""
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
