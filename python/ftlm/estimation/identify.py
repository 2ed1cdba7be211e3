"""Decision about offsets of the equations: tested on request, otherwise reported by a warning."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, as_completed
from dataclasses import dataclass, replace
from typing import Any, Literal

import msgspec
import numpy as np
from msgspec import UNSET

from ftlm.data.run import Run, as_runs
from ftlm.errors import ConvergenceError, DataError, FtlmError, InternalError, ModelError
from ftlm.estimation.closed_loop import instrument_runs, mark_reference_fit
from ftlm.estimation.estimators import Fit, estimate_genetic, estimate_order_search, estimate_output_error
from ftlm.estimation.genetic import Genetic
from ftlm.estimation.model_checks import (
    dead_channel_warnings,
    discretization_warnings,
    excitation_warnings,
    friction_direction_warnings,
    stability_warnings,
    stribeck_warnings,
)
from ftlm.estimation.nuisance_parameters import (
    DEFAULT_PULSES_PER_SAMPLE,
    OffsetTest,
    fit_without_history,
    offset_test,
    unrequested_offset_warnings,
)
from ftlm.estimation.output_error import parameter_set
from ftlm.estimation.result import Identification, Task
from ftlm.estimation.verdict import result_findings, saved_findings
from ftlm.model.model import Estimate, Model
from ftlm.order_search.options import (
    INTERVAL_CHOICES,
    LOSS_CHOICES,
    METHOD_CHOICES,
    Intervals,
    Loss,
    Settings,
    check_options_used,
)
from ftlm.simulation.discretization import default_m
from ftlm.structure.order_grid import OrderGrid, check_order_grid, check_order_grid_names
from ftlm.structure.structure import History, Structure, check_offset
from ftlm.utils.files import PACKAGE_LOGGER
from ftlm.utils.statistics import NEGLIGIBLE_RESIDUAL_SHARE
from ftlm.utils.validation import check_choice
from ftlm.validation.comparison import Comparison, compare_samples, finite, simulate_runs
from ftlm.validation.information_criteria import InformationCriteria, information_criteria
from ftlm.validation.residual_tests import DEFAULT_LAGS, Residuals, residual_warnings, run_residual_tests

#: Largest number of samples with which an offset is tested without request: the test stores a sensitivity of each
#: parameter at every sample.
MAX_OFFSET_TEST_SAMPLES = 400_000


def fit_with_offset_decision(runs: Sequence[Run], structure: Structure, estimate: Callable[[Structure], Fit]) -> Fit:
    """Fit a structure; under ``offset="auto"`` with a constant if the offset test is significant.

    The constant is fitted first, because a fit that lacks a needed constant may end anywhere.
    """
    if structure.offset != "auto":
        fit = estimate(structure)
        # Where a body may stick, what a constant does is no sensitivity alone: it decides where the body rests.
        if structure.offset != "none" or structure.has_friction or not _is_testable(fit.task.runs):
            return fit
        said = unrequested_offset_warnings(fit_offset_test(fit), fit.model.outputs) or _history_offset_warnings(fit)
        return replace(fit, warnings=[*fit.warnings, *said])
    try:
        asked = replace(structure, offset="constant")
    except ModelError as error:
        # One of the initial terms that were given is what an offset integrates to.
        return _with_offset_decision(estimate(replace(structure, offset="none")), f"none: {error}")
    twin = constant_input(runs, structure)
    if twin is not None:
        words = f"none: {twin} is constant on every run, which an offset cannot be told from"
        return _with_offset_decision(estimate(replace(structure, offset="none")), words)
    fit = estimate(asked)
    test = fit_offset_test(fit)
    if test is not None and test.exceeds():
        return _with_offset_decision(fit, test.decision)
    decision = "none: its test has no finite free run" if test is None else test.decision
    return _with_offset_decision(estimate(replace(structure, offset="none")), decision)


def _history_offset_warnings(fit: Fit) -> list[str]:
    """Return a warning if a constant explains the data as well as a history of initial terms.

    A constant is part of the model, whereas initial terms hold for one run only.
    """
    joint, structure = fit.joint, fit.task.structure
    if joint is None or structure.initial != "auto" or not isinstance(joint.initial, History):
        return []
    few = fit_without_history(joint, fit.task.runs, structure)
    if few is None:
        return []
    less = joint.initial_terms - few.initial_terms
    return [
        f"what {', '.join(fit.model.outputs)} did before the runs is estimated with {joint.initial_terms} powers of "
        f"time; an unknown constant in the equation explains as much with {less} numbers fewer: if a sensor's zero, a "
        "load or a mean may be there, offset='auto' estimates it"
    ]


def constant_input(runs: Sequence[Run], structure: Structure) -> str | None:
    """Return an input with a free coefficient that is constant on every run, or None."""
    for item in structure.equations:
        for term in item.terms:
            plain = term.fixed is None and not term.order.names and term.order.constant == 0
            if plain and all(term.signal in r.inputs and float(np.ptp(r[term.signal])) == 0.0 for r in runs):
                return term.signal
    return None


def fit_offset_test(fit: Fit) -> OffsetTest | None:
    """Return the offset test at a fit, with or without an offset; None if not available."""
    structure = replace(fit.task.structure, offset="none")
    if fit.joint is not None:
        values = dict(zip(fit.joint.names, fit.joint.values.tolist(), strict=True))
        asked = replace(structure, initial=fit.joint.initial)
        return offset_test(fit.task.runs, asked, values, every=fit.joint.refinement)
    if fit.method == "genetic":
        return None
    values = {**fit.model.orders, **fit.model.coefficients}
    return offset_test(fit.task.runs, replace(structure, coefficient_law=()), values, every=DEFAULT_PULSES_PER_SAMPLE)


def _with_offset_decision(fit: Fit, decision: str) -> Fit:
    return replace(fit, settings={**fit.settings, "offset_test": decision})


def _is_testable(runs: tuple[Run, ...]) -> bool:
    return sum(run.length for run in runs) <= MAX_OFFSET_TEST_SAMPLES


def identify(
    runs: Run | Sequence[Run],
    structure: Structure,
    *,
    method: Literal[
        "output-error", "instrumental-variables", "multi-innovation", "least-squares", "genetic"
    ] = "output-error",
    criterion: Literal["output-error", "equation-error"] | None = None,
    order_grid: OrderGrid | None = None,
    norm: Literal["l1", "l2"] | None = None,
    innovation_length: int | None = None,
    prior_covariance: float | None = None,
    row_basis: Literal["haar", "time"] | None = None,
    m: int | None = None,
    top: int | None = None,
    genetic: Genetic | None = None,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    store: str | os.PathLike[str] | None = None,
    executor: Executor | None = None,
    offset: Literal["none", "constant", "ramp", "auto"] | None = None,
    reference: str | None = None,
    loss: Loss | None = None,
    intervals: Intervals | None = None,
    start: Identification | Model | Mapping[str, float] | None = None,
) -> Identification:
    """Identify a structure from measured runs.

    ``"output-error"`` estimates continuous orders and coefficients together, with confidence intervals and automatic
    initialization. The equation-error methods search free orders on the order grid: each equation by itself, or all
    together under an order law. They then estimate the coefficients at these orders. An option that the method does not
    use raises ModelError; None means that an option is not given.

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
    criterion, order_grid, norm, top
        Of the order search, by default ``"output-error"``, every lattice of :func:`ftlm.lattice`'s own, ``"l1"`` and
        20; see :func:`ftlm.search_orders`. Refused by ``"output-error"``, whose bounds are the structure's own, and
        where every order is a number. ``"genetic"`` uses lattice (its bounds) and norm.
    threads, progress
        Threads, by default all cores, and what is called with (work done, work in all).
    innovation_length, prior_covariance, row_basis
        p, K0 and the coordinates of paper (42)-(44), by default 7, 1 and ``"haar"``; of ``"multi-innovation"`` alone. p
        is a weight of the data against the prior, nothing else.
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
        ``.comparison.offsets``, estimated anew on any run that the model is judged on; beside a history (a run that
        starts in motion) it is estimated, but cannot be told from it. ``"auto"``: a constant where the
        runs ask for one at 99 %, none where they do not, with the statistic in ``.settings["offset_test"]``; it fits
        once with the constant and, where none is asked for, once without. Default what the structure says. Where it
        says none and a constant would explain much, a warning does.
    reference
        Name of a signal of the runs that drives a closed loop from outside, such as its set point: the instrument of
        ``"output-error"``. Residuals are then made orthogonal to what the part of every input that follows the
        reference does, which noise that the loop feeds back is no part of.
    loss
        Of output error: ``"squares"`` (default), or ``"huber"``, which counts residuals beyond 1.345 of the usual ones
        by their size, so that outliers decide nothing; without any it has 95 % of the precision. Figures stay those of
        all samples.
    intervals
        Of output error: ``"quadratic"``, estimate ± 1.96 standard errors, true where the cost is a parabola;
        ``"profile"``, by profile likelihood for every number, some ten to a hundred free runs each;
        ``"auto"`` (default), by profile likelihood for the numbers for which two free runs each say that the quadratic
        picture is off by over a tenth. See :meth:`ftlm.Identification.profile`.

    start
        Of output error: what is known already, from where it starts besides its automatic starts, so that it never
        ends with a larger cost than one gets from there: an identification or a model of the same outputs, simpler or
        not, or values of free numbers by name. What it does not have starts at the coefficient 0; an order that is
        free now and was a number there starts at that number.

    Returns
    -------
    Identification
        Prints well; ``.model`` simulates, compares and saves.

    Raises
    ------
    DataError
        Runs that do not fit the structure, or a constant output; a reference that is not there or does not move; a
        store of other searches, in use, damaged, or that cannot be written.
    ModelError
        A method that is not known, an option that it does not use, a lattice without or with too many candidates,
        settings out of range, a store or an executor without an order search, a store with ``offset="auto"``, a start
        that has none of the free numbers, others, or values out of their bounds.
    ConvergenceError
        Regressors that cannot be told apart at the given orders, or an executor that has lost its workers.
    """
    several = as_runs(runs)
    check_choice("method", method, METHOD_CHOICES)
    if not isinstance(structure, Structure):
        raise ModelError(f"structure is {type(structure).__name__}; use ftlm.equation(…) or ftlm.flexible_link(…)")
    if offset is not None:
        structure = replace(structure, offset=check_offset(offset))
    if structure.has_friction:
        _check_friction(structure, method, reference)
    check_order_grid(order_grid)
    check_order_grid_names(order_grid, structure)
    if not (genetic is None or isinstance(genetic, Genetic)):
        raise ModelError(f"genetic is {type(genetic).__name__}, not Genetic; use ftlm.Genetic(seeds=…)")
    words: dict[str, Any] = {
        "criterion": criterion,
        "norm": norm,
        "innovation_length": innovation_length,
        "prior_covariance": prior_covariance,
        "rows": row_basis,
        "keep": top,
    }
    words = {n: value for n, value in words.items() if value is not None}
    if loss is not None:
        check_choice("loss", loss, LOSS_CHOICES)
    if intervals is not None:
        check_choice("intervals", intervals, INTERVAL_CHOICES)
    if intervals == "profile" and reference is not None:
        raise ModelError(
            "intervals='profile' needs a cost that has its minimum at the estimate, and reference= has none; use "
            "intervals='quadratic', or leave it out"
        )
    others = {
        "loss": loss,
        "intervals": intervals,
        "lattice": order_grid,
        "genetic": genetic,
        "store": store,
        "executor": executor,
        "reference": reference,
        "start": start,
    }
    given = [*(n for n, value in others.items() if value is not None), *words]
    estimator = "least-squares" if method in ("output-error", "genetic") else method
    settings = Settings.check(coefficients=estimator, threads=threads, **words)
    check_options_used(method, given, free=bool(structure.order_names))
    if executor is not None and threads is None:
        settings = replace(settings, threads=1)
    if structure.offset == "auto" and store is not None:
        raise ModelError(
            "offset='auto' may need two searches, and a store keeps those of one; use offset='none' or "
            "offset='constant' with store="
        )
    if not (start is None or isinstance(start, (Identification, Model, Mapping))):
        raise ModelError(f"start is {type(start).__name__}; give an identification, a model, or values by name")
    begin = start.model if isinstance(start, Identification) else start
    more = start.parameter_values if isinstance(start, Identification) else {}
    answers, weak = (None, []) if reference is None else instrument_runs(several, structure, reference)

    def estimate(asked: Structure) -> Fit:
        task = Task(tuple(several), asked, order_grid)
        if method == "output-error":
            return estimate_output_error(
                task, m, settings.threads, progress, answers, loss or "squares", intervals or "auto", begin, more
            )
        if method == "genetic":
            return estimate_genetic(task, genetic or Genetic(), settings.norm, m, settings.threads, progress)
        return estimate_order_search(task, settings, m, progress, store, executor)

    PACKAGE_LOGGER.info("identifying %s from %s by %s", structure.name, ", ".join(r.name for r in several), method)
    fit = fit_with_offset_decision(several, structure, estimate)
    if reference is not None:
        fit = mark_reference_fit(fit, reference, weak)
    result = assess_fit(fit)
    PACKAGE_LOGGER.info("identified: %s", result.verdict())
    for warning in result.warnings:
        PACKAGE_LOGGER.warning("%s", warning)
    return result


def _check_friction(structure: Structure, method: str, reference: str | None) -> None:
    """Raise ModelError for options that do not support friction."""
    words = f"the equation of {structure.outputs[structure.friction_equations[0]]} has friction, which"
    if method != "output-error":
        raise ModelError(f"{words} method={method!r} does not know; use method='output-error'")
    if reference is not None:
        raise ModelError(f"{words} the instrument reference={reference!r} does not know; leave one of the two out")
    if structure.offset == "auto":
        raise ModelError(
            f"{words} the test of offset='auto' does not know; use offset='constant', whose interval says whether it "
            "is 0, or offset='none'"
        )


def assess_fit(fit: Fit) -> Identification:
    """Validate a fit: both errors, residual tests, information criteria and warnings."""
    runs, model = as_runs(fit.task.runs), fit.model
    free = simulate_runs(model, runs)
    comparison = compare_samples(model, runs, free, m=model.m or default_m(runs, power_of_two=False))
    warnings = [*comparison.warnings, *fit.warnings]
    warnings += [f"run {r.name}: {w}" for r in runs for w in r.warnings]
    warnings += dead_channel_warnings(runs, fit.task.structure) + excitation_warnings(runs, fit.task.structure)
    warnings += (
        discretization_warnings(model, comparison)
        + stability_warnings(model)
        + friction_direction_warnings(model, free)
        + stribeck_warnings(model, runs, free)
    )
    tests, criteria = None, None
    try:
        tests = run_residual_tests(model, runs, free, lags=DEFAULT_LAGS)
        criteria = information_criteria(tests, fit.parameters)
    except DataError:
        # A run that is too short for correlations; everything else can be told.
        pass
    warnings += [] if tests is None else _residual_warnings(fit, tests)
    unique = tuple(dict.fromkeys(warnings))
    known = _estimate(fit, comparison, criteria, unique)
    result = Identification(
        replace(model, estimate=known),
        fit.method,
        comparison,
        fit.searches,
        fit.settings,
        unique,
        fit.joint,
        tests,
        criteria,
        fit.task,
        fit.errors,
    )
    against = tuple(result_findings(result))
    if not (against or saved_findings(known)):
        return result
    # Warnings alone do not say what weighs, so the file does.
    return replace(result, model=replace(model, estimate=msgspec.structs.replace(known, against=against)))


def _residual_warnings(fit: Fit, tests: Residuals) -> list[str]:
    """Return warnings of failed residual tests; a joint fit already reports colored residuals."""
    if "reference" in fit.settings:
        # The loop is known, and its noise is no part of what the model was estimated from.
        tests = replace(tests, outputs={n: replace(o, feedback_tests={}) for n, o in tests.outputs.items()})
    if fit.joint is None:
        return residual_warnings(tests)
    return [
        w for w in residual_warnings(tests, floor=NEGLIGIBLE_RESIDUAL_SHARE) if "residuals are not white (" not in w
    ]


def _estimate(
    fit: Fit, comparison: Comparison, criteria: InformationCriteria | None, warnings: tuple[str, ...]
) -> Estimate:
    """Return the estimate that the model file stores."""
    joint, values, errors = fit.joint, dict(fit.model.orders), {}
    if joint is not None:
        values = dict(zip(joint.names, joint.values.tolist(), strict=True))
        errors = {n: finite(v) for n, v in joint.standard_errors.items()}
    profiles = {} if joint is None else {n: (finite(p.low), finite(p.high)) for n, p in joint.profiles.items()}
    return Estimate(
        method=fit.method,
        runs=tuple(r.name for r in fit.task.runs),
        values={n: float(v) for n, v in {**values, **fit.model.coefficients}.items()},
        standard_errors=errors,
        covariance=fit.covariance,
        fit={n: finite(f) for n, f in comparison.fit_percent.items()},
        information={} if criteria is None else {n: finite(getattr(criteria, n)) for n in ("aic", "aicc", "bic")},
        warnings=warnings,
        intervals=profiles or UNSET,
        free=UNSET if joint is None else parameter_set(joint, fit.task.structure),
    )


@dataclass(frozen=True)
class BatchResult:
    """Result of one item of a batch identification.

    Parameters
    ----------
    name
        Names of its runs.
    result
        The identification, or None.
    error
        The error that stopped it, or None.
    """

    name: str
    result: Identification | None
    error: FtlmError | None

    def __str__(self) -> str:
        return f"{self.name}\n{self.result}" if self.error is None else f"{self.name}: {self.error}"


def identify_one(
    runs: Run | Sequence[Run], structure: Structure, options: dict[str, Any]
) -> tuple[Identification | None, FtlmError | None]:
    """Identify one item and return its result or error."""
    try:
        return identify(runs, structure, **options), None
    except FtlmError as error:
        return None, error
    except Exception as error:  # the others must go on
        return None, InternalError(f"internal fault: {type(error).__name__}: {error}; please report it")


def identify_many(
    runs: Sequence[Run | Sequence[Run]],
    structure: Structure,
    *,
    executor: Executor | None = None,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> list[BatchResult]:
    """Identify each of many runs separately.

    Parameters
    ----------
    runs
        Runs, or sequences of runs that are fitted together.
    structure
        Structure to identify, the same for all.
    executor
        Any :class:`concurrent.futures.Executor`, such as processes or ``dask.distributed.Client(…).get_executor()``.
        Each run is sent to one worker, with one thread by default. None: one after the other in this process.
    progress
        Callback with (runs done, total runs).
    **options
        Options of :func:`ftlm.identify` except `store`.

    Returns
    -------
    list of BatchResult
        Results in the order of the runs, each an identification or an error.

    Raises
    ------
    ModelError
        No runs, an item that is no run, or a store.
    KeyboardInterrupt
        Ctrl-C.
    """
    items = [runs] if isinstance(runs, Run) else list(runs)
    names = []
    for number, item in enumerate(items):
        group = [item] if isinstance(item, Run) else list(item) if isinstance(item, Sequence) else []
        if not group or not all(isinstance(r, Run) for r in group):
            raise ModelError(f"item {number} of {len(items)} is neither a run nor runs; load it with ftlm.load")
        names.append(", ".join(r.name for r in group))
    if not items:
        raise ModelError("there are no runs; give at least one")
    if options.get("store") is not None:
        raise ModelError("a store keeps one identification; call identify for each run with a store of its own")
    if executor is None:
        every = []
        for name, item in zip(names, items, strict=True):
            every.append(BatchResult(name, *identify_one(item, structure, options)))
            if progress is not None:
                progress(len(every), len(items))
        return every
    options = {"threads": 1, **options}
    pending: list[Future[Any]] = []
    try:
        for item in items:
            try:
                pending.append(executor.submit(identify_one, item, structure, options))
            except (BrokenExecutor, RuntimeError) as error:
                lost: Future[Any] = Future()
                lost.set_exception(error)
                pending.append(lost)
        if progress is not None:
            for done, _ in enumerate(as_completed(pending), 1):
                progress(done, len(items))
        return [BatchResult(name, *_future_result(future)) for name, future in zip(names, pending, strict=True)]
    finally:
        for future in pending:
            future.cancel()


def _future_result(future: Future[Any]) -> tuple[Identification | None, FtlmError | None]:
    """Return the result of a worker, or a ConvergenceError if the executor failed."""
    try:
        pair: tuple[Identification | None, FtlmError | None] = future.result()
    except (Exception, CancelledError) as error:
        what = f"{type(error).__name__}: {error}"
        return None, ConvergenceError(f"the executor lost this run ({what}); start a new one and identify it again")
    return pair
