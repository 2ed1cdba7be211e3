"""Poles of a model, and whether it is stable."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from ftlm.base.arrays import Complex, Floats
from ftlm.base.errors import ModelError
from ftlm.data.solved import Solved
from ftlm.solve.frequency import GRAIN, Polynomial, determinant, is_coupled, row_of, systems, transfer_functions

#: Largest degree of the polynomial in s^q whose roots double precision gives.
LARGEST_DEGREE = 100
#: Smallest common base of orders that is looked for.
SMALLEST_BASE = 0.01
#: Beyond these frequencies the lowest and the highest power decide to within this share.
DECIDED = 1e-3
#: Largest turn between two points of the Nyquist curve [rad], and most points.
LARGEST_TURN = 0.2
MOST_POINTS = 200_000
#: Logarithm of the frequency that stands for those beyond the range of numbers.
FARTHEST_LOG = 600.0
#: A Nyquist curve that comes this close to 0, in units of its own terms, has a pole on the axis as far as one can tell.
ON_AXIS = 1e-9


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


def characteristic(model: Solved, *, coupled: bool) -> list[Polynomial]:
    """Characteristic sums of c s^p, one for each set of equations that act together."""
    return [
        determinant([row_of(e, names)[0] for e in model.equations if e.output in names])
        for names in systems(model, coupled=coupled)
    ]


def common_base(powers: Sequence[float]) -> float | None:
    """Largest q of which all powers are multiples, or None where it is below 0.01."""
    powers = [p for p in powers if abs(p) > GRAIN]
    fractions = [Fraction(p).limit_denominator(1000) for p in powers]
    if any(abs(float(f) - p) > 1e-8 for f, p in zip(fractions, powers, strict=True)):
        return None
    common = math.lcm(*(f.denominator for f in fractions))
    base = Fraction(math.gcd(*(int(f * common) for f in fractions)), common)
    # Above 1 one root would stand for several poles.
    base /= max(math.ceil(base), 1)
    return float(base) if base * 1000 >= 999 * SMALLEST_BASE else None


def roots_in_base(polynomial: Polynomial) -> tuple[float, Complex] | None:
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


def poles(model: Solved, *, coupling: str = "simulated") -> Complex:
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
    every: list[complex] = []
    for polynomial in characteristic(model, coupled=is_coupled(coupling)):
        roots = roots_in_base(polynomial)
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
        every += (np.abs(kept) ** (1 / base) * np.exp(1j * np.angle(kept) / base)).tolist()
    return np.array(sorted(every, key=lambda s: (abs(s), s.imag)), dtype=np.complex128)


def stability(model: Solved, *, coupling: str = "simulated") -> Stability:
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
    coupled = is_coupled(coupling)
    unstable, on_axis, method, base = 0.0, False, "poles", None
    for polynomial in characteristic(model, coupled=coupled):
        roots = roots_in_base(polynomial)
        if roots is not None:
            base, values = roots
            margin = np.abs(np.angle(values)) - base * math.pi / 2
            # Companion matrices give simple roots to about 1e-9; closer to the axis than that is on it.
            on_axis |= bool(np.any(np.abs(margin) <= 1e-7))
            unstable += float(np.sum(margin < -1e-7))
        else:
            count, near = right_zeros(polynomial)
            unstable, on_axis, method = unstable + count, on_axis or near, "argument principle"
    transfer = transfer_functions(model, coupling=coupling)
    origin = 0.0
    for output, pairs in transfer.denominator.items():
        lowest = min(p for _, p in pairs)
        for signal in transfer.inputs:
            top = [p for _, p in transfer.numerators[output, signal]]
            origin = max(origin, round(lowest - min(top), 9)) if top else origin
    good = unstable == 0 and not on_axis and origin <= 0
    return Stability(good, unstable, max(origin, 0.0), on_axis, method, base if method == "poles" else None)


def right_zeros(polynomial: Polynomial, angle: float = math.pi / 2) -> tuple[float, bool]:
    """Number of zeros right of the imaginary axis by the argument principle, and whether one lies on the axis.

    Or, with another angle [rad], of those whose argument is smaller: on the surface of ln s it may exceed pi.
    """
    lowest, highest = min(polynomial), max(polynomial)
    if highest - lowest < GRAIN:
        return 0.0, False
    powers = np.array(list(polynomial))
    values = np.array(list(polynomial.values()))

    def shares(at: float, omega: float) -> float:
        """What all other terms weigh beside the term of one power."""
        sizes = np.abs(values) * omega ** (powers - at)
        return float((np.sum(sizes) - abs(polynomial[at])) / abs(polynomial[at]))

    try:
        centre = abs(polynomial[lowest] / polynomial[highest]) ** (1 / (highest - lowest))
    except OverflowError:  # coefficients that ran away, over powers close to one another
        centre = math.exp(FARTHEST_LOG)
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
        turns = np.exp(1j * (powers * angle + np.where(values < 0, math.pi, 0.0)))
        total = np.sum(sizes, axis=0)
        return np.asarray(np.einsum("j,jk->k", turns, sizes) / total), total

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
    count = (highest - lowest) * angle / math.pi - turned / math.pi
    if near or abs(count - round(count)) > 0.1:
        return math.nan, True
    return float(max(round(count), 0)), False
