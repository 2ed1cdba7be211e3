"""Parser of equation texts: text to `Structure`."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Literal

from msgspec import UNSET

from ftlm.errors import ModelError
from ftlm.structure.equation import Equation, Friction, Stribeck, Term
from ftlm.structure.input_nonlinearity import (
    INPUT_EFFECT_ABBREVIATIONS,
    InputNonlinearity,
    NonlinearityKind,
    Value,
    sort_nonlinearities,
)
from ftlm.structure.order import Order, Values
from ftlm.structure.sensor_filter import SensorFilter
from ftlm.structure.structure import Offset, Structure, check_initial, check_offset
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import parameter
from ftlm.utils.validation import check_known, real_number

IDENTIFIER_PATTERN = r"[^\W\d]\w*"
#: Input nonlinearities with a syntax in equation texts.
NONLINEARITY_KINDS: tuple[NonlinearityKind, ...] = ("saturation", "dead_zone")
#: A term that consists of such a name alone is an offset.
_OFFSET_PATTERN = re.compile(r"c\d*")


@check_arguments
def equation(
    text: str,
    *,
    orders: Mapping[str, Values] | None = None,
    fixed: Mapping[str, float] | None = None,
    delay: Mapping[str, float | tuple[float, float]] | None = None,
    saturation: Mapping[str, Value] | None = None,
    dead_zone: Mapping[str, Value] | None = None,
    initial: str | Iterable[float] = "auto",
    sensor_filter: SensorFilter | None = None,
    offset: str | None = None,
    coupling: Literal["measured", "simulated"] | None = None,
) -> Structure:
    """Parse the text of one or several fractional-order equations into a structure.

    Parameters
    ----------
    text
        Such as ``"D^2.2 y = a1 D^0.9 y + a0 y + b0 u"``. ``D^alpha`` is a free order, ``D^(alpha-mu)`` an order law,
        ``D y`` the first derivative. A coefficient is a name, a number (fixed) or a number times a name. Separate
        equations by ``;`` or line breaks. A term ``c`` alone (or ``c0``, ``c1``, …) is an offset, an unknown constant;
        write ``1 c`` for a signal of that name. ``- fc*sign(D y)`` in the equation of y is Coulomb friction of the
        simulated velocity, set-valued at rest. ``- fs*exp(-(D y/vs)^2)*sign(D y)`` adds Stribeck friction, with fs and
        vs > 0 each a name or a number; the breakaway force is then fc + fs.
    orders
        Values of the free orders: a number fixes one, ``"0.5:1.5:0.05"`` or (low, high, step) gives its grid.
    fixed
        Known coefficients, by name.
    delay
        Delay of inputs [s], by name, not negative: a number fixes one, (lower, upper) is estimated by output error.
    saturation, dead_zone
        Symmetric saturation level and half-width of the dead zone of inputs, in their units: a number fixes one,
        (lower, upper) is estimated by output error. As text: ``sat(u, 0.94)``, ``dead(u, 0.05)``, ``sat(u, 0.5:1.5)``.
    initial
        Initial conditions as powers of t: ``"rest"`` (zero), ``"caputo"`` (constant before the start), ``"history"``
        (unknown past: exponents in quarters, as many as are significant), or given exponents. ``"auto"``: rest if the
        outputs start at zero, or stand still in five rows or more before an input moves, or if the inputs are constant
        over the run (said in a finding); then the level of the outputs is estimated where it is not zero, and the
        inputs count from their first value. Else Caputo for integer orders or if the data need no more, else history.
    sensor_filter
        Known filter of some measured signals, inputs or outputs; see :class:`ftlm.SensorFilter`.
    offset
        ``"constant"``: an unknown constant on the right-hand side of each equation, the same as ``+ c`` in the text;
        ``"ramp"``: a constant and a constant times t; ``"level"``: a constant that is added to the output, the value at
        which the plant rests, one number whatever the orders; ``"none"``. From rest a constant is a load that acts from
        the first row on, or, if the outputs stand still elsewhere than at zero, the level at which it rests. Offsets
        are estimated per run with the coefficients and never transferred to another run. Default: as in the text.
    coupling
        Coupling of several equations. ``"measured"``: the measured other outputs are inputs (default).
        ``"simulated"``: all outputs are simulated together (default if an equation has friction).

    Returns
    -------
    Structure
        Structure to identify, or the structure of a model if all parameters are fixed.

    Raises
    ------
    ModelError
        A syntax error (with its position), an unknown name, an order out of range, or an offset in only some of several
        equations.
    """
    if not isinstance(text, str):
        raise ModelError(f"the equation is {type(text).__name__}, not text; write it as in 'D^1.5 y = a0 y + b0 u'")
    lines = [line for line in re.split(r"[;\n]", text) if line.strip()]
    if not lines:
        raise ModelError("the equation is empty; write it as in 'D^1.5 y = a0 y + b0 u'")
    parsed = [_parse(line) for line in lines]
    equations = [item for item, _, _ in parsed]
    fixed = dict(fixed or {})
    check_known("fixed coefficient", fixed, [n for e in equations for n in e.coefficient_names])
    for name, value in fixed.items():
        if not math.isfinite(real_number(f"fixed coefficient {name}", value)):
            raise ModelError(f"fixed coefficient {name} = {value} is not finite; give a number")
    equations = [e.with_coefficients(fixed) for e in equations]
    if coupling is None:
        rubs = len(equations) > 1 and any(e.friction is not None for e in equations)
        coupling = "simulated" if rubs else "measured"
    structure = (
        Structure(
            equations=tuple(equations),
            coupling=coupling,
            initial=check_initial(initial),
            sensor_filter=sensor_filter,
            offset=_offset_of([(item, found) for item, found, _ in parsed], offset),
            input_nonlinearities=_merge_nonlinearities([words for _, _, words in parsed]) or UNSET,
        )
        .with_delays(delay or {})
        .with_orders(orders or {})
    )
    return structure.with_limits(saturation=saturation, dead_zone=dead_zone)


def _offset_of(parsed: Sequence[tuple[Equation, bool]], offset: str | None) -> Offset:
    """Return the offset: the argument if given, else the one that all equation texts share."""
    said = [item.output for item, found in parsed if found]
    if offset is not None:
        if said and check_offset(offset) == "none":
            raise ModelError(
                f"the equation of {said[0]} has an offset, but {parameter('offset', 'none')}; leave one of them out"
            )
        return check_offset(offset)
    without = [item.output for item, found in parsed if not found]
    if said and without:
        raise ModelError(
            f"the equation of {said[0]} has an offset, that of {without[0]} has none; each equation of a structure has "
            "one or none has: write + c in each (its estimate says whether it is 0)"
        )
    return "constant" if said else "none"


_TOKEN_PATTERN = re.compile(
    rf"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>{IDENTIFIER_PATTERN})|(?P<symbol>[-+*/^(){{}}=,:]))"
)


class _TokenStream:
    """Token stream of one equation, with positions for error messages."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.tokens: list[tuple[str, str, int]] = []
        at = 0
        while text[at:].strip():
            token = _TOKEN_PATTERN.match(text, at)
            if token is None:
                start = at + len(text[at:]) - len(text[at:].lstrip())
                raise ModelError(f"equation {text!r}: {text[start]!r} at character {start + 1} has no meaning there")
            kind = str(token.lastgroup)
            self.tokens.append((kind, token[kind], token.start(kind)))
            at = token.end()
        self.position = 0
        #: Nonlinearities by (signal, kind), and signals that occur without one.
        self.limits: dict[tuple[str, str], Value] = {}
        self.plain: set[str] = set()

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
        kind, value, at = self.peek()
        if kind == "symbol" and value in ",:":
            return ModelError(f"equation {self.text!r}: {value!r} at character {at + 1} has no meaning there")
        return ModelError(
            f"equation {self.text!r}: expected {wanted} at character {at + 1}, found {value!r}; "
            "write it as in 'D^1.5 y = a1 D^0.5 y + a0 y + b0 u'"
        )


