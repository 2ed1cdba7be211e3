"""Simulation of equations with friction, and their initial conditions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ftlm import _core
from ftlm.data.run import Run
from ftlm.data.sampling import read
from ftlm.errors import FtlmError, ModelError
from ftlm.model.model import Solved
from ftlm.simulation.discretization import (
    Instants,
    Record,
    compared_times,
    compared_values,
    driving,
    equation_tuple,
    has_own_times,
    linear_tuple,
    record,
    sensor_series,
)
from ftlm.simulation.initial_conditions import decided, has_memory, history, misfit, misfit_of_fits, missed, needed
from ftlm.structure.equation import Equation, Friction
from ftlm.structure.sensor_filter import SensorFilter
from ftlm.structure.structure import History, Initial, Offset, Structure, offset_exponents
from ftlm.utils.linalg import solved
from ftlm.utils.statistics import chi_squared, colour
from ftlm.utils.validation import Floats

#: Maximum number of evaluations for level, velocity and offset of a run, and relative change of the cost that
#: terminates.
EVALUATIONS = 60
STILL = 1e-12


def motion_with_friction(model: Solved, rec: Record, powers: Sequence[Sequence[tuple[float, float]]]) -> _core._Motion:
    """Simulate equations with friction, for initial terms by equation as (exponent, coefficient).

    Impulses (-1, -2, ...) represent the initial state of the sensor filter of these outputs.

    Returns
    -------
    dict
        ``outputs`` (pulse means, a row an equation), and with a row for each body with friction ``velocity`` (at the
        edges of the pulses, one more; exactly 0 at rest), ``force`` (mean of the friction over each pulse, in the unit
        of D^alpha y) and ``stuck`` (whether it is at rest at the end of each).
    """
    equations = [(linear_tuple(e, rec.signals), [float(t.fixed or 0.0) for t in e.terms]) for e in model.equations]
    frictions = [(i, strength(model.equations[i])) for i in model.structure.sticks]
    return _core.friction_respond(rec.core(), equations, frictions, [list(terms) for terms in powers])


def strength(item: Equation) -> tuple[float, float, float]:
    """Friction parameters fc, fs and vs of an equation."""
    return (item.friction or Friction(0.0)).law


def begun(model: Solved, run: Run, rec: Record, every: int, near: list[float] | None = None) -> dict[str, Any]:
    """Fit initial terms and offsets of a simulation with friction, ``every`` pulses per sampling interval.

    They affect when a body sticks and slides, so they are found by optimization, from level and velocity at the start
    of the run or from nearby states.

    Returns
    -------
    dict
        As the core's joint fit, without anything free: ``states``, and ``powers``, their (exponent, coefficient) by run
        and equation.
    """
    check_regular(run, model)
    samples = np.stack([run[name] for name in model.outputs])
    known = ~np.isnan(samples)
    sizes = np.nanstd(samples, axis=1)
    shares: Floats | None = None
    if not known.all():
        shares = np.ascontiguousarray(np.where(known[:, 1:-1], 1.0, 0.0))
    structure = model.structure
    series = sensor_series(structure, rec.m, rec.step)
    filtered = None if series is None else (series, [structure.measured_through(o) for o in model.outputs])
    experiment = (
        rec.core(),
        every,
        np.where(known, samples, 0.0),
        filtered,
        [1.0 / s if s > 0 else 1.0 for s in sizes.tolist()],
        [(None, False)] * len(rec.signals),
        shares,
        None,
    )
    laws = [known_law(item, rec.signals) for item in model.equations]
    frictions: list[tuple[int, list[tuple[float, list[Any]]]]] = [
        (i, [(x, []) for x in strength(model.equations[i])]) for i in structure.sticks
    ]
    return _core.friction_error(
        [experiment],
        laws,
        frictions,
        [],
        [],
        rec.start,
        [],
        [],
        [],
        [] if near is None else [near],
        EVALUATIONS,
        STILL,
    )


def known_law(item: Equation, signals: Sequence[str]) -> tuple[int, tuple[float, list[float]], list[Any]]:
    """Return an identified equation as the core's equation with free parameters, all of them fixed."""
    output, alpha, terms = linear_tuple(item, signals)
    numbers: list[Any] = [
        (s, (order, []), (float(t.fixed or 0.0), [])) for (s, order), t in zip(terms, item.terms, strict=True)
    ]
    return output, (alpha, []), numbers


