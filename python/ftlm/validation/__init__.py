"""Validation: comparison of simulation and measurement, residual tests, information criteria, advice on data."""

from ftlm.validation.data_advice import Advice, advise

__all__ = ["Advice", "advise"]
