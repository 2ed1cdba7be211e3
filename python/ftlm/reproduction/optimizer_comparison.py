"""Cases behind the verdicts: multi-innovation by p and K0, two global optimizers, integer and free orders."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ftlm.arm.flexible_link import flexible_link, integer_order, link_model
from ftlm.data.run import Run
from ftlm.estimation.genetic import GeneticAlgorithm, GeneticRun, differential_evolution_search, genetic_search
from ftlm.estimation.identify import identify
from ftlm.estimation.linear import MultiInnovationTrace, multi_innovation_trace
from ftlm.estimation.methods import OutputError
from ftlm.estimation.result import Identification
from ftlm.estimation.verdict import improves_prediction, is_degenerate
from ftlm.kernels import pulse_means
from ftlm.order_search.result import SearchResult
from ftlm.order_search.search import rank_orders
from ftlm.reproduction.published_values import INNOVATION_LENGTHS
from ftlm.reproduction.simulated_arm import ARM_VARIANTS, StageNumber, decimate_run, demo_run
from ftlm.reproduction.stage_result import (
    GRID_ALPHA,
    MULTI_INNOVATION_LABELS,
    PRIOR_COVARIANCES,
    RIVAL_ALPHA,
    SEARCH_OPTIONS,
    TRACE_EVERY,
    Stage,
    published_structure,
)
from ftlm.simulation.discretization import default_m, prepare
from ftlm.simulation.simulate import explicit_euler
from ftlm.structure.order_grid import OrderGrid
from ftlm.structure.structure import Structure
from ftlm.validation.comparison import Comparison, compare_means, finite, metrics

#: Largest and smallest number of seeds, and most evaluations of one optimizer on one angle over all seeds.
MAX_SEEDS, MIN_SEEDS, MAX_EVALUATIONS = 10, 3, 40_000
#: Default smallest increment of the order grid, on every arm: the paper's grid has 60 000 candidates per angle, as many
#: evaluations per seed, and takes minutes.
CONTEST_STEP = 0.1
#: An error has converged if it stays below the final error of p = 1 plus this share.
CONVERGENCE_MARGIN = 0.02
#: Joint fits use every fourth sample: 8 ms on the virtual rig, a fifteenth of the fastest link mode's period.
ROW_STRIDE = 4
#: Increment of the order grids of trials.
PANEL_STEP = 0.25


@dataclass(frozen=True)
class OptimizerComparison:
    """Results on one equation: multi-innovation with p = 7 by K0, genetic algorithm, differential evolution."""

    settings: GeneticAlgorithm
    candidates: int
    order_grid: dict[float, SearchResult]
    genetic: GeneticRun
    evolution: GeneticRun


def rivals_order_grid(increment: float, smallest: float = CONTEST_STEP) -> OrderGrid:
    """Return the order grid of the comparison, given the increment of the main grid."""
    return OrderGrid(increment=max(increment, smallest), alpha=RIVAL_ALPHA)


def seeds_for(candidates: int) -> tuple[int, ...]:
    """Return ten seeds, or as many as the budget of evaluations allows."""
    return tuple(range(min(MAX_SEEDS, max(MIN_SEEDS, MAX_EVALUATIONS // max(candidates, 1)))))


def _best_orders(run: Run, single: Structure, grid: OrderGrid, p: int, prior: float, **work: Any) -> SearchResult:
    """Return the best candidate of multi-innovation on an order grid."""
    options: dict[str, Any] = {
        **SEARCH_OPTIONS,
        "coefficients": "multi-innovation",
        "innovation_length": p,
        "prior_covariance": prior,
    }
    return rank_orders(run, single, grid, top=1, **options, **work)


def compare_optimizers(
    run: Run,
    single: Structure,
    order_grid: OrderGrid,
    asked: GeneticAlgorithm | None = None,
    *,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> OptimizerComparison:
    """Compare multi-innovation with a genetic algorithm and differential evolution at equal budgets per seed.

    Parameters
    ----------
    run
        Record that starts at rest.
    single
        Structure with one equation.
    order_grid
        Order grid of multi-innovation; its ends bound the orders of the optimizers.
    asked
        Settings of the genetic algorithm given by the user; the order grid and the number of evaluations are replaced.
    threads, progress
        See :func:`ftlm.search_orders`.

    Raises
    ------
    ModelError
        PyGAD or SciPy is not installed, or the record does not start at rest.
    """
    # Reference values of a structure would inform the bounds.
    blind = replace(single, reference={})
    searches = {
        prior: _best_orders(run, blind, order_grid, INNOVATION_LENGTHS[-1], prior, threads=threads, progress=progress)
        for prior in PRIOR_COVARIANCES
    }
    count = searches[PRIOR_COVARIANCES[0]].candidates
    settings = asked or GeneticAlgorithm(seeds=seeds_for(count))
    budget = settings.evaluations or max(count, 2 * settings.population)
    settings = replace(settings, order_grid=order_grid, evaluations=budget)
    records = prepare([run], blind, None, power_of_two=True)
    rivals = [
        search(records, blind, settings, threads=threads, progress=progress)
        for search in (genetic_search, differential_evolution_search)
    ]
    return OptimizerComparison(settings, count, searches, *rivals)


@dataclass(frozen=True)
class Trial:
    """Multi-innovation with all p on one angle of one record, with one K0.

    Parameters
    ----------
    arm, seed, output, prior
        Arm and seed of the record, angle, K0.
    errors
        Output error (45) by p, each at its own best orders.
    convergence_steps
        Steps by p until the error stays within 2 % of the final one of p = 1, all at the orders of p = 7; infinite if
        never.
    nr, manual
        NR of p = 7 and of the manual's integer-order model.
    """

    arm: str
    seed: int
    output: str
    prior: float
    errors: dict[int, float]
    convergence_steps: dict[int, float]
    nr: float
    manual: float

    def to_dict(self) -> dict[str, Any]:
        """Return the trial for JSON."""
        return {
            "arm": self.arm,
            "seed": self.seed,
            "output": self.output,
            "K0": self.prior,
            "nr": finite(self.nr),
            "manual nr": finite(self.manual),
            "errors": {str(p): finite(v) for p, v in self.errors.items()},
            "steps": {str(p): finite(v) for p, v in self.convergence_steps.items()},
        }


@dataclass(frozen=True)
class Contest:
    """Multi-innovation, genetic algorithm and differential evolution on one angle of one record, with equal budgets.

    Parameters
    ----------
    arm, output
        Arm of the record, angle.
    candidates, increment
        Candidates of the order grid, which are the evaluations per seed, and its increment.
    order_grid
        Error (45) of p = 7 by K0.
    genetic, evolution
        Error (45) by seed.
    """

    arm: str
    output: str
    candidates: int
    increment: float
    order_grid: dict[float, float]
    genetic: dict[int, float]
    evolution: dict[int, float]

    def to_dict(self) -> dict[str, Any]:
        """Return the contest for JSON."""
        return {
            "arm": self.arm,
            "output": self.output,
            "candidates": self.candidates,
            "step": self.increment,
            "multi-innovation": {f"{k:g}": finite(v) for k, v in self.order_grid.items()},
            "genetic": {str(s): finite(v) for s, v in self.genetic.items()},
            "differential evolution": {str(s): finite(v) for s, v in self.evolution.items()},
        }


@dataclass(frozen=True)
class OrderComparison:
    """Integer and free orders of (14)-(15) on one record, both by joint output error from the currents alone.

    Parameters
    ----------
    arm, stage
        Arm and stage of the record.
    integer_nr, free_nr
        NR of the output error by angle, with integer and with free orders.
    orders
        Estimate and 95 % interval of every free order.
    gains
        Gain in fit of the free orders on a run that neither was fitted to, by angle [percentage points].
    is_degenerate
        Whether one of the two fits must not be used, so that nothing follows from the comparison.
    """

    arm: str
    stage: int
    integer_nr: dict[str, float]
    free_nr: dict[str, float]
    orders: dict[str, tuple[float, float, float]]
    gains: dict[str, float] = field(default_factory=dict)
    is_degenerate: bool = False

    def earns(self, output: str) -> bool | None:
        """Whether free orders earn their place on an angle by the rule of ``ftlm orders``; None if it is not known."""
        if self.is_degenerate or output not in self.gains:
            return None
        intervals = {n: {self.arm: (low, high)} for n, (_, low, high) in self.orders.items()}
        return improves_prediction([self.gains[output]], intervals, {n: integer_order(n) for n in self.orders})

    @property
    def fractional_orders(self) -> list[str]:
        """Orders whose interval excludes the integer one."""
        return [n for n, (_, low, high) in self.orders.items() if not low <= integer_order(n) <= high]

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison for JSON."""
        return {
            "arm": self.arm,
            "stage": self.stage,
            "whole nr": {n: finite(v) for n, v in self.integer_nr.items()},
            "free nr": {n: finite(v) for n, v in self.free_nr.items()},
            "orders": {n: list(map(finite, v)) for n, v in self.orders.items()},
            "not whole": self.fractional_orders,
            "gain on another run": {n: finite(v) for n, v in self.gains.items()},
            "degenerate": self.is_degenerate,
            "earns": {n: self.earns(n) for n in self.free_nr},
        }


