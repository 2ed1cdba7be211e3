"""Results of one joint: models by every method of section 5, optimizer comparisons, and the cases for verdicts."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from ftlm.arm.flexible_link import Law, flexible_link, integer_order, link_model, order_law
from ftlm.data.run import Run
from ftlm.errors import ConvergenceError, ModelError
from ftlm.estimation.cost_surface import output_error_landscape
from ftlm.estimation.estimators import estimate_output_error
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.genetic import GeneticAlgorithm, GeneticRun, differential_evolution_search, genetic_search
from ftlm.estimation.identify import assess_fit, identify
from ftlm.estimation.linear import MultiInnovationTrace, multi_innovation_trace
from ftlm.estimation.methods import EstimationMethod, InstrumentalVariables, OutputError, method_with_options
from ftlm.estimation.result import Identification, Task
from ftlm.estimation.verdict import improves_prediction, is_degenerate
from ftlm.kernels import pulse_means
from ftlm.model.model import Model
from ftlm.order_search.options import OrderGrid
from ftlm.order_search.result import SearchResult
from ftlm.order_search.search import rank_orders
from ftlm.plot.comparison_charts import pulse_times
from ftlm.reproduction.published_values import (
    INNOVATION_LENGTHS,
    PRIOR_COVARIANCES,
    SEARCH_OPTIONS,
    WEAK_PRIOR,
    best_orders,
    last_orders,
    neighboring_values,
    page_text,
)
from ftlm.reproduction.simulated_arm import ARM_VARIANTS, MAIN_ARM, StageNumber, decimate_run, demo_run
from ftlm.reproduction.workload import CONTEST_STEP, WorkerProgress, seconds_of, seeds_for
from ftlm.simulation.discretization import default_m, prepare
from ftlm.simulation.initial_conditions import starts_at_rest
from ftlm.simulation.simulate import explicit_euler
from ftlm.structure.structure import Structure
from ftlm.svg.charts import Landscape
from ftlm.utils.formatting import attributes, json_value, symbol
from ftlm.utils.validation import Floats, check_threads
from ftlm.validation.comparison import Comparison, Metrics, compare_means, metrics

#: Steps between two points of a convergence curve; the effect of p is limited to the first steps.
TRACE_EVERY = 2
#: Labels of multi-innovation in the optimizer comparison, by K0.
MULTI_INNOVATION_LABELS = ("p = 7", "p = 7, weak prior")
#: Highest orders of the paper's grid, and those of the optimizer comparison, which contain the orders printed for both
#: methods and leave so few candidates that all can be evaluated.
GRID_ALPHA, RIVAL_ALPHA = (1.05, 2.0), (1.95, 2.0)
#: An error has converged if it stays below the final error of p = 1 plus this share.
CONVERGENCE_MARGIN = 0.02
#: Joint fits use every fourth sample: 8 ms on the virtual rig, a fifteenth of the fastest link mode's period.
ROW_STRIDE = 4
#: Joint fits by output error.
JOINT_METHOD = OutputError(loss="squares", intervals="auto", noise="white")
#: Increment of the order grids of trials.
PANEL_STEP = 0.25
#: Radius [increments] of the search by instrumental variables around the orders of least squares; every candidate needs
#: several simulations.
INSTRUMENTAL_RADIUS_STEPS = 2
#: Runs with more samples than the first number are decimated to at most the second for joint fits, whose cost grows
#: with the samples. The arm's modes are two decades below the reduced rate.
MAX_FULL_SAMPLES, DECIMATED_SAMPLES = 6000, 2500
#: Increment of a first search on finer grids, among orders of multi-innovation that no bound excludes, and number of
#: the best candidates around which the grid's own increment follows.
COARSE_INCREMENT, REFINED_CANDIDATES = 0.1, 10
#: Samples of fits with integer orders, whose systematic residuals do not shrink with more samples.
INTEGER_FIT_SAMPLES = 1250


def published_structure(stage: StageNumber, **changes: Any) -> Structure:
    """Return the paper's equations (22)-(25) of a joint, uncoupled and with zero initial conditions."""
    structure = flexible_link(
        stage=stage, form="published", coupling="measured", laws=(), parameters="effective", offset="none"
    )
    return replace(structure, **{"initial": "rest", **changes})


