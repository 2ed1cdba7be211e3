"""Fractional PID controllers: design, and discrete-time approximation with a fixed number of states."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from ftlm.analysis.frequency_response import (
    check_no_input_nonlinearity,
    covariance_of,
    is_coupled,
    parameter_vector,
    response_inputs,
)
from ftlm.analysis.rational_approximation import MAX_APPROXIMATION_ORDER, oustaloup
from ftlm.control.arguments import check_limit, check_samples, checked_rate
from ftlm.control.stability_margins import LoopDesign, Margins, Plant, margins_of, nyquist_frequencies
from ftlm.errors import ModelError
from ftlm.model.model import Model, check_model
from ftlm.simulation.discretization import check_linear
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import parameter, setting, type_name
from ftlm.utils.validation import (
    Complex,
    Floats,
    as_complex,
    check_integer,
    check_vector,
    frequency_pair,
    nearest,
    real_number,
    short_repr,
)

#: Factor by which the frequencies of the poles extend beyond the band at both ends.
POLE_RANGE_FACTOR = 30.0
#: Maximum ratio of the upper to the lower frequency of the band.
MAX_BAND_RATIO = 1e9
#: Number of frequencies at which the approximation error is evaluated.
ERROR_FREQUENCIES = 200


@check_arguments
@dataclass(frozen=True)
class FractionalPid:
    """Fractional PID controller kp + ki s^-lam + kd s^mu.

    Parameters
    ----------
    kp, ki, kd
        Gains from the error to the controller output.
    lam, mu
        Orders of the integral and of the derivative, above 0 and at most 2.

    Raises
    ------
    ModelError
        If a gain is not finite, or an order is out of range.
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
                raise ModelError(f"{name} = {value:g} is not finite; give a finite number")
            if name in ("lam", "mu") and not 0 < value <= 2:
                raise ModelError(
                    f"{name} = {value:g} is not an order of a fractional PID; give an order above 0, at most 2"
                )
            object.__setattr__(self, name, value)

    def response(self, w: Floats | Complex) -> Complex:
        """Return the exact complex frequency response at frequencies w > 0 [rad/s], of the same shape as w."""
        s = 1j * as_complex("w", w)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return np.asarray(self.kp + self.ki * s**-self.lam + self.kd * s**self.mu)

    def to_dict(self) -> dict[str, Any]:
        """Return gains and orders as a dictionary for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        return f"{self.kp:.4g} + {self.ki:.4g} s^-{self.lam:.3g} + {self.kd:.4g} s^{self.mu:.3g}"


@dataclass(frozen=True)
class _Bank:
    """Sum of first-order lags 1/(s + p) and a direct gain, discretized exactly for inputs linear between samples.

    A lag has the state x_k = keep x_{k-1} + now e_k + before e_{k-1} for the input e. The output is direct e_k plus the
    sum of weight x_k over all lags.
    """

    direct: float
    weights: Floats
    keeps: Floats
    input_gain: Floats
    previous_input_gain: Floats

    def response(self, z: Complex) -> Complex:
        """Return the frequency response at points z on the unit circle, shape (W,)."""
        inverse = 1.0 / z[:, None]
        lags = (self.input_gain + self.previous_input_gain * inverse) / (1.0 - self.keeps * inverse)
        return np.asarray(self.direct + lags @ self.weights)


@check_arguments
class DiscretePid:
    """Discrete-time fractional PID controller: Oustaloup's approximation as a sum of first-order lags.

    Call it once per sample with the control error; it returns the controller output. The derivative part starts in the
    steady state of a constant error, so there is no derivative kick at the first sample. While the output is saturated,
    the integral is not increased in the direction of the saturation (anti-windup).

    Parameters
    ----------
    pid
        Fractional PID with orders up to 1.
    rate
        Sampling rate [Hz].
    limit
        Magnitude at which the output saturates.
    band
        Frequency band (low, high) of the approximation [rad/s]; by default from a thousandth to an eighth of the
        Nyquist frequency.
    order
        Order N of Oustaloup's filter, which has 2 N + 1 poles for the integral and as many for the derivative.

    Raises
    ------
    ModelError
        If an order of the PID is above 1, gains overflow, or rate, limit, band or order is invalid.
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
            raise ModelError(
                f"pid is {type_name(pid)}, not a FractionalPid; design one, or construct it from its five parameters"
            )
        for name, order_value in (("lam", pid.lam), ("mu", pid.mu)):
            if order_value > 1:
                raise ModelError(
                    f"{name} = {order_value:g} cannot be realized in discrete time; give a controller with orders "
                    "of at most 1"
                )
        value = checked_rate(rate)
        maximum = check_limit(limit)
        half = math.pi * value
        if band is None:
            band = (half / 1000.0, half / 8.0)
        low, high = frequency_pair(band)
        if not (0 < low < high <= half and high <= MAX_BAND_RATIO * low):
            raise ModelError(
                f"band = ({low:g}, {high:g}) rad/s is out of range; give two increasing frequencies up to half "
                f"the rate, {half:g} rad/s, the upper at most {MAX_BAND_RATIO:g} times the lower"
            )
        count = check_integer("order", order, 1, MAX_APPROXIMATION_ORDER)
        self.pid, self.rate, self.limit, self.band, self.order = pid, value, maximum, (low, high), count
        pole_band = (low / POLE_RANGE_FACTOR, high * POLE_RANGE_FACTOR)
        self._integral = _bank(pid.ki, *_integral(pid.lam, pole_band, count), 1.0 / value)
        self._derivative = _bank(pid.kd, *_power(pid.mu, pole_band, count), 1.0 / value)
        #: Maximum gain error [dB] and phase error [degrees] over the band, relative to the exact controller.
        self.gain_error, self.phase_error = self._errors()
        if not math.isfinite(self.gain_error + self.phase_error):
            raise ModelError(f"{pid} has no finite response in its band; give finite gains, at least one of them not 0")
        self.reset()

    @property
    def state_count(self) -> int:
        """Number of states of the controller, including the last error."""
        return len(self._integral.weights) + len(self._derivative.weights) + 1

    @property
    def direct_gain(self) -> float:
        """Sum of the direct gains of the integral part and of the derivative part, without kp."""
        return self._integral.direct + self._derivative.direct

    def lags(self) -> list[tuple[Literal["integral", "derivative"], tuple[float, float, float, float]]]:
        """Return ("integral" or "derivative", (keep, now, before, weight)) of each first-order lag.

        The state of a lag at sample k is x_k = keep x_{k-1} + now e_k + before e_{k-1}, where e is the error. The
        controller output before saturation is (kp + `direct`) e_k plus the sum of weight x_k over all lags.
        """
        banks: tuple[tuple[Literal["integral", "derivative"], _Bank], ...] = (
            ("integral", self._integral),
            ("derivative", self._derivative),
        )
        return [
            (name, (float(k), float(n), float(b), float(w)))
            for name, bank in banks
            for k, n, b, w in zip(bank.keeps, bank.input_gain, bank.previous_input_gain, bank.weights, strict=True)
        ]

    def response(self, w: Floats | Complex) -> Complex:
        """Return the frequency response of the unsaturated discrete-time controller at w [rad/s], shape (W,)."""
        z = np.exp(1j * check_vector("w", as_complex("w", w)) / self.rate)
        return self.pid.kp + self._integral.response(z) + self._derivative.response(z)

    def reset(self) -> None:
        """Reset all states, so that the next sample is the first one."""
        self._sums = np.zeros(len(self._integral.weights))
        self._lags: Floats | None = None
        self._error = 0.0

    def __call__(self, error: float) -> float:
        """Return the controller output for the control error of the next sample."""
        error = float(error)
        if self._lags is None:
            # The lags of the derivative start in the steady state of a constant error, in which its output is zero.
            bank = self._derivative
            self._lags = error * (bank.input_gain + bank.previous_input_gain) / (1.0 - bank.keeps)
            self._error, sums = error, self._sums
        else:
            self._lags = self._next_states(self._derivative, self._lags, error)
            sums = self._next_states(self._integral, self._sums, error)
        proportional_part = (
            self.pid.kp * error + self._derivative.direct * error + float(self._lags @ self._derivative.weights)
        )
        output = proportional_part + self._integral.direct * error + float(sums @ self._integral.weights)
        # The integral of an error moves the output in the direction of error times gain.
        if abs(output) > self.limit and output * error * self.pid.ki > 0:
            sums = self._sums
            output = proportional_part + self._integral.direct * error + float(sums @ self._integral.weights)
        self._sums, self._error = sums, error
        return min(max(output, -self.limit), self.limit)

    def _next_states(self, bank: _Bank, states: Floats, error: float) -> Floats:
        return bank.keeps * states + bank.input_gain * error + bank.previous_input_gain * self._error

    def _errors(self) -> tuple[float, float]:
        w = np.geomspace(*self.band, ERROR_FREQUENCIES)
        with np.errstate(all="ignore"):
            quotient = self.response(w) / self.pid.response(w)
            gain = float(np.max(np.abs(20.0 * np.log10(np.abs(quotient)))))
        return gain, float(np.degrees(np.max(np.abs(np.angle(quotient)))))

    def to_dict(self) -> dict[str, Any]:
        """Return gains, orders, rate, band and approximation errors as a dictionary for JSON."""
        return {
            "pid": self.pid.to_dict(),
            "rate": self.rate,
            "band": list(self.band),
            "gain_error_db": self.gain_error,
            "phase_error_degrees": self.phase_error,
            "state_count": self.state_count,
        }

    def __str__(self) -> str:
        return (
            f"{self.pid} at {self.rate:g} Hz with {self.state_count} states: within {self.gain_error:.2g} dB and "
            f"{self.phase_error:.2g} degrees from {self.band[0]:.3g} to {self.band[1]:.3g} rad/s"
        )


