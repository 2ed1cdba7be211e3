"""Cells of text: their numbers, the lines that they are cut from, and what names and units look like."""

from __future__ import annotations

import csv
import functools
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ftlm.data.units import TIME_UNITS, header_time, spelled_unit
from ftlm.errors import DataError
from ftlm.utils.validation import Floats, bad_rows

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


_CLOCK = (
    r"([01]?\d|2[0-4]):([0-5]\d)(?::([0-5]\d|60)(?:[.,](\d{1,9})\d*)?)?(?:\s*([AaPp])\.?[Mm]\.?)?"
    r"\s*(Z|[+-]\d{2}:?[0-5]\d)?"
)
_DATE = r"(?=\d{4}[-./]|\d{1,2}[-./]\d{1,2}[-./]\d{2})(\d{4}|\d{1,2})([-./])(\d{1,2})\2(\d{4}|\d{1,2})"
_MOMENT = re.compile(rf"\s*(?:{_DATE}(?:(?:\s+|T){_CLOCK})?|{_CLOCK})\s*", re.ASCII)
#: A time that passed, as ISO 8601 writes it in seconds alone: cells of spreadsheets that hold one are told so.
_PASSED = re.compile(r"\s*(-?)PT(\d{1,9})(?:\.(\d{1,9}))?S\s*", re.ASCII)
_NS = 1_000_000_000
_LONGEST = 64


def is_moment(cell: str) -> bool:
    """Whether a cell holds a date, a time of day, both, or a time that passed."""
    return _match(cell) is not None or _PASSED.fullmatch(cell) is not None


def _match(cell: str) -> re.Match[str] | None:
    """The parts of a moment; None where it is none, as 13:00 AM and 24:30."""
    text = cell.strip()
    found = _MOMENT.fullmatch(text) if len(text) <= _LONGEST else None
    if found is None:
        return None
    groups = found.groups("")
    hour, minute, second, fraction, half, _ = groups[4:10] if groups[1] else groups[10:16]
    late = hour == "24" and int(f"0{minute}{second}{fraction}") > 0
    return None if late or (half and int(hour) > 12) else found


