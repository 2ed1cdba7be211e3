"""A joint fit whose residuals are orthogonal to instruments, not to sensitivities: what a closed loop needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.errors import FtlmError
from ftlm.base.tall import length, orthonormal, projections
from ftlm.data.run import Run
from ftlm.fit.grid import Attempt, Grid
from ftlm.fit.joint import JointFit
from ftlm.fit.problem import FreeProblem
from ftlm.fit.uncertainty import long_run

#: Most steps, and how often one is halved.
STEPS = 40
HALVINGS = 6
#: A step that moves no number by this share of its standard error ends them.
STILL = 1e-3
#: What is left of an instrument below this share is rounding.
ALIKE = 1e-12
#: Least pulses a sample interval: the estimates are those of one grid.
EVERY = 2


def instrumented(joint: JointFit, problem: FreeProblem, runs: Sequence[Run], answers: Sequence[Run]) -> JointFit:
    """Solve for zero correlation of the residuals with sensitivities simulated from clean inputs.

    Residuals e are of the runs as they were measured, so nothing of the input is left out of the model; sensitivities
    are of the answers of the inputs to a reference, which noise is no part of. Where they are orthogonal, feedback of
    noise biases nothing, however well the answers are known (Young, Recursive Estimation and Time-Series Analysis,
    2011, chapters 7 and 9). Gauss-Newton from the fit to the answers; the covariance is robust to coloured residuals.
    """
    weights = [1.0 / max(joint.noise[o], 1e-300) for o in problem.structure.outputs]
    every = max(joint.refinement, EVERY)
    measured, clean = (Grid(problem, each, weights, every=every) for each in (runs, answers))
    values, converged = joint.values, False
    here = _moment(measured, clean, values)
    for _ in range(STEPS):
        attempt, slopes, instruments = here
        residuals = np.asarray(attempt.outcome["residuals"])
        bread = np.linalg.pinv(instruments @ slopes.T)
        step = -bread @ (instruments @ residuals)
        errors = np.sqrt(np.diag(_covariance(measured, attempt, bread @ instruments)))
        if np.all(np.abs(step) <= STILL * errors):
            converged = True
            break
        level = _size(here)
        for halving in range(HALVINGS):
            tried = problem.feasible(values, values + 0.5**halving * step)
            try:
                there = _moment(measured, clean, tried)
            except FtlmError:
                # No finite free run that far.
                continue
            if _size(there) < level:
                values, here = tried, there
                break
        else:
            break
    attempt, slopes, instruments = here
    covariance = _covariance(measured, attempt, np.linalg.pinv(instruments @ slopes.T) @ instruments)
    orders, coefficients, inputs = problem.split(values.tolist())
    levels = measured.levels(attempt)
    return replace(
        joint, orders=dict(zip(problem.orders, orders, strict=True)),
        coefficients=dict(zip(problem.coefficients, coefficients, strict=True)),
        inputs=dict(zip((item.name for item in problem.inputs), inputs, strict=True)), covariance=covariance,
        noise={o: level / w for (o, level), w in zip(levels.items(), weights, strict=True)},
        cost=float(attempt.outcome["cost"]), residuals=measured.residuals(attempt), refinement=every,
        converged=converged,
    )  # fmt: skip


def _moment(measured: Grid, clean: Grid, values: Floats) -> tuple[Attempt, Floats, Floats]:
    """Residuals and sensitivities on the measured inputs, and sensitivities on the clean ones."""
    orders, coefficients, inputs = measured.problem.split(values.tolist())
    start = Attempt(orders, coefficients, "instruments", {}, inputs)
    at = measured.descend(start, 1, plain=True)
    instruments = clean.descend(start, 1, plain=True)
    return at, np.asarray(at.outcome["jacobian"]), np.asarray(instruments.outcome["jacobian"])


def _size(moment: tuple[Attempt, Floats, Floats]) -> float:
    """What of the residuals lies in the span of the instruments."""
    attempt, _, instruments = moment
    basis = orthonormal(instruments.T, ALIKE)
    return length(projections(basis, np.asarray(attempt.outcome["residuals"])))


def _covariance(grid: Grid, attempt: Attempt, influence: Floats) -> Floats:
    """Covariance of the numbers from the influence of each residual on each."""
    series = [residuals for part in grid.residuals(attempt) for residuals in part.values()]
    return long_run(influence, series)
