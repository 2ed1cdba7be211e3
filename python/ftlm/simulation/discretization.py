"""Discretization of a run for a structure: block-pulse records of the core, and sample times on their grid."""

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
from ftlm.data.sampling import make_read_only
from ftlm.errors import DataError, ModelError
from ftlm.simulation.initial_conditions import (
    common_initial_conditions,
    deviations,
    has_memory,
    resolve_initial_conditions,
    resolve_start,
)
from ftlm.simulation.nonlinear_columns import append_columns, check_columns, nonlinear_columns, record_signals
from ftlm.structure.equation import Equation, Term
from ftlm.structure.order import MAX_IMPROPER_ORDER, ORDER_RESOLUTION, Order
from ftlm.structure.structure import Initial, Offset, Structure, check_offset_resolved
from ftlm.utils.parameters import choose_text, parameter, setting
from ftlm.utils.validation import Floats, check_pulses, nearest

#: Default number of block pulses, that of the paper, for runs with as many samples.
DEFAULT_PULSES = 2048
#: Maximum number of pulses of a record: 2^24 of one signal are 128 MB.
MAX_M = 1 << 24
#: Largest relative excess of a negative delay over one sampling interval that is rounding.
MAX_EARLY_ROUNDING = 1e-9
COULOMB_PREFIX = "coulomb_"
#: Number of cached series of sensor filters: long ones, and those of at most this many pulses.
CACHED_LONG_SERIES, SHORT_SERIES_PULSES, CACHED_SHORT_SERIES = 4, 1 << 13, 32
#: Initial terms as the core takes them.
InitialTuple: TypeAlias = tuple[bool, list[float]] | tuple[bool, list[float], int] | tuple[bool, list[float], int, int]


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
        Resolved initial conditions.
    offset
        Unknown constant of each equation on this run.
    states
        Number of initial states of the sensor filter, estimated with the initial terms of every filtered output.
    """

    signals: tuple[str, ...]
    step: float
    means: Floats
    inputs: tuple[bool, ...]
    sensor: Floats | None
    initial: Initial
    offset: Offset = "none"
    states: int = 0

    @property
    def start(self) -> InitialTuple:
        """Initial conditions as an argument of the core."""
        return initial_tuple(self.initial, self.offset, self.states)

    @property
    def m(self) -> int:
        """Number of pulses."""
        return int(self.means.shape[1])

    def core(self) -> tuple[float, Floats, Floats | None]:
        """Return the record as an argument of the core."""
        return self.step, self.means, self.sensor

    def of(self, name: str) -> Floats:
        """Return the pulse means of a signal."""
        row: Floats = self.means[self.signals.index(name)]
        return row


def default_m(runs: Sequence[Run], *, power_of_two: bool) -> int:
    """Return the paper's 2 048 pulses, or as many as the shortest run supports (a power of two for Haar rows)."""
    carried = min(run.length for run in runs) - 1
    m = min(DEFAULT_PULSES, carried)
    return 1 << (m.bit_length() - 1) if power_of_two and m > 0 else m


def check_m(m: int, runs: Sequence[Run], *, power_of_two: bool) -> int:
    """Raise ModelError for an invalid number of pulses, or one that a run or Haar rows do not support."""
    m = check_pulses(m, math.inf)
    for run in runs:
        carried = run.length - 1
        if m > carried:
            raise ModelError(
                f"{setting('m')} {m} is more than run {run.name!r} carries: {run.length} rows are {carried} pulses; "
                f"take m = {carried} or less"
            )
    if power_of_two and m & (m - 1):
        below = 1 << (m.bit_length() - 1)
        raise ModelError(
            f"{setting('m')} {m} is not a power of two, which Haar rows need; take m = {below} or {2 * below}, or "
            f"{parameter('row_basis', 'time')}"
        )
    return m


def record(run: Run, structure: Structure, m: int, *, filtered: bool = True, smooth: bool = True) -> Record:
    """Return pulse means of every signal and non-linear term of a structure, with delays and sensor filter applied.

    Outputs are interpolated linearly between samples; inputs by the intersample behavior of the run. m may exceed the
    grid of the run only if nothing is compared with measurements. ``filtered`` passes signals that were not measured
    through the sensor filter through it (equation error); a simulation without filtered inputs does not need that.
    ``smooth`` smooths the signals whose derivatives are in non-linear terms.
    Raises for missing signals, signals whose squares underflow, delays of outputs, and missing samples of inputs. Other
    missing samples are interpolated and must not be fitted.
    """
    initial = resolve_initial_conditions(run, structure)
    run, structure = without_level(run, structure)
    _check_known_inputs(structure)
    step, means, sensor, _ = recording(run, structure, initial).pulses(m, filtered)
    signals = record_signals(structure)
    return Record(
        signals,
        step,
        make_read_only(append_columns(run, structure, means, step, smooth=smooth)),
        tuple(s in run.inputs or s not in structure.signals for s in signals),
        sensor,
        initial,
        structure.offset,
        structure.filter_states(initial),
    )


