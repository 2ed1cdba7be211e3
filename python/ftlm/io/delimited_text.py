"""Reader of text files with separated columns; its errors name line and column."""

from __future__ import annotations

import codecs
import functools
import gzip
import itertools
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from ftlm.data.export import MAX_HEADER_BYTES, header_of_line
from ftlm.errors import DataError
from ftlm.io.cell_parsing import (
    DECIMAL_COMMA,
    Timestamps,
    detect_thousands_separator,
    is_gap,
    is_number,
    is_timestamp,
    may_group,
    parse_number,
    split_cells,
    split_slash_unit,
    split_unit,
)
from ftlm.io.dialect import SEPARATOR_WORDS, Assumption, Layout, TableDialect, find_table
from ftlm.io.table import Column, FileTable, dates_error
from ftlm.utils.parameters import Placeholder, layout_parameter, parameter
from ftlm.utils.validation import bad_rows_error

_BLOCK_BYTES = 8 << 20
#: Size of the beginning of a text from which the layout is detected: characters, and minimum number of lines.
_SAMPLE_CHARACTERS, _MIN_SAMPLE_LINES = 1 << 16, 8
_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_UTF32 = (codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE)
_MAX_UNPACKED_BYTES = 1 << 30


def _fill_hint() -> str:
    """Return the remedy in error messages on cells without a number."""
    return (
        f"fill or remove these rows yourself, or let them be missing with {parameter('missing', 'weight')} (outputs "
        f"and times) or {parameter('missing', 'hold')} (inputs, too)"
    )


@dataclass
class _BadCells:
    """Cells of one column that are not numbers, for the error message.

    Parameters
    ----------
    line, row, cell
        Line number, row number and text of the first such cell.
    count
        Number of such cells.
    blank
        Whether all of them are empty or mean a missing value.
    comma, sheet
        Whether the decimal mark is a comma, and whether the file is a workbook.
    has_timestamps
        Whether some of them are dates or times of day.
    example
        First cell of the column if it is a date or time in a notation that differs from `cell`; otherwise "".
    """

    line: int
    row: int
    cell: str
    count: int
    blank: bool
    comma: bool
    has_timestamps: bool = False
    sheet: bool = False
    example: str = ""

    def error(self, column: str, source: str) -> DataError:
        label = f"{source}: column {column!r}, line {self.line}"
        text = self.cell.strip()
        cell_text = repr(text if len(text) <= 40 else text[:40] + "…")
        way_out = "correct or remove these rows"
        if not text:
            description = "empty cell" + (", or one with an error or an uncomputed formula" if self.sheet else "")
            way_out = _fill_hint()
        elif is_gap(text):
            description = f"{cell_text} stands for no number"
            way_out = _fill_hint()
        elif (separator := detect_thousands_separator(text, comma=self.comma)) is not None:
            description = f"{cell_text} has marks between thousands"
            way_out = f"give {layout_parameter(thousands=separator)}, or write all numbers without"
        elif self.comma and "." in text and is_number(text):
            description = f"{cell_text} has a point where decimals follow a comma"
            way_out = "write all numbers alike"
            if may_group(text, "point", comma=True):
                way_out += f", or give {layout_parameter(thousands='point')} where points group thousands"
        elif DECIMAL_COMMA.fullmatch(text):
            description = f"{cell_text} has a decimal comma"
            way_out = (
                f"write all numbers alike, or give {layout_parameter(decimal='comma')} where all of them have commas"
            )
        elif self.example:
            description = f"{cell_text} and {self.example!r} are dates or times of day written in two ways"
            way_out = "write all alike"
        elif self.has_timestamps:
            description = (
                f"{cell_text} stands among numbers"
                if is_timestamp(text)
                else f"{cell_text} stands among dates or times of day"
            )
        else:
            description = f"{cell_text} is not a number"
        return bad_rows_error(label, description, self.row, self.count, way_out)


@dataclass
class _Rows:
    """Rows of a table that have been read, with invalid cells and timestamps by column index.

    `ragged` is the number of lines with a wrong number of cells; `ragged_line` and `ragged_cells` describe the first.
    `footer` has the line numbers of the lines below the table. Each array of `blocks` has the values of consecutive
    rows, shape (rows, columns).
    """

    dialect: TableDialect
    sheet: bool = False
    count: int = 0
    ragged: int = 0
    ragged_line: int = 0
    ragged_cells: list[str] = field(default_factory=list)
    after_blank: bool = False
    footer: list[int] = field(default_factory=list)
    blocks: list[npt.NDArray[np.float64]] = field(default_factory=list)
    bad_cells: dict[int, _BadCells] = field(default_factory=dict)
    timestamps: dict[int, list[Timestamps]] = field(default_factory=dict)


