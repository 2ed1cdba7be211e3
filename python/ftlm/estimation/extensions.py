"""Tests whether an extended structure explains colored residuals, and whether other initial conditions fit as well.

The extensions are an output level, nonzero initial conditions, a constant, a linear drift of an output, another
intersample behavior of an input (``"zoh"`` or ``"foh"``), a lag, a delay or lead, a zero, a pole with a zero, dry
friction, a saturation, a dead zone, a squared input, a non-linear term of the output, and a load step.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ftlm import _core
from ftlm.analysis.poles import steady_states
from ftlm.data.run import Run
from ftlm.data.runs import Runs, as_runs
from ftlm.data.sampling import ZERO_ORDER_HOLD, Intersample, drop_missing, longest_delay
from ftlm.errors import FtlmError
from ftlm.estimation.closed_loop import run_with_inputs
from ftlm.estimation.estimators import fitted_model
from ftlm.estimation.fit import Fit
from ftlm.estimation.model_checks import enumerate_names
from ftlm.estimation.nonlinear_checks import nonlinear_term_inputs
from ftlm.estimation.nuisance_parameters import evaluate_at_point, output_sensitivities, refit_after_screening
from ftlm.estimation.output_error import JointFit, fit_output_error
from ftlm.findings import Finding, make_finding
from ftlm.model.model import Model
from ftlm.simulation.initial_conditions import rest_evidence
from ftlm.simulation.output_samples import initial_exponents
from ftlm.simulation.simulate import simulate
from ftlm.structure.equation import Equation, Friction, Term
from ftlm.structure.expression import apply, channel, constant, multiply, power
from ftlm.structure.input_nonlinearity import InputEffect, input_name
from ftlm.structure.order import Order
from ftlm.structure.structure import History, Initial, Offset, Structure, unused_names
from ftlm.utils.linalg import orthonormal
from ftlm.utils.statistics import ROUNDING_RESIDUAL_RATIO
from ftlm.utils.validation import Floats
from ftlm.validation.comparison import MAX_NORMALIZED_RESIDUAL, simulate_runs
from ftlm.validation.residual_tests import (
    DEFAULT_LAGS,
    NoiseModel,
    Residuals,
    friction_term,
    run_residual_tests,
    sign_tanh_slope,
)

#: Minimum decrease of the Schwarz criterion (BIC) for a reported extension. A decrease of 10 is very strong evidence
#: (Kass and Raftery, doi:10.1080/01621459.1995.10476572). The threshold is three times that, because the best of
#: several extensions is chosen.
MIN_CRITERION_DECREASE = 30.0
#: Minimum decrease for a drift, which is a single form and not the best of several. In 128 records whose noise is a
#: random walk, a line decreases the criterion by up to 16.
MIN_DRIFT_DECREASE = 20.0
#: Minimum further decrease of the criterion at which an extension replaces one that precedes it in the list. Some are
#: nearly equivalent on sampled data: feedthrough of a first-order plant, and an input that was logged one sample late.
MIN_CRITERION_GAP = 10.0
#: Maximum number of samples, over all runs, to which extensions are fitted. Each run contributes its first samples.
MAX_EXTENSION_SAMPLES = 6000
#: Fraction of the samples at each end of a run in which no load step is sought.
MIN_LOAD_FRACTION = 0.05
#: Maximum number of iterations in the search for the time of a load step from one fit.
MAX_LOAD_SEARCHES = 4
#: Fraction of the power of a load response that sensitivities to the parameters do not explain. Below this value, the
#: load is collinear with the parameters.
LOAD_COLLINEARITY_TOLERANCE = 1e-6
#: Lower bound of an estimated saturation limit, relative to the largest magnitude of the input.
MIN_SATURATION_FRACTION = 0.05
#: Upper bound of an estimated dead zone, relative to the largest magnitude of the input.
MAX_DEAD_ZONE_FRACTION = 0.9
#: Initial guesses of a saturation limit or dead zone, relative to the largest magnitude of the input.
LIMIT_GUESS_FRACTIONS = (0.25, 0.6)
#: Initial guess of a friction coefficient, relative to the largest magnitude of an input term in the equation.
LOCAL_FRICTION_FRACTION = 0.02
#: Fraction of sampling intervals over which an input must change for its other intersample behavior to be tested.
MIN_CHANGING_FRACTION = 0.5
#: Codes of extensions by offsets and initial conditions, which are preferred to other causes.
OFFSET_CODES = ("level_missing", "offset_missing", "motion_missing", "drift_fits")
#: Text of each extension by its code, in the message on causes that the data do not distinguish.
CAUSE_NAMES = {
    "level_missing": "a level at rest",
    "offset_missing": "a constant in the equation",
    "motion_missing": "motion at the start",
    "drift_fits": "a linear drift",
    "other_intersample_fits": "another intersample behavior of an input",
    "lag_fits": "a further lag",
    "delay_fits": "a delay",
    "zero_fits": "a derivative of an input",
    "mode_fits": "a further pole and zero",
    "saturation_fits": "a saturation",
    "dead_zone_fits": "a dead zone",
    "square_fits": "the square of an input",
    "nonlinear_term_fits": "a non-linear term of the output",
    "friction_fits": "dry friction",
    "load_step_fits": "a load step",
}
#: Words for the intersample behavior of an input in messages.
INTERSAMPLE_NAMES: dict[Intersample, str] = {"zoh": "constant", "foh": "linear"}
#: Minimum reported difference between an estimated delay and the delay in the structure [standard errors].
MIN_DELAY_CHANGE_SIGMAS = 3.0
#: Pairs (initial conditions, offset) of the alternative fits with which a fit is compared.
ALTERNATIVE_INITIAL_CONDITIONS: tuple[tuple[Initial, Offset], ...] = (
    ("rest", "none"),
    ("rest", "level"),
    ("caputo", "none"),
    ("caputo", "level"),
)
#: Residual variance under other initial conditions, relative to that of the fit, up to which both fit equally well.
MAX_SQUARES_RATIO = 1.05
#: Two gains contradict each other if their difference exceeds both limits. The first is in standard errors of the
#: difference, the second is relative to the larger gain.
MIN_GAIN_CHANGE_SIGMAS, MIN_GAIN_CHANGE = 3.0, 0.05


@dataclass(frozen=True)
class Extension:
    """Structure with an additional effect, whose fit is compared with the fit of the original structure.

    Parameters
    ----------
    code
        Code of the finding that reports the extension.
    structure
        The extended structure.
    parameter_count
        Number of additional parameters.
    inputs
        Names of the inputs that the extension concerns.
    starts
        Initial guesses, each with values by parameter name. The entry None stands for automatic initial guesses.
    initial_fit
        Fit with the same free parameters. If given, the extension is fitted from the optimum of this fit with its time
        step, not from `starts`.
    local_start
        Parameter values at which the extended model nearly equals the fitted one. If a local fit from these values does
        not lower the criterion, the slower multistart from `starts` is skipped.
    term_text
        Additional terms as text, for the message.
    runs
        Runs with an additional input or with another intersample behavior; None for the measured runs.
    load_time
        Time of the load step [s].
    positive_coefficient
        Name of the friction coefficient, which is physical only if positive; empty without friction.
    """

    code: str
    structure: Structure
    parameter_count: int
    inputs: Sequence[str]
    starts: Sequence[Mapping[str, float] | None] = (None,)
    initial_fit: JointFit | None = None
    local_start: Mapping[str, float] | None = None
    term_text: str = ""
    runs: Runs | None = None
    load_time: float = 0.0
    positive_coefficient: str = ""


@dataclass(frozen=True)
class FittedExtension:
    """Extension with its fit and the Schwarz criterion of one-step predictions of its residuals; lower is better."""

    extension: Extension
    fit: JointFit
    criterion: float

    @property
    def is_physical(self) -> bool:
        """Whether the friction coefficient is positive; True without friction. Negative friction adds energy."""
        name = self.extension.positive_coefficient
        return not name or self.fit.coefficients[name] > 0.0


@dataclass(frozen=True)
class ExtensionTests:
    """Result of :func:`run_extension_tests`: findings, and whether a structure with dry friction was tested."""

    findings: list[Finding]
    has_friction_test: bool = False


def run_extension_tests(fit: Fit, tests: Residuals) -> ExtensionTests:
    """Fit extended structures if residuals are colored, and report the best one if it predicts clearly better.

    Colored residuals are colored noise, or contain a response that the structure lacks. An autoregression of the
    residuals distinguishes the two: only a missing response raises its innovation variance. An extension is reported
    only if its own residuals depend neither on an input nor on the direction of motion, or if it is a non-linear term.
    Residuals at the level of rounding and discretization errors are not tested.
    If a controller computes an input from the output of the same row, the input contains the noise of this row. An
    extension by which the input acts sooner would seem to improve the fit, because it reproduces this noise. Extensions
    of the dynamics of such inputs are therefore not tested.

    Structures with friction, saturation, dead zone or free delays are not tested. Structures of several equations or
    with a coefficient law are tested only for a constant, a drift and intersample behavior. Structures with other
    non-linear terms are tested only for intersample behavior and for further non-linear terms.
    """
    joint, structure, runs = fit.joint, fit.task.structure, as_runs(fit.task.runs)
    inexact = [o for o in tests.outputs.values() if not o.nr <= ROUNDING_RESIDUAL_RATIO]
    colored = any(not o.whiteness.passed or o.follows_direction for o in inexact)
    is_excluded = structure.has_friction or structure.limits or structure.free_input_parameters or not colored
    if joint is None or not joint.names or is_excluded:
        return ExtensionTests([])
    structure = replace(structure, initial=joint.initial)
    fed_back = _inputs_fed_back_within_row(fit.model, tests)
    inputs = [n for n in _inputs_of_single_equation(structure, runs) if n not in fed_back]
    names = inputs if structure.is_linear else []
    location = {"run": ", ".join(r.name for r in runs), "output": ", ".join(structure.outputs)}
    try:
        joint, runs = _first_samples(joint, structure, runs)
        fitted_criterion = _prediction_criterion(joint, structure, runs, 0)
        is_poor = any(not o.nr <= MAX_NORMALIZED_RESIDUAL for o in inexact)
        fit_each = partial(_fit_extensions, runs=runs, fitted_criterion=fitted_criterion)
        # If the fit explains little, the optimum with an offset may be far from it.
        starts: list[Mapping[str, float] | None] = [joint.values_by_name, *([None] if is_poor else [])]
        fits = fit_each(_offset_extensions(structure, joint, runs, starts))
        offset_fits = sorted((f.fit for f in fits), key=lambda fit: max(fit.noise.values()))
        fits += fit_each([e for e in _intersample_extensions(structure, joint, runs) if not fed_back & {*e.inputs}])
        if names:
            fits += fit_each(_input_extensions(structure, joint, runs, names))
            fits += fit_each(_friction_extensions(structure, joint.values_by_name, runs))
            fits += fit_each(_load_step_extensions(structure, [joint, *offset_fits[:1]], runs))
        with contextlib.suppress(FtlmError):
            fits += fit_each(_nonlinear_extensions(structure, joint, runs, inputs))
        best = _best_physical(fits, fitted_criterion)
        if best is not None and best.extension.code != "offset_missing":
            # The optimum with an offset or friction may be far from that without. Under an input of one sign or of two
            # values, an offset, a dead zone and a saturation are the same model, and so is friction in one direction.
            # Their fits are compared at the same optimum.
            found = {n: best.fit.values_by_name[n] for n in joint.names}
            fits = fit_each(_offset_extensions(structure, joint, runs, [found, None])) + fits
            if names and best.extension.code != "friction_fits":
                fits += fit_each(_friction_extensions(structure, found, runs, is_local=False))
            best = _best_physical(fits, fitted_criterion)
        findings = _extension_findings(best, structure, joint, runs, names, location) if best else []
        if best is not None and any(f.code != "dynamics_missing" for f in findings):
            findings += _alternative_findings(best, fits, runs, location)
    except FtlmError:
        # The fit to the first samples, with which extensions are compared, has failed.
        return ExtensionTests([])
    return ExtensionTests(findings, any(f.extension.code == "friction_fits" for f in fits))


def _extension_findings(
    best: FittedExtension,
    structure: Structure,
    joint: JointFit,
    runs: Runs,
    names: Sequence[str],
    location: Mapping[str, str],
) -> list[Finding]:
    """Return the finding on the best extension, or ``dynamics_missing`` if it fails a residual test or is not physical.

    ``dynamics_missing`` is omitted if `names`, the inputs of a linear structure of one equation, is empty. An extension
    by another intersample behavior is reported only if it changes a parameter by over one standard error.
    """
    missing = [make_finding("dynamics_missing", input=enumerate_names(names), **location)] if names else []
    extension, refit = best.extension, best.fit
    share = 100.0 * (1.0 - min(_largest_change(joint, refit)["ratio"], 1.0))
    if extension.code == "nonlinear_term_fits":
        # The effect of the term is of first order only, so that its residuals may still depend on the inputs.
        return [make_finding(extension.code, term=extension.term_text, share=share, **location)]
    if not best.is_physical or not _passes_residual_tests(best, runs):
        return missing
    if extension.code == "offset_missing":
        change = _largest_change(joint, refit)
        test = f"with it {change['parameter']} is {change['other_value']:.4g}, not {change['value']:.4g}"
        return [make_finding("offset_missing", output=location["output"], share=share, test=test)]
    if extension.code in OFFSET_CODES:
        return [make_finding(extension.code, **location, **_largest_change(joint, refit))]
    if extension.code == "other_intersample_fits":
        return _intersample_findings(extension, joint, refit, runs, location)
    if extension.code == "delay_fits":
        return _delay_findings(extension, refit, structure, min(r.step for r in runs), location) or missing
    location, details = dict(location), {}
    if extension.code == "load_step_fits":
        (load_name,) = extension.inputs
        details = {
            "time": extension.load_time,
            "value": refit.coefficients[load_name],
            "error": refit.standard_errors[load_name],
        }
    if extension.code == "friction_fits":
        name = extension.positive_coefficient
        details = {"value": refit.coefficients[name], "error": refit.standard_errors[name]}
    limits = {n: v for n, v in refit.inputs.items() if n not in joint.inputs}
    if limits:
        ((name, value),) = limits.items()
        details = {"value": value, "error": refit.standard_errors[name], "low": 0.5 * value, "high": 2.0 * value}
        location["parameter"] = name
    if extension.inputs:
        location["input"] = enumerate_names(extension.inputs)
    return [make_finding(extension.code, term=extension.term_text, **location, **details)]


def _inputs_of_single_equation(structure: Structure, runs: Runs) -> tuple[str, ...]:
    """Return the inputs of a structure of one equation without a coefficient law; () for other structures."""
    if len(structure.equations) > 1 or structure.coefficient_law:
        return ()
    return tuple(n for n in runs[0].inputs if n in structure.equations[0].signals)


def _inputs_fed_back_within_row(model: Model, tests: Residuals) -> set[str]:
    """Return the inputs that, by the feedback tests, depend on an output of the same row.

    The set is empty for a non-linear model, which has no static gain.
    """
    loops = {(output, name): t for output, r in tests.outputs.items() for name, t in r.feedback_tests.items()}
    states = steady_states(model) if model.structure.is_linear else ()
    return {
        s.input
        for s in states
        if (s.output, s.input) in loops and loops[s.output, s.input].is_feedback_within_row(s.rate)
    }


def _offset_extensions(
    structure: Structure, joint: JointFit, runs: Runs, starts: Sequence[Mapping[str, float] | None]
) -> list[Extension]:
    """Return extensions by a constant and a drift; if the fit is from rest, also by a level and by initial conditions.

    A structure that has a level is extended only by a drift. The result is [] for non-linear structures and for
    structures with a constant or a ramp. All but the drift are fitted from each of `starts`.

    From rest, an offset of an input also acts through derivatives of the input, from the first sample on. The constant
    is then an input of ones with terms of the same orders.
    """
    if structure.offset not in ("none", "level") or not structure.is_linear:
        return []
    count, extensions = len(structure.equations) * len(runs), []

    def add(code: str, added: int, **changes: Any) -> None:
        with contextlib.suppress(FtlmError):
            extensions.append(Extension(code, replace(structure, **changes), added, [], starts=starts))

    if structure.offset == "none":
        add("offset_missing", count, offset="constant")
        if structure.initial == "rest":
            values = joint.values_by_name
            equations = [e.with_orders({n: values[n] for n in e.order_names}) for e in structure.equations]
            terms = len(runs) * sum(len(initial_exponents(e, "caputo", "none")) for e in equations)
            with contextlib.suppress(FtlmError):
                extensions += _input_offset_extensions(structure, runs, starts)
            add("level_missing", count, offset="level")
            add("motion_missing", terms, initial="caputo")
        # A ramp adds a constant and a slope. With a level, it adds only the slope.
        count *= 2
    drift = replace(structure, offset="ramp")
    return [*extensions, Extension("drift_fits", drift, count, [], initial_fit=joint)]


def _input_offset_extensions(
    structure: Structure, runs: Runs, starts: Sequence[Mapping[str, float] | None]
) -> list[Extension]:
    """Return an extension by an input of ones with its derivatives; [] if no input has derivatives of fixed orders."""
    inputs = _inputs_of_single_equation(structure, runs)
    orders = [t.order for e in structure.equations for t in e.terms if t.signal in inputs]
    if any(order.weights for order in orders) or not any(order.constant > 0.0 for order in orders):
        return []
    derivatives = sorted({0.0, *(order.constant for order in orders)})
    signal, *names = unused_names("one", 1 + len(derivatives), structure, runs[0].signals)
    (equation,) = structure.equations
    terms = [Term(signal, Order(order), name) for order, name in zip(derivatives, names, strict=True)]
    extended = replace(structure, equations=(_with_terms(equation, terms),))
    with_ones = as_runs([run_with_inputs(run, {signal: np.ones(run.length)}) for run in runs])
    guesses = [None if start is None else {**dict.fromkeys(names, 0.0), **start} for start in starts]
    return [Extension("offset_missing", extended, len(names), [], starts=guesses, runs=with_ones)]


def _intersample_extensions(structure: Structure, joint: JointFit, runs: Runs) -> list[Extension]:
    """Return an extension with the other intersample behavior for each input that changes in most samples.

    Samples alone do not distinguish a staircase from a smooth signal. The wrong assumption acts like a delay of half a
    sample, which biases the parameters.
    """
    extensions = []
    for name in runs[0].inputs:
        increments = np.concatenate([np.diff(drop_missing(run[name])) for run in runs])
        if name in structure.signals and np.count_nonzero(increments) > MIN_CHANGING_FRACTION * increments.size:
            alternative: Intersample = "foh" if runs[0].intersample[name] == ZERO_ORDER_HOLD else "zoh"
            changed = as_runs([run.with_intersample({name: alternative}) for run in runs])
            extensions.append(
                Extension("other_intersample_fits", structure, 0, [name], initial_fit=joint, runs=changed)
            )
    return extensions


def _intersample_findings(
    extension: Extension, joint: JointFit, refit: JointFit, runs: Runs, location: Mapping[str, str]
) -> list[Finding]:
    """Return a finding on another intersample behavior if it changes a parameter by over one standard error."""
    change = _largest_change(joint, refit)
    if not abs(change["other_value"] - change["value"]) > change["error"]:
        return []
    (name,), alternative = extension.inputs, as_runs(extension.runs or runs)[0].intersample
    texts = {"taken": INTERSAMPLE_NAMES[runs[0].intersample[name]], "other": INTERSAMPLE_NAMES[alternative[name]]}
    return [make_finding(extension.code, input=name, kind=alternative[name], **location, **change, **texts)]


def _largest_change(joint: JointFit, refit: JointFit) -> dict[str, Any]:
    """Return the parameter that changes most from a fit to a refit, and the ratio of residual variances.

    Keys of the result are ``parameter``, ``value`` and its standard error ``error`` in the fit, ``other_value`` in the
    refit, and ``ratio``. The ratio is the residual variance of the refit divided by that of the fit, smallest over
    outputs. Changes are compared in standard errors.
    """
    ratio = min((refit.noise[o] / noise) ** 2 for o, noise in joint.noise.items() if noise > 0.0)
    values, errors, refit_values = joint.values_by_name, joint.standard_errors, refit.values_by_name
    relative_changes = {
        n: abs(refit_values[n] - values[n]) / e for n, e in errors.items() if e > 0.0 and n in refit_values
    }
    name = max(values, key=lambda n: relative_changes.get(n, 0.0))
    details = {"value": values[name], "error": errors[name], "other_value": refit_values.get(name, math.nan)}
    return {"parameter": name, "ratio": ratio, **details}


def _first_samples(joint: JointFit, structure: Structure, runs: Runs) -> tuple[JointFit, Runs]:
    """Return the fit to the first samples of each run, and these parts of the runs.

    All parts together have at most `MAX_EXTENSION_SAMPLES` samples. Short runs and their fit are returned unchanged.
    """
    length = MAX_EXTENSION_SAMPLES // len(runs)
    if all(run.length <= length for run in runs):
        return joint, runs
    parts = as_runs([run if run.length <= length else run.window(None, length * run.step) for run in runs])
    return fit_output_error(parts, structure, initial_fit=joint, refine=False), parts


def _fit_extensions(extensions: Sequence[Extension], *, runs: Runs, fitted_criterion: float) -> list[FittedExtension]:
    """Return the fits of extensions; an extension whose fits all fail is omitted."""
    return [f for e in extensions if (f := _fit_extension(e, runs, fitted_criterion)) is not None]


def _fit_extension(extension: Extension, runs: Runs, fitted_criterion: float) -> FittedExtension | None:
    """Return the fit of an extension from its best initial guess; None if every fit fails.

    ``fitted_criterion`` is the criterion without the extension. If the fit from ``local_start`` does not lower it, no
    other initial guess is tried.
    """
    extension_runs = extension.runs or runs

    def fit(start: Mapping[str, float] | None) -> FittedExtension:
        refit = fit_output_error(
            extension_runs, extension.structure, start=start, initial_fit=extension.initial_fit, refine=False
        )
        criterion = _prediction_criterion(refit, extension.structure, extension_runs, extension.parameter_count)
        return FittedExtension(extension, refit, criterion)

    fits: list[FittedExtension] = []
    with contextlib.suppress(FtlmError):
        if extension.local_start is not None:
            fits.append(fit(extension.local_start))
            if not fits[0].criterion < fitted_criterion:
                return fits[0]
    for start in extension.starts:
        with contextlib.suppress(FtlmError):
            fits.append(fit(start))
    return min(fits, key=lambda f: max(f.fit.noise.values()), default=None)


def _best_extension(fits: Sequence[FittedExtension], fitted_criterion: float) -> FittedExtension | None:
    """Return the extension with the lowest criterion; None if the decrease is below the minimum for its code.

    Extensions are listed by preference. A later one must be better than an earlier one by `MIN_CRITERION_GAP`.
    Extensions with an unstable optimum are skipped.
    """
    best: FittedExtension | None = None
    for item in fits:
        if item.fit.unstable_optimum is not None:
            continue
        if item.criterion < (fitted_criterion if best is None else best.criterion - MIN_CRITERION_GAP):
            best = item
    if best is None:
        return None
    min_decrease = MIN_DRIFT_DECREASE if best.extension.code == "drift_fits" else MIN_CRITERION_DECREASE
    return best if best.criterion <= fitted_criterion - min_decrease else None


def _best_physical(fits: Sequence[FittedExtension], fitted_criterion: float) -> FittedExtension | None:
    """Return the best extension with positive friction, or the best of all if there is none."""
    physical = [f for f in fits if f.is_physical]
    return _best_extension(physical, fitted_criterion) or _best_extension(fits, fitted_criterion)


def _alternative_findings(
    best: FittedExtension, fits: Sequence[FittedExtension], runs: Runs, location: Mapping[str, str]
) -> list[Finding]:
    """Return a finding if other causes with no more parameters than the best extension explain the residuals as well.

    A structure with more parameters may contain the best one, and then always explains at least as much.
    """
    codes = list(
        dict.fromkeys(
            f.extension.code
            for f in fits
            if f.extension.code != best.extension.code
            and f.extension.parameter_count <= best.extension.parameter_count
            and f.criterion <= best.criterion + MIN_CRITERION_GAP
            and f.fit.unstable_optimum is None
            and f.is_physical
            and _passes_residual_tests(f, runs)
        )
    )
    if not codes:
        return []
    causes = {"cause": CAUSE_NAMES[best.extension.code], "others": enumerate_names([CAUSE_NAMES[c] for c in codes])}
    return [make_finding("causes_alike", output=location["output"], **causes)]


def _delay_findings(
    extension: Extension, refit: JointFit, structure: Structure, step: float, location: Mapping[str, str]
) -> list[Finding]:
    """Return a finding for each input with a significant delay or lead; `step` is the sampling step [s]."""
    findings = []
    for name in extension.inputs:
        key = input_name("delay", name)
        value, error, previous_delay = (
            refit.values_by_name[key],
            refit.standard_errors[key],
            structure.delay.get(name, 0.0),
        )
        if abs(value - previous_delay) > MIN_DELAY_CHANGE_SIGMAS * error:
            if previous_delay:
                change = abs(value - previous_delay)
                interval = {"low": max(value - change, -step), "high": value + change}
                details = {"value": value, "error": error, "before": previous_delay, **interval}
                findings.append(make_finding("delay_differs", input=name, **location, **details))
                continue
            details = {"value": abs(value), "error": error, "rows": abs(value) / step, "longest": 2.0 * abs(value)}
            code = "delay_fits" if value > 0.0 else "lead_fits"
            findings.append(make_finding(code, input=name, **location, **details))
    return findings


def _input_extensions(structure: Structure, joint: JointFit, runs: Runs, names: Sequence[str]) -> list[Extension]:
    """Return the extensions of the input dynamics of a one-equation structure, preferred ones first.

    They are a lag, delays, zeros, a lag with zeros, and a saturation, a dead zone and a square of each input.
    """
    (equation,) = structure.equations
    longest, step = min(longest_delay(r.length, r.step) for r in runs), min(r.step for r in runs)
    delays = {n: structure.delay.get(n, 0.0) for n in names}
    delayed_structure = structure.with_delays({n: (-step, max(longest, 2.0 * d)) for n, d in delays.items()})
    initial_values = {**joint.values_by_name, **{input_name("delay", n): d for n, d in delays.items()}}
    extensions: list[Extension] = []

    def add(code: str, build: Callable[[], Structure], count: int, inputs: Sequence[str], **options: Any) -> None:
        # Extensions that the structure does not allow are omitted, such as orders that no input may have beside a
        # square.
        with contextlib.suppress(FtlmError):
            extensions.append(Extension(code, build(), count, inputs, **options))

    def with_terms(terms: Sequence[Term]) -> Structure:
        return replace(structure, equations=(_with_terms(equation, terms),))

    (lag_name,) = unused_names("lag", 1, structure, runs[0].signals)

    def with_lag(terms: Sequence[Term]) -> Structure:
        return replace(structure, equations=(_with_terms(_with_lag(equation, lag_name), terms),))

    coefficients = unused_names("k", len(names), structure, runs[0].signals)
    derivative_terms = [_next_derivative(equation, *pair) for pair in zip(names, coefficients, strict=True)]
    terms_text = " + ".join(f"{t.coefficient} D^{t.order} {t.signal}" for t in derivative_terms)
    has_fixed_orders = not equation.order.weights and not any(t.order.weights for t in derivative_terms)
    previous_term = f"{lag_name} D^{equation.order} {equation.output}"
    equivalent_values = joint.values_by_name | dict.fromkeys(coefficients, 0.0)
    fast_values = None
    if set(structure.coefficient_names) == {t.coefficient for t in equation.terms}:
        # A lag with a time constant of two samples multiplies all coefficients by its rate.
        rate = 0.5 / step
        rates = dict.fromkeys(structure.coefficient_names, rate)
        fast_values = {lag_name: -rate} | {n: v * rates.get(n, 1.0) for n, v in equivalent_values.items()}
    add("lag_fits", partial(with_lag, []), 1, names, local_start=fast_values, term_text=previous_term)
    add("delay_fits", lambda: delayed_structure, len(names), names, local_start=initial_values)
    if has_fixed_orders and all(t.order.constant <= equation.order.constant for t in derivative_terms):
        add(
            "zero_fits",
            partial(with_terms, derivative_terms),
            len(derivative_terms),
            names,
            local_start=equivalent_values,
            term_text=terms_text,
        )
    if has_fixed_orders and all(t.order.constant <= equation.order.constant + 1.0 for t in derivative_terms):
        add(
            "mode_fits",
            partial(with_lag, derivative_terms),
            1 + len(derivative_terms),
            names,
            local_start=fast_values,
            term_text=f"{previous_term} + {terms_text}",
        )
    values, (coefficient,) = joint.values_by_name, unused_names("k", 1, structure, runs[0].signals)
    for name in names if not structure.limits and not structure.delay else ():
        largest = max(float(np.nanmax(np.abs(run[name]))) for run in runs)
        amplitudes = {
            "saturation": (MIN_SATURATION_FRACTION * largest, largest),
            "dead_zone": (0.0, MAX_DEAD_ZONE_FRACTION * largest),
        }
        effects: tuple[InputEffect, InputEffect] = ("saturation", "dead_zone")
        for effect in effects:
            starts = [{**values, input_name(effect, name): fraction * largest} for fraction in LIMIT_GUESS_FRACTIONS]
            limits = {effect: {name: amplitudes[effect]}}
            add(f"{effect}_fits", partial(structure.with_limits, **limits), 1, [name], starts=starts)
        square = Term(name, Order(0.0), coefficient, expression=power(channel(name), 2.0))
        text, flat = f"{coefficient} {name}^2", {**values, coefficient: 0.0}
        add("square_fits", partial(with_terms, [square]), 1, [name], starts=[flat], term_text=text)
    return extensions


def _friction_extensions(
    structure: Structure, values: Mapping[str, float], runs: Runs, *, is_local: bool = True
) -> list[Extension]:
    """Return extensions by Coulomb friction: -fc sign(D y) if the output y is a position, -fc tanh(s y) if a speed.

    The second one is omitted if y never changes sign, because its friction is then nearly constant. `values` are the
    initial guesses of the parameters: those of the fit if `is_local`, otherwise the optimum of another extension.
    """
    (equation,) = structure.equations
    (name,) = unused_names("fc", 1, structure, runs[0].signals)
    # A simulation with friction starts from a level and a velocity.
    initial = "caputo" if isinstance(structure.initial, History) else structure.initial
    extensions = []
    amplitudes = {
        n: max(float(np.nanmax(np.abs(run[n]))) for run in runs) for n in runs[0].inputs if n in equation.signals
    }
    forces = [
        abs(t.factor * (values[t.coefficient] if isinstance(t.coefficient, str) else t.coefficient))
        * amplitudes[t.signal]
        for t in equation.terms
        if t.signal in amplitudes
    ]
    guess = {**values, name: LOCAL_FRICTION_FRACTION * max(forces)}
    start: dict[str, Any] = {"local_start": guess} if is_local else {"starts": [guess]}

    def add(text: str, **changes: Any) -> None:
        # Some structures with friction cannot be simulated, such as one of order 1 or one behind a sensor filter.
        with contextlib.suppress(FtlmError):
            extended = replace(structure, equations=(replace(equation, **changes),), initial=initial)
            extension = Extension("friction_fits", extended, 1, [], **start, term_text=text)
            extensions.append(replace(extension, positive_coefficient=name))

    add(friction_term(equation.output, name), friction=Friction(name))
    slope = sign_tanh_slope([run[equation.output] for run in runs])
    if math.isfinite(slope):
        smooth_sign = apply("tanh", multiply(constant(slope), channel(equation.output)))
        term = Term(equation.output, Order(0.0), name, factor=-1.0, expression=smooth_sign)
        add(friction_term(equation.output, name, slope), terms=(*equation.terms, term))
    return extensions


def _load_step_extensions(structure: Structure, starts: Sequence[JointFit], runs: Runs) -> list[Extension]:
    """Return a list with an extension by a load step at an unknown time; [] for several or nonuniform runs.

    The search starts from the parameters of each fit in `starts`. It chooses the time at which a load step and
    parameter changes explain most of the residuals, and then fits the model with this load. Both are repeated until
    the time no longer changes or the residuals no longer decrease.
    """
    (equation,), (run, *other_runs) = structure.equations, runs
    if other_runs or run.nonuniform_samples is not None:
        return []
    (name,) = unused_names("load", 1, structure, run.signals)
    extended = replace(structure, equations=(_with_terms(equation, [Term(name, Order(0.0), name)]),))

    def with_load(row: int) -> Run:
        return run_with_inputs(run, {name: np.where(np.arange(run.length) >= row, 1.0, 0.0)})

    def search(values: Mapping[str, float]) -> tuple[float, int, Mapping[str, float]]:
        best: tuple[float, int, Mapping[str, float]] = (math.inf, 0, {})
        for _ in range(MAX_LOAD_SEARCHES):
            # The load is excluded here, so that the residuals alone determine its size.
            values = {n: values[n] for n in starts[0].names}
            row = _load_start_index(
                *_residuals_at(values, structure, run), _load_response(equation, structure, values, run)
            )
            if row is None or row == best[1]:
                break
            fit = fit_output_error([with_load(row)], extended, start={name: 0.0, **values}, refine=False)
            noise, values = fit.noise[equation.output], fit.values_by_name
            if not noise < best[0]:
                break
            best = noise, row, values
        return best

    searches = []
    for fit in starts:
        with contextlib.suppress(FtlmError):
            searches.append(search(fit.values_by_name))
    noise, row, values = min(searches, key=lambda s: s[0], default=(math.inf, 0, {}))
    if not math.isfinite(noise):
        return []
    time = run.start + row * run.step
    return [Extension("load_step_fits", extended, 2, [name], [values], runs=as_runs(with_load(row)), load_time=time)]


def _nonlinear_extensions(structure: Structure, joint: JointFit, runs: Runs, names: Sequence[str]) -> list[Extension]:
    """Return extensions by the terms of :func:`nonlinear_term_inputs`."""
    (signal,), (coefficient,) = (unused_names(base, 1, structure, runs[0].signals) for base in ("term", "k"))
    inputs = nonlinear_term_inputs(structure, runs, fitted_model(joint, structure), names, signal)
    term = Term(signal, Order(0.0), coefficient)
    extended = replace(structure, equations=(_with_terms(structure.equations[0], [term]),)) if inputs else structure
    base = Extension("nonlinear_term_fits", extended, 1, names, starts=[{**joint.values_by_name, coefficient: 0.0}])
    return [replace(base, runs=as_runs(new), term_text=f"{coefficient} {text}") for text, new in inputs.items()]


def _residuals_at(values: Mapping[str, float], structure: Structure, run: Run) -> tuple[Floats, Floats]:
    """Return the residuals at given parameters, and their sensitivities of shape (parameters, samples).

    Both are multiplied by the same factor, which makes the root mean square of the residuals 1.
    """
    _, point = evaluate_at_point([run], structure, values, 1)
    return np.asarray(point.outcome["residuals"]), np.asarray(point.outcome["jacobian"])


def _load_response(equation: Equation, structure: Structure, values: Mapping[str, float], run: Run) -> Floats:
    """Return the response of the output to a unit load that starts at sample 0, at samples 1 to N - 1 of the run.

    The load is added to the right-hand side of the equation, and `values` are the parameters by name.
    """
    output_terms = (t for t in equation.terms if t.signal == equation.output)
    loaded = replace(equation, terms=(*output_terms, Term("load", Order(0.0), 1.0)))
    loaded_structure = replace(structure, equations=(loaded,), delay={}, free_delays={}, initial="rest", offset="none")
    loaded_structure = loaded_structure.with_orders({n: values[n] for n in loaded_structure.order_names})
    model = Model(loaded_structure.with_coefficients({n: values[n] for n in loaded_structure.coefficient_names}))
    ones, zeros = np.ones(run.length), np.zeros(run.length)
    unit_load = Run.from_arrays(step=run.step, inputs={"load": ones}, outputs={equation.output: zeros})
    return simulate(model, unit_load)[equation.output][1:]


def _load_start_index(residuals: Floats, sensitivities: Floats, response: Floats) -> int | None:
    """Return the sample index from which a constant load explains most of the residuals.

    Return None if the response overflows or no load explains a part of the residuals. The first element of every array
    belongs to sample 1. `sensitivities` of the output to the parameters have shape (parameters, samples), and
    `response` is the response to a load from sample 0 on. The part that the parameters can explain is projected out of
    residuals and load responses.
    """
    series, load = residuals, response[: residuals.size]
    edge = max(int(MIN_LOAD_FRACTION * series.size), 1)
    if not np.all(np.isfinite(load)):
        return None
    basis = orthonormal(sensitivities.T, 1e-12)
    series = series - basis @ (basis.T @ series)
    # Dot products with the response to a load from each sample on. Padding prevents circular correlation by the FFT.
    padded_length = 2 * series.size
    spectra = np.fft.rfft(np.column_stack([basis, series]), padded_length, axis=0)
    products = np.fft.irfft(spectra * np.conj(np.fft.rfft(load, padded_length))[:, None], axis=0)[: series.size]
    power = np.cumsum(load**2)[::-1]
    free_power = power - np.sum(products[:, :-1] ** 2, axis=1)
    is_free = free_power > LOAD_COLLINEARITY_TOLERANCE * power
    explained_power = np.where(is_free, products[:, -1] ** 2 / np.where(is_free, free_power, 1.0), 0.0)[edge:-edge]
    # A load from sample k on first affects sample k + 1, which is element k of these arrays.
    return edge + int(np.argmax(explained_power)) if np.any(explained_power > 0.0) else None


def _with_lag(equation: Equation, coefficient: str) -> Equation:
    """Return an equation whose dynamics have one further lag.

    The order of the left-hand side rises by 1, and its former derivative becomes a term with the named coefficient.
    """
    return replace(
        equation,
        order=equation.order + Order(1.0),
        terms=(Term(equation.output, equation.order, coefficient), *equation.terms),
    )


def _with_terms(equation: Equation, terms: Sequence[Term]) -> Equation:
    """Return an equation with additional terms."""
    return replace(equation, terms=(*equation.terms, *terms))


def _next_derivative(equation: Equation, name: str, coefficient: str) -> Term:
    """Return a term of the input `name` whose order is 1 above the highest order of that input in the equation."""
    highest = max((t.order for t in equation.terms if t.signal == name), key=lambda order: order.constant)
    return Term(name, highest + Order(1.0), coefficient)


def _prediction_criterion(joint: JointFit, structure: Structure, runs: Runs, added_parameters: int) -> float:
    """Return the Schwarz criterion of an autoregression of the residuals with at most 25 lags.

    The fit minimizes squared residuals and ignores their color. One generalized least-squares step therefore first
    removes the part of the residuals that parameter errors explain. The penalty counts the coefficients of the
    autoregressions and ``added_parameters``. The criterion is infinite if an innovation variance is not positive.
    """
    total, samples = 0.0, 0
    sensitivities = output_sensitivities(joint, structure, runs)
    for name in joint.noise:
        series = [joint.noise[name] * run_residuals[name] for run_residuals in joint.residuals]
        series = NoiseModel.fit(series, [], DEFAULT_LAGS).subtract(series, sensitivities.get(name, []))
        _, _, innovations, parameters = _core.arx_model(series, [], DEFAULT_LAGS)
        innovation = np.concatenate(innovations)
        rows = int(np.isfinite(innovation).sum())
        power = float(np.nanmean(innovation**2)) if rows else math.nan
        if not power > 0.0:
            return math.inf
        total += rows * math.log(power) + parameters * math.log(rows)
        samples += rows
    return total + added_parameters * math.log(samples)


def _passes_residual_tests(extension_fit: FittedExtension, default_runs: Runs) -> bool:
    """Whether the residuals of a fit depend neither on an input nor on the direction of motion."""
    structure, joint, runs = (
        extension_fit.extension.structure,
        extension_fit.fit,
        extension_fit.extension.runs or default_runs,
    )
    model = fitted_model(joint, structure)
    try:
        tests = run_residual_tests(
            model,
            runs,
            simulate_runs(model, runs),
            lags=DEFAULT_LAGS,
            sensitivities=lambda: output_sensitivities(joint, structure, runs),
        )
    except FtlmError:
        return False
    outputs = tests.outputs.values()
    failed = any(t.failed for o in outputs for t in o.inputs.values())
    return not failed and not any(o.follows_direction for o in outputs)


def undetermined_start_findings(fit: Fit, known_fits: Mapping[tuple[Initial, Offset], JointFit]) -> list[Finding]:
    """Return a finding if other initial conditions fit the runs equally well but give another steady-state gain.

    `known_fits` has the fits that exist already, by (initial conditions, offset). Other alternatives are fitted here.
    """
    joint, structure, runs = fit.joint, fit.task.structure, fit.task.runs
    if joint is None or not structure.is_linear or structure.limits or structure.offset not in ("none", "level"):
        return []
    if joint.unstable_optimum is not None and joint.unstable_optimum.is_accepted:
        # An unstable model has no steady state.
        return []
    if all(rest_evidence(run, structure) is not None for run in runs):
        # Another finding states the evidence of rest, or that rest is assumed.
        return []
    if joint.exact_outputs(runs) == set(joint.noise):
        # A ratio of rounding errors is meaningless.
        return []
    fitted_setting = joint.initial if joint.initial == "rest" else "caputo", structure.offset

    def squares_ratio(other: JointFit) -> float:
        return max((other.noise[o] / noise) ** 2 for o, noise in joint.noise.items() if noise > 0.0)

    def fits_alike(other: JointFit) -> bool:
        return squares_ratio(other) <= MAX_SQUARES_RATIO

    fitted_gains = _gains(joint, structure)
    worst: tuple[float, Finding] | None = None
    for initial, offset in ALTERNATIVE_INITIAL_CONDITIONS if fitted_gains else ():
        if (initial, offset) == fitted_setting:
            continue
        other = known_fits.get((initial, offset))
        if other is None:
            request = replace(structure, initial=initial, offset=offset)
            other = refit_after_screening(joint, runs, request, fits_alike, refine=False)
        if other is None or other.unstable_optimum is not None or not fits_alike(other):
            continue
        for pair, (gain, error) in _gains(other, structure).items():
            fitted_gain, fitted_error = fitted_gains.get(pair, (math.nan, math.nan))
            distance = abs(gain - fitted_gain) / max(math.hypot(error, fitted_error), 1e-300)
            is_different = abs(gain - fitted_gain) > MIN_GAIN_CHANGE * max(abs(gain), abs(fitted_gain))
            if is_different and distance > max(MIN_GAIN_CHANGE_SIGMAS, worst[0] if worst else 0.0):
                ratio = squares_ratio(other)
                details = {"gain": fitted_gain, "error": fitted_error, "other_gain": gain, "other_error": error}
                texts = {
                    "taken": _initial_condition_text(*fitted_setting),
                    "other": _initial_condition_text(initial, offset),
                    "ratio": ratio,
                }
                location = {"run": ", ".join(r.name for r in runs), "output": pair[0], "input": pair[1]}
                worst = distance, make_finding("gain_depends_on_initial_conditions", **location, **details, **texts)
    return [worst[1]] if worst else []


def _initial_condition_text(initial: Initial, offset: Offset) -> str:
    """Return initial conditions as text, such as "nonzero initial conditions and an output level"."""
    zero = "zero" if initial == "rest" else "nonzero"
    return f"{zero} initial conditions" + (" and an output level" if offset == "level" else "")


def _gains(joint: JointFit, structure: Structure) -> dict[tuple[str, str], tuple[float, float]]:
    """Return the (steady-state gain, standard error) of each (output, input); gains that are not finite are omitted.

    The result is {} if steady states cannot be computed.
    """
    try:
        states = steady_states(fitted_model(joint, structure))
    except FtlmError:
        return {}
    return {(s.output, s.input): (s.gain, s.error) for s in states if s.error is not None and math.isfinite(s.gain)}
