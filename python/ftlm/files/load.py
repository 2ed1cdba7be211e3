"""Loads one measured experiment from text, MATLAB or parquet files, refusing whatever it cannot be sure of."""

from __future__ import annotations

import os
import stat
import tomllib
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias, cast

from ftlm.base.checks import as_mapping, listed, names_to_columns, nearest
from ftlm.base.errors import DataError
from ftlm.data.asked import Asked
from ftlm.data.header import Header
from ftlm.data.names import CSV_TIME, is_run_name
from ftlm.data.readings import checked_missing
from ftlm.data.run import Run, built
from ftlm.data.units import time_unit_of
from ftlm.files.apart import MATLAB, PARQUET, read_apart
from ftlm.files.columns import Column, FileTable, Pool
from ftlm.files.text import LONGEST_HEADER, read_text

PathLike: TypeAlias = str | os.PathLike[str]
_SIZE_LIMIT = 1 << 30
_COLUMN_KEYS = ("time", "step", "inputs", "outputs", "units", "intersample")


@dataclass
class _Wanted:
    """Which columns the caller wants, from the arguments, the columns file and ftlm's own header."""

    time: Hashable | None
    step: float | None
    inputs: dict[str, Hashable]
    outputs: dict[str, Hashable]
    units: dict[str, str]
    intersample: dict[str, str]


def load(
    path: PathLike | Sequence[PathLike], *, time: str | int | None = None,
    inputs: Mapping[str, str | int] | Sequence[str] | str | None = None,
    outputs: Mapping[str, str | int] | Sequence[str] | str | None = None, units: Mapping[str, str] | None = None,
    columns: Mapping[str, object] | PathLike | None = None, intersample: Mapping[str, str] | None = None,
    step: float | None = None, slice: Sequence[float | None] | None = None, resample: float | None = None,
    name: str | None = None, time_unit: str | None = None, missing: str | None = None,
) -> Run:  # fmt: skip
    """Load one run from a text, version-5 .mat or parquet file, or from several files that hold its columns.

    Parameters
    ----------
    path : path or sequence of paths
        ``.mat``, ``.parquet``, or text: comma, semicolon, tab or white space between numbers, decimal points, UTF-8,
        lines that begin with ``#`` skipped, an optional header of names. Without a header the columns are c1, c2, …
        The columns of a matrix V of a .mat file are V.1, V.2, … (or ``V(:,1)``), a vector keeps its name; samples are
        in rows.
        Columns of several files are pooled; a name that is in two of them is prefixed by its file, ``STEM/V.3``.
    time : str or int, optional
        Column of the time, by name or, in a single text file, by position from 0. Without `time` and `step`, a text
        file's column called t, time or seconds (any case), alone or with a unit as in ``time [ms]``, ``time (ms)``,
        ``time/ms`` or ``t_ms``, is taken, a .mat file's vector of such a name, or else the first column of every
        matrix in use, which must all agree.
    inputs, outputs : mapping of str to column, or list of str, optional
        Columns by signal name; a list names columns that keep their names. Needed unless `columns` or the file's
        own ftlm header gives them; at least one output.
    units : mapping of str to str, optional
        Unit of a signal's numbers, converted to SI.
    columns : mapping or path of a TOML file, optional
        Keys ``time`` or ``step``, tables ``inputs``, ``outputs``, ``units``, ``intersample``; the arguments of the
        same name override or extend it.
    intersample : mapping of str to {"zoh", "foh"}, optional
        Behaviour of an input between rows; ``"zoh"`` where not given.
    step : float, optional
        Time between rows [s], > 0, in place of `time`.
    slice : pair of float or None, optional
        Use the rows with a ≤ t < b only, [s] since the first row.
    resample : float, optional
        Put the run on this step [s]: held inputs by the mean of the hold over each new interval, everything else
        linearly; outputs of irregular rows keep their own times for output error, see `Run.from_arrays`. Recorded in
        the run's warnings.
    name : str, optional
        What reports call the run; the first file's name where not given.
    time_unit : {"s", "ms", "us", "min", "h"}, optional
        Unit of the time column; where not given, the one that the column's header states (said in the run's
        warnings), or else s. A header that states another one is refused; the spacing of the rows is no guess.
    missing : {"refuse", "weight", "hold"}, optional
        What to do about NaN, empty cells and rows that a regular time lacks: see `Run.from_arrays`. Default
        ``"refuse"``, and ``"weight"`` for a file of ftlm's own that says which outputs were not read throughout.

    Returns
    -------
    Run

    Raises
    ------
    DataError
        If a file is missing, too large (more than 1 GiB), damaged or of another kind; if a line is ragged, or a column
        in use is unknown, empty somewhere or holds text (line, row and column are named); and for everything
        `Run.from_arrays` refuses.

    Examples
    --------
    >>> run = load("arm.csv", time="t_s", inputs={"I1": "Im1_meas_A"}, outputs={"theta11": "th11_deg"},
    ...            units={"theta11": "deg"})  # doctest: +SKIP
    """
    paths = _paths(path)
    chosen = checked_missing(missing or "refuse")
    wanted = _wanted(_columns_file(columns), time, step, inputs, outputs, units, intersample)
    tables = _tables(paths)
    header = tables[0].header
    if header is not None and len(tables) > 1:
        raise DataError(f"{str(paths[0])!r} is a whole run of its own; load it alone")
    if header is not None:
        _take_header(wanted, header)
        chosen = chosen if missing is not None or not header.missing else "weight"
    pool = Pool(tables)
    _check_apart(wanted, pool)
    if not wanted.outputs:
        raise DataError(
            f"no output is named; name the signals with inputs={{name: column}} and outputs={{name: column}}, "
            f"or in a columns file (commands: -u NAME=COLUMN -y NAME=COLUMN, or --columns FILE); {pool.described()}"
        )
    labels: dict[str, str] = {}
    used: list[Column] = []

    def gather(columns: Mapping[str, Hashable], *, blank: bool) -> dict[str, object]:
        picked: dict[str, object] = {}
        for signal, spec in columns.items():
            column = pool.find(spec, f"signal {signal!r}")
            labels[signal] = f"{column.source.name}: column {column.name!r} (signal {signal!r})"
            used.append(column)
            picked[signal] = column.numbers(blank=blank)
        return picked

    given_inputs = gather(wanted.inputs, blank=chosen == "hold")
    given_outputs = gather(wanted.outputs, blank=chosen != "refuse")
    clock = pool.time(wanted.time, used) if wanted.step is None else None
    label = "time" if clock is None else f"{clock.source.name}: column {clock.name!r} (time)"
    if clock is None and time_unit is not None:
        raise DataError(f"time_unit={time_unit!r} is the unit of time=, which is not used; step= is in s")
    unit, said = ("s", ()) if clock is None else time_unit_of(_header_of(clock), label, time_unit)
    if name is None:
        stem = paths[0].stem
        name = header.name if header is not None else stem if is_run_name(stem) else "run"
    asked = Asked(
        given_inputs, given_outputs, step=wanted.step, time=None if clock is None else clock.numbers(),
        units=wanted.units, intersample=wanted.intersample, name=name, resample=resample, window=slice,
        time_unit=unit, labels=labels, facts=said, time_label=label, missing=chosen,
    )  # fmt: skip
    if header is not None:
        stated = header.step if clock is not None and clock.name == CSV_TIME else None
        asked = replace(asked, known_step=stated, facts=(*header.warnings, *said), about=header.about)
    return built(asked)