def check_regular(run: Run, model: Solved) -> None:
    """Raise ModelError for nonuniform samples."""
    if has_own_times(run, model.structure):
        output = model.outputs[model.structure.sticks[0]]
        raise ModelError(
            f"run {run.name!r} has rows at times of their own, and the equation of {output} has friction, "
            "which is followed at regular times; resample the run yourself"
        )


#: First refinement of the record's grid, doubled until converged. Two pulses per interval are the minimum for a sample
#: that is independent of a jump of a zero-order-hold input at its time.
FIRST_REFINEMENT = 2
#: Refinement of the fit of initial terms with friction. The relative error there is a few 1e-5.
FRICTION_REFINEMENT = 4
#: Difference below which two orders count as equal.
GRAIN = 1e-9
#: Distance of a power of t from that of an offset below which both are not separately identifiable. An order just above
#: an integer adds a power that one just below does not, and t^1 in an equation with D^1.0003 acts as a constant force.
STAND_IN = 0.05
#: Order of integration from which on a slope discontinuity is resolved by the pulses.
SMOOTH = 2.0
#: Relative residual of the response to an initial term on the others, below which it is collinear; the value of the
#: joint fit. Responses of an unstable model become collinear, and another value would print another fit.
SPANNED = 1e-12

Terms = Mapping[str, Mapping[float, float]]


@dataclass(frozen=True)
class Sampled:
    """Output samples of a simulation.

    Parameters
    ----------
    outputs
        Shape (outputs, N), filtered for outputs measured through the sensor filter; not finite if the model diverges.
        At the samples of the run, or at its nonuniform sample times.
    initial
        Coefficients of the initial terms, by output and exponent.
    refinement
        Pulses per sampling interval on the finest grid.
    change
        Change on halving the step, relative to the largest value of each output; infinite before there are three grids.
    """

    outputs: Floats
    initial: dict[str, dict[float, float]]
    refinement: int
    change: Floats


def initial_exponents(item: Equation, initial: Initial, offset: Offset, states: int = 0) -> list[float]:
    """Exponents of initial terms and offset of an equation with fixed orders, distinct and ascending.

    Those of the states of a sensor filter are -1, -2 and so on.
    """
    alpha = item.order.constant
    found = {round(e, 9) for e in offset_exponents(alpha, offset).values()} | {-1.0 - k for k in range(states)}
    if initial != "caputo":
        return sorted(found | ({round(e, 9) for e in initial} if not isinstance(initial, str) else set()))
    left: set[float] = set()
    for lowest, order in [(0.0, alpha), *((alpha - t.order.constant, t.order.constant) for t in item.terms)]:
        left |= {round(lowest + i, 9) for i in range(math.ceil(order - GRAIN))}
    return sorted(found | {e for e in left if e == 0.0 or all(abs(e - o) > STAND_IN for o in found)})


def begun_terms(model: Solved, found: Mapping[str, Any]) -> dict[str, dict[float, float]]:
    """Return initial terms by output and exponent from a single-run fit with friction."""
    return {o: dict(terms) for o, terms in zip(model.outputs, found["powers"][0], strict=True)}


def own_times(model: Solved, run: Run) -> Floats | None:
    """Return the times of the compared samples of a run [s] if they are nonuniform, else None."""
    return compared_times(run, model.structure) if has_own_times(run, model.structure) else None


