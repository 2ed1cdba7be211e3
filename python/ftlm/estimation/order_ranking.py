"""Order search with the verdict that an identification at its best orders gets."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any

import numpy as np

from ftlm.data.run import Run, as_runs
from ftlm.data.sampling import drop_missing
from ftlm.errors import FtlmError
from ftlm.estimation.estimators import fit_at_best_orders
from ftlm.estimation.identify import assess_fit
from ftlm.estimation.result import Task
from ftlm.estimation.verdict import MAX_ORDER_ERROR, verdict_from
from ftlm.findings import Finding, make_finding, unique
from ftlm.order_search.options import Coefficients, Criterion, Norm, OrderGrid, RowBasis, SearchSettings
from ftlm.order_search.result import SearchResult
from ftlm.order_search.search import rank_orders
from ftlm.structure.structure import Structure
from ftlm.utils.arguments import check_arguments
from ftlm.utils.statistics import chi_squared_99, is_constant, variance_inflation
from ftlm.utils.validation import Floats
from ftlm.validation.residual_tests import Residuals


@check_arguments
def search_orders(
    runs: Run | Sequence[Run],
    equation: Structure,
    order_grid: OrderGrid | None = None,
    *,
    criterion: Criterion = "output-error",
    coefficients: Coefficients = "multi-innovation",
    norm: Norm = "l1",
    innovation_length: int = 7,
    prior_covariance: float | None = None,
    row_basis: RowBasis = "haar",
    m: int | None = None,
    top: int = 20,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    pruning: bool = True,
    store: str | os.PathLike[str] | None = None,
    executor: Executor | None = None,
) -> SearchResult:
    """Search the orders of an equation, or of coupled equations under an order law, exhaustively over a grid.

    Each candidate gets coefficients from the equation error, then a score. The table equals that of a full evaluation
    of every candidate, bit for bit for any number of threads on one kind of processor (paper Table 2, steps 5-7).

    Parameters
    ----------
    runs
        One run or several with the same names and units; scores add up.
    equation
        Structure with free orders; see :func:`ftlm.equation` and :func:`ftlm.flexible_link`.
    order_grid
        Intervals and increment; see :func:`ftlm.order_grid`.
    criterion
        ``"output-error"``: the simulation, each equation driven by the measured other outputs. ``"equation-error"``:
        measured signals on the right-hand side; it prefers near-identities.
    coefficients
        ``"multi-innovation"`` (closed form of paper (44)), ``"least-squares"``, or ``"instrumental-variables"``:
        refined instrumental variables for every candidate, which noise on the outputs does not bias. Measured outputs
        that drive an equation are replaced by their projections on what the inputs excite, as instruments and in the
        score.
    norm
        ``"l1"`` (paper (45)) or ``"l2"`` (paper (46)).
    innovation_length, prior_covariance, row_basis
        p and K0 of paper (43)-(44), and whether rows come in Haar coordinates (``"haar"``) or in the order of time
        (``"time"``). Without K0 the prior is weak in any units; see :class:`ftlm.MultiInnovation`. Of
        ``"multi-innovation"`` alone; with other coefficients a change of them is refused.
    m
        Block pulses per run; default 2 048, or what the runs carry.
    top
        Rows of the table.
    threads
        Threads; default all cores.
    progress
        Called about twenty times a second with (candidates done, candidates in all).
    pruning
        Whether to leave a candidate once it cannot be kept, by a proved bound of its score or by its partial sum;
        False is brute force, with the same table.
    store
        File in which finished work is kept, on disk within a second; the same call goes on with it after a power cut,
        and so does :func:`resume_search`.
    executor
        Any :class:`concurrent.futures.Executor` to work for this search: threads, processes, or a cluster's, such as
        ``dask.distributed.Client(…).get_executor()``. The result is the same to the last bit on processors of one kind.
        `threads` are those of one task then, one by default.

    Returns
    -------
    SearchResult
        Table, best model, counts, and the verdict that :func:`ftlm.identify` gives at the orders of rank 1.

    Raises
    ------
    DataError
        Runs that do not fit, or a constant output; a store of another search, in use, damaged, or that cannot be
        written.
    ModelError
        Nothing to search, a grid without or with too many candidates, settings out of range, an option that these
        coefficients do not use; what needs more memory than the machine has left, or than ``FTLM_MEMORY`` allows.
    ConvergenceError
        An executor that has lost its workers.
    KeyboardInterrupt
        Ctrl-C, within half a second.

    Notes
    -----
    One Gram matrix of distinct regressors serves all candidates. Each costs a k x k solve and a lower bound of its
    score from a few inner products. Candidates that the bound does not exclude are simulated, likely ones first, until
    their partial sum exceeds the threshold. Candidates are generated by index, so memory does not grow with their
    number.
    """
    settings: dict[str, Any] = {
        "criterion": criterion,
        "norm": norm,
        "coefficients": coefficients,
        "innovation_length": innovation_length,
        "prior_covariance": prior_covariance,
        "row_basis": row_basis,
        "top": top,
        "pruning": pruning,
    }
    several = as_runs(runs)
    result = rank_orders(
        several,
        equation,
        order_grid,
        m=m,
        threads=threads,
        progress=progress,
        store=store,
        executor=executor,
        **settings,
    )
    return with_verdict(result, several, equation, SearchSettings(**settings), order_grid, m=m)


def with_verdict(
    search: SearchResult,
    runs: Sequence[Run],
    structure: Structure,
    settings: SearchSettings,
    order_grid: OrderGrid | None = None,
    *,
    m: int | None = None,
) -> SearchResult:
    """Return an order search with the verdict and the findings that :func:`ftlm.identify` gives at rank 1."""
    name = "stage" if structure.has_order_law else structure.outputs[0]
    first = replace(search, table=search.table[:1])
    try:
        result = assess_fit(fit_at_best_orders(Task(tuple(runs), structure, order_grid), settings, m, {name: first}))
    except FtlmError as error:
        failed = make_finding("rank_not_judged", method=settings.coefficients, text=str(error))
        return replace(search, verdict=verdict_from([failed]), model_findings=(failed,))
    alike = [] if result.residuals is None else _alike_findings(search, result.residuals)
    return replace(search, verdict=result.verdict, model_findings=unique([*alike, *result.findings]))


def _alike_findings(search: SearchResult, residuals: Residuals) -> list[Finding]:
    """Return a finding on rows whose score exceeds that of rank 1 by no more than noise explains.

    With N independent samples the squares of the truth exceed those of the best of k free orders by a chi-squared
    number with k degrees of freedom, divided by N. Colored residuals count as fewer samples.
    """
    samples = min(sum(map(_independent_samples, o.residuals)) for o in residuals.outputs.values())
    best, distinct = search.table[0], search.distinct_rows
    limit = best.score * math.sqrt(1.0 + chi_squared_99(len(search.orders)) / max(samples, 1.0))
    alike = [row for row, _ in distinct if row.score <= limit]
    if len(alike) < 2:
        return []
    values = {n: [row.orders[n] for row in alike] for n in best.orders}
    spans = {n: (min(own), max(own)) for n, own in values.items()}
    spans_of_change = {n: ends for n, ends in spans.items() if ends[1] > ends[0]}
    decided = all(
        max(high - best.orders[n], best.orders[n] - low) <= MAX_ORDER_ERROR for n, (low, high) in spans.items()
    )
    spans_text = ", ".join(f"{n} {low:.4g} to {high:.4g}" for n, (low, high) in spans_of_change.items())
    last = max(row.rank for row in alike)
    every = ", all that are kept," if alike[-1] is distinct[-1][0] and len(distinct) > 1 else ""
    code = "ranks_alike" if decided else "noise_decides"
    return [make_finding(code, parameter=", ".join(spans_of_change), last=last, every=every, shown=spans_text)]


def _independent_samples(residuals: Floats) -> float:
    """Number of independent samples with the information of a series of correlated ones."""
    samples = drop_missing(residuals)
    if samples.size < 2 or is_constant([samples]):
        return float(samples.size)
    # Squares of the residuals of a run that grows may overflow.
    return samples.size / variance_inflation(samples / np.abs(samples).max())
