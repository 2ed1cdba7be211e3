"""Residual tests of a model's free run: whether they are white, and independent of the inputs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from ftlm import _core
from ftlm.base.arrays import Floats
from ftlm.base.checks import whole_number
from ftlm.base.errors import DataError, ModelError
from ftlm.base.statistics import LEVEL, NORMAL_99, chi_squared_99, ljung_box
from ftlm.data.run import Run
from ftlm.data.several import as_runs
from ftlm.data.solved import Solved, check_solved
from ftlm.judge.metrics import finite
from ftlm.paint.table import Table
from ftlm.paint.text import Cell, symbol_html
from ftlm.solve.free_run import compared, respond

#: Refinement of the grid ends when it changes residuals by less than this share of their size.
SETTLED = 0.05
#: ... or at this many pulses.
LARGEST_M = 1 << 18
#: Residuals below this share of the output's deviation are discretisation or quantisation, not a missing term.
NEGLIGIBLE = 1e-3


@dataclass(frozen=True)
class CorrelationTest:
    """Correlations of residuals and whether they could be chance.

    Parameters
    ----------
    lags
        Lags in samples; at a lag k > 0 the residual comes k samples after the other signal.
    values
        Correlation at each lag.
    band
        Half-width of the 99 % band of one correlation.
    statistic, limit
        What is judged, and the value that one true model in a hundred exceeds: for whiteness the Ljung-Box sum over
        all positive lags, for independence the largest correlation at lags >= 0 against a band for all of them.
    passed
        Whether the statistic is within its limit; False where the residuals are not finite.
    """

    lags: NDArray[np.int64]
    values: Floats
    band: float
    statistic: float
    limit: float
    passed: bool

    @property
    def outside(self) -> int:
        """Number of correlations outside the band (lag 0 of an autocorrelation not counted); 1 % are expected."""
        return int(np.sum((np.abs(self.values) > self.band) & (self.values != 1.0)))

    @property
    def largest(self) -> tuple[int, float]:
        """Lag and value of the largest correlation that the statistic judges."""
        judged = np.where((self.lags >= 0) & (self.values != 1.0), np.abs(self.values), -1.0)
        at = int(np.argmax(judged))
        return int(self.lags[at]), float(self.values[at])

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "lags": self.lags.tolist(),
            "values": list(map(finite, self.values.tolist())),
            **{n: finite(getattr(self, n)) for n in ("band", "statistic", "limit")},
            "passed": self.passed,
        }


@dataclass(frozen=True)
class OutputResiduals:
    """Residuals of one output over all runs.

    Parameters
    ----------
    residuals
        Measured minus simulated samples, one array a run, without its first and last sample; SI units.
    rms
        Their root mean square over all runs.
    nr
        The same divided by the output's standard deviation.
    whiteness
        Autocorrelations.
    inputs
        Cross-correlations with each input.
    feedback
        Inputs whose LATER values the residuals correlate with while they do not follow earlier ones: a sign of a closed
        loop, not of a missing term.
    """

    residuals: list[Floats]
    rms: float
    nr: float
    whiteness: CorrelationTest
    inputs: dict[str, CorrelationTest]
    feedback: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "rms": finite(self.rms),
            "nr": finite(self.nr),
            "whiteness": self.whiteness.to_dict(),
            "inputs": {n: t.to_dict() for n, t in self.inputs.items()},
            "feedback": list(self.feedback),
        }


@dataclass(frozen=True)
class Residuals:
    """Residual tests of a model on runs.

    Parameters
    ----------
    outputs
        By output.
    runs
        Names of the runs.
    step
        Sampling step of each run [s].
    refinement
        Pulses a sample interval at which the free run was computed.
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
        """Whether the residuals of each output could be white noise."""
        return {name: output.whiteness.passed for name, output in self.outputs.items()}

    @property
    def independent(self) -> dict[str, bool]:
        """Whether the residuals of each output could be independent of all earlier inputs."""
        return {name: all(t.passed for t in output.inputs.values()) for name, output in self.outputs.items()}

    @property
    def passed(self) -> bool:
        """Whether all residuals pass both tests."""
        return all(self.white.values()) and all(self.independent.values())

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "passed": self.passed,
            "runs": list(self.runs),
            "refinement": self.refinement,
            "outputs": {name: output.to_dict() for name, output in self.outputs.items()},
        }

    def __str__(self) -> str:
        tests = [
            (f"{output} {words}", test)
            for output, judged in self.outputs.items()
            for words, test in [("alone", judged.whiteness), *((f"and {n}", t) for n, t in judged.inputs.items())]
        ]
        width = max(len(label) for label, _ in tests) + 2
        lines = [
            f"residual tests at 99 % on {', '.join(self.runs)}: {'passed' if self.passed else 'FAILED'}",
            f"{'correlation of':<{width}}{'largest':>10}{'at lag':>8}{'band':>10}{'statistic':>12}{'limit':>10}",
        ]
        for label, test in tests:
            lag, value = test.largest
            lines.append(
                f"{label:<{width}}{value:>10.3g}{lag:>8}{test.band:>10.3g}{test.statistic:>12.4g}{test.limit:>10.4g}"
                f"   {_verdict(test.passed)}"
            )
        lines += residual_sentences(self)
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return residuals_html(self)