def read_text(path: Path, layout: Layout) -> FileTable:
    """Read one text file, optionally compressed by gzip, and return its columns; raise DataError on failure."""
    try:
        with open(path, "rb") as stream:
            if path.suffix.lower() != ".gz" and stream.read(2) != b"\x1f\x8b":
                stream.seek(0)
                return parse_text(path, stream, layout)
            stream.seek(0)
            return _read_gzip(path, stream, layout)
    except OSError as error:
        raise DataError(f"{str(path)!r} cannot be read ({error.strerror}); check its permissions") from None


def _read_gzip(path: Path, file: BinaryIO, layout: Layout) -> FileTable:
    try:
        with gzip.GzipFile(fileobj=file) as stream:
            table = parse_text(path, _SizeLimitedStream(path, stream), layout)
    except (OSError, EOFError, zlib.error) as error:
        raise DataError(
            f"{path.name}: damaged file: it cannot be unpacked ({str(error)[:100]}); get an intact copy"
        ) from None
    return replace(table, kind=f"{table.kind}, packed by gzip")


class _SizeLimitedStream:
    """Stream of an unpacked file that raises DataError when more than `_MAX_UNPACKED_BYTES` are read."""

    def __init__(self, path: Path, stream: gzip.GzipFile) -> None:
        self._path, self._stream = path, stream

    def read(self, size: int) -> bytes:
        if self._stream.tell() > _MAX_UNPACKED_BYTES:
            raise DataError(
                f"{self._path.name}: unpacked, it has more than {_MAX_UNPACKED_BYTES} bytes; split the record or lower "
                "its rate"
            )
        return self._stream.read(size)

    def readline(self, size: int) -> bytes:
        return self._stream.readline(size)

    def seek(self, position: int) -> int:
        return self._stream.seek(position)


def parse_text(
    path: Path, stream: BinaryIO | _SizeLimitedStream, layout: Layout, sheet: str | None = None
) -> FileTable:
    """Return the columns in a text stream, or in a sheet given as tab-separated lines, as a table.

    `path` and the name of the `sheet` are used in messages. Raise DataError if the text has no valid table.
    """
    source = path.name if sheet is None else f"{path.name}, sheet {sheet!r}"
    header = header_of_line(path, stream.readline(MAX_HEADER_BYTES)) if sheet is None else None
    stream.seek(0)
    encoding, guessed = _encoding(stream, layout, path)
    stream.seek(0)
    blocks = _line_blocks(path, stream, encoding)
    # Sheets have no comment lines.
    comment_mark = "#" if sheet is None else "\0"
    head, sample, remark = _first_lines(blocks, layout, comment_mark)
    if not sample:
        raise DataError(f"{source}: the file is empty, 0 rows; choose a file that contains a record")
    dialect = find_table(sample, layout, source, is_ftlm_file=header is not None, sheet=sheet is not None)
    dialect = _dialect_with_empty_rows(dialect, head, sample, layout, sheet=sheet is not None)
    rows = _Rows(dialect, sheet is not None)
    for first, lines in itertools.chain(head, blocks):
        _read_block(rows, first, lines, comment_mark, source)
    columns = _columns(rows, path, source)
    used_layout = Layout(sheet=sheet) if sheet is not None else Layout(encoding=encoding)
    if sheet is not None:
        dialect = replace(dialect, layout=replace(dialect.layout, separator=None, decimal=None))
    kind = f"sheet {sheet!r}" if sheet else f"text ({encoding}, {SEPARATOR_WORDS[dialect.separator]} between cells)"
    assumed = () if header is not None else guessed + dialect.assumptions
    if rows.footer:
        first, last = rows.footer[0], rows.footer[-1]
        which = f"lines {first} to {last} are" if last > first else f"line {first} is"
        text = f"{which} below the table and left out"
        assumed = (*assumed, Assumption("", rows.count, text, "remove the empty line above them"))
    if dialect.names is None:
        assumed = tuple(_with_remark(a, remark, dialect.width) for a in assumed)
    return FileTable(
        path, columns, True, header, layout=used_layout.merge(dialect.layout), assumptions=assumed, kind=kind
    )


