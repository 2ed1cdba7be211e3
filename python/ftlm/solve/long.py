"""Free runs of long records: each answer to a sample is refined near its start, only as far as that moves the run.

An equation answers a sample of an input alike wherever it stands, so a free run is the sum of its answers, and of what
it starts with. An answer is rough where its sample acts, and smooth long after: there two or four pulses an interval
tell as much as many, and even one does, which no jump of a held input is near. What halving the step moves is told for
each piece of the answers by what it moves in the run itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from msgspec import UNSET

from ftlm import _core
from ftlm.base.arrays import Floats
from ftlm.base.errors import ModelError
from ftlm.data.readings import bridged
from ftlm.data.run import Run
from ftlm.data.samples import HELD
from ftlm.data.solved import Solved
from ftlm.solve.limit import Limit
from ftlm.solve.motion import decided
from ftlm.solve.records import acting
from ftlm.solve.sampled import GRAIN, Sampled, Terms, fitted, initial_names, measured_samples, sampled, unit_samples

#: Intervals from which on a record is long: below, whole grids cost as little.
LONG = 1 << 14
#: Pieces of an answer begin at its end divided by powers of this, the first of them not below so many intervals: half
#: the step on one costs what the whole did.
RATIO, SHORTEST = 8, 128
#: Pulses an interval on which all of an answer is known. On the first, answers jump where inputs do: the piece where
#: they start is without it.
WHOLE = (1, 2, 4)
#: An answer whose later half exceeds its first by this factor belongs to a run that grows: what sums up would be
#: rounding.
GROWTH = 1e3


@dataclass
class Piece:
    """A part of all answers, from one interval to before another, on its finest grid, and its limit for step 0."""

    first: int
    end: int
    every: int
    limit: Limit


@dataclass(frozen=True)
class Answers:
    """A model on a run, as a sum of answers: to every sample of what drives it, to first samples, to initial terms.

    Parameters
    ----------
    model
        The model from rest, its limits of inputs done.
    run
        The run; of it only names, step and how inputs act in between.
    drivers
        Samples of what drives, as they act.
    begun
        Signals whose first sample acts otherwise than later ones, and those samples.
    names
        Output and power of the initial terms.
    """

    model: Solved
    run: Run
    drivers: Mapping[str, Floats]
    begun: Mapping[str, float]
    names: Sequence[tuple[str, float]]

    @property
    def count(self) -> int:
        """Number of outputs."""
        return len(self.model.outputs)

    @classmethod
    def of(cls, model: Solved, run: Run, names: Sequence[tuple[str, float]]) -> Answers | None:
        """Those of a run; None where it is no such sum."""
        structure = model.structure
        outputs, coupled = model.outputs, structure.coupling == "simulated"
        read = [(e, t) for e in model.equations for t in e.terms]
        drivers = dict.fromkeys(
            t.signal for e, t in read if t.signal != e.output and not (coupled and t.signal in outputs)
        )
        if structure.has_friction or run.readings is not None or structure.behind_filter:
            return None
        if any(name not in run for name in drivers) or any(
            t.order.constant > e.order.constant + GRAIN for e, t in read
        ):
            return None
        late = {name for name in drivers if structure.delay.get(name, 0.0)}
        direct = {t.signal for e, t in read if abs(t.order.constant - e.order.constant) <= GRAIN}
        if late and (late & direct or decided(run, structure) != "rest"):
            # What acted before the run, and at its last sample, is no answer to one of its samples.
            return None
        every = {n: bridged(acting(run, structure, n)[n]) for n in drivers}
        moving = {n: v for n, v in every.items() if v.any()}
        ramps = [n for n in moving if n not in run.inputs or run.intersample[n] != HELD]
        still = replace(model, structure=replace(structure, initial="rest", limited=UNSET))
        return cls(still, run, moving, {n: float(moving[n][0]) for n in ramps if moving[n][0]}, names)

    def on(self, every: int, intervals: int) -> Floats:
        """All answers on so many pulses an interval, a block of rows an answer; not finite where there are none."""
        try:
            return self._on(every, intervals)
        except ModelError:
            # The grid happens to make the equations unsolvable.
            rows = len(self.drivers) + len(self.begun) + len(self.names)
            return np.full((rows * self.count, intervals + 1), np.nan)

    def _on(self, every: int, intervals: int) -> Floats:
        blocks, first = [], []
        for name in self.drivers:
            ramp = name not in self.run.inputs or self.run.intersample[name] != HELD
            # What is linear in between rises to a sample before it falls.
            rows = sampled(self.model, self._unit(name, intervals + ramp, int(ramp)), every, {})[0]
            blocks.append(rows[:, 1:] if ramp else rows)
            if name in self.begun:
                first.append(sampled(self.model, self._unit(name, intervals, 0), every, {})[0] - blocks[-1])
        more = unit_samples(self.model, self._unit("", intervals, 0), every, self.names) if self.names else []
        return np.concatenate([*blocks, *first, *more]) if blocks or more else np.zeros((0, intervals + 1))

    def _unit(self, name: str, intervals: int, row: int) -> Run:
        """A run of nothing but one sample of one signal."""

        def of(signal: str) -> Floats:
            out = np.zeros(intervals + 1)
            if signal == name:
                out[row] = 1.0
            return out

        run = self.run
        return Run.from_arrays(
            step=run.step, inputs={n: of(n) for n in run.inputs}, outputs={n: of(n) for n in run.outputs},
            intersample=run.intersample,
        )  # fmt: skip

    def summed(self, answers: Floats, first: int, weights: Sequence[float]) -> Floats:
        """What answers from one interval on make of the run behind it, shape (outputs, N - first).

        The weights are those of the initial terms.
        """
        n = self.count
        blocks = answers.reshape(-1, n, answers.shape[1])
        out = np.zeros((n, self.run.length - first))
        for block, samples in zip(blocks, self.drivers.values(), strict=False):
            for i, row in enumerate(block):
                if row.any():
                    out[i] += _core.series_multiply(row, samples[: out.shape[1]], out.shape[1])
        once = blocks[len(self.drivers) :]
        for block, weight in zip(once, [*self.begun.values(), *weights], strict=True):
            out[:, : answers.shape[1]] += weight * block
        return out

    def parts(self, answers: Floats) -> tuple[Floats, list[Floats]]:
        """The run without initial terms, and what a unit of each does."""
        units = answers.reshape(-1, self.count, answers.shape[1])[len(self.drivers) + len(self.begun) :]
        return self.summed(answers, 0, [0.0] * len(self.names)), list(units)


def long_run(
    model: Solved, run: Run, initial: Terms | None, *, tolerance: float, largest_m: int
) -> Sampled | None:  # fmt: skip
    """Samples of a long run, as :func:`ftlm.solve.refined.refined` has them; None for one that whole grids must tell.

    The initial terms of the model are decided. The refinement is that of the whole record.
    """
    own = run.length - 1
    if own < LONG or WHOLE[-1] * own > largest_m or model.structure.has_friction:
        return None
    given = None if initial is None else [(o, p) for o in model.outputs for p in initial.get(o, {})]
    names = initial_names(model, decided(run, model.structure)) if given is None else given
    answers = Answers.of(model, run, names)
    if answers is None:
        return None
    grids = {every: answers.on(every, own) for every in WHOLE}
    if not all(_dies_away(rows) for rows in list(grids.values())[1:]):
        return None

    def weighed(rows: Floats) -> tuple[Floats, dict[str, dict[float, float]]]:
        driven, units = answers.parts(rows)
        if initial is None and names:
            return fitted(model, measured_samples(model, run, WHOLE[-1]), driven, names, units)
        kept = {o: dict((initial or {}).get(o, {})) for o in model.outputs}
        return driven + sum((kept[o][p] * u for (o, p), u in zip(names, units, strict=True)), np.zeros(1)), kept

    rough, terms = weighed(grids[WHOLE[-1]])
    size = np.max(np.abs(rough), axis=1)
    weights = [terms[o][p] for o, p in names]

    def moved_from(first: int) -> Callable[[Floats, Floats], Floats]:
        def moved(new: Floats, old: Floats) -> Floats:
            by = new - old
            if not np.all(np.isfinite(by)):
                return np.full(answers.count, np.inf)
            most = np.max(np.abs(answers.summed(by, first, weights)), axis=1)
            return np.asarray(np.where(most == 0.0, 0.0, most / np.where(size > 0.0, size, 1e-300)))

        return moved

    pieces = []
    for first, end in _edges(own):
        limit = Limit(measure=moved_from(first))
        for every in WHOLE[0 if first else 1 :]:
            limit.add(grids[every][:, first:end])
        pieces.append(Piece(first, end, WHOLE[-1], limit))
    del grids
    change = _refined(pieces, answers, tolerance, largest_m)
    best = np.concatenate([p.limit.told().samples for p in pieces], axis=1)
    outputs, terms = weighed(best)
    return Sampled(outputs, terms, pieces[-1].every, change)


def _refined(pieces: Sequence[Piece], answers: Answers, tolerance: float, largest_m: int) -> Floats:
    """Halve the step on the pieces that still move, until all together do not, or pulses run out; what is left."""
    while True:
        changes = [p.limit.told().change for p in pieces]
        left = np.asarray(sum(c[: answers.count] for c in changes))
        restless = [
            p for p, c in zip(pieces, changes, strict=True)
            if np.any(c > tolerance / len(pieces)) and 2 * p.every * p.end <= largest_m
        ]  # fmt: skip
        if np.all(left <= tolerance) or not restless:
            return left
        widest = restless[-1]
        every = 2 * widest.every
        finer = answers.on(every, widest.end - 1)
        for piece in pieces:
            if piece.end <= widest.end and 2 * piece.every == every:
                piece.limit.add(finer[:, piece.first : piece.end])
                piece.every = every


def _edges(own: int) -> list[tuple[int, int]]:
    """Pieces of answers over so many intervals."""
    ends = [own + 1]
    while ends[0] // RATIO >= SHORTEST:
        ends.insert(0, ends[0] // RATIO)
    return list(zip([0, *ends[:-1]], ends, strict=True))


def _dies_away(rows: Floats) -> bool:
    """Whether answers do not grow by so much that their sum would lose its digits."""
    if not np.all(np.isfinite(rows)):
        return False
    half = rows.shape[1] // 2
    first, second = (np.max(np.abs(part), axis=1, initial=0.0) for part in (rows[:, :half], rows[:, half:]))
    return bool(np.all(second <= GROWTH * first))
