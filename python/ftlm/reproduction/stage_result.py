"""Results of one stage: models on both runs, optimizer comparisons, convergence; cases behind the verdicts."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
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
from ftlm.model.model import Model
from ftlm.order_search.options import COMPARED_INNOVATION_LENGTHS as INNOVATION_LENGTHS
from ftlm.order_search.result import SearchResult
from ftlm.order_search.search import rank_orders
from ftlm.reproduction.simulated_arm import ARM_VARIANTS, StageNumber, decimate_run, demo_run
from ftlm.simulation.discretization import default_m, prepare
from ftlm.simulation.simulate import explicit_euler
from ftlm.structure.order_grid import OrderGrid
from ftlm.structure.structure import Structure
from ftlm.svg.heat_map import Landscape
from ftlm.utils.formatting import SUPERSCRIPT_DIGITS, attributes, json_value, symbol
from ftlm.utils.validation import Floats
from ftlm.validation.comparison import Comparison, Metrics, compare_means, metrics

#: Steps between two points of a convergence curve; the effect of p is limited to the first steps.
TRACE_EVERY = 2
#: Prior covariance so large that the data alone decide.
WEAK_PRIOR = 1e10
#: Both values of K0: the paper's identity, and a weak prior.
PRIOR_COVARIANCES = (1.0, WEAK_PRIOR)
#: Labels of multi-innovation in the optimizer comparison, by K0.
MULTI_INNOVATION_LABELS = ("p = 7", "p = 7, weak prior")
#: Highest orders of the paper's grid, and those of the optimizer comparison, which contain the orders printed for both
#: methods and leave so few candidates that all can be evaluated.
GRID_ALPHA, RIVAL_ALPHA = (1.05, 2.0), (1.95, 2.0)
#: Options of every order search, named so that no default changes a table.
SEARCH_OPTIONS = {"criterion": "output-error", "norm": "l1", "row_basis": "haar"}
#: Largest and smallest number of seeds, and most evaluations of one optimizer on one angle over all seeds.
MAX_SEEDS, MIN_SEEDS, MAX_EVALUATIONS = 10, 3, 40_000
#: Default smallest increment of the order grid, on every arm: the paper's grid has 60 000 candidates per angle, as many
#: evaluations per seed, and takes minutes.
CONTEST_STEP = 0.1
#: An error has converged if it stays below the final error of p = 1 plus this share.
CONVERGENCE_MARGIN = 0.02
#: Joint fits use every fourth sample: 8 ms on the virtual rig, a fifteenth of the fastest link mode's period.
ROW_STRIDE = 4
#: Joint fits by output error.
JOINT_METHOD = OutputError(loss="squares", intervals="auto", noise="white")
#: Increment of the order grids of trials.
PANEL_STEP = 0.25


def published_structure(stage: StageNumber, **changes: Any) -> Structure:
    """Return the paper's (22)-(25) of a stage, every equation by itself, with zero initial conditions."""
    made = flexible_link(
        stage=stage, form="published", coupling="measured", laws=(), parameters="effective", offset="none"
    )
    return replace(made, **{"initial": "rest", **changes})


def integer_orders(structure: Structure) -> Structure:
    """Return a structure of the arm with integer orders."""
    return structure.with_orders({n: integer_order(n) for n in structure.order_names})


def neighboring_values(value: float, increment: float, steps: int) -> list[float]:
    """Return the values of an order grid around one of them."""
    return [round(value + k * increment, 9) for k in range(-steps, steps + 1)]


def best_orders(run: Run, single: Structure, grid: OrderGrid, p: int, prior: float, **work: Any) -> SearchResult:
    """Return the best candidate of multi-innovation on an order grid."""
    options: dict[str, Any] = {"innovation_length": p, "prior_covariance": prior, **SEARCH_OPTIONS, **work}
    return rank_orders(run, single, grid, top=1, coefficients="multi-innovation", **options)


def prior_text(prior: float) -> str:
    """Format K0 as 1 or 10¹⁰."""
    return "1" if prior == PRIOR_COVARIANCES[0] else f"10{str(round(math.log10(prior))).translate(SUPERSCRIPT_DIGITS)}"


def are_usable(*candidates: Candidate) -> bool:
    """Whether all fits may be used; a comparison with another one says nothing."""
    return not any(c.result is not None and is_degenerate(c.result) for c in candidates)


