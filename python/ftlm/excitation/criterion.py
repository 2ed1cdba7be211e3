"""How much an information says of chosen numbers, whatever the others are: one number to be made large."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ftlm.base.arrays import Floats

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
