"""Findings on non-linear terms: their range, their share of the motion, chaos, and candidates for missing terms."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ftlm.data.run import Run
from ftlm.errors import FtlmError
from ftlm.estimation.closed_loop import run_with_inputs
from ftlm.findings import Finding, make_finding
from ftlm.kernels import integrate
from ftlm.model.model import Model
from ftlm.simulation.discretization import apply_input_nonlinearity, has_nonuniform_samples
from ftlm.simulation.nonlinear_columns import differentiate
from ftlm.simulation.output_samples import LEVEL_EXPONENT, OutputSamples, simulate_samples
from ftlm.structure.equation import Equation, Term, derivative
from ftlm.structure.expression import Channel, channel
from ftlm.structure.order import Order
from ftlm.structure.structure import Structure
from ftlm.utils.validation import Floats
from ftlm.validation.comparison import simulate_runs

#: Growth factor of a small change from the first to the second half of a run, above which the growth is exponential,
#: and maximum growth factor of the output. In bounded regular motion, a change grows at most in proportion to t.
MIN_CHAOTIC_GROWTH, MAX_OUTPUT_GROWTH = 16.0, 4.0
#: Change of an initial output, relative to the largest value of this output in the run.
INITIAL_CHANGE_RATIO = 1e-7


def nonlinear_findings(model: Model, runs: Sequence[Run], simulations: Sequence[OutputSamples]) -> list[Finding]:
    """Return findings on the non-linear terms of a model on its runs; [] for a linear model."""
    finite = all(np.isfinite(samples.outputs).all() for samples in simulations)
    if not model.structure.has_nonlinear_terms or not finite:
        return []
    values = [_signal_values(model, run, samples) for run, samples in zip(runs, simulations, strict=True)]
    findings = [f for equation in model.equations for f in _term_findings(equation, runs, values)]
    return [*findings, *_chaos_findings(model, runs, simulations)]


def _signal_values(model: Model, run: Run, samples: OutputSamples) -> dict[str, Floats]:
    """Return samples of all signals as they enter the equations, by name.

    These are simulated outputs without their levels, and inputs with saturation and dead zone applied.
    """
    limited = apply_input_nonlinearity(run.with_interpolated_gaps(), model.structure)
    levels = [samples.initial[output].get(LEVEL_EXPONENT, 0.0) for output in model.outputs]
    simulated = {o: y - level for o, y, level in zip(model.outputs, samples.outputs, levels, strict=True)}
    return {name: simulated[name] if name in simulated else limited[name] for name in model.structure.signals}


def _derive(values: Floats, order: float, step: float) -> Floats:
    """Return the fractional derivative (integral for a negative order) of samples; `step` is in seconds.

    The signal is constant before the first sample.
    """
    if order == 0:
        return values
    if order < 0:
        return integrate(values, -order, step=step)
    return differentiate(values - values[0], order, step, local_smoothing=False)


def _channel_values(values: dict[str, Floats], one: Channel, step: float) -> Floats:
    return _derive(values[one[0]], one[1], step)


def _term_values(term: Term, values: dict[str, Floats], step: float) -> Floats:
    """Return the value of a term at every sample, from samples of the signals."""
    shape = term.nonlinear
    if shape is None:
        argument = values[term.signal]
    else:
        argument = np.asarray(shape.evaluate({c: _channel_values(values, c, step) for c in shape.channels}))
        argument = np.broadcast_to(argument, values[term.signal].shape)
    return (term.fixed_value or 0.0) * _derive(argument, term.order.constant, step)


def _term_findings(equation: Equation, runs: Sequence[Run], values: Sequence[dict[str, Floats]]) -> Iterator[Finding]:
    """Yield a note on each non-linear term: its size relative to the highest derivative, and its signals' range."""
    pairs = list(zip(values, (run.step for run in runs), strict=True))
    right_sides = [sum((_term_values(t, v, h) for t in equation.terms), np.zeros(1)) for v, h in pairs]
    amplitude = _rms(right_sides)
    for term in equation.nonlinear_terms:
        shape = term.nonlinear
        fraction = _rms([_term_values(term, v, h) for v, h in pairs]) / amplitude if amplitude > 0 else math.nan
        if shape is None or not math.isfinite(fraction):
            continue
        ranges = []
        for one in shape.channels:
            ranges_seen = np.concatenate([_channel_values(v, one, h) for v, h in pairs])
            ranges.append(f"{channel(*one)} from {ranges_seen.min():.3g} to {ranges_seen.max():.3g}")
        yield make_finding(
            "nonlinear_range",
            output=equation.output,
            term=term.format_operand({}),
            share=100 * fraction,
            whole=derivative(replace(equation.order, constant=round(equation.order.constant, 4)), equation.output),
            ranges=", ".join(ranges),
        )


