"""Simulation with a step that is refined until the samples converge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ftlm import _core
from ftlm.data.run import Run
from ftlm.model.model import Model
from ftlm.simulation.discretization import MAX_M, has_nonuniform_samples
from ftlm.simulation.initial_conditions import (
    conditions_in_motion,
    deviations,
    resolve_initial_conditions,
    resolve_start,
    start_score,
)
from ftlm.simulation.output_samples import (
    INITIAL_STATE_REFINEMENT,
    LEVEL_EXPONENT,
    InitialTermsTuple,
    OutputSamples,
    Terms,
    add_levels,
    initial_names,
    measured_samples,
    named_terms,
    nonuniform_sample_times,
    output_simulation,
    with_initial_conditions,
)
from ftlm.structure.structure import History
from ftlm.utils.resources import memory_limit, stop_flag
from ftlm.utils.validation import Floats

#: Minimum number of intervals of a long record. Below it, refinement of the whole grid costs no more.
LONG_RECORD_INTERVALS = 1 << 14
#: Change on halving the step at which the refinement of a response to past inputs terminates, relative to its largest
#: value.
RESPONSE_CHANGE = 1e-5


def simulate_refined(
    model: Model, run: Run, initial: Terms | None, *, tolerance: float, max_m: int = MAX_M, on_grid: bool = False
) -> OutputSamples:
    """Simulate a model with successively halved steps and Richardson extrapolation until the samples converge.

    The refinement also ends at `max_m` block pulses. Models of integer orders with uniform samples are simulated
    exactly; see :func:`exact_samples`.

    Parameters
    ----------
    initial
        Coefficients of initial terms by output and exponent. With None, they are fitted to the measured outputs, which
        are weighted by their inverse standard deviations.
    tolerance
        Change, relative to the largest value of each output, at which the refinement terminates.
    on_grid
        Whether samples are simulated at the uniform sample times even if the run is compared at nonuniform times.
    """
    if initial is not None:
        return _simulate_refined(model, run, initial, tolerance, max_m, on_grid)
    model = replace(model, structure=resolve_start([run], model.structure))
    if model.structure.offset != "level":
        return _simulate_refined(model, run, None, tolerance, max_m, on_grid)
    shifted, levels = deviations(run, model.structure)
    result = None
    if model.structure.initial == "auto":
        # A run without evidence of rest may still start from rest at a nonzero level.
        rest_model = replace(model, structure=replace(model.structure, initial="rest"))
        result = _simulate_refined(rest_model, shifted, None, tolerance, max_m, on_grid)
        model = replace(model, structure=replace(model.structure, initial=conditions_in_motion(model.structure)))
    # White residuals are no evidence of rest: the response to initial values may end within a few samples.
    free = _simulate_refined(model, shifted, None, tolerance, max_m, on_grid)
    result = free if result is None or not _explains_as_well(model, shifted, result, free) else result
    outputs, terms = add_levels(model, levels, result.outputs, result.initial)
    return replace(result, outputs=outputs, initial=terms)


def _residuals(model: Model, run: Run, simulated: OutputSamples) -> list[Floats]:
    """Return measured minus simulated samples of each output."""
    return [*(measured_samples(model, run, simulated.refinement) - simulated.outputs)]


def _explains_as_well(model: Model, run: Run, short_samples: OutputSamples, long_samples: OutputSamples) -> bool:
    """Whether :func:`start_score` of a simulation with few initial terms is at most that of one with many terms."""
    if not (np.all(np.isfinite(short_samples.outputs)) and np.all(np.isfinite(long_samples.outputs))):
        return False
    residuals = [_residuals(model, run, s) for s in (short_samples, long_samples)]
    scores = [
        start_score(series, sum(map(len, s.initial.values())), residuals[0])
        for series, s in zip(residuals, (short_samples, long_samples), strict=True)
    ]
    return scores[0] <= scores[1]


def _simulate_refined(
    model: Model, run: Run, initial: Terms | None, tolerance: float, max_m: int, on_grid: bool
) -> OutputSamples:
    """Simulate as :func:`simulate_refined`, for a run from which any known level is already subtracted.

    A level that is fitted as an initial term is added to the samples.
    """
    if initial is None and model.structure.is_linear:
        model = with_initial_conditions(model, run)
    times = (
        run.time if on_grid and has_nonuniform_samples(run, model.structure) else nonuniform_sample_times(model, run)
    )
    core, terms = output_simulation(model, run, initial, times, INITIAL_STATE_REFINEMENT)
    exact_outputs = exact_samples(core, terms)
    if exact_outputs is not None:
        return OutputSamples(exact_outputs[0], named_terms(model, exact_outputs[1]), 1, np.zeros(len(model.outputs)))
    if initial is None and isinstance(resolve_initial_conditions(run, model.structure), History):
        terms = _fit_past_inputs(core, model, terms, max_m) or terms
    # The core takes only powers of time as initial terms; levels are added to its result.
    levels = {
        o: dict(exponent_values).get(LEVEL_EXPONENT, 0.0)
        for o, exponent_values in zip(model.outputs, terms[1], strict=True)
    }
    powers = (
        terms[0],
        [[term for term in exponent_values if term[0] != LEVEL_EXPONENT] for exponent_values in terms[1]],
        terms[2],
    )
    (outputs, initial_values), refinement, change = core.refine(
        powers, tolerance, max_m, LONG_RECORD_INTERVALS, memory_limit(), stop_flag()
    )
    if not any(levels.values()):
        return OutputSamples(outputs, named_terms(model, initial_values), refinement, change)
    initial_terms = {
        o: {**exponent_values, LEVEL_EXPONENT: 0.0} for o, exponent_values in named_terms(model, initial_values).items()
    }
    return OutputSamples(*add_levels(model, levels, outputs, initial_terms), refinement, change)


def _fit_past_inputs(
    core: _core.OutputSimulation, model: Model, terms: InitialTermsTuple, max_m: int
) -> InitialTermsTuple | None:
    """Return initial terms that represent past inputs, under a prior on these inputs; None if a response is not finite.

    Only the exponents of `terms` are used. Initial values by Caputo's definition have no prior.
    """
    names = initial_names(model, "caputo")
    free = [[exponent for output, exponent in names if output == o] for o in model.outputs]
    exponents = [
        sorted({*free_exponents, *(e for e, _ in terms_of_output)})
        for free_exponents, terms_of_output in zip(free, terms[1], strict=True)
    ]
    history = core.fit_past_inputs(
        exponents, free, terms[2], RESPONSE_CHANGE, max_m, LONG_RECORD_INTERVALS, memory_limit(), stop_flag()
    )
    return None if history is None else (False, history, False)


def exact_samples(
    core: _core.OutputSimulation, terms: InitialTermsTuple
) -> tuple[Floats, list[list[tuple[float, float]]]] | None:
    """Return exact samples (outputs, N) of a model with integer orders, and its initial terms (exponent, coefficient).

    The result is None if the model must be discretized.
    """
    return core.exact_samples(terms, stop_flag())
