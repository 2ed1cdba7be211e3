"""A model in the frequency domain as charts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ftlm.base.arrays import Floats
from ftlm.base.statistics import NORMAL_95
from ftlm.model.model import Model
from ftlm.paint.figure import SMALL, Figure
from ftlm.paint.lines import line_chart
from ftlm.paint.text import symbol
from ftlm.solve.frequency import frequency_response, response_deviation, response_inputs, transfer_functions
from ftlm.solve.records import COULOMB

#: A natural logarithm of a gain in decibels.
DECIBEL = 20.0 / math.log(10.0)


def response_frequencies(model: Model, step: float | None = None, duration: float | None = None) -> Floats:
    """Frequencies at which a model is worth looking at: from one period in a record to half the sampling rate."""
    if step is not None and duration is not None:
        return np.geomspace(2 * math.pi / duration, math.pi / step, 240)
    corner = []
    for pairs in transfer_functions(model).denominator.values():
        (top, high), (bottom, low) = pairs[0], pairs[-1]
        corner.append(abs(bottom / top) ** (1 / (high - low)) if high > low else 1.0)
    middle = float(np.exp(np.mean(np.log(corner))))
    return np.geomspace(middle / 100, middle * 100, 240)


def bode_charts(model: Model, w: ArrayLike | None = None) -> list[Figure]:
    """Gain and phase of every output from every input that is not modelled, with 95 % bands where they are known.

    Parameters
    ----------
    model
        The model.
    w
        Frequencies [rad/s]; by default around the model's own.
    """
    omega = response_frequencies(model) if w is None else np.asarray(w, dtype=np.float64)
    figures = []
    for curve in bode_curves(model, omega):
        title = f"{symbol(curve.output)} from {symbol(curve.input)}"
        shade = "Shade: 95 % band, from the covariance of the fit." if curve.gain_spread is not None else ""
        for kind, values, spread, label in (
            ("gain", curve.gain, curve.gain_spread, "gain [dB]"),
            ("phase", curve.phase, curve.phase_spread, "phase [degrees]"),
        ):
            bands = [] if spread is None else [(values - spread, values + spread)]
            figures.append(
                line_chart(
                    omega, [("", values)], log_x=True, bands=bands, title=f"{title}: {kind}", width=SMALL, height=220,
                    x_label="frequency [rad/s]", y_label=label, caption=shade,
                )
            )  # fmt: skip
    return figures


@dataclass(frozen=True)
class BodeCurve:
    """Gain [dB] and phase [degrees] of one output from one input, and half-widths of their 95 % bands or None."""

    output: str
    input: str
    gain: Floats
    phase: Floats
    gain_spread: Floats | None
    phase_spread: Floats | None


def bode_curves(model: Model, omega: Floats) -> list[BodeCurve]:
    """Curves of all pairs in which the input reaches the output; Coulomb terms are not linear and have none."""
    response = frequency_response(model, omega)
    spread = None
    if model.estimate is not None and model.estimate.covariance is not None:
        spread = response_deviation(model, omega)
    inputs = response_inputs(model, coupled=True)
    curves = []
    for i, output in enumerate(model.outputs):
        for j, name in enumerate(inputs):
            h = response[i, j]
            if not np.any(h) or name.startswith(COULOMB):
                continue
            with np.errstate(divide="ignore", invalid="ignore"):
                gain = 20 * np.log10(np.abs(h))
            phase = np.degrees(np.unwrap(np.angle(np.where(np.isfinite(h), h, 1.0))))
            widths: tuple[Floats | None, Floats | None] = (None, None)
            if spread is not None:
                widths = (DECIBEL * NORMAL_95 * spread[0][i, j], np.degrees(NORMAL_95 * spread[1][i, j]))
            curves.append(BodeCurve(output, name, gain, phase, *widths))
    return curves
