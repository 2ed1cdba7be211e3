"""Checks of measured data before estimation: faults, poor excitation, and signal statistics."""

from __future__ import annotations

import html
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ftlm import _core
from ftlm.data.run import Run
from ftlm.data.sampling import drop_missing
from ftlm.findings import LEVEL_FACT, LEVEL_NOTE, Finding, make_finding, unique_findings
from ftlm.kernels import pulse_means
from ftlm.structure.structure import Structure
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import attributes, line_length, plural, wrap_text
from ftlm.utils.linalg import orthonormal
from ftlm.utils.parameters import Note, parameter
from ftlm.utils.statistics import estimate_noise, is_rest, quantization_step
from ftlm.utils.validation import Floats
from ftlm.validation.feedback import feedback_test

#: Spectral lines below this fraction of the largest one do not count as excitation.
SPECTRAL_LINE_THRESHOLD = 0.01
#: Width of one spectral line in bins under the Blackman-Harris window (side lobes at -92 dB).
LINE_BINS = 8
BLACKMAN_HARRIS = (0.35875, -0.48829, 0.14128, -0.01168)
#: A mean of an input above this fraction of its standard deviation counts as a constant level. A smaller mean may come
#: from truncated periods.
LEVEL_FRACTION = 0.3
#: Two inputs with a larger absolute correlation are reported as collinear.
MAX_INPUT_CORRELATION = 0.999
#: Fewer samples than this are reported as too short for an estimate.
MIN_USEFUL_SAMPLES = 100
#: An output that is constant for longer than this fraction of the run while an input changes is a dead channel.
DEAD_FRACTION = 0.005
#: Fraction of an interval at rest, at its end, in which an input may already change because of a dead time.
DEAD_TIME_FRACTION = 0.1
MIN_DEAD_SAMPLES = 50
#: Minimum number of consecutive samples at an extreme value that count as clipped, and fraction of clipped samples in a
#: run from which saturation is reported.
MIN_CLIPPED_SAMPLES = 3
CLIPPED_FRACTION = 0.002
#: A spike differs from both neighbors by more than this number of noise standard deviations and this fraction of the
#: range. If a larger fraction of the samples than `MAX_SPIKE_FRACTION` are spikes, none is reported.
SPIKE_SIGMAS = 12.0
SPIKE_FRACTION = 0.03
MAX_SPIKE_FRACTION = 0.01
#: An encoder wrap is a jump of more than this fraction of the range against the slope on both sides. The slope is taken
#: over `WRAP_SLOPE` samples.
WRAP_FRACTION = 0.6
WRAP_SLOPE = 5
#: Thresholds of the change by an unexplained trend over a run: fraction of the standard deviation of the output, and
#: number of standard errors, which are estimated from blocks.
DRIFT_FRACTION = 0.15
DRIFT_SIGMAS = 6.0
DRIFT_BLOCKS = 16
DRIFT_PULSES = 1024
DRIFT_LAGS = 12
#: Minimum fraction of the power of a linear trend that the responses to inputs do not explain, for a drift test.
MIN_TREND_RESIDUAL_FRACTION = 1e-3
#: Maximum number of samples of the test for feedback.
MAX_FEEDBACK_SAMPLES = 8_000
#: Ratio of the test statistic to its limit above which inconclusive feedback is reported. Sweeps in open loop may
#: have ratios above 1.
MIN_UNDECIDED_RATIO = 3.0


