"""Point samples of a model's outputs at a run's instants, with initial terms given or fitted to what was measured.

A sample belongs to its instant after the input of its row has acted: y[k] = y(t_k+), as a sampled state-space model has
it. What integrates is continuous there; what feeds through (a term of the equation's own order) is added as it is then.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ftlm import _core
from ftlm.base.arrays import Floats
from ftlm.base.errors import ModelError
from ftlm.data.equations import Equation
from ftlm.data.run import Run
from ftlm.data.solved import Solved
from ftlm.data.structures import Initial, Offset, SensorFilter, offset_exponents
from ftlm.solve.records import MAX_M, Record, equation_tuple, record, sensor_series

#: First refinement of the record's own grid, doubled until the response stands still. Two pulses an interval are the
#: least from which a sample follows that no jump of a held input at its instant has reached.
FIRST_REFINEMENT = 2
#: Orders closer than this are one order.
GRAIN = 1e-9
#: Share of a response of an initial term that others must leave for it to be told from them.
SPANNED = 1e-10

Terms = Mapping[str, Mapping[float, float]]


@dataclass(frozen=True)
class Sampled:
    """Point samples of a free run.

    Parameters
    ----------
    outputs
        Shape (outputs, N), measured through the sensor filter where they are; not finite where the run diverges.
    initial
        Coefficients of the initial terms, by output and exponent.
    refinement
        Pulses a sample interval on the finest grid that was used.
    change
        What halving the step last moved, as a share of each output's largest value; infinite before there were two.
    """

    outputs: Floats
    initial: dict[str, dict[float, float]]
    refinement: int
    change: Floats


def initial_exponents(item: Equation, initial: Initial, offset: Offset) -> list[float]:
    """Exponents of the initial terms and the offset of an equation whose orders are numbers, distinct and ascending."""
    alpha = item.order.constant
    found = {round(e, 9) for e in offset_exponents(alpha, offset).values()}
    if initial != "caputo":
        return sorted(found | ({round(e, 9) for e in initial} if not isinstance(initial, str) else set()))
    for lowest, order in [(0.0, alpha), *((alpha - t.order.constant, t.order.constant) for t in item.terms)]:
        found |= {round(lowest + i, 9) for i in range(math.ceil(order - GRAIN))}
    return sorted(found)


def refined(model: Solved, run: Run, initial: Terms | None, *, tolerance: float, largest_m: int = MAX_M) -> Sampled:
    """Samples on grids refined, and extrapolated in the step, until they stand still or the pulses run out.

    Parameters
    ----------
    initial
        Coefficients of initial terms by output and exponent; None: those that bring the run closest to the measured
        outputs, each weighted by its own deviation.
    tolerance
        Change, as a share of each output's largest value, at which refinement ends.
    """
    own = run.length - 1
    every = FIRST_REFINEMENT
    coarse, known = _tried(model, run, every, initial)
    terms = known
    best, change = coarse, np.full(len(model.outputs), np.inf)
    extrapolated: Floats | None = None
    lost = 0
    while 2 * every * own <= largest_m and lost < 2:
        every *= 2
        fine, found = _tried(model, run, every, initial, last=lost == 1)
        # A stiff equation may have no stable scheme on a coarse grid; one that has none on two in a row has none.
        lost = 0 if np.all(np.isfinite(fine)) else lost + 1
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            both = bool(np.all(np.isfinite(coarse)))
            best = (4.0 * fine - coarse) / 3.0 if both else fine
            terms = _limit(known, found) if both else found
            if extrapolated is not None:
                size = np.max(np.abs(best), axis=1)
                moved = np.max(np.abs(best - extrapolated), axis=1)
                change = np.where(moved == 0.0, 0.0, moved / size)
        extrapolated, coarse, known = best, fine, found
        if np.all(change <= tolerance):
            break
    return Sampled(best, terms, every, change)


def _limit(coarse: Terms, fine: Terms) -> dict[str, dict[float, float]]:
    """Initial terms in the limit of the step, which two grids tell (Richardson)."""
    return {o: {e: (4.0 * v - coarse[o][e]) / 3.0 for e, v in terms.items()} for o, terms in fine.items()}


def _tried(
    model: Solved, run: Run, every: int, initial: Terms | None, *, last: bool = False
) -> tuple[Floats, dict[str, dict[float, float]]]:
    """Samples on one grid; no numbers where it happens to make the equations unsolvable, unless it is the last try."""
    try:
        return sampled(model, run, every, initial)
    except ModelError:
        # An own coefficient c meets 1 = c h^alpha / gamma(alpha + 2) on one step, not on two.
        if last:
            raise
        return np.full((len(model.outputs), run.length), np.nan), {o: {} for o in model.outputs}


def sampled(model: Solved, run: Run, every: int, initial: Terms | None) -> tuple[Floats, dict[str, dict[float, float]]]:
    """Samples on ``every`` pulses a sample interval, shape (outputs, N), and initial terms; they may not be finite."""
    coupled = model.structure.coupling == "simulated"
    rec = record(run, model.structure, (run.length - 1) * every, filtered=not coupled)
    still = replace(rec, means=np.zeros_like(rec.means))
    if initial is not None:
        kept = {o: dict(initial.get(o, {})) for o in model.outputs}
        return _read(model, run, rec, every, _responses(model, rec, kept), kept), kept
    names = [(e.output, power) for e in model.equations for power in initial_exponents(e, rec.initial, rec.offset)]
    none: dict[str, dict[float, float]] = {o: {} for o in model.outputs}
    driven = _read(model, run, rec, every, _responses(model, rec, none), none)
    if not names or not np.all(np.isfinite(driven)):
        return driven, none
    columns = []
    for output, power in names:
        unit = {**none, output: {power: 1.0}}
        columns.append(_read(model, None, still, every, _responses(model, still, unit), unit))
    return _fitted(model, measured_samples(model, run, every, rec), driven, names, columns)


def measured_samples(model: Solved, run: Run, every: int, rec: Record | None = None) -> Floats:
    """What the outputs are compared with, shape (outputs, N): as measured, or filtered where the equation is."""
    sensor = model.structure.sensor_filter
    filtered = sensor is not None and model.structure.coupling != "simulated"
    if not filtered or sensor is None or set(model.outputs) <= set(sensor.outputs):
        return np.stack([run[name] for name in model.outputs])
    rec = rec or record(run, model.structure, (run.length - 1) * every)
    return np.stack([run[n] if n in sensor.outputs else _core.point_samples(rec.of(n))[::every] for n in model.outputs])


def _fitted(
    model: Solved, measured: Floats, driven: Floats, names: Sequence[tuple[str, float]], columns: Sequence[Floats]
) -> tuple[Floats, dict[str, dict[float, float]]]:
    """Initial terms that bring the run closest to what was measured, by least squares, and the run with them."""
    deviation = np.std(measured, axis=1, keepdims=True)
    weight = 1.0 / np.where(deviation > 0, deviation, 1.0)
    with np.errstate(over="ignore", invalid="ignore"):
        basis = np.stack([(weight * c).ravel() for c in columns], axis=1)
        sizes = np.linalg.norm(basis, axis=0)
    usable = np.isfinite(sizes) & (sizes > 0)
    scaled = basis[:, usable] / sizes[usable]
    x = np.zeros(len(names))
    x[usable] = np.linalg.lstsq(scaled, (weight * (measured - driven)).ravel(), rcond=SPANNED)[0] / sizes[usable]
    terms: dict[str, dict[float, float]] = {o: {} for o in model.outputs}
    total = driven.copy()
    for (output, power), value, column in zip(names, x.tolist(), columns, strict=True):
        terms[output][power] = value
        if value:
            total += value * column
    return total, terms


def _responses(model: Solved, rec: Record, terms: Terms) -> Floats:
    """Pulse means of the outputs, before the sensor filter: all together, or each driven by the measured others."""
    equations = [equation_tuple(e, rec.signals) for e in model.equations]
    powers = [sorted(terms[o].items()) for o in model.outputs]
    inputs = list(rec.inputs)
    if model.structure.coupling == "simulated":
        return _core.respond(rec.core(), equations, inputs, powers)
    return np.concatenate([_core.respond(rec.core(), [e], inputs, [p]) for e, p in zip(equations, powers, strict=True)])


def _read(model: Solved, run: Run | None, rec: Record, every: int, means: Floats, terms: Terms) -> Floats:
    """Samples at the instants from pulse means: what integrates from the left, what feeds through as it is there.

    The last two pulses before each instant are extended to it: no jump of a held input lies in them, so the
    extrapolation crosses none of the kinks t^alpha that jumps leave.
    """
    names, structure = model.outputs, model.structure
    coupled = structure.coupling == "simulated"
    system, drive, now = np.eye(len(names)), np.zeros_like(means), np.zeros((len(names), rec.m // every + 1))
    start = np.zeros(len(names))
    for i, item in enumerate(model.equations):
        start[i] = terms[item.output].get(0.0, 0.0)
        if rec.sensor is not None and structure.sensor_filter is not None:
            # The whole equation passes the filter, and so does what its output starts from.
            start[i] *= high_frequency_gain(structure.sensor_filter)
        for term in item.terms:
            if abs(term.order.constant - item.order.constant) > GRAIN:
                continue
            factor = float(term.fixed or 0.0)
            if coupled and term.signal in names:
                system[i, names.index(term.signal)] -= factor
            elif run is not None:
                drive[i] += factor * rec.of(term.signal)
                now[i] += factor * _at_instants(run, rec, structure.delay.get(term.signal, 0.0), term.signal, every)
    through = np.linalg.inv(system)
    drive, now, start = through @ drive, through @ now, through @ start
    with np.errstate(invalid="ignore", over="ignore"):
        rest = means - drive
        gain = np.ones(len(names))
        series = sensor_series(structure, rec.m, rec.step) if coupled else None
        if series is not None and structure.sensor_filter is not None:
            for i, name in enumerate(names):
                if name in structure.sensor_filter.outputs and np.all(np.isfinite(means[i])):
                    gain[i] = high_frequency_gain(structure.sensor_filter)
                    rest[i] = _core.series_multiply(series, means[i], rec.m) - gain[i] * drive[i]
        later = 1.5 * rest[:, every - 1 :: every] - 0.5 * rest[:, every - 2 :: every]
        return np.concatenate([(gain * start)[:, None], later], axis=1) + gain[:, None] * now


def high_frequency_gain(sensor: SensorFilter) -> float:
    """What a sensor filter makes of a jump at once: 0 unless its numerator is of the denominator's order."""
    highest = max(order for coefficient, order in sensor.denominator if coefficient)
    top, bottom = (sum(c for c, order in part if order == highest) for part in (sensor.numerator, sensor.denominator))
    return top / bottom


def _at_instants(run: Run, rec: Record, delay: float, name: str, every: int) -> Floats:
    """Values of a signal just after the instants."""
    filtered = rec.sensor is not None
    if not delay and not filtered:
        return run[name]
    means = rec.of(name)
    if filtered or run.intersample.get(name) != "zoh":
        return _core.point_samples(means)[::every]
    return np.append(means[::every], means[-1])
