"""Whether an input answers an output: what Sims's regression on past and future inputs finds in the residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.statistics import chi_squared
from ftlm.base.tall import dot, orthonormal, projections, triangle, turned_rows
from ftlm.judge.metrics import finite

#: Future samples of the input that are looked at: an answer within a few samples hides among many.
AHEAD = (5, 25)
#: Share of open loops that one of the two regressions is allowed to call closed.
LEVEL = 0.01
#: Past samples that stand by themselves; those before are averaged over ever longer blocks, each wider by this factor.
DENSE = 25
WIDER = 1.5
#: Rows that are looked at: more of them tell the same.
MOST_ROWS = 50_000
#: Share of a column that the columns before it must leave.
SPANNED = 1e-6


@dataclass(frozen=True)
class FeedbackTest:
    """Whether later inputs tell something of a residual that earlier inputs do not.

    Parameters
    ----------
    statistic, limit
        Sum of squares that later inputs explain in units of the residual's variance, and the value that one open loop
        in a hundred exceeds.
    instant
        Whether only the input of the same sample does: a controller that answers at once, or direct feed-through.
    decided
        Whether there were samples enough, and an input that moves.
    """

    statistic: float
    limit: float
    instant: bool
    decided: bool = True

    @property
    def found(self) -> bool:
        """Whether the input answers the output."""
        return self.decided and self.statistic > self.limit

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        shown = {"statistic": finite(self.statistic), "limit": finite(self.limit)}
        return {**shown, "found": self.found, "instant": self.instant, "decided": self.decided}


def past_columns(signal: Floats, first: int, reach: int, *, dense: int = DENSE, wider: float = WIDER) -> list[Floats]:
    """Samples of a signal from ``first`` to ``dense`` rows back, then means of ever longer blocks up to ``reach``.

    What is before the first row counts as the first value, so a reach may be as long as the signal and no longer.
    """
    count = signal.size
    padded = np.concatenate([np.full(count, signal[0]), signal])
    moved = padded - signal[0]
    sums = np.concatenate([[0.0], np.cumsum(moved)])
    columns = [moved[count - lag : 2 * count - lag] for lag in range(first, min(dense, reach) + 1)]
    start, width = dense + 1, max(2, dense // 4)
    while start + width <= reach:
        end = count - start + 1
        columns.append((sums[end : end + count] - sums[end - width : end - width + count]) / width)
        start, width = start + width, int(width * wider) + 1
    return columns


def feedback_test(
    white: Sequence[Floats], signal: Sequence[Floats], others: Sequence[Sequence[Floats]], *, direct: bool
) -> FeedbackTest:
    """Regress residuals on past and future of an input: without feedback the future adds nothing (Sims, 1972).

    An input that is made beforehand cannot know the noise, however wrong the model is: what a model leaves out follows
    the past of the input, of which long memory is taken in.

    Parameters
    ----------
    white
        Residuals, a run each, through the filter that makes them white.
    signal
        The input, through the same filter.
    others
        Other inputs, whose past may explain the residuals. Their values of the same sample stay out: where one answers
        at once, it makes whatever drives it look like an answer.
    direct
        Whether the model has direct feed-through from this input, so that its value of the same sample is no answer.
    """
    table = Regressors.of(white, signal, others)
    at_once = None if table is None else table.statistic(1 if direct else 0)
    if table is None or at_once is None:
        return FeedbackTest(0.0, np.inf, instant=False, decided=False)
    later = at_once if direct else table.statistic(1)
    if later is not None and later[0] > later[1]:
        return FeedbackTest(*later, instant=False)
    return FeedbackTest(*at_once, instant=at_once[0] > at_once[1])


@dataclass(frozen=True)
class Regressors:
    """Residuals beside what may explain them, turned so that all rows but as many as there are columns are 0.

    A rotation of the rows leaves every inner product as it is, and with it every least squares.

    Parameters
    ----------
    past
        Earlier samples of the input and of the others, and a constant.
    now
        The input's sample of the same row, less its first of that run, as those of the past are.
    future
        The input's sample of the same row, then those after it.
    residuals
        What is to be explained.
    rows
        How many rows there were.
    """

    past: Floats
    now: Floats
    future: Floats
    residuals: Floats
    rows: int

    @classmethod
    def of(
        cls, white: Sequence[Floats], signal: Sequence[Floats], others: Sequence[Sequence[Floats]]
    ) -> Regressors | None:
        """Of residuals and inputs, a run each; None where every run is too short."""
        parts, rows, width = [], 0, 0
        sizes = [e.size for e in white if e.size > DENSE + AHEAD[-1]]
        reach = min(sizes, default=0) // 2
        for run, (every, driving) in enumerate(zip(white, signal, strict=True)):
            e, u = every[: MOST_ROWS - rows], driving[: MOST_ROWS - rows]
            inner = slice(DENSE, e.size - AHEAD[-1])
            if e.size <= max(DENSE + AHEAD[-1], reach):
                continue
            now, *columns = past_columns(u, 0, reach)
            for other in others:
                columns += past_columns(other[run][: e.size], 1, reach, dense=10, wider=2.0)
            columns += [np.ones(e.size), now]
            width = len(columns) - 1
            later = [u[DENSE + k : e.size - AHEAD[-1] + k] for k in range(AHEAD[-1] + 1)]
            parts.append([*(c[inner] for c in columns), *later, e[inner]])
            rows += e.size
            if rows >= MOST_ROWS:
                break
        if not parts:
            return None
        turned = triangle(np.concatenate([turned_rows(part) for part in parts]))
        count = sum(part[-1].size for part in parts)
        return cls(turned[:, :width], turned[:, width], turned[:, width + 1 : -1], turned[:, -1], count)

    def statistic(self, first: int) -> tuple[float, float] | None:
        """What the input from ``first`` samples ahead on, 0 or 1, explains, and its limit, of the better horizon."""
        past = np.column_stack([self.past, self.now]) if first else self.past
        future = self.future[:, first:]
        if self.rows < 2 * (past.shape[1] + future.shape[1]):
            return None
        basis = orthonormal(past, SPANNED)
        left = self.residuals - basis @ projections(basis, self.residuals)
        own = np.linalg.norm(future, axis=0)
        future = future - basis @ (basis.T @ future)
        future = future - basis @ (basis.T @ future)
        new = np.linalg.norm(future, axis=0) > SPANNED * np.where(own > 0, own, 1.0)
        worst: tuple[float, float] | None = None
        for horizon in AHEAD:
            kept = future[:, : horizon + 1 - first][:, new[: horizon + 1 - first]]
            if not kept.size:
                continue
            seen = orthonormal(kept, SPANNED)
            explained, total = float(np.sum((seen.T @ left) ** 2)), dot(left, left)
            rest = (total - explained) / (self.rows - basis.shape[1] - seen.shape[1])
            if not rest > 0:
                continue
            found = explained / rest, chi_squared(seen.shape[1], LEVEL / len(AHEAD))
            if worst is None or found[0] / found[1] > worst[0] / worst[1]:
                worst = found
        return worst