def started(model: Solved, run: Run) -> Solved:
    """Return the model with initial conditions resolved on a run: Caputo's unless the samples require a history."""
    start = decided(run, model.structure)
    long = replace(model, structure=replace(model.structure, initial=start))
    if model.structure.initial != "auto" or not isinstance(start, History):
        return long
    short = replace(model, structure=replace(model.structure, initial="caputo"))
    try:
        measured = measured_samples(model, run, FIRST_REFINEMENT)
        times = own_times(model, run)
        (few, ours), (many, theirs) = (sampled(each, run, FIRST_REFINEMENT, None, times) for each in (short, long))
    except ModelError:
        # The coarse grid makes the equations unsolvable; finer ones need not.
        return long
    more = sum(map(len, theirs.values())) - sum(map(len, ours.values()))
    sizes = np.nanstd(measured, axis=1).tolist()
    excess = misfit_of_fits([*missed(measured, few)], [*missed(measured, many)], sizes)
    return long if needed(model.structure, excess, more) else short


def sampled(
    model: Solved, run: Run, every: int, initial: Terms | None, times: Floats | None = None
) -> tuple[Floats, dict[str, dict[float, float]]]:
    """Return samples (outputs, N) on ``every`` pulses per sampling interval, and initial terms; may be not finite.

    At the sample times of the grid, or at given times [s].
    """
    rec = record(run, model.structure, (run.length - 1) * every, filtered=model.structure.behind_filter)
    at = None if times is None else Instants.of(run, rec, model.structure, times)
    if initial is not None:
        kept = {o: dict(initial.get(o, {})) for o in model.outputs}
        return _read(model, run, rec, every, _responses(model, rec, kept), kept, at), kept
    if model.structure.has_friction:
        kept = begun_terms(model, begun(model, run, rec, every))
        return _read(model, run, rec, every, _responses(model, rec, kept), kept, at), kept
    names = initial_names(model, rec.initial)
    none: dict[str, dict[float, float]] = {o: {} for o in model.outputs}
    if not names:
        return _read(model, run, rec, every, _responses(model, rec, none), none, at), none
    free, units = _free_and_units(model, rec, names)
    driven = _read(model, run, rec, every, free, none, at)
    if not np.all(np.isfinite(driven)):
        return driven, none
    columns = _columns(model, rec, every, names, units, at)
    return fitted(model, measured_samples(model, run, every, rec), driven, names, columns)


def initial_names(model: Solved, initial: Initial) -> list[tuple[str, float]]:
    """Return output and power of every initial term and offset for given initial conditions."""
    structure = model.structure
    states = structure.filter_states(initial)
    return [
        (e.output, power)
        for e in model.equations
        for power in initial_exponents(e, initial, structure.offset, states if structure.held_back(e.output) else 0)
    ]


def unit_samples(model: Solved, run: Run, every: int, names: Sequence[tuple[str, float]]) -> list[Floats]:
    """Return samples of all outputs for unit initial terms, by output and power, without inputs."""
    rec = record(run, model.structure, (run.length - 1) * every, filtered=model.structure.behind_filter)
    return _columns(model, rec, every, names, _free_and_units(model, rec, names)[1], None)


def _columns(
    model: Solved,
    rec: Record,
    every: int,
    names: Sequence[tuple[str, float]],
    units: Sequence[Floats],
    at: Instants | None,
) -> list[Floats]:
    """Return samples for unit initial terms from their pulse means."""
    none: dict[str, dict[float, float]] = {o: {} for o in model.outputs}
    still = replace(rec, means=np.zeros_like(rec.means))
    return [
        _read(model, None, still, every, means, {**none, output: {power: 1.0}}, at)
        for (output, power), means in zip(names, units, strict=True)
    ]


def measured_samples(model: Solved, run: Run, every: int, rec: Record | None = None) -> Floats:
    """Return the samples to compare with, shape (outputs, N): as measured, or filtered if the equation is.

    NaN at missing samples of an output.
    """
    through = model.structure.measured_through
    if not model.structure.behind_filter or all(map(through, model.outputs)):
        return np.stack([compared_values(run, model.structure, name) for name in model.outputs])
    rec = rec or record(run, model.structure, (run.length - 1) * every)
    return np.stack([run[n] if through(n) else _core.point_samples(rec.of(n))[::every] for n in model.outputs])


