"""Genetic algorithm (PyGAD) and differential evolution (SciPy) as baselines for comparison."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, get_args

import numpy as np
from numpy.typing import NDArray

from ftlm import _core
from ftlm.data.run import Run
from ftlm.errors import ModelError
from ftlm.estimation.fit import Fit, ProgressCallback, check_no_friction, make_model
from ftlm.estimation.model_checks import coefficient_law_findings
from ftlm.estimation.prior_knowledge import check_intervals
from ftlm.estimation.result import Task
from ftlm.findings import make_finding
from ftlm.kernels import block_pulse_kernel
from ftlm.order_search.options import Norm, OrderGrid, check_order_grid, check_order_grid_names
from ftlm.progress import Progress
from ftlm.simulation.discretization import Record, check_linear, order_grid_tuple, prepare
from ftlm.structure.equation import Equation
from ftlm.structure.order import Order
from ftlm.structure.structure import Structure
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import parameter, setting
from ftlm.utils.resources import optional_module
from ftlm.utils.validation import Floats, check_choice, check_threads, short_repr, whole_number

#: Increment to which orders are rounded, as in the tables of the paper. Candidates with equal orders share regressors.
ORDER_RESOLUTION = 0.001
#: Bounds of a coefficient with a nominal value: plus and minus this multiple of it.
NOMINAL_RANGE = 2.0
#: Bounds of any other coefficient: plus and minus this multiple of the value at which its term alone is as large as the
#: output.
SCALE_RANGE = 4.0
#: Fraction of the population that survives and mates.
PARENT_FRACTION = 0.25
#: Distribution indices of simulated binary crossover and of polynomial mutation, and the crossover probability: the
#: values of Deb and Agrawal (Complex Systems 1995).
CROSSOVER_DISTRIBUTION_INDEX, MUTATION_DISTRIBUTION_INDEX, CROSSOVER_PROBABILITY = 15.0, 20.0, 0.9
#: Maximum number of generations relative to the nominal number. More generations than nominal may be needed, because
#: copies of parents are not evaluated again.
MAX_GENERATION_FACTOR = 4
#: Maximum number of seeds of one fit.
MAX_SEEDS = 1000
#: Shortest and longest expected run time, relative to the extrapolation from the first generation. Simulations of most
#: later candidates stop early.
DURATION_FACTOR_RANGE = (0.1, 1.5)
#: Fitness of candidates that diverge or cannot become parents. PyGAD accepts finite numbers only.
INFEASIBLE_FITNESS = -1e300
#: Maximum ratio of the final errors of two seeds. Above it some seeds have missed the optimum.
MAX_SEED_ERROR_RATIO = 1.2
#: Maximum number of evaluations used without an explicit request: an order grid under an order law has millions.
MAX_DEFAULT_EVALUATIONS = 1_000_000


@dataclass(frozen=True)
class GeneticRun:
    """Result of the genetic algorithm or of differential evolution.

    ``orders`` and ``coefficients`` are those of the best candidate, by name, and ``bounds`` are those of the search, by
    name. ``errors`` and ``evaluations`` contain the lowest error and the number of evaluations of each seed.

    The error is the sum of absolute simulation errors, eq. (45) of the paper, or the RMSE, eq. (46), for the norm
    ``"l2"``. Under an order law it is the sum over outputs, each divided by the standard deviation of the output.
    """

    orders: dict[str, float]
    coefficients: dict[str, float]
    errors: dict[int, float]
    evaluations: dict[int, int]
    bounds: dict[str, tuple[float, float]]


@dataclass(frozen=True)
class _CandidateMap:
    """Linear map from genes to candidates of one equation: ``genes @ weights + constants``.

    A candidate is a row with alpha (the order of the equation), the orders and the coefficients of the terms.
    ``is_output_term`` is True for terms in the output of the equation, ``points`` computes the errors of candidates,
    and ``scale`` divides these errors.
    """

    points: _core.Points
    weights: Floats
    constants: Floats
    is_output_term: NDArray[np.bool_]
    scale: float

    def candidates(self, genes: Floats, *, repaired: bool) -> Floats:
        """Return one candidate per row of `genes`; `repaired` limits the orders of terms to that of the equation."""
        rows = genes @ self.weights + self.constants
        if repaired:
            highest = rows[:, :1] - np.where(self.is_output_term, ORDER_RESOLUTION, 0.0)
            n = self.is_output_term.size
            rows[:, 1 : 1 + n] = np.minimum(rows[:, 1 : 1 + n], highest)
        return rows


class GeneticProblem:
    """Genes of a structure, one per free order and coefficient, and the evaluation of candidates.

    Parameters
    ----------
    records, structure, settings
        See :func:`genetic_search`.
    threads
        Number of threads that simulate candidates.
    """

    def __init__(
        self,
        records: list[Record],
        structure: Structure,
        settings: GeneticAlgorithm,
        threads: int,
    ) -> None:
        values = (settings.order_grid or OrderGrid()).values(structure)
        self.order_names, self.coefficient_names = structure.order_names, structure.coefficient_names
        self.names = (*self.order_names, *self.coefficient_names)
        self.law = structure.has_order_law
        self.bounds: dict[str, tuple[float, float]] = {n: (v[0], v[-1]) for n, v in values.items()}
        self.bounds |= {n: default_bounds(n, records, structure, values) for n in self.coefficient_names}
        for name, pair in settings.bounds.items():
            if name not in self.names:
                raise ModelError(f"bounds of {name!r}: not a free parameter; free are {', '.join(self.names)}")
            self.bounds[name] = (float(pair[0]), float(pair[1]))
        self.rows = [self._candidate_map(e, records, settings.norm) for e in structure.equations]
        self.threads = threads
        self.size = self._candidates(structure, records, values)

    def _candidate_map(self, equation: Equation, records: list[Record], norm: str) -> _CandidateMap:
        signals, inputs = records[0].signals, list(records[0].inputs)
        n = len(equation.terms)
        weights, constants = np.zeros((len(self.names), 1 + 2 * n)), np.zeros(1 + 2 * n)

        def set_order(column: int, order: Order) -> None:
            constants[column] = order.constant
            for name, weight in order.weights:
                weights[self.names.index(name), column] = weight

        set_order(0, equation.order)
        for k, term in enumerate(equation.terms):
            set_order(1 + k, term.order)
            if isinstance(term.coefficient, str):
                weights[self.names.index(term.coefficient), 1 + n + k] = term.factor
            else:
                constants[1 + n + k] = term.factor * term.coefficient
        points = _core.Points(
            [r.core() for r in records],
            signals.index(equation.output),
            [signals.index(t.signal) for t in equation.terms],
            inputs,
            norm == "l2",
        )
        is_output_term = np.array([t.signal == equation.output for t in equation.terms])
        count = sum(r.m for r in records)
        deviation = math.sqrt(sum(float(np.var(r.of(equation.output)) * r.m) for r in records) / count)
        scale = 1.0 if not self.law else deviation * count if norm == "l1" else deviation
        return _CandidateMap(points, weights, constants, is_output_term, scale)

    def _candidates(self, structure: Structure, records: list[Record], values: Mapping[str, tuple[float, ...]]) -> int:
        """Return the number of candidates of the order grid; under an order law an upper bound of this number."""
        if self.law:
            return math.prod(len(v) for v in values.values())
        orders = order_grid_tuple(structure.equations[0], records[0].signals, values)
        return _core.order_grid_size(orders, list(records[0].inputs))

    def round_orders(self, genes: Floats) -> Floats:
        """Return genes whose orders are rounded to the resolution with which candidates are evaluated."""
        rounded = np.array(genes, dtype=np.float64)
        n = len(self.order_names)
        rounded[:, :n] = np.round(rounded[:, :n] / ORDER_RESOLUTION) * ORDER_RESOLUTION
        return rounded

    def errors(self, genes: Floats, limit: float) -> Floats:
        """Return the simulation error of the candidate in each row of genes; infinite if it exceeds the limit."""
        rounded, sums = self.round_orders(genes), np.zeros(genes.shape[0])
        for candidate_map in self.rows:
            rows = np.ascontiguousarray(candidate_map.candidates(rounded, repaired=not self.law))
            sums += candidate_map.points.scores(rows, limit * candidate_map.scale, self.threads) / candidate_map.scale
        return np.where(sums <= limit, sums, np.inf)

    def values_by_name(self, genes: Floats) -> tuple[dict[str, float], dict[str, float]]:
        """Return orders and coefficients of one row of genes, by name."""
        rounded = self.round_orders(genes[None, :])
        n = len(self.order_names)
        values = dict(zip(self.names, rounded[0].tolist(), strict=True))
        if not self.law:
            candidate_map = self.rows[0]
            row = candidate_map.candidates(rounded, repaired=True)[0]
            for column, value in enumerate(row[: 1 + candidate_map.is_output_term.size].tolist()):
                gene = np.flatnonzero(candidate_map.weights[:n, column])
                if gene.size:
                    values[self.names[int(gene[0])]] = value
        orders = {name: round(values[name], 9) for name in self.order_names}
        return orders, {name: values[name] for name in self.coefficient_names}


def default_bounds(
    name: str, records: Sequence[Record], structure: Structure, values: Mapping[str, tuple[float, ...]]
) -> tuple[float, float]:
    """Return the default bounds (low, high) of a coefficient; see :class:`GeneticAlgorithm`."""
    nominal = structure.nominal_values.get(name, 0.0)
    if nominal:
        return -NOMINAL_RANGE * abs(nominal), NOMINAL_RANGE * abs(nominal)
    midpoints = {n: 0.5 * (v[0] + v[-1]) for n, v in values.items()}
    equation, term = next((e, t) for e in structure.equations for t in e.terms if t.coefficient == name)
    eta = max(equation.order.at(midpoints) - term.order.at(midpoints), 0.0)
    largest = 0.0
    for record in records:
        kernel = block_pulse_kernel(eta, record.m, step=record.step)
        integral = _core.series_multiply(kernel, record.of(term.signal), record.m)
        norm = float(np.linalg.norm(integral))
        largest = max(largest, float(np.linalg.norm(record.of(equation.output))) / norm if norm else 0.0)
    limit = SCALE_RANGE * (largest or 1.0) / abs(term.factor)
    return -limit, limit


def load_pygad() -> Any:
    """Return the PyGAD module; raise ModelError if it is not installed."""
    return optional_module("pygad", "PyGAD", "'ftlm[genetic]'")


def load_differential_evolution() -> Any:
    """Return SciPy's `differential_evolution`; raise ModelError if SciPy is not installed."""
    return optional_module("scipy.optimize", "SciPy", "'ftlm[genetic]'").differential_evolution


