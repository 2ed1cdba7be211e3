"""Terms and orders that earn their place: structures inside one, or a list of them, judged by what they predict."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ftlm.base.errors import ConvergenceError, ModelError
from ftlm.data.run import Run
from ftlm.data.settings import Settings
from ftlm.data.structures import Structure
from ftlm.fit.problem import FreeProblem
from ftlm.identification.identify import identify
from ftlm.selection.automatic import automatic
from ftlm.selection.candidates import Inside, named, signature, worded
from ftlm.selection.growth import MOST_ALIKE, SAME, Work, grown, listed
from ftlm.selection.result import Selection
from ftlm.selection.store import Request, Store
from ftlm.selection.trial import Folds, Trial, criterion, spread
from ftlm.solve.records import prepare

#: Schwarz criteria closer than this tell nothing; doi:10.1080/01621459.1995.10476572.
ALIKE = 2.0
#: Difference of Schwarz criteria that is very strong evidence; the same source.
STRONG = 10.0
#: Folds from which on the scatter over them says something, and one-sided 95 % quantiles of Student's t from there on.
FOLDS, STUDENT_95 = 3, (2.92, 2.35, 2.13, 2.02, 1.94, 1.89, 1.86, 1.83, 1.81)
#: Candidates of a list beyond which somebody has made a mistake.
MOST = 10_000


def select(
    runs: Run | Sequence[Run],
    candidates: str | Structure | Sequence[Structure] | Mapping[str, Structure],
    *,
    validation: str | Run | Sequence[Run] | None = None,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    store: str | os.PathLike[str] | None = None,
) -> Selection:
    """Choose the terms and orders that earn their place on runs that they were not fitted to.

    A structure is grown: from the simplest one inside it (whole orders, the output's own terms, one thing that drives),
    a term, a free order, a delay, friction or an offset more at a time, each fitted by output error from the last
    optimum, the two most promising by Schwarz's criterion judged by free runs on what they were not fitted to (the
    second where what it leaves over on all runs lets it matter). Where two steps in a row predict no better, it is
    pruned, one thing less at a time. A list is judged whole, from automatic starts. Chosen is, among those that predict
    as well as the best (what is left over is within 1 %, or, up to 5 %, three or more folds do not tell the difference
    from 0 at 95 %, or all samples are very strong evidence), the one with the least Schwarz criterion, samples counted
    as the colour of the residuals lets them; of those alike in that the one with the fewest numbers, of the lowest
    order, best where unseen.

    Parameters
    ----------
    runs
        One run or several with the same names and units.
    candidates
        A structure, whose inside is searched; several structures, by name or by their equations; or ``"auto"``: one
        output, every input, whole orders 1 to 4 and the fractional ones that earn their place.
    validation
        ``"runs"``: each run is judged by a fit on the others, the default where there are several; ``"blocks"``: each
        quarter of every run by a fit on the rest, the default for one run; or runs that are fitted to by nobody.
    threads
        Candidates at a time, by default all cores; the result does not depend on it.
    progress
        Called with (candidates fitted, candidates known of so far).
    store
        File that keeps every fit as it ends: the same call with the same file goes on where it was stopped, with
        Ctrl-C or by the machine, and comes to the same bits.

    Returns
    -------
    Selection
        Prints well; ``.best`` is the chosen structure identified on all runs, ``.report`` writes a page.

    Raises
    ------
    DataError
        Runs that do not fit together or the structure, that are too short to be cut, or that excite nothing; a store
        of another selection, in use, damaged, or that cannot be written.
    ModelError
        No candidates, two that are the same but for the names of their numbers, more than 10 000, no validation run,
        words that are not known, one run where several are needed, a validation run that is fitted to.
    ConvergenceError
        No candidate that can be fitted.

    Notes
    -----
    Initial terms are those of whole orders (none from rest, else level and velocity, Caputo's) unless the structure
    says otherwise: with a history, which has more terms the more orders are free, candidates could not be compared.
    Growth costs one fit for each thing that may be added, at each step; of records of more than some 1800 samples every
    one of these is looked at on thinned samples first, and those far behind are not fitted. Where three or more terms
    drive one equation and whole runs judge, every subset of them at whole orders is fitted and judged in closed form
    first, on a lattice of the own coefficients, and growth begins with the best. Of a list of more than 200 candidates
    a ``UserWarning`` says, after the first ones, how long the rest takes.
    """
    # Checked here as identify checks it: threads is a whole number, at least 1.
    workers = Settings.check(coefficients="least-squares", threads=threads).threads
    several = [runs] if isinstance(runs, Run) else list(runs)
    folds = Folds.of(runs, validation if validation is not None else "runs" if len(several) > 1 else "blocks")
    if not isinstance(candidates, (str, Structure, Sequence, Mapping)):
        raise ModelError(
            f"candidates is {type(candidates).__name__}; use ftlm.equation(…), a list or a dictionary of structures, "
            "or 'auto'"
        )
    if not isinstance(candidates, (str, Structure)) and len(candidates) > MOST:
        raise ModelError(
            f"{len(candidates)} candidates are more than {MOST}; give one structure instead, whose inside is grown "
            "step by step"
        )
    every = named(candidates) if not isinstance(candidates, (str, Structure)) else {}
    if isinstance(candidates, str) and candidates != "auto":
        raise ModelError(f"candidates = {candidates!r}; use 'auto', ftlm.equation(…), or a list of structures")
    searched = automatic(folds.runs) if isinstance(candidates, str) else []
    searched += [candidates] if isinstance(candidates, Structure) else []
    idle = [worded(s) for s in (*searched, *every.values()) if not FreeProblem.of(s).names]
    if idle:
        raise ModelError(
            f"{idle[0]} has nothing to estimate; name a coefficient or an order, or use model.compare(runs)"
        )
    for structure in (*searched, *every.values()):
        # Refused here, once, and not as a failure of every candidate.
        prepare(folds.runs, replace(structure.as_given(), offset="none"), None, power_of_two=False, gaps=True)
    if store is None:
        return _found(Work(folds, workers, progress), searched, every)
    judges = [f.judged for f in folds.parts if not any(f.judged is r for r in folds.runs)]
    asked = Request.of(folds.runs, [searched, every], judges, folds.words)
    with Store(store, asked) as kept:
        return _found(Work(folds, workers, progress, store=kept), searched, every)


def _found(work: Work, searched: Sequence[Structure], every: Mapping[str, Structure]) -> Selection:
    """What structures grown inside some, and those of a list, come to."""
    for structure in searched:
        grown(Inside(structure), work)
    if every:
        listed(every, work)
    return _chosen(work, work.folds)


def _chosen(work: Work, folds: Folds) -> Selection:
    """Rank what was judged, choose, and identify the choice."""
    there = [t for t in work.trials if t.joint is not None]
    if not there:
        why = next((f"; {t.name}: {t.failed}" for t in work.trials), "")
        raise ConvergenceError(f"no candidate can be fitted to {folds.words}{why}")
    kept: dict[str, Trial] = {}
    for trial in work.trials:
        key = signature(trial.structure)
        if key not in kept or trial.score < kept[key].score:
            kept[key] = trial
    ranked = sorted(kept.values(), key=lambda t: (t.failed is not None, t.grows, t.score, t.numbers, t.name))
    scatter = min(spread(t.joint) for t in there if t.joint is not None)
    ranked = [t if t.joint is None else replace(t, bic=criterion(t.joint, t.numbers, scatter)) for t in ranked]
    best = ranked[0]
    near = [k for k, t in enumerate(ranked) if t.failed is None and t.grows == best.grows and _as_good(t, best)]
    # What the grid leaves is a fraction of an order, and to a criterion of thousands of samples a fraction counts.
    for k, trial in zip(near, work.quietly(work.refined, [ranked[k] for k in near]), strict=True):
        ranked[k] = trial
    scatter = min(spread(t.joint) for t in ranked if t.joint is not None)
    ranked = [t if t.joint is None else replace(t, bic=criterion(t.joint, t.numbers, scatter)) for t in ranked]
    best, winner = ranked[0], _winner([ranked[k] for k in near])
    found = identify(list(folds.runs), _as_judged(winner, folds), threads=work.threads)
    warnings = []
    if winner.joint is not None and found.joint is not None and found.joint.noise:
        lower = [o for o, v in found.joint.noise.items() if v < 0.99 * winner.joint.noise.get(o, v)]
        if lower:
            warnings.append(
                f"from automatic starts the chosen structure fits {', '.join(lower)} better than where it was judged: "
                "another optimum; .best is that one"
            )
    if winner.unseen < 50.0:
        warnings.append(
            f"the best candidate predicts unseen runs with {winner.unseen:.3g} %: none of them is the machine"
        )
    return Selection(
        tuple(ranked), ranked.index(winner), found, folds.words, _reason(winner, best, ranked), work.done,
        tuple(warnings),
    )  # fmt: skip


def _as_good(trial: Trial, best: Trial) -> bool:
    """Whether a candidate predicts like the best: within 1 %, or up to 5 % if folds do not tell the difference from 0.

    The best is the luckiest of many: a single standard error would refuse a true structure for it in one case of ten.
    Where one block alone says what the others cannot, leaving it out costs the truth far more than 5 %: very strong
    evidence on all samples lets it stand beside. So it does, within 5 %, where folds are too few to tell a scatter.
    """
    apart = np.array(trial.scores) - np.array(best.scores)
    far, likely = trial.score - best.score, _bic(trial) <= _bic(best) - STRONG
    if apart.size < FOLDS:
        return far <= SAME or (far <= MOST_ALIKE and likely)
    scatter = float(np.std(apart, ddof=1)) / math.sqrt(apart.size)
    quantile = STUDENT_95[min(apart.size - FOLDS, len(STUDENT_95) - 1)]
    return (far <= quantile * scatter and likely) or far <= max(SAME, min(quantile * scatter, MOST_ALIKE))


def _winner(near: Sequence[Trial]) -> Trial:
    """Of those that predict alike, the one with the least criterion; of those alike in that, the best where unseen.

    From rest an equation differentiated throughout is the same equation: of these it is the one of the lowest order.
    """
    least = min(_bic(t) for t in near)
    alike = [t for t in near if _bic(t) <= least + ALIKE]
    return min(alike, key=lambda t: (t.numbers, _whole_order(t), t.score, t.looseness))


def _whole_order(trial: Trial) -> int:
    """The highest orders to the next whole number, all equations together."""
    return sum(round(e.order.partly(trial.values).constant) for e in trial.structure.equations)


def _bic(trial: Trial) -> float:
    return math.inf if trial.bic is None else trial.bic


def _as_judged(trial: Trial, folds: Folds) -> Structure:
    """The structure with the initial terms that it was judged with.

    From rest none are needed, and none are forbidden: what it is told of next may be a run in motion.
    """
    if trial.joint is None or (trial.structure.initial == "auto" and trial.joint.initial == "rest"):
        return trial.structure
    return replace(trial.structure, initial=trial.joint.initial)


def _reason(winner: Trial, best: Trial, ranked: Sequence[Trial]) -> str:
    """Why the winner is the winner."""
    lead = f"Chosen: {winner.name} ({winner.numbers} numbers, {winner.unseen:.4g} % where unseen)"
    if winner is best:
        lead += ", which predicts best"
    else:
        more = best.numbers - winner.numbers
        lead += (
            f", which leaves {100 * (math.exp(winner.score - best.score) - 1):.2g} % more than the best prediction"
            + (f" with {more} numbers fewer" if more > 0 else "")
            + " and has the least Schwarz criterion of those that predict alike"
        )
    for word, others in (
        ("fewer", [t for t in ranked if t.failed is None and t.grows == winner.grows and t.numbers < winner.numbers]),
        ("more", [t for t in ranked if t.failed is None and t.grows == winner.grows and t.numbers > winner.numbers]),
    ):
        if others:
            near = min(others, key=lambda t: t.score)
            share = 100 * (math.exp(near.score - winner.score) - 1)
            lead += (
                f"; the best with {word} ({near.numbers}) leaves {abs(share):.3g} % {'more' if share >= 0 else 'less'}"
            )
    return lead + "."
