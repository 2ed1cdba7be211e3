"""Every error ftlm raises: the thing, the first bad index, the count and the way out."""

from ftlm.base.errors import ConvergenceError, DataError, FtlmError, InternalError, ModelError, RigFault

__all__ = ["ConvergenceError", "DataError", "FtlmError", "InternalError", "ModelError", "RigFault"]
