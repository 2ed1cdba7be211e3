"""Measured and modelled frequency responses as charts: gain and phase, the locus in the plane, what is left over."""

from __future__ import annotations

import numpy as np

from ftlm.base.arrays import Complex, Floats
from ftlm.base.statistics import NORMAL_95
from ftlm.data.response import FrequencyData
from ftlm.model.model import Model
from ftlm.paint.figure import SMALL, Figure
from ftlm.paint.lines import line_chart
from ftlm.paint.locus import locus_chart
from ftlm.paint.text import symbol
from ftlm.solve.frequency import frequency_response, response_deviation, response_inputs

DECIBEL = 20.0 / np.log(10.0)
#: Points of a smooth curve between the ends of what was measured.
CURVE = 160


def grid_of(record: FrequencyData) -> tuple[Floats, Floats]:
    """Frequencies of a smooth curve with those of a record among them, and where the record's are (else NaN).

    Between two that were measured lies one that was not, so that each measured point stands alone, as a dot.
    """
    measured = np.unique(record.frequency)
    between = np.sqrt(measured[1:] * measured[:-1])
    smooth = np.geomspace(measured[0], measured[-1], CURVE) if measured.size > 1 else measured
    return np.unique(np.concatenate([measured, between, smooth])), measured


def curve_of(model: Model, record: FrequencyData, omega: Floats) -> tuple[Complex, Floats | None, Floats | None]:
    """Response of the model, and half-widths of the 95 % bands of its gain [dB] and phase [degrees]."""
    at = model.outputs.index(record.output), response_inputs(model, coupled=True).index(record.input)
    response = frequency_response(model, omega)[at]
    if model.estimate is None or model.estimate.covariance is None:
        return response, None, None
    gain, phase = (part[at] for part in response_deviation(model, omega))
    return response, DECIBEL * NORMAL_95 * gain, np.degrees(NORMAL_95 * phase)


def bode_of(model: Model, record: FrequencyData) -> list[Figure]:
    """Gain and phase of a record with the model's and its 95 % band."""
    omega, _ = grid_of(record)
    response, wide, turned = curve_of(model, record, omega)
    phase = np.degrees(np.unwrap(np.angle(response)))
    order = np.argsort(record.frequency, kind="stable")
    place = np.searchsorted(omega, record.frequency[order])
    title = f"{symbol(record.output)} from {symbol(record.input)}, {record.name}"
    shade = "" if wide is None else "Shade: 95 % band, from the covariance of the fit."
    angles = record.phase[order]
    # Whole turns are no difference.
    angles = angles - 360.0 * np.round(np.median(angles - phase[place]) / 360.0)
    size = f"gain [dB of {record.unit}]" if record.unit else "gain [dB]"
    figures = []
    for kind, label, ours, theirs, half in (
        ("gain", size, DECIBEL * np.log(np.abs(response)), record.gain[order], wide),
        ("phase", "phase [degrees]", phase, angles, turned),
    ):
        dots = np.full(omega.size, np.nan)
        dots[place] = theirs
        bands = [] if half is None else [(ours - half, ours + half)]
        figures.append(
            line_chart(
                omega, [("model", ours), ("measured", dots)], log_x=True, bands=bands, title=f"{title}: {kind}",
                dots=("measured",), width=SMALL, height=220, x_label="frequency [rad/s]", y_label=label, caption=shade,
            )
        )  # fmt: skip
    return figures


def locus_of(model: Model, record: FrequencyData) -> Figure:
    """The response in the complex plane; of impedances with -Im upwards, as chemists draw it."""
    omega, _ = grid_of(record)
    response, _, _ = curve_of(model, record, omega)
    impedance = record.unit.endswith("Ω")
    unit = f" [{record.unit}]" if record.unit else ""
    upward = -1.0 if impedance else 1.0
    title = f"{symbol(record.output)} from {symbol(record.input)}, {record.name}: Nyquist"
    words = ("Re Z", "−Im Z") if impedance else ("real part", "imaginary part")
    return locus_chart(
        response.real + 1j * upward * response.imag, record.response.real + 1j * upward * record.response.imag,
        title=title, x_label=words[0] + unit, y_label=words[1] + unit,
    )  # fmt: skip


def misses_of(model: Model, record: FrequencyData) -> Figure:
    """What is left over at each frequency, over the size of the measured response."""
    order = np.argsort(record.frequency, kind="stable")
    omega = record.frequency[order]
    response, _, _ = curve_of(model, record, omega)
    size = np.abs(record.response[order])
    missed = 100.0 * (response - record.response[order]) / np.where(size > 0, size, np.max(size) or 1.0)
    return line_chart(
        omega, [("real part", missed.real), ("imaginary part", missed.imag)], log_x=True, width=SMALL, height=220,
        title=f"{symbol(record.output)} from {symbol(record.input)}, {record.name}: residuals",
        x_label="frequency [rad/s]", y_label="model − measured [% of size]",
    )  # fmt: skip
