"""How long searches take, measured on their own records: the same search on lattices so coarse that it is soon done.

Between two records of one lattice the time differs a hundred times, as more or fewer candidates are excluded.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from ftlm.base.errors import FtlmError
from ftlm.base.progress import Progress
from ftlm.search.job import Job
from ftlm.search.store import Store

#: Every so manieth value of each order is tried, the coarsest lattices first.
COARSER = (16, 12, 10, 8, 6, 5, 4, 3, 2)
#: What is tried has at most this share of the candidates; enough is known once it takes so long [s].
SHARE, ENOUGH = 1 / 12, 0.3
#: Time grows as candidates to a power between these: of finer lattices more is excluded.
GROWTH = (0.7, 1.1)
#: Searches came to between these multiples of what coarse lattices told of them.
CAME_TO = (0.6, 4.0)
#: Candidates from which on whole boxes of them may be excluded, which no coarse lattice shows, and the growth then.
BOXED, IN_BOXES = 1 << 25, 0.5


def announce(progress: object, jobs: Sequence[Job], store: Store | None = None) -> None:
    """Say how long all of these searches take together, where somebody sees it; with a store, what is left of them."""
    if not isinstance(progress, Progress) or progress.quiet:
        return
    least = most = 0.0
    for number, job in enumerate(jobs):
        left = 1.0 if store is None else _left(job, store, number)
        low, high = expected_seconds(job) if left > 0 else (0.0, 0.0)
        least, most = least + left * low, most + left * high
    progress.expect("the search", least, most)


def expected_seconds(job: Job, clock: Callable[[], float] = time.perf_counter) -> tuple[float, float]:
    """Least and most time that a search is expected to take here [s]; both 0 where its lattice is too small to tell.

    Takes up to a tenth of the search or half a second, whichever is less.
    """
    whole = _candidates(job)
    tried: list[tuple[float, float]] = []
    for every in COARSER:
        part = replace(job, values={name: axis[::every] for name, axis in job.values.items()}, progress=None)
        try:
            count = _candidates(part)
            if tried and count <= tried[-1][0]:
                continue
            if count > SHARE * whole:
                break
            begun = clock()
            (part.stage_work() if job.structure.has_order_law else part.equation_work()).search(None)
        except FtlmError:
            # So coarse a lattice may have no candidate, or none with a finite score.
            continue
        tried.append((count, clock() - begun))
        if tried[-1][1] >= ENOUGH:
            break
    if not tried:
        return 0.0, 0.0
    (count, took), power = tried[-1], GROWTH[1]
    if len(tried) > 1 and tried[-2][1] > 0:
        power = math.log(max(took / tried[-2][1], 1e-9)) / math.log(count / tried[-2][0])
        power = min(max(power, GROWTH[0]), GROWTH[1])
    grown = took * (whole / count) ** power
    boxed = grown if whole < BOXED else took * (BOXED / count) ** power * (whole / BOXED) ** IN_BOXES
    return CAME_TO[0] * boxed, CAME_TO[1] * grown


def _candidates(job: Job) -> float:
    """How many candidates a search has; under an order law, points of the lattice."""
    if job.structure.has_order_law:
        return float(math.prod(len(axis) for axis in job.values.values()))
    return float(job.equation_work().plan()[0])


def _left(job: Job, store: Store, number: int) -> float:
    """The share of a search that a store does not hold."""
    section = store.contents.sections[number]
    if job.structure.has_order_law:
        return 0.0 if section.joined is not None else 1.0
    return 1.0 - min(section.dealt / _candidates(job), 1.0)
