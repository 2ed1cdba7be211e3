"""Equations of fractional order in words and objects, model structures, identified models and their files."""

from __future__ import annotations

import ast
import difflib
import math
import os
import re
import stat
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import msgspec

from ftlm.checks import real_number, whole_number
from ftlm.errors import DataError, ModelError

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import ArrayLike, NDArray

    from ftlm.frequency import Stability
    from ftlm.residuals import Residuals
    from ftlm.runs import Run
    from ftlm.validation import Comparison

    Floats = NDArray[np.float64]
    Complex = NDArray[np.complex128]

__all__ = [
    "Equation",
    "Estimate",
    "Model",
    "Order",
    "SensorFilter",
    "Structure",
    "Term",
    "equation",
    "load_model",
    "write_atomically",
]

MAX_ORDER = 3.0
#: Largest model file read: a model is a few kilobytes.
MAX_MODEL_BYTES = 1 << 20
SCHEMA = 2
NAME = r"[^\W\d]\w*"
Initial: TypeAlias = Literal["auto", "rest", "caputo"] | tuple[float, ...]
#: What a person writes for the values of an order, see :func:`parse_values`.
Values: TypeAlias = float | str | Iterable[float]


# ------------------------------------------------------------------------------------------------ orders


@dataclass(frozen=True)
class Order:
    """An order: a number, or an affine function of named free orders.

    Parameters
    ----------
    constant
        Constant part.
    weights
        Weight of each free order, by name, as sorted pairs without zeros.
    """

    constant: float = 0.0
    weights: tuple[tuple[str, float], ...] = ()

    @classmethod
    def parse(cls, text: str | float) -> Order:
        """Read ``0.5``, ``"alpha"`` or an affine expression such as ``"alpha1 - alpha2 + 2*mu2"``.

        Raises
        ------
        ModelError
            Anything that is not affine in its names.
        """
        if isinstance(text, (int, float)) and not isinstance(text, bool):
            return cls(float(text))
        try:
            tree = ast.parse(str(text).strip(), mode="eval").body
            constant, weights = _affine(tree)
        except (SyntaxError, ValueError, OverflowError, RecursionError, MemoryError) as error:
            shown = f"{text!r}"
            shown = shown if len(shown) <= 60 else f"{shown[:60]}…"
            raise ModelError(
                f"order {shown} is neither a number nor a sum of named orders; write 0.5, alpha or alpha1-mu2+0.1"
            ) from error
        # A plain number is judged where its range is known.
        if weights and not all(map(math.isfinite, (constant, *weights.values()))):
            raise ModelError(
                f"order {text!r:.60} holds a number that is not finite; write 0.5, alpha or alpha1-mu2+0.1"
            )
        return cls(constant, tuple(sorted((n, w) for n, w in weights.items() if w)))

    @property
    def names(self) -> tuple[str, ...]:
        """Free orders that this one depends on."""
        return tuple(name for name, _ in self.weights)

    @property
    def is_single(self) -> bool:
        """Whether this is one free order and nothing else."""
        return self.constant == 0 and len(self.weights) == 1 and self.weights[0][1] == 1

    def at(self, values: Mapping[str, float]) -> float:
        """Value at given free orders, rounded to 1e-9.

        Raises
        ------
        ModelError
            A free order without a value.
        """
        try:
            return round(self.constant + sum(w * values[n] for n, w in self.weights), 9) + 0.0
        except KeyError as error:
            raise ModelError(f"order {error.args[0]} has no value; give it in orders=") from None

    def __str__(self) -> str:
        parts = [f"{'-' if w < 0 else '+'}{'' if abs(w) == 1 else f'{shortest(abs(w))}*'}{n}" for n, w in self.weights]
        if self.constant or not parts:
            parts.append(f"{'-' if self.constant < 0 else '+'}{shortest(abs(self.constant))}")
        return "".join(parts).removeprefix("+")


def shortest(value: float) -> str:
    """Write a number in six digits if that is what it is, else in as many as give it back."""
    short = f"{value:g}"
    return short if float(short) == value else repr(value)


def _affine(node: ast.expr) -> tuple[float, dict[str, float]]:
    """Constant and weights of an affine expression; ValueError for anything else."""
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            return float(value), {}
        case ast.Name(id=name):
            return 0.0, {name: 1.0}
        case ast.UnaryOp(op=ast.USub() | ast.UAdd() as sign, operand=operand):
            factor = -1.0 if isinstance(sign, ast.USub) else 1.0
            constant, weights = _affine(operand)
            return factor * constant, {n: factor * w for n, w in weights.items()}
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub() as sign, right=right):
            factor = -1.0 if isinstance(sign, ast.Sub) else 1.0
            c1, w1 = _affine(left)
            c2, w2 = _affine(right)
            return c1 + factor * c2, {n: w1.get(n, 0) + factor * w2.get(n, 0) for n in {**w1, **w2}}
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            c1, w1 = _affine(left)
            c2, w2 = _affine(right)
            if w1 and w2:
                raise ValueError("product of orders")
            return c1 * c2, {n: w * (c2 if w1 else c1) for n, w in {**w1, **w2}.items()}
        case ast.BinOp(left=left, op=ast.Div(), right=ast.Constant(value=int() | float() as value)) if value:
            constant, weights = _affine(left)
            return constant / value, {n: w / value for n, w in weights.items()}
    raise ValueError("not affine")


