"""Candidates of one step looked at on thinned samples, so that long records are fitted by those alone that may lead."""

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

#: Samples of the thinned records, and evaluations of a descent on them: those of a race of starts whose best go on; by
#: how much more than the best one leaves others are out of it.
COARSE_SAMPLES, SECOND_LAP, CONTENDER = 1200, 60, 3.0

Item = TypeVar("Item")
MadeGlance = TypeVar("MadeGlance")
#: A structure and where it starts.
Start = tuple[Structure, Sequence[Mapping[str, float]]]


class Pool(Protocol):
    """What does work for items in their order."""

    def quietly(self, work: Callable[[Item], MadeGlance], items: Sequence[Item]) -> list[MadeGlance]:
        """Work done for each item."""


def contenders(runs: Sequence[Run], starts: Sequence[Start], least: int, pool: Pool) -> list[int]:
    """Places of the structures that are fitted on all samples, in their order.

    Left out are those whose descents on thinned samples, as many evaluations as those ahead in a race of starts have,
    leave more than the best by the factor that ends such a race; never so many that fewer than `least` are left. Of
    records that are not thinned, and of bodies that may stick, none is.
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
    """The least that descents from some points leave on thinned samples, every output weighing alike."""
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
#: Where an order that becomes free starts besides its whole value.
SHIFTS = (0.0, -0.4, 0.4)
#: Where a free number of an input starts, as shares of its interval.
SHARES = (0.1, 0.3, 0.6, 0.9)
#: Steps in a row that predict no better, after which growth ends.
PATIENCE = 2
#: Prediction is better where what is left over falls by more than this share.
BETTER = 0.005
#: Two predictions are alike where what they leave over differs by no more than this share.
SAME = 0.01
#: The most that counts as alike, whatever the scatter.
MOST_ALIKE = 0.05
#: Subsets that were screened are fitted where what they leave over is within this share of the best's, at most so many,
#: and the best of each number of terms.
NEAR, LEADING = 0.03, 8
#: Candidates of a list from which on the time that they take is estimated first.
MANY = 200
#: ln of the multiple of the best's residuals beyond which no root of an equation that keeps its terms is grown.
DOMINATED = math.log(2.0)
#: Changes of a step that are judged on unseen runs: the best by criterion.
JUDGED = 2


@dataclass
class Work:
    """How candidates are tried, and who is told.

    Parameters
    ----------
    folds
        What they are fitted on and judged on.
    threads
        Candidates at a time; what comes out does not depend on it.
    progress
        Called with (candidates fitted, candidates known of so far).
    clock
        Seconds that pass.
    store
        What is already known of it, and what is kept of each step.
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
        """Work done for each item, in their order, and told."""
        self.known += len(items)
        return self._in_order(work, items, self._told)

    def quietly(self, work: Callable[[Item], Made], items: Sequence[Item]) -> list[Made]:
        """The same of work that is no candidate's fit."""
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
        """A fitted candidate on what it never saw."""
        if isinstance(joint, FtlmError):
            return Trial(name, structure, len(FreeProblem.of(structure).names), failed=str(joint))

        def compute() -> Trial:
            try:
                return judged(name, structure, self.folds, joint, fine=fine)
            except FtlmError as error:
                return Trial(name, structure, numbers_of(structure, joint, self.folds), failed=str(error))

        return compute() if self.store is None else self.store.judgement(name, structure, joint, fine, compute)

    def refined(self, trial: Trial) -> Trial:
        """A candidate whose numbers do not depend on the step of the grid."""
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
        """A fit on all runs, or why there is none."""

        def compute() -> JointFit | FtlmError:
            try:
                return fit(self.folds.runs, structure, starts, refine=refine)
            except FtlmError as error:
                return error

        return compute() if self.store is None else self.store.fit(structure, starts, refine, compute)

    def screened(self, inside: Inside) -> list[Screened]:
        """Every subset of what drives, best first."""

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
    """Where a structure starts that has what `values` knows, orders that were `whole`, and coefficients that were 0.

    Friction that `values` does not know is in none of them.
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
    """Candidates on the way from the simplest structures up, and down again, each judged; in the order tried.

    Each whole value of the highest orders is a root of its own: what is best among the simplest need not be what the
    best grows from. Where several signals drive, one may stand for all the others: the best is also come to from above,
    from everything at whole orders, one thing less at a time. Where so many signals drive that subsets can be screened,
    growth begins with the best of them all; where no term may be left out, everything free is a root beside.
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
    """What is as good as the best, and what is left of it when one thing after another is taken away."""
    least = min(_rank(trial) for trial, _ in ends)
    for trial, at in ends:
        if (trial.grows, trial.score) <= (least[0], least[1] + SAME):
            _pruned(inside, work, trial, at, tried)
    return work.trials


