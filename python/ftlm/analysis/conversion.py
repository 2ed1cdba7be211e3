"""Conversion of models from and to python-control, and export to MATLAB (with FOMCON) and to JSON."""

from __future__ import annotations

import functools
import importlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from ftlm._core import __version__
from ftlm.analysis.frequency_response import check_no_input_nonlinearity, response_inputs, transfer_functions
from ftlm.analysis.rational_approximation import approximate, identifier, state_space_matrices
from ftlm.data.sampling import check_step
from ftlm.errors import ModelError
from ftlm.model.model import Model
from ftlm.simulation.discretization import check_linear
from ftlm.structure.equation import format_equation
from ftlm.structure.order import MAX_ORDER
from ftlm.structure.parser import equation
from ftlm.structure.polynomial import POWER_TOLERANCE
from ftlm.structure.structure import Structure
from ftlm.utils.arguments import check_arguments, warn_caller
from ftlm.utils.formatting import plural
from ftlm.utils.parameters import parameter, setting
from ftlm.utils.resources import python_control
from ftlm.utils.validation import Floats


def _comment(text: str, prefix: str) -> str:
    """Return a text as comment lines that begin with `prefix`; each line of the text becomes a comment."""
    lines = re.split(r"[\r\n\u2028\u2029\x0b\x0c\x85]+", text)
    return "\n".join(f"{prefix} {''.join(c if c.isprintable() else '?' for c in line)}" for line in lines)


@check_arguments
def json_text(model: Model) -> str:
    """Return the transfer functions of a model as JSON, exact in powers and coefficients.

    Parameters
    ----------
    model
        A linear model.

    Raises
    ------
    ModelError
        If an input has a saturation or a dead zone, or the model has friction, so that there is no transfer function.
    """
    check_no_input_nonlinearity(model, "a transfer function")
    transfer = transfer_functions(model)
    document = {
        "format": "ftlm-transfer-functions",
        "written_by": f"ftlm {__version__}",
        "name": model.structure.name,
        "outputs": list(transfer.outputs),
        "inputs": list(transfer.inputs),
        "units": dict(model.units),
        "delay_s": transfer.delay,
        "meaning": "output = sum over inputs of (sum of c s^p) / (sum of c s^p) exp(-s delay); pairs are [c, p]",
        "denominator": {o: [list(pair) for pair in pairs] for o, pairs in transfer.denominator.items()},
        "numerator": {
            o: {u: [list(pair) for pair in transfer.numerators[o, u]] for u in transfer.inputs}
            for o in transfer.outputs
        },
        "equations": [str(e) for e in model.equations],
    }
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


@check_arguments
def matlab_text(model: Model) -> str:
    """Return a MATLAB script that defines the transfer functions as vectors, and as FOMCON ``fotf`` objects.

    Parameters
    ----------
    model
        A linear model.

    Raises
    ------
    ModelError
        If an input has a saturation or a dead zone, or the model has friction.
    """
    check_no_input_nonlinearity(model, "a transfer function")
    transfer = transfer_functions(model)

    def vector(values: Sequence[float]) -> str:
        return "[" + " ".join(f"{v:.17g}" for v in values) + "]"

    lines = [
        _comment(f"{model.structure.name}, written by ftlm {__version__}", "%"),
        *(_comment(format_equation(e, model.structure.describe_inputs(".6g")), "%") for e in model.equations),
        "% G_y_u = (b(1)*s^nb(1) + ...)/(a(1)*s^na(1) + ...)*exp(-s*delay); SI units.",
        "% FOMCON (https://fomcon.net) makes fotf objects of them; without it the vectors remain.",
    ]
    names: set[str] = set()
    for output in transfer.outputs:
        for signal in transfer.inputs:
            numerator = transfer.numerators[output, signal]
            if not numerator:
                continue
            name = f"G_{identifier(output)}_{identifier(signal)}"
            while name in names:
                name += "_"
            names.add(name)
            denominator = transfer.denominator[output]
            lines += [
                "",
                _comment(f"{output} from {signal}", "%"),
                f"{name}.b = {vector([c for c, _ in numerator])};",
                f"{name}.nb = {vector([p for _, p in numerator])};",
                f"{name}.a = {vector([c for c, _ in denominator])};",
                f"{name}.na = {vector([p for _, p in denominator])};",
                f"{name}.delay = {transfer.delay[signal]:.17g};",
                "if exist('fotf', 'file')",
                f"  {name} = fotf({name}.a, {name}.na, {name}.b, {name}.nb, {name}.delay);",
                "end",
            ]
    return "\n".join(lines) + "\n"