def parse_values(name: str, spec: Values) -> float | tuple[float, ...]:
    """Values of one order: a number, ``"low:high:step"``, a tuple (low, high, step) or a list of numbers.

    Returns
    -------
    float or tuple of float
        A number if the order is fixed, else its values in ascending order.

    Raises
    ------
    ModelError
        A specification that is none of these, or an empty one.
    """
    if isinstance(spec, str):
        parts = spec.split(":")
        try:
            numbers = [float(p) for p in parts]
        except ValueError:
            raise ModelError(
                f"order {name}: {spec!r} is no interval; write LOW:HIGH:STEP such as 0.5:1.5:0.05"
            ) from None
        if len(numbers) == 1:
            return _checked(name, numbers[0])
        if len(numbers) != 3:
            raise ModelError(f"order {name}: {spec!r} has {len(numbers)} parts; write LOW:HIGH:STEP")
        return grid(name, *numbers)
    if isinstance(spec, (int, float)):
        return _checked(name, real_number(f"order {name}", spec))
    if isinstance(spec, tuple) and len(spec) == 2:
        raise ModelError(f"order {name}: {spec!r} has no step; write (low, high, step), or a list for two values")
    try:
        numbers = [real_number(f"order {name}", v) for v in spec]
    except TypeError:
        raise ModelError(f"order {name}: {spec!r} is no list of numbers; write LOW:HIGH:STEP or numbers") from None
    if isinstance(spec, tuple) and len(spec) == 3:
        return grid(name, *numbers)
    values = [_checked(name, v) for v in numbers]
    if not values:
        raise ModelError(f"order {name} has no value; give at least one")
    return tuple(sorted(set(values)))


def _checked(name: str, value: float) -> float:
    if not (math.isfinite(value) and abs(value) <= MAX_ORDER):
        raise ModelError(f"order {name} = {value:g} is outside [-3, 3]; choose another value")
    return value


#: Most values on one axis of a lattice: a step of 1e-6 over the widest interval is a slip of the hand.
MAX_AXIS = 1_000_000


def grid(name: str, low: float, high: float, step: float) -> tuple[float, ...]:
    """Multiples of ``step`` from ``low`` to ``high``, both included, counted from ``low``.

    Raises
    ------
    ModelError
        A step that is not positive, an interval that is empty or outside [-3, 3], more than a million values.
    """
    low, high, step = (real_number(f"order {name}", v) for v in (low, high, step))
    if not (math.isfinite(step) and step > 0):
        raise ModelError(f"order {name}: step {step:g} is not positive; the paper's is 0.05")
    _checked(name, low)
    _checked(name, high)
    if high < low:
        raise ModelError(f"order {name}: interval {low:g}:{high:g} is empty; put the lower end first")
    steps = (high - low) / step
    if steps > MAX_AXIS:
        raise ModelError(
            f"order {name}: {low:g}:{high:g}:{step:g} has {steps:.3g} values, more than {MAX_AXIS}; raise the step"
        )
    return tuple(round(low + i * step, 9) + 0.0 for i in range(int(steps + 1e-6) + 1))


# ------------------------------------------------------------------------------------------------ equations


@dataclass(frozen=True)
class Term:
    """One term ``factor * coefficient * D^order signal`` of a right-hand side.

    Parameters
    ----------
    signal
        Name of the signal.
    order
        Its order.
    coefficient
        Name of a free coefficient, or its value.
    factor
        Known factor of the coefficient, such as a sign.
    name
        Name that the coefficient had before it got its value.
    """

    signal: str
    order: Order
    coefficient: str | float
    factor: float = 1.0
    name: str | None = None

    @property
    def fixed(self) -> float | None:
        """Value of factor * coefficient, if it is known."""
        return None if isinstance(self.coefficient, str) else self.factor * self.coefficient

    def __str__(self) -> str:
        if isinstance(self.coefficient, str):
            factor = "" if self.factor == 1 else "-" if self.factor == -1 else f"{self.factor!r} "
            text = f"{factor}{self.coefficient} "
        else:
            text = f"{self.factor * self.coefficient!r} "
        return text + _derivative(self.order, self.signal)


def _derivative(order: Order, signal: str) -> str:
    if not order.names and order.constant == 0:
        return signal
    text = str(order)
    plain = re.fullmatch(r"[\w.]+", text)
    return f"D^{text if plain else f'({text})'} {signal}"


