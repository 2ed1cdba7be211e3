"""A run and a structure become the record that the core computes on: pulse means of every signal."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeAlias

import numpy as np

from ftlm import _core
from ftlm.data.run import Run, Runs
from ftlm.data.sampling import HELD, Readings, bridged, locked
from ftlm.errors import DataError, ModelError
from ftlm.simulation.initial_conditions import answers, decided, has_memory, together, without_held
from ftlm.structure.equation import Equation, Term
from ftlm.structure.input_nonlinearity import WORDS
from ftlm.structure.order import Order
from ftlm.structure.structure import Initial, Offset, Structure, check_decided
from ftlm.utils.validation import Floats, check_pulses, nearest

#: The paper's number of block pulses, used where the record carries as many.
PAPER_M = 2048
#: Most pulses in one record: 2^24 of one signal are 128 MB.
MAX_M = 1 << 24
#: A signal that stays below this loses digits of its squares to the end of the range of numbers.
SMALLEST = 1e-140
COULOMB = "coulomb_"
#: Series of sensor filters that are kept: long ones of the grids at hand, those up to so many pulses of all of a fit.
KEPT_LONG, SHORT, KEPT_SHORT = 4, 1 << 13, 32
#: Initial terms as the core takes them.
InitialTuple: TypeAlias = tuple[bool, list[float]] | tuple[bool, list[float], int] | tuple[bool, list[float], int, int]
#: Which signals' sensors may have held something, where each signal began, answers of the filter to impulses.
Begun: TypeAlias = tuple[tuple[bool, ...], tuple[float, ...], Floats | None]


@dataclass(frozen=True)
class Record:
    """Pulse means of the signals of a structure on one run.

    Parameters
    ----------
    signals
        Names, in the order of the rows.
    step
        Pulse width [s].
    means
        Rows of pulse means.
    inputs
        Which signals are inputs of the run.
    sensor
        Series of the sensor filter, applied to every signal not measured through it, or None.
    initial
        Initial terms, decided.
    offset
        Unknown constant of each equation on this run.
    states
        Free motions of the sensor filter beside the initial terms of every output that passes it.
    held
        Whether a signal came through a sensor that may still have held something when the run began.
    levels
        Where each signal began, in a run that is not from rest: derivatives above their equation's order are of what a
        signal is above it. 0 of what the filter's free motion was taken out of.
    answers
        Pulse means of the filter's free motions, a row a state; None where it has others, and from rest.
    """

    signals: tuple[str, ...]
    step: float
    means: Floats
    inputs: tuple[bool, ...]
    sensor: Floats | None
    initial: Initial
    offset: Offset = "none"
    states: int = 0
    held: tuple[bool, ...] = ()
    levels: tuple[float, ...] = ()
    answers: Floats | None = None

    @property
    def start(self) -> InitialTuple:
        """Initial terms as the core takes them."""
        return initial_tuple(self.initial, self.offset, self.states)

    @property
    def m(self) -> int:
        """Number of pulses."""
        return int(self.means.shape[1])

    def core(self) -> tuple[float, Floats, Floats | None]:
        """Return the record as the core takes it."""
        return self.step, self.means, self.sensor

    def begun(self) -> tuple[float, Floats, Floats | None] | tuple[float, Floats, Floats | None, Begun]:
        """Return the record as the core takes it to drive equations."""
        if not any(self.held) and not any(self.levels):
            return self.core()
        return (*self.core(), (self.held, self.levels, self.answers))

    def of(self, name: str) -> Floats:
        """Return the pulse means of a signal."""
        row: Floats = self.means[self.signals.index(name)]
        return row


def default_m(runs: Sequence[Run], *, power_of_two: bool) -> int:
    """Return the paper's 2 048 pulses, or as many as the shortest run carries (a power of two for Haar coordinates)."""
    carried = min(run.length for run in runs) - 1
    m = min(PAPER_M, carried)
    return 1 << (m.bit_length() - 1) if power_of_two and m > 0 else m


def check_m(m: int, runs: Sequence[Run], *, power_of_two: bool) -> int:
    """Refuse an m that is no number of pulses, that a run does not carry, or that Haar coordinates cannot take."""
    m = check_pulses(m, math.inf)
    for run in runs:
        carried = run.length - 1
        if m > carried:
            raise ModelError(
                f"m = {m} is more than run {run.name!r} carries: {run.length} rows are {carried} pulses; "
                f"take m = {carried} or less"
            )
    if power_of_two and m & (m - 1):
        below = 1 << (m.bit_length() - 1)
        raise ModelError(
            f"m = {m} is no power of two, which Haar rows need; take m = {below} or {2 * below}, or rows='time'"
        )
    return m


