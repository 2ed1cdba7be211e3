"""Whether equations have an offset: decided from the runs where that is asked for, spoken of where it is not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ftlm.base.errors import ModelError
from ftlm.data.run import Run
from ftlm.data.structures import History, Structure
from ftlm.fit.history import instead_of_history
from ftlm.identification.estimate import Fit
from ftlm.identification.local import EVERY, OffsetTest, offset_test, unasked_offset

#: Samples in all runs beyond which nobody is told of an offset that was not asked for: the test holds a sensitivity of
#: each number at every sample.
MOST_SAMPLES = 400_000


def with_decided_offset(runs: Sequence[Run], structure: Structure, estimate: Callable[[Structure], Fit]) -> Fit:
    """The fit of a structure; under ``offset="auto"`` with a constant if the runs ask for one, and without if not.

    The constant is fitted first: a fit that lacks it where it belongs may end anywhere.
    """
    if structure.offset != "auto":
        fit = estimate(structure)
        # Where a body may stick, what a constant does is no sensitivity alone: it decides where the body rests.
        if structure.offset != "none" or structure.has_friction or not _small(fit.task.runs):
            return fit
        said = unasked_offset(tested(fit), fit.model.outputs) or _in_place_of_a_past(fit)
        return replace(fit, warnings=[*fit.warnings, *said])
    try:
        asked = replace(structure, offset="constant")
    except ModelError as error:
        # One of the initial terms that were given is what an offset integrates to.
        return _told(estimate(replace(structure, offset="none")), f"none: {error}")
    twin = same_as_offset(runs, structure)
    if twin is not None:
        words = f"none: {twin} is constant on every run, which an offset cannot be told from"
        return _told(estimate(replace(structure, offset="none")), words)
    fit = estimate(asked)
    test = tested(fit)
    if test is not None and test.exceeds():
        return _told(fit, test.decision)
    decision = "none: its test has no finite free run" if test is None else test.decision
    return _told(estimate(replace(structure, offset="none")), decision)


def _in_place_of_a_past(fit: Fit) -> list[str]:
    """Say where a constant explains what a history was taken for: powers of time do not go with the model, it would."""
    joint, structure = fit.joint, fit.task.structure
    if joint is None or structure.initial != "auto" or not isinstance(joint.initial, History):
        return []
    few = instead_of_history(joint, fit.task.runs, structure)
    if few is None:
        return []
    less = joint.initial_terms - few.initial_terms
    return [
        f"what {', '.join(fit.model.outputs)} did before the runs is estimated with {joint.initial_terms} powers of "
        f"time; an unknown constant in the equation explains as much with {less} numbers fewer: if a sensor's zero, a "
        "load or a mean may be there, offset='auto' estimates it"
    ]


def same_as_offset(runs: Sequence[Run], structure: Structure) -> str | None:
    """An input with a free coefficient that does on every run what an offset does, if there is one."""
    for item in structure.equations:
        for term in item.terms:
            plain = term.fixed is None and not term.order.names and term.order.constant == 0
            if plain and all(term.signal in r.inputs and float(np.ptp(r[term.signal])) == 0.0 for r in runs):
                return term.signal
    return None


def tested(fit: Fit) -> OffsetTest | None:
    """The test for an offset at a fit, with or without one; None where there is none."""
    structure = replace(fit.task.structure, offset="none")
    if fit.joint is not None:
        values = dict(zip(fit.joint.names, fit.joint.values.tolist(), strict=True))
        asked = replace(structure, initial=fit.joint.initial)
        return offset_test(fit.task.runs, asked, values, every=fit.joint.refinement)
    if fit.method == "genetic":
        return None
    values = {**fit.model.orders, **fit.model.coefficients}
    return offset_test(fit.task.runs, replace(structure, coefficient_law=()), values, every=EVERY)


def _told(fit: Fit, decision: str) -> Fit:
    return replace(fit, settings={**fit.settings, "offset_test": decision})


def _small(runs: tuple[Run, ...]) -> bool:
    return sum(run.length for run in runs) <= MOST_SAMPLES
