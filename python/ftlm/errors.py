"""Exception classes of ftlm.

A message names the argument or file, what was found (with the first index and the count), and a remedy.
"""

from __future__ import annotations

from typing import Any


class FtlmError(Exception):
    """Base class of all exceptions of ftlm."""


class DataError(FtlmError, ValueError):
    """Error for invalid data: a file, a column, a sample or a unit."""


class ModelError(FtlmError, ValueError):
    """Error for an invalid model, equation, order, order grid or option."""


class ConvergenceError(FtlmError):
    """Error for an estimation that ended without a reliable result."""


class RigFault(FtlmError):  # noqa: N818 — a fault, as people at a rig say
    """Error for a fault of the rig; `run` contains the samples recorded up to the fault, None for fewer than three."""

    run: Any = None


class InternalError(FtlmError):
    """Error for a defect of ftlm itself; please report it with the message."""
