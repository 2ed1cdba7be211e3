"""What to do about a run before anything is identified from it."""

from ftlm.data.advice import Advice, Finding, advise

__all__ = ["Advice", "Finding", "advise"]
