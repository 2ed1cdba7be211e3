"""Zeros of sums of c s^p with real powers p: by polynomial roots, Newton's method and the argument principle."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from fractions import Fraction
from functools import lru_cache

import numpy as np

from ftlm.structure.polynomial import POWER_TOLERANCE, Polynomial
from ftlm.utils.validation import Complex, Floats

#: Maximum degree of a polynomial in s^q whose roots are accurate in double precision.
MAX_ROOT_DEGREE = 100
#: Minimum common base q of orders, that is, the largest number of which all orders are multiples.
MIN_ORDER_BASE = 0.01
#: Sum of the magnitudes of all other terms, relative to one term, below which this term dominates.
DOMINANCE_RATIO = 1e-3
#: Maximum angle between two adjacent points of the Nyquist curve, and maximum number of points.
MAX_TURN_RAD = 0.2
MAX_NYQUIST_POINTS = 200_000
#: Natural logarithm of the frequency [rad/s] that replaces a mean frequency which overflows.
OVERFLOW_LOG_FREQUENCY = 600.0
#: Magnitude of the characteristic function, relative to the sum of the magnitudes of its terms, below which a pole is
#: regarded as on the imaginary axis.
AXIS_TOLERANCE = 1e-9
#: Maximum number of polynomials whose zeros are cached. Findings, verdict and report of one model need the same zeros.
CACHED_POLYNOMIALS = 64
#: Maximum angle [rad] between the pole of a relaxation and the negative real axis. The limit is 1.96 standard
#: deviations of the angle if these are smaller.
REAL_AXIS_ANGLE_RAD = 0.02 * math.pi
#: Maximum abs(ln s) of a frequency without overflow.
MAX_LOG_FREQUENCY = 700.0
#: Increments to which orders are rounded for the initial guesses of Newton's method, and maximum polynomial degree.
SEED_ORDER_BASES = (0.25, 0.2, 0.1, 0.08, 0.05, 0.04, 0.03, 0.025, 0.02)
MAX_SEED_DEGREE = 90
#: Maximum number of Newton iterations, and maximum step in ln s.
MAX_NEWTON_ITERATIONS, MAX_NEWTON_STEP = 60, 0.5
#: Maximum sum of the terms at a zero, relative to the sum of their magnitudes, and distance in ln s below which two
#: zeros count as equal.
ZERO_TOLERANCE, DISTINCT_ZERO_TOLERANCE = 1e-10, 1e-7


def common_base(powers: Sequence[float]) -> float | None:
    """Return the largest number, at most 1, of which all powers are multiples; None if it is below 0.01."""
    powers = [p for p in powers if abs(p) > POWER_TOLERANCE]
    fractions = [Fraction(p).limit_denominator(1000) for p in powers]
    if any(abs(float(f) - p) > 1e-8 for f, p in zip(fractions, powers, strict=True)):
        return None
    common = math.lcm(*(f.denominator for f in fractions))
    base = Fraction(math.gcd(*(int(f * common) for f in fractions)), common)
    # With a base above 1, one root would represent several poles.
    base /= max(math.ceil(base), 1)
    return float(base) if base * 1000 >= 999 * MIN_ORDER_BASE else None


def roots_in_base(polynomial: Polynomial) -> tuple[float, Complex] | None:
    """Return the common base q of the powers of s in a polynomial, and its nonzero roots in the variable s^q.

    Return None if there is no common base, the degree exceeds 100, or a root or a coefficient overflows.
    """
    lowest, highest = min(polynomial), max(polynomial)
    base = common_base([p - lowest for p in polynomial])
    if base is None or (highest - lowest) / base > MAX_ROOT_DEGREE:
        return None
    if highest - lowest < POWER_TOLERANCE:
        return base or 1.0, np.empty(0, dtype=np.complex128)
    degree = round((highest - lowest) / base)
    log_magnitudes = {power: math.log(abs(value)) for power, value in polynomial.items() if value}
    if lowest not in log_magnitudes or highest not in log_magnitudes:
        return None
    # With frequencies relative to their geometric mean, all coefficients have similar magnitudes.
    unit = (log_magnitudes[lowest] - log_magnitudes[highest]) / (highest - lowest)
    logs = {
        power: log_magnitude - log_magnitudes[highest] + unit * (power - highest)
        for power, log_magnitude in log_magnitudes.items()
    }
    if max(abs(unit), *logs.values()) > MAX_LOG_FREQUENCY:
        return None
    coefficients = np.zeros(degree + 1)
    for power, log_magnitude in logs.items():
        index = degree - round((power - lowest) / base)
        coefficients[index] = math.copysign(
            math.exp(log_magnitude), polynomial[power] / math.copysign(1.0, polynomial[highest])
        )
    return base, np.asarray(np.roots(coefficients) * math.exp(unit * base), dtype=np.complex128)


def right_zeros(polynomial: Polynomial, angle: float = math.pi / 2) -> tuple[float, bool]:
    """Return the number of zeros with positive real parts, and whether a zero is on the imaginary axis.

    The number follows from the argument principle; it is NaN if a zero is on the axis. With another `angle` [rad], the
    zeros with abs(arg s) < angle are counted, and the axis is the ray arg s = angle. On the Riemann surface of ln s,
    the angle may exceed pi.
    """
    return _right_zeros_of_terms(tuple(polynomial.items()), angle)


@lru_cache(maxsize=CACHED_POLYNOMIALS)
def _right_zeros_of_terms(terms: tuple[tuple[float, float], ...], angle: float) -> tuple[float, bool]:
    """Return the result of :func:`right_zeros` for a polynomial given as pairs of a power and its coefficient."""
    polynomial = dict(terms)
    lowest, highest = min(polynomial), max(polynomial)
    if highest - lowest < POWER_TOLERANCE:
        return 0.0, False
    powers = np.array(list(polynomial))
    values = np.array(list(polynomial.values()))

    def other_terms_ratio(at: float, omega: float) -> float:
        """Return, at s = omega, the sum of the magnitudes of all other terms relative to the term with power `at`."""
        magnitudes = np.abs(values) * omega ** (powers - at)
        return float((np.sum(magnitudes) - abs(polynomial[at])) / abs(polynomial[at]))

    try:
        center = abs(polynomial[lowest] / polynomial[highest]) ** (1 / (highest - lowest))
    except OverflowError:  # coefficients that differ much, with powers that differ little
        center = math.exp(OVERFLOW_LOG_FREQUENCY)
    low, high = center, center
    while other_terms_ratio(lowest, low) > DOMINANCE_RATIO and low > 1e-300:
        low /= 10
    while other_terms_ratio(highest, high) > DOMINANCE_RATIO and high < 1e300:
        high *= 10
    log_omega = np.linspace(math.log(low), math.log(high), 2001)

    def curve(logs: Floats) -> tuple[Complex, Floats]:
        """Return D(s) divided by the sum of the magnitudes of its terms, and this sum divided by its largest term.

        D is the polynomial at s = ω exp(j angle), and `logs` are the values of ln ω.
        """
        exponents = np.outer(powers, logs) + np.log(np.abs(values))[:, None]
        shift = exponents.max(axis=0)
        magnitudes = np.exp(exponents - shift)
        phasors = np.exp(1j * (powers * angle + np.where(values < 0, math.pi, 0.0)))
        magnitude_sum = np.sum(magnitudes, axis=0)
        return np.asarray(np.einsum("j,jk->k", phasors, magnitudes) / magnitude_sum), magnitude_sum

    points, _ = curve(log_omega)
    while log_omega.size < MAX_NYQUIST_POINTS:
        phase_steps = np.abs(np.angle(points[1:] * np.conj(points[:-1])))
        coarse_intervals = np.flatnonzero(phase_steps > MAX_TURN_RAD)
        if not coarse_intervals.size or float(np.min(np.abs(points))) < AXIS_TOLERANCE:
            break
        midpoints = (log_omega[coarse_intervals] + log_omega[coarse_intervals + 1]) / 2
        if np.any(np.diff(np.concatenate([log_omega[coarse_intervals], midpoints]).reshape(2, -1), axis=0) <= 0):
            break
        log_omega = np.sort(np.concatenate([log_omega, midpoints]))
        points, _ = curve(log_omega)
    is_near_axis = float(np.min(np.abs(points))) < AXIS_TOLERANCE
    phase_change = float(np.sum(np.angle(points[1:] * np.conj(points[:-1]))))
    count = (highest - lowest) * angle / math.pi - phase_change / math.pi
    if is_near_axis or abs(count - round(count)) > 0.1:
        return math.nan, True
    return float(max(round(count), 0)), False


def zeros_of(polynomial: Polynomial, max_argument: float = math.pi + REAL_AXIS_ANGLE_RAD) -> list[complex]:
    """Return the zeros of a sum of c s^p as ln s, slowest first: s is not 0, and 0 <= Im ln s <= max_argument."""
    return list(_zeros_of_terms(tuple(polynomial.items()), max_argument))


@lru_cache(maxsize=CACHED_POLYNOMIALS)
def _zeros_of_terms(terms: tuple[tuple[float, float], ...], max_argument: float) -> tuple[complex, ...]:
    """Return the zeros of :func:`zeros_of` for a polynomial given as pairs of a power and its coefficient."""
    polynomial = dict(terms)
    powers = np.array(list(polynomial))
    lowest, highest = float(powers.min()), float(powers.max())
    if highest - lowest < POWER_TOLERANCE:
        return ()
    exact_roots = roots_in_base(polynomial)
    if exact_roots is not None:
        base, roots = exact_roots
        roots = roots[np.abs(roots) > 0]
        w = np.log(np.abs(roots)) / base + 1j * np.abs(np.angle(roots)) / base
        # Of a conjugate pair, only the zero with Im ln s > 0 is returned.
        is_in_sector = w[(np.angle(roots) >= -DISTINCT_ZERO_TOLERANCE) & (w.imag <= max_argument)]
        if abs(base - 1) < POWER_TOLERANCE:
            is_in_sector = is_in_sector[is_in_sector.imag <= math.pi + DISTINCT_ZERO_TOLERANCE]
        return tuple(sorted(is_in_sector.tolist(), key=lambda z: (z.real, z.imag)))
    values = np.array(list(polynomial.values()))
    zeros: list[complex] = []
    seeds = [_two_term_zeros(powers, values, max_argument)]
    for base in SEED_ORDER_BASES:
        if (highest - lowest) / base > MAX_SEED_DEGREE:
            continue
        seeds.append(_rounded_order_zeros(polynomial, base, max_argument))
    for z in _newton_zeros(np.concatenate(seeds), powers, values):
        if -DISTINCT_ZERO_TOLERANCE <= z.imag <= max_argument and all(
            abs(z - known_root) > DISTINCT_ZERO_TOLERANCE for known_root in zeros
        ):
            zeros.append(complex(z.real, max(z.imag, 0.0)))
    return tuple(sorted(zeros, key=lambda z: (z.real, z.imag)))


def _rounded_order_zeros(polynomial: Polynomial, base: float, max_argument: float) -> Complex:
    """Return initial guesses for zeros, as ln s: the zeros after rounding the orders to multiples of a base."""
    rounded: Polynomial = {}
    for power, value in polynomial.items():
        multiple = round(round(power / base) * base, 9)
        rounded[multiple] = rounded.get(multiple, 0.0) + value
    base_roots = roots_in_base({p: v for p, v in rounded.items() if v != 0.0}) if len(rounded) > 1 else None
    if base_roots is None or not base_roots[1].size:
        return np.empty(0, dtype=np.complex128)
    step, roots = base_roots
    roots = roots[np.abs(roots) > 0]
    w = np.log(np.abs(roots)) / step + 1j * np.abs(np.angle(roots)) / step
    return np.asarray(w[w.imag <= 1.2 * max_argument], dtype=np.complex128)


def _two_term_zeros(powers: Floats, values: Floats, max_argument: float) -> Complex:
    """Return initial guesses for zeros of a sum of c s^p, as ln s: for each pair of terms, the zeros of their sum.

    `powers` and `values` are p and c. The guesses are accurate for zeros of very small or large magnitude if orders
    differ little.
    """
    out = []
    for i, j in itertools.combinations(range(powers.size), 2):
        difference = powers[j] - powers[i]
        phase = np.angle(-values[i] / values[j] + 0j)
        angles = (
            phase + 2 * math.pi * np.arange(-1, math.ceil(max_argument * abs(difference) / math.pi) + 1)
        ) / difference
        log_magnitude = math.log(abs(values[i] / values[j])) / difference
        out += [complex(log_magnitude, a) for a in angles.tolist() if -DISTINCT_ZERO_TOLERANCE <= a <= max_argument]
    return np.array(out, dtype=np.complex128)


def _newton_zeros(w: Complex, powers: Floats, values: Floats) -> list[complex]:
    """Return the zeros of a sum of c s^p, as ln s, to which Newton's method converges from the initial guesses `w`.

    `powers` and `values` are p and c.
    """
    if not w.size:
        return []
    for _ in range(MAX_NEWTON_ITERATIONS):
        terms, _ = scaled_terms(w, powers, values)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.sum(terms, axis=0) / np.sum(powers[:, None] * terms, axis=0)
        step = np.where(np.isfinite(step), step, 0.0)
        w = w - step * np.minimum(1.0, MAX_NEWTON_STEP / np.maximum(np.abs(step), 1e-300))
    terms, _ = scaled_terms(w, powers, values)
    is_zero = np.abs(np.sum(terms, axis=0)) <= ZERO_TOLERANCE * np.sum(np.abs(terms), axis=0)
    return [complex(z) for z in w[is_zero]]


def scaled_terms(w: Complex, powers: Floats, values: Floats) -> tuple[Complex, Floats]:
    """Return the terms c s^p at each w = ln s, divided by their largest magnitude m, and ln m.

    `powers` and `values` are p and c.
    """
    exponents = np.outer(powers, w)
    largest = np.max(exponents.real + np.log(np.abs(values))[:, None], axis=0)
    return np.asarray(values[:, None] * np.exp(exponents - largest)), largest
