"""Poles, zeros, stability, modes and steady-state gain of a model."""

from __future__ import annotations

import cmath
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from ftlm.analysis.frequency_response import (
    check_no_input_nonlinearity,
    coupled_outputs,
    covariance_of,
    equation_polynomials,
    is_coupled,
    nonzero_determinant,
    response_inputs,
    shifted_models,
    transfer_functions,
)
from ftlm.analysis.polynomial_zeros import (
    DISTINCT_ZERO_TOLERANCE,
    MAX_LOG_FREQUENCY,
    REAL_AXIS_ANGLE_RAD,
    common_base,
    right_zeros,
    roots_in_base,
    scaled_terms,
    zeros_of,
)
from ftlm.errors import ModelError
from ftlm.model.model import Model, check_model
from ftlm.structure.equation import Equation
from ftlm.structure.polynomial import POWER_TOLERANCE, Polynomial, add_polynomial
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import with_error
from ftlm.utils.parameters import parameter
from ftlm.utils.statistics import NORMAL_95
from ftlm.utils.validation import Complex, Floats

#: One-sided confidence level of an unstable mode, and number of standard errors by which the real part of its pole, or
#: the excess of orders that causes it, must exceed 0.
GROWTH_LEVEL = 0.99
GROWTH_SIGMAS = NormalDist().inv_cdf(GROWTH_LEVEL)


@dataclass(frozen=True)
class Stability:
    """Result of a stability test: whether bounded inputs give bounded outputs, with the reason.

    Parameters
    ----------
    stable
        Whether all poles have negative real parts. A pole at the origin makes the model unstable.
    unstable_poles
        Number of poles with positive real parts; NaN if a pole on the imaginary axis prevents the count.
    origin_order
        Order of the pole at s = 0: 0 for none, 1 for an integrator.
    on_axis
        Whether a pole other than s = 0 lies on the imaginary axis, within numerical accuracy.
    method
        Method used: ``"poles"`` (Matignon's criterion) or ``"argument principle"``.
    commensurate_order
        Largest number, at most 1, of which all powers of s are multiples; None if it would be below 0.01, or the method
        is the argument principle.
    """

    stable: bool
    unstable_poles: float
    origin_order: float
    on_axis: bool
    method: str
    commensurate_order: float | None

    def __bool__(self) -> bool:
        return self.stable

    def __str__(self) -> str:
        reasons = []
        if self.unstable_poles > 0:
            count = int(self.unstable_poles)
            reasons.append(f"{count} pole{'s' if count > 1 else ''} with a positive real part")
        if self.on_axis:
            reasons.append("a pole on the imaginary axis")
        if self.origin_order > 0:
            reasons.append(f"it integrates its input with order {self.origin_order:g}")
        verdict = "stable" if self.stable else f"not stable: {', '.join(reasons)}"
        method_text = self.method
        if self.method == "poles" and self.commensurate_order:
            method_text = "poles in s" if self.commensurate_order == 1.0 else f"poles in s^{self.commensurate_order:g}"
        return f"{verdict} ({method_text})"


def characteristic(model: Model, *, coupled: bool) -> list[Polynomial]:
    """Return the characteristic function of each group of coupled equations: a sum of c s^p, as a dictionary {p: c}."""
    return [
        nonzero_determinant([equation_polynomials(e, names)[0] for e in model.equations if e.output in names], names)
        for names in coupled_outputs(model, coupled=coupled)
    ]


@check_arguments
def poles(model: Model, *, coupling: str = "simulated") -> Complex:
    """Return the poles of a model; with fractional orders, those on the principal Riemann sheet.

    Parameters
    ----------
    model
        The model.
    coupling
        See :func:`frequency_response`.

    Returns
    -------
    ndarray of complex
        Values of s [rad/s], sorted by magnitude, without s = 0. With fractional orders ``|arg s| < pi``; with integer
        orders the negative real axis is included. Roots on other sheets are not poles; they only affect how a response
        decays.

    Raises
    ------
    ModelError
        If `coupling` is unknown, poles overflow, or their number differs from the count by the argument principle.

    Notes
    -----
    If the orders have a common base q, the characteristic function is a polynomial in s^q, whose roots are the
    eigenvalues of its companion matrix. Otherwise Newton's method in ln s finds the roots, and the argument principle
    verifies their number.
    """
    all_poles = [s for p in characteristic(model, coupled=is_coupled(coupling)) for s in _principal_roots(p, "poles")]
    return np.array(sorted(all_poles, key=lambda s: (abs(s), s.imag)), dtype=np.complex128)


