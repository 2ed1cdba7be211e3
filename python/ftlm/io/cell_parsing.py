"""Parsing of text cells: numbers, units, dates and times of day."""

from __future__ import annotations

import csv
import functools
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ftlm.data.sampling import masked_rows_error
from ftlm.data.units import TIME_UNITS, parse_unit, split_time_header
from ftlm.errors import DataError
from ftlm.utils.parameters import layout_parameter
from ftlm.utils.validation import Floats

DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?|[+-]?\d+,(?:[eE][+-]?\d+)?")
#: Separators before a unit that ends a column name without brackets.
_BEFORE_UNITS = (" / ", ",", " in ")
#: Thousands separators, as regular-expression character classes.
THOUSANDS_SEPARATORS = {"point": "[.]", "comma": "[,]", "space": "[ \u00a0\u202f]", "apostrophe": "['\u2019]"}
#: Numbers with a Fortran exponent D; a point or a sign is required, because a bare D between digits can be a name.
_FORTRAN_NUMBER_PATTERN = re.compile(
    r"\s*[+-]?(?:(?:\d+[.]\d*|[.]\d+)[dD][+-]?\d{1,3}|\d+[dD][+-]\d{1,3})\s*", re.ASCII
)
#: Numbers of case-folded Boolean cells, equal to those of Boolean columns of other formats.
_TRUTH_VALUES = {"true": 1.0, "false": 0.0}
#: Case-folded cell texts that mean a missing value.
_MISSING_VALUE_TEXTS = frozenset(("", "n/a", "na", "#n/a", "null", "none", "-", "--", "---"))


@functools.cache
def _grouped_number_pattern(separator: str, comma: bool) -> re.Pattern[str]:
    """Return a regular expression for numbers with grouped thousands; its group 1 is the decimal mark and decimals.

    `separator` is the name of the thousands separator. `comma` states whether the decimal mark is a comma.
    """
    point = "," if comma else "[.]"
    return re.compile(
        rf"\s*[+-]?[1-9]\d{{0,2}}(?:{THOUSANDS_SEPARATORS[separator]}\d{{3}})+({point}\d*)?(?:[eE][+-]?\d{{1,3}})?\s*",
        re.ASCII,
    )


def detect_thousands_separator(cell: str, *, comma: bool) -> str | None:
    """Return the name of the thousands separator in a number, or None unless decimals make it unambiguous.

    `comma` states whether the decimal mark is a comma.
    """
    if len(cell) < len("1.234,"):
        return None
    for separator in THOUSANDS_SEPARATORS:
        pair = (
            _grouped_number_pattern(separator, comma).fullmatch(cell)
            if separator != ("comma" if comma else "point")
            else None
        )
        if pair and pair[1]:
            return separator
    return None


def may_group(cell: str, separator: str, *, comma: bool) -> bool:
    """Whether a cell may be a number with the thousands separator named `separator`; `comma` means decimal commas."""
    return _grouped_number_pattern(separator, comma).fullmatch(cell) is not None


def parse_number(cell: str, *, comma: bool = False, thousands_separator: str | None = None) -> float:
    """Return the number in a cell, 1 for true and 0 for false; raise ValueError if there is none.

    `comma` states whether the decimal mark is a comma, and `thousands_separator` is the name of the thousands
    separator. Underscores between digits, which Python accepts, are rejected. With decimal commas, points are accepted
    as thousands separators only.
    """
    if thousands_separator is not None and may_group(cell, thousands_separator, comma=comma):
        cell = re.sub(THOUSANDS_SEPARATORS[thousands_separator], "", cell)
    if "_" in cell or (comma and "." in cell):
        raise ValueError(cell)
    text = cell.replace(",", ".") if comma else cell
    truth = _TRUTH_VALUES.get(text.strip().casefold())
    if truth is not None:
        return truth
    try:
        return float(text)
    except ValueError:
        if not _FORTRAN_NUMBER_PATTERN.fullmatch(text):
            raise
        return float(text.replace("D", "e").replace("d", "e"))


