"""Reproduction of the paper's section 5, and a short demonstration."""

from ftlm.reproduction.checks import Check, table_3_coefficients
from ftlm.reproduction.cross_validation import (
    Deflection,
    OrderCrossValidation,
    Verdict,
    cross_validate_orders,
    cross_validation_page,
)
from ftlm.reproduction.published_values import AsPrinted, as_printed, implied_spreads, printed_saturation
from ftlm.reproduction.simulated_arm import demo_plant, demo_run
from ftlm.reproduction.stage import Candidate, OptimizerComparison, Stage

__all__ = [
    "AsPrinted",
    "Candidate",
    "Check",
    "Deflection",
    "OptimizerComparison",
    "OrderCrossValidation",
    "Stage",
    "Verdict",
    "as_printed",
    "cross_validate_orders",
    "cross_validation_page",
    "demo_plant",
    "demo_run",
    "implied_spreads",
    "printed_saturation",
    "table_3_coefficients",
]
