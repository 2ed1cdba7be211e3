"""Comparison of a model with measured runs: simulation error and equation error, with metrics and tables."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike

from ftlm import _core
from ftlm.data.run import Run, Runs, as_runs
from ftlm.data.sampling import drop_missing
from ftlm.errors import DataError
from ftlm.findings import Finding, make_finding, texts
from ftlm.model.model import Model, check_model
from ftlm.simulation.discretization import (
    Record,
    check_m,
    check_no_missing,
    compared_times,
    default_m,
    equation_tuple,
    records,
)
from ftlm.simulation.output_samples import (
    LEVEL_EXPONENT,
    OutputSamples,
    initial_exponents,
    measured_samples,
    runs_in_motion,
)
from ftlm.simulation.simulate import comparison_records, respond
from ftlm.simulation.step_refinement import simulate_refined
from ftlm.structure.structure import Structure, offset_exponents
from ftlm.svg.html_page import Table
from ftlm.utils.arguments import check_arguments
from ftlm.utils.files import to_frame
from ftlm.utils.formatting import Cell, Exact, attributes, json_value, symbol_html
from ftlm.utils.validation import Floats, as_floats


@dataclass(frozen=True)
class Metrics:
    """Error metrics of one output: error (45), RMSE (46) and NR (47) of the paper, and fit.

    Parameters
    ----------
    error
        Sum of absolute errors over all samples (or block pulses), in the unit of the output; equation (45) of the
        paper.
    rmse
        Root mean square error, in the unit of the output; equation (46).
    nr
        Normalized residual: RMSE divided by the standard deviation of the output; equation (47).
    fit
        Fit in percent: 100 (1 - ‖y - ŷ‖ / ‖y - mean y‖).
    """

    error: float
    rmse: float
    nr: float
    fit: float

    def to_dict(self) -> dict[str, float | None]:
        """Return the metrics as a dictionary for JSON."""
        return attributes(self, ("error", "rmse", "nr", "fit"))


#: Metrics of an unknown error.
UNKNOWN_METRICS = Metrics(math.nan, math.nan, math.nan, math.nan)


@check_arguments
def metrics(measured: ArrayLike, predicted: ArrayLike) -> Metrics:
    """Return error, RMSE, normalized residual and fit of a prediction; see :class:`Metrics`.

    Parameters
    ----------
    measured, predicted
        Arrays of shape (M,) in the same unit.

    Returns
    -------
    Metrics
        Metrics that are not finite if the prediction is not finite. NR and fit are meaningless for a constant
        measurement.

    Raises
    ------
    DataError
        If an array is empty or not one-dimensional, the lengths differ, or a measured value is not a finite real
        number.
    """
    y, prediction = as_floats("measured", measured), as_floats("predicted", predicted)
    if y.ndim != 1 or y.size == 0 or prediction.shape != y.shape:
        raise DataError(
            f"measured has shape {y.shape}, predicted {prediction.shape}; give two vectors of one length, at least 1"
        )
    return Metrics(*_core.metrics(y, y - prediction))


def pooled_metrics(outputs: list[Floats], residuals: list[Floats]) -> Metrics:
    """Return metrics over several runs from their measured outputs and residuals, without missing samples."""
    finite = [~np.isnan(y) for y in outputs]
    if not all(k.all() for k in finite):
        outputs = [y[k] for y, k in zip(outputs, finite, strict=True)]
        residuals = [e[k] for e, k in zip(residuals, finite, strict=True)]
    if len(outputs) == 1:
        return Metrics(*_core.metrics(outputs[0], residuals[0]))
    return Metrics(*_core.metrics(np.concatenate([y - np.mean(y) for y in outputs]), np.concatenate(residuals)))


#: Orders of an output's own terms closer to alpha than this make I^(alpha - nu) nearly the identity on smooth signals.
NEAR_IDENTITY_ORDER_GAP = 0.25
#: Ratio of output error to equation error (NR) above which the equation error is misleading.
MAX_ERROR_RATIO = 5.0
#: Drop of the fit from estimation to validation data, in percentage points, that indicates overfitting.
MAX_FIT_DROP_POINTS = 20.0
#: Normalized residual (NR) of a simulation above which the model explains little of the output.
MAX_NORMALIZED_RESIDUAL = 0.5
#: Change of a simulation on halving the step, relative to its largest value, at which refinement terminates.
REFINEMENT_TOLERANCE = 1e-6
#: Maximum number of pulses of a refined simulation (at least four per sampling interval), and the change on halving the
#: step above which a warning reports that it has not converged.
MAX_PULSES = 1 << 20
VISIBLE_STEP_CHANGE = 1e-3


@dataclass(frozen=True)
class Comparison:
    """Errors of a model on measured runs: output error of the simulation, and equation error.

    Parameters
    ----------
    output_error, equation_error
        Metrics by output, over all runs. The output error is the error of the simulation; the equation error is the
        error of the equation with measured signals on its right-hand side.
    per_run
        (equation error, output error) of each run by name, each as metrics by output.
    simulated, measured
        Simulated and measured values by output, one array per run: samples at the sample times, or means over block
        pulses if ``output_samples`` is False. Missing samples are NaN in ``measured`` and excluded from the output
        error. With missing samples there is no equation error.
    step
        Width of the block pulses of each run [s], for the equation error.
    m
        Number of block pulses per run, for the equation error.
    initial
        Coefficients of the initial terms (powers of t) in the simulation, one mapping per run: output -> exponent ->
        value. They are valid for that run only.
    findings
        Findings on reasons to doubt these metrics.
    times
        Time of each value of ``simulated`` and ``measured`` [s since the first sample], one array per run.
    output_samples
        Whether samples at the sample times are compared; False for means over block pulses, as in the paper.
    offsets
        Estimated offsets of the equations, one mapping per run: output -> ``"constant"`` [unit of D^alpha y] (and
        ``"ramp"`` [that unit/s]) -> value. They are estimated on each run separately. Empty for a model without an
        offset, and for an output whose initial terms make the offset unidentifiable or whose simulation diverges.
    without_equation_error
        Reason by name, for each output without an equation error: friction acts on it, or samples are missing.
    """

    output_error: dict[str, Metrics]
    equation_error: dict[str, Metrics]
    per_run: list[tuple[str, dict[str, Metrics], dict[str, Metrics]]]
    simulated: dict[str, list[Floats]]
    measured: dict[str, list[Floats]]
    step: list[float]
    m: int
    initial: list[dict[str, dict[float, float]]]
    findings: tuple[Finding, ...] = field(default=())
    times: list[Floats] = field(default_factory=list)
    output_samples: bool = True
    offsets: tuple[dict[str, dict[str, float]], ...] = field(default=())
    without_equation_error: Mapping[str, str] = field(default_factory=dict)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Findings as sentences."""
        return texts(self.findings)

    @property
    def fit(self) -> dict[str, float]:
        """Fit of the simulation in percent, by output."""
        return {name: figures.fit for name, figures in self.output_error.items()}

    #: The same, by the name that has the unit.
    fit_percent = fit

    def to_frame(self) -> Any:
        """Return both errors of every run as a pandas DataFrame, one row for each run, output and kind of error."""
        rows = [
            {"run": run, "output": name, "of": kind, "error": f.error, "rmse": f.rmse, "nr": f.nr, "fit": f.fit}
            for run, equation, output in self.per_run
            for kind, figures in (("equation error", equation), ("output error", output))
            for name, f in figures.items()
        ]
        return to_frame(rows, ["run", "output", "of"])

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as a dictionary for JSON."""
        parts = ("run", "equation_error", "output_error")
        return {
            **attributes(self, ("m", "output_error", "equation_error")),
            "runs": [dict(zip(parts, json_value(part), strict=True)) for part in self.per_run],
            **attributes(self, ["offsets"] if self.offsets else []),
            **attributes(self, ("findings", "warnings")),
        }

    def __str__(self) -> str:
        width = max(len(name) for name in self.output_error) + 2
        lines = [f"{'output':<{max(width, 8)}}{'':<16}{'error':>12}{'RMSE':>12}{'NR':>10}{'fit %':>12}"]
        for name in self.output_error:
            both = (("equation error", self.equation_error[name]), ("output error", self.output_error[name]))
            for label, f in both[1 if name in self.without_equation_error else 0 :]:
                lines.append(
                    f"{name:<{max(width, 8)}}{label:<16}{f.error:>12.5g}{f.rmse:>12.5g}{f.nr:>10.4g}{f.fit:>12.4g}"
                )
        if self.output_samples:
            count = max(sum(drop_missing(y).size for y in parts) for parts in self.measured.values())
            reference_text = (
                f", equation error over {self.m} block pulses per run"
                if set(self.measured) - set(self.without_equation_error)
                else ""
            )
            lines.append(f"output error over {count} samples{reference_text}")
        else:
            lines.append(f"over {self.m} block pulses per run")
        lines += describe_missing_equation_errors(self.without_equation_error)
        lines += describe_offsets(self)
        if not self.offsets and (terms := describe_initial_terms(self)):
            lines.append(f"initial terms estimated on each run (their number): {terms}")
        lines += [f"warning: {w}" for w in self.warnings]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return comparison_html(self)


#: Reasons for a missing equation error.
FRICTION_REASON = "friction acts on it, and the sign of a measured velocity is that of its noise, most of all at rest"
MISSING_SAMPLES_REASON = "some of its samples are missing, and interpolated samples are not measurements"
UNDEFINED_TERM_REASON = "a non-linear term of the measured signals has no value in some of the rows"
#: Note on an offset that the initial history makes unidentifiable.
HIDDEN_OFFSET_NOTE = "not separately identifiable from the initial conditions; begin the run at rest to identify it"


@check_arguments
def compare(model: Model, runs: Run | Sequence[Run], *, m: int | None = None) -> Comparison:
    """Compare a model with measured runs, and return its output error and equation error.

    The output error compares each sample y[k] with the simulation (free run: only inputs and initial conditions are
    used) at the same time. The time step is refined until the simulation has converged, as in :func:`ftlm.simulate`.
    Initial values are fitted to the samples of the run, unless the model starts from rest. Initial terms of a history
    (past inputs) have a prior, so that they explain no more than plausible inputs before the run could. A run of an
    unstable plant is simulated in pieces with their own initial values if the model was identified in this way. The fit
    is 100 (1 - ‖y - ŷ‖ / ‖y - mean y‖), in percent.

    Parameters
    ----------
    model
        Model to compare.
    runs
        One run or several with the same names and units.
    m
        Number of block pulses per run for the equation error; by default as in the identification, or fewer for
        shorter runs.

    Returns
    -------
    Comparison
        Comparison whose metrics equal those of the identification on the estimation data. Initial terms, and offsets if
        the structure has any, are estimated on each run separately.

    Raises
    ------
    DataError
        If runs differ in names or units, a signal of the model is missing, or an output is constant.
    ModelError
        If a run is too short for `m` pulses.
    """
    several, m = _check_arguments(model, runs, m)
    return compare_samples(model, several, simulate_runs(model, several), m=m)


def simulate_runs(model: Model, runs: Sequence[Run]) -> list[OutputSamples]:
    """Simulate each run with initial terms fitted to it, and return samples of the outputs.

    The time step is refined until converged. A model that was identified from pieces of runs is simulated in such
    pieces, each with its own initial terms.
    """
    duration = None if model.estimate is None else model.estimate.piece_duration
    return [_simulate_pieces(model, [run] if duration is None else run.split(duration)) for run in runs]


def _simulate_pieces(model: Model, pieces: Sequence[Run]) -> OutputSamples:
    """Return the concatenated simulations of consecutive pieces of a run, with the first piece's initial terms."""
    free = [
        simulate_refined(model, run, None, tolerance=REFINEMENT_TOLERANCE, max_m=max(MAX_PULSES, 4 * run.length))
        for run in pieces
    ]
    return replace(
        free[0],
        outputs=np.concatenate([piece.outputs for piece in free], axis=1),
        refinement=max(piece.refinement for piece in free),
        change=np.max([piece.change for piece in free], axis=0),
    )


