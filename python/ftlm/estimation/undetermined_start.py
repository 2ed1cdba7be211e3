"""Refits from other initial conditions, which may explain runs as well as those that were assumed."""

from __future__ import annotations

import math
from dataclasses import replace

from ftlm.analysis.poles import steady_states
from ftlm.errors import FtlmError
from ftlm.estimation.estimators import fitted_model
from ftlm.estimation.fit import Fit
from ftlm.estimation.output_error import JointFit, fit_output_error
from ftlm.findings import Finding, make_finding
from ftlm.simulation.initial_conditions import rest_evidence
from ftlm.structure.structure import Initial, Offset, Structure

#: Initial conditions and offsets with which a fit is compared.
OTHER_STARTS: tuple[tuple[Initial, Offset], ...] = (
    ("rest", "none"),
    ("rest", "level"),
    ("caputo", "none"),
    ("caputo", "level"),
)
#: Maximum ratio of the sum of squares under other initial conditions to that of the fit at which both explain a run.
MAX_SQUARES_RATIO = 1.05
#: Difference of two gains, in joint standard errors and relative to the larger one, beyond which they contradict.
GAIN_SIGMAS, MIN_GAIN_CHANGE = 3.0, 0.05


def undetermined_start_findings(fit: Fit) -> list[Finding]:
    """Return a finding if other initial conditions explain the runs as well and give another gain."""
    joint, structure, runs = fit.joint, fit.task.structure, fit.task.runs
    if joint is None or not structure.is_linear or structure.limits or structure.offset not in ("none", "level"):
        return []
    if all(rest_evidence(run, structure) is not None for run in runs):
        # Another finding states the evidence of rest, or that rest is assumed.
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
    """Return initial conditions as text."""
    return ("at rest" if initial == "rest" else "in motion") + (" with a nonzero level" if offset == "level" else "")


def _gains(joint: JointFit, structure: Structure) -> dict[tuple[str, str], tuple[float, float]]:
    """Return the finite steady-state gains of a fit by output and input, with their standard errors."""
    try:
        states = steady_states(fitted_model(joint, structure))
    except FtlmError:
        return {}
    return {(s.output, s.input): (s.gain, s.error) for s in states if s.error is not None and math.isfinite(s.gain)}
