"""Methods of estimation as classes whose fields are their options, and the noise model of output error."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Protocol, cast, get_args

import numpy as np

from ftlm.data.run import Run
from ftlm.errors import InternalError, ModelError
from ftlm.estimation.closed_loop import instrument_runs, with_reference_findings
from ftlm.estimation.confidence_intervals import Intervals
from ftlm.estimation.estimators import estimate_order_search, estimate_output_error, number_covariance
from ftlm.estimation.fit import Fit, ProgressCallback, check_no_friction
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.genetic import GeneticAlgorithm
from ftlm.estimation.objective import Iterate, Objective
from ftlm.estimation.output_error import JointFit, Loss, Noise, start_from_values
from ftlm.estimation.prior_knowledge import (
    Bounds,
    Priors,
    check_bounds,
    check_intervals,
    check_priors,
    fit_within_bounds,
    prior_findings,
    with_priors,
)
from ftlm.estimation.result import Identification, Task
from ftlm.findings import Finding, make_finding
from ftlm.model.model import Model
from ftlm.order_search.options import (
    Coefficients,
    Criterion,
    Norm,
    OrderGrid,
    RowBasis,
    SearchSettings,
    check_order_grid,
    check_order_grid_names,
)
from ftlm.order_search.search import check_executor, threads_per_task
from ftlm.simulation.discretization import check_linear
from ftlm.structure.structure import Structure
from ftlm.utils.arguments import check_arguments
from ftlm.utils.linalg import column_norms, minimum_norm_solution, orthonormal
from ftlm.utils.parameters import parameter
from ftlm.utils.statistics import autoregression
from ftlm.utils.validation import Floats, check_choice, check_threads
from ftlm.validation.residual_tests import DEFAULT_LAGS

#: Maximum number of alternations between model and noise model, and change of every parameter [standard errors] below
#: which they have converged.
MAX_ALTERNATIONS, ALTERNATION_TOLERANCE = 30, 0.02
#: Singular value of lagged residuals, relative to the largest one, below which it counts as a rounding error.
LAG_RANK_TOLERANCE = 1e-10


def check_noise_model(runs: Sequence[Run], structure: Structure) -> None:
    """Raise ModelError if the runs or the structure do not allow an autoregressive noise model.

    It requires one output, a linear structure without saturations and dead zones, and uniform samples.
    """
    label = parameter("noise", "ar")
    if len(structure.outputs) > 1:
        raise ModelError(
            f"{label} supports one output, and the structure has {', '.join(structure.outputs)}; fit each one"
        )
    if not structure.is_linear or structure.limits:
        raise ModelError(
            f"{label} requires a linear model without saturations and dead zones, because its filter does not commute "
            f"with them; omit {label}"
        )
    if any(run.nonuniform_samples is not None for run in runs):
        raise ModelError(f"{label} needs uniform samples; resample the runs, or leave it out")


def fit_noise_model(fit: Fit, refit: Callable[[Task, JointFit], Fit]) -> Fit:
    """Return the fit of a model with autoregressive noise, by alternating minimization of model and noise model.

    `fit` is the fit for white noise, from which the iteration starts. `refit` fits a task from a joint fit.

    The noise is v = e / A(q) with white e. One step fits A(q) to the residuals v of the simulation. The other fits the
    model to runs whose inputs and output are filtered by A(q), which a linear model permits. Both steps decrease the
    sum of squared prediction errors, whose minimum is consistent in a closed loop with a delay (Ljung, System
    Identification, 1999, chapter 13). The covariance of the parameters includes the uncertainty of A(q).
    """
    first_fit, runs, first_joint = fit, fit.task.runs, fit.joint
    if first_joint is None:
        raise InternalError("a fit by output error has no optimum; please report it")
    joint = first_joint
    for _ in range(MAX_ALTERNATIONS):
        residuals = _residuals(first_fit, joint, runs)
        noise_filter = _noise_model(residuals)
        whitened_runs = tuple(whiten(run, noise_filter) for run in runs)
        fit = refit(Task(whitened_runs, replace(first_fit.task.structure, initial=joint.initial)), joint)
        joint_before, joint = joint, fit.joint or joint
        errors = np.sqrt(np.diag(joint.covariance))
        if np.all(np.abs(joint.values - joint_before.values) <= ALTERNATION_TOLERANCE * errors):
            findings = fit.findings
            break
    else:
        findings = [*fit.findings, make_finding("not_converged")]
    order = noise_filter.size - 1
    joint = replace(joint, starts=first_joint.starts, covariance=_with_noise_model_errors(fit, joint, residuals, order))
    return replace(
        fit,
        task=first_fit.task,
        model=replace(fit.model, structure=replace(fit.model.structure, initial=first_fit.model.structure.initial)),
        findings=findings,
        joint=joint,
        covariance=number_covariance(joint, FreeProblem.of(replace(fit.task.structure, initial=joint.initial))),
        settings={**fit.settings, "starts": len(joint.starts), "noise_model": noise_filter[1:].tolist()},
    )


def _noise_model(residuals: Sequence[Floats]) -> Floats:
    """Return the coefficients of A(q) by least squares from residuals; its order minimizes BIC."""
    order = autoregression(residuals, DEFAULT_LAGS).size - 1
    if order == 0:
        return np.ones(1)
    regressors, targets = _lag_columns(residuals, order), np.concatenate(residuals)
    is_complete = np.isfinite(targets) & np.isfinite(regressors).all(axis=1)
    return np.concatenate(
        [[1.0], -minimum_norm_solution(regressors[is_complete], targets[is_complete], LAG_RANK_TOLERANCE)]
    )


def _lag_columns(residuals: Sequence[Floats], order: int) -> Floats:
    """Return the residuals of all runs at lags 1 to ``order``, one column per lag.

    Values before the start of a run are NaN.
    """
    columns = [[np.concatenate([np.full(lag, np.nan), v[:-lag]]) for v in residuals] for lag in range(1, order + 1)]
    return np.stack([np.concatenate(column) for column in columns], axis=1)


def whiten(run: Run, noise_filter: Floats) -> Run:
    """Return a run whose signals are filtered by the FIR `noise_filter`; the first output samples are missing."""
    filter_order = noise_filter.size - 1

    def whitened_samples(values: Floats) -> Floats:
        return np.convolve(values, noise_filter)[: values.size]

    return Run.from_arrays(
        step=run.step,
        inputs={n: whitened_samples(run[n]) for n in run.inputs},
        outputs={
            n: np.concatenate([np.full(filter_order, np.nan), whitened_samples(run[n])[filter_order:]])
            for n in run.outputs
        },
        units={n: u for n, u in run.units.items() if u},
        intersample=run.intersample,
        name=run.name,
        missing="weight",
    )


def _at_estimate(fit: Fit, joint: JointFit, runs: Sequence[Run], weight: float) -> tuple[Objective, Iterate]:
    """Return the objective of a fit for `runs`, with the output weight `weight`, and its estimate as an iterate."""
    problem = FreeProblem.of(replace(fit.task.structure, initial=joint.initial))
    values = joint.values_by_name
    return Objective(problem, runs, [weight], pulses_per_sample=joint.refinement), start_from_values(problem, values)


def _residuals(fit: Fit, joint: JointFit, runs: Sequence[Run]) -> list[Floats]:
    """Return the residuals of the simulation by run; NaN for missing samples."""
    objective, start = _at_estimate(fit, joint, runs, 1.0)
    return [
        series for run_residuals in objective.residuals(objective.evaluate(start)) for series in run_residuals.values()
    ]


def _with_noise_model_errors(fit: Fit, joint: JointFit, residuals: Sequence[Floats], order: int) -> Floats:
    """Return the covariance of the parameters, including the uncertainty of the noise model.

    In open loop, the errors of the noise model and of the parameters are independent. Feedback correlates the inputs
    with past noise. The lagged residuals, which are the sensitivities to A(q), then have a component along the
    sensitivities to the parameters.
    """
    if order == 0:
        return joint.covariance
    objective, start = _at_estimate(fit, joint, fit.task.runs, 1.0 / max(*joint.noise.values(), 1e-300))
    rows = np.asarray(objective.minimize(start, 1, linear_scale=True).outcome["jacobian"])
    priors = fit.task.structure.priors or {}
    prior_information = np.array([priors[n][1] ** -2.0 if n in priors else 0.0 for n in joint.names])
    scale = 1.0 / np.maximum(np.sqrt(column_norms(rows.T) ** 2 + prior_information), 1e-300)
    rows, prior_information = rows * scale[:, None], np.diag(prior_information * scale**2)
    # Lagged residuals are set to 0 at missing samples, at which the sensitivities are 0.
    basis = orthonormal(
        np.nan_to_num(_lag_columns(residuals, order)) * np.any(rows != 0.0, axis=0)[:, None], LAG_RANK_TOLERANCE
    )
    residual_rows = rows - (rows @ basis) @ basis.T
    additional_covariance = np.linalg.pinv(residual_rows @ residual_rows.T + prior_information) - np.linalg.pinv(
        rows @ rows.T + prior_information
    )
    covariance: Floats = joint.covariance + scale[:, None] * additional_covariance * scale
    return covariance


class EstimationMethod(Protocol):
    """Protocol of a method of estimation: an object with a name and a `fit` method.

    Any such object can be passed to :func:`ftlm.identify`.
    """

    name: ClassVar[str]

    def fit(
        self,
        runs: Sequence[Run],
        structure: Structure,
        *,
        m: int | None,
        threads: int | None,
        progress: ProgressCallback,
    ) -> Fit:
        """Fit a structure to validated runs; arguments as in `identify`, but the offset is not ``"auto"``."""


@check_arguments
@dataclass(frozen=True, kw_only=True)
class OutputError:
    """Output-error method, which estimates orders and coefficients of all equations together.

    It maximizes the likelihood of white measurement noise.

    Orders are continuous, initialization is automatic, and parameters have confidence intervals.

    Parameters
    ----------
    loss
        ``"squares"``, or ``"huber"``, which limits the influence of residuals beyond 1.345 standard deviations. Without
        outliers it has 95 % of the efficiency of least squares. The reported error metrics weight all samples equally.
    intervals
        Kind of the 95 % intervals. ``"quadratic"``: estimate ± 1.96 standard errors, exact for a quadratic cost.
        ``"profile"``: profile likelihood for every parameter, 10 to 200 simulations each. ``"auto"``: profile
        likelihood for parameters whose quadratic interval is wrong by over a tenth, as tested by two simulations each.
        See :meth:`ftlm.Identification.profile`.
    start
        Additional initial guess: an identification, a model of the same outputs, or values of free parameters by name.
        The cost of the fit is never larger than the cost of a fit from this guess alone. A missing coefficient starts
        at 0. A free order that is fixed in the given model starts at the fixed value.
    reference
        Name of a reference signal of a closed loop in the runs, such as its set point. It serves as external
        instrument: the fit makes residuals orthogonal to sensitivities computed from the part of every input that the
        reference explains. This part is uncorrelated with the noise that feedback carries into the inputs.
    noise
        Noise model: ``"white"``, or ``"ar"`` for y = G u + e / A(q), where model and autoregression are estimated
        together by the prediction-error method. The estimate is consistent in a closed loop if A(q) can describe the
        noise and the loop has a delay (Ljung, chapter 13). ``"ar"`` requires one output, a linear model and uniform
        samples; its intervals are ± 1.96 standard errors.
    bounds
        (lower, upper) of coefficients and orders by name; infinite without a bound on that side. A coefficient that
        ends on a bound is fixed at the bound, has no confidence interval, and is named by a finding.
    priors
        (mean, standard deviation) of normal priors of orders, coefficients, delays and actuator limits by name. The
        estimate maximizes the posterior density, and its intervals include the priors. Findings name a prior whose mean
        differs by more than three standard deviations from the estimate without it, and a parameter that its prior
        determines.

    Raises
    ------
    ModelError
        If `loss`, `intervals` or `noise` is unknown, `start` or `reference` has the wrong type, or a reference is
        combined with profile likelihood, a noise model or priors.
    """

    name: ClassVar[str] = "output-error"
    loss: Loss = "squares"
    intervals: Intervals = "auto"
    start: Identification | Model | Mapping[str, float] | None = None
    reference: str | None = None
    noise: Noise = "white"
    bounds: Bounds | None = None
    priors: Priors | None = None

    def __post_init__(self) -> None:
        check_choice("loss", self.loss, get_args(Loss))
        check_choice("intervals", self.intervals, get_args(Intervals))
        check_choice("noise", self.noise, get_args(Noise))
        check_intervals(self.bounds or {})
        check_priors(self.priors or {})
        if not (self.start is None or isinstance(self.start, (Identification, Model, Mapping))):
            raise ModelError(
                f"start is {type(self.start).__name__}; give an identification, a model, or values by name"
            )
        if not (self.reference is None or isinstance(self.reference, str)):
            raise ModelError(f"reference is {type(self.reference).__name__}; give the name of a signal of the runs")
        if self.intervals == "profile" and self.reference is not None:
            raise ModelError(
                f"{parameter('intervals', 'profile')} needs a cost that has its minimum at the estimate, and "
                f"{parameter('reference')} has none; use {parameter('intervals', 'quadratic')}, or leave it out"
            )
        if self.priors and self.reference is not None:
            raise ModelError(
                f"{parameter('priors')} cannot be used with {parameter('reference')}: an instrumental-variable "
                "estimate minimizes no cost to which a prior could be added; leave one of the two out"
            )
        if self.noise == "ar" and (self.reference is not None or self.intervals == "profile" or self.loss != "squares"):
            conflicting_option = (
                "reference" if self.reference is not None else "loss" if self.loss != "squares" else "intervals"
            )
            raise ModelError(
                f"{parameter('noise', 'ar')} is not used with {parameter(conflicting_option)}; leave one of the two out"
            )

    def fit(
        self,
        runs: Sequence[Run],
        structure: Structure,
        *,
        m: int | None = None,
        threads: int | None = None,
        progress: ProgressCallback = None,
        fitted: JointFit | None = None,
        is_preliminary: bool = False,
    ) -> Fit:
        """Fit a structure to checked runs; see :func:`ftlm.identify`.

        `fitted` is a joint fit by the method that :attr:`preliminary_method` returns. If given, it is completed with
        the remaining confidence intervals, and no new fit is made. A preliminary fit has no findings.
        """
        if self.reference is not None and structure.has_friction:
            raise ModelError(
                f"the equation of {structure.outputs[structure.friction_equations[0]]} has friction, which the "
                f"instrument {parameter('reference', self.reference)} does not support; leave one of the two out"
            )
        if self.reference is not None:
            check_linear(structure.equations, f"the instrument {parameter('reference', self.reference)}")
        workers, noise_free_runs, instrument_findings = check_threads(threads), None, list[Finding]()
        if self.reference is not None:
            noise_free_runs, instrument_findings = instrument_runs(runs, structure, self.reference)
        start_model = self.start.model if isinstance(self.start, Identification) else self.start
        values = self.start.parameters.items() if isinstance(self.start, Identification) else ()
        start_values = {n: p.value for n, p in values if not p.fixed}
        structure, bounds = check_bounds(structure, self.bounds, start_model)
        structure = with_priors(structure, self.priors)
        if self.noise == "ar":
            check_noise_model(runs, structure)

        def estimate(variant: Structure, single_guess: Mapping[str, float] | None) -> tuple[Fit, Mapping[str, float]]:
            fixed = set(structure.coefficient_names) - set(variant.coefficient_names)
            guess = start_model
            if fixed and isinstance(start_model, Mapping):
                guess = {n: v for n, v in start_model.items() if n not in fixed} or None
            task, guess_or_start, single_start = (
                Task(tuple(runs), variant),
                guess if single_guess is None else single_guess,
                single_guess is not None,
            )
            if self.noise == "ar":
                fit = fit_noise_model(
                    estimate_output_error(
                        task,
                        m,
                        workers,
                        progress,
                        None,
                        self.loss,
                        "quadratic",
                        guess_or_start,
                        start_values,
                        single_start=single_start,
                    ),
                    lambda white, joint: estimate_output_error(
                        white, m, workers, None, None, self.loss, "quadratic", joint.values_by_name, single_start=True
                    ),
                )
            else:
                fit = estimate_output_error(
                    task,
                    m,
                    workers,
                    progress,
                    noise_free_runs,
                    self.loss,
                    self.intervals,
                    guess_or_start,
                    start_values,
                    single_start,
                    fitted,
                    is_preliminary,
                )
            return fit, {} if fit.joint is None else fit.joint.values_by_name

        fit, bound_findings = fit_within_bounds(structure, bounds, estimate)
        fit = replace(fit, findings=[*fit.findings, *bound_findings])
        if self.priors and fit.joint is not None:
            fit = replace(
                fit,
                findings=[*fit.findings, *prior_findings(self.priors, fit.joint)],
                settings={**fit.settings, "priors": dict(structure.priors or {})},
            )
        return fit if self.reference is None else with_reference_findings(fit, self.reference, instrument_findings)

    @property
    def preliminary_method(self) -> OutputError | None:
        """Method without profile likelihood, for preliminary fits that :meth:`fit` can complete.

        None with bounds, a noise model or a reference, because :meth:`fit` cannot complete such fits.
        """
        resumable = self.bounds is None and self.noise == "white" and self.reference is None
        return replace(self, intervals="quadratic") if resumable else None


@dataclass(frozen=True, kw_only=True)
class OrderSearchMethod:
    """Base class of the equation-error methods, with the options of their order search.

    If no order is free, the options must have their default values.

    Parameters
    ----------
    order_grid, criterion, norm, top, store, executor
        See :func:`ftlm.search_orders`.
    """

    name: ClassVar[str]
    order_grid: OrderGrid | None = None
    criterion: Criterion = SearchSettings.criterion
    norm: Norm = SearchSettings.norm
    top: int = SearchSettings.top
    store: str | os.PathLike[str] | None = None
    executor: Executor | None = None

    def __post_init__(self) -> None:
        check_order_grid(self.order_grid)
        check_executor(self.executor)
        if not (self.store is None or isinstance(self.store, (str, os.PathLike))):
            raise ModelError(f"store is {type(self.store).__name__}; give the path of a file")
        self.settings()

    def settings(self) -> SearchSettings:
        """Return the options of the order search and of the coefficient estimation as one object."""
        names = {f.name for f in fields(self)} & {f.name for f in fields(SearchSettings)}
        return SearchSettings(
            coefficients=cast("Coefficients", self.name), **{name: getattr(self, name) for name in names}
        )

    def fit(
        self,
        runs: Sequence[Run],
        structure: Structure,
        *,
        m: int | None = None,
        threads: int | None = None,
        progress: ProgressCallback = None,
    ) -> Fit:
        """Search the free orders on a grid, then estimate the coefficients; see :func:`ftlm.identify`."""
        check_no_friction(structure, self.name)
        check_order_grid_names(self.order_grid, structure)
        changed = [f.name for f in fields(OrderSearchMethod) if getattr(self, f.name) != f.default]
        if changed and not structure.order_names:
            raise ModelError(
                f"{parameter(changed[0])} is not used: it is for order searches, and every order here is a number; "
                "leave it out, or free an order"
            )
        task, workers = Task(tuple(runs), structure, self.order_grid), threads_per_task(threads, self.executor)
        return estimate_order_search(task, self.settings(), m, workers, progress, self.store, self.executor)


@check_arguments
@dataclass(frozen=True, kw_only=True)
class LeastSquares(OrderSearchMethod):
    """Least-squares method, which minimizes the equation error at the best orders of an order grid.

    It is the limit of the multi-innovation method for a weak prior. Noise on the outputs biases the estimate.

    Parameters
    ----------
    order_grid, criterion, norm, top, store, executor
        Options of the order search; see :func:`ftlm.search_orders`. Without a free order they must be the defaults.

    Raises
    ------
    ModelError
        If :func:`ftlm.search_orders` does not accept the value of an option.
    """

    name: ClassVar[str] = "least-squares"


@check_arguments
@dataclass(frozen=True, kw_only=True)
class InstrumentalVariables(OrderSearchMethod):
    """Method of refined instrumental variables, which estimates coefficients at the best orders of an order grid.

    Noise on the outputs does not bias the coefficients.

    Parameters
    ----------
    order_grid, criterion, norm, top, store, executor
        Options of the order search; see :func:`ftlm.search_orders`. Without a free order they must be the defaults.

    Raises
    ------
    ModelError
        If :func:`ftlm.search_orders` does not accept the value of an option.
    """

    name: ClassVar[str] = "instrumental-variables"


@check_arguments
@dataclass(frozen=True, kw_only=True)
class MultiInnovation(OrderSearchMethod):
    """Multi-innovation method, eq. (44) of the paper, which estimates coefficients with a prior at the best orders.

    Parameters
    ----------
    order_grid, criterion, norm, top, store, executor
        Options of the order search; see :func:`ftlm.search_orders`. Without a free order they must be the defaults.
    innovation_length
        Innovation length p in eqs. (43)-(44) of the paper. It only weights the data against the prior.
    prior_covariance
        Diagonal entry of the prior covariance K0 in eqs. (43)-(44) of the paper, the same for all coefficients. By
        default the prior is weak and independent of units: 1e10 over the sum of squares of each coefficient's
        regressor. The paper uses 1.
    row_basis
        Basis of the rows in eq. (42) of the paper: ``"haar"`` for Haar wavelets, for which m is a power of two, or
        ``"time"``.

    Raises
    ------
    ModelError
        If :func:`ftlm.search_orders` does not accept the value of an option.
    """

    name: ClassVar[str] = "multi-innovation"
    innovation_length: int = SearchSettings.innovation_length
    prior_covariance: float | None = SearchSettings.prior_covariance
    row_basis: RowBasis = SearchSettings.row_basis


#: Classes of the estimation methods by name. The name alone selects the method with default options.
METHODS_BY_NAME: dict[str, type[Any]] = {
    method.name: method
    for method in (OutputError, InstrumentalVariables, MultiInnovation, LeastSquares, GeneticAlgorithm)
}


def resolve_method(method: str | EstimationMethod) -> EstimationMethod:
    """Return the method of estimation that a name or an object denotes; raise ModelError if there is none."""
    if isinstance(method, str):
        check_choice("method", method, METHODS_BY_NAME)
        estimator: EstimationMethod = METHODS_BY_NAME[method]()
        return estimator
    if isinstance(method, type):
        raise ModelError(f"method is the class {method.__name__}; pass an object, method={method.__name__}()")
    if not (isinstance(getattr(method, "name", None), str) and callable(getattr(method, "fit", None))):
        names = " or ".join(map(repr, METHODS_BY_NAME))
        raise ModelError(f"method is {type(method).__name__}; use {names}, or an object such as ftlm.OutputError()")
    return method


def method_with_options(name: str, options: Mapping[str, Any]) -> EstimationMethod:
    """Return the named method with the given options; raise ModelError for an option that it lacks."""
    check_choice("method", name, METHODS_BY_NAME)
    names = {method: [f.name for f in fields(kind)] for method, kind in METHODS_BY_NAME.items()}
    unused = [option for option in options if option not in names[name]]
    if unused:
        users = " or ".join(
            parameter("method", method) for method, options_of_method in names.items() if unused[0] in options_of_method
        )
        count = len(unused) - 1
        further_options = f", nor {count} other{'s' if count > 1 else ''} given here" if count else ""
        raise ModelError(
            f"{parameter(unused[0])} is not used by {parameter('method', name)}{further_options}; leave it out, or "
            f"use {users}"
        )
    estimator: EstimationMethod = METHODS_BY_NAME[name](**options)
    return estimator
