"""Text summary of an identification: verdict, equations, parameters, modes, fit, findings and settings."""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from markupsafe import Markup

from ftlm.analysis.poles import Mode, SteadyState, modes, steady_states
from ftlm.errors import FtlmError
from ftlm.estimation.result import Identification
from ftlm.estimation.verdict import verdict
from ftlm.findings import LEVEL_NOTE, MAX_SUMMARY_FINDINGS, Finding, group_findings, hidden_findings_text
from ftlm.model.model import Model
from ftlm.report.typesetting import ORDER_DECIMALS
from ftlm.structure.equation import Equation, format_equation
from ftlm.structure.order import Order
from ftlm.utils.formatting import Cell, Exact, format_bound, symbol, with_error, wrap_text
from ftlm.utils.parameters import choose_text
from ftlm.utils.statistics import NORMAL_95
from ftlm.validation.comparison import Comparison, describe_initial_terms, describe_offsets

#: Maximum number of modes in a summary.
MAX_LISTED_MODES = 6


def summary(result: Identification, validation: Comparison | None = None) -> str:
    """Return the summary of an identification as text; `validation` is its comparison with validation runs."""
    overall_verdict = verdict(result, validation)
    lines = [*wrap_text(str(overall_verdict)), ""]
    lines += equation_lines(result.model, result.comparison)
    lines += ["", *parameter_lines(result), *behavior_lines(result.model), ""]
    lines += [*fit_lines(result, validation), *_residual_lines(result), *_initial_condition_lines(result)]
    if validation is not None and (terms := describe_initial_terms(validation)):
        lines += wrap_text(f"initial terms and levels of validation runs, estimated on them (their number): {terms}")
    lines += finding_lines(result.findings)
    return "\n".join(lines)


def equation_lines(model: Model, comparison: Comparison | None = None) -> list[str]:
    """Return one text line per equation of a model, with delays, saturations, dead zones and friction.

    The offset is shown as a number if `comparison` has a single run.
    """
    structure = model.structure
    lines = []
    for equation in model.equations:
        offset = _offset_text(equation.output, comparison)
        tail = structure.offset_text if offset is None else offset
        lines.append(format_equation(_rounded_equation(equation), structure.describe_inputs(".6g")) + tail)
    return lines


def _rounded_equation(equation: Equation) -> Equation:
    """Return a copy of an equation with its orders rounded to four decimals."""
    copied = copy.copy(equation)
    terms = tuple(replace(t, order=Order(round(t.order.constant, ORDER_DECIMALS) + 0.0)) for t in equation.terms)
    vars(copied).update(order=Order(round(equation.order.constant, ORDER_DECIMALS)), terms=terms)
    return copied


def _offset_text(output: str, comparison: Comparison | None) -> str | None:
    """Return the estimated offset of the equation of `output` as text; None for several runs or without an offset.

    An offset of kind "level" is omitted: it is added to the output, and is not a term of the equation.
    """
    if comparison is None or len(comparison.offsets) != 1 or not comparison.offsets[0].get(output):
        return None
    parts = comparison.offsets[0][output]
    parts_with_units = [(parts[name], tail) for name, tail in (("constant", ""), ("ramp", " t")) if name in parts]
    return "".join(f" {'-' if v < 0 else '+'} {abs(v):.4g}{unit_text}" for v, unit_text in parts_with_units)


def parameter_lines(result: Identification) -> list[str]:
    """Return one text line per parameter: value, standard error, unit, profile-likelihood interval, nominal value.

    The list is empty without parameters.
    """
    offsets, reference = result.offsets, result.model.structure.nominal_values
    rows = []
    for name, p in result.parameters.items():
        has_error = not math.isnan(p.standard_error)
        error_text = f"± {format_bound(p.standard_error)}" if has_error else "fixed" if p.fixed else ""
        tail = f"[{result.profiles[name]}]" if name in result.profiles else ""
        tail = "(offset of one run, not part of the model)" if name in offsets else tail
        if name in reference:
            tail = f"{tail}  (nominal {reference[name]:.6g})".strip()
        rows.append((name, f"{p.value:.6g}", error_text, p.unit, tail))
    if not rows:
        return []
    a, b, c, d = (max(len(row[k]) for row in rows) for k in range(4))
    lines = [f"  {n:<{a}}  {v:>{b}} {s:<{c}}  {f'{u:<{d}}  ' if d else ''}{tail}".rstrip() for n, v, s, u, tail in rows]
    note = "± is one standard error; 95 % intervals are ± 1.96 of these"
    note += ", in brackets by profile likelihood" if result.profiles else ""
    has_errors = any(not math.isnan(p.standard_error) for p in result.parameters.values())
    return [*lines, f"  ({note})"] if has_errors else lines


