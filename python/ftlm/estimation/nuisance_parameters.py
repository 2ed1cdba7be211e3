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
    run_multistart,
    start_from_values,
    uncounted_level_count,
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
from ftlm.structure.structure import History, Initial, Structure, offset_exponents, unused_names
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
CONVERGED_RESIDUAL_FRACTION, SCREENING_RESIDUAL_FRACTION = 0.9, 0.5
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
    runs: Sequence[Run], structure: Structure, values: Mapping[str, float], pulses_per_sample: int
) -> tuple[Objective, Iterate]:
    """Return the output-error objective and its evaluation at given parameters.

    Output weights are the reciprocal RMS residuals, and `pulses_per_sample` is the number of block pulses per sample.
    Raise ConvergenceError if the residuals of an output are 0.
    """
    structure = resolve_start(runs, structure)
    problem = FreeProblem.of(replace(structure, initial=resolve_common_initial_conditions(runs, structure)))
    orders, coefficients, inputs = problem.split([values[n] for n in problem.names])
    start = Iterate(orders, coefficients, "given", {}, inputs)
    objective = Objective(problem, runs, [1.0] * len(structure.outputs), pulses_per_sample=pulses_per_sample)
    point = objective.minimize(start, 1, linear_scale=True)
    levels = objective.rms_residuals(point)
    exact_outputs = [output for output, level in levels.items() if not level * MAX_SAMPLE_VALUE > 1.0]
    if exact_outputs:
        raise ConvergenceError(
            f"the residuals of {', '.join(exact_outputs)} are 0, so no statistic can be computed; use a longer record"
        )
    weights = [1.0 / level for level in levels.values()]
    objective = replace(objective, weights=weights)
    if len(weights) > 1:
        # Initial terms are fitted to all outputs together, so they depend on the weights.
        return objective, objective.minimize(point, 1, linear_scale=True)
    scaled = {n: weights[0] * np.asarray(point.outcome[n]) for n in ("residuals", "jacobian")}
    cost = weights[0] ** 2 * float(point.outcome["cost"])
    return objective, replace(point, outcome={**point.outcome, **scaled, "cost": cost})


