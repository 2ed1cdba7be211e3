"""Order grid of a search: interval and increment of every free order."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from ftlm.errors import ModelError
from ftlm.structure.order import MAX_ORDER, Order, Values, order_axis, parse_values
from ftlm.structure.structure import Structure
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import parameter
from ftlm.utils.validation import real_number

#: Increment of the order grid in the paper.
DEFAULT_INCREMENT = 0.05
#: Default interval of the highest order: a flexible link has an order of 2 or slightly less.
DEFAULT_ALPHA_RANGE = (1.05, 2.0)


@check_arguments
@dataclass(frozen=True)
class OrderGrid:
    """Intervals and step of an order search.

    Parameters
    ----------
    increment
        Increment of every order that has none of its own.
    alpha
        (low, high) of every highest order.
    orders
        Other orders by name: a number, a tuple (low, high) or (low, high, step), ``"low:high:step"`` or a list of
        values. The name ``alpha`` means every highest order and replaces the interval above.
    """

    increment: float = DEFAULT_INCREMENT
    alpha: tuple[float, float] = DEFAULT_ALPHA_RANGE
    orders: Mapping[str, Values] = field(default_factory=dict)

    @check_arguments
    def values(self, structure: Structure) -> dict[str, tuple[float, ...]]:
        """Return the grid values of each free order of a structure.

        An order that neither the structure nor this grid names takes all multiples of the increment from 0 to the
        largest alpha. The search restricts own-output orders to values below alpha and input orders to at most alpha.

        Raises
        ------
        ModelError
            A name that is not a free order, or an interval out of range.
        """
        free = structure.order_names
        check_order_grid_names(self, structure)
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
                values[name] = order_axis(name, 0.0, min(top, MAX_ORDER), self.increment)
        return {name: values[name] for name in free}

    def _axis(self, name: str, spec: Values) -> tuple[float, ...]:
        if isinstance(spec, tuple) and len(spec) == 2:
            spec = (*spec, self.increment)
        values = parse_values(name, spec)
        return (values,) if isinstance(values, float) else values


@check_arguments
def order_grid(
    increment: float = DEFAULT_INCREMENT, alpha: tuple[float, float] = DEFAULT_ALPHA_RANGE, **orders: Values
) -> OrderGrid:
    """Intervals and step of an order search.

    Every own-output order takes all values 0 <= nu < alpha on the step (distinct, unordered within a signal), every
    other signal's 0 <= nu <= alpha, unless named here.

    Parameters
    ----------
    increment
        Grid increment, positive; the paper uses 0.05.
    alpha
        (low, high) of the highest order, in (0, 10].
    **orders
        Other orders by name, see :class:`OrderGrid`.

    Returns
    -------
    OrderGrid
        Grid whose values depend on the structure it is applied to.

    Raises
    ------
    ModelError
        An increment that is not positive, or an interval that is empty or out of range.
    """
    if not (isinstance(alpha, (tuple, list)) and len(alpha) == 2):
        raise ModelError(f"alpha = {alpha!r} is not an interval; write (low, high), such as {DEFAULT_ALPHA_RANGE}")
    low, high = (real_number("alpha", a) for a in alpha)
    if not 0 < low <= MAX_ORDER:
        raise ModelError(f"alpha interval {low:g}:{high:g} starts outside (0, 10]; choose a positive order")
    order_axis("alpha", low, high, increment)
    return OrderGrid(increment, (float(low), float(high)), dict(orders))


def check_order_grid(order_grid: OrderGrid | None) -> None:
    """Raise if an argument is not an order grid."""
    if not (order_grid is None or isinstance(order_grid, OrderGrid)):
        raise ModelError(f"order_grid is {type(order_grid).__name__}, not an OrderGrid; use ftlm.order_grid(…)")


def axis_of(order: Order, values: Mapping[str, tuple[float, ...]]) -> list[float]:
    """Return the grid values of an order that is a number or a single free order."""
    return list(values[order.names[0]]) if order.names else [order.constant]


def check_order_grid_names(given: OrderGrid | None, structure: Structure) -> None:
    """Raise if an order grid names an order that is not free."""
    for name in given.orders if given is not None else ():
        if name not in structure.order_names and name != "alpha":
            free = ", ".join(structure.order_names) or "none"
            raise ModelError(f"order {name!r} of {parameter('order_grid')} is not a free order; free are {free}")


def restrict_order_grid(given: OrderGrid | None, part: Structure) -> OrderGrid | None:
    """Restrict an order grid to the free orders of a substructure."""
    if given is None:
        return None
    names = (*part.order_names, "alpha")
    return replace(given, orders={n: v for n, v in given.orders.items() if n in names})
