"""How a file is laid out: what a person says of it, what is found, and what is said of what was found."""

from __future__ import annotations

import codecs
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from ftlm.errors import DataError
from ftlm.io.cell_parsing import DECIMAL_COMMA, grouping, is_moment, is_number, is_unit, split, unit_of
from ftlm.utils.validation import listed, nearest, whole_number

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


_WORDS = {character: word for word, character in SEPARATORS.items()}
SEPARATOR_WORDS: dict[str | None, str] = {";": "semicolon", "\t": "tab", ",": "comma", None: "white space"}
_ORDER = (";", "\t", ",", None)
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+")
_PAIRS = re.compile(r"\s*[+-]?\d+,\d+(?:,\s+[+-]?\d+,\d+)+\s*")
#: What LabVIEW puts above the cells of remarks that few rows have.
_REMARKS = "comment"
#: What oscilloscopes call the unit of a column that counts rows.
_COUNTED = "sequence"


@dataclass(frozen=True)
class Found:
    """The table of a text.

    Parameters
    ----------
    separator, comma, mark
        Between cells, whether decimals follow a comma, and what groups thousands.
    names, units
        Of its columns; None where it has no header.
    begin
        Number of the line of its first row.
    width
        Cells a row.
    layout
        All of that as a person would say it.
    assumed
        What was not said and taken for granted.
    """

    separator: str | None
    comma: bool
    names: list[str] | None
    names_line: int
    units: list[str] | None
    begin: int
    width: int
    layout: Layout
    assumed: tuple[Assumption, ...]
    mark: str | None = None


@dataclass(frozen=True)
class _Line:
    """One line of the sample, cut in one way."""

    at: int
    cells: list[str]
    numbers: list[bool]
    words: int

    @property
    def width(self) -> int:
        return len(self.cells)

    @property
    def count(self) -> int:
        """Cells that hold a number or a moment."""
        return sum(self.numbers)

    @property
    def full(self) -> bool:
        return self.words == 0 and self.count > 0

    @property
    def good(self) -> bool:
        """Whether it may be a row: numbers, and not more words than they."""
        return self.count > 0 and self.count >= self.words

    @property
    def named(self) -> bool:
        return self.words > 0 and self.count == 0


def find_table(lines: Sequence[tuple[int, str]], given: Layout, source: str, *, own: bool, sheet: bool) -> Found:
    """Find the table that begins in the first lines of a text.

    Parameters
    ----------
    lines
        Numbers of lines and lines, blank ones and comments left out; at least one.
    given
        What a person says; the rest is found.
    source
        What errors call the file.
    own
        A file of ftlm's own: commas, decimal points, one line of names.
    sheet
        Rows of a sheet, cells between tabs.

    Raises
    ------
    DataError
        Nothing that could be a row, or more than one way to read it.
    """
    if own:
        given = Layout(separator="comma", decimal="point", thousands="none", skip=0, header=1).under(given)
    elif sheet:
        given = Layout(separator="tab", decimal="point", thousands="none").under(given)
    kept = [(at, line) for at, line in lines if at > (given.skip or 0)]
    if not kept:
        raise DataError(f"{source}: no table below the first {given.skip} lines; say another number with layout=")
    separator, comma, mark, cut = _chosen(kept, given, source)
    width = _width(cut)
    first = 0 if given.skip is not None and given.header is not None else _first_row(cut, width)
    top = first if given.skip is None or given.header is None else min(given.header, len(cut))
    names, units, top = _header(cut, top, width, given, source, own=own)
    layout, assumed = _said(cut, given, separator, comma, mark, names, units, top, first)
    if given.skip is None:
        _check_above(cut[: top - (0 if names is None else 1 if units is None else 2)], width, source, (comma, mark))
    if not own and names is None and top < len(cut):
        _check_headless(cut[top], source, given)
    if names is not None and not own and given.separator is None:
        _check_mixed(cut, top, separator, comma, source)
    line = cut[top - (2 if units else 1)].at if names is not None else 0
    begin = cut[top].at if top < len(cut) else cut[-1].at + 1
    if names is not None:
        width = len(names)
    return Found(separator, comma, names, line, units, begin, width, layout, assumed, mark)


