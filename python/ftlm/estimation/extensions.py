"""Extensions of a structure that explain its colored residuals: a lag, a delay, a zero, a mode, a limit of an input."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ftlm import _core
from ftlm.data.run import Run, Runs, as_runs
from ftlm.data.sampling import longest_delay
from ftlm.errors import FtlmError
from ftlm.estimation.estimators import fitted_model
from ftlm.estimation.fit import Fit
from ftlm.estimation.model_checks import join_names
from ftlm.estimation.nuisance_parameters import output_sensitivities
from ftlm.estimation.output_error import JointFit, fit_output_error
from ftlm.findings import Finding, make_finding
from ftlm.model.model import Model
from ftlm.simulation.simulate import simulate
from ftlm.structure.equation import Equation, Term
from ftlm.structure.expression import channel, power
from ftlm.structure.input_nonlinearity import InputEffect, input_name
from ftlm.structure.order import Order
from ftlm.structure.structure import Structure
from ftlm.utils.validation import Floats
from ftlm.validation.comparison import simulate_runs
from ftlm.validation.residual_tests import DEFAULT_LAGS, Residuals, run_residual_tests

#: Decrease of the Schwarz criterion of one-step predictions from which on an extension is reported. The choice among
#: several extensions lowers it as well, so it is three times what is called very strong evidence.
MIN_CRITERION_DECREASE = 30.0
#: Decrease of the criterion from which on a later extension is preferred to an earlier one. An input that was logged
#: one row late and feedthrough of a first-order plant, for example, give the same samples.
STRONG_EVIDENCE = 10.0
#: Name of an additional input, a load that is constant from some row on, and smallest share of the run before and
#: after its step.
LOAD_NAME, MIN_LOAD_SHARE = "load", 0.05
#: Number of rows at which a load is fitted first, and most searches from the best of them.
FIRST_LOAD_ROWS, MAX_LOAD_SEARCHES = 7, 4
#: Smallest saturation limit and largest dead zone that are tried, as shares of the largest value of an input.
MIN_SATURATION_SHARE, MAX_DEAD_SHARE = 0.05, 0.9
#: First values of a saturation or dead zone, as shares of the largest value of an input.
LIMIT_STARTS = (0.25, 0.6)
#: Name of the coefficient of the square of an input.
SQUARE_NAME = "square"
#: Difference of an estimated delay from the one of the structure, in standard errors, from which on it is reported.
DELAY_SIGMAS = 3.0


@dataclass(frozen=True)
class Extension:
    """Structure with more dynamics than the fitted one.

    Parameters
    ----------
    code
        Code of the finding that reports it.
    structure
        The extended structure.
    parameters
        Number of additional parameters.
    inputs
        Inputs of what is added.
    starts
        Initial guesses; None stands for the automatic ones.
    terms
        Additional terms, as text.
    runs
        Runs with an additional input; None for the given ones.
    time
        Time from which on the additional input acts [s].
    """

    code: str
    structure: Structure
    parameters: int
    inputs: Sequence[str]
    starts: Sequence[Mapping[str, float] | None] = (None,)
    terms: str = ""
    runs: Runs | None = None
    time: float = 0.0


@dataclass(frozen=True)
class FittedExtension:
    """Extension with its fit and the criterion of one-step predictions of its residuals."""

    extension: Extension
    fit: JointFit
    criterion: float


def extension_findings(fit: Fit, tests: Residuals) -> list[Finding]:
    """Return a finding on the extension whose residuals are best predicted from their own past, if clearly better.

    Colored noise and a response that the structure lacks look alike in the residuals, but noise has the same one-step
    prediction error beside every structure: the innovations of an autoregression of the residuals. An extension lowers
    it if the residuals contain a response to the inputs.
    """
    joint, structure, runs = fit.joint, fit.task.structure, as_runs(fit.task.runs)
    colored = any(not o.whiteness.passed for o in tests.outputs.values())
    single = len(structure.equations) == 1 and structure.is_linear and not structure.has_friction
    if joint is None or not colored or not single or structure.coefficient_law or structure.free_inputs:
        return []
    (equation,) = structure.equations
    names = tuple(n for n in runs[0].inputs if n in equation.signals)
    if not names:
        return []
    own = _prediction_criterion(joint, 0)
    best = _best_extension(_extensions(structure, joint, runs, names), joint, runs, own)
    load = _load_step(equation, structure, joint, runs)
    best = best if load is None else _best_extension([load], joint, runs, own, best)
    if best is None or best.criterion > own - MIN_CRITERION_DECREASE:
        return []
    extension, refit = best.extension, best.fit
    about = {"run": ", ".join(r.name for r in runs), "output": equation.output}
    if not _is_sufficient(best, runs):
        return [make_finding("dynamics_missing", input=join_names(names), **about)]
    if extension.code == "delay_fits":
        return _delay_findings(extension, refit, structure, min(r.step for r in runs), about)
    numbers: dict[str, float] = {}
    if extension.runs is not None:
        numbers = {
            "time": extension.time,
            "value": refit.coefficients[LOAD_NAME],
            "error": refit.standard_errors[LOAD_NAME],
        }
    limits = {n: v for n, v in refit.inputs.items() if n not in joint.inputs}
    if limits:
        ((name, value),) = limits.items()
        numbers = {"value": value, "error": refit.standard_errors[name], "low": 0.5 * value, "high": 2.0 * value}
        about["parameter"] = name
    shown = join_names(extension.inputs)
    return [make_finding(extension.code, input=shown, term=extension.terms, **about, **numbers)]


def _best_extension(
    extensions: Sequence[Extension], joint: JointFit, runs: Runs, own: float, best: FittedExtension | None = None
) -> FittedExtension | None:
    """Return the fit of the extension with the least criterion, if that is below `own` and clearly below `best`."""
    for extension in extensions:
        there = extension.runs or runs
        asked = replace(extension.structure, initial=joint.initial)
        try:
            fits = [fit_output_error(there, asked, start=start, refine=False) for start in extension.starts]
        except FtlmError:
            continue
        refit = min(fits, key=log_noise)
        criterion = _prediction_criterion(refit, extension.parameters)
        if refit.unstable_optimum is None and criterion < (own if best is None else best.criterion - STRONG_EVIDENCE):
            best = FittedExtension(replace(extension, structure=asked), refit, criterion)
    return best


def log_noise(joint: JointFit) -> float:
    """Return the sum over outputs of the logarithm of the residuals' root mean square."""
    return sum(math.log(max(v, 1e-300)) for v in joint.noise.values())


