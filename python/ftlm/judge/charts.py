"""Comparisons and residual tests as charts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.errors import DataError
from ftlm.judge.comparison import Comparison
from ftlm.judge.residuals import CorrelationTest, Residuals
from ftlm.paint.axes import POINTS
from ftlm.paint.figure import SMALL, Figure
from ftlm.paint.lines import line_chart
from ftlm.paint.text import number, symbol


def pulse_times(comparison: Comparison, run: int = 0) -> Floats:
    """Return when each value of a run of a comparison holds [s]: its instants, or the middle of every block pulse."""
    if comparison.times:
        return comparison.times[run]
    return np.asarray((np.arange(comparison.m) + 0.5) * comparison.step[run], dtype=np.float64)


def comparison_charts(
    comparison: Comparison, *, units: Mapping[str, str] | None = None, label: str = "", points: int = POINTS
) -> list[Figure]:
    """Measured and simulated output, a chart for every output of every run.

    Parameters
    ----------
    comparison
        From :func:`ftlm.compare` or an identification.
    units
        Units of the outputs.
    label
        What the data were to the model, such as "estimation".
    points
        Most points of a line.
    """
    return [
        line_chart(
            pulse_times(comparison, k),
            [("measured", comparison.measured[name][k]), ("simulated", comparison.simulated[name][k])],
            title=f"{symbol(name)}, {f'{label}: ' if label else ''}{run}", x_label="time [s]",
            y_label=with_unit(symbol(name), units, name), points=points,
            caption=f"Free run: fit {number(figures.fit)}\u00a0%, NR {number(figures.nr)}.",
        )
        for k, (run, _, output_error) in enumerate(comparison.per_run)
        for name, figures in output_error.items()
    ]  # fmt: skip


def error_chart(
    compared: Sequence[tuple[str, Comparison]], output: str, *, run: int = 0, title: str = "",
    units: Mapping[str, str] | None = None, points: int = POINTS,
) -> Figure:  # fmt: skip
    """Absolute error of the free runs of several models on one run, as in the paper's Figure 4(a).

    Parameters
    ----------
    compared
        (name of the model, its comparison); all on the same run with the same m.
    output
        Whose error.
    run
        Index of the run in the comparisons.
    title
        Default: says what is shown.
    units
        Units of the outputs.
    points
        Most points of a line.
    """
    if not compared:
        raise DataError("an error chart needs at least one comparison; give (name, comparison) pairs")
    errors = [(name, np.abs(c.measured[output][run] - c.simulated[output][run])) for name, c in compared]
    return line_chart(
        pulse_times(compared[0][1], run), errors, title=title or f"{symbol(output)}: absolute error of the free run",
        x_label="time [s]", y_label=with_unit("|error|", units, output), points=points,
    )  # fmt: skip


def with_unit(text: str, units: Mapping[str, str] | None, name: str) -> str:
    """Return the label of an axis with the unit of a signal, where it is known."""
    unit = (units or {}).get(name, "")
    return f"{text} [{unit}]" if unit else text


def residual_charts(tests: Residuals, *, label: str = "") -> list[Figure]:
    """Autocorrelation and cross-correlations of the residuals of every output, with their 99 % bands.

    Parameters
    ----------
    tests
        From :func:`ftlm.resid`.
    label
        What the data were to the model, such as "validation".
    """
    figures = []
    suffix = f", {label}" if label else ""
    for output, judged in tests.outputs.items():
        drawn = [("itself", judged.whiteness), *judged.inputs.items()]
        for name, test in drawn:
            own = name == "itself"
            # Lag 0 of an autocorrelation is 1 and says nothing.
            keep = test.lags != 0 if own else np.ones(test.lags.size, dtype=bool)
            lags, values = test.lags[keep].astype(np.float64), test.values[keep]
            band = np.full(lags.size, test.band)
            other = "itself" if own else symbol(name)
            figures.append(
                line_chart(
                    lags, [("", values)], stems=True, width=SMALL, height=190, bands=[(-band, band)],
                    title=f"Residual of {symbol(output)} with {other}{suffix}",
                    x_label="lag [samples]", y_label="correlation",
                    caption=_residual_caption(test, values, "" if own else symbol(name)),
                )
            )  # fmt: skip
    return figures


def _residual_caption(test: CorrelationTest, drawn: Floats, signal: str) -> str:
    """What the bars of one test show, and what they were judged by; no signal stands for the residual itself."""
    if not test.decided:
        why = f"{signal} does not move" if np.isnan(test.limit) else f"its limit is {number(test.limit)}, above 1"
        return f"Whether the residual follows {signal} is undecided: {why}."
    if not np.isfinite(test.statistic):
        return "The residual is not finite, so there are no correlations."
    outside = int(np.sum(np.abs(drawn) > test.band))
    bars = f"Shade: 99 % band of one bar; {outside} of {drawn.size} bars leave{'s' if outside == 1 else ''} it."
    if signal:
        word = "could be independent of" if test.passed else "is not independent of"
        judged = f"largest bar at lags from 0 on {number(test.statistic)}, limit {number(test.limit)}"
        return f"{bars} The residual {word} earlier {signal}: {judged} (99 %, both through the whitening filter)."
    word = "could be" if test.passed else "is not"
    judged = f"Ljung-Box sum {number(test.statistic)}, limit {number(test.limit)}"
    return f"{bars} The residual {word} white noise: {judged} (99 %)."
