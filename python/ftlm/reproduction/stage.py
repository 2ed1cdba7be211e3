"""Results of one joint (stage) of the arm: models by every method of the paper's section 5, and cases for verdicts.

A case is the outcome of one test of a claim of the paper, on one simulated or measured record. In this module, p is the
innovation length and K0 the prior covariance of multi-innovation. Equation numbers are those of the paper.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from operator import attrgetter
from typing import Any

import numpy as np

from ftlm.arm.flexible_link import flexible_link, integer_order, link_model, order_law
from ftlm.data.run import Run
from ftlm.errors import ConvergenceError, ModelError
from ftlm.estimation.cost_surface import output_error_landscape
from ftlm.estimation.estimators import estimate_output_error
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.genetic import GeneticAlgorithm, GeneticRun, differential_evolution_search, genetic_search
from ftlm.estimation.identify import assess_fit, identify
from ftlm.estimation.linear import MultiInnovationTrace, multi_innovation_trace
from ftlm.estimation.methods import (
    EstimationMethod,
    InstrumentalVariables,
    LeastSquares,
    MultiInnovation,
    OrderSearchMethod,
    OutputError,
)
from ftlm.estimation.result import Identification, Task
from ftlm.estimation.verdict import improves_prediction, is_degenerate
from ftlm.kernels import pulse_means
from ftlm.model.model import Model
from ftlm.order_search.options import OrderGrid, restrict_order_grid
from ftlm.order_search.result import SearchResult
from ftlm.order_search.search import rank_orders
from ftlm.plot.comparison_charts import pulse_times
from ftlm.reproduction import published_values as printed
from ftlm.reproduction.published_values import FIRST_P, INNOVATION_LENGTHS, LAST_P, PRIOR_COVARIANCES, page_text
from ftlm.reproduction.simulated_arm import ARM_VARIANTS, MAIN_ARM, StageNumber, decimate_run, demo_run
from ftlm.reproduction.workload import COMPARISON_INCREMENT, WorkerProgress, seconds_of, seeds_for
from ftlm.simulation.discretization import default_m, prepare
from ftlm.simulation.initial_conditions import starts_at_rest
from ftlm.simulation.simulate import explicit_euler
from ftlm.structure.structure import Initial, Structure
from ftlm.svg.charts import Landscape
from ftlm.utils.formatting import attributes, json_value, symbol
from ftlm.utils.validation import Floats, check_threads
from ftlm.validation.comparison import Comparison, Metrics, compare_means, metrics

#: Number of recursion steps between two points of a convergence curve; p has an effect only in the first steps.
TRACE_EVERY = 2
#: Labels of multi-innovation in the optimizer comparison, for the prior covariances K0 = 1 and 1e10.
MULTI_INNOVATION_LABELS = ("p = 7", "p = 7, weak prior")
#: Interval of alpha in the paper's order grid, and in the optimizer comparison. The latter contains the orders printed
#: for both methods, and is so short that all candidates can be evaluated.
GRID_ALPHA, COMPARISON_ALPHA = (1.05, 2.0), (1.95, 2.0)
#: An error has converged once it stays below the final error of p = 1 times 1 plus this margin.
CONVERGENCE_MARGIN = 0.02
#: Decimation factor of joint fits: 8 ms on the virtual rig, a fifteenth of the period of the fastest link mode.
ROW_STRIDE = 4
#: Method of joint fits (of both equations of a joint): output error with squared residuals and white noise.
JOINT_METHOD = OutputError(loss="squares", intervals="auto", noise="white")
#: Method of joint fits of the published equations, of which only standard errors are used.
PUBLISHED_METHOD = replace(JOINT_METHOD, intervals="quadratic")
#: Increment of the order grids with which claims on the innovation length are tested (:class:`Trial`).
TRIAL_INCREMENT = 0.25
#: Radius [increments] of the search by instrumental variables around the orders of least squares. It is small because
#: every candidate takes several simulations.
INSTRUMENTAL_RADIUS_STEPS = 2
#: Number of samples above which a run is decimated for joint fits, and maximum number of samples after decimation. The
#: modes of the arm are two decades below the reduced sampling rate.
MAX_FULL_SAMPLES, DECIMATED_SAMPLES = 6000, 2500
#: Increment of a first, coarse search by multi-innovation whose candidates no bound excludes, and number of its best
#: candidates around which the full order grid is then searched.
COARSE_INCREMENT, REFINED_CANDIDATES = 0.1, 10
#: Number of samples of fits with integer orders, whose systematic residuals do not shrink with more samples.
INTEGER_FIT_SAMPLES = 1250


#: Convergence of multi-innovation, by output and innovation length p.
Traces = dict[str, dict[int, MultiInnovationTrace]]


def published_structure(stage: StageNumber) -> Structure:
    """Return the structure of a joint by eqs. (22)-(25) of the paper, uncoupled and from rest."""
    structure = flexible_link(stage=stage, form="published", coupling="measured", laws=(), parameters="effective")
    return replace(structure, initial="rest")


def integer_orders(structure: Structure) -> Structure:
    """Return a structure of the arm whose free orders are fixed at the integer values of the manufacturer's manual."""
    return structure.with_orders({n: integer_order(n) for n in structure.order_names})


