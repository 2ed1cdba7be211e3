"""Options of an order search: order grids, and validated settings of search and coefficient estimation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, get_args

from ftlm import _core
from ftlm.errors import ModelError
from ftlm.structure.order import MAX_ORDER, Values, order_axis, parse_values
from ftlm.structure.structure import Structure
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import parameter, setting
from ftlm.utils.resources import memory_limit
from ftlm.utils.validation import check_choice, check_integer, real_number, whole_number

#: Increment of the order grid in the paper.
DEFAULT_INCREMENT = 0.05
#: Default interval of the highest order alpha of an equation: that of a flexible link is 2 or slightly less.
DEFAULT_ALPHA_RANGE = (1.05, 2.0)


@check_arguments
@dataclass(frozen=True)
class OrderGrid:
    """Grid of an order search: interval of each order, and increment within the interval.

    Parameters
    ----------
    increment
        Increment of every order for which `orders` gives none.
    alpha
        Interval (low, high) of the highest order of every equation.
    orders
        Values of other orders by name: a number, a tuple (low, high) or (low, high, increment), the text
        ``"low:high:increment"``, or a list. The name ``alpha`` stands for the highest order of every equation. Its
        values replace the argument `alpha`.
    """

    increment: float = DEFAULT_INCREMENT
    alpha: tuple[float, float] = DEFAULT_ALPHA_RANGE
    orders: Mapping[str, Values] = field(default_factory=dict)

    def values(self, structure: Structure) -> dict[str, tuple[float, ...]]:
        """Return the grid values of each free order of a structure, by name.

        An order without values in the structure and in this grid takes all multiples of the increment from 0 to the
        largest alpha. Of these, the search uses orders below alpha for output terms, and up to alpha for other signals.

        Raises
        ------
        ModelError
            If `orders` contains a name that is not a free order, or an interval is out of range.
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
        highest_order = max([max(values[n]) for n in highest if n in values] + fixed, default=2.0)
        for name in free:
            if name not in values:
                values[name] = order_axis(name, 0.0, min(highest_order, MAX_ORDER), self.increment)
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
    """Return the grid of an order search: interval of each order, and increment within the interval.

    An order nu that is not given here takes all multiples of the increment. For a term in the output of the equation,
    they satisfy 0 <= nu < alpha, and for other signals 0 <= nu <= alpha. Terms of the same signal have different
    orders, and permutations of these orders count once.

    Parameters
    ----------
    increment
        Positive increment of the grid; the paper uses 0.05.
    alpha
        Interval (low, high) of the highest order alpha of every equation, within (0, 10].
    **orders
        Values of other orders by name; see :class:`OrderGrid`.

    Returns
    -------
    OrderGrid
        Order grid; its values for a structure follow from :meth:`OrderGrid.values`.

    Raises
    ------
    ModelError
        If the increment is not positive, or an interval is empty or out of range.
    """
    if not (isinstance(alpha, (tuple, list)) and len(alpha) == 2):
        raise ModelError(f"alpha = {alpha!r} is not an interval; write (low, high), such as {DEFAULT_ALPHA_RANGE}")
    low, high = (real_number("alpha", a) for a in alpha)
    if not 0 < low <= MAX_ORDER:
        raise ModelError(f"alpha interval {low:g}:{high:g} starts outside (0, 10]; choose a positive order")
    order_axis("alpha", low, high, increment)
    return OrderGrid(increment, (float(low), float(high)), dict(orders))


def check_order_grid(order_grid: OrderGrid | None) -> None:
    """Raise ModelError unless `order_grid` is None or an OrderGrid."""
    if not (order_grid is None or isinstance(order_grid, OrderGrid)):
        raise ModelError(f"order_grid is {type(order_grid).__name__}, not an OrderGrid; use ftlm.order_grid(…)")


def check_order_grid_names(grid: OrderGrid | None, structure: Structure) -> None:
    """Raise ModelError if an order grid names an order that is not free in the structure."""
    for name in grid.orders if grid is not None else ():
        if name not in structure.order_names and name != "alpha":
            free = ", ".join(structure.order_names) or "none"
            raise ModelError(f"order {name!r} of {parameter('order_grid')} is not a free order; free are {free}")


def restrict_order_grid(grid: OrderGrid | None, group: Structure) -> OrderGrid:
    """Return an order grid, by default the default one, without orders that are not free in the structure `group`."""
    grid, names = grid or OrderGrid(), (*group.order_names, "alpha")
    return replace(grid, orders={n: v for n, v in grid.orders.items() if n in names})


