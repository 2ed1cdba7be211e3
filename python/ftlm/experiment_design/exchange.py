"""Exchange algorithm for piecewise-constant inputs.

A hold is an interval of constant input. An exchange changes the level of one hold, or of two holds by opposite amounts.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ftlm.experiment_design.problem import Bounds, Criterion, Sensitivities
from ftlm.utils.resources import stop_flag
from ftlm.utils.validation import Complex, Floats

#: Levels that an input may have, as fractions of its peak.
COMMAND_LEVELS = (-1.0, 0.0, 1.0)
#: Changes of the level of a hold that are tried, and distances [holds] of a second hold that changes by the opposite
#: amount. A distance of 0 stands for an exchange of one hold.
LEVEL_CHANGES, PAIR_GAPS_HOLDS = (-2.0, -1.0, 1.0, 2.0), (1, 2, 4, 8)
#: Maximum number of candidate exchanges, those with the largest linearized gain, that are evaluated exactly.
MAX_EVALUATED_EXCHANGES = 200
#: Maximum number of exchanges, and minimum gain in score of an exchange.
MAX_EXCHANGES, MIN_SCORE_GAIN = 400, 1e-7


@dataclass(frozen=True)
class Design:
    """Candidate input of an input design, and its score.

    Parameters
    ----------
    name
        Description of the input, such as "multisine".
    commands
        Commands, shape (inputs, rows), within all limits.
    score
        Score of the optimality criterion; higher is better.
    """

    name: str
    commands: Floats
    score: float


def scaled_design(
    name: str, commands: Floats, sensitivities: Sensitivities, criterion: Criterion, bounds: Bounds
) -> Design:
    """Return a candidate input: commands, shape (inputs, rows), scaled down to meet all limits, with their score."""
    scale = bounds.scale(commands, sensitivities.outputs(commands))
    score = float(criterion.score(sensitivities.information(sensitivities.derivatives(commands)))) + math.log(scale)
    return Design(name, scale * commands, score)


def exchange_holds(
    begin: Design, hold: int, sensitivities: Sensitivities, criterion: Criterion, bounds: Bounds
) -> Design:
    """Return the candidate input to which the exchange algorithm improves the candidate input `begin`.

    A hold is an interval of `hold` samples with constant input. First, `begin` is rounded to the levels -1, 0 and 1
    times the peak. An exchange then changes the level of one hold, or of two holds by opposite amounts. The Fisher
    information is quadratic in the commands, so convolutions give its change by every exchange exactly. The best
    feasible exchange is made until none improves the score, which gives a local optimum. Source: Fedorov, Theory of
    Optimal Experiments, 1972.
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
    ended = stop_flag()
    for _ in range(MAX_EXCHANGES):
        if ended is not None and ended.is_set:
            raise KeyboardInterrupt
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
    """Return the logarithm of the largest ratio of an output to its limit; 0 if all limits are met.

    `outputs` has shape (outputs, rows), and `limits` shape (outputs, 1).
    """
    return math.log(max(1.0, float(np.max(np.abs(outputs) / limits))))


def _feasible_starts(level: Floats, step: float, gap: int) -> NDArray[np.bool_]:
    """Return a mask of the holds whose level can change by `step`, shape (holds,).

    With `gap` above 0, the level of the hold that is `gap` holds later must also be able to change by -`step`.
    """
    is_feasible: NDArray[np.bool_] = np.abs(level + step) < COMMAND_LEVELS[-1] + 0.5
    if gap:
        is_feasible[:-gap] &= np.abs(level[gap:] - step) < COMMAND_LEVELS[-1] + 0.5
        is_feasible[-gap:] = False
    return is_feasible