@dataclass(frozen=True)
class Candidate:
    """Model of a stage with its errors on both runs.

    Parameters
    ----------
    label
        Label, such as "p = 7".
    model
        The model.
    estimation, validation
        Both errors on the estimation run, with the inputs that the method uses, and on the other run, if there is one.
    input_driven
        Output error from the currents alone, by run and output.
    result
        The identification; None for a model that was not identified.
    """

    label: str
    model: Model
    estimation: Comparison
    validation: Comparison | None
    input_driven: dict[str, dict[str, Metrics]]
    result: Identification | None = None

    @property
    def fits(self) -> list[float]:
        """Fit of the free run in percent, for each output on both runs; NaN without a run."""
        runs = self.estimation, self.validation
        return [math.nan if c is None else c.output_error[o].fit for o in self.estimation.output_error for c in runs]

    def to_dict(self) -> dict[str, Any]:
        """Return the model and its errors for JSON."""
        result = {} if self.result is None else attributes(self.result, ("intervals", "settings", "warnings"))
        errors = attributes(self, ("estimation", "validation", "input_driven"))
        return attributes(self.model, ("orders", "coefficients")) | errors | result


@dataclass(frozen=True)
class Rival:
    """Multi-innovation, genetic algorithm and differential evolution on one equation, with equal budgets.

    Parameters
    ----------
    candidates, increment
        Candidates of the order grid, which are also the default evaluations per seed, and its increment.
    population
        Population size of the genetic algorithm.
    order_grid
        Searches by multi-innovation with p = 7, by K0.
    optimizers
        Results of the genetic algorithm and of differential evolution by seed, with their bounds.
    models
        Best model of each by label: genetic, differential evolution, p = 7 with K0 = 1 and with a weak prior.
    """

    candidates: int
    increment: float
    population: int
    order_grid: dict[float, SearchResult]
    optimizers: dict[str, GeneticRun]
    models: dict[str, Candidate] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison for JSON."""
        runs = {n: attributes(run, ("errors", "evaluations", "bounds")) for n, run in self.optimizers.items()}
        return attributes(self, ("candidates", "increment", "population", "models")) | {"optimizers": runs}


@dataclass(frozen=True)
class DroppedDerivative:
    """Effect of the derivative of the current that (19) drops on the simulated deflection, at equal parameters."""

    output: str
    order: float  # of the current's derivative; 0 as published
    time: Floats  # middle of every pulse [s]
    current: Floats  # pulse means
    measured: Floats
    published: Floats  # by (22)-(25)
    derived: Floats  # by (14)-(15)

    @property
    def correlations(self) -> dict[str, float]:
        """Correlation of the deflection with the current: measured, (14)-(15), published; NaN at rest."""
        found = {}
        for name in ("measured", "derived", "published"):
            parts = [v - np.mean(v) for v in (getattr(self, name), self.current)]
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                found[name] = float(np.dot(*parts) / np.sqrt(np.dot(parts[0], parts[0]) * np.dot(parts[1], parts[1])))
        return found


@dataclass(frozen=True)
class Stage:
    """Results of one stage.

    Parameters
    ----------
    number
        1 or 2.
    candidates
        Models by label, in the order of the tables.
    traces, weak_traces
        Convergence by output and p: each p at its own orders and K0 = 1; with a weak prior, at the orders of p = 7.
    rivals
        Optimizer comparisons by output; empty without PyGAD or for a run that does not start at rest.
    printed_orders
        Model with the printed orders and least-squares coefficients on this run.
    by_equation
        Model with the orders of the smallest equation error on the grid.
    derived
        Effect of the dropped derivative of the current.
    landscape
        Cost around the joint fit over its two most correlated orders; None without them.
    """

    number: StageNumber
    candidates: dict[str, Candidate]
    traces: dict[str, dict[int, MultiInnovationTrace]]
    weak_traces: dict[str, dict[int, MultiInnovationTrace]]
    rivals: dict[str, Rival]
    printed_orders: Candidate
    by_equation: Candidate
    derived: DroppedDerivative
    landscape: Landscape | None

    @property
    def outputs(self) -> tuple[str, str]:
        """Hub angle and deflection."""
        return f"theta{self.number}1", f"theta{self.number}2"

    @property
    def weak(self) -> dict[str, dict[int, dict[str, float]]]:
        """Coefficients by output and p with a weak prior, at the orders of p = 7."""
        return {
            o: {p: {n: float(c[-1]) for n, c in trace.coefficients.items()} for p, trace in each.items()}
            for o, each in self.weak_traces.items()
        }

    def to_dict(self) -> dict[str, Any]:
        """Return the stage results for JSON."""
        return {
            "models": json_value(self.candidates),
            "derived input order": attributes(self.derived, ("output", "order", "correlations")),
        } | attributes(self, ("printed_orders", "by_equation", "weak", "rivals"))


def rivals_order_grid(increment: float, smallest: float = CONTEST_STEP) -> OrderGrid:
    """Return the order grid of the comparison, given the increment of the main grid."""
    return OrderGrid(increment=max(increment, smallest), alpha=RIVAL_ALPHA)


def seeds_for(candidates: int) -> tuple[int, ...]:
    """Return ten seeds, or as many as the budget of evaluations allows."""
    return tuple(range(min(MAX_SEEDS, max(MIN_SEEDS, MAX_EVALUATIONS // max(candidates, 1)))))


def compare_optimizers(
    run: Run,
    single: Structure,
    order_grid: OrderGrid,
    asked: GeneticAlgorithm | None = None,
    *,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Rival:
    """Compare multi-innovation with a genetic algorithm and differential evolution at equal budgets per seed.

    The result has no models yet.

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
    work: dict[str, Any] = {"threads": threads, "progress": progress}
    searches = {k: best_orders(run, blind, order_grid, INNOVATION_LENGTHS[-1], k, **work) for k in PRIOR_COVARIANCES}
    count = searches[PRIOR_COVARIANCES[0]].candidates
    settings = asked or GeneticAlgorithm(seeds=seeds_for(count))
    budget = settings.evaluations or max(count, 2 * settings.population)
    settings = replace(settings, order_grid=order_grid, evaluations=budget)
    records = prepare([run], blind, None, power_of_two=True)
    optimizers = {
        "genetic": genetic_search(records, blind, settings, **work),
        "differential evolution": differential_evolution_search(records, blind, settings, **work),
    }
    return Rival(count, order_grid.increment, settings.population, searches, optimizers)


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
    optimizers
        Error (45) by optimizer and seed.
    """

    arm: str
    output: str
    candidates: int
    increment: float
    order_grid: dict[float, float]
    optimizers: dict[str, dict[int, float]]

    @classmethod
    def of(cls, arm: str, output: str, rival: Rival) -> Contest:
        """Return the errors of a comparison."""
        grid = {k: search.score for k, search in rival.order_grid.items()}
        return cls(
            arm, output, rival.candidates, rival.increment, grid, {n: r.errors for n, r in rival.optimizers.items()}
        )


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

    @property
    def fractional_text(self) -> str:
        """Orders whose interval excludes the integer one, as text."""
        return ", ".join(f"{symbol(n)} {self.orders[n][0]:.3g}" for n in self.fractional_orders) or "none"

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison for JSON."""
        names = ("arm", "stage", "integer_nr", "free_nr", "orders", "fractional_orders", "gains", "is_degenerate")
        return attributes(self, names) | {"earns": {n: self.earns(n) for n in self.free_nr}}


