"""Whether a run that looks like rest at its start was in motion before, as a model tells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.errors import FtlmError
from ftlm.base.statistics import chi_squared, colour
from ftlm.data.readings import read
from ftlm.data.run import Run
from ftlm.data.solved import Solved
from ftlm.data.structures import Structure
from ftlm.solve.motion import decided, has_memory, history, misfit, missed
from ftlm.solve.sampled import FIRST_REFINEMENT, measured_samples, own_times, sampled

#: A run whose first values look like rest is in motion where its residuals would ask for a history in this share of
#: runs at rest only: a first value near zero is rare for a run in motion, and common for one at rest. At a share of
#: 0.001 pasts that bias orders by five standard errors still go unseen, at 0.05 each twentieth run from rest pays.
RARE = 0.01


#: A run is said to have been in motion if estimating its past halves what the model leaves over at least, by so many
#: points of fit, and to this many standard deviations or less; a model that misses more than MISSES of them from rest
#: tells nothing of the run.
HALVES, POINTS, FOLLOWS, MISSES = 0.5, 0.01, 0.2, 3.0


@dataclass(frozen=True)
class Left:
    """What a structure leaves over of a run from rest and with a history, a row an output.

    ``terms`` are those of the history, ``sizes`` those of the outputs.
    """

    rest: Floats
    past: Floats
    terms: int
    sizes: Floats


def in_motion(structure: Structure, runs: Sequence[Run]) -> bool:
    """Whether what a solved structure leaves over of runs from rest, of all together, asks for a history."""
    left = []
    for run in runs:
        if (one := _left(structure, run)) is None:
            return False
        left.append(one)
    return _asks(left)


def _asks(left: Sequence[Left]) -> bool:
    """Whether all together ask for a history."""
    terms = sum(one.terms for one in left)
    excess = sum(misfit([*one.rest], [*one.past], one.sizes.tolist()) for one in left)
    # Noise that is coloured is followed by slow terms in any run.
    spread = max([1.0, *(colour(read(past)) for one in left for past in one.past)])
    return terms > 0 and excess / spread > chi_squared(terms, RARE)


def _left(structure: Structure, run: Run) -> Left | None:
    """The free runs of both starts beside the measurement; None without numbers."""
    ends, terms = [], 0
    for start in ("rest", history(run, structure)):
        model = Solved(replace(structure, initial=start))
        try:
            samples, found = sampled(model, run, FIRST_REFINEMENT, None, own_times(model, run))
        except FtlmError:
            return None
        if not np.all(np.isfinite(samples)):
            return None
        ends.append(missed(measured_samples(model, run, FIRST_REFINEMENT), samples))
        terms = sum(map(len, found.values()))
    return Left(ends[0], ends[1], terms, np.nanstd([run[o] for o in structure.outputs], axis=1))


def looked_like_rest(model: Solved, runs: Sequence[Run]) -> list[str]:
    """Names of the runs that a model which leaves initial terms open takes for at rest, and that were in motion."""
    structure = model.structure
    if structure.initial != "auto" or structure.has_friction or not has_memory(structure):
        return []
    looked = ((run.name, _left(structure, run)) for run in runs if decided(run, structure) == "rest")
    return [name for name, left in looked if left is not None and _told_by(left) and _asks([left])]


def _told_by(left: Left) -> bool:
    """Whether a model follows a run with a history, and misses it from rest, by enough to be said."""
    rest, past = (np.sqrt(np.nanmean(end**2, axis=1)) / left.sizes for end in (left.rest, left.past))
    return bool(np.any(
        (past <= HALVES * rest) & (rest - past >= POINTS) & (past <= FOLLOWS) & (rest <= MISSES)
    ))  # fmt: skip
