"""Reads columns of numbers from text, refusing whatever it cannot be sure of."""

from __future__ import annotations

import csv
import itertools
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from ftlm.base.checks import bad_rows
from ftlm.base.errors import DataError
from ftlm.data.header import BOM, header_of_line
from ftlm.files.columns import Column, FileTable

_BLOCK = 8 << 20
LONGEST_HEADER = 1 << 20
_SAMPLE_LINES = 20
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?|[+-]?\d+,(?:[eE][+-]?\d+)?")
_DECIMAL_COMMAS = re.compile(r"\s*[+-]?\d+,\d+(?:[eE][+-]?\d+)?(?:\s+[+-]?\d+,\d+(?:[eE][+-]?\d+)?)+\s*")
_DECIMAL_WAY_OUT = "write decimal points, for instance by replacing every comma by a point where ';' or tabs separate"
_UTF16 = (b"\xff\xfe", b"\xfe\xff")


@dataclass
class _Trouble:
    """Cells of one column that are not numbers."""

    line: int
    row: int
    cell: str
    count: int
    blank: bool

    def error(self, column: str, source: Path) -> DataError:
        thing = f"{source.name}: column {column!r}, line {self.line}"
        text = self.cell.strip()
        shown = repr(text if len(text) <= 40 else text[:40] + "…")
        if not text:
            what = "empty cell"
            way_out = "fill or remove these rows yourself, or let them be missing with missing='weight' or 'hold'"
        elif _DECIMAL_COMMA.fullmatch(text):
            what, way_out = f"{shown} has a decimal comma", _DECIMAL_WAY_OUT
        else:
            what, way_out = f"{shown} is not a number", "correct or remove these rows"
        return bad_rows(thing, what, self.row, self.count, way_out)


def read_text(path: Path) -> FileTable:
    """Read the columns of one text file."""
    try:
        with open(path, "rb") as stream:
            return _parse_text(path, stream)
    except OSError as error:
        raise DataError(f"{str(path)!r} cannot be read ({error.strerror}); check its permissions") from None


def _parse_text(path: Path, stream: BinaryIO) -> FileTable:
    first = stream.readline(LONGEST_HEADER)
    stream.seek(0)
    header = header_of_line(path, first)
    names: list[str] | None = None
    separator: str | None = None
    width = rows = ragged = 0
    ragged_line, ragged_width = 0, 0
    blocks: list[npt.NDArray[np.float64]] = []
    troubles: dict[int, _Trouble] = {}
    for number, lines in _line_blocks(path, stream):
        kept = [(index, line) for index, line in enumerate(lines, number) if line.strip() and line.lstrip()[0] != "#"]
        if not kept:
            continue
        started = width > 0
        if not started:
            separator = _separator([line for _, line in kept[:_SAMPLE_LINES]], path, kept[0][0])
        cells = _split([line for _, line in kept], separator, path, kept[0][0])
        if not started:
            width = len(cells[0])
            names = _names(cells[0], path, kept[0][0], own=header is not None)
            if names is not None:
                kept, cells = kept[1:], cells[1:]
        wrong = [index for index, row in enumerate(cells) if len(row) != width]
        if wrong:
            if not ragged:
                ragged_line, ragged_width = kept[wrong[0]][0], len(cells[wrong[0]])
            ragged += len(wrong)
        if not ragged and cells:
            # Python's numbers may have underscores between their digits, those of files have not.
            plain = not any("_" in line for _, line in kept)
            blocks.append(_numbers(cells, [index for index, _ in kept], rows, troubles, plain=plain))
        rows += len(cells)
    if width == 0:
        raise DataError(f"{path.name}: the file is empty, 0 rows; choose a file that holds a record")
    if ragged:
        raise DataError(
            f"{path.name}: line {ragged_line} has {ragged_width} cells where the first line has {width}, {ragged} "
            f"lines in all; give every line the same number of cells (separator: {_SEPARATOR_WORDS[separator]})"
        )
    if rows == 0:
        raise DataError(f"{path.name}: a header and no rows; choose a file that holds a record")
    values = np.concatenate(blocks).T.copy() if len(blocks) > 1 else blocks[0].T.copy()
    if names is None:
        names = [f"c{index + 1}" for index in range(width)]
    problems = [troubles[k].error(name, path) if k in troubles else None for k, name in enumerate(names)]
    blank = [k in troubles and troubles[k].blank for k in range(len(names))]
    columns = [
        Column(name, name, path, column, problem, blank=empty)
        for name, column, problem, empty in zip(names, values, problems, blank, strict=True)
    ]
    return FileTable(path, columns, text=True, header=header)


_SEPARATOR_WORDS: dict[str | None, str] = {";": "semicolon", "\t": "tab", ",": "comma", None: "white space"}


