"""Discretization of a run for a structure: block-pulse means of signals, and sample times for comparisons."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeAlias

import numpy as np

from ftlm import _core
from ftlm.data.run import Run
from ftlm.data.runs import Runs
from ftlm.data.sampling import NonuniformSamples, make_read_only
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
from ftlm.utils.formatting import plural
from ftlm.utils.parameters import Placeholder, choose_text, parameter, setting
from ftlm.utils.validation import Floats, check_pulses, nearest

#: Default number of block pulses (the value of the paper), for runs with at least as many sampling intervals.
DEFAULT_PULSES = 2048
#: Maximum number of block pulses of a record: 2^24 pulses of one signal take 128 MB.
MAX_M = 1 << 24
#: Maximum excess of a negative delay over one sampling interval, relative to the interval, that counts as rounding.
MAX_EARLY_ROUNDING = 1e-9
COULOMB_PREFIX = "coulomb_"
#: Placeholder for a column name in error messages that show lines of a file for the option ``columns``.
QUOTED_COLUMN = '"COLUMN"'
#: Cache of power series of sensor filters: number of long series, maximum pulses of a short series, and number of
#: short series.
CACHED_LONG_SERIES, SHORT_SERIES_PULSES, CACHED_SHORT_SERIES = 4, 1 << 13, 32
#: Initial conditions as the Rust core takes them: whether they are Caputo's, given exponents of t, index of the offset
#: option in ("none", "constant", "ramp", "level"), and number of filter states. The last two may be absent.
InitialTuple: TypeAlias = tuple[bool, list[float]] | tuple[bool, list[float], int] | tuple[bool, list[float], int, int]


@dataclass(frozen=True)
class Record:
    """Block-pulse record of a run: the mean of each signal over each block pulse.

    Parameters
    ----------
    signals
        Names of the rows: signals, then the texts of non-linear terms.
    step
        Width of a block pulse [s].
    means
        Means over the block pulses, shape (rows, pulses).
    inputs
        Whether each row is an input of the run or a non-linear term.
    sensor
        Power series of the sensor filter on the block pulses, if the filter is applied to every signal that was not
        measured through it; otherwise None.
    initial
        Initial conditions of the run; for ``"auto"``, those that were chosen.
    offset
        Offset option of the structure; ``"none"`` if this option is ``"level"``, because the levels are already
        subtracted from the samples.
    states
        Number of initial states of the sensor filter, estimated for each filtered output together with its initial
        terms.
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
        """Initial conditions, offset and filter states in the form of :data:`InitialTuple`."""
        return initial_tuple(self.initial, self.offset, self.states)

    @property
    def m(self) -> int:
        """Number of block pulses."""
        return int(self.means.shape[1])

    def core(self) -> tuple[float, Floats, Floats | None]:
        """Return (pulse width [s], means, filter series), the form of a record that the Rust core takes."""
        return self.step, self.means, self.sensor

    def of(self, name: str) -> Floats:
        """Return the block-pulse means of a row, shape (pulses,)."""
        row: Floats = self.means[self.signals.index(name)]
        return row


def default_m(runs: Sequence[Run], *, power_of_two: bool) -> int:
    """Return the default number of block pulses: 2048, but at most the number of intervals of the shortest run.

    With `power_of_two`, the number is rounded down to a power of two, which Haar rows require.
    """
    max_m = min(run.length for run in runs) - 1
    m = min(DEFAULT_PULSES, max_m)
    return 1 << (m.bit_length() - 1) if power_of_two and m > 0 else m


def check_m(m: int, runs: Sequence[Run], *, power_of_two: bool) -> int:
    """Return the number of block pulses `m`, validated.

    Raise ModelError if a run has fewer than `m` sampling intervals, or if `power_of_two` is True and `m` is no power of
    two.
    """
    m = check_pulses(m, math.inf)
    for run in runs:
        max_m = run.length - 1
        if m > max_m:
            raise ModelError(
                f"{setting('m')} {m} is more than run {run.name!r} allows: {run.length} rows give {max_m} pulses; "
                f"use m = {max_m} or less"
            )
    if power_of_two and m & (m - 1):
        lower_power = 1 << (m.bit_length() - 1)
        raise ModelError(
            f"{setting('m')} {m} is not a power of two, which Haar rows need; take m = {lower_power} or "
            f"{2 * lower_power}, or "
            f"{parameter('row_basis', 'time')}"
        )
    return m