@dataclass(frozen=True)
class Panel:
    """All cases behind the verdicts."""

    trials: tuple[Trial, ...] = ()
    contests: tuple[Contest, ...] = ()
    order_comparisons: tuple[OrderComparison, ...] = ()

    @classmethod
    def union(cls, parts: Sequence[Panel]) -> Panel:
        """Return all cases of some panels."""
        return cls(*(tuple(c for part in parts for c in getattr(part, each.name)) for each in fields(cls)))


def convergence_step(trace: MultiInnovationTrace, end: float) -> float:
    """First step from which an error stays within a share of a final error; infinite if never."""
    with np.errstate(invalid="ignore"):
        away = np.flatnonzero(~(trace.error <= (1.0 + CONVERGENCE_MARGIN) * end))
    if not away.size:
        return float(trace.step[0])
    return float(trace.step[away[-1] + 1]) if away[-1] + 1 < trace.step.size else math.inf


def euler_means(model: Model, run: Run, m: int) -> dict[str, Floats]:
    """Pulse means of a model's response by explicit Euler, as in the paper; infinite if it overflows."""
    found = {}
    for name, samples in explicit_euler(model, run).items():
        with np.errstate(over="ignore", invalid="ignore"):
            found[name] = pulse_means(samples, m) if np.all(np.isfinite(samples)) else np.full(m, np.inf)
    return found


