"""Prescreening of candidates on subsampled records; only survivors are fitted on all samples."""

from __future__ import annotations

import itertools
import math
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

from ftlm.data.run import Run
from ftlm.errors import FtlmError
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Grid
from ftlm.estimation.output_error import COARSE_SHARE, JointFit, given, output_sizes
from ftlm.structure.structure import Structure
from ftlm.structure_selection.best_subset import Screened, screened
from ftlm.structure_selection.candidates import Change, Inside, Variant, signature, worded
from ftlm.structure_selection.checkpoint import Store
from ftlm.structure_selection.cross_validation import (
    Folds,
    Trial,
    criterion,
    decided,
    fit,
    judged,
    least_unseen,
    numbers_of,
    refined,
    spread,
)
from ftlm.utils.resources import pool

#: Number of samples of the subsampled records, maximum number of evaluations of an optimization on them (the budget of
#: a rung of the multistart), and ratio to the lowest cost above which a candidate is excluded.
COARSE_SAMPLES, SECOND_LAP, CONTENDER = 1200, 60, 3.0

Item = TypeVar("Item")
MadeGlance = TypeVar("MadeGlance")
#: A structure and its initial guesses.
Start = tuple[Structure, Sequence[Mapping[str, float]]]


class Pool(Protocol):
    """Pool that maps a function over items, in their order."""

    def quietly(self, work: Callable[[Item], MadeGlance], items: Sequence[Item]) -> list[MadeGlance]:
        """Return the results for the items, in their order."""


def contenders(runs: Sequence[Run], starts: Sequence[Start], least: int, pool: Pool) -> list[int]:
    """Return indices of the structures to fit on all samples, in their order.

    A structure is excluded if its cost on subsampled records, with the budget of a rung of the multistart, exceeds the
    lowest cost by the factor of the multistart. At least `least` structures remain. Records too short for subsampling
    and structures with friction are not prescreened.
    """
    every = list(range(len(starts)))
    decimation = max(1, round(min(run.length - 1 for run in runs) / COARSE_SAMPLES))
    if decimation == 1 or len(starts) <= least or any(s.has_friction for s, _ in starts):
        return every

    def level(start: Start) -> float:
        structure, points = start
        try:
            return _level(runs, decided(structure, runs), points, decimation)
        except FtlmError:
            # The fit on all samples says why.
            return math.inf

    levels = pool.quietly(level, starts)
    limit = CONTENDER * min(levels)
    ahead = sorted(every, key=lambda k: (levels[k], k))[:least]
    return [k for k in every if levels[k] <= limit or k in ahead]


def _level(runs: Sequence[Run], structure: Structure, points: Sequence[Mapping[str, float]], decimation: int) -> float:
    """Lowest cost of optimizations from some initial guesses on subsampled records, outputs weighted equally."""
    problem = FreeProblem.of(structure)
    grid = Grid(
        problem, runs, [1.0 / (COARSE_SHARE * size) for size in output_sizes(runs, structure)], decimation=decimation
    )
    found = math.inf
    for point in points:
        try:
            found = min(found, grid.descend(given(problem, point), SECOND_LAP).level)
        except FtlmError:
            # A start whose free run is not finite is no start.
            continue
    return found


Made = TypeVar("Made")
#: Initial guesses of an order that becomes free, relative to its integer value.
SHIFTS = (0.0, -0.4, 0.4)
#: Initial guesses of a free input parameter, as fractions of its interval.
SHARES = (0.1, 0.3, 0.6, 0.9)
#: Number of consecutive steps without a better prediction at which forward selection terminates.
PATIENCE = 2
#: Relative decrease of the validation residual that counts as a better prediction.
BETTER = 0.005
#: Relative difference of validation residuals up to which two predictions count as equal.
SAME = 0.01
#: Upper limit of that difference, for any scatter over folds.
MOST_ALIKE = 0.05
#: Screened subsets are fitted if their residual is within this relative margin of the best one, up to this number. The
#: best subset of each size is fitted in addition.
NEAR, LEADING = 0.03, 8
#: Number of listed candidates above which the total time is estimated first.
MANY = 200
#: Score gap to the best initial structure above which one is not extended, for equations without optional terms.
DOMINATED = math.log(2.0)
#: Number of changes per step, best by criterion, that are evaluated on validation data.
JUDGED = 2