def record(run: Run, structure: Structure, m: int, *, filtered: bool = True, local_smoothing: bool = True) -> Record:
    """Return the block-pulse record of a run for a structure, with delays and sensor filter applied.

    The record has a row for each signal and each non-linear term. Between samples, outputs are linear and inputs follow
    the intersample behavior of the run. `m` is the number of block pulses. It may exceed the number of sampling
    intervals only if nothing is compared with measurements. With `filtered`, the sensor filter is applied to signals
    that were not measured through it; the equation error requires this. With `local_smoothing`, signals are smoothed if
    a non-linear term contains their derivatives. Missing samples of outputs are interpolated, and must not be fitted.

    Raise FtlmError for a missing signal, a signal whose squares underflow, a delay of an output or a missing sample of
    an input.
    """
    initial = resolve_initial_conditions(run, structure)
    run, structure = without_level(run, structure)
    _check_known_inputs(structure)
    step, means, sensor, _ = recording(run, structure, initial).pulses(m, filtered)
    signals = record_signals(structure)
    return Record(
        signals,
        step,
        make_read_only(append_columns(run, structure, means, step, local_smoothing=local_smoothing)),
        tuple(s in run.inputs or s not in structure.signals for s in signals),
        sensor,
        initial,
        structure.offset,
        structure.filter_states(initial),
    )


def without_level(run: Run, structure: Structure) -> tuple[Run, Structure]:
    """Return the run minus the levels of its outputs, and the structure without offset, for the offset ``"level"``.

    For other offsets, return run and structure unchanged.
    """
    if structure.offset != "level":
        return run, structure
    return deviations(run, structure)[0], replace(structure, offset="none")


def recording(run: Run, structure: Structure, initial: Initial | None = None) -> _core.Recording:
    """Return a run as an object of the Rust core, from which the Rust core computes block-pulse means for a structure.

    `initial` replaces the initial conditions of the structure. The core applies delays, saturations and dead zones.
    Raise FtlmError for a missing signal, a delay of an output or a missing sample of an input.
    """
    initial = resolve_initial_conditions(run, structure) if initial is None else initial
    run, structure = without_level(run, structure)
    _check_missing(run, structure)
    check_derivative_orders(run, structure)
    sensor, signals = structure.sensor_filter, structure.signals
    # Friction and non-linear terms are simulated on the uniform grid.
    samples = run.nonuniform_samples if structure.is_linear else None
    return _core.Recording(
        {
            "name": run.name,
            "step": run.step,
            "times": None if samples is None else samples.times,
            "signals": [_channel(run, structure, name, samples) for name in signals],
            "outputs": [signals.index(name) for name in structure.outputs],
            "filter": None if sensor is None else (sensor.numerator, sensor.denominator),
            "filter_states": structure.filter_states(initial),
            "at_rest": initial == "rest",
            "coupled": structure.coupling == "simulated",
            "friction": not structure.is_linear,
            "free": [(signals.index(item.signal), item.kind) for item in structure.free_input_parameters],
        }
    )


def _missing_signals_text(run: Run, structure: Structure) -> str:
    """Return the error message on signals that a run lacks, with the options that select columns for them."""
    missing = [n for n in structure.signals if n not in run and not n.startswith(COULOMB_PREFIX)]
    roles = {"outputs": [n for n in missing if n in structure.outputs]}
    roles["inputs"] = [n for n in missing if n not in roles["outputs"]]
    column = Placeholder("column")
    options = [
        choose_text(
            parameter(role, dict.fromkeys(names, column)), " ".join(parameter(role, {n: column}) for n in names)
        )
        for role, names in roles.items()
        if names
    ]
    lines = [
        f"{', '.join(f'{n} = {QUOTED_COLUMN}' for n in names)} under [{role}]" for role, names in roles.items() if names
    ]
    in_a_file = f", or in a file for {parameter('columns')} with {' and '.join(lines)}"
    description = f"signal {missing[0]!r}{nearest(missing[0], run.signals)}"
    if len(missing) > 1:
        description = f"signals {', '.join(map(repr, missing))}"
    return (
        f"run {run.name!r} has no {description}, which the model needs; it has {', '.join(run.signals)}: name the "
        "columns "
        f"with {choose_text(' and ', ' ').join(options)}{choose_text(in_a_file, in_a_file, '')}"
    )


