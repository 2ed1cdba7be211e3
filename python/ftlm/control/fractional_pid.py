"""Fractional PID controllers, and the same one sample at a time in bounded memory."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np

from ftlm.analysis.frequency_response import check_unlimited, is_coupled, model_numbers, response_inputs
from ftlm.analysis.rational_approximation import LARGEST_ORDER, oustaloup
from ftlm.control.arguments import checked_rate, drawn_from, largest
from ftlm.control.stability_margins import JudgedLoop, Margins, Plant, grid, margins_of
from ftlm.errors import ModelError
from ftlm.model.model import Solved, check_solved
from ftlm.simulation.discretization import check_linear
from ftlm.utils.validation import Complex, Floats, nearest, real_number, shown, whole_number

#: Poles reach this many times beyond the band on both sides.
REACH = 30.0
#: Widest band, high over low.
WIDEST = 1e9
#: Frequencies at which the error is measured.
COMPARED_FRACTIONAL = 200


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
        self,
        pid: FractionalPid,
        rate: float,
        *,
        limit: float = math.inf,
        band: tuple[float, float] | None = None,
        order: int = 6,
    ) -> None:
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
            ("integral", self._integral),
            ("derivative", self._derivative),
        )
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
        w = np.geomspace(*self.band, COMPARED_FRACTIONAL)
        with np.errstate(all="ignore"):
            quotient = self.response(w) / self.pid.response(w)
            gain = float(np.max(np.abs(20.0 * np.log10(np.abs(quotient)))))
        return gain, float(np.degrees(np.max(np.abs(np.angle(quotient)))))

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "pid": self.pid.to_dict(),
            "rate": self.rate,
            "band": list(self.band),
            "gain_error_db": self.gain_error,
            "phase_error_degrees": self.phase_error,
            "memory": self.memory,
        }

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


#: Orders that are tried: of the integral and of the derivative, first over all, then around the best.
LOWEST, HIGHEST, TRIED = 0.5, 1.0, 15
ROUNDS = 3
#: Frequencies of the curves on which orders are compared.
COMPARED = 300
#: Largest sensitivity over all samples that is aimed at; where none has so little, this much above the least.
CALM, ABOVE = 1.5, 1.05
#: Where the loop's gain is to be high, against friction and offsets: this share of the crossover.
SLOW = 0.1
#: A design that more than this share of the parameters' samples breaks is none.
BROKEN = 0.05
#: A sample keeps a design whose phase margin is at least this share of what was asked for.
KEPT = 0.5
#: The lowest crossover as a share of its rate: below, floating point tells no margins.
SLOWEST = 1e-6
#: Gains of the plant over which flatness is told.
FLAT = (0.7, 1.4)


@dataclass(frozen=True)
class PidDesign(JudgedLoop):
    """A fractional PID with the margins of its loop.

    Parameters
    ----------
    pid
        The controller.
    rate
        Of the loop [Hz].
    nominal
        Margins at the values of the model's numbers.
    samples
        Margins at samples of the numbers from their covariance; none where the model has no covariance.
    flat
        Phase margin with 0.7, 1 and 1.4 times the plant's gain [degrees].
    plants
        Every output that the input moves, that which is controlled first.
    """

    pid: FractionalPid
    rate: float
    nominal: Margins
    samples: tuple[Margins, ...]
    flat: tuple[float, float, float]
    plants: tuple[Plant, ...] = field(default=(), compare=False, repr=False)

    def acting(self, w: Floats | Complex) -> tuple[tuple[str, ...], Complex, Complex]:
        """The output it reads, its response to it and to the reference, at frequencies [rad/s], as it runs."""
        response = Realised(self.pid, self.rate).response(w)
        return (self.plants[0].output,), response[None], response

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "design": "pid",
            "rate": self.rate,
            **self.pid.to_dict(),
            "phase_margin_at_gains": list(self.flat),
            **self._margins(),
        }

    def __str__(self) -> str:
        lines = [f"fractional PID: {self.pid}", *self._judged()]
        lines.append(
            "phase margin with {:g}, 1, {:g} of the plant's gain: ".format(*FLAT)
            + ", ".join(f"{p:.3g}" for p in self.flat)
            + " degrees"
        )
        return "\n".join(lines)


def fractional_pid(
    model: Solved,
    *,
    output: str | None = None,
    input: str | None = None,
    crossover: float,
    phase_margin: float = 60.0,
    rate: float = 500.0,
    samples: int = 100,
    seed: int = 0,
    coupling: Literal["simulated", "measured"] = "simulated",
    sensor: bool = False,
) -> PidDesign:
    """Tune a fractional PID on a model: crossover, phase margin, flat phase, and the best worst case of its intervals.

    Parameters
    ----------
    model
        A linear model, identified or written down, of any orders.
    output, input : str, optional
        What is controlled and what with; where the model has one of them alone it needs no name.
    crossover
        Where the loop's gain is 1 [rad/s].
    phase_margin
        There [degrees], 10 to 80.
    rate
        Of the loop [Hz], whose sample of delay and whose hold are counted as they are.
    samples
        Of the model's numbers, from their covariance, 0 to 10000.
    seed
        Of the samples.
    coupling
        ``"measured"``: the output's own equation alone.
    sensor
        Whether the loop reads what passed the model's sensor filter; by default the filter was of the run alone.

    Returns
    -------
    PidDesign
        With margins at the values and at each sample.

    Raises
    ------
    ModelError
        A model that is not stable (an integral is), with friction, or whose intervals are too wide: more than a
        twentieth of the samples break the loop or halve its phase margin. A margin that no gains from 0 reach there.

    Notes
    -----
    At given orders three conditions at the crossover, gain 1, phase, and no change of phase with frequency, are linear
    in the three gains: they hold exactly. Of all orders whose largest sensitivity over all samples is at most 1.5 (or
    within 5 % of the least there is) those are taken that give the loop most gain at a tenth of the crossover.
    Monje, Vinagre, Feliu and Chen (2008), doi:10.1016/j.conengprac.2007.08.006.
    """
    plant = plant_of(model, output, input, rate, coupling, sensor=sensor)
    wc = real_number("crossover", crossover)
    if not SLOWEST * plant.rate <= wc < math.pi * plant.rate / 4:
        raise ModelError(
            f"crossover = {shown(crossover)} rad/s is outside [{SLOWEST * plant.rate:.4g}, "
            f"{math.pi * plant.rate / 4:.4g}), from a millionth to an eighth of the rate of {plant.rate:g} Hz"
        )
    asked = real_number("phase_margin", phase_margin)
    if not 10 <= asked <= 80:
        raise ModelError(f"phase_margin = {shown(phase_margin)} degrees is outside [10, 80]")
    count, start = drawn_from(samples, seed)
    plant.check_stable()
    drawn = plant.samples(count, start)
    target = np.exp(1j * (math.radians(asked) - math.pi)) / plant.response(np.array([wc]))[0]
    near = np.array([wc * (1 - 1e-5), wc * (1 + 1e-5)])
    slope = float(np.diff(np.unwrap(np.angle(plant.response(near))))[0] / (near[1] - near[0]))
    w = np.geomspace(wc / 100, min(30 * wc, 0.999 * math.pi * plant.rate), COMPARED)
    curves = np.array([one.response(w) for one in [plant, *drawn[:50]]])
    best = _best(target, slope, wc, w, curves)
    if best is None:
        raise ModelError(
            f"no fractional PID with gains from 0 and orders from {LOWEST:g} to {HIGHEST:g} has a flat phase margin of "
            f"{asked:g} degrees at {wc:g} rad/s on this model, whose phase there is "
            f"{np.degrees(np.angle(plant.response(np.array([wc]))[0])):.4g} degrees; move the crossover, or ask for "
            "another phase margin"
        )
    fine = grid(wc, plant.rate)
    acting = best.response(fine)

    def judged(one: Plant, factor: float = 1.0) -> Margins:
        order = one.integrates() + (best.lam if best.ki > 0 else 0.0)
        return margins_of(factor * acting * one.response(fine), fine, order, one.grows())

    nominal = judged(plant)
    if not nominal.stable:
        raise ModelError(
            f"the loop with a phase margin of {asked:g} degrees at {wc:g} rad/s is not stable on this model: its gain "
            "is 1 elsewhere too, at a resonance; move the crossover away from it"
        )
    margins = tuple(map(judged, drawn))
    broken = [m for m in margins if not (m.stable and m.phase >= KEPT * asked)]
    if len(broken) > BROKEN * len(margins):
        raise ModelError(
            f"the intervals are too wide to design on: in {len(broken)} of {len(margins)} samples of the model's "
            f"numbers the loop is not stable or has less than {KEPT * asked:g} degrees of the phase margin; "
            f"{known_least(model)}; "
            "identify from a longer or richer run, or lower the crossover"
        )
    flat = tuple(judged(plant, factor).phase for factor in (FLAT[0], 1.0, FLAT[1]))
    others = [replace(plant, output=o) for o in model.outputs if o != plant.output]
    moved = (plant, *(p for p in others if p.reached()))
    return PidDesign(best, plant.rate, nominal, margins, (flat[0], flat[1], flat[2]), moved)


def plant_of(
    model: Solved, output: str | None, driver: str | None, rate: float, coupling: str, *, sensor: bool
) -> Plant:
    """The input and output that are meant, or a refusal."""
    check_solved(model)
    if not isinstance(sensor, bool):
        raise ModelError(f"sensor = {shown(sensor)} is neither True nor False")
    check_linear(model.equations, "a loop's margin")
    check_unlimited(model, "a loop's margin")
    inputs = response_inputs(model, coupled=is_coupled(coupling))
    names = []
    for what, name, known in (("output", output, model.outputs), ("input", driver, inputs)):
        if name is None and len(known) == 1:
            names.append(known[0])
        elif name is None:
            raise ModelError(f"the model has several {what}s: say which, {what}=…; it has {', '.join(known)}")
        elif not isinstance(name, str) or name not in known:
            near = nearest(name, known) if isinstance(name, str) else ""
            raise ModelError(
                f"{what} = {shown(name)} is not one of the model's{near}; it has {', '.join(known) or 'none'}"
            )
        else:
            names.append(name)
    return Plant(model, names[0], names[1], checked_rate(rate), coupling, sensor)


def _best(target: complex, slope: float, wc: float, w: Floats, curves: Complex) -> FractionalPid | None:
    """Of the calm controllers that meet all three conditions, the one with most gain at low frequencies."""
    found: list[tuple[float, float, FractionalPid]] = []
    centre, reach = ((LOWEST + HIGHEST) / 2,) * 2, (HIGHEST - LOWEST) / 2
    for _ in range(ROUNDS):
        around = [np.clip(c + reach * np.linspace(-1, 1, TRIED), LOWEST, HIGHEST) for c in centre]
        for lam in np.unique(around[0]).tolist():
            for mu in np.unique(around[1]).tolist():
                pid = _solved(target, slope, wc, lam, mu)
                if pid is None:
                    continue
                worst = float(np.max(1.0 / np.abs(1.0 + pid.response(w) * curves)))
                found.append((worst, float(abs(pid.response(np.array([SLOW * wc]))[0])), pid))
        if not found:
            return None
        calm = max(CALM, ABOVE * min(worst for worst, _, _ in found))
        best = max((f for f in found if f[0] <= calm), key=lambda f: f[1])[2]
        centre, reach = (best.lam, best.mu), reach / TRIED * 2
    return best


def _solved(target: complex, slope: float, wc: float, lam: float, mu: float) -> FractionalPid | None:
    """Gains at given orders: C(j wc) = target and d arg C/dw = -slope; None where one is negative."""
    powers = np.array([0.0, -lam, mu])
    parts = (1j * wc) ** powers
    turning = powers * parts / (wc * target)
    try:
        gains = np.linalg.solve(
            np.array([parts.real, parts.imag, turning.imag]), np.array([target.real, target.imag, -slope])
        )
    except np.linalg.LinAlgError:
        return None
    if not (np.isfinite(gains).all() and (gains >= 0).all()):
        return None
    kp, ki, kd = gains.tolist()
    return FractionalPid(kp, ki, kd, lam, mu)


def known_least(model: Solved) -> str:
    """Which coefficient or order is known least."""
    covariance = None if model.estimate is None else model.estimate.covariance
    if covariance is None:
        return "none is known"
    names = []
    for item in model.equations:
        names += [f"the order of {item.output}"]
        names += [
            n
            for t in item.terms
            for n in (f"the order of {t.signal} in {item.output}", f"the coefficient of {t.signal} in {item.output}")
        ]
    share = np.sqrt(np.abs(np.diag(covariance))) / np.maximum(np.abs(model_numbers(model)), 1e-12)
    at = int(np.argmax(np.nan_to_num(share, nan=0.0, posinf=1e300)))
    return f"known least is {names[at]}, to {100 * share[at]:.2g} % (one standard error)"
