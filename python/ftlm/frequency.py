"""A model in the frequency domain: response and its uncertainty, poles, modes, stability, steady state, steps."""

from ftlm.solve.frequency import (  # noqa: I001 — packed, so that a face stays short
    TransferFunctions, frequency_response, response_deviation, step_response, transfer_functions,
)  # fmt: skip
from ftlm.solve.modes import Mode, SteadyState, dcgain, modes, steady_states
from ftlm.solve.stability import Stability, poles, stability

__all__ = ["Mode", "Stability", "SteadyState", "TransferFunctions", "dcgain", "frequency_response", "modes", "poles",
           "response_deviation", "stability", "steady_states", "step_response", "transfer_functions"]  # fmt: skip