def _check_apart(wanted: _Wanted, pool: Pool) -> None:
    """Refuse one column as an input and as an output: the model that explains it says nothing."""
    driven = {id(pool.find(spec, f"signal {name!r}")): (name, spec) for name, spec in wanted.inputs.items()}
    twice = [
        (driven[id(column)], name)
        for name, spec in wanted.outputs.items()
        if id(column := pool.find(spec, f"signal {name!r}")) in driven
    ]
    if twice and twice[0][0][0] != twice[0][1]:
        (name, spec), other = twice[0]
        raise DataError(
            f"column {spec!r} is the input {name!r} and the output {other!r} ({len(twice)} such columns in all); name "
            "another column for one of them"
        )


def _header_of(clock: Column) -> str:
    """Return what stands above a column of times; the first column of a matrix has no words of its own."""
    return clock.variable if clock.matrix is None else "time"


def _paths(given: PathLike | Sequence[PathLike]) -> list[Path]:
    entries = [given] if isinstance(given, (str, os.PathLike)) else given
    if not isinstance(entries, Sequence) or not all(isinstance(entry, (str, os.PathLike)) for entry in entries):
        raise DataError(f"path is a {type(given).__name__}; pass the path of a file, or a list of paths")
    if not entries:
        raise DataError("path: the list is empty; pass the path of at least one file")
    paths = [Path(entry) for entry in entries]
    total = 0
    for index, path in enumerate(paths):
        total += _size(path)
        if any(path.resolve() == other.resolve() for other in paths[:index]):
            raise DataError(f"{str(path)!r} is given twice; give every file once")
    if total > _SIZE_LIMIT:
        raise DataError(
            f"{listed(map(str, paths))}: {total} bytes, more than the limit of {_SIZE_LIMIT}; "
            "split the record or lower its rate"
        )
    return paths


