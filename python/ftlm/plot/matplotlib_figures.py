"""Plots as matplotlib figures, created without pyplot so that no global state changes."""

from __future__ import annotations

import importlib
import io
import math
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import groupby, islice
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ftlm.data.frequency_data import FrequencyData
from ftlm.data.run import Run
from ftlm.errors import ModelError
from ftlm.estimation.cost_surface import output_error_landscape
from ftlm.estimation.frequency_result import (
    FrequencyIdentification,
    FrequencyValidation,
    assign_signals,
    nyquist_chart,
    record_charts,
)
from ftlm.estimation.result import Identification
from ftlm.experiment_design.result import DesignedInput
from ftlm.model.model import Model
from ftlm.order_search.search import landscape as scores_of
from ftlm.plot.comparison_charts import comparison_charts, correlation_chart, residual_rows, signal_chart
from ftlm.plot.model_charts import TimeResponse, bode_charts, pole_charts, response_chart
from ftlm.structure.circuit import Circuit
from ftlm.svg.charts import BarChart, CorrelationMap, Landscape, PlaneChart
from ftlm.svg.figure import Figure
from ftlm.svg.line_chart import LINE_STYLES, LineChart, line_styles
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import symbol
from ftlm.utils.parameters import parameter
from ftlm.utils.resources import optional_module
from ftlm.utils.validation import as_array
from ftlm.validation.comparison import Comparison
from ftlm.validation.residual_tests import Residuals

#: Width of a figure and height of one row of axes [inch]. The width is that of two columns of a journal.
FIGURE_WIDTH_INCH, ROW_HEIGHT_INCH = 7.0, 2.2
#: Free space above the lines for the legend, as a fraction of the range of the vertical axis.
LEGEND_HEIGHT_FRACTION = 0.25
#: Resolution of figures in notebooks [dots per inch].
NOTEBOOK_DPI = 110