def record(run: Run, structure: Structure, m: int, *, filtered: bool = True) -> Record:
    """Pulse means of every signal of a structure, delays and sensor filter honoured.

    Outputs are point samples taken as linear in between; inputs hold or are linear as the run says; m may exceed the
    run's own grid only where nothing is measured against it. ``filtered`` puts signals that were not measured through
    the sensor filter through it (equation error); a free run that no filtered signal drives leaves them. Refuses
    signals that the run lacks, those so small that their squares vanish, delays of what is no input, and samples that
    are missing where an equation needs them; over others stand straight lines, to which nothing may be fitted.
    """
    _check_known(run, structure)
    check_held(run, structure)
    initial = decided(run, structure)
    sensor = None
    if filtered and structure.sensor_filter is not None:
        sensor = sensor_series(structure, m, run.duration / m)
    rows = []
    for name in structure.signals:
        means = _means(run, structure, name, m, at_rest=initial == "rest")
        if sensor is not None and not structure.measured_through(name):
            means = _core.series_multiply(sensor, means, m)
        peak = float(np.max(np.abs(means), initial=0.0))
        if 0 < peak < SMALLEST:
            raise DataError(
                f"signal {name!r} of run {run.name!r}: no mean is larger than {peak:.3g}, and squares below "
                f"{SMALLEST:g} lose their digits; scale the signal"
            )
        rows.append(means)
    states, step = structure.filter_states(initial), run.duration / m
    levels = tuple(_level(run, structure, s, initial) for s in structure.signals)
    held = tuple(states > 0 and sensor is not None and structure.measured_through(s) for s in structure.signals)
    return Record(
        structure.signals,
        step,
        locked(np.stack(rows)),
        tuple(s in run.inputs for s in structure.signals),
        sensor,
        initial,
        structure.offset,
        states,
        held,
        levels,
        None
        if sensor is None or structure.sensor_filter is None
        else answers(structure.sensor_filter, states, m, step),
    )


def _level(run: Run, structure: Structure, name: str, initial: Initial) -> float:
    """Where a signal began; 0 from rest, of what came through the filter of an equation, and where it was not read."""
    if initial == "rest" or name not in run or (structure.behind_filter and structure.measured_through(name)):
        return 0.0
    first = float(acting(run, structure, name)[name][0])
    return first if math.isfinite(first) else 0.0


def acting(run: Run, structure: Structure, name: str | None = None) -> Run:
    """The run with its inputs, or one of them, as known saturations and dead zones let them act."""
    free = next((limit for limit in structure.limits if limit.free is not None), None)
    if free is not None:
        raise ModelError(
            f"the {WORDS[free.law]} of {free.signal} is free: only method='output-error' estimates limits; give its "
            "value"
        )
    limits = [limit for limit in structure.limits if limit.signal in run and name in (None, limit.signal)]
    return run.bent(limits) if limits else run


def driving(run: Run, structure: Structure, name: str | None = None) -> Run:
    """The run with its signals, or one of them, as they drive equations: inputs acting, filters begun at rest."""
    return without_held(acting(run, structure, name), structure, name)


def check_held(run: Run, structure: Structure, known: Mapping[str, float] | None = None) -> None:
    """Refuse the derivative of a jump: a held input above the order of the output that it drives.

    ``known`` holds free orders that have one value.
    """
    for item in structure.equations:
        alpha = item.order.partly(known or {})
        for term in item.terms:
            order = term.order.partly(known or {})
            if alpha.names or order.names or order.constant <= alpha.constant + 1e-9:
                continue
            if term.signal in run.inputs and run.intersample[term.signal] == "zoh":
                raise ModelError(
                    f"order {order.constant:g} of {term.signal} is above alpha = {alpha.constant:g} of "
                    f"{item.output}, and run {run.name!r} holds {term.signal} between its samples: its jumps have no "
                    "derivative; lower the order, or say intersample='foh' if it moves in between"
                )


