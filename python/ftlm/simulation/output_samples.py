"""Simulation of equations with friction, and their initial conditions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ftlm import _core
from ftlm.data.run import Run
from ftlm.data.sampling import drop_missing
from ftlm.errors import FtlmError, ModelError
from ftlm.model.model import Model
from ftlm.simulation.discretization import (
    Record,
    SampleTimes,
    compared_times,
    compared_values,
    equation_tuple,
    has_nonuniform_samples,
    linear_tuple,
    record,
    recording,
    sensor_series,
)
from ftlm.simulation.initial_conditions import (
    has_memory,
    history,
    misfit,
    needs_history,
    output_residuals,
    resolve_initial_conditions,
    resolve_start,
    rest_evidence,
)
from ftlm.structure.equation import Equation, Friction
from ftlm.structure.sensor_filter import SensorFilter
from ftlm.structure.structure import History, Initial, Offset, Structure, offset_exponents
from ftlm.utils.linalg import minimum_norm_solution
from ftlm.utils.statistics import chi_squared, variance_inflation
from ftlm.utils.validation import Floats

#: Maximum number of evaluations for level, velocity and offset of a run, and relative change of the cost that
#: terminates.
MAX_EVALUATIONS = 60
COST_TOLERANCE = 1e-12


def motion_with_friction(model: Model, rec: Record, powers: Sequence[Sequence[tuple[float, float]]]) -> _core._Motion:
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
    frictions = [(i, friction_parameters(model.equations[i])) for i in model.structure.friction_equations]
    return _core.friction_respond(rec.core(), equations, frictions, [list(terms) for terms in powers])


def friction_parameters(item: Equation) -> tuple[float, float, float]:
    """Friction parameters fc, fs and vs of an equation."""
    return (item.friction or Friction(0.0)).law


def fit_initial_terms_with_friction(
    model: Model, run: Run, rec: Record, every: int, near: list[float] | None = None
) -> dict[str, Any]:
    """Fit initial terms and offsets of a simulation with friction, ``every`` pulses per sampling interval.

    They affect when a body sticks and slides, so they are found by optimization, from level and velocity at the start
    of the run or from nearby states.

    Returns
    -------
    dict
        As the core's joint fit, without anything free: ``states``, and ``powers``, their (exponent, coefficient) by run
        and equation.
    """
    check_uniform_samples(run, model)
    samples = np.stack([run[name] for name in model.outputs])
    known = ~np.isnan(samples)
    sizes = np.nanstd(samples, axis=1)
    shares: Floats | None = None
    if not known.all():
        shares = np.ascontiguousarray(np.where(known[:, 1:-1], 1.0, 0.0))
    structure = model.structure
    series = sensor_series(structure, rec.m, rec.step)
    filtered = None if series is None else (series, [structure.is_filtered(o) for o in model.outputs])
    experiment: _core._Experiment = {
        "record": rec.core(),
        "pulses_per_sample": every,
        "samples": np.where(known, samples, 0.0),
        "filter": filtered,
        "weights": [1.0 / s if s > 0 else 1.0 for s in sizes.tolist()],
        "signals": [(None, False)] * len(rec.signals),
        "robust_weights": shares,
        "sample_times": None,
    }
    laws = [fixed_equation(item, rec.signals) for item in model.equations]
    frictions: list[tuple[int, list[tuple[float, list[Any]]]]] = [
        (i, [(x, []) for x in friction_parameters(model.equations[i])]) for i in structure.friction_equations
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
        MAX_EVALUATIONS,
        COST_TOLERANCE,
    )


def fixed_equation(item: Equation, signals: Sequence[str]) -> tuple[int, tuple[float, list[float]], list[Any]]:
    """Return an identified equation as the core's equation with free parameters, all of them fixed."""
    output, alpha, terms = linear_tuple(item, signals)
    numbers: list[Any] = [
        (s, (order, []), (float(t.fixed or 0.0), [])) for (s, order), t in zip(terms, item.terms, strict=True)
    ]
    return output, (alpha, []), numbers


