"""Sampling of runs as the definitions say it, in NumPy: what the core's recordings are compared with."""

import math
from dataclasses import dataclass, replace

import numpy as np

from ftlm import _core, kernels
from ftlm.simulation.discretization import apply_input_nonlinearity, compared_times, compared_values, sensor_series
from ftlm.simulation.discretization import has_nonuniform_samples as is_nonuniform
from ftlm.simulation.initial_conditions import resolve_initial_conditions


def grid(rows, step):
    return np.arange(rows, dtype=np.float64) * step


# ----------------------------------------------------------------------------------------------------------------------
# Means at sample times of their own


def hold_means(times, values, m, step):
    """Means of a hold over m pulses, cut at the old samples; those within rounding of an edge are at it."""
    edges, close = grid(m + 1, step), 1e-6 * step
    near = np.minimum(np.searchsorted(edges, times, side="left"), m)
    near = np.where((near > 0) & (np.abs(edges[near - 1] - times) <= close), near - 1, near)
    snapped = np.where(np.abs(edges[near] - times) <= close, edges[near], times)
    cuts = np.unique(np.concatenate([edges, snapped[snapped < edges[-1]]]))
    row, first = np.searchsorted(snapped, cuts[:-1], side="right") - 1, np.searchsorted(cuts, edges[:-1])
    begin = values[row[first]]
    ramps = (values[row] - np.repeat(begin, np.diff(np.append(first, row.size)))) * (np.diff(cuts) / step)
    return begin + np.add.reduceat(ramps, first)


def linear_means(times, values, m, step):
    edges = grid(m + 1, step)
    area = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(times))])
    row = np.clip(np.searchsorted(times, edges, side="right") - 1, 0, times.size - 1)
    there = np.interp(edges, times, values)
    return np.diff(area[row] + 0.5 * (values[row] + there) * (edges - times[row])) / step


@dataclass(frozen=True)
class Line:
    """An input at its own times, late by a delay."""

    times: np.ndarray
    values: np.ndarray
    is_zero_order_hold: bool

    @classmethod
    def of(cls, run, structure, name, before):
        own, delay = run.nonuniform_samples, structure.delay.get(name, 0.0)
        times, values = (run.time, run[name]) if own is None else (own.times, own.data[name])
        if delay:
            times, values = np.append(0.0, times + delay), np.append(before, values)
        return cls(times, values, run.intersample.get(name) == "zoh")

    def means(self, m, step):
        return (hold_means if self.is_zero_order_hold else linear_means)(self.times, self.values, m, step)

    def jumps(self):
        return self.times, np.diff(self.values, prepend=0.0)

    def at(self, times):
        if not self.is_zero_order_hold:
            return np.interp(times, self.times, self.values)
        slack = 1e-12 * max(float(self.times[-1]), 1e-300)
        return self.values[np.maximum(np.searchsorted(self.times, times + slack, side="right") - 1, 0)]


# ----------------------------------------------------------------------------------------------------------------------
# Sensor filters


def filter_states(sensor):
    """A filter without zeros as a chain of states, the output first, and the gain of its input."""
    powers = {int(order): 0.0 for _, order in sensor.denominator}
    for coefficient, order in sensor.denominator:
        powers[int(order)] += coefficient
    size = max(order for order, coefficient in powers.items() if coefficient)
    system = np.diag(np.ones(size - 1), 1)
    system[-1] = [-powers.get(k, 0.0) / powers[size] for k in range(size)]
    return system, sum(c for c, _ in sensor.numerator) / powers[size]


def fastest_pole(sensor):
    return float(np.max(np.abs(np.linalg.eigvals(filter_states(sensor)[0])), initial=0.0))


def impulse_states(system, gain, states):
    return np.stack([np.linalg.matrix_power(system, k)[:, -1] * gain for k in range(states)], axis=1)


def matrix_exponential(matrix):
    """Scaling and squaring of a Taylor series."""
    halvings = max(0, math.ceil(math.log2(max(float(np.linalg.norm(matrix, 1)), 1e-300))) + 1)
    part = matrix / 2.0**halvings
    term = total = np.eye(matrix.shape[0])
    for k in range(1, 20):
        term = term @ part / k
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total


def free_responses(system, initial, count, state):
    """One state at unit time steps for several initial states, shape (count, initial states)."""
    power, states = matrix_exponential(system), initial[None]
    while states.shape[0] < count:
        states = np.concatenate([states, power @ states])
        power = power @ power
    return states[:count, state]