@dataclass(frozen=True)
class Equation:
    """D^order output = sum of terms.

    Parameters
    ----------
    output
        Name of the output.
    order
        Highest order, alpha.
    terms
        Right-hand side.
    """

    output: str
    order: Order
    terms: tuple[Term, ...]

    def __post_init__(self) -> None:
        if not self.terms:
            raise ModelError(f"the equation of {self.output} has no term; add at least one")
        names = [t.coefficient for t in self.terms if isinstance(t.coefficient, str)]
        twice = next((n for i, n in enumerate(names) if n in names[:i]), None)
        if twice is not None:
            raise ModelError(
                f"coefficient {twice} stands twice in the equation of {self.output}; give each its own name"
            )
        both = set(names) & set(self.order_names)
        if both:
            raise ModelError(f"{min(both)} names an order and a coefficient; rename one")
        if not self.order.names and not 0 < self.order.constant <= MAX_ORDER:
            raise ModelError(
                f"order alpha = {self.order.constant:g} of {self.output} is outside (0, 3]; choose another"
            )
        for term in self.terms:
            if term.factor == 0 or not math.isfinite(term.factor):
                raise ModelError(
                    f"factor {term.factor:g} of {term.coefficient} {term.signal} in the equation of {self.output} "
                    "leaves nothing to estimate; give a finite number other than 0"
                )
            if term.fixed is not None and not math.isfinite(term.fixed):
                raise ModelError(
                    f"coefficient of {term.signal} in the equation of {self.output} is {term.fixed:g}, which is not "
                    "finite; give a number"
                )
            if term.order.names or self.order.names:
                continue
            own, alpha, order = term.signal == self.output, self.order.constant, term.order.constant
            if own and not 0 <= order < alpha:
                raise ModelError(f"own-output order {order:g} of {self.output} is outside [0, {alpha:g}); lower it")
            if not own and not -MAX_ORDER <= order <= alpha:
                raise ModelError(f"order {order:g} of {term.signal} is above alpha = {alpha:g}; lower it")

    @property
    def signals(self) -> tuple[str, ...]:
        """Output first, then the other signals in order of appearance."""
        return tuple(dict.fromkeys([self.output, *(t.signal for t in self.terms)]))

    @property
    def order_names(self) -> tuple[str, ...]:
        """Free orders in order of appearance."""
        return tuple(dict.fromkeys(n for o in (self.order, *(t.order for t in self.terms)) for n in o.names))

    @property
    def coefficient_names(self) -> tuple[str, ...]:
        """Free coefficients in order of appearance."""
        return tuple(t.coefficient for t in self.terms if isinstance(t.coefficient, str))

    def with_orders(self, values: Mapping[str, float]) -> Equation:
        """Return the equation with these free orders replaced by values; others stay free.

        Raises
        ------
        ModelError
            Orders out of range once they are numbers.
        """

        def put(order: Order) -> Order:
            constant = order.constant + sum(w * values[n] for n, w in order.weights if n in values)
            return Order(round(constant, 9) + 0.0, tuple((n, w) for n, w in order.weights if n not in values))

        terms = tuple(replace(t, order=put(t.order)) for t in self.terms)
        return Equation(self.output, put(self.order), terms)

    def with_coefficients(self, values: Mapping[str, float]) -> Equation:
        """Return the equation with these free coefficients replaced by values; others stay free.

        Raises
        ------
        ModelError
            A value that is no finite number.
        """
        terms = tuple(
            replace(t, coefficient=real_number(t.coefficient, values[t.coefficient]), name=t.coefficient)
            if isinstance(t.coefficient, str) and t.coefficient in values
            else t
            for t in self.terms
        )
        return Equation(self.output, self.order, terms)

    @property
    def is_identified(self) -> bool:
        """Whether every order and every coefficient is a number."""
        return not self.order_names and not self.coefficient_names

    def __str__(self) -> str:
        right = " + ".join(str(t) for t in self.terms).replace("+ -", "- ")
        return f"{_derivative(self.order, self.output)} = {right}"


def equation(
    text: str,
    *,
    orders: Mapping[str, Values] | None = None,
    fixed: Mapping[str, float] | None = None,
    delay: Mapping[str, float | tuple[float, float]] | None = None,
    initial: str | Iterable[float] = "auto",
    sensor_filter: SensorFilter | None = None,
) -> Structure:
    """Any linear fractional equation, in words.

    Parameters
    ----------
    text
        Such as ``"D^2.2 y = a1 D^0.9 y + a0 y + b0 u"``. ``D^alpha`` names a free order, ``D^(alpha-mu)`` an order
        law, ``D`` and ``D y`` the first derivative; a coefficient is a name, a number (fixed) or a number times a
        name. Several equations are separated by ``;`` or by lines.
    orders
        Values of the free orders: a number fixes one, ``"0.5:1.5:0.05"`` or (low, high, step) gives its lattice.
    fixed
        Known coefficients, by name.
    delay
        Delay of inputs [s], by name, not negative: a number is known, (least, largest) is estimated by output error.
    initial
        Initial terms: ``"auto"`` (Caputo's if the record does not start at rest), ``"rest"``, ``"caputo"``, or the
        exponents of t to use.
    sensor_filter
        Known filter that some outputs went through.

    Returns
    -------
    Structure
        To be identified, or a model's structure if nothing is free.

    Raises
    ------
    ModelError
        Text that is no such equation (with the place), a name that does not occur, orders out of range.
    """
    if not isinstance(text, str):
        raise ModelError(f"the equation is {type(text).__name__}, not text; write it as in 'D^1.5 y = a0 y + b0 u'")
    lines = [line for line in re.split(r"[;\n]", text) if line.strip()]
    if not lines:
        raise ModelError("the equation is empty; write it as in 'D^1.5 y = a0 y + b0 u'")
    equations = [parse_equation(line) for line in lines]
    fixed = dict(fixed or {})
    _known("fixed coefficient", fixed, [n for e in equations for n in e.coefficient_names])
    for name, value in fixed.items():
        if not math.isfinite(real_number(f"fixed coefficient {name}", value)):
            raise ModelError(f"fixed coefficient {name} = {value} is not finite; give a number")
    equations = [e.with_coefficients(fixed) for e in equations]
    return (
        Structure(equations=tuple(equations), initial=check_initial(initial), sensor_filter=sensor_filter)
        .with_delays(delay or {})
        .with_orders(orders or {})
    )


def _known(what: str, given: Iterable[str], known: Sequence[str]) -> None:
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(str(name), known, 1)
            hint = f"did you mean {near[0]}?" if near else f"known: {', '.join(dict.fromkeys(known)) or 'none'}"
            raise ModelError(f"{what} {name!r} does not occur in the equation; {hint}")


_TOKEN = re.compile(
    rf"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>{NAME})|(?P<symbol>[-+*/^(){{}}=]))"
)


