"""Loads one measured experiment from the files that programs write, refusing whatever it cannot be sure of."""

from __future__ import annotations

import os
import stat
import tomllib
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias, cast

from ftlm.data.construction import Asked
from ftlm.data.export import LONGEST_HEADER, Header
from ftlm.data.run import Run, built
from ftlm.data.sampling import Missing, checked_missing
from ftlm.data.units import header_time, time_unit_of
from ftlm.errors import DataError
from ftlm.io.cell_parsing import stated_unit
from ftlm.io.delimited_text import read_text
from ftlm.io.dialect import OF_SHEETS, OF_TEXT, Layout
from ftlm.io.isolated_reader import kind_of, read_apart
from ftlm.io.table import Column, FileTable, Pool, order_of_dates
from ftlm.utils.files import LOG
from ftlm.utils.validation import CSV_TIME, as_mapping, is_run_name, listed, names_to_columns, nearest

PathLike: TypeAlias = str | os.PathLike[str]
_SIZE_LIMIT = 1 << 30
_COLUMN_KEYS = ("time", "step", "inputs", "outputs", "units", "intersample", "layout")


@dataclass
class Wanted:
    """Which columns of which layout the caller wants, from the arguments, the columns file and ftlm's own header."""

    time: Hashable | None
    step: float | None
    inputs: dict[str, Hashable]
    outputs: dict[str, Hashable]
    units: dict[str, str]
    intersample: dict[str, str]
    layout: Layout


def load(
    path: PathLike | Sequence[PathLike],
    *,
    time: str | int | None = None,
    inputs: Mapping[str, str | int] | Sequence[str] | str | None = None,
    outputs: Mapping[str, str | int] | Sequence[str] | str | None = None,
    units: Mapping[str, str] | None = None,
    columns: Mapping[str, object] | PathLike | None = None,
    intersample: Mapping[str, str] | None = None,
    step: float | None = None,
    slice: Sequence[float | None] | None = None,
    resample: float | None = None,
    name: str | None = None,
    time_unit: str | None = None,
    missing: str | None = None,
    layout: Layout | Mapping[str, object] | None = None,
) -> Run:
    """Load one run from a file of text, a sheet or arrays, or from several files that hold its columns.

    Parameters
    ----------
    path : path or sequence of paths
        Text, packed by gzip or not; ``.xlsx``, ``.xls``, ``.ods``; ``.mat``, ``.h5``, ``.npz``, ``.npy``; ``.parquet``,
        ``.feather``. Of text and of sheets, `layout` says what is above the table and how its cells are written, or it
        is found: comma, semicolon, tab or white space between cells, decimal points or commas, a header of names, a
        line of units, dates. What could be read in two ways is refused; what was taken for granted and could change
        numbers stands in the run's `warnings`, with what says otherwise. Lines that begin with ``#`` are skipped.
        Without a header the columns are c1, c2, …
        The columns of a matrix V are V.1, V.2, … (or ``V(:,1)``), a vector keeps its name; samples are in rows.
        Columns of several files are pooled; a name that is in two of them is prefixed by its file, ``STEM/V.3``.
    time : str or int, optional
        Column of the time, by name or, in a single text file, by position from 0. Without `time` and `step`, a text
        file's column called t, time or seconds (any case), alone or with a unit as in ``time [ms]``, ``time (ms)``,
        ``time/ms`` or ``t_ms``, is taken, a .mat file's vector of such a name; else (said in the run's `warnings`) one
        that other programs call so, such as Timestamp or Zeit, the only one that holds dates, or a first one with a
        unit of time; or else the first column of every matrix in use, which must all agree. Dates and times of day
        count from the first row on.
    inputs, outputs : mapping of str to column, or list of str, optional
        Columns by signal name; a list names columns that keep their names. Needed unless `columns` or the file's
        own ftlm header gives them; at least one output. A column that ends in its unit, ``I (A)``, is found without.
    units : mapping of str to str, optional
        Unit of a signal's numbers, converted to SI. A unit that the file states is not applied by itself:
        :func:`ftlm.open_file` shows it.
    columns : mapping or path of a TOML file, optional
        Keys ``time`` or ``step``, tables ``inputs``, ``outputs``, ``units``, ``intersample``, ``layout``; the arguments
        of the same name override or extend it.
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
    layout : Layout or dict, optional
        How text or a sheet is laid out, as far as it is to be said: see :class:`ftlm.Layout`.

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
    wanted = wanted_of(columns, time, step, inputs, outputs, units, intersample, layout)
    options = Options(slice, resample, name, time_unit, missing)
    run = run_from(tables_of(path, wanted.layout), wanted, options)
    LOG.info("read: %s: %d rows, %s", run.name, run.length, ", ".join(run.signals))
    return run


@dataclass(frozen=True)
class Options:
    """What else is asked of a run, as in :func:`load`, `missing` checked."""

    window: Sequence[float | None] | None = None
    resample: float | None = None
    name: str | None = None
    time_unit: str | None = None
    missing: str | None = None

    def __post_init__(self) -> None:
        checked_missing(self.missing or "refuse")

    def chosen(self, header: Header | None) -> Missing:
        """What becomes of gaps: as asked, or as a run of ftlm's own says."""
        if self.missing is None and header is not None and header.missing:
            return "weight"
        return checked_missing(self.missing or "refuse")