def are_usable(*candidates: Candidate) -> bool:
    """True if no identified model has the verdict "do not use". Comparisons with such a model would be meaningless."""
    return not any(c.result is not None and is_degenerate(c.result) for c in candidates)


@dataclass(frozen=True)
class Candidate:
    """Model of one joint of the arm, with its errors on the estimation run and on the validation run.

    Parameters
    ----------
    model
        Model of both angles of the joint, or of one of them.
    estimation, validation
        Equation error and output error on the estimation run and on the validation run, with the coupling of the model.
        `validation` is None without a validation run.
    input_driven
        Output error of the simulation from the currents alone, by run name and output; empty for a single equation.
    result
        Identification of the model; None for a model that was not identified.
    """

    model: Model
    estimation: Comparison
    validation: Comparison | None
    input_driven: dict[str, dict[str, Metrics]]
    result: Identification | None = None

    @property
    def fits(self) -> list[float]:
        """Fit of the simulation [%], for each output first on the estimation run, then on the validation run.

        The fit is NaN if there is no validation run.
        """
        runs = self.estimation, self.validation
        return [math.nan if c is None else c.output_error[o].fit for o in self.estimation.output_error for c in runs]

    def to_dict(self) -> dict[str, Any]:
        """Return orders, coefficients and errors of the model as a dictionary for JSON."""
        result = {} if self.result is None else attributes(self.result, ("intervals", "settings", "warnings"))
        errors = attributes(self, ("estimation", "validation", "input_driven"))
        return attributes(self.model, ("orders", "coefficients")) | errors | result