class _Words:
    """Tokens of one equation, with the place of each for messages."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.tokens: list[tuple[str, str, int]] = []
        at = 0
        while text[at:].strip():
            found = _TOKEN.match(text, at)
            if found is None:
                start = at + len(text[at:]) - len(text[at:].lstrip())
                raise ModelError(f"equation {text!r}: {text[start]!r} at character {start + 1} has no meaning there")
            kind = str(found.lastgroup)
            self.tokens.append((kind, found[kind], found.start(kind)))
            at = found.end()
        self.position = 0

    def peek(self, ahead: int = 0) -> tuple[str, str, int]:
        index = self.position + ahead
        return self.tokens[index] if index < len(self.tokens) else ("end", "the end", len(self.text))

    def take(self) -> tuple[str, str, int]:
        token = self.peek()
        self.position += 1
        return token

    def order(self, text: str, at: int) -> Order:
        try:
            return Order.parse(text)
        except ModelError as error:
            raise ModelError(f"equation {self.text!r}: at character {at + 1}: {error}") from error

    def fail(self, wanted: str) -> ModelError:
        _, value, at = self.peek()
        return ModelError(
            f"equation {self.text!r}: expected {wanted} at character {at + 1}, found {value!r}; "
            "write it as in 'D^1.5 y = a1 D^0.5 y + a0 y + b0 u'"
        )


def parse_equation(text: str) -> Equation:
    """Read one equation; see :func:`equation`.

    Raises
    ------
    ModelError
        With the character at which the text stops being an equation.
    """
    words = _Words(text)
    order, output = _parse_derivative(words)
    if words.take()[1] != "=":
        words.position -= 1
        raise words.fail("'='")
    if order is None:
        raise ModelError(
            f"equation {text!r}: its left-hand side has no derivative; write it as in 'D^1.5 {output} = …'"
        )
    terms = []
    while True:
        sign = 1.0
        while words.peek()[1] in "+-" and words.peek()[0] == "symbol":
            sign *= -1.0 if words.take()[1] == "-" else 1.0
        terms.append(_parse_term(words, sign))
        kind, value, _ = words.peek()
        if kind == "end":
            break
        if not (kind == "symbol" and value in "+-"):
            raise words.fail("'+', '-' or the end")
    return Equation(output, order, tuple(terms))


def _parse_derivative(words: _Words) -> tuple[Order | None, str]:
    """``D^order signal`` or ``signal``."""
    kind, value, _ = words.peek()
    order: Order | None = None
    if kind == "name" and value == "D":
        words.take()
        order = Order(1.0)
        if words.peek()[1] == "^":
            words.take()
            order = _parse_order(words)
    kind, value, _ = words.peek()
    if kind != "name" or value == "D":
        raise words.fail("the name of a signal")
    words.take()
    return order, value


def _parse_order(words: _Words) -> Order:
    kind, value, start = words.peek()
    if value in "({" and kind == "symbol":
        close = ")" if value == "(" else "}"
        words.take()
        depth, begin = 1, start + 1
        while depth:
            kind, token, at = words.take()
            if kind == "end":
                words.position -= 1
                raise words.fail(f"'{close}'")
            depth += token in "({" and kind == "symbol"
            depth -= token in ")}" and kind == "symbol"
        return words.order(words.text[begin:at], begin)
    sign = ""
    if value == "-" and kind == "symbol":
        sign = words.take()[1]
        kind, value, _ = words.peek()
    if kind not in ("number", "name"):
        raise words.fail("an order: a number, a name or (…)")
    words.take()
    return words.order(sign + value, start)


def _parse_term(words: _Words, sign: float) -> Term:
    factor = sign
    if words.peek()[0] == "number":
        factor *= float(words.take()[1])
        if words.peek()[1] == "*":
            words.take()
    coefficient: str | float = 1.0
    kind, value, _ = words.peek()
    following = words.peek(1)
    # A name is a coefficient if a signal or a derivative follows it.
    if kind == "name" and value != "D" and (following[0] == "name" or following[1] == "*"):
        coefficient = value
        words.take()
        if words.peek()[1] == "*":
            words.take()
    order, signal = _parse_derivative(words)
    if coefficient == 1.0:
        return Term(signal, order or Order(), factor, 1.0)
    return Term(signal, order or Order(), coefficient, factor)


# ------------------------------------------------------------------------------------------------ structures


class SensorFilter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A known rational filter that some measured outputs went through.

    Parameters
    ----------
    outputs
        Names of the outputs that are measured through it.
    numerator, denominator
        (coefficient, order) pairs of sums of coefficient * D^order.
    """

    outputs: tuple[str, ...]
    numerator: tuple[tuple[float, float], ...]
    denominator: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        """Refuse a filter that is none.

        Raises
        ------
        ModelError
            A number that is not finite, an order outside [0, 3], a denominator without a term, a numerator of a
            higher order than the denominator.
        """
        for part, terms in (("numerator", self.numerator), ("denominator", self.denominator)):
            for coefficient, order in terms:
                if not (math.isfinite(coefficient) and 0 <= order <= MAX_ORDER):
                    raise ModelError(
                        f"sensor filter: {coefficient:g} D^{order:g} in its {part} is no term; give a finite "
                        "coefficient and an order in [0, 3]"
                    )
        highest = max((order for coefficient, order in self.denominator if coefficient), default=None)
        if highest is None:
            raise ModelError("sensor filter: its denominator has no term; give at least one")
        improper = next((order for _, order in self.numerator if order > highest), None)
        if improper is not None:
            raise ModelError(
                f"sensor filter: order {improper:g} of its numerator is above {highest:g}, the highest of its "
                "denominator; a filter that can be built is proper"
            )

    @classmethod
    def low_pass(cls, outputs: Sequence[str], frequency: float = 2.0, damping: float = 0.9) -> SensorFilter:
        """Second-order low-pass of ``frequency`` [Hz]; the default is that of the arm's stock real-time model."""
        omega = 2 * math.pi * frequency
        return cls(tuple(outputs), ((omega**2, 0.0),), ((1.0, 2.0), (2 * damping * omega, 1.0), (omega**2, 0.0)))


