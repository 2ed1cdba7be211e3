"""Frequency responses as matplotlib objects: measured points beside the model's curve."""

from __future__ import annotations

from typing import Any

import numpy as np

from ftlm.base.errors import ModelError
from ftlm.data.response import FrequencyData
from ftlm.identification.frequency_charts import DECIBEL, curve_of, grid_of
from ftlm.identification.frequency_result import FrequencyIdentification, FrequencyValidation, placed
from ftlm.model.model import Model
from ftlm.paint.lines import LINES
from ftlm.paint.text import symbol
from ftlm.report.canvas import axes_for, plain


def response(
    result: FrequencyIdentification | Model, data: FrequencyData | FrequencyValidation | None = None, *, ax: Any = None
) -> Any:
    """Gain and phase of measured responses with the model's curve and its 95 % band.

    Parameters
    ----------
    result
        What :func:`ftlm.identify_frequency` found, or a model.
    data
        Responses to draw; by default those of the fit. A model needs some.
    ax
        Axes to draw into, as many as the figure would have; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        Gain on the left, phase on the right, a row for every record.

    Raises
    ------
    ModelError
        Something that is no result, a model without data, axes that are none or too many or few, or no matplotlib.
    DataError
        Data of signals that the model does not have.
    """
    model, records = _given(result, data)
    figure, axes = axes_for(ax, len(records), 2)
    for (left, right), record in zip(axes, records, strict=True):
        omega, _ = grid_of(record)
        ours, wide, turned = curve_of(model, record, omega)
        phase = np.degrees(np.unwrap(np.angle(ours)))
        order = np.argsort(record.frequency, kind="stable")
        near = phase[np.searchsorted(omega, record.frequency[order])]
        angles = record.phase[order]
        angles = angles - 360.0 * np.round(np.median(angles - near) / 360.0)
        gain = DECIBEL * np.log(np.abs(ours))
        unit = f" of {record.unit}" if record.unit else ""
        for axis, curve, dots, half, label in (
            (left, gain, record.gain[order], wide, f"gain [dB{unit}]"),
            (right, phase, angles, turned, "phase [degrees]"),
        ):
            axis.semilogx(record.frequency[order], dots, "o", fillstyle="none", markersize=4, color=LINES[0][0],
                          label="measured")  # fmt: skip
            axis.semilogx(omega, curve, color=LINES[1][0], linewidth=1.2, label="model")
            if half is not None:
                axis.fill_between(omega, curve - half, curve + half, color=LINES[1][0], alpha=0.25, linewidth=0)
            axis.set(xlabel="frequency [rad/s]", ylabel=label)
            axis.set_title(plain(f"{symbol(record.output)} from {symbol(record.input)}"), fontsize="small")
            axis.grid(visible=True, alpha=0.3)
        left.legend(fontsize="small")
    return figure


def nyquist(
    result: FrequencyIdentification | Model, data: FrequencyData | FrequencyValidation | None = None, *, ax: Any = None
) -> Any:
    """Measured responses in the complex plane with the model's curve, one unit in both directions.

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
    model, records = _given(result, data)
    figure, axes = axes_for(ax, len(records), row=3.4)
    for axis, record in zip(axes[:, 0], records, strict=True):
        curve, _, _ = curve_of(model, record, grid_of(record)[0])
        impedance = record.unit.endswith("Ω")
        upward = -1.0 if impedance else 1.0
        axis.plot(record.response.real, upward * record.response.imag, "o", fillstyle="none", markersize=4,
                  color=LINES[0][0], label="measured")  # fmt: skip
        axis.plot(curve.real, upward * curve.imag, color=LINES[1][0], linewidth=1.2, label="model")
        unit = f" [{record.unit}]" if record.unit else ""
        words = ("Re Z", "−Im Z") if impedance else ("real part", "imaginary part")
        axis.set(xlabel=words[0] + unit, ylabel=words[1] + unit)
        axis.set_aspect("equal", adjustable="datalim")
        axis.set_title(plain(f"{symbol(record.output)} from {symbol(record.input)}"), fontsize="small")
        axis.grid(visible=True, alpha=0.3)
        axis.legend(fontsize="small")
    return figure


def _given(
    result: FrequencyIdentification | Model, data: FrequencyData | FrequencyValidation | None
) -> tuple[Model, list[FrequencyData]]:
    """The model and the records that were meant."""
    if not isinstance(result, (FrequencyIdentification, Model)):
        raise ModelError(f"result is {type(result).__name__}; give what identify_frequency returns, or a model")
    if isinstance(result, FrequencyIdentification):
        model, records = result.model, list(result.data)
    else:
        model, records = result, []
    if isinstance(data, FrequencyValidation):
        records = list(data.data)
    elif isinstance(data, FrequencyData):
        records = [placed(model, data)]
    elif data is not None:
        raise ModelError(f"data is {type(data).__name__}; give frequency data, such as load_frequency returns")
    if not records:
        raise ModelError("a model alone has no measured points; give data, such as load_frequency returns")
    return model, records