@dataclass
class Work:
    """Evaluation of candidates, and its progress callback.

    Parameters
    ----------
    folds
        Estimation and validation data.
    threads
        Number of candidates evaluated concurrently; the result does not depend on it.
    progress
        Called with (candidates fitted, candidates so far).
    clock
        Clock in seconds.
    store
        Checkpoint file with the results of each step.
    """

    folds: Folds
    threads: int
    progress: Callable[[int, int], None] | None = None
    clock: Callable[[], float] = time.perf_counter
    store: Store | None = None
    done: int = 0
    known: int = 0
    trials: list[Trial] = field(default_factory=list)

    def each(self, work: Callable[[Item], Made], items: Sequence[Item]) -> list[Made]:
        """Return the results for candidates, in their order, with progress reports."""
        self.known += len(items)
        return self._in_order(work, items, self._told)

    def quietly(self, work: Callable[[Item], Made], items: Sequence[Item]) -> list[Made]:
        """Return the results for items, in their order, without progress reports."""
        return self._in_order(work, items, lambda: None)

    def _told(self) -> None:
        self.done += 1
        if self.progress is not None:
            self.progress(self.done, self.known)

    def _in_order(self, work: Callable[[Item], Made], items: Sequence[Item], told: Callable[[], None]) -> list[Made]:
        out: list[Made] = []
        with pool(self.threads) as workers:
            for made in workers.map(work, items):
                out.append(made)
                told()
        return out

    def judge(self, name: str, structure: Structure, joint: JointFit | FtlmError, *, fine: bool = False) -> Trial:
        """Evaluate a fitted candidate on validation data."""
        if isinstance(joint, FtlmError):
            return Trial(name, structure, len(FreeProblem.of(structure).names), failed=str(joint))

        def compute() -> Trial:
            try:
                return judged(name, structure, self.folds, joint, fine=fine)
            except FtlmError as error:
                return Trial(name, structure, numbers_of(structure, joint, self.folds), failed=str(error))

        return compute() if self.store is None else self.store.judgement(name, structure, joint, fine, compute)

    def refined(self, trial: Trial) -> Trial:
        """Return a candidate refitted until its parameters are independent of the step of the grid."""
        if trial.fine:
            return trial
        joint = self.fitted(trial.structure, [trial.values])
        try:
            # On a finer grid it may have no finite free run: it stays what it was judged as.
            return trial if isinstance(joint, FtlmError) else refined(trial, self.folds, joint)
        except FtlmError:
            return trial

    def fitted(
        self, structure: Structure, starts: Sequence[Mapping[str, float]], *, refine: bool = True
    ) -> JointFit | FtlmError:
        """Fit a candidate on all runs; return the error if the fit fails."""

        def compute() -> JointFit | FtlmError:
            try:
                return fit(self.folds.runs, structure, starts, refine=refine)
            except FtlmError as error:
                return error

        return compute() if self.store is None else self.store.fit(structure, starts, refine, compute)

    def screened(self, inside: Inside) -> list[Screened]:
        """Return every subset of input terms, best first."""

        def compute() -> list[Screened]:
            return screened(inside, self.folds, self)

        return compute() if self.store is None else self.store.subsets(inside.structure, compute)


@dataclass(frozen=True)
class Fitted:
    """A variant with its fit."""

    change: Change
    joint: JointFit
    bic: float


def starts_from(
    structure: Structure, values: Mapping[str, float], whole: Mapping[str, float]
) -> list[dict[str, float]]:
    """Return initial guesses from known `values`, orders that were `whole`, and coefficients that were 0.

    Friction missing in `values` is missing in the initial guesses.
    """
    problem = FreeProblem.of(structure)
    usual: dict[str, list[float]] = {}
    for name, (low, high) in zip(problem.orders, problem.bounds, strict=True):
        at = whole.get(name, 0.5 * (low + high))
        usual[name] = [min(max(at + shift, low), high) for shift in SHIFTS]
    rubs = {n for e in structure.equations if e.friction is not None for n in e.friction.names}
    usual |= {n: [0.0] for n in problem.coefficients if n not in rubs}
    usual |= {i.name: [i.bounds[0] + s * (i.bounds[1] - i.bounds[0]) for s in SHARES] for i in problem.inputs}
    places = {n: [values[n]] if n in values else places for n, places in usual.items()}
    return [dict(zip(places, point, strict=True)) for point in itertools.product(*places.values())]