def check_initial(initial: str | Iterable[float]) -> Initial:
    """Refuse initial terms that are neither a known word nor exponents above -1.

    Raises
    ------
    ModelError
        With what is allowed.
    """
    if isinstance(initial, str):
        if initial in ("auto", "rest", "caputo"):
            return initial  # type: ignore[return-value]
        raise ModelError(f"initial = {initial!r} is not known; use 'auto', 'rest', 'caputo' or exponents of t")
    try:
        exponents = tuple(real_number("exponent of an initial term", e) for e in initial)
    except TypeError:
        raise ModelError(
            f"initial = {initial!r} is not known; use 'auto', 'rest', 'caputo' or exponents of t"
        ) from None
    bad = next((e for e in exponents if not (math.isfinite(e) and -1 < e <= 10)), None)
    if bad is not None:
        raise ModelError(f"exponent {bad:g} of an initial term is outside (-1, 10]; t to this power is of no use")
    return exponents


@dataclass(frozen=True)
class Structure:
    """Equations over shared signals, with what is known about them; some orders or coefficients may be free.

    Parameters
    ----------
    equations
        One for each output that is modelled.
    order_values
        Lattice of free orders that have one: their values, ascending.
    coupling
        ``"measured"``: each equation is driven by the measured other outputs. ``"simulated"``: all outputs follow
        together from the inputs alone.
    delay
        Known delay of inputs [s].
    free_delays
        Least and largest delay of inputs whose delay is to be estimated [s].
    initial
        Initial terms, see :func:`equation`.
    sensor_filter
        Known filter that some outputs were measured through.
    coefficient_law
        Optional law that ties the coefficients: (name, sign, factors) with coefficient = sign * product of factors.
    reference
        Coefficients by name as the maker of the machine states them, to be set beside estimates.
    name
        What this is.
    """

    equations: tuple[Equation, ...]
    order_values: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    coupling: Literal["measured", "simulated"] = "measured"
    delay: Mapping[str, float] = field(default_factory=dict)
    free_delays: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    initial: Initial = "auto"
    sensor_filter: SensorFilter | None = None
    coefficient_law: tuple[tuple[str, float, tuple[str, ...]], ...] = ()
    reference: Mapping[str, float] = field(default_factory=dict)
    name: str = "equation"

    def __post_init__(self) -> None:
        if not self.equations:
            raise ModelError("a model needs at least one equation")
        outputs = [e.output for e in self.equations]
        twice = next((o for i, o in enumerate(outputs) if o in outputs[:i]), None)
        if twice is not None:
            raise ModelError(f"two equations have the output {twice}; give each output one equation")
        if self.coupling not in ("measured", "simulated"):
            raise ModelError(f"coupling = {self.coupling!r} is not known; use 'measured' or 'simulated'")
        names = [n for e in self.equations for n in e.coefficient_names]
        twice = next((n for i, n in enumerate(names) if n in names[:i]), None)
        if twice is not None:
            raise ModelError(f"coefficient {twice} stands in two equations; give each its own name")
        external = [s for s in self.signals if s not in outputs]
        _known("delayed input", [*self.delay, *self.free_delays], external)
        for name, delay in self.delay.items():
            if not 0 <= real_number(f"delay of {name}", delay) < math.inf:
                raise ModelError(f"delay of {name} = {delay} s is not a non-negative number; give seconds")
        for name, (low, high) in self.free_delays.items():
            numbers = real_number(f"least delay of {name}", low), real_number(f"largest delay of {name}", high)
            if not 0 <= numbers[0] < numbers[1] < math.inf:
                raise ModelError(f"delay of {name} from {low} to {high} s is no interval; give two rising times from 0")
            if delay_name(name) in names or delay_name(name) in self.order_names:
                raise ModelError(f"{delay_name(name)} is the delay of {name}; call the coefficient otherwise")
        if self.sensor_filter is not None:
            _known("filtered output", self.sensor_filter.outputs, self.signals)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Modelled outputs, one an equation."""
        return tuple(e.output for e in self.equations)

    @property
    def signals(self) -> tuple[str, ...]:
        """Outputs first, then every other signal."""
        return tuple(dict.fromkeys([e.output for e in self.equations] + [s for e in self.equations for s in e.signals]))

    @property
    def order_names(self) -> tuple[str, ...]:
        """Free orders: those that stand alone in order of appearance, then those seen only through a law."""
        orders = [o for e in self.equations for o in (e.order, *(t.order for t in e.terms))]
        alone = [o.names[0] for o in orders if o.is_single]
        return tuple(dict.fromkeys([*alone, *(n for o in orders for n in o.names)]))

    @property
    def coefficient_names(self) -> tuple[str, ...]:
        """Free coefficients."""
        return tuple(n for e in self.equations for n in e.coefficient_names)

    @property
    def has_order_law(self) -> bool:
        """Whether orders depend on one another: one is no plain name, or two are the same."""
        orders = [o for e in self.equations for o in (e.order, *(t.order for t in e.terms)) if o.names]
        names = [o.names[0] for o in orders]
        return any(not o.is_single for o in orders) or len(set(names)) < len(names)

    def parts(self) -> dict[str, Structure]:
        """What an order search takes one by one: equations that share no free order do not wait for one another.

        Equations that an order law ties stay together, as ``"stage"`` where that is all of the structure, else under
        the names of their outputs; any other equation is by itself, with measured coupling. Equations without free
        orders are left out.
        """
        groups: list[tuple[set[str], list[Equation]]] = []
        for item in self.equations:
            names, together = set(item.order_names), [item]
            for group in [g for g in groups if g[0] & names]:
                names |= group[0]
                together = group[1] + together
                groups.remove(group)
            groups.append((names, together))
        out = {}
        for names, together in groups:
            single = len(together) == 1
            if not names:
                continue
            if single and not replace(self, equations=tuple(together), coefficient_law=()).has_order_law:
                out[together[0].output] = self.equation(together[0].output)
                continue
            if len(together) == len(self.equations):
                return {"stage": self}
            kept = replace(
                self,
                equations=tuple(together),
                order_values={n: v for n, v in self.order_values.items() if n in names},
                delay={},
                free_delays={},
                sensor_filter=None,
                coefficient_law=(),
            )
            out[", ".join(e.output for e in together)] = replace(
                kept,
                delay={n: v for n, v in self.delay.items() if n in kept.signals},
                free_delays={n: v for n, v in self.free_delays.items() if n in kept.signals},
                sensor_filter=_narrowed(self.sensor_filter, kept.signals),
                name=f"{self.name}, {', '.join(kept.outputs)}",
            )
        return out

    def equation(self, output: str) -> Structure:
        """One equation of this structure alone, with measured coupling and free of order laws.

        An order that a law would give becomes a free order of its own, named after its term; the order of an input
        becomes 0 unless it is a number already.

        Raises
        ------
        ModelError
            No such output.
        """
        _known("output", [output], self.outputs)
        found = next(e for e in self.equations if e.output == output)
        modelled = [s for e in self.equations for s in e.signals if s in self.outputs]

        def freed(k: int, term: Term) -> Term:
            if term.order.is_single or not term.order.names:
                return term
            if term.signal not in modelled:
                return replace(term, order=Order())
            paper = ORDER_OF_COEFFICIENT.match(str(term.coefficient))
            name = {"a": "beta", "b": "gamma", "d": "mu"}[paper[1]] + paper[2] if paper else f"nu_{output}_{k + 1}"
            return replace(term, order=Order(0.0, ((name, 1.0),)))

        single = replace(found, terms=tuple(freed(k, t) for k, t in enumerate(found.terms)))
        return replace(
            self,
            equations=(single,),
            order_values={n: v for n, v in self.order_values.items() if n in single.order_names},
            coupling="measured",
            delay={n: v for n, v in self.delay.items() if n in single.signals},
            free_delays={n: v for n, v in self.free_delays.items() if n in single.signals},
            sensor_filter=_narrowed(self.sensor_filter, single.signals),
            coefficient_law=(),
            name=f"{self.name}, {output}",
        )

    def with_orders(self, orders: Mapping[str, Values]) -> Structure:
        """Fix free orders (a number) or give them a lattice (see :func:`parse_values`).

        Raises
        ------
        ModelError
            A name that is no free order, or values out of range.
        """
        _known("order", orders, self.order_names)
        numbers: dict[str, float] = {}
        lattices = dict(self.order_values)
        for name, spec in orders.items():
            values = parse_values(name, spec)
            if isinstance(values, float):
                numbers[name] = values
            else:
                lattices[name] = values
        equations = tuple(e.with_orders(numbers) for e in self.equations)
        return replace(self, equations=equations, order_values={n: v for n, v in lattices.items() if n not in numbers})

    def with_coefficients(self, values: Mapping[str, float]) -> Structure:
        """Fix free coefficients.

        Raises
        ------
        ModelError
            A name that is no free coefficient.
        """
        _known("coefficient", values, self.coefficient_names)
        return replace(self, equations=tuple(e.with_coefficients(values) for e in self.equations))

    def with_delays(self, delays: Mapping[str, float | tuple[float, float]]) -> Structure:
        """Set delays of inputs [s]: a number is known, (least, largest) is to be estimated.

        Raises
        ------
        ModelError
            A name that is no input, a delay that is negative, or no interval.
        """
        known, free = dict(self.delay), dict(self.free_delays)
        for name, delay in delays.items():
            known.pop(name, None)
            free.pop(name, None)
            if isinstance(delay, (tuple, list)):
                if len(delay) != 2:
                    raise ModelError(f"delay of {name} = {delay!r} is neither a number nor (least, largest) [s]")
                free[name] = (delay[0], delay[1])
            else:
                known[name] = delay
        return replace(self, delay=known, free_delays=free)

    def __str__(self) -> str:
        return "\n".join(str(e) for e in self.equations)

    def _repr_html_(self) -> str:
        from html import escape  # noqa: PLC0415 — only notebooks need it

        return f"<pre>{escape(str(self))}</pre>"


def delay_name(signal: str) -> str:
    """Name under which the estimated delay of an input stands among the parameters."""
    return f"delay_{signal}"


ORDER_OF_COEFFICIENT = re.compile(r"^([abd])(\d+)$")


def _narrowed(sensor: SensorFilter | None, signals: Sequence[str]) -> SensorFilter | None:
    if sensor is None:
        return None
    outputs = tuple(o for o in sensor.outputs if o in signals)
    return SensorFilter(outputs, sensor.numerator, sensor.denominator) if outputs else None


# ------------------------------------------------------------------------------------------------ models


class Estimate(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is known about how a model was identified, kept with it so that a report needs no other file.

    Parameters
    ----------
    method
        Estimator.
    runs
        Names of the runs.
    values, standard_errors
        Orders and coefficients by name as they were estimated, and their standard errors where there are any.
    covariance
        Of every number of the model in the order of its equations (alpha, then order and coefficient of each term);
        None where the estimator gives none. It may be singular: laws tie numbers.
    fit
        Fit of the free run on these runs in percent, by output.
    information
        Information criteria, where known.
    warnings
        What makes the model doubtful, in words.
    """

    method: str
    runs: tuple[str, ...]
    values: dict[str, float]
    standard_errors: dict[str, float | None] = {}
    covariance: tuple[tuple[float, ...], ...] | None = None
    fit: dict[str, float | None] = {}
    information: dict[str, float | None] = {}
    warnings: tuple[str, ...] = ()