@dataclass(frozen=True)
class Panel:
    """All cases behind the verdicts."""

    trials: tuple[Trial, ...] = ()
    contests: tuple[Contest, ...] = ()
    order_comparisons: tuple[OrderComparison, ...] = ()

    def merge_with(self, other: Panel) -> Panel:
        """Return the union of two panels."""
        return Panel(
            self.trials + other.trials, self.contests + other.contests, self.order_comparisons + other.order_comparisons
        )

    def to_dict(self) -> dict[str, Any]:
        """Return all cases for JSON."""
        return {
            "trials": [t.to_dict() for t in self.trials],
            "contests": [c.to_dict() for c in self.contests],
            "whole and free orders": [f.to_dict() for f in self.order_comparisons],
        }


def convergence_step(trace: MultiInnovationTrace, end: float) -> float:
    """First step from which an error stays within a share of a final error; infinite if never."""
    with np.errstate(invalid="ignore"):
        away = np.flatnonzero(~(trace.error <= (1.0 + CONVERGENCE_MARGIN) * end))
    if not away.size:
        return float(trace.step[0])
    return float(trace.step[away[-1] + 1]) if away[-1] + 1 < trace.step.size else math.inf


def manual_nr(stage: StageNumber, run: Run) -> dict[str, float]:
    """NR of the manual's integer-order model by explicit Euler, as in the paper."""
    m = default_m([run], power_of_two=True)
    found = {}
    for name, samples in explicit_euler(link_model(stage=stage, form="published"), run).items():
        with np.errstate(over="ignore", invalid="ignore"):
            finite_run = bool(np.all(np.isfinite(samples)))
        found[name] = metrics(pulse_means(run[name], m), pulse_means(samples, m)).nr if finite_run else math.inf
    return found


