"""Samples of a free run on ever finer grids, until they stand still."""

from __future__ import annotations

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.errors import ModelError
from ftlm.data.run import Run
from ftlm.data.solved import Solved
from ftlm.solve.friction import begun
from ftlm.solve.instants import has_own_times
from ftlm.solve.limit import Limit
from ftlm.solve.long import long_run
from ftlm.solve.records import MAX_M, record
from ftlm.solve.sampled import (
    FIRST_REFINEMENT,
    FRICTION_REFINEMENT,
    Sampled,
    Terms,
    begun_terms,
    own_times,
    sampled,
    started,
)


def refined(
    model: Solved, run: Run, initial: Terms | None, *, tolerance: float, largest_m: int = MAX_M, on_grid: bool = False
) -> Sampled:
    """Samples on grids refined, and extrapolated in the step, until they stand still or the pulses run out.

    A long record is refined only as far as that moves it (:func:`ftlm.solve.long.long_run`).

    Parameters
    ----------
    initial
        Coefficients of initial terms by output and exponent; None: those that bring the run closest to the measured
        outputs, each weighted by its own deviation.
    tolerance
        Change, as a share of each output's largest value, at which refinement ends.
    on_grid
        Whether the instants are those of the run's grid although its rows have times of their own.
    """
    own = run.length - 1
    every = FIRST_REFINEMENT
    if initial is None and model.structure.has_friction:
        # Level and velocity at the start are found by descent, whose ends scatter by more than steps move them.
        rec = record(run, model.structure, FRICTION_REFINEMENT * own, filtered=False)
        initial = begun_terms(model, begun(model, run, rec, FRICTION_REFINEMENT))
    elif initial is None:
        model = started(model, run)
    long = long_run(model, run, initial, tolerance=tolerance, largest_m=largest_m)
    if long is not None:
        return long
    times = run.time if on_grid and has_own_times(run, model.structure) else own_times(model, run)
    limit, lost = Limit(), 0
    while True:
        last = 2 * every * own > largest_m
        samples, terms = _tried(model, run, every, initial, times, last=lost == 1)
        finite = bool(np.all(np.isfinite(samples)))
        owners = [i for i, o in enumerate(model.outputs) for _ in terms[o]]
        limit.add(samples, np.array([v for o in model.outputs for v in terms[o].values()]))
        told = limit.told(owners, enough=tolerance)
        # A stiff equation may have no stable scheme on a coarse grid; one that has none on two in a row has none.
        lost = 0 if finite or every == FIRST_REFINEMENT else lost + 1
        if last or lost == 2 or np.all(told.change <= tolerance):
            break
        every *= 2
    return Sampled(told.samples, _like(terms, told.beside), every, told.change)


def _like(terms: Terms, values: Floats) -> dict[str, dict[float, float]]:
    """Initial terms of these outputs and exponents with other values."""
    left = iter(values.tolist())
    return {o: {e: next(left) for e in powers} for o, powers in terms.items()}


def _tried(
    model: Solved, run: Run, every: int, initial: Terms | None, times: Floats | None, *, last: bool = False
) -> tuple[Floats, dict[str, dict[float, float]]]:
    """Samples on one grid; no numbers where it happens to make the equations unsolvable, unless it is the last try."""
    try:
        return sampled(model, run, every, initial, times)
    except ModelError:
        # An own coefficient c meets 1 = c h^alpha / gamma(alpha + 2) on one step, not on two.
        if last:
            raise
        count = run.length if times is None else times.size
        return np.full((len(model.outputs), count), np.nan), {o: {} for o in model.outputs}
