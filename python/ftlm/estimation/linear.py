"""Linear estimation of coefficients at given orders: least squares, multi-innovation, instrumental variables.

The module also has the online estimator :class:`Streaming`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ftlm import _core
from ftlm.data.run import Run
from ftlm.data.sampling import check_step
from ftlm.errors import DataError, FtlmError, InternalError, ModelError
from ftlm.findings import Finding, make_finding
from ftlm.kernels import Recursion
from ftlm.model.model import Model
from ftlm.order_search.options import RowBasis, SearchSettings
from ftlm.order_search.search import free_run_score, record_run
from ftlm.simulation.discretization import (
    InitialTuple,
    Record,
    check_linear,
    named_coefficients,
    prepare,
    structure_tuple,
)
from ftlm.simulation.nonlinear_columns import has_derivative_channels
from ftlm.structure.equation import Equation
from ftlm.structure.structure import Initial, Structure
from ftlm.svg.line_chart import LineChart
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import parameter, setting
from ftlm.utils.validation import Floats, check_integer

#: Maximum number of iterations of refined instrumental variables, and the relative change of a coefficient below which
#: the iteration has converged.
MAX_IV_ITERATIONS = 40
IV_RELATIVE_TOLERANCE = 1e-8
#: Maximum relative change of a coefficient by the prior covariance that is not reported.
MAX_PRIOR_SHIFT = 0.05
#: Minimum number of block pulses with which the bias by the discretization is estimated.
MIN_STEP_TEST_PULSES = 32
#: Maximum discretization bias of a coefficient, in standard errors, that is not reported.
MAX_STEP_BIAS_ERRORS = 0.5


@dataclass(frozen=True)
class CoefficientFit:
    """Result of a linear estimation at given orders.

    ``m`` is the number of block pulses per run, and ``initial`` are the initial conditions. ``values`` are the
    coefficients by name, and ``errors`` their standard errors if the method gives them.
    """

    m: int
    initial: Initial
    values: dict[str, float] = field(default_factory=dict)
    errors: dict[str, float] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)


def estimate_coefficients(
    runs: Sequence[Run], structure: Structure, settings: SearchSettings, m: int | None
) -> CoefficientFit:
    """Return the coefficients at given orders, estimated by the linear method ``settings.coefficients``.

    If a non-linear term contains the derivative of a measured signal, the coefficients are estimated twice, with
    derivatives of the raw and of the smoothed signals. The estimate with the smaller simulation error is returned.
    """
    if settings.coefficients == "instrumental-variables":
        check_linear(structure.equations, "an instrument")
    if not has_derivative_channels(structure):
        return _estimate_coefficients(runs, structure, settings, m, local_smoothing=True)[0]
    fits = [
        _estimate_coefficients(runs, structure, settings, m, local_smoothing=local_smoothing)
        for local_smoothing in (True, False)
    ]
    tracks = [record_run(rec, structure) for rec in fits[0][1]]

    def score(pair: tuple[CoefficientFit, list[Record]]) -> float:
        model = Model(structure.with_coefficients(pair[0].values))
        return free_run_score(model, pair[1], tracks, "l2", [1.0] * len(model.outputs))

    return min(fits, key=score)[0]


def _estimate_coefficients(
    runs: Sequence[Run], structure: Structure, settings: SearchSettings, m: int | None, *, local_smoothing: bool
) -> tuple[CoefficientFit, list[Record]]:
    """Return the coefficients at given orders, and the block-pulse records that they were estimated from.

    With `local_smoothing`, derivatives in non-linear terms are computed from smoothed signals.
    """
    records = prepare(runs, structure, m, power_of_two=settings.needs_haar, local_smoothing=local_smoothing)
    fit = CoefficientFit(records[0].m, records[0].initial)
    if settings.coefficients == "instrumental-variables":
        _instrumental(fit, structure, records)
        return fit, records
    for equation in structure.equations:
        if settings.coefficients == "least-squares":
            estimates = _core.least_squares(*_linear(equation, records))[0]
        else:
            estimates = _multi_innovation(equation, records, settings, settings.prior_covariance)
            if settings.prior_covariance is not None:
                weak_prior_estimates = _multi_innovation(
                    equation, records, settings, min(settings.prior_covariance * 1e12, 1e300)
                )
                fit.findings.extend(_prior_findings(equation.output, estimates, weak_prior_estimates, settings))
        fit.values.update(named_coefficients(equation, estimates))
    return fit, records


def _linear(
    equation: Equation, records: list[Record]
) -> tuple[list[Any], Any, list[bool], list[float | None], InitialTuple]:
    """Return one equation and its records as positional arguments of the core's linear estimators."""
    first = records[0]
    fixed, structure = [t.fixed_value for t in equation.terms], structure_tuple(equation, first.signals)
    return [r.core() for r in records], structure, list(first.inputs), fixed, first.start