@check_arguments
def zeros(model: Model, output: str | None = None, input: str | None = None) -> Complex:
    """Return the zeros of a transfer function; with fractional orders, those on the principal Riemann sheet.

    Parameters
    ----------
    model
        The model; its equations are coupled.
    output, input
        Names of the signals. A name may be omitted if the model has only one output or input.

    Returns
    -------
    ndarray of complex
        Values of s [rad/s], sorted by magnitude, without s = 0. With fractional orders ``|arg s| < pi``; with integer
        orders the negative real axis is included. Zeros that a pole cancels are also returned.

    Raises
    ------
    ModelError
        If a name is unknown, a name is required but missing, or zeros overflow.
    """
    transfer = transfer_functions(model)
    pair = []
    for kind, argument, choices in (("output", output, transfer.outputs), ("input", input, transfer.inputs)):
        if argument is None and len(choices) != 1:
            raise ModelError(f"the model has the {kind}s {', '.join(choices)}; name one with {parameter(kind)}")
        name = choices[0] if argument is None else argument
        if name not in choices:
            raise ModelError(f"{kind} {name!r} is not in the model; known: {', '.join(choices)}")
        pair.append(name)
    numerator = {power: value for value, power in transfer.numerators[pair[0], pair[1]]}
    roots = _principal_roots(numerator, "zeros") if numerator else []
    return np.array(sorted(roots, key=lambda s: (abs(s), s.imag)), dtype=np.complex128)


def _principal_roots(polynomial: Polynomial, kind: str) -> list[complex]:
    """Return the roots of a sum of c s^p on the principal Riemann sheet, with their conjugates.

    `kind` is "poles" or "zeros" in messages. Raise ModelError if roots overflow or some were not found.
    """
    upper = zeros_of(polynomial, math.pi)
    if not _has_integer_spacing(polynomial):
        upper = [w for w in upper if w.imag < math.pi - DISTINCT_ZERO_TOLERANCE]
    if any(abs(w.real) > MAX_LOG_FREQUENCY for w in upper):
        decades = int(MAX_LOG_FREQUENCY / math.log(10))
        raise ModelError(
            f"the {kind} overflow, outside of 1e-{decades} to 1e{decades} rad/s; change the unit of time "
            "or the coefficients"
        )
    poles = [s for w in upper for s in ({_pole(w), _pole(w.conjugate())} if w.imag else {_pole(w)})]
    if roots_in_base(polynomial) is None:
        expected, has_root_on_cut = right_zeros(polynomial, math.pi)
        if not has_root_on_cut and len(poles) != expected:
            raise ModelError(
                f"only {len(poles)} of {expected:.0f} {kind} were found (number by the argument principle); round the "
                "orders to multiples of 0.01"
            )
    return poles


def _has_integer_spacing(polynomial: Polynomial) -> bool:
    """Whether all powers of s differ by integers, so that there is a single Riemann sheet."""
    lowest = min(polynomial)
    return all(abs(p - lowest - round(p - lowest)) < POWER_TOLERANCE for p in polynomial)


def _pole(w: complex) -> complex:
    """Return s = exp(w) for w = ln s; s is exactly real if Im w is 0 or pi."""
    if abs(w.imag) in (0.0, math.pi):
        return complex(math.copysign(math.exp(w.real), 1.0 if w.imag == 0.0 else -1.0))
    return cmath.exp(w)


