"""What is not measured, from what is: a Kalman filter on the poles of an identified model, one sample at a time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from ftlm.control.arguments import drawn_from, largest, names_of, positive, sums
from ftlm.control.fractional_pid import BROKEN, known_least, plant_of
from ftlm.control.realization import Realisation, python_control, realised, solving
from ftlm.control.stability_margins import JudgedLoop, Margins, Plant, margins_of
from ftlm.data.run import Run
from ftlm.errors import DataError, ModelError
from ftlm.model.model import Solved, check_solved
from ftlm.utils.validation import Complex, Floats, nearest, shown

#: What an observer calls the unknown part of its input.
UNKNOWN = "unknown input"


@dataclass(frozen=True)
class Observer:
    """A Kalman filter: a model's sampled states and an unknown part of its input, corrected by what is measured.

    Parameters
    ----------
    realisation
        Of the model, all outputs; its error is in it.
    measured
        Outputs that it reads.
    noise
        Standard deviation of each of them.
    drift
        By how much the unknown part of the input walks in a second (standard deviation).
    gain
        Of the correction, shape (states + 1, measured).
    deviations
        Standard deviation of every output's estimate in the steady state, as the model and its noise have it.
    """

    realisation: Realisation
    measured: tuple[str, ...]
    noise: tuple[float, ...]
    drift: float
    gain: Floats
    deviations: dict[str, float]

    @property
    def rows(self) -> Floats:
        """Which states the measured outputs are."""
        return self.realisation.c[[self.realisation.outputs.index(o) for o in self.measured]]

    @property
    def matrices(self) -> tuple[Floats, Floats, Floats]:
        """States and the input's unknown part from sample to sample, what the input does, what is measured."""
        a, b = self.realisation.a, self.realisation.b
        size = len(a)
        whole = np.eye(size + 1)
        whole[:size, :size], whole[:size, size:] = a, b
        return whole, np.vstack([b, [[0.0]]]), np.column_stack([self.rows, np.zeros(len(self.rows))])

    def over(self, run: Run) -> dict[str, Floats]:
        """Estimates along a run from its input and what is measured of it, no sample ahead: of every output, and input.

        The first sample is taken to be at rest where its first measured output that integrates is.

        Raises
        ------
        DataError
            A run without these signals, or with another step.
        """
        names = (self.realisation.input, *self.measured)
        absent = [n for n in names if n not in run.signals]
        if absent:
            raise DataError(f"run {run.name} has no {', '.join(absent)}; the observer reads {', '.join(names)}")
        if abs(run.step * self.realisation.rate - 1.0) > 1e-6:
            raise DataError(
                f"run {run.name} has a step of {run.step:g} s, and the observer one of "
                f"{1.0 / self.realisation.rate:g} s; make it for rate={1.0 / run.step:g}"
            )
        a, b, c = self.matrices
        y = np.array([run[n] for n in self.measured])
        kept = np.eye(len(a)) - self.gain @ c
        start = np.append(self.rest(y[:, 0]), 0.0)
        # From one corrected state to the next: x' = kept (a x + b u) + gain y'.
        library = python_control()
        system = library.ss(
            kept @ a,
            np.column_stack([kept @ b, self.gain]),
            np.eye(len(a)),
            np.zeros((len(a), 1 + len(self.measured))),
            1.0 / self.realisation.rate,
        )
        time = np.arange(y.shape[1]) / self.realisation.rate
        inputs = np.vstack([run[self.realisation.input], np.column_stack([y[:, 1:], y[:, -1:]])])
        states = library.forced_response(system, time, inputs, start).states
        shown = self.realisation.c @ states[:-1]
        return dict(zip(self.realisation.outputs, shown, strict=True)) | {UNKNOWN: states[-1]}

    def rest(self, measured: Floats) -> Floats:
        """States at rest where an integrating output is what is measured; of one that does not, 0."""
        states = np.zeros(self.realisation.states)
        column = self.rows[:, 0]
        if self.realisation.poles[0] == 0 and np.any(column):
            at = int(np.argmax(np.abs(column)))
            states[0] = measured[at] / column[at]
        return states

    def __str__(self) -> str:
        shown = ", ".join(f"{o} to {d:.3g}" for o, d in self.deviations.items())
        return f"observer from {', '.join(self.measured)}: {self.realisation}; estimates {shown} (standard deviation)"