def offset_test(
    runs: Sequence[Run],
    structure: Structure,
    values: Mapping[str, float],
    *,
    pulses_per_sample: int = DEFAULT_PULSES_PER_SAMPLE,
) -> OffsetTest | None:
    """Test at given parameters for an unknown constant in each equation and run; None if not computable.

    Two linear regressions of the residuals under autoregressive noise are compared. The regressors of the first one are
    the sensitivities to all free parameters and initial terms. The second regression also has, as regressors, the
    responses to a constant in each equation. The statistic is twice the logarithm of the likelihood ratio of their
    one-step prediction errors. `values` are consistent estimates by name, and `pulses_per_sample` is the number of
    block pulses per sampling interval.
    """
    (constant_name,) = unused_names("one", 1, structure, runs[0].signals)
    names = [f"{constant_name}_{k}" for k in range(len(structure.equations))]
    equations = tuple(
        replace(e, terms=(*e.terms, Term(constant_name, Order(), n)))
        for e, n in zip(structure.equations, names, strict=True)
    )
    initial = without_offset_equivalents(resolve_common_initial_conditions(runs, structure), structure, values)
    extended_structure = replace(structure, equations=equations, offset="none", initial=initial)
    try:
        extended_runs = [run.with_outputs({constant_name: np.ones(run.length)}) for run in runs]
        objective, point = evaluate_at_point(
            extended_runs, extended_structure, {**values, **dict.fromkeys(names, 0.0)}, pulses_per_sample
        )
    except FtlmError:
        # No statistic can be computed without a finite simulation on this grid.
        return None
    first_row = len(objective.problem.orders) + objective.problem.coefficients.index(names[0])
    rows = np.asarray(point.outcome["jacobian"])
    other_rows = np.delete(rows, range(first_row, first_row + len(names)), axis=0)
    residuals = np.asarray(point.outcome["residuals"])
    blocks = _residual_blocks(objective)
    columns = []
    for row in rows[first_row : first_row + len(names)]:
        for start, stop in ((run_blocks[0][0], run_blocks[-1][1]) for run_blocks in blocks):
            column = np.zeros(residuals.size)
            column[start:stop] = row[start:stop]
            columns.append(column)
    columns_before = np.stack(columns, axis=1)
    norms = column_norms(columns_before)
    scaled = columns_before / np.where(norms > 0, norms, 1.0)
    basis = orthonormal(other_rows.T, 1e-12) if other_rows.size else np.zeros((residuals.size, 0))
    for _ in range(2):
        scaled = scaled - basis @ (basis.T @ scaled)
    directions, singular_values, _ = thin_svd(scaled)
    basis_part = directions[:, singular_values > OFFSET_COLLINEARITY_TOLERANCE]
    count = basis_part.shape[1]
    residual_power = dot(residuals, residuals)
    if count == 0 or not residual_power > 0:
        return OffsetTest(0.0, 0, 0.0, 0.0)
    components = projections(basis_part, residuals)
    # The sensitivities are orthogonal to the responses to initial terms. These responses are regressors as well,
    # because the regression under colored noise estimates the initial terms again.
    common = np.column_stack([basis, *_initial_responses(point, blocks, residuals.size)])
    nested_regressors, extended_regressors = (
        np.ascontiguousarray(c.T) for c in (common, np.column_stack([common, basis_part]))
    )
    by_output = [list(places_of_output) for places_of_output in zip(*blocks, strict=True)]
    statistic = _core.prediction_ratio(nested_regressors, extended_regressors, residuals, by_output, DEFAULT_LAGS)
    offset_effect = basis_part @ components
    output_deviations = [float(np.nanstd(run[o])) for run in runs for o in structure.outputs]
    weights = [w for _ in runs for w in objective.weights]
    output_blocks = [block for run_blocks in blocks for block in run_blocks]
    relative_size = max(
        math.sqrt(float(np.mean(offset_effect[a:b] ** 2))) / (w * s) if w * s > 0 else 0.0
        for (a, b), w, s in zip(output_blocks, weights, output_deviations, strict=True)
    )
    return OffsetTest(statistic, count, float(components @ components) / residual_power, relative_size)


def offset_errors(
    joint: JointFit, structure: Structure, runs: Sequence[Run], offsets: Sequence[Mapping[str, Mapping[str, float]]]
) -> tuple[dict[str, dict[str, float]], ...]:
    """Return the standard errors of the offsets of each run, by output and kind; () if not computable.

    `offsets` are the estimates in the same form. A joint fit eliminates the offsets, so its covariance lacks them. Here
    the Jacobian has a row for each offset. It is the response to the input 1 for a constant, and to the input t for a
    ramp. For a level, it is 1 at the samples of the output.
    """
    entries = [(k, o, kind) for k, run in enumerate(offsets) for o, by_kind in run.items() for kind in by_kind]
    if not entries or len(offsets) != len(runs):
        return ()
    values, has_level = joint.values_by_name, structure.offset == "level"
    terms: dict[str, list[Term]] = {o: [] for o in structure.outputs}
    reserved_names = {*structure.signals, *structure.coefficient_names, *structure.order_names, *runs[0].signals}
    prefix = "one"
    while any(name.startswith(prefix) for name in reserved_names):
        prefix += "_"
    names = [] if has_level else [f"{prefix}_{kind}_{k}_{output}" for k, output, kind in entries]
    for name, (k, output, kind) in zip(names, entries, strict=False):
        values[name] = offsets[k][output][kind]
        terms[output].append(Term(f"{prefix}_{kind}_{k}", Order(), name))
    extended_runs = []
    for k, run in enumerate(runs):
        if has_level:
            extended_runs.append(
                deviations(run, structure, {o: by_kind["level"] for o, by_kind in offsets[k].items() if by_kind})[0]
            )
            continue
        shapes = {"constant": np.ones(run.length), "ramp": run.step * np.arange(run.length, dtype=float)}
        constant_inputs = {f"{prefix}_{kind}_{j}": shapes[kind] * float(k == j) for j, _, kind in entries}
        extended_runs.append(run.with_outputs(constant_inputs))
    initial = joint.initial
    if structure.is_linear and not has_level:
        initial = without_offset_equivalents(initial, structure, values)
    equations = tuple(replace(e, terms=(*e.terms, *terms[e.output])) for e in structure.equations)
    problem = FreeProblem.of(replace(structure, equations=equations, offset="none", initial=initial))
    weights = [1.0 / max(joint.noise[o], 1e-300) for o in structure.outputs]
    objective = Objective(
        problem, extended_runs, weights, max(joint.refinement, 1), robust_weights=joint.robust_weights
    )
    try:
        point = objective.minimize(start_from_values(problem, values), 1, linear_scale=True)
        rows = np.asarray(point.outcome["jacobian"])
        if has_level:
            rows = np.vstack([rows, *_level_responses(objective, point, entries)])
            point = replace(point, outcome={**point.outcome, "jacobian": rows})
        variances = np.diag(covariance(point, objective))
    except FtlmError:
        return ()
    indices = range(len(rows) - len(entries), len(rows)) if has_level else [problem.names.index(n) for n in names]
    errors: tuple[dict[str, dict[str, float]], ...] = tuple({o: {} for o in run} for run in offsets)
    for (k, output, kind), index in zip(entries, indices, strict=True):
        errors[k][output][kind] = math.sqrt(variances[index])
    return errors


