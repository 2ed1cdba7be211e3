"""Coefficients at given orders: least squares, multi-innovation, instrumental variables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ftlm import _core
from ftlm.base.errors import FtlmError
from ftlm.data.equations import Equation
from ftlm.data.run import Run
from ftlm.data.settings import Settings
from ftlm.data.structures import Initial, Structure
from ftlm.solve.records import InitialTuple, Record, named_coefficients, prepare, structure_tuple

#: Most steps of refined instrumental variables, and the relative change of a coefficient that ends them.
REFINEMENTS = 40
STILL = 1e-8
#: A coefficient that the prior moves by more than this share is not the data's alone.
PULLED = 0.05
#: Fewest pulses on which the effect of the step is looked at.
LEAST_PULSES = 32
#: Standard errors that the step may move a coefficient by before it is said.
STEP_BIAS = 0.5


@dataclass(frozen=True)
class CoefficientFit:
    """Coefficients at given orders by name, their standard errors where known, on what, and what to beware of."""

    m: int
    initial: Initial
    values: dict[str, float] = field(default_factory=dict)
    errors: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


def estimate_coefficients(
    runs: Sequence[Run], structure: Structure, settings: Settings, m: int | None
) -> CoefficientFit:
    """Coefficients at given orders by the estimator that the settings name."""
    records = prepare(runs, structure, m, power_of_two=settings.needs_haar)
    fit = CoefficientFit(records[0].m, records[0].initial)
    if settings.coefficients == "instrumental-variables":
        _instrumental(fit, structure, records)
        return fit
    for item in structure.equations:
        if settings.coefficients == "least-squares":
            raw = _core.least_squares(*_linear(item, records))[0]
        else:
            raw = _multi_innovation(item, records, settings, settings.prior_covariance)
            # A prior so weak that the data alone decide.
            weak = _multi_innovation(item, records, settings, min(settings.prior_covariance * 1e12, 1e300))
            fit.warnings.extend(_pulled(item.output, raw, weak, settings))
        fit.values.update(named_coefficients(item, raw))
    return fit


def _linear(
    item: Equation, records: list[Record]
) -> tuple[list[Any], Any, list[bool], list[float | None], InitialTuple]:
    """One equation and its records as the estimators that are linear in the coefficients take them."""
    first = records[0]
    fixed, structure = [t.fixed for t in item.terms], structure_tuple(item, first.signals)
    return [r.core() for r in records], structure, list(first.inputs), fixed, first.start


def _multi_innovation(item: Equation, records: list[Record], settings: Settings, prior: float) -> list[float]:
    """Coefficients by (44) in closed form."""
    haar = settings.rows == "haar"
    (raw, *_), _ = _core.multi_innovation(*_linear(item, records), settings.innovation_length, prior, haar, False)
    return raw


def _instrumental(fit: CoefficientFit, structure: Structure, records: list[Record]) -> None:
    """Fill in coefficients by refined instrumental variables, their standard errors at these orders, and warnings.

    Equations that drive each other are simulated together, so that every instrument follows from the inputs alone.
    """
    initial, inputs = records[0].start, list(records[0].inputs)
    groups = [structure.equations] if structure.coupling == "simulated" else [(e,) for e in structure.equations]
    for group in groups:
        outputs = ", ".join(e.output for e in group)
        estimates, covariances, iterations, converged, damped = _core.instrumental_variables(
            [r.core() for r in records], [structure_tuple(e, records[0].signals) for e in group], inputs,
            [[t.fixed for t in e.terms] for e in group], initial, REFINEMENTS, STILL,
        )  # fmt: skip
        if not converged:
            fit.warnings.append(
                f"{outputs}: instrumental variables did not stand still in {iterations} steps; the coefficients are "
                "those of the least output error met. Too much noise for these terms: use method='output-error'"
            )
        if damped:
            fit.warnings.append(f"{outputs}: the free run of these coefficients is unstable; do not trust them")
        for item, (raw, _, _, _), covariance in zip(group, estimates, covariances, strict=True):
            fit.values.update(named_coefficients(item, raw))
            free = [t for t in item.terms if t.fixed is None]
            spread = np.sqrt(np.diag(np.reshape(covariance, (len(free), len(free)))))
            pairs = zip(free, spread.tolist(), strict=True)
            fit.errors.update({str(t.coefficient): s / abs(t.factor) for t, s in pairs})


def step_bias(runs: Sequence[Run], structure: Structure, settings: Settings, fit: CoefficientFit) -> list[str]:
    """Say so where the step of the pulses moves coefficients by more than noise does.

    The scheme is of second order, so of the move from twice the step a third is left (Richardson).
    """
    if not fit.errors or fit.m < 2 * LEAST_PULSES:
        return []
    try:
        coarser = estimate_coefficients(runs, structure, settings, fit.m // 2).values
    except FtlmError:
        # A step that leaves no estimate tells nothing about half of it.
        return []
    moved = {n: abs(coarser[n] - fit.values[n]) / 3 / e for n, e in fit.errors.items() if e > 0}
    worst = max(moved, key=lambda n: moved[n], default="")
    if not worst or moved[worst] <= STEP_BIAS:
        return []
    carried = min(run.length - 1 for run in runs)
    finer = f"raise m, up to {carried}, or " if fit.m < carried else ""
    # Far from the limit a third of the move says no more than that it is large.
    amount = f"about {moved[worst]:.2g}" if moved[worst] <= 10 else "more than 10"
    return [
        f"at {fit.m} pulses the step alone moves coefficient {worst} by {amount} standard errors, which do "
        f"not count it; {finer}use method='output-error', which refines the step"
    ]


def _pulled(output: str, raw: list[float], weak: list[float], settings: Settings) -> list[str]:
    """Say so where the prior, not the data, decides the size of a coefficient."""
    shares = [abs(a - b) / abs(b) for a, b in zip(raw, weak, strict=True) if b]
    worst = max(shares, default=0.0)
    if worst <= PULLED:
        return []
    return [
        f"{output}: the prior (K0 = {settings.prior_covariance:g}, coefficients near 0) moves a coefficient by "
        f"{100 * min(worst, 9.99):.0f} % from what the data alone say; p = {settings.innovation_length} only weighs "
        "the data against it. Raise prior_covariance or use method='least-squares'"
    ]
