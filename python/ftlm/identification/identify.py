"""From measured runs to a model: orders, coefficients, both errors and what to beware of."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import Literal

from ftlm.base.errors import DataError, ModelError
from ftlm.data.lattice import Lattice, check_lattice, check_lattice_names
from ftlm.data.run import Run
from ftlm.data.settings import Settings
from ftlm.data.several import as_runs
from ftlm.data.solved import Estimate
from ftlm.data.structures import Structure, check_offset
from ftlm.fit.genetic import Genetic
from ftlm.identification.estimate import Fit, by_genetic_algorithm, by_lattice, by_output_error
from ftlm.identification.judged import Task
from ftlm.identification.result import Identification
from ftlm.identification.warnings import discretisation, growing, unexcited
from ftlm.judge.comparison import Comparison, compare
from ftlm.judge.criteria import InformationCriteria, information_criteria
from ftlm.judge.metrics import finite
from ftlm.judge.residuals import Residuals, resid, residual_warnings

METHODS = ("output-error", "instrumental-variables", "multi-innovation", "least-squares", "genetic")
#: Residuals of an output-error fit below this share of the output are rounding and discretisation.
ROUNDING = 3e-5


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
    offset: Literal["none", "constant", "ramp"] | None = None,
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
    offset
        ``"constant"``: an unknown constant on the right-hand side of each equation, such as a sensor's zero, a load or
        friction that the model lacks; ``"ramp"``: one that drifts in proportion to time as well. One each run, in
        ``.comparison.offsets``, estimated anew on any run that the model is judged on. Default what the structure says.

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
    several = as_runs(runs)
    if method not in METHODS:
        raise ModelError(f"method = {method!r} is not known; use {' or '.join(map(repr, METHODS))}")
    if not isinstance(structure, Structure):
        raise ModelError(f"structure is {type(structure).__name__}; use ftlm.equation(…) or ftlm.flexible_link(…)")
    if offset is not None:
        structure = replace(structure, offset=check_offset(offset))
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
    task = Task(tuple(several), structure, lattice)
    if method == "output-error":
        return judged(by_output_error(task, m, settings.threads, progress))
    if method == "genetic":
        return judged(by_genetic_algorithm(task, genetic or Genetic(), norm, m, settings.threads, progress))
    if executor is not None and threads is None:
        settings = replace(settings, threads=1)
    return judged(by_lattice(task, settings, m, progress, store, executor))


def judged(fit: Fit) -> Identification:
    """Both errors, residual tests, information criteria and everything that makes a fit doubtful."""
    runs, model = fit.task.runs, fit.model
    comparison = compare(model, runs, m=model.m)
    warnings = [*comparison.warnings, *fit.warnings]
    warnings += [f"run {r.name}: {w}" for r in runs for w in r.warnings] + unexcited(runs, fit.task.structure)
    warnings += discretisation(model, comparison) + growing(model)
    tests, criteria = None, None
    try:
        tests = resid(model, runs)
        criteria = information_criteria(tests, fit.parameters)
    except DataError:
        # A run that is too short for correlations; everything else can be told.
        pass
    warnings += [] if tests is None else _residual_warnings(fit, tests)
    unique = tuple(dict.fromkeys(warnings))
    model = replace(model, estimate=_estimate(fit, comparison, criteria, unique))
    return Identification(
        model, fit.method, comparison, fit.searches, fit.settings, unique, fit.joint, tests, criteria, fit.task,
        fit.errors,
    )  # fmt: skip


def _residual_warnings(fit: Fit, tests: Residuals) -> list[str]:
    """Failed tests; of a joint fit it is said already that residuals are coloured, and what that means."""
    if fit.joint is None:
        return residual_warnings(tests)
    return [w for w in residual_warnings(tests, floor=ROUNDING) if "not white" not in w]


def _estimate(
    fit: Fit, comparison: Comparison, criteria: InformationCriteria | None, warnings: tuple[str, ...]
) -> Estimate:
    """What a model's file keeps of its identification."""
    joint, values, errors = fit.joint, dict(fit.model.orders), {}
    if joint is not None:
        values = dict(zip(joint.names, joint.values.tolist(), strict=True))
        errors = {n: finite(v) for n, v in joint.standard_errors.items()}
    return Estimate(
        method=fit.method,
        runs=tuple(r.name for r in fit.task.runs),
        values={n: float(v) for n, v in {**values, **fit.model.coefficients}.items()},
        standard_errors=errors,
        covariance=fit.covariance,
        fit={n: finite(f) for n, f in comparison.fit_percent.items()},
        information={} if criteria is None else {n: finite(getattr(criteria, n)) for n in ("aic", "aicc", "bic")},
        warnings=warnings,
    )
