"""Confidence intervals of a joint fit: Wald and profile likelihood.

At each value of one parameter all others are refitted. The interval contains the values at which the cost rises by at
most the threshold of the likelihood-ratio test (Venzon & Moolgavkar, doi:10.2307/2347496; Raue et al.,
doi:10.1093/bioinformatics/btp358).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Literal

from ftlm import _core
from ftlm.data.run import Run
from ftlm.errors import ConvergenceError, FtlmError, ModelError
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.output_error import JointFit, Loss, ProfileInterval, fit_output_error, fit_state
from ftlm.estimation.result import Identification
from ftlm.findings import Finding, make_finding
from ftlm.simulation.discretization import recording
from ftlm.utils.parameters import parameter
from ftlm.utils.resources import stop_flag
from ftlm.utils.validation import Floats, real_number

Intervals = Literal["auto", "quadratic", "profile"]
#: Confidence level of the printed intervals.
DEFAULT_INTERVAL_LEVEL = 0.95
#: Minimum relative decrease of the RMS residual of an output at which a lower optimum is reported.
MIN_NOISE_REDUCTION = 1e-3
#: Maximum number of restarts from a lower optimum found by the interval search.
MAX_RESTARTS = 2
#: Maximum number of simulated block pulses for profiles with intervals="auto", and minimum number of remaining
#: simulations with which the search for a further bound starts. With free orders a pulse costs FREE_ORDER_COST_FACTOR
#: times as much.
MAX_AUTO_PULSES, MIN_INITIAL_BUDGET_PER_BOUND = 6_000_000, 20
FREE_ORDER_COST_FACTOR = 3
#: Maximum number of evaluations of the minimization that precedes the search for intervals.
MAX_DESCENT_EVALUATIONS = 120


def with_intervals(
    joint: JointFit,
    problem: FreeProblem,
    runs: Sequence[Run],
    intervals: Intervals,
    *,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
    loss: Loss = "squares",
) -> tuple[JointFit, list[Finding]]:
    """Return a joint fit to which the requested confidence intervals are added, and findings about them.

    ``"quadratic"`` gives Wald intervals. ``"auto"`` computes profile-likelihood intervals for the parameters whose Wald
    interval is inaccurate, ``"profile"`` for all. If a profile leads to an optimum of lower cost, the fit is repeated
    from there.
    """
    count = len(joint.names) + joint.initial_terms
    # With fewer than two samples per parameter the residuals do not determine the noise level.
    if intervals == "quadratic" or (intervals == "auto" and joint.samples < 2 * count):
        return joint, []
    if intervals == "auto" and joint.unstable_optimum is not None and joint.unstable_optimum.at_stability_limit:
        # The cost has no minimum at the limit. A profile would lead to the unstable optimum that was discarded.
        return joint, []
    findings: list[Finding] = []
    pulse_count = 0
    for restart in range(MAX_RESTARTS + 1):
        pulses = joint.samples * joint.refinement * (FREE_ORDER_COST_FACTOR if joint.orders else 1)
        auto = intervals == "auto"
        budget = (max(MAX_AUTO_PULSES - pulse_count, 0) // pulses, MIN_INITIAL_BUDGET_PER_BOUND) if auto else None
        names = None if auto else problem.names
        try:
            profile = profile_intervals(
                joint, problem, runs, names, DEFAULT_INTERVAL_LEVEL, threads=threads, progress=progress, budget=budget
            )
        except FtlmError:
            # There is no finite simulation with the new weights, so the previous result is kept.
            return joint, findings
        pulse_count += profile.evaluations * pulses
        if profile.lower_optimum is None or restart == MAX_RESTARTS:
            break
        if not profile.lower_on_finer_grid:
            # An optimum on this grid only is an artifact of the discretization, so its cost is no evidence.
            return joint, findings
        start = dict(zip(problem.names, profile.lower_optimum.tolist(), strict=True))
        start_count, level = len(joint.starts), joint.noise
        try:
            refit = fit_output_error(runs, problem.structure, threads=threads, start=start, loss=loss)
        except FtlmError:
            break
        exact_outputs = joint.exact_outputs(runs)
        if all(o in exact_outputs or v > (1.0 - MIN_NOISE_REDUCTION) * level[o] for o, v in refit.noise.items()):
            joint = replace(refit, starts=joint.starts, origin=joint.origin)
            continue
        joint = replace(refit, origin="a lower optimum found by the search for its intervals")
        before_text, after_text = (
            ", ".join(f"{o} {v:.4g}" for o, v in noise.items()) for noise in (level, joint.noise)
        )
        findings = [make_finding("lower_optimum_found", starts=start_count, before=before_text, after=after_text)]
    if profile.incomplete_names:
        findings.append(make_finding("intervals_rough", parameter=", ".join(profile.incomplete_names)))
    return replace(joint, profiles=profile.intervals), findings


@dataclass(frozen=True)
class ProfileResult:
    """Profile-likelihood intervals, and any lower optimum found during the search.

    Parameters
    ----------
    intervals
        Intervals by name.
    lower_optimum
        Parameters of an optimum with a lower cost than the fit; None if there is no significantly lower one.
    lower_on_finer_grid
        Whether that optimum has a lower cost with the next smaller time step as well.
    incomplete_names
        Parameters whose profile needed more simulations than allowed.
    evaluations
        Total number of simulations.
    """

    intervals: dict[str, ProfileInterval]
    lower_optimum: Floats | None
    lower_on_finer_grid: bool
    incomplete_names: tuple[str, ...]
    evaluations: int


def profile_intervals(
    joint: JointFit,
    problem: FreeProblem,
    runs: Sequence[Run],
    names: Sequence[str] | None,
    level: float,
    *,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
    budget: tuple[int, int] | None = None,
    evaluations: int = MAX_DESCENT_EVALUATIONS,
) -> ProfileResult:
    """Return profile-likelihood intervals of some parameters of a fit.

    Results do not depend on the number of threads. The interval of a parameter that is not identifiable is unbounded on
    both sides, or ends at a lower bound of 0.

    Parameters
    ----------
    joint, problem, runs
        Fit, its estimation problem and its runs.
    names
        Parameter names; None for those whose Wald interval is inaccurate.
    level
        Confidence level, between 0 and 1.
    threads, progress
        Number of threads, and a callback with (bounds found, total bounds).
    budget
        Maximum total number of simulations, and minimum number of simulations that must remain when the search for a
        bound starts. None for no limit.
    evaluations
        Maximum number of evaluations of a minimization that starts from the optimum before the bounds are searched.

    Raises
    ------
    KeyboardInterrupt
        On Ctrl-C, after at most one refit.
    """
    answer = _core.profile_intervals(
        problem.core,
        [recording(run, problem.structure) for run in runs],
        fit_state(joint, problem),
        None if names is None else [problem.names.index(n) for n in names],
        half_width(level),
        budget=budget,
        threads=threads,
        evaluations=evaluations,
        progress=progress,
        stop=stop_flag(),
    )
    # A lower bound of 0 is a limit of the quantity itself, such as of a delay, and ends the interval.
    minima = [0.0 if low == 0.0 else -math.inf for low, _ in problem.all_bounds]
    return ProfileResult(
        {
            problem.names[i]: ProfileInterval(max(low, minima[i]), high, level, tuple(points), evaluation_count)
            for i, low, high, points, evaluation_count in answer["intervals"]
        },
        answer["lower_optimum"],
        answer["lower_on_finer_grid"],
        tuple(problem.names[i] for i in answer["incomplete"]),
        answer["evaluations"],
    )


def half_width(level: float) -> float:
    """Return the half-width, in standard deviations, of a normal confidence interval with confidence `level`."""
    return NormalDist().inv_cdf(0.5 + 0.5 * level)


def result_profiles(
    result: Identification,
    names: Sequence[str],
    level: float,
    threads: int,
    progress: Callable[[int, int], None] | None,
) -> dict[str, ProfileInterval]:
    """Return profile-likelihood intervals of a result; see :meth:`ftlm.Identification.profile`.

    Raise ModelError if the fit has no likelihood, a name is not a free parameter or the level is invalid. Raise
    ConvergenceError if a profile leads to an optimum of lower cost.
    """
    if "reference" in result.settings:
        raise ModelError(
            f"a fit with {parameter('reference')} solves instrument equations and has no cost function to profile; "
            "use its standard errors"
        )
    if "noise_model" in result.settings:
        raise ModelError(f"a fit with {parameter('noise', 'ar')} has no profile; use its standard errors")
    if result.joint is None or result.task is None:
        raise ModelError(
            f"method {result.method!r} has no likelihood to profile; identify by {parameter('method', 'output-error')}"
        )
    problem = FreeProblem.of(replace(result.task.structure, initial=result.joint.initial))
    unknown = [n for n in names if n not in problem.names]
    if unknown:
        further_names = f", nor {len(unknown) - 1} more" if len(unknown) > 1 else ""
        raise ModelError(
            f"{unknown[0]!r}{further_names} is not a free parameter of this fit; it has {', '.join(problem.names)}"
        )
    probability = real_number("level", level)
    if not 0.0 < probability < 1.0:
        raise ModelError(f"level = {level} is not a probability; give one between 0 and 1, such as 0.95")
    parameters = list(dict.fromkeys(names)) or problem.names
    profile = profile_intervals(
        result.joint, problem, result.task.runs, parameters, probability, threads=threads, progress=progress
    )
    if profile.lower_optimum is not None:
        raise ConvergenceError(
            "the profile leads to an optimum with a lower cost than this fit, so the fit is not the best; identify "
            f"again with {parameter('intervals', 'profile')}, which continues from that optimum"
        )
    return profile.intervals