@dataclass(frozen=True)
class OptimizerComparison:
    """Comparison of multi-innovation, genetic algorithm and differential evolution on one equation.

    Parameters
    ----------
    candidates, increment
        Number of candidates of the order grid, and its increment. The number is also the default number of evaluations
        per seed.
    population
        Population size of the genetic algorithm.
    order_grid
        Order searches by multi-innovation with innovation length 7, by prior covariance K0.
    optimizers
        Results of the genetic algorithm and of differential evolution, by name.
    models
        Best model of each method by label: genetic, differential evolution, "p = 7" (K0 = 1) and "p = 7, weak prior".
        Empty if the models were not computed.
    """

    candidates: int
    increment: float
    population: int
    order_grid: dict[float, SearchResult]
    optimizers: dict[str, GeneticRun]
    models: dict[str, Candidate] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as a dictionary for JSON."""
        runs = {n: attributes(run, ("errors", "evaluations", "bounds")) for n, run in self.optimizers.items()}
        return attributes(self, ("candidates", "increment", "population", "models")) | {"optimizers": runs}


@dataclass(frozen=True)
class DroppedDerivative:
    """Deflection simulated with and without the derivative of the motor current that eq. (19) of the paper drops.

    All arrays have one value per block pulse; deflections [rad] and current [A] are means over the pulse.
    """

    output: str
    order: float  # order of the dropped derivative of the current; the published equations have 0
    time: Floats  # middle of every block pulse [s]
    current: Floats
    measured: Floats
    published: Floats  # simulated by eqs. (22)-(25), without the derivative
    derived: Floats  # simulated by eqs. (14)-(15), without elimination

    @property
    def correlations(self) -> dict[str, float]:
        """Correlation coefficient of the current with each deflection; NaN for a constant signal.

        Keys are "measured", "derived" (simulated by eqs. (14)-(15) of the paper) and "published" (simulated by eqs.
        (22)-(25) of the paper).
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
        Number of the joint, 1 or 2.
    candidates
        Models by label, in the sequence of the tables.
    traces, weak_prior_traces
        Convergence of the multi-innovation recursion by output and innovation length p. `traces` have K0 = 1 and the
        best orders of each p. `weak_prior_traces` have a weak prior and the orders of p = 7. Empty for a run that does
        not start at rest.
    optimizer_comparisons
        Optimizer comparisons by output; empty without PyGAD or SciPy, or for a run that does not start at rest.
    printed_orders
        Model with the orders printed in the paper and least-squares coefficients on the estimation run.
    dropped_derivative_effect
        Simulations of the deflection with and without the derivative of the current that the paper drops.
    landscape
        Output-error cost around the optimum, as a function of the two most correlated orders; None if there are no two
        orders with a finite standard error.
    """

    number: StageNumber
    candidates: dict[str, Candidate]
    traces: Traces
    weak_prior_traces: Traces
    optimizer_comparisons: dict[str, OptimizerComparison]
    printed_orders: Candidate
    dropped_derivative_effect: DroppedDerivative
    landscape: Landscape | None

    @property
    def outputs(self) -> tuple[str, str]:
        """Names of the hub angle and of the link deflection of this joint."""
        return f"theta{self.number}1", f"theta{self.number}2"

    @property
    def weak_prior_coefficients(self) -> dict[str, dict[int, dict[str, float]]]:
        """Final coefficients with a weak prior at the orders of p = 7, by output, innovation length p and name."""
        return {
            o: {p: {n: float(c[-1]) for n, c in trace.coefficients.items()} for p, trace in each.items()}
            for o, each in self.weak_prior_traces.items()
        }

    def to_dict(self) -> dict[str, Any]:
        """Return the results of the joint as a dictionary for JSON."""
        derived = attributes(self.dropped_derivative_effect, ("output", "order", "correlations"))
        parts = {"models": json_value(self.candidates), "dropped_derivative_effect": derived}
        return parts | attributes(self, ("printed_orders", "weak_prior_coefficients", "optimizer_comparisons"))


def compare_optimizers(
    run: Run,
    single: Structure,
    order_grid: OrderGrid,
    optimizer: GeneticAlgorithm | None = None,
    *,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> OptimizerComparison:
    """Compare multi-innovation with a genetic algorithm and differential evolution.

    The models are not computed, so the field `models` of the result is empty.

    By default, each seed of an optimizer has as many evaluations as the order grid has candidates.

    Parameters
    ----------
    run
        Estimation run, which starts at rest.
    single
        Structure with one equation.
    order_grid
        Order grid of multi-innovation; its limits bound the orders of the optimizers.
    optimizer
        Settings of the genetic algorithm, whose order grid is replaced.
    threads, progress
        See :func:`ftlm.search_orders`.

    Raises
    ------
    ModelError
        If PyGAD or SciPy is not installed, or the run does not start at rest.
    """
    # Reference values of a structure would influence the bounds of the optimizers.
    single = replace(single, nominal_values={})
    work: dict[str, Any] = {"threads": threads, "progress": progress}
    searches = {k: printed.best_orders(run, single, order_grid, LAST_P, k, **work) for k in PRIOR_COVARIANCES}
    count = searches[PRIOR_COVARIANCES[0]].candidates
    settings = optimizer or GeneticAlgorithm(seeds=seeds_for(count), population=200, norm="l1")
    budget = settings.evaluations or max(count, 2 * settings.population)
    settings = replace(settings, order_grid=order_grid, evaluations=budget)
    records = prepare([run], single, None, power_of_two=True)
    optimizers = {
        "genetic": genetic_search(records, single, settings, **work),
        "differential evolution": differential_evolution_search(records, single, settings, **work),
    }
    return OptimizerComparison(count, order_grid.increment, settings.population, searches, optimizers)


@dataclass(frozen=True)
class Trial:
    """Errors of multi-innovation on one angle of one record with one prior covariance K0, for each innovation length p.

    Parameters
    ----------
    arm, seed, output, prior
        Name of the arm, seed of its noise, name of the angle, and K0.
    errors
        Sum of absolute simulation errors, eq. (45) of the paper, by p, each at the best orders for this p.
    convergence_steps
        Number of recursion steps, by p, until the error stays within 2 % above the final error of p = 1; infinite if it
        never does. All p have the best orders of p = 7.
    nr, manual
        Normalized residual NR, eq. (47) of the paper, of the model with p = 7, and of the integer-order model of the
        manufacturer's manual.
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
class OptimizerErrors:
    """Errors of multi-innovation, genetic algorithm and differential evolution on one angle, at equal evaluations.

    Errors are sums of absolute simulation errors, eq. (45) of the paper.

    Parameters
    ----------
    arm, output
        Name of the arm and of the angle.
    candidates, increment
        Number of candidates of the order grid, which is also the number of evaluations per seed, and its increment.
    order_grid
        Error of multi-innovation with innovation length 7, by prior covariance K0.
    optimizers
        Error by optimizer and seed.
    """

    arm: str
    output: str
    candidates: int
    increment: float
    order_grid: dict[float, float]
    optimizers: dict[str, dict[int, float]]

    @classmethod
    def of(cls, arm: str, output: str, result: OptimizerComparison) -> OptimizerErrors:
        """Return the errors of an optimizer comparison on one angle (`output`) of an arm."""
        grid = {k: search.score for k, search in result.order_grid.items()}
        errors = {name: run.errors for name, run in result.optimizers.items()}
        return cls(arm, output, result.candidates, result.increment, grid, errors)


