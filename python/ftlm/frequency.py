"""A model in the frequency domain: exact response, its uncertainty, poles, stability, transfer functions, steps."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from ftlm.errors import DataError, ModelError
from ftlm.runs import Run

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from ftlm.models import Equation, Model

    Floats = NDArray[np.float64]
    Complex = NDArray[np.complex128]

__all__ = [
    "Stability",
    "TransferFunctions",
    "frequency_response",
    "poles",
    "response_deviation",
    "stability",
    "step_response",
    "transfer_functions",
]

#: A sum of coefficient * s^power, by power.
Polynomial: TypeAlias = dict[float, float]

#: Powers closer than this are one power.
GRAIN = 1e-9
#: A coefficient that cancels to this share of what was added is rounding.
CANCELLED = 1e-13
#: Largest degree of the polynomial in s^q whose roots double precision gives.
LARGEST_DEGREE = 100
#: Smallest common base of orders that is looked for.
SMALLEST_BASE = 0.01
#: Beyond these frequencies the lowest and the highest power decide to within this share.
DECIDED = 1e-3
#: Largest turn between two points of the Nyquist curve [rad], and most points.
LARGEST_TURN = 0.2
MOST_POINTS = 200_000
#: A Nyquist curve that comes this close to 0, in units of its own terms, has a pole on the axis as far as one can tell.
ON_AXIS = 1e-9
#: Relative step of the numerical derivatives of the delta method.
DELTA = 1e-6


# ------------------------------------------------------------------------------------------------ equations in s


def response_inputs(model: Model, *, coupled: bool) -> tuple[str, ...]:
    """Signals that drive the response: all that are not modelled; where each equation is alone, modelled ones, too."""
    if coupled:
        return tuple(s for s in model.structure.signals if s not in model.outputs)
    read = [t.signal for e in model.equations for t in e.terms if t.signal != e.output]
    return tuple(dict.fromkeys(s for s in model.structure.signals if s in read))


def _add(into: Polynomial, other: Polynomial, factor: float = 1.0) -> None:
    for power, value in other.items():
        at = next((p for p in into if abs(p - power) < GRAIN), power)
        into[at] = into.get(at, 0.0) + factor * value


def _times(a: Polynomial, b: Polynomial) -> Polynomial:
    out: Polynomial = {}
    for (p, x), (q, y) in itertools.product(a.items(), b.items()):
        _add(out, {round(p + q, 9): x * y})
    return out


def _row(item: Equation, names: Sequence[str]) -> tuple[list[Polynomial], dict[str, Polynomial]]:
    """D^alpha y - own and coupled terms, by output; every other signal's terms."""
    left: list[Polynomial] = [{} for _ in names]
    right: dict[str, Polynomial] = {}
    left[names.index(item.output)][item.order.constant] = 1.0
    for term in item.terms:
        value = {term.order.constant: float(term.fixed or 0.0)}
        if term.signal in names:
            _add(left[names.index(term.signal)], value, -1.0)
        else:
            _add(right.setdefault(term.signal, {}), value)
    return left, right


def _determinant(matrix: list[list[Polynomial]]) -> Polynomial:
    """Sum over permutations: exact in the powers, and there are never more than a few outputs."""
    n = len(matrix)
    out: Polynomial = {}
    size: Polynomial = {}
    for order in itertools.permutations(range(n)):
        sign = 1.0
        for i, j in itertools.combinations(range(n), 2):
            sign = -sign if order[i] > order[j] else sign
        product: Polynomial = {0.0: 1.0}
        for i, j in enumerate(order):
            product = _times(product, matrix[i][j])
        _add(out, product, sign)
        _add(size, {p: abs(v) for p, v in product.items()})
    return {p: v for p, v in sorted(out.items()) if abs(v) > CANCELLED * size[p]}


@dataclass(frozen=True)
class TransferFunctions:
    """Every input to every output as a quotient of sums of coefficient * s^power, exact in powers and coefficients.

    Parameters
    ----------
    outputs, inputs
        Names.
    denominator
        (coefficient, power) pairs, highest power first, of the outputs that hang together: one for each output.
    numerators
        The same by output and input; empty where an input does not reach an output.
    delay
        Delay of each input [s].
    """

    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    denominator: dict[str, tuple[tuple[float, float], ...]]
    numerators: dict[tuple[str, str], tuple[tuple[float, float], ...]]
    delay: dict[str, float]