def _dialect_with_empty_rows(
    dialect: TableDialect,
    head: list[tuple[int, list[str]]],
    sample: list[tuple[int, str]],
    layout: Layout,
    *,
    sheet: bool,
) -> TableDialect:
    """Return the layout of the table, adjusted for rows of empty cells directly below the header.

    In text such rows are rows of the table. In a sheet they are skipped, and an assumption lists them.
    """
    if dialect.separator != "\t" or dialect.names is None:
        return dialect
    last_line_before = max((at for at, _ in sample if at < dialect.first_line), default=0)
    lines = ((at, line) for first, part in head for at, line in enumerate(part, first))
    lines_between = itertools.takewhile(lambda pair: pair[0] < dialect.first_line, lines)
    gaps = [
        at
        for at, line in lines_between
        if at > last_line_before and not line.strip() and line.count("\t") == dialect.width - 1
    ]
    if not gaps or dialect.width == 1:
        return dialect
    if not sheet:
        return replace(dialect, first_line=gaps[0])
    if layout.header is not None:
        return dialect
    text = f"line {gaps[0]}, right below the header, is empty and left out"
    if len(gaps) > 1:
        text = f"lines {gaps[0]} to {gaps[-1]}, right below the header, are empty and left out"
    header = 1 if dialect.units is None else 2
    return replace(
        dialect, assumptions=(*dialect.assumptions, Assumption("header", header, text, layout_parameter(header=1)))
    )


def _with_remark(assumption: Assumption, remark: str, width: int) -> Assumption:
    """Return an assumption about the header with a comment line above the table (`remark`) added to its evidence.

    This applies if the comment has as many words as the table has columns (`width`). Any other assumption is returned
    unchanged.
    """
    words = remark.lstrip("# \t").replace(",", " ").split()
    if assumption.option != "header" or len(words) != width or any(map(is_number, words)):
        return assumption
    return replace(
        assumption, evidence=f"{assumption.evidence} (a remark above them has as many words: {' '.join(words)!r})"
    )


def _first_lines(
    blocks: Iterator[tuple[int, list[str]]], layout: Layout, comment_mark: str
) -> tuple[list[tuple[int, list[str]]], list[tuple[int, str]], str]:
    """Return the first blocks, the lines from which the layout is detected, and the last comment above these lines.

    Blocks are (number of the first line, lines), and lines are (number, text) without blank lines and comments.
    `comment_mark` begins a comment.
    """
    head: list[tuple[int, list[str]]] = []
    sample: list[tuple[int, str]] = []
    size, remark = 0, ""
    for first, lines in blocks:
        head.append((first, lines))
        for at, line in enumerate(lines, first):
            if size > _SAMPLE_CHARACTERS and len(sample) >= _MIN_SAMPLE_LINES:
                break
            if not sample and line.lstrip()[:1] == comment_mark:
                remark = line[:400]
            if _has_content(line, comment_mark):
                sample.append((at, line))
                size += len(line) if at > (layout.skip or 0) else 0
        if size > _SAMPLE_CHARACTERS and len(sample) >= _MIN_SAMPLE_LINES:
            break
    return head, sample, remark


def _has_content(line: str, comment_mark: str) -> bool:
    text = line.lstrip()
    return bool(text) and text[0] != comment_mark


def _read_block(rows: _Rows, first: int, lines: list[str], comment_mark: str, source: str) -> None:
    """Parse the lines of one block, and append their rows to `rows`.

    `first` is the number of the first line, and `comment_mark` begins a comment. Raise DataError for a second table, a
    repeated header or an ambiguous comment.
    """
    dialect = rows.dialect
    content = []
    for at, line in enumerate(lines, first):
        # With tabs, a line of empty cells is a row of missing values, not a blank line.
        gap = dialect.separator == "\t" and "\t" in line and not line.strip()
        if at >= dialect.first_line and (gap or _has_content(line, comment_mark)):
            if rows.footer or (rows.after_blank and _is_footer(line, dialect, source, at)):
                _check_footer(rows, line, at, source)
                rows.footer.append(at)
                continue
            content.append((at, line))
            rows.after_blank = False
        elif at >= dialect.first_line and not line.strip():
            rows.after_blank = bool(content) or rows.count > 0
        elif at >= dialect.first_line and line.lstrip()[:1] == comment_mark:
            _check_remark(line, at, dialect, source)
    if not content:
        return
    cells = split_cells([line for _, line in content], dialect.separator, source, content[0][0])
    ragged_indices = [index for index, row in enumerate(cells) if len(row) != dialect.width]
    if ragged_indices:
        if not rows.ragged:
            rows.ragged_line, rows.ragged_cells = content[ragged_indices[0]][0], cells[ragged_indices[0]]
        rows.ragged += len(ragged_indices)
    repeated = next((at for (at, _), row in zip(content, cells, strict=True) if row == dialect.names), None)
    if repeated is not None:
        raise DataError(
            f"{source}: line {repeated} repeats the line of names; save the lines from {repeated} on as a second file, "
            "and give both files as two runs, or remove that line if the record continues"
        )
    if not rows.ragged:
        # float() accepts underscores between digits, which numbers in files must not have.
        is_plain_decimal = (
            not dialect.comma and dialect.thousands_separator is None and not any("_" in line for _, line in content)
        )
        rows.blocks.append(_numbers(rows, cells, [at for at, _ in content], is_plain_decimal=is_plain_decimal))
    rows.count += len(cells)


