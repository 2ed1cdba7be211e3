"""Numbers of a fit in a unit of time of the runs' own, so that nothing hangs on the unit in which time is told."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.data.run import Run
from ftlm.fit.problem import FreeProblem
from ftlm.solve.records import affine

#: ln of the largest power of the unit that counts; the core's, too.
LARGEST = 300.0


@dataclass(frozen=True)
class Clock:
    """A coefficient before D^nu y beside D^alpha y is a time to the power of -(alpha - nu), which free orders change.

    Parameters
    ----------
    unit
        ln of the unit of time.
    constants, weights
        alpha - nu of each parameter at orders of 0, and by how much it rises with each parameter; 0 where it is no
        coefficient that stands alone before a term, and under a law of products.
    """

    unit: float
    constants: Floats
    weights: Floats

    @classmethod
    def of(cls, problem: FreeProblem, runs: Sequence[Run]) -> Clock:
        """The unit is that of a frequency half way, in logarithms, between that of the runs and Nyquist's."""
        spans = [math.log(run.step) + math.log(run.length * run.step) for run in runs]
        size, first = len(problem.names), len(problem.orders)
        constants, weights = np.zeros(size), np.zeros((size, size))
        # Under a law between coefficients one number stands before terms of several orders, and keeps its own unit.
        lawful = any(len(factors) > 1 for _, factors in problem.products.values())
        for place, name in enumerate(problem.coefficients, first):
            alone = [(e, t) for e in problem.structure.equations for t in e.terms if t.coefficient == name]
            if not alone or lawful:
                continue
            (item, term), *_ = alone
            top, above = affine(item.order, problem.orders)
            bottom, below = affine(term.order, problem.orders)
            constants[place] = top - bottom
            weights[place, :first] = np.array(above) - np.array(below)
        return cls(float(np.mean(spans)) / 2.0 - math.log(math.pi), constants, weights)

    def _factors(self, values: Floats) -> Floats:
        # Only orders have weights, and they are the same in any unit.
        powers: Floats = np.exp(np.clip(self.unit * (self.constants + self.weights @ values), -LARGEST, LARGEST))
        return powers

    def told(self, values: Floats) -> Floats:
        """Parameters in the unit."""
        return values * self._factors(values)

    def untold(self, values: Floats) -> Floats:
        """Parameters from those in the unit."""
        return values / self._factors(values)

    def step(self, values: Floats, moved: Floats) -> Floats:
        """A small step of the parameters at some values, from the one in the unit."""
        return moved / self._factors(values) - values * self.unit * (self.weights @ moved)

    def errors(self, values: Floats, covariance: Floats) -> Floats:
        """Standard errors in the unit; infinite where the runs do not see all that takes part."""
        turned = self._factors(values)[:, None] * (np.eye(values.size) + self.unit * values[:, None] * self.weights)
        seen = np.isfinite(np.diag(covariance))
        known = np.where(np.outer(seen, seen), covariance, 0.0)
        variances = np.einsum("ij,jk,ik->i", turned, known, turned)
        variances[(turned[:, ~seen] != 0.0).any(axis=1)] = np.inf
        errors: Floats = np.sqrt(np.maximum(variances, 0.0))
        return errors
