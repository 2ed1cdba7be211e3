"""Orders of terms, and grids of order values. An order is a number or an affine function of free orders."""

from __future__ import annotations

import ast
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

from ftlm.errors import ModelError
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import parameter
from ftlm.utils.validation import real_number

#: Highest order of an equation, and lowest order of an input term (threefold integration).
MAX_ORDER = 10.0
MIN_INPUT_ORDER = -3.0
#: Upper bound on the order of an input term minus the highest order of its equation. Above this bound, samples of the
#: measured signal do not determine the required derivative.
MAX_IMPROPER_ORDER = 1.0
#: Highest order in the default grid of a search, unless the structure contains a higher one.
MAX_DEFAULT_SEARCH_ORDER = 3.0
#: Orders are rounded to this resolution; smaller differences mean the same order.
ORDER_RESOLUTION = 1e-9
#: Accepted specifications of the values of an order; see :func:`parse_values`.
Values: TypeAlias = float | str | Iterable[float]


@check_arguments
@dataclass(frozen=True)
class Order:
    """Order of a term: a number, or an affine function of named free orders.

    Parameters
    ----------
    constant
        Constant part.
    weights
        (name, weight) of each free order, sorted by name, without zero weights.
    """

    constant: float = 0.0
    weights: tuple[tuple[str, float], ...] = ()

    def __add__(self, other: Order) -> Order:
        """Return the sum of two orders."""
        weights = dict(self.weights)
        for name, weight in other.weights:
            weights[name] = weights.get(name, 0.0) + weight
        constant = round(self.constant + other.constant, 9) + 0.0
        return Order(constant, tuple(sorted((n, w) for n, w in weights.items() if w)))

    def substitute(self, values: Mapping[str, float]) -> Order:
        """Return the order with some free orders replaced by values; the other orders stay free."""
        constant = self.constant + sum(w * values[n] for n, w in self.weights if n in values)
        return Order(round(constant, 9) + 0.0, tuple((n, w) for n, w in self.weights if n not in values))

    @classmethod
    def parse(cls, text: str | float) -> Order:
        """Return the order for a number or a text.

        The text is a number, a name, or an affine expression such as ``"alpha1 - alpha2 + 2*mu2"``.

        Raises
        ------
        ModelError
            If an expression is not affine in its names.
        """
        if isinstance(text, (int, float)) and not isinstance(text, bool):
            return cls(float(text))
        try:
            tree = ast.parse(str(text).strip(), mode="eval").body
            constant, weights = _affine(tree)
        except (SyntaxError, ValueError, OverflowError, RecursionError, MemoryError) as error:
            label = f"{text!r}"
            label = label if len(label) <= 60 else f"{label[:60]}…"
            raise ModelError(
                f"order {label} is neither a number nor a sum of named orders; write 0.5, alpha or alpha1-mu2+0.1"
            ) from error
        # The range of a plain number is checked by the equation.
        if weights and not all(map(math.isfinite, (constant, *weights.values()))):
            raise ModelError(f"order {text!r:.60} has a number that is not finite; write 0.5, alpha or alpha1-mu2+0.1")
        return cls(constant, tuple(sorted((n, w) for n, w in weights.items() if w)))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free orders on which the order depends."""
        return tuple(name for name, _ in self.weights)

    @property
    def is_single(self) -> bool:
        """Whether the order equals one free order."""
        return self.constant == 0 and len(self.weights) == 1 and self.weights[0][1] == 1

    def at(self, values: Mapping[str, float]) -> float:
        """Return the value of the order at given values of the free orders, rounded to 1e-9.

        Raises
        ------
        ModelError
            If a free order has no value.
        """
        try:
            return round(self.constant + sum(w * values[n] for n, w in self.weights), 9) + 0.0
        except KeyError as error:
            raise ModelError(f"order {error.args[0]} has no value; give it in {parameter('orders')}") from None

    def __str__(self) -> str:
        parts = [
            f"{'-' if w < 0 else '+'}{'' if abs(w) == 1 else f'{format_shortest(abs(w))}*'}{n}" for n, w in self.weights
        ]
        if self.constant or not parts:
            parts.append(f"{'-' if self.constant < 0 else '+'}{format_shortest(abs(self.constant))}")
        return "".join(parts).removeprefix("+")


def format_shortest(value: float) -> str:
    """Return a number as text: with six significant digits if they are exact, otherwise with all digits."""
    text = f"{value:g}"
    return text if float(text) == value else repr(value)


def _affine(node: ast.expr) -> tuple[float, dict[str, float]]:
    """Return the constant and the weights of an affine expression; raise ValueError if it is not affine."""
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            return float(value), {}
        case ast.Name(id=name):
            return 0.0, {name: 1.0}
        case ast.UnaryOp(op=ast.USub() | ast.UAdd() as sign, operand=operand):
            factor = -1.0 if isinstance(sign, ast.USub) else 1.0
            constant, weights = _affine(operand)
            return factor * constant, {n: factor * w for n, w in weights.items()}
        case ast.BinOp(left=lhs, op=ast.Add() | ast.Sub() as sign, right=right):
            factor = -1.0 if isinstance(sign, ast.Sub) else 1.0
            c1, w1 = _affine(lhs)
            c2, w2 = _affine(right)
            return c1 + factor * c2, {n: w1.get(n, 0) + factor * w2.get(n, 0) for n in {**w1, **w2}}
        case ast.BinOp(left=lhs, op=ast.Mult(), right=right):
            c1, w1 = _affine(lhs)
            c2, w2 = _affine(right)
            if w1 and w2:
                raise ValueError("product of orders")
            return c1 * c2, {n: w * (c2 if w1 else c1) for n, w in {**w1, **w2}.items()}
        case ast.BinOp(left=lhs, op=ast.Div(), right=ast.Constant(value=int() | float() as value)) if value:
            constant, weights = _affine(lhs)
            return constant / value, {n: w / value for n, w in weights.items()}
    raise ValueError("not affine")


def parse_values(name: str, spec: Values) -> float | tuple[float, ...]:
    """Return the value of a fixed order, or the ascending grid values of a free one.

    `spec` is a number, ``"low:high:step"``, a tuple (low, high, step) or a list of numbers. `name` names the order in
    error messages. Raise ModelError for other input and for values outside [-3, 10].
    """
    if isinstance(spec, str):
        parts = spec.split(":")
        try:
            numbers = [float(p) for p in parts]
        except ValueError:
            raise ModelError(
                f"order {name}: {spec!r} is not an interval; write LOW:HIGH:STEP such as 0.5:1.5:0.05"
            ) from None
        if len(numbers) == 1:
            return _check_range(name, numbers[0])
        if len(numbers) != 3:
            raise ModelError(f"order {name}: {spec!r} has {len(numbers)} parts; write LOW:HIGH:STEP")
        return order_axis(name, *numbers)
    if isinstance(spec, (int, float)):
        return _check_range(name, real_number(f"order {name}", spec))
    if isinstance(spec, tuple) and len(spec) == 2:
        raise ModelError(f"order {name}: {spec!r} has no step; write (low, high, step), or a list for two values")
    try:
        numbers = [real_number(f"order {name}", v) for v in spec]
    except TypeError:
        raise ModelError(f"order {name}: {spec!r} is not a list of numbers; write LOW:HIGH:STEP or numbers") from None
    if isinstance(spec, tuple) and len(spec) == 3:
        return order_axis(name, *numbers)
    values = [_check_range(name, v) for v in numbers]
    if not values:
        raise ModelError(f"order {name} has no value; give at least one")
    values = sorted(set(values))
    for low, high in pairwise(values):
        if round(low, 9) == round(high, 9):
            raise ModelError(
                f"order {name}: values {format_shortest(low)} and {format_shortest(high)} are equal, because orders "
                f"have a resolution of {ORDER_RESOLUTION:g}; leave one out"
            )
    return tuple(values)


def _check_range(name: str, value: float) -> float:
    if not MIN_INPUT_ORDER <= value <= MAX_ORDER:
        raise ModelError(f"order {name} = {value:g} is outside [-3, 10]; choose another value")
    return value


#: Maximum number of values on one axis of an order grid; a larger number is regarded as a typing error.
MAX_AXIS_VALUES = 1_000_000


def order_axis(name: str, low: float, high: float, step: float) -> tuple[float, ...]:
    """Return the values low, low + step, … up to `high` of an order; raise ModelError for an invalid interval."""
    low, high, step = (real_number(f"order {name}", v) for v in (low, high, step))
    if not (math.isfinite(step) and step > 0):
        raise ModelError(f"order {name}: increment {step:g} is not positive; the paper's is 0.05")
    if step < ORDER_RESOLUTION:
        raise ModelError(
            f"order {name}: increment {step:g} is below {ORDER_RESOLUTION:g}, the resolution of orders; raise the "
            "increment"
        )
    _check_range(name, low)
    _check_range(name, high)
    if high < low:
        raise ModelError(f"order {name}: interval {low:g}:{high:g} is empty; put the lower end first")
    steps = (high - low) / step
    if steps > MAX_AXIS_VALUES:
        raise ModelError(
            f"order {name}: {low:g}:{high:g}:{step:g} has {steps:.3g} values, more than {MAX_AXIS_VALUES}; raise "
            "the increment"
        )
    return tuple(round(low + i * step, 9) + 0.0 for i in range(int(steps + 1e-6) + 1))
