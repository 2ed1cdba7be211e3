"""Layout of text files: the user's options, and detection of separator, decimal mark and header."""

from __future__ import annotations

import codecs
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from ftlm.errors import DataError
from ftlm.io.cell_parsing import (
    DECIMAL_COMMA,
    detect_thousands_separator,
    is_number,
    is_timestamp,
    is_unit,
    split_cells,
    unit_of,
)
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import Note, Placeholder, layout_fields, layout_parameter, parameter, type_name
from ftlm.utils.validation import join_names, nearest, whole_number

#: Cell separators by name; None means any white space.
SEPARATOR_CHARACTERS: dict[str, str | None] = {"semicolon": ";", "tab": "\t", "comma": ",", "space": None}
DECIMAL_CHARACTERS = {"point": ".", "comma": ","}
THOUSANDS_CHARACTERS: dict[str, str | None] = {"none": "", "point": ".", "comma": ",", "space": None, "apostrophe": "'"}
DATE_ORDERS = ("ymd", "dmy", "mdy")
#: Layout options that apply to sheets, and those that apply to text files.
SHEET_OPTIONS = ("skip", "header", "dates", "sheet")
TEXT_OPTIONS = ("encoding", "separator", "decimal", "thousands", "skip", "header", "dates")
_MAX_SKIPPED_LINES = 1 << 40


@check_arguments
@dataclass(frozen=True)
class Layout:
    """Layout options of a text file or sheet. Options that are None are detected and reported as assumptions.

    Parameters
    ----------
    encoding : str, optional
        Text encoding known to Python, such as ``"utf-8"``, ``"cp1252"``, ``"utf-16"``.
    separator : {"comma", "semicolon", "tab", "space"}, optional
        Separator of cells in text, by name or as the character itself. ``"space"`` means any white space.
    decimal : {"point", "comma"}, optional
        Decimal mark in text.
    thousands : {"none", "point", "comma", "space", "apostrophe"}, optional
        Thousands separator in text. It is detected only if decimals make it unambiguous, as in ``1.234,5``.
    skip : int, optional
        Number of lines (rows of a sheet) above the header of the table.
    header : {0, 1, 2}, optional
        Number of header lines: 0 for none, 1 for names, 2 for names and units.
    dates : {"ymd", "dmy", "mdy"}, optional
        Sequence of year, month and day in ambiguous dates.
    sheet : str, optional
        Name of the sheet in a workbook.

    Raises
    ------
    DataError
        If an option has an invalid value.
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
        for option, names in (
            ("separator", SEPARATOR_CHARACTERS),
            ("decimal", DECIMAL_CHARACTERS),
            ("thousands", THOUSANDS_CHARACTERS),
        ):
            value = getattr(self, option)
            if value is not None:
                object.__setattr__(self, option, _word(option, value, names))
        if self.separator == self.decimal == "comma":
            raise DataError(
                f"{layout_fields('separator', 'decimal')} are both a comma; cells could not be distinguished"
            )
        if self.thousands is not None and self.thousands == self.decimal:
            raise DataError(f"{layout_fields('thousands', 'decimal')} are both a {self.decimal}; change one of them")
        if self.separator == self.thousands == "space":
            raise DataError(
                f"{layout_fields('separator', 'thousands')} are both a space; cells could not be distinguished"
            )
        if self.dates is not None and self.dates not in DATE_ORDERS:
            raise DataError(
                f"{layout_fields('dates')} is {self.dates!r}; the known orders are {join_names(DATE_ORDERS)}"
            )
        for option, maximum in (("skip", _MAX_SKIPPED_LINES), ("header", 2)):
            value = getattr(self, option)
            count = None if value is None else whole_number(value)
            if value is not None and (count is None or not 0 <= count <= maximum):
                expected = "0, 1 (names) or 2 (names and units)" if option == "header" else "a number of lines from 0"
                raise DataError(f"{layout_fields(option)} is {value!r}; give {expected}")
            object.__setattr__(self, option, count)
        if self.encoding is not None:
            object.__setattr__(self, "encoding", _encoding(self.encoding))
        if self.sheet is not None and not isinstance(self.sheet, str):
            raise DataError(f"{layout_fields('sheet')} is {type_name(self.sheet)}; give the name of a sheet")

    @classmethod
    def from_argument(cls, layout: object) -> Layout:
        """Return a layout from None (no option set), a layout or a mapping of its fields; raise DataError otherwise."""
        if layout is None:
            return cls()
        if isinstance(layout, Layout):
            return layout
        if not isinstance(layout, Mapping):
            raise DataError(f"{parameter('layout')} is {type_name(layout)}; pass a dict, such as dict(decimal='comma')")
        keys = [f.name for f in fields(cls)]
        for key in layout:
            if key not in keys:
                raise DataError(
                    f"{parameter('layout')}: {key!r} is unknown{nearest(key, keys)}; the known keys are "
                    f"{join_names(keys)}"
                )
        return cls(**layout)

    def merge(self, other: Layout) -> Layout:
        """Return the options of both layouts; where both set an option, that of `other` is used."""
        return replace(self, **other.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """Return the options that are set, by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) is not None}

    def check_used(self, path: str, kind: str, names: tuple[str, ...]) -> None:
        """Raise DataError if an option is set that is not in `names`, the options that a file format uses.

        In the message, `path` names the file and `kind` the format.
        """
        unused = [option for option in self.to_dict() if option not in names]
        if unused:
            raise DataError(f"{path}: {layout_fields(unused[0])} is not used with {kind}; leave it out")


