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
    initial: Design, hold: int, sensitivities: Sensitivities, criterion: Criterion, bounds: Bounds
) -> Design:
    """Return the locally optimal input that the exchange algorithm finds from the candidate input `initial`.

    A hold is an interval of `hold` samples with constant input. First, `initial` is rounded to the levels -1, 0 and 1
    times the peak. An exchange then changes the level of one hold, or of two holds by opposite amounts. The Fisher
    information is quadratic in the commands, so convolutions give its change by every exchange exactly. The best
    feasible exchange is made until none improves the score, which gives a local optimum. Source: Fedorov, Theory of
    Optimal Experiments, 1972.
    """
    inputs, rows = initial.commands.shape
    starts = np.arange(0, rows, hold)
    peaks = np.array(list(bounds.peaks.values()))[:, None]
    limits = np.array(list(bounds.output_limits.values()))[:, None]
    means = np.add.reduceat(initial.commands, starts, axis=1) / np.diff(np.append(starts, rows))
    levels = _nearest_level(means / np.maximum(np.max(np.abs(means), axis=1, keepdims=True), 1e-300))
    holds = [Hold.of(sensitivities, k, hold, starts, float(peaks[k, 0])) for k in range(inputs)]

    def commands() -> Floats:
        return np.asarray(np.repeat(levels, hold, axis=1)[:, :rows] * peaks)

    derivatives, outputs = sensitivities.derivatives(commands()), sensitivities.outputs(commands())
    information = sensitivities.information(derivatives)
    score = float(criterion.score(information)) - _log_limit_excess(outputs, limits)
    stop = stop_flag()
    for _ in range(MAX_EXCHANGES):
        if stop is not None and stop.is_set:
            raise KeyboardInterrupt
        slope = None if score == -math.inf else criterion.gradient(information) / 2
        moves: list[tuple[float, int, int, int, float, Floats]] = []
        for k, hold_response in enumerate(holds):
            for gap, linear, quadratic in hold_response.information_changes(sensitivities, derivatives):
                for step in LEVEL_CHANGES:
                    is_feasible = _feasible_starts(levels[k], step, gap)
                    gain = np.zeros(len(linear))
                    if slope is not None:
                        gain = np.einsum("spq,pq->s", step * linear + step**2 * quadratic, slope)
                    for i in np.argsort(np.where(is_feasible, -gain, np.inf))[
                        : min(MAX_EVALUATED_EXCHANGES, int(np.sum(is_feasible)))
                    ]:
                        moves.append((float(gain[i]), k, int(i), gap, step, step * linear[i] + step**2 * quadratic[i]))
        moves = sorted(moves, key=lambda m: -m[0])[:MAX_EVALUATED_EXCHANGES]
        if not moves:
            break
        scores = criterion.score(information + np.stack([m[5] for m in moves]))
        best, best_outputs = score + MIN_SCORE_GAIN, outputs
        exchange: tuple[int, int, int, float] | None = None
        for rank in np.argsort(-scores):
            if not scores[rank] > best:
                break
            _, k, i, gap, step, _ = moves[rank]
            outputs_after = holds[k].apply_exchange(outputs, i, gap, step, of_response=True)
            candidate_score = float(scores[rank]) - _log_limit_excess(outputs_after, limits)
            if candidate_score > best:
                best, best_outputs, exchange = candidate_score, outputs_after, (k, i, gap, step)
        if exchange is None:
            break
        k, i, gap, step = exchange
        score, outputs = best, best_outputs
        levels[k, i] += step
        if gap:
            levels[k, i + gap] -= step
        derivatives = holds[k].apply_exchange(derivatives, i, gap, step, of_response=False)
        information = sensitivities.information(derivatives)
    return scaled_design(initial.name, commands(), sensitivities, criterion, bounds)


def _log_limit_excess(outputs: Floats, limits: Floats) -> float:
    """Return the logarithm of the largest ratio of an output to its limit; 0 if all limits are met.

    `outputs` has shape (outputs, rows), and `limits` shape (outputs, 1).
    """
    return math.log(max(1.0, float(np.max(np.abs(outputs) / limits))))


