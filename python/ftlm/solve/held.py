"""What a sensor filter still held when a run began, taken out of the signals that drive behind it.

A signal that was measured through the filter is the filter's answer to what the machine did since the run began, and
beside it the free motion of what it held before. Only the first is the machine's: the second drives nothing, and at the
first sample it is a jump, whose derivative of an order above the equation's is infinite.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.data.filters import SensorFilter
from ftlm.data.run import Run
from ftlm.data.samples import HELD, locked
from ftlm.data.structures import Structure
from ftlm.solve.motion import decided

#: What a filter held is told from what came in over this share of the time in which its fastest pole turns, in which
#: what came in is as good as a level and a slope; and over so many samples a number at least.
SHOWN = 1.0
SAMPLES = 2
#: A filter whose fastest pole turns so often in a sample interval has forgotten what it held before anybody sees it.
FORGOTTEN = 1e3
#: Answers of a filter that are kept: those of the grids at hand.
KEPT = 4


def without_held(run: Run, structure: Structure, name: str | None = None) -> Run:
    """Return the run less the filter's free motion in its signals, or in one, that drive behind it.

    From rest the filter held nothing. Left as they are: outputs that drive no other equation, held or delayed commands,
    and filters whose free motions are more than answers to impulses or gone before the second sample.
    """
    sensor = structure.sensor_filter
    if sensor is None or not structure.behind_filter:
        return run
    names = [n for n in ([name] if name else structure.signals) if n in run and _drives(run, structure, n)]
    if not names or not sensor.holds_answers or _fastest(sensor) * run.step > FORGOTTEN:
        return run
    states = structure.filter_states(decided(run, structure))
    if not states:
        return run
    changed = {n: run[n] - _held(run[n], run.step, sensor, states) for n in names}
    if run.readings is None:
        return run.with_samples(changed)
    times = run.readings.times
    own = {n: run.readings.data[n] - np.interp(times, run.time, run[n] - v) for n, v in changed.items()}
    return run.with_samples(changed, own)


def _drives(run: Run, structure: Structure, name: str) -> bool:
    """Whether a signal that came through the filter drives an equation that is not its own."""
    if not structure.measured_through(name) or (structure.coupling == "simulated" and name in structure.outputs):
        return False
    if name in run.inputs and (run.intersample[name] == HELD or name in (*structure.delay, *structure.free_delays)):
        return False
    return any(t.signal == name for e in structure.equations if e.output != name for t in e.terms)


def _held(samples: Floats, step: float, sensor: SensorFilter, states: int) -> Floats:
    """The free motion of the filter at the samples of a signal: the first one is all free motion."""
    system, gain = _states(sensor)
    size = system.shape[0]
    fastest = _fastest(sensor)
    shown = round(SHOWN / (fastest * step)) if fastest > 0 else 0
    count = min(max(shown, SAMPLES * (states + 2)), samples.size)
    # A level and a slope that come in are two states more, which nothing moves but the slope the level.
    whole = np.zeros((size + 2, size + 2))
    whole[:size, :size], whole[size - 1, size], whole[size, size + 1] = system, gain, 1.0
    begun = np.zeros((size + 2, states + 2))
    begun[:size, :states] = _caught(system, gain, states)
    begun[size, states], begun[size + 1, states + 1] = 1.0, 1.0
    columns = _motions(whole * step, begun, count, 0)
    jump = columns[0, states - 1]
    rest = np.delete(columns, states - 1, axis=1)
    level = samples[0] / jump
    sizes = np.linalg.norm(rest, axis=0)
    sizes[sizes == 0] = 1.0
    found = np.linalg.lstsq(rest / sizes, samples[:count] - level * columns[:, states - 1], rcond=None)[0] / sizes
    first = begun[:size, :states] @ np.append(found[: states - 1], level)
    return _motions(system * step, first[:, None], samples.size, 0)[:, 0]


@lru_cache(maxsize=KEPT)
def answers(sensor: SensorFilter, states: int, m: int, step: float) -> Floats | None:
    """Pulse means of a filter's answers to an impulse and to derivatives of one, shape (states, m).

    Pulses would have an impulse last for one of them, and its derivative for two. None of a filter with zeros, or that
    forgets within a pulse.
    """
    if not sensor.holds_answers or not states or _fastest(sensor) * step > FORGOTTEN:
        return None
    system, gain = _states(sensor)
    size = system.shape[0]
    # What the answer has come to is one state more.
    whole = np.zeros((size + 1, size + 1))
    whole[:size, :size], whole[size, 0] = system, 1.0
    begun = np.zeros((size + 1, states))
    begun[:size] = _caught(system, gain, states)
    return locked(np.ascontiguousarray(np.diff(_motions(whole * step, begun, m + 1, size), axis=0).T / step))


def _caught(system: Floats, gain: float, states: int) -> Floats:
    """States after an impulse, and after derivatives of one, column by column."""
    # An impulse is caught by the last state; each derivative of one goes through the system once more.
    return np.stack([np.linalg.matrix_power(system, k)[:, -1] * gain for k in range(states)], axis=1)


def _states(sensor: SensorFilter) -> tuple[Floats, float]:
    """A filter without zeros as a chain of states, of which the first is its answer, and what the last one catches."""
    powers = {int(order): 0.0 for _, order in sensor.denominator}
    for coefficient, order in sensor.denominator:
        powers[int(order)] += coefficient
    size = max(order for order, coefficient in powers.items() if coefficient)
    system = np.diag(np.ones(size - 1), 1)
    system[-1] = [-powers.get(k, 0.0) / powers[size] for k in range(size)]
    return system, sum(c for c, _ in sensor.numerator) / powers[size]


def _fastest(sensor: SensorFilter) -> float:
    """How fast the fastest pole of a filter without zeros is [rad/s]."""
    return float(np.max(np.abs(np.linalg.eigvals(_states(sensor)[0])), initial=0.0))


def _motions(system: Floats, begun: Floats, count: int, state: int) -> Floats:
    """A state at so many samples, a unit of time apart, from each of several beginnings, shape (count, beginnings)."""
    power = exponential(system)
    states = begun[None]
    while states.shape[0] < count:
        states = np.concatenate([states, power @ states])
        power = power @ power
    return np.asarray(states[:count, state])


def exponential(matrix: Floats) -> Floats:
    """Exponential of a small matrix: Taylor's series of a part so small that its terms soon vanish, squared again."""
    halvings = max(0, math.ceil(math.log2(max(float(np.linalg.norm(matrix, 1)), 1e-300))) + 1)
    part = matrix / 2.0**halvings
    term = total = np.eye(matrix.shape[0])
    for k in range(1, 20):
        term = term @ part / k
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total