def parse_equation(text: str) -> Equation:
    """Parse one equation without offset and input nonlinearities; see :func:`equation`."""
    item, offset, words = _parse(text)
    if offset or words.limits:
        what = "an offset" if offset else "a limit of an input"
        raise ModelError(f"equation {text!r}: {what} belongs to a structure; use equation(…)")
    return item


def _merge_nonlinearities(parsed: Sequence[_TokenStream]) -> tuple[InputNonlinearity, ...]:
    """Merge the input nonlinearities of all equations; each input must have the same one in every term."""
    found: dict[tuple[str, str], Value] = {}
    for words in parsed:
        for key, limit in words.limits.items():
            if found.setdefault(key, limit) != limit:
                raise ModelError(f"{key[0]} has two limits of one kind in these equations; an actuator has one")
    bare = {signal for words in parsed for signal in words.plain}
    both = next((signal for signal, _ in found if signal in bare), None)
    if both is not None:
        raise ModelError(
            f"{both} stands there limited and as it is, but an actuator limits all that it drives; limit it in each "
            "term, or give the run the limited input as a signal of its own"
        )
    return tuple(
        sort_nonlinearities(
            [InputNonlinearity(s, law, v) for law in NONLINEARITY_KINDS for (s, own), v in found.items() if own == law]
        )
    )