def _power(power: float, pole_band: tuple[float, float], order: int) -> tuple[Floats, Floats, float]:
    """Return (poles, residues, direct gain) of Oustaloup's filter for s^power, 0 < power <= 1.

    `pole_band` is the frequency range of the poles [rad/s], and `order` the order of the filter. The steady-state gain
    is zero. The filter is the direct gain plus the sum of residue/(s + pole). For power 1 it is a filtered derivative.
    """
    if power < 1.0:
        poles, residues, _ = oustaloup(power, pole_band, order)
        # This direct gain makes the steady-state gain zero. Oustaloup's own gives the gain at the band's lower end.
        return poles, residues, -float(np.sum(residues / poles))
    high = pole_band[1]
    return np.array([high]), np.array([-high * high]), high


def _integral(power: float, pole_band: tuple[float, float], order: int) -> tuple[Floats, Floats, float]:
    """Return (poles, residues, direct gain) of an approximation of s^-power, 0 < power <= 1, with a pole at s = 0.

    It is an integrator in series with Oustaloup's filter for s^(1 - power), so a loop has no steady-state error.
    """
    if power >= 1.0:
        return np.zeros(1), np.ones(1), 0.0
    poles, residues, gain = oustaloup(1.0 - power, pole_band, order)
    total_gain = gain + float(np.sum(residues / poles))
    return np.append(0.0, poles), np.append(total_gain, -residues / poles), 0.0


