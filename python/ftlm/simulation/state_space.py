"""Simulation of models with integer orders by exact discretization in state space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ftlm import _core
from ftlm.data.run import Run
from ftlm.data.sampling import ZERO_ORDER_HOLD
from ftlm.model.model import Model
from ftlm.simulation.discretization import (
    MIN_SIGNAL_PEAK,
    apply_input_nonlinearity,
    check_early_input,
    equation_tuple,
)
from ftlm.simulation.initial_conditions import resolve_initial_conditions
from ftlm.simulation.output_samples import (
    ORDER_TOLERANCE,
    OutputSamples,
    Terms,
    initial_names,
    measured_samples,
    named_terms,
)
from ftlm.structure.structure import History
from ftlm.utils.validation import Floats


@dataclass(frozen=True)
class StateSpace:
    """Model with integer orders on a uniformly sampled run without missing input samples.

    Parameters
    ----------
    model, run
        Model, and run after input nonlinearities.
    at_rest
        Whether delayed inputs are zero before the run; otherwise they have their first value.
    """

    model: Model
    run: Run
    at_rest: bool

    @classmethod
    def of(cls, model: Model, run: Run) -> StateSpace | None:
        """Build for a run. None if an order is not an integer, or if the run needs the pulse grid."""
        structure = model.structure
        orders = [o for e in model.equations for o in (e.order, *(t.order for t in e.terms))]
        if structure.has_friction or structure.sensor_filter is not None or structure.free_inputs:
            return None
        if run.sample_times is not None or any(name not in run for name in structure.signals):
            return None
        if not _are_integers([o.constant for o in orders]):
            return None
        run, drivers = apply_input_nonlinearity(run, structure), _drivers(model)
        if any(structure.delay.get(name) and name not in run.inputs for name in drivers):
            return None
        for name, delay in structure.delay.items():
            check_early_input(run, name, delay)
        for name in structure.signals:
            # The peak of a driver with a missing sample is NaN, which is in neither range.
            peak = (np.max if name in drivers else np.fmax.reduce)(np.abs(run[name]))
            if not (peak == 0.0 or peak >= MIN_SIGNAL_PEAK):
                return None
        return cls(model, run, not structure.delay or resolve_initial_conditions(run, structure) == "rest")

    def respond(self, terms: Terms, *, driven: bool = True) -> Floats | None:
        """Return the output samples, shape (outputs, N), with these initial terms.

        None if the core refuses the model. ``driven`` is whether the inputs act.
        """
        equations, outputs = self.model.equations, self.model.outputs
        if self.model.structure.coupling == "simulated":
            return self._respond(range(len(equations)), terms, driven)
        rows = np.zeros((len(outputs), self.run.length))
        for i, output in enumerate(outputs):
            if driven or terms.get(output):
                row = self._respond([i], terms, driven)
                if row is None:
                    return None
                rows[i] = row[0]
        return rows

    def _respond(self, numbers: Sequence[int], terms: Terms, driven: bool) -> Floats | None:
        """Simulate some equations together, with all other signals as inputs."""
        run, signals = self.run, self.model.structure.signals
        equations = [self.model.equations[i] for i in numbers]
        own = [e.output for e in equations]
        read = {t.signal for e in equations for t in e.terms} - set(own)
        intersample, inputs = run.intersample, []
        for i, name in enumerate(signals):
            if driven and name in read:
                samples = run[name]
                delay = self.model.structure.delay.get(name, 0.0) / run.step
                before = 0.0 if self.at_rest else float(samples[0])
                inputs.append((i, samples, intersample.get(name) == ZERO_ORDER_HOLD, delay, before))
        return _core.state_space_respond(
            [equation_tuple(e, signals) for e in equations],
            [s in run.inputs for s in signals],
            inputs,
            [sorted(terms.get(o, {}).items()) for o in own],
            run.step,
            run.length,
        )


def _are_integers(orders: Sequence[float]) -> bool:
    """Whether all orders or exponents are integers; differences of two of them are so within the core's tolerance."""
    return all(abs(order - round(order)) <= 0.5 * ORDER_TOLERANCE for order in orders)


def _drivers(model: Model) -> list[str]:
    """Return the signals that are inputs of the equations."""
    simulated = model.outputs if model.structure.coupling == "simulated" else ()
    read = (t.signal for e in model.equations for t in e.terms if t.signal not in (e.output, *simulated))
    return list(dict.fromkeys(read))


def simulate_state_space(model: Model, run: Run, initial: Terms | None) -> OutputSamples | None:
    """Simulate samples exactly; None if the model has a fractional order or if exact discretization does not apply.

    It applies to uniform samples without a sensor filter or friction.

    Parameters
    ----------
    initial
        Coefficients of initial terms by output and exponent. None: fit them to the measured outputs.
    """
    system = StateSpace.of(model, run)
    if system is None:
        return None
    none: dict[str, dict[float, float]] = {o: {} for o in model.outputs}
    if initial is None:
        start = resolve_initial_conditions(run, model.structure)
        if isinstance(start, History) or model.structure.offset == "auto":
            return None
        model = replace(model, structure=replace(model.structure, initial=start))
        names = initial_names(model, start)
        terms = none
    else:
        names = []
        terms = {o: dict(initial.get(o, {})) for o in model.outputs}
    exponents = [e for _, e in names] + [e for powers in terms.values() for e in powers]
    if not _are_integers(exponents) or any(e < 0.0 for e in exponents):
        return None
    samples = system.respond(terms)
    if samples is None:
        return None
    if (names or (initial is None and model.structure.offset == "level")) and np.all(np.isfinite(samples)):
        columns = [system.respond({**none, output: {power: 1.0}}, driven=False) for output, power in names]
        known = [c for c in columns if c is not None]
        if len(known) < len(columns):
            return None
        units = [(model.outputs.index(output), power) for output, power in names]
        level, measured = model.structure.offset == "level", measured_samples(model, run, 1)
        samples, found = _core.fit_initial_terms(measured, samples, units, known, level)
        terms = named_terms(model, found)
    return OutputSamples(samples, terms, 1, np.zeros(len(model.outputs)))
