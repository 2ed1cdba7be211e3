"""Optimal spectrum of a periodic input, from a convex problem; the equivalence theorem certifies its optimality."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ftlm.analysis.frequency_response import DERIVATIVE_STEP_RATIO, frequency_response, shifted_models
from ftlm.experiment_design.problem import Bounds, Criterion, ModelFit
from ftlm.model.model import Model
from ftlm.utils.validation import Complex, Floats

#: Maximum number of lines of a spectrum. More are not needed, because neighboring lines give similar information.
MAX_SPECTRAL_LINES = 240
#: Highest frequency of a line, as a fraction of the sampling frequency.
MAX_FREQUENCY_RATIO = 0.25
#: Maximum number of iterations of the weights at fixed prices (dual variables of the limits), and of price updates.
MAX_WEIGHT_ITERATIONS, MAX_PRICE_ITERATIONS = 60, 40
#: Relative distance in precision from the optimum at which a spectrum counts as optimal.
OPTIMALITY_TOLERANCE = 1e-3


@dataclass(frozen=True)
class SpectralLines:
    """Fisher information of each spectral line per unit of power, and fraction of each squared limit that it uses.

    A point is one line of one input. The points of the first input come first. Unit power means that the mean square
    of the input equals its squared peak.

    Parameters
    ----------
    frequencies
        Frequency of each point [Hz], shape (points,).
    information
        Fisher information of each point at unit power, shape (points, parameters, parameters).
    costs
        Mean square of each input and output at unit power of a point, divided by the squared limit of the signal,
        shape (limits, points). Limits of inputs come first.
    """

    frequencies: Floats
    information: Floats
    costs: Floats


@dataclass(frozen=True)
class Spectrum:
    """Optimal distribution of power over the spectral lines of all inputs.

    Parameters
    ----------
    lines
        Spectral lines of all inputs.
    power
        Mean square of the input at each point (line of an input), relative to the squared peak of the input, shape
        (points,). All limits are met.
    score
        Score of the optimality criterion; -inf if the parameters are not identifiable.
    bound
        Upper bound of the score over all periodic inputs within the limits.
    """

    lines: SpectralLines
    power: Floats
    score: float
    bound: float

    @property
    def gap(self) -> float:
        """Upper bound of the relative gain in precision that another spectrum can have."""
        return math.expm1(self.bound - self.score)


def spectral_lines(fit: ModelFit, bounds: Bounds, step: float, rows: int) -> SpectralLines:
    """Return the spectral lines of a periodic input whose period is the run of `rows` samples.

    The lines are distributed among the inputs such that no two inputs share a line. `step` is the sampling interval
    [s].
    """
    inputs = fit.inputs
    max_harmonic = max(int(MAX_FREQUENCY_RATIO * rows), len(inputs) + 1)
    harmonics = np.unique(np.round(np.geomspace(1, max_harmonic, MAX_SPECTRAL_LINES * 4)).astype(np.int64))
    if len(harmonics) > MAX_SPECTRAL_LINES:
        harmonics = np.unique(np.round(np.geomspace(1, max_harmonic, MAX_SPECTRAL_LINES)).astype(np.int64))
    frequencies = harmonics / (rows * step)
    slopes, gains = _response_sensitivities(fit, 2 * math.pi * frequencies, step)
    peaks = np.array(list(bounds.peaks.values()))
    output_limits = np.array(list(bounds.output_limits.values()))
    weights = 1.0 / np.array([fit.noise[o] for o in fit.outputs])
    information = (
        np.einsum("oilp,oilq,o->ilpq", slopes, slopes.conj(), weights**2).real * rows * peaks[:, None, None, None] ** 2
    )
    count = len(inputs)
    costs = np.zeros((count + len(output_limits), count, len(harmonics)))
    for k in range(count):
        costs[k, k] = 1.0
    costs[count:] = (np.abs(gains) * peaks[:, None] / output_limits[:, None, None]) ** 2
    groups = [(k, np.arange(k, len(harmonics), count)) for k in range(count)]
    return SpectralLines(
        np.concatenate([frequencies[indices] for _, indices in groups]),
        np.concatenate([information[k, indices] for k, indices in groups]),
        np.concatenate([costs[:, k, indices] for k, indices in groups], axis=1),
    )


def _response_sensitivities(fit: ModelFit, w: Floats, step: float) -> tuple[Complex, Complex]:
    """Return parameter derivatives of the frequency responses to zero-order-hold inputs, and the responses.

    Derivatives have shape (outputs, inputs, W, parameters), and responses shape (outputs, inputs, W). `w` are the
    frequencies [rad/s], and `step` is the sampling interval [s].
    """
    hold_response = np.exp(-0.5j * w * step) * np.sinc(w * step / (2 * math.pi))
    gains = frequency_response(fit.model, w)
    coupling = fit.problem.structure.coupling
    coupled_model = replace(fit.model, structure=replace(fit.model.structure, coupling=coupling))
    _, coefficients, _ = fit.problem.split(fit.values)
    jacobian = fit.problem.model_parameter_jacobian(coefficients)
    # With measured coupling, the other outputs in an equation are inputs of the equation.
    responses = (
        gains
        if coupling == "simulated"
        else np.concatenate([gains, np.tile(np.eye(len(fit.inputs))[..., None], w.size)])
    )
    signals = fit.inputs if coupling == "simulated" else (*fit.outputs, *fit.inputs)
    slopes = np.zeros((*gains.shape, len(fit.names)), dtype=np.complex128)
    for k, increment, *models in shifted_models(coupled_model, np.any(jacobian != 0, axis=1), DERIVATIVE_STEP_RATIO):
        upper, lower = (_output_responses(shifted, w, coupling, responses, signals) for shifted in models)
        slopes += ((upper - lower) / (2 * increment))[..., None] * jacobian[k]
    for column, item in enumerate(fit.problem.inputs, start=len(fit.names) - len(fit.problem.inputs)):
        index = fit.inputs.index(item.signal)
        slopes[:, index, :, column] = -1j * w * gains[:, index]
    return slopes * hold_response[:, None], gains * hold_response


def _output_responses(model: Model, w: Floats, coupling: str, responses: Complex, signals: Sequence[str]) -> Complex:
    """Return the frequency responses of the outputs to the inputs at w [rad/s], shape (outputs, inputs, W).

    With measured coupling, an equation also has other outputs as inputs. `responses` are then the responses of all
    `signals` to the inputs, shape (signals, inputs, W).
    """
    if coupling == "simulated":
        return frequency_response(model, w)
    direct = frequency_response(model, w, coupling="measured")
    from_signals = [s for s in model.structure.signals if s in signals]
    input_signals = [t.signal for e in model.equations for t in e.terms if t.signal != e.output]
    inputs = [s for s in from_signals if s in input_signals]
    return np.asarray(np.einsum("osw,siw->oiw", direct, responses[[list(signals).index(s) for s in inputs]]))


def best_spectrum(lines: SpectralLines, criterion: Criterion) -> Spectrum:
    """Return the spectrum whose powers at the lines maximize the criterion under all limits.

    Each limit has a dual variable (price). With fixed prices, the problem is an optimization of weights that sum to
    one. It is solved by Titterington's multiplicative algorithm (Silvey, Titterington & Torsney, 1978). For any prices,
    the optimum of this problem is an upper bound of the optimum of the original problem. The equivalence theorem of
    Kiefer & Wolfowitz bounds the difference between this optimum and the score of the current weights. After each
    solution, the price of a limit is increased if much of the limit is used, and decreased otherwise.

    If the parameters are not identifiable, the powers are zero and the score is -inf.
    """
    limits, points = lines.costs.shape
    price = np.full(limits, 1.0 / limits)
    weights = np.full(points, 1.0 / points)
    best, power, bound = -math.inf, weights, math.inf
    exponent = 1.0 if criterion.kind == "D" else 0.2
    for iteration in range(MAX_PRICE_ITERATIONS):
        cost = price @ lines.costs
        information = lines.information / cost[:, None, None]
        for _ in range(MAX_WEIGHT_ITERATIONS):
            gain = _gain_per_point(weights, information, criterion)
            if gain is None:
                return Spectrum(lines, np.zeros(points), -math.inf, math.inf)
            weights = weights * np.maximum(gain, 0.0) ** exponent
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
        price = price * usage ** (0.7 if iteration < MAX_PRICE_ITERATIONS // 2 else 0.4)
        price = np.maximum(price / np.sum(price), 1e-9)
    return Spectrum(lines, power, best, bound)


def _gain_per_point(weights: Floats, information: Floats, criterion: Criterion) -> Floats | None:
    """Return the derivative of twice the criterion with respect to the weight of each point, shape (points,).

    Its mean, weighted with `weights`, is 1. None if the parameters are not identifiable.
    """
    total = np.tensordot(weights, information, 1)
    if not np.isfinite(criterion.score(total)):
        return None
    return np.asarray(np.einsum("kpq,pq->k", information, criterion.gradient(total)))
