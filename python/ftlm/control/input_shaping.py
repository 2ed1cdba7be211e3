"""Zero-vibration (ZV) and ZV-derivative (ZVD) input shapers for the oscillatory modes of a model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ftlm.analysis.poles import Mode
from ftlm.analysis.poles import modes as model_modes
from ftlm.control.arguments import checked_rate
from ftlm.errors import DataError, ModelError
from ftlm.model.model import Model
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import attributes, with_error
from ftlm.utils.parameters import parameter, setting
from ftlm.utils.statistics import NORMAL_95
from ftlm.utils.validation import Floats, as_array, as_floats, check_choice, check_integer, short_repr

#: Number of times that the ZV shaper is convolved for each kind, which is the multiplicity of its zero at the pole.
SHAPER_REPETITIONS = {"zv": 1, "zvd": 2}
#: Maximum permitted residual vibration over the confidence intervals of the poles, relative to an unshaped step.
MAX_RESIDUAL_VIBRATION = 0.2
#: Maximum length of a shaper [samples], and permitted range of the magnitude of poles [rad/s].
MAX_SHAPER_SAMPLES = 1 << 22
POLE_RANGE_RAD_S = (1e-12, 1e12)
#: Number of grid points over the confidence interval of the frequency, and over that of the damping.
INTERVAL_GRID_POINTS = 9


@check_arguments
@dataclass(frozen=True)
class Shaper:
    """Input shaper: a sequence of impulses with sum 1 that excites no residual vibration of given modes.

    Parameters
    ----------
    kind
        ``"zv"``: zero vibration. ``"zvd"``: in addition, zero derivative of the vibration with respect to the pole,
        with twice the delay.
    modes
        Modes that the shaper does not excite.
    times, amplitudes
        Times [s] and amplitudes of the impulses in continuous time.
    max_residual_vibration
        Maximum residual vibration for frequencies and dampings within the 95 % intervals of the modes, relative to an
        unshaped step. None if the modes have no intervals.
    """

    kind: str
    modes: tuple[Mode, ...]
    times: tuple[float, ...]
    amplitudes: tuple[float, ...]
    max_residual_vibration: float | None

    @property
    def delay(self) -> float:
        """Time of the last impulse [s], by which the shaper delays the end of a reference."""
        return self.times[-1]

    def residual_vibration(self, frequency: ArrayLike, damping: ArrayLike) -> Floats:
        """Return the amplitude of the vibration of a mode after a shaped step, relative to that after an unshaped step.

        The arguments are broadcast.

        Parameters
        ----------
        frequency
            Undamped natural frequencies of the mode [rad/s].
        damping
            Damping ratios of the mode.
        """
        return residual_vibration(np.array(self.times), np.array(self.amplitudes), frequency, damping)

    def impulses(self, rate: float) -> Floats:
        """Return the shaper at a sampling rate [Hz] as the amplitude at each sample, shape (N,), with sum 1.

        The sampled shaper has exact zeros at the poles of the modes. For this, an impulse between two samples is
        divided between them such that the excited vibration does not change. Linear interpolation would change it.

        Raises
        ------
        ModelError
            If the rate is invalid, has fewer than four samples per period of a mode, or makes the shaper longer than 4
            million samples.
        """
        rate = checked_rate(rate)
        if self.delay * rate > MAX_SHAPER_SAMPLES:
            raise ModelError(
                f"{setting('rate')} {rate:g} Hz makes the shaper {self.delay * rate:.3g} samples long; use at most "
                f"{MAX_SHAPER_SAMPLES / self.delay:.3g} Hz"
            )
        taps = np.ones(1)
        for mode in self.modes:
            if mode.pole.imag * 2.0 > math.pi * rate:
                raise ModelError(
                    f"{setting('rate')} {rate:g} Hz has fewer than four samples in a period of the mode at "
                    f"{mode.frequency:.4g} rad/s; use at least {2.0 * mode.pole.imag / math.pi:.3g} Hz"
                )
            mode_impulses = _zv_samples(mode, 1.0 / rate)
            for _ in range(SHAPER_REPETITIONS[self.kind]):
                taps = _convolve(np.append(taps, np.zeros(len(mode_impulses) - 1)), mode_impulses)
        return taps

    def filter(self, reference: ArrayLike, rate: float) -> Floats:
        """Return a reference filtered by the shaper, with the same shape.

        Before its first row, the reference is assumed to be constant. The filtered reference reaches its final value
        later by `delay`, so the reference should end with a constant part of at least this duration.

        Parameters
        ----------
        reference
            Reference with one row per sample, shape (rows,) or (rows, columns).
        rate
            Sampling rate [Hz].

        Raises
        ------
        DataError
            If the reference has another shape or a value that is not finite.
        ModelError
            If the rate is invalid; see :meth:`impulses`.
        """
        values = as_array("reference", reference)
        if values.dtype.kind not in "fiu" or values.ndim not in (1, 2) or values.size == 0:
            raise DataError("reference is not an array of numbers; give one of shape (rows,) or (rows, columns)")
        x = as_floats("reference", values).reshape(len(values), -1)
        invalid_rows = np.flatnonzero(~np.isfinite(x).all(axis=1))
        if invalid_rows.size:
            raise DataError(
                f"reference is not finite at row {invalid_rows[0]} ({invalid_rows.size} such rows in all); give "
                "finite numbers"
            )
        taps = self.impulses(rate)
        initial_value = x[0]
        shaped = np.column_stack([_convolve(column, taps) for column in (x - initial_value).T]) + initial_value
        return np.asarray(shaped.reshape(values.shape), dtype=np.float64)

    def to_dict(self) -> dict[str, Any]:
        """Return kind, impulses, modes and residual vibration as a dictionary for JSON."""
        modes = [[m.frequency, m.damping] for m in self.modes]
        return attributes(self, ("kind", "times", "amplitudes")) | {
            "modes": modes,
            "max_residual_vibration": self.max_residual_vibration,
        }

    def __str__(self) -> str:
        impulses_text = ", ".join(f"{a:.4g} at {t:.4g} s" for a, t in zip(self.amplitudes, self.times, strict=True))
        worst_text = (
            ""
            if self.max_residual_vibration is None
            else f"; within their intervals at most {100 * self.max_residual_vibration:.2g} % is left"
        )
        modes_text = ", ".join(map(str, self.modes))
        return f"{self.kind.upper()} shaper of {modes_text}: {impulses_text}{worst_text}"


@check_arguments
def input_shaper(
    model: Model | complex,
    kind: Literal["zv", "zvd"] = "zv",
    *,
    modes: int = 1,
    coupling: Literal["simulated", "measured"] = "simulated",
) -> Shaper:
    """Design an input shaper for the least damped modes of a model of any orders.

    Parameters
    ----------
    model
        Model whose least damped modes are shaped, or a single pole [rad/s] such as ``-2 + 17j``.
    kind
        ``"zv"``: zero-vibration shaper (Smith's posicast), with a delay of half a period. ``"zvd"``: shaper with a
        delay of a full period, on which errors of the pole have only a second-order effect.
    modes
        Number of modes that are shaped, the least damped first. Their delays are added.
    coupling
        ``"simulated"``: the modes are poles of the coupled equations. ``"measured"``: they are poles of each equation
        alone, as for a flexible link on a hub that follows a stiff position loop.

    Returns
    -------
    Shaper
        Impulses and their residual vibration.

    Raises
    ------
    ModelError
        If the model is unstable, has friction or too few oscillatory modes, or its poles are so uncertain that the
        residual vibration may exceed 20 %.

    Notes
    -----
    Source: Singer and Seering (1990), doi:10.1115/1.2894142. In addition to its oscillation, the response of a
    fractional model has a component that decays as a power of time. It is not a vibration, and no shaper cancels it.
    """
    check_choice("kind", kind, SHAPER_REPETITIONS)
    count = check_integer("modes", modes, 1)
    if isinstance(model, (complex, float, int, np.number)):
        all_modes: tuple[Mode, ...] = (_mode_of(model),)
    else:
        all_modes = model_modes(model, coupling=coupling)
    unstable = [m for m in all_modes if m.unstable or m.damping <= 0.0]
    if unstable:
        raise ModelError(
            f"the model is not stable ({unstable[0]}), so its response cannot be shaped; close a loop around it, and "
            "shape the poles of the loop"
        )
    oscillatory = sorted((m for m in all_modes if m.oscillatory), key=lambda m: m.damping)
    if len(oscillatory) < count:
        raise ModelError(
            f"{short_repr(count)} modes are to be shaped, but {len(oscillatory)} modes of the model oscillate, and "
            "only these need a shaper; give at most this number"
        )
    modes_used = tuple(oscillatory[:count])
    times, amplitudes = np.zeros(1), np.ones(1)
    for mode in modes_used:
        half, decay = _half(mode)
        for _ in range(SHAPER_REPETITIONS[kind]):
            times = np.concatenate([times, times + half])
            amplitudes = np.concatenate([amplitudes, amplitudes * decay]) / (1.0 + decay)
    instants, time_index = np.unique(np.round(times, 15), return_inverse=True)
    summed = np.bincount(time_index, weights=amplitudes)
    worst_residual = _worst_residual(
        np.asarray(instants, dtype=np.float64), np.asarray(summed, dtype=np.float64), modes_used
    )
    if worst_residual is not None and not worst_residual <= MAX_RESIDUAL_VIBRATION:
        widest = max(modes_used, key=lambda m: (m.frequency_error or 0.0) / m.frequency + (m.damping_error or 0.0))
        raise ModelError(
            f"the poles are too uncertain for a shaper: within the intervals of the mode at "
            f"{with_error(widest.frequency, widest.frequency_error)} rad/s, damping "
            f"{with_error(widest.damping, widest.damping_error)}, a {kind} shaper may leave "
            f"{100 * worst_residual:.0f} % of the "
            f"vibration, more than {100 * MAX_RESIDUAL_VIBRATION:.0f} %; identify from a longer run, or from one "
            "that excites this mode" + (f", or use {parameter('kind', 'zvd')}" if kind == "zv" else "")
        )
    return Shaper(kind, modes_used, tuple(instants.tolist()), tuple(summed.tolist()), worst_residual)


def residual_vibration(times: Floats, amplitudes: Floats, frequency: ArrayLike, damping: ArrayLike) -> Floats:
    """Return the amplitude of vibration after the last of several impulses, relative to one unit impulse at that time.

    `times` [s] and `amplitudes` define the impulses. `frequency` [rad/s] and `damping` of the mode are broadcast. Raise
    DataError if one is out of range.
    """
    w, z = np.broadcast_arrays(as_floats("frequency", frequency), as_floats("damping", damping))
    if not (np.all(np.abs(w) < POLE_RANGE_RAD_S[1]) and np.all(np.abs(z) <= 1.0)):
        raise DataError("frequency or damping is out of range; give rad/s, finite, and damping ratios from -1 to 1")
    pole = w * (-z + 1j * np.sqrt(np.maximum(1.0 - z * z, 0.0)))
    phasors = np.sum(amplitudes * np.exp(pole[..., None] * (times[-1] - times)), axis=-1)
    return np.asarray(np.abs(phasors), dtype=np.float64)


def _convolve(x: Floats, taps: Floats) -> Floats:
    """Return the convolution of a signal x with a filter of few nonzero taps, truncated to the length of x."""
    out = np.zeros(len(x))
    for at in np.flatnonzero(taps[: len(x)]):
        out[at:] += taps[at] * x[: len(x) - at]
    return out


def _mode_of(value: complex | np.number[Any]) -> Mode:
    try:
        pole = complex(value)
        magnitude = abs(pole)
    except (TypeError, ValueError, OverflowError):
        pole, magnitude = complex("nan"), math.nan
    low, high = POLE_RANGE_RAD_S
    if not (low <= abs(pole.imag) and magnitude <= high):
        raise ModelError(f"pole = {short_repr(value)} does not oscillate; give a complex pole such as -2 + 17j [rad/s]")
    decay_rate = abs(pole.real)
    return Mode(
        complex(pole.real, abs(pole.imag)),
        magnitude,
        -pole.real / magnitude,
        1 / decay_rate if decay_rate else math.inf,
        True,
    )


def _half(mode: Mode) -> tuple[float, float]:
    """Return half the damped period of a mode [s], and the factor by which its amplitude decays in this time."""
    half = math.pi / mode.pole.imag
    return half, math.exp(mode.pole.real * half)


def _zv_samples(mode: Mode, step: float) -> Floats:
    """Return the zero-vibration shaper of a mode as amplitudes at samples, with sum 1 and a zero at the mode's pole.

    `step` is the sampling interval [s].
    """
    half, decay_ratio = _half(mode)
    whole_samples = math.floor(half / step)
    remainder = half - whole_samples * step
    # sooner + later e^(-s step) = e^(-s rest) at the pole s. Both are positive if the pole is below half the rate.
    decay, angular_frequency = mode.pole.real, mode.pole.imag
    second_amplitude = (
        math.exp(decay * (step - remainder))
        * math.sin(angular_frequency * remainder)
        / math.sin(angular_frequency * step)
    )
    sooner = (
        math.exp(-decay * remainder)
        * math.sin(angular_frequency * (step - remainder))
        / math.sin(angular_frequency * step)
    )
    taps = np.zeros(whole_samples + 2)
    taps[0] = 1.0
    taps[whole_samples] += decay_ratio * sooner
    taps[whole_samples + 1] += decay_ratio * second_amplitude
    return np.asarray(taps / taps.sum())


def _worst_residual(times: Floats, amplitudes: Floats, modes: tuple[Mode, ...]) -> float | None:
    """Return the largest residual vibration over the 95 % intervals of frequency and damping of the modes.

    Return None if no mode has intervals.
    """
    largest_residual: float | None = None
    for mode in modes:
        if mode.frequency_error is None or mode.damping_error is None:
            continue
        across = NORMAL_95 * np.linspace(-1.0, 1.0, INTERVAL_GRID_POINTS)
        w = np.maximum(mode.frequency + mode.frequency_error * across, 1e-6 * mode.frequency)
        z = np.clip(mode.damping + mode.damping_error * across, -0.99, 0.99)
        vibration = residual_vibration(times, amplitudes, w[:, None], z)
        largest_residual = max(
            largest_residual or 0.0, float(np.max(np.where(np.isfinite(vibration), vibration, np.inf)))
        )
    return largest_residual