@dataclass(frozen=True)
class Advice:
    """Findings on the data of a run before estimation; empty if the checks find no fault.

    Parameters
    ----------
    run
        Name of the run.
    findings
        Findings, most severe kinds first; see :class:`ftlm.Finding`.
    """

    run: str
    findings: tuple[Finding, ...]

    @property
    def codes(self) -> tuple[str, ...]:
        """Distinct codes of the findings."""
        return tuple(dict.fromkeys(f.code for f in self.findings))

    def __iter__(self) -> Iterator[Finding]:
        return iter(self.findings)

    def __len__(self) -> int:
        return len(self.findings)

    def to_dict(self) -> list[dict[str, Any]]:
        """Return the findings as a list of dictionaries for JSON."""
        return [f.to_dict() for f in self.findings]

    def __str__(self) -> str:
        if not self.findings:
            return f"advice on {self.run}: no findings"
        return "\n".join([f"advice on {self.run}:", *(f"  {f.sentence}" for f in self.findings)])

    def _repr_html_(self) -> str:
        items = "".join(f"<li>{html.escape(f.sentence)}</li>" for f in self.findings)
        return f"<p>Advice on {html.escape(self.run)}:</p><ul>{items or '<li>no findings</li>'}</ul>"


@check_arguments
def advise(run: Run, structure: Structure | None = None) -> Advice:
    """Check a run for faults and poor excitation; see :meth:`ftlm.Run.advice`."""
    return Advice(run.name, tuple(_findings(run, structure)))


def _findings(run: Run, structure: Structure | None) -> Iterator[Finding]:
    run = run.with_interpolated_gaps()
    varying_signals = [n for n in run.signals if np.ptp(run[n]) > 0]
    for name in run.signals:
        if name not in varying_signals:
            yield _constant(run, name)
    yield from _duplicate_channels(run, varying_signals)
    inputs = [n for n in run.inputs if n in varying_signals]
    outputs = [n for n in run.outputs if n in varying_signals]
    for name in outputs:
        yield from find_dead_channel(run, name)
    typical_findings = []
    for name in outputs:
        wraps = list(_wraps(run, name))
        yield from wraps
        # A signal that wraps jumps across its range: tests for saturation, spikes and drift would be meaningless.
        if not wraps:
            typical_findings.append(name)
            yield from _saturation(run, name)
            yield from _spikes(run, name)
    for name in inputs:
        yield from _saturation(run, name)
    yield from _insufficient_duration(run, outputs)
    yield from _excitation(run, inputs)
    if structure is not None:
        yield from check_excitation(run, structure)
    yield from _feedback(run, inputs, typical_findings)
    yield from _drift(run, inputs, typical_findings)
    for name in outputs:
        yield from _offset(run, name)


def _with_unit(run: Run, name: str, value: float) -> str:
    unit = run.units.get(name, "")
    return f"{value:.4g} {unit}".strip() if unit not in ("", "1") else f"{value:.4g}"


