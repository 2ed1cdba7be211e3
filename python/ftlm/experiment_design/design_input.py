"""Design of an optimal input: validation of arguments, initial inputs, and choice of the best candidate input."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ftlm.analysis.frequency_response import check_no_input_nonlinearity
from ftlm.analysis.poles import modes, stability
from ftlm.data.run import Run
from ftlm.data.sampling import drop_missing
from ftlm.errors import DataError, FtlmError, ModelError
from ftlm.estimation.output_error import parameter_set_of
from ftlm.estimation.result import Identification
from ftlm.estimation.verdict import MAX_ORDER_ERROR
from ftlm.experiment_design.exchange import Design, exchange_holds, scaled_design
from ftlm.experiment_design.problem import Bounds, Criterion, Kind, ModelFit, Sensitivities, per_signal_values
from ftlm.experiment_design.result import DesignedInput, PredictedExtreme
from ftlm.experiment_design.spectrum import Spectrum, best_spectrum, spectral_lines
from ftlm.findings import MISSING_PART_CODES, NOT_WHITE_CODES, Finding, make_finding
from ftlm.model.model import Model, check_model
from ftlm.progress import FractionTracker, Progress
from ftlm.simulation.discretization import check_linear
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import parameter, setting, type_name
from ftlm.utils.resources import duration_bounds, estimate_duration
from ftlm.utils.statistics import NORMAL_95
from ftlm.utils.validation import Floats, check_seed, nearest, real_number, short_repr

#: Number of iterations that clip the peaks of a multisine and restore its spectrum.
CREST_ITERATIONS = 200
#: Clipping level of these iterations, as a fraction of the peak.
CREST_CLIP_RATIO = 0.85
#: Fractions of the power of a spectrum that lie below its low, middle and high frequency.
LOW_POWER_QUANTILE, MEDIAN_POWER_QUANTILE, HIGH_POWER_QUANTILE = 0.05, 0.5, 0.95


def square_wave(rows: int, period: int) -> Floats:
    """Return a square wave of amplitude 1 that starts at +1, shape (rows,); `period` is in samples."""
    return np.where((np.arange(rows) % period) * 2 < period, 1.0, -1.0)


def initial_inputs(spectrum: Spectrum, inputs: int, rows: int, step: float, seed: int) -> Iterator[tuple[str, Floats]]:
    """Yield (name, commands) of initial inputs of the exchange algorithm: multisine, chirp, square wave, random binary.

    Commands have shape (inputs, rows) and magnitude at most 1. Their frequencies follow from the optimal spectrum.
    `inputs` is the number of inputs, `rows` the number of samples, and `step` the sampling interval [s].
    """
    rng = np.random.default_rng(seed)
    sines = multisine(spectrum, inputs, rows, step, rng)
    yield "multisine", sines
    yield "binary by multisine", np.where(sines >= 0, 1.0, -1.0)
    low, median, high = power_quantiles(spectrum, rows * step)
    time = np.asarray(step * np.arange(rows), dtype=np.float64)
    sweep = _chirp(time, low, max(high, 1.5 * low))
    signs = np.where(np.arange(inputs) % 2 == 0, 1.0, -1.0)[:, None]
    yield f"chirp {low:.3g} to {max(high, 1.5 * low):.3g} Hz", signs * sweep
    yield "binary by chirp", signs * np.where(sweep >= 0, 1.0, -1.0)
    for frequency in np.unique([low, math.sqrt(low * median), median, math.sqrt(median * high), high]):
        period = max(2, round(1.0 / frequency / step))
        ratios = np.arange(inputs)
        yield f"square, period {period * step:.3g} s", np.stack([square_wave(rows, period << int(k)) for k in ratios])
    for frequency in np.unique([math.sqrt(low * median), median, math.sqrt(median * high)]):
        hold = max(1, round(0.4 / frequency / step))
        holds = -(-rows // hold)
        levels = rng.choice([-1.0, 1.0], (inputs, holds))
        yield f"random binary, clock {hold * step:.3g} s", np.repeat(levels, hold, axis=1)[:, :rows]


def power_quantiles(spectrum: Spectrum, duration: float) -> tuple[float, float, float]:
    """Return the frequencies [Hz] below which 5 %, 50 % and 95 % of the power of a spectrum lie.

    For a spectrum without power, they are 1, 3 and 10 divided by `duration` [s].
    """
    order = np.argsort(spectrum.lines.frequencies)
    frequencies, power = spectrum.lines.frequencies[order], spectrum.power[order]
    total = np.cumsum(power)
    if not total[-1] > 0:
        return 1 / duration, 3 / duration, 10 / duration
    low, median, high = (
        float(frequencies[np.searchsorted(total, q * total[-1])])
        for q in (LOW_POWER_QUANTILE, MEDIAN_POWER_QUANTILE, HIGH_POWER_QUANTILE)
    )
    return low, median, high


def multisine(spectrum: Spectrum, inputs: int, rows: int, step: float, rng: np.random.Generator) -> Floats:
    """Return multisines with the powers of a spectrum, amplitude 1 and a low crest factor, shape (inputs, rows).

    The initial phases are Schroeder's (doi:10.1109/TIT.1970.1054411). Each iteration then clips the peaks and restores
    the power spectrum (Van der Ouderaa, Schoukens & Renneboog, 1988). An input without power gets a random binary
    signal. `step` is the sampling interval [s].
    """
    count = len(spectrum.power)
    input_indices = np.argmax(spectrum.lines.costs[:inputs] > 0, axis=0) if count else np.zeros(0, int)
    harmonics = np.round(spectrum.lines.frequencies * rows * step).astype(np.int64)
    out = np.zeros((inputs, rows))
    for k in range(inputs):
        is_used = (input_indices == k) & (spectrum.power > 1e-6 * np.max(spectrum.power, initial=0.0))
        if not is_used.any():
            out[k] = rng.choice([-1.0, 1.0], rows)
            continue
        levels = np.zeros(rows // 2 + 1)
        levels[harmonics[is_used]] = np.sqrt(spectrum.power[is_used])
        fractions = levels**2 / np.sum(levels**2)
        phases = -2 * math.pi * np.cumsum(np.cumsum(fractions)) + rng.uniform(0, 2 * math.pi, levels.size) * 1e-3
        best, crest = np.zeros(rows), math.inf
        for _ in range(CREST_ITERATIONS):
            wave = np.fft.irfft(levels * np.exp(1j * phases), rows)
            peak = float(np.max(np.abs(wave)))
            if peak < crest:
                best, crest = wave, peak
            phases = np.angle(np.fft.rfft(np.clip(wave, -CREST_CLIP_RATIO * peak, CREST_CLIP_RATIO * peak)))
        out[k] = best / crest
    return out


def _chirp(time: Floats, low: float, high: float) -> Floats:
    log_ratio, duration = math.log(high / low), float(time[-1])
    return np.asarray(np.sin(2 * math.pi * low * duration / log_ratio * np.expm1(log_ratio * time / duration)))


#: Minimum and maximum number of samples of a designed run.
MIN_RUN_SAMPLES, MAX_RUN_SAMPLES = 32, 50_000
#: Number of holds (intervals of constant input) when the exchange algorithm is first applied, and divisors of the hold
#: length with which it is then applied again.
COARSE_HOLDS, HOLD_DIVISORS = 125, (1, 2, 4)
#: Range of the ratio of actual to estimated computing time, which is wide because the number of exchanges is unknown.
TIME_FACTOR_RANGE = (0.4, 4.0)
#: Maximum number of initial inputs from which the exchange algorithm is started.
MAX_EXCHANGE_STARTS = 4
#: Number of periods of the square wave for comparison: five, as in the ten-second runs of the paper.
REFERENCE_SQUARE_PERIODS = 5
#: Maximum standard deviation of an output due to parameter uncertainty, relative to the RMS value of the output.
MAX_RELATIVE_UNCERTAINTY = 0.5


@check_arguments
def design_input(
    model: Identification | Model,
    *,
    reference_run: Run | None = None,
    duration: float | None = None,
    step: float | None = None,
    peak: float | Mapping[str, float] | None = None,
    slew: float | Mapping[str, float] | None = None,
    limits: Mapping[str, float] | None = None,
    parameters: Sequence[str] | None = None,
    criterion: Kind = "D",
    noise: Mapping[str, float] | None = None,
    period: float | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> DesignedInput:
    """Design the input with which the parameters of a model are identified most precisely, within given limits.

    The Fisher information of an input follows from the exact sensitivities of the outputs to the parameters, divided by
    the noise standard deviation. A convex problem gives the optimal periodic spectrum, with a certificate of its
    optimality. An exchange algorithm then improves piecewise-constant inputs up to a local optimum. It is started from
    a multisine with this spectrum, sweeps, square waves and random binary signals. The design takes seconds to a
    minute, and more for more samples and parameters.

    Parameters
    ----------
    model : Identification or Model
        Identification by output error, or a saved model of such an identification.
    reference_run : Run, optional
        Run that the machine is known to tolerate. Its duration, sampling interval and largest values are the defaults
        of `duration`, `step`, `peak` and `limits`. By default the first run of the identification.
    duration, step : float, optional
        Duration and sampling interval of the run [s].
    peak : float or mapping, optional
        Maximum magnitude of each input, by name or equal for all; by default that of the reference run.
    slew : float or mapping, optional
        Maximum rate of change of each input [unit/s]; by default unlimited.
    limits : mapping, optional
        Maximum magnitude of each output by name; infinite for no limit. By default the largest deviation from its first
        value in the reference run.
    parameters : sequence of str, optional
        Names of the parameters of interest; by default all free orders, or all parameters if no order is free.
    criterion : {"D", "E"}, default "D"
        ``"D"`` minimizes the volume of the confidence ellipsoid of the parameters of interest, and ``"E"`` the length
        of its longest axis. For E, coefficients are relative to their values.
    noise : mapping, optional
        Noise standard deviation of each output, by name; by default that of the fit.
    period : float, optional
        Period [s] of the square wave with which the design is compared; by default a fifth of the duration, as in the
        paper.
    seed : int
        Seed of the random initial inputs.
    progress : callable, optional
        Callback with (steps done, total steps).

    Returns
    -------
    DesignedInput
        Commands, active constraints, and standard errors: of the model now, predicted for the designed input, and
        predicted for the square wave. The method ``save`` writes the commands for a rig.

    Raises
    ------
    ModelError
        If the model is unstable, has an integrator without a limit of the output, has friction, saturations or dead
        zones, or is too uncertain. Also if an argument is invalid or a limit cannot be met.
    DataError
        If the reference run lacks an input of the model.
    """
    if progress is not None and not callable(progress):
        raise ModelError(f"progress is {type_name(progress)}; give a function of (done, total)")
    plant = model.model if isinstance(model, Identification) else model
    check_model(plant)
    check_linear(plant.equations, "a design of the next experiment")
    check_no_input_nonlinearity(plant, "a design of the next experiment")
    if reference_run is None and isinstance(model, Identification) and model.task is not None:
        reference_run = model.task.runs[0]
    if reference_run is not None and not isinstance(reference_run, Run):
        raise ModelError(f"reference_run is {type(reference_run).__name__}, not a Run; give a run of the machine")
    free = parameter_set_of(plant)
    fit = ModelFit.of(plant, per_signal_values("noise", noise, plant.outputs, free.noise))
    _check_signals(fit, reference_run)
    if free.covariance is None:
        _raise_too_uncertain(fit, "some of its parameters have infinite intervals", None)
    default = (plant.about.get("step"), None) if reference_run is None else (reference_run.step, reference_run.duration)
    step = _positive("step", default[0] if step is None else step, "a step [s]")
    duration = _positive("duration", default[1] if duration is None else duration, "a length [s]")
    rows = round(min(duration / step, 1e9)) + 1
    if not MIN_RUN_SAMPLES <= rows <= MAX_RUN_SAMPLES:
        raise ModelError(
            f"{setting('duration')} {duration:g} s in steps of {step:g} s are {rows} rows; give a run of "
            f"{MIN_RUN_SAMPLES} to {MAX_RUN_SAMPLES} rows"
        )
    bounds = _bounds_of(fit, reference_run, peak, slew, limits)
    _check_slew(bounds, step, rows)
    _check_stable(fit, bounds)
    _check_uncertainty(fit, step, duration)
    indices = _parameter_indices(fit, parameters)
    if not isinstance(criterion, str) or criterion not in ("D", "E"):
        raise ModelError(
            f"{setting('criterion')} {short_repr(criterion)} is not known; use 'D' (all intervals) or 'E' (the widest)"
        )
    # Standard errors of orders are absolute in the criterion, those of other parameters are relative to their values.
    units = [1.0 if fit.names[i] in fit.problem.orders else abs(fit.values[i]) or 1.0 for i in indices]
    goal = Criterion(criterion, indices, tuple(units))
    seed = check_seed(seed)
    square_period = _positive("period", duration / REFERENCE_SQUARE_PERIODS if period is None else period, "a time [s]")
    period_rows = round(square_period / step)
    if not 2 <= period_rows <= 2 * rows:
        raise ModelError(
            f"{setting('period')} {period:g} s is out of range; give two samples to twice the duration of the run"
        )
    if isinstance(progress, Progress):
        size = len(fit.names) * len(fit.outputs) * rows
        progress.announce("the design", *duration_bounds(estimate_duration(0.3 + 2e-5 * size, 1), TIME_FACTOR_RANGE))
    tracker = FractionTracker(progress)
    sensitivities = Sensitivities.of(fit, step, rows - 1, bounds.ramp_samples(step))
    tracker.advance_to(0.05)
    spectrum = best_spectrum(spectral_lines(fit, bounds, step, rows - 1), goal)
    tracker.advance_to(0.15)
    designs = _design_candidates(sensitivities, goal, bounds, spectrum, seed, tracker)
    square = np.stack([p * square_wave(rows - 1, period_rows) for p in bounds.peaks.values()])
    reference = fit.run(sensitivities.rig_commands(square), step, f"square of period {period_rows * step:.4g} s")
    square_score = float(goal.score(sensitivities.information(sensitivities.derivatives(square))))
    best = designs[0]
    commands = best.commands * _robust_scale(sensitivities, bounds, best.commands)
    run = fit.run(sensitivities.rig_commands(commands), step, "designed")
    errors = _errors(fit, reference, run)
    ratios = np.log(errors["square"][list(indices)]) - np.log(errors["designed"][list(indices)])
    tracker.advance_to(1.0)
    return DesignedInput(
        run=run,
        reference=reference,
        shape=_shape_text(best, run, sensitivities),
        criterion=goal.kind,
        parameters=tuple(fit.names[i] for i in indices),
        values=dict(zip(fit.names, fit.values, strict=True)),
        standard_errors={k: dict(zip(fit.names, v.tolist(), strict=True)) for k, v in errors.items()},
        gain=float(np.exp(np.sum(ratios))),
        gains=tuple((d.name, math.exp(min(goal.count * (d.score - square_score), 700.0))) for d in designs),
        predicted_extremes=_predicted_extremes(run, bounds),
        spectrum=spectrum,
        efficiency=math.exp(best.score - spectrum.bound),
        findings=_prediction_findings(plant, noise_given=noise is not None),
    )


def _design_candidates(
    sensitivities: Sensitivities,
    goal: Criterion,
    bounds: Bounds,
    spectrum: Spectrum,
    seed: int,
    tracker: FractionTracker,
) -> list[Design]:
    """Return all candidate inputs, best first: initial inputs, and those improved by the exchange algorithm.

    The exchange algorithm is started from the best initial inputs of different kinds. Raise ModelError if no input
    makes the parameters of interest identifiable.
    """
    fit, rows = sensitivities.fit, sensitivities.rows
    peaks = np.array(list(bounds.peaks.values()))[:, None]
    initial_designs = [
        scaled_design(name, peaks * c, sensitivities, goal, bounds)
        for name, c in initial_inputs(spectrum, len(fit.inputs), rows, sensitivities.step, seed)
    ]
    feasible = [d for d in initial_designs if d.score > -math.inf]
    if not feasible:
        raise ModelError(
            f"no input of this length makes {', '.join(fit.names[i] for i in goal.indices)} separately identifiable "
            "from the other parameters; name fewer parameters, or make the run longer"
        )
    # The best initial input of each kind is used, because different kinds lead to different local optima.
    best_by_kind: dict[str, Design] = {}
    for design in sorted(feasible, key=lambda d: -d.score):
        best_by_kind.setdefault(design.name.split(",")[0].split(" by")[0], design)
    starts = sorted(best_by_kind.values(), key=lambda d: -d.score)[:MAX_EXCHANGE_STARTS]
    coarse_hold = max(sensitivities.ramp, 1, -(-rows // COARSE_HOLDS))
    optima = []
    for index, design in enumerate(starts):
        optima.append(exchange_holds(design, coarse_hold, sensitivities, goal, bounds))
        tracker.advance_to(0.15 + 0.55 * (index + 1) / len(starts))
    best = max(optima, key=lambda d: d.score)
    for index, divisor in enumerate(HOLD_DIVISORS[1:]):
        hold = max(sensitivities.ramp, 1, coarse_hold // divisor)
        if coarse_hold % hold:
            continue
        candidate = exchange_holds(best, hold, sensitivities, goal, bounds)
        best = candidate if candidate.score > best.score else best
        tracker.advance_to(0.7 + 0.25 * (index + 1) / len(HOLD_DIVISORS[1:]))
    optima = [replace(d, name=f"{d.name}, exchanged") for d in (*(e for e in optima if e.name != best.name), best)]
    return sorted([*feasible, *optima], key=lambda d: -d.score)


def _bounds_of(
    fit: ModelFit,
    reference_run: Run | None,
    peak: float | Mapping[str, float] | None,
    slew: float | Mapping[str, float] | None,
    limits: Mapping[str, float] | None,
) -> Bounds:
    """Return the limits of inputs, slew rates and outputs, with defaults of peaks and outputs from a reference run.

    Raise ModelError if a limit is missing or invalid.
    """
    peaks, output_limits = None, dict.fromkeys(fit.outputs, math.inf)
    if reference_run is not None:
        peaks = _largest_values(reference_run, fit.inputs, from_start=False)
        output_limits |= _largest_values(reference_run, fit.outputs, from_start=True)
    bounds = Bounds(
        per_signal_values("peak", peak, fit.inputs, peaks),
        per_signal_values("slew", slew, fit.inputs, dict.fromkeys(fit.inputs, math.inf)),
        per_signal_values("limits", limits, fit.outputs, output_limits),
    )
    for name, value in bounds.peaks.items():
        if math.isinf(value):
            raise ModelError(f"peak of {name} is infinite; give the largest value that the machine allows")
    return bounds


def _check_slew(bounds: Bounds, step: float, rows: int) -> None:
    """Raise ModelError if an input needs more than a quarter of the run to change from one peak to the opposite.

    `step` is the sampling interval [s], and `rows` the number of samples.
    """
    ramp = bounds.ramp_samples(step)
    if ramp > rows // 4:
        slowest = min(bounds.slews, key=lambda n: bounds.slews[n] / bounds.peaks[n])
        raise ModelError(
            f"slew of {slowest} = {bounds.slews[slowest]:g} per second needs {ramp * step:.3g} s from one peak to the "
            f"other, but the run lasts only {(rows - 1) * step:g} s; lower "
            f"{parameter('peak')}, or raise {parameter('slew')} or {parameter('duration')}"
        )


def _prediction_findings(model: Model, *, noise_given: bool) -> tuple[Finding, ...]:
    """Return findings on why predictions may be wrong: missing dynamics, or else noise that is not white.

    Noise that is not white is not reported if the user gave the noise standard deviations (`noise_given`).
    """
    findings = () if model.estimate is None else model.estimate.findings
    missing = [f for f in findings if f.code in MISSING_PART_CODES]
    finding = min(missing, key=lambda f: MISSING_PART_CODES.index(f.code), default=None)
    if finding is not None:
        return (make_finding("prediction_in_doubt", output=finding.output, text=finding.text),)
    noise_finding = next((f for f in findings if f.code in NOT_WHITE_CODES), None)
    if noise_finding is None or noise_given:
        return ()
    return (make_finding("designed_for_white_noise", output=noise_finding.output, text=noise_finding.text),)


def _check_signals(fit: ModelFit, reference_run: Run | None) -> None:
    """Raise ModelError if there is no input or a filtered input, and DataError if the reference run lacks an input."""
    if not fit.inputs:
        raise ModelError("the model has no input to design; give a model with an input")
    if fit.problem.structure.all_filtered:
        raise ModelError(
            "an input of the model was measured through the sensor filter, but the command to a rig is not filtered; "
            "identify the model with the filter on outputs only"
        )
    if reference_run is None:
        return
    missing = [n for n in fit.inputs if n not in reference_run.inputs]
    if missing:
        raise DataError(
            f"run {reference_run.name!r} has no input {missing[0]!r}{nearest(missing[0], reference_run.inputs)}, which "
            f"the model requires; give the run of that machine, or leave {parameter('reference_run')} out"
        )


def _positive(name: str, value: object, expected: str) -> float:
    if value is None:
        raise ModelError(
            f"{name} is not given; give {expected} as {parameter(name)}, or a run as {parameter('reference_run')}"
        )
    number = real_number(name, value)
    if not (number > 0 and math.isfinite(number)):
        raise ModelError(f"{setting(name)} {number:g} is not {expected} above 0; give a positive number")
    return number


def _largest_values(run: Run, names: Sequence[str], *, from_start: bool) -> dict[str, float]:
    """Return the largest absolute value of each signal of a run by name; missing and zero signals are omitted.

    With `from_start`, it is the largest absolute deviation from the first value of the signal.
    """
    out = {}
    for name in names:
        if name in run:
            values = drop_missing(run[name])
            largest = float(np.max(np.abs(values - (values[0] if from_start else 0.0))))
            if largest > 0:
                out[name] = largest
    return out


def _parameter_indices(fit: ModelFit, names: Sequence[str] | None) -> tuple[int, ...]:
    """Return the indices of the parameters of interest; by default all free orders, or all parameters without orders.

    Raise ModelError if a name is unknown or repeated.
    """
    if isinstance(names, str):
        names = [names]
    if names is None:
        names = fit.problem.orders or fit.names
    if not isinstance(names, Iterable):
        raise ModelError(f"parameters is {type_name(names)}; give a list of {', '.join(fit.names)}")
    name_list = list(names)
    for k, name in enumerate(name_list):
        if not isinstance(name, str) or name not in fit.names:
            hint = nearest(name, fit.names) if isinstance(name, str) else ""
            raise ModelError(
                f"parameters[{k}] = {short_repr(name)} is not a free parameter of the model{hint}; it has "
                f"{', '.join(fit.names)}"
            )
        if name in name_list[:k]:
            raise ModelError(f"parameters has {name!r} twice; give each once")
    if not name_list:
        raise ModelError("parameters is empty; give those of interest, or leave it out for all orders")
    return tuple(fit.names.index(n) for n in name_list)


def _check_stable(fit: ModelFit, bounds: Bounds) -> None:
    """Raise ModelError if a model is unstable, or has an integrator while an output has no limit."""
    poles = stability(fit.model)
    if poles.unstable_poles != 0 or poles.on_axis:
        raise ModelError(
            f"the model is {poles}, and inputs are designed for stable models; identify the machine with a stabilizing "
            "controller, or check the model"
        )
    unlimited = [o for o, limit in bounds.output_limits.items() if math.isinf(limit)]
    if poles.origin_order > 0 and unlimited:
        raise ModelError(
            f"the model integrates its input (order {poles.origin_order:g}), so that {unlimited[0]} may drift without "
            f"limit; give its maximum acceptable value with {parameter('limits')}, or give "
            f"{parameter('reference_run')} a run"
        )


def _check_uncertainty(fit: ModelFit, step: float, length: float) -> None:
    """Raise ModelError if the model is so uncertain that an input optimal for it may be poor for the machine.

    This is so if an order has a large standard error, or if parameter uncertainty has a large effect on an output.
    `step` [s] and `length` [s] are the sampling interval and the duration of the run.
    """
    covariance = fit.covariance
    errors = np.sqrt(np.diag(covariance))
    uncertain = [
        f"{n} = {v:.3g} ± {e:.2g}"
        for n, v, e in zip(fit.names, fit.values, errors, strict=True)
        if n in fit.problem.orders and not e <= MAX_ORDER_ERROR
    ]
    if uncertain:
        _raise_too_uncertain(fit, f"order {uncertain[0]}", (step, length))
    rows = min(max(round(length / step), MIN_RUN_SAMPLES), 2000)
    interval = length / rows
    inputs = np.stack(
        [np.where(np.random.default_rng(k).random(rows) < 0.5, -1.0, 1.0) for k in range(len(fit.inputs))]
    )
    run = fit.run(np.cumsum(inputs, axis=1) / math.sqrt(rows) + inputs, interval, "probe")
    jacobian = fit.jacobian(run)
    variances = np.einsum("pt,pq,qt->t", jacobian, covariance, jacobian)
    for output, variance in zip(fit.outputs, np.split(variances, len(fit.outputs)), strict=True):
        rms = float(np.sqrt(np.mean((run[output] / fit.noise[output]) ** 2)))
        ratio = float(np.sqrt(np.mean(np.maximum(variance, 0.0)))) / max(rms, 1e-300)
        if not ratio <= MAX_RELATIVE_UNCERTAINTY:
            _raise_too_uncertain(
                fit, f"its uncertainty changes the response of {output} by {100 * ratio:.0f} %", (step, length)
            )


def _raise_too_uncertain(fit: ModelFit, reason: str, times: tuple[float, float] | None) -> None:
    """Raise ModelError for a model that is too uncertain, with the reason `reason` and a recommended first experiment.

    `times` are (sampling interval, duration) of the run [s], or None.
    """
    low, high = (0.1, 10.0) if times is None else (1.0 / times[1], 0.1 / times[0])
    try:
        frequencies = [abs(m.pole) / (2 * math.pi) for m in modes(fit.model)]
        if frequencies:
            low, high = max(low, min(frequencies) / 10), min(high, 10 * max(frequencies))
    except FtlmError:
        # If the modes of the model are unknown, the band of the run is used.
        pass
    band = f"{low:.2g}:{max(high, 2 * low):.2g}"
    raise ModelError(
        f"the intervals are too wide to design on ({reason}): an input that is optimal for this model may be poor for "
        f"the machine. First record a run that excites the whole band, such as a multisine of {band} Hz (ftlm record "
        f"--input multisine --band {band}), and identify again from both runs"
    )


def _robust_scale(sensitivities: Sensitivities, bounds: Bounds, commands: Floats) -> float:
    """Return the largest factor, at most 1, with which scaled commands and 95 % bands of outputs meet the limits.

    The bands represent the uncertainty of the parameters.
    """
    fit, outputs, derivatives = sensitivities.fit, sensitivities.outputs(commands), sensitivities.derivatives(commands)
    variances = np.einsum("pot,pq,qot->ot", derivatives, fit.covariance, derivatives)
    noise = np.array([fit.noise[o] for o in fit.outputs])[:, None]
    largest = np.abs(outputs) + NORMAL_95 * noise * np.sqrt(np.maximum(variances, 0.0))
    return bounds.scale(commands, largest)


def _errors(fit: ModelFit, reference: Run, run: Run) -> dict[str, Floats]:
    """Return the standard errors of the parameters, one array per case "now", "square", "designed" and "both".

    The cases are, in this sequence: the model; a fit to the square wave (`reference`); a fit to the designed run
    (`run`); a fit to the designed run together with the estimation runs. The last three are predictions.
    """
    current, predicted = fit.covariance, fit.predicted_covariance(run)
    scale = np.sqrt(np.diag(current))
    information = np.linalg.inv(current / np.outer(scale, scale)) + np.linalg.inv(predicted / np.outer(scale, scale))
    both = np.linalg.inv(information) * np.outer(scale, scale)
    covariances = {"now": current, "square": fit.predicted_covariance(reference), "designed": predicted, "both": both}
    return {k: np.sqrt(np.diag(v)) for k, v in covariances.items()}


def _predicted_extremes(run: Run, bounds: Bounds) -> tuple[PredictedExtreme, ...]:
    out = []
    for name, limit in bounds.peaks.items():
        out.append(PredictedExtreme(name, float(np.max(np.abs(run[name]))), limit))
        if math.isfinite(bounds.slews[name]):
            fastest = float(np.max(np.abs(np.diff(run[name][:-1], prepend=0.0)))) / run.step
            out.append(PredictedExtreme(f"slew of {name}", fastest, bounds.slews[name]))
    return (
        *out,
        *(PredictedExtreme(o, float(np.max(np.abs(run[o]))), limit) for o, limit in bounds.output_limits.items()),
    )


def _shape_text(best: Design, run: Run, sensitivities: Sensitivities) -> str:
    """Return text that describes the shape of the designed input: name of the initial input, number of switches."""
    if not best.name.endswith("exchanged"):
        return best.name
    first = sensitivities.fit.inputs[0]
    switches = int(np.sum(np.diff(run[first][:-1]) != 0)) if sensitivities.ramp == 1 else 0
    origin = best.name.removesuffix(", exchanged")
    return f"levels exchanged from {origin}" + (f", {switches} switches" if switches else "")
