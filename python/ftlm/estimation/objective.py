"""Output-error objective on sampled runs: residuals, minimization and covariance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from ftlm import _core
from ftlm.data.run import Run
from ftlm.data.sampling import drop_missing
from ftlm.estimation.free_parameters import FreeProblem, sampling_spans
from ftlm.simulation.discretization import (
    Record,
    SampleTimes,
    compared_times,
    compared_values,
    has_nonuniform_samples,
    record,
    sensor_series,
    with_effective_inputs,
)
from ftlm.simulation.initial_conditions import deviations
from ftlm.structure.structure import Structure
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
) -> _core._Experiment:
    """Convert a run for the core, with `every` pulses a sample interval and each `decimation`-th sample.

    `shares` are the robust weights of the compared samples, one row an output. Missing samples have weight 0.
    """
    # What is free of inputs is the core's to apply, to inputs as they were given.
    structure = problem.structure.without_input_nonlinearities()
    if structure.offset == "level":
        run = deviations(run, structure)[0]
    rows = (run.length - 1) // decimation * decimation + 1
    if rows != run.length:
        run = run.window(None, rows * run.step - run.step / 2)
    intervals = (rows - 1) // decimation
    rec = record(run, structure, intervals * every, filtered=structure.all_filtered)
    if has_nonuniform_samples(run, problem.structure):
        return _sample_nonuniform_run(run, structure, rec, weights, decimation, shares)
    samples = []
    for output in structure.outputs:
        if rec.sensor is None or structure.is_filtered(output):
            samples.append(run[output][::decimation])
        else:
            # The equation is compared in filtered signals, so this output passes the filter too.
            samples.append(_core.point_samples(rec.of(output))[::every])
    filtered = _output_filter(structure, rec)
    instants = [_signal_at_samples(run, structure, rec, name, every, decimation) for name in structure.signals]
    measured, counted = _weighted_samples(np.stack(samples), slice(1, -1), shares)
    return {
        "record": rec.core_with_transients(),
        "pulses_per_sample": every,
        "samples": measured,
        "filter": filtered,
        "weights": list(weights),
        "signals": instants,
        "robust_weights": counted,
        "sample_times": None,
    }


def _sample_nonuniform_run(
    run: Run, structure: Structure, rec: Record, weights: Sequence[float], decimation: int, shares: Floats | None
) -> _core._Experiment:
    """Convert a run with nonuniform sample times. The first sample only gives the initial value."""
    times = compared_times(run, structure)
    kept = np.flatnonzero(times > 0.0)[::decimation]
    at = SampleTimes.of(run, rec, structure, times[kept])
    measured, counted = _weighted_samples(
        np.stack([compared_values(run, structure, o)[kept] for o in structure.outputs]), slice(None), shares
    )
    filtered = _output_filter(structure, rec)
    signals = [at.values(name) for name in structure.signals]
    # What was not read everywhere drives nothing.
    instants = [(None if v is None or np.isnan(v).any() else v, False) for v in signals]
    own = (at.pulse_positions, [at.jumps(name) for name in structure.signals])
    return {
        "record": rec.core_with_transients(),
        "pulses_per_sample": 1,
        "samples": measured,
        "filter": filtered,
        "weights": list(weights),
        "signals": instants,
        "robust_weights": counted,
        "sample_times": own,
    }


def _output_filter(structure: Structure, rec: Record) -> tuple[Floats, list[bool]] | None:
    """Return the sensor filter of the simulated outputs, or None if all signals are filtered already."""
    series = None if rec.sensor is not None else sensor_series(structure, rec.m, rec.step)
    return None if series is None else (series, [structure.is_filtered(o) for o in structure.outputs])


def _weighted_samples(samples: Floats, compared: slice, shares: Floats | None) -> tuple[Floats, Floats | None]:
    """Return samples without gaps, and the weights of the compared samples; None if all weights are 1."""
    unread = np.isnan(samples)
    counted = shares
    if unread.any():
        known = np.where(unread[:, compared], 0.0, 1.0)
        counted = np.ascontiguousarray(known if shares is None else known * shares)
    return np.ascontiguousarray(np.where(unread, 0.0, samples)), counted


def _signal_at_samples(
    run: Run, structure: Structure, rec: Record, name: str, every: int, decimation: int
) -> tuple[Floats | None, bool]:
    """Return a signal at the sample times, after any jump there, and whether it is held between samples.

    None if the signal has no jump or slope discontinuity at the samples (behind a sensor filter, or computed from other
    signals), and if it has missing samples.
    """
    if name not in run or name in run.missing_samples or (rec.sensor is not None and not structure.is_filtered(name)):
        return None, False
    held = name in run.inputs and run.intersample[name] == "zoh"
    values, delay = with_effective_inputs(run, structure, name)[name], structure.delay.get(name, 0.0)
    if delay and held:
        # A command switches between samples after a delay: what it is then is the pulse that follows.
        means = rec.of(name)[::every]
        return np.append(means, means[-1]), held
    if delay:
        values = _core.delay_samples(values, delay / run.step, 0.0 if rec.initial == "rest" else float(values[0]))
    return np.ascontiguousarray(values[::decimation]), held


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
    experiments: list[Any],
    attempt: Iterate,
    *,
    evaluations: int,
    plain: bool = False,
    held: int | Sequence[int] = (),
    tolerance: float = COST_REDUCTION_TOLERANCE,
    steady: bool = False,
) -> Iterate:
    """Minimize the cost by Levenberg-Marquardt; parameters with an index in `held` stay fixed.

    With `steady`, no step leads from a stable model to an unstable one. Initial states of bodies with friction are not
    projected out and continue from the last values.
    """
    states = attempt.outcome.get("states", []) if isinstance(attempt.outcome, dict) else []
    outcome = problem.core.minimize(
        experiments,
        (attempt.values.tolist(), states),
        plain,
        (held,) if isinstance(held, int) else held,
        evaluations,
        tolerance,
        steady,
        stop_flag(),
    )
    orders, coefficients, inputs = problem.split(outcome["values"])
    return replace(attempt, orders=orders, coefficients=coefficients, inputs=inputs, outcome=outcome)


@dataclass(frozen=True)
class Objective:
    """Output-error objective on sampled runs: problem, output weights, pulses a sample, decimation.

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

    @cached_property
    def experiments(self) -> list[Any]:
        """Runs in the form that the core compares with."""
        return [
            sample_run(
                run,
                self.problem,
                self.weights,
                every=self.every,
                decimation=self.decimation,
                shares=None if self.robust_weights is None else self.robust_weights[k],
            )
            for k, run in enumerate(self.runs)
        ]

    @cached_property
    def finer(self) -> Objective:
        """The same objective with half the step."""
        return replace(self, every=2 * self.every)

    def minimize(
        self,
        attempt: Iterate,
        evaluations: int,
        *,
        plain: bool = False,
        held: int | Sequence[int] = (),
        tolerance: float = COST_REDUCTION_TOLERANCE,
    ) -> Iterate:
        """Minimize the cost by Levenberg-Marquardt; see :func:`minimize_cost`."""
        return minimize_cost(
            self.problem,
            self.experiments,
            attempt,
            evaluations=evaluations,
            plain=plain,
            held=held,
            tolerance=tolerance,
            steady=self.prefer_stable,
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
        return [
            (e["robust_weights"], e["samples"].shape[1] - (2 if e["sample_times"] is None else 0))
            for e in self.experiments
        ]

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


@dataclass(frozen=True)
class RunSampler:
    """Converter of the runs of a joint fit to the forms that the core requests.

    The core calls these methods on the thread that called it.
    """

    problem: FreeProblem
    runs: Sequence[Run]

    def sample(self, every: int, decimation: int, first: int | None) -> list[Any]:
        """Return the runs with `every` block pulses a sample interval, decimated by `decimation`.

        With `first`, only the first `first` sample intervals of each run are used.
        """
        weights = [1.0] * len(self.problem.structure.outputs)
        runs = self.runs if first is None else [run.window(None, (first + 0.5) * run.step) for run in self.runs]
        return [sample_run(run, self.problem, weights, every=every, decimation=decimation) for run in runs]

    def records(self, m: int, inputs: Sequence[float]) -> list[Any]:
        """Return block-pulse records with `m` pulses, measured inputs and given input parameters."""
        names = (item.name for item in self.problem.inputs)
        structure = self.problem.structure.with_inputs(dict(zip(names, inputs, strict=True)))
        structure = replace(structure, coupling="measured")
        return [record(run, structure, m).core() for run in self.runs]

    def read(self, signal: int) -> list[Floats]:
        """Return one signal of each run at regular sample times; missing samples are NaN."""
        name, structure = self.problem.structure.signals[signal], self.problem.structure
        if structure.offset == "level":
            return [np.ascontiguousarray(deviations(run, structure)[0][name]) for run in self.runs]
        return [np.ascontiguousarray(run[name]) for run in self.runs]

    def core_arguments(self, told: Callable[[int, int], None] | None = None) -> tuple[Any, ...]:
        """Return this object, sampling spans, intersample behavior of each signal, progress callback."""

        def intersample_kind(name: str) -> str | None:
            if name not in self.runs[0].inputs:
                return None
            return "zoh" if any(run.intersample.get(name) == "zoh" for run in self.runs) else "foh"

        return (
            self,
            sampling_spans(self.runs),
            [intersample_kind(name) for name in self.problem.structure.signals],
            told,
        )


def covariance(attempt: Iterate, grid: Objective) -> Floats:
    """Return the covariance of the parameters, robust to autocorrelation if residuals are not white.

    Nothing is truncated: a parameter in a direction that the data do not determine has infinite variance. Under a
    robust loss the covariance is that of an M-estimator.
    """
    series = [residuals for part in grid.residuals(attempt) for residuals in part.values()]
    shares = None if grid.robust_weights is None else grid.residual_weights
    return _core.fit_covariance(np.asarray(attempt.outcome["jacobian"]), series, shares)


def covariance_of(jacobian: Floats, series: Sequence[Floats], squares: float) -> Floats:
    """Return the covariance from a Jacobian (row a parameter), residual series and their sum of squares.

    Missing residuals are NaN. Covariances with a parameter of infinite variance are NaN.
    """
    return _core.covariance_of(jacobian, series, squares)


def propagated_errors(slopes: Floats, spread: Floats) -> Floats:
    """Return standard errors by first-order propagation, infinite if a variance involved is infinite."""
    unseen = np.isinf(np.diag(spread))
    known = slopes[:, ~unseen]
    variance = np.einsum("ij,jk,ik->i", known, spread[np.ix_(~unseen, ~unseen)], known)
    return np.where((slopes[:, unseen] != 0).any(axis=1), np.inf, np.sqrt(np.maximum(variance, 0.0)))
