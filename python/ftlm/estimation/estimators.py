"""Estimators of whole structures: joint output error, external instruments, and order search with linear methods."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from ftlm import _core
from ftlm.data.run import Run
from ftlm.errors import FtlmError
from ftlm.estimation.confidence_intervals import Intervals, with_intervals
from ftlm.estimation.fit import Fit, ProgressCallback, initial_terms_text, make_model, offset_setting
from ftlm.estimation.free_parameters import FreeProblem, values_of_model, warm_starts
from ftlm.estimation.linear import estimate_coefficients, step_bias_findings
from ftlm.estimation.model_checks import (
    coefficient_law_findings,
    identifiability_findings,
    multistart_findings,
    sample_findings,
)
from ftlm.estimation.nuisance_parameters import errors_with_orders, fit_with_initial_conditions
from ftlm.estimation.objective import Iterate, Objective, propagated_covariance
from ftlm.estimation.output_error import JointFit, Loss
from ftlm.estimation.result import Task
from ftlm.findings import Finding, make_finding
from ftlm.model.model import Estimate, Model
from ftlm.order_search.checkpoint import Store
from ftlm.order_search.options import SearchSettings
from ftlm.order_search.result import SearchResult
from ftlm.order_search.search import announce_time, make_job, run_job
from ftlm.progress import FractionTracker
from ftlm.simulation.discretization import prepare
from ftlm.simulation.initial_conditions import resolve_start
from ftlm.structure.structure import Structure
from ftlm.utils.linalg import orthonormal, projections, vector_norm
from ftlm.utils.validation import Floats
from ftlm.validation.comparison import compare_means

#: Maximum number of Gauss-Newton steps, and of halvings of one step.
MAX_GAUSS_NEWTON_STEPS = 40
MAX_STEP_HALVINGS = 6
#: Maximum step of a converged fit, for every parameter [standard errors].
STEP_TOLERANCE_ERRORS = 1e-3
#: Singular value of the instruments, relative to the largest one, below which it counts as a rounding error.
INSTRUMENT_RANK_TOLERANCE = 1e-12
#: Minimum score of the best candidate, relative to the score of a zero output, for a finding on a small prior
#: covariance.
MAX_PRIOR_SCORE_RATIO = 0.5
#: Minimum number of block pulses per sampling interval in a fit with instruments, whose step is not refined.
MIN_PULSES_PER_SAMPLE = 2


def fit_with_instruments(
    joint: JointFit, problem: FreeProblem, runs: Sequence[Run], noise_free_runs: Sequence[Run]
) -> JointFit:
    """Return a joint fit whose output-error residuals are uncorrelated with instruments from noise-free inputs.

    `joint` is the initial fit to `noise_free_runs`. These are the measured `runs` in which each input is replaced by
    the noise-free part that the reference explains.

    The residuals belong to the measured runs. The instruments are the sensitivities of the outputs to the parameters,
    computed with `noise_free_runs`. Residuals that are orthogonal to the instruments have no bias from feedback of
    noise, even if `noise_free_runs` are inaccurate (Young, Recursive Estimation and Time-Series Analysis, 2011,
    chapters 7 and 9). The equations are solved by Gauss-Newton. The covariance is robust to colored residuals.
    """
    weights = [1.0 / max(joint.noise[o], 1e-300) for o in problem.structure.outputs]
    pulses_per_sample = max(joint.refinement, MIN_PULSES_PER_SAMPLE)
    data_objective, noise_free_objective = (
        Objective(problem, data, weights, pulses_per_sample=pulses_per_sample) for data in (runs, noise_free_runs)
    )
    values, converged = joint.values, False
    evaluation = _evaluate_estimating_equation(data_objective, noise_free_objective, values)
    for _ in range(MAX_GAUSS_NEWTON_STEPS):
        iterate, slopes, instruments = evaluation
        residuals = np.asarray(iterate.outcome["residuals"])
        jacobian_inverse = np.linalg.pinv(instruments @ slopes.T)
        step = -jacobian_inverse @ (instruments @ residuals)
        errors = np.sqrt(np.diag(_covariance(data_objective, iterate, jacobian_inverse @ instruments)))
        if np.all(np.abs(step) <= STEP_TOLERANCE_ERRORS * errors):
            converged = True
            break
        current_norm = _estimating_equation_norm(evaluation)
        for halving in range(MAX_STEP_HALVINGS):
            trial = problem.feasible_point(values, values + 0.5**halving * step)
            try:
                trial_evaluation = _evaluate_estimating_equation(data_objective, noise_free_objective, trial)
            except FtlmError:
                # The simulation diverges after a step of this length.
                continue
            if _estimating_equation_norm(trial_evaluation) < current_norm:
                values, evaluation = trial, trial_evaluation
                break
        else:
            break
    iterate, slopes, instruments = evaluation
    covariance = _covariance(data_objective, iterate, np.linalg.pinv(instruments @ slopes.T) @ instruments)
    orders, coefficients, inputs = problem.split(values.tolist())
    levels = data_objective.rms_residuals(iterate)
    return replace(
        joint,
        orders=dict(zip(problem.orders, orders, strict=True)),
        coefficients=dict(zip(problem.coefficients, coefficients, strict=True)),
        inputs=dict(zip((item.name for item in problem.inputs), inputs, strict=True)),
        covariance=covariance,
        noise={o: level / w for (o, level), w in zip(levels.items(), weights, strict=True)},
        cost=float(iterate.outcome["cost"]),
        residuals=data_objective.residuals(iterate),
        refinement=pulses_per_sample,
        converged=converged,
    )


def feedback_bias(joint: JointFit, problem: FreeProblem, runs: Sequence[Run], noise_free_runs: Sequence[Run]) -> float:
    """Return the largest bias that feedback of noise causes in a parameter, in standard errors of the parameter.

    `noise_free_runs` are the runs with inputs from which the part that depends on past residuals is removed. They serve
    as instruments, and the bias is the first Gauss-Newton step of :func:`fit_with_instruments`. The result is infinite
    if that step cannot be computed.
    """
    weights = [1.0 / max(joint.noise[o], 1e-300) for o in problem.structure.outputs]
    pulses_per_sample = max(joint.refinement, MIN_PULSES_PER_SAMPLE)
    try:
        data_objective, noise_free_objective = (
            Objective(problem, data, weights, pulses_per_sample=pulses_per_sample) for data in (runs, noise_free_runs)
        )
        iterate, slopes, instruments = _evaluate_estimating_equation(data_objective, noise_free_objective, joint.values)
    except FtlmError:
        return math.inf
    step = np.linalg.pinv(instruments @ slopes.T) @ (instruments @ np.asarray(iterate.outcome["residuals"]))
    errors = np.array([joint.standard_errors[n] for n in joint.names])
    is_finite = np.isfinite(errors) & (errors > 0)
    return float(np.max(np.abs(step[is_finite]) / errors[is_finite], initial=0.0))


def _evaluate_estimating_equation(
    data_objective: Objective, noise_free_objective: Objective, values: Floats
) -> tuple[Iterate, Floats, Floats]:
    """Return the evaluated residuals, their Jacobian on measured inputs, and the Jacobian on noise-free inputs.

    Both Jacobians have shape (parameters, residuals).
    """
    orders, coefficients, inputs = data_objective.problem.split(values.tolist())
    start = Iterate(orders, coefficients, "instruments", {}, inputs)
    iterate = data_objective.minimize(start, 1, linear_scale=True)
    instruments = noise_free_objective.minimize(start, 1, linear_scale=True)
    return iterate, np.asarray(iterate.outcome["jacobian"]), np.asarray(instruments.outcome["jacobian"])


def _estimating_equation_norm(evaluation: tuple[Iterate, Floats, Floats]) -> float:
    """Return the norm of the residuals projected onto the span of the instruments."""
    iterate, _, instruments = evaluation
    basis = orthonormal(instruments.T, INSTRUMENT_RANK_TOLERANCE)
    return vector_norm(projections(basis, np.asarray(iterate.outcome["residuals"])))


def _covariance(objective: Objective, iterate: Iterate, influence: Floats) -> Floats:
    """Return the parameter covariance, consistent under heteroskedasticity and autocorrelation of residuals.

    The estimator is that of Newey and West (doi:10.2307/1913610). ``influence`` is the derivative of each parameter
    with respect to each residual, of shape (parameters, residuals).
    """
    series = [residuals for run_residuals in objective.residuals(iterate) for residuals in run_residuals.values()]
    return _core.long_run_covariance(influence, series)


#: Maximum number of block pulses per run for the final instrumental-variable fit if m is not given.
MAX_IV_PULSES = 1 << 14


def loss_setting(joint: JointFit) -> dict[str, Any]:
    """Return the robust loss and its summary as entries of `Fit.settings`; {} for squared residuals."""
    return {} if joint.robust is None else {"loss": "huber", **asdict(joint.robust)}


def estimate_output_error(
    task: Task,
    m: int | None,
    threads: int,
    progress: ProgressCallback,
    noise_free_runs: Sequence[Run] | None = None,
    loss: Loss = "squares",
    intervals: Intervals = "auto",
    begin: Model | Mapping[str, float] | None = None,
    additional_values: Mapping[str, float] | None = None,
    single_start: bool = False,
    joint_fit: JointFit | None = None,
    is_preliminary: bool = False,
) -> Fit:
    """Estimate orders and coefficients together by joint output error.

    `noise_free_runs` are the runs with each input replaced by the part that a reference explains. If given, they serve
    as instruments. `begin` is an additional initial guess. If it is a model, `additional_values` adds values of
    parameters that the model lacks. If `single_start` is True, no other initial guess is used. `joint_fit` is a joint
    fit of the same task, if one was computed before. A preliminary fit has no findings.
    """
    # An order with a single grid value is fixed.
    order_values = {n: v[0] for n, v in task.structure.order_values.items() if len(v) == 1}
    request = task.structure.with_orders(order_values)
    structure = resolve_start(task.runs, request)
    record = prepare(task.runs, structure.without_free_input_parameters(), m, power_of_two=False, gaps=True)[0]
    start = record.initial
    additional_guesses: list[dict[str, float]] = []
    if begin is not None:
        free = FreeProblem.of(replace(structure, initial="rest"))
        guess = values_of_model(free, begin, additional_values or {}) if isinstance(begin, Model) else begin
        additional_guesses = warm_starts(free, guess)
    # Progress assumes one fit, since a second one (with or without a history) is rare. Profiles take about a third.
    tracker = FractionTracker(progress)
    joint = joint_fit or fit_with_initial_conditions(
        noise_free_runs or task.runs,
        structure,
        start,
        threads=threads,
        progress=tracker.subtask(0.7, 0.9),
        loss=loss,
        guesses=additional_guesses,
        single_start=single_start,
    )
    tracker.advance_to(0.7)
    problem = FreeProblem.of(replace(structure, initial=joint.initial))
    lower: list[Finding] = []
    if noise_free_runs is not None:
        joint = fit_with_instruments(joint, problem, task.runs, noise_free_runs)
    else:
        joint, lower = with_intervals(
            joint, problem, task.runs, intervals, threads=threads, progress=tracker.subtask(1.0, 0.9), loss=loss
        )
    tracker.advance_to(1.0)
    findings: list[Finding] = []
    if not is_preliminary:
        findings = [*lower, *identifiability_findings(joint, problem), *sample_findings(task.runs, joint, problem)]
    if noise_free_runs is None and not is_preliminary:
        findings += multistart_findings(joint, problem, task.runs)
    if start == "rest" and joint.initial != "rest":
        # Otherwise a comparison of the model would assume rest because of the first samples.
        structure = request = replace(structure, initial="history")
        findings.append(make_finding("rest_rejected", run=", ".join(r.name for r in task.runs)))
    coefficients = problem.coefficients_by_name(list(joint.coefficients.values()))
    # On another run the initial conditions are determined again.
    identified = request.with_orders(joint.orders).with_coefficients(coefficients)
    return Fit(
        Task(task.runs, structure),
        "output-error",
        make_model(
            task,
            "output-error",
            identified.with_input_parameters(joint.inputs),
            {**order_values, **joint.orders},
            record.m,
        ),
        len(joint.names),
        {
            "method": "output-error",
            "m": record.m,
            "initial": initial_terms_text(joint.initial),
            "refinement": joint.refinement,
            "starts": len(joint.starts),
            "noise": joint.noise,
            "converged": joint.converged,
            **offset_setting(structure),
            **loss_setting(joint),
        },
        findings,
        joint=joint,
        covariance=number_covariance(joint, problem),
    )


def number_covariance(joint: JointFit, problem: FreeProblem) -> tuple[tuple[float, ...], ...] | None:
    """Return the covariance of all parameters, as a model file stores it; None if a parameter is not identifiable."""
    jacobian = problem.model_parameter_jacobian(list(joint.coefficients.values()))
    inputs = problem.structure.with_input_parameters(joint.inputs).fixed_input_parameters
    jacobian = np.array([*jacobian, *([float(n == name) for n in joint.names] for name in inputs)])
    covariance = propagated_covariance(jacobian, joint.covariance)
    return tuple(tuple(row) for row in covariance.tolist()) if np.all(np.isfinite(covariance)) else None


def estimate_order_search(
    task: Task,
    settings: SearchSettings,
    m: int | None,
    threads: int,
    progress: ProgressCallback,
    store: str | os.PathLike[str] | None,
    executor: Executor | None,
) -> Fit:
    """Search the orders on a grid, then estimate the coefficients at the best orders by the same linear method."""
    searches = (
        run_order_searches(task, settings, m, threads, progress, store, executor) if task.structure.order_names else {}
    )
    return fit_at_best_orders(task, settings, m, searches)


def fit_at_best_orders(
    task: Task, settings: SearchSettings, m: int | None, searches: Mapping[str, SearchResult]
) -> Fit:
    """Estimate the coefficients at the best orders of completed order searches, by a linear method."""
    method, structure = settings.coefficients, task.structure
    orders = {n: v for search in searches.values() for n, v in search.orders.items()}
    rank = 1
    if "stage" in searches and method == "instrumental-variables" and structure.coupling == "simulated":
        rank = coupled_rank(task, settings, m, searches["stage"])
        orders = searches["stage"].table[rank - 1].orders
    if m is None and method == "instrumental-variables":
        # Instrumental variables remove the noise bias, so the bias of the step matters: use all samples.
        m = min(MAX_IV_PULSES, *(run.length - 1 for run in task.runs))
    at_orders = structure.with_orders(orders)
    fit = estimate_coefficients(task.runs, at_orders, settings, m)
    errors: Mapping[str, float] = fit.errors
    free = structure.with_orders({n: v for n, v in orders.items() if n in fixed_orders(task)})
    if free.order_names and fit.errors:
        # Standard errors of the coefficients at fixed orders are too small if the orders are estimates.
        errors = errors_with_orders(task.runs, free, {**orders, **fit.values}) or {}
    model = make_model(task, method, at_orders.with_coefficients(fit.values), orders, fit.m, **settings.to_dict())
    edges = [(n, v) for search in searches.values() for n, v in search.at_grid_edge.items()]
    return Fit(
        task,
        method,
        model,
        len(orders) + len(fit.values),
        {
            **settings.to_dict(),
            "m": fit.m,
            "initial": initial_terms_text(fit.initial),
            **({"rank": rank} if rank > 1 else {}),
            **offset_setting(structure),
        },
        [
            *fit.findings,
            *prior_findings(task, settings, m, searches),
            *step_bias_findings(task.runs, at_orders, settings, fit),
            *coefficient_law_findings(model),
            *(make_finding("order_on_edge", parameter=n, value=v) for n, v in edges),
        ],
        dict(searches),
        errors,
    )


def prior_findings(
    task: Task, settings: SearchSettings, m: int | None, searches: Mapping[str, SearchResult]
) -> list[Finding]:
    """Return a finding on each order search in which a small prior covariance shrinks the best simulation to near 0."""
    if settings.coefficients != "multi-innovation" or settings.prior_covariance is None:
        return []
    if settings.criterion != "output-error":
        return []
    findings = []
    groups = task.structure.independent_groups() if searches else {}
    for name, search in searches.items():
        group = groups.get(name, task.structure)
        if len(group.equations) > 1:
            continue
        (output,) = group.outputs
        records = prepare(task.runs, group, m, power_of_two=settings.needs_haar)
        outputs = np.concatenate([record.of(output) for record in records])
        zero_output_score = np.abs(outputs).sum() if settings.norm == "l1" else np.sqrt(np.mean(outputs**2))
        score_ratio = search.score / float(zero_output_score)
        if score_ratio > MAX_PRIOR_SCORE_RATIO:
            findings.append(
                make_finding("prior_decides_ranking", output=output, prior=settings.prior_covariance, share=score_ratio)
            )
    return findings


def fixed_orders(task: Task) -> set[str]:
    """Return the names of orders with a single grid value, which are not estimated."""
    groups = task.structure.independent_groups().values() if task.structure.order_names else []
    axes = [task.part_order_grid(group).values(group) for group in groups]
    return {n for values in axes for n, v in values.items() if len(v) == 1}


def run_order_searches(
    task: Task,
    settings: SearchSettings,
    m: int | None,
    threads: int,
    progress: ProgressCallback,
    store: str | os.PathLike[str] | None,
    executor: Executor | None,
) -> dict[str, SearchResult]:
    """Run an order search for each independent group of equations, all with one checkpoint file.

    The results are keyed by output, or by ``"stage"`` for a search of coupled equations.
    """
    jobs = {
        name: make_job(task.runs, group, task.part_order_grid(group), settings, m=m, threads=threads, progress=progress)
        for name, group in task.structure.independent_groups().items()
    }
    with contextlib.ExitStack() as stack:
        requests = [job.request(name) for name, job in jobs.items()]
        store_file = None if store is None else stack.enter_context(Store(store, requests))
        announce_time(progress, list(jobs.values()), store_file)
        return {
            name: run_job(job, store=store_file, number=number, executor=executor)
            for number, (name, job) in enumerate(jobs.items())
        }


def coupled_rank(task: Task, settings: SearchSettings, m: int | None, search: SearchResult) -> int:
    """Return the rank in an order search of the orders with the most likely simulation of all equations together.

    The order search ranks candidates by simulations in which measured outputs enter each equation. Such simulations
    hardly distinguish neighboring orders. The criterion here is the sum over outputs of ln NR, where NR is the
    normalized residual of eq. (47) of the paper. Except for a constant, this sum is proportional to the negative log
    likelihood of white residuals of unknown variance.
    """
    best, rank = math.inf, 1
    for row in search.table:
        at_orders = task.structure.with_orders(row.orders)
        try:
            fit = estimate_coefficients(task.runs, at_orders, settings, m)
            comparison = compare_means(Model(at_orders.with_coefficients(fit.values), m=fit.m), task.runs, m=fit.m)
        except FtlmError:
            # This row has a score, but its model cannot be estimated or simulated.
            continue
        cost = sum(math.log(max(f.nr, 1e-300)) for f in comparison.output_error.values())
        if cost < best:
            best, rank = cost, row.rank
    return rank


def fitted_model(joint: JointFit, structure: Structure) -> Model:
    """Return the model of a joint fit, with its initial conditions and the covariance of its parameters."""
    problem = FreeProblem.of(replace(structure, initial=joint.initial))
    coefficients = problem.coefficients_by_name(list(joint.coefficients.values()))
    identified_structure = (
        problem.structure.with_orders(joint.orders).with_coefficients(coefficients).with_input_parameters(joint.inputs)
    )
    estimate = Estimate("output-error", (), joint.values_by_name, covariance=number_covariance(joint, problem))
    return Model(identified_structure, orders=joint.orders, estimate=estimate)