def _bank(factor: float, poles: Floats, residues: Floats, direct: float, step: float) -> _Bank:
    """Return `factor` times (`direct` plus the sum of residue/(s + pole)) in discrete time.

    The discretization is exact for signals that are linear between samples. `step` is the sampling interval [s].
    """
    x = poles * step
    keeps = np.exp(-x)
    # Near x = 0, (1 - e^-x)/x and both coefficients are replaced by their limits 1, 1/2 and 1/2.
    is_small = x < 1e-6
    divisor = np.where(is_small, 1.0, x)
    mean = np.where(is_small, 1.0 - x / 2.0, -np.expm1(-divisor) / divisor)
    input_gain = step * np.where(is_small, 0.5, (1.0 - mean) / divisor)
    coefficients_before = step * np.where(is_small, 0.5, (mean - keeps) / divisor)
    with np.errstate(over="ignore"):
        return _Bank(factor * direct, factor * residues, keeps, input_gain, coefficients_before)


#: Range of the orders of integral and derivative, and number of values per order in each step of the grid refinement.
MIN_ORDER, MAX_ORDER, ORDERS_PER_ROUND = 0.5, 1.0, 15
#: Number of grid refinements.
REFINEMENT_ROUNDS = 3
#: Number of frequencies at which the sensitivity is evaluated to compare orders.
COMPARISON_FREQUENCIES = 300
#: Maximum sensitivity over all parameter samples that orders may have. If no orders reach it, they may exceed the
#: smallest value by the factor SENSITIVITY_TOLERANCE.
TARGET_SENSITIVITY, SENSITIVITY_TOLERANCE = 1.5, 1.05
#: Frequency, as a fraction of the crossover, at which the loop gain is maximized to reject friction and offsets.
LOW_FREQUENCY_FRACTION = 0.1
#: Maximum fraction of parameter samples for which the loop may be unstable or have too small a phase margin.
MAX_FAILED_SAMPLE_FRACTION = 0.05
#: Minimum phase margin for a parameter sample, as a fraction of the requested one.
MIN_PHASE_MARGIN_FRACTION = 0.5
#: Minimum crossover [rad/s] divided by the sampling rate [Hz]. Below it, margins are not computable in floating point.
MIN_CROSSOVER_FRACTION = 1e-6
#: Frequency, relative to the requested crossover, above which the loop gain must be below 1.
LAST_CROSSOVER_TOLERANCE = 1.01
#: Factors of the plant gain at which the phase margin is evaluated, besides 1.
GAIN_VARIATIONS = (0.7, 1.4)


