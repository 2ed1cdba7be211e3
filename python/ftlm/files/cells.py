"""Cells of text: their numbers, the lines that they are cut from, and what names and units look like."""

from __future__ import annotations

import csv
import functools
import re

from ftlm.base.errors import DataError
from ftlm.data.units import TIME_UNITS, header_time, spelled_unit

DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?|[+-]?\d+,(?:[eE][+-]?\d+)?")
#: What stands before a unit at the end of a name, where it has no brackets.
_BEFORE_UNITS = (" / ", ",", " in ")
#: What people group thousands by, as character classes.
THOUSANDS = {"point": "[.]", "comma": "[,]", "space": "[ \u00a0\u202f]", "apostrophe": "['\u2019]"}
#: Exponents of Fortran; without a point or a sign, a D between digits is part of a name.
_FORTRAN = re.compile(r"\s*[+-]?(?:(?:\d+[.]\d*|[.]\d+)[dD][+-]?\d{1,3}|\d+[dD][+-]\d{1,3})\s*", re.ASCII)
#: What stands for no number, without capitals.
_GAPS = frozenset(("", "n/a", "na", "#n/a", "null", "none", "-", "--", "---"))


@functools.cache
def _grouped(mark: str, comma: bool) -> re.Pattern[str]:
    """A number whose thousands are grouped; its decimals, if any, are a group of the pattern."""
    point = "," if comma else "[.]"
    return re.compile(
        rf"\s*[+-]?[1-9]\d{{0,2}}(?:{THOUSANDS[mark]}\d{{3}})+({point}\d*)?(?:[eE][+-]?\d{{1,3}})?\s*", re.ASCII
    )


def grouping(cell: str, *, comma: bool) -> str | None:
    """What groups the thousands of a number, where that can be nothing else: decimals stand behind it."""
    if len(cell) < len("1.234,"):
        return None
    for mark in THOUSANDS:
        found = _grouped(mark, comma).fullmatch(cell) if mark != ("comma" if comma else "point") else None
        if found and found[1]:
            return mark
    return None


def may_group(cell: str, mark: str, *, comma: bool) -> bool:
    """Whether a cell is a number whose thousands this mark may group, decimals behind it or not."""
    return _grouped(mark, comma).fullmatch(cell) is not None


def number(cell: str, *, comma: bool = False, mark: str | None = None) -> float:
    """Return the number in a cell; `ValueError` where there is none.

    Python's numbers may have underscores between their digits, those of files have not; where commas are decimal,
    points may group digits, so that a number with one is none unless `mark` says that they do.
    """
    if mark is not None and may_group(cell, mark, comma=comma):
        cell = re.sub(THOUSANDS[mark], "", cell)
    if "_" in cell or (comma and "." in cell):
        raise ValueError(cell)
    text = cell.replace(",", ".") if comma else cell
    try:
        return float(text)
    except ValueError:
        if not _FORTRAN.fullmatch(text):
            raise
        return float(text.replace("D", "e").replace("d", "e"))


def is_number(cell: str, *, comma: bool = False, mark: str | None = None) -> bool:
    """Whether a cell holds a number."""
    try:
        number(cell, comma=comma, mark=mark)
    except ValueError:
        return False
    return True


def is_gap(cell: str) -> bool:
    """Whether a cell is empty, or says that there is no number."""
    return cell.strip().casefold() in _GAPS


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


def behind_a_stroke(name: str) -> tuple[str, str]:
    """What a column of text is called, and the known unit behind the stroke of ``I/A``, as written; "" for none."""
    bare, stroke, unit = (part.strip() for part in name.partition("/"))
    known = stroke and bare and unit and spelled_unit(unit) is not None
    return (bare, unit) if known and spelled_unit(name) is None and not is_gap(name) and unit != "1" else (name, "")


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
