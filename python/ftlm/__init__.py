"""Fractional-order models of flexible machines from measured data.

Public names are imported on first use, because importing all of them takes longer than NumPy.
"""

import importlib as _importlib
import typing as _typing

if _typing.TYPE_CHECKING:
    from ftlm import rig
    from ftlm._core import __version__
    from ftlm.arm.energy_balance import energies
    from ftlm.arm.flexible_link import PARAMETER_SETS, LinkParameters, flexible_link, link_model, order_law
    from ftlm.data.frequency_data import FrequencyData
    from ftlm.data.run import Run
    from ftlm.errors import ConvergenceError, DataError, FtlmError, InternalError, ModelError, RigFault
    from ftlm.estimation.consistency import Consistency, ParameterDifference, consistency
    from ftlm.estimation.frequency_domain import identify_frequency
    from ftlm.estimation.frequency_result import FrequencyIdentification, FrequencyValidation
    from ftlm.estimation.genetic import GeneticAlgorithm
    from ftlm.estimation.identify import BatchResult, identify, identify_many
    from ftlm.estimation.linear import MultiInnovationTrace, multi_innovation_trace
    from ftlm.estimation.methods import InstrumentalVariables, LeastSquares, MultiInnovation, OutputError
    from ftlm.estimation.output_error import ProfileInterval
    from ftlm.estimation.physical_parameters import PhysicalParameter, physical_parameters
    from ftlm.estimation.result import Identification
    from ftlm.estimation.verdict import Validation, Verdict
    from ftlm.experiment_design.design_input import design_input
    from ftlm.experiment_design.result import DesignedInput
    from ftlm.fractional_calculus import (
        block_pulse_matrix,
        fractional_derivative,
        fractional_integral,
        haar_inverse,
        haar_matrix,
        haar_transform,
        operational_matrix,
    )
    from ftlm.io.dialect import Assumption, Layout
    from ftlm.io.load import load
    from ftlm.io.load_frequency import load_frequency
    from ftlm.io.preview import FileColumn, OpenedFile, open_file
    from ftlm.model.model import Estimate, Model, load_model
    from ftlm.order_search.certificate import certify_orders
    from ftlm.order_search.result import OrderCertificate, SearchResult, SearchRow, StoreStatus
    from ftlm.order_search.search import resume_search, search_orders, search_status
    from ftlm.reproduction.reproduction import Reproduction, reproduce
    from ftlm.simulation.simulate import explicit_euler, simulate
    from ftlm.structure.equation import Equation, Friction, Stribeck, Term
    from ftlm.structure.order import Order
    from ftlm.structure.order_grid import OrderGrid, order_grid
    from ftlm.structure.parser import equation
    from ftlm.structure.sensor_filter import SensorFilter
    from ftlm.structure.structure import Structure
    from ftlm.structure_selection.cross_validation import Trial
    from ftlm.structure_selection.result import Selection
    from ftlm.structure_selection.select import select
    from ftlm.validation.comparison import Comparison, Metrics, compare, metrics
    from ftlm.validation.information_criteria import InformationCriteria, information_criteria
    from ftlm.validation.residual_tests import CorrelationTest, FeedbackTest, OutputResiduals, Residuals, resid

__all__ = [
    "PARAMETER_SETS",
    "Assumption",
    "BatchResult",
    "Comparison",
    "Consistency",
    "ConvergenceError",
    "CorrelationTest",
    "DataError",
    "DesignedInput",
    "Equation",
    "Estimate",
    "FeedbackTest",
    "FileColumn",
    "FrequencyData",
    "FrequencyIdentification",
    "FrequencyValidation",
    "Friction",
    "FtlmError",
    "GeneticAlgorithm",
    "Identification",
    "InformationCriteria",
    "InstrumentalVariables",
    "InternalError",
    "Layout",
    "LeastSquares",
    "LinkParameters",
    "Metrics",
    "Model",
    "ModelError",
    "MultiInnovation",
    "MultiInnovationTrace",
    "OpenedFile",
    "Order",
    "OrderCertificate",
    "OrderGrid",
    "OutputError",
    "OutputResiduals",
    "ParameterDifference",
    "PhysicalParameter",
    "ProfileInterval",
    "Reproduction",
    "Residuals",
    "RigFault",
    "Run",
    "SearchResult",
    "SearchRow",
    "Selection",
    "SensorFilter",
    "StoreStatus",
    "Stribeck",
    "Structure",
    "Term",
    "Trial",
    "Validation",
    "Verdict",
    "__version__",
    "block_pulse_matrix",
    "certify_orders",
    "compare",
    "consistency",
    "design_input",
    "energies",
    "equation",
    "explicit_euler",
    "flexible_link",
    "fractional_derivative",
    "fractional_integral",
    "haar_inverse",
    "haar_matrix",
    "haar_transform",
    "identify",
    "identify_frequency",
    "identify_many",
    "information_criteria",
    "link_model",
    "load",
    "load_frequency",
    "load_model",
    "metrics",
    "multi_innovation_trace",
    "open_file",
    "operational_matrix",
    "order_grid",
    "order_law",
    "physical_parameters",
    "reproduce",
    "resid",
    "resume_search",
    "rig",
    "search_orders",
    "search_status",
    "select",
    "simulate",
]