@check_arguments
def control_text(model: Model, *, band: tuple[float, float], order: int = 5) -> str:
    """Return a Python script that builds the approximation of a model as a python-control system, without ftlm.

    Parameters
    ----------
    model
        A linear model.
    band
        Frequency band (low, high) of the approximation [rad/s].
    order
        Order of Oustaloup's filter, 1 to 50.

    Raises
    ------
    ModelError
        In the cases of :func:`approximate`; python-control need not be installed.
    """
    approximation = approximate(model, band=band, order=order)

    def matrix(values: Floats) -> str:
        rows = ",\n    ".join(repr([float(v) for v in row]) for row in values)
        return f"np.array([\n    {rows},\n])" if values.size else f"np.zeros({values.shape})"

    lines = [
        _comment(f"{model.structure.name}, written by ftlm {__version__}", "#"),
        *(_comment(format_equation(e, model.structure.describe_inputs(".6g")), "#") for e in model.equations),
        *(_comment(line, "#") for line in str(approximation).splitlines()),
        "import control",
        "import numpy as np",
        "",
        f"A = {matrix(approximation.a)}",
        f"B = {matrix(approximation.b)}",
        f"C = {matrix(approximation.c)}",
        f"D = {matrix(approximation.d)}",
        f"system = control.ss(A, B, C, D, inputs={list(approximation.inputs)!r}, "
        f"outputs={list(approximation.outputs)!r}, "
        f"name={identifier(model.structure.name)!r})",
    ]
    return "\n".join(lines) + "\n"


@check_arguments
def export_text(
    model: Model, to: Literal["control", "matlab", "json"], *, band: tuple[float, float] | None = None, order: int = 5
) -> str:
    """Return a model as text for another tool: a Python script, a MATLAB script, or JSON.

    `band` [rad/s] and `order` are passed to :func:`control_text` and apply to "control" only. Raise ModelError for an
    unknown tool, a missing band, or a model that the tool cannot represent.
    """
    if to == "json":
        return json_text(model)
    if to == "matlab":
        return matlab_text(model)
    if to != "control":
        raise ModelError(f"{setting('to')} {to!r} is not known; use 'control', 'matlab' or 'json'")
    if band is None:
        raise ModelError(
            "python-control has no fractional orders; give the frequency band of an approximation, as in "
            f"{parameter('band', (0.1, 100))}"
        )
    return control_text(model, band=band, order=order)


#: Fractional part of a delay in sampling intervals below which the delay counts as a multiple of the interval.
WHOLE_DELAY_TOLERANCE = 1e-9
#: Magnitude of a Markov parameter c A^k b, relative to the norms of its factors, below which it is rounding error.
MARKOV_TOLERANCE = 1e-12
_LABEL_PATTERN = re.compile(r"([A-Za-z]+)\[(\d+)\]")


