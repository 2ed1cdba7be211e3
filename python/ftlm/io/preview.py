"""What the names of columns say of them: inputs, outputs, units, and names that equations can hold."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ftlm.data.run import Run
from ftlm.data.units import header_time, spelled_unit
from ftlm.errors import DataError
from ftlm.io.cell_parsing import stated_unit
from ftlm.io.dialect import Assumption, Layout
from ftlm.io.load import Options, PathLike, Wanted, header_of, load, run_from, tables_of, wanted_of
from ftlm.io.load_frequency import is_response
from ftlm.io.table import Column, FileTable, Pool, order_of_dates
from ftlm.utils.validation import CSV_TIME, listed

_DRIVES = frozenset(
    (
        "u",
        "in",
        "inp",
        "input",
        "eingang",
        "cmd",
        "command",
        "current",
        "strom",
        "torque",
        "drehmoment",
        "pwm",
        "duty",
        "drive",
        "force",
        "kraft",
        "power",
        "leistung",
        "heater",
        "heating",
        "excitation",
        "anregung",
        "actuator",
        "i",
        "im",
        "valve",
        "ventil",
        "throttle",
    )
)
_FOLLOWS = frozenset(
    (
        "y",
        "out",
        "output",
        "ausgang",
        "angle",
        "winkel",
        "position",
        "pos",
        "weg",
        "displacement",
        "deflection",
        "auslenkung",
        "theta",
        "th",
        "temp",
        "temperature",
        "temperatur",
        "speed",
        "velocity",
        "drehzahl",
        "geschwindigkeit",
        "acceleration",
        "accel",
        "beschleunigung",
        "level",
        "pressure",
        "druck",
        "response",
        "antwort",
        "strain",
        "dehnung",
        "tip",
    )
)
#: A motor is driven by its voltage, a cell answers with it.
_EITHER = frozenset(["voltage", "volt", "volts", "spannung", "v"])
#: Degrees of these are no angles.
_WARM = frozenset(("temp", "temperature", "temperatur", "heat", "heater", "heating", "thermo"))


def _words(column: str) -> set[str]:
    """The words of a column's name, without its unit, digits and capitals."""
    bare = re.sub(r"(?<=[a-zäöüß])(?=[A-Z])", " ", stated_unit(column)[0])
    return set(re.split(r"[\W\d_]+", bare.casefold())) - {""}


def guessed_roles(columns: Sequence[str]) -> tuple[list[str], list[str]]:
    """Inputs and outputs among columns by their names; both empty where that leaves anything open."""
    told = {column: _words(column) for column in columns}
    drives = [c for c, words in told.items() if words & _DRIVES and not words & _FOLLOWS]
    follows = [c for c, words in told.items() if words & _FOLLOWS and not words & _DRIVES]
    either = [c for c, words in told.items() if words & _EITHER and c not in drives and c not in follows]
    if either and not drives:
        drives, either = either, []
    rest = [c for c in columns if c not in drives and c not in follows]
    if len(rest) == 1 and rest != either:
        if drives and not follows:
            follows, rest = rest, []
        elif follows and not drives:
            drives, rest = rest, []
    return (drives, follows) if drives and follows else ([], [])


def known_unit(stated: str, column: str = "") -> str:
    """The unit of ftlm that a file's unit is; "" where it is none, or degrees of what may be a temperature."""
    unit = spelled_unit(stated) or ""
    return "" if unit in ("deg", "°") and _words(column) & _WARM else unit


def signal_names(columns: Mapping[str, str]) -> dict[str, str]:
    """Names of signals by column, given whether each is an input ("u") or an output ("y")."""
    names: dict[str, str] = {}
    for column, role in columns.items():
        bare = re.sub(r"\W+", "_", stated_unit(column)[0].rpartition("/")[2]).strip("_")
        usable = re.fullmatch(r"[^\W\d]\w*", bare) and len(bare) <= 30 and bare.casefold() not in _TAKEN
        name = bare if usable else role
        taken, count = set(names.values()), 1
        while name in taken:
            count += 1
            name = f"{bare if usable else role}_{count}"
        names[column] = name
    return names


