"""LQG control and Kalman filters (observers) on a low-order realization of an identified model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ftlm.control.arguments import check_limit, check_samples, positive, select_outputs, sum_row
from ftlm.control.fractional_pid import MAX_FAILED_SAMPLE_FRACTION, least_certain_parameter, plant_of
from ftlm.control.realization import Realization, catch_numerical_errors, fit_realization
from ftlm.control.stability_margins import LoopDesign, Margins, Plant, margins_of
from ftlm.data.run import Run
from ftlm.errors import DataError, ModelError
from ftlm.model.model import Model, check_model
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import parameter, setting
from ftlm.utils.resources import python_control
from ftlm.utils.validation import Complex, Floats, as_complex, as_floats, check_vector, nearest, short_repr

#: Name of the estimated input disturbance among the estimates of an observer.
UNKNOWN_INPUT = "unknown input"


@check_arguments
@dataclass(frozen=True)
class Observer:
    """Steady-state Kalman filter of a discrete-time model with an unknown input disturbance.

    Parameters
    ----------
    realization
        State-space realization of the model with all outputs, and its approximation error.
    measured
        Names of the measured outputs.
    noise
         Standard deviation of the noise of each measured output.
    process_noise
        Process noise intensity: standard deviation of the change of the disturbance within one second.
    gain
        Kalman gain of the measurement update, shape (states + 1, measured outputs). The last row is for the
        disturbance.
    deviations
        Standard deviation of the estimation error of each output in steady state, as predicted by the model.
    """

    realization: Realization
    measured: tuple[str, ...]
    noise: tuple[float, ...]
    process_noise: float
    gain: Floats
    deviations: dict[str, float]

    @property
    def output_matrix(self) -> Floats:
        """Output matrix of the measured outputs, shape (measured outputs, states)."""
        return self.realization.c[[self.realization.outputs.index(o) for o in self.measured]]

    @property
    def matrices(self) -> tuple[Floats, Floats, Floats]:
        """Matrices a, b, c of the discrete-time system with the input disturbance as the last state."""
        a, b = self.realization.a, self.realization.b
        state_count = len(a)
        transformation = np.eye(state_count + 1)
        transformation[:state_count, :state_count], transformation[:state_count, state_count:] = a, b
        return (
            transformation,
            np.vstack([b, [[0.0]]]),
            np.column_stack([self.output_matrix, np.zeros(len(self.output_matrix))]),
        )

    def estimate_run(self, run: Run) -> dict[str, Floats]:
        """Return estimates of each output and of the input disturbance over a run, one array per name.

        The estimate at a sample uses this and earlier samples. The filter starts at rest or, if the model has an
        integrator, in the equilibrium in which one measured output has its first measured value.

        Raises
        ------
        DataError
            If the run lacks a signal, or has another sampling interval.
        """
        names = (self.realization.input, *self.measured)
        missing_names = [n for n in names if n not in run.signals]
        if missing_names:
            raise DataError(f"run {run.name} has no {', '.join(missing_names)}; the observer reads {', '.join(names)}")
        if abs(run.step * self.realization.rate - 1.0) > 1e-6:
            raise DataError(
                f"run {run.name} has a step of {run.step:g} s, and the observer one of "
                f"{1.0 / self.realization.rate:g} s; design it with {parameter('rate')}{1.0 / run.step:g}"
            )
        a, b, c = self.matrices
        y = np.array([run[n] for n in self.measured])
        projection = np.eye(len(a)) - self.gain @ c
        start = np.append(self.equilibrium_state(y[:, 0]), 0.0)
        # Corrected state at the next sample: x' = projection (a x + b u) + gain y'.
        library = python_control()
        system = library.ss(
            projection @ a,
            np.column_stack([projection @ b, self.gain]),
            np.eye(len(a)),
            np.zeros((len(a), 1 + len(self.measured))),
            1.0 / self.realization.rate,
        )
        time = np.arange(y.shape[1]) / self.realization.rate
        inputs = np.vstack([run[self.realization.input], np.column_stack([y[:, 1:], y[:, -1:]])])
        states = library.forced_response(system, time, inputs, start).states
        estimates = self.realization.c @ states[:-1]
        return dict(zip(self.realization.outputs, estimates, strict=True)) | {UNKNOWN_INPUT: states[-1]}

    def equilibrium_state(self, measured: Floats) -> Floats:
        """Return the equilibrium state, shape (states,), for the measured values of one sample.

        It is zero unless the model has an integrator that acts on a measured output.
        """
        states = np.zeros(self.realization.state_count)
        column = self.output_matrix[:, 0]
        if self.realization.poles[0] == 0 and np.any(column):
            at = int(np.argmax(np.abs(column)))
            states[0] = _measured_values(self, measured)[at] / column[at]
        return states

    def __str__(self) -> str:
        estimates = ", ".join(f"{o} to {d:.3g}" for o, d in self.deviations.items())
        return (
            f"observer from {', '.join(self.measured)}: {self.realization}; estimates {estimates} (standard deviation)"
        )


def _measured_values(observer: Observer, measured: Sequence[float] | Floats) -> Floats:
    """Return the measured values of one sample as an array (measured outputs,).

    Raise DataError unless there is one value for each measured output of the observer.
    """
    values = as_floats("measured", measured)
    if values.shape != (len(observer.measured),):
        raise DataError(f"measured has shape {values.shape}; give one value each of {', '.join(observer.measured)}")
    return values


@check_arguments
def observer(
    model: Model,
    *,
    input: str | None = None,
    measured: Sequence[str] | None = None,
    noise: Mapping[str, float] | None = None,
    process_noise: float,
    rate: float = 500.0,
    band: tuple[float, float] | None = None,
    poles: int | None = None,
    coupling: Literal["simulated", "measured"] = "simulated",
    sensor: bool = False,
) -> Observer:
    """Design an observer that estimates all outputs of a model from some of them, such as a deflection from an angle.

    Parameters
    ----------
    model
        Linear model that is stable except for an integrator.
    input : str, optional
        Name of the input; may be omitted for a model with one input.
    measured : sequence of str, optional
        Names of the measured outputs; by default all.
    noise : mapping, optional
        Standard deviation of the noise of each measured output; by default that of the residuals of the fit.
    process_noise
        Process noise intensity: standard deviation of the change of an input disturbance within one second, in the unit
        of the input. The disturbance represents friction, offsets and other unmodeled effects.
    rate, band, poles
        Sampling rate [Hz], frequency band (low, high) [rad/s] and number of poles of the integer-order realization. The
        default band is from 1/5000 to 1/8 of the Nyquist frequency. By default, there are as many poles as errors below
        0.1 dB and 1 degree require.
    coupling, sensor
        As for :func:`ftlm.analysis.frequency_response`. By default, measured outputs have not passed the sensor filter.

    Returns
    -------
    Observer
        Steady-state Kalman filter.

    Raises
    ------
    ModelError
        If the model is unstable or has no accurate low-order realization, or if python-control is not installed. Also
        if a name or the noise of an output is unknown, or states are not observable.
    """
    plants = plants_of(model, input, rate, coupling, sensor=sensor)
    names = select_outputs("measured", measured, tuple(p.output for p in plants))
    return kalman_filter(
        fit_realization(plants, band, poles),
        names,
        noise_deviations(model, names, noise),
        positive("process_noise", process_noise),
    )


def plants_of(model: Model, input_name: str | None, rate: float, coupling: str, *, sensor: bool) -> list[Plant]:
    """Return the plants from one input of a model to each output that depends on the input.

    Arguments are those of :func:`plant_of`. Raise ModelError if the model is unstable, or if no output depends on the
    input.
    """
    check_model(model)
    plants = [plant_of(model, o, input_name, rate, coupling, sensor=sensor) for o in model.outputs]
    plants[0].check_stable()
    controllable_plants = [p for p in plants if p.has_response()]
    if not controllable_plants:
        raise ModelError(f"{plants[0].input} affects no output of this model; choose another input")
    return controllable_plants


def kalman_filter(
    realization: Realization, measured: tuple[str, ...], noise: tuple[float, ...], process_noise: float
) -> Observer:
    """Return the steady-state Kalman filter of a realization.

    `measured`, `noise` and `process_noise` are those of :class:`Observer`. Raise ModelError if the measured outputs do
    not make all states observable, so that the filter is unstable.
    """
    bare = Observer(realization, measured, noise, process_noise, np.zeros((0, 0)), {})
    a, b, c = bare.matrices
    step = 1.0 / realization.rate
    # The input also has white process noise, whose standard deviation is that of its random walk after one second.
    process_covariance = np.zeros_like(a)
    process_covariance[:-1, :-1] = b[:-1] @ b[:-1].T * process_noise**2
    process_covariance[-1, -1] = process_noise**2 * step
    measurement_covariance = np.diag(np.square(noise))
    with catch_numerical_errors(f"no observer from {', '.join(measured)}", "measure more, or narrow the band"):
        _, error_covariance, _ = python_control().dlqe(a, np.eye(len(a)), c, process_covariance, measurement_covariance)
        gain = np.linalg.solve(c @ error_covariance @ c.T + measurement_covariance, c @ error_covariance).T
        posterior = error_covariance - gain @ c @ error_covariance
        good = bool(np.isfinite(gain).all())
    if not good or np.max(np.abs(np.linalg.eigvals(a - a @ gain @ c))) >= 1.0:
        raise ModelError(
            f"no observer from {', '.join(measured)} is stable: not all states are observable; measure more outputs"
        )
    variances = np.einsum("ij,jk,ik->i", realization.c, posterior[:-1, :-1], realization.c)
    deviations = np.sqrt(np.maximum(variances, 0.0)).tolist()
    return Observer(
        realization, measured, noise, process_noise, gain, dict(zip(realization.outputs, deviations, strict=True))
    )


def noise_deviations(model: Model, measured: tuple[str, ...], noise: Mapping[str, float] | None) -> tuple[float, ...]:
    """Return the noise standard deviation of each measured output: the given one, or that of the fit.

    Raise ModelError if one is unknown or invalid.
    """
    if noise is not None and not isinstance(noise, Mapping):
        raise ModelError(f"{setting('noise')} {short_repr(noise)} is not a mapping; give standard deviations by output")
    for name in noise or {}:
        if name not in measured:
            suggestion = nearest(name, measured) if isinstance(name, str) else ""
            raise ModelError(
                f"{setting('noise')} {{{short_repr(name)}: …}}: this is not a measured output{suggestion}; they are "
                f"{', '.join(measured)}"
            )
    free = None if model.estimate is None else model.estimate.free_parameters
    noise_of_fit = {} if free is None else dict(free.noise)
    out = []
    for name in measured:
        value = (noise or {}).get(name, noise_of_fit.get(name))
        if value is None:
            raise ModelError(
                f"the noise of {name} is not known, because the model file has no residuals of its fit; give its "
                "standard "
                f"deviation in {parameter('noise', {name: 0.001})}"
            )
        out.append(positive(f"noise of {name}", value))
    return tuple(out)


#: Maximum sensitivity of an acceptable design. It implies a phase margin of at least 19 degrees and a gain margin of at
#: least 1.5.
MAX_SENSITIVITY = 3.0
#: Number of frequencies of a Nyquist curve, and its lowest frequency relative to the lower end of the band.
CURVE_POINTS, BAND_EXTENSION = 2500, 1e-2
#: Distance from z = 1 below which a pole of the controller counts as its integrator.
INTEGRATOR_TOLERANCE = 1e-7


@check_arguments
class Lqg:
    """Discrete-time LQG controller: an observer with state feedback.

    Call it once per sample with the measured outputs and the reference; it returns the command. The observer starts in
    the equilibrium that corresponds to the first measured outputs. The observer uses the saturated commands, which
    avoids windup.

    Parameters
    ----------
    observer
        Observer of the states and of the input disturbance.
    feedback
        State feedback gain, shape (1, states).
    tracked
        Name of the output that follows the reference.
    limit
        Magnitude at which the command saturates.

    Raises
    ------
    ModelError
        If the feedback has the wrong shape or is not finite, the limit is not positive, or the output has no
        equilibrium. Also, on a call of the controller, if the command is not finite.
    """

    def __init__(self, observer: Observer, feedback: ArrayLike, tracked: str, *, limit: float = math.inf) -> None:
        self.observer, self.tracked, self.limit = observer, tracked, check_limit(limit)
        realization = observer.realization
        self.rate = realization.rate
        gains = as_floats("feedback", feedback).reshape(1, -1).copy()
        if gains.shape[1] != realization.state_count or not np.isfinite(gains).all():
            raise ModelError(
                f"feedback is not finite or has {gains.shape[1]} values; give {realization.state_count}, one per state"
            )
        self.feedback = gains
        self._a, self._b, self._c = observer.matrices
        self._gains = np.append(gains, [[1.0]], axis=1)
        equilibrium_state = _equilibrium(realization, tracked)
        #: Gain of the reference in the command, with which the output equals the reference in steady state.
        self.ahead = float(gains[0] @ equilibrium_state[:-1] + equilibrium_state[-1])
        self.reset()

    @property
    def state_count(self) -> int:
        """Number of states of the controller, including the last command."""
        return len(self._a) + 1

    @property
    def estimate(self) -> dict[str, float]:
        """Predictions of all outputs at the next sample, and prediction of the input disturbance, by name."""
        states = np.zeros(len(self._a)) if self._states is None else self._states
        estimates = (self.observer.realization.c @ states[:-1]).tolist()
        return dict(zip(self.observer.realization.outputs, estimates, strict=True)) | {UNKNOWN_INPUT: float(states[-1])}

    def reset(self) -> None:
        """Reset all states, so that the next sample is the first one."""
        self._states: Floats | None = None
        self._applied = 0.0

    def __call__(self, measured: Sequence[float] | Floats, reference: float) -> float:
        """Return the command from the measured outputs of one sample and the reference of the tracked output.

        The measured outputs are in the sequence of `observer.measured`. Raise ModelError if the command is not finite.
        """
        y = _measured_values(self.observer, measured)
        with np.errstate(over="ignore", invalid="ignore"):
            if self._states is None:
                self._states = np.append(self.observer.equilibrium_state(y), 0.0)
            corrected = self._states + self.observer.gain @ (y - self._c @ self._states)
            self._states = self._a @ corrected + self._b[:, 0] * self._applied
            command = self.ahead * reference - float(self._gains[0] @ self._states)
        if not math.isfinite(command):
            raise ModelError(
                f"the command is {command}: a measurement, the reference or a state is not finite; call reset()"
            )
        self._applied = min(max(command, -self.limit), self.limit)
        return self._applied

    def response(self, w: Floats | Complex) -> tuple[Complex, Complex]:
        """Return the frequency responses of the unsaturated command to measured outputs and reference at w [rad/s].

        The response to the measured outputs has shape (measured outputs, W), the response to the reference (W,).
        """
        z = np.exp(1j * check_vector("w", as_complex("w", w)) / self.rate)
        a, into = self._transition_matrices()
        system = z[:, None, None] * np.eye(len(a)) - a
        input_columns = np.broadcast_to(np.column_stack([into, self._b]), (z.size, len(a), into.shape[1] + 1))
        responses = (self._gains @ np.linalg.solve(system, input_columns))[:, 0, :]
        return np.asarray(-z[None] * responses[:, :-1].T), np.asarray(self.ahead * (1.0 - responses[:, -1]))

    def poles(self) -> Complex:
        """Return the poles of the controller in the z-plane."""
        return np.asarray(np.linalg.eigvals(self._transition_matrices()[0]))

    def _transition_matrices(self) -> tuple[Floats, Floats]:
        """Return the state matrix of the controller, and its input matrix from the measured outputs."""
        into = self._a @ self.observer.gain
        return self._a - self._b @ self._gains - into @ self._c, into

    def to_dict(self) -> dict[str, Any]:
        """Return signals, matrices and approximation errors of the controller as a dictionary for JSON."""
        realization = self.observer.realization
        return {
            "kind": "lqg",
            "rate": self.rate,
            "limit": self.limit if math.isfinite(self.limit) else None,
            "input": realization.input,
            "tracked": self.tracked,
            "measured": list(self.observer.measured),
            "state_count": self.state_count,
            "gain_error_db": max(realization.gain_error.values()),
            "phase_error_degrees": max(realization.phase_error.values()),
            "a": realization.a.tolist(),
            "b": realization.b.tolist(),
            "c": realization.c.tolist(),
            "correction": self.observer.gain.tolist(),
            "feedback": self.feedback.tolist(),
        }

    def __str__(self) -> str:
        return (
            f"LQG at {self.rate:g} Hz with {self.state_count} states, from "
            f"{', '.join(self.observer.measured)} to {self.observer.realization.input}, {self.tracked} as asked for"
        )


@check_arguments
@dataclass(frozen=True)
class LqgDesign(LoopDesign):
    """Result of :func:`lqg`: the controller, and the stability margins of its loop with the exact model.

    Parameters
    ----------
    controller
        Designed discrete-time controller.
    realization
        Integer-order realization of the model, and its approximation error.
    nominal
        Stability margins of the loop, opened at the plant input, at the nominal parameters of the model.
    samples
        Stability margins at parameters drawn from their covariance; empty if the model has no covariance.
    plants
        Plants from the manipulated input to all outputs that depend on it.
    """

    controller: Lqg
    realization: Realization
    nominal: Margins
    samples: tuple[Margins, ...]
    plants: tuple[Plant, ...]

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]."""
        return self.realization.rate

    def controller_response(self, w: Floats | Complex) -> tuple[tuple[str, ...], Complex, Complex]:
        """Return the names of the measured outputs, and two frequency responses of the controller at w [rad/s].

        The first is the response of the command to the negative of each measured output, shape (outputs, W). The second
        is the response of the command to the reference, shape (W,).
        """
        feedback_response, reference_response = self.controller.response(w)
        return self.controller.observer.measured, -feedback_response, reference_response

    def with_limit(self, limit: float) -> Lqg:
        """Return a new controller of this design whose command saturates at the magnitude `limit`."""
        return Lqg(self.controller.observer, self.controller.feedback, self.controller.tracked, limit=limit)

    def to_dict(self) -> dict[str, Any]:
        """Return design and margins as a dictionary for JSON, without the matrices."""
        realization = self.realization
        return {
            "design": "lqg",
            "rate": self.rate,
            "input": realization.input,
            "tracked": self.controller.tracked,
            "measured": list(self.controller.observer.measured),
            "state_count": realization.state_count,
            "band": list(realization.band),
            "gain_error_db": realization.gain_error,
            "phase_error_degrees": realization.phase_error,
            **self._margins(),
        }

    def __str__(self) -> str:
        lines = [str(self.controller), f"realised by {self.realization}", *self._margin_lines()]
        return "\n".join(lines)