def observer(
    model: Solved,
    *,
    input: str | None = None,
    measured: Sequence[str] | None = None,
    noise: Mapping[str, float] | None = None,
    drift: float,
    rate: float = 500.0,
    band: tuple[float, float] | None = None,
    poles: int | None = None,
    coupling: Literal["simulated", "measured"] = "simulated",
    sensor: bool = False,
) -> Observer:
    """Observe all outputs of a model from some of them: a deflection from a hub, a tip with less noise than its gauge.

    Parameters
    ----------
    model
        A linear model that is stable, an integral apart.
    input : str, optional
        What drives it; where the model has one input alone it needs no name.
    measured : sequence of str, optional
        Outputs that are read; default all.
    noise : mapping, optional
        Standard deviation of the noise of each; default what the fit of the model left.
    drift
        By how much an unknown part of the input may walk in a second, in its unit (standard deviation): friction,
        offsets, what else is not modelled.
    rate, band, poles
        Of the realisation; see :class:`Realisation`. The band is by default a five-thousandth to an eighth of half the
        rate, the number of poles what brings the error below 0.1 dB and 1 degree.
    coupling, sensor
        See :func:`ftlm.analysis.frequency_response`; by default what is measured passed no sensor filter.

    Returns
    -------
    Observer

    Raises
    ------
    ModelError
        A model that is not stable, an output or an input that it does not have, noise that is not known, a model that
        a few poles do not realise, python-control that is not installed.
    """
    plants = plants_of(model, input, rate, coupling, sensor=sensor)
    names = names_of("measured", measured, tuple(p.output for p in plants))
    return filtered(realised(plants, band, poles), names, noises(model, names, noise), positive("drift", drift))


def plants_of(model: Solved, driver: str | None, rate: float, coupling: str, *, sensor: bool) -> list[Plant]:
    """A stable model's outputs from one input; refuses the others."""
    check_solved(model)
    plants = [plant_of(model, o, driver, rate, coupling, sensor=sensor) for o in model.outputs]
    plants[0].check_stable()
    reached = [p for p in plants if p.reached()]
    if not reached:
        raise ModelError(f"{plants[0].input} reaches no output of this model")
    return reached


def filtered(realisation: Realisation, measured: tuple[str, ...], noise: tuple[float, ...], drift: float) -> Observer:
    """The Kalman filter of a realisation."""
    bare = Observer(realisation, measured, noise, drift, np.zeros((0, 0)), {})
    a, b, c = bare.matrices
    step = 1.0 / realisation.rate
    # What is not known of the input: as much again from sample to sample as it walks in a second.
    inside = np.zeros_like(a)
    inside[:-1, :-1] = b[:-1] @ b[:-1].T * drift**2
    inside[-1, -1] = drift**2 * step
    outside = np.diag(np.square(noise))
    with solving(f"no observer from {', '.join(measured)}", "measure more, or narrow the band"):
        _, spread, _ = python_control().dlqe(a, np.eye(len(a)), c, inside, outside)
        gain = np.linalg.solve(c @ spread @ c.T + outside, c @ spread).T
        left = spread - gain @ c @ spread
        good = bool(np.isfinite(gain).all())
    if not good or np.max(np.abs(np.linalg.eigvals(a - a @ gain @ c))) >= 1.0:
        raise ModelError(
            f"no observer from {', '.join(measured)} comes to rest: they do not tell all states; measure more outputs"
        )
    variances = np.einsum("ij,jk,ik->i", realisation.c, left[:-1, :-1], realisation.c)
    deviations = np.sqrt(np.maximum(variances, 0.0)).tolist()
    return Observer(realisation, measured, noise, drift, gain, dict(zip(realisation.outputs, deviations, strict=True)))


def noises(model: Solved, measured: tuple[str, ...], given: Mapping[str, float] | None) -> tuple[float, ...]:
    """Deviation of the noise of each measured output."""
    if given is not None and not isinstance(given, Mapping):
        raise ModelError(f"noise = {shown(given)} is no mapping from outputs to standard deviations")
    for name in given or {}:
        if name not in measured:
            near = nearest(name, measured) if isinstance(name, str) else ""
            raise ModelError(f"noise of {shown(name)} is of nothing that is measured{near}")
    free = msgspec.UNSET if model.estimate is None else model.estimate.free
    left = {} if free is msgspec.UNSET else dict(free.noise)
    out = []
    for name in measured:
        value = (given or {}).get(name, left.get(name))
        if value is None:
            raise ModelError(
                f"the noise of {name} is not known, since this model does not say what its fit left; give its standard "
                f"deviation in noise (--noise {name}=0.001)"
            )
        out.append(positive(f"noise of {name}", value))
    return tuple(out)


