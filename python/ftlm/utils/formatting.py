"""Formatting of text: Greek symbols, significant digits, word wrap, control characters, and values for JSON."""

from __future__ import annotations

import math
import re
import shutil
import sys
import textwrap
import unicodedata
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from numbers import Integral
from typing import Any, TextIO, cast

from markupsafe import Markup

#: Number of significant digits of printed estimates: enough for a comparison with the paper.
SIGNIFICANT_DIGITS = 5
DIVERGED_TEXT = "diverged"
#: Maximum and minimum line length [characters].
MAX_LINE_CHARACTERS, MIN_LINE_CHARACTERS = 110, 40
_EQUATION_PATTERN = re.compile(r"D\^?\S* \S+ = ")
GREEK_LETTERS = {
    name: unicodedata.lookup(f"GREEK SMALL LETTER {name}")
    for name in ("alpha", "beta", "gamma", "delta", "theta", "mu", "nu", "tau", "phi", "omega")
}
_SUBSCRIPT_DIGITS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
SUPERSCRIPT_DIGITS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
SYMBOL_PATTERN = re.compile(rf"({'|'.join(GREEK_LETTERS)}|[A-Za-z])_?(\d*)", re.ASCII)


def symbol(name: str) -> str:
    """Return a name as a symbol, such as θ₁₂ for ``theta12``; other names are returned unchanged."""
    match = SYMBOL_PATTERN.fullmatch(name)
    if not match:
        return name
    return GREEK_LETTERS.get(match[1], match[1]) + match[2].translate(_SUBSCRIPT_DIGITS)


def symbol_html(name: str) -> Markup:
    """Return a name as an HTML symbol, such as θ with the subscript 12 for ``theta12``; the text is escaped."""
    match = SYMBOL_PATTERN.fullmatch(name)
    if not match:
        return Markup("<i>{}</i>").format(name)
    stem = Markup("<i>{}</i>").format(GREEK_LETTERS.get(match[1], match[1]))
    return stem + Markup("<sub>{}</sub>").format(match[2]) if match[2] else stem


#: A derivative of order 1, whose order is not shown; and an exponent: an expression in parentheses, a number or a name.
_FIRST_DERIVATIVE_PATTERN = re.compile(r"\bD\^1(?![\w.])")
_EXPONENT_PATTERN = re.compile(r"\^(?:\(([^()]*)\)|([-−]?\d+(?:\.\d+)?|[-−]?[^\W\d]\w*))")


def split_exponents(text: str) -> list[str]:
    """Return alternately the texts and the exponents of an expression such as ``D^1.5 y``; ``D^1`` is written as D."""
    parts = [part for part in _EXPONENT_PATTERN.split(_FIRST_DERIVATIVE_PATTERN.sub("D", text)) if part is not None]
    return [symbol(part).replace("-", "−") if k % 2 else part for k, part in enumerate(parts)]


def typeset(text: str) -> Markup:
    """Return a text as HTML, with superscripts for exponents such as that of ``s^-0.9``, and with minus signs.

    ``Markup`` is returned unchanged.
    """
    if isinstance(text, Markup):
        return text
    parts = split_exponents(with_minus_signs(text))
    return Markup("").join(Markup("<sup>{}</sup>" if k % 2 else "{}").format(part) for k, part in enumerate(parts))


class Exact(float):
    """Number that is not an estimate, such as an order on a grid, and is printed with up to ten digits."""


Cell = str | float | None


def number(value: float, digits: int = SIGNIFICANT_DIGITS) -> str:
    """Return a number as text with `digits` significant digits; infinity is "∞ diverged", and NaN is "undefined"."""
    if isinstance(value, Integral):
        return f"{value:,}".replace(",", "\u202f")
    if math.isnan(value):
        return "undefined"
    if math.isinf(value):
        return f"{'−' if value < 0 else ''}∞ {DIVERGED_TEXT}"
    if value == 0:
        return "0"
    text = f"{value:.10g}" if isinstance(value, Exact) else f"{value:#.{digits}g}"
    mantissa, _, exponent = text.partition("e")
    mantissa = mantissa.removesuffix(".").replace("-", "−")
    return f"{mantissa}×10{str(int(exponent)).translate(SUPERSCRIPT_DIGITS)}" if exponent else mantissa


def format_bound(value: float, spec: str = ".3g") -> str:
    """Return a standard error or an interval bound as text in the format `spec`; infinity is "∞"."""
    return f"{'−' if value < 0 else ''}∞" if math.isinf(value) else f"{value:{spec}}"


