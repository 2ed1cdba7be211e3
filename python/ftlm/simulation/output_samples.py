"""Simulation of output samples, and the choice of the initial conditions of a run by them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from ftlm import _core
from ftlm.data.run import Run
from ftlm.data.sampling import drop_missing
from ftlm.errors import FtlmError, ModelError
from ftlm.model.model import Model
from ftlm.simulation.discretization import (
    compared_times,
    compared_values,
    derived_signals,
    has_nonuniform_samples,
    initial_tuple,
    linear_tuple,
    record,
    recording,
    without_level,
)
from ftlm.simulation.initial_conditions import (
    deviations,
    has_memory,
    history,
    huber_loss_excess,
    needs_history,
    output_residuals,
    resolve_initial_conditions,
    resolve_start,
    rest_evidence,
)
from ftlm.simulation.nonlinear_columns import record_signals
from ftlm.structure.equation import Equation, Friction
from ftlm.structure.structure import History, Initial, Offset, Structure, offset_exponents
from ftlm.utils.resources import stop_flag
from ftlm.utils.statistics import chi_squared, variance_inflation
from ftlm.utils.validation import Floats

#: Initial number of block pulses per sampling interval, which is doubled until convergence. Two pulses are the minimum
#: for a sample that is independent of a jump of a zero-order-hold input at its time.
FIRST_REFINEMENT = 2
#: Number of block pulses per sampling interval for the fit of initial terms with friction or non-linear terms. The
#: relative error is a few 1e-5.
INITIAL_STATE_REFINEMENT = 4
#: Difference below which two orders count as equal.
ORDER_TOLERANCE = 1e-9
#: Difference of the exponents of an initial term and an offset below which they are not separately identifiable. For
#: example, an order of 1.0003 gives an initial term t^1, which acts almost like a constant force.
OFFSET_POWER_TOLERANCE = 0.05
Terms = Mapping[str, Mapping[float, float]]
#: Key of the level of an output among its initial terms. It is the last key, and not an exponent of t.
LEVEL_EXPONENT = math.inf


@dataclass(frozen=True)
class OutputSamples:
    """Samples of the simulated outputs of a model on one run.

    Parameters
    ----------
    outputs
        Samples of shape (outputs, N) at the sample times of the run. The sensor filter is applied to outputs that were
        measured through it. Samples are not finite if the model diverges.
    initial
        Coefficients of the initial terms, by output and exponent.
    refinement
        Number of block pulses per sampling interval at the smallest step; 1 for an exact simulation.
    change
        For each output, the change of its samples in the last halving of the step, relative to its largest value;
        infinite with fewer than three steps.
    """

    outputs: Floats
    initial: dict[str, dict[float, float]]
    refinement: int
    change: Floats


def initial_exponents(equation: Equation, initial: Initial, offset: Offset, states: int = 0) -> list[float]:
    """Return the distinct exponents e of the powers t^e that enter an equation, sorted from lowest to highest.

    The powers are the initial terms and the offset. `states` initial states of a sensor filter are represented by the
    exponents -1, -2 and so on. All orders must be fixed.
    """
    alpha = equation.order.constant
    exponents = {round(e, 9) for e in offset_exponents(alpha, offset).values()} | {-1.0 - k for k in range(states)}
    if initial != "caputo":
        return sorted(exponents | ({round(e, 9) for e in initial} if not isinstance(initial, str) else set()))
    offsets: set[float] = set()
    for lowest, order in [(0.0, alpha), *((alpha - t.order.constant, t.order.constant) for t in equation.terms)]:
        offsets |= {round(lowest + i, 9) for i in range(math.ceil(order - ORDER_TOLERANCE))}
    return sorted(
        exponents | {e for e in offsets if e == 0.0 or all(abs(e - o) > OFFSET_POWER_TOLERANCE for o in exponents)}
    )


def nonuniform_sample_times(model: Model, run: Run) -> Floats | None:
    """Return the times [s] at which simulation and run are compared if they are nonuniform, otherwise None."""
    return compared_times(run, model.structure) if has_nonuniform_samples(run, model.structure) else None


#: Initial terms for Rust: whether their coefficients are fitted, (exponent, coefficient) pairs for each output, and
#: whether levels are fitted.
InitialTermsTuple: TypeAlias = tuple[bool, list[list[tuple[float, float]]], bool]


def output_simulation(
    model: Model, run: Run, initial: Terms | None, times: Floats | None, state_refinement: int
) -> tuple[_core.OutputSimulation, InitialTermsTuple]:
    """Return the simulation object of the Rust core for a model and a run, and the initial terms for it.

    Samples are at the uniform sample times of the run, or at given `times` [s]. `initial` are given initial terms; with
    None, they are fitted to the run. For a non-linear model they are fitted here, with `state_refinement` block pulses
    per sampling interval.
    """
    structure, signals = model.structure, record_signals(model.structure)
    start = resolve_initial_conditions(run, structure)
    run, run_without_level = without_level(run, structure)
    frictions = [(i, (model.equations[i].friction or Friction(0.0)).law) for i in structure.friction_equations]
    equations = [(linear_tuple(e, signals), [float(t.fixed_value or 0.0) for t in e.terms]) for e in model.equations]
    core = _core.OutputSimulation(
        recording(run, run_without_level, start), equations, frictions, times, derived_signals(structure)
    )
    if initial is not None:
        return core, (False, [list(initial.get(o, {}).items()) for o in model.outputs], False)
    if not structure.is_linear:
        states = initial_tuple(start, structure.offset, run_without_level.filter_states(start))
        return core, (False, core.fit_initial_states(states, state_refinement, stop_flag()), False)
    names = initial_names(model, start)
    exponents = [[(power, 0.0) for output, power in names if output == o] for o in model.outputs]
    return core, (True, exponents, structure.offset == "level")


def simulate_samples(
    model: Model, run: Run, pulses_per_sample: int, initial: Terms | None, times: Floats | None = None
) -> tuple[Floats, dict[str, dict[float, float]]]:
    """Return simulated samples, shape (outputs, N), and coefficients of initial terms by output and exponent.

    Samples are at the uniform sample times of the run, or at given `times` [s]. They are not finite if the simulation
    diverges. The simulation uses `pulses_per_sample` block pulses per sampling interval. `initial` are given initial
    terms; with None, they are fitted to the run.
    """
    core, terms = output_simulation(model, run, initial, times, pulses_per_sample)
    samples, initial_terms = core.samples(pulses_per_sample, terms, stop_flag())
    if initial is not None or model.structure.offset != "level":
        return samples, named_terms(model, initial_terms)
    return add_levels(model, deviations(run, model.structure)[1], samples, named_terms(model, initial_terms))


def add_levels(
    model: Model, levels: Mapping[str, float], outputs: Floats, initial: Terms
) -> tuple[Floats, dict[str, dict[float, float]]]:
    """Add the levels that the outputs had before the run to samples and initial terms, and return both.

    `outputs` and `initial` are deviations from these levels.
    """
    terms = {
        o: {e: v + levels[o] * (e == LEVEL_EXPONENT) for e, v in coefficients_by_exponent.items()}
        for o, coefficients_by_exponent in initial.items()
    }
    return outputs + np.array([levels[o] for o in model.outputs])[:, None], terms


def named_terms(model: Model, terms: Sequence[Sequence[tuple[float, float]]]) -> dict[str, dict[float, float]]:
    """Return initial terms, given as (exponent, coefficient) pairs for each output, by output and exponent."""
    return {o: dict(coefficients_by_exponent) for o, coefficients_by_exponent in zip(model.outputs, terms, strict=True)}


def with_initial_conditions(model: Model, run: Run) -> Model:
    """Return the model with initial conditions for a run.

    For a run in motion, ``"auto"`` becomes a history (powers of t for past inputs) if the samples require it, otherwise
    Caputo's initial values.
    """
    model = replace(model, structure=resolve_start([run], model.structure))
    start = resolve_initial_conditions(run, model.structure)
    long = replace(model, structure=replace(model.structure, initial=start))
    if model.structure.initial != "auto" or not isinstance(start, History):
        return long
    short = replace(model, structure=replace(model.structure, initial="caputo"))
    try:
        outputs = measured_samples(model, run, FIRST_REFINEMENT)
        times = nonuniform_sample_times(model, run)
        (short_samples, short_terms), (long_samples, long_terms) = (
            simulate_samples(model_variant, run, FIRST_REFINEMENT, None, times) for model_variant in (short, long)
        )
    except ModelError:
        # The equations are singular on this coarse grid, but may be regular on finer grids.
        return long
    terms = sum(map(len, short_terms.values())), sum(map(len, long_terms.values()))
    residuals = [*output_residuals(outputs, short_samples)], [*output_residuals(outputs, long_samples)]
    output_deviations = np.nanstd(outputs, axis=1).tolist()
    return long if needs_history(model.structure, *residuals, output_deviations, terms) else short


def initial_names(model: Model, initial: Initial) -> list[tuple[str, float]]:
    """Return the (output, exponent) pairs of all initial terms and offsets for given initial conditions."""
    structure = model.structure
    states = structure.filter_states(initial)
    return [
        (e.output, power)
        for e in model.equations
        for power in initial_exponents(
            e, initial, structure.offset, states if structure.has_filter_transient(e.output) else 0
        )
    ]


def measured_samples(model: Model, run: Run, pulses_per_sample: int) -> Floats:
    """Return the measured samples to compare with a simulation, shape (outputs, N), with NaN for missing samples.

    If the equations apply to filtered signals, the sensor filter is applied to outputs that were not measured through
    it, with `pulses_per_sample` block pulses per sampling interval.
    """
    is_filtered = model.structure.is_filtered
    if not model.structure.all_filtered or all(map(is_filtered, model.outputs)):
        return np.stack([compared_values(run, model.structure, name) for name in model.outputs])
    rec = record(run, model.structure, (run.length - 1) * pulses_per_sample)
    return np.stack(
        [run[n] if is_filtered(n) else _core.point_samples(rec.of(n))[::pulses_per_sample] for n in model.outputs]
    )


#: Significance level of the test of rest for runs whose first values are near zero. Such values are rare for runs in
#: motion and common for runs from rest. A level of 0.001 misses initial conditions that bias orders by five standard
#: errors, and a level of 0.05 rejects one in twenty runs from rest.
REST_TEST_LEVEL = 0.01


#: Maximum number of first samples of a run with which its initial conditions are tested. Effects of past inputs decay.
MAX_START_SAMPLES = 1 << 15


#: Limits for a report of nonzero initial conditions, for root-mean-square residuals in units of the standard deviation
#: of the output. The ratio of the residuals with a history and from rest must be at most the first limit, and their
#: difference at least the second. The residual with a history must be at most the third limit, and the residual from
#: rest at most the fourth.
MAX_RESIDUAL_RATIO, MIN_RESIDUAL_DROP, MAX_HISTORY_RESIDUAL, MAX_REST_RESIDUAL = 0.5, 0.01, 0.2, 3.0


@dataclass(frozen=True)
class StartResiduals:
    """Residuals of a run simulated from rest and with a history (initial terms for past inputs), shape (outputs, N).

    `terms` is the number of initial terms of the history, and `deviations` has the standard deviations of the outputs.
    """

    from_rest: Floats
    with_history: Floats
    terms: int
    deviations: Floats


def is_in_motion(structure: Structure, runs: Sequence[Run]) -> bool:
    """Whether all runs together require initial terms for past inputs (a history) in place of a start from rest.

    The result is False if a run cannot be simulated.
    """
    residuals = []
    for run in runs:
        if (run_residuals := _start_residuals(structure, run)) is None:
            return False
        residuals.append(run_residuals)
    return _requires_history(residuals)


def _requires_history(residuals: Sequence[StartResiduals]) -> bool:
    """Whether a chi-squared test over all runs requires initial terms for past inputs (a history)."""
    terms = sum(run_residuals.terms for run_residuals in residuals)
    excess = sum(
        huber_loss_excess([*run_residuals.from_rest], [*run_residuals.with_history], run_residuals.deviations.tolist())
        for run_residuals in residuals
    )
    # Slow initial terms can fit colored noise in any run, so the excess is reduced by the variance inflation.
    inflation = max(
        [
            1.0,
            *(
                variance_inflation(drop_missing(series))
                for run_residuals in residuals
                for series in run_residuals.with_history
            ),
        ]
    )
    return terms > 0 and excess / inflation > chi_squared(terms, REST_TEST_LEVEL)


def _start_residuals(structure: Structure, run: Run) -> StartResiduals | None:
    """Return the residuals of the first samples of a run from rest and with a history; None if they are infinite."""
    if run.length > MAX_START_SAMPLES:
        run = run.window(None, MAX_START_SAMPLES * run.step)
    series, terms = [], 0
    for start in ("rest", history(run, structure)):
        model = Model(replace(structure, initial=start))
        try:
            samples, initial_terms = simulate_samples(
                model, run, FIRST_REFINEMENT, None, nonuniform_sample_times(model, run)
            )
        except FtlmError:
            return None
        if not np.all(np.isfinite(samples)):
            return None
        series.append(output_residuals(measured_samples(model, run, FIRST_REFINEMENT), samples))
        terms = sum(map(len, initial_terms.values()))
    return StartResiduals(series[0], series[1], terms, np.nanstd([run[o] for o in structure.outputs], axis=1))


def runs_in_motion(model: Model, runs: Sequence[Run]) -> list[str]:
    """Return the names of the runs that start near zero although their samples require nonzero initial conditions."""
    structure = model.structure
    if structure.initial != "auto" or not structure.is_linear or not has_memory(structure):
        return []
    candidates = (
        (run.name, _start_residuals(structure, run))
        for run in runs
        if rest_evidence(run, structure) is None and resolve_initial_conditions(run, structure) == "rest"
    )
    return [
        name
        for name, residuals in candidates
        if residuals is not None and _is_reportable(residuals) and _requires_history([residuals])
    ]


def _is_reportable(residuals: StartResiduals) -> bool:
    """Whether terms for past inputs reduce the residuals so much that nonzero initial conditions are reported."""
    # Overflows give infinity. If both values are infinite, there is no finding.
    with np.errstate(over="ignore", invalid="ignore"):
        normalized = [
            series / residuals.deviations[:, None] for series in (residuals.from_rest, residuals.with_history)
        ]
        rest_rms, history_rms = (np.sqrt(np.nanmean(series**2, axis=1)) for series in normalized)
        large = (history_rms <= MAX_RESIDUAL_RATIO * rest_rms) & (rest_rms - history_rms >= MIN_RESIDUAL_DROP)
    return bool(np.any(large & (history_rms <= MAX_HISTORY_RESIDUAL) & (rest_rms <= MAX_REST_RESIDUAL)))