def without_level(run: Run, structure: Structure) -> tuple[Run, Structure]:
    """Return a run minus the output level of a structure, and the structure without it."""
    if structure.offset != "level":
        return run, structure
    return deviations(run, structure)[0], replace(structure, offset="none")


def recording(run: Run, structure: Structure, initial: Initial | None = None) -> _core.Recording:
    """Return a run as the core samples it for a structure, with ``initial`` or the structure's initial conditions.

    Free delays and limits are the core's to apply. Raises for missing signals, delays of outputs, and missing samples
    of inputs.
    """
    initial = resolve_initial_conditions(run, structure) if initial is None else initial
    run, structure = without_level(run, structure)
    _check_missing(run, structure)
    check_derivative_orders(run, structure)
    sensor, signals = structure.sensor_filter, structure.signals
    return _core.Recording(
        {
            "name": run.name,
            "step": run.step,
            "times": None if run.sample_times is None else run.sample_times.times,
            "signals": [_channel(run, structure, name) for name in signals],
            "outputs": [signals.index(name) for name in structure.outputs],
            "filter": None if sensor is None else (sensor.numerator, sensor.denominator),
            "filter_states": structure.filter_states(initial),
            "at_rest": initial == "rest",
            "coupled": structure.coupling == "simulated",
            "friction": not structure.is_linear,
            "free": [(signals.index(item.signal), item.law) for item in structure.free_inputs],
        }
    )


def _channel(run: Run, structure: Structure, name: str) -> _core._Channel:
    """Return a signal of a run as the core samples it."""
    channel: _core._Channel = {
        "name": name,
        "samples": np.zeros(0),
        "nonuniform": None,
        "role": "derived",
        "delay": None,
        "limits": [],
        "filtered": structure.is_filtered(name),
        "enters_others": any(name in t.signals for e in structure.equations if e.output != name for t in e.terms),
    }
    moving = name.removeprefix(COULOMB_PREFIX)
    if name not in run and moving != name and moving in run:
        # The sign of the measured rate over each interval; the last row repeats so that rows match.
        rate = np.sign(np.diff(run[moving]))
        return {**channel, "samples": np.append(rate, rate[-1])}
    if name not in run:
        raise DataError(
            f"run {run.name!r} has no signal {name!r}{nearest(name, run.signals)}, which the model needs; "
            f"it has {', '.join(run.signals)}: name the columns with {parameter('inputs')} and "
            f"{parameter('outputs')}"
        )
    delay = structure.delay.get(name)
    if delay and name not in run.inputs:
        raise ModelError(f"delay of {name} = {delay:g} s, but run {run.name!r} has it as an output; delay inputs")
    check_early_input(run, name, delay if delay is not None else structure.free_delays.get(name, (0.0,))[0])
    limits = [limit for limit in structure.limits if limit.signal == name]
    return {
        **channel,
        "samples": run[name],
        "nonuniform": None if run.sample_times is None else run.sample_times.data[name],
        "role": run.intersample.get(name, "output"),
        "delay": delay,
        "limits": [(limit.law, None if isinstance(limit.value, tuple) else limit.value) for limit in limits],
    }


def check_early_input(run: Run, name: str, delay: float) -> None:
    """Raise ModelError for an input that acts more than one sampling interval before it is logged."""
    if delay < -run.step * (1.0 + MAX_EARLY_ROUNDING):
        raise ModelError(
            f"delay of {name} = {delay:g} s is more than one sampling interval ({run.step:g} s) of run {run.name!r} "
            "before the row that logs it; shift the rows of that input"
        )


def _check_known_inputs(structure: Structure) -> None:
    """Raise ModelError for a free delay, saturation or dead zone."""
    for item in structure.free_inputs:
        what, value = ("delays", "value in seconds") if item.law == "delay" else ("limits", "value")
        raise ModelError(
            f"the {item.words} is free: only {parameter('method', 'output-error')} estimates {what}; give its {value}"
        )