#: What equations in words use themselves.
_TAKEN = frozenset(("d", "sign", "sat", "dead", "delay", "alpha", "a0", "b0", "c", CSV_TIME))


_SHOWN = 40
#: Names of a time that state its unit by themselves.
_SECONDS = frozenset(("seconds", "second", "sec", "secs", "sekunden"))
#: What the error of a column says of its first bad cell.
_IN_LINE = re.compile(r"line \d+: .*?(?=, first at)")


@dataclass(frozen=True)
class FileColumn:
    """One column of a file.

    Parameters
    ----------
    name : str
        As the file has it.
    role : str
        ``"time"``, ``"input"``, ``"output"``, or "" for none.
    signal : str
        What a run calls it, where it is an input or an output.
    unit : str
        As the file states it; "" for none.
    first, low, high : float or None
        First, lowest and highest number; None where it holds no numbers.
    words : str
        What it holds where that is no numbers.
    """

    name: str
    role: str
    signal: str
    unit: str
    first: float | None
    low: float | None
    high: float | None
    words: str = ""


@dataclass(frozen=True)
class OpenedFile:
    """A file as :func:`ftlm.open_file` reads it.

    Parameters
    ----------
    path : str
        Of the file.
    kind : str
        What it is, in words.
    rows : int
        How many rows its table has.
    columns : tuple of FileColumn
        What they hold.
    layout : Layout
        How it is laid out, nothing left open.
    assumed : tuple of Assumption
        What nobody said and was taken for granted, each with the option that says it.
    options : dict
        Arguments of :func:`ftlm.load` that say all of it: the run is the same.
    step : float or None
        Time between rows [s]; None where `problem` stands in the way.
    problem : str
        Why it is no run yet, and what to do; "" for a run.
    notes : tuple of str
        What the run says of itself.
    """

    path: str
    kind: str
    rows: int
    columns: tuple[FileColumn, ...]
    layout: Layout
    assumed: tuple[Assumption, ...]
    options: dict[str, Any]
    step: float | None
    problem: str
    notes: tuple[str, ...] = ()

    def load(self) -> Run:
        """Load it as a run, everything said that was assumed."""
        return load(self.path, **self.options)

    def command(self, verb: str = "identify") -> str:
        """What to type next, quoted for a shell; "" where inputs or outputs are not known yet.

        Parameters
        ----------
        verb
            Command of `ftlm`: ``identify`` with the simplest equation of the first output, ``inspect``, ``select``.
        """
        if self.problem:
            return ""
        words = ["ftlm", verb, self.path if not self.path.startswith("-") else f"./{self.path}", *self._flags()]
        outputs = [c.signal for c in self.columns if c.role == "output"]
        inputs = [c.signal for c in self.columns if c.role == "input"]
        if verb == "identify":
            drives = "".join(f" + b{k} {name}" for k, name in enumerate(inputs))
            words += ["--structure", f"D^alpha {outputs[0]} = a0 {outputs[0]}{drives}"]
        elif verb == "select":
            words += ["--structure", "auto"]
        return " ".join(map(shlex.quote, words))

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        said = {**asdict(self), "layout": self.layout.to_dict(), "commands": self._commands()}
        return {**said, "options": {k: v.to_dict() if isinstance(v, Layout) else v for k, v in self.options.items()}}

    def __str__(self) -> str:
        heads = ("column", "role", "unit", "first", "low", "high")
        shown = self.columns[:_SHOWN]
        cells = [heads, *((_printed(c.name), _role(c), _printed(c.unit), *_figures(c)) for c in shown)]
        widths = [max(len(row[k]) for row in cells) for k in range(6)]
        counts = f"{self.rows} row{'s' * (self.rows != 1)}, {len(self.columns)} column{'s' * (len(self.columns) != 1)}"
        lines = [f"{_printed(self.path)}: {self.kind}; {counts}"]
        lines += ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in cells]
        if len(self.columns) > _SHOWN:
            lines.append(f"… and {len(self.columns) - _SHOWN} more")
        if self.step is not None:
            lines.append(f"step {self.step:.6g} s, {self.step * (self.rows - 1):.6g} s in all")
        lines += [f"assumed: {assumption}" for assumption in self.assumed]
        lines += [f"note: {note}" for note in self.notes]
        if self.problem:
            lines.append(f"to do: {self.problem}")
        # What cannot be printed cannot be copied from a terminal either.
        lines += [f"next: {line}" for line in self._commands() if line.isprintable()]
        return "\n".join(map(_escaped, lines))

    def _commands(self) -> list[str]:
        return [] if self.problem else [self.command("inspect"), self.command("identify")]

    def _flags(self) -> list[str]:
        """Options of the command line."""
        told = self.options
        # What every reader finds by itself and what is so by default may stay unsaid.
        plain = {a.option for a in self.assumed if not a.counts and a.option != "time"}
        words = []
        for key, option in (
            ("time", "--time"),
            ("step", "--sampling"),
            ("time_unit", "--time-unit"),
            ("resample", "--resample"),
            ("missing", "--missing"),
        ):
            if key in told and key not in plain:
                words += [option, str(told[key])]
        if "slice" in told:
            words += ["--slice", ":".join("" if end is None else repr(end) for end in told["slice"])]
        for key, option in (("inputs", "-u"), ("outputs", "-y"), ("units", "--unit"), ("intersample", "--intersample")):
            bare = key in ("inputs", "outputs")
            pairs = (name if bare and name == value else f"{name}={value}" for name, value in told.get(key, {}).items())
            words += [w for pair in pairs for w in (option, pair)]
        told_layout: Layout = told.get("layout", Layout())
        words += [w for k, v in told_layout.to_dict().items() if k not in plain for w in (f"--{k}", str(v))]
        return words


