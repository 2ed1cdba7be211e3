"""The limit for step 0 of samples on ever finer grids, each of half the step of the one before (Romberg's triangle)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ftlm.base.arrays import Floats

#: Powers of the step that the error of a sample has: the second is the pulse scheme's; the third comes with reading an
#: instant from the pulses before it; then the next of both. A kink t^eta leaves powers in between, which these columns
#: do not take away, but none makes the error larger by more than a small factor.
POWERS = (2, 3, 4)
#: A column is taken for the power that it still has where halving the step divided what it moves by this share of that
#: power's factor at least.
SEEN = 0.5
#: Where no power is known, halving the step divided what moves by this factor at least (by the root of two, and a
#: little less), in as many samples as if so many alone moved: one number is told by theirs.
LEAST_RATIO, FEW = 1.4, 8.0
#: Grids that tell such a factor, and whether it is one.
GRIDS = 4


def _moved(new: Floats, old: Floats) -> Floats:
    moved, size = np.max(np.abs(new - old), axis=1), np.max(np.abs(new), axis=1)
    return np.asarray(np.where(moved == 0.0, 0.0, moved / size))


@dataclass(frozen=True)
class Told:
    """What grids tell of the limit.

    Parameters
    ----------
    samples
        The samples there.
    change
        By which share of its largest value another halving would move each output; infinite before there were three
        grids.
    beside
        The numbers beside the samples there.
    """

    samples: Floats
    change: Floats
    beside: Floats


@dataclass
class Limit:
    """What grids of 1, 1/2, 1/4, … of a step say together; samples have the shape (outputs, N).

    Parameters
    ----------
    rows
        Of the last grids, finest last: the samples, and those with one power of the step after another taken away.
    beside
        The same of numbers beside them, such as initial terms that were fitted on each grid.
    moved
        By which share of its largest value halving the step moved each output in each of these columns, for the last
        two halvings; infinite for the samples themselves.
    measure
        That share, of samples on a grid and on the one before.
    """

    rows: list[list[Floats]] = field(default_factory=list)
    beside: list[list[Floats]] = field(default_factory=list)
    moved: list[list[Floats]] = field(default_factory=list)
    measure: Callable[[Floats, Floats], Floats] = _moved

    def add(self, samples: Floats, beside: Floats | None = None) -> None:
        """The samples on the next grid; a grid without finite numbers tells nothing, and everything begins anew."""
        before = self.rows[-1] if self.rows else []
        both = bool(before) and bool(np.all(np.isfinite(before[0])) and np.all(np.isfinite(samples)))
        row = extrapolated(samples, before if both else [])
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            # Nobody asks for the samples themselves: what was taken away moves less.
            moved = [unknown(samples.shape[0])] * min(len(row), len(before))
            moved[1:] = [self.measure(new, old) for new, old in zip(row[1:], before[1:], strict=False)]
        numbers = np.zeros(0) if beside is None else beside
        self.beside = [*self.beside, extrapolated(numbers, self.beside[-1] if both else [])][-GRIDS:]
        self.rows = [*self.rows, row][-GRIDS:]
        self.moved = [*self.moved, moved][-2:]

    def told(self, owners: Sequence[int] = (), *, enough: float = 0.0) -> Told:
        """What another halving would move least; the numbers beside belong to these outputs.

        Where it moves a column by no more than what is enough, no other is looked for.
        """
        column, change = self.best
        found = Told(self.rows[-1][column], change, self.beside[-1][column])
        if len(self.rows) < GRIDS or np.all(change <= enough):
            return found
        known = min(map(len, self.rows))
        every = [found, *(self._by_ratio(k, np.array(owners, dtype=int)) for k in range(known))]
        return min((one for one in every if one is not None), key=lambda one: float(np.max(_known(one.change))))

    def _by_ratio(self, column: int, owners: NDArray[np.intp]) -> Told | None:
        """The limit of a column whose error shrinks by a factor of its own, if the grid before told one as well.

        Kinks t^eta leave powers in between, and orders that meet logarithms, which no power of the triangle takes away.
        """
        oldest, older, old, new = (row[column] for row in self.rows)
        second, third = (row[column] for row in self.beside[-2:])
        before, now = still_to_go(oldest, older, old), still_to_go(older, old, new)
        if before is None or now is None:
            return None
        with np.errstate(invalid="ignore", over="ignore"):
            samples = new + now[:, None] * (new - old)
            change = self.measure(samples, old + before[:, None] * (old - older))
        return Told(samples, change, third + now[owners] * (third - second))

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


def still_to_go(older: Floats, old: Floats, new: Floats) -> Floats | None:
    """By which share of its last move each output moves yet, if one move after another is smaller by the same factor.

    That is Aitken's, told by all samples of an output together; None where few of them move, or not ever less.
    """
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        now, before = new - old, old - older
        size = np.max(np.abs(now), axis=1, keepdims=True, initial=0.0)
        unit = now / np.where(size > 0.0, size, 1.0)
        squares = np.sum(unit**2, axis=1)
        still = squares == 0.0
        ratio = np.where(still, np.inf, np.sum(unit * before, axis=1) / np.where(still, 1.0, squares * size[:, 0]))
        if not np.all(ratio >= LEAST_RATIO) or np.any(squares**2 < FEW * np.sum(unit**4, axis=1)):
            return None
        return np.asarray(1.0 / (ratio - 1.0))


def unknown(outputs: int) -> Floats:
    """The change of outputs of which nothing is known."""
    return np.full(outputs, np.inf)


def _known(change: Floats) -> Floats:
    """Without numbers, a change is as large as can be."""
    return np.where(np.isnan(change), np.inf, change)
