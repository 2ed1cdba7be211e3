"""Huber's loss: squares for usual residuals, sizes for the others, so that a few that are far off decide nothing.

The minimum is found by least squares with weights that follow the residuals until they stand still (doi:10.1214/aoms/
1177703732, doi:10.1080/03610927708827533). The scale is the median of the sizes, which outliers do not move.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.statistics import BEND, robust_deviation
from ftlm.fit.grid import Attempt, Grid

#: Residuals beyond so many deviations are outliers: of normal noise one in two millions is.
FAR = 5.0
#: Shares are settled when none moves by more than this.
SETTLED_SHARES = 2e-3


@dataclass(frozen=True)
class Robust:
    """What a robust loss did.

    Parameters
    ----------
    lowered
        Residuals beyond 1.345 deviations, which count less; of normal noise 18 % are.
    outliers
        Those beyond five.
    samples
        Residuals in all.
    """

    lowered: int
    outliers: int
    samples: int

    @classmethod
    def of(cls, grid: Grid, attempt: Attempt) -> Robust:
        """Count them at an optimum."""
        sizes = np.abs(np.concatenate(list(relative(grid, attempt).values())))
        return cls(int(np.sum(sizes > BEND)), int(np.sum(sizes > FAR)), sizes.size)


def scales(grid: Grid, attempt: Attempt) -> dict[str, float]:
    """Deviation of the usual residuals by output, in units of the weights; of all where half of them are none."""
    return {
        o: robust_deviation(e) or float(np.sqrt(np.mean(e**2))) for o, e in grid.pooled(attempt).items()
    }  # fmt: skip


def relative(grid: Grid, attempt: Attempt) -> dict[str, Floats]:
    """Residuals over the deviation of the usual ones, by output."""
    levels = scales(grid, attempt)
    return {o: e / max(levels[o], 1e-300) for o, e in grid.pooled(attempt).items()}


def huber_shares(grid: Grid, attempt: Attempt, levels: dict[str, float]) -> list[Floats]:
    """Roots of Huber's weights of the compared samples, by run, a row an output; 1 where nothing was read."""
    out = []
    for part in grid.residuals(attempt):
        rows = [np.abs(e) / max(levels[o], 1e-300) for o, e in part.items()]
        # A comparison with what was not read is false.
        out.append(np.stack([np.sqrt(np.where(r > BEND, BEND / np.maximum(r, BEND), 1.0)) for r in rows]))
    return out


def same_shares(before: Sequence[Floats] | None, after: Sequence[Floats] | None) -> bool:
    """Whether shares have settled."""
    if before is None or after is None:
        return before is after
    return all(float(np.abs(a - b).max()) <= SETTLED_SHARES for a, b in zip(before, after, strict=True))
