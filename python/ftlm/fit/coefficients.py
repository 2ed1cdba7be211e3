"""Coefficients at given orders: least squares, multi-innovation, instrumental variables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ftlm import _core
from ftlm.base.errors import FtlmError
from ftlm.data.run import Run
from ftlm.data.settings import Settings
from ftlm.data.structures import Structure
from ftlm.solve.records import Record, initial_tuple, named_coefficients, prepare, structure_tuple

#: Most steps of refined instrumental variables, and the relative change of a coefficient that ends them.
REFINEMENTS = 40
STILL = 1e-8
#: A coefficient that the prior moves by more than this share is not the data's alone.
PULLED = 0.05
#: Fewest pulses on which the effect of the step is looked at.
LEAST_PULSES = 32
#: Standard errors that the step may move a coefficient by before it is said.
STEP_BIAS = 0.5


def estimate_coefficients(
    runs: Sequence[Run], structure: Structure, settings: Settings, m: int | None
) -> tuple[dict[str, float], list[str], int, str, dict[str, float]]:
    """Coefficients by name at given orders, warnings, M, the initial terms in words, and standard errors if known."""
    records = prepare(runs, structure, m, power_of_two=settings.needs_haar)
    initial = initial_tuple(records[0].initial)
    words = records[0].initial if isinstance(records[0].initial, str) else f"t^{list(records[0].initial)}"
    cores = [r.core() for r in records]
    inputs = list(records[0].inputs)
    coefficients: dict[str, float] = {}
    warnings: list[str] = []
    if settings.coefficients == "instrumental-variables":
        coefficients, errors, warnings = _instrumental(structure, records)
        return coefficients, warnings, records[0].m, str(words), errors
    for item in structure.equations:
        fixed = [t.fixed for t in item.terms]
        core_structure = structure_tuple(item, records[0].signals)
        if settings.coefficients == "least-squares":
            raw, _, _, _ = _core.least_squares(cores, core_structure, inputs, fixed, initial)
        else:
            (raw, _, _, _), _ = _core.multi_innovation(
                cores, core_structure, inputs, fixed, initial, settings.innovation_length, settings.prior_covariance,
                settings.rows == "haar", False,
            )  # fmt: skip
            # A prior so weak that the data alone decide.
            weak, _ = _core.multi_innovation(
                cores, core_structure, inputs, fixed, initial, settings.innovation_length,
                min(settings.prior_covariance * 1e12, 1e300), settings.rows == "haar", False,
            )  # fmt: skip
            warnings += _pulled(item.output, raw, weak[0], settings)
        coefficients |= named_coefficients(item, raw)
    return coefficients, warnings, records[0].m, str(words), {}


def _instrumental(structure: Structure, records: list[Record]) -> tuple[dict[str, float], dict[str, float], list[str]]:
    """Coefficients by refined instrumental variables, their standard errors at these orders, and warnings.

    Equations that drive each other are simulated together, so that every instrument follows from the inputs alone.
    """
    initial, inputs = initial_tuple(records[0].initial), list(records[0].inputs)
    groups = [structure.equations] if structure.coupling == "simulated" else [(e,) for e in structure.equations]
    coefficients: dict[str, float] = {}
    errors: dict[str, float] = {}
    warnings: list[str] = []
    for group in groups:
        outputs = ", ".join(e.output for e in group)
        estimates, covariances, iterations, converged, damped = _core.instrumental_variables(
            [r.core() for r in records], [structure_tuple(e, records[0].signals) for e in group], inputs,
            [[t.fixed for t in e.terms] for e in group], initial, REFINEMENTS, STILL,
        )  # fmt: skip
        if not converged:
            warnings.append(
                f"{outputs}: instrumental variables did not stand still in {iterations} steps; the coefficients are "
                "those of the least output error met. Too much noise for these terms: use method='output-error'"
            )
        if damped:
            warnings.append(f"{outputs}: the free run of these coefficients is unstable; do not trust them")
        for item, (raw, _, _, _), covariance in zip(group, estimates, covariances, strict=True):
            coefficients |= named_coefficients(item, raw)
            free = [t for t in item.terms if t.fixed is None]
            spread = np.sqrt(np.diag(np.reshape(covariance, (len(free), len(free)))))
            pairs = zip(free, spread.tolist(), strict=True)
            errors |= {t.coefficient: s / abs(t.factor) for t, s in pairs if isinstance(t.coefficient, str)}
    return coefficients, errors, warnings


def step_bias(
    runs: Sequence[Run],
    structure: Structure,
    settings: Settings,
    m: int,
    coefficients: Mapping[str, float],
    errors: Mapping[str, float],
) -> list[str]:
    """Say so where the step of the pulses moves coefficients by more than noise does.

    The scheme is of second order, so of the move from twice the step a third is left (Richardson).
    """
    if not errors or m < 2 * LEAST_PULSES:
        return []
    try:
        coarser, *_ = estimate_coefficients(runs, structure, settings, m // 2)
    except FtlmError:
        # A step that leaves no estimate tells nothing about half of it.
        return []
    moved = {n: abs(coarser[n] - coefficients[n]) / 3 / e for n, e in errors.items() if e > 0}
    worst = max(moved, key=lambda n: moved[n], default="")
    if not worst or moved[worst] <= STEP_BIAS:
        return []
    carried = min(run.length - 1 for run in runs)
    finer = f"raise m, up to {carried}, or " if m < carried else ""
    # Far from the limit a third of the move says no more than that it is large.
    amount = f"about {moved[worst]:.2g}" if moved[worst] <= 10 else "more than 10"
    return [
        f"at {m} pulses the step alone moves coefficient {worst} by {amount} standard errors, which do "
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
