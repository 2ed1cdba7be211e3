"""Matplotlib figures and axes without pyplot, so that no global state is changed."""

from __future__ import annotations

import importlib
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
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
    nyquist_curves,
    record_charts,
)
from ftlm.estimation.result import Identification
from ftlm.experiment_design.result import DesignedInput
from ftlm.model.model import Model
from ftlm.order_search.search import landscape as scores_of
from ftlm.plot.comparison_charts import correlation_charts, pulse_times, with_unit
from ftlm.plot.model_charts import (
    TimeResponse,
    bode_curves,
    bode_line_charts,
    pole_points,
    response_frequencies,
    response_line_chart,
)
from ftlm.structure.circuit import Circuit
from ftlm.svg.charts import Landscape
from ftlm.svg.line_chart import LINE_STYLES, LineChart, line_styles
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import symbol
from ftlm.utils.parameters import parameter
from ftlm.utils.resources import optional_module
from ftlm.utils.validation import as_array, as_floats
from ftlm.validation.comparison import Comparison
from ftlm.validation.residual_tests import Residuals

#: Width of a figure and height of one row of axes [inch]; the width is a journal's double column.
FIGURE_WIDTH_INCH, ROW_HEIGHT_INCH = 7.0, 2.2
#: Resolution in a notebook.
NOTEBOOK_DPI = 110


