"""Selection of the initial conditions of a fit, and of its offset: an output level or a constant in the equation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np

from ftlm.data.run import Run
from ftlm.data.sampling import drop_missing
from ftlm.errors import FtlmError, ModelError
from ftlm.estimation.extensions import undetermined_start_findings
from ftlm.estimation.fit import Fit
from ftlm.estimation.nuisance_parameters import (
    DEFAULT_PULSES_PER_SAMPLE,
    OffsetTest,
    constant_input,
    fit_score,
    fit_score_gain,
    fit_without_history,
    fits_better,
    has_colored_residuals,
    has_independent_residuals,
    has_white_residuals,
    offset_test,
    refit_after_screening,
    unrequested_offset_findings,
)
from ftlm.estimation.output_error import JointFit
from ftlm.findings import Finding, make_finding
from ftlm.simulation.initial_conditions import START_SETTINGS, conditions_in_motion, has_memory, rest_evidence
from ftlm.structure.structure import History, Initial, Offset, Structure
from ftlm.validation.residual_tests import NEGLIGIBLE_RESIDUAL_RATIO

#: Initial conditions that are tried together with an output level.
INITIAL_CONDITIONS_WITH_LEVEL: tuple[Literal["rest"], Literal["caputo"]] = ("rest", "caputo")
#: Minimum ratio of the mean of an output to its standard deviation that suggests a level.
MIN_LEVEL_MEAN_RATIO = 3.0
#: Minimum ratio of the RMS residual to the standard deviation of an output that suggests a level.
MIN_LEVEL_RESIDUAL_RATIO = 0.5
#: Maximum difference of the information criteria of two fits that explain the runs alike (Kass and Raftery 1995).
MAX_EQUIVALENT_SCORE_DIFFERENCE = 2.0
#: Ratio of a standard error to its value above which a parameter counts as not identifiable. It is due to collinear
#: sensitivities, whose covariance consists of rounding errors.
MAX_RELATIVE_STANDARD_ERROR = 1e6
#: Maximum number of samples with which an offset is tested without request: the test stores a sensitivity of each
#: parameter at every sample.
MAX_OFFSET_TEST_SAMPLES = 400_000


def fit_with_offset_decision(
    runs: Sequence[Run], structure: Structure, estimate: Callable[[Structure], Fit], fits: InitialConditionFits
) -> Fit:
    """Return the fit of a structure, and decide on its initial conditions and its offset.

    With ``offset="auto"``, the function `estimate` fits the structure with a constant in each equation, and without it
    if it is not significant. A fit that lacks a necessary constant may end at a wrong optimum. For a non-linear model,
    fits without offset, with a constant and with an output level are compared. With every other offset, the functions
    in `fits` fit the structure as given.
    """
    if structure.offset == "auto" and not structure.is_linear:
        fit = _fit_with_start_decision(replace(structure, offset="none"), replace(fits, may_add_offset=True))
        decision = f"{fit.task.structure.offset}: no offset, a constant and a level were compared by their fits"
        return _with_offset_decision(fit, decision)
    if structure.offset != "auto":
        fit = _fit_with_start_decision(structure, fits)
        if structure.initial != "auto" or structure.offset != "none":
            return fit
        return replace(fit, findings=[*fit.findings, *undetermined_start_findings(fit, fits.joint_fits)])
    try:
        request = replace(structure, offset="constant")
    except ModelError as error:
        # The response to the constant is collinear with an initial term of the user: both have the same power of t.
        return _with_offset_decision(estimate(replace(structure, offset="none")), f"none: {error}")
    constant_name = constant_input(runs, structure)
    if constant_name is not None:
        decision_text = (
            f"none: {constant_name} is constant on every run, from which an offset is not separately identifiable"
        )
        return _with_offset_decision(estimate(replace(structure, offset="none")), decision_text)
    fit = estimate(request)
    if fit.task.structure.offset == "level":
        return _with_offset_decision(fit, "level: the runs rest at their own level before an input moves")
    test = fit_offset_test(fit)
    if test is not None and test.exceeds():
        return _with_offset_decision(fit, test.decision)
    decision = "none: the simulation of its test is not finite" if test is None else test.decision
    return _with_offset_decision(estimate(replace(structure, offset="none")), decision)


@dataclass(frozen=True)
class InitialConditionFits:
    """Functions that fit one structure under several initial conditions, and the last joint fit under each.

    A joint fit estimates the parameters of all equations from all runs at once (output error).

    Parameters
    ----------
    estimate
        Function that fits a structure.
    may_add_offset
        Whether a level or a constant may be added; False if the user gave an offset.
    complete_fit
        Function that adds all confidence intervals to a joint fit of a structure; None if :attr:`estimate` already
        gives them.
    joint_fits
        Last joint fit of each pair of initial conditions and offset.
    """

    estimate: Callable[[Structure], Fit]
    may_add_offset: bool
    complete_fit: Callable[[Structure, JointFit | None], Fit] | None = None
    joint_fits: dict[tuple[Initial, Offset], JointFit] = field(default_factory=dict)

    def fit(self, structure: Structure) -> Fit:
        """Return the fit of a structure from automatic initial guesses."""
        fit = self.estimate(structure)
        if fit.joint is not None:
            self.joint_fits[fit.joint.initial, structure.offset] = fit.joint
        return fit

    def with_intervals(self, structure: Structure, fit: Fit) -> Fit:
        """Return the chosen fit with all requested confidence intervals."""
        return fit if self.complete_fit is None else self.complete_fit(structure, fit.joint)

    def refit(self, structure: Structure, fit: Fit, accepts: Callable[[JointFit], bool]) -> Fit | None:
        """Return a fit of a structure whose initial conditions differ from those of `fit`; None if not accepted.

        The new fit starts from the optimum of `fit` if `fit` has a joint fit and :attr:`complete_fit` is given,
        otherwise from automatic initial guesses. The function `accepts` decides from the new joint fit whether it is
        accepted.
        """
        joint, runs = fit.joint, fit.task.runs
        if joint is None or self.complete_fit is None:
            refit = self.fit(structure)
            return refit if refit.joint is not None and accepts(refit.joint) else None
        request = replace(fit.task.structure, initial=structure.initial, offset=structure.offset)
        refit_joint = refit_after_screening(joint, runs, request, accepts)
        if refit_joint is None:
            return None
        self.joint_fits[refit_joint.initial, request.offset] = refit_joint
        return (
            None
            if not accepts(refit_joint)
            else replace(fit, joint=replace(refit_joint, starts=joint.starts, origin=joint.origin))
        )


def _fit_with_start_decision(structure: Structure, fits: InitialConditionFits) -> Fit:
    """Return the fit of a structure, with a constant, nonzero initial conditions or levels if they are significant."""
    fit = fits.fit(structure)
    if not structure.is_linear:
        return _fit_nonlinear(fit, structure, fits)
    constant = _fit_with_offset(fit, structure, fits)
    if constant is not None:
        return constant
    restart = _fit_if_rest_rejected(fit, structure, fits)
    if restart is not None:
        return restart
    if fit.task.structure.offset != "none":
        return fits.with_intervals(structure, fit)
    suggests_level = _suggests_level(fit)
    is_level_tried = suggests_level or _may_hide_level(fit)
    level = _fit_with_level(fit, structure, fits, is_suggested=suggests_level) if is_level_tried else None
    if level is not None:
        return level
    test = fit_offset_test(fit) if sum(run.length for run in fit.task.runs) <= MAX_OFFSET_TEST_SAMPLES else None
    offset_findings = unrequested_offset_findings(test, fit.model.outputs) or _history_offset_findings(fit)
    if offset_findings and not is_level_tried and fit.task.structure.initial == "auto" and not _has_quiet_samples(fit):
        level = _fit_with_level(fit, structure, fits, is_suggested=False)
        if level is not None:
            return level
    fit = fits.with_intervals(structure, fit)
    return replace(fit, findings=[*fit.findings, *offset_findings])


def _fit_nonlinear(fit: Fit, structure: Structure, fits: InitialConditionFits) -> Fit:
    """Return the fit of a non-linear structure, with initial values, a constant or a level if they are significant.

    All of them are compared by their fits, because the test of an offset assumes a linear model, and a constant also
    moves the equilibrium of a non-linear one. Nothing is compared if residuals are white, with one exception: if all
    inputs are constant from the second sample on, initial values and a level may explain the runs alike. The plant is
    then assumed to have been at rest at a level, as for a linear structure, and a finding states this assumption.
    """
    is_automatic = structure.initial == "auto" and structure.offset == "none"
    if fit.joint is None or not is_automatic or fit.task.structure.offset != "none":
        return fits.with_intervals(structure, fit)
    if _is_rest_assumed(fit) and fit.joint.initial != "rest":
        level = _fit_with_level(fit, structure, fits, is_suggested=True)
        if level is not None:
            return level
    if has_white_residuals(fit.joint):
        return fits.with_intervals(structure, fit)
    best_structure, best_fit = structure, fit
    if fit.joint.initial == "rest" and not _has_quiet_samples(fit):
        request = replace(structure, initial=conditions_in_motion(structure))
        fit_in_motion = _preferred_fit(request, fit.joint, fits) if _improves_nearby(request, fit, fits) else None
        if fit_in_motion is not None:
            best_structure, best_fit = request, fit_in_motion
    if fits.may_add_offset and not (best_fit.joint is not None and has_white_residuals(best_fit.joint)):
        with_offset, best_fit = _fit_nonlinear_with_offset(best_fit, structure, fits)
        if with_offset is not None:
            return with_offset
    complete_fit = fits.with_intervals(best_structure, best_fit)
    if best_structure is structure:
        return complete_fit
    return _with_start_findings(complete_fit, structure, is_rest_rejected=True)


def _preferred_fit(request: Structure, joint: JointFit, fits: InitialConditionFits) -> Fit | None:
    """Return the fit of a non-linear structure from automatic guesses; None if it is not clearly better than `joint`.

    A non-linear structure has several optima, so that a slightly lower criterion is no evidence of further terms.
    """
    try:
        candidate = fits.fit(request)
    except FtlmError:
        return None
    if candidate.joint is None or candidate.joint.unstable_optimum is not None:
        return None
    return candidate if fits_better(candidate.joint, joint, -START_SETTINGS.history_margin) else None


def _fit_nonlinear_with_offset(fit: Fit, structure: Structure, fits: InitialConditionFits) -> tuple[Fit | None, Fit]:
    """Return the fit of a non-linear structure with a significant constant or level, or None, and the fit without.

    The fit without offset is that of `fit`, or a better one from the optimum with an offset.
    """
    constant, request = None, replace(structure, offset="constant")
    if fit.joint is None:
        return None, fit
    has_constant_input = constant_input(fit.task.runs, structure) is not None
    offsets: list[Offset] = ["level"] if has_constant_input else ["constant", "level"]
    nearby = [replace(structure, initial=fit.joint.initial, offset=offset) for offset in offsets]
    if not any(_improves_nearby(offset_request, fit, fits) for offset_request in nearby):
        return None, fit
    if not has_constant_input:
        constant = _preferred_fit(request, fit.joint, fits)
    if constant is not None:
        fit, is_significant = _compare_with_offset(fit, constant, structure, fits)
        constant = constant if is_significant else None
    level = _fit_with_level(fit if constant is None else constant, structure, fits, is_suggested=True)
    if level is not None:
        fit, is_significant = _compare_with_offset(fit, level, structure, fits)
        if is_significant:
            return level, fit
    if constant is None:
        return None, fit
    return _with_constant_finding(fits.with_intervals(request, constant)), fit


def _improves_nearby(request: Structure, fit: Fit, fits: InitialConditionFits) -> bool:
    """Whether other initial conditions or an offset clearly improve a non-linear fit near its optimum.

    If they are missing, they improve the fit near any optimum, so that automatic initial guesses can wait for this.
    """
    if fit.joint is None or fits.complete_fit is None:
        return True
    is_better = partial(fits_better, other=fit.joint, margin=-START_SETTINGS.history_margin)
    try:
        return fits.refit(request, fit, is_better) is not None
    except FtlmError:
        return False


def _compare_with_offset(
    fit: Fit, with_offset: Fit, structure: Structure, fits: InitialConditionFits
) -> tuple[Fit, bool]:
    """Return the best fit without offset, and whether the offset of `with_offset` is identifiable and significant.

    An offset and friction may compensate each other, so that a fit with an offset may end near an optimum without it
    that all initial guesses of `fit` missed.
    """
    if fit.joint is None or with_offset.joint is None:
        return fit, False
    without_offset = replace(structure, initial=fit.joint.initial)
    try:
        nearby_fit = fits.refit(without_offset, with_offset, partial(fits_better, other=fit.joint))
    except FtlmError:
        nearby_fit = None
    best_fit = nearby_fit or fit
    assert best_fit.joint is not None
    is_better = fits_better(with_offset.joint, best_fit.joint, -START_SETTINGS.history_margin)
    return best_fit, is_better and _is_identifiable(with_offset.joint)


def _is_identifiable(joint: JointFit) -> bool:
    """Whether the runs determine every parameter: no sensitivity is collinear with the others within rounding."""
    errors, values = joint.standard_errors, joint.values_by_name
    limits = {n: MAX_RELATIVE_STANDARD_ERROR * abs(values[n]) if values[n] else math.inf for n in joint.names}
    return all(math.isfinite(errors[n]) and errors[n] <= limits[n] for n in joint.names)


def _fit_with_offset(fit: Fit, structure: Structure, fits: InitialConditionFits) -> Fit | None:
    """Return the fit of an integrating linear plant with a constant; None if the constant is not significant.

    For other linear plants, the result is None, because a level suffices and is tried later. A level cannot describe
    the response of an integrating plant to the offset of an input sensor. The new fit starts from its own initial
    guesses, because the fit without a constant may be at a wrong local optimum.
    """
    automatic = structure.initial == "auto" and structure.offset == "none" and fits.may_add_offset
    if fit.joint is None or not automatic or fit.task.structure.offset != "none":
        return None
    level_suffices = not structure.integrates
    if level_suffices or has_white_residuals(fit.joint) or constant_input(fit.task.runs, structure) is not None:
        return None

    def is_better(candidate: JointFit, *, joint: JointFit = fit.joint) -> bool:
        return fits_better(candidate, joint)

    request = replace(structure, offset="constant")
    try:
        has_history = isinstance(fit.joint.initial, History)
        if fits.complete_fit is not None and not has_history:
            # A missing constant improves the fit near any optimum, so that automatic initial guesses can wait for this.
            # With a history, the constant may replace its powers of t instead.
            nearby = replace(request, initial=fit.joint.initial)
            if fits.refit(nearby, fit, is_better) is None:
                return None
        candidate = fits.fit(request)
    except FtlmError:
        return None
    joint = candidate.joint
    if joint is None or joint.unstable_optimum is not None or not is_better(joint):
        return None
    complete_fit = _fit_if_rest_rejected(candidate, request, fits) or fits.with_intervals(request, candidate)
    has_constant = complete_fit.task.structure.offset != "none"
    return _with_constant_finding(complete_fit) if has_constant else complete_fit


def _with_constant_finding(fit: Fit) -> Fit:
    """Return a fit with a constant in its equations, and the finding that reports it."""
    context = {"run": ", ".join(r.name for r in fit.task.runs), "output": ", ".join(fit.model.outputs)}
    return replace(fit, findings=[*fit.findings, make_finding("constant_estimated", **context)])


def _fit_if_rest_rejected(fit: Fit, structure: Structure, fits: InitialConditionFits) -> Fit | None:
    """Return a fit with nonzero initial conditions or a level if residuals contradict a start from rest, else None.

    A level is a constant that is added to the output. Rest is kept if the residuals are white. If they are colored
    without a slow component, the new fit is accepted only if its own residuals are white or no dynamics are missing: in
    a run that has no constant samples before its first input change, the residuals are independent of the inputs.

    Both fits are compared by an information criterion with one noise color. It is that of the new fit if no dynamics
    are missing. Otherwise it is that of the fit from rest: residuals due to missing dynamics then count as noise, which
    initial conditions are not meant to explain. It is also that of the fit from rest if a run has constant samples
    before its first input change, in which a level is visible.
    """
    joint, runs = fit.joint, fit.task.runs
    automatic = structure.initial == "auto" and structure.is_linear
    if joint is None or not automatic or joint.initial != "rest":
        return None
    is_colored = has_colored_residuals(joint)
    if not is_colored and has_white_residuals(joint):
        return None
    evidence = [rest_evidence(run, structure) for run in runs]
    if any(item is not None and item.rows == 0 for item in evidence):
        # A constant input gives no evidence of rest.
        return None
    is_quiet, lowest_score, candidate = _has_quiet_samples(fit), math.inf, None
    starts: list[tuple[Initial, Offset]] = [("caputo", structure.offset)]
    if structure.offset == "none" and fits.may_add_offset:
        starts.insert(0, ("caputo", "level"))
        if not is_quiet:
            starts.append(("rest", "level"))

    def is_complete(candidate: JointFit) -> bool:
        return not is_quiet and has_independent_residuals(candidate, runs, structure)

    for k, (initial, offset) in enumerate(starts):
        request = replace(structure, initial=initial, offset=offset)

        def is_better(candidate: JointFit, *, lowest_score: float = lowest_score) -> bool:
            gain = fit_score_gain(candidate, joint, candidate if is_complete(candidate) else joint)
            return gain > START_SETTINGS.history_margin and fit_score(candidate, joint) < lowest_score

        # The optimum from rest may be far from that of the most general start. With integer orders, automatic guesses
        # cost little.
        is_new_fit = k == 0 and not has_memory(structure)
        previous_fit = fit if candidate is None else candidate[1]
        try:
            alternative = fits.fit(request) if is_new_fit else fits.refit(request, previous_fit, is_better)
        except FtlmError:
            continue
        if alternative is None or alternative.joint is None or alternative.joint.unstable_optimum is not None:
            continue
        if not is_better(alternative.joint):
            continue
        if is_colored or has_white_residuals(alternative.joint) or is_complete(alternative.joint):
            lowest_score, candidate = fit_score(alternative.joint, joint), (request, alternative)
    if candidate is None:
        return None
    if structure.offset == "constant" and fits.may_add_offset:
        candidate = _without_insignificant_constant(*candidate, fits)
    return _with_start_findings(fits.with_intervals(*candidate), structure, is_rest_rejected=True)


def _without_insignificant_constant(
    structure: Structure, fit: Fit, fits: InitialConditionFits
) -> tuple[Structure, Fit]:
    """Return a structure and its fit, both without the constant if it does not lower the information criterion.

    A constant that improves a fit from rest may only stand for initial conditions.
    """
    joint, request = fit.joint, replace(structure, offset="none")

    def is_sufficient(candidate: JointFit) -> bool:
        return joint is not None and not fits_better(joint, candidate)

    try:
        candidate = fits.refit(request, fit, is_sufficient)
    except FtlmError:
        return structure, fit
    if candidate is None or candidate.joint is None or candidate.joint.unstable_optimum is not None:
        return structure, fit
    return request, candidate


def _fit_with_level(fit: Fit, structure: Structure, fits: InitialConditionFits, *, is_suggested: bool) -> Fit | None:
    """Return the best fit with a level added to each output, from rest or in motion; None if no level is preferred.

    Both information criteria that are compared use the noise spectrum of the fit with the larger residuals. If
    `is_suggested` is True, the optimum may be far away, so automatic initial guesses are used. They are also used for
    integer orders, for which they cost little. Otherwise the fit starts from the optimum without a level. With
    automatic guesses, the fit in motion starts from the fit at rest only if the residuals of the latter are white,
    because its optimum may be as far away otherwise.
    """
    if fit.joint is None or not fits.may_add_offset:
        return None
    best = fit.joint
    candidate: tuple[Structure, Fit] | None = None
    is_rest_assumed = not structure.is_linear and _is_rest_assumed(fit)
    margin = START_SETTINGS.history_margin if isinstance(best.initial, History) else 0.0
    if not structure.is_linear and fit.task.structure.offset == "none":
        # A non-linear structure has several optima, so that a slightly lower criterion is no evidence of a level.
        margin = MAX_EQUIVALENT_SCORE_DIFFERENCE if is_rest_assumed else -START_SETTINGS.history_margin

    def is_preferred(joint: JointFit) -> bool:
        return fits_better(joint, best, margin)

    # Initial values without a level were rejected before, or quiet samples show rest.
    for initial in INITIAL_CONDITIONS_WITH_LEVEL[: 1 if best.initial == "rest" or is_rest_assumed else None]:
        request = replace(structure, initial=initial, offset="level")
        try:
            # With integer orders, automatic guesses cost little and lead to the best optimum.
            is_near = candidate is not None and has_white_residuals(best)
            is_new_fit = not is_near and (is_suggested or not has_memory(structure))
            previous_fit = fit if candidate is None else candidate[1]
            level = fits.fit(request) if is_new_fit else fits.refit(request, previous_fit, is_preferred)
            if level is not None and level.joint is not None and not (is_new_fit or level.joint.converged):
                # There is no optimum under these initial conditions near the optimum under the others.
                level = fits.fit(request)
        except FtlmError:
            continue
        if level is not None and level.joint is not None and is_preferred(level.joint):
            best, candidate, margin = level.joint, (request, level), 0.0
            if not structure.is_linear and has_white_residuals(best):
                # Nothing is left that motion could explain, and a fit of a non-linear structure takes long.
                break
    if candidate is None:
        return None
    return _with_start_findings(fits.with_intervals(*candidate), structure, is_rest_rejected=False)


def _with_start_findings(fit: Fit, structure: Structure, *, is_rest_rejected: bool) -> Fit:
    """Return a fit whose initial conditions differ from the first choice, with findings that report them.

    Other runs may start differently, so the model is reset to the requested initial conditions of `structure`. If a
    start from rest was rejected in favor of other initial conditions, the model keeps those of the fit, because a
    comparison with the same runs would choose rest again.
    """
    initial = None if fit.joint is None else fit.joint.initial
    names = ", ".join(run.name for run in fit.task.runs)
    findings = [*fit.findings]
    if is_rest_rejected and initial != "rest":
        findings.append(make_finding("rest_rejected", run=names))
    if fit.task.structure.offset == "level" and structure.offset != "level":
        # Initial terms are no evidence of motion: a plant may rest at the equilibrium of a constant input.
        start = "at rest" if initial == "rest" else "with estimated initial terms"
        findings.append(make_finding("level_estimated", run=names, output=", ".join(fit.model.outputs), start=start))
    if is_rest_rejected and initial != "rest":
        return replace(fit, findings=findings)
    model = replace(fit.model, structure=replace(fit.model.structure, initial=structure.initial))
    return replace(fit, model=model, findings=findings)


def _suggests_level(fit: Fit) -> bool:
    """Whether a level of an output is so likely that it is fitted from automatic initial guesses.

    This holds if initial conditions were estimated, and the mean or the residuals of an output are large relative to
    its standard deviation. The optimum with a level may then be far away.
    """
    joint = fit.joint
    if joint is None or not _has_estimated_initial_conditions(fit):
        return False
    for output, noise in joint.noise.items():
        values = [drop_missing(run[output]) for run in fit.task.runs]
        if any(abs(float(np.mean(y))) > MIN_LEVEL_MEAN_RATIO * float(np.std(y)) for y in values):
            return True
        if noise > MIN_LEVEL_RESIDUAL_RATIO * max(float(np.std(y)) for y in values):
            return True
    return False


def _may_hide_level(fit: Fit) -> bool:
    """Whether estimated initial conditions and residuals that are not white may hide a level from the offset test."""
    joint = fit.joint
    if joint is None or not _has_estimated_initial_conditions(fit):
        return False
    deviations = {o: max(float(np.nanstd(run[o])) for run in fit.task.runs) for o in joint.noise}
    is_negligible = all(noise <= NEGLIGIBLE_RESIDUAL_RATIO * deviations[o] for o, noise in joint.noise.items())
    return not is_negligible and not has_white_residuals(joint)


def _has_quiet_samples(fit: Fit) -> bool:
    """Whether a run has samples before its inputs change, in which a level of the outputs would be visible."""
    evidence = (rest_evidence(run, fit.task.structure) for run in fit.task.runs)
    return any(item is not None and item.rows > 1 for item in evidence)


def _is_rest_assumed(fit: Fit) -> bool:
    """Whether inputs are constant from the second row on in every run, so that rest before it can only be assumed."""
    evidence = (rest_evidence(run, fit.task.structure) for run in fit.task.runs)
    return all(item is not None and item.rows == 0 for item in evidence)


def _has_estimated_initial_conditions(fit: Fit) -> bool:
    """Whether nonzero initial conditions were chosen automatically (``initial="auto"``)."""
    return fit.joint is not None and fit.joint.initial != "rest" and fit.task.structure.initial == "auto"


def _history_offset_findings(fit: Fit) -> list[Finding]:
    """Return a list with a finding if a constant in the equations explains the data as well as the initial terms.

    Otherwise the list is empty. A constant is part of the model, whereas initial terms hold for one run only.
    """
    joint, structure = fit.joint, fit.task.structure
    if joint is None or structure.initial != "auto" or not isinstance(joint.initial, History):
        return []
    joint_without_history = fit_without_history(joint, fit.task.runs, structure)
    if joint_without_history is None:
        return []
    fewer_terms = joint.initial_terms - joint_without_history.initial_terms
    outputs = ", ".join(fit.model.outputs)
    return [make_finding("constant_instead_of_past", output=outputs, terms=joint.initial_terms, fewer=fewer_terms)]


def fit_offset_test(fit: Fit) -> OffsetTest | None:
    """Return the offset test at the parameters of a fit; None if the fit does not allow the test."""
    structure = replace(fit.task.structure, offset="none")
    if fit.joint is not None:
        values = fit.joint.values_by_name
        request = replace(structure, initial=fit.joint.initial)
        return offset_test(fit.task.runs, request, values, pulses_per_sample=fit.joint.refinement)
    if not fit.at_optimum:
        return None
    values = {**fit.model.orders, **fit.model.coefficients}
    return offset_test(
        fit.task.runs, replace(structure, coefficient_law=()), values, pulses_per_sample=DEFAULT_PULSES_PER_SAMPLE
    )


def _with_offset_decision(fit: Fit, decision: str) -> Fit:
    return replace(fit, settings={**fit.settings, "offset_test": decision})