def open_file(
    path: PathLike,
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
    time_unit: str | None = None,
    missing: str | None = None,
    layout: Layout | Mapping[str, object] | None = None,
) -> OpenedFile:
    """Say what a file is and how it is read: columns, units, roles, what was assumed, what to type next.

    What is not asked for is taken from the file: the time and roles from names, units from names or a line of them. All
    of it stands in the result, with the arguments of :func:`ftlm.load` that say it. Nothing is guessed from numbers.

    Parameters
    ----------
    path : path
        One file of any kind that :func:`ftlm.load` reads.
    time, inputs, outputs, units, columns, intersample, step, slice, resample, time_unit, missing, layout
        As of :func:`ftlm.load`.

    Returns
    -------
    OpenedFile
        Prints as a table; ``.load()`` is the run.

    Raises
    ------
    DataError
        The file is missing, damaged, or can be read in more than one way; what only keeps it from being a run is its
        `problem`.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise DataError(f"path is a {type(path).__name__}; pass the path of one file")
    wanted = wanted_of(columns, time, step, inputs, outputs, units, intersample, layout)
    options = Options(slice, resample, None, time_unit, missing)
    (table,) = tables_of(path, wanted.layout)
    return _Opening(table, Pool([table]), wanted, options).result(os.fspath(path))


@dataclass
class _Opening:
    """A file on its way to being understood."""

    table: FileTable
    pool: Pool
    wanted: Wanted
    asked: Options

    def result(self, path: str) -> OpenedFile:
        table, wanted = self.table, self.wanted
        every = self.pool.columns
        clock, assumed, problem = self._time(every)
        of_clock = () if clock is None else self._of_clock(clock)
        roles, said, open_roles = self._roles(every, clock)
        assumed = (*table.assumed, *assumed, *of_clock, *said)
        step, notes = None, tuple[str, ...]()
        if not problem:
            problem = open_roles
        options = self._options(clock, of_clock)
        if not problem:
            try:
                run = run_from([table], wanted, self.asked)
                step, notes = run.step, tuple(n for n in run.warnings if n not in {str(a) for a in assumed})
            except DataError as error:
                problem = str(error)
        shown = tuple(_shown(column, roles) for column in every)
        rows = max((0 if c.values is None else c.values.size for c in every), default=0)
        return OpenedFile(path, table.kind, rows, shown, table.layout, assumed, options, step, problem, notes)

    def _time(self, every: list[Column]) -> tuple[Column | None, tuple[Assumption, ...], str]:
        """The time, what was assumed of it, and why there is none."""
        wanted, header = self.wanted, self.table.header
        if header is not None and wanted.time is None and wanted.step is None:
            wanted.time = CSV_TIME
        if wanted.step is not None:
            return None, (), ""
        matrices = list(dict.fromkeys(c.matrix for c in every if c.matrix is not None))
        used = [c for c in every if c.matrix is not None] if len(matrices) == 1 else []
        try:
            clock, assumed = self.pool.time(wanted.time, used)
        except DataError as error:
            if is_response(self.pool):
                return (
                    None,
                    (),
                    (
                        "these are columns of a frequency response or an impedance spectrum, and none is a time; "
                        "ftlm.load_frequency and ftlm identify-frequency read it as such"
                    ),
                )
            return None, (), str(error)
        if assumed is not None:
            return clock, (assumed,), ""
        if wanted.time is None and clock.matrix is not None:
            words = f"the time is the first column of the matrix, {clock.name!r}"
            return clock, (Assumption("time", clock.name, words, "time=COLUMN", False),), ""
        return clock, (), ""

    def _roles(
        self, every: list[Column], clock: Column | None
    ) -> tuple[dict[str, tuple[str, str]], tuple[Assumption, ...], str]:
        """Role and signal by column, what was guessed, and what is still open."""
        wanted, header, guessed = self.wanted, self.table.header, False
        if header is not None and not wanted.inputs and not wanted.outputs:
            wanted.inputs, wanted.outputs = {n: n for n in header.inputs}, {n: n for n in header.outputs}
        elif not wanted.inputs and not wanted.outputs:
            free = [c for c in every if c is not clock and _holds(c) and c.name and c.name.isprintable()]
            own = {c.written: c.name for c in free}
            drives, follows = guessed_roles(list(own))
            names = signal_names({**dict.fromkeys(drives, "u"), **dict.fromkeys(follows, "y")})
            wanted.inputs, wanted.outputs = {names[c]: own[c] for c in drives}, {names[c]: own[c] for c in follows}
            guessed = bool(drives)
        roles: dict[str, tuple[str, str]] = {} if clock is None else {clock.name: ("time", "")}
        for role, asked in (("input", wanted.inputs), ("output", wanted.outputs)):
            for name, spec in asked.items():
                column = self.pool.find(spec, f"signal {name!r}")
                roles[column.name] = (role, name)
                unit = known_unit(column.stated, column.written)
                if unit and name not in wanted.units and header is None:
                    wanted.units[name] = unit
        said = []
        if guessed:
            inputs, outputs = listed(wanted.inputs.values(), 10), listed(wanted.outputs.values(), 10)
            words = f"{inputs} {'drives' if len(wanted.inputs) == 1 else 'drive'} {outputs}, by their names"
            said.append(Assumption("inputs", inputs, words, "inputs={name: column}, outputs={name: column}"))
        left = ""
        if not wanted.outputs:
            choice = listed((c.name for c in every if c is not clock and _holds(c)), 20)
            left = (
                "which columns are inputs and which are outputs, their names do not say; name them with "
                f"inputs={{name: column}} and outputs={{name: column}}; there are {choice or 'none'}"
            )
            wordy = (c for c in every if c is not clock and not _holds(c) and c.moments is None)
            others = [f"{c.name!r} ({_why(c)})" for c in wordy]
            if others:
                more = f" and {len(others) - _SHOWN} more" * (len(others) > _SHOWN)
                left += f"; no column of numbers is {', '.join(others[:_SHOWN])}{more}"
        return roles, tuple(said), left

    def _of_clock(self, clock: Column) -> tuple[Assumption, ...]:
        """What was assumed of the numbers or dates of the time."""
        if self.table.header is not None:
            return ()
        if clock.moments is not None:
            order = order_of_dates(clock, self.wanted.layout.dates)
            return () if order is None else (order,)
        name = header_of(clock)
        known = header_time(name)[1] is not None or name.casefold() in _SECONDS
        if self.asked.time_unit is not None or known or clock.problem is not None:
            return ()
        words = f"the numbers of {clock.name!r} are seconds, as no unit is stated"
        return (Assumption("time_unit", "s", words, "time_unit=UNIT", False),)

    def _options(self, clock: Column | None, of_clock: tuple[Assumption, ...]) -> dict[str, Any]:
        """What says all of it to `load`."""
        wanted = self.wanted
        options: dict[str, Any] = {"step": wanted.step} if wanted.step is not None else {}
        if clock is not None and self.table.header is None:
            options["time"] = clock.name
        asked = self.asked
        more = {
            "slice": asked.window,
            "resample": asked.resample,
            "time_unit": asked.time_unit,
            "missing": asked.missing,
        }
        options |= {key: value for key, value in more.items() if value is not None}
        for key in ("inputs", "outputs", "units", "intersample"):
            if getattr(wanted, key) and (self.table.header is None or key in ("inputs", "outputs")):
                options[key] = dict(getattr(wanted, key))
        said = {*wanted.layout.to_dict(), *(a.option for a in self.table.assumed)}
        layout = Layout.of({key: value for key, value in self.table.layout.to_dict().items() if key in said})
        for assumption in of_clock:
            if assumption.option == "dates":
                layout = layout.under(Layout(dates=str(assumption.value)))
            else:
                options[assumption.option] = assumption.value
        return options | ({"layout": layout} if layout != Layout() else {})


def _holds(column: Column) -> bool:
    """Whether a column holds numbers, gaps or not."""
    return column.problem is None or column.blank


def _why(column: Column) -> str:
    """Its first cell that is no number, and in which line."""
    found = _IN_LINE.search(str(column.problem))
    return "" if found is None else found[0]


def _shown(column: Column, roles: Mapping[str, tuple[str, str]]) -> FileColumn:
    role, signal = roles.get(column.name, ("", ""))
    unit, values = column.stated, column.values
    if column.moments is not None:
        return FileColumn(column.name, role, signal, unit, None, None, None, f"from {column.moments.first}")
    if values is None or not values.size or not _holds(column):
        why = _why(column)
        words = "no numbers" if not why else f"no numbers ({why})"
        return FileColumn(column.name, role, signal, unit, None, None, None, words)
    there = values[~np.isnan(values)]
    if not there.size:
        return FileColumn(column.name, role, signal, unit, None, None, None, "empty")
    return FileColumn(column.name, role, signal, unit, float(values[0]), float(there.min()), float(there.max()))


def _role(column: FileColumn) -> str:
    return f"{column.role} {column.signal}" if column.signal else column.role


def _figures(column: FileColumn) -> tuple[str, str, str]:
    if column.first is None or column.low is None or column.high is None:
        return _printed(column.words), "", ""
    return f"{column.first:.5g}", f"{column.low:.5g}", f"{column.high:.5g}"


def _printed(text: str) -> str:
    """Text without what a terminal would obey, and not too long."""
    return _escaped(text[:60]) + ("…" if len(text) > 60 else "")


def _escaped(text: str) -> str:
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
