"""Results of one stage: models on both runs, optimizer comparisons, convergence."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ftlm.arm.flexible_link import flexible_link, integer_order
from ftlm.data.run import Run
from ftlm.estimation.genetic import GeneticRun
from ftlm.estimation.linear import MultiInnovationTrace
from ftlm.estimation.result import Identification
from ftlm.estimation.verdict import is_degenerate
from ftlm.model.model import Model
from ftlm.order_search.result import SearchResult
from ftlm.order_search.search import rank_orders
from ftlm.reproduction.simulated_arm import StageNumber
from ftlm.structure.order_grid import OrderGrid
from ftlm.structure.structure import Structure
from ftlm.svg.heat_map import Landscape
from ftlm.utils.formatting import SUPERSCRIPT_DIGITS
from ftlm.utils.validation import Floats
from ftlm.validation.comparison import Comparison, Metrics, attributes, plain

#: Steps between two points of a convergence curve; the effect of p is limited to the first steps.
TRACE_EVERY = 2
#: Prior covariance so large that the data alone decide.
WEAK_PRIOR = 1e10
#: Both values of K0: the paper's identity, and a weak prior.
PRIOR_COVARIANCES = (1.0, WEAK_PRIOR)
#: Labels of multi-innovation in the optimizer comparison, by K0.
MULTI_INNOVATION_LABELS = ("p = 7", "p = 7, weak prior")
#: Highest orders of the paper's grid, and those of the optimizer comparison, which contain the orders printed for both
#: methods and leave so few candidates that all can be evaluated.
GRID_ALPHA, RIVAL_ALPHA = (1.05, 2.0), (1.95, 2.0)
#: Options of every order search, named so that no default changes a table.
SEARCH_OPTIONS = {"criterion": "output-error", "norm": "l1", "row_basis": "haar"}


def published_structure(stage: StageNumber, **changes: Any) -> Structure:
    """Return the paper's (22)-(25) of a stage, every equation by itself, with zero initial conditions."""
    made = flexible_link(
        stage=stage, form="published", coupling="measured", laws=(), parameters="effective", offset="none"
    )
    return replace(made, **{"initial": "rest", **changes})


def integer_orders(structure: Structure) -> Structure:
    """Return a structure of the arm with integer orders."""
    return structure.with_orders({n: integer_order(n) for n in structure.order_names})


def around(value: float, increment: float, steps: int) -> list[float]:
    """Return the values of an order grid around one of them."""
    return [round(value + k * increment, 9) for k in range(-steps, steps + 1)]


def best_orders(run: Run, single: Structure, grid: OrderGrid, p: int, prior: float, **work: Any) -> SearchResult:
    """Return the best candidate of multi-innovation on an order grid."""
    options: dict[str, Any] = {"innovation_length": p, "prior_covariance": prior, **SEARCH_OPTIONS, **work}
    return rank_orders(run, single, grid, top=1, coefficients="multi-innovation", **options)


def prior_text(prior: float) -> str:
    """Format K0 as 1 or 10¹⁰."""
    return "1" if prior == PRIOR_COVARIANCES[0] else f"10{str(round(math.log10(prior))).translate(SUPERSCRIPT_DIGITS)}"


def are_usable(*candidates: Candidate) -> bool:
    """Whether all fits may be used; a comparison with another one says nothing."""
    return not any(c.result is not None and is_degenerate(c.result) for c in candidates)


@dataclass(frozen=True)
class Candidate:
    """Model of a stage with its errors on both runs.

    Parameters
    ----------
    label
        Label, such as "p = 7".
    model
        The model.
    estimation, validation
        Both errors on the estimation run, with the inputs that the method uses, and on the other run, if there is one.
    input_driven
        Output error from the currents alone, by run and output.
    result
        The identification; None for a model that was not identified.
    """

    label: str
    model: Model
    estimation: Comparison
    validation: Comparison | None
    input_driven: dict[str, dict[str, Metrics]]
    result: Identification | None = None

    @property
    def fits(self) -> list[float]:
        """Fit of the free run in percent, for each output on both runs; NaN without a run."""
        runs = self.estimation, self.validation
        return [math.nan if c is None else c.output_error[o].fit for o in self.estimation.output_error for c in runs]

    def to_dict(self) -> dict[str, Any]:
        """Return the model and its errors for JSON."""
        result = {} if self.result is None else attributes(self.result, ("intervals", "settings", "warnings"))
        errors = attributes(self, ("estimation", "validation", "input_driven"))
        return attributes(self.model, ("orders", "coefficients")) | errors | result