def compare_samples(model: Model, runs: Runs, free: Sequence[OutputSamples], *, m: int) -> Comparison:
    """Return a comparison from finished simulations of runs; the equation error is computed on m block pulses."""
    full = records(runs, model.structure, m)
    parts = []
    for run, sampled, rec in zip(runs, free, full, strict=True):
        outputs = dict(zip(model.outputs, measured_samples(model, run, sampled.refinement), strict=True))
        simulated = dict(zip(model.outputs, sampled.outputs, strict=True))
        parts.append(_run_errors(model, rec, simulated, outputs, sampled.initial, gaps=run.missing_samples))
    times = [compared_times(run, model.structure) for run in runs]
    result = _pooled_comparison(model, runs, parts, m, times, sampled=True)
    findings = list(result.findings)
    if restless := [run.name for run, sampled in zip(runs, free, strict=True) if _is_unconverged(sampled)]:
        findings.append(make_finding("sampling_coarse", run=", ".join(restless)))
    if moving := runs_in_motion(model, runs):
        findings.append(make_finding("simulated_from_rest", run=", ".join(moving)))
    return replace(result, findings=tuple(findings))


def _is_unconverged(sampled: OutputSamples) -> bool:
    """Whether a simulation is finite, but halving the time step still changes it noticeably."""
    return bool(np.all(np.isfinite(sampled.outputs)) and np.any(sampled.change > VISIBLE_STEP_CHANGE))


