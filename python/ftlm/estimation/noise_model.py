"""Output error with an autoregressive noise model: the fit that minimizes the one-step prediction errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ftlm.data.run import Run
from ftlm.errors import InternalError, ModelError
from ftlm.estimation.estimators import number_covariance
from ftlm.estimation.fit import Fit
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Iterate, Objective
from ftlm.estimation.output_error import JointFit, start_from_values
from ftlm.estimation.result import Task
from ftlm.findings import make_finding
from ftlm.structure.structure import Structure
from ftlm.utils.linalg import column_norms, minimum_norm_solution, orthonormal
from ftlm.utils.parameters import parameter
from ftlm.utils.statistics import autoregression
from ftlm.utils.validation import Floats
from ftlm.validation.residual_tests import DEFAULT_LAGS

#: Largest number of alternations of model and noise model, and largest change of a parameter of a converged one, in
#: standard errors.
MAX_ALTERNATIONS, ALTERNATION_TOLERANCE = 30, 0.02
#: Relative size of a direction of lagged noise below which it is rounding.
LAG_RANK_TOLERANCE = 1e-10


def check_noise_model(runs: Sequence[Run], structure: Structure) -> None:
    """Raise ModelError for runs and structures to which a noise model does not apply."""
    asked = parameter("noise", "ar")
    if len(structure.outputs) > 1:
        raise ModelError(f"{asked} is of one output, not of {', '.join(structure.outputs)}; fit each one")
    if not structure.is_linear or structure.limits:
        raise ModelError(
            f"{asked} filters inputs and output alike, and friction, non-linear terms and limits do not commute with it"
        )
    if any(run.sample_times is not None for run in runs):
        raise ModelError(f"{asked} needs samples on a regular grid; resample the runs, or leave it out")


def fit_noise_model(fit: Fit, refit: Callable[[Task, JointFit], Fit]) -> Fit:
    """Fit model and noise model in turn until neither changes, from a fit for white noise.

    The noise is v = e / A(q) with white e. A(q) is the autoregression of the residuals v of the simulation, and the
    model is fitted to the runs filtered by A(q): inputs and output of a linear model commute with it. Both decrease the
    sum of squared prediction errors, whose minimum is consistent in a closed loop with a delay (Ljung, System
    Identification, 1999, chapter 13). The covariance counts the estimated noise model.
    """
    first, runs, plain = fit, fit.task.runs, fit.joint
    if plain is None:
        raise InternalError("a fit by output error has no optimum; please report it")
    joint = plain
    for _ in range(MAX_ALTERNATIONS):
        residuals = _residuals(first, joint, runs)
        colour = _noise_model(residuals)
        white = tuple(whiten(run, colour) for run in runs)
        fit = refit(Task(white, replace(first.task.structure, initial=joint.initial)), joint)
        before, joint = joint, fit.joint or joint
        errors = np.sqrt(np.diag(joint.covariance))
        if np.all(np.abs(joint.values - before.values) <= ALTERNATION_TOLERANCE * errors):
            findings = fit.findings
            break
    else:
        findings = [*fit.findings, make_finding("not_converged")]
    order = colour.size - 1
    joint = replace(joint, starts=plain.starts, covariance=_with_noise_model_errors(fit, joint, residuals, order))
    return replace(
        fit,
        task=first.task,
        model=replace(fit.model, structure=replace(fit.model.structure, initial=first.model.structure.initial)),
        findings=findings,
        joint=joint,
        covariance=number_covariance(joint, FreeProblem.of(replace(fit.task.structure, initial=joint.initial))),
        settings={**fit.settings, "starts": len(joint.starts), "noise_model": colour[1:].tolist()},
    )


def _noise_model(residuals: Sequence[Floats]) -> Floats:
    """Return A(q) with the least squares of A(q) v; its order has the least Bayesian criterion."""
    order = autoregression(residuals, DEFAULT_LAGS).size - 1
    if order == 0:
        return np.ones(1)
    past, now = _lag_columns(residuals, order), np.concatenate(residuals)
    known = np.isfinite(now) & np.isfinite(past).all(axis=1)
    return np.concatenate([[1.0], -minimum_norm_solution(past[known], now[known], LAG_RANK_TOLERANCE)])


def _lag_columns(residuals: Sequence[Floats], order: int) -> Floats:
    """Return the residuals of all runs at lags 1 to ``order``, one column per lag; NaN before the first."""
    columns = [[np.concatenate([np.full(lag, np.nan), v[:-lag]]) for v in residuals] for lag in range(1, order + 1)]
    return np.stack([np.concatenate(column) for column in columns], axis=1)


def whiten(run: Run, colour: Floats) -> Run:
    """Return a run filtered by A(q). The first output samples are missing, because their past is unknown."""
    past = colour.size - 1

    def whitened_samples(values: Floats) -> Floats:
        return np.convolve(values, colour)[: values.size]

    return Run.from_arrays(
        step=run.step,
        inputs={n: whitened_samples(run[n]) for n in run.inputs},
        outputs={n: np.concatenate([np.full(past, np.nan), whitened_samples(run[n])[past:]]) for n in run.outputs},
        units={n: u for n, u in run.units.items() if u},
        intersample=run.intersample,
        name=run.name,
        missing="weight",
    )


def _at_estimate(fit: Fit, joint: JointFit, runs: Sequence[Run], weight: float) -> tuple[Objective, Iterate]:
    """Return the objective of a fit on some runs, and its estimate as an iterate."""
    problem = FreeProblem.of(replace(fit.task.structure, initial=joint.initial))
    values = joint.values_by_name
    return Objective(problem, runs, [weight], every=joint.refinement), start_from_values(problem, values)


def _residuals(fit: Fit, joint: JointFit, runs: Sequence[Run]) -> list[Floats]:
    """Return the residuals of the simulation by run; NaN for missing samples."""
    grid, start = _at_estimate(fit, joint, runs, 1.0)
    return [series for part in grid.residuals(grid.evaluate(start)) for series in part.values()]


def _with_noise_model_errors(fit: Fit, joint: JointFit, residuals: Sequence[Floats], order: int) -> Floats:
    """Return the covariance of the parameters that counts the errors of the noise model.

    They are independent of those of the model but where feedback makes the inputs follow the noise: there lagged
    residuals, the sensitivities to A(q), lie along the sensitivities to the parameters.
    """
    if order == 0:
        return joint.covariance
    grid, start = _at_estimate(fit, joint, fit.task.runs, 1.0 / max(*joint.noise.values(), 1e-300))
    rows = np.asarray(grid.minimize(start, 1, plain=True).outcome["jacobian"])
    scale = 1.0 / np.maximum(column_norms(rows.T), 1e-300)
    rows = rows * scale[:, None]
    # Missing samples have no sensitivity.
    basis = orthonormal(
        np.nan_to_num(_lag_columns(residuals, order)) * np.any(rows != 0.0, axis=0)[:, None], LAG_RANK_TOLERANCE
    )
    left = rows - (rows @ basis) @ basis.T
    added = np.linalg.pinv(left @ left.T) - np.linalg.pinv(rows @ rows.T)
    covariance: Floats = joint.covariance + scale[:, None] * added * scale
    return covariance
