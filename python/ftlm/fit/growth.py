"""An optimum whose free run grows, beside one whose free run dies away."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Growth:
    """An optimum whose free run grows beside the best one found whose free run does not.

    Parameters
    ----------
    kept
        Whether the growing one is the fit's, because the runs force it or there was no other.
    excess
        Share by which residuals of the other one are larger (root mean square); infinite where there was none, below 0
        where the growing one was no optimum.
    at_limit
        Whether the other one stands where free runs begin to grow, no optimum of its own.
    """

    kept: bool
    excess: float
    at_limit: bool = False
