"""Stepwise structure selection: forward selection, then backward elimination.

Candidates are prescreened on subsampled records.
"""

from __future__ import annotations

import itertools
import math
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

from ftlm.data.run import Run
from ftlm.errors import FtlmError
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Objective
from ftlm.estimation.output_error import COARSE_SHARE, JointFit, output_deviations, start_from_values
from ftlm.structure.structure import Structure
from ftlm.structure_selection.best_subset import ScreenedSubset, TaskPool, screen_subsets
from ftlm.structure_selection.candidates import Change, NestedStructures, Variant, describe_structure, signature
from ftlm.structure_selection.checkpoint import Store
from ftlm.structure_selection.cross_validation import (
    Folds,
    Trial,
    fit,
    fix_initial_conditions,
    parameter_count,
    residual_variance_inflation,
    schwarz_criterion,
    update_trial,
    validate_fit,
    validation_score_bound,
)
from ftlm.utils.resources import interruptible_pool

#: Number of samples of the subsampled records, maximum number of evaluations of an optimization on them (the budget of
#: a rung of the multistart), and ratio to the lowest cost above which a candidate is excluded.
PRESCREEN_SAMPLES, PRESCREEN_EVALUATIONS, MAX_PRESCREEN_COST_RATIO = 1200, 60, 3.0

Item = TypeVar("Item")
Result = TypeVar("Result")
#: A structure and its initial guesses.
Start = tuple[Structure, Sequence[Mapping[str, float]]]


def prescreen(runs: Sequence[Run], starts: Sequence[Start], least: int, pool: TaskPool) -> list[int]:
    """Return the indices of structures that are worth a fit on all samples, in ascending sequence.

    Each structure is fitted to subsampled records with a limited number of evaluations. It is excluded if its cost
    exceeds the lowest cost by the factor that the multistart uses for successive halving. At least `least` structures
    remain. All remain if records are too short for subsampling or a structure is nonlinear.
    """
    every = list(range(len(starts)))
    decimation = max(1, round(min(run.length - 1 for run in runs) / PRESCREEN_SAMPLES))
    if decimation == 1 or len(starts) <= least or not all(s.is_linear for s, _ in starts):
        return every

    def level(start: Start) -> float:
        structure, points = start
        try:
            return _prescreen_cost(runs, fix_initial_conditions(structure, runs), points, decimation)
        except FtlmError:
            # The fit to all samples reports the error.
            return math.inf

    levels = pool.map_items(level, starts)
    limit = MAX_PRESCREEN_COST_RATIO * min(levels)
    best_levels = sorted(every, key=lambda k: (levels[k], k))[:least]
    return [k for k in every if levels[k] <= limit or k in best_levels]


def _prescreen_cost(
    runs: Sequence[Run], structure: Structure, points: Sequence[Mapping[str, float]], decimation: int
) -> float:
    """Return the lowest cost from some initial guesses on subsampled records, with equally weighted outputs."""
    problem = FreeProblem.of(structure)
    grid = Objective(
        problem,
        runs,
        [1.0 / (COARSE_SHARE * size) for size in output_deviations(runs, structure)],
        decimation=decimation,
    )
    cost = math.inf
    for point in points:
        try:
            cost = min(cost, grid.minimize(start_from_values(problem, point), PRESCREEN_EVALUATIONS).cost_per_residual)
        except FtlmError:
            # Initial guesses without a finite simulation are skipped.
            continue
    return cost