def _level_responses(objective: Objective, point: Iterate, entries: Sequence[tuple[int, str, str]]) -> list[Floats]:
    """Return derivatives of weighted residuals with respect to levels, orthogonal to responses to initial terms.

    Each entry of `entries` is (index of the run, output, kind). The result has one array over all residuals per entry.
    """
    robust_weights, blocks = objective.residual_weights, _residual_blocks(objective)
    bases, columns = _initial_responses(point, blocks, robust_weights.size), []
    for k, output, _ in entries:
        output_index = objective.problem.structure.outputs.index(output)
        block = slice(*blocks[k][output_index])
        column = np.zeros(robust_weights.size)
        column[block] = objective.weights[output_index] * robust_weights[block]
        for basis in bases * 2:
            column -= basis @ projections(basis, column)
        columns.append(column)
    return columns


def output_sensitivities(joint: JointFit, structure: Structure, runs: Sequence[Run]) -> dict[str, list[Floats]]:
    """Return the sensitivities of residuals to parameters by output, an array (parameters, samples) for each run.

    Their projection on the responses to initial terms is subtracted. The result is {} if the evaluation fails.
    """
    try:
        objective, point = evaluate_at_point(runs, structure, joint.values_by_name, max(joint.refinement, 1))
    except FtlmError:
        return {}
    rows, blocks = np.asarray(point.outcome["jacobian"]), _residual_blocks(objective)
    return {
        name: [rows[:, slice(*run_blocks[k])] for run_blocks in blocks]
        for k, name in enumerate(objective.problem.structure.outputs)
    }


def without_offset_equivalents(initial: Initial, structure: Structure, values: Mapping[str, float]) -> Initial:
    """Return initial terms without the powers of t that the response to a constant contains.

    Caputo initial terms become a history with the remaining exponents. Other initial terms are returned unchanged.
    """
    if initial != "caputo":
        return initial
    exponents: set[float] = set()
    for equation in (e.with_orders({n: values[n] for n in e.order_names}) for e in structure.equations):
        equivalents = offset_exponents(equation.order.constant, "constant").values()
        exponents |= set(initial_exponents(equation, "caputo", "constant")) - {round(e, 9) for e in equivalents}
    return History(sorted(exponents))