def _multi_innovation(
    equation: Equation, records: list[Record], settings: SearchSettings, prior: float | None
) -> list[float]:
    """Return the multi-innovation estimate of the coefficients in closed form, eq. (44) of the paper."""
    haar = settings.row_basis == "haar"
    (estimates, *_), _ = _core.multi_innovation(
        *_linear(equation, records), settings.innovation_length, prior, haar, False
    )
    return estimates


def _instrumental(fit: CoefficientFit, structure: Structure, records: list[Record]) -> None:
    """Store the refined instrumental-variables estimate of the coefficients, their errors and findings in `fit`.

    All equations are simulated together, so every instrument depends only on the inputs. The standard errors are
    conditional on the given orders.
    """
    initial, inputs = records[0].start, list(records[0].inputs)
    groups = [structure.equations] if structure.coupling == "simulated" else [(e,) for e in structure.equations]
    for group in groups:
        outputs = ", ".join(e.output for e in group)
        answer = _core.instrumental_variables(
            [r.core() for r in records],
            [structure_tuple(e, records[0].signals) for e in group],
            inputs,
            [[t.fixed_value for t in e.terms] for e in group],
            initial,
            MAX_IV_ITERATIONS,
            IV_RELATIVE_TOLERANCE,
        )
        if not answer["converged"]:
            fit.findings.append(
                make_finding("instruments_not_converged", output=outputs, iterations=answer["iterations"])
            )
        if answer["damped"]:
            fit.findings.append(make_finding("instruments_unstable", output=outputs))
        for equation, (estimate, _, _, _), covariance in zip(
            group, answer["estimates"], answer["covariances"], strict=True
        ):
            fit.values.update(named_coefficients(equation, estimate))
            free = [t for t in equation.terms if t.fixed_value is None]
            errors = np.sqrt(np.diag(np.reshape(covariance, (len(free), len(free)))))
            pairs = zip(free, errors.tolist(), strict=True)
            fit.errors.update({str(t.coefficient): s / abs(t.factor) for t, s in pairs})


