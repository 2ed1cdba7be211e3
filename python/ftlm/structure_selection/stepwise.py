"""Stepwise structure selection: forward selection, then backward elimination.

Candidates are prescreened on subsampled records.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

from ftlm.data.run import Run
from ftlm.errors import FtlmError
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Objective
from ftlm.estimation.output_error import COARSE_FRACTION, JointFit, output_deviations, start_from_values
from ftlm.structure.structure import Structure
from ftlm.structure_selection.best_subset import ScreenedSubset, TaskPool, screen_subsets
from ftlm.structure_selection.candidates import Change, NestedStructures, Variant, describe_structure, signature
from ftlm.structure_selection.checkpoint import Store
from ftlm.structure_selection.cross_validation import (
    Folds,
    Trial,
    fit,
    fit_criterion,
    fix_initial_conditions,
    parameter_count,
    residual_variance_inflation,
    update_trial,
    validate_fit,
    validation_score_bound,
)
from ftlm.utils.arguments import warn_caller
from ftlm.utils.resources import interruptible_pool

#: Options of the prescreening: number of samples of the subsampled records, maximum number of evaluations of an
#: optimization (as in a rung of the multistart), and ratio to the lowest cost above which a candidate is excluded.
PRESCREEN_SAMPLES, PRESCREEN_EVALUATIONS, MAX_PRESCREEN_COST_RATIO = 1200, 60, 3.0

Item = TypeVar("Item")
Result = TypeVar("Result")
#: A structure and its initial guesses.
Start = tuple[Structure, Sequence[Mapping[str, float]]]


def prescreen(runs: Sequence[Run], starts: Sequence[Start], min_count: int, pool: TaskPool) -> list[int]:
    """Return the ascending indices of the structures that are worth a fit on all samples.

    Each structure is fitted to subsampled records with a limited number of evaluations. It is excluded if its cost
    exceeds `MAX_PRESCREEN_COST_RATIO` times the lowest cost. At least `min_count` structures remain. All remain if
    records are too short for subsampling or a structure is non-linear.
    """
    all_indices = list(range(len(starts)))
    decimation = max(1, round(min(run.length - 1 for run in runs) / PRESCREEN_SAMPLES))
    if decimation == 1 or len(starts) <= min_count or not all(s.is_linear for s, _ in starts):
        return all_indices

    def cost_of(start: Start) -> float:
        structure, points = start
        try:
            return _prescreen_cost(runs, fix_initial_conditions(structure, runs), points, decimation)
        except FtlmError:
            # The fit to all samples reports the error.
            return math.inf

    costs = pool.map_items(cost_of, starts)
    limit = MAX_PRESCREEN_COST_RATIO * min(costs)
    best_indices = sorted(all_indices, key=lambda k: (costs[k], k))[:min_count]
    return [k for k in all_indices if costs[k] <= limit or k in best_indices]


def _prescreen_cost(
    runs: Sequence[Run], structure: Structure, points: Sequence[Mapping[str, float]], decimation: int
) -> float:
    """Return the lowest cost from some initial guesses on subsampled records, with equally weighted outputs."""
    problem = FreeProblem.of(structure)
    objective = Objective(
        problem,
        runs,
        [1.0 / (COARSE_FRACTION * size) for size in output_deviations(runs, structure)],
        decimation=decimation,
    )
    cost = math.inf
    for point in points:
        try:
            cost = min(
                cost, objective.minimize(start_from_values(problem, point), PRESCREEN_EVALUATIONS).cost_per_residual
            )
        except FtlmError:
            # Initial guesses without a finite simulation are skipped.
            continue
    return cost


#: Differences between the initial guesses of an order that becomes free and its integer value.
INITIAL_ORDER_SHIFTS = (0.0, -0.4, 0.4)
#: Initial guesses of a free input parameter, as fractions of its interval.
INITIAL_INPUT_FRACTIONS = (0.1, 0.3, 0.6, 0.9)
#: Number of consecutive steps without a better prediction at which forward selection terminates.
MAX_IDLE_STEPS = 2
#: Relative decrease of the validation residual that counts as a better prediction.
MIN_SCORE_IMPROVEMENT = 0.005
#: Relative difference of validation residuals up to which two predictions count as equal.
SCORE_TOLERANCE = 0.01
#: Relative difference of validation residuals above which predictions never count as equal, however large the scatter
#: over folds is.
MAX_SCORE_TOLERANCE = 0.05
#: Screened subsets are fitted if their residual exceeds that of the best subset by at most this fraction; and maximum
#: number of these subsets. The best subset of each size is fitted in addition.
SUBSET_SCORE_MARGIN, MAX_FITTED_SUBSETS = 0.03, 8
#: Number of candidates in a list above which the total time is estimated from the first ones.
TIME_ESTIMATE_CANDIDATES = 200
#: Maximum difference from the best score for an initial structure that is extended, if no term is optional.
MAX_ROOT_SCORE_GAP = math.log(2.0)
#: Number of changes per step that are evaluated on validation data: those with the lowest Schwarz criterion.
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
        Callback with (number of fitted candidates, number of candidates known so far).
    clock
        Function that returns the time [s].
    store
        Checkpoint file with the results of each step, if any.
    done_count, announced_count
        Numbers of candidates that are fitted, and that are known up to now.
    trials
        Trials of all validated candidates.
    """

    folds: Folds
    threads: int
    progress: Callable[[int, int], None] | None = None
    clock: Callable[[], float] = time.perf_counter
    store: Store | None = None
    done_count: int = 0
    announced_count: int = 0
    trials: list[Trial] = field(default_factory=list)

    def map_candidates(self, work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
        """Return the results of a function for candidates, in the sequence of the candidates, with progress reports."""
        self.announced_count += len(items)
        out: list[Result] = []
        with interruptible_pool(self.threads) as workers:
            for result in workers.map(work, items):
                out.append(result)
                self.done_count += 1
                if self.progress is not None:
                    self.progress(self.done_count, self.announced_count)
        return out

    def map_items(self, work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
        """Return the results of a function for items, in the sequence of the items, without progress reports."""
        with interruptible_pool(self.threads) as workers:
            return list(workers.map(work, items))

    def validate(
        self, name: str, structure: Structure, joint: JointFit | FtlmError, *, is_final: bool = False
    ) -> Trial:
        """Return the trial of a fitted candidate on validation data; a failed fit gives a failed trial."""
        if isinstance(joint, FtlmError):
            return Trial(name, structure, len(FreeProblem.of(structure).names), failure=str(joint))

        def compute() -> Trial:
            try:
                return validate_fit(name, structure, self.folds, joint, is_final=is_final)
            except FtlmError as error:
                return Trial(name, structure, parameter_count(structure, joint, self.folds), failure=str(error))

        return compute() if self.store is None else self.store.validation(name, structure, joint, is_final, compute)

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

    def best_subsets(self, nested: NestedStructures) -> list[ScreenedSubset]:
        """Return every subset of input terms, best prediction first; see :func:`screen_subsets`."""

        def compute() -> list[ScreenedSubset]:
            return screen_subsets(nested, self.folds, self)

        return compute() if self.store is None else self.store.subsets(nested.structure, compute)


@dataclass(frozen=True)
class FittedVariant:
    """Variant (nested structure) with its fit and its Schwarz criterion."""

    change: Change
    joint: JointFit
    bic: float


def initial_guesses(
    structure: Structure, values: Mapping[str, float], integer_orders: Mapping[str, float]
) -> list[dict[str, float]]:
    """Return initial guesses of a structure from the estimates `values` of a nested structure.

    Orders that are free in this structure but were fixed to integers in the nested one start near these integers, which
    `integer_orders` contains by name. A coefficient that is not in `values` starts at zero. A friction parameter that
    is not in `values` is omitted.
    """
    problem = FreeProblem.of(structure)
    defaults: dict[str, list[float]] = {}
    for name, (low, high) in zip(problem.orders, problem.bounds, strict=True):
        at = integer_orders.get(name, 0.5 * (low + high))
        defaults[name] = [min(max(at + shift, low), high) for shift in INITIAL_ORDER_SHIFTS]
    friction_names = {n for e in structure.equations if e.friction is not None for n in e.friction.names}
    defaults |= {n: [0.0] for n in problem.coefficients if n not in friction_names}
    defaults |= {
        i.name: [i.bounds[0] + s * (i.bounds[1] - i.bounds[0]) for s in INITIAL_INPUT_FRACTIONS] for i in problem.inputs
    }
    values_by_name = {n: [values[n]] if n in values else guesses for n, guesses in defaults.items()}
    return [dict(zip(values_by_name, point, strict=True)) for point in itertools.product(*values_by_name.values())]


@dataclass
class StepwiseSelection:
    """Stepwise selection among the structures nested in another one.

    Parameters
    ----------
    nested
        The nested structures.
    work
        Evaluator of the candidates.
    keys
        Signatures of the structures that are not fitted again.
    """

    nested: NestedStructures
    work: CandidateEvaluator
    keys: set[str] = field(default_factory=set)

    def run(self) -> list[Trial]:
        """Run forward selection, then backward elimination. Return all trials in the sequence of their validation.

        Each integer value of the highest orders gives its own initial structure, because the best of the simplest
        structures need not be nested in the best structure. With several inputs, one input may act as a proxy for the
        others. Backward elimination therefore also starts from the full structure at integer orders. If
        there are enough input terms for best-subset screening, selection starts from the best subset. If no term is
        optional, the structure with all orders free is a second initial structure.
        """
        subsets = self.work.best_subsets(self.nested)
        subset_results = self._select_from_subsets(subsets)
        if subset_results:
            # Screened subsets are not fitted again as neighbors of other variants.
            self.keys = {self._key(s.change) for s in subsets}
            return self._eliminate_from_results(subset_results)
        if not self.nested.droppable:
            return self._select_from_full()
        pairs = self._fit_roughly(self._untried_changes(self.nested.simplest()))
        fits = [joint.values_by_name for _, joint in pairs if not isinstance(joint, FtlmError)]
        if not fits:
            return self._validate_failures(pairs)
        roots: dict[tuple[float | None, ...], list[tuple[Change, JointFit | FtlmError]]] = {}
        for change, joint in pairs:
            roots.setdefault(self.nested.highest_orders(change.variant), []).append((change, joint))
        results = [self._select_forward(best) for root in roots.values() for best in self._by_criterion(root)[:1]]
        best_result = min(results, key=lambda pair: _ranking_key(pair[0]))
        from_above = self._eliminate_from_full(best_result[1], fits)
        return self._eliminate_from_results([*results, *([] if from_above is None else [from_above])])

    def _build(self, change: Change) -> Structure:
        return self.nested.build(change.variant)

    def _key(self, change: Change) -> str:
        return signature(self._build(change))

    def _untried_changes(self, changes: Iterable[Change]) -> list[Change]:
        """Return the changes that lead to structures that are not yet fitted, without duplicates."""
        return list({key: c for c in changes if (key := self._key(c)) not in self.keys}.values())

    def _fit_roughly(self, changes: Sequence[Change]) -> list[tuple[Change, JointFit | FtlmError]]:
        """Return each change with the fit of its structure, or with the error of the fit.

        The fit starts from automatic initial guesses, and its time step is not refined.
        """
        joints = self.work.map_candidates(lambda c: self.work.fit_candidate(self._build(c), [], refine=False), changes)
        return list(zip(changes, joints, strict=True))

    def _validate_failures(self, pairs: Sequence[tuple[Change, JointFit | FtlmError]]) -> list[Trial]:
        """Add a failed trial for each structure, because none of them can be fitted, and return all trials."""
        self.work.trials += [self.work.validate(c.words, self._build(c), joint) for c, joint in pairs]
        return self.work.trials

    def _eliminate_from_results(self, results: Sequence[tuple[Trial, FittedVariant]]) -> list[Trial]:
        """Run backward elimination from each of the `results` that predicts as well as the best; return all trials."""
        lowest_key = min(_ranking_key(trial) for trial, _ in results)
        for trial, at in results:
            if (trial.unstable, trial.score) <= (lowest_key[0], lowest_key[1] + SCORE_TOLERANCE):
                self._eliminate_backward(trial, at)
        return self.work.trials

    def _select_from_full(self) -> list[Trial]:
        """Select orders forward from integer orders and backward from free orders, if no term is optional.

        Forward selection is skipped if the validation residual with integer orders far exceeds that with all orders
        free.
        """
        structure = self.nested.structure
        full_variant = Variant(frozenset(structure.coefficient_names), (), structure.offset == "constant")
        full_change = Change(describe_structure(self.nested.build(full_variant)), full_variant)
        pairs = self._fit_roughly(self._untried_changes([*self.nested.simplest(), full_change]))
        roots = self._by_criterion([p for p in pairs if p[0].variant == full_variant])
        roots += self._by_criterion([p for p in pairs if p[0].variant != full_variant])[:1]
        if not roots:
            return self._validate_failures(pairs)
        root_trials = self.validate_variants(roots, limit=-math.inf, margin=MAX_ROOT_SCORE_GAP)
        self.keys = {self._key(r.change) for r in roots}
        lowest_score = min(trial.score for trial in root_trials)
        results = [
            self._select_forward(at, trial)
            for trial, at in reversed(list(zip(root_trials, roots, strict=False)))
            if trial.score <= lowest_score + MAX_ROOT_SCORE_GAP
        ]
        return self._eliminate_from_results(results)

    def _select_from_subsets(self, subsets: Sequence[ScreenedSubset]) -> list[tuple[Trial, FittedVariant]]:
        """Return the best fitted subset, then its extension by forward selection; [] if no subset can be fitted."""
        if not subsets:
            return []
        best_subsets = [s for s in subsets if s.score <= subsets[0].score + SUBSET_SCORE_MARGIN][:MAX_FITTED_SUBSETS]
        by_size: dict[int, ScreenedSubset] = {}
        for subset in subsets:
            by_size.setdefault(len(subset.start), subset)
        best_subsets += [s for s in by_size.values() if s not in best_subsets]
        joints = self.work.map_candidates(
            lambda s: self.work.fit_candidate(self._build(s.change), [s.start], refine=False), best_subsets
        )
        ranked = self._by_criterion([(s.change, j) for s, j in zip(best_subsets, joints, strict=True)])
        if not ranked:
            return []
        results = list(zip(self.validate_variants(ranked), ranked, strict=True))
        self.keys = {self._key(s.change) for s in subsets}
        best_result = min(results, key=lambda pair: _ranking_key(pair[0]))
        return [best_result, self._select_forward(best_result[1], best_result[0])]

    def _select_forward(self, candidate: FittedVariant, validated: Trial | None = None) -> tuple[Trial, FittedVariant]:
        """Add one term, free order or offset at a time while the prediction improves; return the best result."""
        best = validated or self.validate_variants([candidate])[0]
        best_variant, unsuccessful_steps = candidate, 0
        self.keys.add(self._key(candidate.change))
        while unsuccessful_steps < MAX_IDLE_STEPS:
            larger = self._untried_changes(self.nested.larger(candidate.change.variant))
            changes = self._fit_changes(candidate, larger)[:VALIDATED_CHANGES]
            if not changes:
                break
            trials = self.validate_variants(changes, limit=_max_relevant_score(best))
            self.keys |= {self._key(s.change) for s in changes}
            best_index = min(range(len(trials)), key=lambda k: (_ranking_key(trials[k]), k))
            candidate = changes[best_index]
            if _is_better(trials[best_index], best):
                best, best_variant, unsuccessful_steps = trials[best_index], candidate, 0
            else:
                unsuccessful_steps += 1
        return best, best_variant

    def _eliminate_from_full(
        self, low: FittedVariant, values: Sequence[Mapping[str, float]]
    ) -> tuple[Trial, FittedVariant] | None:
        """Eliminate one term at a time from the full structure at integer orders, and return the best result.

        `values` are additional estimates, by name, of which each gives an initial guess. The result is None if the full
        structure has fewer than two terms more than `low`, or cannot be fitted.
        """
        full_variant = self.nested.richest(low.change.variant)
        if len(full_variant.coefficients) - len(low.change.variant.coefficients) < 2:
            return None
        structure = self.nested.build(full_variant)
        values_by_root = (low.joint.values_by_name, *values)
        starts = [
            initial_guesses(structure, root_values, full_variant.integer_order_values())[0]
            for root_values in values_by_root
        ]
        (joint,) = self.work.map_candidates(lambda s: self.work.fit_candidate(s, starts, refine=False), [structure])
        if isinstance(joint, FtlmError):
            return None
        at = FittedVariant(Change(describe_structure(structure), full_variant), joint, 0.0)
        (best,) = self.validate_variants([at])
        best_at = at
        while True:
            variant = at.change.variant
            smaller = [
                c for c in self.nested.smaller(variant) if len(c.variant.coefficients) < len(variant.coefficients)
            ]
            fits = self._fit_changes(at, smaller)
            if not fits:
                return best, best_at
            at = fits[0]
            if self._key(at.change) in self.keys:
                continue
            self.keys.add(self._key(at.change))
            (trial,) = self.validate_variants([at])
            if _ranking_key(trial) <= (best.unstable, best.score + MIN_SCORE_IMPROVEMENT):
                best, best_at = trial, at

    def validate_variants(
        self, candidates: Sequence[FittedVariant], *, limit: float = math.inf, margin: float = 0.0
    ) -> list[Trial]:
        """Return the trials of fitted variants, without those that cannot be the best.

        The first variant whose lower bound of the score exceeds `limit`, and all variants after it, are evaluated last.
        These variants are skipped if all their lower bounds exceed the best score of the earlier variants by more than
        `margin`.
        """

        def validate(candidate: FittedVariant) -> Trial:
            structure = self._build(candidate.change)
            return self.work.validate(describe_structure(structure), structure, candidate.joint)

        bounds = [validation_score_bound(f.joint, self.work.folds) for f in candidates]
        first_skipped = next((k for k, bound in enumerate(bounds) if k > 0 and bound > limit), len(candidates))
        trials = self.work.map_candidates(validate, candidates[:first_skipped])
        best = min(trials, key=_ranking_key, default=None)
        if best is not None and (
            best.unstable or any(bound <= best.score + margin for bound in bounds[first_skipped:])
        ):
            trials += self.work.map_candidates(validate, candidates[first_skipped:])
        self.work.trials += trials
        return trials

    def _fit_changes(self, at: FittedVariant, changes: Sequence[Change]) -> list[FittedVariant]:
        """Fit the structures of `changes` from the optimum of `at`, and return the fits, best first.

        Structures that prescreening excludes are not fitted.
        """
        values = at.joint.values_by_name
        starts: list[Start] = []
        for change in changes:
            structure = self._build(change)
            integer_orders = {**at.change.variant.integer_order_values(), **change.variant.integer_order_values()}
            starts.append((structure, initial_guesses(structure, values, integer_orders)))
        selection = prescreen(self.work.folds.runs, starts, VALIDATED_CHANGES, self.work)
        joints = self.work.map_candidates(lambda k: self.work.fit_candidate(*starts[k], refine=False), selection)
        return self._by_criterion([(changes[k], joint) for k, joint in zip(selection, joints, strict=True)])

    def _by_criterion(self, pairs: Sequence[tuple[Change, JointFit | FtlmError]]) -> list[FittedVariant]:
        """Return fitted variants, lowest Schwarz criterion first.

        The criterion of every variant uses the smallest of their variance inflations.
        """
        fits = [(c, j) for c, j in pairs if not isinstance(j, FtlmError)]
        if not fits:
            return []
        inflation = min(residual_variance_inflation(j) for _, j in fits)
        fitted = [FittedVariant(c, j, fit_criterion(j, inflation)) for c, j in fits]
        return sorted(fitted, key=lambda f: f.bic)

    def _eliminate_backward(self, best: Trial, at: FittedVariant) -> None:
        """Eliminate one term, free order or offset at a time while the prediction does not get worse."""
        while True:
            smaller = self._untried_changes(self.nested.smaller(at.change.variant))
            changes = [c for c in smaller if _is_adjacent_integer(c, at)]
            smaller_variants = self._fit_changes(at, changes)
            self.keys |= {self._key(c) for c in changes}
            trials = self.validate_variants(smaller_variants[:VALIDATED_CHANGES], limit=_max_relevant_score(best))
            better = [
                (t, s)
                for t, s in zip(trials, smaller_variants, strict=False)
                if _ranking_key(t) <= (best.unstable, best.score + MIN_SCORE_IMPROVEMENT)
            ]
            if not better:
                return
            best, at = min(better, key=lambda pair: _ranking_key(pair[0]))


def _ranking_key(trial: Trial) -> tuple[bool, float]:
    """Return the sort key of a trial: instability first, then the score."""
    return trial.unstable, trial.score


def _max_relevant_score(best: Trial) -> float:
    """Return the score above which a candidate is neither better than the best nor equally good."""
    return math.inf if best.unstable else best.score + MAX_SCORE_TOLERANCE


def _is_better(trial: Trial, reference: Trial) -> bool:
    """Whether a trial predicts significantly better than another."""
    return _ranking_key(trial) < (reference.unstable, reference.score - MIN_SCORE_IMPROVEMENT)


def _is_adjacent_integer(change: Change, at: FittedVariant) -> bool:
    """Whether each order that a change fixes to an integer is less than 1 from its estimate."""
    values = at.joint.values_by_name
    return all(abs(v - values[n]) < 1.0 for n, v in change.variant.integer_orders if n in values)


def evaluate_list(candidates: Mapping[str, Structure], work: CandidateEvaluator) -> list[Trial]:
    """Return the trials of listed candidates, each fitted from automatic initial guesses."""

    def evaluate(item: tuple[str, Structure]) -> Trial:
        name, structure = item
        return work.validate(name, structure, work.fit_candidate(structure, []), is_final=True)

    items = list(candidates.items())
    # Stored results take no time, so they do not allow an estimate.
    if len(items) > TIME_ESTIMATE_CANDIDATES and not (work.store is not None and len(work.store)):
        start_time = work.clock()
        work.trials += work.map_candidates(evaluate, items[: work.threads])
        elapsed = work.clock() - start_time
        remaining_count = len(items) - work.threads
        warn_caller(
            f"{len(items)} candidates: the first {work.threads} took {format_duration(elapsed)}, so the other "
            f"{remaining_count} "
            f"take about {format_duration(elapsed * remaining_count / work.threads)} on {work.threads} threads; "
            "Ctrl-C stops the "
            "selection, and one structure with a stepwise search of its terms needs far fewer fits"
        )
        items = items[work.threads :]
    work.trials += work.map_candidates(evaluate, items)
    return work.trials


def format_duration(seconds: float) -> str:
    """Return a duration in seconds as text in seconds, minutes or hours, with two digits."""
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.2g} s"