def _systems(model: Model, *, coupled: bool) -> list[tuple[str, ...]]:
    return [model.outputs] if coupled else [(o,) for o in model.outputs]


def transfer_functions(model: Model, *, coupling: str = "simulated") -> TransferFunctions:
    """Transfer functions of a model by Cramer's rule, without the sensor filter.

    Parameters
    ----------
    model
        The model.
    coupling
        ``"simulated"``: the equations together, driven by what is not modelled. ``"measured"``: each equation alone,
        the other outputs among its inputs.

    Returns
    -------
    TransferFunctions

    Raises
    ------
    ModelError
        Another coupling, or equations that cannot be solved for their outputs.
    """
    coupled = _is_coupled(coupling)
    inputs = response_inputs(model, coupled=coupled)
    denominator: dict[str, tuple[tuple[float, float], ...]] = {}
    numerators: dict[tuple[str, str], tuple[tuple[float, float], ...]] = {}
    for names in _systems(model, coupled=coupled):
        items = [e for e in model.equations if e.output in names]
        rows = [_row(e, names) for e in items]
        matrix = [left for left, _ in rows]
        bottom = _determinant(matrix)
        if not bottom:
            raise ModelError(f"the equations of {', '.join(names)} cannot be solved for them: their determinant is 0")
        for j, output in enumerate(names):
            denominator[output] = _written(bottom)
            for signal in inputs:
                column = [right.get(signal, {}) for _, right in rows]
                replaced = [[*row[:j], column[i], *row[j + 1 :]] for i, row in enumerate(matrix)]
                numerators[output, signal] = _written(_determinant(replaced))
    delay = {s: model.structure.delay.get(s, 0.0) for s in inputs}
    return TransferFunctions(model.outputs, inputs, denominator, numerators, delay)


def _written(polynomial: Polynomial) -> tuple[tuple[float, float], ...]:
    return tuple((v, p) for p, v in sorted(polynomial.items(), reverse=True))


def _is_coupled(coupling: str) -> bool:
    if coupling not in ("simulated", "measured"):
        raise ModelError(f"coupling = {coupling!r} is not known; use 'simulated' or 'measured'")
    return coupling == "simulated"


# ------------------------------------------------------------------------------------------------ frequency response


