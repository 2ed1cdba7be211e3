"""Feedback test: whether an input depends on past values of an output (Granger causality)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ftlm import _core
from ftlm.utils.formatting import attributes
from ftlm.utils.linalg import minimum_norm_solution
from ftlm.utils.statistics import chi_squared, robust_deviation
from ftlm.utils.validation import Floats

FeedbackState = Literal["command", "none", "found", "undecided"]
#: Significance level over all sets of regressors, and numbers of past output innovations in the sets that have them.
FEEDBACK_LEVEL = 0.005
INNOVATION_COUNTS = (3, 12)
#: Minimum number of samples of a run, and maximum number of tested samples.
MIN_FEEDBACK_ROWS, MAX_FEEDBACK_ROWS = 150, 8_000
#: Maximum lags of the input itself, of other inputs and of the output; each is also limited by a fraction of
#: the run.
MAX_INPUT_LAGS, MAX_OTHER_LAGS, MAX_OUTPUT_LAGS = 60, 20, 40
#: Maximum number of distinct values, and maximum ratio of this number to the number of samples, of an input that
#: switches between few levels. A linear prediction of such an input has no meaningful innovation.
MAX_COMMAND_LEVELS, MAX_COMMAND_LEVEL_FRACTION = 6, 0.01
#: Minimum number of changes of an input that is constant between its changes.
MIN_CHANGES = 80
#: One-step prediction error of an input, relative to its standard deviation, below which its own past determines it.
PREDICTED_FRACTION = 3e-4
#: Innovation of an output, relative to its standard deviation, below which it is a rounding error.
QUIET_FRACTION = 1e-6
#: Limits [standard deviations] at which input innovations, output innovations, and residuals are clipped.
INPUT_CLIP, OUTPUT_CLIP, RESIDUAL_CLIP = 3.0, 5.0, 12.0
#: Threshold [robust standard deviations] and number of iterations of the robust prediction of the input.
ROBUST_SIGMAS, ROBUST_ITERATIONS = 2.0, 4
#: Feedback is certain from these values on: the fraction of the input innovation that past outputs explain, the
#: relative prediction error of the input, and the ratio of the test statistic to its limit.
CERTAIN_FRACTION, ROUGH_FRACTION, CERTAIN_RATIO = 0.5, 2e-3, 5.0
#: Minimum of samples x explained fraction x (relative prediction error)^2, below which feedback hardly biases
#: estimates.
MIN_FEEDBACK_POWER = 0.01
#: Assumed variances of the noise on a measured input, as fractions of the largest possible variance.
INPUT_NOISE_FRACTIONS = (0.2, 0.4, 0.6, 0.75, 0.87, 0.94)
#: Number of time shifts of the outputs that serve as placebos, and minimum ratio of the test statistic to the largest
#: placebo statistic for detected feedback.
PLACEBO_COUNT, PLACEBO_RATIO = 19, 1.2
#: Minimum ratio to the placebo statistic, and to the limit, if the input innovation is not white in all parts of a run.
PLACEBO_RATIO_IN_DOUBT = 10.0
#: Number of parts of a run, and minimum explained power of the median part relative to that of all parts together.
STEADY_PARTS, STEADY_FRACTION = 8, 0.05
#: Number of samples of the short blocks in which whiteness and independence from past inputs are tested, and maximum
#: lag of the test of whiteness.
LOCAL_ROWS, LOCAL_LAGS = 50, 4
#: Maximum number of spectral lines of an input, minimum ratio of their power to the median power of the neighborhood,
#: and half-width of the neighborhood [bins].
MAX_LINES, LINE_RATIO, LINE_NEIGHBORS = 16, 40.0, 400
#: Weight of the newest residual in low-pass filtered residuals, which integral control feeds back, and length of the
#: filter [samples].
SLOW_FORGETTING, SLOW_MEMORY_ROWS = 0.1, 100
RIDGE_FRACTION = 1e-10


@dataclass(frozen=True)
class FeedbackTest:
    """Result of a test of whether an input depends on past values of an output (feedback).

    Parameters
    ----------
    state
        Conclusion. ``"command"``: the input was generated in open loop, because it repeats itself, has few levels, or
        is determined by its own past. ``"none"``: no feedback. ``"found"``: past outputs explain innovations of the
        input; noise on the measured input has the same effect. ``"undecided"``: see ``reason``.
    reason
        Reason for the conclusion as text; empty if there is none.
    ratio
        Largest test statistic over all sets of regressors, divided by its limit. In open loop, the probability that the
        ratio exceeds 1 is about 0.5 %.
    explained_fraction
        Fraction of the variance of the input innovation that past outputs explain.
    samples
        Number of samples that were tested.
    bias
        Maximum bias that the feedback causes in a parameter, in standard errors of the parameter; None if unknown.
    same_sample_correlation
        Correlation between the innovations of input and output in the same sample, divided by its 99.5 % limit, with
        its sign. Feedback without delay and direct feedthrough both cause it.
    response
        Part of the input that past residuals of the output explain, one array per run in the unit of the input; empty
        without feedback.
    """

    state: FeedbackState
    reason: str = ""
    ratio: float = 0.0
    explained_fraction: float = 0.0
    samples: int = 0
    bias: float | None = None
    same_sample_correlation: float = 0.0
    response: tuple[Floats, ...] = field(default=(), repr=False, compare=False)

    @property
    def has_feedback(self) -> bool:
        """Whether the test found that the input depends on past outputs."""
        return self.state == "found"

    def is_feedback_within_row(self, gain: float) -> bool:
        """Whether the input is correlated with the output innovation in the same row only, as by immediate feedback.

        The sign of the correlation is opposite to that of the static `gain` of the plant. A missing direct feedthrough
        gives the same sign.
        """
        return self.state == "undecided" and self.same_sample_correlation * math.copysign(1.0, gain) < -1.0

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a dictionary for JSON."""
        return attributes(self, ("state", "reason", "has_feedback", "ratio", "explained_fraction", "samples", "bias"))


