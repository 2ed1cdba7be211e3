"""How a file is laid out: what a person says of it, what is found, and what is said of what was found."""

from __future__ import annotations

import codecs
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from ftlm.base.checks import listed, nearest, whole_number
from ftlm.base.errors import DataError

#: Words for what separates cells; None is white space.
SEPARATORS: dict[str, str | None] = {"semicolon": ";", "tab": "\t", "comma": ",", "space": None}
DECIMALS = {"point": ".", "comma": ","}
GROUPS: dict[str, str | None] = {"none": "", "point": ".", "comma": ",", "space": None, "apostrophe": "'"}
DATES = ("ymd", "dmy", "mdy")
#: What spreadsheets leave open of it, and other files.
OF_SHEETS, OF_TEXT = (
    ("skip", "header", "dates", "sheet"),
    ("encoding", "separator", "decimal", "thousands", "skip", "header", "dates"),
)
_MOST_LINES = 1 << 40


@dataclass(frozen=True)
class Layout:
    """How the cells of a text file or of a sheet are written; what is None is found from the file, and said.

    Parameters
    ----------
    encoding : str, optional
        Of text: a name that Python knows, such as ``"utf-8"``, ``"cp1252"``, ``"utf-16"``.
    separator : {"comma", "semicolon", "tab", "space"}, optional
        What stands between the cells of text; the character itself will do. ``"space"`` is any white space.
    decimal : {"point", "comma"}, optional
        What stands between whole numbers and their decimals in text.
    thousands : {"none", "point", "comma", "space", "apostrophe"}, optional
        What groups the thousands of numbers in text; found only where decimals stand behind a group, as in
        ``1.234,5``.
    skip : int, optional
        Lines (rows of a sheet) above the table, header not counted.
    header : {0, 1, 2}, optional
        Lines of the table's header: none, names, names and units.
    dates : {"ymd", "dmy", "mdy"}, optional
        Order of day and month where dates leave it open.
    sheet : str, optional
        Sheet of a workbook.

    Raises
    ------
    DataError
        A value that is none of these.
    """

    encoding: str | None = None
    separator: str | None = None
    decimal: str | None = None
    thousands: str | None = None
    skip: int | None = None
    header: int | None = None
    dates: str | None = None
    sheet: str | None = None

    def __post_init__(self) -> None:
        for option, known in (("separator", SEPARATORS), ("decimal", DECIMALS), ("thousands", GROUPS)):
            given = getattr(self, option)
            if given is not None:
                object.__setattr__(self, option, _word(option, given, known))
        if self.separator == self.decimal == "comma":
            raise DataError("layout=: separator and decimal are both a comma; cells could not be told apart")
        if self.thousands is not None and self.thousands == self.decimal:
            raise DataError(f"layout=: thousands and decimal are both a {self.decimal}; say which of them it is")
        if self.separator == self.thousands == "space":
            raise DataError("layout=: separator and thousands are both a space; cells could not be told apart")
        if self.dates is not None and self.dates not in DATES:
            raise DataError(f"layout=: dates is {self.dates!r}; the known orders are {listed(DATES)}")
        for option, most in (("skip", _MOST_LINES), ("header", 2)):
            given = getattr(self, option)
            count = None if given is None else whole_number(given)
            if given is not None and (count is None or not 0 <= count <= most):
                what = "0, 1 (names) or 2 (names and units)" if option == "header" else "a number of lines from 0"
                raise DataError(f"layout=: {option} is {given!r}; give {what}")
            object.__setattr__(self, option, count)
        if self.encoding is not None:
            object.__setattr__(self, "encoding", _encoding(self.encoding))
        if self.sheet is not None and not isinstance(self.sheet, str):
            raise DataError(f"layout=: sheet is a {type(self.sheet).__name__}; give the name of a sheet")

    @classmethod
    def of(cls, given: object) -> Layout:
        """Take what a person gave: nothing, a layout, or a mapping of its fields."""
        if given is None:
            return cls()
        if isinstance(given, Layout):
            return given
        if not isinstance(given, Mapping):
            raise DataError(f"layout= is a {type(given).__name__}; pass a dict, such as dict(decimal='comma')")
        known = [f.name for f in fields(cls)]
        for key in given:
            if key not in known:
                raise DataError(f"layout=: {key!r} is unknown{nearest(key, known)}; the known keys are {listed(known)}")
        return cls(**given)

    def under(self, other: Layout) -> Layout:
        """Return this layout where the other one says nothing."""
        return replace(self, **other.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """What it says, by key."""
        return {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) is not None}

    def check_used(self, path: str, kind: str, used: tuple[str, ...]) -> None:
        """Refuse what a kind of file has no use for."""
        unused = [option for option in self.to_dict() if option not in used]
        if unused:
            raise DataError(f"{path}: layout=: {unused[0]!r} is not used with {kind}; leave it out")


@dataclass(frozen=True)
class Assumption:
    """One thing that a file does not say and that was taken for it.

    Parameters
    ----------
    option : str
        The option of :class:`ftlm.Layout` or argument of :func:`ftlm.load` that says it.
    value : str or int
        What was taken.
    words : str
        What was seen.
    otherwise : str
        How to say something else.
    counts : bool
        Whether numbers, or which rows there are, depend on it and the file decided it: the run says so.
    """

    option: str
    value: str | int
    words: str
    otherwise: str = ""
    counts: bool = True

    def __str__(self) -> str:
        return f"{self.words}; otherwise {self.otherwise}" if self.otherwise else self.words


def _word(option: str, given: object, known: Mapping[str, str | None]) -> str:
    """The word for what a person gave as a word or as the character itself."""
    if isinstance(given, str):
        if given in known:
            return given
        for word, character in known.items():
            if given == (" " if character is None else character) or (character == "\t" and given == "\\t"):
                return word
    raise DataError(f"layout=: {option} is {given!r}; the known ones are {listed(known)}")


def _encoding(given: object) -> str:
    """The name of an encoding of text, as Python writes it."""
    try:
        if not isinstance(given, str):
            raise LookupError
        name = codecs.lookup(given).name
        b"a".decode(name, errors="replace")  # some codecs of Python are none of text
    except (LookupError, ValueError):
        raise DataError(
            f"layout=: encoding is {str(given)[:40]!r}, which is unknown; utf-8, utf-16, cp1252 and latin-1 are known"
        ) from None
    return name
