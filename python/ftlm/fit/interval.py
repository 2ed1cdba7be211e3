"""The record of an interval by profile likelihood."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ftlm.paint.text import unbounded


@dataclass(frozen=True)
class ProfileInterval:
    """The values of a number at which the cost, all others fitted anew, rises by no more than noise explains.

    Parameters
    ----------
    low, high
        Its ends, in the unit of the number; infinite where the cost does not rise to the threshold within the bounds,
        as far as there is a finite free run.
    level
        Probability with which intervals of repeated runs hold the truth.
    points
        (value, rise) of every refit: the rise of the weighted sum of squares in units of the noise's variance, so that
        its root counts standard deviations; widened for coloured residuals as the standard errors are.
    evaluations
        Free runs that it took.
    """

    low: float
    high: float
    level: float
    points: tuple[tuple[float, float], ...] = field(default=(), repr=False)
    evaluations: int = field(default=0, repr=False)

    @property
    def is_open(self) -> bool:
        """Whether an end is infinite."""
        return not (math.isfinite(self.low) and math.isfinite(self.high))

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high

    def __str__(self) -> str:
        return f"{unbounded(self.low, '.6g')} to {unbounded(self.high, '.6g')}"
