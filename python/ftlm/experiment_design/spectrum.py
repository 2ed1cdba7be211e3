"""Optimal spectrum of a periodic input, a convex problem whose solution the equivalence theorem certifies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ftlm.analysis.frequency_response import DERIVATIVE_STEP_RATIO, frequency_response, shifted_models
from ftlm.experiment_design.problem import Bounds, Criterion, ModelFit
from ftlm.model.model import Model
from ftlm.utils.validation import Complex, Floats

#: Maximum number of lines of a spectrum. Information changes little between neighboring lines.
MAX_SPECTRAL_LINES = 240
#: Highest line, as a fraction of the sampling frequency.
MAX_FREQUENCY_RATIO = 0.25
#: Maximum number of weight iterations at fixed prices of the limits, and of price updates.
MAX_WEIGHT_ITERATIONS, MAX_PRICE_ITERATIONS = 60, 40
#: Relative gap in precision at which a design counts as optimal.
OPTIMALITY_TOLERANCE = 1e-3


@dataclass(frozen=True)
class SpectralLines:
    """Fisher information, and share of each limit that is used, per unit of power at each spectral line.

    Parameters
    ----------
    frequencies
        Frequencies of the lines [Hz].
    information
        Fisher information, shape (points, parameters, parameters). Points are the lines of the first input, then of the
        next input, each with a mean square equal to the squared peak.
    costs
        Fraction of each squared limit that a point uses, shape (limits, points); limits of inputs come first.
    """

    frequencies: Floats
    information: Floats
    costs: Floats


@dataclass(frozen=True)
class Spectrum:
    """Optimal distribution of power over the spectral lines of the inputs.

    Parameters
    ----------
    lines
        Spectral lines of all inputs.
    power
        Mean square of each point, relative to the squared peak of its input; within all limits.
    score
        Value of the criterion.
    bound
        Upper bound of the criterion over all periodic inputs within the limits.
    """

    lines: SpectralLines
    power: Floats
    score: float
    bound: float

    @property
    def gap(self) -> float:
        """Upper bound of the relative gain in precision that any other spectrum can have."""
        return math.expm1(self.bound - self.score)


def spectral_lines(fit: ModelFit, bounds: Bounds, step: float, rows: int) -> SpectralLines:
    """Return the spectral lines of a run of one period, distributed among inputs so that no two share a line."""
    inputs = fit.inputs
    most = max(int(MAX_FREQUENCY_RATIO * rows), len(inputs) + 1)
    numbers = np.unique(np.round(np.geomspace(1, most, MAX_SPECTRAL_LINES * 4)).astype(np.int64))
    if len(numbers) > MAX_SPECTRAL_LINES:
        numbers = np.unique(np.round(np.geomspace(1, most, MAX_SPECTRAL_LINES)).astype(np.int64))
    frequencies = numbers / (rows * step)
    slopes, gains = _response_sensitivities(fit, 2 * math.pi * frequencies, step)
    peaks = np.array(list(bounds.peaks.values()))
    swings = np.array(list(bounds.output_limits.values()))
    weights = 1.0 / np.array([fit.noise[o] for o in fit.outputs])
    information = (
        np.einsum("oilp,oilq,o->ilpq", slopes, slopes.conj(), weights**2).real * rows * peaks[:, None, None, None] ** 2
    )
    count = len(inputs)
    costs = np.zeros((count + len(swings), count, len(numbers)))
    for k in range(count):
        costs[k, k] = 1.0
    costs[count:] = (np.abs(gains) * peaks[:, None] / swings[:, None, None]) ** 2
    groups = [(k, np.arange(k, len(numbers), count)) for k in range(count)]
    return SpectralLines(
        np.concatenate([frequencies[at] for _, at in groups]),
        np.concatenate([information[k, at] for k, at in groups]),
        np.concatenate([costs[:, k, at] for k, at in groups], axis=1),
    )


def _response_sensitivities(fit: ModelFit, w: Floats, step: float) -> tuple[Complex, Complex]:
    """Return the frequency responses to zero-order-hold inputs, and their derivatives by parameters.

    The derivatives come first and have shape (outputs, inputs, W, parameters).
    """
    hold_response = np.exp(-0.5j * w * step) * np.sinc(w * step / (2 * math.pi))
    gains = frequency_response(fit.model, w)
    coupling = fit.problem.structure.coupling
    own = replace(fit.model, structure=replace(fit.model.structure, coupling=coupling))
    _, coefficients, _ = fit.problem.split(fit.values)
    chain = fit.problem.model_parameter_jacobian(coefficients)
    # The other outputs in an equation are simulated or measured, depending on the coupling.
    drives = (
        gains
        if coupling == "simulated"
        else np.concatenate([gains, np.tile(np.eye(len(fit.inputs))[..., None], w.size)])
    )
    signals = fit.inputs if coupling == "simulated" else (*fit.outputs, *fit.inputs)
    slopes = np.zeros((*gains.shape, len(fit.names)), dtype=np.complex128)
    for k, small, *models in shifted_models(own, np.any(chain != 0, axis=1), DERIVATIVE_STEP_RATIO):
        above, below = (_output_responses(shifted, w, coupling, drives, signals) for shifted in models)
        slopes += ((above - below) / (2 * small))[..., None] * chain[k]
    for place, item in enumerate(fit.problem.inputs, start=len(fit.names) - len(fit.problem.inputs)):
        at = fit.inputs.index(item.signal)
        slopes[:, at, :, place] = -1j * w * gains[:, at]
    return slopes * hold_response[:, None], gains * hold_response


def _output_responses(model: Model, w: Floats, coupling: str, drives: Complex, signals: Sequence[str]) -> Complex:
    """Return the frequency responses of the outputs to the inputs, shape (outputs, inputs, frequencies).

    With measured coupling, other `signals` enter the equations; ``drives`` are their responses to the inputs.
    """
    if coupling == "simulated":
        return frequency_response(model, w)
    alone = frequency_response(model, w, coupling="measured")
    from_signals = [s for s in model.structure.signals if s in signals]
    read = [t.signal for e in model.equations for t in e.terms if t.signal != e.output]
    inputs = [s for s in from_signals if s in read]
    return np.asarray(np.einsum("osw,siw->oiw", alone, drives[[list(signals).index(s) for s in inputs]]))


def best_spectrum(lines: SpectralLines, criterion: Criterion) -> Spectrum:
    """Return the spectrum with the optimal power of each line under all limits.

    Each limit has a dual variable (price). With fixed prices, the problem is an optimization of weights that sum to
    one, solved by Titterington's multiplicative algorithm (Silvey, Titterington & Torsney, 1978). For any prices, its
    optimum is an upper bound of the original problem. The equivalence theorem of Kiefer & Wolfowitz bounds the distance
    of a design from this optimum. Prices are adapted to the use of the limits.
    """
    limits, points = lines.costs.shape
    price = np.full(limits, 1.0 / limits)
    weights = np.full(points, 1.0 / points)
    best, power, bound = -math.inf, weights, math.inf
    damp = 1.0 if criterion.kind == "D" else 0.2
    for turn in range(MAX_PRICE_ITERATIONS):
        cost = price @ lines.costs
        information = lines.information / cost[:, None, None]
        for _ in range(MAX_WEIGHT_ITERATIONS):
            gain = _gain_per_point(weights, information, criterion)
            if gain is None:
                return Spectrum(lines, np.zeros(points), -math.inf, math.inf)
            weights = weights * np.maximum(gain, 0.0) ** damp
            weights = weights / np.sum(weights)
            if np.max(gain) < 1 + OPTIMALITY_TOLERANCE:
                break
        gain = _gain_per_point(weights, information, criterion)
        if gain is None:
            return Spectrum(lines, np.zeros(points), -math.inf, math.inf)
        total = np.tensordot(weights, information, 1)
        bound = min(bound, criterion.smooth_score(total) + 0.5 * math.log(max(float(np.max(gain)), 1.0)))
        normalized = weights / cost
        usage = lines.costs @ normalized
        feasible = normalized / np.max(usage)
        score = float(criterion.score(np.tensordot(feasible, lines.information, 1)))
        if score > best:
            best, power = score, feasible
        if bound - best < OPTIMALITY_TOLERANCE:
            break
        price = price * usage ** (0.7 if turn < MAX_PRICE_ITERATIONS // 2 else 0.4)
        price = np.maximum(price / np.sum(price), 1e-9)
    return Spectrum(lines, power, best, bound)


def _gain_per_point(weights: Floats, information: Floats, criterion: Criterion) -> Floats | None:
    """Return the derivative of the criterion with respect to the power of each point; None if not identifiable.

    Its weighted mean is 1.
    """
    total = np.tensordot(weights, information, 1)
    if not np.isfinite(criterion.score(total)):
        return None
    return np.asarray(np.einsum("kpq,pq->k", information, criterion.gradient(total)))