@dataclass(frozen=True)
class Hold:
    """Response of the model to one hold (interval of constant input) of one input at its peak, and derived quantities.

    Parameters
    ----------
    starts
        Sample indices at which the holds of a run start, shape (holds,).
    block, response
        Derivatives of the outputs with respect to the parameters, divided by the noise, shape (parameters, outputs,
        rows), and outputs, shape (outputs, rows). Both begin at the start of the hold.
    spectrum
        Fourier transform of `block` along its last axis.
    offsets
        Inner products of `block`, shifted to each start, with the basis of the responses to offsets, shape (holds,
        parameters, basis vectors).
    own
        Fisher information of the response to a unit exchange, shape (holds, parameters, parameters), by the distance of
        the two holds of the exchange [holds]. The first axis is the first hold of the exchange. Distance 0 means an
        exchange of one hold. For a larger distance, the response to the second hold is subtracted, because the two
        levels change by opposite amounts.
    """

    starts: NDArray[np.int64]
    block: Floats
    response: Floats
    spectrum: Complex
    offsets: Floats
    own: Mapping[int, Floats]

    @classmethod
    def of(cls, sensitivities: Sensitivities, place: int, hold: int, starts: NDArray[np.int64], peak: float) -> Hold:
        """Return the response to a hold of `hold` samples of the input with index `place` at its peak value `peak`."""
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
        """Yield (gap, first-order change, second-order change) of the information by exchanges of holds.

        `gap` is the distance between the two holds of an exchange, counted in holds; 0 for an exchange of one hold.
        Changes have shape (holds, parameters, parameters). If the level changes by s, the information changes by s
        times the first-order plus s^2 times the second-order change. `derivatives` are the derivatives of the outputs
        with respect to the parameters for the current input.
        """
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
        """Return the output derivatives or, with `of_response`, the outputs after an exchange.

        `series` are the values before the exchange. The level of the hold with index `at` changes by `step`. With `gap`
        above 0, the level of the hold that starts `gap` holds later changes by -`step`.
        """
        block, out = self.response if of_response else self.block, series.copy()
        for begins, size in ((self.starts[at], step), *(((self.starts[at + gap], -step),) if gap else ())):
            out[..., begins:] += size * block[..., : block.shape[-1] - begins]
        return out


def _nearest_level(values: Floats) -> Floats:
    """Return values rounded to the nearest of the levels -1, 0 and 1; midpoints are rounded away from zero."""
    levels = np.array(COMMAND_LEVELS)
    return np.asarray(levels[np.argmin(np.abs(values[..., None] * (1 + 1e-9) - levels), axis=-1)])


def _hold_response(kernel: Floats, hold: int) -> Floats:
    """Return the response to a pulse of `hold` samples from `kernel`, the response to one sample (last axis: time)."""
    total = np.cumsum(kernel, axis=-1)
    total[..., hold:] -= total[..., :-hold].copy()
    return total


def _inner_products(sensitivities: Sensitivities, one: Floats, other: Floats, starts: NDArray[np.int64]) -> Floats:
    """Return, for each start, the inner products of responses that begin at this sample and end with the run.

    The responses `one` and `other` have shapes (p, outputs, rows) and (q, outputs, rows), the result (starts, p, q).
    """
    products = np.zeros((len(starts), len(one), len(other)))
    for p, row in enumerate(one):
        total = np.cumsum(np.einsum("ot,qot->qt", row, other), axis=-1)
        products[:, p] = total[:, sensitivities.rows - 1 - starts].T
    return products


def _correlate_at_starts(
    sensitivities: Sensitivities, series: Floats, spectrum: Complex, starts: NDArray[np.int64]
) -> Floats:
    """Return inner products of series with the responses to holds that start at given samples.

    `series` has shape (series, outputs, rows), and `spectrum` is the Fourier transform of the response to a hold. The
    result has shape (starts, parameters, series).
    """
    out = np.zeros((len(starts), spectrum.shape[0], len(series)))
    for place, one in enumerate(np.fft.rfft(series, sensitivities.length)):
        product = np.einsum("of,pof->pf", one, np.conj(spectrum))
        out[..., place] = np.fft.irfft(product, sensitivities.length)[:, starts].T
    return out
