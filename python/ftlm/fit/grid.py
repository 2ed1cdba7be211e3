"""Runs sampled for a joint fit, points in the space of its parameters, and the descents between them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from ftlm import _core
from ftlm.base.arrays import Floats
from ftlm.base.errors import FtlmError
from ftlm.data.run import Run
from ftlm.data.structures import Structure
from ftlm.fit.problem import FreeProblem
from ftlm.solve.records import Record, initial_tuple, record, sensor_series

#: A descent ends where a whole step would lower the cost by a smaller share than this.
TOLERANCE = 1e-9
#: Discretisation that the first fit on all samples may leave, in standard deviations of the noise.
NOTICED = 0.3
#: Finest grid: pulses a sample interval.
FINEST = 16


def experiment(
    run: Run, problem: FreeProblem, weights: Sequence[float], *, every: int = 1, decimation: int = 1
) -> tuple[Any, ...]:
    """A run as the core compares with it: ``every`` pulses a sample interval, each ``decimation``-th sample."""
    # Free delays are the core's to apply, to inputs as they were given.
    structure = replace(problem.structure, free_delays={})
    rows = (run.length - 1) // decimation * decimation + 1
    if rows != run.length:
        run = run.slice(None, rows * run.step - run.step / 2)
    intervals = (rows - 1) // decimation
    coupled = structure.coupling == "simulated"
    rec = record(run, structure, intervals * every, filtered=not coupled)
    samples = []
    for output in structure.outputs:
        measured_through = structure.sensor_filter is not None and output in structure.sensor_filter.outputs
        if rec.sensor is None or measured_through:
            samples.append(run[output][::decimation])
        else:
            # The equation is compared in filtered signals, so this output passes the filter too.
            samples.append(_core.point_samples(rec.of(output))[::every])
    filtered = None
    if coupled and structure.sensor_filter is not None:
        applies = [o in structure.sensor_filter.outputs for o in structure.outputs]
        filtered = (sensor_series(structure, rec.m, rec.step), applies)
    instants = [_instant(run, structure, rec, name, every, decimation) for name in structure.signals]
    return rec.core(), every, np.ascontiguousarray(np.stack(samples)), filtered, list(weights), instants


def _instant(
    run: Run, structure: Structure, rec: Record, name: str, every: int, decimation: int
) -> tuple[Floats | None, bool]:
    """What a signal is at the samples, after it changed there, and whether it holds in between.

    None where it has no jump or corner of its own at the samples: behind a sensor filter, or made of other signals.
    """
    measured_through = structure.sensor_filter is not None and name in structure.sensor_filter.outputs
    if name not in run or (rec.sensor is not None and not measured_through):
        return None, False
    held = name in run.inputs and run.intersample[name] == "zoh"
    values, delay = run[name], structure.delay.get(name, 0.0)
    if delay and held:
        # A command switches between samples after a delay: what it is then is the pulse that follows.
        means = rec.of(name)[::every]
        return np.append(means, means[-1]), held
    if delay:
        values = _core.delayed(values, delay / run.step, 0.0 if rec.initial == "rest" else float(values[0]))
    return np.ascontiguousarray(values[::decimation]), held


@dataclass
class Attempt:
    """A point in the space of parameters, and what the core said about it."""

    orders: list[float]
    coefficients: list[float]
    origin: str
    outcome: Any
    delays: list[float] = field(default_factory=list)

    @property
    def values(self) -> Floats:
        """Orders, coefficients, delays."""
        return np.array(self.orders + self.coefficients + self.delays)

    @property
    def level(self) -> float:
        """Cost per residual: 1 at the noise floor if the weights are right."""
        return 2.0 * float(self.outcome["cost"]) / len(self.outcome["residuals"])

    @property
    def converged(self) -> bool:
        """Whether the gradient vanished, but for what pushes out of a bound; a fit stopped at a wall has not."""
        return bool(self.outcome["status"] == "converged")


def descend(
    problem: FreeProblem, experiments: list[Any], attempt: Attempt, *, evaluations: int, plain: bool = False
) -> Attempt:
    """Levenberg-Marquardt from an attempt."""
    structure, signals = problem.structure, problem.structure.signals
    outcome = _core.output_error(
        experiments, problem.laws(signals), list(problem.bounds),
        problem.coordinates(attempt.coefficients, plain=plain), structure.coupling == "simulated",
        initial_tuple(structure.initial, structure.offset), attempt.orders, attempt.coefficients,
        [
            (signals.index(n), structure.free_delays[n], delay)
            for n, delay in zip(problem.delays, attempt.delays, strict=True)
        ],
        evaluations, TOLERANCE,
    )  # fmt: skip
    orders, coefficients, delays = (list(outcome[n]) for n in ("orders", "coefficients", "delays"))
    return Attempt(orders, coefficients, attempt.origin, outcome, delays)


@dataclass(frozen=True)
class Grid:
    """A problem on its runs, what each output weighs, pulses a sample interval, and of how many samples one counts."""

    problem: FreeProblem
    runs: Sequence[Run]
    weights: Sequence[float]
    every: int = 1
    decimation: int = 1

    @cached_property
    def experiments(self) -> list[Any]:
        """The runs as the core compares with them."""
        options = {"every": self.every, "decimation": self.decimation}
        return [experiment(run, self.problem, self.weights, **options) for run in self.runs]

    @property
    def finer(self) -> Grid:
        """The same on half the step."""
        return replace(self, every=2 * self.every)

    def descend(self, attempt: Attempt, evaluations: int, *, plain: bool = False) -> Attempt:
        """Levenberg-Marquardt from an attempt."""
        return descend(self.problem, self.experiments, attempt, evaluations=evaluations, plain=plain)

    def lowest(self, attempt: Attempt, evaluations: int) -> Attempt:
        """Descend in logarithmic coordinates, then in plain ones, which may cross zero."""
        first = self.descend(attempt, evaluations)
        second = self.descend(first, evaluations, plain=True)
        return second if second.outcome["cost"] <= first.outcome["cost"] else first

    def residuals(self, attempt: Attempt) -> list[dict[str, Floats]]:
        """Weighted residuals of an attempt by run and output."""
        residuals = np.asarray(attempt.outcome["residuals"])
        parts, at = [], 0
        for _, _, samples, *_ in self.experiments:
            compared = samples.shape[1] - 2
            part = {}
            for output in self.problem.structure.outputs:
                part[output] = residuals[at : at + compared]
                at += compared
            parts.append(part)
        return parts

    def levels(self, attempt: Attempt) -> dict[str, float]:
        """Root mean square of the weighted residuals by output, over all runs."""
        parts, outputs = self.residuals(attempt), self.problem.structure.outputs
        return {o: float(np.sqrt(np.mean(np.concatenate([p[o] for p in parts]) ** 2))) for o in outputs}

    def matters(self, attempt: Attempt) -> bool:
        """Whether halving the step moves the simulated samples by a share of their noise that the fit would notice."""
        try:
            ends = [grid.descend(attempt, 1).outcome["residuals"] for grid in (self, self.finer)]
        except FtlmError:
            # Finite on one grid and not on the other: it matters.
            return True
        moved: Floats = np.asarray(ends[1]) - np.asarray(ends[0])
        return bool(np.mean(moved**2) > NOTICED**2)

    def ranked(self, attempts: Sequence[Attempt]) -> list[Attempt]:
        """Attempts by their cost on the grid they come from or on this finer one, whichever is the larger.

        The pulse scheme of a stiff equation has a mode that alternates from pulse to pulse. A fit may use it to follow
        noise, at the cost of a free run that no other grid has.
        """

        def worse(attempt: Attempt) -> float:
            try:
                return max(attempt.level, self.descend(attempt, 1).level)
            except FtlmError:
                # It has no finite free run there.
                return math.inf

        costs = [worse(a) for a in attempts]
        if not any(map(math.isfinite, costs)):
            return sorted(attempts, key=lambda a: a.level)
        return [attempts[i] for i in sorted(range(len(attempts)), key=lambda i: (costs[i], attempts[i].level))]
