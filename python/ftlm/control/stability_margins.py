"""Stability margins of sampled loops, from the exact frequency response of the model."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ftlm.analysis.frequency_response import (
    covariance_of,
    frequency_response,
    parameter_vector,
    response_inputs,
    transfer_functions,
    value_at,
    with_parameter_vector,
)
from ftlm.analysis.poles import stability
from ftlm.errors import ModelError
from ftlm.model.model import Model
from ftlm.utils.formatting import json_value
from ftlm.utils.validation import Complex, Floats, as_complex

#: Number of frequencies of a Nyquist curve, and its lowest frequency as a fraction of the crossover.
NYQUIST_POINTS = 1500
LOWEST_FREQUENCY_FRACTION = 1e-3


@dataclass(frozen=True)
class Margins:
    """Stability margins of a feedback loop with the loop transfer function L.

    Parameters
    ----------
    stable
        Whether the closed loop is stable, by the argument principle on 1 + L.
    crossover
        Highest frequency with abs(L) = 1 [rad/s]; NaN without one.
    phase
        Minimum phase margin over all frequencies with abs(L) = 1 [degrees]; 180 without one.
    gain
        Gain margin: smallest factor above 1 such that multiplying or dividing the loop gain by it makes L = -1 at some
        frequency; infinite without one.
    sensitivity
        Maximum sensitivity: largest abs(1/(1 + L)) over frequency.
    """

    stable: bool
    crossover: float
    phase: float
    gain: float
    sensitivity: float

    def __str__(self) -> str:
        if not self.stable:
            return "not stable"
        return (
            f"highest crossover {self.crossover:.4g} rad/s, smallest phase margin {self.phase:.3g} degrees, gain "
            f"margin {self.gain:.3g}, largest sensitivity {self.sensitivity:.3g}"
        )


class LoopDesign:
    """Base class of loop designs, with stability margins at the nominal parameters and at parameter samples.

    Parameter samples are drawn from the covariance of the model.
    """

    nominal: Margins
    samples: tuple[Margins, ...]

    @property
    def stable_fraction(self) -> float:
        """Fraction of the parameter samples for which the loop is stable; 1 without samples."""
        return sum(m.stable for m in self.samples) / len(self.samples) if self.samples else 1.0

    def margin_interval(self, what: Literal["crossover", "phase", "gain", "sensitivity"]) -> tuple[float, float]:
        """Return the central 95 % interval (low, high) of a margin over the parameter samples.

        `what` is the name of the margin. Without samples, both limits are the nominal value.
        """
        if not self.samples:
            value = getattr(self.nominal, what)
            return value, value
        low, high = np.quantile([getattr(m, what) for m in self.samples], [0.025, 0.975])
        return float(low), float(high)

    def _margins(self) -> dict[str, Any]:
        """Return the margins, nominal and for each parameter sample, as a dictionary for JSON."""
        return {"nominal": json_value(self.nominal), "samples": json_value(self.samples)}

    def _margin_lines(self) -> list[str]:
        """Return the margins as lines of text."""
        lines = [f"at the values: {self.nominal}"]
        if self.samples:
            phase, gain, peak = (self.margin_interval(n) for n in ("phase", "gain", "sensitivity"))
            lines.append(
                f"over the intervals ({len(self.samples)} samples, {100 * self.stable_fraction:.0f} % stable), 95 % "
                "between: "
                f"phase margin {phase[0]:.3g} and {phase[1]:.3g} degrees, gain margin {gain[0]:.3g} and {gain[1]:.3g}, "
                f"largest sensitivity {peak[0]:.3g} and {peak[1]:.3g}"
            )
        return lines


@dataclass(frozen=True)
class Plant:
    """Plant of a sampled feedback loop: a model from one input to one output.

    Parameters
    ----------
    model
        Model in continuous time.
    output, input
        Names of output and input.
    rate
         Sampling rate [Hz]. A command acts with one sample of delay and a zero-order hold.
    coupling, sensor
        As for :func:`ftlm.analysis.frequency_response`.
    """

    model: Model
    output: str
    input: str
    rate: float
    coupling: str
    sensor: bool = False

    def exact(self, w: Floats | Complex) -> Complex:
        """Return the frequency response of the continuous-time model at w [rad/s], shape (W,).

        Frequencies may be complex; s = jw.
        """
        if np.iscomplexobj(w):
            transfer = transfer_functions(self.model, coupling=self.coupling)
            s: Complex = 1j * as_complex("w", w)
            numerator, denominator = (
                value_at({p: c for c, p in pairs}, s)
                for pairs in (transfer.numerators[self.output, self.input], transfer.denominator[self.output])
            )
            return np.asarray(
                numerator / denominator * np.exp(-s * transfer.delay[self.input]) * self._filter_response(s)
            )
        inputs = response_inputs(self.model, coupled=self.coupling == "simulated")
        all_responses = frequency_response(self.model, w, coupling=self.coupling, sensor=self.sensor)
        return np.asarray(all_responses[self.model.outputs.index(self.output), inputs.index(self.input)])

    def _filter_response(self, s: Complex) -> Complex:
        """Return the factor by which the sensor filter changes the response at the points s; 1 without a filter."""
        filter_model = self.model.structure.sensor_filter if self.sensor else None
        if filter_model is None:
            return np.ones_like(s)
        numerator, denominator = (
            value_at({o: c for c, o in polynomial}, s)
            for polynomial in (filter_model.numerator, filter_model.denominator)
        )
        power = (self.output in filter_model.signals) - (self.input in filter_model.signals)
        return np.asarray((numerator / denominator) ** power)

    def held_response(self, w: Floats | Complex) -> Complex:
        """Return the frequency response with a zero-order hold of the input, at w [rad/s] below Nyquist frequency."""
        z_exponent = 1j * w / self.rate
        return np.asarray(self.exact(w) * -np.expm1(-z_exponent) / z_exponent)

    def response(self, w: Floats | Complex) -> Complex:
        """Return the frequency response with a zero-order hold and one sample of delay, at w [rad/s]."""
        return np.asarray(self.held_response(w) * np.exp(-1j * w / self.rate))

    def integral_order(self) -> float:
        """Return the order of the plant's pole at s = 0, which may be fractional and is negative for a zero.

        Raise ModelError if the output does not depend on the input.
        """
        (_, numerator_order), (_, denominator_order) = self._lowest_terms()
        return denominator_order - numerator_order

    def gain_sign(self) -> float:
        """Return the sign of the plant's gain at low frequencies, 1 or -1.

        Raise ModelError if the output does not depend on the input.
        """
        (numerator, _), (denominator, _) = self._lowest_terms()
        return math.copysign(1.0, numerator * denominator)

    def _lowest_terms(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return (coefficient, order) of the lowest terms of the numerator and of the denominator."""
        transfer = transfer_functions(self.model, coupling=self.coupling)
        numerator = transfer.numerators[self.output, self.input]
        if not numerator:
            raise ModelError(f"{self.input} does not affect {self.output} in this model; choose another pair")
        return numerator[-1], transfer.denominator[self.output][-1]

    def count_unstable_poles(self) -> float:
        """Return the number of poles of the model with a positive real part; NaN if a pole is on the imaginary axis."""
        result = stability(self.model, coupling=self.coupling)
        return math.nan if result.on_axis else result.unstable_poles

    def has_response(self) -> bool:
        """Whether the output depends on the input."""
        return bool(transfer_functions(self.model, coupling=self.coupling).numerators[self.output, self.input])

    def check_stable(self) -> None:
        """Raise ModelError if the model is unstable; an integrator is permitted."""
        unstable_poles = self.count_unstable_poles()
        if unstable_poles != 0:
            reason = (
                "a pole is on the imaginary axis"
                if math.isnan(unstable_poles)
                else f"{unstable_poles:g} of its poles are on the right"
            )
            raise ModelError(
                f"the model is not stable ({reason}), so stability margins of its loop are meaningless; stabilize the "
                "machine first, and identify the stabilized machine"
            )

    def samples(self, count: int, seed: int) -> list[Plant]:
        """Return `count` plants with parameters drawn from the covariance of the model; empty without a covariance."""
        matrix = covariance_of(self.model)
        if matrix is None:
            return []
        # A parameter that is not identifiable has an infinite variance, which is replaced by a large one.
        matrix = np.nan_to_num(matrix, nan=0.0, posinf=1e12, neginf=-1e12)
        values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
        covariance_root = vectors * np.sqrt(np.maximum(values, 0.0))
        shifts = np.random.default_rng(seed).standard_normal((count, len(values))) @ covariance_root.T
        mean_parameters = parameter_vector(self.model)
        return [replace(self, model=with_parameter_vector(self.model, mean_parameters + d)) for d in shifts]


