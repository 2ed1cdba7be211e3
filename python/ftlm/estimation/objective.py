"""Output-error objective on sampled runs: evaluation of residuals, minimization, and covariance of the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from ftlm import _core
from ftlm.data.run import Run
from ftlm.data.sampling import drop_missing
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.simulation.discretization import recording
from ftlm.utils.resources import stop_flag
from ftlm.utils.validation import Floats

#: Relative cost reduction of a full step below which the minimization has converged.
COST_REDUCTION_TOLERANCE = 1e-9


def sample_run(
    run: Run,
    problem: FreeProblem,
    weights: Sequence[float],
    *,
    pulses_per_sample: int = 1,
    decimation: int = 1,
    robust_weights: Floats | None = None,
) -> _core.Experiment:
    """Return a run as an object of the core, with block pulses and samples at the given resolution.

    `weights` are the reciprocal noise standard deviations of the outputs, `pulses_per_sample` is the number of block
    pulses per sampling interval, and every `decimation`-th sample is compared.

    `robust_weights` are the robust weights of the compared samples, of shape (outputs, samples). Missing samples have
    weight 0.
    """
    return recording(run, problem.structure).experiment(pulses_per_sample, decimation, list(weights), robust_weights)


@dataclass
class Iterate:
    """Point in parameter space, the initial guess from which it was reached, and its evaluation by the core."""

    orders: list[float]
    coefficients: list[float]
    origin: str
    outcome: Any
    inputs: list[float] = field(default_factory=list)

    @property
    def values(self) -> Floats:
        """Vector of orders, coefficients and input parameters."""
        return np.array(self.orders + self.coefficients + self.inputs)

    @property
    def cost_per_residual(self) -> float:
        """Mean squared weighted residual, which is 1 if the weights are the reciprocal noise standard deviations."""
        return 2.0 * float(self.outcome["cost"]) / len(self.outcome["residuals"])

    @property
    def has_converged(self) -> bool:
        """Whether the gradient vanishes except along active bounds; False if another constraint is active."""
        return bool(self.outcome["status"] == "converged")


def minimize_cost(
    problem: FreeProblem,
    experiments: Sequence[_core.Experiment],
    iterate: Iterate,
    *,
    evaluations: int,
    linear_scale: bool = False,
    fixed: int | Sequence[int] = (),
    tolerance: float = COST_REDUCTION_TOLERANCE,
    prefer_stable: bool = False,
) -> Iterate:
    """Minimize the output-error cost by Levenberg-Marquardt; parameters with an index in `fixed` stay constant.

    `iterate` is the initial point, and `evaluations` is the maximum number of evaluations. The optimization variables
    are logarithms of coefficients where the signs permit it; with `linear_scale`, they are the coefficients themselves.

    With `prefer_stable`, no step leads from a stable model to an unstable one.
    """
    states = iterate.outcome.get("states", []) if isinstance(iterate.outcome, dict) else []
    outcome = problem.core.minimize(
        experiments,
        (iterate.values.tolist(), states),
        linear_scale,
        (fixed,) if isinstance(fixed, int) else fixed,
        evaluations,
        tolerance,
        prefer_stable,
        stop_flag(),
    )
    orders, coefficients, inputs = problem.split(outcome["values"])
    return replace(iterate, orders=orders, coefficients=coefficients, inputs=inputs, outcome=outcome)


@dataclass(frozen=True)
class Objective:
    """Output-error objective: an estimation problem and runs at a given resolution.

    `weights` are the reciprocal noise standard deviations of the outputs, `pulses_per_sample` is the number of block
    pulses per sampling interval, and every `decimation`-th sample is compared.

    `robust_weights` are the weights of a robust loss: for each run an array (outputs, samples). With `prefer_stable`,
    no optimization step leads from a stable model to an unstable one.
    """

    problem: FreeProblem
    runs: Sequence[Run]
    weights: Sequence[float]
    pulses_per_sample: int = 1
    decimation: int = 1
    robust_weights: Sequence[Floats] | None = None
    prefer_stable: bool = False

    @cached_property
    def experiments(self) -> list[_core.Experiment]:
        """Runs as sampled objects of the core, with which simulations are compared."""
        weights_by_run = [None] * len(self.runs) if self.robust_weights is None else self.robust_weights
        return [
            sample_run(
                run,
                self.problem,
                self.weights,
                pulses_per_sample=self.pulses_per_sample,
                decimation=self.decimation,
                robust_weights=run_weights,
            )
            for run, run_weights in zip(self.runs, weights_by_run, strict=True)
        ]

    def minimize(
        self,
        iterate: Iterate,
        evaluations: int,
        *,
        linear_scale: bool = False,
        fixed: int | Sequence[int] = (),
        tolerance: float = COST_REDUCTION_TOLERANCE,
    ) -> Iterate:
        """Minimize the cost by Levenberg-Marquardt; see :func:`minimize_cost`."""
        return minimize_cost(
            self.problem,
            self.experiments,
            iterate,
            evaluations=evaluations,
            linear_scale=linear_scale,
            fixed=fixed,
            tolerance=tolerance,
            prefer_stable=self.prefer_stable,
        )

    def evaluate(self, iterate: Iterate) -> Iterate:
        """Return a point with its residuals and its cost, without derivatives."""
        return self.minimize(iterate, 0)

    def residuals(self, iterate: Iterate) -> list[dict[str, Floats]]:
        """Return residuals divided by noise standard deviations, by run and output, without robust weights.

        Missing samples are NaN.
        """
        residuals = np.asarray(iterate.outcome["residuals"])
        parts, at = [], 0
        for robust_weights, count in self.counts:
            run_residuals = {}
            for i, output in enumerate(self.problem.structure.outputs):
                run_residuals[output] = residuals[at : at + count]
                at += count
                if robust_weights is not None:
                    run_residuals[output] = run_residuals[output] / np.where(
                        robust_weights[i] > 0, robust_weights[i], np.nan
                    )
            parts.append(run_residuals)
        return parts

    @property
    def counts(self) -> list[tuple[Floats | None, int]]:
        """Robust weights and number of compared samples for each run."""
        return [(e.robust_weights, e.compared_count) for e in self.experiments]

    @property
    def residual_weights(self) -> Floats:
        """Robust weight of every residual, in the sequence of the core's residual vector."""
        outputs = len(self.problem.structure.outputs)
        return np.concatenate(
            [
                np.ones(outputs * count) if robust_weights is None else robust_weights.ravel()
                for robust_weights, count in self.counts
            ]
        )

    def rms_residuals(self, iterate: Iterate) -> dict[str, float]:
        """Return the root mean square of the weighted residuals by output, over all runs; infinite on overflow."""
        with np.errstate(over="ignore"):
            return {o: float(np.sqrt(np.mean(e**2))) for o, e in self.pooled_residuals(iterate).items()}

    def pooled_residuals(self, iterate: Iterate) -> dict[str, Floats]:
        """Return the weighted residuals by output, concatenated over all runs, without missing samples."""
        parts = self.residuals(iterate)
        return {o: drop_missing(np.concatenate([p[o] for p in parts])) for o in self.problem.structure.outputs}