@dataclass(frozen=True)
class Assumption:
    """Assumption that the reader made because the file does not state an option.

    Parameters
    ----------
    option : str
        Option of :class:`ftlm.Layout` or argument of :func:`ftlm.load` that replaces the assumption; empty if none.
    value : str or int
        Assumed value.
    evidence : str
        Evidence in the file, as text.
    override : str
        Text of the argument that replaces the assumption; empty if there is none.
    affects_run : bool
        Whether values or rows of the run depend on the assumption; the warnings of the run then list it.
    """

    option: str
    value: str | int
    evidence: str
    override: str = ""
    affects_run: bool = True

    def __str__(self) -> str:
        return str(self.note)

    @property
    def note(self) -> Note:
        """Note on the assumption for the run."""
        return Note(self.evidence, self.override)


def _word(option: str, value: object, characters_by_name: Mapping[str, str | None]) -> str:
    """Return the name of a layout option's value, which the user gives by name (``comma``) or by character (``,``).

    `characters_by_name` maps names to characters. Raise DataError for an unknown value.
    """
    if isinstance(value, str):
        if value in characters_by_name:
            return value
        for word, character in characters_by_name.items():
            if value == (" " if character is None else character) or (character == "\t" and value == "\\t"):
                return word
    raise DataError(f"{layout_fields(option)} is {value!r}; the known ones are {join_names(characters_by_name)}")


def _encoding(value: object) -> str:
    """Return Python's canonical name of a text encoding; raise DataError if Python does not know the encoding."""
    try:
        if not isinstance(value, str):
            raise LookupError
        name = codecs.lookup(value).name
        b"a".decode(name, errors="replace")  # some codecs of Python are none of text
    except (LookupError, ValueError):
        raise DataError(
            f"{layout_fields('encoding')} is {str(value)[:40]!r}, which is unknown; utf-8, utf-16, cp1252 and "
            "latin-1 are known"
        ) from None
    return name


_WORDS_BY_SEPARATOR = {character: word for word, character in SEPARATOR_CHARACTERS.items()}
SEPARATOR_WORDS: dict[str | None, str] = {";": "semicolon", "\t": "tab", ",": "comma", None: "white space"}
_SEPARATOR_CANDIDATES = (";", "\t", ",", None)
#: Maximum number of columns of a text file; reading such a file takes a few seconds.
MAX_COLUMNS = 100_000
_COMMA_THOUSANDS_PATTERN = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+")
_COMMA_PAIRS_PATTERN = re.compile(r"\s*[+-]?\d+,\d+(?:,\s+[+-]?\d+,\d+)+\s*")
#: Column name of the sparse comment column in LabVIEW files.
_COMMENT_COLUMN_NAME = "comment"
#: Unit of the row counter in oscilloscope files.
_ROW_INDEX_UNIT = "sequence"