def _from_everything(inside: Inside, work: Work) -> list[Trial]:
    """Equations that keep their terms, under a law or coupled: from the whole orders up, and from all orders free down.

    Growth from whole orders is left out where these leave over far more than all orders free do on unseen runs.
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
    """The best subsets fitted and judged, and what the best of them grows to when its orders become free."""
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
    """What a candidate is compared by: whether its free run grows without bound, then what it leaves over."""
    return trial.grows, trial.score


def values_of(joint: JointFit) -> dict[str, float]:
    """Everything free by name."""
    return dict(zip(joint.names, joint.values.tolist(), strict=True))


def _upwards(
    inside: Inside, work: Work, chosen: Fitted, tried: set[str], judged_already: Trial | None = None
) -> tuple[Trial, Fitted]:
    """One thing more after another, as long as prediction gets better; the best of the way."""
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
    """What a candidate leaves over that is neither better than the best nor alike."""
    return math.inf if best.grows else best.score + MOST_ALIKE


def _is_better(trial: Trial, than: Trial) -> bool:
    """Whether a candidate predicts better than another by more than nothing."""
    return _rank(trial) < (than.grows, than.score - BETTER)


def _downwards(
    inside: Inside, work: Work, low: Fitted, others: Sequence[Mapping[str, float]], tried: set[str]
) -> tuple[Trial, Fitted] | None:
    """One thing less after another from everything at whole orders, all the way; the best of the way."""
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
    """Fitted variants on what they never saw: all, or as many of the first of them as may matter.

    One that leaves over more than `beyond` already where it is fitted waits for those before it, and is not judged if
    it leaves more than the best of these does where unseen, by the margin: it predicts no better.
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
    """Changes fitted from where one is, best first; of long records those alone that may lead."""
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
    """Those that were fitted, by Schwarz's criterion, all with the colour of the best residuals among them."""
    there = [(c, j) for c, j in pairs if not isinstance(j, FtlmError)]
    if not there:
        return []
    scatter = min(spread(j) for _, j in there)
    count = [numbers_of(inside.build(c.variant), j, work.folds) for c, j in there]
    every = [Fitted(c, j, criterion(j, n, scatter)) for (c, j), n in zip(there, count, strict=True)]
    return sorted(every, key=lambda f: f.bic)


def _pruned(inside: Inside, work: Work, best: Trial, at: Fitted, tried: set[str]) -> None:
    """One thing less after another, as long as prediction is no worse."""
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
    """Whether orders that become whole move to the next whole number on either side of their estimate."""
    values = values_of(at.joint)
    return all(abs(v - values[n]) < 1.0 for n, v in change.variant.whole if n in values)


def _key(inside: Inside, change: Change) -> str:
    return signature(inside.build(change.variant))


def _new(inside: Inside, changes: Iterable[Change], tried: set[str]) -> list[Change]:
    """Changes to what was not tried, each once."""
    return list({key: c for c in changes if (key := _key(inside, c)) not in tried}.values())


def _name(inside: Inside, fitted: Fitted) -> str:
    return worded(inside.build(fitted.change.variant))


def listed(candidates: Mapping[str, Structure], work: Work) -> list[Trial]:
    """Candidates of a list, each from automatic starts."""

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
    """Seconds, minutes or hours, in two figures."""
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.2g} s"