def _parse(text: str) -> tuple[Equation, bool, _TokenStream]:
    """Parse one equation: the equation, whether it has an offset, and its token stream with nonlinearities."""
    words = _TokenStream(text)
    order, output = _parse_derivative(words)
    if words.take()[1] != "=":
        words.position -= 1
        raise words.fail("'='")
    if order is None:
        raise ModelError(
            f"equation {text!r}: its left-hand side has no derivative; write it as in 'D^1.5 {output} = …'"
        )
    terms = []
    offset = False
    friction: Friction | None = None
    near: Stribeck | None = None
    while True:
        sign = 1.0
        while words.peek()[1] in "+-" and words.peek()[0] == "symbol":
            sign *= -1.0 if words.take()[1] == "-" else 1.0
        if _is_offset(words):
            if offset or sign < 0:
                raise ModelError(
                    f"equation {text!r}: the offset {words.peek()[1]!r} at character {words.peek()[2] + 1} "
                    + ("stands there twice" if offset else "has a sign, but an unknown constant has its own")
                    + "; write '+ c' once"
                )
            offset = True
            words.take()
        elif (rubs := _parse_friction(words, sign)) is not None:
            if (near if isinstance(rubs[0], Stribeck) else friction) is not None:
                which = "Stribeck friction" if isinstance(rubs[0], Stribeck) else "friction"
                raise ModelError(f"equation {text!r}: {which} of D {output} stands there twice; write it once")
            if rubs[1] != output:
                raise ModelError(
                    f"equation {text!r}: friction follows the velocity of the equation's own output, which is "
                    f"{output}, not {rubs[1]}; the sign of a measured rate is the signal coulomb_{rubs[1]}"
                )
            if isinstance(rubs[0], Stribeck):
                near = rubs[0]
            else:
                friction = rubs[0]
        else:
            terms.append(_parse_term(words, sign))
        kind, value, _ = words.peek()
        if kind == "end":
            break
        if not (kind == "symbol" and value in "+-"):
            raise words.fail("'+', '-' or the end")
    if near is not None and friction is None:
        raise ModelError(
            f"equation {text!r}: Stribeck friction is what a body has near rest beyond the friction that it has at "
            f"speed; write '- fc*sign(D {output})' beside it, or '- 0*sign(D {output})' where there is none"
        )
    if near is not None and friction is not None:
        friction = replace(friction, more=near)
    return Equation(output, order, tuple(terms), friction or UNSET), offset, words


def _parse_friction(words: _TokenStream, sign: float) -> tuple[Friction | Stribeck, str] | None:
    """Parse ``fc*sign(D y)`` or ``fs*exp(-(D y/vs)^2)*sign(D y)`` with its signal; None for any other term."""
    ahead = 0
    factor, coefficient = sign, 1.0
    named: str | None = None
    if words.peek(ahead)[0] == "number":
        coefficient = float(words.peek(ahead)[1])
        ahead += 1 + (words.peek(ahead + 1)[1] == "*")
    if words.peek(ahead)[0] == "name" and words.peek(ahead)[1] not in ("D", "sign", "exp"):
        named = words.peek(ahead)[1]
        ahead += 1 + (words.peek(ahead + 1)[1] == "*")
    if words.peek(ahead)[1] not in ("sign", "exp") or words.peek(ahead + 1)[1] != "(":
        return None
    words.position += ahead
    near: tuple[str, str | float] | None = None
    if words.peek()[1] == "exp":
        near = _parse_stribeck_factor(words)
        if words.peek()[1] == "*":
            words.take()
        if words.peek()[1] != "sign":
            raise words.fail(f"sign(D {near[0]})")
    words.take()
    _expect(words, "(")
    if words.peek()[1] != "D" or words.peek(1)[0] != "name":
        raise words.fail("D and the name of a signal, as in sign(D y)")
    words.take()
    signal = words.take()[1]
    _expect(words, ")")
    if near is not None and near[0] != signal:
        raise ModelError(
            f"equation {words.text!r}: Stribeck friction has the speed of {near[0]} and the sign of {signal}; it "
            "follows one velocity"
        )
    if factor > 0:
        shape = "fc*" if near is None else f"fs*exp(-(D {signal}/vs)^2)*"
        raise ModelError(
            f"equation {words.text!r}: friction takes energy, so it is subtracted: write '- {shape}sign(D {signal})'"
        )
    strength = (named, factor * coefficient) if named is not None else (coefficient, factor)
    return (Friction(*strength) if near is None else Stribeck(strength[0], near[1], strength[1])), signal