@check_arguments
@dataclass(frozen=True)
class PidDesign(LoopDesign):
    """Result of :func:`fractional_pid`: the controller and the stability margins of its loop.

    Parameters
    ----------
    pid
        Designed controller.
    rate
        Sampling rate [Hz].
    nominal
        Stability margins of the loop at the nominal parameters of the model.
    samples
        Stability margins at parameters drawn from their covariance; empty if the model has no covariance.
    phase_margin_at_gains
        Phase margins [degrees] at 0.7, 1 and 1.4 times the plant gain.
    plants
        Plants from the manipulated input to all outputs that depend on it, the controlled output first.
    """

    pid: FractionalPid
    rate: float
    nominal: Margins
    samples: tuple[Margins, ...]
    phase_margin_at_gains: tuple[float, float, float]
    plants: tuple[Plant, ...] = field(default=(), compare=False, repr=False)

    def controller_response(self, w: Floats | Complex) -> tuple[tuple[str, ...], Complex, Complex]:
        """Return the names of the measured outputs, and two frequency responses of the controller at w [rad/s].

        The first is the response of the command to the negative of each measured output, shape (outputs, W). The second
        is the response of the command to the reference, shape (W,).
        """
        response = DiscretePid(self.pid, self.rate).response(w)
        return (self.plants[0].output,), response[None], response

    def to_dict(self) -> dict[str, Any]:
        """Return gains, orders and margins as a dictionary for JSON."""
        return {
            "design": "pid",
            "rate": self.rate,
            **self.pid.to_dict(),
            "phase_margin_at_gains": list(self.phase_margin_at_gains),
            **self._margins(),
        }

    def __str__(self) -> str:
        lines = [f"fractional PID: {self.pid}", *self._margin_lines()]
        lines.append(
            "phase margin with {:g}, 1, {:g} of the plant's gain: ".format(*GAIN_VARIATIONS)
            + ", ".join(f"{p:.3g}" for p in self.phase_margin_at_gains)
            + " degrees"
        )
        return "\n".join(lines)