def _feasible_starts(levels: Floats, step: float, gap: int) -> NDArray[np.bool_]:
    """Return a mask of the holds whose level can change by `step`, shape (holds,).

    With `gap` above 0, the level of the hold that is `gap` holds later must also be able to change by -`step`.
    """
    is_feasible: NDArray[np.bool_] = np.abs(levels + step) < COMMAND_LEVELS[-1] + 0.5
    if gap:
        is_feasible[:-gap] &= np.abs(levels[gap:] - step) < COMMAND_LEVELS[-1] + 0.5
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
    quadratic
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
    quadratic: Mapping[int, Floats]

    @classmethod
    def of(cls, sensitivities: Sensitivities, index: int, hold: int, starts: NDArray[np.int64], peak: float) -> Hold:
        """Return the response to a hold of `hold` samples of the input with index `index` at its peak value `peak`."""
        block, response = (
            _hold_response(sensitivities.kernels[index], hold) * peak,
            _hold_response(sensitivities.responses[index], hold) * peak,
        )
        spectrum = np.fft.rfft(block, sensitivities.length)
        offsets = _correlate_at_starts(
            sensitivities, sensitivities.nuisance.reshape(-1, *block.shape[1:]), spectrum, starts
        )
        single = _inner_products(sensitivities, block, block, starts) - np.einsum("spr,sqr->spq", offsets, offsets)
        quadratic = {0: single}
        for gap in PAIR_GAPS_HOLDS:
            if gap >= len(starts):
                break
            delayed_block = np.zeros_like(block)
            delayed_block[..., gap * hold :] = block[..., : sensitivities.rows - gap * hold]
            cross_products = _inner_products(sensitivities, block, delayed_block, starts)[:-gap]
            cross_products = cross_products - np.einsum("spr,sqr->spq", offsets[:-gap], offsets[gap:])
            pair = np.zeros_like(single)
            pair[:-gap] = single[:-gap] + single[gap:] - cross_products - np.swapaxes(cross_products, -1, -2)
            quadratic[gap] = pair
        return cls(starts, block, response, spectrum, offsets, quadratic)

    def information_changes(
        self, sensitivities: Sensitivities, derivatives: Floats
    ) -> Iterator[tuple[int, Floats, Floats]]:
        """Yield (gap, first-order change, second-order change) of the information by exchanges of holds.

        `gap` is the distance between the two holds of an exchange, counted in holds; 0 for an exchange of one hold.
        Changes have shape (holds, parameters, parameters). If the level changes by s, the information changes by s
        times the first-order plus s^2 times the second-order change. `derivatives` are the derivatives of the outputs
        with respect to the parameters for the current input.
        """
        linear = _correlate_at_starts(sensitivities, derivatives, self.spectrum, self.starts)
        if len(sensitivities.nuisance):
            rows = derivatives.reshape(len(derivatives), -1) @ sensitivities.nuisance.T
            linear = linear - np.einsum("spr,qr->spq", self.offsets, rows)
        linear = linear + np.swapaxes(linear, -1, -2)
        for gap, quadratic in self.quadratic.items():
            pair = linear
            if gap:
                pair = np.zeros_like(linear)
                pair[:-gap] = linear[:-gap] - linear[gap:]
            yield gap, pair, quadratic

    def apply_exchange(self, series: Floats, index: int, gap: int, step: float, *, of_response: bool) -> Floats:
        """Return the output derivatives or, with `of_response`, the outputs after an exchange.

        `series` are the values before the exchange. The level of the hold with index `index` changes by `step`. With
        `gap` above 0, the level of the hold that starts `gap` holds later changes by -`step`.
        """
        block, out = self.response if of_response else self.block, series.copy()
        for start, change in ((self.starts[index], step), *(((self.starts[index + gap], -step),) if gap else ())):
            out[..., start:] += change * block[..., : block.shape[-1] - start]
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


def _inner_products(sensitivities: Sensitivities, first: Floats, second: Floats, starts: NDArray[np.int64]) -> Floats:
    """Return, for each start, the inner products of responses that begin at this sample and end with the run.

    The responses `first` and `second` have shapes (p, outputs, rows) and (q, outputs, rows), the result (starts, p, q).
    """
    products = np.zeros((len(starts), len(first), len(second)))
    for p, row in enumerate(first):
        cumulative = np.cumsum(np.einsum("ot,qot->qt", row, second), axis=-1)
        products[:, p] = cumulative[:, sensitivities.rows - 1 - starts].T
    return products


def _correlate_at_starts(
    sensitivities: Sensitivities, series: Floats, spectrum: Complex, starts: NDArray[np.int64]
) -> Floats:
    """Return inner products of series with the responses to holds that start at given samples.

    `series` has shape (series, outputs, rows), and `spectrum` is the Fourier transform of the response to a hold. The
    result has shape (starts, parameters, series).
    """
    out = np.zeros((len(starts), spectrum.shape[0], len(series)))
    for index, transform in enumerate(np.fft.rfft(series, sensitivities.length)):
        product = np.einsum("of,pof->pf", transform, np.conj(spectrum))
        out[..., index] = np.fft.irfft(product, sensitivities.length)[:, starts].T
    return out