def is_number(cell: str, *, comma: bool = False, thousands_separator: str | None = None) -> bool:
    """Whether a cell is a number; arguments are those of :func:`parse_number`."""
    try:
        parse_number(cell, comma=comma, thousands_separator=thousands_separator)
    except ValueError:
        return False
    return True


def is_gap(cell: str) -> bool:
    """Whether a cell represents a missing value."""
    return cell.strip().casefold() in _MISSING_VALUE_TEXTS


def split_cells(lines: list[str], separator: str | None, source: str, first: int) -> list[list[str]]:
    """Return the cells of each line; separators within quotes do not split a cell.

    `first` is the number of the first line, for messages. Raise DataError for unbalanced quotes.
    """
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


def split_unit(name: str) -> tuple[str, str]:
    """Split a column name into the name without unit and the unit; the unit is "" if there is none.

    Any text in brackets counts as a unit. Without brackets, only known units do, as in ``Strom / A`` or ``Current, A``.
    """
    # No regular expression here: its time would grow with the cube of the number of spaces.
    text = name.rstrip()
    opening = {"]": "[", ")": "("}.get(text[-1:])
    if opening is None:
        for word in _BEFORE_UNITS:
            bare, preposition, unit = text.rpartition(word)
            if preposition and bare.strip() and parse_unit(unit.strip()) is not None:
                return bare.rstrip(), unit.strip()
        return name, ""
    bare, preposition, unit = text[:-1].rpartition(opening)
    bare, unit = bare.rstrip().removesuffix(" /").rstrip(), unit.strip()
    return (bare, unit) if preposition and bare and unit and text[-1] not in unit else (name, "")


def split_slash_unit(name: str) -> tuple[str, str]:
    """Split a name such as ``I/A`` into name and known unit; the unit is "" if there is none."""
    bare, stroke, unit = (part.strip() for part in name.partition("/"))
    is_unit = stroke and bare and unit and parse_unit(unit) is not None
    return (bare, unit) if is_unit and parse_unit(name) is None and not is_gap(name) and unit != "1" else (name, "")


def _bracket_content(cell: str) -> str | None:
    """Return the content of the brackets if a cell consists of one pair of brackets, otherwise None."""
    text = cell.strip()
    is_bracketed = len(text) > 1 and text[0] in "[(" and text[-1] in "])" and not any(c in "[]()" for c in text[1:-1])
    return text[1:-1].strip() if is_bracketed else None


def is_unit(cell: str) -> bool:
    """Whether a cell may be part of a row of units: it is empty, a known unit, or a short text in brackets."""
    bracketed = _bracket_content(cell)
    word = cell.strip() if bracketed is None else bracketed
    short = bracketed is not None and len(word) <= 12
    return not word or parse_unit(word) is not None or is_time_unit(word) or short


def is_time_unit(word: str) -> bool:
    """Whether a word is a spelling of a time unit."""
    return bool(word) and split_time_header(f"t [{word}]")[1] in TIME_UNITS


def unit_of(cell: str) -> str:
    """Return the unit in a cell of a row of units, without brackets."""
    bracketed = _bracket_content(cell)
    return cell.strip() if bracketed is None else bracketed


_TIME_OF_DAY_PATTERN = (
    r"([01]?\d|2[0-4]):([0-5]\d)(?::([0-5]\d|60)(?:[.,](\d{1,9})\d*)?)?(?:\s*([AaPp])\.?[Mm]\.?)?"
    r"\s*(Z|[+-]\d{2}:?[0-5]\d)?"
)
_DATE_PATTERN = r"(?=\d{4}[-./]|\d{1,2}[-./]\d{1,2}[-./]\d{2})(\d{4}|\d{1,2})([-./])(\d{1,2})\2(\d{4}|\d{1,2})"
_TIMESTAMP_PATTERN = re.compile(
    rf"\s*(?:{_DATE_PATTERN}(?:(?:\s+|T){_TIME_OF_DAY_PATTERN})?|{_TIME_OF_DAY_PATTERN})\s*", re.ASCII
)
#: ISO 8601 duration in seconds; the isolated reader writes spreadsheet durations in this form.
_DURATION_PATTERN = re.compile(r"\s*(-?)PT(\d{1,9})(?:\.(\d{1,9}))?S\s*", re.ASCII)
_NANOSECONDS_PER_SECOND = 1_000_000_000
_MAX_TIMESTAMP_CHARACTERS = 64


