"""Results of one joint (stage) of the arm: models by every method of the paper's section 5, and cases for verdicts.

A case is the outcome of one test of a claim of the paper, on one simulated or measured record. In this module, p is the
innovation length and K0 the prior covariance of multi-innovation. Equation numbers are those of the paper.
"""

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

#: Number of recursion steps between two points of a convergence curve; p has an effect only in the first steps.
TRACE_EVERY = 2
#: Labels of multi-innovation in the optimizer comparison, for the prior covariances K0 = 1 and 1e10.
MULTI_INNOVATION_LABELS = ("p = 7", "p = 7, weak prior")
#: Interval of alpha in the paper's order grid, and in the optimizer comparison. The latter contains the orders printed
#: for both methods, and is so short that all candidates can be evaluated.
GRID_ALPHA, RIVAL_ALPHA = (1.05, 2.0), (1.95, 2.0)
#: An error has converged once it stays below the final error of p = 1 times 1 plus this margin.
CONVERGENCE_MARGIN = 0.02
#: Decimation factor of joint fits: 8 ms on the virtual rig, a fifteenth of the period of the fastest link mode.
ROW_STRIDE = 4
#: Method of joint fits (of both equations of a joint): output error with squared residuals and white noise.
JOINT_METHOD = OutputError(loss="squares", intervals="auto", noise="white")
#: Increment of the order grids with which claims on the innovation length are tested (:class:`Trial`).
PANEL_STEP = 0.25
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


def published_structure(stage: StageNumber, **changes: Any) -> Structure:
    """Return the structure of a joint by eqs. (22)-(25) of the paper, uncoupled and from rest; `changes` set fields."""
    structure = flexible_link(
        stage=stage, form="published", coupling="measured", laws=(), parameters="effective", offset="none"
    )
    return replace(structure, **{"initial": "rest", **changes})


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
    label
        Label in tables, such as "p = 7" for multi-innovation with innovation length 7.
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

    label: str
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
class Rival:
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
    traces, weak_traces
        Convergence of the multi-innovation recursion by output and innovation length p. `traces` have K0 = 1 and the
        best orders of each p. `weak_traces` have a weak prior and the orders of p = 7. Empty for a run that does not
        start at rest.
    rivals
        Optimizer comparisons by output; empty without PyGAD or SciPy, or for a run that does not start at rest.
    printed_orders
        Model with the orders printed in the paper and least-squares coefficients on the estimation run.
    derived
        Simulations of the deflection with and without the derivative of the current that the paper drops.
    landscape
        Output-error cost around the optimum, as a function of the two most correlated orders; None if there are no two
        orders with a finite standard error.
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
        """Names of the hub angle and of the link deflection of this joint."""
        return f"theta{self.number}1", f"theta{self.number}2"

    @property
    def weak(self) -> dict[str, dict[int, dict[str, float]]]:
        """Final coefficients with a weak prior at the orders of p = 7, by output, innovation length p and name."""
        return {
            o: {p: {n: float(c[-1]) for n, c in trace.coefficients.items()} for p, trace in each.items()}
            for o, each in self.weak_traces.items()
        }

    def to_dict(self) -> dict[str, Any]:
        """Return the results of the joint as a dictionary for JSON."""
        return {
            "models": json_value(self.candidates),
            "derived input order": attributes(self.derived, ("output", "order", "correlations")),
        } | attributes(self, ("printed_orders", "weak", "rivals"))


