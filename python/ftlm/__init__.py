"""Fractional-order models of flexible machines from measured data.

Public names in the order in which a measurement passes them: runs, operators, equations and models, identification and
order search, simulation and validation.

What models are made of is imported at once, every other module when one of its names is first asked for: to import all
of them takes longer than numpy does.
"""

import importlib as _importlib
import typing as _typing

from ftlm.errors import ConvergenceError, DataError, FtlmError, InternalError, ModelError, RigFault

# A function with the name of its module: imported late, the module would take its place.
from ftlm.flexible_link import PARAMETERS, LinkParameters, flexible_link, link_model, order_law

if _typing.TYPE_CHECKING:
    from ftlm import rig
    from ftlm._core import __version__
    from ftlm.baselines import Genetic
    from ftlm.files import load
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
    from ftlm.residuals import (
        CorrelationTest,
        InformationCriteria,
        OutputResiduals,
        Residuals,
        information_criteria,
        resid,
    )
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

#: Where each name lives.
_HOMES = {
    name: home
    for home, names in {
        "_core": ("__version__",),
        "baselines": ("Genetic",),
        "files": ("load",),
        "reproduction": ("Reproduction", "reproduce"),
        "identification": (
            "Identification",
            "Trace",
            "identify",
            "multi_innovation_trace",
        ),
        "models": (
            "Equation",
            "Estimate",
            "Model",
            "Order",
            "SensorFilter",
            "Structure",
            "Term",
            "equation",
            "load_model",
        ),
        "operators": (
            "block_pulse_matrix",
            "fractional_derivative",
            "fractional_integral",
            "haar_inverse",
            "haar_matrix",
            "haar_transform",
            "operational_matrix",
        ),
        "many": ("Identified", "identify_many"),
        "order_search": (
            "Lattice",
            "SearchResult",
            "SearchRow",
            "StoreStatus",
            "lattice",
            "resume_search",
            "search_orders",
            "search_status",
        ),
        "physical": (
            "PhysicalParameter",
            "physical_parameters",
        ),
        "residuals": (
            "CorrelationTest",
            "InformationCriteria",
            "OutputResiduals",
            "Residuals",
            "information_criteria",
            "resid",
        ),
        "runs": ("Run",),
        "simulation": (
            "explicit_euler",
            "simulate",
        ),
        "validation": (
            "Comparison",
            "Metrics",
            "compare",
            "metrics",
        ),
    }.items()
    for name in names
}
#: Modules that are asked for as attributes.
_MODULES = frozenset({*_HOMES.values(), "plot", "progress", "rig"})


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
