"""Intervals and step of an order search."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from ftlm.errors import ModelError
from ftlm.structure.order import MAX_ORDER, Order, Values, grid, parse_values
from ftlm.structure.structure import Structure
from ftlm.utils.validation import real_number

#: The paper's step.
STEP = 0.05
#: The interval of alpha: a flexible link is second order or a little less.
ALPHA = (1.05, 2.0)


@dataclass(frozen=True)
class Lattice:
    """Intervals and step of an order search.

    Parameters
    ----------
    step
        Step of every order that has no step of its own.
    alpha
        (low, high) of every highest order.
    orders
        Other orders by name: a number, a tuple (low, high) or (low, high, step), ``"low:high:step"`` or a list of
        values; ``alpha`` stands for every highest order and takes the place of the interval above.
    """

    step: float = STEP
    alpha: tuple[float, float] = ALPHA
    orders: Mapping[str, Values] = field(default_factory=dict)

    def values(self, structure: Structure) -> dict[str, tuple[float, ...]]:
        """Values of each free order of a structure.

        What the structure or this lattice does not name runs over all multiples of the step from 0 to the largest
        alpha; the search itself keeps an own-output order below alpha and any other at most alpha.

        Raises
        ------
        ModelError
            A name that is no free order, an interval out of range.
        """
        free = structure.order_names
        check_lattice_names(self, structure)
        highest = [n for e in structure.equations for n in e.order.names if e.order.is_single]
        values: dict[str, tuple[float, ...]] = {}
        for name in free:
            if name in self.orders:
                values[name] = self._axis(name, self.orders[name])
            elif name in structure.order_values:
                values[name] = structure.order_values[name]
            elif name in highest:
                values[name] = self._axis(name, self.orders.get("alpha", self.alpha))
        fixed = [e.order.constant for e in structure.equations if not e.order.names]
        top = max([max(values[n]) for n in highest if n in values] + fixed, default=2.0)
        for name in free:
            if name not in values:
                values[name] = grid(name, 0.0, min(top, MAX_ORDER), self.step)
        return {name: values[name] for name in free}

    def _axis(self, name: str, spec: Values) -> tuple[float, ...]:
        if isinstance(spec, tuple) and len(spec) == 2:
            spec = (*spec, self.step)
        values = parse_values(name, spec)
        return (values,) if isinstance(values, float) else values


def lattice(step: float = STEP, alpha: tuple[float, float] = ALPHA, **orders: Values) -> Lattice:
    """Intervals and step of an order search.

    Every own-output order takes all values 0 <= nu < alpha on the step (distinct, unordered within a signal), every
    other signal's 0 <= nu <= alpha, unless named here.

    Parameters
    ----------
    step
        Step, positive; the paper's is 0.05.
    alpha
        (low, high) of the highest order, in (0, 10].
    **orders
        Other orders by name, see :class:`Lattice`.

    Returns
    -------
    Lattice
        Its values follow once it meets a structure.

    Raises
    ------
    ModelError
        A step that is not positive, an interval that is empty or out of range.
    """
    if not (isinstance(alpha, (tuple, list)) and len(alpha) == 2):
        raise ModelError(f"alpha = {alpha!r} is no interval; write (low, high), such as {ALPHA}")
    low, high = (real_number("alpha", a) for a in alpha)
    if not 0 < low <= MAX_ORDER:
        raise ModelError(f"alpha interval {low:g}:{high:g} starts outside (0, 10]; choose a positive order")
    grid("alpha", low, high, step)
    return Lattice(step, (float(low), float(high)), dict(orders))


def check_lattice(lattice: Lattice | None) -> None:
    """Refuse a lattice that is none."""
    if not (lattice is None or isinstance(lattice, Lattice)):
        raise ModelError(f"lattice is {type(lattice).__name__}, not a Lattice; use ftlm.lattice(…)")


def axis_of(order: Order, values: Mapping[str, tuple[float, ...]]) -> list[float]:
    """Values of an order that is a number or one free order."""
    return list(values[order.names[0]]) if order.names else [order.constant]


def check_lattice_names(given: Lattice | None, structure: Structure) -> None:
    """Refuse a lattice that names an order which is not free."""
    for name in given.orders if given is not None else ():
        if name not in structure.order_names and name != "alpha":
            free = ", ".join(structure.order_names) or "none"
            raise ModelError(f"lattice order {name!r} is no free order; free are {free}")


def lattice_of(given: Lattice | None, part: Structure) -> Lattice | None:
    """Return what a lattice says of a part of its structure."""
    if given is None:
        return None
    names = (*part.order_names, "alpha")
    return replace(given, orders={n: v for n, v in given.orders.items() if n in names})
