"""The header of a run that ftlm wrote: its format, stated once."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.errors import DataError
from ftlm.data.measured import Measured
from ftlm.data.names import is_run_name
from ftlm.data.samples import grid_of

CSV_MARK = "# ftlm-run "
CSV_VERSION = 1
_Kind = TypeVar("_Kind")
BOM = b"\xef\xbb\xbf"


@dataclass(frozen=True)
class Header:
    """What the first line of a file written by `Run.to_csv` says."""

    name: str
    step: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: dict[str, str]
    intersample: dict[str, str]
    warnings: tuple[str, ...]
    about: dict[str, object]


def header_of_line(path: Path, line: bytes) -> Header | None:
    text = line.removeprefix(BOM).decode("utf-8", errors="replace")
    if not text.startswith(CSV_MARK):
        return None
    return header_of(path, "line 1", text.removeprefix(CSV_MARK))


def header_of(path: Path, where: str, text: str) -> Header:
    """Return what ``VERSION JSON`` says."""
    version, _, body = text.partition(" ")
    if version.strip() != "1":
        raise DataError(
            f"{path.name}: {where}: the format ftlm-run {version.strip()[:20]!r} is not known here; use a newer ftlm, "
            "or remove the line and name the columns"
        )
    try:
        told = json.loads(body)
        header = Header(
            name=_field(told, "name", str),
            step=_field(told, "step", float),
            inputs=tuple(_field(told, "inputs", list)),
            outputs=tuple(_field(told, "outputs", list)),
            units=_field(told, "units", dict),
            intersample=_field(told, "intersample", dict),
            warnings=tuple(_field(told, "warnings", list)),
            about=_field({"about": {}} | told, "about", dict),
        )
        words = (
            header.inputs,
            header.outputs,
            header.warnings,
            header.units.values(),
            header.intersample.values(),
        )
        if not is_run_name(header.name) or not math.isfinite(header.step):
            raise ValueError("its name or step cannot be used")
        if not all(isinstance(word, str) for word in itertools.chain.from_iterable(words)):
            raise ValueError("a name, unit or warning is not text")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise DataError(
            f"{path.name}: {where} is a damaged ftlm header ({str(error)[:100]}); restore it, or remove the line and "
            "name the columns"
        ) from None
    return header


def _field(told: Mapping[str, object], key: str, kind: type[_Kind]) -> _Kind:
    value = told[key]
    if not isinstance(value, kind):
        raise ValueError(f"{key!r} is {str(value)[:40]!r}")
    return value


def header_text(run: Measured) -> str:
    """Write ``VERSION JSON``."""
    header = {
        "name": run.name,
        "step": run.step,
        "start": run.start,
        "inputs": list(run.inputs),
        "outputs": list(run.outputs),
        "units": run.units,
        "intersample": run.intersample,
        "warnings": list(run.facts),
    } | ({"about": run.about} if run.about else {})
    return f"{CSV_VERSION} {json.dumps(header, ensure_ascii=False, allow_nan=False)}"


def written_time(run: Measured) -> Floats:
    """Source time of every row, in digits that read well."""
    exact = run.start + grid_of(run.length, run.step)
    # Nine digits below the step read well, and the exact step stands in the header.
    digits = 9 - math.floor(math.log10(run.step))
    if not 0 <= digits <= 15 or np.abs(exact).max() * 10.0**digits >= 2.0**53:
        return exact
    rounded = np.round(exact, digits)
    rounded[0] = run.start
    return rounded