#: Initial guesses of an order that becomes free, relative to its integer value.
INITIAL_ORDER_SHIFTS = (0.0, -0.4, 0.4)
#: Initial guesses of a free input parameter, as fractions of its interval.
INITIAL_INPUT_FRACTIONS = (0.1, 0.3, 0.6, 0.9)
#: Number of consecutive steps without a better prediction at which forward selection terminates.
MAX_IDLE_STEPS = 2
#: Relative decrease of the validation residual that counts as a better prediction.
MIN_SCORE_IMPROVEMENT = 0.005
#: Relative difference of validation residuals up to which two predictions count as equal.
SCORE_TOLERANCE = 0.01
#: Upper limit of that difference, for any scatter over folds.
MAX_SCORE_TOLERANCE = 0.05
#: Screened subsets are fitted if their residual is within this relative margin of the best one, up to this number. The
#: best subset of each size is fitted in addition.
SUBSET_SCORE_MARGIN, MAX_FITTED_SUBSETS = 0.03, 8
#: Number of listed candidates above which the total time is estimated first.
TIME_ESTIMATE_CANDIDATES = 200
#: Score gap to the best initial structure above which another one is not extended (no optional terms).
MAX_ROOT_SCORE_GAP = math.log(2.0)
#: Number of changes per step with the lowest criterion that are evaluated on validation data.
VALIDATED_CHANGES = 2


