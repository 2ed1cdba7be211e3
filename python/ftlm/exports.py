"""Models for other tools: python-control by Oustaloup's approximation, MATLAB with FOMCON, JSON, pandas."""

from ftlm.base.frames import to_frame
from ftlm.solve.approximation import Approximation, approximate, to_control
from ftlm.solve.exports import control_text, export_text, json_text, matlab_text

__all__ = ["Approximation", "approximate", "control_text", "export_text", "json_text", "matlab_text",
           "to_control", "to_frame"]  # fmt: skip
