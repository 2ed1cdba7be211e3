"""The report's figures as matplotlib objects: nothing is shown or saved, and no global state is touched."""

from __future__ import annotations

import importlib
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ftlm.base.errors import ModelError
from ftlm.data.run import Run
from ftlm.identification.landscape import output_error_landscape
from ftlm.identification.result import Identification
from ftlm.judge.charts import pulse_times, with_unit
from ftlm.judge.comparison import Comparison
from ftlm.judge.residuals import Residuals
from ftlm.model.charts import bode_curves, response_frequencies
from ftlm.model.model import Model
from ftlm.paint.heat import Landscape
from ftlm.paint.lines import LINES
from ftlm.paint.text import symbol
from ftlm.search.orders import landscape as scores_of

#: Width of a figure, and height of one row of axes [inches]: a journal's double column.
WIDTH, ROW = 7.0, 2.2
#: Resolution in a notebook.
NOTEBOOK_DPI = 110
#: A fit has its error beneath it at this share of its height.
BENEATH = 0.4


def _figure(rows: int, columns: int = 1, *, row: float = ROW, **options: Any) -> tuple[Any, Any]:
    """A figure with a grid of axes, made without pyplot so that nothing is kept or shown."""
    try:
        module = importlib.import_module("matplotlib.figure")
    except ImportError:
        raise ModelError("matplotlib is not installed; pip install 'ftlm[plot]'") from None

    class Drawing(module.Figure):  # type: ignore[misc, name-defined]
        """A figure that a notebook shows although pyplot does not know it."""

        def _repr_png_(self) -> bytes:
            data = io.BytesIO()
            self.savefig(data, format="png", dpi=NOTEBOOK_DPI)
            return data.getvalue()

    figure = Drawing(figsize=(WIDTH, max(row * rows, 2.0)), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def _plain(text: str) -> str:
    """Text that matplotlib does not take for mathematics, whatever a name holds."""
    return text.replace("$", r"\$")


def _unit(name: str, units: Mapping[str, str]) -> str:
    return _plain(with_unit(symbol(name), units, name))


def fit(result: Identification | Model | Comparison, runs: Run | Sequence[Run] | None = None) -> Any:
    """Measured and simulated outputs, the residual beneath each.

    Parameters
    ----------
    result
        A comparison; an identification (on its own runs unless others are given); or a model, which needs runs.
    runs
        Runs to compare with.

    Returns
    -------
    matplotlib.figure.Figure
        Two axes for every output of every run, in SI units.

    Raises
    ------
    ModelError
        A model without runs, something that is no result, or no matplotlib.
    DataError
        Runs that do not fit the model.
    """
    units: Mapping[str, str] = {}
    if isinstance(result, Comparison):
        comparison = result
    elif not isinstance(result, (Identification, Model)):
        raise ModelError(
            f"result is {type(result).__name__}; give an identification, a model with runs or a comparison"
        )
    else:
        model = result.model if isinstance(result, Identification) else result
        units = model.units
        if runs is not None:
            comparison = model.compare(runs)
        elif isinstance(result, Identification):
            comparison = result.comparison
        else:
            raise ModelError("a model alone has nothing to be compared with; give runs")
    pairs = [(k, name) for k in range(len(comparison.per_run)) for name in comparison.output_error]
    figure, axes = _figure(2 * len(pairs), row=ROW * 0.75, height_ratios=[1.0, BENEATH] * len(pairs))
    for i, (k, name) in enumerate(pairs):
        run, _, figures = comparison.per_run[k]
        time = pulse_times(comparison, k)
        measured, simulated = comparison.measured[name][k], comparison.simulated[name][k]
        upper, lower = axes[2 * i, 0], axes[2 * i + 1, 0]
        upper.plot(time, measured, color=LINES[0][0], linewidth=2.2, label="measured")
        upper.plot(time, simulated, color=LINES[1][0], linewidth=1.0, label=f"simulated, fit {figures[name].fit:.4g} %")
        # A run that runs away would flatten what it is to be compared with.
        height = float(np.ptp(measured)) or 1.0
        low, high = float(np.min(measured)) - 0.5 * height, float(np.max(measured)) + 0.5 * height
        upper.set(ylim=(low, high), ylabel=_unit(name, units))
        upper.set_title(_plain(run), fontsize="medium", loc="left")
        upper.legend(loc="upper right", fontsize="small", ncols=2)
        upper.tick_params(labelbottom=False)
        lower.sharex(upper)
        lower.plot(time, measured - simulated, color=LINES[2][0], linewidth=0.7)
        lower.set(ylabel="residual", xlabel="time [s]")
    return figure


def residuals(tests: Residuals | Identification) -> Any:
    """Correlations of the residuals with themselves and with every input, with their 99 % bands.

    Parameters
    ----------
    tests
        From :func:`ftlm.resid`, or an identification (on its own runs).

    Returns
    -------
    matplotlib.figure.Figure
        A row for every output.

    Raises
    ------
    ModelError
        An identification whose runs were too short for tests, something that is no result, or no matplotlib.
    """
    found = tests.residuals if isinstance(tests, Identification) else tests
    if found is None:
        raise ModelError("the runs were too short for residual tests, so there is nothing to draw")
    if not isinstance(found, Residuals):
        raise ModelError(f"tests is {type(found).__name__}; give what resid returns, or an identification")
    drawn = {output: [("itself", part.whiteness), *part.inputs.items()] for output, part in found.outputs.items()}
    columns = max(map(len, drawn.values()))
    figure, axes = _figure(len(drawn), columns)
    for row, (output, correlations) in zip(axes, drawn.items(), strict=True):
        for axis, (name, test) in zip(row, correlations, strict=False):
            keep = test.lags != 0 if name == "itself" else np.ones(test.lags.size, dtype=bool)
            axis.axhspan(-test.band, test.band, color=LINES[1][0], alpha=0.2, linewidth=0)
            axis.vlines(test.lags[keep], 0, test.values[keep], color=LINES[1][0], linewidth=1.2)
            axis.axhline(0, color=LINES[0][0], linewidth=0.6)
            other = name if name == "itself" else symbol(name)
            axis.set_title(_plain(f"{symbol(output)} with {other}: {test.verdict}"), fontsize="small")
            axis.set_xlabel("lag [samples]")
        row[0].set_ylabel("correlation")
        for axis in row[len(correlations) :]:
            axis.set_axis_off()
    return figure


def landscape(result: Identification | Landscape, output: str | None = None) -> Any:
    """Score of an order search, or cost of a joint fit, over two of its orders.

    Parameters
    ----------
    result
        An identification by output error or with an order search, or a landscape (``ftlm.report.landscape``,
        ``ftlm.report.output_error_landscape``), which may be of any two orders.
    output
        Which search of an identification; by default its first.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ModelError
        An identification without a search, or without that one; fewer than two free orders; no matplotlib.
    """
    found: Landscape | Identification | None = result
    if isinstance(result, Identification) and result.joint is not None:
        found = output_error_landscape(result)
        if found is None:
            raise ModelError("this fit has no two free orders with standard errors, so it has no landscape")
    elif isinstance(result, Identification):
        if not result.searches or result.task is None:
            raise ModelError("this identification searched no lattice, so it has no landscape")
        name = next(iter(result.searches)) if output is None else output
        if name not in result.searches:
            raise ModelError(f"there is no search {name!r}; there are {', '.join(result.searches)}")
        part = result.task.structure if name == "stage" else result.task.structure.equation(name)
        found = scores_of(result.task.runs, part, result.searches[name], result.task.lattice_of(part))
    if not isinstance(found, Landscape):
        raise ModelError(f"result is {type(found).__name__}; give an identification or a landscape")
    figure, axes = _figure(1, row=3.2)
    axis = axes[0, 0]
    scores = np.where(np.isfinite(found.scores) & (found.scores > 0), found.scores, np.nan)
    if np.all(np.isnan(scores)):
        raise ModelError("no candidate of this lattice has a finite score; widen it")
    norm = importlib.import_module("matplotlib.colors").LogNorm()
    drawn = axis.pcolormesh(found.x, found.y, scores, norm=norm, cmap="viridis", shading="nearest")
    axis.set_facecolor("0.8")
    row, column = divmod(int(np.nanargmin(scores)), scores.shape[1])
    ring = {"markersize": 9, "fillstyle": "none", "color": LINES[1][0], "markeredgewidth": 2}
    axis.plot(found.x[column], found.y[row], "o", **ring)
    xlabel, ylabel = (_plain(f"order {symbol(name)}") for name in found.names)
    axis.set(xlabel=xlabel, ylabel=ylabel)
    figure.colorbar(drawn, ax=axis, label=f"{found.score} (grey: no candidate, or diverged)")
    return figure


def bode(model: Model | Identification, w: ArrayLike | None = None) -> Any:
    """Gain and phase of every output from every input, with 95 % bands where the model has a covariance.

    Parameters
    ----------
    model
        A model or an identification.
    w
        Frequencies [rad/s]; by default around the model's own.

    Returns
    -------
    matplotlib.figure.Figure
        Gain on the left, phase on the right, a row for every pair.

    Raises
    ------
    ModelError
        Something that is no model, or no matplotlib.
    DataError
        Frequencies that are not finite numbers from 0.
    """
    found = model.model if isinstance(model, Identification) else model
    if not isinstance(found, Model):
        raise ModelError(f"model is {type(found).__name__}; give a model or an identification")
    omega = response_frequencies(found) if w is None else np.asarray(w, dtype=np.float64)
    curves = bode_curves(found, omega)
    figure, axes = _figure(max(len(curves), 1), 2)
    for i, curve in enumerate(curves):
        sides = ((curve.gain, curve.gain_spread, "gain [dB]"), (curve.phase, curve.phase_spread, "phase [degrees]"))
        for axis, (values, spread, label) in zip(axes[i], sides, strict=True):
            axis.semilogx(omega, values, color=LINES[1][0], linewidth=1.2)
            if spread is not None:
                axis.fill_between(omega, values - spread, values + spread, color=LINES[1][0], alpha=0.25, linewidth=0)
            axis.set(ylabel=label, xlabel="frequency [rad/s]")
            axis.grid(visible=True, alpha=0.3)
            axis.set_title(_plain(f"{symbol(curve.output)} from {symbol(curve.input)}"), fontsize="small")
    return figure