def _cut(
    kept: Sequence[tuple[int, str]], separator: str | None, source: str, given: Layout, *, comma: bool
) -> tuple[list[_Line], str | None]:
    """Lines cut into cells, and what groups thousands in them.

    A line whose quotes cannot be read is cut as it stands; the rows say so later.
    """
    cut, parted = [], []
    for at, line in kept:
        try:
            (cells,) = split([line], separator, source, at)
        except DataError:
            cells = line.split(separator)
        parted.append((at, cells))
    mark = None if given.thousands == "none" else given.thousands
    if given.thousands is None:
        marks = (grouping(cell, comma=comma) for _, cells in parted for cell in cells)
        mark = next((found for found in marks if found is not None), None)
    for at, cells in parted:
        there = [bool(cell.strip()) for cell in cells]
        numbers = [
            full and (is_number(cell, comma=comma, mark=mark) or is_moment(cell))
            for cell, full in zip(cells, there, strict=True)
        ]
        cut.append(_Line(at, cells, numbers, sum(there) - sum(numbers)))
    return cut, mark


def _ways(text: str, given: Layout) -> Iterator[tuple[str | None, bool]]:
    """Separators and decimals that there may be."""
    for separator in _ORDER if given.separator is None else (SEPARATORS[given.separator],):
        if given.separator is None and separator is not None and separator not in text:
            continue
        for comma in (False, True) if given.decimal is None else (given.decimal == "comma",):
            if comma and (separator == "," or ("," not in text and given.decimal is None)):
                continue
            yield separator, comma


def _chosen(
    kept: Sequence[tuple[int, str]], given: Layout, source: str
) -> tuple[str | None, bool, str | None, list[_Line]]:
    """The way of cutting under which most lines are rows of one width."""
    text = "".join(line for _, line in kept)
    best: tuple[tuple[int, ...], str | None, bool, str | None, list[_Line]] | None = None
    for separator, comma in _ways(text, given):
        cut, mark = _cut(kept, separator, source, given, comma=comma)
        if comma and given.decimal is None and _decimal_comma(cut) is None:
            continue
        width = _width(cut)
        rows = [line for line in cut[_first_row(cut, width) :] if line.width == width and line.good]
        half = 2 * sum(line.width > 1 for line in cut[:20]) >= len(cut[:20])
        rank = (len(rows), -sum(line.words for line in rows), half and not rows)
        if best is None or rank > best[0]:
            best = rank, separator, comma, mark, cut
    if best is None:
        raise DataError(f"{source}: the separator and the decimals that layout= says do not go together; say others")
    _, separator, comma, mark, cut = best
    if given.decimal is None and given.separator is None and separator == ",":
        _check_commas(kept, cut, source)
    if given.decimal is None and comma:
        _check_thousands(cut, source)
    return separator, comma, mark, cut


def _decimal_comma(cut: list[_Line]) -> str | None:
    """The first number with a decimal comma."""
    return next((c.strip() for line in cut for c in line.cells if DECIMAL_COMMA.fullmatch(c.strip())), None)


def _width(cut: list[_Line]) -> int:
    """Cells a row: of most lines that hold numbers alone, else of most that hold numbers, else of the first."""
    for rows in ([line for line in cut if line.full], [line for line in cut if line.good]):
        counts = Counter(line.width for line in rows)
        if counts:
            most = max(counts.values())
            widths = [width for width, count in counts.items() if count == most]
            return cut[0].width if cut[0].width in widths else max(widths)
    return cut[0].width


def _first_row(cut: list[_Line], width: int) -> int:
    """Where the rows begin: the first one that looks like most of them, and damaged ones right above it."""
    rows = [line for line in cut if line.width == width and line.good]
    if not rows:
        return 1 if cut[0].named else 0
    most = [2 * sum(line.numbers[k] for line in rows) > len(rows) for k in range(width)]

    def alike(line: _Line) -> bool:
        return line.width == width and all(n or not m for n, m in zip(line.numbers, most, strict=True))

    first = next((k for k, line in enumerate(cut) if alike(line) and line.count), None)
    if first is None:
        first = next(k for k, line in enumerate(cut) if line is rows[0])
    while first > 0 and cut[first - 1].width == width and cut[first - 1].count:
        if _above_units(cut, first) or _settings(cut, first - 1):
            break
        first -= 1
    # Short rows right below a line of names are rows; what is wrong with them is said when all are read.
    above = first
    while above > 0 and cut[above - 1].full:
        above -= 1
    return above if above > 0 and cut[above - 1].named and cut[above - 1].width == width else first


def _above_units(cut: list[_Line], first: int) -> bool:
    """Whether the line above is a header although it holds numbers, as of channels 1 and 2: units stand below it."""
    return first < len(cut) and _units(cut[first])