def figure_of(rows: int, columns: int = 1, *, row: float = ROW_HEIGHT_INCH, **options: Any) -> tuple[Any, Any]:
    """Return a new figure, created without pyplot, and its axes as an array of shape (rows, columns).

    `row` is the height of a row of axes [inch], and `options` are passed to ``Figure.subplots``. Raise ModelError if
    matplotlib is not installed.
    """
    module = optional_module("matplotlib.figure", "matplotlib", "'ftlm[plot]'")

    class NotebookFigure(module.Figure):  # type: ignore[misc, name-defined]
        """Matplotlib figure that notebooks display without pyplot."""

        def _repr_png_(self) -> bytes:
            data = io.BytesIO()
            self.savefig(data, format="png", dpi=NOTEBOOK_DPI)
            return data.getvalue()

    figure = NotebookFigure(figsize=(FIGURE_WIDTH_INCH, max(row * rows, 2.0)), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def axes_for(ax: Any, rows: int, columns: int = 1, **options: Any) -> tuple[Any, Any]:
    """Return a figure and its axes, shape (rows, columns): the given axes `ax`, or those of a new figure for None.

    Raise ModelError if `ax` contains other objects, or their number is not rows times columns.
    """
    if ax is None:
        return figure_of(rows, columns, **options)
    all_axes = np.atleast_1d(as_array("ax", ax)).ravel().astype(object)
    wrong_types = [type(a).__name__ for a in all_axes if not hasattr(a, "plot") or not hasattr(a, "figure")]
    if wrong_types:
        raise ModelError(
            f"ax contains an object of type {wrong_types[0]}, not matplotlib axes; give the axes that subplots returns"
        )
    if all_axes.size != rows * columns:
        raise ModelError(
            f"this figure has {rows * columns} axes ({rows} by {columns}), and ax has {all_axes.size}; give as many, "
            f"such as subplots({rows}, {columns})[1], or leave ax out"
        )
    return all_axes[0].figure, all_axes.reshape(rows, columns)


def draw_figure(rows: Sequence[Sequence[Figure]], ax: Any, **options: Any) -> Any:
    """Draw rows of charts into the axes `ax`, or into a new figure if it is None, and return the figure.

    `options` are those of :func:`figure_of`.
    """
    figure, axes = axes_for(ax, max(len(rows), 1), max((len(row) for row in rows), default=1), **options)
    for row, charts in zip(axes, rows, strict=False):
        for axis, chart in zip(row, charts, strict=False):
            draw_chart(axis, chart)
        for axis in row[len(charts) :]:
            axis.set_axis_off()
    return figure


def escape_math(text: str) -> str:
    """Return text with dollar signs escaped, and powers such as s^2 in matplotlib's math mode."""
    return re.sub(r"((?<!\w)\w|)\^([\d.]+)", r"$\1^{\2}$", text.replace("$", r"\$"))


def draw_chart(axis: Any, chart: Figure) -> None:
    """Draw a chart and its title in matplotlib axes."""
    axis.set_title(escape_math(chart.title), fontsize="small")
    if isinstance(chart, LineChart):
        _draw_lines(axis, chart)
    elif isinstance(chart, PlaneChart):
        _draw_plane(axis, chart)
    elif isinstance(chart, BarChart):
        _draw_bars(axis, chart)
    elif isinstance(chart, CorrelationMap):
        _draw_correlations(axis, chart)
    elif isinstance(chart, Landscape):
        _draw_landscape(axis, chart)


def _draw_lines(axis: Any, chart: LineChart) -> None:
    styles = line_styles(name for name, _ in chart.lines)
    x = np.asarray(chart.x)
    if chart.bars is not None:
        edges, heights = chart.bars
        axis.bar(edges[:-1], heights, np.diff(edges), align="edge", color=LINE_STYLES[2][0], alpha=0.55)
    below_first = sorted(zip(chart.lines, styles, strict=True), key=lambda line: line[0][0] not in chart.dots)
    for (name, values), style in below_first:
        color, _, dashes = LINE_STYLES[style]
        label = escape_math(name) or None
        if chart.stems:
            axis.vlines(x, 0, values, color=color, linewidth=1.2)
            axis.axhline(0, color=LINE_STYLES[0][0], linewidth=0.6)
        elif name in chart.dots:
            is_finite = np.isfinite(values)
            dots = {"fillstyle": "none", "markersize": 4, "color": color, "label": label}
            axis.plot(x[is_finite], np.asarray(values)[is_finite], "o", **dots)
        else:
            dash = (0, [float(length) for length in dashes.split()]) if dashes else "-"
            options = {"drawstyle": "steps-post"} if chart.steps else {}
            # The measured line is wider, so that it stays visible behind a simulated line that coincides with it.
            width = 2.2 if style == 0 and len(styles) > 1 else 1.0
            axis.plot(x, values, color=color, linewidth=width, linestyle=dash, label=label, **options)
    for (low, high), style in zip(chart.bands, styles, strict=False):
        axis.fill_between(x, low, high, color=LINE_STYLES[style][0], alpha=0.25, linewidth=0)
    left, right, bottom, top = chart.frame
    # Free space for the legend, so that it does not cover the lines.
    top += LEGEND_HEIGHT_FRACTION * (top - bottom) if any(name for name, _ in chart.lines) else 0.0
    xlim, ylim = (10.0**left, 10.0**right) if chart.log_x else (left, right), (bottom, top)
    axis.set(xscale="log" if chart.log_x else "linear", yscale="log" if chart.log_y else "linear")
    axis.set(xlim=xlim, ylim=(10.0**bottom, 10.0**top) if chart.log_y else ylim)
    _label_axes(axis, chart.x_label, chart.y_label, loc="upper right", ncols=len(styles))


def _label_axes(axis: Any, x_label: str, y_label: str, **legend: Any) -> None:
    """Set the axis labels and the grid, and add a legend if a line has a name."""
    axis.set(xlabel=escape_math(x_label), ylabel=escape_math(y_label))
    axis.grid(visible=True, alpha=0.3)
    axis.set_axisbelow(True)
    if axis.get_legend_handles_labels()[1]:
        axis.legend(fontsize="small", **legend)


def _draw_plane(axis: Any, chart: PlaneChart) -> None:
    points, (low, high) = chart.values, chart.plot_corners
    if chart.line is None:
        corner = np.array(chart.sector_outline(high.real))
        axis.fill(corner.real, corner.imag, color=LINE_STYLES[1][0], alpha=0.16, linewidth=0, label="not stable")
        axis.plot(points.real, points.imag, "x", color=LINE_STYLES[2][0], markersize=8, markeredgewidth=2)
    else:
        measured = {"fillstyle": "none", "markersize": 4, "color": LINE_STYLES[0][0], "label": "measured"}
        axis.plot(points.real, points.imag, "o", **measured)
        axis.plot(chart.line.real, chart.line.imag, color=LINE_STYLES[1][0], linewidth=1.2, label="model")
    axis.axhline(0, color=LINE_STYLES[0][0], linewidth=0.6)
    axis.axvline(0, color=LINE_STYLES[0][0], linewidth=0.6)
    axis.set(xlim=(low.real, high.real), ylim=(low.imag, high.imag))
    axis.set_aspect("equal")
    _label_axes(axis, chart.x_label, chart.y_label)


def _draw_bars(axis: Any, chart: BarChart) -> None:
    height, (low, high) = 0.8 / len(chart.tables), chart.axis_limits
    for i, (name, values) in enumerate(chart.tables):
        positions = np.arange(values.size) + (i - (len(chart.tables) - 1) / 2) * height
        clipped = np.clip(np.nan_to_num(values, nan=low), low, high) - low
        label = escape_math(name) if len(chart.tables) > 1 else None
        bars = axis.barh(positions, clipped, height, low, color=LINE_STYLES[1 + i][0], label=label)
        axis.bar_label(bars, [f"{v:.4g}" for v in values], fontsize="small", padding=3)
    axis.set_yticks(range(len(chart.names)), [escape_math(n) for n in chart.names])
    axis.invert_yaxis()
    # The axis extends beyond the longest bar, because the value is printed next to it.
    axis.set(xlim=(low, low + 1.12 * (high - low)))
    _label_axes(axis, chart.x_label, "")


def _draw_correlations(axis: Any, chart: CorrelationMap) -> None:
    image = axis.imshow(chart.matrix, vmin=-1, vmax=1, cmap="RdBu_r")
    labels = [escape_math(symbol(n)) for n in chart.names]
    axis.set_xticks(range(len(labels)), labels)
    axis.set_yticks(range(len(labels)), labels)
    for i, j in np.ndindex(chart.matrix.shape):
        if i != j:
            value = chart.matrix[i, j]
            text_color = "white" if abs(value) > 0.6 else "black"
            axis.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize="x-small", color=text_color)
    axis.figure.colorbar(image, ax=axis, label="correlation")


