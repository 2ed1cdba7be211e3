"""What is not measured, from what is: a Kalman filter on the poles of an identified model, one sample at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.checks import nearest, shown
from ftlm.base.errors import DataError, ModelError
from ftlm.control.margins import Plant
from ftlm.control.names import names_of, positive
from ftlm.control.pid import plant_of
from ftlm.control.realisation import Realisation, python_control, realised, solving
from ftlm.data.run import Run
from ftlm.data.solved import Solved, check_solved

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
            kept @ a, np.column_stack([kept @ b, self.gain]), np.eye(len(a)),
            np.zeros((len(a), 1 + len(self.measured))), 1.0 / self.realisation.rate,
        )  # fmt: skip
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
    model: Solved, *, input: str | None = None, measured: Sequence[str] | None = None,
    noise: Mapping[str, float] | None = None, drift: float, rate: float = 500.0,
    band: tuple[float, float] | None = None, poles: int | None = None,
    coupling: Literal["simulated", "measured"] = "simulated", sensor: bool = False,
) -> Observer:  # fmt: skip
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
        See :func:`ftlm.frequency.frequency_response`; by default what is measured passed no sensor filter.

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
