"""Starts from a scan of resonances: with the own terms of an equation fixed, its output error is linear in the rest.

Where signals feed back on each other or residuals are coloured, least squares on the equation error says nothing about
the own terms. Here they are put on a grid of frequencies and damping ratios; all other coefficients, and the initial
terms, follow by linear least squares on the output error itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ftlm import _core
from ftlm.base.errors import FtlmError
from ftlm.data.equations import Equation
from ftlm.solve.records import Record, equation_tuple, named_coefficients, structure_tuple

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
    if not others or len(others) == len(item.terms):
        return []
    rest = replace(item, terms=others)
    points = []
    for share in FREQUENCIES:
        best: tuple[float, dict[str, float]] | None = None
        for damping in DAMPINGS:
            own = own_coefficients(item, share * frequency, damping)
            if own is None:
                return []
            try:
                point = _projected(records, item, rest, own)
            except FtlmError:
                # Too fast for the step, or regressors that this filter makes alike.
                continue
            if math.isfinite(point[0]) and (best is None or point[0] < best[0]):
                best = point
        if best is not None:
            points.append(best)
    return sorted(points, key=lambda p: p[0])[:keep]


def _projected(
    records: Sequence[Record], item: Equation, rest: Equation, own: Mapping[str, float]
) -> tuple[float, dict[str, float]]:
    """Least squares on the output error over all coefficients but the own ones."""
    filtered, inputs = [], list(records[0].inputs)
    for rec in records:
        divisor = np.zeros(rec.m)
        divisor[0] = 1.0
        for term in item.terms:
            if term.signal == item.output:
                eta = item.order.constant - term.order.constant
                value = own[str(term.coefficient)] * term.factor
                divisor -= value * _core.block_pulse_kernel(eta, rec.m, rec.step)
        unit = np.zeros(rec.m)
        unit[0] = 1.0
        response = _core.series_divide(unit, divisor)
        means = rec.means.copy()
        for row, signal in enumerate(rec.signals):
            if signal != item.output:
                means[row] = _core.series_multiply(response, np.ascontiguousarray(means[row]), rec.m)
        sensor = response if rec.sensor is None else _core.series_multiply(response, rec.sensor, rec.m)
        filtered.append(replace(rec, means=means, sensor=sensor))
    # Caputo's powers of the whole equation: the rest alone would not know those of the own terms.
    initial = records[0].start
    signals = records[0].signals
    cores = [r.core() for r in filtered]
    raw = _core.least_squares(cores, structure_tuple(rest, signals), inputs, [t.fixed for t in rest.terms], initial)[0]
    values = {**own, **named_coefficients(rest, raw)}
    solved = equation_tuple(rest.with_coefficients(values), signals)
    missed = [_core.equation_error(core, solved, inputs, initial) for core in cores]
    size = math.sqrt(sum(float(np.sum(np.square(r.of(item.output)))) for r in records))
    # A shape that leaves the range of numbers is the worst of all, and nothing to warn of.
    with np.errstate(over="ignore", invalid="ignore"):
        error = math.sqrt(sum(float(e @ e) for e in missed)) / max(size, 1e-300)
    return error, values
