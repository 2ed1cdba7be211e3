"""A second rival beside the genetic baseline: differential evolution, by SciPy, on the same genes and budget."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.checks import check_threads
from ftlm.base.errors import ModelError
from ftlm.data.lattice import Lattice
from ftlm.data.structures import Structure
from ftlm.fit.genetic import Genetic, GeneticRun, Problem
from ftlm.solve.records import Record

#: Candidates a generation for each gene: SciPy's own.
EACH = 15
#: Logarithm of an error that is not finite: above those of all that are.
DIVERGED = 1e3


def differential_evolution_search(
    records: list[Record], structure: Structure, lattice: Lattice, settings: Genetic, *, norm: str = "l1",
    threads: int | None = None, progress: Callable[[int, int], None] | None = None,
) -> GeneticRun:  # fmt: skip
    """Minimise the error of the free run by differential evolution, within what the genetic baseline is given.

    Seeds, evaluations and bounds are those of `settings`; everything else is as SciPy has it (best1bin, 15 candidates a
    gene), with as many whole generations as the evaluations are enough for, and no local search at the end.

    Raises
    ------
    ModelError
        SciPy is not installed, a record that does not start at rest, no candidate with a finite error.
    """
    try:
        from scipy.optimize import differential_evolution  # type: ignore[import-untyped]  # noqa: PLC0415 — an extra; only this rival needs it
    except ImportError:
        raise ModelError("differential evolution needs SciPy; pip install 'ftlm[genetic]'") from None
    if records[0].start != (False, []) or records[0].offset != "none":
        raise ModelError("differential evolution knows no initial terms and no offset; slice the runs to start at rest")
    problem = Problem(records, structure, lattice, settings, norm, check_threads(threads))
    wanted = settings.evaluations or problem.size
    bounds = [problem.bounds[n] for n in problem.names]
    generation = EACH * sum(low < high for low, high in bounds)
    generations = max(0, math.ceil(wanted / generation) - 1)
    total, done = (generations + 1) * generation * len(settings.seeds), 0

    def errors(columns: Floats) -> Floats:
        nonlocal done
        rows = np.ascontiguousarray(columns.T if columns.ndim == 2 else columns[None, :])
        done += rows.shape[0]
        if progress is not None:
            progress(min(done, total), total)
        # Only comparisons count, and the spread of errors over hundreds of decades is no number.
        with np.errstate(divide="ignore"):
            return np.clip(np.log(problem.errors(rows, math.inf)), -DIVERGED, DIVERGED)

    ends: dict[int, Any] = {}
    for seed in settings.seeds:
        ends[int(seed)] = differential_evolution(
            errors, bounds, maxiter=generations, popsize=EACH, tol=0.0, polish=False, updating="deferred",
            vectorized=True, rng=np.random.default_rng(int(seed)),
        )  # fmt: skip
    best = min(ends.values(), key=lambda end: float(end.fun))
    if best.fun >= DIVERGED:
        raise ModelError("no candidate of differential evolution had a finite error; narrow its bounds")
    orders, coefficients = problem.named(np.asarray(best.x, dtype=np.float64))
    each = {seed: math.exp(end.fun) if end.fun < DIVERGED else math.inf for seed, end in ends.items()}
    # SciPy counts calls, of a generation each.
    evaluations = {seed: int(end.nfev) * generation for seed, end in ends.items()}
    return GeneticRun(orders, coefficients, each, evaluations, problem.bounds)
