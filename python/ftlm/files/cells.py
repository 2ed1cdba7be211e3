"""Cells of text: their numbers, the lines that they are cut from, and what names and units look like."""

from __future__ import annotations

import csv
import re

from ftlm.base.errors import DataError
from ftlm.data.units import TIME_UNITS, header_time, spelled_unit

DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?|[+-]?\d+,(?:[eE][+-]?\d+)?")
#: What stands before a unit at the end of a name, where it has no brackets.
_BEFORE_UNITS = (" / ", ",", " in ")


def number(cell: str, *, comma: bool = False) -> float:
    """Return the number in a cell; `ValueError` where there is none.

    Python's numbers may have underscores between their digits, those of files have not; where commas are decimal,
    points may group digits, so that a number with one is none.
    """
    if "_" in cell or (comma and "." in cell):
        raise ValueError(cell)
    return float(cell.replace(",", ".")) if comma else float(cell)


def is_number(cell: str, *, comma: bool = False) -> bool:
    """Whether a cell holds a number."""
    try:
        number(cell, comma=comma)
    except ValueError:
        return False
    return True


def split(lines: list[str], separator: str | None, source: str, first: int) -> list[list[str]]:
    """Cut lines into cells, quoted ones whole."""
    if separator is None:
        return [line.split() for line in lines]
    if not any('"' in line for line in lines):
        return [line.split(separator) for line in lines]
    try:
        rows = list(csv.reader(lines, delimiter=separator, strict=True))
    except csv.Error as error:
        raise DataError(f"{source}: quotes after line {first} cannot be read ({error}); correct them") from None
    if len(rows) != len(lines):
        raise DataError(f"{source}: a quoted cell after line {first} spans lines; correct the quotes")
    return rows


def stated_unit(name: str) -> tuple[str, str]:
    """What a column is called, and the unit that its name states, both as written; "" for none.

    Any in brackets; a known one in ``Strom / A``, ``Current, A`` and ``Winkel in Grad``.
    """
    # Without regular expressions, whose time would grow with the cube of a long name's spaces.
    text = name.rstrip()
    opening = {"]": "[", ")": "("}.get(text[-1:])
    if opening is None:
        for before in _BEFORE_UNITS:
            bare, mark, unit = text.rpartition(before)
            if mark and bare.strip() and spelled_unit(unit.strip()) is not None:
                return bare.rstrip(), unit.strip()
        return name, ""
    bare, mark, unit = text[:-1].rpartition(opening)
    bare, unit = bare.rstrip().removesuffix(" /").rstrip(), unit.strip()
    return (bare, unit) if mark and bare and unit and text[-1] not in unit else (name, "")


def _bracketed(cell: str) -> str | None:
    """What stands in the brackets that a cell consists of; None where it does not."""
    text = cell.strip()
    whole = len(text) > 1 and text[0] in "[(" and text[-1] in "])" and not any(c in "[]()" for c in text[1:-1])
    return text[1:-1].strip() if whole else None


def is_unit(cell: str) -> bool:
    """Whether a cell can stand in a row of units."""
    bracketed = _bracketed(cell)
    word = cell.strip() if bracketed is None else bracketed
    short = bracketed is not None and len(word) <= 12
    return not word or spelled_unit(word) is not None or is_time_unit(word) or short


def is_time_unit(word: str) -> bool:
    """Whether a word is a unit of time in any of its writings."""
    return bool(word) and header_time(f"t [{word}]")[1] in TIME_UNITS


def unit_of(cell: str) -> str:
    """The unit that a cell of a row of units holds, without its brackets."""
    bracketed = _bracketed(cell)
    return cell.strip() if bracketed is None else bracketed