class _TermFile(msgspec.Struct, forbid_unknown_fields=True):
    signal: str
    order: float
    coefficient: float
    factor: float = 1.0
    name: str | None = None


class _EquationFile(msgspec.Struct, forbid_unknown_fields=True):
    output: str
    order: float
    terms: list[_TermFile]


class _ModelFile(msgspec.Struct, forbid_unknown_fields=True):
    format: Literal["ftlm-model"]
    schema: int
    name: str
    equations: list[_EquationFile]
    coupling: Literal["measured", "simulated"]
    delay: dict[str, float]
    initial: str | list[float]
    sensor_filter: SensorFilter | None
    units: dict[str, str]
    orders: dict[str, float]
    m: int | None
    about: dict[str, str | float | int | bool | None]
    estimate: Estimate | None = None


@dataclass(frozen=True)
class Model:
    """A structure whose orders and coefficients are numbers.

    Parameters
    ----------
    structure
        The structure, nothing free.
    orders
        Free orders by name, as they were found.
    units
        SI units of the signals, where known.
    m
        Number of block pulses on which the model was identified and is compared by default.
    about
        How the model came to be, for people.
    estimate
        Standard errors, covariance and warnings of the identification; None for a model that was written down.
    """

    structure: Structure
    orders: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    m: int | None = None
    about: Mapping[str, str | float | int | bool | None] = field(default_factory=dict)
    estimate: Estimate | None = None

    def __post_init__(self) -> None:
        if self.m is not None and not 1 <= (whole_number(self.m) or 0) < 1 << 62:
            raise ModelError(f"m = {self.m!r} is no number of pulses; give a whole number, at least 1")
        if self.structure.free_delays:
            late = ", ".join(self.structure.free_delays)
            raise ModelError(f"the delay of {late} is still free; identify it first, or set it by with_delays")
        for item in self.structure.equations:
            if not item.is_identified:
                free = [*item.order_names, *item.coefficient_names]
                raise ModelError(f"the equation of {item.output} still has free {', '.join(free)}; identify it first")
            for k, term in enumerate(item.terms):
                if not math.isfinite(float(term.coefficient)):
                    raise ModelError(f"coefficient {k} of {item.output} is not finite; the model cannot be used")

    @property
    def coefficients(self) -> dict[str, float]:
        """Coefficients by name."""
        return {t.name: float(t.coefficient) for e in self.equations for t in e.terms if t.name is not None}

    @property
    def equations(self) -> tuple[Equation, ...]:
        """The equations, all numbers."""
        return self.structure.equations

    @property
    def outputs(self) -> tuple[str, ...]:
        """Modelled outputs."""
        return self.structure.outputs

    def simulate(
        self,
        run: Run,
        *,
        tolerance: float = 1e-6,
        initial: Mapping[str, Mapping[float, float]] | None = None,
        largest_m: int = 1 << 21,
    ) -> Run:
        """Free run on a run's inputs; see :func:`ftlm.simulate`."""
        from ftlm.simulation import simulate  # noqa: PLC0415 — simulation reads models

        return simulate(self, run, tolerance=tolerance, initial=initial, largest_m=largest_m)

    def compare(self, runs: Run | Sequence[Run], *, m: int | None = None) -> Comparison:
        """Both errors on measured runs; see :func:`ftlm.compare`."""
        from ftlm.validation import compare  # noqa: PLC0415 — validation reads models

        return compare(self, runs, m=m)

    def resid(self, runs: Run | Sequence[Run], *, lags: int = 25) -> Residuals:
        """Whiteness of the residuals and their independence of the inputs; see :func:`ftlm.resid`."""
        from ftlm.residuals import resid  # noqa: PLC0415 — the tests read models

        return resid(self, runs, lags=lags)

    def frequency_response(self, w: ArrayLike, *, coupling: str = "simulated", sensor: bool = True) -> Complex:
        """Exact response at angular frequencies [rad/s], shape (outputs, inputs, W).

        See :func:`ftlm.frequency.frequency_response`.
        """
        from ftlm.frequency import frequency_response  # noqa: PLC0415 — reads models

        return frequency_response(self, w, coupling=coupling, sensor=sensor)

    def step_response(self, time: ArrayLike, *, tolerance: float = 1e-6) -> Floats:
        """Response to unit steps, shape (outputs, inputs, N); see :func:`ftlm.frequency.step_response`."""
        from ftlm.frequency import step_response  # noqa: PLC0415 — reads models

        return step_response(self, time, tolerance=tolerance)

    def stability(self, *, coupling: str = "simulated") -> Stability:
        """Whether the model is stable, and why not; see :func:`ftlm.frequency.stability`."""
        from ftlm.frequency import stability  # noqa: PLC0415 — reads models

        return stability(self, coupling=coupling)

    def is_stable(self, *, coupling: str = "simulated") -> bool:
        """Whether bounded inputs give bounded outputs; an integrator is not stable in this sense."""
        return self.stability(coupling=coupling).stable

    def poles(self, *, coupling: str = "simulated") -> Complex:
        """Poles of a model whose orders have a common base; see :func:`ftlm.frequency.poles`."""
        from ftlm.frequency import poles  # noqa: PLC0415 — reads models

        return poles(self, coupling=coupling)

    def to_control(self, *, band: tuple[float, float], order: int = 5) -> Any:
        """A python-control system by Oustaloup's approximation; see :func:`ftlm.exports.to_control`."""
        from ftlm.exports import to_control  # noqa: PLC0415 — reads models

        return to_control(self, band=band, order=order)

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> Path:
        """Write the model as JSON, atomically.

        Raises
        ------
        DataError
            The file exists and ``force`` is not set, or cannot be written.
        """
        data = msgspec.json.format(msgspec.json.encode(self._to_file()), indent=2)
        return write_atomically(path, data + b"\n", force=force)

    def _to_file(self) -> _ModelFile:
        s = self.structure
        equations = [
            _EquationFile(
                e.output,
                e.order.constant,
                [_TermFile(t.signal, t.order.constant, float(t.coefficient), t.factor, t.name) for t in e.terms],
            )
            for e in s.equations
        ]
        initial = s.initial if isinstance(s.initial, str) else list(s.initial)
        return _ModelFile(
            "ftlm-model", SCHEMA, s.name, equations, s.coupling, dict(s.delay), initial, s.sensor_filter,
            dict(self.units), dict(self.orders), self.m, dict(self.about), self.estimate,
        )  # fmt: skip

    def __str__(self) -> str:
        return "\n".join(numeric(e) for e in self.equations)

    def _repr_html_(self) -> str:
        from ftlm.report.notebook import model_html  # noqa: PLC0415 — only notebooks need it

        return model_html(self)