def _settings(cut: list[_Line], at: int) -> bool:
    """Whether a line below one of names holds units and settings, as oscilloscopes write start and increment there."""
    line = cut[at]
    words = [c.strip() for c, n in zip(line.cells, line.numbers, strict=True) if c.strip() and not n]
    units = [word for word in words if is_unit(word)]
    others = {word.casefold() for word in words if not is_unit(word)}
    # Settings stand in columns of their own; numbers that the row below has too are a row's.
    below = cut[at + 1].numbers if at + 1 < len(cut) else []
    row = any(one and other for one, other in zip(line.numbers, below, strict=False))
    return at > 0 and cut[at - 1].named and line.count > 0 and _measured(units) and others <= {_COUNTED} and not row


def _units(line: _Line) -> bool:
    cells = [cell for cell in line.cells if cell.strip()]
    return line.named and all(is_unit(cell) for cell in cells) and _measured(cells)


def _measured(units: Sequence[str]) -> bool:
    """Whether one of them is a unit and no mark that also stands for a missing number."""
    return any(unit.strip().casefold() not in ("-", "none", "%") for unit in units)


def _header(
    cut: list[_Line], top: int, width: int, given: Layout, source: str, *, own: bool
) -> tuple[list[str] | None, list[str] | None, int]:
    """Names and units above the rows, and where the rows begin."""
    rows = [line for line in cut[top:] if line.width == width]
    spare = bool(rows) and all(not line.cells[-1].strip() for line in rows)

    def fitted(line: _Line) -> list[str]:
        """Names without a last one that rows leave out, or with one for a last cell that they leave empty."""
        names = [cell.strip() for cell in line.cells]
        if len(names) == width + 1 and names[-1].casefold() in ("", _REMARKS):
            return names[:-1]
        return [*names, ""] if spare and len(names) == width - 1 else names

    count = given.header
    if count is None:
        count = 0
        units_above = top > 1 and (_units(cut[top - 1]) or _settings(cut, top - 1))
        if top > 0 and (cut[top - 1].named or own or units_above):
            count = 1
            if units_above and len(fitted(cut[top - 2])) == width and cut[top - 2].words:
                count = 2
            elif len(fitted(cut[top - 1])) != width and top > 1:
                count = 0
    if count > top and given.skip is None and count < len(cut):
        # Names that are numbers look like a row.
        top = count
    if count > top:
        raise DataError(f"{source}: layout= says {count} lines of header, and {top} stand above the rows; say fewer")
    if count == 0:
        return None, None, top
    line = cut[top - count]
    names = fitted(line)
    if not own and count == 1 and line.count and given.header is None:
        raise _mixed_line(line, source)
    commas = [cell for cell in names if DECIMAL_COMMA.fullmatch(cell)]
    if commas and not own and count == 1:
        raise DataError(
            f"{source}: line {line.at}: {commas[0]!r} has a decimal comma, so it is no line of names; say "
            "layout=dict(decimal='comma')"
        )
    check_distinct(names, line.at, source)
    if count == 1:
        return names, None, top
    units = [unit_of(cell) for cell in cut[top - 1].cells]
    units += [""] * (len(names) - len(units))
    return names, units[: len(names)], top


def check_distinct(names: list[str], at: int, source: str) -> None:
    """Refuse a name of a header that is there twice."""
    times = Counter(names)
    for name in names:
        if name and times[name] > 1:
            raise DataError(
                f"{source}: line {at}: the column name {name!r} is there {times[name]} times; rename all but one"
            )


def _check_headless(line: _Line, source: str, given: Layout) -> None:
    """Refuse words among the numbers of a first row: it could be a header as well."""
    if line.words and given.header is None:
        raise _mixed_line(line, source)


def _check_above(above: list[_Line], width: int, source: str, marks: tuple[bool, str | None]) -> None:
    """Refuse to leave out what may be rows: lines of several numbers and nothing else."""
    comma, mark = marks
    rows = [line for line in above if line.full and sum(is_number(c, comma=comma, mark=mark) for c in line.cells) > 1]
    if rows:
        raise DataError(
            f"{source}: line {rows[0].at} has {rows[0].width} numbers, {len(rows)} such lines in all, and stands above "
            f"a table of {width} cells a row; give every line the same number of cells, or say how many lines to leave "
            "out with layout=dict(skip=LINES)"
        )


def _mixed_line(line: _Line, source: str) -> DataError:
    words = [cell.strip() for cell, is_n in zip(line.cells, line.numbers, strict=True) if cell.strip() and not is_n]
    commas = [word for word in words if DECIMAL_COMMA.fullmatch(word)]
    if commas:
        return DataError(
            f"{source}: line {line.at}: {commas[0]!r} has a decimal comma, and others have points; write all numbers "
            "alike"
        )
    return DataError(
        f"{source}: line {line.at} mixes words and numbers ({words[0][:40]!r} is not a number, {len(words)} in "
        "all), so it is neither a header nor a row; correct that cell, or give the columns names"
    )


