"""Fractional-order models of flexible machines from measured data.

Names are imported when they are first asked for: all of them together take longer than numpy does. Where each lives is
the way of a measurement: data, files, solve, judge, fit, model, search, identification, selection, excitation, and
beside it arm, rig, paper.
"""

import importlib as _importlib
import typing as _typing

if _typing.TYPE_CHECKING:
    from ftlm import rig
    from ftlm._core import __version__
    from ftlm.arm.energies import energies
    from ftlm.arm.link import flexible_link, link_model, order_law
    from ftlm.arm.parameters import PARAMETERS, LinkParameters
    from ftlm.base.errors import ConvergenceError, DataError, FtlmError, InternalError, ModelError, RigFault
    from ftlm.data.equations import Equation, Friction, Stribeck, Term
    from ftlm.data.filters import SensorFilter
    from ftlm.data.language import equation
    from ftlm.data.lattice import Lattice, lattice
    from ftlm.data.orders import Order
    from ftlm.data.response import FrequencyData
    from ftlm.data.run import Run
    from ftlm.data.solved import Estimate
    from ftlm.data.structures import Structure
    from ftlm.excitation.experiment import design_input
    from ftlm.excitation.result import DesignedInput
    from ftlm.files.layout import Assumption, Layout
    from ftlm.files.load import load
    from ftlm.files.opened import FileColumn, OpenedFile, open_file
    from ftlm.files.response import load_frequency
    from ftlm.fit.genetic import Genetic
    from ftlm.fit.interval import ProfileInterval
    from ftlm.fit.recursion import Trace, multi_innovation_trace
    from ftlm.identification.agreement import Agreement, Difference, agreement
    from ftlm.identification.frequency import identify_frequency
    from ftlm.identification.frequency_result import FrequencyIdentification, FrequencyValidation
    from ftlm.identification.identify import identify
    from ftlm.identification.many import Identified, identify_many
    from ftlm.identification.physical import PhysicalParameter, physical_parameters
    from ftlm.identification.result import Identification
    from ftlm.identification.verdict import Validation, Verdict
    from ftlm.judge.comparison import Comparison, compare
    from ftlm.judge.criteria import InformationCriteria, information_criteria
    from ftlm.judge.feedback import FeedbackTest
    from ftlm.judge.metrics import Metrics, metrics
    from ftlm.judge.residuals import CorrelationTest, OutputResiduals, Residuals, resid
    from ftlm.model.model import Model, load_model
    from ftlm.paper.reproduction import Reproduction, reproduce
    from ftlm.search.certificate import certify_orders
    from ftlm.search.orders import resume_search, search_orders, search_status
    from ftlm.search.proved import OrderCertificate
    from ftlm.search.result import SearchResult, SearchRow, StoreStatus
    from ftlm.selection.result import Selection
    from ftlm.selection.select import select
    from ftlm.selection.trial import Trial
    from ftlm.solve.free_run import explicit_euler, simulate
    from ftlm.solve.operators import (
        block_pulse_matrix,
        fractional_derivative,
        fractional_integral,
        haar_inverse,
        haar_matrix,
        haar_transform,
        operational_matrix,
    )