def frequency_response(model: Model, w: ArrayLike, *, coupling: str = "simulated", sensor: bool = True) -> Complex:
    """Exact frequency response, orders as they are.

    Parameters
    ----------
    model
        The model.
    w
        Angular frequencies [rad/s], shape (W,), finite, >= 0.
    coupling
        ``"simulated"``: the equations together, from the signals that are not modelled. ``"measured"``: each equation
        alone, the other outputs among its inputs (in the order of ``model.structure.signals``).
    sensor
        Whether outputs that are measured through the sensor filter pass it.

    Returns
    -------
    ndarray of complex, shape (outputs, inputs, W)
        In SI units of output over input. Infinite where the model has a pole at that frequency. A Coulomb signal
        counts as an input; what it does to the angle is not linear and not in here.

    Raises
    ------
    DataError
        Frequencies that are not finite numbers from 0.
    ModelError
        Another coupling.
    """
    coupled = _is_coupled(coupling)
    omega = np.asarray(w, dtype=np.float64)
    if omega.ndim != 1 or omega.size == 0:
        raise DataError(f"w has shape {omega.shape}; give a vector of frequencies in rad/s")
    bad = ~(np.isfinite(omega) & (omega >= 0))
    if np.any(bad):
        at = int(np.argmax(bad))
        raise DataError(
            f"w is {omega[at]} at index {at} ({int(np.sum(bad))} such values in all); give rad/s, finite, >= 0"
        )
    inputs = response_inputs(model, coupled=coupled)
    out = np.zeros((len(model.outputs), len(inputs), omega.size), dtype=np.complex128)
    s = 1j * omega
    for names in _systems(model, coupled=coupled):
        items = [e for e in model.equations if e.output in names]
        a = np.zeros((omega.size, len(names), len(names)), dtype=np.complex128)
        b = np.zeros((omega.size, len(names), len(inputs)), dtype=np.complex128)
        for i, item in enumerate(items):
            left, right = _row(item, names)
            # Divided by s^alpha at high and left as it is at low frequencies, numbers keep their range.
            scale = np.maximum(omega, 1.0) ** -item.order.constant
            for j, polynomial in enumerate(left):
                a[:, i, j] = scale * _value(polynomial, s)
            for signal, polynomial in right.items():
                b[:, i, inputs.index(signal)] = scale * _value(polynomial, s)
        singular = np.abs(np.linalg.det(a)) == 0
        a[singular] = np.eye(len(names))
        found = np.linalg.solve(a, b)
        found[singular] = np.where(b[singular] != 0, np.inf, 0)
        for i, name in enumerate(names):
            out[model.outputs.index(name)] = found[:, i, :].T
    for k, name in enumerate(inputs):
        delay = model.structure.delay.get(name, 0.0)
        if delay:
            out[:, k] *= np.exp(-s * delay)
    filtered = model.structure.sensor_filter
    if sensor and filtered is not None:
        gain = _value({o: c for c, o in filtered.numerator}, s) / _value({o: c for c, o in filtered.denominator}, s)
        for i, name in enumerate(model.outputs):
            out[i] *= gain if name in filtered.outputs else 1.0
    return out


def _value(polynomial: Polynomial, s: NDArray[Any]) -> Complex:
    total = np.zeros(s.shape, dtype=np.complex128)
    for power, coefficient in polynomial.items():
        with np.errstate(divide="ignore", invalid="ignore"):
            total += coefficient * (np.ones_like(s) if power == 0 else s**power)
    return total


def response_deviation(model: Model, w: ArrayLike, *, coupling: str = "simulated") -> tuple[Floats, Floats]:
    """Standard deviations of the frequency response from those of the model's numbers, by the delta method.

    Parameters
    ----------
    model
        With the covariance of an output-error fit (``model.estimate``).
    w, coupling
        See :func:`frequency_response`.

    Returns
    -------
    gain, phase
        Standard deviation of ln|H| (times 8.686 it is dB) and of arg H [rad], each of shape (outputs, inputs, W).

    Raises
    ------
    ModelError
        A model without covariance.
    """
    covariance = None if model.estimate is None else model.estimate.covariance
    if covariance is None:
        raise ModelError(
            "this model has no covariance, so its response has no uncertainty; identify it with method='output-error'"
        )
    centre = frequency_response(model, w, coupling=coupling)
    values = model_numbers(model)
    derivative = np.zeros((values.size, *centre.shape), dtype=np.complex128)
    for k, value in enumerate(values):
        step = DELTA * max(abs(value), 1e-3)
        if not np.any(covariance[k]):
            continue
        sides = []
        for sign in (1.0, -1.0):
            moved = values.copy()
            moved[k] += sign * step
            sides.append(frequency_response(with_numbers(model, moved), w, coupling=coupling))
        with np.errstate(divide="ignore", invalid="ignore"):
            derivative[k] = (sides[0] - sides[1]) / (2 * step) / centre
    matrix = np.asarray(covariance, dtype=np.float64)
    variances = [np.einsum("i...,ij,j...->...", part, matrix, part) for part in (derivative.real, derivative.imag)]
    gain, phase = (np.sqrt(np.maximum(v, 0.0)) for v in variances)
    return gain, phase


def model_numbers(model: Model) -> Floats:
    """Every number of a model in one vector: of each equation alpha, then order and coefficient of each term."""
    numbers: list[float] = []
    for item in model.equations:
        numbers.append(item.order.constant)
        for term in item.terms:
            numbers += [term.order.constant, float(term.fixed or 0.0)]
    return np.array(numbers)


