"""Tests of whether the data require nuisance parameters: offsets and initial terms."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ftlm import _core
from ftlm.data.run import Run
from ftlm.data.sampling import MAX_SAMPLE_VALUE, drop_missing, interpolate_gaps
from ftlm.errors import ConvergenceError, FtlmError
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Iterate, Objective, covariance
from ftlm.estimation.output_error import (
    JointFit,
    Loss,
    fit_output_error,
    level_count,
    run_multistart,
    start_from_values,
)
from ftlm.findings import Finding, make_finding
from ftlm.model.model import Model
from ftlm.simulation.discretization import values_at_residuals
from ftlm.simulation.initial_conditions import (
    START_SETTINGS,
    common_initial_conditions,
    deviations,
    has_memory,
    history,
    needs_history,
    output_residuals,
    resolve_common_initial_conditions,
    resolve_start,
    start_score,
)
from ftlm.simulation.output_samples import initial_exponents, is_in_motion, measured_samples
from ftlm.simulation.step_refinement import simulate_refined
from ftlm.structure.equation import Term
from ftlm.structure.order import Order
from ftlm.structure.structure import History, Initial, Structure, offset_exponents
from ftlm.utils.linalg import (
    column_norms,
    dot,
    orthonormal,
    projections,
    thin_svd,
)
from ftlm.utils.statistics import (
    ROUNDING_RESIDUAL_RATIO,
    SIGNIFICANCE_LEVEL,
    chi_squared,
    is_white,
    robust_deviation,
    variance_inflation,
)
from ftlm.utils.validation import Floats
from ftlm.validation.residual_tests import DEFAULT_LAGS, is_independent

#: Number of block pulses per sampling interval if the fit does not state its refinement.
DEFAULT_PULSES_PER_SAMPLE = 2
#: Fraction of the norm of an offset sensitivity that the other sensitivities do not explain. Below this value, the
#: offset is collinear with the other parameters.
OFFSET_COLLINEARITY_TOLERANCE = 1e-6
#: Minimum RMS effect of a reported offset, as a fraction of the standard deviation of the output.
MIN_OFFSET_SIZE_RATIO = 1e-3
#: Significance level of the finding on an offset that was not requested.
UNREQUESTED_OFFSET_LEVEL = 1e-4
#: Maximum number of evaluations of a fit from a point of the order grid to the nearby optimum.
MAX_REFINEMENT_EVALUATIONS = 40
#: Maximum number of evaluations of a screening: a short fit with other initial conditions from a known optimum. Initial
#: conditions that explain the runs equally well converge in two to four evaluations.
MAX_SCREENING_EVALUATIONS = 12
#: Increase of twice the log-likelihood by a full step below which a screening has converged.
SCREENING_LIKELIHOOD_TOLERANCE = 0.01
#: RMS residual that a complete fit may reach, relative to that of the screening: if the screening has converged, and if
#: it has not.
CONVERGED_RESIDUAL_SHARE, SCREENING_RESIDUAL_SHARE = 0.9, 0.5
#: Change when the step is halved, relative to the largest value, at which simulations with a history have converged.
HISTORY_SIMULATION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class OffsetTest:
    """Test for unknown constants in the equations, at given parameters.

    Parameters
    ----------
    statistic
        Twice the logarithm of the likelihood ratio under autoregressive noise; approximately chi-squared distributed if
        there is no constant.
    degrees
        Number of identifiable constants over all equations and runs; 0 if none is identifiable.
    share
        Fraction of the residual sum of squares that the constants explain.
    size
        Root-mean-square effect of the constants relative to the standard deviation of the output, largest over runs and
        outputs. A very small effect may be rounding error.
    """

    statistic: float
    degrees: int
    share: float
    size: float

    def exceeds(self, level: float = SIGNIFICANCE_LEVEL, *, size: float = ROUNDING_RESIDUAL_RATIO) -> bool:
        """Whether the statistic is significant at `level` and the effect is larger than `size`.

        An effect larger than the standard deviation of the output counts as significant, because noise of any color
        cannot explain it.
        """
        significant = self.size > 1.0 or self.statistic > chi_squared(self.degrees, level)
        return self.degrees > 0 and self.size > size and significant

    @property
    def statistic_text(self) -> str:
        """Test statistic and its 99 % limit as text."""
        limit = chi_squared(self.degrees, SIGNIFICANCE_LEVEL)
        return f"chi-squared {self.statistic:.4g} of {self.degrees}, 99 % limit {limit:.4g}"

    @property
    def decision(self) -> str:
        """Decision of ``offset="auto"`` as text, for the settings of a fit."""
        if not self.degrees:
            return "none: it is not separately identifiable from the other parameters"
        if self.exceeds():
            return f"constant, because the test is significant ({self.statistic_text})"
        return f"none, because the test is not significant ({self.statistic_text})"


def evaluate_at_point(
    runs: Sequence[Run], structure: Structure, values: Mapping[str, float], every: int
) -> tuple[Objective, Iterate]:
    """Return the output-error objective and its evaluation at given parameters.

    Output weights are the reciprocal RMS residuals, and `every` is the number of block pulses per sample. Raise
    ConvergenceError if the residuals of an output are 0.
    """
    structure = resolve_start(runs, structure)
    problem = FreeProblem.of(replace(structure, initial=resolve_common_initial_conditions(runs, structure)))
    orders, coefficients, inputs = problem.split([values[n] for n in problem.names])
    start = Iterate(orders, coefficients, "given", {}, inputs)
    grid = Objective(problem, runs, [1.0] * len(structure.outputs), every=every)
    point = grid.minimize(start, 1, plain=True)
    levels = grid.rms_residuals(point)
    exact = [output for output, level in levels.items() if not level * MAX_SAMPLE_VALUE > 1.0]
    if exact:
        raise ConvergenceError(
            f"the residuals of {', '.join(exact)} are 0, so no statistic can be computed; use a longer record"
        )
    weights = [1.0 / level for level in levels.values()]
    grid = replace(grid, weights=weights)
    if len(weights) > 1:
        # Initial terms are fitted to all outputs together, so they depend on the weights.
        return grid, grid.minimize(point, 1, plain=True)
    scaled = {n: weights[0] * np.asarray(point.outcome[n]) for n in ("residuals", "jacobian")}
    cost = weights[0] ** 2 * float(point.outcome["cost"])
    return grid, replace(point, outcome={**point.outcome, **scaled, "cost": cost})


def offset_test(
    runs: Sequence[Run], structure: Structure, values: Mapping[str, float], *, every: int = DEFAULT_PULSES_PER_SAMPLE
) -> OffsetTest | None:
    """Test at given parameters for an unknown constant in each equation and run; None if not computable.

    Two linear regressions of the residuals under autoregressive noise are compared. The regressors of the first one are
    the sensitivities to all free parameters and initial terms. The second regression also has, as regressors, the
    responses to a constant in each equation. The statistic is twice the logarithm of the likelihood ratio of their
    one-step prediction errors. `values` are consistent estimates by name, and `every` is the number of block pulses per
    sampling interval.
    """
    reserved_names = {*structure.signals, *structure.coefficient_names, *structure.order_names, *runs[0].signals}
    one = next(n for n in ("one", *(f"one{k}" for k in range(len(reserved_names) + 1))) if n not in reserved_names)
    names = [f"{one}_{k}" for k in range(len(structure.equations))]
    equations = tuple(
        replace(e, terms=(*e.terms, Term(one, Order(), n))) for e, n in zip(structure.equations, names, strict=True)
    )
    initial = without_offset_equivalents(resolve_common_initial_conditions(runs, structure), structure, values)
    extended = replace(structure, equations=equations, offset="none", initial=initial)
    try:
        whole = [run.with_outputs({one: np.ones(run.length)}) for run in runs]
        grid, point = evaluate_at_point(whole, extended, {**values, **dict.fromkeys(names, 0.0)}, every)
    except FtlmError:
        # No statistic can be computed without a finite simulation on this grid.
        return None
    first = len(grid.problem.orders) + grid.problem.coefficients.index(names[0])
    rows = np.asarray(point.outcome["jacobian"])
    others = np.delete(rows, range(first, first + len(names)), axis=0)
    residuals = np.asarray(point.outcome["residuals"])
    blocks = _residual_blocks(grid)
    columns = []
    for row in rows[first : first + len(names)]:
        for start, stop in ((own[0][0], own[-1][1]) for own in blocks):
            column = np.zeros(residuals.size)
            column[start:stop] = row[start:stop]
            columns.append(column)
    columns_before = np.stack(columns, axis=1)
    norms = column_norms(columns_before)
    scaled = columns_before / np.where(norms > 0, norms, 1.0)
    basis = orthonormal(others.T, 1e-12) if others.size else np.zeros((residuals.size, 0))
    for _ in range(2):
        scaled = scaled - basis @ (basis.T @ scaled)
    directions, spread, _ = thin_svd(scaled)
    basis_part = directions[:, spread > OFFSET_COLLINEARITY_TOLERANCE]
    count = basis_part.shape[1]
    total = dot(residuals, residuals)
    if count == 0 or not total > 0:
        return OffsetTest(0.0, 0, 0.0, 0.0)
    along = projections(basis_part, residuals)
    # The sensitivities are orthogonal to the responses to initial terms. These responses are regressors as well,
    # because the regression under colored noise estimates the initial terms again.
    common = np.column_stack([basis, *_initial_responses(point, blocks, residuals.size)])
    nested, full = (np.ascontiguousarray(c.T) for c in (common, np.column_stack([common, basis_part])))
    by_output = [list(places_of_output) for places_of_output in zip(*blocks, strict=True)]
    statistic = _core.prediction_ratio(nested, full, residuals, by_output, DEFAULT_LAGS)
    explained = basis_part @ along
    sizes = [float(np.nanstd(run[o])) for run in runs for o in structure.outputs]
    weights = [w for _ in runs for w in grid.weights]
    places = [place for own in blocks for place in own]
    size = max(
        math.sqrt(float(np.mean(explained[a:b] ** 2))) / (w * s) if w * s > 0 else 0.0
        for (a, b), w, s in zip(places, weights, sizes, strict=True)
    )
    return OffsetTest(statistic, count, float(along @ along) / total, size)


def offset_errors(
    joint: JointFit, structure: Structure, runs: Sequence[Run], offsets: Sequence[Mapping[str, Mapping[str, float]]]
) -> tuple[dict[str, dict[str, float]], ...]:
    """Return the standard errors of the offsets of each run, by output and kind; () if not computable.

    `offsets` are the estimates in the same form. A joint fit eliminates the offsets, so its covariance lacks them. Here
    the Jacobian has a row for each offset. It is the response to the input 1 for a constant, and to the input t for a
    ramp. For a level, it is 1 at the samples of the output.
    """
    listed = [(k, o, kind) for k, run in enumerate(offsets) for o, own in run.items() for kind in own]
    if not listed or len(offsets) != len(runs):
        return ()
    values, has_level = joint.values_by_name, structure.offset == "level"
    terms: dict[str, list[Term]] = {o: [] for o in structure.outputs}
    reserved_names = {*structure.signals, *structure.coefficient_names, *structure.order_names, *runs[0].signals}
    prefix = "one"
    while any(name.startswith(prefix) for name in reserved_names):
        prefix += "_"
    names = [] if has_level else [f"{prefix}_{kind}_{k}_{output}" for k, output, kind in listed]
    for name, (k, output, kind) in zip(names, listed, strict=False):
        values[name] = offsets[k][output][kind]
        terms[output].append(Term(f"{prefix}_{kind}_{k}", Order(), name))
    whole = []
    for k, run in enumerate(runs):
        if has_level:
            whole.append(deviations(run, structure, {o: own["level"] for o, own in offsets[k].items() if own})[0])
            continue
        shapes = {"constant": np.ones(run.length), "ramp": run.step * np.arange(run.length, dtype=float)}
        own_inputs = {f"{prefix}_{kind}_{j}": shapes[kind] * float(k == j) for j, _, kind in listed}
        whole.append(run.with_outputs(own_inputs))
    initial = joint.initial
    if structure.is_linear and not has_level:
        initial = without_offset_equivalents(initial, structure, values)
    equations = tuple(replace(e, terms=(*e.terms, *terms[e.output])) for e in structure.equations)
    problem = FreeProblem.of(replace(structure, equations=equations, offset="none", initial=initial))
    weights = [1.0 / max(joint.noise[o], 1e-300) for o in structure.outputs]
    grid = Objective(problem, whole, weights, max(joint.refinement, 1), robust_weights=joint.robust_weights)
    try:
        point = grid.minimize(start_from_values(problem, values), 1, plain=True)
        rows = np.asarray(point.outcome["jacobian"])
        if has_level:
            rows = np.vstack([rows, *_level_responses(grid, point, listed)])
            point = replace(point, outcome={**point.outcome, "jacobian": rows})
        spread = np.diag(covariance(point, grid))
    except FtlmError:
        return ()
    places = range(len(rows) - len(listed), len(rows)) if has_level else [problem.names.index(n) for n in names]
    errors: tuple[dict[str, dict[str, float]], ...] = tuple({o: {} for o in run} for run in offsets)
    for (k, output, kind), place in zip(listed, places, strict=True):
        errors[k][output][kind] = math.sqrt(spread[place])
    return errors


def _level_responses(grid: Objective, point: Iterate, listed: Sequence[tuple[int, str, str]]) -> list[Floats]:
    """Return derivatives of weighted residuals with respect to levels, orthogonal to responses to initial terms.

    Each entry of `listed` is (index of the run, output, kind). The result has one array over all residuals per entry.
    """
    shares, blocks = grid.residual_weights, _residual_blocks(grid)
    bases, columns = _initial_responses(point, blocks, shares.size), []
    for k, output, _ in listed:
        place = grid.problem.structure.outputs.index(output)
        own = slice(*blocks[k][place])
        column = np.zeros(shares.size)
        column[own] = grid.weights[place] * shares[own]
        for basis in bases * 2:
            column -= basis @ projections(basis, column)
        columns.append(column)
    return columns


def output_sensitivities(joint: JointFit, structure: Structure, runs: Sequence[Run]) -> dict[str, list[Floats]]:
    """Return the sensitivities of residuals to parameters by output, an array (parameters, samples) for each run.

    Their projection on the responses to initial terms is subtracted. The result is {} if the evaluation fails.
    """
    try:
        grid, point = evaluate_at_point(runs, structure, joint.values_by_name, max(joint.refinement, 1))
    except FtlmError:
        return {}
    rows, blocks = np.asarray(point.outcome["jacobian"]), _residual_blocks(grid)
    return {name: [rows[:, slice(*own[k])] for own in blocks] for k, name in enumerate(grid.problem.structure.outputs)}


def without_offset_equivalents(initial: Initial, structure: Structure, values: Mapping[str, float]) -> Initial:
    """Return initial terms without the powers of t that the response to a constant contains.

    Caputo initial terms become a history with the remaining exponents. Other initial terms are returned unchanged.
    """
    if initial != "caputo":
        return initial
    exponents: set[float] = set()
    for item in (e.with_orders({n: values[n] for n in e.order_names}) for e in structure.equations):
        own = offset_exponents(item.order.constant, "constant").values()
        exponents |= set(initial_exponents(item, "caputo", "constant")) - {round(e, 9) for e in own}
    return History(sorted(exponents))


def _residual_blocks(grid: Objective) -> list[list[tuple[int, int]]]:
    """Return, for each run, the (start, stop) indices of each output's block in the residual vector."""
    blocks, at = [], 0
    for _, count in grid.counts:
        own = []
        for _ in grid.problem.structure.outputs:
            own.append((at, at + count))
            at += count
        blocks.append(own)
    return blocks


