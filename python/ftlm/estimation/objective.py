"""Output-error objective on sampled runs: residuals, minimization and covariance."""

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
    every: int = 1,
    decimation: int = 1,
    shares: Floats | None = None,
) -> _core.Experiment:
    """Convert a run for the core, with `every` pulses per sampling interval and each `decimation`-th sample.

    `shares` are the robust weights of the compared samples, one row an output. Missing samples have weight 0.
    """
    return recording(run, problem.structure).experiment(every, decimation, list(weights), shares)


@dataclass
class Iterate:
    """Point in parameter space with its origin and the result of its evaluation by the core."""

    orders: list[float]
    coefficients: list[float]
    origin: str
    outcome: Any
    inputs: list[float] = field(default_factory=list)

    @property
    def values(self) -> Floats:
        """Orders, coefficients and input parameters."""
        return np.array(self.orders + self.coefficients + self.inputs)

    @property
    def cost_per_residual(self) -> float:
        """Cost per residual: 1 at the noise level if the weights are right."""
        return 2.0 * float(self.outcome["cost"]) / len(self.outcome["residuals"])

    @property
    def has_converged(self) -> bool:
        """Whether the gradient vanishes, apart from active bounds; False at another constraint."""
        return bool(self.outcome["status"] == "converged")


def minimize_cost(
    problem: FreeProblem,
    experiments: Sequence[_core.Experiment],
    attempt: Iterate,
    *,
    evaluations: int,
    plain: bool = False,
    fixed: int | Sequence[int] = (),
    tolerance: float = COST_REDUCTION_TOLERANCE,
    prefer_stable: bool = False,
) -> Iterate:
    """Minimize the cost by Levenberg-Marquardt; parameters with an index in `fixed` stay fixed.

    With `prefer_stable`, no step leads from a stable model to an unstable one. Initial states of bodies with friction
    are not projected out and continue from the last values.
    """
    states = attempt.outcome.get("states", []) if isinstance(attempt.outcome, dict) else []
    outcome = problem.core.minimize(
        experiments,
        (attempt.values.tolist(), states),
        plain,
        (fixed,) if isinstance(fixed, int) else fixed,
        evaluations,
        tolerance,
        prefer_stable,
        stop_flag(),
    )
    orders, coefficients, inputs = problem.split(outcome["values"])
    return replace(attempt, orders=orders, coefficients=coefficients, inputs=inputs, outcome=outcome)


@dataclass(frozen=True)
class Objective:
    """Output-error objective on sampled runs: problem, output weights, pulses per sample, decimation.

    `robust_weights` holds the weights of a robust loss by run, one row an output. With `prefer_stable`, no step leads
    from a stable model to an unstable one.
    """

    problem: FreeProblem
    runs: Sequence[Run]
    weights: Sequence[float]
    every: int = 1
    decimation: int = 1
    robust_weights: Sequence[Floats] | None = None
    prefer_stable: bool = False

    @property
    def recordings(self) -> list[_core.Recording]:
        """Runs in the form that the core samples."""
        return [recording(run, self.problem.structure) for run in self.runs]

    @cached_property
    def experiments(self) -> list[_core.Experiment]:
        """Runs in the form that the core compares with."""
        shares = [None] * len(self.runs) if self.robust_weights is None else self.robust_weights
        return [
            sample_run(run, self.problem, self.weights, every=self.every, decimation=self.decimation, shares=share)
            for run, share in zip(self.runs, shares, strict=True)
        ]

    def minimize(
        self,
        attempt: Iterate,
        evaluations: int,
        *,
        plain: bool = False,
        fixed: int | Sequence[int] = (),
        tolerance: float = COST_REDUCTION_TOLERANCE,
    ) -> Iterate:
        """Minimize the cost by Levenberg-Marquardt; see :func:`minimize_cost`."""
        return minimize_cost(
            self.problem,
            self.experiments,
            attempt,
            evaluations=evaluations,
            plain=plain,
            fixed=fixed,
            tolerance=tolerance,
            prefer_stable=self.prefer_stable,
        )

    def evaluate(self, attempt: Iterate) -> Iterate:
        """Evaluate residuals and cost at a point, without derivatives."""
        return self.minimize(attempt, 0)

    def residuals(self, attempt: Iterate) -> list[dict[str, Floats]]:
        """Return unweighted residuals in noise deviations by run and output; NaN for missing samples."""
        residuals = np.asarray(attempt.outcome["residuals"])
        parts, at = [], 0
        for shares, count in self.counts:
            part = {}
            for i, output in enumerate(self.problem.structure.outputs):
                part[output] = residuals[at : at + count]
                at += count
                if shares is not None:
                    part[output] = part[output] / np.where(shares[i] > 0, shares[i], np.nan)
            parts.append(part)
        return parts

    @property
    def counts(self) -> list[tuple[Floats | None, int]]:
        """Robust weights and number of compared samples of each run."""
        return [(e.robust_weights, e.compared_count) for e in self.experiments]

    @property
    def residual_weights(self) -> Floats:
        """Robust weight of every residual, in the order of the core."""
        outputs = len(self.problem.structure.outputs)
        return np.concatenate(
            [np.ones(outputs * count) if shares is None else shares.ravel() for shares, count in self.counts]
        )

    def rms_residuals(self, attempt: Iterate) -> dict[str, float]:
        """Return the root mean square of the weighted residuals by output, over all runs.

        Infinite on overflow.
        """
        with np.errstate(over="ignore"):
            return {o: float(np.sqrt(np.mean(e**2))) for o, e in self.pooled_residuals(attempt).items()}

    def pooled_residuals(self, attempt: Iterate) -> dict[str, Floats]:
        """Return the weighted residuals by output, all runs concatenated, missing samples left out."""
        parts = self.residuals(attempt)
        return {o: drop_missing(np.concatenate([p[o] for p in parts])) for o in self.problem.structure.outputs}


def covariance(attempt: Iterate, grid: Objective) -> Floats:
    """Return the covariance of the parameters, robust to autocorrelation if residuals are not white.

    Nothing is truncated: a parameter in a direction that the data do not determine has infinite variance. Under a
    robust loss the covariance is that of an M-estimator.
    """
    series = [residuals for part in grid.residuals(attempt) for residuals in part.values()]
    shares = None if grid.robust_weights is None else grid.residual_weights
    return _core.fit_covariance(np.asarray(attempt.outcome["jacobian"]), series, shares)


def covariance_of(jacobian: Floats, series: Sequence[Floats], squares: float) -> Floats:
    """Return the covariance from a Jacobian (one row per parameter), residual series and their sum of squares.

    Missing residuals are NaN. Covariances with a parameter of infinite variance are NaN.
    """
    return _core.covariance_of(jacobian, series, squares)


def propagated_errors(slopes: Floats, spread: Floats) -> Floats:
    """Return standard errors by first-order propagation, infinite if a variance involved is infinite."""
    unidentifiable = np.isinf(np.diag(spread))
    columns = slopes[:, ~unidentifiable]
    variance = np.einsum("ij,jk,ik->i", columns, spread[np.ix_(~unidentifiable, ~unidentifiable)], columns)
    return np.where((slopes[:, unidentifiable] != 0).any(axis=1), np.inf, np.sqrt(np.maximum(variance, 0.0)))
