"""A run and a structure become the record that the core computes on: pulse means of every signal."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ftlm import _core
from ftlm.checks import whole_number
from ftlm.errors import DataError, ModelError
from ftlm.runs import nearest

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from ftlm.models import Equation, Initial, Structure
    from ftlm.runs import Run

    Floats = NDArray[np.float64]

__all__ = ["Record", "default_m", "equation_tuple", "initial_tuple", "record", "structure_tuple"]

#: The paper's number of block pulses, used where the record carries as many.
PAPER_M = 2048
#: Most pulses in one record: 2^24 of one signal are 128 MB.
MAX_M = 1 << 24
#: A signal that stays below this loses digits of its squares to the end of the range of numbers.
SMALLEST = 1e-140
COULOMB = "coulomb_"
#: A first value beyond this many noise standard deviations is not rest.
REST_SIGMAS = 5.0
#: ... nor one beyond this share of the signal's deviation, where there is no noise.
REST_SHARE = 1e-3
#: Median absolute deviation of a normal variable in units of its standard deviation.
MAD = 0.6744897501960817


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
    """

    signals: tuple[str, ...]
    step: float
    means: Floats
    inputs: tuple[bool, ...]
    sensor: Floats | None
    initial: Initial

    @property
    def m(self) -> int:
        """Number of pulses."""
        return int(self.means.shape[1])

    def core(self) -> tuple[float, Floats, Floats | None]:
        """Return the record as the core takes it."""
        return self.step, self.means, self.sensor

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
    """Refuse an m that is no number of pulses, that a run does not carry, or that Haar coordinates cannot take.

    Raises
    ------
    ModelError
        Naming the run, what it carries and what to choose.
    """
    pulses = whole_number(m)
    if pulses is None or pulses < 1:
        raise ModelError(f"m = {m!r} is no number of pulses; give a whole number, at least 1")
    m = pulses
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


def is_rest(samples: Floats) -> bool:
    """Whether a signal starts at zero within its noise.

    Only the first sample is judged: a machine at rest may answer within a few samples.
    """
    noise = noise_of(samples)
    return bool(abs(samples[0]) <= REST_SIGMAS * noise + REST_SHARE * float(np.std(samples)))


def noise_of(samples: Floats) -> float:
    """Estimate the deviation of white noise on a smooth signal, from the median of its second differences."""
    return float(np.median(np.abs(np.diff(samples, 2)))) / MAD / float(np.sqrt(6.0)) if samples.size > 2 else 0.0


def starts_at_rest(run: Run, structure: Structure) -> bool:
    """Whether all outputs of a structure start at zero within their noise."""
    return all(is_rest(run[name]) for name in structure.signals if name in run.outputs)


def record(run: Run, structure: Structure, m: int, *, filtered: bool = True) -> Record:
    """Pulse means of every signal of a structure, delays and sensor filter honoured.

    Outputs are point samples taken as linear in between; inputs hold or are linear as the run says; m may exceed the
    run's own grid only where nothing is measured against it.

    Parameters
    ----------
    run
        The run.
    structure
        Whose signals are wanted.
    m
        Number of pulses.
    filtered
        Whether to put signals that were not measured through the sensor filter through it (equation error), or to
        leave them (coupled free run).

    Raises
    ------
    DataError
        A signal that the run does not have, or one so small that its squares vanish.
    ModelError
        A delay of a signal that is no input, or a free delay.
    """
    initial = structure.initial
    if initial == "auto":
        initial = "rest" if starts_at_rest(run, structure) else "caputo"
    sensor = None
    if filtered and structure.sensor_filter is not None:
        sensor = sensor_series(structure, m, run.duration / m)
    rows = []
    for name in structure.signals:
        means = _means(run, structure, name, m, at_rest=initial == "rest")
        if sensor is not None and structure.sensor_filter is not None and name not in structure.sensor_filter.outputs:
            means = _core.series_multiply(sensor, means, m)
        peak = float(np.max(np.abs(means), initial=0.0))
        if 0 < peak < SMALLEST:
            raise DataError(
                f"signal {name!r} of run {run.name!r}: no mean is larger than {peak:.3g}, and squares below "
                f"{SMALLEST:g} lose their digits; scale the signal"
            )
        rows.append(means)
    return Record(
        structure.signals,
        run.duration / m,
        np.ascontiguousarray(np.stack(rows)),
        tuple(s in run.inputs for s in structure.signals),
        sensor,
        initial,
    )


def sensor_series(structure: Structure, m: int, step: float) -> Floats | None:
    """Return the structure's sensor filter as a series, or None."""
    sensor = structure.sensor_filter
    return None if sensor is None else _core.filter_series(list(sensor.numerator), list(sensor.denominator), m, step)


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
    samples = run[name]
    if name in structure.free_delays:
        raise ModelError(
            f"the delay of {name} is free: only method='output-error' estimates delays; give its value in seconds"
        )
    delay = structure.delay.get(name, 0.0)
    if name not in run.inputs:
        if delay:
            raise ModelError(f"delay of {name} = {delay:g} s, but run {run.name!r} has it as an output; delay inputs")
        return _core.pulse_means(samples, m, False)
    held = run.intersample[name] == "zoh"
    if delay:
        intervals = run.length - 1
        # On a finer grid the delayed command switches within an interval, so it is held on that grid before the delay.
        every = m // intervals if held and m % intervals == 0 else 1
        samples = np.repeat(samples, every)[: intervals * every + 1]
        samples = _core.delayed(samples, delay / run.step * every, 0.0 if at_rest else float(samples[0]))
    return _core.pulse_means(samples, m, held)


# ------------------------------------------------------------------------------------------------ as the core takes it


def structure_tuple(item: Equation, signals: Sequence[str]) -> tuple[int, float, list[tuple[int, float]]]:
    """Output, alpha and (signal, order) pairs of an equation whose orders are numbers."""
    index = {name: i for i, name in enumerate(signals)}
    terms = [(index[t.signal], t.order.constant) for t in item.terms]
    return index[item.output], item.order.constant, terms


def equation_tuple(
    item: Equation, signals: Sequence[str]
) -> tuple[tuple[int, float, list[tuple[int, float]]], list[float]]:
    """Return an identified equation: its structure and its coefficients."""
    return structure_tuple(item, signals), [float(t.fixed or 0.0) for t in item.terms]


def initial_tuple(initial: Initial) -> tuple[bool, list[float]]:
    """Return decided initial terms: whether Caputo's, else their exponents."""
    if initial == "caputo":
        return True, []
    return False, [] if isinstance(initial, str) else list(initial)


def named_signals(error: ModelError, signals: Sequence[str]) -> ModelError:
    """The core knows signals by number; people know them by name."""
    return ModelError(re.sub(r"signal (\d+)", lambda m: f"signal {signals[int(m[1])]!r}", str(error)))