def _size(path: Path) -> int:
    try:
        status = path.stat()
    except FileNotFoundError:
        try:
            beside = sorted(entry.name for entry in path.parent.iterdir())
        except OSError:
            beside = []
        raise DataError(f"{str(path)!r} does not exist{nearest(path.name, beside)}; check the path") from None
    except (OSError, ValueError) as error:
        raise DataError(f"{str(path)!r} cannot be opened ({error}); check the path and its permissions") from None
    if not stat.S_ISREG(status.st_mode):
        raise DataError(f"{str(path)!r} is not a file; pass the path of a file")
    return status.st_size


def _tables(paths: list[Path]) -> list[FileTable]:
    read: dict[Path, FileTable] = {}
    for kind in (MATLAB, PARQUET):
        own = [path for path in paths if path.suffix.lower() in kind.suffixes]
        if own:
            read |= dict(zip(own, read_apart(own, kind), strict=True))
    return [read[path] if path in read else read_text(path) for path in paths]


def column_names(path: PathLike) -> tuple[str, ...] | None:
    """Names of the columns of one file; None for a run that ftlm wrote, which names its own signals.

    Raises
    ------
    DataError
        As :func:`load`.
    """
    (table,) = _tables(_paths(path))
    return None if table.header is not None else Pool([table]).names


def _wanted(
    told: Mapping[str, object], time: Hashable | None, step: object, inputs: object, outputs: object, units: object,
    intersample: object,
) -> _Wanted:  # fmt: skip
    if time is not None and step is not None:
        raise DataError("time= and step=: both are given; pass one of them")
    if time is None and step is None:
        time, step = told.get("time"), told.get("step")
        if time is not None and step is not None:
            raise DataError("columns=: both time and step are given; keep one of them")
    return _Wanted(
        time,
        cast("float | None", step),
        names_to_columns("inputs", told.get("inputs")) | names_to_columns("inputs", inputs),
        names_to_columns("outputs", told.get("outputs")) | names_to_columns("outputs", outputs),
        _words("units", told.get("units")) | _words("units", units),
        _words("intersample", told.get("intersample")) | _words("intersample", intersample),
    )


def _words(argument: str, given: object) -> dict[str, str]:
    return {} if given is None else dict(cast("Mapping[str, str]", as_mapping(argument, given, "word")))


def _columns_file(columns: object) -> Mapping[str, object]:
    if columns is None:
        return {}
    told: Mapping[str, object]
    if isinstance(columns, Mapping):
        told, source = columns, "columns="
    elif isinstance(columns, (str, os.PathLike)):
        path = Path(columns)
        source = repr(str(path))
        if _size(path) > LONGEST_HEADER:
            raise DataError(f"{source} is too large for a columns file; pass the TOML file that names the columns")
        try:
            told = tomllib.loads(path.read_bytes().decode("utf-8-sig").replace("\r\n", "\n"))
        except (OSError, ValueError, RecursionError) as error:
            # A ValueError also for a number of thousands of digits.
            raise DataError(
                f"{source} is not a TOML file ({error}); write a time key and tables [inputs], [outputs] and [units] "
                "of name = column"
            ) from None
    else:
        raise DataError(f"columns= is a {type(columns).__name__}; pass a dict or the path of a TOML file")
    unknown = [key for key in told if key not in _COLUMN_KEYS]
    if unknown:
        raise DataError(
            f"{source}: the key {unknown[0]!r} is unknown{nearest(unknown[0], _COLUMN_KEYS)}, {len(unknown)} in all; "
            f"the known keys are {listed(_COLUMN_KEYS)}"
        )
    return told


def _take_header(wanted: _Wanted, header: Header) -> None:
    """Fill in what was not asked for from ftlm's own header."""
    if wanted.time is None and wanted.step is None:
        wanted.time = CSV_TIME
    if not wanted.inputs and not wanted.outputs:
        wanted.inputs = {name: name for name in header.inputs}
        wanted.outputs = {name: name for name in header.outputs}
    elif not wanted.outputs:
        wanted.outputs = {name: name for name in header.outputs if name not in wanted.inputs}
    elif not wanted.inputs:
        wanted.inputs = {name: name for name in header.inputs if name not in wanted.outputs}
    for name, column in (wanted.inputs | wanted.outputs).items():
        stated = header.units.get(str(column))
        told = wanted.units.get(name)
        if stated and told and told != stated:
            raise DataError(
                f"units=: {told!r} is asked for signal {name!r}, and the file itself says {stated!r}; "
                "leave the unit out for a file written by ftlm"
            )
        if stated and not told:
            wanted.units[name] = stated
        if name in wanted.inputs and str(column) in header.intersample:
            wanted.intersample.setdefault(name, header.intersample[str(column)])
