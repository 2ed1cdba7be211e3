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

    nested: NestedStructures
    variant: Variant
    structure: Structure
    output_coefficients: tuple[tuple[str, float], ...]
    columns: tuple[Column, ...]
    runs: tuple[Run, ...]

    def grid_points(self) -> Iterator[tuple[float, ...]]:
        """Yield grid points, with coordinates ln(frequency) and ln(damping).

        There is one coordinate for each free coefficient of an output term.
        """
        if not self.output_coefficients:
            yield ()
            return
        longest = max(r.length * r.step for r in self.runs)
        low, high = math.log(1.0 / longest), math.log(math.pi / (2.0 * min(r.step for r in self.runs)))
        frequencies = np.linspace(low, high, max(2, math.ceil((high - low) / LOG_FREQUENCY_SPACING) + 1)).tolist()
        for w in frequencies:
            yield from [(w,)] if len(self.output_coefficients) == 1 else [(w, math.log(g)) for g in DAMPING_FACTORS]

    def coefficients(self, point: tuple[float, ...]) -> dict[str, float]:
        """Return the coefficients of the output terms at a grid point.

        The coefficient of a term of order ν is -g ω^(α-ν) with the frequency ω, where g is 1 for the lowest order and
        the damping for the other order.
        """
        w = math.exp(point[0]) if point else 1.0
        factors = [1.0, math.exp(point[1]) if len(point) > 1 else 1.0]
        ordered = sorted(self.output_coefficients, key=lambda item: item[1])
        alpha = self.structure.equations[0].order.constant
        return {n: -g * w ** (alpha - order) for (n, order), g in zip(ordered, factors, strict=False)}

    def is_stable(self, point: tuple[float, ...]) -> bool:
        """Whether the model is stable at a grid point; True if no coefficient of an output term is free."""
        if not point:
            return True
        values = self.coefficients(point)
        equation = self.structure.equations[0]
        output_terms = [
            (
                t.factor * values[t.coefficient] if isinstance(t.coefficient, str) else float(t.fixed_value or 0.0),
                t.order.constant,
            )
            for t in equation.terms
            if t.signal == equation.output
        ]
        return not _core.has_unstable_pole(equation.order.constant, output_terms)


def screen_subsets(nested: NestedStructures, folds: Folds, pool: TaskPool) -> list[ScreenedSubset]:
    """Return every subset of input terms at integer orders, best prediction first; [] if screening does not apply.

    Screening requires several runs or a validation run, because blocks of one run share initial terms.
    """
    # Optional friction is not linear in its parameters; stepwise selection adds it to the best subset.
    nested = NestedStructures(nested.without_optional_friction)
    structure = nested.structure
    input_terms = [t for t in structure.equations[0].terms if t.signal != structure.equations[0].output]
    if (
        len(structure.equations) > 1
        or not structure.is_linear
        or structure.free_input_parameters
        or sum(t.coefficient in nested.droppable for t in input_terms) < MIN_INPUT_TERMS
        or any(f.rows is not None for f in folds.parts)
    ):
        return []
    runs = list(folds.runs)
    runs += [f.validation_run for f in folds.parts if not any(f.validation_run is r for r in runs)]
    subsets: dict[str, ScreenedSubset] = {}
    for base in base_models(nested, tuple(runs)):
        for subset in score_subsets(base, folds, pool):
            key = signature(nested.build(subset.change.variant))
            if key not in subsets or subset.score < subsets[key].score:
                subsets[key] = subset
    return sorted(subsets.values(), key=lambda s: (s.score, s.change.words))


#: Free coefficients of output terms, as (name, integer order of the term).
Free = tuple[tuple[str, float], ...]


