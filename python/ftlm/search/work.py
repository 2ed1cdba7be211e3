"""What a search is computed from, as the core takes it, here and in a worker."""

from __future__ import annotations

import hashlib
import os
import threading
import time
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar, cast

import msgspec
import numpy as np

from ftlm import _core
from ftlm.base.arrays import Floats
from ftlm.data.settings import Settings
from ftlm.search.frames import Outcomes, Part, Span
from ftlm.solve.records import InitialTuple

#: Searches that a worker keeps ready.
READY = 2
Table = TypeVar("Table")
Piece = TypeVar("Piece")
CoreRecord = tuple[float, Floats, Floats | None]
Told = Callable[[int, int, int], None]


@dataclass(frozen=True)
class Work(ABC, Generic[Table]):
    """What every round of a search is computed from, and the table it ends in."""

    runs: tuple[CoreRecord, ...]
    inputs: list[bool]
    initial: InitialTuple
    settings: Settings

    @property
    @abstractmethod
    def asked(self) -> tuple[Any, ...]:
        """What the core takes behind the runs."""

    def core(self, *more: Any) -> tuple[Any, ...]:
        """All of it, and more, as the core takes it."""
        return list(self.runs), *self.asked, *more

    @abstractmethod
    def search(self, progress: Told | None) -> Table:
        """Search here and at once."""

    @abstractmethod
    def ready(self) -> _core.OrderSearch | _core.StageSearch:
        """Build what all pieces of the search share."""

    @property
    def key(self) -> str:
        """Digest that names the search among workers."""
        digest = hashlib.blake2b(digest_size=16)
        for step, means, sensor in self.runs:
            digest.update(msgspec.msgpack.encode((step, means.shape, sensor is None)))
            digest.update(np.ascontiguousarray(means).tobytes())
            digest.update(b"" if sensor is None else np.ascontiguousarray(sensor).tobytes())
        digest.update(msgspec.msgpack.encode(self.asked))
        return digest.hexdigest()


@dataclass(frozen=True)
class EquationWork(Work["_core._Found"]):
    """The search of one equation: output, values of its highest order, and signal, values and freedom of each term."""

    orders: tuple[int, list[float], list[tuple[int, list[float], bool]]]
    fixed: list[float | None]

    @property
    def asked(self) -> tuple[Any, ...]:
        """What the core takes behind the runs."""
        return self.orders, self.inputs, self.fixed, self.initial, self.settings.core()

    def search(self, progress: Told | None) -> _core._Found:
        """Search here and at once."""
        return _core.search(*self.core(progress))

    def ready(self) -> _core.OrderSearch:
        """Build what all rounds share."""
        return _core.OrderSearch(*self.core())

    def plan(self, algorithm: int | None = None) -> tuple[int, list[int], int]:
        """Candidates, where each wave of rounds ends by this or an earlier algorithm, and the number of this one."""
        return _core.search_plan(self.orders, self.inputs, self.initial, self.settings.core(), algorithm)

    @property
    def samples(self) -> int:
        """Pulses of all records."""
        return sum(int(means.shape[1]) for _, means, _ in self.runs)

    def join(self, parts: list[Part]) -> _core._Found:
        """Join the parts of all rounds."""
        settings = self.settings.core()
        return _core.search_join(self.orders, self.inputs, self.initial, settings, self.samples, parts)


@dataclass(frozen=True)
class StageWork(Work["_core._FoundStage"]):
    """The search of a stage: values of the free orders, its equations as sums of them, a scale for each score."""

    axes: list[list[float]]
    laws: list[tuple[int, tuple[float, list[float]], list[tuple[int, tuple[float, list[float]]]]]]
    fixed: list[list[float | None]]
    scales: list[float]

    @property
    def asked(self) -> tuple[Any, ...]:
        """What the core takes behind the runs."""
        return self.axes, self.laws, self.inputs, self.fixed, self.scales, self.initial, self.settings.core()

    def search(self, progress: Told | None) -> _core._FoundStage:
        """Search here and at once."""
        return _core.search_stage(*self.core(progress))

    def ready(self, *, keeps_course: bool = False) -> _core.StageSearch:
        """Build what all candidates share, and where the search itself is kept its course."""
        return _core.StageSearch(*self.core(keeps_course))


_ready: OrderedDict[str, _core.OrderSearch | _core.StageSearch] = OrderedDict()
_lock = threading.Lock()


def _new_lock() -> None:
    """Replace the lock, which another thread may have held when this process was forked."""
    global _lock  # noqa: PLW0603
    _lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_new_lock)


def some_rounds(
    key: str, work: EquationWork | None, first: int, last: int, seed: list[tuple[int, float]], start: Any, threads: int
) -> tuple[float, Part] | None:
    """Do some rounds in a worker: seconds and part, or None where the search is not known and not given."""
    return _timed(key, work, lambda search: cast("Part", search.rounds(first, last, seed, start, threads, None, None)))


def some_candidates(key: str, work: StageWork | None, spans: list[Span], threads: int) -> tuple[float, Outcomes] | None:
    """Follow some candidates in a worker: seconds and verdicts, or None where the search is not known and not given."""
    return _timed(key, work, lambda search: cast("Outcomes", search.follow(spans, threads, None)))


def _timed(key: str, work: Work[Any] | None, do: Callable[[Any], Piece]) -> tuple[float, Piece] | None:
    with _lock:
        search = _ready.get(key) or (None if work is None else work.ready())
        if search is None:
            return None
        _ready[key] = search
        _ready.move_to_end(key)
        while len(_ready) > READY:
            _ready.popitem(last=False)
    began = time.monotonic()
    piece = do(search)
    return time.monotonic() - began, piece
