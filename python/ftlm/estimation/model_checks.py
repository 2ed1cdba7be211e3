"""Checks of an identified model: identifiability, bounds, residuals, excitation and stability."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ftlm import _core
from ftlm.data.run import Run
from ftlm.data.sampling import drop_missing
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.output_error import OUTLIER_DEVIATIONS, JointFit
from ftlm.estimation.result import Identification
from ftlm.model.model import Model
from ftlm.simulation.discretization import compared_values, has_nonuniform_samples
from ftlm.simulation.output_samples import OutputSamples
from ftlm.structure.structure import Structure
from ftlm.utils.linalg import dot
from ftlm.utils.parameters import parameter
from ftlm.utils.statistics import NEGLIGIBLE_RESIDUAL_SHARE, is_white, robust_deviation
from ftlm.utils.validation import Floats
from ftlm.validation.comparison import Comparison, compare, validation_warnings
from ftlm.validation.data_advice import check_excitation, find_dead_channel

#: Largest correlation of two separately identifiable parameters, unless one of them is well determined.
MAX_PARAMETER_CORRELATION = 0.995
#: Largest relative standard error of a well-determined coefficient or delay, and largest standard error of an order.
#: Its 95 % interval then spans less than half its value, or less than the increment of 0.5 between common mechanisms.
MAX_RELATIVE_STANDARD_ERROR = 0.1
#: Outliers are reported from this number and this fraction of all residuals, or if they hold this fraction of the
#: squares, which doubles the variance of every parameter.
MIN_OUTLIERS = 3
MIN_OUTLIER_FRACTION = 2e-3
MIN_OUTLIER_POWER_FRACTION = 0.5
#: Quantization step in noise standard deviations above which residuals are dominated by rounding.
QUANTIZATION_NOISE_RATIO = 2.0
#: Largest deviation of a value from a multiple of the quantization step, as a fraction of the step.
QUANTIZATION_STEP_TOLERANCE = 0.01
#: Smallest change within a sample that counts as motion, as a fraction of the range of the output.
MIN_MOTION_RANGE_FRACTION = 1e-6
#: Fewest intervals at less than SLOW_SPEED_RATIO times vs that determine the Stribeck term.
MIN_SLOW_INTERVALS, SLOW_SPEED_RATIO = 5, 2.0
#: Largest relative deviation of two coefficients from the coefficient law.
MAX_LAW_DEVIATION = 0.05


def identifiability_warnings(joint: JointFit, problem: FreeProblem) -> list[str]:
    """Return warnings about convergence and about parameters that the runs do not determine."""
    warnings = []
    if not joint.converged:
        warnings.append("the fit ended before it stood still; its figures are provisional")
    if not joint.step_converged:
        warnings.append(
            f"at {joint.refinement} pulses a sample the step still moves estimates by over a tenth of their standard "
            "errors: the model is stiffer than the sampling; sample faster or trust its fast poles less"
        )
    warnings += _unstable_optimum_warnings(joint)
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
        if not errors[name] <= high - low and not _has_bounded_interval(joint, name):
            warnings.append(f"order {name} cannot be told from these runs: its standard error exceeds its bounds")
        elif min(value - low, high - value) < 1e-6 and high > low and value != 0:
            warnings.append(f"order {name} = {value:g} is on its bound; widen it")
    for item in problem.inputs:
        value, (low, high) = joint.inputs[item.name], item.bounds
        if item.name in unseen:
            continue
        if not errors[item.name] <= high - low and not _has_bounded_interval(joint, item.name):
            warnings.append(f"the {item.words} cannot be told from these runs: its standard error exceeds its bounds")
        elif high - value < 1e-6 * (high - low) or (low > 0 and value - low < 1e-6 * (high - low)):
            unit = " s" if item.law == "delay" else ""
            warnings.append(f"the {item.words} = {value:g}{unit} is on its bound; widen it")
    for name, value in joint.coefficients.items():
        # Where the cost is no parabola, its profile knows better.
        told = name in joint.profiles and 0.0 not in joint.profiles[name]
        if name not in unseen and not errors[name] <= abs(value) and not told:
            warnings.append(
                f"coefficient {name} = {value:.4g} is not different from 0 in these runs "
                f"(standard error {errors[name]:.3g})"
            )
    warnings += correlation_warnings(joint) + unbounded_interval_warnings(joint, unseen)
    coloured = sorted({o for run in joint.residuals for o, series in run.items() if not is_white(series)})
    if coloured:
        warnings.append(
            f"residuals of {', '.join(coloured)} are not white: the model leaves something out; "
            "standard errors allow for the colour, not for the bias of what is left out"
        )
    return warnings


def _unstable_optimum_warnings(joint: JointFit) -> list[str]:
    """Return warnings about an unstable optimum and the choice made."""
    if joint.unstable_optimum is None or joint.unstable_optimum.residual_excess <= 0.0:
        # One that costs more than the stable one was none.
        return []
    excess = 100.0 * joint.unstable_optimum.residual_excess
    if not joint.unstable_optimum.is_accepted:
        limit = joint.unstable_optimum.at_stability_limit
        smaller = 100.0 * (1.0 - 1.0 / (1.0 + joint.unstable_optimum.residual_excess))
        return [
            f"an optimum that is not stable has residuals {smaller:.2g} % smaller, by no more than chance: what the "
            "run did before its start takes a growing mode away until its end; the stable one was kept"
            + (", which stands where free runs begin to grow: the runs do not tell its damping" if limit else "")
        ]
    if not math.isfinite(excess):
        return ["no stable optimum was found beside this one, whose free run grows"]
    return [
        f"the free run of this optimum grows; the best stable one found has residuals {excess:.2g} % larger, which the "
        "runs refuse at 99 %: an unstable machine in a closed loop, or a term that is missing"
    ]


def _has_bounded_interval(joint: JointFit, name: str) -> bool:
    """Whether the profile-likelihood interval of a parameter is bounded on both sides."""
    return name in joint.profiles and not joint.profiles[name].is_open


def unbounded_interval_warnings(joint: JointFit, unseen: Sequence[str]) -> list[str]:
    """Return a warning about parameters with an unbounded interval."""
    sides = {
        n: [s for s, end in (("below", p.low), ("above", p.high)) if math.isinf(end)]
        for n, p in joint.profiles.items()
        if n not in unseen
    }
    # An order that ends at 0 has nothing below it.
    words = [f"{n} {' or '.join(s)}" for n, s in sides.items() if s and (s != ["below"] or joint.orders.get(n) != 0.0)]
    if not words:
        return []
    return [
        f"these runs do not bound {', '.join(words)}: with all other numbers fitted anew the cost never rises by what "
        "noise explains; fix a number, leave a term out, or record a richer input"
    ]


def sample_warnings(runs: Sequence[Run], joint: JointFit, problem: FreeProblem) -> list[str]:
    """Return warnings about outliers, quantization and interpolated nonuniform samples."""
    warnings = []
    for output in problem.structure.outputs:
        size = math.sqrt(float(np.mean([np.nanvar(run[output]) for run in runs])))
        noise = joint.noise[output]
        if noise <= NEGLIGIBLE_RESIDUAL_SHARE * size:
            continue
        warnings += [
            w
            for w in (
                _outlier_warning(runs, joint, output),
                _quantization_warning(runs, problem.structure, output, noise),
            )
            if w
        ]
    kept = [
        run.name for run in runs if run.sample_times is not None and not has_nonuniform_samples(run, problem.structure)
    ]
    if kept:
        warnings.append(
            f"{', '.join(kept)}: outputs were read at times of their own, but a free delay, or signals taken "
            "behind a sensor filter, need them on a grid: straight lines were drawn between them, and the intervals do "
            "not know what that costs"
        )
    return warnings


def _outlier_warning(runs: Sequence[Run], joint: JointFit, output: str) -> str | None:
    """Return a warning about outliers, unless a robust loss was used."""
    if joint.robust is not None:
        return None
    every = drop_missing(np.concatenate([part[output] for part in joint.residuals]))
    usual = robust_deviation(every)
    far, first = 0, ""
    for run, part in zip(runs, joint.residuals, strict=True):
        rows = np.flatnonzero(np.abs(part[output]) > OUTLIER_DEVIATIONS * usual)
        if rows.size and not far:
            # Compared rows begin behind the first one.
            first = f"first at row {int(rows[0]) + 1} of {run.name}"
        far += rows.size
    count = every.size
    share = float(np.sum(every[np.abs(every) > OUTLIER_DEVIATIONS * usual] ** 2) / max(dot(every, every), 1e-300))
    if usual == 0.0 or (share < MIN_OUTLIER_POWER_FRACTION and far < max(MIN_OUTLIERS, MIN_OUTLIER_FRACTION * count)):
        return None
    verb, held = ("lies", "holds") if far == 1 else ("lie", "hold")
    power = f" and {held} {100 * share:.0f} % of their squares" if share >= MIN_OUTLIER_POWER_FRACTION else ""
    return (
        f"{far} of {count} residuals of {output} {verb} beyond {OUTLIER_DEVIATIONS:g} times the usual one{power}, "
        f"{first}: {'an outlier' if far == 1 else 'outliers'}, or moments that the model does not explain; squares "
        f"let them cost precision: {parameter('loss', 'huber')} weighs them down"
    )


def _quantization_warning(runs: Sequence[Run], structure: Structure, output: str, noise: float) -> str | None:
    """Return a warning about an output whose quantization step exceeds its noise."""
    steps = [quantization_step(drop_missing(compared_values(run, structure, output))) for run in runs]
    coarse = [(step, run) for step, run in zip(steps, runs, strict=True) if step > QUANTIZATION_NOISE_RATIO * noise]
    if not coarse:
        return None
    step, run = max(coarse, key=lambda pair: pair[0])
    return (
        f"{output} is quantised in steps of {step:.3g} in {run.name}, and its residuals are {noise:.3g}: rounding, "
        "which repeats where the signal does and is no noise; intervals do not allow for it; use a finer converter or "
        "scale"
    )


def quantization_step(values: Floats) -> float:
    """Return the step of which all values are multiples; 0 if there is none."""
    levels = np.unique(values)
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-9 * max(float(np.abs(levels).max()), float(np.ptp(levels)))] if gaps.size else gaps
    if gaps.size == 0:
        return 0.0
    # Rounding apart, the least gap is the step; the mean of those close to it tells it better.
    step = float(np.mean(gaps[gaps < 1.5 * gaps.min()]))
    multiples = gaps / step
    return step if float(np.abs(multiples - np.rint(multiples)).max()) < QUANTIZATION_STEP_TOLERANCE else 0.0


def correlation_warnings(joint: JointFit) -> list[str]:
    """Return warnings about groups of parameters that are not separately identifiable, one line a group."""
    errors, correlation = joint.standard_errors, np.abs(joint.correlation)
    sizes = {n: abs(v) for n, v in zip(joint.names, joint.values.tolist(), strict=True)}
    # Negated so that a standard error that is not a number counts as too large.
    vague = [
        i
        for i, n in enumerate(joint.names)
        if not errors[n] <= MAX_RELATIVE_STANDARD_ERROR * (1.0 if n in joint.orders else sizes[n])
    ]
    groups: list[list[int]] = []
    for i in vague:
        tied = [g for g in groups if any(_are_inseparable(joint, correlation, i, j) for j in g)]
        groups = [g for g in groups if g not in tied] + [sorted([*(j for g in tied for j in g), i])]
    said = []
    for group in (g for g in groups if len(g) > 1):
        *most, last = (joint.names[i] for i in group)
        known = [c for i in group for j in group if i < j and math.isfinite(c := float(correlation[i, j]))]
        of = "correlation" if len(group) == 2 else "correlations up to"
        why = f"{of} {max(known):.4f}" if known else "their standard errors are not finite"
        said.append(f"{', '.join(most)} and {last} cannot be told apart in these runs ({why})")
    return said


def _are_inseparable(joint: JointFit, correlation: Floats, i: int, j: int) -> bool:
    """Whether two uncertain parameters are correlated, or both have an infinite standard error."""
    errors = joint.standard_errors
    if not any(math.isfinite(errors[joint.names[k]]) for k in (i, j)):
        return True
    return bool(correlation[i, j] > MAX_PARAMETER_CORRELATION)


def excitation_warnings(runs: Sequence[Run], structure: Structure) -> list[str]:
    """Return warnings about equations whose free parameters no run excites."""
    lacking = [{f.signal: f.sentence for f in check_excitation(run, structure)} for run in runs]
    return [sentence for output, sentence in lacking[0].items() if all(output in other for other in lacking)]


def dead_channel_warnings(runs: Sequence[Run], structure: Structure) -> list[str]:
    """Return warnings about measured channels that are dead, which a fit would take for motion."""
    channels = [(r.with_interpolated_gaps(), n) for r in runs for n in r.outputs if n in structure.signals]
    return [f"run {run.name}: {found.sentence}" for run, name in channels for found in find_dead_channel(run, name)]


def coefficient_law_warnings(model: Model) -> list[str]:
    """Return warnings about freely estimated coefficients that violate the coefficient law."""
    law, values = model.structure.coefficient_law, model.coefficients
    warnings = []
    for name, sign, factors in law:
        known = [values[f] for f in factors if f in values]
        if name not in values or len(known) != len(factors):
            continue
        wanted = sign * math.prod(known)
        if abs(values[name] - wanted) > MAX_LAW_DEVIATION * max(abs(wanted), abs(values[name])):
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


def discretization_warnings(model: Model, comparison: Comparison) -> list[str]:
    """Return warnings if the block-pulse scheme itself is unstable with this number of pulses.

    A stiff equation with alpha - nu > 1 for an own term gives the scheme a mode at its Nyquist frequency that the model
    does not have.
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


