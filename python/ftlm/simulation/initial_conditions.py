"""Choice of the initial conditions of a run: rest, or initial terms that represent its past inputs.

An initial term is a power of t in the integrated equation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from ftlm.data.run import Run
from ftlm.data.sampling import drop_missing
from ftlm.structure.structure import History, Initial, Structure
from ftlm.utils.linalg import vector_norm
from ftlm.utils.statistics import (
    NOISE_SAMPLES,
    REST_FRACTION,
    REST_SIGMAS,
    ROUNDING_RESIDUAL_RATIO,
    chi_squared,
    estimate_noise,
    huber_excess,
    is_rest,
    quantization_step,
    variance_inflation,
    white_noise,
)
from ftlm.utils.validation import Floats

#: Increment of the exponents of t in a history.
POWER_INCREMENT = 0.25
#: Ratio of the norm of a signal to its noise standard deviation, and the highest exponent of t, in quarters, at which
#: biases are then below a tenth of a standard error (benches/history.py bases).
REFERENCE_SIGNAL_RATIO, REFERENCE_QUARTERS = 2500.0, 6
#: Factor by which an exponent higher by a quarter reduces the unmodeled effect of past inputs.
SIGNAL_RATIO_PER_QUARTER = 2.5
#: Minimum and maximum of the highest exponent, in quarters.
MIN_QUARTERS, MAX_QUARTERS = 2, 12
#: Minimum number of samples of a run per quarter of the highest exponent.
MIN_SAMPLES_PER_QUARTER = 16
#: Integer exponents below this number are always included, so that the list is the same for all orders up to 3.
MIN_INTEGER_POWERS = 3
#: Significance level of the test of Caputo's terms against a full history. The usual 1 or 5 % would miss weak effects
#: of past inputs, and confidence intervals would not cover the bias. The level is lower with an offset, because the
#: offset explains a nonzero first value, and a history would make the offset unidentifiable.
HISTORY_TEST_LEVEL, HISTORY_TEST_LEVEL_WITH_OFFSET = 0.25, 0.02
#: Weight of the excess in the residual sum of squares, as an alternative to the robust excess. A few outliers must not
#: require a history. On the other hand, a least-squares fit must not be worse than one with a history and fewer
#: parameters.
SQUARES_WEIGHT = 0.25


@dataclass(frozen=True)
class StartSettings:
    """Thresholds for the choice of initial conditions, tuned on simulated records and verified on others.

    Parameters
    ----------
    quiet_rows
        Minimum number of samples before the first change of an input ("quiet" samples) that are accepted as evidence of
        rest.
    sigmas
        Number of standard errors within which slope, standard deviation and mean of quiet samples are consistent
        with noise.
    noise_error
        Relative standard error of the noise estimate, multiplied by the square root of the number of samples.
    least_noise
        Noise assumed for a noise-free signal, as a fraction of its standard deviation.
    drift_share
        Maximum standard error of a drift in the quiet samples, extrapolated to the whole run, as a fraction of the
        output's standard deviation. It is checked only if at least one input begins at a nonzero value, and at least
        one input changes more than once.
    outlier_share
        Maximum fraction of quiet samples that may be outliers; one outlier is always allowed.
    rounding
        Change of an input, relative to its largest value, below which it counts as constant.
    slow_share
        Maximum change of an output between two samples, as a fraction of its median change, at which the output counts
        as slow. The output is only tested if its noise is below this change as well.
    moving_share
        Minimum fraction of samples in which an output must not be slow, so that a slow start of this output is evidence
        of rest.
    white_inflation
        Variance inflation of the mean of the residuals (1 for white noise) above which the structure is regarded as
        incomplete.
    history_margin
        Difference of :func:`start_score` above which initial terms of a history (past inputs) are preferred although
        the residuals are colored.
    """

    quiet_rows: int = 5
    sigmas: float = 3.3
    noise_error: float = 1.5
    least_noise: float = 1e-6
    drift_share: float = 0.1
    outlier_share: float = 0.1
    rounding: float = 1e-9
    slow_share: float = 0.1
    moving_share: float = 0.8
    white_inflation: float = 2.0
    history_margin: float = 30.0


START_SETTINGS = StartSettings()


@dataclass(frozen=True)
class RestEvidence:
    """Evidence in the first samples of a run that the plant was at rest before the run.

    Parameters
    ----------
    rows
        Number of samples in which inputs and outputs are constant before an input changes. It is 1 if the evidence is
        that the outputs start slowly at zero. It is 0 if no input changes after the second sample; rest is then an
        assumption.
    levels
        Constant value of each output before the run.
    inputs
        Constant value of each input before the run.
    shows_level
        Whether at least one of these values is not 0, within the noise.
    """

    rows: int
    levels: dict[str, float]
    inputs: dict[str, float]
    shows_level: bool


_EVIDENCE_BY_RUN: WeakKeyDictionary[Run, dict[tuple[tuple[str, ...], tuple[str, ...]], RestEvidence | None]] = (
    WeakKeyDictionary()
)


def rest_evidence(run: Run, structure: Structure) -> RestEvidence | None:
    """Return the evidence that the plant was at rest before the run; None if it may have been in motion."""
    run = run.unmasked_run or run
    evidence = _EVIDENCE_BY_RUN.setdefault(run, {})
    key = structure.outputs, structure.signals
    if key not in evidence:
        inputs, outputs = ([n for n in structure.signals if n in names] for names in (run.inputs, run.outputs))
        evidence[key] = None
        if inputs and outputs and all(n in run for n in structure.signals):
            evidence[key] = _rest_evidence(run, inputs, outputs) or _slow_start_evidence(run, inputs, outputs)
    return evidence[key]


def _rest_evidence(run: Run, inputs: Sequence[str], outputs: Sequence[str]) -> RestEvidence | None:
    """Return evidence of rest from quiet first samples, or from inputs that are constant from the second sample on.

    Quiet samples are those before an input changes. The result is None if there is no such evidence.
    """
    if run.nonuniform_samples is not None and run.missing_samples:
        return None
    if any(np.nanstd(run[n]) == 0.0 for n in outputs):
        # A constant output gives no evidence, for example in a run that is only an input for a simulation.
        return None
    change_indices = [_change_indices(run[n]) for n in inputs]
    rest_length = min((int(rows[0]) for rows in change_indices if rows.size), default=0)
    if rest_length >= START_SETTINGS.quiet_rows:
        levels = {}
        shows_level = any(run[n][0] != 0.0 for n in inputs)
        # A command that changes often may have changed before the run, so a longer quiet phase is required.
        has_frequent_changes = shows_level and any(np.count_nonzero(np.diff(run[n])) > 1 for n in inputs)
        for name in outputs:
            noise = noise_at_start(run[name])
            rows = _without_outliers(drop_missing(run[name][:rest_length]), noise)
            if rows.size < START_SETTINGS.quiet_rows or not _is_at_rest(rows, noise):
                return None
            drift_error = noise * run.length / _noise_to_slope_error_ratio(rows.size)
            if has_frequent_changes and drift_error > START_SETTINGS.drift_share * float(np.nanstd(run[name])):
                return None
            levels[name] = float(np.mean(rows))
            threshold = START_SETTINGS.sigmas * noise / math.sqrt(rows.size) + REST_FRACTION * float(
                np.nanstd(run[name])
            )
            shows_level |= abs(levels[name]) > threshold or _is_tared(run[name])
        return RestEvidence(rest_length, levels, {n: float(run[n][0]) for n in inputs}, shows_level)
    constant = all(_change_indices(run[n][1:]).size == 0 for n in inputs)
    if not constant or not any(np.any(run[n][1:]) for n in inputs):
        return None
    first_values = {n: float(drop_missing(run[n])[0]) for n in outputs}
    shows_level = any(not is_rest(run[n]) or _is_tared(run[n]) for n in outputs)
    return RestEvidence(0, first_values, dict.fromkeys(inputs, 0.0), shows_level)


def _is_tared(samples: Floats) -> bool:
    """Whether the first value of a noisy signal was subtracted from all values. Its noise is then a level.

    The first value is then exactly 0. Rounding errors of a quantized signal are no such noise.
    """
    if samples[0] != 0.0:
        return False
    rounding = max(START_SETTINGS.least_noise * float(np.nanstd(samples)), quantization_step(drop_missing(samples)))
    return white_noise(samples) > rounding


def _slow_start_evidence(run: Run, inputs: Sequence[str], outputs: Sequence[str]) -> RestEvidence | None:
    """Return the evidence that outputs start at zero and change slowly at first; None if they do not.

    The inputs may be arbitrary.
    """
    series = [run[n] for n in outputs]
    if run.nonuniform_samples is not None or not all(map(is_rest, series)) or not _starts_slowly(series):
        return None
    return RestEvidence(1, dict.fromkeys(outputs, 0.0), dict.fromkeys(inputs, 0.0), shows_level=False)


def _starts_slowly(outputs: Sequence[Floats]) -> bool:
    """True if every output that changes in most samples changes little between its first two samples.

    False if no output changes in most samples.
    """
    conclusive = False
    for samples in outputs:
        noise = START_SETTINGS.sigmas * math.sqrt(2.0) * noise_at_start(samples)
        changes = np.abs(np.diff(samples))
        limit = START_SETTINGS.slow_share * float(np.nanmedian(changes))
        if noise <= limit and np.mean(drop_missing(changes) > limit) > START_SETTINGS.moving_share:
            conclusive = True
            if not changes[0] <= limit:
                return False
    return conclusive


def noise_at_start(samples: Floats) -> float:
    """Return an upper bound of the noise standard deviation: the estimate plus two standard errors of the estimate."""
    count = min(samples.size, NOISE_SAMPLES)
    noise = white_noise(samples) * (1.0 + 2.0 * START_SETTINGS.noise_error / math.sqrt(count))
    return max(noise, START_SETTINGS.least_noise * float(np.nanstd(samples)))


def _change_indices(samples: Floats) -> NDArray[np.intp]:
    """Return the indices of samples that differ from the first one."""
    return np.flatnonzero(np.abs(samples - samples[0]) > START_SETTINGS.rounding * float(np.max(np.abs(samples))))


def _is_at_rest(rows: Floats, noise: float) -> bool:
    """Whether slope and standard deviation of samples are consistent with white noise of standard deviation `noise`."""
    t = np.arange(rows.size) - 0.5 * (rows.size - 1)
    slope, scatter = float(t @ rows) / float(t @ t), float(np.std(rows))
    limits = noise / _noise_to_slope_error_ratio(rows.size), noise / math.sqrt(2.0 * rows.size)
    return abs(slope) <= START_SETTINGS.sigmas * limits[0] and scatter <= noise + START_SETTINGS.sigmas * limits[1]


def _without_outliers(rows: Floats, noise: float) -> Floats:
    """Return samples without a few values far from the median; more such values are not outliers and are kept."""
    is_inlier = np.abs(rows - np.median(rows)) <= REST_SIGMAS * noise if rows.size else np.ones(0, dtype=bool)
    max_outliers = max(1.0, START_SETTINGS.outlier_share * rows.size)
    return rows[is_inlier] if np.count_nonzero(~is_inlier) <= max_outliers else rows


def _noise_to_slope_error_ratio(rows: int) -> float:
    """Return the ratio of the noise standard deviation to the standard error of a least-squares slope per sample.

    The line is fitted to `rows` samples.
    """
    return math.sqrt(rows * (rows**2 - 1) / 12.0)


def resolve_start(runs: Sequence[Run], structure: Structure) -> Structure:
    """Return the structure with initial conditions and offset for runs whose plant was at rest before the first sample.

    Initial terms and offsets that the user gave are kept. The initial conditions ``"auto"`` become ``"rest"``, but
    remain ``"auto"`` if a run may have been in motion. The offset becomes ``"level"`` if outputs or inputs were at rest
    at nonzero values, or if it is ``"constant"`` and no input changes. With direct
    feedthrough, a nonzero output under constant inputs is no evidence of a level, because feedthrough explains it too.
    """
    automatic = structure.initial == "auto" and structure.offset in ("none", "level", "constant")
    if not structure.is_linear or not (automatic or (structure.initial, structure.offset) == ("rest", "constant")):
        return structure
    evidence = [rest_evidence(run, structure) for run in runs]
    available = [f for f in evidence if f is not None]
    constant = structure.offset == "constant" and any(f.rows == 0 for f in available)
    direct = any(t.order == e.order for e in structure.equations for t in e.terms)
    has_level = any(f.shows_level and not (direct and f.rows == 0) for f in available)
    offset = "level" if constant or has_level else structure.offset
    initial = "rest" if automatic and len(available) == len(evidence) else structure.initial
    return replace(structure, initial=initial, offset=offset)


def deviations(
    run: Run, structure: Structure, output_levels: Mapping[str, float] | None = None
) -> tuple[Run, dict[str, float]]:
    """Return a run minus the levels of its signals before the first sample, and the levels of its outputs by name.

    The level of a signal is its constant value before an input changes. Without evidence of rest, the level of an
    output is its first value, and inputs are unchanged. Estimated `output_levels` replace these values. The level of an
    input with a saturation or dead zone is not subtracted.
    """
    evidence = rest_evidence(run, structure)
    limited = {limit.signal for limit in structure.limits}
    outputs = [n for n in structure.signals if n in run.outputs]
    levels = {n: float(drop_missing(run[n])[0]) for n in outputs} if evidence is None else evidence.levels
    levels = {**levels, **(output_levels or {})}
    inputs = {} if evidence is None else {n: v for n, v in evidence.inputs.items() if n not in limited}
    levels_nonzero = {n: v for n, v in {**levels, **inputs}.items() if v != 0.0}
    if not levels_nonzero:
        return run, levels
    samples = {n: run[n] - v for n, v in levels_nonzero.items()}
    nonuniform = run.nonuniform_samples
    shifted_samples = None if nonuniform is None else {n: nonuniform.data[n] - v for n, v in levels_nonzero.items()}
    shifted = run.with_samples(samples, shifted_samples)
    if run.unmasked_run is not None:
        shifted = shifted.with_unmasked_run(deviations(run.unmasked_run, structure, output_levels)[0])
    return shifted, levels


def starts_at_rest(run: Run, structure: Structure) -> bool:
    """Whether the first samples of all outputs are zero within their noise."""
    return all(is_rest(run[name]) for name in structure.signals if name in run.outputs)


def has_memory(structure: Structure) -> bool:
    """Whether an order is free or fractional, so that no finite-dimensional state represents the past."""
    orders = [o for e in structure.equations for o in e.orders]
    return any(o.names or o.constant != round(o.constant) for o in orders)


def history(run: Run, structure: Structure) -> History:
    """Return the exponents of t that represent the effect of past inputs on a run.

    Their number increases with the signal-to-noise ratio of the outputs.
    """
    signal_to_noise = 1.0
    for name in structure.outputs:
        if name in run:
            samples = drop_missing(run[name])
            # Without an offset, the mean is an effect of past inputs. An offset represents the mean itself.
            norm = vector_norm(samples - (0.0 if structure.offset == "none" else np.mean(samples)))
            if norm:
                signal_to_noise = max(
                    signal_to_noise, norm / max(estimate_noise(run[name]), np.finfo(np.float64).eps * norm)
                )
    quarters = REFERENCE_QUARTERS + math.ceil(
        math.log(signal_to_noise / REFERENCE_SIGNAL_RATIO) / math.log(SIGNAL_RATIO_PER_QUARTER)
    )
    quarters = max(MIN_QUARTERS, min(quarters, MAX_QUARTERS, run.length // MIN_SAMPLES_PER_QUARTER))
    highest = max((e.order.constant for e in structure.equations if not e.order.names), default=0.0)
    integer_powers = range(max(MIN_INTEGER_POWERS, math.ceil(highest)))
    return History(sorted({*(POWER_INCREMENT * k for k in range(quarters + 1)), *map(float, integer_powers)}))


def resolve_initial_conditions(run: Run, structure: Structure) -> Initial:
    """Return the initial conditions of a structure for a run, with ``"auto"`` and ``"history"`` resolved."""
    structure = resolve_start([run], structure)
    initial = structure.initial
    if initial == "auto":
        if structure.offset != "level" and starts_at_rest(run, structure):
            return "rest"
        initial = conditions_in_motion(structure)
    return history(run, structure) if initial == "history" else initial


def conditions_in_motion(structure: Structure) -> Initial:
    """Return the initial conditions for a run that may start in motion.

    They are ``"history"`` for a linear structure with free or fractional orders, otherwise ``"caputo"``.
    """
    # A history superposes responses to past inputs, which requires linearity.
    return "history" if has_memory(structure) and structure.is_linear else "caputo"


def common_initial_conditions(decisions: list[Initial]) -> Initial | None:
    """Return the most general of the initial conditions of several runs; None if all are equal.

    Powers of t are more general than Caputo's initial values, and these are more general than rest.
    """
    if len(set(decisions)) < 2:
        return None
    return max(decisions, key=lambda d: (isinstance(d, tuple), d == "caputo", len(d)))


def resolve_common_initial_conditions(runs: Sequence[Run], structure: Structure) -> Initial:
    """Return initial conditions that are common to all runs of a fit, with ``"auto"`` and ``"history"`` resolved."""
    starts = [resolve_initial_conditions(run, structure) for run in runs]
    return common_initial_conditions(starts) or starts[0]


def huber_loss_excess(
    few_term_residuals: Sequence[Floats], many_term_residuals: Sequence[Floats], output_deviations: Sequence[float]
) -> float:
    """Return the excess of the Huber loss with few initial terms over that with many, in units of the noise variance.

    The excess is summed over outputs; outputs with residuals of rounding size are omitted. If the few terms are
    sufficient, the sum has a chi-squared distribution. Its degrees of freedom are the number of additional terms.

    Parameters
    ----------
    few_term_residuals, many_term_residuals
        Residuals of each output with few and with many terms; infinite if the simulation is not finite, NaN at missing
        samples.
    output_deviations
        Standard deviation of each measured output.
    """
    excess = 0.0
    for few_series, many_series, deviation in zip(
        few_term_residuals, many_term_residuals, output_deviations, strict=True
    ):
        is_finite = ~np.isnan(few_series)
        if float(np.sqrt(np.mean(few_series[is_finite] ** 2))) > ROUNDING_RESIDUAL_RATIO * deviation:
            excess += huber_excess(few_series[is_finite], many_series[is_finite])
    return excess


def loss_excess_of_fits(
    few_term_residuals: Sequence[Floats], many_term_residuals: Sequence[Floats], output_deviations: Sequence[float]
) -> float:
    """Return the larger of :func:`huber_loss_excess` and a quarter of the excess sum of squares, for two fits.

    The excess is divided by the noise variance. Arguments are those of :func:`huber_loss_excess`.
    """
    squares = 0.0
    for few_series, many_series, deviation in zip(
        few_term_residuals, many_term_residuals, output_deviations, strict=True
    ):
        is_finite = ~np.isnan(few_series)
        floor, squares_excess = (
            float(np.mean(many_series[is_finite] ** 2)),
            float(np.sum(few_series[is_finite] ** 2 - many_series[is_finite] ** 2)),
        )
        if math.sqrt(float(np.mean(few_series[is_finite] ** 2))) > ROUNDING_RESIDUAL_RATIO * deviation:
            squares += squares_excess / floor if floor > 0.0 else math.inf
    return max(huber_loss_excess(few_term_residuals, many_term_residuals, output_deviations), SQUARES_WEIGHT * squares)


def output_residuals(measurement: Floats, simulated: Floats) -> Floats:
    """Return measured minus simulated samples; infinite if the simulation is not finite, NaN at missing samples."""
    with np.errstate(invalid="ignore"):
        rows: Floats = measurement - simulated
    rows[~np.isnan(measurement) & ~np.isfinite(rows)] = np.inf
    return rows


def start_score(residuals: Sequence[Floats], terms: int, reference: Sequence[Floats]) -> float:
    """Return the Bayesian information criterion of a fit with `terms` initial terms, up to a constant.

    Lower is better. Other parameters are not counted, so compared fits must have the same other parameters. The number
    of samples is divided by the variance inflation of the `reference` residuals, which must be the same for all
    compared fits. A smooth misfit then has the same weight in all of them.
    """
    score, effective_total = 0.0, 0.0
    for series, reference_series in zip(residuals, reference, strict=True):
        differences = drop_missing(series)
        effective_count = differences.size / variance_inflation(drop_missing(reference_series))
        effective_total += effective_count
        score += effective_count * math.log(max(float(np.mean(differences**2)), 1e-300))
    return score + math.log(max(effective_total, 1.0)) * terms


def needs_history(
    structure: Structure,
    few_term_residuals: Sequence[Floats],
    many_term_residuals: Sequence[Floats],
    output_deviations: Sequence[float],
    terms: tuple[int, int],
) -> bool:
    """Whether residuals with Caputo's initial terms are so large that terms for past inputs (a history) are required.

    `few_term_residuals` and `many_term_residuals` are the residuals of each output with Caputo's terms and with a
    history. `terms` are the numbers of these terms, and `output_deviations` the standard deviations of the outputs.

    The powers of t of a history can also fit an effect that the structure lacks. The threshold is therefore higher for
    colored residuals.
    """
    additional_terms = terms[1] - terms[0]
    finite = all(np.all(np.isfinite(drop_missing(r))) for r in (*few_term_residuals, *many_term_residuals))
    if (
        finite
        and additional_terms > 0
        and max(variance_inflation(drop_missing(r)) for r in many_term_residuals) > START_SETTINGS.white_inflation
    ):
        return start_score(
            many_term_residuals, terms[1], few_term_residuals
        ) + START_SETTINGS.history_margin < start_score(few_term_residuals, terms[0], few_term_residuals)
    significance_level = HISTORY_TEST_LEVEL if structure.offset == "none" else HISTORY_TEST_LEVEL_WITH_OFFSET
    return additional_terms > 0 and loss_excess_of_fits(
        few_term_residuals, many_term_residuals, output_deviations
    ) > chi_squared(additional_terms, significance_level)
