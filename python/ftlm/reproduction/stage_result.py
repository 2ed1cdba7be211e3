"""Results of one stage: models on both runs, optimizer comparisons, convergence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ftlm.estimation.genetic import GeneticRun
from ftlm.estimation.linear import MultiInnovationTrace
from ftlm.estimation.result import Identification
from ftlm.model.model import Model
from ftlm.reproduction.simulated_arm import StageNumber
from ftlm.svg.heat_map import Landscape
from ftlm.utils.validation import Floats
from ftlm.validation.comparison import Comparison, Metrics, finite

#: Steps between two points of a convergence curve; the effect of p is limited to the first steps.
TRACE_EVERY = 2
#: Prior covariance so large that the data alone decide.
WEAK_PRIOR = 1e10
#: Both values of K0: the paper's identity, and a weak prior.
PRIOR_COVARIANCES = (1.0, WEAK_PRIOR)
#: Labels of multi-innovation in the optimizer comparison, by K0.
MULTI_INNOVATION_LABELS = ("p = 7", "p = 7, weak prior")
#: Highest orders of the optimizer comparison: they contain those printed for both methods, and all candidates can be
#: evaluated.
RIVAL_ALPHA = (1.95, 2.0)


@dataclass(frozen=True)
class Candidate:
    """Model of a stage with its errors on both runs.

    Parameters
    ----------
    label
        Label, such as "p = 7".
    model
        The model.
    estimation
        Both errors on the estimation run, with the inputs that the method uses.
    validation
        Both errors on the other run; None without one.
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

    def to_dict(self) -> dict[str, Any]:
        """Return the model and its errors for JSON."""
        result = self.result
        return {
            "orders": {n: float(v) for n, v in self.model.orders.items()},
            "coefficients": {n: float(v) for n, v in self.model.coefficients.items()},
            "intervals": {} if result is None else {n: list(map(finite, i)) for n, i in result.intervals.items()},
            "estimation": self.estimation.to_dict(),
            "validation": None if self.validation is None else self.validation.to_dict(),
            "alone": {run: {o: f.to_dict() for o, f in figures.items()} for run, figures in self.input_driven.items()},
            "settings": {} if result is None else result.settings,
            "warnings": [] if result is None else list(result.warnings),
        }


@dataclass(frozen=True)
class Rival:
    """Multi-innovation, genetic algorithm and differential evolution on one equation, with equal budgets.

    Parameters
    ----------
    candidates
        Candidates of the order grid, and default evaluations per seed.
    increment
        Increment of the order grid.
    population
        Population size of the genetic algorithm.
    genetic_run, evolution_run
        Results of the genetic algorithm and of differential evolution by seed, with their bounds.
    models
        Best model of each by label: genetic, differential evolution, p = 7 with K0 = 1 and with a weak prior.
    """

    candidates: int
    increment: float
    population: int
    genetic_run: GeneticRun
    evolution_run: GeneticRun
    models: dict[str, Candidate]

    @property
    def genetic(self) -> Candidate:
        """Best seed of the genetic algorithm."""
        return self.models["genetic"]

    @property
    def lattice(self) -> Candidate:
        """Multi-innovation with p = 7 and K0 = 1."""
        return self.models["p = 7"]

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison for JSON."""
        runs = {"genetic": self.genetic_run, "differential evolution": self.evolution_run}
        return {
            "candidates": self.candidates,
            "step": self.increment,
            "population": self.population,
            "models": {n: c.to_dict() for n, c in self.models.items()},
            "errors": {n: {str(s): finite(e) for s, e in r.errors.items()} for n, r in runs.items()},
            "evaluations": {n: {str(s): e for s, e in r.evaluations.items()} for n, r in runs.items()},
            "bounds": {n: list(b) for n, b in self.genetic_run.bounds.items()},
        }


@dataclass(frozen=True)
class DroppedDerivative:
    """Effect of the derivative of the current that (19) drops on the simulated deflection, at equal parameters."""

    output: str
    order: float  # that the current would have; 0 as published
    time: Floats  # middle of every pulse [s]
    current: Floats  # pulse means
    measured: Floats
    published: Floats  # by (22)-(25)
    derived: Floats  # by (14)-(15), nothing dropped

    @property
    def correlations(self) -> dict[str, float]:
        """Correlation of the deflection with the current: measured, (14)-(15), published; NaN at rest."""
        found = {}
        for words, series in (("measured", self.measured), ("derived", self.derived), ("published", self.published)):
            parts = [v - np.mean(v) for v in (series, self.current)]
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                found[words] = float(np.dot(*parts) / np.sqrt(np.dot(parts[0], parts[0]) * np.dot(parts[1], parts[1])))
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
    weak
        Coefficients by output and p with a weak prior, at the orders of p = 7.
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
    weak: dict[str, dict[int, dict[str, float]]]
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
    def manual(self) -> str:
        """Label of the manual's model as simulated in the paper; Euler's method needs a start at rest."""
        return "integer, Euler" if self.traces else "integer, exact"

    def to_dict(self) -> dict[str, Any]:
        """Return the stage results for JSON."""
        return {
            "models": {label: c.to_dict() for label, c in self.candidates.items()},
            "printed orders": self.printed_orders.to_dict(),
            "weak prior": {o: {str(p): c for p, c in each.items()} for o, each in self.weak.items()},
            "genetic": {o: r.to_dict() for o, r in self.rivals.items()},
            "smallest equation error": self.by_equation.to_dict(),
            "derived input order": {
                "output": self.derived.output,
                "order": self.derived.order,
                "correlations": {n: finite(v) for n, v in self.derived.correlations.items()},
            },
        }