@dataclass(frozen=True)
class TableDialect:
    """Layout and position of a table in a text.

    Parameters
    ----------
    separator, comma, thousands_separator
        Cell separator (None for white space), whether the decimal mark is a comma, and name of the thousands separator
        (None if there is none).
    names, units
        Names and units of the columns; None if the header does not have them.
    first_line
        Line number of the first row, counted from 1.
    width
        Number of cells per row.
    layout
        Detected options as a :class:`Layout`.
    assumptions
        Assumptions of the detection.
    """

    separator: str | None
    comma: bool
    names: list[str] | None
    units: list[str] | None
    first_line: int
    width: int
    layout: Layout
    assumptions: tuple[Assumption, ...]
    thousands_separator: str | None = None


@dataclass(frozen=True)
class _Line:
    """One of the first lines of a text, split into cells by a candidate separator and decimal mark.

    Parameters
    ----------
    at
        Line number, counted from 1.
    cells
        Texts of the cells.
    numbers
        Whether each cell is a number or a timestamp.
    words
        Number of other cells that are not empty.
    """

    at: int
    cells: list[str]
    numbers: list[bool]
    words: int

    @property
    def width(self) -> int:
        return len(self.cells)

    @property
    def count(self) -> int:
        """Number of cells that are a number or a timestamp."""
        return sum(self.numbers)

    @property
    def has_only_numbers(self) -> bool:
        return self.words == 0 and self.count > 0

    @property
    def is_row_candidate(self) -> bool:
        """Whether the line may be a row of data: it has numbers, and at most as many words as numbers."""
        return self.count > 0 and self.count >= self.words

    @property
    def has_only_words(self) -> bool:
        return self.words > 0 and self.count == 0


def find_table(
    lines: Sequence[tuple[int, str]], layout_options: Layout, source: str, *, is_ftlm_file: bool, sheet: bool
) -> TableDialect:
    """Return the layout and position of the table in the first lines of a text.

    Parameters
    ----------
    lines
        (line number, line) pairs without blank lines and comments; at least one.
    layout_options
        Options given by the user; the others are detected.
    source
        Name of the file in error messages.
    is_ftlm_file
        Whether ftlm wrote the file, so that it has commas, decimal points and one line of names.
    sheet
        Whether the lines are rows of a sheet, with tabs between cells.

    Raises
    ------
    DataError
        If there is no row of numbers, or the layout is ambiguous.
    """
    if is_ftlm_file:
        layout_options = Layout(separator="comma", decimal="point", thousands="none", skip=0, header=1).merge(
            layout_options
        )
    elif sheet:
        layout_options = Layout(separator="tab", decimal="point", thousands="none").merge(layout_options)
    rows = [(at, line) for at, line in lines if at > (layout_options.skip or 0)]
    if not rows:
        raise DataError(
            f"{source}: no table below the first {layout_options.skip} lines; give another number with "
            f"{layout_parameter(skip=Placeholder('LINES'))}"
        )
    _check_width(rows[-2:], source)
    separator, comma, thousands_separator, table_lines = _choose_separator(rows, layout_options, source)
    width = _width(table_lines)
    if layout_options.skip is None or layout_options.header is None:
        top = _first_row(table_lines, width)
    else:
        top = min(layout_options.header, len(table_lines))
    names, units, top = _header(table_lines, top, width, layout_options, source, is_ftlm_file=is_ftlm_file)
    header = 0 if names is None else 1 if units is None else 2
    layout = Layout(
        separator=_WORDS_BY_SEPARATOR[separator],
        decimal="comma" if comma else "point",
        thousands=thousands_separator,
        skip=table_lines[top - header].at - 1 if 0 < top - header < len(table_lines) else 0,
        header=header,
    ).merge(layout_options)
    assumed = _layout_assumptions(table_lines, layout_options, layout, top, units)
    if layout_options.skip is None:
        _check_above(table_lines[: top - header], width, source, (comma, thousands_separator))
    if (
        not is_ftlm_file
        and names is None
        and top < len(table_lines)
        and table_lines[top].words
        and layout_options.header is None
    ):
        # A first row with words and numbers may be a header.
        raise _mixed_line_error(table_lines[top], source)
    if names is not None and not is_ftlm_file and layout_options.separator is None:
        _check_mixed(table_lines, top, separator, comma, source)
    first_line = table_lines[top].at if top < len(table_lines) else table_lines[-1].at + 1
    if names is not None:
        width = len(names)
    return TableDialect(separator, comma, names, units, first_line, width, layout, assumed, thousands_separator)


