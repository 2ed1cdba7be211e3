"""Verdict on an identified model: a level with its reason, by explicit rules."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from statistics import median
from typing import Any

from markupsafe import Markup
from msgspec.structs import replace

from ftlm.analysis.poles import modes
from ftlm.errors import FtlmError, ModelError
from ftlm.estimation.model_checks import enumerate_names, stability_findings
from ftlm.estimation.result import Identification
from ftlm.findings import LEVEL_DO_NOT_USE, LEVEL_WITH_CARE, Finding, group_findings, make_finding
from ftlm.model.model import Estimate, Model
from ftlm.utils.formatting import format_bound
from ftlm.utils.statistics import NORMAL_95
from ftlm.validation.comparison import MAX_FIT_DROP_POINTS, MAX_NORMALIZED_RESIDUAL, Comparison, Metrics
from ftlm.validation.residual_tests import NEGLIGIBLE_RESIDUAL_RATIO, OutputResiduals

TRUST_LEVEL = "trust"
#: Maximum relative standard error of a well-determined coefficient, and maximum standard error of an order. Half the
#: width of the 95 % interval then equals the coefficient, or the increment 0.5 between orders of common mechanisms.
MAX_COEFFICIENT_ERROR_RATIO, MAX_ORDER_ERROR = 0.5, 0.25
#: Limits of the validation loss (100 minus fit [%]): pairs of the maximum ratio to the estimation loss, and of the loss
#: [%] up to which any ratio is accepted.
VALIDATION_LOSS_LIMITS = ((3.0, 10.0), (5.0, 5.0))
#: Minimum significant difference in fit on a validation run [percentage points].
MIN_FIT_GAIN = 0.5
#: NR below which a model explains a part of an output that consists mostly of noise.
MAX_BURIED_RESIDUAL = 0.99
#: Codes of findings that attribute a poor fit to the data.
POOR_FIT_CODES = ("buried_in_noise", "end_row_far_off")
NOT_SEPARABLE_TOPIC = "not_separable"
#: Codes of findings on validation runs that contain samples to which the model was fitted.
REPEATED_RUN_CODES = ("estimation_run_repeated", "estimation_rows_repeated")
#: Codes of findings on an unstable plant, whose model cannot be validated by simulations of whole runs.
UNSTABLE_PLANT_CODES = ("plant_unstable", "plant_unstable_in_pieces", "plant_needs_pieces")


@dataclass(frozen=True)
class Verdict:
    """Verdict on a model: a level with its reasons.

    Parameters
    ----------
    level
        ``"trust"``, ``"with care"`` or ``"do not use"``.
    reason
        Most serious reason, as a sentence.
    remedy
        Suggested remedy, as a sentence.
    reasons
        All reasons, most serious first; the first is ``reason``.
    """

    level: str
    reason: str
    remedy: str = ""
    reasons: tuple[str, ...] = ()

    @property
    def trusted(self) -> bool:
        """Whether the level is ``"trust"``."""
        return self.level == TRUST_LEVEL

    def __call__(self, validation: Any = None) -> Verdict:
        """Return ``validation.verdict``, or this verdict without a validation.

        So ``result.verdict(v)`` is the same as ``v.verdict``. The validation must belong to the same result; this
        condition is not checked.

        Raises
        ------
        ModelError
            If `validation` is not a result of ``validate(runs)``.
        """
        included = self if validation is None else getattr(validation, "verdict", None)
        if not isinstance(included, Verdict):
            raise ModelError(f"validation is {type(validation).__name__}; give what validate(run) returns")
        return included

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict as a dictionary for JSON."""
        return asdict(self) | {"reasons": list(self.reasons)}

    @property
    def sentence(self) -> str:
        """Reason and remedy as text."""
        return self.reason + (f"; {self.remedy}" if self.remedy else "")

    def __str__(self) -> str:
        return f"{self.level.upper()}: {self.sentence}"


@dataclass(frozen=True)
class Validation(Comparison):
    """Comparison of a model with runs that it was not identified from, and the resulting verdict.

    Parameters
    ----------
    output_error, equation_error, per_run, simulated, measured, step, m, initial, findings, times
        See :class:`ftlm.Comparison`.
    output_samples, offsets, without_equation_error
        See :class:`ftlm.Comparison`.
    verdict
        Verdict on the model after this validation.
    """

    verdict: Verdict = field(kw_only=True)

    def __str__(self) -> str:
        return f"{self.verdict}\n{super().__str__()}"

    def _repr_html_(self) -> str:
        return str(verdict_html(self.verdict)) + super()._repr_html_()


