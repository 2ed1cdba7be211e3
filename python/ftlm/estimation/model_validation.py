"""Validation of an identified model with other runs, and the findings about it."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace

from ftlm.data.run import Run
from ftlm.data.runs import as_runs
from ftlm.errors import FtlmError
from ftlm.estimation.model_checks import discretization_findings, enumerate_names
from ftlm.estimation.result import Identification
from ftlm.estimation.verdict import UNSTABLE_PLANT_CODES
from ftlm.findings import Finding, make_finding, unique
from ftlm.utils.validation import Floats
from ftlm.validation.comparison import (
    Comparison,
    compare,
    simulate_runs,
    simulation_sensitivities,
    validation_findings,
)
from ftlm.validation.residual_tests import DEFAULT_LAGS, NEGLIGIBLE_RESIDUAL_RATIO, run_residual_tests


def validate(result: Identification, runs: Run | Sequence[Run]) -> Comparison:
    """Return a comparison of the model with validation runs; see :meth:`ftlm.Identification.validate`."""
    comparison = compare(result.model, runs)
    findings = [
        *comparison.findings,
        *validation_findings(result.comparison, comparison),
        *discretization_findings(result.model, comparison),
        *_validation_residual_findings(result, runs, comparison),
    ]
    return replace(comparison, findings=unique(findings))


def _validation_residual_findings(
    result: Identification, runs: Run | Sequence[Run], comparison: Comparison
) -> list[Finding]:
    """Return a finding for each output whose residuals on validation runs depend on an input.

    The part of the residuals that errors of the parameters explain is not tested. An estimation run may not excite the
    dynamics that a model lacks, so that only a validation run shows them.
    """
    model, several = result.model, as_runs(runs)
    if result.joint is None or any(f.code in UNSTABLE_PLANT_CODES for f in result.findings):
        return []

    def sensitivities() -> dict[str, list[Floats]]:
        with contextlib.suppress(FtlmError):
            every = simulation_sensitivities(model, several, comparison)
            return {name: [rows[:, 1:-1] for rows in each] for name, each in every.items()}
        return {}

    try:
        free = simulate_runs(model, several)
        tests = run_residual_tests(model, several, free, lags=DEFAULT_LAGS, sensitivities=sensitivities)
    except FtlmError:
        # The runs are too short for correlations, or a simulation fails, which other findings report.
        return []
    findings = []
    for name, output in tests.outputs.items():
        signals = [s for s, test in output.informative_tests.items() if test.failed]
        if signals and output.nr > NEGLIGIBLE_RESIDUAL_RATIO:
            words = enumerate_names(signals)
            findings.append(
                make_finding("validation_follows_input", output=name, input=", ".join(signals), shown=words)
            )
    return findings