def grown(inside: Inside, work: Work) -> list[Trial]:
    """Select structures stepwise from the simplest ones upwards, then downwards; return all validated trials in order.

    Each integer value of the highest orders is an initial structure of its own: the best of the simplest structures
    need not be nested in the best one. With several inputs, one may act as a proxy for the others, so the best
    structure is also approached from the full structure at integer orders by backward elimination. If there are enough
    input terms for best-subset screening, selection starts from the best subset. If no term is optional, the structure
    with all orders free is a second initial structure.
    """
    subsets = work.screened(inside)
    found = _from_subsets(inside, work, subsets)
    if found:
        # What was screened is not fitted again because it is one thing more, or less, than something.
        return _finished(inside, work, found, {signature(inside.build(s.change.variant)) for s in subsets})
    if not inside.droppable:
        return _from_everything(inside, work)
    changes = _new(inside, inside.skeletons(), set())
    joints = work.each(lambda c: work.fitted(inside.build(c.variant), [], refine=False), changes)
    roots: dict[tuple[float | None, ...], list[tuple[Change, JointFit | FtlmError]]] = {}
    for change, joint in zip(changes, joints, strict=True):
        roots.setdefault(inside.top(change.variant), []).append((change, joint))
    if all(isinstance(j, FtlmError) for j in joints):
        work.trials += [work.judge(c.words, inside.build(c.variant), j) for c, j in zip(changes, joints, strict=True)]
    ends: list[tuple[Trial, Fitted]] = []
    tried: set[str] = set()
    for pairs in roots.values():
        ahead = _by_criterion(inside, work, pairs)[:1]
        ends += [_upwards(inside, work, one, tried) for one in ahead]
    if not ends:
        return work.trials
    first = min(ends, key=lambda end: _rank(end[0]))
    joined = [values_of(j) for c, j in zip(changes, joints, strict=True) if not isinstance(j, FtlmError)]
    from_above = _downwards(inside, work, first[1], joined, tried)
    ends += [] if from_above is None else [from_above]
    return _finished(inside, work, ends, tried)


def _finished(inside: Inside, work: Work, ends: Sequence[tuple[Trial, Fitted]], tried: set[str]) -> list[Trial]:
    """Eliminate terms backward from each forward-selection result that is as good as the best."""
    least = min(_rank(trial) for trial, _ in ends)
    for trial, at in ends:
        if (trial.grows, trial.score) <= (least[0], least[1] + SAME):
            _pruned(inside, work, trial, at, tried)
    return work.trials


def _from_everything(inside: Inside, work: Work) -> list[Trial]:
    """Select from integer orders upwards, and from all orders free downwards, for equations without optional terms.

    Forward selection from integer orders is skipped if their validation residual far exceeds that with all orders free.
    """
    structure = inside.structure
    full = Variant(frozenset(structure.coefficient_names), (), structure.offset == "constant")
    changes = _new(inside, [*inside.skeletons(), Change(worded(inside.build(full)), full)], set())
    joints = work.each(lambda c: work.fitted(inside.build(c.variant), [], refine=False), changes)
    pairs = list(zip(changes, joints, strict=True))
    roots = _by_criterion(inside, work, [p for p in pairs if p[0].variant == full])
    roots += _by_criterion(inside, work, [p for p in pairs if p[0].variant != full])[:1]
    if not roots:
        work.trials += [work.judge(c.words, inside.build(c.variant), j) for c, j in pairs]
        return work.trials
    first = _judged(inside, work, roots, beyond=-math.inf, margin=DOMINATED)
    tried = {_key(inside, r.change) for r in roots}
    least = min(trial.score for trial in first)
    ends = [
        _upwards(inside, work, at, tried, trial)
        for trial, at in reversed(list(zip(first, roots, strict=False)))
        if trial.score <= least + DOMINATED
    ]
    return _finished(inside, work, ends, tried)