def _delay_findings(
    extension: Extension, refit: JointFit, structure: Structure, step: float, about: Mapping[str, str]
) -> list[Finding]:
    """Return a finding on each significant delay or lead of an input."""
    findings = []
    for name in extension.inputs:
        key = input_name("delay", name)
        value, error = refit.values_by_name[key], refit.standard_errors[key]
        if abs(value - structure.delay.get(name, 0.0)) > DELAY_SIGMAS * error:
            numbers = {"value": abs(value), "error": error, "rows": abs(value) / step, "longest": 2.0 * abs(value)}
            code = "delay_fits" if value > 0.0 else "lead_fits"
            findings.append(make_finding(code, input=name, **about, **numbers))
    return findings


def _extensions(structure: Structure, joint: JointFit, runs: Runs, names: Sequence[str]) -> list[Extension]:
    """Return the extensions of a structure of one equation, those that are preferred first."""
    (equation,) = structure.equations
    longest, step = min(longest_delay(r.length, r.step) for r in runs), min(r.step for r in runs)
    given = {n: structure.delay.get(n, 0.0) for n in names}
    late = structure.with_delays({n: (-step, max(longest, 2.0 * d)) for n, d in given.items()})
    begin = {**joint.values_by_name, **{input_name("delay", n): d for n, d in given.items()}}
    found: list[Extension] = []

    def add(code: str, make: Callable[[], Structure], count: int, inputs: Sequence[str], **more: Any) -> None:
        # What the structure cannot be extended by, such as orders that no input may have beside a square, is left out.
        with contextlib.suppress(FtlmError):
            found.append(Extension(code, make(), count, inputs, **more))

    def with_equation(item: Equation) -> Structure:
        return replace(structure, equations=(item,))

    lagged = _with_lag(equation)
    add("lag_fits", lambda: with_equation(lagged), 1, names)
    add("delay_fits", lambda: late, len(names), names, starts=[None, begin])
    more = [_next_derivative(equation, name, k) for k, name in enumerate(names)]
    shown = " + ".join(f"{t.coefficient} D^{t.order} {t.signal}" for t in more)
    for code, item, limit in (("zero_fits", equation, equation.order), ("mode_fits", lagged, lagged.order)):
        if all(t.order.weights == () and limit.weights == () and t.order.constant <= limit.constant for t in more):
            wider = replace(item, terms=(*item.terms, *more))
            add(code, partial(with_equation, wider), len(more) + (item is lagged), names, terms=shown)
    known = joint.values_by_name
    for name in names if not structure.limits and not structure.delay else ():
        largest = max(float(np.nanmax(np.abs(run[name]))) for run in runs)
        ends = {"saturation": (MIN_SATURATION_SHARE * largest, largest), "dead_zone": (0.0, MAX_DEAD_SHARE * largest)}
        effects: tuple[InputEffect, InputEffect] = ("saturation", "dead_zone")
        for effect in effects:
            starts = [{**known, input_name(effect, name): share * largest} for share in LIMIT_STARTS]
            limits = {effect: {name: ends[effect]}}
            add(f"{effect}_fits", partial(structure.with_limits, **limits), 1, [name], starts=starts)
        square = Term(name, Order(0.0), SQUARE_NAME, expression=power(channel(name), 2.0))
        curved = replace(equation, terms=(*equation.terms, square))
        flat = {**known, SQUARE_NAME: 0.0}
        add("gain_varies", partial(with_equation, curved), 1, [name], starts=[flat], terms=f"k {name}^2")
    return found


