"""Arrays of real numbers: what they are called, and how anything becomes one."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftlm.base.errors import DataError

#: Real and complex arrays of double precision.
Floats: TypeAlias = NDArray[np.float64]
Complex: TypeAlias = NDArray[np.complex128]


def as_floats(name: str, values: object) -> NDArray[np.float64]:
    """Return a float64 array of real numbers; never a view that is written to.

    Raises
    ------
    DataError
        Text, objects or complex numbers, rows of different lengths.
    """
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise DataError(f"{name} is no array: {str(error).rstrip('.')}; give rows of equal length") from error
    if array.dtype.kind not in "fiub":
        raise DataError(f"{name} holds {array.dtype} values; give real numbers")
    return np.asarray(array, dtype=np.float64, order="C")


def along(
    name: str, values: ArrayLike, axis: int, work: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Apply ``work``, which takes and returns rows, along one axis of an array."""
    array = as_floats(name, values)
    if array.ndim == 0 or not -array.ndim <= axis < array.ndim:
        raise DataError(f"{name} has {array.ndim} dimensions and no axis {axis}; give an array and one of its axes")
    moved = np.moveaxis(array, axis, -1)
    if moved.size == 0:
        raise DataError(f"{name} has shape {array.shape} and holds no value; give at least one")
    rows = np.ascontiguousarray(moved.reshape(-1, moved.shape[-1]))
    return np.moveaxis(work(rows).reshape(moved.shape), -1, axis)