@check_arguments
def stability(model: Model, *, coupling: str = "simulated") -> Stability:
    """Test whether a model is stable, by its poles or by the argument principle.

    Parameters
    ----------
    model
        The model.
    coupling
        See :func:`frequency_response`. The coupled equations may be stable although single equations are not, and vice
        versa.

    Returns
    -------
    Stability
        Result that is True if the model is stable, and prints the reason if it is not.

    Raises
    ------
    ModelError
        If `coupling` is unknown.

    Notes
    -----
    If the orders have a common base q, the model is stable if every root lambda of the polynomial in s^q has ``|arg
    lambda| > q pi/2`` (Matignon 1996). Otherwise the argument principle gives the number of zeros of the characteristic
    function D(s) with positive real parts, (p_max − p_min)/2 − Φ/π. Here Φ is the change of arg D(jω) from ω = 0 to ∞,
    and p_max and p_min are the highest and lowest power of s in D. Delays of inputs do not affect stability.
    """
    coupled = is_coupled(coupling)
    unstable, has_root_on_axis, method = 0.0, False, "poles"
    polynomials = characteristic(model, coupled=coupled)
    for polynomial in polynomials:
        roots = roots_in_base(polynomial)
        if roots is not None:
            base_of_polynomial, values = roots
            margin = np.abs(np.angle(values)) - base_of_polynomial * math.pi / 2
            # Companion matrices give simple roots to about 1e-9; roots within 1e-7 rad of the axis count as on it.
            has_root_on_axis |= bool(np.any(np.abs(margin) <= 1e-7))
            unstable += float(np.sum(margin < -1e-7))
        else:
            count, is_near_axis = right_zeros(polynomial)
            unstable, has_root_on_axis, method = (
                unstable + count,
                has_root_on_axis or is_near_axis,
                "argument principle",
            )
    transfer = transfer_functions(model, coupling=coupling)
    origin = 0.0
    for output, pairs in transfer.denominator.items():
        lowest = min(p for _, p in pairs)
        for signal in transfer.inputs:
            numerator_orders = [p for _, p in transfer.numerators[output, signal]]
            origin = max(origin, round(lowest - min(numerator_orders), 9)) if numerator_orders else origin
    every_power = [p - min(polynomial) for polynomial in polynomials for p in polynomial]
    base = common_base(every_power) if method == "poles" else None
    is_stable = unstable == 0 and not has_root_on_axis and origin <= 0
    return Stability(is_stable, unstable, max(origin, 0.0), has_root_on_axis, method, base)


#: Half of the last printed digit of an order; smaller absolute values count as 0.
PRINTED_ORDER_TOLERANCE = 5e-5
#: Maximum argument of zeros that represent relaxations of a model without poles: D^0.5 y = -a y has a zero with
#: arg s = 2 pi.
MAX_SHEET_ANGLE_RAD = 2.0 * math.pi
#: Relative step of numerical derivatives. It is 10^4 times the resolution of powers, which is 1e-9.
POLE_DERIVATIVE_STEP_RATIO = 1e-5


@dataclass(frozen=True)
class Mode:
    """Mode of a model: an oscillatory pole pair or a relaxation.

    Parameters
    ----------
    pole
        Pole [rad/s]. For a conjugate pair, it is the pole with positive imaginary part. For a stable relaxation with
        the time constant T, it is -1/T.
    frequency
        Natural frequency abs(pole) [rad/s].
    damping
        Damping ratio -cos(arg pole): 1 for a stable relaxation, negative for an unstable mode.
    time_constant
        1/abs(Re pole) of an oscillation, 1/abs(pole) of a relaxation [s].
    oscillatory
        Whether the mode is a complex pole pair. A relaxation decays exponentially for integer orders, and as a power of
        time for fractional orders.
    frequency_error, damping_error, time_constant_error
        Standard errors from the parameter covariance of the model, in the units of the values; None without a
        covariance. The damping of a relaxation has no standard error.
    """

    pole: complex
    frequency: float
    damping: float
    time_constant: float
    oscillatory: bool
    frequency_error: float | None = None
    damping_error: float | None = None
    time_constant_error: float | None = None

    @property
    def unstable(self) -> bool:
        """Whether the mode is unstable."""
        return self.damping < 0

    def __str__(self) -> str:
        growth_text = ", grows" if self.unstable else ""
        if not self.oscillatory:
            return f"time constant {with_error(self.time_constant, self.time_constant_error)} s{growth_text}"
        hertz = self.frequency / (2 * math.pi)
        return (
            f"{with_error(self.frequency, self.frequency_error)} rad/s ({hertz:.3g} Hz), damping "
            f"{with_error(self.damping, self.damping_error)}{growth_text}"
        )