__all__ = [
    "PARAMETERS", "Agreement", "Assumption", "Comparison", "ConvergenceError", "CorrelationTest", "DataError",
    "DesignedInput", "Difference", "Equation", "Estimate", "FeedbackTest", "FileColumn", "FrequencyData",
    "FrequencyIdentification", "FrequencyValidation", "Friction", "FtlmError", "Genetic", "Identification",
    "Identified", "InformationCriteria", "InternalError", "Lattice", "Layout", "LinkParameters", "Metrics", "Model",
    "ModelError", "OpenedFile", "Order", "OrderCertificate", "OutputResiduals", "PhysicalParameter", "ProfileInterval",
    "Reproduction", "Residuals", "RigFault", "Run", "SearchResult", "SearchRow", "Selection", "SensorFilter",
    "StoreStatus", "Stribeck", "Structure", "Term", "Trace", "Trial", "Validation", "Verdict", "__version__",
    "agreement", "block_pulse_matrix", "certify_orders", "compare", "design_input", "energies", "equation",
    "explicit_euler", "flexible_link", "fractional_derivative", "fractional_integral", "haar_inverse", "haar_matrix",
    "haar_transform", "identify", "identify_frequency", "identify_many", "information_criteria", "lattice",
    "link_model", "load", "load_frequency", "load_model", "metrics", "multi_innovation_trace", "open_file",
    "operational_matrix", "order_law", "physical_parameters", "reproduce", "resid", "resume_search", "rig",
    "search_orders", "search_status", "select", "simulate",
]  # fmt: skip

#: Where each name lives.
_HOMES = {
    name: home
    for home, names in {
        "_core": "__version__",
        "arm.energies": "energies",
        "arm.link": "flexible_link link_model order_law",
        "arm.parameters": "LinkParameters PARAMETERS",
        "base.errors": "ConvergenceError DataError FtlmError InternalError ModelError RigFault",
        "data.equations": "Equation Friction Stribeck Term",
        "data.language": "equation",
        "data.lattice": "Lattice lattice",
        "data.orders": "Order",
        "data.response": "FrequencyData",
        "data.run": "Run",
        "data.solved": "Estimate",
        "data.structures": "SensorFilter Structure",
        "excitation.experiment": "design_input",
        "excitation.result": "DesignedInput",
        "files.layout": "Assumption Layout",
        "files.load": "load",
        "files.opened": "FileColumn OpenedFile open_file",
        "files.response": "load_frequency",
        "fit.genetic": "Genetic",
        "fit.interval": "ProfileInterval",
        "fit.recursion": "Trace multi_innovation_trace",
        "identification.agreement": "Agreement Difference agreement",
        "identification.frequency": "identify_frequency",
        "identification.frequency_result": "FrequencyIdentification FrequencyValidation",
        "identification.identify": "identify",
        "identification.many": "Identified identify_many",
        "identification.physical": "PhysicalParameter physical_parameters",
        "identification.result": "Identification",
        "identification.verdict": "Validation Verdict",
        "judge.comparison": "Comparison compare",
        "judge.criteria": "InformationCriteria information_criteria",
        "judge.feedback": "FeedbackTest",
        "judge.metrics": "Metrics metrics",
        "judge.residuals": "CorrelationTest OutputResiduals Residuals resid",
        "model.model": "Model load_model",
        "paper.reproduction": "Reproduction reproduce",
        "search.certificate": "certify_orders",
        "search.orders": "resume_search search_orders search_status",
        "search.proved": "OrderCertificate",
        "search.result": "SearchResult SearchRow StoreStatus",
        "selection.result": "Selection",
        "selection.select": "select",
        "selection.trial": "Trial",
        "solve.free_run": "explicit_euler simulate",
        "solve.operators": "block_pulse_matrix fractional_derivative fractional_integral haar_inverse haar_matrix "
        "haar_transform operational_matrix",
    }.items()
    for name in names.split()
}
#: Modules that are asked for as attributes.
_MODULES = frozenset(
    {
        "advice",
        "control",
        "demo",
        "errors",
        "exports",
        "frequency",
        "plot",
        "progress",
        "report",
        "reproduction",
        "rig",
        "sklearn",
    }
)


def __getattr__(name: str) -> object:
    """A public name, or a module such as `ftlm.rig`, imported when it is first asked for."""
    if name in _HOMES:
        value = getattr(_importlib.import_module(f"ftlm.{_HOMES[name]}"), name)
    elif name in _MODULES:
        value = _importlib.import_module(f"ftlm.{name}")
    else:
        raise AttributeError(f"module 'ftlm' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Public names, imported or not."""
    return sorted({*globals(), *__all__, *_MODULES})
