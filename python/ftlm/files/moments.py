"""Dates and times of day in the cells of text, as seconds since the first of them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ftlm.base.arrays import Floats
from ftlm.base.checks import bad_rows
from ftlm.base.errors import DataError

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
            np.concatenate([p.parts for p in pieces]), pieces[0].mark, np.concatenate([p.clock for p in pieces]),
            pieces[0].first, pieces[0].way,
        )  # fmt: skip

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
                thing, "a date that is none", int(np.flatnonzero(bad)[0]), int(bad.sum()),
                "correct these rows, or say the order of day and month with layout=dict(dates='dmy')",
            )  # fmt: skip
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
