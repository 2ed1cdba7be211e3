"""How much an information says of chosen numbers, whatever the others are: one number to be made large."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ftlm.errors import ModelError
from ftlm.utils.validation import Floats, nearest, real_number, shown

Kind = Literal["D", "E"]
#: Kiefer's mean, taken for the widest axis where a derivative is needed: within s^(1/16) of it for s numbers.
SHARP = 16
#: A determinant below this, of an information in units of its own diagonal, is rounding.
LOST = 1e-28


@dataclass(frozen=True)
class Criterion:
    """The precision of chosen numbers, in their units, as a logarithm: twice the input is log 2 more.

    Parameters
    ----------
    kind
        ``"D"``: the geometric mean of the axes of their ellipsoid of confidence. ``"E"``: its widest axis.
    chosen
        Places of the numbers.
    units
        What counts as one of each of them.
    """

    kind: Kind
    chosen: tuple[int, ...]
    units: tuple[float, ...]

    @property
    def count(self) -> int:
        """Chosen numbers."""
        return len(self.chosen)

    def score(self, information: Floats) -> Floats:
        """Of informations, shape (…, numbers, numbers); minus infinity where they do not tell the chosen numbers."""
        spread = self._inverse(information)
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.kind == "D":
                sign, size = np.linalg.slogdet(spread)
                found = np.where(sign > 0, -0.5 * size / self.count, -np.inf)
            else:
                axes = np.linalg.eigvalsh(np.where(np.isfinite(spread), spread, 0.0))
                found = np.where(axes[..., 0] > 0, -0.5 * np.log(axes[..., -1]), -np.inf)
        return np.where(np.isfinite(spread[..., 0, 0]), found, -np.inf)

    def mean(self, information: Floats) -> float:
        """The same, but of the widest axis Kiefer's mean, which has a derivative and is at least as good."""
        if self.kind == "D":
            return float(self.score(information))
        axes = np.linalg.eigvalsh(self._inverse(information))
        if not (np.all(np.isfinite(axes)) and axes[0] > 0):
            return -math.inf
        return float(-0.5 * (np.log(axes[-1]) + np.log(np.mean((axes / axes[-1]) ** SHARP)) / SHARP))

    def slope(self, information: Floats) -> Floats:
        """What, times a direction and summed up, is how :meth:`mean` doubled grows along it; 1 along itself."""
        p = len(information)
        size = np.sqrt(np.diag(information))
        whole = np.linalg.inv(information / np.outer(size, size)) / np.outer(size, size)
        arms = whole[:, self.chosen] / np.asarray(self.units)
        block = arms[list(self.chosen)] / np.asarray(self.units)[:, None]
        axes, turn = np.linalg.eigh(0.5 * (block + block.T))
        axes = np.maximum(axes, np.finfo(np.float64).tiny)
        power = SHARP if self.kind == "E" else 0
        share = (axes / axes[-1]) ** power
        weights = share / axes / np.sum(share)
        lever = arms @ turn
        return np.asarray((lever * weights) @ lever.T).reshape(p, p)

    def _inverse(self, information: Floats) -> Floats:
        """Covariance of the chosen numbers in their units; infinite where there is none."""
        diagonal = np.diagonal(information, axis1=-2, axis2=-1)
        seen = np.all(diagonal > 0, axis=-1)
        size = np.sqrt(np.where(seen[..., None], diagonal, 1.0))
        scaled = information / (size[..., :, None] * size[..., None, :])
        scaled = np.where(seen[..., None, None], scaled, np.eye(scaled.shape[-1]))
        sign, determinant = np.linalg.slogdet(scaled)
        good = seen & (sign > 0) & (determinant > math.log(LOST) * 2)
        scaled = np.where(good[..., None, None], scaled, np.eye(scaled.shape[-1]))
        at = list(self.chosen)
        unit = size[..., at] * np.asarray(self.units)
        inverse = np.linalg.inv(scaled)[..., at, :][..., at] / (unit[..., :, None] * unit[..., None, :])
        return np.where(good[..., None, None], inverse, np.inf)


#: Sizes that a limit may have, or infinity: of others squares of their quotients are none.
SIZES = (1e-50, 1e50)


@dataclass(frozen=True)
class Bounds:
    """Limits of a run, in the units of its signals.

    Parameters
    ----------
    peaks
        Largest size of each input.
    slews
        Fastest change of each input, a second; infinite where there is none.
    swings
        Largest size of each output; infinite where there is none.
    """

    peaks: Mapping[str, float]
    slews: Mapping[str, float]
    swings: Mapping[str, float]

    def ramp(self, step: float) -> int:
        """Samples over which a change from one peak to the other has to be spread."""
        return max(1, *(math.ceil(min(2 * p / self.slews[n] / step, 1e18) - 1e-9) for n, p in self.peaks.items()))

    def scale(self, commands: Floats, moved: Floats) -> float:
        """Factor, at most 1, by which commands within their peaks keep all outputs within theirs; rows by name."""
        return min(
            1.0,
            *(
                limit / float(np.max(np.abs(row), initial=0.0)) if np.any(row) else 1.0
                for limit, row in zip(self.swings.values(), moved, strict=True)
            ),
            *(
                limit / float(np.max(np.abs(row), initial=0.0)) if np.any(row) else 1.0
                for limit, row in zip(self.peaks.values(), commands, strict=True)
            ),
        )


def by_name(what: str, given: object, names: Sequence[str], default: Mapping[str, float] | None) -> dict[str, float]:
    """One positive number for all names, or some by name; what is not said is as the default says.

    Raises
    ------
    ModelError
        A name that is none of them, a value that is no positive number, or one that is not said without a default.
    """
    if isinstance(given, Mapping):
        for name in given:
            if name not in names:
                near = nearest(name, names) if isinstance(name, str) else ""
                raise ModelError(
                    f"{what} names {shown(name)}{near}, which is none of {', '.join(names) or 'nothing'}; "
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
                    f"{what} of {name} is not given; give {what}= a number, or one by name, or like= a run"
                )
            out[name] = default[name]
            continue
        value = real_number(f"{what} of {name}", said)
        if not value > 0:
            raise ModelError(f"{what} of {name} = {value:g} is not above 0; give the largest size it may have")
        if not SIZES[0] <= value <= SIZES[1] and not math.isinf(value):
            raise ModelError(
                f"{what} of {name} = {value:g} is no size from {SIZES[0]:g} to {SIZES[1]:g}; use other units"
            )
        out[name] = value
    return out
