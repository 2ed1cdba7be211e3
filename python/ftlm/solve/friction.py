"""Free runs of bodies some of which may stick, and what a run of them starts with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ftlm import _core
from ftlm.base.arrays import Floats
from ftlm.base.errors import ModelError
from ftlm.data.equations import Equation, Friction
from ftlm.data.run import Run
from ftlm.data.solved import Solved
from ftlm.solve.instants import has_own_times
from ftlm.solve.records import Record, linear_tuple, sensor_series

#: Evaluations in which level, velocity and offset of a run are found, and the share of the cost that ends the search.
EVALUATIONS = 60
STILL = 1e-12


def motion_with_friction(model: Solved, rec: Record, powers: Sequence[Sequence[tuple[float, float]]]) -> _core._Motion:
    """Outputs of equations some of which have friction, initial terms by equation as (exponent, coefficient).

    Impulses (-1, -2, ...) stand in the outputs for what the filter that these pass still held.

    Returns
    -------
    dict
        ``outputs`` (pulse means, a row an equation), and with a row for each body with friction ``velocity`` (at the
        edges of the pulses, one more; exactly 0 at rest), ``force`` (mean of the friction over each pulse, in the unit
        of D^alpha y) and ``stuck`` (whether it is at rest at the end of each).
    """
    equations = [(linear_tuple(e, rec.signals), [float(t.fixed or 0.0) for t in e.terms]) for e in model.equations]
    frictions = [(i, strength(model.equations[i])) for i in model.structure.sticks]
    return _core.friction_respond(rec.core(), equations, frictions, [list(terms) for terms in powers])


def strength(item: Equation) -> tuple[float, float, float]:
    """Numbers fc, fs and vs of an equation's friction."""
    return (item.friction or Friction(0.0)).law


def begun(model: Solved, run: Run, rec: Record, every: int, near: list[float] | None = None) -> dict[str, Any]:
    """Initial terms and offsets that bring a free run with friction closest to a run, ``every`` pulses an interval.

    They change when a body sticks and slides, so that they are found by descent, from where and how fast the run starts
    or from states that are near.

    Returns
    -------
    dict
        As the core's joint fit, without anything free: ``states``, and ``powers``, their (exponent, coefficient) by run
        and equation.
    """
    check_regular(run, model)
    samples = np.stack([run[name] for name in model.outputs])
    known = ~np.isnan(samples)
    sizes = np.nanstd(samples, axis=1)
    shares: Floats | None = None
    if not known.all():
        shares = np.ascontiguousarray(np.where(known[:, 1:-1], 1.0, 0.0))
    structure = model.structure
    series = sensor_series(structure, rec.m, rec.step)
    filtered = None if series is None else (series, [structure.measured_through(o) for o in model.outputs])
    experiment = (
        rec.core(), every, np.where(known, samples, 0.0), filtered, [1.0 / s if s > 0 else 1.0 for s in sizes.tolist()],
        [(None, False)] * len(rec.signals), shares, None,
    )  # fmt: skip
    laws = [known_law(item, rec.signals) for item in model.equations]
    frictions: list[tuple[int, list[tuple[float, list[Any]]]]] = [
        (i, [(x, []) for x in strength(model.equations[i])]) for i in structure.sticks
    ]
    return _core.friction_error(
        [experiment], laws, frictions, [], [], rec.start, [], [], [],
        [] if near is None else [near], EVALUATIONS, STILL,
    )  # fmt: skip


def known_law(item: Equation, signals: Sequence[str]) -> tuple[int, tuple[float, list[float]], list[Any]]:
    """An identified equation as the core takes one in which everything might be free."""
    output, alpha, terms = linear_tuple(item, signals)
    numbers: list[Any] = [
        (s, (order, []), (float(t.fixed or 0.0), [])) for (s, order), t in zip(terms, item.terms, strict=True)
    ]
    return output, (alpha, []), numbers


def check_regular(run: Run, model: Solved) -> None:
    """Refuse samples at times of their own."""
    if has_own_times(run, model.structure):
        output = model.outputs[model.structure.sticks[0]]
        raise ModelError(
            f"run {run.name!r} has rows at times of their own, and the equation of {output} has friction, "
            "which is followed at regular times; resample the run yourself"
        )