def _initial_responses(point: Iterate, blocks: list[list[tuple[int, int]]], size: int) -> list[Floats]:
    """Return an array (residuals, initial terms) of responses to initial terms for each run that has such terms.

    The responses are 0 at the residuals of other runs, and `size` is the number of all residuals.
    """
    columns = []
    for responses, own in zip(point.outcome["initial_responses"], blocks, strict=True):
        if len(responses):
            columns.append(np.zeros((size, len(responses))))
            columns[-1][own[0][0] : own[-1][1]] = responses.T
    return columns


def constant_input(runs: Sequence[Run], structure: Structure) -> str | None:
    """Return the name of an input that is constant in every run and has a free coefficient at order 0, or None."""
    for item in structure.equations:
        for term in item.terms:
            plain = term.fixed is None and not term.order.names and term.order.constant == 0 and term.nonlinear is None
            if plain and all(term.signal in r.inputs and float(np.ptp(r[term.signal])) == 0.0 for r in runs):
                return term.signal
    return None


def unrequested_offset_findings(test: OffsetTest | None, outputs: Sequence[str]) -> list[Finding]:
    """Return a finding if an offset that the user did not request would explain part of the residuals."""
    if test is None or not test.exceeds(UNREQUESTED_OFFSET_LEVEL, size=MIN_OFFSET_SIZE_RATIO):
        return []
    numbers = {"share": 100 * min(test.share, 1), "test": test.statistic_text}
    return [make_finding("offset_missing", output=", ".join(outputs), **numbers)]