def apply_input_nonlinearity(run: Run, structure: Structure, name: str | None = None) -> Run:
    """Return the run with known saturations and dead zones applied to its inputs, or to one of them."""
    _check_known_inputs(structure)
    limits = [limit for limit in structure.limits if limit.signal in run and name in (None, limit.signal)]
    return run.with_input_nonlinearities(limits) if limits else run


def check_derivative_orders(run: Run, structure: Structure, order_values: Mapping[str, float] | None = None) -> None:
    """Raise ModelError for derivatives of a run's signals that its samples do not determine.

    The order of another signal is below that of the equation plus 1, and for a zero-order-hold input at most that of
    the equation, because its jumps have no derivative. ``order_values`` maps free orders with a single value to it.
    """
    for item in structure.equations:
        alpha = item.order.substitute(order_values or {})
        for term in item.terms:
            order = term.order.substitute(order_values or {})
            if alpha.names or order.names or order.constant <= alpha.constant + ORDER_RESOLUTION:
                continue
            if term.signal in run.inputs and run.intersample[term.signal] == "zoh":
                raise ModelError(
                    f"order {order.constant:g} of {term.signal} is above alpha = {alpha.constant:g} of "
                    f"{item.output}, and run {run.name!r} holds {term.signal} between its samples: its jumps have no "
                    f"derivative; lower the order, or say {parameter('intersample', 'foh')} if it moves in between"
                )
            _check_excess_order(term.signal, order.constant, item.output, alpha.constant)


def _check_excess_order(signal: str, order: float, output: str, alpha: float) -> None:
    """Raise ModelError for a signal that is differentiated once more than the output, or more often."""
    if signal != output and order > alpha + MAX_IMPROPER_ORDER - ORDER_RESOLUTION:
        raise ModelError(
            f"order {order:g} of {signal} is {order - alpha:g} above alpha = {alpha:g} of {output}; in the time domain "
            "an equation carries another signal less than one order above its own output: lower it"
        )


def records(
    runs: Sequence[Run], structure: Structure, m: int, *, filtered: bool = True, smooth: bool = True
) -> list[Record]:
    """Return records of several runs (see :func:`record`), cached if `runs` is a :class:`Runs`.

    Records with a finer grid than the runs are large and used once, so they are not cached.
    """

    def build() -> list[Record]:
        return [record(run, resolve_start([run], structure), m, filtered=filtered, smooth=smooth) for run in runs]

    if not isinstance(runs, Runs) or m >= min(run.length for run in runs):
        return build()
    filtered = filtered or structure.sensor_filter is None
    inputs = (structure.delay, structure.free_delays, structure.limits)
    read = (record_signals(structure), inputs, structure.sensor_filter, structure.initial)
    start = (
        structure.offset,
        structure.outputs,
        has_memory(structure),
        [e.order.constant for e in structure.equations],
    )
    return list(runs.get_or_compute(repr((read, start, m, filtered, smooth)), build))


def sensor_series(structure: Structure, m: int, step: float) -> Floats | None:
    """Return the structure's sensor filter as a series, or None."""
    sensor = structure.sensor_filter
    if sensor is None:
        return None
    return (_short_series if m <= SHORT_SERIES_PULSES else _long_series)(sensor.numerator, sensor.denominator, m, step)


def _filter_series(
    numerator: tuple[tuple[float, float], ...], denominator: tuple[tuple[float, float], ...], m: int, step: float
) -> Floats:
    """Return the series of a filter on m pulses."""
    return make_read_only(_core.filter_series(list(numerator), list(denominator), m, step))


_long_series, _short_series = (
    lru_cache(maxsize=CACHED_LONG_SERIES)(_filter_series),
    lru_cache(maxsize=CACHED_SHORT_SERIES)(_filter_series),
)


def _check_missing(run: Run, structure: Structure) -> None:
    """Raise DataError for missing samples of inputs, and of outputs that are filtered before comparison."""
    missing = run.missing_samples
    if not missing:
        return
    outputs, coupled = structure.outputs, structure.coupling == "simulated"
    drivers = {
        name: e.output
        for e in structure.equations
        for name in (s.removeprefix(COULOMB_PREFIX) if s not in run else s for s in e.signals)
        if name != e.output and not (coupled and name in outputs)
    }
    lacking = next((name for name in missing if name in drivers), None)
    if lacking is not None:
        mask = missing[lacking]
        raise DataError(
            f"signal {lacking!r} of run {run.name!r} holds no value in {int(mask.sum())} rows, first row "
            f"{int(np.flatnonzero(mask)[0])}, and drives the equation of {drivers[lacking]} as measured; fill these "
            f"rows yourself, avoid them with {parameter('window')}, or use {parameter('coupling', 'simulated')}"
        )
    if structure.all_filtered and any(name in missing for name in outputs):
        raise DataError(
            f"run {run.name!r} has missing samples, and a sensor filter with {parameter('coupling', 'measured')}, or "
            f"on what drives the run, must see all of them; use {parameter('coupling', 'simulated')}, or a part "
            "without gaps"
        )