def verdict_html(shown_verdict: Verdict) -> Markup:
    """Return a verdict as an HTML paragraph."""
    return Markup("<p><strong>{}</strong>: {}.</p>").format(shown_verdict.level.capitalize(), shown_verdict.sentence)


def validation_with_verdict(result: Identification, comparison: Comparison) -> Validation:
    """Return a comparison with other runs as a validation, with the verdict from estimation and validation."""
    comparison_fields = {f.name: getattr(comparison, f.name) for f in fields(Comparison)}
    return Validation(**comparison_fields, verdict=verdict(result, comparison))


def verdict(result: Identification, validation: Comparison | None = None) -> Verdict:
    """Return the verdict on a result by the rules of :attr:`ftlm.Identification.verdict`.

    Serious findings that no rule covers follow in the sequence of the topics in ``findings.toml``.
    """
    is_complete = not any(f.code == "runs_split" for f in result.findings)
    unstable = is_complete and any(f.code in UNSTABLE_PLANT_CODES for f in result.findings)
    runs = () if validation is None or unstable else (validation,)
    repeated = validation is not None and any(f.code in REPEATED_RUN_CODES for f in validation.findings)
    has_validation = bool(runs) and not repeated
    overall_verdict = _combined_verdict([*result_findings(result)], result.fit, runs, has_validation, result.method)
    if overall_verdict is not None:
        return overall_verdict
    fits = ", ".join(f"{o} {f.fit:.4g} %" for o, f in (validation or result.comparison).output_error.items())
    residual_text = _describe_residuals(result)
    return Verdict(
        TRUST_LEVEL, f"it predicts validation runs ({fits}), {residual_text}, all parameters are well determined"
    )


def _describe_residuals(result: Identification) -> str:
    """Return text on whether the residuals of a trusted model are noise, colored noise, or negligibly small."""
    outputs = () if result.residuals is None else result.residuals.outputs.values()
    if any(not r.is_noise for r in outputs):
        return f"residuals are below {100 * NEGLIGIBLE_RESIDUAL_RATIO:g} % of the output where they are not noise"
    colored = any(not r.whiteness.passed for r in outputs)
    return "residuals are noise with a color" if colored else "residuals are noise"


def _combined_verdict(
    model_findings: Sequence[Finding],
    estimation_fits: Mapping[str, float],
    runs: Sequence[Comparison],
    has_validation: bool,
    method: str = "",
) -> Verdict | None:
    """Return the verdict from findings on a fit (`model_findings`) and comparisons with validation runs (`runs`).

    None if no finding is a warning. `method` is the name of the estimation method.
    """
    reported_outputs = [f.output for f in model_findings if f.code in POOR_FIT_CODES]
    findings = [f for comparison in runs for f in _poor_fits("the validation run of ", comparison, reported_outputs)]
    findings += [f for comparison in runs for f in _validation_losses(estimation_fits, comparison)]
    # A remedy must not suggest the method that was used.
    findings = [replace(f, method=method) for f in findings]
    severe = [f for f in model_findings if f.level == LEVEL_DO_NOT_USE]
    # Findings of the fit name what is missing more precisely.
    input_following = [f for comparison in runs for f in comparison.findings if f.code == "validation_follows_input"]
    input_following += [] if has_validation else [make_finding("not_validated")]
    return verdict_from([*severe, *findings, *model_findings, *input_following])


def verdict_from(findings: Iterable[Finding]) -> Verdict | None:
    """Return the verdict whose reason is the most serious of some findings; None if no finding is a warning."""
    all_findings = list(findings)
    relevant = [f for level in (LEVEL_DO_NOT_USE, LEVEL_WITH_CARE) for f in all_findings if f.level == level]
    if not relevant:
        return None
    return Verdict(
        relevant[0].level, relevant[0].reason, relevant[0].remedy, tuple(dict.fromkeys(f.reason for f in relevant))
    )