#: Maximum number of characters in a line of the label of a color bar.
COLORBAR_LABEL_CHARACTERS = 40


def _draw_landscape(axis: Any, chart: Landscape) -> None:
    norm = importlib.import_module("matplotlib.colors").LogNorm()
    mesh = axis.pcolormesh(chart.x, chart.y, chart.valid_scores, norm=norm, cmap="viridis", shading="nearest")
    axis.set_facecolor("0.8")
    row, column = chart.best
    ring = {"markersize": 9, "fillstyle": "none", "color": LINE_STYLES[1][0], "markeredgewidth": 2}
    axis.plot(chart.x[column], chart.y[row], "o", **ring)
    xlabel, ylabel = (escape_math(f"order {symbol(name)}") for name in chart.names)
    axis.set(xlabel=xlabel, ylabel=ylabel)
    # A long label does not fit along the bar.
    label = textwrap.fill(f"{chart.score} (grey: no candidate, or diverged)", COLORBAR_LABEL_CHARACTERS)
    axis.figure.colorbar(mesh, ax=axis, label=label)


#: Height of a residual plot, as a fraction of the height of the fit plot above it.
RESIDUAL_HEIGHT_FRACTION = 0.4


@check_arguments
def fit(
    result: Identification | Model | Comparison,
    runs: Run | Sequence[Run] | None = None,
    *,
    inputs: bool = False,
    ax: Any = None,
) -> Any:
    """Plot measured and simulated outputs, with the residual below each.

    Parameters
    ----------
    result
        A comparison, an identification or a model. An identification is by default plotted on its estimation runs. A
        model requires `runs`.
    runs
        Measured runs that the model is compared with.
    inputs
        Whether the inputs of each run are plotted below its outputs. For a comparison this requires `runs`.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        Figure with two axes for every output of every run, in SI units, and one for every requested input.

    Raises
    ------
    ModelError
        If `result` has another type, or a model or requested inputs are given without runs. Also if `ax` is not the
        required number of axes, or matplotlib is not installed.
    DataError
        If a run lacks a signal of the model.
    """
    units: Mapping[str, str] = {}
    if isinstance(result, Comparison):
        comparison = result
    else:
        model = result.model if isinstance(result, Identification) else result
        units = model.units
        if runs is not None:
            comparison = model.compare(runs)
        elif isinstance(result, Identification):
            comparison = result.comparison
        else:
            raise ModelError("a model without runs cannot be compared; give runs")
    runs_of_result = _runs_of(result, runs) if inputs else []
    pairs = zip(comparison_charts(comparison, units=units), residual_rows(comparison, units=units), strict=True)
    charts, heights = [], []
    for k in range(len(comparison.per_run)):
        for fit_chart, (residual_chart, *_) in islice(pairs, len(comparison.output_error)):
            charts += [
                replace(fit_chart, title=f"{fit_chart.title}. {fit_chart.caption}"),
                replace(residual_chart, title="", y_label="residual"),
            ]
            heights += [1.0, RESIDUAL_HEIGHT_FRACTION]
        input_charts = [signal_chart(runs_of_result[k], name) for name in runs_of_result[k].inputs] if inputs else []
        charts += input_charts
        heights += [0.7] * len(input_charts)
    return draw_figure([[chart] for chart in charts], ax, row=ROW_HEIGHT_INCH * 0.75, height_ratios=heights)


