"""Every error ftlm raises: the thing, the first bad index, the count and the way out."""

from __future__ import annotations

from typing import Any


class FtlmError(Exception):
    """Base of all errors that ftlm raises on purpose."""


class DataError(FtlmError, ValueError):
    """Data that cannot be used as given: a file, a column, a sample, a unit."""


class ModelError(FtlmError, ValueError):
    """A model, an equation, an order or a lattice that cannot be used as given."""


class ConvergenceError(FtlmError):
    """An estimator that ended without an answer that can be trusted."""


class RigFault(FtlmError):  # noqa: N818 — a fault, as people at a rig say
    """A fault of the rig, with its cause in words; `run` is what was recorded until then, if three rows were."""

    run: Any = None


class InternalError(FtlmError):
    """A fault in ftlm itself; please report it with the message."""