def _check_width(rows: Sequence[tuple[int, str]], source: str) -> None:
    """Raise DataError if a line has more than `MAX_COLUMNS` cells with one of the possible separators."""
    for at, line in rows:
        count = max(
            len(line.split()),
            *(line.count(separator) + 1 for separator in _SEPARATOR_CANDIDATES if separator is not None),
        )
        if count > MAX_COLUMNS:
            raise DataError(
                f"{source}: line {at} has {count} cells, more than {MAX_COLUMNS}; save a part of the columns, or "
                "transpose a file with samples in columns"
            )


def _split_lines(
    rows: Sequence[tuple[int, str]], separator: str | None, source: str, layout: Layout, *, comma: bool
) -> tuple[list[_Line], str | None]:
    """Return the lines split into cells, and the thousands separator (None if there is none).

    If a line has unbalanced quotes, the quotes are ignored here, and reading its row raises an error later.
    """
    lines, cells_by_line = [], []
    for at, line in rows:
        try:
            (cells,) = split_cells([line], separator, source, at)
        except DataError:
            cells = line.split(separator)
        cells_by_line.append((at, cells))
    thousands_separator = None if layout.thousands == "none" else layout.thousands
    if layout.thousands is None:
        separators = (detect_thousands_separator(cell, comma=comma) for _, cells in cells_by_line for cell in cells)
        thousands_separator = next((candidate for candidate in separators if candidate is not None), None)
    for at, cells in cells_by_line:
        is_full = [bool(cell.strip()) for cell in cells]
        numbers = [
            is_complete
            and (is_number(cell, comma=comma, thousands_separator=thousands_separator) or is_timestamp(cell))
            for cell, is_complete in zip(cells, is_full, strict=True)
        ]
        lines.append(_Line(at, cells, numbers, sum(is_full) - sum(numbers)))
    return lines, thousands_separator


def _dialect_candidates(text: str, layout: Layout) -> Iterator[tuple[str | None, bool]]:
    """Yield the candidates (separator, whether the decimal mark is a comma) that the text and the options allow."""
    for separator in _SEPARATOR_CANDIDATES if layout.separator is None else (SEPARATOR_CHARACTERS[layout.separator],):
        if layout.separator is None and separator is not None and separator not in text:
            continue
        for comma in (False, True) if layout.decimal is None else (layout.decimal == "comma",):
            if comma and (separator == "," or ("," not in text and layout.decimal is None)):
                continue
            yield separator, comma


def _choose_separator(
    table_rows: Sequence[tuple[int, str]], layout: Layout, source: str
) -> tuple[str | None, bool, str | None, list[_Line]]:
    """Return separator, whether the decimal mark is a comma, thousands separator, and the split lines.

    The chosen separators give the largest number of rows of equal width. Raise DataError if the options allow no
    candidate, or if the role of the commas is ambiguous.
    """
    text = "".join(line for _, line in table_rows)
    best_choice: tuple[tuple[int, ...], str | None, bool, str | None, list[_Line]] | None = None
    for separator, comma in _dialect_candidates(text, layout):
        lines, thousands_separator = _split_lines(table_rows, separator, source, layout, comma=comma)
        if comma and layout.decimal is None and _decimal_comma(lines) is None:
            continue
        width = _width(lines)
        rows = [line for line in lines[_first_row(lines, width) :] if line.width == width and line.is_row_candidate]
        half = 2 * sum(line.width > 1 for line in lines[:20]) >= len(lines[:20])
        rank = (len(rows), -sum(line.words for line in rows), half and not rows)
        if best_choice is None or rank > best_choice[0]:
            best_choice = rank, separator, comma, thousands_separator, lines
    if best_choice is None:
        raise DataError(f"{source}: {layout_fields('separator', 'decimal')} do not match the text; give others")
    _, separator, comma, thousands_separator, lines = best_choice
    if layout.decimal is None and layout.separator is None and separator == ",":
        _check_commas(table_rows, lines, source)
    if layout.decimal is None and comma:
        _check_thousands(lines, source)
    return separator, comma, thousands_separator, lines