def _load_step(item: Equation, structure: Structure, joint: JointFit, runs: Runs) -> Extension | None:
    """Return the structure with a constant load from some row on; None if the runs cannot have one.

    Fits with loads from few rows on give a model near the plant. The row is that at which its response to a load
    explains most of the residuals, searched again with the model that is fitted then.
    """
    (run, *others) = runs
    if others or run.sample_times is not None or LOAD_NAME in run or LOAD_NAME in structure.coefficient_names:
        return None
    wider = replace(structure, equations=(replace(item, terms=(*item.terms, Term(LOAD_NAME, Order(0.0), LOAD_NAME))),))
    size = run.length

    def fit_at(row: int, near: JointFit) -> JointFit:
        loaded = _with_input(run, LOAD_NAME, np.where(np.arange(size) >= row, 1.0, 0.0))
        start = {LOAD_NAME: 0.0, **near.values_by_name}
        return fit_output_error([loaded], replace(wider, initial=joint.initial), start=start, refine=False)

    def search(fitted: JointFit, row: int) -> tuple[float, int]:
        for _ in range(MAX_LOAD_SEARCHES):
            response = _load_response(item, structure, fitted, run)
            residuals = fitted.noise[item.output] * fitted.residuals[0][item.output]
            if row:
                residuals[row - 1 :] += fitted.coefficients[LOAD_NAME] * response[: size - 1 - row]
            found = _load_row(residuals, response)
            if found is None or found == row:
                break
            fitted, row = fit_at(found, fitted), found
        return (fitted.noise[item.output] if row else math.inf), row

    try:
        rows = np.linspace(0, size, FIRST_LOAD_ROWS + 2).astype(int)[1:-1]
        best = min(((fit_at(int(k), joint), int(k)) for k in rows), key=lambda pair: pair[0].noise[item.output])
        noise, row = min(search(joint, 0), search(*best))
    except FtlmError:
        return None
    if not math.isfinite(noise):
        return None
    loaded = _with_input(run, LOAD_NAME, np.where(np.arange(size) >= row, 1.0, 0.0))
    starts = [None, {LOAD_NAME: 0.0, **joint.values_by_name}]
    return Extension("load_steps", wider, 2, [LOAD_NAME], starts, runs=as_runs(loaded), time=run.start + row * run.step)


