"""Multi-innovation and its two rivals like for like: one record, criterion and budget, bounds that know nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from ftlm.data.lattice import Lattice
from ftlm.data.run import Run
from ftlm.data.structures import Structure
from ftlm.fit.differential import differential_evolution_search
from ftlm.fit.genetic import Genetic, GeneticRun, genetic_search
from ftlm.paper.printed import INNOVATION_LENGTHS
from ftlm.paper.records import PRIORS, RIVAL_ALPHA
from ftlm.search.orders import search_orders
from ftlm.search.result import SearchResult
from ftlm.solve.records import prepare

#: Most seeds, fewest, and how many evaluations of one rival on one angle all seeds together may come to.
MOST_SEEDS, FEWEST_SEEDS, EVALUATIONS = 10, 3, 40_000
#: Smallest step of the rivals' lattice, on every arm, unless another is asked for: the paper's has 60 000 candidates an
#: angle, as many evaluations a seed, and takes minutes.
CONTEST_STEP = 0.1


@dataclass(frozen=True)
class LikeForLike:
    """What the three came to on one equation: p = 7 by K0, and both rivals."""

    settings: Genetic
    candidates: int
    lattice: dict[float, SearchResult]
    genetic: GeneticRun
    evolution: GeneticRun


def rivals_lattice(step: float, smallest: float = CONTEST_STEP) -> Lattice:
    """The lattice of the genetic comparison, where the orders' own has this step."""
    return Lattice(step=max(step, smallest), alpha=RIVAL_ALPHA)


def seeds_for(candidates: int) -> tuple[int, ...]:
    """Ten seeds, or as many as the evaluations allow."""
    return tuple(range(min(MOST_SEEDS, max(FEWEST_SEEDS, EVALUATIONS // max(candidates, 1)))))


def like_for_like(
    run: Run, single: Structure, lattice: Lattice, asked: Genetic | None = None, *,
    seeds: Sequence[int] | None = None, threads: int | None = None, progress: Callable[[int, int], None] | None = None,
) -> LikeForLike:  # fmt: skip
    """Give the genetic algorithm and differential evolution as many evaluations a seed as the lattice has candidates.

    Parameters
    ----------
    run
        One record that starts at rest.
    single
        One equation.
    lattice
        Of multi-innovation; its ends bound the rivals' orders.
    asked
        Seeds and evaluations that are asked for.
    seeds
        Where none are asked for; default as many as the evaluations allow.
    threads, progress
        See :func:`ftlm.search_orders`.

    Raises
    ------
    ModelError
        PyGAD or SciPy is not installed, or the record does not start at rest.
    """
    # Where a structure states the maker's values, bounds would follow them.
    blind = replace(single, reference={})
    searches = {
        prior: search_orders(
            run, blind, lattice, coefficients="multi-innovation", innovation_length=INNOVATION_LENGTHS[-1],
            prior_covariance=prior, keep=1, threads=threads, progress=progress,
        )
        for prior in PRIORS
    }  # fmt: skip
    count = searches[PRIORS[0]].candidates
    settings = asked or Genetic(seeds=tuple(seeds or seeds_for(count)))
    settings = replace(settings, evaluations=settings.evaluations or max(count, 2 * settings.population))
    records = prepare([run], blind, None, power_of_two=True)
    rivals = [
        search(records, blind, lattice, settings, threads=threads, progress=progress)
        for search in (genetic_search, differential_evolution_search)
    ]
    return LikeForLike(settings, count, searches, *rivals)