@dataclass(frozen=True)
class Moments:
    """Moments as they were written.

    Parameters
    ----------
    parts
        The three numbers of each date in the order in which they stand, shape (N, 3); zeros of a time of day alone.
    mark
        What stands between them; "" where there is no date.
    clock
        Time of day [ns], less the offset of its time zone, shape (N,).
    first
        The first cell.
    way
        How they are written: what stands between the numbers of a date, whether with a time zone, with halves of days.
    """

    parts: npt.NDArray[np.int64]
    mark: str
    clock: npt.NDArray[np.int64]
    first: str
    way: tuple[object, ...] = ()

    @classmethod
    def read(cls, cells: Sequence[str]) -> Moments | None:
        """Moments of all cells; None where one is no moment, or written otherwise than the first."""
        spans = [_PASSED.fullmatch(cell) for cell in cells]
        if all(span is not None for span in spans) and cells:
            clock = np.array([_span(*span.groups("")) for span in spans if span is not None], np.int64)
            return cls(np.zeros((clock.size, 3), np.int64), "", clock, cells[0].strip(), ("passed",))
        found = [_match(cell) for cell in cells]
        if not found or any(match is None for match in found):
            return None
        groups = [match.groups("") for match in found if match is not None]
        mark = groups[0][1]
        zoned = bool(groups[0][9] or groups[0][15])
        rows = [(*g[:4], *(g[4:10] if g[1] else g[10:16])) for g in groups]
        halved = bool(rows[0][8])
        if any(row[1] != mark or bool(row[9]) != zoned or bool(row[8]) != halved for row in rows):
            return None
        parts = np.array([(int(r[0] or 0), int(r[2] or 0), int(r[3] or 0)) for r in rows], np.int64)
        clock = np.array([_clock(*row[4:]) for row in rows], np.int64)
        return cls(parts, mark, clock, cells[0].strip(), (mark, zoned, halved))

    @classmethod
    def joined(cls, pieces: Sequence[Moments]) -> Moments | None:
        """Moments of one column that was read in pieces; None where these are written in several ways."""
        if len({piece.way for piece in pieces}) > 1:
            return None
        return cls(
            np.concatenate([p.parts for p in pieces]),
            pieces[0].mark,
            np.concatenate([p.clock for p in pieces]),
            pieces[0].first,
            pieces[0].way,
        )

    def seconds(self, thing: str, dates: str | None) -> Floats:
        """Seconds since the first row, exact to the nanosecond.

        Parameters
        ----------
        thing
            What errors call the column.
        dates
            Order of day and month, where a person says it.

        Raises
        ------
        DataError
            A date that is none, or whose order of day and month is open.
        """
        since = self.clock
        if not self.mark:
            return np.asarray((since - since[0]) / _NS)
        year, month, day = (self.parts[:, place] for place in self._order(thing, dates))
        year = np.where(year < 100, year + 2000, year)
        bad = (month < 1) | (month > 12) | (day < 1) | (day > _lengths(year, np.clip(month, 1, 12)))
        if bad.any():
            raise bad_rows(
                thing,
                "a date that is none",
                int(np.flatnonzero(bad)[0]),
                int(bad.sum()),
                "correct these rows, or say the order of day and month with layout=dict(dates='dmy')",
            )
        months = (12 * (year - 1970) + month - 1).astype("datetime64[M]")
        days = months.astype("datetime64[D]").astype(np.int64) + day - 1
        return np.asarray((days - days[0]) * 86400.0 + (since - since[0]) / _NS)

    def inferred(self, dates: str | None) -> str:
        """Order of day and month where it was inferred and any number depends on it; "" where not."""
        if not self.mark or dates is not None or (self.parts == self.parts[0]).all():
            return ""
        order = self._likely()
        return "" if order == "ymd" else order

    def _likely(self) -> str:
        """The order that the dates themselves tell; "" where they leave it open."""
        first, second, last = self.parts.max(axis=0)
        if first > 31:
            return "ymd"
        if second > 12 >= first:
            return "mdy"
        # Dates with points begin with the day; of others the numbers may tell, and one day is the same either way.
        told = self.mark == "." or (first > 12 and last > 31) or (self.parts == self.parts[0]).all()
        return "dmy" if told else ""

    def _order(self, thing: str, dates: str | None) -> tuple[int, int, int]:
        """Places of year, month and day."""
        first, likely = self.parts[:, 0].max(), self._likely()
        order = likely if likely == "ymd" or dates is None else dates
        if order:
            return {"ymd": (0, 1, 2), "dmy": (2, 1, 0), "mdy": (2, 0, 1)}[order]
        if first > 12:
            raise DataError(
                f"{thing}: {self.first!r} may begin with the year or with the day; say layout=dict(dates='ymd') or "
                "layout=dict(dates='dmy')"
            )
        raise DataError(
            f"{thing}: {self.first!r} may begin with the day or with the month; say layout=dict(dates='dmy') or "
            "layout=dict(dates='mdy')"
        )


def _clock(hour: str, minute: str, second: str, fraction: str, half: str, zone: str) -> int:
    """Time of day [ns], in universal time where it has a zone."""
    hours, offset = int(hour or 0), 0
    if half:
        hours = hours % 12 + (12 if half in "Pp" else 0)
    if zone and zone != "Z":
        digits = zone[1:].replace(":", "")
        offset = (1 if zone[0] == "+" else -1) * (int(digits[:2]) * 60 + int(digits[2:]))
    minutes = hours * 60 + int(minute or 0) - offset
    return (minutes * 60 + int(second or 0)) * _NS + int((fraction or "0").ljust(9, "0"))


def _span(sign: str, whole: str, fraction: str) -> int:
    """A time that passed [ns]."""
    nanoseconds = int(whole) * _NS + int(fraction.ljust(9, "0") or 0)
    return -nanoseconds if sign else nanoseconds


def _lengths(year: npt.NDArray[np.int64], month: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Days of months."""
    leap = (year % 4 == 0) & ((year % 100 != 0) | (year % 400 == 0))
    days = np.array([31, 28, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31])[month - 1]
    return np.asarray(days + (leap & (month == 2)))
