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
from ftlm.data.run import Run
from ftlm.data.runs import Runs, as_runs
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
from ftlm.simulation.simulate import comparison_records, simulate_record
from ftlm.simulation.step_refinement import simulate_refined
from ftlm.structure.structure import Structure, offset_exponents
from ftlm.svg.html_page import Table
from ftlm.utils.arguments import check_arguments
from ftlm.utils.files import to_frame
from ftlm.utils.formatting import Cell, Exact, attributes, json_value, symbol_html
from ftlm.utils.validation import Floats, as_floats


@dataclass(frozen=True)
class Metrics:
    """Error metrics of one output: the metrics of eqs. (45) to (47) of the paper, and the fit in percent.

    Parameters
    ----------
    error
        Sum of absolute errors over all samples (or block pulses), in the unit of the output; eq. (45) of the paper.
    rmse
        Root mean square error, in the unit of the output; eq. (46) of the paper.
    nr
        Normalized residual: RMSE divided by the standard deviation of the output; eq. (47) of the paper.
    fit
        Fit in percent: 100 (1 - ‖y - ŷ‖ / ‖y - mean y‖), with the measured output y and the predicted output ŷ.
    """

    error: float
    rmse: float
    nr: float
    fit: float

    def to_dict(self) -> dict[str, float | None]:
        """Return the metrics as a dictionary for JSON."""
        return attributes(self, ("error", "rmse", "nr", "fit"))


#: Metrics of an output whose error cannot be computed: all are NaN.
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
        Error metrics; they are not finite if the prediction is not finite. NR and fit are meaningless if all measured
        values are equal.

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
    """Return the metrics of one output over several runs, without missing samples.

    `outputs` (measured) and `residuals` have one array per run; a missing sample is NaN in `outputs`. With several
    runs, the mean of each run is subtracted from its output.
    """
    finite = [~np.isnan(y) for y in outputs]
    if not all(k.all() for k in finite):
        outputs = [y[k] for y, k in zip(outputs, finite, strict=True)]
        residuals = [e[k] for e, k in zip(residuals, finite, strict=True)]
    if len(outputs) == 1:
        return Metrics(*_core.metrics(outputs[0], residuals[0]))
    return Metrics(*_core.metrics(np.concatenate([y - np.mean(y) for y in outputs]), np.concatenate(residuals)))


#: Difference alpha - nu below which an equation of order alpha predicts smooth outputs from its own term of order nu.
#: The fractional integral of order alpha - nu is then nearly the identity.
NEAR_IDENTITY_ORDER_GAP = 0.25
#: NR of the output error divided by NR of the equation error, above which the equation error is misleading.
MAX_ERROR_RATIO = 5.0
#: Decrease of the fit from estimation to validation data [percentage points] above which overfitting is reported.
MAX_FIT_DROP_POINTS = 20.0
#: Normalized residual (NR) of a simulation above which the model explains little of the output.
MAX_NORMALIZED_RESIDUAL = 0.5
#: Change of a simulation when its step is halved, relative to its largest value, at which refinement terminates.
REFINEMENT_TOLERANCE = 1e-6
#: Maximum number of block pulses of a refined simulation. Four per sample are allowed in any case.
MAX_PULSES = 1 << 20
#: Change of a simulation when its step is halved, relative to its largest value, above which a finding reports that
#: the simulation has not converged.
VISIBLE_STEP_CHANGE = 1e-3


