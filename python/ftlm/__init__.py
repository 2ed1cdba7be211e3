"""Fractional-order models of flexible machines from measured data.

Public names are imported on first use, because importing all of them takes longer than NumPy.
"""

import importlib as _importlib
import typing as _typing

if _typing.TYPE_CHECKING:
    from ftlm import rig as rig
    from ftlm._core import __version__ as __version__
    from ftlm.analysis.model_algebra import transfer_function as transfer_function
    from ftlm.arm.energy_balance import energies as energies
    from ftlm.arm.flexible_link import PARAMETER_SETS as PARAMETER_SETS
    from ftlm.arm.flexible_link import LinkParameters as LinkParameters
    from ftlm.arm.flexible_link import flexible_link as flexible_link
    from ftlm.arm.flexible_link import link_model as link_model
    from ftlm.arm.flexible_link import order_law as order_law
    from ftlm.data.frequency_data import FrequencyData as FrequencyData
    from ftlm.data.run import Run as Run
    from ftlm.errors import ConvergenceError as ConvergenceError
    from ftlm.errors import DataError as DataError
    from ftlm.errors import FtlmError as FtlmError
    from ftlm.errors import InternalError as InternalError
    from ftlm.errors import ModelError as ModelError
    from ftlm.errors import RigFault as RigFault
    from ftlm.estimation.consistency import Consistency as Consistency
    from ftlm.estimation.consistency import ParameterDifference as ParameterDifference
    from ftlm.estimation.consistency import consistency as consistency
    from ftlm.estimation.frequency_domain import identify_frequency as identify_frequency
    from ftlm.estimation.frequency_result import FrequencyIdentification as FrequencyIdentification
    from ftlm.estimation.frequency_result import FrequencyValidation as FrequencyValidation
    from ftlm.estimation.genetic import GeneticAlgorithm as GeneticAlgorithm
    from ftlm.estimation.identify import BatchResult as BatchResult
    from ftlm.estimation.identify import identify as identify
    from ftlm.estimation.identify import identify_many as identify_many
    from ftlm.estimation.linear import MultiInnovationTrace as MultiInnovationTrace
    from ftlm.estimation.linear import multi_innovation_trace as multi_innovation_trace
    from ftlm.estimation.methods import InstrumentalVariables as InstrumentalVariables
    from ftlm.estimation.methods import LeastSquares as LeastSquares
    from ftlm.estimation.methods import MultiInnovation as MultiInnovation
    from ftlm.estimation.methods import OutputError as OutputError
    from ftlm.estimation.order_ranking import search_orders as search_orders
    from ftlm.estimation.output_error import ProfileInterval as ProfileInterval
    from ftlm.estimation.physical_parameters import PhysicalParameter as PhysicalParameter
    from ftlm.estimation.physical_parameters import physical_parameters as physical_parameters
    from ftlm.estimation.result import Identification as Identification
    from ftlm.estimation.verdict import Validation as Validation
    from ftlm.estimation.verdict import Verdict as Verdict
    from ftlm.experiment_design.design_input import design_input as design_input
    from ftlm.experiment_design.result import DesignedInput as DesignedInput
    from ftlm.findings import Finding as Finding
    from ftlm.fractional_calculus import block_pulse_matrix as block_pulse_matrix
    from ftlm.fractional_calculus import fractional_derivative as fractional_derivative
    from ftlm.fractional_calculus import fractional_integral as fractional_integral
    from ftlm.fractional_calculus import haar_inverse as haar_inverse
    from ftlm.fractional_calculus import haar_matrix as haar_matrix
    from ftlm.fractional_calculus import haar_transform as haar_transform
    from ftlm.fractional_calculus import operational_matrix as operational_matrix
    from ftlm.io.dialect import Assumption as Assumption
    from ftlm.io.dialect import Layout as Layout
    from ftlm.io.load import load as load
    from ftlm.io.load_frequency import load_frequency as load_frequency
    from ftlm.io.preview import FileColumn as FileColumn
    from ftlm.io.preview import OpenedFile as OpenedFile
    from ftlm.io.preview import open_file as open_file
    from ftlm.model.model import Estimate as Estimate
    from ftlm.model.model import Model as Model
    from ftlm.model.parameter_estimates import Parameter as Parameter
    from ftlm.model.serialization import load_model as load_model
    from ftlm.order_search.certificate import certify_orders as certify_orders
    from ftlm.order_search.result import OrderCertificate as OrderCertificate
    from ftlm.order_search.result import SearchResult as SearchResult
    from ftlm.order_search.result import SearchRow as SearchRow
    from ftlm.order_search.result import StoreStatus as StoreStatus
    from ftlm.order_search.search import resume_search as resume_search
    from ftlm.order_search.search import search_status as search_status
    from ftlm.reproduction.reproduction import Reproduction as Reproduction
    from ftlm.reproduction.reproduction import reproduce as reproduce
    from ftlm.simulation.simulate import explicit_euler as explicit_euler
    from ftlm.simulation.simulate import simulate as simulate
    from ftlm.structure.circuit import Circuit as Circuit
    from ftlm.structure.equation import Equation as Equation
    from ftlm.structure.equation import Friction as Friction
    from ftlm.structure.equation import Stribeck as Stribeck
    from ftlm.structure.equation import Term as Term
    from ftlm.structure.order import Order as Order
    from ftlm.structure.order_grid import OrderGrid as OrderGrid
    from ftlm.structure.order_grid import order_grid as order_grid
    from ftlm.structure.parser import equation as equation
    from ftlm.structure.sensor_filter import SensorFilter as SensorFilter
    from ftlm.structure.structure import Structure as Structure
    from ftlm.structure_selection.cross_validation import Trial as Trial
    from ftlm.structure_selection.result import Selection as Selection
    from ftlm.structure_selection.select import select as select
    from ftlm.validation.comparison import Comparison as Comparison
    from ftlm.validation.comparison import Metrics as Metrics
    from ftlm.validation.comparison import compare as compare
    from ftlm.validation.comparison import metrics as metrics
    from ftlm.validation.feedback import FeedbackTest as FeedbackTest
    from ftlm.validation.information_criteria import InformationCriteria as InformationCriteria
    from ftlm.validation.information_criteria import information_criteria as information_criteria
    from ftlm.validation.residual_tests import CorrelationTest as CorrelationTest
    from ftlm.validation.residual_tests import OutputResiduals as OutputResiduals
    from ftlm.validation.residual_tests import Residuals as Residuals
    from ftlm.validation.residual_tests import resid as resid

