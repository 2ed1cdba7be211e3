"""A model in the frequency domain: exact response, its uncertainty, poles, stability, transfer functions, steps."""

from ftlm.solve.frequency import (  # noqa: I001 — packed, so that a face stays short
    TransferFunctions, frequency_response, response_deviation, step_response, transfer_functions,
)  # fmt: skip
from ftlm.solve.stability import Stability, poles, stability

__all__ = ["Stability", "TransferFunctions", "frequency_response", "poles", "response_deviation", "stability",
           "step_response", "transfer_functions"]  # fmt: skip