def compare_means(model: Model, runs: Run | Sequence[Run], *, m: int | None = None) -> Comparison:
    """Return output error and equation error on the means over m block pulses, as in the paper's tables.

    A mean averages neighboring samples. These errors therefore understate noise, and overstate model errors if an
    oscillation has few pulses per period.
    """
    several, m = _check_arguments(model, runs, m)
    check_no_missing(several, "figures of pulse means")
    pairs = zip(comparison_records(several, model, m), records(several, model.structure, m), strict=True)
    parts = []
    for free, full in pairs:
        responses, initial = respond(model, free)
        parts.append(_run_errors(model, full, responses, {o: free.of(o) for o in model.outputs}, initial))
    middles = [np.asarray((np.arange(m) + 0.5) * p.step, dtype=np.float64) for p in parts]
    return _pooled_comparison(model, several, parts, m, middles, sampled=False)


def _check_arguments(model: Model, runs: Run | Sequence[Run], m: int | None) -> tuple[Runs, int]:
    """Return the runs and the number of pulses; raise if runs lack a signal of the model or are too short."""
    check_model(model)
    several = as_runs(runs)
    carried = min(run.length for run in several) - 1
    length = min(model.m or default_m(several, power_of_two=False), carried) if m is None else m
    m = check_m(length, several, power_of_two=False)
    for run in several:
        run.require_outputs([o for o in model.outputs if o in run])
    return several, m