#: Module of each public name.
_MODULE_BY_NAME = {
    name: module
    for module, names in {
        "_core": "__version__",
        "analysis.model_algebra": "transfer_function",
        "arm.energy_balance": "energies",
        "arm.flexible_link": "PARAMETER_SETS LinkParameters flexible_link link_model order_law",
        "data.frequency_data": "FrequencyData",
        "data.run": "Run",
        "errors": "ConvergenceError DataError FtlmError InternalError ModelError RigFault",
        "estimation.consistency": "Consistency ParameterDifference consistency",
        "estimation.frequency_domain": "identify_frequency",
        "estimation.frequency_result": "FrequencyIdentification FrequencyValidation",
        "estimation.genetic": "GeneticAlgorithm",
        "estimation.identify": "BatchResult identify identify_many",
        "estimation.linear": "MultiInnovationTrace multi_innovation_trace",
        "estimation.methods": "InstrumentalVariables LeastSquares MultiInnovation OutputError",
        "estimation.order_ranking": "search_orders",
        "estimation.output_error": "ProfileInterval",
        "estimation.physical_parameters": "PhysicalParameter physical_parameters",
        "estimation.result": "Identification",
        "estimation.verdict": "Validation Verdict",
        "experiment_design.design_input": "design_input",
        "experiment_design.result": "DesignedInput",
        "findings": "Finding",
        "fractional_calculus": "block_pulse_matrix fractional_derivative fractional_integral haar_inverse haar_matrix "
        "haar_transform operational_matrix",
        "io.dialect": "Assumption Layout",
        "io.load": "load",
        "io.load_frequency": "load_frequency",
        "io.preview": "FileColumn OpenedFile open_file",
        "model.model": "Estimate Model",
        "model.parameter_estimates": "Parameter",
        "model.serialization": "load_model",
        "order_search.certificate": "certify_orders",
        "order_search.result": "OrderCertificate SearchResult SearchRow StoreStatus",
        "order_search.search": "resume_search search_status",
        "reproduction.reproduction": "Reproduction reproduce",
        "simulation.simulate": "explicit_euler simulate",
        "structure.circuit": "Circuit",
        "structure.equation": "Equation Friction Stribeck Term",
        "structure.order": "Order",
        "structure.order_grid": "OrderGrid order_grid",
        "structure.parser": "equation",
        "structure.sensor_filter": "SensorFilter",
        "structure.structure": "Structure",
        "structure_selection.cross_validation": "Trial",
        "structure_selection.result": "Selection",
        "structure_selection.select": "select",
        "validation.comparison": "Comparison Metrics compare metrics",
        "validation.information_criteria": "InformationCriteria information_criteria",
        "validation.feedback": "FeedbackTest",
        "validation.residual_tests": "CorrelationTest OutputResiduals Residuals resid",
    }.items()
    for name in names.split()
}
#: Public modules that are attributes of the package.
_PUBLIC_MODULES = frozenset(
    {
        "control",
        "errors",
        "analysis",
        "kernels",
        "plot",
        "progress",
        "report",
        "reproduction",
        "rig",
        "sklearn",
        "validation",
    }
)

__all__ = list(sorted({*_MODULE_BY_NAME, "rig"}, key=lambda name: (not name.isupper(), not name[0].isupper(), name)))


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