def _from_subsets(inside: Inside, work: Work, subsets: Sequence[Screened]) -> list[tuple[Trial, Fitted]]:
    """Fit and validate the best subsets; extend the best of them by free orders."""
    if not subsets:
        return []
    ahead = [s for s in subsets if s.score <= subsets[0].score + NEAR][:LEADING]
    by_size: dict[int, Screened] = {}
    for one in subsets:
        by_size.setdefault(len(one.start), one)
    ahead += [s for s in by_size.values() if s not in ahead]

    def from_lattice(subset: Screened) -> JointFit | FtlmError:
        return work.fitted(inside.build(subset.change.variant), [subset.start], refine=False)

    joints = work.each(from_lattice, ahead)
    steps = _by_criterion(inside, work, [(s.change, j) for s, j in zip(ahead, joints, strict=True)])
    if not steps:
        return []
    ends = list(zip(_judged(inside, work, steps), steps, strict=True))
    tried = {signature(inside.build(s.change.variant)) for s in subsets}
    first = min(ends, key=lambda end: _rank(end[0]))
    return [first, _upwards(inside, work, first[1], tried, first[0])]


def _rank(trial: Trial) -> tuple[bool, float]:
    """Sort key of a candidate: instability first, then the score."""
    return trial.grows, trial.score


def values_of(joint: JointFit) -> dict[str, float]:
    """Return all free parameters by name."""
    return dict(zip(joint.names, joint.values.tolist(), strict=True))


def _upwards(
    inside: Inside, work: Work, chosen: Fitted, tried: set[str], judged_already: Trial | None = None
) -> tuple[Trial, Fitted]:
    """Add one thing at a time while prediction improves; return the best result on the way."""
    best = judged_already or _judged(inside, work, [chosen])[0]
    best_at, idle = chosen, 0
    tried.add(_key(inside, chosen.change))
    while idle < PATIENCE:
        larger = _new(inside, inside.larger(chosen.change.variant), tried)
        ahead = _tried(inside, work, chosen, larger)[:JUDGED]
        if not ahead:
            break
        found = _judged(inside, work, ahead, beyond=_hopeless(best))
        tried |= {_key(inside, s.change) for s in ahead}
        place = min(range(len(found)), key=lambda k: (_rank(found[k]), k))
        chosen = ahead[place]
        if _is_better(found[place], best):
            best, best_at, idle = found[place], chosen, 0
        else:
            idle += 1
    return best, best_at


def _hopeless(best: Trial) -> float:
    """Score above which a candidate is neither better than the best nor equal to it."""
    return math.inf if best.grows else best.score + MOST_ALIKE


def _is_better(trial: Trial, than: Trial) -> bool:
    """Whether a candidate predicts significantly better than another."""
    return _rank(trial) < (than.grows, than.score - BETTER)


def _downwards(
    inside: Inside, work: Work, low: Fitted, others: Sequence[Mapping[str, float]], tried: set[str]
) -> tuple[Trial, Fitted] | None:
    """Eliminate one term at a time from the full structure at integer orders; return the best on the way."""
    full = inside.richest(low.change.variant)
    if len(full.kept) - len(low.change.variant.kept) < 2:
        return None
    structure = inside.build(full)
    starts = [starts_from(structure, known, full.held())[0] for known in (values_of(low.joint), *others)]
    (joint,) = work.each(lambda item: work.fitted(item, starts, refine=False), [structure])
    if isinstance(joint, FtlmError):
        return None
    at = Fitted(Change(worded(structure), full), joint, 0.0)
    found = _judged(inside, work, [at])
    best, best_at = found[0], at
    while True:
        changes = [c for c in inside.smaller(at.change.variant) if len(c.variant.kept) < len(at.change.variant.kept)]
        ahead = _tried(inside, work, at, changes)
        if not ahead:
            return best, best_at
        at = ahead[0]
        if _key(inside, at.change) in tried:
            continue
        tried.add(_key(inside, at.change))
        (trial,) = _judged(inside, work, [at])
        if _rank(trial) <= (best.grows, best.score + BETTER):
            best, best_at = trial, at


def _judged(
    inside: Inside, work: Work, ahead: Sequence[Fitted], *, beyond: float = math.inf, margin: float = 0.0
) -> list[Trial]:
    """Evaluate fitted variants on validation data: all, or only the first ones if the others cannot matter.

    A variant whose lower bound of the score exceeds `beyond` waits for those before it. It is skipped if the bound
    exceeds their best score by more than the margin.
    """

    def one(fitted: Fitted) -> Trial:
        return work.judge(_name(inside, fitted), inside.build(fitted.change.variant), fitted.joint)

    least = [least_unseen(f.joint, work.folds) for f in ahead]
    first = next((k for k, level in enumerate(least) if k > 0 and level > beyond), len(ahead))
    found = work.each(one, ahead[:first])
    best = min(found, key=_rank, default=None)
    if best is not None and (best.grows or any(level <= best.score + margin for level in least[first:])):
        found += work.each(one, ahead[first:])
    work.trials += found
    return found