def saved_verdict(model: Model, validation: Sequence[Comparison]) -> Verdict:
    """Return the verdict on a model read from a file, from its stored findings and comparisons with runs."""
    estimate = model.estimate
    plant = estimate is not None and any(f.code in UNSTABLE_PLANT_CODES for f in estimate.findings)
    unstable = plant and estimate is not None and estimate.piece_duration is None
    model_findings = [] if unstable else [*_unstable_poles(model)]
    validation = () if unstable else validation
    if estimate is None:
        model_findings.append(make_finding("origin_unknown"))
        overall_verdict = _combined_verdict(model_findings, {}, validation, True)
    else:
        model_findings += saved_findings(estimate)
        estimation_fits = {n: f for n, f in estimate.fit.items() if f is not None}
        is_repeated = any(name in estimate.runs for c in validation for name, _, _ in c.per_run)
        is_validated = bool(validation) and not is_repeated
        overall_verdict = _combined_verdict(model_findings, estimation_fits, validation, is_validated, estimate.method)
    if overall_verdict is not None:
        return overall_verdict
    fits = ", ".join(f"{o} {f.fit:.4g} %" for c in validation for o, f in c.output_error.items())
    return Verdict(TRUST_LEVEL, f"it predicts validation runs ({fits}), with no finding against its fit")


def saved_findings(estimate: Estimate) -> list[Finding]:
    """Return the stored findings against a model, plus one on unidentifiable parameters if none reports them."""
    findings = list(estimate.verdict_findings)
    unidentifiable = [n for n, e in estimate.standard_errors.items() if e is None]
    if unidentifiable and not any(f.kind.topic == NOT_SEPARABLE_TOPIC for f in findings):
        findings.append(
            make_finding(
                "not_separately_identifiable",
                parameter=", ".join(unidentifiable),
                shown=enumerate_names(unidentifiable),
            )
        )
    return findings


def result_findings(result: Identification) -> Iterator[Finding]:
    """Yield the findings that lower the verdict on a result that is not validated, most important first."""
    for finding in _against_result(result):
        yield replace(finding, method=result.method)


def _against_result(result: Identification) -> Iterator[Finding]:
    codes = {f.code for f in result.findings}
    yield from _simulation_findings(result)
    errors, joint = result.standard_errors, result.joint
    yield from (f for f in result.findings if f.code == "simulation_chaotic")
    unidentifiable = [n for n, e in errors.items() if not math.isfinite(e)]
    if unidentifiable and "simulation_chaotic" not in codes:
        yield make_finding(
            "not_separately_identifiable", parameter=", ".join(unidentifiable), shown=enumerate_names(unidentifiable)
        )
    yield from (f for f in result.findings if f.code == "equation_says_identity")
    yield from (f for f in result.findings if f.kind.names_missing_part)
    yield from _residual_findings(result)
    if joint is not None and not joint.converged and "not_converged" not in codes:
        yield make_finding("not_converged")
    uncertain = [n for n in errors if n not in unidentifiable and _is_uncertain(result, n)]
    if uncertain:
        text = enumerate_names([_format_uncertain(result, n) for n in uncertain])
        yield make_finding("parameter_imprecise", parameter=", ".join(uncertain), shown=text)
    unbounded = [n for n, p in result.profiles.items() if _is_of_input(result, n) and math.isinf(p.high)]
    if unbounded:
        yield make_finding("interval_open", parameter=enumerate_names(unbounded), sides=", ".join(unbounded))
    runs = zip(result.comparison.offsets, result.comparison.initial, strict=False)
    outputs = dict.fromkeys(o for offsets, initial in runs for o in offsets if not offsets[o] and initial[o])
    if outputs:
        yield make_finding("offset_hidden", output=", ".join(outputs), shown=enumerate_names(list(outputs)))
    for group in group_findings(result.findings):
        if not group.first_finding.topic.has_rule and group.first_finding.level in (
            LEVEL_DO_NOT_USE,
            LEVEL_WITH_CARE,
        ):
            yield group.first_finding
    if not errors:
        yield make_finding("no_standard_errors")


def _simulation_findings(result: Identification) -> Iterator[Finding]:
    """Yield findings about the simulation: overflow, instability, poor fit, unstable plant."""
    plant = [f for f in result.findings if f.code in UNSTABLE_PLANT_CODES]
    yield from plant
    if plant and plant[0].code != "plant_needs_pieces":
        return
    outputs = [o for o, f in result.output_error.items() if not math.isfinite(f.nr)]
    if outputs:
        yield make_finding("out_of_range", output=", ".join(outputs))
    yield from _unstable_poles(result.model)
    reported = [f for f in result.findings if f.code in POOR_FIT_CODES]
    yield from _poor_fits("", result.comparison, [f.output for f in reported])
    yield from reported


