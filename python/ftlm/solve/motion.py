"""How a run starts: at rest, or in motion, with powers of time for what it did before.

A fractional integral remembers all that was before the run: to c I^eta s it adds c/Gamma(eta) times the integral of
(t + s)^(eta-1) over the past s, which is no finite sum. It is smooth but for a start like t^eta, so a few powers of t
in quarters reproduce it to any noise; Caputo's own terms, those of a past in which nothing moved, do not. How many are
needed follows from how far the run stands above its noise, never from how well they fit: a length chosen by the fit
would make its intervals too short. The fit only decides between Caputo's terms and all of these, in favour of these
wherever there is a doubt.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.statistics import ROUNDING, chi_squared, huber_excess, is_rest, noise_of
from ftlm.base.tall import length
from ftlm.data.readings import read
from ftlm.data.run import Run
from ftlm.data.structures import History, Initial, Structure

#: Distance between the powers of time.
QUARTER = 0.25
#: Highest power, in quarters, that a signal REFERENCE times the deviation of its noise's mean needs: biases stay below
#: a tenth of a standard error (benches/RESULTS.md).
REFERENCE, QUARTERS = 2500.0, 6
#: One quarter more lets this factor less of the past through.
FACTOR = 2.5
#: Fewest and most quarters.
LEAST, MOST = 2, 12
#: Samples a run has for each quarter at least.
SPARSEST = 16
#: Whole powers below this stand among the quarters always, so that their list is that of any order up to 3.
WHOLE = 3
#: Caputo's terms are enough where a past that holds no more would leave a larger misfit than theirs in this share of
#: runs. The usual share of 1 or 5 % would let a weak past through unseen, with intervals too short for its bias. Beside
#: an offset, which explains a first value away from zero by itself and which a history would hide, it is less.
DOUBT, DOUBT_BESIDE_OFFSET = 0.25, 0.02
#: Share of an excess in squares that asks for a history as well: what few samples far out make of it is no history, but
#: where squares are what is fitted, no fit is to leave more than one with fewer numbers does that has a history.
OF_SQUARES = 0.25


def starts_at_rest(run: Run, structure: Structure) -> bool:
    """Whether all outputs of a structure start at zero within their noise."""
    return all(is_rest(run[name]) for name in structure.signals if name in run.outputs)


def has_memory(structure: Structure) -> bool:
    """Whether an order of a structure is free or no whole number: then what was before the run is no finite sum."""
    orders = [o for e in structure.equations for o in (e.order, *(t.order for t in e.terms))]
    return any(o.names or o.constant != round(o.constant) for o in orders)


def history(run: Run, structure: Structure) -> History:
    """Powers of time for what the run did before its start, as many as its outputs' noise lets through."""
    visible = 1.0
    for name in structure.outputs:
        if name in run:
            samples = read(run[name])
            # A level that is no offset is a part of the past; one that is takes no power of its own.
            size = length(samples - (0.0 if structure.offset == "none" else np.mean(samples)))
            if size:
                visible = max(visible, size / max(noise_of(run[name]), np.finfo(np.float64).eps * size))
    quarters = QUARTERS + math.ceil(math.log(visible / REFERENCE) / math.log(FACTOR))
    quarters = max(LEAST, min(quarters, MOST, run.length // SPARSEST))
    highest = max((e.order.constant for e in structure.equations if not e.order.names), default=0.0)
    whole = range(max(WHOLE, math.ceil(highest)))
    return History(sorted({*(QUARTER * k for k in range(quarters + 1)), *map(float, whole)}))


def decided(run: Run, structure: Structure) -> Initial:
    """The initial terms of a structure on a run, where it leaves them open."""
    initial = structure.initial
    if initial == "auto":
        if starts_at_rest(run, structure):
            return "rest"
        # A body with friction has no velocities but its own, so that only level and velocity are asked for.
        initial = "history" if has_memory(structure) and not structure.has_friction else "caputo"
    return history(run, structure) if initial == "history" else initial


def together(decisions: list[Initial]) -> Initial | None:
    """One decision for runs of one fit, or None where they agree: the longest; a run at rest finds zeros for it."""
    if len(set(decisions)) < 2:
        return None
    return max(decisions, key=lambda d: (isinstance(d, tuple), d == "caputo", len(d)))


def decided_together(runs: Sequence[Run], structure: Structure) -> Initial:
    """Initial terms of a fit of all runs together."""
    starts = [decided(run, structure) for run in runs]
    return together(starts) or starts[0]


def misfit(few: Sequence[Floats], many: Sequence[Floats], sizes: Sequence[float]) -> float:
    """By how much residuals with few initial terms exceed those with many, in units of noise.

    Where the few are enough this is distributed as chi-squared, with as many degrees as there are terms more.

    Parameters
    ----------
    few, many
        Residuals of each output; infinite where a free run has no numbers, NaN where nothing was read.
    sizes
        Deviation of what was measured of each output.
    """
    excess = 0.0
    for one, other, size in zip(few, many, sizes, strict=True):
        there = ~np.isnan(one)
        if float(np.sqrt(np.mean(one[there] ** 2))) > ROUNDING * size:
            excess += huber_excess(one[there], other[there])
    return excess


def misfit_of_fits(few: Sequence[Floats], many: Sequence[Floats], sizes: Sequence[float]) -> float:
    """The misfit of one fit beside another, or a share of what squares say of it where that is more."""
    squares = 0.0
    for one, other, size in zip(few, many, sizes, strict=True):
        there = ~np.isnan(one)
        floor, above = float(np.mean(other[there] ** 2)), float(np.sum(one[there] ** 2 - other[there] ** 2))
        if math.sqrt(float(np.mean(one[there] ** 2))) > ROUNDING * size:
            squares += above / floor if floor > 0.0 else math.inf
    return max(misfit(few, many, sizes), OF_SQUARES * squares)


def missed(measured: Floats, simulated: Floats) -> Floats:
    """What a free run misses of what was read; infinite where it has no numbers, NaN where nothing was read."""
    with np.errstate(invalid="ignore"):
        rows: Floats = measured - simulated
    rows[~np.isnan(measured) & ~np.isfinite(rows)] = np.inf
    return rows


def needed(structure: Structure, excess: float, terms: int) -> bool:
    """Whether such an excess over residuals with so many terms more asks for a history beside Caputo's terms."""
    doubt = DOUBT if structure.offset == "none" else DOUBT_BESIDE_OFFSET
    return terms > 0 and excess > chi_squared(terms, doubt)
