"""Rational state-space approximation of fractional models within a frequency band (Oustaloup)."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ftlm.analysis.frequency_response import check_no_input_nonlinearity, frequency_response, response_inputs
from ftlm.analysis.poles import stability
from ftlm.errors import ModelError
from ftlm.model.model import Model
from ftlm.simulation.discretization import check_linear
from ftlm.utils.arguments import check_arguments, warn_caller
from ftlm.utils.parameters import parameter
from ftlm.utils.resources import python_control
from ftlm.utils.validation import Floats, as_floats, check_integer, check_vector, frequency_pair

#: Maximum errors of the approximation without a warning.
MAX_GAIN_ERROR_DB, MAX_PHASE_ERROR_DEGREES = 1.0, 5.0
#: Number of frequencies at which the approximation is compared with the model.
COMPARISON_FREQUENCIES = 200
#: Factor by which filters extend beyond the band on both sides, because their phase is inaccurate near their ends.
BAND_EXTENSION_FACTOR = 100.0
#: Distance of a pole from the imaginary axis, relative to the lower end of the band, below which it counts as on it.
ORIGIN_POLE_RATIO = 1e-3
#: Maximum order of Oustaloup's filter. At higher orders, adjacent zeros and poles nearly cancel.
MAX_APPROXIMATION_ORDER = 50
#: Order of the Padé approximation of a delay.
PADE_ORDER = 4
#: Phase of a delay [rad] up to which its Padé approximation of order 4 is within 5 degrees.
PADE_ACCURATE_ANGLE = 5.7


def identifier(name: str) -> str:
    """Return a name converted to an identifier that is valid in MATLAB, Python and python-control."""
    valid_name = re.sub(r"[^A-Za-z0-9_]+", "_", name).strip("_")[:60]
    return valid_name if valid_name and valid_name[0].isalpha() else f"x_{valid_name}"


@dataclass(frozen=True)
class Approximation:
    """Rational state-space approximation of a fractional model within a frequency band.

    Parameters
    ----------
    a, b, c, d
        State-space matrices. Rows and columns follow the sequence of `outputs` and `inputs`.
    outputs, inputs
        Signal names.
    band
        Frequency band (low, high) of the approximation [rad/s].
    order
        Order of Oustaloup's filter; each fractional operator has 2 order + 1 poles.
    gain_error, phase_error
        Maximum gain error [dB] and phase error [degrees] over the band, by (output, input).
    stable
        Whether the approximation is stable.
    warnings
        Warnings about limits of the approximation, as sentences.
    """

    a: Floats
    b: Floats
    c: Floats
    d: Floats
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    band: tuple[float, float]
    order: int
    gain_error: dict[tuple[str, str], float]
    phase_error: dict[tuple[str, str], float]
    stable: bool
    warnings: tuple[str, ...]

    @property
    def state_count(self) -> int:
        """Number of states."""
        return int(self.a.shape[0])

    @check_arguments
    def frequency_response(self, w: Sequence[float] | Floats) -> NDArray[np.complex128]:
        """Return the complex response at angular frequencies w [rad/s], shape (outputs, inputs, W)."""
        omega = check_vector("w", as_floats("w", w))
        system = 1j * omega[:, None, None] * np.eye(self.state_count) - self.a
        response = self.c @ np.linalg.solve(system, np.broadcast_to(self.b, (omega.size, *self.b.shape))) + self.d
        return np.asarray(np.moveaxis(response, 0, -1), dtype=np.complex128)

    def __str__(self) -> str:
        gain, phase = max(self.gain_error.values()), max(self.phase_error.values())
        lines = [
            f"{self.state_count} states for {self.band[0]:g} to {self.band[1]:g} rad/s: within {gain:.2g} dB and "
            f"{phase:.2g} degrees of the model"
        ]
        return "\n".join(lines + [f"warning: {w}" for w in self.warnings])


def oustaloup(power: float, band: tuple[float, float], order: int) -> tuple[Floats, Floats, float]:
    """Return (p, r, gain) of Oustaloup's filter gain + sum of r_k / (s + p_k) for s^power, 0 < power < 1.

    `band` is (low, high) [rad/s]; p and r have 2 order + 1 elements. Source: doi:10.1109/81.817385.
    """
    low, high = band
    k = np.arange(-order, order + 1) + order
    count = 2 * order + 1
    ratio = high / low
    zeros = low * ratio ** ((k + 0.5 * (1 - power)) / count)
    roots = low * ratio ** ((k + 0.5 * (1 + power)) / count)
    gain = high**power
    # Each residue is a product of quotients, without the polynomials of numerator and denominator.
    differences = zeros[None, :] - roots[:, None]
    root_differences = roots[None, :] - roots[:, None]
    np.fill_diagonal(root_differences, 1.0)
    residues = gain * np.prod(differences / root_differences, axis=1)
    return roots, residues, gain


#: Linear combination of states, inputs and outputs of the approximation: coefficients by (kind, index).
_Signal = dict[tuple[Literal["state", "input", "output"], int], float]


def _sum(signals: Iterable[tuple[float, _Signal]]) -> _Signal:
    """Return the sum of factor * signal over (factor, signal) pairs.

    A signal is a linear combination of states, inputs and outputs.
    """
    total: _Signal = {}
    for factor, signal in signals:
        for source, value in signal.items():
            total[source] = total.get(source, 0.0) + factor * value
    return total


def _dense(signals: Sequence[_Signal], kind: str, width: int) -> Floats:
    """Return the coefficients of all states, inputs or outputs in signals as a matrix, one row per signal.

    `kind` is "state", "input" or "output", and `width` is the number of variables of this kind.
    """
    matrix = np.zeros((len(signals), width))
    for i, signal in enumerate(signals):
        for (source, j), value in signal.items():
            if source == kind:
                matrix[i, j] = value
    return matrix


def _filter_signal(
    states: list[_Signal], signal: _Signal, power: float, band: tuple[float, float], order: int
) -> _Signal:
    """Apply Oustaloup's filter for s^power to a signal, with one state per pole, and return the filtered signal.

    `states` contains the time derivative of each state. The derivatives of the new filter states are appended to it.
    """
    roots, residues, gain = oustaloup(power, band, order)
    summands = [(gain, signal)]
    for pole, residue in zip(roots.tolist(), residues.tolist(), strict=True):
        state_signal: _Signal = {("state", len(states)): 1.0}
        states.append(_sum([(pole, signal), (-pole, state_signal)]))
        summands.append((residue / pole, state_signal))
    return _sum(summands)


def _delay_input(states: list[_Signal], source: int, delay: float) -> _Signal:
    """Apply Padé's approximation of a delay [s] to the input with index `source`, and return the delayed signal.

    The states are in observer form, and their time derivatives are appended to `states`.
    """
    # Numerator and denominator are sum (2n-k)! n! / ((2n)! k! (n-k)!) x^k with x = -s tau and x = s tau.
    f, n = math.factorial, PADE_ORDER
    c = [f(2 * n - k) * f(n) / (f(2 * n) * f(k) * f(n - k)) for k in range(n + 1)]
    denominator = [c[k] * delay**k / (c[n] * delay**n) for k in range(n)]
    direct = (-1.0) ** n
    numerator = [(-1.0) ** k * denominator[k] - direct * denominator[k] for k in range(n)]
    first = len(states)
    last = first + n - 1
    for k in range(n):
        previous_state: _Signal = {("state", first + k - 1): 1.0} if k else {}
        states.append(
            _sum(
                [
                    (1.0, {("state", last): -denominator[k]}),
                    (1.0, previous_state),
                    (numerator[k], {("input", source): 1.0}),
                ]
            )
        )
    return {("state", last): 1.0, ("input", source): direct}


@check_arguments
def approximate(model: Model, *, band: tuple[float, float], order: int = 5) -> Approximation:
    """Return a rational state-space system that approximates a model within a frequency band.

    Parameters
    ----------
    model
        The model; its equations are coupled, with all signals except the outputs as inputs.
    band
        Frequency band (low, high) of the approximation [rad/s], 0 < low < high.
    order
        Order of Oustaloup's filter, 1 to 50; each distinct integral of fractional order has 2 order + 1 poles.

    Returns
    -------
    Approximation
        State-space system with its errors over the band.

    Raises
    ------
    ModelError
        If band or order is invalid, or the equations cannot be solved for their outputs.

    Notes
    -----
    Oustaloup's filters extend two decades beyond the band on both sides, because their phase is inaccurate near the
    ends. Integer orders are exact. Delays are replaced by Padé's approximation of order 4. The sensor filter is not
    included.
    """
    low, high = frequency_pair(band)
    if not (math.isfinite(low) and math.isfinite(high) and 0 < low < high):
        raise ModelError(f"band = ({low:g}, {high:g}) rad/s is not an interval; give 0 < low < high")
    count = check_integer("order", order, 1, MAX_APPROXIMATION_ORDER)
    check_linear(model.equations, "a linear system in state space")
    check_no_input_nonlinearity(model, "a linear system in state space")
    delays = model.structure.delay
    advanced_input = next((name for name, delay in delays.items() if delay < 0.0), None)
    if advanced_input is not None:
        raise ModelError(
            f"{advanced_input} acts {-delays[advanced_input]:g} s before it is logged, and no linear system "
            "responds before its "
            "input; shift the rows of that input, and identify again"
        )
    extended_band = (low / BAND_EXTENSION_FACTOR, high * BAND_EXTENSION_FACTOR)
    matrices = state_space_matrices(model, delays, extended_band, count)
    inputs, outputs = response_inputs(model, coupled=True), model.outputs
    without_errors = Approximation(*matrices, outputs, inputs, (low, high), count, {}, {}, stable=True, warnings=())
    return _with_errors(model, without_errors)


def state_space_matrices(
    model: Model, delays: Mapping[str, float], extended_band: tuple[float, float], count: int
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the state-space matrices A, B, C and D of a model with coupled equations.

    Inputs have the sequence of :func:`response_inputs`.

    Parameters
    ----------
    model
        A linear model. Integer orders are represented exactly.
    delays
        Delays of inputs [s] by name, which are approximated.
    extended_band, count
        Frequency band (low, high) [rad/s] and order of the filters that approximate fractional orders.

    Raises
    ------
    ModelError
        If an input order is above the order of its equation, or the equations form an algebraic loop.
    """
    inputs, outputs = response_inputs(model, coupled=True), model.outputs
    states: list[_Signal] = []
    sources: dict[str, _Signal] = {o: {("output", i): 1.0} for i, o in enumerate(outputs)}
    for i, name in enumerate(inputs):
        sources[name] = _delay_input(states, i, delays[name]) if delays.get(name) else {("input", i): 1.0}
    # With eta = alpha - nu, the equation D^alpha y = sum of c D^nu x over signals x becomes
    # y = sum of c s^-ceil(eta) s^(ceil(eta) - eta) x, where a filter approximates the fractional power. The integrators
    # of an equation form one chain, to which all terms are added (observer form). No integrator is unstable by itself,
    # and the model is exact at steady state and far below the band.
    filters: dict[tuple[str, float], _Signal] = {}
    output_signals: list[_Signal] = []
    for equation in model.equations:
        by_level: dict[int, list[tuple[float, _Signal]]] = {}
        for term in equation.terms:
            eta = round(equation.order.constant - term.order.constant, 9)
            integer_order = math.ceil(eta)
            if integer_order < 0:
                raise ModelError(
                    f"order {term.order.constant:g} of {term.signal} is {-eta:g} above alpha = "
                    f"{equation.order.constant:g} "
                    f"of {equation.output}: a state-space system has no derivative of its input; use "
                    "frequency_response()"
                )
            key = (term.signal, round(integer_order - eta, 9))
            if key not in filters:
                source = sources[term.signal]
                filters[key] = _filter_signal(states, source, key[1], extended_band, count) if key[1] > 0 else source
            by_level.setdefault(integer_order, []).append((float(term.fixed_value or 0.0), filters[key]))
        previous_integrator: _Signal = {}
        for level in range(max(by_level), 0, -1):
            states.append(_sum([*by_level.get(level, []), (1.0, previous_integrator)]))
            previous_integrator = {("state", len(states) - 1): 1.0}
        output_signals.append(_sum([(1.0, previous_integrator), *by_level.get(0, [])]))
    widths = {"state": len(states), "input": len(inputs), "output": len(outputs)}
    a, b, feedback = (_dense(states, kind, width) for kind, width in widths.items())
    output_matrix, direct, loop = (_dense(output_signals, kind, width) for kind, width in widths.items())
    loop_matrix = np.eye(len(outputs)) - loop
    if abs(float(np.linalg.det(loop_matrix))) < 1e-12:
        raise ModelError(
            f"the equations of {', '.join(outputs)} cannot be solved for these outputs, because they form an "
            "algebraic loop; change an equation"
        )
    c: Floats = np.asarray(np.linalg.solve(loop_matrix, output_matrix), dtype=np.float64)
    d: Floats = np.asarray(np.linalg.solve(loop_matrix, direct), dtype=np.float64)
    return a + feedback @ c, b + feedback @ d, c, d