def describe_missing_equation_errors(why: Mapping[str, str]) -> list[str]:
    """Return lines of text on outputs without an equation error, with the reasons."""
    return [f"{name} has no equation error: {reason}" for name, reason in why.items()]


def offset_values(model: Model, initial: Mapping[str, Mapping[float, float]]) -> dict[str, dict[str, float]]:
    """Return offsets of the equations, computed from their fitted responses c t^alpha / Gamma(alpha + 1).

    `initial` has the coefficients of the powers of t by output and exponent. The result is output -> kind -> value.

    The result is empty for an output with initial terms of a history, whose powers of t make a constant unidentifiable,
    and for an output whose simulation diverges.
    """
    out: dict[str, dict[str, float]] = {}
    for item in model.equations:
        if LEVEL_EXPONENT in initial[item.output]:
            out[item.output] = {"level": initial[item.output][LEVEL_EXPONENT]}
            continue
        alone = initial_exponents(item, "caputo", model.structure.offset)
        exponent_set = {round(e, 9) for e in initial[item.output] if e > -1}
        if not exponent_set or (isinstance(model.structure.initial, str) and not exponent_set <= set(alone)):
            out[item.output] = {}
            continue
        exponents, values = map(np.array, zip(*initial[item.output].items(), strict=True))
        out[item.output] = {
            name: float(values[np.argmin(np.abs(exponents - power))]) * math.gamma(power + 1.0)
            for name, power in offset_exponents(item.order.constant, model.structure.offset).items()
        }
    return out


def describe_offsets(comparison: Comparison) -> list[str]:
    """Return text on the offsets of every run that has any, one line per output."""
    lines = []
    for (run, _, _), offsets, initial in zip(comparison.per_run, comparison.offsets, comparison.initial, strict=False):
        for output, values in offsets.items():
            if not values:
                note = HIDDEN_OFFSET_NOTE if initial[output] else "not estimated, since the simulation diverges"
                lines.append(f"offset in the equation of {output} in {run}: {note}")
                continue
            if "level" in values:
                lines.append(f"level of {output} in {run} (estimated on that run, for it alone): {values['level']:.6g}")
                continue
            ramp = f" and {values['ramp']:.6g} t" if "ramp" in values else ""
            lines.append(
                f"offset in the equation of {output} in {run} (estimated on that run, for it alone): "
                f"{values['constant']:.6g}{ramp}"
            )
    return lines