def covariance(iterate: Iterate, objective: Objective) -> Floats:
    """Return the covariance matrix of the parameters at an optimum, robust to colored residuals.

    A parameter that is not identifiable has infinite variance, because small singular values are not truncated. With a
    robust loss the matrix is the covariance of an M-estimator. Priors of the structure are further observations.
    """
    series = [residuals for run_residuals in objective.residuals(iterate) for residuals in run_residuals.values()]
    jacobian, names = np.asarray(iterate.outcome["jacobian"]), objective.problem.names
    priors = {names.index(n): s for n, (_, s) in (objective.problem.structure.priors or {}).items() if n in names}
    columns = np.zeros((len(jacobian), len(priors)))
    columns[list(priors), range(len(priors))] = [-1.0 / s for s in priors.values()]
    weights = None if objective.robust_weights is None else np.r_[objective.residual_weights, np.ones(len(priors))]
    return _core.fit_covariance(np.hstack([jacobian, columns]), series, weights, len(priors))


def covariance_of(jacobian: Floats, series: Sequence[Floats], squares: float) -> Floats:
    """Return the covariance of parameters from a Jacobian of shape (parameters, residuals) and the residuals.

    `series` are the residuals of each run and output, and `squares` is their sum of squares.

    Missing residuals are NaN. Covariances with a parameter of infinite variance are NaN.
    """
    return _core.covariance_of(jacobian, series, squares)


def propagated_covariance(slopes: Floats, parameter_covariance: Floats) -> Floats:
    """Return the covariance of functions of the parameters, to first order; that of unidentifiable ones is not finite.

    `slopes` are the derivatives (functions, parameters), and `parameter_covariance` is that of the parameters. A
    variance that is only rounding error, which may be negative, is 0, and so are the covariances with it.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        out: Floats = slopes @ parameter_covariance @ slopes.T
        magnitudes = np.sum(np.abs(slopes) @ np.abs(parameter_covariance) * np.abs(slopes), axis=1)
        rounding = np.finfo(np.float64).eps * len(parameter_covariance) * magnitudes
        is_rounding = np.diagonal(out) <= rounding
    out[is_rounding], out[:, is_rounding] = 0.0, 0.0
    return out


def propagated_errors(slopes: Floats, parameter_covariance: Floats) -> Floats:
    """Return standard errors of functions of the parameters, to first order.

    `slopes` are the derivatives (functions, parameters), and `parameter_covariance` is that of the parameters. The
    error is infinite if a function depends on a parameter of infinite variance.
    """
    unidentifiable = np.isinf(np.diag(parameter_covariance))
    columns = slopes[:, ~unidentifiable]
    variance = np.einsum(
        "ij,jk,ik->i", columns, parameter_covariance[np.ix_(~unidentifiable, ~unidentifiable)], columns
    )
    return np.where((slopes[:, unidentifiable] != 0).any(axis=1), np.inf, np.sqrt(np.maximum(variance, 0.0)))