def errors_with_orders(
    runs: Sequence[Run], structure: Structure, values: Mapping[str, float]
) -> dict[str, float] | None:
    """Return standard errors of orders and coefficients after an order search, by name; None if not computable.

    Refined instrumental variables are as efficient as output error. The standard errors are therefore those of output
    error with free orders, robust to colored residuals. The distance from the grid point to the optimum is added as a
    further error.
    """
    try:
        grid, point = evaluate_at_point(runs, replace(structure, coefficient_law=()), values, DEFAULT_PULSES_PER_SAMPLE)
        refit = grid.minimize(point, MAX_REFINEMENT_EVALUATIONS, plain=True)
        spread = np.diag(covariance(refit, grid))
    except FtlmError:
        return None
    at_grid = np.array([values[n] for n in grid.problem.names])
    with np.errstate(invalid="ignore"):
        errors = np.sqrt(spread + (refit.values - at_grid) ** 2)
    return {n: e if math.isfinite(e) else math.inf for n, e in zip(grid.problem.names, errors.tolist(), strict=True)}


def fit_with_initial_conditions(
    runs: Sequence[Run],
    structure: Structure,
    start: Initial,
    *,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
    loss: Loss = "squares",
    guesses: Sequence[Mapping[str, float]] = (),
    alone: bool = False,
) -> JointFit:
    """Fit a structure to runs with unknown initial conditions, and select the initial terms.

    `start` are the initial conditions suggested by the data. A fit with a history (powers of t that represent past
    inputs) is replaced by one with Caputo initial terms, of which there are fewer, if its residuals are equally small.
    A fit from rest is replaced only if a history improves it significantly. The result names the fitted terms in
    ``initial``. With `alone`, the first of `guesses` is the only initial guess.
    """

    def fit_initial_terms(
        initial: Initial, *, refine: bool = True, multistart: _core.JointMultistart | None = None
    ) -> JointFit:
        request = replace(structure, initial=initial)
        fit = partial(fit_output_error, start=guesses[0]) if alone else partial(fit_output_error, guesses=guesses)
        return fit(runs, request, threads=threads, refine=refine, progress=progress, loss=loss, multistart=multistart)

    decided = structure.initial != "auto" or not has_memory(structure) or not structure.is_linear
    if not decided and isinstance(start, History):
        # If few terms suffice on the coarsest grid, only they are fitted on finer grids: discretization errors favor
        # more terms, not fewer.
        request = replace(structure, initial=start)
        multistart = None if alone else run_multistart(runs, request, threads, progress)
        many = fit_initial_terms(start, refine=False, multistart=multistart)
        simplified = _simplify_initial_terms(many, runs, structure, refine=False)
        if simplified is many and not alone:
            without = _fit_without_implausible_history(many, runs, structure, lambda: fit_initial_terms("caputo"))
            if without is not None:
                return without
        request = replace(structure, initial=simplified.initial)
        fine = fit_output_error(runs, request, near=simplified, loss=loss, multistart=multistart)
        unstable = fine.unstable_optimum or simplified.unstable_optimum or many.unstable_optimum
        fine = replace(fine, starts=many.starts, origin=many.origin, unstable_optimum=unstable)
        return fine if simplified is not many else _simplify_initial_terms(fine, runs, structure, refine=True)
    joint = fit_initial_terms(start)
    if decided or start != "rest" or not _has_nonzero_start(joint, runs, structure):
        return joint
    past = fit_initial_terms(
        common_initial_conditions([history(run, structure) for run in runs]) or history(runs[0], structure)
    )
    return past if fit_score(past, joint) < fit_score(joint, joint) else joint


