"""A body that slides and rests by itself, by least squares: what drives, brakes and rubs it, each with its own sign."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from ftlm import _core
from ftlm.base.arrays import Floats
from ftlm.base.statistics import noise_of
from ftlm.base.tall import solved
from ftlm.data.equations import Equation
from ftlm.data.readings import read
from ftlm.data.run import Run
from ftlm.data.structures import Structure
from ftlm.solve.records import record

#: Steps of a run over which its velocity is told, as a share of all, and the deviations of noise that it must exceed.
PACE, SEEN = 0.01, 5.0
#: Turns in which what friction holds at rest is taken from what drives.
TURNS = 4


def slid(runs: Sequence[Run], alone: Structure) -> dict[str, float]:
    """Coefficients of one equation with friction, its orders numbers, that explain its integrals on all runs best.

    Own terms pull back and friction brakes; what drives has any sign. The sign of the velocity is that of the measured
    one where it stands out of its noise, elsewhere the body rests, and friction is what drives it. Each run has a
    level, a velocity and a constant of its own.

    Returns
    -------
    dict
        By name; empty where no such numbers are finite.
    """
    item = alone.equations[0]
    if item.friction is None or not isinstance(item.friction.coefficient, str):
        return {}
    parts = [_regressors(run, alone) for run in runs]
    rest = [part[2] == 0.0 for part in parts]
    signs = [part[2].copy() for part in parts]
    strength, found = item.friction.coefficient, dict[str, float]()
    for _ in range(TURNS):
        found = _best(item, parts, signs)
        if not found:
            return {}
        holds = -item.friction.factor * found[strength]
        if holds <= 0.0:
            break
        for sign, still, part in zip(signs, rest, parts, strict=True):
            push = sum((_value(item, k, found) * drive for k, drive in part[3].items()), start=np.zeros(sign.size))
            sign[still] = np.clip(push[still] / holds, -1.0, 1.0)
    return found


_Part = tuple[list[Floats], Floats, Floats, dict[int, Floats], float]


def _regressors(run: Run, alone: Structure) -> _Part:
    """Integrals of every term, the output's means, the sign of its velocity, drives by term, and the step."""
    item, m = alone.equations[0], run.length - 1
    rec = record(run, alone, m, filtered=False)
    alpha, means = item.order.constant, rec.of(item.output)
    integrals = [_integral(rec.of(t.signal), rec.step, alpha - t.order.constant) for t in item.terms]
    pace = max(1, round(PACE * m))
    gone = means[pace:] - means[:-pace]
    gone = np.concatenate([gone[:1].repeat(pace // 2), gone, gone[-1:].repeat(pace - pace // 2)])
    sign = np.where(np.abs(gone) > SEEN * noise_of(read(run[item.output])), np.sign(gone), 0.0)
    drives = {
        k: rec.of(t.signal) for k, t in enumerate(item.terms) if t.signal != item.output and t.order.constant == 0.0
    }
    return integrals, means, sign, drives, rec.step


def _integral(means: Floats, step: float, order: float) -> Floats:
    """Pulse means of the integral of this order, above 0."""
    signals = np.stack([np.zeros_like(means), means])
    found: Floats = _core.respond((step, signals, None), [((0, order, [(1, 0.0)]), [1.0])], [False, True], [[]])[0]
    return found


def _value(item: Equation, k: int, found: Mapping[str, float]) -> float:
    """A term's coefficient with its factor."""
    term = item.terms[k]
    return term.fixed if term.fixed is not None else term.factor * found[str(term.coefficient)]


def _best(item: Equation, parts: Sequence[_Part], signs: Sequence[Floats]) -> dict[str, float]:
    """The best numbers of which none has the wrong sign: least squares without each set of those that might have."""
    alpha, rubs = item.order.constant, item.friction
    assert rubs is not None
    target, rows = [], []
    for r, ((integrals, means, _, _, step), sign) in enumerate(zip(parts, signs, strict=True)):
        times = (np.arange(means.size) + 0.5) * step
        free = [c * t.factor for c, t in zip(integrals, item.terms, strict=True) if t.fixed is None]
        known = [c * t.fixed for c, t in zip(integrals, item.terms, strict=True) if t.fixed is not None]
        rub = rubs.factor * _integral(sign, step, alpha)
        starts = [times * 0.0] * (3 * len(parts))
        starts[3 * r : 3 * r + 3] = [np.ones_like(times), times, times**alpha]
        rows.append(np.stack([*free, rub, *starts], axis=1))
        target.append(means - sum(known, start=np.zeros_like(means)))
    matrix, wanted = np.concatenate(rows), np.concatenate(target)
    sizes = np.linalg.norm(matrix, axis=0)
    terms = [t for t in item.terms if t.fixed is None]
    names = [*(str(t.coefficient) for t in terms), str(rubs.coefficient)]
    # A coefficient times its factor is negative of an own term, and of friction.
    bound = {k: -np.sign(t.factor) for k, t in enumerate(terms) if t.signal == item.output} | {len(terms): 1.0}
    best: tuple[float, dict[str, float]] = (np.inf, {})
    for out in itertools.chain.from_iterable(itertools.combinations(bound, n) for n in range(len(bound) + 1)):
        kept = [k for k in range(matrix.shape[1]) if k not in out and sizes[k] > 0]
        if not np.all(np.isfinite(matrix[:, kept])):
            return {}
        x = np.zeros(matrix.shape[1])
        x[kept] = solved(matrix[:, kept] / sizes[kept], wanted, None) / sizes[kept]
        if any(x[k] * side < 0.0 for k, side in bound.items()):
            continue
        left = float(np.sum((wanted - matrix @ x) ** 2))
        if left < best[0]:
            best = (left, dict(zip(names, x[: len(names)].tolist(), strict=True)))
    return best[1]