def with_numbers(model: Model, numbers: Floats) -> Model:
    """Return the model with other numbers in the order of :func:`model_numbers`."""
    at = iter(numbers.tolist())
    equations = []
    for item in model.equations:
        alpha = replace(item.order, constant=next(at))
        terms = []
        for term in item.terms:
            order = replace(term.order, constant=next(at))
            terms.append(replace(term, order=order, coefficient=next(at) / term.factor))
        equations.append(_unchecked(item, alpha, tuple(terms)))
    return replace(model, structure=replace(model.structure, equations=tuple(equations)))


def _unchecked(item: Equation, order: object, terms: tuple[object, ...]) -> Equation:
    """An equation whose orders may lie a hair outside of what a person may write, as a derivative at an edge needs."""
    new = object.__new__(type(item))
    object.__setattr__(new, "output", item.output)
    object.__setattr__(new, "order", order)
    object.__setattr__(new, "terms", terms)
    return new


# ------------------------------------------------------------------------------------------------ stability


@dataclass(frozen=True)
class Stability:
    """Whether bounded inputs give bounded outputs, and why.

    Parameters
    ----------
    stable
        No pole on the right of the imaginary axis or on it, the origin included.
    unstable_poles
        Number of poles with a positive real part; NaN where a pole on the axis leaves it open.
    origin_order
        Power of s by which an input that never ends is integrated: 0 for none, 1 for an integrator.
    on_axis
        Whether a pole lies on the imaginary axis as far as can be told (the origin not counted).
    method
        ``"poles"`` (Matignon's criterion) or ``"argument principle"``.
    base
        Common base of all orders, or None.
    """

    stable: bool
    unstable_poles: float
    origin_order: float
    on_axis: bool
    method: str
    base: float | None

    def __bool__(self) -> bool:
        return self.stable

    def __str__(self) -> str:
        why = []
        if self.unstable_poles > 0:
            count = int(self.unstable_poles)
            why.append(f"{count} pole{'s' if count > 1 else ''} with a positive real part")
        if self.on_axis:
            why.append("a pole on the imaginary axis")
        if self.origin_order > 0:
            why.append(f"it integrates its input with order {self.origin_order:g}")
        verdict = "stable" if self.stable else f"not stable: {', '.join(why)}"
        how = f"poles in s^{self.base:g}" if self.method == "poles" and self.base else self.method
        return f"{verdict} ({how})"


def _characteristic(model: Model, *, coupled: bool) -> list[Polynomial]:
    found = []
    for names in _systems(model, coupled=coupled):
        items = [e for e in model.equations if e.output in names]
        found.append(_determinant([_row(e, names)[0] for e in items]))
    return found


def common_base(powers: Sequence[float]) -> float | None:
    """Largest q of which all powers are multiples, or None where it is below 0.01."""
    fractions = [Fraction(p).limit_denominator(1000) for p in powers if abs(p) > GRAIN]
    if any(abs(float(f) - p) > 1e-8 for f, p in zip(fractions, [p for p in powers if abs(p) > GRAIN], strict=True)):
        return None
    base = Fraction(0)
    for f in fractions:
        base = Fraction(
            math.gcd(base.numerator * f.denominator, f.numerator * base.denominator), base.denominator * f.denominator
        )
    # Above 1 one root would stand for several poles.
    base /= max(math.ceil(base), 1)
    return float(base) if base * 1000 >= 999 * SMALLEST_BASE else None


def _roots(polynomial: Polynomial) -> tuple[float, Complex] | None:
    """Base q and the roots in s^q of a commensurate polynomial freed of its lowest power; None where there are none."""
    lowest, highest = min(polynomial), max(polynomial)
    base = common_base([p - lowest for p in polynomial])
    if base is None or (highest - lowest) / base > LARGEST_DEGREE:
        return None
    if highest - lowest < GRAIN:
        return base or 1.0, np.empty(0, dtype=np.complex128)
    degree = round((highest - lowest) / base)
    # In units of the mean frequency all coefficients are of a size.
    unit = abs(polynomial[lowest] / polynomial[highest]) ** (1 / (highest - lowest))
    coefficients = np.zeros(degree + 1)
    for power, value in polynomial.items():
        at = degree - round((power - lowest) / base)
        coefficients[at] = value / polynomial[highest] * unit ** (power - highest)
    return base, np.asarray(np.roots(coefficients) * unit**base, dtype=np.complex128)