def check_uniform_samples(run: Run, model: Model) -> None:
    """Raise ModelError for nonuniform samples."""
    if has_nonuniform_samples(run, model.structure):
        output = model.outputs[model.structure.friction_equations[0]]
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
ORDER_TOLERANCE = 1e-9
#: Distance of a power of t from that of an offset below which both are not separately identifiable. An order just above
#: an integer adds a power that one just below does not, and t^1 in an equation with D^1.0003 acts as a constant force.
OFFSET_POWER_TOLERANCE = 0.05
#: Order of integration from which on a slope discontinuity is resolved by the pulses.
SMOOTH_INTEGRATION_ORDER = 2.0
#: Relative residual of the response to an initial term on the others, below which it is collinear; the value of the
#: joint fit. Responses of an unstable model become collinear, and another value would print another fit.
COLLINEARITY_TOLERANCE = 1e-12

Terms = Mapping[str, Mapping[float, float]]
#: Exponent under which the level of an output stands among its initial terms: it follows them, and is no power of t.
LEVEL_EXPONENT = math.inf


@dataclass(frozen=True)
class OutputSamples:
    """Output samples of a simulation.

    Parameters
    ----------
    outputs
        Shape (outputs, N), filtered for outputs measured through the sensor filter; not finite if the model diverges.
        At the samples of the run, or at its nonuniform sample times.
    initial
        Coefficients of the initial terms, by output and exponent.
    refinement
        Pulses per sampling interval on the finest grid; 1 for an exact simulation.
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
        left |= {round(lowest + i, 9) for i in range(math.ceil(order - ORDER_TOLERANCE))}
    return sorted(found | {e for e in left if e == 0.0 or all(abs(e - o) > OFFSET_POWER_TOLERANCE for o in found)})


def friction_initial_terms(model: Model, found: Mapping[str, Any]) -> dict[str, dict[float, float]]:
    """Return initial terms by output and exponent from a single-run fit with friction."""
    return {o: dict(terms) for o, terms in zip(model.outputs, found["powers"][0], strict=True)}


def nonuniform_sample_times(model: Model, run: Run) -> Floats | None:
    """Return the times of the compared samples of a run [s] if they are nonuniform, else None."""
    return compared_times(run, model.structure) if has_nonuniform_samples(run, model.structure) else None


def with_initial_conditions(model: Model, run: Run) -> Model:
    """Return the model with initial conditions resolved on a run: Caputo's unless the samples require a history."""
    model = replace(model, structure=resolve_start([run], model.structure))
    start = resolve_initial_conditions(run, model.structure)
    long = replace(model, structure=replace(model.structure, initial=start))
    if model.structure.initial != "auto" or not isinstance(start, History):
        return long
    short = replace(model, structure=replace(model.structure, initial="caputo"))
    try:
        measured = measured_samples(model, run, FIRST_REFINEMENT)
        times = nonuniform_sample_times(model, run)
        (few, ours), (many, theirs) = (
            simulate_samples(each, run, FIRST_REFINEMENT, None, times) for each in (short, long)
        )
    except ModelError:
        # The coarse grid makes the equations unsolvable; finer ones need not.
        return long
    terms = sum(map(len, ours.values())), sum(map(len, theirs.values()))
    residuals = [*output_residuals(measured, few)], [*output_residuals(measured, many)]
    sizes = np.nanstd(measured, axis=1).tolist()
    return long if needs_history(model.structure, *residuals, sizes, terms) else short


