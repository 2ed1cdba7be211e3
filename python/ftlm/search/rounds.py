"""The rounds of a search: done here or by an executor, kept in a store or not, to the same bits.

Rounds form waves (see the core's search): those of a wave depend only on the rows kept before it, so they may be done
anywhere and in any order. Under an order law candidates of the equations take the place of rounds: what those of a wave
are, and how far each is followed, depends only on the waves before. An executor gets index ranges. What they are
computed from is sent only to a worker that says it has not got it, once.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from typing import Any, cast

import msgspec

from ftlm import _core
from ftlm.base.errors import ModelError
from ftlm.search.frames import Found, Joined, Part, Section, Span
from ftlm.search.store import Store
from ftlm.search.work import StageWork, Work, some_candidates, some_rounds
from ftlm.search.workers import Pace, Stretch, shipped

#: Time [s] between two writes of what candidates under an order law came to: what is lost is not much more.
PIECE = 0.25
#: Fewest candidates under an order law that are followed or sent together: the first wave, so that the first worker to
#: be asked gets the record before the others are.
FEWEST = 256


def do_rounds(
    work: Work,
    *,
    store: Store | None,
    number: int,
    executor: Executor | None,
    threads: int,
    progress: Callable[[int, int, int], None] | None,
) -> list[Part]:
    """Do all rounds that a store does not hold yet.

    Parameters
    ----------
    work
        The search.
    store, number
        Where parts are kept, and the number of this search in it.
    executor
        Who does them; None: this process.
    threads
        Threads of a task.
    progress
        Called with candidates done, in all, and 0.

    Returns
    -------
    list of Part
        What the rounds came to.

    Raises
    ------
    ConvergenceError
        An executor that has lost its workers.
    DataError
        A store that cannot be written.
    """
    total, ends = work.plan()
    keep = work.settings[5]
    section = None if store is None else store.contents.sections[number]
    parts: list[Part] = []
    search: _core.OrderSearch | None = None
    first = 0
    for end in ends:
        # The rows that all rounds of this wave know.
        best = sorted({(row[1], row[0]) for part in parts for row in part[0]})[:keep]
        seed = [(index, score) for score, index in best]
        held = [] if section is None else [p for f, (_, p) in section.done.items() if first <= f < end]
        left = list(_left(section, first, end))
        done = sum(sum(part[1][1:]) for part in (*parts, *held))
        if left and executor is None:
            search = search or work.ready()
            for stretch in left:
                told = None if progress is None else _from(progress, done, total)
                save = None if store is None else _saver(store, number, stretch)
                start = stretch.start
                part = cast("Part", search.rounds(stretch.first, stretch.last, seed, start, threads, told, save))
                _keep(store, number, stretch, part)
                held.append(part)
                done += sum(part[1][1:])
        elif left and executor is not None:
            key = work.key

            def send(stretch: Stretch, seed: list[tuple[int, float]] = seed, key: str = key) -> tuple[Any, ...]:
                payload = work if stretch.sent else None
                return some_rounds, key, payload, stretch.first, stretch.last, seed, stretch.start, threads

            for stretch, part in cast("Iterator[tuple[Stretch, Part]]", shipped(send, left, executor, Pace())):
                _keep(store, number, stretch, part)
                held.append(part)
                done += sum(part[1][1:])
                if progress is not None:
                    progress(done, total, 0)
        parts = [*_trimmed(parts, keep), *held]
        first = end
    if progress is not None:
        progress(total, total, 0)
    return parts


def _trimmed(parts: list[Part], keep: int) -> list[Part]:
    """Parts without the rows that better ones have pushed out."""
    ranked = sorted({(row[1], row[0]) for part in parts for row in part[0]})
    if len(ranked) <= keep:
        return parts
    worst = ranked[keep - 1]
    return [(tuple(r for r in rows if (r[1], r[0]) <= worst), counts, failed) for rows, counts, failed in parts]


def _from(progress: Callable[[int, int, int], None], done: int, total: int) -> Callable[[int, int, int], None]:
    return lambda here, _, pruned: progress(min(done + here, total), total, pruned)


def _saver(store: Store, number: int, stretch: Stretch) -> Callable[[Any], None]:
    return lambda checkpoint: store.save(number, stretch.first, stretch.last, checkpoint)


def _keep(store: Store | None, number: int, stretch: Stretch, part: Part) -> None:
    if store is not None:
        store.done(number, stretch.first, stretch.last, part)


def do_stage(
    work: StageWork,
    *,
    store: Store | None,
    number: int,
    executor: Executor | None,
    threads: int,
    progress: Callable[[int, int, int], None] | None,
) -> _core._FoundStage:
    """Search a stage under its order law: follow all candidates that a store does not hold yet, and join.

    Parameters
    ----------
    work
        The search.
    store, number, executor, threads, progress
        As for :func:`do_rounds`; candidates are those of the equations.

    Returns
    -------
    dict
        Table, counts and failures.

    Raises
    ------
    ConvergenceError
        An executor that has lost its workers.
    DataError
        A store that cannot be written.
    ModelError
        A store that holds other candidates.
    """
    section = None if store is None else store.contents.sections[number]
    if section is not None and section.joined is not None:
        return _table(work, section.joined)
    search = work.ready(keeps_course=True)
    pace = Pace(fewest=FEWEST)
    key, first, pruned = work.key, 0, 0
    while spans := search.wanted():
        end = first + sum(last - start for _, start, last, _ in spans)
        held = {} if section is None else {f: s for f, s in section.followed.items() if first <= f < end}
        left = list(_left(section, first, end))
        done = end - sum(s.last - s.first for s in left)
        total, _ = search.state()

        def send(stretch: Stretch, spans: list[Span] = spans, first: int = first) -> tuple[Any, ...]:
            some = cut(spans, stretch.first - first, stretch.last - first)
            return some_candidates, key, work if stretch.sent else None, some, threads

        came = (
            _followed(search, spans, first, left, threads, pace)
            if executor is None
            else cast("Iterator[tuple[Stretch, Found]]", shipped(send, left, executor, pace))
        )
        for stretch, (values, kinds) in came:
            if store is not None:
                store.followed(number, stretch.first, stretch.last, values, kinds)
            held[stretch.first] = (stretch.last, values, kinds)
            done += len(kinds)
            pruned += kinds.count(1) + kinds.count(2)
            if progress is not None:
                progress(done, total, pruned)
        search.take(*_whole(held, first, end), threads)
        first = end
    if section is not None and section.dealt != first:
        raise ModelError(f"it holds {section.dealt} candidates of {first}")
    if progress is not None:
        progress(first, first, 0)
    found = search.outcome()
    if store is not None:
        store.joined(number, found)
    return found


def stage_state(work: StageWork, section: Section, threads: int) -> tuple[int, float | None]:
    """Candidates that the search of a stage follows, as far as a store tells, and the best score so far.

    Raises
    ------
    ModelError
        A store that holds other candidates.
    """
    if section.joined is not None:
        return section.dealt, _table(work, section.joined)["rows"][0][1]
    search = work.ready(keeps_course=True)
    first = 0
    while spans := search.wanted():
        end = first + sum(last - start for _, start, last, _ in spans)
        held = {f: s for f, s in section.followed.items() if first <= f < end}
        if list(_left(section, first, end)):
            break
        search.take(*_whole(held, first, end), threads)
        first = end
    return search.state()


def _table(work: StageWork, joined: Joined) -> _core._FoundStage:
    """The table of a finished search as the core gives it.

    Raises
    ------
    ModelError
        One of another search.
    """
    widths = [len(terms) for _, _, terms in work.laws]
    dealt = sum(v for k, v in joined.counts.items() if k != "candidates")
    sound = (
        set(joined.counts) == {"candidates", "kept", "beaten", "bound", "stopped early", "singular", "diverged"}
        and dealt == joined.counts["candidates"]
        and 0 < len(joined.rows) == joined.counts["kept"] <= work.settings[5]
        and all(len(free) == len(work.axes) for _, free, _ in joined.failures)
        and all(len(free) == len(work.axes) for _, _, free, _ in joined.rows)
        and all([len(p[3]) for p in parts] == widths for _, _, _, parts in joined.rows)
    )
    if not sound:
        raise ModelError("its table is of another search")
    found = msgspec.to_builtins({"rows": joined.rows, "counts": joined.counts, "failures": joined.failures})
    return cast("_core._FoundStage", {**found, "distinct": []})


def _followed(
    search: _core.StageSearch, spans: list[Span], first: int, left: list[Stretch], threads: int, pace: Pace
) -> Iterator[tuple[Stretch, Found]]:
    """Follow the candidates of stretches here, in pieces of about :data:`PIECE` seconds."""
    for stretch in left:
        at = stretch.first
        while at < stretch.last:
            piece = Stretch(at, min(stretch.last, at + pace.size(PIECE)))
            began = time.monotonic()
            found = search.follow(cut(spans, piece.first - first, piece.last - first), threads, None)
            pace.took(time.monotonic() - began, piece.last - piece.first)
            yield piece, found
            at = piece.last


def cut(spans: list[Span], first: int, last: int) -> list[Span]:
    """The candidates ``first … last − 1`` of spans, counted through all of them."""
    found = []
    at = 0
    for equation, start, end, limit in spans:
        low, high = max(first - at, 0), min(last - at, end - start)
        if low < high:
            found.append((equation, start + low, start + high, limit))
        at += end - start
    return found


def _whole(held: dict[int, tuple[int, bytes, bytes]], first: int, end: int) -> Found:
    """Verdicts of a wave in their order.

    Raises
    ------
    ModelError
        Stretches that do not make it up.
    """
    at, values, kinds = first, [], []
    for start, (last, some, of) in sorted(held.items()):
        if start != at:
            break
        at = last
        values.append(some)
        kinds.append(of)
    if at != end:
        raise ModelError(f"candidates {first} to {end} are cut up otherwise")
    return b"".join(values), b"".join(kinds)


def _left(section: Any, first: int, end: int) -> Iterator[Stretch]:
    """Stretches of a wave that are not done: half done ones as they stand, and the gaps between."""
    if section is None:
        yield Stretch(first, end)
        return
    known = [(f, last, None) for f, (last, *_) in (*section.done.items(), *section.followed.items())]
    known += [(f, half.last, half.checkpoint) for f, half in section.open.items()]
    at = first
    for start, last, checkpoint in sorted(known, key=lambda k: k[0]):
        if not first <= start < end:
            continue
        if at < start:
            yield Stretch(at, start)
        if checkpoint is not None:
            yield Stretch(start, last, checkpoint)
        at = last
    if at < end:
        yield Stretch(at, end)
