"""Expressions of signals in non-linear terms: construction, text, evaluation and derivatives."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from ftlm.errors import ModelError
from ftlm.structure.order import format_shortest
from ftlm.utils.arguments import check_arguments
from ftlm.utils.validation import Floats

Function: TypeAlias = Literal["sin", "cos", "exp", "tanh", "abs", "sqrt"]
Operation: TypeAlias = Literal["constant", "channel", "add", "multiply", "power"] | Function
#: Signal or derivative of a signal, as (signal name, order of the derivative).
Channel: TypeAlias = tuple[str, float]
#: Functions that an expression may contain, by name, as (function, its derivative).
EXPRESSION_FUNCTIONS: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    "sin": (np.sin, np.cos),
    "cos": (np.cos, lambda x: -np.sin(x)),
    "exp": (np.exp, np.exp),
    "tanh": (np.tanh, lambda x: 1.0 / np.cosh(x) ** 2),
    "abs": (np.abs, np.sign),
    "sqrt": (np.sqrt, lambda x: 0.5 / np.sqrt(x)),
}
#: Maximum exponent of a power; larger powers overflow for signals that are not scaled.
MAX_POWER = 100
#: Maximum number of instructions of an expression, which excludes excessively long texts.
MAX_INSTRUCTIONS = 1000


@check_arguments
@dataclass(frozen=True)
class Expression:
    """Expression of signals and their derivatives without free parameters, such as ``abs(D y)*D y``.

    The functions :func:`constant`, :func:`channel`, :func:`add`, :func:`multiply`, :func:`power` and :func:`apply`
    construct expressions in normal form. The parser converts the text of an expression back to an equal expression.

    Parameters
    ----------
    operation
        Kind of the expression, such as ``"add"``, or the name of a function.
    arguments
        Operands of the operation.
    value
        Value of a constant, exponent of a power, or order of the derivative in a channel (a signal or its derivative).
    signal
        Name of the signal in a channel.
    """

    operation: Operation
    arguments: tuple[Expression, ...] = ()
    value: float = 0.0
    signal: str = ""

    @property
    def channels(self) -> tuple[Channel, ...]:
        """(signal, order of its derivative) pairs in the expression, in the sequence in which they first occur."""
        if self.operation == "channel":
            return ((self.signal, self.value),)
        return tuple(dict.fromkeys(c for argument in self.arguments for c in argument.channels))

    @property
    def is_linear(self) -> bool:
        """Whether the expression is affine: a sum of constants and of constants times channels."""
        if self.operation == "multiply":
            return len(self.arguments) == 2 and not self.arguments[0].channels and self.arguments[1].is_linear
        return self.operation in ("constant", "channel") or (
            self.operation == "add" and all(argument.is_linear for argument in self.arguments)
        )

    def program(self, channel_index: Mapping[Channel, int]) -> list[tuple[str, float]]:
        """Return the expression as postfix instructions for Rust; `channel_index` has the index of each channel.

        Instructions are ("constant", value), ("channel", index), ("add", 0), ("multiply", 0), ("negate", 0),
        ("power", exponent), and (name of a function, 0).
        """
        if self.operation == "constant":
            return [("constant", self.value)]
        if self.operation == "channel":
            return [("channel", float(channel_index[self.signal, self.value]))]
        first, *others = self.arguments
        if self.operation == "multiply" and first == constant(-1.0):
            return [*multiply(*others).program(channel_index), ("negate", 0.0)]
        out = first.program(channel_index)
        for other in others:
            out += [*other.program(channel_index), (self.operation, 0.0)]
        if not others:
            out.append((self.operation, self.value if self.operation == "power" else 0.0))
        return out

    def evaluate(self, values: Mapping[Channel, Floats | float]) -> Any:
        """Return the value of the expression for values of its channels, which are numbers or arrays of equal shape.

        The result is NaN or infinite where the expression is undefined or overflows.
        """
        with np.errstate(all="ignore"):
            return self._evaluate({c: np.asarray(v, dtype=np.float64) for c, v in values.items()})

    def _evaluate(self, values: Mapping[Channel, Any]) -> Any:
        match self.operation:
            case "constant":
                return self.value
            case "channel":
                return values[self.signal, self.value]
            case "power":
                return self.arguments[0]._evaluate(values) ** self._exponent
        argument_values = [argument._evaluate(values) for argument in self.arguments]
        if self.operation in EXPRESSION_FUNCTIONS:
            return EXPRESSION_FUNCTIONS[self.operation][0](argument_values[0])
        out = argument_values[0]
        for value in argument_values[1:]:
            out = out + value if self.operation == "add" else out * value
        return out

    @property
    def _exponent(self) -> float | int:
        return int(self.value) if self.value.is_integer() else self.value

    def gradient(self, values: Mapping[Channel, Floats | float]) -> dict[Channel, Any]:
        """Return the partial derivatives with respect to the channels, by channel, at given values of the channels.

        The derivative of abs at 0 is 0.
        """
        samples = {c: np.asarray(v, dtype=np.float64) for c, v in values.items()}
        with np.errstate(all="ignore"):
            return {c: self._derivative(c, samples) for c in self.channels}

    def _derivative(self, channel: Channel, values: Mapping[Channel, Any]) -> Any:
        """Return the partial derivative with respect to one channel by the chain rule."""
        if self.operation == "channel":
            return float((self.signal, self.value) == channel)
        inner = [argument._derivative(channel, values) for argument in self.arguments]
        if self.operation in ("constant", "add"):
            return sum(inner)
        argument_values = [argument._evaluate(values) for argument in self.arguments]
        if self.operation == "power":
            n = self._exponent
            return n * argument_values[0] ** (n - 1) * inner[0]
        if self.operation in EXPRESSION_FUNCTIONS:
            return EXPRESSION_FUNCTIONS[self.operation][1](argument_values[0]) * inner[0]
        others = [[*argument_values[:i], *argument_values[i + 1 :]] for i in range(len(inner))]
        return sum(math.prod(factors, start=slope) for factors, slope in zip(others, inner, strict=True))

    def split_factor(self) -> tuple[float, Expression]:
        """Return the constant factor of the expression (1 if it has none) and the expression without the factor."""
        if self.operation == "constant":
            return self.value, constant(1.0)
        if self.operation == "multiply" and self.arguments[0].operation == "constant":
            return self.arguments[0].value, multiply(*self.arguments[1:])
        return 1.0, self

    def as_text(self, signals: Mapping[str, str] | None = None) -> str:
        """Return the expression as text; `signals` maps an input to its text with delay and non-linearity."""
        texts = signals or {}
        match self.operation:
            case "constant":
                return format_shortest(self.value)
            case "channel":
                return derivative_text(self.value, texts.get(self.signal, self.signal))
            case "add":
                text = " + ".join(argument.as_text(texts) for argument in self.arguments)
                return text.replace("+ -", "- ")
            case "multiply":
                first, *others = self.arguments
                if first == constant(-1.0):
                    return "-" + multiply(*others)._as_factor(texts)
                return "*".join([first._as_factor(texts), *(other._as_factor(texts) for other in others)])
            case "power":
                base = self.arguments[0]
                text = base.as_text(texts)
                is_atomic = base.operation in EXPRESSION_FUNCTIONS or (base.operation == "channel" and base.value == 0)
                return f"{text if is_atomic else f'({text})'}^{format_shortest(self.value)}"
        return f"{self.operation}({self.arguments[0].as_text(texts)})"

    def _as_factor(self, texts: Mapping[str, str]) -> str:
        """Return the expression as text, in parentheses if it is a sum, for use in a product."""
        text = self.as_text(texts)
        return f"({text})" if self.operation == "add" else text

    def __str__(self) -> str:
        return self.as_text()


def derivative_text(order: float, text: str) -> str:
    """Return the derivative of a signal as text, such as ``D^0.5 y``."""
    return text if order == 0 else f"D {text}" if order == 1 else f"D^{format_shortest(order)} {text}"


def constant(value: float) -> Expression:
    """Return a constant as an expression.

    Raises
    ------
    ModelError
        If the value is not finite.
    """
    if not math.isfinite(value):
        raise ModelError(f"a constant of an expression is {value}, which is not finite; give a number")
    return Expression("constant", value=float(value) + 0.0)


def channel(signal: str, order: float = 0.0) -> Expression:
    """Return a signal, or its derivative of the given order, as an expression.

    Raises
    ------
    ModelError
        If the order is negative.
    """
    if not 0 <= order < math.inf:
        raise ModelError(f"order {order:g} of {signal} inside a non-linear term is negative; use derivatives, from 0")
    return Expression("channel", value=float(order), signal=signal)


def add(*terms: Expression) -> Expression:
    """Return a sum in normal form: without nested sums, and with at most one constant, at the end."""
    parts = [part for term in terms for part in (term.arguments if term.operation == "add" else (term,))]
    total = sum(part.value for part in parts if part.operation == "constant")
    parts = [part for part in parts if part.operation != "constant"]
    if total or not parts:
        parts.append(constant(total))
    return parts[0] if len(parts) == 1 else Expression("add", tuple(parts))


def multiply(*factors: Expression) -> Expression:
    """Return a product in normal form: without nested products, and with at most one constant, at the start."""
    parts = [part for factor in factors for part in (factor.arguments if factor.operation == "multiply" else (factor,))]
    product = math.prod(part.value for part in parts if part.operation == "constant")
    parts = [part for part in parts if part.operation != "constant"]
    if product == 0.0 or not parts:
        return constant(product)
    if product != 1.0:
        parts.insert(0, constant(product))
    return parts[0] if len(parts) == 1 else Expression("multiply", tuple(parts))


def power(base: Expression, exponent: float) -> Expression:
    """Return a power of an expression.

    The exponent must be an integer from 1 to 100; for an absolute value, any number in (0, 100].

    Raises
    ------
    ModelError
        If the exponent is out of range, or a constant power overflows.
    """
    if base.operation == "abs":
        if not 0 < exponent <= MAX_POWER:
            raise ModelError(f"the power {exponent:g} of {base} is not in (0, {MAX_POWER}]; choose another")
    elif not 1 <= exponent <= MAX_POWER:
        raise ModelError(
            f"the power {exponent:g} of {base} is not in [1, {MAX_POWER}]; give a quotient of signals as a signal of "
            "the run"
        )
    elif not float(exponent).is_integer():
        raise ModelError(f"the power {exponent:g} of {base} is not a whole number; write abs({base})^{exponent:g}")
    if base.operation == "constant":
        try:
            return constant(base.value ** int(exponent))
        except OverflowError:
            raise ModelError(f"the power {exponent:g} of {base} overflows; give a smaller one") from None
    return base if exponent == 1 else Expression("power", (base,), float(exponent))


def apply(function: str, argument: Expression) -> Expression:
    """Return a function, such as ``sin``, of an expression.

    Raises
    ------
    ModelError
        If the function is unknown, or its value for a constant argument is not finite.
    """
    if function not in EXPRESSION_FUNCTIONS:
        raise ModelError(f"{function}(…) is unknown; use {', '.join(EXPRESSION_FUNCTIONS)}")
    if argument.operation == "constant":
        with np.errstate(all="ignore"):
            value = float(EXPRESSION_FUNCTIONS[function][0](argument.value))
        if not math.isfinite(value):
            raise ModelError(f"{function}({argument}) is {value}, which is not finite; give another argument")
        return constant(value)
    return Expression(function, (argument,))  # type: ignore[arg-type]
