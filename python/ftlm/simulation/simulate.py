"""Simulation of a model on the inputs of a run, and explicit Euler as a baseline."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ftlm import _core
from ftlm.data.run import Run
from ftlm.errors import ConvergenceError, DataError, ModelError
from ftlm.model.model import Model, check_model
from ftlm.simulation.discretization import (
    MAX_M,
    Record,
    apply_input_nonlinearity,
    equation_tuple,
    records,
    sensor_series,
)
from ftlm.simulation.initial_conditions import deviations
from ftlm.simulation.output_samples import LEVEL_EXPONENT
from ftlm.simulation.step_refinement import simulate_refined
from ftlm.structure.equation import Equation
from ftlm.structure.order import ORDER_RESOLUTION
from ftlm.structure.structure import check_initial
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import parameter, setting
from ftlm.utils.validation import Floats, real_number

#: Difference up to which two exponents of initial terms are equal.
EXPONENT_TOLERANCE = 1e-6


def comparison_records(runs: Sequence[Run], model: Model, m: int) -> list[Record]:
    """Return block-pulse records of runs for comparisons with simulations.

    Outputs are as measured, with or without the sensor filter. If a filtered signal is an input of a simulation, the
    filter is applied to all other signals.
    """
    return records(runs, model.structure, m, filtered=model.structure.all_filtered)


def simulate_record(model: Model, rec: Record) -> tuple[dict[str, Floats], dict[str, dict[float, float]]]:
    """Return simulated block-pulse means by output, and coefficients of initial terms by output and exponent.

    `rec` is one of the :func:`comparison_records`. The coefficients are fitted to the measured outputs by least
    squares.
    """
    structure = model.structure
    series = sensor_series(structure, rec.m, rec.step) if rec.sensor is None else None
    responses: dict[str, Floats] = {}
    initial: dict[str, dict[float, float]] = {}
    for group in [model.equations] if structure.coupling == "simulated" else [(e,) for e in model.equations]:
        names = [e.output for e in group]
        equations = [equation_tuple(e, rec.signals) for e in group]
        output_filter = None if series is None else (series, [structure.is_filtered(n) for n in names])
        outputs, exponents, values = _core.respond_with_initial(
            rec.core(), equations, list(rec.inputs), rec.start, output_filter
        )
        for i, name in enumerate(names):
            responses[name] = outputs[i]
            initial[name] = dict(zip(exponents[i], values[i], strict=True))
    return responses, initial


@check_arguments
def simulate(
    model: Model,
    run: Run,
    *,
    tolerance: float = 1e-6,
    initial: Mapping[str, Mapping[float, float] | Sequence[float]] | None = None,
    max_m: int = 1 << 22,
) -> Run:
    """Simulate a model with the inputs of a run, and return the outputs at the run's sample times.

    Models of integer orders are simulated exactly, by the matrix exponential of one sampling interval, if the samples
    are uniform and the model has no sensor filter, friction or non-linear term. For all other models, the step is
    halved until a further halving changes no output by more than ``tolerance`` times its largest value. Inputs follow
    their intersample behavior (a zero-order hold stays exact), and Richardson extrapolation removes the error terms
    with powers 2, 3 and 4 of the step.

    A simulated sample is the value just after the zero-order-hold inputs change at its time. It differs from the value
    just before the change only if the model has direct feedthrough.

    Parameters
    ----------
    model
        Model to simulate. With ``coupling="measured"``, the run must contain the outputs that are inputs of other
        equations.
    run
        Run with the inputs. Measured values of the simulated outputs are not used.
    tolerance
        Change of the outputs, relative to their largest value, at which the refinement of the step terminates.
    initial
        Initial values or initial terms of the outputs, by name; by default the run starts at rest. A sequence gives the
        initial values y(0), y'(0), ... by Caputo's definition. A mapping gives the coefficients of the initial terms
        (powers of t) by exponent, as in ``Comparison.initial``. The coefficient of t is not y'(0) if the equation has a
        term D y. If initial values imply further powers and these are missing, an error lists them.
        With a sensor filter, the exponents -1 and -2 are an impulse and its derivative, which represent the initial
        state of the filter. An offset c of the equation is the exponent alpha with the coefficient
        c / Gamma(alpha + 1). The exponent infinity is the level of an output; the values of the inputs before they
        change are then subtracted from the inputs.
    max_m
        Maximum number of block pulses. If the simulation has not converged with it, ConvergenceError is raised.

    Returns
    -------
    Run
        Run with the inputs and the simulated outputs, at the sample times of `run`. The sensor filter is applied to
        outputs that are measured through it, and to all outputs if a filtered signal is an input.

    Raises
    ------
    DataError
        If the run lacks a signal of the model.
    ModelError
        If an equation cannot be solved for its output, or the tolerance is not positive.
    ConvergenceError
        If the output of an unstable model overflows (the message has the time), or the simulation has not converged
        with ``max_m`` pulses.
    """
    check_model(model)
    if not isinstance(run, Run):
        raise DataError(f"run is {type(run).__name__}, not a Run; use ftlm.load or Run.from_arrays")
    sensor = model.structure.sensor_filter
    impulses = {-1.0 - k for k in range(sensor.relative_degree if sensor is not None else 0)}
    unknown = next((name for name in initial or {} if name not in model.outputs), None)
    if unknown is not None:
        raise ModelError(
            f"initial terms of {unknown!r}, which is no output of the model; give those of {', '.join(model.outputs)}"
        )
    for name, entry in (initial or {}).items():
        exponents = entry if isinstance(entry, Mapping) else ()
        has_transient = model.structure.has_filter_transient(name)
        check_initial([e for e in exponents if e != LEVEL_EXPONENT and not (has_transient and e in impulses)])
    initial_terms = _initial_terms(model, initial or {})
    if not real_number("tolerance", tolerance) > 0:
        raise ModelError(f"{setting('tolerance')} {tolerance} is not positive; the default is 1e-6")
    # The equations are simulated for deviations from given levels, which are added to the result.
    levels = {name: terms.get(LEVEL_EXPONENT, 0.0) for name, terms in initial_terms.items()}
    powers = {n: {e: v for e, v in terms.items() if e != LEVEL_EXPONENT} for n, terms in initial_terms.items()}
    if any(levels.values()):
        run = deviations(run, model.structure)[0]
    if model.structure.offset == "level":
        model = replace(model, structure=replace(model.structure, offset="none"))
    default_pulses = run.length - 1
    max_m = min(max_m, MAX_M)
    if default_pulses > max_m:
        raise ModelError(f"run {run.name!r} has {default_pulses} intervals, more than {max_m}; slice it")
    free = simulate_refined(
        model, _with_missing_outputs(run, model), powers, tolerance=tolerance, max_m=max_m, on_grid=True
    )
    for name, samples in zip(model.outputs, free.outputs, strict=True):
        if not np.all(np.isfinite(samples)):
            at = int(np.argmax(~np.isfinite(samples))) * run.step
            raise ConvergenceError(
                f"the simulation of {name} overflows {at:.4g} s into run {run.name!r}; "
                "the model is unstable: check its orders and coefficients"
            )
    if not np.all(free.change <= tolerance):
        raise ConvergenceError(
            f"the response of {', '.join(model.outputs)} still changes by more than {tolerance:g} of its size at "
            f"{default_pulses * free.refinement} pulses; raise {parameter('tolerance')} or {parameter('max_m')}, or "
            "check that "
            "the model is stable"
        )
    return Run.from_arrays(
        step=run.step,
        inputs={n: run[n] for n in run.inputs},
        outputs={n: free.outputs[i] + levels.get(n, 0.0) for i, n in enumerate(model.outputs)},
        units={n: u for n, u in _units(model, run).items() if u},
        intersample=run.intersample,
        name=f"{run.name}, simulated",
    )


def _initial_terms(
    model: Model, initial: Mapping[str, Mapping[float, float] | Sequence[float]]
) -> dict[str, dict[float, float]]:
    """Return the coefficients of the powers of t by output and exponent; initial values are converted to them.

    Raise ModelError if an output has more initial values than its order allows, if coupled equations have both initial
    values and powers, or if powers that the given integer powers imply are missing.
    """
    values: dict[str, list[float]] = {}
    powers: dict[str, dict[float, float]] = {}
    for equation in model.equations:
        output, order = equation.output, equation.order.constant
        entry = initial.get(output, {})
        if isinstance(entry, Mapping):
            powers |= {output: dict(entry)} if output in initial else {}
            continue
        values[output] = [real_number(f"an initial value of {output}", v) for v in entry]
        count = math.ceil(order - ORDER_RESOLUTION)
        if len(values[output]) > count:
            raise ModelError(
                f"{len(values[output])} initial values of {output}, but its equation of order {order:g} has {count}; "
                "give y(0) and the derivatives of lower order than the equation"
            )
        term = next((t for t in equation.nonlinear_terms if t.order.constant > 0.0), None)
        if term is not None and any(values[output]):
            raise ModelError(
                f"initial values of {output} beside the derivative of {term.column}, whose initial value they do not "
                "give; give powers of t"
            )
    if values and powers and model.structure.coupling == "simulated":
        raise ModelError(
            f"initial values of {next(iter(values))} and powers of t of {next(iter(powers))} in coupled equations; "
            "give initial values of all outputs, or powers of all"
        )
    for equation in model.equations:
        _check_powers(equation, powers.get(equation.output, {}))
    for equation in model.equations if values else ():
        output = equation.output
        acting = values if model.structure.coupling == "simulated" else {output: values.get(output, [])}
        implied = _powers_of_initial_values(equation, acting)
        if implied:
            powers[output] = implied
    return powers


def _powers_of_initial_values(equation: Equation, values: Mapping[str, Sequence[float]]) -> dict[float, float]:
    """Return the coefficients of the powers of t in an equation by exponent, for initial values of outputs.

    In an equation of order alpha, integrated alpha times, a term with Caputo's derivative D^nu y becomes
    I^(alpha - nu) (y - sum of y_i t^i / i!), where y_i are the initial values. This contains powers alpha - nu + i.
    """
    alpha = equation.order.constant
    coefficients = {float(i): v / math.factorial(i) for i, v in enumerate(values.get(equation.output, ()))}
    for term in equation.terms:
        order = term.order.constant
        for i, value in enumerate(values.get(term.column, ())):
            if not value or i >= math.ceil(order - ORDER_RESOLUTION):
                continue
            power = round(alpha - order + i, 9)
            if power <= -1.0:
                raise ModelError(
                    f"initial values of {term.column} make {equation.output} infinite at the start, because its "
                    f"equation of order {alpha:g} contains D^{order:g} {term.column}; give powers of t"
                )
            change = float(term.fixed_value or 0.0) * value / math.gamma(power + 1.0)
            coefficients[power] = coefficients.get(power, 0.0) - change
    return coefficients


def _check_powers(equation: Equation, terms: Mapping[float, float]) -> None:
    """Raise ModelError if powers of t that are implied by the given integer powers are missing.

    An integer power is taken for an initial value if a fractional power that it implies is missing, or if an integer
    power that it implies is missing or 0.
    """
    output = equation.output
    count = math.ceil(equation.order.constant - ORDER_RESOLUTION)
    integer_powers = {int(e): v for e, v in terms.items() if 0.0 <= e < count and e == int(e)}
    if not any(integer_powers.values()):
        return
    values = [math.factorial(i) * integer_powers.get(i, 0.0) for i in range(max(integer_powers) + 1)]
    implied_powers = _powers_of_initial_values(equation, {output: values})

    def is_missing(exponent: float) -> bool:
        value = next((v for e, v in terms.items() if abs(e - exponent) < EXPONENT_TOLERANCE), None)
        return value is None or (value == 0.0 and exponent == round(exponent))

    missing_exponents = [e for e, v in implied_powers.items() if v and is_missing(e)]
    if not missing_exponents:
        return
    fractional = next((e for e in missing_exponents if e != round(e)), None)
    if fractional is None:
        # Initial values that imply the given powers and no others.
        same_powers: list[float] = []
        for i in range(count):
            implied = _powers_of_initial_values(equation, {output: same_powers}).get(float(i), 0.0)
            same_powers.append(math.factorial(i) * (integer_powers.get(i, 0.0) - implied))
        otherwise = f"{[float(f'{v:.6g}') for v in same_powers]} for the given powers alone"
    else:
        otherwise = f"t^{fractional:g} as 0 if only the given powers are meant"
    powers_text = ", ".join(f"{e:g}: {v:.6g}" for e, v in sorted(implied_powers.items()))
    raise ModelError(
        f"initial terms of {output}: powers of t {', '.join(f'{e:g}' for e in sorted(integer_powers))}, but initial "
        f"values by Caputo's definition imply the powers {{{powers_text}}}; give "
        f"{parameter('initial')}{{{output!r}: {[float(f'{v:.6g}') for v in values]}}} for these initial values, or "
        f"{otherwise}"
    )


def _units(model: Model, run: Run) -> dict[str, str]:
    """Return the units of inputs (from the run, else the model) and outputs (from the model, else the run) by name."""
    inputs = {n: run.units[n] or model.units.get(n, "") for n in run.inputs}
    return inputs | {n: model.units.get(n, "") or run.units.get(n, "") for n in model.outputs}


def _with_missing_outputs(run: Run, model: Model) -> Run:
    """Return the run with zeros for outputs of the model that it lacks and that the simulation does not use.

    Raise DataError if such an output enters another equation as a measured signal.
    """
    missing_outputs = [o for o in model.outputs if o not in run]
    if not missing_outputs:
        return run
    users = {s: e.output for e in model.equations for s in e.signals if s != e.output}
    first_missing = next((o for o in missing_outputs if o in users), None)
    if first_missing is not None and model.structure.coupling != "simulated":
        raise DataError(
            f"run {run.name!r} has no signal {first_missing!r}, which enters the equation of {users[first_missing]} "
            "as measured; "
            f"give it, or use {parameter('coupling', 'simulated')}"
        )
    return run.with_outputs({n: np.zeros(run.length) for n in missing_outputs})


@check_arguments
def explicit_euler(model: Model, run: Run) -> dict[str, Floats]:
    """Simulate an integer-order model by explicit Euler steps of one sampling interval, as the baseline of the paper.

    Parameters
    ----------
    model
        Model with integer orders only, such as :func:`ftlm.link_model` with the values of the manual.
    run
        Run with the inputs. The paper uses a step of 0.002 s.

    Returns
    -------
    dict
        Samples by output. They are not finite if the method is unstable at this step. For the hub pole of the second
        joint (-500 1/s), a step of 2 ms is near the stability limit.

    Raises
    ------
    ModelError
        If an order is fractional, or the model has friction or a non-linear term.
    """
    signals = model.structure.signals
    run = apply_input_nonlinearity(run, model.structure)
    rows = [run[s] if s not in model.outputs else np.zeros(run.length) for s in signals]
    equations = [equation_tuple(e, signals) for e in model.equations]
    inputs = [s not in model.outputs for s in signals]
    outputs = _core.explicit_euler(np.stack(rows), run.step, equations, inputs)
    return dict(zip(model.outputs, outputs, strict=True))