def _parse_stribeck_factor(words: _TokenStream) -> tuple[str, str | float]:
    """Parse ``exp(-(D y/vs)^2)``: the signal, and name or value of the Stribeck speed."""
    words.take()
    for symbol in "(-(":
        _expect(words, symbol, "-(D y/vs)^2, as in exp(-(D y/vs)^2)")
    if words.peek()[1] != "D" or words.peek(1)[0] != "name":
        raise words.fail("D and the name of a signal, as in exp(-(D y/vs)^2)")
    words.take()
    signal = words.take()[1]
    _expect(words, "/")
    kind, value, _ = words.peek()
    if kind not in ("name", "number"):
        raise words.fail("a speed, its name or a positive number")
    words.take()
    for symbol in (")", "^", "2", ")"):
        _expect(words, symbol, f"'{symbol}', as in exp(-(D y/vs)^2)")
    return signal, float(value) if kind == "number" else value


def _expect(words: _TokenStream, symbol: str, wanted: str | None = None) -> None:
    """Consume an expected symbol; raise if the next token is another one."""
    if words.peek()[1] != symbol:
        raise words.fail(wanted or f"'{symbol}'")
    words.take()


def _is_offset(words: _TokenStream) -> bool:
    """Whether the next term is an unknown constant (offset); raise for a numeric constant."""
    (kind, value, at), (after, symbol, _) = words.peek(), words.peek(1)
    if not (after == "end" or (after == "symbol" and symbol in "+-")):
        return False
    if kind == "number":
        raise ModelError(
            f"equation {words.text!r}: {value} at character {at + 1} is a constant without a signal; an offset is "
            f"unknown: write '+ c' and it is estimated, or subtract a known one from the run"
        )
    return kind == "name" and _OFFSET_PATTERN.fullmatch(value) is not None


def _parse_derivative(words: _TokenStream) -> tuple[Order | None, str]:
    """Parse ``D^order signal`` or ``signal``."""
    kind, value, _ = words.peek()
    order: Order | None = None
    if kind == "name" and value == "D":
        words.take()
        order = Order(1.0)
        if words.peek()[1] == "^":
            words.take()
            order = _parse_order(words)
    return order, _parse_signal(words)


def _parse_signal(words: _TokenStream) -> str:
    """Parse a signal, or an input with nonlinearity such as ``sat(dead(u, 0.05), 0.5:1.2)``."""
    kind, value, _ = words.peek()
    if kind != "name" or value == "D":
        raise words.fail("the name of a signal")
    law = next(
        (law for law in NONLINEARITY_KINDS if INPUT_EFFECT_ABBREVIATIONS[law] == value and words.peek(1)[1] == "("),
        None,
    )
    words.take()
    if law is None:
        words.plain.add(value)
        return value
    words.take()
    before = set(words.plain)
    signal = _parse_signal(words)
    words.plain = before | (words.plain - {signal})
    if law == "dead_zone" and (signal, "saturation") in words.limits:
        raise ModelError(
            f"equation {words.text!r}: a dead zone acts before a saturation: write sat(dead({signal}, …), …)"
        )
    if words.take()[1] != ",":
        words.position -= 1
        raise words.fail("',' and the limit, as in sat(u, 0.94)")
    ends = [_parse_number(words)]
    if words.peek()[1] == ":":
        words.take()
        ends.append(_parse_number(words))
    if words.take()[1] != ")":
        words.position -= 1
        raise words.fail("')'")
    limit = ends[0] if len(ends) == 1 else (ends[0], ends[1])
    if words.limits.setdefault((signal, law), limit) != limit:
        raise ModelError(f"equation {words.text!r}: {signal} has two limits of one kind; an actuator has one")
    return signal


def _parse_number(words: _TokenStream) -> float:
    kind, value, _ = words.peek()
    if kind != "number":
        raise words.fail("a limit, or LEAST:LARGEST where it is estimated")
    words.take()
    return float(value)


def _parse_order(words: _TokenStream) -> Order:
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


def _parse_term(words: _TokenStream, sign: float) -> Term:
    factor = sign
    if words.peek()[0] == "number":
        factor *= float(words.take()[1])
        if words.peek()[1] == "*":
            words.take()
    coefficient: str | float = 1.0
    kind, value, _ = words.peek()
    following = words.peek(1)
    # A name followed by a signal or a derivative is a coefficient.
    if kind == "name" and value != "D" and (following[0] == "name" or following[1] == "*"):
        coefficient = value
        words.take()
        if words.peek()[1] == "*":
            words.take()
    order, signal = _parse_derivative(words)
    if coefficient == 1.0:
        return Term(signal, order or Order(), factor, 1.0)
    return Term(signal, order or Order(), coefficient, factor)
