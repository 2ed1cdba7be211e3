"""From measured runs to a model: orders, coefficients, both errors and what to beware of."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ftlm import _core
from ftlm.advice import excitation_for
from ftlm.baselines import Genetic, genetic_search
from ftlm.checks import whole_number
from ftlm.errors import DataError, FtlmError, InternalError, ModelError
from ftlm.models import Estimate, Model, Structure, delay_name, numeric
from ftlm.order_search import (
    Lattice,
    SearchResult,
    Settings,
    check_lattice,
    check_threads,
    make_job,
    named_coefficients,
    prepare,
    run_job,
)
from ftlm.output_error import NORMAL_95, FreeProblem, JointFit, fit_output_error, is_white
from ftlm.physical import PhysicalParameter, physical_parameters
from ftlm.records import initial_tuple, structure_tuple
from ftlm.residuals import (
    InformationCriteria,
    Residuals,
    information_criteria,
    resid,
    residual_warnings,
)
from ftlm.store import Store
from ftlm.validation import Comparison, Metrics, as_runs, compare, validation_warnings

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Mapping, Sequence
    from concurrent.futures import Executor
    from pathlib import Path

    from numpy.typing import NDArray

    from ftlm.records import Record
    from ftlm.runs import Run

__all__ = ["Identification", "Trace", "identify", "multi_innovation_trace"]

METHODS = ("output-error", "instrumental-variables", "multi-innovation", "least-squares", "genetic")
#: Most pulses a run on which instrumental variables end where m is not given.
MOST_PULSES = 1 << 14
#: Fewest pulses on which the effect of the step is looked at.
LEAST_PULSES = 32
#: Standard errors that the step may move a coefficient by before it is said.
STEP_BIAS = 0.5
#: Most steps of refined instrumental variables, and the relative change of a coefficient that ends them.
REFINEMENTS = 40
STILL = 1e-8
#: A coefficient that the prior moves by more than this share is not the data's alone.
PULLED = 0.05
#: Two parameters more correlated than this cannot be told apart.
INSEPARABLE = 0.995
#: Residuals of an output-error fit below this share of the output are rounding and discretisation.
ROUNDING = 3e-5
#: Seeds of the genetic algorithm whose errors differ by more than this factor have not all found the optimum.
SCATTERED = 1.2
#: Two coefficients further apart than this share do not obey the coefficient law.
LAW_BROKEN = 0.05


@dataclass(frozen=True)
class Task:
    """What was asked for: from it, reports draw what the result alone does not hold.

    Parameters
    ----------
    runs
        The runs.
    structure
        What was identified, its free orders and coefficients still free.
    lattice
        Of the order search; None for the default.
    """

    runs: tuple[Run, ...]
    structure: Structure
    lattice: Lattice | None = None

    def lattice_of(self, part: Structure) -> Lattice:
        """The lattice of one searched part of the structure."""
        return _lattice_of(self.lattice, part) or Lattice()


@dataclass(frozen=True)
class Identification:
    """An identified model with everything that is known about it.

    Parameters
    ----------
    model
        The model.
    method
        Estimator of the coefficients.
    comparison
        Both errors on the runs it was identified from.
    searches
        The order searches that gave its orders: by output, or under ``"stage"`` for a search under the order law;
        empty where all orders were given.
    settings
        Of the estimator.
    warnings
        What makes the model doubtful, in words.
    joint
        The optimum of the joint output error with its covariance; None for the equation-error methods.
    residuals
        Residual tests on the runs it was identified from; None where these are too short.
    information
        Information criteria, orders counted as parameters; None where there are no residuals.
    task
        The runs and the structure as they were given.
    coefficient_errors
        Standard errors of the coefficients at these orders, where the method gives no joint covariance.
    """

    model: Model
    method: str
    comparison: Comparison
    searches: dict[str, SearchResult]
    settings: dict[str, Any]
    warnings: tuple[str, ...] = field(default=())
    joint: JointFit | None = None
    residuals: Residuals | None = None
    information: InformationCriteria | None = None
    task: Task | None = field(default=None, repr=False)
    coefficient_errors: Mapping[str, float] = field(default_factory=dict)

    @property
    def orders(self) -> dict[str, float]:
        """Free orders by name."""
        return dict(self.model.orders)

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors by name.

        Of orders and coefficients by output error; of coefficients alone, at the orders found and robust to coloured
        residuals, by instrumental variables; empty for the equation-error methods.
        """
        if self.joint is None:
            return dict(self.coefficient_errors)
        return {**self.joint.standard_errors, **self.joint.derived_errors}

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % intervals by name, of what has standard errors."""
        values = {**self.orders, **self.coefficients, **({} if self.joint is None else self._joint_values)}
        errors = self.standard_errors
        return {n: (values[n] - NORMAL_95 * e, values[n] + NORMAL_95 * e) for n, e in errors.items()}

    @property
    def delays(self) -> dict[str, float]:
        """Delays of inputs [s] by input, estimated or known."""
        return dict(self.model.structure.delay)

    @property
    def _joint_values(self) -> dict[str, float]:
        return {} if self.joint is None else dict(zip(self.joint.names, self.joint.values.tolist(), strict=True))

    def physical(self, **known: float) -> dict[str, PhysicalParameter]:
        """Physical parameters of a flexible link once one of them is known; see :func:`ftlm.physical_parameters`.

        Parameters
        ----------
        **known
            One parameter a stage by name, such as ``J_12=0.1704``.

        Returns
        -------
        dict
            Every parameter of the stage by name, with standard error, interval and unit.

        Raises
        ------
        ModelError
            A model without coefficient law or intervals, or a name that is no parameter of it.
        """
        if self.joint is None:
            raise ModelError(f"method {self.method!r} gives no joint covariance; identify by method='output-error'")
        return physical_parameters(self.joint, known)

    @property
    def coefficients(self) -> dict[str, float]:
        """Coefficients by name."""
        return self.model.coefficients

    @property
    def equation_error(self) -> dict[str, Metrics]:
        """Figures of the equation error by output."""
        return self.comparison.equation_error

    @property
    def output_error(self) -> dict[str, Metrics]:
        """Figures of the free run by output."""
        return self.comparison.output_error

    @property
    def fit_percent(self) -> dict[str, float]:
        """Fit of the free run in percent, by output."""
        return self.comparison.fit_percent

    def resid(self, runs: Run | Sequence[Run], *, lags: int = 25) -> Residuals:
        """Residual tests on other runs; see :func:`ftlm.resid`."""
        return resid(self.model, runs, lags=lags)

    def validate(self, runs: Run | Sequence[Run]) -> Comparison:
        """Both errors on runs that the model was not identified from, with what they say against the model.

        Parameters
        ----------
        runs
            One run or several with the same names and units.

        Returns
        -------
        Comparison
            Its warnings name a fit that is lost, and runs that the model was identified from.

        Raises
        ------
        DataError
            Runs that do not fit the model.
        """
        others = as_runs(runs)
        found = compare(self.model, others)
        words = [*found.warnings, *validation_warnings(self.comparison, found), *discretisation(self.model, found)]
        return replace(found, warnings=tuple(dict.fromkeys(words)))

    def report(
        self,
        path: str | os.PathLike[str],
        *,
        validation: Run | Sequence[Run] | None = None,
        force: bool = False,
    ) -> Path:
        """Write everything about this result as one HTML file that opens offline.

        Parameters
        ----------
        path
            File to write.
        validation
            Runs that the model was not identified from; without any, the page says that it was not validated.
        force
            Overwrite an existing file.

        Returns
        -------
        pathlib.Path
            The file.

        Raises
        ------
        DataError
            A validation run that does not fit the model; the file exists and ``force`` is not set, or cannot be
            written.
        """
        from ftlm.report.page import identification_page  # noqa: PLC0415 — pages read results

        return identification_page(self, path, validation=validation, force=force)

    def to_frame(self) -> Any:
        """Orders and coefficients as a pandas frame: value, standard error, 95 % interval, stated value by name."""
        from ftlm.exports import to_frame  # noqa: PLC0415 — pandas is not always there

        values = {**self.orders, **self._joint_values, **self.coefficients}
        errors, intervals = self.standard_errors, self.intervals
        none = (math.nan, math.nan)
        rows = [
            {
                "parameter": n, "value": v, "standard_error": errors.get(n, math.nan),
                "low": intervals.get(n, none)[0], "high": intervals.get(n, none)[1],
                "stated": self.model.structure.reference.get(n, math.nan),
            }
            for n, v in values.items()
        ]  # fmt: skip
        return to_frame(rows, ["parameter"])

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "method": self.method,
            "settings": self.settings,
            "equations": {e.output: numeric(e) for e in self.model.equations},
            "orders": self.orders,
            "coefficients": self.coefficients,
            "delays": self.delays,
            "standard_errors": self.standard_errors,
            "intervals": {n: list(i) for n, i in self.intervals.items()},
            **self.comparison.to_dict(),
            "residuals": None if self.residuals is None else self.residuals.to_dict(),
            "information": None if self.information is None else self.information.to_dict(),
            "searches": {name: s.to_dict() for name, s in self.searches.items()},
            "choice": None if self.joint is None else self.joint.choice,
            "warnings": list(self.warnings),
        }

    def __str__(self) -> str:
        lines = [f"{self.model.structure.name}: {self.method}, {_settings_in_words(self.settings)}"]
        lines += [f"  {numeric(e)}" for e in self.model.equations]
        reference = self.model.structure.reference
        errors, shown = self.standard_errors, {**self.orders, **self.coefficients}
        if self.joint is not None:
            shown = {**self.orders, **self._joint_values, **self.coefficients}
        for name, value in shown.items():
            spread = f" ± {errors[name]:<10.3g}" if name in errors else ""
            stated = f"   (stated {reference[name]:.6g})" if name in reference else ""
            lines.append(f"  {name:<12}{value:>14.6g}{spread}{stated}")
        if self.joint is not None:
            lines.append(f"  {self.joint.choice}")
        if errors:
            lines.append("  (value ± standard error; 95 % intervals are ± 1.96 of these)")
        lines.append(str(replace(self.comparison, warnings=())))
        if self.residuals is not None:
            white = ", ".join(f"{o} {'yes' if w else 'no'}" for o, w in self.residuals.white.items())
            free = ", ".join(f"{o} {'yes' if w else 'no'}" for o, w in self.residuals.independent.items())
            lines.append(f"residuals white: {white}; independent of the inputs: {free} (99 %)")
        if self.information is not None:
            lines.append(str(self.information))
        for name, search in self.searches.items():
            pruned = ", ".join(f"{count} {reason}" for reason, count in search.pruned.items() if count)
            lines.append(f"order search ({name}): {search.candidates} candidates, {len(search.table)} kept, {pruned}")
        initial = _initial_in_words(self.comparison)
        lines += initial
        lines += [f"warning: {w}" for w in self.warnings]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        from ftlm.report.notebook import identification_html  # noqa: PLC0415 — only notebooks need it

        return identification_html(self)


def _settings_in_words(settings: Mapping[str, Any]) -> str:
    words = f"M = {settings['m']}"
    if "refinement" in settings:
        words = f"all samples, {settings['refinement']} pulses each, {settings['starts']} starts"
    if "seeds" in settings:
        seeds = ", ".join(map(str, settings["seeds"]))
        words += f", seeds {seeds}, {sum(settings['evaluations'].values())} evaluations in all"
    if "innovation_length" in settings:
        words += f", p = {settings['innovation_length']}, K0 = {settings['prior_covariance']:g}"
        words += f", {settings['rows']} rows"
    return f"{words}, initial terms: {settings['initial']}"


def _initial_in_words(comparison: Comparison) -> list[str]:
    lines = []
    for (run, _, _), initial in zip(comparison.per_run, comparison.initial, strict=True):
        for output, terms in initial.items():
            if terms:
                listed = ", ".join(f"{v:.4g} t^{e:g}" for e, v in terms.items())
                lines.append(f"initial terms of {output} in {run} (of that run alone): {listed}")
    return lines


def identify(
    runs: Run | Sequence[Run],
    structure: Structure,
    *,
    method: Literal[
        "output-error", "instrumental-variables", "multi-innovation", "least-squares", "genetic"
    ] = "output-error",
    criterion: Literal["output-error", "equation-error"] = "output-error",
    lattice: Lattice | None = None,
    norm: Literal["l1", "l2"] = "l1",
    innovation_length: int = 7,
    prior_covariance: float = 1.0,
    rows: Literal["haar", "time"] = "haar",
    m: int | None = None,
    keep: int = 20,
    genetic: Genetic | None = None,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    store: str | os.PathLike[str] | None = None,
    executor: Executor | None = None,
) -> Identification:
    """Identify a structure from measured runs.

    By output error, orders and coefficients are continuous and found together, with intervals, from an automatic start.
    By the equation-error methods, free orders are searched on the lattice: each equation on its own, or all under their
    order law; at the orders found, or given, the coefficients are those of the estimator.

    Parameters
    ----------
    runs
        One run or several with the same names and units, in one fit; each keeps its own initial terms.
    structure
        What to identify; see :func:`ftlm.equation` and :func:`ftlm.flexible_link`.
    method
        ``"output-error"``: all equations and runs together, maximum likelihood for white noise.
        ``"instrumental-variables"``: refined instrumental variables, orders from the lattice, coefficients without the
        bias of noise. ``"multi-innovation"``: the paper's (44) in closed form. ``"least-squares"``: its limit for a
        weak prior. ``"genetic"``: orders and coefficients by a genetic algorithm on the free run, the paper's
        baseline, for comparison only (``pip install 'ftlm[genetic]'``).
    criterion, lattice, norm, keep, threads, progress
        Of the order search; see :func:`ftlm.search_orders`. Not used by ``"output-error"``, whose bounds are the
        structure's own.
    innovation_length, prior_covariance, rows
        p, K0 and the coordinates of paper (42)-(44). p is a weight of the data against the prior, nothing else.
    m
        Block pulses a run; default 2 048, or what the runs carry (a power of two for Haar rows). Instrumental variables
        search on these and, without m, end on all samples (at most 16 384 pulses).
    genetic
        Seeds, evaluations, population and bounds of the genetic algorithm.
    store
        File in which the order searches are kept: the same call goes on with them after a power cut, and
        :func:`ftlm.resume_search` with the searches alone; see :func:`ftlm.search_orders`.
    executor
        Any :class:`concurrent.futures.Executor` to work for the order searches; see :func:`ftlm.search_orders`. For
        many runs each by itself: :func:`ftlm.identify_many`.

    Returns
    -------
    Identification
        Prints well; ``.model`` simulates, compares and saves.

    Raises
    ------
    DataError
        Runs that do not fit the structure, or a constant output; a store of other searches, in use, damaged, or that
        cannot be written.
    ModelError
        A method that is not known, a lattice without or with too many candidates, settings out of range, a store or an
        executor without an order search.
    ConvergenceError
        Regressors that cannot be told apart at the given orders, or an executor that has lost its workers.
    """
    found = as_runs(runs)
    if method not in METHODS:
        raise ModelError(f"method = {method!r} is not known; use {' or '.join(map(repr, METHODS))}")
    if not isinstance(structure, Structure):
        raise ModelError(f"structure is {type(structure).__name__}; use ftlm.equation(…) or ftlm.flexible_link(…)")
    check_lattice(lattice)
    _check_lattice_names(lattice, structure)
    if not (genetic is None or isinstance(genetic, Genetic)):
        raise ModelError(f"genetic is {type(genetic).__name__}, not Genetic; use ftlm.Genetic(seeds=…)")
    if genetic is not None and method != "genetic":
        raise ModelError(f"genetic settings are given, but method = {method!r}; use method='genetic'")
    estimator = "least-squares" if method in ("output-error", "genetic") else method
    settings = Settings.check(criterion, norm, estimator, innovation_length, prior_covariance, rows, keep, threads)
    searched = bool(structure.order_names) and method not in ("output-error", "genetic")
    if not searched and not (store is None and executor is None):
        why = f"method {method!r} makes none" if structure.order_names else "every order here is a number"
        raise ModelError(f"store= and executor= are for order searches, and {why}; leave them out")
    if method == "output-error":
        return _identify_output_error(found, structure, m, threads, progress)
    if method == "genetic":
        return _identify_genetic(found, structure, lattice, genetic or Genetic(), norm, m, threads, progress)

    searches: dict[str, SearchResult] = {}
    orders: dict[str, float] = {}
    if structure.order_names:
        jobs = {
            name: make_job(
                found, part, _lattice_of(lattice, part), criterion=criterion, coefficients=method, norm=norm,
                innovation_length=innovation_length, prior_covariance=prior_covariance, rows=rows, m=m, keep=keep,
                threads=1 if executor is not None and threads is None else threads, progress=progress,
            )
            for name, part in structure.parts().items()
        }  # fmt: skip
        with contextlib.ExitStack() as stack:
            requests = [job.request(name) for name, job in jobs.items()]
            kept = None if store is None else stack.enter_context(Store(store, requests))
            for number, (name, job) in enumerate(jobs.items()):
                searches[name] = run_job(job, store=kept, number=number, executor=executor)
                orders |= searches[name].orders
    rank = 1
    if "stage" in searches and method == "instrumental-variables" and structure.coupling == "simulated":
        rank = _coupled_rank(found, structure, settings, m, searches["stage"])
        orders = searches["stage"].table[rank - 1].orders
    structure_at = structure.with_orders(orders)
    if m is None and method == "instrumental-variables":
        # Coefficients without the bias of noise show that of the step: all samples, once the orders are found.
        m = min(MOST_PULSES, *(run.length - 1 for run in found))
    coefficients, pulled, pulses, initial, spread = _estimate(found, structure_at, settings, m)
    pulled += _step_bias(found, structure_at, settings, pulses, coefficients, spread)
    about: dict[str, str | float | int | bool | None] = {
        "method": method, "runs": ", ".join(r.name for r in found), **settings.to_dict(),
    }  # fmt: skip
    model = Model(
        structure_at.with_coefficients(coefficients),
        orders=orders,
        units={n: u for n, u in found[0].units.items() if n in structure.signals},
        m=pulses,
        about=about,
    )
    comparison = compare(model, found, m=pulses)
    warnings = list(comparison.warnings) + pulled + _broken_law(model)
    for search in searches.values():
        warnings += [f"order {n} = {v:g} is on the edge of its interval; widen it" for n, v in search.edges.items()]
    warnings += [f"run {r.name}: {w}" for r in found for w in r.warnings] + _unexcited(found, structure)
    warnings += discretisation(model, comparison) + growing(model)
    tests, criteria = _judged(model, found, len(orders) + len(coefficients))
    warnings += [] if tests is None else residual_warnings(tests)
    used = {**settings.to_dict(), "m": pulses, "initial": initial, **({"rank": rank} if rank > 1 else {})}
    model = _kept_with(model, method, found, comparison, criteria, warnings)
    return Identification(
        model, method, comparison, searches, used, tuple(dict.fromkeys(warnings)), coefficient_errors=spread,
        residuals=tests, information=criteria, task=Task(tuple(found), structure, lattice),
    )  # fmt: skip


def _coupled_rank(
    runs: Sequence[Run], structure: Structure, settings: Settings, m: int | None, search: SearchResult
) -> int:
    """Rank of the kept row whose coupled free run is the likeliest; the table ranks equations one by one.

    Among orders that the equations one by one hardly tell apart, the run of the whole from the inputs alone decides:
    by the sum of ln NR over outputs, the likelihood of white noise of unknown size.
    """
    best, rank = math.inf, 1
    for row in search.table:
        structure_at = structure.with_orders(row.orders)
        try:
            coefficients, _, pulses, _, _ = _estimate(runs, structure_at, settings, m)
            found = compare(Model(structure_at.with_coefficients(coefficients), m=pulses), runs, m=pulses)
        except FtlmError:
            # It has a score in the table, but no model.
            continue
        cost = sum(math.log(max(f.nr, 1e-300)) for f in found.output_error.values())
        if cost < best:
            best, rank = cost, row.rank
    return rank


def _kept_with(
    model: Model,
    method: str,
    runs: Sequence[Run],
    comparison: Comparison,
    criteria: InformationCriteria | None,
    warnings: Sequence[str],
    joint: JointFit | None = None,
    problem: FreeProblem | None = None,
) -> Model:
    """The model with what is known about its identification, for its file."""
    values = {**model.orders, **model.coefficients}
    errors: dict[str, float | None] = {}
    covariance = None
    if joint is not None and problem is not None:
        values = {**dict(zip(joint.names, joint.values.tolist(), strict=True)), **model.coefficients}
        errors = {n: _finite(v) for n, v in joint.standard_errors.items()}
        moved = problem.number_jacobian(list(joint.orders.values()), list(joint.coefficients.values()))
        spread = moved @ joint.covariance @ moved.T
        if np.all(np.isfinite(spread)):
            covariance = tuple(tuple(row) for row in spread.tolist())
    estimate = Estimate(
        method=method,
        runs=tuple(r.name for r in runs),
        values={n: float(v) for n, v in values.items()},
        standard_errors=errors,
        covariance=covariance,
        fit={n: _finite(f) for n, f in comparison.fit_percent.items()},
        information={} if criteria is None else {n: _finite(getattr(criteria, n)) for n in ("aic", "aicc", "bic")},
        warnings=tuple(dict.fromkeys(warnings)),
    )
    return replace(model, estimate=estimate)


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _judged(model: Model, runs: Sequence[Run], parameters: int) -> tuple[Residuals | None, InformationCriteria | None]:
    """Residual tests and information criteria; None where a run is too short for them."""
    try:
        tests = resid(model, runs)
    except DataError:
        return None, None
    return tests, information_criteria(tests, parameters)


def _identify_output_error(
    runs: Sequence[Run],
    structure: Structure,
    m: int | None,
    threads: int | None,
    progress: Callable[[int, int], None] | None,
) -> Identification:
    """Orders and coefficients together by joint output error."""
    # An order with one value is known.
    known = {n: v[0] for n, v in structure.order_values.items() if len(v) == 1}
    structure = structure.with_orders(known)
    records = prepare(runs, replace(structure, free_delays={}), m, power_of_two=False)
    decided = replace(structure, initial=records[0].initial)
    joint = fit_output_error(runs, decided, threads=check_threads(threads), progress=progress)
    problem = FreeProblem.of(decided)
    model = Model(
        structure.with_orders(joint.orders)
        .with_coefficients(problem.named(list(joint.coefficients.values())))
        .with_delays(joint.delays),
        orders={**known, **joint.orders},
        units={n: u for n, u in runs[0].units.items() if n in structure.signals},
        m=records[0].m,
        about={"method": "output-error", "runs": ", ".join(r.name for r in runs)},
    )
    comparison = compare(model, runs, m=records[0].m)
    initial = records[0].initial if isinstance(records[0].initial, str) else f"t^{list(records[0].initial)}"
    used = {
        "method": "output-error", "m": records[0].m, "initial": initial, "refinement": joint.refinement,
        "starts": len(joint.starts), "noise": joint.noise, "converged": joint.converged,
    }  # fmt: skip
    warnings = list(comparison.warnings) + _uncertain(joint, problem)
    warnings += [f"run {r.name}: {w}" for r in runs for w in r.warnings] + _unexcited(runs, structure)
    warnings += discretisation(model, comparison) + growing(model)
    tests, criteria = _judged(model, runs, len(joint.names))
    # That they are coloured is said already, with what it means for the intervals.
    warnings += [] if tests is None else [w for w in residual_warnings(tests, floor=ROUNDING) if "not white" not in w]
    model = _kept_with(model, "output-error", runs, comparison, criteria, warnings, joint, problem)
    return Identification(
        model, "output-error", comparison, {}, used, tuple(dict.fromkeys(warnings)), joint, tests, criteria,
        Task(tuple(runs), structure),
    )  # fmt: skip


def _identify_genetic(
    runs: Sequence[Run],
    structure: Structure,
    lattice: Lattice | None,
    settings: Genetic,
    norm: str,
    m: int | None,
    threads: int | None,
    progress: Callable[[int, int], None] | None,
) -> Identification:
    """Orders and coefficients by a genetic algorithm: each equation alone, or all under their order law."""
    parts = {"stage": structure} if structure.has_order_law else {
        e.output: structure.equation(e.output) for e in structure.equations
    }  # fmt: skip
    strange = [
        n for n in settings.bounds if all(n not in (*p.order_names, *p.coefficient_names) for p in parts.values())
    ]
    if strange:
        free = ", ".join(n for p in parts.values() for n in (*p.order_names, *p.coefficient_names))
        raise ModelError(f"bounds of {strange[0]!r}: there is no such number; free are {free}")
    orders: dict[str, float] = {}
    coefficients: dict[str, float] = {}
    about: dict[str, Any] = {"bounds": {}, "errors": {}, "evaluations": {}}
    records = prepare(runs, structure, m, power_of_two=True)
    for name, part in parts.items():
        own = {n: b for n, b in settings.bounds.items() if n in (*part.order_names, *part.coefficient_names)}
        found = genetic_search(
            prepare(runs, part, records[0].m, power_of_two=True), part, _lattice_of(lattice, part) or Lattice(),
            replace(settings, bounds=own), norm=norm, threads=threads, progress=progress,
        )  # fmt: skip
        orders |= found.orders
        coefficients |= found.coefficients
        about["bounds"] |= {n: list(b) for n, b in found.bounds.items()}
        about["errors"][name] = {str(seed): error for seed, error in found.errors.items()}
        about["evaluations"][name] = sum(found.evaluations.values())
    model = Model(
        structure.with_orders(orders).with_coefficients(coefficients),
        orders=orders,
        units={n: u for n, u in runs[0].units.items() if n in structure.signals},
        m=records[0].m,
        about={"method": "genetic", "runs": ", ".join(r.name for r in runs), "seeds": str(list(settings.seeds))},
    )
    comparison = compare(model, runs, m=records[0].m)
    warnings = [*comparison.warnings, *_broken_law(model)]
    for name, (low, high) in about["bounds"].items():
        value = {**orders, **coefficients}[name]
        if min(value - low, high - value) < 1e-3 * (high - low) and value not in (0.0, 2.0):
            warnings.append(f"{name} = {value:.4g} is on its bound for the genetic algorithm; widen it")
    for name, errors in about["errors"].items():
        low, high = min(errors.values()), max(errors.values())
        if high > SCATTERED * low:
            warnings.append(
                f"{name}: the seeds of the genetic algorithm end at errors from {low:.4g} to {high:.4g}; "
                "it has not found the optimum of each"
            )
    warnings += [f"run {r.name}: {w}" for r in runs for w in r.warnings] + _unexcited(runs, structure)
    warnings += discretisation(model, comparison) + growing(model)
    tests, criteria = _judged(model, runs, len(orders) + len(coefficients))
    warnings += [] if tests is None else residual_warnings(tests)
    used = {
        "method": "genetic", "norm": norm, "m": records[0].m, "initial": "rest", "seeds": list(settings.seeds),
        "population": settings.population, **about,
    }  # fmt: skip
    model = _kept_with(model, "genetic", runs, comparison, criteria, warnings)
    return Identification(
        model, "genetic", comparison, {}, used, tuple(dict.fromkeys(warnings)), residuals=tests,
        information=criteria, task=Task(tuple(runs), structure, lattice),
    )  # fmt: skip


def _uncertain(joint: JointFit, problem: FreeProblem) -> list[str]:
    """Say what the runs cannot tell."""
    warnings = []
    if not joint.converged:
        warnings.append("the fit ended before it stood still; its figures are provisional")
    if not joint.settled:
        warnings.append(
            f"at {joint.refinement} pulses a sample the step still moves estimates by over a tenth of their standard "
            "errors: the model is stiffer than the sampling; sample faster or trust its fast poles less"
        )
    errors = joint.standard_errors
    for (name, value), (low, high) in zip(joint.orders.items(), problem.bounds, strict=True):
        # Negated so that a standard error that is not a number counts as too large.
        if not errors[name] <= high - low:
            warnings.append(f"order {name} cannot be told from these runs: its standard error exceeds its bounds")
        elif min(value - low, high - value) < 1e-6 and high > low and value != 0:
            warnings.append(f"order {name} = {value:g} is on its bound; widen it")
    for signal, value in joint.delays.items():
        low, high = problem.structure.free_delays[signal]
        if not errors[delay_name(signal)] <= high - low:
            warnings.append(
                f"the delay of {signal} cannot be told from these runs: its standard error exceeds its bounds"
            )
        elif high - value < 1e-6 * (high - low) or (low > 0 and value - low < 1e-6 * (high - low)):
            warnings.append(f"the delay of {signal} = {value:g} s is on its bound; widen it")
    for name, value in joint.coefficients.items():
        if not errors[name] <= abs(value):
            warnings.append(
                f"coefficient {name} = {value:.4g} is not different from 0 in these runs "
                f"(standard error {errors[name]:.3g})"
            )
    correlation = joint.correlation
    for i, first in enumerate(joint.names):
        for j, second in enumerate(joint.names[:i]):
            if abs(correlation[i, j]) > INSEPARABLE:
                warnings.append(
                    f"{second} and {first} cannot be told apart in these runs (correlation {correlation[i, j]:.4f})"
                )
    coloured = sorted({o for run in joint.residuals for o, series in run.items() if not is_white(series)})
    if coloured:
        warnings.append(
            f"residuals of {', '.join(coloured)} are not white: the model leaves something out; "
            "standard errors allow for it"
        )
    return warnings


def _unexcited(runs: Sequence[Run], structure: Structure) -> list[str]:
    """Say so where no run alone has inputs rich enough for the free numbers of an equation."""
    lacking = [{f.signal: f.sentence for f in excitation_for(run, structure)} for run in runs]
    return [sentence for output, sentence in lacking[0].items() if all(output in other for other in lacking)]


def _check_lattice_names(given: Lattice | None, structure: Structure) -> None:
    for name in given.orders if given is not None else ():
        if name not in structure.order_names and name != "alpha":
            free = ", ".join(structure.order_names) or "none"
            raise ModelError(f"lattice order {name!r} is no free order; free are {free}")


def _lattice_of(given: Lattice | None, part: Structure) -> Lattice | None:
    if given is None:
        return None
    names = (*part.order_names, "alpha")
    return replace(given, orders={n: v for n, v in given.orders.items() if n in names})


def _estimate(
    runs: Sequence[Run], structure: Structure, settings: Settings, m: int | None
) -> tuple[dict[str, float], list[str], int, str, dict[str, float]]:
    """Coefficients by name at given orders, warnings, M, the initial terms in words, and standard errors if known."""
    records = prepare(runs, structure, m, power_of_two=settings.needs_haar)
    initial = initial_tuple(records[0].initial)
    words = records[0].initial if isinstance(records[0].initial, str) else f"t^{list(records[0].initial)}"
    cores = [r.core() for r in records]
    inputs = list(records[0].inputs)
    coefficients: dict[str, float] = {}
    warnings: list[str] = []
    if settings.coefficients == "instrumental-variables":
        coefficients, errors, warnings = _instrumental(structure, records)
        return coefficients, warnings, records[0].m, str(words), errors
    for item in structure.equations:
        fixed = [t.fixed for t in item.terms]
        core_structure = structure_tuple(item, records[0].signals)
        if settings.coefficients == "least-squares":
            raw, _, _, _ = _core.least_squares(cores, core_structure, inputs, fixed, initial)
        else:
            (raw, _, _, _), _ = _core.multi_innovation(
                cores, core_structure, inputs, fixed, initial, settings.innovation_length, settings.prior_covariance,
                settings.rows == "haar", False,
            )  # fmt: skip
            # A prior so weak that the data alone decide.
            weak, _ = _core.multi_innovation(
                cores, core_structure, inputs, fixed, initial, settings.innovation_length,
                min(settings.prior_covariance * 1e12, 1e300), settings.rows == "haar", False,
            )  # fmt: skip
            warnings += _pulled(item.output, raw, weak[0], settings)
        coefficients |= named_coefficients(item, raw)
    return coefficients, warnings, records[0].m, str(words), {}


def _instrumental(structure: Structure, records: list[Record]) -> tuple[dict[str, float], dict[str, float], list[str]]:
    """Coefficients by refined instrumental variables, their standard errors at these orders, and warnings.

    Equations that drive each other are simulated together, so that every instrument follows from the inputs alone.
    """
    initial, inputs = initial_tuple(records[0].initial), list(records[0].inputs)
    groups = [structure.equations] if structure.coupling == "simulated" else [(e,) for e in structure.equations]
    coefficients: dict[str, float] = {}
    errors: dict[str, float] = {}
    warnings: list[str] = []
    for group in groups:
        outputs = ", ".join(e.output for e in group)
        estimates, covariances, iterations, converged, damped = _core.instrumental_variables(
            [r.core() for r in records], [structure_tuple(e, records[0].signals) for e in group], inputs,
            [[t.fixed for t in e.terms] for e in group], initial, REFINEMENTS, STILL,
        )  # fmt: skip
        if not converged:
            warnings.append(
                f"{outputs}: instrumental variables did not stand still in {iterations} steps; the coefficients are "
                "those of the least output error met. Too much noise for these terms: use method='output-error'"
            )
        if damped:
            warnings.append(f"{outputs}: the free run of these coefficients is unstable; do not trust them")
        for item, (raw, _, _, _), covariance in zip(group, estimates, covariances, strict=True):
            coefficients |= named_coefficients(item, raw)
            free = [t for t in item.terms if t.fixed is None]
            spread = np.sqrt(np.diag(np.reshape(covariance, (len(free), len(free)))))
            pairs = zip(free, spread.tolist(), strict=True)
            errors |= {t.coefficient: s / abs(t.factor) for t, s in pairs if isinstance(t.coefficient, str)}
    return coefficients, errors, warnings


def _step_bias(
    runs: Sequence[Run],
    structure: Structure,
    settings: Settings,
    m: int,
    coefficients: Mapping[str, float],
    errors: Mapping[str, float],
) -> list[str]:
    """Say so where the step of the pulses moves coefficients by more than noise does.

    The scheme is of second order, so of the move from twice the step a third is left (Richardson).
    """
    if not errors or m < 2 * LEAST_PULSES:
        return []
    try:
        coarser, *_ = _estimate(runs, structure, settings, m // 2)
    except FtlmError:
        # A step that leaves no estimate tells nothing about half of it.
        return []
    moved = {n: abs(coarser[n] - coefficients[n]) / 3 / e for n, e in errors.items() if e > 0}
    worst = max(moved, key=lambda n: moved[n], default="")
    if not worst or moved[worst] <= STEP_BIAS:
        return []
    carried = min(run.length - 1 for run in runs)
    finer = f"raise m, up to {carried}, or " if m < carried else ""
    # Far from the limit a third of the move says no more than that it is large.
    amount = f"about {moved[worst]:.2g}" if moved[worst] <= 10 else "more than 10"
    return [
        f"at {m} pulses the step alone moves coefficient {worst} by {amount} standard errors, which do "
        f"not count it; {finer}use method='output-error', which refines the step"
    ]


def _pulled(output: str, raw: list[float], weak: list[float], settings: Settings) -> list[str]:
    """Say so where the prior, not the data, decides the size of a coefficient."""
    shares = [abs(a - b) / abs(b) for a, b in zip(raw, weak, strict=True) if b]
    worst = max(shares, default=0.0)
    if worst <= PULLED:
        return []
    return [
        f"{output}: the prior (K0 = {settings.prior_covariance:g}, coefficients near 0) moves a coefficient by "
        f"{100 * min(worst, 9.99):.0f} % from what the data alone say; p = {settings.innovation_length} only weighs "
        "the data against it. Raise prior_covariance or use method='least-squares'"
    ]


def _broken_law(model: Model) -> list[str]:
    """Distance of freely estimated coefficients from the coefficient law, in words."""
    law, values = model.structure.coefficient_law, model.coefficients
    warnings = []
    for name, sign, factors in law:
        known = [values[f] for f in factors if f in values]
        if name not in values or len(known) != len(factors):
            continue
        wanted = sign * math.prod(known)
        if abs(values[name] - wanted) > LAW_BROKEN * max(abs(wanted), abs(values[name])):
            warnings.append(
                f"coefficient law: {name} = {values[name]:.4g}, but the other equation gives {wanted:.4g}; "
                "the equation-error estimators do not impose the law"
            )
    ratios: dict[str, list[tuple[str, float]]] = {}
    for name, sign, factors in law:
        free = [f for f in factors if f not in values]
        known = [values[f] for f in factors if f in values]
        rest = math.prod(known)
        if name in values and len(free) == 1 and known and rest:
            ratios.setdefault(free[0], []).append((name, sign * values[name] / rest))
    for ratio, found in ratios.items():
        wrong = [(n, v) for n, v in found if not v > 1]
        if wrong:
            listed = ", ".join(f"{v:.4g} by {n}" for n, v in wrong)
            warnings.append(f"coefficient law: the inertia ratio {ratio} must exceed 1, but is {listed}")
    return warnings


def discretisation(model: Model, comparison: Comparison) -> list[str]:
    """Warn where the block-pulse scheme itself is unstable at this number of pulses.

    An own-output order alpha - nu > 1 of a stiff equation gives the scheme a mode at its Nyquist frequency that the
    model does not have.
    """
    warnings = []
    for item in model.equations:
        own = [
            (float(t.fixed or 0.0), item.order.constant - t.order.constant)
            for t in item.terms
            if t.signal == item.output
        ]
        margin = min(_core.nyquist_margin(own, step) for step in comparison.step)
        if margin <= 0:
            warnings.append(
                f"{item.output}: at {comparison.m} pulses the discretisation itself is unstable (margin {margin:.2g}), "
                "whether or not the model is; raise m"
            )
    return warnings


def growing(model: Model) -> list[str]:
    """Warn of poles with a positive real part: within one run the input may hide what they do, later nothing does."""
    found = model.stability(coupling=model.structure.coupling)
    if not found.unstable_poles > 0:
        return []
    return [f"the model is {found}: its free run grows without bound, however well it fits a run of this length"]


@dataclass(frozen=True)
class Trace:
    """How the recursion (44) converged on one equation.

    Parameters
    ----------
    step
        Steps at which the rest is given, from 1.
    coefficients
        By name, after each of these steps.
    error
        Error (45) of the free run of the model after each of these steps, at rest; infinite where it diverged.
    innovation_length
        p.
    """

    step: NDArray[np.int64]
    coefficients: dict[str, NDArray[np.float64]]
    error: NDArray[np.float64]
    innovation_length: int


def multi_innovation_trace(
    run: Run,
    equation: Structure,
    *,
    innovation_length: int = 7,
    prior_covariance: float = 1.0,
    rows: Literal["haar", "time"] = "haar",
    m: int | None = None,
    every: int = 1,
) -> Trace:
    """Run the recursion (44) step by step: coefficients, and error (45) of the model they make, after every step.

    Parameters
    ----------
    run
        One run that starts at rest.
    equation
        One equation whose orders are numbers.
    innovation_length, prior_covariance, rows, m
        See :func:`identify`.
    every
        Give every n-th step (and the last).

    Returns
    -------
    Trace
        The last row equals the closed form to rounding.

    Raises
    ------
    ModelError
        More than one equation, free orders, settings out of range.

    Notes
    -----
    O(m k^3) for the recursion and one division of series for each step given.
    """
    settings = Settings.check("output-error", "l1", "multi-innovation", innovation_length, prior_covariance, rows, 1, 1)
    if len(equation.equations) != 1 or equation.order_names:
        raise ModelError("a trace needs one equation whose orders are numbers; use .equation(…).with_orders(…)")
    stride = whole_number(every)
    if stride is None or stride < 1:
        raise ModelError(f"every = {every!r} is no whole number from 1; 1 gives every step")
    rest = replace(equation, initial="rest")
    rec = prepare([run], rest, m, power_of_two=settings.needs_haar)[0]
    item = equation.equations[0]
    core_structure = structure_tuple(item, rec.signals)
    inputs = list(rec.inputs)
    _, trace = _core.multi_innovation(
        [rec.core()], core_structure, inputs, [t.fixed for t in item.terms], (False, []),
        settings.innovation_length, settings.prior_covariance, settings.rows == "haar", True,
    )  # fmt: skip
    if trace is None:
        raise InternalError("the recursion gave no trace; please report it")
    step = np.unique(np.append(np.arange(stride, trace.shape[0] + 1, stride), trace.shape[0]))
    kept = np.ascontiguousarray(trace[step - 1])
    error = _core.trace_errors(rec.core(), core_structure, inputs, kept)
    names = {t.coefficient: kept[:, k] / t.factor for k, t in enumerate(item.terms) if isinstance(t.coefficient, str)}
    return Trace(step, names, error, settings.innovation_length)