#: Hyphen before a number, at the start of a word; options such as ``--bounds a=-1:1`` have none.
_HYPHEN_OF_NUMBER = re.compile(r"(?<![^\s(\[±])-(?=\.?\d)")


def with_minus_signs(text: str) -> str:
    """Return a text in which the hyphen of a negative number is replaced by a minus sign (−), for HTML pages."""
    return _HYPHEN_OF_NUMBER.sub("−", text)


def plural(count: int, noun: str, verb: str = "") -> str:
    """Return a count with a noun and a verb that agree in number, such as ``3 rows remain`` or ``1 row is``.

    `noun` is given in the singular, and `verb` in the plural.
    """
    singular = {"": "", "are": " is"}.get(verb, f" {verb}s")
    return f"{count} {noun}{singular if count == 1 else f's {verb}'.rstrip()}"


def truncate_text(text: str, max_length: int) -> str:
    """Return a text, truncated with an ellipsis if it has more than `max_length` characters."""
    return text if len(text) <= max_length else text[: max_length - 1] + "…"


def with_error(value: float, error: float | None) -> str:
    """Return "value ± error" rounded to two digits of the error; without an error, the value with five digits."""
    if error is None or not math.isfinite(error) or error <= 0 or not math.isfinite(value):
        return f"{value:.5g}"
    decimals = 1 - math.floor(math.log10(error))
    if abs(value) >= 1e6 or not 0 <= decimals <= 9:
        return f"{value:.5g} ± {error:.2g}"
    return f"{value:.{decimals}f} ± {error:.{decimals}f}"


def line_length() -> int:
    """Return the line length [characters] of the terminal or of the variable ``COLUMNS``, limited to 40 … 110."""
    return min(
        max(shutil.get_terminal_size((MAX_LINE_CHARACTERS, 40)).columns, MIN_LINE_CHARACTERS), MAX_LINE_CHARACTERS
    )


def wrap_text(text: str, lead: str = "", indent: str | None = None) -> list[str]:
    """Return a text as a list of lines that fit the terminal; see :func:`line_length`.

    The first line begins with `lead`, and each other line with `indent` (by default spaces).
    """
    # Equations break between their terms. Texts such as "1 ± 2" and "3 %" do not break.
    text = re.sub(" (?![+-] )" if _EQUATION_PATTERN.match(text) else " (?=[±%])|(?<=±) ", "\u00a0", text)
    lines = textwrap.wrap(
        text,
        line_length(),
        initial_indent=lead,
        subsequent_indent=" " * (len(lead) or 2) if indent is None else indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [line.replace("\u00a0", " ") for line in lines]


#: Characters that control a terminal: controls except tab and line feed, marks of text direction, line separators.
_CONTROL_PATTERN = re.compile("[\\x00-\\x08\\x0b-\\x1f\\x7f-\\x9f\\u061c\\u200e\\u200f\\u2028-\\u202e\\u2066-\\u2069]")


def escape_controls(text: str) -> str:
    """Return a text with control characters replaced by JSON escapes."""
    return _CONTROL_PATTERN.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


class EscapedStream:
    """Text stream to a terminal that escapes control characters in all texts written to it.

    Parameters
    ----------
    stream
        Stream that receives the escaped text. Progress bars are written to it directly.
    """

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        """Write a text with escaped control characters, and return the length of the original text."""
        self.stream.write(escape_controls(text))
        return len(text)

    def writelines(self, lines: Any) -> None:
        """Write several texts with escaped control characters."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        # A library with access to the underlying byte stream would write without escapes.
        if name in ("buffer", "detach"):
            raise AttributeError(name)
        return getattr(self.stream, name)


def escape_standard_streams() -> None:
    """Replace standard output and standard error by escaped streams, unless they are escaped already."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if not isinstance(stream, EscapedStream):
            setattr(sys, name, cast("TextIO", EscapedStream(stream)))


def finite(value: float) -> float | None:
    """Return a float for JSON, or None if it is not finite."""
    return float(value) if math.isfinite(value) else None


def attributes(value: object, names: Iterable[str]) -> dict[str, Any]:
    """Return the attributes in `names` of an object as a JSON-compatible dictionary; see :func:`json_value`."""
    return {name: json_value(getattr(value, name)) for name in names}


def json_value(value: Any) -> Any:
    """Return a JSON-compatible value: dataclasses become dictionaries, and nonfinite numbers become None."""
    if isinstance(value, Mapping):
        return {f"{k:g}" if isinstance(k, float) else str(k): json_value(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_value(item) for item in value]
    if hasattr(value, "to_dict"):
        return value.to_dict()
    if is_dataclass(value):
        return attributes(value, [item.name for item in fields(value)])
    return finite(value) if isinstance(value, float) else value