#: Largest sensitivity of a loop that is a design: a phase margin of 19 degrees and gain margins of 1.5 at least.
SHARP = 3.0
#: Frequencies of a Nyquist curve, and how far below the band it begins.
POINTS, BELOW = 2500, 1e-2
#: A pole of the controller this close to 1 is its integral.
AT_ONE = 1e-7


class Lqg:
    """An observer and a state feedback, one sample at a time.

    The first sample is safe: the observer begins at rest where the output stands, and what is asked for is answered
    from there. It is told the currents that were cut at the limit, so that nothing winds up.

    Parameters
    ----------
    observer
        What it knows its states from.
    feedback
        Of the states, shape (1, states).
    tracked
        The output that follows the reference.
    limit
        Largest command.

    Raises
    ------
    ModelError
        Feedback of another shape or that is not finite, a limit that is not above 0, an output that cannot be held;
        when it is called, a command that is no number.
    """

    def __init__(self, observer: Observer, feedback: ArrayLike, tracked: str, *, limit: float = math.inf) -> None:
        self.observer, self.tracked, self.limit = observer, tracked, largest(limit)
        realisation = observer.realisation
        self.rate = realisation.rate
        gains = np.array(feedback, dtype=np.float64).reshape(1, -1)
        if gains.shape[1] != realisation.states or not np.isfinite(gains).all():
            raise ModelError(f"feedback is no row of {realisation.states} finite numbers, one a state")
        self.feedback = gains
        self._a, self._b, self._c = observer.matrices
        self._gains = np.append(gains, [[1.0]], axis=1)
        rest = _equilibrium(realisation, tracked)
        #: Of the reference, so that in the end the output is where it is asked for.
        self.ahead = float(gains[0] @ rest[:-1] + rest[-1])
        self.reset()

    @property
    def memory(self) -> int:
        """Numbers that are remembered from one sample to the next."""
        return len(self._a) + 1

    @property
    def estimate(self) -> dict[str, float]:
        """Every output as it is thought to be at the next sample, and the unknown part of the input."""
        states = np.zeros(len(self._a)) if self._states is None else self._states
        shown = (self.observer.realisation.c @ states[:-1]).tolist()
        return dict(zip(self.observer.realisation.outputs, shown, strict=True)) | {UNKNOWN: float(states[-1])}

    def reset(self) -> None:
        """Forgets everything."""
        self._states: Floats | None = None
        self._applied = 0.0

    def __call__(self, measured: Sequence[float] | Floats, reference: float) -> float:
        """The command for what is measured at a sample, in the observer's order, and what is asked for."""
        y = np.asarray(measured, dtype=np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            if self._states is None:
                self._states = np.append(self.observer.rest(y), 0.0)
            corrected = self._states + self.observer.gain @ (y - self._c @ self._states)
            self._states = self._a @ corrected + self._b[:, 0] * self._applied
            command = self.ahead * reference - float(self._gains[0] @ self._states)
        if not math.isfinite(command):
            raise ModelError(
                f"the command is {command}, which no machine takes: what is measured, asked for or held is not finite"
            )
        self._applied = min(max(command, -self.limit), self.limit)
        return self._applied

    def response(self, w: Floats | Complex) -> tuple[Complex, Complex]:
        """Of the command to what is measured, shape (measured, W), and to the reference, (W,), without the limit."""
        z = np.exp(1j * np.asarray(w) / self.rate)
        a, into = self._closed()
        system = z[:, None, None] * np.eye(len(a)) - a
        right = np.broadcast_to(np.column_stack([into, self._b]), (z.size, len(a), into.shape[1] + 1))
        answer = (self._gains @ np.linalg.solve(system, right))[:, 0, :]
        return np.asarray(-z[None] * answer[:, :-1].T), np.asarray(self.ahead * (1.0 - answer[:, -1]))

    def poles(self) -> Complex:
        """Its own, in the plane of z."""
        return np.asarray(np.linalg.eigvals(self._closed()[0]))

    def _closed(self) -> tuple[Floats, Floats]:
        """The controller from sample to sample, and what is measured into it."""
        into = self._a @ self.observer.gain
        return self._a - self._b @ self._gains - into @ self._c, into

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        realisation = self.observer.realisation
        return {
            "kind": "lqg",
            "rate": self.rate,
            "limit": self.limit if math.isfinite(self.limit) else None,
            "input": realisation.input,
            "tracked": self.tracked,
            "measured": list(self.observer.measured),
            "memory": self.memory,
            "gain_error_db": max(realisation.gain_error.values()),
            "phase_error_degrees": max(realisation.phase_error.values()),
            "a": realisation.a.tolist(),
            "b": realisation.b.tolist(),
            "c": realisation.c.tolist(),
            "correction": self.observer.gain.tolist(),
            "feedback": self.feedback.tolist(),
        }

    def __str__(self) -> str:
        return (
            f"LQG at {self.rate:g} Hz with {self.memory} numbers of memory, from "
            f"{', '.join(self.observer.measured)} to {self.observer.realisation.input}, {self.tracked} as asked for"
        )


@dataclass(frozen=True)
class LqgDesign(JudgedLoop):
    """A linear-quadratic controller with the margins of its loop on the exact model.

    Parameters
    ----------
    controller
        What runs.
    realisation
        Of the model, with its error.
    nominal
        Margins at the values of the model's numbers, at the plant's input.
    samples
        Margins at samples of the numbers from their covariance; none where the model has no covariance.
    plants
        The model's outputs as they are measured.
    """

    controller: Lqg
    realisation: Realisation
    nominal: Margins
    samples: tuple[Margins, ...]
    plants: tuple[Plant, ...]

    @property
    def rate(self) -> float:
        """Of the loop [Hz]."""
        return self.realisation.rate

    def acting(self, w: Floats | Complex) -> tuple[tuple[str, ...], Complex, Complex]:
        """Outputs it reads, its response to each of them and to the reference, at frequencies [rad/s]."""
        heard, asked = self.controller.response(w)
        return self.controller.observer.measured, -heard, asked

    def controlled(self, limit: float) -> Lqg:
        """The controller with a limit of its command, as a rig has it."""
        return Lqg(self.controller.observer, self.controller.feedback, self.controller.tracked, limit=limit)

    def to_dict(self) -> dict[str, Any]:
        """For JSON, without the matrices."""
        made = self.realisation
        return {
            "design": "lqg",
            "rate": self.rate,
            "input": made.input,
            "tracked": self.controller.tracked,
            "measured": list(self.controller.observer.measured),
            "states": made.states,
            "band": list(made.band),
            "gain_error_db": made.gain_error,
            "phase_error_degrees": made.phase_error,
            **self._margins(),
        }

    def __str__(self) -> str:
        lines = [str(self.controller), f"realised by {self.realisation}", *self._judged()]
        return "\n".join(lines)


def lqg(
    model: Solved,
    *,
    allowed: Mapping[str, float],
    effort: float,
    input: str | None = None,
    output: str | None = None,
    measured: Sequence[str] | None = None,
    noise: Mapping[str, float] | None = None,
    drift: float | None = None,
    rate: float = 500.0,
    limit: float = math.inf,
    band: tuple[float, float] | None = None,
    poles: int | None = None,
    samples: int = 100,
    seed: int = 0,
    coupling: Literal["simulated", "measured"] = "simulated",
    sensor: bool = False,
) -> LqgDesign:
    """Control a model of any orders from an observer of its states: linear-quadratic, with an integral.

    Parameters
    ----------
    model
        A linear model that is stable, an integral apart.
    allowed : mapping
        Deviations of outputs, or of sums such as ``"theta11 + theta12"`` (a tip), that are as dear as `effort`.
    effort
        Of the input, in its unit.
    input, output : str, optional
        What is controlled with, and the output that follows the reference: default the one that integrates, or the
        first. Where the model has one input alone it needs no name.
    measured, noise, rate, band, poles, coupling, sensor
        See :func:`observer`.
    drift
        By how much an unknown part of the input may walk in a second; default a fifth of `effort`. The larger, the
        faster is the observer, and the more of the noise is in the command.
    limit
        Largest command.
    samples, seed
        Of the model's numbers, from their covariance, 0 to 10000.

    Returns
    -------
    LqgDesign
        Its `controller` runs; margins are those of the controller as it runs on the exact response of the model.

    Raises
    ------
    ModelError
        As :func:`observer`; a loop whose largest sensitivity on the exact model is above 3, intervals so wide that it
        is in more than a twentieth of their samples.

    Notes
    -----
    The riccati equations are python-control's, on the sampled realisation; a sample of delay is counted. Such loops
    have no guaranteed margins: Doyle (1978), doi:10.1109/TAC.1978.1101812. So they are judged by the argument principle
    on the exact response.
    """
    count, start = drawn_from(samples, seed)
    dear = positive("effort", effort)
    walks = 0.2 * dear if drift is None else positive("drift", drift)
    plants = plants_of(model, input, rate, coupling, sensor=sensor)
    names = tuple(p.output for p in plants)
    read = names_of("measured", measured, names)
    weights = _weights(allowed, names)
    tracked = _tracked(output, plants)
    realisation = realised(plants, band, poles)
    seen = filtered(realisation, read, noises(model, read, noise), walks)
    c = realisation.c
    cost = sum(np.outer(row @ c, row @ c) / size**2 for row, size in weights)
    no = "no state feedback brings the model to rest; allow for deviations of every output that integrates"
    with solving(*no.split("; ")):
        gains, _, own = python_control().dlqr(realisation.a, realisation.b, cost, np.eye(1) / dear**2)
    if np.max(np.abs(own)) >= 1.0 - AT_ONE:
        raise ModelError(no)
    controller = Lqg(seen, gains, tracked, limit=limit)
    w = np.geomspace(BELOW * realisation.band[0], 0.999 * math.pi * plants[0].rate, POINTS)
    acting = -controller.response(w)[0]
    poles_of_it = controller.poles()
    at_one = np.abs(poles_of_it - 1.0) < AT_ONE
    integral, grows = int(np.sum(at_one)), int(np.sum((np.abs(poles_of_it) > 1.0) & ~at_one))
    heard = [plants[names.index(o)] for o in seen.measured]

    def judged(which: Solved) -> Margins:
        parts = [replace(p, model=which) for p in heard]
        loop = np.sum(acting * np.array([p.response(w) for p in parts]), axis=0)
        order = max(p.integrates() for p in parts)
        return margins_of(loop, w, max(order, 0.0) + integral, parts[0].grows() + grows)

    nominal = judged(model)
    if not (nominal.stable and nominal.sensitivity <= SHARP):
        raise ModelError(
            f"the loop is no design on the exact response of the model ({nominal}): such loops have no guaranteed "
            "margins; make effort smaller, drift larger or the noise smaller, or allow for larger deviations"
        )
    margins = tuple(judged(one.model) for one in plants[0].samples(count, start))
    broken = [m for m in margins if not (m.stable and m.sensitivity <= SHARP)]
    if len(broken) > BROKEN * len(margins):
        raise ModelError(
            f"the intervals are too wide to design on: in {len(broken)} of {len(margins)} samples of the model's "
            f"numbers the loop is not stable or has a largest sensitivity above {SHARP:g}; {known_least(model)}; "
            "identify from a longer or richer run (ftlm design-input lays it out), or make effort smaller"
        )
    return LqgDesign(controller, realisation, nominal, margins, tuple(plants))


def _tracked(output: str | None, plants: Sequence[Plant]) -> str:
    """The output that follows the reference."""
    names = [p.output for p in plants]
    if output is not None:
        return names_of("output", [output], tuple(names))[0]
    return next((p.output for p in plants if p.integrates() > 0.5), names[0])


def _weights(allowed: Mapping[str, float], names: tuple[str, ...]) -> list[tuple[Floats, float]]:
    """Rows of outputs that are summed up, and the deviations that are allowed for."""
    if not isinstance(allowed, Mapping) or not allowed:
        raise ModelError(
            f"allowed = {shown(allowed)} is no mapping from outputs, or sums of them, to deviations; give such as "
            f"{{{names[0]!r}: 0.01}}"
        )
    return [(sums("allowed", text, names), positive(f"allowed[{shown(text)}]", size)) for text, size in allowed.items()]


def _equilibrium(realisation: Realisation, tracked: str) -> Floats:
    """States and input at rest with the tracked output at 1."""
    if tracked not in realisation.outputs:
        raise ModelError(f"tracked = {shown(tracked)} is not one of the outputs {', '.join(realisation.outputs)}")
    size = realisation.states
    matrix = np.zeros((size + 1, size + 1))
    matrix[:size, :size] = realisation.a - np.eye(size)
    matrix[:size, size:] = realisation.b
    matrix[size, :size] = realisation.c[realisation.outputs.index(tracked)]
    try:
        found = np.linalg.solve(matrix, np.eye(size + 1)[-1])
    except np.linalg.LinAlgError:
        raise ModelError(f"{tracked} cannot be held at a value by {realisation.input}: its steady gain is 0") from None
    return np.asarray(found, dtype=np.float64)
