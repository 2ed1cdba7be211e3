"""Recursive-descent parser of equation texts; syntax errors name the position.

Braces mark a repeated item, brackets an optional item, and a bar an alternative. A ``delay`` or ``limit`` is a number
or an interval ``low:high``. A ``strength`` or ``speed`` is a number or a name. An ``order`` is a number, a name or an
expression in parentheses. Blanks between names, numbers and symbols do not matter.

::

    equation    = sum "=" (sum | "0")  |  transfer
    sum         = {sign} item {sign {sign} item}      (a sign is + or -)
    item        = "c"  |  "(c + ramp t)"  |  "(c if significant)"  |  friction  |  term
                |  number ["*"] "(" sum ")" ["/" number]
    term        = {number ["*" | "/"]} [name ["*"]] (derivative | product | "D" ["^" order] group) ["/" number]
    derivative  = ["D" ["^" order]] signal  |  signal {"'"}  |  "dy/dt"  |  "d^2 y/dt^2"  |  "d/dt" signal
                (y or y(t); a power of d and dt is a whole number, a number or a name, the same in both)
    signal      = name {"'"} ["(t" [("-" | "+") delay ["s"]] ")"]
                |  "sat(" signal "," limit ")"  |  "dead(" signal "," limit ")"
    product     = power {"*" power}
    power       = (number | group | function group | derivative) ["^" number]
    group       = "(" {sign} product {sign {sign} product} ")"
    function    = "sin" | "cos" | "exp" | "tanh" | "abs" | "sqrt"
    friction    = [strength [*]] ["exp(-(D y/" speed ")^2)" [*]] "sign(D y)"      (or y', dy/dt for D y)
    transfer    = signal "=" {sign} path {sign path}  |  signal "/" signal "=" ratio
    path        = ratio signal  |  a ratio with a factor name "(s)"
    ratio       = factor {("*" | "/" | "") factor}
    factor      = number  |  name ["^" whole number]  |  "s" ["^" order]  |  "sqrt(s)"  |  "e^(-" delay "s)"
                |  "(" polynomial ")" ["^" whole number]
    polynomial  = {sign} product of factors and ["/" number] {sign product}
"""

from __future__ import annotations

import functools
import itertools
import re
from collections.abc import Collection
from dataclasses import dataclass, replace

from ftlm.errors import ModelError
from ftlm.structure.equation import Friction, Stribeck
from ftlm.structure.expression import (
    EXPRESSION_FUNCTIONS,
    MAX_INSTRUCTIONS,
    Expression,
    add,
    apply,
    channel,
    constant,
    multiply,
    power,
)
from ftlm.structure.input_nonlinearity import INPUT_EFFECT_ABBREVIATIONS, NonlinearityKind, Value
from ftlm.structure.order import Order
from ftlm.structure.token_reader import (
    FUNCTION_LIST_TEXT,
    FUNCTION_NAMES,
    IDENTIFIER_PATTERN,
    KNOWN_FUNCTIONS,
    TokenReader,
)
from ftlm.utils.validation import nearest

#: Input non-linearities with a syntax in equation texts.
NONLINEARITY_KINDS: tuple[NonlinearityKind, ...] = ("saturation", "dead_zone")
#: Names of offsets, such as c and c1: a term that consists of this name alone is an offset.
_OFFSET_PATTERN = re.compile(r"c\d*")
#: Numerator of ``d^0.5 y/dt^0.5``, ``d2y/dt2`` or ``dy(t)/dt`` as tokens with spaces, and maximum tokens of a
#: derivative.
_LEIBNIZ_PATTERN = re.compile(
    rf"d(?: \^ ([\d.]+|{IDENTIFIER_PATTERN})(?: ({IDENTIFIER_PATTERN}))?|(?:(\d+)?({IDENTIFIER_PATTERN}))?)"
    r"(?: \( t \))?(?= /)"
)
MAX_LEIBNIZ_TOKENS = 11
#: Tokens after the name of an offset in parentheses, by the kind of offset.
OFFSET_PHRASES = {"ramp": ("+", "ramp", "t"), "auto": ("if", "significant")}
#: Maximum nesting depth of parentheses and functions in a non-linear term.
MAX_DEPTH = 30
#: Minimum similarity of a name right before a parenthesis to a function, from which it is a misspelled function.
MIN_FUNCTION_SIMILARITY = 0.7
#: Maximum power of a polynomial in s that is multiplied out.
MAX_POLYNOMIAL_POWER = 10
#: Maximum number of terms of a polynomial in s with named coefficients.
MAX_POLYNOMIAL_TERMS = 200