def _runs_of(result: Identification | Model | Comparison, runs: Run | Sequence[Run] | None) -> list[Run]:
    """Return the given runs, or else the estimation runs of an identification; raise ModelError without runs."""
    if runs is not None:
        return [runs] if isinstance(runs, Run) else list(runs)
    task = result.task if isinstance(result, Identification) else None
    if task is None:
        raise ModelError(f"{parameter('inputs', True)} plots the inputs of the runs, but there are no runs; give runs")
    return list(task.runs)


@check_arguments
def run(run: Run, *, ax: Any = None) -> Any:
    """Plot the outputs and inputs of a run.

    Parameters
    ----------
    run
        Run to plot.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        One axes for every signal, in SI units.

    Raises
    ------
    ModelError
        If `run` is not a run, `ax` is not the required number of axes, or matplotlib is not installed.
    """
    charts = [[signal_chart(run, name)] for name in (*run.outputs, *run.inputs)]
    return draw_figure(charts, ax, row=ROW_HEIGHT_INCH * 0.6)


@check_arguments
def residuals(tests: Residuals | Identification, *, ax: Any = None) -> Any:
    """Plot the autocorrelation of the residuals and their cross-correlations with every input, with 99 % bands.

    Parameters
    ----------
    tests
        Result of :func:`ftlm.resid`, or an identification, whose residuals on its estimation runs are plotted.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        One row for every output, with one axes for the autocorrelation and one for every input.

    Raises
    ------
    ModelError
        If the runs of the identification were too short for residual tests, `tests` has another type, or matplotlib is
        not installed.
    """
    results = tests.residuals if isinstance(tests, Identification) else tests
    if results is None:
        raise ModelError("the runs were too short for residual tests; give longer runs to draw them")
    rows = [
        [correlation_chart(*test, label=test[-1].verdict) for test in group]
        for _, group in groupby(results.tests, key=lambda test: test[0])
    ]
    return draw_figure(rows, ax)


