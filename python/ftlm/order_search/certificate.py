"""Certificate of an order search: a lower bound of the equation error over intervals of orders."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from ftlm import _core
from ftlm.data.run import Run
from ftlm.errors import FtlmError, ModelError
from ftlm.order_search.options import DEFAULT_INCREMENT, OrderGrid, SearchSettings
from ftlm.order_search.result import OrderCertificate
from ftlm.order_search.search import Job, make_job, run_job
from ftlm.simulation.discretization import check_linear, error_with_signal_names
from ftlm.structure.structure import Structure
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import plural
from ftlm.utils.parameters import parameter, setting
from ftlm.utils.resources import memory_limit
from ftlm.utils.validation import check_integer, real_number, short_repr

#: Default tolerance of the certificate, as a fraction of the smallest equation error found, and default maximum number
#: of boxes of orders.
DEFAULT_TOLERANCE = 0.05
DEFAULT_MAX_CELLS = 20_000_000
#: Default maximum RMS of all terms of an equation together, divided by the RMS of the output. Larger terms cancel one
#: another to within a hundredth.
DEFAULT_MAX_TERM_RATIO = 100.0
#: Settings of an order search for which a certificate exists.
CERTIFIED_SETTINGS: dict[str, Any] = {"criterion": "equation-error", "norm": "l2", "coefficients": "least-squares"}


@check_arguments
def certify_orders(
    runs: Run | Sequence[Run],
    equation: Structure,
    order_grid: OrderGrid | None = None,
    *,
    tolerance: float = DEFAULT_TOLERANCE,
    start: Sequence[Mapping[str, float]] = (),
    min_separation: float | None = None,
    max_term_ratio: float = DEFAULT_MAX_TERM_RATIO,
    max_cells: int = DEFAULT_MAX_CELLS,
    m: int | None = None,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> OrderCertificate:
    """Compute a lower bound of the equation error over all real orders in the intervals of an order grid.

    It certifies that no orders have an error much smaller than the smallest error found.

    Branch and bound halves boxes of orders. It stops when every box has a lower bound of at least ``1 - tolerance``
    times the smallest error found. The bound holds for the RMS equation error at all orders of the box, with the best
    coefficients. The certificate covers only squared equation errors, zero initial conditions, and free coefficients.
    No such certificate is known for output errors. A finding reports if the simulation at the best orders is unstable
    or explains little of the output.

    Parameters
    ----------
    runs
        One run, or several with the same names and units, whose squared errors are added.
    equation
        One equation with free orders.
    order_grid
        Order grid, of which only the limits of the intervals are used.
    tolerance
        Fraction (below 1) by which the error at other orders may be smaller than the smallest error found.
    start
        Points to compare with the bound, each with orders by name, such as results of another optimizer. The
        certificate contains the error of each point, and whether other orders may have a smaller error.
    min_separation
        Minimum difference between alpha and the order of every output term, and between the orders of two terms of the
        same signal. An equation with a difference of 0 holds for any data. Default: the increment of the order grid.
    max_term_ratio
        Maximum RMS of all terms of an equation together, divided by the RMS of the output. Larger terms, which cancel
        one another, are not identifiable.
    max_cells
        Maximum number of boxes. When it is reached, the bound computed up to then is returned.
    m
        Number of block pulses per run; by default 2048, or fewer for shorter runs.
    threads
        Number of threads; default all cores.
    progress
        Callback with (boxes finished, boxes created), called about twenty times a second.

    Returns
    -------
    OrderCertificate
        Lower bound of the error, and the achieved tolerance, which may be larger than the requested one.

    Raises
    ------
    DataError
        If runs lack a signal of the equation.
    ModelError
        If the structure is coupled under an order law, or has initial terms, nonlinear terms or known coefficients.
        Also if an option is out of range, or the intervals contain no orders or require too many boxes.
    KeyboardInterrupt
        On Ctrl-C, within half a second.
    """
    relative_tolerance = real_number("tolerance", tolerance)
    if not 0 < relative_tolerance < 1:
        raise ModelError(
            f"{parameter('tolerance', tolerance)} is outside (0, 1); 0.05 means that no orders may be better by more "
            "than 5 %"
        )
    box_limit = check_integer("max_cells", max_cells, 1)
    increment = order_grid.increment if isinstance(order_grid, OrderGrid) else DEFAULT_INCREMENT
    gap = real_number("min_separation", increment if min_separation is None else min_separation)
    if not 0 < gap <= 1:
        raise ModelError(
            f"{setting('min_separation')} {min_separation!r} is outside (0, 1]; the increment of the order grid is "
            "usual"
        )
    term_ratio = real_number("max_term_ratio", max_term_ratio)
    if not 1 <= term_ratio <= 1e9:
        raise ModelError(
            f"{setting('max_term_ratio')} {max_term_ratio!r} is outside [1, 1e9]; the default is "
            f"{DEFAULT_MAX_TERM_RATIO:g}"
        )
    job = make_job(runs, equation, order_grid, SearchSettings(**CERTIFIED_SETTINGS), m=m, threads=threads)
    _check_certifiable(job)
    errors = tuple(_equation_error(job, orders, k, len(start)) for k, orders in enumerate(start))
    record, single_equation = job.records[0], job.structure.equations[0]
    output, alpha, terms = job.equation_problem().orders
    try:
        result = _core.certify(
            [r.core() for r in job.records],
            output=output,
            alpha=(min(alpha), max(alpha)),
            terms=[(signal, min(values), max(values)) for signal, values, _ in terms],
            min_separation=gap,
            tolerance=relative_tolerance,
            max_term_ratio=term_ratio,
            max_cells=box_limit,
            threads=job.threads,
            memory=memory_limit(),
            progress=None if progress is None else lambda count, total, _pruned: progress(count, total),
        )
    except ModelError as error:
        raise error_with_signal_names(error, record.signals) from None
    values = [result["alpha"], *result["orders"]] if result["orders"] else []
    orders = {o.names[0]: v for o, v in zip(single_equation.orders, values, strict=False) if o.names}
    nr, unstable = _free_run(job, orders) if orders else (math.nan, math.nan)
    return OrderCertificate(
        result["lower_bound"],
        result["best"],
        orders,
        relative_tolerance,
        {name: (min(values), max(values)) for name, values in job.values.items()},
        gap,
        term_ratio,
        result["cells"],
        result["open"],
        record.m,
        nr,
        unstable,
        start_errors=errors,
    )


def _equation_error(job: Job, orders: Mapping[str, float], index: int, count: int) -> float:
    """Return the minimum RMS equation error at given orders, over all coefficients.

    It is infinite if the terms are linearly dependent. Raise ModelError if an order is missing or outside its interval.
    The message names the point by its `index` among `count` points.
    """
    names = {name: (min(values), max(values)) for name, values in job.values.items()}
    theta = {str(name): real_number("start", value) for name, value in orders.items()}
    if set(theta) != set(names) or not all(low <= theta[n] <= high for n, (low, high) in names.items()):
        intervals = ", ".join(f"{n} from {low:g} to {high:g}" for n, (low, high) in names.items())
        raise ModelError(f"start {index} of {count} is {short_repr(dict(orders))}; give {intervals}")
    try:
        return run_job(replace(job, values={n: (theta[n],) for n in names}, progress=None)).score
    except FtlmError:
        # The terms are linearly dependent at these orders.
        return math.inf


def _check_certifiable(job: Job) -> None:
    """Raise ModelError if a search has an order law, nonlinear terms, initial terms or known coefficients.

    No certificate can be computed for these.
    """
    if job.structure.has_order_law:
        raise ModelError(
            "there is no certificate over the orders of coupled equations under an order law; certify the equations "
            "one by one"
        )
    check_linear(job.structure.equations, "a certificate")
    equation = job.structure.equations[0]
    if tuple(job.records[0].start) != (False, []):
        raise ModelError(
            "there is no certificate over all orders with initial terms; give the equation "
            f"{parameter('initial', 'rest')}"
        )
    fixed_terms = [t for t in equation.terms if t.fixed_value is not None]
    if fixed_terms:
        raise ModelError(
            f"a certificate over all orders requires free coefficients, but the equation of {equation.output} has "
            f"{plural(len(fixed_terms), 'fixed one')} (the first is {fixed_terms[0].fixed_value:g}); give each a name"
        )


def _free_run(job: Job, orders: dict[str, float]) -> tuple[float, float]:
    """Return (NR, number of unstable poles) of the least-squares model at given orders.

    NR is the RMS simulation error divided by the standard deviation of the output. It is infinite if the simulation
    fails. The number of poles is NaN if it is unknown.
    """
    settings = SearchSettings(**{**CERTIFIED_SETTINGS, "criterion": "output-error", "pruning": False})
    values = {name: (orders[name],) for name in job.values}
    try:
        result = run_job(replace(job, values=values, settings=settings, progress=None))
    except FtlmError:
        # No candidate has a finite score.
        return math.inf, math.nan
    unstable_poles = math.nan
    with contextlib.suppress(FtlmError):
        unstable_poles = result.model.stability().unstable_poles
    return result.score / job.standard_deviations()[0], unstable_poles
