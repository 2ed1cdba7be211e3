"""Gains under other hypotheses on the start of a run: a finding where the data do not decide between them."""

from __future__ import annotations

import math
from dataclasses import replace

from ftlm.analysis.poles import steady_states
from ftlm.errors import FtlmError
from ftlm.estimation.estimators import number_covariance
from ftlm.estimation.fit import Fit
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.output_error import JointFit, fit_output_error
from ftlm.findings import Finding, make_finding
from ftlm.model.model import Estimate, Model
from ftlm.simulation.initial_conditions import rest_evidence
from ftlm.structure.structure import Initial, Offset, Structure

#: Other starts that a fit is compared with.
OTHER_STARTS: tuple[tuple[Initial, Offset], ...] = (
    ("rest", "none"),
    ("rest", "level"),
    ("caputo", "none"),
    ("caputo", "level"),
)
#: Largest ratio of the sums of squares of another start and of the one that was taken at which both explain a run.
MAX_SQUARES_RATIO = 1.05
#: Difference of two gains, in joint standard errors and relative to the larger one, from which on they contradict.
GAIN_SIGMAS, MIN_GAIN_CHANGE = 3.0, 0.05


def start_not_told_findings(fit: Fit) -> list[Finding]:
    """Return a finding if another start explains the runs as well as the one that was taken, with another gain."""
    joint, structure, runs = fit.joint, fit.task.structure, fit.task.runs
    if joint is None or structure.has_friction or structure.limits or structure.offset not in ("none", "level"):
        return []
    if all(rest_evidence(run, structure) is not None for run in runs):
        # What shows rest, or that it is assumed, is said.
        return []
    taken = joint.initial if joint.initial == "rest" else "caputo", structure.offset
    own = _gains(joint, structure)
    worst: tuple[float, Finding] | None = None
    for initial, offset in OTHER_STARTS if own else ():
        if (initial, offset) == taken:
            continue
        try:
            other = fit_output_error(runs, replace(structure, initial=initial, offset=offset), near=joint, refine=False)
        except FtlmError:
            continue
        ratio = max((other.noise[o] / noise) ** 2 for o, noise in joint.noise.items() if noise > 0.0)
        if not ratio <= MAX_SQUARES_RATIO or other.unstable_optimum is not None:
            continue
        for pair, (gain, error) in _gains(other, structure).items():
            known, own_error = own.get(pair, (math.nan, math.nan))
            distance = abs(gain - known) / max(math.hypot(error, own_error), 1e-300)
            far = abs(gain - known) > MIN_GAIN_CHANGE * max(abs(gain), abs(known))
            if far and distance > max(GAIN_SIGMAS, worst[0] if worst else 0.0):
                numbers = {"gain": known, "error": own_error, "other_gain": gain, "other_error": error}
                words = {"taken": _name_start(*taken), "other": _name_start(initial, offset), "ratio": ratio}
                about = {"run": ", ".join(r.name for r in runs), "output": pair[0], "input": pair[1]}
                worst = distance, make_finding("start_not_told", **about, **numbers, **words)
    return [worst[1]] if worst else []


def _name_start(initial: Initial, offset: Offset) -> str:
    """Name a start."""
    return ("at rest" if initial == "rest" else "in motion") + (" at a level of its own" if offset == "level" else "")


def _gains(joint: JointFit, structure: Structure) -> dict[tuple[str, str], tuple[float, float]]:
    """Return the finite steady-state gains of a fit by output and input, with their standard errors."""
    problem = FreeProblem.of(replace(structure, initial=joint.initial))
    orders, coefficients, inputs = problem.split(joint.values.tolist())
    known = (
        problem.structure.with_orders(dict(zip(problem.orders, orders, strict=True)))
        .with_coefficients(problem.coefficients_by_name(coefficients))
        .with_inputs(dict(zip(problem.names[len(orders) + len(coefficients) :], inputs, strict=True)))
    )
    estimate = Estimate("output-error", (), joint.values_by_name, covariance=number_covariance(joint, problem))
    try:
        states = steady_states(Model(known, estimate=estimate))
    except FtlmError:
        return {}
    return {(s.output, s.input): (s.gain, s.error) for s in states if s.error is not None and math.isfinite(s.gain)}