def _check_commas(kept: Sequence[tuple[int, str]], cut: list[_Line], source: str) -> None:
    """Refuse commas that may be separators or decimals: pairs of them with spaces between, one of whole numbers."""
    rows = [(line, text) for line, (_, text) in zip(cut, kept, strict=True) if line.full]
    if not rows:
        return
    pairs = all(_PAIRS.fullmatch(text) for _, text in rows)
    single = not any(line.named and line.width == 2 for line in cut) and all(
        line.width == 2 and all(cell.strip().lstrip("+-").isdecimal() for cell in line.cells) for line, _ in rows
    )
    if pairs or single:
        at, shown = rows[0][0].at, rows[0][1].strip()[:40]
        raise DataError(
            f"{source}: line {at}: the commas of {shown!r} may stand between cells or before decimals; say "
            "layout=dict(separator='comma'), or layout=dict(decimal='comma') where spaces separate"
        )


def _check_thousands(cut: list[_Line], source: str) -> None:
    """Refuse commas that may group thousands: three digits behind every one."""
    cells = [
        (line.at, cell.strip())
        for line in cut
        for cell, n in zip(line.cells, line.numbers, strict=True)
        if n and "," in cell and not is_moment(cell)
    ]
    if cells and all(_THOUSANDS.fullmatch(cell) for _, cell in cells):
        at, shown = cells[0]
        raise DataError(
            f"{source}: line {at}: the comma of {shown!r} may stand before decimals or group thousands, as in every "
            "other number there; say layout=dict(decimal='comma'), or write them without"
        )


def _check_mixed(cut: list[_Line], top: int, separator: str | None, comma: bool, source: str) -> None:
    """Refuse a second separator that header and rows share: decimals would not stand in the names, too."""
    if not comma or separator is None:
        return
    header = cut[top - 1]
    both = [re.split(f"[,{separator}]", separator.join(line.cells)) for line in (header, *cut[top : top + 20])]
    if len(both[0]) > header.width and len(both) > 1 and len({len(cells) for cells in both}) == 1:
        raise DataError(
            f"{source}: line {header.at} and the rows below it have commas and {SEPARATOR_WORDS[separator]}s between "
            f"their cells; write one separator, or say layout=dict(separator={_WORDS[separator]!r}, decimal='comma')"
        )


def _said(
    cut: list[_Line],
    given: Layout,
    separator: str | None,
    comma: bool,
    mark: str | None,
    names: list[str] | None,
    units: list[str] | None,
    top: int,
    first: int,
) -> tuple[Layout, tuple[Assumption, ...]]:
    """The layout, and what of it nobody said."""
    header = 0 if names is None else 2 if units is not None else 1
    start = top - header
    skip = given.skip if given.skip is not None else 0 if start == 0 else cut[start].at - 1 if start < len(cut) else 0
    layout = Layout(
        separator=_WORDS[separator], decimal="comma" if comma else "point", thousands=mark, skip=skip, header=header
    ).under(given)
    assumed = []
    if given.separator is None:
        words = f"{SEPARATOR_WORDS[separator]} between cells"
        assumed.append(Assumption("separator", str(layout.separator), words, "layout=dict(separator=NAME)", False))
    if given.decimal is None and comma:
        shown = _decimal_comma(cut)
        words, otherwise = f"decimal commas, as in {shown!r}", "layout=dict(decimal='point')"
        assumed.append(Assumption("decimal", "comma", words, otherwise))
    if given.thousands is None and mark is not None:
        shown = next(c.strip() for line in cut for c in line.cells if grouping(c, comma=comma) == mark)
        words = f"{mark}s group thousands, as in {shown!r}"
        assumed.append(Assumption("thousands", mark, words, "layout=dict(thousands='none')"))
    if given.skip is None and skip:
        words = f"{'line 1 is' if skip == 1 else f'lines 1 to {skip} are'} above the table and left out"
        assumed.append(Assumption("skip", skip, words, "layout=dict(skip=LINES)"))
    if given.header is None and units is not None:
        words = f"line {cut[top - 1].at} holds units"
        assumed.append(Assumption("header", 2, words, "layout=dict(header=1)"))
    elif given.header is None and header == 0:
        assumed.append(
            Assumption("header", 0, "no line of names: columns are c1, c2, …", "layout=dict(header=1)", False)
        )
    return layout, tuple(assumed)
