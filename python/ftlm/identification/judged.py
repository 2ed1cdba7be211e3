"""The record of an identification: a model, what it was asked from, and everything that is known about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ftlm.base.statistics import NORMAL_95
from ftlm.data.lattice import Lattice, lattice_of
from ftlm.data.run import Run
from ftlm.data.structures import Structure
from ftlm.fit.interval import ProfileInterval
from ftlm.fit.joint import JointFit
from ftlm.judge.comparison import Comparison
from ftlm.judge.criteria import InformationCriteria
from ftlm.judge.metrics import Metrics
from ftlm.judge.residuals import Residuals
from ftlm.model.model import Model
from ftlm.search.result import SearchResult


@dataclass(frozen=True)
class Task:
    """What was asked for: from it, reports draw what the result alone does not hold.

    Parameters
    ----------
    runs
        The runs.
    structure
        What was identified, its free orders and coefficients still free.
    lattice
        Of the order search; None for the default.
    """

    runs: tuple[Run, ...]
    structure: Structure
    lattice: Lattice | None = None

    def lattice_of(self, part: Structure) -> Lattice:
        """The lattice of one searched part of the structure."""
        return lattice_of(self.lattice, part) or Lattice()


@dataclass(frozen=True)
class Judged:
    """An identified model and all figures; its fields are those of :class:`ftlm.Identification`."""

    model: Model
    method: str
    comparison: Comparison
    searches: dict[str, SearchResult]
    settings: dict[str, Any]
    warnings: tuple[str, ...] = field(default=())
    joint: JointFit | None = None
    residuals: Residuals | None = None
    information: InformationCriteria | None = None
    task: Task | None = field(default=None, repr=False)
    coefficient_errors: Mapping[str, float] = field(default_factory=dict)

    @property
    def orders(self) -> dict[str, float]:
        """Free orders by name."""
        return dict(self.model.orders)

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors by name.

        Of orders and coefficients by output error and by instrumental variables, robust to coloured residuals; where
        all orders were given, of the coefficients. Empty for the equation-error methods.
        """
        if self.joint is None:
            return dict(self.coefficient_errors)
        return {**self.joint.standard_errors, **self.joint.derived_errors}

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % intervals by name, of what has standard errors.

        Value ± 1.96 standard errors, or, where the quadratic picture fails for a number of a joint fit, those of the
        profile likelihood: neither symmetric nor always finite.
        """
        values = {**self.orders, **self.coefficients, **({} if self.joint is None else self.joint_values)}
        errors = self.standard_errors
        quadratic = {n: (values[n] - NORMAL_95 * e, values[n] + NORMAL_95 * e) for n, e in errors.items()}
        return {**quadratic, **{n: (p.low, p.high) for n, p in self.profiles.items()}}

    @property
    def profiles(self) -> dict[str, ProfileInterval]:
        """95 % intervals by profile likelihood, where they are used; see :meth:`ftlm.Identification.profile`."""
        return {} if self.joint is None else dict(self.joint.profiles)

    @property
    def delays(self) -> dict[str, float]:
        """Delays of inputs [s] by input, estimated or known."""
        return dict(self.model.structure.delay)

    @property
    def limits(self) -> dict[str, float]:
        """Saturations (``sat_u``) and dead zones (``dead_u``) of inputs in their units, estimated or known."""
        known = [(limit.name, limit.value) for limit in self.model.structure.limits]
        return {n: float(v) for n, v in known if not isinstance(v, tuple)}

    @property
    def joint_values(self) -> dict[str, float]:
        """Orders, coefficients and numbers of inputs of the joint fit by name; empty without one."""
        return {} if self.joint is None else dict(zip(self.joint.names, self.joint.values.tolist(), strict=True))

    @property
    def coefficients(self) -> dict[str, float]:
        """Coefficients by name."""
        return self.model.coefficients

    @property
    def equation_error(self) -> dict[str, Metrics]:
        """Figures of the equation error by output."""
        return self.comparison.equation_error

    @property
    def output_error(self) -> dict[str, Metrics]:
        """Figures of the free run by output."""
        return self.comparison.output_error

    @property
    def fit_percent(self) -> dict[str, float]:
        """Fit of the free run in percent, by output."""
        return self.comparison.fit_percent
