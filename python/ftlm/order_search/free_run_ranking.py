"""Ranking of candidates with non-linear terms by their free runs, after a ranking by equation error.

The free run of a linear candidate has a lower bound that excludes most candidates without simulation. No such bound
holds for a non-linear one, and each free run is a computation of its own: only the best by equation error get one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from msgspec import UNSET

from ftlm.data.run import Run
from ftlm.errors import FtlmError, ModelError
from ftlm.model.model import Model
from ftlm.order_search.options import Norm
from ftlm.order_search.result import SearchRow
from ftlm.simulation.discretization import Record
from ftlm.simulation.output_samples import simulate_samples
from ftlm.structure.structure import Structure
from ftlm.utils.validation import Floats

#: Candidates of an order search that get a free run.
FREE_RUN_CANDIDATES = 300


def record_run(rec: Record, structure: Structure) -> Run:
    """Return a record as a run whose pulse means are those of the record; samples of outputs are means of neighbors."""
    rows = {name: rec.of(name) for name in structure.signals}
    inputs = {
        name: np.append(row, row[-1])
        for (name, row), is_input in zip(rows.items(), rec.inputs, strict=False)
        if is_input
    }
    outputs = {
        name: np.concatenate([[1.5 * row[0] - 0.5 * row[1]], (row[:-1] + row[1:]) / 2, [1.5 * row[-1] - 0.5 * row[-2]]])
        for name, row in rows.items()
        if name not in inputs
    }
    return Run.from_arrays(step=rec.step, inputs=inputs, outputs=outputs, intersample=dict.fromkeys(inputs, "zoh"))


def record_structure(rec: Record, structure: Structure) -> Structure:
    """Return a structure for the run of a record, whose inputs have passed delays and nonlinearities."""
    return replace(
        structure, delay={}, free_delays={}, input_nonlinearities=UNSET, initial=rec.initial, offset=rec.offset
    )


def free_run_errors(model: Model, rec: Record, run: Run) -> dict[str, Floats]:
    """Return measured minus simulated pulse means by output; not finite where the free run diverges."""
    simulated, _ = simulate_samples(replace(model, structure=record_structure(rec, model.structure)), run, 1, None)
    with np.errstate(over="ignore", invalid="ignore"):
        return {
            name: rec.of(name) - (row[:-1] + row[1:]) / 2 for name, row in zip(model.outputs, simulated, strict=True)
        }


def free_run_score(
    model: Model, records: Sequence[Record], runs: Sequence[Run], norm: Norm, scales: Sequence[float]
) -> float:
    """Return the score of a model by its free runs: error (45), or RMSE, summed over outputs in units of their scales.

    Infinite where a free run diverges or a pulse has no solution.
    """
    try:
        errors = [free_run_errors(model, rec, run) for rec, run in zip(records, runs, strict=True)]
    except FtlmError:
        return math.inf
    score = 0.0
    for name, scale in zip(model.outputs, scales, strict=True):
        left = np.concatenate([e[name] for e in errors])
        with np.errstate(over="ignore", invalid="ignore"):
            own = float(np.abs(left).sum()) if norm == "l1" else math.sqrt(float(np.mean(left**2)))
        score += own / scale
    return score if math.isfinite(score) else math.inf


def rank_by_free_runs(
    table: Sequence[SearchRow], structure: Structure, records: Sequence[Record], norm: Norm, scales: Sequence[float]
) -> list[SearchRow]:
    """Return the rows with a finite free run, by its score.

    Raises
    ------
    ModelError
        No row has a finite free run.
    """
    runs = [record_run(rec, structure) for rec in records]
    scored = []
    for row in table:
        model = Model(structure.with_orders(row.orders).with_coefficients(row.coefficients))
        score = free_run_score(model, records, runs, norm, scales)
        if math.isfinite(score):
            scored.append(replace(row, score=score))
    if not scored:
        raise ModelError(
            f"the free runs of the best {len(table)} candidates by equation error all diverge; check the signs of the "
            "non-linear terms, or search by equation error"
        )
    scored.sort(key=lambda row: (row.score, row.index))
    return [replace(row, rank=rank) for rank, row in enumerate(scored, 1)]
