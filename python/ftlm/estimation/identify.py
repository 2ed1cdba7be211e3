"""Identification: fit of a structure, checks of the fit, and batches of runs."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, as_completed
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import msgspec
import numpy as np

from ftlm.arm.flexible_link import FLEXIBLE_LINK
from ftlm.data.run import Run
from ftlm.data.runs import Runs, as_runs
from ftlm.errors import ConvergenceError, DataError, FtlmError, InternalError, ModelError
from ftlm.estimation.closed_loop import run_with_inputs
from ftlm.estimation.estimators import feedback_bias
from ftlm.estimation.extensions import OFFSET_CODES, run_extension_tests
from ftlm.estimation.fit import Fit
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.initial_condition_selection import InitialConditionFits, fit_with_offset_decision
from ftlm.estimation.methods import EstimationMethod, OutputError, method_with_options, resolve_method
from ftlm.estimation.model_checks import (
    dead_channel_findings,
    discretization_findings,
    enumerate_names,
    excitation_findings,
    friction_direction_findings,
    mode_sampling_findings,
    stability_findings,
    start_findings,
    stribeck_findings,
)
from ftlm.estimation.nonlinear_checks import nonlinear_findings
from ftlm.estimation.nuisance_parameters import (
    offset_errors,
    output_sensitivities,
)
from ftlm.estimation.output_error import parameter_set
from ftlm.estimation.prior_knowledge import Bounds, Priors
from ftlm.estimation.result import Identification
from ftlm.estimation.unstable_plants import SPLIT_CODES, unstable_plant_findings
from ftlm.estimation.verdict import has_loop_noise_model, is_buried, result_findings
from ftlm.findings import MISSING_PART_CODES, Finding, make_finding, unique_findings
from ftlm.model.model import Estimate
from ftlm.order_search.search import check_executor, threads_per_task
from ftlm.progress import FractionTracker
from ftlm.simulation.discretization import check_linear, default_m
from ftlm.structure.parser import as_structure
from ftlm.structure.structure import Offset, Structure, check_initial, check_offset
from ftlm.utils.arguments import check_arguments
from ftlm.utils.files import PACKAGE_LOGGER
from ftlm.utils.formatting import finite
from ftlm.utils.parameters import parameter
from ftlm.utils.resources import run_in_worker
from ftlm.utils.statistics import ROUNDING_RESIDUAL_RATIO
from ftlm.utils.validation import Floats, check_threads
from ftlm.validation.comparison import (
    MAX_NORMALIZED_RESIDUAL,
    Comparison,
    compare_samples,
    simulate_runs,
)
from ftlm.validation.data_advice import data_notes
from ftlm.validation.information_criteria import InformationCriteria, information_criteria
from ftlm.validation.residual_tests import (
    DEFAULT_LAGS,
    Residuals,
    residual_findings,
    run_residual_tests,
)

#: Codes of residual findings that are omitted if a reported extension of the structure explains the residuals.
SHOWN_BY_RESIDUALS = ("residuals_not_white", "residuals_follow_direction")
#: Codes of reported effects that have a nonzero mean. The test for an offset would report this mean as well.
HAVE_MEAN_CODES = (
    *OFFSET_CODES,
    *("saturation_fits", "dead_zone_fits", "square_fits", "nonlinear_term_fits", "friction_fits", "load_step_fits"),
)
#: Fraction of the progress of an identification that is reached when its initial conditions are selected.
INITIAL_CONDITIONS_PROGRESS = 0.7


@check_arguments
def identify(
    runs: Run | Sequence[Run],
    structure: Structure | str,
    *,
    method: str | EstimationMethod = "output-error",
    initial: str | Iterable[float] | None = None,
    offset: Offset | None = None,
    bounds: Bounds | None = None,
    priors: Priors | None = None,
    m: int | None = None,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Identification:
    """Identify a structure from measured runs.

    The output-error method estimates continuous orders and coefficients together, with confidence intervals and
    automatic initialization. The equation-error methods search free orders on an order grid, for each equation
    separately or for all together under an order law. They then estimate the coefficients at the best orders.

    Parameters
    ----------
    runs
        One run, or several runs with the same names and units. All are fitted together, and each has its own initial
        terms.
    structure
        Structure to identify, or the text of its equations; see :func:`ftlm.equation` and :func:`ftlm.flexible_link`.
    method
        Method of estimation with its options: :class:`ftlm.OutputError`, :class:`ftlm.InstrumentalVariables`,
        :class:`ftlm.MultiInnovation`, :class:`ftlm.LeastSquares` or :class:`ftlm.GeneticAlgorithm`. A name selects the
        method with default options: ``"output-error"``, ``"instrumental-variables"``, ``"multi-innovation"``,
        ``"least-squares"`` or ``"genetic"``.
    initial
        Initial conditions of every run: ``"auto"``, ``"rest"``, ``"caputo"``, ``"history"`` or exponents of t, as in
        :func:`ftlm.equation`; by default those of the structure. With ``"auto"``, runs of an unstable plant under
        control may be split into pieces with their own initial values, because a simulation of a whole run diverges.
    offset
        ``"constant"``: an unknown constant on the right-hand side of each equation, such as a sensor bias or a load.
        ``"level"``: an unknown constant that is added to each output. ``"ramp"``: c + d t with unknown c and d on the
        right-hand side of each equation.
        ``"auto"``: a constant in the equations if it is significant at 99 %, with the statistic in
        ``.settings["offset_test"]``. Each run has its own offset, in ``.comparison.offsets``. An offset is not
        identifiable together with ``initial="history"``. Default: the offset of the structure. If it has none,
        a level or, for integrating or non-linear plants, a constant is added if it improves the fit. ``"none"``
        prevents this, but the level of a run that rests before an input changes is still used.
    bounds
        (lower, upper) of parameters by name, such as ``{"a": (0, 10)}``. They replace the bounds of the method.
    priors
        (mean, standard deviation) of normal priors of parameters by name, such as ``{"a": (2, 0.1)}``. They replace the
        priors of the method; see :class:`ftlm.OutputError`.
    m
        Number of block pulses per run; by default 2048, or fewer for shorter runs (a power of two for Haar rows).
        Without `m`, instrumental variables use the default for the order search and all samples, at most 16384, for the
        estimation.
    threads, progress
        Number of threads, by default all cores; and a callback with (work done, total work).

    Returns
    -------
    Identification
        Result that prints its summary. Its ``.model`` can be simulated and saved; ``.validate`` compares it with other
        runs, and ``.report`` writes an HTML page.

    Raises
    ------
    DataError
        If runs lack a signal of the structure, an output is constant, the reference is missing or constant, or the
        checkpoint file belongs to another search, is in use, is damaged or cannot be written.
    ModelError
        If the method is unknown, the order grid has no or too many candidates, an option is out of range, options of an
        order search are given without a free order, `store` is given with ``offset="auto"``, or the initial guess has
        no free parameter, an unknown one, or a value out of bounds.
    ConvergenceError
        If regressors are linearly dependent at the given orders, or the executor has lost its workers.
    """
    run_list = as_runs(runs)
    estimator = resolve_method(method)
    prior_knowledge = {n: v for n, v in (("bounds", bounds), ("priors", priors)) if v is not None}
    if prior_knowledge:
        estimator = method_with_options(estimator.name, {**vars(estimator), **prior_knowledge})
    if isinstance(structure, str) and structure == "auto":
        raise ModelError("structure = 'auto'; use ftlm.select(runs, 'auto').best, which chooses and identifies one")
    structure = as_structure("structure", structure)
    check_threads(threads)
    if initial is not None:
        structure = replace(structure, initial=check_initial(initial))
    if offset is not None:
        structure = replace(structure, offset=check_offset(offset))
    if structure.offset == "auto":
        _check_offset_test(structure, estimator)

    PACKAGE_LOGGER.info(
        "identifying %s from %s by %s", structure.name, ", ".join(r.name for r in run_list), estimator.name
    )
    fit = _fit_runs(run_list, structure, estimator, offset is None, m=m, threads=threads, progress=progress)
    result = assess_fit(fit)
    duration = next((f.numbers["seconds"] for f in result.findings if f.code in SPLIT_CODES), None)
    without_reference = isinstance(estimator, OutputError) and estimator.reference is None
    if duration is not None and structure.initial == "auto" and without_reference:
        # If the pieces cannot be fitted, the result for whole runs is returned.
        with contextlib.suppress(FtlmError):
            split = identify_pieces(run_list, structure, float(duration), method=estimator, m=m, threads=threads)
            result = split if any(f.code == "plant_unstable" for f in split.findings) else result
    PACKAGE_LOGGER.info("identified: %s", result.verdict)
    for finding in result.findings:
        PACKAGE_LOGGER.warning("%s", finding)
    return result


def _fit_runs(
    runs: Runs,
    structure: Structure,
    estimator: EstimationMethod,
    may_add_offset: bool,
    *,
    m: int | None,
    threads: int | None,
    progress: Callable[[int, int], None] | None,
) -> Fit:
    """Return the fit of a structure by a method, with selected initial conditions and offsets.

    `may_add_offset` allows an offset that the structure lacks.
    """

    def estimate(
        request: Structure,
        method: EstimationMethod = estimator,
        report: Callable[[int, int], None] | None = progress,
        **options: Any,
    ) -> Fit:
        fit = method.fit(runs, request, m=m, threads=threads, progress=report, **options)
        if not isinstance(fit, Fit):
            raise ModelError(
                f"the method {estimator.name!r} fitted a {type(fit).__name__}; return a Fit from its fit method"
            )
        return fit

    preliminary_method, initial_condition_fits = (
        getattr(estimator, "preliminary_method", None),
        InitialConditionFits(estimate, may_add_offset),
    )
    if preliminary_method is not None:
        tracker = FractionTracker(progress)
        initial_condition_fits = InitialConditionFits(
            partial(
                estimate,
                method=preliminary_method,
                report=tracker.subtask(INITIAL_CONDITIONS_PROGRESS, 0.9),
                is_preliminary=True,
            ),
            may_add_offset,
            lambda request, joint: estimate(request, report=tracker.subtask(1.0, 1.0), fitted=joint),
        )
    return fit_with_offset_decision(runs, structure, estimate, initial_condition_fits)


def identify_pieces(
    runs: Sequence[Run],
    structure: Structure,
    duration: float,
    *,
    method: EstimationMethod | None = None,
    m: int | None = None,
    threads: int | None = None,
) -> Identification:
    """Identify an unstable plant under control from pieces of its runs, each with its own initial values.

    The simulation error of an unstable model grows exponentially, but each piece is too short for a large error. White
    measurement noise in the feedback does not bias output-error estimates if the plant has a delay of one sample.

    Parameters
    ----------
    runs
        Whole runs.
    structure
        Structure to identify. Its initial conditions are replaced by ``"caputo"``.
    duration
        Shortest duration of a piece [s].
    method
        Method of estimation, by default output error.
    m, threads
        See :func:`identify`.

    Returns
    -------
    Identification
        Result whose model divides other runs into such pieces when it is compared with them.
    """
    pieces = as_runs([piece for run in runs for piece in run.split(duration)])
    request = replace(structure, initial="caputo")
    result = assess_fit(_fit_runs(pieces, request, method or OutputError(), True, m=m, threads=threads, progress=None))
    notes = [note for run in runs for note in data_notes(run)]
    findings = (*result.findings, *notes, make_finding("runs_split", pieces=len(pieces), seconds=duration))
    estimate = result.model.estimate
    assert estimate is not None
    details = msgspec.structs.replace(estimate, findings=tuple(f.to_file() for f in findings), piece_duration=duration)
    return replace(result, model=replace(result.model, estimate=details), findings=findings)


def _check_offset_test(structure: Structure, method: EstimationMethod) -> None:
    """Raise ModelError if ``offset="auto"`` is not possible: with friction or a checkpoint file.

    With non-linear terms it is only possible with :class:`OutputError`, whose fits with and without offset are
    compared.

    The offset test may require two fits, but the checkpoint file of a method stores only one search.
    """
    if structure.has_friction:
        raise ModelError(
            f"the equation of {structure.outputs[structure.friction_equations[0]]} has friction, which the test of "
            f"{parameter('offset', 'auto')} does not support; use {parameter('offset', 'constant')}, whose interval "
            f"says whether it is 0, or {parameter('offset', 'none')}"
        )
    if not isinstance(method, OutputError):
        check_linear(structure.equations, f"the test of {parameter('offset', 'auto')}")
    if getattr(method, "store", None) is not None:
        raise ModelError(
            f"{parameter('offset', 'auto')} may need two searches, but a store keeps only one; use "
            f"{parameter('offset', 'none')} or {parameter('offset', 'constant')} with {parameter('store')}"
        )


def assess_fit(fit: Fit) -> Identification:
    """Return an identification: a fit with its errors, residual tests, information criteria and findings.

    All of them are computed on the estimation runs.
    """
    runs, model = as_runs(fit.task.runs), fit.model
    simulations = simulate_runs(model, runs)
    comparison = compare_samples(model, runs, simulations, m=model.m or default_m(runs, power_of_two=False))
    findings = [*comparison.findings, *fit.findings]
    findings += [note for run in runs for note in data_notes(run)]
    findings += start_findings(runs, model.structure)
    findings += dead_channel_findings(runs, fit.task.structure) + excitation_findings(runs, fit.task.structure)
    findings += (
        discretization_findings(model, comparison)
        + stability_findings(replace(model, estimate=_estimate(fit, comparison, None, ())))
        + mode_sampling_findings(model, runs)
        + friction_direction_findings(model, simulations)
        + stribeck_findings(model, runs, simulations)
        + nonlinear_findings(model, runs, simulations)
    )
    if fit.joint is not None and any(f.code == "simulation_chaotic" for f in findings):
        # The cost is nowhere quadratic, and a profile follows one of its many minima.
        infinite_covariance = np.diag(np.full(len(fit.joint.names), np.inf))
        fit = replace(fit, joint=replace(fit.joint, covariance=infinite_covariance, profiles={}))
    tests, criteria = None, None
    try:
        tests = run_residual_tests(model, runs, simulations, lags=DEFAULT_LAGS, sensitivities=_sensitivities(fit))
        criteria = information_criteria(tests, fit.parameters)
    except DataError:
        # The run is too short for correlations. All other results are available.
        pass
    plant = unstable_plant_findings(
        fit, replace(model, estimate=_estimate(fit, comparison, None, ())), runs, comparison
    )
    if plant:
        findings = [*plant, *(f for f in findings if not f.kind.simulates_whole_run)]
    if any(f.code in SPLIT_CODES for f in plant):
        # Residuals over whole runs do not test a model that holds for pieces only.
        tests, criteria = None, None
    tests = None if tests is None else _with_feedback_bias(fit, tests)
    if tests is None:
        findings = [_undecided_color(f) if f.code == "residuals_not_white" else f for f in findings]
    else:
        extensions = run_extension_tests(fit, tests)
        extension_findings = extensions.findings
        if extensions.has_friction_test:
            # The fit of the structure with friction replaces the correlation test for friction.
            outputs = {n: replace(o, direction=None) for n, o in tests.outputs.items()}
            tests = replace(tests, outputs=outputs)
        directed = [o for o, r in tests.outputs.items() if r.follows_direction]
        findings = [f for f in findings if f.code != "residuals_not_white" or f.output not in directed]
        is_explained = bool(extension_findings) and all(f.code != "dynamics_missing" for f in extension_findings)
        if directed and not is_explained:
            # No linear structure explains the residuals, so the finding on the direction of motion is more specific.
            extension_findings = []
        if not extension_findings:
            white_outputs = {o for o, r in tests.outputs.items() if r.whiteness.passed}
            findings = [f for f in findings if f.code != "residuals_not_white" or f.output not in white_outputs]
            findings = [_noise_finding(f, tests) for f in findings]
        findings += _residual_findings(fit, tests)
        if is_explained:
            findings = [f for f in findings if f.code not in SHOWN_BY_RESIDUALS]
        if any(f.code in HAVE_MEAN_CODES for f in extension_findings):
            findings = [f for f in findings if f.code != "offset_missing"]
        findings += extension_findings
        findings = [_coupling_finding(f, fit.task.structure) for f in findings]
        findings += arm_findings(fit.task.structure, findings)
    all_findings = unique_findings(msgspec.structs.replace(f, method=fit.method) for f in findings)
    estimate = _estimate(fit, comparison, criteria, all_findings)
    result = Identification(
        replace(model, estimate=estimate),
        fit.method,
        comparison,
        fit.searches,
        fit.settings,
        all_findings,
        fit.joint,
        tests,
        criteria,
        fit.task,
        fit.errors,
        _offset_errors(fit, comparison),
    )
    limiting = tuple(f.to_file() for f in unique_findings(result_findings(result)))
    if not limiting:
        return result
    return replace(result, model=replace(model, estimate=msgspec.structs.replace(estimate, verdict_findings=limiting)))


def _offset_errors(fit: Fit, comparison: Comparison) -> tuple[dict[str, dict[str, float]], ...]:
    """Return the standard errors of the offsets of each run, by output and kind; () if they are not computable."""
    joint = fit.joint
    if joint is None or has_loop_noise_model(fit.settings) or not np.isfinite(np.diag(joint.covariance)).any():
        return ()
    return offset_errors(joint, fit.task.structure, fit.task.runs, comparison.offsets)


def _sensitivities(fit: Fit) -> Callable[[], Mapping[str, list[Floats]]] | None:
    """Return a function that computes output sensitivities to the parameters, or None.

    None is returned without a joint fit, without free parameters, and for a structure with friction.
    """
    joint, structure = fit.joint, fit.task.structure
    if joint is None or not joint.names or structure.has_friction:
        return None
    request = replace(structure, initial=joint.initial)
    return lambda: output_sensitivities(joint, request, fit.task.runs)


def _undecided_color(finding: Finding) -> Finding:
    """Return the finding on colored residuals for data that do not distinguish noise from missing dynamics."""
    return make_finding("color_undecided", output=finding.output)


def _noise_finding(finding: Finding, tests: Residuals) -> Finding:
    """Return a finding, replaced by a less severe one if the residuals are noise that no input explains.

    Findings on colored residuals and on a poor fit are replaced. Residual tests omit the first and the last sample. If
    the fit is poor only because of these two samples, the finding states that they are outliers.
    """
    if finding.code == "explains_little" and tests.outputs[finding.output].nr <= MAX_NORMALIZED_RESIDUAL:
        remainder = 100.0 * (1.0 - tests.outputs[finding.output].nr)
        return make_finding("end_row_far_off", output=finding.output, inner=remainder, **finding.numbers)
    if finding.code == "explains_little" and is_buried(tests.outputs[finding.output]):
        return make_finding("buried_in_noise", output=finding.output, **finding.numbers)
    if finding.code == "residuals_not_white" and tests.outputs[finding.output].is_undecided:
        return _undecided_color(finding)
    colored = finding.code == "residuals_not_white" and tests.outputs[finding.output].is_noise
    return make_finding("noise_coloured", output=finding.output) if colored else finding


def _coupling_finding(finding: Finding, structure: Structure) -> Finding:
    """Return a finding, changed to ``coupling_missing`` if it reports an input that no equation uses."""
    if finding.code != "residuals_follow_input" or finding.input in structure.signals:
        return finding
    return msgspec.structs.replace(finding, code="coupling_missing")


def arm_findings(structure: Structure, findings: Sequence[Finding]) -> list[Finding]:
    """Return findings on the effects that the flexible-link model neglects, if residual tests fail.

    Friction at a hub is a term in the equation of the hub angle. It affects the equation of a deflection only through
    this angle.
    """
    if not structure.name.startswith(FLEXIBLE_LINK) or not any(f.code in MISSING_PART_CODES for f in findings):
        return []
    outputs = enumerate_names(list(dict.fromkeys(f.output for f in findings if f.code in MISSING_PART_CODES)))
    stages = {name[len("theta")] for name in structure.signals if name.startswith("theta")}
    has_hub = not {"theta11", "theta21"}.isdisjoint(structure.outputs)
    kinds = ["hub_friction_missing"] if has_hub and not structure.has_friction else []
    kinds += ["other_link_missing"] if len(stages) == 1 else []
    return [make_finding(kind, output=outputs) for kind in kinds]


def _with_feedback_bias(fit: Fit, tests: Residuals) -> Residuals:
    """Return the residual tests, with the parameter bias that detected feedback can cause."""
    fed = {
        signal: test.response
        for o in tests.outputs.values()
        for signal, test in o.feedback_tests.items()
        if test.response
    }
    runs = fit.task.runs
    is_supported = fit.task.structure.is_linear and all(run.nonuniform_samples is None for run in runs)
    if fit.joint is None or not fed or has_loop_noise_model(fit.settings) or not is_supported:
        return tests
    noise_free_runs = [
        run_with_inputs(run, {n: run[n] - np.pad(v[k], 1) for n, v in fed.items()}) for k, run in enumerate(runs)
    ]
    problem = FreeProblem.of(replace(fit.task.structure, initial=fit.joint.initial))
    bias = feedback_bias(fit.joint, problem, runs, noise_free_runs)
    outputs = {
        name: replace(
            o, feedback_tests={n: replace(t, bias=bias) if t.has_feedback else t for n, t in o.feedback_tests.items()}
        )
        for name, o in tests.outputs.items()
    }
    return replace(tests, outputs=outputs)


def _residual_findings(fit: Fit, tests: Residuals) -> list[Finding]:
    """Return findings of failed residual tests.

    For a joint fit, findings on colored residuals are omitted, because the fit itself already reports them. For other
    fits, findings on the direction of motion are omitted: their residuals are not orthogonal to the effects of all
    parameters, and depend on this direction even without friction.
    """
    if has_loop_noise_model(fit.settings):
        # Such a fit is consistent in a closed loop, so detected feedback is no finding.
        tests = replace(tests, outputs={n: replace(o, feedback_tests={}) for n, o in tests.outputs.items()})
    if fit.joint is None:
        return [f for f in residual_findings(tests) if f.code != "residuals_follow_direction"]
    codes = ("output_not_white", "noise_coloured", "color_undecided")
    return [f for f in residual_findings(tests, floor=ROUNDING_RESIDUAL_RATIO) if f.code not in codes]


def _estimate(
    fit: Fit, comparison: Comparison, criteria: InformationCriteria | None, findings: tuple[Finding, ...]
) -> Estimate:
    """Return the estimate that a model file stores: parameters, standard errors, fit and findings."""
    joint, values, errors = fit.joint, dict(fit.model.orders), {}
    if joint is not None:
        values = joint.values_by_name
        errors = {n: finite(v) for n, v in joint.standard_errors.items()}
    profiles = {} if joint is None else {n: (finite(p.low), finite(p.high)) for n, p in joint.profiles.items()}
    return Estimate(
        method=fit.method,
        runs=tuple(r.name for r in fit.task.runs),
        values={n: float(v) for n, v in {**values, **fit.model.coefficients}.items()},
        standard_errors=errors,
        covariance=fit.covariance,
        fit={n: finite(f) for n, f in comparison.fit.items()},
        information={} if criteria is None else {n: finite(getattr(criteria, n)) for n in ("aic", "aicc", "bic")},
        findings=tuple(f.to_file() for f in findings),
        intervals=profiles,
        free_parameters=None if joint is None else parameter_set(joint, fit.task.structure),
    )


@dataclass(frozen=True)
class BatchResult:
    """Result of one item of a batch identification.

    Parameters
    ----------
    name
        Names of the runs of the item.
    result
        Identification; None if it failed.
    error
        Error that stopped the identification, or None.
    """

    name: str
    result: Identification | None
    error: FtlmError | None

    def __str__(self) -> str:
        return f"{self.name}\n{self.result}" if self.error is None else f"{self.name}: {self.error}"


def identify_one(
    runs: Run | Sequence[Run], structure: Structure | str, options: dict[str, Any]
) -> tuple[Identification | None, FtlmError | None]:
    """Identify one item of a batch, and return (result, None) or (None, error); other faults become InternalError."""
    try:
        return identify(runs, structure, **options), None
    except FtlmError as error:
        return None, error
    except Exception as error:  # A fault in one item must not stop the other items.
        return None, InternalError(f"internal fault: {type(error).__name__}: {error}; please report it")


@check_arguments
def identify_many(
    runs: Sequence[Run | Sequence[Run]],
    structure: Structure | str,
    *,
    method: str | EstimationMethod = "output-error",
    offset: Offset | None = None,
    m: int | None = None,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    executor: Executor | None = None,
) -> list[BatchResult]:
    """Identify each of many runs separately.

    Parameters
    ----------
    runs
        Runs, or sequences of runs that are fitted together.
    structure
        Structure to identify, the same for all.
    method, offset, m
        See :func:`ftlm.identify`; the method must not have a `store`.
    threads
        Number of threads of one identification; by default all cores, or one with an executor.
    progress
        Callback with (runs done, total runs).
    executor
        Any :class:`concurrent.futures.Executor`, such as processes or ``dask.distributed.Client(…).get_executor()``.
        Each item is sent to one worker. With None the items are identified one after the other in this process.

    Returns
    -------
    list of BatchResult
        Results in the sequence of the runs, each an identification or an error.

    Raises
    ------
    ModelError
        If there are no runs, an item is not a run, or the method is unknown, has a `store`, or has its own executor as
        well.
    KeyboardInterrupt
        On Ctrl-C.
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
    check_executor(executor)
    estimator = resolve_method(method)
    if getattr(estimator, "store", None) is not None:
        raise ModelError(
            "a store keeps one identification; identify each run by its own call with its own checkpoint file"
        )
    if executor is not None and getattr(estimator, "executor", None) is not None:
        raise ModelError(f"the method has an executor besides {parameter('executor')}; leave one of the two out")
    options = {"method": estimator, "offset": offset, "m": m, "threads": threads}
    if executor is None:
        batch = []
        for name, item in zip(names, items, strict=True):
            batch.append(BatchResult(name, *identify_one(item, structure, options)))
            if progress is not None:
                progress(len(batch), len(items))
        return batch
    options["threads"] = threads_per_task(threads, executor)
    pending: list[Future[Any]] = []
    try:
        for item in items:
            try:
                pending.append(executor.submit(run_in_worker, identify_one, item, structure, options))
            except (BrokenExecutor, RuntimeError) as error:
                failure: Future[Any] = Future()
                failure.set_exception(error)
                pending.append(failure)
        if progress is not None:
            for count, _ in enumerate(as_completed(pending), 1):
                progress(count, len(items))
        return [BatchResult(name, *_future_result(future)) for name, future in zip(names, pending, strict=True)]
    finally:
        for future in pending:
            future.cancel()


def _future_result(future: Future[Any]) -> tuple[Identification | None, FtlmError | None]:
    """Return the (result, error) pair of a worker; the error is a ConvergenceError if the executor failed."""
    try:
        pair: tuple[Identification | None, FtlmError | None] = future.result()
    except (Exception, CancelledError) as error:
        message = f"{type(error).__name__}: {error}"
        return None, ConvergenceError(
            f"the executor lost this run ({message}); start a new executor and identify the run again"
        )
    return pair
