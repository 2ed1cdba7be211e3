"""Fractional-order models of flexible machines from measured data.

Public names in the order in which a measurement passes them: runs, operators, equations and models, identification and
order search, simulation and validation.
"""

from ftlm import rig
from ftlm._core import __version__
from ftlm.baselines import Genetic
from ftlm.errors import ConvergenceError, DataError, FtlmError, InternalError, ModelError, RigFault
from ftlm.files import load
from ftlm.flexible_link import PARAMETERS, LinkParameters, flexible_link, link_model, order_law
from ftlm.identification import Identification, Trace, identify, multi_innovation_trace
from ftlm.many import Identified, identify_many
from ftlm.models import Equation, Estimate, Model, Order, SensorFilter, Structure, Term, equation, load_model
from ftlm.operators import (
    block_pulse_matrix,
    fractional_derivative,
    fractional_integral,
    haar_inverse,
    haar_matrix,
    haar_transform,
    operational_matrix,
)
from ftlm.order_search import (
    Lattice,
    SearchResult,
    SearchRow,
    StoreStatus,
    lattice,
    resume_search,
    search_orders,
    search_status,
)
from ftlm.physical import PhysicalParameter, physical_parameters
from ftlm.reproduction import Reproduction, reproduce
from ftlm.residuals import CorrelationTest, InformationCriteria, OutputResiduals, Residuals, information_criteria, resid
from ftlm.runs import Run
from ftlm.simulation import explicit_euler, simulate
from ftlm.validation import Comparison, Metrics, compare, metrics

__all__ = [
    "PARAMETERS",
    "Comparison",
    "ConvergenceError",
    "CorrelationTest",
    "DataError",
    "Equation",
    "Estimate",
    "FtlmError",
    "Genetic",
    "Identification",
    "Identified",
    "InformationCriteria",
    "InternalError",
    "Lattice",
    "LinkParameters",
    "Metrics",
    "Model",
    "ModelError",
    "Order",
    "OutputResiduals",
    "PhysicalParameter",
    "Reproduction",
    "Residuals",
    "RigFault",
    "Run",
    "SearchResult",
    "SearchRow",
    "SensorFilter",
    "StoreStatus",
    "Structure",
    "Term",
    "Trace",
    "__version__",
    "block_pulse_matrix",
    "compare",
    "equation",
    "explicit_euler",
    "flexible_link",
    "fractional_derivative",
    "fractional_integral",
    "haar_inverse",
    "haar_matrix",
    "haar_transform",
    "identify",
    "identify_many",
    "information_criteria",
    "lattice",
    "link_model",
    "load",
    "load_model",
    "metrics",
    "multi_innovation_trace",
    "operational_matrix",
    "order_law",
    "physical_parameters",
    "reproduce",
    "resid",
    "resume_search",
    "rig",
    "search_orders",
    "search_status",
    "simulate",
]


def __getattr__(name: str) -> object:
    """`ftlm.plot`, imported when it is first asked for: drawing needs more than everything else."""
    if name == "plot":
        from importlib import import_module  # noqa: PLC0415

        return import_module("ftlm.plot")
    raise AttributeError(f"module 'ftlm' has no attribute {name!r}")