def describe_initial_terms(comparison: Comparison) -> str:
    """Return text that names the runs whose initial terms and levels were estimated from their own outputs."""
    counts = [sum(map(len, terms.values())) for terms in comparison.initial]
    return ", ".join(f"{run[0]} ({n})" for run, n in zip(comparison.per_run, counts, strict=True) if n)


@dataclass(frozen=True)
class _RunErrors:
    """Data for the errors of one run, by output: simulation, measurement, equation signal and equation error."""

    step: float
    initial: dict[str, dict[float, float]]
    simulated: dict[str, Floats]
    measured: dict[str, Floats]
    equation_signals: dict[str, Floats]
    equation_errors: dict[str, Floats]


def _run_errors(
    model: Model,
    full: Record,
    simulated: dict[str, Floats],
    outputs: dict[str, Floats],
    initial: dict[str, dict[float, float]],
    *,
    gaps: Container[str] = (),
) -> _RunErrors:
    """Return the data for the errors of one run, after the sensor filter is applied to all signals.

    An output with missing samples (`gaps`) has no equation error, because it would be computed from interpolated
    samples.
    """
    (step, means, sensor), inputs, powers = full.core(), list(full.inputs), full.start
    core = step, np.nan_to_num(means) if model.structure.has_nonlinear_terms else means, sensor
    missed = {
        e.output: _core.equation_error(core, equation_tuple(e, full.signals), inputs, powers)
        for e in model.equations
        # An equation with friction has no equation error, because noise determines the sign of a measured velocity
        # at rest. Gaps and undefined non-linear terms have none either.
        if e.output not in gaps and e.friction is None and all(np.isfinite(full.of(t.column)).all() for t in e.terms)
    }
    return _RunErrors(full.step, initial, simulated, outputs, {o: full.of(o) for o in model.outputs}, missed)


def _pooled_comparison(
    model: Model, runs: Sequence[Run], parts: Sequence[_RunErrors], m: int, times: list[Floats], *, sampled: bool
) -> Comparison:
    """Return the comparison that pools the errors of all runs."""
    equation_error, output_error = _pooled_errors(parts)
    # Single runs may have equation errors although the pooled one is undefined.
    rubbed = {e.output for e in model.equations if e.friction is not None}
    gaps = {name for run in runs for name in run.missing_samples}
    unequated = {
        o: FRICTION_REASON if o in rubbed else MISSING_SAMPLES_REASON if o in gaps else UNDEFINED_TERM_REASON
        for o, f in equation_error.items()
        if f is UNKNOWN_METRICS
    }
    offsets = tuple(offset_values(model, p.initial) for p in parts)
    if model.structure.offset == "none":
        offsets = tuple({o: values for o, values in run.items() if values} for run in offsets)
    return Comparison(
        output_error,
        equation_error,
        [(run.name, *_pooled_errors([p])) for run, p in zip(runs, parts, strict=True)],
        {o: [p.simulated[o] for p in parts] for o in model.outputs},
        {o: [p.measured[o] for p in parts] for o in model.outputs},
        [p.step for p in parts],
        m,
        [p.initial for p in parts],
        tuple(near_identity_findings(model.structure, equation_error, output_error)),
        times,
        sampled,
        offsets if model.structure.offset != "none" or any(offsets) else (),
        unequated,
    )


def _pooled_errors(parts: Sequence[_RunErrors]) -> tuple[dict[str, Metrics], dict[str, Metrics]]:
    """Return (equation error, output error), each as metrics by output, pooled over runs."""
    outputs = parts[0].measured
    equation = {
        o: pooled_metrics([p.equation_signals[o] for p in parts], [p.equation_errors[o] for p in parts])
        if all(o in p.equation_errors for p in parts)
        else UNKNOWN_METRICS
        for o in outputs
    }
    free = {
        o: pooled_metrics([p.measured[o] for p in parts], [p.measured[o] - p.simulated[o] for p in parts])
        for o in outputs
    }
    return equation, free


