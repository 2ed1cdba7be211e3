"""Prior knowledge of parameters: bounds and normal priors.

Bounds are imposed by an active-set method: a coefficient beyond its bound is fixed at the bound, and the others are
fitted again. Priors add their squared deviations to the cost of a fit, so that it maximizes the posterior density.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import TypeVar

from ftlm.errors import ConvergenceError, ModelError
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.output_error import JointFit
from ftlm.findings import Finding, make_finding
from ftlm.structure.structure import Structure
from ftlm.utils.parameters import Placeholder, parameter
from ftlm.utils.validation import check_known, join_names, real_number

Bounds = Mapping[str, tuple[float, float]]
#: Mean and standard deviation of the normal priors of parameters by name.
Priors = Mapping[str, tuple[float, float]]

FitType = TypeVar("FitType")


def check_intervals(bounds: object, *, finite: bool = False) -> None:
    """Raise ModelError unless `bounds` maps names to pairs lower < upper. `finite` excludes infinite bounds."""
    if not isinstance(bounds, Mapping):
        raise ModelError(f"bounds = {bounds!r} is not a mapping; write {{name: (low, high)}}")
    for name, pair in bounds.items():
        pair_values = [real_number(f"bound of {name}", v) for v in pair] if isinstance(pair, (tuple, list)) else []
        if not (len(pair_values) == 2 and pair_values[0] < pair_values[1]) or (
            finite and not all(map(math.isfinite, pair_values))
        ):
            raise ModelError(
                f"bounds of {name} = {pair!r} are not an interval; write "
                f"{parameter('bounds', {name: (Placeholder('low'), Placeholder('high'))})}"
            )


def check_priors(priors: object) -> None:
    """Raise ModelError unless `priors` maps names to pairs of a finite mean and a positive standard deviation."""
    if not isinstance(priors, Mapping):
        raise ModelError(f"priors = {priors!r} is not a mapping; write {{name: (mean, standard deviation)}}")
    for name, pair in priors.items():
        numbers = [real_number(f"prior of {name}", v) for v in pair] if isinstance(pair, (tuple, list)) else []
        if not (len(numbers) == 2 and all(map(math.isfinite, numbers)) and numbers[1] > 0.0):
            raise ModelError(
                f"prior of {name} = {pair!r} is not a finite mean and a positive standard deviation; write "
                f"{parameter('priors', {name: (Placeholder('mean'), Placeholder('deviation'))})}"
            )


def _check_not_in_law(option: str, names: Iterable[str], structure: Structure) -> None:
    """Raise ModelError for a name that a coefficient law determines; such a coefficient is not a free parameter."""
    laws = {name: (factor, factors) for name, factor, factors in structure.coefficient_law}
    for name in names:
        if name in laws:
            factor, factors = laws[name]
            product = " ".join([*([] if factor == 1.0 else ["-" if factor == -1.0 else f"{factor:g}"]), *factors])
            allowed = join_names([n for n in factors if n in structure.coefficient_names])
            raise ModelError(
                f"{parameter(option)} has {name}, which follows from the coefficient law {name} = {product}; "
                f"{f'use {allowed}, or ' if allowed else ''}identify without the law"
            )


def with_priors(structure: Structure, priors: Priors | None) -> Structure:
    """Return the structure with normal priors of free parameters, such as orders, coefficients and delays.

    Raises
    ------
    ModelError
        If a name is not a free parameter, or a prior is not a pair of a finite mean and a positive deviation.
    """
    check_priors(priors or {})
    if not priors:
        return structure
    _check_not_in_law("priors", priors, structure)
    check_known("prior of", priors, FreeProblem.of(replace(structure, initial="rest", offset="none")).names)
    return replace(
        structure, priors={name: (float(mean), float(deviation)) for name, (mean, deviation) in priors.items()}
    )


#: Distance of the estimate without a prior from the mean of the prior, in standard deviations of their difference,
#: above which the two disagree.
MAX_PRIOR_DISTANCE = 3.0
#: Fraction of the information on a parameter above which its prior determines it.
DETERMINING_FRACTION = 0.5


def prior_findings(priors: Priors, joint: JointFit) -> list[Finding]:
    """Return findings on priors that the runs contradict, and on parameters that the priors determine.

    Let e be the estimate, and w the fraction of the information that its prior (mean m, variance s²) contributes. The
    estimate without the prior differs from m by (e - m) / (1 - w), and the variance of this difference is s² / (1 - w).
    """
    findings = []
    for name, fraction in joint.prior_fractions.items():
        (mean, deviation), value = priors[name], joint.values_by_name[name]
        numbers = {"parameter": name, "value": value, "mean": mean, "deviation": deviation}
        distance = abs(value - mean) / (deviation * math.sqrt(1.0 - fraction)) if fraction < 1.0 else 0.0
        if distance > MAX_PRIOR_DISTANCE:
            findings.append(make_finding("prior_contradicts_runs", distance=distance, **numbers))
        if fraction > DETERMINING_FRACTION:
            findings.append(make_finding("prior_determines_parameter", share=100.0 * fraction, **numbers))
    return findings


def check_bounds(structure: Structure, bounds: Bounds | None, start: object = None) -> tuple[Structure, Bounds]:
    """Return the structure with the bounds of its orders, and the bounds of its coefficients.

    Raises
    ------
    ModelError
        If a name is not a free order or coefficient, a bound is not a pair of increasing numbers, or an initial guess
        is out of its bounds.
    """
    check_intervals(bounds or {})
    out, limits = {}, bounds or {}
    inputs = {item.name: item for item in structure.free_input_parameters}
    _check_not_in_law("bounds", limits, structure)
    laws = {name for name, _, _ in structure.coefficient_law}
    free = [n for n in structure.coefficient_names if n not in laws]
    check_known("bound of", limits, [*free, *structure.order_names, *inputs])
    for name, pair in limits.items():
        if name in inputs:
            item = inputs[name]
            raise ModelError(
                f"{parameter('bounds')} has {name}, but the bounds of the {item.description}, {item.bounds[0]:g} to "
                f"{item.bounds[1]:g}, are part of the structure; change them there"
            )
        low, high = map(float, pair)
        value = start.get(name) if isinstance(start, Mapping) else None
        if value is not None and not low <= real_number(f"start value of {name}", value) <= high:
            raise ModelError(
                f"{parameter('start')} has {name} = {value:g}, out of its bounds {low:g} to {high:g}; choose a value "
                "within them"
            )
        out[name] = (low, high)
    orders = {n: list(out.pop(n)) for n in structure.order_names if n in out}
    return structure.with_orders(orders), out


def fit_within_bounds(
    structure: Structure,
    bounds: Bounds,
    fit: Callable[[Structure, Mapping[str, float] | None], tuple[FitType, Mapping[str, float]]],
) -> tuple[FitType, list[Finding]]:
    """Return the fit of a structure with its coefficients within bounds, and a finding on each active bound.

    An active-set method fixes coefficients beyond their bounds at the bounds. Then it frees each fixed coefficient in
    turn and fits again, starting from the bound. The refit is kept if it satisfies all bounds. `fit` is called with a
    structure and its only initial guess, or None for automatic initial guesses. It returns a fit and its estimates by
    name.
    """

    def violations(values: Mapping[str, float]) -> dict[str, float]:
        clipped_values = {
            n: (values[n], min(max(values[n], low), high)) for n, (low, high) in bounds.items() if n in values
        }
        return {n: end for n, (value, end) in clipped_values.items() if value != end}

    result, values = fit(structure, None)
    fixed, violating_values = dict[str, float](), dict[str, float]()
    while bound_values := violations(values):
        fixed |= bound_values
        violating_values |= {n: values[n] for n in bound_values}
        result, values = fit(structure.with_coefficients(fixed), None)
    for name in list(fixed):
        other_fixed = {n: v for n, v in fixed.items() if n != name}
        with contextlib.suppress(ConvergenceError):
            relaxed_fit, relaxed_values = fit(structure.with_coefficients(other_fixed), {**values, name: fixed[name]})
            if not violations(relaxed_values):
                result, values, fixed = relaxed_fit, relaxed_values, other_fixed
    bound_findings = [
        make_finding("coefficient_on_bound", parameter=n, value=v, outside=violating_values[n])
        for n, v in fixed.items()
    ]
    return result, bound_findings
