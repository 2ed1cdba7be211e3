"""Oracle of the initial terms that represent past inputs: one simulation per response, and NumPy's decompositions.

Before the first sample, each equation has an unknown zero-mean Gaussian input, piecewise constant on octaves of time.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import msgspec
import numpy as np

import ftlm
from ftlm.simulation.output_samples import FIRST_REFINEMENT, initial_names, measured_samples, output_simulation
from ftlm.structure.equation import Term
from ftlm.structure.order import Order

PAST_LENGTHS = 4
SIZES = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0)
LIMITS = (1e-5, 1 << 17, 1 << 30, 1 << 30)
TOLERANCE = 1e-10


def fit_past_inputs(core, model, run, terms, times):
    """Posterior means of the initial terms, as (exponent, coefficient) by equation; `terms` are their names."""
    outputs, count = model.outputs, len(model.outputs)
    free = {(outputs.index(o), e) for o, e in initial_names(model, "caputo")}
    units = sorted(free | {(i, e) for i, own in enumerate(terms[1]) for e, _ in own})
    names = [*units, *((i, math.inf) for i in range(count) if terms[2])]
    past = past_responses(model, run, times)

    def respond(name):
        if name is not None and name[1] == math.inf:
            return driven + np.eye(count)[name[0]][:, None]
        own = [[(name[1], 1.0)] if name and name[0] == i else [] for i in range(count)]
        return core.refine((False, own, False), *LIMITS)[0][0]

    driven = respond(None)
    columns = [respond(name) - driven for name in names]
    measurements = measured_samples(model, run, FIRST_REFINEMENT)
    is_finite = ~np.isnan(measurements)
    weights = 1.0 / np.maximum(np.nanstd(measurements, axis=1), np.finfo(np.float64).tiny)[:, None]
    target, forced = ((weights * rows)[is_finite] for rows in (measurements - driven, driven))
    responses = np.stack([(weights * rows)[is_finite] for rows in columns], axis=1)
    norms = np.linalg.norm(responses, axis=0)
    responses, names = (
        responses[:, norms > 0.0] / norms[norms > 0.0],
        [n for n, v in zip(names, norms, strict=True) if v],
    )
    # Files and simulations know a history as powers of time.
    u, spread, right = np.linalg.svd(responses, full_matrices=False)
    is_significant = spread > TOLERANCE * spread.max(initial=0.0)
    fixed = [k for k, (i, e) in enumerate(names) if (i, e) in free or e == math.inf]
    basis, sizes, _ = np.linalg.svd(responses[:, fixed], full_matrices=False)
    basis = basis[:, sizes > TOLERANCE * sizes.max(initial=0.0)]
    target_left, forced_left = (rows - basis @ (basis.T @ rows) for rows in (target, forced))
    # If no input changes, only the past moves the output.
    size = float(np.mean((forced_left if np.any(driven) else target_left) ** 2))
    mixed = []
    for group in past:
        start = float(np.sum((weights[None] * group[:, :, :1]) ** 2))
        octaves = np.stack([(weights * rows)[is_finite] for rows in group], axis=1)
        along = u[:, is_significant].T @ octaves
        mixed.append(
            (right[is_significant].T / spread[is_significant]) @ along * math.sqrt(size / start if start > 0.0 else 0.0)
        )
    mixing = np.concatenate(mixed, axis=1)
    shapes = responses @ mixing
    shapes -= basis @ (basis.T @ shapes)
    values = mixing @ posterior_mean(shapes, target_left)
    values[fixed] += np.linalg.lstsq(responses[:, fixed], target - responses @ values, rcond=TOLERANCE)[0]
    values /= norms[norms > 0.0]
    history = [[] for _ in outputs]
    for (i, exponent), value in zip(names, values.tolist(), strict=True):
        history[i].append((exponent, value))
    return history


def posterior_mean(shapes, target):
    """Posterior mean of coefficients under the normal prior of greatest likelihood; the rest is noise."""
    u, spread, right = np.linalg.svd(shapes, full_matrices=False)
    along = u.T @ target
    noise = target - u @ along
    variance = float(np.mean(noise**2)) * inflation(noise)
    best, means = math.inf, np.zeros(shapes.shape[1])
    for size in SIZES:
        power = (size * spread) ** 2
        cost = float(np.sum(along**2 / (variance + power) + np.log1p(power / variance)))
        if cost < best:
            best, means = cost, right.T @ (size**2 * spread * along / (variance + power))
    return means


def inflation(series):
    """Variance of the mean relative to white noise, by Bartlett's window."""
    lags = int(4 * series.size ** (1.0 / 3.0))
    x = series - np.mean(series)
    correlations = np.array([x[k:] @ x[: x.size - k] for k in range(1, lags)]) / (x @ x)
    return max(1.0, 1.0 + 2.0 * float((1.0 - np.arange(1, lags) / lags) @ correlations))


def past_responses(model, run, times):
    """Responses (octaves, outputs, N) to unit inputs at given times, an array for each equation."""
    outputs = model.outputs
    followed = outputs if model.structure.coupling == "simulated" else ()
    forcing = next(n for n in (f"forcing{k}" for k in range(len(outputs) + 1)) if n not in outputs)
    rows, length = run.length, (1 + PAST_LENGTHS) * run.length
    octaves = [0, *(1 << k for k in range((PAST_LENGTHS * rows - 1).bit_length())), PAST_LENGTHS * rows]
    rest = {o: np.zeros(length) for o in outputs}
    longer = ftlm.Run.from_arrays(step=run.step, inputs={forcing: np.ones(length)}, outputs=rest)
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
        step_model = ftlm.Model(replace(structure, input_nonlinearities=msgspec.UNSET, coefficient_law=()))
        core, terms = output_simulation(step_model, longer, {o: {} for o in outputs}, None, FIRST_REFINEMENT)
        steps = core.refine(terms, *LIMITS)[0][0]
        at = times / run.step
        series_of_octaves = [np.stack([np.interp(at + k, np.arange(length), row) for row in steps]) for k in octaves]
        responses.append(np.stack([new - old for old, new in itertools.pairwise(series_of_octaves)]))
    return responses