def _channel(run: Run, structure: Structure, name: str, samples: NonuniformSamples | None) -> _core._Channel:
    """Return a signal of a run, with its nonuniform `samples` if there are any, in the form that the Rust core takes.

    For a name with the prefix ``coulomb_``, the signal is the sign of the derivative of the signal after the prefix.

    Raise DataError if the run lacks the signal, and ModelError for a delay of an output or too large a lead.
    """
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
    signal = name.removeprefix(COULOMB_PREFIX)
    if name not in run and signal != name and signal in run:
        # The sign of the measured rate over each interval. The last value is repeated, so that there are N values.
        rate = np.sign(np.diff(run[signal]))
        return {**channel, "samples": np.append(rate, rate[-1])}
    if name not in run:
        raise DataError(_missing_signals_text(run, structure))
    delay = structure.delay.get(name)
    if delay and name not in run.inputs:
        raise ModelError(f"delay of {name} = {delay:g} s, but run {run.name!r} has it as an output; delay inputs")
    least_delay = delay if delay is not None else structure.free_delays.get(name, (0.0,))[0]
    if least_delay < -run.step * (1.0 + MAX_EARLY_ROUNDING):
        raise ModelError(
            f"delay of {name} = {least_delay:g} s is a lead of more than one sampling interval ({run.step:g} s) of run "
            f"{run.name!r}; shift the rows of that input"
        )
    limits = [limit for limit in structure.limits if limit.signal == name]
    return {
        **channel,
        "samples": run[name],
        "nonuniform": None if samples is None else samples.data[name],
        "role": run.intersample.get(name, "output"),
        "delay": delay,
        "limits": [(limit.kind, None if isinstance(limit.value, tuple) else limit.value) for limit in limits],
    }


def _check_known_inputs(structure: Structure) -> None:
    """Raise ModelError if the structure has a free delay, saturation or dead zone."""
    for item in structure.free_input_parameters:
        description, value = ("delays", "value in seconds") if item.kind == "delay" else ("limits", "value")
        raise ModelError(
            f"the {item.description} is free: only {parameter('method', 'output-error')} estimates {description}; give "
            f"its {value}"
        )


def apply_input_nonlinearity(run: Run, structure: Structure) -> Run:
    """Return the run with the structure's known saturations and dead zones applied to its inputs."""
    _check_known_inputs(structure)
    limits = [limit for limit in structure.limits if limit.signal in run]
    return run.with_input_nonlinearities(limits) if limits else run


def check_derivative_orders(run: Run, structure: Structure, order_values: Mapping[str, float] | None = None) -> None:
    """Raise ModelError for a term whose order is too high for the samples of its signal.

    In an equation of order alpha, the order of every signal except the output must be below alpha + 1. The order of a
    zero-order-hold input must be at most alpha, because jumps have no derivative. `order_values` are values of free
    orders by name; terms with other free orders are not checked.
    """
    for equation in structure.equations:
        alpha = equation.order.substitute(order_values or {})
        for term in equation.terms:
            order = term.order.substitute(order_values or {})
            if alpha.names or order.names or order.constant <= alpha.constant + ORDER_RESOLUTION:
                continue
            if term.signal in run.inputs and run.intersample[term.signal] == "zoh":
                raise ModelError(
                    f"order {order.constant:g} of {term.signal} is above alpha = {alpha.constant:g} of "
                    f"{equation.output}, and {term.signal} of run {run.name!r} has a zero-order hold, whose jumps have "
                    f"no derivative; reduce the order, or set {parameter('intersample', 'foh')} if the signal is "
                    "linear between samples"
                )
            _check_excess_order(term.signal, order.constant, equation.output, alpha.constant)


def _check_excess_order(signal: str, order: float, output: str, alpha: float) -> None:
    """Raise ModelError if the order of a signal is at least alpha + 1, where alpha is the order of the equation.

    The equation's own output is exempt.
    """
    if signal != output and order > alpha + MAX_IMPROPER_ORDER - ORDER_RESOLUTION:
        raise ModelError(
            f"order {order:g} of {signal} is {order - alpha:g} above alpha = {alpha:g} of {output}; in the time "
            "domain the order of another signal must be below alpha + 1; lower it"
        )