@dataclass(frozen=True)
class ParsedTerm:
    """Term ``factor * name * D^order signal`` on one side of an equation text.

    ``name`` is None if the coefficient is a number.

    A non-linear term has an expression; ``signal`` is then the first signal of the expression.
    """

    factor: float
    name: str | None
    order: Order
    signal: str
    expression: Expression | None = None

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the signals in the term."""
        return (self.signal,) if self.expression is None else tuple(signal for signal, _ in self.expression.channels)


#: Terms (factor, name, order) of a sum of ``factor * name * s^order``; orders may be fractional. The name of a product
#: of coefficients is ``"a*b"``.
SymbolicPolynomial = list[tuple[float, str | None, Order]]
UNIT_POLYNOMIAL: SymbolicPolynomial = [(1.0, None, Order())]


class EquationParser(TokenReader):
    """Parser of the text of one equation; :meth:`parse` sets its attributes.

    Parameters
    ----------
    text
        Text of the equation.
    signals
        Names that denote signals where they could also denote coefficients.

    Attributes
    ----------
    left, right
        Terms of the left-hand and the right-hand side.
    friction, stribeck
        (friction, signal) of the Coulomb and of the Stribeck term on the right-hand side; None without such a term.
    offset
        Kind of the offset: ``"constant"``, ``"ramp"`` or ``"auto"``; None without an offset.
    limits
        Saturation levels and half-widths of dead zones, by (signal, kind): a number, or (lower, upper) bounds.
    unlimited
        Names of signals that occur at least once without a saturation or dead zone.
    delays
        Delay [s] of each signal: a number if it is known, (lower, upper) bounds if it is to be estimated.
    is_transfer
        Whether the equation is written with transfer functions in s.
    """

    def __init__(self, text: str, signals: Collection[str] = ()) -> None:
        super().__init__(text)
        self._signals = signals
        self._depth = 0
        self._primes = 0
        self._conflicting_delay: str | None = None
        self.left: list[ParsedTerm] = []
        self.right: list[ParsedTerm] = []
        self.friction: tuple[Friction, str] | None = None
        self.stribeck: tuple[Stribeck, str] | None = None
        self.offset: str | None = None
        self.limits: dict[tuple[str, NonlinearityKind], Value] = {}
        self.unlimited: set[str] = set()
        self.delays: dict[str, Value] = {}
        self.is_transfer = False

    # ------------------------------------------------------------------------------------------------ equation

    def parse(self) -> EquationParser:
        """Parse the whole text as an equation, set the attributes, and return the parser."""
        if self._is_transfer():
            self.is_transfer = True
            self._transfer()
            return self
        self.left = self._sum(is_lhs=True)
        self._expect("=")
        if self._next_is("0", "the end"):
            self._take()
        else:
            self.right = self._sum()
        if self._peek()[0] != "end":
            raise self._syntax_error("'+', '-' or the end")
        self._check_delayed_signals()
        return self

    def _check_delayed_signals(self) -> None:
        """Raise ModelError if an output has a delay, or if a signal has two different delays.

        Signals that are differentiated on the left-hand side are outputs.
        """
        outputs = {item.signal for item in self.left if item.order.names or item.order.constant}
        output = next((signal for signal in self.delays if self.delays[signal] != 0.0 and signal in outputs), None)
        signal = self._conflicting_delay if output is None else output
        if signal is None:
            return
        reason = f"{signal} has two delays; give the input with the longer delay its own name"
        if signal in outputs:
            reason = f"the output {signal} is delayed, but only inputs have delays; give the delayed one its own name"
        raise self._error(f"{reason}, and its own signal in the run")

    def parse_expression(self) -> Expression:
        """Parse the whole text as the expression of a non-linear term, and return it."""
        terms = self._expression()
        if self._peek()[0] != "end":
            raise self._syntax_error("'+', '-', '*' or the end")
        return terms

    def _sum(self, *, is_lhs: bool = False, closed: bool = False) -> list[ParsedTerm]:
        """Parse a sum up to the first token that cannot continue it, and return its terms.

        Its offset and friction are stored instead of returned.
        """
        terms: list[ParsedTerm] = []
        for sign in self._signs():
            if self._is_offset():
                self._take_offset(sign, is_lhs=is_lhs)
            elif closed or not (self._take_printed_offset() or self._take_friction(-sign if is_lhs else sign)):
                terms += self._item(sign)
        return terms

    def _item(self, sign: float) -> list[ParsedTerm]:
        """Parse a product, or a number times a sum in parentheses, and return its terms."""
        factor = self._numeric_factor(sign)
        name: str | None = None
        if self._next_is("(") and not self._is_expression_group():
            self._take()
            terms = self._sum(closed=True)
            self._expect(")")
            factor = self._divisors(factor)
            return [replace(item, factor=factor * item.factor) for item in terms]
        kind, value, position = self._peek()
        if kind == "name" and value != "D" and self._leibniz() is None and self._continues_after_name():
            name = value
            self._take()
            is_call = self._next_is("(") and self._peek()[2] == position + len(name)
            if is_call and nearest(name, (*FUNCTION_NAMES, *KNOWN_FUNCTIONS), MIN_FUNCTION_SIMILARITY):
                raise self._error(
                    f"{name!r} at character {position + 1} is no known function{nearest(name, KNOWN_FUNCTIONS)}; if it "
                    f"is a coefficient, write '{name}*('"
                )
            self._accept("*")
            if self._peek()[0] == "number":
                raise self._error(
                    f"{self._peek()[1]} at character {self._peek()[2] + 1} follows the coefficient {name}; write "
                    "numbers first"
                )
            if self._next_is("(") and self._is_plain_sum():
                raise self._multiplied_sum_error(name, position)
        start = self._peek()[2]
        order, operand = self._operand()
        if isinstance(operand, str):
            return [ParsedTerm(self._divisors(factor), name, order, operand)]
        scale, expression = operand.split_factor()
        factor = self._divisors(factor * scale)
        if expression.operation == "channel":
            return [ParsedTerm(factor, name, order + Order(expression.value), expression.signal)]
        if expression.is_linear:
            if not expression.channels:
                raise self._error(f"the term at character {start + 1} is a constant without a signal; leave it out")
            raise self._multiplied_sum_error(name or f"{factor:g}", position)
        if len(expression.program({c: 0 for c in expression.channels})) > MAX_INSTRUCTIONS:
            raise self._error(f"the non-linear term at character {start + 1} has too many operations; shorten it")
        return [ParsedTerm(factor, name, order, expression.channels[0][0], expression)]

    def _multiplied_sum_error(self, name: str, position: int) -> ModelError:
        return self._error(
            f"{name} at character {position + 1} multiplies a sum; multiply it out, with a coefficient of its own in "
            "each term"
        )

    def _numeric_factor(self, factor: float) -> float:
        """Parse numbers at the start of a product, and return `factor` times these numbers."""
        while self._peek()[0] == "number":
            factor *= float(self._take()[1])
            while self._next_is("/") and self._peek(1)[0] == "number":
                factor = self._divisors(factor)
            self._accept("*")
        return factor

    def _continues_after_name(self) -> bool:
        """Whether the next name is a coefficient, which is the case if a signal, a derivative or a sum follows it."""
        kind, value, _ = self._peek(1)
        if self._peek()[1] in self._signals:
            return False
        if kind == "name" or value == "*":
            return self._peek()[1] not in FUNCTION_NAMES or kind == "name"
        if value != "(" or self._peek()[1] in FUNCTION_NAMES or self._peek()[1] in INPUT_EFFECT_ABBREVIATIONS.values():
            return False
        return self._peek(2)[1] not in ("t", "s") or self._peek(3)[1] not in ")-+"

    # ------------------------------------------------------------------------------------------------- offset

    def _is_offset(self) -> bool:
        """Whether the next term is an unknown constant (offset); raise ModelError for a known constant."""
        (kind, value, position), (kind_after, symbol, _) = self._peek(), self._peek(1)
        if not (kind_after == "end" or (kind_after == "symbol" and symbol in "+-=")):
            return False
        if kind == "number":
            raise self._error(
                f"{value} at character {position + 1} is a constant without a signal; an offset is unknown: write '+ "
                "c' and it is estimated, or subtract a known one from the run"
            )
        return kind == "name" and _OFFSET_PATTERN.fullmatch(value) is not None

    def _take_offset(self, sign: float, *, is_lhs: bool) -> None:
        _, value, position = self._peek()
        if self.offset or sign < 0 or is_lhs:
            reason = "occurs twice" if self.offset else "has a sign, but the estimate of the constant includes the sign"
            reason = "is on the left-hand side" if is_lhs else reason
            raise self._error(
                f"the offset {value!r} at character {position + 1} {reason}; write '+ c' once, on the right-hand side"
            )
        self.offset = "constant"
        self._take()

    def _take_printed_offset(self) -> bool:
        """Parse and store an offset in parentheses, as a structure prints it; return False for any other term."""
        for kind, phrase in OFFSET_PHRASES.items():
            if self._next_is("(") and self._peek(1)[0] == "name":
                values = [self._peek(k)[1] for k in range(2, 3 + len(phrase))]
                if values == [*phrase, ")"]:
                    if self.offset:
                        raise self._error("the offset occurs twice; write it once")
                    self.offset = kind
                    self._index += 3 + len(phrase)
                    return True
        return False

    # ------------------------------------------------------------------------------------------ non-linear terms

    def _closing_distance(self, offset: int = 0) -> int:
        """Return the number of next tokens up to and including the one that closes the parenthesis at `offset`."""
        depth = 0
        while True:
            kind, value, _ = self._peek(offset)
            depth += (value == "(") - (value == ")")
            offset += 1
            if not depth or kind == "end":
                return offset

    def _has_power_or_function(self, count: int) -> bool:
        """Whether the next `count` tokens contain a power or a function."""
        return any(self._peek(k)[1] == "^" or self._peek(k)[1] in EXPRESSION_FUNCTIONS for k in range(count))

    def _is_plain_sum(self) -> bool:
        """Whether the next parentheses contain a sum without powers and functions, and no ``^`` or ``*`` follows."""
        count, depth, signs = self._closing_distance(), 0, 0
        for k in range(count):
            value = self._peek(k)[1]
            depth += (value == "(") - (value == ")")
            signs += depth == 1 and k > 1 and value in "+-"
        return signs > 0 and not self._has_power_or_function(count) and self._peek(count)[1] not in ("^", "*")

    def _is_expression_group(self) -> bool:
        """Whether parentheses after a number are a factor of a non-linear term, not a sum to multiply out.

        They are a factor if ``^`` or ``*`` follows. They are also a factor if they contain a power or function, and
        either a constant term or a second pair of parentheses around the whole sum.
        """
        count = self._closing_distance()
        if self._peek(count)[1] in ("^", "*"):
            return True
        if not self._has_power_or_function(count):
            return False
        if self._next_is("(", "(") and self._closing_distance(1) == count - 1:
            return True
        depth, is_number = 0, False
        for k in range(count):
            kind, value, _ = self._peek(k)
            depth += value == "("
            if depth == 1 and (value in "(+-" or k == count - 1):
                if is_number and self._peek(k - 1)[0] == "number":
                    return True
                is_number = True
            else:
                is_number = is_number and (kind == "number" or value in "^*/")
            depth -= value == ")"
        return False

    def _operand(self) -> tuple[Order, str | Expression]:
        """Parse a term after its coefficient; return (order, signal), or (order, expression) of a non-linear term."""
        start = self._index
        operator = self._operator()
        if operator is not None and self._next_is("("):
            expression = self._group()
            if self._peek()[1] in ("^", "*"):
                raise self._error(
                    f"{self._peek()[1]!r} at character {self._peek()[2] + 1} follows the derivative of an expression; "
                    "only signals and their derivatives are multiplied"
                )
            return operator, expression
        self._index = start
        kind, value, _ = self._peek()
        if kind == "name" and not (value in FUNCTION_NAMES and self._peek(1)[1] == "("):
            order, signal = self._derivative()
            if self._peek()[1] not in ("^", "*"):
                return order or Order(), signal
            self._index = start
        if kind == "symbol" and value != "(":
            raise self._syntax_error("the name of a signal")
        return Order(), self._product(divide=False)

    def _operator(self) -> Order | None:
        """Parse ``D``, ``D^order`` or ``d/dt`` before an operand, and return its order; None for other text."""
        derivative = self._leibniz()
        if derivative is not None and not derivative[1]:
            self._index += derivative[2]
            return derivative[0]
        if not self._next_is("D"):
            return None
        self._take()
        return self._order() if self._accept("^") else Order(1.0)

    def _group(self) -> Expression:
        """Parse an expression in parentheses, and return it."""
        self._expect("(")
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise self._error(f"parentheses are nested more than {MAX_DEPTH} times; write the term with fewer")
        terms = self._expression()
        if self._peek()[0] == "name":
            position = self._peek()[2]
            raise self._error(
                f"{self._peek()[1]!r} at character {position + 1} follows another name inside a non-linear term: write "
                "* between signals; a free parameter inside one is not estimated: give its value"
            )
        self._expect(")")
        self._depth -= 1
        return terms

    def _expression(self) -> Expression:
        """Parse a sum of products of numbers, signals and functions without free parameters, and return it."""
        return add(*[multiply(constant(sign), self._product()) for sign in self._signs()])

    def _product(self, *, divide: bool = True) -> Expression:
        """Parse a product of numbers, signals, derivatives, powers and functions, and return it."""
        factors = [self._power()]
        while True:
            kind, value, _ = self._peek()
            is_number = factors[-1].operation == "constant"
            if self._accept("*") or (is_number and (kind == "name" or value == "(")):
                factors.append(self._power())
            elif divide and value == "/":
                if self._peek(1)[0] != "number":
                    raise self._error(
                        f"{self._peek(1)[1]!r} at character {self._peek(1)[2] + 1} divides inside a non-linear term: "
                        "give its value if it is a parameter, and the quotient as a signal of the run if it is a signal"
                    )
                factors.append(constant(self._divisors(1.0)))
            else:
                return multiply(*factors)

    def _power(self) -> Expression:
        """Parse one factor of a product with its optional exponent, and return it."""
        kind, value, position = self._peek()
        is_derivative = value == "D" or self._leibniz() is not None
        if kind == "number":
            self._take()
            base = constant(float(value))
        elif value == "(":
            base = self._group()
        elif kind == "name" and value in FUNCTION_NAMES and self._peek(1)[1] == "(":
            base = self._function()
        else:
            order, signal = self._derivative()
            if order is not None and order.names:
                raise self._error(
                    f"the order {order} at character {position + 1} is free inside a non-linear term; give its value"
                )
            if is_derivative and self._next_is("^"):
                text = self._normalized[position : self._peek()[2]].strip()
                raise self._error(
                    f"a power of {text} at character {self._peek()[2] + 1} has two meanings; write ({text})^…"
                )
            base = channel(signal, 0.0 if order is None else order.constant)
        if not self._accept("^"):
            return base
        sign = -1.0 if self._accept("-") else 1.0
        if self._peek()[0] != "number":
            raise self._syntax_error("a power: a number")
        try:
            return power(base, sign * float(self._take()[1]))
        except ModelError as error:
            raise self._error(f"at character {position + 1}: {error}") from error

    def _function(self) -> Expression:
        """Parse a function of an expression, and return it."""
        _, name, position = self._take()
        if name not in EXPRESSION_FUNCTIONS:
            friction = "; friction is '- fc*sign(D y)', and drag '- w abs(D y)*D y'" if name == "sign" else ""
            raise self._error(f"{name}(…) at character {position + 1}: {FUNCTION_LIST_TEXT}{friction}")
        argument = self._group()
        try:
            return apply(name, argument)
        except ModelError as error:
            raise self._error(f"at character {position + 1}: {error}") from error

    # ------------------------------------------------------------------------------------ derivatives and signals

    def _derivative(self) -> tuple[Order | None, str]:
        """Parse a signal or its derivative, and return (order, signal); the order of a plain signal is None."""
        derivative = self._leibniz()
        if derivative is not None and derivative[1]:
            self._index += derivative[2]
            return derivative[:2]
        self._primes = 0
        order, signal = self._operator(), self._signal()
        if order is None:
            primes = self._primes + self._count_primes()
            return Order(float(primes)) if primes else None, signal
        if self._primes:
            raise self._error(f"{signal} has both D and primes; write one of them, as in D^2 {signal}")
        return order, signal

    def _count_primes(self) -> int:
        """Parse primes after a signal, and return their number."""
        start = self._index
        while self._accept("'"):
            pass
        return self._index - start

    def _leibniz(self) -> tuple[Order, str, int] | None:
        """Return (order, signal, number of tokens) of ``dy/dt``, ``d^2 y/dt^2`` or ``d/dt``; None for other text."""
        text = " ".join(self._peek(k)[1] for k in range(MAX_LEIBNIZ_TOKENS))
        top = _LEIBNIZ_PATTERN.match(text)
        if top is None:
            return None
        order, signal = top[1] or top[3] or "1", top[2] or top[4] or ""
        bottom = re.compile(rf" / dt( \^ {order}|{'' if order == '1' else order})(?= |$)").match(text, top.end())
        if bottom is None:
            return None
        if signal:
            self.unlimited.add(signal)
        return self._order_from(order, self._peek()[2]), signal, text.count(" ", 0, bottom.end()) + 1

    def _signal(self) -> str:
        """Parse a signal with its time argument, saturation or dead zone, and return its name."""
        kind, value, _ = self._peek()
        if kind != "name" or value == "D":
            raise self._syntax_error("the name of a signal")
        law = next(
            (law for law in NONLINEARITY_KINDS if INPUT_EFFECT_ABBREVIATIONS[law] == value and self._peek(1)[1] == "("),
            None,
        )
        self._take()
        if law is None:
            self.unlimited.add(value)
            self._primes = self._count_primes()
            self._time_argument(value)
            return value
        self._take()
        unlimited_before = set(self.unlimited)
        signal = self._signal()
        if self._primes:
            raise self._error(f"{value}(…) limits a signal, not its derivative; write {value}({signal}, …)")
        self.unlimited = unlimited_before | (self.unlimited - {signal})
        if law == "dead_zone" and (signal, "saturation") in self.limits:
            raise self._error(f"a dead zone acts before a saturation: write sat(dead({signal}, …), …)")
        self._expect(",", "',' and the limit, as in sat(u, 0.94)")
        limit = self._value("a limit, or LEAST:LARGEST where it is estimated")
        self._expect(")")
        if self.limits.setdefault((signal, law), limit) != limit:
            raise self._error(f"{signal} has two saturations or two dead zones; write at most one of each")
        return signal

    def _time_argument(self, signal: str) -> None:
        """Parse ``(t)`` or ``(t - 0.06 s)`` after a signal, and store the delay of the signal."""
        if not (self._next_is("(", "t") and self._peek(2)[1] in ")-+"):
            self._check_delay(signal, 0.0)
            return
        self._index += 2
        delay: Value = 0.0
        if self._accept("+"):
            delay = self._lead(signal)
        elif self._accept("-"):
            delay = self._delay(signal)
        # A printed model has the unit s after a delay.
        self._index += self._next_is("s")
        self._expect(")")
        self._check_delay(signal, delay)

    def _check_delay(self, signal: str, delay: Value) -> None:
        if self.delays.setdefault(signal, delay) != delay:
            self._conflicting_delay = self._conflicting_delay or signal

    def _lead(self, signal: str) -> float:
        kind, value, _ = self._peek()
        if kind != "number":
            raise self._error(
                f"the lead {value!r} of {signal} is not a number, but a lead is estimated as a negative delay between "
                f"bounds; write bounds in seconds, as in {signal}(t - -0.1:0)"
            )
        self._take()
        return -float(value)

    def _delay(self, signal: str) -> Value:
        kind, value, _ = self._peek()
        if kind == "name":
            raise self._error(
                f"the delay {value} of {signal} is free, but a delay is estimated between bounds; write "
                f"bounds in seconds, as in {signal}(t - 0:0.5)"
            )
        return self._value("a delay [s], or LEAST:LARGEST where it is estimated")

    # ------------------------------------------------------------------------------------------------ friction

    def _take_friction(self, sign: float) -> bool:
        """Parse and store ``fc*sign(D y)`` or ``fs*exp(-(D y/vs)^2)*sign(D y)``; return False for any other term."""
        start, number, name = self._index, 1.0, None
        if self._peek()[0] == "number":
            number = float(self._take()[1])
            self._accept("*")
        if self._peek()[0] == "name" and self._peek()[1] not in ("D", "sign", "exp"):
            name = self._take()[1]
            self._accept("*")
        # The exponential factor of Stribeck friction stands before sign(D y).
        count = self._closing_distance(1) if self._next_is("exp", "(") else 0
        has_factor = count > 0 and self._peek(count + (self._peek(count)[1] == "*"))[1] == "sign"
        if not has_factor and not self._next_is("sign", "("):
            self._index = start
            return False
        factor = self._stribeck_factor() if has_factor else None
        self._accept("*")
        self._take()
        self._expect("(")
        kind, value, _ = self._peek()
        if kind == "name" and value != "D" and self._peek(1)[1] == ")":
            raise self._error(
                f"sign({value}) is not a term; friction of a position is '- fc*sign(D {value})', that of a measured "
                "speed "
                f"'- fc*tanh(100 {value})', with a slope that rises within its noise"
            )
        signal = self._velocity("D and the name of a signal, as in sign(D y)")
        self._expect(")")
        if factor is not None and factor[0] != signal:
            speed = factor[0]
            raise self._error(
                f"Stribeck friction has the speed of {speed} and the sign of {signal}; use the same velocity in both"
            )
        if sign > 0:
            prefix = "fc*" if factor is None else f"fs*exp(-(D {signal}/vs)^2)*"
            raise self._error(f"friction dissipates energy, so it is subtracted: write '- {prefix}sign(D {signal})'")
        if (self.friction if factor is None else self.stribeck) is not None:
            subject = "friction" if factor is None else "Stribeck friction"
            raise self._error(f"{subject} of D {signal} occurs twice; write it once")
        strength: tuple[str | float, float] = (name, sign * number) if name is not None else (number, sign)
        if factor is None:
            self.friction = Friction(*strength), signal
        else:
            self.stribeck = Stribeck(strength[0], factor[1], strength[1]), signal
        return True

    def _stribeck_factor(self) -> tuple[str, str | float]:
        """Parse ``exp(-(D y/vs)^2)``, and return (signal, name or value of the Stribeck speed vs)."""
        self._take()
        for symbol in "(-(":
            self._expect(symbol, "-(D y/vs)^2, as in exp(-(D y/vs)^2)")
        signal = self._velocity("D and the name of a signal, as in exp(-(D y/vs)^2)")
        self._expect("/")
        kind, value, _ = self._peek()
        if kind not in ("name", "number"):
            raise self._syntax_error("a speed, its name or a positive number")
        self._take()
        for symbol in (")", "^", "2", ")"):
            self._expect(symbol, f"'{symbol}', as in exp(-(D y/vs)^2)")
        return signal, float(value) if kind == "number" else value

    def _velocity(self, expectation: str) -> str:
        """Parse ``D y``, ``y'`` or ``dy/dt``, and return the signal; `expectation` is the text of the syntax error."""
        start, (order, signal) = self._index, self._derivative() if self._peek()[0] == "name" else (None, "")
        if order is None:
            self._index = start
            raise self._syntax_error(expectation)
        if order != Order(1.0):
            raise self._error(f"friction depends on the first derivative; write sign(D {signal}) for the velocity")
        return signal

    # --------------------------------------------------------------------------------------- transfer functions

    def _is_transfer(self) -> bool:
        """Whether the text has the form ``y = G(s) u`` or ``y/u = G(s)``.

        The left-hand side is then a signal or a ratio of two signals, and s occurs on the right-hand side.
        """
        values = [value for _, value, _ in self._tokens]
        if values.count("=") != 1:
            return False
        equals = values.index("=")
        signal = rf"{IDENTIFIER_PATTERN}( \( s \))?"
        if not re.fullmatch(rf"{signal}( / {signal})?", " ".join(values[:equals])):
            return False
        last = len(values) - 1
        # The s of u(s), the unit in u(t - 0.1 s) and a last token s, which is a signal, do not count.
        return any(
            values[k] == "s" and k != last and values[k - 1] != "(" and values[k - 3 : k - 1] != ["t", "-"]
            for k in range(equals + 1, len(values))
        ) or any(values[k : k + 2] == ["(", "s"] and values[k + 2 : k + 3] != [")"] for k in range(equals, len(values)))

    def _transfer(self) -> None:
        """Parse transfer functions, multiply the equation by all denominators, and store the terms of both sides."""
        output = self._laplace_signal()
        common = self._laplace_signal() if self._accept("/") else None
        self._expect("=")
        paths: list[tuple[SymbolicPolynomial, SymbolicPolynomial, str]] = []
        for sign in self._signs():
            num, den, delay, named_input = self._ratio(common)
            signal = common or named_input or self._laplace_signal()
            self.delays[signal] = delay
            if any(signal == other for _, _, other in paths):
                raise self._error(f"{signal} occurs twice; combine its terms into one transfer function")
            paths.append(([(sign * c, n, o) for c, n, o in num], den, signal))
        if self._peek()[0] != "end":
            raise self._syntax_error("'+', '-' or the end")
        denominators: list[SymbolicPolynomial] = []
        for _, den, _ in paths:
            if den not in denominators:
                denominators.append(den)
        product = functools.reduce(self._times, denominators, UNIT_POLYNOMIAL)
        self.left = [ParsedTerm(c, n, o, output) for c, n, o in product]
        for num, path_den, signal in paths:
            scaled = functools.reduce(self._times, [den for den in denominators if den != path_den], num)
            self.right += [ParsedTerm(c, n, o, signal) for c, n, o in scaled]

    def _laplace_signal(self) -> str:
        """Parse a signal, with or without ``(s)`` after it, and return its name."""
        kind, value, _ = self._peek()
        if kind != "name":
            raise self._syntax_error("the name of a signal")
        self._take()
        if self._next_is("(", "s", ")"):
            self._index += 3
        self.unlimited.add(value)
        return value

    def _ratio(self, common: str | None) -> tuple[SymbolicPolynomial, SymbolicPolynomial, Value, str | None]:
        """Parse a transfer function; return numerator, denominator, delay, and the input if it is a factor ``u(s)``.

        `common` is u in the form ``y/u = …``.
        """
        num, den, divides, start = UNIT_POLYNOMIAL, UNIT_POLYNOMIAL, False, self._index
        delay: Value = 0.0
        signal: str | None = None
        while True:
            kind, value, _ = self._peek()
            symbols = [self._peek(k)[1] for k in (1, 2, 3)]
            if value in ("e", "exp") and symbols[0] in ("^", "("):
                delay = self._exponential()
            elif not (common or signal or divides) and value != "sqrt" and symbols == ["(", "s", ")"]:
                signal = self._laplace_signal()
            elif not divides and self._ends_ratio(kind, value, symbols, is_named=common is None and signal is None):
                return num, den, delay, signal
            elif not divides and (kind == "end" or value in "+-"):
                raise self._missing_input_error(start)
            elif divides:
                den = self._times(den, self._factor())
            else:
                num = self._times(num, self._factor())
            divides = self._accept("/")
            if not divides:
                self._accept("*")

    def _missing_input_error(self, start: int) -> ModelError:
        """Return the error for a transfer function without an input at its end; `start` is its first token."""
        text = "the transfer function has no input at its end; write "
        factors = itertools.takewhile(lambda token: token[1] not in "/(", self._tokens[start : self._index])
        names = [token for token in factors if token[0] == "name" and token[1] not in ("s", "e", "exp", "sqrt")]
        if names:
            _, name, position = names[-1]
            before = self._normalized[self._tokens[start][2] : position].rstrip("* ") or "1"
            after = self._normalized[position + len(name) : self._peek()[2]].strip()
            text += f"{f'{before}{after} {name}'!r} if {name} is the input, and otherwise "
        return self._error(f"{text}both signals, as in 'y = 2/(s + 3) u' or 'y/u = 2/(s + 3)'")

    @staticmethod
    def _ends_ratio(kind: str, value: str, symbols: list[str], *, is_named: bool) -> bool:
        """Whether a token ends a transfer function; `symbols` are the three tokens after it.

        With `is_named`, the name of the input ends the transfer function. Otherwise a plus or minus sign or the end of
        the text ends it.
        """
        if not is_named:
            return kind == "end" or (kind == "symbol" and value in "+-")
        last = symbols[0] in ("the end", "+", "-") or symbols == ["(", "s", ")"]
        return kind == "name" and value not in ("s", "sqrt") and last

    def _exponential(self) -> Value:
        """Parse ``e^(-0.1 s)`` or ``exp(-0.1 s)``, and return the delay [s] or its (lower, upper) bounds."""
        _, value, position = self._take()
        if value == "e":
            self._take()
        closing = {"(": ")", "{": "}"}.get(self._take()[1])
        if closing is None or not self._accept("-") or self._peek()[0] != "number":
            raise self._error(
                f"an exponential at character {position + 1} is a delay; write a number, as in e^(-0.1 s), or bounds "
                "of an estimate, as in e^(-0:0.5 s)"
            )
        delay = self._value("a delay [s], or LEAST:LARGEST where it is estimated")
        self._accept("*")
        self._expect("s")
        self._expect(closing)
        return delay

    def _polynomial(self) -> SymbolicPolynomial:
        """Parse a sum of products of numbers, names and powers of s, and return it as a polynomial in s."""
        polynomial: SymbolicPolynomial = []
        for sign in self._signs():
            product = self._factor()
            while self._peek()[0] in ("number", "name") or self._peek()[1] in ("(", "*", "/"):
                if self._next_is("/"):
                    divisor = self._divisors(1.0)
                    product = [(divisor * c, name, order) for c, name, order in product]
                else:
                    self._accept("*")
                    product = self._times(product, self._factor())
            polynomial += [(sign * c, name, order) for c, name, order in product]
        return [term for term in _combine_numeric(polynomial) if term[0] != 0.0] or UNIT_POLYNOMIAL

    def _factor(self) -> SymbolicPolynomial:
        """Parse one factor of a transfer function, and return it as a polynomial in s."""
        kind, value, position = self._peek()
        if kind == "number":
            self._take()
            base: SymbolicPolynomial = [(float(value), None, Order())]
        elif value == "sqrt" and self._next_is("sqrt", "(", "s", ")"):
            self._index += 4
            return [(1.0, None, Order(0.5))]
        elif kind == "name" and value not in FUNCTION_NAMES:
            self._take()
            if value == "s":
                return [(1.0, None, self._order() if self._accept("^") else Order(1.0))]
            base = [(1.0, value, Order())]
        elif self._accept("("):
            base = self._polynomial()
            self._expect(")")
        else:
            raise self._syntax_error("a number, a coefficient, s or (…)")
        if not self._accept("^"):
            return base
        kind, value, position = self._take()
        if not (kind == "number" and value.isdigit() and 1 <= int(value) <= MAX_POLYNOMIAL_POWER):
            raise self._error(
                f"the power {value!r} of a polynomial at character {position + 1} is not a whole number from 1 to "
                f"{MAX_POLYNOMIAL_POWER}; only these give a sum of powers of s"
            )
        return functools.reduce(self._times, [base] * int(value), UNIT_POLYNOMIAL)

    def _times(self, first: SymbolicPolynomial, second: SymbolicPolynomial) -> SymbolicPolynomial:
        """Return the product of two polynomials in s; terms with the same power and coefficient names are combined."""
        products: dict[tuple[str | None, Order], float] = {}
        for c1, n1, o1 in first:
            for c2, n2, o2 in second:
                names = [name for product in (n1, n2) if product for name in product.split("*")]
                key = "*".join(sorted(names)) or None, o1 + o2
                products[key] = products.get(key, 0.0) + c1 * c2
            if len(products) > MAX_POLYNOMIAL_TERMS:
                raise self._error(
                    f"the transfer function has more than {MAX_POLYNOMIAL_TERMS} terms after multiplication; give each "
                    "power of s one coefficient"
                )
        return [(c, name, order) for (name, order), c in products.items() if c != 0.0]


def _combine_numeric(terms: SymbolicPolynomial) -> SymbolicPolynomial:
    """Return a polynomial in which terms of equal order with numeric coefficients are combined."""
    sums: dict[object, tuple[float, str | None, Order]] = {}
    for index, (c, name, order) in enumerate(terms):
        key = order if name is None else index
        sums[key] = (sums[key][0] + c if key in sums else c, name, order)
    return list(sums.values())