def numeric(item: Equation) -> str:
    """Write an identified equation with six significant digits."""
    parts = [f"{t.fixed or 0.0:+.6g} {_derivative(t.order, t.signal)}" for t in item.terms]
    right = " ".join(parts).removeprefix("+").replace(" +", " + ").replace(" -", " - ")
    return f"{_derivative(item.order, item.output)} = {right}"


def load_model(path: str | os.PathLike[str]) -> Model:
    """Read a model written by :meth:`Model.save`.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    Model
        The same to the last bit, without what is of use only before identification (lattices, laws, references).

    Raises
    ------
    DataError
        No such file, a file that is no model (with the place), one of a later schema, or one above 1 MiB.
    """
    file = Path(path)
    try:
        found = file.stat()
        if not stat.S_ISREG(found.st_mode):
            raise DataError(f"{file} is no regular file; give a file written by save()")
        if found.st_size > MAX_MODEL_BYTES:
            raise DataError(
                f"{file} has {found.st_size} bytes, no model is larger than {MAX_MODEL_BYTES}; give a model file"
            )
        read = msgspec.json.decode(file.read_bytes(), type=_ModelFile)
    except OSError as error:
        raise DataError(f"model {file} cannot be read: {error.strerror or error}; check the path") from error
    except DataError:
        raise
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise DataError(f"{file} is no ftlm model: {error}; give a file written by save()") from error
    if read.schema > SCHEMA or read.schema < 1:
        raise DataError(f"{file} has schema {read.schema}, this version reads up to {SCHEMA}; upgrade ftlm")
    try:
        structure = Structure(
            equations=tuple(_equation_of(e) for e in read.equations), coupling=read.coupling, delay=read.delay,
            initial=check_initial(read.initial), sensor_filter=read.sensor_filter, name=read.name,
        )  # fmt: skip
        _check_estimate(read)
        return Model(structure, read.orders, read.units, read.m, read.about, read.estimate)
    except ModelError as error:
        raise DataError(f"{file} holds no usable model: {error}") from error


