"""Validation of an identified model with other runs, and the findings about it."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ftlm.analysis.frequency_response import covariance_of, parameter_vector, with_parameter_vector
from ftlm.data.run import Run
from ftlm.data.runs import as_runs
from ftlm.errors import FtlmError
from ftlm.estimation.model_checks import discretization_findings, enumerate_names
from ftlm.estimation.result import Identification
from ftlm.estimation.verdict import UNSTABLE_PLANT_CODES
from ftlm.findings import Finding, make_finding, unique_findings
from ftlm.model.model import Model
from ftlm.utils.validation import Floats
from ftlm.validation.comparison import (
    Comparison,
    compare,
    simulate_runs,
    validation_findings,
)
from ftlm.validation.residual_tests import DEFAULT_LAGS, NEGLIGIBLE_RESIDUAL_RATIO, run_residual_tests

#: Step of numerical derivatives with respect to a parameter, in standard errors. It is small enough for the curvature
#: of the output, and large enough for the tolerance of the simulation.
DERIVATIVE_STEP_IN_ERRORS = 0.1


def validate(result: Identification, runs: Run | Sequence[Run]) -> Comparison:
    """Return a comparison of the model with validation runs; see :meth:`ftlm.Identification.validate`."""
    comparison = validate_model(result.model, runs)
    findings = [*comparison.findings, *validation_findings(result.comparison, comparison)]
    return replace(
        comparison, findings=unique_findings([*findings, *discretization_findings(result.model, comparison)])
    )


def validate_model(model: Model, runs: Run | Sequence[Run]) -> Comparison:
    """Return a comparison of a model, such as a saved one, with validation runs and their findings."""
    comparison = compare(model, runs)
    return replace(
        comparison, findings=unique_findings([*comparison.findings, *_residual_findings(model, runs, comparison)])
    )


def _residual_findings(model: Model, runs: Run | Sequence[Run], comparison: Comparison) -> list[Finding]:
    """Return a finding for each output whose residuals on validation runs depend on an input.

    The part of the residuals that errors of the parameters explain is not tested, so a model without a covariance is
    not tested. An estimation run may not excite the dynamics that a model lacks, so that only a validation run shows
    them.
    """
    estimate, run_list = model.estimate, as_runs(runs)
    if estimate is None or estimate.covariance is None:
        return []
    if any(f.code in UNSTABLE_PLANT_CODES for f in estimate.findings):
        return []

    def sensitivities() -> dict[str, list[Floats]]:
        with contextlib.suppress(FtlmError):
            by_output = simulation_sensitivities(model, run_list, comparison)
            return {name: [rows[:, 1:-1] for rows in each] for name, each in by_output.items()}
        return {}

    try:
        simulations = simulate_runs(model, run_list)
        tests = run_residual_tests(model, run_list, simulations, lags=DEFAULT_LAGS, sensitivities=sensitivities)
    except FtlmError:
        # The runs are too short for correlations, or a simulation fails, which other findings report.
        return []
    findings = []
    for name, output in tests.outputs.items():
        signals = [s for s, test in output.informative_tests.items() if test.failed]
        if signals and output.nr > NEGLIGIBLE_RESIDUAL_RATIO:
            names_text = enumerate_names(signals)
            findings.append(
                make_finding("validation_follows_input", output=name, input=", ".join(signals), shown=names_text)
            )
    return findings


def uncertain_parameters(covariance: Floats) -> list[int]:
    """Return the indices of the parameters with a positive variance; a negative one in a file is rounding error."""
    return np.flatnonzero(np.diagonal(covariance) > 0.0).tolist()


def simulation_sensitivities(
    model: Model, runs: Run | Sequence[Run], comparison: Comparison
) -> dict[str, list[Floats]]:
    """Return the derivatives of simulated outputs with respect to the uncertain parameters of a model.

    Parameters
    ----------
    model
        Identified model with a finite covariance, or without one.
    runs, comparison
        Runs, and the comparison of the model with them.

    Returns
    -------
    dict
        By output, one array per run with shape (uncertain parameters, samples). Each parameter takes one comparison.

    Raises
    ------
    FtlmError
        If a simulation with a changed parameter fails.
    """
    values, matrix = parameter_vector(model), covariance_of(model)
    covariance = np.zeros((values.size, values.size)) if matrix is None else matrix
    columns: dict[str, list[list[Floats]]] = {name: [[] for _ in each] for name, each in comparison.simulated.items()}
    for k in uncertain_parameters(covariance):
        step = DERIVATIVE_STEP_IN_ERRORS * float(np.sqrt(covariance[k, k]))
        shifted = compare(with_parameter_vector(model, values + step * np.eye(values.size)[k]), runs)
        for name, each in comparison.simulated.items():
            for column, reference_samples, other in zip(columns[name], each, shifted.simulated[name], strict=True):
                column.append((other - reference_samples) / step)
    return {name: [np.array(column) for column in each] for name, each in columns.items()}
