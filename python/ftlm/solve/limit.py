"""The limit for step 0 of samples on ever finer grids, each of half the step of the one before (Romberg's triangle)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ftlm.base.arrays import Floats

#: Powers of the step that the error of a sample has: the second is the pulse scheme's; the third comes with reading an
#: instant from the pulses before it; then the next of both. A kink t^eta leaves powers in between, which these columns
#: do not take away, but none makes the error larger by more than a small factor.
POWERS = (2, 3, 4)
#: A column is taken for the power that it still has where halving the step divided what it moves by this share of that
#: power's factor at least.
SEEN = 0.5


def _moved(new: Floats, old: Floats) -> Floats:
    moved, size = np.max(np.abs(new - old), axis=1), np.max(np.abs(new), axis=1)
    return np.asarray(np.where(moved == 0.0, 0.0, moved / size))


@dataclass
class Limit:
    """What grids of 1, 1/2, 1/4, … of a step say together; samples have the shape (outputs, N).

    Parameters
    ----------
    rows
        Of the last grids, finest last: the samples, and those with one power of the step after another taken away.
    moved
        By which share of its largest value halving the step moved each output in each of these columns, for the last
        two halvings; infinite for the samples themselves.
    measure
        That share, of samples on a grid and on the one before.
    """

    rows: list[list[Floats]] = field(default_factory=list)
    moved: list[list[Floats]] = field(default_factory=list)
    measure: Callable[[Floats, Floats], Floats] = _moved

    def add(self, samples: Floats) -> None:
        """The samples on the next grid; a grid without finite numbers tells nothing, and everything begins anew."""
        before = self.rows[-1] if self.rows else []
        both = bool(before) and bool(np.all(np.isfinite(before[0])) and np.all(np.isfinite(samples)))
        row = extrapolated(samples, before if both else [])
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            # Nobody asks for the samples themselves: what was taken away moves less.
            moved = [unknown(samples.shape[0])] * min(len(row), len(before))
            moved[1:] = [self.measure(new, old) for new, old in zip(row[1:], before[1:], strict=False)]
        self.rows = [*self.rows, row][-2:]
        self.moved = [*self.moved, moved][-2:]

    @property
    def best(self) -> tuple[int, Floats]:
        """The column that another halving would move least, and by which share of each output's largest value.

        Infinite before there were three grids.
        """
        row, last = self.rows[-1], self.moved[-1]
        found: tuple[int, Floats] = (len(row) - 1 if len(row) <= 2 else 1, unknown(row[0].shape[0]))
        for column in range(1, len(last)):
            told = [(column, last[column])]
            before = self.moved[0][column] if len(self.moved) > 1 and column < len(self.moved[0]) else None
            if before is not None and column + 1 < len(row):
                factor = 2.0 ** POWERS[column]
                # What is left of a column whose power shows is what the next column takes away.
                if np.all(last[column] * (SEEN * factor) <= before):
                    told.append((column + 1, last[column] / (factor - 1.0)))
            found = min([found, *told], key=lambda pair: float(np.max(_known(pair[1]))))
        return found


def extrapolated(fine: Floats, coarse: Sequence[Floats]) -> list[Floats]:
    """A row of the triangle from numbers on a grid and the row of twice its step."""
    row = [fine]
    with np.errstate(invalid="ignore", over="ignore"):
        for power, before in zip(POWERS, coarse, strict=False):
            factor = 2.0**power
            row.append((factor * row[-1] - before) / (factor - 1.0))
    return row


def unknown(outputs: int) -> Floats:
    """The change of outputs of which nothing is known."""
    return np.full(outputs, np.inf)


def _known(change: Floats) -> Floats:
    """Without numbers, a change is as large as can be."""
    return np.where(np.isnan(change), np.inf, change)
