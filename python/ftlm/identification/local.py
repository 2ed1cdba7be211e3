"""The output error around a point: what an offset would explain there, and what free orders add to intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ftlm import _core
from ftlm.base.arrays import Floats
from ftlm.base.colour import autoregression
from ftlm.base.errors import FtlmError
from ftlm.base.statistics import LEVEL, ROUNDING, chi_squared
from ftlm.base.tall import dot, orthonormal, projections, singular
from ftlm.data.equations import Term
from ftlm.data.orders import Order
from ftlm.data.run import Run
from ftlm.data.structures import History, Initial, Structure, offset_exponents
from ftlm.fit.grid import Attempt, Grid
from ftlm.fit.problem import FreeProblem
from ftlm.fit.uncertainty import covariance
from ftlm.judge.residuals import LAGS
from ftlm.solve.motion import decided_together
from ftlm.solve.sampled import initial_exponents

#: Pulses a sample interval where the fit does not say how many it needed.
EVERY = 2
#: Share of what an offset does that other unknowns must leave for it to be told from them.
TOLD_APART = 1e-6
#: What explains less of an output than this share of its deviation nobody would miss.
VISIBLE = 1e-3
#: Share of records without an offset in which one is spoken of that nobody asked for.
UNASKED = 1e-4
#: Evaluations from the lattice's point to the optimum between its points.
EVALUATIONS = 40


@dataclass(frozen=True)
class OffsetTest:
    """Whether unknown constants in the equations explain more than noise does.

    Parameters
    ----------
    statistic
        Squared sizes of the constants in units of their variances under the colour of the residuals; chi-squared where
        there is no offset.
    degrees
        How many constants the runs tell, over all equations and runs; 0 where they tell none from the other unknowns.
    share
        Share of the residuals' sum of squares that the constants explain.
    size
        What they explain as a share of the outputs' deviations, root mean square: far below 1, it is rounding.
    """

    statistic: float
    degrees: int
    share: float
    size: float

    def exceeds(self, level: float = LEVEL, *, size: float = ROUNDING) -> bool:
        """Whether a record without an offset comes to this with a probability below ``level``, rounding set aside."""
        return self.degrees > 0 and self.size > size and self.statistic > chi_squared(self.degrees, level)

    @property
    def figures(self) -> str:
        """The statistic and its 99 % limit in words."""
        return f"chi-squared {self.statistic:.4g} of {self.degrees}, 99 % limit {chi_squared(self.degrees, LEVEL):.4g}"

    @property
    def decision(self) -> str:
        """What ``offset="auto"`` makes of it, in words."""
        if not self.degrees:
            return "none: these runs do not tell one from the other unknowns"
        if self.exceeds():
            return f"constant, since the runs ask for one ({self.figures})"
        return f"none, since the runs ask for none ({self.figures})"


def at_point(
    runs: Sequence[Run], structure: Structure, values: Mapping[str, float], every: int
) -> tuple[Grid, Attempt]:
    """The output error at given numbers, each output weighing as its residuals ask for."""
    problem = FreeProblem.of(replace(structure, initial=decided_together(runs, structure)))
    orders, coefficients, inputs = problem.split([values[n] for n in problem.names])
    start = Attempt(orders, coefficients, "given", {}, inputs)
    grid = Grid(problem, runs, [1.0] * len(structure.outputs), every=every)
    here = grid.descend(start, 1, plain=True)
    weights = [1.0 / max(level, 1e-300) for level in grid.levels(here).values()]
    grid = replace(grid, weights=weights)
    if len(weights) > 1:
        # Initial terms bring all outputs closest together, so that they follow the weights.
        return grid, grid.descend(here, 1, plain=True)
    scaled = {n: weights[0] * np.asarray(here.outcome[n]) for n in ("residuals", "jacobian")}
    cost = weights[0] ** 2 * float(here.outcome["cost"])
    return grid, replace(here, outcome={**here.outcome, **scaled, "cost": cost})


def offset_test(
    runs: Sequence[Run], structure: Structure, values: Mapping[str, float], *, every: int = EVERY
) -> OffsetTest | None:
    """Test for an unknown constant in each equation on each run, at given numbers; None where it cannot be computed.

    What an input of ones would do joins the sensitivities of everything that is free, initial terms projected out, with
    a coefficient of 0. It is a score test made insensitive to errors of the other numbers (Neyman's C(alpha)), so that
    any consistent estimate will do. Its variance is that of residuals of their own colour, an autoregression.
    """
    taken = {*structure.signals, *structure.coefficient_names, *structure.order_names, *runs[0].signals}
    one = next(n for n in ("one", *(f"one{k}" for k in range(len(taken) + 1))) if n not in taken)
    names = [f"{one}_{k}" for k in range(len(structure.equations))]
    equations = tuple(
        replace(e, terms=(*e.terms, Term(one, Order(), n))) for e, n in zip(structure.equations, names, strict=True)
    )
    initial = without_stand_ins(decided_together(runs, structure), structure, values)
    extended = replace(structure, equations=equations, offset="none", initial=initial)
    try:
        whole = [run.with_outputs({one: np.ones(run.length)}) for run in runs]
        grid, here = at_point(whole, extended, {**values, **dict.fromkeys(names, 0.0)}, every)
    except FtlmError:
        # No finite free run on this grid: the result says so elsewhere.
        return None
    first = len(grid.problem.orders) + grid.problem.coefficients.index(names[0])
    rows = np.asarray(here.outcome["jacobian"])
    others = np.delete(rows, range(first, first + len(names)), axis=0)
    residuals = np.asarray(here.outcome["residuals"])
    blocks = _blocks(grid)
    columns = []
    for row in rows[first : first + len(names)]:
        for start, stop in ((own[0][0], own[-1][1]) for own in blocks):
            column = np.zeros(residuals.size)
            column[start:stop] = row[start:stop]
            columns.append(column)
    before = np.stack(columns, axis=1)
    sizes = np.linalg.norm(before, axis=0)
    left = before / np.where(sizes > 0, sizes, 1.0)
    basis = orthonormal(others.T, 1e-12) if others.size else np.zeros((residuals.size, 0))
    for _ in range(2):
        left = left - basis @ (basis.T @ left)
    directions, spread, _ = singular(left)
    told = directions[:, spread > TOLD_APART]
    count = told.shape[1]
    total = dot(residuals, residuals)
    if count == 0 or not total > 0:
        return OffsetTest(0.0, 0, 0.0, 0.0)
    along = projections(told, residuals)
    # Where the numbers come from a fit with an offset, part of what it does lies along their sensitivities.
    noise = residuals - told @ along - basis @ projections(basis, residuals)
    spread = _coloured(told, noise, blocks, residuals.size - basis.shape[1] - count)
    statistic = float(along @ np.linalg.pinv(spread) @ along)
    explained = told @ along
    sizes = [float(np.nanstd(run[o])) for run in runs for o in structure.outputs]
    weights = [w for _ in runs for w in grid.weights]
    places = [place for own in blocks for place in own]
    size = max(
        math.sqrt(float(np.mean(explained[a:b] ** 2))) / (w * s) if w * s > 0 else 0.0
        for (a, b), w, s in zip(places, weights, sizes, strict=True)
    )
    return OffsetTest(statistic, count, float(along @ along) / total, size)


def without_stand_ins(initial: Initial, structure: Structure, values: Mapping[str, float]) -> Initial:
    """Caputo's terms at given numbers without powers of t that do what an offset does; others as they are."""
    if initial != "caputo":
        return initial
    kept: set[float] = set()
    for item in (e.with_orders({n: values[n] for n in e.order_names}) for e in structure.equations):
        own = offset_exponents(item.order.constant, "constant").values()
        kept |= set(initial_exponents(item, "caputo", "constant")) - {round(e, 9) for e in own}
    return History(sorted(kept))


def _blocks(grid: Grid) -> list[list[tuple[int, int]]]:
    """First and last place of the residuals of every output, by run."""
    blocks, at = [], 0
    for _, count in grid.counts:
        own = []
        for _ in grid.problem.structure.outputs:
            own.append((at, at + count))
            at += count
        blocks.append(own)
    return blocks


def _coloured(directions: Floats, noise: Floats, blocks: list[list[tuple[int, int]]], degrees: int) -> Floats:
    """Covariance of what directions see of noise, each output's an autoregression over all runs."""
    total: Floats = np.zeros((directions.shape[1], directions.shape[1]))
    scale = noise.size / max(degrees, 1)
    for output in range(len(blocks[0])):
        places = [slice(*own[output]) for own in blocks]
        series = [noise[p] for p in places]
        filtered = autoregression(series, LAGS)
        errors = np.concatenate([np.convolve(e, filtered, "valid") for e in series])
        power = float(np.mean(errors**2)) * scale
        for place in places:
            size = place.stop - place.start
            divisor = np.zeros(size)
            divisor[: min(filtered.size, size)] = filtered[:size]
            # Noise is what 1/A makes of white noise; its transpose runs through the directions backwards.
            turned = [_core.series_divide(np.ascontiguousarray(d[place][::-1]), divisor) for d in directions.T]
            stacked = np.stack(turned)
            total += power * np.einsum("ik,jk->ij", stacked, stacked)
    return total


def unasked_offset(test: OffsetTest | None, outputs: Sequence[str]) -> list[str]:
    """Say so where an offset that nobody asked for explains what a model misses."""
    if test is None or not test.exceeds(UNASKED, size=VISIBLE):
        return []
    return [
        f"an unknown constant in the equation of {', '.join(outputs)} explains {100 * min(test.share, 1):.2g} % of "
        f"what the model misses ({test.figures}): a sensor's zero, a load, a voltage at rest; use offset='constant' "
        "or offset='auto'"
    ]


def errors_with_orders(
    runs: Sequence[Run], structure: Structure, values: Mapping[str, float], *, every: int = EVERY
) -> dict[str, float] | None:
    """Standard errors of orders and coefficients found on a lattice; None where they cannot be computed.

    Instruments refined at the optimum make instrumental variables as precise as the output error, so the errors are
    those of the output error with all orders free, robust to colour, at the optimum between the lattice's points; the
    way there is what the lattice is off, and counts as an error as well.
    """
    try:
        grid, here = at_point(runs, replace(structure, coefficient_law=()), values, every)
        there = grid.descend(here, EVALUATIONS, plain=True)
        spread = np.diag(covariance(there, grid))
    except FtlmError:
        return None
    given = np.array([values[n] for n in grid.problem.names])
    with np.errstate(invalid="ignore"):
        errors = np.sqrt(spread + (there.values - given) ** 2)
    return {n: e if math.isfinite(e) else math.inf for n, e in zip(grid.problem.names, errors.tolist(), strict=True)}