def _true_intervals(flags: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the start indices and the lengths of all intervals of consecutive True values."""
    edges = np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8))
    starts = np.flatnonzero(edges == 1)
    return starts, np.flatnonzero(edges == -1) - starts


def _duplicate_channels(run: Run, names: list[str]) -> Iterator[Finding]:
    for first, second in itertools.combinations(names, 2):
        if np.array_equal(run[first], run[second]):
            role = {"input" if second in run.inputs else "output": second}
            yield make_finding("twin", run=run.name, **role, other=first)


def _constant(run: Run, name: str) -> Finding:
    level = _with_unit(run, name, float(run[name][0]))
    if name in run.inputs:
        return make_finding("constant_input", run=run.name, input=name, level=level, rows=run.length)
    return make_finding("constant_output", run=run.name, output=name, level=level, rows=run.length)


def find_dead_channel(run: Run, name: str) -> Iterator[Finding]:
    """Yield a finding on the longest interval over which an output is constant although it varies elsewhere.

    No finding is given if quantization, saturation or rest without an input explains the interval.
    """
    y = run[name]
    is_unchanged = np.diff(y) == 0
    starts, lengths = _true_intervals(is_unchanged)
    if not lengths.size:
        return
    # Coarse quantization or stiction gives many constant intervals; a dead channel only one or two.
    if float(np.mean(is_unchanged)) > 0.3 and np.median(lengths) > 1:
        return
    at = int(np.argmax(lengths))
    start, rows = int(starts[at]), int(lengths[at]) + 1
    if rows < max(MIN_DEAD_SAMPLES, DEAD_FRACTION * run.length):
        return
    # Clipping at an extreme is reported as saturation; rest at any level before the first input, and under no input,
    # is legitimate.
    if _entered_steeply(y, start, rows):
        return
    # The output may be at rest while an input already changes, because it responds after a dead time.
    tail = max(1, int(DEAD_TIME_FRACTION * rows))
    head_samples = [run[n][start : start + rows - tail] for n in run.inputs]
    tail_samples = [run[n][start + rows - tail : start + rows + 1] for n in run.inputs]
    is_moving = any(np.any(after != before[0]) for before, after in zip(head_samples, tail_samples, strict=True))
    without_input = not any(values[0] for values in head_samples)
    if all(np.ptp(values) == 0 for values in head_samples) and (without_input or (start == 0 and is_moving)):
        return
    start_time, end_time = start * run.step, (start + rows) * run.step
    advice = (
        f"use {parameter('window', (float(f'{end_time:.4g}'), None))}"
        if start < run.length // 20
        else "check the sensor, or cut it away"
    )
    level = _with_unit(run, name, float(y[start]))
    yield make_finding(
        "channel_off",
        run=run.name,
        output=name,
        level=level,
        begin=start_time,
        end=end_time,
        rows=rows,
        after=advice,
    )


def _smallest_change(y: Floats) -> float:
    changes = np.abs(np.diff(y))
    changes = changes[changes > 1e-12 * float(np.max(np.abs(y)))]
    return float(changes.min()) if changes.size else 0.0


def _entered_steeply(y: Floats, start: int, rows: int) -> bool:
    """Whether an interval of equal values is an extreme of a signal that is steep just before and after it."""
    increments = np.abs(np.diff(y))
    typical = float(np.median(increments[increments > 0])) if np.any(increments > 0) else 0.0
    # A slow turning point that ends with an input step is steep on one side only.
    step_before = abs(y[start - 1] - y[start - 2]) if start >= 2 else math.inf
    stop = start + rows
    step_after = abs(y[stop + 1] - y[stop]) if stop + 1 < y.size else math.inf
    at_extreme = y[start] in (y.min(), y.max())
    return bool(
        at_extreme and rows < y.size and min(step_before, step_after) > max(4 * _smallest_change(y), 0.2 * typical)
    )


def _saturation(run: Run, name: str) -> Iterator[Finding]:
    y = run[name]
    levels = np.unique(y)
    if name in run.inputs and levels.size < max(12, 0.01 * y.size):
        return  # A signal of few levels is at its extremes by design.
    noise, least_change = estimate_noise(y), _smallest_change(y)
    code, role = ("saturation_input", "input") if name in run.inputs else ("saturation", "output")
    for extreme, extreme_name in ((levels[0], "lowest"), (levels[-1], "highest")):
        starts, lengths = _true_intervals(y == extreme)
        long = lengths >= MIN_CLIPPED_SAMPLES
        if noise < 2 * least_change:
            # If quantization exceeds the noise, only an interval that is entered steeply counts as clipped.
            is_steep = [_entered_steeply(y, int(s), int(n)) for s, n in zip(starts[long], lengths[long], strict=True)]
            clipped = int(np.sum(lengths[long][np.array(is_steep, dtype=bool)]))
        else:
            clipped = int(np.sum(lengths[long]))
        if clipped >= max(MIN_CLIPPED_SAMPLES, CLIPPED_FRACTION * y.size):
            level = _with_unit(run, name, float(extreme))
            details = {"extreme": extreme_name, "level": level, "rows": clipped, "share": 100 * clipped / y.size}
            yield make_finding(code, run=run.name, **{role: name}, **details)


def _spikes(run: Run, name: str) -> Iterator[Finding]:
    y = run[name]
    if y.size < 5:
        return
    rises, falls = np.diff(y)[:-1], np.diff(y)[1:]
    range_width = float(np.quantile(y, 0.995) - np.quantile(y, 0.005))
    height = np.minimum(np.abs(rises), np.abs(falls))
    limit = max(SPIKE_SIGMAS * estimate_noise(y), SPIKE_FRACTION * range_width)
    out = (rises * falls < 0) & (height > limit)
    # A fast signal may turn that sharply everywhere; a spike is isolated between quiet neighbors.
    neighbor_differences = np.abs(y[2:] - y[:-2])
    out &= neighbor_differences < 0.5 * height
    for n in run.inputs:
        jump = np.abs(np.diff(run[n]))
        # A pulse of one sample in an input may cause a pulse in a fast output.
        is_pulse = (jump > 0.2 * np.ptp(run[n])) & (np.ptp(run[n]) > 0)
        out &= ~(is_pulse[:-1] & is_pulse[1:])
    rows = np.flatnonzero(out) + 1
    if not rows.size or rows.size > MAX_SPIKE_FRACTION * y.size:
        return
    highest_row = rows[int(np.argmax(height[rows - 1]))]
    yield make_finding(
        "spikes",
        run=run.name,
        output=name,
        count=rows.size,
        plural="s" if rows.size > 1 else "",
        first=int(rows[0]),
        time=float(rows[0]) * run.step,
        height=_with_unit(run, name, float(height[highest_row - 1])),
        worst=int(highest_row),
    )


def _wraps(run: Run, name: str) -> Iterator[Finding]:
    y = run[name]
    increments = np.diff(y)
    range_width, typical = float(np.ptp(y)), float(np.median(np.abs(increments)))
    jumps = np.flatnonzero((np.abs(increments) > WRAP_FRACTION * range_width) & (np.abs(increments) > 10 * typical))
    rows = []
    for at in jumps.tolist():
        if at < WRAP_SLOPE or at + WRAP_SLOPE + 1 >= y.size:
            continue
        slope_before = float(y[at] - y[at - WRAP_SLOPE])
        slope_after = float(y[at + 1 + WRAP_SLOPE] - y[at + 1])
        if any(_jumps_near(run[n], at) for n in run.inputs):
            # A measured current follows its command, which jumps.
            continue
        # Both slopes oppose the jump: the quantity continued while its counter restarted.
        slope_is_small = max(abs(slope_before), abs(slope_after)) < 0.5 * abs(increments[at])
        if slope_is_small and slope_before * increments[at] < 0 and slope_after * increments[at] < 0:
            rows.append(at + 1)
    if not rows:
        return
    jump = float(np.median(np.abs(increments[np.array(rows) - 1])))
    turn_text = " (a turn)" if run.units.get(name) == "rad" and abs(jump / (2 * math.pi) - 1) < 0.1 else ""
    details = {
        "size": _with_unit(run, name, jump),
        "turn": turn_text,
        "times": plural(len(rows), "time"),
        "first": rows[0],
    }
    yield make_finding("wrap", run=run.name, output=name, **details)


def _jumps_near(u: Floats, at: int) -> bool:
    """Whether an input jumps by more than the fraction `WRAP_FRACTION` of its range within one sample of index `at`."""
    nearby_increments = np.abs(np.diff(u[at - 1 : at + 3]))
    return bool(np.any(nearby_increments > WRAP_FRACTION * float(np.ptp(u)))) and float(np.ptp(u)) > 0.0


def spectral_lines(u: Floats) -> tuple[int, int]:
    """Return the number of spectral lines of an input, and the FFT bin of its largest line."""
    x = u - np.mean(u)
    phase = 2 * np.pi * np.arange(x.size) / x.size
    window = sum(a * np.cos(k * phase) for k, a in enumerate(BLACKMAN_HARRIS))
    magnitude = np.abs(np.fft.rfft(x * window))
    magnitude[:2] = 0  # The window spreads the mean over these bins.
    strong = magnitude > SPECTRAL_LINE_THRESHOLD * magnitude.max()
    # A single line fills LINE_BINS bins. A broader interval counts as the number of lines that fit into it.
    _, lengths = _true_intervals(strong)
    return int(np.sum(np.maximum(1, np.rint(lengths / LINE_BINS)))), int(np.argmax(magnitude))


def _excitation(run: Run, inputs: list[str]) -> Iterator[Finding]:
    for name in inputs:
        lines, at = spectral_lines(run[name])
        if lines < 2 and at > 2:
            omega = 2 * math.pi * at / (run.length * run.step)
            yield make_finding("one_sine", run=run.name, input=name, omega=omega)
    for i, name in enumerate(inputs):
        for other_input in inputs[:i]:
            r = float(np.corrcoef(run[name], run[other_input])[0, 1])
            if abs(r) > MAX_INPUT_CORRELATION:
                yield make_finding("inputs_collinear", run=run.name, input=name, other=other_input, correlation=r)


def check_excitation(run: Run, structure: Structure) -> Iterator[Finding]:
    """Yield a finding on each equation with more free parameters than the spectral lines of its inputs identify.

    In steady state, one spectral line identifies two parameters of each output that it excites, and a constant level
    identifies one. Equations with friction or non-linear terms are skipped, because their response has harmonics of the
    input lines.
    """
    run = run.with_interpolated_gaps()
    for equation in structure.equations:
        if equation.friction is not None or equation.nonlinear_terms:
            continue
        inputs = [s for s in equation.signals if s in run.inputs]
        # With measured coupling the other measured outputs are inputs of this equation.
        if structure.coupling == "measured":
            inputs += [s for s in equation.signals if s != equation.output and s in run.outputs]
        else:
            inputs = [s for s in structure.signals if s in run.inputs]
        if not inputs:
            # A free response has no input.
            continue
        varying_inputs = [n for n in inputs if np.ptp(run[n]) > 0]
        line_count = sum(2 * spectral_lines(run[n])[0] for n in varying_inputs)
        line_count += sum(abs(float(np.mean(run[n]))) > LEVEL_FRACTION * float(np.std(run[n])) for n in inputs)
        free = len(equation.order_names) + len(equation.coefficient_names)
        if free > line_count:
            inputs_text = ", ".join(inputs)
            yield make_finding(
                "excitation_short",
                run=run.name,
                output=equation.output,
                free=free,
                listed=inputs_text,
                known=int(line_count),
            )


def _insufficient_duration(run: Run, outputs: list[str]) -> Iterator[Finding]:
    if run.length < MIN_USEFUL_SAMPLES:
        yield make_finding("few_rows", run=run.name, rows=run.length, needed=MIN_USEFUL_SAMPLES)
        return
    for name in outputs:
        y = run[name]
        swing = float(np.std(y))
        level = np.zeros(y.size)
        level[y > np.mean(y) + 0.2 * swing], level[y < np.mean(y) - 0.2 * swing] = 1.0, -1.0
        nonzero_levels = level[level != 0]
        crossings = int(np.sum(np.diff(nonzero_levels) != 0))
        tail = y[-y.size // 5 :]
        if crossings <= 2 and np.ptp(tail) > 0.1 * np.ptp(y):
            yield make_finding(
                "short", run=run.name, output=name, times=plural(crossings, "time"), duration=run.duration
            )


def _offset(run: Run, name: str) -> Iterator[Finding]:
    if not is_rest(run[name]):
        level = _with_unit(run, name, float(run[name][0]))
        yield make_finding("starts_off_zero", run=run.name, output=name, level=level)


def _drift(run: Run, inputs: list[str], outputs: list[str]) -> Iterator[Finding]:
    """Yield a finding on each output with a linear trend that the inputs do not explain.

    The regressors are the inputs, their first-order lags and their integrals.
    """
    m = min(DRIFT_PULSES, run.length - 1)
    if m < 4 * DRIFT_BLOCKS:
        return
    step = run.duration / m
    means = {n: pulse_means(run[n] - run[n][0], m, hold=run.intersample.get(n) == "zoh") for n in (*inputs, *outputs)}
    initial_levels = {n: pulse_means(np.full(run.length, float(run[n][0])), m, hold=True) for n in inputs}
    times = np.geomspace(2 * step, run.duration / 8, DRIFT_LAGS)
    series = [_core.filter_series([(1.0, 0.0)], [(float(t), 1.0), (1.0, 0.0)], m, step) for t in times]
    regressors = [_core.series_multiply(s, means[n] + initial_levels[n], m) for n in inputs for s in series]
    regressors += [means[n] + initial_levels[n] for n in inputs]
    regressors += [np.cumsum(means[n] + initial_levels[n]) for n in inputs]
    t = np.linspace(-0.5, 0.5, m)
    for name in outputs:
        y = means[name]
        free = [] if is_rest(run[name]) else [np.exp(-(t + 0.5) * run.duration / tau) for tau in times]
        basis = np.stack([np.ones(m), *regressors, *free])
        scale = np.linalg.norm(basis, axis=1)
        basis = basis[scale > 0] / scale[scale > 0][:, None]
        # The part of trend and output that the regressors explain does not count as drift, so it is removed.
        q = orthonormal(basis.T, 1e-8)
        y_residual, t_residual = y - q @ (q.T @ y), t - q @ (q.T @ t)
        if float(t_residual @ t_residual) < MIN_TREND_RESIDUAL_FRACTION * float(t @ t):
            continue
        slope = float(t_residual @ y_residual) / float(t_residual @ t_residual)
        remainder = y_residual - slope * t_residual
        blocks = np.array_split(remainder * t_residual, DRIFT_BLOCKS)
        slope_error = math.sqrt(sum(float(np.sum(b)) ** 2 for b in blocks)) / float(t_residual @ t_residual)
        deviation = float(np.std(y))
        if abs(slope) > DRIFT_FRACTION * deviation and abs(slope) > DRIFT_SIGMAS * slope_error:
            details = {"slope": _with_unit(run, name, slope), "share": 100 * abs(slope) / deviation}
            yield make_finding("drift", run=run.name, output=name, **details)


def _feedback(run: Run, inputs: list[str], outputs: list[str]) -> Iterator[Finding]:
    """Yield a finding on each input that depends on past outputs, or for which this test is inconclusive.

    The finding names the output with the largest test statistic. See :func:`feedback_test`.
    """
    rows = min(run.length, MAX_FEEDBACK_SAMPLES)
    signals = {name: run[name][:rows] for name in (*inputs, *outputs)}
    for u in inputs:
        other_inputs = [[signals[n]] for n in inputs if n != u]
        tests = {y: feedback_test([signals[y]], [signals[u]], other_inputs) for y in outputs}
        strongest = max(tests, key=lambda y: tests[y].ratio, default="")
        feedback_output = max((y for y in tests if tests[y].has_feedback), key=lambda y: tests[y].ratio, default="")
        if feedback_output:
            yield make_finding(
                "loop_in_data", run=run.name, input=u, output=feedback_output, ratio=tests[feedback_output].ratio
            )
        elif strongest and tests[strongest].ratio > MIN_UNDECIDED_RATIO:
            test = tests[strongest]
            details = {"ratio": test.ratio, "reason": test.reason}
            yield make_finding("feedback_inconclusive", run=run.name, input=u, output=strongest, **details)


@dataclass(frozen=True)
class SignalFigures:
    """Statistics of one signal in SI units.

    Parameters
    ----------
    name, role, unit
        Name, ``"input"`` or ``"output"``, and SI unit of the signal.
    first, low, high, mean, deviation
        First value, extremes, mean and standard deviation.
    noise
        Standard deviation of the measurement noise, estimated from second differences.
    quantum
        Quantization step: the largest step of which all differences between samples are multiples. 0 if there is none,
        and for a zero-order-hold input, whose values are exact commands.
    at_extremes
        Fraction of samples at the lowest or highest value. A large fraction shows saturation or a two-level signal.
    constant
        Whether all samples are equal.
    at_rest
        Whether the first samples are zero within the noise.
    """

    name: str
    role: str
    unit: str
    first: float
    low: float
    high: float
    mean: float
    deviation: float
    noise: float
    quantum: float
    at_extremes: float
    constant: bool
    at_rest: bool


@dataclass(frozen=True)
class Inspection:
    """Statistics of all signals of a run, with findings about the data.

    Parameters
    ----------
    run
        Name of the run.
    rows, step, duration
        Number of samples, sampling step [s] and duration [s].
    signals
        Statistics of each signal, inputs first.
    findings
        Findings about the data.
    """

    run: str
    rows: int
    step: float
    duration: float
    signals: list[SignalFigures]
    findings: tuple[Finding, ...]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Findings as sentences, without the name of the run."""
        return tuple(f.sentence for f in self.findings)

    def to_dict(self) -> dict[str, Any]:
        """Return the statistics as a dictionary for JSON."""
        return attributes(self, ("run", "rows", "step", "duration", "signals", "findings", "warnings"))

    def __str__(self) -> str:
        width = max(len(name) for name in ("signal", *(s.name for s in self.signals))) + 2
        headings = ("first", "low", "high", "mean", "sd", "noise", "quantum")
        table: list[tuple[str, tuple[str, ...]]] = [(f"{'signal':<{width}}{'role':<8}{'unit':<8}", headings)]
        for s in self.signals:
            figures = (s.first, s.low, s.high, s.mean, s.deviation, s.noise)
            cells = (*(f"{v:.4g}" for v in figures), f"{s.quantum:.4g}" if s.quantum else "-")
            table.append((f"{s.name:<{width}}{s.role:<8}{s.unit or '1':<8}", cells))
        lines = wrap_text(
            f"run {self.run}: {self.rows} rows, step {self.step:g} s, {self.duration:g} s; "
            f"carries up to {self.rows - 1} block pulses"
        )
        # Columns for which a narrow terminal has no room follow in a second table.
        columns_per_line = max((line_length() - width - 16) // 11, 1)
        for start in range(0, len(headings), columns_per_line):
            lines += [
                row_start + "".join(f"{cell:>11}" for cell in cells[start : start + columns_per_line])
                for row_start, cells in table
            ]
        minor = (LEVEL_FACT, LEVEL_NOTE)
        return "\n".join(lines + [f"{'note' if f.level in minor else 'warning'}: {f.sentence}" for f in self.findings])


def inspect_run(run: Run) -> Inspection:
    """Compute range, noise, quantization and initial rest of every signal of a run.

    Parameters
    ----------
    run
        The run.

    Returns
    -------
    Inspection
        Statistics that print as a table.
    """
    signals = [_figures(run, name) for name in run.signals]
    findings = data_notes(run)
    for s in signals:
        if s.constant:
            findings.append(make_finding("signal_constant", run=run.name, **{s.role: s.name}, level=s.first))
    return Inspection(run.name, run.length, run.step, run.duration, signals, unique_findings(findings))


def data_notes(run: Run) -> list[Finding]:
    """Return notes, as findings, on how a run was read and processed, and on whether the rig stopped it."""
    notes = []
    for note in run.warnings:
        texts = {"text": note.fact, "override": note.override} if isinstance(note, Note) else {"text": note}
        notes.append(make_finding("data_note", run=run.name, **texts))
    faults = run.metadata.get("faults")
    if not (isinstance(faults, list) and faults):
        return notes
    return [make_finding("rig_stopped", run=run.name, cause="; ".join(map(str, faults))), *notes]


def _figures(run: Run, name: str) -> SignalFigures:
    all_rows = run[name]
    x = drop_missing(all_rows)
    low, high, noise = float(x.min()), float(x.max()), estimate_noise(all_rows)
    deviation = float(x.std())
    return SignalFigures(
        name=name,
        role="input" if name in run.inputs else "output",
        unit=run.units.get(name, ""),
        first=float(x[0]),
        low=low,
        high=high,
        mean=float(x.mean()),
        deviation=deviation,
        noise=noise,
        quantum=0.0 if run.intersample.get(name) == "zoh" else quantization_step(x),
        at_extremes=float(np.mean((x == low) | (x == high))),
        constant=low == high,
        at_rest=is_rest(x),
    )
