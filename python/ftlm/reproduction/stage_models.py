"""Models of one stage, by every method of section 5, and the progress of the work."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from ftlm.arm.flexible_link import Law, flexible_link, link_model, order_law
from ftlm.data.run import Run
from ftlm.errors import ConvergenceError, ModelError
from ftlm.estimation.cost_surface import output_error_landscape
from ftlm.estimation.estimators import estimate_output_error
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.genetic import GeneticAlgorithm, GeneticRun
from ftlm.estimation.identify import assess_fit, identify
from ftlm.estimation.linear import MultiInnovationTrace
from ftlm.estimation.methods import EstimationMethod, InstrumentalVariables, OutputError, method_with_options
from ftlm.estimation.result import Identification, Task
from ftlm.kernels import pulse_means
from ftlm.model.model import Model
from ftlm.order_search.result import SearchResult
from ftlm.order_search.search import rank_orders
from ftlm.plot.comparison_charts import pulse_times
from ftlm.progress import ShareTracker, Stoppable
from ftlm.reproduction import published_values as printed
from ftlm.reproduction.simulated_arm import StageNumber, decimate_run
from ftlm.reproduction.stage_result import (
    CONTEST_STEP,
    JOINT_METHOD,
    MULTI_INNOVATION_LABELS,
    PRIOR_COVARIANCES,
    SEARCH_OPTIONS,
    WEAK_PRIOR,
    Candidate,
    DroppedDerivative,
    Rival,
    Stage,
    compare_optimizers,
    euler_means,
    integer_orders,
    neighboring_values,
    published_structure,
    rivals_order_grid,
    seeds_for,
    traces_of,
)
from ftlm.simulation.discretization import default_m, prepare
from ftlm.simulation.initial_conditions import starts_at_rest
from ftlm.simulation.simulate import explicit_euler
from ftlm.structure.order_grid import OrderGrid
from ftlm.structure.structure import Structure
from ftlm.utils.validation import check_threads
from ftlm.validation.comparison import Comparison, compare_means, metrics

#: Steps of the work: processor time on one core of the reference machine [s], executions for a stage of the estimation
#: run, and for a stage of another arm. Searches are those of the paper's increment, optimizers those of theirs. Times
#: are three quarters of the measured ones, which included other load.
STEP_COSTS: Mapping[str, tuple[float, int, int]] = {
    "whole orders": (1.5, 1, 0),
    "search": (1.4, 5, 0),
    "instrumental": (2.0, 1, 0),
    "output error": (5.8, 1, 0),
    "published": (1.5, 1, 0),
    "traces": (0.8, 1, 0),
    "rivals": (5.2, 2, 2),
    "equation": (0.1, 1, 0),
    "landscape": (2.4, 1, 0),
    "printed": (0.4, 1, 0),
    "trials": (2.0, 1, 0),
    "freed": (4.0, 0, 1),
}
#: Candidates of the optimizer comparison at its default increment.
CONTEST_CANDIDATES = 3800
#: Radius [increments] of the search by instrumental variables around the orders of least squares; every candidate needs
#: several simulations.
INSTRUMENTAL_RADIUS_STEPS = 2
#: Runs with more samples than the first number are decimated to at most the second for joint fits, whose cost grows
#: with the samples. The arm's modes are two decades below the reduced rate.
MOST_ROWS, JOINT_ROWS = 6000, 2500
#: Increment of a first search on finer grids, among orders of multi-innovation that no bound excludes, and number of
#: the best candidates around which the grid's own increment follows.
COARSE_INCREMENT, REFINED_CANDIDATES = 0.1, 10
#: Samples of fits with integer orders, whose systematic residuals do not shrink with more samples.
WHOLE_ROWS = 1250
#: Note on a reproduction without the optimizer comparison, with a placeholder for the reason.
RIVALS_OMITTED = "Tables 6 and 7 and Figure 11 are left out: {}"


def seconds_of(step: str, increment: float, rivals_increment: float | None = CONTEST_STEP) -> float:
    """Processor time of a step [s]; searches grow with the inverse fourth power of the increment."""
    scale = 1.0
    if step == "search":
        scale = (0.05 / increment) ** 4
    elif step == "rivals":
        candidates = 0
        if rivals_increment is not None:
            candidates = round(CONTEST_CANDIDATES * (CONTEST_STEP / max(increment, rivals_increment)) ** 4)
        scale = candidates * len(seeds_for(candidates)) / (CONTEST_CANDIDATES * len(seeds_for(CONTEST_CANDIDATES)))
    return STEP_COSTS[step][0] * scale


def seconds_of_all(
    increment: float, stages: int, arms: int = 0, records: int = 1, *, rivals_increment: float | None = CONTEST_STEP
) -> float:
    """Processor time of the whole reproduction [s]."""
    counts = {step: own + arms * other for step, (_, own, other) in STEP_COSTS.items()}
    counts["trials"] += (arms + 1) * records - 1
    return stages * sum(count * seconds_of(step, increment, rivals_increment) for step, count in counts.items())


class TotalProgress:
    """Share of all completed work, reported by several workers to one receiver.

    Parameters
    ----------
    seconds
        Processor time of all work.
    told
        See :class:`ftlm.progress.ShareTracker`.
    """

    def __init__(self, seconds: float, told: Callable[[int, int], None] | None) -> None:
        self._seconds, self._course, self._lock = max(seconds, 1e-9), ShareTracker(told), threading.Lock()
        self._done: dict[object, float] = {}

    def report(self, worker: object, seconds: float) -> None:
        """Report the processor time of all work that a worker has done [s]."""
        with self._lock:
            self._done[worker] = seconds
            self._course.advance_to(sum(self._done.values()) / self._seconds)

    def end(self) -> None:
        """Report that all work is finished, including skipped steps."""
        self._course.advance_to(1.0)


class WorkerProgress(Stoppable):
    """Progress of one worker through its steps; searches and fits call it with (done, total).

    Parameters
    ----------
    whole
        Progress of all work.
    stop
        Event that ends the work with KeyboardInterrupt at its next report.
    """

    def __init__(self, whole: TotalProgress, stop: threading.Event) -> None:
        super().__init__(None, stop)
        self._whole, self._before, self._step, self._within = whole, 0.0, 0.0, 0.0

    def begin(self, seconds: float) -> None:
        """Finish the previous step, and start one with this processor time."""
        super().__call__(0, 0)
        self._before, self._step, self._within = self._before + self._step, seconds, 0.0
        self._whole.report(self, self._before)

    def __call__(self, done: int, total: int, pruned: int | None = None) -> None:
        """Report progress within the step; a restarted count continues at half of the remainder."""
        super().__call__(done, total, pruned)
        share = done / max(total, 1)
        if share < self._within:
            self._step *= 0.5
            self._before += self._step
        self._within = share
        self._whole.report(self, self._before + self._step * share)


@dataclass(frozen=True)
class Preset:
    """Settings that differ between the reproduction and the demonstration."""

    order_grid: OrderGrid
    top: int  # rows of an order search
    trace_every: int  # steps between two points of a convergence curve
    # Whether all models are compared on the paper's pulses (a sum over other pulses is another number) and from the
    # currents alone as well, or each with the pulses of its method.
    common_pulses: bool
    # Of the order grid of the optimizer comparison; None without PyGAD or SciPy.
    rivals_increment: float | None = CONTEST_STEP


@dataclass
class StageWork:
    """Computation of one stage: runs, settings, progress receivers, and notes about omitted parts."""

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
        """Announce the next step and its share of the whole."""
        self.log(f"stage {self.number}: {words}")
        if isinstance(self.progress, WorkerProgress):
            self.progress.begin(seconds_of(step, self.preset.order_grid.increment, self.preset.rivals_increment))

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
        if prepare([self.on], self.measured, None, power_of_two=True)[0].initial == "rest":
            models = {p: candidates[f"p = {p}"].model for p in printed.INNOVATION_LENGTHS}
            traces = self.traces(models)
            weak = self.traces(dict.fromkeys(models, models[printed.INNOVATION_LENGTHS[-1]]), WEAK_PRIOR)
        else:
            self.notes.append(
                f"run {self.on.name} does not start at rest: every model is fitted and compared with initial terms; "
                "explicit Euler, which steps from rest as in the paper, is not, and its errors hold that; convergence "
                "of the recursion, and with it Figures 4(b) to 8(b), and the weak prior are left out"
            )
        rivals = self.rivals(genetic)
        axes = {n: [v] for output in self.measured.outputs for n, v in printed.last_orders(output).items()}
        near = self.search_candidate(
            "printed orders", replace(self.preset.order_grid, orders=axes), coefficients="least-squares"
        )
        self.begin("orders by the equation error", "equation")
        options = {"coefficients": "least-squares", "criterion": "equation-error", "norm": "l2"}
        by_equation = self.search_candidate("smallest equation error", self.preset.order_grid, **options)
        derived = self.dropped_derivative(joint.model)
        self.begin("the landscape of its orders", "landscape")
        landscape = None
        if joint.result is not None and joint.result.joint is not None:
            landscape = output_error_landscape(joint.result)
        return Stage(self.number, candidates, traces, weak, rivals, near, by_equation, derived, landscape)

    def candidate(self, label: str, model: Model, result: Identification | None = None) -> Candidate:
        """Return a model with both errors on both runs, and its simulation from the currents alone."""
        alike = self.preset.common_pulses
        m = default_m([self.on], power_of_two=True) if alike else model.m
        model = model if model.m == m else replace(model, m=m)
        runs = [run for run in (self.on, self.off) if run is not None]
        on, *off = (compare_means(model, run) for run in runs)
        alone = {}
        if alike and len(model.equations) > 1:
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

        def by_euler(run: Run, known: Comparison) -> Comparison:
            means = euler_means(exact.model, run, known.m)
            if self.preset.common_pulses:
                errors = {n: metrics(known.measured[n][0], mean) for n, mean in means.items()}
            else:
                errors = {n: metrics(run[n], samples) for n, samples in explicit_euler(exact.model, run).items()}
            simulated, parts = {n: [mean] for n, mean in means.items()}, [(run.name, known.equation_error, errors)]
            return replace(known, simulated=simulated, output_error=errors, per_run=parts, findings=())

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
            for p in printed.INNOVATION_LENGTHS
        }
        found, grid = {}, self.preset.order_grid
        for label, (coefficients, options) in (kinds | {"least squares": ("least-squares", {})}).items():
            self.begin(f"orders on the lattice, {label}", "search")
            if self.preset.common_pulses:
                found[label] = self.search_candidate(label, grid, coefficients=coefficients, **options)
            else:
                method = method_with_options(coefficients, {"order_grid": grid, "top": self.preset.top, **options})
                found[label] = self.identify_candidate(label, self.on, self.measured, method)
        return found

    def search_candidate(self, label: str, order_grid: OrderGrid, **options: Any) -> Candidate:
        """Return the best orders of each equation by itself, without the statistics of an identification."""
        orders: dict[str, float] = {}
        coefficients: dict[str, float] = {}
        for output in self.measured.outputs:
            single = self.measured.equation(output)
            own = replace(order_grid, orders={n: v for n, v in order_grid.orders.items() if n in single.order_names})
            best = self._best_orders(single, own, {**SEARCH_OPTIONS, **options})
            orders |= best.orders
            coefficients |= best.coefficients
        known = self.measured.with_orders(orders).with_coefficients(coefficients)
        units = {n: u for n, u in self.on.units.items() if n in known.signals}
        about = {"origin": label, "run": self.on.name}
        return self.candidate(label, Model(known, orders=orders, units=units, about=about))

    def _best_orders(self, single: Structure, own: OrderGrid, options: Mapping[str, Any]) -> SearchResult:
        """Return the best candidate of an order grid.

        With K0 = 1 a deflection hardly moves. The errors of all candidates are close to those of a zero output, so no
        bound excludes any, and each would have to be simulated completely.
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
        """Search by instrumental variables on the part of the grid around the orders of another model."""
        self.begin("orders by instrumental variables", "instrumental")
        grid = self.preset.order_grid
        axes = {}
        for name, value in start.model.orders.items():
            steps = 1 if name.startswith("alpha") else INSTRUMENTAL_RADIUS_STEPS
            axes[name] = [v for v in neighboring_values(value, grid.increment, steps) if 0 <= v <= grid.alpha[1]]
        method = InstrumentalVariables(order_grid=replace(grid, orders=axes), top=self.preset.top)
        return self.identify_candidate("instrumental variables", self.on, self.measured, method)

    def joint(
        self, label: str, structure: Structure, words: str, step: str = "output error", near: Model | None = None
    ) -> Candidate:
        """Fit by joint output error, to the whole run or to a decimated one."""
        self.begin(words, step)
        run = self.on
        if step == "whole orders" and run.length >= 2 * WHOLE_ROWS:
            run = decimate_run(run, run.length // WHOLE_ROWS)
        elif run.length > MOST_ROWS:
            every = -(-run.length // JOINT_ROWS)
            self.notes.append(
                f"run {run.name} has {run.length} rows: joint fits by output error take one of {every} rows, "
                f"{every * run.step:.6g} s apart, with the means of held currents in between; all models are compared "
                "on the same block pulses of the whole run"
            )
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
        """Fit by joint output error from the current alone, or with the measured other angle if that fails."""
        words = f"{what}, by output error"
        try:
            return self.joint(label, structure, words, step, near)
        except ConvergenceError as error:
            self.notes.append(
                f"stage {self.number}, {label}: from the current alone, {error}; that row is driven by the measured "
                "other angle instead"
            )
        return self.joint(label, replace(structure, coupling="measured"), words, step, near)

    def traces(
        self, models: Mapping[int, Model], prior: float = PRIOR_COVARIANCES[0]
    ) -> dict[str, dict[int, MultiInnovationTrace]]:
        """Convergence of every equation with every p, at the orders of the model of that p."""
        parts = {o: self.measured.equation(o) for o in self.measured.outputs}
        return {o: traces_of(self.on, each, models, prior, self.preset.trace_every) for o, each in parts.items()}

    def rivals(self, genetic: GeneticAlgorithm | None) -> dict[str, Rival]:
        """Compare multi-innovation with other optimizers on each equation; empty if these are not installed."""
        if self.preset.rivals_increment is None:
            return {}
        grid = rivals_order_grid(self.preset.order_grid.increment, self.preset.rivals_increment)
        found = {}
        for output in self.measured.outputs:
            single = self.measured.equation(output)
            self.begin(f"the rivals on {output}", "rivals")
            try:
                made = compare_optimizers(self.on, single, grid, genetic, threads=self.threads, progress=self.progress)
            except ModelError as error:
                self.notes.append(RIVALS_OMITTED.format(error))
                return {}
            best = dict(zip(MULTI_INNOVATION_LABELS, made.order_grid.values(), strict=True))
            ends: list[tuple[str, GeneticRun | SearchResult]] = [*made.optimizers.items(), *best.items()]
            models = {
                name: Model(single.with_orders(end.orders).with_coefficients(end.coefficients), orders=dict(end.orders))
                for name, end in ends
            }
            found[output] = replace(made, models={n: self.candidate(n, model) for n, model in models.items()})
        return found

    def in_published_form(self, model: Model) -> Model:
        """Insert the parameters of (14)-(15) into (22)-(25), which drop a derivative of the current."""
        h, d = self.number * 2 - 1, self.number * 2
        known = {n: model.coefficients[n] for n in (f"{c}{k}" for c in "ad" for k in (h, d))}
        known |= {n: model.coefficients[n] for n in (f"b{h}", f"g{h}")}
        known |= {f"{c}{d}": -known[f"{c}{h}"] for c in "bg"}
        known |= {f"{c}{d}": known[f"{c}{d}"] - known[f"{c}{h}"] for c in "ad"}
        highest = {e.output: e.order.constant for e in model.equations}
        other = link_model(
            stage=self.number,
            form="published",
            orders={**model.orders, f"alpha{d}": highest[self.measured.outputs[1]]},
            coefficients=known,
            coupling=model.structure.coupling,
        )
        return replace(other, m=model.m, structure=replace(other.structure, initial=model.structure.initial))

    def published_values(self, model: Model) -> dict[str, float]:
        """Values of the free parameters of (22)-(25) under their laws for a model of (14)-(15)."""
        other = self.in_published_form(model)
        known = {**other.orders, **other.coefficients}
        h, d = f"a{self.number * 2 - 1}", f"a{self.number * 2}"
        free = FreeProblem.of(replace(self.published, initial="rest")).names
        return {n: v for n, v in known.items() if n in free} | {f"r{self.number}": -known[d] / known[h]}

    def dropped_derivative(self, model: Model) -> DroppedDerivative:
        """Compare the deflection by (14)-(15) with that by (22)-(25) at equal parameters."""
        output, other = self.measured.outputs[1], self.in_published_form(model)
        whole, published = (compare_means(m, self.on) for m in (model, other))
        drive = f"I{self.number}"
        current = pulse_means(self.on[drive], whole.m, hold=self.on.intersample[drive] == "zoh")
        order = order_law(self.number, "derived")["input"].at(other.orders)
        responses = whole.measured[output][0], published.simulated[output][0], whole.simulated[output][0]
        return DroppedDerivative(output, order, pulse_times(whole), current, *responses)
