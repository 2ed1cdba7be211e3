"""The best spectrum of a periodic input: a convex problem, its optimum certified by the equivalence theorem."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ftlm.analysis.frequency_response import DELTA, frequency_response, model_numbers, with_numbers
from ftlm.experiment_design.problem import Bounds, Criterion
from ftlm.experiment_design.sensitivity import Laid
from ftlm.model.model import Solved
from ftlm.utils.validation import Complex, Floats

#: Most lines of a spectrum: between so many, information changes little.
LINES = 240
#: Highest line, as a share of the sampling frequency.
HIGHEST = 0.25
#: Rounds of the algorithm with limits priced as they are, and prices found.
ROUNDS, PRICES = 60, 40
#: A design this close to the optimum, as a share of its precision, is one.
CLOSE = 1e-3


@dataclass(frozen=True)
class Lines:
    """What a unit of power at each line of each input says, and what it costs of each limit.

    Parameters
    ----------
    frequencies
        Of the lines [Hz].
    information
        Shape (points, numbers, numbers): points are lines of the first input, then of the next, each at the mean square
        of its peak.
    costs
        Shape (limits, points): share of each limit's square that a point uses up, inputs first.
    """

    frequencies: Floats
    information: Floats
    costs: Floats


@dataclass(frozen=True)
class Spectrum:
    """The best distribution of power.

    Parameters
    ----------
    lines
        Of which points.
    power
        Mean square of each point, in units of its input's peak squared; within all limits.
    score
        What it says.
    bound
        What no periodic input within the limits says more than.
    """

    lines: Lines
    power: Floats
    score: float
    bound: float

    @property
    def gap(self) -> float:
        """Share of precision by which a better one may beat this one, at most."""
        return math.expm1(self.bound - self.score)


def lines_of(laid: Laid, bounds: Bounds, step: float, rows: int) -> Lines:
    """Lines of a run that is one period, shared out among inputs so that no two have one."""
    inputs = laid.inputs
    most = max(int(HIGHEST * rows), len(inputs) + 1)
    numbers = np.unique(np.round(np.geomspace(1, most, LINES * 4)).astype(np.int64))
    if len(numbers) > LINES:
        numbers = np.unique(np.round(np.geomspace(1, most, LINES)).astype(np.int64))
    frequencies = numbers / (rows * step)
    slopes, gains = _responses(laid, 2 * math.pi * frequencies, step)
    peaks = np.array(list(bounds.peaks.values()))
    swings = np.array(list(bounds.swings.values()))
    weights = 1.0 / np.array([laid.noise[o] for o in laid.outputs])
    told = (
        np.einsum("oilp,oilq,o->ilpq", slopes, slopes.conj(), weights**2).real * rows * peaks[:, None, None, None] ** 2
    )
    count = len(inputs)
    costs = np.zeros((count + len(swings), count, len(numbers)))
    for k in range(count):
        costs[k, k] = 1.0
    costs[count:] = (np.abs(gains) * peaks[:, None] / swings[:, None, None]) ** 2
    kept = [(k, np.arange(k, len(numbers), count)) for k in range(count)]
    return Lines(
        np.concatenate([frequencies[at] for _, at in kept]),
        np.concatenate([told[k, at] for k, at in kept]),
        np.concatenate([costs[:, k, at] for k, at in kept], axis=1),
    )


def _responses(laid: Laid, w: Floats, step: float) -> tuple[Complex, Complex]:
    """Derivatives of the outputs' responses to held inputs, (outputs, inputs, W, numbers), and the responses."""
    held = np.exp(-0.5j * w * step) * np.sinc(w * step / (2 * math.pi))
    gains = frequency_response(laid.model, w)
    coupling = laid.problem.structure.coupling
    own = replace(laid.model, structure=replace(laid.model.structure, coupling=coupling))
    orders, coefficients, _ = laid.problem.split(laid.values)
    chain = laid.problem.number_jacobian(orders, coefficients)
    values = model_numbers(own)
    # What drives an equation is measured, or follows with it.
    drives = (
        gains
        if coupling == "simulated"
        else np.concatenate([gains, np.tile(np.eye(len(laid.inputs))[..., None], w.size)])
    )
    signals = laid.inputs if coupling == "simulated" else (*laid.outputs, *laid.inputs)
    slopes = np.zeros((*gains.shape, len(laid.names)), dtype=np.complex128)
    for k, value in enumerate(values):
        if not np.any(chain[k]):
            continue
        small = DELTA * max(abs(value), 1e-3)
        ends = []
        for at in (value + small, value - small):
            moved = values.copy()
            moved[k] = at
            ends.append(_driven(with_numbers(own, moved), w, coupling, drives, signals))
        slopes += ((ends[0] - ends[1]) / (2 * small))[..., None] * chain[k]
    for place, item in enumerate(laid.problem.inputs, start=len(laid.names) - len(laid.problem.inputs)):
        at = laid.inputs.index(item.signal)
        slopes[:, at, :, place] = -1j * w * gains[:, at]
    return slopes * held[:, None], gains * held