def integer_orders(structure: Structure) -> Structure:
    """Return a structure of the arm with integer orders."""
    return structure.with_orders({n: integer_order(n) for n in structure.order_names})


def are_usable(*candidates: Candidate) -> bool:
    """Whether all fits may be used; otherwise comparisons with them are meaningless."""
    return not any(c.result is not None and is_degenerate(c.result) for c in candidates)


@dataclass(frozen=True)
class Candidate:
    """Model of a joint with its errors on both runs.

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
        """Fit of the simulation in percent, for each output on both runs; NaN without a run."""
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
    """Deflection simulated with and without the derivative of the current that the paper's (19) drops."""

    output: str
    order: float  # of the current's derivative; 0 as published
    time: Floats  # middle of every pulse [s]
    current: Floats  # pulse means
    measured: Floats
    published: Floats  # by (22)-(25)
    derived: Floats  # by (14)-(15)

    @property
    def correlations(self) -> dict[str, float]:
        """Return the correlation of the current with each deflection by name; NaN at rest.

        The deflections are measured, derived by the paper's (14)-(15), and published by its (22)-(25).
        """
        names = ("measured", "derived", "published")
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            matrix = np.corrcoef([getattr(self, n) for n in names] + [self.current])
        return dict(zip(names, matrix[-1].tolist(), strict=False))


@dataclass(frozen=True)
class Stage:
    """Results of one joint (stage) of the arm.

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
    derived: DroppedDerivative
    landscape: Landscape | None

    @property
    def outputs(self) -> tuple[str, str]:
        """Names of the hub angle and the deflection."""
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
        } | attributes(self, ("printed_orders", "weak", "rivals"))


def rivals_order_grid(increment: float, smallest: float = CONTEST_STEP) -> OrderGrid:
    """Return the order grid of the comparison, given the increment of the main grid."""
    return OrderGrid(increment=max(increment, smallest), alpha=RIVAL_ALPHA)


def compare_optimizers(
    run: Run,
    single: Structure,
    order_grid: OrderGrid,
    optimizer: GeneticAlgorithm | None = None,
    *,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Rival:
    """Compare multi-innovation with a genetic algorithm and differential evolution at equal budgets per seed.

    The result does not contain the models.

    Parameters
    ----------
    run
        Record that starts at rest.
    single
        Structure with one equation.
    order_grid
        Order grid of multi-innovation; its ends bound the orders of the optimizers.
    optimizer
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
    settings = optimizer or GeneticAlgorithm(seeds=seeds_for(count))
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
    """Multi-innovation estimates of one angle of one record at one prior covariance K0, for each innovation length p.

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
    """Fits of one angle by multi-innovation, genetic algorithm and differential evolution, at equal budgets.

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
    """Fits of the paper's (14)-(15) to one record with integer and with free orders, by joint output error.

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

    @classmethod
    def of(cls, arm: str, stage: int, integer: Candidate, free: Candidate) -> OrderComparison:
        """Return the comparison of two identified models."""
        before, after = ({} if c.validation is None else c.validation.fit for c in (integer, free))
        gains = {o: after[o] - before[o] for o in after if math.isfinite(after[o] - before[o])}
        nr, free_nr = ({o: f.nr for o, f in c.estimation.output_error.items()} for c in (integer, free))
        if free.result is None:
            raise ModelError(f"model {free.label} was not identified; its orders have no intervals")
        orders = {n: (v, *free.result.intervals[n]) for n, v in free.result.orders.items()}
        return cls(arm, stage, nr, free_nr, orders, gains, not are_usable(integer, free))

    def improves(self, output: str) -> bool | None:
        """Whether free orders improve the fit of an angle significantly, as in ``ftlm orders``; None if unknown."""
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
        return attributes(self, names) | {"improves": {n: self.improves(n) for n in self.free_nr}}


@dataclass(frozen=True)
class Panel:
    """All cases on which the verdicts are based."""

    trials: tuple[Trial, ...] = ()
    contests: tuple[Contest, ...] = ()
    order_comparisons: tuple[OrderComparison, ...] = ()

    @classmethod
    def union(cls, parts: Sequence[Panel]) -> Panel:
        """Return all cases of some panels."""
        return cls(*(tuple(c for part in parts for c in getattr(part, each.name)) for each in fields(cls)))


def convergence_step(trace: MultiInnovationTrace, end: float) -> float:
    """Return the first step from which an error stays close to a final error; infinite if it never does."""
    with np.errstate(invalid="ignore"):
        away = np.flatnonzero(~(trace.error <= (1.0 + CONVERGENCE_MARGIN) * end))
    if not away.size:
        return float(trace.step[0])
    return float(trace.step[away[-1] + 1]) if away[-1] + 1 < trace.step.size else math.inf


def euler_means(model: Model, run: Run, m: int) -> dict[str, Floats]:
    """Pulse means of a model's response by explicit Euler, as in the paper; infinite if it overflows."""
    means = {}
    for name, samples in explicit_euler(model, run).items():
        with np.errstate(over="ignore", invalid="ignore"):
            means[name] = pulse_means(samples, m) if np.all(np.isfinite(samples)) else np.full(m, np.inf)
    return means