def fit_score(joint: JointFit, reference: JointFit) -> float:
    """Return the information criterion of a fit, by which initial conditions and offsets are compared.

    Lower is better. The noise color is taken from the fit `reference`.
    """
    own, others = _pooled_residuals(joint), _pooled_residuals(reference)
    return start_score(own, joint.initial_terms, others)


def fit_score_gain(joint: JointFit, other: JointFit, reference: JointFit) -> float:
    """Return the decrease of :func:`fit_score` from `other` to `joint`, both with the noise color of `reference`."""
    return fit_score(other, reference) - fit_score(joint, reference)


def fits_better(joint: JointFit, other: JointFit, margin: float = 0.0) -> bool:
    """Whether the criterion of a fit is below the other fit's criterion plus `margin`, which may be negative.

    Both criteria use the noise color of the fit with the larger residuals.
    """
    worse = max((other, joint), key=lambda either: math.prod(either.noise.values()))
    return fit_score_gain(joint, other, worse) > -margin


def has_colored_residuals(joint: JointFit) -> bool:
    """Whether residuals of an output are so correlated that a missing term or a wrong initial condition is likely."""
    inflation = (variance_inflation(drop_missing(series)) for series in _pooled_residuals(joint))
    return max(inflation) > START_SETTINGS.white_inflation


