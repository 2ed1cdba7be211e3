"""Charts of measured and simulated outputs, residuals and residual tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np

from ftlm.analysis.frequency_response import covariance_of
from ftlm.data.run import Run
from ftlm.errors import DataError, FtlmError
from ftlm.estimation.model_validation import simulation_sensitivities, uncertain_parameters
from ftlm.model.model import Model
from ftlm.svg.charts import BarChart, histogram
from ftlm.svg.figure import MAX_LINE_POINTS, SMALL_WIDTH_PX, Figures
from ftlm.svg.line_chart import LineChart
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import number, symbol
from ftlm.utils.statistics import NORMAL_95
from ftlm.utils.validation import Floats
from ftlm.validation.comparison import Comparison
from ftlm.validation.residual_tests import CorrelationTest, Residuals

#: (lower, upper) edge of a band over time.
Band: TypeAlias = tuple[Floats, Floats]


def pulse_times(comparison: Comparison, run: int = 0) -> Floats:
    """Return the times [s] of the compared values of the run with index `run`: sample times, or block-pulse centers."""
    if comparison.times:
        return comparison.times[run]
    return np.asarray((np.arange(comparison.m) + 0.5) * comparison.step[run], dtype=np.float64)


@check_arguments
def comparison_charts(
    comparison: Comparison,
    *,
    units: Mapping[str, str] | None = None,
    label: str = "",
    points: int = MAX_LINE_POINTS,
    bands: Mapping[str, Band] | None = None,
) -> list[LineChart]:
    """Return a chart of the measured and the simulated output for every output of every run.

    Parameters
    ----------
    comparison
        Result of :func:`ftlm.compare`, or the comparison of an identification.
    units
        Units of the outputs by name.
    label
        Role of the data for the titles, such as "estimation".
    points
        Maximum number of drawn points of a line.
    bands
        (lower, upper) edges of the 95 % confidence band of a simulated output, by output; only for a single run.
    """
    bands_by_output = bands or {}
    return [
        LineChart(
            pulse_times(comparison, k),
            [("measured", comparison.measured[name][k]), ("simulated", comparison.simulated[name][k])],
            title=f"{symbol(name)}, {f'{label}: ' if label else ''}{run}",
            x_label="time [s]",
            y_label=with_unit(symbol(name), units, name),
            points=points,
            slider=True,
            bands=_bands_of_lines(bands_by_output[name]) if name in bands_by_output else (),
            caption=f"Simulation: fit {number(figures.fit)}\u00a0%."
            + (" Shade: 95 % confidence band of the simulation." if name in bands_by_output else ""),
        )
        for k, (run, _, output_error) in enumerate(comparison.per_run)
        for name, figures in output_error.items()
    ]


def _bands_of_lines(band: Band) -> list[Band]:
    """Return the bands of the measured and the simulated line of a chart; the first band is empty (NaN)."""
    empty = np.full(band[0].size, np.nan)
    return [(empty, empty), band]


@check_arguments
def input_charts(runs: Sequence[Run], signals: Sequence[str], *, points: int = MAX_LINE_POINTS) -> list[LineChart]:
    """Return a chart of every input of every run, to be shown below the charts of the outputs.

    Parameters
    ----------
    runs
        Runs whose inputs are drawn.
    signals
        Names of the inputs; those that a run lacks are omitted.
    points
        Maximum number of drawn points of a line.
    """
    return [signal_chart(run, name, points=points) for run in runs for name in signals if name in run.inputs]


def signal_chart(run: Run, name: str, *, points: int = MAX_LINE_POINTS) -> LineChart:
    """Return the chart of the signal `name` of a run over time; `points` is the maximum number of drawn points."""
    is_input = name in run.inputs
    return LineChart(
        run.time,
        [("", run[name])],
        title=f"{symbol(name)}, {'input' if is_input else 'output'} of {run.name}",
        x_label="time [s]",
        y_label=with_unit(symbol(name), run.units, name),
        points=points,
        height=180 if is_input else 240,
        # A command is constant until the next sample, so it is drawn as a staircase.
        steps=run.intersample.get(name) == "zoh",
    )


@check_arguments
def residual_series(
    comparison: Comparison, *, units: Mapping[str, str] | None = None, label: str = "", points: int = MAX_LINE_POINTS
) -> list[LineChart]:
    """Return charts of the simulation residual (measured minus simulated) and its histogram, per output and run.

    Parameters
    ----------
    comparison, units, label, points
        See :func:`comparison_charts`.
    """
    rows = residual_rows(comparison, units=units, label=label, points=points)
    return [chart for row in rows for chart in row]


def residual_rows(
    comparison: Comparison, *, units: Mapping[str, str] | None = None, label: str = "", points: int = MAX_LINE_POINTS
) -> list[list[LineChart]]:
    """Return the charts of :func:`residual_series` as rows, one for every output of every run.

    A row has the residual over time, then its histogram if there are at least two finite residuals.
    """
    rows = []
    suffix = f", {label}" if label else ""
    for k, (run, _, _) in enumerate(comparison.per_run):
        for name in comparison.output_error:
            residual = comparison.measured[name][k] - comparison.simulated[name][k]
            residual_title = f"Residual of {symbol(name)}{suffix}, {run}"
            axis = with_unit(f"residual of {symbol(name)}", units, name)
            over_time = LineChart(
                pulse_times(comparison, k),
                [("", residual)],
                title=f"{residual_title}: over time",
                x_label="time [s]",
                y_label=axis,
                points=points,
                width=SMALL_WIDTH_PX,
                height=190,
            )
            rows.append([over_time])
            if np.sum(np.isfinite(residual)) >= 2:
                caption = "Line: the normal curve of the same mean and deviation."
                rows[-1].append(
                    histogram(residual, title=f"{residual_title}: histogram", x_label=axis, caption=caption)
                )
    return rows


@check_arguments
def compared_bars(
    compared: Sequence[tuple[str, Sequence[tuple[str, Comparison]]]], *, title: str = "Fit of the simulation"
) -> list[BarChart]:
    """Return bar charts of the fits of several models side by side, one for every output.

    Parameters
    ----------
    compared
        (name, comparisons) of each model. The comparisons are (role of the data, comparison) pairs, as in
        ``("integer", [("estimation", a), ("validation", b)])``. All models must have the same roles.
    title
        Title of the charts.

    Raises
    ------
    DataError
        If there is no model, or a model has other outputs or roles of data than the first.
    """
    if not compared:
        raise DataError("compared is empty; give at least one (name, comparisons) pair")
    first, kinds = compared[0], [kind for kind, _ in compared[0][1]]
    outputs = list(first[1][0][1].output_error) if first[1] else []
    for name, parts in compared:
        if [kind for kind, _ in parts] != kinds or any(list(c.output_error) != outputs for _, c in parts):
            raise DataError(
                f"model {name!r} has other outputs or data than {first[0]!r}; give comparisons on the same runs"
            )
    return [
        BarChart(
            [name for name, _ in compared],
            [(kind, [parts[i][1].output_error[o].fit for _, parts in compared]) for i, kind in enumerate(kinds)],
            title=f"{title} of {symbol(o)}",
            x_label="fit [%]",
            low=0.0,
            high=100.0,
            caption="100 % is no error. The bar of a negative fit has no length; its value is printed.",
        )
        for o in outputs
    ]


@check_arguments
def error_chart(
    compared: Sequence[tuple[str, Comparison]],
    output: str,
    *,
    title: str = "",
    units: Mapping[str, str] | None = None,
    points: int = MAX_LINE_POINTS,
) -> LineChart:
    """Return a chart of the absolute simulation error of several models on the first compared run.

    Figure 4(a) of the paper is such a chart.

    Parameters
    ----------
    compared
        (name, comparison) of each model. All comparisons are with the same run and the same number of pulses.
    output
        Name of the output.
    title
        Title; "" for a default title.
    units
        Units of the outputs by name.
    points
        Maximum number of drawn points of a line.

    Raises
    ------
    DataError
        If there is no comparison, or one of them lacks the output.
    """
    if not compared:
        raise DataError("compared is empty; give at least one (name, comparison) pair")
    for name, comparison in compared:
        outputs = list(comparison.measured)
        if output not in outputs:
            raise DataError(f"comparison {name!r} has no output {output!r}; it has {', '.join(outputs)}")
    errors = [(name, np.abs(c.measured[output][0] - c.simulated[output][0])) for name, c in compared]
    return LineChart(
        pulse_times(compared[0][1]),
        errors,
        title=title or f"{symbol(output)}: absolute error of the simulation",
        x_label="time [s]",
        y_label=with_unit("|error|", units, output),
        points=points,
    )


def with_unit(text: str, units: Mapping[str, str] | None, name: str) -> str:
    """Return the axis label `text`, followed by the unit of the signal `name` in brackets if it is known."""
    unit = (units or {}).get(name, "")
    return f"{text} [{unit}]" if unit else text


@check_arguments
def residual_charts(tests: Residuals, *, label: str = "") -> list[LineChart]:
    """Return charts of the autocorrelation and the cross-correlations of each residual, with 99 % bands.

    Parameters
    ----------
    tests
        Result of :func:`ftlm.resid`.
    label
        Role of the data, such as "validation".
    """
    return [correlation_chart(*test, label=label) for test in tests.tests]


def correlation_chart(output: str, signal: str, test: CorrelationTest, *, label: str = "") -> LineChart:
    """Return a chart of the correlation of the residual of `output` with an input `signal` as a function of lag.

    An empty `signal` stands for the residual itself (autocorrelation).
    """
    # Lag 0 of an autocorrelation is omitted, because its value is always 1.
    is_shown = test.lags != 0 if not signal else np.ones(test.lags.size, dtype=bool)
    values = test.values[is_shown]
    band = np.full(values.size, test.band)
    return LineChart(
        test.lags[is_shown].astype(np.float64),
        [("", values)],
        title=f"Residual of {symbol(output)} with {symbol(signal) or 'itself'}{f', {label}' if label else ''}",
        x_label="lag [samples]",
        y_label="correlation",
        caption=_residual_caption(test, values, symbol(signal)),
        bands=[(-band, band)],
        stems=True,
        width=SMALL_WIDTH_PX,
        height=190,
    )


def _residual_caption(test: CorrelationTest, values: Floats, signal: str) -> str:
    """Return the caption of the chart of one residual test: its result and limit.

    An empty `signal` stands for the residual itself.
    """
    if not test.conclusive:
        reason = f"{signal} does not move" if np.isnan(test.limit) else f"its limit is {number(test.limit)}, above 1"
        return f"Whether the residual follows {signal} is undecided: {reason}."
    if not np.isfinite(test.statistic):
        return "The residual is not finite, so there are no correlations."
    outside_count = int(np.sum(np.abs(values) > test.band))
    bars = (
        f"Shade: 99 % band of one bar; {outside_count} of {values.size} bars "
        f"leave{'s' if outside_count == 1 else ''} it."
    )
    if signal:
        verdict_text = "could be independent of" if test.passed else "is not independent of"
        result = f"largest bar at lags from 0 on {number(test.statistic)}, limit {number(test.limit)}"
        return (
            f"{bars} The residual {verdict_text} earlier {signal}: {result} (99 %, both through the whitening filter)."
        )
    verdict_text = "could be" if test.passed else "is not"
    result = f"statistic {number(test.statistic)}, limit {number(test.limit)}"
    return f"{bars} The residual {verdict_text} white noise: {result} (99 %)."


def run_charts(run: Run, *signals: str) -> Figures:
    """Return a chart of each named signal of a run, by default of all signals; see :meth:`ftlm.Run.plot`.

    Raise DataError if the run lacks a signal.
    """
    unknown_names = [name for name in signals if name not in run]
    if unknown_names:
        raise DataError(
            f"signal {unknown_names[0]!r} is not in run {run.name!r}; its signals are {', '.join(run.signals)}"
        )
    return Figures(signal_chart(run, name) for name in signals or (*run.outputs, *run.inputs))


def confidence_bands(model: Model, run: Run, comparison: Comparison) -> dict[str, Band]:
    """Return the pointwise 95 % confidence band of each simulated output on one run, by output.

    The covariance of all parameters is propagated to first order. The band does not include measurement noise. The
    computation takes one simulation per parameter.

    Parameters
    ----------
    model
        Identified model.
    run
        Run that the model is compared with.
    comparison
        Comparison of the model with this run alone.

    Returns
    -------
    dict
        (lower, upper) edges of the band by output. The dictionary is empty for a model without covariance, or if a
        simulation with a changed parameter fails.
    """
    covariance = covariance_of(model)
    if covariance is None or not np.all(np.isfinite(covariance)):
        return {}
    try:
        sensitivities = simulation_sensitivities(model, run, comparison)
    except FtlmError:
        return {}
    rows, bands = uncertain_parameters(covariance), {}
    for name, (matrix,) in sensitivities.items():
        nominal = comparison.simulated[name][0]
        variance = np.einsum("kt,kl,lt->t", matrix, covariance[np.ix_(rows, rows)], matrix)
        half_width = NORMAL_95 * np.sqrt(np.maximum(variance, 0.0))
        if np.all(np.isfinite(half_width)):
            bands[name] = (nominal - half_width, nominal + half_width)
    return bands
