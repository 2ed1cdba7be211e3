"""What a search is computed from, as the core takes it, here and in a worker."""

from __future__ import annotations

import hashlib
import os
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import msgspec
import numpy as np

from ftlm import _core
from ftlm.search.frames import Found, Part, Span

#: Searches that a worker keeps ready.
READY = 2


@dataclass(frozen=True)
class Work:
    """What every round of a search is computed from, as the core takes it."""

    runs: tuple[tuple[float, Any, Any], ...]
    orders: tuple[int, list[float], list[tuple[int, list[float], bool]]]
    inputs: list[bool]
    fixed: list[float | None]
    initial: tuple[bool, list[float]]
    settings: tuple[str, str, int, float, bool, int, int, bool, int]

    @property
    def samples(self) -> int:
        """Pulses of all records."""
        return sum(int(means.shape[1]) for _, means, _ in self.runs)

    @property
    def key(self) -> str:
        """Digest that names the search among workers."""
        return _key(self.runs, (self.orders, self.inputs, self.fixed, self.initial, self.settings))

    def plan(self) -> tuple[int, list[int]]:
        """Candidates, and where each wave of rounds ends."""
        return _core.search_plan(self.orders, self.inputs, self.initial, self.settings)

    def ready(self) -> _core.OrderSearch:
        """Build what the rounds share."""
        return _core.OrderSearch(list(self.runs), self.orders, self.inputs, self.fixed, self.initial, self.settings)

    def join(self, parts: Sequence[Part]) -> _core._Found:
        """Join the parts of all rounds."""
        settings = (self.orders, self.inputs, self.initial, self.settings)
        return _core.search_join(*settings, self.samples, list(parts))


@dataclass(frozen=True)
class StageWork:
    """What the search of a stage under its order law is computed from, as the core takes it."""

    runs: tuple[tuple[float, Any, Any], ...]
    axes: list[list[float]]
    laws: list[tuple[int, tuple[float, list[float]], list[tuple[int, tuple[float, list[float]]]]]]
    inputs: list[bool]
    fixed: list[list[float | None]]
    scales: list[float]
    initial: tuple[bool, list[float]]
    settings: tuple[str, str, int, float, bool, int, int, bool, int]

    @property
    def key(self) -> str:
        """Digest that names the search among workers."""
        settled = (self.axes, self.laws, self.inputs, self.fixed, self.scales, self.initial, self.settings)
        return _key(self.runs, settled)

    def ready(self, *, keeps_course: bool = False) -> _core.StageSearch:
        """Build what all candidates share, and where the search itself is kept its course."""
        return _core.StageSearch(
            list(self.runs), self.axes, self.laws, self.inputs, self.fixed, self.scales, self.initial, self.settings,
            keeps_course,
        )  # fmt: skip

    def search(self, progress: Callable[[int, int, int], None] | None) -> _core._FoundStage:
        """Search here, without a store."""
        return _core.search_stage(
            list(self.runs), self.axes, self.laws, self.inputs, self.fixed, self.scales, self.initial, self.settings,
            progress,
        )  # fmt: skip


def _key(runs: Sequence[tuple[float, Any, Any]], settled: tuple[Any, ...]) -> str:
    found = hashlib.blake2b(digest_size=16)
    for step, means, sensor in runs:
        found.update(msgspec.msgpack.encode((step, means.shape, sensor is None)))
        found.update(np.ascontiguousarray(means).tobytes())
        found.update(b"" if sensor is None else np.ascontiguousarray(sensor).tobytes())
    found.update(msgspec.msgpack.encode(settled))
    return found.hexdigest()


_ready: OrderedDict[str, _core.OrderSearch | _core.StageSearch] = OrderedDict()
_lock = threading.Lock()


def _new_lock() -> None:
    """Replace the lock, which another thread may have held when this process was forked."""
    global _lock  # noqa: PLW0603
    _lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_new_lock)


def some_rounds(
    key: str, work: Work | None, first: int, last: int, seed: list[tuple[int, float]], start: Any, threads: int
) -> tuple[float, Part] | None:
    """Do some rounds in a worker: seconds and part, or None where the search is not known and not given."""
    search = _known(key, work)
    if search is None:
        return None
    began = time.monotonic()
    part = cast("_core.OrderSearch", search).rounds(first, last, seed, start, threads, None, None)
    return time.monotonic() - began, cast("Part", part)


def some_candidates(key: str, work: StageWork | None, spans: list[Span], threads: int) -> tuple[float, Found] | None:
    """Follow some candidates in a worker: seconds and verdicts, or None where the search is not known and not given."""
    search = _known(key, work)
    if search is None:
        return None
    began = time.monotonic()
    found = cast("_core.StageSearch", search).follow(spans, threads, None)
    return time.monotonic() - began, found


def _known(key: str, work: Work | StageWork | None) -> _core.OrderSearch | _core.StageSearch | None:
    with _lock:
        search = _ready.get(key)
        if search is None:
            if work is None:
                return None
            search = work.ready()
            _ready[key] = search
            while len(_ready) > READY:
                _ready.popitem(last=False)
        _ready.move_to_end(key)
        return search