@check_arguments
def landscape(result: Identification | Landscape, output: str | None = None, *, ax: Any = None) -> Any:
    """Plot the score of an order search, or the cost of a joint fit, over two orders.

    Parameters
    ----------
    result
        An identification by output error or with an order search, or a landscape. A landscape of any two orders is
        returned by ``ftlm.report.landscape`` and ``ftlm.report.output_error_landscape``.
    output
        Output whose order search is plotted, or ``"stage"`` for a search of coupled equations; by default the first
        search of the identification.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ModelError
        If the identification has no order search of this output, or no two free orders with standard errors. Also if
        matplotlib is not installed.
    """
    if not isinstance(result, Identification):
        surface: Landscape | None = result
    elif result.joint is not None:
        surface = output_error_landscape(result)
    else:
        if not result.searches or result.task is None:
            raise ModelError("the identification has no order search; identify with an order grid to draw its scores")
        name = next(iter(result.searches)) if output is None else output
        if name not in result.searches:
            raise ModelError(f"there is no order search {name!r}; the searches are {', '.join(result.searches)}")
        group = result.task.structure if name == "stage" else result.task.structure.equation(name)
        surface = scores_of(result.task.runs, group, result.searches[name], result.task.part_order_grid(group))
    if surface is None:
        raise ModelError("this fit has no two free orders with standard errors; free two orders to draw them")
    return draw_figure([[surface]], ax, row=3.2)


@check_arguments
def bode(model: Model | Identification, w: ArrayLike | None = None, *, ax: Any = None) -> Any:
    """Plot gain and phase of every pair of output and input, with 95 % bands if the model has a covariance.

    Parameters
    ----------
    model
        A model or an identification.
    w
        Frequencies [rad/s]; by default a range around the corner frequencies of the model.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        Gain on the left, phase on the right, a row for every pair.

    Raises
    ------
    ModelError
        If `model` has another type, or matplotlib is not installed.
    DataError
        If a frequency is not finite or is negative.
    """
    charts = bode_charts(_model_of(model), w)
    return draw_figure([charts[k : k + 2] for k in range(0, len(charts), 2)] or [[], []], ax)


def _model_of(model: Model | Identification) -> Model:
    """Return the model of an identification, or the given model itself."""
    return model.model if isinstance(model, Identification) else model


@check_arguments
def poles(model: Model | Identification, *, ax: Any = None) -> Any:
    """Plot poles in the complex plane of s^q, with the unstable sector; q is 1 for integer orders.

    Parameters
    ----------
    model
        A model or an identification.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ModelError
        If `model` has another type, friction or no poles, `ax` is invalid, or matplotlib is not installed.
    """
    charts = pole_charts(_model_of(model))
    if not charts:
        raise ModelError("this model has no poles to draw, as with friction; draw its response instead")
    return draw_figure([charts], ax, row=4.0)


@check_arguments
def step(model: Model | Identification, time: ArrayLike | None = None, *, ax: Any = None) -> Any:
    """Plot the responses to unit steps with zero initial conditions, with 95 % bands if the model has a covariance.

    Parameters
    ----------
    model
        A model or an identification.
    time
        Uniform sample times that begin at 0 [s]; by default up to about six time constants of the slowest mode.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        A row for every output, a column for every input.

    Raises
    ------
    ModelError
        If `model` has another type, or an input with a saturation or dead zone. Also if `ax` is invalid, or matplotlib
        is not installed.
    DataError
        If sample times are not uniform, or do not begin at 0.
    """
    return _response_figure(_model_of(model).step(time), ax)


@check_arguments
def impulse(model: Model | Identification, time: ArrayLike | None = None, *, ax: Any = None) -> Any:
    """Plot the responses to unit impulses, averaged over each sampling interval.

    Arguments, figure and errors are those of :func:`step`.
    """
    return _response_figure(_model_of(model).impulse(time), ax)


def _response_figure(time_responses: TimeResponse, ax: Any) -> Any:
    inputs = range(len(time_responses.inputs))
    charts = [
        [response_chart(time_responses, i, j, time_responses.units) for j in inputs]
        for i in range(len(time_responses.outputs))
    ]
    return draw_figure(charts, ax)