def step_bias_findings(
    runs: Sequence[Run], structure: Structure, settings: SearchSettings, fit: CoefficientFit
) -> list[Finding]:
    """Return a finding if the discretization biases a coefficient by more than half its standard error.

    The coefficients are estimated again with twice the step. The discretization has order 2, so one third of the change
    is the remaining error (Richardson).
    """
    if not fit.errors or fit.m < 2 * MIN_STEP_TEST_PULSES:
        return []
    try:
        coarser = estimate_coefficients(runs, structure, settings, fit.m // 2).values
    except FtlmError:
        # Without an estimate on the coarser step there is no estimate of the bias.
        return []
    changes = {n: abs(coarser[n] - fit.values[n]) / 3 / e for n, e in fit.errors.items() if e > 0}
    most_changed = max(changes, key=lambda n: changes[n], default="")
    if not most_changed or changes[most_changed] <= MAX_STEP_BIAS_ERRORS:
        return []
    max_m = min(run.length - 1 for run in runs)
    finer_text = f"raise m, up to {max_m}, or " if fit.m < max_m else ""
    # Far from the limit of zero step, a third of the change is only a rough estimate of the bias.
    amount = f"about {changes[most_changed]:.2g}" if changes[most_changed] <= 10 else "more than 10"
    return [make_finding("step_bias", parameter=most_changed, m=fit.m, amount=amount, finer=finer_text)]


def _prior_findings(
    output: str, estimates: list[float], weak_prior_estimates: list[float], settings: SearchSettings
) -> list[Finding]:
    """Return a finding if the prior covariance, not the data, determines the size of a coefficient.

    `estimates` are the coefficients with the prior of the settings, `weak_prior_estimates` the coefficients with a weak
    prior.
    """
    relative_changes = [abs(a - b) / abs(b) for a, b in zip(estimates, weak_prior_estimates, strict=True) if b]
    largest_change = max(relative_changes, default=0.0)
    if largest_change <= MAX_PRIOR_SHIFT:
        return []
    details = {"prior": settings.prior_covariance, "share": 100 * min(largest_change, 9.99)}
    return [make_finding("prior_shifts_estimate", output=output, length=settings.innovation_length, **details)]


@dataclass(frozen=True)
class MultiInnovationTrace:
    """Coefficients and simulation error after each step of the multi-innovation recursion, eq. (44) of the paper.

    Parameters
    ----------
    step
        Numbers of the steps at which values are given, counted from 1.
    coefficients
        Coefficients by name, one value for each of these steps.
    error
        Sum of absolute errors, eq. (45) of the paper, of a simulation from rest with the coefficients of each step;
        infinite if the simulation diverges.
    innovation_length
        Innovation length p.
    """

    step: NDArray[np.int64]
    coefficients: dict[str, NDArray[np.float64]]
    error: NDArray[np.float64]
    innovation_length: int


@check_arguments
def multi_innovation_trace(
    run: Run,
    equation: Structure,
    *,
    innovation_length: int = 7,
    prior_covariance: float | None = None,
    row_basis: RowBasis = "haar",
    m: int | None = None,
    every: int = 1,
) -> MultiInnovationTrace:
    """Run the recursion of eq. (44) of the paper, and return coefficients and simulation error after each step.

    The error is the sum of absolute errors, eq. (45) of the paper.

    Parameters
    ----------
    run
        Run that starts at rest.
    equation
        One equation whose orders are numbers.
    innovation_length, prior_covariance, row_basis, m
        See :class:`ftlm.MultiInnovation` and :func:`ftlm.identify`.
    every
        Interval between returned steps, as a number of steps. The last step is always returned.

    Returns
    -------
    MultiInnovationTrace
        Trace whose last coefficients equal the closed-form estimate up to rounding.

    Raises
    ------
    ModelError
        If there is more than one equation, an order is free, or a setting is out of range.

    Notes
    -----
    The recursion takes O(m k^3) operations for m pulses and k coefficients. Each returned step takes a simulation in
    addition.
    """
    settings = SearchSettings(
        innovation_length=innovation_length, prior_covariance=prior_covariance, row_basis=row_basis
    )
    if len(equation.equations) != 1 or equation.order_names:
        raise ModelError(
            "a convergence trace needs one equation whose orders are numbers; use .equation(…).with_orders(…)"
        )
    if equation.offset != "none":
        raise ModelError(
            f"a convergence trace cannot estimate an offset, and offset = {equation.offset!r}; use "
            f"{parameter('offset', 'none')}"
        )
    stride = check_integer("every", every, 1)
    rest_structure = replace(equation, initial="rest")
    rec = prepare([run], rest_structure, m, power_of_two=settings.needs_haar)[0]
    single_equation = equation.equations[0]
    check_linear([single_equation], "a trace")
    core_structure = structure_tuple(single_equation, rec.signals)
    inputs = list(rec.inputs)
    _, trace = _core.multi_innovation(
        [rec.core()],
        core_structure,
        inputs,
        [t.fixed_value for t in single_equation.terms],
        (False, []),
        settings.innovation_length,
        settings.prior_covariance,
        settings.row_basis == "haar",
        True,
    )
    if trace is None:
        raise InternalError("the recursion gave no trace; please report it")
    step = np.unique(np.append(np.arange(stride, trace.shape[0] + 1, stride), trace.shape[0]))
    history = np.ascontiguousarray(trace[step - 1])
    error = _core.trace_errors(rec.core(), core_structure, inputs, history)
    names = {
        t.coefficient: history[:, k] / t.factor
        for k, t in enumerate(single_equation.terms)
        if isinstance(t.coefficient, str)
    }
    return MultiInnovationTrace(step, names, error, settings.innovation_length)


@check_arguments
def trace_chart(traces: Sequence[tuple[str, MultiInnovationTrace]], *, title: str, log_x: bool = False) -> LineChart:
    """Return a chart of the simulation error after each step of the multi-innovation recursion.

    It corresponds to Fig. 4(b) of the paper. The error is eq. (45) and the recursion is eq. (44) of the paper.

    Parameters
    ----------
    traces
        Pairs (label, trace), such as ("p = 7", …). All traces have the same equation and steps.
    title
        Title of the chart.
    log_x
        Whether the axis of steps is logarithmic, which enlarges the first steps.

    Raises
    ------
    DataError
        If there is no trace, or the steps of the traces differ.
    """
    if not traces:
        raise DataError("a convergence chart needs at least one trace; give (name, trace) pairs")
    step = traces[0][1].step
    for name, trace in traces:
        if not np.array_equal(trace.step, step):
            raise DataError(
                f"trace {name!r} is given at other steps than {traces[0][0]!r}; use the same {parameter('every')}"
            )
    return LineChart(
        step,
        [(name, trace.error) for name, trace in traces],
        title=title,
        x_label="step of the recursion",
        y_label="error (45) of the simulation",
        log_x=log_x,
        log_y=True,
    )


class Streaming:
    """Online estimator of the coefficients of a structure for a run that starts at rest.

    The time per sample does not depend on the length of the run, because about a hundred states per signal represent
    the past. After the last sample the coefficients equal those of
    ``identify(method=MultiInnovation(row_basis="time"))`` at the same orders, with one block pulse per sampling
    interval, up to rounding.

    Parameters
    ----------
    structure
        One or several equations whose orders are numbers, without delays, initial terms or sensor filter. The order of
        the equation minus the order of a term must be in [0, 2] for every term.
    step
        Time between samples [s].
    max_duration
        Maximum duration of a run [s].
    inputs
        Names of the input signals, which are constant between samples (zero-order hold).
    innovation_length, prior_covariance
        Innovation length p and prior covariance K0 in eq. (44) of the paper; by default the prior is weak, as in
        :class:`ftlm.MultiInnovation`.

    Raises
    ------
    ModelError
        If the structure does not meet these conditions, or a setting is out of range.
    """

    @check_arguments
    def __init__(
        self,
        structure: Structure,
        *,
        step: float,
        max_duration: float,
        inputs: Sequence[str] = ("I1", "I2"),
        innovation_length: int = 7,
        prior_covariance: float | None = None,
    ) -> None:
        if structure.order_names:
            raise ModelError(
                f"the orders {', '.join(structure.order_names)} are free; a stream needs numbers: give them with "
                "with_orders(…)"
            )
        if structure.offset != "none":
            raise ModelError(
                f"{setting('offset')} {structure.offset!r} is not supported in a stream; identify the recorded "
                f"run, or use {parameter('offset', 'none')}"
            )
        if (
            structure.delay
            or structure.limits
            or structure.sensor_filter is not None
            or structure.initial not in ("auto", "rest")
        ):
            raise ModelError(
                "delays, limits, initial terms and sensor filters are not supported in a stream; identify the "
                "recorded run"
            )
        self.signals = tuple(structure.signals)
        self.structure = structure
        length = check_integer("innovation_length", innovation_length, 1, (1 << 31) - 1)
        step, max_duration = check_step(step, "step"), check_step(max_duration, "max_duration")
        self.step = step
        self._recursions: list[Recursion] = []
        for equation in structure.equations:
            output, alpha, terms = structure_tuple(equation, self.signals)
            self._recursions.append(
                Recursion(
                    [alpha, *(order for _, order in terms)],
                    [signal for signal, _ in terms],
                    output=output,
                    step=step,
                    hold=[name in inputs for name in self.signals],
                    p=length,
                    prior_covariance=prior_covariance,
                    longest=max(2, round(max_duration / step) + 1),
                    fixed=[t.fixed_value for t in equation.terms],
                )
            )

    @check_arguments
    def push(self, samples: Floats) -> None:
        """Update the estimate with samples of shape (n, len(signals)), in SI units and the sequence of `signals`.

        Raises
        ------
        DataError
            If a sample is not finite.
        ModelError
            If the samples exceed `max_duration`.
        ConvergenceError
            If rounding errors make the covariance indefinite.
        """
        for recursion in self._recursions:
            recursion.push(samples)

    @property
    def coefficients(self) -> dict[str, float]:
        """Estimates of the coefficients by name, after the newest sample."""
        pairs = zip(self.structure.equations, self._recursions, strict=True)
        return {
            name: c
            for equation, recursion in pairs
            for name, c in named_coefficients(equation, recursion.coefficients.tolist()).items()
        }

    @property
    def pulses(self) -> int:
        """Number of rows processed by the recursion, eq. (44) of the paper: the number of samples minus one."""
        return self._recursions[0].pulses

    def __str__(self) -> str:
        return ", ".join(f"{name} = {value:.6g}" for name, value in self.coefficients.items())