def figure_of(rows: int, columns: int = 1, *, row: float = ROW_HEIGHT_INCH, **options: Any) -> tuple[Any, Any]:
    """Return a figure with a grid of axes, created without pyplot."""
    module = optional_module("matplotlib.figure", "matplotlib", "'ftlm[plot]'")

    class NotebookFigure(module.Figure):  # type: ignore[misc, name-defined]
        """Figure that notebooks show although pyplot does not manage it."""

        def _repr_png_(self) -> bytes:
            data = io.BytesIO()
            self.savefig(data, format="png", dpi=NOTEBOOK_DPI)
            return data.getvalue()

    figure = NotebookFigure(figsize=(FIGURE_WIDTH_INCH, max(row * rows, 2.0)), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def axes_for(ax: Any, rows: int, columns: int = 1, **options: Any) -> tuple[Any, Any]:
    """Return (figure, grid of rows by columns) from the given axes or a new figure."""
    if ax is None:
        return figure_of(rows, columns, **options)
    given = np.atleast_1d(as_array("ax", ax)).ravel().astype(object)
    strange = [type(a).__name__ for a in given if not hasattr(a, "plot") or not hasattr(a, "figure")]
    if strange:
        raise ModelError(f"ax holds {strange[0]}, which is no matplotlib axes; give what subplots returns")
    if given.size != rows * columns:
        raise ModelError(
            f"this figure has {rows * columns} axes ({rows} by {columns}), and ax has {given.size}; give as many, "
            f"such as subplots({rows}, {columns})[1], or leave ax out"
        )
    return given[0].figure, given.reshape(rows, columns)


def escape_math(text: str) -> str:
    """Escape text for matplotlib's math mode."""
    return text.replace("$", r"\$")


def label_of(name: str, units: Mapping[str, str]) -> str:
    """Return a signal's symbol with its unit."""
    return escape_math(with_unit(symbol(name), units, name))


def draw_chart(axis: Any, chart: LineChart) -> None:
    """Draw a chart of lines into axes."""
    styles = line_styles(name for name, _ in chart.lines)
    # Measured points are below the curves.
    below_first = sorted(zip(chart.lines, styles, strict=True), key=lambda line: line[0][0] not in chart.dots)
    for (name, values), style in below_first:
        color, label = LINE_STYLES[style][0], escape_math(name) or None
        if chart.stems:
            axis.vlines(chart.x, 0, values, color=color, linewidth=1.2)
            axis.axhline(0, color=LINE_STYLES[0][0], linewidth=0.6)
        elif name in chart.dots:
            there = np.isfinite(values)
            axis.plot(chart.x[there], values[there], "o", fillstyle="none", markersize=4, color=color, label=label)
        else:
            axis.plot(chart.x, values, color=color, linewidth=1.2, label=label)
    for (low, high), style in zip(chart.bands, styles, strict=False):
        axis.fill_between(chart.x, low, high, color=LINE_STYLES[style][0], alpha=0.25, linewidth=0)
    scales = {"xscale": "log" if chart.log_x else "linear", "yscale": "log" if chart.log_y else "linear"}
    label_axes(axis, chart.title, xlabel=escape_math(chart.x_label), ylabel=escape_math(chart.y_label), **scales)


def label_axes(axis: Any, title: str, **labels: Any) -> None:
    """Set title, labels and grid of one of several axes."""
    axis.set(**labels)
    axis.set_title(escape_math(title), fontsize="small")
    axis.grid(visible=True, alpha=0.3)


#: Height of a residual plot relative to the fit plot above it.
RESIDUAL_HEIGHT_SHARE = 0.4


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
        A comparison; an identification (on its own runs unless others are given); or a model, which needs runs.
    runs
        Runs to compare with.
    inputs
        Draw the inputs of each run below its outputs.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        Two axes for every output of every run, in SI units, and one for every input that was asked for.

    Raises
    ------
    ModelError
        A model without runs, inputs without runs, something that is not a result, axes that are none or too many or
        few, or no matplotlib.
    DataError
        Runs that do not fit the model.
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
            raise ModelError("a model alone has nothing to be compared with; give runs")
    drawn: list[tuple[int, str, str]] = []
    shown = _runs_of(result, runs) if inputs else []
    for k in range(len(comparison.per_run)):
        drawn += [(k, name, kind) for name in comparison.output_error for kind in ("fit", "residual")]
        drawn += [(k, name, "input") for name in (shown[k].inputs if inputs else ())]
    heights = [RESIDUAL_HEIGHT_SHARE if kind == "residual" else 1.0 if kind == "fit" else 0.7 for _, _, kind in drawn]
    figure, axes = axes_for(ax, len(drawn), row=ROW_HEIGHT_INCH * 0.75, height_ratios=heights)
    upper = None
    for axis, (k, name, kind) in zip(axes[:, 0], drawn, strict=True):
        if kind == "input":
            _line_of(axis, shown[k], name)
            continue
        run, _, figures = comparison.per_run[k]
        time = pulse_times(comparison, k)
        measured, simulated = comparison.measured[name][k], comparison.simulated[name][k]
        if kind == "fit":
            upper = axis
            label = f"simulated, fit {figures[name].fit:.4g} %"
            axis.plot(time, measured, color=LINE_STYLES[0][0], linewidth=2.2, label="measured")
            axis.plot(time, simulated, color=LINE_STYLES[1][0], linewidth=1.0, label=label)
            # A run that runs away would flatten what it is to be compared with.
            height = float(np.ptp(measured)) or 1.0
            low, high = float(np.min(measured)) - 0.5 * height, float(np.max(measured)) + 0.5 * height
            axis.set(ylim=(low, high), ylabel=label_of(name, units))
            axis.set_title(escape_math(run), fontsize="medium", loc="left")
            axis.legend(loc="upper right", fontsize="small", ncols=2)
            axis.tick_params(labelbottom=False)
            continue
        if ax is None:
            axis.sharex(upper)
        axis.plot(time, measured - simulated, color=LINE_STYLES[2][0], linewidth=0.7)
        axis.set(ylabel="residual", xlabel="time [s]")
    return figure


def _runs_of(result: Identification | Model | Comparison, runs: Run | Sequence[Run] | None) -> list[Run]:
    """Return the runs of a comparison, for their inputs."""
    if runs is not None:
        return [runs] if isinstance(runs, Run) else list(runs)
    task = result.task if isinstance(result, Identification) else None
    if task is None:
        raise ModelError(f"{parameter('inputs', True)} needs the runs; give them")
    return list(task.runs)


def _line_of(axis: Any, run: Run, name: str) -> None:
    """Plot one signal of a run; zero-order-hold inputs as steps."""
    held = run.intersample.get(name) == "zoh"
    axis.plot(
        run.time,
        run[name],
        color=LINE_STYLES[2 if name in run.inputs else 0][0],
        linewidth=1.0,
        drawstyle="steps-post" if held else "default",
    )
    axis.set(ylabel=label_of(name, run.units), xlabel="time [s]")
    axis.grid(visible=True, alpha=0.3)


@check_arguments
def run(run: Run, *, ax: Any = None) -> Any:
    """Plot the outputs and inputs of a run.

    Parameters
    ----------
    run
        The run.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        One axes for every signal, in SI units.

    Raises
    ------
    ModelError
        Something that is not a run, axes that are none or too many or few, or no matplotlib.
    """
    names = [*run.outputs, *run.inputs]
    figure, axes = axes_for(ax, len(names), row=ROW_HEIGHT_INCH * 0.6)
    for axis, name in zip(axes[:, 0], names, strict=True):
        _line_of(axis, run, name)
    axes[0, 0].set_title(escape_math(run.name), fontsize="medium", loc="left")
    return figure


@check_arguments
def residuals(tests: Residuals | Identification, *, ax: Any = None) -> Any:
    """Plot correlations of the residuals with themselves and with every input, with 99 % bands.

    Parameters
    ----------
    tests
        From :func:`ftlm.resid`, or an identification (on its own runs).
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        A row for every output.

    Raises
    ------
    ModelError
        An identification whose runs were too short for tests, something that is not a result, or no matplotlib.
    """
    found = tests.residuals if isinstance(tests, Identification) else tests
    if found is None:
        raise ModelError("the runs were too short for residual tests, so there is nothing to draw")
    rows = correlation_charts(found)
    figure, axes = axes_for(ax, len(rows), max(map(len, rows)))
    for row, charts in zip(axes, rows, strict=True):
        for axis, (chart, test) in zip(row, charts, strict=False):
            draw_chart(axis, replace(chart, title=f"{chart.title}: {test.verdict}"))
        for axis in row[len(charts) :]:
            axis.set_axis_off()
    return figure


@check_arguments
def landscape(result: Identification | Landscape, output: str | None = None, *, ax: Any = None) -> Any:
    """Plot the score of an order search, or the cost of a joint fit, over two orders.

    Parameters
    ----------
    result
        An identification by output error or with an order search, or a landscape (``ftlm.report.landscape``,
        ``ftlm.report.output_error_landscape``), which may be of any two orders.
    output
        Which search of an identification; by default its first.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ModelError
        An identification without a search, or without that one; fewer than two free orders; no matplotlib.
    """
    if not isinstance(result, Identification):
        found: Landscape | None = result
    elif result.joint is not None:
        found = output_error_landscape(result)
    else:
        if not result.searches or result.task is None:
            raise ModelError("this identification searched no order grid, so it has no landscape")
        name = next(iter(result.searches)) if output is None else output
        if name not in result.searches:
            raise ModelError(f"there is no search {name!r}; there are {', '.join(result.searches)}")
        part = result.task.structure if name == "stage" else result.task.structure.equation(name)
        found = scores_of(result.task.runs, part, result.searches[name], result.task.part_order_grid(part))
    if found is None:
        raise ModelError("this fit has no two free orders with standard errors, so it has no landscape")
    figure, axes = axes_for(ax, 1, row=3.2)
    axis = axes[0, 0]
    scores = np.where(np.isfinite(found.scores) & (found.scores > 0), found.scores, np.nan)
    if np.all(np.isnan(scores)):
        raise ModelError("no candidate of this order grid has a finite score; widen it")
    norm = importlib.import_module("matplotlib.colors").LogNorm()
    drawn = axis.pcolormesh(found.x, found.y, scores, norm=norm, cmap="viridis", shading="nearest")
    axis.set_facecolor("0.8")
    row, column = divmod(int(np.nanargmin(scores)), scores.shape[1])
    ring = {"markersize": 9, "fillstyle": "none", "color": LINE_STYLES[1][0], "markeredgewidth": 2}
    axis.plot(found.x[column], found.y[row], "o", **ring)
    xlabel, ylabel = (escape_math(f"order {symbol(name)}") for name in found.names)
    axis.set(xlabel=xlabel, ylabel=ylabel)
    figure.colorbar(drawn, ax=axis, label=f"{found.score} (grey: no candidate, or diverged)")
    return figure


@check_arguments
def bode(model: Model | Identification, w: ArrayLike | None = None, *, ax: Any = None) -> Any:
    """Plot gain and phase of every pair of output and input, with 95 % bands if the model has a covariance.

    Parameters
    ----------
    model
        A model or an identification.
    w
        Frequencies [rad/s]; by default around the model's own.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        Gain on the left, phase on the right, a row for every pair.

    Raises
    ------
    ModelError
        Something that is not a model, or no matplotlib.
    DataError
        Frequencies that are not finite numbers from 0.
    """
    found = _model_of(model)
    omega = response_frequencies(found) if w is None else as_floats("w", w)
    charts = bode_line_charts(omega, bode_curves(found, omega))
    figure, axes = axes_for(ax, max(len(charts) // 2, 1), 2)
    for axis, chart in zip(axes.flat, charts, strict=False):
        draw_chart(axis, chart)
    return figure


def _model_of(model: Model | Identification) -> Model:
    """Return the model of an argument."""
    return model.model if isinstance(model, Identification) else model


@check_arguments
def poles(model: Model | Identification, *, ax: Any = None) -> Any:
    """Plot poles in the plane of s^q (s for integer orders) with the unstable sector.

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
        Something that is not a model, one with friction or without poles, axes that are none, or no matplotlib.
    """
    found = _model_of(model)
    q, points = pole_points(found)
    if not points.size:
        raise ModelError("this model has no poles to draw: it has friction, or it only integrates")
    figure, axes = axes_for(ax, 1, row=4.0)
    axis = axes[0, 0]
    reach = 1.18 * float(np.max(np.abs(points)))
    angle = np.linspace(-q * np.pi / 2, q * np.pi / 2, 61)
    corner = 4 * reach * np.concatenate([[0.0], np.exp(1j * angle)])
    axis.fill(corner.real, corner.imag, color=LINE_STYLES[1][0], alpha=0.16, linewidth=0, label="not stable")
    axis.plot(points.real, points.imag, "x", color=LINE_STYLES[2][0], markersize=8, markeredgewidth=2)
    plane = "s" if q == 1 else f"s^{{{q:.4g}}}"
    axis.set(xlim=(-reach, reach), ylim=(-reach, reach), xlabel=f"real part of ${plane}$", ylabel="imaginary part")
    axis.set_aspect("equal")
    axis.axhline(0, color=LINE_STYLES[0][0], linewidth=0.6)
    axis.axvline(0, color=LINE_STYLES[0][0], linewidth=0.6)
    axis.grid(visible=True, alpha=0.3)
    axis.legend(loc="upper left", fontsize="small")
    return figure


@check_arguments
def step(model: Model | Identification, time: ArrayLike | None = None, *, ax: Any = None) -> Any:
    """Plot the response to unit steps from rest, with its 95 % band if the model has a covariance.

    Parameters
    ----------
    model
        A model or an identification.
    time
        Regular instants from 0 [s]; by default until the model has settled.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        A row for every output, a column for every input.

    Raises
    ------
    ModelError
        Something that is not a model, one whose input saturates or has a dead zone, axes that are none, no matplotlib.
    DataError
        Instants that are not regular from 0.
    """
    return _response_figure(_model_of(model).step(time), ax)


@check_arguments
def impulse(model: Model | Identification, time: ArrayLike | None = None, *, ax: Any = None) -> Any:
    """Plot the response to unit impulses, averaged over each interval; otherwise as :func:`step`."""
    return _response_figure(_model_of(model).impulse(time), ax)


def _response_figure(found: TimeResponse, ax: Any) -> Any:
    figure, axes = axes_for(ax, len(found.outputs), max(len(found.inputs), 1))
    for i, j in np.ndindex(axes.shape) if found.inputs else ():
        draw_chart(axes[i, j], response_line_chart(found, i, j, found.units))
    return figure


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
        Something that is not an identification, one without a joint covariance, axes that are none, or no matplotlib.
    """
    if result.joint is None:
        raise ModelError(
            f"method {result.method!r} gives no joint covariance; identify by {parameter('method', 'output-error')}"
        )
    names, values = result.joint.names, result.joint.correlation
    figure, axes = axes_for(ax, 1, row=4.0)
    axis = axes[0, 0]
    drawn = axis.imshow(values, vmin=-1, vmax=1, cmap="RdBu_r")
    labels = [escape_math(symbol(n)) for n in names]
    axis.set_xticks(range(len(names)), labels)
    axis.set_yticks(range(len(names)), labels)
    for i, j in np.ndindex(values.shape):
        if i != j:
            ink = "white" if abs(values[i, j]) > 0.6 else "black"
            axis.text(j, i, f"{values[i, j]:.2f}", ha="center", va="center", fontsize="x-small", color=ink)
    figure.colorbar(drawn, ax=axis, label="correlation")
    return figure


@check_arguments
def residual_series(result: Identification | Comparison, *, ax: Any = None) -> Any:
    """Plot output-error residuals over time and their histogram.

    Parameters
    ----------
    result
        An identification (on its own runs) or a comparison.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        Over time on the left, how often on the right, a row for every output of every run.

    Raises
    ------
    ModelError
        Something that is not a result, axes that are none or too many or few, or no matplotlib.
    """
    comparison = result.comparison if isinstance(result, Identification) else result
    units = result.model.units if isinstance(result, Identification) else {}
    pairs = [(k, name) for k in range(len(comparison.per_run)) for name in comparison.output_error]
    figure, axes = axes_for(ax, len(pairs), 2, **({} if ax is not None else {"width_ratios": [2.0, 1.0]}))
    for (left, right), (k, name) in zip(axes, pairs, strict=True):
        missed = comparison.measured[name][k] - comparison.simulated[name][k]
        there = missed[np.isfinite(missed)]
        left.plot(pulse_times(comparison, k), missed, color=LINE_STYLES[2][0], linewidth=0.7)
        left.set(xlabel="time [s]", ylabel=label_of(name, units))
        left.set_title(escape_math(f"residual, {comparison.per_run[k][0]}"), fontsize="small", loc="left")
        right.hist(there, bins=31, color=LINE_STYLES[2][0], alpha=0.7)
        right.set(xlabel=label_of(name, units), ylabel="samples")
        right.locator_params(axis="x", nbins=3)
    return figure


@check_arguments
def models(compared: Mapping[str, Comparison], *, ax: Any = None) -> Any:
    """Plot the fits of several models on the same runs as bars.

    Parameters
    ----------
    compared
        Comparisons by the name of the model.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        A bar for every model and output.

    Raises
    ------
    ModelError
        No model, something that is not a comparison, models with other outputs, axes that are none, or no matplotlib.
    """
    if not compared:
        raise ModelError("bars need at least one model; give comparisons by name, such as {'integer': a, 'free': b}")
    outputs = list(next(iter(compared.values())).output_error)
    for name, comparison in compared.items():
        if list(comparison.output_error) != outputs:
            raise ModelError(
                f"{name!r} has the outputs {', '.join(comparison.output_error)}, the first {', '.join(outputs)}"
            )
    figure, axes = axes_for(ax, 1, row=max(ROW_HEIGHT_INCH, 0.4 * len(compared) * len(outputs)))
    axis, height = axes[0, 0], 0.8 / len(outputs)
    for i, output in enumerate(outputs):
        places = np.arange(len(compared)) + (i - (len(outputs) - 1) / 2) * height
        fits = [c.output_error[output].fit for c in compared.values()]
        bars = axis.barh(
            places,
            np.clip(np.nan_to_num(fits, nan=0.0), 0.0, 100.0),
            height,
            color=LINE_STYLES[1 + i % 5][0],
            label=escape_math(symbol(output)),
        )
        axis.bar_label(bars, [f"{v:.4g}" for v in fits], fontsize="small", padding=3)
    axis.set_yticks(range(len(compared)), [escape_math(n) for n in compared])
    axis.invert_yaxis()
    axis.set(xlabel="fit of the simulation [%]", xlim=(0, 112))
    if len(outputs) > 1:
        axis.legend(loc="lower right", fontsize="small")
    return figure


@check_arguments
def design(result: DesignedInput, *, ax: Any = None) -> Any:
    """Plot a designed input, its predicted response beside that to a square wave, limits and spectrum.

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
        Another type of result, the wrong number of axes, or no matplotlib.
    """
    run, square = result.run, result.reference
    figure, axes = axes_for(ax, len(run.inputs) + len(run.outputs) + 1, row=1.9)
    limits = {r.name: r.limit for r in result.predicted_extremes}
    time = run.step * np.arange(run.length)
    for axis, name in zip(axes[:, 0], (*run.inputs, *run.outputs), strict=False):
        held = {"drawstyle": "steps-post"} if name in run.inputs else {}
        axis.plot(time, square[name], color=LINE_STYLES[1][0], linewidth=0.9, label=square.name, **held)
        axis.plot(time, run[name], color=LINE_STYLES[0][0], linewidth=1.1, label="designed", **held)
        if math.isfinite(limits[name]):
            for side in (-1, 1):
                axis.axhline(
                    side * limits[name], color="0.5", linewidth=0.8, linestyle=":", label="limit" if side > 0 else None
                )
        axis.set(xlabel="time [s]", ylabel=label_of(name, run.units))
        axis.grid(visible=True, alpha=0.3)
    axes[0, 0].legend(fontsize="small", ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False)
    _draw_spectrum(axes[-1, 0], result)
    return figure


def _draw_spectrum(axis: Any, result: DesignedInput) -> None:
    """Plot the cumulative power spectrum, which separates line spectra better than the spectrum itself."""
    rows = result.run.length - 1
    frequencies = np.fft.rfftfreq(rows, result.step)
    for shown, color, label in (
        (result.reference, LINE_STYLES[1][0], result.reference.name),
        (result.run, LINE_STYLES[0][0], "designed"),
    ):
        power = np.sum([np.abs(np.fft.rfft(shown[n][:rows])) ** 2 for n in shown.inputs], axis=0)
        axis.plot(frequencies[1:], np.cumsum(power[1:]) / np.sum(power[1:]), color=color, linewidth=1.1, label=label)
    order = np.argsort(result.spectrum.lines.frequencies)
    best = np.cumsum(result.spectrum.power[order])
    if best[-1] > 0:
        axis.plot(
            result.spectrum.lines.frequencies[order],
            best / best[-1],
            color=LINE_STYLES[2][0],
            linewidth=0.9,
            linestyle="--",
            label="best periodic",
        )
    lines = result.spectrum.lines.frequencies
    axis.set(
        xscale="log",
        xlim=(float(lines.min()), float(lines.max())),
        ylim=(-0.02, 1.02),
        xlabel="frequency [Hz]",
        ylabel="power below",
    )
    axis.grid(visible=True, alpha=0.3)
    axis.legend(fontsize="small", loc="lower right")


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
        Responses to draw, by default those of the fit; required for a model.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        Gain on the left, phase on the right, a row for every record; of an impedance magnitude and phase over Hz.

    Raises
    ------
    ModelError
        Another type of result, a model without data, the wrong number of axes, or no matplotlib.
    DataError
        Data of signals that the model does not have.
    """
    model, records = _model_and_data(result, data)
    figure, axes = axes_for(ax, len(records), 2)
    for row, record in zip(axes, records, strict=True):
        for axis, chart in zip(row, record_charts(model, record), strict=True):
            draw_chart(axis, chart)
        row[0].legend(fontsize="small")
    return figure


@check_arguments
def nyquist(
    result: FrequencyIdentification | Model, data: FrequencyData | FrequencyValidation | None = None, *, ax: Any = None
) -> Any:
    """Plot measured frequency responses and the model's curve in the complex plane with equal axis units.

    Parameters
    ----------
    result, data, ax
        See :func:`response`. An impedance has its negative imaginary part upwards.

    Returns
    -------
    matplotlib.figure.Figure
        One axes for every record.

    Raises
    ------
    ModelError
        See :func:`response`.
    DataError
        Data of signals that the model does not have.
    """
    model, records = _model_and_data(result, data)
    figure, axes = axes_for(ax, len(records), row=3.4)
    for axis, record in zip(axes[:, 0], records, strict=True):
        curve, points, x_label, y_label = nyquist_curves(model, record)
        measured = {"fillstyle": "none", "markersize": 4, "color": LINE_STYLES[0][0], "label": "measured"}
        axis.plot(points.real, points.imag, "o", **measured)
        axis.plot(curve.real, curve.imag, color=LINE_STYLES[1][0], linewidth=1.2, label="model")
        axis.set_aspect("equal", adjustable="datalim")
        label_axes(axis, f"{symbol(record.output)} from {symbol(record.input)}", xlabel=x_label, ylabel=y_label)
        axis.legend(fontsize="small")
    return figure


def _model_and_data(
    result: FrequencyIdentification | Model, data: FrequencyData | FrequencyValidation | None
) -> tuple[Model | Circuit, list[FrequencyData]]:
    """Return the model and the frequency data of the arguments."""
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
