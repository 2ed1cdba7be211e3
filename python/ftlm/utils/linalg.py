"""Linear algebra of tall-skinny matrices, computed by the Rust core on one thread.

Multithreaded libraries are not used, because their threads occupy the processor for a tenth of a second after each
factorization. This is longer than most computations of this module take.
"""

from __future__ import annotations

import numpy as np

from ftlm import _core
from ftlm.utils.validation import Floats


def dot(one: Floats, other: Floats) -> float:
    """Return the dot product of two vectors."""
    return float(np.einsum("i,i->", one, other))


def projections(columns: Floats, row: Floats) -> Floats:
    """Return the dot product of each column with the vector `row`, shape (columns,)."""
    return np.asarray(np.einsum("ij,i->j", columns, row))


def vector_norm(row: Floats) -> float:
    """Return the Euclidean norm of a vector."""
    return float(np.sqrt(dot(row, row)))


def column_norms(columns: Floats) -> Floats:
    """Return the Euclidean norm of each column, without overflow or underflow."""
    # Without scaling, the squares of large values would overflow.
    peaks = np.max(np.abs(columns), axis=0, initial=0.0)
    return np.asarray(peaks * np.linalg.norm(columns / np.where(peaks > 0, peaks, 1.0), axis=0))


def triangular_factor(tall: Floats) -> Floats:
    """Return the triangular factor R of the QR factorization of a tall matrix.

    The inner products of the columns of R are those of the matrix. Least-squares problems with columns of R therefore
    have the same solutions.
    """
    return _core.triangular_factor(np.ascontiguousarray(tall.T))


def thin_svd(tall: Floats) -> tuple[Floats, Floats, Floats]:
    """Return (U, s, Vt) of the thin singular value decomposition: the matrix is ``U * s @ Vt``, and s is a vector."""
    u, sizes, right = _core.singular_values(np.ascontiguousarray(tall.T))
    return u.reshape(sizes.size, len(tall)).T, sizes, right.reshape(sizes.size, tall.shape[1])


def minimum_norm_solution(tall: Floats, target: Floats, rcond: float | None) -> Floats:
    """Return the minimum-norm least-squares solution x of ``tall @ x = target``.

    Singular values below `rcond` times the largest are treated as zero. With None, `rcond` is the machine epsilon times
    the larger dimension of the matrix.
    """
    columns = tall.shape[1]
    both = triangular_factor(np.column_stack([tall, target]))
    if rcond is None:
        rcond = float(np.finfo(np.float64).eps) * max(tall.shape)
    return np.asarray(np.linalg.lstsq(both[:, :columns], both[:, columns], rcond=rcond)[0])


def orthonormal(columns: Floats, least: float) -> Floats:
    """Return a matrix whose columns are an orthonormal basis of the span of the given columns.

    The columns are normalized first. Left singular vectors are omitted if their singular value is at most `least` times
    the largest.
    """
    sizes = column_norms(columns)
    directions, spread, _ = thin_svd(columns / np.where(sizes > 0, sizes, 1.0))
    basis: Floats = directions[:, spread > least * spread.max(initial=0.0)]
    return basis
