"""Exception classes. Messages name the object, the first bad index, the count and the remedy."""

from __future__ import annotations

from typing import Any


class FtlmError(Exception):
    """Base class of all exceptions of ftlm."""


class DataError(FtlmError, ValueError):
    """Unusable data: a file, a column, a sample, a unit."""


class ModelError(FtlmError, ValueError):
    """Unusable model, equation, order, order grid or option."""


class ConvergenceError(FtlmError):
    """Estimation that ended without a reliable result."""


class RigFault(FtlmError):  # noqa: N818 — a fault, as people at a rig say
    """Fault of the rig; `run` holds the samples recorded until then, if there were at least three."""

    run: Any = None


class InternalError(FtlmError):
    """Defect of ftlm itself; please report it with the message."""