def has_white_residuals(joint: JointFit) -> bool:
    """Whether the residuals of every output are white.

    Unlike :func:`has_colored_residuals`, this test detects oscillating residuals.
    """
    return all(is_white(drop_missing(series)) for series in _pooled_residuals(joint))


def has_independent_residuals(joint: JointFit, runs: Sequence[Run], structure: Structure) -> bool:
    """Whether the residuals of every output are independent of present and past inputs: no dynamics are missing.

    Also False if a run is too short for the test, or an input is constant.
    """
    names = [n for n in structure.signals if n in runs[0].inputs]
    inputs = [[interpolate_gaps(values_at_residuals(run, structure, n)) for run in runs] for n in names]
    series = [[part[o] for part in joint.residuals] for o in joint.noise]
    return all(is_independent(one, inputs) for one in series)


def _pooled_residuals(joint: JointFit) -> list[Floats]:
    """Return the residuals of each output in its unit, concatenated over all runs."""
    return [noise * np.concatenate([part[o] for part in joint.residuals]) for o, noise in joint.noise.items()]


def _simplify_initial_terms(joint: JointFit, runs: Sequence[Run], structure: Structure, *, refine: bool) -> JointFit:
    """Return the fit with Caputo initial terms if they suffice, otherwise the fit with a history."""

    def suffices(simplified: JointFit) -> bool:
        return not _fit_needs_history(simplified, joint, runs, structure)

    simplified = refit_after_screening(joint, runs, replace(structure, initial="caputo"), suffices, refine=refine)
    return joint if simplified is None or not suffices(simplified) else simplified