def records(runs: Sequence[Run], structure: Structure, m: int, *, filtered: bool = True) -> list[Record]:
    """Records of several runs (see :func:`record`), made once for runs that were checked together.

    Records finer than the runs themselves are not kept: they are large, and nobody asks for one twice.
    """

    def made() -> list[Record]:
        return [record(run, structure, m, filtered=filtered) for run in runs]

    if not isinstance(runs, Runs) or m >= min(run.length for run in runs):
        return made()
    filtered = filtered or structure.sensor_filter is None
    inputs = (structure.delay, structure.free_delays, structure.limits)
    read = (structure.signals, inputs, structure.sensor_filter, structure.initial)
    start = (
        structure.offset,
        structure.outputs,
        has_memory(structure),
        [e.order.constant for e in structure.equations],
    )
    return list(runs.keep(repr((read, start, m, filtered)), made))


def sensor_series(structure: Structure, m: int, step: float) -> Floats | None:
    """Return the structure's sensor filter as a series, or None."""
    sensor = structure.sensor_filter
    if sensor is None:
        return None
    return (_short_series if m <= SHORT else _long_series)(sensor.numerator, sensor.denominator, m, step)


def _made(
    numerator: tuple[tuple[float, float], ...], denominator: tuple[tuple[float, float], ...], m: int, step: float
) -> Floats:
    """The series of a filter on m pulses; every signal and every run of one step passes the same one."""
    return locked(_core.filter_series(list(numerator), list(denominator), m, step))


_long_series, _short_series = lru_cache(maxsize=KEPT_LONG)(_made), lru_cache(maxsize=KEPT_SHORT)(_made)


def _check_known(run: Run, structure: Structure) -> None:
    """Refuse missing samples of what drives an equation, and of outputs that pass a filter before they are compared."""
    missing = run.missing
    if not missing:
        return
    outputs, coupled = structure.outputs, structure.coupling == "simulated"
    drivers = {
        name: e.output
        for e in structure.equations
        for name in (s.removeprefix(COULOMB) if s not in run else s for s in e.signals)
        if name != e.output and not (coupled and name in outputs)
    }
    lacking = next((name for name in missing if name in drivers), None)
    if lacking is not None:
        gone = missing[lacking]
        raise DataError(
            f"signal {lacking!r} of run {run.name!r} holds no value in {int(gone.sum())} rows, first row "
            f"{int(np.flatnonzero(gone)[0])}, and drives the equation of {drivers[lacking]} as measured; fill these "
            "rows yourself, avoid them with slice=, or use coupling='simulated'"
        )
    if structure.behind_filter and any(name in missing for name in outputs):
        raise DataError(
            f"run {run.name!r} has missing samples, and a sensor filter with coupling='measured', or on what "
            "drives the run, must see all of them; use coupling='simulated', or a part without gaps"
        )


def whole(runs: Sequence[Run], what: str) -> None:
    """Refuse runs with missing samples for what cannot leave them out."""
    for run in runs:
        for name, gone in run.missing.items():
            raise DataError(
                f"output {name!r} of run {run.name!r} holds no value in {int(gone.sum())} rows, first row "
                f"{int(np.flatnonzero(gone)[0])}: {what} cannot leave them out; use method='output-error' "
                "(identify), a part without gaps, or fill them yourself"
            )


def _means(run: Run, structure: Structure, name: str, m: int, *, at_rest: bool) -> Floats:
    if name not in run and name.startswith(COULOMB) and name.removeprefix(COULOMB) in run:
        # The sign of the measured rate over each interval; the last row repeats so that rows match.
        rate = np.sign(np.diff(run[name.removeprefix(COULOMB)]))
        return _core.pulse_means(np.append(rate, rate[-1]), m, True)
    if name not in run:
        raise DataError(
            f"run {run.name!r} has no signal {name!r}{nearest(name, run.signals)}, which the model needs; "
            f"it has {', '.join(run.signals)}: name the columns with inputs= and outputs= (commands: -u and -y)"
        )
    run = driving(run, structure, name)
    samples = bridged(run[name])
    if name in structure.free_delays:
        raise ModelError(
            f"the delay of {name} is free: only method='output-error' estimates delays; give its value in seconds"
        )
    delay = structure.delay.get(name, 0.0)
    if name not in run.inputs:
        if delay:
            raise ModelError(f"delay of {name} = {delay:g} s, but run {run.name!r} has it as an output; delay inputs")
        if run.readings is not None and name not in run.missing:
            return run.readings.means(name, "foh", m, run.duration, 0.0, 0.0)
        return _core.pulse_means(samples, m, False)
    held = run.intersample[name] == "zoh"
    if run.readings is not None:
        before = 0.0 if at_rest else float(samples[0])
        return run.readings.means(name, run.intersample[name], m, run.duration, delay, before)
    if delay:
        intervals = run.length - 1
        # On a finer grid the delayed command switches within an interval, so it is held on that grid before the delay.
        every = m // intervals if held and m % intervals == 0 else 1
        samples = np.repeat(samples, every)[: intervals * every + 1]
        samples = _core.delayed(samples, delay / run.step * every, 0.0 if at_rest else float(samples[0]))
    return _core.pulse_means(samples, m, held)