def run_from(tables: list[FileTable], wanted: Wanted, options: Options) -> Run:
    """Make the run that is wanted of files that have been read."""
    header = tables[0].header
    chosen = options.chosen(header)
    if header is not None and len(tables) > 1:
        raise DataError(f"{str(tables[0].path)!r} is a whole run of its own; load it alone")
    if header is not None:
        _take_header(wanted, header)
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
    clock = _clock(wanted, pool, used, options)
    name = options.name
    if name is None:
        stem = stem_of(tables[0].path)
        name = header.name if header is not None else stem if is_run_name(stem) else "run"
    several = len(tables) > 1
    facts = tuple(
        f"{table.path.name}: {a}" if several else str(a) for table in tables for a in table.assumed if a.counts
    )
    facts += clock.facts
    asked = Asked(
        given_inputs,
        given_outputs,
        step=wanted.step,
        time=clock.times,
        units=wanted.units,
        intersample=wanted.intersample,
        name=name,
        resample=options.resample,
        window=options.window,
        time_unit=clock.unit,
        labels=labels,
        facts=facts,
        time_label=clock.label,
        missing=chosen,
    )
    if header is not None:
        stated = header.step if clock.name == CSV_TIME else None
        asked = replace(asked, known_step=stated, facts=(*header.warnings, *facts), about=header.about)
    return built(asked)


@dataclass(frozen=True)
class _Clock:
    """The time of the rows: numbers in a unit, the column that they are from, what errors call it, what is said."""

    times: object = None
    unit: str = "s"
    label: str = "time"
    name: str | None = None
    facts: tuple[str, ...] = ()


def _clock(wanted: Wanted, pool: Pool, used: list[Column], options: Options) -> _Clock:
    given = options.time_unit
    if wanted.step is not None:
        if given is not None:
            raise DataError(f"time_unit={given!r} is the unit of time=, which is not used; step= is in s")
        return _Clock()
    column, assumed = pool.time(wanted.time, used)
    label = f"{column.source.name}: column {column.name!r} (time)"
    facts: tuple[str, ...] = () if assumed is None else (str(assumed),)
    if column.moments is None:
        unit, said = time_unit_of(header_of(column), label, given)
        return _Clock(column.numbers(), unit, label, column.name, facts + said)
    if given is not None:
        raise DataError(f"time_unit={given!r} is the unit of numbers, and {label} holds dates or times of day")
    seconds = column.moments.seconds(label, wanted.layout.dates)
    order = order_of_dates(column, wanted.layout.dates)
    facts += () if order is None else (str(order),)
    facts += (f"time counted from {column.moments.first!r} on",)
    return _Clock(seconds, "s", label, column.name, facts)


def stem_of(path: Path) -> str:
    """What a file is called without the endings that say how it is packed and what it is."""
    return Path(path.stem).stem if path.suffix.lower() == ".gz" else path.stem


def _check_apart(wanted: Wanted, pool: Pool) -> None:
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


def header_of(clock: Column) -> str:
    """Return what stands above a column of times; the first column of a matrix has no words of its own."""
    if clock.matrix is not None:
        return "time"
    below = clock.stated and header_time(clock.variable)[1] is None and not stated_unit(clock.variable)[1]
    return f"{clock.variable} [{clock.stated}]" if below else clock.variable


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


def tables_of(path: PathLike | Sequence[PathLike], layout: Layout) -> list[FileTable]:
    """Read files as they are, whatever is wanted of them."""
    paths = _paths(path)
    read: dict[Path, FileTable] = {}
    kinds = {path: kind_of(path) for path in paths}
    for kind in dict.fromkeys(kinds.values()):
        if kind is not None:
            own = [path for path in paths if kinds[path] is kind]
            for name in own:
                layout.check_used(repr(name.name), kind.words, OF_SHEETS if kind.sheets else ())
            read |= dict(zip(own, read_apart(own, kind, layout), strict=True))
    for name in paths:
        if kinds[name] is None:
            layout.check_used(repr(name.name), "text", OF_TEXT)
    return [read[path] if path in read else read_text(path, layout) for path in paths]


def column_names(path: PathLike) -> tuple[str, ...] | None:
    """Names of the columns of one file; None for a run that ftlm wrote, which names its own signals.

    Raises
    ------
    DataError
        As :func:`load`.
    """
    (table,) = tables_of(path, Layout())
    return None if table.header is not None else Pool([table]).names


def wanted_of(
    columns: object,
    time: Hashable | None,
    step: object,
    inputs: object,
    outputs: object,
    units: object,
    intersample: object,
    layout: object,
) -> Wanted:
    """What a person wants, by arguments and by a columns file; the arguments go before."""
    told = _columns_file(columns)
    if time is not None and step is not None:
        raise DataError("time= and step=: both are given; pass one of them")
    if time is None and step is None:
        time, step = told.get("time"), told.get("step")
        if time is not None and step is not None:
            raise DataError("columns=: both time and step are given; keep one of them")
    return Wanted(
        time,
        cast("float | None", step),
        names_to_columns("inputs", told.get("inputs")) | names_to_columns("inputs", inputs),
        names_to_columns("outputs", told.get("outputs")) | names_to_columns("outputs", outputs),
        _words("units", told.get("units")) | _words("units", units),
        _words("intersample", told.get("intersample")) | _words("intersample", intersample),
        Layout.of(told.get("layout")).under(Layout.of(layout)),
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


def _take_header(wanted: Wanted, header: Header) -> None:
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