def _fit_without_implausible_history(
    joint: JointFit, runs: Sequence[Run], structure: Structure, fit_caputo: Callable[[], JointFit]
) -> JointFit | None:
    """Return the fit with Caputo initial terms if no plausible past input explains the fitted history, else None.

    The free powers of t of a history can fit dynamics that the structure lacks. Under the prior on past inputs that
    :func:`ftlm.compare` uses, such a history gives larger residuals than Caputo's terms do.
    """
    try:
        residuals = _simulation_residuals(Model(_fitted_structure(joint, structure)), runs)
        if not all(np.all(np.isfinite(drop_missing(row))) for row in residuals):
            return None
        under_prior = start_score(residuals, 0, residuals)
        if under_prior - start_score(_pooled_residuals(joint), 0, residuals) < START_SETTINGS.history_margin:
            return None
        caputo = fit_caputo()
    except FtlmError:
        return None
    return caputo if start_score(_pooled_residuals(caputo), 0, residuals) < under_prior else None


def _simulation_residuals(model: Model, runs: Sequence[Run]) -> list[Floats]:
    """Return the residuals of each output over all runs, simulated with initial terms fitted as in `compare`."""
    parts = []
    for run in runs:
        simulated = simulate_refined(model, run, None, tolerance=HISTORY_SIMULATION_TOLERANCE)
        parts.append(output_residuals(measured_samples(model, run, simulated.refinement), simulated.outputs))
    return list(np.concatenate(parts, axis=1))


def _fitted_structure(joint: JointFit, structure: Structure) -> Structure:
    """Return a structure with the orders, coefficients and input parameters of a joint fit."""
    numbers = FreeProblem.of(structure).coefficients_by_name(list(joint.coefficients.values()))
    return structure.with_orders(joint.orders).with_coefficients(numbers).with_inputs(joint.inputs)


