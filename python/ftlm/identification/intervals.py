"""Intervals of a joint fit: which of them the quadratic picture gives, and which the profile of the likelihood."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from ftlm.base.arrays import Floats
from ftlm.base.checks import real_number
from ftlm.base.errors import ConvergenceError, FtlmError, ModelError
from ftlm.data.run import Run
from ftlm.data.settings import Intervals, Loss
from ftlm.fit.grid import Attempt, Grid
from ftlm.fit.interval import ProfileInterval
from ftlm.fit.joint import JointFit, fit_output_error
from ftlm.fit.problem import FreeProblem
from ftlm.fit.profile import Profiles, Valley, bent_numbers, profiled
from ftlm.identification.judged import Judged

#: Level of the intervals that are printed.
PRINTED = 0.95
#: A lower optimum is spoken of where the residuals of an output fall by this share.
TOLD = 1e-3
#: How often a fit goes on from a lower optimum that its intervals came upon.
REFITS = 2
#: Pulses that may be spent on profiles nobody asked for, all numbers together, and free runs that an end is worth
#: beginning with. Where an order is free, a pulse costs so many of running sums.
UNASKED, FEWEST = 6_000_000, 20
FRACTIONAL = 3


def with_intervals(
    joint: JointFit, problem: FreeProblem, runs: Sequence[Run], intervals: Intervals, *, threads: int = 1,
    progress: Callable[[int, int], None] | None = None, loss: Loss = "squares",
) -> tuple[JointFit, list[str]]:  # fmt: skip
    """A joint fit with the intervals that were asked for, and what is to be said of them.

    ``"auto"`` profiles the numbers for which the quadratic picture fails, ``"profile"`` all. Where that leads to an
    optimum below the fit's, the fit is done again from there.
    """
    fitted = len(joint.names) + joint.initial_terms
    # Where no more samples are left over than numbers were fitted, the residuals do not tell what noise explains.
    if intervals == "quadratic" or (intervals == "auto" and joint.samples < 2 * fitted):
        return joint, []
    warnings: list[str] = []
    spent = 0
    for turn in range(REFITS + 1):
        try:
            valley = Valley.of(joint, problem, runs)
        except FtlmError:
            # No finite free run where the weights of the last descent are taken anew: what is known stays.
            return joint, warnings
        names = valley.names if intervals == "profile" else bent_numbers(valley, PRINTED)
        pulses, least = joint.samples * joint.refinement, FEWEST * 2 * len(names)
        pulses *= FRACTIONAL if joint.orders else 1
        allowed = (UNASKED - spent) // pulses
        if intervals == "auto" and least > allowed:
            found = Profiles({}, None, tuple(names))
            break
        most = None if intervals == "profile" else allowed
        found = profiled(valley, names, PRINTED, threads=threads, progress=progress, most=most)
        spent += found.evaluations * pulses
        if found.lower is None or turn == REFITS:
            break
        if not is_lower(valley.grid, joint.on_grid, found.lower):
            # What only this grid carries is a mode of the scheme; along it the cost tells nothing of the numbers.
            return joint, warnings
        start = dict(zip(problem.names, found.lower.tolist(), strict=True))
        tried, level = len(joint.starts), joint.noise
        try:
            again = fit_output_error(runs, problem.structure, threads=threads, start=start, loss=loss)
        except FtlmError:
            break
        if all(v > (1.0 - TOLD) * level[o] for o, v in again.noise.items()):
            joint = replace(again, starts=joint.starts, origin=joint.origin)
            continue
        joint = replace(again, origin="a lower optimum that the search for its intervals came upon")
        before, after = (", ".join(f"{o} {v:.4g}" for o, v in noise.items()) for noise in (level, joint.noise))
        warnings = [
            f"none of {tried} starts led to this optimum, but the search for intervals did (residuals {before} before, "
            f"{after} now): there may be others"
        ]
    if found.left:
        warnings.append(
            f"the cost is no parabola along {', '.join(found.left)}, and its profile there would take long: these "
            "intervals are rough; intervals='profile' finds them"
        )
    return replace(joint, profiles=found.intervals), warnings


def is_lower(grid: Grid, before: Floats, after: Floats) -> bool:
    """Whether one point costs less than another on the next finer grid as well.

    There they are only evaluated: a mode of the scheme would settle on that grid anew.
    """
    finer, costs = grid.finer, []
    for values in (before, after):
        orders, coefficients, inputs = grid.problem.split(values.tolist())
        try:
            there = finer.descend(Attempt(orders, coefficients, "finer grid", {}, inputs), 1, plain=True)
        except FtlmError:
            return False
        costs.append(float(there.outcome["cost"]))
    return costs[1] < costs[0]


def valley_of(result: Judged) -> Valley:
    """The cost around the optimum of a result by output error."""
    if result.joint is None or result.task is None:
        raise ModelError(f"method {result.method!r} has no likelihood to profile; identify by method='output-error'")
    problem = FreeProblem.of(replace(result.task.structure, initial=result.joint.initial))
    return Valley.of(result.joint, problem, result.task.runs)


def profile(
    result: Judged, names: Sequence[str], level: float, threads: int, progress: Callable[[int, int], None] | None
) -> dict[str, ProfileInterval]:
    """Profile intervals of a result's numbers; see :meth:`ftlm.Identification.profile`."""
    if "reference" in result.settings:
        raise ModelError(
            "a fit with reference= is where residuals are orthogonal to instruments, and no minimum of a cost: it has "
            "no profile; use its standard errors"
        )
    valley = valley_of(result)
    unknown = [n for n in names if n not in valley.names]
    if unknown:
        others = f", nor {len(unknown) - 1} more" if len(unknown) > 1 else ""
        raise ModelError(f"{unknown[0]!r}{others} is no free number of this fit; it has {', '.join(valley.names)}")
    probability = real_number("level", level)
    if not 0.0 < probability < 1.0:
        raise ModelError(f"level = {level} is no probability between 0 and 1, such as 0.95")
    asked = list(dict.fromkeys(names)) or valley.names
    found = profiled(valley, asked, probability, threads=threads, progress=progress)
    if found.lower is not None:
        raise ConvergenceError(
            "the profile leads to an optimum below this fit's, so its estimates are not the likeliest; identify again "
            "with intervals='profile', which goes on from there"
        )
    return found.intervals