def check_no_missing(runs: Sequence[Run], what: str) -> None:
    """Raise DataError for missing samples if an analysis cannot exclude them."""
    for run in runs:
        for name, is_missing in run.missing_samples.items():
            raise DataError(
                f"output {name!r} of run {run.name!r} holds no value in {int(is_missing.sum())} rows, first row "
                f"{int(np.flatnonzero(is_missing)[0])}: {what} cannot leave them out; use "
                f"{parameter('method', 'output-error')} (identify), a part without gaps, or fill them yourself"
            )


def structure_tuple(item: Equation, signals: Sequence[str]) -> tuple[int, float, list[tuple[int, float]]]:
    """Output, alpha and (signal, order) pairs of an equation whose orders are numbers.

    Raises
    ------
    ModelError
        An equation with friction, which nothing linear follows.
    """
    check_frictionless([item], "what is linear in its coefficients")
    return linear_tuple(item, signals)


def check_linear(equations: Sequence[Equation], what: str) -> None:
    """Raise ModelError for friction or a non-linear term in a linear analysis."""
    check_frictionless(equations, what)
    for item in equations:
        for term in item.nonlinear_terms:
            point = parameter("at", dict.fromkeys(term.signals, 0.3))
            linear = choose_text(f"model.linearized({point})", "Model.linearized in Python")
            raise ModelError(
                f"the equation of {item.output} has the non-linear term {term}, and {what} needs a linear model; "
                f"use the linear model about an operating point, {linear}, or free runs (simulate, compare)"
            )


def check_frictionless(equations: Sequence[Equation], what: str) -> None:
    """Raise ModelError for friction, which is not linear in its coefficients."""
    for item in equations:
        if item.friction is not None:
            raise ModelError(
                f"the equation of {item.output} has friction, and {what} needs a linear model; use "
                f"{parameter('method', 'output-error')} and simulations (simulate, compare), or leave the friction out"
            )


def linear_tuple(item: Equation, signals: Sequence[str]) -> tuple[int, float, list[tuple[int, float]]]:
    """Return an equation without friction as an argument of the core; non-linear terms are columns of a record."""
    index = {name: i for i, name in enumerate(signals)}
    if any(t.column not in index for t in item.nonlinear_terms):
        check_linear([item], "a computation on the signals alone")
    terms = [(index[t.column], t.order.constant) for t in item.terms]
    return index[item.output], item.order.constant, terms


def derived_signals(structure: Structure) -> list[_core._Derived]:
    """Return the expressions of non-linear terms as the core takes them; they follow the signals of the structure."""
    return [
        (
            item.program({channel: i for i, channel in enumerate(item.channels)}),
            [(structure.signals.index(signal), order) for signal, order in item.channels],
        )
        for item in nonlinear_columns(structure).values()
    ]


def order_grid_tuple(
    item: Equation, signals: Sequence[str], values: Mapping[str, Sequence[float]]
) -> tuple[int, list[float], list[tuple[int, list[float], bool]]]:
    """Output, values of alpha, and (signal, values of the order, whether both are free) of each term."""
    check_linear([item], "a genetic algorithm")

    def axis(order: Order) -> list[float]:
        return list(values[order.names[0]]) if order.names else [order.constant]

    terms = [(signals.index(t.signal), axis(t.order), bool(t.order.names) and t.fixed is None) for t in item.terms]
    return signals.index(item.output), axis(item.order), terms


def affine(order: Order, names: Sequence[str]) -> tuple[float, list[float]]:
    """Return the constant of an order and its weights of the free orders."""
    weights = dict(order.weights)
    return order.constant, [weights.get(n, 0.0) for n in names]


def equation_tuple(
    item: Equation, signals: Sequence[str]
) -> tuple[tuple[int, float, list[tuple[int, float]]], list[float]]:
    """Return an equation with its coefficients as arguments of the core."""
    for term in item.terms:
        _check_excess_order(term.signal, term.order.constant, item.output, item.order.constant)
    return structure_tuple(item, signals), [float(t.fixed or 0.0) for t in item.terms]