def behavior_lines(model: Model) -> list[str]:
    """Return text lines on steady-state gains and modes, or one line on the reason if the model is not linear.

    The list is empty if they cannot be computed.
    """
    if model.structure.has_friction:
        return ["  no poles and no gain: a model with friction is not linear"]
    if model.structure.has_nonlinear_terms:
        return ["  no poles and no gain: only a linear model has them, such as linearized(at=…) about a point"]
    lines: list[str] = []
    # Equations that cannot be solved for all outputs together have neither modes nor gains.
    with contextlib.suppress(FtlmError):
        model_modes = modes(model)
        unstable = any(mode.unstable for mode in model_modes)
        noun = "mode" if len(model_modes) == 1 else "modes"
        lines += [
            f"  {noun if k == 0 else '':<7}{describe_mode(mode)}"
            for k, mode in enumerate(model_modes[:MAX_LISTED_MODES])
        ]
        if len(model_modes) > MAX_LISTED_MODES:
            lines.append(f"         and {len(model_modes) - MAX_LISTED_MODES} faster ones: .model.modes()")
        if not (unstable or model.structure.limits):
            lines = [f"  {'gain':<7}{describe_gain(s, model)}" for s in steady_states(model)] + lines
    return lines


def describe_mode(mode: Mode) -> str:
    """Return text on a mode, followed by its pole [rad/s]."""
    s = mode.pole
    pole_text = f"{s.real:.4g} ± {abs(s.imag):.4g}j" if mode.oscillatory else f"{s.real:.4g}"
    return f"{mode}; pole {pole_text}"


def describe_gain(state: SteadyState, model: Model) -> str:
    """Return text on a steady-state gain, or on the growth or decay of the step response if there is no such gain."""
    pair = f"{state.output} from {state.input}"
    output_unit, input_unit = (model.units.get(n, "") for n in (state.output, state.input))
    unit = f" {output_unit}/{input_unit}" if output_unit and input_unit else ""
    rate, uncertainty = with_error(state.rate, state.error), describe_order(state)
    if state.order > 0:
        per_time = "per second" if state.order == 1 else f"t^{state.order:.4g}/Γ({state.order + 1:.4g})"
        return f"{pair}: none, it integrates: {rate}{unit} {per_time}{uncertainty}"
    if state.order < 0:
        return f"{pair}: 0, the response to a step decays{uncertainty}"
    return f"{pair}: {rate}{unit}{uncertainty}"


def describe_order(state: SteadyState) -> str:
    """Return text on the exponent of t in a step response, with its standard error; empty if it is fixed."""
    error = state.order_error
    if not error:
        return ""
    integer = float(round(state.order))
    is_determined = abs(state.order - integer) > NORMAL_95 * error
    meaning = {0.0: "a gain", 1.0: "an integrator"}.get(integer, f"order {integer:g}")
    return f"; order {with_error(state.order, error)}" + (
        "" if is_determined else f", which may be {integer:g}: {meaning}"
    )


def fit_lines(result: Identification, validation: Comparison | None) -> list[str]:
    """Return text lines of a table: simulation fit [%] to estimation and validation data, and RMSE, per output."""
    width = max(len(o) for o in result.output_error) + 2
    lines = [f"{'simulation fit, %':<24}{'estimation':>12}{'validation':>12}{'RMSE':>12}"]
    for output, errors in result.output_error.items():
        unit = result.model.units.get(output, "")
        text = "not tried" if validation is None else f"{validation.output_error[output].fit:.4g}"
        lines.append(
            f"  {output:<{max(width, 22)}}{errors.fit:>12.4g}{text:>12}{errors.rmse:>12.4g}{f' {unit}' if unit else ''}"
        )
    return lines


def _residual_lines(result: Identification) -> list[str]:
    if result.residuals is None:
        return ["residuals: the runs are too short for tests"]
    whiteness_text = ", ".join(f"{o} {'yes' if w else 'no'}" for o, w in result.residuals.white.items())
    free = ", ".join(f"{o} {w}" for o, w in result.residuals.independence.items())
    return [f"residuals white: {whiteness_text}; independent of the inputs: {free} (99 %)"]


def _initial_condition_lines(result: Identification) -> list[str]:
    """Return text lines on offsets without an estimate, and on runs with nonzero initial conditions."""
    comparison = result.comparison
    unestimated = tuple({o: values for o, values in run.items() if not values} for run in comparison.offsets)
    lines = describe_offsets(replace(comparison, offsets=unestimated))
    initial_terms_text = "" if comparison.offsets else describe_initial_terms(comparison)
    if initial_terms_text and not any(f.code == "runs_split" for f in result.findings):
        lines += wrap_text(f"nonzero initial conditions, initial terms estimated (their number): {initial_terms_text}")
    return lines


