"""Refits under other assumptions: initial conditions, a drifting level, and the hold of inputs between samples."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ftlm.analysis.poles import steady_states
from ftlm.data.run import Run
from ftlm.data.sampling import ZERO_ORDER_HOLD, Intersample, drop_missing
from ftlm.errors import FtlmError
from ftlm.estimation.estimators import fitted_model
from ftlm.estimation.fit import Fit
from ftlm.estimation.nuisance_parameters import fit_score
from ftlm.estimation.output_error import JointFit, fit_output_error
from ftlm.findings import Finding, make_finding
from ftlm.simulation.initial_conditions import START_SETTINGS, rest_evidence
from ftlm.structure.structure import Initial, Offset, Structure

#: Initial conditions and offsets with which a fit is compared.
OTHER_STARTS: tuple[tuple[Initial, Offset], ...] = (
    ("rest", "none"),
    ("rest", "level"),
    ("caputo", "none"),
    ("caputo", "level"),
)
#: Offsets without and with a linear trend.
DRIFT_OFFSETS: tuple[Offset, Offset] = ("constant", "ramp")
#: Maximum ratio of the sum of squares under other initial conditions to that of the fit at which both explain a run.
MAX_SQUARES_RATIO = 1.05
#: Difference of two gains, in joint standard errors and relative to the larger one, beyond which they contradict.
GAIN_SIGMAS, MIN_GAIN_CHANGE = 3.0, 0.05
#: Least share of rows in which an input changes, so that its behavior between samples is in doubt.
MIN_CHANGING_SHARE = 0.5
_BETWEEN_SAMPLES: dict[Intersample, str] = {"zoh": "constant", "foh": "linear"}


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


def intersample_findings(fit: Fit) -> list[Finding]:
    """Return a finding on each input for which the runs clearly prefer the other hold, zero-order or first-order.

    Samples alone do not distinguish a staircase from a smooth signal. The wrong hold acts like a delay of half a
    sample, which biases the parameters. For each input that changes in most rows, the model is refitted with the other
    hold.
    """
    joint, structure, runs = fit.joint, fit.task.structure, fit.task.runs
    if joint is None or structure.has_friction or structure.limits:
        return []
    findings = []
    for name in runs[0].inputs:
        if name not in structure.signals or not _changes_often(runs, name):
            continue
        other: Intersample = "foh" if runs[0].intersample[name] == ZERO_ORDER_HOLD else "zoh"
        changed = tuple(run.with_intersample({name: other}) for run in runs)
        try:
            refit = fit_output_error(changed, replace(structure, initial=joint.initial), near=joint, refine=False)
        except FtlmError:
            continue
        if refit.unstable_optimum is not None:
            continue
        if not fit_score(refit, joint) + START_SETTINGS.history_margin < fit_score(joint, joint):
            continue
        numbers = _largest_change(joint, refit)
        if numbers is None:
            continue
        words = {"taken": _BETWEEN_SAMPLES[runs[0].intersample[name]], "other": _BETWEEN_SAMPLES[other]}
        about = {"run": ", ".join(r.name for r in runs), "input": name, "kind": other}
        findings.append(make_finding("other_intersample_fits", **about, **numbers, **words))
    return findings


def drift_findings(fit: Fit) -> list[Finding]:
    """Return a finding if the runs clearly prefer a linear trend of the outputs over constant levels."""
    joint, structure, runs = fit.joint, fit.task.structure, fit.task.runs
    if joint is None or not structure.is_linear or structure.limits or structure.offset not in ("none", "level"):
        return []
    asked = replace(structure, initial=joint.initial)
    try:
        constant, line = (
            fit_output_error(runs, replace(asked, offset=offset), near=joint, refine=False) for offset in DRIFT_OFFSETS
        )
    except FtlmError:
        return []
    numbers, score = _largest_change(joint, line), fit_score(line, joint)
    preferred = score < fit_score(constant, joint)
    if numbers is None or not (preferred and score + START_SETTINGS.history_margin < fit_score(joint, joint)):
        return []
    about = {"run": ", ".join(r.name for r in runs), "output": ", ".join(structure.outputs)}
    return [make_finding("drift_fits", **about, **numbers)]


def _largest_change(joint: JointFit, refit: JointFit) -> dict[str, Any] | None:
    """Return the ratio of the sums of squares of two fits, and the parameter that differs most in standard errors.

    None if no parameter differs by more than one standard error.
    """
    ratio = min((refit.noise[o] / noise) ** 2 for o, noise in joint.noise.items() if noise > 0.0)
    values, errors, others = joint.values_by_name, joint.standard_errors, refit.values_by_name
    moves = {n: abs(others[n] - values[n]) / e for n, e in errors.items() if e > 0.0 and n in others}
    if not moves or not max(moves.values()) > 1.0:
        return None
    most = max(moves, key=lambda n: moves[n])
    known = {"value": values[most], "error": errors[most], "other_value": others[most]}
    return {"parameter": most, "ratio": ratio, **known}


def _changes_often(runs: Sequence[Run], name: str) -> bool:
    """Whether an input changes in most rows of the runs."""
    steps = np.concatenate([np.diff(drop_missing(run[name])) for run in runs])
    return bool(np.count_nonzero(steps) > MIN_CHANGING_SHARE * steps.size)


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