@check_arguments
def to_tf(model: Model) -> Any:
    """Return a model of integer orders as a python-control TransferFunction, without approximation.

    Delays of inputs are not part of the transfer function; see the attribute ``delay``.

    Parameters
    ----------
    model
        A linear model of integer orders; equations are coupled.

    Returns
    -------
    control.TransferFunction
        System with named inputs and outputs, from the inputs to the measured outputs (a sensor filter of integer orders
        is included). Its attribute ``delay`` has the nonzero delays [s] by input, because python-control cannot
        represent them.

    Warns
    -----
    UserWarning
        If an input has a delay.

    Raises
    ------
    ModelError
        If an order is fractional, the model has friction, an input has a saturation or a dead zone or is measured
        through the sensor filter, or python-control is not installed.
    """
    control = python_control()
    check_no_input_nonlinearity(model, "a transfer function")
    transfer = transfer_functions(model)
    filtered, filter_numerator, filter_denominator = _output_filter(model, transfer.inputs)
    numerators, denominators = [], []
    for output in transfer.outputs:
        output_numerator, output_denominator = (
            (filter_numerator, filter_denominator) if output in filtered else (np.ones(1), np.ones(1))
        )
        denominator = np.convolve(_coefficients(transfer.denominator[output]), output_denominator)
        numerators.append(
            [np.convolve(_coefficients(transfer.numerators[output, u]), output_numerator) for u in transfer.inputs]
        )
        denominators.append([denominator] * len(transfer.inputs))
    names = {"inputs": list(transfer.inputs), "outputs": list(transfer.outputs)}
    system = control.TransferFunction(numerators, denominators, name=identifier(model.structure.name), **names)
    return _with_delay(system, transfer.delay)


@check_arguments
def to_ss(model: Model, *, step: float | None = None) -> Any:
    """Return a model of integer orders as a python-control StateSpace, without approximation.

    ``scipy.signal.StateSpace`` accepts its matrices ``A``, ``B``, ``C`` and ``D``.

    Parameters
    ----------
    model
        A linear model of integer orders; equations are coupled.
    step
        Sampling interval [s] for a discrete-time system, which is exact for inputs that are constant between samples.
        Delays of inputs, of any length, become states. None for continuous time.

    Returns
    -------
    control.StateSpace
        System with named inputs and outputs, from the inputs to the measured outputs (a sensor filter of integer orders
        is included). In continuous time, its attribute ``delay`` has the nonzero delays [s] by input.

    Warns
    -----
    UserWarning
        If an input has a delay, in continuous time.

    Raises
    ------
    ModelError
        In the cases of :func:`to_tf`, if an input order is above the order of its equation, if the step is not
        positive, or if an input has a negative delay in discrete time.
    """
    control = python_control()
    check_linear(model.equations, "a linear system in state space")
    check_no_input_nonlinearity(model, "a linear system in state space")
    orders = {o.constant for equation in model.equations for o in equation.orders}
    _coefficients([(1.0, order) for order in sorted(orders)])
    inputs = response_inputs(model, coupled=True)
    filtered, filter_numerator, filter_denominator = _output_filter(model, inputs)
    a, b, c, d = state_space_matrices(model, {}, (1.0, 1.0), 1)
    for i, name in enumerate(model.outputs):
        if name in filtered:
            a, b, c, d = _filter_output(
                a,
                b,
                c,
                d,
                i,
                np.pad(filter_numerator, (filter_denominator.size - filter_numerator.size, 0)),
                filter_denominator,
            )
    delay = {name: model.structure.delay.get(name, 0.0) for name in inputs}
    if step is not None:
        interval = check_step(step, "step")
        advanced_input = next((name for name, seconds in delay.items() if seconds < 0.0), None)
        if advanced_input is not None:
            raise ModelError(
                f"{advanced_input} acts {-delay[advanced_input]:g} s before its sample; shift its rows, and "
                "identify again"
            )
        a, b, c, d = _sample_system(a, b, c, d, [delay[name] for name in inputs], interval)
    names = {"inputs": list(inputs), "outputs": list(model.outputs), "name": identifier(model.structure.name)}
    if step is not None:
        return control.ss(a, b, c, d, interval, **names)
    return _with_delay(control.ss(a, b, c, d, **names), delay)


def _with_delay(system: Any, delay: Mapping[str, float]) -> Any:
    """Set the attribute `delay` of a system to the nonzero delays [s], warn about each, and return the system."""
    system.delay = {name: seconds for name, seconds in delay.items() if seconds}
    for name, seconds in system.delay.items():
        warn_caller(
            f"the delay of {name}, {seconds:g} s, is not in the system, only in the attribute delay; to_ss with "
            f"{parameter('step')} includes delays, and to_control with {parameter('band')} approximates them"
        )
    return system