@dataclass(frozen=True)
class Rival:
    """Multi-innovation, genetic algorithm and differential evolution on one equation, with equal budgets.

    Parameters
    ----------
    candidates, increment
        Candidates of the order grid, which are also the default evaluations per seed, and its increment.
    population
        Population size of the genetic algorithm.
    order_grid
        Searches by multi-innovation with p = 7, by K0.
    optimizers
        Results of the genetic algorithm and of differential evolution by seed, with their bounds.
    models
        Best model of each by label: genetic, differential evolution, p = 7 with K0 = 1 and with a weak prior.
    """

    candidates: int
    increment: float
    population: int
    order_grid: dict[float, SearchResult]
    optimizers: dict[str, GeneticRun]
    models: dict[str, Candidate] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison for JSON."""
        runs = {n: attributes(run, ("errors", "evaluations", "bounds")) for n, run in self.optimizers.items()}
        return attributes(self, ("candidates", "increment", "population", "models")) | {"optimizers": runs}


@dataclass(frozen=True)
class DroppedDerivative:
    """Effect of the derivative of the current that (19) drops on the simulated deflection, at equal parameters."""

    output: str
    order: float  # of the current's derivative; 0 as published
    time: Floats  # middle of every pulse [s]
    current: Floats  # pulse means
    measured: Floats
    published: Floats  # by (22)-(25)
    derived: Floats  # by (14)-(15)

    @property
    def correlations(self) -> dict[str, float]:
        """Correlation of the deflection with the current: measured, (14)-(15), published; NaN at rest."""
        found = {}
        for name in ("measured", "derived", "published"):
            parts = [v - np.mean(v) for v in (getattr(self, name), self.current)]
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                found[name] = float(np.dot(*parts) / np.sqrt(np.dot(parts[0], parts[0]) * np.dot(parts[1], parts[1])))
        return found


@dataclass(frozen=True)
class Stage:
    """Results of one stage.

    Parameters
    ----------
    number
        1 or 2.
    candidates
        Models by label, in the order of the tables.
    traces, weak_traces
        Convergence by output and p: each p at its own orders and K0 = 1; with a weak prior, at the orders of p = 7.
    rivals
        Optimizer comparisons by output; empty without PyGAD or for a run that does not start at rest.
    printed_orders
        Model with the printed orders and least-squares coefficients on this run.
    by_equation
        Model with the orders of the smallest equation error on the grid.
    derived
        Effect of the dropped derivative of the current.
    landscape
        Cost around the joint fit over its two most correlated orders; None without them.
    """

    number: StageNumber
    candidates: dict[str, Candidate]
    traces: dict[str, dict[int, MultiInnovationTrace]]
    weak_traces: dict[str, dict[int, MultiInnovationTrace]]
    rivals: dict[str, Rival]
    printed_orders: Candidate
    by_equation: Candidate
    derived: DroppedDerivative
    landscape: Landscape | None

    @property
    def outputs(self) -> tuple[str, str]:
        """Hub angle and deflection."""
        return f"theta{self.number}1", f"theta{self.number}2"

    @property
    def weak(self) -> dict[str, dict[int, dict[str, float]]]:
        """Coefficients by output and p with a weak prior, at the orders of p = 7."""
        return {
            o: {p: {n: float(c[-1]) for n, c in trace.coefficients.items()} for p, trace in each.items()}
            for o, each in self.weak_traces.items()
        }

    def to_dict(self) -> dict[str, Any]:
        """Return the stage results for JSON."""
        return {
            "models": plain(self.candidates),
            "derived input order": attributes(self.derived, ("output", "order", "correlations")),
        } | attributes(self, ("printed_orders", "by_equation", "weak", "rivals"))
