"""Free runs: a model's outputs from a run's inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from ftlm import _core
from ftlm.data.run import Run
from ftlm.errors import ConvergenceError, DataError, ModelError
from ftlm.model.model import Solved, check_solved
from ftlm.simulation.discretization import MAX_M, Record, acting, equation_tuple, records, sensor_series
from ftlm.simulation.step_refinement import refined
from ftlm.structure.structure import check_initial
from ftlm.utils.validation import Floats, real_number


def compared(runs: Sequence[Run], model: Solved, m: int) -> list[Record]:
    """Records that free runs are compared with: their outputs are the measured ones, filtered as those of a free run.

    Free runs follow from their inputs, then pass the sensor filter where outputs were measured through it; where a
    filtered signal drives one, all signals are taken behind the filter.
    """
    return records(runs, model.structure, m, filtered=model.structure.behind_filter)


def respond(model: Solved, rec: Record) -> tuple[dict[str, Floats], dict[str, dict[float, float]]]:
    """Pulse means of the model's outputs on one of its :func:`compared` records, and initial terms by exponent.

    The initial terms are those that bring the response closest to the measured outputs.
    """
    structure = model.structure
    coupled = structure.coupling == "simulated"
    terms = rec.start
    inputs = list(rec.inputs)
    equations = [equation_tuple(e, rec.signals) for e in model.equations]
    series = sensor_series(structure, rec.m, rec.step) if rec.sensor is None else None
    responses: dict[str, Floats] = {}
    initial: dict[str, dict[float, float]] = {}

    def keep(names: tuple[str, ...], response: tuple[Floats, list[list[float]], list[list[float]]]) -> None:
        outputs, exponents, values = response
        for i, name in enumerate(names):
            responses[name] = outputs[i]
            initial[name] = dict(zip(exponents[i], values[i], strict=True))

    def behind(names: tuple[str, ...]) -> tuple[Floats, list[bool]] | None:
        return None if series is None else (series, [structure.measured_through(n) for n in names])

    if coupled:
        keep(model.outputs, _core.respond_with_initial(rec.core(), equations, inputs, terms, behind(model.outputs)))
    else:
        for name, item in zip(model.outputs, equations, strict=True):
            keep((name,), _core.respond_with_initial(rec.core(), [item], inputs, terms, behind((name,))))
    return responses, initial


def simulate(
    model: Solved,
    run: Run,
    *,
    tolerance: float = 1e-6,
    initial: Mapping[str, Mapping[float, float]] | None = None,
    largest_m: int = 1 << 22,
) -> Run:
    """Point samples of a model's outputs on a run's inputs, at the run's instants.

    The grid is the record's own, refined under the inputs' inter-sample behaviour (a held command stays exact) and
    extrapolated in the step (its powers 2, 3 and 4), until halving the step moves no output by more than ``tolerance``
    of its largest value. A sample belongs to its instant after the input of its row has acted: a term of the equation's
    own order (direct feed-through) shows at once, everything else is continuous there.

    Parameters
    ----------
    model
        The model. With measured coupling the run must hold the measured other outputs.
    run
        The run; measured values of the modelled outputs are not used.
    tolerance
        Relative change at which refinement ends.
    initial
        Coefficients of initial terms, by output and exponent; default at rest. Those of another record mean nothing.
        Behind a sensor filter -1 and -2 are an impulse and its derivative, which stand for the filter's own state.
        An offset c of the equation is the exponent alpha with the coefficient c / Gamma(alpha + 1); default none.
    largest_m
        Most pulses; beyond it the change that is left is an error.

    Returns
    -------
    Run
        The inputs as they are and the simulated outputs, with the run's step and length. Outputs that are measured
        through the sensor filter are filtered; all of them are where a filtered signal drives the run.

    Raises
    ------
    DataError
        A signal that the run does not have.
    ModelError
        An equation that cannot be solved for its output, or a tolerance that is not positive.
    ConvergenceError
        An unstable model (with the first index that is not finite), or a response that still moves at ``largest_m``.
    """
    check_solved(model)
    if not isinstance(run, Run):
        raise DataError(f"run is {type(run).__name__}, not a Run; use ftlm.load or Run.from_arrays")
    sensor = model.structure.sensor_filter
    impulses = {-1.0 - k for k in range(sensor.relative_degree if sensor is not None else 0)}
    for name, terms in (initial or {}).items():
        if name not in model.outputs:
            raise ModelError(f"initial terms of {name!r}, which is no output of the model: {', '.join(model.outputs)}")
        check_initial([e for e in terms if not (model.structure.held_back(name) and e in impulses)])
    if not real_number("tolerance", tolerance) > 0:
        raise ModelError(f"tolerance = {tolerance} is not positive; the default is 1e-6")
    own = run.length - 1
    largest_m = min(largest_m, MAX_M)
    if own > largest_m:
        raise ModelError(f"run {run.name!r} has {own} intervals, more than {largest_m}; slice it")
    free = refined(model, _completed(run, model), initial or {}, tolerance=tolerance, largest_m=largest_m, on_grid=True)
    for name, samples in zip(model.outputs, free.outputs, strict=True):
        if not np.all(np.isfinite(samples)):
            at = int(np.argmax(~np.isfinite(samples))) * run.step
            raise ConvergenceError(
                f"the free run of {name} leaves the range of numbers {at:.4g} s into run {run.name!r}; "
                "the model is unstable: check its orders and coefficients"
            )
    if not np.all(free.change <= tolerance):
        raise ConvergenceError(
            f"the response of {', '.join(model.outputs)} still moves by more than {tolerance:g} of its size at "
            f"{own * free.refinement} pulses; raise tolerance or largest_m, or check that the model is stable"
        )
    return Run.from_arrays(
        step=run.step,
        inputs={n: run[n] for n in run.inputs},
        outputs={n: free.outputs[i] for i, n in enumerate(model.outputs)},
        units={n: u for n, u in _units(model, run).items() if u},
        intersample=run.intersample,
        name=f"{run.name}, simulated",
    )


def _units(model: Solved, run: Run) -> dict[str, str]:
    """Units of inputs and simulated outputs; where the run or the model does not say, the other may."""
    inputs = {n: run.units[n] or model.units.get(n, "") for n in run.inputs}
    return inputs | {n: model.units.get(n, "") or run.units.get(n, "") for n in model.outputs}


def _completed(run: Run, model: Solved) -> Run:
    """Return the run with zeros for outputs that it lacks: what is simulated need not be there, and is never read."""
    missing = [o for o in model.outputs if o not in run]
    if not missing:
        return run
    read = {s: e.output for e in model.equations for s in e.signals if s != e.output}
    lacking = next((o for o in missing if o in read), None)
    if lacking is not None and model.structure.coupling != "simulated":
        raise DataError(
            f"run {run.name!r} has no signal {lacking!r}, which the equation of {read[lacking]} reads as measured; "
            "give it, or use coupling='simulated'"
        )
    return run.with_outputs({n: np.zeros(run.length) for n in missing})


def explicit_euler(model: Solved, run: Run, *, step: Literal["record"] = "record") -> dict[str, Floats]:
    """Integer-order model stepped by explicit Euler at the run's step from rest, as the paper ran its baseline.

    Parameters
    ----------
    model
        All orders whole; see :func:`ftlm.link_model` for the manual's.
    run
        Its inputs drive the model; the paper's step is 0.002 s.
    step
        Only the record's own.

    Returns
    -------
    dict
        Point samples by output. Not finite where Euler's step is unstable, which for the second stage's hub pole
        (-500 1/s) at 2 ms is nearly the case.

    Raises
    ------
    ModelError
        An order that is not whole.
    """
    if step != "record":
        raise ModelError(f"step = {step!r} is not known; Euler steps at the record's own step: resample the run")
    signals = model.structure.signals
    run = acting(run, model.structure)
    rows = [run[s] if s not in model.outputs else np.zeros(run.length) for s in signals]
    equations = [equation_tuple(e, signals) for e in model.equations]
    inputs = [s not in model.outputs for s in signals]
    outputs = _core.explicit_euler(np.stack(rows), run.step, equations, inputs)
    return dict(zip(model.outputs, outputs, strict=True))
