"""Closed-loop identification with the reference signal as external instrument."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ftlm.data.run import Run
from ftlm.errors import DataError, ModelError
from ftlm.estimation.fit import Fit
from ftlm.findings import Finding, make_finding
from ftlm.structure.structure import Structure
from ftlm.utils.linalg import minimum_norm_solution
from ftlm.utils.parameters import parameter
from ftlm.utils.statistics import autoregression, is_constant
from ftlm.utils.validation import Floats, nearest
from ftlm.validation.residual_tests import DEFAULT_LAGS

#: Number of single past samples among the regressors. Older samples are averaged over blocks that grow by this factor.
DENSE_PAST_SAMPLES = 25
BLOCK_GROWTH_FACTOR = 1.5
#: Numbers of reference lags with their own coefficients that are tried, and minimum number of samples of the shortest
#: run per lag. Earlier samples are averaged over blocks of growing width.
DENSE_LAG_COUNTS = (3, 6, 12, 25, 50, 100)
MIN_ROWS_PER_LAG = 15
#: Minimum first-stage F statistic of a strong instrument (Staiger and Stock, doi:10.2307/2171753).
MIN_FIRST_STAGE_F = 10.0


def instrument_runs(runs: Sequence[Run], structure: Structure, reference: str) -> tuple[list[Run], list[Finding]]:
    """Return runs with inputs projected on present and past reference values, and findings on weak instruments.

    In a closed loop, a linear filter maps the reference to each input. Least squares over all runs fit this filter, as
    in the first step of the two-stage method. The projection contains no noise that feedback carries into the input.
    Source: Van den Hof and Schrama, An indirect method for transfer function estimation from closed loop data,
    Automatica 29, 1993, 1523-1527.

    Raises
    ------
    ModelError
        If the reference is itself a signal of the model.
    DataError
        If a run lacks the reference or has nonuniform samples, the reference is constant, or the model has no input.
    """
    if reference in structure.signals:
        raise ModelError(
            f"{parameter('reference', reference)} is a signal of the model; a reference is an external signal of the "
            "loop that is not in the model; give such a signal"
        )
    for run in runs:
        if run.nonuniform_samples is not None:
            raise DataError(
                f"run {run.name!r} has nonuniform sample times, but the response of an input to "
                f"{parameter('reference')} is estimated on a regular grid; resample the run"
            )
        if reference not in run:
            raise DataError(
                f"run {run.name!r} has no signal {reference!r}{nearest(reference, run.signals)} for "
                f"{parameter('reference')}; it has {', '.join(run.signals)}"
            )
    inputs = [s for s in structure.signals if s in runs[0].inputs]
    if not inputs:
        raise DataError(
            f"{parameter('reference', reference)}: the model has no input of run {runs[0].name!r} that could "
            "depend on it; omit this argument, or add the input to the equation"
        )
    references = [run[reference] for run in runs]
    if is_constant(references):
        raise DataError(
            f"{parameter('reference', reference)} is constant, so it explains no input; record a reference that changes"
        )
    shortest = min(run.length for run in runs)
    ends = np.cumsum([run.length for run in runs])[:-1]
    laws = [
        _columns(references, shortest, dense)
        for dense in DENSE_LAG_COUNTS
        if dense == DENSE_LAG_COUNTS[0] or dense * MIN_ROWS_PER_LAG < shortest
    ]
    explained_inputs: dict[str, list[Floats]] = {}
    findings = []
    for name in inputs:
        output = np.concatenate([run[name] for run in runs])
        # The model with the smallest BIC is chosen, because every superfluous coefficient fits noise.
        fits = [columns @ minimum_norm_solution(columns, output, 1e-10) for columns in laws]
        costs = [_criterion(output - fit, columns.shape[1]) for fit, columns in zip(fits, laws, strict=True)]
        best = int(np.argmin(costs))
        explained_inputs[name] = np.split(fits[best], ends)
        statistic = first_stage_f(explained_inputs[name], np.split(output - fits[best], ends), laws[best].shape[1])
        if statistic < MIN_FIRST_STAGE_F:
            details = {"f": statistic, "needed": MIN_FIRST_STAGE_F}
            findings.append(make_finding("reference_weak", input=name, reference=reference, **details))
    return [
        run_with_inputs(run, {n: a[k] for n, a in explained_inputs.items()}) for k, run in enumerate(runs)
    ], findings


def past_regressors(signal: Floats, first: int, max_lag: int, *, dense: int = DENSE_PAST_SAMPLES) -> list[Floats]:
    """Return past samples of a signal as regressors, minus its first sample: single lags, then means of lag blocks.

    Lags from ``first`` to ``dense`` each give one regressor. Longer lags up to ``max_lag`` are averaged in blocks of
    growing length. Each regressor has the length of the signal.

    Samples before the start of the signal are assumed to equal the first sample. ``max_lag`` may be at most the length
    of the signal.
    """
    count = signal.size
    extended_signal = np.concatenate([np.full(count, signal[0]), signal])
    deviations = extended_signal - signal[0]
    sums = np.concatenate([[0.0], np.cumsum(deviations)])
    columns = [deviations[count - lag : 2 * count - lag] for lag in range(first, min(dense, max_lag) + 1)]
    start, block_length = dense + 1, max(2, dense // 4)
    while start + block_length <= max_lag:
        end = count - start + 1
        columns.append((sums[end : end + count] - sums[end - block_length : end - block_length + count]) / block_length)
        start, block_length = start + block_length, int(block_length * BLOCK_GROWTH_FACTOR) + 1
    return columns


def first_stage_f(explained_parts: Sequence[Floats], residuals: Sequence[Floats], coefficients: int) -> float:
    """Return the F statistic of the first stage of a two-stage fit, corrected for colored residuals.

    `explained_parts` are the explained parts of an input by run, `residuals` its residuals, and `coefficients` is the
    number of coefficients of the first stage. The statistic is infinite if the residuals are 0.
    """
    noise_filter = autoregression(residuals, DEFAULT_LAGS)
    errors = np.concatenate([np.convolve(e - np.mean(e), noise_filter, "valid") for e in residuals])
    level = float(np.mean(errors**2)) / max(float(np.sum(noise_filter)) ** 2, 1e-12)
    power = sum(float(np.var(a)) * a.size for a in explained_parts)
    return power / coefficients / level if level > 0 else math.inf


def _columns(references: Sequence[Floats], shortest: int, dense: int) -> Floats:
    """Return a regressor matrix for all runs: present and past reference samples, then one constant column per run.

    The largest lag is half of `shortest`, the length of the shortest run. Each lag up to `dense` has its own column,
    and larger lags share columns.
    """
    blocks = [np.stack(past_regressors(r, 0, shortest // 2, dense=dense), axis=1) for r in references]
    levels = np.repeat(np.eye(len(references)), [r.size for r in references], axis=0)
    return np.hstack([np.concatenate(blocks), levels])


def _criterion(residuals: Floats, coefficients: int) -> float:
    power = float(np.mean(residuals**2))
    return residuals.size * math.log(max(power, 1e-300)) + coefficients * math.log(residuals.size)


def run_with_inputs(run: Run, values: Mapping[str, Floats]) -> Run:
    """Return a copy of a run in which some inputs are replaced or added; added inputs are zero-order holds."""
    return Run.from_arrays(
        step=run.step,
        inputs={**{n: run[n] for n in run.inputs}, **values},
        outputs={n: run[n] for n in run.outputs},
        units={n: u for n, u in run.units.items() if u},
        intersample={**dict.fromkeys(values, "zoh"), **run.intersample},
        name=run.name,
        missing="weight",
    )


def with_reference_findings(fit: Fit, reference: str, findings: Sequence[Finding]) -> Fit:
    """Return a fit whose settings name the reference signal that it used, with `findings` on this signal.

    The finding on colored residuals is removed.
    """
    # Noise in a closed loop is colored even if the model is complete. Intervals take the color into account.
    other_findings = [f for f in fit.findings if f.code != "residuals_not_white"]
    return replace(fit, findings=[*other_findings, *findings], settings={**fit.settings, "reference": reference})
