"""A joint fit of runs that may start in motion: which of its initial terms the runs ask for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ftlm import _core
from ftlm.base.errors import FtlmError
from ftlm.base.progress import Course
from ftlm.data.run import Run
from ftlm.data.settings import Loss
from ftlm.data.structures import History, Initial, Structure
from ftlm.fit.joint import RACED, SWEEP, JointFit, Outset, fit_output_error
from ftlm.fit.problem import FreeProblem
from ftlm.solve.motion import has_memory, history, misfit_of_fits, needed, together
from ftlm.solve.past import in_motion


def fit_any_start(
    runs: Sequence[Run], structure: Structure, start: Initial, *, threads: int = 1,
    progress: Callable[[int, int], None] | None = None, loss: Loss = "squares",
    known: Sequence[Mapping[str, float]] = (), alone: bool = False,
) -> JointFit:  # fmt: skip
    """Fit a structure on runs whose initial terms look like `start`, and decide by the fit where it leaves them open.

    Alone, the first of what is known is the only start.

    A fit with a history is kept unless Caputo's terms leave residuals that are as good; a fit from rest unless a
    history makes them much better. Which terms were fitted is in the result.
    """

    def fitted(initial: Initial, *, refine: bool = True, raced: _core.JointRace | None = None) -> JointFit:
        asked = replace(structure, initial=initial)
        begun = partial(fit_output_error, start=known[0]) if alone else partial(fit_output_error, known=known)
        return begun(runs, asked, threads=threads, refine=refine, progress=progress, loss=loss, raced=raced)

    decided = structure.initial != "auto" or not has_memory(structure) or structure.has_friction
    if not decided and isinstance(start, History):
        # Where few terms are enough on the first grid, finer ones are for them alone: what a coarse grid leaves asks
        # for more terms, not for fewer.
        outset = Outset.of(runs, replace(structure, initial=start))
        raced = None if alone else outset.race(threads, Course(progress).until(RACED, SWEEP))
        many = fitted(start, refine=False, raced=raced)
        kept = _shorter(many, runs, structure, loss, refine=False)
        if kept.growth is None and many.growth is None:
            asked = replace(structure, initial=kept.initial)
            fine = fit_output_error(runs, asked, near=kept, loss=loss, raced=raced)
            fine = replace(fine, starts=many.starts, origin=many.origin)
            return fine if kept is not many else _shorter(fine, runs, structure, loss, refine=True)
        # Where a free run may grow, the starts of the race are asked on every grid.
        return _shorter(fitted(start, raced=raced), runs, structure, loss, refine=True)
    joint = fitted(start)
    if decided or start != "rest" or not _moved(joint, runs, structure):
        return joint
    return fitted(together([history(run, structure) for run in runs]) or history(runs[0], structure))


def _shorter(joint: JointFit, runs: Sequence[Run], structure: Structure, loss: Loss, *, refine: bool) -> JointFit:
    """The fit with Caputo's terms where they are enough, else the one with a history."""
    try:
        few = _from(joint, runs, replace(structure, initial="caputo"), loss, refine=refine)
    except FtlmError:
        # From here it has no finite free run, so it is not enough.
        return joint
    return joint if asks_for_history(few, joint, runs, structure) else few


def _from(
    joint: JointFit, runs: Sequence[Run], structure: Structure, loss: Loss, *, refine: bool = False
) -> JointFit:  # fmt: skip
    """A fit of another structure from where one ended; where it is not refined, on a grid as coarse as it allows."""
    values = dict(zip(joint.names, joint.values.tolist(), strict=True))
    return fit_output_error(runs, structure, start=values, loss=loss, refine=refine)


def instead_of_history(joint: JointFit, runs: Sequence[Run], structure: Structure) -> JointFit | None:
    """A fit with Caputo's terms and a constant in each equation that leaves no more than one with a history, if any."""
    asked = replace(structure, offset="constant")
    loss: Loss = "squares" if joint.robust is None else "huber"
    try:
        few = _from(joint, runs, replace(asked, initial="caputo"), loss)
        # On the same kind of grid: what a coarse one leaves is no history.
        many = _from(joint, runs, replace(structure, initial=joint.initial), loss)
    except FtlmError:
        return None
    fewer = few.initial_terms < many.initial_terms
    return few if fewer and not asks_for_history(few, many, runs, asked) else None


def asks_for_history(few: JointFit, many: JointFit, runs: Sequence[Run], structure: Structure) -> bool:
    """Whether a fit with few initial terms leaves more than one with a history."""
    outputs = structure.outputs
    ours, theirs = (
        [fit.noise[o] * np.concatenate([part[o] for part in fit.residuals]) for o in outputs] for fit in (few, many)
    )
    sizes = [float(np.nanstd(np.concatenate([run[o] for run in runs]))) for o in outputs]
    return needed(structure, misfit_of_fits(ours, theirs, sizes), many.initial_terms - few.initial_terms)


def _moved(joint: JointFit, runs: Sequence[Run], structure: Structure) -> bool:
    """Whether what a fit from rest leaves over asks for a history."""
    problem = FreeProblem.of(structure)
    numbers = problem.named(list(joint.coefficients.values()))
    return in_motion(structure.with_orders(joint.orders).with_coefficients(numbers).with_inputs(joint.inputs), runs)