def _is_footer(line: str, dialect: TableDialect, source: str, at: int) -> bool:
    """Whether a line after an empty line is a footer: its first cell is a word, and it is not a row of the table."""
    cells = split_cells([line], dialect.separator, source, at)[0]
    are_numbers = [
        is_number(cell, comma=dialect.comma, thousands_separator=dialect.thousands_separator) or is_timestamp(cell)
        for cell in cells
    ]
    return bool(cells[0].strip()) and not are_numbers[0] and (len(cells) != dialect.width or not any(are_numbers))


def _check_footer(rows: _Rows, line: str, at: int, source: str) -> None:
    """Raise DataError if a line below a footer is a row of numbers, that is, part of a second table."""
    dialect = rows.dialect
    cells = split_cells([line], dialect.separator, source, at)[0]
    if len(cells) == dialect.width and all(
        is_number(c, comma=dialect.comma, thousands_separator=dialect.thousands_separator) for c in cells
    ):
        raise DataError(
            f"{source}: a table ends above line {rows.footer[0]}, and line {at} is a row of another one; save the "
            f"lines from {rows.footer[0]} on as a second file, and give both files as two runs"
        )


def _check_remark(line: str, at: int, dialect: TableDialect, source: str) -> None:
    """Raise DataError if a line that begins with # may also be a row, for example one that begins with #N/A."""
    cells = line.split(dialect.separator)
    has_numbers = any(
        is_number(cell, comma=dialect.comma, thousands_separator=dialect.thousands_separator) or is_timestamp(cell)
        for cell in cells
    )
    error = len(cells) == 1 and cells[0].strip().endswith(("!", "?", "/A"))
    if (
        len(cells) == dialect.width
        and (dialect.width > 1 or error)
        and (has_numbers or error or dialect.separator is not None)
    ):
        raise DataError(
            f"{source}: line {at} begins with # and has as many cells as a row ({line.strip()[:40]!r}), so it may be "
            "a comment or a row; remove that line, or write a number in its first cell"
        )


def _columns(rows: _Rows, path: Path, source: str) -> list[Column]:
    dialect = rows.dialect
    if rows.ragged:
        raise _ragged_rows_error(rows, source)
    if rows.count == 0:
        raise DataError(f"{source}: a header and no rows; choose a file that contains a record")
    values = np.concatenate(rows.blocks).T.copy() if len(rows.blocks) > 1 else rows.blocks[0].T.copy()
    names = dialect.names if dialect.names is not None else [f"c{index + 1}" for index in range(dialect.width)]
    columns = []
    for k, (name, column) in enumerate(zip(names, values, strict=True)):
        column_errors, blocks = rows.bad_cells.get(k), rows.timestamps.get(k)
        timestamps = None if blocks is None else Timestamps.concatenate(blocks)
        problem = None if column_errors is None else column_errors.error(name, source)
        if blocks is not None and (timestamps is None or timestamps.clock.size != rows.count):
            problem = problem or DataError(
                f"{source}: column {name!r}: dates or times have several notations; write all in the same notation"
            )
            timestamps = None
        elif timestamps is not None:
            description = f"dates or times of day, not numbers ({timestamps.first!r})"
            problem = dates_error(f"{source}: column {name!r}", description, rows.count)
        unit = (
            (dialect.units[k] if dialect.units is not None else "") or split_unit(name)[1] or split_slash_unit(name)[1]
        )
        blank = column_errors is not None and column_errors.blank
        columns.append(Column(name, name, path, column, problem, blank=blank, timestamps=timestamps, file_unit=unit))
    return columns


