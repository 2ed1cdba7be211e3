"""What Huber's loss did: squares for usual residuals, sizes for others, so that a few that are far off decide nothing.

The core finds its minimum by least squares with weights that follow the residuals until they stand still.
"""

from __future__ import annotations

from dataclasses import dataclass

#: Residuals beyond so many deviations are outliers: of normal noise one in two millions is.
FAR = 5.0


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
