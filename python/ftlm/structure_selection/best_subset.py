"""Best-subset search over the input terms of one equation, with scores in closed form."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np
from msgspec import UNSET

from ftlm import _core
from ftlm.data.run import Run
from ftlm.errors import FtlmError
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Attempt, Grid, descend
from ftlm.structure.equation import Term
from ftlm.structure.order import Order
from ftlm.structure.structure import Offset, Structure, narrowed
from ftlm.structure_selection.candidates import Change, Inside, Variant, signature, worded
from ftlm.structure_selection.cross_validation import LOST, Folds, decided
from ftlm.utils.validation import Floats

Item = TypeVar("Item")
Made = TypeVar("Made")
#: Minimum number of input terms for best-subset screening. Stepwise selection is as fast for fewer.
LEAST_DRIVES = 3
#: Minimum number of samples of a subsampled run.
SAMPLES = 1000
#: Spacing of the grid in ln(frequency), damping factors, and number of times that the spacing is halved around the best
#: points.
SPACING = 0.15
DAMPING = tuple(np.geomspace(0.006, 4.0, 10).tolist())
ZOOMS = 2
#: Number of subsets around whose points the grid is refined.
LEADING = 24
#: Maximum number of subsets for an exhaustive search. Beyond it, the best subsets of each size are extended.
ALL = 4096
#: Ridge added to the scaled normal matrix, for collinear responses.
UNTOLD = 1e-12
#: Number of grid points per task.
CHUNK = 16


class Pool(Protocol):
    """Pool that maps a function over items, in their order."""

    def quietly(self, work: Callable[[Item], Made], items: Sequence[Item]) -> list[Made]:
        """Return the results for the items, in their order."""


@dataclass(frozen=True)
class Screened:
    """Subset with the initial guess of its fit, and its score on the grid: mean over folds of ln(1 - fit / 100)."""

    change: Change
    start: Mapping[str, float]
    score: float


@dataclass(frozen=True)
class Column:
    """Input term at one of its integer orders."""

    coefficient: str
    signal: str
    place: float
    names: tuple[str, ...]

    def term(self, term: Term, name: str) -> Term:
        """Return the term at this order with a coefficient of its own."""
        return replace(term, order=Order(self.place), coefficient=name)


@dataclass(frozen=True)
class Ground:
    """Base model: own terms at integer orders with coefficients from a grid, and columns of possible input terms."""

    inside: Inside
    variant: Variant
    structure: Structure
    own: tuple[tuple[str, float], ...]
    columns: tuple[Column, ...]
    runs: tuple[Run, ...]

    @property
    def top(self) -> float:
        """Highest order."""
        return self.structure.equations[0].order.constant

    def lattice(self) -> Iterator[tuple[float, ...]]:
        """Yield logarithms of frequency and of damping, as many as there are free own coefficients."""
        if not self.own:
            yield ()
            return
        longest = max(r.length * r.step for r in self.runs)
        low, high = math.log(1.0 / longest), math.log(math.pi / (2.0 * min(r.step for r in self.runs)))
        steps = np.linspace(low, high, max(2, math.ceil((high - low) / SPACING) + 1)).tolist()
        for w in steps:
            yield from [(w,)] if len(self.own) == 1 else [(w, math.log(g)) for g in DAMPING]

    def coefficients(self, point: tuple[float, ...]) -> dict[str, float]:
        """Own coefficients at a point: a power of the frequency for the lower order, damping for the higher."""
        w = math.exp(point[0]) if point else 1.0
        shares = [1.0, math.exp(point[1]) if len(point) > 1 else 1.0]
        ordered = sorted(self.own, key=lambda item: item[1])
        return {n: -g * w ** (self.top - order) for (n, order), g in zip(ordered, shares, strict=False)}

    def stable(self, point: tuple[float, ...]) -> bool:
        """Whether the model is stable at a point; True if no own coefficient is free."""
        if not point:
            return True
        values = self.coefficients(point)
        item = self.structure.equations[0]
        own = [
            (
                t.factor * values[t.coefficient] if isinstance(t.coefficient, str) else float(t.fixed or 0.0),
                t.order.constant,
            )
            for t in item.terms
            if t.signal == item.output
        ]
        return not _core.grows(item.order.constant, own)


@dataclass
class Products:
    """Inner products of the responses of the columns and of the residual without inputs, by point and run."""

    points: list[tuple[float, ...]]
    values: Floats


def screened(inside: Inside, folds: Folds, pool: Pool) -> list[Screened]:
    """Return every subset at integer orders, best prediction first; empty if the screening does not apply.

    It needs several runs, or a validation run: blocks of one run share initial terms.
    """
    # Subsets are compared as bodies that slide; friction that may be left out is added to the best.
    inside = Inside(inside.sliding)
    structure = inside.structure
    drives = [t for t in structure.equations[0].terms if t.signal != structure.equations[0].output]
    if (
        len(structure.equations) > 1
        or structure.has_friction
        or structure.free_inputs
        or sum(t.coefficient in inside.droppable for t in drives) < LEAST_DRIVES
        or any(f.rows is not None for f in folds.parts)
    ):
        return []
    runs = list(folds.runs)
    runs += [f.judged for f in folds.parts if not any(f.judged is r for r in runs)]
    found: dict[str, Screened] = {}
    for ground in grounds(inside, tuple(runs)):
        for one in judged_subsets(ground, folds, pool):
            key = signature(inside.build(one.change.variant))
            if key not in found or one.score < found[key].score:
                found[key] = one
    return sorted(found.values(), key=lambda s: (s.score, s.change.words))


def grounds(inside: Inside, runs: tuple[Run, ...]) -> Iterator[Ground]:
    """Yield base models: at most two own terms at integer orders, with and without an offset."""
    structure = inside.structure
    item = structure.equations[0]
    own = [t for t in item.terms if t.signal == item.output]
    tops = inside.wholes(item.order.names[0]) if item.order.is_single else [item.order.constant]
    seen: set[str] = set()
    for top in (v for v in tops if v > 0):
        for places in itertools.product(*(_places(inside, t, top) for t in own)):
            there = [(t, p) for t, p in zip(own, places, strict=True) if p is not None]
            if len({p for _, p in there}) < len(there) or (own and not there):
                continue
            free = tuple((t.coefficient, p) for t, p in there if isinstance(t.coefficient, str))
            if len(free) > 2:
                continue
            whole = {t.order.names[0]: p for t, p in there if t.order.is_single}
            whole |= {item.order.names[0]: top} if item.order.is_single else {}
            offsets = (False, True) if inside.offset_allowed else (False,)
            for offset in (True,) if structure.offset == "constant" else offsets:
                variant = Variant(frozenset(n for n, _ in free), tuple(sorted(whole.items())), offset)
                ground = _ground(inside, variant, [(t, p) for t, p in there], top, free, runs)
                key = "" if ground is None else signature(ground.structure)
                if ground is not None and key not in seen:
                    seen.add(key)
                    yield ground


def _places(inside: Inside, term: Term, top: float) -> list[float | None]:
    """Integer orders of an own term below the highest, and None if it is optional."""
    out: list[float | None] = [None] if term.coefficient in inside.droppable else []
    places = inside.wholes(term.order.names[0]) if term.order.is_single else [term.order.constant]
    return out + [p for p in places if p < top]


def _ground(
    inside: Inside,
    variant: Variant,
    own: Sequence[tuple[Term, float]],
    top: float,
    free: tuple[tuple[str, float], ...],
    runs: tuple[Run, ...],
) -> Ground | None:
    """Return a base model with every possible column; None if there is none, or not all are linear."""
    item = inside.structure.equations[0]
    known = [t for t in item.terms if t.signal != item.output and t.fixed is not None]
    kept = [replace(t, order=Order(p)) for t, p in own]
    columns: list[Column] = []
    terms: list[Term] = []
    taken = {n for n, _ in free}
    for term in item.terms:
        if term.signal == item.output or term.coefficient not in inside.droppable:
            continue
        if term.coefficient in taken:
            return None
        names = term.order.names
        for place in inside.wholes(names[0]) if term.order.is_single else [term.order.constant]:
            column = Column(str(term.coefficient), term.signal, place, tuple(names))
            made = column.term(term, f"column{len(columns)}")
            if _drives(inside.structure, [*kept, *known, made], top, runs):
                columns.append(column)
                terms.append(made)
    if not columns:
        return None
    asked: Offset = (
        inside.structure.offset if inside.structure.offset == "ramp" else "constant" if variant.offset else "none"
    )
    structure = _with_terms(inside.structure, [*kept, *known, *terms], top, asked)
    return Ground(inside, variant, decided(structure, runs), free, tuple(columns), runs)


def _with_terms(structure: Structure, terms: Sequence[Term], top: float, offset: Offset) -> Structure:
    item = replace(structure.equations[0], order=Order(top), terms=tuple(terms))
    signals = tuple(dict.fromkeys((item.output, *item.signals)))
    return replace(
        structure,
        equations=(item,),
        order_values={},
        offset=offset,
        delay={n: v for n, v in structure.delay.items() if n in signals},
        limited=tuple(x for x in structure.limits if x.signal in signals) or UNSET,
        sensor_filter=narrowed(structure.sensor_filter, signals),
    )


def _drives(structure: Structure, terms: Sequence[Term], top: float, runs: Sequence[Run]) -> bool:
    """Whether these terms form an equation that the runs can simulate."""
    try:
        made = decided(_with_terms(structure, terms, top, "none"), runs)
        Grid(FreeProblem.of(made), runs[:1], [1.0], decimation=_thinning(runs)).experiments  # noqa: B018
    except FtlmError:
        return False
    return True


def _thinning(runs: Sequence[Run]) -> int:
    return max(1, min(run.length - 1 for run in runs) // SAMPLES)


def judged_subsets(
    ground: Ground, folds: Folds, pool: Pool, points: Sequence[tuple[float, ...]] | None = None
) -> list[Screened]:
    """Score subsets of the columns of a base model by their residuals on validation data.

    Own coefficients are those of given points, or of a grid refined around the best points.
    """
    problem = FreeProblem.of(ground.structure)
    grid = Grid(problem, ground.runs, [1.0], decimation=_thinning(ground.runs))
    # Made here, once, before the threads ask for them.
    experiments, ends = grid.experiments, np.cumsum([0, *(count for _, count in grid.counts)]).tolist()
    places = [problem.coefficients.index(f"column{k}") for k in range(len(ground.columns))]

    def one(points: Sequence[tuple[float, ...]]) -> list[Floats | None]:
        return [_products(ground, problem, experiments, ends, places, p) for p in points]

    def all_of(points: Sequence[tuple[float, ...]]) -> list[tuple[tuple[float, ...], Floats]]:
        asked = [p for p in points if ground.stable(p)]
        chunks = [asked[k : k + CHUNK] for k in range(0, len(asked), CHUNK)]
        made = [g for part in pool.quietly(one, chunks) for g in part]
        return [(p, g) for p, g in zip(asked, made, strict=True) if g is not None]

    there = all_of(list(ground.lattice()) if points is None else points)
    judge = Judge.of(ground, folds, [float(np.nanvar(r[ground.structure.outputs[0]])) for r in ground.runs], ends)
    spacing = (SPACING, math.log(DAMPING[1] / DAMPING[0]))
    for zoom in range(ZOOMS + 1):
        if not there:
            return []
        products = Products([p for p, _ in there], np.array([g for _, g in there]))
        found = judge.every(products)
        if zoom == ZOOMS or points is not None or not ground.own:
            break
        spacing = (spacing[0] / 2, spacing[1] / 2)
        known = {p for p, _ in there}
        best = sorted(found, key=lambda s: found[s].score)[:LEADING]
        centres = dict.fromkeys(products.points[k] for s in best for k in found[s].points)
        near = (
            tuple(c + m * w for c, m, w in zip(centre, moves, spacing, strict=False))
            for centre in centres
            for moves in itertools.product((-1, 0, 1), repeat=len(centre))
        )
        there += all_of([p for p in dict.fromkeys(near) if p not in known])
    out = []
    for subset, verdict in found.items():
        change = _change(ground, subset)
        if change is not None:
            values = ground.coefficients(products.points[verdict.points[-1]])
            values |= {ground.columns[k].coefficient: c for k, c in zip(subset, verdict.coefficients, strict=True)}
            out.append(Screened(change, values, verdict.score))
    return out


def _products(
    ground: Ground,
    problem: FreeProblem,
    experiments: list[object],
    ends: Sequence[int],
    places: Sequence[int],
    point: tuple[float, ...],
) -> Floats | None:
    """Inner products by run of the responses to the columns and of the residual; None if a response diverges."""
    values = ground.coefficients(point)
    coefficients = [values.get(n, 0.0) for n in problem.coefficients]
    try:
        outcome = descend(problem, experiments, Attempt([], coefficients, "", {}), evaluations=1, plain=True).outcome
    except FtlmError:
        return None
    rows = np.vstack([np.asarray(outcome["jacobian"])[places], np.asarray(outcome["residuals"])])
    if not np.isfinite(rows).all():
        return None
    return np.stack([rows[:, a:b] @ rows[:, a:b].T for a, b in itertools.pairwise(ends)])


def _change(ground: Ground, subset: Sequence[int]) -> Change | None:
    """Return a subset as a change to a variant; None if it is invalid."""
    chosen = [ground.columns[k] for k in subset]
    whole = {**ground.variant.held(), **{n: c.place for c in chosen for n in c.names}}
    kept = ground.variant.kept | {c.coefficient for c in chosen}
    variant = replace(ground.variant, kept=frozenset(kept)).with_whole(whole)
    if not ground.inside.possible(variant):
        return None
    return Change(worded(ground.inside.build(variant)), variant)


@dataclass(frozen=True)
class Verdict:
    """Score of a subset, its grid points by fold (last: all runs), and its coefficients there."""

    score: float
    points: tuple[int, ...]
    coefficients: tuple[float, ...]


@dataclass(frozen=True)
class Judge:
    """Scorer of subsets: estimation runs by fold (last: all), validation run by fold, and output powers."""

    columns: tuple[Column, ...]
    fitted: tuple[tuple[int, ...], ...]
    judged: tuple[int, ...]
    sizes: Floats

    @classmethod
    def of(cls, ground: Ground, folds: Folds, spread: Sequence[float], ends: Sequence[int]) -> Judge:
        """Build from the folds on the runs of a base model."""

        def place(run: Run) -> int:
            return next(k for k, r in enumerate(ground.runs) if r is run)

        fitted = [tuple(place(r) for r in f.runs) for f in folds.parts]
        sizes = np.array([v * (b - a) for v, (a, b) in zip(spread, itertools.pairwise(ends), strict=True)])
        return cls(
            ground.columns,
            (*fitted, tuple(place(r) for r in folds.runs)),
            tuple(place(f.judged) for f in folds.parts),
            sizes,
        )

    def one(self, products: Floats, pooled: Floats, subset: Sequence[int]) -> Verdict:
        """Fit a subset on the runs of each fold at its best point, and score it on the validation run."""
        keys = [*subset, -1]
        cut = pooled[:, :, keys][:, :, :, keys]
        matrix, right, rest = cut[..., :-1, :-1], cut[..., :-1, -1], cut[..., -1, -1]
        scale = np.sqrt(np.maximum(np.einsum("...kk->...k", matrix), np.finfo(float).tiny))
        even = matrix / scale[..., None] / scale[..., None, :] + UNTOLD * np.eye(len(subset))
        found = -np.linalg.solve(even, (right / scale)[..., None])[..., 0] / scale
        left = rest + np.einsum("pfk,pfk->pf", found, right)
        points = np.argmin(left, axis=0)
        scores = []
        for fold, run in enumerate(self.judged):
            at, c = points[fold], found[points[fold], fold]
            whole = products[at, run][keys][:, keys]
            with_one = np.append(c, 1.0)
            share = math.sqrt(max(float(with_one @ whole @ with_one), 0.0) / float(self.sizes[run]))
            scores.append(math.log(min(max(share, 1e-12), 1.0 - LOST / 100.0)))
        return Verdict(float(np.mean(scores)), tuple(points.tolist()), tuple(found[points[-1], -1].tolist()))

    def every(self, products: Products) -> dict[tuple[int, ...], Verdict]:
        """Score every subset; if there are too many, extend the best of each size."""
        values = products.values
        pooled = np.stack([values[:, list(runs)].sum(axis=1) for runs in self.fitted], axis=1)
        choices: dict[str, list[int]] = {}
        for k, column in enumerate(self.columns):
            choices.setdefault(column.coefficient, []).append(k)
        count = math.prod(1 + len(c) for c in choices.values()) - 1
        out: dict[tuple[int, ...], Verdict] = {}

        def judge(subsets: Iterable[tuple[int, ...]]) -> None:
            for subset in subsets:
                if subset not in out:
                    out[subset] = self.one(values, pooled, subset)

        if count <= ALL:
            judge(
                tuple(sorted(k for k in chosen if k is not None))
                for chosen in itertools.product(*([None, *c] for c in choices.values()))
                if any(k is not None for k in chosen)
            )
            return out
        width = max(4, ALL // len(self.columns) ** 2)
        ahead: list[tuple[int, ...]] = [()]
        for _ in choices:
            wider = {
                tuple(sorted((*subset, k)))
                for subset in ahead
                for places in choices.values()
                if not set(places) & set(subset)
                for k in places
            }
            judge(sorted(wider))
            ahead = sorted(wider, key=lambda s: (out[s].score, s))[:width]
        return out