def _ragged_rows_error(rows: _Rows, source: str) -> DataError:
    dialect = rows.dialect
    reference = "line of names" if dialect.names is not None else "first row"
    other_separators = [
        separator_name
        for separator, separator_name in SEPARATOR_WORDS.items()
        if separator is not None
        and separator != dialect.separator
        and not (dialect.comma and separator == ",")
        and sum(cell.count(separator) for cell in rows.ragged_cells) >= max(1, dialect.width - 1)
    ]
    mixed = (
        f"; that line has {other_separators[0]}s" if other_separators and len(rows.ragged_cells) < dialect.width else ""
    )
    return DataError(
        f"{source}: line {rows.ragged_line} has {len(rows.ragged_cells)} cells where the {reference} has "
        f"{dialect.width}, "
        f"{rows.ragged} lines in all; give every line the same number of cells "
        f"(separator: {SEPARATOR_WORDS[dialect.separator]}{mixed})"
    )


def _encoding(stream: BinaryIO | _SizeLimitedStream, layout: Layout, path: Path) -> tuple[str, tuple[Assumption, ...]]:
    """Return the encoding of a text, and assumptions about it.

    The first criterion that applies is used: the option of the layout, a byte-order mark, zero bytes as in UTF-16,
    valid UTF-8, valid cp1252, or latin-1. Raise DataError for bytes that are not text.
    """
    if layout.encoding is not None:
        return layout.encoding, ()
    head = stream.read(MAX_HEADER_BYTES)
    if head.startswith(_UTF32):
        return "utf-32", ()
    if head.startswith(_UTF16):
        return "utf-16", ()
    for offset, name in ((1, "utf-16-le"), (0, "utf-16-be")):
        zeros, other_zeros = head[offset:4000:2].count(0), head[1 - offset : 4000 : 2].count(0)
        if zeros > 4 and other_zeros == 0 and zeros > 0.8 * len(head[offset:4000:2]):
            description = f"every other byte is 0, so the text is {name}"
            return name, (
                Assumption("encoding", name, description, layout_parameter(encoding=Placeholder("NAME")), False),
            )
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError as error:
        if any(code in head for code in (*range(9), *range(14, 32))):
            at = head[: error.start].count(b"\n") + 1
            zipped = ": it begins as workbooks do, whose names end in .xlsx or .ods" if head[:2] == b"PK" else ""
            raise DataError(
                f"{path.name}: line {at} is not UTF-8 text (byte {head[error.start]:#04x}), and other bytes are not "
                f"text in any encoding{zipped}; give {layout_parameter(encoding=Placeholder('NAME'))}, or pass a csv, "
                "text or .mat file"
            ) from None
        description = (
            f"no UTF-8 (byte {head[error.start]:#04x}), read as cp1252 of Windows, which does not affect numbers"
        )
        override = layout_parameter(encoding=Placeholder("NAME"))
        try:
            head.decode("cp1252")
        except UnicodeDecodeError:
            return "latin-1", (
                Assumption("encoding", "latin-1", description.replace("cp1252 of Windows", "latin-1"), override),
            )
        return "cp1252", (Assumption("encoding", "cp1252", description, override),)
    return "utf-8", ()


def _line_blocks(path: Path, stream: BinaryIO | _SizeLimitedStream, encoding: str) -> Iterator[tuple[int, list[str]]]:
    """Yield (number of the first line, lines) for blocks of about 8 MB; raise DataError if the text is invalid."""
    decoder = codecs.getincrementaldecoder("utf-8-sig" if encoding == "utf-8" else encoding)()
    incomplete_line, line_number, newline = "", 1, ""
    while True:
        block = stream.read(_BLOCK_BYTES)
        try:
            data = incomplete_line + decoder.decode(block, final=not block)
        except UnicodeError as error:
            raise _undecodable_error(path, error, line_number + incomplete_line.count("\n"), encoding) from None
        if not block:
            # Old programs write Ctrl-Z at the end of a text.
            data = data.removesuffix("\x1a")
        if not newline:
            newline = "\r" if "\r" in data and "\n" not in data else "\n" if data else ""
        zero = data.find("\0")
        if zero >= 0:
            raise DataError(
                f"{path.name}: a zero byte near line {line_number + data[:zero].count(newline)}, so it is not a "
                "text file "
                "or is damaged; pass a csv, text or .mat file"
            )
        cut = data.rfind(newline) + 1 if block and newline else len(data) if not block else 0
        if cut == 0 and len(data) > _BLOCK_BYTES:
            raise DataError(
                f"{path.name}: line {line_number} is longer than {_BLOCK_BYTES} bytes; pass a csv or text file"
            )
        if cut:
            lines = data[:cut].split(newline)
            yield line_number, lines
            line_number += len(lines) - 1
        incomplete_line = data[cut:]
        if not block:
            return


