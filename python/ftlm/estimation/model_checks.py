"""Checks of an identified model: identifiability, bounds, residuals, excitation and stability."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ftlm import _core
from ftlm.analysis.frequency_response import covariance_of, parameter_vector, with_parameter_vector
from ftlm.analysis.poles import GROWTH_LEVEL, GROWTH_SIGMAS, OrderExcess, modes, order_excesses
from ftlm.data.run import Run
from ftlm.data.sampling import ZERO_ORDER_HOLD, drop_missing, interpolate_gaps
from ftlm.errors import FtlmError
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Iterate, Objective
from ftlm.estimation.output_error import OUTLIER_DEVIATIONS, JointFit
from ftlm.findings import Finding, make_finding
from ftlm.model.model import Model
from ftlm.simulation.discretization import compared_values, has_nonuniform_samples
from ftlm.simulation.initial_conditions import (
    START_SETTINGS,
    RestEvidence,
    noise_at_start,
    resolve_start,
    rest_evidence,
)
from ftlm.simulation.output_samples import OutputSamples
from ftlm.structure.structure import Structure
from ftlm.utils.linalg import dot
from ftlm.utils.statistics import chi_squared, is_white, quantization_step, robust_deviation
from ftlm.utils.validation import Floats
from ftlm.validation.comparison import Comparison
from ftlm.validation.data_advice import check_excitation, find_dead_channel

#: Maximum absolute correlation of two separately identifiable parameters, unless one of them is well determined.
MAX_PARAMETER_CORRELATION = 0.995
#: Minimum number of samples per period of a mode, below which its parameters depend on the assumed intersample behavior
#: of the inputs; and minimum damping ratio of a mode that does not count as oscillatory.
MIN_SAMPLES_PER_PERIOD, MAX_SWING_DAMPING = 8.0, 0.7
#: Maximum relative standard error of a well-determined coefficient or delay, and maximum standard error of an order.
#: The 95 % interval is then shorter than half the value, or than the increment 0.5 between orders of common mechanisms.
MAX_RELATIVE_STANDARD_ERROR = 0.1
#: An output responds too early if it leaves its level in the sample in which an input changes. The deviation must
#: exceed `EARLY_SIGMAS` noise standard deviations. Divided by the next increment, it must be within `EARLY_ROWS`
#: [samples]. With a larger ratio, the output would have left its level one sample earlier.
EARLY_SIGMAS, EARLY_ROWS = 4.0, (0.1, 1.5)
#: Outliers are reported from a minimum number and a minimum fraction of all residuals on. They are also reported if
#: their fraction of the residual sum of squares reaches a limit, which doubles the variance of every parameter.
MIN_OUTLIERS = 3
MIN_OUTLIER_FRACTION = 2e-3
MIN_OUTLIER_POWER_FRACTION = 0.5
#: Number of samples of similar speed from which the standard deviation of the residuals at that speed is estimated.
ROWS_OF_ONE_SPEED = 25
#: Quantization step, in noise standard deviations, above which quantization dominates the residuals.
QUANTIZATION_NOISE_RATIO = 2.0
#: Minimum change per sampling interval that counts as motion, as a fraction of the range or largest change of the
#: output.
MIN_MOTION_RANGE_FRACTION = 1e-6
#: Conditional variance of a parameter, relative to its variance, below which the eliminated parameters determine it.
MIN_VARIANCE_RATIO = 1e-9
#: Minimum number of sampling intervals at low speed that determine the Stribeck term. A speed is low below
#: `SLOW_SPEED_RATIO` times the Stribeck speed.
MIN_SLOW_INTERVALS, SLOW_SPEED_RATIO = 5, 2.0
#: Maximum decrease of the log likelihood from the best optimum to a second optimum, and minimum difference between
#: their values of one parameter [standard errors].
SECOND_OPTIMUM_LOG_LIKELIHOOD, SECOND_OPTIMUM_ERRORS = 2.0, 3.0
#: Sum of squared differences between the residuals of two optima, divided by the noise variance, below which both are
#: the same model.
SAME_MODEL_POWER = 1e-2
#: Maximum cost of a multistart candidate from which a second optimum is sought, relative to the lowest cost. Both are
#: costs on the coarse grid.
MAX_SECOND_COST_RATIO = 1.05
#: Maximum number of evaluations of the search for a second optimum.
MAX_SECOND_EVALUATIONS = 60
#: Second optima of long records are first sought on the first samples of each run: total number over all runs, and
#: minimum number per run.
MAX_SECOND_SAMPLES, MIN_SECOND_RUN_SAMPLES = 6000, 1000
#: Maximum relative deviation of a coefficient from its value by the coefficient law.
MAX_LAW_DEVIATION = 0.05


def identifiability_findings(joint: JointFit, problem: FreeProblem) -> list[Finding]:
    """Return findings on failed convergence, and on parameters that are on a bound or not determined by the runs."""
    findings = []
    if not joint.converged:
        findings.append(make_finding("not_converged"))
    findings += _unstable_optimum_findings(joint)
    errors = joint.standard_errors
    unidentifiable = [n for n in joint.names if math.isinf(errors[n])]
    if unidentifiable:
        findings.append(
            make_finding(
                "not_separately_identifiable",
                parameter=", ".join(unidentifiable),
                shown=enumerate_names(unidentifiable),
            )
        )
    for (name, value), (low, high) in zip(joint.orders.items(), problem.bounds, strict=True):
        # Negated so that a NaN standard error counts as too large.
        if name in unidentifiable:
            continue
        if not errors[name] <= high - low and not _has_bounded_interval(joint, name):
            findings.append(make_finding("order_not_identifiable", parameter=name))
        elif min(value - low, high - value) < 1e-6 and high > low and value != 0:
            findings.append(make_finding("on_bound", parameter=name, what=f"order {name}", value=f"{value:g}"))
    for item in problem.inputs:
        value, (low, high) = joint.inputs[item.name], item.bounds
        if item.name in unidentifiable:
            continue
        if not errors[item.name] <= high - low and not _has_bounded_interval(joint, item.name):
            findings.append(
                make_finding("input_parameter_not_identifiable", parameter=item.name, words=item.description)
            )
        elif high - value < 1e-6 * (high - low) or (low > 0 and value - low < 1e-6 * (high - low)):
            unit = " s" if item.kind == "delay" else ""
            findings.append(
                make_finding("on_bound", parameter=item.name, what=f"the {item.description}", value=f"{value:g}{unit}")
            )
    for name, value in joint.coefficients.items():
        # If the cost is not quadratic, the profile is more accurate than the standard error.
        is_bounded = name in joint.profiles and 0.0 not in joint.profiles[name]
        if name not in unidentifiable and not errors[name] <= abs(value) and not is_bounded:
            findings.append(make_finding("not_different_from_0", parameter=name, value=value, error=errors[name]))
    return findings + correlation_findings(joint) + unbounded_interval_findings(joint, unidentifiable)


def second_optimum_findings(
    names: Sequence[str],
    values: Floats,
    errors: Mapping[str, float],
    optima: Sequence[tuple[Floats, float, Mapping[str, float]]],
) -> list[Finding]:
    """Return a finding on the most likely other optimum whose parameters differ by over three standard errors.

    `values` and `errors` are the parameters of the best optimum and their standard errors. Each other optimum is given
    as (values, decrease of the log likelihood, standard errors by name). Each difference is compared with the larger of
    the two standard errors.
    """
    for optimum_values, likelihood_decrease, optimum_errors in sorted(optima, key=lambda optimum: optimum[1]):
        if likelihood_decrease > SECOND_OPTIMUM_LOG_LIKELIHOOD:
            break
        difference_texts = [
            f"{n} = {other_value:.4g} for {value:.4g}"
            for n, value, other_value in zip(names, values.tolist(), optimum_values.tolist(), strict=True)
            if math.isfinite(errors[n])
            and abs(other_value - value) > SECOND_OPTIMUM_ERRORS * max(errors[n], optimum_errors[n])
        ]
        if difference_texts:
            names_text = ", ".join(text.partition(" = ")[0] for text in difference_texts)
            return [
                make_finding(
                    "second_optimum",
                    parameter=names_text,
                    shown=", ".join(difference_texts),
                    difference=max(likelihood_decrease, 0.0),
                )
            ]
    return []


def multistart_findings(joint: JointFit, problem: FreeProblem, runs: Sequence[Run]) -> list[Finding]:
    """Return a finding if a candidate of the multistart leads to a second, almost equally likely optimum.

    Candidates of low cost that are far from the optimum are fitted to all samples.
    """
    errors = [joint.standard_errors[n] for n in joint.names]
    best_cost = min((cost for cost, _ in joint.survivors), default=0.0)
    distinct = [
        np.array(values)
        for cost, values in joint.survivors
        if cost <= MAX_SECOND_COST_RATIO * best_cost
        and any(
            math.isfinite(e) and abs(b - a) > SECOND_OPTIMUM_ERRORS * e
            for a, b, e in zip(joint.values.tolist(), values, errors, strict=True)
        )
    ]
    is_exact = len(joint.exact_outputs(runs)) == len(problem.structure.outputs)
    if not distinct or is_exact or joint.robust is not None or not problem.structure.is_linear:
        return []
    weights = [1.0 / max(joint.noise[o], 1e-300) for o in problem.structure.outputs]
    sample_limit = max(MAX_SECOND_SAMPLES // len(runs), MIN_SECOND_RUN_SAMPLES)
    shortened_runs = [
        run.window(0.0, sample_limit * run.step) if run.length > 2 * sample_limit else run for run in runs
    ]
    optima = [(values, 0.0) for values in distinct]
    # A second optimum on all samples is also one on the first part, on which the search is cheaper.
    for compared_runs in (
        [shortened_runs, runs]
        if any(part is not run for part, run in zip(shortened_runs, runs, strict=True))
        else [runs]
    ):
        objective = Objective(problem, compared_runs, weights, pulses_per_sample=joint.refinement)
        optima = _other_optima(objective, joint.values, [values for values, _ in optima]) if optima else []
    standard_errors = joint.standard_errors
    return second_optimum_findings(
        joint.names,
        joint.values,
        standard_errors,
        [(values, likelihood_decrease, standard_errors) for values, likelihood_decrease in optima],
    )


def _other_optima(objective: Objective, optimum: Floats, starts: Sequence[Floats]) -> list[tuple[Floats, float]]:
    """Return other optima that are almost as likely as the best one but have other simulated outputs.

    Each is returned as (values, decrease of the log likelihood). The result is [] if a fit from one of `starts` fails.
    """

    def fit(values: Floats) -> tuple[Floats, float, Floats]:
        orders, coefficients, inputs = objective.problem.split(values.tolist())
        start = Iterate(orders, coefficients, "second optimum", {}, inputs)
        fitted = objective.minimize(start, MAX_SECOND_EVALUATIONS, linear_scale=True)
        return fitted.values, float(fitted.outcome["cost"]), np.asarray(fitted.outcome["residuals"])

    optima = []
    try:
        _, cost, residuals = fit(optimum)
        for start in starts:
            values, other_cost, series = fit(start)
            is_other = float(np.sum((series - residuals) ** 2)) > SAME_MODEL_POWER
            if is_other and other_cost - cost <= SECOND_OPTIMUM_LOG_LIKELIHOOD:
                optima.append((values, other_cost - cost))
    except FtlmError:
        # The path between the optima has no finite simulation.
        return []
    return optima


def _unstable_optimum_findings(joint: JointFit) -> list[Finding]:
    """Return a finding on an unstable optimum, which states whether the unstable or a stable optimum was chosen."""
    if joint.unstable_optimum is None or joint.unstable_optimum.residual_excess <= 0.0:
        # An unstable optimum with a larger cost than the stable one is no alternative.
        return []
    excess = 100.0 * joint.unstable_optimum.residual_excess
    if not joint.unstable_optimum.is_accepted:
        limit = joint.unstable_optimum.at_stability_limit
        smaller = 100.0 * (1.0 - 1.0 / (1.0 + joint.unstable_optimum.residual_excess))
        return [make_finding("damping_not_identifiable" if limit else "unstable_optimum_discarded", smaller=smaller)]
    if not math.isfinite(excess):
        return [make_finding("no_stable_optimum")]
    return [make_finding("unstable_optimum_kept", excess=excess)]


def _has_bounded_interval(joint: JointFit, name: str) -> bool:
    """Whether the profile-likelihood interval of a parameter is bounded on both sides."""
    return name in joint.profiles and not joint.profiles[name].is_open


def unbounded_interval_findings(joint: JointFit, unidentifiable: Sequence[str]) -> list[Finding]:
    """Return a finding on parameters whose confidence interval is unbounded, except unidentifiable ones."""
    unbounded_sides = {
        n: [s for s, end in (("below", p.low), ("above", p.high)) if math.isinf(end)]
        for n, p in joint.profiles.items()
        if n not in unidentifiable
    }
    open_ended = {n: s for n, s in unbounded_sides.items() if s}
    if not open_ended:
        return []
    texts = [f"{n} {' or '.join(s)}" for n, s in open_ended.items()]
    return [make_finding("interval_open", parameter=", ".join(open_ended), sides=", ".join(texts))]


def sample_findings(runs: Sequence[Run], joint: JointFit, problem: FreeProblem) -> list[Finding]:
    """Return findings on discretization, color of residuals, outliers, quantization and interpolated samples.

    Outputs whose residuals are at the level of rounding errors give no finding, because such residuals hardly change
    the estimates.
    """
    exact = joint.exact_outputs(runs)
    outputs = [o for o in problem.structure.outputs if o not in exact]
    colored_outputs = [
        o for o in sorted(outputs) if not all(is_white(run_residuals[o]) for run_residuals in joint.residuals)
    ]
    findings = []
    if outputs and not joint.step_converged:
        findings.append(make_finding("step_moves_estimate", pulses=joint.refinement))
    findings += [make_finding("residuals_not_white", output=output) for output in colored_outputs]
    for output in outputs:
        findings += _outlier_findings(runs, problem.structure, joint, output)
        findings += _quantization_findings(runs, problem.structure, output, joint.noise[output])
    run_names = [
        run.name
        for run in runs
        if run.nonuniform_samples is not None and not has_nonuniform_samples(run, problem.structure)
    ]
    if run_names:
        findings.append(make_finding("sample_times_interpolated", run=", ".join(run_names)))
    return findings


def start_findings(runs: Sequence[Run], structure: Structure) -> list[Finding]:
    """Return findings on runs that are assumed to start from rest, with the evidence for or against it."""
    resolved = resolve_start(runs, structure)
    findings = []
    some_rested = resolved.initial == "auto" and resolved.offset == "level"
    for run in runs if resolved.initial == "rest" or some_rested else ():
        evidence = rest_evidence(run, structure)
        if evidence is None:
            continue
        outputs = [o for o in structure.outputs if o in evidence.levels]
        levels = enumerate_names([f"{o} = {evidence.levels[o]:.4g}" for o in outputs])
        if evidence.rows == 0 and structure.initial == "auto":
            first_changes = {n: int(run[n][0] != run[n][1]) for n in structure.signals if n in run.inputs}
            row = max(first_changes.values())
            inputs = enumerate_names([n for n in first_changes if np.any(run[n])])
            findings.append(make_finding("rest_assumed", run=run.name, input=inputs, row=row, shown=levels))
        elif evidence.rows and resolved.offset == "level":
            nonzero_inputs = [f"{n} = {v:.4g}" for n, v in evidence.inputs.items() if v]
            other_inputs = f" with {enumerate_names(nonzero_inputs)}" if nonzero_inputs else ""
            level_text = f"the run rests at {levels}{other_inputs}"
            findings.append(make_finding("rests_at_level", run=run.name, rows=evidence.rows, shown=level_text))
        findings += _early_output_findings(run, structure, evidence)
    return findings


def _early_output_findings(run: Run, structure: Structure, evidence: RestEvidence) -> list[Finding]:
    """Return findings on outputs that respond in the same sample in which an input first changes.

    With a zero-order hold the change acts from that sample on, so a strictly proper model responds one sample later.
    """
    row = evidence.rows
    if not START_SETTINGS.quiet_rows <= row < run.length - 1 or run.nonuniform_samples is not None:
        return []
    changes = [n for n in evidence.inputs if run[n][row] != run[n][row - 1]]
    findings = []
    for equation in structure.equations:
        input_terms = [t for t in equation.terms if t.signal in changes]
        direct = any(t.order == equation.order for t in input_terms)
        if not input_terms or direct or any(run.intersample[t.signal] != ZERO_ORDER_HOLD for t in input_terms):
            continue
        y, level = run[equation.output], evidence.levels[equation.output]
        noise = noise_at_start(y)
        excursion, slope = float(y[row]) - level, float(y[row + 1] - y[row])
        rows = excursion / slope if slope else math.inf
        # A drifting output also deviates from its mean level, but its last increment is not larger than the others.
        increments = np.diff(drop_missing(y[: row + 1]))
        usual_increment = max(noise, float(np.sqrt(np.mean(increments[:-1] ** 2))))
        is_early = abs(excursion) > EARLY_SIGMAS * noise and abs(increments[-1]) > EARLY_SIGMAS * usual_increment
        if is_early and EARLY_ROWS[0] <= rows <= EARLY_ROWS[1]:
            details = {"row": row, "size": abs(excursion) / noise, "rows": rows}
            inputs = enumerate_names([t.signal for t in input_terms])
            location = {"run": run.name, "output": equation.output, "input": inputs}
            findings.append(make_finding("moves_before_input", **location, **details))
    return findings


def _outlier_findings(runs: Sequence[Run], structure: Structure, joint: JointFit, output: str) -> list[Finding]:
    """Return a finding on outliers among the residuals of an output; [] if a robust loss was used."""
    if joint.robust is not None:
        return []
    series = [joint.noise[output] * part[output] for part in joint.residuals]
    all_residuals = drop_missing(np.concatenate(series))
    outputs = [compared_values(run, structure, output) for run in runs]
    speeds = [_simulated_speeds(y, part) for y, part in zip(outputs, series, strict=True)]
    usual_deviations = _usual_deviations(np.concatenate(series), np.concatenate(speeds))
    power, outlier_count, first_text = 0.0, 0, ""
    limits = np.split(OUTLIER_DEVIATIONS * usual_deviations, np.cumsum([part.size for part in series])[:-1])
    for run, part, limit in zip(runs, series, limits, strict=True):
        rows = np.flatnonzero(np.abs(part) > limit)
        power += float(np.sum(part[rows] ** 2))
        if rows.size and not outlier_count:
            # The first residual belongs to the second sample of a run.
            first_text = f"first at row {int(rows[0]) + 1} of {run.name}"
        outlier_count += rows.size
    count = all_residuals.size
    power_fraction = power / max(dot(all_residuals, all_residuals), 1e-300)
    if not np.any(usual_deviations > 0.0) or (
        power_fraction < MIN_OUTLIER_POWER_FRACTION and outlier_count < max(MIN_OUTLIERS, MIN_OUTLIER_FRACTION * count)
    ):
        return []
    verb, contribution_verb, noun = (
        ("lies", "contributes", "an outlier") if outlier_count == 1 else ("lie", "contribute", "outliers")
    )
    return [
        make_finding(
            "outliers_dominate" if power_fraction >= MIN_OUTLIER_POWER_FRACTION else "outliers",
            output=output,
            count=outlier_count,
            total=count,
            deviations=OUTLIER_DEVIATIONS,
            power=100 * power_fraction,
            first=first_text,
            verb=verb,
            holds=contribution_verb,
            noun=noun,
        )
    ]


def _simulated_speeds(samples: Floats, residuals: Floats) -> Floats:
    """Return, for each residual, the larger change of the simulated output to a neighboring sample (absolute value).

    The simulated output is the measured one minus the residuals, so outliers of the measurement do not affect it.
    """
    simulated = interpolate_gaps(samples[1 : 1 + residuals.size] - residuals)
    increments = np.abs(np.diff(simulated, prepend=simulated[:1], append=simulated[-1:]))
    return np.maximum(increments[:-1], increments[1:])


def _usual_deviations(residuals: Floats, speeds: Floats) -> Floats:
    """Return a robust standard deviation of the residuals for each sample, by which outliers are detected.

    It is estimated from all samples, or from the samples of similar speed if that estimate is larger. Residuals that
    grow with speed, such as those of timing or gain errors, are therefore not outliers. If the machine is at rest
    during most of the run, samples in motion are not outliers either.
    """
    deviations = np.full(residuals.size, robust_deviation(drop_missing(residuals)))
    finite_rows = np.flatnonzero(~np.isnan(residuals))
    for rows in np.array_split(
        finite_rows[np.argsort(speeds[finite_rows], kind="stable")], max(finite_rows.size // ROWS_OF_ONE_SPEED, 1)
    ):
        deviations[rows] = np.maximum(deviations[rows], robust_deviation(residuals[rows]))
    return deviations


def _quantization_findings(runs: Sequence[Run], structure: Structure, output: str, noise: float) -> list[Finding]:
    """Return a finding if the quantization step of an output exceeds `QUANTIZATION_NOISE_RATIO` times its noise."""
    quantization_steps = [quantization_step(drop_missing(compared_values(run, structure, output))) for run in runs]
    coarse = [
        (step, run)
        for step, run in zip(quantization_steps, runs, strict=True)
        if step > QUANTIZATION_NOISE_RATIO * noise
    ]
    if not coarse:
        return []
    step, run = max(coarse, key=lambda pair: pair[0])
    return [make_finding("quantised", run=run.name, output=output, step=step, noise=noise)]


def correlation_findings(joint: JointFit) -> list[Finding]:
    """Return findings on groups of parameters that are not separately identifiable, one per group."""
    errors, correlation = joint.standard_errors, np.abs(joint.correlation)
    magnitudes = {n: abs(v) for n, v in joint.values_by_name.items()}
    # Negated so that a NaN standard error counts as too large.
    uncertain = [
        i
        for i, n in enumerate(joint.names)
        if not errors[n] <= MAX_RELATIVE_STANDARD_ERROR * (1.0 if n in joint.orders else magnitudes[n])
    ]
    groups: list[list[int]] = []
    for i in uncertain:
        inseparable = [g for g in groups if any(_are_inseparable(joint, correlation, i, j) for j in g)]
        groups = [g for g in groups if g not in inseparable] + [sorted([*(j for g in inseparable for j in g), i])]
    findings = []
    for group in (g for g in groups if len(g) > 1):
        *first_names, last = (joint.names[i] for i in group)
        finite_values = [c for i in group for j in group if i < j and math.isfinite(c := float(correlation[i, j]))]
        noun = "correlation" if len(group) == 2 else "correlations up to"
        why = f"{noun} {max(finite_values):.4f}" if finite_values else "their standard errors are not finite"
        findings.append(
            make_finding("parameters_correlated", parameter=f"{', '.join(first_names)} and {last}", why=why)
        )
    return findings


def _are_inseparable(joint: JointFit, correlation: Floats, i: int, j: int) -> bool:
    """Whether two parameters cannot be identified separately.

    They are strongly correlated, or both have an infinite standard error.
    """
    errors = joint.standard_errors
    if not any(math.isfinite(errors[joint.names[k]]) for k in (i, j)):
        return True
    return bool(correlation[i, j] > MAX_PARAMETER_CORRELATION)


def excitation_findings(runs: Sequence[Run], structure: Structure) -> list[Finding]:
    """Return a finding for each equation whose free parameters are not excited in any run."""
    findings_by_run = [{f.output: f for f in check_excitation(run, structure)} for run in runs]
    return [
        finding for output, finding in findings_by_run[0].items() if all(output in other for other in findings_by_run)
    ]


def dead_channel_findings(runs: Sequence[Run], structure: Structure) -> list[Finding]:
    """Return findings on measured outputs that are constant during part of a run although they vary otherwise."""
    channels = [(r.with_interpolated_gaps(), n) for r in runs for n in r.outputs if n in structure.signals]
    return [finding for run, name in channels for finding in find_dead_channel(run, name)]


def coefficient_law_findings(model: Model) -> list[Finding]:
    """Return findings on separately estimated coefficients that violate the coefficient law of the structure."""
    law, values = model.structure.coefficient_law, model.coefficients
    findings = []
    for name, sign, factors in law:
        factor_values = [values[f] for f in factors if f in values]
        if name not in values or len(factor_values) != len(factors):
            continue
        expected = sign * math.prod(factor_values)
        if abs(values[name] - expected) > MAX_LAW_DEVIATION * max(abs(expected), abs(values[name])):
            findings.append(make_finding("coefficient_law_broken", parameter=name, value=values[name], wanted=expected))
    ratios: dict[str, list[tuple[str, float]]] = {}
    for name, sign, factors in law:
        free = [f for f in factors if f not in values]
        factor_values = [values[f] for f in factors if f in values]
        other_factors = math.prod(factor_values)
        if name in values and len(free) == 1 and factor_values and other_factors:
            ratios.setdefault(free[0], []).append((name, sign * values[name] / other_factors))
    for ratio, estimates in ratios.items():
        violating = [(n, v) for n, v in estimates if not v > 1]
        if violating:
            values_text = ", ".join(f"{v:.4g} by {n}" for n, v in violating)
            findings.append(make_finding("inertia_ratio_broken", parameter=ratio, listed=values_text))
    return findings


def discretization_findings(model: Model, comparison: Comparison) -> list[Finding]:
    """Return findings if the block-pulse discretization is unstable at this step although the model is stable.

    Such an instability occurs in a stiff equation of order alpha if an output term has an order nu with alpha - nu > 1.
    The discretization then has an unstable mode at the Nyquist frequency, which the model does not have.
    """
    findings = []
    for equation in model.equations:
        output_terms = [
            (float(t.fixed_value or 0.0), equation.order.constant - t.order.constant)
            for t in equation.terms
            if t.column == equation.output
        ]
        margin = min(_core.nyquist_margin(output_terms, step) for step in comparison.step)
        if margin <= 0:
            findings.append(make_finding("scheme_unstable", output=equation.output, m=comparison.m, margin=margin))
    return findings


def friction_direction_findings(model: Model, simulations: Sequence[OutputSamples]) -> list[Finding]:
    """Return a finding for each body that slides in one direction only, so that friction and offset are collinear."""
    if not model.structure.has_friction or model.structure.offset == "none":
        return []

    def reverses(samples: Floats) -> bool:
        increments, threshold = np.diff(samples), MIN_MOTION_RANGE_FRACTION * float(np.ptp(samples))
        return bool(np.any(increments > threshold) and np.any(increments < -threshold))

    return [
        make_finding("friction_unsigned", output=model.outputs[i])
        for i in model.structure.friction_equations
        if not any(reverses(run.outputs[i]) for run in simulations)
    ]


def stribeck_findings(model: Model, runs: Sequence[Run], simulations: Sequence[OutputSamples]) -> list[Finding]:
    """Return findings if no run distinguishes friction at low speed from friction at high speed."""
    findings = []
    for equation in model.equations:
        stribeck = None if equation.friction is None else equation.friction.stribeck
        if stribeck is None or (stribeck.name is None and stribeck.speed_name is None):
            continue
        vs, column = float(stribeck.speed), model.outputs.index(equation.output)
        speeds_by_run = [
            np.abs(np.diff(simulated.outputs[column])) / run.step
            for run, simulated in zip(runs, simulations, strict=True)
        ]
        speeds = np.concatenate([p[p > MIN_MOTION_RANGE_FRACTION * p.max(initial=0.0)] for p in speeds_by_run])
        slow_count = int(np.sum(speeds < SLOW_SPEED_RATIO * vs))
        if slow_count < MIN_SLOW_INTERVALS:
            details = {
                "ratio": SLOW_SPEED_RATIO,
                "speed": SLOW_SPEED_RATIO * vs,
                "slow": slow_count,
                "total": speeds.size,
            }
            findings.append(make_finding("slow_motion_missing", output=equation.output, **details))
        elif speeds.max(initial=0.0) < vs:
            findings.append(make_finding("fast_motion_missing", output=equation.output, speed=vs))
    return findings


#: Codes of the findings on significantly and on insignificantly unstable poles, by whether the simulation of the model
#: contains these poles. It does not if outputs that enter other equations are taken as measured.
GROWTH_CODES = {
    True: ("simulation_unbounded", "instability_not_significant"),
    False: ("coupled_model_unstable", "coupled_instability_not_significant"),
}


def stability_findings(model: Model) -> list[Finding]:
    """Return findings on poles with a positive real part; a short run may not reveal the growth of their modes.

    The finding is an error if the real part of a pole is significantly positive. Otherwise an integrator or a slowly
    decaying mode explains the run as well. A stable model with measured coupling may be unstable if its equations are
    simulated together, as in its frequency response and in a controller design.
    """
    if not model.structure.is_linear:
        # Friction or a hardening spring can bound a growing motion. Poles do not describe this.
        return []
    coupling = model.structure.coupling
    findings = _instability_findings(model, coupling)
    if findings or coupling == "simulated":
        return findings
    try:
        return _instability_findings(model, "simulated")
    except FtlmError:
        # Equations that cannot be solved for all outputs together have no common poles.
        return []


def _instability_findings(model: Model, coupling: str) -> list[Finding]:
    """Return findings on poles with a positive real part of the model with the given coupling."""
    stable = model.stability(coupling=coupling)
    if not stable.unstable_poles > 0:
        return []
    excesses = order_excesses(model, coupling=coupling)
    findings = [_excess_finding(excess) for excess in excesses]
    count = stable.unstable_poles - _excess_pole_count(excesses)
    if count > 0:
        codes = GROWTH_CODES[coupling == model.structure.coupling]
        code = codes[0 if _has_other_unstable_mode(model, coupling) else 1]
        findings.append(make_finding(code, stability=str(stable), poles=unstable_poles_text(count)))
    return findings


def _excess_finding(excess: OrderExcess) -> Finding:
    """Return the finding on an :class:`OrderExcess` and the unstable pole that it causes."""
    return make_finding(
        "order_excess" if excess.significant else "order_excess_not_significant",
        excess=excess.excess,
        spread="" if not excess.error else f" ± {excess.error:.2g}",
        order_sum=excess.order_sum,
        frequency=math.exp(max(w.real for w in excess.poles)),
    )


def _excess_pole_count(excesses: Sequence[OrderExcess]) -> int:
    return sum(len(excess.poles) for excess in excesses)


def mode_sampling_findings(model: Model, runs: Sequence[Run]) -> list[Finding]:
    """Return a finding if the fastest oscillatory mode has too few samples per period."""
    if not model.structure.is_linear:
        return []
    try:
        oscillatory_modes = [m for m in modes(model, coupling=model.structure.coupling) if m.oscillatory]
    except FtlmError:
        return []
    fastest = max((m.frequency for m in oscillatory_modes if abs(m.damping) < MAX_SWING_DAMPING), default=0.0)
    if not fastest > 0.0:
        return []
    samples = 2.0 * math.pi / (fastest * max(run.step for run in runs))
    if samples >= MIN_SAMPLES_PER_PERIOD:
        return []
    loss = 100.0 * (1.0 - float(np.sinc(1.0 / samples)))
    details = {"frequency": fastest, "samples": samples, "phase": 180.0 / samples, "loss": loss}
    return [make_finding("mode_sampled_coarsely", **details)]


def has_unstable_mode(model: Model, coupling: str) -> bool:
    """Whether the model has a significantly unstable mode (99 %); True if modes or their errors are unknown.

    `coupling` selects the poles, as in :func:`ftlm.modes`.
    """
    excesses = order_excesses(model, coupling=coupling)
    if any(excess.significant for excess in excesses):
        return True
    count = model.stability(coupling=coupling).unstable_poles - _excess_pole_count(excesses)
    return count > 0 and _has_other_unstable_mode(model, coupling)


def _has_other_unstable_mode(model: Model, coupling: str) -> bool:
    """Whether the model has a significantly unstable mode that no :class:`OrderExcess` causes.

    The standard error of a pole is a first-order approximation. It fails at multiple poles, such as those of a double
    integrator. A mode is therefore not significant if the model is stable without its insignificant terms.
    """
    return _has_significant_instability(model, coupling) and not _is_stable_without_insignificant_terms(model, coupling)


def _has_significant_instability(model: Model, coupling: str) -> bool:
    """Whether the real part of an unstable pole exceeds its standard error significantly."""
    try:
        unstable = [mode for mode in modes(model, coupling=coupling) if mode.unstable]
    except FtlmError:
        return True
    # To first order, the real part of an oscillatory pole and the damping have the same ratio to their standard errors.
    # For a real pole, the frequency has this ratio.
    ratios = [
        (mode.damping, mode.damping_error) if mode.oscillatory else (mode.frequency, mode.frequency_error)
        for mode in unstable
    ]
    return not ratios or any(not error or abs(real_part) > GROWTH_SIGMAS * error for real_part, error in ratios)


def _is_stable_without_insignificant_terms(model: Model, coupling: str) -> bool:
    """Whether backward elimination of insignificant output terms leads to a stable model that a Wald test accepts.

    Each elimination moves the remaining parameters to their conditional means. The Wald statistics of the steps add up
    to that of all eliminated terms (Seber & Wild, Nonlinear Regression, section 5.3).
    """
    covariance = covariance_of(model)
    if covariance is None:
        return False
    matrix, values = covariance.copy(), parameter_vector(model)
    at, terms = 0, list[int]()
    for equation in model.equations:
        terms += [at + 2 + 2 * k for k, t in enumerate(equation.terms) if t.column in model.outputs]
        at += 1 + 2 * len(equation.terms)
    variances, statistic = np.diagonal(matrix).copy(), 0.0
    for eliminated in range(1, len(terms) + 1):
        # A coefficient without remaining variance is fixed, or determined by the eliminated ones.
        free = [i for i in terms if matrix[i, i] > MIN_VARIANCE_RATIO * variances[i]]
        if not free:
            return False
        least_significant = min(free, key=lambda i: values[i] ** 2 / matrix[i, i])
        statistic += values[least_significant] ** 2 / matrix[least_significant, least_significant]
        if not statistic <= chi_squared(eliminated, 2.0 * (1.0 - GROWTH_LEVEL)):
            return False
        column = matrix[:, least_significant] / matrix[least_significant, least_significant]
        values, matrix = (
            values - column * values[least_significant],
            matrix - np.outer(column, matrix[least_significant]),
        )
        values[least_significant], matrix[least_significant], matrix[:, least_significant] = 0.0, 0.0, 0.0
        try:
            reduced = with_parameter_vector(model, values)
            excess_count = _excess_pole_count(order_excesses(reduced, coupling=coupling))
            if not reduced.stability(coupling=coupling).unstable_poles > excess_count:
                return True
        except FtlmError:
            return False
    return False


def unstable_poles_text(count: float) -> str:
    """Return the number of poles with a positive real part as text."""
    return f"{int(count)} pole{'s' if count > 1 else ''} with a positive real part"


def enumerate_names(names: Sequence[str]) -> str:
    """Return a list of names as text: up to three names, then the number of the others."""
    items = names if len(names) <= 3 else [*names[:3], f"{len(names) - 3} more"]
    return " and ".join([", ".join(items[:-1]), items[-1]]) if len(items) > 1 else items[0]
