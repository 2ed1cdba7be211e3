"""The header of a run that ftlm wrote: its format, stated once, for reading and for writing."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from ftlm.base.errors import DataError
from ftlm.data.measured import Measured
from ftlm.data.names import is_run_name
from ftlm.data.readings import unread

CSV_MARK = "# ftlm-run "
CSV_VERSION = 1
BOM = b"\xef\xbb\xbf"
#: Most bytes of the line; a reader that knew none would take a file without a line's end into memory.
LONGEST_HEADER = 1 << 20
#: What a file says of rows at times of their own, which it does not hold.
LEFT_BEHIND = "written on its grid: the times at which outputs were read stayed behind"
#: What must be told, as JSON gives it; the rows themselves say when they start.
_KINDS: dict[str, type] = {
    "name": str, "step": float, "inputs": list, "outputs": list, "units": dict, "intersample": dict, "warnings": list,
    "about": dict, "missing": list,
}  # fmt: skip
#: ... and what may be left out.
_OPTIONAL: dict[str, Any] = {"about": {}, "missing": []}


@dataclass(frozen=True)
class Header:
    """What the first line of a csv file or the metadata of a parquet file says: ``VERSION JSON``, keys as here."""

    name: str
    step: float
    start: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: dict[str, str]
    intersample: dict[str, str]
    warnings: tuple[str, ...]
    about: dict[str, Any] = field(default_factory=dict)
    missing: tuple[str, ...] = ()

    @classmethod
    def of(cls, run: Measured) -> Header:
        """Return the header of a run."""
        return cls(
            run.name, run.step, run.start, run.inputs, run.outputs, run.units, dict(run.intersample),
            run.facts if run.readings is None else (*run.facts, LEFT_BEHIND), run.about,
            tuple(n for n in run.outputs if unread(run[n]).any()),
        )  # fmt: skip

    def text(self) -> str:
        """Write it."""
        told = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _OPTIONAL or getattr(self, f.name)}
        words = json.dumps(told, ensure_ascii=False, allow_nan=False)
        # Half of a pair, which no file can hold, is written as JSON escapes it.
        return f"{CSV_VERSION} {words.encode('utf-8', 'backslashreplace').decode()}"

    def line(self) -> str:
        """Write it as the first line of a text file, or refuse what no reader would take for one."""
        line = f"{CSV_MARK}{self.text()}\n"
        size = len(line.encode())
        if size > LONGEST_HEADER:
            raise DataError(
                f"run {self.name!r}: names, warnings and what it is about take {size} bytes, more than the "
                f"{LONGEST_HEADER} of the first line of a csv file; write it as .parquet"
            )
        return line

    @classmethod
    def read(cls, path: Path, where: str, text: str) -> Header:
        """Read what a file says in one place, and refuse a damaged header or one of a later version."""
        version, _, body = text.partition(" ")
        if version.strip() != str(CSV_VERSION):
            raise DataError(
                f"{path.name}: {where}: the format ftlm-run {version.strip()[:20]!r} is not known here; use a newer "
                "ftlm, or remove the line and name the columns"
            )
        try:
            return _checked(json.loads(body))
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise DataError(
                f"{path.name}: {where} is a damaged ftlm header ({str(error)[:100]}); restore it, or remove the line "
                "and name the columns"
            ) from None


def _checked(told: Any) -> Header:
    values: dict[str, Any] = {}
    for key, kind in _KINDS.items():
        value = told.get(key, _OPTIONAL[key]) if key in _OPTIONAL else told[key]
        if not isinstance(value, kind):
            raise ValueError(f"{key!r} is {str(value)[:40]!r}")
        values[key] = tuple(value) if isinstance(value, list) else value
    header = Header(start=0.0, **values)
    words = (header.inputs, header.outputs, header.warnings, header.units.values(), header.intersample.values())
    if not is_run_name(header.name) or not math.isfinite(header.step):
        raise ValueError("its name or step cannot be used")
    if not all(isinstance(word, str) for word in itertools.chain.from_iterable(words)):
        raise ValueError("a name, unit or warning is not text")
    return header


def header_of_line(path: Path, line: bytes) -> Header | None:
    """Return what the first line of a text file says, if ftlm wrote it."""
    text = line.removeprefix(BOM).decode("utf-8", errors="replace")
    return Header.read(path, "line 1", text.removeprefix(CSV_MARK)) if text.startswith(CSV_MARK) else None