def _undecodable_error(path: Path, error: UnicodeError, line: int, encoding: str) -> DataError:
    if not isinstance(error, UnicodeDecodeError):
        return DataError(
            f"{path.name}: the text is not {encoding} ({error}); give {layout_parameter(encoding=Placeholder('NAME'))}"
        )
    at, byte = line + error.object[: error.start].count(b"\n"), error.object[error.start]
    return DataError(
        f"{path.name}: line {at} is not {encoding.upper()} text (byte {byte:#04x}); give "
        f"{layout_parameter(encoding='cp1252')} if it is that of Windows, or save it as UTF-8"
    )


def _numbers(
    rows: _Rows, cells: list[list[str]], lines: list[int], *, is_plain_decimal: bool
) -> npt.NDArray[np.float64]:
    width = len(cells[0])
    parse_cell = functools.partial(
        parse_number, comma=rows.dialect.comma, thousands_separator=rows.dialect.thousands_separator
    )
    value: Callable[[str], float] = float if is_plain_decimal else parse_cell
    try:
        flat = np.fromiter(map(value, itertools.chain.from_iterable(cells)), dtype=np.float64, count=len(cells) * width)
    except ValueError:
        pass
    else:
        return flat.reshape(len(cells), width)
    values = np.zeros((len(cells), width))
    for index in range(width):
        column = [row[index] for row in cells]
        try:
            values[:, index] = list(map(parse_cell, column))
        except ValueError:
            _store_other_cells(rows, index, column, lines, values)
    return values


def _store_other_cells(
    rows: _Rows, index: int, column: list[str], lines: list[int], values: npt.NDArray[np.float64]
) -> None:
    """Store the timestamps or invalid cells of a column in `rows`; not all cells of the column are numbers.

    `column` has the texts of the cells in a block, `index` is the index of the column, and `lines` are the line numbers
    of the cells. If all invalid cells mean missing values, the column of `values` is filled with the numbers, and with
    NaN for missing values.
    """
    comma, thousands_separator = rows.dialect.comma, rows.dialect.thousands_separator
    if is_timestamp(column[0]) and rows.count == sum(m.clock.size for m in rows.timestamps.get(index, [])):
        timestamps = Timestamps.read(column)
        if timestamps is not None:
            rows.timestamps.setdefault(index, []).append(timestamps)
            return
    invalid_rows = [
        row
        for row, cell in enumerate(column)
        if not is_number(cell, comma=comma, thousands_separator=thousands_separator)
    ]
    dated = [row for row in invalid_rows if is_timestamp(column[row])]
    if dated and 2 * len(dated) > len(column):
        # In a column that consists mostly of dates, the other cells are invalid.
        invalid_rows = [row for row in range(len(column)) if not is_timestamp(column[row])] or invalid_rows
    # If all cells are timestamps, those with another notation are invalid.
    ways = (
        [row for row in invalid_rows if Timestamps.read([column[0], column[row]]) is None]
        if len(dated) == len(column)
        else []
    )
    invalid_rows = ways or invalid_rows
    # Report invalid texts rather than empty cells.
    invalid_rows = [row for row in invalid_rows if not is_gap(column[row])] or invalid_rows
    blank = all(is_gap(column[row]) for row in invalid_rows)
    if blank and not dated:
        values[:, index] = [
            np.nan if is_gap(cell) else parse_number(cell, comma=comma, thousands_separator=thousands_separator)
            for cell in column
        ]
    first_row, blank = invalid_rows[0], blank and not dated
    location = lines[first_row], rows.count + first_row, column[first_row]
    bad_cell = rows.bad_cells.get(index)
    if bad_cell is None:
        example = column[0].strip()[:40] if ways else ""
        rows.bad_cells[index] = _BadCells(*location, len(invalid_rows), blank, comma, bool(dated), rows.sheet, example)
        return
    if bad_cell.blank and not blank:
        bad_cell.line, bad_cell.row, bad_cell.cell = location
    bad_cell.count += len(invalid_rows)
    bad_cell.blank &= blank
