"""Free runs of a body that may stick, and what a run of it starts with."""

from __future__ import annotations

from typing import Any

import numpy as np

from ftlm import _core
from ftlm.base.arrays import Floats
from ftlm.base.errors import ModelError
from ftlm.data.equations import Equation, Friction
from ftlm.data.run import Run
from ftlm.data.solved import Solved
from ftlm.solve.instants import has_own_times
from ftlm.solve.records import Record, initial_tuple, linear_tuple

#: Evaluations in which level, velocity and offset of a run are found, and the share of the cost that ends the search.
EVALUATIONS = 60
STILL = 1e-12


def motion_with_friction(item: Equation, rec: Record, powers: list[tuple[float, float]]) -> _core._Motion:
    """Output and velocity of an identified equation with friction, its initial terms given as (exponent, coefficient).

    Returns
    -------
    dict
        ``output`` (pulse means), ``velocity`` (at the edges of the pulses, one more; exactly 0 at rest), ``force``
        (mean of the friction over each pulse, in the unit of D^alpha y) and ``stuck`` (whether the body is at rest at
        the end of each).
    """
    strength = (item.friction or Friction(0.0)).law
    coefficients = [float(t.fixed or 0.0) for t in item.terms]
    return _core.friction_respond(rec.core(), linear_tuple(item, rec.signals), coefficients, strength, powers)


def begun(model: Solved, run: Run, rec: Record, every: int, near: list[float] | None = None) -> dict[str, Any]:
    """Initial terms and offset that bring a free run with friction closest to a run, ``every`` pulses an interval.

    They change when a body sticks and slides, so that they are found by descent, from where and how fast the run starts
    or from states that are near.

    Returns
    -------
    dict
        As the core's joint fit, without anything free: ``states``, and ``powers``, their (exponent, coefficient).
    """
    item = model.equations[0]
    check_regular(run, model)
    samples = run[item.output]
    known = ~np.isnan(samples)
    size = float(np.std(samples[known]))
    shares: Floats | None = None
    if not known.all():
        shares = np.where(known[1:-1], 1.0, 0.0)[None]
    experiment = (
        rec.core(), every, np.where(known, samples, 0.0)[None], None, [1.0 / size if size > 0 else 1.0],
        [(None, False)] * len(rec.signals), shares, None,
    )  # fmt: skip
    output, alpha, terms = linear_tuple(item, rec.signals)
    law: tuple[int, tuple[float, list[float]], list[Any]] = (
        output, (alpha, []),
        [(s, (order, []), (float(t.fixed or 0.0), [])) for (s, order), t in zip(terms, item.terms, strict=True)],
    )  # fmt: skip
    strength: list[tuple[float, list[Any]]] = [(x, []) for x in (item.friction or Friction(0.0)).law]
    return _core.friction_error(
        [experiment], law, strength, [], [], initial_tuple(rec.initial, rec.offset), [], [], [],
        [] if near is None else [near], EVALUATIONS, STILL,
    )  # fmt: skip


def check_regular(run: Run, model: Solved) -> None:
    """Refuse samples at times of their own."""
    if has_own_times(run, model.structure):
        raise ModelError(
            f"run {run.name!r} has rows at times of their own, and the equation of {model.outputs[0]} has friction, "
            "which is followed at regular times; resample the run yourself"
        )
