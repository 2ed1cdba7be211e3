"""Tokens of an equation text, with parsers of the signs, numbers and orders that all parts of the grammar share."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator

from ftlm.errors import ModelError
from ftlm.structure.expression import EXPRESSION_FUNCTIONS
from ftlm.structure.input_nonlinearity import Value
from ftlm.structure.order import Order
from ftlm.utils.parameters import parameter
from ftlm.utils.validation import nearest

IDENTIFIER_PATTERN = r"[^\W\d]\w*"
_TOKEN_PATTERN = re.compile(
    rf"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>{IDENTIFIER_PATTERN})|(?P<symbol>[-+*/^(){{}}=,:']))"
)
#: Typographic minus and multiplication signs, mapped to the symbols of the grammar.
_PRINTED_SIGNS = str.maketrans("−·⋅×", "-***")
_SUPERSCRIPT_PATTERN = re.compile("[⁰¹²³⁴-⁹]+")
#: A signal of one letter with optional combining dots above it, and its optional subscript.
_DOTTED_PATTERN = re.compile(
    r"(?<![\w\u0307\u0308\u20db])([^\W\d_][\u0307\u0308\u20db]*)((?:_\w*|\d+)?)(?![\w\u0307\u0308\u20db])"
)
#: Order of the derivative that a combining dot, two dots and three dots stand for.
_DOT_ORDERS = {"\u0307": 1, "\u0308": 2, "\u20db": 3}
#: Letters whose two dots belong to the alphabet and do not mean a derivative.
_UMLAUT_LETTERS = "äëïöüÄËÏÖÜ"


def _prime_notation(dotted: re.Match[str]) -> str:
    """Return a one-letter signal with primes in place of dots, such as y'' for ÿ; return other names unchanged."""
    name, rest = dotted.groups()
    parts = unicodedata.normalize("NFD", name)
    if name in _UMLAUT_LETTERS or not set(parts[1:]) <= set(_DOT_ORDERS):
        return dotted.group()
    return f"{parts[0]}{rest}{chr(39) * sum(_DOT_ORDERS[dot] for dot in parts[1:])}"


#: Names that are parsed as functions before a parenthesis; for an unsupported one, the error message names it.
FUNCTION_NAMES = ("sin", "cos", "tan", "tanh", "exp", "log", "ln", "abs", "sqrt", "sign", "atan", "arctan")
#: Functions that an equation may have, with sign for friction.
KNOWN_FUNCTIONS = (*EXPRESSION_FUNCTIONS, "sat", "dead", "sign")
FUNCTION_LIST_TEXT = f"of the functions of signals only {', '.join(EXPRESSION_FUNCTIONS)}, sat and dead are computed"


class TokenReader:
    """Reader of the tokens of an equation text, with errors that name the position.

    Parameters
    ----------
    text
        Text of the equation.
    """

    def __init__(self, text: str) -> None:
        text = _SUPERSCRIPT_PATTERN.sub(lambda power: "^" + unicodedata.normalize("NFKC", power[0]), text)
        text = _DOTTED_PATTERN.sub(_prime_notation, unicodedata.normalize("NFC", text))
        self.text = text
        self._tokens: list[tuple[str, str, int]] = []
        self._index = 0
        # Replacements have the length of the originals, so that positions in error messages stay valid.
        normalized = text.translate(_PRINTED_SIGNS).replace("**", "^ ")
        position = 0
        while normalized[position:].strip():
            token = _TOKEN_PATTERN.match(normalized, position)
            if token is None:
                start = position + len(normalized[position:]) - len(normalized[position:].lstrip())
                at_character = f"{text[start]!r} at character {start + 1}"
                raise ModelError(f"equation {text!r}: unexpected {at_character}; remove it")
            kind = str(token.lastgroup)
            self._tokens.append((kind, token[kind], token.start(kind)))
            position = token.end()
        self._normalized = normalized

    def _peek(self, offset: int = 0) -> tuple[str, str, int]:
        index = self._index + offset
        return self._tokens[index] if index < len(self._tokens) else ("end", "the end", len(self.text))

    def _take(self) -> tuple[str, str, int]:
        token = self._peek()
        self._index += 1
        return token

    def _next_is(self, *values: str) -> bool:
        """Whether the next tokens are the given texts."""
        return all(self._peek(k)[1] == value for k, value in enumerate(values))

    def _accept(self, symbol: str) -> bool:
        """Consume the next token if it is the given symbol, and return whether it was."""
        is_match = self._peek()[:2] == ("symbol", symbol)
        self._index += is_match
        return is_match

    def _expect(self, symbol: str, expectation: str | None = None) -> None:
        if self._peek()[1] != symbol:
            raise self._syntax_error(expectation or f"'{symbol}'")
        self._take()

    def _error(self, message: str) -> ModelError:
        return ModelError(f"equation {self.text!r}: {message}")

    def _syntax_error(self, expectation: str) -> ModelError:
        kind, value, position = self._peek()
        found = value if kind == "end" else repr(value)
        if kind == "symbol" and value in ",:'":
            remedy = "separate equations by ';'" if value == "," and "=" in self.text[position:] else "remove it"
            return self._error(f"unexpected {value!r} at character {position + 1}; {remedy}")
        if value == "D" or (expectation == "the name of a signal" and self._index > 0 and self._peek(-1)[1] == "D"):
            return self._error(
                f"expected {expectation} at character {position + 1}, found {found}; D is the derivative in an "
                f"equation: rename a signal called D, such as by {parameter('outputs', {'y': 'D'})}"
            )
        remedy = "write it as in 'D^1.5 y = a1 D^0.5 y + a0 y + b0 u'"
        before = self._peek(-1) if self._index else ("", "", 0)
        if before[0] == kind == "name":
            remedy = f"a name has no blanks: write {f'{before[1]}_{value}'!r} for one signal"
            if self._index > 1 and self._peek(-2)[0] == "name":
                remedy += f", and one name for a product of coefficients, as in 'a1 {value}'"
        elif kind == "name" and self._index > 1 and self._peek(-2)[1] == "^":
            remedy = f"a power of a coefficient is a coefficient: write one name for it, as in 'a1 {value}'"
        elif before[0] == "name" and value == "(":
            remedy = f"{before[1]!r} is no known function{nearest(before[1], KNOWN_FUNCTIONS)}; {FUNCTION_LIST_TEXT}"
        return self._error(f"expected {expectation} at character {position + 1}, found {found}; {remedy}")

    def _signs(self) -> Iterator[float]:
        """Yield the sign of each term of a sum, up to the first token that cannot continue it."""
        is_first = True
        while is_first or self._next_is("+") or self._next_is("-"):
            is_first, sign = False, 1.0
            while self._next_is("+") or self._next_is("-"):
                sign *= -1.0 if self._take()[1] == "-" else 1.0
            yield sign

    def _divisors(self, factor: float) -> float:
        """Parse divisions by numbers at the end of a product, and return `factor` divided by them."""
        while self._accept("/"):
            kind, value, position = self._peek()
            if kind != "number" or float(value) == 0.0:
                raise self._error(
                    f"{value!r} at character {position + 1} divides, but a divisor must be a number other than 0; "
                    "write a coefficient instead, as in a y for y/T"
                )
            factor /= float(self._take()[1])
        return factor

    def _value(self, expectation: str) -> Value:
        """Parse a number or an interval ``low:high``, and return it; `expectation` is the text of the syntax error."""
        bounds = []
        while True:
            sign = -1.0 if self._accept("-") else 1.0
            if self._peek()[0] != "number":
                raise self._syntax_error(expectation)
            bounds.append(sign * float(self._take()[1]))
            if len(bounds) == 2 or not self._accept(":"):
                return bounds[0] if len(bounds) == 1 else (bounds[0], bounds[1])

    def _order(self) -> Order:
        """Parse an order (a number, a name, or an expression in parentheses), and return it."""
        kind, value, start = self._peek()
        if value in "({" and kind == "symbol":
            closing = ")" if value == "(" else "}"
            self._take()
            depth, text_start, position = 1, start + 1, start + 1
            while depth:
                kind, token, position = self._take()
                if kind == "end":
                    self._index -= 1
                    raise self._syntax_error(f"'{closing}'")
                depth += token in "({" and kind == "symbol"
                depth -= token in ")}" and kind == "symbol"
            return self._order_from(self._normalized[text_start:position], text_start)
        sign = "-" if self._accept("-") else ""
        kind, value, _ = self._peek()
        if kind not in ("number", "name"):
            raise self._syntax_error("an order: a number, a name or (…)")
        self._take()
        return self._order_from(sign + value, start)

    def _order_from(self, text: str, position: int) -> Order:
        try:
            return Order.parse(text)
        except ModelError as error:
            raise self._error(f"at character {position + 1}: {error}") from error