def _decimal_comma(lines: list[_Line]) -> str | None:
    """Return the first number with a decimal comma; None if there is none."""
    return next((c.strip() for line in lines for c in line.cells if DECIMAL_COMMA.fullmatch(c.strip())), None)


def _width(lines: list[_Line]) -> int:
    """Return the most frequent number of cells per line, over the lines that are most likely rows.

    These are the lines with only numbers; without such lines, those that may be rows; otherwise the first line.
    """
    for rows in ([line for line in lines if line.has_only_numbers], [line for line in lines if line.is_row_candidate]):
        counts = Counter(line.width for line in rows)
        if counts:
            largest_count = max(counts.values())
            widths = [width for width, count in counts.items() if count == largest_count]
            return lines[0].width if lines[0].width in widths else max(widths)
    return lines[0].width


def _first_row(lines: list[_Line], width: int) -> int:
    """Return the index of the first row of data in the split lines.

    It is the first line of the given width that has numbers in all columns in which most rows have numbers. Damaged
    rows just before it are included.
    """
    rows = [line for line in lines if line.width == width and line.is_row_candidate]
    if not rows:
        return 1 if lines[0].has_only_words else 0
    is_numeric_column = [2 * sum(line.numbers[k] for line in rows) > len(rows) for k in range(width)]

    def is_typical(line: _Line) -> bool:
        return line.width == width and all(n or not m for n, m in zip(line.numbers, is_numeric_column, strict=True))

    first = next((k for k, line in enumerate(lines) if is_typical(line) and line.count), None)
    if first is None:
        first = next(k for k, line in enumerate(lines) if line is rows[0])
    while first > 0 and lines[first - 1].width == width and lines[first - 1].count:
        # A line with numbers is part of a header if the next line contains units.
        if (first < len(lines) and _is_unit_line(lines[first])) or _is_settings_line(lines, first - 1):
            break
        first -= 1
    # Short lines right below a header count as rows; reading them raises a specific error later.
    row = first
    while row > 0 and lines[row - 1].has_only_numbers:
        row -= 1
    return row if row > 0 and lines[row - 1].has_only_words and lines[row - 1].width == width else first


def _is_settings_line(lines: list[_Line], at: int) -> bool:
    """Whether a line below the names contains units and settings, such as start and increment of an oscilloscope."""
    line = lines[at]
    words = [c.strip() for c, n in zip(line.cells, line.numbers, strict=True) if c.strip() and not n]
    units = [word for word in words if is_unit(word)]
    other_words = {word.casefold() for word in words if not is_unit(word)}
    # Settings have columns of their own. Numbers in columns where the next line also has numbers belong to a row.
    next_numbers = lines[at + 1].numbers if at + 1 < len(lines) else []
    row = any(here and below_it for here, below_it in zip(line.numbers, next_numbers, strict=False))
    return (
        at > 0
        and lines[at - 1].has_only_words
        and line.count > 0
        and _has_unit(units)
        and other_words <= {_ROW_INDEX_UNIT}
        and not row
    )


def _is_unit_line(line: _Line) -> bool:
    cells = [cell for cell in line.cells if cell.strip()]
    return line.has_only_words and all(is_unit(cell) for cell in cells) and _has_unit(cells)


def _has_unit(units: Sequence[str]) -> bool:
    """Whether at least one of the unit texts cannot be mistaken for a symbol of a missing value or a percentage."""
    return any(unit.strip().casefold() not in ("-", "none", "%") for unit in units)


