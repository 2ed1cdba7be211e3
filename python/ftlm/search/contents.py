"""What a search store holds: read frame by frame as far as it is whole, and told apart by search."""

from __future__ import annotations

import bisect
import math
import os
from dataclasses import dataclass, field

import msgspec

from ftlm.base.errors import DataError, ModelError
from ftlm.search import frames
from ftlm.search.log import SEARCH, check


@dataclass
class Half:
    """A stretch of rounds, half done, with all rows found since its start."""

    last: int
    place: frames.Place
    order: int
    rows: list[frames.Row]
    counts: frames.Counts
    failures: frames.Failures

    @property
    def checkpoint(self) -> frames.Checkpoint:
        """Where to go on, as the core takes it."""
        return (*self.place, self.order), False, (tuple(self.rows), self.counts, self.failures)


@dataclass
class Section:
    """What is known of one search: stretches done (of rounds, or of candidates under an order law) and half done.

    Both stand under their first round or candidate.
    """

    law: bool = False
    done: dict[int, frames.Rounds | frames.Verdicts] = field(default_factory=dict)
    open: dict[int, Half] = field(default_factory=dict)
    joined: frames.Joined | None = None
    _firsts: list[int] = field(default_factory=list)

    def take(self, frame: frames.Frame) -> None:
        """Take a frame in; refuse one that is there already, that is no stretch, or of another kind of search."""
        if self.joined is not None or (isinstance(frame, frames.Joined) and not self.law):
            raise ModelError("a table stands where none belongs")
        if isinstance(frame, frames.Joined):
            self.joined = frame
            return
        if frame.first >= frame.last or isinstance(frame, frames.Verdicts) != self.law:
            raise ModelError(f"rounds {frame.first} to {frame.last} are no stretch")
        place = bisect.bisect_left(self._firsts, frame.last)
        if place and self.done[self._firsts[place - 1]].last > frame.first:
            raise ModelError(f"rounds {frame.first} to {frame.last} are there twice")
        if isinstance(frame, frames.Begun):
            self._take_begun(frame)
            return
        count = frame.last - frame.first
        if isinstance(frame, frames.Verdicts) and (len(frame.values), len(frame.kinds)) != (8 * count, count):
            raise ModelError(f"candidates {frame.first} to {frame.last} have other verdicts")
        self.open.pop(frame.first, None)
        self.done[frame.first] = frame
        self._firsts.insert(place, frame.first)

    def _take_begun(self, frame: frames.Begun) -> None:
        half = self.open.get(frame.first)
        if not frame.first <= frame.place[0] < frame.last or (half is not None and half.last != frame.last):
            raise ModelError(f"rounds {frame.first} to {frame.last} are continued as something else")
        _, followed, end, size, limit = frame.place
        if not (followed <= end and size >= (end > 0) and not math.isnan(limit)):
            raise ModelError(f"rounds {frame.first} to {frame.last} stand nowhere")
        if half is None or frame.anew:
            half = self.open[frame.first] = Half(frame.last, frame.place, frame.order, [], frame.counts, ())
        half.place, half.order, half.counts = frame.place, frame.order, frame.counts
        half.rows.extend(frame.rows)
        half.failures = half.failures if frame.failures is None else frame.failures

    @property
    def dealt(self) -> int:
        """Candidates dealt with."""
        done = (len(f.kinds) if isinstance(f, frames.Verdicts) else sum(f.part[1][1:7]) for f in self.done.values())
        return sum(done) + sum(sum(half.counts[1:7]) for half in self.open.values())

    @property
    def best(self) -> float | None:
        """Smallest raw score so far, of one equation's candidates."""
        rows = [row for frame in self.done.values() if isinstance(frame, frames.Rounds) for row in frame.part[0]]
        return min((row[1] for row in (*rows, *(r for half in self.open.values() for r in half.rows))), default=None)


@dataclass
class Contents:
    """What a store holds."""

    requests: tuple[frames.Request, ...]
    sections: list[Section]
    version: str
    algorithm: int
    #: Offset behind the last whole frame, and that frame's digest.
    end: int
    digest: bytes
    #: Bytes behind it that a power cut or a kill left, or that are being written.
    torn: int = 0
    #: What is damaged, with its offset, where frames or bytes follow that cannot be read; None for a whole store.
    damage: str | None = None


def read_store(path: str | os.PathLike[str]) -> Contents:
    """Read a store as far as it is whole; it may be in use."""
    try:
        # A pipe that nobody writes to would keep the open waiting.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        with os.fdopen(handle, "rb") as stream:
            check(path, handle, SEARCH)
            data = stream.read()
    except DataError:
        raise
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else None
        raise DataError(f"store {path} cannot be read: {why or error}; check the path") from error
    return contents_of(path, memoryview(data))


def contents_of(path: str | os.PathLike[str], data: memoryview) -> Contents:
    """Contents of a store's bytes; refuse what is none, has no first frame, or is of a later version."""
    start = bytes(data[: len(frames.MAGIC)])
    if not frames.MAGIC.startswith(start):
        raise DataError(f"{path} is no ftlm search store; give a file written with store= (--store)")
    contents: Contents | None = None
    offset, digest = len(frames.MAGIC), bytes(frames.DIGEST)
    while offset < len(data):
        got = frames.next_frame(data, offset, digest)
        if isinstance(got, str):
            if contents is None:
                why = "it ends before its first frame does" if got == "torn" else got
                raise DataError(f"{path} cannot be used: {why}; start the search again in another file")
            contents.torn = len(data) - offset if got == "torn" else 0
            contents.damage = None if got == "torn" else got
            break
        payload, digest, end = got
        try:
            frame = frames.DECODER.decode(payload)
            if contents is None:
                contents = _opened(frame, end, digest)
            elif isinstance(frame, frames.Requests):
                raise ModelError("requests stand twice")
            else:
                if frame.search >= len(contents.sections):
                    raise ModelError(f"there is no search {frame.search}")
                contents.sections[frame.search].take(frame)
        except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError) as error:
            raise DataError(
                f"{path} holds something else at byte {offset}: {error}; start the search again in another file"
            ) from error
        offset = end
        contents.end, contents.digest = end, digest
    if contents is None:
        raise DataError(f"{path} ends before its first frame: its search had not begun; start it again with store=")
    return contents


def _opened(frame: frames.Requests | frames.Frame, end: int, digest: bytes) -> Contents:
    if not isinstance(frame, frames.Requests) or not frame.requests:
        raise ModelError("the first frame holds no request")
    sections = [Section(law=r.structure.has_order_law) for r in frame.requests]
    return Contents(frame.requests, sections, frame.version, frame.algorithm, end, digest)
