"""Result of an input design: designed input, predicted standard errors, and active constraints."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ftlm.data.run import Run
from ftlm.experiment_design.problem import Kind
from ftlm.experiment_design.spectrum import Spectrum
from ftlm.findings import Finding, texts
from ftlm.utils.files import to_frame
from ftlm.utils.formatting import attributes, finite, format_bound, json_value
from ftlm.utils.statistics import NORMAL_95
from ftlm.utils.validation import Floats

#: Minimum fraction of a limit at which it counts as an active constraint.
ACTIVE_LIMIT_FRACTION = 0.98
#: Maximum number of candidate inputs that are listed in the printed text.
MAX_PRINTED_INPUTS = 6


@dataclass(frozen=True)
class PredictedExtreme:
    """Largest absolute value that is predicted for a signal or a slew rate in the designed run, and its limit."""

    name: str
    largest: float
    limit: float

    @property
    def is_active(self) -> bool:
        """Whether the largest value is at least 98 % of its limit, so that the constraint is active."""
        return self.largest >= ACTIVE_LIMIT_FRACTION * self.limit

    def __str__(self) -> str:
        limit = "no limit" if math.isinf(self.limit) else f"of {self.limit:.4g}{', binds' if self.is_active else ''}"
        return f"{self.name} {self.largest:.4g} ({limit})"


@dataclass(frozen=True)
class DesignedInput:
    """Result of an input design: the designed run, predicted confidence intervals, and active constraints.

    Parameters
    ----------
    run
        Designed run from rest: commands (zero-order hold) and simulated outputs of the model.
    reference
        Simulated run with a square wave of the same duration and peaks, for comparison.
    shape
        Text that describes the shape of the input.
    criterion
        Optimality criterion, ``"D"`` or ``"E"``.
    parameters
        Names of the parameters of interest.
    values
        Values of the free parameters of the model by name.
    standard_errors
        Standard errors of the free parameters by case and name. ``"now"``: those of the model. ``"square"`` and
        ``"designed"``: predicted for a fit to the square wave alone, or to the designed run alone. ``"both"``:
        predicted for a fit to the designed run together with the estimation runs.
    gain
        Product of the interval widths of all parameters of interest with the square wave, divided by this product with
        the designed input.
    gains
        (name, gain) of every candidate input, best first. The gain is the size of the confidence ellipsoid with the
        square wave, divided by that with the candidate. For D the size is the volume, and for E the longest axis to the
        power of the number of parameters of interest.
    predicted_extremes
        Largest absolute values of inputs, slew rates and outputs in the designed run, with their limits.
    spectrum
        Optimal spectrum of a periodic input in steady state under the same limits.
    efficiency
        Precision with the designed input, divided by the upper bound of the precision with periodic inputs in steady
        state under the limits. The start from rest adds information, so the ratio may exceed 1.
    findings
        Findings on why predictions may be wrong.
    """

    run: Run
    reference: Run
    shape: str
    criterion: Kind
    parameters: tuple[str, ...]
    values: Mapping[str, float]
    standard_errors: Mapping[str, Mapping[str, float]]
    gain: float
    gains: tuple[tuple[str, float], ...]
    predicted_extremes: tuple[PredictedExtreme, ...]
    spectrum: Spectrum = field(repr=False)
    efficiency: float
    findings: tuple[Finding, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Texts of the findings, one per finding."""
        return texts(self.findings)

    @property
    def input(self) -> dict[str, Floats]:
        """Commands of the designed run, one array (rows,) per input name."""
        return {n: np.array(self.run[n]) for n in self.run.inputs}

    @property
    def step(self) -> float:
        """Sampling interval of the commands [s]."""
        return self.run.step

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % intervals (low, high) by parameter name, predicted for a fit to the designed run alone.

        They are centered at the values of the model.
        """
        errors = self.standard_errors["designed"]
        return {n: (v - NORMAL_95 * errors[n], v + NORMAL_95 * errors[n]) for n, v in self.values.items()}

    @property
    def active_constraints(self) -> tuple[str, ...]:
        """Names of the signals and slew rates whose predicted largest values reach their limits."""
        return tuple(r.name for r in self.predicted_extremes if r.is_active)

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write the designed run to a csv file, which ``ftlm record --input csv --file PATH`` reads.

        Parameters
        ----------
        path
            File to write.
        force
            Whether to overwrite an existing file.

        Raises
        ------
        DataError
            If the file exists and `force` is False, or it cannot be written.
        """
        self.run.to_csv(path, force=force)

    def to_frame(self) -> Any:
        """Return a pandas DataFrame: one row per parameter, columns for its value and its standard error by case."""
        rows = [
            {"parameter": n, "value": v, **{kind: errors[n] for kind, errors in self.standard_errors.items()}}
            for n, v in self.values.items()
        ]
        return to_frame(rows, ["parameter"])

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a dictionary for JSON, without the run."""
        spectrum = self.spectrum
        return {
            **attributes(self, ("shape", "criterion", "parameters")),
            "duration": self.run.duration,
            **attributes(self, ("step", "values")),
            "standard_errors": json_value(self.standard_errors),
            "gain": finite(self.gain),
            "gains": dict(self.gains),
            "predicted_extremes": {
                r.name: attributes(r, ("largest", "limit", "is_active")) for r in self.predicted_extremes
            },
            "efficiency": finite(self.efficiency),
            "spectrum": {
                "frequencies": spectrum.lines.frequencies.tolist(),
                "power": spectrum.power.tolist(),
                "gap": finite(spectrum.gap),
            },
            **attributes(self, ("findings", "warnings")),
        }

    def __str__(self) -> str:
        square = self.reference.name
        lines = [
            f"{', '.join(self.run.inputs)}: {self.shape}, {self.run.duration:.6g} s in steps of {self.step:.6g} s, "
            f"{self.criterion}-optimal for {', '.join(self.parameters)}",
            "",
            f"  {'standard error of':<18}{'now':>12}{'square':>12}{'designed':>12}{'combined':>12}"
            f"{'square/designed':>17}",
        ]
        for name, value in self.values.items():
            now, square_error, new, both = (
                self.standard_errors[k][name] for k in ("now", "square", "designed", "both")
            )
            mark = "*" if name in self.parameters else " "
            ratio = square_error / new if new > 0 else math.nan
            cells = "".join(f"{format_bound(v):>12}" for v in (now, square_error, new, both))
            lines.append(f"{mark} {f'{name} = {value:.6g}':<18}{cells}{ratio:>17.2f}")
        lines += [
            "",
            f"parameters marked *: the product of their intervals is {self.gain:.3g} times smaller than with a "
            f"{square} of the same duration and peak",
            f"limits: {'; '.join(map(str, self.predicted_extremes))}",
            f"precision: {100 * self.efficiency:.0f} % of that of the best periodic input in steady state within these "
            f"limits (upper bound, computed to {100 * self.spectrum.gap:.2g} %; a start from rest adds information)",
            "candidates: "
            + ", ".join(f"{name} {value:.3g}" for name, value in self.gains[:MAX_PRINTED_INPUTS])
            + (f" and {len(self.gains) - MAX_PRINTED_INPUTS} more" if len(self.gains) > MAX_PRINTED_INPUTS else "")
            + f" (gain relative to the {square})",
        ]
        lines += [f"! {w}" for w in self.warnings]
        return "\n".join(lines)