def refit_after_screening(
    joint: JointFit,
    runs: Sequence[Run],
    structure: Structure,
    accepts: Callable[[JointFit], bool],
    *,
    refine: bool = True,
) -> JointFit | None:
    """Return the refit of a linear structure with other initial conditions or offsets; None if screened out or failed.

    First, the cost is minimized from the optimum of `joint` with at most `MAX_SCREENING_EVALUATIONS` evaluations. The
    RMS residuals are multiplied by `CONVERGED_RESIDUAL_SHARE` if this minimization converged, otherwise by
    `SCREENING_RESIDUAL_SHARE`. The products are an optimistic estimate of the residuals of a complete fit. If `accepts`
    rejects this estimate, the result is None. Otherwise the structure is fitted with the time step of `joint`. With
    `refine`, an accepted fit is repeated with a refined step. The returned fit may be one that `accepts` rejects.
    """
    problem = FreeProblem.of(structure)
    weights = [1.0 / max(joint.noise[o], 1e-300) for o in structure.outputs]
    grid = Objective(problem, runs, weights, max(joint.refinement, 1), robust_weights=joint.robust_weights)
    loss: Loss = "squares" if joint.robust is None else "huber"
    begin = start_from_values(problem, joint.values_by_name)
    try:
        # Limit of the increase of twice the log-likelihood in one step, per sample.
        tolerance = SCREENING_LIKELIHOOD_TOLERANCE / joint.samples
        screening = grid.minimize(begin, MAX_SCREENING_EVALUATIONS, plain=True, tolerance=tolerance)
        share = CONVERGED_RESIDUAL_SHARE if screening.has_converged else SCREENING_RESIDUAL_SHARE
        deviation = grid.rms_residuals(screening)
        if joint.robust is not None:
            deviation = {o: robust_deviation(e) for o, e in grid.pooled_residuals(screening).items()}
        screened = replace(
            joint,
            noise={o: share * v * joint.noise[o] for o, v in deviation.items()},
            residuals=[
                {o: e / max(deviation[o], 1e-300) for o, e in part.items()} for part in grid.residuals(screening)
            ],
            initial_terms=sum(len(terms) for run in screening.outcome["initial"] for terms in run)
            + level_count(runs, structure),
        )
        if not accepts(screened):
            return None
        fit = fit_output_error(runs, structure, near=joint, loss=loss, refine=False)
        if refine and accepts(fit):
            # The refinement of a fit is that of the finer of its two last grids.
            coarser = replace(fit, refinement=max(fit.refinement // 2, 1))
            fit = fit_output_error(runs, structure, near=coarser, loss=loss)
    except FtlmError:
        return None
    return fit


def fit_without_history(joint: JointFit, runs: Sequence[Run], structure: Structure) -> JointFit | None:
    """Return a fit with Caputo initial terms and a constant if it fits as well as one with a history, else None."""
    request = replace(structure, offset="constant")
    loss: Loss = "squares" if joint.robust is None else "huber"
    try:
        fit = partial(fit_output_error, runs, start=joint.values_by_name, loss=loss, refine=False)
        few = fit(replace(request, initial="caputo"))
        # Both fits use the same grids, because discretization errors of a coarse grid are no evidence of a history.
        many = fit(replace(structure, initial=joint.initial))
    except FtlmError:
        return None
    fewer = few.initial_terms < many.initial_terms
    return few if fewer and not _fit_needs_history(few, many, runs, request) else None


def _fit_needs_history(few: JointFit, many: JointFit, runs: Sequence[Run], structure: Structure) -> bool:
    """Whether a fit with few initial terms has significantly larger residuals than one with many."""
    caputo_residuals, history_residuals = _pooled_residuals(few), _pooled_residuals(many)
    sizes = [float(np.nanstd(np.concatenate([run[o] for run in runs]))) for o in structure.outputs]
    return needs_history(structure, caputo_residuals, history_residuals, sizes, (few.initial_terms, many.initial_terms))


def _has_nonzero_start(joint: JointFit, runs: Sequence[Run], structure: Structure) -> bool:
    """Whether the runs, at the parameters of a fit from rest, require nonzero initial conditions."""
    return is_in_motion(_fitted_structure(joint, structure), runs)