def _rms(parts: Sequence[Floats]) -> float:
    with np.errstate(over="ignore", invalid="ignore"):
        return math.sqrt(float(np.mean(np.concatenate(parts) ** 2)))


def _chaos_findings(model: Model, runs: Sequence[Run], simulations: Sequence[OutputSamples]) -> list[Finding]:
    """Return a finding if a small change of the initial outputs grows exponentially in the simulation.

    The output itself must not grow. As in chaotic motion, the end of the run then depends too strongly on the
    parameters for a meaningful fit to the whole run. Sensitivities to parameters do not show this: they also grow when
    an input that was constant starts to move.
    """
    worst: tuple[float, float, str] | None = None
    for run, samples in zip(runs, simulations, strict=True):
        half = run.length // 2
        peaks = np.abs(samples.outputs).max(axis=1, keepdims=True)
        peaks[peaks == 0.0] = 1.0
        try:
            y = simulate_samples(model, run, 1, samples.initial)[0] / peaks
        except FtlmError:
            continue
        if (np.abs(y[:, half:]).max(axis=1) > MAX_OUTPUT_GROWTH * np.abs(y[:, :half]).max(axis=1)).any():
            continue
        for output, peak in zip(model.outputs, peaks[:, 0], strict=True):
            terms = samples.initial[output]
            perturbed = {**samples.initial, output: {**terms, 0.0: terms.get(0.0, 0.0) + INITIAL_CHANGE_RATIO * peak}}
            try:
                change = np.abs(simulate_samples(model, run, 1, perturbed)[0] / peaks - y)
            except FtlmError:
                continue
            early_change, late_change = change[:, :half].max(), change[:, half:].max()
            growth = late_change / early_change if early_change > 0.0 else 0.0
            if math.isfinite(growth) and growth > (MIN_CHAOTIC_GROWTH if worst is None else worst[0]):
                initial_change = float(change[:, : max(half // 4, 1)].max())
                at = int(np.argmax(change.max(axis=0) > MIN_CHAOTIC_GROWTH * initial_change))
                worst = growth, at * run.step, run.name
    if worst is None:
        return []
    return [make_finding("simulation_chaotic", run=worst[2], growth=worst[0], seconds=worst[1])]


def nonlinear_term_inputs(
    structure: Structure, runs: Sequence[Run], model: Model, names: Sequence[str], signal: str
) -> dict[str, list[Run]]:
    """Return runs with non-linear terms of the output as an additional input `signal`, by the text of the term.

    The terms are the square and the cube of the output, and its product with each of the inputs `names` that is not
    delayed. In an equation with non-linear terms but without the output itself, the output is one of them. Terms that
    the equation has are left out. All are computed from simulations of `model` and divided by a power of the largest
    value. A coefficient of such an input has the effect of a small non-linear term, to first order. The result is empty
    for several equations, a coefficient law, and runs that are compared at nonuniform sample times.
    """
    is_single = len(structure.equations) == 1 and not structure.coefficient_law
    if not is_single or any(has_nonuniform_samples(run, structure) for run in runs):
        return {}
    (equation,) = structure.equations
    name = equation.output
    simulated = [simulation.outputs[0] for simulation in simulate_runs(model, runs)]
    scale = max(float(np.abs(y).max()) for y in simulated) or 1.0
    outputs = [y / scale for y in simulated]
    factors: dict[str, Sequence[Floats]] = {f"{name}^2": outputs, f"{name}^3": [y**2 for y in outputs]}
    factors |= {f"{name}*{n}": [run[n] for run in runs] for n in names if n not in structure.delay}
    if equation.nonlinear_terms and not any(t.signal == name and t.order == Order(0.0) for t in equation.terms):
        factors[name] = [np.ones_like(y) for y in outputs]

    def with_term(run: Run, values: Floats) -> Run:
        return run_with_inputs(run, {signal: values}).with_intersample({signal: "foh"})

    present = {t.column for t in equation.nonlinear_terms}
    return {
        text: [with_term(run, y * v) for run, y, v in zip(runs, outputs, values, strict=True)]
        for text, values in factors.items()
        if text not in present and "*".join(reversed(text.split("*"))) not in present
    }