def _unstable_poles(model: Model) -> Iterator[Finding]:
    """Yield findings about unstable poles and undamped modes; none for a non-linear model.

    A pole at the origin is an integrator, which is common in machines and gives no finding.
    """
    if not model.structure.is_linear:
        return
    growth = stability_findings(model)
    yield from growth
    if math.isnan(model.stability(coupling=model.structure.coupling).unstable_poles):
        yield make_finding("stability_unknown")
    elif not any(f.code == "simulation_unbounded" for f in growth):
        with contextlib.suppress(FtlmError):
            yield from _undamped_modes(model)


def _undamped_modes(model: Model) -> Iterator[Finding]:
    """Yield a finding about the slowest oscillatory mode whose damping is not significantly positive, if any."""
    for mode in modes(model, coupling=model.structure.coupling):
        if mode.oscillatory and mode.damping - NORMAL_95 * (mode.damping_error or 0.0) <= 0.0:
            error_text = "" if mode.damping_error is None else f" ± {mode.damping_error:.2g}"
            yield make_finding(
                "oscillation_may_not_decay", frequency=mode.frequency, damping=mode.damping, spread=error_text
            )
            return


def is_degenerate(result: Identification) -> bool:
    """Whether the verdict on a fit is "do not use" without validation, so that comparisons with it are meaningless."""
    return result.verdict.level == LEVEL_DO_NOT_USE


def have_common_value(intervals: Any) -> bool:
    """Whether all intervals (low, high) have a value in common."""
    all_intervals = list(intervals)
    return not all_intervals or max(low for low, _ in all_intervals) <= min(high for _, high in all_intervals)


def improves_prediction(
    gains: Sequence[float],
    intervals: Mapping[str, Mapping[str, tuple[float, float]]],
    integer_orders: Mapping[str, float],
) -> bool | None:
    """Whether fractional orders improve the prediction of other runs; None if the test is inconclusive.

    `gains` are the increases of the fit on validation runs [percentage points], `intervals` the confidence intervals of
    orders by name and run, and `integer_orders` the integer orders by name.

    True if every estimation run excludes an integer order, the intervals of the runs overlap, no gain is significantly
    negative, and the median gain is significant. False if no gain is significant, or if no run excludes an integer
    order and the median gain is not significant. Otherwise None.
    """
    runs = list(next(iter(intervals.values()), {}))
    is_outside = [any(not e[r][0] <= integer_orders[n] <= e[r][1] for n, e in intervals.items()) for r in runs]
    counts = median(gains) >= MIN_FIT_GAIN
    if (
        all(is_outside)
        and counts
        and min(gains) > -MIN_FIT_GAIN
        and all(have_common_value(e.values()) for e in intervals.values())
    ):
        return True
    if max(gains) < MIN_FIT_GAIN or (not any(is_outside) and not counts):
        return False
    return None


def is_buried(residuals: OutputResiduals) -> bool:
    """Whether the residuals of an output are white and uncorrelated with the inputs, so that only noise remains.

    The model must also explain a part of the output, because a zero model of pure noise passes both tests.
    """
    conclusive_tests = [t for t in residuals.informative_tests.values() if t.conclusive]
    is_explained = residuals.nr < MAX_BURIED_RESIDUAL
    return (
        is_explained
        and residuals.whiteness.passed
        and bool(conclusive_tests)
        and all(t.passed for t in conclusive_tests)
    )


def _poor_fits(location: str, comparison: Comparison, reported_outputs: Sequence[str] = ()) -> Iterator[Finding]:
    """Yield a finding on the outputs whose NR exceeds `MAX_NORMALIZED_RESIDUAL` over all runs, or else in one run.

    If no output exceeds the limit over all runs, each run is tested by itself, because runs with large signals dominate
    the total. NR is the normalized residual. `reported_outputs` are outputs that are not tested.
    """
    for run, errors in _errors_by_run(comparison):
        poor_outputs = [
            o for o, f in errors.items() if not f.nr <= MAX_NORMALIZED_RESIDUAL and o not in reported_outputs
        ]
        if poor_outputs:
            text = ", ".join(f"{o} (fit {errors[o].fit:.3g} %{_on(run)})" for o in poor_outputs)
            yield make_finding("poor_fit", run=run, output=", ".join(poor_outputs), where=location, shown=text)
            return


def _errors_by_run(comparison: Comparison) -> Iterator[tuple[str, Mapping[str, Metrics]]]:
    """Yield ("", output error over all runs), then (name, output error) of each run if there are several."""
    yield "", comparison.output_error
    if len(comparison.per_run) > 1:
        for name, _, errors in comparison.per_run:
            yield name, errors