def trials_of(stage: StageNumber, square: Run, arm: str, seed: int, threads: int | None) -> list[Trial]:
    """Run multi-innovation on both angles of a stage, with all p and both values of K0."""
    structure, grid = published_structure(stage), OrderGrid(increment=PANEL_STEP, alpha=GRID_ALPHA)
    run = square.select(list(structure.signals))
    manual, found = manual_nr(stage, run), []
    for output in structure.outputs:
        single = structure.equation(output)
        for prior in PRIOR_COVARIANCES:
            best = {p: _best_orders(run, single, grid, p, prior, threads=threads) for p in INNOVATION_LENGTHS}
            last = best[INNOVATION_LENGTHS[-1]].model
            known = single.with_orders({n: last.orders[n] for n in single.order_names})
            common: dict[str, Any] = {"prior_covariance": prior, "row_basis": "haar", "every": TRACE_EVERY}
            traces = {p: multi_innovation_trace(run, known, innovation_length=p, **common) for p in INNOVATION_LENGTHS}
            end = float(traces[INNOVATION_LENGTHS[0]].error[-1])
            steps = {p: convergence_step(t, end) for p, t in traces.items()}
            nr = compare_means(last, run).output_error[output].nr
            errors = {p: s.score for p, s in best.items()}
            found.append(Trial(arm, seed, output, prior, errors, steps, nr, manual[output]))
    return found