def initial_tuple(initial: Initial, offset: Offset = "none", states: int = 0) -> InitialTuple:
    """Return resolved initial conditions for the core: Caputo or exponents, offset terms, filter states."""
    powers = [] if isinstance(initial, str) else list(initial)
    decided = (initial == "caputo", powers)
    if states:
        return (*decided, ("none", "constant", "ramp", "level").index(offset), states)
    return decided if offset == "none" else (*decided, ("none", "constant", "ramp", "level").index(offset))


def named_signals(error: ModelError, signals: Sequence[str]) -> ModelError:
    """Return the error with names instead of signal numbers."""
    return ModelError(re.sub(r"signal (\d+)", lambda m: f"signal {signals[int(m[1])]!r}", str(error)))


def prepare(
    runs: Sequence[Run],
    structure: Structure,
    m: int | None,
    *,
    power_of_two: bool,
    gaps: bool = False,
    smooth: bool = True,
) -> list[Record]:
    """Return the records of runs for an equation-error estimator, or raise for unsuitable data.

    Missing samples raise DataError unless ``gaps`` is True, for an estimator that excludes them.
    """
    check_offset_resolved(structure.offset)
    if not gaps:
        check_no_missing(runs, "an estimator on the equation error")
    structure = resolve_start(runs, structure)
    m = check_m(default_m(runs, power_of_two=power_of_two) if m is None else m, runs, power_of_two=power_of_two)
    for run in runs:
        run.require_outputs([o for o in structure.outputs if o in run])
    prepared = records(runs, structure, m, smooth=smooth)
    common = common_initial_conditions([r.initial for r in prepared])
    if common is not None:
        # One rule for all runs of a fit: initial terms that a run at rest does not need are estimated as zero.
        prepared = records(runs, replace(structure, initial=common), m, smooth=smooth)
    for run, rec in [] if gaps else zip(runs, prepared, strict=True):
        check_columns(run, structure, dict(zip(rec.signals, rec.means, strict=True)), rec.step)
    for item in structure.equations:
        for term in item.terms:
            if term.fixed is None and term.column != item.output and not any(r.of(term.column).any() for r in prepared):
                raise DataError(
                    f"{term.column} is 0 throughout, so its coefficient in the equation of {item.output} cannot be "
                    "identified; leave the term out, fix its coefficient, or add a run in which it moves"
                )
            if structure.offset in ("constant", "ramp") and _is_offset(term, item, prepared):
                raise DataError(
                    f"{term.column} is constant on every run, so {term} and the offset in the equation of "
                    f"{item.output} are not separately identifiable; add a run in which it changes, fix its "
                    f"coefficient, "
                    f"or use {parameter('offset', 'none')}"
                )
    return prepared


def _is_offset(term: Term, item: Equation, prepared: Sequence[Record]) -> bool:
    """Whether a free term of order 0 is equivalent to an offset on every run."""
    if term.fixed is not None or term.column == item.output or term.order.names or term.order.constant != 0:
        return False
    return all(float(np.ptp(r.of(term.column))) == 0.0 for r in prepared)


def named_coefficients(item: Equation, raw: Sequence[float]) -> dict[str, float]:
    """Return free coefficients by name. ``raw`` has the product of factor and coefficient of each term."""
    return {t.coefficient: c / t.factor for t, c in zip(item.terms, raw, strict=True) if isinstance(t.coefficient, str)}


def has_nonuniform_samples(run: Run, structure: Structure) -> bool:
    """Whether the outputs of a run are compared at nonuniform sample times.

    False if an input parameter is free, or if all signals are filtered.
    """
    return run.sample_times is not None and not structure.free_inputs and not structure.all_filtered


def compared_times(run: Run, structure: Structure) -> Floats:
    """Return the times of the compared samples of a run [s since its first sample]."""
    if run.sample_times is None or not has_nonuniform_samples(run, structure):
        return run.time
    return run.sample_times.times[run.sample_times.indices_within(run.duration)]


def compared_values(run: Run, structure: Structure, name: str) -> Floats:
    """Return the recorded values of a signal at these times; NaN for missing samples of an output."""
    if run.sample_times is None or not has_nonuniform_samples(run, structure):
        return run[name]
    return run.sample_times.data[name][run.sample_times.indices_within(run.duration)]
