"""Frequency response of a model: transfer functions, exact response, standard deviation, and step response."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET
from numpy.typing import ArrayLike, NDArray

from ftlm.data.run import Run
from ftlm.errors import DataError, ModelError
from ftlm.model.model import Model
from ftlm.simulation.discretization import check_linear
from ftlm.simulation.simulate import simulate
from ftlm.structure.equation import Equation, Friction, Term
from ftlm.structure.input_nonlinearity import INPUT_EFFECT_LABELS
from ftlm.structure.order import Order
from ftlm.structure.polynomial import Polynomial, add_polynomial, multiply_polynomials
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import parameter
from ftlm.utils.validation import Complex, Floats, as_floats, check_choice

#: Magnitude of a sum of coefficients, relative to the sum of their magnitudes, below which it is rounding error.
CANCELLATION_TOLERANCE = 1e-13
#: Relative step of the numerical derivatives of the delta method.
DERIVATIVE_STEP_RATIO = 1e-6


def check_no_input_nonlinearity(model: Model, operation: str) -> None:
    """Raise ModelError if an input has a saturation or a dead zone; `operation` names the linear analysis."""
    for limit in model.structure.limits:
        raise ModelError(
            f"{limit.signal} passes a {INPUT_EFFECT_LABELS[limit.kind]} before it acts, which {operation} cannot "
            "represent; "
            "use simulations (simulate, compare), or a model of the equation without it"
        )


def response_inputs(model: Model, *, coupled: bool) -> tuple[str, ...]:
    """Return the names of the inputs of a response: all signals except the outputs.

    If the equations are not coupled, outputs that enter other equations are also inputs.
    """
    if coupled:
        return tuple(s for s in model.structure.signals if s not in model.outputs)
    input_names = [t.signal for e in model.equations for t in e.terms if t.signal != e.output]
    return tuple(dict.fromkeys(s for s in model.structure.signals if s in input_names))


def equation_polynomials(equation: Equation, names: Sequence[str]) -> tuple[list[Polynomial], dict[str, Polynomial]]:
    """Return the polynomials in s of an equation: a list for the outputs `names`, and a dictionary for other signals.

    Terms of the outputs are moved to the left-hand side. Raise ModelError for friction or a non-linear term.
    """
    check_linear([equation], "a frequency response")
    polynomials: list[Polynomial] = [{} for _ in names]
    input_polynomials: dict[str, Polynomial] = {}
    polynomials[names.index(equation.output)][equation.order.constant] = 1.0
    for term in equation.terms:
        value = {term.order.constant: float(term.fixed_value or 0.0)}
        if term.signal in names:
            add_polynomial(polynomials[names.index(term.signal)], value, -1.0)
        else:
            add_polynomial(input_polynomials.setdefault(term.signal, {}), value)
    return polynomials, input_polynomials


def determinant(matrix: list[list[Polynomial]]) -> Polynomial:
    """Return the determinant of a small matrix of polynomials by the Leibniz formula.

    Coefficients that are only rounding errors are omitted.
    """
    n = len(matrix)
    out: Polynomial = {}
    magnitudes: Polynomial = {}
    for order in itertools.permutations(range(n)):
        sign = 1.0
        for i, j in itertools.combinations(range(n), 2):
            sign = -sign if order[i] > order[j] else sign
        product: Polynomial = {0.0: 1.0}
        for i, j in enumerate(order):
            product = multiply_polynomials(product, matrix[i][j])
        add_polynomial(out, product, sign)
        add_polynomial(magnitudes, {p: abs(v) for p, v in product.items()})
    return {p: v for p, v in sorted(out.items()) if abs(v) > CANCELLATION_TOLERANCE * magnitudes[p]}


def nonzero_determinant(matrix: list[list[Polynomial]], names: Sequence[str]) -> Polynomial:
    """Return the determinant of the equations of the outputs `names`; raise ModelError if it is 0."""
    common_denominator = determinant(matrix)
    if not common_denominator:
        raise ModelError(
            f"the equations of {', '.join(names)} are linearly dependent (determinant 0); change one of them"
        )
    return common_denominator


@dataclass(frozen=True)
class TransferFunctions:
    """Transfer functions from every input to every output, exact in powers and coefficients.

    Parameters
    ----------
    outputs, inputs
        Signal names.
    denominator
        Denominator of each output as (coefficient, power) pairs, highest power first. Coupled outputs have the same
        denominator.
    numerators
        Numerator by (output, input), as pairs like the denominator; empty if the input has no effect on the output.
    delay
        Delay of each input [s].
    """

    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    denominator: dict[str, tuple[tuple[float, float], ...]]
    numerators: dict[tuple[str, str], tuple[tuple[float, float], ...]]
    delay: dict[str, float]


def coupled_outputs(model: Model, *, coupled: bool) -> list[tuple[str, ...]]:
    """Return the groups of outputs whose equations are solved together: one group if `coupled`, else one per output."""
    return [model.outputs] if coupled else [(o,) for o in model.outputs]


@check_arguments
def transfer_functions(model: Model, *, coupling: str = "simulated") -> TransferFunctions:
    """Return the transfer functions of a model, by Cramer's rule, without the sensor filter.

    Parameters
    ----------
    model
        The model.
    coupling
        ``"simulated"``: coupled equations, with all signals except the outputs as inputs. ``"measured"``: each equation
        alone, with the other outputs among its inputs.

    Returns
    -------
    TransferFunctions

    Raises
    ------
    ModelError
        If `coupling` is unknown, the model is not linear, or the equations cannot be solved for their outputs.
    """
    coupled = is_coupled(coupling)
    inputs = response_inputs(model, coupled=coupled)
    denominator: dict[str, tuple[tuple[float, float], ...]] = {}
    numerators: dict[tuple[str, str], tuple[tuple[float, float], ...]] = {}
    for names in coupled_outputs(model, coupled=coupled):
        items = [e for e in model.equations if e.output in names]
        rows = [equation_polynomials(e, names) for e in items]
        matrix = [lhs for lhs, _ in rows]
        common_denominator = nonzero_determinant(matrix, names)
        for j, output in enumerate(names):
            denominator[output] = _coefficient_pairs(common_denominator)
            for signal in inputs:
                column = [input_polynomials.get(signal, {}) for _, input_polynomials in rows]
                replaced_matrix = [[*row[:j], column[i], *row[j + 1 :]] for i, row in enumerate(matrix)]
                numerators[output, signal] = _coefficient_pairs(determinant(replaced_matrix))
    delay = {s: model.structure.delay.get(s, 0.0) for s in inputs}
    return TransferFunctions(model.outputs, inputs, denominator, numerators, delay)


def _coefficient_pairs(polynomial: Polynomial) -> tuple[tuple[float, float], ...]:
    return tuple((v, p) for p, v in sorted(polynomial.items(), reverse=True))


def is_coupled(coupling: str) -> bool:
    """Return True for the coupling "simulated", False for "measured"; raise ModelError for another coupling."""
    check_choice("coupling", coupling, ("simulated", "measured"))
    return coupling == "simulated"


@check_arguments
def frequency_response(model: Model, w: ArrayLike, *, coupling: str = "simulated", sensor: bool = True) -> Complex:
    """Return the exact frequency response of a model, with its fractional orders.

    Parameters
    ----------
    model
        The model.
    w
        Angular frequencies [rad/s], shape (W,), finite and nonnegative.
    coupling
        ``"simulated"``: coupled equations, with all signals except the outputs as inputs. ``"measured"``: each equation
        alone, with the other outputs among its inputs (in the sequence of ``model.structure.signals``).
    sensor
        Whether the sensor filter is included: the response of a filtered output is multiplied by the filter, and the
        response to a filtered input is divided by it.

    Returns
    -------
    ndarray of complex, shape (outputs, inputs, W)
        Response in SI units of output over input; infinite at a pole.

    Raises
    ------
    DataError
        If a frequency is negative or not finite.
    ModelError
        If `coupling` is unknown, an input has a saturation or dead zone, or the model is not linear.
    """
    check_no_input_nonlinearity(model, "a frequency response")
    coupled = is_coupled(coupling)
    omega = as_floats("w", w)
    if omega.ndim != 1 or omega.size == 0:
        raise DataError(f"w has shape {omega.shape}; give a vector of frequencies in rad/s")
    is_invalid = ~(np.isfinite(omega) & (omega >= 0))
    if np.any(is_invalid):
        index = int(np.argmax(is_invalid))
        raise DataError(
            f"w is {omega[index]} at index {index} ({int(np.sum(is_invalid))} such values in all); give finite "
            "frequencies of at least 0 rad/s"
        )
    inputs = response_inputs(model, coupled=coupled)
    out = np.zeros((len(model.outputs), len(inputs), omega.size), dtype=np.complex128)
    s = 1j * omega
    for names in coupled_outputs(model, coupled=coupled):
        items = [e for e in model.equations if e.output in names]
        a = np.zeros((omega.size, len(names), len(names)), dtype=np.complex128)
        b = np.zeros((omega.size, len(names), len(inputs)), dtype=np.complex128)
        for i, equation in enumerate(items):
            lhs, input_polynomials = equation_polynomials(equation, names)
            # Division by s^alpha at high frequencies avoids overflow.
            scale = np.maximum(omega, 1.0) ** -equation.order.constant
            for j, polynomial in enumerate(lhs):
                a[:, i, j] = scale * value_at(polynomial, s)
            for signal, polynomial in input_polynomials.items():
                b[:, i, inputs.index(signal)] = scale * value_at(polynomial, s)
        singular = np.abs(np.linalg.det(a)) == 0
        a[singular] = np.eye(len(names))
        response = np.linalg.solve(a, b)
        response[singular] = np.where(b[singular] != 0, np.inf, 0)
        for i, name in enumerate(names):
            out[model.outputs.index(name)] = response[:, i, :].T
    for k, name in enumerate(inputs):
        delay = model.structure.delay.get(name, 0.0)
        if delay:
            out[:, k] *= np.exp(-s * delay)
    filtered = model.structure.sensor_filter
    if sensor and filtered is not None:
        gain = value_at({o: c for c, o in filtered.numerator}, s) / value_at({o: c for c, o in filtered.denominator}, s)
        for i, name in enumerate(model.outputs):
            out[i] *= gain if name in filtered.signals else 1.0
        for k, name in enumerate(inputs):
            if name in filtered.signals:
                with np.errstate(divide="ignore", invalid="ignore"):
                    out[:, k] /= gain
    return out


def value_at(polynomial: Polynomial, s: NDArray[Any]) -> Complex:
    """Return the values of a polynomial with real powers at complex frequencies s, in the shape of s."""
    sum_of_terms = np.zeros(s.shape, dtype=np.complex128)
    for power, coefficient in polynomial.items():
        with np.errstate(divide="ignore", invalid="ignore"):
            sum_of_terms += coefficient * (np.ones_like(s) if power == 0 else s**power)
    return sum_of_terms


@check_arguments
def response_deviation(model: Model, w: ArrayLike, *, coupling: str = "simulated") -> tuple[Floats, Floats]:
    """Return standard deviations of gain and phase of the frequency response, by the delta method.

    Parameters
    ----------
    model
        Model with the covariance of an output-error fit (``model.estimate``).
    w, coupling
        See :func:`frequency_response`.

    Returns
    -------
    gain, phase
        Standard deviation of ln|H| (times 8.686 it is dB) and of arg H [rad], each of shape (outputs, inputs, W).

    Raises
    ------
    ModelError
        If the model has no covariance.
    """
    matrix = covariance_of(model)
    if matrix is None:
        raise ModelError(
            "this model has no covariance, so its response has no uncertainty; identify it with "
            f"{parameter('method', 'output-error')}, and without a term whose interval is infinite"
        )
    nominal = frequency_response(model, w, coupling=coupling)
    derivative = np.zeros((len(matrix), *nominal.shape), dtype=np.complex128)
    for k, step, upper_model, lower_model in shifted_models(model, np.any(matrix != 0, axis=1), DERIVATIVE_STEP_RATIO):
        higher, lower = (frequency_response(shifted, w, coupling=coupling) for shifted in (upper_model, lower_model))
        with np.errstate(divide="ignore", invalid="ignore"):
            derivative[k] = (higher - lower) / (2 * step) / nominal
    variances = [
        np.einsum("i...,ij,j...->...", component, matrix, component) for component in (derivative.real, derivative.imag)
    ]
    gain, phase = (np.sqrt(np.maximum(v, 0.0)) for v in variances)
    return gain, phase


def covariance_of(model: Model) -> Floats | None:
    """Return the covariance of the parameters in :func:`parameter_vector`; None if the model has no covariance."""
    if model.estimate is None or model.estimate.covariance is None:
        return None
    return np.asarray(model.estimate.covariance, dtype=np.float64)


def parameter_vector(model: Model) -> Floats:
    """Return all orders and coefficients of a model as a vector, equation by equation, then its input parameters.

    An equation contributes alpha, then order and coefficient of each term, then the parameters of its friction. The
    coefficient of a term includes its known factor. The input parameters (delays, saturations and dead
    zones) are those of ``Structure.fixed_input_parameters``.
    """
    parameters: list[float] = []
    for equation in model.equations:
        parameters += [
            equation.order.constant,
            *(v for t in equation.terms for v in (t.order.constant, float(t.fixed_value or 0.0))),
        ]
        parameters += [] if equation.friction is None else equation.friction.parameter_values
    return np.array([*parameters, *model.structure.fixed_input_parameters.values()])


def with_parameter_vector(model: Model, parameters: Floats) -> Model:
    """Return the model with parameters from a vector, in the sequence of :func:`parameter_vector`."""
    values = iter(parameters.tolist())
    equations = []
    for equation in model.equations:
        alpha = replace(equation.order, constant=next(values))
        # Keyword arguments are evaluated in this sequence: the order first, then the coefficient.
        terms = [
            replace(t, order=replace(t.order, constant=next(values)), coefficient=next(values) / t.factor)
            for t in equation.terms
        ]
        friction = (
            None
            if equation.friction is None
            else equation.friction.with_parameter_values([next(values) for _ in equation.friction.parameter_values])
        )
        equations.append(_replace_unchecked(equation, alpha, tuple(terms), friction))
    structure = replace(model.structure, equations=tuple(equations))
    return replace(
        model,
        structure=structure.with_input_parameters({name: next(values) for name in structure.fixed_input_parameters}),
    )


def shifted_models(model: Model, varied: NDArray[np.bool_], ratio: float) -> Iterator[tuple[int, float, Model, Model]]:
    """Yield (index, step, model with the parameter plus step, model with it minus step) for central differences.

    The parameters are those of :func:`parameter_vector` for which the mask `varied` is True. `ratio` is the step
    relative to the parameter, or to 1e-3 for smaller parameters.
    """
    values = parameter_vector(model)
    for k in np.flatnonzero(varied).tolist():
        step = ratio * max(abs(float(values[k])), 1e-3)
        shift = step * np.eye(values.size)[k]
        yield k, step, with_parameter_vector(model, values + shift), with_parameter_vector(model, values - shift)


def _replace_unchecked(
    equation: Equation, order: Order, terms: tuple[Term, ...], friction: Friction | None
) -> Equation:
    """Return an equation with other orders, terms and friction, without range checks.

    Numerical derivatives at a limit of the range require orders beyond the limit.
    """
    copied = copy.copy(equation)
    vars(copied).update(order=order, terms=terms, friction=friction)
    return copied


def linear_part(model: Model) -> Model:
    """Return the model without friction, saturations and dead zones, with the covariance of the other parameters.

    The result describes small deviations under three conditions. Velocities on which friction acts neither are 0 nor
    change sign. They are well above the Stribeck speed. Inputs are between dead zone and saturation.
    """
    structure, is_linear = model.structure, list[bool]()
    for equation in model.equations:
        is_linear += [True] * (1 + 2 * len(equation.terms))
        is_linear += [False] * (0 if equation.friction is None else len(equation.friction.parameter_values))
    is_linear += [True] * len(structure.delay) + [False] * (
        len(structure.fixed_input_parameters) - len(structure.delay)
    )
    equations = tuple(replace(e, friction=None) for e in structure.equations)
    matrix, estimate = covariance_of(model), model.estimate
    if matrix is not None and estimate is not None:
        rows = tuple(tuple(row) for row in matrix[np.ix_(is_linear, is_linear)].tolist())
        estimate = msgspec.structs.replace(estimate, covariance=rows)
    return replace(
        model, structure=replace(structure, equations=equations, input_nonlinearities=UNSET), estimate=estimate
    )


@check_arguments
def step_response(model: Model, time: ArrayLike, *, tolerance: float = 1e-6) -> Floats:
    """Return the response of every output to a unit step of every input, from rest.

    Parameters
    ----------
    model
        The model; its equations are coupled.
    time
        Uniform time points from 0 [s], shape (N,), N >= 3.
    tolerance
        Tolerance of the simulation; see :func:`ftlm.simulate`.

    Returns
    -------
    ndarray, shape (outputs, inputs, N)
        Responses, including sensor filter and delays. The step acts just after time 0.

    Raises
    ------
    DataError
        If the time points are not uniform from 0.
    ModelError
        If an input has a saturation or dead zone.
    ConvergenceError
        If the response of an unstable model overflows.
    """
    check_no_input_nonlinearity(model, "a step response")
    t = as_floats("time", time)
    if t.ndim != 1 or t.size < 3 or not np.all(np.isfinite(t)) or t[0] != 0:
        raise DataError("time is not a vector of at least three sample times [s] from 0; use numpy.arange")
    step = float(t[-1]) / (t.size - 1)
    irregular = np.abs(t - step * np.arange(t.size)) > 1e-6 * step
    if step <= 0 or np.any(irregular):
        raise DataError(
            f"time is not uniform, first at index {int(np.argmax(irregular))} ({int(np.sum(irregular))} in all); use "
            "numpy.arange"
        )
    inputs = response_inputs(model, coupled=True)
    coupled_model = replace(model, structure=replace(model.structure, coupling="simulated", initial="rest"))
    out = np.zeros((len(model.outputs), len(inputs), t.size))
    for k, name in enumerate(inputs):
        inputs_by_name = {n: np.full(t.size, float(n == name)) for n in inputs}
        zero_outputs = {n: np.zeros(t.size) for n in model.outputs}
        run = Run.from_arrays(step=step, inputs=inputs_by_name, outputs=zero_outputs, name=f"unit step of {name}")
        simulated = simulate(coupled_model, run, tolerance=tolerance)
        for i, output in enumerate(model.outputs):
            out[i, k] = simulated[output]
    return out