@check_arguments
def correlation(result: Identification, *, ax: Any = None) -> Any:
    """Plot the correlation matrix of the estimates of a joint fit.

    Parameters
    ----------
    result
        An identification by output error.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ModelError
        If `result` is not an identification or has no joint covariance, `ax` is invalid, or matplotlib is not
        installed.
    """
    if result.joint is None:
        raise ModelError(
            f"method {result.method!r} gives no joint covariance; identify by {parameter('method', 'output-error')}"
        )
    chart = CorrelationMap(result.joint.names, result.joint.correlation, title="Correlations of the estimates")
    return draw_figure([[chart]], ax, row=4.0)


@check_arguments
def residual_series(result: Identification | Comparison, *, ax: Any = None) -> Any:
    """Plot output-error residuals (measured minus simulated) over time, and their histograms.

    Parameters
    ----------
    result
        An identification, whose residuals on its estimation runs are plotted, or a comparison.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        Residuals over time on the left, their histogram on the right, a row for every output of every run.

    Raises
    ------
    ModelError
        If `result` has another type, `ax` is not the required number of axes, or matplotlib is not installed.
    """
    comparison = result.comparison if isinstance(result, Identification) else result
    units = result.model.units if isinstance(result, Identification) else {}
    rows = residual_rows(comparison, units=units)
    return draw_figure(rows, ax, **({} if ax is not None else {"width_ratios": [3.0, 2.0]}))


@check_arguments
def models(compared: Mapping[str, Comparison], *, ax: Any = None) -> Any:
    """Plot the fits [%] of several models on the same runs as a bar chart.

    Parameters
    ----------
    compared
        Comparison of each model with the runs, by the name of the model.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        A bar for every model and output.

    Raises
    ------
    ModelError
        If there is no model, a value is not a comparison, or the models have different outputs. Also if `ax` is
        invalid, or matplotlib is not installed.
    """
    if not compared:
        raise ModelError("compared is empty; give at least one comparison by name, such as {'integer': a, 'free': b}")
    outputs = list(next(iter(compared.values())).output_error)
    for name, comparison in compared.items():
        if list(comparison.output_error) != outputs:
            raise ModelError(
                f"{name!r} has the outputs {', '.join(comparison.output_error)}, the first has {', '.join(outputs)}; "
                "give comparisons of the same outputs"
            )
    chart = BarChart(
        list(compared),
        [(symbol(output), [c.output_error[output].fit for c in compared.values()]) for output in outputs],
        title="Fit of the simulation",
        x_label="fit [%]",
        high=100.0,
    )
    return draw_figure([[chart]], ax, row=max(ROW_HEIGHT_INCH, 0.4 * len(compared) * len(outputs)))


@check_arguments
def design(result: DesignedInput, *, ax: Any = None) -> Any:
    """Plot a designed input and its spectrum, with the predicted outputs and the limits of the signals.

    A square wave of the same length and peaks, and the outputs for it, are plotted for comparison.

    Parameters
    ----------
    result
        Result of :func:`ftlm.design_input`.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        One axes for every input, one for every output, and one for the spectrum.

    Raises
    ------
    ModelError
        If `result` has another type, `ax` is not the required number of axes, or matplotlib is not installed.
    """
    charts = [[_designed_chart(result, name)] for name in (*result.run.inputs, *result.run.outputs)]
    return draw_figure([*charts, [_spectrum_chart(result)]], ax, row=1.9)


def _designed_chart(result: DesignedInput, name: str) -> LineChart:
    """Return the chart of signal `name` in the designed run and in the square-wave run, with its limits as a band."""
    run, square = result.run, result.reference
    lines = [("designed", run[name]), (square.name, square[name])]
    limit = next(r.limit for r in result.predicted_extremes if r.name == name)
    bands = [(np.full(run.length, -limit), np.full(run.length, limit))] if math.isfinite(limit) else []
    return replace(signal_chart(run, name), lines=lines, bands=bands, steps=name in run.inputs)


