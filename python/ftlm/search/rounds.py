"""The rounds of a search: done here or by an executor, kept in a store or not, to the same bits.

Rounds form waves (see the core's search): those of a wave depend only on the rows kept before it, so they may be done
anywhere and in any order. Under an order law candidates of the equations take the place of rounds: what those of a wave
are, and how far each is followed, depends only on the waves before. An executor gets index ranges. What they are
computed from is sent only to a worker that says it has not got it, once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import Executor
from functools import partial
from typing import Any, cast

import msgspec

from ftlm import _core
from ftlm.base.errors import ModelError
from ftlm.search.contents import Section
from ftlm.search.frames import Joined
from ftlm.search.store import Store
from ftlm.search.waves import Course, Done, EquationCourse, StageCourse
from ftlm.search.work import EquationWork, StageWork, Table, Told
from ftlm.search.workers import Stretch, shipped


def search_equation(
    work: EquationWork, *, store: Store | None, number: int, executor: Executor | None, progress: Told | None
) -> _core._Found:
    """Search the orders of one equation: at once here, or in rounds with a store (its search `number`) or executor."""
    if store is None and executor is None:
        return work.search(progress)
    algorithm = None if store is None else store.contents.algorithm
    return _do(EquationCourse(work, algorithm), store, number, executor, progress)


def search_stage(
    work: StageWork, *, store: Store | None, number: int, executor: Executor | None, progress: Told | None
) -> _core._FoundStage:
    """Search a stage under its order law, as :func:`search_equation`; a finished search is only read."""
    if store is None and executor is None:
        return work.search(progress)
    joined = None if store is None else store.contents.sections[number].joined
    if joined is not None:
        return _table(work, joined)
    table = _do(StageCourse(work), store, number, executor, progress)
    if store is not None:
        store.joined(number, table)
    return table


def _do(
    course: Course[Done, Table], store: Store | None, number: int, executor: Executor | None, progress: Told | None
) -> Table:
    """Do all that a store does not hold yet, wave by wave, and join."""
    section = None if store is None else store.contents.sections[number]
    save = None if store is None else partial(store.save, number)
    pruned = 0
    for first, end in course.waves():
        for held in _held(section, first, end):
            course.take(held)
        left = list(_left(section, first, end))
        if left and store is not None and not course.goes_on:
            raise store.outdated()
        if executor is None:
            pieces = course.here(left, progress, save)
        else:
            pieces = shipped(course.task, left, executor, course.pace)
        for stretch, piece in pieces:
            frame = course.frame(number, stretch, piece)
            if store is not None:
                store.done(frame)
            pruned += course.take(frame)
            if progress is not None and not (course.core_tells and executor is None):
                progress(course.done, course.total, pruned)
    if section is not None and section.law and section.dealt != course.total:
        raise ModelError(f"it holds {section.dealt} candidates of {course.total}")
    if progress is not None:
        progress(course.total, course.total, 0)
    return course.table()


def equation_state(work: EquationWork, section: Section) -> tuple[int, float | None]:
    """Candidates of one equation, and the best score so far."""
    best = section.best
    if best is not None and work.settings.norm == "l2":
        best = math.sqrt(max(best, 0.0) / work.samples)
    return work.plan()[0], best


def stage_state(work: StageWork, section: Section) -> tuple[int, float | None]:
    """Candidates that the search of a stage follows, as far as a store tells, and the best score so far."""
    if section.joined is not None:
        return section.dealt, _table(work, section.joined)["rows"][0][1]
    course = StageCourse(work)
    for first, end in course.waves():
        for held in _held(section, first, end):
            course.take(held)
        if any(_left(section, first, end)):
            break
    return course.search.state()


def _table(work: StageWork, joined: Joined) -> _core._FoundStage:
    """The table of a finished search as the core gives it; refuse one of another search."""
    widths = [len(terms) for _, _, terms in work.laws]
    dealt = sum(v for k, v in joined.counts.items() if k != "candidates")
    sound = (
        set(joined.counts) == {"candidates", "kept", "beaten", "bound", "stopped early", "singular", "diverged"}
        and dealt == joined.counts["candidates"]
        and 0 < len(joined.rows) == joined.counts["kept"] <= work.settings.keep
        and all(len(free) == len(work.axes) for _, free, _ in joined.failures)
        and all(len(free) == len(work.axes) for _, _, free, _ in joined.rows)
        and all([len(p[3]) for p in parts] == widths for _, _, _, parts in joined.rows)
    )
    if not sound:
        raise ModelError("its table is of another search")
    table = msgspec.to_builtins({"rows": joined.rows, "counts": joined.counts, "failures": joined.failures})
    return cast("_core._FoundStage", {**table, "distinct": []})


def _held(section: Section | None, first: int, end: int) -> list[Any]:
    """What a store holds of a wave."""
    return [] if section is None else [frame for at, frame in section.done.items() if first <= at < end]


def _left(section: Section | None, first: int, end: int) -> Iterator[Stretch]:
    """Stretches of a wave that are not done: half done ones as they stand, and the gaps between."""
    known: list[Stretch] = []
    if section is not None:
        known = [Stretch(at, frame.last) for at, frame in section.done.items()]
        known += [Stretch(at, half.last, half.checkpoint) for at, half in section.open.items()]
    at = first
    for stretch in sorted(known, key=lambda s: s.first):
        if not first <= stretch.first < end:
            continue
        if at < stretch.first:
            yield Stretch(at, stretch.first)
        if stretch.start is not None:
            yield stretch
        at = stretch.last
    if at < end:
        yield Stretch(at, end)