def compare_orders(
    stage: StageNumber,
    square: Run,
    arm: str,
    threads: int | None,
    progress: Callable[[int, int], None] | None = None,
    *,
    unseen: Run,
) -> OrderComparison:
    """Fit integer and free orders of one stage of a simulated arm, which starts at rest, on a decimated run.

    Both are compared on an unseen run.

    Raises
    ------
    ConvergenceError
        No initial guess of one of the fits converged.
    """
    structure = replace(flexible_link(stage=stage, form="lagrange", coupling="simulated"), initial="rest")
    own, other = (run.select(list(structure.signals)) for run in (square, unseen))
    run = decimate_run(own, ROW_STRIDE)
    whole = structure.with_orders({n: integer_order(n) for n in structure.order_names})
    method = OutputError(loss="squares", intervals="auto", noise="white")
    # Coefficients of integer orders overflow on an arm without them.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        fits = [identify(run, item, method=method, threads=threads, progress=progress) for item in (whole, structure)]
    models = [replace(fit.model, m=default_m([own], power_of_two=True)) for fit in fits]
    seen, judged = ([compare_means(model, each) for model in models] for each in (own, other))
    return _order_comparison(arm, stage, seen, judged, fits)


def _order_comparison(
    arm: str,
    stage: int,
    seen: Sequence[Comparison],
    unseen: Sequence[Comparison | None],
    fits: Sequence[Identification | None],
) -> OrderComparison:
    """Return the comparison of integer and free orders, in this order."""
    nr, free_nr = ({o: f.nr for o, f in c.output_error.items()} for c in seen)
    before, after = ({} if c is None else c.fit for c in unseen)
    gains = {o: after[o] - before[o] for o in nr if o in before and math.isfinite(after[o] - before[o])}
    free = fits[1]
    assert free is not None
    orders = {n: (v, *free.intervals[n]) for n, v in free.orders.items()}
    degenerate = any(fit is None or is_degenerate(fit) for fit in fits)
    return OrderComparison(arm, stage, nr, free_nr, orders, gains, degenerate)


def panel_of(stage: Stage, square: Run, arm: str, seed: int, threads: int | None) -> Panel:
    """Return the cases of one run and its stage results; trials only for runs that start at rest."""
    contests, freed = [], []
    for output, rival in stage.rivals.items():
        lattice = dict(zip(PRIOR_COVARIANCES, (rival.models[n] for n in MULTI_INNOVATION_LABELS), strict=True))
        errors = {k: c.estimation.output_error[output].error for k, c in lattice.items()}
        sizes = rival.candidates, rival.increment
        contests.append(Contest(arm, output, *sizes, errors, rival.genetic_run.errors, rival.evolution_run.errors))
    both = [stage.candidates[n] for n in ("integer, identified", "output error")]
    if both[1].result is not None and both[1].result.joint is not None:
        seen, unseen, fits = ([getattr(c, f) for c in both] for f in ("estimation", "validation", "result"))
        freed.append(_order_comparison(arm, stage.number, seen, unseen, fits))
    trials = trials_of(stage.number, square, arm, seed, threads) if stage.traces else []
    return Panel(tuple(trials), tuple(contests), tuple(freed))


def simulated_panel(
    stage: StageNumber,
    arm: str,
    seeds: Sequence[int],
    noise: float,
    threads: int | None,
    *,
    genetic: GeneticAlgorithm | None = None,
    order_grid: OrderGrid | None = None,
    has_contests: bool = True,
    begin: Callable[[str], None] = lambda _: None,
    progress: Callable[[int, int], None] | None = None,
) -> Panel:
    """Return the cases of one stage on one simulated arm; contests and joint fits on the first record only.

    Without an order grid there are neither; with ``has_contests=False`` there are no contests. Before each step `begin`
    is called with its name, a key of `ftlm.reproduction.stage_models.STEP_COSTS`.
    """
    trials: list[Trial] = []
    contests: list[Contest] = []
    freed: list[OrderComparison] = []
    for seed in seeds:
        run, unseen = (demo_run(s, noise=noise, seed=seed, parameters=ARM_VARIANTS[arm]) for s in ("square", "sine"))
        begin("trials")
        trials += trials_of(stage, run, arm, seed, threads)
        if order_grid is None or seed != seeds[0]:
            continue
        structure = published_structure(stage)
        own = run.select(list(structure.signals))
        for output in structure.outputs if has_contests else ():
            begin("rivals")
            single = structure.equation(output)
            made = compare_optimizers(own, single, order_grid, genetic, threads=threads, progress=progress)
            errors = {k: search.score for k, search in made.order_grid.items()}
            sizes = made.candidates, order_grid.increment
            contests.append(Contest(arm, output, *sizes, errors, made.genetic.errors, made.evolution.errors))
        begin("freed")
        freed.append(compare_orders(stage, run, arm, threads, progress, unseen=unseen))
    return Panel(tuple(trials), tuple(contests), tuple(freed))