Criterion = Literal["output-error", "equation-error"]
Coefficients = Literal["multi-innovation", "least-squares", "instrumental-variables"]
Norm = Literal["l1", "l2"]
RowBasis = Literal["haar", "time"]
#: Innovation lengths p that the paper's tables compare.
COMPARED_INNOVATION_LENGTHS = (1, 3, 5, 7)
#: Maximum number of iterations of refined instrumental variables per candidate; most candidates converge earlier.
MAX_IV_ITERATIONS = 5
#: Maximum number of rows of the result table.
MAX_TOP = 100_000
#: Settings that only the coefficient estimator "multi-innovation" uses.
MULTI_INNOVATION_SETTINGS = ("innovation_length", "prior_covariance", "row_basis")


@dataclass(frozen=True, kw_only=True)
class SearchSettings:
    """Options that determine the result of an order search.

    Parameters
    ----------
    criterion, norm, coefficients, innovation_length, prior_covariance, row_basis, top, pruning
        See :func:`ftlm.search_orders`.

    Raises
    ------
    ModelError
        If a value is out of range, or an option of multi-innovation is given for another coefficient estimator.
    """

    criterion: Criterion = "output-error"
    norm: Norm = "l1"
    coefficients: Coefficients = "multi-innovation"
    innovation_length: int = 7
    prior_covariance: float | None = None
    row_basis: RowBasis = "haar"
    top: int = 20
    pruning: bool = True

    def __post_init__(self) -> None:
        check_choice("criterion", self.criterion, get_args(Criterion))
        check_choice("norm", self.norm, get_args(Norm))
        check_choice("coefficients", self.coefficients, get_args(Coefficients))
        check_choice("row_basis", self.row_basis, get_args(RowBasis))
        top = whole_number(self.top)
        if top is None or not 1 <= top <= MAX_TOP:
            raise ModelError(
                f"{setting('top')} {self.top!r} is outside [1, {MAX_TOP}]; choose the number of rows in the table"
            )
        length = check_integer("innovation_length", self.innovation_length, 1)
        covariance_value = self.prior_covariance
        covariance = None if covariance_value is None else real_number("prior_covariance", covariance_value)
        if covariance is not None and not 0 < covariance < math.inf:
            raise ModelError(
                f"{setting('prior_covariance')} {self.prior_covariance!r} is not positive; a large one is a weak prior"
            )
        if not isinstance(self.pruning, bool):
            raise ModelError(f"pruning = {self.pruning!r} is neither True nor False; give one of them")
        for name, value in (("top", top), ("innovation_length", length), ("prior_covariance", covariance)):
            object.__setattr__(self, name, value)
        if self.coefficients != "multi-innovation":
            changed = [
                f.name
                for f in fields(self)
                if f.name in MULTI_INNOVATION_SETTINGS and getattr(self, f.name) != f.default
            ]
            if changed:
                raise ModelError(
                    f"{parameter(changed[0])} is not used by {parameter('coefficients', self.coefficients)}; leave "
                    f"it out, or use {parameter('coefficients', 'multi-innovation')}"
                )

    @property
    def needs_haar(self) -> bool:
        """Whether the Haar row basis is used, for which the number of block pulses must be a power of two."""
        return self.coefficients == "multi-innovation" and self.row_basis == "haar"

    def core_arguments(self, threads: int) -> _core._Options:
        """Return the settings in the form that the Rust core takes, with the memory limit of this machine [bytes]."""
        return {
            "criterion": self.criterion,
            "norm": self.norm,
            "innovation_length": self.innovation_length if self.coefficients == "multi-innovation" else 0,
            "prior_covariance": self.prior_covariance,
            "haar_rows": self.row_basis == "haar",
            "top": self.top,
            "threads": threads,
            "pruning": self.pruning,
            "iterations": MAX_IV_ITERATIONS if self.coefficients == "instrumental-variables" else 0,
            "memory": memory_limit(),
        }

    def to_dict(self) -> dict[str, Any]:
        """Return the settings to show in results and reports, by name, except options of other estimators."""
        method_settings = MULTI_INNOVATION_SETTINGS if self.coefficients == "multi-innovation" else ()
        return {name: getattr(self, name) for name in ("criterion", "norm", "coefficients", *method_settings)}