def poles(model: Model, *, coupling: str = "simulated") -> Complex:
    """Poles of a commensurate model on the principal sheet.

    Parameters
    ----------
    model
        A model whose orders are multiples of one number, at least 0.01.
    coupling
        See :func:`frequency_response`.

    Returns
    -------
    ndarray of complex
        Values of s [rad/s], ``|arg s| < pi``, slowest first, without those at the origin. Roots on other sheets are no
        poles: they only shape how a response dies away.

    Raises
    ------
    ModelError
        Orders without a common base, or a degree in it above 100.
    """
    found: list[complex] = []
    for polynomial in _characteristic(model, coupled=_is_coupled(coupling)):
        roots = _roots(polynomial)
        if roots is None:
            raise ModelError(
                "the orders have no common base of 0.01 or more (or a degree above 100 in it), so the model has no "
                "polynomial whose roots could be found; use stability(), or round the orders"
            )
        base, values = roots
        angle = np.angle(values)
        kept = values[np.abs(angle) < base * math.pi - 1e-12]
        if abs(base - 1) < GRAIN:
            kept = values  # whole orders have one sheet, the negative real axis included
        # Principal logarithm: arg s = arg(lambda) / q lies within (-pi, pi) by the choice above.
        found += (np.abs(kept) ** (1 / base) * np.exp(1j * np.angle(kept) / base)).tolist()
    return np.array(sorted(found, key=lambda s: (abs(s), s.imag)), dtype=np.complex128)


def stability(model: Model, *, coupling: str = "simulated") -> Stability:
    """Whether a model is stable: by its poles where orders are commensurate, else by the argument principle.

    Parameters
    ----------
    model
        The model.
    coupling
        See :func:`frequency_response`; a model may be stable as a whole and not equation by equation, or the reverse.

    Returns
    -------
    Stability
        True where stable; prints why not.

    Raises
    ------
    ModelError
        Another coupling.

    Notes
    -----
    Matignon (1996): roots lambda in s^q are stable where ``|arg lambda| > q pi/2``. Without a common base the number of
    zeros of the characteristic function D(s) on the right is (p_max − p_min)/2 − Φ/π, Φ the turn of D(jω) from ω = 0 to
    ∞ and p the powers of its highest and lowest term: the argument principle on the right half plane, where s^p has one
    value. Delays of inputs do not matter.
    """
    coupled = _is_coupled(coupling)
    unstable, on_axis, method, base = 0.0, False, "poles", None
    for polynomial in _characteristic(model, coupled=coupled):
        roots = _roots(polynomial)
        if roots is not None:
            base, values = roots
            margin = np.abs(np.angle(values)) - base * math.pi / 2
            # Companion matrices give simple roots to about 1e-9; closer to the axis than that is on it.
            on_axis |= bool(np.any(np.abs(margin) <= 1e-7))
            unstable += float(np.sum(margin < -1e-7))
        else:
            count, near = right_zeros(polynomial)
            unstable, on_axis, method = unstable + count, on_axis or near, "argument principle"
    found = transfer_functions(model, coupling=coupling)
    origin = 0.0
    for output, pairs in found.denominator.items():
        lowest = min(p for _, p in pairs)
        for signal in found.inputs:
            top = [p for _, p in found.numerators[output, signal]]
            origin = max(origin, round(lowest - min(top), 9)) if top else origin
    good = unstable == 0 and not on_axis and origin <= 0
    return Stability(good, unstable, max(origin, 0.0), on_axis, method, base if method == "poles" else None)