@check_arguments
def fractional_pid(
    model: Model,
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
    """Design a fractional PID controller for a crossover frequency, a phase margin and a flat phase at the crossover.

    With a flat phase the phase margin depends little on the plant gain. The loop is also tested for parameters drawn
    from the covariance of the model.

    Parameters
    ----------
    model
        Linear model of any orders, identified or defined by hand.
    output, input : str, optional
        Controlled output and manipulated input; may be omitted for a model with one of them.
    crossover
        Gain crossover frequency [rad/s]. The loop must have no higher one.
    phase_margin
        Phase margin at the crossover [degrees], 10 to 80.
    rate
        Sampling rate [Hz]. The loop includes one sample of delay and the zero-order hold.
    samples
        Number of parameter vectors drawn from the covariance of the model, 0 to 10000.
    seed
        Seed of these random parameter vectors.
    coupling
        ``"simulated"``: the plant has all coupled equations. ``"measured"``: it has only the equation of the output.
    sensor
        Whether the measured output has passed the sensor filter of the model; by default it has not.

    Returns
    -------
    PidDesign
        Controller with margins at the nominal parameters and at each parameter sample.

    Raises
    ------
    ModelError
        If the model is unstable (an integrator is permitted), has friction, or is too uncertain. It is too uncertain if
        for more than 5 % of the parameter samples the loop is unstable or has less than half the requested phase
        margin. Also if no gains with the sign of the plant's gain meet the requirements, or if the selected
        loop is unstable at 0.7, 1 or 1.4 times the plant gain, or all loops have a second crossover above the requested
        one.

    Notes
    -----
    At given orders, three conditions at the crossover (gain 1, phase, zero slope of the phase) are linear in the three
    gains and are met exactly. Orders are admissible if the maximum sensitivity of their loop over the parameter samples
    is at most 1.5. If no orders achieve this, orders within 5 % of the smallest maximum sensitivity are admissible.
    Among them, those with the largest loop gain at a tenth of the crossover are selected. If their loop has another
    crossover at a higher frequency, only orders without one are compared. Source: Monje, Vinagre, Feliu and Chen
    (2008), doi:10.1016/j.conengprac.2007.08.006.
    """
    plant = plant_of(model, output, input, rate, coupling, sensor=sensor)
    wc = real_number("crossover", crossover)
    if not MIN_CROSSOVER_FRACTION * plant.rate <= wc < math.pi * plant.rate / 4:
        raise ModelError(
            f"{setting('crossover')} {short_repr(crossover)} rad/s is out of range; give one from "
            f"{MIN_CROSSOVER_FRACTION * plant.rate:.4g} to {math.pi * plant.rate / 4:.4g} at {plant.rate:g} Hz"
        )
    margin = real_number("phase_margin", phase_margin)
    if not 10 <= margin <= 80:
        raise ModelError(f"{setting('phase_margin')} {short_repr(phase_margin)} degrees is out of range; give 10 to 80")
    count, start = check_samples(samples, seed)
    plant.check_stable()
    samples_drawn = plant.samples(count, start)
    target = np.exp(1j * (math.radians(margin) - math.pi)) / plant.response(np.array([wc]))[0]
    crossover_pair = np.array([wc * (1 - 1e-5), wc * (1 + 1e-5)])
    slope = float(
        np.diff(np.unwrap(np.angle(plant.response(crossover_pair))))[0] / (crossover_pair[1] - crossover_pair[0])
    )
    # The derivative action may raise the loop gain close to 1 far above the crossover.
    w = np.geomspace(wc / 100, 0.999 * math.pi * plant.rate, COMPARISON_FREQUENCIES)
    plant_responses = np.array([plant_sample.response(w) for plant_sample in [plant, *samples_drawn[:50]]])
    find_controller = partial(_best_controller, target, slope, wc, w, plant_responses, plant.gain_sign())
    controller = find_controller()
    if controller is None:
        raise ModelError(
            "no fractional PID with gains of the plant's sign and orders from "
            f"{MIN_ORDER:g} to {MAX_ORDER:g} has a flat phase margin of {margin:g} degrees at {wc:g} rad/s on this "
            f"model, whose phase there is {np.degrees(np.angle(plant.response(np.array([wc]))[0])):.4g} degrees; move "
            "the crossover, or ask for another phase margin"
        )
    fine_frequencies = nyquist_frequencies(wc, plant.rate)
    is_above_crossover = fine_frequencies > LAST_CROSSOVER_TOLERANCE * wc
    high = plant.response(fine_frequencies[is_above_crossover])

    def is_last(pid: FractionalPid) -> bool:
        """Whether the loop gain is below 1 at all frequencies above the requested crossover."""
        return bool(np.all(np.abs(pid.response(fine_frequencies[is_above_crossover]) * high) < 1.0))

    choice = controller if is_last(controller) else find_controller(is_last)
    acting = (choice or controller).response(fine_frequencies)
    lam = (choice or controller).lam if (choice or controller).ki else 0.0

    def loop_margins(plant_sample: Plant, factor: float = 1.0) -> Margins:
        order = plant_sample.integral_order() + lam
        return margins_of(
            factor * acting * plant_sample.response(fine_frequencies),
            fine_frequencies,
            order,
            plant_sample.count_unstable_poles(),
        )

    nominal = loop_margins(plant)
    if choice is None:
        raise ModelError(
            f"the loop with a crossover of {wc:g} rad/s crosses a gain of 1 again on this model, last at "
            f"{nominal.crossover:.4g} rad/s, whatever the orders; if the plant has a resonance there, move the "
            "crossover above it or further below it, otherwise raise the crossover"
        )
    if not nominal.stable:
        raise ModelError(
            f"the loop with a phase margin of {margin:g} degrees at {wc:g} rad/s is not stable on this model; move the "
            "crossover, or ask for another phase margin"
        )
    margins = tuple(map(loop_margins, samples_drawn))
    failures = [m for m in margins if not (m.stable and m.phase >= MIN_PHASE_MARGIN_FRACTION * margin)]
    if len(failures) > MAX_FAILED_SAMPLE_FRACTION * len(margins):
        raise ModelError(
            f"the confidence intervals are too wide to design on: in {len(failures)} of {len(margins)} samples of the "
            f"parameters the loop is not stable or has less than {MIN_PHASE_MARGIN_FRACTION * margin:g} degrees of the "
            "phase margin; "
            f"{least_certain_parameter(model)}; "
            "identify from a longer or richer run, or lower the crossover"
        )
    low_gain, high_gain = (loop_margins(plant, factor) for factor in GAIN_VARIATIONS)
    if not (low_gain.stable and high_gain.stable):
        raise ModelError(
            f"the loop with a phase margin of {margin:g} degrees at {wc:g} rad/s has a gain margin of only "
            f"{nominal.gain:.3g}: it is unstable at {GAIN_VARIATIONS[0]:g} or "
            f"{GAIN_VARIATIONS[1]:g} times the gain of the plant; move the crossover, or ask for another phase margin"
        )
    other_plants = [replace(plant, output=o) for o in model.outputs if o != plant.output]
    plants = (plant, *(p for p in other_plants if p.has_response()))
    phases = (low_gain.phase, nominal.phase, high_gain.phase)
    return PidDesign(choice, plant.rate, nominal, margins, phases, plants)


def plant_of(
    model: Model, output: str | None, input_name: str | None, rate: float, coupling: str, *, sensor: bool
) -> Plant:
    """Return the plant of a sampled loop from the input `input_name` to an output of a model.

    If `output` or `input_name` is None, the only output or input of the model is used. Other arguments are those of
    :class:`Plant`. Raise ModelError if a name is unknown or missing, or the model is not linear.
    """
    check_model(model)
    if not isinstance(sensor, bool):
        raise ModelError(f"sensor = {short_repr(sensor)} is neither True nor False; give one of them")
    check_linear(model.equations, "a loop's margin")
    check_no_input_nonlinearity(model, "a loop's margin")
    inputs = response_inputs(model, coupled=is_coupled(coupling))
    names = []
    for kind, name, choices in (("output", output, model.outputs), ("input", input_name, inputs)):
        if name is None and len(choices) == 1:
            names.append(choices[0])
        elif name is None:
            raise ModelError(f"the model has several {kind}s; name one with {parameter(kind)}: {', '.join(choices)}")
        elif not isinstance(name, str) or name not in choices:
            suggestion = nearest(name, choices) if isinstance(name, str) else ""
            raise ModelError(
                f"{kind} = {short_repr(name)} is not one of the model's{suggestion}; it has "
                f"{', '.join(choices) or 'none'}"
            )
        else:
            names.append(name)
    return Plant(model, names[0], names[1], checked_rate(rate), coupling, sensor)


def _best_controller(
    target: complex,
    slope: float,
    wc: float,
    w: Floats,
    plant_responses: Complex,
    gain_sign: float,
    is_allowed: Callable[[FractionalPid], bool] = lambda _: True,
) -> FractionalPid | None:
    """Return the controller with the largest low-frequency gain that meets all conditions and `is_allowed`, or None.

    At the frequency `wc` [rad/s], the controller has the response `target`, and its phase slope is minus the phase
    slope `slope` of the plant. `plant_responses` are the responses of the plant at the frequencies `w`, one row per
    parameter sample. They determine the maximum sensitivity of the loop. The gains of the controller have the sign
    `gain_sign` of the gain of the plant.
    """
    candidates: list[tuple[float, float, FractionalPid]] = []
    center, half_range = ((MIN_ORDER + MAX_ORDER) / 2,) * 2, (MAX_ORDER - MIN_ORDER) / 2
    for _ in range(REFINEMENT_ROUNDS):
        order_values = [
            np.clip(c + half_range * np.linspace(-1, 1, ORDERS_PER_ROUND), MIN_ORDER, MAX_ORDER) for c in center
        ]
        for lam in np.unique(order_values[0]).tolist():
            for mu in np.unique(order_values[1]).tolist():
                pid = _solve_gains(target, slope, wc, lam, mu, gain_sign)
                if pid is None or not is_allowed(pid):
                    continue
                max_sensitivity = float(np.max(1.0 / np.abs(1.0 + pid.response(w) * plant_responses)))
                candidates.append(
                    (max_sensitivity, float(abs(pid.response(np.array([LOW_FREQUENCY_FRACTION * wc]))[0])), pid)
                )
        if not candidates:
            return None
        sensitivity_limit = max(
            TARGET_SENSITIVITY, SENSITIVITY_TOLERANCE * min(max_sensitivity for max_sensitivity, _, _ in candidates)
        )
        controller = max((f for f in candidates if f[0] <= sensitivity_limit), key=lambda f: f[1])[2]
        center, half_range = (controller.lam, controller.mu), half_range / ORDERS_PER_ROUND * 2
    return controller


def _solve_gains(
    target: complex, slope: float, wc: float, lam: float, mu: float, gain_sign: float
) -> FractionalPid | None:
    """Return the controller C with orders lam and mu, C(j wc) = target and d arg C/dw = -slope at wc [rad/s].

    Return None if a gain does not have the sign `gain_sign` or is not finite, or if the equations are singular.
    """
    powers = np.array([0.0, -lam, mu])
    powers_of_s = (1j * wc) ** powers
    turning = powers * powers_of_s / (wc * target)
    try:
        gains = np.linalg.solve(
            np.array([powers_of_s.real, powers_of_s.imag, turning.imag]), np.array([target.real, target.imag, -slope])
        )
    except np.linalg.LinAlgError:
        return None
    if not (np.isfinite(gains).all() and (gain_sign * gains >= 0).all()):
        return None
    kp, ki, kd = gains.tolist()
    return FractionalPid(kp, ki, kd, lam, mu)


def least_certain_parameter(model: Model) -> str:
    """Return text on the coefficient or order with the largest relative standard error, or on a missing covariance."""
    covariance = covariance_of(model)
    if covariance is None:
        return "their covariance is not known"
    names = []
    for equation in model.equations:
        names += [f"the order of {equation.output}"]
        names += [
            n
            for t in equation.terms
            for n in (
                f"the order of {t.signal} in {equation.output}",
                f"the coefficient of {t.signal} in {equation.output}",
            )
        ]
        names += [f"the friction of {equation.output}"] * (
            0 if equation.friction is None else len(equation.friction.parameter_values)
        )
    names += list(model.structure.fixed_input_parameters)
    relative_errors = np.sqrt(np.abs(np.diag(covariance))) / np.maximum(np.abs(parameter_vector(model)), 1e-12)
    at = int(np.argmax(np.nan_to_num(relative_errors, nan=0.0, posinf=1e300)))
    return f"the most uncertain is {names[at]}, with a standard error of {100 * relative_errors[at]:.2g} %"