def _tried(inside: Inside, work: Work, at: Fitted, changes: Sequence[Change]) -> list[Fitted]:
    """Fit changes from the current optimum, best first; for long records only survivors of the prescreening."""
    values = values_of(at.joint)
    starts: list[Start] = []
    for change in changes:
        structure = inside.build(change.variant)
        whole = {**at.change.variant.held(), **change.variant.held()}
        starts.append((structure, starts_from(structure, values, whole)))
    ahead = contenders(work.folds.runs, starts, JUDGED, work)
    joints = work.each(lambda k: work.fitted(*starts[k], refine=False), ahead)
    return _by_criterion(inside, work, [(changes[k], joint) for k, joint in zip(ahead, joints, strict=True)])


def _by_criterion(inside: Inside, work: Work, pairs: Sequence[tuple[Change, JointFit | FtlmError]]) -> list[Fitted]:
    """Sort fitted variants by Schwarz's criterion, with the correlation of the best residuals among them."""
    there = [(c, j) for c, j in pairs if not isinstance(j, FtlmError)]
    if not there:
        return []
    scatter = min(spread(j) for _, j in there)
    count = [numbers_of(inside.build(c.variant), j, work.folds) for c, j in there]
    every = [Fitted(c, j, criterion(j, n, scatter)) for (c, j), n in zip(there, count, strict=True)]
    return sorted(every, key=lambda f: f.bic)


def _pruned(inside: Inside, work: Work, best: Trial, at: Fitted, tried: set[str]) -> None:
    """Eliminate one thing at a time while prediction does not get worse."""
    while True:
        changes = [c for c in _new(inside, inside.smaller(at.change.variant), tried) if _beside(c, at)]
        steps = _tried(inside, work, at, changes)
        tried |= {_key(inside, c) for c in changes}
        found = _judged(inside, work, steps[:JUDGED], beyond=_hopeless(best))
        better = [(t, s) for t, s in zip(found, steps, strict=False) if _rank(t) <= (best.grows, best.score + BETTER)]
        if not better:
            return
        best, at = min(better, key=lambda pair: _rank(pair[0]))


def _beside(change: Change, at: Fitted) -> bool:
    """Whether orders that become integer move to an adjacent integer of their estimate."""
    values = values_of(at.joint)
    return all(abs(v - values[n]) < 1.0 for n, v in change.variant.whole if n in values)


def _key(inside: Inside, change: Change) -> str:
    return signature(inside.build(change.variant))


def _new(inside: Inside, changes: Iterable[Change], tried: set[str]) -> list[Change]:
    """Return changes to untried variants, each once."""
    return list({key: c for c in changes if (key := _key(inside, c)) not in tried}.values())


def _name(inside: Inside, fitted: Fitted) -> str:
    return worded(inside.build(fitted.change.variant))


def listed(candidates: Mapping[str, Structure], work: Work) -> list[Trial]:
    """Evaluate listed candidates, each from automatic initial guesses."""

    def one(item: tuple[str, Structure]) -> Trial:
        name, structure = item
        return work.judge(name, structure, work.fitted(structure, []), fine=True)

    items = list(candidates.items())
    # What a store gives back takes no time, and tells none.
    if len(items) > MANY and not (work.store is not None and len(work.store)):
        begun = work.clock()
        work.trials += work.each(one, items[: work.threads])
        took = work.clock() - begun
        rest = len(items) - work.threads
        warnings.warn(
            f"{len(items)} candidates: the first {work.threads} took {duration(took)}, so the other {rest} take about "
            f"{duration(took * rest / work.threads)} on {work.threads} threads; Ctrl-C ends it, and a structure whose "
            "inside is searched needs far fewer fits",
            UserWarning,
            stacklevel=3,
        )
        items = items[work.threads :]
    work.trials += work.each(one, items)
    return work.trials


def duration(seconds: float) -> str:
    """Format seconds as seconds, minutes or hours, with two digits."""
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.2g} s"