@check_arguments
def modes(model: Model, *, coupling: str = "simulated") -> tuple[Mode, ...]:
    """Return the modes of a model, slowest first: frequency, damping and time constant of each pole.

    Parameters
    ----------
    model
        The model.
    coupling
        See :func:`ftlm.analysis.frequency_response`.

    Returns
    -------
    tuple of Mode
        One mode per real pole or conjugate pair; poles at the origin are excluded. A pole that exists only because of
        an insignificant order excess (:class:`OrderExcess`) is excluded too. Standard errors are first-order
        approximations from the parameter covariance of the fit.

    Raises
    ------
    ModelError
        If `coupling` is unknown, or the model has friction, for which poles are not defined.

    Notes
    -----
    Poles are the zeros of the characteristic function D(s), a sum of c s^p, with abs(arg s) < pi. Orders need no common
    base, because Newton's method in ln s starts from the roots of D with rounded orders. A zero on the negative axis,
    within its uncertainty, is a relaxation. A model with orders below 1 may have no pole, and decays as a power of
    time. The zeros up to arg s = 2 pi then give its time constants, such as (c_0/c_p)^(-1/p) for D^p y = -c_0/c_p y.
    """
    check_model(model)
    coupled = is_coupled(coupling)
    result: list[Mode] = []
    for group, polynomial in enumerate(characteristic(model, coupled=coupled)):
        # A pole that underflows counts as a pole at the origin. A pole that overflows has no visible effect.
        zeros = [w for w in zeros_of(polynomial) or _relaxation_zeros(polynomial) if abs(w.real) < MAX_LOG_FREQUENCY]
        excess = order_excess(model, group, coupled=coupled)
        if excess is not None and not excess.significant:
            zeros = [w for w in zeros if all(abs(w - v) > DISTINCT_ZERO_TOLERANCE for v in excess.poles)]
        deviations = _standard_deviations(model, group, np.array(zeros), coupled=coupled)
        result += [_mode(w, deviation) for w, deviation in zip(zeros, deviations, strict=True)]
    return tuple(sorted(result, key=lambda mode: (mode.frequency, mode.pole.imag)))


@dataclass(frozen=True)
class OrderExcess:
    """Excess of the highest power of s in a characteristic function over the sum of the orders of its equations.

    Usually, the product of all D^alpha contains the highest power. If terms in the outputs of other equations contain a
    higher one with the opposite sign, the coupled equations have an unstable pole. As the excess decreases to 0, this
    pole tends to infinity, so data that do not determine the sign of the excess do not show whether the pole exists.

    Parameters
    ----------
    order_sum
        Sum of the orders alpha of the equations.
    excess
        Highest power of s minus this sum.
    error
        Standard error of the excess; None without a covariance.
    poles
        Unstable poles that do not exist without the excess, as ln s.
    """

    order_sum: float
    excess: float
    error: float | None
    poles: tuple[complex, ...]

    @property
    def significant(self) -> bool:
        """Whether the excess is significantly positive (99 %), or has no standard error."""
        return not self.error or self.excess > GROWTH_SIGMAS * self.error


def order_excesses(model: Model, *, coupling: str) -> list[OrderExcess]:
    """Return the order excesses that cause unstable poles, at most one for each group of coupled equations."""
    coupled = is_coupled(coupling)
    groups = range(len(coupled_outputs(model, coupled=coupled)))
    return [e for k in groups if (e := order_excess(model, k, coupled=coupled)) is not None]