def records(
    runs: Sequence[Run], structure: Structure, m: int, *, filtered: bool = True, local_smoothing: bool = True
) -> list[Record]:
    """Return the block-pulse records of several runs; see :func:`record`.

    If `runs` is a :class:`Runs`, it caches the records. Records with more pulses than sampling intervals are not
    cached, because they are large and used once.
    """

    def build() -> list[Record]:
        return [
            record(run, resolve_start([run], structure), m, filtered=filtered, local_smoothing=local_smoothing)
            for run in runs
        ]

    if not isinstance(runs, Runs) or m >= min(run.length for run in runs):
        return build()
    filtered = filtered or structure.sensor_filter is None
    inputs = (structure.delay, structure.free_delays, structure.limits)
    settings = (record_signals(structure), inputs, structure.sensor_filter, structure.initial)
    start = (
        structure.offset,
        structure.outputs,
        has_memory(structure),
        [e.order.constant for e in structure.equations],
    )
    return list(runs.get_or_compute(repr((settings, start, m, filtered, local_smoothing)), build))


def sensor_series(structure: Structure, m: int, step: float) -> Floats | None:
    """Return the power series of the sensor filter on m block pulses of width `step` [s]; None without a filter."""
    sensor = structure.sensor_filter
    if sensor is None:
        return None
    return (_short_series if m <= SHORT_SERIES_PULSES else _long_series)(sensor.numerator, sensor.denominator, m, step)


def _filter_series(
    numerator: tuple[tuple[float, float], ...], denominator: tuple[tuple[float, float], ...], m: int, step: float
) -> Floats:
    """Return the power series of a transfer function on m block pulses of width `step` [s].

    Numerator and denominator are (coefficient, exponent of s) pairs.
    """
    return make_read_only(_core.filter_series(list(numerator), list(denominator), m, step))


_long_series, _short_series = (
    lru_cache(maxsize=CACHED_LONG_SERIES)(_filter_series),
    lru_cache(maxsize=CACHED_SHORT_SERIES)(_filter_series),
)


def _check_missing(run: Run, structure: Structure) -> None:
    """Raise DataError if samples are missing in a measured signal that enters another equation as an input.

    With a sensor filter on all signals, missing samples of outputs raise DataError as well.
    """
    missing = run.missing_samples
    if not missing:
        return
    outputs, coupled = structure.outputs, structure.coupling == "simulated"
    input_signals = {
        name: e.output
        for e in structure.equations
        for name in (s.removeprefix(COULOMB_PREFIX) if s not in run else s for s in e.signals)
        if name != e.output and not (coupled and name in outputs)
    }
    first_missing = next((name for name in missing if name in input_signals), None)
    if first_missing is not None:
        mask = missing[first_missing]
        raise DataError(
            f"signal {first_missing!r} of run {run.name!r} has no value in {plural(int(mask.sum()), 'row')}, first row "
            f"{int(np.flatnonzero(mask)[0])}, and enters the equation of {input_signals[first_missing]} as "
            "measured; fill these "
            f"rows yourself, avoid them with {parameter('window')}, or use {parameter('coupling', 'simulated')}"
        )
    if structure.all_filtered and any(name in missing for name in outputs):
        raise DataError(
            f"run {run.name!r} has missing samples, and a sensor filter with {parameter('coupling', 'measured')}, or "
            f"on an input of the model, requires all samples; use {parameter('coupling', 'simulated')}, or a part "
            "without gaps"
        )


def check_no_missing(runs: Sequence[Run], what: str) -> None:
    """Raise DataError if runs have missing samples; `what` names the analysis that does not allow them."""
    for run in runs:
        for name, is_missing in run.missing_samples.items():
            raise DataError(
                f"output {name!r} of run {run.name!r} has no value in {plural(int(is_missing.sum()), 'row')}, "
                f"first row "
                f"{int(np.flatnonzero(is_missing)[0])}: {what} requires all samples; use "
                f"{parameter('method', 'output-error')} (identify), a part without gaps, or fill them yourself"
            )


def structure_tuple(equation: Equation, signals: Sequence[str]) -> tuple[int, float, list[tuple[int, float]]]:
    """Return a linear equation as (output index, alpha, [(signal index, order), …]), the form that the Rust core takes.

    All orders must be numbers.

    Raises
    ------
    ModelError
        If the equation has friction or another non-linear term.
    """
    check_frictionless([equation], "a method that is linear in the coefficients")
    return linear_tuple(equation, signals)