def near_identity_findings(
    structure: Structure, equation_error: Mapping[str, Metrics], output_error: Mapping[str, Metrics]
) -> list[Finding]:
    """Return findings on outputs whose equation error is misleadingly small.

    If a term of the output has an order close to alpha, the equation predicts any smooth output from itself. Only the
    simulation reveals that such a model is wrong.
    """
    findings = []
    for item in structure.equations:
        name, alpha = item.output, item.order.constant
        equation, output = equation_error[name], output_error[name]
        close = [
            t.order.constant
            for t in item.terms
            if t.column == name and alpha - t.order.constant < NEAR_IDENTITY_ORDER_GAP
        ]
        # Negated so that NaN counts as bad. An undefined equation error is no evidence.
        unknown = math.isnan(equation.nr) and math.isfinite(output.nr)
        worse = not output.nr <= MAX_ERROR_RATIO * equation.nr and not unknown
        useless = not output.nr <= MAX_NORMALIZED_RESIDUAL
        if close and worse:
            listed = ", ".join(f"{order:g}" for order in close)
            listed = f"orders {listed} are" if len(close) > 1 else f"order {listed} is"
            numbers = {"orders": listed, "alpha": alpha, "nr": output.nr, "equation_nr": equation.nr}
            findings.append(make_finding("equation_says_identity", output=name, **numbers))
        elif worse and useless:
            findings.append(
                make_finding("simulation_worse_than_equation_error", output=name, nr=output.nr, equation_nr=equation.nr)
            )
        elif useless:
            findings.append(make_finding("explains_little", output=name, nr=output.nr))
    return findings


def validation_findings(own: Comparison, validation: Comparison) -> list[Finding]:
    """Return findings on validation runs that are also estimation runs, and on outputs whose fit drops."""
    findings = []
    for k, (name, _, _) in enumerate(own.per_run):
        for j, (other, _, _) in enumerate(validation.per_run):
            first_lags, tested = (
                np.stack([c.measured[o][i] for o in own.measured]) for c, i in ((own, k), (validation, j))
            )
            shared = common_rows(first_lags, tested)
            if shared == tested.shape[1] == first_lags.shape[1]:
                findings.append(make_finding("estimation_run_repeated", run=other, other=name))
            elif shared:
                numbers = {"count": shared, "rows": tested.shape[1]}
                findings.append(make_finding("estimation_rows_repeated", run=other, other=name, **numbers))
    return findings + validation_fit_findings({n: f.fit for n, f in own.output_error.items()}, validation)


#: Rows compared to align two recordings. Fewer common rows than the second number count as chance.
ALIGNMENT_ROWS, MIN_COMMON_ROWS = 8, 32


def common_rows(one: Floats, other: Floats) -> int:
    """Return the number of samples that two records have in common as parts of one recording; 0 if there are none.

    Both records have shape (outputs, samples).

    They have samples in common if one of them contains the other's first samples and agrees with it from there on.
    """
    if one.shape == other.shape and np.array_equal(one, other, equal_nan=True):
        return int(one.shape[1])
    for earlier, later in ((one, other), (other, one)):
        first = next(iter(np.flatnonzero(np.any(np.diff(later) != 0.0, axis=0))), 0)
        head = later[:, first : first + ALIGNMENT_ROWS]
        if head.shape[1] < ALIGNMENT_ROWS or earlier.shape[1] < MIN_COMMON_ROWS:
            continue
        windows = np.lib.stride_tricks.sliding_window_view(earlier, ALIGNMENT_ROWS, axis=1)
        for start in np.flatnonzero(np.all(windows == head[:, None, :], axis=(0, 2))) - first:
            count = min(earlier.shape[1] - start, later.shape[1])
            if start < 0 or count < MIN_COMMON_ROWS:
                continue
            if np.array_equal(earlier[:, start : start + count], later[:, :count], equal_nan=True):
                return int(count)
    return 0


def validation_fit_findings(estimation_fits: Mapping[str, float], validation: Comparison) -> list[Finding]:
    """Return findings on outputs whose fit on validation runs is far below that on the estimation data."""
    findings = []
    for other, _, figures in validation.per_run:
        for output, f in figures.items():
            # Negated so that a NaN fit counts as a drop.
            if (
                np.isfinite(estimation_fits.get(output, np.nan))
                and not f.fit >= estimation_fits[output] - MAX_FIT_DROP_POINTS
            ):
                numbers = {"before": estimation_fits[output], "after": f.fit, "where": ""}
                findings.append(make_finding("fit_falls", run=other, output=output, **numbers))
    return findings


_METRIC_LABELS = ("error (45)", "RMSE", "NR", "fit %")


