"""Best-subset search over the input terms of one equation, with scores in closed form.

The coefficients of output terms are taken from a grid; those of input terms then follow by linear least squares.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np

from ftlm import _core
from ftlm.data.run import Run
from ftlm.errors import FtlmError
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Iterate, Objective, minimize_cost
from ftlm.structure.equation import Term
from ftlm.structure.order import Order
from ftlm.structure.structure import Offset, Structure, restrict_structure
from ftlm.structure_selection.candidates import Change, NestedStructures, Variant, describe_structure, signature
from ftlm.structure_selection.cross_validation import MIN_FIT_PERCENT, Folds, fix_initial_conditions
from ftlm.utils.validation import Floats

Item = TypeVar("Item")
Result = TypeVar("Result")
#: Minimum number of input terms for best-subset screening. Stepwise selection is as fast for fewer.
MIN_INPUT_TERMS = 3
#: Minimum number of samples of a subsampled run.
MIN_SCREENING_SAMPLES = 1000
#: Spacing of the grid in ln(frequency), damping factors, and number of times that the spacing is halved around the best
#: points.
LOG_FREQUENCY_SPACING = 0.15
DAMPING_FACTORS = tuple(np.geomspace(0.006, 4.0, 10).tolist())
GRID_REFINEMENTS = 2
#: Number of best subsets around whose grid points the grid is refined.
REFINED_SUBSETS = 24
#: Maximum number of subsets for an exhaustive search. Beyond it, the best subsets of each size are extended.
MAX_EXHAUSTIVE_SUBSETS = 4096
#: Ridge added to the scaled normal matrix, for collinear responses.
RELATIVE_RIDGE = 1e-12
#: Number of grid points per task.
POINTS_PER_TASK = 16


class TaskPool(Protocol):
    """Protocol of a pool that applies a function to items and returns the results in the sequence of the items."""

    def map_items(self, work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
        """Return the results of `work` for all items, in the sequence of the items."""


@dataclass(frozen=True)
class ScreenedSubset:
    """Subset of input terms, with the initial guess for its fit and its score.

    The score is the mean over folds of ln(1 - fit / 100); lower is better.
    """

    change: Change
    start: Mapping[str, float]
    score: float


@dataclass(frozen=True)
class Column:
    """Input term at one integer value of its order; ``names`` are the free orders that this value fixes."""

    coefficient: str
    order: float
    names: tuple[str, ...]


@dataclass(frozen=True)
class BaseModel:
    """Terms of the output at integer orders, with coefficients from a grid, and the candidate input terms (columns)."""

    inside: NestedStructures
    variant: Variant
    structure: Structure
    own: tuple[tuple[str, float], ...]
    columns: tuple[Column, ...]
    runs: tuple[Run, ...]

    def grid_points(self) -> Iterator[tuple[float, ...]]:
        """Yield grid points, with coordinates ln(frequency) and ln(damping).

        There is one coordinate for each free coefficient of an output term.
        """
        if not self.own:
            yield ()
            return
        longest = max(r.length * r.step for r in self.runs)
        low, high = math.log(1.0 / longest), math.log(math.pi / (2.0 * min(r.step for r in self.runs)))
        steps = np.linspace(low, high, max(2, math.ceil((high - low) / LOG_FREQUENCY_SPACING) + 1)).tolist()
        for w in steps:
            yield from [(w,)] if len(self.own) == 1 else [(w, math.log(g)) for g in DAMPING_FACTORS]

    def coefficients(self, point: tuple[float, ...]) -> dict[str, float]:
        """Return the coefficients of the output terms at a grid point.

        The coefficient of a term of order ν is -g ω^(α-ν) with the frequency ω, where g is 1 for the lowest order and
        the damping for the other order.
        """
        w = math.exp(point[0]) if point else 1.0
        shares = [1.0, math.exp(point[1]) if len(point) > 1 else 1.0]
        ordered = sorted(self.own, key=lambda item: item[1])
        alpha = self.structure.equations[0].order.constant
        return {n: -g * w ** (alpha - order) for (n, order), g in zip(ordered, shares, strict=False)}

    def is_stable(self, point: tuple[float, ...]) -> bool:
        """Whether the model is stable at a grid point; True if no coefficient of an output term is free."""
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
        return not _core.has_unstable_pole(item.order.constant, own)


def screen_subsets(inside: NestedStructures, folds: Folds, pool: TaskPool) -> list[ScreenedSubset]:
    """Return every subset of input terms at integer orders, best prediction first; [] if screening does not apply.

    Screening requires several runs or a validation run, because blocks of one run share initial terms.
    """
    # Optional friction is not linear in its parameters; stepwise selection adds it to the best subset.
    inside = NestedStructures(inside.without_optional_friction)
    structure = inside.structure
    drives = [t for t in structure.equations[0].terms if t.signal != structure.equations[0].output]
    if (
        len(structure.equations) > 1
        or not structure.is_linear
        or structure.free_inputs
        or sum(t.coefficient in inside.droppable for t in drives) < MIN_INPUT_TERMS
        or any(f.rows is not None for f in folds.parts)
    ):
        return []
    runs = list(folds.runs)
    runs += [f.validation_run for f in folds.parts if not any(f.validation_run is r for r in runs)]
    subsets: dict[str, ScreenedSubset] = {}
    for base in base_models(inside, tuple(runs)):
        for one in score_subsets(base, folds, pool):
            key = signature(inside.build(one.change.variant))
            if key not in subsets or one.score < subsets[key].score:
                subsets[key] = one
    return sorted(subsets.values(), key=lambda s: (s.score, s.change.words))


#: Free coefficients of output terms, as (name, integer order of the term).
Free = tuple[tuple[str, float], ...]


def base_models(inside: NestedStructures, runs: tuple[Run, ...]) -> Iterator[BaseModel]:
    """Yield the base models: at most two output terms at integer orders, with and without an offset."""
    structure = inside.structure
    item = structure.equations[0]
    own = [t for t in item.terms if t.signal == item.output]
    tops = inside.integer_values(item.order.names[0]) if item.order.is_single else [item.order.constant]
    input_terms = [t for t in item.terms if t.signal != item.output and t.fixed is not None]
    droppable = [t for t in item.terms if t.signal != item.output and t.coefficient in inside.droppable]

    def base_model(variant: Variant, present: Sequence[Term], top: float, free: Free) -> BaseModel | None:
        """Return a base model with every valid column; None if there is none, or if two terms share a coefficient."""
        if {t.coefficient for t in droppable} & {n for n, _ in free}:
            return None
        columns: list[Column] = []
        terms: list[Term] = []
        for term in droppable:
            names = term.order.names
            for place in inside.integer_values(names[0]) if term.order.is_single else [term.order.constant]:
                column = Column(str(term.coefficient), place, tuple(names))
                column_term = replace(term, order=Order(place), coefficient=f"column{len(columns)}")
                if _is_valid_input_set(structure, [*present, *input_terms, column_term], top, runs):
                    columns.append(column)
                    terms.append(column_term)
        if not columns:
            return None
        offset: Offset = structure.offset if structure.offset == "ramp" else "constant" if variant.offset else "none"
        whole = _with_terms(structure, [*present, *input_terms, *terms], top, offset)
        return BaseModel(inside, variant, fix_initial_conditions(whole, runs), free, tuple(columns), runs)

    keys: set[str] = set()
    for top in (v for v in tops if v > 0):
        for places in itertools.product(*(_candidate_orders(inside, t, top) for t in own)):
            terms_present = [(t, p) for t, p in zip(own, places, strict=True) if p is not None]
            if len({p for _, p in terms_present}) < len(terms_present) or (own and not terms_present):
                continue
            free = tuple((t.coefficient, p) for t, p in terms_present if isinstance(t.coefficient, str))
            if len(free) > 2:
                continue
            whole = {t.order.names[0]: p for t, p in terms_present if t.order.is_single}
            whole |= {item.order.names[0]: top} if item.order.is_single else {}
            offsets = (False, True) if inside.offset_allowed else (False,)
            for offset in (True,) if structure.offset == "constant" else offsets:
                variant = Variant(frozenset(n for n, _ in free), tuple(sorted(whole.items())), offset)
                present = [replace(t, order=Order(p)) for t, p in terms_present]
                base = base_model(variant, present, top, free)
                key = "" if base is None else signature(base.structure)
                if base is not None and key not in keys:
                    keys.add(key)
                    yield base


def _candidate_orders(inside: NestedStructures, term: Term, top: float) -> list[float | None]:
    """Return the integer orders that an output term may have below the highest order, and None if it is optional."""
    out: list[float | None] = [None] if term.coefficient in inside.droppable else []
    places = inside.integer_values(term.order.names[0]) if term.order.is_single else [term.order.constant]
    return out + [p for p in places if p < top]


def _with_terms(structure: Structure, terms: Sequence[Term], top: float, offset: Offset) -> Structure:
    item = replace(structure.equations[0], order=Order(top), terms=tuple(terms))
    return restrict_structure(structure, (item,), offset=offset)


def _is_valid_input_set(structure: Structure, terms: Sequence[Term], top: float, runs: Sequence[Run]) -> bool:
    """Whether an equation with these input terms can be simulated on the runs."""
    try:
        candidate = fix_initial_conditions(_with_terms(structure, terms, top, "none"), runs)
        Objective(FreeProblem.of(candidate), runs[:1], [1.0], decimation=_decimation(runs)).experiments  # noqa: B018
    except FtlmError:
        return False
    return True


def _decimation(runs: Sequence[Run]) -> int:
    return max(1, min(run.length - 1 for run in runs) // MIN_SCREENING_SAMPLES)


def score_subsets(base: BaseModel, folds: Folds, pool: TaskPool) -> list[ScreenedSubset]:
    """Return the subsets of the columns of a base model, with their scores on validation data.

    The coefficients of output terms are those on a grid that is refined around the best ones.
    """
    problem = FreeProblem.of(base.structure)
    grid = Objective(problem, base.runs, [1.0], decimation=_decimation(base.runs))
    # Computed once here, because the threads share them.
    experiments, ends = grid.experiments, np.cumsum([0, *(count for _, count in grid.counts)]).tolist()
    places = [problem.coefficients.index(f"column{k}") for k in range(len(base.columns))]

    def products_at(point: tuple[float, ...]) -> Floats | None:
        """Return the Gram matrix of column responses and residual for each run; None if a response diverges."""
        values = base.coefficients(point)
        iterate = Iterate([], [values.get(n, 0.0) for n in problem.coefficients], "", {})
        try:
            outcome = minimize_cost(problem, experiments, iterate, evaluations=1, plain=True).outcome
        except FtlmError:
            return None
        rows = np.vstack([np.asarray(outcome["jacobian"])[places], np.asarray(outcome["residuals"])])
        if not np.isfinite(rows).all():
            return None
        return np.stack([rows[:, a:b] @ rows[:, a:b].T for a, b in itertools.pairwise(ends)])

    def one(points: Sequence[tuple[float, ...]]) -> list[Floats | None]:
        return [products_at(point) for point in points]

    def all_of(points: Sequence[tuple[float, ...]]) -> list[tuple[tuple[float, ...], Floats]]:
        stable = [p for p in points if base.is_stable(p)]
        chunks = [stable[k : k + POINTS_PER_TASK] for k in range(0, len(stable), POINTS_PER_TASK)]
        gram_matrices = [g for part in pool.map_items(one, chunks) for g in part]
        return [(p, g) for p, g in zip(stable, gram_matrices, strict=True) if g is not None]

    solutions = all_of(list(base.grid_points()))
    scorer = SubsetScorer.of(base, folds, [float(np.nanvar(r[base.structure.outputs[0]])) for r in base.runs], ends)
    spacing = (LOG_FREQUENCY_SPACING, math.log(DAMPING_FACTORS[1] / DAMPING_FACTORS[0]))
    for zoom in range(GRID_REFINEMENTS + 1):
        if not solutions:
            return []
        scores = scorer.score_all(np.array([g for _, g in solutions]))
        if zoom == GRID_REFINEMENTS or not base.own:
            break
        spacing = (spacing[0] / 2, spacing[1] / 2)
        points_before = {p for p, _ in solutions}
        best = sorted(scores, key=lambda s: scores[s].score)[:REFINED_SUBSETS]
        centres = dict.fromkeys(solutions[k][0] for s in best for k in scores[s].points)
        near = (
            tuple(c + m * w for c, m, w in zip(centre, moves, spacing, strict=False))
            for centre in centres
            for moves in itertools.product((-1, 0, 1), repeat=len(centre))
        )
        solutions += all_of([p for p in dict.fromkeys(near) if p not in points_before])
    out = []
    for subset, verdict in scores.items():
        change = _change(base, subset)
        if change is not None:
            values = base.coefficients(solutions[verdict.points[-1]][0])
            values |= {base.columns[k].coefficient: c for k, c in zip(subset, verdict.coefficients, strict=True)}
            out.append(ScreenedSubset(change, values, verdict.score))
    return out


def _change(base: BaseModel, subset: Sequence[int]) -> Change | None:
    """Return the change that adds a subset of columns to a structure; None if the result is invalid."""
    columns = [base.columns[k] for k in subset]
    whole = {**base.variant.integer_order_values(), **{n: c.order for c in columns for n in c.names}}
    coefficients = base.variant.coefficients | {c.coefficient for c in columns}
    variant = replace(base.variant, coefficients=frozenset(coefficients)).with_integer_orders(whole)
    if not base.inside.is_valid(variant):
        return None
    return Change(describe_structure(base.inside.build(variant)), variant)


@dataclass(frozen=True)
class SubsetScore:
    """Score of a subset, with its coefficients from all runs.

    ``points`` are the indices of the best grid points: one for each fold, then the one for all runs.
    """

    score: float
    points: tuple[int, ...]
    coefficients: tuple[float, ...]


@dataclass(frozen=True)
class SubsetScorer:
    """Closed-form scoring of subsets of columns from inner products.

    Parameters
    ----------
    columns
        Columns of the base model.
    estimation_runs
        Indices of the estimation runs of each fold. The last entry has the indices of all runs.
    validation_runs
        Index of the validation run in each fold.
    sizes
        For each run, the sum of squared deviations of the output from its mean.
    """

    columns: tuple[Column, ...]
    estimation_runs: tuple[tuple[int, ...], ...]
    validation_runs: tuple[int, ...]
    sizes: Floats

    @classmethod
    def of(cls, base: BaseModel, folds: Folds, spread: Sequence[float], ends: Sequence[int]) -> SubsetScorer:
        """Return the scorer for the columns of a base model and the folds of a validation.

        `spread` are the variances of the output in each run, and `ends` are the boundaries of the runs among the
        compared samples.
        """

        def place(run: Run) -> int:
            return next(k for k, r in enumerate(base.runs) if r is run)

        fit_parts = [tuple(place(r) for r in f.runs) for f in folds.parts]
        sizes = np.array([v * (b - a) for v, (a, b) in zip(spread, itertools.pairwise(ends), strict=True)])
        return cls(
            base.columns,
            (*fit_parts, tuple(place(r) for r in folds.runs)),
            tuple(place(f.validation_run) for f in folds.parts),
            sizes,
        )

    def score_subset(self, products: Floats, pooled: Floats, subset: Sequence[int]) -> SubsetScore:
        """Return the score of a subset on validation runs.

        It is fitted on the estimation runs of each fold, at the best grid point of the fold. `products` are
        :attr:`Products.values`, and `pooled` are their sums over the estimation runs of each fold.
        """
        keys = [*subset, -1]
        cut = pooled[:, :, keys][:, :, :, keys]
        matrix, right, rest = cut[..., :-1, :-1], cut[..., :-1, -1], cut[..., -1, -1]
        scale = np.sqrt(np.maximum(np.einsum("...kk->...k", matrix), np.finfo(float).tiny))
        even = matrix / scale[..., None] / scale[..., None, :] + RELATIVE_RIDGE * np.eye(len(subset))
        solutions = -np.linalg.solve(even, (right / scale)[..., None])[..., 0] / scale
        remainders = rest + np.einsum("pfk,pfk->pf", solutions, right)
        points = np.argmin(remainders, axis=0)
        scores = []
        for fold, run in enumerate(self.validation_runs):
            at, c = points[fold], solutions[points[fold], fold]
            whole = products[at, run][keys][:, keys]
            with_one = np.append(c, 1.0)
            share = math.sqrt(max(float(with_one @ whole @ with_one), 0.0) / float(self.sizes[run]))
            scores.append(math.log(min(max(share, 1e-12), 1.0 - MIN_FIT_PERCENT / 100.0)))
        return SubsetScore(float(np.mean(scores)), tuple(points.tolist()), tuple(solutions[points[-1], -1].tolist()))

    def score_all(self, products: Floats) -> dict[tuple[int, ...], SubsetScore]:
        """Return the scores of all subsets from Gram matrices, shape (grid points, runs, columns + 1, columns + 1).

        The matrices have the responses to the columns, and last the residual of the model without inputs. If there are
        too many subsets, they are extended column by column from the best ones of each size, and the remaining ones are
        not scored.
        """
        pooled = np.stack([products[:, list(runs)].sum(axis=1) for runs in self.estimation_runs], axis=1)
        choices: dict[str, list[int]] = {}
        for k, column in enumerate(self.columns):
            choices.setdefault(column.coefficient, []).append(k)
        count = math.prod(1 + len(c) for c in choices.values()) - 1
        out: dict[tuple[int, ...], SubsetScore] = {}

        def score_missing(subsets: Iterable[tuple[int, ...]]) -> None:
            for subset in subsets:
                if subset not in out:
                    out[subset] = self.score_subset(products, pooled, subset)

        if count <= MAX_EXHAUSTIVE_SUBSETS:
            score_missing(
                tuple(sorted(k for k in subset if k is not None))
                for subset in itertools.product(*([None, *c] for c in choices.values()))
                if any(k is not None for k in subset)
            )
            return out
        width = max(4, MAX_EXHAUSTIVE_SUBSETS // len(self.columns) ** 2)
        candidate_subsets: list[tuple[int, ...]] = [()]
        for _ in choices:
            wider = {
                tuple(sorted((*subset, k)))
                for subset in candidate_subsets
                for places in choices.values()
                if not set(places) & set(subset)
                for k in places
            }
            score_missing(sorted(wider))
            candidate_subsets = sorted(wider, key=lambda s: (out[s].score, s))[:width]
        return out
