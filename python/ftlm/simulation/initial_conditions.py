"""How a run starts: at rest, or in motion, with powers of time for what it did before.

A fractional integral remembers all that was before the run: to c I^eta s it adds c/Gamma(eta) times the integral of
(t + s)^(eta-1) over the past s, which is no finite sum. It is smooth but for a start like t^eta, so a few powers of t
in quarters reproduce it to any noise; Caputo's own terms, those of a past in which nothing moved, do not. How many are
needed follows from how far the run stands above its noise, never from how well they fit: a length chosen by the fit
would make its intervals too short. The fit only decides between Caputo's terms and all of these, in favour of these
wherever there is a doubt.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from ftlm.data.run import Run
from ftlm.data.sampling import HELD, locked, read
from ftlm.structure.sensor_filter import SensorFilter
from ftlm.structure.structure import History, Initial, Structure
from ftlm.utils.linalg import length
from ftlm.utils.statistics import ROUNDING, chi_squared, huber_excess, is_rest, noise_of
from ftlm.utils.validation import Floats

#: Distance between the powers of time.
QUARTER = 0.25
#: Highest power, in quarters, that a signal REFERENCE times the deviation of its noise's mean needs: biases stay below
#: a tenth of a standard error (benches/RESULTS.md).
REFERENCE, QUARTERS = 2500.0, 6
#: One quarter more lets this factor less of the past through.
FACTOR = 2.5
#: Fewest and most quarters.
LEAST, MOST = 2, 12
#: Samples a run has for each quarter at least.
SPARSEST = 16
#: Whole powers below this stand among the quarters always, so that their list is that of any order up to 3.
WHOLE = 3
#: Caputo's terms are enough where a past that holds no more would leave a larger misfit than theirs in this share of
#: runs. The usual share of 1 or 5 % would let a weak past through unseen, with intervals too short for its bias. Beside
#: an offset, which explains a first value away from zero by itself and which a history would hide, it is less.
DOUBT, DOUBT_BESIDE_OFFSET = 0.25, 0.02
#: Share of an excess in squares that asks for a history as well: what few samples far out make of it is no history, but
#: where squares are what is fitted, no fit is to leave more than one with fewer numbers does that has a history.
OF_SQUARES = 0.25


def starts_at_rest(run: Run, structure: Structure) -> bool:
    """Whether all outputs of a structure start at zero within their noise."""
    return all(is_rest(run[name]) for name in structure.signals if name in run.outputs)


def has_memory(structure: Structure) -> bool:
    """Whether an order of a structure is free or no whole number: then what was before the run is no finite sum."""
    orders = [o for e in structure.equations for o in (e.order, *(t.order for t in e.terms))]
    return any(o.names or o.constant != round(o.constant) for o in orders)


def history(run: Run, structure: Structure) -> History:
    """Powers of time for what the run did before its start, as many as its outputs' noise lets through."""
    visible = 1.0
    for name in structure.outputs:
        if name in run:
            samples = read(run[name])
            # A level that is no offset is a part of the past; one that is takes no power of its own.
            size = length(samples - (0.0 if structure.offset == "none" else np.mean(samples)))
            if size:
                visible = max(visible, size / max(noise_of(run[name]), np.finfo(np.float64).eps * size))
    quarters = QUARTERS + math.ceil(math.log(visible / REFERENCE) / math.log(FACTOR))
    quarters = max(LEAST, min(quarters, MOST, run.length // SPARSEST))
    highest = max((e.order.constant for e in structure.equations if not e.order.names), default=0.0)
    whole = range(max(WHOLE, math.ceil(highest)))
    return History(sorted({*(QUARTER * k for k in range(quarters + 1)), *map(float, whole)}))


def decided(run: Run, structure: Structure) -> Initial:
    """The initial terms of a structure on a run, where it leaves them open."""
    initial = structure.initial
    if initial == "auto":
        if starts_at_rest(run, structure):
            return "rest"
        # A body with friction has no velocities but its own, so that only level and velocity are asked for.
        initial = "history" if has_memory(structure) and not structure.has_friction else "caputo"
    return history(run, structure) if initial == "history" else initial


def together(decisions: list[Initial]) -> Initial | None:
    """One decision for runs of one fit, or None where they agree: the longest; a run at rest finds zeros for it."""
    if len(set(decisions)) < 2:
        return None
    return max(decisions, key=lambda d: (isinstance(d, tuple), d == "caputo", len(d)))


def decided_together(runs: Sequence[Run], structure: Structure) -> Initial:
    """Initial terms of a fit of all runs together."""
    starts = [decided(run, structure) for run in runs]
    return together(starts) or starts[0]


def misfit(few: Sequence[Floats], many: Sequence[Floats], sizes: Sequence[float]) -> float:
    """By how much residuals with few initial terms exceed those with many, in units of noise.

    Where the few are enough this is distributed as chi-squared, with as many degrees as there are terms more.

    Parameters
    ----------
    few, many
        Residuals of each output; infinite where a free run has no numbers, NaN where nothing was read.
    sizes
        Deviation of what was measured of each output.
    """
    excess = 0.0
    for one, other, size in zip(few, many, sizes, strict=True):
        there = ~np.isnan(one)
        if float(np.sqrt(np.mean(one[there] ** 2))) > ROUNDING * size:
            excess += huber_excess(one[there], other[there])
    return excess


def misfit_of_fits(few: Sequence[Floats], many: Sequence[Floats], sizes: Sequence[float]) -> float:
    """The misfit of one fit beside another, or a share of what squares say of it where that is more."""
    squares = 0.0
    for one, other, size in zip(few, many, sizes, strict=True):
        there = ~np.isnan(one)
        floor, above = float(np.mean(other[there] ** 2)), float(np.sum(one[there] ** 2 - other[there] ** 2))
        if math.sqrt(float(np.mean(one[there] ** 2))) > ROUNDING * size:
            squares += above / floor if floor > 0.0 else math.inf
    return max(misfit(few, many, sizes), OF_SQUARES * squares)


def missed(measured: Floats, simulated: Floats) -> Floats:
    """What a free run misses of what was read; infinite where it has no numbers, NaN where nothing was read."""
    with np.errstate(invalid="ignore"):
        rows: Floats = measured - simulated
    rows[~np.isnan(measured) & ~np.isfinite(rows)] = np.inf
    return rows


def needed(structure: Structure, excess: float, terms: int) -> bool:
    """Whether such an excess over residuals with so many terms more asks for a history beside Caputo's terms."""
    doubt = DOUBT if structure.offset == "none" else DOUBT_BESIDE_OFFSET
    return terms > 0 and excess > chi_squared(terms, doubt)


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
