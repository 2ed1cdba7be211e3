"""Initial conditions of a run: rest, or initial terms for its past inputs, and initial state of the sensor filter."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ftlm.data.run import Run
from ftlm.data.sampling import drop_missing
from ftlm.structure.structure import History, Initial, Structure
from ftlm.utils.linalg import vector_norm
from ftlm.utils.statistics import NEGLIGIBLE_RESIDUAL_SHARE, chi_squared, estimate_noise, huber_excess, is_rest
from ftlm.utils.validation import Floats

#: Increment of the powers of time.
POWER_INCREMENT = 0.25
#: Ratio of a signal's norm to its noise standard deviation, and the highest power, in quarters, that it needs for
#: biases below a tenth of a standard error (benches/RESULTS.md).
REFERENCE_SIGNAL_RATIO, REFERENCE_QUARTERS = 2500.0, 6
#: Factor by which one more quarter reduces the unmodeled past.
SIGNAL_RATIO_PER_QUARTER = 2.5
#: Minimum and maximum number of quarters.
MIN_QUARTERS, MAX_QUARTERS = 2, 12
#: Minimum number of samples of a run per quarter.
MIN_SAMPLES_PER_QUARTER = 16
#: Integer powers below this are always included, so that the list is the same for any order up to 3.
MIN_INTEGER_POWERS = 3
#: Significance level of the test of Caputo's terms against a full history. The usual 1 or 5 % would miss a weak past,
#: with intervals too short for its bias. With an offset the level is lower: it explains a nonzero first value by
#: itself, and a history would make it unidentifiable.
HISTORY_TEST_LEVEL, HISTORY_TEST_LEVEL_WITH_OFFSET = 0.25, 0.02
#: Weight of the excess in the residual sum of squares, as an alternative to the robust excess. Few outliers must not
#: require a history, but a least-squares fit must not be worse than one with a history and fewer parameters.
SQUARES_WEIGHT = 0.25


def starts_at_rest(run: Run, structure: Structure) -> bool:
    """Whether all outputs of a structure start at zero within their noise."""
    return all(is_rest(run[name]) for name in structure.signals if name in run.outputs)


def has_memory(structure: Structure) -> bool:
    """Whether an order is free or fractional, so that initial conditions are no finite sum."""
    orders = [o for e in structure.equations for o in (e.order, *(t.order for t in e.terms))]
    return any(o.names or o.constant != round(o.constant) for o in orders)


def history(run: Run, structure: Structure) -> History:
    """Return powers of time for the past inputs of a run, as many as the noise of its outputs requires."""
    visible = 1.0
    for name in structure.outputs:
        if name in run:
            samples = drop_missing(run[name])
            # A level that is no offset is a part of the past; one that is takes no power of its own.
            size = vector_norm(samples - (0.0 if structure.offset == "none" else np.mean(samples)))
            if size:
                visible = max(visible, size / max(estimate_noise(run[name]), np.finfo(np.float64).eps * size))
    quarters = REFERENCE_QUARTERS + math.ceil(
        math.log(visible / REFERENCE_SIGNAL_RATIO) / math.log(SIGNAL_RATIO_PER_QUARTER)
    )
    quarters = max(MIN_QUARTERS, min(quarters, MAX_QUARTERS, run.length // MIN_SAMPLES_PER_QUARTER))
    highest = max((e.order.constant for e in structure.equations if not e.order.names), default=0.0)
    whole = range(max(MIN_INTEGER_POWERS, math.ceil(highest)))
    return History(sorted({*(POWER_INCREMENT * k for k in range(quarters + 1)), *map(float, whole)}))


def resolve_initial_conditions(run: Run, structure: Structure) -> Initial:
    """Return the initial conditions of a structure on a run, resolving ``"auto"``."""
    initial = structure.initial
    if initial == "auto":
        if starts_at_rest(run, structure):
            return "rest"
        # A body with friction has no velocities but its own, so that only level and velocity are asked for.
        initial = "history" if has_memory(structure) and not structure.has_friction else "caputo"
    return history(run, structure) if initial == "history" else initial


def common_initial_conditions(decisions: list[Initial]) -> Initial | None:
    """Return common initial conditions for runs of one fit, the longest ones, or None if they are equal."""
    if len(set(decisions)) < 2:
        return None
    return max(decisions, key=lambda d: (isinstance(d, tuple), d == "caputo", len(d)))


def resolve_common_initial_conditions(runs: Sequence[Run], structure: Structure) -> Initial:
    """Return common initial conditions of a fit of all runs."""
    starts = [resolve_initial_conditions(run, structure) for run in runs]
    return common_initial_conditions(starts) or starts[0]


def misfit(few: Sequence[Floats], many: Sequence[Floats], sizes: Sequence[float]) -> float:
    """Excess of residuals with few initial terms over those with many, in units of noise.

    If the few terms suffice, it has a chi-squared distribution with the number of additional terms as degrees of
    freedom.

    Parameters
    ----------
    few, many
        Residuals of each output; infinite where a simulation is not finite, NaN at missing samples.
    sizes
        Standard deviation of each measured output.
    """
    excess = 0.0
    for one, other, size in zip(few, many, sizes, strict=True):
        there = ~np.isnan(one)
        if float(np.sqrt(np.mean(one[there] ** 2))) > NEGLIGIBLE_RESIDUAL_SHARE * size:
            excess += huber_excess(one[there], other[there])
    return excess


def misfit_of_fits(few: Sequence[Floats], many: Sequence[Floats], sizes: Sequence[float]) -> float:
    """Misfit between two fits, or a fraction of the excess in the sum of squares if that is larger."""
    squares = 0.0
    for one, other, size in zip(few, many, sizes, strict=True):
        there = ~np.isnan(one)
        floor, above = float(np.mean(other[there] ** 2)), float(np.sum(one[there] ** 2 - other[there] ** 2))
        if math.sqrt(float(np.mean(one[there] ** 2))) > NEGLIGIBLE_RESIDUAL_SHARE * size:
            squares += above / floor if floor > 0.0 else math.inf
    return max(misfit(few, many, sizes), SQUARES_WEIGHT * squares)


def output_residuals(measured: Floats, simulated: Floats) -> Floats:
    """Difference of measured and simulated samples; infinite if the simulation is, NaN at missing samples."""
    with np.errstate(invalid="ignore"):
        rows: Floats = measured - simulated
    rows[~np.isnan(measured) & ~np.isfinite(rows)] = np.inf
    return rows


def needs_history(structure: Structure, excess: float, terms: int) -> bool:
    """Whether an excess over residuals with additional terms requires a history instead of Caputo's terms."""
    doubt = HISTORY_TEST_LEVEL if structure.offset == "none" else HISTORY_TEST_LEVEL_WITH_OFFSET
    return terms > 0 and excess > chi_squared(terms, doubt)