def _check_estimate(read: _ModelFile) -> None:
    if read.estimate is None or read.estimate.covariance is None:
        return
    count = sum(1 + 2 * len(e.terms) for e in read.equations)
    rows = read.estimate.covariance
    if len(rows) != count or any(len(row) != count for row in rows):
        raise ModelError(f"its covariance is not of {count} by {count} numbers, as its equations need")


def _equation_of(item: _EquationFile) -> Equation:
    terms = tuple(Term(t.signal, Order(t.order), t.coefficient, t.factor, t.name) for t in item.terms)
    return Equation(item.output, Order(item.order), terms)


def write_atomically(path: str | os.PathLike[str], data: bytes, *, force: bool) -> Path:
    """Write beside, flush to disk, rename: a reader sees the old file or the new one.

    Raises
    ------
    DataError
        The file exists and ``force`` is not set, or the folder cannot be written.
    """
    file = Path(path)
    if os.path.lexists(file) and not force:
        raise DataError(f"{file} exists; choose another name, or overwrite it with force=True (--force)")
    try:
        handle, beside = tempfile.mkstemp(prefix=f".{file.name}.", dir=file.parent or Path())
        try:
            with os.fdopen(handle, "wb") as out:
                out.write(data)
                out.flush()
                os.fsync(out.fileno())
            umask = os.umask(0)
            os.umask(umask)
            Path(beside).chmod(0o666 & ~umask)
            Path(beside).replace(file)
        except BaseException:
            Path(beside).unlink(missing_ok=True)
            raise
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else None
        raise DataError(f"{file} cannot be written: {why or error}; choose another folder") from error
    return file
