"""One stage of the paper's section 5, recomputed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ftlm import _core
from ftlm.arm.link import flexible_link, link_model, order_law
from ftlm.arm.parameters import INTEGER_ORDERS
from ftlm.base.arrays import Floats
from ftlm.base.errors import ConvergenceError, ModelError
from ftlm.data.equations import Equation
from ftlm.data.lattice import Lattice
from ftlm.data.orders import Order
from ftlm.data.run import Run
from ftlm.data.structures import Structure
from ftlm.fit.genetic import Genetic
from ftlm.fit.recursion import Trace, multi_innovation_trace
from ftlm.identification.identify import identify
from ftlm.identification.result import Identification
from ftlm.judge.comparison import Comparison, compare
from ftlm.judge.metrics import Metrics, metrics
from ftlm.model.model import Model
from ftlm.paper import printed
from ftlm.paper.arm import PLANTS
from ftlm.solve.free_run import explicit_euler
from ftlm.solve.records import default_m, prepare

#: Steps between two points of a convergence curve: what p does, it does in the first steps.
TRACE_EVERY = 4
#: A prior so weak that the data alone decide.
WEAK_PRIOR = 1e10
#: Lattice of the genetic comparison: both algorithms' printed highest orders lie in it, and all of it can be evaluated.
RIVAL_ALPHA = (1.95, 2.0)
#: Instrumental variables are searched so many steps of the lattice around the orders of least squares: every candidate
#: costs several free runs.
AROUND = 2
#: Runs with more rows than the first are thinned to at most the second for joint fits, whose cost and whose grid's
#: refinement grow with the rows; the arm's modes are two decades below the rate that is left.
MOST_ROWS, JOINT_ROWS = 6000, 2500


@dataclass(frozen=True)
class Candidate:
    """One model of a stage on both runs.

    Parameters
    ----------
    label
        Such as "p = 7".
    model
        The model.
    estimation
        Both errors on the run that it was identified from, driven as the method drives it.
    validation
        The same on the other run; None without one.
    alone
        Output error from the currents alone, on both runs, by run and output.
    result
        The identification; None for a model that was not identified.
    """

    label: str
    model: Model
    estimation: Comparison
    validation: Comparison | None
    alone: dict[str, dict[str, Metrics]]
    result: Identification | None = None


@dataclass(frozen=True)
class Rival:
    """The genetic algorithm and multi-innovation on one equation, like for like.

    Parameters
    ----------
    candidates
        Of the lattice, and evaluations of every seed.
    genetic, lattice
        The two results.
    """

    candidates: int
    genetic: Candidate
    lattice: Candidate


@dataclass(frozen=True)
class Derived:
    """What the derivative of the current that (19) drops would change.

    Parameters
    ----------
    output
        The deflection.
    order
        The order that the current would have; 0 as published.
    time
        Middle of every pulse [s].
    published, derived
        Pulse means of the free run from the current alone, all other numbers alike.
    """

    output: str
    order: float
    time: Floats
    published: Floats
    derived: Floats


@dataclass(frozen=True)
class Stage:
    """Everything about one stage.

    Parameters
    ----------
    number
        1 or 2.
    candidates
        Models by label, in the order of the tables.
    traces, weak_traces
        Convergence by output and p: each p at its own orders and K0 = 1; with a weak prior, at the orders of p = 7.
    weak
        Coefficients by output and p with a weak prior, at the orders of p = 7.
    rivals
        By output; empty without PyGAD or where a run does not start at rest.
    near
        The model with the orders that the paper prints, least-squares coefficients on this run.
    by_equation
        The model whose orders have the smallest equation error on the lattice.
    derived
        What the dropped derivative of the current changes.
    """

    number: int
    candidates: dict[str, Candidate]
    traces: dict[str, dict[int, Trace]]
    weak_traces: dict[str, dict[int, Trace]]
    weak: dict[str, dict[int, dict[str, float]]]
    rivals: dict[str, Rival]
    near: Candidate
    by_equation: Candidate
    derived: Derived

    @property
    def outputs(self) -> tuple[str, str]:
        """Hub angle and deflection."""
        return f"theta{self.number}1", f"theta{self.number}2"

    @property
    def manual(self) -> str:
        """Label of the manual's model as the paper ran it; Euler's steps start at rest, so not on any other run."""
        return "integer, Euler" if self.traces else "integer, exact"


@dataclass(frozen=True)
class Recomputed:
    """Both stages and the runs; its fields are those of :class:`ftlm.Reproduction`."""

    square: Run
    sine: Run | None
    simulated: bool
    stages: dict[int, Stage]
    lattice: Lattice
    notes: tuple[str, ...] = field(default=())

    @property
    def truth(self) -> dict[int, dict[str, float]]:
        """Orders and coefficients of the simulated arm by stage; empty for measured runs."""
        if not self.simulated:
            return {}
        found = {}
        for n in self.stages:
            orders, free = PLANTS[n]
            found[n] = {**orders, **{(f"r{n}" if name == "r" else name): v for name, v in free.items()}}
        return found


def thinned(run: Run, every: int) -> Run:
    """Every so manieth row of a run, held inputs by their means until the next one, which act alike."""
    rows = run.length // every
    data = {}
    for name in run.signals:
        samples = run[name][: rows * every].reshape(rows, every)
        held = name in run.inputs and run.intersample[name] == "zoh"
        data[name] = samples.mean(axis=1) if held else samples[:, 0]
    return Run.from_arrays(
        step=run.step * every, inputs={n: data[n] for n in run.inputs}, outputs={n: data[n] for n in run.outputs},
        units=dict(run.units), intersample=dict(run.intersample), name=run.name,
    )  # fmt: skip


@dataclass
class StageWork:
    """One stage under way."""

    number: int
    square: Run
    sine: Run | None
    lattice: Lattice
    genetic: Genetic | None
    threads: int | None
    say: Callable[[str], None]
    progress: Callable[[int, int], None] | None
    notes: list[str]

    def __post_init__(self) -> None:
        which: Any = self.number
        self.measured = flexible_link(stage=which, coupling="measured", laws=())
        self.coupled = flexible_link(stage=which)
        own = list(self.measured.signals)
        self.on = self.square.select(own)
        self.off = None if self.sine is None else self.sine.select(own)

    def thinned(self) -> Run:
        """The run for joint fits: as it is, or every so many rows of it."""
        run = self.on
        if run.length <= MOST_ROWS:
            return run
        every = -(-run.length // JOINT_ROWS)
        self.notes.append(
            f"run {run.name} has {run.length} rows: joint fits by output error take one of {every} rows, "
            f"{every * run.step:.6g} s apart, with the means of held currents in between; all models are compared on "
            "the same block pulses of the whole run"
        )
        return thinned(run, every)

    @property
    def runs(self) -> list[Run]:
        return [self.on] if self.off is None else [self.on, self.off]

    def stage(self) -> Stage:
        candidates = {c.label: c for c in self.integer()}
        for p in printed.INNOVATION_LENGTHS:
            candidates[f"p = {p}"] = self.searched(f"p = {p}", "multi-innovation", innovation_length=p)
        candidates["least squares"] = self.searched("least squares", "least-squares")
        candidates["instrumental variables"] = self.instrumental(candidates["least squares"])
        candidates["output error"] = self.best()
        last = candidates[f"p = {printed.INNOVATION_LENGTHS[-1]}"]
        traces: dict[str, dict[int, Trace]] = {}
        weak_traces: dict[str, dict[int, Trace]] = {}
        weak: dict[str, dict[int, dict[str, float]]] = {}
        if prepare([self.on], self.measured, None, power_of_two=True)[0].initial == "rest":
            for output in self.measured.outputs:
                each = {p: candidates[f"p = {p}"].model for p in printed.INNOVATION_LENGTHS}
                traces[output] = {p: self.trace(self.ordered(output, m.orders), p, 1.0) for p, m in each.items()}
                single = self.ordered(output, last.model.orders)
                weak_traces[output] = {p: self.trace(single, p, WEAK_PRIOR) for p in each}
                weak[output] = {
                    p: {n: float(c[-1]) for n, c in t.coefficients.items()} for p, t in weak_traces[output].items()
                }
        else:
            self.notes.append(
                f"run {self.on.name} does not start at rest: every model is fitted and compared with initial terms; "
                "explicit Euler, which steps from rest as in the paper, is not, and its errors hold that; convergence "
                "of the recursion, and with it Figures 4(b) to 8(b), and the weak prior are left out"
            )
        return Stage(
            self.number, candidates, traces, weak_traces, weak, self.rivals(), self.near(),
            self.by_equation(),
            self.derived(candidates["output error"].model),
        )  # fmt: skip

    def candidate(self, label: str, model: Model, result: Identification | None = None) -> Candidate:
        """Both errors of a model on both runs, and its free run from the currents alone.

        Whatever a method worked on, all are judged on the paper's pulses: a sum over other pulses is another number.
        """
        m = default_m([self.on], power_of_two=True)
        own = [] if result is None or result.task is None else result.task.runs
        known = result.comparison if result is not None and any(run is self.on for run in own) else None
        model = model if model.m == m else replace(model, m=m)
        estimation = known if known is not None and known.m == m else compare(model, self.on)
        alone_model = replace(model, structure=replace(model.structure, coupling="simulated"))
        whole = len(model.equations) > 1
        alone = {r.name: compare(alone_model, r).output_error for r in self.runs} if whole else {}
        validation = None if self.off is None else compare(model, self.off)
        return Candidate(label, model, estimation, validation, alone, result)

    def integer(self) -> list[Candidate]:
        """The manual's model by explicit Euler and exactly, and whole orders identified from the run."""
        which: Any = self.number
        model = link_model(stage=which)
        exact = self.candidate("integer, exact", model)
        euler = [
            self._euler(model, r, c) for r, c in zip(self.runs, (exact.estimation, exact.validation), strict=False)
        ]
        stepped = replace(
            exact, label="integer, Euler", estimation=euler[0], validation=euler[1] if self.off else None,
            alone={r.name: e.output_error for r, e in zip(self.runs, euler, strict=True)},
        )  # fmt: skip
        whole = {n: INTEGER_ORDERS.get(n.rstrip("0123456789"), 2.0) for n in self.measured.order_names}
        words = "whole orders, each equation driven by the measured other angle"
        return [stepped, exact, self.joint("integer, identified", self.measured.with_orders(whole), words)]

    def _euler(self, model: Model, run: Run, exact: Comparison | None) -> Comparison:
        """The comparison with Euler's response in place of the exact one."""
        if exact is None:
            raise ModelError(f"run {run.name!r} was not compared; please report it")
        stepped = explicit_euler(model, run)
        simulated = {}
        for name, samples in stepped.items():
            with np.errstate(over="ignore", invalid="ignore"):
                finite = bool(np.all(np.isfinite(samples)))
            simulated[name] = _core.pulse_means(samples, exact.m, False) if finite else np.full(exact.m, np.inf)
        errors = {n: metrics(exact.measured[n][0], s) for n, s in simulated.items()}
        return replace(
            exact, simulated={n: [s] for n, s in simulated.items()}, output_error=errors,
            per_run=[(run.name, exact.equation_error, errors)], warnings=(),
        )  # fmt: skip

    def searched(self, label: str, method: Any, **options: Any) -> Candidate:
        self.say(f"stage {self.number}: searching the orders of both equations, {label}")
        result = identify(
            self.on, self.measured, method=method, lattice=self.lattice, keep=1, threads=self.threads,
            progress=self.progress, **options,
        )  # fmt: skip
        return self.candidate(label, result.model, result)

    def instrumental(self, start: Candidate) -> Candidate:
        """Orders on the part of the lattice around those of least squares."""
        self.say(f"stage {self.number}: searching the orders by instrumental variables")
        step, axes = self.lattice.step, {}
        for name, value in start.model.orders.items():
            steps = range(-1, 2) if name.startswith("alpha") else range(-AROUND, AROUND + 1)
            near = [round(value + k * step, 9) for k in steps]
            top = self.lattice.alpha[1]
            axes[name] = [v for v in near if 0 <= v <= top]
        result = identify(
            self.on, self.measured, method="instrumental-variables", lattice=Lattice(step=step, orders=axes), keep=1,
            threads=self.threads, progress=self.progress,
        )  # fmt: skip
        return self.candidate("instrumental variables", result.model, result)

    def joint(self, label: str, structure: Structure, words: str) -> Candidate:
        self.say(f"stage {self.number}: {words}, by output error")
        result = identify(self.thinned(), structure, threads=self.threads, progress=self.progress)
        return self.candidate(label, result.model, result)

    def best(self) -> Candidate:
        """Joint output error from the current alone, or driven by the measured other angle where that has no start."""
        try:
            return self.joint(
                "output error", self.coupled, "all orders and coefficients together, from the current alone"
            )
        except ConvergenceError as error:
            self.notes.append(
                f"stage {self.number}: from the current alone, {error}; the row of output error is driven by the "
                "measured other angle instead"
            )
        return self.joint(
            "output error", replace(self.coupled, coupling="measured"), "all orders and coefficients together"
        )

    def ordered(self, output: str, orders: Mapping[str, float]) -> Structure:
        single = self.measured.equation(output)
        return single.with_orders({n: orders[n] for n in single.order_names})

    def trace(self, single: Structure, p: int, prior: float) -> Trace:
        return multi_innovation_trace(self.on, single, innovation_length=p, prior_covariance=prior, every=TRACE_EVERY)

    def rivals(self) -> dict[str, Rival]:
        """Genetic algorithm and lattice on one equation each: same record, same number of candidates."""
        lattice = Lattice(step=self.lattice.step, alpha=RIVAL_ALPHA)
        found = {}
        for output in self.measured.outputs:
            single = self.measured.equation(output)
            self.say(f"{output}: a genetic algorithm with as many evaluations as the lattice has candidates")
            paper = identify(
                self.on, single, method="multi-innovation", lattice=lattice, keep=1, threads=self.threads,
                progress=self.progress,
            )  # fmt: skip
            count = paper.searches[output].candidates
            settings = self.genetic or Genetic()
            settings = (
                settings if settings.evaluations else replace(settings, evaluations=max(count, 2 * settings.population))
            )
            try:
                result = identify(
                    self.on, single, method="genetic", lattice=lattice, genetic=settings, threads=self.threads,
                    progress=self.progress,
                )  # fmt: skip
            except ModelError as error:
                self.notes.append(f"Tables 6 and 7 and Figure 11 are left out: {error}")
                return {}
            found[output] = Rival(
                count, self.candidate("genetic", result.model, result), self.candidate("p = 7", paper.model, paper)
            )
        return found

    def near(self) -> Candidate:
        """The orders that the paper prints, with the best coefficients that this run gives them."""
        orders: dict[str, float] = {}
        for item in self.measured.equations:
            row = printed.FRACTIONAL[item.output][printed.INNOVATION_LENGTHS[-1]]
            index = next(n for n in self.measured.equation(item.output).order_names if n.startswith("alpha"))[5:]
            orders |= {f"{n}{index}": v for n, v in row.orders.items()}
        result = identify(self.on, self.measured.with_orders(orders), method="least-squares")
        return self.candidate("printed orders", result.model, result)

    def by_equation(self) -> Candidate:
        """Least squares at the orders whose equation error is smallest."""
        self.say(f"stage {self.number}: searching the orders with the smallest equation error")
        result = identify(
            self.on, self.measured, method="least-squares", criterion="equation-error", norm="l2",
            lattice=self.lattice, threads=self.threads, progress=self.progress,
        )  # fmt: skip
        return self.candidate("smallest equation error", result.model, result)

    def derived(self, model: Model) -> Derived:
        """The deflection with the current's order as published and as derived, all other numbers alike."""
        output = self.measured.outputs[1]
        order = order_law(self.number, "derived")["input"].at(model.orders)

        def moved(item: Equation) -> Equation:
            if item.output != output:
                return item
            return replace(
                item,
                terms=tuple(replace(t, order=Order(order)) if t.signal in self.on.inputs else t for t in item.terms),
            )

        other = replace(model, structure=replace(model.structure, equations=tuple(map(moved, model.equations))))
        found = [compare(m, self.on) for m in (model, other)]
        time = np.asarray((np.arange(found[0].m) + 0.5) * found[0].step[0], dtype=np.float64)
        return Derived(output, order, time, found[0].simulated[output][0], found[1].simulated[output][0])