def simulate_samples(
    model: Model, run: Run, every: int, initial: Terms | None, times: Floats | None = None
) -> tuple[Floats, dict[str, dict[float, float]]]:
    """Return samples (outputs, N) on ``every`` pulses per sampling interval, and initial terms; may be not finite.

    At the sample times of the grid, or at given times [s].
    """
    rec = record(run, model.structure, (run.length - 1) * every, filtered=model.structure.all_filtered)
    at = None if times is None else SampleTimes.of(run, rec, model.structure, times)
    if initial is not None:
        kept = {o: dict(initial.get(o, {})) for o in model.outputs}
        return _samples_from_pulses(model, run, rec, every, _responses(model, rec, kept), kept, at), kept
    if model.structure.has_friction:
        kept = friction_initial_terms(model, fit_initial_terms_with_friction(model, run, rec, every))
        return _samples_from_pulses(model, run, rec, every, _responses(model, rec, kept), kept, at), kept
    names = initial_names(model, rec.initial)
    none: dict[str, dict[float, float]] = {o: {} for o in model.outputs}
    if not names and model.structure.offset != "level":
        return _samples_from_pulses(model, run, rec, every, _responses(model, rec, none), none, at), none
    free, units = _free_and_units(model, rec, names)
    driven = _samples_from_pulses(model, run, rec, every, free, none, at)
    if not np.all(np.isfinite(driven)):
        return driven, none
    columns = _columns(model, rec, every, names, units, at)
    return fit_initial_terms(model, measured_samples(model, run, every, rec), driven, names, columns)


def initial_names(model: Model, initial: Initial) -> list[tuple[str, float]]:
    """Return output and power of every initial term and offset for given initial conditions."""
    structure = model.structure
    states = structure.filter_states(initial)
    return [
        (e.output, power)
        for e in model.equations
        for power in initial_exponents(
            e, initial, structure.offset, states if structure.has_filter_transient(e.output) else 0
        )
    ]


def unit_samples(model: Model, run: Run, every: int, names: Sequence[tuple[str, float]]) -> list[Floats]:
    """Return samples of all outputs for unit initial terms, by output and power, without inputs."""
    rec = record(run, model.structure, (run.length - 1) * every, filtered=model.structure.all_filtered)
    return _columns(model, rec, every, names, _free_and_units(model, rec, names)[1], None)


def _columns(
    model: Model,
    rec: Record,
    every: int,
    names: Sequence[tuple[str, float]],
    units: Sequence[Floats],
    at: SampleTimes | None,
) -> list[Floats]:
    """Return samples for unit initial terms from their pulse means."""
    none: dict[str, dict[float, float]] = {o: {} for o in model.outputs}
    still = replace(rec, means=np.zeros_like(rec.means))
    return [
        _samples_from_pulses(model, None, still, every, means, {**none, output: {power: 1.0}}, at)
        for (output, power), means in zip(names, units, strict=True)
    ]


def measured_samples(model: Model, run: Run, every: int, rec: Record | None = None) -> Floats:
    """Return the samples to compare with, shape (outputs, N): as measured, or filtered if the equation is.

    NaN at missing samples of an output.
    """
    through = model.structure.is_filtered
    if not model.structure.all_filtered or all(map(through, model.outputs)):
        return np.stack([compared_values(run, model.structure, name) for name in model.outputs])
    rec = rec or record(run, model.structure, (run.length - 1) * every)
    return np.stack([run[n] if through(n) else _core.point_samples(rec.of(n))[::every] for n in model.outputs])


def fit_initial_terms(
    model: Model, measured: Floats, driven: Floats, names: Sequence[tuple[str, float]], columns: Sequence[Floats]
) -> tuple[Floats, dict[str, dict[float, float]]]:
    """Fit initial terms to measured samples by least squares; return the simulation with them, and the terms.

    The level of an output, which no equation sees, is one more term.
    """
    if model.structure.offset == "level":
        names = [*names, *((o, LEVEL_EXPONENT) for o in model.outputs)]
        ones = np.ones(measured.shape[1])
        columns = [*columns, *(np.outer(row, ones) for row in np.eye(len(model.outputs)))]
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
    x[usable] = (
        minimum_norm_solution(scaled, (weight * (measured - driven)).ravel(), COLLINEARITY_TOLERANCE) / sizes[usable]
    )
    terms: dict[str, dict[float, float]] = {o: {} for o in model.outputs}
    total = driven.copy()
    for (output, power), value, column in zip(names, x.tolist(), columns, strict=True):
        terms[output][power] = value
        if value:
            total += value * column
    return total, terms