def fitted(
    model: Solved, measured: Floats, driven: Floats, names: Sequence[tuple[str, float]], columns: Sequence[Floats]
) -> tuple[Floats, dict[str, dict[float, float]]]:
    """Fit initial terms to measured samples by least squares; return the simulation with them, and the terms."""
    deviation = np.nanstd(measured, axis=1, keepdims=True)
    # What was not read weighs nothing.
    unread = np.isnan(measured)
    weight = np.where(unread, 0.0, 1.0 / np.where(deviation > 0, deviation, 1.0))
    measured = np.where(unread, 0.0, measured)
    with np.errstate(over="ignore", invalid="ignore"):
        basis = np.stack([(weight * c).ravel() for c in columns], axis=1)
        sizes = np.linalg.norm(basis, axis=0)
    usable = np.isfinite(sizes) & (sizes > 0)
    scaled = basis[:, usable] / sizes[usable]
    x = np.zeros(len(names))
    x[usable] = solved(scaled, (weight * (measured - driven)).ravel(), SPANNED) / sizes[usable]
    terms: dict[str, dict[float, float]] = {o: {} for o in model.outputs}
    total = driven.copy()
    for (output, power), value, column in zip(names, x.tolist(), columns, strict=True):
        terms[output][power] = value
        if value:
            total += value * column
    return total, terms


def _responses(model: Solved, rec: Record, terms: Terms) -> Floats:
    """Return pulse means of the outputs before the sensor filter: coupled, or each with the measured others as inputs.

    Impulses (-1, -2, ...) represent the initial state of the sensor filter.
    """
    if model.structure.has_friction:
        return motion_with_friction(model, rec, [sorted(terms[o].items()) for o in model.outputs])["outputs"]
    equations = [equation_tuple(e, rec.signals) for e in model.equations]
    powers = [sorted(terms[o].items()) for o in model.outputs]
    inputs, core = list(rec.inputs), rec.begun()
    if model.structure.coupling == "simulated":
        return _core.respond(core, equations, inputs, powers)
    return np.concatenate([_core.respond(core, [e], inputs, [p]) for e, p in zip(equations, powers, strict=True)])


def _free_and_units(model: Solved, rec: Record, names: Sequence[tuple[str, float]]) -> tuple[Floats, list[Floats]]:
    """Return pulse means of all outputs before the sensor filter: from rest, and for a unit of each initial term.

    A unit (output, power) acts without inputs.
    """
    equations = [equation_tuple(e, rec.signals) for e in model.equations]
    inputs, outputs, core = list(rec.inputs), model.outputs, rec.begun()
    if model.structure.coupling == "simulated":
        asked = [(outputs.index(output), power) for output, power in names]
        free, rows = _core.respond_and_units(core, equations, inputs, asked)
        return free, list(rows.reshape(len(names), len(outputs), rec.m))
    # Each equation alone: an initial term moves its own output.
    free, units = np.zeros((len(outputs), rec.m)), [np.zeros((len(outputs), rec.m)) for _ in names]
    for i, (output, item) in enumerate(zip(outputs, equations, strict=True)):
        own = [k for k, name in enumerate(names) if name[0] == output]
        if not own:
            free[i] = _core.respond(core, [item], inputs, [[]])[0]
            continue
        alone, rows = _core.respond_and_units(core, [item], inputs, [(0, names[k][1]) for k in own])
        free[i] = alone[0]
        for k, row in zip(own, rows, strict=True):
            units[k][i] = row
    return free, units