def base_models(nested: NestedStructures, runs: tuple[Run, ...]) -> Iterator[BaseModel]:
    """Yield the base models: at most two output terms at integer orders, with and without an offset."""
    structure = nested.structure
    equation = structure.equations[0]
    output_terms = [t for t in equation.terms if t.signal == equation.output]
    tops = nested.integer_values(equation.order.names[0]) if equation.order.is_single else [equation.order.constant]
    input_terms = [t for t in equation.terms if t.signal != equation.output and t.fixed_value is not None]
    droppable = [t for t in equation.terms if t.signal != equation.output and t.coefficient in nested.droppable]

    def base_model(variant: Variant, fixed_terms: Sequence[Term], highest_order: float, free: Free) -> BaseModel | None:
        """Return a base model with every valid column; None if there is none, or if two terms share a coefficient."""
        if {t.coefficient for t in droppable} & {n for n, _ in free}:
            return None
        columns: list[Column] = []
        terms: list[Term] = []
        for term in droppable:
            names = term.order.names
            for value in nested.integer_values(names[0]) if term.order.is_single else [term.order.constant]:
                column = Column(str(term.coefficient), value, tuple(names))
                column_term = replace(term, order=Order(value), coefficient=f"column{len(columns)}")
                if _is_valid_input_set(structure, [*fixed_terms, *input_terms, column_term], highest_order, runs):
                    columns.append(column)
                    terms.append(column_term)
        if not columns:
            return None
        offset: Offset = structure.offset if structure.offset == "ramp" else "constant" if variant.offset else "none"
        full_structure = _with_terms(structure, [*fixed_terms, *input_terms, *terms], highest_order, offset)
        return BaseModel(nested, variant, fix_initial_conditions(full_structure, runs), free, tuple(columns), runs)

    keys: set[str] = set()
    for highest_order in (v for v in tops if v > 0):
        for constants in itertools.product(*(_candidate_orders(nested, t, highest_order) for t in output_terms)):
            terms_present = [(t, p) for t, p in zip(output_terms, constants, strict=True) if p is not None]
            if len({p for _, p in terms_present}) < len(terms_present) or (output_terms and not terms_present):
                continue
            free = tuple((t.coefficient, p) for t, p in terms_present if isinstance(t.coefficient, str))
            if len(free) > 2:
                continue
            integer_orders = {t.order.names[0]: p for t, p in terms_present if t.order.is_single}
            integer_orders |= {equation.order.names[0]: highest_order} if equation.order.is_single else {}
            offsets = (False, True) if nested.offset_allowed else (False,)
            for offset in (True,) if structure.offset == "constant" else offsets:
                variant = Variant(frozenset(n for n, _ in free), tuple(sorted(integer_orders.items())), offset)
                fixed_terms = [replace(t, order=Order(p)) for t, p in terms_present]
                base = base_model(variant, fixed_terms, highest_order, free)
                key = "" if base is None else signature(base.structure)
                if base is not None and key not in keys:
                    keys.add(key)
                    yield base


def _candidate_orders(nested: NestedStructures, term: Term, highest_order: float) -> list[float | None]:
    """Return the integer orders that an output term may have below the highest order, and None if it is optional."""
    out: list[float | None] = [None] if term.coefficient in nested.droppable else []
    values = nested.integer_values(term.order.names[0]) if term.order.is_single else [term.order.constant]
    return out + [p for p in values if p < highest_order]


def _with_terms(structure: Structure, terms: Sequence[Term], highest_order: float, offset: Offset) -> Structure:
    equation = replace(structure.equations[0], order=Order(highest_order), terms=tuple(terms))
    return restrict_structure(structure, (equation,), offset=offset)


def _is_valid_input_set(structure: Structure, terms: Sequence[Term], highest_order: float, runs: Sequence[Run]) -> bool:
    """Whether an equation with these input terms can be simulated on the runs."""
    try:
        candidate = fix_initial_conditions(_with_terms(structure, terms, highest_order, "none"), runs)
        Objective(FreeProblem.of(candidate), runs[:1], [1.0], decimation=_decimation(runs)).experiments  # noqa: B018
    except FtlmError:
        return False
    return True