@check_arguments
def lqg(
    model: Model,
    *,
    max_deviation: Mapping[str, float],
    max_input: float,
    input: str | None = None,
    output: str | None = None,
    measured: Sequence[str] | None = None,
    noise: Mapping[str, float] | None = None,
    process_noise: float | None = None,
    rate: float = 500.0,
    limit: float = math.inf,
    band: tuple[float, float] | None = None,
    poles: int | None = None,
    samples: int = 100,
    seed: int = 0,
    coupling: Literal["simulated", "measured"] = "simulated",
    sensor: bool = False,
) -> LqgDesign:
    """Design an LQG controller with integral action on a low-order realization of a model of any orders.

    Parameters
    ----------
    model
        Linear model that is stable except for an integrator.
    max_deviation : mapping
        Maximum acceptable deviation of each output, or of sums of outputs such as ``"theta11 + theta12"`` (a tip).
        Bryson's rule gives the weights of the cost function from these values.
    max_input
        Maximum acceptable magnitude of the input, in its unit.
    input, output : str, optional
        Manipulated input, and output that follows the reference. The input may be omitted for a model with one input.
        The default output is the first with an integrator, or else the first.
    measured, noise, rate, band, poles, coupling, sensor
        As for :func:`observer`.
    process_noise
        Process noise intensity; see :func:`observer`. The default is a fifth of `max_input`. A larger value gives a
        faster observer and more noise in the command.
    limit
        Magnitude at which the command saturates.
    samples, seed
        Number of parameter vectors drawn from the covariance of the model, 0 to 10000, and seed of the drawing.

    Returns
    -------
    LqgDesign
        Design with a discrete-time `controller`. Its margins are computed with the exact frequency response of the
        model.

    Raises
    ------
    ModelError
        If the model is unstable or has no accurate low-order realization, a name is unknown, or an argument is invalid.
        Also if states are not observable, an integrating output has no maximum deviation, or python-control is not
        installed. Also if the maximum sensitivity with the exact model exceeds 3, nominally or for more than 5 % of the
        parameter samples.

    Notes
    -----
    python-control solves the Riccati equations for the sampled realization, which includes one sample of delay. LQG
    loops have no guaranteed margins (Doyle 1978, doi:10.1109/TAC.1978.1101812). Stability is therefore tested by the
    argument principle on the exact response.
    """
    count, start = check_samples(samples, seed)
    max_input_value = positive("max_input", max_input)
    process_noise_value = 0.2 * max_input_value if process_noise is None else positive("process_noise", process_noise)
    plants = plants_of(model, input, rate, coupling, sensor=sensor)
    names = tuple(p.output for p in plants)
    measured_names = select_outputs("measured", measured, names)
    weights = _weights(max_deviation, names)
    tracked = _tracked_output(output, plants)
    realization = fit_realization(plants, band, poles)
    kalman = kalman_filter(
        realization, measured_names, noise_deviations(model, measured_names, noise), process_noise_value
    )
    c = realization.c
    cost = sum(np.outer(row @ c, row @ c) / max_value**2 for row, max_value in weights)
    no = "no state feedback stabilizes the model; state a maximum deviation of every output that integrates"
    with catch_numerical_errors(*no.split("; ")):
        gains, _, closed_loop_poles = python_control().dlqr(
            realization.a, realization.b, cost, np.eye(1) / max_input_value**2
        )
    if np.max(np.abs(closed_loop_poles)) >= 1.0 - INTEGRATOR_TOLERANCE:
        raise ModelError(no)
    controller = Lqg(kalman, gains, tracked, limit=limit)
    w = np.geomspace(BAND_EXTENSION * realization.band[0], 0.999 * math.pi * plants[0].rate, CURVE_POINTS)
    acting = -controller.response(w)[0]
    poles_of_it = controller.poles()
    is_integrator = np.abs(poles_of_it - 1.0) < INTEGRATOR_TOLERANCE
    integral, unstable_poles = int(np.sum(is_integrator)), int(np.sum((np.abs(poles_of_it) > 1.0) & ~is_integrator))
    measured_plants = [plants[names.index(o)] for o in kalman.measured]

    def loop_margins(which: Model) -> Margins:
        sampled_plants = [replace(p, model=which) for p in measured_plants]
        loop = np.sum(acting * np.array([p.response(w) for p in sampled_plants]), axis=0)
        order = max(p.integral_order() for p in sampled_plants)
        return margins_of(
            loop, w, max(order, 0.0) + integral, sampled_plants[0].count_unstable_poles() + unstable_poles
        )

    nominal = loop_margins(model)
    if not (nominal.stable and nominal.sensitivity <= MAX_SENSITIVITY):
        raise ModelError(
            f"the loop with the exact response of the model is unstable or not robust ({nominal}): LQG loops have no "
            "guaranteed margins; make max_input smaller, process_noise larger or the noise smaller, or allow for "
            "larger deviations"
        )
    margins = tuple(loop_margins(plant_sample.model) for plant_sample in plants[0].samples(count, start))
    failures = [m for m in margins if not (m.stable and m.sensitivity <= MAX_SENSITIVITY)]
    if len(failures) > MAX_FAILED_SAMPLE_FRACTION * len(margins):
        raise ModelError(
            f"the confidence intervals are too wide to design on: in {len(failures)} of {len(margins)} samples of the "
            f"parameters the loop is not stable or has a largest sensitivity above {MAX_SENSITIVITY:g}; "
            f"{least_certain_parameter(model)}; "
            "identify from a longer or richer run (ftlm design-input designs one), or make max_input smaller"
        )
    return LqgDesign(controller, realization, nominal, margins, tuple(plants))