def _read(
    model: Solved, run: Run | None, rec: Record, every: int, means: Floats, terms: Terms, at: Instants | None
) -> Floats:
    """Return samples from pulse means: integrals from the left, direct feedthrough with its value at the sample.

    The last two pulses before each sample time are extrapolated to it. No jump of a zero-order-hold input lies in them,
    so the extrapolation crosses no slope discontinuity t^alpha of a jump. At nonuniform sample times, between which
    jumps may lie anywhere, samples follow from the pulses around them and the kink correction.
    """
    names, structure = model.outputs, model.structure
    coupled = structure.coupling == "simulated"
    count = rec.m // every + 1 if at is None else at.times.size
    system, now = np.eye(len(names)), np.zeros((len(names), count))
    # Made where something feeds through: it is as long as the grid.
    drive: Floats | None = None
    start = np.zeros(len(names))
    for i, item in enumerate(model.equations):
        start[i] = terms[item.output].get(0.0, 0.0)
        if rec.sensor is not None and structure.sensor_filter is not None:
            # The whole equation passes the filter, and so does what its output starts from: of all powers of t, and of
            # impulses as powers below, the one that the filter makes a jump of.
            degree = structure.sensor_filter.relative_degree
            start[i] = terms[item.output].get(-float(degree), 0.0) * leading_gain(structure.sensor_filter)
        for term in item.terms:
            if abs(term.order.constant - item.order.constant) > GRAIN:
                continue
            factor = float(term.fixed or 0.0)
            if coupled and term.signal in names:
                system[i, names.index(term.signal)] -= factor
            elif run is not None:
                drive = np.zeros_like(means) if drive is None else drive
                drive[i] += factor * rec.of(term.signal)
                now[i] += factor * _at_instants(run, rec, structure, term.signal, every, at)
    through = np.linalg.inv(system)
    drive, now, start = None if drive is None else through @ drive, through @ now, through @ start
    with np.errstate(invalid="ignore", over="ignore"):
        rest = means if drive is None else means - drive
        gain, held = np.ones(len(names)), np.zeros(len(names))
        series = sensor_series(structure, rec.m, rec.step) if rec.sensor is None else None
        if series is not None and structure.sensor_filter is not None:
            rest = means.copy() if drive is None else rest
            for i, name in enumerate(names):
                if structure.measured_through(name) and np.all(np.isfinite(means[i])):
                    gain[i] = high_frequency_gain(structure.sensor_filter)
                    # What the filter of this output still held, of impulses as powers below.
                    if degree := structure.sensor_filter.relative_degree:
                        held[i] = terms[name].get(-float(degree), 0.0) * leading_gain(structure.sensor_filter)
                    rest[i] = _core.series_multiply(series, means[i], rec.m)
                    if drive is not None:
                        rest[i] -= gain[i] * drive[i]
        if at is not None:
            kinks = through @ _kinks(model, run, at, terms)
            kinks[gain != 1.0] = 0.0
            # At the very start nothing has been integrated yet.
            begun = np.where(at.times > 0.0, _finite_readings(rest, at) + kinks, (gain * start + held)[:, None])
            return np.asarray(begun + gain[:, None] * now)
        # On one pulse an interval what is asked for lies far behind its start, see long.py.
        earlier = rest[:, every - 2 :: every] if every > 1 else np.concatenate([rest[:, :1], rest[:, :-1]], axis=1)
        later = 1.5 * rest[:, every - 1 :: every] - 0.5 * earlier
        if any(t.order.constant > e.order.constant + GRAIN for e in model.equations for t in e.terms):
            # A term above its equation's order differentiates, nearly as Tustin's rule does at one above: pulses carry
            # a part that changes its sign from one to the next, which those on both sides of an instant take away.
            later[:, :-1] = 0.5 * (rest[:, every - 1 : -1 : every] + rest[:, every::every])
            if run is not None:
                later[:, :-1] -= np.where(gain == 1.0, 1.0, 0.0)[:, None] * _early(model, run, rec, every)
            later[:, -1] = rest[:, -1] + 0.5 * rest[:, -2] - 0.5 * rest[:, -3]
        return np.concatenate([(gain * start + held)[:, None], later], axis=1) + gain[:, None] * now