def friction_direction_warnings(model: Model, free: Sequence[OutputSamples]) -> list[str]:
    """Return warnings if friction and an offset are collinear (sliding in one direction only)."""
    if not model.structure.has_friction or model.structure.offset == "none":
        return []

    def turns(samples: Floats) -> bool:
        moved, least = np.diff(samples), MIN_MOTION_RANGE_FRACTION * float(np.ptp(samples))
        return bool(np.any(moved > least) and np.any(moved < -least))

    return [
        f"the velocity of {model.outputs[i]} never changes its sign in a run: while it slides, friction is a constant "
        "like the offset, and only the rests tell them apart; add a run that moves both ways, or use "
        f"{parameter('offset', 'none')}"
        for i in model.structure.friction_equations
        if not any(turns(run.outputs[i]) for run in free)
    ]


def stribeck_warnings(model: Model, runs: Sequence[Run], free: Sequence[OutputSamples]) -> list[str]:
    """Return warnings if no run distinguishes the friction near rest from that at speed."""
    said = []
    for item in model.equations:
        near = None if item.friction is None else item.friction.stribeck
        if near is None or (near.name is None and near.speed_name is None):
            continue
        vs, column = float(near.speed), model.outputs.index(item.output)
        paces = [np.abs(np.diff(there.outputs[column])) / run.step for run, there in zip(runs, free, strict=True)]
        pace = np.concatenate([p[p > MIN_MOTION_RANGE_FRACTION * p.max(initial=0.0)] for p in paces])
        slow = int(np.sum(pace < SLOW_SPEED_RATIO * vs))
        if slow < MIN_SLOW_INTERVALS:
            said.append(
                f"{item.output} moves at less than {SLOW_SPEED_RATIO:g} vs = {SLOW_SPEED_RATIO * vs:.3g} per s in "
                f"{slow} of {pace.size} "
                "intervals: nothing tells fs and vs, what is seen of friction is fc alone; add a run that creeps, or "
                "leave the Stribeck term out"
            )
        elif pace.max(initial=0.0) < vs:
            said.append(
                f"{item.output} never moves faster than vs = {vs:.3g} per s: what is seen of friction is fc and fs "
                "together; add a run that slides faster, or leave the Stribeck term out"
            )
    return said


def stability_warnings(model: Model) -> list[str]:
    """Return a warning about poles with a positive real part, which a short run may hide."""
    if model.structure.has_friction:
        # Friction holds what would grow slowly; no poles say so.
        return []
    verdict = model.stability(coupling=model.structure.coupling)
    if not verdict.unstable_poles > 0:
        return []
    return [f"the model is {verdict}: its free run grows without bound, however well it fits a run of this length"]


def validate(result: Identification, runs: Run | Sequence[Run]) -> Comparison:
    """Compare a result with other runs and add warnings; see :meth:`ftlm.Identification.validate`."""
    there = compare(result.model, runs)
    words = [
        *there.warnings,
        *validation_warnings(result.comparison, there),
        *discretization_warnings(result.model, there),
    ]
    return replace(there, warnings=tuple(dict.fromkeys(words)))
