"""Analysis of a model: frequency response, poles, modes, steady state, time responses, and export to other tools."""

from ftlm.analysis.conversion import control_text, export_text, json_text, matlab_text, to_ss, to_tf
from ftlm.analysis.frequency_response import (
    TransferFunctions,
    frequency_response,
    response_deviation,
    step_response,
    transfer_functions,
)
from ftlm.analysis.poles import Mode, Stability, SteadyState, dcgain, modes, poles, stability, steady_states, zeros
from ftlm.analysis.rational_approximation import Approximation, approximate, to_control

__all__ = [
    "Approximation",
    "Mode",
    "Stability",
    "SteadyState",
    "TransferFunctions",
    "approximate",
    "control_text",
    "dcgain",
    "export_text",
    "frequency_response",
    "json_text",
    "matlab_text",
    "modes",
    "poles",
    "response_deviation",
    "stability",
    "steady_states",
    "step_response",
    "to_control",
    "to_ss",
    "to_tf",
    "transfer_functions",
    "zeros",
]