@dataclass(frozen=True)
class Comparison:
    """Errors of a model on measured runs: output error of the simulation, and equation error.

    Parameters
    ----------
    output_error, equation_error
        Metrics by output, over all runs. The output error is the error of the simulation. The equation error is the
        error of the equation when measured signals are inserted on its right-hand side.
    per_run
        One tuple (run name, equation error, output error) for each run; both errors are metrics by output.
    simulated, measured
        Simulated and measured values by output, one array per run: samples at the sample times, or means over block
        pulses if ``output_samples`` is False. Missing samples are NaN in ``measured`` and excluded from the output
        error. An output with missing samples has no equation error.
    step
        Width [s] of the block pulses with which the equation error is computed, for each run.
    m
        Number of block pulses per run with which the equation error is computed.
    initial
        Coefficients of the initial terms (powers of t) in the simulation, one mapping per run: output -> exponent ->
        value. Each mapping applies to its run only.
    findings
        Findings that state why these metrics may be misleading.
    times
        Time of each value of ``simulated`` and ``measured`` [s since the first sample], one array per run.
    output_samples
        Whether samples at the sample times are compared; False for means over block pulses, as in the paper.
    offsets
        Estimated offsets, one mapping per run: output -> kind -> value. Kinds are ``"level"`` [unit of the output y],
        or ``"constant"`` [unit of D^alpha y] and ``"ramp"`` [unit of D^alpha y per second]. They are estimated on each
        run separately. Empty for a model without an offset. The mapping of an output is empty if its initial terms make
        the offset unidentifiable or its simulation diverges.
    without_equation_error
        Reason by output name, for each output without an equation error: friction, missing samples, or a non-linear
        term that is undefined for some samples.
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

    #: Same as `fit`, under a name that states the unit.
    fit_percent = fit

    def to_frame(self) -> Any:
        """Return a pandas DataFrame of the metrics; one row per run, output and kind (output error, equation error)."""
        rows = [
            {"run": run, "output": name, "of": kind, "error": f.error, "rmse": f.rmse, "nr": f.nr, "fit": f.fit}
            for run, equation, output in self.per_run
            for kind, figures in (("equation error", equation), ("output error", output))
            for name, f in figures.items()
        ]
        return to_frame(rows, ["run", "output", "of"])

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as a dictionary for JSON."""
        keys = ("run", "equation_error", "output_error")
        return {
            **attributes(self, ("m", "output_error", "equation_error")),
            "runs": [dict(zip(keys, json_value(run_comparison), strict=True)) for run_comparison in self.per_run],
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
        return str(warnings_html(self.warnings) + errors_table([("compared", self)]).to_html())


#: Texts that state why an output has no equation error.
FRICTION_REASON = "friction acts on it, and the sign of a measured velocity is that of its noise, most of all at rest"
MISSING_SAMPLES_REASON = "some of its samples are missing, and interpolated samples are not measurements"
UNDEFINED_TERM_REASON = "a non-linear term of the measured signals has no value in some of the rows"
#: Note on an offset that is not identifiable, because the initial terms of a history explain it as well.
HIDDEN_OFFSET_NOTE = "not separately identifiable from the initial conditions; begin the run at rest to identify it"


@check_arguments
def compare(model: Model, runs: Run | Sequence[Run], *, m: int | None = None) -> Comparison:
    """Compare a model with measured runs, and return its output error and equation error.

    The output error compares each sample y[k] with the simulation (free run: only inputs and initial conditions are
    used) at the same time. The time step is refined until the simulation has converged, as in :func:`ftlm.simulate`.
    Initial values are fitted to the samples of the run, unless the model starts from rest. A prior limits the initial
    terms of a history (past inputs) to the response that plausible inputs before the run can cause. If the model of an
    unstable plant was identified from pieces of runs, each run is simulated in such pieces. Each piece then has its own
    initial values. The fit in percent is 100 (1 - ‖y - ŷ‖ / ‖y - mean y‖), where ŷ is the simulated output.

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
    run_list, m = _check_arguments(model, runs, m)
    return compare_samples(model, run_list, simulate_runs(model, run_list), m=m)


def simulate_runs(model: Model, runs: Sequence[Run]) -> list[OutputSamples]:
    """Return the simulated outputs of each run at its sample times, with initial terms fitted to the run.

    The time step is refined until the simulation has converged. If the model was identified from pieces of runs, each
    run is divided into pieces of the same duration, and each piece has its own initial terms.
    """
    duration = None if model.estimate is None else model.estimate.piece_duration
    return [_simulate_pieces(model, [run] if duration is None else run.split(duration)) for run in runs]


def _simulate_pieces(model: Model, pieces: Sequence[Run]) -> OutputSamples:
    """Simulate consecutive pieces of a run separately, and return the concatenated outputs.

    The result has the initial terms of the first piece.
    """
    simulations = [
        simulate_refined(model, run, None, tolerance=REFINEMENT_TOLERANCE, max_m=max(MAX_PULSES, 4 * run.length))
        for run in pieces
    ]
    return replace(
        simulations[0],
        outputs=np.concatenate([samples.outputs for samples in simulations], axis=1),
        refinement=max(samples.refinement for samples in simulations),
        change=np.max([samples.change for samples in simulations], axis=0),
    )


def compare_samples(model: Model, runs: Runs, simulations: Sequence[OutputSamples], *, m: int) -> Comparison:
    """Return the comparison of runs with their `simulations`, which are samples of the simulated outputs.

    The equation error is computed on `m` block pulses per run.
    """
    block_pulses = records(runs, model.structure, m)
    run_signals = []
    for run, sampled, rec in zip(runs, simulations, block_pulses, strict=True):
        outputs = dict(zip(model.outputs, measured_samples(model, run, sampled.refinement), strict=True))
        simulated = dict(zip(model.outputs, sampled.outputs, strict=True))
        run_signals.append(_run_signals(model, rec, simulated, outputs, sampled.initial, gaps=run.missing_samples))
    times = [compared_times(run, model.structure) for run in runs]
    result = _pooled_comparison(model, runs, run_signals, m, times, sampled=True)
    findings = list(result.findings)
    if unconverged_runs := [
        run.name for run, sampled in zip(runs, simulations, strict=True) if _is_unconverged(sampled)
    ]:
        findings.append(make_finding("sampling_coarse", run=", ".join(unconverged_runs)))
    if names_in_motion := runs_in_motion(model, runs):
        findings.append(make_finding("simulated_from_rest", run=", ".join(names_in_motion)))
    return replace(result, findings=tuple(findings))


def _is_unconverged(sampled: OutputSamples) -> bool:
    """Whether a simulation is finite, but changes by more than `VISIBLE_STEP_CHANGE` when its time step is halved."""
    return bool(np.all(np.isfinite(sampled.outputs)) and np.any(sampled.change > VISIBLE_STEP_CHANGE))


def compare_means(model: Model, runs: Run | Sequence[Run], *, m: int | None = None) -> Comparison:
    """Compare a model with runs by the means of signals over `m` block pulses, as in the tables of the paper.

    A mean averages neighboring samples. These errors therefore understate noise, and overstate model errors if an
    oscillation has few pulses per period.
    """
    run_list, m = _check_arguments(model, runs, m)
    check_no_missing(run_list, "figures of pulse means")
    pairs = zip(comparison_records(run_list, model, m), records(run_list, model.structure, m), strict=True)
    run_signals = []
    for rec, block_pulses in pairs:
        responses, initial = simulate_record(model, rec)
        run_signals.append(_run_signals(model, block_pulses, responses, {o: rec.of(o) for o in model.outputs}, initial))
    midpoint_times = [np.asarray((np.arange(m) + 0.5) * p.step, dtype=np.float64) for p in run_signals]
    return _pooled_comparison(model, run_list, run_signals, m, midpoint_times, sampled=False)


def _check_arguments(model: Model, runs: Run | Sequence[Run], m: int | None) -> tuple[Runs, int]:
    """Return the runs as a tuple, and the number of block pulses per run.

    Raise DataError if an output of the model is constant in a run, or if a run has it as an input. Raise ModelError if
    a run is too short for the number of pulses.
    """
    check_model(model)
    run_list = as_runs(runs)
    max_m = min(run.length for run in run_list) - 1
    length = min(model.m or default_m(run_list, power_of_two=False), max_m) if m is None else m
    m = check_m(length, run_list, power_of_two=False)
    for run in run_list:
        run.require_outputs([o for o in model.outputs if o in run])
    return run_list, m


def describe_missing_equation_errors(reasons: Mapping[str, str]) -> list[str]:
    """Return one line of text for each output without an equation error; `reasons` maps these outputs to reasons."""
    return [f"{name} has no equation error: {reason}" for name, reason in reasons.items()]


def offset_values(model: Model, initial: Mapping[str, Mapping[float, float]]) -> dict[str, dict[str, float]]:
    """Return the offsets of a run as output -> kind -> value, from the fitted coefficients of the powers of t.

    Kinds are ``"level"``, or ``"constant"`` and ``"ramp"``. `initial` has the coefficients by output and exponent. A
    constant c in an equation of order alpha has the response c t^alpha / Gamma(alpha + 1).

    The mapping of an output is empty if its simulation diverges. It is also empty with initial terms of a history,
    because their powers of t make a constant unidentifiable.
    """
    out: dict[str, dict[str, float]] = {}
    for equation in model.equations:
        if LEVEL_EXPONENT in initial[equation.output]:
            out[equation.output] = {"level": initial[equation.output][LEVEL_EXPONENT]}
            continue
        exponents_without_offset = initial_exponents(equation, "caputo", model.structure.offset)
        exponent_set = {round(e, 9) for e in initial[equation.output] if e > -1}
        if not exponent_set or (
            isinstance(model.structure.initial, str) and not exponent_set <= set(exponents_without_offset)
        ):
            out[equation.output] = {}
            continue
        exponents, values = map(np.array, zip(*initial[equation.output].items(), strict=True))
        out[equation.output] = {
            name: float(values[np.argmin(np.abs(exponents - power))]) * math.gamma(power + 1.0)
            for name, power in offset_exponents(equation.order.constant, model.structure.offset).items()
        }
    return out


def describe_offsets(comparison: Comparison) -> list[str]:
    """Return lines of text on the estimated offsets, one for each run and output."""
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
    """Return text with the names of the runs that have initial terms, each with the number of its terms."""
    counts = [sum(map(len, terms.values())) for terms in comparison.initial]
    return ", ".join(f"{run[0]} ({n})" for run, n in zip(comparison.per_run, counts, strict=True) if n)


@dataclass(frozen=True)
class _RunSignals:
    """Signals of one run from which its error metrics are computed, by output.

    Output error: ``simulated`` and ``measured``. Equation error: residuals ``equation_errors`` of the equations, and
    the block-pulse means ``equation_signals`` of the outputs. ``step`` is the width of a pulse [s]. ``initial`` has the
    coefficients of the initial terms by output and exponent of t.
    """

    step: float
    initial: dict[str, dict[float, float]]
    simulated: dict[str, Floats]
    measured: dict[str, Floats]
    equation_signals: dict[str, Floats]
    equation_errors: dict[str, Floats]


def _run_signals(
    model: Model,
    block_pulses: Record,
    simulated: dict[str, Floats],
    outputs: dict[str, Floats],
    initial: dict[str, dict[float, float]],
    *,
    gaps: Container[str] = (),
) -> _RunSignals:
    """Return the signals of one run from which its error metrics are computed.

    `block_pulses` is the block-pulse record for the equation error. In it, the sensor filter is applied to signals that
    were not measured through it. An output with missing samples (`gaps`) has no equation error, because interpolated
    samples are not measurements.
    """
    (step, means, sensor), inputs, powers = block_pulses.core(), list(block_pulses.inputs), block_pulses.start
    core = step, np.nan_to_num(means) if model.structure.has_nonlinear_terms else means, sensor
    equation_residuals = {
        e.output: _core.equation_error(core, equation_tuple(e, block_pulses.signals), inputs, powers)
        for e in model.equations
        # An equation with friction has no equation error, because noise determines the sign of a measured velocity
        # at rest. An output with gaps or with an undefined non-linear term has none either.
        if e.output not in gaps
        and e.friction is None
        and all(np.isfinite(block_pulses.of(t.column)).all() for t in e.terms)
    }
    return _RunSignals(
        block_pulses.step,
        initial,
        simulated,
        outputs,
        {o: block_pulses.of(o) for o in model.outputs},
        equation_residuals,
    )


def _pooled_comparison(
    model: Model, runs: Sequence[Run], run_signals: Sequence[_RunSignals], m: int, times: list[Floats], *, sampled: bool
) -> Comparison:
    """Return a comparison with the errors of each run, and with the errors pooled over all runs."""
    equation_error, output_error = _pooled_errors(run_signals)
    # Single runs may have equation errors although the pooled one is undefined.
    friction_outputs = {e.output for e in model.equations if e.friction is not None}
    gaps = {name for run in runs for name in run.missing_samples}
    missing_reasons = {
        o: FRICTION_REASON if o in friction_outputs else MISSING_SAMPLES_REASON if o in gaps else UNDEFINED_TERM_REASON
        for o, f in equation_error.items()
        if f is UNKNOWN_METRICS
    }
    offsets = tuple(offset_values(model, p.initial) for p in run_signals)
    if model.structure.offset == "none":
        offsets = tuple({o: values for o, values in run.items() if values} for run in offsets)
    return Comparison(
        output_error,
        equation_error,
        [(run.name, *_pooled_errors([p])) for run, p in zip(runs, run_signals, strict=True)],
        {o: [p.simulated[o] for p in run_signals] for o in model.outputs},
        {o: [p.measured[o] for p in run_signals] for o in model.outputs},
        [p.step for p in run_signals],
        m,
        [p.initial for p in run_signals],
        tuple(near_identity_findings(model.structure, equation_error, output_error)),
        times,
        sampled,
        offsets if model.structure.offset != "none" or any(offsets) else (),
        missing_reasons,
    )


def _pooled_errors(run_signals: Sequence[_RunSignals]) -> tuple[dict[str, Metrics], dict[str, Metrics]]:
    """Return (equation error, output error), each as metrics by output, pooled over runs."""
    outputs = run_signals[0].measured
    equation = {
        o: pooled_metrics([p.equation_signals[o] for p in run_signals], [p.equation_errors[o] for p in run_signals])
        if all(o in p.equation_errors for p in run_signals)
        else UNKNOWN_METRICS
        for o in outputs
    }
    simulation = {
        o: pooled_metrics([p.measured[o] for p in run_signals], [p.measured[o] - p.simulated[o] for p in run_signals])
        for o in outputs
    }
    return equation, simulation


def near_identity_findings(
    structure: Structure, equation_error: Mapping[str, Metrics], output_error: Mapping[str, Metrics]
) -> list[Finding]:
    """Return findings on outputs simulated poorly, or far less accurately than the equation error suggests.

    If a term of the output has nearly the order of the equation, the equation predicts any smooth output from itself.
    The equation error is then small for a wrong model as well, but the output error is not.
    """
    findings = []
    for single_equation in structure.equations:
        name, alpha = single_equation.output, single_equation.order.constant
        equation, output = equation_error[name], output_error[name]
        close_orders = [
            t.order.constant
            for t in single_equation.terms
            if t.column == name and alpha - t.order.constant < NEAR_IDENTITY_ORDER_GAP
        ]
        # Negated so that NaN counts as bad. An undefined equation error is no evidence against the model.
        is_undefined = math.isnan(equation.nr) and math.isfinite(output.nr)
        is_worse = not output.nr <= MAX_ERROR_RATIO * equation.nr and not is_undefined
        has_poor_fit = not output.nr <= MAX_NORMALIZED_RESIDUAL
        if close_orders and is_worse:
            orders_text = ", ".join(f"{order:g}" for order in close_orders)
            orders_text = f"orders {orders_text} are" if len(close_orders) > 1 else f"order {orders_text} is"
            details = {"orders": orders_text, "alpha": alpha, "nr": output.nr, "equation_nr": equation.nr}
            findings.append(make_finding("equation_says_identity", output=name, **details))
        elif is_worse and has_poor_fit:
            findings.append(
                make_finding("simulation_worse_than_equation_error", output=name, nr=output.nr, equation_nr=equation.nr)
            )
        elif has_poor_fit:
            findings.append(make_finding("explains_little", output=name, nr=output.nr))
    return findings


def validation_findings(estimation: Comparison, validation: Comparison) -> list[Finding]:
    """Return findings on validation samples that are also estimation samples, and on outputs with a far lower fit.

    `estimation` is the comparison of the model with its estimation runs.
    """
    findings = []
    for k, (name, _, _) in enumerate(estimation.per_run):
        for j, (validation_run, _, _) in enumerate(validation.per_run):
            estimation_samples, validation_samples = (
                np.stack([c.measured[o][i] for o in estimation.measured]) for c, i in ((estimation, k), (validation, j))
            )
            shared_rows = common_rows(estimation_samples, validation_samples)
            if shared_rows == validation_samples.shape[1] == estimation_samples.shape[1]:
                findings.append(make_finding("estimation_run_repeated", run=validation_run, other=name))
            elif shared_rows:
                details = {"count": shared_rows, "rows": validation_samples.shape[1]}
                findings.append(make_finding("estimation_rows_repeated", run=validation_run, other=name, **details))
    return findings + validation_fit_findings({n: f.fit for n, f in estimation.output_error.items()}, validation)


#: Number of successive samples that are compared to align two recordings, and minimum number of common samples.
#: Fewer samples may agree by chance.
ALIGNMENT_ROWS, MIN_COMMON_ROWS = 8, 32


def common_rows(first_series: Floats, second_series: Floats) -> int:
    """Return the number of samples that two excerpts of one recording share; 0 if they share none.

    Both arrays have shape (outputs, samples). They share samples if the later excerpt starts within the earlier one,
    and both are equal where they overlap.
    """
    if first_series.shape == second_series.shape and np.array_equal(first_series, second_series, equal_nan=True):
        return int(first_series.shape[1])
    for earlier, later in ((first_series, second_series), (second_series, first_series)):
        first_change = next(iter(np.flatnonzero(np.any(np.diff(later) != 0.0, axis=0))), 0)
        head = later[:, first_change : first_change + ALIGNMENT_ROWS]
        if head.shape[1] < ALIGNMENT_ROWS or earlier.shape[1] < MIN_COMMON_ROWS:
            continue
        windows = np.lib.stride_tricks.sliding_window_view(earlier, ALIGNMENT_ROWS, axis=1)
        for start in np.flatnonzero(np.all(windows == head[:, None, :], axis=(0, 2))) - first_change:
            count = min(earlier.shape[1] - start, later.shape[1])
            if start < 0 or count < MIN_COMMON_ROWS:
                continue
            if np.array_equal(earlier[:, start : start + count], later[:, :count], equal_nan=True):
                return int(count)
    return 0


def validation_fit_findings(estimation_fits: Mapping[str, float], validation: Comparison) -> list[Finding]:
    """Return a finding for each validation run and output with a fit `MAX_FIT_DROP_POINTS` below the estimation fit."""
    findings = []
    for validation_run, _, figures in validation.per_run:
        for output, f in figures.items():
            # Negated so that a NaN fit counts as a drop.
            if (
                np.isfinite(estimation_fits.get(output, np.nan))
                and not f.fit >= estimation_fits[output] - MAX_FIT_DROP_POINTS
            ):
                details = {"before": estimation_fits[output], "after": f.fit, "where": ""}
                findings.append(make_finding("fit_falls", run=validation_run, output=output, **details))
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
    missing_reasons: dict[str, str] = {}

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
        missing_reasons |= comparison.without_equation_error
        if len(runs) > 1:
            add(f"{label}: {len(runs)} runs together", comparison.equation_error, comparison.output_error)
        for name, equation, output in runs:
            add(f"{label}: {name}", equation, output)
    reasons = [f"{text}." for text in describe_missing_equation_errors(missing_reasons)]
    column_count = 1 + len(_METRIC_LABELS)
    if missing_reasons and all(cell is None for row in rows for cell in row[1:column_count]):
        # Four empty columns would push the others off a narrow screen.
        shown_rows: list[list[Cell]] = [[row[0], *row[column_count:]] for row in rows]
        single_heading = (("", 1), ("output error (simulation)", 4))
        return Table(
            title,
            ("output", *_METRIC_LABELS),
            shown_rows,
            groups=single_heading,
            headings=headings,
            note=" ".join(reasons),
        )
    note = (
        "The equation error uses the measured output on the right-hand side; only the simulation shows how well the "
        "model predicts. The equation error is small for any model whose orders are close to one another."
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
    """Return the label of an initial term whose exponent of t is negative.

    Such a term represents an initial state of a sensor filter: -1 is an impulse, -2 its derivative, and so on.
    """
    return f"filter's state {round(-exponent)}"


def initial_terms_table(comparison: Comparison, *, title: str = "Initial terms of the simulations") -> Table | None:
    """Return a table of the initial terms and offsets by run and output; None if no run has initial terms."""
    rows: list[list[Cell]] = [
        [name, symbol_html(output), Exact(exponent) if exponent > -1 else filter_state(exponent), value]
        for (name, _, _), initial in zip(comparison.per_run, comparison.initial, strict=True)
        for output, terms in initial.items()
        for exponent, value in terms.items()
    ]
    if not rows:
        return None
    rows += [
        [name, symbol_html(output), f"offset: {label}", value]
        for (name, _, _), offsets in zip(comparison.per_run, comparison.offsets, strict=False)
        for output, values in offsets.items()
        for label, value in values.items()
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