def rivals_order_grid(increment: float, smallest: float = CONTEST_STEP) -> OrderGrid:
    """Return the order grid of the optimizer comparison, whose increment is at least `smallest`."""
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
    without_reference = replace(single, reference={})
    work: dict[str, Any] = {"threads": threads, "progress": progress}
    searches = {
        k: best_orders(run, without_reference, order_grid, INNOVATION_LENGTHS[-1], k, **work) for k in PRIOR_COVARIANCES
    }
    count = searches[PRIOR_COVARIANCES[0]].candidates
    settings = optimizer or GeneticAlgorithm(seeds=seeds_for(count))
    budget = settings.evaluations or max(count, 2 * settings.population)
    settings = replace(settings, order_grid=order_grid, evaluations=budget)
    records = prepare([run], without_reference, None, power_of_two=True)
    optimizers = {
        "genetic": genetic_search(records, without_reference, settings, **work),
        "differential evolution": differential_evolution_search(records, without_reference, settings, **work),
    }
    return Rival(count, order_grid.increment, settings.population, searches, optimizers)


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
    def of(cls, arm: str, output: str, result: Rival) -> OptimizerErrors:
        """Return the errors of an optimizer comparison on one angle (`output`) of an arm."""
        grid = {k: search.score for k, search in result.order_grid.items()}
        return cls(
            arm, output, result.candidates, result.increment, grid, {n: r.errors for n, r in result.optimizers.items()}
        )


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
        before, after = ({} if c.validation is None else c.validation.fit for c in (integer, free))
        gains = {o: after[o] - before[o] for o in after if math.isfinite(after[o] - before[o])}
        nr, free_nr = ({o: f.nr for o, f in c.estimation.output_error.items()} for c in (integer, free))
        if free.result is None:
            raise ModelError(f"model {free.label} was not identified; its orders have no intervals")
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
class Panel:
    """All cases on which verdicts on claims are based: multi-innovation, other optimizers, integer and free orders."""

    trials: tuple[Trial, ...] = ()
    contests: tuple[OptimizerErrors, ...] = ()
    order_comparisons: tuple[OrderComparison, ...] = ()

    @classmethod
    def union(cls, parts: Sequence[Panel]) -> Panel:
        """Return a panel with all cases of the given panels, in sequence."""
        return cls(*(tuple(c for part in parts for c in getattr(part, each.name)) for each in fields(cls)))


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
    """Return the convergence of multi-innovation for one equation, by innovation length p, at the orders of `models`.

    `prior` is the prior covariance, and `every` the number of recursion steps between two stored values.
    """
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
    """Fit a joint of a simulated arm with integer and with free orders, and compare both fits on a validation run.

    The estimation run `square` starts at rest and is decimated for the fits.

    Raises
    ------
    ConvergenceError
        If no initial guess of one of the fits converges.
    """
    structure = replace(flexible_link(stage=stage, form="lagrange", coupling="simulated"), initial="rest")
    own, other = (run.select(list(structure.signals)) for run in (square, validation))
    run = decimate_run(own, ROW_STRIDE)
    # Coefficients of fits with integer orders may overflow on an arm with fractional orders.
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
    """Return the cases for verdicts from the results of one joint; trials are omitted for a run not from rest."""
    freed = OrderComparison.of(
        arm, stage.number, stage.candidates["integer, identified"], stage.candidates["output error"]
    )
    trials = trials_of(stage.number, square, arm, seed, threads) if stage.traces else ()
    return Panel(tuple(trials), tuple(OptimizerErrors.of(arm, o, r) for o, r in stage.rivals.items()), (freed,))


@dataclass(frozen=True)
class Preset:
    """Settings in which the full reproduction and the short demonstration differ."""

    order_grid: OrderGrid
    top: int | None  # rows of each order search, followed by an identification's statistics; None for a search alone
    trace_every: int  # recursion steps between two points of a convergence curve
    # Increment of the order grid of the optimizer comparison; None for no comparison.
    rivals_increment: float | None = CONTEST_STEP

    def seconds_of(self, step: str) -> float:
        """Return the expected processor time [s] of the step with this name, at the order increments of this preset."""
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
    """Return the cases for verdicts on one joint of one simulated arm, from one record per seed of the noise.

    Comparisons of optimizers and of orders use only the first record. They are omitted for the main arm, because
    :func:`panel_of` returns them.
    """
    trials: list[Trial] = []
    contests: list[OptimizerErrors] = []
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
                comparison = compare_optimizers(own, single, grid, genetic, threads=threads, progress=steps)
                contests.append(OptimizerErrors.of(arm, output, comparison))
        begin("freed")
        freed.append(compare_orders(stage, run, arm, threads, steps, validation=validation))
    return Panel(tuple(trials), tuple(contests), tuple(freed))