def trials_of(stage: StageNumber, square: Run, arm: str, seed: int, threads: int | None) -> list[Trial]:
    """Run multi-innovation on both angles of a stage, with all p and both values of K0."""
    structure, grid = published_structure(stage), OrderGrid(increment=PANEL_STEP, alpha=GRID_ALPHA)
    run, found = square.select(list(structure.signals)), []
    m = default_m([run], power_of_two=True)
    manual = euler_means(link_model(stage=stage, form="published"), run, m)
    for output in structure.outputs:
        single, manual_nr = structure.equation(output), metrics(pulse_means(run[output], m), manual[output]).nr
        for prior in PRIOR_COVARIANCES:
            best = {p: best_orders(run, single, grid, p, prior, threads=threads) for p in INNOVATION_LENGTHS}
            last = best[INNOVATION_LENGTHS[-1]].model
            traces = traces_of(run, single, dict.fromkeys(INNOVATION_LENGTHS, last), prior, TRACE_EVERY)
            end = float(traces[INNOVATION_LENGTHS[0]].error[-1])
            steps = {p: convergence_step(t, end) for p, t in traces.items()}
            nr = compare_means(last, run).output_error[output].nr
            errors = {p: s.score for p, s in best.items()}
            found.append(Trial(arm, seed, output, prior, errors, steps, nr, manual_nr))
    return found


def traces_of(
    run: Run, single: Structure, models: Mapping[int, Model], prior: float, every: int
) -> dict[int, MultiInnovationTrace]:
    """Convergence of one equation with every p, at the orders of the model of that p."""
    found = {}
    for p, model in models.items():
        known = single.with_orders({n: model.orders[n] for n in single.order_names})
        options: dict[str, Any] = {"innovation_length": p, "prior_covariance": prior, "row_basis": "haar"}
        found[p] = multi_innovation_trace(run, known, every=every, **options)
    return found


def compare_orders(
    stage: StageNumber,
    square: Run,
    arm: str,
    threads: int | None,
    progress: Callable[[int, int], None] | None = None,
    *,
    validation: Run,
) -> OrderComparison:
    """Fit integer and free orders of one stage of a simulated arm, which starts at rest, on a decimated run.

    Both are compared on a validation run.

    Raises
    ------
    ConvergenceError
        No initial guess of one of the fits converged.
    """
    structure = replace(flexible_link(stage=stage, form="lagrange", coupling="simulated"), initial="rest")
    own, other = (run.select(list(structure.signals)) for run in (square, validation))
    run = decimate_run(own, ROW_STRIDE)
    # Coefficients of integer orders overflow on an arm without them.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        fits = [
            identify(run, item, method=JOINT_METHOD, threads=threads, progress=progress)
            for item in (integer_orders(structure), structure)
        ]
    models = [replace(fit.model, m=default_m([own], power_of_two=True)) for fit in fits]
    seen, judged = ([compare_means(model, each) for model in models] for each in (own, other))
    return _order_comparison(arm, stage, seen, judged, fits)


def _order_comparison(
    arm: str,
    stage: int,
    seen: Sequence[Comparison],
    validation: Sequence[Comparison | None],
    fits: Sequence[Identification],
) -> OrderComparison:
    """Return the comparison of integer and free orders, in this order."""
    nr, free_nr = ({o: f.nr for o, f in c.output_error.items()} for c in seen)
    before, after = ({} if c is None else c.fit for c in validation)
    gains = {o: after[o] - before[o] for o in nr if o in before and math.isfinite(after[o] - before[o])}
    orders = {n: (v, *fits[1].intervals[n]) for n, v in fits[1].orders.items()}
    return OrderComparison(arm, stage, nr, free_nr, orders, gains, any(map(is_degenerate, fits)))


def panel_of(stage: Stage, square: Run, arm: str, seed: int, threads: int | None) -> Panel:
    """Return the cases of one run and its stage results; trials only for runs that start at rest."""
    both = [stage.candidates[n] for n in ("integer, identified", "output error")]
    seen, validation, fits = ([getattr(c, f) for c in both] for f in ("estimation", "validation", "result"))
    freed = (_order_comparison(arm, stage.number, seen, validation, fits),)
    trials = trials_of(stage.number, square, arm, seed, threads) if stage.traces else ()
    return Panel(tuple(trials), tuple(Contest.of(arm, o, rival) for o, rival in stage.rivals.items()), freed)


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
        run, validation = (
            demo_run(s, noise=noise, seed=seed, parameters=ARM_VARIANTS[arm]) for s in ("square", "sine")
        )
        begin("trials")
        trials += trials_of(stage, run, arm, seed, threads)
        if order_grid is None or seed != seeds[0]:
            continue
        structure = published_structure(stage)
        own = run.select(list(structure.signals))
        work: dict[str, Any] = {"threads": threads, "progress": progress}
        for output in structure.outputs if has_contests else ():
            begin("rivals")
            made = compare_optimizers(own, structure.equation(output), order_grid, genetic, **work)
            contests.append(Contest.of(arm, output, made))
        begin("freed")
        freed.append(compare_orders(stage, run, arm, **work, validation=validation))
    return Panel(tuple(trials), tuple(contests), tuple(freed))