def is_timestamp(cell: str) -> bool:
    """Whether a cell is a date, a time of day, both, or a duration."""
    return _match_timestamp(cell) is not None or _DURATION_PATTERN.fullmatch(cell) is not None


def _match_timestamp(cell: str) -> re.Match[str] | None:
    """Return the match of a timestamp; None for other text and for invalid times such as 13:00 AM or 24:30."""
    text = cell.strip()
    match = _TIMESTAMP_PATTERN.fullmatch(text) if len(text) <= _MAX_TIMESTAMP_CHARACTERS else None
    if match is None:
        return None
    groups = match.groups("")
    hour, minute, second, fraction, half, _ = groups[4:10] if groups[1] else groups[10:16]
    is_after_midnight = hour == "24" and int(f"0{minute}{second}{fraction}") > 0
    return None if is_after_midnight or (half and int(hour) > 12) else match


@dataclass(frozen=True)
class Timestamps:
    """Dates and times of a column, as numbers parsed from text.

    Parameters
    ----------
    parts
        Three numbers of each date in the sequence of the text, shape (N, 3); zeros without a date.
    separator
        Separator of the date; "" without a date.
    clock
        Time of day (in UTC if the text has a time zone), duration, or time since a reference [ns], shape (N,).
    first
        Text of the first cell.
    notation
        Notation of the text: separator of the date, whether there is a time zone, and whether there is AM/PM.
        Durations have a notation of their own.
    """

    parts: npt.NDArray[np.int64]
    separator: str
    clock: npt.NDArray[np.int64]
    first: str
    notation: tuple[object, ...] = ()

    @classmethod
    def read(cls, cells: Sequence[str]) -> Timestamps | None:
        """Return the timestamps of all cells; None if a cell has no timestamp or the notations of the cells differ."""
        spans = [_DURATION_PATTERN.fullmatch(cell) for cell in cells]
        if all(span is not None for span in spans) and cells:
            clock = np.array([_duration_ns(*span.groups("")) for span in spans if span is not None], np.int64)
            return cls(np.zeros((clock.size, 3), np.int64), "", clock, cells[0].strip(), ("passed",))
        matches = [_match_timestamp(cell) for cell in cells]
        if not matches or any(match is None for match in matches):
            return None
        groups = [match.groups("") for match in matches if match is not None]
        separator = groups[0][1]
        zoned = bool(groups[0][9] or groups[0][15])
        rows = [(*g[:4], *(g[4:10] if g[1] else g[10:16])) for g in groups]
        halved = bool(rows[0][8])
        if any(row[1] != separator or bool(row[9]) != zoned or bool(row[8]) != halved for row in rows):
            return None
        parts = np.array([(int(r[0] or 0), int(r[2] or 0), int(r[3] or 0)) for r in rows], np.int64)
        clock = np.array([_time_of_day_ns(*row[4:]) for row in rows], np.int64)
        return cls(parts, separator, clock, cells[0].strip(), (separator, zoned, halved))

    @classmethod
    def concatenate(cls, pieces: Sequence[Timestamps]) -> Timestamps | None:
        """Return consecutive blocks of a column as one; None if they differ in notation."""
        if len({piece.notation for piece in pieces}) > 1:
            return None
        parts, clock = (np.concatenate([getattr(p, name) for p in pieces]) for name in ("parts", "clock"))
        return replace(pieces[0], parts=parts, clock=clock)

    def seconds(self, label: str, dates: str | None) -> Floats:
        """Return the times in seconds since the first row, exact to the nanosecond.

        Parameters
        ----------
        label
            Label of the column in error messages.
        dates
            Sequence of year, month and day given by the user ("ymd", "dmy" or "mdy"), or None.

        Raises
        ------
        DataError
            If a date is invalid, or the sequence of day and month is ambiguous.
        """
        since = self.clock
        if not self.separator:
            return np.asarray((since - since[0]) / _NANOSECONDS_PER_SECOND)
        year, month, day = (self.parts[:, index] for index in self._order(label, dates))
        year = np.where(year < 100, year + 2000, year)
        months = (12 * (year - 1970) + np.clip(month, 1, 12) - 1).astype("datetime64[M]")
        starts, ends = (m.astype("datetime64[D]").astype(np.int64) for m in (months, months + 1))
        is_invalid = (month < 1) | (month > 12) | (day < 1) | (day > ends - starts)
        if is_invalid.any():
            remedy = f"correct these rows, or give the order of day and month with {layout_parameter(dates='dmy')}"
            raise masked_rows_error(label, "an invalid date", is_invalid, remedy)
        days = starts + day - 1
        return np.asarray((days - days[0]) * 86400.0 + (since - since[0]) / _NANOSECONDS_PER_SECOND)

    def inferred_date_order(self, dates: str | None) -> str:
        """Return the inferred sequence of day and month ("dmy" or "mdy") if the times depend on it, otherwise "".

        The result is also "" if the user gave the sequence (`dates`).
        """
        if not self.separator or dates is not None or (self.parts == self.parts[0]).all():
            return ""
        order = self._detect_date_order()
        return "" if order == "ymd" else order

    def _detect_date_order(self) -> str:
        """Return the sequence of year, month and day that the numbers of the dates imply; "" if it is ambiguous."""
        first, second, last = self.parts.max(axis=0)
        if first > 31:
            return "ymd"
        if second > 12 >= first:
            return "mdy"
        # Dates with points begin with the day; other dates may have conclusive numbers. Equal dates need no order.
        is_day_first = self.separator == "." or (first > 12 and last > 31) or (self.parts == self.parts[0]).all()
        return "dmy" if is_day_first else ""

    def _order(self, label: str, dates: str | None) -> tuple[int, int, int]:
        """Return the positions of year, month and day in a date; raise DataError if they are ambiguous."""
        largest_first, likely = self.parts[:, 0].max(), self._detect_date_order()
        order = likely if likely == "ymd" or dates is None else dates
        if order:
            return {"ymd": (0, 1, 2), "dmy": (2, 1, 0), "mdy": (2, 0, 1)}[order]
        if largest_first > 12:
            raise DataError(
                f"{label}: {self.first!r} may begin with the year or with the day; give "
                f"{layout_parameter(dates='ymd')} or {layout_parameter(dates='dmy')}"
            )
        raise DataError(
            f"{label}: {self.first!r} may begin with the day or with the month; give {layout_parameter(dates='dmy')} "
            f"or {layout_parameter(dates='mdy')}"
        )


def _time_of_day_ns(hour: str, minute: str, second: str, fraction: str, half: str, zone: str) -> int:
    """Return the time of day [ns] from the texts of its parts (`half` is AM or PM); in UTC if there is a time zone."""
    hours, offset = int(hour or 0), 0
    if half:
        hours = hours % 12 + (12 if half in "Pp" else 0)
    if zone and zone != "Z":
        digits = zone[1:].replace(":", "")
        offset = (1 if zone[0] == "+" else -1) * (int(digits[:2]) * 60 + int(digits[2:]))
    minutes = hours * 60 + int(minute or 0) - offset
    return (minutes * 60 + int(second or 0)) * _NANOSECONDS_PER_SECOND + int((fraction or "0").ljust(9, "0"))


def _duration_ns(sign: str, whole_seconds: str, fraction: str) -> int:
    """Return a duration [ns] from the texts of its sign, seconds and decimals."""
    nanoseconds = int(whole_seconds) * _NANOSECONDS_PER_SECOND + int(fraction.ljust(9, "0") or 0)
    return -nanoseconds if sign else nanoseconds
