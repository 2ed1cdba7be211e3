"""The waves of a search: what each consists of, how a piece of it is done, and what the pieces come to.

Those of one equation are rounds; those of a stage under its order law are candidates of its equations.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from functools import cached_property, partial
from typing import Any, Generic, TypeVar, cast

from ftlm import _core
from ftlm.base.errors import ModelError
from ftlm.search.frames import Checkpoint, Outcomes, Part, Rounds, Span, Verdicts
from ftlm.search.work import EquationWork, StageWork, Table, Told, Work, some_candidates, some_rounds
from ftlm.search.workers import Pace, Stretch

#: Time [s] between two writes of what candidates under an order law came to: what is lost is not much more.
PIECE = 0.25
#: Fewest candidates under an order law that are followed or sent together: the first wave, so that the first worker to
#: be asked gets the record before the others are.
FEWEST = 256
Done = TypeVar("Done", Rounds, Verdicts)
#: Notes a checkpoint of the rounds from the first to the last.
Save = Callable[[int, int, Checkpoint | None], None]


class Course(ABC, Generic[Done, Table]):
    """A search on its way: candidates done and in all, and the wave that is being done."""

    #: Whether what an earlier version began may be gone on with.
    goes_on = True
    #: Whether the core itself tells of progress in what is done here.
    core_tells = False

    def __init__(self, work: Work[Table], pace: Pace) -> None:
        self.work, self.pace = work, pace
        self.threads = work.settings.threads
        self.done = self.total = 0

    @cached_property
    def key(self) -> str:
        """Name of the search among workers."""
        return self.work.key

    def payload(self, stretch: Stretch) -> Work[Table] | None:
        """What goes along with a stretch: nothing, unless a worker said that it does not know the search."""
        return self.work if stretch.sent else None

    @abstractmethod
    def waves(self) -> Iterator[tuple[int, int]]:
        """First piece of each wave and the one behind its last; the next is laid out once that one is whole."""

    @abstractmethod
    def here(self, left: list[Stretch], progress: Told | None, save: Save | None) -> Iterator[tuple[Stretch, Any]]:
        """Do stretches here."""

    @abstractmethod
    def task(self, stretch: Stretch) -> tuple[Any, ...]:
        """Name a function and its arguments that do a stretch elsewhere."""

    @abstractmethod
    def frame(self, number: int, stretch: Stretch, piece: Any) -> Done:
        """Make what a stretch came to a frame of a store, as of its search of that number."""

    @abstractmethod
    def take(self, done: Done) -> int:
        """Take in a stretch of the wave; tell how many of its candidates were left early, where that is known."""

    @abstractmethod
    def table(self) -> Table:
        """Join all waves."""


class EquationCourse(Course[Rounds, "_core._Found"]):
    """The rounds of one equation; those of a wave know the best rows of the waves before."""

    core_tells = True
    work: EquationWork

    def __init__(self, work: EquationWork, algorithm: int | None = None) -> None:
        super().__init__(work, Pace())
        self.total, self._ends, present = work.plan(algorithm)
        self.goes_on = algorithm is None or algorithm >= present
        self._parts: list[Part] = []
        self._seed: list[tuple[int, float]] = []

    @cached_property
    def _search(self) -> _core.OrderSearch:
        return self.work.ready()

    def waves(self) -> Iterator[tuple[int, int]]:
        """Rounds that know the same rows, each wave at a pace of its own: later ones exclude more."""
        first, keep = 0, self.work.settings.keep
        for end in self._ends:
            ranked = sorted({(row[1], row[0]) for part in self._parts for row in part[0]})[:keep]
            if len(ranked) == keep:
                self._parts = [_up_to(ranked[-1], part) for part in self._parts]
            self._seed = [(index, score) for score, index in ranked]
            self.pace = Pace()
            yield first, end
            first = end

    def here(self, left: list[Stretch], progress: Told | None, save: Save | None) -> Iterator[tuple[Stretch, Part]]:
        """Do each stretch in one call, from where it stands."""
        for stretch in left:
            first, last = stretch.first, stretch.last
            told = None if progress is None else partial(self._tell, progress, self.done)
            saved = None if save is None else partial(save, first, last)
            part = self._search.rounds(first, last, self._seed, stretch.start, self.threads, told, saved)
            yield stretch, cast("Part", part)

    def _tell(self, progress: Told, before: int, done: int, _all: int, pruned: int) -> None:
        progress(min(before + done, self.total), self.total, pruned)

    def task(self, stretch: Stretch) -> tuple[Any, ...]:
        """Some rounds."""
        ranged = stretch.first, stretch.last, self._seed, stretch.start, self.threads
        return some_rounds, self.key, self.payload(stretch), *ranged

    def frame(self, number: int, stretch: Stretch, piece: Part) -> Rounds:
        """Some rounds, done."""
        return Rounds(number, stretch.first, stretch.last, piece)

    def take(self, done: Rounds) -> int:
        """Take in some rounds."""
        self._parts.append(done.part)
        self.done += sum(done.part[1][1:])
        return 0

    def table(self) -> _core._Found:
        """Join the parts of all rounds."""
        return self.work.join(self._parts)


def _up_to(worst: tuple[float, int], part: Part) -> Part:
    """A part without the rows that better ones have pushed out."""
    rows, counts, failures = part
    return tuple(row for row in rows if (row[1], row[0]) <= worst), counts, failures


class StageCourse(Course[Verdicts, "_core._FoundStage"]):
    """The candidates that a stage wants followed; what those of a wave are depends on the waves before."""

    work: StageWork

    def __init__(self, work: StageWork) -> None:
        super().__init__(work, Pace(fewest=FEWEST))
        self.search = work.ready(keeps_course=True)
        self._first = 0
        self._spans: list[Span] = []
        self._wave: list[Verdicts] = []

    def waves(self) -> Iterator[tuple[int, int]]:
        """Candidates that are wanted next, by a number that goes on through all waves."""
        while spans := self.search.wanted():
            end = self._first + sum(last - first for _, first, last, _ in spans)
            self._spans, self._wave = spans, []
            self.total, _ = self.search.state()
            yield self._first, end
            self.search.take(*_whole(self._wave, self._first, end), self.threads)
            self._first = end
        self.total = self._first

    def here(self, left: list[Stretch], progress: Told | None, save: Save | None) -> Iterator[tuple[Stretch, Outcomes]]:
        """Follow candidates in pieces of about :data:`PIECE` seconds."""
        for stretch in left:
            at = stretch.first
            while at < stretch.last:
                piece = Stretch(at, min(stretch.last, at + self.pace.size(PIECE)))
                began = time.monotonic()
                outcomes = self.search.follow(self._cut(piece), self.threads, None)
                self.pace.took(time.monotonic() - began, piece.last - piece.first)
                yield piece, outcomes
                at = piece.last

    def task(self, stretch: Stretch) -> tuple[Any, ...]:
        """Some candidates."""
        return some_candidates, self.key, self.payload(stretch), self._cut(stretch), self.threads

    def _cut(self, stretch: Stretch) -> list[Span]:
        """The candidates of a stretch, counted through all spans of the wave."""
        cut, at = [], self._first
        for equation, start, end, limit in self._spans:
            low, high = max(stretch.first - at, 0), min(stretch.last - at, end - start)
            if low < high:
                cut.append((equation, start + low, start + high, limit))
            at += end - start
        return cut

    def frame(self, number: int, stretch: Stretch, piece: Outcomes) -> Verdicts:
        """Some candidates, done."""
        return Verdicts(number, stretch.first, stretch.last, *piece)

    def take(self, done: Verdicts) -> int:
        """Take in some verdicts."""
        self._wave.append(done)
        self.done += len(done.kinds)
        return done.kinds.count(1) + done.kinds.count(2)

    def table(self) -> _core._FoundStage:
        """Join the equations under their law."""
        return self.search.outcome()


def _whole(wave: list[Verdicts], first: int, end: int) -> Outcomes:
    """Verdicts of a wave in their order; refuse stretches that do not make it up."""
    at, values, kinds = first, [], []
    for verdicts in sorted(wave, key=lambda v: v.first):
        if verdicts.first != at:
            break
        at = verdicts.last
        values.append(verdicts.values)
        kinds.append(verdicts.kinds)
    if at != end:
        raise ModelError(f"candidates {first} to {end} are cut up otherwise")
    return b"".join(values), b"".join(kinds)