def resid(model: Solved, runs: Run | Sequence[Run], *, lags: int = 25) -> Residuals:
    """Test whether the residuals of a model's free run are white, and independent of the inputs.

    Residuals are measured samples minus the free run at the same instants, with initial terms and offsets fitted to
    each run, on a grid fine enough not to matter. Each run is taken about its own mean; runs are pooled.

    Parameters
    ----------
    model
        The model.
    runs
        One run or several with the same names and units, each of at least ``2 * lags + 3`` rows.
    lags
        Largest lag in samples; the default is the convention of the field.

    Returns
    -------
    Residuals
        ``.passed`` says both; prints as a table.

    Raises
    ------
    DataError
        Runs that do not fit the model, or are too short for these lags.
    ModelError
        A number of lags that is none, an equation that cannot be solved for its output.

    Notes
    -----
    Whiteness: the 99 % band of one autocorrelation of white noise is 2.576/√N; the verdict is the sum of Ljung and Box
    (doi:10.1093/biomet/65.2.297) over all lags against the 99 % quantile of χ². Independence: the variance of one
    cross-correlation of independent signals is Bartlett's Σρₑ(τ)ρᵤ(τ)/N (doi:10.2307/2983611), which allows for
    coloured residuals and is taken no smaller than for white ones; the verdict is the largest correlation at lags >= 0
    against the band that holds for all of them together with 99 % (Šidák). Both tests are of the free run: an equation
    error that passes proves nothing.
    """
    check_solved(model)
    several = as_runs(runs)
    count = whole_number(lags)
    if count is None or count < 1:
        raise ModelError(f"lags = {lags!r} is no number of lags; give a whole number, at least 1")
    for run in several:
        if run.length < 2 * count + 3:
            raise DataError(
                f"run {run.name!r} has {run.length} rows, correlations up to {count} lags need {2 * count + 3}; "
                "give a longer run or fewer lags"
            )
        run.require_outputs([o for o in model.outputs if o in run])
    refinement, residuals, initial_terms = _settled(model, several)
    read = [s for s in model.structure.signals if s not in model.outputs and s in several[0]]
    inputs = list(dict.fromkeys([*several[0].inputs, *read]))
    signals = {n: [np.ascontiguousarray(run[n][1:-1]) for run in several] for n in inputs}
    outputs = {}
    for name in model.outputs:
        deviation = math.sqrt(float(np.mean([np.var(run[name]) for run in several])))
        outputs[name] = _tested(residuals[name], signals, count, deviation)
    steps = tuple(run.step for run in several)
    return Residuals(outputs, tuple(run.name for run in several), steps, refinement, initial_terms)


def _settled(model: Solved, runs: Sequence[Run]) -> tuple[int, dict[str, list[Floats]], int]:
    """Residuals on a grid refined until they stand still, and the number of initial terms fitted."""
    every = 1
    residuals, terms = _residuals(model, runs, every)
    while 2 * every * max(run.length for run in runs) <= LARGEST_M:
        finer, terms = _residuals(model, runs, 2 * every)
        pairs = [(a, b) for name in residuals for a, b in zip(residuals[name], finer[name], strict=True)]
        residuals, every = finer, 2 * every
        with np.errstate(over="ignore", invalid="ignore"):
            moved = [float(np.linalg.norm(a - b)) > SETTLED * float(np.linalg.norm(b)) for a, b in pairs]
        if not any(moved):
            break
    return every, residuals, terms


def _residuals(model: Solved, runs: Sequence[Run], every: int) -> tuple[dict[str, list[Floats]], int]:
    """Residuals at the inner samples of each run, on ``every`` pulses a sample interval."""
    out: dict[str, list[Floats]] = {o: [] for o in model.outputs}
    terms = 0
    sensor = model.structure.sensor_filter
    for run in runs:
        (rec,) = compared([run], model, (run.length - 1) * every)
        responses, initial = respond(model, rec)
        terms += sum(len(t) for t in initial.values())
        for name in model.outputs:
            through = rec.sensor is None or (sensor is not None and name in sensor.outputs)
            # An equation compared in filtered signals has its measured output filtered, too.
            measured = run[name] if through else _core.point_samples(rec.of(name))[::every]
            simulated = _core.point_samples(responses[name])[::every]
            out[name].append(np.ascontiguousarray((measured - simulated)[1:-1]))
    return out, terms