@dataclass
class CandidateEvaluator:
    """Object that fits and validates candidates in parallel, with a progress callback and a checkpoint file.

    Parameters
    ----------
    folds
        Estimation and validation data.
    threads
        Number of candidates evaluated concurrently; the result does not depend on it.
    progress
        Callback with (fitted candidates, candidates so far).
    clock
        Function that returns the time [s].
    store
        Checkpoint file with the results of each step, if any.
    """

    folds: Folds
    threads: int
    progress: Callable[[int, int], None] | None = None
    clock: Callable[[], float] = time.perf_counter
    store: Store | None = None
    done_count: int = 0
    known_count: int = 0
    trials: list[Trial] = field(default_factory=list)

    def map_candidates(self, work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
        """Return the results of a function for candidates, in the same order, with progress reports."""
        self.known_count += len(items)
        return self._in_order(work, items, self._report_progress)

    def map_items(self, work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
        """Return the results of a function for items, in the same order, without progress reports."""
        return self._in_order(work, items, lambda: None)

    def _report_progress(self) -> None:
        self.done_count += 1
        if self.progress is not None:
            self.progress(self.done_count, self.known_count)

    def _in_order(
        self, work: Callable[[Item], Result], items: Sequence[Item], report: Callable[[], None]
    ) -> list[Result]:
        out: list[Result] = []
        with interruptible_pool(self.threads) as workers:
            for result in workers.map(work, items):
                out.append(result)
                report()
        return out

    def validate(self, name: str, structure: Structure, joint: JointFit | FtlmError, *, fine: bool = False) -> Trial:
        """Return the trial of a fitted candidate on validation data; a failed fit gives a failed trial."""
        if isinstance(joint, FtlmError):
            return Trial(name, structure, len(FreeProblem.of(structure).names), failed=str(joint))

        def compute() -> Trial:
            try:
                return validate_fit(name, structure, self.folds, joint, fine=fine)
            except FtlmError as error:
                return Trial(name, structure, parameter_count(structure, joint, self.folds), failed=str(error))

        return compute() if self.store is None else self.store.validation(name, structure, joint, fine, compute)

    def refine_trial(self, trial: Trial) -> Trial:
        """Return a trial refitted with a time step that is refined until the parameters converge."""
        if trial.refined:
            return trial
        joint = self.fit_candidate(trial.structure, [trial.values])
        try:
            # Without a finite simulation on the finer grid the trial stays unrefined.
            return trial if isinstance(joint, FtlmError) else update_trial(trial, self.folds, joint)
        except FtlmError:
            return trial

    def fit_candidate(
        self, structure: Structure, starts: Sequence[Mapping[str, float]], *, refine: bool = True
    ) -> JointFit | FtlmError:
        """Return the fit of a candidate on all runs, or the error of the fit."""

        def compute() -> JointFit | FtlmError:
            try:
                return fit(self.folds.runs, structure, starts, refine=refine)
            except FtlmError as error:
                return error

        return compute() if self.store is None else self.store.fit(structure, starts, refine, compute)

    def best_subsets(self, inside: NestedStructures) -> list[ScreenedSubset]:
        """Return every subset of input terms, best prediction first; see :func:`screen_subsets`."""

        def compute() -> list[ScreenedSubset]:
            return screen_subsets(inside, self.folds, self)

        return compute() if self.store is None else self.store.subsets(inside.structure, compute)


@dataclass(frozen=True)
class FittedVariant:
    """Variant (nested structure) with its fit."""

    change: Change
    joint: JointFit
    bic: float


def initial_guesses(
    structure: Structure, values: Mapping[str, float], whole: Mapping[str, float]
) -> list[dict[str, float]]:
    """Return initial guesses of a structure from the estimates `values` of a nested structure.

    `whole` are the integers around which orders that become free start.

    `whole` are the integer values of orders that become free.

    A coefficient that is not in `values` starts at 0; a friction parameter that is not in `values` gets no initial
    value.
    """
    problem = FreeProblem.of(structure)
    usual: dict[str, list[float]] = {}
    for name, (low, high) in zip(problem.orders, problem.bounds, strict=True):
        at = whole.get(name, 0.5 * (low + high))
        usual[name] = [min(max(at + shift, low), high) for shift in INITIAL_ORDER_SHIFTS]
    rubs = {n for e in structure.equations if e.friction is not None for n in e.friction.names}
    usual |= {n: [0.0] for n in problem.coefficients if n not in rubs}
    usual |= {
        i.name: [i.bounds[0] + s * (i.bounds[1] - i.bounds[0]) for s in INITIAL_INPUT_FRACTIONS] for i in problem.inputs
    }
    places = {n: [values[n]] if n in values else places for n, places in usual.items()}
    return [dict(zip(places, point, strict=True)) for point in itertools.product(*places.values())]


def select_stepwise(inside: NestedStructures, work: CandidateEvaluator) -> list[Trial]:
    """Select structures by forward selection and backward elimination, and return all trials in sequence.

    Forward selection runs from a simplest structure for each integer value of the highest orders, because the best of
    the simplest structures need not be nested in the best structure. With several inputs, one input may act as a proxy
    for the others; backward elimination from the full structure at integer orders avoids this. If there are enough
    input terms for best-subset screening, selection starts from the best subset. If no term is optional, it also starts
    from the structure with all orders free.
    """
    subsets = work.best_subsets(inside)
    ends_from_subsets = _select_from_subsets(inside, work, subsets)
    if ends_from_subsets:
        # Screened subsets are not fitted again as neighbors of other variants.
        return _eliminate_from_ends(
            inside, work, ends_from_subsets, {signature(inside.build(s.change.variant)) for s in subsets}
        )
    if not inside.droppable:
        return _select_from_full(inside, work)
    changes = _untried_changes(inside, inside.simplest(), set())
    joints = work.map_candidates(lambda c: work.fit_candidate(inside.build(c.variant), [], refine=False), changes)
    roots: dict[tuple[float | None, ...], list[tuple[Change, JointFit | FtlmError]]] = {}
    for change, joint in zip(changes, joints, strict=True):
        roots.setdefault(inside.highest_orders(change.variant), []).append((change, joint))
    if all(isinstance(j, FtlmError) for j in joints):
        work.trials += [
            work.validate(c.words, inside.build(c.variant), j) for c, j in zip(changes, joints, strict=True)
        ]
    ends: list[tuple[Trial, FittedVariant]] = []
    keys: set[str] = set()
    for pairs in roots.values():
        best_changes = _by_criterion(inside, work, pairs)[:1]
        ends += [_select_forward(inside, work, one, keys) for one in best_changes]
    if not ends:
        return work.trials
    first = min(ends, key=lambda end: _ranking_key(end[0]))
    joined = [j.values_by_name for c, j in zip(changes, joints, strict=True) if not isinstance(j, FtlmError)]
    from_above = _eliminate_from_full(inside, work, first[1], joined, keys)
    ends += [] if from_above is None else [from_above]
    return _eliminate_from_ends(inside, work, ends, keys)


def _eliminate_from_ends(
    inside: NestedStructures, work: CandidateEvaluator, ends: Sequence[tuple[Trial, FittedVariant]], keys: set[str]
) -> list[Trial]:
    """Eliminate terms from each result of forward selection that is as good as the best; return the trials."""
    least = min(_ranking_key(trial) for trial, _ in ends)
    for trial, at in ends:
        if (trial.unstable, trial.score) <= (least[0], least[1] + SCORE_TOLERANCE):
            _eliminate_backward(inside, work, trial, at, keys)
    return work.trials


def _select_from_full(inside: NestedStructures, work: CandidateEvaluator) -> list[Trial]:
    """Return the trials for equations without optional terms, in which only orders are selected.

    Orders are made free one at a time, or fixed to integers one at a time from all orders free.

    The former is skipped if the validation residual with integer orders far exceeds that with all orders free.
    """
    structure = inside.structure
    full = Variant(frozenset(structure.coefficient_names), (), structure.offset == "constant")
    changes = _untried_changes(
        inside, [*inside.simplest(), Change(describe_structure(inside.build(full)), full)], set()
    )
    joints = work.map_candidates(lambda c: work.fit_candidate(inside.build(c.variant), [], refine=False), changes)
    pairs = list(zip(changes, joints, strict=True))
    roots = _by_criterion(inside, work, [p for p in pairs if p[0].variant == full])
    roots += _by_criterion(inside, work, [p for p in pairs if p[0].variant != full])[:1]
    if not roots:
        work.trials += [work.validate(c.words, inside.build(c.variant), j) for c, j in pairs]
        return work.trials
    first = _validate_variants(inside, work, roots, limit=-math.inf, margin=MAX_ROOT_SCORE_GAP)
    keys = {_key(inside, r.change) for r in roots}
    least = min(trial.score for trial in first)
    ends = [
        _select_forward(inside, work, at, keys, trial)
        for trial, at in reversed(list(zip(first, roots, strict=False)))
        if trial.score <= least + MAX_ROOT_SCORE_GAP
    ]
    return _eliminate_from_ends(inside, work, ends, keys)


def _select_from_subsets(
    inside: NestedStructures, work: CandidateEvaluator, subsets: Sequence[ScreenedSubset]
) -> list[tuple[Trial, FittedVariant]]:
    """Return the trials of the best subsets, of which the best are extended by free orders."""
    if not subsets:
        return []
    best_subsets = [s for s in subsets if s.score <= subsets[0].score + SUBSET_SCORE_MARGIN][:MAX_FITTED_SUBSETS]
    by_size: dict[int, ScreenedSubset] = {}
    for one in subsets:
        by_size.setdefault(len(one.start), one)
    best_subsets += [s for s in by_size.values() if s not in best_subsets]

    def from_grid(subset: ScreenedSubset) -> JointFit | FtlmError:
        return work.fit_candidate(inside.build(subset.change.variant), [subset.start], refine=False)

    joints = work.map_candidates(from_grid, best_subsets)
    steps = _by_criterion(inside, work, [(s.change, j) for s, j in zip(best_subsets, joints, strict=True)])
    if not steps:
        return []
    ends = list(zip(_validate_variants(inside, work, steps), steps, strict=True))
    keys = {signature(inside.build(s.change.variant)) for s in subsets}
    first = min(ends, key=lambda end: _ranking_key(end[0]))
    return [first, _select_forward(inside, work, first[1], keys, first[0])]


def _ranking_key(trial: Trial) -> tuple[bool, float]:
    """Return the sort key of a trial: instability first, then the score."""
    return trial.unstable, trial.score


def _select_forward(
    inside: NestedStructures,
    work: CandidateEvaluator,
    candidate: FittedVariant,
    keys: set[str],
    validated: Trial | None = None,
) -> tuple[Trial, FittedVariant]:
    """Add one term, free order or offset at a time while the prediction improves; return the best trial."""
    best = validated or _validate_variants(inside, work, [candidate])[0]
    best_at, idle = candidate, 0
    keys.add(_key(inside, candidate.change))
    while idle < MAX_IDLE_STEPS:
        larger = _untried_changes(inside, inside.larger(candidate.change.variant), keys)
        changes = _fit_changes(inside, work, candidate, larger)[:VALIDATED_CHANGES]
        if not changes:
            break
        trials = _validate_variants(inside, work, changes, limit=_max_relevant_score(best))
        keys |= {_key(inside, s.change) for s in changes}
        place = min(range(len(trials)), key=lambda k: (_ranking_key(trials[k]), k))
        candidate = changes[place]
        if _is_better(trials[place], best):
            best, best_at, idle = trials[place], candidate, 0
        else:
            idle += 1
    return best, best_at


def _max_relevant_score(best: Trial) -> float:
    """Return the score above which a candidate is neither better than the best nor equally good."""
    return math.inf if best.unstable else best.score + MAX_SCORE_TOLERANCE


def _is_better(trial: Trial, than: Trial) -> bool:
    """Whether a trial predicts significantly better than another."""
    return _ranking_key(trial) < (than.unstable, than.score - MIN_SCORE_IMPROVEMENT)


def _eliminate_from_full(
    inside: NestedStructures,
    work: CandidateEvaluator,
    low: FittedVariant,
    others: Sequence[Mapping[str, float]],
    keys: set[str],
) -> tuple[Trial, FittedVariant] | None:
    """Eliminate one term at a time from the full structure at integer orders; return the best trial, or None."""
    full = inside.richest(low.change.variant)
    if len(full.coefficients) - len(low.change.variant.coefficients) < 2:
        return None
    structure = inside.build(full)
    known_values = (low.joint.values_by_name, *others)
    starts = [initial_guesses(structure, coefficients, full.integer_order_values())[0] for coefficients in known_values]
    (joint,) = work.map_candidates(lambda item: work.fit_candidate(item, starts, refine=False), [structure])
    if isinstance(joint, FtlmError):
        return None
    at = FittedVariant(Change(describe_structure(structure), full), joint, 0.0)
    trials = _validate_variants(inside, work, [at])
    best, best_at = trials[0], at
    while True:
        changes = [
            c
            for c in inside.smaller(at.change.variant)
            if len(c.variant.coefficients) < len(at.change.variant.coefficients)
        ]
        fits = _fit_changes(inside, work, at, changes)
        if not fits:
            return best, best_at
        at = fits[0]
        if _key(inside, at.change) in keys:
            continue
        keys.add(_key(inside, at.change))
        (trial,) = _validate_variants(inside, work, [at])
        if _ranking_key(trial) <= (best.unstable, best.score + MIN_SCORE_IMPROVEMENT):
            best, best_at = trial, at


def _validate_variants(
    inside: NestedStructures,
    work: CandidateEvaluator,
    candidates: Sequence[FittedVariant],
    *,
    limit: float = math.inf,
    margin: float = 0.0,
) -> list[Trial]:
    """Return the trials of fitted variants, except those that cannot be the best.

    Variants are evaluated in two batches. The second starts with the first variant whose lower bound of the score
    exceeds `limit`. It is skipped if all its bounds exceed the best score of the first batch by more than `margin`.
    """

    def one(candidate: FittedVariant) -> Trial:
        return work.validate(_name(inside, candidate), inside.build(candidate.change.variant), candidate.joint)

    least = [validation_score_bound(f.joint, work.folds) for f in candidates]
    first = next((k for k, level in enumerate(least) if k > 0 and level > limit), len(candidates))
    trials = work.map_candidates(one, candidates[:first])
    best = min(trials, key=_ranking_key, default=None)
    if best is not None and (best.unstable or any(level <= best.score + margin for level in least[first:])):
        trials += work.map_candidates(one, candidates[first:])
    work.trials += trials
    return trials


def _fit_changes(
    inside: NestedStructures, work: CandidateEvaluator, at: FittedVariant, changes: Sequence[Change]
) -> list[FittedVariant]:
    """Return the fits of changed variants, sorted by BIC; they start from the current optimum.

    For long records only survivors of the prescreening are fitted.
    """
    values = at.joint.values_by_name
    starts: list[Start] = []
    for change in changes:
        structure = inside.build(change.variant)
        whole = {**at.change.variant.integer_order_values(), **change.variant.integer_order_values()}
        starts.append((structure, initial_guesses(structure, values, whole)))
    selection = prescreen(work.folds.runs, starts, VALIDATED_CHANGES, work)
    joints = work.map_candidates(lambda k: work.fit_candidate(*starts[k], refine=False), selection)
    return _by_criterion(inside, work, [(changes[k], joint) for k, joint in zip(selection, joints, strict=True)])


def _by_criterion(
    inside: NestedStructures, work: CandidateEvaluator, pairs: Sequence[tuple[Change, JointFit | FtlmError]]
) -> list[FittedVariant]:
    """Return fitted variants sorted by BIC, which uses the smallest variance inflation of their residuals."""
    fits = [(c, j) for c, j in pairs if not isinstance(j, FtlmError)]
    if not fits:
        return []
    inflation = min(residual_variance_inflation(j) for _, j in fits)
    count = [parameter_count(inside.build(c.variant), j, work.folds) for c, j in fits]
    every = [FittedVariant(c, j, schwarz_criterion(j, n, inflation)) for (c, j), n in zip(fits, count, strict=True)]
    return sorted(every, key=lambda f: f.bic)


def _eliminate_backward(
    inside: NestedStructures, work: CandidateEvaluator, best: Trial, at: FittedVariant, keys: set[str]
) -> None:
    """Remove one term, free order or offset at a time while the prediction does not get worse.

    The trials are stored in the evaluator.
    """
    while True:
        changes = [
            c for c in _untried_changes(inside, inside.smaller(at.change.variant), keys) if _is_adjacent_integer(c, at)
        ]
        steps = _fit_changes(inside, work, at, changes)
        keys |= {_key(inside, c) for c in changes}
        trials = _validate_variants(inside, work, steps[:VALIDATED_CHANGES], limit=_max_relevant_score(best))
        better = [
            (t, s)
            for t, s in zip(trials, steps, strict=False)
            if _ranking_key(t) <= (best.unstable, best.score + MIN_SCORE_IMPROVEMENT)
        ]
        if not better:
            return
        best, at = min(better, key=lambda pair: _ranking_key(pair[0]))


def _is_adjacent_integer(change: Change, at: FittedVariant) -> bool:
    """Whether each order that a change fixes to an integer moves by less than 1 from its estimate."""
    values = at.joint.values_by_name
    return all(abs(v - values[n]) < 1.0 for n, v in change.variant.integer_orders if n in values)


def _key(inside: NestedStructures, change: Change) -> str:
    return signature(inside.build(change.variant))


def _untried_changes(inside: NestedStructures, changes: Iterable[Change], keys: set[str]) -> list[Change]:
    """Return the changes whose variant has not been tried, each variant once."""
    return list({key: c for c in changes if (key := _key(inside, c)) not in keys}.values())


def _name(inside: NestedStructures, candidate: FittedVariant) -> str:
    return describe_structure(inside.build(candidate.change.variant))


def evaluate_list(candidates: Mapping[str, Structure], work: CandidateEvaluator) -> list[Trial]:
    """Return the trials of listed candidates, each fitted from automatic initial guesses."""

    def one(item: tuple[str, Structure]) -> Trial:
        name, structure = item
        return work.validate(name, structure, work.fit_candidate(structure, []), fine=True)

    items = list(candidates.items())
    # Stored results take no time, so they give no estimate of it.
    if len(items) > TIME_ESTIMATE_CANDIDATES and not (work.store is not None and len(work.store)):
        start_time = work.clock()
        work.trials += work.map_candidates(one, items[: work.threads])
        took = work.clock() - start_time
        rest = len(items) - work.threads
        warnings.warn(
            f"{len(items)} candidates: the first {work.threads} took {format_duration(took)}, so the other {rest} "
            f"take about {format_duration(took * rest / work.threads)} on {work.threads} threads; Ctrl-C stops the "
            "selection, and one structure with a stepwise search of its terms needs far fewer fits",
            UserWarning,
            stacklevel=3,
        )
        items = items[work.threads :]
    work.trials += work.map_candidates(one, items)
    return work.trials


def format_duration(seconds: float) -> str:
    """Return a duration in seconds as text in seconds, minutes or hours, with two digits."""
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.2g} s"
