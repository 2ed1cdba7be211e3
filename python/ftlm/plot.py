"""Figures for papers: matplotlib objects, with ``ax=`` in every function; nothing is shown, saved or kept."""

from ftlm.report.plots import (  # noqa: I001 — packed, so that a face stays short
    bode, correlation, fit, impulse, landscape, models, poles, residual_series, residuals, run, step,
)  # fmt: skip
from ftlm.report.response_plots import nyquist, response

__all__ = ["bode", "correlation", "fit", "impulse", "landscape", "models", "nyquist", "poles", "residual_series",
           "residuals", "response", "run", "step"]  # fmt: skip