def _with_errors(model: Model, system: Approximation) -> Approximation:
    """Return the approximation with its gain and phase errors, stability and warnings set."""
    low, high = system.band
    omega = np.geomspace(low, high, COMPARISON_FREQUENCIES)
    exact_response = frequency_response(model, omega, sensor=False)
    approximate_response = system.frequency_response(omega)
    gain, phase = {}, {}
    for i, output in enumerate(system.outputs):
        for j, signal in enumerate(system.inputs):
            if not np.any(exact_response[i, j]):
                continue
            with np.errstate(divide="ignore", invalid="ignore"):
                quotient = approximate_response[i, j] / exact_response[i, j]
                gain[output, signal] = float(np.max(np.abs(20 * np.log10(np.abs(quotient)))))
                phase[output, signal] = float(np.degrees(np.max(np.abs(np.angle(quotient)))))
    roots = np.linalg.eigvals(system.a)
    stable = bool(np.all(roots.real < -ORIGIN_POLE_RATIO * low))
    warnings = []
    worst_gain, worst_phase = max(gain.values(), default=0.0), max(phase.values(), default=0.0)
    if not (worst_gain <= MAX_GAIN_ERROR_DB and worst_phase <= MAX_PHASE_ERROR_DEGREES):
        warnings.append(
            f"from {low:g} to {high:g} rad/s the error of the approximation is up to {worst_gain:.2g} dB "
            f"and {worst_phase:.2g} degrees, so smaller gain and phase margins are meaningless; "
            + _error_cause(model, system)
        )
    sensor = model.structure.sensor_filter
    if sensor is not None:
        warnings.append(
            f"the sensor filter of {', '.join(sensor.signals)} is not in the system; multiply its transfer function by "
            "that of the filter"
        )
    if stability(model).unstable_poles != np.sum(roots.real > ORIGIN_POLE_RATIO * low):
        warnings.append(
            "the approximation and the model have different numbers of unstable poles, so its stability margins do not "
            "apply to the model; raise order, or move the band"
        )
    return replace(system, gain_error=gain, phase_error=phase, stable=stable, warnings=tuple(warnings))