def finding_lines(findings: Iterable[Finding], hint: str | None = None) -> list[str]:
    """Return text lines on at most `MAX_SUMMARY_FINDINGS` groups of findings with remedies, most serious first.

    If findings are omitted, the last line has their number and `hint` to display them.
    """
    groups = group_findings(findings)
    lines = []
    for group in groups[:MAX_SUMMARY_FINDINGS]:
        lines += wrap_text(
            f"{group.first_finding}{group.count}", "  " if group.first_finding.level == LEVEL_NOTE else "! "
        )
        if group.remedy:
            lines += wrap_text(group.remedy, "  -> ")
    hidden_text = hidden_findings_text(groups)
    return (
        [
            *lines,
            f"  ({hidden_text}: {hint or choose_text('print(result.details())', '--report FILE shows all')})",
        ]
        if hidden_text
        else lines
    )


ROW_BASIS_TEXTS = {"haar": "Haar coordinates", "time": "order of time"}
INITIAL_TERMS_TEXTS = {"rest": "none, the records start at rest", "caputo": "Caputo's, estimated for each run"}
NORM_TEXTS = {"l1": "sum of absolute errors (45)", "l2": "RMSE (46)"}


def settings_text(settings: Mapping[str, Any]) -> str:
    """Return the settings of an identification as one line of text."""
    text = f"M = {settings['m']}"
    if "refinement" in settings:
        text = f"all samples, {settings['refinement']} pulses each, {settings['starts']} initial guesses"
    if "seeds" in settings:
        seeds = ", ".join(map(str, settings["seeds"]))
        text += f", seeds {seeds}, {sum(settings['evaluations'].values())} evaluations in all"
    if "innovation_length" in settings:
        prior = settings["prior_covariance"]
        text += f", p = {settings['innovation_length']}, {'weak prior' if prior is None else f'K0 = {prior:g}'}"
        text += f", {settings['row_basis']} rows"
    if "loss" in settings:
        text += f", loss: {settings['loss']} ({robust_loss_text(settings)})"
    text += f", initial terms: {settings['initial']}"
    text += f", offset: {settings['offset']}, one per run" if "offset" in settings else ""
    text += f", offset found by test: {settings['offset_test']}" if "offset_test" in settings else ""
    text += f", noise: autoregression of order {len(settings['noise_model'])}" if "noise_model" in settings else ""
    text += f", priors: {_priors_text(settings['priors'])}" if "priors" in settings else ""
    return text + (
        f", instrument: the part of the inputs that {settings['reference']} explains" if "reference" in settings else ""
    )


def _priors_text(priors: Mapping[str, tuple[float, float]]) -> str:
    return ", ".join(f"{name} = {mean:g} ± {deviation:g}" for name, (mean, deviation) in priors.items())


def robust_loss_text(settings: Mapping[str, Any]) -> str:
    """Return text on the number of residuals that the robust loss down-weighted, and on the number of outliers."""
    return (
        f"{settings['downweighted_count']} of {settings['samples']} residuals down-weighted, "
        f"{settings['outliers']} of them beyond five deviations"
    )


def settings_rows(settings: Mapping[str, Any], *, searched: bool) -> list[list[Cell]]:
    """Return (setting, value) rows for the settings of an identification.

    `searched` is whether orders were searched; only then the ranking criterion is included.
    """
    rows: list[list[Cell]] = [["block pulses per run, M", int(settings["m"])]]
    if "innovation_length" in settings:
        rows += [
            ["innovation length, p", int(settings["innovation_length"])],
            [
                Markup("prior covariance, K<sub>0</sub>"),
                "weak" if settings["prior_covariance"] is None else Exact(settings["prior_covariance"]),
            ],
            ["rows of the recursion", ROW_BASIS_TEXTS.get(settings["row_basis"], settings["row_basis"])],
        ]
    if "refinement" in settings:
        rows += [
            ["pulses per sampling interval", int(settings["refinement"])],
            ["automatic initial guesses", int(settings["starts"])],
        ]
        rows += [[f"noise found on {symbol(name)}", float(level)] for name, level in settings["noise"].items()]
    if "loss" in settings:
        rows.append(["loss", f"{settings['loss']}: {robust_loss_text(settings)}"])
    rows.append(["initial terms", INITIAL_TERMS_TEXTS.get(str(settings["initial"]), str(settings["initial"]))])
    if "offset" in settings:
        rows.append(["offset of each equation", f"{settings['offset']}, estimated for each run"])
    if "offset_test" in settings:
        rows.append(["offset found by test", settings["offset_test"]])
    if "noise_model" in settings:
        rows.append(["noise", f"autoregression of order {len(settings['noise_model'])}, estimated with the model"])
    if "priors" in settings:
        rows.append(["priors, mean ± standard deviation", _priors_text(settings["priors"])])
    if "reference" in settings:
        rows.append(["reference", f"{settings['reference']}; instrument: the part of the inputs that it explains"])
    if searched:
        rows.append(
            ["orders ranked by", f"{settings['criterion']}, {NORM_TEXTS.get(settings['norm'], settings['norm'])}"]
        )
    return rows