def _early(model: Solved, run: Run, rec: Record, every: int) -> Floats:
    """Early part of the mean of the pulses on either side of each inner sample, shape (outputs, N - 2).

    It is half of the response of the first pulse after a jump or a corner of the inputs, of which only the direct gain
    acts at the sample, as in the joint fit.
    """
    names, structure, count = model.outputs, model.structure, len(model.outputs)
    coupled = structure.coupling == "simulated"
    halves: dict[str, Floats] = {}
    answered: tuple[Floats, dict[str, Floats]] = (np.eye(count), {})
    direct: tuple[Floats, dict[str, Floats]] = (np.eye(count), {})
    for i, item in enumerate(model.equations):
        for term in item.terms:
            name, factor = term.signal, float(term.fixed or 0.0)
            eta = item.order.constant - term.order.constant
            own = name == item.output or (coupled and name in names)
            if not own and (name not in run or (rec.sensor is not None and not structure.measured_through(name))):
                # It was made smooth, or is known by its means alone.
                continue
            for (between, driven), leading in ((answered, _first(eta, rec.step)), (direct, float(abs(eta) <= GRAIN))):
                if own:
                    between[i, names.index(name)] -= factor * leading
                else:
                    driven.setdefault(name, np.zeros(count))[i] += factor * leading
            if not own and name not in halves:
                means = rec.of(name)
                told = 0.5 * (means[every - 1 : -1 : every] + means[every::every])
                values = _at_instants(run, rec, structure, name, every, None)[1:-1]
                held = name in run.inputs and run.intersample[name] == "zoh"
                halves[name] = values - told if held else told - values
    out = np.zeros((count, rec.m // every - 1))
    for name, half in halves.items():
        gains = [np.linalg.solve(between, driven[name]) for between, driven in (answered, direct)]
        out += np.outer(gains[0] - gains[1], half)
    return out


def _first(eta: float, step: float) -> float:
    """Response within its own pulse of a term integrated by eta; below 0 by the reciprocal scheme."""
    value: float = step ** abs(eta) / math.gamma(abs(eta) + 2.0)
    return value if eta >= 0.0 else 1.0 / value


def _finite_readings(rest: Floats, at: Instants) -> Floats:
    """Interpolate smooth signals at the sample times; not finite from an overflow on."""
    return _core.read_at(np.ascontiguousarray(rest), at.places)


def _kinks(model: Solved, run: Run | None, at: Instants, terms: Terms) -> Floats:
    """Kink correction at the sample times: slope discontinuities of input jumps and of initial terms.

    It includes the direct path of a jump and one pass through the output's own terms, as in the joint fit.
    """
    names, coupled = model.outputs, model.structure.coupling == "simulated"
    out = np.zeros((len(names), at.times.size))
    for i, item in enumerate(model.equations):
        for power, value in terms[item.output].items():
            if value and power != round(power):
                jump = (np.zeros(1), np.array([value * math.gamma(power + 1.0)]))
                out[i] += _core.corners(at.record.m, at.places, jump, power, at.record.step)
        own = [t for t in item.terms if t.signal == item.output]
        for term in item.terms if run is not None else ():
            if term.signal == item.output or (coupled and term.signal in names):
                continue
            for path in ([term], *([term, other] for other in own)):
                order = sum(item.order.constant - t.order.constant for t in path)
                if order <= GRAIN or (len(path) > 1 and order >= SMOOTH):
                    continue
                known = at.corners(term.signal, order)
                if known is not None:
                    out[i] += math.prod(float(t.fixed or 0.0) for t in path) * known
    return out


def high_frequency_gain(sensor: SensorFilter) -> float:
    """Gain of a sensor filter for a jump: 0 unless numerator and denominator have the same order."""
    highest = max(order for coefficient, order in sensor.denominator if coefficient)
    top, bottom = (sum(c for c, order in part if order == highest) for part in (sensor.numerator, sensor.denominator))
    return top / bottom


def leading_gain(sensor: SensorFilter) -> float:
    """Jump of a sensor filter's response to the lowest derivative of an impulse that gives one, else 0."""
    orders = [max((o for c, o in part if c), default=0.0) for part in (sensor.numerator, sensor.denominator)]
    if abs(orders[1] - orders[0] - sensor.relative_degree) > GRAIN:
        return 0.0
    top, bottom = (
        sum(c for c, o in part if o == highest)
        for part, highest in zip((sensor.numerator, sensor.denominator), orders, strict=True)
    )
    return top / bottom


def _at_instants(run: Run, rec: Record, structure: Structure, name: str, every: int, at: Instants | None) -> Floats:
    """Values of a signal just after the sample times."""
    if at is not None:
        values = at.values(name)
        return _core.read_at(rec.of(name)[None], at.places)[0] if values is None else values
    delay = structure.delay.get(name, 0.0)
    filtered = rec.sensor is not None and not structure.measured_through(name)
    if not delay and not filtered:
        # Between two pulses there may be a corner, which their mean rounds off.
        return driving(run, structure, name)[name]
    means = rec.of(name)
    if filtered or run.intersample.get(name) != "zoh":
        return _core.point_samples(means)[::every]
    return np.append(means[::every], means[-1])


#: Significance level of the test of rest for runs whose first values are near zero, which is rare in motion and common
#: at rest. At 0.001 initial conditions that bias orders by five standard errors are missed. At 0.05 one in twenty runs
#: from rest is rejected.
RARE = 0.01


#: Nonzero initial conditions are reported if a history reduces the residual to this ratio, by at least this drop, and
#: to at most this value, all in standard deviations of the output. A model with a larger residual from rest than the
#: last value is not conclusive.
HALVES, POINTS, FOLLOWS, MISSES = 0.5, 0.01, 0.2, 3.0


@dataclass(frozen=True)
class Left:
    """Residuals of a run from rest and with a history, one row per output.

    ``terms`` is the number of terms of the history, ``sizes`` are the standard deviations of the outputs.
    """

    rest: Floats
    past: Floats
    terms: int
    sizes: Floats


def in_motion(structure: Structure, runs: Sequence[Run]) -> bool:
    """Whether the residuals of a model from rest, on all runs together, require a history."""
    left = []
    for run in runs:
        if (one := _left(structure, run)) is None:
            return False
        left.append(one)
    return _asks(left)


def _asks(left: Sequence[Left]) -> bool:
    """Whether all runs together require a history."""
    terms = sum(one.terms for one in left)
    excess = sum(misfit([*one.rest], [*one.past], one.sizes.tolist()) for one in left)
    # Noise that is coloured is followed by slow terms in any run.
    spread = max([1.0, *(colour(read(past)) for one in left for past in one.past)])
    return terms > 0 and excess / spread > chi_squared(terms, RARE)


def _left(structure: Structure, run: Run) -> Left | None:
    """Residuals of simulations from rest and with a history; None if they are not finite."""
    ends, terms = [], 0
    for start in ("rest", history(run, structure)):
        model = Solved(replace(structure, initial=start))
        try:
            samples, found = sampled(model, run, FIRST_REFINEMENT, None, own_times(model, run))
        except FtlmError:
            return None
        if not np.all(np.isfinite(samples)):
            return None
        ends.append(missed(measured_samples(model, run, FIRST_REFINEMENT), samples))
        terms = sum(map(len, found.values()))
    return Left(ends[0], ends[1], terms, np.nanstd([run[o] for o in structure.outputs], axis=1))


def looked_like_rest(model: Solved, runs: Sequence[Run]) -> list[str]:
    """Return names of the runs that start near zero but had nonzero initial conditions."""
    structure = model.structure
    if structure.initial != "auto" or structure.has_friction or not has_memory(structure):
        return []
    looked = ((run.name, _left(structure, run)) for run in runs if decided(run, structure) == "rest")
    return [name for name, left in looked if left is not None and _told_by(left) and _asks([left])]


def _told_by(left: Left) -> bool:
    """Whether a model explains a run with a history, and not from rest, by enough for a report."""
    rest, past = (np.sqrt(np.nanmean(end**2, axis=1)) / left.sizes for end in (left.rest, left.past))
    return bool(np.any((past <= HALVES * rest) & (rest - past >= POINTS) & (past <= FOLLOWS) & (rest <= MISSES)))