def _with_input(run: Run, name: str, values: Floats) -> Run:
    """Return a run with an additional held input."""
    return Run.from_arrays(
        step=run.step,
        inputs={**{n: run[n] for n in run.inputs}, name: values},
        outputs={n: run[n] for n in run.outputs},
        intersample={**run.intersample, name: "zoh"},
        name=run.name,
        missing="weight",
    )


def _load_response(item: Equation, structure: Structure, joint: JointFit, run: Run) -> Floats:
    """Return the response of a fitted model to a constant load from row 0 on, at rows 1 to N - 1."""
    own = (t for t in item.terms if t.signal == item.output)
    alone = replace(item, terms=(*own, Term(LOAD_NAME, Order(0.0), 1.0)))
    known = replace(structure, equations=(alone,), delay={}, free_delays={}, initial="rest", offset="none")
    values = joint.values_by_name
    known = known.with_orders({n: values[n] for n in known.order_names})
    model = Model(known.with_coefficients({n: values[n] for n in known.coefficient_names}))
    ones, zeros = np.ones(run.length), np.zeros(run.length)
    return simulate(model, Run.from_arrays(step=run.step, inputs={LOAD_NAME: ones}, outputs={item.output: zeros}))[
        item.output
    ][1:]


def _load_row(residuals: Floats, response: Floats) -> int | None:
    """Return the row from which on a load explains most of the residuals of the inner rows of a run."""
    series = np.nan_to_num(residuals)
    here = response[: series.size]
    power, edge = np.cumsum(here**2)[::-1], max(int(MIN_LOAD_SHARE * series.size), 1)
    if not np.all(np.isfinite(here)) or not power[-edge] > 0.0:
        return None
    explained = np.correlate(series, here, "full")[series.size - 1 :] ** 2 / np.maximum(power, 1e-300)
    # A load of row k acts on row k + 1 first, which is number k of the inner rows.
    return edge + int(np.argmax(explained[edge:-edge]))


def _with_lag(item: Equation) -> Equation:
    """Return an equation with a further lag: its order raised by 1, and a term of its former order."""
    raised = Order(item.order.constant + 1.0, item.order.weights)
    return replace(item, order=raised, terms=(Term(item.output, item.order, "lag"), *item.terms))


def _next_derivative(item: Equation, name: str, number: int) -> Term:
    """Return a term of an input whose order is 1 above the highest one of this input."""
    highest = max((t.order for t in item.terms if t.signal == name), key=lambda order: order.constant)
    return Term(name, Order(highest.constant + 1.0, highest.weights), f"zero{number or ''}")


def _prediction_criterion(joint: JointFit, more: int) -> float:
    """Return the Schwarz criterion of one-step predictions of the residuals from their own past."""
    total = 0.0
    for name in joint.noise:
        series = [joint.noise[name] * part[name] for part in joint.residuals]
        _, _, innovations, parameters = _core.arx_model(series, [], DEFAULT_LAGS)
        left = np.concatenate(innovations)
        rows = int(np.isfinite(left).sum())
        power = float(np.nanmean(left**2)) if rows else math.nan
        if not power > 0.0:
            return math.inf
        total += rows * math.log(power) + (parameters + more) * math.log(rows)
    return total


def _is_sufficient(fitted: FittedExtension, given: Runs) -> bool:
    """Whether the residuals of a fit depend neither on an input nor on the direction of motion."""
    structure, joint, runs = fitted.extension.structure, fitted.fit, fitted.extension.runs or given
    model = fitted_model(joint, structure)
    try:
        tests = run_residual_tests(
            model,
            runs,
            simulate_runs(model, runs),
            lags=DEFAULT_LAGS,
            sensitivities=lambda: output_sensitivities(runs, structure, joint.values_by_name, max(joint.refinement, 1)),
        )
    except FtlmError:
        return False
    outputs = tests.outputs.values()
    failed = any(t.failed for o in outputs for t in o.inputs.values())
    return not failed and not any(o.follows_direction for o in outputs)