def trials_of(stage: StageNumber, square: Run, arm: str, seed: int, threads: int | None) -> list[Trial]:
    """Run multi-innovation on both angles of a stage, with all p and both values of K0."""
    structure, grid = published_structure(stage), OrderGrid(increment=PANEL_STEP, alpha=GRID_ALPHA)
    run, trials = square.select(list(structure.signals)), []
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
            trials.append(Trial(arm, seed, output, prior, errors, steps, nr, manual_nr))
    return trials


def traces_of(
    run: Run, single: Structure, models: Mapping[int, Model], prior: float, every: int
) -> dict[int, MultiInnovationTrace]:
    """Return the convergence of the recursion for one equation by innovation length p."""
    traces = {}
    for p, model in models.items():
        structure = single.with_orders({n: model.orders[n] for n in single.order_names})
        options: dict[str, Any] = {"innovation_length": p, "prior_covariance": prior, "row_basis": "haar"}
        traces[p] = multi_innovation_trace(run, structure, every=every, **options)
    return traces


def compare_orders(
    stage: StageNumber,
    square: Run,
    arm: str,
    threads: int | None,
    progress: Callable[[int, int], None] | None = None,
    *,
    validation: Run,
) -> OrderComparison:
    """Fit integer orders and free orders of one joint of a simulated arm to a decimated run that starts at rest.

    Both fits are compared on a validation run.

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
    m, candidates = default_m([own], power_of_two=True), []
    for fit in fits:
        model = replace(fit.model, m=m)
        candidates.append(Candidate("", model, compare_means(model, own), compare_means(model, other), {}, fit))
    return OrderComparison.of(arm, stage, *candidates)


def panel_of(stage: Stage, square: Run, arm: str, seed: int, threads: int | None) -> Panel:
    """Return the cases of one run and the results of its joint; trials only for runs that start at rest."""
    freed = OrderComparison.of(
        arm, stage.number, stage.candidates["integer, identified"], stage.candidates["output error"]
    )
    trials = trials_of(stage.number, square, arm, seed, threads) if stage.traces else ()
    return Panel(tuple(trials), tuple(Contest.of(arm, o, rival) for o, rival in stage.rivals.items()), (freed,))


@dataclass(frozen=True)
class Preset:
    """Settings that differ between the reproduction and the demonstration."""

    order_grid: OrderGrid
    top: int | None  # rows of an order search with the statistics of an identification; None: a search alone
    trace_every: int  # steps between two points of a convergence curve
    # Of the order grid of the optimizer comparison; None without PyGAD or SciPy.
    rivals_increment: float | None = CONTEST_STEP

    def seconds_of(self, step: str) -> float:
        """Processor time of a step [s]."""
        return seconds_of(step, self.order_grid.increment, self.rivals_increment)


def simulated_panel(
    stage: StageNumber,
    arm: str,
    seeds: Sequence[int],
    noise: float,
    preset: Preset,
    threads: int | None,
    genetic: GeneticAlgorithm | None = None,
    steps: WorkerProgress | None = None,
) -> Panel:
    """Return the cases of one stage on one simulated arm; contests and joint fits on the first record only.

    For the main arm only trials are computed, because :func:`panel_of` returns the other cases of its first record.
    """
    trials: list[Trial] = []
    contests: list[Contest] = []
    freed: list[OrderComparison] = []

    def begin(step: str) -> None:
        if steps is not None:
            steps.begin(preset.seconds_of(step))

    for seed in seeds:
        run, validation = (
            demo_run(s, noise=noise, seed=seed, parameters=ARM_VARIANTS[arm]) for s in ("square", "sine")
        )
        begin("trials")
        trials += trials_of(stage, run, arm, seed, threads)
        if arm == MAIN_ARM or seed != seeds[0]:
            continue
        structure = published_structure(stage)
        own = run.select(list(structure.signals))
        if preset.rivals_increment is not None:
            grid = rivals_order_grid(preset.order_grid.increment, preset.rivals_increment)
            for output in structure.outputs:
                begin("rivals")
                single = structure.equation(output)
                contest = compare_optimizers(own, single, grid, genetic, threads=threads, progress=steps)
                contests.append(Contest.of(arm, output, contest))
        begin("freed")
        freed.append(compare_orders(stage, run, arm, threads, steps, validation=validation))
    return Panel(tuple(trials), tuple(contests), tuple(freed))


@dataclass
class StageWork:
    """Computation for one stage of the arm: runs, settings, progress callbacks, and notes on omitted results."""

    number: StageNumber
    square: Run
    sine: Run | None
    preset: Preset
    threads: int | None
    log: Callable[[str], None]
    progress: Callable[[int, int], None] | None
    notes: list[str] = field(default_factory=list)
    # Whether the runs are simulated from rest, so that initial conditions are known.
    simulated: bool = False

    def __post_init__(self) -> None:
        # Structures of the paper, under its laws, and of the simulated arm.
        self.measured = published_structure(self.number)
        laws: tuple[Law, ...] = ("orders", "coefficients")
        self.published = flexible_link(stage=self.number, form="published", coupling="simulated", laws=laws)
        self.coupled = flexible_link(stage=self.number, form="lagrange", coupling="simulated", laws=laws)
        own = list(self.measured.signals)
        self.on = self.square.select(own)
        self.off = None if self.sine is None else self.sine.select(own)
        if self.simulated:
            self.published, self.coupled = (replace(s, initial="rest") for s in (self.published, self.coupled))
        elif not starts_at_rest(self.on, self.measured):
            # The paper's equation errors have few terms; ten powers of t more would be combinations of them.
            self.measured, self.published, self.coupled = (
                replace(s, initial="caputo") for s in (self.measured, self.published, self.coupled)
            )

    def begin(self, words: str, step: str) -> None:
        """Report the start of the next step and its processor time."""
        self.log(f"stage {self.number}: {words}")
        if isinstance(self.progress, WorkerProgress):
            self.progress.begin(self.preset.seconds_of(step))

    def compute_stage(self, genetic: GeneticAlgorithm | None) -> Stage:
        """Compute all results of section 5 for a stage."""
        exact = self.manual("integer, exact")
        candidates = {"integer, Euler": self.euler_candidate("integer, Euler", exact), "integer, exact": exact}
        whole = integer_orders(self.coupled)
        candidates["integer, identified"] = self.best("integer, identified", whole, "whole orders", "whole orders")
        candidates |= self.searches()
        candidates["instrumental variables"] = self.instrumental(candidates["least squares"])
        joint = candidates["output error"] = self.best("output error", self.coupled, "free orders")
        label = "published, output error"
        candidates[label] = self.best(label, self.published, "free orders, (22)–(25)", "published", joint.model)
        self.begin("convergence", "traces")
        traces: dict[str, dict[int, MultiInnovationTrace]] = {}
        weak: dict[str, dict[int, MultiInnovationTrace]] = {}
        if self.measured.initial == "rest":
            models = {p: candidates[f"p = {p}"].model for p in INNOVATION_LENGTHS}
            traces = self.traces(models)
            weak = self.traces(dict.fromkeys(models, models[INNOVATION_LENGTHS[-1]]), WEAK_PRIOR)
        else:
            self.notes.append(page_text("moving_start", run=self.on.name))
        rivals = self.rivals(genetic)
        derived = self.dropped_derivative(joint.model)
        self.begin("the landscape of its orders", "landscape")
        landscape = None
        if joint.result is not None and joint.result.joint is not None:
            landscape = output_error_landscape(joint.result)
        return Stage(self.number, candidates, traces, weak, rivals, self.printed_orders(), derived, landscape)

    def candidate(self, label: str, model: Model, result: Identification | None = None) -> Candidate:
        """Return a model with both errors on both runs, and its simulation from the currents alone."""
        # Errors are sums over the paper's pulses; over other pulses they would be other numbers.
        model = replace(model, m=default_m([self.on], power_of_two=True))
        runs = [run for run in (self.on, self.off) if run is not None]
        on, *off = (compare_means(model, run) for run in runs)
        alone = {}
        if len(model.equations) > 1:
            coupled = replace(model, structure=replace(model.structure, coupling="simulated"))
            alone = {run.name: compare_means(coupled, run).output_error for run in runs}
        return Candidate(label, model, on, off[0] if off else None, alone, result)

    def identify_candidate(
        self, label: str, run: Run, structure: Structure, method: EstimationMethod = JOINT_METHOD
    ) -> Candidate:
        """Identify a candidate, by default by output error."""
        result = identify(run, structure, method=method, threads=self.threads, progress=self.progress)
        return self.candidate(label, result.model, result)

    def manual(self, label: str) -> Candidate:
        """Return the integer-order model of the manufacturer's manual."""
        return self.candidate(label, link_model(stage=self.number, form="published"))

    def euler_candidate(self, label: str, exact: Candidate) -> Candidate:
        """Return the same model simulated by explicit Euler, as in the paper."""

        def by_euler(run: Run, comparison: Comparison) -> Comparison:
            means = euler_means(exact.model, run, comparison.m)
            errors = {n: metrics(comparison.measured[n][0], mean) for n, mean in means.items()}
            simulated, parts = {n: [mean] for n, mean in means.items()}, [(run.name, comparison.equation_error, errors)]
            return replace(comparison, simulated=simulated, output_error=errors, per_run=parts, findings=())

        on, off = by_euler(self.on, exact.estimation), None
        alone = {self.on.name: on.output_error}
        if self.off is not None and exact.validation is not None:
            off = by_euler(self.off, exact.validation)
            alone[self.off.name] = off.output_error
        return replace(exact, label=label, estimation=on, validation=off, input_driven=alone)

    def searches(self) -> dict[str, Candidate]:
        """Search the whole order grid by multi-innovation with the paper's p, and by least squares."""
        kinds: dict[str, tuple[str, dict[str, Any]]] = {
            f"p = {p}": ("multi-innovation", {"innovation_length": p, "prior_covariance": PRIOR_COVARIANCES[0]})
            for p in INNOVATION_LENGTHS
        }
        candidates, grid = {}, self.preset.order_grid
        for label, (coefficients, options) in (kinds | {"least squares": ("least-squares", {})}).items():
            self.begin(f"orders on the lattice, {label}", "search")
            if self.preset.top is None:
                candidates[label] = self.search_candidate(label, grid, coefficients=coefficients, **options)
            else:
                method = method_with_options(coefficients, {"order_grid": grid, "top": self.preset.top, **options})
                candidates[label] = self.identify_candidate(label, self.on, self.measured, method)
        return candidates

    def search_candidate(self, label: str, order_grid: OrderGrid, **options: Any) -> Candidate:
        """Return the model with the best orders of each equation, without the statistics of an identification."""
        orders: dict[str, float] = {}
        coefficients: dict[str, float] = {}
        for output in self.measured.outputs:
            single = self.measured.equation(output)
            own = replace(order_grid, orders={n: v for n, v in order_grid.orders.items() if n in single.order_names})
            best = self._best_orders(single, own, {**SEARCH_OPTIONS, **options})
            orders |= best.orders
            coefficients |= best.coefficients
        structure = self.measured.with_orders(orders).with_coefficients(coefficients)
        units = {n: u for n, u in self.on.units.items() if n in structure.signals}
        about = {"origin": label, "run": self.on.name}
        return self.candidate(label, Model(structure, orders=orders, units=units, about=about))

    def printed_orders(self) -> Candidate:
        """Return the model with the printed orders and least-squares coefficients."""
        axes = {n: [v] for output in self.measured.outputs for n, v in last_orders(output).items()}
        grid = replace(self.preset.order_grid, orders=axes)
        return self.search_candidate("printed orders", grid, coefficients="least-squares")

    def _best_orders(self, single: Structure, own: OrderGrid, options: Mapping[str, Any]) -> SearchResult:
        """Return the best candidate of an order grid.

        With K0 = 1 the simulated deflection is nearly zero. The errors of all candidates are then close to that of a
        zero output. No bound excludes a candidate, and each would have to be simulated completely.
        """
        work: dict[str, Any] = {"threads": self.threads, "progress": self.progress, **options}
        own_terms = sum(t.signal == single.outputs[0] for t in single.equations[0].terms)
        heavy = own_terms > 1 and options.get("coefficients") == "multi-innovation"
        if not (heavy and own.increment < COARSE_INCREMENT and not own.orders):
            return rank_orders(self.on, single, own, top=1, **work)
        values, coarse = own.values(single), replace(own, increment=COARSE_INCREMENT)
        ends = []
        for row in rank_orders(self.on, single, coarse, top=REFINED_CANDIDATES, **work).table:
            near = {
                n: [v for v in values[n] if abs(v - at) < 2 * COARSE_INCREMENT - 1e-9] for n, at in row.orders.items()
            }
            ends.append(rank_orders(self.on, single, replace(own, orders=near), top=1, **work))
        return min(ends, key=lambda end: end.score)

    def instrumental(self, start: Candidate) -> Candidate:
        """Return the best model of a search by instrumental variables around the orders of another model."""
        self.begin("orders by instrumental variables", "instrumental")
        grid = self.preset.order_grid
        axes = {}
        for name, value in start.model.orders.items():
            steps = 1 if name.startswith("alpha") else INSTRUMENTAL_RADIUS_STEPS
            axes[name] = [v for v in neighboring_values(value, grid.increment, steps) if 0 <= v <= grid.alpha[1]]
        method = InstrumentalVariables(order_grid=replace(grid, orders=axes), top=1)
        return self.identify_candidate("instrumental variables", self.on, self.measured, method)

    def joint(
        self, label: str, structure: Structure, words: str, step: str = "output error", near: Model | None = None
    ) -> Candidate:
        """Return a model fitted by joint output error, to the whole run or to a decimated run."""
        self.begin(words, step)
        run = self.on
        if step == "whole orders" and run.length >= 2 * INTEGER_FIT_SAMPLES:
            run = decimate_run(run, run.length // INTEGER_FIT_SAMPLES)
        elif run.length > MAX_FULL_SAMPLES:
            every = -(-run.length // DECIMATED_SAMPLES)
            self.notes.append(page_text("decimated", run=run, every=every, step=every * run.step))
            run = decimate_run(run, every)
        if near is None:
            return self.identify_candidate(label, run, structure)
        # Only standard errors of the published form are used. Its automatic initial guesses end in optima that rounding
        # chooses between; the parameters of (14)-(15) lead to the one whose residuals are the noise.
        begin = self.published_values(near)
        if not self.simulated:
            try:
                return self.identify_candidate(label, run, structure, OutputError(intervals="quadratic", start=begin))
            except ModelError:
                # Outside the bounds of (22)-(25).
                return self.identify_candidate(label, run, structure, OutputError(intervals="quadratic"))
        task, options = Task((run,), structure), (None, check_threads(self.threads), self.progress)
        result = assess_fit(estimate_output_error(task, *options, intervals="quadratic", begin=begin, alone=True))
        return self.candidate(label, result.model, result)

    def best(
        self, label: str, structure: Structure, what: str, step: str = "output error", near: Model | None = None
    ) -> Candidate:
        """Return a model fitted by joint output error from the current alone.

        If that fails, it is fitted with the measured other angle.
        """
        words = f"{what}, by output error"
        try:
            return self.joint(label, structure, words, step, near)
        except ConvergenceError as error:
            self.notes.append(page_text("measured_coupling", stage=self.number, label=label, error=error))
        return self.joint(label, replace(structure, coupling="measured"), words, step, near)

    def traces(
        self, models: Mapping[int, Model], prior: float = PRIOR_COVARIANCES[0]
    ) -> dict[str, dict[int, MultiInnovationTrace]]:
        """Return the convergence of the recursion for every equation and innovation length p."""
        parts = {o: self.measured.equation(o) for o in self.measured.outputs}
        return {o: traces_of(self.on, each, models, prior, self.preset.trace_every) for o, each in parts.items()}

    def rivals(self, genetic: GeneticAlgorithm | None) -> dict[str, Rival]:
        """Compare multi-innovation with other optimizers on each equation; empty if these are not installed."""
        if self.preset.rivals_increment is None:
            return {}
        grid = rivals_order_grid(self.preset.order_grid.increment, self.preset.rivals_increment)
        rivals = {}
        for output in self.measured.outputs:
            single = self.measured.equation(output)
            self.begin(f"the rivals on {output}", "rivals")
            try:
                contest = compare_optimizers(
                    self.on, single, grid, genetic, threads=self.threads, progress=self.progress
                )
            except ModelError as error:
                self.notes.append(page_text("rivals_omitted", reason=error))
                return {}
            best = dict(zip(MULTI_INNOVATION_LABELS, contest.order_grid.values(), strict=True))
            ends: list[tuple[str, GeneticRun | SearchResult]] = [*contest.optimizers.items(), *best.items()]
            models = {
                name: Model(single.with_orders(end.orders).with_coefficients(end.coefficients), orders=dict(end.orders))
                for name, end in ends
            }
            rivals[output] = replace(contest, models={n: self.candidate(n, model) for n, model in models.items()})
        return rivals

    def in_published_form(self, model: Model) -> Model:
        """Insert the parameters of the paper's (14)-(15) into its (22)-(25), which drop a derivative of the current."""
        h, d = self.number * 2 - 1, self.number * 2
        values = {n: model.coefficients[n] for n in (f"{c}{k}" for c in "ad" for k in (h, d))}
        values |= {n: model.coefficients[n] for n in (f"b{h}", f"g{h}")}
        values |= {f"{c}{d}": -values[f"{c}{h}"] for c in "bg"}
        values |= {f"{c}{d}": values[f"{c}{d}"] - values[f"{c}{h}"] for c in "ad"}
        highest = {e.output: e.order.constant for e in model.equations}
        other = link_model(
            stage=self.number,
            form="published",
            orders={**model.orders, f"alpha{d}": highest[self.measured.outputs[1]]},
            coefficients=values,
            coupling=model.structure.coupling,
        )
        return replace(other, m=model.m, structure=replace(other.structure, initial=model.structure.initial))

    def published_values(self, model: Model) -> dict[str, float]:
        """Return the free parameters of the paper's (22)-(25) that correspond to a model of its (14)-(15), by name."""
        other = self.in_published_form(model)
        values = {**other.orders, **other.coefficients}
        h, d = f"a{self.number * 2 - 1}", f"a{self.number * 2}"
        free = FreeProblem.of(replace(self.published, initial="rest")).names
        return {n: v for n, v in values.items() if n in free} | {f"r{self.number}": -values[d] / values[h]}

    def dropped_derivative(self, model: Model) -> DroppedDerivative:
        """Simulate the deflection by equations (14)-(15) and by (22)-(25) of the paper, with equal parameters."""
        output, other = self.measured.outputs[1], self.in_published_form(model)
        whole, published = (compare_means(m, self.on) for m in (model, other))
        drive = f"I{self.number}"
        current = pulse_means(self.on[drive], whole.m, hold=self.on.intersample[drive] == "zoh")
        order = order_law(self.number, "derived")["input"].at(other.orders)
        responses = whole.measured[output][0], published.simulated[output][0], whole.simulated[output][0]
        return DroppedDerivative(output, order, pulse_times(whole), current, *responses)