def _tested(series: list[Floats], signals: Mapping[str, list[Floats]], lags: int, deviation: float) -> OutputResiduals:
    """Both tests of one output's residuals; all fail where these are not finite."""
    everything = np.concatenate(series)
    with np.errstate(over="ignore", invalid="ignore"):
        rms = float(np.sqrt(np.mean(everything**2)))
    nr = rms / deviation if deviation > 0 else math.inf
    if not math.isfinite(rms):
        lost, across = _lost(np.arange(lags + 1)), _lost(np.arange(-lags, lags + 1))
        return OutputResiduals(series, math.inf, math.inf, lost, dict.fromkeys(signals, across), ())
    whiteness = _whiteness(series, everything.size, lags)
    inputs = {name: _independence(series, values, lags) for name, values in signals.items()}
    before = {name: float(np.max(np.abs(test.values[:lags]))) for name, test in inputs.items()}
    feedback = tuple(name for name, test in inputs.items() if test.passed and before[name] > test.limit)
    return OutputResiduals(series, rms, nr, whiteness, inputs, feedback)


def _lost(lags: NDArray[np.int64]) -> CorrelationTest:
    """Return a test that nothing passes: there are no correlations."""
    return CorrelationTest(lags, np.full(lags.size, math.nan), math.nan, math.inf, math.nan, passed=False)


def _whiteness(series: list[Floats], count: int, lags: int) -> CorrelationTest:
    """Ljung and Box's sum against its limit."""
    own = _core.correlation(series, series, lags)[0][lags:]
    statistic, limit = ljung_box(own[1:], count), chi_squared_99(lags)
    band = NORMAL_99 / math.sqrt(count)
    return CorrelationTest(np.arange(lags + 1), own, band, statistic, limit, passed=statistic <= limit)


def _independence(series: list[Floats], signal: list[Floats], lags: int) -> CorrelationTest:
    """Largest correlation at lags from 0 on against the band that holds for all of them together."""
    cross, variance, _ = _core.correlation(series, signal, lags)
    spread, largest = math.sqrt(variance), float(np.max(np.abs(cross[lags:])))
    limit = NormalDist().inv_cdf(1 - (1 - (1 - LEVEL) ** (1 / (lags + 1))) / 2) * spread
    around = np.arange(-lags, lags + 1)
    return CorrelationTest(around, cross, NORMAL_99 * spread, largest, limit, passed=largest <= limit)


def residual_sentences(tests: Residuals) -> list[str]:
    """Every failed test in words, and signs of feedback."""
    words = []
    for name, output in tests.outputs.items():
        if not math.isfinite(output.rms):
            words.append(f"{name}: the free run leaves the range of numbers, so its residuals cannot be tested")
            continue
        white = output.whiteness
        if not white.passed:
            words.append(
                f"{name}: residuals are not white (Ljung-Box {white.statistic:.3g} over {white.lags[-1]} lags, 99 % "
                f"limit {white.limit:.3g}): the model leaves something out"
            )
        for signal, test in output.inputs.items():
            lag, value = test.largest
            if not test.passed:
                words.append(
                    f"{name}: residuals still follow {signal} (correlation {value:.2g} at lag {lag}, 99 % limit "
                    f"{test.limit:.2g}): not all of what {signal} does is in the model"
                )
        if output.feedback:
            words.append(
                f"{name}: residuals come before {', '.join(output.feedback)} and not after: the run was made in a "
                "closed loop, or the input is correlated with itself"
            )
    return words


def residual_warnings(tests: Residuals, *, floor: float = NEGLIGIBLE) -> list[str]:
    """Failed residual tests in words, without those of outputs that are explained to within ``floor`` of their size."""
    kept = {name: output for name, output in tests.outputs.items() if not output.nr <= floor}
    return [w for w in residual_sentences(replace(tests, outputs=kept)) if "closed loop" not in w]


def residual_table(tests: Residuals, *, title: str = "Residual tests") -> Table:
    """Return every residual test with its statistic and limit."""
    rows: list[list[Cell]] = []
    for name, output in tests.outputs.items():
        judged = [(Markup("whiteness"), output.whiteness)]
        judged += [(Markup("independence of {}").format(symbol_html(n)), t) for n, t in output.inputs.items()]
        rows += [[symbol_html(name), what, t.statistic, t.limit, _verdict(t.passed)] for what, t in judged]
    note = (
        "Whiteness: Ljung-Box sum over 25 lags. Independence: largest correlation at lags from 0 on. One true model in "
        "a hundred fails each."
    )
    return Table(title, ("output", "test", "statistic", "limit (99 %)", "verdict"), rows, note=note)


def _verdict(passed: bool) -> str:
    return "passed" if passed else "failed"


def residuals_html(tests: Residuals) -> str:
    """Return every residual test with its verdict."""
    return str(residual_table(tests, title=f"Residual tests: {', '.join(tests.runs)}").to_html())
