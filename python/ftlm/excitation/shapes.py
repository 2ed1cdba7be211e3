"""Inputs to begin with: squares, sweeps, random switching, sums of sines with the best spectrum and a low crest."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.excitation.spectrum import Spectrum

#: Rounds in which the crest of a sum of sines is cut and its spectrum put back.
CREST_ROUNDS = 200
#: What is cut of a crest in each.
CUT = 0.85
#: Shares of the best spectrum's power below which its lowest and its highest frequency lie.
LOW, MIDDLE, HIGH = 0.05, 0.5, 0.95


def square(rows: int, period: int) -> Floats:
    """A square of size 1 that begins high, period in samples."""
    return np.where((np.arange(rows) % period) * 2 < period, 1.0, -1.0)


def shapes(spectrum: Spectrum, inputs: int, rows: int, step: float, seed: int) -> Iterator[tuple[str, Floats]]:
    """Name and commands, shape (inputs, rows), of size 1 at most; motors get different ones where chance decides."""
    rng = np.random.default_rng(seed)
    sines = multisine(spectrum, inputs, rows, step, rng)
    yield "multisine", sines
    yield "binary by multisine", np.where(sines >= 0, 1.0, -1.0)
    low, middle, high = quantiles(spectrum, rows * step)
    time = np.asarray(step * np.arange(rows), dtype=np.float64)
    sweep = _chirp(time, low, max(high, 1.5 * low))
    signs = np.where(np.arange(inputs) % 2 == 0, 1.0, -1.0)[:, None]
    yield f"chirp {low:.3g} to {max(high, 1.5 * low):.3g} Hz", signs * sweep
    yield "binary by chirp", signs * np.where(sweep >= 0, 1.0, -1.0)
    for f in np.unique([low, math.sqrt(low * middle), middle, math.sqrt(middle * high), high]):
        period = max(2, round(1.0 / f / step))
        ratios = np.arange(inputs)
        yield f"square, period {period * step:.3g} s", np.stack([square(rows, period << int(k)) for k in ratios])
    for f in np.unique([math.sqrt(low * middle), middle, math.sqrt(middle * high)]):
        clock = max(1, round(0.4 / f / step))
        every = -(-rows // clock)
        drawn = rng.choice([-1.0, 1.0], (inputs, every))
        yield f"random binary, clock {clock * step:.3g} s", np.repeat(drawn, clock, axis=1)[:, :rows]


def quantiles(spectrum: Spectrum, duration: float) -> tuple[float, float, float]:
    """Where the power of a spectrum lies [Hz]: its low end, its middle and its high end."""
    order = np.argsort(spectrum.lines.frequencies)
    frequencies, power = spectrum.lines.frequencies[order], spectrum.power[order]
    total = np.cumsum(power)
    if not total[-1] > 0:
        return 1 / duration, 3 / duration, 10 / duration
    low, middle, high = (float(frequencies[np.searchsorted(total, q * total[-1])]) for q in (LOW, MIDDLE, HIGH))
    return low, middle, high


def multisine(spectrum: Spectrum, inputs: int, rows: int, step: float, rng: np.random.Generator) -> Floats:
    """A sum of sines with the powers of a spectrum, of size 1, phases such that its crest is low.

    Schroeder's phases (doi:10.1109/TIT.1970.1054411) for a start; then its peaks are cut and its spectrum is put back,
    time and again (Van der Ouderaa, Schoukens & Renneboog, 1988).
    """
    points = len(spectrum.power)
    of_input = np.argmax(spectrum.lines.costs[:inputs] > 0, axis=0) if points else np.zeros(0, int)
    numbers = np.round(spectrum.lines.frequencies * rows * step).astype(np.int64)
    out = np.zeros((inputs, rows))
    for k in range(inputs):
        own = (of_input == k) & (spectrum.power > 1e-6 * np.max(spectrum.power, initial=0.0))
        if not own.any():
            out[k] = rng.choice([-1.0, 1.0], rows)
            continue
        sizes = np.zeros(rows // 2 + 1)
        sizes[numbers[own]] = np.sqrt(spectrum.power[own])
        share = sizes**2 / np.sum(sizes**2)
        phases = -2 * math.pi * np.cumsum(np.cumsum(share)) + rng.uniform(0, 2 * math.pi, sizes.size) * 1e-3
        best, crest = np.zeros(rows), math.inf
        for _ in range(CREST_ROUNDS):
            wave = np.fft.irfft(sizes * np.exp(1j * phases), rows)
            peak = float(np.max(np.abs(wave)))
            if peak < crest:
                best, crest = wave, peak
            phases = np.angle(np.fft.rfft(np.clip(wave, -CUT * peak, CUT * peak)))
        out[k] = best / crest
    return out


def _chirp(time: Floats, low: float, high: float) -> Floats:
    growth, duration = math.log(high / low), float(time[-1])
    return np.asarray(np.sin(2 * math.pi * low * duration / growth * np.expm1(growth * time / duration)))