#: Module of each public name.
_MODULE_BY_NAME = {
    name: home
    for home, names in {
        "_core": "__version__",
        "arm.energy_balance": "energies",
        "arm.flexible_link": "flexible_link link_model order_law LinkParameters PARAMETER_SETS",
        "errors": "ConvergenceError DataError FtlmError InternalError ModelError RigFault",
        "structure.equation": "Equation Friction Stribeck Term",
        "structure.parser": "equation",
        "structure.order_grid": "OrderGrid order_grid",
        "structure.order": "Order",
        "data.frequency_data": "FrequencyData",
        "data.run": "Run",
        "model.model": "Estimate Model load_model",
        "structure.structure": "SensorFilter Structure",
        "experiment_design.design_input": "design_input",
        "experiment_design.result": "DesignedInput",
        "io.dialect": "Assumption Layout",
        "io.load": "load",
        "io.preview": "FileColumn OpenedFile open_file",
        "io.load_frequency": "load_frequency",
        "estimation.genetic": "GeneticAlgorithm",
        "estimation.methods": "InstrumentalVariables LeastSquares MultiInnovation OutputError",
        "estimation.output_error": "ProfileInterval",
        "estimation.linear": "MultiInnovationTrace multi_innovation_trace",
        "estimation.consistency": "Consistency ParameterDifference consistency",
        "estimation.frequency_domain": "identify_frequency",
        "estimation.frequency_result": "FrequencyIdentification FrequencyValidation",
        "estimation.identify": "BatchResult identify identify_many",
        "estimation.physical_parameters": "PhysicalParameter physical_parameters",
        "estimation.result": "Identification",
        "estimation.verdict": "Validation Verdict",
        "validation.comparison": "Comparison compare Metrics metrics",
        "validation.information_criteria": "InformationCriteria information_criteria",
        "validation.residual_tests": "FeedbackTest CorrelationTest OutputResiduals Residuals resid",
        "reproduction.reproduction": "Reproduction reproduce",
        "order_search.certificate": "certify_orders",
        "order_search.search": "resume_search search_orders search_status",
        "order_search.result": "OrderCertificate SearchResult SearchRow StoreStatus",
        "structure_selection.result": "Selection",
        "structure_selection.select": "select",
        "structure_selection.cross_validation": "Trial",
        "simulation.simulate": "explicit_euler simulate",
        "fractional_calculus": "block_pulse_matrix fractional_derivative fractional_integral haar_inverse "
        "haar_matrix haar_transform operational_matrix",
    }.items()
    for name in names.split()
}
#: Public modules that are attributes of the package.
_PUBLIC_MODULES = frozenset(
    {
        "control",
        "errors",
        "analysis",
        "plot",
        "progress",
        "report",
        "reproduction",
        "rig",
        "sklearn",
        "validation",
    }
)


def __getattr__(name: str) -> object:
    """Import a public name or module, such as `ftlm.rig`, on first use."""
    if name in _MODULE_BY_NAME:
        value = getattr(_importlib.import_module(f"ftlm.{_MODULE_BY_NAME[name]}"), name)
    elif name in _PUBLIC_MODULES:
        value = _importlib.import_module(f"ftlm.{name}")
    else:
        raise AttributeError(f"module 'ftlm' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Public names, imported or not."""
    return sorted({*globals(), *__all__, *_PUBLIC_MODULES})
