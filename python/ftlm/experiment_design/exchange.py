"""Exchange algorithm for piecewise-constant inputs, which changes one or two holds at a time.

A hold is an interval of constant input.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ftlm.experiment_design.problem import Bounds, Criterion, Sensitivities
from ftlm.utils.validation import Complex, Floats

#: Levels of a command, as fractions of its peak.
COMMAND_LEVELS = (-1.0, 0.0, 1.0)
#: Changes of a level, and distances in holds at which a second hold may change by the opposite amount (0: none).
LEVEL_CHANGES, PAIR_GAPS_HOLDS = (-2.0, -1.0, 1.0, 2.0), (1, 2, 4, 8)
#: Maximum number of exchanges with the largest linearized gain that are evaluated exactly.
MAX_EVALUATED_EXCHANGES = 200
#: Maximum number of exchanges, and minimum gain in score of one.
MAX_EXCHANGES, MIN_SCORE_GAIN = 400, 1e-7


@dataclass(frozen=True)
class Design:
    """Commands of a designed input and their score.

    Parameters
    ----------
    name
        Origin of the commands, such as "sweep".
    commands
        Commands of shape (inputs, rows), within all limits.
    score
        Value of the criterion; higher is better.
    """

    name: str
    commands: Floats
    score: float


def scaled_design(
    name: str, commands: Floats, sensitivities: Sensitivities, criterion: Criterion, bounds: Bounds
) -> Design:
    """Return commands scaled down until all limits hold, with their score."""
    scale = bounds.scale(commands, sensitivities.outputs(commands))
    score = float(criterion.score(sensitivities.information(sensitivities.derivatives(commands)))) + math.log(scale)
    return Design(name, scale * commands, score)


def exchange_holds(
    begin: Design,
    hold: int,
    sensitivities: Sensitivities,
    criterion: Criterion,
    bounds: Bounds,
    stopped: Callable[[], None] = lambda: None,
) -> Design:
    """Improve a piecewise-constant input by exchanges of holds, one or two at a time, and return the design.

    Source: Fedorov, Theory of Optimal Experiments, 1972. `hold` is the length of a hold in samples.

    The Fisher information is quadratic in the commands, so convolutions give its change by every exchange exactly. The
    best feasible exchange is made until no exchange improves the score. The result is a local optimum with respect to
    changes of one hold, and to opposite changes of two neighboring holds.
    """
    inputs, rows = begin.commands.shape
    starts = np.arange(0, rows, hold)
    peaks = np.array(list(bounds.peaks.values()))[:, None]
    limits = np.array(list(bounds.output_limits.values()))[:, None]
    means = np.add.reduceat(begin.commands, starts, axis=1) / np.diff(np.append(starts, rows))
    level = _nearest_level(means / np.maximum(np.max(np.abs(means), axis=1, keepdims=True), 1e-300))
    holds = [Hold.of(sensitivities, k, hold, starts, float(peaks[k, 0])) for k in range(inputs)]

    def commands() -> Floats:
        return np.asarray(np.repeat(level, hold, axis=1)[:, :rows] * peaks)

    derivatives, outputs = sensitivities.derivatives(commands()), sensitivities.outputs(commands())
    information = sensitivities.information(derivatives)
    score = float(criterion.score(information)) - _log_limit_excess(outputs, limits)
    for _ in range(MAX_EXCHANGES):
        stopped()
        slope = None if score == -math.inf else criterion.gradient(information) / 2
        moves: list[tuple[float, int, int, int, float, Floats]] = []
        for k, one in enumerate(holds):
            for gap, shared, own in one.information_changes(sensitivities, derivatives):
                for step in LEVEL_CHANGES:
                    is_feasible = _feasible_starts(level[k], step, gap)
                    gain = np.zeros(len(shared))
                    if slope is not None:
                        gain = np.einsum("spq,pq->s", step * shared + step**2 * own, slope)
                    for at in np.argsort(np.where(is_feasible, -gain, np.inf))[
                        : min(MAX_EVALUATED_EXCHANGES, int(np.sum(is_feasible)))
                    ]:
                        moves.append((float(gain[at]), k, int(at), gap, step, step * shared[at] + step**2 * own[at]))
        moves = sorted(moves, key=lambda m: -m[0])[:MAX_EVALUATED_EXCHANGES]
        if not moves:
            break
        scores = criterion.score(information + np.stack([m[5] for m in moves]))
        best, then = score + MIN_SCORE_GAIN, outputs
        exchange: tuple[int, int, int, float] | None = None
        for place in np.argsort(-scores):
            if not scores[place] > best:
                break
            _, k, at, gap, step, _ = moves[place]
            outputs_after = holds[k].apply_exchange(outputs, at, gap, step, of_response=True)
            reached = float(scores[place]) - _log_limit_excess(outputs_after, limits)
            if reached > best:
                best, then, exchange = reached, outputs_after, (k, at, gap, step)
        if exchange is None:
            break
        k, at, gap, step = exchange
        score, outputs = best, then
        level[k, at] += step
        if gap:
            level[k, at + gap] -= step
        derivatives = holds[k].apply_exchange(derivatives, at, gap, step, of_response=False)
        information = sensitivities.information(derivatives)
    return scaled_design(begin.name, commands(), sensitivities, criterion, bounds)


def _log_limit_excess(outputs: Floats, limits: Floats) -> float:
    """Return the logarithm of the largest ratio of outputs to their limits; 0 if all limits are met."""
    return math.log(max(1.0, float(np.max(np.abs(outputs) / limits))))


def _feasible_starts(level: Floats, step: float, gap: int) -> NDArray[np.bool_]:
    """Return a mask of the holds that can change by a step.

    The hold `gap` later changes by the opposite amount.
    """
    is_feasible: NDArray[np.bool_] = np.abs(level + step) < COMMAND_LEVELS[-1] + 0.5
    if gap:
        is_feasible[:-gap] &= np.abs(level[gap:] - step) < COMMAND_LEVELS[-1] + 0.5
        is_feasible[-gap:] = False
    return is_feasible


@dataclass(frozen=True)
class Hold:
    """Response of the model to one hold of an input at its peak level, with quantities derived from it.

    Parameters
    ----------
    starts
        Sample indices at which holds start.
    block, response
        Derivatives by parameters, shape (parameters, outputs, rows), and outputs, both from the start of a hold.
    spectrum
        Fourier transform of the derivatives.
    offsets
        Projection of the response of a hold onto responses to offsets, by the start of the hold.
    own
        Information of one hold by its start, and by gap that of one hold minus another that starts one gap later.
    """

    starts: NDArray[np.int64]
    block: Floats
    response: Floats
    spectrum: Complex
    offsets: Floats
    own: Mapping[int, Floats]

    @classmethod
    def of(cls, sensitivities: Sensitivities, place: int, hold: int, starts: NDArray[np.int64], peak: float) -> Hold:
        """Return the hold of the input with index `place`, of `hold` samples, from the sensitivities."""
        block, response = (
            _hold_response(sensitivities.kernels[place], hold) * peak,
            _hold_response(sensitivities.responses[place], hold) * peak,
        )
        spectrum = np.fft.rfft(block, sensitivities.length)
        offsets = _correlate_at_starts(
            sensitivities, sensitivities.nuisance.reshape(-1, *block.shape[1:]), spectrum, starts
        )
        alone = _inner_products(sensitivities, block, block, starts) - np.einsum("spr,sqr->spq", offsets, offsets)
        own = {0: alone}
        for gap in PAIR_GAPS_HOLDS:
            if gap >= len(starts):
                break
            late = np.zeros_like(block)
            late[..., gap * hold :] = block[..., : sensitivities.rows - gap * hold]
            mixed = _inner_products(sensitivities, block, late, starts)[:-gap]
            mixed = mixed - np.einsum("spr,sqr->spq", offsets[:-gap], offsets[gap:])
            pair = np.zeros_like(alone)
            pair[:-gap] = alone[:-gap] + alone[gap:] - mixed - np.swapaxes(mixed, -1, -2)
            own[gap] = pair
        return cls(starts, block, response, spectrum, offsets, own)

    def information_changes(
        self, sensitivities: Sensitivities, derivatives: Floats
    ) -> Iterator[tuple[int, Floats, Floats]]:
        """Yield, for each gap, the first- and second-order changes of the information by an exchange, by its start."""
        shared = _correlate_at_starts(sensitivities, derivatives, self.spectrum, self.starts)
        if len(sensitivities.nuisance):
            flat = derivatives.reshape(len(derivatives), -1) @ sensitivities.nuisance.T
            shared = shared - np.einsum("spr,qr->spq", self.offsets, flat)
        shared = shared + np.swapaxes(shared, -1, -2)
        for gap, own in self.own.items():
            pair = shared
            if gap:
                pair = np.zeros_like(shared)
                pair[:-gap] = shared[:-gap] - shared[gap:]
            yield gap, pair, own

    def apply_exchange(self, series: Floats, at: int, gap: int, step: float, *, of_response: bool) -> Floats:
        """Return derivatives (or outputs with `of_response`) after an exchange."""
        block, out = self.response if of_response else self.block, series.copy()
        for begins, size in ((self.starts[at], step), *(((self.starts[at + gap], -step),) if gap else ())):
            out[..., begins:] += size * block[..., : block.shape[-1] - begins]
        return out


def _nearest_level(values: Floats) -> Floats:
    """Return values rounded to the nearest level; midpoints are rounded away from zero."""
    levels = np.array(COMMAND_LEVELS)
    return np.asarray(levels[np.argmin(np.abs(values[..., None] * (1 + 1e-9) - levels), axis=-1)])


def _hold_response(kernel: Floats, hold: int) -> Floats:
    """Return the response to a hold, computed from the response to one sample."""
    total = np.cumsum(kernel, axis=-1)
    total[..., hold:] -= total[..., :-hold].copy()
    return total


def _inner_products(sensitivities: Sensitivities, one: Floats, other: Floats, starts: NDArray[np.int64]) -> Floats:
    """Return, for each start, the inner product of two responses that both begin there and end with the run."""
    products = np.zeros((len(starts), len(one), len(other)))
    for p, row in enumerate(one):
        total = np.cumsum(np.einsum("ot,qot->qt", row, other), axis=-1)
        products[:, p] = total[:, sensitivities.rows - 1 - starts].T
    return products


def _correlate_at_starts(
    sensitivities: Sensitivities, series: Floats, spectrum: Complex, starts: NDArray[np.int64]
) -> Floats:
    """Return inner products of series with holds that start at given samples, shape (starts, parameters, series)."""
    out = np.zeros((len(starts), spectrum.shape[0], len(series)))
    for place, one in enumerate(np.fft.rfft(series, sensitivities.length)):
        product = np.einsum("of,pof->pf", one, np.conj(spectrum))
        out[..., place] = np.fft.irfft(product, sensitivities.length)[:, starts].T
    return out