def _driven(model: Solved, w: Floats, coupling: str, drives: Complex, signals: Sequence[str]) -> Complex:
    """What the outputs do, where equations follow together or are driven by what the others did."""
    if coupling == "simulated":
        return frequency_response(model, w)
    alone = frequency_response(model, w, coupling="measured")
    from_signals = [s for s in model.structure.signals if s in signals]
    read = [t.signal for e in model.equations for t in e.terms if t.signal != e.output]
    inputs = [s for s in from_signals if s in read]
    return np.asarray(np.einsum("osw,siw->oiw", alone, drives[[list(signals).index(s) for s in inputs]]))


def best_spectrum(lines: Lines, criterion: Criterion) -> Spectrum:
    """The best share of power of each line under all limits.

    With a price for each limit the problem is one of weights that sum to one, which Titterington's multiplicative
    algorithm solves (Silvey, Titterington & Torsney, 1978); whatever the prices, its optimum is above that of limits
    themselves, and Kiefer & Wolfowitz's theorem says how far from it a design is at most. Prices follow what is used.
    """
    limits, points = lines.costs.shape
    price = np.full(limits, 1.0 / limits)
    weights = np.full(points, 1.0 / points)
    best, power, bound = -math.inf, weights, math.inf
    damp = 1.0 if criterion.kind == "D" else 0.2
    for turn in range(PRICES):
        cost = price @ lines.costs
        told = lines.information / cost[:, None, None]
        for _ in range(ROUNDS):
            gain = _gains(weights, told, criterion)
            if gain is None:
                return Spectrum(lines, np.zeros(points), -math.inf, math.inf)
            weights = weights * np.maximum(gain, 0.0) ** damp
            weights = weights / np.sum(weights)
            if np.max(gain) < 1 + CLOSE:
                break
        gain = _gains(weights, told, criterion)
        if gain is None:
            return Spectrum(lines, np.zeros(points), -math.inf, math.inf)
        total = np.tensordot(weights, told, 1)
        bound = min(bound, criterion.mean(total) + 0.5 * math.log(max(float(np.max(gain)), 1.0)))
        spent = weights / cost
        used = lines.costs @ spent
        feasible = spent / np.max(used)
        score = float(criterion.score(np.tensordot(feasible, lines.information, 1)))
        if score > best:
            best, power = score, feasible
        if bound - best < CLOSE:
            break
        price = price * used ** (0.7 if turn < PRICES // 2 else 0.4)
        price = np.maximum(price / np.sum(price), 1e-9)
    return Spectrum(lines, power, best, bound)


def _gains(weights: Floats, told: Floats, criterion: Criterion) -> Floats | None:
    """How much a little more power at each point adds, 1 on average; None where nothing tells the chosen numbers."""
    total = np.tensordot(weights, told, 1)
    if not np.isfinite(criterion.score(total)):
        return None
    return np.asarray(np.einsum("kpq,pq->k", told, criterion.slope(total)))
