"""From measured runs to a model: orders, coefficients, both errors and what to beware of."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from ftlm.base.checks import check_threads
from ftlm.base.errors import DataError, FtlmError, ModelError
from ftlm.data.lattice import Lattice, check_lattice, check_lattice_names, lattice_of
from ftlm.data.run import Run
from ftlm.data.settings import Settings
from ftlm.data.several import as_runs
from ftlm.data.solved import Estimate
from ftlm.data.structures import Structure
from ftlm.fit.coefficients import estimate_coefficients, step_bias
from ftlm.fit.genetic import Genetic, genetic_search
from ftlm.fit.joint import JointFit, fit_output_error
from ftlm.fit.problem import FreeProblem
from ftlm.identification.judged import Task
from ftlm.identification.result import Identification
from ftlm.identification.warnings import broken_law, discretisation, growing, uncertain, unexcited
from ftlm.judge.comparison import Comparison, compare
from ftlm.judge.criteria import InformationCriteria, information_criteria
from ftlm.judge.residuals import Residuals, resid, residual_warnings
from ftlm.model.model import Model
from ftlm.search.job import run_job
from ftlm.search.orders import make_job
from ftlm.search.result import SearchResult
from ftlm.search.store import Store
from ftlm.solve.records import prepare

METHODS = ("output-error", "instrumental-variables", "multi-innovation", "least-squares", "genetic")
#: Most pulses a run on which instrumental variables end where m is not given.
MOST_PULSES = 1 << 14
#: Residuals of an output-error fit below this share of the output are rounding and discretisation.
ROUNDING = 3e-5
#: Seeds of the genetic algorithm whose errors differ by more than this factor have not all found the optimum.
SCATTERED = 1.2


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
    check_lattice_names(lattice, structure)
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
                found, part, lattice_of(lattice, part), criterion=criterion, coefficients=method, norm=norm,
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
    coefficients, pulled, pulses, initial, spread = estimate_coefficients(found, structure_at, settings, m)
    pulled += step_bias(found, structure_at, settings, pulses, coefficients, spread)
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
    warnings = list(comparison.warnings) + pulled + broken_law(model)
    for search in searches.values():
        warnings += [f"order {n} = {v:g} is on the edge of its interval; widen it" for n, v in search.edges.items()]
    warnings += [f"run {r.name}: {w}" for r in found for w in r.warnings] + unexcited(found, structure)
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
            coefficients, _, pulses, _, _ = estimate_coefficients(runs, structure_at, settings, m)
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
    warnings = list(comparison.warnings) + uncertain(joint, problem)
    warnings += [f"run {r.name}: {w}" for r in runs for w in r.warnings] + unexcited(runs, structure)
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
            prepare(runs, part, records[0].m, power_of_two=True), part, lattice_of(lattice, part) or Lattice(),
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
    warnings = [*comparison.warnings, *broken_law(model)]
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
    warnings += [f"run {r.name}: {w}" for r in runs for w in r.warnings] + unexcited(runs, structure)
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