def right_zeros(polynomial: Polynomial) -> tuple[float, bool]:
    """Number of zeros right of the imaginary axis by the argument principle, and whether one lies on the axis."""
    lowest, highest = min(polynomial), max(polynomial)
    if highest - lowest < GRAIN:
        return 0.0, False
    powers = np.array(list(polynomial))
    values = np.array(list(polynomial.values()))

    def shares(at: float, omega: float) -> float:
        """What all other terms weigh beside the term of one power."""
        sizes = np.abs(values) * omega ** (powers - at)
        return float((np.sum(sizes) - abs(polynomial[at])) / abs(polynomial[at]))

    centre = abs(polynomial[lowest] / polynomial[highest]) ** (1 / (highest - lowest))
    low, high = centre, centre
    while shares(lowest, low) > DECIDED and low > 1e-300:
        low /= 10
    while shares(highest, high) > DECIDED and high < 1e300:
        high *= 10
    log_omega = np.linspace(math.log(low), math.log(high), 2001)

    def curve(logs: Floats) -> tuple[Complex, Floats]:
        """D(jω) divided by the sum of its terms' sizes, which changes no angle, and that sum."""
        exponents = np.outer(powers, logs) + np.log(np.abs(values))[:, None]
        shift = exponents.max(axis=0)
        sizes = np.exp(exponents - shift)
        turns = np.exp(1j * (powers * math.pi / 2 + np.where(values < 0, math.pi, 0.0)))
        total = np.sum(sizes, axis=0)
        return np.asarray(turns @ sizes / total), total

    points, _ = curve(log_omega)
    while log_omega.size < MOST_POINTS:
        turn = np.abs(np.angle(points[1:] * np.conj(points[:-1])))
        wide = np.flatnonzero(turn > LARGEST_TURN)
        if not wide.size or float(np.min(np.abs(points))) < ON_AXIS:
            break
        middle = (log_omega[wide] + log_omega[wide + 1]) / 2
        if np.any(np.diff(np.concatenate([log_omega[wide], middle]).reshape(2, -1), axis=0) <= 0):
            break
        log_omega = np.sort(np.concatenate([log_omega, middle]))
        points, _ = curve(log_omega)
    near = float(np.min(np.abs(points))) < ON_AXIS
    turned = float(np.sum(np.angle(points[1:] * np.conj(points[:-1]))))
    count = (highest - lowest) / 2 - turned / math.pi
    if near or abs(count - round(count)) > 0.1:
        return math.nan, True
    return float(max(round(count), 0)), False


# ------------------------------------------------------------------------------------------------ step response


def step_response(model: Model, time: ArrayLike, *, tolerance: float = 1e-6) -> Floats:
    """Response of every output to a unit step of every input that is not modelled, from rest.

    Parameters
    ----------
    model
        The model; its equations act together.
    time
        Regular instants from 0 [s], shape (N,), N >= 3.
    tolerance
        Of the free run; see :func:`ftlm.simulate`.

    Returns
    -------
    ndarray, shape (outputs, inputs, N)
        Sensor filter and delays included; the step acts just after time 0.

    Raises
    ------
    DataError
        Instants that are not regular from 0.
    ConvergenceError
        A model so unstable that the response leaves the range of numbers.
    """
    t = np.asarray(time, dtype=np.float64)
    if t.ndim != 1 or t.size < 3 or not np.all(np.isfinite(t)) or t[0] != 0:
        raise DataError("time must be a vector of at least three instants [s] that begins with 0, such as numpy.arange")
    step = float(t[-1]) / (t.size - 1)
    off = np.abs(t - step * np.arange(t.size)) > 1e-6 * step
    if step <= 0 or np.any(off):
        raise DataError(
            f"time is not regular, first at index {int(np.argmax(off))} ({int(np.sum(off))} in all); use numpy.arange"
        )
    inputs = response_inputs(model, coupled=True)
    together = replace(model, structure=replace(model.structure, coupling="simulated", initial="rest"))
    out = np.zeros((len(model.outputs), len(inputs), t.size))
    for k, name in enumerate(inputs):
        drive = {n: np.full(t.size, float(n == name)) for n in inputs}
        rest = {n: np.zeros(t.size) for n in model.outputs}
        run = Run.from_arrays(step=step, inputs=drive, outputs=rest, name=f"unit step of {name}")
        found = together.simulate(run, tolerance=tolerance)
        for i, output in enumerate(model.outputs):
            out[i, k] = found[output]
    return out
