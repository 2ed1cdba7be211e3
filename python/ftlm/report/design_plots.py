"""The designed experiment as a matplotlib figure."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ftlm.base.errors import ModelError
from ftlm.excitation.result import DesignedInput
from ftlm.paint.lines import LINES
from ftlm.report.canvas import axes_for, label_of


def design(result: DesignedInput, *, ax: Any = None) -> Any:
    """A designed input, the answer it is predicted to have beside that to the square, limits and spectrum.

    Parameters
    ----------
    result
        What :func:`ftlm.design_input` returns.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        One axes for every input, one for every output, and one for the spectrum.

    Raises
    ------
    ModelError
        Something that is no designed input, axes that are none or too many or few, or no matplotlib.
    """
    if not isinstance(result, DesignedInput):
        raise ModelError(f"result is {type(result).__name__}; give what design_input returns")
    run, square = result.run, result.reference
    figure, axes = axes_for(ax, len(run.inputs) + len(run.outputs) + 1, row=1.9)
    limits = {r.name: r.limit for r in result.reached}
    time = run.step * np.arange(run.length)
    for axis, name in zip(axes[:, 0], (*run.inputs, *run.outputs), strict=False):
        held = {"drawstyle": "steps-post"} if name in run.inputs else {}
        axis.plot(time, square[name], color=LINES[1][0], linewidth=0.9, label=square.name, **held)
        axis.plot(time, run[name], color=LINES[0][0], linewidth=1.1, label="designed", **held)
        if math.isfinite(limits[name]):
            for side in (-1, 1):
                axis.axhline(side * limits[name], color="0.5", linewidth=0.8, linestyle=":",
                             label="limit" if side > 0 else None)  # fmt: skip
        axis.set(xlabel="time [s]", ylabel=label_of(name, run.units))
        axis.grid(visible=True, alpha=0.3)
    axes[0, 0].legend(fontsize="small", ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False)
    _draw_spectrum(axes[-1, 0], result)
    return figure


def _draw_spectrum(axis: Any, result: DesignedInput) -> None:
    """Share of the power below each frequency: sums tell spectra with few lines from one another."""
    rows = result.run.length - 1
    frequencies = np.fft.rfftfreq(rows, result.step)
    for shown, color, label in (
        (result.reference, LINES[1][0], result.reference.name), (result.run, LINES[0][0], "designed"),
    ):  # fmt: skip
        power = np.sum([np.abs(np.fft.rfft(shown[n][:rows])) ** 2 for n in shown.inputs], axis=0)
        axis.plot(frequencies[1:], np.cumsum(power[1:]) / np.sum(power[1:]), color=color, linewidth=1.1, label=label)
    order = np.argsort(result.spectrum.lines.frequencies)
    best = np.cumsum(result.spectrum.power[order])
    if best[-1] > 0:
        axis.plot(result.spectrum.lines.frequencies[order], best / best[-1], color=LINES[2][0], linewidth=0.9,
                  linestyle="--", label="best periodic")  # fmt: skip
    lines = result.spectrum.lines.frequencies
    axis.set(xscale="log", xlim=(float(lines.min()), float(lines.max())), ylim=(-0.02, 1.02),
             xlabel="frequency [Hz]", ylabel="power below")  # fmt: skip
    axis.grid(visible=True, alpha=0.3)
    axis.legend(fontsize="small", loc="lower right")