def nyquist_frequencies(crossover: float, rate: float) -> Floats:
    """Return the frequencies [rad/s] of a Nyquist curve, ascending, up to just below the Nyquist frequency.

    `crossover` is the crossover frequency [rad/s] and `rate` the sampling rate [Hz].
    """
    return np.geomspace(LOWEST_FREQUENCY_FRACTION * crossover, 0.999 * math.pi * rate, NYQUIST_POINTS)


def margins_of(loop: Complex, w: Floats, integrates: float, unstable_poles: float = 0.0) -> Margins:
    """Return the stability margins of a loop from its frequency response on a fine grid of frequencies.

    Parameters
    ----------
    loop
        Loop transfer function L(jw), shape (W,).
    w
        Frequencies [rad/s], ascending, shape (W,).
    integrates
        Order of the pole of L at s = 0.
    unstable_poles
        Number of unstable poles of L; with NaN the loop counts as unstable.
    """
    if not np.isfinite(loop).all() or math.isnan(unstable_poles):
        return Margins(False, math.nan, math.nan, math.nan, math.inf)
    difference = 1.0 + loop
    unwrapped_phase = np.unwrap(np.angle(difference))
    # Number of unstable poles of the closed loop, from the phase of 1 + L over the upper half of the Nyquist contour
    # and over the upper half of the small circle around the origin.
    closed = unstable_poles + integrates / 2.0 - (unwrapped_phase[-1] - unwrapped_phase[0]) / math.pi
    log_gain, phase = np.log(np.abs(loop)), np.unwrap(np.angle(loop))
    at = np.flatnonzero(np.sign(log_gain[:-1]) != np.sign(log_gain[1:]))
    fraction = log_gain[at] / (log_gain[at] - log_gain[at + 1])
    phases = np.degrees(phase[at] + fraction * (phase[at + 1] - phase[at]))
    crossings = np.exp(np.log(w[at]) + fraction * np.log(w[at + 1] / w[at]))
    away = np.abs((phases + 360.0) % 360.0 - 180.0)
    revolutions = np.floor((phase / math.pi + 1.0) / 2.0)
    cut = np.flatnonzero(revolutions[:-1] != revolutions[1:])
    edge = math.pi * (2.0 * np.maximum(revolutions[cut], revolutions[cut + 1]) - 1.0)
    interpolation = (edge - phase[cut]) / (phase[cut + 1] - phase[cut])
    gains = np.exp(np.abs(log_gain[cut] + interpolation * (log_gain[cut + 1] - log_gain[cut])))
    return Margins(
        bool(round(closed) == 0),
        float(crossings[-1]) if at.size else math.nan,
        float(np.min(away, initial=180.0)),
        float(np.min(gains, initial=math.inf)),
        float(np.max(1.0 / np.abs(difference))),
    )
