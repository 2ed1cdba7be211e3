"""Roles of columns (input or output) and signal names, inferred from column names."""

from __future__ import annotations

import re
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

from ftlm.data.units import parse_unit
from ftlm.io.cell_parsing import split_unit
from ftlm.io.dialect import Assumption, Layout
from ftlm.io.table import Column, ColumnTable
from ftlm.utils.parameters import NAMED_COLUMNS, parameter
from ftlm.utils.validation import CSV_TIME, join_names


@dataclass
class ColumnSelection:
    """Selection of the columns of a run, with units and layout.

    It comes from arguments, a columns file or the header of a file that ftlm wrote. At most one of the column `time`
    and the `step` [s] is set; without both, the time column is detected. `inputs` and `outputs` map each signal to the
    name or position of its column.
    """

    time: Hashable | None
    step: float | None
    inputs: dict[str, Hashable]
    outputs: dict[str, Hashable]
    units: dict[str, str]
    intersample: dict[str, str]
    layout: Layout


#: Words in column names, by the role or quantity that they indicate. A voltage is an input of motors and an output of
#: cells. A reference is neither input nor output of a plant. Names of a command and its measurement differ in one word.
#: Degrees of a temperature are not angles.
_WORDS_BY_ROLE = {
    kind: frozenset(words.split())
    for kind, words in {
        "input": "u in inp input eingang cmd command current strom torque drehmoment pwm duty drive force kraft power "
        "leistung heater heating excitation anregung actuator i im valve ventil throttle pump pumpe fan opening "
        "vin uin iin pin",
        "output": "y out output ausgang angle winkel position pos weg displacement deflection auslenkung theta th temp "
        "temperature temperatur speed velocity drehzahl geschwindigkeit acceleration accel beschleunigung level "
        "pressure druck response antwort strain dehnung tip vout uout iout pout",
        "input or output": "voltage volt volts spannung v",
        "reference": "ref reference setpoint target desired soll sollwert referenz",
        "command": "cmd command commanded",
        "measurement": "meas measured actual ist",
        "temperature": "temp temperature temperatur heat heater heating thermo",
    }.items()
}


def words_of(column: str) -> set[str]:
    """Return the case-folded words of a column name, without its unit and without digits."""
    bare = re.sub(r"(?<=[a-zäöüß])(?=[A-Z])", " ", split_unit(column)[0])
    return set(re.split(r"[\W\d_]+", bare.casefold())) - {""}