def structure_tuple(item: Equation, signals: Sequence[str]) -> tuple[int, float, list[tuple[int, float]]]:
    """Output, alpha and (signal, order) pairs of an equation whose orders are numbers.

    Raises
    ------
    ModelError
        An equation with friction, which nothing linear follows.
    """
    check_linear([item], "what is linear in its coefficients")
    return linear_tuple(item, signals)


def check_linear(equations: Sequence[Equation], what: str) -> None:
    """Refuse friction where nothing knows it."""
    for item in equations:
        if item.friction is not None:
            raise ModelError(
                f"the equation of {item.output} has friction, which {what} does not know; use method='output-error' "
                "and free runs (simulate, compare), or leave the friction out"
            )


def linear_tuple(item: Equation, signals: Sequence[str]) -> tuple[int, float, list[tuple[int, float]]]:
    """The linear part of an equation."""
    index = {name: i for i, name in enumerate(signals)}
    terms = [(index[t.signal], t.order.constant) for t in item.terms]
    return index[item.output], item.order.constant, terms


def lattice_tuple(
    item: Equation, signals: Sequence[str], values: Mapping[str, Sequence[float]]
) -> tuple[int, list[float], list[tuple[int, list[float], bool]]]:
    """Output, values of alpha, and (signal, values of the order, whether both are free) of each term."""
    check_linear([item], "an order search")

    def axis(order: Order) -> list[float]:
        return list(values[order.names[0]]) if order.names else [order.constant]

    terms = [(signals.index(t.signal), axis(t.order), bool(t.order.names) and t.fixed is None) for t in item.terms]
    return signals.index(item.output), axis(item.order), terms


def affine(order: Order, names: Sequence[str]) -> tuple[float, list[float]]:
    """Constant of an order, and its weight of each free order."""
    weights = dict(order.weights)
    return order.constant, [weights.get(n, 0.0) for n in names]


def equation_tuple(
    item: Equation, signals: Sequence[str]
) -> tuple[tuple[int, float, list[tuple[int, float]]], list[float]]:
    """Return an identified equation: its structure and its coefficients."""
    return structure_tuple(item, signals), [float(t.fixed or 0.0) for t in item.terms]


def initial_tuple(initial: Initial, offset: Offset = "none", states: int = 0) -> InitialTuple:
    """Return decided initial terms: whether Caputo's, else their exponents; numbers of offset terms, filter states."""
    powers = [] if isinstance(initial, str) else list(initial)
    decided = (initial == "caputo", powers)
    if states:
        return (*decided, ("none", "constant", "ramp").index(offset), states)
    return decided if offset == "none" else (*decided, 1 if offset == "constant" else 2)


def named_signals(error: ModelError, signals: Sequence[str]) -> ModelError:
    """The core knows signals by number; people know them by name."""
    return ModelError(re.sub(r"signal (\d+)", lambda m: f"signal {signals[int(m[1])]!r}", str(error)))