def candidate_dict(candidate: Candidate) -> dict[str, Any]:
    return {
        "orders": {n: float(v) for n, v in candidate.model.orders.items()},
        "coefficients": {n: float(v) for n, v in candidate.model.coefficients.items()},
        "intervals": {} if candidate.result is None else {n: list(i) for n, i in candidate.result.intervals.items()},
        "estimation": candidate.estimation.to_dict(),
        "validation": None if candidate.validation is None else candidate.validation.to_dict(),
        "alone": {run: {o: f.to_dict() for o, f in found.items()} for run, found in candidate.alone.items()},
        "settings": {} if candidate.result is None else candidate.result.settings,
        "warnings": [] if candidate.result is None else list(candidate.result.warnings),
    }


def stage_dict(stage: Stage) -> dict[str, Any]:
    return {
        "models": {label: candidate_dict(c) for label, c in stage.candidates.items()},
        "printed orders": candidate_dict(stage.near),
        "weak prior": {o: {str(p): c for p, c in found.items()} for o, found in stage.weak.items()},
        "genetic": {
            o: {
                "candidates": r.candidates,
                "genetic": candidate_dict(r.genetic),
                "multi-innovation": candidate_dict(r.lattice),
            }
            for o, r in stage.rivals.items()
        },
        "smallest equation error": candidate_dict(stage.by_equation),
        "derived input order": {"output": stage.derived.output, "order": stage.derived.order},
    }
