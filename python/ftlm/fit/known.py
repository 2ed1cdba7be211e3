"""Starts from what is known already: the numbers of a simpler model, or values by name."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping

from ftlm.base.checks import check_known, real_number
from ftlm.base.errors import ModelError
from ftlm.data.orders import Order
from ftlm.data.solved import Solved
from ftlm.fit.problem import FreeProblem

#: Whole orders at which a term starts that what is known does not have, and how many starts that may make.
WHOLE = (0.0, 1.0, 2.0)
MOST = 9


def known_starts(problem: FreeProblem, known: Mapping[str, float]) -> list[dict[str, float]]:
    """Starts from values by name; what they lack has the coefficient 0, so that it does nothing at first.

    An order that they lack starts at each whole value within its bounds.

    Raises
    ------
    ModelError
        A name that is not free, nothing that is, or a value that is none or out of its bounds.
    """
    bounds = dict(zip(problem.names, problem.all_bounds, strict=True))
    check_known("start value", known, problem.names)
    if not known:
        raise ModelError(f"start= has none of the numbers that are free: {', '.join(problem.names)}")
    for name, value in known.items():
        low, high = bounds[name]
        if not low <= real_number(f"start value of {name}", value) <= high:
            raise ModelError(f"start= has {name} = {value:g}, out of its bounds {low:g} to {high:g}; widen them")
    places: dict[str, list[float]] = {}
    for name, (low, high) in bounds.items():
        if name in known:
            places[name] = [float(known[name])]
        elif name in problem.orders:
            places[name] = [v for v in WHOLE if low <= v <= high] or [0.5 * (low + high)]
        else:
            places[name] = [0.0 if low <= 0.0 <= high else low if math.isfinite(low) else high]
    points = itertools.islice(itertools.product(*places.values()), MOST)
    return [dict(zip(places, point, strict=True)) for point in points]


def values_of_model(problem: FreeProblem, model: Solved, more: Mapping[str, float]) -> dict[str, float]:
    """What a model of the same outputs knows of a problem's numbers; ``more`` are those that it holds under a law.

    Orders that are free here and were numbers there are those of the same coefficient's term.

    Raises
    ------
    ModelError
        A model of other outputs.
    """
    check_known("output of start", model.outputs, problem.structure.outputs)
    found = {**model.orders, **model.coefficients, **more}
    there = {e.output: e for e in model.equations}

    def tell(order: Order, value: Order) -> None:
        if order.is_single and not value.names:
            found.setdefault(order.names[0], value.constant)

    for item in problem.structure.equations:
        other = there.get(item.output)
        if other is None:
            continue
        tell(item.order, other.order)
        named = {t.name: t for t in other.terms if t.name is not None}
        for term in item.terms:
            if term.coefficient in named:
                tell(term.order, named[str(term.coefficient)].order)
    return {n: v for n, v in found.items() if n in problem.names}