def order_excess(model: Model, group: int, *, coupled: bool) -> OrderExcess | None:
    """Return the order excess that causes an unstable pole of a group of coupled equations; None if there is none."""
    names = coupled_outputs(model, coupled=coupled)[group]
    polynomial = characteristic(model, coupled=coupled)[group]
    order_sum, highest = sum(e.order.constant for e in model.equations if e.output in names), max(polynomial)
    if highest - order_sum < POWER_TOLERANCE:
        return None
    without_excess: Polynomial = {}
    for power, value in polynomial.items():
        add_polynomial(without_excess, {min(power, order_sum): value})
    growing, remaining = (
        [w for w in zeros_of(p) if w.imag <= DISTINCT_ZERO_TOLERANCE and w.real < MAX_LOG_FREQUENCY]
        for p in (polynomial, without_excess)
    )
    if len(growing) <= len(remaining):
        return None
    matrix, error = covariance_of(model), None
    if matrix is not None:
        gradient = _excess_gradient(model, names, highest)
        error = math.sqrt(max(float(gradient @ matrix @ gradient), 0.0))
    return OrderExcess(order_sum, highest - order_sum, error, tuple(growing[len(remaining) :]))


def _excess_gradient(model: Model, names: Sequence[str], highest: float) -> Floats:
    """Return the derivatives of the power `highest` minus the sum of orders, with respect to all parameters."""
    positions, at = {}, 0
    for equation in model.equations:
        positions[equation.output] = at
        at += 1 + 2 * len(equation.terms)
    gradient = np.zeros(at + len(model.structure.fixed_input_parameters))
    items = [e for e in model.equations if e.output in names]

    def highest_order(equation: Equation, name: str) -> tuple[float, int]:
        """Return the highest order of a signal in an equation, and its position in the parameter vector."""
        first = positions[equation.output]
        orders = [(equation.order.constant, first)] if equation.output == name else []
        orders += [
            (t.order.constant, first + 1 + 2 * k)
            for k, t in enumerate(equation.terms)
            if t.signal == name and t.fixed_value
        ]
        return max(orders, default=(-math.inf, first))

    products = [
        [highest_order(e, name) for e, name in zip(items, columns, strict=True)]
        for columns in itertools.permutations(names)
    ]
    for _, position in min(products, key=lambda product: abs(sum(power for power, _ in product) - highest)):
        gradient[position] += 1.0
    for equation in items:
        gradient[positions[equation.output]] -= 1.0
    return gradient


def _mode(w: complex, deviations: tuple[float, float, float] | None) -> Mode:
    """Return the mode of a zero s of the characteristic function, given as w = ln s.

    `deviations` contains the standard deviations of Re w, Im w and ln abs(Re s); None without a covariance.
    """
    magnitude, angle = math.exp(w.real), w.imag
    # A poorly determined pole may be far from the real axis although its interval includes it, so the limit is fixed.
    half_width = min(
        NORMAL_95 * (0.0 if deviations is None or not math.isfinite(deviations[1]) else deviations[1]),
        REAL_AXIS_ANGLE_RAD,
    )
    if angle >= math.pi - max(half_width, DISTINCT_ZERO_TOLERANCE) or angle <= DISTINCT_ZERO_TOLERANCE:
        sign = 1.0 if angle <= DISTINCT_ZERO_TOLERANCE else -1.0
        error = None if deviations is None else deviations[0]
        scaled = (None, None) if error is None else (magnitude * error, error / magnitude)
        return Mode(complex(sign * magnitude), magnitude, -sign, 1.0 / magnitude, False, scaled[0], None, scaled[1])
    decay_rate, damping = abs(magnitude * math.cos(angle)), -math.cos(angle)
    if abs(damping) <= DISTINCT_ZERO_TOLERANCE:
        decay_rate, damping = 0.0, 0.0
    pole = magnitude * complex(math.cos(angle), math.sin(angle))
    constant = 1.0 / decay_rate if decay_rate > 0 else math.inf
    if deviations is None:
        return Mode(pole, magnitude, damping, constant, True)
    radial, frequency_deviation, damping_deviation = deviations
    return Mode(
        pole,
        magnitude,
        damping,
        constant,
        True,
        magnitude * radial,
        abs(math.sin(angle)) * frequency_deviation,
        constant * damping_deviation,
    )