def check_linear(equations: Sequence[Equation], what: str) -> None:
    """Raise ModelError if an equation has friction or a non-linear term; `what` names the analysis."""
    check_frictionless(equations, what)
    for equation in equations:
        for term in equation.nonlinear_terms:
            point = parameter("at", dict.fromkeys(term.signals, 0.3))
            linear = choose_text(f"model.linearized({point})", "Model.linearized in Python")
            raise ModelError(
                f"the equation of {equation.output} has the non-linear term {term}, and {what} needs a linear model; "
                f"use the linear model about an operating point, {linear}, or simulations (simulate, compare)"
            )


def check_frictionless(equations: Sequence[Equation], what: str) -> None:
    """Raise ModelError if an equation has friction, which is not linear in its parameters.

    `what` names the analysis in the message.
    """
    for equation in equations:
        if equation.friction is not None:
            raise ModelError(
                f"the equation of {equation.output} has friction, and {what} needs a linear model; use "
                f"{parameter('method', 'output-error')} and simulations (simulate, compare), or remove the friction"
            )


def linear_tuple(equation: Equation, signals: Sequence[str]) -> tuple[int, float, list[tuple[int, float]]]:
    """Return an equation without its friction as (output index, alpha, [(signal index, order), …]), for Rust.

    `signals` are the rows of the record. A non-linear term has the index of its row; raise ModelError if there is
    no such row.
    """
    index = {name: i for i, name in enumerate(signals)}
    if any(t.column not in index for t in equation.nonlinear_terms):
        check_linear([equation], "a computation on the signals alone")
    terms = [(index[t.column], t.order.constant) for t in equation.terms]
    return index[equation.output], equation.order.constant, terms


def derived_signals(structure: Structure) -> list[_core._Derived]:
    """Return each expression of a non-linear term as (instructions, [(signal index, order), …]), for Rust.

    The pairs are the channels of the expression. The core appends the values of the expressions to the signals.
    """
    return [
        (
            item.program({channel: i for i, channel in enumerate(item.channels)}),
            [(structure.signals.index(signal), order) for signal, order in item.channels],
        )
        for item in nonlinear_columns(structure).values()
    ]


def order_grid_tuple(
    equation: Equation, signals: Sequence[str], values: Mapping[str, Sequence[float]]
) -> tuple[int, list[float], list[tuple[int, list[float], bool]]]:
    """Return an equation with grids of orders in the form that the Rust core takes.

    The result is (output index, values of alpha, [(signal index, values of the order, whether coefficient and order are
    free), …]). `values` are the grid values of free orders by name. Every order must be a number or a single free
    order.
    """

    def axis(order: Order) -> list[float]:
        return list(values[order.names[0]]) if order.names else [order.constant]

    terms = [
        (signals.index(t.column), axis(t.order), bool(t.order.names) and t.fixed_value is None) for t in equation.terms
    ]
    return signals.index(equation.output), axis(equation.order), terms


def affine(order: Order, names: Sequence[str]) -> tuple[float, list[float]]:
    """Return the constant of an affine order, and the weight of each free order in `names` (0 for an absent one)."""
    weights = dict(order.weights)
    return order.constant, [weights.get(n, 0.0) for n in names]


def equation_tuple(
    equation: Equation, signals: Sequence[str]
) -> tuple[tuple[int, float, list[tuple[int, float]]], list[float]]:
    """Return an identified linear equation in the form of :func:`structure_tuple`, and its coefficient values."""
    for term in equation.terms:
        _check_excess_order(term.signal, term.order.constant, equation.output, equation.order.constant)
    return structure_tuple(equation, signals), [float(t.fixed_value or 0.0) for t in equation.terms]


def initial_tuple(initial: Initial, offset: Offset = "none", states: int = 0) -> InitialTuple:
    """Return initial conditions, offset and number of filter states in the form of :data:`InitialTuple`."""
    powers = [] if isinstance(initial, str) else list(initial)
    fixed_terms = (initial == "caputo", powers)
    if states:
        return (*fixed_terms, ("none", "constant", "ramp", "level").index(offset), states)
    return fixed_terms if offset == "none" else (*fixed_terms, ("none", "constant", "ramp", "level").index(offset))


def error_with_signal_names(error: ModelError, signals: Sequence[str]) -> ModelError:
    """Return a copy of an error of the Rust core, with names in place of signal indices in its message."""
    return ModelError(re.sub(r"signal (\d+)", lambda m: f"signal {signals[int(m[1])]!r}", str(error)))