def _decimation(runs: Sequence[Run]) -> int:
    return max(1, min(run.length - 1 for run in runs) // MIN_SCREENING_SAMPLES)


def score_subsets(base: BaseModel, folds: Folds, pool: TaskPool) -> list[ScreenedSubset]:
    """Return the subsets of the columns of a base model, with their scores on validation data.

    The coefficients of output terms are on a grid, which is refined around its best points.
    """
    problem = FreeProblem.of(base.structure)
    objective = Objective(problem, base.runs, [1.0], decimation=_decimation(base.runs))
    # Computed once here, because the threads share them.
    experiments, boundaries = objective.experiments, np.cumsum([0, *(count for _, count in objective.counts)]).tolist()
    indices = [problem.coefficients.index(f"column{k}") for k in range(len(base.columns))]

    def products_at(point: tuple[float, ...]) -> Floats | None:
        """Return the Gram matrix of column responses and residual for each run; None if a response diverges."""
        values = base.coefficients(point)
        iterate = Iterate([], [values.get(n, 0.0) for n in problem.coefficients], "", {})
        try:
            outcome = minimize_cost(problem, experiments, iterate, evaluations=1, linear_scale=True).outcome
        except FtlmError:
            return None
        rows = np.vstack([np.asarray(outcome["jacobian"])[indices], np.asarray(outcome["residuals"])])
        if not np.isfinite(rows).all():
            return None
        return np.stack([rows[:, a:b] @ rows[:, a:b].T for a, b in itertools.pairwise(boundaries)])

    def products_of_chunk(points: Sequence[tuple[float, ...]]) -> list[Floats | None]:
        return [products_at(point) for point in points]

    def solutions_at(points: Sequence[tuple[float, ...]]) -> list[tuple[tuple[float, ...], Floats]]:
        stable = [p for p in points if base.is_stable(p)]
        chunks = [stable[k : k + POINTS_PER_TASK] for k in range(0, len(stable), POINTS_PER_TASK)]
        gram_matrices = [g for chunk in pool.map_items(products_of_chunk, chunks) for g in chunk]
        return [(p, g) for p, g in zip(stable, gram_matrices, strict=True) if g is not None]

    solutions = solutions_at(list(base.grid_points()))
    scorer = SubsetScorer.of(
        base, folds, [float(np.nanvar(r[base.structure.outputs[0]])) for r in base.runs], boundaries
    )
    spacing = (LOG_FREQUENCY_SPACING, math.log(DAMPING_FACTORS[1] / DAMPING_FACTORS[0]))
    for zoom in range(GRID_REFINEMENTS + 1):
        if not solutions:
            return []
        scores = scorer.score_all(np.array([g for _, g in solutions]))
        if zoom == GRID_REFINEMENTS or not base.output_coefficients:
            break
        spacing = (spacing[0] / 2, spacing[1] / 2)
        points_before = {p for p, _ in solutions}
        best = sorted(scores, key=lambda s: scores[s].score)[:REFINED_SUBSETS]
        centers = dict.fromkeys(solutions[k][0] for s in best for k in scores[s].points)
        neighbors = (
            tuple(c + m * w for c, m, w in zip(center, shifts, spacing, strict=False))
            for center in centers
            for shifts in itertools.product((-1, 0, 1), repeat=len(center))
        )
        solutions += solutions_at([p for p in dict.fromkeys(neighbors) if p not in points_before])
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
    integer_orders = {**base.variant.integer_order_values(), **{n: c.order for c in columns for n in c.names}}
    coefficients = base.variant.coefficients | {c.coefficient for c in columns}
    variant = replace(base.variant, coefficients=frozenset(coefficients)).with_integer_orders(integer_orders)
    if not base.nested.is_valid(variant):
        return None
    return Change(describe_structure(base.nested.build(variant)), variant)


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
    output_power
        For each run, the sum of squared deviations of the output from its mean.
    """

    columns: tuple[Column, ...]
    estimation_runs: tuple[tuple[int, ...], ...]
    validation_runs: tuple[int, ...]
    output_power: Floats

    @classmethod
    def of(cls, base: BaseModel, folds: Folds, variances: Sequence[float], boundaries: Sequence[int]) -> SubsetScorer:
        """Return the scorer for the columns of a base model and the folds of a validation.

        `variances` are the variances of the output in each run, and `boundaries` are the boundaries of the runs among
        the compared samples.
        """

        def run_index(run: Run) -> int:
            return next(k for k, r in enumerate(base.runs) if r is run)

        fit_parts = [tuple(run_index(r) for r in f.runs) for f in folds.parts]
        output_power = np.array(
            [v * (b - a) for v, (a, b) in zip(variances, itertools.pairwise(boundaries), strict=True)]
        )
        return cls(
            base.columns,
            (*fit_parts, tuple(run_index(r) for r in folds.runs)),
            tuple(run_index(f.validation_run) for f in folds.parts),
            output_power,
        )

    def score_subset(self, products: Floats, pooled: Floats, subset: Sequence[int]) -> SubsetScore:
        """Return the score of a subset on validation runs.

        The subset is fitted on the estimation runs of each fold, at the best grid point of the fold. `products` are the
        Gram matrices of :meth:`score_all`, and `pooled` are their sums over the estimation runs of each fold.
        """
        keys = [*subset, -1]
        cut = pooled[:, :, keys][:, :, :, keys]
        matrix, vector, rest = cut[..., :-1, :-1], cut[..., :-1, -1], cut[..., -1, -1]
        scale = np.sqrt(np.maximum(np.einsum("...kk->...k", matrix), np.finfo(float).tiny))
        scaled = matrix / scale[..., None] / scale[..., None, :] + RELATIVE_RIDGE * np.eye(len(subset))
        solutions = -np.linalg.solve(scaled, (vector / scale)[..., None])[..., 0] / scale
        remainders = rest + np.einsum("pfk,pfk->pf", solutions, vector)
        points = np.argmin(remainders, axis=0)
        scores = []
        for fold, run in enumerate(self.validation_runs):
            at, c = points[fold], solutions[points[fold], fold]
            gram = products[at, run][keys][:, keys]
            extended = np.append(c, 1.0)
            relative_error = math.sqrt(max(float(extended @ gram @ extended), 0.0) / float(self.output_power[run]))
            scores.append(math.log(min(max(relative_error, 1e-12), 1.0 - MIN_FIT_PERCENT / 100.0)))
        return SubsetScore(float(np.mean(scores)), tuple(points.tolist()), tuple(solutions[points[-1], -1].tolist()))

    def score_all(self, products: Floats) -> dict[tuple[int, ...], SubsetScore]:
        """Return the scores of all subsets from Gram matrices, shape (grid points, runs, columns + 1, columns + 1).

        A Gram matrix has the inner products of the responses to the columns and, last, of the residual without inputs.
        If there are too many subsets, the best subsets of each size are extended column by column, and the others are
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
        beam_width = max(4, MAX_EXHAUSTIVE_SUBSETS // len(self.columns) ** 2)
        candidate_subsets: list[tuple[int, ...]] = [()]
        for _ in choices:
            extended_subsets = {
                tuple(sorted((*subset, k)))
                for subset in candidate_subsets
                for indices in choices.values()
                if not set(indices) & set(subset)
                for k in indices
            }
            score_missing(sorted(extended_subsets))
            candidate_subsets = sorted(extended_subsets, key=lambda s: (out[s].score, s))[:beam_width]
        return out
