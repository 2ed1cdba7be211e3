"""ZV and ZVD input shapers for the oscillatory modes of a model."""

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

#: Convolution power of the zero-vibration shaper: the multiplicity of its zero at the pole.
SHAPER_REPETITIONS = {"zv": 1, "zvd": 2}
#: Maximum residual vibration over the confidence intervals of the poles.
MAX_RESIDUAL_VIBRATION = 0.2
#: Longest shaper [samples], and range of its poles [rad/s].
MAX_SHAPER_SAMPLES = 1 << 22
POLE_RANGE_RAD_S = (1e-12, 1e12)
#: Grid points per interval of frequency and of damping.
INTERVAL_GRID_POINTS = 9


@check_arguments
@dataclass(frozen=True)
class Shaper:
    """Input shaper: a sequence of impulses with sum 1 that causes no residual vibration of given modes.

    Parameters
    ----------
    kind
        ``"zv"``: zero vibration. ``"zvd"``: in addition, zero derivative of the vibration with respect to the pole,
        with twice the delay.
    modes
        Modes that are shaped.
    times, amplitudes
        Times [s] and amplitudes of the impulses in continuous time.
    worst
        Maximum residual vibration within the 95 % intervals of the modes; None without intervals.
    """

    kind: str
    modes: tuple[Mode, ...]
    times: tuple[float, ...]
    amplitudes: tuple[float, ...]
    worst: float | None

    @property
    def delay(self) -> float:
        """Delay by which the shaper extends a reference [s]."""
        return self.times[-1]

    def residual(self, frequency: ArrayLike, damping: ArrayLike) -> Floats:
        """Return the residual vibration of a mode after a shaped step, relative to that after an unshaped step.

        Parameters
        ----------
        frequency
            Undamped natural frequency of the mode [rad/s].
        damping
            Damping ratio.
        """
        return residual_vibration(np.array(self.times), np.array(self.amplitudes), frequency, damping)

    def impulses(self, rate: float) -> Floats:
        """Return the impulses at a sampling rate [Hz], shape (N,), with sum 1 and exact zeros at the poles.

        An impulse between two samples is divided between them in such a way that its effect at the pole does not
        change. Linear interpolation would change it.

        Raises
        ------
        ModelError
            If the rate is invalid, gives fewer than four samples per period of a mode, or gives millions of samples.
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
            part = _zv_samples(mode, 1.0 / rate)
            for _ in range(SHAPER_REPETITIONS[self.kind]):
                taps = _convolve(np.append(taps, np.zeros(len(part) - 1)), part)
        return taps

    def filter(self, reference: ArrayLike, rate: float) -> Floats:
        """Return a reference filtered by the shaper at a sampling rate [Hz]; its length does not change.

        The reference is assumed to equal its first row in the past. The result is delayed by `delay`, so the reference
        should end at rest.

        Parameters
        ----------
        reference
            Reference with one row per sample.
        rate
            Sampling rate [Hz].

        Raises
        ------
        DataError
            If a row is not finite.
        ModelError
            In the cases of :meth:`impulses`.
        """
        values = as_array("reference", reference)
        if values.dtype.kind not in "fiu" or values.ndim not in (1, 2) or values.size == 0:
            raise DataError("reference is not an array of numbers; give one of shape (rows,) or (rows, columns)")
        x = as_floats("reference", values).reshape(len(values), -1)
        bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
        if bad.size:
            raise DataError(
                f"reference is not finite at row {bad[0]} ({bad.size} such rows in all); give finite numbers"
            )
        taps = self.impulses(rate)
        rest = x[0]
        shaped = np.column_stack([_convolve(column, taps) for column in (x - rest).T]) + rest
        return np.asarray(shaped.reshape(values.shape), dtype=np.float64)

    def to_dict(self) -> dict[str, Any]:
        """Return impulses and modes as a dictionary for JSON."""
        modes = [[m.frequency, m.damping] for m in self.modes]
        return attributes(self, ("kind", "times", "amplitudes")) | {"modes": modes, "worst": self.worst}

    def __str__(self) -> str:
        steps = ", ".join(f"{a:.4g} at {t:.4g} s" for a, t in zip(self.amplitudes, self.times, strict=True))
        within = "" if self.worst is None else f"; within their intervals at most {100 * self.worst:.2g} % is left"
        modes_text = ", ".join(map(str, self.modes))
        return f"{self.kind.upper()} shaper of {modes_text}: {steps}{within}"


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
        Identified model, whose least damped modes are shaped; or a pole [rad/s] such as ``-2 + 17j``.
    kind
        ``"zv"`` (Smith's posicast, with a delay of half a period) or ``"zvd"`` (with a delay of a full period; errors
        of the pole have only a second-order effect).
    modes
        Number of modes that are shaped, the least damped first. Their delays are added.
    coupling
        ``"simulated"``: poles of the coupled equations. ``"measured"``: poles of each equation alone, as for a flexible
        link on a hub that a stiff position loop moves.

    Returns
    -------
    Shaper

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
        every: tuple[Mode, ...] = (_mode_of(model),)
    else:
        every = model_modes(model, coupling=coupling)
    growing = [m for m in every if m.unstable or m.damping <= 0.0]
    if growing:
        raise ModelError(
            f"the model is not stable ({growing[0]}), so its response cannot be shaped; close a loop around it, and "
            "shape the poles of the loop"
        )
    swings = sorted((m for m in every if m.oscillatory), key=lambda m: m.damping)
    if len(swings) < count:
        raise ModelError(
            f"{short_repr(count)} modes are to be shaped, but {len(swings)} modes of the model oscillate; other modes "
            "need no shaper"
        )
    modes_used = tuple(swings[:count])
    times, amplitudes = np.zeros(1), np.ones(1)
    for mode in modes_used:
        half, decay = _half(mode)
        for _ in range(SHAPER_REPETITIONS[kind]):
            times = np.concatenate([times, times + half])
            amplitudes = np.concatenate([amplitudes, amplitudes * decay]) / (1.0 + decay)
    instants, place = np.unique(np.round(times, 15), return_inverse=True)
    summed = np.bincount(place, weights=amplitudes)
    worst = _worst_residual(np.asarray(instants, dtype=np.float64), np.asarray(summed, dtype=np.float64), modes_used)
    if worst is not None and not worst <= MAX_RESIDUAL_VIBRATION:
        widest = max(modes_used, key=lambda m: (m.frequency_error or 0.0) / m.frequency + (m.damping_error or 0.0))
        raise ModelError(
            f"the poles are too uncertain for a shaper: within the intervals of the mode at "
            f"{with_error(widest.frequency, widest.frequency_error)} rad/s, damping "
            f"{with_error(widest.damping, widest.damping_error)}, a {kind} shaper may leave {100 * worst:.0f} % of the "
            f"vibration, more than {100 * MAX_RESIDUAL_VIBRATION:.0f} %; identify from a longer run, or from one "
            "that excites this mode" + (f", or use {parameter('kind', 'zvd')}" if kind == "zv" else "")
        )
    return Shaper(kind, modes_used, tuple(instants.tolist()), tuple(summed.tolist()), worst)


def residual_vibration(times: Floats, amplitudes: Floats, frequency: ArrayLike, damping: ArrayLike) -> Floats:
    """Return the vibration amplitude after the last impulse, divided by the amplitude after one unit impulse."""
    w, z = np.broadcast_arrays(as_floats("frequency", frequency), as_floats("damping", damping))
    if not (np.all(np.abs(w) < POLE_RANGE_RAD_S[1]) and np.all(np.abs(z) <= 1.0)):
        raise DataError("frequency or damping is out of range; give rad/s, finite, and damping ratios from -1 to 1")
    pole = w * (-z + 1j * np.sqrt(np.maximum(1.0 - z * z, 0.0)))
    phasors = np.sum(amplitudes * np.exp(pole[..., None] * (times[-1] - times)), axis=-1)
    return np.asarray(np.abs(phasors), dtype=np.float64)


def _convolve(x: Floats, taps: Floats) -> Floats:
    """Return the causal convolution of a signal with a few impulses, truncated to the length of the signal."""
    out = np.zeros(len(x))
    for at in np.flatnonzero(taps[: len(x)]):
        out[at:] += taps[at] * x[: len(x) - at]
    return out


def _mode_of(value: complex | np.number[Any]) -> Mode:
    try:
        pole = complex(value)
        size = abs(pole)
    except (TypeError, ValueError, OverflowError):
        pole, size = complex("nan"), math.nan
    low, high = POLE_RANGE_RAD_S
    if not (low <= abs(pole.imag) and size <= high):
        raise ModelError(f"pole = {short_repr(value)} does not oscillate; give a complex pole such as -2 + 17j [rad/s]")
    slow = abs(pole.real)
    return Mode(complex(pole.real, abs(pole.imag)), size, -pole.real / size, 1 / slow if slow else math.inf, True)


def _half(mode: Mode) -> tuple[float, float]:
    """Return half the damped period of a mode [s], and the decay of its amplitude over this time."""
    half = math.pi / mode.pole.imag
    return half, math.exp(mode.pole.real * half)


def _zv_samples(mode: Mode, step: float) -> Floats:
    """Return the sampled zero-vibration shaper of a mode, which is zero exactly at the pole of the mode."""
    half, decay_ratio = _half(mode)
    whole = math.floor(half / step)
    rest = half - whole * step
    # a + b e^(-s step) = e^(-s rest) at the pole; both are positive below half the sampling rate.
    decay, turn = mode.pole.real, mode.pole.imag
    later = math.exp(decay * (step - rest)) * math.sin(turn * rest) / math.sin(turn * step)
    sooner = math.exp(-decay * rest) * math.sin(turn * (step - rest)) / math.sin(turn * step)
    taps = np.zeros(whole + 2)
    taps[0] = 1.0
    taps[whole] += decay_ratio * sooner
    taps[whole + 1] += decay_ratio * later
    return np.asarray(taps / taps.sum())


def _worst_residual(times: Floats, amplitudes: Floats, modes: tuple[Mode, ...]) -> float | None:
    """Return the largest residual vibration over the confidence intervals of the modes; None without intervals."""
    worst: float | None = None
    for mode in modes:
        if mode.frequency_error is None or mode.damping_error is None:
            continue
        across = NORMAL_95 * np.linspace(-1.0, 1.0, INTERVAL_GRID_POINTS)
        w = np.maximum(mode.frequency + mode.frequency_error * across, 1e-6 * mode.frequency)
        z = np.clip(mode.damping + mode.damping_error * across, -0.99, 0.99)
        vibration = residual_vibration(times, amplitudes, w[:, None], z)
        worst = max(worst or 0.0, float(np.max(np.where(np.isfinite(vibration), vibration, np.inf))))
    return worst
