"""What a recomputed section 5 consists of: models on both runs, rivals, stages."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.data.lattice import Lattice
from ftlm.data.run import Run
from ftlm.fit.recursion import Trace
from ftlm.identification.result import Identification
from ftlm.judge.comparison import Comparison
from ftlm.judge.metrics import Metrics, finite
from ftlm.model.model import Model
from ftlm.paper.arm import truth_of

#: Steps between two points of a convergence curve: what p does, it does in the first steps.
TRACE_EVERY = 4
#: A prior so weak that the data alone decide.
WEAK_PRIOR = 1e10
#: Lattice of the genetic comparison: both algorithms' printed highest orders lie in it, and all of it can be evaluated.
RIVAL_ALPHA = (1.95, 2.0)


@dataclass(frozen=True)
class Candidate:
    """One model of a stage on both runs.

    Parameters
    ----------
    label
        Such as "p = 7".
    model
        The model.
    estimation
        Both errors on the run that it was identified from, driven as the method drives it.
    validation
        The same on the other run; None without one.
    alone
        Output error from the currents alone, on both runs, by run and output.
    result
        The identification; None for a model that was not identified.
    """

    label: str
    model: Model
    estimation: Comparison
    validation: Comparison | None
    alone: dict[str, dict[str, Metrics]]
    result: Identification | None = None

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        result = self.result
        return {
            "orders": {n: float(v) for n, v in self.model.orders.items()},
            "coefficients": {n: float(v) for n, v in self.model.coefficients.items()},
            "intervals": {} if result is None else {n: list(map(finite, i)) for n, i in result.intervals.items()},
            "estimation": self.estimation.to_dict(),
            "validation": None if self.validation is None else self.validation.to_dict(),
            "alone": {run: {o: f.to_dict() for o, f in figures.items()} for run, figures in self.alone.items()},
            "settings": {} if result is None else result.settings,
            "warnings": [] if result is None else list(result.warnings),
        }


@dataclass(frozen=True)
class Rival:
    """The genetic algorithm and multi-innovation on one equation, like for like.

    Parameters
    ----------
    candidates
        Of the lattice, and evaluations of every seed.
    genetic, lattice
        The two results.
    """

    candidates: int
    genetic: Candidate
    lattice: Candidate

    @property
    def settings(self) -> dict[str, Any]:
        """What the genetic algorithm worked with."""
        return {} if self.genetic.result is None else self.genetic.result.settings

    @property
    def errors(self) -> dict[str, float]:
        """Error (45) that each of its seeds came to."""
        errors: dict[str, float] = next(iter(self.settings.get("errors", {"": {}}).values()))
        return errors

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        both = {"genetic": self.genetic.to_dict(), "multi-innovation": self.lattice.to_dict()}
        return {"candidates": self.candidates, **both}


@dataclass(frozen=True)
class Derived:
    """What the derivative of the current that (19) drops does to the deflection's free run, all numbers alike."""

    output: str
    order: float  # that the current would have; 0 as published
    time: Floats  # middle of every pulse [s]
    current: Floats  # pulse means
    measured: Floats
    published: Floats  # by (22)-(25)
    derived: Floats  # by (14)-(15), nothing dropped

    @property
    def correlations(self) -> dict[str, float]:
        """Of the deflection with the current: as measured, with nothing dropped, as published; nan for one at rest."""
        found = {}
        for words, series in (("measured", self.measured), ("derived", self.derived), ("published", self.published)):
            parts = [v - np.mean(v) for v in (series, self.current)]
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                found[words] = float(np.dot(*parts) / np.sqrt(np.dot(parts[0], parts[0]) * np.dot(parts[1], parts[1])))
        return found


@dataclass(frozen=True)
class Stage:
    """Everything about one stage.

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
        By output; empty without PyGAD or where a run does not start at rest.
    near
        The model with the orders that the paper prints, least-squares coefficients on this run.
    by_equation
        The model whose orders have the smallest equation error on the lattice.
    derived
        What the dropped derivative of the current changes.
    """

    number: int
    candidates: dict[str, Candidate]
    traces: dict[str, dict[int, Trace]]
    weak_traces: dict[str, dict[int, Trace]]
    weak: dict[str, dict[int, dict[str, float]]]
    rivals: dict[str, Rival]
    near: Candidate
    by_equation: Candidate
    derived: Derived

    @property
    def outputs(self) -> tuple[str, str]:
        """Hub angle and deflection."""
        return f"theta{self.number}1", f"theta{self.number}2"

    @property
    def manual(self) -> str:
        """Label of the manual's model as the paper ran it; Euler's steps start at rest, so not on any other run."""
        return "integer, Euler" if self.traces else "integer, exact"

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "models": {label: c.to_dict() for label, c in self.candidates.items()},
            "printed orders": self.near.to_dict(),
            "weak prior": {o: {str(p): c for p, c in each.items()} for o, each in self.weak.items()},
            "genetic": {o: r.to_dict() for o, r in self.rivals.items()},
            "smallest equation error": self.by_equation.to_dict(),
            "derived input order": {
                "output": self.derived.output,
                "order": self.derived.order,
                "correlations": {n: finite(v) for n, v in self.derived.correlations.items()},
            },
        }


@dataclass(frozen=True)
class Recomputed:
    """Both stages and the runs; its fields are those of :class:`ftlm.Reproduction`."""

    square: Run
    sine: Run | None
    simulated: bool
    stages: dict[int, Stage]
    lattice: Lattice
    notes: tuple[str, ...] = field(default=())

    @property
    def truth(self) -> dict[int, dict[str, float]]:
        """Orders and coefficients of the simulated arm by stage; empty for measured runs."""
        return {n: truth_of(n) for n in self.stages} if self.simulated else {}

    @property
    def runs(self) -> list[Run]:
        """The square run, and the sine run if there is one."""
        return [self.square] if self.sine is None else [self.square, self.sine]

    @property
    def angles(self) -> list[tuple[Stage, str]]:
        """Every stage with each of its outputs."""
        return [(stage, output) for stage in self.stages.values() for output in stage.outputs]

    @property
    def rivals(self) -> dict[str, Rival]:
        """The genetic comparisons of all stages by output."""
        return {output: rival for stage in self.stages.values() for output, rival in stage.rivals.items()}

    @property
    def traces(self) -> dict[str, dict[int, Trace]]:
        """Convergence of all stages by output and p."""
        return {output: each for stage in self.stages.values() for output, each in stage.traces.items()}

    @property
    def weak_traces(self) -> dict[str, dict[int, Trace]]:
        """The same with the weak prior."""
        return {output: each for stage in self.stages.values() for output, each in stage.weak_traces.items()}