def prepare(
    runs: Sequence[Run], structure: Structure, m: int | None, *, power_of_two: bool, gaps: bool = False
) -> list[Record]:
    """Make the records of runs for an estimator on the equation error, refusing what it cannot be given.

    Missing samples are refused unless gaps are let pass by an estimator that leaves them out.
    """
    check_decided(structure.offset)
    if not gaps:
        whole(runs, "an estimator on the equation error")
    m = check_m(default_m(runs, power_of_two=power_of_two) if m is None else m, runs, power_of_two=power_of_two)
    for run in runs:
        run.require_outputs([o for o in structure.outputs if o in run])
    prepared = records(runs, structure, m)
    common = together([r.initial for r in prepared])
    if common is not None:
        # One rule for all runs of a fit: initial terms that a run at rest does not need are estimated as zero.
        prepared = records(runs, replace(structure, initial=common), m)
    for item in structure.equations:
        for term in item.terms:
            if term.fixed is None and term.signal != item.output and not any(r.of(term.signal).any() for r in prepared):
                raise DataError(
                    f"{term.signal} is 0 throughout, so its coefficient in the equation of {item.output} cannot be "
                    "identified; leave the term out, fix its coefficient, or add a run in which it moves"
                )
            if structure.offset != "none" and _is_offset(term, item, prepared):
                raise DataError(
                    f"{term.signal} is constant on every run, so {term} and the offset in the equation of "
                    f"{item.output} cannot be told apart; add a run in which it changes, fix its coefficient, "
                    "or use offset='none'"
                )
    return prepared


def _is_offset(term: Term, item: Equation, prepared: Sequence[Record]) -> bool:
    """Whether a free term of order 0 does on every run what an offset does."""
    if term.fixed is not None or term.signal == item.output or term.order.names or term.order.constant != 0:
        return False
    return all(float(np.ptp(r.of(term.signal))) == 0.0 for r in prepared)


def named_coefficients(item: Equation, raw: Sequence[float]) -> dict[str, float]:
    """Free coefficients by name from the core's products of factor and coefficient."""
    return {t.coefficient: c / t.factor for t, c in zip(item.terms, raw, strict=True) if isinstance(t.coefficient, str)}


def has_own_times(run: Run, structure: Structure) -> bool:
    """Whether a run's outputs are compared when they were read.

    Not where a number of an input is free, nor behind a filter of all.
    """
    return run.readings is not None and not structure.free_inputs and not structure.behind_filter


@dataclass(frozen=True, eq=False)
class Instants:
    """Times within a run, on its grid of pulses, and the commands as they were given.

    Parameters
    ----------
    run, record
        The run, and its pulses.
    structure
        Whose delays are honoured.
    readings
        Rows of the run at times of their own.
    times
        The times [s since the first row].
    """

    run: Run
    record: Record
    structure: Structure
    readings: Readings
    times: Floats

    @classmethod
    def of(cls, run: Run, record: Record, structure: Structure, times: Floats) -> Instants:
        """At some times of a run; a regular one was read on its grid."""
        run = acting(run, structure)
        readings = run.readings or Readings(run.time, {n: run[n] for n in run.signals})
        return cls(run, record, structure, readings, times)

    @property
    def places(self) -> Floats:
        """The times in pulses."""
        return np.asarray(np.minimum(self.times / self.record.step, float(self.record.m)))

    def jumps(self, name: str) -> tuple[Floats, Floats] | None:
        """Places and sizes of the jumps of an input that holds in between; None for what does not jump."""
        if name not in self.run.inputs or self.run.intersample[name] != HELD:
            return None
        times, sizes = self.readings.jumps(name, self._delay(name), self._before(name))
        return np.asarray(times / self.record.step), sizes

    def values(self, name: str) -> Floats | None:
        """A signal at the times, after it has changed there; None for one that is made of others."""
        if name in self.run.inputs:
            kind = self.run.intersample[name]
            return self.readings.at(name, kind, self.times, self._delay(name), self._before(name))
        if name not in self.run:
            return None
        return self.readings.at(name, "foh", self.times, 0.0, 0.0)

    def corners(self, name: str, order: float) -> Floats | None:
        """What the pulses lack at the times of I^order of an input that jumps."""
        jumps = self.jumps(name)
        if jumps is None:
            return None
        return _core.corners(self.record.m, self.places, jumps, order, self.record.step)

    def _delay(self, name: str) -> float:
        return self.structure.delay.get(name, 0.0)

    def _before(self, name: str) -> float:
        return 0.0 if self.record.initial == "rest" else float(self.readings.data[name][0])


def compared_times(run: Run, structure: Structure) -> Floats:
    """When the samples of a run that are compared were read [s since its first row]."""
    if run.readings is None or not has_own_times(run, structure):
        return run.time
    return run.readings.times[run.readings.compared(run.duration)]


def compared_values(run: Run, structure: Structure, name: str) -> Floats:
    """A signal at these times, as it was recorded; an output is NaN where it was not read."""
    if run.readings is None or not has_own_times(run, structure):
        return run[name]
    return run.readings.data[name][run.readings.compared(run.duration)]