def _output_filter(model: Model, inputs: Sequence[str]) -> tuple[tuple[str, ...], Floats, Floats]:
    """Return the filtered signals, and numerator and denominator of the sensor filter in descending powers of s.

    Without a filter, return () for the signals and 1 for both polynomials. Raise ModelError if an input is filtered, or
    an order is fractional.
    """
    sensor = model.structure.sensor_filter
    if sensor is None:
        return (), np.ones(1), np.ones(1)
    name = next((name for name in inputs if name in sensor.signals), None)
    if name is not None:
        raise ModelError(
            f"the input {name} has a sensor filter, whose inverse is not a transfer function; remove the filter"
        )
    return tuple(sensor.signals), _coefficients(sensor.numerator), _coefficients(sensor.denominator)


def _filter_output(
    a: Floats, b: Floats, c: Floats, d: Floats, output: int, numerator: Floats, denominator: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return state-space matrices in which a filter is applied to one output, in observer form.

    `output` is the index of the output. `numerator` and `denominator` are the coefficients of the filter in descending
    powers, and have the same length.
    """
    count, system_states = denominator.size - 1, a.shape[0]
    numerator, denominator = numerator / denominator[0], denominator / denominator[0]
    shift = np.eye(count, k=1)
    shift[:, :1] -= denominator[1:, None]
    filter_input = (numerator[1:] - denominator[1:] * numerator[0])[:, None]
    a = np.block([[a, np.zeros((system_states, count))], [filter_input @ c[output : output + 1], shift]])
    b = np.vstack([b, filter_input @ d[output : output + 1]])
    c = np.hstack([c, np.zeros((c.shape[0], count))])
    c[output], d[output] = numerator[0] * c[output], numerator[0] * d[output]
    c[output, system_states : system_states + 1] += 1.0
    return a, b, c, d


def _sample_system(
    a: Floats, b: Floats, c: Floats, d: Floats, delays: Sequence[float], step: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return discrete-time state-space matrices for zero-order-hold inputs with delays [s], which become states.

    For a delay that is not a multiple of the step, two successive values of the input act within each sampling interval
    (Åström and Wittenmark, Computer-Controlled Systems, section 2.3).
    """
    expm = importlib.import_module("scipy.linalg").expm

    def hold(column: Floats, seconds: float) -> tuple[Floats, Floats]:
        """Return the state-transition matrix over a duration [s], and the final zero-state response to a unit input.

        `column` is the input matrix of this input, shape (states, 1).
        """
        exponential = expm(np.block([[a, column], [np.zeros((1, a.shape[0] + 1))]]) * seconds)
        return exponential[:-1, :-1], exponential[:-1, -1:]

    count, inputs = a.shape[0], b.shape[1]
    whole_steps = [math.floor(delay / step + WHOLE_DELAY_TOLERANCE) for delay in delays]
    fractions = [max(delay - k * step, 0.0) for delay, k in zip(delays, whole_steps, strict=True)]
    lengths = [
        k + (fraction > WHOLE_DELAY_TOLERANCE * step) for k, fraction in zip(whole_steps, fractions, strict=True)
    ]
    state_count = count + sum(lengths)
    # The columns are the states, past values of each input, and the inputs at this sample.
    update, output_map = np.zeros((state_count, state_count + inputs)), np.zeros((c.shape[0], state_count + inputs))
    update[:count, :count], output_map[:, :count] = hold(np.zeros((count, 1)), step)[0], c
    state = count
    for j, length in enumerate(lengths):
        column, has_full_delay = b[:, j : j + 1], length > whole_steps[j]
        column_indices = [state_count + j, *range(state, state + length)]
        update[:count, [column_indices[whole_steps[j]]]] += hold(
            column, step - fractions[j] if has_full_delay else step
        )[1]
        output_map[:, column_indices[-1]] += d[:, j]
        if has_full_delay:
            update[:count, [column_indices[-1]]] += hold(column, step - fractions[j])[0] @ hold(column, fractions[j])[1]
        update[column_indices[1:], column_indices[:-1]] = 1.0
        state += length
    return update[:, :state_count], update[:, state_count:], output_map[:, :state_count], output_map[:, state_count:]


def _coefficients(pairs: Sequence[tuple[float, float]]) -> Floats:
    """Return polynomial coefficients in descending powers from (coefficient, power) pairs.

    Raise ModelError for a power that is not an integer.
    """
    bad_power = next((p for _, p in pairs if abs(p - round(p)) > POWER_TOLERANCE or p < -POWER_TOLERANCE), None)
    if bad_power is not None:
        raise ModelError(
            f"order {bad_power:g} is not a whole number of at least 0, so no system of python-control is exact; "
            f"to_control with {parameter('band')} approximates one"
        )
    values = np.zeros(1 + max((round(p) for _, p in pairs), default=0))
    for value, power in pairs:
        values[values.size - 1 - round(power)] += value
    return values


def structure_of(system: Any, inputs: Sequence[str] | None = None, outputs: Sequence[str] | None = None) -> Structure:
    """Return the structure of a python-control system; for arguments and errors see :meth:`ftlm.Model.from_control`."""
    if getattr(system, "dt", None) not in (0, None):
        raise ModelError(
            f"the system is sampled (dt = {system.dt}); an equation is in continuous time; give a continuous-time "
            "system"
        )
    if hasattr(system, "A"):
        polynomials = _from_state_space(*(np.asarray(getattr(system, n), dtype=float) for n in "ABCD"))
    elif hasattr(system, "num") and hasattr(system, "den"):
        polynomials = _from_fractions(system.num, system.den)
    else:
        raise ModelError(
            f"{type(system).__name__} is not a system of python-control with equations; for a measured response use "
            "ftlm.FrequencyData.from_arrays"
        )
    signals = _names("inputs", inputs, getattr(system, "input_labels", None), len(polynomials[0][1]))
    results = _names("outputs", outputs, getattr(system, "output_labels", None), len(polynomials))
    duplicates = sorted(set(signals) & set(results))
    if duplicates:
        raise ModelError(
            f"{', '.join(duplicates)}: each is the name of both an input and an output; pass {parameter('inputs')} and "
            f"{parameter('outputs')} with other names"
        )
    rows = zip(results, polynomials, strict=True)
    return equation(
        "\n".join(_equation_text(name, signals, *polynomial) for name, polynomial in rows),
        coupling="measured",
        delay=_input_delays(system, signals),
    )


def _input_delays(system: Any, signals: Sequence[str]) -> dict[str, float]:
    """Return the delays [s] in the attribute `delay` of a system, which :func:`to_tf` and :func:`to_ss` set.

    The attribute has the delay by input label; `signals` are the names of the inputs in the model. Raise ModelError for
    an attribute of another form.
    """
    delays = getattr(system, "delay", None) or {}
    labels = list(getattr(system, "input_labels", None) or signals)
    if not isinstance(delays, Mapping) or not set(delays) <= set(labels):
        raise ModelError(
            f"the attribute delay of the system is {delays!r}; give a dict with the delay [s] of each of the inputs "
            f"{', '.join(labels)}"
        )
    return {name: float(delays[label]) for label, name in zip(labels, signals, strict=True) if delays.get(label)}


def _equation_text(output: str, inputs: Sequence[str], denominator: Floats, numerators: Sequence[Floats]) -> str:
    """Return an equation D^n y = … as text, from a monic denominator and a numerator for each input.

    Polynomials have their highest power first. Raise ModelError if the order n is not from 1 to 10, a numerator has a
    higher order, or all numerators are 0.
    """
    order = denominator.size - 1
    if not 0 < order <= MAX_ORDER:
        raise ModelError(
            f"the equation of {output} would be of order {order}; an equation has an order from 1 to {MAX_ORDER:g}"
        )
    terms = [(-c, output, order - k) for k, c in enumerate(denominator) if k > 0]
    for name, numerator in zip(inputs, numerators, strict=True):
        if numerator.size > denominator.size:
            raise ModelError(f"{output} from {name} has more zeros than poles; add a fast pole")
        terms += [(c, name, numerator.size - 1 - k) for k, c in enumerate(numerator)]
    term_texts = [f"{float(c)!r} D^{k} {name}" for c, name, k in terms if c]
    if not any(name != output for c, name, _ in terms if c):
        raise ModelError(f"no input affects {output}; leave this output out")
    return f"D^{order} {output} = " + " + ".join(term_texts).replace("+ -", "- ")


def _from_fractions(numerator_table: Any, denominator_table: Any) -> list[tuple[Floats, list[Floats]]]:
    """Return, for each output, a common monic denominator and the numerator of each input over it.

    `numerator_table` and `denominator_table` are numerators and denominators by output and input, with the highest
    power first.
    """
    fractions = []
    for numerator_row, denominator_row in zip(numerator_table, denominator_table, strict=True):
        denominators = [np.trim_zeros(np.atleast_1d(np.asarray(d, dtype=float)), "f") for d in denominator_row]
        distinct_denominators: list[Floats] = []
        for d in (d / d[0] for d in denominators):
            if not any(
                d.size == denominator.size and np.array_equal(d, denominator) for denominator in distinct_denominators
            ):
                distinct_denominators.append(d)
        common = functools.reduce(np.convolve, distinct_denominators, np.ones(1))
        numerators = []
        for n, d in zip(numerator_row, denominators, strict=True):
            other_factors = [
                denominator for denominator in distinct_denominators if not np.array_equal(denominator, d / d[0])
            ]
            values = np.trim_zeros(np.atleast_1d(np.asarray(n, dtype=float)), "f") / d[0]
            numerators.append(functools.reduce(np.convolve, other_factors, values) if values.size else np.zeros(1))
        fractions.append((common, numerators))
    return fractions


def _from_state_space(a: Floats, b: Floats, c: Floats, d: Floats) -> list[tuple[Floats, list[Floats]]]:
    """Return, for each output, the monic denominator and the numerators of all inputs (Faddeev-LeVerrier algorithm)."""
    count = a.shape[0]
    denominator, powers = [1.0], [np.eye(count)]
    for k in range(1, count + 1):
        product = a @ powers[-1]
        denominator.append(-float(np.trace(product)) / k)
        powers.append(product + denominator[-1] * np.eye(count))
    scale = max(float(np.linalg.norm(a, 2)) if count else 0.0, 1e-300)
    fractions = []
    for i, row in enumerate(c):
        numerators = []
        for j in range(b.shape[1]):
            numerator = d[i, j] * np.array(denominator)
            numerator[1:] += [float(row @ p @ b[:, j]) for p in powers[:count]]
            if d[i, j] == 0.0:
                row_scale = float(np.linalg.norm(row) * np.linalg.norm(b[:, j]))
                markov_magnitudes = [abs(float(row @ np.linalg.matrix_power(a, k) @ b[:, j])) for k in range(count)]
                rows = [k for k, v in enumerate(markov_magnitudes) if v > MARKOV_TOLERANCE * row_scale * scale**k]
                numerator[: 1 + (rows[0] if rows else count)] = 0.0
            numerators.append(numerator)
        fractions.append((np.array(denominator), numerators))
    return fractions


def _names(kind: str, names_argument: Sequence[str] | None, labels: Sequence[str] | None, count: int) -> list[str]:
    """Return the names of `count` signals from the argument, or else from the labels of the system.

    The label u[0] becomes u0, or u if there is only one signal. `kind` is "inputs" or "outputs". Raise ModelError for a
    wrong number of names.
    """
    if names_argument is not None:
        names = [names_argument] if isinstance(names_argument, str) else list(names_argument)
        if len(names) != count:
            raise ModelError(
                f"{kind}: {plural(len(names), 'name', 'are')} given, but the system has {count}; give "
                f"{plural(count, 'name')}"
            )
        return names
    names = list(labels) if labels else [f"{kind[0]}[{k}]" for k in range(count)]
    label_matches = [_LABEL_PATTERN.fullmatch(n) for n in names]
    return [n if m is None else m[1] + (m[2] if count > 1 else "") for n, m in zip(names, label_matches, strict=True)]
