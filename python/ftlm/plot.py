"""Figures for papers as matplotlib objects: fits, residual tests, order landscapes, Bode plots."""

from ftlm.report.plots import bode, fit, landscape, residuals

__all__ = ["bode", "fit", "landscape", "residuals"]
