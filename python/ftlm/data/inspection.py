"""What a run looks like before anything is made of it: ranges, noise, quantisation, rest."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ftlm.base.statistics import is_rest, noise_of
from ftlm.data.measured import Measured
from ftlm.data.readings import read


@dataclass(frozen=True)
class SignalFigures:
    """Figures of one signal, in its SI unit.

    Parameters
    ----------
    name, role, unit
        Which signal.
    first, low, high, mean, deviation
        First value, extremes, mean and standard deviation.
    noise
        Standard deviation of the part that changes from sample to sample, from second differences.
    quantum
        Smallest change between two samples.
    at_extremes
        Share of samples at the lowest or highest value: saturation or a two-level signal.
    constant
        Whether all samples are equal.
    at_rest
        Whether the signal starts at zero within its noise.
    """

    name: str
    role: str
    unit: str
    first: float
    low: float
    high: float
    mean: float
    deviation: float
    noise: float
    quantum: float
    at_extremes: float
    constant: bool
    at_rest: bool


@dataclass(frozen=True)
class Inspection:
    """A run in figures.

    Parameters
    ----------
    run
        Its name.
    rows, step, duration
        Its size, sampling step [s] and duration [s].
    signals
        Figures by signal, inputs first.
    warnings
        What to look at, in words.
    """

    run: str
    rows: int
    step: float
    duration: float
    signals: list[SignalFigures]
    warnings: list[str]

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    def __str__(self) -> str:
        width = max(len(name) for name in ("signal", *(s.name for s in self.signals))) + 2
        heads = ("first", "low", "high", "mean", "sd", "noise", "quantum")
        lines = [
            f"run {self.run}: {self.rows} rows, step {self.step:g} s, {self.duration:g} s; "
            f"carries up to {self.rows - 1} block pulses",
            f"{'signal':<{width}}{'role':<8}{'unit':<8}" + "".join(f"{h:>11}" for h in heads),
        ]
        for s in self.signals:
            figures = (s.first, s.low, s.high, s.mean, s.deviation, s.noise, s.quantum)
            lines.append(f"{s.name:<{width}}{s.role:<8}{s.unit or '1':<8}" + "".join(f"{v:>11.4g}" for v in figures))
        return "\n".join(lines + [f"warning: {w}" for w in self.warnings])


def inspect_run(run: Measured) -> Inspection:
    """Ranges, noise, quantisation and rest of every signal of a run.

    Parameters
    ----------
    run
        The run.

    Returns
    -------
    Inspection
        Prints as a table.
    """
    signals = [_figures(run, name) for name in run.signals]
    warnings = list(run.warnings)
    for s in signals:
        if s.constant:
            warnings.append(f"{s.name} is constant ({s.first:g}): a dead channel, or nothing happened")
        elif s.role == "output" and not s.at_rest:
            warnings.append(f"{s.name} does not start at rest (first value {s.first:.4g}): initial terms will be used")
    return Inspection(run.name, run.length, run.step, run.duration, signals, list(dict.fromkeys(warnings)))


def _figures(run: Measured, name: str) -> SignalFigures:
    all_rows = run[name]
    x = read(all_rows)
    low, high, noise = float(x.min()), float(x.max()), noise_of(all_rows)
    changes = np.abs(np.diff(x))
    changes = changes[changes > 0]
    deviation = float(x.std())
    return SignalFigures(
        name=name,
        role="input" if name in run.inputs else "output",
        unit=run.units.get(name, ""),
        first=float(x[0]),
        low=low,
        high=high,
        mean=float(x.mean()),
        deviation=deviation,
        noise=noise,
        quantum=float(changes.min()) if changes.size else 0.0,
        at_extremes=float(np.mean((x == low) | (x == high))),
        constant=low == high,
        at_rest=is_rest(x),
    )
