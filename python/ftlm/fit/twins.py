"""Signals that drive an equation alike on every run: nothing tells their coefficients apart."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from ftlm.base.tall import dot, length
from ftlm.data.readings import bridged
from ftlm.data.run import Run
from ftlm.data.structures import Structure

#: Share of a signal's size that it may differ from a multiple of another one and still be one: rounding of files.
ROUNDED = 1e-9


def twin_words(runs: Sequence[Run], structure: Structure) -> str | None:
    """Which two signals with free coefficients drive an equation at the same order, one a multiple of the other."""
    for item in structure.equations:
        driving = [t for t in item.terms if t.signal != item.output and isinstance(t.coefficient, str)]
        for one, other in itertools.combinations(driving, 2):
            if one.signal == other.signal or one.order != other.order:
                continue
            first, second = (np.concatenate([bridged(run[t.signal]) for run in runs]) for t in (one, other))
            size = dot(first, first)
            ratio = dot(first, second) / size if size > 0 else 0.0
            if length(second - ratio * first) <= ROUNDED * length(second):
                return (
                    f"{other.signal} is {ratio:.6g} times {one.signal} on every run, which no run tells apart: leave "
                    f"out the term of {other.coefficient} or that of {one.coefficient}, fix one of them, or add a run "
                    "in which the two signals differ"
                )
    return None
