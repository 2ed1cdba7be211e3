"""Circuits and fractional transfer functions in closed form, a frequency at a time, in 30 digits."""

import mpmath
import numpy as np

mpmath.mp.dps = 30


def at(frequencies, formula):
    """A formula of s at angular frequencies [rad/s], rounded at the very end."""
    return np.array([complex(formula(mpmath.mpc(0, mpmath.mpf(float(w))))) for w in frequencies])


def randles(w, r0, r1, c):
    """A resistor, then a resistor beside a capacitor."""
    return at(w, lambda s: r0 + 1 / (1 / mpmath.mpf(r1) + s * c))


def zarc(w, r0, r1, time, alpha):
    """A resistor, then a resistor beside a constant-phase element: a depressed arc."""
    return at(w, lambda s: r0 + r1 / (1 + (s * time) ** alpha))


def warburg(w, r0, r1, time, alpha, sigma):
    """A depressed arc in series with the diffusion of a half-infinite medium."""
    return at(w, lambda s: r0 + r1 / (1 + (s * time) ** alpha) + sigma / mpmath.sqrt(s))


def cpe(w, q, alpha):
    """A constant-phase element."""
    return at(w, lambda s: 1 / (q * s**alpha))


def transfer(w, numerator, denominator, delay=0.0):
    """A quotient of sums of (coefficient, order), delayed."""

    def total(terms, s):
        return mpmath.fsum(mpmath.mpf(c) * s ** mpmath.mpf(o) for c, o in terms)

    return at(w, lambda s: total(numerator, s) / total(denominator, s) * mpmath.exp(-s * delay))
