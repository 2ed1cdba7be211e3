"""Samples of simulations in NumPy, on one grid and in the limit for zero step: what the core's are compared with."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from ftlm import _core
from ftlm.data.run import Run
from ftlm.data.sampling import ZERO_ORDER_HOLD, interpolate_gaps
from ftlm.errors import ModelError
from ftlm.model.model import Model
from ftlm.simulation.discretization import (
    Record,
    apply_input_nonlinearity,
    equation_tuple,
    record,
    recording,
    sensor_series,
)
from ftlm.simulation.initial_conditions import resolve_initial_conditions
from ftlm.simulation.output_samples import (
    FIRST_REFINEMENT,
    LEVEL_EXPONENT,
    ORDER_TOLERANCE,
    OutputSamples,
    Terms,
    initial_names,
    measured_samples,
    nonuniform_sample_times,
    with_initial_conditions,
)
from ftlm.structure.sensor_filter import SensorFilter
from ftlm.structure.structure import Structure
from ftlm.utils.linalg import minimum_norm_solution
from ftlm.utils.validation import Floats

SMOOTH_INTEGRATION_ORDER, COLLINEARITY_TOLERANCE = 2.0, 1e-12


@dataclass(frozen=True)
class TransientRecord(Record):
    """Record with filter transients (of which signals), initial levels, and impulse responses of the filter."""

    has_transient: tuple[bool, ...] = ()
    initial_levels: tuple[float, ...] = ()
    filter_responses: Floats | None = None

    @classmethod
    def of_run(cls, run: Run, structure: Structure, m: int) -> TransientRecord:
        """Build for a run."""
        plain = record(run, structure, m, filtered=structure.all_filtered)
        _, _, _, (transient, levels, responses) = recording(run, structure, plain.initial).pulses(
            m, structure.all_filtered
        )
        return cls(
            **vars(plain), has_transient=tuple(transient), initial_levels=tuple(levels), filter_responses=responses
        )

    def core_with_transients(self) -> tuple:
        """The record as an argument of the core."""
        if not any(self.has_transient) and not any(self.initial_levels):
            return self.core()
        return (*self.core(), (self.has_transient, self.initial_levels, self.filter_responses))


@dataclass(frozen=True, eq=False)
class SampleTimes:
    """Sample times of a run on its grid of pulses, with the original input samples.

    Parameters
    ----------
    record
        Pulse means of the run.
    recording
        The run.
    times
        Sample times [s since the first sample].
    """

    record: Record
    recording: _core.Recording
    times: Floats

    @classmethod
    def of(cls, run: Run, record: Record, structure: Structure, times: Floats) -> SampleTimes:
        """Build for given times of a run; a uniformly sampled run has the samples of its grid."""
        return cls(record, recording(run, structure, record.initial), times)

    @property
    def pulse_positions(self) -> Floats:
        """Sample times in units of pulses."""
        return np.asarray(np.minimum(self.times / self.record.step, float(self.record.m)))

    def values(self, name: str) -> Floats | None:
        """Values of a signal just after the sample times; None for a derived signal."""
        return self.recording.values_at(self.record.signals.index(name), self.times)

    def jump_correction(self, name: str, order: float) -> Floats | None:
        """Correction to the pulse means of I^order of an input with jumps, at the sample times."""
        jumps = self.recording.jumps(self.record.signals.index(name))
        if jumps is None:
            return None
        jumps = (jumps[0] / self.record.step, jumps[1])
        return _core.kink_correction(self.record.m, self.pulse_positions, jumps, order, self.record.step)


def simulate_samples(
    model: Model, run: Run, every: int, initial: Terms | None, times: Floats | None = None
) -> tuple[Floats, dict[str, dict[float, float]]]:
    """Return samples (outputs, N) on ``every`` pulses per sampling interval, and initial terms; may be not finite.

    At the sample times of the grid, or at given times [s].
    """
    rec = TransientRecord.of_run(run, model.structure, (run.length - 1) * every)
    at = None if times is None else SampleTimes.of(run, rec, model.structure, times)
    if initial is not None:
        terms = {o: dict(initial.get(o, {})) for o in model.outputs}
        return _samples_from_pulses(model, run, rec, every, _responses(model, rec, terms), terms, at), terms
    names = initial_names(model, rec.initial)
    none: dict[str, dict[float, float]] = {o: {} for o in model.outputs}
    if not names and model.structure.offset != "level":
        return _samples_from_pulses(model, run, rec, every, _responses(model, rec, none), none, at), none
    free, units = _free_and_units(model, rec, names)
    driven = _samples_from_pulses(model, run, rec, every, free, none, at)
    if not np.all(np.isfinite(driven)):
        return driven, none
    columns = _columns(model, rec, every, names, units, at)
    return fit_initial_terms(model, measured_samples(model, run, every), driven, names, columns)


def unit_samples(model: Model, run: Run, every: int, names: Sequence[tuple[str, float]]) -> list[Floats]:
    """Return samples of all outputs for unit initial terms, by output and power, without inputs."""
    rec = TransientRecord.of_run(run, model.structure, (run.length - 1) * every)
    return _columns(model, rec, every, names, _free_and_units(model, rec, names)[1], None)


def _columns(
    model: Model,
    rec: TransientRecord,
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


def _responses(model: Model, rec: TransientRecord, terms: Terms) -> Floats:
    """Return pulse means of the outputs before the sensor filter: coupled, or each with the measured others as inputs.

    Impulses (-1, -2, ...) represent the initial state of the sensor filter.
    """
    equations = [equation_tuple(e, rec.signals) for e in model.equations]
    powers = [sorted(terms[o].items()) for o in model.outputs]
    inputs, core = list(rec.inputs), rec.core_with_transients()
    if model.structure.coupling == "simulated":
        return _core.respond(core, equations, inputs, powers)
    return np.concatenate([_core.respond(core, [e], inputs, [p]) for e, p in zip(equations, powers, strict=True)])


def _free_and_units(
    model: Model, rec: TransientRecord, names: Sequence[tuple[str, float]]
) -> tuple[Floats, list[Floats]]:
    """Pulse means of all outputs before the sensor filter: from rest, and for a unit of each initial term."""
    none: dict[str, dict[float, float]] = {o: {} for o in model.outputs}
    still = replace(rec, means=np.zeros_like(rec.means), initial_levels=(0.0,) * len(rec.signals))
    return _responses(model, rec, none), [_responses(model, still, {**none, o: {p: 1.0}}) for o, p in names]


def _samples_from_pulses(
    model: Model, run: Run | None, rec: TransientRecord, every: int, means: Floats, terms: Terms, at: SampleTimes | None
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
            factor = float(term.fixed_value or 0.0)
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
        gain, offsets = np.ones(len(names)), np.zeros(len(names))
        series = sensor_series(structure, rec.m, rec.step) if rec.sensor is None else None
        if series is not None and structure.sensor_filter is not None:
            rest = means.copy() if drive is None else rest
            for i, name in enumerate(names):
                if structure.is_filtered(name) and np.all(np.isfinite(means[i])):
                    gain[i] = high_frequency_gain(structure.sensor_filter)
                    # What the filter of this output still held, of impulses as powers below.
                    if degree := structure.sensor_filter.relative_degree:
                        offsets[i] = terms[name].get(-float(degree), 0.0) * leading_gain(structure.sensor_filter)
                    rest[i] = _core.series_multiply(series, means[i], rec.m)
                    if drive is not None:
                        rest[i] -= gain[i] * drive[i]
        if at is not None:
            kinks = through @ _kink_correction(model, run, at, terms)
            kinks[gain != 1.0] = 0.0
            # At the very start nothing has been integrated yet.
            early = np.where(at.times > 0.0, _interpolate_smooth(rest, at) + kinks, (gain * start + offsets)[:, None])
            return np.asarray(early + gain[:, None] * now)
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
        return np.concatenate([(gain * start + offsets)[:, None], later], axis=1) + gain[:, None] * now


def _early_response(model: Model, run: Run, rec: TransientRecord, every: int) -> Floats:
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
            name, factor = term.signal, float(term.fixed_value or 0.0)
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
                middles = 0.5 * (means[every - 1 : -1 : every] + means[every::every])
                values = _values_at_samples(run, rec, structure, name, every, None)[1:-1]
                is_hold = name in run.inputs and run.intersample[name] == "zoh"
                halves[name] = values - middles if is_hold else middles - values
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
                correction = at.jump_correction(term.signal, order)
                if correction is not None:
                    out[i] += math.prod(float(t.fixed_value or 0.0) for t in path) * correction
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
    run: Run, rec: TransientRecord, structure: Structure, name: str, every: int, at: SampleTimes | None
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


#: Powers of the step in the error of a sample: 2 from the block-pulse scheme, 3 from extrapolation to a sample time,
#: and 4 from the next term of both. A slope discontinuity t^eta adds powers in between, which these columns do not
#: eliminate, but none of them increases the error by more than a small factor.
ERROR_POWERS = (2, 3, 4)
#: A column has the error of its power if halving the step reduced its change by at least this fraction of 2^power.
MIN_POWER_RATIO = 0.5
#: For an unknown power: minimum reduction of the change on halving the step (slightly below the square root of two),
#: and minimum effective number of samples from which the reduction is estimated.
MIN_REDUCTION_FACTOR, MIN_EFFECTIVE_SAMPLES = 1.4, 8.0
#: Number of grids needed to estimate such a reduction factor and to test it.
RATIO_TEST_GRIDS = 4


def _relative_change(new: Floats, old: Floats) -> Floats:
    change, size = np.max(np.abs(new - old), axis=1), np.max(np.abs(new), axis=1)
    return np.asarray(np.where(change == 0.0, 0.0, change / size))


@dataclass(frozen=True)
class LimitEstimate:
    """Estimate of the limit for zero step.

    Parameters
    ----------
    samples
        Extrapolated samples.
    change
        Change of each output on another halving, relative to its largest value; infinite before there are three grids.
    initial_terms
        Extrapolated initial terms.
    """

    samples: Floats
    change: Floats
    initial_terms: Floats


@dataclass
class RichardsonTable:
    """Richardson table of grids of 1, 1/2, 1/4, … of a step; samples have the shape (outputs, N).

    Parameters
    ----------
    rows
        Last grids, finest last: the samples, then those with one power of the step after another eliminated.
    initial_terms
        The same for initial terms fitted on each grid.
    changes
        Change of each output in each column on the last two halvings, relative to its largest value; infinite for the
        samples themselves.
    measure
        Function that gives this relative change between samples on a grid and on the previous one.
    """

    rows: list[list[Floats]] = field(default_factory=list)
    initial_terms: list[list[Floats]] = field(default_factory=list)
    changes: list[list[Floats]] = field(default_factory=list)
    measure: Callable[[Floats, Floats], Floats] = _relative_change

    def add(self, samples: Floats, beside: Floats | None = None) -> None:
        """Add samples on the next grid; samples that are not finite restart the table."""
        before = self.rows[-1] if self.rows else []
        both = bool(before) and bool(np.all(np.isfinite(before[0])) and np.all(np.isfinite(samples)))
        row = extrapolate_row(samples, before if both else [])
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            # Nobody asks for the samples themselves: what was taken away moves less.
            changes = [unknown_change(samples.shape[0])] * min(len(row), len(before))
            changes[1:] = [self.measure(new, old) for new, old in zip(row[1:], before[1:], strict=False)]
        numbers = np.zeros(0) if beside is None else beside
        self.initial_terms = [*self.initial_terms, extrapolate_row(numbers, self.initial_terms[-1] if both else [])][
            -RATIO_TEST_GRIDS:
        ]
        self.rows = [*self.rows, row][-RATIO_TEST_GRIDS:]
        self.changes = [*self.changes, changes][-2:]

    def estimate(self, owners: Sequence[int] = (), *, enough: float = 0.0) -> LimitEstimate:
        """Return the estimate that another halving changes least; ``owners`` are the outputs of the initial terms.

        If the change of a column is at most ``enough``, no other estimate is tried.
        """
        column, change = self.best_column
        best = LimitEstimate(self.rows[-1][column], change, self.initial_terms[-1][column])
        if len(self.rows) < RATIO_TEST_GRIDS or np.all(change <= enough):
            return best
        count = min(map(len, self.rows))
        every = [best, *(self._by_ratio(k, np.array(owners, dtype=int)) for k in range(count))]
        return min(
            (one for one in every if one is not None), key=lambda one: float(np.max(_nan_to_infinity(one.change)))
        )

    def _by_ratio(self, column: int, owners: NDArray[np.intp]) -> LimitEstimate | None:
        """Extrapolate a column with an error of unknown power, if the previous grid gave a reduction factor as well.

        Slope discontinuities t^eta add intermediate powers, and coinciding orders add logarithms, which the table does
        not eliminate.
        """
        oldest, older, old, new = (row[column] for row in self.rows)
        second, third = (row[column] for row in self.initial_terms[-2:])
        before, now = remaining_change_ratio(oldest, older, old), remaining_change_ratio(older, old, new)
        if before is None or now is None:
            return None
        with np.errstate(invalid="ignore", over="ignore"):
            samples = new + now[:, None] * (new - old)
            change = self.measure(samples, old + before[:, None] * (old - older))
        return LimitEstimate(samples, change, third + now[owners] * (third - second))

    @property
    def best_column(self) -> tuple[int, Floats]:
        """Column that another halving changes least, and its change relative to the largest value of each output.

        Infinite before there are three grids.
        """
        row, last = self.rows[-1], self.changes[-1]
        best: tuple[int, Floats] = (len(row) - 1 if len(row) <= 2 else 1, unknown_change(row[0].shape[0]))
        for column in range(1, len(last)):
            choices = [(column, last[column])]
            before = self.changes[0][column] if len(self.changes) > 1 and column < len(self.changes[0]) else None
            if before is not None and column + 1 < len(row):
                factor = 2.0 ** ERROR_POWERS[column]
                # What is left of a column whose power shows is what the next column takes away.
                if np.all(last[column] * (MIN_POWER_RATIO * factor) <= before):
                    choices.append((column + 1, last[column] / (factor - 1.0)))
            best = min([best, *choices], key=lambda pair: float(np.max(_nan_to_infinity(pair[1]))))
        return best


def extrapolate_row(fine: Floats, coarse: Sequence[Floats]) -> list[Floats]:
    """Return a row of the table from values on a grid and the row of twice its step."""
    row = [fine]
    with np.errstate(invalid="ignore", over="ignore"):
        for power, before in zip(ERROR_POWERS, coarse, strict=False):
            factor = 2.0**power
            row.append((factor * row[-1] - before) / (factor - 1.0))
    return row


def remaining_change_ratio(older: Floats, old: Floats, new: Floats) -> Floats | None:
    """Ratio of the remaining change to the last change of each output, for changes that shrink by a constant factor.

    This is Aitken's method with one factor for all samples of an output. None if few samples change, or do not
    converge.
    """
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        now, before = new - old, old - older
        size = np.max(np.abs(now), axis=1, keepdims=True, initial=0.0)
        unit = now / np.where(size > 0.0, size, 1.0)
        squares = np.sum(unit**2, axis=1)
        still = squares == 0.0
        ratio = np.where(still, np.inf, np.sum(unit * before, axis=1) / np.where(still, 1.0, squares * size[:, 0]))
        if not np.all(ratio >= MIN_REDUCTION_FACTOR) or np.any(
            squares**2 < MIN_EFFECTIVE_SAMPLES * np.sum(unit**4, axis=1)
        ):
            return None
        return np.asarray(1.0 / (ratio - 1.0))


def unknown_change(outputs: int) -> Floats:
    """Return an infinite change of each output."""
    return np.full(outputs, np.inf)


def _nan_to_infinity(change: Floats) -> Floats:
    """Replace NaN by infinity."""
    return np.where(np.isnan(change), np.inf, change)


#: Minimum number of intervals of a long record. Below it, refinement of the whole grid costs no more.
LONG_RECORD_INTERVALS = 1 << 14
#: Pieces of a response start at its end divided by powers of this ratio, down to this minimum number of intervals.
#: Halving the step on a piece costs as much as the whole response did.
PIECE_RATIO, MIN_PIECE_INTERVALS = 8, 128
#: Pulses per interval of the grids that cover the whole response. The coarsest grid is not used for the first piece,
#: where responses jump with the inputs.
FULL_GRID_REFINEMENTS = (1, 2, 4)
#: Ratio of the second to the first half of a response above which the model is unstable and the sum loses its digits.
MAX_GROWTH_RATIO = 1e3


@dataclass
class ResponsePiece:
    """Piece of all responses, from one interval to before another, on its finest grid, and its limit for zero step."""

    first: int
    end: int
    refinement: int
    limit: RichardsonTable


@dataclass(frozen=True)
class SampleResponses:
    """Simulation as a sum of responses: to every sample of the inputs, to first samples, and to initial terms.

    Parameters
    ----------
    model
        Model from rest, without input non-linearities.
    run
        Run of which only names, step and intersample behavior are used.
    inputs
        Samples of the inputs, after input non-linearities.
    first_samples
        First samples of the signals for which they act differently from later ones.
    names
        Output and power of the initial terms.
    """

    model: Model
    run: Run
    inputs: Mapping[str, Floats]
    first_samples: Mapping[str, float]
    names: Sequence[tuple[str, float]]

    @property
    def count(self) -> int:
        """Number of outputs."""
        return len(self.model.outputs)

    @classmethod
    def of(cls, model: Model, run: Run, names: Sequence[tuple[str, float]]) -> SampleResponses | None:
        """Build for a run; None if superposition does not apply."""
        structure = model.structure
        outputs, coupled = model.outputs, structure.coupling == "simulated"
        read = [(e, t) for e in model.equations for t in e.terms]
        drivers = dict.fromkeys(
            t.signal for e, t in read if t.signal != e.output and not (coupled and t.signal in outputs)
        )
        if structure.has_friction or run.nonuniform_samples is not None or structure.all_filtered:
            return None
        if any(name not in run for name in drivers) or any(
            t.order.constant > e.order.constant + ORDER_TOLERANCE for e, t in read
        ):
            return None
        late = {name for name in drivers if structure.delay.get(name, 0.0)}
        direct = {t.signal for e, t in read if abs(t.order.constant - e.order.constant) <= ORDER_TOLERANCE}
        if late and (late & direct or resolve_initial_conditions(run, structure) != "rest"):
            # What acted before the run, and at its last sample, is no answer to one of its samples.
            return None
        every = {n: interpolate_gaps(apply_input_nonlinearity(run, structure)[n]) for n in drivers}
        moving = {n: v for n, v in every.items() if v.any()}
        ramps = [n for n in moving if n not in run.inputs or run.intersample[n] != ZERO_ORDER_HOLD]
        still = replace(model, structure=replace(structure, initial="rest", input_nonlinearities=UNSET))
        return cls(still, run, moving, {n: float(moving[n][0]) for n in ramps if moving[n][0]}, names)

    def compute(self, every: int, intervals: int) -> Floats:
        """Compute all responses on a grid, one block of rows per response; NaN if the equations are singular there."""
        try:
            return self._compute(every, intervals)
        except ModelError:
            # The grid happens to make the equations unsolvable.
            rows = len(self.inputs) + len(self.first_samples) + len(self.names)
            return np.full((rows * self.count, intervals + 1), np.nan)

    def _compute(self, every: int, intervals: int) -> Floats:
        blocks, first = [], []
        for name in self.inputs:
            ramp = name not in self.run.inputs or self.run.intersample[name] != ZERO_ORDER_HOLD
            # What is linear in between rises to a sample before it falls.
            rows = simulate_samples(self.model, self._unit(name, intervals + ramp, int(ramp)), every, {})[0]
            blocks.append(rows[:, 1:] if ramp else rows)
            if name in self.first_samples:
                first.append(simulate_samples(self.model, self._unit(name, intervals, 0), every, {})[0] - blocks[-1])
        more = unit_samples(self.model, self._unit("", intervals, 0), every, self.names) if self.names else []
        return np.concatenate([*blocks, *first, *more]) if blocks or more else np.zeros((0, intervals + 1))

    def _unit(self, name: str, intervals: int, row: int) -> Run:
        """Return a run with a single unit sample of one signal."""

        def of(signal: str) -> Floats:
            out = np.zeros(intervals + 1)
            if signal == name:
                out[row] = 1.0
            return out

        run = self.run
        return Run.from_arrays(
            step=run.step,
            inputs={n: of(n) for n in run.inputs},
            outputs={n: of(n) for n in run.outputs},
            intersample=run.intersample,
        )

    def superpose(self, answers: Floats, first: int, weights: Sequence[float]) -> Floats:
        """Superpose responses from one interval on, shape (outputs, N - first).

        The weights are those of the initial terms.
        """
        n = self.count
        blocks = answers.reshape(-1, n, answers.shape[1])
        out = np.zeros((n, self.run.length - first))
        for block, samples in zip(blocks, self.inputs.values(), strict=False):
            for i, row in enumerate(block):
                if row.any():
                    out[i] += _core.series_multiply(row, samples[: out.shape[1]], out.shape[1])
        once = blocks[len(self.inputs) :]
        for block, weight in zip(once, [*self.first_samples.values(), *weights], strict=True):
            out[:, : answers.shape[1]] += weight * block
        return out

    def split(self, answers: Floats) -> tuple[Floats, list[Floats]]:
        """Return the simulation without initial terms, and the responses to unit initial terms."""
        units = answers.reshape(-1, self.count, answers.shape[1])[len(self.inputs) + len(self.first_samples) :]
        return self.superpose(answers, 0, [0.0] * len(self.names)), list(units)


def simulate_long(
    model: Model, run: Run, initial: Terms | None, *, tolerance: float, max_m: int
) -> OutputSamples | None:
    """Simulate a long run as :func:`refined` does; None if superposition does not apply.

    The initial conditions of the model are resolved. The refinement is that of the whole record.
    """
    own = run.length - 1
    pairs = None if initial is None else [(o, p) for o in model.outputs for p in initial.get(o, {})]
    names = initial_names(model, resolve_initial_conditions(run, model.structure)) if pairs is None else pairs
    answers = SampleResponses.of(model, run, names)
    if answers is None:
        return None
    grids = {every: answers.compute(every, own) for every in FULL_GRID_REFINEMENTS}
    if not all(_decays(rows) for rows in list(grids.values())[1:]):
        return None

    def superpose_with_terms(rows: Floats) -> tuple[Floats, dict[str, dict[float, float]]]:
        driven, units = answers.split(rows)
        if initial is None and (names or model.structure.offset == "level"):
            return fit_initial_terms(
                model, measured_samples(model, run, FULL_GRID_REFINEMENTS[-1]), driven, names, units
            )
        values = {o: dict((initial or {}).get(o, {})) for o in model.outputs}
        return driven + sum((values[o][p] * u for (o, p), u in zip(names, units, strict=True)), np.zeros(1)), values

    rough, terms = superpose_with_terms(grids[FULL_GRID_REFINEMENTS[-1]])
    size = np.max(np.abs(rough), axis=1)
    weights = [terms[o][p] for o, p in names]

    def change_from(first: int) -> Callable[[Floats, Floats], Floats]:
        def relative_output_change(new: Floats, old: Floats) -> Floats:
            by = new - old
            if not np.all(np.isfinite(by)):
                return np.full(answers.count, np.inf)
            most = np.max(np.abs(answers.superpose(by, first, weights)), axis=1)
            return np.asarray(np.where(most == 0.0, 0.0, most / np.where(size > 0.0, size, 1e-300)))

        return relative_output_change

    pieces = []
    for first, end in _piece_ranges(own):
        limit = RichardsonTable(measure=change_from(first))
        for every in FULL_GRID_REFINEMENTS[0 if first else 1 :]:
            limit.add(grids[every][:, first:end])
        pieces.append(ResponsePiece(first, end, FULL_GRID_REFINEMENTS[-1], limit))
    del grids
    change = _refine_pieces(pieces, answers, tolerance, max_m)
    best = np.concatenate([p.limit.estimate().samples for p in pieces], axis=1)
    outputs, terms = superpose_with_terms(best)
    return OutputSamples(outputs, terms, pieces[-1].refinement, change)


def _refine_pieces(pieces: Sequence[ResponsePiece], answers: SampleResponses, tolerance: float, max_m: int) -> Floats:
    """Halve the step on pieces that have not converged; return the remaining change."""
    while True:
        changes = [p.limit.estimate().change for p in pieces]
        remaining_change = np.asarray(sum(c[: answers.count] for c in changes))
        restless = [
            p
            for p, c in zip(pieces, changes, strict=True)
            if np.any(c > tolerance / len(pieces)) and 2 * p.refinement * p.end <= max_m
        ]
        if np.all(remaining_change <= tolerance) or not restless:
            return remaining_change
        widest = restless[-1]
        every = 2 * widest.refinement
        finer = answers.compute(every, widest.end - 1)
        for piece in pieces:
            if piece.end <= widest.end and 2 * piece.refinement == every:
                piece.limit.add(finer[:, piece.first : piece.end])
                piece.refinement = every


def _piece_ranges(own: int) -> list[tuple[int, int]]:
    """Return the ranges of the pieces of responses over a number of intervals."""
    ends = [own + 1]
    while ends[0] // PIECE_RATIO >= MIN_PIECE_INTERVALS:
        ends.insert(0, ends[0] // PIECE_RATIO)
    return list(zip([0, *ends[:-1]], ends, strict=True))


def _decays(rows: Floats) -> bool:
    """Whether responses do not grow so much that their sum loses its digits."""
    if not np.all(np.isfinite(rows)):
        return False
    half = rows.shape[1] // 2
    first, second = (np.max(np.abs(part), axis=1, initial=0.0) for part in (rows[:, :half], rows[:, half:]))
    return bool(np.all(second <= MAX_GROWTH_RATIO * first))


def simulate_refined(
    model: Model, run: Run, initial: Terms | None, *, tolerance: float, max_m: int, long_intervals: int = 1 << 60
) -> OutputSamples:
    """Samples in the limit for zero step of a model without friction and level."""
    if initial is None:
        model = with_initial_conditions(model, run)
    if run.length > long_intervals:
        result = simulate_long(model, run, initial, tolerance=tolerance, max_m=max_m)
        if result is not None:
            return result
    own = run.length - 1
    every = FIRST_REFINEMENT
    times = nonuniform_sample_times(model, run)
    limit, failures = RichardsonTable(), 0
    while True:
        last = 2 * every * own > max_m
        samples, terms = _simulate_grid(model, run, every, initial, times, last=failures == 1)
        finite = bool(np.all(np.isfinite(samples)))
        owners = [i for i, o in enumerate(model.outputs) for _ in terms[o]]
        limit.add(samples, np.array([v for o in model.outputs for v in terms[o].values()]))
        estimate = limit.estimate(owners, enough=tolerance)
        # A stiff equation may have no stable scheme on a coarse grid; one that has none on two in a row has none.
        failures = 0 if finite or every == FIRST_REFINEMENT else failures + 1
        if last or failures == 2 or np.all(estimate.change <= tolerance):
            break
        every *= 2
    return OutputSamples(estimate.samples, _with_values(terms, estimate.initial_terms), every, estimate.change)


def _with_values(terms: Terms, values: Floats) -> dict[str, dict[float, float]]:
    """Return initial terms with the same outputs and exponents and other values."""
    remaining = iter(values.tolist())
    return {o: {e: next(remaining) for e in powers} for o, powers in terms.items()}


def _simulate_grid(
    model: Model, run: Run, every: int, initial: Terms | None, times: Floats | None, *, last: bool = False
) -> tuple[Floats, dict[str, dict[float, float]]]:
    """Simulate on one grid; NaN if the equations are singular there, unless it is the last grid."""
    try:
        return simulate_samples(model, run, every, initial, times)
    except ModelError:
        # An own coefficient c meets 1 = c h^alpha / gamma(alpha + 2) on one step, not on two.
        if last:
            raise
        count = run.length if times is None else times.size
        return np.full((len(model.outputs), count), np.nan), {o: {} for o in model.outputs}