def guess_roles(columns: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the columns whose names suggest an input, and those whose names suggest an output.

    Both lists are empty if the names are ambiguous. References, and commands whose quantity is also measured, are
    omitted unless all inputs or all outputs are among them. A single column is an output, unless its name suggests an
    input.
    """
    if len(columns) == 1 and not words_of(columns[0]) & _WORDS_BY_ROLE["input"]:
        return [], list(columns)
    quantities = {
        _tokens(c) - _WORDS_BY_ROLE["measurement"] for c in columns if _tokens(c) & _WORDS_BY_ROLE["measurement"]
    }
    plant = [
        c
        for c in columns
        if not words_of(c) & _WORDS_BY_ROLE["reference"]
        and not (_tokens(c) & _WORDS_BY_ROLE["command"] and _tokens(c) - _WORDS_BY_ROLE["command"] in quantities)
    ]
    roles, roles_of_all = _roles_by_words(plant), _roles_by_words(columns)
    # If the only other columns are outputs, a reference is the input of a closed loop.
    return roles_of_all if not roles[1] or (roles_of_all[0] and not roles[0]) else roles


def _tokens(column: str) -> frozenset[str]:
    """Return the case-folded words of a column name, including digits, such as ``im1``."""
    return frozenset(re.split(r"[\W_]+", column.casefold()))


def _roles_by_words(columns: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the columns whose names contain words of inputs, and those whose names contain words of outputs.

    A single remaining column gets the role that no other column has. Both lists are empty if roles are ambiguous.
    """
    words_by_column = {column: words_of(column) for column in columns}
    inputs, outputs, both = (
        [c for c, words in words_by_column.items() if words & _WORDS_BY_ROLE[role]]
        for role in ("input", "output", "input or output")
    )
    input_columns, output_columns = [c for c in inputs if c not in outputs], [c for c in outputs if c not in inputs]
    ambiguous = [c for c in both if c not in input_columns and c not in output_columns]
    if ambiguous and not input_columns:
        input_columns, ambiguous = ambiguous, []
    without_role = [c for c in columns if c not in input_columns and c not in output_columns]
    if len(without_role) == 1 and without_role != ambiguous:
        if input_columns and not output_columns:
            output_columns, without_role = without_role, []
        elif output_columns and not input_columns:
            input_columns, without_role = without_role, []
    if output_columns and not input_columns and not without_role:
        # Outputs without any input are a free response.
        return [], output_columns
    return (input_columns, output_columns) if input_columns and output_columns else ([], [])


def known_unit(text: str, column: str = "") -> str:
    """Return the ftlm unit for the unit `text` in a file; "" if it is unknown.

    The result is also "" for degrees if the name of the column suggests a temperature.
    """
    unit = parse_unit(text) or ""
    return "" if unit in ("deg", "°") and words_of(column) & _WORDS_BY_ROLE["temperature"] else unit


def signal_names(columns: Mapping[str, str]) -> dict[str, str]:
    """Return a valid, unique signal name for each column; the values of `columns` are fallback names, "u" or "y"."""
    names: dict[str, str] = {}
    for column, role in columns.items():
        bare = re.sub(r"\W+", "_", split_unit(column)[0].rpartition("/")[2]).strip("_")
        usable = re.fullmatch(r"[^\W\d]\w*", bare) and len(bare) <= 30 and bare.casefold() not in _RESERVED_NAMES
        name = bare if usable else role
        used_names, count = set(names.values()), 1
        while name in used_names:
            count += 1
            name = f"{bare if usable else role}_{count}"
        names[column] = name
    return names


#: Names that have a meaning in equation texts, and are therefore not used for signals.
_RESERVED_NAMES = frozenset(("d", "sign", "sat", "dead", "delay", "alpha", "a0", "b0", "c", CSV_TIME))


def has_numbers(column: Column) -> bool:
    """Whether a column consists of numbers, possibly with gaps."""
    return column.problem is None or column.blank


def assume_roles(
    selection: ColumnSelection, columns: Sequence[Column], signals: tuple[Sequence[str], Sequence[str]] | None = None
) -> tuple[Assumption, ...]:
    """Set inputs and outputs of a selection in place if it has neither, and return any assumption on them.

    Parameters
    ----------
    selection
        Column selection to complete.
    columns
        Columns of the file except the time.
    signals
        Inputs and outputs of an equation. If the file has all of them, they are selected without an assumption.
        Otherwise roles are guessed from words in the column names, such as input or torque, output or angle. Inputs and
        outputs stay empty if these words are ambiguous.
    """
    if selection.inputs or selection.outputs:
        return ()
    free = [c for c in columns if has_numbers(c) and c.name and c.name.isprintable()]
    names_by_label = {c.name_with_unit: c.name for c in free}
    if signals is not None:
        columns_by_name = {
            name: names_by_label[c] for c, name in signal_names(dict.fromkeys(names_by_label, "c")).items()
        } | {c.name: c.name for c in free}
        if all(name in columns_by_name for names_pair in signals for name in names_pair):
            selection.inputs = {name: columns_by_name[name] for name in signals[0]}
            selection.outputs = {name: columns_by_name[name] for name in signals[1]}
            return ()
    ignored = [c.name for c in columns if c.name and not has_numbers(c)]
    if len(names_by_label) == 1 and any(words_of(name) & _WORDS_BY_ROLE["input"] for name in ignored):
        # If the input has no numbers, the file is faulty, and the output must not be taken for a free response.
        return ()
    input_columns, output_columns = guess_roles(list(names_by_label))
    names = signal_names({**dict.fromkeys(input_columns, "u"), **dict.fromkeys(output_columns, "y")})
    selection.inputs, selection.outputs = (
        {names[c]: names_by_label[c] for c in input_columns},
        {names[c]: names_by_label[c] for c in output_columns},
    )
    if not output_columns:
        return ()
    inputs, outputs = join_names(selection.inputs.values(), 10), join_names(selection.outputs.values(), 10)
    text = f"{inputs} {'is an input' if len(selection.inputs) == 1 else 'are inputs'} of {outputs}, by their names"
    if not input_columns:
        text = (
            f"there is no input of {outputs}, {'by the names of the columns' if len(free) > 1 else 'the only signal'}"
        )
    remedy = f"{parameter('inputs', NAMED_COLUMNS)}, {parameter('outputs', NAMED_COLUMNS)}"
    return (Assumption("inputs", inputs, text, remedy),)


def add_file_units(selection: ColumnSelection, pool: ColumnTable) -> None:
    """Add the known units in the files to a selection, in place, for signals without a unit in the selection."""
    for name, spec in (selection.inputs | selection.outputs).items():
        column = pool.find(spec, f"signal {name!r}")
        unit = known_unit(column.file_unit, column.name_with_unit)
        if unit and name not in selection.units:
            selection.units[name] = unit