def filter_transient(samples, step, sensor, states):
    """Transient of the filter at the samples of a signal; the first sample is all transient."""
    system, gain = filter_states(sensor)
    size, fastest = system.shape[0], fastest_pole(sensor)
    rows = round(1.0 / (fastest * step)) if fastest > 0 else 0
    count = min(max(rows, 2 * (states + 2)), samples.size)
    whole = np.zeros((size + 2, size + 2))
    whole[:size, :size], whole[size - 1, size], whole[size, size + 1] = system, gain, 1.0
    initial = np.zeros((size + 2, states + 2))
    initial[:size, :states] = impulse_states(system, gain, states)
    initial[size, states], initial[size + 1, states + 1] = 1.0, 1.0
    columns = free_responses(whole * step, initial, count, 0)
    rest, level = np.delete(columns, states - 1, axis=1), samples[0] / columns[0, states - 1]
    sizes = np.linalg.norm(rest, axis=0)
    sizes[sizes == 0] = 1.0
    solution = np.linalg.lstsq(rest / sizes, samples[:count] - level * columns[:, states - 1], rcond=None)[0] / sizes
    first = initial[:size, :states] @ np.append(solution[: states - 1], level)
    return free_responses(system * step, first[:, None], samples.size, 0)[:, 0]


def impulse_responses(sensor, states, m, step):
    """Pulse means of a filter's responses to an impulse and its derivatives; None where it has none of these."""
    if not sensor.has_impulse_transient or not states or fastest_pole(sensor) * step > 1e3:
        return None
    system, gain = filter_states(sensor)
    size = system.shape[0]
    whole = np.zeros((size + 1, size + 1))
    whole[:size, :size], whole[size, 0] = system, 1.0
    initial = np.zeros((size + 1, states))
    initial[:size] = impulse_states(system, gain, states)
    return np.diff(free_responses(whole * step, initial, m + 1, size), axis=0).T / step


def enters_as_input(run, structure, name):
    if not structure.is_filtered(name) or (structure.coupling == "simulated" and name in structure.outputs):
        return False
    late = name in (*structure.delay, *structure.free_delays)
    if name in run.inputs and (run.intersample[name] == "zoh" or late):
        return False
    return any(t.signal == name for e in structure.equations if e.output != name for t in e.terms)


def acting(run, structure):
    """The run behind its limits, without the transients of its sensor filter."""
    run, sensor = apply_input_nonlinearity(run, structure), structure.sensor_filter
    if sensor is None or not structure.all_filtered or not sensor.has_impulse_transient:
        return run
    states = structure.filter_states(resolve_initial_conditions(run, structure))
    names = [n for n in structure.signals if n in run and enters_as_input(run, structure, n)]
    if not names or not states or fastest_pole(sensor) * run.step > 1e3:
        return run
    changed = {n: run[n] - filter_transient(run[n], run.step, sensor, states) for n in names}
    if run.nonuniform_samples is None:
        return run.with_samples(changed)
    own = run.nonuniform_samples
    read = {n: own.data[n] - np.interp(own.times, run.time, run[n] - v) for n, v in changed.items()}
    return run.with_samples(changed, read)


# ----------------------------------------------------------------------------------------------------------------------
# Records and experiments


def gapless(values):
    is_missing = np.isnan(values)
    rows = np.arange(values.size)
    return (
        np.where(is_missing, np.interp(rows, rows[~is_missing], values[~is_missing]), values)
        if is_missing.any()
        else values
    )


def means_of(run, structure, name, m, at_rest):
    """Pulse means of one signal of a run that already acts."""
    if name not in run:
        rate = np.sign(np.diff(run[name.removeprefix("coulomb_")]))
        return kernels.pulse_means(np.append(rate, rate[-1]), m, hold=True)
    samples, delay, step = gapless(run[name]), structure.delay.get(name, 0.0), run.duration / m
    is_hold, before = run.intersample.get(name) == "zoh", 0.0 if at_rest else float(run[name][0])
    if run.nonuniform_samples is not None and name not in run.missing_samples:
        return Line.of(run, structure, name, before).means(m, step)
    if delay:
        intervals = run.length - 1
        every = m // intervals if is_hold and m % intervals == 0 else 1
        samples = np.repeat(samples, every)[: intervals * every + 1]
        samples = _core.delay_samples(samples, delay / run.step * every, before)
    return kernels.pulse_means(samples, m, hold=is_hold)


