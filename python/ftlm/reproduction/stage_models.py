"""Progress of the reproduction: processor time of its steps and completed share."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ftlm.arm.flexible_link import flexible_link, integer_order, link_model, order_law
from ftlm.data.run import Run
from ftlm.errors import ConvergenceError, ModelError
from ftlm.estimation.cost_surface import output_error_landscape
from ftlm.estimation.estimators import estimate_output_error
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.genetic import GeneticAlgorithm, GeneticRun
from ftlm.estimation.identify import assess_fit, identify
from ftlm.estimation.linear import MultiInnovationTrace, multi_innovation_trace
from ftlm.estimation.methods import EstimationMethod, InstrumentalVariables, OutputError, method_with_options
from ftlm.estimation.result import Identification, Task
from ftlm.kernels import pulse_means
from ftlm.model.model import Model
from ftlm.order_search.result import SearchResult
from ftlm.order_search.search import rank_orders
from ftlm.plot.comparison_charts import pulse_times
from ftlm.progress import ShareTracker, Stoppable
from ftlm.reproduction import published_values as printed
from ftlm.reproduction.optimizer_comparison import CONTEST_STEP, compare_optimizers, rivals_order_grid, seeds_for
from ftlm.reproduction.simulated_arm import StageNumber, decimate_run
from ftlm.reproduction.stage_result import (
    MULTI_INNOVATION_LABELS,
    PRIOR_COVARIANCES,
    WEAK_PRIOR,
    Candidate,
    DroppedDerivative,
    Rival,
    Stage,
)
from ftlm.simulation.discretization import default_m, prepare
from ftlm.simulation.initial_conditions import starts_at_rest
from ftlm.simulation.simulate import explicit_euler
from ftlm.structure.order_grid import OrderGrid
from ftlm.structure.structure import Structure
from ftlm.svg.heat_map import Landscape
from ftlm.utils.validation import check_threads
from ftlm.validation.comparison import Comparison, compare_means, metrics

#: Processor time of each step of a stage on one core of the reference machine of base/pace.py [s]: searches with the
#: paper's increment, optimizers with theirs, fits on the virtual rig's 5000 samples. These are three quarters of the
#: measured times, which included other load.
STEP_DURATIONS_S: Mapping[str, float] = {
    "whole orders": 1.5,
    "search": 1.4,
    "instrumental": 2.0,
    "output error": 5.8,
    "published": 1.5,
    "traces": 0.8,
    "rivals": 5.2,
    "equation": 0.1,
    "landscape": 2.4,
    "printed": 0.4,
    "trials": 2.0,
    "freed": 4.0,
}


#: Candidates of the optimizer comparison at its default increment.
CONTEST_CANDIDATES = 3800
#: Number of executions of each step, for a stage of the estimation run and for a stage of another arm.
STEPS_PER_STAGE = {
    "whole orders": 1,
    "search": 5,
    "instrumental": 1,
    "output error": 1,
    "published": 1,
    "traces": 1,
    "rivals": 2,
    "equation": 1,
    "landscape": 1,
    "printed": 1,
    "trials": 1,
}
STEPS_PER_ARM = {"trials": 0, "rivals": 2, "freed": 1}


def seconds_of(increment: str, lattice_step: float, rivals_increment: float | None = CONTEST_STEP) -> float:
    """Processor time of a step [s]; searches grow with the inverse fourth power of the increment."""
    if increment == "rivals":
        if rivals_increment is None:
            return 0.0
        candidates = round(CONTEST_CANDIDATES * (CONTEST_STEP / max(lattice_step, rivals_increment)) ** 4)
        evaluations = candidates * len(seeds_for(candidates))
        return STEP_DURATIONS_S[increment] * evaluations / (CONTEST_CANDIDATES * len(seeds_for(CONTEST_CANDIDATES)))
    return STEP_DURATIONS_S[increment] * float((0.05 / lattice_step) ** 4 if increment == "search" else 1.0)


def seconds_of_all(
    lattice_step: float, stages: int, arms: int = 0, records: int = 1, *, rivals_increment: float | None = CONTEST_STEP
) -> float:
    """Processor time of the whole reproduction [s]."""
    counts = dict(STEPS_PER_STAGE)
    for step, count in STEPS_PER_ARM.items():
        counts[step] = counts.get(step, 0) + arms * count
    counts["trials"] += (arms + 1) * records - 1
    return stages * sum(count * seconds_of(step, lattice_step, rivals_increment) for step, count in counts.items())


class TotalProgress:
    """Share of all completed work, reported by several workers to one receiver.

    Parameters
    ----------
    seconds
        Processor time of all work.
    told
        See :class:`ftlm.progress.Course`.
    """

    def __init__(self, seconds: float, told: Callable[[int, int], None] | None) -> None:
        self._seconds, self._course, self._lock = max(seconds, 1e-9), ShareTracker(told), threading.Lock()
        self._done = 0.0
        self._under_way: dict[object, float] = {}

    def report_step(self, worker: object, seconds: float) -> None:
        """Report the progress of a worker within its step."""
        with self._lock:
            self._under_way[worker] = seconds
            self._course.advance_to((self._done + sum(self._under_way.values())) / self._seconds)

    def finish_step(self, worker: object, seconds: float) -> None:
        """Report that a worker has finished a step."""
        with self._lock:
            self._under_way.pop(worker, None)
            self._done += seconds
            self._course.advance_to((self._done + sum(self._under_way.values())) / self._seconds)

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
        self._whole, self._step, self._within = whole, 0.0, 0.0

    def begin(self, seconds: float) -> None:
        """Finish the previous step, and start one with this processor time."""
        super().__call__(0, 0)
        self._whole.finish_step(self, self._step)
        self._step, self._within = seconds, 0.0

    def __call__(self, done: int, total: int, pruned: int | None = None) -> None:
        """Report progress within the step; a restarted count continues at half of the remainder."""
        super().__call__(done, total, pruned)
        share = done / max(total, 1)
        if share < self._within:
            self._step, passed = 0.5 * self._step, 0.5 * self._step
            self._whole.finish_step(self, passed)
        self._within = share
        self._whole.report_step(self, self._step * share)


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


@dataclass(frozen=True)
class Preset:
    """Settings that differ between the reproduction and the demonstration."""

    order_grid: OrderGrid
    top: int  # rows of an order search
    trace_every: int  # steps between two points of a convergence curve
    # Whether all models are judged alike, on the paper's pulses (a sum over other pulses is another number) and from
    # the currents alone as well, or each as its method worked.
    common_pulses: bool
    # Of the order grid of the optimizer comparison; None without PyGAD or SciPy.
    rivals_increment: float | None = CONTEST_STEP


#: Note on a reproduction without the optimizer comparison, with a placeholder for the reason.
RIVALS_OMITTED = "Tables 6 and 7 and Figure 11 are left out: {}"


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
        # Structures of the paper and of the simulated arm.
        self.measured = flexible_link(stage=self.number, form="published", coupling="measured", laws=())
        self.published = flexible_link(stage=self.number, form="published")
        self.coupled = flexible_link(stage=self.number, coupling="simulated")
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
        self.log(words)
        if isinstance(self.progress, WorkerProgress):
            self.progress.begin(seconds_of(step, self.preset.order_grid.increment, self.preset.rivals_increment))

    def compute_stage(self, genetic: GeneticAlgorithm | None) -> Stage:
        """Compute all results of section 5 for a stage."""
        exact = self.manual("integer, exact")
        candidates = {"integer, Euler": self.euler_candidate("integer, Euler", exact), "integer, exact": exact}
        candidates["integer, identified"] = self.best(
            "integer, identified",
            self.coupled.with_orders({n: integer_order(n) for n in self.coupled.order_names}),
            "whole orders",
            WHOLE_ROWS,
        )
        candidates |= self.searches()
        candidates["instrumental variables"] = self.instrumental(candidates["least squares"])
        candidates["output error"] = self.best("output error", self.coupled)
        candidates["published, output error"] = self.best(
            "published, output error", self.published, near=candidates["output error"].model
        )
        self.begin(f"stage {self.number}: convergence", "traces")
        traces: dict[str, dict[int, MultiInnovationTrace]] = {}
        weak: dict[str, dict[int, MultiInnovationTrace]] = {}
        if prepare([self.on], self.measured, None, power_of_two=True)[0].initial == "rest":
            traces = self.traces(candidates)
            # All p at the orders of the largest.
            last = candidates[f"p = {printed.INNOVATION_LENGTHS[-1]}"]
            weak = self.traces(dict.fromkeys(candidates, last), WEAK_PRIOR)
        else:
            self.notes.append(
                f"run {self.on.name} does not start at rest: every model is fitted and compared with initial terms; "
                "explicit Euler, which steps from rest as in the paper, is not, and its errors hold that; convergence "
                "of the recursion, and with it Figures 4(b) to 8(b), and the weak prior are left out"
            )
        ends = {
            o: {p: {n: float(c[-1]) for n, c in trace.coefficients.items()} for p, trace in each.items()}
            for o, each in weak.items()
        }
        return Stage(
            self.number,
            candidates,
            traces,
            weak,
            ends,
            self.rivals(genetic),
            self.printed_order_candidate(),
            self.by_equation(),
            self.dropped_derivative(candidates["output error"].model),
            self.landscape(candidates["output error"].result),
        )

    def landscape(self, result: Identification | None) -> Landscape | None:
        """Cost surface around the joint fit over its two most correlated orders."""
        self.begin(f"stage {self.number}: the landscape of its orders", "landscape")
        return None if result is None or result.fit is None else output_error_landscape(result)

    def candidate(self, label: str, model: Model, result: Identification | None = None) -> Candidate:
        """Return a model with both errors on both runs, and its simulation from the currents alone."""
        alike = self.preset.common_pulses
        m = default_m([self.on], power_of_two=True) if alike else model.m
        model = model if model.m == m else replace(model, m=m)
        estimation = compare_means(model, self.on)
        validation = None if self.off is None else compare_means(model, self.off)
        alone = {}
        if alike and len(model.equations) > 1:
            coupled = replace(model, structure=replace(model.structure, coupling="simulated"))
            runs = [run for run in (self.on, self.off) if run is not None]
            alone = {run.name: compare_means(coupled, run).output_error for run in runs}
        return Candidate(label, model, estimation, validation, alone, result)

    def identify_candidate(
        self, label: str, run: Run, structure: Structure, method: str | EstimationMethod = "output-error"
    ) -> Candidate:
        """Identify a candidate by one of the methods."""
        result = identify(run, structure, method=method, threads=self.threads, progress=self.progress)
        return self.candidate(label, result.model, result)

    def manual(self, label: str) -> Candidate:
        """Return the maker's integer-order model."""
        return self.candidate(label, link_model(stage=self.number, form="published"))

    def euler_candidate(self, label: str, exact: Candidate) -> Candidate:
        """Return the same model simulated by explicit Euler, as in the paper."""
        on = self._by_euler(exact.model, self.on, exact.estimation)
        alone = {self.on.name: on.output_error}
        off = None
        if self.off is not None and exact.validation is not None:
            off = self._by_euler(exact.model, self.off, exact.validation)
            alone[self.off.name] = off.output_error
        return replace(exact, label=label, estimation=on, validation=off, input_driven=alone)

    def _by_euler(self, model: Model, run: Run, exact: Comparison) -> Comparison:
        """Return the comparison with Euler's response in place of the exact one."""
        responses = explicit_euler(model, run)
        means = {}
        for name, samples in responses.items():
            with np.errstate(over="ignore", invalid="ignore"):
                finite = bool(np.all(np.isfinite(samples)))
            means[name] = pulse_means(samples, exact.m) if finite else np.full(exact.m, np.inf)
        if self.preset.common_pulses:
            errors = {n: metrics(exact.measured[n][0], mean) for n, mean in means.items()}
        else:
            errors = {n: metrics(run[n], samples) for n, samples in responses.items()}
        return replace(
            exact,
            simulated={n: [mean] for n, mean in means.items()},
            output_error=errors,
            per_run=[(run.name, exact.equation_error, errors)],
            findings=(),
        )

    def searches(self) -> dict[str, Candidate]:
        """Search the whole order grid by multi-innovation with the paper's p, and by least squares."""
        kinds: dict[str, dict[str, Any]] = {
            f"p = {p}": {
                "coefficients": "multi-innovation",
                "innovation_length": p,
                "prior_covariance": PRIOR_COVARIANCES[0],
            }
            for p in printed.INNOVATION_LENGTHS
        }
        kinds["least squares"] = {"coefficients": "least-squares"}
        found = {}
        for label, options in kinds.items():
            self.begin(f"stage {self.number}: orders on the lattice, {label}", "search")
            if self.preset.common_pulses:
                found[label] = self.search_candidate(label, self.preset.order_grid, **options)
                continue
            own = {n: v for n, v in options.items() if n != "coefficients"}
            method = method_with_options(
                options["coefficients"], {"order_grid": self.preset.order_grid, "top": self.preset.top, **own}
            )
            found[label] = self.identify_candidate(label, self.on, self.measured, method)
        return found

    def search_candidate(self, label: str, order_grid: OrderGrid, **options: Any) -> Candidate:
        """Return the best orders of each equation by itself, without the statistics of an identification."""
        orders: dict[str, float] = {}
        coefficients: dict[str, float] = {}
        for output in self.measured.outputs:
            single = self.measured.equation(output)
            own = replace(order_grid, orders={n: v for n, v in order_grid.orders.items() if n in single.order_names})
            best = self._best_orders(single, own, options)
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

        def run_search(order_grid: OrderGrid, top: int) -> SearchResult:
            return rank_orders(
                self.on, single, order_grid, top=top, threads=self.threads, progress=self.progress, **options
            )

        own_terms = sum(t.signal == single.outputs[0] for t in single.equations[0].terms)
        heavy = own_terms > 1 and options.get("coefficients") == "multi-innovation"
        if not (heavy and own.increment < COARSE_INCREMENT and not own.orders):
            return run_search(own, 1)
        ends = [
            run_search(replace(own, orders=grid_values_around(row.orders, own, single)), 1)
            for row in run_search(replace(own, increment=COARSE_INCREMENT), REFINED_CANDIDATES).table
        ]
        return min(ends, key=lambda end: end.score)

    def instrumental(self, start: Candidate) -> Candidate:
        """Search by instrumental variables on the part of the grid around the orders of another model."""
        self.begin(f"stage {self.number}: orders by instrumental variables", "instrumental")
        step, top = self.preset.order_grid.increment, self.preset.order_grid.alpha[1]
        axes = {}
        for name, value in start.model.orders.items():
            steps = 1 if name.startswith("alpha") else INSTRUMENTAL_RADIUS_STEPS
            near = [round(value + k * step, 9) for k in range(-steps, steps + 1)]
            axes[name] = [v for v in near if 0 <= v <= top]
        return self.identify_candidate(
            "instrumental variables",
            self.on,
            self.measured,
            InstrumentalVariables(order_grid=OrderGrid(increment=step, orders=axes), top=self.preset.top),
        )

    def joint(
        self, label: str, structure: Structure, words: str, rows: int | None = None, near: Model | None = None
    ) -> Candidate:
        """Fit by joint output error, on the whole run or a decimated one."""
        step = "published" if structure is self.published else "output error" if rows is None else "whole orders"
        self.begin(f"stage {self.number}: {words}", step)
        run = self.on
        if rows is not None and run.length >= 2 * rows:
            run = decimate_run(run, run.length // rows)
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
        # Of the published form standard errors alone are looked at. Its automatic starts end in optima of their own,
        # which rounding chooses between; the numbers of (14)-(15) lead to the one that leaves the noise.
        begin = self.published_values(near)
        if not self.simulated:
            try:
                return self.identify_candidate(label, run, structure, OutputError(intervals="quadratic", start=begin))
            except ModelError:
                # Out of the bounds that (22)-(25) have.
                return self.identify_candidate(label, run, structure, OutputError(intervals="quadratic"))
        fit = estimate_output_error(
            Task((run,), structure),
            None,
            check_threads(self.threads),
            self.progress,
            intervals="quadratic",
            begin=begin,
            alone=True,
        )
        result = assess_fit(fit)
        return self.candidate(label, result.model, result)

    def best(
        self,
        label: str,
        structure: Structure,
        what: str = "free orders",
        rows: int | None = None,
        near: Model | None = None,
    ) -> Candidate:
        """Fit by joint output error from the current alone, or with the measured other angle if that fails."""
        words = f"{what}{', (22)–(25)' * (structure is self.published)}, "
        try:
            return self.joint(label, structure, f"{words}by output error", rows, near)
        except ConvergenceError as error:
            self.notes.append(
                f"stage {self.number}, {label}: from the current alone, {error}; that row is driven by the measured "
                "other angle instead"
            )
        return self.joint(label, replace(structure, coupling="measured"), f"{words}by output error", rows, near)

    def traces(
        self, candidates: Mapping[str, Candidate], prior: float = 1.0
    ) -> dict[str, dict[int, MultiInnovationTrace]]:
        """Convergence of every equation with every p, at the orders of the model of that p."""
        return {
            output: {p: self._trace(output, candidates[f"p = {p}"], p, prior) for p in printed.INNOVATION_LENGTHS}
            for output in self.measured.outputs
        }

    def _trace(self, output: str, at: Candidate, p: int, prior: float) -> MultiInnovationTrace:
        single = self.measured.equation(output)
        single = single.with_orders({n: at.model.orders[n] for n in single.order_names})
        return multi_innovation_trace(
            self.on, single, innovation_length=p, prior_covariance=prior, every=self.preset.trace_every
        )

    def rivals(self, genetic: GeneticAlgorithm | None) -> dict[str, Rival]:
        """Compare multi-innovation with other optimizers on each equation; empty if these are not installed."""
        if self.preset.rivals_increment is None:
            return {}
        lattice = rivals_order_grid(self.preset.order_grid.increment, self.preset.rivals_increment)
        found = {}
        for output in self.measured.outputs:
            single = self.measured.equation(output)
            self.begin(f"stage {self.number}: the rivals on {output}", "rivals")
            try:
                made = compare_optimizers(
                    self.on, single, lattice, genetic, threads=self.threads, progress=self.progress
                )
            except ModelError as error:
                self.notes.append(RIVALS_OMITTED.format(error))
                return {}

            def model(
                orders: Mapping[str, float], coefficients: Mapping[str, float], item: Structure = single
            ) -> Model:
                return Model(item.with_orders(orders).with_coefficients(coefficients), orders=dict(orders))

            ends: dict[str, GeneticRun | SearchResult] = {
                "genetic": made.genetic,
                "differential evolution": made.evolution,
                **dict(zip(MULTI_INNOVATION_LABELS, made.order_grid.values(), strict=True)),
            }
            candidates = {
                n: self.candidate(n, _known_model(single, end.orders, end.coefficients)) for n, end in ends.items()
            }
            found[output] = Rival(
                made.candidates, lattice.increment, made.settings.population, made.genetic, made.evolution, candidates
            )
        return found

    def printed_order_candidate(self) -> Candidate:
        """Return the model with the printed orders and least-squares coefficients on this run."""
        orders: dict[str, float] = {}
        for output in self.measured.outputs:
            orders |= printed.last_orders(output)
        axes = OrderGrid(increment=self.preset.order_grid.increment, orders={n: [v] for n, v in orders.items()})
        return self.search_candidate("printed orders", axes, coefficients="least-squares")

    def by_equation(self) -> Candidate:
        """Return the least-squares model with the orders of the smallest equation error."""
        self.begin(f"stage {self.number}: orders by the equation error", "equation")
        return self.search_candidate(
            "smallest equation error",
            self.preset.order_grid,
            coefficients="least-squares",
            criterion="equation-error",
            norm="l2",
        )

    def in_published_form(self, model: Model) -> Model:
        """Insert the parameters of (14)-(15) into (22)-(25), which drop a derivative of the current."""
        h, d = self.number * 2 - 1, self.number * 2
        output = self.measured.outputs[1]
        known = {n: model.coefficients[n] for n in (f"{c}{k}" for c in "ad" for k in (h, d))}
        known |= {n: model.coefficients[n] for n in (f"b{h}", f"g{h}")}
        known |= {f"{c}{d}": -known[f"{c}{h}"] for c in "bg"}
        known |= {f"{c}{d}": known[f"{c}{d}"] - known[f"{c}{h}"] for c in "ad"}
        orders = {**model.orders, f"alpha{d}": next(e.order.constant for e in model.equations if e.output == output)}
        other = link_model(
            stage=self.number,
            form="published",
            orders=orders,
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
        return DroppedDerivative(
            output,
            order_law(self.number, "derived")["input"].at(other.orders),
            pulse_times(whole),
            current,
            whole.measured[output][0],
            published.simulated[output][0],
            whole.simulated[output][0],
        )


def grid_values_around(orders: Mapping[str, float], order_grid: OrderGrid, single: Structure) -> dict[str, list[float]]:
    """Grid values less than two coarse increments away from these orders."""
    values = order_grid.values(single)
    return {n: [v for v in values[n] if abs(v - at) < 2 * COARSE_INCREMENT - 1e-9] for n, at in orders.items()}


def _known_model(item: Structure, orders: Mapping[str, float], coefficients: Mapping[str, float]) -> Model:
    """Return a model of one equation with given parameters."""
    return Model(item.with_orders(orders).with_coefficients(coefficients), orders=dict(orders))