def _header(
    lines: list[_Line], top: int, width: int, layout: Layout, source: str, *, is_ftlm_file: bool
) -> tuple[list[str] | None, list[str] | None, int]:
    """Return names, units and the index of the first row; names or units are None if the header lacks them.

    `top` is the detected index of the first row. The returned index is larger than `top` if the layout states header
    lines that look like rows. Raise DataError if the header does not match the options, mixes words and numbers, or
    repeats a name.
    """
    rows = [line for line in lines[top:] if line.width == width]
    spare = bool(rows) and all(not line.cells[-1].strip() for line in rows)

    def fit_names(line: _Line) -> list[str]:
        """Return the column names in a line, adapted to the width of the rows.

        A last column that the rows lack is dropped if it is empty or for comments. A last column that is empty in all
        rows gets an empty name.
        """
        names = [cell.strip() for cell in line.cells]
        if len(names) == width + 1 and names[-1].casefold() in ("", _COMMENT_COLUMN_NAME):
            return names[:-1]
        return [*names, ""] if spare and len(names) == width - 1 else names

    count = layout.header
    if count is None:
        count = 0
        units_above = top > 1 and (_is_unit_line(lines[top - 1]) or _is_settings_line(lines, top - 1))
        if top > 0 and (lines[top - 1].has_only_words or is_ftlm_file or units_above):
            count = 1
            if units_above and len(fit_names(lines[top - 2])) == width and lines[top - 2].words:
                count = 2
            elif len(fit_names(lines[top - 1])) != width and top > 1:
                # A line between names and rows may consist of one cell with a remark.
                has_names = len(fit_names(lines[top - 2])) == width and lines[top - 2].has_only_words
                count = 2 if has_names and lines[top - 1].width == 1 else 0
    if count > top and layout.skip is None and count < len(lines):
        # A header of numbers looks like a row.
        top = count
    if count > top:
        raise DataError(
            f"{source}: {layout_fields('header')} is {count}, "
            f"but the number of lines above the rows is {top}; give fewer"
        )
    if count == 0:
        return None, None, top
    line = lines[top - count]
    names = fit_names(line)
    if not is_ftlm_file and count == 1 and line.count and layout.header is None:
        raise _mixed_line_error(line, source)
    commas = [cell for cell in names if DECIMAL_COMMA.fullmatch(cell)]
    if commas and not is_ftlm_file and count == 1:
        raise DataError(
            f"{source}: line {line.at}: {commas[0]!r} has a decimal comma, so it is not a line of names; give "
            f"{layout_parameter(decimal='comma')}"
        )
    check_distinct(names, line.at, source)
    if count == 1:
        return names, None, top
    previous_cells = lines[top - 1].cells
    units = [unit_of(cell) for cell in previous_cells] if len(previous_cells) > 1 or width == 1 else []
    units += [""] * (len(names) - len(units))
    return names, units[: len(names)], top


def check_distinct(names: list[str], at: int, source: str) -> None:
    """Raise DataError if a column name is repeated."""
    times = Counter(names)
    for name in names:
        if name and times[name] > 1:
            raise DataError(
                f"{source}: line {at}: the column name {name!r} occurs {times[name]} times; rename all but one"
            )


def _check_above(preceding: list[_Line], width: int, source: str, number_format: tuple[bool, str | None]) -> None:
    """Raise DataError if a line with at least two numbers and no words is above the table and would be skipped.

    `number_format` is (whether the decimal mark is a comma, name of the thousands separator). `width` is the number of
    cells per row of the table, for the message.
    """
    comma, thousands_separator = number_format
    rows = [
        line
        for line in preceding
        if line.has_only_numbers
        and sum(is_number(c, comma=comma, thousands_separator=thousands_separator) for c in line.cells) > 1
    ]
    if rows:
        raise DataError(
            f"{source}: line {rows[0].at} has {rows[0].width} numbers, {len(rows)} such lines in all, and stands above "
            f"a table of {width} cells per row; give every line the same number of cells, or state how many lines to "
            f"leave out with {layout_parameter(skip=Placeholder('LINES'))}"
        )


def _mixed_line_error(line: _Line, source: str) -> DataError:
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