def _line_blocks(path: Path, stream: BinaryIO) -> Iterator[tuple[int, list[str]]]:
    """Yield the number of a first line and the lines from there, a few megabytes at a time."""
    carry, number, newline = b"", 1, b""
    while True:
        block = stream.read(_BLOCK)
        if not newline:
            if block.startswith(_UTF16):
                raise DataError(f"{path.name}: the text is UTF-16; save it as UTF-8")
            block = block.removeprefix(BOM)
            newline = b"\r" if b"\r" in block and b"\n" not in block else b"\n"
        zero = block.find(b"\0")
        if zero >= 0:
            raise DataError(
                f"{path.name}: a zero byte near line {number + (carry + block[:zero]).count(newline)}, so it is not a "
                "text file or is damaged; pass a csv, text or .mat file"
            )
        data = carry + block
        cut = data.rfind(newline) + 1 if block else len(data)
        if cut == 0 and len(data) > _BLOCK:
            raise DataError(f"{path.name}: line {number} is longer than {_BLOCK} bytes; pass a csv or text file")
        if cut:
            try:
                text = data[:cut].decode("utf-8")
            except UnicodeDecodeError as error:
                raise DataError(
                    f"{path.name}: line {number + data[: error.start].count(newline)} is not UTF-8 text (byte "
                    f"{data[error.start]:#04x}); save it as UTF-8"
                ) from None
            lines = text.split(newline.decode())
            yield number, lines
            number += len(lines) - 1
        carry = data[cut:]
        if not block:
            return


def _separator(sample: list[str], path: Path, number: int) -> str | None:
    """Return what at least half of the first lines have: a semicolon, else a tab, else a comma, else None."""
    if 2 * sum(_DECIMAL_COMMAS.fullmatch(line) is not None for line in sample) >= len(sample):
        raise DataError(f"{path.name}: line {number} and others have decimal commas; {_DECIMAL_WAY_OUT}")
    for candidate in (";", "\t", ","):
        if 2 * sum(candidate in line.strip() for line in sample) >= len(sample):
            return candidate
    return None


def _split(lines: list[str], separator: str | None, path: Path, number: int) -> list[list[str]]:
    if separator is None:
        return [line.split() for line in lines]
    if not any('"' in line for line in lines):
        return [line.split(separator) for line in lines]
    try:
        rows = list(csv.reader(lines, delimiter=separator, strict=True))
    except csv.Error as error:
        raise DataError(f"{path.name}: quotes after line {number} cannot be read ({error}); correct them") from None
    if len(rows) != len(lines):
        raise DataError(f"{path.name}: a quoted cell after line {number} spans lines; correct the quotes")
    return rows


def _names(cells: list[str], path: Path, number: int, *, own: bool) -> list[str] | None:
    """Return the names when this is a header, None when it is a row; a file of ftlm's `own` has one."""
    stripped = [cell.strip() for cell in cells]
    words = [cell for cell in stripped if cell and not _is_number(cell)]
    if not words:
        return None
    commas = [cell for cell in words if _DECIMAL_COMMA.fullmatch(cell)]
    if commas:
        raise DataError(f"{path.name}: line {number}: {commas[0]!r} has a decimal comma; {_DECIMAL_WAY_OUT}")
    if not own and any(_is_number(cell) for cell in stripped):
        raise DataError(
            f"{path.name}: line {number} mixes words and numbers ({words[0][:40]!r} is not a number, {len(words)} in "
            "all), so it is neither a header nor a row; correct that cell, or give the columns names"
        )
    times = Counter(stripped)
    for name in stripped:
        if name and times[name] > 1:
            raise DataError(
                f"{path.name}: line {number}: the column name {name!r} is there {times[name]} times; rename all but one"
            )
    return stripped


def _is_number(cell: str) -> bool:
    try:
        _number(cell)
    except ValueError:
        return False
    return True


def _number(cell: str) -> float:
    if "_" in cell:
        raise ValueError(cell)
    return float(cell)


def _numbers(
    cells: list[list[str]], lines: list[int], rows_before: int, troubles: dict[int, _Trouble], *, plain: bool
) -> npt.NDArray[np.float64]:
    width = len(cells[0])
    number = float if plain else _number
    try:
        flat = np.fromiter(
            map(number, itertools.chain.from_iterable(cells)), dtype=np.float64, count=len(cells) * width
        )
    except ValueError:
        pass
    else:
        return flat.reshape(len(cells), width)
    values = np.zeros((len(cells), width))
    for index in range(width):
        column = [row[index] for row in cells]
        try:
            values[:, index] = list(map(number, column))
        except ValueError:
            bad = [row for row, cell in enumerate(column) if not _is_number(cell)]
            blank = all(not column[row].strip() for row in bad)
            if blank:
                values[:, index] = [number(cell) if cell.strip() else np.nan for cell in column]
            known = troubles.get(index)
            if known is None:
                troubles[index] = _Trouble(lines[bad[0]], rows_before + bad[0], column[bad[0]], len(bad), blank)
            else:
                known.count += len(bad)
                known.blank &= blank
    return values