def feedback_test(
    residuals: Sequence[Floats], signal: Sequence[Floats], other_inputs: Sequence[Sequence[Floats]] = ()
) -> FeedbackTest:
    """Test whether an input depends on past outputs: feedback in Granger's sense (doi:10.2307/1912791).

    The innovation of the input is its residual after regression on its own past and on the other inputs. In open loop
    the innovation is independent of past outputs. This requires that the regression includes enough lags, and that no
    other input depends on both the output and this input. A heteroskedasticity-robust score test (White,
    doi:10.2307/1912934) tests whether past residuals, their differences, their low-pass part and past innovations of
    the output predict the innovation of the input. The present residual is not used, because feedback within one sample
    cannot be distinguished from direct feedthrough.

    Parameters
    ----------
    residuals
        Residuals of the output, or the output itself, one array per run; NaN marks a missing sample.
    signal
        Input, one array per run.
    other_inputs
        Other inputs, each with one array per run. Their past and present values are regressors of the input.
    """
    runs = [k for k, u in enumerate(signal) if u.size >= MIN_FEEDBACK_ROWS]
    longest = sum(signal[k].size for k in runs)
    if not runs:
        min_size = max((u.size for u in signal), default=0)
        return FeedbackTest("undecided", f"runs of {min_size} rows; {MIN_FEEDBACK_ROWS} are needed")
    inputs = [signal[k] for k in runs]
    if all(np.ptp(u) == 0 for u in inputs):
        return FeedbackTest("undecided", "the input is constant")
    changes = [np.flatnonzero(np.diff(u)) + 1 for u in inputs]
    levels = np.unique(np.concatenate(inputs)).size
    if all(_is_periodic(u) for u in inputs):
        return FeedbackTest("command", "it repeats itself exactly", samples=longest)
    if levels <= max(MAX_COMMAND_LEVELS, MAX_COMMAND_LEVEL_FRACTION * longest):
        if _has_common_change_interval(changes):
            return FeedbackTest("command", f"{levels} levels on a clock", samples=longest)
        return FeedbackTest(
            "undecided", f"{levels} levels: a relay and a command are indistinguishable", samples=longest
        )
    count = sum(c.size for c in changes)
    dense = 2 * count >= longest
    if not dense and count < MIN_CHANGES:
        return FeedbackTest("undecided", f"{count} changes; {MIN_CHANGES} are needed", samples=longest)
    if not dense:
        # Between its changes a zero-order-hold input has no innovation. The residual before a change is known at the
        # change.
        rows_by_run = [k for k, c in enumerate(changes) if c.size >= MIN_CHANGES // 2]
        if not rows_by_run:
            return FeedbackTest("undecided", f"{count} changes over {len(runs)} short runs", samples=longest)
        runs, inputs, changes = (
            [runs[k] for k in rows_by_run],
            [inputs[k] for k in rows_by_run],
            [changes[k] for k in rows_by_run],
        )
        aligned_residuals = [_fill_missing(residuals[k])[c - 1] for k, c in zip(runs, changes, strict=True)]
        input_values = [u[c] for u, c in zip(inputs, changes, strict=True)]
        other_at_changes = [[other[k][c] for k, c in zip(runs, changes, strict=True)] for other in other_inputs]
    else:
        aligned_residuals, input_values = [_fill_missing(residuals[k]) for k in runs], inputs
        other_at_changes = [[other[k] for k in runs] for other in other_inputs]
    row_budget = MAX_FEEDBACK_ROWS
    sizes = []
    for u in input_values:
        sizes.append(min(u.size, row_budget))
        row_budget -= sizes[-1]
    rows_used = [k for k, rows in enumerate(sizes) if rows >= (MIN_FEEDBACK_ROWS if dense else MIN_CHANGES // 2)]
    test = _Innovations(
        [aligned_residuals[k][: sizes[k]] for k in rows_used],
        [input_values[k][: sizes[k]] for k in rows_used],
        [[other[k][: sizes[k]] for k in rows_used] for other in other_at_changes],
        shift=int(dense),
    ).test()
    if not test.has_feedback:
        return test
    responses: list[Floats] = [np.zeros(u.size) for u in signal]
    for k, response in zip(rows_used, test.response, strict=True):
        response_rows, size = responses[runs[k]], inputs[k].size
        if dense:
            response_rows[: response.size] = response
        else:
            boundaries = [*changes[k][1 : response.size], size][: response.size]
            for_rows = np.diff([changes[k][0], *boundaries])
            series = np.repeat(response, for_rows)
            response_rows[changes[k][0] : changes[k][0] + series.size] = series
    return replace(test, response=tuple(responses))


def _fill_missing(residuals: Floats) -> Floats:
    """Return residuals with missing samples replaced by the mean, which only reduces the power of the test."""
    is_missing = np.isnan(residuals)
    return (
        np.where(is_missing, np.mean(residuals[~is_missing]), residuals)
        if is_missing.any() and not is_missing.all()
        else residuals
    )


def _has_common_change_interval(changes: Sequence[NDArray[np.intp]]) -> bool:
    """Whether a signal changes only at multiples of a common interval of at least two samples, as a generated one does.

    `changes` are the sample indices of the changes in each run.
    """
    gaps = np.concatenate([np.diff(c) for c in changes])
    return bool(gaps.size >= MAX_COMMAND_LEVELS and np.gcd.reduce(gaps) > 1)


def _is_periodic(u: Floats) -> bool:
    """Whether an input is exactly periodic, with a period of at most half the run."""
    x = u - u.mean()
    count = x.size
    power = np.abs(np.fft.rfft(x, 2 * count)) ** 2
    correlation = np.fft.irfft(power)[:count] / np.arange(count, 0, -1)
    start = 8
    periods = np.argsort(-correlation[start : count // 2 + 1])[:3] + start
    return any(np.max(np.abs(u[p:] - u[:-p])) <= 1e-6 * np.ptp(u) for p in periods.tolist())


def _lags(x: Floats, first_lag: int, last_lag: int, start: int) -> Floats:
    """Return a matrix of lagged samples: rows from ``start`` on, columns with lags ``first_lag`` to ``last_lag``."""
    windows = sliding_window_view(x, last_lag - first_lag + 1)
    return windows[start - last_lag : x.size - last_lag][:, ::-1]


def _line_regressors(u: Floats) -> list[Floats]:
    """Return cosines and sines at the spectral lines of an input, as regressors beside its lagged samples."""
    count = u.size
    transform_size = 1 << math.ceil(math.log2(8 * count))
    window, time, x = np.hanning(count - 1), np.arange(count), u - u.mean()
    columns: list[Floats] = []
    for _ in range(min(MAX_LINES, count // 60)):
        # Differences are used, because the slow part of a random walk would resemble a line.
        power = np.abs(np.fft.rfft(np.diff(x) * window, transform_size)) ** 2
        power[:16] = 0
        at = int(np.argmax(power))
        neighborhood = power[max(0, at - LINE_NEIGHBORS) : at + LINE_NEIGHBORS + 1]
        if power[at] <= 0 or power[at] < LINE_RATIO * np.median(neighborhood):
            break
        peak = float(at)
        if 0 < at < power.size - 1:
            low, center, high = np.log(power[at - 1 : at + 2] + 1e-300).tolist()
            curvature = low - 2 * center + high
            peak += 0.5 * (low - high) / curvature if curvature else 0.0
        omega = 2 * math.pi * peak / transform_size
        columns += [np.cos(omega * time), np.sin(omega * time)]
        basis = np.column_stack([np.ones(count), *columns])
        x = _project_out(basis, u)
    return columns


def _ridge_gram(weighted: Floats, regressors: Floats) -> Floats:
    """Return the normal matrix ``weighted.T @ regressors`` of a weighted regression, plus a small ridge."""
    gram: Floats = weighted.T @ regressors
    gram[np.diag_indices_from(gram)] += RIDGE_FRACTION * np.trace(gram) / len(gram)
    return gram


def _project_out(regressors: Floats, targets: Floats, weights: Floats | None = None) -> Floats:
    """Return the residuals of a weighted ridge regression of `targets` on the columns of `regressors`.

    The ridge is small, and one refinement step corrects it.
    """
    weighted = regressors if weights is None else regressors * weights[:, None]
    gram = _ridge_gram(weighted, regressors)
    factor = np.linalg.cholesky(gram)
    for _ in range(2):
        targets = targets - regressors @ np.linalg.solve(factor.T, np.linalg.solve(factor, weighted.T @ targets))
    return targets


def _score_ratio(innovation: Floats, columns: Floats) -> float:
    """Return the self-normalized score statistic of an innovation and regressors, divided by its critical value."""
    score = columns.T @ innovation
    products = columns * innovation[:, None]
    score_covariance = products.T @ products
    score_covariance[np.diag_indices_from(score_covariance)] += (
        1e-9 * np.trace(score_covariance) / len(score_covariance)
    )
    limit = chi_squared(columns.shape[1], FEEDBACK_LEVEL / (2 + len(INNOVATION_COUNTS)))
    return float(score @ np.linalg.solve(score_covariance, score)) / limit


def _largest_score_ratio(innovation: Floats, columns: Floats) -> tuple[float, Floats]:
    """Return the largest :func:`_score_ratio` over sets of regressors, and the normalized columns of the set."""
    norms = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(norms > 0, norms, 1.0)
    sets = [columns[:, :1], columns[:, :3], *(columns[:, 3 : 3 + k] for k in INNOVATION_COUNTS)]
    ratios = [_score_ratio(innovation, columns_of_set) for columns_of_set in sets]
    best_index = int(np.argmax(ratios))
    return ratios[best_index], sets[best_index]


def _local_autocorrelation(w: Floats) -> float:
    """Return the mean squared autocorrelation over short blocks, divided by the upper limit for white noise."""
    count = w.size // LOCAL_ROWS
    if count < 4:
        return 0.0
    x = w[: count * LOCAL_ROWS].reshape(count, LOCAL_ROWS)
    power = np.sum(x * x, axis=1)
    power = np.where(power > 0, power, np.inf)
    r = np.array([np.sum(x[:, k:] * x[:, :-k], axis=1) / power for k in range(1, LOCAL_LAGS + 1)])
    return float(np.mean(LOCAL_ROWS * r * r)) / (1 + max(0.5, 4 * math.sqrt(2 / (LOCAL_LAGS * count))))


def _local_explained_fraction(w: Floats, regressors: Floats) -> float:
    """Return the mean fraction of `w` that `regressors` explain in short blocks, divided by its limit by chance."""
    count = w.size // LOCAL_ROWS
    if count < 1:
        return 0.0
    x = regressors[: count * LOCAL_ROWS].reshape(count, LOCAL_ROWS, -1)
    x = x - x.mean(axis=1, keepdims=True)
    y = w[: count * LOCAL_ROWS].reshape(count, LOCAL_ROWS, 1)
    y = y - y.mean(axis=1, keepdims=True)
    u, singular_values, _ = np.linalg.svd(x, full_matrices=False)
    projection = np.where(
        singular_values[:, :, None] > 1e-9 * singular_values[:, :1, None], u.transpose(0, 2, 1) @ y, 0.0
    )
    power = np.sum(y * y, axis=(1, 2))
    fractions = np.sum(projection * projection, axis=(1, 2)) / np.where(power > 0, power, np.inf)
    return float(np.mean(LOCAL_ROWS * fractions / x.shape[2])) / (1 + 3.5 / math.sqrt(count))


class _Innovations:
    """Innovations of an input and of an output over several runs, with the feedback test on them."""

    def __init__(
        self, residuals: list[Floats], input_values: list[Floats], other_inputs: list[list[Floats]], *, shift: int
    ) -> None:
        shortest = min(u.size for u in input_values)
        self.shift = shift
        self.input_lags = min(MAX_INPUT_LAGS, shortest // 10)
        output_lags = min(MAX_OUTPUT_LAGS, shortest // 14)
        self.start = max(self.input_lags, output_lags)
        deviation = math.sqrt(float(np.mean(np.concatenate([(u - u.mean()) ** 2 for u in input_values]))))
        self.deviation = deviation
        inputs = [(u - u.mean()) / deviation for u in input_values]
        outputs = self._clip_outliers(residuals)
        lengths = [u.size - self.start for u in input_values]
        stops = np.cumsum(lengths).tolist()
        #: (start, stop) of each run in the stacked rows.
        self.row_ranges = [(stop - length, stop) for stop, length in zip(stops, lengths, strict=True)]
        input_lags_of_runs = [np.concatenate([_lags(u, 1, self.input_lags, self.start) for u in inputs])]
        other_lags = []
        for other_input in other_inputs:
            other_deviation = math.sqrt(float(np.mean(np.concatenate([(v - v.mean()) ** 2 for v in other_input]))))
            if other_deviation > 0:
                lag_count = min(self.input_lags, MAX_OTHER_LAGS)
                other_lags.append(
                    np.concatenate(
                        [_lags((v - v.mean()) / other_deviation, 0, lag_count, self.start) for v in other_input]
                    )
                )
        lines = [[np.ones(u.size), *_line_regressors(u)] for u in inputs]
        self.past = np.column_stack([*input_lags_of_runs, *other_lags, *self._block_diagonal(lines)])
        self.inputs = self._stack_rows(inputs)
        self.weights = np.ones(self.inputs.size)
        w = _project_out(self.past, self.inputs)
        for _ in range(ROBUST_ITERATIONS):
            limit = ROBUST_SIGMAS * max(robust_deviation(w), 1e-14)
            self.weights = np.minimum(1.0, limit / np.maximum(np.abs(w), 1e-300))
            w = _project_out(self.past, self.inputs, self.weights)
        self.innovation, self.scale = w, robust_deviation(w)
        levels = self._block_diagonal([[np.ones(u.size)] for u in inputs])
        output_lags_of_runs = [np.concatenate([_lags(e, 1, output_lags, self.start) for e in outputs])]
        present_input_lags = [np.concatenate([_lags(u, 0, output_lags, self.start) for u in inputs])]
        self.residuals = self._stack_rows(outputs)
        projected = _project_out(
            np.column_stack([*output_lags_of_runs, *present_input_lags, *other_lags, *levels]), self.residuals
        )
        past_input_lags = [columns[:, 1:] for columns in present_input_lags]
        self.same_row_output = _project_out(
            np.column_stack([*output_lags_of_runs, *past_input_lags, *other_lags, *levels]), self.residuals
        )
        self.noise = robust_deviation(projected)
        self.output_innovation = np.clip(projected / max(self.noise, 1e-300), -OUTPUT_CLIP, OUTPUT_CLIP)
        memory = SLOW_FORGETTING * (1 - SLOW_FORGETTING) ** np.arange(SLOW_MEMORY_ROWS)
        self.slow_regressors = self._stack_rows([np.convolve(e, memory)[: e.size] for e in outputs])

    def _clip_outliers(self, residuals: list[Floats]) -> list[Floats]:
        """Return residuals, centered and divided by their standard deviation, with far outliers clipped.

        Outliers only reduce the power of the test.
        """
        pooled = np.concatenate([e - e.mean() for e in residuals])
        deviation = float(np.std(pooled)) or 1.0
        median_value = float(np.median(pooled)) / deviation
        clip_width = RESIDUAL_CLIP * max(robust_deviation(pooled / deviation - median_value), 1e-12)
        return [
            np.clip((e - e.mean()) / deviation, median_value - clip_width, median_value + clip_width) for e in residuals
        ]

    def _stack_rows(self, series: Sequence[Floats]) -> Floats:
        return np.concatenate([x[self.start :] for x in series])

    def _block_diagonal(self, columns: Sequence[Sequence[Floats]]) -> list[Floats]:
        """Return columns that are nonzero in one run each, so that every run has its own coefficients."""
        out = []
        for (start, stop), block in zip(self.row_ranges, columns, strict=True):
            for column in block:
                padded_column = np.zeros(self.row_ranges[-1][1])
                padded_column[start:stop] = column[self.start :]
                out.append(padded_column)
        return out

    def _rows(self, offset: int) -> NDArray[np.intp]:
        """Return the indices of the stacked rows whose regressors, delayed by `offset` more samples, lie in one run."""
        skip = max(INNOVATION_COUNTS) + 2 + offset
        return np.concatenate([np.arange(min(start + skip, stop), stop) for start, stop in self.row_ranges])

    def _regressors(self, rows: NDArray[np.intp], offset: int) -> Floats:
        """Return the regressors at `rows`: past residuals, their differences, their low-pass part, and innovations."""
        lag = self.shift + offset
        back: Callable[[Floats, int], Floats] = lambda x, k: x[rows - k - offset]  # noqa: E731
        innovations = [back(self.output_innovation, k + self.shift) for k in range(max(INNOVATION_COUNTS))]
        current = self.residuals[rows - lag]
        return np.column_stack(
            [current, current - self.residuals[rows - lag - 1], self.slow_regressors[rows - lag], *innovations]
        )

    def _ratio(self, offset: int, clipped: Floats) -> tuple[float, Floats, NDArray[np.intp]]:
        """Return the largest ratio of a score statistic to its critical value, with its regressors and rows.

        `offset` is an additional delay of the outputs in samples.
        """
        rows = self._rows(offset)
        # The same weights make the score orthogonal to the estimated parameters.
        columns = _project_out(self.past[rows], self._regressors(rows, offset), self.weights[rows])
        return *_largest_score_ratio(clipped[rows], columns), rows

    def test(self) -> FeedbackTest:
        """Return the result of the feedback test, after checks that the innovation is suitable."""
        count = self.inputs.size
        clipped = np.clip(self.innovation / max(self.scale, 1e-300), -INPUT_CLIP, INPUT_CLIP)
        clipped = clipped - clipped.mean()
        if robust_deviation(self.same_row_output) < QUIET_FRACTION:
            return FeedbackTest("none", "the output has no noise that could come back", samples=count)
        signed = self._same_sample_ratio(clipped)
        same_row_ratio = abs(signed)
        same_row_text = (
            f"it is correlated with the output of the same row (ratio {same_row_ratio:.2g}): a controller, or a "
            "feedthrough"
        )
        if self.scale < PREDICTED_FRACTION or self.noise < QUIET_FRACTION:
            if same_row_ratio > 1:
                return FeedbackTest("undecided", same_row_text, samples=count, same_sample_correlation=signed)
            return FeedbackTest("command", f"its own past determines it to {self.scale:.1e}", samples=count)
        ratio, columns, rows = self._ratio(0, clipped)
        target = clipped[rows]
        fit = columns @ minimum_norm_solution(columns, target, 1e-12)
        power_fraction = float(1 - np.sum((target - fit) ** 2) / np.sum(target**2))

        def result(state: FeedbackState, reason: str = "") -> FeedbackTest:
            response = self._response(columns, rows) if state == "found" else ()
            return FeedbackTest(
                state, reason, ratio, power_fraction, count, same_sample_correlation=signed, response=response
            )

        # Without feedback, past outputs cannot explain most of the innovation of a rough input.
        if power_fraction >= CERTAIN_FRACTION and self.scale >= ROUGH_FRACTION and ratio >= CERTAIN_RATIO:
            return result("found")
        objection = ""
        if _local_autocorrelation(clipped) > 1:
            objection = "its innovations are not white"
        elif _local_explained_fraction(clipped, self.past[:, :2]) > 1:
            objection = "its innovations depend on its past in parts of the run, as those of a sweep"
        if objection and ratio <= PLACEBO_RATIO_IN_DOUBT:
            return result("undecided", objection)
        if ratio <= 1 or count * power_fraction * self.scale**2 < MIN_FEEDBACK_POWER:
            if same_row_ratio > 1:
                return result("undecided", same_row_text)
            return result("none", "" if ratio <= 1 else "too little to matter")
        if self._ratio_with_noisy_input(rows) <= 1:
            return result("undecided", "a closed loop, or noise in the measured input")
        # A loop acts during the whole run. Independent signals are correlated by chance on one part only.
        gains = np.array([gain_part.sum() for gain_part in np.array_split(fit * target, STEADY_PARTS)])
        if np.median(gains) < STEADY_FRACTION * max(float(gains.sum()), 1e-300):
            return result("undecided", "only one part of the run shows it")
        min_lag = max(INNOVATION_COUNTS) + self.input_lags
        max_lag = min(stop - start for start, stop in self.row_ranges) // 3
        placebo_lags = (
            np.unique(np.linspace(min_lag, max_lag, PLACEBO_COUNT).astype(int)).tolist() if max_lag > min_lag else []
        )
        placebo = max((self._ratio(k, clipped)[0] for k in placebo_lags), default=1.0)
        if ratio < (PLACEBO_RATIO_IN_DOUBT * max(placebo, 1.0) if objection else PLACEBO_RATIO * placebo):
            return result("undecided", objection or f"outputs far in the past explain as much (ratio {placebo:.2g})")
        return result("found")

    def _same_sample_ratio(self, clipped: Floats) -> float:
        """Return the signed score statistic of the output innovation in the same sample, divided by its critical value.

        This statistic detects integral control, under which the past input already contains the past outputs. These
        outputs therefore do not improve the prediction of the input.
        """
        deviation = max(robust_deviation(self.same_row_output), 1e-300)
        clipped_output = np.clip(self.same_row_output / deviation, -OUTPUT_CLIP, OUTPUT_CLIP)
        column = _project_out(self.past, clipped_output[:, None], self.weights)
        ratio = _score_ratio(clipped, column / max(float(np.linalg.norm(column)), 1e-300))
        return math.copysign(ratio, float(clipped @ column[:, 0]))

    def _ratio_with_noisy_input(self, rows: NDArray[np.intp]) -> float:
        """Return the least ratio of the score statistic to its critical value over assumed noise levels of the input.

        For each noise level, the normal matrix of the regression is corrected for the noise. If the input is noisy, the
        past output contains information on the true past input that the measured input lacks. This can look like
        feedback.
        """
        regressors, y = self.past[rows], self.inputs[rows]
        weighted = regressors * self.weights[rows][:, None]
        gram = weighted.T @ regressors
        ridge = 1e-12 * float(np.trace(gram))
        input_indices, other_indices = np.arange(self.input_lags), np.arange(self.input_lags, regressors.shape[1])
        cross, other_gram = (
            gram[np.ix_(input_indices, other_indices)],
            gram[np.ix_(other_indices, other_indices)] + ridge * np.eye(other_indices.size),
        )
        partial_gram = gram[np.ix_(input_indices, input_indices)] - cross @ np.linalg.solve(other_gram, cross.T)
        largest_noise = max(float(np.linalg.eigvalsh(partial_gram)[0]), 0.0)
        columns = self._regressors(rows, 0)
        at, from_columns = weighted.T @ y, weighted.T @ columns
        lowest_ratio = math.inf
        for fraction in INPUT_NOISE_FRACTIONS:
            reduced_gram = gram + ridge * np.eye(len(gram))
            reduced_gram[input_indices, input_indices] -= fraction * largest_noise
            inverse = np.linalg.inv(reduced_gram)
            w = y - regressors @ (inverse @ at)
            w = np.clip(w / max(robust_deviation(w), 1e-300), -INPUT_CLIP, INPUT_CLIP)
            w = w - w.mean()
            remainder = columns - regressors @ (inverse @ from_columns)
            lowest_ratio = min(lowest_ratio, _largest_score_ratio(w, remainder)[0])
        return lowest_ratio

    def _response(self, columns: Floats, rows: NDArray[np.intp]) -> tuple[Floats, ...]:
        """Return the part of the input that the feedback explains, one array per run.

        The explained innovations pass through the autoregression of the input on its own past. The part of the input
        that is correlated with the residual of the same sample also counts as feedback.
        """
        projected = _project_out(self.past[rows], self.residuals[rows, None], self.weights[rows])
        columns = np.column_stack([columns, projected / max(float(np.linalg.norm(projected)), 1e-300)])
        innovations = np.zeros(self.inputs.size)
        innovations[rows] = columns @ minimum_norm_solution(columns, self.innovation[rows], 1e-12)
        weighted = self.past * self.weights[:, None]
        law = np.linalg.solve(_ridge_gram(weighted, self.past), weighted.T @ self.inputs)[: self.input_lags]
        out = []
        for start, stop in self.row_ranges:
            x = np.concatenate([np.zeros(self.start), innovations[start:stop]])
            divisor = np.zeros(x.size)
            divisor[0] = 1.0
            divisor[1 : 1 + law.size] = -law[: x.size - 1]
            filtered = _core.series_divide(x, divisor)
            # An unstable filter would make the result larger than the input.
            deviation = float(np.std(filtered)) if np.all(np.isfinite(filtered)) else math.inf
            out.append(self.deviation * (filtered if deviation <= 1.0 else x))
        return tuple(out)