def _relaxation_zeros(polynomial: Polynomial) -> list[complex]:
    """Return the zeros of a sum of c s^p as ln s, up to arg s = 2 pi or up to the first zero, whichever is larger.

    They represent relaxations of a model that has no zero on the principal Riemann sheet.
    """
    powers = np.array(list(polynomial))
    gap = float(np.min(np.diff(np.sort(powers)), initial=math.inf))
    zeros = zeros_of(polynomial, max(MAX_SHEET_ANGLE_RAD, math.pi / gap) + REAL_AXIS_ANGLE_RAD)
    lowest_argument = min((w.imag for w in zeros), default=0.0)
    return [w for w in zeros if w.imag <= max(MAX_SHEET_ANGLE_RAD, lowest_argument) + REAL_AXIS_ANGLE_RAD]


def _standard_deviations(
    model: Model, group: int, zeros: Complex, *, coupled: bool
) -> Sequence[tuple[float, float, float] | None]:
    """Return the standard deviations of Re ln s, Im ln s and ln abs(Re s) of each zero; None without a covariance.

    `zeros` are values of ln s at which the characteristic function D of the group `group` of coupled equations is 0.
    The derivatives with respect to the parameters follow from d ln s = -dD / (dD/d ln s).
    """
    matrix = covariance_of(model)
    if matrix is None or not zeros.size:
        return [None] * zeros.size
    slopes = np.zeros((len(matrix), zeros.size), dtype=np.complex128)
    polynomial_of_pole = characteristic(model, coupled=coupled)[group]
    _, unit = scaled_terms(zeros, np.array(list(polynomial_of_pole)), np.array(list(polynomial_of_pole.values())))

    def value(shifted: Model) -> tuple[Complex, Complex]:
        """Return D and dD / d ln s of a model with changed parameters at the zeros, relative to the largest term."""
        polynomial = characteristic(shifted, coupled=coupled)[group]
        powers = np.array(list(polynomial))
        terms, level = scaled_terms(zeros, powers, np.array(list(polynomial.values())))
        scale = np.exp(level - unit)
        return np.sum(terms, axis=0) * scale, np.sum(powers[:, None] * terms, axis=0) * scale

    _, slope = value(model)
    for k, step, *models in shifted_models(model, np.any(matrix != 0, axis=1), POLE_DERIVATIVE_STEP_RATIO):
        (upper, _), (lower, _) = map(value, models)
        with np.errstate(divide="ignore", invalid="ignore"):
            slopes[k] = -(upper - lower) / (2 * step) / slope
    with np.errstate(invalid="ignore"):
        damping_slopes = slopes.real - np.tan(zeros.imag) * slopes.imag
        components = (slopes.real, slopes.imag, damping_slopes)
        variances = [np.einsum("ik,ij,jk->k", component, matrix, component) for component in components]
        standard_deviations = [np.sqrt(np.maximum(v, 0.0)).tolist() for v in variances]
    return list(zip(*standard_deviations, strict=True))


@dataclass(frozen=True)
class SteadyState:
    """Final behavior of an output after a unit step of an input.

    Parameters
    ----------
    output, input
        Names of the signals.
    gain
        Final value of the output in SI units; 0 if the output returns to 0, infinite if it grows without bound.
    error
        Standard error of `rate`; None without a covariance.
    order
        Exponent of the growth t^order for large t: 0 for a finite gain, 1 for an integrator, negative if the output
        returns to 0.
    rate
        Coefficient of t^order/Gamma(order + 1) for large t; the gain if the order is 0.
    order_error
        Standard error of the order, 0 for a fixed order; None without a covariance.
    """

    output: str
    input: str
    gain: float
    error: float | None
    order: float
    rate: float
    order_error: float | None = None


