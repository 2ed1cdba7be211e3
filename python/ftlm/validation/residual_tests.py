"""Residual tests: whiteness, independence from the inputs, and feedback."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import NormalDist
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from ftlm import _core
from ftlm.data.run import Run
from ftlm.data.runs import Runs, as_runs
from ftlm.data.sampling import interpolate_gaps
from ftlm.errors import DataError
from ftlm.findings import Finding, make_finding, texts
from ftlm.model.model import Model, check_model
from ftlm.simulation.discretization import compared_values
from ftlm.simulation.output_samples import OutputSamples, measured_samples
from ftlm.svg.html_page import Table
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import Cell, attributes, json_value, plural, symbol_html
from ftlm.utils.linalg import dot, minimum_norm_solution
from ftlm.utils.statistics import (
    NORMAL_99,
    SIGNIFICANCE_LEVEL,
    autocorrelations,
    chi_squared_99,
    is_constant,
    portmanteau,
    whiten_series,
)
from ftlm.utils.validation import Floats, check_integer
from ftlm.validation.comparison import simulate_runs
from ftlm.validation.feedback import FeedbackTest, feedback_test

#: Difference below which two orders count as equal.
ORDER_TOLERANCE = 1e-9
#: Ratio of residual RMS to the output's standard deviation below which discretization or quantization
#: explains the residuals.
NEGLIGIBLE_RESIDUAL_RATIO = 1e-3
#: Simulated velocity, relative to the largest one, below which an output counts as at rest.
MAX_REST_VELOCITY_RATIO = 0.01
#: Product of slope s and largest velocity in tanh(s v), which replaces the sign of a measured velocity v.
SIGN_TANH_SLOPE = 100.0
#: Minimum peak velocity against the main direction, relative to the peak in the main direction, for a reversal.
MIN_REVERSAL_RATIO = 0.01
#: Singular value of a sensitivity matrix, relative to the largest one, below which it counts as a rounding error.
SENSITIVITY_RANK_TOLERANCE = 1e-10


@dataclass(frozen=True)
class CorrelationTest:
    """Auto- or cross-correlations of residuals, with a test of their significance.

    Parameters
    ----------
    lags
        Lags in samples. At a lag k > 0, the residual is k samples later than the other signal.
    values
        Correlation at each lag.
    band
        Half-width of the 99 % confidence band of a single correlation.
    statistic, limit
        Test statistic and its 99 % limit for a true model. The statistic for whiteness is the sum of normalized squared
        autocorrelations over all positive lags; see :func:`ftlm.resid`. For independence it is the largest absolute
        correlation at lags >= 0, and the limit is a simultaneous band for all these lags.
    passed
        Whether the test is conclusive and the statistic within its limit; False if the residuals are not finite.
    conclusive
        Whether the test can fail at all. It cannot if the limit of a correlation exceeds 1 or the input is constant.
        The test then neither passes nor fails.
    first_lag
        Smallest tested lag of an independence test: 1 if only the correlation at lag 0 exceeds the limit, otherwise 0.
    """

    lags: NDArray[np.int64]
    values: Floats
    band: float
    statistic: float
    limit: float
    passed: bool
    conclusive: bool = True
    first_lag: int = 0

    @property
    def failed(self) -> bool:
        """Whether the test is conclusive and not passed."""
        return self.conclusive and not self.passed

    @property
    def verdict(self) -> str:
        """Conclusion as text: ``"passed"``, ``"failed"`` or ``"undecided"``."""
        return "undecided" if not self.conclusive else "passed" if self.passed else "failed"

    @property
    def outside_count(self) -> int:
        """Number of correlations outside the band, without lag 0 of an autocorrelation; 1 % are expected."""
        return int(np.sum((np.abs(self.values) > self.band) & (self.values != 1.0)))

    @property
    def largest_correlation(self) -> tuple[int, float]:
        """Lag and value of the largest correlation among the tested lags."""
        magnitudes = np.where((self.lags >= self.first_lag) & (self.values != 1.0), np.abs(self.values), -1.0)
        at = int(np.argmax(magnitudes))
        return int(self.lags[at]), float(self.values[at])

    def to_dict(self) -> dict[str, Any]:
        """Return the test as a dictionary for JSON."""
        rows = {"lags": self.lags.tolist(), "values": json_value(self.values.tolist())}
        return rows | attributes(self, ("band", "statistic", "limit", "passed", "conclusive"))


@dataclass(frozen=True)
class OutputResiduals:
    """Residuals of one output over all runs, with the tests on them.

    Parameters
    ----------
    residuals
        Measured minus simulated samples in SI units, one array per run, without the first and last sample of the run.
        NaN at missing samples.
    rms
        Root mean square of the residuals over all runs, in SI units.
    nr
        ``rms`` divided by the standard deviation of the output.
    whiteness
        Test of the autocorrelations.
    inputs
        Tests of the cross-correlations with each input, by name. Both signals are filtered by the whitening filter of
        the residuals.
    feedback_tests
        Feedback test of each input of the equation, by name.
    direction
        Test of the cross-correlations with the sign of the simulated velocity; None for equations with friction.
    sign_slope
        Slope s of the friction term tanh(s y) that `direction` tests; infinite for the term sign(D y).
    """

    residuals: list[Floats]
    rms: float
    nr: float
    whiteness: CorrelationTest
    inputs: dict[str, CorrelationTest]
    feedback_tests: dict[str, FeedbackTest] = field(default_factory=dict)
    direction: CorrelationTest | None = None
    sign_slope: float = math.inf

    @property
    def follows_direction(self) -> bool:
        """Whether residuals depend on the direction of motion but not on an input, and no feedback was found."""
        return self.direction is not None and self.direction.failed and self.is_noise and not self.feedback

    @property
    def feedback(self) -> tuple[str, ...]:
        """Inputs that depend on past values of this output, as in a closed loop."""
        return tuple(name for name, test in self.feedback_tests.items() if test.has_feedback)

    @property
    def is_correlated(self) -> bool:
        """Whether the residuals are finite, and correlated with an input or the direction of motion."""
        tests = [*self.inputs.values(), *([self.direction] if self.direction else [])]
        return math.isfinite(self.rms) and any(t.failed for t in tests)

    @property
    def is_noise(self) -> bool:
        """Whether the residuals pass the test of independence from every input that varies."""
        return all(test.passed for test in self.informative_tests.values())

    @property
    def is_undecided(self) -> bool:
        """Whether no test of independence is conclusive, such as for a constant input or a short run."""
        return not any(test.conclusive for test in self.inputs.values())

    @property
    def informative_tests(self) -> dict[str, CorrelationTest]:
        """Tests of the inputs that vary, or of all inputs if none does."""
        return {n: t for n, t in self.inputs.items() if t.conclusive or not math.isnan(t.limit)} or self.inputs

    def to_dict(self) -> dict[str, Any]:
        """Return residual statistics and tests as a dictionary for JSON."""
        tests = attributes(self, ("rms", "nr", "whiteness", "inputs", "feedback"))
        return tests | {"loops": json_value(self.feedback_tests)}


@dataclass(frozen=True)
class Residuals:
    """Results of the residual tests of a model on some runs.

    Parameters
    ----------
    outputs
        Residuals and tests by output.
    runs
        Names of the runs.
    step
        Sampling step of each run [s].
    refinement
        Number of block pulses per sampling interval in the simulation.
    initial_terms
        Number of initial terms that were fitted to these runs.
    """

    outputs: dict[str, OutputResiduals]
    runs: tuple[str, ...]
    step: tuple[float, ...]
    refinement: int
    initial_terms: int

    @property
    def white(self) -> dict[str, bool]:
        """Result of the whiteness test by output; True if the residuals may be white noise."""
        return {name: output.whiteness.passed for name, output in self.outputs.items()}

    @property
    def independent(self) -> dict[str, bool]:
        """Result of the independence test by output; True if the residuals are uncorrelated with the inputs.

        Inputs at the same and at earlier samples are tested. False if the test is inconclusive.
        """
        return {name: all(t.passed for t in output.informative_tests.values()) for name, output in self.outputs.items()}

    @property
    def tests(self) -> list[tuple[str, str, CorrelationTest]]:
        """All tests as (output, input, test); the input is empty for a whiteness test."""
        return [
            (name, signal, test)
            for name, output in self.outputs.items()
            for signal, test in [("", output.whiteness), *output.inputs.items()]
        ]

    @property
    def independence(self) -> dict[str, str]:
        """Result of the independence test by output as text: ``"yes"``, ``"no"`` or ``"undecided"``."""
        return {
            name: "no" if any(t.failed for t in output.inputs.values()) else "yes" if is_independent else "undecided"
            for (name, output), is_independent in zip(self.outputs.items(), self.independent.values(), strict=True)
        }

    @property
    def _informative_tests(self) -> list[CorrelationTest]:
        return [t for output in self.outputs.values() for t in (output.whiteness, *output.informative_tests.values())]

    @property
    def passed(self) -> bool:
        """Whether the residuals of all outputs pass both tests.

        False if a test is inconclusive, except for constant inputs.
        """
        return all(test.passed for test in self._informative_tests)

    @property
    def conclusive(self) -> bool:
        """Whether at least one test has failed, or all tests are conclusive. Tests of constant inputs do not count."""
        return any(test.failed for test in self._informative_tests) or all(
            test.conclusive for test in self._informative_tests
        )

    @property
    def verdict(self) -> str:
        """Conclusion as text: ``"passed"``, ``"FAILED"`` if one test has failed, or ``"undecided"``."""
        return "passed" if self.passed else "FAILED" if self.conclusive else "undecided"

    def to_dict(self) -> dict[str, Any]:
        """Return the results as a dictionary for JSON."""
        return attributes(self, ("passed", "conclusive", "runs", "refinement", "outputs"))

    def __str__(self) -> str:
        tests = [(f"{output} and {signal}" if signal else f"{output} alone", t) for output, signal, t in self.tests]
        width = max(len(label) for label, _ in tests) + 2
        lines = [
            f"residual tests at 99 % on {', '.join(self.runs)}: {self.verdict}",
            f"{'correlation of':<{width}}{'largest':>10}{'at lag':>8}{'band':>10}{'statistic':>12}{'limit':>10}",
        ]
        for label, test in tests:
            lag, value = test.largest_correlation
            lines.append(
                f"{label:<{width}}{value:>10.3g}{lag:>8}{test.band:>10.3g}{test.statistic:>12.4g}{test.limit:>10.4g}"
                f"   {test.verdict}"
            )
        lines += texts(failed_tests(self))
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return str(residual_table(self, title=f"Residual tests: {', '.join(self.runs)}").to_html())


#: Maximum lag [samples] of the residual tests after every identification; the usual convention.
DEFAULT_LAGS = 25


@check_arguments
def resid(model: Model, runs: Run | Sequence[Run], *, lags: int = DEFAULT_LAGS) -> Residuals:
    """Test whether the residuals of a simulation are white and independent of the inputs.

    Residuals are measured minus simulated samples. Initial terms and offsets are fitted to each run, and the time step
    is refined until converged. The mean of each run is subtracted before the runs are pooled.

    Parameters
    ----------
    model
        The model.
    runs
        One run or several with the same names and units, each of at least ``2 * lags + 3`` rows.
    lags
        Maximum lag in samples; 25 by default, as in Ljung's book.

    Returns
    -------
    Residuals
        Test results, which print as a table. ``passed`` is True if both tests pass.

    Raises
    ------
    DataError
        If runs lack a signal of the model or are too short for these lags.
    ModelError
        If the number of lags is invalid, or an equation cannot be solved for its output.

    Notes
    -----
    Whiteness: the statistic is the sum over all lags k of (Σ eₜ eₜ₋ₖ)² / Σ (eₜ eₜ₋ₖ)², and its limit is the 99 %
    quantile of χ² (Lobato, Nankervis and Savin, doi:10.1111/1468-2354.00106). The variance of the noise may change
    within a run. The 99 % band of one autocorrelation of white noise is ±2.576/√N.

    Independence: residuals and input are filtered by the whitening filter of the residuals, an autoregression whose
    order minimizes BIC. Without this filter, chance correlations of two slow signals hide a missing dead time (Box and
    Jenkins, chapter 11). The statistic is the largest correlation at lags >= 0, and its limit is the simultaneous 99 %
    band of all of them (Šidák). The variance of one correlation of independent signals is Bartlett's Σρₑ(τ)ρᵤ(τ)/N
    (doi:10.2307/2983611), but at least that for white residuals. It is also at least the mean of Σ eₜ² uₜ₋ₖ² over all
    lags, which permits noise that grows with the input. If the model has no feedthrough and only lag 0 is outside the
    band, feedback or feedthrough within one sample explains it, and only the other lags are tested.

    A test with a limit above 1 or with a constant input is inconclusive. The feedback test is described at
    :class:`ftlm.FeedbackTest`.
    """
    check_model(model)
    run_list = as_runs(runs)
    count = check_integer("lags", lags, 1)
    check_run_lengths(run_list, count)
    for run in run_list:
        run.require_outputs([o for o in model.outputs if o in run])
    return run_residual_tests(model, run_list, simulate_runs(model, run_list), lags=count)


def check_run_lengths(runs: Runs, lags: int) -> None:
    """Raise DataError if a run is too short for these lags."""
    for run in runs:
        if run.length < 2 * lags + 3:
            raise DataError(
                f"run {run.name!r} has {plural(run.length, 'row')}, correlations up to {lags} lags need "
                f"{2 * lags + 3}; "
                "give a longer run or fewer lags"
            )


def run_residual_tests(
    model: Model,
    runs: Runs,
    simulations: Sequence[OutputSamples],
    *,
    lags: int,
    sensitivities: Callable[[], Mapping[str, list[Floats]]] | None = None,
) -> Residuals:
    """Run whiteness, independence and feedback tests on the residuals of runs, given their `simulations`.

    The first and last sample of each run are omitted. ``sensitivities`` is a function that returns, by output, the
    sensitivities to the fitted parameters, one array per run with shape (parameters, samples). It is called only if
    residuals are correlated with an input or with the direction of motion. Raise DataError if a run is too
    short for these lags.
    """
    check_run_lengths(runs, lags)
    residuals: dict[str, list[Floats]] = {o: [] for o in model.outputs}
    for run, sampled in zip(runs, simulations, strict=True):
        with np.errstate(invalid="ignore"):
            residuals_by_output = measured_samples(model, run, sampled.refinement) - sampled.outputs
        for name, series in zip(model.outputs, residuals_by_output, strict=True):
            residuals[name].append(np.ascontiguousarray(series[1:-1]))
    input_names = [s for s in model.structure.signals if s not in model.outputs and s in runs[0]]
    inputs = list(dict.fromkeys([*runs[0].inputs, *input_names]))
    signals = {
        n: [np.ascontiguousarray(interpolate_gaps(compared_values(run, model.structure, n))[1:-1]) for run in runs]
        for n in inputs
    }
    outputs = {}
    for equation in model.equations:
        name = equation.output
        measurements = [compared_values(run, model.structure, name) for run in runs]
        deviation = math.sqrt(float(np.mean([np.nanvar(y) for y in measurements])))
        gaps = [np.isnan(y[1:-1]) for y in measurements]
        direct = {
            s
            for t in equation.terms
            for s in t.signals
            if t.order.constant >= equation.order.constant - ORDER_TOLERANCE
        }
        commands = {s: s in direct for s in equation.signals if s in runs[0].inputs}
        outputs[name] = _test_output(residuals[name], gaps, signals, lags, deviation, commands, runs[0].inputs)
        signs: list[Floats] = []
        if equation.friction is None and model.structure.is_linear and math.isfinite(outputs[name].rms):
            row = model.outputs.index(name)
            motion = [
                np.gradient(f.outputs[row]) if equation.order.constant > 1.0 else f.outputs[row] for f in simulations
            ]
            signs = _signs_of_motion(motion)
            slope = math.inf if equation.order.constant > 1.0 else sign_tanh_slope(motion)
            outputs[name] = _test_direction(outputs[name], signs, lags, slope)
        if sensitivities is not None and outputs[name].is_correlated:
            output_sensitivities = sensitivities().get(name, [])
            outputs[name] = _test_beyond_parameters(outputs[name], output_sensitivities, signals, signs, lags)
    step_sizes, terms = tuple(run.step for run in runs), sum(len(t) for s in simulations for t in s.initial.values())
    return Residuals(
        outputs, tuple(run.name for run in runs), step_sizes, max(s.refinement for s in simulations), terms
    )


def _test_output(
    series: list[Floats],
    gaps: list[NDArray[np.bool_]],
    signals: Mapping[str, list[Floats]],
    lags: int,
    deviation: float,
    commands: Mapping[str, bool],
    run_inputs: Sequence[str],
) -> OutputResiduals:
    """Run the whiteness, independence and feedback tests of one output; they fail if a residual is not finite.

    ``series`` are the residuals and ``gaps`` the masks of missing samples, one array per run. ``signals`` are the
    tested inputs by name, ``run_inputs`` the names of the inputs of the runs, and ``deviation`` is the standard
    deviation of the output. ``commands`` states for each input of the equation whether the model has direct feedthrough
    from it.
    """
    pooled = np.concatenate([e[~gap] for e, gap in zip(series, gaps, strict=True)])
    with np.errstate(over="ignore", invalid="ignore"):
        rms = float(np.sqrt(np.mean(pooled**2)))
    nr = rms / deviation if deviation > 0 else math.inf
    if not math.isfinite(rms):
        failure, across = _failed_test(np.arange(lags + 1)), _failed_test(np.arange(-lags, lags + 1))
        return OutputResiduals(series, math.inf, math.inf, failure, dict.fromkeys(signals, across))
    series = [np.where(gap, np.nan, e) for e, gap in zip(series, gaps, strict=True)]
    white_test = _whiteness(series, pooled.size, lags)
    varying_inputs = {n: signals[n] for n in run_inputs if not is_constant(signals[n])}
    loops = {
        name: feedback_test(series, varying_inputs[name], [v for n, v in varying_inputs.items() if n != name])
        for name in commands
        if name in varying_inputs
    }
    inputs = {}
    for name, values in signals.items():
        noise = NoiseModel.fit(series, values, lags)
        inputs[name] = _independence(series, values, noise, lags, first_lag=0)
        if inputs[name].failed and not commands.get(name, True):
            # A correlation at lag 0 alone is feedback or feedthrough within the sample, not missing dynamics.
            delayed_test = _independence(series, values, noise, lags, first_lag=1)
            inputs[name] = delayed_test if delayed_test.passed else inputs[name]
    return OutputResiduals(series, rms, nr, white_test, inputs, loops)


def _signs_of_motion(velocities: Sequence[Floats]) -> list[Floats]:
    """Return the sign of the velocity at each inner sample, 0 at rest, one array per run; [] if nothing moves."""
    largest = max(float(np.max(np.abs(v))) for v in velocities)
    if not 0.0 < largest < math.inf:
        return []
    return [np.where(np.abs(v) > MAX_REST_VELOCITY_RATIO * largest, np.sign(v), 0.0)[1:-1] for v in velocities]


def _test_direction(output: OutputResiduals, signs: list[Floats], lags: int, slope: float) -> OutputResiduals:
    """Return the residuals of an output with a test of their dependence on the sign of a simulated velocity.

    Missing dry friction causes such a dependence.
    """
    if not signs:
        return output
    test = _independence(output.residuals, signs, NoiseModel.fit(output.residuals, signs, lags), lags, first_lag=0)
    return replace(output, direction=test, sign_slope=slope)


def _test_beyond_parameters(
    output: OutputResiduals,
    sensitivities: Sequence[Floats],
    signals: Mapping[str, list[Floats]],
    signs: list[Floats],
    lags: int,
) -> OutputResiduals:
    """Return the residuals of an output, with failed tests replaced by passed ones if parameter errors explain them.

    ``signs`` are the signs of the velocity. Errors of the parameters correlate the residuals on validation data with an
    input or with the direction of motion. They also do so on estimation data, because least squares ignores the color
    of the noise. One generalized least-squares step removes the part of the residuals that these errors explain.
    """

    def repeat(test: CorrelationTest, signal: list[Floats]) -> CorrelationTest:
        noise = NoiseModel.fit(output.residuals, signal, lags)
        residuals = noise.subtract(output.residuals, sensitivities)
        repeated_test = _independence(residuals, signal, noise, lags, first_lag=test.first_lag)
        return repeated_test if repeated_test.passed else test

    inputs = {name: repeat(test, signals[name]) if test.failed else test for name, test in output.inputs.items()}
    direction = output.direction
    if direction is not None and direction.failed:
        direction = repeat(direction, signs)
    return replace(output, inputs=inputs, direction=direction)


def _failed_test(lags: NDArray[np.int64]) -> CorrelationTest:
    """Return a failed test without correlations, for residuals that are not finite."""
    return CorrelationTest(lags, np.full(lags.size, math.nan), math.nan, math.inf, math.nan, passed=False)


def _whiteness(series: list[Floats], count: int, lags: int) -> CorrelationTest:
    """Return the whiteness test of `count` residuals; the variance of the noise may change within a run."""
    limit = chi_squared_99(lags)
    correlations, statistic = autocorrelations(series, lags)[0], portmanteau(series, lags)
    band = NORMAL_99 / math.sqrt(count)
    return CorrelationTest(np.arange(lags + 1), correlations, band, statistic, limit, passed=statistic <= limit)


@dataclass(frozen=True)
class NoiseModel:
    """Autoregressive noise model of residuals from which the response to an input is removed.

    Parameters
    ----------
    filter
        Whitening filter: coefficients 1, a₁, …, aₙ.
    start
        Sample index of the first innovation.
    innovations
        Innovations of the noise, one array per run.
    inflation
        Factor that corrects the mean square of the innovations for the fitted coefficients: samples / (samples -
        coefficients).
    """

    filter: Floats
    start: int
    innovations: list[Floats]
    inflation: float

    @classmethod
    def fit(cls, series: list[Floats], signal: list[Floats], lags: int) -> NoiseModel:
        """Return the noise part of an ARX model of residuals and one input; of an AR model if ``signal`` is empty.

        An AR model of the residuals alone would also describe the response to a periodic or slow input, and the test of
        independence would not detect this response. Responses to other inputs count as noise.
        """
        through, start, innovations, parameters = _core.arx_model(series, [signal] if signal else [], lags)
        rows = sum(row.size for row in innovations)
        return cls(through, start, innovations, rows / max(rows - parameters, 1))

    def whiten(self, series: list[Floats]) -> list[Floats]:
        """Return series filtered by the whitening filter, starting at the sample of the first innovation."""
        padding = self.start - (self.filter.size - 1)
        return [np.ascontiguousarray(row[padding:]) for row in whiten_series(series, self.filter)]

    def subtract(self, series: list[Floats], directions: Sequence[Floats]) -> list[Floats]:
        """Return series minus their generalized least-squares projection onto directions.

        ``directions`` has one array per series, shape (directions, samples). If the numbers of samples differ, the
        series are returned unchanged.
        """
        if [rows.shape[1] for rows in directions] != [e.size for e in series]:
            return series
        directions_with_gaps = [np.where(np.isnan(e), np.nan, rows) for e, rows in zip(series, directions, strict=True)]
        columns = [np.concatenate(self.whiten(list(rows))) for rows in zip(*directions_with_gaps, strict=True)]
        if not columns:
            return series
        residuals = np.concatenate(self.whiten(series))
        amounts = minimum_norm_solution(np.stack(columns, axis=1), residuals, SENSITIVITY_RANK_TOLERANCE)
        return [e - amounts @ rows for e, rows in zip(series, directions, strict=True)]


def _independence(
    series: list[Floats], signal: list[Floats], noise: NoiseModel, lags: int, *, first_lag: int
) -> CorrelationTest:
    """Return the test of the cross-correlations at all lags >= ``first_lag`` against a simultaneous 99 % band."""
    all_lags = np.arange(-lags, lags + 1)
    if is_constant(signal):
        return CorrelationTest(
            all_lags, np.zeros(all_lags.size), math.nan, 0.0, math.nan, passed=False, conclusive=False
        )
    # Whitening the noise makes chance correlations with a slow input small.
    whitened, filtered_signal = noise.whiten(series), noise.whiten(signal)
    cross, _, _ = _core.correlation(whitened, filtered_signal, lags)
    _, variance, _ = _core.correlation(noise.innovations, filtered_signal, lags)
    # Noise that grows with the input widens the band, as colored noise does.
    variance = max(variance, _product_variance(noise.innovations, filtered_signal, lags))
    power, innovation_power = (sum(dot(row, row) for row in rows) for rows in (whitened, noise.innovations))
    variance_ratio = noise.inflation * innovation_power / power if power > 0.0 else 1.0
    standard_error = math.sqrt(variance * min(variance_ratio, noise.inflation))
    largest = float(np.max(np.abs(cross[lags + first_lag :])))
    limit = (
        NormalDist().inv_cdf(1 - (1 - (1 - SIGNIFICANCE_LEVEL) ** (1 / (lags + 1 - first_lag))) / 2) * standard_error
    )
    is_conclusive = limit < 1.0
    is_passed = is_conclusive and largest <= limit
    return CorrelationTest(
        all_lags, cross, NORMAL_99 * standard_error, largest, limit, is_passed, is_conclusive, first_lag
    )


def is_independent(series: list[Floats], signals: Sequence[list[Floats]]) -> bool:
    """Whether residuals (`series`, one array per run) are uncorrelated with all `signals` at the default delays.

    Also False if a run is too short for the test, or a signal is constant.
    """
    lags = DEFAULT_LAGS
    if min(e.size for e in series) < 2 * lags + 1:
        return False
    return all(_independence(series, s, NoiseModel.fit(series, s, lags), lags, first_lag=0).passed for s in signals)


def _product_variance(whitened: list[Floats], signal: list[Floats], lags: int) -> float:
    """Return the variance of a cross-correlation: the normalized mean product of the squared signals at lags >= 0."""
    powers = [(e * e, v * v) for e, v in zip(whitened, (v - v.mean() for v in signal), strict=True)]
    squared_means = sum(float(e.sum()) for e, _ in powers) * sum(float(v.sum()) for _, v in powers)
    products_by_lag = [sum(dot(e[k:], v[: e.size - k]) for e, v in powers if e.size > k) for k in range(lags + 1)]
    return float(np.mean(products_by_lag)) / squared_means if squared_means > 0 else 0.0


def sign_tanh_slope(velocities: Sequence[Floats]) -> float:
    """Return the slope s with which tanh(s v) replaces the sign of a measured velocity v.

    It is infinite if the velocity never changes sign.
    """
    low, high = (float(f([f(v) for v in velocities])) for f in (np.nanmin, np.nanmax))
    largest = max(-low, high)
    return SIGN_TANH_SLOPE / largest if min(-low, high) > MIN_REVERSAL_RATIO * largest else math.inf


def friction_term(output: str, coefficient: str, tanh_slope: float = math.inf) -> str:
    """Return a friction term as text: ``- fc*sign(D y)``, or ``- fc*tanh(s y)`` if a finite slope s is given."""
    velocity = f"sign(D {output})" if math.isinf(tanh_slope) else f"tanh({tanh_slope:.3g} {output})"
    return f"- {coefficient}*{velocity}"


def failed_tests(tests: Residuals) -> list[Finding]:
    """Return findings on failed tests, undecided tests and detected feedback."""
    findings = []
    for name, output in tests.outputs.items():
        if not math.isfinite(output.rms):
            findings.append(make_finding("out_of_range", output=name))
            continue
        whiteness = output.whiteness
        if not whiteness.passed and not output.follows_direction:
            details = {"statistic": whiteness.statistic, "lags": int(whiteness.lags[-1]), "limit": whiteness.limit}
            code = "output_not_white"
            if output.is_undecided or output.is_noise:
                code, details = "color_undecided" if output.is_undecided else "noise_coloured", {}
            findings.append(make_finding(code, output=name, **details))
        for signal, test in output.informative_tests.items():
            lag, value = test.largest_correlation
            if not test.conclusive:
                code = "residual_test_input_constant" if math.isnan(test.limit) else "residual_test_inconclusive"
                findings.append(make_finding(code, output=name, input=signal, limit=test.limit))
            elif not test.passed:
                details = {"value": value, "lag": lag, "limit": test.limit}
                findings.append(make_finding("residuals_follow_input", output=name, input=signal, **details))
            elif test.first_lag:
                value_at_lag_0 = test.values[test.lags == 0]
                findings.append(
                    make_finding("moves_within_row", output=name, input=signal, value=float(value_at_lag_0[0]))
                )
        if output.follows_direction and output.direction is not None:
            details = {"value": output.direction.largest_correlation[1], "limit": output.direction.limit}
            term = friction_term(name, "fc", output.sign_slope)
            findings.append(make_finding("residuals_follow_direction", output=name, term=term, **details))
        findings += [feedback_finding(name, signal, output) for signal in output.feedback]
    return findings


def feedback_finding(name: str, signal: str, output: OutputResiduals) -> Finding:
    """Return a finding on detected feedback, with its effect on the estimates."""
    test = output.feedback_tests[signal]
    details = {"ratio": test.ratio, "share": 100 * test.explained_fraction}
    if test.bias is None:
        # Without a joint fit the bias is not known. Feedback of white noise hardly biases output-error estimates.
        code = "loop_harmless" if output.whiteness.passed else "loop_found"
        effect = " slightly" if output.whiteness.passed else ""
        return make_finding(code, output=name, input=signal, effect=effect, **details)
    effect = f" by up to {test.bias:.2g} of their standard errors"
    return make_finding(
        "loop_found" if test.bias > 1 else "loop_harmless", output=name, input=signal, effect=effect, **details
    )


def residual_findings(tests: Residuals, *, floor: float = NEGLIGIBLE_RESIDUAL_RATIO) -> list[Finding]:
    """Return findings on failed residual tests, except for outputs whose NR is at most ``floor``."""
    return failed_tests(replace(tests, outputs={n: o for n, o in tests.outputs.items() if not o.nr <= floor}))


def residual_table(tests: Residuals, *, title: str = "Residual tests") -> Table:
    """Return a table of the residual tests with statistic, limit and verdict."""
    rows: list[list[Cell]] = []
    for name, output in tests.outputs.items():
        test_rows = [(Markup("whiteness"), output.whiteness)]
        test_rows += [(Markup("independence of {}").format(symbol_html(n)), t) for n, t in output.inputs.items()]
        rows += [[symbol_html(name), label, t.statistic, t.limit, t.verdict] for label, t in test_rows]
    note = (
        "Whiteness: statistic over all lags. Independence: largest correlation at lags >= 0 after residual and input "
        "pass the filter that whitens the residual. A true model fails each test in 1 % of cases. Undecided: the test "
        "could not have failed."
    )
    return Table(title, ("output", "test", "statistic", "limit (99 %)", "verdict"), rows, note=note)
