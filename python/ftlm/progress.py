"""Progress of long work on standard error."""

from ftlm.base.progress import Progress, Stoppable

__all__ = ["Progress", "Stoppable"]