@check_arguments
def steady_states(model: Model) -> tuple[SteadyState, ...]:
    """Return the final behavior of every output after a step of every input that affects it, with coupled equations.

    Parameters
    ----------
    model
        Linear model whose equations are simulated together.

    Returns
    -------
    tuple of SteadyState
        One entry per output and input of the transfer functions that are not 0.

    Raises
    ------
    ModelError
        If an input has a saturation or dead zone, or the model has friction.
    """
    check_model(model)
    check_no_input_nonlinearity(model, "a steady state")
    pairs = _final_values(model)
    matrix = covariance_of(model)
    errors: dict[tuple[str, str], tuple[float, float]] = {}
    if matrix is not None:
        slopes = {pair: np.zeros((2, len(matrix))) for pair in pairs}
        for k, step, *models in shifted_models(model, np.any(matrix != 0, axis=1), POLE_DERIVATIVE_STEP_RATIO):
            upper, lower = map(_final_values, models)
            for pair, slope in slopes.items():
                slope[:, k] = np.subtract(upper[pair], lower[pair]) / (2 * step)
        for pair, (power_difference, slope) in slopes.items():
            variances = [float(v @ matrix @ v) for v in (power_difference, slope)]
            errors[pair] = (math.sqrt(max(variances[0], 0.0)), math.sqrt(max(variances[1], 0.0)))
    out = []
    for (output, signal), (order, rate) in pairs.items():
        gain = rate if abs(order) < PRINTED_ORDER_TOLERANCE else 0.0 if order < 0 else math.copysign(math.inf, rate)
        power_error, error = errors.get((output, signal), (None, None))
        out.append(SteadyState(output, signal, gain, error, order, rate, power_error))
    return tuple(out)


def _final_values(model: Model) -> dict[tuple[str, str], tuple[float, float]]:
    """Return, by (output, input), the (order, rate) of each step response, as in :class:`SteadyState`."""
    transfer = transfer_functions(model)
    sensor = model.structure.sensor_filter
    out = {}
    for output in transfer.outputs:
        denominator_coefficient, lowest = transfer.denominator[output][-1]
        for signal in transfer.inputs:
            if not transfer.numerators[output, signal]:
                continue
            numerator_coefficient, power = transfer.numerators[output, signal][-1]
            order, rate = lowest - power, numerator_coefficient / denominator_coefficient
            if sensor is not None and (output in sensor.signals) != (signal in sensor.signals):
                (p, a), (q, b) = (
                    min((o, c) for c, o in polynomial) for polynomial in (sensor.numerator, sensor.denominator)
                )
                exponent_sign = 1 if output in sensor.signals else -1
                order, rate = order + exponent_sign * (q - p), rate * (a / b) ** exponent_sign
            out[output, signal] = (0.0 if abs(order) < POWER_TOLERANCE else order, rate)
    return out


@check_arguments
def dcgain(model: Model) -> Floats:
    """Return the steady-state gains from all inputs to all outputs; outputs do not count as inputs.

    Parameters
    ----------
    model
        The model; its equations are coupled.

    Returns
    -------
    ndarray, shape (outputs, inputs)
        Gains in SI units of output over input. A gain is 0 if the input does not affect the output or its effect
        decays, and infinite if the input is integrated. Inputs have the same sequence as in
        :func:`ftlm.analysis.transfer_functions`.

    Raises
    ------
    ModelError
        If an input has a saturation or dead zone, or the model has friction.
    """
    states = steady_states(model)
    inputs = response_inputs(model, coupled=True)
    out = np.zeros((len(model.outputs), len(inputs)))
    for state in states:
        out[model.outputs.index(state.output), inputs.index(state.input)] = state.gain
    return out


def settling_time(model: Model) -> float:
    """Return a duration for response charts [s]: six time constants of the slowest mode plus the longest delay.

    The time constant of each mode is limited to twenty periods of the mode. Without the delay, the duration is at most
    fifty periods of the fastest oscillation, so that a chart resolves this oscillation. A model without modes gives 10
    s.
    """
    model_modes = modes(model)
    if not model_modes:
        return 10.0
    slowest = max(min(m.time_constant, 20.0 * 2 * math.pi / m.frequency) for m in model_modes)
    periods = [2 * math.pi / m.frequency for m in model_modes if m.oscillatory]
    duration = min(6.0 * slowest, 50.0 * min(periods)) if periods else 6.0 * slowest
    return duration + max(model.structure.delay.values(), default=0.0)
