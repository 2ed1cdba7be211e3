"""Starts from a scan of resonances: with the own terms of an equation fixed, its output error is linear in the rest.

Where signals feed back on each other or residuals are coloured, least squares on the equation error says nothing about
the own terms. Here they are put on a grid of frequencies and damping ratios; all other coefficients, and the initial
terms, follow by linear least squares on the output error itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ftlm import _core
from ftlm.data.equations import Equation
from ftlm.solve.records import Record, named_coefficients, structure_tuple

#: Frequencies of the scan in units of the frequency below which 90 % of the output's power lies.
FREQUENCIES = tuple(np.geomspace(0.15, 8.0, 14).tolist())
#: Damping ratios.
DAMPINGS = (0.03, 0.15, 0.5, 1.0)


def own_coefficients(item: Equation, omega: float, damping: float) -> dict[str, float] | None:
    """Coefficients of the own terms of D^alpha y = -2 zeta w^(alpha - nu) D^nu y - w^alpha y; None if all are known."""
    own = sorted((t for t in item.terms if t.signal == item.output), key=lambda t: t.order.constant)
    if not own or any(not isinstance(t.coefficient, str) for t in own):
        return None
    out = {}
    for place, term in enumerate(own):
        share = 1.0 if place == 0 else 2.0 * damping / (len(own) - 1)
        size = -share * omega ** (item.order.constant - term.order.constant)
        out[str(term.coefficient)] = size / term.factor
    return out


def scan_equation(
    records: Sequence[Record], item: Equation, frequency: float, *, keep: int
) -> list[tuple[float, dict[str, float]]]:
    """Best points of the scan of one equation whose orders are numbers, of each frequency only the best damping.

    The frequency [rad/s] is the unit of the scan's. A point is the root mean square output error as a share of the
    output's size, and the coefficients by name.
    """
    others = tuple(t for t in item.terms if t.signal != item.output)
    own = [t for t in item.terms if t.signal == item.output]
    if not others or not own:
        return []
    grid = [(share * frequency, damping) for share in FREQUENCIES for damping in DAMPINGS]
    tried: list[dict[str, float]] = []
    for omega, damping in grid:
        values = own_coefficients(item, omega, damping)
        if values is None:
            return []
        tried.append(values)
    # Caputo's powers of the whole equation: the rest alone would not know those of the own terms.
    rest, initial, signals = replace(item, terms=others), records[0].start, records[0].signals
    found = _core.projected_errors(
        [r.core() for r in records], structure_tuple(rest, signals), list(records[0].inputs),
        [t.fixed for t in others], initial, [item.order.constant - t.order.constant for t in own],
        [[values[str(t.coefficient)] * t.factor for t in own] for values in tried],
    )  # fmt: skip
    points = []
    for first in range(0, len(grid), len(DAMPINGS)):
        # What is not there is too fast for the step, or has regressors that this filter makes alike.
        there = [
            (at[0], {**values, **named_coefficients(rest, at[1])})
            for at, values in zip(found[first : first + len(DAMPINGS)], tried[first:], strict=False)
            if at is not None and math.isfinite(at[0])
        ]
        if there:
            points.append(min(there, key=lambda point: point[0]))
    return sorted(points, key=lambda p: p[0])[:keep]