def _on(run: str) -> str:
    return f" on {run}" if run else ""


def _validation_losses(estimation_fits: Mapping[str, float], validation: Comparison) -> Iterator[Finding]:
    """Yield one finding for each output whose fit on validation runs is far below its fit on estimation runs."""
    found_outputs: set[str] = set()
    for run, errors in _errors_by_run(validation):
        for output, figures in errors.items():
            if output not in estimation_fits or output in found_outputs:
                continue
            misfit, estimation_misfit = 100.0 - figures.fit, 100.0 - estimation_fits[output]
            if not (
                misfit <= estimation_misfit + MAX_FIT_DROP_POINTS
                and all(
                    misfit <= times * estimation_misfit or misfit <= small_misfit
                    for times, small_misfit in VALIDATION_LOSS_LIMITS
                )
            ):
                details = {"before": estimation_fits[output], "after": figures.fit, "where": _on(run)}
                yield make_finding("fit_falls", run=run, output=output, **details)
                found_outputs.add(output)


def _residual_findings(result: Identification) -> Iterator[Finding]:
    """Yield findings on failed residual tests: correlation with an input, feedback, color."""
    if result.residuals is None:
        if not any(f.code == "plant_unstable_in_pieces" for f in result.findings):
            yield make_finding("too_short_for_tests")
        return
    has_loop_model = has_loop_noise_model(result.settings)
    outputs = {o: r for o, r in result.residuals.outputs.items() if not r.nr <= NEGLIGIBLE_RESIDUAL_RATIO}
    # Residuals of an incomplete model under a periodic input resemble feedback, so missing terms come first.
    coupled = [f for f in result.findings if f.code == "coupling_missing" and f.output in outputs]
    missing_couplings = {(f.output, f.input) for f in coupled}
    signals_by_output = {
        o: [s for s, t in r.informative_tests.items() if t.failed and (o, s) not in missing_couplings]
        for o, r in outputs.items()
    }
    signals_by_output = {o: signals for o, signals in signals_by_output.items() if signals}
    if signals_by_output:
        text = ", ".join(f"{o} with {enumerate_names(signals)}" for o, signals in signals_by_output.items())
        signals = ", ".join(dict.fromkeys(s for output_signals in signals_by_output.values() for s in output_signals))
        yield make_finding("residuals_follow_input", output=", ".join(signals_by_output), input=signals, shown=text)
    yield from coupled
    yield from (f for f in result.findings if f.code == "residuals_follow_direction" and f.output in outputs)
    yield from (f for f in result.findings if f.code == "loop_found" and f.output in outputs)
    # Such a fit is consistent under colored noise, so color alone is no finding.
    colored_outputs = (
        [] if has_loop_model else [o for o, r in outputs.items() if not (r.whiteness.passed or r.is_noise)]
    )
    for name in colored_outputs:
        code = "color_undecided" if outputs[name].is_undecided else "residuals_not_white"
        yield make_finding(code, output=name)


def has_loop_noise_model(settings: Mapping[str, Any]) -> bool:
    """Whether a fit is consistent in a closed loop, because it used a reference signal or a noise model."""
    return "reference" in settings or "noise_model" in settings


def _is_uncertain(result: Identification, name: str) -> bool:
    """Whether an order or a coefficient is poorly determined, by its profile-likelihood interval if available."""
    error = result.standard_errors[name]
    coefficients = {**result.coefficients, **({} if result.joint is None else result.joint.coefficients)}
    if name in result.orders:
        return error > MAX_ORDER_ERROR or (name in result.profiles and math.isinf(result.profiles[name].high))
    if name not in coefficients:
        # A delay, saturation or dead zone may be 0.
        return False
    if name in result.profiles:
        interval = result.profiles[name]
        return interval.is_open or 0.0 in interval
    return error > MAX_COEFFICIENT_ERROR_RATIO * abs(coefficients[name])


def _is_of_input(result: Identification, name: str) -> bool:
    """Whether a parameter is a delay, a saturation or a dead zone of an input."""
    structure = result.model.structure
    return name in {f"delay_{s}" for s in structure.delay} | {limit.name for limit in structure.limits}


def _format_uncertain(result: Identification, name: str) -> str:
    return f"{name} = {result.parameters[name].value:.3g} ± {format_bound(result.standard_errors[name], '.2g')}"
