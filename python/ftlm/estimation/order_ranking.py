"""Order search, followed by an identification at the best orders that gives the verdict on the result."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any

import numpy as np

from ftlm.data.run import Run
from ftlm.data.runs import as_runs
from ftlm.data.sampling import drop_missing
from ftlm.errors import FtlmError
from ftlm.estimation.estimators import fit_at_best_orders
from ftlm.estimation.identify import assess_fit
from ftlm.estimation.result import Identification, Task
from ftlm.estimation.verdict import MAX_ORDER_ERROR, verdict_from
from ftlm.findings import Finding, make_finding, unique_findings
from ftlm.order_search.options import Coefficients, Criterion, Norm, OrderGrid, RowBasis, SearchSettings
from ftlm.order_search.result import SearchResult
from ftlm.order_search.search import rank_orders
from ftlm.structure.parser import as_structure
from ftlm.structure.structure import Structure
from ftlm.utils.arguments import check_arguments
from ftlm.utils.statistics import chi_squared_99, is_constant, variance_inflation
from ftlm.utils.validation import Floats
from ftlm.validation.residual_tests import Residuals


@check_arguments
def search_orders(
    runs: Run | Sequence[Run],
    equation: Structure | str,
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
    """Rank all points of an order grid for one equation, or for coupled equations under an order law.

    For each candidate, the coefficients are estimated from the equation error, and the candidate gets a score (Table 2
    of the paper, steps 5-7). The table of best candidates equals the table of a full evaluation of every candidate. It
    is the same bit for bit for any number of threads on processors of one kind.

    Parameters
    ----------
    runs
        One run, or several runs with the same names and units, whose scores are added.
    equation
        Structure with free orders, or the text of its equations; see :func:`ftlm.equation` and
        :func:`ftlm.flexible_link`.
    order_grid
        Intervals and increment of the orders; see :func:`ftlm.order_grid`.
    criterion
        Error that is scored. ``"output-error"``: error of a simulation of each equation, whose inputs include the
        measured other outputs. ``"equation-error"``: error of the equation with measured signals on the right-hand
        side. This error is smallest for equations that are nearly identities, in which a signal predicts itself.
    coefficients
        Estimator of the coefficients: ``"multi-innovation"`` (closed form of eq. (44) of the paper),
        ``"least-squares"``, or ``"instrumental-variables"`` for refined instrumental variables, which noise on the
        outputs does not bias. With instrumental variables, measured outputs that enter another equation are replaced by
        their projections on filtered inputs.
    norm
        ``"l1"`` for the sum of absolute errors, eq. (45) of the paper, or ``"l2"`` for the RMSE, eq. (46) of the paper.
    innovation_length, prior_covariance, row_basis
        Options of ``"multi-innovation"``; see :class:`ftlm.MultiInnovation`. With another estimator they must have
        their default values.
    m
        Number of block pulses per run; by default 2048, or fewer for shorter runs.
    top
        Number of rows of the table.
    threads
        Number of threads, by default all cores.
    progress
        Callback with (candidates done, total candidates), called about twenty times a second.
    pruning
        Whether a candidate is excluded as soon as a lower bound or the partial sum of its score exceeds the worst score
        in the table. False evaluates every candidate in full, with the same table.
    store
        Checkpoint file, to which finished work is written within a second. After an interruption, the same call or
        :func:`resume_search` continues from it.
    executor
        :class:`concurrent.futures.Executor` that evaluates candidates in threads, in processes or on a cluster, such as
        ``dask.distributed.Client(…).get_executor()``. The result does not change on processors of one kind. `threads`
        then counts the threads of one task, by default one.

    Returns
    -------
    SearchResult
        Table, best model, counts, and the verdict that :func:`ftlm.identify` gives at the orders of rank 1.

    Raises
    ------
    DataError
        If runs lack a signal of the equation, an output is constant, or the checkpoint file belongs to another search,
        is in use, is damaged or cannot be written.
    ModelError
        If no order is free, the grid has no or too many candidates, an option is out of range or not used by
        `coefficients`, or the search needs more memory than is free or than ``FTLM_MEMORY`` allows.
    ConvergenceError
        If the executor has lost its workers.
    KeyboardInterrupt
        On Ctrl-C, within half a second.

    Notes
    -----
    All candidates share one Gram matrix of the distinct regressors. For k coefficients, a candidate takes the solution
    of k linear equations, and a lower bound of its score from a few inner products. Candidates that the bound does not
    exclude are simulated, promising ones first, until their partial sum exceeds the threshold. Candidates are generated
    from their index, so memory does not grow with their number.
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
    run_list, structure = as_runs(runs), as_structure("equation", equation)
    result = rank_orders(
        run_list,
        structure,
        order_grid,
        m=m,
        threads=threads,
        progress=progress,
        store=store,
        executor=executor,
        **settings,
    )
    return with_verdict(result, run_list, structure, SearchSettings(**settings), order_grid, m=m)


