"""Linear algebra of tall-skinny matrices by the core on one thread.

Multithreaded libraries leave their threads spinning for a tenth of a second after each factorization, which is longer
than most computations here.
"""

from __future__ import annotations

import numpy as np

from ftlm import _core
from ftlm.utils.validation import Floats


def dot(one: Floats, other: Floats) -> float:
    """Dot product of two vectors."""
    return float(np.einsum("i,i->", one, other))


def projections(columns: Floats, row: Floats) -> Floats:
    """Dot product of each column with a vector."""
    return np.asarray(np.einsum("ij,i->j", columns, row))


def linear_combinations(columns: Floats, amounts: Floats) -> Floats:
    """Sum of the columns, each times its amount; one sum per column of amounts if these are a matrix."""
    return np.asarray(np.einsum("ij,j...->i...", columns, amounts))


def vector_norm(row: Floats) -> float:
    """Euclidean norm of a vector."""
    return float(np.sqrt(dot(row, row)))


def column_norms(columns: Floats) -> Floats:
    """Euclidean norm of each column, without overflow or underflow."""
    # Squares of large columns overflow.
    peaks = np.max(np.abs(columns), axis=0, initial=0.0)
    return np.asarray(peaks * np.linalg.norm(columns / np.where(peaks > 0, peaks, 1.0), axis=0))


def triangular_factor(tall: Floats) -> Floats:
    """Triangular factor R of the QR factorization of a tall matrix.

    Orthogonal transformations preserve the inner products of the columns, and with them all least-squares problems.
    """
    return _core.triangular_factor(np.ascontiguousarray(tall.T))


def thin_svd(tall: Floats) -> tuple[Floats, Floats, Floats]:
    """Thin singular value decomposition: the matrix is left * sizes @ right."""
    u, sizes, right = _core.singular_values(np.ascontiguousarray(tall.T))
    return u.reshape(sizes.size, len(tall)).T, sizes, right.reshape(sizes.size, tall.shape[1])


def minimum_norm_solution(tall: Floats, target: Floats, rcond: float | None) -> Floats:
    """Minimum-norm least-squares solution; singular values below a share ``rcond`` of the largest are zero.

    Without ``rcond`` the cutoff is the rounding level.
    """
    columns = tall.shape[1]
    both = triangular_factor(np.column_stack([tall, target]))
    if rcond is None:
        rcond = float(np.finfo(np.float64).eps) * max(tall.shape)
    return np.asarray(np.linalg.lstsq(both[:, :columns], both[:, columns], rcond=rcond)[0])


def orthonormal(columns: Floats, least: float) -> Floats:
    """Orthonormal basis of columns of any scale; directions below a share ``least`` are dropped."""
    sizes = column_norms(columns)
    directions, spread, _ = thin_svd(columns / np.where(sizes > 0, sizes, 1.0))
    basis: Floats = directions[:, spread > least * spread.max(initial=0.0)]
    return basis