def prepare(
    runs: Sequence[Run],
    structure: Structure,
    m: int | None,
    *,
    power_of_two: bool,
    gaps: bool = False,
    local_smoothing: bool = True,
) -> list[Record]:
    """Return the block-pulse records of runs for an equation-error estimator, with common initial conditions.

    `m` is the number of block pulses; None for the default. With `gaps`, missing samples of outputs are allowed: the
    estimator must exclude them.

    Raises
    ------
    DataError
        If samples are missing, an output is constant, a non-linear term is not finite, or a coefficient is not
        identifiable because its signal is 0 or equivalent to the offset.
    ModelError
        If `m` is invalid, the offset is ``"auto"``, or the data lack a derivative in a non-linear term.
    """
    check_offset_resolved(structure.offset)
    if not gaps:
        check_no_missing(runs, "an estimator on the equation error")
    structure = resolve_start(runs, structure)
    m = check_m(default_m(runs, power_of_two=power_of_two) if m is None else m, runs, power_of_two=power_of_two)
    for run in runs:
        run.require_outputs([o for o in structure.outputs if o in run])
    prepared = records(runs, structure, m, local_smoothing=local_smoothing)
    common = common_initial_conditions([r.initial for r in prepared])
    if common is not None:
        # All runs of a fit have the same initial terms; those of a run from rest are estimated as zero.
        prepared = records(runs, replace(structure, initial=common), m, local_smoothing=local_smoothing)
    for run, rec in [] if gaps else zip(runs, prepared, strict=True):
        check_columns(run, structure, dict(zip(rec.signals, rec.means, strict=True)), rec.step)
    for equation in structure.equations:
        for term in equation.terms:
            if (
                term.fixed_value is None
                and term.column != equation.output
                and not any(r.of(term.column).any() for r in prepared)
            ):
                raise DataError(
                    f"{term.column} is 0 in all rows, so its coefficient in the equation of {equation.output} "
                    "cannot be "
                    "identified; remove the term, fix its coefficient, or add a run in which the signal is not 0"
                )
            if structure.offset in ("constant", "ramp") and _is_offset(term, equation, prepared):
                raise DataError(
                    f"{term.column} is constant on every run, so {term} and the offset in the equation of "
                    f"{equation.output} are not separately identifiable; add a run in which it changes, fix its "
                    f"coefficient, or use {parameter('offset', 'none')}"
                )
    return prepared


def _is_offset(term: Term, equation: Equation, prepared: Sequence[Record]) -> bool:
    """Whether a free term of order 0 has a constant signal in every run, so that it is equivalent to an offset."""
    if term.fixed_value is not None or term.column == equation.output or term.order.names or term.order.constant != 0:
        return False
    return all(float(np.ptp(r.of(term.column))) == 0.0 for r in prepared)


def named_coefficients(equation: Equation, values: Sequence[float]) -> dict[str, float]:
    """Return the free coefficients by name: the estimates `values` divided by the known factor of each term."""
    return {
        t.coefficient: c / t.factor
        for t, c in zip(equation.terms, values, strict=True)
        if isinstance(t.coefficient, str)
    }


def has_nonuniform_samples(run: Run, structure: Structure) -> bool:
    """Whether simulation and measurement are compared at nonuniform sample times.

    The uniform grid is used instead if a delay, saturation or dead zone is free, if all signals are filtered, or with
    friction or non-linear terms.
    """
    needs_grid = structure.free_input_parameters or structure.all_filtered or not structure.is_linear
    return run.nonuniform_samples is not None and not needs_grid


def compared_times(run: Run, structure: Structure) -> Floats:
    """Return the times [s since the first sample] at which a run is compared with a simulation."""
    if run.nonuniform_samples is None or not has_nonuniform_samples(run, structure):
        return run.time
    return run.nonuniform_samples.times[run.nonuniform_samples.indices_within(run.duration)]


def compared_values(run: Run, structure: Structure, name: str) -> Floats:
    """Return the measured values of a signal at the times of :func:`compared_times`; NaN for missing samples."""
    if run.nonuniform_samples is None or not has_nonuniform_samples(run, structure):
        return run[name]
    return run.nonuniform_samples.data[name][run.nonuniform_samples.indices_within(run.duration)]


def values_at_residuals(run: Run, structure: Structure, name: str) -> Floats:
    """Return the measured values of a signal at the times of a fit's residuals; NaN for missing samples.

    A fit compares all nonuniform samples after t = 0, and all uniform samples except the first and the last.
    """
    values = compared_values(run, structure, name)
    if has_nonuniform_samples(run, structure):
        return values[compared_times(run, structure) > 0.0]
    return values[1:-1]
