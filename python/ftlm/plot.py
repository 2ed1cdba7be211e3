"""Figures for papers: matplotlib objects, with ``ax=`` in every function; nothing is shown, saved or kept."""

from ftlm.report.design_plots import design  # noqa: I001 — packed, so that a face stays short
from ftlm.report.plots import (
    bode, correlation, fit, impulse, landscape, models, poles, residual_series, residuals, run, step,
)  # fmt: skip
from ftlm.report.response_plots import nyquist, response

__all__ = ["bode", "correlation", "design", "fit", "impulse", "landscape", "models", "nyquist", "poles",
           "residual_series", "residuals", "response", "run", "step"]  # fmt: skip