def _residual_blocks(objective: Objective) -> list[list[tuple[int, int]]]:
    """Return, for each run, the (start, stop) indices of each output's block in the residual vector."""
    blocks, at = [], 0
    for _, count in objective.counts:
        run_blocks = []
        for _ in objective.problem.structure.outputs:
            run_blocks.append((at, at + count))
            at += count
        blocks.append(run_blocks)
    return blocks


def _initial_responses(point: Iterate, blocks: list[list[tuple[int, int]]], size: int) -> list[Floats]:
    """Return an array (residuals, initial terms) of responses to initial terms for each run that has such terms.

    The responses are 0 at the residuals of other runs, and `size` is the number of all residuals.
    """
    columns = []
    for responses, run_blocks in zip(point.outcome["initial_responses"], blocks, strict=True):
        if len(responses):
            columns.append(np.zeros((size, len(responses))))
            columns[-1][run_blocks[0][0] : run_blocks[-1][1]] = responses.T
    return columns


def constant_input(runs: Sequence[Run], structure: Structure) -> str | None:
    """Return the name of an input that is constant in every run and has a free coefficient at order 0, or None."""
    for equation in structure.equations:
        for term in equation.terms:
            is_constant_term = (
                term.fixed_value is None
                and not term.order.names
                and term.order.constant == 0
                and term.nonlinear is None
            )
            if is_constant_term and all(term.signal in r.inputs and float(np.ptp(r[term.signal])) == 0.0 for r in runs):
                return term.signal
    return None


def unrequested_offset_findings(test: OffsetTest | None, outputs: Sequence[str]) -> list[Finding]:
    """Return a finding if an offset that the user did not request would explain part of the residuals."""
    if test is None or not test.exceeds(UNREQUESTED_OFFSET_LEVEL, size=MIN_OFFSET_SIZE_RATIO):
        return []
    details = {"share": 100 * min(test.share, 1), "test": test.statistic_text}
    return [make_finding("offset_missing", output=", ".join(outputs), **details)]


def errors_with_orders(
    runs: Sequence[Run], structure: Structure, values: Mapping[str, float]
) -> dict[str, float] | None:
    """Return standard errors of orders and coefficients after an order search, by name; None if not computable.

    Refined instrumental variables are as efficient as output error. The standard errors are therefore those of output
    error with free orders, robust to colored residuals. The distance from the grid point to the optimum is added as a
    further error.
    """
    try:
        objective, point = evaluate_at_point(
            runs, replace(structure, coefficient_law=()), values, DEFAULT_PULSES_PER_SAMPLE
        )
        refit = objective.minimize(point, MAX_REFINEMENT_EVALUATIONS, linear_scale=True)
        variances = np.diag(covariance(refit, objective))
    except FtlmError:
        return None
    at_grid = np.array([values[n] for n in objective.problem.names])
    with np.errstate(invalid="ignore"):
        errors = np.sqrt(variances + (refit.values - at_grid) ** 2)
    return {
        n: e if math.isfinite(e) else math.inf for n, e in zip(objective.problem.names, errors.tolist(), strict=True)
    }