def with_verdict(
    search: SearchResult,
    runs: Sequence[Run],
    structure: Structure,
    settings: SearchSettings,
    order_grid: OrderGrid | None = None,
    *,
    m: int | None = None,
) -> SearchResult:
    """Return an order search with the verdict and the findings of an identification at its best orders."""
    name = "stage" if structure.has_order_law else structure.outputs[0]
    best_search = replace(search, table=search.table[:1])
    try:
        result = search_identification({name: best_search}, runs, structure, settings, order_grid, m=m)
    except FtlmError as error:
        failed = make_finding("rank_not_validated", method=settings.coefficients, text=str(error))
        return replace(search, verdict=verdict_from([failed]), model_findings=(failed,))
    equivalent_rows = [] if result.residuals is None else _tied_rank_findings(search, result.residuals)
    findings = unique_findings([*equivalent_rows, *result.findings])
    return replace(search, verdict=result.verdict, model_findings=findings, best=result)


def search_identification(
    searches: Mapping[str, SearchResult],
    runs: Sequence[Run],
    structure: Structure,
    settings: SearchSettings,
    order_grid: OrderGrid | None = None,
    *,
    m: int | None = None,
) -> Identification:
    """Return the identification of all equations at the best orders of completed searches, for a report."""
    return assess_fit(fit_at_best_orders(Task(tuple(runs), structure, order_grid), settings, m, searches))


def _tied_rank_findings(search: SearchResult, residuals: Residuals) -> list[Finding]:
    """Return a finding on table rows whose score is not significantly larger than the score of rank 1.

    Consider N independent residuals and k free orders. The sum of squares at the true orders exceeds that at the best
    orders by the relative amount chi-squared(k) / N. Colored residuals count as fewer samples.
    """
    samples = min(sum(map(_independent_samples, o.residuals)) for o in residuals.outputs.values())
    best, distinct_rows = search.table[0], search.distinct_rows
    limit = best.score * math.sqrt(1.0 + chi_squared_99(len(search.orders)) / max(samples, 1.0))
    tied = [row for row, _ in distinct_rows if row.score <= limit]
    if len(tied) < 2:
        return []
    values = {n: [row.orders[n] for row in tied] for n in best.orders}
    spans = {n: (min(order_range), max(order_range)) for n, order_range in values.items()}
    spans_of_change = {n: ends for n, ends in spans.items() if ends[1] > ends[0]}
    is_determined = all(
        max(high - best.orders[n], best.orders[n] - low) <= MAX_ORDER_ERROR for n, (low, high) in spans.items()
    )
    spans_text = ", ".join(f"{n} {low:.4g} to {high:.4g}" for n, (low, high) in spans_of_change.items())
    last_rank = max(row.rank for row in tied)
    scope_text = ", all that are kept," if tied[-1] is distinct_rows[-1][0] and len(distinct_rows) > 1 else ""
    code = "tied_orders_close" if is_determined else "tied_orders_far_apart"
    return [
        make_finding(code, parameter=", ".join(spans_of_change), last=last_rank, every=scope_text, shown=spans_text)
    ]


def _independent_samples(residuals: Floats) -> float:
    """Return the number of independent samples with the same information as a series of correlated samples."""
    samples = drop_missing(residuals)
    if samples.size < 2 or is_constant([samples]):
        return float(samples.size)
    # The squared residuals of a diverging simulation may overflow.
    return samples.size / variance_inflation(samples / np.abs(samples).max())