def _responses(model: Model, rec: Record, terms: Terms) -> Floats:
    """Return pulse means of the outputs before the sensor filter: coupled, or each with the measured others as inputs.

    Impulses (-1, -2, ...) represent the initial state of the sensor filter.
    """
    if model.structure.has_friction:
        return motion_with_friction(model, rec, [sorted(terms[o].items()) for o in model.outputs])["outputs"]
    equations = [equation_tuple(e, rec.signals) for e in model.equations]
    powers = [sorted(terms[o].items()) for o in model.outputs]
    inputs, core = list(rec.inputs), rec.core_with_transients()
    if model.structure.coupling == "simulated":
        return _core.respond(core, equations, inputs, powers)
    return np.concatenate([_core.respond(core, [e], inputs, [p]) for e, p in zip(equations, powers, strict=True)])


def _free_and_units(model: Model, rec: Record, names: Sequence[tuple[str, float]]) -> tuple[Floats, list[Floats]]:
    """Return pulse means of all outputs before the sensor filter: from rest, and for a unit of each initial term.

    A unit (output, power) acts without inputs.
    """
    equations = [equation_tuple(e, rec.signals) for e in model.equations]
    inputs, outputs, core = list(rec.inputs), model.outputs, rec.core_with_transients()
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


def _samples_from_pulses(
    model: Model, run: Run | None, rec: Record, every: int, means: Floats, terms: Terms, at: SampleTimes | None
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
            if abs(term.order.constant - item.order.constant) > ORDER_TOLERANCE:
                continue
            factor = float(term.fixed or 0.0)
            if coupled and term.signal in names:
                system[i, names.index(term.signal)] -= factor
            elif run is not None:
                drive = np.zeros_like(means) if drive is None else drive
                drive[i] += factor * rec.of(term.signal)
                now[i] += factor * _values_at_samples(run, rec, structure, term.signal, every, at)
    through = np.linalg.inv(system)
    drive, now, start = None if drive is None else through @ drive, through @ now, through @ start
    with np.errstate(invalid="ignore", over="ignore"):
        rest = means if drive is None else means - drive
        gain, held = np.ones(len(names)), np.zeros(len(names))
        series = sensor_series(structure, rec.m, rec.step) if rec.sensor is None else None
        if series is not None and structure.sensor_filter is not None:
            rest = means.copy() if drive is None else rest
            for i, name in enumerate(names):
                if structure.is_filtered(name) and np.all(np.isfinite(means[i])):
                    gain[i] = high_frequency_gain(structure.sensor_filter)
                    # What the filter of this output still held, of impulses as powers below.
                    if degree := structure.sensor_filter.relative_degree:
                        held[i] = terms[name].get(-float(degree), 0.0) * leading_gain(structure.sensor_filter)
                    rest[i] = _core.series_multiply(series, means[i], rec.m)
                    if drive is not None:
                        rest[i] -= gain[i] * drive[i]
        if at is not None:
            kinks = through @ _kink_correction(model, run, at, terms)
            kinks[gain != 1.0] = 0.0
            # At the very start nothing has been integrated yet.
            begun = np.where(at.times > 0.0, _interpolate_smooth(rest, at) + kinks, (gain * start + held)[:, None])
            return np.asarray(begun + gain[:, None] * now)
        # On one pulse an interval what is asked for lies far behind its start, see long.py.
        earlier = rest[:, every - 2 :: every] if every > 1 else np.concatenate([rest[:, :1], rest[:, :-1]], axis=1)
        later = 1.5 * rest[:, every - 1 :: every] - 0.5 * earlier
        if any(t.order.constant > e.order.constant + ORDER_TOLERANCE for e in model.equations for t in e.terms):
            # A term above its equation's order differentiates, nearly as Tustin's rule does at one above: pulses carry
            # a part that changes its sign from one to the next, which those on both sides of an instant take away.
            later[:, :-1] = 0.5 * (rest[:, every - 1 : -1 : every] + rest[:, every::every])
            if run is not None:
                later[:, :-1] -= np.where(gain == 1.0, 1.0, 0.0)[:, None] * _early_response(model, run, rec, every)
            later[:, -1] = rest[:, -1] + 0.5 * rest[:, -2] - 0.5 * rest[:, -3]
        return np.concatenate([(gain * start + held)[:, None], later], axis=1) + gain[:, None] * now


def _early_response(model: Model, run: Run, rec: Record, every: int) -> Floats:
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
            if not own and (name not in run or (rec.sensor is not None and not structure.is_filtered(name))):
                # It was made smooth, or is known by its means alone.
                continue
            for (between, driven), leading in (
                (answered, _first_pulse_gain(eta, rec.step)),
                (direct, float(abs(eta) <= ORDER_TOLERANCE)),
            ):
                if own:
                    between[i, names.index(name)] -= factor * leading
                else:
                    driven.setdefault(name, np.zeros(count))[i] += factor * leading
            if not own and name not in halves:
                means = rec.of(name)
                told = 0.5 * (means[every - 1 : -1 : every] + means[every::every])
                values = _values_at_samples(run, rec, structure, name, every, None)[1:-1]
                held = name in run.inputs and run.intersample[name] == "zoh"
                halves[name] = values - told if held else told - values
    out = np.zeros((count, rec.m // every - 1))
    for name, half in halves.items():
        gains = [np.linalg.solve(between, driven[name]) for between, driven in (answered, direct)]
        out += np.outer(gains[0] - gains[1], half)
    return out


def _first_pulse_gain(eta: float, step: float) -> float:
    """Response within its own pulse of a term integrated by eta; below 0 by the reciprocal scheme."""
    value: float = step ** abs(eta) / math.gamma(abs(eta) + 2.0)
    return value if eta >= 0.0 else 1.0 / value


def _interpolate_smooth(rest: Floats, at: SampleTimes) -> Floats:
    """Interpolate smooth signals at the sample times; not finite from an overflow on."""
    return _core.interpolate_samples(np.ascontiguousarray(rest), at.pulse_positions)


def _kink_correction(model: Model, run: Run | None, at: SampleTimes, terms: Terms) -> Floats:
    """Kink correction at the sample times: slope discontinuities of input jumps and of initial terms.

    It includes the direct path of a jump and one pass through the output's own terms, as in the joint fit.
    """
    names, coupled = model.outputs, model.structure.coupling == "simulated"
    out = np.zeros((len(names), at.times.size))
    for i, item in enumerate(model.equations):
        for power, value in terms[item.output].items():
            if value and power != round(power):
                jump = (np.zeros(1), np.array([value * math.gamma(power + 1.0)]))
                out[i] += _core.kink_correction(at.record.m, at.pulse_positions, jump, power, at.record.step)
        own = [t for t in item.terms if t.signal == item.output]
        for term in item.terms if run is not None else ():
            if term.signal == item.output or (coupled and term.signal in names):
                continue
            for path in ([term], *([term, other] for other in own)):
                order = sum(item.order.constant - t.order.constant for t in path)
                if order <= ORDER_TOLERANCE or (len(path) > 1 and order >= SMOOTH_INTEGRATION_ORDER):
                    continue
                known = at.jump_correction(term.signal, order)
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
    if abs(orders[1] - orders[0] - sensor.relative_degree) > ORDER_TOLERANCE:
        return 0.0
    top, bottom = (
        sum(c for c, o in part if o == highest)
        for part, highest in zip((sensor.numerator, sensor.denominator), orders, strict=True)
    )
    return top / bottom


def _values_at_samples(
    run: Run, rec: Record, structure: Structure, name: str, every: int, at: SampleTimes | None
) -> Floats:
    """Values of a signal just after the sample times."""
    if at is not None:
        values = at.values(name)
        return _core.interpolate_samples(rec.of(name)[None], at.pulse_positions)[0] if values is None else values
    delay = structure.delay.get(name, 0.0)
    filtered = rec.sensor is not None and not structure.is_filtered(name)
    if not delay and not filtered:
        # Between two pulses there may be a corner, which their mean rounds off.
        return recording(run, structure, rec.initial).acting_samples(rec.signals.index(name))
    means = rec.of(name)
    if filtered or run.intersample.get(name) != "zoh":
        return _core.point_samples(means)[::every]
    return np.append(means[::every], means[-1])


#: Significance level of the test of rest for runs whose first values are near zero, which is rare in motion and common
#: at rest. At 0.001 initial conditions that bias orders by five standard errors are missed. At 0.05 one in twenty runs
#: from rest is rejected.
REST_TEST_LEVEL = 0.01


#: Nonzero initial conditions are reported if a history reduces the residual to this ratio, by at least this drop, and
#: to at most this value, all in standard deviations of the output. A model with a larger residual from rest than the
#: last value is not conclusive.
MAX_RESIDUAL_RATIO, MIN_RESIDUAL_DROP, MAX_HISTORY_RESIDUAL, MAX_REST_RESIDUAL = 0.5, 0.01, 0.2, 3.0


@dataclass(frozen=True)
class StartResiduals:
    """Residuals of a run from rest and with a history, one row per output.

    ``terms`` is the number of terms of the history, ``sizes`` are the standard deviations of the outputs.
    """

    rest: Floats
    history: Floats
    terms: int
    sizes: Floats


def is_in_motion(structure: Structure, runs: Sequence[Run]) -> bool:
    """Whether the residuals of a model from rest, on all runs together, require a history."""
    left = []
    for run in runs:
        if (one := _start_residuals(structure, run)) is None:
            return False
        left.append(one)
    return _requires_history(left)


def _requires_history(left: Sequence[StartResiduals]) -> bool:
    """Whether all runs together require a history."""
    terms = sum(one.terms for one in left)
    excess = sum(misfit([*one.rest], [*one.history], one.sizes.tolist()) for one in left)
    # Noise that is coloured is followed by slow terms in any run.
    spread = max([1.0, *(variance_inflation(drop_missing(past)) for one in left for past in one.history)])
    return terms > 0 and excess / spread > chi_squared(terms, REST_TEST_LEVEL)


def _start_residuals(structure: Structure, run: Run) -> StartResiduals | None:
    """Residuals of simulations from rest and with a history; None if they are not finite."""
    ends, terms = [], 0
    for start in ("rest", history(run, structure)):
        model = Model(replace(structure, initial=start))
        try:
            samples, found = simulate_samples(model, run, FIRST_REFINEMENT, None, nonuniform_sample_times(model, run))
        except FtlmError:
            return None
        if not np.all(np.isfinite(samples)):
            return None
        ends.append(output_residuals(measured_samples(model, run, FIRST_REFINEMENT), samples))
        terms = sum(map(len, found.values()))
    return StartResiduals(ends[0], ends[1], terms, np.nanstd([run[o] for o in structure.outputs], axis=1))


def runs_in_motion(model: Model, runs: Sequence[Run]) -> list[str]:
    """Return names of the runs that start near zero but had nonzero initial conditions."""
    structure = model.structure
    if structure.initial != "auto" or structure.has_friction or not has_memory(structure):
        return []
    looked = (
        (run.name, _start_residuals(structure, run))
        for run in runs
        if rest_evidence(run, structure) is None and resolve_initial_conditions(run, structure) == "rest"
    )
    return [name for name, left in looked if left is not None and _is_reportable(left) and _requires_history([left])]


def _is_reportable(left: StartResiduals) -> bool:
    """Whether a model explains a run with a history, and not from rest, by enough for a report."""
    # An overflow is infinite, and nothing is reported where both are.
    with np.errstate(over="ignore", invalid="ignore"):
        ends = [end / left.sizes[:, None] for end in (left.rest, left.history)]
        rest, past = (np.sqrt(np.nanmean(end**2, axis=1)) for end in ends)
        large = (past <= MAX_RESIDUAL_RATIO * rest) & (rest - past >= MIN_RESIDUAL_DROP)
    return bool(np.any(large & (past <= MAX_HISTORY_RESIDUAL) & (rest <= MAX_REST_RESIDUAL)))