def fit_with_initial_conditions(
    runs: Sequence[Run],
    structure: Structure,
    start: Initial,
    *,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
    loss: Loss = "squares",
    guesses: Sequence[Mapping[str, float]] = (),
    single_start: bool = False,
) -> JointFit:
    """Fit a structure to runs with unknown initial conditions, and select the initial terms.

    `start` are the initial conditions suggested by the data. A fit with a history (powers of t that represent past
    inputs) is replaced by one with Caputo initial terms, of which there are fewer, if its residuals are equally small.
    A fit from rest is replaced only if a history improves it significantly. The result names the fitted terms in
    ``initial``. With `single_start`, the first of `guesses` is the only initial guess.
    """

    def fit_initial_terms(
        initial: Initial, *, refine: bool = True, multistart: _core.JointMultistart | None = None
    ) -> JointFit:
        request = replace(structure, initial=initial)
        fit = (
            partial(fit_output_error, start=guesses[0]) if single_start else partial(fit_output_error, guesses=guesses)
        )
        return fit(runs, request, threads=threads, refine=refine, progress=progress, loss=loss, multistart=multistart)

    is_decided = structure.initial != "auto" or not has_memory(structure) or not structure.is_linear
    if not is_decided and isinstance(start, History):
        # If few terms suffice on the coarsest grid, only they are fitted on finer grids: discretization errors favor
        # more terms, not fewer.
        request = replace(structure, initial=start)
        multistart = None if single_start else run_multistart(runs, request, threads, progress)
        history_fit = fit_initial_terms(start, refine=False, multistart=multistart)
        simplified = _simplify_initial_terms(history_fit, runs, structure, refine=False)
        if simplified is history_fit and not single_start:
            caputo_fit = _fit_without_implausible_history(
                history_fit, runs, structure, lambda: fit_initial_terms("caputo")
            )
            if caputo_fit is not None:
                return caputo_fit
        request = replace(structure, initial=simplified.initial)
        refined = fit_output_error(runs, request, initial_fit=simplified, loss=loss, multistart=multistart)
        unstable = refined.unstable_optimum or simplified.unstable_optimum or history_fit.unstable_optimum
        refined = replace(refined, starts=history_fit.starts, origin=history_fit.origin, unstable_optimum=unstable)
        return (
            refined if simplified is not history_fit else _simplify_initial_terms(refined, runs, structure, refine=True)
        )
    joint = fit_initial_terms(start)
    if is_decided or start != "rest" or not _has_nonzero_start(joint, runs, structure):
        return joint
    past_fit = fit_initial_terms(
        common_initial_conditions([history(run, structure) for run in runs]) or history(runs[0], structure)
    )
    return past_fit if fit_score(past_fit, joint) < fit_score(joint, joint) else joint


def fit_score(joint: JointFit, reference: JointFit) -> float:
    """Return the information criterion of a fit, by which initial conditions and offsets are compared.

    Lower is better. The noise color is taken from the fit `reference`.
    """
    series, reference_series = _pooled_residuals(joint), _pooled_residuals(reference)
    return start_score(series, joint.initial_terms, reference_series)


def fit_score_gain(joint: JointFit, other: JointFit, reference: JointFit) -> float:
    """Return the decrease of :func:`fit_score` from `other` to `joint`, both with the noise color of `reference`."""
    return fit_score(other, reference) - fit_score(joint, reference)


def fits_better(joint: JointFit, other: JointFit, margin: float = 0.0) -> bool:
    """Whether the criterion of a fit is below the other fit's criterion plus `margin`, which may be negative.

    Both criteria use the noise color of the fit with the larger residuals.
    """
    reference = max((other, joint), key=lambda either: math.prod(either.noise.values()))
    return fit_score_gain(joint, other, reference) > -margin


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
    series = [[run_residuals[o] for run_residuals in joint.residuals] for o in joint.noise]
    return all(is_independent(output_series, inputs) for output_series in series)


def _pooled_residuals(joint: JointFit) -> list[Floats]:
    """Return the residuals of each output in its unit, concatenated over all runs."""
    return [
        noise * np.concatenate([run_residuals[o] for run_residuals in joint.residuals])
        for o, noise in joint.noise.items()
    ]


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
    residuals = []
    for run in runs:
        simulated = simulate_refined(model, run, None, tolerance=HISTORY_SIMULATION_TOLERANCE)
        residuals.append(output_residuals(measured_samples(model, run, simulated.refinement), simulated.outputs))
    return list(np.concatenate(residuals, axis=1))