def _check_commas(rows_of_text: Sequence[tuple[int, str]], lines: list[_Line], source: str) -> None:
    """Raise DataError if it is ambiguous whether commas are separators or decimal marks."""
    rows = [(line, text) for line, (_, text) in zip(lines, rows_of_text, strict=True) if line.has_only_numbers]
    if not rows:
        return
    pairs = all(_COMMA_PAIRS_PATTERN.fullmatch(text) for _, text in rows)
    is_single_column = not any(line.has_only_words and line.width == 2 for line in lines) and all(
        line.width == 2 and all(cell.strip().lstrip("+-").isdecimal() for cell in line.cells) for line, _ in rows
    )
    if pairs or is_single_column:
        at, example = rows[0][0].at, rows[0][1].strip()[:40]
        raise DataError(
            f"{source}: line {at}: the commas of {example!r} may be cell separators or decimal marks; give "
            f"{layout_parameter(separator='comma')}, or {layout_parameter(decimal='comma')} if spaces separate"
        )


def _check_thousands(lines: list[_Line], source: str) -> None:
    """Raise DataError if three digits follow every comma, so that commas may be thousands separators."""
    cells = [
        (line.at, cell.strip())
        for line in lines
        for cell, n in zip(line.cells, line.numbers, strict=True)
        if n and "," in cell and not is_timestamp(cell)
    ]
    if cells and all(_COMMA_THOUSANDS_PATTERN.fullmatch(cell) for _, cell in cells):
        at, text = cells[0]
        raise DataError(
            f"{source}: line {at}: the comma of {text!r} may be a decimal mark or group thousands, as in every "
            f"other number there; give {layout_parameter(decimal='comma')}, or write them without"
        )


def _check_mixed(lines: list[_Line], top: int, separator: str | None, comma: bool, source: str) -> None:
    """Raise DataError if header and rows have equal cell counts when split at commas as well as at the separator."""
    if not comma or separator is None:
        return
    header = lines[top - 1]
    both = [re.split(f"[,{separator}]", separator.join(line.cells)) for line in (header, *lines[top : top + 20])]
    if len(both[0]) > header.width and len(both) > 1 and len({len(cells) for cells in both}) == 1:
        raise DataError(
            f"{source}: line {header.at} and the rows below it have commas and {SEPARATOR_WORDS[separator]}s between "
            "their cells; write one separator, or give "
            f"{layout_parameter(separator=_WORDS_BY_SEPARATOR[separator], decimal='comma')}"
        )


def _layout_assumptions(
    lines: list[_Line], requested: Layout, layout: Layout, top: int, units: list[str] | None
) -> tuple[Assumption, ...]:
    """Return the assumptions about the options in a detected layout that `requested` does not set.

    The first row of data is ``lines[top]``.
    """
    assumed = []
    if requested.separator is None:
        text = f"{SEPARATOR_WORDS[SEPARATOR_CHARACTERS[str(layout.separator)]]} between cells"
        override = layout_parameter(separator=Placeholder("NAME"))
        assumed.append(Assumption("separator", str(layout.separator), text, override, False))
    if requested.decimal is None and layout.decimal == "comma":
        text, override = f"decimal commas, as in {_decimal_comma(lines)!r}", layout_parameter(decimal="point")
        assumed.append(Assumption("decimal", "comma", text, override))
    if requested.thousands is None and (thousands_separator := layout.thousands) is not None:
        cells, comma = (c for line in lines for c in line.cells), layout.decimal == "comma"
        example = next(c.strip() for c in cells if detect_thousands_separator(c, comma=comma) == thousands_separator)
        text = f"{thousands_separator}s group thousands, as in {example!r}"
        assumed.append(Assumption("thousands", thousands_separator, text, layout_parameter(thousands="none")))
    if requested.skip is None and (skip := layout.skip):
        text = f"{'line 1 is' if skip == 1 else f'lines 1 to {skip} are'} above the table and left out"
        assumed.append(Assumption("skip", skip, text, layout_parameter(skip=Placeholder("LINES"))))
    if requested.header is None and units is not None:
        text = f"line {lines[top - 1].at} contains units" if any(units) else f"line {lines[top - 1].at} is a remark"
        assumed.append(Assumption("header", 2, text, layout_parameter(header=1)))
    elif requested.header is None and layout.header == 0:
        text = "no line of names: columns are c1, c2, …"
        assumed.append(Assumption("header", 0, text, layout_parameter(header=1), False))
    return tuple(assumed)
