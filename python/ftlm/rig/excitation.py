"""Motor-current signals (excitations) for experiments on a rig."""

from __future__ import annotations

import math
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ftlm.errors import DataError, ModelError
from ftlm.io.load import column_names, load
from ftlm.rig.rig import CURRENT_LIMIT, MAX_RUN_DURATION_S, check_rate
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import parameter, setting
from ftlm.utils.validation import Floats, real_number, short_repr

SIGNAL_SHAPES = ("square", "sine", "chirp", "multisine", "prbs", "doublet", "csv")
CURRENT_SIGNALS = ("I1", "I2")
#: Frequency of the paper's sine current [rad/s].
_PAPER_SINE_RAD_S = 6.3


@check_arguments
@dataclass(frozen=True)
class Excitation:
    """Motor-current signal of an experiment, for both motors.

    Parameters
    ----------
    shape
        Shape of the signal. ``"square"``: square wave with a duty cycle of 50 %. ``"sine"``: sine wave. ``"chirp"``:
        exponential frequency sweep over `band`. ``"multisine"``: sum of all multiples of 1/`period` in `band`, with
        equal amplitudes and random phases. ``"prbs"``: random sign that may change after every `period`. ``"doublet"``:
        positive for half a period, negative for the other half, then zero. ``"csv"``: columns I1 and I2 [A] of `file`,
        with zero-order hold.
    amplitude
        Maximum current [A] of both motors, or (motor 1, motor 2).
    period
        Period [s]; by default 2 for square and doublet, 10 for multisine, 2 pi/6.3 for sine, 0.1 for prbs.
    band
        Lowest and highest frequency of chirp and multisine [Hz].
    ramp
        Duration of the linear ramp of the amplitude from zero [s].
    seed
        Random seed of prbs and multisine, in which the two motors have different signals.
    file
        File with the currents for the shape ``"csv"``.
    """

    shape: str = "square"
    amplitude: float | tuple[float, float] = 0.3
    period: float | None = None
    band: tuple[float, float] = (0.1, 20.0)
    ramp: float = 0.0
    seed: int = 0
    file: str | os.PathLike[str] | None = None

    def commands(self, rate: float, duration: float) -> Floats:
        """Return the currents [A] of both motors, shape (round(duration·rate) + 1, 2); the last row is zero.

        Parameters
        ----------
        rate
            Sampling rate [Hz].
        duration
            Duration [s].

        Raises
        ------
        ModelError
            If shape, amplitude, period, band, ramp, rate or duration is invalid, or a current exceeds the limit of the
            amplifiers.
        DataError
            If the file cannot be read, or has neither column I1 nor I2.
        """
        samples, length = finite_number(rate), finite_number(duration)
        if samples is None or length is None or not 0 <= length <= MAX_RUN_DURATION_S:
            raise ModelError(
                f"{setting('duration')} {short_repr(duration)} s at {short_repr(rate)} Hz is not a run of at most "
                f"{MAX_RUN_DURATION_S:g} s; give its length and its rate"
            )
        check_rate(samples)
        rows = round(length * samples) + 1
        t = np.arange(rows) / rate
        ramp = finite_number(self.ramp)
        if ramp is None or not 0 <= ramp <= duration:
            raise ModelError(
                f"{setting('ramp')} {short_repr(self.ramp)} s is out of range; give 0 to {duration:g} s, the run length"
            )
        if self.shape == "csv":
            currents = self._file(t)
        else:
            currents = self._shapes(t, rate, duration) * np.array(self._amplitudes())
        if ramp > 0:
            currents = currents * np.minimum(1.0, t / ramp)[:, None]
        currents[-1] = 0.0
        for k, limit in enumerate(CURRENT_LIMIT):
            exceeding_rows = np.flatnonzero(np.abs(currents[:, k]) > limit * (1 + 1e-12))
            if exceeding_rows.size:
                raise ModelError(
                    f"the current of motor {k + 1} is {currents[exceeding_rows[0], k]:.4g} A at "
                    f"{t[exceeding_rows[0]]:.4g} s ({exceeding_rows.size} "
                    f"samples in all), over the limit of {limit:g} A; use a smaller amplitude"
                )
        return currents

    def _amplitudes(self) -> tuple[float, float]:
        amplitudes = self.amplitude if isinstance(self.amplitude, (tuple, list)) else (self.amplitude, self.amplitude)
        pair = [a for a in map(finite_number, amplitudes) if a is not None and a >= 0]
        if len(amplitudes) != 2 or len(pair) != 2:
            raise ModelError(
                f"{setting('amplitude')} {short_repr(self.amplitude)} is not a current; give one, or a pair, in A"
            )
        for k, (value, limit) in enumerate(zip(pair, CURRENT_LIMIT, strict=True)):
            if value > limit:
                raise ModelError(
                    f"{setting('amplitude')} {value:g} A of motor {k + 1} is over the limit of {limit:g} A; use a "
                    "smaller one"
                )
        return pair[0], pair[1]

    def _period(self, rate: float) -> float:
        default_period = {"sine": 2 * math.pi / _PAPER_SINE_RAD_S, "prbs": 0.1, "multisine": 10.0}.get(self.shape, 2.0)
        period = default_period if self.period is None else finite_number(self.period)
        if period is None or not period * rate >= 2:
            raise ModelError(
                f"{setting('period')} {short_repr(self.period)} s is too short; give at least two samples, "
                f"{2 / rate:g} s"
            )
        if self.shape == "multisine" and period > MAX_RUN_DURATION_S:
            raise ModelError(
                f"{setting('period')} {period:g} s of a multisine is longer than any run; give at "
                f"most {MAX_RUN_DURATION_S:g} s"
            )
        return period

    def _shapes(self, t: Floats, rate: float, duration: float) -> Floats:
        period = self._period(rate)
        # A tolerance of half a sample prevents rounding from shifting an edge.
        phase = ((t + 0.5 / rate) % period) / period
        if self.shape == "square":
            signal = np.where(phase < 0.5, 1.0, -1.0)
        elif self.shape == "sine":
            signal = np.sin(2 * math.pi * t / period)
        elif self.shape == "doublet":
            signal = np.where(t + 0.5 / rate < period, np.where(phase < 0.5, 1.0, -1.0), 0.0)
        elif self.shape == "chirp":
            low, high = self._band(rate)
            growth = math.log(high / low)
            signal = np.sin(2 * math.pi * low * duration / growth * np.expm1(growth * t / duration))
        elif self.shape in ("prbs", "multisine"):
            return np.column_stack([self._random(t, rate, period, motor) for motor in (0, 1)])
        else:
            raise ModelError(f"{setting('input')} {self.shape!r} is not known; use one of {', '.join(SIGNAL_SHAPES)}")
        return np.column_stack([signal, signal])

    def _random(self, t: Floats, rate: float, period: float, motor: int) -> Floats:
        rng = np.random.default_rng([self.seed, motor])
        if self.shape == "prbs":
            intervals = np.floor((t + 0.5 / rate) / period).astype(np.int64)
            return rng.choice([-1.0, 1.0], size=int(intervals[-1]) + 1)[intervals]
        low, high = self._band(rate)
        lines = np.arange(math.ceil(low * period - 1e-9), math.floor(high * period + 1e-9) + 1)
        lines = lines[(lines > 0) & (2 * lines <= round(period * rate))]
        if lines.size == 0:
            raise ModelError(
                f"{setting('band')} {self.band!r} Hz contains no multiple of 1/period = {1 / period:g} Hz; "
                "widen the band"
            )
        phases = rng.uniform(0, 2 * math.pi, lines.size)
        n = max(2, round(period * rate))
        spectrum = np.zeros(n // 2 + 1, dtype=np.complex128)
        spectrum[lines] = np.exp(1j * phases)
        signal: Floats = np.fft.irfft(spectrum, n)
        signal /= np.abs(signal).max()
        return signal[np.arange(t.size) % n]

    def _band(self, rate: float) -> tuple[float, float]:
        band = self.band
        frequencies = [b for b in map(finite_number, band) if b is not None] if isinstance(band, (tuple, list)) else []
        if len(frequencies) != 2 or len(band) != 2 or not 0 < frequencies[0] < frequencies[1] <= rate / 2:
            raise ModelError(
                f"{setting('band')} {short_repr(band)} Hz is not a band; give two increasing frequencies up to half "
                f"the rate, {rate / 2:g} Hz"
            )
        return frequencies[0], frequencies[1]

    def _file(self, t: Floats) -> Floats:
        if self.file is None:
            raise ModelError(f"{setting('input')} 'csv' needs a file; give it as {parameter('file')}")
        names = column_names(self.file)
        names_present = [name for name in CURRENT_SIGNALS if names is not None and name in names]
        # A run that was written by ftlm is loaded with all signals; from any other file only the currents are read.
        run = load(self.file) if names is None else load(self.file, outputs=names_present) if names_present else None
        if run is None or not any(name in run for name in CURRENT_SIGNALS):
            raise DataError(
                f"{str(self.file)!r} has no column I1 or I2; give the columns of the currents [A] these names"
            )
        rows = np.minimum(np.floor(t / run.step + 1e-6).astype(np.int64), run.length - 1)
        is_after_end = t > run.duration + run.step * (1 - 1e-6)
        currents = np.column_stack(
            [(run[name] if name in run else np.zeros(run.length))[rows] for name in CURRENT_SIGNALS]
        )
        currents[is_after_end] = 0.0
        return currents

    def to_dict(self) -> dict[str, Any]:
        """Return the parameters of the signal as a dictionary for JSON, without those that are None."""
        values = asdict(self) | {"file": None if self.file is None else Path(self.file).name}
        return {k: _to_json_value(v) for k, v in values.items() if v is not None}


def finite_number(value: object) -> float | None:
    """Return a finite real number as a float; None for any other value, including bool."""
    try:
        result = real_number("", value)
    except ModelError:
        return None
    return result if math.isfinite(result) else None


def _to_json_value(value: object) -> object:
    """Return a value with tuples replaced by lists and NumPy scalars by Python scalars, as JSON requires."""
    if isinstance(value, (tuple, list)):
        return [_to_json_value(v) for v in value]
    return value.item() if isinstance(value, np.generic) else value