def errors_table(compared: Iterable[tuple[str, Comparison]], *, units: Mapping[str, str] | None = None) -> Table:
    """Return a table of equation error and output error, with a row for each output of each comparison.

    Parameters
    ----------
    compared
        Pairs (role of the data, comparison), such as ``("estimation", result.comparison)``. A comparison with several
        runs has further rows for each run.
    units
        Units by output.
    """
    title = "Both errors"
    rows: list[list[Cell]] = []
    headings: dict[int, str] = {}
    unequated: dict[str, str] = {}

    def add(heading: str, equation: Mapping[str, Metrics], output: Mapping[str, Metrics]) -> None:
        headings[len(rows)] = heading
        for name in output:
            unit = (units or {}).get(name, "")
            label = symbol_html(name) + (Markup(" [{}]").format(unit) if unit else Markup(""))
            has_values = equation[name] is not UNKNOWN_METRICS
            rows.append(
                [
                    label,
                    *(astuple(equation[name]) if has_values else [None] * len(_METRIC_LABELS)),
                    *astuple(output[name]),
                ]
            )

    for label, comparison in compared:
        runs = comparison.per_run
        unequated |= comparison.without_equation_error
        if len(runs) > 1:
            add(f"{label}: {len(runs)} runs together", comparison.equation_error, comparison.output_error)
        for name, equation, output in runs:
            add(f"{label}: {name}", equation, output)
    reasons = [f"{words}." for words in describe_missing_equation_errors(unequated)]
    own = 1 + len(_METRIC_LABELS)
    if unequated and all(cell is None for row in rows for cell in row[1:own]):
        # Four empty columns would push the others off a narrow screen.
        shown_rows: list[list[Cell]] = [[row[0], *row[own:]] for row in rows]
        single = (("", 1), ("output error (simulation)", 4))
        return Table(
            title, ("output", *_METRIC_LABELS), shown_rows, groups=single, headings=headings, note=" ".join(reasons)
        )
    note = (
        "The equation error uses the measured output on the right-hand side and flatters a model whose orders are "
        "close to one another; only the simulation shows what the model knows."
    )
    groups = (("", 1), ("equation error", 4), ("output error (simulation)", 4))
    return Table(
        title,
        ("output", *_METRIC_LABELS, *_METRIC_LABELS),
        rows,
        groups=groups,
        headings=headings,
        note=" ".join([note, *reasons]),
    )


def filter_state(exponent: float) -> str:
    """Return a label for an initial term of negative exponent: -1 is an impulse, -2 its derivative, and so on.

    These terms represent the initial state of a sensor filter.
    """
    return f"filter's state {round(-exponent)}"


def initial_terms_table(comparison: Comparison, *, title: str = "Initial terms of the simulations") -> Table | None:
    """Return a table of the initial terms by run and output; None if every run starts at rest."""
    rows: list[list[Cell]] = [
        [name, symbol_html(output), Exact(exponent) if exponent > -1 else filter_state(exponent), value]
        for (name, _, _), initial in zip(comparison.per_run, comparison.initial, strict=True)
        for output, terms in initial.items()
        for exponent, value in terms.items()
    ]
    if not rows:
        return None
    rows += [
        [name, symbol_html(output), f"offset: {what}", value]
        for (name, _, _), offsets in zip(comparison.per_run, comparison.offsets, strict=False)
        for output, values in offsets.items()
        for what, value in values.items()
    ]
    note = "They describe how that record starts and are never carried to another."
    if comparison.offsets:
        note += (
            " An offset c on the right-hand side is the power alpha with the coefficient c/Gamma(alpha + 1); it is "
            "estimated on each run for that run alone."
        )
    return Table(title, ("run", "output", "exponent of t", "coefficient"), rows, note=note)


def warnings_html(warnings: Sequence[str]) -> Markup:
    """Return warnings as an HTML list; empty markup without warnings."""
    if not warnings:
        return Markup("")
    items = Markup("").join(Markup("<li>{}</li>").format(w) for w in warnings)
    return Markup("<p><strong>Warnings</strong></p><ul>{}</ul>").format(items)


def comparison_html(comparison: Comparison) -> str:
    """Return HTML with the warnings of a comparison and a table of the prediction and simulation error by run."""
    return str(warnings_html(comparison.warnings) + errors_table([("compared", comparison)]).to_html())
