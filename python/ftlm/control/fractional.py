"""Fractional PID controllers, and the same one sample at a time in bounded memory."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from ftlm.base.arrays import Complex, Floats
from ftlm.base.checks import real_number, shown, whole_number
from ftlm.base.errors import ModelError
from ftlm.control.names import checked_rate, largest
from ftlm.solve.approximation import LARGEST_ORDER, oustaloup

#: Poles reach this many times beyond the band on both sides.
REACH = 30.0
#: Widest band, high over low.
WIDEST = 1e9
#: Frequencies at which the error is measured.
COMPARED = 200


@dataclass(frozen=True)
class FractionalPid:
    """kp + ki s^-lam + kd s^mu.

    Parameters
    ----------
    kp, ki, kd
        Gains, of the controller's output over the error.
    lam, mu
        Orders of the integral and of the derivative, above 0 and at most 2.

    Raises
    ------
    ModelError
        A gain that is no finite number, an order out of range.
    """

    kp: float
    ki: float
    kd: float
    lam: float
    mu: float

    def __post_init__(self) -> None:
        for name in ("kp", "ki", "kd", "lam", "mu"):
            value = real_number(name, getattr(self, name))
            if not math.isfinite(value):
                raise ModelError(f"{name} = {value:g} is not a finite number; give one")
            if name in ("lam", "mu") and not 0 < value <= 2:
                raise ModelError(f"{name} = {value:g} is no order of a fractional PID; give one above 0, at most 2")
            object.__setattr__(self, name, value)

    def response(self, w: Floats | Complex) -> Complex:
        """Exact response at frequencies above 0 [rad/s]."""
        s = 1j * np.asarray(w)
        return np.asarray(self.kp + self.ki * s**-self.lam + self.kd * s**self.mu)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    def __str__(self) -> str:
        return f"{self.kp:.4g} + {self.ki:.4g} s^-{self.lam:.3g} + {self.kd:.4g} s^{self.mu:.3g}"


@dataclass(frozen=True)
class _Bank:
    """A sum of gain, integral and lags 1/(s + p), exact for what is linear between samples."""

    direct: float
    weights: Floats
    keeps: Floats
    now: Floats
    before: Floats

    def response(self, z: Complex) -> Complex:
        """At points of the unit circle."""
        inverse = 1.0 / z[:, None]
        lags = (self.now + self.before * inverse) / (1.0 - self.keeps * inverse)
        return np.asarray(self.direct + lags @ self.weights)


class Realised:
    """A fractional PID at a sampling rate: Oustaloup's poles, each an exponential memory of one number.

    The first sample is safe: a constant error has no derivative, so what is there at the start answers with kp alone.
    While the output is at its limit the integral stands still where it would push it further.

    Parameters
    ----------
    pid
        The controller, of orders up to 1.
    rate
        Samples per second.
    limit
        Largest output; what is beyond is cut, since it is known to be and nothing winds up.
    band
        Frequencies within which it is to hold [rad/s]; default from a thousandth to an eighth of the rate's half.
    order
        Of Oustaloup's filter: 2 order + 1 poles for the integral, as many for the derivative.

    Raises
    ------
    ModelError
        A controller whose orders exceed 1 or whose gains leave floating point, a rate, limit, band or order that is
        none.
    """

    def __init__(
        self, pid: FractionalPid, rate: float, *, limit: float = math.inf, band: tuple[float, float] | None = None,
        order: int = 6,
    ) -> None:  # fmt: skip
        if not isinstance(pid, FractionalPid):
            raise ModelError(f"pid is a {type(pid).__name__}, no FractionalPid; tune one, or write its five numbers")
        for name, given in (("lam", pid.lam), ("mu", pid.mu)):
            if given > 1:
                raise ModelError(f"{name} = {given:g} cannot be realised; give a controller whose orders are at most 1")
        value = checked_rate(rate)
        most = largest(limit)
        half = math.pi * value
        if band is None:
            band = (half / 1000.0, half / 8.0)
        try:
            low, high = (real_number("band", b) for b in band)
        except (TypeError, ValueError):
            raise ModelError(f"band = {shown(band)} is no pair of frequencies; give (low, high) in rad/s") from None
        if not (0 < low < high <= half and high <= WIDEST * low):
            raise ModelError(
                f"band = ({low:g}, {high:g}) rad/s is no interval up to half the rate, {half:g} rad/s, whose upper end "
                f"is at most {WIDEST:g} times the lower"
            )
        count = whole_number(order)
        if count is None or not 1 <= count <= LARGEST_ORDER:
            raise ModelError(f"order = {shown(order)} is no whole number from 1 to {LARGEST_ORDER}")
        self.pid, self.rate, self.limit, self.band, self.order = pid, value, most, (low, high), count
        reach = (low / REACH, high * REACH)
        self._integral = _bank(pid.ki, *_integral(pid.lam, reach, count), 1.0 / value)
        self._derivative = _bank(pid.kd, *_power(pid.mu, reach, count), 1.0 / value)
        #: Largest errors over the band against the exact controller [dB], [degrees].
        self.gain_error, self.phase_error = self._errors()
        if not math.isfinite(self.gain_error + self.phase_error):
            raise ModelError(f"{pid} is not finite in its band; give gains within floating point, one not 0")
        self.reset()

    @property
    def memory(self) -> int:
        """Numbers that are remembered from one sample to the next."""
        return len(self._integral.weights) + len(self._derivative.weights) + 1

    @property
    def direct(self) -> float:
        """What acts at once, besides kp and the lags."""
        return self._integral.direct + self._derivative.direct

    def lags(self) -> list[tuple[Literal["integral", "derivative"], tuple[float, float, float, float]]]:
        """What each of its memories keeps, takes in of this error and of the last, and weighs."""
        banks: tuple[tuple[Literal["integral", "derivative"], _Bank], ...] = (
            ("integral", self._integral), ("derivative", self._derivative),
        )  # fmt: skip
        return [
            (name, (float(k), float(n), float(b), float(w)))
            for name, bank in banks
            for k, n, b, w in zip(bank.keeps, bank.now, bank.before, bank.weights, strict=True)
        ]

    def response(self, w: Floats | Complex) -> Complex:
        """Its own response at frequencies [rad/s], limit apart."""
        z = np.exp(1j * np.asarray(w) / self.rate)
        return self.pid.kp + self._integral.response(z) + self._derivative.response(z)

    def reset(self) -> None:
        """Forgets everything."""
        self._sums = np.zeros(len(self._integral.weights))
        self._lags: Floats | None = None
        self._error = 0.0

    def __call__(self, error: float) -> float:
        """The output for the error of a sample."""
        if self._lags is None:
            # As if the error had always been there: of a constant no derivative is left.
            bank = self._derivative
            self._lags = error * (bank.now + bank.before) / (1.0 - bank.keeps)
            self._error, sums = error, self._sums
        else:
            self._lags = self._stepped(self._derivative, self._lags, error)
            sums = self._stepped(self._integral, self._sums, error)
        rest = self.pid.kp * error + self._derivative.direct * error + float(self._lags @ self._derivative.weights)
        output = rest + self._integral.direct * error + float(sums @ self._integral.weights)
        if abs(output) > self.limit and output * error > 0:
            sums = self._sums
            output = rest + self._integral.direct * error + float(sums @ self._integral.weights)
        self._sums, self._error = sums, error
        return min(max(output, -self.limit), self.limit)

    def _stepped(self, bank: _Bank, states: Floats, error: float) -> Floats:
        return bank.keeps * states + bank.now * error + bank.before * self._error

    def _errors(self) -> tuple[float, float]:
        w = np.geomspace(*self.band, COMPARED)
        with np.errstate(all="ignore"):
            quotient = self.response(w) / self.pid.response(w)
            gain = float(np.max(np.abs(20.0 * np.log10(np.abs(quotient)))))
        return gain, float(np.degrees(np.max(np.abs(np.angle(quotient)))))

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"pid": self.pid.to_dict(), "rate": self.rate, "band": list(self.band), "gain_error_db": self.gain_error,
                "phase_error_degrees": self.phase_error, "memory": self.memory}  # fmt: skip

    def __str__(self) -> str:
        return (
            f"{self.pid} at {self.rate:g} Hz with {self.memory} numbers of memory: within {self.gain_error:.2g} dB and "
            f"{self.phase_error:.2g} degrees from {self.band[0]:.3g} to {self.band[1]:.3g} rad/s"
        )


def _power(power: float, reach: tuple[float, float], order: int) -> tuple[Floats, Floats, float]:
    """Poles, residues and direct gain of s^power, 0 < power <= 1."""
    if power < 1.0:
        poles, residues, _ = oustaloup(power, reach, order)
        # The gain that leaves nothing of a constant, as no derivative does; Oustaloup's leaves the lower end's.
        return poles, residues, -float(np.sum(residues / poles))
    high = reach[1]
    return np.array([high]), np.array([-high * high]), high


def _integral(power: float, reach: tuple[float, float], order: int) -> tuple[Floats, Floats, float]:
    """The same of s^-power: an integral of s^(1 - power), so that nothing constant is left at rest."""
    if power >= 1.0:
        return np.zeros(1), np.ones(1), 0.0
    poles, residues, gain = oustaloup(1.0 - power, reach, order)
    whole = gain + float(np.sum(residues / poles))
    return np.append(0.0, poles), np.append(whole, -residues / poles), 0.0


def _bank(factor: float, poles: Floats, residues: Floats, direct: float, step: float) -> _Bank:
    """Lags that are exact for a signal that is linear between samples."""
    x = poles * step
    keeps = np.exp(-x)
    # (1 - e^-x)/x and what follows from it, whose limits at 0 are 1, 1/2 and 1/2.
    small = x < 1e-6
    safe = np.where(small, 1.0, x)
    mean = np.where(small, 1.0 - x / 2.0, -np.expm1(-safe) / safe)
    now = step * np.where(small, 0.5, (1.0 - mean) / safe)
    before = step * np.where(small, 0.5, (mean - keeps) / safe)
    with np.errstate(over="ignore"):
        return _Bank(factor * direct, factor * residues, keeps, now, before)
