"""Linear algebra of tall-skinny matrices, computed by the Rust core on one thread.

Multithreaded libraries are not used, because their threads occupy the processor for a tenth of a second after each
factorization. This is longer than most computations of this module take.
"""

from __future__ import annotations

import numpy as np

from ftlm import _core
from ftlm.utils.validation import Floats


def dot(a: Floats, b: Floats) -> float:
    """Return the dot product of two vectors."""
    return float(np.einsum("i,i->", a, b))


def projections(columns: Floats, vector: Floats) -> Floats:
    """Return the dot product of each column with the vector `vector`, shape (columns,)."""
    return np.asarray(np.einsum("ij,i->j", columns, vector))


def vector_norm(vector: Floats) -> float:
    """Return the Euclidean norm of a vector."""
    return float(np.sqrt(dot(vector, vector)))


def column_norms(columns: Floats) -> Floats:
    """Return the Euclidean norm of each column, without overflow or underflow."""
    # Without scaling, the squares of large values would overflow.
    scales = np.max(np.abs(columns), axis=0, initial=0.0)
    return np.asarray(scales * np.linalg.norm(columns / np.where(scales > 0, scales, 1.0), axis=0))


def triangular_factor(matrix: Floats) -> Floats:
    """Return the triangular factor R of the QR factorization of a tall matrix.

    The inner products of the columns of R are those of the matrix. Least-squares problems with columns of R therefore
    have the same solutions.
    """
    return _core.triangular_factor(np.ascontiguousarray(matrix.T))


def thin_svd(matrix: Floats) -> tuple[Floats, Floats, Floats]:
    """Return (U, s, Vt) of the thin singular value decomposition: the matrix is ``U * s @ Vt``, and s is a vector."""
    u, s, vt = _core.singular_values(np.ascontiguousarray(matrix.T))
    return u.reshape(s.size, len(matrix)).T, s, vt.reshape(s.size, matrix.shape[1])


def minimum_norm_solution(matrix: Floats, target: Floats, rcond: float | None) -> Floats:
    """Return the minimum-norm least-squares solution x of ``matrix @ x = target``.

    Singular values below `rcond` times the largest are treated as zero. With None, `rcond` is the machine epsilon times
    the larger dimension of the matrix.
    """
    columns = matrix.shape[1]
    factor = triangular_factor(np.column_stack([matrix, target]))
    if rcond is None:
        rcond = float(np.finfo(np.float64).eps) * max(matrix.shape)
    return np.asarray(np.linalg.lstsq(factor[:, :columns], factor[:, columns], rcond=rcond)[0])


def orthonormal(columns: Floats, tolerance: float) -> Floats:
    """Return a matrix whose columns are an orthonormal basis of the span of the given columns.

    The columns are normalized first. Left singular vectors are omitted if their singular value is at most `tolerance`
    times the largest.
    """
    norms = column_norms(columns)
    left_vectors, singular_values, _ = thin_svd(columns / np.where(norms > 0, norms, 1.0))
    basis: Floats = left_vectors[:, singular_values > tolerance * singular_values.max(initial=0.0)]
    return basis
