"""Initial terms of a run that represent its past inputs, under a Gaussian prior on these inputs.

When a model is compared with a run, initial terms with free coefficients would absorb errors of the model. The prior
prevents this. Before the first sample, each equation has an unknown zero-mean Gaussian input. It is piecewise constant
on octaves of time, over four lengths of the run. Its variance, relative to the model's response to the inputs of the
run, maximizes the marginal likelihood (empirical Bayes). Initial values by Caputo's definition have no prior.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import msgspec
import numpy as np

from ftlm import _core
from ftlm.data.run import Run
from ftlm.errors import FtlmError
from ftlm.model.model import Model
from ftlm.simulation.output_samples import (
    FIRST_REFINEMENT,
    INITIAL_STATE_REFINEMENT,
    LEVEL_EXPONENT,
    InitialTermsTuple,
    initial_names,
    measured_samples,
    output_simulation,
)
from ftlm.structure.equation import Term
from ftlm.structure.order import Order
from ftlm.utils.linalg import (
    column_norms,
    linear_combinations,
    minimum_norm_solution,
    orthonormal,
    projections,
    thin_svd,
)
from ftlm.utils.resources import memory_limit, stop_flag
from ftlm.utils.statistics import variance_inflation
from ftlm.utils.validation import Floats

#: Minimum number of intervals of a long record. Below it, refinement of the whole grid costs no more.
LONG_RECORD_INTERVALS = 1 << 14
#: Length of the past that is modeled, in lengths of the run.
PAST_LENGTHS = 4
#: Sizes of a history to choose from, in units of the root mean square of the response to the run's inputs.
HISTORY_SIZES = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0)
#: Change on halving the step at which the refinement of a response terminates, relative to its largest value.
RESPONSE_CHANGE = 1e-5
#: Singular values of responses, relative to the largest, below which they are rounding.
RESPONSE_TOLERANCE = 1e-10


def fit_history(
    core: _core.OutputSimulation, model: Model, run: Run, terms: InitialTermsTuple, times: Floats, max_m: int
) -> InitialTermsTuple | None:
    """Return the posterior mean of the initial terms that represent past inputs; None if a response is not finite.

    Parameters
    ----------
    core, terms
        Simulation of the run by the core, and the names of the initial terms to fit.
    model, run
        Model and measured run.
    times
        Times of the compared samples [s].
    max_m
        Maximum number of pulses.
    """
    outputs, count = model.outputs, len(model.outputs)
    free = {(outputs.index(o), e) for o, e in initial_names(model, "caputo")}
    units = sorted(free | {(i, e) for i, own in enumerate(terms[1]) for e, _ in own})
    names = [*units, *((i, LEVEL_EXPONENT) for i in range(count) if terms[2])]
    past = _past_responses(model, run, times, max_m)

    def respond(name: tuple[int, float] | None) -> Floats:
        if name is not None and name[1] == LEVEL_EXPONENT:
            return np.asarray(driven + np.eye(count)[name[0]][:, None])
        own: list[list[tuple[float, float]]] = [[(name[1], 1.0)] if name and name[0] == i else [] for i in range(count)]
        return core.refine(
            (False, own, False), RESPONSE_CHANGE, max_m, LONG_RECORD_INTERVALS, memory_limit(), stop_flag()
        )[0][0]

    driven = respond(None)
    columns = [respond(name) - driven for name in names]
    measurements = measured_samples(model, run, FIRST_REFINEMENT)
    if past is None or not all(np.all(np.isfinite(rows)) for rows in (driven, *columns)):
        return None
    is_finite = ~np.isnan(measurements)
    weights = 1.0 / np.maximum(np.nanstd(measurements, axis=1), np.finfo(np.float64).tiny)[:, None]
    target, forced = ((weights * rows)[is_finite] for rows in (measurements - driven, driven))
    responses = np.stack([(weights * rows)[is_finite] for rows in columns], axis=1)
    norms = column_norms(responses)
    responses, names = (
        responses[:, norms > 0.0] / norms[norms > 0.0],
        [n for n, v in zip(names, norms, strict=True) if v],
    )
    # Files and simulations know a history as powers of time.
    u, spread, right = thin_svd(responses)
    is_significant = spread > RESPONSE_TOLERANCE * spread.max(initial=0.0)
    fixed = [k for k, (i, e) in enumerate(names) if (i, e) in free or e == LEVEL_EXPONENT]
    basis = orthonormal(responses[:, fixed], RESPONSE_TOLERANCE)
    target_left, forced_left = (
        rows - linear_combinations(basis, projections(basis, rows)) for rows in (target, forced)
    )
    # If no input changes, only the past moves the output.
    size = float(np.mean((forced_left if np.any(driven) else target_left) ** 2))
    mixed = []
    for group in past:
        start = float(np.sum((weights[None] * group[:, :, :1]) ** 2))
        octaves = np.stack([(weights * rows)[is_finite] for rows in group], axis=1)
        along = np.stack([projections(u[:, is_significant], octave) for octave in octaves.T], axis=1)
        mixed.append(
            (right[is_significant].T / spread[is_significant]) @ along * math.sqrt(size / start if start > 0.0 else 0.0)
        )
    mixing = np.concatenate(mixed, axis=1)
    shapes = linear_combinations(responses, mixing)
    shapes -= linear_combinations(basis, np.einsum("ij,ik->jk", basis, shapes))
    values = mixing @ _posterior_mean(shapes, target_left)
    values[fixed] += minimum_norm_solution(
        responses[:, fixed], target - linear_combinations(responses, values), RESPONSE_TOLERANCE
    )
    values /= norms[norms > 0.0]
    history: list[list[tuple[float, float]]] = [[] for _ in outputs]
    for (i, exponent), value in zip(names, values.tolist(), strict=True):
        history[i].append((exponent, value))
    return False, history, False


def _posterior_mean(shapes: Floats, target: Floats) -> Floats:
    """Return the posterior mean of the coefficients of some signals (shapes) in a target, under a normal prior.

    The standard deviation of the prior maximizes the likelihood. The rest of the target is noise, whose variance is
    increased for autocorrelation.
    """
    u, spread, right = thin_svd(shapes)
    along = projections(u, target)
    noise = target - linear_combinations(u, along)
    variance = float(np.mean(noise**2)) * variance_inflation(noise)
    if not variance > 0.0:
        return right.T @ np.divide(along, spread, out=np.zeros_like(along), where=spread > 0.0)
    best, means = math.inf, np.zeros(shapes.shape[1])
    for size in HISTORY_SIZES:
        power = (size * spread) ** 2
        cost = float(np.sum(along**2 / (variance + power) + np.log1p(power / variance)))
        if cost < best:
            best, means = cost, right.T @ (size**2 * spread * along / (variance + power))
    return means


def _past_responses(model: Model, run: Run, times: Floats, max_m: int) -> list[Floats] | None:
    """Return the responses of all outputs to unit inputs: one per equation and per octave of past time.

    There is one array (octaves, outputs, N) for each equation, at the given times [s]. None if a response is not
    finite.
    """
    outputs = model.outputs
    followed = outputs if model.structure.coupling == "simulated" else ()
    forcing = next(n for n in (f"forcing{k}" for k in range(len(outputs) + 1)) if n not in outputs)
    rows, length = run.length, (1 + PAST_LENGTHS) * run.length
    octaves = [0, *(1 << k for k in range((PAST_LENGTHS * rows - 1).bit_length())), PAST_LENGTHS * rows]
    rest = {o: np.zeros(length) for o in outputs}
    longer = Run.from_arrays(step=run.step, inputs={forcing: np.ones(length)}, outputs=rest)
    responses = []
    for forced in outputs:
        equations = []
        for item in model.equations:
            own = [t for t in item.terms if t.signal in {item.output, *followed}]
            own += [Term(forcing, Order(), 1.0)] if item.output == forced else []
            equations.append(replace(item, terms=tuple(own)))
        sensor, through = model.structure.sensor_filter, tuple(o for o in outputs if model.structure.is_filtered(o))
        sensor = msgspec.structs.replace(sensor, signals=through) if sensor is not None and through else None
        structure = replace(
            model.structure, equations=tuple(equations), initial="rest", offset="none", delay={}, sensor_filter=sensor
        )
        step_model = Model(replace(structure, input_nonlinearities=msgspec.UNSET, coefficient_law=()))
        none: dict[str, dict[float, float]] = {o: {} for o in outputs}
        try:
            core, terms = output_simulation(step_model, longer, none, None, INITIAL_STATE_REFINEMENT)
            exact = core.exact_samples(terms, stop_flag())
            if exact is None:
                steps = core.refine(terms, RESPONSE_CHANGE, max_m, LONG_RECORD_INTERVALS, memory_limit(), stop_flag())[
                    0
                ][0]
            else:
                steps = exact[0]
        except FtlmError:
            return None
        if not np.all(np.isfinite(steps)):
            return None
        at = times / run.step
        series_of_octaves = [np.stack([np.interp(at + k, np.arange(length), row) for row in steps]) for k in octaves]
        responses.append(np.stack([new - old for old, new in itertools.pairwise(series_of_octaves)]))
    return responses