def _error_cause(model: Model, system: Approximation) -> str:
    """Return text on the cause of large errors of an approximation, with the remedy."""
    nonzero_delays = {name: delay for name, delay in model.structure.delay.items() if delay}
    if nonzero_delays and system.band[1] * max(nonzero_delays.values()) > PADE_ACCURATE_ANGLE:
        name = max(nonzero_delays, key=lambda n: nonzero_delays[n])
        return (
            f"the delay of {name}, {nonzero_delays[name]:g} s, is left out above "
            f"{PADE_ACCURATE_ANGLE / nonzero_delays[name]:.3g} rad/s, "
            f"where its Padé approximation of order {PADE_ORDER} ends; lower the upper end of the band, or use "
            "frequency_response, which is exact"
        )
    return (
        f"the fractional orders have {2 * system.order + 1} poles each, which is too few for the band; raise order, or "
        "narrow the band"
    )


def _exact_band(model: Model) -> tuple[float, float]:
    """Return a frequency band [rad/s] for a system that needs no approximation; raise ModelError for other models."""
    orders = (o.constant for e in model.equations for o in e.orders)
    fractional = next((order for order in orders if not order.is_integer()), None)
    delayed_input = next((name for name, delay in model.structure.delay.items() if delay), None)
    if fractional is not None or delayed_input is not None:
        reason = f"order {fractional:g}" if fractional is not None else f"the delay of {delayed_input}"
        raise ModelError(
            f"{reason} is approximated within a frequency band; give the band in rad/s, as in "
            f"{parameter('band', (0.1, 100))}"
        )
    return 1.0, 1.0 + 1e-9


@check_arguments
def to_control(model: Model, *, band: tuple[float, float] | None = None, order: int = 5) -> Any:
    """Return a python-control system that approximates a model within a frequency band.

    Parameters
    ----------
    model, order
        See :func:`approximate`.
    band
        Frequency band (low, high) of the approximation [rad/s]. It may be omitted if no order is fractional and no
        input has a delay, because the system is then exact.

    Returns
    -------
    control.StateSpace
        System with named inputs and outputs. Its attribute ``approximation`` is the :class:`Approximation` with the
        errors.

    Warns
    -----
    UserWarning
        If the errors are too large for stability margins to be computed from the approximation, or the model has a
        sensor filter, which is not part of the system.

    Raises
    ------
    ModelError
        If python-control is not installed, or the band is missing; see also :func:`approximate`.
    """
    control = python_control()
    if band is None:
        band = _exact_band(model)
    approximation = approximate(model, band=band, order=order)
    for text in approximation.warnings:
        warn_caller(text)
    system = control.ss(
        approximation.a,
        approximation.b,
        approximation.c,
        approximation.d,
        inputs=list(approximation.inputs),
        outputs=list(approximation.outputs),
        name=identifier(model.structure.name),
    )
    system.approximation = approximation
    return system
