"""Charts of a model: Bode plot, poles, step and impulse response."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from ftlm.analysis.frequency_response import (
    covariance_of,
    frequency_response,
    response_deviation,
    response_inputs,
    transfer_functions,
)
from ftlm.analysis.poles import modes
from ftlm.analysis.time_response import Response, response
from ftlm.estimation.frequency_result import DECIBELS_PER_NEPER, frequency_chart
from ftlm.model.model import Model, check_model
from ftlm.plot.comparison_charts import with_unit
from ftlm.simulation.discretization import COULOMB_PREFIX
from ftlm.svg.charts import PlaneChart
from ftlm.svg.figure import SMALL_WIDTH_PX, Figure
from ftlm.svg.line_chart import LineChart
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import symbol
from ftlm.utils.statistics import NORMAL_95
from ftlm.utils.validation import Complex, Floats, as_floats


def response_frequencies(model: Model, step: float | None = None, duration: float | None = None) -> Floats:
    """Return 240 logarithmically spaced frequencies [rad/s] for a Bode plot.

    For runs with a sampling interval `step` [s] and a duration [s], they range from one period per run to the Nyquist
    frequency. Otherwise they cover two decades on each side of the mean corner frequency of the model.
    """
    if step is not None and duration is not None:
        return np.geomspace(2 * math.pi / duration, math.pi / step, 240)
    corners = []
    for pairs in transfer_functions(model).denominator.values():
        (highest, high), (lowest, low) = pairs[0], pairs[-1]
        corners.append(abs(lowest / highest) ** (1 / (high - low)) if high > low else 1.0)
    mean_corner = float(np.exp(np.mean(np.log(corners))))
    return np.geomspace(mean_corner / 100, mean_corner * 100, 240)


@check_arguments
def bode_charts(model: Model, w: ArrayLike | None = None) -> list[LineChart]:
    """Return gain and phase charts for every pair of output and external input.

    They include 95 % bands if the model has a covariance.

    Parameters
    ----------
    model
        Model.
    w
        Frequencies [rad/s]; by default around the corner frequencies of the model.
    """
    omega = response_frequencies(model) if w is None else as_floats("w", w)
    return curve_charts(omega, bode_curves(model, omega))


def curve_charts(omega: Floats, curves: Sequence[BodeCurve]) -> list[LineChart]:
    """Return a gain chart and a phase chart for every Bode curve; `omega` are the frequencies [rad/s] of all curves."""
    charts = []
    for curve in curves:
        title = f"{symbol(curve.output)} from {symbol(curve.input)}"
        gain, phase = [("", curve.gain)], [("", curve.phase)]
        charts.append(frequency_chart(f"{title}: gain", "gain [dB]", omega, gain, curve.gain_band))
        charts.append(frequency_chart(f"{title}: phase", "phase [degrees]", omega, phase, curve.phase_band))
    return charts


def pole_points(model: Model) -> tuple[float, Complex]:
    """Return the order q of the pole plane s^q, and the poles as complex values in this plane.

    The array of poles is empty for a nonlinear model.
    """
    q = plane_order(model)
    model_modes = modes(model) if model.structure.is_linear else ()
    points = []
    for m in model_modes:
        angle = math.acos(max(-1.0, min(1.0, -m.damping)))
        # The zero of a relaxation of fractional order may have |arg s| > pi. It is drawn on the negative axis of s^q.
        pole_angle = math.pi if not m.oscillatory and not m.unstable else q * angle
        value = m.frequency**q * complex(math.cos(pole_angle), math.sin(pole_angle))
        points += [value, value.conjugate()] if m.oscillatory else [complex(value.real)]
    return q, np.array(points, dtype=np.complex128)


@check_arguments
def pole_charts(model: Model) -> list[PlaneChart]:
    """Return a list with the pole chart in the plane of s^q, in which the unstable sector is shaded.

    The list is empty for a model with friction or without poles. The order q is 1 for integer orders, otherwise the
    highest order divided by the next higher integer.

    Parameters
    ----------
    model
        Model; it need not be linear.
    """
    q, points = pole_points(model)
    if not points.size:
        return []
    model_modes = modes(model)
    plane = "s" if q == 1 else f"s^{q:.4g}"
    unstable_count = sum(m.unstable for m in model_modes)
    texts = (
        "it has no pole"
        if not unstable_count
        else f"it has {unstable_count} of {len(model_modes)} modes, so the model is not stable"
    )
    caption = f"Shade: |arg {plane}| < {90 * q:.4g} degrees, the unstable sector; {texts}."
    if q != 1:
        caption += f" A relaxation is drawn at −T^−{q:.4g}."
    unit = "rad/s" if q == 1 else f"(rad/s)^{q:.4g}"
    return [
        PlaneChart(
            points.tolist(),
            title=f"Poles in the plane of {plane}",
            x_label=f"real part of {plane} [{unit}]",
            y_label=f"imaginary part [{unit}]",
            sector=q * math.pi / 2,
            caption=caption,
        )
    ]


def plane_order(model: Model) -> float:
    """Return the order q of the pole plane s^q: 1 for integer orders, otherwise between 0.5 and 1."""
    orders = [e.order.constant for e in model.equations]
    orders += [t.order.constant for e in model.equations for t in e.terms]
    highest = max(orders)
    is_integer = all(abs(o - round(o)) < 1e-9 for o in orders) or highest <= 0
    return 1.0 if is_integer else round(highest / math.ceil(highest - 1e-9), 4)


@dataclass(frozen=True)
class BodeCurve:
    """Gain [dB] and phase [degrees] over frequency from one input to one output.

    `gain_band` and `phase_band` are half-widths of the 95 % confidence band in the same units, or None without a
    covariance.
    """

    output: str
    input: str
    gain: Floats
    phase: Floats
    gain_band: Floats | None
    phase_band: Floats | None


def bode_curves(model: Model, omega: Floats) -> list[BodeCurve]:
    """Return the Bode curve of every pair of input and output with a nonzero response at frequencies `omega` [rad/s].

    Friction forces, which are inputs of the linear part, are omitted.
    """
    response = frequency_response(model, omega)
    deviation = None if covariance_of(model) is None else response_deviation(model, omega)
    inputs = response_inputs(model, coupled=True)
    curves = []
    for i, output in enumerate(model.outputs):
        for j, name in enumerate(inputs):
            h = response[i, j]
            if not np.any(h) or name.startswith(COULOMB_PREFIX):
                continue
            with np.errstate(divide="ignore", invalid="ignore"):
                gain = 20 * np.log10(np.abs(h))
            phase = np.degrees(np.unwrap(np.angle(np.where(np.isfinite(h), h, 1.0))))
            half_widths: tuple[Floats | None, Floats | None] = (None, None)
            if deviation is not None:
                half_widths = (
                    DECIBELS_PER_NEPER * NORMAL_95 * deviation[0][i, j],
                    np.degrees(NORMAL_95 * deviation[1][i, j]),
                )
            curves.append(BodeCurve(output, name, gain, phase, *half_widths))
    return curves


@dataclass(frozen=True)
class Bode:
    """Result of :meth:`ftlm.Model.bode`: frequency responses with their charts.

    Parameters
    ----------
    frequency
        Frequencies [rad/s], shape (W,).
    curves
        Gain [dB] and phase [degrees] with half-widths of their 95 % bands, for every pair of input and output with a
        nonzero response.
    """

    frequency: Floats
    curves: tuple[BodeCurve, ...]

    def figures(self) -> list[Figure]:
        """Return the SVG charts of the result, as a report shows them."""
        return [*curve_charts(self.frequency, self.curves)]

    def __str__(self) -> str:
        pairs = ", ".join(f"{c.output} from {c.input}" for c in self.curves) or "no input affects an output"
        return f"Bode: {pairs}; {self.frequency.size} frequencies from {self.frequency[0]:.4g} rad/s to " + (
            f"{self.frequency[-1]:.4g} rad/s"
        )

    def _repr_html_(self) -> str:
        return "".join(f._repr_html_() for f in self.figures())


def bode(model: Model, w: ArrayLike | None = None) -> Bode:
    """Return the frequency response of a model with charts; see :meth:`ftlm.Model.bode`."""
    check_model(model)
    omega = response_frequencies(model) if w is None else as_floats("w", w)
    return Bode(omega, tuple(bode_curves(model, omega)))


@check_arguments
def response_charts(result: Response, *, units: Mapping[str, str] | None = None) -> list[LineChart]:
    """Return a chart of the step or impulse response of every pair of input and output with a nonzero response.

    The charts include 95 % bands if standard deviations are known.

    Parameters
    ----------
    result
        Responses with their sample times and standard deviations.
    units
        Units of the signals by name.
    """
    return [
        response_chart(result, i, j, units or {})
        for i in range(len(result.outputs))
        for j, signal in enumerate(result.inputs)
        if np.any(result.values[i, j]) and not signal.startswith(COULOMB_PREFIX)
    ]


def response_chart(response: Response, i: int, j: int, units: Mapping[str, str]) -> LineChart:
    """Return the chart of the response of output i to input j (indices), with its 95 % band if it is known."""
    output, values = response.outputs[i], response.values[i, j]
    bands, caption = [], "No covariance, so there is no band."
    if response.deviation is not None:
        half = NORMAL_95 * response.deviation[i, j]
        bands, caption = [(values - half, values + half)], "Shade: 95 % band, from the covariance of the fit."
    return LineChart(
        response.time,
        [("", values)],
        title=f"{symbol(output)} after a unit {response.kind} of {symbol(response.inputs[j])}",
        x_label="time [s]",
        y_label=with_unit(symbol(output), units, output),
        caption=caption,
        bands=bands,
        width=SMALL_WIDTH_PX,
        height=220,
    )


@dataclass(frozen=True)
class TimeResponse(Response):
    """Result of :meth:`ftlm.Model.step` or :meth:`ftlm.Model.impulse`: responses with their charts.

    Parameters
    ----------
    kind, outputs, inputs, time, values, deviation, final_values
        In this sequence: ``"step"`` or ``"impulse"``; names of outputs; names of inputs; sample times [s], shape (N,);
        responses, shape (outputs, inputs, N); their standard deviations in the same shape, or None; final values of
        step responses by (output, input), as (value, standard error). An impulse response is a mean over each sampling
        interval, at the middle of the interval.
    units
        Units of the signals by name.
    """

    units: Mapping[str, str] = field(default_factory=dict)

    def figures(self) -> list[Figure]:
        """Return the SVG charts of the result, as a report shows them."""
        return [*response_charts(self, units=self.units)]

    def __str__(self) -> str:
        lines = [f"{self.kind} response, {self.time.size} samples to {self.time[-1]:.4g} s"]
        for i, output in enumerate(self.outputs):
            for j, signal in enumerate(self.inputs):
                values = self.values[i, j]
                peak = int(np.argmax(np.abs(values)))
                final_value, error = values[-1], None if self.deviation is None else self.deviation[i, j, -1]
                name = f"value at {self.time[-1]:.4g} s"
                if (output, signal) in self.final_values:
                    (final_value, error), name = self.final_values[output, signal], "final value"
                uncertainty = f" ± {error:.2g}" if error else ""
                lines.append(
                    f"  {output} from {signal}: {name} {final_value:.5g}{uncertainty}, "
                    f"peak {values[peak]:.5g} at {self.time[peak]:.4g} s"
                )
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return "".join(f._repr_html_() for f in self.figures())


def time_response(model: Model, time: ArrayLike | None, kind: str) -> TimeResponse:
    """Return the responses of a model for `kind` "step" or "impulse", with charts; see :meth:`ftlm.Model.step`."""
    result = response(model, time, kind=kind)
    return TimeResponse(**vars(result), units=dict(model.units))
