"""Result of one estimator, without the residual tests and findings that `identify` adds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ftlm.errors import ModelError
from ftlm.estimation.output_error import JointFit
from ftlm.estimation.result import Task
from ftlm.findings import Finding
from ftlm.model.model import Model
from ftlm.order_search.result import SearchResult
from ftlm.structure.structure import History, Initial, Structure
from ftlm.utils.parameters import parameter

ProgressCallback = Callable[[int, int], None] | None


@dataclass(frozen=True)
class Fit:
    """Result of one estimator, without the residual tests and findings that `identify` adds.

    Parameters
    ----------
    task
        Runs and structure, with the decided offset and initial conditions.
    method
        Name of the estimator.
    model
        Estimated model.
    parameters
        Number of free parameters.
    settings
        Options of the estimator by name, for the summary.
    findings
        Findings of the estimator itself.
    searches, errors, joint, covariance
        Order searches, standard errors of the coefficients at the best orders, joint fit, and covariance of the model
        parameters, each if the estimator gives it.
    at_optimum
        Whether the parameters minimize a criterion of the residuals. The offset test requires it.
    """

    task: Task
    method: str
    model: Model
    parameters: int
    settings: dict[str, Any]
    findings: list[Finding]
    searches: dict[str, SearchResult] = field(default_factory=dict)
    errors: Mapping[str, float] = field(default_factory=dict)
    joint: JointFit | None = None
    covariance: tuple[tuple[float, ...], ...] | None = None
    at_optimum: bool = True


def make_model(
    task: Task, method: str, structure: Structure, orders: Mapping[str, float], m: int, **estimate_details: Any
) -> Model:
    """Return a model of a structure with fixed orders and coefficients, which records its method and runs.

    `m` is the number of block pulses. `estimate_details` adds entries to the field `about` of the model.
    """
    units = {n: u for n, u in task.runs[0].units.items() if n in structure.signals}
    step_sizes = {run.step for run in task.runs}
    step_entry = {"step": step_sizes.pop()} if len(step_sizes) == 1 else {}
    details = {"method": method, "runs": ", ".join(r.name for r in task.runs), **step_entry, **estimate_details}
    return Model(structure, orders=orders, units=units, m=m, about=details)


def check_no_friction(structure: Structure, method: str) -> None:
    """Raise ModelError for a structure with friction, which only output error estimates."""
    if structure.has_friction:
        output = structure.outputs[structure.friction_equations[0]]
        raise ModelError(
            f"the equation of {output} has friction, which {parameter('method', method)} cannot estimate; use "
            f"{parameter('method', 'output-error')}"
        )


def initial_terms_text(initial: Initial) -> str:
    """Return chosen initial conditions as text for the summary."""
    if isinstance(initial, History):
        return f"history, {len(initial)} powers of t up to {initial[-1]:g}"
    return initial if isinstance(initial, str) else f"t^{list(initial)}"


def offset_setting(structure: Structure) -> dict[str, str]:
    """Return the offset option of a structure as an entry of `Fit.settings`; {} without an offset."""
    return {} if structure.offset == "none" else {"offset": structure.offset}