def _fitted_structure(joint: JointFit, structure: Structure) -> Structure:
    """Return a structure with the orders, coefficients and input parameters of a joint fit."""
    coefficients = FreeProblem.of(structure).coefficients_by_name(list(joint.coefficients.values()))
    return structure.with_orders(joint.orders).with_coefficients(coefficients).with_input_parameters(joint.inputs)


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
    RMS residuals are multiplied by `CONVERGED_RESIDUAL_FRACTION` if this minimization converged, otherwise by
    `SCREENING_RESIDUAL_FRACTION`. The products are an optimistic estimate of the residuals of a complete fit. If
    `accepts` rejects this estimate, the result is None. Otherwise the structure is fitted with the time step of
    `joint`. With `refine`, an accepted fit is repeated with a refined step. The returned fit may be one that `accepts`
    rejects.
    """
    problem = FreeProblem.of(structure)
    weights = [1.0 / max(joint.noise[o], 1e-300) for o in structure.outputs]
    objective = Objective(problem, runs, weights, max(joint.refinement, 1), robust_weights=joint.robust_weights)
    loss: Loss = "squares" if joint.robust is None else "huber"
    initial = start_from_values(problem, joint.values_by_name)
    try:
        # Limit of the increase of twice the log-likelihood in one step, per sample.
        tolerance = SCREENING_LIKELIHOOD_TOLERANCE / joint.samples
        screening = objective.minimize(initial, MAX_SCREENING_EVALUATIONS, linear_scale=True, tolerance=tolerance)
        factor = CONVERGED_RESIDUAL_FRACTION if screening.has_converged else SCREENING_RESIDUAL_FRACTION
        deviation = objective.rms_residuals(screening)
        if joint.robust is not None:
            deviation = {o: robust_deviation(e) for o, e in objective.pooled_residuals(screening).items()}
        optimistic = replace(
            joint,
            noise={o: factor * v * joint.noise[o] for o, v in deviation.items()},
            residuals=[
                {o: e / max(deviation[o], 1e-300) for o, e in run_residuals.items()}
                for run_residuals in objective.residuals(screening)
            ],
            initial_terms=sum(len(terms) for run in screening.outcome["initial"] for terms in run)
            + uncounted_level_count(runs, structure),
        )
        if not accepts(optimistic):
            return None
        # The Jacobian and samples of the screening are released before the fit, which needs as much memory.
        del objective, screening, optimistic
        fit = fit_output_error(runs, structure, initial_fit=joint, loss=loss, refine=False)
        if refine and accepts(fit):
            # The refinement of a fit is that of the finer of its two last grids.
            coarser = replace(fit, refinement=max(fit.refinement // 2, 1))
            fit = fit_output_error(runs, structure, initial_fit=coarser, loss=loss)
    except FtlmError:
        return None
    return fit


def fit_without_history(joint: JointFit, runs: Sequence[Run], structure: Structure) -> JointFit | None:
    """Return a fit with Caputo initial terms and a constant if it fits as well as one with a history, else None."""
    request = replace(structure, offset="constant")
    loss: Loss = "squares" if joint.robust is None else "huber"
    try:
        fit = partial(fit_output_error, runs, start=joint.values_by_name, loss=loss, refine=False)
        caputo_fit = fit(replace(request, initial="caputo"))
        # Both fits use the same grids, because discretization errors of a coarse grid are no evidence of a history.
        history_fit = fit(replace(structure, initial=joint.initial))
    except FtlmError:
        return None
    has_fewer_terms = caputo_fit.initial_terms < history_fit.initial_terms
    return caputo_fit if has_fewer_terms and not _fit_needs_history(caputo_fit, history_fit, runs, request) else None


def _fit_needs_history(caputo_fit: JointFit, history_fit: JointFit, runs: Sequence[Run], structure: Structure) -> bool:
    """Whether residuals of `caputo_fit` are significantly larger than those of `history_fit`."""
    caputo_residuals, history_residuals = _pooled_residuals(caputo_fit), _pooled_residuals(history_fit)
    output_deviations = [float(np.nanstd(np.concatenate([run[o] for run in runs]))) for o in structure.outputs]
    return needs_history(
        structure,
        caputo_residuals,
        history_residuals,
        output_deviations,
        (caputo_fit.initial_terms, history_fit.initial_terms),
    )


def _has_nonzero_start(joint: JointFit, runs: Sequence[Run], structure: Structure) -> bool:
    """Whether the runs, at the parameters of a fit from rest, require nonzero initial conditions."""
    return is_in_motion(_fitted_structure(joint, structure), runs)
