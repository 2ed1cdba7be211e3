"""What makes an identified model doubtful, in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ftlm import _core
from ftlm.base.arrays import Floats
from ftlm.base.statistics import is_white
from ftlm.data.advice import excitation_for
from ftlm.data.run import Run
from ftlm.data.structures import Structure, delay_name
from ftlm.fit.joint import JointFit
from ftlm.fit.problem import FreeProblem
from ftlm.identification.judged import Judged
from ftlm.judge.comparison import Comparison, compare, validation_warnings
from ftlm.model.model import Model

#: Two parameters more correlated than this cannot be told apart where neither is known by itself.
INSEPARABLE = 0.995
#: A coefficient or delay is not known by itself where its standard error exceeds this share of its value, an order
#: where it exceeds this much. However correlated two numbers are, both are usable if each is within a tenth: then its
#: 95 % interval spans less than half its value, and an order's less than the steps of 0.5 in which mechanisms differ.
VAGUE = 0.1
#: Two coefficients further apart than this share do not obey the coefficient law.
LAW_BROKEN = 0.05


def uncertain(joint: JointFit, problem: FreeProblem) -> list[str]:
    """Say what the runs cannot tell."""
    warnings = []
    if not joint.converged:
        warnings.append("the fit ended before it stood still; its figures are provisional")
    if not joint.settled:
        warnings.append(
            f"at {joint.refinement} pulses a sample the step still moves estimates by over a tenth of their standard "
            "errors: the model is stiffer than the sampling; sample faster or trust its fast poles less"
        )
    errors = joint.standard_errors
    unseen = [n for n in joint.names if math.isinf(errors[n])]
    if unseen:
        warnings.append(
            f"these runs do not tell {', '.join(unseen)} apart: moved together they change nothing that was measured, "
            "so their intervals are infinite; leave a term out, fix one of them, or record a richer input"
        )
    for (name, value), (low, high) in zip(joint.orders.items(), problem.bounds, strict=True):
        # Negated so that a standard error that is not a number counts as too large.
        if name in unseen:
            continue
        if not errors[name] <= high - low:
            warnings.append(f"order {name} cannot be told from these runs: its standard error exceeds its bounds")
        elif min(value - low, high - value) < 1e-6 and high > low and value != 0:
            warnings.append(f"order {name} = {value:g} is on its bound; widen it")
    for signal, value in joint.delays.items():
        low, high = problem.structure.free_delays[signal]
        if delay_name(signal) in unseen:
            continue
        if not errors[delay_name(signal)] <= high - low:
            warnings.append(
                f"the delay of {signal} cannot be told from these runs: its standard error exceeds its bounds"
            )
        elif high - value < 1e-6 * (high - low) or (low > 0 and value - low < 1e-6 * (high - low)):
            warnings.append(f"the delay of {signal} = {value:g} s is on its bound; widen it")
    for name, value in joint.coefficients.items():
        if name not in unseen and not errors[name] <= abs(value):
            warnings.append(
                f"coefficient {name} = {value:.4g} is not different from 0 in these runs "
                f"(standard error {errors[name]:.3g})"
            )
    warnings += inseparable(joint)
    coloured = sorted({o for run in joint.residuals for o, series in run.items() if not is_white(series)})
    if coloured:
        warnings.append(
            f"residuals of {', '.join(coloured)} are not white: the model leaves something out; "
            "standard errors allow for the colour, not for the bias of what is left out"
        )
    return warnings


def inseparable(joint: JointFit) -> list[str]:
    """Say which numbers trade for each other, a line a group: correlated, and none of them known by itself."""
    errors, correlation = joint.standard_errors, np.abs(joint.correlation)
    sizes = {n: abs(v) for n, v in zip(joint.names, joint.values.tolist(), strict=True)}
    # Negated so that a standard error that is not a number counts as too large.
    vague = [i for i, n in enumerate(joint.names) if not errors[n] <= VAGUE * (1.0 if n in joint.orders else sizes[n])]
    groups: list[list[int]] = []
    for i in vague:
        tied = [g for g in groups if any(_trade(joint, correlation, i, j) for j in g)]
        groups = [g for g in groups if g not in tied] + [sorted([*(j for g in tied for j in g), i])]
    said = []
    for group in (g for g in groups if len(g) > 1):
        *most, last = (joint.names[i] for i in group)
        known = [c for i in group for j in group if i < j and math.isfinite(c := float(correlation[i, j]))]
        of = "correlation" if len(group) == 2 else "correlations up to"
        why = f"{of} {max(known):.4f}" if known else "their standard errors are not finite"
        said.append(f"{', '.join(most)} and {last} cannot be told apart in these runs ({why})")
    return said


def _trade(joint: JointFit, correlation: Floats, i: int, j: int) -> bool:
    """Whether two vague numbers move together; those without a finite error do, whatever their correlation."""
    errors = joint.standard_errors
    if not any(math.isfinite(errors[joint.names[k]]) for k in (i, j)):
        return True
    return bool(correlation[i, j] > INSEPARABLE)


def unexcited(runs: Sequence[Run], structure: Structure) -> list[str]:
    """Say so where no run alone has inputs rich enough for the free numbers of an equation."""
    lacking = [{f.signal: f.sentence for f in excitation_for(run, structure)} for run in runs]
    return [sentence for output, sentence in lacking[0].items() if all(output in other for other in lacking)]


def broken_law(model: Model) -> list[str]:
    """Distance of freely estimated coefficients from the coefficient law, in words."""
    law, values = model.structure.coefficient_law, model.coefficients
    warnings = []
    for name, sign, factors in law:
        known = [values[f] for f in factors if f in values]
        if name not in values or len(known) != len(factors):
            continue
        wanted = sign * math.prod(known)
        if abs(values[name] - wanted) > LAW_BROKEN * max(abs(wanted), abs(values[name])):
            warnings.append(
                f"coefficient law: {name} = {values[name]:.4g}, but the other equation gives {wanted:.4g}; "
                "the equation-error estimators do not impose the law"
            )
    ratios: dict[str, list[tuple[str, float]]] = {}
    for name, sign, factors in law:
        free = [f for f in factors if f not in values]
        known = [values[f] for f in factors if f in values]
        rest = math.prod(known)
        if name in values and len(free) == 1 and known and rest:
            ratios.setdefault(free[0], []).append((name, sign * values[name] / rest))
    for ratio, said in ratios.items():
        wrong = [(n, v) for n, v in said if not v > 1]
        if wrong:
            listed = ", ".join(f"{v:.4g} by {n}" for n, v in wrong)
            warnings.append(f"coefficient law: the inertia ratio {ratio} must exceed 1, but is {listed}")
    return warnings


def discretisation(model: Model, comparison: Comparison) -> list[str]:
    """Warn where the block-pulse scheme itself is unstable at this number of pulses.

    An own-output order alpha - nu > 1 of a stiff equation gives the scheme a mode at its Nyquist frequency that the
    model does not have.
    """
    warnings = []
    for item in model.equations:
        own = [
            (float(t.fixed or 0.0), item.order.constant - t.order.constant)
            for t in item.terms
            if t.signal == item.output
        ]
        margin = min(_core.nyquist_margin(own, step) for step in comparison.step)
        if margin <= 0:
            warnings.append(
                f"{item.output}: at {comparison.m} pulses the discretisation itself is unstable (margin {margin:.2g}), "
                "whether or not the model is; raise m"
            )
    return warnings


def growing(model: Model) -> list[str]:
    """Warn of poles with a positive real part: within one run the input may hide what they do, later nothing does."""
    verdict = model.stability(coupling=model.structure.coupling)
    if not verdict.unstable_poles > 0:
        return []
    return [f"the model is {verdict}: its free run grows without bound, however well it fits a run of this length"]


def validate(result: Judged, runs: Run | Sequence[Run]) -> Comparison:
    """Both errors on other runs, with what they say against the model; see :meth:`ftlm.Identification.validate`."""
    there = compare(result.model, runs)
    words = [*there.warnings, *validation_warnings(result.comparison, there), *discretisation(result.model, there)]
    return replace(there, warnings=tuple(dict.fromkeys(words)))
