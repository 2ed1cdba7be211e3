"""Optimality criterion (D or E) and signal limits of an experiment."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ftlm.errors import ModelError
from ftlm.utils.parameters import parameter
from ftlm.utils.validation import Floats, nearest, real_number, short_repr

Kind = Literal["D", "E"]
#: Exponent of Kiefer's mean, the smooth substitute of the widest axis: within s^(1/16) of it for s parameters.
KIEFER_MEAN_EXPONENT = 16
#: Determinant of the information, scaled to a unit diagonal, below which it is numerically singular.
MIN_SCALED_DETERMINANT = 1e-28


@dataclass(frozen=True)
class Criterion:
    """Log precision of the parameters of interest, in their units; twice the input adds ln 2.

    Parameters
    ----------
    kind
        ``"D"``: geometric mean of the axes of the confidence ellipsoid. ``"E"``: its widest axis.
    indices
        Indices of the parameters of interest.
    units
        Unit of each of them.
    """

    kind: Kind
    indices: tuple[int, ...]
    units: tuple[float, ...]

    @property
    def count(self) -> int:
        """Number of parameters of interest."""
        return len(self.indices)

    def score(self, information: Floats) -> Floats:
        """Score of information matrices, shape (…, p, p); -inf if the parameters are not identifiable."""
        spread = self._inverse(information)
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.kind == "D":
                sign, size = np.linalg.slogdet(spread)
                found = np.where(sign > 0, -0.5 * size / self.count, -np.inf)
            else:
                axes = np.linalg.eigvalsh(np.where(np.isfinite(spread), spread, 0.0))
                found = np.where(axes[..., 0] > 0, -0.5 * np.log(axes[..., -1]), -np.inf)
        return np.where(np.isfinite(spread[..., 0, 0]), found, -np.inf)

    def smooth_score(self, information: Floats) -> float:
        """Differentiable score: for E, Kiefer's mean in place of the widest axis; never below :meth:`score`."""
        if self.kind == "D":
            return float(self.score(information))
        axes = np.linalg.eigvalsh(self._inverse(information))
        if not (np.all(np.isfinite(axes)) and axes[0] > 0):
            return -math.inf
        return float(
            -0.5
            * (np.log(axes[-1]) + np.log(np.mean((axes / axes[-1]) ** KIEFER_MEAN_EXPONENT)) / KIEFER_MEAN_EXPONENT)
        )

    def gradient(self, information: Floats) -> Floats:
        """Gradient of twice :meth:`smooth_score`, shape (p, p); its inner product with the information is 1."""
        p = len(information)
        size = np.sqrt(np.diag(information))
        whole = np.linalg.inv(information / np.outer(size, size)) / np.outer(size, size)
        arms = whole[:, self.indices] / np.asarray(self.units)
        block = arms[list(self.indices)] / np.asarray(self.units)[:, None]
        axes, turn = np.linalg.eigh(0.5 * (block + block.T))
        axes = np.maximum(axes, np.finfo(np.float64).tiny)
        power = KIEFER_MEAN_EXPONENT if self.kind == "E" else 0
        share = (axes / axes[-1]) ** power
        weights = share / axes / np.sum(share)
        lever = arms @ turn
        return np.asarray((lever * weights) @ lever.T).reshape(p, p)

    def _inverse(self, information: Floats) -> Floats:
        """Covariance of the parameters of interest in their units; infinite if the information is singular."""
        diagonal = np.diagonal(information, axis1=-2, axis2=-1)
        seen = np.all(diagonal > 0, axis=-1)
        size = np.sqrt(np.where(seen[..., None], diagonal, 1.0))
        scaled = information / (size[..., :, None] * size[..., None, :])
        scaled = np.where(seen[..., None, None], scaled, np.eye(scaled.shape[-1]))
        sign, determinant = np.linalg.slogdet(scaled)
        good = seen & (sign > 0) & (determinant > math.log(MIN_SCALED_DETERMINANT) * 2)
        scaled = np.where(good[..., None, None], scaled, np.eye(scaled.shape[-1]))
        at = list(self.indices)
        unit = size[..., at] * np.asarray(self.units)
        inverse = np.linalg.inv(scaled)[..., at, :][..., at] / (unit[..., :, None] * unit[..., None, :])
        return np.where(good[..., None, None], inverse, np.inf)


#: Range of a finite limit. Beyond it squares of ratios overflow.
LIMIT_RANGE = (1e-50, 1e50)


@dataclass(frozen=True)
class Bounds:
    """Limits of a run, in the units of its signals.

    Parameters
    ----------
    peaks
        Largest absolute value of each input.
    slews
        Largest rate of change of each input [unit/s]; infinite if unlimited.
    output_limits
        Largest absolute value of each output; infinite if unlimited.
    """

    peaks: Mapping[str, float]
    slews: Mapping[str, float]
    output_limits: Mapping[str, float]

    def ramp_samples(self, step: float) -> int:
        """Number of samples that a change from one peak to the other takes under the slew rates."""
        return max(1, *(math.ceil(min(2 * p / self.slews[n] / step, 1e18) - 1e-9) for n, p in self.peaks.items()))

    def scale(self, commands: Floats, moved: Floats) -> float:
        """Return the factor, at most 1, that keeps commands and outputs within their limits.

        ``commands`` and ``moved`` have one row per input and per output, in the order of the limits.
        """
        return min(
            1.0,
            *(
                limit / float(np.max(np.abs(row), initial=0.0)) if np.any(row) else 1.0
                for limit, row in zip(self.output_limits.values(), moved, strict=True)
            ),
            *(
                limit / float(np.max(np.abs(row), initial=0.0)) if np.any(row) else 1.0
                for limit, row in zip(self.peaks.values(), commands, strict=True)
            ),
        )


def per_signal_values(
    what: str, given: object, names: Sequence[str], default: Mapping[str, float] | None
) -> dict[str, float]:
    """Return one positive number for each name, from a number, a mapping, or the default.

    Raises
    ------
    ModelError
        An unknown name, a value that is not positive, or a missing value without a default.
    """
    if isinstance(given, Mapping):
        for name in given:
            if name not in names:
                near = nearest(name, names) if isinstance(name, str) else ""
                raise ModelError(
                    f"{what} names {short_repr(name)}{near}, which is none of {', '.join(names) or 'nothing'}; "
                    "name one of them"
                )
    elif given is not None:
        given = dict.fromkeys(names, given)
    out = {}
    for name in names:
        said = None if given is None else given.get(name)
        if said is None:
            if default is None or name not in default:
                raise ModelError(
                    f"{what} of {name} is not given; give {parameter(what)} a number, or one by name, or "
                    f"{parameter('reference_run')} a run"
                )
            out[name] = default[name]
            continue
        value = real_number(f"{what} of {name}", said)
        if not value > 0:
            raise ModelError(f"{what} of {name} = {value:g} is not above 0; give its largest absolute value")
        if not LIMIT_RANGE[0] <= value <= LIMIT_RANGE[1] and not math.isinf(value):
            raise ModelError(
                f"{what} of {name} = {value:g} is not between {LIMIT_RANGE[0]:g} and {LIMIT_RANGE[1]:g}; use other "
                "units"
            )
        out[name] = value
    return out