def genetic_search(
    records: list[Record],
    structure: Structure,
    settings: GeneticAlgorithm,
    *,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> GeneticRun:
    """Minimize the simulation error over orders and coefficients of one equation or under an order law.

    The order grid of the settings bounds the orders, and its size is the default number of evaluations. `progress` is
    called with (evaluations done, total evaluations) over all seeds. The result does not depend on the number of
    threads.

    Raises
    ------
    ModelError
        If PyGAD is not installed, a record does not start at rest, a bound names no free parameter, or the order grid
        is so large that `evaluations` must be given.
    """
    pygad = load_pygad()
    if records[0].offset != "none":
        raise ModelError(
            f"the genetic baseline does not estimate an offset, and offset = {records[0].offset!r}; "
            f"use {parameter('method', 'output-error')}, or {parameter('offset', 'none')}"
        )
    if records[0].start != (False, []):
        raise ModelError(
            "the genetic baseline does not estimate initial terms and needs runs that start at rest; "
            f"slice the runs, or give the structure {parameter('initial', 'rest')}"
        )
    problem = GeneticProblem(records, structure, settings, check_threads(threads))
    evaluations = settings.evaluations or problem.size
    if settings.evaluations is None and evaluations > MAX_DEFAULT_EVALUATIONS:
        raise ModelError(
            f"the order grid has {evaluations} candidates, too many to evaluate one by one; give "
            "GeneticAlgorithm(evaluations=…)"
        )
    evaluations = max(evaluations, 2 * settings.population)
    total = evaluations * len(settings.seeds)
    if isinstance(progress, Progress):
        name = "the stage" if structure.has_order_law else structure.outputs[0]
        progress.announce(f"the genetic algorithm on {name}", *_seconds(problem, settings.population, total))
    results: dict[int, _ParentThreshold] = {}
    for number, seed in enumerate(settings.seeds):

        def report_evaluations(count: int, count_before: int = number * evaluations) -> None:
            if progress is not None:
                progress(min(count_before + count, total), total)

        results[int(seed)] = _evolve(pygad.GA, problem, settings.population, int(seed), evaluations, report_evaluations)
    best = min(results.values(), key=lambda end: end.best)
    if not math.isfinite(best.best):
        raise ModelError("no candidate of the genetic algorithm had a finite error; narrow its bounds")
    orders, coefficients = problem.values_by_name(best.genes)
    errors = {seed: end.best for seed, end in results.items()}
    return GeneticRun(orders, coefficients, errors, {s: end.count for s, end in results.items()}, problem.bounds)


def _seconds(problem: GeneticProblem, population: int, evaluations: int) -> tuple[float, float]:
    """Return the shortest and the longest expected run time [s], extrapolated from one random generation."""
    low, high = np.array([problem.bounds[n] for n in problem.names]).T
    genes = low + np.random.default_rng(0).random((population, low.size)) * (high - low)
    start_time = time.perf_counter()
    problem.errors(genes, math.inf)
    seconds_each = (time.perf_counter() - start_time) / population
    return DURATION_FACTOR_RANGE[0] * seconds_each * evaluations, DURATION_FACTOR_RANGE[1] * seconds_each * evaluations


def _evolve(
    algorithm: Any,
    problem: GeneticProblem,
    population: int,
    seed: int,
    evaluations: int,
    listener: Callable[[int], None],
) -> _ParentThreshold:
    """Run the genetic algorithm from one seed until its evaluations are used up.

    Genes are real numbers. The operators are simulated binary crossover, polynomial mutation and truncation selection.
    The simulation of a candidate stops once its partial error excludes it from the parents, which does not change the
    result.
    """
    parents = max(2, round(PARENT_FRACTION * population))
    threshold = _ParentThreshold(parents)
    bounds = [problem.bounds[n] for n in problem.names]
    low, high = np.array(bounds).T

    def check_budget(_: Any) -> str | None:
        return "stop" if threshold.count >= evaluations else None

    def crossover(parents: Any, shape: tuple[int, int], algorithm: Any) -> Floats:
        return simulated_binary_crossover(
            np.asarray(parents, dtype=np.float64), shape, algorithm.numpy_random_generator
        )

    def mutation(children: Any, algorithm: Any) -> Floats:
        return polynomial_mutation(np.asarray(children, dtype=np.float64), low, high, algorithm.numpy_random_generator)

    def fitness(_: Any, genes: Any, __: Any) -> list[float]:
        candidates = np.asarray(genes, dtype=np.float64)
        errors = problem.errors(candidates, threshold.limit)
        threshold.add_generation(errors, candidates)
        listener(threshold.count)
        return np.where(np.isfinite(errors), -errors, INFEASIBLE_FITNESS).tolist()  # type: ignore[no-any-return]

    algorithm(
        num_generations=MAX_GENERATION_FACTOR * math.ceil(evaluations / (population - parents)),
        on_generation=check_budget,
        num_parents_mating=parents,
        keep_elitism=parents,
        sol_per_pop=population,
        num_genes=len(bounds),
        fitness_func=fitness,
        fitness_batch_size=population,
        gene_space=[{"low": first, "high": stop} for first, stop in bounds],
        parent_selection_type="sss",
        crossover_type=crossover,
        mutation_type=mutation,
        random_seed=seed,
        suppress_warnings=True,
        save_best_solutions=False,
    ).run()
    return threshold


def simulated_binary_crossover(parents: Floats, shape: tuple[int, int], random: Any) -> Floats:
    """Return children by simulated binary crossover (Deb and Agrawal, Complex Systems 9, 1995)."""
    pairs = (shape[0] + 1) // 2
    mothers, fathers = (parents[random.randint(0, parents.shape[0], pairs)] for _ in range(2))
    u = random.random_sample(mothers.shape)
    with np.errstate(divide="ignore"):
        factor = np.where(u <= 0.5, 2.0 * u, 0.5 / (1.0 - u)) ** (1.0 / (CROSSOVER_DISTRIBUTION_INDEX + 1.0))
    is_crossed = (random.random_sample(mothers.shape) < 0.5) & (
        random.random_sample((pairs, 1)) < CROSSOVER_PROBABILITY
    )
    factor = np.where(is_crossed, factor, 1.0)
    means, half_differences = 0.5 * (mothers + fathers), 0.5 * (mothers - fathers)
    return np.concatenate([means + factor * half_differences, means - factor * half_differences])[: shape[0]]


def polynomial_mutation(children: Floats, low: Floats, high: Floats, random: Any) -> Floats:
    """Return children after polynomial mutation of one gene per child on average (Deb and Goyal 1996)."""
    u = random.random_sample(children.shape)
    power = 1.0 / (MUTATION_DISTRIBUTION_INDEX + 1.0)
    change = np.where(u < 0.5, (2.0 * u) ** power - 1.0, 1.0 - (2.0 * (1.0 - u)) ** power)
    is_mutated = random.random_sample(children.shape) < 1.0 / children.shape[1]
    return np.clip(children + np.where(is_mutated, change * (high - low), 0.0), low, high)


class _ParentThreshold:
    """Largest error with which a candidate can become a parent of the next generation.

    The smallest errors of all generations up to now are stored, as many as there are parents. ``genes`` and ``best``
    are the best candidate and its error, and ``count`` is the number of evaluations.
    """

    def __init__(self, parents: int) -> None:
        self._errors = np.full(parents, np.inf)
        self.genes = np.zeros(0)
        self.best = math.inf
        self.count = 0

    @property
    def limit(self) -> float:
        """Largest error among the current parents."""
        return float(self._errors[-1])

    def add_generation(self, errors: Floats, genes: Floats) -> None:
        """Add the errors and genes of one generation, which has one row of genes per error."""
        self.count += errors.size
        best_index = int(np.argmin(errors))
        if errors[best_index] < self.best:
            self.best, self.genes = float(errors[best_index]), genes[best_index].copy()
        self._errors = np.sort(np.concatenate([self._errors, errors]))[: self._errors.size]


#: Candidates of one generation for each gene: the default of SciPy.
CANDIDATES_PER_GENE = 15
#: Logarithm that replaces an error that is not finite; larger than that of any finite error.
MAX_LOG_ERROR = 1e3


def differential_evolution_search(
    records: list[Record],
    structure: Structure,
    settings: GeneticAlgorithm,
    *,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> GeneticRun:
    """Minimize the simulation error by differential evolution, with the options of the genetic baseline.

    Seeds, evaluations and bounds come from `settings`. Other options are defaults of SciPy (best1bin, 15 candidates per
    gene), without the final local search. The number of evaluations is rounded up to whole generations.

    Raises
    ------
    ModelError
        If SciPy is not installed, a record does not start at rest, or no candidate has a finite error.
    """
    differential_evolution = load_differential_evolution()
    if records[0].start != (False, []) or records[0].offset != "none":
        raise ModelError(
            "differential evolution estimates no initial terms and no offset; cut the runs so that they start at rest"
        )
    problem = GeneticProblem(records, structure, settings, check_threads(threads))
    evaluation_count = settings.evaluations or problem.size
    bounds = [problem.bounds[n] for n in problem.names]
    generation = CANDIDATES_PER_GENE * sum(low < high for low, high in bounds)
    generations = max(0, math.ceil(evaluation_count / generation) - 1)
    total, count = (generations + 1) * generation * len(settings.seeds), 0

    def errors(columns: Floats) -> Floats:
        nonlocal count
        rows = np.ascontiguousarray(columns.T if columns.ndim == 2 else columns[None, :])
        count += rows.shape[0]
        if progress is not None:
            progress(min(count, total), total)
        # Differential evolution only compares errors. With logarithms, the spread of the errors stays finite.
        with np.errstate(divide="ignore"):
            return np.clip(np.log(problem.errors(rows, math.inf)), -MAX_LOG_ERROR, MAX_LOG_ERROR)

    results: dict[int, Any] = {}
    for seed in settings.seeds:
        results[int(seed)] = differential_evolution(
            errors,
            bounds,
            maxiter=generations,
            popsize=CANDIDATES_PER_GENE,
            tol=0.0,
            polish=False,
            updating="deferred",
            vectorized=True,
            rng=np.random.default_rng(int(seed)),
        )
    best = min(results.values(), key=lambda end: float(end.fun))
    if best.fun >= MAX_LOG_ERROR:
        raise ModelError("no candidate of differential evolution had a finite error; narrow its bounds")
    orders, coefficients = problem.values_by_name(np.asarray(best.x, dtype=np.float64))
    final_errors = {seed: math.exp(end.fun) if end.fun < MAX_LOG_ERROR else math.inf for seed, end in results.items()}
    # SciPy counts calls, each of which evaluates one generation.
    evaluations = {seed: int(end.nfev) * generation for seed, end in results.items()}
    return GeneticRun(orders, coefficients, final_errors, evaluations, problem.bounds)


@check_arguments
@dataclass(frozen=True, kw_only=True)
class GeneticAlgorithm:
    """Genetic algorithm that minimizes the simulation error: the baseline of the paper, for comparison only.

    Orders and coefficients are searched together. The method requires PyGAD (``pip install 'ftlm[genetic]'``).

    Parameters
    ----------
    order_grid
        Grid whose limits bound the orders and whose size is the default of `evaluations`; see :func:`ftlm.order_grid`.
    norm
        Simulation error to minimize. ``"l1"``: sum of absolute errors, eq. (45) of the paper. ``"l2"``: root mean
        square, eq. (46) of the paper.
    seeds
        Seeds of the random numbers. The algorithm runs once per seed, and the best run gives the result. The result
        states the errors of all runs.
    evaluations
        Evaluations per seed, rounded up to a whole generation; by default as many as the order grid has candidates.
    population
        Number of candidates of one generation, at least 8.
    bounds
        (low, high) of coefficients by name. By default ±2 times the nominal value in the structure. Without a nominal
        value, ±4 times the coefficient at which the term alone would be as large as the output, at the midpoints of the
        order intervals.

    Raises
    ------
    ModelError
        If there are no seeds or too many, `population` is outside [8, 100000], `evaluations` are fewer than two
        generations, a bound is not an interval, or the order grid or norm is invalid.
    """

    name: ClassVar[str] = "genetic"
    order_grid: OrderGrid | None = None
    norm: Norm = "l1"
    seeds: Sequence[int] = (0, 1, 2)
    evaluations: int | None = None
    population: int = 200
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_order_grid(self.order_grid)
        check_choice("norm", self.norm, get_args(Norm))
        population = whole_number(self.population)
        if population is None or not 8 <= population <= 100_000:
            raise ModelError(
                f"{setting('population')} {self.population!r} is out of range; give an integer from 8 to 100000"
            )
        if self.evaluations is not None and (whole_number(self.evaluations) or 0) < 2 * self.population:
            raise ModelError(
                f"{setting('evaluations')} {self.evaluations!r} is less than two generations of {self.population}; "
                "give more"
            )
        seed_values = self.seeds if isinstance(self.seeds, Iterable) and not isinstance(self.seeds, str) else [None]
        seeds = [whole_number(s) for s in itertools.islice(seed_values, MAX_SEEDS + 1)]
        if not 0 < len(seeds) <= MAX_SEEDS or any(s is None or not 0 <= s < 1 << 32 for s in seeds):
            raise ModelError(
                f"{setting('seeds')} {short_repr(self.seeds)}: give 1 to {MAX_SEEDS} whole numbers from 0 to 4294967295"
            )
        check_intervals(self.bounds, finite=True)

    def fit(
        self,
        runs: Sequence[Run],
        structure: Structure,
        *,
        m: int | None = None,
        threads: int | None = None,
        progress: ProgressCallback = None,
    ) -> Fit:
        """Estimate orders and coefficients, one equation at a time or jointly; see :func:`ftlm.identify`."""
        check_no_friction(structure, self.name)
        check_linear(structure.equations, "the genetic baseline")
        check_order_grid_names(self.order_grid, structure)
        task = Task(tuple(runs), structure, self.order_grid)
        groups = (
            {"stage": structure} if structure.has_order_law else {o: structure.equation(o) for o in structure.outputs}
        )
        free = {name: (*group.order_names, *group.coefficient_names) for name, group in groups.items()}
        names = [n for group_names in free.values() for n in group_names]
        unknown = [n for n in self.bounds if n not in names]
        if unknown:
            raise ModelError(f"bounds of {unknown[0]!r}: not a free parameter; free are {', '.join(names)}")
        record = prepare(task.runs, structure, m, power_of_two=True)[0]
        results = {}
        for name, group in groups.items():
            bounded = {n: b for n, b in self.bounds.items() if n in free[name]}
            group_names = replace(self, order_grid=task.part_order_grid(group), bounds=bounded)
            records = prepare(task.runs, group, record.m, power_of_two=True)
            results[name] = genetic_search(records, group, group_names, threads=threads, progress=progress)
        orders = {n: v for result in results.values() for n, v in result.orders.items()}
        coefficients = {n: v for result in results.values() for n, v in result.coefficients.items()}
        bounds = {n: b for result in results.values() for n, b in result.bounds.items()}
        seeds, identified = list(self.seeds), structure.with_orders(orders).with_coefficients(coefficients)
        model = make_model(task, self.name, identified, orders, record.m, seeds=str(seeds))
        findings = coefficient_law_findings(model)
        for name, (low, high) in bounds.items():
            value = {**orders, **coefficients}[name]
            if min(value - low, high - value) < 1e-3 * (high - low) and value not in (0.0, 2.0):
                findings.append(make_finding("genetic_on_bound", parameter=name, value=value))
        for name, result in results.items():
            low, high = min(result.errors.values()), max(result.errors.values())
            if high > MAX_SEED_ERROR_RATIO * low:
                findings.append(make_finding("seeds_disagree", output=name, low=low, high=high))
        options = {
            "method": self.name,
            "norm": self.norm,
            "m": record.m,
            "initial": "rest",
            "seeds": seeds,
            "population": self.population,
            "bounds": {n: list(b) for n, b in bounds.items()},
            "errors": {name: {str(seed): e for seed, e in result.errors.items()} for name, result in results.items()},
            "evaluations": {name: sum(result.evaluations.values()) for name, result in results.items()},
        }
        return Fit(task, self.name, model, len(orders) + len(coefficients), options, findings, at_optimum=False)