def _spectrum_chart(result: DesignedInput) -> LineChart:
    """Return a chart of the fraction of input power below each frequency, for designed and square-wave inputs.

    A cumulative curve shows differences between line spectra better than the spectrum itself. The optimal periodic
    spectrum is included if it has power.
    """
    rows, lines = result.run.length - 1, result.spectrum.lines.frequencies
    all_frequencies = np.fft.rfftfreq(rows, result.step)
    is_shown = (all_frequencies >= lines.min()) & (all_frequencies <= lines.max())
    curves: list[tuple[str, ArrayLike]] = []
    for name, run in ((result.reference.name, result.reference), ("designed", result.run)):
        power = np.sum([np.abs(np.fft.rfft(run[n][:rows])) ** 2 for n in run.inputs], axis=0)
        curves.append((name, (np.cumsum(power[1:]) / np.sum(power[1:]))[is_shown[1:]]))
    order = np.argsort(lines)
    cumulative_power = np.cumsum(result.spectrum.power[order])
    if cumulative_power[-1] > 0:
        curves.append(
            (
                "best periodic",
                np.interp(all_frequencies[is_shown], lines[order], cumulative_power / cumulative_power[-1]),
            )
        )
    return LineChart(
        all_frequencies[is_shown], curves, title="Spectrum", x_label="frequency [Hz]", y_label="power below", log_x=True
    )


@check_arguments
def response(
    result: FrequencyIdentification | Model, data: FrequencyData | FrequencyValidation | None = None, *, ax: Any = None
) -> Any:
    """Plot gain and phase of measured frequency responses with the model's curve and its 95 % band.

    Parameters
    ----------
    result
        Result of :func:`ftlm.identify_frequency`, or a model.
    data
        Measured responses to draw; by default those of the identification. Required if `result` is a model.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        Gain on the left, phase on the right, a row for every measured response. For an impedance, magnitude and phase
        are drawn over frequency in Hz.

    Raises
    ------
    ModelError
        If `result` or `data` has another type, or a model is given without data. Also if `ax` is not the required
        number of axes, or matplotlib is not installed.
    DataError
        If the model lacks a signal of the data.
    """
    model, records = _model_and_data(result, data)
    return draw_figure([record_charts(model, record) for record in records], ax)


@check_arguments
def nyquist(
    result: FrequencyIdentification | Model, data: FrequencyData | FrequencyValidation | None = None, *, ax: Any = None
) -> Any:
    """Plot measured frequency responses and the model's curve in the complex plane with equal axis units.

    Parameters
    ----------
    result, data, ax
        See :func:`response`. For an impedance, the vertical axis is the negative imaginary part.

    Returns
    -------
    matplotlib.figure.Figure
        One axes for every measured response.

    Raises
    ------
    ModelError
        See :func:`response`.
    DataError
        If the model lacks a signal of the data.
    """
    model, records = _model_and_data(result, data)
    return draw_figure([[nyquist_chart(model, record)] for record in records], ax, row=3.4)


def _model_and_data(
    result: FrequencyIdentification | Model, data: FrequencyData | FrequencyValidation | None
) -> tuple[Model | Circuit, list[FrequencyData]]:
    """Return the model and the measured responses to draw, from the arguments of :func:`response`.

    Raise ModelError for other types, or if there are no measured responses.
    """
    if not isinstance(result, (FrequencyIdentification, Model)):
        raise ModelError(f"result is {type(result).__name__}; give what identify_frequency returns, or a model")
    if isinstance(result, FrequencyIdentification):
        model, records = result.system, list(result.data)
    else:
        model, records = result, []
    if isinstance(data, FrequencyValidation):
        records = list(data.data)
    elif isinstance(data, FrequencyData):
        records = [assign_signals(model, data)]
    elif data is not None:
        raise ModelError(f"data is {type(data).__name__}; give frequency data, such as load_frequency returns")
    if not records:
        raise ModelError("a model alone has no measured points; give data, such as load_frequency returns")
    return model, records