@dataclass(frozen=True)
class OrderComparison:
    """Output-error fits of eqs. (14)-(15) of the paper to one run of a joint, with integer and with free orders.

    Parameters
    ----------
    arm, stage
        Name of the arm, and number of the joint.
    integer_nr, free_nr
        Normalized residual NR of the simulation, by angle, with integer and with free orders.
    orders
        (estimate, low, high) of every free order by name, with its 95 % interval.
    gains
        Fit with free orders minus fit with integer orders on the validation run, by angle [percentage points]. Angles
        without a finite gain are omitted.
    is_degenerate
        Whether one of the two fits has the verdict "do not use". The comparison is then meaningless.
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
        """Return the comparison of two models; raise ModelError if the model with free orders was not identified."""
        if free.result is None:
            raise ModelError("the model with free orders was not identified; its orders have no intervals")
        before, after = ({} if c.validation is None else c.validation.fit for c in (integer, free))
        gains = {o: after[o] - before[o] for o in after if math.isfinite(after[o] - before[o])}
        nr, free_nr = ({o: f.nr for o, f in c.estimation.output_error.items()} for c in (integer, free))
        orders = {n: (v, *free.result.intervals[n]) for n, v in free.result.orders.items()}
        return cls(arm, stage, nr, free_nr, orders, gains, not are_usable(integer, free))

    def improves(self, output: str) -> bool | None:
        """Whether free orders improve the fit of an angle on the validation run significantly; None if inconclusive."""
        if self.is_degenerate or output not in self.gains:
            return None
        intervals = {n: {self.arm: (low, high)} for n, (_, low, high) in self.orders.items()}
        return improves_prediction([self.gains[output]], intervals, {n: integer_order(n) for n in self.orders})

    @property
    def fractional_orders(self) -> list[str]:
        """Names of the orders whose 95 % interval excludes the integer order of the manufacturer's manual."""
        return [n for n, (_, low, high) in self.orders.items() if not low <= integer_order(n) <= high]

    @property
    def fractional_text(self) -> str:
        """Orders whose 95 % interval excludes the integer order, with their estimates, as text; "none" without one."""
        return ", ".join(f"{symbol(n)} {self.orders[n][0]:.3g}" for n in self.fractional_orders) or "none"

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as a dictionary for JSON."""
        names = ("arm", "stage", "integer_nr", "free_nr", "orders", "fractional_orders", "gains", "is_degenerate")
        return attributes(self, names) | {"improves": {n: self.improves(n) for n in self.free_nr}}


@dataclass(frozen=True)
class Cases:
    """All cases on which verdicts on claims are based: multi-innovation, other optimizers, integer and free orders."""

    trials: tuple[Trial, ...] = ()
    optimizer_errors: tuple[OptimizerErrors, ...] = ()
    order_comparisons: tuple[OrderComparison, ...] = ()

    def __add__(self, other: Cases) -> Cases:
        return Cases(*(getattr(self, each.name) + getattr(other, each.name) for each in fields(self)))


def convergence_step(trace: MultiInnovationTrace, end: float) -> float:
    """Return the first recursion step from which the error stays at most 2 % above `end`; infinite if it never does."""
    with np.errstate(invalid="ignore"):
        away = np.flatnonzero(~(trace.error <= (1.0 + CONVERGENCE_MARGIN) * end))
    if not away.size:
        return float(trace.step[0])
    return float(trace.step[away[-1] + 1]) if away[-1] + 1 < trace.step.size else math.inf


def euler_means(model: Model, run: Run, m: int) -> dict[str, Floats]:
    """Return block-pulse means (m,) of each output, simulated by explicit Euler as in the paper.

    All means of an output are infinite if one of its samples is not finite.
    """
    means = {}
    for name, samples in explicit_euler(model, run).items():
        with np.errstate(over="ignore", invalid="ignore"):
            means[name] = pulse_means(samples, m) if np.all(np.isfinite(samples)) else np.full(m, np.inf)
    return means


def trials_of(stage: StageNumber, square: Run, arm: str, seed: int, threads: int | None) -> list[Trial]:
    """Run multi-innovation on both angles of a joint for all innovation lengths p.

    Return one trial per angle and prior covariance K0. `square` is the estimation run with noise of this `seed`.
    """
    structure, grid = published_structure(stage), OrderGrid(increment=TRIAL_INCREMENT, alpha=GRID_ALPHA)
    run, trials = square.select(list(structure.signals)), []
    m = default_m([run], power_of_two=True)
    manual = euler_means(link_model(stage=stage, form="published", parameters="effective"), run, m)
    for output in structure.outputs:
        single, manual_nr = structure.equation(output), metrics(pulse_means(run[output], m), manual[output]).nr
        for prior in PRIOR_COVARIANCES:
            best = {p: printed.best_orders(run, single, grid, p, prior, threads=threads) for p in INNOVATION_LENGTHS}
            last = best[LAST_P].model
            traces = traces_of(run, single, dict.fromkeys(INNOVATION_LENGTHS, last), prior, TRACE_EVERY)
            end = float(traces[FIRST_P].error[-1])
            steps = {p: convergence_step(t, end) for p, t in traces.items()}
            nr = compare_means(last, run).output_error[output].nr
            errors = {p: search.score for p, search in best.items()}
            trials.append(Trial(arm, seed, output, prior, errors, steps, nr, manual_nr))
    return trials


def traces_of(
    run: Run, single: Structure, models: Mapping[int, Model], prior: float, every: int
) -> dict[int, MultiInnovationTrace]:
    """Return the convergence of multi-innovation for one equation, by innovation length p, at the orders of `models`.

    `prior` is the prior covariance, and `every` the number of recursion steps between two stored values.
    """
    options = {"prior_covariance": prior, "every": every, **printed.RECURSION_OPTIONS}
    traces = {}
    for p, model in models.items():
        structure = single.with_orders({n: model.orders[n] for n in single.order_names})
        traces[p] = multi_innovation_trace(run, structure, innovation_length=p, **options)
    return traces


def cases_of(stage: Stage, square: Run, arm: str, seed: int, threads: int | None) -> Cases:
    """Return the cases for verdicts from the results of one joint; trials are omitted for a run not from rest."""
    models = stage.candidates["integer, identified"], stage.candidates["output error"]
    trials = trials_of(stage.number, square, arm, seed, threads) if stage.traces else ()
    errors = (OptimizerErrors.of(arm, o, comparison) for o, comparison in stage.optimizer_comparisons.items())
    return Cases(tuple(trials), tuple(errors), (OrderComparison.of(arm, stage.number, *models),))


@dataclass(frozen=True)
class Preset:
    """Settings of all steps, which differ between the full reproduction and the short demonstration."""

    order_grid: OrderGrid
    top: int | None = None  # table rows of an order search with identification; None for no identification
    trace_every: int = TRACE_EVERY  # recursion steps between two points of a convergence curve
    comparison_increment: float | None = COMPARISON_INCREMENT  # minimum order increment; None: no comparison
    genetic: GeneticAlgorithm | None = None  # settings of the optimizer comparison; None for default settings
    threads: int | None = None

    @property
    def comparison_order_grid(self) -> OrderGrid | None:
        """Order grid of the optimizer comparison; None for no comparison."""
        if self.comparison_increment is None:
            return None
        return OrderGrid(increment=max(self.order_grid.increment, self.comparison_increment), alpha=COMPARISON_ALPHA)

    def seconds_of(self, step: str) -> float:
        """Return the expected processor time [s] of the step with this name, at the order increments of this preset."""
        return seconds_of(step, self.order_grid.increment, self.comparison_increment)


def simulated_cases(
    stage: StageNumber, arm: str, seeds: Sequence[int], noise: float, preset: Preset, progress: WorkerProgress
) -> Cases:
    """Return the cases for verdicts on one joint of one simulated arm, from one record per seed of the noise.

    Comparisons of optimizers and of orders use only the first record. They are omitted for the main arm, because
    :func:`cases_of` returns them.
    """
    cases = Cases()
    for seed in seeds:
        recording = partial(demo_run, noise=noise, seed=seed, parameters=ARM_VARIANTS[arm])
        square, sine = map(recording, ("square", "sine"))
        work = StageWork(stage, square, sine, preset, lambda _: None, progress, simulated=True)
        progress.begin(preset.seconds_of("trials"))
        cases += Cases(tuple(trials_of(stage, square, arm, seed, preset.threads)))
        if arm != MAIN_ARM and seed == seeds[0]:
            comparisons = work.compare_optimizers().items()
            progress.begin(preset.seconds_of("order comparison"))
            errors = tuple(OptimizerErrors.of(arm, o, comparison) for o, comparison in comparisons)
            cases += Cases((), errors, (work.compare_orders(arm),))
    return cases


@dataclass
class StageWork:
    """Computation of all results of one joint (stage) of the arm.

    `square` is the estimation run of both joints, and `sine` the validation run or None. `log` is called with a line of
    text at each step. If `simulated` is True, the runs are simulated from rest, so that initial conditions are known.
    `notes` collects texts on omitted or modified results.
    """

    number: StageNumber
    square: Run
    sine: Run | None
    preset: Preset
    log: Callable[[str], None]
    progress: WorkerProgress
    simulated: bool = False
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        measured, link = published_structure(self.number), partial(flexible_link, stage=self.number)
        own = list(measured.signals)
        self.estimation_run = self.square.select(own)
        self.validation_run = None if self.sine is None else self.sine.select(own)
        moving = not self.simulated and not starts_at_rest(self.estimation_run, measured)
        # With the ten powers of t of other initial terms, the few terms of an equation would be nearly dependent.
        initial: Initial = "rest" if self.simulated else "caputo" if moving else "auto"
        # Structures: uncoupled equations of the paper, the same under the paper's laws, and the simulated arm.
        self.measured = replace(measured, initial="caputo") if moving else measured
        self.published = replace(link(form="published", coupling="simulated"), initial=initial)
        self.coupled = replace(link(form="lagrange", coupling="simulated"), initial=initial)

    def begin(self, words: str, step: str) -> None:
        """Log the description `words` of the next step, and pass its expected processor time to `progress`."""
        self.log(f"stage {self.number}: {words}")
        self.progress.begin(self.preset.seconds_of(step))

    @property
    def execution_options(self) -> dict[str, Any]:
        """Number of threads and progress callback, as arguments of searches and fits."""
        return {"threads": self.preset.threads, "progress": self.progress}

    def compute_stage(self) -> Stage:
        """Compute all results of the paper's section 5 for the joint."""
        exact = self.manual()
        candidates = {"integer, Euler": self.euler_candidate(exact), "integer, exact": exact}
        whole = integer_orders(self.coupled)
        candidates["integer, identified"] = self.joint("integer, identified", whole, "integer orders", "integer orders")
        candidates |= self.searches()
        candidates["instrumental variables"] = self.instrumental(candidates["least squares"])
        joint = candidates["output error"] = self.joint("output error", self.coupled, "free orders")
        label = "published, output error"
        candidates[label] = self.joint(label, self.published, "free orders, (22)–(25)", "published", joint.model)
        self.begin("convergence", "traces")
        traces, weak_prior_traces = Traces(), Traces()
        if self.measured.initial == "rest":
            models = {p: candidates[f"p = {p}"].model for p in INNOVATION_LENGTHS}
            traces = self.traces(models)
            weak_prior_traces = self.traces(dict.fromkeys(models, models[LAST_P]), printed.WEAK_PRIOR)
        else:
            self.notes.append(page_text("moving_start", run=self.estimation_run.name))
        comparisons = self.compare_optimizers()
        derived = self.dropped_derivative(joint.model)
        self.begin("the landscape of its orders", "landscape")
        landscape = None
        if joint.result is not None and joint.result.joint is not None:
            landscape = output_error_landscape(joint.result)
        near = self.printed_orders()
        return Stage(self.number, candidates, traces, weak_prior_traces, comparisons, near, derived, landscape)

    def candidate(self, found: Model | Identification) -> Candidate:
        """Return a model with its errors on both runs; a coupled model is also simulated from the currents alone."""
        result = found if isinstance(found, Identification) else None
        # The error of the paper is a sum over its block pulses, so its value depends on their number.
        m = default_m([self.estimation_run], power_of_two=True)
        model = replace(found.model if isinstance(found, Identification) else found, m=m)
        runs = [run for run in (self.estimation_run, self.validation_run) if run is not None]
        estimation, *validation = (compare_means(model, run) for run in runs)
        alone = {}
        if len(model.equations) > 1:
            coupled = replace(model, structure=replace(model.structure, coupling="simulated"))
            alone = {run.name: compare_means(coupled, run).output_error for run in runs}
        return Candidate(model, estimation, next(iter(validation), None), alone, result)

    def identify_candidate(self, run: Run, structure: Structure, method: EstimationMethod = JOINT_METHOD) -> Candidate:
        """Identify a model from a run, by default by output error, and return it with its errors on both runs."""
        return self.candidate(identify(run, structure, method=method, **self.execution_options))

    def manual(self) -> Candidate:
        """Return the integer-order model of the manufacturer's manual, with its errors on both runs."""
        return self.candidate(link_model(stage=self.number, form="published", parameters="effective"))

    def euler_candidate(self, exact: Candidate) -> Candidate:
        """Return the candidate `exact` with the errors of simulations by explicit Euler, the method of the paper."""
        compared, alone = [], {}
        for run, by_pulses in ((self.estimation_run, exact.estimation), (self.validation_run, exact.validation)):
            if run is None or by_pulses is None:
                continue
            means = euler_means(exact.model, run, by_pulses.m)
            errors = alone[run.name] = {n: metrics(by_pulses.measured[n][0], mean) for n, mean in means.items()}
            simulated, parts = {n: [mean] for n, mean in means.items()}, [(run.name, by_pulses.equation_error, errors)]
            compared.append(replace(by_pulses, simulated=simulated, output_error=errors, per_run=parts, findings=()))
        estimation, *validation = compared
        return replace(exact, estimation=estimation, validation=next(iter(validation), None), input_driven=alone)

    def searches(self) -> dict[str, Candidate]:
        """Return the best models on the order grid, by label: multi-innovation with each p, and least squares.

        p is the innovation length.
        """
        shared = {"order_grid": self.preset.order_grid, "top": self.preset.top or 1, **printed.SEARCH_OPTIONS}
        recursion = {"prior_covariance": PRIOR_COVARIANCES[0], **printed.RECURSION_OPTIONS, **shared}
        methods: dict[str, OrderSearchMethod] = {
            f"p = {p}": MultiInnovation(innovation_length=p, **recursion) for p in INNOVATION_LENGTHS
        }
        methods["least squares"] = LeastSquares(**shared)
        candidates = {}
        for label, method in methods.items():
            self.begin(f"orders on the grid, {label}", "search")
            if self.preset.top is None:
                candidates[label] = self.search_candidate(label, method)
            else:
                candidates[label] = self.identify_candidate(self.estimation_run, self.measured, method)
        return candidates

    def search_candidate(self, label: str, method: OrderSearchMethod) -> Candidate:
        """Return the model with the best orders of each equation by a method, without standard errors."""
        orders: dict[str, float] = {}
        coefficients: dict[str, float] = {}
        for single in map(self.measured.equation, self.measured.outputs):
            best = self._best_orders(single, method)
            orders |= best.orders
            coefficients |= best.coefficients
        structure, run = self.measured.with_orders(orders).with_coefficients(coefficients), self.estimation_run
        about = {"origin": label, "run": run.name}
        return self.candidate(Model(structure, orders=orders, units=run.units, about=about))

    def printed_orders(self) -> Candidate:
        """Return the model with least-squares coefficients at the orders that the paper prints for p = 7."""
        axes = {n: [v] for n, v in printed.printed_numbers(self.number, LAST_P)[0].items()}
        grid = replace(self.preset.order_grid, orders=axes)
        return self.search_candidate("printed orders", LeastSquares(order_grid=grid, top=1, **printed.SEARCH_OPTIONS))

    def _best_orders(self, single: Structure, method: OrderSearchMethod) -> SearchResult:
        """Return the result of an order search of one equation, whose first row is the best candidate.

        With prior covariance 1 the simulated deflection is nearly zero. All candidates then have errors close to that
        of a zero output, so no candidate can be excluded by a bound on its error. The fine grid is therefore searched
        only around the best candidate of a coarser grid.
        """
        grid = restrict_order_grid(method.order_grid, single)

        def search(order_grid: OrderGrid, **changes: int) -> SearchResult:
            options = {**self.execution_options, **vars(method.settings()), **changes}
            return rank_orders(self.estimation_run, single, order_grid, **options)

        own_terms = sum(t.signal == single.outputs[0] for t in single.equations[0].terms)
        is_expensive = own_terms > 1 and isinstance(method, MultiInnovation)
        if not (is_expensive and grid.increment < COARSE_INCREMENT and not grid.orders):
            return search(grid)
        values, ends, radius = grid.values(single), [], 2 * COARSE_INCREMENT - 1e-9
        for row in search(replace(grid, increment=COARSE_INCREMENT), top=REFINED_CANDIDATES).table:
            near = {n: [v for v in values[n] if abs(v - at) < radius] for n, at in row.orders.items()}
            ends.append(search(replace(grid, orders=near)))
        return min(ends, key=attrgetter("score"))

    def instrumental(self, start: Candidate) -> Candidate:
        """Return the best model of an order search by instrumental variables around the orders of the model `start`."""
        self.begin("orders by instrumental variables", "instrumental")
        grid, axes = self.preset.order_grid, {}
        for name, value in start.model.orders.items():
            steps = 1 if name.startswith("alpha") else INSTRUMENTAL_RADIUS_STEPS
            near = printed.neighboring_values(value, grid.increment, steps)
            axes[name] = [v for v in near if 0 <= v <= grid.alpha[1]]
        method = InstrumentalVariables(order_grid=replace(grid, orders=axes), top=1, **printed.SEARCH_OPTIONS)
        return self.identify_candidate(self.estimation_run, self.measured, method)

    def joint(
        self, label: str, structure: Structure, what: str, step: str = "output error", near: Model | None = None
    ) -> Candidate:
        """Return a model of both equations fitted by output error from the current alone, with its errors on both runs.

        If no fit converges, a model with measured coupling is fitted, in which the measured other angle is an input of
        each equation, and a note is added. A long run is decimated first. `what` describes the step in the log, and
        `step` gives its expected time. `near` is a model by eqs. (14)-(15) of the paper whose parameters give the
        initial guess for eqs. (22)-(25).
        """
        self.begin(f"{what}, by output error", step)
        run = self.estimation_run
        if step == "integer orders" and run.length >= 2 * INTEGER_FIT_SAMPLES:
            run = decimate_run(run, run.length // INTEGER_FIT_SAMPLES)
        elif run.length > MAX_FULL_SAMPLES:
            every = -(-run.length // DECIMATED_SAMPLES)
            self.notes.append(page_text("decimated", run=run, every=every, step=every * run.step))
            run = decimate_run(run, every)
        try:
            return self.fit_jointly(run, structure, near)
        except ConvergenceError as error:
            self.notes.append(page_text("measured_coupling", stage=self.number, label=label, error=error))
        return self.fit_jointly(run, replace(structure, coupling="measured"), near)

    def fit_jointly(self, run: Run, structure: Structure, near: Model | None) -> Candidate:
        """Return a model of both equations fitted by output error to a run; `near` is as in `joint`."""
        if near is None:
            return self.identify_candidate(run, structure)
        # Only standard errors of the published form are used. From automatic initial guesses, rounding decides which
        # optimum is found. The parameters of (14)-(15) lead to the optimum whose residuals are the noise.
        guess = self.published_values(near)
        if self.simulated:
            task, threads = Task((run,), structure), check_threads(self.preset.threads)
            method: dict[str, Any] = {"loss": PUBLISHED_METHOD.loss, "intervals": PUBLISHED_METHOD.intervals}
            options = {"begin": guess, "single_start": True, **method}
            fit = estimate_output_error(task, None, threads, self.progress, **options)
            return self.candidate(assess_fit(fit))
        try:
            return self.identify_candidate(run, structure, replace(PUBLISHED_METHOD, start=guess))
        except ModelError:
            # The initial guess is outside the parameter bounds of (22)-(25).
            return self.identify_candidate(run, structure, PUBLISHED_METHOD)

    def compare_orders(self, arm: str) -> OrderComparison:
        """Fit the joint with integer and with free orders, and compare both fits on the validation run.

        The runs are simulated with the arm of this name. The estimation run is decimated for the fits. Raise
        ConvergenceError if no initial guess of one of the fits converges.
        """
        structure = flexible_link(stage=self.number, form="lagrange", coupling="simulated", parameters="effective")
        structure, candidates = replace(structure, initial="rest"), []
        for item in (integer_orders(structure), structure):
            # Coefficients of fits with integer orders may overflow on an arm with fractional orders.
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                candidates.append(self.identify_candidate(decimate_run(self.estimation_run, ROW_STRIDE), item))
        return OrderComparison.of(arm, self.number, *candidates)

    def traces(self, models: Mapping[int, Model], prior: float = PRIOR_COVARIANCES[0]) -> Traces:
        """Return the convergence of multi-innovation by output and innovation length p, at the orders of `models`."""
        run, every = self.estimation_run, self.preset.trace_every
        return {o: traces_of(run, self.measured.equation(o), models, prior, every) for o in self.measured.outputs}

    def compare_optimizers(self) -> dict[str, OptimizerComparison]:
        """Return comparisons of multi-innovation with other optimizers, by output.

        The result is empty if the preset omits the comparisons. It is also empty if a comparison is impossible; a note
        then states the reason.
        """
        run, grid, comparisons = self.estimation_run, self.preset.comparison_order_grid, {}
        if grid is None:
            return {}
        for output in self.measured.outputs:
            single = self.measured.equation(output)
            self.begin(f"the other optimizers on {output}", "optimizers")
            try:
                comparison = compare_optimizers(run, single, grid, self.preset.genetic, **self.execution_options)
            except ModelError as error:
                self.notes.append(page_text("comparison_omitted", reason=error))
                return {}
            searches = dict(zip(MULTI_INNOVATION_LABELS, comparison.order_grid.values(), strict=True))
            ends: dict[str, GeneticRun | SearchResult] = {**comparison.optimizers, **searches}
            models = {}
            for label, end in ends.items():
                structure = single.with_orders(end.orders).with_coefficients(end.coefficients)
                models[label] = self.candidate(Model(structure, orders=dict(end.orders)))
            comparisons[output] = replace(comparison, models=models)
        return comparisons

    def in_published_form(self, model: Model) -> Model:
        """Return the model by eqs. (22)-(25) of the paper that corresponds to a model by eqs. (14)-(15).

        Equations (22)-(25) drop a derivative.
        """
        h, d = self.number * 2 - 1, self.number * 2
        hub = {c: model.coefficients[f"{c}{h}"] for c in "abdg"}
        link = {"b": -hub["b"], "g": -hub["g"]} | {c: model.coefficients[f"{c}{d}"] - hub[c] for c in "ad"}
        highest = {e.output: e.order.constant for e in model.equations}
        other = link_model(
            stage=self.number,
            form="published",
            orders={**model.orders, f"alpha{d}": highest[self.measured.outputs[1]]},
            coefficients={f"{c}{k}": v for k, values in ((h, hub), (d, link)) for c, v in values.items()},
            coupling=model.structure.coupling,
        )
        return replace(other, m=model.m, structure=replace(other.structure, initial=model.structure.initial))

    def published_values(self, model: Model) -> dict[str, float]:
        """Return the free parameters of eqs. (22)-(25) of the paper, by name, from a model by its eqs. (14)-(15)."""
        other = self.in_published_form(model)
        values = {**other.orders, **other.coefficients}
        h, d = f"a{self.number * 2 - 1}", f"a{self.number * 2}"
        free = FreeProblem.of(replace(self.published, initial="rest")).names
        return {n: v for n, v in values.items() if n in free} | {f"r{self.number}": -values[d] / values[h]}

    def dropped_derivative(self, model: Model) -> DroppedDerivative:
        """Simulate the deflection by eqs. (14)-(15) and (22)-(25) of the paper, with the parameters of `model`."""
        run, output, other = self.estimation_run, self.measured.outputs[1], self.in_published_form(model)
        whole, published = (compare_means(m, run) for m in (model, other))
        drive = f"I{self.number}"
        current = pulse_means(run[drive], whole.m, hold=run.intersample[drive] == "zoh")
        order = order_law(self.number, "derived")["input"].at(other.orders)
        responses = whole.measured[output][0], published.simulated[output][0], whole.simulated[output][0]
        return DroppedDerivative(output, order, pulse_times(whole), current, *responses)