def pulses(run, structure, m, filtered):
    """Step, means, series of the filter, (signals with a transient, levels, responses), as the core tells them."""
    initial, step = resolve_initial_conditions(run, structure), run.duration / m
    sensor, rows, there = sensor_series(structure, m, step) if filtered else None, [], acting(run, structure)
    for name in structure.signals:
        row = means_of(there, structure, name, m, initial == "rest")
        rows.append(row if sensor is None or structure.is_filtered(name) else _core.series_multiply(sensor, row, m))
    states, limited = structure.filter_states(initial), apply_input_nonlinearity(run, structure)
    levels = []
    for name in structure.signals:
        none = initial == "rest" or name not in run or (structure.all_filtered and structure.is_filtered(name))
        first = 0.0 if none else float(limited[name][0])
        levels.append(first if math.isfinite(first) else 0.0)
    transient = [states > 0 and sensor is not None and structure.is_filtered(s) for s in structure.signals]
    responses = None if sensor is None else impulse_responses(structure.sensor_filter, states, m, step)
    return step, np.stack(rows), sensor, (transient, levels, responses)


def experiment(run, structure, *, every=1, decimation=1):
    """A run on a grid with the samples to compare with, as the core takes it; nothing of its inputs is free."""
    structure = structure.without_free_input_parameters()
    rows = (run.length - 1) // decimation * decimation + 1
    if rows != run.length:
        run = run.window(None, rows * run.step - run.step / 2)
    m, own, weights = (rows - 1) // decimation * every, is_nonuniform(run, structure), [1.0] * len(structure.outputs)
    step, means, sensor, initial = pulses(run, structure, m, structure.all_filtered)
    series = None if sensor is not None else sensor_series(structure, m, step)
    of = dict(zip(structure.signals, means, strict=True))
    if own:
        times = compared_times(run, structure)
        sample_rows = np.flatnonzero(times > 0.0)[::decimation]
        samples = np.stack([compared_values(run, structure, o)[sample_rows] for o in structure.outputs])
        signals, jumps, limited = [], [], apply_input_nonlinearity(run, structure)
        at_rest = resolve_initial_conditions(run, structure) == "rest"
        for name in structure.signals:
            line = None
            if name in run:
                line = Line.of(
                    limited, structure, name, 0.0 if at_rest else float(limited.nonuniform_samples.data[name][0])
                )
            values = None if line is None else line.at(times[sample_rows])
            signals.append((None if values is None or np.isnan(values).any() else values, False))
            jump_pair = None if line is None or not line.is_zero_order_hold else line.jumps()
            jumps.append(None if jump_pair is None else (jump_pair[0] / step, jump_pair[1]))
        places = np.minimum(times[sample_rows] / step, float(m)), jumps
    else:
        plain = [sensor is None or structure.is_filtered(o) for o in structure.outputs]
        samples = np.stack(
            [
                run[o][::decimation] if p else _core.point_samples(of[o])[::every]
                for o, p in zip(structure.outputs, plain, strict=True)
            ]
        )
        signals = [instant(run, structure, n, of, sensor, every, decimation) for n in structure.signals]
        places = None
    unread = np.isnan(samples)
    inner = unread if own else unread[:, 1:-1]
    record = (step, means, sensor, initial) if any(initial[0]) or any(initial[1]) else (step, means, sensor)
    return {
        "record": record,
        "pulses_per_sample": 1 if own else every,
        "samples": np.ascontiguousarray(np.where(unread, 0.0, samples)),
        "filter": None if series is None else (series, [structure.is_filtered(o) for o in structure.outputs]),
        "weights": weights,
        "signals": signals,
        "robust_weights": np.ascontiguousarray(np.where(inner, 0.0, 1.0)) if unread.any() else None,
        "sample_times": places,
    }


def instant(run, structure, name, means, sensor, every, decimation):
    """Values of a signal at the samples, after any jump there, and whether it is held between samples."""
    if name not in run or name in run.missing_samples or (sensor is not None and not structure.is_filtered(name)):
        return None, False
    is_hold, delay = name in run.inputs and run.intersample[name] == "zoh", structure.delay.get(name, 0.0)
    values = acting(run, structure)[name]
    if delay and is_hold:
        later = means[name][::every]
        return np.append(later, later[-1]), is_hold
    if delay:
        before = 0.0 if resolve_initial_conditions(run, structure) == "rest" else float(values[0])
        values = _core.delay_samples(values, delay / run.step, before)
    return np.ascontiguousarray(values[::decimation]), is_hold


def records(run, structure, m, inputs):
    """Step, means and series of the measured signals, with given free numbers of inputs, all behind the filter."""
    names = [item.name for item in structure.free_input_parameters]
    fixed = replace(structure.with_input_parameters(dict(zip(names, inputs, strict=True))), coupling="measured")
    return pulses(run, fixed, m, filtered=True)[:3]
