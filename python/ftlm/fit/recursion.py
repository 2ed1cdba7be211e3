"""The recursion (44) step by step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ftlm import _core
from ftlm.base.checks import whole_number
from ftlm.base.errors import DataError, InternalError, ModelError
from ftlm.data.run import Run
from ftlm.data.settings import Settings
from ftlm.data.structures import Structure
from ftlm.paint.figure import Figure
from ftlm.paint.lines import line_chart
from ftlm.solve.records import prepare, structure_tuple


@dataclass(frozen=True)
class Trace:
    """How the recursion (44) converged on one equation.

    Parameters
    ----------
    step
        Steps at which the rest is given, from 1.
    coefficients
        By name, after each of these steps.
    error
        Error (45) of the free run of the model after each of these steps, at rest; infinite where it diverged.
    innovation_length
        p.
    """

    step: NDArray[np.int64]
    coefficients: dict[str, NDArray[np.float64]]
    error: NDArray[np.float64]
    innovation_length: int


def multi_innovation_trace(
    run: Run, equation: Structure, *, innovation_length: int = 7, prior_covariance: float = 1.0,
    rows: Literal["haar", "time"] = "haar", m: int | None = None, every: int = 1,
) -> Trace:  # fmt: skip
    """Run the recursion (44) step by step: coefficients, and error (45) of the model they make, after every step.

    Parameters
    ----------
    run
        One run that starts at rest.
    equation
        One equation whose orders are numbers.
    innovation_length, prior_covariance, rows, m
        See :func:`identify`.
    every
        Give every n-th step (and the last).

    Returns
    -------
    Trace
        The last row equals the closed form to rounding.

    Raises
    ------
    ModelError
        More than one equation, free orders, settings out of range.

    Notes
    -----
    O(m k^3) for the recursion and one division of series for each step given.
    """
    settings = Settings.check(innovation_length=innovation_length, prior_covariance=prior_covariance, rows=rows)
    if len(equation.equations) != 1 or equation.order_names:
        raise ModelError("a trace needs one equation whose orders are numbers; use .equation(…).with_orders(…)")
    if equation.offset != "none":
        raise ModelError(f"a trace follows no offset, and offset = {equation.offset!r}; use offset='none'")
    stride = whole_number(every)
    if stride is None or stride < 1:
        raise ModelError(f"every = {every!r} is no whole number from 1; 1 gives every step")
    rest = replace(equation, initial="rest")
    rec = prepare([run], rest, m, power_of_two=settings.needs_haar)[0]
    item = equation.equations[0]
    core_structure = structure_tuple(item, rec.signals)
    inputs = list(rec.inputs)
    _, trace = _core.multi_innovation(
        [rec.core()], core_structure, inputs, [t.fixed for t in item.terms], (False, []),
        settings.innovation_length, settings.prior_covariance, settings.rows == "haar", True,
    )  # fmt: skip
    if trace is None:
        raise InternalError("the recursion gave no trace; please report it")
    step = np.unique(np.append(np.arange(stride, trace.shape[0] + 1, stride), trace.shape[0]))
    kept = np.ascontiguousarray(trace[step - 1])
    error = _core.trace_errors(rec.core(), core_structure, inputs, kept)
    names = {t.coefficient: kept[:, k] / t.factor for k, t in enumerate(item.terms) if isinstance(t.coefficient, str)}
    return Trace(step, names, error, settings.innovation_length)


def trace_chart(traces: Sequence[tuple[str, Trace]], *, title: str, log_x: bool = False) -> Figure:
    """Error (45) of the free run after every step of the recursion (44), as in the paper's Figure 4(b).

    Parameters
    ----------
    traces
        (name, trace), such as ("p = 7", …), of one equation and with the same steps.
    title
        What is shown.
    log_x
        Whether the axis of steps is logarithmic, which widens the first ones.

    Raises
    ------
    DataError
        No trace, or traces whose steps differ.
    """
    if not traces:
        raise DataError("a convergence chart needs at least one trace; give (name, trace) pairs")
    steps = traces[0][1].step
    for name, trace in traces:
        if not np.array_equal(trace.step, steps):
            raise DataError(f"trace {name!r} is given at other steps than {traces[0][0]!r}; use the same every=")
    return line_chart(
        steps, [(name, trace.error) for name, trace in traces], title=title, x_label="step of the recursion",
        y_label="error (45) of the free run", log_x=log_x, log_y=True,
    )  # fmt: skip