def _tracked_output(output: str | None, plants: Sequence[Plant]) -> str:
    """Return the name of the output that follows the reference; raise ModelError if `output` is unknown.

    By default it is the first output with an integrator, or else the first output.
    """
    names = [p.output for p in plants]
    if output is not None:
        return select_outputs("output", [output], tuple(names))[0]
    return next((p.output for p in plants if p.integral_order() > 0.5), names[0])


def _weights(max_deviation: Mapping[str, float], names: tuple[str, ...]) -> list[tuple[Floats, float]]:
    """Return (coefficients of the outputs, maximum acceptable deviation) for each key of `max_deviation`.

    A key is an output or a sum of outputs. Raise ModelError if a key or a deviation is invalid.
    """
    if not isinstance(max_deviation, Mapping) or not max_deviation:
        raise ModelError(
            f"{setting('max_deviation')} {short_repr(max_deviation)} is not a mapping from outputs, or sums of them, "
            f"to deviations; give such as {{{names[0]!r}: 0.01}}"
        )
    return [
        (sum_row("max_deviation", text, names), positive(f"max_deviation[{short_repr(text)}]", max_value))
        for text, max_value in max_deviation.items()
    ]


def _equilibrium(realization: Realization, tracked: str) -> Floats:
    """Return states and input in the equilibrium with tracked output 1, as one vector (states + 1,).

    Raise ModelError if the output is unknown, or if its steady-state gain is zero.
    """
    if tracked not in realization.outputs:
        raise ModelError(
            f"tracked = {short_repr(tracked)} is not an output; give one of {', '.join(realization.outputs)}"
        )
    state_count = realization.state_count
    matrix = np.zeros((state_count + 1, state_count + 1))
    matrix[:state_count, :state_count] = realization.a - np.eye(state_count)
    matrix[:state_count, state_count:] = realization.b
    matrix[state_count, :state_count] = realization.c[realization.outputs.index(tracked)]
    try:
        equilibrium = np.linalg.solve(matrix, np.eye(state_count + 1)[-1])
    except np.linalg.LinAlgError:
        raise ModelError(
            f"{tracked} cannot follow a constant reference, because its steady-state gain from {realization.input} is "
            "0; choose another output"
        ) from None
    return np.asarray(equilibrium, dtype=np.float64)
