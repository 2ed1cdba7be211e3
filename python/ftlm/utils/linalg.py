"""Tall matrices and long rows, by the core and on one thread.

A library that shares one factorisation, or one long sum, out among threads leaves these waiting for more with their
processors busy, for a tenth of a second each time: more than most of what is computed here takes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ftlm import _core
from ftlm.utils.validation import Floats

#: Rows of columns that are laid out at a time.
ROWS = 1 << 12


def dot(one: Floats, other: Floats) -> float:
    """Sum of the products of two rows."""
    return float(np.einsum("i,i->", one, other))


def projections(columns: Floats, row: Floats) -> Floats:
    """Sum of the products of each column with a row."""
    return np.asarray(np.einsum("ij,i->j", columns, row))


def length(row: Floats) -> float:
    """Root of the sum of squares of a row."""
    return float(np.sqrt(dot(row, row)))


def triangle(tall: Floats) -> Floats:
    """A matrix turned so that all rows but as many as it has columns hold 0; those that do are left out.

    A rotation of the rows leaves every inner product as it is, and with it every least squares among the columns.
    """
    return _core.triangle(np.ascontiguousarray(tall.T))


def turned_rows(columns: Sequence[Floats]) -> Floats:
    """The same of a matrix that is there by its columns, without laying it out as a whole."""
    whole = np.zeros((0, len(columns)))
    for first in range(0, len(columns[0]), ROWS):
        part = np.stack([column[first : first + ROWS] for column in columns])
        whole = _core.triangle(np.hstack([whole.T, part]))
    return whole


def singular(tall: Floats) -> tuple[Floats, Floats, Floats]:
    """Singular values in the middle: the matrix is left * sizes @ right."""
    left, sizes, right = _core.singular(np.ascontiguousarray(tall.T))
    return left.reshape(sizes.size, len(tall)).T, sizes, right.reshape(sizes.size, tall.shape[1])


def solved(tall: Floats, wanted: Floats, rcond: float | None) -> Floats:
    """The shortest of the least squares; singular values below a share ``rcond`` of the largest are 0.

    None: those below rounding.
    """
    columns = tall.shape[1]
    both = triangle(np.column_stack([tall, wanted]))
    if rcond is None:
        rcond = float(np.finfo(np.float64).eps) * max(tall.shape)
    return np.asarray(np.linalg.lstsq(both[:, :columns], both[:, columns], rcond=rcond)[0])


def orthonormal(columns: Floats, least: float) -> Floats:
    """An orthonormal basis of columns of any size; what is left of one below a share ``least`` is rounding."""
    sizes = np.linalg.norm(columns, axis=0)
    directions, spread, _ = singular(columns / np.where(sizes > 0, sizes, 1.0))
    kept: Floats = directions[:, spread > least * spread.max(initial=0.0)]
    return kept