@dataclass
class StageWork:
    """Computation of all results of one joint (stage) of the arm.

    `square` is the estimation run and `sine` the validation run, or None. `log` is called with a line of text at each
    step. `notes` collect texts on omitted or modified results.
    """

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
        # Structures: uncoupled equations of the paper, the same under the paper's laws, and the simulated arm.
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
            # With the ten powers of t of other initial terms, the few terms of an equation would be nearly dependent.
            self.measured, self.published, self.coupled = (
                replace(s, initial="caputo") for s in (self.measured, self.published, self.coupled)
            )

    def begin(self, words: str, step: str) -> None:
        """Log the description `words` of the next step, and pass its expected processor time to `progress`."""
        self.log(f"stage {self.number}: {words}")
        if isinstance(self.progress, WorkerProgress):
            self.progress.begin(self.preset.seconds_of(step))

    def compute_stage(self, genetic: GeneticAlgorithm | None) -> Stage:
        """Compute all results of the paper's section 5 for the joint; `genetic` is None for default settings."""
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
        """Return a model with its errors on both runs; a coupled model is also simulated from the currents alone."""
        # The error of the paper is a sum over its block pulses, so its value depends on their number.
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
        """Identify a model from a run, by default by output error, and return it with its errors on both runs."""
        result = identify(run, structure, method=method, threads=self.threads, progress=self.progress)
        return self.candidate(label, result.model, result)

    def manual(self, label: str) -> Candidate:
        """Return the integer-order model of the manufacturer's manual, with its errors on both runs."""
        return self.candidate(label, link_model(stage=self.number, form="published"))

    def euler_candidate(self, label: str, exact: Candidate) -> Candidate:
        """Return the candidate `exact` with the errors of simulations by explicit Euler, the method of the paper."""

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
        """Return the best models on the order grid, by label: multi-innovation with each p, and least squares.

        p is the innovation length.
        """
        kinds: dict[str, tuple[str, dict[str, Any]]] = {
            f"p = {p}": ("multi-innovation", {"innovation_length": p, "prior_covariance": PRIOR_COVARIANCES[0]})
            for p in INNOVATION_LENGTHS
        }
        candidates, grid = {}, self.preset.order_grid
        for label, (coefficients, options) in (kinds | {"least squares": ("least-squares", {})}).items():
            self.begin(f"orders on the grid, {label}", "search")
            if self.preset.top is None:
                candidates[label] = self.search_candidate(label, grid, coefficients=coefficients, **options)
            else:
                method = method_with_options(coefficients, {"order_grid": grid, "top": self.preset.top, **options})
                candidates[label] = self.identify_candidate(label, self.on, self.measured, method)
        return candidates

    def search_candidate(self, label: str, order_grid: OrderGrid, **options: Any) -> Candidate:
        """Return the model with the best orders of each equation on an order grid, without standard errors.

        `options` are options of the order search.
        """
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
        """Return the model with least-squares coefficients at the orders that the paper prints for p = 7."""
        axes = {n: [v] for output in self.measured.outputs for n, v in last_orders(output).items()}
        grid = replace(self.preset.order_grid, orders=axes)
        return self.search_candidate("printed orders", grid, coefficients="least-squares")

    def _best_orders(self, single: Structure, own: OrderGrid, options: Mapping[str, Any]) -> SearchResult:
        """Return the result of an order search of one equation, whose first row is the best candidate.

        With prior covariance 1 the simulated deflection is nearly zero. All candidates then have errors close to that
        of a zero output, so no candidate can be excluded by a bound on its error. The fine grid is therefore searched
        only around the best candidate of a coarser grid.
        """
        work: dict[str, Any] = {"threads": self.threads, "progress": self.progress, **options}
        own_terms = sum(t.signal == single.outputs[0] for t in single.equations[0].terms)
        is_expensive = own_terms > 1 and options.get("coefficients") == "multi-innovation"
        if not (is_expensive and own.increment < COARSE_INCREMENT and not own.orders):
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
        """Return the best model of an order search by instrumental variables around the orders of the model `start`."""
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
        """Return a model of both equations fitted by output error, with its errors on both runs.

        A long run is decimated first. `words` describe the step in the log, and `step` gives its expected time. `near`
        is a model by eqs. (14)-(15) of the paper whose parameters give the initial guess for eqs. (22)-(25).
        """
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
        # Only standard errors of the published form are used. From automatic initial guesses, rounding decides which
        # optimum is found. The parameters of (14)-(15) lead to the optimum whose residuals are the noise.
        begin = self.published_values(near)
        if not self.simulated:
            try:
                return self.identify_candidate(label, run, structure, OutputError(intervals="quadratic", start=begin))
            except ModelError:
                # The initial guess is outside the parameter bounds of (22)-(25).
                return self.identify_candidate(label, run, structure, OutputError(intervals="quadratic"))
        task, options = Task((run,), structure), (None, check_threads(self.threads), self.progress)
        result = assess_fit(estimate_output_error(task, *options, intervals="quadratic", begin=begin, alone=True))
        return self.candidate(label, result.model, result)

    def best(
        self, label: str, structure: Structure, what: str, step: str = "output error", near: Model | None = None
    ) -> Candidate:
        """Return a model of both equations fitted by output error from the current alone; arguments as in `joint`.

        If no fit converges, a model with measured coupling is fitted, in which the measured other angle is an input of
        each equation, and a note is added.
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
        """Return the convergence of multi-innovation by output and innovation length p, at the orders of `models`."""
        parts = {o: self.measured.equation(o) for o in self.measured.outputs}
        return {o: traces_of(self.on, each, models, prior, self.preset.trace_every) for o, each in parts.items()}

    def rivals(self, genetic: GeneticAlgorithm | None) -> dict[str, Rival]:
        """Return comparisons of multi-innovation with other optimizers, by output.

        The result is empty if the preset omits the comparisons. It is also empty if a comparison is impossible; a note
        then states the reason.
        """
        if self.preset.rivals_increment is None:
            return {}
        grid = rivals_order_grid(self.preset.order_grid.increment, self.preset.rivals_increment)
        rivals = {}
        for output in self.measured.outputs:
            single = self.measured.equation(output)
            self.begin(f"the rivals on {output}", "rivals")
            try:
                comparison = compare_optimizers(
                    self.on, single, grid, genetic, threads=self.threads, progress=self.progress
                )
            except ModelError as error:
                self.notes.append(page_text("rivals_omitted", reason=error))
                return {}
            best = dict(zip(MULTI_INNOVATION_LABELS, comparison.order_grid.values(), strict=True))
            ends: list[tuple[str, GeneticRun | SearchResult]] = [*comparison.optimizers.items(), *best.items()]
            models = {
                name: Model(single.with_orders(end.orders).with_coefficients(end.coefficients), orders=dict(end.orders))
                for name, end in ends
            }
            rivals[output] = replace(comparison, models={n: self.candidate(n, model) for n, model in models.items()})
        return rivals

    def in_published_form(self, model: Model) -> Model:
        """Return the model by eqs. (22)-(25) of the paper that corresponds to a model by eqs. (14)-(15).

        Equations (22)-(25) drop a derivative.
        """
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
        """Return the free parameters of eqs. (22)-(25) of the paper, by name, from a model by its eqs. (14)-(15)."""
        other = self.in_published_form(model)
        values = {**other.orders, **other.coefficients}
        h, d = f"a{self.number * 2 - 1}", f"a{self.number * 2}"
        free = FreeProblem.of(replace(self.published, initial="rest")).names
        return {n: v for n, v in values.items() if n in free} | {f"r{self.number}": -values[d] / values[h]}

    def dropped_derivative(self, model: Model) -> DroppedDerivative:
        """Simulate the deflection by eqs. (14)-(15) and (22)-(25) of the paper, with the parameters of `model`."""
        output, other = self.measured.outputs[1], self.in_published_form(model)
        whole, published = (compare_means(m, self.on) for m in (model, other))
        drive = f"I{self.number}"
        current = pulse_means(self.on[drive], whole.m, hold=self.on.intersample[drive] == "zoh")
        order = order_law(self.number, "derived")["input"].at(other.orders)
        responses = whole.measured[output][0], published.simulated[output][0], whole.simulated[output][0]
        return DroppedDerivative(output, order, pulse_times(whole), current, *responses)
